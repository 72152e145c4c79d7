"""Which sets of effects explain the seen numbers: all small sets are compared in closed form about the sets fitted so
far, the best few are refitted in full, until none is better."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, zip_longest

from scipy import special

from lab.diagnose.inference.closed_form import LinearProblem, LinearSet, posterior, smallest_set
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import Fit, log_likelihood, refit
from lab.diagnose.inference.score import Changes, Signatures, signatures_of
from lab.diagnose.policy import DecisionPolicy
from sim.effects.base import Effect, Effects

#: Most sets whose signatures are kept, 10 MB each in a session of 200 frames: those of the current set and of its
#: subsets, which are asked for again.
MOST_SIGNATURES = 8


@dataclass(frozen=True)
class Model:
    """A set of effects by name, with its posterior probability among all sets of listed effects. `refitted`: False
    where that is of the linear problem about another set."""

    effects: tuple[str, ...]
    probability: float
    refitted: bool = True


@dataclass(frozen=True)
class ModelSet:
    """What the search says: the smallest set of models that holds `policy.model_set_share`, likeliest first; every
    effect's probability of being a part, likeliest first; and what the budget left, sets of effects by name."""

    models: tuple[Model, ...] = ()
    inclusion: tuple[tuple[str, float], ...] = ()
    not_weighed: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class _Proposal:
    """A set to be refitted: where that starts, and the set whose Jacobian it reuses."""

    start: tuple[Effect, ...]
    beside: Fit

    @property
    def key(self) -> frozenset[str]:
        return frozenset(e.name for e in self.start)


