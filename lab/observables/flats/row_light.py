"""Light that changes while a frame is taken, in measurements of single frames: a scatter, as the time at which a frame
begins in a period of the light isn't known."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from sim.spectrum import FloatArray
from sim.uniform import Uniform

#: Times within a period at which a frame may begin.
PHASES = 24
ROW_LIGHT = frozenset({"light.rows"})


def row_light_scatter(
    model: Uniform, rows: int, exposure_s: float, frames: float, of: Callable[[FloatArray], FloatArray]
) -> list[FloatArray]:
    """Vectors v_k (n,) such that sum_k v_k v_k' is the covariance of n numbers in the mean of `frames` frames that
    begin at random times. `of`: factors on the light by row (phases, rows) -> the numbers of single frames (phases,
    n)."""
    if not model.varies_by_row:
        return []
    numbers = of(model.row_factors_by_phase(rows, exposure_s, PHASES))
    away = (numbers - numbers.mean(0)) / np.sqrt(len(numbers) * frames)
    _, size, direction = np.linalg.svd(away, full_matrices=False)
    return [s * d for s, d in zip(size, direction, strict=True) if s > 1e-9]


def row_light_variance(model: Uniform, rows: int, exposure_s: float, part: slice = slice(None)) -> float:
    """Relative variance of the mean level of the rows `part` in single frames that begin at random times."""
    if not model.varies_by_row:
        return 0.0
    return float(np.var(model.row_factors_by_phase(rows, exposure_s, PHASES)[:, part].mean(1)))


def nuisances(name: str, scattered: Iterable[FloatArray]) -> dict[str, FloatArray]:
    """Vectors as columns of a prediction's Jacobian, for nuisance parameters of standard deviation 1."""
    return {f"{name}:row light:{k}": v for k, v in enumerate(scattered)}
