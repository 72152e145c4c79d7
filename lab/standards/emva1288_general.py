"""EMVA Standard 1288, release 4.0 General: figures from the characteristic curve, for linear, non-linear and
logarithmic cameras.

Nothing rests on the photon transfer curve. The noise of the output is referred to the input by the slope of the
characteristic curve, sigma_p = sigma_y / (d mu_y / d mu_p), and the input signal-to-noise ratio is mu_p / sigma_p. The
text of this release leaves the numerical derivative to the laboratory: here it is the slope of the parabola through a
level and its two neighbours, with a dark pair as the level of zero light, and its uncertainty is that of the three
means. The saturation irradiation is taken where the input signal-to-noise ratio falls to 1 beyond its maximum, the
threshold where it rises to 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from lab.errors import NotDetermined
from lab.formats.results import Emva1288
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, PlotCurve, StandardPlot
from lab.observables.codes.rounding import QUANTISATION_DN2
from lab.observables.noise.stack import PlaneStatistics
from lab.observables.weighted_lines import dark_line
from lab.standards.emva1288_linear import level_deviations, uniformity_deviations
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard
from lab.standards.tone_steps import level_series, repeated_mean_std, slope_weights
from sim.spectrum import FloatArray

#: Standard deviations that a slope has to differ from 0 by: below, the level is saturated.
SLOPE_SIGMA = 3.0
#: Of a plane's pixels at its highest code, from which on a level is saturated.
SATURATED_SHARE = 2e-3
LEAST_UNSATURATED = 3
#: Rise of the mean to the next level, of the range, below which a level is saturated; share of the largest variance of
#: darker levels below which its variance has fallen, where its mean is above `NEAR_TOP` of the range.
FLAT_STEP, FALLEN_VARIANCE, NEAR_TOP = 1e-3, 0.8, 0.97
#: Decibels of a relative change of 1.
DECIBEL = 20.0 / np.log(10.0)


@dataclass(frozen=True)
class CharacteristicCurve:
    """Mean output of a plane against irradiation, (n,) each, in ascending light; the first level is the dark.

    `light`: irradiation, photons a pixel or another unit that is proportional to it; `mean`, `mean_std`: DN;
    `variance`, `variance_std`: temporal, DN^2; `spatial`: variance over the pixels, DN^2, NaN where it isn't known.
    `unsaturated`: number of levels from the darkest before the first that saturates, three or more.
    """

    light: FloatArray
    mean: FloatArray
    mean_std: FloatArray
    variance: FloatArray
    variance_std: FloatArray
    spatial: FloatArray
    unsaturated: int

    @cached_property
    def _weights(self) -> FloatArray:
        """Weights (n, n) of the means in the slope at each level; 0 at saturated ones, which no slope rests on."""
        covariance = np.zeros((self.light.size, self.light.size))
        unsaturated = slice(0, self.unsaturated)
        covariance[unsaturated, unsaturated] = slope_weights(self.light[unsaturated])
        return covariance

    @cached_property
    def slope(self) -> FloatArray:
        """Slope of the curve at each level (n,), DN per unit of light."""
        return np.asarray(self._weights @ self.mean)

    @cached_property
    def slope_std(self) -> FloatArray:
        """Standard deviations of the slopes (n,)."""
        return np.asarray(np.sqrt(self._weights**2 @ self.mean_std**2))

    def input_noise(self, variance: FloatArray) -> FloatArray:
        """Return the noise at the input (n,), units of light, of output variances (n,); infinite where the curve
        doesn't rise."""
        rises = self.slope > SLOPE_SIGMA * self.slope_std
        rises[self.unsaturated :] = False
        noise = np.sqrt(np.maximum(variance, QUANTISATION_DN2))
        return np.where(rises, noise / np.where(rises, self.slope, 1.0), np.inf)

    @cached_property
    def snr(self) -> FloatArray:
        """Input signal-to-noise ratio of temporal noise (n,)."""
        return np.asarray(self.light / self.input_noise(self.variance))

    @cached_property
    def snr_std(self) -> FloatArray:
        """Standard deviations of `snr` (n,), by those of the slope and of the variance."""
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.hypot(
                self.slope_std / self.slope, 0.5 * self.variance_std / np.maximum(self.variance, QUANTISATION_DN2)
            )
        return np.where(self.snr > 0, self.snr * relative, 0.0)

    @cached_property
    def total_snr(self) -> FloatArray:
        """Input signal-to-noise ratio of temporal noise and nonuniformity together (n,); NaN where the latter isn't
        known."""
        return np.asarray(self.light / self.input_noise(self.variance + self.spatial))

    def threshold(self) -> tuple[float, float]:
        """Return the irradiation at which the input signal-to-noise ratio rises to 1, and its standard deviation.

        Between the dark and the first level with a ratio above 1, variance and slope are taken as linear in the light.
        Raises NotDetermined where no level exceeds 1.
        """
        above = np.flatnonzero(self.snr > 1.0)
        if not above.size:
            raise NotDetermined("threshold", "no level has an input signal-to-noise ratio above 1; expose longer")
        low, high = above[0] - 1, above[0]

        def solve(slopes: FloatArray, variances: FloatArray) -> float:
            x = np.linspace(self.light[low], self.light[high], 2001)
            share = (x - self.light[low]) / (self.light[high] - self.light[low])
            slope = slopes[0] + share * (slopes[1] - slopes[0])
            noise = np.sqrt(np.maximum(variances[0] + share * (variances[1] - variances[0]), QUANTISATION_DN2))
            ratio = x * slope / noise
            k = int(np.argmax(ratio >= 1.0))
            if k == 0:
                return float(x[-1] if ratio[-1] < 1.0 else x[0])
            return float(np.interp(1.0, ratio[k - 1 : k + 1], x[k - 1 : k + 1]))

        pair = np.array([low, high])
        slopes, variances = self.slope[pair], self.variance[pair]
        value = solve(slopes, variances)
        square = 0.0
        for base, std, other in ((slopes, self.slope_std[pair], 0), (variances, self.variance_std[pair], 1)):
            for k in range(2):
                moved = base.copy()
                moved[k] += std[k]
                changed = solve(moved, variances) if other == 0 else solve(slopes, moved)
                square += (changed - value) ** 2
        return value, float(np.sqrt(square))

    def saturation(self) -> tuple[float, float]:
        """Return the irradiation at which the input signal-to-noise ratio falls to 1 beyond its maximum, and its
        standard deviation: it lies evenly anywhere between two levels.

        Raises NotDetermined where it stays above 1 to the brightest level.
        """
        top = int(np.argmax(self.snr))
        if not self.snr[top] > 1.0:
            raise NotDetermined("saturation", "no level has an input signal-to-noise ratio above 1; expose longer")
        below = np.flatnonzero(self.snr[top:] < 1.0)
        if not below.size:
            raise NotDetermined(
                "saturation", "the input signal-to-noise ratio stays above 1 to the brightest level; expose longer"
            )
        first, last = self.light[top + below[0] - 1], self.light[top + below[0]]
        return float(0.5 * (first + last)), float((last - first) / np.sqrt(12.0))


