"""The summary of one edge: its profile as a spline, estimated from the pixels near it, with all that is read from it.

An edge is summarised once (`summarise_edge`). The profile (ESF) is fitted by weighted least squares of the spline and
of the gradients of the illumination, in passes, as the noise and the gradients depend on it. `EdgeSummary` keeps the
normal equations of this fit, the sums over the samples that predict their right side for any other profile, and the
profile itself. Two readings are made of it: the MTF under the prior of the line spread (`mtf.py`), and the transfer
function at a few frequencies with the covariance of its noise (`transfer.py`).

A summary is in codes of the frames. No black level, exposure or f-number enters it: the levels of both sides are free,
and so are gradients of the illumination.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from lab.errors import NotDetermined
from lab.observables.codes.rounding import rounding_std_dn, rounding_waves_dn, variance_before_rounding
from lab.observables.edges.finding import (
    ACROSS,
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
MOST_SHIFT_PX = 5.0  # of a profile against its own zero
GRID_PX = 0.05  # step of the grid of distances on which other profiles are given


@dataclass(frozen=True)
class EdgeSummary:
    """One edge in the pixels of one colour, in codes, with k spline coefficients and g gradients of the illumination.

    `curve`: where it lies. `reach_px`: the largest distance of a sample from it; `samples`: their number. `spline`:
    basis of the profile. `gram` (k + g + 1, k + g + 1): A^T W A, where A holds the columns of the spline, the gradients
    and the values, which are 0 on the dark and 1 on the light side, and W the inverse variances of the values.
    `inverse` (k + g, k + g): of the normal matrix with the prior of the line spread; it takes A^T W values to the
    solution. `solution` (k + g,), its first k numbers the profile, and `covariance` (k, k) of these about the truth.
    `right_side` (k + g, distances): the operator A^T W C that takes another profile, given at `grid_px`, to the right
    side of the normal equations; C interpolates to the samples by cubics. `rounding` (waves, k + g): A^T W e for the
    errors e that rounding to whole codes may leave, one standard deviation each. `levels`, `noise_std`: of the dark and
    the light side, in codes. `residual_chi2_per_sample`: near 1 where edge, spline and noise explain the region.
    """

    curve: EdgeCurve
    angle_deg: float
    angle_deg_std: float
    reach_px: float
    samples: int
    spline: Spline
    gram: Array
    inverse: Array
    solution: Array
    covariance: Array
    right_side: sparse.csr_array
    rounding: Array
    levels: tuple[float, float]
    noise_std: tuple[float, float]
    residual_chi2_per_sample: float

    @property
    def esf(self) -> Array:
        """Return the coefficients (k,) of the profile."""
        return self.solution[: self.spline.size]

    @property
    def contrast(self) -> float:
        """Return the difference of the two levels, codes."""
        return self.levels[1] - self.levels[0]

    @property
    def has_gradient_across(self) -> bool:
        """Return whether a gradient of the illumination across the edge is free: the region reaches far enough."""
        return len(self.solution) > self.spline.size + ACROSS

    @property
    def grid_px(self) -> Array:
        """Return the distances of `right_side`, `GRID_PX` apart and even about the edge, px."""
        return _grid_px(self.reach_px)

    def predict(self, profile: Callable[[Array], Array]) -> Array:
        """Predict the coefficients (k,) that the estimator finds, at this edge, for a noise-free profile.

        `profile(distance_px)` gives the ESF at signed distances from the edge, rising towards positive distances, with
        any two levels and any shift: the edge is put where the profile is half way.
        """
        grid = _grid_px(self.reach_px + 2.0 * MOST_SHIFT_PX)
        values = np.asarray(profile(grid), dtype=float)
        middle = half_way_px(grid, (values - values[0]) / (values[-1] - values[0]))
        placed = _cubic_interpolation(self.grid_px + np.clip(middle, -MOST_SHIFT_PX, MOST_SHIFT_PX), grid) @ values
        return np.asarray(self.inverse @ (self.right_side @ placed))[: self.spline.size]


def _grid_px(reach_px: float) -> Array:
    """Return distances `GRID_PX` apart that reach beyond `reach_px` on both sides."""
    count = int(np.ceil(reach_px / GRID_PX)) + 3
    return GRID_PX * np.arange(-count, count + 1, dtype=float)


def _cubic_interpolation(at: Array, grid: Array) -> sparse.csr_array:
    """Return the matrix (at, grid) that interpolates from an even grid (Catmull-Rom): the error is of fourth order in
    the spacing.
    """
    place = np.clip((at - grid[0]) / GRID_PX, 1.0, len(grid) - 2.001)
    left = np.floor(place + 1e-9).astype(np.int64)
    t = place - left
    weights = np.stack(
        [0.5 * t * (-1 + t * (2 - t)), 1 + 0.5 * t * t * (-5 + 3 * t), 0.5 * t * (1 + t * (4 - 3 * t)),
        0.5 * t * t * (t - 1)], axis=1
    )  # fmt: skip
    index = left[:, None] + np.array([-1, 0, 1, 2])
    rows = np.repeat(np.arange(len(at)), 4)
    return sparse.csr_array((weights.ravel(), (rows, index.ravel())), shape=(len(at), len(grid)))


def _right_side(basis: sparse.csr_array, gradients: Array, weight: Array, distance: Array) -> sparse.csr_array:
    """Return the operator of `EdgeSummary.right_side` for samples at `distance` (n,), with their `weight` (n,), the
    `basis` (n, k) of the spline and the columns of the `gradients` (g, n).
    """
    between = _cubic_interpolation(distance, _grid_px(float(np.abs(distance).max())))
    weighted = sparse.diags_array(weight) @ between
    return sparse.csr_array(sparse.vstack([basis.T @ weighted, gradients @ weighted]))


@dataclass(frozen=True)
class Quantisation:
    """Values that were rounded to multiples of `size` (in their unit; 0: not rounded), then averaged over `frames`."""

    size: float
    frames: int

    def std_of(self, residual: Array, step: float) -> float:
        """Return the standard deviation of the values about a profile, from their residuals (n,) on one side: the
        noise, and the error of rounding. `step`: the least difference of unequal values there. The level and two
        gradients are fitted; two more are allowed for, so that 1 / variance, which weighs the samples, is unbiased.
        """
        std = _robust_std(residual, max(step, self.size)) * np.sqrt(len(residual) / max(len(residual) - 5, 1))
        if not self.size:
            return float(std)
        return float(np.hypot(std, self.size * rounding_std_dn(self.frames * (std / self.size) ** 2)))

    def waves(self, level: Array, variance: Array) -> list[Array]:
        """Return the errors (n,) that rounding may leave, which repeats don't average out.

        `level`, `variance` (n,): mean and temporal variance of the values at the samples.
        """
        if not self.size:
            return []
        spread = variance_before_rounding(np.asarray(self.frames * variance / self.size**2, float))
        return [self.size * wave for wave in rounding_waves_dn(np.asarray(level / self.size, float), spread)]


@one_blas_thread
def summarise_edge(
    planes: Sequence[Plane], noise_std: float | None = None, code: float = 0.0, frames: int = 1
) -> EdgeSummary:
    """Summarise the edge that one or more planes see with the same blur (the two green ones).

    Each plane is levelled by itself, so that unequal gains don't matter. `noise_std`, in the unit of the values, is
    estimated from the residuals on both sides of the edge where it isn't given. `code`: the values were rounded to
    multiples of it (0: not at all) before a mean of `frames` was taken; where the noise is below the step, the error of
    rounding is part of the uncertainty. Raises `NotDetermined` where there is no single edge.
    """
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
    return _fit_profile(planes, near, edge, noise_std, Quantisation(code, frames))


def _fit_profile(
    planes: Sequence[Plane], near: Samples, edge: EdgeCurve, noise_std: float | None, quantisation: Quantisation
) -> EdgeSummary:
    """Fit the profile of an edge that has been found. `near`: samples close to the edge; the others as of
    `summarise_edge`.
    """
    reach = usable_reach_px(planes, edge)
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

    spline = Spline(_knots_px(core, reach, near.step))
    size = spline.size
    placed = SortedSamples.of(spline, distance)
    distance, foot, value = distance[placed.order], foot[placed.order], value[placed.order]
    dark_tail, light_tail = distance < -0.5 * inner, distance > 0.5 * inner
    steps = [_step_of(samples.value[placed.order][tail]) for tail in (dark_tail, light_tail)]
    tied = _one_gradient(size, room, max(dark_level, 0.0) / contrast)
    variance, used = np.ones_like(value), np.ones(len(value), dtype=bool)
    esf = np.clip(0.5 + distance, 0.0, 1.0)
    start, solution = (1, 1, 3, 0), np.zeros(size)
    for pass_number in range(PASSES):
        weight = np.where(used, 1.0 / variance, 0.0)
        gradients = illumination_gradients(distance, foot * edge.half_length, esf, room)
        gram = placed.gram(np.concatenate([gradients, value[None]]), weight)
        matrix, right = gram[:-1, :-1], gram[:-1, -1]
        if pass_number == 0:
            bridged = matrix.copy()
            bridged[:size, :size] += spline.roughness(ROUGHNESS_SHARE * np.trace(matrix[:size, :size]) / size)
            inverse = tied @ np.linalg.inv(tied.T @ bridged @ tied) @ tied.T
        else:
            priors = LineSpreadPriors.of(spline, solution[:size], width, outer)
            log_range = LOG_LIKELIHOOD_RANGE if pass_number == PASSES - 1 else 0.0
            inverse, covariance, start = posterior(priors, tied.T @ matrix @ tied, tied.T @ right, start, log_range)
            inverse, covariance = tied @ inverse @ tied.T, tied @ covariance @ tied.T
        solution = inverse @ right
        esf = placed.values(solution[:size])
        residual = value - esf - solution[size:] @ gradients
        std_dark, std_light = (
            noise_std / contrast if noise_std else quantisation.std_of(residual[tail] * contrast, step) / contrast
            for tail, step in zip((dark_tail, light_tail), steps, strict=True)
        )
        variance = std_dark**2 + np.clip(esf, 0.0, 1.0) * (std_light**2 - std_dark**2) + STD_FLOOR**2
        used = np.abs(residual) < 6.0 * np.sqrt(variance) + 0.02
    _refuse_unless_one_edge(residual, dark_tail | light_tail, max(std_dark, std_light), float(np.mean(~used)))
    _refuse_too_wide(spline, solution[:size], outer)
    _refuse_clipped(samples.value[placed.order][light_tail], std_dark * contrast, contrast)

    waves = quantisation.waves(dark_level + esf * contrast, variance * contrast**2)
    weighted = np.array(waves).reshape(-1, len(value)) * (weight / contrast)
    rounding = np.concatenate([weighted @ spline.design(distance), weighted @ gradients.T], axis=1)
    moved = rounding @ inverse[:size].T
    return EdgeSummary(
        curve=edge,
        angle_deg=angle_from_vertical_deg(edge.tilt, edge.transposed),
        angle_deg_std=angle_std_deg(placed.derivatives(solution[:size]), distance, foot, variance, gradients, edge),
        reach_px=float(np.abs(distance).max()),
        samples=len(distance),
        spline=spline,
        gram=gram,
        inverse=inverse,
        solution=solution,
        covariance=covariance[:size, :size] + moved.T @ moved,
        right_side=_right_side(spline.design(distance), gradients, weight, distance),
        rounding=rounding,
        levels=(dark_level, light_level),
        noise_std=(std_dark * contrast, std_light * contrast),
        residual_chi2_per_sample=float((weight * residual**2).sum())
        / max(int(used.sum()) - len(solution) - len(edge.poly), 1),
    )


def _one_gradient(size: int, room: bool, dark_share: float) -> Array:
    """Return the matrix (k + g, k + g / 2) that ties the gradients of the light that the edge adds and of that which
    both sides have, `dark_share` of the contrast, as all light has one gradient. `size`: k; `room`: whether there is
    one across the edge.

    All codes of the dark side count as light: a black level of a tenth of the contrast makes its gradient wrong by a
    tenth of the light side's.
    """
    directions = 2 if room else 1
    tied = np.zeros((size + 2 * directions, size + directions))
    tied[:size, :size] = np.eye(size)
    for k in range(directions):
        tied[size + 2 * k : size + 2 * k + 2, size + k] = 1.0, dark_share
    return tied


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
    highest = float(light.max())
    if noise_std > max(0.7 * _step_of(light), 1e-4 * contrast) and float(np.mean(light == highest)) > 0.2:
        raise NotDetermined("mtf", f"the edge's light side is clipped at {highest:g}: expose it shorter")


def _step_of(values: Array) -> float:
    """Return the least difference of unequal values, 0 where all are equal: pictures that were made linear have steps
    that grow with the level.
    """
    different = np.unique(values)
    return float(np.diff(different).min()) if len(different) > 1 else 0.0
