"""The counts that even light and its noise give an ideal converter, and how an estimate of both from the same pixels
follows a converter's law."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage, sparse
from scipy.interpolate import CubicSpline
from scipy.special import ndtr

from lab.observables.codes.landings import MARGIN
from lab.observables.dataset import Dataset
from lab.observables.noise.surface import shading
from sim.spectrum import FloatArray

AROUND = 9  # side of the box in a plane of the mosaic whose mean is the light at a pixel, px
#: Width of the levels whose pixels share one distribution, over the standard deviation of the noise.
STEP_OF_LEVELS = 0.2
#: Levels over which the noise of local means scatters neighbouring pixels: six standard deviations, of 1 / `AROUND` of
#: the pixels' noise each.
LEVELS_TOGETHER = round(6.0 / AROUND / STEP_OF_LEVELS) + 1
BIN = 0.2  # of the fixed pattern's standard deviation: width of the bins of its distribution
MOST_BINS = 100  # on either side
OUTLYING = 5.0  # standard deviations from which on a pixel is an outlier
LIMITED, SOLVED = 2, 8  # iterations of the limit of outliers, and of the variance that limited squares show
PART_STEP = 0.01  # of the variance's part of the fixed pattern, in which its shape is looked up
LEAST_SQUARE = 1e-3  # DN^2
LEAST_LEVEL = 0.05  # of the mean signal, to which departures are related
LEAST_REST, MOST_OF_PATTERN = 0.05, 0.95  # of the variance
#: Frames from which on the pattern's distribution is measured: of fewer, their own noise has too large a part in it.
LEAST_FRAMES = 4
ORDERS = 6  # of the polynomials of the fixed pattern by which the counts' noise is less than without it
COARSER = 3  # box means after each other that leave the fine pattern out
FARTHEST, GRID = 6.5, 1.0 / 16.0  # of the normalised departure: farthest, and spacing of its distribution's spline
FOLLOWED, MOST_FOLLOWED = 4, 1.0  # iterations of `ExpectedCounts.change`; largest change of a mean over the noise


class LevelCounts(NamedTuple):
    """The pixels of one level in one plane: their first code, their number, and by code (6 + n, codes):

    the probability (row 0); its change by one standard deviation of the mean (1), and by 1 / sqrt 2 of the variance
    (2). Of the counts' noise a pixel, one standard deviation each: what goes with the pixel's mean (3), with its mean
    square (4), and how far the latter is from what the change of the variance gives (5; 0 of a normal distribution).
    How the probability depends on the pixel's fixed pattern, by its orthonormal polynomials (6 and following).
    """

    first: int
    number: int
    table: FloatArray


class SensitivityPattern:
    """Distribution of pixels' own sensitivities about the local mean, the same in all frames of a plane.

    It is that of the pixels' mean departures over frames, over the mean signal. What noise these means have is normal,
    as is what the noise of one frame has beyond it: their sum is spread as one frame is, whatever the pattern's own
    distribution.
    """

    def __init__(self, departures: FloatArray) -> None:
        """Take the mean departures (pixels,), over the mean signal."""
        width = max(BIN * min(float(departures.std()), 1.4826 * float(np.median(np.abs(departures)))), 1e-12)
        index = np.clip(np.rint(departures / width), -MOST_BINS, MOST_BINS).astype(int) + MOST_BINS
        number = np.bincount(index)
        at = np.flatnonzero(number)
        self._share = number[at] / len(departures)
        self._place = np.bincount(index, departures)[at] / number[at]
        core = np.abs(self._place) < OUTLYING * width / BIN
        #: Mean square of the departures but for outliers, over the square of the signal.
        self.variance = float(self._share[core] @ np.square(self._place[core])) / float(self._share[core].sum())
        # polynomials of the place, orthonormal over the pixels; the first is 1
        limited = np.clip(self._place / (width / BIN), -OUTLYING, OUTLYING)
        root = np.sqrt(self._share)[:, None]
        basis, triangle = np.linalg.qr(root * np.vander(limited, min(ORDERS, len(at)), increasing=True))
        self._orthonormal = np.zeros((len(at), ORDERS))
        self._orthonormal[:, : basis.shape[1]] = basis * np.sign(np.diag(triangle)) / root
        self._shapes: dict[int, CubicSpline] = {}

    def rest_variance(self, light: EvenLight) -> float:
        """Return the variance of the normal noise that, with the pattern, gives a plane's mean square of departures."""
        own = np.maximum(light.middle - light.black_dn, 1.0)
        place, limit = self._place * np.sqrt(np.average(np.square(own), weights=light.number)), light.limit_dn
        rest = light.mean_square
        for _ in range(SOLVED):
            std = np.sqrt(rest)
            high, low = (limit - place) / std, (-limit - place) / std
            inside = ndtr(high) - ndtr(low)
            edges = (limit + place) * _normal(high) + (limit - place) * _normal(low)
            square = (np.square(place) + rest) * inside - std * edges + limit**2 * (1.0 - inside)
            rest = max(rest + light.mean_square - float(self._share @ square), LEAST_REST * light.mean_square)
        return rest

    def shape(self, part: float) -> CubicSpline:
        """Return, over the normalised departure z, the distribution function and its first three derivatives; its
        changes of rows 4 and 5 of `LevelCounts`, and those with the pattern. The pattern has `part` of the variance,
        normal noise the rest."""
        key = round(part / PART_STEP)
        if key not in self._shapes:
            self._shapes[key] = self._shape(key * PART_STEP)
        return self._shapes[key]

    def _shape(self, part: float) -> CubicSpline:
        place = self._place * np.sqrt(part / max(self.variance, 1e-300))
        std = float(np.sqrt(1.0 - part))
        z = np.linspace(-FARTHEST, FARTHEST, round(2.0 * FARTHEST / GRID) + 1)
        u = (z[:, None] - place) / std
        density = _normal(u)
        slope = (-u * density / std**2) @ self._share
        # of (place + std u)^2, given the place: its integral and its variance
        square = -(std * (z[:, None] + place) * density) @ self._share
        near = np.abs(place) < OUTLYING
        of_square = float(self._share[near] @ (2.0 * std**4 + 4.0 * np.square(place[near]) * std**2))
        columns = (
            (density / std) @ self._share,
            slope,
            ((np.square(u) - 1.0) * density / std**3) @ self._share,
            square / np.sqrt(of_square),
            square / np.sqrt(of_square) - 0.5 * np.sqrt(of_square) * slope,
        )
        with_place = ndtr(u) @ (self._share[:, None] * self._orthonormal)
        return CubicSpline(z, np.column_stack([with_place[:, 0], *columns, with_place[:, 1:]]))


