"""Modulation transfer function from a slanted edge, on the raw mosaic (the purpose of ISO 12233's e-SFR).

One Bayer plane is analysed on its own grid; nothing is demosaiced. The edge is a cubic in the frame, found by iterated
least squares; the edge-spread function (ESF) is a cubic spline of the distance from it, with even knots in the core and ever
wider ones in the tails, fitted by weighted least squares together with the illumination's gradient; the transfer function is
the Fourier transform of the spline's derivative, in closed form. (A hat basis in place of the spline leaves a ripple of
h^2 E'' / 12 that an uneven spread of the samples turns into a bias of 0.1 % of MTF50.)

What the samples leave open is filled by a prior of the line spread (`_under_priors`): a Gaussian and, about it, a Gaussian
process, over the strength and smoothness of which the evidence averages. Noise that no line spread makes is kept out, the
uncertainty is that of the truth given the data, and the tail of diffraction, 1 % of the contrast of which lies beyond any
region, is followed by its law.

Everything after the edge is found is linear in the pixel values. An `EdgeGeometry` keeps that linear operator, so that a
*predicted* edge profile goes through the same estimator as the recording (`EdgeMtf.predict`), which takes the estimator's
own bias out of any comparison.

Frequencies are in cycles per pixel of the full sensor, along the edge's normal, also where a plane is sampled at every second
pixel: the slant samples the profile more finely than the plane's pitch.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, ndimage, sparse, special
from scipy.interpolate import BSpline, CubicSpline

from lab.errors import NotDetermined
from lab.fit.levels import rounding_std_dn, rounding_waves_dn, unrounded
from lab.formats.recording_set import RecordingSet, SlantedEdge
from lab.formats.results import MtfCurve, NoiseFit
from sim.camera import Cfa, Side
from sim.sensor.mosaic import phases
from sim.sensor.mosaic import step as period

Array = NDArray[np.floating[Any]]
_Point = tuple[int, int, int, int]  # of the grid of priors: smoothness, length, strength, tail's amplitude
Region = tuple[int, int, int, int]  # row0, col0, row1, col1, end excluded

KNOT_SPACING_PX = 0.25  # in the core; a cubic spline of this spacing passes 1 cy/px with an error of 1e-4
TAIL_GROWTH = 1.6  # ratio of neighbouring knot spacings outside the core: few knots, and the tail is smooth
TAIL_REACH_PX = 9.0
OUTER_ZONE_PX = 36.0  # beyond: levels, the tail's law and the illumination's gradient
# Of the prior of the line spread, in blur widths and in units of its envelope: by evidence
PRIOR_LENGTHS = (0.5, 1.2, 3.0)
PRIOR_STRENGTHS = (0.12, 0.25, 0.5, 1.0, 2.0, 4.0)
# Of the line spread's tail, amplitude / distance^2: 4 / (pi^3 cutoff) of a diffracting lens, px
FAR_AMPLITUDES_PX = (0.001, 0.1, 0.3)
GAUSSIAN_STD = (1.0, 1.0, 1.0, 0.1, 0.1)  # of the Gaussian part: its height, place, width, skewness, peakedness
WARP = 2.0  # blur widths from the edge, beyond which the correlation's length grows with the distance
LEAST_WEIGHT, LEAST_EVIDENCE = (
    0.01,
    4.0,
)  # of a prior that counts; how far, in logarithms, the evidence falls before the search ends
ENVELOPE_WIDTHS, ENVELOPE_FLOOR = 0.8, 1e-3  # over how many blur widths the estimate is averaged; its least value
FAR_PX = 150.0  # to where the profile is followed, by its law where there are no samples
FAR_LENGTH, FAR_ALIKE = 4.0, 0.98  # of the tail's correlation, in the distance's logarithm; between both sides
MOST_REACH_PX = 60.0
SMOOTHING = 1e-6  # of a knot's weight: bridges knots that no sample falls on; 1e-4 of the signal at 1 cy/px
EDGE_ORDER = 3
FEW_PHASES_PX, WIDEST_GAP_PX = 0.6, 1.02  # gaps between the samples' distances, of a quarter and of the whole edge
WIDEST_RISE = 0.65  # from 10 % to 90 %, of the room on either side
REFINED_PX = 6.0  # the samples within see the edge's place
CORE_PX, CORE_SIGMAS = 2.5, 3.0  # half-width of the core
PASSES = 3  # of the least squares: noise levels and gradients need the profile
NUMERICAL_FLOOR = 1e-6  # of the contrast: noise-free regions have weights too
LEAST_EDGE_PX, LEAST_ROOM_PX, MOST_EDGES = 40.0, 20.0, 24  # of the edges that are looked for in a frame
DEFAULT_FREQUENCY_CY_PER_PX: Array = np.arange(101) / 100.0


@dataclass(frozen=True)
class Spline:
    """Cubic spline over ascending `knot_px`, constant beyond the first and the last: the value there is the outer coefficient."""

    knot_px: Array

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return len(self.knot_px) + 2

    @property
    def _all_knots(self) -> Array:
        return np.concatenate([[self.knot_px[0]] * 3, self.knot_px, [self.knot_px[-1]] * 3])

    def design(self, distance_px: Array) -> sparse.csr_array:
        """(n, size) matrix from the coefficients to the values at `distance_px`."""
        inside = np.clip(distance_px, self.knot_px[0], self.knot_px[-1])
        return BSpline.design_matrix(inside, self._all_knots, 3)

    def slope(self, coefficients: Array, distance_px: Array) -> Array:
        """First derivative at `distance_px`, 0 beyond the ends."""
        value = BSpline(self._all_knots, coefficients, 3)(distance_px, nu=1, extrapolate=True)
        outside = (distance_px < self.knot_px[0]) | (distance_px > self.knot_px[-1])
        return np.where(outside, 0.0, value)

    @cached_property
    def pieces(self) -> Array:
        """(intervals, 4, 4): powers of t = 0..1 within an interval, lowest first, of the four basis functions there."""
        t = np.array([0.0, 1.0, 2.0, 3.0]) / 3.0
        at = self.knot_px[:-1, None] + t * np.diff(self.knot_px)[:, None]
        values = BSpline(self._all_knots, np.eye(self.size), 3)(np.minimum(at, self.knot_px[-1]).ravel())
        index = np.arange(len(at))[:, None, None] + np.arange(4)
        local = values.reshape(len(at), 4, self.size)[np.arange(len(at))[:, None, None], np.arange(4)[:, None], index]
        return np.asarray(np.linalg.inv(np.vander(t, increasing=True)) @ local)

    def roughness(self, strength: float) -> Array:
        """Penalty matrix of third differences, which bridges knots that no sample falls on."""
        differences = np.diff(np.eye(self.size), 3, axis=0)
        return np.asarray(strength * differences.T @ differences)

    def transfer_operator(self, frequency_cy_per_px: Array) -> NDArray[np.complex128]:
        """(frequencies, size) matrix from the coefficients to the Fourier transform of the derivative.

        Exact: between knots the derivative is a parabola in t = 0..1, whose transform is a sum of the moments of
        exp(-2 pi i f width t).
        """
        turn = -2j * np.pi * np.asarray(frequency_cy_per_px, dtype=float)[:, None]
        moments = _exponential_moments(turn * np.diff(self.knot_px)) * np.exp(turn * self.knot_px[:-1])
        out = np.zeros((len(turn), self.size), dtype=complex)
        slopes = self.pieces[:, 1:] * np.array([1.0, 2.0, 3.0])[:, None]  # of t, by t
        for basis in range(4):
            out[:, basis : basis + len(slopes)] += np.einsum("kfi,ik->fi", moments, slopes[:, :, basis])
        return out


def _exponential_moments(z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """(3, ...): integral over t = 0..1 of t^k exp(z t), k = 0, 1, 2; by series where |z| < 1, else by recursion."""
    out = np.empty((3, *z.shape), dtype=complex)
    far = np.abs(z) >= 1.0
    end = np.exp(z[far])
    out[0, far] = (end - 1.0) / z[far]
    out[1, far] = (end - out[0, far]) / z[far]
    out[2, far] = (end - 2.0 * out[1, far]) / z[far]
    small = z[~far]
    for k in range(3):
        term, total = np.ones_like(small), np.full_like(small, 1.0 / (k + 1))
        for n in range(1, 16):
            term = term * small / n
            total += term / (n + k + 1)
        out[k, ~far] = total
    return out


@dataclass(frozen=True)
class EdgeGeometry:
    """Where the samples lie with respect to the edge: all that the estimator needs to know besides the values.

    `edge_px`: coefficients of the edge's coordinate across, a polynomial in (along - centre) / half_length, in px of the full
    sensor; `transposed`: across is the row, else the column. `distance_px`: (n,) signed distance of every sample used,
    positive on the light side; `weight`: (n,) inverse variance of the (normalised) values; `spline`: the ESF's basis.
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
    gradients: Array  # (g, n): the illumination's gradient along and across, as seen at the samples
    normal: Array  # (k + g, k + g): from A^T W values to the solution; inverse of the normal matrix with its prior
    scatter: Array  # (k + g, k + g): its covariance over repeats, which the prior makes smaller
    gram: Array  # (k + g + 1, k + g + 1): A^T W A, A the spline's columns, the gradients and the values: all that the samples say

    @property
    def reach_px(self) -> float:
        """Largest distance from the edge of a sample that counts."""
        return float(np.abs(self.distance_px).max())

    @cached_property
    def basis(self) -> sparse.csr_array:
        """(n, k): the spline at the samples."""
        return self.spline.design(self.distance_px)

    def coefficients(self, values: Array) -> Array:
        """Least-squares spline coefficients (k,) of the ESF from values at the samples, (n,)."""
        weighted = values * self.weight
        right = np.concatenate([self.basis.T @ weighted, self.gradients @ weighted])
        return np.asarray(self.normal @ right)[: self.basis.shape[1]]

    def optical_transfer(self, coefficients: Array, frequency_cy_per_px: Array) -> NDArray[np.complex128]:
        """Complex transfer function of an ESF: 1 at frequency 0, phase about the edge."""
        step = coefficients[-1] - coefficients[0]
        return np.asarray(self.spline.transfer_operator(frequency_cy_per_px) @ coefficients / step)

    def predict(self, profile: Callable[[Array], Array], frequency_cy_per_px: ArrayLike) -> Array:
        """MTF that the estimator would report, at this very geometry, for a noise-free edge profile.

        `profile(distance_px)` gives the ESF at signed distances from the edge, rising towards positive distances; any two
        levels will do, and any shift, for the edge lies where the profile is half way. It is called once, on an even grid
        of 0.05 px.
        """
        reach = self.reach_px + 0.1
        count = int(np.ceil(reach / 0.05))
        grid = np.arange(-count, count + 1) * 0.05
        values = np.asarray(profile(grid), dtype=float)
        middle = _crossing(grid, (values - values[0]) / (values[-1] - values[0]))
        sampled = _interpolate(grid, values, self.distance_px + middle)
        otf = self.optical_transfer(self.coefficients(sampled), np.asarray(frequency_cy_per_px, dtype=float))
        return np.abs(otf)


