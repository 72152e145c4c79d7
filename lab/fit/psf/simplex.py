"""Quadratic minimisation over the simplex: x >= 0, sum x = 1."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.floating[Any]]

BRIEF_SOLVES, MOST_SOLVES = 4, 80  # factorisations of the active-set step: for an intermediate kernel, for the last one
PATIENCE = 3  # exchanges without gain


def on_simplex(quadratic: Array, linear: Array, start: Array, solves: int = MOST_SOLVES) -> Array:
    """argmin 1/2 x^T Q x - c^T x over x >= 0, sum x = 1, from `start` (n,): `quadratic` Q (n, n), `linear` c (n,).

    Accelerated projected gradients with restarts (O'Donoghue and Candes 2015), then an exact active-set step. `solves`
    limits that step, each iteration of which costs one factorisation; it ends by itself at the optimum.
    """
    scale = np.sqrt(np.diag(quadratic).mean())
    q, c = quadratic / scale**2, linear / scale**2
    vector = np.ones(len(c)) / np.sqrt(len(c))
    for _ in range(12):
        vector = q @ vector
        vector /= np.linalg.norm(vector)
    step = 1.0 / (1.05 * float(np.vdot(vector, q @ vector)))
    x = _project_on_simplex(start)
    y, momentum = x, 1.0
    for _ in range(150):
        new = _project_on_simplex(y - step * (q @ y - c))
        if (y - new) @ (new - x) > 0.0:  # the momentum points uphill: restart
            momentum = 1.0
        following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        y = new + (momentum - 1.0) / following * (new - x)
        done = np.abs(new - x).max() < 1e-9 * new.max()
        x, momentum = new, following
        if done:
            break
    return _polished(q, c, x, solves)


def _project_on_simplex(x: Array) -> Array:
    """Nearest point with x >= 0, sum x = 1."""
    ordered = np.sort(x)[::-1]
    excess = (np.cumsum(ordered) - 1.0) / np.arange(1, len(x) + 1)
    return np.asarray(np.maximum(x - excess[np.flatnonzero(ordered > excess)[-1]], 0.0))


def _polished(q: Array, c: Array, x: Array, solves: int) -> Array:
    """Exact optimum from a nearby point by block principal pivoting (Portugal, Judice and Vicente 1994).

    Solve on the support, then exchange all elements that violate the optimality conditions. Where this stops to gain,
    exchange only the last of them, which terminates.
    """
    free = x > 0.0
    fewest, patience = len(c) + 1, PATIENCE
    tolerance = 1e-10 * np.abs(c).max()
    for _ in range(solves):
        at = np.flatnonzero(free)
        factor = linalg.cho_factor(q[np.ix_(at, at)], check_finite=False)
        both = linalg.cho_solve(factor, np.column_stack([c[at], np.ones(len(at))]), check_finite=False)
        multiplier = (1.0 - both[:, 0].sum()) / both[:, 1].sum()
        solution = np.zeros_like(x)
        solution[at] = both[:, 0] + multiplier * both[:, 1]
        gradient = c - q[:, at] @ solution[at] + multiplier
        violated = np.flatnonzero((free & (solution < 0.0)) | (~free & (gradient > tolerance)))
        x = solution
        if not len(violated):
            break
        if len(violated) < fewest:
            fewest, patience = len(violated), PATIENCE
        elif patience > 0:
            patience -= 1
        else:
            violated = violated[-1:]
        free[violated] = ~free[violated]
    x = np.maximum(x, 0.0)
    return np.asarray(x / x.sum())
