"""Sensitivities from lights as they are usually computed: division, the pseudo-inverse, plain Tikhonov: for comparison,
not for use."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]


def divided(wavelength_nm: Array, operator: Array, signal: Array) -> Array:
    """Signal over the light's integral at the light's centroid, linear between lights; (n, m) `operator` holds the
    weights."""
    total = operator.sum(axis=1)
    centroid = operator @ wavelength_nm / total
    order = np.argsort(centroid)
    return np.interp(wavelength_nm, centroid[order], (signal / total)[order])


def pseudo_inverse(operator: Array, signal: Array) -> Array:
    """The shortest least-squares solution; singular values below a hundredth of the largest are left out."""
    return np.linalg.pinv(operator, rcond=1e-2) @ signal


def tikhonov(operator: Array, signal: Array, std: Array) -> Array:
    """min |(operator S - signal) / std|^2 + strength |second difference of S|^2 with S >= 0, strength by generalised
    cross-validation (of the linear problem)."""
    size = operator.shape[1]
    second = np.diff(np.eye(size), 2, axis=0)
    a, b = operator / std[:, None], signal / std
    normal, bend = a.T @ a, second.T @ second
    unit = np.trace(normal) / np.trace(bend)
    best, chosen = np.inf, unit
    for strength in unit * np.logspace(-9, 3, 49):
        hat = a @ np.linalg.solve(normal + strength * bend, a.T)
        free = b.size - np.trace(hat)
        if free < 1e-3:
            continue
        score = float(np.sum((b - hat @ b) ** 2)) / free**2
        if score < best:
            best, chosen = score, strength
    stacked = np.concatenate([a, np.sqrt(chosen) * second])
    return nnls(stacked, np.append(b, np.zeros(size - 2)), maxiter=100 * size)[0]
