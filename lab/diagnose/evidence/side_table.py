"""One side, measured and searched: the table of sets, and the models about which it is read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.formats.recording_set import RecordingSet
from lab.inference.check import HeldOutCheck
from lab.inference.hypotheses import symmetric
from lab.inference.model import State, everyday_scales, scaled_columns, with_columns
from lab.inference.posterior import Posterior
from lab.inference.recordings import SideModel, SideProblem
from lab.inference.search import FittedSet, Search, Table
from lab.inference.statements.found import is_statement
from lab.observables.gaussian import Gaussian, chi2, conditional
from lab.observables.observable import Observable
from sim.camera import Side
from sim.effects.base import Effect
from sim.spectrum import FloatArray


@dataclass(frozen=True)
class SideTable:
    """One side: what was measured, the table of sets, what it says, and the check on held-out captures.

    `recordings`: with metadata errors corrected. `least_nothing`: p(nothing) that 1 % of healthy draws fall short of.
    `unchanged`: chi2 of held-out numbers by the baseline alone."""

    recordings: RecordingSet
    side: Side
    problem: SideProblem
    search: Search
    table: Table
    posterior: Posterior
    checked: tuple[HeldOutCheck, ...]
    unchanged: tuple[HeldOutCheck, ...]
    least_nothing: float

    # --- the models --------------------------------------------------------------------------------------------------

    @cached_property
    def used(self) -> MeasurementModel:
        """The model of the numbers that the table rests on: all of them are used."""
        return _marked(self.problem.measured, lambda k: False)

    @cached_property
    def whole(self) -> MeasurementModel:
        """The model of the numbers that are used, and after them of those that are held out, marked so."""
        count = len(self.problem.measured.blocks)
        return _marked(self.problem.whole, lambda k: k >= count)

    @property
    def effects_of(self) -> Callable[[State], tuple[Effect, ...]]:
        """State of a set -> its effects, without wrong statements."""
        return self.model.effects

    def family_of(self, name: str) -> str:
        """Return the identifier of a hypothesis' family."""
        return self.search.hypotheses[name].family

    @cached_property
    def statements(self) -> frozenset[str]:
        """Names of the hypotheses that are wrong statements, and no effects."""
        return frozenset(name for name, one in self.search.hypotheses.items() if is_statement(one))

    @property
    def model(self) -> SideModel:
        """The model that the search used."""
        found = self.search.model
        assert isinstance(found, SideModel)
        return found

    # --- sets --------------------------------------------------------------------------------------------------------

    @cached_property
    def sets(self) -> dict[frozenset[str], float]:
        """Sets of hypotheses with their probabilities, whatever is unlisted beside them, likeliest first."""
        found: dict[frozenset[str], float] = {}
        for row in self.table.rows:
            found[row.members] = found.get(row.members, 0.0) + row.probability
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def unlisted_with(self, members: frozenset[str]) -> frozenset[int]:
        """Return the groups that are likeliest to be unlisted beside a set."""
        rows = [row for row in self.table.rows if row.members == members]
        return max(rows, key=lambda row: row.probability).unlisted if rows else frozenset()

    def fit_of(self, members: frozenset[str]) -> FittedSet | None:
        """Return the fit of a set, made where the closed form has an estimate of it; None where it has none."""
        try:
            return self.search.refit(members)
        except KeyError:
            return None

    def gaussian(self, fit: FittedSet, unlisted: frozenset[int]) -> Gaussian:
        """Return the predictive distribution of the used numbers under a set at its mode: theta, form errors and small
        physics marginalised, these groups of it unlisted."""
        fit = fit.given(unlisted)
        bare = self.model.gaussian(fit.state, fit.likeliest.form)
        tau = fit.likeliest.scales.mode(unlisted)
        return with_columns(bare, scaled_columns(self.problem.groups, tau, len(self.used.value)))

    @cached_property
    def baseline(self) -> Gaussian:
        """The predictive distribution of the used numbers under the empty set, everyday scales at their medians."""
        groups = self.problem.groups
        columns = scaled_columns(groups, everyday_scales(groups), len(self.used.value))
        return with_columns(self.model.gaussian({}, 0.0), columns)

    @cached_property
    def inclusion_prior(self) -> Mapping[str, float]:
        """Prior probability that each hypothesis is a member of the set: over numbers k of members,

        p_k w_i e_{k-1}(w without w_i) / e_k(w),   e_k the elementary symmetric polynomials of the shares w."""
        prior = self.search.prior
        weight, most = prior.weight, len(prior.number) - 1
        total = symmetric(list(weight.values()), most)
        found = {}
        for name, own in weight.items():
            rest = symmetric([w for other, w in weight.items() if other != name], most)
            found[name] = float(
                sum(prior.number[k] * own * rest[k - 1] / total[k] for k in range(1, most + 1) if total[k] > 0.0)
            )
        return found


def predict_by_baseline(problem: SideProblem) -> tuple[HeldOutCheck, ...]:
    """Return chi2 of the held-out numbers of each observable given the used ones, by the camera without effects and
    without small physics: its parameters alone are adapted."""
    if not problem.held_out:
        return ()
    used = len(problem.measured.value)
    gaussian = SideModel(problem.whole, ()).gaussian({}, 0.0)
    seen = np.arange(len(problem.whole.value)) < used
    residual, covariance = conditional(problem.whole.value - gaussian.mean, gaussian.covariance, ~seen, seen)
    found, at = [], 0
    for block in problem.held_out:
        own = slice(at, at + len(block.value))
        value = chi2(residual[own], covariance[own, own])
        found.append(
            HeldOutCheck(block.measurement.name, len(block.value), value, float(chdtrc(len(block.value), value)))
        )
        at = own.stop
    return tuple(found)


def _marked(model: MeasurementModel, is_held_out: Callable[[int], bool]) -> MeasurementModel:
    """Return the model with the numbers of each block marked as held out, or as used."""

    def block_of(k: int, block: Observable) -> Observable:
        labels = tuple(replace(label, held_out=is_held_out(k)) for label in block.labels)
        return replace(block, labels=labels)

    blocks = tuple(block_of(k, block) for k, block in enumerate(model.blocks))
    return replace(model, blocks=blocks, _predictions={}, _covariances={}, _numbers={})


def weighted_residual(model: MeasurementModel, effects: Sequence[Effect], disturbances: FloatArray) -> FloatArray:
    """Return C^-1 (y - m) of the used numbers, zero at the others, (n,). `disturbances`: columns (n, r) of small
    physics, of unit variance."""
    seen = model.seen
    gaussian = with_columns(model.seen_gaussian(tuple(effects)), disturbances[seen])
    weighted = np.zeros(len(model.value))
    weighted[seen] = gaussian.solve(model.seen_value - gaussian.mean)
    return weighted


def posterior_means(
    model: MeasurementModel, effects: Sequence[Effect], disturbances: FloatArray
) -> tuple[dict[str, float], FloatArray]:
    """Return the posterior means of the nuisance parameters by name, and of the change (n,) by small physics, given the
    used numbers."""
    weighted = weighted_residual(model, effects, disturbances)
    estimates = {name: float(column @ weighted) for name, column in model.nuisance_jacobian(effects).items()}
    return estimates, disturbances @ (disturbances.T @ weighted)