@dataclass
class Search:
    """The sets that were fitted so far, by their effects' names, and the search over further ones.

    `threshold` is that of the scores, which one healthy camera in a hundred reaches; `above_noise`: by how much drawn
    healthy cameras have raised it. `changes`: of the candidates' prototypes, beside no effect. `clock` gives the CPU
    time (s) that the budget is counted in, from the search's beginning. `not_weighed`: what the budget left.
    """

    model: MeasurementModel
    candidates: tuple[type[Effect], ...]
    changes: Changes
    threshold: float
    policy: DecisionPolicy = field(default_factory=DecisionPolicy)
    above_noise: float = 0.0
    fits: dict[frozenset[str], Fit] = field(default_factory=dict)
    clock: Callable[[], float] = time.process_time
    not_weighed: dict[frozenset[str], tuple[str, ...]] = field(default_factory=dict)
    _whole: dict[frozenset[str], float] = field(default_factory=dict)
    _signatures: dict[tuple[Effect, ...], Signatures] = field(default_factory=dict)
    _problems: dict[tuple[Effect, ...], LinearProblem] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._begin = self.clock()

    @property
    def is_spent(self) -> bool:
        """Whether the budget is."""
        return self.clock() - self._begin > self.policy.search_cpu_s

    def signatures(self, fit: Fit) -> Signatures:
        """Residual and signatures about a fitted set, its parameters projected out, of the candidates that aren't in
        it."""
        if fit.effects not in self._signatures:
            if len(self._signatures) >= MOST_SIGNATURES:
                self._signatures.pop(next(iter(self._signatures)))
            others = [c for c in self.changes if c[0].name not in fit.names]
            self._signatures[fit.effects] = signatures_of(self.model, fit.effects, others, fit.jacobian, fit.tolerated)
        return self._signatures[fit.effects]

    # --- log odds ----------------------------------------------------------------------------------------------------

    def log_odds(self, fit: Fit) -> float:
        """Log posterior of a set, less what each of its effects has to earn."""
        return fit.log_posterior - self.needed_log_odds * len(fit.effects)

    @cached_property
    def needed_log_odds(self) -> float:
        """Gain in log posterior that an effect has to earn: it is there with `least_inclusion_probability`, by how
        often effects occur."""
        policy = self.policy
        likely = policy.included_log_odds + float(special.logit(policy.least_inclusion_probability))
        return likely + 0.5 * self.above_noise

    def _parameters_cost(self, kind: type[Effect]) -> float:
        return self.policy.parameter_log_odds * sum(not q.dispensable for q in kind.quantities().values())

    @cached_property
    def _cost(self) -> dict[str, float]:
        """Gain in log-likelihood that each effect has to earn."""
        return {e.name: self.needed_log_odds + self._parameters_cost(e) for e in self.candidates}

    # --- search ------------------------------------------------------------------------------------------------------

    def best(self, report: Callable[[str], None] = lambda _: None) -> Fit:
        """From no effect on: the likeliest of the sets with one effect more, one exchanged or one less, and of those
        with one more beside the runner-up, until the log odds don't rise; then of the sets with one effect exchanged
        for two, or two or three more that by themselves aren't seen. Of each kind the best in closed form are refitted,
        about the current set, or about it without the member that is exchanged."""
        current = self.fitted((), converged=True)
        for step in range(self.policy.search_steps):
            report(f"looking for {'another' if step else 'an'} effect")
            better = self._refitted(current, wide=False) or self._refitted(current, wide=True)
            if better is None:
                break
            current = better
        return current

    def _refitted(self, current: Fit, *, wide: bool) -> Fit | None:
        """Return the likeliest of the sets about the current one, refitted as far as the budget goes; None where it is
        no better."""
        for proposal in self._proposals(current, wide=wide):
            if self.is_spent:
                self.leave(proposal.start)
            else:
                self.fitted(proposal.start, beside=proposal.beside)
        return self._better(current)

    def _better(self, current: Fit) -> Fit | None:
        """Return the likeliest set that was fitted, to convergence, if it is likelier than the current one by what
        counts."""
        best: Fit | None = None
        for fit in sorted(self._listed(), key=self.promised_log_odds, reverse=True):
            if self.promised_log_odds(fit) <= self.log_odds(best or current) + self.policy.exchange_log_odds:
                break
            if self.is_spent and best is not None:
                break
            whole = self.fitted(fit.effects, converged=True)
            gain = self.log_odds(whole) - self.log_odds(current)
            is_better = best is None or self.log_odds(whole) > self.log_odds(best)
            if is_better and gain > self.policy.exchange_log_odds:
                best = whole
        return best

    def _listed(self) -> list[Fit]:
        """Return the sets that hold nothing but effects of the library."""
        return [f for f in self.fits.values() if self._is_listed(f)]

    def _is_listed(self, fit: Fit) -> bool:
        return all(e.is_candidate for e in fit.effects)

    def promised_log_odds(self, fit: Fit) -> float:
        """Log odds that a fit may reach when it has converged: by further steps, and without dispensable parameters."""
        if fit.converged:
            return self.log_odds(fit)
        dispensable = sum(q.dispensable for e in fit.effects for q in type(e).quantities().values())
        return self.log_odds(fit) + fit.promised_gain + self.policy.parameter_log_odds * dispensable

    def is_known(self, effects: Effects) -> bool:
        """Return whether these effects were fitted together."""
        return frozenset(e.name for e in effects) in self.fits

    def leave(self, effects: Effects) -> None:
        """Note a set that the budget leaves without a refit."""
        if not self.is_known(effects):
            self.not_weighed[frozenset(e.name for e in effects)] = tuple(e.name for e in effects)

    def _proposals(self, current: Fit, *, wide: bool) -> list[_Proposal]:
        """Return the sets to be refitted next, of every kind the best in turn, as a linear problem compares sets about
        one fit better than about several."""
        extended, exchanged = (
            (self._wide_extensions, self._wide_exchanges) if wide else (self._extensions, self._exchanges)
        )
        kinds = [extended(current), *(exchanged(current, i) for i in range(len(current.effects)))]
        if not wide:
            kinds.append(self._extensions_of_runner_up(current))
        found: dict[frozenset[str], _Proposal] = {}
        for one in chain.from_iterable(zip_longest(*kinds)):
            if one is not None and one.key not in self.fits:
                found.setdefault(one.key, one)
        return list(found.values())[: self.policy.refitted_pairs if wide else self.policy.refitted_sets]

    def _extensions(self, current: Fit) -> list[_Proposal]:
        """One effect more: those that promise a share of what the best does. The others are scored again about the set
        with that one."""
        seen = self._seen_sets(current, 1)
        least = self.policy.promised_share * seen[0].score if seen else 0.0
        return [self._proposal(current, one) for one in seen if one.score > least]

    def _extensions_of_runner_up(self, current: Fit) -> list[_Proposal]:
        """One effect more beside the likeliest of the sets that differ from the current one by one member: those that
        promise more than the current set has. An effect that does the work of two is fitted before either of them, and
        is left for both only from here."""
        key = frozenset(current.names)
        others = [f for f in self._listed() if len(f.effects) == len(key) and len(key - frozenset(f.names)) == 1]
        if len(key) < 2 or not others:
            return []
        second = max(others, key=self.log_odds)
        least = self.log_odds(current) - self.promised_log_odds(second)
        return [self._proposal(second, one) for one in self._seen_sets(second, 1) if one.log_odds > least]

    def _wide_extensions(self, current: Fit) -> list[_Proposal]:
        """Two effects more, or three, where fewer aren't seen. What hides a pair is fitted first and exchanged for it
        then, as sets are compared better about a fit that is nearer."""
        seen: list[LinearSet] = []
        for size in range(1, self.policy.added_effects + 1):
            seen = seen or self._seen_sets(current, size)
        return [self._proposal(current, one) for one in seen if len(one.members) > 1]

    def _exchanges(self, current: Fit, index: int) -> list[_Proposal]:
        """One effect in the place of a member: it has to promise a share of what that one gains."""
        origin, gone = self._less(current, index), current.effects[index].name
        least = 2.0 * self.policy.promised_share * (current.log_posterior - origin.log_posterior)
        names = self.problem(origin).owners
        seen = [one for one in self._seen_sets(origin, 1) if one.score > least and names[one.members[0]] != gone]
        return [self._proposal(origin, one) for one in seen]

    def _wide_exchanges(self, current: Fit, index: int) -> list[_Proposal]:
        """Two effects in the place of a member. Where one of them was fitted in its place, the other is scored about
        that fit, which has to promise more than the current set has. Of other pairs, the score has to be above the
        member's by what an effect has to earn."""
        origin, gone = self._less(current, index), current.effects[index].name
        problem, rest = self.problem(origin), frozenset(origin.names)
        halves = [f for key, f in self.fits.items() if rest < key and len(key) == len(rest) + 1 and gone not in key]
        found: list[tuple[float, _Proposal]] = []
        for half in (f for f in halves if self._is_listed(f)):
            names = self.problem(half).owners
            for one in self._seen_sets(half, 1):
                promised = self.promised_log_odds(half) + one.log_odds
                if names[one.members[0]] != gone and promised > self.log_odds(current):
                    found.append((promised, self._proposal(half, one)))
        fitted = {gone, *(name for half in halves for name in half.names if name not in rest)}
        own = problem.singles[gone].score if gone in problem.singles else 0.0
        for one in self._seen_sets(origin, 2):
            if one.score > own + self.threshold and fitted.isdisjoint(problem.owners[m] for m in one.members):
                found.append((self.log_odds(origin) + one.log_odds, self._proposal(origin, one)))
        return [proposal for _, proposal in sorted(found, key=lambda item: -item[0])]

    def _less(self, fit: Fit, index: int) -> Fit:
        """Return the set without one of its members."""
        return self.fitted((*fit.effects[:index], *fit.effects[index + 1 :]), converged=True)

    def _seen_sets(self, origin: Fit, size: int) -> list[LinearSet]:
        """Return the sets of `size` effects beside `origin` that promise what they have to earn, or whose score, as
        refits may gain more, is above the threshold for every member; best first."""
        if len(origin.effects) + size > self.policy.most_effects:
            return []
        sets = self.problem(origin).best(size)
        return [one for one in sets if one.log_odds > 0.0 or one.score > self.threshold * size]

    def problem(self, fit: Fit) -> LinearProblem:
        """Return the linear problem about a fitted set."""
        if fit.effects not in self._problems:
            self._problems[fit.effects] = self.signatures(fit).problem(self._cost)
        return self._problems[fit.effects]

    def _proposal(self, origin: Fit, one: LinearSet) -> _Proposal:
        return _Proposal(self._start(origin, self.signatures(origin).starts(one)), origin)

    def _start(self, origin: Fit, linear: Effects) -> tuple[Effect, ...]:
        """Return where the refit of a set starts: at the linear problem's coefficients, or where its members stood when
        each was fitted by itself, as a large effect isn't linear: whichever is likelier."""
        alone = [self.fits.get(frozenset((e.name,))) for e in linear]
        if origin.effects or len(linear) < 2 or not any(alone):
            return (*origin.effects, *linear)
        mixed = tuple(e if fit is None else fit.effects[0] for e, fit in zip(linear, alone, strict=True))
        return max((tuple(linear), mixed), key=lambda start: log_likelihood(self.model, start, self.policy))

    # --- fits --------------------------------------------------------------------------------------------------------

    def fitted(self, start: Effects, *, converged: bool = False, beside: Fit | None = None) -> Fit:
        """Return the fit of a set of effects, made once: rough, which is enough to rank sets, or to convergence.

        `beside`: the set that `start` grew from, whose Jacobian a rough fit reuses.
        """
        key, begin = frozenset(e.name for e in start), tuple(start)
        known = self.fits.get(key)
        if known is not None and known.converged >= converged:
            return known
        if known is not None:
            begin = known.effects
        made = refit(self.model, begin, self.policy, rough=not converged, beside=None if converged else beside)
        self.fits[key] = made
        self.not_weighed.pop(key, None)
        return made

    def without(self, fit: Fit, index: int) -> Fit:
        """Return the set fitted without one of its members."""
        rest = (*fit.effects[:index], *fit.effects[index + 1 :])
        return self.fitted(rest, converged=True)

    def member_log_odds(self, fit: Fit, index: int) -> float:
        """Return the log posterior of a fitted set over that without one of its members; beside others, the lesser of
        that with the likeliest share of the laws' form tolerances and that with the whole, and `beside_tolerance` at
        least.

        What a strong effect's law may lack is no second effect: a set with one more effect fits with a small share
        where the set without it needs the whole, and would be likelier by the whole's cost alone.
        """
        without = self.without(fit, index)
        odds = fit.log_posterior - without.log_posterior
        if not without.effects or odds < self.needed_log_odds:
            return odds
        return min(odds, self._by_whole_tolerances(fit) - self._by_whole_tolerances(without))

    def _by_whole_tolerances(self, fit: Fit) -> float:
        """Log posterior of a fitted set with the whole of its laws' form tolerances, and `beside_tolerance` at
        least."""
        key = frozenset(fit.names)
        if key not in self._whole:
            self._whole[key] = refit(
                self.model, fit.effects, self.policy, passes=1, tolerance=self.policy.beside_tolerance
            ).log_posterior
        return self._whole[key]

    # --- what it says ------------------------------------------------------------------------------------------------

    def models(self) -> ModelSet:
        """Every set that was fitted, and those with one or two effects beside a likely one, in closed form, with their
        probabilities. Rough fits that may reach a share are fitted to convergence."""
        top = max(self.log_odds(f) for f in self._listed())
        for fit in self._listed():
            is_near = self.promised_log_odds(fit) > top + math.log(self.policy.least_rival_probability)
            if not fit.converged and is_near and not self.is_spent:
                self.fitted(fit.effects, converged=True)
        weighed = self.weighed()
        sets = sorted(weighed, key=lambda names: -weighed[names])
        probability = posterior([weighed[names] for names in sets])
        kept = smallest_set(probability.tolist(), self.policy.model_set_share)
        inclusion: dict[str, float] = {}
        for names, p in zip(sets, probability, strict=True):
            for name in names:
                inclusion[name] = inclusion.get(name, 0.0) + float(p)
        likely = [(n, min(p, 1.0)) for n, p in inclusion.items() if p >= self.policy.least_rival_probability]
        return ModelSet(
            tuple(Model(self._in_order(sets[i]), float(probability[i]), sets[i] in self.fits) for i in kept),
            tuple(sorted(likely, key=lambda one: (-one[1], one[0]))),  # members of a set have no order of their own
            tuple(self.not_weighed.values()),
        )

    def weighed(self) -> dict[frozenset[str], float]:
        """Log posterior of sets of listed effects, by name. A set's prior is `policy.included_log_odds` for each
        effect, how often effects occur; a name has to earn more, for its false alarms are limited. Of sets that weren't
        fitted, those of one or two effects beside a fitted set that isn't far below the likeliest, by the linear
        problem about that: the value about the nearest, the fitted set that has most of their effects."""
        prior, near = self.policy.included_log_odds, math.log(self.policy.least_rival_probability)
        found = {frozenset(f.names): f.log_posterior - prior * len(f.effects) for f in self._listed()}
        cost = {e.name: prior + self._parameters_cost(e) for e in self.candidates}
        likely = sorted(self._listed(), key=lambda f: -found[frozenset(f.names)])
        least = found[frozenset(likely[0].names)] + near
        beside: dict[frozenset[str], tuple[int, float]] = {}
        for fit in [f for f in likely if found[frozenset(f.names)] > least][: self.policy.refitted_sets]:
            if fit.effects not in self._problems and self.is_spent:
                continue
            problem = self.signatures(fit).problem(cost)
            for one in (*problem.singles.values(), *problem.pairs):
                key = frozenset(fit.names) | problem.names(one)
                if key not in found and len(key) <= self.policy.most_effects:
                    value = len(fit.names), found[frozenset(fit.names)] + one.log_odds
                    beside[key] = max(beside.get(key, value), value)
        return found | {key: value for key, (_, value) in beside.items()}

    def _in_order(self, names: frozenset[str]) -> tuple[str, ...]:
        """As the set was fitted, else as the candidates stand."""
        fit = self.fits.get(names)
        return fit.names if fit is not None else tuple(e.name for e in self.candidates if e.name in names)
