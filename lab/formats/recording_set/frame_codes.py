"""The codes of a frame: how often each comes, by cell of the 2 x 2 mosaic, whatever is stated of the frame.

From these counts follow means, variances, quantiles, clipped shares and the step of the codes, for any mosaic, black
level or white level: a frame is read once, and what its metadata state enters afterwards.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.camera import Cfa
from sim.sensor.mosaic import phases

# mypy: disallow-untyped-decorators=False

CODES = 1 << 16  # of 16 bits
#: Row and column of the cells of a 2 x 2 mosaic, in the order of `FrameCodes.cells`.
CELLS = ((0, 0), (0, 1), (1, 0), (1, 1))


@njit(cache=True)
def _count(frame: NDArray[np.uint16], counts: NDArray[np.int64]) -> None:
    """Add a frame (rows, cols) to `counts` (4, 65536), by cell."""
    rows, cols = frame.shape
    for i in range(rows):
        here, beside = counts[2 * (i % 2)], counts[2 * (i % 2) + 1]
        for j in range(0, cols - 1, 2):
            here[frame[i, j]] += 1
            beside[frame[i, j + 1]] += 1
        if cols % 2:
            here[frame[i, cols - 1]] += 1


@dataclass(frozen=True, eq=False)
class CodeCounts:
    """Numbers of pixels by code.

    lowest  the lowest code that counts, DN
    number  pixels with the code `lowest` + i, (n,)
    """

    lowest: int
    number: NDArray[np.int64]

    @property
    def code_dn(self) -> NDArray[np.int64]:
        """The codes, (n,), DN."""
        return self.lowest + np.arange(len(self.number))

    @cached_property
    def pixels(self) -> int:
        """Number of pixels."""
        return int(self.number.sum())

    @property
    def highest_dn(self) -> int:
        """Highest code that comes, DN; 0 without pixels."""
        return self.lowest + max(len(self.number) - 1, 0)

    @cached_property
    def mean_dn(self) -> float:
        """Mean of the pixels, DN."""
        return int(self.number @ self.code_dn) / self.pixels

    @cached_property
    def variance_dn2(self) -> float:
        """Variance between the pixels, DN^2."""
        return float(self.number @ np.square(self.code_dn - self.mean_dn)) / self.pixels

    @property
    def std_dn(self) -> float:
        """Standard deviation between the pixels, DN."""
        return float(np.sqrt(self.variance_dn2))

    def share_from(self, code_dn: float) -> float:
        """Return the share of the pixels that have `code_dn` or a higher code."""
        first = int(np.clip(np.ceil(code_dn) - self.lowest, 0, len(self.number)))
        return int(self.number[first:].sum()) / self.pixels

    def quantiles(self, shares: Iterable[float]) -> NDArray[np.float64]:
        """Return the codes, DN, below which `shares` of the pixels lie: `numpy.quantile` of the pixels.

        >>> CodeCounts(10, np.array([1, 0, 1])).quantiles([0.5]).tolist()
        [11.0]
        """
        below = np.cumsum(self.number)
        place = np.asarray(list(shares)) * (self.pixels - 1)
        rank = np.floor(place)
        low, high = (np.searchsorted(below, np.minimum(rank + k, self.pixels - 1), side="right") for k in (0, 1))
        return np.asarray(self.lowest + low + (place - rank) * (high - low))

    def dense(self) -> NDArray[np.int64]:
        """Return the number of pixels by code from 0 on, (65536,)."""
        counts = np.zeros(CODES, np.int64)
        counts[self.lowest : self.lowest + len(self.number)] = self.number
        return counts

    @classmethod
    def total(cls, parts: Iterable[CodeCounts]) -> CodeCounts:
        """Return the counts of several parts together."""
        own = [part for part in parts if len(part.number)]
        if not own:
            return cls(0, np.zeros(0, np.int64))
        lowest = min(part.lowest for part in own)
        number = np.zeros(max(part.highest_dn for part in own) - lowest + 1, np.int64)
        for part in own:
            number[part.lowest - lowest :][: len(part.number)] += part.number
        return cls(lowest, number)

    @classmethod
    def of(cls, dense: NDArray[np.int64]) -> CodeCounts:
        """Return the counts (codes,) from code 0 on, without the codes at either end that don't come."""
        there = np.flatnonzero(dense)
        if there.size == 0:
            return cls(0, np.zeros(0, np.int64))
        return cls(int(there[0]), dense[there[0] : there[-1] + 1].copy())


@dataclass(frozen=True, eq=False)
class FrameCodes:
    """The codes of one frame.

    cells   counts by cell of the 2 x 2 mosaic, in the order of `CELLS`
    digest  of the frame: equal for frames that are equal, bit for bit
    """

    cells: tuple[CodeCounts, ...]
    digest: bytes = b""

    @classmethod
    def count(cls, frame: NDArray[Any], *, with_digest: bool = False) -> FrameCodes:
        """Return the codes of a frame (rows, cols), DN.

        >>> FrameCodes.count(np.array([[5, 7], [5, 9]], np.uint16)).every.mean_dn
        6.5
        """
        counts = np.zeros((len(CELLS), CODES), np.int64)
        _count(np.ascontiguousarray(frame, np.uint16), counts)
        digest = hashlib.blake2b(np.ascontiguousarray(frame).data, digest_size=16).digest() if with_digest else b""
        return cls(tuple(CodeCounts.of(one) for one in counts), digest)

    @cached_property
    def every(self) -> CodeCounts:
        """Counts of all pixels."""
        return CodeCounts.total(self.cells)

    def of_channel(self, cfa: Cfa, channel: str) -> tuple[CodeCounts, ...]:
        """Return the counts of a channel's cells in a stated mosaic: of R, B or Y one, of G two, first that on the red
        rows."""
        if cfa == "MONO":
            return (self.every,)
        return tuple(self.cells[CELLS.index(place)] for place in phases(cfa)[channel])

    def channel(self, cfa: Cfa, channel: str) -> CodeCounts:
        """Return the counts of all pixels of a channel (R, G, B, or Y) of a stated mosaic."""
        return CodeCounts.total(self.of_channel(cfa, channel))
