"""The slanted-edge estimator on a region: `edge_mtf`, and `planes_mtf` for several planes of a mosaic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.errors import NotDetermined
from lab.fit.mtf.edge_finding import first_line, refined_edge, usable_reach_px, widest_gap_px
from lab.fit.mtf.edge_profile import Quantisation, measured_mtf
from lab.fit.mtf.samples import Plane, Samples, refuse_unusable
from lab.fit.mtf.transfer_function import EdgeMtf
from lab.one_blas_thread import one_blas_thread

Array = NDArray[np.floating[Any]]

WIDEST_GAP_PX = 1.02  # between the distances of the samples from the edge
DEFAULT_FREQUENCY_CY_PER_PX: Array = np.arange(101) / 100.0


def edge_mtf(
    region: ArrayLike, frequency_cy_per_px: ArrayLike | None = None, noise_std: float | None = None
) -> EdgeMtf:
    """MTF of a linear region (rows, cols) that holds one straight or gently bent edge at any angle.

    `frequency_cy_per_px` (frequencies,) defaults to 0..1 by 0.01. `noise_std`, in the unit of the region, is estimated
    from the residuals on both sides of the edge where it isn't given. The angle is from the vertical, -90 to 90 deg,
    positive where the top of the edge turns to the right. Raises `NotDetermined` where there is no single edge,
    ValueError for frequencies or a `noise_std` that are not usable. The method: `lab.fit.mtf`.
    """
    values = np.asarray(region, dtype=float)
    if values.ndim != 2:
        raise NotDetermined("mtf", f"a region has two dimensions, this one has {values.ndim}")
    return planes_mtf([Plane(values)], frequency_cy_per_px, noise_std)


@one_blas_thread
def planes_mtf(
    planes: Sequence[Plane],
    frequency_cy_per_px: ArrayLike | None = None,
    noise_std: float | None = None,
    code: float = 0.0,
    frames: int = 1,
) -> EdgeMtf:
    """As `edge_mtf`, from one or more planes that see the same edge with the same blur (the two green ones).

    Each plane is levelled by itself, so that unequal gains don't matter. `code`: the values were rounded to multiples
    of it (0: not at all) before a mean of `frames` was taken; where the noise is below the step, the error of rounding
    is part of the uncertainty.
    """
    frequency = (
        DEFAULT_FREQUENCY_CY_PER_PX if frequency_cy_per_px is None else np.asarray(frequency_cy_per_px, dtype=float)
    )
    if frequency.ndim != 1 or not np.isfinite(frequency).all() or (frequency < 0.0).any():
        raise ValueError("frequency_cy_per_px must be a list of finite frequencies that aren't negative")
    if noise_std is not None and not 0.0 < noise_std < np.inf:
        raise ValueError(f"noise_std = {noise_std} must be positive and finite; without it the residual says it")
    refuse_unusable(planes)
    edge = first_line(planes[0])
    widest = usable_reach_px(planes, edge)
    near = Samples.near(planes, edge, min(max(16.0, 3.0 * planes[0].step), widest) + 8.0)
    edge = refined_edge(near, edge, widest)
    gap = widest_gap_px(near, edge, np.ones(len(near.value), dtype=bool))
    if gap > WIDEST_GAP_PX:
        raise NotDetermined(
            "mtf",
            f"the samples lie {gap:.1f} px apart across the edge: turn the edge by 2 deg or more, or take a longer one",
        )
    return measured_mtf(
        planes, near, edge, usable_reach_px(planes, edge), frequency, noise_std, Quantisation(code, frames)
    )
