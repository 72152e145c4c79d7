"""The counts that even light and its noise give an ideal converter, and how an estimate of both from the same pixels
follows a converter's law."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit
from scipy import ndimage, sparse
from scipy.special import ndtr

from lab.observables.codes.landings import MARGIN
from lab.observables.noise.surface import shading
from sim.spectrum import FloatArray

# mypy: disallow-untyped-decorators=False

AROUND = 9  # side of the box in a plane of the mosaic whose mean is the light at a pixel, px
#: Width of the levels whose pixels share one distribution, over the standard deviation of the noise.
STEP_OF_LEVELS = 0.2
#: Levels of the local means that share one estimate: six standard deviations of the means' noise, which is 1 /
#: `AROUND` of the pixels' noise.
LEVELS_TOGETHER = round(6.0 / AROUND / STEP_OF_LEVELS) + 1
OUTLYING = 5.0  # standard deviations from which on a pixel is an outlier
LIMITED = 2  # iterations of the limit of outliers
LEAST_SQUARE = 1e-3  # DN^2
LEAST_VARIANCE = 1e-2  # DN^2, of the pixels of one level
#: Frames from which on the pixels' sensitivities are measured: of fewer, their own noise is most of what is found.
LEAST_FRAMES = 4
FARTHEST = 6.5  # of a departure over its standard deviation
FOLLOWED, MOST_FOLLOWED = 4, 1.0  # iterations of `ExpectedCounts.change`; largest change of a mean over the noise


@dataclass
class PatternSum:
    """Sum of a plane's departures from smooth light (rows, cols), DN, over frames, and of the frames' mean signals
    above black.

    Shot noise is as large in the sum from each frame per root of its signal, as least squares demand.
    """

    departures: FloatArray | float = 0.0
    signal_dn: float = 0.0
    number: int = 0

    def add(self, plane: Any, black_dn: float) -> None:
        """Add a frame's plane (rows, cols) less its smooth surface and its rows' means."""
        own = plane - shading(plane)
        own -= own.mean(axis=1, keepdims=True)
        self.departures = self.departures + own
        self.signal_dn += max(float(plane.mean()) - black_dn, 1.0)
        self.number += 1

    def sensitivity(self) -> FloatArray | float:
        """Return the relative departure of each pixel's sensitivity (rows, cols); 0 of too few frames."""
        return self.departures / self.signal_dn if self.number >= LEAST_FRAMES else 0.0


@dataclass
class EvenLight:
    """The light in a plane of the mosaic over the frames of one setting.

    Pixels are counted by their level, in steps of `step_dn`, and by the group of levels of the local mean about them:
    of one frame the `cells` have these two numbers, the number of pixels, and the sums of their levels above the step's
    lower border and of its squares. `mean_square` is that of the departures from the level, at a mean signal of
    `signal_dn`; both are sums over `frames`.
    """

    black_dn: float
    step_dn: float = 0.0
    mean_square: float = 0.0
    signal_dn: float = 0.0
    frames: int = 0
    cells: list[FloatArray] = field(default_factory=list)

    def add(self, plane: Any, sensitivity: FloatArray | float) -> None:
        """Add a frame's plane (rows, cols), whose pixels have a relative `sensitivity` (rows, cols) beyond 1.

        A pixel's level is the smooth surface and the local mean over `AROUND` x `AROUND` pixels, and as much beside it
        as its row is on the whole, times the pixel's own sensitivity. Local means are those without the sensitivities,
        whose defects and coarse patterns they would blur. The smooth surface is taken off first, as means at a frame's
        border would be wrong by its slope.

        The sensitivities have a part of this frame's noise, 1 / n of n frames. It spreads the levels, and the
        departures from these have as much less: both together are spread as the frame is.
        """
        smooth = shading(plane)
        fixed = sensitivity * max(float(smooth.mean()) - self.black_dn, 1.0)
        own = plane - smooth - fixed
        around = ndimage.uniform_filter(own, AROUND, mode="reflect")
        departures = own - around
        departures -= departures.mean(axis=1, keepdims=True)
        # a pattern that isn't known is in the local means: these would tell of departures
        departures -= float(np.vdot(departures, around)) / max(float(np.vdot(around, around)), 1e-12) * around
        surface = plane - departures
        mean_square = _limited_square(departures)
        self.mean_square += mean_square
        self.signal_dn += max(float(surface.mean()) - self.black_dn, 1.0)
        self.frames += 1
        self.step_dn = self.step_dn or max(STEP_OF_LEVELS * float(np.sqrt(mean_square)), 1.0)
        self.cells.append(_cells(surface, surface - fixed, self.step_dn))

    def counts(self, gain: float | None, codes: int) -> PlaneCounts:
        """Return the counts that the light gives at `codes` codes from 0 on.

        The departures' mean square is proportional to the signal. They are normal, with the skewness of Poisson numbers
        (Edgeworth's first term). `gain`, DN per electron; None: that of shot noise alone.
        """
        signal, mean_square = self.signal_dn / self.frames, self.mean_square / self.frames
        gain = mean_square / signal if gain is None else gain
        group, level, number, above, square = np.concatenate(self.cells, axis=1)
        own, at = np.unique(level, return_inverse=True)
        pixels: FloatArray = np.bincount(at, number).astype(float)
        mean = np.bincount(at, above) / pixels
        within = np.maximum(np.bincount(at, square) / pixels - np.square(mean), 0.0)
        middle = own * self.step_dn + mean
        light = np.maximum(middle - self.black_dn, 1.0)
        sigma = np.sqrt(np.maximum(mean_square * light / signal + within, LEAST_VARIANCE))
        low = np.maximum((middle - 6.0 * sigma).astype(int), 0)
        code = low[:, None] + np.arange(int(12.0 * sigma.max()) + 4)
        z = np.clip((code - 0.5 - middle[:, None]) / sigma[:, None], -FARTHEST, FARTHEST)
        density = np.exp(-0.5 * np.square(z)) / np.sqrt(2.0 * np.pi)
        # Poisson numbers s in units of the gain K have the third central moment K^2 (K s)
        skewness = (gain**2 * light / sigma**3)[:, None]
        below = (ndtr(z) - skewness / 6.0 * (np.square(z) - 1.0) * density, -density, -z * density / np.sqrt(2.0))
        inside = code[:, :-1] < codes
        row, column = np.nonzero(inside)[0], code[:, :-1][inside]
        tables = tuple(sparse.csr_array((np.diff(of)[inside], (row, column)), shape=(len(own), codes)) for of in below)
        first = group.min()
        by_group = sparse.csr_array((number, ((group - first).astype(int), at)))
        return PlaneCounts(tables, pixels, by_group)