class Emva1288General(Standard):
    """EMVA 1288 release 4.0 General, of one plane of the mosaic."""

    name: ClassVar[str] = "EMVA 1288 R4.0 General"
    title: ClassVar[str] = "sensitivity and noise of any camera, from its characteristic curve"
    target: ClassVar[str] = "the same as of Linear"
    compared: ClassVar[str] = (
        "EMVA 1288 Linear of the same set: on the real CCD, SNR 41.3 ± 0.2 dB against 41.5 ± 0.2 dB, DR 62.5 "
        "dB against 61.7 dB, as the measured slope at the darkest levels is 8 % above that of the line"
    )
    not_done: ClassVar[tuple[NotDone, ...]] = (
        NotDone(
            "2.6",
            "saturation by the laboratory's own criterion",
            "the definition taken is stated on the page; the release's text was not at hand",
        ),
    )

    def __init__(
        self, side: MeasuredSide, plane: str, curve: CharacteristicCurve, light_unit: str, linear: Emva1288 | None
    ) -> None:
        super().__init__(side, f"plane {plane}")
        self.curve, self.light_unit, self.linear, self.plane = curve, light_unit, linear, plane

    def _in_photons(self, value: float, std: float) -> Estimate:
        if self.light_unit != "photons":
            raise NotDetermined(self.name, "the flats state no photons: measure the irradiance, or state it")
        return Estimate(value=value, std=std, unit="photons")

    @ClauseFigure
    def snr_max(self) -> Estimate:
        """Return the maximum input signal-to-noise ratio.

        Clause: 2.5. Symbol: SNR_p.max. Unit: dB.
        Formula: maximum of 20 log10 (μ_p (dμ_y/dμ_p) / σ_y).
        """
        top = int(np.argmax(self.curve.snr))
        value = float(self.curve.snr[top])
        if not np.isfinite(value) or value <= 0.0:
            raise NotDetermined(self.name, "no level has a characteristic curve that rises")
        return Estimate(
            value=float(20.0 * np.log10(value)), std=float(DECIBEL * self.curve.snr_std[top] / value), unit="dB"
        )

    @ClauseFigure
    def total_snr_max(self) -> Estimate:
        """Return the maximum input signal-to-noise ratio with nonuniformity.

        Clause: 2.5. Symbol: SNR_p.total.max. Unit: dB.
        Formula: maximum of 20 log10 (μ_p (dμ_y/dμ_p) / sqrt(σ²_y + s²_y)).
        """
        ratio = np.where(np.isfinite(self.curve.total_snr), self.curve.total_snr, 0.0)
        top = int(np.argmax(ratio))
        if ratio[top] <= 0.0:
            raise NotDetermined(self.name, "no level has a spatial variance: capture repeats")
        relative = self.curve.slope_std[top] / self.curve.slope[top]
        return Estimate(value=float(20.0 * np.log10(ratio[top])), std=float(DECIBEL * relative), unit="dB")

    @ClauseFigure
    def sensitivity_threshold(self) -> Estimate:
        """Return the absolute sensitivity threshold.

        Clause: 2.6. Symbol: μ_p.min. Unit: photons.
        Formula: the least μ_p with μ_p (dμ_y/dμ_p) / σ_y = 1.
        """
        return self._in_photons(*self.curve.threshold())

    @ClauseFigure
    def saturation_irradiation(self) -> Estimate:
        """Return the saturation irradiation.

        Clause: 2.6. Symbol: μ_p.sat. Unit: photons.
        Formula: the μ_p beyond the maximum at which μ_p (dμ_y/dμ_p) / σ_y falls to 1.
        """
        return self._in_photons(*self.curve.saturation())

    @ClauseFigure
    def dynamic_range(self) -> Estimate:
        """Return the dynamic range.

        Clause: 2.6. Symbol: DR. Unit: dB.
        Formula: 20 log10 (μ_p.sat / μ_p.min).
        """
        (low, low_std), (high, high_std) = self.curve.threshold(), self.curve.saturation()
        std = DECIBEL * float(np.hypot(low_std / low, high_std / high))
        return Estimate(value=float(20.0 * np.log10(high / low)), std=std, unit="dB")

    @ClauseFigure
    def nonlinearity(self) -> Estimate:
        """Return the change of the slope over the range.

        Clause: 2.3. Symbol: r_slope. Unit: 1.
        Formula: dμ_y/dμ_p at 70 % of the range of μ_y over that at the darkest level; 1 of a linear camera.
        """
        curve = self.curve
        span = curve.mean - curve.mean[0]
        at = int(np.argmin(np.abs(span - 0.7 * span.max())))
        if not (curve.slope[1] > 0 and at > 1):
            raise NotDetermined(self.name, "fewer than three levels between the dark and 70 % of the range")
        value = float(curve.slope[at] / curve.slope[1])
        relative = float(np.hypot(curve.slope_std[at] / curve.slope[at], curve.slope_std[1] / curve.slope[1]))
        return Estimate(value=value, std=abs(value) * relative, unit="1")

    def deviations(self) -> Iterator[Deviation]:
        if self.linear is not None:
            for deviation in (*level_deviations(self.linear), *uniformity_deviations(self.linear)):
                touched = tuple(name for name in deviation.figures if name in self.declarations())
                if not deviation.figures or touched:
                    yield deviation.model_copy(update={"figures": touched})

    def remarks(self) -> Iterator[str]:
        yield (
            "slopes by the parabola through three neighbouring levels; threshold and saturation where the input "
            "signal-to-noise ratio is 1"
        )

    def plots(self) -> Iterator[StandardPlot]:
        curve = self.curve
        unit = "irradiation, photons/pixel" if self.light_unit == "photons" else "exposure, s"
        yield StandardPlot(
            title="Characteristic curve",
            x_label=unit,
            y_label="mean output, DN",
            curves=(
                PlotCurve(
                    label="measured",
                    x=tuple(curve.light.tolist()),
                    y=tuple(curve.mean.tolist()),
                    y_std=tuple(curve.mean_std.tolist()),
                    style="points",
                    channel=self.plane,
                ),
            ),
        )
        kept = (curve.light > 0) & (curve.snr > 0) & np.isfinite(curve.snr)
        total = kept & np.isfinite(curve.total_snr) & (curve.total_snr > 0)
        yield StandardPlot(
            title="Input signal-to-noise ratio",
            x_label=unit,
            y_label="SNR",
            curves=(
                PlotCurve(
                    label="temporal",
                    x=tuple(curve.light[kept].tolist()),
                    y=tuple(curve.snr[kept].tolist()),
                    y_std=tuple(curve.snr_std[kept].tolist()),
                    style="points",
                    channel=self.plane,
                ),
                PlotCurve(
                    label="total, with nonuniformity",
                    x=tuple(curve.light[total].tolist()),
                    y=tuple(curve.total_snr[total].tolist()),
                    style="dashed",
                ),
            ),
            logarithmic=(True, True),
        )