def _normal(z: FloatArray) -> FloatArray:
    """Density of the standard normal distribution."""
    return np.asarray(np.exp(-0.5 * np.square(z)) / np.sqrt(2.0 * np.pi))


#: Of pixels that are all alike, or whose pattern isn't known: their departures are taken as normal.
NO_PATTERN = SensitivityPattern(np.zeros(1))


@dataclass
class PatternSum:
    """Sum of a plane's departures (pixels,) or (rows, cols) over frames, and of the frames' mean signals above black.

    Shot noise is as large in the sum from each frame per root of its signal, as least squares demand.
    """

    departures: FloatArray | float = 0.0
    signal_dn: float = 0.0
    number: int = 0

    def add(self, departures: FloatArray, signal_dn: float) -> None:
        """Add a frame."""
        self.departures = self.departures + departures
        self.signal_dn += signal_dn
        self.number += 1

    def add_plane(self, plane: Any, black_dn: float) -> None:
        """Add a frame's plane (rows, cols) less its smooth surface and its rows' means."""
        own = plane - shading(plane)
        self.add(own - own.mean(axis=1, keepdims=True), max(float(plane.mean()) - black_dn, 1.0))

    def distribution(self) -> SensitivityPattern:
        """Return the pixels' distribution; that of pixels that are all alike from too few frames."""
        if self.number < LEAST_FRAMES:
            return NO_PATTERN
        return SensitivityPattern(np.asarray(self.departures, float).ravel() / self.signal_dn)

    def fine(self) -> FloatArray | float:
        """Return what all frames have finer than local means, over the mean signal (rows, cols); 0 of too few.

        Local means of what is left of a frame don't tell of its pixels' own sensitivities, which a defect or a pattern
        as wide as their box would make them do.
        """
        if self.number < LEAST_FRAMES:
            return 0.0
        total = np.asarray(self.departures)
        limit, _ = _limited(total)
        coarse = np.clip(total, -limit, limit)
        for _ in range(COARSER):
            coarse = ndimage.uniform_filter(coarse, AROUND, mode="reflect")
        return np.asarray((total - coarse) / self.signal_dn)


