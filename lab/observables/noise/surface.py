"""The smooth surface of an image, shading of the lens and the lamp, and the pixels that stand out of it."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lab.observables.codes.rounding import QUANTISATION_DN2
from lab.observables.noise.frame_sums import BoolArray
from lab.observables.noise.robust import sampled
from sim.camera import Cfa
from sim.sensor.mosaic import planes

SHADING_DEGREE = 6
F = TypeVar("F", bound=np.floating[Any])


def shading_factors(image: NDArray[F], degree: int) -> tuple[NDArray[F], NDArray[F]]:
    """Return the smooth surface as a product (rows, k) @ (k, cols), in the precision of the image. Least squares on
    means of blocks.
    """
    rows, cols = image.shape
    # At most 32 blocks an axis; each degree needs three
    counts = [int(np.clip(size // 8, 1, 32)) for size in (rows, cols)]
    block = rows // counts[0], cols // counts[1]
    inner = image[: counts[0] * block[0], : counts[1] * block[1]]
    means = inner.reshape(counts[0], block[0], counts[1], block[1]).mean(axis=(1, 3), dtype=float)
    full, small = [], []
    for size, count, width in zip((rows, cols), counts, block, strict=True):
        order = surface_degree(size, degree)
        at = 2.0 * (np.arange(size) + 0.5) / size - 1.0
        basis = np.polynomial.legendre.legvander(at, order)
        full.append(basis)
        small.append(basis[: count * width].reshape(count, width, -1).mean(axis=1))
    coefficients = np.linalg.pinv(small[0]) @ means @ np.linalg.pinv(small[1]).T
    return (full[0] @ coefficients).astype(image.dtype), np.ascontiguousarray(full[1].T.astype(image.dtype))


def surface_degree(size: int, degree: int = SHADING_DEGREE) -> int:
    """Degree of the surface along an axis of `size` pixels; small images have too few blocks for the full one."""
    return min(degree, int(np.clip(size // 8, 1, 32)) // 3)


def shading(image: NDArray[F], degree: int = SHADING_DEGREE) -> NDArray[F]:
    """Smooth surface of an image (rows, cols): the polynomial of `degree` in rows and in columns nearest to its block
    means.
    """
    down, across = shading_factors(image, degree)
    return down @ across


DEFECT_SIGMA = 8.0  # a normal pattern of a million pixels doesn't reach that far


def defective_pixels(image: NDArray[np.floating[Any]], cfa: Cfa, step_dn: float = 1.0) -> BoolArray:
    """Pixels of a mean frame (rows, cols) beyond 8 robust standard deviations of their plane, as a mask (rows, cols).

    Robust: 1.4826 times the median modulus of the residual from the smooth surface. `step_dn`: step of the codes.
    """
    bad = np.zeros(image.shape, bool)
    for name, plane in planes(image, cfa).items():
        rest = plane - np.median(sampled(plane))
        # Most pixels of a rounded plane may be equal: the least scale is then that of rounding, else a tenth of a step
        least = step_dn * (np.sqrt(QUANTISATION_DN2) if not np.median(np.abs(sampled(rest))) > 0 else 0.1)
        for _ in range(2):  # glow widens the first scale, hot pixels distort the first surface
            limit = DEFECT_SIGMA * max(1.4826 * float(np.median(np.abs(sampled(rest)))), least)
            rest = rest - shading(np.clip(rest, -limit, limit))
        limit = DEFECT_SIGMA * max(1.4826 * float(np.median(np.abs(sampled(rest)))), least)
        planes(bad, cfa)[name][...] = np.abs(rest) > limit
    return bad
