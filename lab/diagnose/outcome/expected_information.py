"""Expected information of captures about which of several rivals acts.

Under rival k, a capture's numbers y are normal about m_k + J_k t: t, standard normal, are the rival's parameters as far
as the recordings left them open. Captures that are taken together share t, so that one may pin a parameter without
which another tells nothing. The information is bounded from below by the rivals' Bhattacharyya distances B (Kolchinsky
and Tracey, Entropy 19, 361, 2017):

    I >= -sum_k p_k ln sum_l p_l exp(-B_kl)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag, cholesky, solve_triangular

from sim.spectrum import FloatArray


@dataclass(frozen=True)
class Forecast:
    """What each of k rivals predicts of one capture, in directions in which the numbers have unit noise.

    mean : (k, n)
    jacobian : of each rival (n, p), the change by one posterior standard deviation of each of its parameters
    law_error : of each rival (n, q), the change by one standard deviation of its law's error in this capture alone
    """

    mean: FloatArray
    jacobian: tuple[FloatArray, ...]
    law_error: tuple[FloatArray, ...]

    @classmethod
    def of(
        cls,
        mean: FloatArray,
        jacobian: Sequence[FloatArray],
        law_error: Sequence[FloatArray],
        covariance: FloatArray,
    ) -> Forecast:
        """Return the forecast of numbers with that `covariance` (n, n). Only directions in which rivals differ are
        kept: in all others every rival predicts the same, with the same noise."""
        whole = np.concatenate([(mean - mean[0]).T, *jacobian, *law_error], axis=1)
        white = solve_triangular(cholesky(covariance, lower=True), whole, lower=True)
        basis = np.linalg.qr(white)[0]
        columns = np.split(basis.T @ white, np.cumsum([len(mean), *(j.shape[1] for j in (*jacobian, *law_error))]), 1)
        rivals = len(mean)
        return cls(columns[0].T, tuple(columns[1 : rivals + 1]), tuple(columns[rivals + 1 : 2 * rivals + 1]))

    def distances(self) -> FloatArray:
        """D = 1/2 |m_k - m_l|^2 of each pair of rivals (k, k), at their likeliest parameters."""
        apart = self.mean[:, None] - self.mean[None]
        return np.asarray(0.5 * np.sum(np.square(apart), axis=-1))


def entropy(odds: Sequence[float]) -> float:
    """-sum p ln p, nat."""
    p = np.array([one for one in odds if one > 0.0])
    return float(-np.sum(p * np.log(p)))


def expected_information(forecasts: Sequence[Forecast], odds: Sequence[float]) -> float:
    """Return the information (nat) that captures taken together give about which rival acts. `odds`: probabilities of
    the rivals, which sum to 1."""
    p = np.asarray(odds, float)
    mean, variance = _together(forecasts, len(p))
    near = np.eye(len(p))
    for k, l in combinations(range(len(p)), 2):  # noqa: E741
        near[k, l] = near[l, k] = np.exp(-_bhattacharyya(mean[k] - mean[l], variance[k], variance[l]))
    return float(max(-np.sum(p * np.log(near @ p)), 0.0))


#: Draws a rival behind the probability that captures settle a doubt.
DRAWS = 400


def settling_probability(forecasts: Sequence[Forecast], odds: Sequence[float], threshold: float) -> float:
    """Return the probability that one rival holds `threshold` of the probability after captures that are taken
    together. Each rival's numbers are drawn from its forecast; the standard error is at most 0.5 / sqrt(`DRAWS`)."""
    p = np.asarray(odds, float)
    mean, variance = _together(forecasts, len(p))
    lower = [cholesky(v, lower=True) for v in variance]
    noise = np.random.default_rng(0).standard_normal((mean.shape[1], DRAWS))
    settled = 0.0
    for k in range(len(p)):
        numbers = mean[k][:, None] + lower[k] @ noise
        log = np.empty((len(p), DRAWS))
        for l in range(len(p)):  # noqa: E741
            white = solve_triangular(lower[l], numbers - mean[l][:, None], lower=True)
            log[l] = np.log(p[l]) - 0.5 * np.square(white).sum(axis=0) - np.log(np.diag(lower[l])).sum()
        weight = np.exp(log - log.max(axis=0))
        settled += float(p[k] * np.mean((weight / weight.sum(axis=0)).max(axis=0) >= threshold))
    return settled


def _together(forecasts: Sequence[Forecast], rivals: int) -> tuple[FloatArray, list[FloatArray]]:
    """Return mean (k, n) and covariances (n, n) of captures that are taken together, for each of k rivals."""
    mean = np.concatenate([f.mean for f in forecasts], axis=1)
    variance = []
    for k in range(rivals):
        by_parameters = np.concatenate([f.jacobian[k] for f in forecasts])
        by_law = block_diag(*(f.law_error[k] for f in forecasts))
        variance.append(np.eye(mean.shape[1]) + by_parameters @ by_parameters.T + by_law @ by_law.T)
    return mean, variance


def _bhattacharyya(apart: FloatArray, one: FloatArray, other: FloatArray) -> float:
    """Return the Bhattacharyya distance of two normal distributions with means `apart` (n,) and covariances (n, n)."""
    lower = cholesky(0.5 * (one + other), lower=True)
    white = solve_triangular(lower, apart, lower=True)
    log_det = 2.0 * float(np.log(np.diag(lower)).sum())
    own = [float(np.linalg.slogdet(c)[1]) for c in (one, other)]
    return 0.125 * float(white @ white) + 0.5 * (log_det - 0.5 * sum(own))