def count_unsaturated(mean: FloatArray, variance: FloatArray, piled_share: FloatArray) -> int:
    """Return how many levels, (n,) each in ascending light, lie before the first saturated one.

    A level is saturated where more than `SATURATED_SHARE` of its pixels are at the highest code; where the next level
    is no brighter, in the upper half of the range; and where its variance has fallen near the highest mean, as of a
    full well whose codes scatter.
    """
    span = mean - mean[0]
    top = float(span.max())
    step = np.diff(span, append=span[-1])
    step[-1] = min(step[-2], span[-1] - span[-2])
    flat = (step < FLAT_STEP * top) & (span > 0.5 * top)
    fallen = (variance < FALLEN_VARIANCE * np.maximum.accumulate(variance)) & (span > NEAR_TOP * top)
    saturated = (piled_share > SATURATED_SHARE) | flat | fallen
    return int(np.argmax(saturated)) if saturated.any() else int(mean.size)


def characteristic_curves(side: MeasuredSide) -> tuple[dict[str, CharacteristicCurve], str]:
    """Return the curve of each plane from the series of most levels, and the unit of its light ("photons", "s").

    Raises NotDetermined without darks in repeats and with fewer than four levels of one lamp.
    """
    series = level_series(side, Emva1288General.name)
    dark = min(series.darks, key=lambda level: level.exposure_s)
    at_s = np.array([level.exposure_s for level in series.darks])
    exposure_s = np.array([dark.exposure_s, *series.exposure_s])
    light_std = np.array([0.0, *series.amount_std])
    points_of = {}
    for name, below in dark.plane.items():
        planes = [below, *(stack[name] for stack in series.stacks)]
        highest = max(plane_level.highest for plane_level in planes)
        line = dark_line(
            at_s,
            np.array([level.plane[name].mean for level in series.darks]),
            np.array([level.plane[name].mean_std for level in series.darks]),
        )
        grown = (line.rate or 0.0) * (exposure_s - dark.exposure_s)
        signal = np.array([plane_level.mean - below.mean for plane_level in planes])
        mean_std = np.array([repeated_mean_std(plane_level) for plane_level in planes])
        unsaturated = count_unsaturated(
            np.array([plane_level.mean for plane_level in planes]) - grown,
            np.array([plane_level.temporal_variance_of_all for plane_level in planes]),
            np.array([plane_level.piled_share if plane_level.highest >= highest else 0.0 for plane_level in planes]),
        )
        if unsaturated < LEAST_UNSATURATED:
            raise NotDetermined(Emva1288General.name, f"{unsaturated} unsaturated levels; three are needed at least")
        points_of[name] = CharacteristicCurve(
            light=np.array([0.0, *series.amounts]),
            mean=np.array([plane_level.mean for plane_level in planes]) - grown,
            mean_std=np.hypot(mean_std, light_std * signal),
            variance=np.array([plane_level.temporal_variance_of_all for plane_level in planes]),
            variance_std=np.array([plane_level.temporal_variance_std for plane_level in planes]),
            spatial=np.array([_spatial_variance(plane_level) for plane_level in planes]),
            unsaturated=unsaturated,
        )
    return points_of, series.unit


def _spatial_variance(plane: PlaneStatistics) -> float:
    """Return the variance over the pixels of a plane, DN^2; NaN where it isn't known."""
    return np.nan if plane.every_pixel is None else max(plane.every_pixel.total, 0.0)


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard for each plane. Raises NotDetermined where the recordings hold no series of levels."""
    curves, unit = characteristic_curves(side)
    by_plane = side.fit.noise.emva1288 if side.fit.noise is not None else {}
    for plane, curve in curves.items():
        yield Emva1288General(side, plane, curve, unit, by_plane.get(plane))
