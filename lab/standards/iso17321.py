"""ISO 17321-1: the sensitivity metamerism index (SMI) and the colour matrix, from measured spectral sensitivities or
from a chart.

Test colours, observer and colour differences are colour-science's. The matrix takes linear camera signals to
tristimulus values; it keeps white and has the least sum of squared CIELAB differences over the eighteen chromatic
patches. The index is 100 - 5.5 times their mean difference. The uncertainty is that of repeated draws of the
sensitivities, or of the chart's levels, with the tolerances of its patches.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from typing import ClassVar

import numpy as np
from scipy import optimize

from lab.capture_kinds.chart import ChartCapture
from lab.errors import NotDetermined
from lab.formats.results import SpectralFit
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation
from lab.observables.charts.patches import patch_covariance, patch_levels
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard
from sim.scene.colorchecker import reflectances
from sim.scene.light import colour_science
from sim.spectrum import FloatArray, Spectrum

#: Wavelengths of all sums, nm.
GRID_NM: FloatArray = np.arange(380.0, 781.0, 5.0)
CHROMATIC = 18
ILLUMINANT = "D55"
DRAWS = 60
#: Fixed, so that a set has one result.
SEED = 17321
CHANNELS = ("R", "G", "B")
COEFFICIENTS = tuple(f"{row}{column}" for row in "XYZ" for column in CHANNELS)


@cache
def _observer() -> FloatArray:
    """Colour matching functions (wavelengths, 3) of the CIE's observer of 1931 on `GRID_NM`."""
    observer = colour_science().MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    return np.stack([np.interp(GRID_NM, observer.wavelengths, observer.values[:, k]) for k in range(3)], axis=1)


@cache
def _test_colours() -> FloatArray:
    """Reflectances (24, wavelengths) of the ColorChecker that the standard prints."""
    patches = colour_science().SDS_COLOURCHECKERS["ISO 17321-1"]
    return np.stack([np.interp(GRID_NM, curve.wavelengths, curve.values) for curve in patches.values()])


def illuminant_power(name: str) -> FloatArray:
    """Return the relative power (wavelengths,) of one of the CIE's illuminants on `GRID_NM`."""
    curve = colour_science().SDS_ILLUMINANTS[name]
    return np.asarray(np.interp(GRID_NM, curve.wavelengths, curve.values))


@dataclass(frozen=True)
class Colorimetry:
    """Tristimulus values (patches, 3) of the test colours and of white (3,), white at Y = 1."""

    patches: FloatArray
    white: FloatArray

    @classmethod
    def under(cls, power: FloatArray, colours: FloatArray) -> Colorimetry:
        """Return those of reflectances `colours` (patches, wavelengths) under light of `power` (wavelengths,)."""
        weight = power[:, None] * _observer()
        scale = weight[:, 1].sum()
        return cls(colours @ weight / scale, weight.sum(axis=0) / scale)

    def lab(self, xyz: FloatArray) -> FloatArray:
        """Return CIELAB (n, 3) of tristimulus values (n, 3) under this white."""
        # by its formula: colour-science's own, which a test compares, takes 20 times as long in a search
        ratio = np.asarray(xyz) / self.white
        limit = 6.0 / 29.0
        root = np.where(ratio > limit**3, np.cbrt(np.maximum(ratio, limit**3)), ratio / (3.0 * limit**2) + 4.0 / 29.0)
        x, y, z = root.T
        return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=1)

    def differences(self, xyz: FloatArray) -> FloatArray:
        """Return the CIELAB differences (patches,) of tristimulus values from the test colours'."""
        return np.asarray(np.linalg.norm(self.lab(xyz) - self.lab(self.patches), axis=1))


@dataclass(frozen=True)
class ColourMatrix:
    """A matrix (3, 3) from camera signals, white-balanced to 1 on white, to tristimulus values; mean CIELAB difference
    over the chromatic patches."""

    matrix: FloatArray
    mean_difference: float

    @property
    def smi(self) -> float:
        """Sensitivity metamerism index."""
        return 100.0 - 5.5 * self.mean_difference


def fit_matrix(
    signals: FloatArray, white: FloatArray, truth: Colorimetry, start: FloatArray | None = None
) -> ColourMatrix:
    """Fit a matrix to camera signals (patches, 3) of the test colours; `white` (3,): of a perfect diffuser.

    Its rows are free but for white, which is kept. `start` (3, 3): where the search begins; None: at the least squares
    of tristimulus values.
    """
    balanced = signals / white
    used = slice(0, CHROMATIC)
    begin = np.linalg.lstsq(balanced[used], truth.patches[used], rcond=None)[0].T if start is None else start

    def matrix(free: FloatArray) -> FloatArray:
        first = free.reshape(3, 2)
        return np.column_stack([first, truth.white - first.sum(axis=1)])

    wanted = truth.lab(truth.patches[used])

    def residual(free: FloatArray) -> FloatArray:
        return np.asarray((truth.lab(balanced[used] @ matrix(free).T) - wanted).ravel())

    solution = optimize.least_squares(residual, begin[:, :2].ravel(), method="lm")
    best = matrix(solution.x)
    return ColourMatrix(best, float(truth.differences(balanced @ best.T)[used].mean()))


