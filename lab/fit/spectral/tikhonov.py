"""Tikhonov regularisation: posterior of a curve under a second-difference prior, its strength by marginal
likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize

from lab.fit.spectral.curvature_prior import rough_root, signal_covariance, straight_lines
from sim.spectrum import FloatArray


@dataclass(frozen=True, eq=False)
class CurvePrior:
    """The prior of a curve: roughness `shape` (m,) times `strength`, and `fine_share` of fine structure (`fine_covariance`)."""

    shape: FloatArray
    strength: float
    fine_share: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior `mean` (m,) and `covariance` (m, m) of a curve.

    `gain` (m, n): Jacobian of the mean by the signals; `precision` (n, n): inverse covariance of the signals under the prior, whose curves
    aren't known.
    """

    mean: FloatArray
    covariance: FloatArray
    gain: FloatArray
    precision: FloatArray


def likeliest_prior(
    wave: FloatArray,
    operator: FloatArray,
    value: FloatArray,
    std: FloatArray,
    shapes: Sequence[FloatArray],
    fine_share: float = 0.0,
) -> CurvePrior:
    """Of the prior roughnesses `shapes`, (m,) each, the one with the largest marginal likelihood at its best strength, for value = operator S +
    noise, straight lines free.
    """
    line = operator @ straight_lines(wave)
    misfits = [least_misfit(signal_covariance(wave, operator, s, fine_share), line, value, std) for s in shapes]
    best = min(range(len(shapes)), key=lambda i: misfits[i][0])
    return CurvePrior(shapes[best], misfits[best][1], fine_share)


def posterior_under_prior(
    wave: FloatArray, operator: FloatArray, value: FloatArray, std: FloatArray, prior: CurvePrior
) -> Posterior:
    """Posterior of S with value = operator S + noise under `prior`, straight lines free."""
    line = straight_lines(wave)
    rough = rough_root(wave, prior.shape, prior.fine_share)
    rough = rough - line @ np.linalg.lstsq(line, rough, rcond=None)[0]  # straight lines are free
    # Straight lines have a normal prior a thousand times as wide as the curve is high. Singular values keep well and
    # poorly determined directions apart; differences of covariances lose digits where noise is small.
    height = float(np.max(np.abs(value / operator.sum(axis=1))))
    root = np.concatenate([1e3 * height * line, prior.strength * rough], axis=1)
    left, singular, right = np.linalg.svd(operator @ root / std[:, None], full_matrices=True)
    known = np.append(1.0 / np.sqrt(1.0 + singular**2), np.ones(right.shape[0] - singular.size))
    half = root @ right.T * known
    share = singular / (1.0 + singular**2)
    gain = (root @ right[: singular.size].T * share) @ (left[:, : singular.size] / std[:, None]).T
    unknown = left / std[:, None] / np.sqrt(1.0 + np.append(singular, np.zeros(left.shape[1] - singular.size)) ** 2)
    return Posterior(gain @ value, half @ half.T, gain, unknown @ unknown.T)


def least_misfit(covariance: FloatArray, line: FloatArray, value: FloatArray, std: FloatArray) -> tuple[float, float]:
    """Least negative log marginal likelihood of value = line a + strength u + noise over the strength, and that strength.

    u is normal with `covariance` (n, n), a (2,) is free and integrated out. `line` (n, 2), `value`, `std` (n,).
    """
    z, h = value / std, line / std[:, None]
    rest = linalg.qr(h)[0][:, line.shape[1] :]
    eigenvalue, vector = np.linalg.eigh(rest.T @ (covariance / np.outer(std, std)) @ rest)
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
