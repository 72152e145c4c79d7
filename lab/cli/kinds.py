"""`calibench kinds`."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.cli.console import out
from lab.cli.sources import StoreFolder, recordings_of

commands = typer.Typer()


@commands.command()
def kinds(
    source: Annotated[
        str, typer.Argument(metavar="[SOURCE]", help="count the captures in a recording set or a stored session")
    ] = "",
    data: StoreFolder = None,
) -> None:
    """The kinds of capture: the scene, and the sequence that takes them."""
    from lab.capture_kinds.base import CAPTURES

    counted = Counter(capture.kind for capture in recordings_of(source, data).captures()) if source else None
    table = Table(box=None, pad_edge=False)
    for heading in (
        "kind",
        "sequence",
        "what stands before the camera",
        *(["captures"] if counted is not None else []),
    ):
        table.add_column(heading)
    for name, kind in CAPTURES.models.items():
        sequence = kind.sequence.name if kind.sequence else "-"
        table.add_row(name, sequence, escape(kind.shows), *([str(counted[name])] if counted is not None else []))
    out.print(table)
