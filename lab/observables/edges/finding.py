"""Where an edge lies: the curve of the edge, the pixels near it, and the search for both.

Planes of the mosaic stand on their own grids; samples have the coordinates of the edge. The edge is a straight line
from the gradients first, then a cubic by Gauss-Newton on the profile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.errors import InputError, NotDetermined
from lab.observables.edges.spread import SortedSamples, Spline
from sim.camera import Cfa
from sim.sensor.mosaic import phases
from sim.sensor.mosaic import step as period

Array = NDArray[np.floating[Any]]
EDGE_ORDER = 3  # degree of the polynomial
ORDERS = np.arange(1.0, EDGE_ORDER + 1)  # of its terms beyond the constant

Region = tuple[int, int, int, int]  # row0, col0, row1, col1, end excluded

FEW_PHASES_PX = 0.6  # widest gap between distances of a quarter of the edge; above it the edge is taken as straight
ACROSS = 2  # the column of `illumination_gradients` across the edge, of the light that the edge adds
REFINED_PX = 6.0  # half-width of the zone that decides where the edge is
MOST_REACH_PX = 60.0


@dataclass(frozen=True)
class EdgeCurve:
    """An edge as a polynomial: across = poly((along - centre) / half_length), px of the full sensor.

    `transposed`: across is the row and along the column, else the reverse. `poly` (EDGE_ORDER + 1,) lowest power
    first. `sign`: +1 where the light side is at larger across, else -1. `along` arguments of the methods are in half
    lengths from the centre.
    """

    transposed: bool
    centre: tuple[float, float]
    half_length: float
    poly: Array
    sign: int

    @property
    def tilt(self) -> float:
        """Return the slope of the edge at its middle, px across per px along."""
        return float(self.poly[1]) / self.half_length

    @property
    def slope(self) -> Array:
        """Return the coefficients (EDGE_ORDER,) of the slope of the edge, px across per px along."""
        return self.poly[1:] * ORDERS / self.half_length

    def shift(self, change: Array) -> EdgeCurve:
        """Return the edge with `change` (EDGE_ORDER + 1,) added to its coefficients."""
        return EdgeCurve(self.transposed, self.centre, self.half_length, self.poly + change, self.sign)

    def distance(self, along: Array, across: Array) -> tuple[Array, Array, Array]:
        """Measure the signed distance of points from the curve (px, positive on the light side), and the foot of the
        perpendicular.

        `along` (n,) in half lengths and `across` (n,) in px. Returns (distance, foot, slope), each (n,): the foot in
        half lengths along, and the slope of the curve there. Two Newton steps; a straight line in closed form.
        """
        first = self.slope
        second = first[1:] * ORDERS[:-1] / self.half_length
        foot = along
        if not self.poly[2:].any():  # a straight line: in closed form
            gap = across - polynomial_value(along, self.poly)
            slope = np.full_like(along, first[0])
            return (
                self.sign * gap / np.sqrt(1.0 + first[0] ** 2),
                along + gap * first[0] / (1.0 + first[0] ** 2) / self.half_length,
                slope,
            )
        for _ in range(2):
            gap = across - polynomial_value(foot, self.poly)
            slope = polynomial_value(foot, first)
            lag = (foot - along) * self.half_length - gap * slope
            foot = foot - lag / (1.0 + slope * slope - gap * polynomial_value(foot, second)) / self.half_length
        slope = polynomial_value(foot, first)
        gap = across - polynomial_value(foot, self.poly)
        return self.sign * gap * np.sqrt(1.0 + slope * slope), foot, slope


def polynomial_value(x: Array, coefficients: Array) -> Array:
    """Evaluate a polynomial at `x` (n,); coefficients lowest power first (Horner)."""
    value = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value *= x
        value += c
    return value


def powers(x: Array, order: int) -> Array:
    """Return the powers 1, x, x^2, ... of `x` (n,), (order + 1, n)."""
    rows = np.empty((order + 1, len(x)))
    rows[0] = 1.0
    for k in range(order):
        np.multiply(rows[k], x, out=rows[k + 1])
    return rows


def angle_from_vertical_deg(slope: float, transposed: bool) -> float:
    """Return the angle of an edge of given `slope` (px across per px along) from the vertical.

    Positive where the top turns to the right; -90 < angle <= 90 deg.
    """
    row, col = (slope, 1.0) if transposed else (1.0, slope)
    angle = float(np.degrees(np.arctan2(col, -row)))
    return angle - 180.0 * np.ceil((angle - 90.0) / 180.0)


@dataclass(frozen=True)
class Plane:
    """Samples of one channel on their own grid: `values[i, j]` lies at row `row0 + step i`, column `col0 + step j` of
    the sensor.
    """

    values: Array
    row0: float = 0.0
    col0: float = 0.0
    step: int = 1


def region_planes(frame: NDArray[np.generic], region: Region, cfa: Cfa, channel: str) -> list[Plane]:
    """Cut the planes of a channel (two for green) within `region` out of a raw frame (rows, cols), in codes.

    `region`: (row0, col0, row1, col1), end excluded. The planes keep their coordinates on the sensor. Raises
    `InputError` where the region isn't inside the frame: a negative column would be counted from the other border.
    """
    row0, col0, row1, col1 = region
    rows, cols = frame.shape
    if not (0 <= row0 < row1 <= rows and 0 <= col0 < col1 <= cols):
        raise InputError(f"region {list(region)} isn't inside the frame of {rows} x {cols}: give one that is")
    step = period(cfa)
    found = []
    for first_row, first_col in sorted(phases(cfa)[channel]):
        r, c = row0 + (first_row - row0) % step, col0 + (first_col - col0) % step
        found.append(Plane(frame[r:row1:step, c:col1:step].astype(float), r, c, step))
    return found


def refuse_unusable(planes: Sequence[Plane]) -> None:
    """Raise `NotDetermined` where a plane is smaller than 16 x 16 px or holds values that are not finite."""
    if not planes or any(min(p.values.shape) * p.step < 16 or min(p.values.shape) < 8 for p in planes):
        raise NotDetermined("mtf", "the region is too small: at least 16 x 16 px (8 x 8 samples) are needed")
    bad = sum(int(np.count_nonzero(~np.isfinite(p.values))) for p in planes)
    if bad:
        raise NotDetermined("mtf", f"the region holds {bad} values that aren't finite: leave them out of the region")


@dataclass(frozen=True)
class Samples:
    """Pixels of all planes near an edge, (n,) each: `along` in half lengths, `across` in px, `value`, and the index of
    the `plane`.

    `step` is the pitch of the planes in px, `count` their number.
    """

    along: Array
    across: Array
    value: Array
    plane: NDArray[np.int64]
    step: int
    count: int

    def where(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Samples:
        """Return the samples that `kept` selects, a mask or indices."""
        return Samples(self.along[kept], self.across[kept], self.value[kept], self.plane[kept], self.step, self.count)

    @staticmethod
    def near(planes: Sequence[Plane], edge: EdgeCurve, reach_px: float, every: int = 1) -> Samples:
        """Collect the samples within `reach_px` of the edge, measured across it; with `every` > 1 only every so many
        lines along the edge.
        """
        found = []
        band = reach_px * np.sqrt(1.0 + edge.tilt**2)
        for k, p in enumerate(planes):
            r = p.row0 + p.step * np.arange(p.values.shape[0], dtype=float) - edge.centre[0]
            c = p.col0 + p.step * np.arange(p.values.shape[1], dtype=float) - edge.centre[1]
            values = p.values
            if edge.transposed:
                r, c, values = c, r, values.T
            r, values = r[::every] / edge.half_length, values[::every]
            inside = np.abs(c - polynomial_value(r, edge.poly)[:, None]) < band
            i, j = np.nonzero(inside)
            found.append((r[i], c[j], values[inside], np.full(len(i), k)))
        along, across, value, plane = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return Samples(along, across, value, plane, planes[0].step, len(planes))


def level_planes(samples: Samples, distance: Array, inner: float, outer: float) -> tuple[Array, float, float]:
    """Level the values: the mean levels of each plane become 0 (dark) and 1 (light). Returns the values, and these two
    levels averaged over the planes.

    The levels are means over `inner` < |distance| < `outer`, px. Raises `NotDetermined` where a side has no room, or
    where both are alike.
    """
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


def illumination_gradients(distance: Array, along_px: Array, profile: Array, room: bool) -> Array:
    """Return the columns (2 or 4, n) of planar gradients of the illumination, per 100 px: along the edge, and across
    it if `room`; each of the light that the edge adds and of that which both sides have.

    `profile` (n,): 0 on the dark and 1 on the light side. What part of the dark side's codes is light isn't known, so
    that its gradient is free. Without an outer zone (`room` False) a gradient across the edge can't be told from the
    tails of the profile.
    """
    rows = [along_px * profile / 100.0, along_px / 100.0]
    if room:
        rows += [distance * profile / 100.0, distance / 100.0]
    return np.array(rows)


def first_line(plane: Plane) -> EdgeCurve:
    """Find a straight edge from the gradients of the smoothed plane: their common direction, then their weighted line.

    Good to about a pixel. Raises `NotDetermined` where the plane is uniform or its gradients have no common line.
    """
    blocks = max(1, min(plane.values.shape) // 96)  # the line need only be good to a pixel
    rows, cols = (n // blocks * blocks for n in plane.values.shape)
    binned = plane.values[:rows, :cols].reshape(rows // blocks, blocks, cols // blocks, blocks).mean(axis=(1, 3))
    smooth = ndimage.gaussian_filter(binned, 1.2, mode="nearest")
    g_row, g_col = (g[2:-2, 2:-2] for g in np.gradient(smooth))
    pitch = plane.step * blocks
    row, col = (np.indices(g_row.shape, dtype=float) + 2.0) * pitch + plane.step * (blocks - 1) / 2.0
    size = plane.step * np.array(plane.values.shape)
    row, col = row - (size[0] - plane.step) / 2.0, col - (size[1] - plane.step) / 2.0
    power = g_row**2 + g_col**2
    weight = np.square(np.clip(power - 3.0 * np.median(power), 0.0, None))  # above the gradients of noise
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
    return EdgeCurve(transposed, centre, half_length, poly, sign)


def refine_edge(samples: Samples, edge: EdgeCurve, widest: float) -> EdgeCurve:
    """Refine the polynomial of the edge by Gauss-Newton on the profile, coarse and wide first.

    Model: v = E(d), d the distance from the edge, E a free spline profile; dE/d(coefficients) = -E'(d) sign powers /
    sqrt(1 + slope^2). `widest`: the reach of the samples, px.
    """
    chance = np.random.default_rng(0).random(len(samples.value))
    # Along rows or diagonals of the pixels, each quarter of the edge samples few phases of the profile.
    # They don't determine a curve.
    quarters = [widest_gap_px(samples, edge, np.abs(samples.along - at) < 0.25) for at in (-0.75, -0.25, 0.25, 0.75)]
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
        kept = np.flatnonzero(np.abs(samples.across - polynomial_value(samples.along, edge.poly)) < limit * tilt)
        if spacing > 0.5 and len(kept) > 8000:
            kept = kept[chance[kept] < 8000.0 / len(kept)]
        part = samples.where(kept)
        distance, foot, slope = edge.distance(part.along, part.across)
        value, _, _ = level_planes(part, distance, 0.6 * limit, 1.5 * limit)
        count = int(np.ceil(limit / spacing))
        spline = Spline(np.arange(-count, count + 1) * (limit / count))
        placed = SortedSamples.of(spline, distance)
        distance, foot, slope, value = (x[placed.order] for x in (distance, foot, slope, value))
        gram = placed.gram(value[None])
        normal = gram[:-1, :-1]
        esf = np.linalg.solve(normal + spline.roughness(1e-4 * np.trace(normal) / spline.size), gram[:-1, -1])
        profile = placed.values(esf)
        residual = value - profile
        # d(distance) / d(edge) = -sign / sqrt(1 + slope^2)
        response = -edge.sign * placed.derivatives(esf) / np.sqrt(1.0 + slope * slope)
        columns = np.concatenate(
            [
                response * powers(foot, terms),
                illumination_gradients(distance, foot * edge.half_length, np.clip(profile, 0.0, 1.0), room=True),
            ]
        )
        inlier = np.abs(residual) < 5.0 * np.sqrt(np.mean(residual**2)) + 1e-9
        kept_columns = columns * inlier
        change = np.linalg.lstsq(kept_columns @ columns.T, kept_columns @ residual, rcond=1e-10)[0][: terms + 1]
        # Profile and edge have a shift in common: the edge is put where the profile is half way.
        grid = np.linspace(-limit, limit, 401)
        # The values are levelled: half way is 1/2. The outermost coefficients are of few samples and are no levels.
        offset = half_way_px(grid, spline.values(esf, grid))
        change[0] = edge.sign * offset * tilt
        change = np.clip(change, -0.25 * limit, 0.25 * limit)
        edge = edge.shift(np.concatenate([change, np.zeros(EDGE_ORDER - terms)]))
    return edge


def angle_std_deg(
    steepness: Array, distance: Array, foot: Array, variance: Array, gradients: Array, edge: EdgeCurve
) -> float:
    """Return the standard deviation of the angle of the edge, deg, for noise of given `variance` (n,) of the samples.

    Error propagation through the unweighted least squares of `refine_edge`. `steepness` (n,): derivative of the
    profile per px; `distance`, `foot`: see `EdgeCurve.distance`; `gradients`: see `illumination_gradients`.
    """
    near = np.abs(distance) < REFINED_PX
    columns = np.concatenate(
        [steepness[near] / np.sqrt(1.0 + edge.tilt**2) * powers(foot[near], EDGE_ORDER), gradients[:, near]]
    )
    inverse = np.linalg.pinv(columns @ columns.T, hermitian=True)
    covariance = inverse @ ((columns * variance[near]) @ columns.T) @ inverse
    return float(np.degrees(np.sqrt(covariance[1, 1]) / edge.half_length / (1.0 + edge.tilt**2)))


def widest_gap_px(samples: Samples, edge: EdgeCurve, part: NDArray[np.bool_]) -> float:
    """Return the widest gap between neighbouring distances within 3 px of the edge, over the samples of `part` (n,),
    px.
    """
    distance, _, _ = edge.distance(samples.along[part], samples.across[part])
    return float(np.diff(np.sort(np.append(distance[np.abs(distance) < 3.0], [-3.0, 3.0]))).max())


def half_way_px(distance: Array, rising: Array) -> float:
    """Find the distance at which a profile `rising` from 0 to 1 crosses one half; the crossing nearest to 0, and 0
    where there is none.

    `distance`, `rising` (n,), ascending distances in px.
    """
    i = np.flatnonzero((rising[:-1] < 0.5) & (rising[1:] >= 0.5))
    if not len(i):
        return 0.0
    at = distance[i] + (0.5 - rising[i]) / (rising[i + 1] - rising[i]) * (distance[i + 1] - distance[i])
    return float(at[np.argmin(np.abs(at))])


def usable_reach_px(planes: Sequence[Plane], edge: EdgeCurve) -> float:
    """Find the distance from the edge, px, up to which both sides hold at least half as many samples as there are
    beside the edge; 60 px at most.

    Raises `NotDetermined` below 4 px.
    """
    every = max(1, min(planes[0].values.shape) // 64)
    samples = Samples.near(planes, edge, MOST_REACH_PX + 4.0 * planes[0].step, every)
    slope = polynomial_value(samples.along, edge.slope)
    distance = (samples.across - polynomial_value(samples.along, edge.poly)) / np.sqrt(1.0 + slope**2)
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
