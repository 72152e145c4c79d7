"""The MTF of an edge: the edge profile, its transfer function, and `edge_mtf`, the whole estimator on a region.

The profile is fitted by weighted least squares of the spline and the illumination (`measure_mtf`), in passes, since
the noise levels and the gradients depend on it. The transfer function is that of the spline, with its covariance, and
the frequencies at which it falls to 50 % and 10 % (`edge_result`). Regions that can't be used are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.interpolate import CubicSpline

from lab.errors import NotDetermined
from lab.observables.codes.rounding import rounding_std_dn, rounding_waves_dn, variance_before_rounding
from lab.observables.edges.finding import (
    EdgeCurve,
    Plane,
    Samples,
    angle_from_vertical_deg,
    angle_std_deg,
    first_line,
    half_way_px,
    illumination_gradients,
    level_planes,
    refine_edge,
    refuse_unusable,
    usable_reach_px,
    widest_gap_px,
)
from lab.observables.edges.spread import (
    KNOT_SPACING_PX,
    LOG_LIKELIHOOD_RANGE,
    LineSpreadPriors,
    SortedSamples,
    Spline,
    posterior,
)
from lab.one_blas_thread import one_blas_thread

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

WIDEST_GAP_PX = 1.02  # between the distances of the samples from the edge
DEFAULT_FREQUENCY_CY_PER_PX: Array = np.arange(101) / 100.0


@dataclass(frozen=True)
class EdgeGeometry:
    """The linear operator of the estimator: where the samples lie with respect to the edge, and their weights.

    With n samples, k spline coefficients and g gradients of the illumination:

    `edge_px`: coefficients of the edge, a polynomial in (along - centre) / half_length, in px of the full sensor,
    lowest power first. `transposed`: the polynomial gives the row, else the column. `distance_px` (n,): signed
    distance of the samples from the edge, positive on the light side. `weight` (n,): inverse variance of the
    normalised values. `spline`: basis of the ESF. `gradients` (g, n): columns of the gradients of the illumination.
    `inverse` (k + g, k + g): inverse of the normal matrix with its prior, which takes A^T W values to the solution.
    `gram` (k + g + 1, k + g + 1): A^T W A, where A holds the columns of the spline, the gradients and the values.
    """

    angle_deg: float
    angle_deg_std: float
    transposed: bool
    edge_px: tuple[float, ...]
    centre_px: tuple[float, float]
    half_length_px: float
    distance_px: Array
    weight: Array
    spline: Spline
    gradients: Array
    inverse: Array
    gram: Array

    @property
    def reach_px(self) -> float:
        """Return the largest distance of a sample from the edge, px."""
        return float(np.abs(self.distance_px).max())

    @cached_property
    def basis(self) -> sparse.csr_array:
        """Return the basis functions of the spline at the samples, (n, k)."""
        return self.spline.design(self.distance_px)

    def coefficients(self, values: Array) -> Array:
        """Return the coefficients (k,) of the ESF that the estimator finds for `values` (n,) at the samples."""
        weighted = values * self.weight
        right = np.concatenate([self.basis.T @ weighted, self.gradients @ weighted])
        return np.asarray(self.inverse @ right)[: self.basis.shape[1]]

    def optical_transfer(self, coefficients: Array, frequency_cy_per_px: Array) -> NDArray[np.complex128]:
        """Return the complex transfer function (frequencies,) of an ESF with these coefficients: 1 at frequency 0,
        phase about the edge.
        """
        step = coefficients[-1] - coefficients[0]
        return np.asarray(self.spline.transfer_operator(frequency_cy_per_px) @ coefficients / step)

    def predict(self, profile: Callable[[Array], Array], frequency_cy_per_px: ArrayLike) -> Array:
        """Predict the MTF (frequencies,) that the estimator reports, at this very geometry, for a noise-free edge
        profile.

        `profile(distance_px)` gives the ESF at signed distances from the edge, rising towards positive distances, with
        any two levels and any shift: the edge is put where the profile is half way. It is called once, on an even grid
        of 0.05 px.
        """
        reach = self.reach_px + 0.1
        count = int(np.ceil(reach / 0.05))
        grid = np.arange(-count, count + 1) * 0.05
        values = np.asarray(profile(grid), dtype=float)
        middle = half_way_px(grid, (values - values[0]) / (values[-1] - values[0]))
        sampled = _cubic_interpolation(grid, values, self.distance_px + middle)
        otf = self.optical_transfer(self.coefficients(sampled), np.asarray(frequency_cy_per_px, dtype=float))
        return np.abs(otf)


def _cubic_interpolation(grid: Array, values: Array, at: Array) -> Array:
    """Interpolate `values` on the even `grid` at the places `at` (Catmull-Rom): the error is of fourth order in the
    spacing.
    """
    step = grid[1] - grid[0]
    position = np.clip((at - grid[0]) / step, 1.0, len(grid) - 2.001)
    i = position.astype(np.int64)
    t = position - i
    a, b, c, d = values[i - 1], values[i], values[i + 1], values[i + 2 - (i + 2 >= len(grid))]
    return np.asarray(b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))))


@dataclass(frozen=True)
class EdgeMtf:
    """The result of one edge in one channel.

    `mtf` (frequencies,): modulus with the contribution of the noise taken out, and `mtf_std`, `covariance`
    (frequencies, frequencies) of it. `otf`: the complex transfer function as estimated, phase about the edge. `esf` (0
    dark, 1 light) and `lsf`, its derivative per px, at `distance_px`. `dark_level`, `light_level` and the standard
    deviations `noise_std_dark`, `noise_std_light` are in the unit of the region. `residual_chi2_per_sample` is near 1
    where edge, spline and noise explain the region.
    """

    frequency_cy_per_px: Array
    mtf: Array
    mtf_std: Array
    covariance: Array
    otf: NDArray[np.complex128]
    mtf50_cy_per_px: float | None
    mtf50_cy_per_px_std: float | None
    mtf10_cy_per_px: float | None
    mtf10_cy_per_px_std: float | None
    angle_deg: float
    angle_deg_std: float
    distance_px: Array
    esf: Array
    lsf: Array
    dark_level: float
    light_level: float
    noise_std_dark: float
    noise_std_light: float
    residual_chi2_per_sample: float
    geometry: EdgeGeometry

    def predict(self, profile: Callable[[Array], Array]) -> Array:
        """Predict the MTF at `frequency_cy_per_px` that this estimator reports for an edge profile; see
        `EdgeGeometry.predict`.
        """
        return self.geometry.predict(profile, self.frequency_cy_per_px)


def edge_result(
    geometry: EdgeGeometry,
    esf: Array,
    covariance_of_esf: Array,
    frequency: Array,
    *,
    levels: tuple[float, float],
    noise: tuple[float, float],
    chi2: float,
) -> EdgeMtf:
    """Derive the transfer function, its covariance, MTF50 and MTF10 from the coefficients `esf` (k,) and their
    covariance (k, k).

    `levels`, `noise`: (dark, light), in the unit of the region; `chi2`: of the residual per degree of freedom.
    """
    spline = geometry.spline
    otf, jacobian = transfer_and_jacobian(geometry, esf, frequency)
    modulus = np.abs(otf)
    phase = np.where(modulus > 0, otf / np.maximum(modulus, 1e-300), 1.0)
    rotated = jacobian * phase.conj()[:, None]
    along_jacobian, across_jacobian = rotated.real, rotated.imag
    covariance = along_jacobian @ covariance_of_esf @ along_jacobian.T
    across_variance = np.einsum("fi,fi->f", across_jacobian @ covariance_of_esf, across_jacobian)
    along_variance = np.clip(np.diag(covariance), 0.0, None)
    # Noise n adds to the power: E|F + n|^2 = |F|^2 + var. Its part across F does so everywhere, its part along F only
    # where |F| is small.
    power = modulus**2
    excess = across_variance + along_variance**2 / np.maximum(along_variance + power, 1e-300)
    # The last term, of fourth order where |F| is large, takes out the floor that is left where it is small
    mtf = np.sqrt(np.clip(power - excess - excess**2 / np.maximum(power, 1e-300), 0.0, None))

    (mtf50, mtf50_std), (mtf10, mtf10_std) = _falling_frequencies(geometry, esf, covariance_of_esf, (0.5, 0.1))
    step = esf[-1] - esf[0]
    count = int(geometry.reach_px / 0.125)
    distance = np.arange(-count, count + 1) * 0.125
    return EdgeMtf(
        frequency_cy_per_px=frequency,
        mtf=mtf,
        mtf_std=np.sqrt(along_variance),
        covariance=covariance,
        otf=otf,
        mtf50_cy_per_px=mtf50,
        mtf50_cy_per_px_std=mtf50_std,
        mtf10_cy_per_px=mtf10,
        mtf10_cy_per_px_std=mtf10_std,
        angle_deg=geometry.angle_deg,
        angle_deg_std=geometry.angle_deg_std,
        distance_px=distance,
        esf=(spline.values(esf, distance) - esf[0]) / step,
        lsf=spline.derivative(esf, distance) / step,
        dark_level=levels[0],
        light_level=levels[1],
        noise_std_dark=noise[0],
        noise_std_light=noise[1],
        residual_chi2_per_sample=chi2,
        geometry=geometry,
    )


def transfer_and_jacobian(
    geometry: EdgeGeometry, esf: Array, frequency: Array
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the transfer function F (frequencies,) and its Jacobian dF/d(esf) (frequencies, k).

    F = T esf / (esf[-1] - esf[0]), T the transfer operator of the spline.
    """
    operator = geometry.spline.transfer_operator(frequency)
    step = esf[-1] - esf[0]
    otf = np.asarray(operator @ esf / step)
    jacobian = operator / step
    jacobian[:, -1] -= otf / step
    jacobian[:, 0] += otf / step
    return otf, jacobian


