"""Pixels near an edge: planes of the mosaic on their own grids, samples in the coordinates of the edge, levels and
gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.fit.mtf.edge_curve import EdgeCurve, polynomial_value
from sim.camera import Cfa
from sim.sensor.mosaic import phases
from sim.sensor.mosaic import step as period

Array = NDArray[np.floating[Any]]
Region = tuple[int, int, int, int]  # row0, col0, row1, col1, end excluded


@dataclass(frozen=True)
class Plane:
    """Samples of one channel on their own grid: `values[i, j]` lies at row `row0 + step i`, column `col0 + step j` of
    the sensor.
    """

    values: Array
    row0: float = 0.0
    col0: float = 0.0
    step: int = 1


def region_planes(
    frame: NDArray[np.generic], region: Region, cfa: Cfa, channel: str, black_level_dn: float
) -> list[Plane]:
    """Planes of a channel (two for green) within `region` of a raw frame (rows, cols), in DN above `black_level_dn`.

    `region`: (row0, col0, row1, col1), end excluded. The planes keep their coordinates on the sensor.
    """
    row0, col0, row1, col1 = region
    step = period(cfa)
    found = []
    for first_row, first_col in phases(cfa)[channel]:
        r, c = row0 + (first_row - row0) % step, col0 + (first_col - col0) % step
        found.append(Plane(frame[r:row1:step, c:col1:step].astype(float) - black_level_dn, r, c, step))
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
        """The samples that `kept` selects, a mask or indices."""
        return Samples(self.along[kept], self.across[kept], self.value[kept], self.plane[kept], self.step, self.count)

    @staticmethod
    def near(planes: Sequence[Plane], edge: EdgeCurve, reach_px: float, every: int = 1) -> Samples:
        """The samples within `reach_px` of the edge, measured across it; with `every` > 1 only every so many lines
        along the edge.
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


def levelled(samples: Samples, distance: Array, inner: float, outer: float) -> tuple[Array, float, float]:
    """Values with the mean levels of each plane mapped to 0 (dark) and 1 (light); and these two levels, averaged over
    the planes.

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


def illumination_gradients(distance: Array, along_px: Array, light: Array, room: bool) -> Array:
    """Columns (1 or 2, n) of a planar gradient of the illumination, per 100 px: along the edge, and across it if
    `room`.

    `light` (n,) is the profile that the gradient multiplies. Without an outer zone (`room` False) a gradient across
    the edge can't be told from the tails of the profile.
    """
    rows = [along_px * light / 100.0]
    if room:
        rows.append(distance * light / 100.0)
    return np.array(rows)