def _cells(surface: FloatArray, local: FloatArray, step_dn: float) -> FloatArray:
    """Return the cells of `EvenLight` (5, cells): pixels by their level and by the group of their local mean."""
    first, last = (max(int(end / step_dn), 0) for end in (surface.min(), surface.max()))
    begin, end = (max(int(end / (LEVELS_TOGETHER * step_dn)), 0) for end in (local.min(), local.max()))
    sums = np.zeros((end - begin + 1, last - first + 1, 3))
    _add_cells(surface, local, step_dn, LEVELS_TOGETHER * step_dn, first, begin, sums)
    group, level = np.nonzero(sums[..., 0])
    return np.array((group + begin, level + first, *sums[group, level].T))


@njit(cache=True)
def _add_cells(
    surface: FloatArray, local: FloatArray, step_dn: float, wide_dn: float, first: int, begin: int, sums: FloatArray
) -> None:
    """Add to `sums` (groups, levels, 3) the number of pixels, the sum of their levels above the step's lower border,
    DN, and that of its squares: of groups from `begin` and levels from `first` on."""
    for i in range(surface.shape[0]):
        for j in range(surface.shape[1]):
            value = max(surface[i, j] / step_dn, 0.0)
            level, group = int(value), int(max(local[i, j] / wide_dn, 0.0))
            above = (value - level) * step_dn
            # rounding may put the lowest and the highest pixel beside the table
            cell = sums[min(max(group - begin, 0), len(sums) - 1), min(max(level - first, 0), sums.shape[1] - 1)]
            cell[0] += 1.0
            cell[1] += above
            cell[2] += above * above


def _limited_square(departures: FloatArray) -> float:
    """Return the mean square of departures that are limited to `OUTLYING` standard deviations."""
    square = np.square(departures)
    mean_square = max(float(np.mean(square, dtype=float)), LEAST_SQUARE)
    for _ in range(LIMITED):
        mean_square = max(float(np.mean(np.minimum(square, OUTLYING**2 * mean_square), dtype=float)), LEAST_SQUARE)
    return mean_square


@dataclass(frozen=True)
class PlaneCounts:
    """Counts that the light in a plane of the mosaic gives an ideal converter over the frames of one setting.

    `tables`: three of (levels, codes), for a pixel of each level: the probability of each code; its change by one
    standard deviation of the mean; and by 1 / sqrt 2 of the variance. The latter two are also the parts of the counts'
    noise that go with a pixel's mean and with its mean square, one standard deviation each. `number` (levels,): of
    pixels. `by_group` (groups, levels): of pixels, by the local means that share an estimate.
    """

    tables: tuple[sparse.csr_array, ...]
    number: FloatArray
    by_group: sparse.csr_array

    def expected(self) -> FloatArray:
        """Return the counts (codes,)."""
        return np.asarray(self.number @ self.tables[0])

    def scatter(self, first: int, size: int) -> sparse.csr_array:
        """Return the probabilities (levels, size) at codes from `first` on, times the root of the pixels' number."""
        return sparse.csr_array(sparse.diags_array(np.sqrt(self.number)) @ self.tables[0][:, first : first + size])


