"""Parts of the data sheet's plots: a plot with its caption, markers, lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.report.charts import Figure, Trace


@dataclass(frozen=True)
class EmvaPlot:
    """A figure with its title and caption."""

    title: str
    figure: Figure
    caption: str
    of_plane: bool = True  # of the sheet's plotted plane; else of all pixels


def markers(name: str, x: Sequence[float], y: Sequence[float], colour: str, **more: Any) -> Trace:
    """Return a trace of markers; `more`: further keys of the trace."""
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": list(x),
        "y": list(y),
        "marker": {"color": colour, "size": 5},
    } | more


def curve(name: str, x: Sequence[float], y: Sequence[float], colour: str, dash: str = "solid", **more: Any) -> Trace:
    """Return a trace of lines; `more`: further keys of the trace."""
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": list(x),
        "y": list(y),
        "line": {"color": colour, "width": 1.6, "dash": dash},
    } | more


def floats(values: NDArray[np.floating[Any]]) -> list[float]:
    """Return an array (n,) as a list."""
    return [float(value) for value in values]
