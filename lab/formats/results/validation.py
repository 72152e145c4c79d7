"""What predictions are worth: a validation, a comparison of two fits, and the file of a report."""

from __future__ import annotations

from typing import Literal

from lab.formats.results.fit import Skipped
from lab.shown import Tabular
from sim.camera import Side
from sim.parameters import Frozen


class PatchComparison(Frozen):
    """One chart patch in one channel, predicted and measured; DN above black."""

    patch: str
    channel: str
    predicted_dn: float
    predicted_dn_std: float
    measured_dn: float
    measured_dn_std: float


class CurveComparison(Frozen):
    """A predicted and a measured curve on one axis."""

    label: str
    channel: str
    axis: str  # name and unit: "spatial frequency, cy/px"
    x: tuple[float, ...]
    predicted: tuple[float, ...]
    measured: tuple[float, ...]
    measured_std: tuple[float, ...]


class KernelPair(Frozen):
    """A predicted and a measured point-spread function."""

    label: str
    channel: str
    predicted: tuple[tuple[float, ...], ...]
    measured: tuple[tuple[float, ...], ...]
    psnr_peak_db: float  # peak = maximum of the predicted kernel
    psnr_unit_db: float  # peak = 1


class Check(Frozen):
    """Predicted against measured for one measurement that the fit didn't use. `passed`: chi2 is within its 99.9 %
    quantile."""

    name: Literal["colorchecker", "mtf", "psf"]
    side: Side
    capture: str
    n: int
    chi2: float
    rms_relative_percent: float
    passed: bool
    patches: tuple[PatchComparison, ...] = ()
    curves: tuple[CurveComparison, ...] = ()
    kernels: tuple[KernelPair, ...] = ()


class ValidationResult(Tabular, Frozen):
    """All checks of a recording set."""

    format: Literal["calibench-validation"] = "calibench-validation"
    version: Literal[1] = 1
    source: str
    checks: tuple[Check, ...]
    skipped: tuple[Skipped, ...] = ()
    baseline: str | None = None  # names of the camera files that stood in for the fitted cameras


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


class ComparisonResult(Tabular, Frozen):
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


class ReportFile(Frozen):
    """A report: its path, relative to the data folder if it lies there, and the ids of the results that it shows, by
    kind."""

    path: str
    results: dict[str, str] = {}
