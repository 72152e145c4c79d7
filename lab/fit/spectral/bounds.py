"""The most probable curve within lower bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.spectrum import FloatArray


@dataclass(frozen=True, eq=False)
class LowerBounds:
    """operator (k, m) S >= limit (k,): positivity, and what saturated signals say."""

    operator: FloatArray
    limit: FloatArray


def within_bounds(mean: FloatArray, covariance: FloatArray, bounds: LowerBounds) -> FloatArray:
    """The most probable curve (m,) within bounds, of a normal distribution: an active set on its dual, S = mean + V
    G^T multiplier.
    """
    cross = covariance @ bounds.operator.T
    inner = bounds.operator @ cross
    slack = bounds.operator @ mean - bounds.limit
    ridge = 1e-9 * float(np.mean(np.diag(inner))) + 1e-300
    active = np.zeros(slack.size, bool)
    multiplier = np.zeros(slack.size)
    for _ in range(50):
        now = slack + inner @ multiplier
        worst = np.where(active, np.inf, now)
        # New bounds in batches, as neighbours are violated together; the tolerance is relative to the curve
        entering = worst < -1e-6 * float(np.max(np.abs(mean)))
        if not entering.any():
            break
        active |= entering
        while active.any():
            index = np.flatnonzero(active)
            solved = np.linalg.solve(inner[np.ix_(index, index)] + ridge * np.eye(index.size), -slack[index])
            if np.all(solved >= 0):
                break
            active[index[solved < 0]] = False
        multiplier = np.zeros(slack.size)
        if active.any():
            multiplier[active] = solved
    return np.clip(mean + cross @ multiplier, 0.0, None)
