"""Where the converter's input lands: the share of each ideal code's input that a law of the converter gives each
code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import sparse

from lab.observables.dataset import Dataset
from sim.effects.base import Effects
from sim.spectrum import FloatArray
from sim.uniform import Uniform

FINE = 8  # samples a code at which the converter's law is evaluated where it isn't straight
#: Codes by which the middle of 1 / `FINE` of a code may land off the mean of its ends, where the law is straight.
JUMP = 1e-3
STRAIGHT = 1e-9  # codes: second difference of a law between codes, of rounding alone
MARGIN = 64  # codes beyond those that are counted


def landings(first: int, size: int, effects: Effects, dataset: Dataset) -> sparse.csr_array:
    """Return the matrix (n, n) of shares of the inputs of ideal codes (columns) that give each code (rows): of `size`
    codes from `first` on, and `MARGIN` on either side.

    An ideal code's input lands evenly between where its ends land, and what lands on each code is exact. Where the
    law bends within it, it is sampled `FINE` times, and samples in which it bends as often again.
    """
    law = Uniform(dataset.camera, effects).codes
    first, size = first - MARGIN, size + 2 * MARGIN
    edge = np.asarray(np.arange(size + 1) - 0.5, float)
    lands = law(edge + first) - first
    bend = np.abs(np.diff(lands, 2)) > STRAIGHT
    bent = np.zeros(len(edge) - 1, bool)
    bent[:-1] |= bend
    bent[1:] |= bend
    straight = np.flatnonzero(~bent)
    parts = [_shares(straight, lands[straight], lands[straight + 1], 1.0)]
    cell = np.flatnonzero(bent)
    begin, step = edge[:-1][bent], 1.0
    for is_last in (False, True):
        # a sample is an interval of `step` codes
        step /= FINE
        cell, begin = np.repeat(cell, FINE), (begin[:, None] + step * np.arange(FINE)).ravel()
        one, other, middle = (_at(law, begin + share * step, first) for share in (0.0, 1.0, 0.5))
        low, high = np.minimum(one, other), np.maximum(one, other)
        bends = np.abs(middle - 0.5 * (low + high)) > JUMP * (FINE * step)
        if is_last:  # it lands where its middle lands, as wide as without the law
            low[bends], high[bends] = middle[bends] - 0.5 * step, middle[bends] + 0.5 * step
            bends[:] = False
        parts.append(_shares(cell[~bends], low[~bends], high[~bends], step))
        cell, begin = cell[bends], begin[bends]
    code, column, share = (np.concatenate(part) for part in zip(*parts, strict=True))
    inside = (code >= 0) & (code < size) & (share > 0.0)
    return sparse.csr_array((share[inside], (code[inside], column[inside])), shape=(size, size))


def widths(codes: Any, effects: Effects, dataset: Dataset) -> FloatArray:
    """Width (codes,) of each code of a histogram: the interval of the converter's input that gives it, 1 for an ideal
    converter."""
    return np.asarray(landings(codes.first, len(codes.count), effects, dataset).sum(axis=1)[MARGIN:-MARGIN])


def _at(law: Callable[[FloatArray], FloatArray], place: FloatArray, first: int) -> FloatArray:
    return np.asarray(law(place + first) - first)


def _shares(cell: Any, low: FloatArray, high: FloatArray, step: float) -> tuple[Any, Any, FloatArray]:
    """Return codes, cells and shares: of inputs of `step` codes in each cell (n,), which land evenly from `low` to
    `high`."""
    begin = np.rint(low).astype(int)
    most = int((np.rint(high) - begin).max(initial=0)) + 1
    code = begin[:, None] + np.arange(most)
    within = np.minimum(high[:, None], code + 0.5) - np.maximum(low[:, None], code - 0.5)
    stretch = high - low
    share = np.clip(within, 0.0, None) / np.where(stretch > 0.0, stretch, 1.0)[:, None]
    share[stretch <= 0.0, 0] = 1.0  # all of it on one code
    return code.ravel(), np.repeat(cell, most), step * share.ravel()
