"""The posterior of small physics that no list has: delta of one group given the numbers that are used, as curves.

Given a set at its mode and the scales tau, with H_g tau_g = F (n, r), C the covariance of all numbers with theta, u,
form errors and delta marginalised, and r the residual at the posterior mean of u's prior,

    E z = F' C^-1 r,   cov z = 1 - F' C^-1 F,   delta_g = tau_g z.

Over the sets in which the group is unlisted it is their mixture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lab.inference.model import Group, Model, Process, scaled_columns, with_columns
from lab.inference.search import Row, Table
from lab.observables.gaussian import Gaussian
from sim.spectrum import FloatArray

#: The most sets over which delta is a mixture.
MOST_SETS = 6


@dataclass(frozen=True)
class Delta:
    """delta of one group: mean (r,) and covariance (r, r) of the coefficients of its columns, and the mean of tau^2."""

    mean: FloatArray
    covariance: FloatArray
    scale2: float

    def at_nodes(self, process: Process) -> tuple[FloatArray, FloatArray]:
        """Return mean (k,) and covariance (k, k) of a process of the group at its nodes."""
        covariance = process.values @ self.covariance @ process.values.T + self.scale2 * process.rest
        return process.values @ self.mean, covariance


def delta_of(table: Table, model: Model, group: int) -> Delta | None:
    """Return the posterior of a group's delta, given that it is unlisted; None where no refitted set has it so."""
    rows = list(_sets_with(table, group))
    if not rows:
        return None
    weight = np.array([row.probability for row in rows])
    weight /= weight.sum()
    parts = [_given_set(table, model, row, group) for row in rows]
    mean = np.sum([w * p.mean for w, p in zip(weight, parts, strict=True)], axis=0)
    covariance = np.sum(
        [w * (p.covariance + np.outer(p.mean - mean, p.mean - mean)) for w, p in zip(weight, parts, strict=True)],
        axis=0,
    )
    return Delta(mean, covariance, float(weight @ [p.scale2 for p in parts]))


def _sets_with(table: Table, group: int) -> Iterator[Row]:
    """Yield the likeliest refitted sets in which a group is unlisted."""
    found = [row for row in table.rows if group in row.unlisted and row.refitted]
    yield from found[:MOST_SETS]


def _given_set(table: Table, model: Model, row: Row, group: int) -> Delta:
    fit = table.fits[row.members].given(row.unlisted)
    bare = model.gaussian(fit.state, fit.likeliest.form)
    tau = fit.likeliest.scales.mode(row.unlisted)
    gaussian = with_columns(
        bare,
        np.column_stack(
            [scaled_columns(model.groups, tau, len(model.value)), fit.jacobian / np.sqrt(fit.precision)]
        ),
    )  # fmt: skip
    residual = model.value - bare.mean - fit.jacobian @ (fit.pull / fit.precision)
    return condition(gaussian, residual, model.groups[group], float(tau[group]))


def condition(gaussian: Gaussian, residual: FloatArray, group: Group, tau: float) -> Delta:
    """Return delta of a group given the residual (n,) of a distribution whose covariance holds the group at `tau`."""
    own = tau * group.columns
    solved = gaussian.solve(np.column_stack([own, residual]))
    z = own.T @ solved
    left = np.eye(own.shape[1]) - z[:, :-1]
    return Delta(tau * z[:, -1], tau**2 * 0.5 * (left + left.T), tau**2)