@dataclass(frozen=True)
class ExpectedCounts:
    """Counts that light and noise give an ideal converter, by groups of neighbouring levels of a plane whose local
    means are of the same pixels.

    `tables`: three of (groups, cells), the sums of the pixels' `PlaneCounts.tables`; a cell is the input of an ideal
    code, of which `MARGIN` lie on either side of the codes that are counted. `plane`, `number`, `middle` (groups,):
    index of the plane, number of pixels, mean code less the first cell's. `by_mean`, `by_spread` (groups,): change of
    the sum of departures by the second table, and of their squares by the third.
    """

    tables: tuple[sparse.csr_array, ...]
    plane: FloatArray
    number: FloatArray
    middle: FloatArray
    by_mean: FloatArray
    by_spread: FloatArray

    @classmethod
    def of(cls, planes: Sequence[PlaneCounts], first: int, size: int) -> ExpectedCounts:
        """Return the counts of planes at `size` codes from `first` on."""
        begin, cells = first - MARGIN, size + 2 * MARGIN
        parts: list[list[sparse.coo_array]] = [[], [], []]
        rows: list[FloatArray] = []
        for index, plane in enumerate(planes):
            tables = [sparse.csr_array(plane.by_group @ table) for table in plane.tables]
            number = np.asarray(plane.by_group.sum(axis=1))
            kept = number > 0.0
            tables, number = [table[kept] for table in tables], number[kept]
            code = np.arange(tables[0].shape[1]) - float(begin)
            middle = tables[0] @ code / number
            by_mean = tables[1] @ code - middle * tables[1].sum(axis=1)
            second = tables[2] @ np.square(code) - 2.0 * middle * (tables[2] @ code)
            by_spread = second + np.square(middle) * tables[2].sum(axis=1)
            rows.append(np.array((np.full(len(number), index), number, middle, by_mean, by_spread)))
            for part, table in zip(parts, tables, strict=True):
                part.append(_shifted(table, begin, cells))
        together = tuple(sparse.csr_array(sparse.vstack(part)) for part in parts)
        return cls(together, *np.concatenate(rows, axis=1))

    def followed(self) -> Iterator[FloatArray]:
        """Yield the parts (codes, n) of the counts' noise, one standard deviation each, that the estimates follow: of
        each group's mean, and of each plane's mean square."""
        of_plane = sparse.csr_array((self.plane[None, :] == np.unique(self.plane)[:, None]).astype(float))
        for table, number in (
            (self.tables[1], self.number),
            (of_plane @ self.tables[2], of_plane @ self.number),
        ):
            scaled = sparse.diags_array(1.0 / np.sqrt(number)) @ table
            yield np.asarray(scaled.toarray().T[MARGIN:-MARGIN])

    def change(self, lands: sparse.csr_array) -> FloatArray:
        """Return the change (codes,) of counts less what is estimated, by a converter with `landings`.

        What is estimated has the mean code of each group and the mean square of each plane. So the light's own mean
        and spread are those that give these codes; Hermite's expansion of the normal distribution moves and widens it,
        to second order in the move.
        """
        found = lands.tocoo()
        away, cells = found.coords[0] - found.coords[1], lands.shape[1]
        mass = np.maximum(np.bincount(found.coords[1], found.data, cells), 1e-12)
        moved = np.bincount(found.coords[1], found.data * away, cells) / mass
        square = np.bincount(found.coords[1], found.data * np.square(away), cells) / mass
        sums = np.array([(t @ moved, t @ (2.0 * np.arange(cells) * moved + square)) for t in self.tables])
        mean, second = sums[:, 0], sums[:, 1] - 2.0 * self.middle * sums[:, 0]
        plane = self.plane.astype(int)
        shift, wider = np.zeros(len(plane)), np.zeros(len(plane))
        for _ in range(FOLLOWED):
            shift = -(mean[0] + wider * mean[2]) / np.maximum(self.by_mean + mean[1], 1e-12)
            shift = np.clip(shift, -MOST_FOLLOWED, MOST_FOLLOWED)
            of_shift, by_wider = np.square(shift) / np.sqrt(2.0), self.by_spread + second[2]
            left = np.bincount(plane, second[0] + shift * second[1] + of_shift * by_wider)
            common = -left / np.maximum(np.bincount(plane, by_wider), 1e-12)
            wider = of_shift + np.clip(common, -MOST_FOLLOWED, MOST_FOLLOWED)[plane]
        even, by_shift, by_wider = self.tables
        ideal = even.sum(axis=0)
        given = lands @ (ideal + by_shift.T @ shift + by_wider.T @ wider)
        return np.asarray((given - ideal)[MARGIN:-MARGIN])


def _shifted(table: sparse.csr_array, begin: int, cells: int) -> sparse.coo_array:
    """Return the columns of a table (n, codes) from code `begin` on, `cells` of them; 0 where there is no code."""
    row, column = table.tocoo().coords
    inside = (column >= begin) & (column < begin + cells)
    return sparse.coo_array(
        (table.tocoo().data[inside], (row[inside], column[inside] - begin)), shape=(table.shape[0], cells)
    )
