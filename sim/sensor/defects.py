"""Defective pixels of a sensor: fixed by a seed, the same in every frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc, gammaincinv

from sim.spectrum import FloatArray


@lru_cache(maxsize=8)
def defective_pixels(shape: tuple[int, ...], share: float, seed: int) -> NDArray[np.intp]:
    """Choose round(share x pixels) different pixels, at least one, in random order.

    shape : of the frame; share : 0..1; seed : of the choice

    Returns flat indices.

    >>> len(defective_pixels((10, 10), 0.05, 1))
    5
    """
    pixels = int(np.prod(shape))
    count = min(max(round(share * pixels), 1), pixels)
    chosen = np.random.default_rng([seed, 1]).choice(pixels, count, replace=False)
    chosen.flags.writeable = False
    return chosen


#: Below this relative standard deviation all defective pixels are equal.
ALIKE = 0.02


@lru_cache(maxsize=8)
def defect_sizes(shape: tuple[int, ...], share: float, seed: int, spread: float = 1.0) -> FloatArray:
    """(shape): variables of mean 1 and standard deviation `spread` at `defective_pixels`, gamma distributed (1:
    exponential), 0 elsewhere."""
    sizes = np.zeros(shape)
    chosen = defective_pixels(shape, share, seed)
    drawn = np.random.default_rng([seed, 2]).exponential(1.0, chosen.size)
    if spread < ALIKE:
        drawn = np.ones(chosen.size)
    elif spread != 1.0:
        k = spread**-2
        drawn = gammaincinv(k, -np.expm1(-drawn)) / k
    sizes.flat[chosen] = drawn
    sizes.flags.writeable = False
    return sizes


@lru_cache(maxsize=256)
def size_nodes(spread: float, count: int = 48) -> tuple[FloatArray, FloatArray]:
    """Compute a quadrature of the distribution of `defect_sizes`: means over parts of it, narrower ones towards the
    tail.

    spread : relative standard deviation; count : number of parts

    Returns weights and sizes, (count,) each. The weights and the weighted sizes sum to 1.

    >>> weights, sizes = size_nodes(1.0)
    >>> round(float(weights.sum()), 9), round(float(weights @ sizes), 9)
    (1.0, 1.0)
    """
    if spread < ALIKE:
        return np.ones(1), np.ones(1)
    k = spread**-2
    below = 1.0 - np.linspace(1.0, 0.0, count + 1) ** 2
    at = gammaincinv(k, below[:-1])
    # the mean over a part of a gamma distribution is by the distribution of the next order
    held = np.append(gammainc(k + 1.0, at), 1.0)
    weights = np.diff(below)
    return weights, np.diff(held) / weights


@lru_cache(maxsize=256)
def node_std(spread: float, count: int = 48) -> FloatArray:
    """Standard deviation (count,) of the sizes within each part of `size_nodes`."""
    if spread < ALIKE:
        return np.zeros(1)
    k = spread**-2
    at = gammaincinv(k, 1.0 - np.linspace(1.0, 0.0, count + 1)[:-1] ** 2)
    # E x^2 over a part is by the distribution of the order k + 2, of all sizes 1 + 1 / k
    held = np.append(gammainc(k + 2.0, at), 1.0)
    weights, sizes = size_nodes(spread, count)
    return np.asarray(np.sqrt(np.maximum((1.0 + 1.0 / k) * np.diff(held) / weights - np.square(sizes), 0.0)))


@dataclass(frozen=True)
class Defects:
    """A share of the pixels, chosen by a seed, with sizes that are gamma distributed about their mean: a `relative_std`
    of 1 is an exponential distribution, 0 are sizes that are all alike. The unit of `mean_size` is that of what the
    pixels do.
    """

    share: float
    mean_size: float
    relative_std: float
    seed: int

    def pixels(self, shape: tuple[int, ...]) -> NDArray[np.intp]:
        """Their flat indices."""
        return defective_pixels(shape, self.share, self.seed)

    def sizes(self, shape: tuple[int, ...]) -> FloatArray:
        """(shape): their sizes, 0 in all other pixels."""
        return self.mean_size * defect_sizes(shape, self.share, self.seed, self.relative_std)

    def nodes(self) -> tuple[FloatArray, FloatArray]:
        """Return the distribution of sizes by nodes: shares of all pixels (k,) and sizes (k,)."""
        weights, sizes = size_nodes(self.relative_std)
        return self.share * weights, self.mean_size * sizes

    def node_std(self) -> FloatArray:
        """Return the standard deviation of the sizes within each node's part of the distribution, (k,)."""
        return self.mean_size * node_std(self.relative_std)


@dataclass(frozen=True)
class Jumps(Defects):
    """Pixels that jump between two levels, a size apart: the higher one in `high_share` of the frames. Their mean is
    nil.
    """

    high_share: float = 0.5
