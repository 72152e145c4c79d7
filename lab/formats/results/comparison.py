"""The result of `calibench compare`: what changed between two calibrations."""

from __future__ import annotations

from typing import Literal

from lab.formats.results.skipped import Skipped
from sim.camera import Side
from sim.parameters import Frozen


class Change(Frozen):
    """One fitted number in two calibrations, or the point of a curve of `n` points at which they differ most.

    `difference` is B less A. `significance_sigma`: two-sided, in standard deviations of a normal distribution,
    corrected for the number of points. `title`, `unit`: as a lab reads them; "1": a ratio. `temperature_c`: of a dark
    current, the sensor's temperature in A, to which B is converted; `difference_std` has the uncertainty of that
    conversion.
    """

    name: str
    title: str = ""
    unit: str = "1"
    side: Side | None = None
    where: str = ""
    temperature_c: float | None = None
    n: int = 1
    a: float
    a_std: float
    b: float
    b_std: float
    difference: float
    difference_std: float
    significance_sigma: float
    changed: bool


class ProjectionChange(Frozen):
    """Difference of the projections of two calibrations of one camera, px rms over the corners that both use.

    `as_stated_px`: by the numbers as they are; `difference_px`: after the implied motion is removed. `vectors_px`
    [row][column] (x, y): the latter on a grid over the frame.
    """

    side: Side
    as_stated_px: float
    implied_turn_mrad: tuple[float, float, float]
    implied_shift_mm: tuple[float, float, float]
    difference_px: float
    expected_px: float  # from the uncertainties alone
    significance_sigma: float
    changed: bool
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    vectors_px: tuple[tuple[tuple[float, float], ...], ...]


class ComparisonResult(Frozen):
    """Two calibrations, A and B, compared."""

    format: Literal["calibench-comparison"] = "calibench-comparison"
    version: Literal[1] = 1
    a: str
    b: str
    #: Probability that two calibrations of an unchanged camera show any change, and the threshold that follows for one
    #: number.
    false_alarm_rate: float
    threshold_sigma: float
    changes: tuple[Change, ...]
    projection: tuple[ProjectionChange, ...] = ()
    #: What differs of the instruments, a line each, where both calibrations know theirs.
    instruments: tuple[str, ...] = ()
    skipped: tuple[Skipped, ...] = ()

    @property
    def changed(self) -> bool:
        """Whether anything changed beyond its uncertainty."""
        return any(item.changed for item in self.changes) or any(item.changed for item in self.projection)
