"""The held-out predictive check: captures that no fit has used, against the prediction of the whole table.

Every third capture in time within a setting is held out, by its id, before anything is fitted."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc

from lab.formats.recording_set import RecordingSet
from lab.inference.hypotheses import coordinates_of, moved, stacked
from lab.inference.model import scaled_columns, with_columns
from lab.observables.gaussian import BlockCovariance, chi2
from sim.camera import Side
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from lab.inference.recordings import SideProblem
    from lab.inference.search import Row, Search, Table

#: Keys of a capture that don't belong to its setting: which frame it is, and the readings of its light.
_NOT_OF_SETTING: dict[str, Any] = dict.fromkeys(
    ("id", "frame", "time", "temperature_c", "dummy_frames", "radiance", "light_radiance", "dark_radiance"), True
) | {"screen": {"radiance": True}}
#: Of the captures of a setting, in time: the last of every so many is held out, so that among those that are used some
#: follow another of their own setting.
ONE_IN = 3


def held_out_ids(recordings: RecordingSet, side: Side) -> frozenset[str]:
    """Return the ids of one side's captures that are held out: every third in time of each setting with three or more.

    A setting is all that a capture states but its time, its temperature, its frame and the readings of its light. Where
    captures have no time, the manifest's order stands for it."""
    settings: dict[str, list[tuple[float, int, str]]] = {}
    for order, capture in enumerate(recordings.captures(side=side)):
        setting = capture.model_dump_json(exclude=_NOT_OF_SETTING)
        time = 0.0 if capture.time is None else capture.time.timestamp()
        settings.setdefault(setting, []).append((time, order, capture.id))
    return frozenset(
        name
        for group in settings.values()
        if len(group) >= ONE_IN
        for k, (_, _, name) in enumerate(sorted(group))
        if k % ONE_IN == ONE_IN - 1
    )


#: Family-wise rate of false contradictions.
RATE = 0.005
#: Probability of the table that the prediction has to hold, and the most sets that are predicted.
SHARE, MOST_ROWS = 0.95, 6


@dataclass(frozen=True)
class HeldOutCheck:
    """One observable's held-out numbers against the prediction: chi2 of n numbers, and the probability of as large a
    chi2, both means over the table."""

    measurement: str
    n: int
    chi2: float
    p: float
    contradicts: bool = False


def check_held_out(problem: SideProblem, search: Search, table: Table) -> tuple[HeldOutCheck, ...]:
    """Return p(y* | y) of the whole table, observable by observable; by Holm's procedure, which contradict it."""
    rows = _likeliest(table)
    if not problem.held_out or not rows:
        return ()
    weight = np.array([r.probability for r in rows])
    weight /= weight.sum()
    names = [b.measurement.name for b in problem.held_out]
    values = np.zeros((len(rows), len(names)))
    counts = np.array([len(b.value) for b in problem.held_out])
    for k, row in enumerate(rows):
        residual, covariance = _predict(problem, search, row, table)
        at = 0
        for j, n in enumerate(counts):
            own = slice(at, at + n)
            lower = BlockCovariance(covariance[own, own]).lower
            values[k, j] = float(np.sum(np.square(np.linalg.solve(lower, residual[own]))))
            at += n
    p = weight @ chdtrc(counts, values)
    against = holm(p, RATE)
    found = zip(names, counts, weight @ values, p, against, strict=True)
    return tuple(HeldOutCheck(name, int(n), float(c), float(q), bool(no)) for name, n, c, q, no in found)


def holm(p: FloatArray, rate: float) -> np.ndarray:
    """Return which of some probabilities contradict at a family-wise rate (Holm, 1979)."""
    order = np.argsort(p)
    fails = p[order] < rate / (len(p) - np.arange(len(p)))
    fails &= np.cumprod(fails).astype(bool)
    found = np.zeros(len(p), bool)
    found[order] = fails
    return found


