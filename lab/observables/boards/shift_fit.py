"""Displacements of the corners in one colour from those in another, as a combination of a few: for the cameras of the
colours, and for lateral colour by rings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
HUBER_STD = 1.5  # standard deviations of a coordinate from which residuals lose weight
MOST_ITERATIONS = 50


@dataclass(frozen=True)
class ShiftFit:
    """The coefficients `values` (p,), and `influence` (n, p): what the residual of each of the n corners contributes to
    them. `away_std` (n,): lengths of the residuals, in standard deviations of a coordinate, `std_px`.
    """

    values: Array
    influence: Array
    away_std: Array
    std_px: float

    @property
    def covariance(self) -> Array:
        """Return the covariance (p, p) of the values for independent corners: Huber's sandwich."""
        return np.asarray(self.influence.T @ self.influence)


def fit_shift(shift: Array, jacobian: Array) -> ShiftFit:
    """Solve shift (n, 2) = jacobian (n, 2, p) values by robust least squares: Huber's, with the spread of the residuals
    by their median.

    Corners have errors by the demosaicing that aren't normal. Cut off at some residual, another set of them counts in
    each session, and the values jump by more than their standard deviation; Huber's weights change smoothly.
    """
    scale = np.maximum(np.linalg.norm(jacobian, axis=(0, 1)), 1e-12)
    design = jacobian / scale
    weight = np.ones(len(shift))
    values = np.zeros(len(scale))
    for _ in range(MOST_ITERATIONS):
        root, before = np.sqrt(weight)[:, None], values
        weighted = (design * root[..., None]).reshape(-1, len(scale))
        values = np.linalg.lstsq(weighted, (shift * root).ravel(), rcond=1e-12)[0]
        rest = shift - design @ values
        away = np.linalg.norm(rest, axis=1)
        std = max(1.4826 * float(np.median(np.abs(rest))), 1e-6)
        weight = np.minimum(1.0, HUBER_STD * std / np.maximum(away, 1e-12))
        if np.max(np.abs(values - before)) < 1e-3 * std:  # the design's columns have norm 1: `std` is that of a value
            break
    # Beyond the bend, Huber's influence has no slope along the residual and that of its weight across
    slope = np.where(weight < 1.0, 0.5 * weight, 1.0)
    bread = np.linalg.pinv(np.einsum("n,nij,nik->jk", slope, design, design))
    scores = np.einsum("n,nij,ni->nj", weight, design, rest)
    freedom = len(shift) * 2 / max(len(shift) * 2 - len(values), 1)
    return ShiftFit(values / scale, np.sqrt(freedom) * scores @ bread / scale, away / std, std)
