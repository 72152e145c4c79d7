"""Where an edge lies: a straight line from the gradients, then a cubic by Gauss-Newton on the profile; how far the
samples reach.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.errors import NotDetermined
from lab.fit.mtf.edge_curve import EDGE_ORDER, EdgeCurve, polynomial_value, powers
from lab.fit.mtf.samples import Plane, Samples, illumination_gradients, levelled
from lab.fit.mtf.spline import SortedSamples, Spline

Array = NDArray[np.floating[Any]]

FEW_PHASES_PX = 0.6  # widest gap between distances of a quarter of the edge; above it the edge is taken as straight
REFINED_PX = 6.0  # half-width of the zone that decides where the edge is
MOST_REACH_PX = 60.0


def first_line(plane: Plane) -> EdgeCurve:
    """Straight edge from the gradients of the smoothed plane: their common direction, then their weighted line.

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


def refined_edge(samples: Samples, edge: EdgeCurve, widest: float) -> EdgeCurve:
    """The polynomial of the edge by Gauss-Newton on the profile, coarse and wide first.

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
        value, _, _ = levelled(part, distance, 0.6 * limit, 1.5 * limit)
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
        edge = edge.shifted(np.concatenate([change, np.zeros(EDGE_ORDER - terms)]))
    return edge


def angle_std_deg(
    steepness: Array, distance: Array, foot: Array, variance: Array, gradients: Array, edge: EdgeCurve
) -> float:
    """Standard deviation of the angle of the edge, deg, for noise of given `variance` (n,) of the samples.

    Error propagation through the unweighted least squares of `refined_edge`. `steepness` (n,): derivative of the
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
    """Widest gap between neighbouring distances within 3 px of the edge, over the samples of `part` (n,), px."""
    distance, _, _ = edge.distance(samples.along[part], samples.across[part])
    return float(np.diff(np.sort(np.append(distance[np.abs(distance) < 3.0], [-3.0, 3.0]))).max())


def half_way_px(distance: Array, rising: Array) -> float:
    """Distance at which a profile `rising` from 0 to 1 crosses one half; the crossing nearest to 0, and 0 where there
    is none.
    """
    i = np.flatnonzero((rising[:-1] < 0.5) & (rising[1:] >= 0.5))
    if not len(i):
        return 0.0
    at = distance[i] + (0.5 - rising[i]) / (rising[i + 1] - rising[i]) * (distance[i + 1] - distance[i])
    return float(at[np.argmin(np.abs(at))])


def usable_reach_px(planes: Sequence[Plane], edge: EdgeCurve) -> float:
    """Distance from the edge, px, up to which both sides hold at least half as many samples as there are beside the
    edge; 60 px at most.

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