def _falling_frequencies(
    geometry: EdgeGeometry, esf: Array, covariance: Array, levels: Sequence[float]
) -> list[tuple[float | None, float | None]]:
    """Find the first frequency at which the MTF falls to each level, and its standard deviation, cy/px.

    None where it doesn't fall so far up to 1.5 cy/px, or where the standard deviation of the MTF there is above 0.3 of
    the level.
    """
    grid = 1.5 * (np.arange(2, 81) / 80.0) ** 2
    mtf = np.abs(geometry.optical_transfer(esf, grid))
    # The first frequency of the grid below each level; 0 where there is none
    first = [int(np.argmax(mtf < level)) for level in levels]
    spans = np.array([np.linspace(grid[k - 1], grid[k], 9) for k in first if k])
    if not len(spans):
        return [(None, None) for _ in levels]
    curves = np.abs(geometry.optical_transfer(esf, spans.ravel())).reshape(spans.shape)
    fallen = [level for level, k in zip(levels, first, strict=True) if k]
    # Between the points of the grid: a cubic spline through nine
    splines = [CubicSpline(span, curve - level) for span, curve, level in zip(spans, curves, fallen, strict=True)]
    crossings = np.array([float(f.roots(extrapolate=False)[0]) for f in splines])
    otf, jacobian = transfer_and_jacobian(geometry, esf, crossings)
    by_esf = (jacobian * (otf.conj() / np.abs(otf))[:, None]).real
    stds = np.sqrt(np.einsum("fi,fi->f", by_esf @ covariance, by_esf))
    found = {
        level: (float(at), float(std / abs(f(at, 1))))
        for level, at, std, f in zip(fallen, crossings, stds, splines, strict=True)
        if std < 0.3 * level
    }
    return [found.get(level, (None, None)) for level in levels]


