"""The data of a page's charts: the figures as typed arrays, and plotly.js with Cartesian traces only, both compressed.

`plotly-cartesian.min.js.gz` is a third of the full build. It was made by

    npm pack plotly.js-cartesian-dist-min@4.1.1     # MIT, see plotly-LICENSE.txt
    gzip -9 -n < package/plotly-cartesian.min.js > plotly-cartesian.min.js.gz
"""

from __future__ import annotations

import base64
import gzip
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lab.report.charts import Figure

BUILD = Path(__file__).with_name("plotly-cartesian.min.js.gz")
#: A trace's keys whose numbers are sent as typed arrays, from how many numbers on.
PACKED, PACKED_FROM = frozenset({"x", "y", "z", "array", "arrayminus"}), 8


@cache
def plotly_base64() -> str:
    """Return the compressed build as base64; `charts.js` expands it in the page."""
    return base64.b64encode(BUILD.read_bytes()).decode("ascii")


class ChartData:
    """The figures of one page, in the order in which its template asks for them."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add(self, figure: Figure) -> int:
        """Keep a figure; its number on the page."""
        self._lines.append(figure_json(figure))
        return len(self._lines) - 1

    def packed(self) -> str:
        """All figures, a line of JSON each, compressed, as base64: no text of theirs can end the element that holds
        it."""
        return base64.b64encode(gzip.compress("\n".join(self._lines).encode(), mtime=0)).decode("ascii")


def _packed(values: Any) -> dict[str, str] | None:
    """Numbers as plotly's typed array (float32, base64; NaN where there is none), None where it isn't an array worth
    packing."""
    if not isinstance(values, list | tuple) or len(values) < PACKED_FROM:
        return None
    rows = [row for row in values if isinstance(row, list | tuple)]
    if rows and (len(rows) != len(values) or len({len(row) for row in rows}) != 1):
        return None
    flat = [item for row in rows for item in row] if rows else list(values)
    if any(isinstance(item, bool) or not isinstance(item, int | float | None) for item in flat):
        return None
    numbers = np.array([np.nan if item is None else item for item in flat], "<f4")
    shape = {"shape": f"{len(rows)}, {len(rows[0])}"} if rows else {}
    return {"dtype": "f4", "bdata": base64.b64encode(numbers.tobytes()).decode("ascii")} | shape


def figure_json(figure: Figure) -> str:
    """Return a figure as one line of JSON: a trace's numbers as typed arrays, others rounded to 7 digits."""

    def rounded(value: Any, key: str = "") -> Any:
        if key in PACKED and (packed := _packed(value)) is not None:
            return packed
        if isinstance(value, dict):
            return {name: rounded(item, name) for name, item in value.items()}
        if isinstance(value, list | tuple):
            return [rounded(item) for item in value]
        if isinstance(value, float):
            return float(f"{value:.7g}") if np.isfinite(value) else None
        return value

    return json.dumps(rounded(figure), separators=(",", ":"), allow_nan=False)
