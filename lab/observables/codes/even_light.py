"""The counts that even light and its noise give an ideal converter, and how an estimate of both from the same pixels
follows a converter's law."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage, sparse
from scipy.special import ndtr

from lab.observables.codes.landings import MARGIN
from lab.observables.dataset import Dataset
from lab.observables.noise.surface import shading
from sim.spectrum import FloatArray

AROUND = 9  # side of the box in a plane of the mosaic whose mean is the light at a pixel, px
#: Width of the levels whose pixels share one normal distribution, over the standard deviation of the noise.
STEP_OF_LEVELS = 0.2
#: Levels over which the noise of local means scatters neighbouring pixels: six standard deviations, of 1 / `AROUND` of
#: the pixels' noise each.
LEVELS_TOGETHER = round(6.0 / AROUND / STEP_OF_LEVELS) + 1
FOLLOWED, MOST_FOLLOWED = 4, 1.0  # iterations of `ExpectedCounts.change`; largest change of a mean over the noise


class LevelCounts(NamedTuple):
    """The pixels of one level in one plane: their first code, their number, and by code (3, codes) the probability and
    its covariances with the first two Hermite polynomials, z and (z^2 - 1) / sqrt 2, of the normalised departure z."""

    first: int
    number: int
    table: FloatArray


def levels_of(plane: Any, dataset: Dataset) -> Iterator[LevelCounts]:
    """Yield a plane's pixels by level.

    A pixel's expected code is the local mean over `AROUND` x `AROUND` pixels, and as much beside it as its row is on
    the whole. The smooth surface is taken off first, as means at a frame's border would be wrong by its slope. The
    variance is proportional to the signal above black, and scaled so that its mean is the measured mean square of the
    departures: so much are the codes spread about local means, which have noise of their own. The distribution is
    normal with the skewness of Poisson numbers (Edgeworth's first term).
    """
    bend = shading(plane)
    surface = bend + ndimage.uniform_filter(plane - bend, AROUND, mode="reflect")
    surface = surface + (plane - surface).mean(axis=1, keepdims=True)
    noise = dataset.noise
    signal = max(float(surface.mean()) - noise.black, 1.0)
    variance = float(np.mean(np.square(plane - surface), dtype=float))
    # where no gain is known, that of shot noise alone
    gain = noise.gain if noise.gain_is_known else variance / signal
    # pixels are binned by level, in steps narrow beside the noise; the variance of the levels within a bin is added
    step = max(STEP_OF_LEVELS * np.sqrt(variance), 1.0)
    above = surface.ravel().astype(float) - float(surface.min())
    group = (above / step).astype(int)
    number = np.bincount(group)
    share = np.maximum(number, 1)
    mean = np.bincount(group, above) / share
    within = np.maximum(np.bincount(group, np.square(above)) / share - np.square(mean), 0.0)
    for n, middle, added in zip(number, mean + float(surface.min()), within, strict=True):
        if n == 0:
            continue
        own = max(middle - noise.black, 1.0)
        sigma = np.sqrt(max(variance * own / signal + added, 1e-2))
        low = max(int(middle - 6.0 * sigma), 0)
        edges = (np.arange(low, int(middle + 6.0 * sigma) + 3) - 0.5 - middle) / sigma
        density = np.exp(-0.5 * np.square(edges)) / np.sqrt(2.0 * np.pi)
        # Poisson numbers s in units of the gain K have the third central moment K^2 (K s)
        skewness = gain**2 * own / sigma**3
        whole = ndtr(edges) - skewness / 6.0 * (np.square(edges) - 1.0) * density
        yield LevelCounts(low, int(n), np.diff(np.array([whole, -density, -edges * density / np.sqrt(2.0)])))


@dataclass(frozen=True)
class ExpectedCounts:
    """Counts that light and noise give an ideal converter, by groups of neighbouring levels of a plane whose local
    means are of the same pixels.

    `tables`: three of (groups, cells), the sums of the pixels' `LevelCounts.table`; a cell is the input of an ideal
    code, of which `MARGIN` lie on either side of the codes that are counted. `plane`, `number`, `middle` (groups,):
    index of the plane, number of pixels, mean code less the first cell's. `by_mean`, `by_spread` (groups,): change of
    the sum of departures by the second table, and of their squares by the third.
    """

    tables: tuple[sparse.csr_array, sparse.csr_array, sparse.csr_array]
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
                table = np.zeros((3, max(level.first + level.table.shape[1] for level in members) - low))
                for level in members:
                    at = level.first - low
                    table[:, at : at + level.table.shape[1]] += level.number * level.table
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
        """Return the parts (codes, n) of the counts' noise, one standard deviation each, that the estimates follow:
        of each group's mean (row 1), of each plane's mean square (row 2)."""
        table, number = self.tables[row], self.number
        if row == 2:
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
