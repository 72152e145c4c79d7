"""Tikhonov regularisation: posterior of a curve under a second-difference prior, its strength by marginal
likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg, optimize

from lab.fit.spectral.curvature_prior import rough_root, straight_lines
from sim.spectrum import FloatArray


def posterior_under_prior(
    wave: FloatArray,
    operator: FloatArray,
    value: FloatArray,
    std: FloatArray,
    shapes: Sequence[FloatArray],
    fine_share: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Posterior mean (m,) and covariance (m, m) of S with value = operator S + noise, straight lines free.

    Of the prior roughnesses `shapes`, (m,) each, the one with the largest marginal likelihood at its best strength.
    `fine_share`: see `rough_root`.
    """
    line = straight_lines(wave)
    roots = [rough_root(wave, shape, fine_share) for shape in shapes]
    roots = [root - line @ np.linalg.lstsq(line, root, rcond=None)[0] for root in roots]  # straight lines are free
    misfits = [least_misfit(root, line, operator, value, std) for root in roots]
    best = min(range(len(roots)), key=lambda i: misfits[i][0])
    # Straight lines have a normal prior a thousand times as wide as the curve is high. Singular values keep well and
    # poorly determined directions apart; differences of covariances lose digits where noise is small.
    height = float(np.max(np.abs(value / operator.sum(axis=1))))
    prior = np.concatenate([1e3 * height * line, misfits[best][1] * roots[best]], axis=1)
    left, singular, right = np.linalg.svd(operator @ prior / std[:, None], full_matrices=True)
    mean = prior @ (
        right[: singular.size].T @ (singular / (1.0 + singular**2) * (left[:, : singular.size].T @ (value / std)))
    )
    known = np.append(1.0 / np.sqrt(1.0 + singular**2), np.ones(right.shape[0] - singular.size))
    half = prior @ right.T * known
    return mean, half @ half.T


def least_misfit(
    root: FloatArray, line: FloatArray, operator: FloatArray, value: FloatArray, std: FloatArray
) -> tuple[float, float]:
    """Least negative log marginal likelihood of S = lines a + strength root u over the strength, and that strength.

    u is standard normal, a is free and integrated out. `root` (m, m), `line` (m, 2), `operator` (n, m), `value`, `std`
    (n,).
    """
    z, h, f = value / std, operator @ line / std[:, None], operator @ root / std[:, None]
    rest = linalg.qr(h)[0][:, line.shape[1] :]
    eigenvalue, vector = np.linalg.eigh((rest.T @ f) @ (rest.T @ f).T)
    eigenvalue = np.clip(eigenvalue, 0.0, None)
    power = (vector.T @ (rest.T @ z)) ** 2

    def loss(log_square: float) -> float:
        variance = np.exp(log_square) * eigenvalue + 1.0
        return 0.5 * float(np.sum(power / variance + np.log(variance)))

    start = -np.log(max(float(eigenvalue.max()), 1e-300))
    grid = start + np.linspace(-2.0, 40.0, 85)
    best = int(np.argmin([loss(g) for g in grid]))
    found = optimize.minimize_scalar(
        loss, bounds=(grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]), method="bounded"
    )
    return float(found.fun), float(np.exp(0.5 * found.x))
