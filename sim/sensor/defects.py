"""Which pixels of a sensor are unlike the others: fixed by a seed, the same in every frame."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sim.spectrum import FloatArray


@lru_cache(maxsize=8)
def odd_pixels(shape: tuple[int, ...], share: float, seed: int) -> NDArray[np.intp]:
    """Flat indices of round(share x pixels) different pixels, at least one, in random order."""
    pixels = int(np.prod(shape))
    count = min(max(round(share * pixels), 1), pixels)
    chosen = np.random.default_rng([seed, 1]).choice(pixels, count, replace=False)
    chosen.flags.writeable = False
    return chosen


@lru_cache(maxsize=8)
def exponential_excess(shape: tuple[int, ...], share: float, seed: int) -> FloatArray:
    """(shape): exponential variables of mean 1 in `odd_pixels`, 0 elsewhere."""
    excess = np.zeros(shape)
    chosen = odd_pixels(shape, share, seed)
    excess.flat[chosen] = np.random.default_rng([seed, 2]).exponential(1.0, chosen.size)
    excess.flags.writeable = False
    return excess