@dataclass(frozen=True)
class Quantisation:
    """Values that were rounded to multiples of `size` (in their unit; 0: not rounded), then averaged over `frames`."""

    size: float
    frames: int

    def with_rounding(self, std: float) -> float:
        """Return the standard deviation of the mean of rounded values, from the one before rounding."""
        if not self.size:
            return std
        return float(np.hypot(std, self.size * rounding_std_dn(self.frames * (std / self.size) ** 2)))

    def covariance(self, geometry: EdgeGeometry, level: Array, variance: Array) -> Array:
        """Return the covariance (k, k) of the spline coefficients by rounding errors, which repeats don't average out.

        `level`, `variance` (n,): mean and temporal variance of the values at the samples.
        """
        out = np.zeros((geometry.spline.size,) * 2)
        if self.size:
            spread = variance_before_rounding(np.asarray(self.frames * variance / self.size**2, float))
            for wave in rounding_waves_dn(np.asarray(level / self.size, float), spread):
                change = self.size * geometry.coefficients(wave)
                out += np.outer(change, change)
        return out


def measure_mtf(
    planes: Sequence[Plane],
    near: Samples,
    edge: EdgeCurve,
    reach: float,
    frequency: Array,
    noise_std: float | None,
    quantisation: Quantisation,
) -> EdgeMtf:
    """Measure the MTF of an edge that has been found.

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
    value, dark_level, light_level = level_planes(samples, distance, inner, outer)
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
    """Place the knots: evenly spaced within `width` of the edge, then ever wider apart up to `FAR_PX`.

    `reach` of the samples, px; `step`: their pitch, px.
    """
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
    """Return the standard deviation of the Gaussian with the 10 % to 90 % distance of the profile, px."""
    kept = np.abs(distance) < reach
    value, _, _ = level_planes(samples.where(kept), distance[kept], 0.75 * reach, reach)
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
    """Return the standard deviation without outliers: 1.4826 times the median modulus, then the rms of what is within 4
    of it.

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


