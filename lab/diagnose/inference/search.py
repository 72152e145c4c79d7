"""Which set of effects explains the seen numbers best: a beam search over sets, with pairs that only together explain anything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from lab.diagnose.inference.evidence import Evidence
from lab.diagnose.inference.refit import Fit, refit
from lab.diagnose.inference.score import signatures
from lab.diagnose.measurements.summaries import Effects
from sim.effects.base import Effect

MOST_EFFECTS = 4
SCREENED = 8  # candidates that are refitted for a set
PAIRS = 4  # pairs that are refitted at the start
BEAM = 2  # sets of one size from which the search goes on
#: Of the best score: what is below it isn't refitted, as its refit would have to gain so many times what it promises.
HOPELESS_SHARE = 0.1
#: Of what a member gains, in nats: the score (two a nat) from which on an effect may stand in its place.
RIVAL_FROM = 1.2
#: Of the threshold: what an effect has to gain where a stronger one acts on the same measurement. That one's law may be wrong.
FURTHER = 1.5
#: Nats below the best by which a set may lie and still be gone on from.
BEHIND = 25.0


def _unlike(sets: Sequence[Fit]) -> list[Fit]:
    """Without those that are a better one with a member exchanged for its declared rival: what they grow into is alike, and the
    exchange is tried in the end (`Search._exchanged`)."""
    kept: list[Fit] = []
    for one in sets:
        if not any(_is_exchanged(one, better) for better in kept):
            kept.append(one)
    return kept


def _is_exchanged(one: Fit, other: Fit) -> bool:
    mine = [e for e in one.effects if e.name not in other.names]
    theirs = [e for e in other.effects if e.name not in one.names]
    return len(mine) == len(theirs) == 1 and mine[0].name in type(theirs[0]).rivals


@dataclass
class Search:
    """The search's state: every set that was fitted, by its names, and which of them once more from elsewhere."""

    evidence: Evidence
    known: tuple[type[Effect], ...]
    threshold: float
    fits: dict[frozenset[str], Fit] = field(default_factory=dict)
    twice: set[frozenset[str]] = field(default_factory=set)

    def worth(self, fit: Fit) -> float:
        """Nats less what every effect has to earn: half the threshold, beyond which one in a hundred healthy cameras gets."""
        return fit.weight - 0.5 * self.threshold * len(fit.effects)

    def best(self, report: Callable[[str], None] = lambda _: None) -> Fit:
        """Grow sets effect by effect, then leave out and exchange members while that is worth more."""
        current = self.fitted((), final=True)
        beam = [current]
        for count in range(MOST_EFFECTS):
            report(f"looking for {'another' if count else 'an'} effect")
            grown = [fit for state in beam for fit in self._grown(state)]
            grown = sorted({frozenset(f.names): f for f in grown}.values(), key=self.worth, reverse=True)
            beam = [self.fitted(f.effects, final=True) for f in _unlike(grown)[:BEAM]]
            beam = sorted(beam, key=self.worth, reverse=True)
            if not beam or self.worth(beam[0]) < self.worth(current) - BEHIND:
                break
            if self.worth(beam[0]) <= self.worth(current) and count:
                break
            beam = [f for f in beam if self.worth(f) > self.worth(beam[0]) - BEHIND]
            if self.worth(beam[0]) > self.worth(current) + self._further(beam[0], current):
                current = beam[0]
        return self._mended(current)

    def _further(self, fit: Fit, than: Fit) -> float:
        """Nats that a set has to be worth more than the one that it was grown from: of an effect that shows most where one of those
        acts."""
        new = [e for e in fit.effects if e.name not in than.names]
        if not than.effects or len(new) != len(fit.effects) - len(than.effects):
            return 0.0
        seats = [self.evidence.blocks[self.evidence.seat(e, fit.effects)] for e in new]
        old = [type(e) for e in fit.effects if e.name in than.names]
        beside = any(seat.touched_by(e) for seat in seats for e in old)
        return 0.5 * (FURTHER - 1.0) * self.threshold if beside else 0.0

    def _grown(self, state: Fit) -> list[Fit]:
        found = signatures(
            self.evidence,
            self.evidence.camera,
            state.effects,
            [e for e in self.known if e.name not in state.names],
            state.tangents,
        )
        every = found.scores()
        least = max(self.threshold, HOPELESS_SHARE * every[0].value) if every else self.threshold
        scores = [s for s in every if s.value > least][:SCREENED]
        starts: list[Effects] = [(*state.effects, s.start) for s in scores]
        if not state.effects:
            single = every[0].value if every else self.threshold
            starts += [pair.starts for pair in found.pairs(PAIRS) if pair.value > single + self.threshold]
        return [self.fitted(start, beside=state) for start in starts]

    def _mended(self, fit: Fit) -> Fit:
        """With members left out or exchanged for a declared rival, while that is worth more."""
        while fit.effects:
            others = [tuple(e for e in fit.effects if e is not gone) for gone in fit.effects]
            tried = [self.fitted(rest, final=True) for rest in others]
            if len(fit.effects) > 1:
                tried += [f for i, rest in enumerate(tuple(tried)) for f in self._exchanged(fit, i, rest)]
            better = max(tried, key=self.worth)
            if self.worth(better) <= self.worth(fit) + 0.5:
                return fit
            fit = self.fitted(better.effects, final=True)
        return fit

    def _exchanged(self, fit: Fit, index: int, without: Fit) -> list[Fit]:
        rest = (*fit.effects[:index], *fit.effects[index + 1 :])
        rivals = type(fit.effects[index]).rivals
        kinds = [e for e in self.known if e.name in rivals and e.name not in fit.names]
        scores = signatures(self.evidence, self.evidence.camera, rest, kinds).scores()
        least = RIVAL_FROM * (fit.weight - without.weight)
        return [self.fitted((*rest, s.start), beside=without) for s in scores if s.value > least]

    def fitted(self, start: Effects, *, final: bool = False, again: bool = False, beside: Fit | None = None) -> Fit:
        """A set's fit, made once (a rough one is good to tell sets apart; `final`: to convergence). There are several optima: `again`
        goes on from `start` whatever was found, once, and keeps the better. `beside`: the set that `start` is grown from, whose
        slopes do for a rough fit."""
        key, begin = frozenset(e.name for e in start), tuple(start)
        known = self.fits.get(key)
        if known is not None and known.final >= final:
            if not again or key in self.twice:
                return known
            self.twice.add(key)
        elif known is not None:
            begin = known.effects
        passes, evaluations = (3, 12) if final else (2, 8)
        settled = None if final else beside
        made = refit(self.evidence, begin, passes=passes, evaluations=evaluations, final=final, settled=settled)
        if known is None or known.final < final or made.weight > known.weight:
            self.fits[key] = made
        return self.fits[key]
