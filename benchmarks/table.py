"""How the benchmarks print: one table, a row a figure, ours beside a peer's or a limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One figure: `ours` beside `beside`, a peer's figure in the same run or a limit (None: there is none)."""

    name: str
    ours: float
    beside: float | None = None
    unit: str = ""
    note: str = ""  # what stands beside it: "OpenCV", "limit"


def show(title: str, rows: Sequence[Row]) -> None:
    """Print the rows as a table with the ratio of ours to what stands beside it."""
    print(f"\n{title}")
    print(f"| {'figure':52} | {'ours':>10} | {'beside':>10} | {'ratio':>7} | of |")
    print(f"| {'-' * 52} | {'-' * 10} | {'-' * 10} | {'-' * 7} | --- |")
    for row in rows:
        name = f"{row.name}, {row.unit}" if row.unit else row.name
        beside = "" if row.beside is None else f"{row.beside:.4g}"
        ratio = "" if not row.beside else f"{row.ours / row.beside:.3f}"
        print(f"| {name:52} | {row.ours:10.4g} | {beside:>10} | {ratio:>7} | {row.note} |")