def edge_mtf(
    region: ArrayLike, frequency_cy_per_px: ArrayLike | None = None, noise_std: float | None = None
) -> EdgeMtf:
    """Estimate the MTF of a linear region (rows, cols) that holds one straight or gently bent edge at any angle.

    `frequency_cy_per_px` (frequencies,) defaults to 0..1 by 0.01. `noise_std`, in the unit of the region, is estimated
    from the residuals on both sides of the edge where it isn't given. The angle is from the vertical, -90 to 90 deg,
    positive where the top of the edge turns to the right. Raises `NotDetermined` where there is no single edge,
    ValueError for frequencies or a `noise_std` that are not usable. The method: `lab.fit.mtf`.
    """
    values = np.asarray(region, dtype=float)
    if values.ndim != 2:
        raise NotDetermined("mtf", f"a region has two dimensions, this one has {values.ndim}")
    return planes_mtf([Plane(values)], frequency_cy_per_px, noise_std)


@one_blas_thread
def planes_mtf(
    planes: Sequence[Plane],
    frequency_cy_per_px: ArrayLike | None = None,
    noise_std: float | None = None,
    code: float = 0.0,
    frames: int = 1,
) -> EdgeMtf:
    """Estimate the MTF as `edge_mtf`, from one or more planes that see the same edge with the same blur (the two green
    ones).

    Each plane is levelled by itself, so that unequal gains don't matter. `code`: the values were rounded to multiples
    of it (0: not at all) before a mean of `frames` was taken; where the noise is below the step, the error of rounding
    is part of the uncertainty.
    """
    frequency = (
        DEFAULT_FREQUENCY_CY_PER_PX if frequency_cy_per_px is None else np.asarray(frequency_cy_per_px, dtype=float)
    )
    if frequency.ndim != 1 or not np.isfinite(frequency).all() or (frequency < 0.0).any():
        raise ValueError("frequency_cy_per_px must be a list of finite frequencies that aren't negative")
    if noise_std is not None and not 0.0 < noise_std < np.inf:
        raise ValueError(f"noise_std = {noise_std} must be positive and finite; without it the residual says it")
    refuse_unusable(planes)
    edge = first_line(planes[0])
    widest = usable_reach_px(planes, edge)
    near = Samples.near(planes, edge, min(max(16.0, 3.0 * planes[0].step), widest) + 8.0)
    edge = refine_edge(near, edge, widest)
    gap = widest_gap_px(near, edge, np.ones(len(near.value), dtype=bool))
    if gap > WIDEST_GAP_PX:
        raise NotDetermined(
            "mtf",
            f"the samples lie {gap:.1f} px apart across the edge: turn the edge by 2 deg or more, or take a longer one",
        )
    return measure_mtf(
        planes, near, edge, usable_reach_px(planes, edge), frequency, noise_std, Quantisation(code, frames)
    )