def _likeliest(table: Table) -> list[Row]:
    found: list[Row] = []
    for row in table.rows:
        if row.refitted:
            found.append(row)
        if sum(r.probability for r in found) > SHARE or len(found) == MOST_ROWS:
            break
    return found


@dataclass(frozen=True)
class CurvePrediction:
    """What delta of one group, given the used numbers, takes off chi2 of n held-out numbers: chi2 of their residuals
    without any delta of the group, and with its mean; both by the covariance without it."""

    n: int
    chi2_before: float
    chi2_after: float


def predict_by_curve(
    problem: SideProblem, search: Search, table: Table, group: int, measurements: Collection[str]
) -> CurvePrediction | None:
    """Return how well delta of a group predicts the held-out numbers of some measurements, under the likeliest set in
    which it is unlisted; None where none of them is held out."""
    row = next((r for r in table.rows if group in r.unlisted and r.refitted), None)
    names = np.array([b.measurement.name for b in problem.held_out for _ in b.value])
    where = np.isin(names, list(measurements))
    if row is None or not where.any():
        return None
    without, covariance = _predict(problem, search, row, table, without=group)
    beside, _ = _predict(problem, search, row, table)
    own = covariance[np.ix_(where, where)]
    return CurvePrediction(int(where.sum()), chi2(without[where], own), chi2(beside[where], own))


def _predict(
    problem: SideProblem, search: Search, row: Row, table: Table, without: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Residual (n*,) and covariance (n*, n*) of the held-out numbers given those that are used, under one set, its
    parameters, theta and delta marginalised about the mode. `without`: a group of which there is none."""
    fit = table.fits[row.members].given(row.unlisted)
    model = problem.whole_model(problem.groups)
    used = len(problem.measured.value)
    value = problem.whole.value
    gaussian = model.gaussian(fit.state, fit.likeliest.form)
    tau = fit.likeliest.scales.mode(row.unlisted).copy()
    if without is not None:
        tau[without] = 0.0
    disturbances = np.vstack(
        [
            scaled_columns(problem.groups, tau, used),
            np.column_stack(
                [t * g.held_out for g, t in zip(problem.groups, tau, strict=True) if g.held_out is not None and t > 0.0]
            ),
        ]
    )
    coords = [c for _, _, c in coordinates_of(search.hypotheses, fit.state)]
    u = stacked(fit.state)
    columns = []
    for k, c in enumerate(coords):
        step = c.step or 0.02 * c.unit
        shifted = u.copy()
        shifted[k] += -step if u[k] + step > c.upper else step
        columns.append((model.mean(moved(fit.state, shifted)) - gaussian.mean) / (shifted[k] - u[k]))
    jacobian = np.array(columns).T if columns else np.zeros((len(value), 0))
    residual = value - gaussian.mean - jacobian @ (fit.pull / fit.precision)
    gaussian = with_columns(gaussian, np.column_stack([disturbances, jacobian / np.sqrt(fit.precision)]))
    f = gaussian.shared_jacobian
    alone = type(gaussian)(gaussian.mean, gaussian.blocks, np.zeros((len(value), 0)))
    white = alone.whiten(np.column_stack([f, residual]))[:used]  # blocks of used and held-out numbers are apart
    table_, r = white[:, :-1], white[:, -1]
    inner = np.linalg.inv(np.eye(table_.shape[1]) + table_.T @ table_)
    mean = inner @ (table_.T @ r)
    covariance = f[used:] @ inner @ f[used:].T
    at = 0
    for block in gaussian.blocks[_blocks_used(problem) :]:
        n = len(block.covariance)
        covariance[at : at + n, at : at + n] += block.covariance
        at += n
    return residual[used:] - f[used:] @ mean, covariance


def _blocks_used(problem: SideProblem) -> int:
    return len(problem.measured.blocks)


def passes(checked: Sequence[HeldOutCheck]) -> bool:
    """Whether no observable contradicts."""
    return not any(c.contradicts for c in checked)