@dataclass(frozen=True)
class EdgeMtf:
    """What one edge in one channel says.

    `mtf` is the modulus with the noise's share taken out; `covariance` is that of `mtf` over the frequencies. `otf` is the
    complex transfer function as it came out (phase about the edge). `esf` (0 on the dark side, 1 on the light one) and its
    derivative `lsf` (per px) are at `distance_px`. `residual_chi2_per_sample` is near 1 where the edge, the spline and the
    noise explain the region.
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
    planes: Sequence[Plane],
    frequency_cy_per_px: ArrayLike | None = None,
    noise_std: float | None = None,
    code: float = 0.0,
    frames: int = 1,
) -> EdgeMtf:
    """As `edge_mtf`, from one or more planes that see the same edge with the same blur (the two green ones).

    Each plane is levelled by itself, so that unequal gains don't matter. `code`: what values were rounded to multiples of before a mean
    of `frames` was taken. A dark side that spreads by less than that stands still, and is less sure than it looks.
    """
    frequency = (
        DEFAULT_FREQUENCY_CY_PER_PX if frequency_cy_per_px is None else np.asarray(frequency_cy_per_px, dtype=float)
    )
    if frequency.ndim != 1 or not np.isfinite(frequency).all() or (frequency < 0.0).any():
        raise ValueError("frequency_cy_per_px must be a list of finite frequencies that aren't negative")
    if noise_std is not None and not 0.0 < noise_std < np.inf:
        raise ValueError(f"noise_std = {noise_std} must be positive and finite; without it the residual says it")
    _refuse_unusable(planes)
    edge = _first_line(planes[0])
    widest = _reach(planes, edge)
    near = _Samples.near(planes, edge, min(max(16.0, 3.0 * planes[0].step), widest) + 8.0)
    edge = _refined(near, edge, widest)
    gap = _widest_gap(near, edge, np.ones(len(near.value), dtype=bool))
    if gap > WIDEST_GAP_PX:
        raise NotDetermined(
            "mtf",
            f"the samples lie {gap:.1f} px apart across the edge: turn the edge by 2 deg or more, or take a longer one",
        )
    return _measure(planes, near, edge, _reach(planes, edge), frequency, noise_std, _Codes(code, frames))


# --- samples and the edge -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Edge:
    """across = polynomial(along'), along' = (along - centre) / half_length; `sign` +1 where light is at larger across."""

    transposed: bool
    centre: tuple[float, float]
    half_length: float
    poly: Array
    sign: int

    @property
    def tilt(self) -> float:
        """Of the edge at its middle: px across a px along."""
        return float(self.poly[1]) / self.half_length

    def shifted(self, change: Array) -> _Edge:
        return _Edge(self.transposed, self.centre, self.half_length, self.poly + change, self.sign)

    def distance(self, along: Array, across: Array) -> tuple[Array, Array, Array]:
        """Signed distance from the curve, the foot's parameter, and the curve's slope there (two Newton steps)."""
        first = polynomial.polyder(self.poly) / self.half_length
        second = polynomial.polyder(first) / self.half_length
        foot = along
        if not self.poly[2:].any():  # a line: the foot in closed form
            gap = across - _horner(along, self.poly)
            slope = np.full_like(along, first[0])
            return (
                self.sign * gap / np.sqrt(1.0 + first[0] ** 2),
                along + gap * first[0] / (1.0 + first[0] ** 2) / self.half_length,
                slope,
            )
        for _ in range(2):
            gap = across - _horner(foot, self.poly)
            slope = _horner(foot, first)
            lag = (foot - along) * self.half_length - gap * slope
            foot = foot - lag / (1.0 + slope * slope - gap * _horner(foot, second)) / self.half_length
        slope = _horner(foot, first)
        gap = across - _horner(foot, self.poly)
        return self.sign * gap * np.sqrt(1.0 + slope * slope), foot, slope


def _horner(x: Array, coefficients: Array) -> Array:
    """Polynomial, lowest power first."""
    value = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value *= x
        value += c
    return value


@dataclass(frozen=True)
class _Samples:
    """Pixels of all planes near an edge, in the edge's own frame: `along` in half lengths, `across` in px."""

    along: Array
    across: Array
    value: Array
    plane: NDArray[np.int64]
    step: int
    count: int

    def where(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> _Samples:
        return _Samples(self.along[kept], self.across[kept], self.value[kept], self.plane[kept], self.step, self.count)

    @staticmethod
    def near(planes: Sequence[Plane], edge: _Edge, reach_px: float, every: int = 1) -> _Samples:
        """Those within `reach_px` of the edge; of every so manieth line across it only."""
        found = []
        band = reach_px * np.sqrt(1.0 + edge.tilt**2)
        for k, p in enumerate(planes):
            r = p.row0 + p.step * np.arange(p.values.shape[0], dtype=float) - edge.centre[0]
            c = p.col0 + p.step * np.arange(p.values.shape[1], dtype=float) - edge.centre[1]
            values = p.values
            if edge.transposed:
                r, c, values = c, r, values.T
            r, values = r[::every] / edge.half_length, values[::every]
            inside = np.abs(c - _horner(r, edge.poly)[:, None]) < band
            i, j = np.nonzero(inside)
            found.append((r[i], c[j], values[inside], np.full(len(i), k)))
        along, across, value, plane = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return _Samples(along, across, value, plane, planes[0].step, len(planes))


def _refuse_unusable(planes: Sequence[Plane]) -> None:
    if not planes or any(min(p.values.shape) * p.step < 16 or min(p.values.shape) < 8 for p in planes):
        raise NotDetermined("mtf", "the region is too small: at least 16 x 16 px (8 x 8 samples) are needed")
    bad = sum(int(np.count_nonzero(~np.isfinite(p.values))) for p in planes)
    if bad:
        raise NotDetermined("mtf", f"the region holds {bad} values that aren't finite: leave them out of the region")


@dataclass(frozen=True)
class _Placed:
    """Samples in the order of a spline's intervals, so that a sum over all of them is one small product an interval."""

    spline: Spline
    order: NDArray[np.int64]
    starts: NDArray[np.int64]  # (intervals + 1,)
    powers: Array  # (4, n) of the place within the interval, 0..1

    @staticmethod
    def of(spline: Spline, distance_px: Array) -> _Placed:
        knots = spline.knot_px
        inside = np.clip(distance_px, knots[0], knots[-1])
        interval = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
        order = np.argsort(interval.astype(np.int16), kind="stable")
        counts = np.bincount(interval, minlength=len(knots) - 1)
        starts = np.concatenate([[0], np.cumsum(counts)])
        t = (inside[order] - np.repeat(knots[:-1], counts)) / np.repeat(np.diff(knots), counts)
        powers = np.empty((4, len(t)))
        powers[0] = 1.0
        for k in (1, 2, 3):
            np.multiply(powers[k - 1], t, out=powers[k])
        return _Placed(spline, order, starts, powers)

    def _local(self, coefficients: Array) -> Array:
        """(4, intervals) powers of t of a spline."""
        windows = np.lib.stride_tricks.sliding_window_view(coefficients, 4)
        return np.einsum("ikl,il->ki", self.spline.pieces, windows)

    def values(self, coefficients: Array) -> Array:
        """A spline at the samples, (n,), in their new order."""
        counts, t = np.diff(self.starts), self.powers[1]
        value, *rest = (np.repeat(c, counts) for c in self._local(coefficients)[::-1])
        for c in rest:
            value *= t
            value += c
        return value

    def slopes(self, coefficients: Array) -> Array:
        """First derivative, per px."""
        counts = np.diff(self.starts)
        _, b, c, d = (np.repeat(k / np.diff(self.spline.knot_px), counts) for k in self._local(coefficients))
        return np.asarray(b + 2.0 * c * self.powers[1] + 3.0 * d * self.powers[2])

    def gram(self, columns: Array, weight: Array | None = None) -> Array:
        """A^T W A, A = the spline's columns and then `columns` (g, n): (size + g, size + g)."""
        size, extra = self.spline.size, len(columns)
        rows = np.concatenate([self.powers, columns])
        weighted = rows if weight is None else rows * weight
        bounds = zip(self.starts[:-1], self.starts[1:], strict=True)
        parts = np.array([weighted[:, start:stop] @ rows[:, start:stop].T for start, stop in bounds])
        pieces = self.spline.pieces
        core = pieces.transpose(0, 2, 1) @ parts[:, :4, :4] @ pieces
        cross = pieces.transpose(0, 2, 1) @ parts[:, :4, 4:]
        out = np.zeros((size + extra,) * 2)
        at = np.arange(len(parts))
        for k in range(4):
            out[at + k, size:] += cross[:, k]
            for other in range(4):
                out[at + k, at + other] += core[:, k, other]
        out[size:, :size] = out[:size, size:].T
        out[size:, size:] = parts[:, 4:, 4:].sum(axis=0)
        return out


def _first_line(plane: Plane) -> _Edge:
    """Straight edge from the gradients of the smoothed plane: their common direction, then their weighted line."""
    blocks = max(1, min(plane.values.shape) // 96)  # large regions are binned: the line need only be good to a pixel
    rows, cols = (n // blocks * blocks for n in plane.values.shape)
    binned = plane.values[:rows, :cols].reshape(rows // blocks, blocks, cols // blocks, blocks).mean(axis=(1, 3))
    smooth = ndimage.gaussian_filter(binned, 1.2, mode="nearest")
    g_row, g_col = (g[2:-2, 2:-2] for g in np.gradient(smooth))
    pitch = plane.step * blocks
    row, col = (np.indices(g_row.shape, dtype=float) + 2.0) * pitch + plane.step * (blocks - 1) / 2.0
    size = plane.step * np.array(plane.values.shape)
    row, col = row - (size[0] - plane.step) / 2.0, col - (size[1] - plane.step) / 2.0
    power = g_row**2 + g_col**2
    weight = np.square(np.clip(power - 3.0 * np.median(power), 0.0, None))  # the edge outshines a field of noise
    for _ in range(8):
        total = weight.sum()
        if not total > 0.0:
            raise NotDetermined("mtf", "no edge in the region: it is uniform")
        share = weight / total / np.maximum(power, 1e-300)
        angle = 0.5 * np.arctan2(2.0 * (share * g_row * g_col).sum(), (share * (g_row**2 - g_col**2)).sum())
        n_row, n_col = np.cos(angle), np.sin(angle)
        gap = row * n_row + col * n_col
        gap -= (weight * gap).sum() / total
        spread = np.sqrt((weight * gap**2).sum() / total)
        weight = np.where(np.abs(gap) < max(2.5 * spread, 3.0 * pitch), np.square(g_row * n_row + g_col * n_col), 0.0)
    total = weight.sum()
    if not total > 0.0:
        raise NotDetermined("mtf", "no edge in the region: its gradients don't line up")
    transposed = bool(abs(n_row) > abs(n_col))
    along, across = (col, row) if transposed else (row, col)
    mean_along, mean_across = (weight * along).sum() / total, (weight * across).sum() / total
    slope = -(n_col / n_row if transposed else n_row / n_col)
    half_length = float(size[1 if transposed else 0]) / 2.0
    poly = np.zeros(EDGE_ORDER + 1)
    poly[:2] = mean_across - slope * mean_along, slope * half_length
    sign = 1 if ((g_row if transposed else g_col) * weight).sum() > 0 else -1
    centre = (plane.row0 + (size[0] - plane.step) / 2.0, plane.col0 + (size[1] - plane.step) / 2.0)
    return _Edge(transposed, centre, half_length, poly, sign)


def _levelled(samples: _Samples, distance: Array, inner: float, outer: float) -> tuple[Array, float, float]:
    """Values with each plane's mean levels at `inner` < |distance| < `outer` mapped to 0 and 1; the mean levels in the input's unit."""
    value = np.empty_like(samples.value)
    dark_sum = light_sum = 0.0
    for k in range(samples.count):
        here = slice(None) if samples.count == 1 else samples.plane == k
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


def _refined(samples: _Samples, edge: _Edge, widest: float) -> _Edge:
    """The edge's polynomial by Gauss-Newton on the profile: v = E(d), dE/d(edge) = -E'(d); wide and coarse first."""
    chance = np.random.default_rng(0).random(len(samples.value))
    # An edge along the pixels' own rows or diagonals shows each quarter of itself few phases of the profile: a curve through
    # them could be anything, so a line it is
    quarters = [_widest_gap(samples, edge, np.abs(samples.along - at) < 0.25) for at in (-0.75, -0.25, 0.25, 0.75)]
    highest = EDGE_ORDER if max(quarters) < FEW_PHASES_PX else 1
    for reach, spacing, order in (
        (16.0, 1.0, 1),
        (12.0, 0.75, 2),
        (8.0, 0.5, 3),
        (REFINED_PX, 0.25, 3),
        (REFINED_PX, 0.25, 3),
        (REFINED_PX, 0.25, 3),
    ):
        terms = min(order, highest)
        limit = min(max(reach, 3.0 * samples.step), 0.8 * widest)
        tilt = np.sqrt(1.0 + edge.tilt**2)
        kept = np.flatnonzero(np.abs(samples.across - _horner(samples.along, edge.poly)) < limit * tilt)
        if spacing > 0.5 and len(kept) > 8000:  # coarse steps need few samples
            kept = kept[chance[kept] < 8000.0 / len(kept)]
        part = samples.where(kept)
        distance, foot, slope = edge.distance(part.along, part.across)
        value, _, _ = _levelled(part, distance, 0.6 * limit, 1.5 * limit)
        count = int(np.ceil(limit / spacing))
        spline = Spline(np.arange(-count, count + 1) * (limit / count))
        placed = _Placed.of(spline, distance)
        distance, foot, slope, value = (x[placed.order] for x in (distance, foot, slope, value))
        gram = placed.gram(value[None])
        normal = gram[:-1, :-1]
        esf = np.linalg.solve(normal + spline.roughness(1e-4 * np.trace(normal) / spline.size), gram[:-1, -1])
        profile = placed.values(esf)
        residual = value - profile
        # d(distance) / d(edge) = -sign / sqrt(1 + slope^2)
        response = -edge.sign * placed.slopes(esf) / np.sqrt(1.0 + slope * slope)
        columns = np.concatenate(
            [
                response * _powers(foot, terms),
                # uneven illumination would else pull the edge
                _gradients(distance, foot * edge.half_length, np.clip(profile, 0.0, 1.0), room=True),
            ]
        )
        inlier = np.abs(residual) < 5.0 * np.sqrt(np.mean(residual**2)) + 1e-9
        kept_columns = columns * inlier
        change = np.linalg.lstsq(kept_columns @ columns.T, kept_columns @ residual, rcond=1e-10)[0][: terms + 1]
        # A free profile can be shifted against a free edge: the edge is where the profile is half way.
        grid = np.linspace(-limit, limit, 401)
        offset = _crossing(grid, spline.design(grid) @ (esf - esf[0]) / (esf[-1] - esf[0]))
        change[0] = edge.sign * offset * tilt
        change = np.clip(change, -0.25 * limit, 0.25 * limit)
        edge = edge.shifted(np.concatenate([change, np.zeros(EDGE_ORDER - terms)]))
    return edge


def _widest_gap(samples: _Samples, edge: _Edge, part: NDArray[np.bool_]) -> float:
    """Between neighbouring distances from the edge, within 3 px of it, of some of the samples; px."""
    distance, _, _ = edge.distance(samples.along[part], samples.across[part])
    return float(np.diff(np.sort(np.append(distance[np.abs(distance) < 3.0], [-3.0, 3.0]))).max())


def _powers(x: Array, order: int) -> Array:
    """(order + 1, n): 1, x, x^2, ..."""
    rows = np.empty((order + 1, len(x)))
    rows[0] = 1.0
    for k in range(order):
        np.multiply(rows[k], x, out=rows[k + 1])
    return rows


def _crossing(distance: Array, rising: Array) -> float:
    """Distance at which a profile between 0 and 1 crosses one half, the crossing nearest to 0."""
    i = np.flatnonzero((rising[:-1] < 0.5) & (rising[1:] >= 0.5))
    if not len(i):
        return 0.0
    at = distance[i] + (0.5 - rising[i]) / (rising[i + 1] - rising[i]) * (distance[i + 1] - distance[i])
    return float(at[np.argmin(np.abs(at))])


def _reach(planes: Sequence[Plane], edge: _Edge) -> float:
    """Distance from the edge, 60 px at most, up to which, on both sides, at least half as many samples lie as beside it."""
    every = max(1, min(planes[0].values.shape) // 64)
    samples = _Samples.near(planes, edge, MOST_REACH_PX + 4.0 * planes[0].step, every)
    slope = _horner(samples.along, polynomial.polyder(edge.poly)) / edge.half_length
    distance = (samples.across - _horner(samples.along, edge.poly)) / np.sqrt(1.0 + slope**2)
    width = 2.0 * samples.step
    bins = int(MOST_REACH_PX / width) + 1
    at = np.floor(distance / width + 0.5).astype(int) + bins
    count = np.bincount(at[(at >= 0) & (at <= 2 * bins)], minlength=2 * bins + 1)
    enough = count >= 0.5 * max(float(count[bins - 1 : bins + 2].mean()), 1.0)
    right, left = np.flatnonzero(~enough[bins:]), np.flatnonzero(~enough[: bins + 1][::-1])
    steps = min(right[0] if len(right) else bins + 1, left[0] if len(left) else bins + 1)
    reach = min((float(steps) - 0.5) * width, MOST_REACH_PX)
    if reach < 4.0:
        raise NotDetermined(
            "mtf",
            f"only {max(reach, 0.0):.0f} px beside the edge: place the region so that at least 4 px lie on both sides",
        )
    return reach


# --- the measurement -------------------------------------------------------------------------------------------------------


def _interpolate(grid: Array, values: Array, at: Array) -> Array:
    """Cubic (Catmull-Rom) interpolation on an even grid: error of order 4 where plain linear would smear."""
    step = grid[1] - grid[0]
    position = np.clip((at - grid[0]) / step, 1.0, len(grid) - 2.001)
    i = position.astype(np.int64)
    t = position - i
    a, b, c, d = values[i - 1], values[i], values[i + 1], values[i + 2 - (i + 2 >= len(grid))]
    return np.asarray(b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))))


def _knots(width: float, reach: float, step: int) -> Array:
    """Even knots in the core of half-width `width`, then wider and wider ones, out to where no sample is needed any more."""
    core = min(width, max(reach - 2.0 * step, 2.0))
    count = max(int(np.ceil(core / KNOT_SPACING_PX)), 6)
    side = list(np.arange(count + 1) * KNOT_SPACING_PX)
    spacing = KNOT_SPACING_PX
    while side[-1] < FAR_PX:
        spacing *= TAIL_GROWTH
        side.append(side[-1] + spacing)
    positive = np.array(side)
    return np.concatenate([-positive[:0:-1], positive])


@dataclass(frozen=True)
class _Codes:
    """Values that were rounded to multiples of `size` (their unit; 0: not at all), and then averaged over frames."""

    size: float
    frames: int

    def std(self, std: float) -> float:
        """A scatter with the error of rounding."""
        if not self.size:
            return std
        return float(np.hypot(std, self.size * rounding_std_dn(self.frames * (std / self.size) ** 2)))

    def covariance(self, geometry: EdgeGeometry, level: Array, variance: Array) -> Array:
        """Of the spline's coefficients, by what no repeats take out: of values that scatter by `variance` about `level`, (n,)."""
        out = np.zeros((geometry.spline.size,) * 2)
        if self.size:
            spread = unrounded(np.asarray(self.frames * variance / self.size**2, float))
            for wave in rounding_waves_dn(np.asarray(level / self.size, float), spread):
                change = self.size * geometry.coefficients(wave)
                out += np.outer(change, change)
        return out


def _measure(
    planes: Sequence[Plane],
    near: _Samples,
    edge: _Edge,
    reach: float,
    frequency: Array,
    noise_std: float | None,
    codes: _Codes,
) -> EdgeMtf:
    distance, _, _ = edge.distance(near.along, near.across)
    width = _blur_width(near, distance, min(12.0, reach))
    core = CORE_PX + CORE_SIGMAS * width
    outer = min(reach, core + TAIL_REACH_PX + OUTER_ZONE_PX)
    room = outer > core + TAIL_REACH_PX + 8.0 * near.step
    samples = _Samples.near(planes, edge, 1.05 * outer + 2.0)
    distance, foot, _ = edge.distance(samples.along, samples.across)
    kept = np.abs(distance) < outer
    samples, distance, foot = samples.where(kept), distance[kept], foot[kept]
    inner = min(0.6 * outer, core + TAIL_REACH_PX)
    value, dark_level, light_level = _levelled(samples, distance, inner, outer)
    contrast = light_level - dark_level
    offset = max(dark_level, 0.0) / contrast  # the illumination's gradient acts on the dark side's light too

    spline = Spline(_knots(core, reach, near.step))
    size = spline.size
    placed = _Placed.of(spline, distance)
    distance, foot, value = distance[placed.order], foot[placed.order], value[placed.order]
    dark_tail, light_tail = distance < -0.5 * inner, distance > 0.5 * inner
    variance = np.ones_like(value)
    used = np.ones(len(value), dtype=bool)
    esf = np.clip(0.5 + distance, 0.0, 1.0)
    start, solution = (1, 1, 3, 0), np.zeros(size)
    for turn in range(PASSES):
        weight = np.where(used, 1.0 / variance, 0.0)
        gradients = _gradients(distance, foot * edge.half_length, esf + offset, room)
        gram = placed.gram(np.concatenate([gradients, value[None]]), weight)
        matrix, right = gram[:-1, :-1], gram[:-1, -1]
        if turn == 0:
            bridged = matrix.copy()
            bridged[:size, :size] += spline.roughness(SMOOTHING * np.trace(matrix[:size, :size]) / size)
            normal = np.linalg.inv(bridged)
        else:
            priors = _Priors.of(spline, solution[:size], width, outer)
            normal, covariance, start = _under_priors(
                priors, matrix, right, start, LEAST_EVIDENCE if turn == PASSES - 1 else 0.0
            )
        solution = normal @ right
        esf = placed.values(solution[:size])
        residual = value - esf - solution[size:] @ gradients
        if noise_std is None:
            std_dark, std_light = (
                codes.std(contrast * _robust_std(residual[tail], codes.size / contrast)) / contrast
                for tail in (dark_tail, light_tail)
            )
        else:
            std_dark = std_light = noise_std / contrast
        variance = std_dark**2 + np.clip(esf, 0.0, 1.0) * (std_light**2 - std_dark**2) + NUMERICAL_FLOOR**2
        used = np.abs(residual) < 6.0 * np.sqrt(variance) + 0.02
    _refuse_unless_one_edge(residual, dark_tail | light_tail, max(std_dark, std_light), float(np.mean(~used)))
    _refuse_too_wide(spline, solution[:size], outer)
    _refuse_clipped(samples.value[placed.order][light_tail], std_dark * contrast, contrast)

    geometry = EdgeGeometry(
        angle_deg=_angle_deg(edge.tilt, edge.transposed),
        angle_deg_std=_angle_deg_std(placed.slopes(solution[:size]), distance, foot, variance, gradients, edge),
        transposed=edge.transposed,
        edge_px=tuple(float(c) for c in edge.poly),
        centre_px=edge.centre,
        half_length_px=edge.half_length,
        distance_px=distance,
        weight=weight,
        spline=spline,
        gradients=gradients,
        normal=normal,
        scatter=normal @ gram[:-1, :-1] @ normal,
        gram=gram,
    )
    covariance[:size, :size] += (
        codes.covariance(geometry, (esf + offset) * contrast, variance * contrast**2) / contrast**2
    )
    freedom = max(np.count_nonzero(used) - len(solution) - len(edge.poly), 1)
    return _described(
        geometry,
        solution[:size],
        covariance[:size, :size],
        frequency,
        levels=(dark_level, light_level),
        noise=(std_dark * contrast, std_light * contrast),
        chi2=float((weight * residual**2).sum() / freedom),
    )


def _under_priors(
    priors: _Priors, matrix: Array, right: Array, start: _Point, least_evidence: float
) -> tuple[Array, Array, _Point]:
    """Inverse of the normal matrix under the line spread's prior, (k + g, k + g); the covariance of the solution about the
    truth; and the best of the priors, the search for which begins at `start` (`_weighed`).

    The line spread's mass between knots is the sum of three: a Gaussian of free height, place and width, a little skew and
    peaked; near it a Gaussian process, envelope x correlation x envelope, the envelope from the estimate itself, smoother the
    farther from the edge; and far from it amplitude / distance^2, as any aperture diffracts, much alike on both sides, which
    carries what is seen of the tail to beyond the samples (a diffraction-limited profile has 1 % of its contrast there).
    The process's smoothness, length and strength and the tail's amplitude are averaged over by evidence, not chosen: where
    several explain the data the solution lies between theirs, and the covariance holds how far they differ. Nothing is said
    of levels and gradients.
    """
    masses = len(priors.envelope)
    size = masses + 1
    free = 1 + len(matrix) - size
    # Unknowns: the dark level, the gradients, the masses
    turn = np.zeros((len(matrix), len(matrix)))
    turn[:size, 0] = 1.0
    turn[size:, 1:free] = np.eye(free - 1)
    turn[:size, free:] = np.tril(np.ones((size, masses)), -1)
    turned, turned_right = turn.T @ matrix @ turn, turn.T @ right
    free_covariance = np.linalg.inv(turned[:free, :free])
    pull = free_covariance @ turned[:free, free:]
    power, waves = np.linalg.eigh(turned[free:, free:] - turned[free:, :free] @ pull)
    seen = power > 1e-14 * power[-1]
    pulled_right = turned_right[free:] - pull.T @ turned_right[:free]
    # What the data say of the masses, with unit noise: data = eye @ masses + noise
    eye = np.sqrt(power[seen])[:, None] * waves[:, seen].T
    data = waves[:, seen].T @ pulled_right / np.sqrt(power[seen])

    weights, best = _weighed(priors, eye, data, start, least_evidence)
    information = eye.T @ eye
    posterior = np.zeros((masses, masses))
    means = []
    for at, weight in weights.items():
        root = _root(priors.at(at))
        inner = root.T @ information @ root
        inner[np.diag_indices_from(inner)] += 1.0
        factor, _ = linalg.lapack.dpotrf(inner, lower=1)
        half, _ = linalg.lapack.dtrtrs(factor, root.T, lower=1)
        one = half.T @ half
        posterior += weight * one
        means.append(one @ pulled_right)
    shares = np.array(list(weights.values()))
    apart = (np.array(means) - shares @ np.array(means)) * np.sqrt(shares)[:, None]
    whole = turn @ np.concatenate([-pull, np.eye(masses)])
    normal = whole @ posterior @ whole.T + turn[:, :free] @ free_covariance @ turn[:, :free].T
    apart = apart @ whole.T
    return normal, normal + apart.T @ apart, best


def _weighed(
    priors: _Priors, eye: Array, data: Array, start: _Point, least_evidence: float
) -> tuple[dict[_Point, float], _Point]:
    """The evidence's share of every prior that counts, and the best of them; data = eye @ masses + unit noise.

    Uphill on the grid of priors from `start`, then around the summit as far as the evidence is within `least_evidence`.
    """
    fixed, far = (eye @ part @ eye.T for part in (priors.gaussian, priors.tails))
    near: dict[tuple[int, int], Array] = {}
    tried: dict[_Point, float] = {}

    def evidence(at: _Point) -> float:
        """Its logarithm, but for a constant."""
        if not all(0 <= i < count for i, count in zip(at, _PRIOR_GRID, strict=True)):
            return -np.inf
        if at not in tried:
            kind, length, strength, amplitude = at
            if (kind, length) not in near:
                near[kind, length] = eye @ priors.near(kind, length) @ eye.T
            spread = (
                PRIOR_STRENGTHS[strength] ** 2 * near[kind, length] + FAR_AMPLITUDES_PX[amplitude] ** 2 * far + fixed
            )
            spread[np.diag_indices_from(spread)] += 1.0
            factor, _ = linalg.lapack.dpotrf(spread, lower=1)
            white, _ = linalg.lapack.dtrtrs(factor, data, lower=1)
            tried[at] = float(-0.5 * white @ white - np.log(np.diag(factor)).sum())
        return tried[at]

    best = start
    while True:
        uphill = max(_beside(best), key=evidence)
        if evidence(uphill) <= evidence(best):
            break
        best = uphill
    candidates, waiting = {best}, [best]
    while waiting:
        for at in _beside(waiting.pop()):
            if at not in candidates and evidence(at) > evidence(best) - least_evidence:
                candidates.add(at)
                waiting.append(at)
    top = max(evidence(at) for at in candidates)
    weights = {at: float(np.exp(evidence(at) - top)) for at in candidates}
    least = LEAST_WEIGHT * sum(weights.values())
    total = sum(weight for weight in weights.values() if weight > least)
    return {at: weight / total for at, weight in weights.items() if weight > least}, best


def _root(covariance: Array) -> Array:
    """R with covariance R R^T."""
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    correlation[np.diag_indices_from(correlation)] += 1e-12
    factor, _ = linalg.lapack.dpotrf(correlation, lower=1, clean=1)
    return np.asarray(scale[:, None] * factor)


@dataclass(frozen=True)
class _Priors:
    """Covariances of the line spread's masses between knots: `gaussian`, `tails`, and `near` at a point of the grid."""

    envelope: Array
    warped: Array  # distance in blur widths, pressed together far from the edge
    gaussian: Array
    tails: Array

    @staticmethod
    def of(spline: Spline, coefficients: Array, width: float, reach: float) -> _Priors:
        knots = np.concatenate([[spline.knot_px[0]] * 2, spline.knot_px, [spline.knot_px[-1]] * 2])
        place = (knots[:-2] + knots[1:-1] + knots[2:]) / 3.0
        at, pitch = 0.5 * (place[1:] + place[:-1]), np.diff(place)
        scale = max(width, KNOT_SPACING_PX)
        density = np.where(np.abs(at) < reach, np.diff(coefficients) / pitch, 0.0)
        share = pitch * np.exp(-0.5 * ((at[:, None] - at) / (ENVELOPE_WIDTHS * scale)) ** 2)
        local = np.abs(share @ density) / share.sum(axis=1)
        decay = 1.0 / (1.0 + (at / (4.0 * scale)) ** 2)
        envelope = pitch * np.maximum(local * (np.abs(at) < 0.5 * reach), ENVELOPE_FLOOR * local.max() * decay)

        x = place / scale
        bell = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
        shapes = np.stack([special.ndtr(x), bell, x * bell, (x * x - 1.0) * bell, (x**3 - 3.0 * x) * bell])
        columns = np.diff(np.linalg.solve(spline.design(place).toarray(), shapes.T), axis=0) * np.array(GAUSSIAN_STD)

        side = np.where(np.sign(at)[:, None] == np.sign(at), 1.0, FAR_ALIKE)
        order = np.log(np.maximum(np.abs(at), 1.0))
        far = pitch * at**2 / (at**2 + (3.0 * scale) ** 2) / np.maximum(at**2, 1e-6)
        return _Priors(
            envelope=envelope,
            warped=WARP * np.arcsinh(at / (WARP * scale)),
            gaussian=columns @ columns.T,
            tails=np.outer(far, far) * side * _matern_3(np.abs(order[:, None] - order) / FAR_LENGTH),
        )

    def near(self, kind: int, length: int) -> Array:
        """The process about the Gaussian, of unit strength."""
        apart = np.abs(self.warped[:, None] - self.warped) / PRIOR_LENGTHS[length]
        return np.outer(self.envelope, self.envelope) * _CORRELATIONS[kind](apart)

    def at(self, point: _Point) -> Array:
        """All of it, at a point of the grid."""
        kind, length, strength, amplitude = point
        near = PRIOR_STRENGTHS[strength] ** 2 * self.near(kind, length)
        return near + FAR_AMPLITUDES_PX[amplitude] ** 2 * self.tails + self.gaussian


def _beside(at: _Point) -> list[_Point]:
    """Neighbours on the grid of priors."""
    kind, length, strength, amplitude = at
    return [
        (kind + i, length + j, strength + k, amplitude + m)
        for i, j, k, m in (*np.eye(4, dtype=int).tolist(), *(-np.eye(4, dtype=int)).tolist())
    ]


def _matern_3(apart: Array) -> Array:
    """Correlation (Matern 3/2) at distances in units of its length: once differentiable, so that kinks are no surprise."""
    return np.asarray((1.0 + np.sqrt(3.0) * apart) * np.exp(-np.sqrt(3.0) * apart))


def _matern_5(apart: Array) -> Array:
    """The same of a smoother process, twice differentiable."""
    return np.asarray((1.0 + np.sqrt(5.0) * apart + 5.0 / 3.0 * apart * apart) * np.exp(-np.sqrt(5.0) * apart))


_CORRELATIONS = (_matern_3, _matern_5)
_PRIOR_GRID = (len(_CORRELATIONS), len(PRIOR_LENGTHS), len(PRIOR_STRENGTHS), len(FAR_AMPLITUDES_PX))


def _described(
    geometry: EdgeGeometry,
    esf: Array,
    covariance_of_esf: Array,
    frequency: Array,
    *,
    levels: tuple[float, float],
    noise: tuple[float, float],
    chi2: float,
) -> EdgeMtf:
    """Transfer function, its covariance and MTF50 of the ESF's coefficients."""
    spline = geometry.spline
    otf, slopes = _transfer_and_slopes(geometry, esf, frequency)
    across = np.abs(otf)
    phase = np.where(across > 0, otf / np.maximum(across, 1e-300), 1.0)
    turned = slopes * phase.conj()[:, None]
    along_slopes, aside_slopes = turned.real, turned.imag
    covariance = along_slopes @ covariance_of_esf @ along_slopes.T
    aside = np.einsum("fi,fi->f", aside_slopes @ covariance_of_esf, aside_slopes)
    along = np.clip(np.diag(covariance), 0.0, None)
    # E|F + n|^2 = |F|^2 + var: what lies across F counts always, what lies along it only where there is no F to speak of
    power = across**2
    excess = aside + along**2 / np.maximum(along + power, 1e-300)
    # ... and where even that leaves a floor, the last term brings it down; it is of fourth order where F stands out
    mtf = np.sqrt(np.clip(power - excess - excess**2 / np.maximum(power, 1e-300), 0.0, None))

    (mtf50, mtf50_std), (mtf10, mtf10_std) = _falls_to(geometry, esf, covariance_of_esf, (0.5, 0.1))
    step = esf[-1] - esf[0]
    count = int(geometry.reach_px / 0.125)
    distance = np.arange(-count, count + 1) * 0.125
    return EdgeMtf(
        frequency_cy_per_px=frequency,
        mtf=mtf,
        mtf_std=np.sqrt(along),
        covariance=covariance,
        otf=otf,
        mtf50_cy_per_px=mtf50,
        mtf50_cy_per_px_std=mtf50_std,
        mtf10_cy_per_px=mtf10,
        mtf10_cy_per_px_std=mtf10_std,
        angle_deg=geometry.angle_deg,
        angle_deg_std=geometry.angle_deg_std,
        distance_px=distance,
        esf=(spline.design(distance) @ esf - esf[0]) / step,
        lsf=spline.slope(esf, distance) / step,
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
    """Transfer function and its derivatives by the ESF's coefficients, (frequencies, size)."""
    operator = geometry.spline.transfer_operator(frequency)
    step = esf[-1] - esf[0]
    otf = np.asarray(operator @ esf / step)
    slopes = operator / step
    slopes[:, -1] -= otf / step
    slopes[:, 0] += otf / step
    return otf, slopes


def _falls_to(
    geometry: EdgeGeometry, esf: Array, covariance: Array, levels: Sequence[float]
) -> list[tuple[float | None, float | None]]:
    """First frequency at which the MTF falls to each level, with its uncertainty; None where it doesn't up to 1.5 cy/px, or
    where the curve there is no higher than its noise."""
    grid = 1.5 * (np.arange(2, 81) / 80.0) ** 2
    mtf = np.abs(geometry.optical_transfer(esf, grid))
    # the first of the grid below each level; 0 where the curve doesn't fall so far
    first = [int(np.argmax(mtf < level)) for level in levels]
    spans = np.array([np.linspace(grid[k - 1], grid[k], 9) for k in first if k])
    if not len(spans):
        return [(None, None) for _ in levels]
    curves = np.abs(geometry.optical_transfer(esf, spans.ravel())).reshape(spans.shape)
    fallen = [level for level, k in zip(levels, first, strict=True) if k]
    # smooth between the grid's points: by a spline through nine
    splines = [CubicSpline(span, curve - level) for span, curve, level in zip(spans, curves, fallen, strict=True)]
    crossings = np.array([float(f.roots(extrapolate=False)[0]) for f in splines])
    otf, slopes = _transfer_and_slopes(geometry, esf, crossings)
    by_esf = (slopes * (otf.conj() / np.abs(otf))[:, None]).real
    stds = np.sqrt(np.einsum("fi,fi->f", by_esf @ covariance, by_esf))
    found = {
        level: (float(at), float(std / abs(f(at, 1))))
        for level, at, std, f in zip(fallen, crossings, stds, splines, strict=True)
        if std < 0.3 * level
    }
    return [found.get(level, (None, None)) for level in levels]


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
    spline = Spline(np.arange(-count, count + 1) * reach / count)
    placed = _Placed.of(spline, distance[kept])
    gram = placed.gram(value[placed.order][None])
    normal = gram[:-1, :-1]
    coefficients = np.linalg.solve(normal + spline.roughness(1e-3 * np.trace(normal) / spline.size), gram[:-1, -1])
    fine = np.linspace(-reach, reach, 16 * count + 1)
    esf = spline.design(fine) @ coefficients
    low, high = fine[esf < 0.1], fine[esf > 0.9]
    first = low[low < 0].max(initial=-reach)
    last = high[high > 0].min(initial=reach)
    return float(np.clip((last - first) / 2.563, 0.2, reach / 3.0))


def _robust_std(residual: Array, code: float = 0.0) -> float:
    """Standard deviation without outliers: 1.4826 times the median of the modulus, then clipped at 4 sigma. Of values rounded to
    multiples of `code` most may be alike, and those of the next code aren't outliers."""
    rough = max(1.4826 * float(np.median(np.abs(residual))), 0.5 * code)
    kept = residual[np.abs(residual) <= 4.0 * rough + 1e-12]
    return float(np.sqrt(np.mean(kept**2)))


def _refuse_unless_one_edge(residual: Array, tail: NDArray[np.bool_], std: float, outliers: float) -> None:
    if std > 1.0:
        raise NotDetermined("mtf", f"no edge in the region: the contrast is only {1.0 / std:.2f} of the noise")
    spread = float(np.sqrt(np.mean(residual[tail] ** 2)))
    local = _robust_std(np.diff(residual[tail])) / np.sqrt(2.0)
    if spread > max(0.12, 3.0 * local) or outliers > 0.03:
        raise NotDetermined("mtf", "the region holds more than one edge: narrow it down to a single one")


def _refuse_too_wide(spline: Spline, coefficients: Array, reach: float) -> None:
    """Levels that the profile hasn't reached within the region are nobody's."""
    at = np.linspace(-reach, reach, 201)
    esf = spline.design(at) @ coefficients
    rise = float(np.count_nonzero((esf > 0.1) & (esf < 0.9)) * (at[1] - at[0]))
    if rise > WIDEST_RISE * reach:
        raise NotDetermined(
            "mtf",
            f"the edge takes {rise:.0f} px from 10 % to 90 %, with only {reach:.0f} px beside it: widen the region",
        )


def _refuse_clipped(light: Array, noise_std: float, contrast: float) -> None:
    """A light side that stands still at its highest value although there is noise has met the converter's end."""
    values = np.unique(light)
    step = float(np.diff(values).min()) if len(values) > 1 else 0.0
    if noise_std > max(0.7 * step, 1e-4 * contrast) and float(np.mean(light == values[-1])) > 0.2:
        raise NotDetermined("mtf", f"the edge's light side is clipped at {values[-1]:g}: expose it shorter")


def _angle_deg(slope: float, transposed: bool) -> float:
    """From the vertical, positive where the top turns to the right; -90 < angle <= 90."""
    row, col = (slope, 1.0) if transposed else (1.0, slope)
    angle = float(np.degrees(np.arctan2(col, -row)))
    return angle - 180.0 * np.ceil((angle - 90.0) / 180.0)


def _angle_deg_std(
    steepness: Array, distance: Array, foot: Array, variance: Array, gradients: Array, edge: _Edge
) -> float:
    """Of the least squares without weights that found the edge's polynomial (`_refined`), given the noise's variances."""
    near = np.abs(distance) < REFINED_PX
    columns = np.concatenate(
        [steepness[near] / np.sqrt(1.0 + edge.tilt**2) * _powers(foot[near], EDGE_ORDER), gradients[:, near]]
    )
    inverse = np.linalg.pinv(columns @ columns.T, hermitian=True)
    covariance = inverse @ ((columns * variance[near]) @ columns.T) @ inverse
    return float(np.degrees(np.sqrt(covariance[1, 1]) / edge.half_length / (1.0 + edge.tilt**2)))


# --- recordings ------------------------------------------------------------------------------------------------------------


def region_planes(
    frame: NDArray[np.generic], region: Region, cfa: Cfa, channel: str, black_level_dn: float
) -> list[Plane]:
    """The channel's planes (two green ones) within `region` of a raw frame, DN above black, at their sensor coordinates."""
    row0, col0, row1, col1 = region
    step = period(cfa)
    found = []
    for first_row, first_col in phases(cfa)[channel]:
        r, c = row0 + (first_row - row0) % step, col0 + (first_col - col0) % step
        found.append(Plane(frame[r:row1:step, c:col1:step].astype(float) - black_level_dn, r, c, step))
    return found


@dataclass(frozen=True)
class FoundEdge:
    """An edge that `find_edges` found: a region around its middle (row0, col0, row1, col1), its angle and its length."""

    region: Region
    angle_deg: float
    length_px: float


def find_edges(frame: ArrayLike, cfa: Cfa = "MONO", saturation_dn: float | None = None) -> tuple[FoundEdge, ...]:
    """Edges of a raw frame from which an MTF can be taken, the longest first, none twice.

    Line segments (LSD) of the frame binned to a channel's pitch; around the middle of each a region is laid that holds no
    other edge, and kept where both sides are uniform, unsaturated, and the MTF of the green (or only) channel can be had.
    Raises `NotDetermined` where none is left, with the nearest miss.
    """
    values = np.asarray(frame, dtype=float)
    if values.ndim != 2 or not np.isfinite(values).all():
        raise NotDetermined("mtf", "the frame has to be two-dimensional and finite to find edges in it")
    step = period(cfa)
    rows, cols = (n // step * step for n in values.shape)
    binned = values[:rows, :cols].reshape(rows // step, step, cols // step, step).mean(axis=(1, 3))
    low, high = np.quantile(binned, [0.002, 0.998])
    if not high > low:
        raise NotDetermined("mtf", "no edge found in the frame: it is uniform")
    picture = ndimage.gaussian_filter(np.clip((binned - low) / (high - low), 0.0, 1.0), 1.0)
    lines = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(np.rint(255.0 * picture).astype(np.uint8))[0]
    found: list[FoundEdge] = []
    reason = "no straight line of 40 px or more stands out"
    segments = np.empty((0, 4)) if lines is None else lines.reshape(-1, 4) * step
    lengths = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    for index in np.argsort(-lengths):
        if lengths[index] < LEAST_EDGE_PX or len(found) == MOST_EDGES:
            break
        x0, y0, x1, y1 = segments[index]
        middle, along = (
            (0.5 * (y0 + y1), 0.5 * (x0 + x1)),
            (np.array([y1 - y0, x1 - x0]) / lengths[index]),
        )
        if any(
            abs((middle[0] - 0.5 * (r0 + r1)) * along[1] - (middle[1] - 0.5 * (c0 + c1)) * along[0]) < LEAST_ROOM_PX
            and max(abs(middle[0] - 0.5 * (r0 + r1)), abs(middle[1] - 0.5 * (c0 + c1))) < 0.75 * max(r1 - r0, c1 - c0)
            for r0, c0, r1, c1 in (f.region for f in found)
        ):
            continue
        for share in (0.9, 0.7, 0.5):
            half = 0.5 * share * lengths[index] * np.abs(along)
            if min(2.0 * half.max(), 2.0 * half.max()) < 0.6 * LEAST_EDGE_PX:
                break
            # room across, but not so much that the next side of a square comes into the region
            room = np.maximum(half, np.minimum(LEAST_ROOM_PX + half.min(), 0.47 * lengths[index] * np.abs(along).max()))
            start = np.maximum(np.ceil(np.array(middle) - room), 0).astype(int)
            stop = np.minimum(np.floor(np.array(middle) + room) + 1, values.shape).astype(int)
            region = (int(start[0]), int(start[1]), int(stop[0]), int(stop[1]))
            part = values[start[0] : stop[0], start[1] : stop[1]]
            if saturation_dn is not None and np.mean(part >= saturation_dn) > 0.002:
                reason = f"the edge at row {middle[0]:.0f}, column {middle[1]:.0f} is saturated; expose it shorter"
                continue
            try:
                planes = region_planes(values, region, cfa, "Y" if cfa == "MONO" else "G", 0.0)
                edge = planes_mtf(planes, np.array([0.1, 0.25]))
            except NotDetermined as refused:
                reason = f"at row {middle[0]:.0f}, column {middle[1]:.0f}: {refused.reason}"
                continue
            noise = max(edge.noise_std_dark, edge.noise_std_light)
            contrast = edge.light_level - edge.dark_level
            if edge.residual_chi2_per_sample > 2.0 or noise > 0.1 * contrast or contrast < 0.05 * (high - low):
                reason = (
                    f"what lies at row {middle[0]:.0f}, column {middle[1]:.0f} isn't one edge between two even fields"
                )
                continue
            found.append(FoundEdge(region, edge.angle_deg, float(share * lengths[index])))
            break
    if not found:
        raise NotDetermined("mtf", f"no edge found in the frame: {reason}")
    return tuple(found)


def measure_edge(
    recordings: RecordingSet,
    captures: Sequence[SlantedEdge],
    channel: str,
    noise: NoiseFit | None = None,
    frequency_cy_per_px: ArrayLike | None = None,
    region: Region | None = None,
) -> EdgeMtf:
    """MTF of one slanted edge in one channel; `captures` are repeats of the same settings, averaged before the analysis.

    The edge is the one in `region`: the capture's own where it isn't given, and the longest that `find_edges` finds where the
    capture names none. The noise is what is left between the frame and the fitted edge, so that it holds the photo response
    non-uniformity, which repeats don't average out. Raises `NotDetermined` where the light side is saturated or the region
    holds no edge.
    """
    first = captures[0]
    camera = recordings.camera(first.side)
    black = noise.black_level_dn if noise is not None and noise.black_level_dn is not None else camera.black_level_dn
    if black is None:
        raise NotDetermined("mtf", "the black level is neither fitted nor stated: add dark frames")
    frames = [recordings.frame(c) for c in captures]
    row0, col0, row1, col1 = region = region or first.region or _found(recordings, first)[0].region
    saturated = float(np.mean(frames[0][row0:row1, col0:col1] >= camera.saturation_dn))
    if saturated > 0.002:
        raise NotDetermined("mtf", f"{first.id}: {100 * saturated:.1f} % of the region is saturated; expose it shorter")
    empty = float(np.mean(frames[0][row0:row1, col0:col1] <= 0))
    if black > 0.0 and empty > 0.002:
        raise NotDetermined(
            "mtf",
            f"{first.id}: {100 * empty:.1f} % of the region is at 0, below the black level {black:g}: it is clipped",
        )
    mean = np.mean([f.astype(float) for f in frames], axis=0) if len(frames) > 1 else frames[0]
    planes = region_planes(mean, region, camera.cfa, channel, black)
    frequency = DEFAULT_FREQUENCY_CY_PER_PX if frequency_cy_per_px is None else frequency_cy_per_px
    return planes_mtf(planes, frequency, code=1.0, frames=len(frames))


def _found(recordings: RecordingSet, capture: SlantedEdge) -> tuple[FoundEdge, ...]:
    camera = recordings.camera(capture.side)
    return find_edges(recordings.frame(capture), camera.cfa, camera.saturation_dn)


def fit_mtf(recordings: RecordingSet, side: Side, noise: NoiseFit | None = None) -> tuple[MtfCurve, ...]:
    """One MTF curve for every slanted-edge capture of `side` and every channel (R, G, B; or Y), captures in their order.

    A capture that names no region gives the curves of all edges found in its frame (`find_edges`), each with its region. The
    black level is `noise`'s where it was fitted, else the stated one. The angle is given in the turn (of 180 deg) next to
    the capture's nominal one. A capture without a usable edge is left out; raises `NotDetermined` where none has one.
    """
    captures = recordings.captures("slanted_edge", side)
    if not captures:
        raise NotDetermined("mtf", "no slanted_edge captures")
    camera = recordings.camera(side)
    curves, reasons = [], []
    for capture in captures:
        try:
            regions = [capture.region] if capture.region else [f.region for f in _found(recordings, capture)]
        except NotDetermined as refused:
            reasons.append(f"{capture.id}: {refused.reason}")
            continue
        for region, channel in itertools.product(regions, ("Y",) if camera.cfa == "MONO" else ("R", "G", "B")):
            try:
                edge = measure_edge(recordings, [capture], channel, noise, region=region)
            except NotDetermined as refused:
                reasons.append(f"{capture.id} ({channel}): {refused.reason}")
                continue
            turns = 0.0 if capture.angle_deg is None else 180.0 * round((capture.angle_deg - edge.angle_deg) / 180.0)
            row0, col0, row1, col1 = region
            field_mm = capture.field_mm
            if capture.region is None and camera.pixel_pitch_um is not None:
                pitch_mm = 1e-3 * camera.pixel_pitch_um
                field_mm = (pitch_mm * (row0 + row1 - camera.rows) / 2.0, pitch_mm * (col0 + col1 - camera.cols) / 2.0)
            curves.append(
                MtfCurve(
                    capture=capture.id,
                    channel=channel,
                    angle_deg=edge.angle_deg + turns,
                    angle_deg_std=edge.angle_deg_std,
                    field_mm=field_mm,
                    region=region,
                    frequency_cy_per_px=tuple(edge.frequency_cy_per_px.tolist()),
                    mtf=tuple(edge.mtf.tolist()),
                    mtf_std=tuple(edge.mtf_std.tolist()),
                    mtf50_cy_per_px=edge.mtf50_cy_per_px,
                    mtf50_cy_per_px_std=edge.mtf50_cy_per_px_std,
                    mtf10_cy_per_px=edge.mtf10_cy_per_px,
                    mtf10_cy_per_px_std=edge.mtf10_cy_per_px_std,
                )
            )
    if not curves:
        raise NotDetermined("mtf", reasons[0])
    return tuple(curves)