@dataclass(frozen=True)
class EvenLight:
    """The light in a plane by level (levels,): number of pixels, mean code, variance of the levels within it; and, of
    the plane, the mean signal above black, the mean square of the departures from the local mean, limited to
    `limit_dn`, and the gain, DN per electron."""

    number: FloatArray
    middle: FloatArray
    within: FloatArray
    signal_dn: float
    mean_square: float
    limit_dn: float
    gain: float
    black_dn: float

    def levels(self, pattern: SensitivityPattern) -> Iterator[LevelCounts]:
        """Yield the pixels by level, of a plane with a fixed pattern.

        The variance gives the measured mean square of the departures: so much are the codes spread about local means,
        which have noise of their own. The pattern's is proportional to the signal's square, the rest's to the signal.
        The distribution is that of the pattern with normal noise, and the skewness of Poisson numbers (Edgeworth's
        first term).
        """
        rest = pattern.rest_variance(self)
        for n, middle, added in zip(self.number, self.middle, self.within, strict=True):
            own = max(middle - self.black_dn, 1.0)
            of_pattern = pattern.variance * own**2
            variance = max(of_pattern + rest * own / self.signal_dn + added, 1e-2)
            sigma = np.sqrt(variance)
            low = max(int(middle - 6.0 * sigma), 0)
            edges = (np.arange(low, int(middle + 6.0 * sigma) + 3) - 0.5 - middle) / sigma
            # Poisson numbers s in units of the gain K have the third central moment K^2 (K s)
            skewness = self.gain**2 * own / sigma**3
            of_pattern = min(of_pattern / variance, MOST_OF_PATTERN)
            whole, density, slope, bend, *others = pattern.shape(of_pattern)(np.clip(edges, -FARTHEST, FARTHEST)).T
            table = (
                whole - skewness / 6.0 * bend,
                -density,
                slope / np.sqrt(2.0),
                -np.sqrt(1.0 - of_pattern) * density,
                *others,
            )
            yield LevelCounts(low, int(n), np.diff(np.array(table)))


def even_light(plane: Any, dataset: Dataset, fine: FloatArray | float) -> tuple[EvenLight, FloatArray]:
    """Return the light of a plane (rows, cols), and its pixels' departures from it (pixels,), DN at the mean signal.

    A pixel's expected code is the local mean over `AROUND` x `AROUND` pixels without the `fine` pattern (rows, cols),
    relative to the mean signal, and as much beside it as its row is on the whole. The smooth surface is taken off
    first, as means at a frame's border would be wrong by its slope.
    """
    smooth = shading(plane)
    fixed = fine * max(float(smooth.mean()) - dataset.noise.black, 1.0)
    own = plane - smooth - fixed
    around = ndimage.uniform_filter(own, AROUND, mode="reflect")
    rest = own - around
    rest -= rest.mean(axis=1, keepdims=True)
    # the fine pattern's noise, and a pattern that isn't known, are in the local means: these would tell of departures
    rest -= float(np.vdot(rest, around)) / max(float(np.vdot(around, around)), 1e-12) * around
    departures = rest + fixed
    surface = plane - departures
    noise = dataset.noise
    signal = max(float(surface.mean()) - noise.black, 1.0)
    limit, mean_square = _limited(departures)
    # where no gain is known, that of shot noise alone
    gain = noise.gain if noise.gain_is_known else mean_square / signal
    # pixels are binned by level, in steps narrow beside the noise; the variance of the levels within a bin is added
    step = max(STEP_OF_LEVELS * np.sqrt(mean_square), 1.0)
    lowest = float(surface.min())
    above = surface.ravel().astype(float) - lowest
    group = (above / step).astype(int)
    number = np.bincount(group).astype(float)
    share = np.maximum(number, 1.0)
    mean = np.bincount(group, above) / share
    within = np.maximum(np.bincount(group, np.square(above)) / share - np.square(mean), 0.0)
    of = number > 0
    light = EvenLight(
        number[of], mean[of] + lowest, within[of], signal, mean_square, limit, gain, black_dn=noise.black
    )  # fmt: skip
    return light, (departures * (signal / np.maximum(surface - noise.black, LEAST_LEVEL * signal))).ravel()


