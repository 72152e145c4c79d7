"""The result of `calibench validate`: predicted against measured."""

from __future__ import annotations

from typing import Literal

from lab.formats.results.skipped import Skipped
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


class ValidationResult(Frozen):
    """All checks of a recording set."""

    format: Literal["calibench-validation"] = "calibench-validation"
    version: Literal[1] = 1
    source: str
    checks: tuple[Check, ...]
    skipped: tuple[Skipped, ...] = ()
    baseline: str | None = None  # names of the camera files that stood in for the fitted cameras
