"""Pixels that stand out of their plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.fit.noise.frame_sums import BoolArray
from lab.fit.noise.shading import shading
from lab.fit.rounding import QUANTISATION_DN2
from sim.camera import Cfa
from sim.sensor.mosaic import planes

DEFECT_SIGMA = 8.0  # a normal pattern of a million pixels doesn't reach that far


def defective_pixels(image: NDArray[np.floating[Any]], cfa: Cfa) -> BoolArray:
    """Pixels of a mean frame (rows, cols) beyond 8 robust standard deviations of their plane, as a mask (rows, cols).

    Robust: 1.4826 times the median modulus of the residual from the smooth surface.
    """
    bad = np.zeros(image.shape, bool)
    for name, plane in planes(image, cfa).items():
        rest = plane - np.median(plane)
        # Most pixels of a rounded plane may be equal: the least scale is then that of rounding, else a tenth of a DN
        least = np.sqrt(QUANTISATION_DN2) if not np.median(np.abs(rest)) > 0 else 0.1
        for _ in range(2):  # glow widens the first scale, hot pixels distort the first surface
            limit = DEFECT_SIGMA * max(1.4826 * float(np.median(np.abs(rest))), least)
            rest = rest - shading(np.clip(rest, -limit, limit))
        limit = DEFECT_SIGMA * max(1.4826 * float(np.median(np.abs(rest))), least)
        planes(bad, cfa)[name][...] = np.abs(rest) > limit
    return bad