class Iso17321(Standard):
    """ISO 17321-1:2012 from measured spectral sensitivities (method A)."""

    name: ClassVar[str] = "ISO 17321-1:2012"
    title: ClassVar[str] = "colour characterisation: sensitivity metamerism index and colour matrix"
    target: ClassVar[str] = "narrowband light over 380 to 780 nm, or a ColorChecker in daylight"
    compared: ClassVar[str] = (
        "colour-science 0.4.7: test colours, observer, illuminants; CIELAB differences equal to 1e-9"
    )
    not_done: ClassVar[tuple[NotDone, ...]] = (NotDone("5.2", "sensitivities themselves", "of the spectral fit"),)

    def __init__(self, side: MeasuredSide, subject: str, fitted: ColourMatrix, drawn: list[ColourMatrix]) -> None:
        super().__init__(side, subject)
        self.fitted, self.drawn = fitted, drawn

    def _unbiased(self, name: str) -> Estimate:
        """Return a figure of the matrix less what noise adds to it: differences have no sign, so that the draws lie
        higher than what they are drawn about by as much as this lies above the truth."""
        fitted, drawn = getattr(self.fitted, name), np.array([getattr(draw, name) for draw in self.drawn])
        return Estimate(value=float(2.0 * fitted - drawn.mean()), std=float(drawn.std(ddof=1)), unit="1")

    @ClauseFigure
    def smi(self) -> Estimate:
        """Return the sensitivity metamerism index.

        Clause: Annex C. Symbol: SMI. Unit: 1.
        Formula: 100 − 5.5 times the mean CIELAB difference of the eighteen chromatic patches.
        """
        return Estimate(value=self.fitted.smi, std=float(np.std([draw.smi for draw in self.drawn], ddof=1)), unit="1")

    @ClauseFigure
    def mean_difference(self) -> Estimate:
        """Return the mean colour difference.

        Clause: Annex C. Symbol: ΔE*ab. Unit: 1.
        Formula: mean CIELAB difference of the eighteen chromatic patches after the matrix.
        """
        return self._unbiased("mean_difference")

    @ClauseFigure
    def green_to_luminance(self) -> Estimate:
        """Return the coefficient from white-balanced green to luminance.

        Clause: Annex C. Symbol: M(Y, G). Unit: 1.
        Formula: middle element of the matrix of least sum of squared CIELAB differences that keeps white.
        """
        std = float(np.std([draw.matrix[1, 1] for draw in self.drawn], ddof=1))
        return Estimate(value=float(self.fitted.matrix[1, 1]), std=std, unit="1")

    @cached_property
    def matrix_std(self) -> FloatArray:
        """Standard deviations (3, 3) of the matrix."""
        return np.std([draw.matrix for draw in self.drawn], axis=0, ddof=1)

    def remarks(self) -> Iterator[str]:
        rows = (
            f"{name} = "
            + " ".join(
                f"{value:+.4f}±{std:.4f} {channel}" for value, std, channel in zip(row, stds, CHANNELS, strict=True)
            )
            for name, row, stds in zip("XYZ", self.fitted.matrix, self.matrix_std, strict=True)
        )
        yield "colour matrix of signals that are 1 on a perfect diffuser: " + "; ".join(rows)


class Iso17321FromCurves(Iso17321):
    """ISO 17321-1:2012 from measured spectral sensitivities (method A)."""

    def conditions(self) -> Iterator[str]:
        yield f"measured spectral sensitivities, illuminant {ILLUMINANT}, the standard's test colours"

    def deviations(self) -> Iterator[Deviation]:
        spectral = self.measured.fit.spectral
        assert spectral is not None
        low, high = spectral.wavelength_nm[0], spectral.wavelength_nm[-1]
        if low > 400.0 or high < 700.0:
            yield Deviation(
                clause="5.2",
                quantity="wavelengths of the sensitivities",
                found=f"{low:g} to {high:g} nm",
                limit="380 to 780 nm, 400 to 700 nm at least",
                remedy="capture more narrowband light",
            )


