"""Which set of effects explains the seen numbers best: a beam search over sets, starting from single effects and
pairs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import Fit, refit
from lab.diagnose.inference.rivals import session_rivals
from lab.diagnose.inference.score import signatures
from lab.diagnose.measurements.block import Effects
from lab.diagnose.policy import DecisionPolicy
from sim.effects.base import Effect


@dataclass
class Search:
    """The sets that were fitted so far, by their effects' names, and the search over further ones.

    `threshold` is that of the scores: twice the log odds that every effect has to earn. `refitted_again` holds the
    names of sets that were fitted from a second start.
    """

    model: MeasurementModel
    candidates: tuple[type[Effect], ...]
    threshold: float
    policy: DecisionPolicy = field(default_factory=DecisionPolicy)
    fits: dict[frozenset[str], Fit] = field(default_factory=dict)
    refitted_again: set[frozenset[str]] = field(default_factory=set)

    @cached_property
    def rivals(self) -> Mapping[str, frozenset[str]]:
        """Effects whose signatures in these recordings are alike, by name; a symmetric relation."""
        return session_rivals(self.model, self.candidates, self.policy.rival_cosine)

    def log_odds(self, fit: Fit) -> float:
        """Log posterior of a set, less half the threshold for every effect: one healthy camera in a hundred reaches
        that."""
        return fit.log_posterior - 0.5 * self.threshold * len(fit.effects)

    def best(self, report: Callable[[str], None] = lambda _: None) -> Fit:
        """Grow sets effect by effect; then leave out and exchange members while the log odds rise."""
        current = self.fitted((), converged=True)
        beam = [current]
        for count in range(self.policy.most_effects):
            report(f"looking for {'another' if count else 'an'} effect")
            grown = [fit for state in beam for fit in self._grown(state)]
            grown = sorted({frozenset(f.names): f for f in grown}.values(), key=self.log_odds, reverse=True)
            kept = self._without_exchanges(grown)[: self.policy.beam_width]
            beam = [self.fitted(f.effects, converged=True) for f in kept]
            beam = sorted(beam, key=self.log_odds, reverse=True)
            if not beam or self.log_odds(beam[0]) < self.log_odds(current) - self.policy.beam_log_odds:
                break
            if self.log_odds(beam[0]) <= self.log_odds(current) and count:
                break
            beam = [f for f in beam if self.log_odds(f) > self.log_odds(beam[0]) - self.policy.beam_log_odds]
            if self.log_odds(beam[0]) > self.log_odds(current) + self._added_cost(beam[0], current):
                current = beam[0]
        return self._improved(current)

    def _without_exchanges(self, sets: Sequence[Fit]) -> list[Fit]:
        """Sets, best first, without those that are a better one with a member exchanged for its rival: they would grow
        alike, and the exchange is tried in the end (`_exchanged`)."""
        kept: list[Fit] = []
        for one in sets:
            if not any(self._is_exchange(one, better) for better in kept):
                kept.append(one)
        return kept

    def _is_exchange(self, one: Fit, other: Fit) -> bool:
        mine = [e for e in one.effects if e.name not in other.names]
        theirs = [e for e in other.effects if e.name not in one.names]
        return len(mine) == len(theirs) == 1 and mine[0].name in self.rivals[theirs[0].name]

    def _added_cost(self, fit: Fit, grown_from: Fit) -> float:
        """Log odds that an added effect has to earn beyond its own, where it shows most in a block on which an earlier
        member acts."""
        new = [e for e in fit.effects if e.name not in grown_from.names]
        if not grown_from.effects or len(new) != len(fit.effects) - len(grown_from.effects):
            return 0.0
        strongest = [self.model.blocks[self.model.strongest_block(e, fit.effects)] for e in new]
        old = [type(e) for e in fit.effects if e.name in grown_from.names]
        overlap = any(block.touched_by(e) for block in strongest for e in old)
        return 0.5 * (self.policy.added_threshold_factor - 1.0) * self.threshold if overlap else 0.0

    def _grown(self, state: Fit) -> list[Fit]:
        """Rough fits of the set with one more effect, the best by score; from no effect, also of the best pairs."""
        policy = self.policy
        found = signatures(
            self.model,
            self.model.camera,
            state.effects,
            [e for e in self.candidates if e.name not in state.names],
            state.jacobian,
        )
        every = found.scores()
        least = max(self.threshold, policy.least_score_share * every[0].value) if every else self.threshold
        scores = [s for s in every if s.value > least][: policy.screened_effects]
        starts: list[Effects] = [(*state.effects, s.start) for s in scores]
        if not state.effects:
            single = every[0].value if every else self.threshold
            pairs = found.pairs(policy.screened_pairs)
            starts += [pair.starts for pair in pairs if pair.value > single + self.threshold]
        return [self.fitted(start, beside=state) for start in starts]

    def _improved(self, fit: Fit) -> Fit:
        """The set with members left out, or exchanged for a rival, while the log odds rise."""
        while fit.effects:
            others = [tuple(e for e in fit.effects if e is not gone) for gone in fit.effects]
            tried = [self.fitted(rest, converged=True) for rest in others]
            if len(fit.effects) > 1:
                tried += [f for i, rest in enumerate(tuple(tried)) for f in self._exchanged(fit, i, rest)]
            better = max(tried, key=self.log_odds)
            if self.log_odds(better) <= self.log_odds(fit) + self.policy.exchange_log_odds:
                return fit
            fit = self.fitted(better.effects, converged=True)
        return fit

    def _exchanged(self, fit: Fit, index: int, without: Fit) -> list[Fit]:
        """Rough fits with a rival in the place of one member; `without`: the fit without that member."""
        rest = (*fit.effects[:index], *fit.effects[index + 1 :])
        rivals = self.rivals[fit.effects[index].name]
        kinds = [e for e in self.candidates if e.name in rivals and e.name not in fit.names]
        scores = signatures(self.model, self.model.camera, rest, kinds).scores()
        least = self.policy.rival_score_factor * (fit.log_posterior - without.log_posterior)
        return [self.fitted((*rest, s.start), beside=without) for s in scores if s.value > least]

    def fitted(self, start: Effects, *, converged: bool = False, again: bool = False, beside: Fit | None = None) -> Fit:
        """The fit of a set of effects, made once: rough, which is enough to rank sets, or to convergence.

        There are several optima. `again`: fit once more from `start`, once, and keep the better. `beside`: the set that
        `start` grew from, whose Jacobian a rough fit reuses.
        """
        key, begin = frozenset(e.name for e in start), tuple(start)
        known = self.fits.get(key)
        if known is not None and known.converged >= converged:
            if not again or key in self.refitted_again:
                return known
            self.refitted_again.add(key)
        elif known is not None:
            begin = known.effects
        made = refit(self.model, begin, self.policy, rough=not converged, beside=None if converged else beside)
        if known is None or known.converged < converged or made.log_posterior > known.log_posterior:
            self.fits[key] = made
        return self.fits[key]

    def without(self, fit: Fit, index: int) -> Fit:
        """The set fitted without one of its members; from a second start, too, where that member gains little."""
        rest = (*fit.effects[:index], *fit.effects[index + 1 :])
        without = self.fitted(rest, converged=True)
        if rest and fit.log_posterior - without.log_posterior < self.policy.refit_again_log_odds:
            without = self.fitted(rest, converged=True, again=True)
        return without
