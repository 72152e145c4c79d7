"""The statements that a table of sets says are wrong, in words, with the recordings as they have to be stated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from lab.diagnose.metadata.misstatement import Misstatement
from lab.formats.recording_set import RecordingSet
from lab.inference.hypotheses import Hypothesis
from lab.inference.model import State
from lab.inference.posterior import NAMED, parameter_slice, weights_of_sets
from lab.inference.search import FittedSet, Search, Table
from lab.inference.statements.statement import Restatement
from sim.camera import Side

if TYPE_CHECKING:
    from lab.inference.recordings import SideModel


#: Share of the probability from which on another value is told.
LEAST_TOLD = 0.02


def is_statement(hypothesis: Hypothesis) -> bool:
    """Return whether a hypothesis is that of a wrong statement, and not of an effect."""
    return isinstance(hypothesis.alternatives[0].points[0].template, Restatement)


def inclusion(table: Table) -> Mapping[str, float]:
    """Return the inclusion probability of every member of the table's rows."""
    found: dict[str, float] = {}
    for row in table.rows:
        for name in row.members:
            found[name] = found.get(name, 0.0) + row.probability
    return found


def wrong_statements(
    recordings: RecordingSet, side: Side, search: Search, table: Table
) -> tuple[Misstatement, ...]:  # fmt: skip
    """Return the statements that are wrong with a probability of `NAMED`, likeliest first; each with the recordings in
    which those before it are corrected, too."""
    probabilities = inclusion(table)
    names = [n for n, h in search.hypotheses.items() if is_statement(h) and probabilities.get(n, 0.0) >= NAMED]
    found: list[Misstatement] = []
    for name in sorted(names, key=lambda n: -probabilities[n]):
        weights = weights_of_sets(table, name)
        if not weights:
            continue
        row = next(r for r in table.rows if r.refitted and r.members == max(weights, key=lambda key: weights[key]))
        fit = table.fits[row.members].given(row.unlisted)
        point, own = fit.state[name], parameter_slice(fit, name)
        restatement: Restatement = point.template
        std = np.sqrt(np.maximum(np.diag(fit.laplace.covariance)[own], 0.0))
        told = restatement.told(recordings, side, point.u + fit.laplace.mean[own], std)
        assert restatement.measurement is not None
        check = " ".join([told.check, *_others(recordings, side, fit, name)])
        model = search.model
        without: State = {n: p for n, p in fit.state.items() if n != name}
        before, n = _chi2(model, without, restatement)  # type: ignore[arg-type]
        after, _ = _chi2(model, fit.state, restatement)  # type: ignore[arg-type]
        found.append(
            Misstatement(
                restatement.measurement, told.where, told.shape, check, before, after, n, told.captures,
                told.corrected, told.correction, min(probabilities[name], 1.0),
            )
        )  # fmt: skip
        recordings = told.corrected
    return tuple(found)


def _others(recordings: RecordingSet, side: Side, fit: FittedSet, name: str) -> Iterator[str]:
    """Yield, in words, other values of a wrong statement that hold a part of the probability of a set."""
    modes = (fit, *fit.others)
    log = np.array([fit.base - fit.shift, *(m.base for m in fit.others)])
    share = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    for mode, p in zip(modes[1:], share[1:], strict=True):
        point, own = mode.state[name], parameter_slice(mode, name)
        if p < LEAST_TOLD or point.template is fit.state[name].template:
            continue
        std = np.sqrt(np.maximum(np.diag(mode.laplace.covariance)[own], 0.0))
        other: Restatement = point.template
        told = other.told(recordings, side, point.u + mode.laplace.mean[own], std)
        yield f"Or, with a share of {100.0 * p:.0f} % of the probability: {told.check}"


def _chi2(model: SideModel, state: State, restatement: Restatement) -> tuple[float, int]:
    """chi2, and the number, of the numbers of the measurement that shows a wrong statement, under a set."""
    gaussian = model.gaussian(state, 0.0)
    index = next(k for k, b in enumerate(model.measured.blocks) if b.measurement is restatement.measurement)
    at = gaussian.slices[index]
    residual = model.value[at] - gaussian.mean[at]
    covariance = gaussian.block_covariance(index)
    return float(residual @ np.linalg.solve(covariance, residual)), len(residual)