def _limited(departures: FloatArray) -> tuple[float, float]:
    """Return the departure from which on pixels are outliers, `OUTLYING` standard deviations, and the mean square of
    departures that are limited to it."""
    square = np.square(departures)
    mean_square = max(float(np.mean(square, dtype=float)), LEAST_SQUARE)
    for _ in range(LIMITED):
        limit = OUTLYING * float(np.sqrt(mean_square))
        mean_square = max(float(np.mean(np.minimum(square, limit**2), dtype=float)), LEAST_SQUARE)
    return limit, mean_square


@dataclass(frozen=True)
class ExpectedCounts:
    """Counts that light and noise give an ideal converter, by groups of neighbouring levels of a plane whose local
    means are of the same pixels.

    `tables`: six of (groups, cells), the sums of the pixels' `LevelCounts.table`; a cell is the input of an ideal
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
    def of(cls, planes: Sequence[Sequence[LevelCounts]], first: int, size: int) -> ExpectedCounts:
        """Return the counts of planes at `size` codes from `first` on."""
        begin, cells = first - MARGIN, size + 2 * MARGIN
        values: list[FloatArray] = []
        columns, counted, rows = [], [0], []
        for plane, levels in enumerate(planes):
            for k in range(0, len(levels), LEVELS_TOGETHER):
                members = levels[k : k + LEVELS_TOGETHER]
                low = min(level.first for level in members)
                table = np.zeros((6, max(level.first + level.table.shape[1] for level in members) - low))
                for level in members:
                    at = level.first - low
                    table[:, at : at + level.table.shape[1]] += level.number * level.table[:6]
                code = np.arange(table.shape[1]) + low - begin
                number = sum(level.number for level in members)
                middle = float(code @ table[0]) / number
                away = code - middle
                rows.append((plane, number, middle, away @ table[1], np.square(away) @ table[2]))
                inside = (code >= 0) & (code < cells)
                values.append(table[:, inside])
                columns.append(code[inside])
                counted.append(counted[-1] + int(inside.sum()))
        value, column, pointer = np.concatenate(values, axis=1), np.concatenate(columns), np.array(counted)
        shape = len(rows), cells
        tables = tuple(sparse.csr_array((one, column, pointer), shape=shape) for one in value)
        return cls(tables, *np.array(rows, float).T)

    def followed(self, row: int) -> FloatArray:
        """Return the parts (codes, n) of the counts' noise, one standard deviation each, by a row of
        `LevelCounts.table`: that the estimates follow, of each group's mean (3) and of each plane's mean square (4),
        and that these bring (5)."""
        table, number = self.tables[row], self.number
        if row > 3:
            of_plane = self.plane[None, :] == np.unique(self.plane)[:, None]
            table, number = sparse.csr_array(of_plane.astype(float)) @ table, of_plane @ number
        scaled = sparse.diags_array(1.0 / np.sqrt(number)) @ table
        return np.asarray(scaled.toarray().T[MARGIN:-MARGIN])

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
        sums = np.array([(t @ moved, t @ (2.0 * np.arange(cells) * moved + square)) for t in self.tables[:3]])
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
        even, by_shift, by_wider = self.tables[:3]
        ideal = even.sum(axis=0)
        given = lands @ (ideal + by_shift.T @ shift + by_wider.T @ wider)
        return np.asarray((given - ideal)[MARGIN:-MARGIN])
