"""What `calibench standards` finds: figures of standards with their uncertainty, the requirements that the recordings
don't meet, and the pictures' points."""

from __future__ import annotations

from typing import Literal

from lab.formats.results.estimate import Estimate
from lab.formats.results.fit import Skipped
from sim.camera import Side
from sim.parameters import Frozen


class Deviation(Frozen):
    """A requirement of a standard that the recordings don't meet.

    `quantity`, `found`, `limit`, `remedy`: in words. `figures`: names of the figures that it bears on; empty: all."""

    clause: str
    quantity: str
    found: str
    limit: str
    remedy: str
    figures: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The deviation in one line."""
        return f"{self.quantity}: {self.found}; the standard asks for {self.limit} ({self.clause}): {self.remedy}"


class StandardFigure(Frozen):
    """One figure of a standard.

    `clause`, `symbol`, `formula`: as declared beside its computation. `estimate`: None where the recordings don't
    determine it; `reason`: why. `by_the_standard`: whether all requirements that bear on it are met."""

    name: str
    quantity: str
    clause: str
    symbol: str
    unit: str
    formula: str
    estimate: Estimate | None
    by_the_standard: bool
    reason: str = ""


class PlotCurve(Frozen):
    """A curve of a plot. `y_std`: standard uncertainties; empty: none. `style`: how it is drawn."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    y_std: tuple[float, ...] = ()
    style: Literal["points", "line", "dashed"] = "line"
    channel: str = ""


class StandardPlot(Frozen):
    """Curves over one abscissa."""

    title: str
    x_label: str
    y_label: str
    curves: tuple[PlotCurve, ...]
    caption: str = ""
    logarithmic: tuple[bool, bool] = (False, False)


class StandardMap(Frozen):
    """Values over cells of the frame, rows from its top; None where there is none."""

    title: str
    unit: str
    values: tuple[tuple[float | None, ...], ...]
    caption: str = ""


class StandardReading(Frozen):
    """One standard on one subject (a plane, an edge, the camera) of one side.

    `conditions`: what was measured, how and by which instruments, in words. `remarks`: where the reading differs from
    the standard's text, and what its own estimator is biased by."""

    standard: str
    title: str
    side: Side
    subject: str
    figures: tuple[StandardFigure, ...]
    deviations: tuple[Deviation, ...] = ()
    conditions: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    plots: tuple[StandardPlot, ...] = ()
    maps: tuple[StandardMap, ...] = ()


class StandardsResult(Frozen):
    """The standards' figures of a recording set."""

    format: Literal["calibench-standards"] = "calibench-standards"
    version: Literal[1] = 1
    source: str
    readings: tuple[StandardReading, ...]
    skipped: tuple[Skipped, ...] = ()
