"""Modulation transfer function from a slanted edge, on the raw mosaic (the purpose of ISO 12233's e-SFR).

One Bayer plane is analysed on its own grid; nothing is demosaiced. The edge is a cubic in the frame, found by iterated
least squares; the edge-spread function (ESF) is a linear spline of the distance from it, fitted by weighted least squares
with the illumination's gradient; the transfer function is the exact Fourier transform of the spline's derivative, divided by
the spline's own response.

Everything after the edge is found is linear in the pixel values. An `EdgeGeometry` keeps that linear operator, so that a
*predicted* edge profile goes through the same estimator as the recording (`EdgeMtf.predict`), which takes the estimator's
own bias out of any comparison.

Frequencies are in cycles per pixel of the full sensor, along the edge's normal, also where a plane is sampled at every second
pixel: the slant samples the profile more finely than the plane's pitch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from lab.errors import NotDetermined
from lab.results import MtfCurve, NoiseFit

Array = NDArray[np.floating[Any]]

KNOT_SPACING_PX = 0.25  # in the core; its Nyquist frequency, 2 cy/px, is beyond what any pixel aperture passes
TAIL_GROWTH = 1.7  # ratio of neighbouring knot spacings outside the core, where the profile is smooth
TAIL_REACH_PX = 14.0
OUTER_ZONE_PX = 28.0  # beyond the last knot: levels and the illumination's gradient
SMOOTHING = 1e-6  # of a knot's weight: bridges knots that no sample falls on; 1e-4 of the signal at 1 cy/px
EDGE_ORDER = 3
CORE_PX, CORE_SIGMAS = 1.5, 3.5  # half-width of the core
PASSES = 4  # of the least squares: noise levels and gradients need the profile
NUMERICAL_FLOOR = 1e-6  # of the contrast: noise-free regions have weights too
DEFAULT_FREQUENCY_CY_PER_PX: Array = np.arange(101) / 100.0


@dataclass(frozen=True)
class EdgeGeometry:
    """Where the samples lie with respect to the edge: all that the estimator needs to know besides the values.

    `edge_px`: coefficients of the edge's coordinate across, a polynomial in (along - centre) / half_length, in px of the full
    sensor; `transposed`: across is the row, else the column. `distance_px`: (n,) signed distance of every sample used,
    positive on the light side; `weight`: (n,) inverse variance of the (normalised) values; `knot_px`: knots of the ESF.
    """

    angle_deg: float
    angle_deg_std: float
    transposed: bool
    edge_px: tuple[float, ...]
    centre_px: tuple[float, float]
    half_length_px: float
    distance_px: Array
    weight: Array
    knot_px: Array
    gradients: Array  # (g, n): the illumination's gradient along and across, as seen at the samples
    normal: Array  # (k + g, k + g): inverse of the normal matrix = covariance of the coefficients

    @property
    def reach_px(self) -> float:
        """Largest distance from the edge of a sample that counts."""
        return float(np.abs(self.distance_px).max())

    def coefficients(self, values: Array) -> Array:
        """Least-squares ESF at the knots (beyond the first and the last one it is constant) from values at the samples, (n,)."""
        right = _project(self.distance_px, self.knot_px, self.gradients, values * self.weight)
        return np.asarray(self.normal @ right)[: len(self.knot_px)]

    def optical_transfer(self, coefficients: Array, frequency_cy_per_px: Array) -> NDArray[np.complex128]:
        """Complex transfer function of an ESF given at the knots: 1 at frequency 0, phase about the edge."""
        operator = _transfer_operator(self.knot_px, frequency_cy_per_px)
        step = coefficients[-1] - coefficients[0]
        return np.asarray(operator @ coefficients / step)

    def predict(self, profile: Callable[[Array], Array], frequency_cy_per_px: ArrayLike) -> Array:
        """MTF that the estimator would report, at this very geometry, for a noise-free edge profile.

        `profile(distance_px)` gives the ESF at signed distances from the edge, rising towards positive distances; any two
        levels will do. It is called once, on an even grid of 0.05 px.
        """
        reach = self.reach_px + 0.1
        count = int(np.ceil(reach / 0.05))
        grid = np.arange(-count, count + 1) * 0.05
        values = np.asarray(profile(grid), dtype=float)
        sampled = _interpolate(grid, values, self.distance_px)
        otf = self.optical_transfer(self.coefficients(sampled), np.asarray(frequency_cy_per_px, dtype=float))
        return np.abs(otf)


@dataclass(frozen=True)
class EdgeMtf:
    """What one edge in one channel says.

    `mtf` is the modulus with the noise's share taken out; `covariance` is that of `mtf` over the frequencies. `otf` is the
    complex transfer function as it came out (phase about the edge). `esf` is at `esf_distance_px`, 0 on the dark side and 1
    on the light one; `lsf` (per px) at `lsf_distance_px`, the middles between.
    """

    frequency_cy_per_px: Array
    mtf: Array
    mtf_std: Array
    covariance: Array
    otf: NDArray[np.complex128]
    mtf50_cy_per_px: float | None
    mtf50_cy_per_px_std: float | None
    angle_deg: float
    angle_deg_std: float
    esf_distance_px: Array
    esf: Array
    lsf_distance_px: Array
    lsf: Array
    dark_level: float
    light_level: float
    noise_std_dark: float
    noise_std_light: float
    residual_chi2_per_sample: float
    geometry: EdgeGeometry

    def predict(self, profile: Callable[[Array], Array]) -> Array:
        """MTF, at `frequency_cy_per_px`, that this estimator reports for a predicted edge profile; see `EdgeGeometry.predict`."""
        return self.geometry.predict(profile, self.frequency_cy_per_px)


@dataclass(frozen=True)
class Plane:
    """Samples of one channel on their own grid: `values[i, j]` lies at `row0 + step i`, `col0 + step j` of the sensor."""

    values: Array
    row0: float = 0.0
    col0: float = 0.0
    step: int = 1


def edge_mtf(
    region: ArrayLike, frequency_cy_per_px: ArrayLike | None = None, noise_std: float | None = None
) -> EdgeMtf:
    """MTF from a linear region (rows, cols) that holds one straight or gently bent edge at any angle.

    `frequency_cy_per_px` defaults to 0..1 by 0.01; `noise_std` (in the region's unit) is estimated from the residuals on both
    sides of the edge where it isn't given. The angle is from the vertical, -90 to 90 deg, positive where the edge's top turns
    to the right. Raises `NotDetermined` where there is no single edge.
    """
    values = np.asarray(region, dtype=float)
    if values.ndim != 2:
        raise NotDetermined("mtf", f"a region has two dimensions, this one has {values.ndim}")
    return planes_mtf([Plane(values)], frequency_cy_per_px, noise_std)


def planes_mtf(
    planes: Sequence[Plane], frequency_cy_per_px: ArrayLike | None = None, noise_std: float | None = None
) -> EdgeMtf:
    """As `edge_mtf`, from one or more planes that see the same edge with the same blur (the two green ones).

    Each plane is levelled by itself, so that unequal gains don't matter.
    """
    frequency = (
        DEFAULT_FREQUENCY_CY_PER_PX if frequency_cy_per_px is None else np.asarray(frequency_cy_per_px, dtype=float)
    )
    samples = _Samples.of(planes)
    edge = _first_line(planes, samples)
    edge = _refined(samples, edge)
    return _measure(samples, edge, frequency, noise_std)


# --- samples and the edge -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Samples:
    row: Array
    col: Array
    value: Array
    plane: NDArray[np.int64]
    step: int
    count: int

    def where(self, kept: NDArray[np.bool_]) -> _Samples:
        return _Samples(self.row[kept], self.col[kept], self.value[kept], self.plane[kept], self.step, self.count)

    @staticmethod
    def of(planes: Sequence[Plane]) -> _Samples:
        if not planes or any(min(p.values.shape) * p.step < 16 or min(p.values.shape) < 8 for p in planes):
            raise NotDetermined("mtf", "the region is too small: at least 16 x 16 px (8 x 8 samples) are needed")
        rows, cols, values, index = [], [], [], []
        for k, p in enumerate(planes):
            if not np.isfinite(p.values).all():
                raise NotDetermined("mtf", "the region holds values that aren't finite")
            r = p.row0 + p.step * np.arange(p.values.shape[0], dtype=float)
            c = p.col0 + p.step * np.arange(p.values.shape[1], dtype=float)
            rows.append(np.repeat(r, len(c)))
            cols.append(np.tile(c, len(r)))
            values.append(p.values.ravel().astype(float))
            index.append(np.full(p.values.size, k))
        return _Samples(
            np.concatenate(rows),
            np.concatenate(cols),
            np.concatenate(values),
            np.concatenate(index),
            planes[0].step,
            len(planes),
        )


@dataclass(frozen=True)
class _Edge:
    """across = polynomial(along'), along' = (along - centre) / half_length; `sign` +1 where light is at larger across."""

    transposed: bool
    centre: tuple[float, float]
    half_length: float
    poly: Array
    sign: int

    def frame(self, samples: _Samples) -> tuple[Array, Array]:
        row, col = samples.row - self.centre[0], samples.col - self.centre[1]
        along, across = (col, row) if self.transposed else (row, col)
        return along / self.half_length, across

    def shifted(self, change: Array) -> _Edge:
        return _Edge(self.transposed, self.centre, self.half_length, self.poly + change, self.sign)

    def distance(self, along: Array, across: Array) -> tuple[Array, Array, Array]:
        """Signed distance from the curve, the foot's parameter, and the curve's slope there (two Newton steps)."""
        first = polynomial.polyder(self.poly) / self.half_length
        second = polynomial.polyder(first) / self.half_length
        foot = along
        for _ in range(2):
            gap = across - polynomial.polyval(foot, self.poly)
            slope = polynomial.polyval(foot, first)
            bend = polynomial.polyval(foot, second)
            lag = (foot - along) * self.half_length - gap * slope
            foot = foot - lag / (1.0 + slope**2 - gap * bend) / self.half_length
        slope = polynomial.polyval(foot, first)
        gap = across - polynomial.polyval(foot, self.poly)
        return self.sign * gap * np.sqrt(1.0 + slope**2), foot, slope


def _first_line(planes: Sequence[Plane], samples: _Samples) -> _Edge:
    """Straight edge from the gradients of the smoothed first plane: their orientation, then their weighted line."""
    plane = planes[0]
    smooth = ndimage.gaussian_filter(plane.values, 1.2, mode="nearest")
    g_row, g_col = np.gradient(smooth)
    g_row, g_col = g_row[2:-2, 2:-2], g_col[2:-2, 2:-2]
    rows, cols = np.indices(g_row.shape, dtype=float) + 2.0
    centre = (
        plane.row0 + plane.step * (plane.values.shape[0] - 1) / 2.0,
        plane.col0 + plane.step * (plane.values.shape[1] - 1) / 2.0,
    )
    power = g_row**2 + g_col**2
    # Smoothed white noise has a known mean gradient power; its square as weight lets the edge outshine the field of noise.
    weight = np.square(np.clip(power - 3.0 * np.median(power), 0.0, None))
    if weight.sum() <= 0.0:
        raise NotDetermined("mtf", "no edge in the region: it is uniform")
    transposed = False
    normal = np.array([1.0, 0.0])
    for _ in range(8):
        total = weight.sum()
        if not total > 0.0:
            raise NotDetermined("mtf", "no edge in the region: gradients don't line up")
        tensor_rr = (weight * g_row**2 / np.maximum(power, 1e-300)).sum()
        tensor_cc = (weight * g_col**2 / np.maximum(power, 1e-300)).sum()
        tensor_rc = (weight * g_row * g_col / np.maximum(power, 1e-300)).sum()
        angle = 0.5 * np.arctan2(2.0 * tensor_rc, tensor_rr - tensor_cc)
        normal = np.array([np.cos(angle), np.sin(angle)])  # (row, col)
        transposed = bool(abs(normal[0]) > abs(normal[1]))
        offset = (weight * (rows * normal[0] + cols * normal[1])).sum() / total
        gap = rows * normal[0] + cols * normal[1] - offset
        spread = np.sqrt((weight * gap**2).sum() / total)
        along_gradient = np.square(g_row * normal[0] + g_col * normal[1])
        power = g_row**2 + g_col**2
        weight = np.where(np.abs(gap) < max(2.5 * spread, 3.0), np.square(along_gradient), 0.0)
    total = weight.sum()
    along, across = (cols, rows) if transposed else (rows, cols)
    mean_along, mean_across = (weight * along).sum() / total, (weight * across).sum() / total
    spread = (weight * (along - mean_along) ** 2).sum()
    slope = (weight * (along - mean_along) * (across - mean_across)).sum() / max(spread, 1e-300)
    row_scale = np.array([plane.values.shape[0], plane.values.shape[1]]) * plane.step / 2.0
    half_length = float(row_scale[1] if transposed else row_scale[0])
    centre_along = (centre[1] - plane.col0 if transposed else centre[0] - plane.row0) / plane.step
    centre_across = (centre[0] - plane.row0 if transposed else centre[1] - plane.col0) / plane.step
    poly = np.zeros(EDGE_ORDER + 1)
    poly[0] = (mean_across + slope * (centre_along - mean_along) - centre_across) * plane.step
    poly[1] = slope * half_length
    sign = 1 if ((g_row if transposed else g_col) * weight).sum() > 0 else -1
    return _Edge(transposed, centre, half_length, poly, sign)


def _levelled(samples: _Samples, distance: Array, inner: float, outer: float) -> tuple[Array, float, float]:
    """Values with each plane's mean levels at `inner` < |distance| < `outer` mapped to 0 and 1; the mean levels in the input's unit."""
    value = np.empty_like(samples.value)
    dark_sum = light_sum = 0.0
    for k in range(samples.count):
        here = samples.plane == k
        d = distance[here]
        v = samples.value[here]
        dark, light = v[(d < -inner) & (d > -outer)], v[(d > inner) & (d < outer)]
        if min(len(dark), len(light)) < 8:
            raise NotDetermined("mtf", "the edge leaves no room on one of its sides within the region")
        low, high = float(np.mean(dark)), float(np.mean(light))
        if high <= low:
            raise NotDetermined("mtf", "no edge in the region: both sides are equally light")
        value[here] = (v - low) / (high - low)
        dark_sum, light_sum = dark_sum + low, light_sum + high
    return value, dark_sum / samples.count, light_sum / samples.count


def _refined(samples: _Samples, edge: _Edge) -> _Edge:
    """The edge's polynomial by Gauss-Newton on the profile: v = E(d), dE/d(edge) = -E'(d); wide and coarse first."""
    along, across = edge.frame(samples)
    schedule = [(16.0, 1.0, 1), (12.0, 0.75, 2), (10.0, 0.5, 3), (8.0, 0.25, 3), (8.0, 0.25, 3), (8.0, 0.25, 3)]
    reach_limit = _reach(edge, samples)
    for reach, spacing, order in schedule:
        limit = min(max(reach, 2.0 * samples.step), 0.8 * reach_limit)
        near = np.abs(across - polynomial.polyval(along, edge.poly)) < 2.0 * (limit + 2.0)
        t, x = along[near], across[near]
        distance, foot, slope = edge.distance(t, x)
        kept = np.abs(distance) < limit
        value = samples.value[near][kept]
        plane = samples.plane[near][kept]
        d, foot, slope = distance[kept], foot[kept], slope[kept]
        for k in range(samples.count):  # level each plane on the spot
            here = plane == k
            far_low, far_high = (d[here] < -0.6 * limit), (d[here] > 0.6 * limit)
            if far_low.sum() < 4 or far_high.sum() < 4:
                raise NotDetermined("mtf", "the edge leaves no room on one of its sides within the region")
            low, high = np.median(value[here][far_low]), np.median(value[here][far_high])
            if not high > low:
                raise NotDetermined("mtf", "no edge in the region: both sides are equally light")
            value[here] = (value[here] - low) / (high - low)
        count = int(np.ceil(limit / spacing))
        knots = np.arange(-count, count + 1) * spacing
        normal, right = _normal_equations(d, np.ones_like(d), knots, value)
        esf = np.linalg.solve(normal + _roughness(len(knots), 1e-4 * np.trace(normal) / len(knots)), right)
        slope_of_esf = np.gradient(esf, spacing)
        residual = value - np.interp(d, knots, esf)
        steepness = np.interp(d, knots, slope_of_esf)
        # d(distance) = -sign * d(edge) / sqrt(1 + slope^2)
        response = -edge.sign * steepness / np.sqrt(1.0 + slope**2)
        basis = response * foot ** np.arange(order + 1)[:, None]
        clipped = np.abs(residual) < 6.0 * np.sqrt(np.mean(residual**2)) + 1e-12
        gram = (basis * clipped) @ basis.T
        change = np.linalg.lstsq(gram, (basis * clipped) @ residual, rcond=1e-10)[0]
        change = np.clip(change, -0.25 * limit, 0.25 * limit)
        edge = edge.shifted(np.concatenate([change, np.zeros(EDGE_ORDER - order)]))
    return edge


def _reach(edge: _Edge, samples: _Samples) -> float:
    """Distance from the edge up to which, on both sides, at least half as many samples lie as beside the edge."""
    along, across = edge.frame(samples)
    slope = polynomial.polyval(along, polynomial.polyder(edge.poly)) / edge.half_length
    distance = (across - polynomial.polyval(along, edge.poly)) / np.sqrt(1.0 + slope**2)
    width = 2.0 * samples.step
    count, _ = np.histogram(distance, bins=np.arange(-101, 102) * width)
    middle = len(count) // 2
    enough = count >= 0.5 * max(float(count[middle - 1 : middle + 2].mean()), 1.0)
    right = np.flatnonzero(~enough[middle:])
    left = np.flatnonzero(~enough[: middle + 1][::-1])
    steps = min(right[0] if len(right) else middle, left[0] if len(left) else middle)
    reach = (float(steps) - 0.5) * width
    if reach < 4.0:
        raise NotDetermined(
            "mtf",
            f"only {max(reach, 0.0):.0f} px beside the edge: place the region so that at least 4 px lie on both sides",
        )
    return reach


# --- the spline and its transform ------------------------------------------------------------------------------------------


def _hats(distance: Array, knots: Array) -> tuple[NDArray[np.int64], Array]:
    """Index of the interval and the share of its right knot; constant beyond the ends."""
    index = np.clip(np.searchsorted(knots, distance, side="right") - 1, 0, len(knots) - 2)
    share = np.clip((distance - knots[index]) / (knots[index + 1] - knots[index]), 0.0, 1.0)
    return index, share


def _project(distance: Array, knots: Array, gradients: Array, weighted: Array) -> Array:
    """A^T (weighted values), A = the hats and the gradients."""
    index, share = _hats(distance, knots)
    size = len(knots)
    right = np.bincount(index, weighted * (1.0 - share), size) + np.bincount(index + 1, weighted * share, size)
    return np.concatenate([right, gradients @ weighted])


def _normal_equations(
    distance: Array, weight: Array, knots: Array, value: Array, gradients: Array | None = None
) -> tuple[Array, Array]:
    """A^T W A and A^T W v of the spline (tridiagonal) bordered by the gradients."""
    size = len(knots)
    index, share = _hats(distance, knots)
    left = 1.0 - share
    extra = np.zeros((0, len(distance))) if gradients is None else gradients
    normal = np.zeros((size + len(extra),) * 2)
    k = np.arange(size)
    normal[k, k] = np.bincount(index, weight * left**2, size) + np.bincount(index + 1, weight * share**2, size)
    off = np.bincount(index, weight * left * share, size)[: size - 1]
    normal[k[:-1], k[1:]] = off
    normal[k[1:], k[:-1]] = off
    for j, g in enumerate(extra):
        column = np.bincount(index, weight * left * g, size) + np.bincount(index + 1, weight * share * g, size)
        normal[:size, size + j] = normal[size + j, :size] = column
        normal[size + j, size:] = extra @ (weight * g)
    return normal, _project(distance, knots, extra, weight * value)


def _roughness(size: int, strength: float) -> Array:
    """Penalty on third differences of neighbouring knots."""
    if size < 4:
        return np.zeros((size, size))
    differences = np.diff(np.eye(size), 3, axis=0)
    return strength * differences.T @ differences


def _transfer_operator(knots: Array, frequency: Array) -> NDArray[np.complex128]:
    """Matrix from the ESF at the knots to the Fourier transform of its derivative, (frequencies, knots).

    The derivative is a staircase, whose transform is exact. A least-squares linear spline passes a sinusoid with
    sinc^4(f h) / ((2 + cos 2 pi f h) / 3), h the spacing of the core: divided out.
    """
    h = np.diff(knots)
    middle = 0.5 * (knots[1:] + knots[:-1])
    stairs = np.exp(-2j * np.pi * frequency[:, None] * middle) * np.sinc(frequency[:, None] * h)  # of unit area each
    operator = np.zeros((len(frequency), len(knots)), dtype=complex)
    operator[:, 1:] += stairs
    operator[:, :-1] -= stairs
    core = float(h.min())
    response = np.sinc(frequency * core) ** 4 * 3.0 / (2.0 + np.cos(2.0 * np.pi * frequency * core))
    return np.asarray(operator / response[:, None])


def _interpolate(grid: Array, values: Array, at: Array) -> Array:
    """Cubic (Catmull-Rom) interpolation on an even grid: error of order 4 where plain linear would smear."""
    step = grid[1] - grid[0]
    position = np.clip((at - grid[0]) / step, 1.0, len(grid) - 2.001)
    i = position.astype(np.int64)
    t = position - i
    a, b, c, d = values[i - 1], values[i], values[i + 1], values[i + 2 - (i + 2 >= len(grid))]
    return np.asarray(b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))))


# --- the measurement -------------------------------------------------------------------------------------------------------


def _knots(width: float, reach: float, step: int) -> tuple[Array, bool]:
    """Even knots in the core of half-width `width`, then wider and wider ones; whether there is room for an outer zone."""
    limit = max(reach - 2.0 * step, 2.0)
    core = min(width, limit)
    count = max(int(np.ceil(core / KNOT_SPACING_PX)), 6)
    side = list(np.arange(count + 1) * KNOT_SPACING_PX)
    spacing = KNOT_SPACING_PX
    while side[-1] < count * KNOT_SPACING_PX + TAIL_REACH_PX:
        spacing *= TAIL_GROWTH
        if side[-1] + spacing > limit:
            break
        side.append(side[-1] + spacing)
    positive = np.array(side)
    return np.concatenate([-positive[:0:-1], positive]), reach - positive[-1] > 8.0 * step


def _measure(samples: _Samples, edge: _Edge, frequency: Array, noise_std: float | None) -> EdgeMtf:
    reach = _reach(edge, samples)
    along, across = edge.frame(samples)
    near = np.abs(across - polynomial.polyval(along, edge.poly)) < 1.6 * reach + 4.0
    samples = samples.where(near)
    distance, foot, _ = edge.distance(along[near], across[near])

    knots, room = _knots(CORE_PX + CORE_SIGMAS * _blur_width(samples, distance, min(12.0, reach)), reach, samples.step)
    outer = min(reach, float(knots[-1]) + OUTER_ZONE_PX)
    kept = np.abs(distance) < outer
    samples, distance, foot = samples.where(kept), distance[kept], foot[kept]
    inner = min(0.6 * outer, float(knots[-1]))
    value, dark_level, light_level = _levelled(samples, distance, inner, outer)
    contrast = light_level - dark_level
    offset = max(dark_level, 0.0) / contrast  # the illumination's gradient acts on the dark side's light too

    size = len(knots)
    dark_tail, light_tail = distance < -0.5 * inner, distance > 0.5 * inner
    variance = np.ones_like(value)
    used = np.ones(len(value), dtype=bool)
    esf = np.clip(0.5 + distance, 0.0, 1.0)
    index, share = _hats(distance, knots)
    for _ in range(PASSES):
        weight = np.where(used, 1.0 / variance, 0.0)
        gradients = _gradients(distance, foot * edge.half_length, esf + offset, room)
        equations, right = _normal_equations(distance, weight, knots, value, gradients)
        equations[:size, :size] += _roughness(size, SMOOTHING * np.trace(equations[:size, :size]) / size)
        normal = np.linalg.inv(equations)
        solution = normal @ right
        esf = solution[index] * (1.0 - share) + solution[index + 1] * share
        residual = value - esf - solution[size:] @ gradients
        if noise_std is None:
            std_dark, std_light = _robust_std(residual[dark_tail]), _robust_std(residual[light_tail])
        else:
            std_dark = std_light = noise_std / contrast
        variance = std_dark**2 + np.clip(esf, 0.0, 1.0) * (std_light**2 - std_dark**2) + NUMERICAL_FLOOR**2
        used = np.abs(residual) < 6.0 * np.sqrt(variance) + 0.02
    _refuse_unless_one_edge(residual, dark_tail | light_tail, max(std_dark, std_light))

    slope = float(polynomial.polyval(0.0, polynomial.polyder(edge.poly))) / edge.half_length
    steepness = np.interp(distance, 0.5 * (knots[1:] + knots[:-1]), np.diff(solution[:size]) / np.diff(knots))
    geometry = EdgeGeometry(
        angle_deg=_angle_deg(slope, edge.transposed),
        angle_deg_std=_angle_deg_std(steepness, foot, weight, slope, edge.half_length),
        transposed=edge.transposed,
        edge_px=tuple(float(c) for c in edge.poly),
        centre_px=edge.centre,
        half_length_px=edge.half_length,
        distance_px=distance,
        weight=weight,
        knot_px=knots,
        gradients=gradients,
        normal=normal,
    )
    freedom = max(np.count_nonzero(used) - len(solution) - len(edge.poly), 1)
    return _described(
        geometry,
        solution[:size],
        frequency,
        levels=(dark_level, light_level),
        noise=(std_dark * contrast, std_light * contrast),
        chi2=float((weight * residual**2).sum() / freedom),
    )


def _described(
    geometry: EdgeGeometry,
    esf: Array,
    frequency: Array,
    *,
    levels: tuple[float, float],
    noise: tuple[float, float],
    chi2: float,
) -> EdgeMtf:
    """Transfer function, its covariance and MTF50 of an ESF at the geometry's knots."""
    knots = geometry.knot_px
    covariance_of_esf = geometry.normal[: len(knots), : len(knots)]
    otf, slopes = _transfer_and_slopes(geometry, esf, frequency)
    across = np.abs(otf)
    phase = np.where(across > 0, otf / np.maximum(across, 1e-300), 1.0)
    turned = slopes * phase.conj()[:, None]
    along_slopes, aside_slopes = turned.real, turned.imag
    covariance = along_slopes @ covariance_of_esf @ along_slopes.T
    aside = np.einsum("fi,ij,fj->f", aside_slopes, covariance_of_esf, aside_slopes)
    mtf = np.sqrt(np.clip(across**2 - aside, 0.0, None))  # |F + n| is too large by var(n across F) / (2 |F|)

    mtf50, mtf50_std = _mtf50(geometry, esf, covariance_of_esf)
    step = esf[-1] - esf[0]
    return EdgeMtf(
        frequency_cy_per_px=frequency,
        mtf=mtf,
        mtf_std=np.sqrt(np.clip(np.diag(covariance), 0.0, None)),
        covariance=covariance,
        otf=otf,
        mtf50_cy_per_px=mtf50,
        mtf50_cy_per_px_std=mtf50_std,
        angle_deg=geometry.angle_deg,
        angle_deg_std=geometry.angle_deg_std,
        esf_distance_px=knots,
        esf=(esf - esf[0]) / step,
        lsf_distance_px=0.5 * (knots[1:] + knots[:-1]),
        lsf=np.diff(esf) / np.diff(knots) / step,
        dark_level=levels[0],
        light_level=levels[1],
        noise_std_dark=noise[0],
        noise_std_light=noise[1],
        residual_chi2_per_sample=chi2,
        geometry=geometry,
    )


def _transfer_and_slopes(
    geometry: EdgeGeometry, esf: Array, frequency: Array
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Transfer function and its derivatives by the ESF's values at the knots, (frequencies, knots)."""
    operator = _transfer_operator(geometry.knot_px, frequency)
    step = esf[-1] - esf[0]
    otf = np.asarray(operator @ esf / step)
    slopes = operator / step
    slopes[:, -1] -= otf / step
    slopes[:, 0] += otf / step
    return otf, slopes


def _mtf50(geometry: EdgeGeometry, esf: Array, covariance: Array) -> tuple[float | None, float | None]:
    """First frequency at which the MTF falls to one half; None where it doesn't up to 1.5 cy/px."""
    frequency = np.arange(1, 151) / 100.0
    mtf = np.abs(geometry.optical_transfer(esf, frequency))
    below = np.flatnonzero(mtf < 0.5)
    if not len(below) or below[0] == 0:
        return None, None
    low, high = frequency[below[0] - 1], frequency[below[0]]
    for _ in range(3):  # secant steps on a smooth curve, bracketed to 0.01 cy/px: exact to 1e-9
        pair = np.abs(geometry.optical_transfer(esf, np.array([low, high])))
        crossing = float(low + (0.5 - pair[0]) * (high - low) / (pair[1] - pair[0]))
        width = 0.05 * (high - low)
        low, high = crossing - width, crossing + width
    slope = (pair[1] - pair[0]) / (20.0 * width)
    otf, slopes = _transfer_and_slopes(geometry, esf, np.array([crossing]))
    by_esf = (slopes[0] * otf[0].conj() / abs(otf[0])).real
    return crossing, float(np.sqrt(by_esf @ covariance @ by_esf) / abs(slope))


def _gradients(distance: Array, along_px: Array, light: Array, room: bool) -> Array:
    """Columns of a planar gradient of the illumination, per 100 px: along the edge; across it where there is an outer zone."""
    rows = [along_px * light / 100.0]
    if room:  # else it can't be told from the profile's own tails
        rows.append(distance * light / 100.0)
    return np.array(rows)


def _blur_width(samples: _Samples, distance: Array, reach: float) -> float:
    """Standard deviation of the Gaussian with the profile's 10 % to 90 % distance, px."""
    kept = np.abs(distance) < reach
    value, _, _ = _levelled(samples.where(kept), distance[kept], 0.75 * reach, reach)
    count = max(int(reach / 0.5), 4)
    knots = np.arange(-count, count + 1) * reach / count
    normal, right = _normal_equations(distance[kept], np.ones_like(value), knots, value)
    esf = np.linalg.solve(normal + _roughness(len(knots), 1e-3 * np.trace(normal) / len(knots)), right)
    low, high = np.flatnonzero(esf > 0.1), np.flatnonzero(esf < 0.9)
    i, j = max(int(low[0]), 1), min(int(high[-1]), len(esf) - 2)
    first = knots[i] - (esf[i] - 0.1) / max(esf[i] - esf[i - 1], 1e-3) * reach / count
    last = knots[j] + (0.9 - esf[j]) / max(esf[j + 1] - esf[j], 1e-3) * reach / count
    return float(np.clip((last - first) / 2.563, 0.2, reach))


def _robust_std(residual: Array) -> float:
    """Standard deviation without outliers: 1.4826 times the median of the modulus, then clipped at 4 sigma."""
    rough = 1.4826 * float(np.median(np.abs(residual)))
    kept = residual[np.abs(residual) <= 4.0 * rough + 1e-12]
    return float(np.sqrt(np.mean(kept**2)))


def _refuse_unless_one_edge(residual: Array, tail: NDArray[np.bool_], std: float) -> None:
    if std > 1.0:
        raise NotDetermined("mtf", f"no edge in the region: the contrast is only {1.0 / std:.2f} of the noise")
    spread = float(np.sqrt(np.mean(residual[tail] ** 2)))
    local = _robust_std(np.diff(residual[tail])) / np.sqrt(2.0)
    if spread > max(0.12, 3.0 * local):
        raise NotDetermined("mtf", "the region holds more than one edge: narrow it down to a single one")


def _angle_deg(slope: float, transposed: bool) -> float:
    """From the vertical, positive where the top turns to the right; -90 < angle <= 90."""
    row, col = (slope, 1.0) if transposed else (1.0, slope)
    angle = float(np.degrees(np.arctan2(col, -row)))
    return angle - 180.0 * np.ceil((angle - 90.0) / 180.0)


def _angle_deg_std(steepness: Array, foot: Array, weight: Array, slope: float, half_length: float) -> float:
    """From the Gauss-Newton matrix of the edge's polynomial."""
    basis = steepness / np.sqrt(1.0 + slope**2) * foot ** np.arange(EDGE_ORDER + 1)[:, None]
    covariance = np.linalg.pinv((basis * weight) @ basis.T)
    return float(np.degrees(np.sqrt(covariance[1, 1]) / half_length / (1.0 + slope**2)))


# --- recordings ------------------------------------------------------------------------------------------------------------


def region_planes(
    frame: NDArray[np.generic], region: tuple[int, int, int, int], cfa: str, channel: str, black_level_dn: float
) -> list[Plane]:
    """The channel's planes (two green ones) within `region` of a raw frame, DN above black, at their sensor coordinates."""
    row0, col0, row1, col1 = region
    if cfa == "MONO":
        return [Plane(frame[row0:row1, col0:col1].astype(float) - black_level_dn, row0, col0, 1)]
    found = []
    for phase, name in enumerate(cfa):
        if name == channel:
            r = row0 + (phase // 2 - row0) % 2
            c = col0 + (phase % 2 - col0) % 2
            found.append(Plane(frame[r:row1:2, c:col1:2].astype(float) - black_level_dn, r, c, 2))
    return found


def measure_edge(
    recordings: Any,
    captures: Sequence[Any],
    channel: str,
    noise: NoiseFit | None = None,
    frequency_cy_per_px: ArrayLike | None = None,
) -> EdgeMtf:
    """MTF of one slanted edge in one channel; `captures` are repeats of the same settings, averaged before the analysis.

    The noise is what is left between the frame and the fitted edge, so that it holds the photo response non-uniformity,
    which repeats don't average out. Raises `NotDetermined` where the light side is saturated or the region holds no edge.
    """
    first = captures[0]
    camera = recordings.camera(first.side)
    black = noise.black_level_dn if noise is not None and noise.black_level_dn is not None else camera.black_level_dn
    if black is None:
        raise NotDetermined("mtf", "the black level is neither fitted nor stated: add dark frames")
    frames = [recordings.frame(c) for c in captures]
    white = camera.white_level_dn if camera.white_level_dn is not None else 2.0**camera.bit_depth - 1.0
    row0, col0, row1, col1 = first.region
    saturated = float(np.mean(frames[0][row0:row1, col0:col1] >= white))
    if saturated > 0.002:
        raise NotDetermined("mtf", f"{first.id}: {100 * saturated:.1f} % of the region is saturated; expose it shorter")
    mean = np.mean([f.astype(float) for f in frames], axis=0) if len(frames) > 1 else frames[0]
    planes = region_planes(mean, first.region, camera.cfa, channel, black)
    frequency = DEFAULT_FREQUENCY_CY_PER_PX if frequency_cy_per_px is None else frequency_cy_per_px
    return planes_mtf(planes, frequency)


def fit_mtf(recordings: Any, side: str, noise: NoiseFit | None = None) -> tuple[MtfCurve, ...]:
    """One MTF curve for every slanted-edge capture of `side` and every channel (R, G, B; or Y), captures in their order.

    The black level is `noise`'s where it was fitted, else the stated one. The angle is given in the turn (of 180 deg) next to
    the capture's nominal one. A capture without a usable edge is left out; raises `NotDetermined` where none has one.
    """
    captures = recordings.captures("slanted_edge", side)
    if not captures:
        raise NotDetermined("mtf", "no slanted_edge captures")
    channels = ("Y",) if recordings.camera(side).cfa == "MONO" else ("R", "G", "B")
    curves, reasons = [], []
    for capture in captures:
        for channel in channels:
            try:
                edge = measure_edge(recordings, [capture], channel, noise)
            except NotDetermined as refused:
                reasons.append(f"{capture.id} ({channel}): {refused.reason}")
                continue
            turns = 0.0 if capture.angle_deg is None else 180.0 * round((capture.angle_deg - edge.angle_deg) / 180.0)
            curves.append(
                MtfCurve(
                    capture=capture.id,
                    channel=channel,
                    angle_deg=edge.angle_deg + turns,
                    angle_deg_std=edge.angle_deg_std,
                    field_mm=capture.field_mm,
                    frequency_cy_per_px=tuple(edge.frequency_cy_per_px.tolist()),
                    mtf=tuple(edge.mtf.tolist()),
                    mtf_std=tuple(edge.mtf_std.tolist()),
                    mtf50_cy_per_px=edge.mtf50_cy_per_px,
                    mtf50_cy_per_px_std=edge.mtf50_cy_per_px_std,
                )
            )
    if not curves:
        raise NotDetermined("mtf", reasons[0])
    return tuple(curves)
