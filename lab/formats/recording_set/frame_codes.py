"""The codes of a frame: how often each comes, by cell of the 2 x 2 mosaic, whatever is stated of the frame.

From these counts follow means, variances, quantiles, clipped shares and the step of the codes, for any mosaic, black
level or white level: a frame is read once, and what its metadata state enters afterwards.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
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
        even, odd = counts[2 * (i % 2)], counts[2 * (i % 2) + 1]  # columns
        for j in range(0, cols - 1, 2):
            even[frame[i, j]] += 1
            odd[frame[i, j + 1]] += 1
        if cols % 2:
            even[frame[i, cols - 1]] += 1


@dataclass(frozen=True, eq=False)
class CodeCounts:
    """Numbers of pixels by code, in the smallest unsigned integers that hold them.

    code_dn  the codes that come, ascending, (n,), DN
    number   pixels with each of them, (n,)
    """

    code_dn: NDArray[np.uint16]
    number: NDArray[np.unsignedinteger[Any]]

    @cached_property
    def pixels(self) -> int:
        """Number of pixels."""
        return int(self.number.sum())

    @property
    def highest_dn(self) -> int:
        """Highest code that comes, DN; 0 without pixels."""
        return int(self.code_dn[-1]) if self.code_dn.size else 0

    @cached_property
    def mean_dn(self) -> float:
        """Mean of the pixels, DN."""
        return int(self.number.astype(np.int64) @ self.code_dn.astype(np.int64)) / self.pixels

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
        return int(self.number[np.searchsorted(self.code_dn, code_dn) :].sum()) / self.pixels

    def quantiles(self, shares: Iterable[float]) -> NDArray[np.float64]:
        """Return the codes, DN, below which `shares` of the pixels lie: `numpy.quantile` of the pixels.

        >>> CodeCounts.of(np.array([0, 0, 1, 0, 1])).quantiles([0.5]).tolist()
        [3.0]
        """
        below = np.cumsum(self.number, dtype=np.int64)
        place = np.asarray(list(shares)) * (self.pixels - 1)
        rank = np.floor(place)
        low, high = (
            self.code_dn[np.searchsorted(below, np.minimum(rank + k, self.pixels - 1), side="right")].astype(float)
            for k in (0, 1)
        )
        return np.asarray(low + (place - rank) * (high - low))

    def dense(self) -> NDArray[np.int64]:
        """Return the number of pixels by code from 0 on, (65536,)."""
        counts = np.zeros(CODES, np.int64)
        counts[self.code_dn] = self.number
        return counts

    @classmethod
    def total(cls, parts: Iterable[CodeCounts]) -> CodeCounts:
        """Return the counts of several parts together."""
        all_parts = [cls.of(np.zeros(0, np.int64)), *parts]
        codes, at = np.unique(np.concatenate([part.code_dn for part in all_parts]), return_inverse=True)
        number = np.zeros(len(codes), np.int64)
        np.add.at(number, at, np.concatenate([part.number.astype(np.int64) for part in all_parts]))
        return cls(codes, _smallest(number))

    @classmethod
    def of(cls, dense: NDArray[np.int64]) -> CodeCounts:
        """Return the counts (codes,) from code 0 on, without the codes that don't come."""
        codes = np.flatnonzero(dense)
        return cls(codes.astype(np.uint16), _smallest(dense[codes]))


def _smallest(number: NDArray[np.int64]) -> NDArray[np.unsignedinteger[Any]]:
    """Return a copy in the smallest unsigned integers: of hundreds of frames the counts are kept."""
    return number.astype(np.min_scalar_type(int(number.max(initial=0))))


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
        return cls(tuple(CodeCounts.of(count) for count in counts), digest)

    def moved(self, row: int, col: int) -> FrameCodes:
        """Return the codes of a part that begins at `row` and `col` of a frame, by the cells of that frame's mosaic."""
        return replace(self, cells=tuple(self.cells[CELLS.index(((r - row) % 2, (c - col) % 2))] for r, c in CELLS))

    @cached_property
    def every(self) -> CodeCounts:
        """Counts of all pixels."""
        return CodeCounts.total(self.cells)

    def channels(self, cfa: Cfa) -> dict[str, tuple[CodeCounts, ...]]:
        """Return the counts of the cells of every channel of a stated mosaic: of R, B or Y one, of G two, first that on
        the red rows. A frame of one row or column has no pixels of some cells, and of some channels: they are left out.
        """
        if cfa == "MONO":
            return {"Y": (self.every,)}
        cells_of_channel = {
            channel: tuple(cell for place in places if (cell := self.cells[CELLS.index(place)]).pixels)
            for channel, places in phases(cfa).items()
        }
        return {channel: cells for channel, cells in cells_of_channel.items() if cells}