class Iso17321FromChart(Iso17321):
    """ISO 17321-1:2012 from a chart (method B): the differences include the chart's own tolerances."""

    def conditions(self) -> Iterator[str]:
        yield "a ColorChecker in the measured light of its capture; tolerances of its patches in the uncertainty"

    def deviations(self) -> Iterator[Deviation]:
        yield Deviation(
            clause="6.1",
            quantity="light on the chart",
            found="the light of the recordings, as measured",
            limit="daylight or studio tungsten of ISO 7589",
            remedy="light the chart by one of these, or take the index from measured sensitivities",
        )


def from_curves(spectral: SpectralFit) -> tuple[ColourMatrix, list[ColourMatrix]]:
    """Return the matrix of measured sensitivities, and those of draws from their uncertainties. Raises NotDetermined
    where one of R, G and B isn't there."""
    curves = spectral.quantum_efficiency or spectral.relative_sensitivity
    stds = spectral.quantum_efficiency_std or spectral.relative_sensitivity_std
    if not set(CHANNELS) <= set(curves):
        raise NotDetermined(Iso17321.name, "no sensitivities of R, G and B; capture narrowband light")
    wave = np.array(spectral.wavelength_nm)
    value = np.stack([np.array(curves[c]) for c in CHANNELS])
    std = np.stack([np.array(stds[c]) for c in CHANNELS])
    power = illuminant_power(ILLUMINANT)
    truth = Colorimetry.under(power, _test_colours())
    weight = power * GRID_NM  # sensitivities are per photon

    def signals(curves: FloatArray) -> tuple[FloatArray, FloatArray]:
        on_grid = np.stack([np.interp(GRID_NM, wave, curve, left=0.0, right=0.0) for curve in curves]) * weight
        return _test_colours() @ on_grid.T, on_grid.sum(axis=1)

    fitted = fit_matrix(*signals(value), truth)
    rng = np.random.default_rng(SEED)
    drawn = [fit_matrix(*signals(value + std * rng.standard_normal(value.shape)), truth) for _ in range(DRAWS)]
    return fitted, drawn


def from_chart(side: MeasuredSide) -> tuple[ColourMatrix, list[ColourMatrix]]:
    """Return the matrix of a chart's levels, and those of draws from their covariance. Raises NotDetermined without a
    whole unclipped ColorChecker of three channels."""
    data = side.dataset
    charts = side.recordings.captures(ChartCapture, side.side)
    points = [p for p in patch_levels(data) if charts and p.captures[0].radiance == charts[0].radiance]
    names = list(reflectances("ColorChecker24"))
    first = [p for p in points if not p.held_out]
    if len(first) != len(names) * len(CHANNELS):
        raise NotDetermined(
            Iso17321.name,
            f"{len(first)} unclipped patches and channels of {len(names) * len(CHANNELS)}; capture a ColorChecker, "
            "exposed for its white patch",
        )
    offset = data.noise.black + data.noise.dark_dn_per_s * first[0].captures[0].exposure_s
    level = np.array([p.level for p in first]) - offset
    covariance = patch_covariance(data, first, np.maximum(level, 0.1))
    place = {(p.name, p.channel): k for k, p in enumerate(first)}
    order = np.array([[place[name, channel] for channel in CHANNELS] for name in names])
    light: Spectrum = side.recordings.spectrum(first[0].captures[0].radiance)
    patches = reflectances("ColorChecker24")
    truth = Colorimetry.under(light.at(GRID_NM), np.stack([patches[name].at(GRID_NM) for name in names]))
    # the white patch stands for a perfect diffuser of its reflectance
    white_share = truth.patches[CHROMATIC] / truth.white

    def fit(values: FloatArray, start: FloatArray | None = None) -> ColourMatrix:
        signals = values[order]
        return fit_matrix(signals, signals[CHROMATIC] / float(white_share[1]), truth, start)

    rng = np.random.default_rng(SEED)
    factor = np.linalg.cholesky(covariance + 1e-12 * np.trace(covariance) * np.eye(len(level)))
    fitted = fit(level)
    drawn = [fit(level + factor @ rng.standard_normal(len(level)), fitted.matrix) for _ in range(DRAWS)]
    return fitted, drawn


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard from sensitivities and from a chart, whichever there are. Raises NotDetermined without
    both."""
    if side.camera.cfa == "MONO":
        raise NotDetermined(Iso17321.name, "a monochrome camera has no colour matrix")
    reasons = []
    if side.fit.spectral is None:
        reasons.append("no spectral sensitivities; capture narrowband light")
    else:
        yield Iso17321FromCurves(side, "from spectral sensitivities", *from_curves(side.fit.spectral))
    try:
        yield Iso17321FromChart(side, "from a ColorChecker", *from_chart(side))
    except NotDetermined as refused:
        reasons.append(refused.reason)
    if len(reasons) > 1:
        raise NotDetermined(Iso17321.name, "; ".join(reasons))
