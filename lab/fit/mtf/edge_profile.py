"""The edge profile: weighted least squares of the spline and the illumination, noise levels, and regions that are
refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.fit.mtf.edge_curve import EdgeCurve, angle_from_vertical_deg
from lab.fit.mtf.edge_finding import angle_std_deg
from lab.fit.mtf.line_spread_prior import KNOT_SPACING_PX, LOG_LIKELIHOOD_RANGE, LineSpreadPriors, posterior
from lab.fit.mtf.samples import Plane, Samples, illumination_gradients, levelled
from lab.fit.mtf.spline import SortedSamples, Spline
from lab.fit.mtf.transfer_function import EdgeGeometry, EdgeMtf, edge_result
from lab.fit.rounding import rounding_std_dn, rounding_waves_dn, unrounded

Array = NDArray[np.floating[Any]]

CORE_PX, CORE_WIDTHS = 2.5, 3.0  # half-width of the evenly spaced knots: CORE_PX + CORE_WIDTHS blur widths
TAIL_GROWTH = 1.6  # ratio of neighbouring knot spacings beyond: the tail is smooth
TAIL_REACH_PX = 9.0
OUTER_ZONE_PX = 36.0  # beyond: levels, amplitude of the tail, gradient of the illumination
FAR_PX = 150.0  # last knot; without samples there, the prior extrapolates
ROUGHNESS_SHARE = 1e-6  # of the mean diagonal: bridges knots without samples; changes 1 cy/px by 1e-4
PASSES = 3  # of the least squares: noise levels and gradients depend on the profile
STD_FLOOR = 1e-6  # of the contrast: noise-free regions have finite weights
WIDEST_RISE = 0.65  # from 10 % to 90 %, of the reach on either side


@dataclass(frozen=True)
class Quantisation:
    """Values that were rounded to multiples of `size` (in their unit; 0: not rounded), then averaged over `frames`."""

    size: float
    frames: int

    def with_rounding(self, std: float) -> float:
        """Standard deviation of the mean of rounded values, from the one before rounding."""
        if not self.size:
            return std
        return float(np.hypot(std, self.size * rounding_std_dn(self.frames * (std / self.size) ** 2)))

    def covariance(self, geometry: EdgeGeometry, level: Array, variance: Array) -> Array:
        """Covariance (k, k) of the spline coefficients by rounding errors, which repeats don't average out.

        `level`, `variance` (n,): mean and temporal variance of the values at the samples.
        """
        out = np.zeros((geometry.spline.size,) * 2)
        if self.size:
            spread = unrounded(np.asarray(self.frames * variance / self.size**2, float))
            for wave in rounding_waves_dn(np.asarray(level / self.size, float), spread):
                change = self.size * geometry.coefficients(wave)
                out += np.outer(change, change)
        return out


def measured_mtf(
    planes: Sequence[Plane],
    near: Samples,
    edge: EdgeCurve,
    reach: float,
    frequency: Array,
    noise_std: float | None,
    quantisation: Quantisation,
) -> EdgeMtf:
    """MTF of an edge that has been found.

    `near`: samples close to the edge; `reach`: usable distance, px; `frequency`: cy/px; `noise_std`: of the values, or
    None to take it from the residuals on both sides.
    """
    distance, _, _ = edge.distance(near.along, near.across)
    width = _blur_width_px(near, distance, min(12.0, reach))
    core = CORE_PX + CORE_WIDTHS * width
    outer = min(reach, core + TAIL_REACH_PX + OUTER_ZONE_PX)
    room = outer > core + TAIL_REACH_PX + 8.0 * near.step
    samples = Samples.near(planes, edge, 1.05 * outer + 2.0)
    distance, foot, _ = edge.distance(samples.along, samples.across)
    kept = np.abs(distance) < outer
    samples, distance, foot = samples.where(kept), distance[kept], foot[kept]
    inner = min(0.6 * outer, core + TAIL_REACH_PX)
    value, dark_level, light_level = levelled(samples, distance, inner, outer)
    contrast = light_level - dark_level
    offset = max(dark_level, 0.0) / contrast  # the gradient multiplies the dark level, too

    spline = Spline(_knots_px(core, reach, near.step))
    size = spline.size
    placed = SortedSamples.of(spline, distance)
    distance, foot, value = distance[placed.order], foot[placed.order], value[placed.order]
    dark_tail, light_tail = distance < -0.5 * inner, distance > 0.5 * inner
    variance = np.ones_like(value)
    used = np.ones(len(value), dtype=bool)
    esf = np.clip(0.5 + distance, 0.0, 1.0)
    start, solution = (1, 1, 3, 0), np.zeros(size)
    for pass_number in range(PASSES):
        weight = np.where(used, 1.0 / variance, 0.0)
        gradients = illumination_gradients(distance, foot * edge.half_length, esf + offset, room)
        gram = placed.gram(np.concatenate([gradients, value[None]]), weight)
        matrix, right = gram[:-1, :-1], gram[:-1, -1]
        if pass_number == 0:
            bridged = matrix.copy()
            bridged[:size, :size] += spline.roughness(ROUGHNESS_SHARE * np.trace(matrix[:size, :size]) / size)
            inverse = np.linalg.inv(bridged)
        else:
            priors = LineSpreadPriors.of(spline, solution[:size], width, outer)
            inverse, covariance, start = posterior(
                priors, matrix, right, start, LOG_LIKELIHOOD_RANGE if pass_number == PASSES - 1 else 0.0
            )
        solution = inverse @ right
        esf = placed.values(solution[:size])
        residual = value - esf - solution[size:] @ gradients
        if noise_std is None:
            std_dark, std_light = (
                quantisation.with_rounding(contrast * _robust_std(residual[tail], quantisation.size / contrast))
                / contrast
                for tail in (dark_tail, light_tail)
            )
        else:
            std_dark = std_light = noise_std / contrast
        variance = std_dark**2 + np.clip(esf, 0.0, 1.0) * (std_light**2 - std_dark**2) + STD_FLOOR**2
        used = np.abs(residual) < 6.0 * np.sqrt(variance) + 0.02
    _refuse_unless_one_edge(residual, dark_tail | light_tail, max(std_dark, std_light), float(np.mean(~used)))
    _refuse_too_wide(spline, solution[:size], outer)
    _refuse_clipped(samples.value[placed.order][light_tail], std_dark * contrast, contrast)

    geometry = EdgeGeometry(
        angle_deg=angle_from_vertical_deg(edge.tilt, edge.transposed),
        angle_deg_std=angle_std_deg(placed.derivatives(solution[:size]), distance, foot, variance, gradients, edge),
        transposed=edge.transposed,
        edge_px=tuple(float(c) for c in edge.poly),
        centre_px=edge.centre,
        half_length_px=edge.half_length,
        distance_px=distance,
        weight=weight,
        spline=spline,
        gradients=gradients,
        inverse=inverse,
        gram=gram,
    )
    covariance[:size, :size] += (
        quantisation.covariance(geometry, (esf + offset) * contrast, variance * contrast**2) / contrast**2
    )
    freedom = max(np.count_nonzero(used) - len(solution) - len(edge.poly), 1)
    return edge_result(
        geometry,
        solution[:size],
        covariance[:size, :size],
        frequency,
        levels=(dark_level, light_level),
        noise=(std_dark * contrast, std_light * contrast),
        chi2=float((weight * residual**2).sum() / freedom),
    )


def _knots_px(width: float, reach: float, step: int) -> Array:
    """Knots: evenly spaced within `width` of the edge, then ever wider apart up to `FAR_PX`."""
    core = min(width, max(reach - 2.0 * step, 2.0))
    count = max(int(np.ceil(core / KNOT_SPACING_PX)), 6)
    side = list(np.arange(count + 1) * KNOT_SPACING_PX)
    spacing = KNOT_SPACING_PX
    while side[-1] < FAR_PX:
        spacing *= TAIL_GROWTH
        side.append(side[-1] + spacing)
    positive = np.array(side)
    return np.concatenate([-positive[:0:-1], positive])


def _blur_width_px(samples: Samples, distance: Array, reach: float) -> float:
    """Standard deviation of the Gaussian with the 10 % to 90 % distance of the profile, px."""
    kept = np.abs(distance) < reach
    value, _, _ = levelled(samples.where(kept), distance[kept], 0.75 * reach, reach)
    count = max(int(reach / 0.5), 4)
    spline = Spline(np.arange(-count, count + 1) * reach / count)
    placed = SortedSamples.of(spline, distance[kept])
    gram = placed.gram(value[placed.order][None])
    matrix = gram[:-1, :-1]
    coefficients = np.linalg.solve(matrix + spline.roughness(1e-3 * np.trace(matrix) / spline.size), gram[:-1, -1])
    fine = np.linspace(-reach, reach, 16 * count + 1)
    esf = spline.values(coefficients, fine)
    low, high = fine[esf < 0.1], fine[esf > 0.9]
    first = low[low < 0].max(initial=-reach)
    last = high[high > 0].min(initial=reach)
    return float(np.clip((last - first) / 2.563, 0.2, reach / 3.0))


def _robust_std(residual: Array, code: float = 0.0) -> float:
    """Standard deviation without outliers: 1.4826 times the median modulus, then the rms of what is within 4 of it.

    `code`: step of the rounded values. Most of them may be equal, and the next code is no outlier: the first estimate
    is at least code / 2.
    """
    rough = max(1.4826 * float(np.median(np.abs(residual))), 0.5 * code)
    kept = residual[np.abs(residual) <= 4.0 * rough + 1e-12]
    return float(np.sqrt(np.mean(kept**2)))


def _refuse_unless_one_edge(residual: Array, tail: NDArray[np.bool_], std: float, outliers: float) -> None:
    """Raise `NotDetermined` where the noise exceeds the contrast, or the tails are not flat."""
    if std > 1.0:
        raise NotDetermined("mtf", f"no edge in the region: the contrast is only {1.0 / std:.2f} of the noise")
    spread = float(np.sqrt(np.mean(residual[tail] ** 2)))
    local = _robust_std(np.diff(residual[tail])) / np.sqrt(2.0)
    if spread > max(0.12, 3.0 * local) or outliers > 0.03:
        raise NotDetermined("mtf", "the region holds more than one edge: narrow it down to a single one")


def _refuse_too_wide(spline: Spline, coefficients: Array, reach: float) -> None:
    """Raise `NotDetermined` where the profile hardly reaches its levels within the region."""
    at = np.linspace(-reach, reach, 201)
    esf = spline.values(coefficients, at)
    rise = float(np.count_nonzero((esf > 0.1) & (esf < 0.9)) * (at[1] - at[0]))
    if rise > WIDEST_RISE * reach:
        raise NotDetermined(
            "mtf",
            f"the edge takes {rise:.0f} px from 10 % to 90 %, with only {reach:.0f} px beside it: widen the region",
        )


def _refuse_clipped(light: Array, noise_std: float, contrast: float) -> None:
    """Raise `NotDetermined` where much of the light side is at its highest value although there is noise."""
    values = np.unique(light)
    step = float(np.diff(values).min()) if len(values) > 1 else 0.0
    if noise_std > max(0.7 * step, 1e-4 * contrast) and float(np.mean(light == values[-1])) > 0.2:
        raise NotDetermined("mtf", f"the edge's light side is clipped at {values[-1]:g}: expose it shorter")
