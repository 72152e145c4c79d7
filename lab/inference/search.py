"""The search: closed form about fitted sets, refits of the likeliest, and the table of sets with their probabilities.

About a fitted set, with the whitened residual r and the whitened signatures G of all hypotheses, z = G'r and R = G'G
give the evidence of every further set in closed form: all single hypotheses, all pairs, the best triples. The likeliest
set that was never refitted is refitted next, until those that are left hold less than `LEFT` of the probability, or the
budget is spent. Sets without one member of the likeliest are refitted, too; what promises most beside these is an
exchange."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg.blas import dsyrk
from scipy.optimize import least_squares

from lab.inference.closed_form import (
    SILENT,
    HealthyDraws,
    Signature,
    gains_of,
    integrate_each,
    integrate_set,
    log_mean_exp,
    others_over_empty,
    project_groups,
    signature_log_odds,
    signatures_of,
)
from lab.inference.hypotheses import (
    Coordinate,
    Hypothesis,
    SetPrior,
    coordinates_of,
    moved,
    size_precision,
    stacked,
    symmetric,
)
from lab.inference.laplace import Laplace, best_within_bounds, bounds, correct_along, integrate, near_bound
from lab.inference.model import (
    FormScale,
    Model,
    Point,
    ScaleIntegral,
    State,
    everyday_forms,
    everyday_scales,
    log_sum_exp,
    scaled_columns,
    unlisted_forms,
    with_columns,
)
from lab.observables.gaussian import Gaussian
from sim.spectrum import FloatArray

#: The budget: refits a side.
REFITS = 60
#: Mass of sets that were never refitted, above which a result is undecided.
LEFT = 0.01
#: Log odds below the likeliest set at which the closed form is trusted to rule a set out, however large its error.
HOPELESS = 50.0
#: Gain of log evidence above which an estimate is made again about the largest refitted part of its set: of large
#: changes the closed form is wrong by a share of the gain.
HALFWAY = 5.0
#: Gain of log evidence from which on the closed form about a set may be wrong by more than rivals differ: a change of
#: the prediction isn't linear then. The most hypotheses that are refitted beside that set.
CURVED, SINGLES = 10.0, 8
#: Refits of sets that the closed form about a set far below the likeliest promises: about such a set it isn't linear.
DOUBTFUL = 3
#: P(any group is unlisted) of a camera.
ANY_UNLISTED = 0.05
#: Log odds below the likeliest set beyond which a set isn't made an origin of closed forms, and its scales aren't
#: integrated in full.
FAR_BELOW = 7.0
#: Evaluations of the prediction in each of the two passes of a refit.
EVALUATIONS = (8, 4)
#: Pairs and triples that are integrated one by one about each origin; the others by an estimate.
PAIRS, TRIPLES, EXTENSIONS = 120, 12, 10
#: Standard deviations from its bound below which an amplitude's evidence is taken by quadrature.
NEAR = 3.0
#: Scales of the groups, drawn from their posterior, over which a closed form is averaged.
SCALES_AVERAGED = 7
#: Departure from linearity, over the change, up to which a Jacobian is updated after a step, not differenced again.
NEARLY_LINEAR = 0.3
#: Log evidence by which the largest everyday form error has to exceed the next for larger ones to be tried.
STEEP = 0.5
#: Healthy draws whose p(nothing) is taken as that of a measured set: so many of the lowest, of so many at most.
LOWEST, MOST_REFINED = 2, 40
#: Gain of log posterior by unlisted groups from which on parameters are fitted anew with these: where they take most of
#: what a hypothesis explained, its mode is elsewhere. The most such fits of a set.
MOVED, MOST_MOVED = 3.0, 3
#: Gain of log posterior by the linear problem about a mode, above which the prediction has to have a half of it.
PROMISED = 1.0
#: Gain of log evidence up to which a size may be near 0, where shapes vanish.
WEAK = 6.0
#: Probability that the laws of the likeliest set are inexact from which on others are looked for in the place of its
#: members, and the most sets that are refitted then.
DOUBTED, EXCHANGES = 0.5, 2
#: Log evidence within which two alternatives of one hypothesis are both refitted, and the most that are.
ALTERNATIVES_NEAR, MOST_ALTERNATIVES = 4.0, 2


@dataclass(frozen=True)
class FormFit:
    """A fitted set with the form errors of its laws at one scale, whose log prior is `log_prior`: log p(y | A) with the
    groups at their median everyday scales (`base`), and the marginal likelihood of these scales, `start_log` there.

    `correction`: what `base` has beyond the linear problem. Where that is much, the point is no mode, and what the
    parameters gain there the groups would take: flips have `HALFWAY` of it at most."""

    form: float
    log_prior: float
    base: float
    scales: ScaleIntegral
    start_log: float
    correction: float

    @property
    def _taken(self) -> float:
        return max(self.correction - HALFWAY, 0.0)

    @cached_property
    def quick(self) -> float:
        """Log p(y | A), flips with the scales of the others as without: a lower bound, near enough to rank sets."""
        none, singles = self.scales.quick
        return self.base - self.start_log + log_sum_exp([none, singles - self._taken])

    @cached_property
    def by_groups(self) -> Mapping[frozenset[int], float]:
        """Log p(y | A, u) p(u), by which groups are unlisted: all single flips and the best pairs."""
        weights = self.scales.weights().items()
        return {u: self.base + w - self.start_log - (self._taken if u else 0.0) for u, w in weights}


@dataclass(frozen=True)
class FittedSet:
    """A refitted set at its mode, for each scale of form errors. `jacobian` (n, p) of m by u at the
    mode; `others`: further modes of the posterior, which `shift` adds to the evidence of this one. `flipped`: fits
    about the mode with these groups unlisted, where that is another."""

    state: State
    coordinates: tuple[Coordinate, ...]
    forms: tuple[FormFit, ...]
    laplace: Laplace
    jacobian: FloatArray
    precision: FloatArray
    pull: FloatArray
    others: tuple[FittedSet, ...] = ()
    shift: float = 0.0
    flipped: Mapping[frozenset[int], FittedSet] = field(default_factory=dict)

    def given(self, unlisted: frozenset[int]) -> FittedSet:
        """Return the fit about the mode with these groups unlisted."""
        held = [groups for groups in self.flipped if groups <= unlisted]
        return self.flipped[max(held, key=len)] if held else self

    @property
    def members(self) -> frozenset[str]:
        """Names of the active hypotheses."""
        return frozenset(self.state)

    @property
    def base(self) -> float:
        """Log p(y | A) with the groups at their median everyday scales."""
        return self.shift + log_sum_exp([f.base + f.log_prior for f in self.forms])

    @cached_property
    def quick(self) -> float:
        """Log p(y | A), near enough to rank sets: without what several unlisted groups gain, where single ones gain
        little (`FormFit.quick`)."""
        return self.total if self.single > self.everyday + MOVED else self.single

    @property
    def single(self) -> float:
        """Log p(y | A) over no and single unlisted groups, about one mode."""
        return self.shift + log_sum_exp([f.quick + f.log_prior for f in self.forms])

    @cached_property
    def likeliest(self) -> FormFit:
        """The likeliest scale of form errors."""
        return max(self.forms, key=lambda f: f.quick + f.log_prior)

    @cached_property
    def by_groups(self) -> Mapping[frozenset[int], float]:
        """Log p(y | A, u) p(u), by which groups are unlisted, summed over the scales of form errors; those far below
        the likeliest count for nothing."""
        fits = (self, *self.flipped.values())
        return {u: value for fit in fits for u, value in fit._about_mode.items() if self.given(u) is fit}

    @cached_property
    def _about_mode(self) -> Mapping[frozenset[int], float]:
        near = [f for f in self.forms if f.quick > self.likeliest.quick - FAR_BELOW]
        sums: dict[frozenset[int], list[float]] = {}
        for form in near:
            for u, value in form.by_groups.items():
                sums.setdefault(u, []).append(value + form.log_prior)
        return {u: self.shift + log_sum_exp(v) for u, v in sums.items()}

    @property
    def inexact(self) -> float:
        """Probability that the laws are wrong by more than they declare, given the set."""
        if self.flipped:
            fits = (self, *self.flipped.values())
            own = [[v for u, v in self.by_groups.items() if self.given(u) is fit] for fit in fits]
            return float(sum(np.exp(log_sum_exp(v) - self.total) * f._inexact for f, v in zip(fits, own, strict=True)))
        return self._inexact

    @property
    def _inexact(self) -> float:
        log = [f.quick + f.log_prior for f in self.forms]
        beyond = [w for f, w in zip(self.forms, log, strict=True) if f.form > 1.0]
        return float(np.exp(log_sum_exp(beyond) - log_sum_exp(log))) if beyond else 0.0

    @property
    def everyday(self) -> float:
        """Log p(y | A, u) p(u) with all groups everyday."""
        none = frozenset[int]()
        own = [f.base - f.start_log + f.scales.everyday + f.scales.log_prior(none) + f.log_prior for f in self.forms]
        return self.shift + log_sum_exp(own)

    @property
    def total(self) -> float:
        """Log p(y | A), summed over the groups that were tried."""
        return log_sum_exp(list(self.by_groups.values()))


@dataclass(frozen=True)
class Row:
    """One set of the table: its members, the groups that are unlisted, its probability, whether it was refitted, and
    whether it had to be: the recordings change its probability (`SILENT`)."""

    members: frozenset[str]
    unlisted: frozenset[int]
    probability: float
    refitted: bool
    is_closed_form_enough: bool = False


@dataclass(frozen=True)
class Tail:
    """All sets of three or more members more than `members` of which the recordings say little, together: their
    probability, and by hypothesis the share that holds it, by family the share that holds any of it, by group the share
    in which something unlisted acts on a state."""

    members: frozenset[str]
    probability: float
    effects: Mapping[str, float]
    families: Mapping[str, float]
    unlisted: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Table:
    """All sets with their probabilities, likeliest first, and the fits of those that were refitted. `tails`: larger
    sets, which aren't listed one by one. `groups`: the state of each group."""

    rows: tuple[Row, ...]
    tails: tuple[Tail, ...]
    fits: Mapping[frozenset[str], FittedSet]
    groups: tuple[str, ...]
    log_evidence: float
    refits: int

    def states(self, unlisted: frozenset[int]) -> tuple[str, ...]:
        """Return the states on which these groups act."""
        return tuple(dict.fromkeys(self.groups[g] for g in sorted(unlisted)))

    def groups_on(self, state: str) -> frozenset[int]:
        """Return the groups that act on a state."""
        return frozenset(g for g, name in enumerate(self.groups) if name == state)

    @property
    def left(self) -> float:
        """Probability of the sets that had to be refitted and never were."""
        return sum(r.probability for r in self.rows if not r.refitted and not r.is_closed_form_enough)

    @property
    def closed_form(self) -> float:
        """Probability of the sets of which the recordings say so little that the closed form is enough."""
        listed = sum(r.probability for r in self.rows if not r.refitted and r.is_closed_form_enough)
        return listed + sum(t.probability for t in self.tails)

    @property
    def is_undecided(self) -> bool:
        """Whether too much of the probability was never refitted."""
        return self.left > LEFT


@dataclass(frozen=True)
class _Estimate:
    by_groups: Mapping[frozenset[int], float]  # log posterior, by which groups are unlisted
    gain: float  # of log evidence over the origin
    weight: float  # log p(y | A, u) p(u) p(A) of the origin with the unlisted groups of the estimate
    origin: frozenset[str]
    alternatives: tuple[int, ...]  # signatures, by index
    coefficients: tuple[FloatArray, ...]

    @cached_property
    def log_posterior(self) -> float:
        """Whatever is unlisted beside it."""
        return log_sum_exp(list(self.by_groups.values()))


@dataclass
class Search:
    """The search for one side. `report` is called with each set that is refitted."""

    model: Model
    hypotheses: Mapping[str, Hypothesis]
    prior: SetPrior
    refits: int = REFITS
    any_unlisted: float = ANY_UNLISTED
    report: Callable[[str], None] = lambda text: None
    fits: dict[frozenset[str], FittedSet] = field(default_factory=dict)
    estimates: dict[frozenset[str], _Estimate] = field(default_factory=dict)
    singles: dict[frozenset[str], dict[str, float]] = field(default_factory=dict)
    _exchanged: set[frozenset[str]] = field(default_factory=set)  # sets whose members were looked to be exchanged
    _doubtful: int = 0  # refits of sets whose closed form is about a set that fits far worse

    @cached_property
    def _everyday(self) -> FloatArray:
        """Columns of the groups at their median everyday scales."""
        groups = self.model.groups
        return scaled_columns(groups, everyday_scales(groups), len(self.model.value))

    def run(self) -> Table:
        """Fill the table."""
        self._linearise(self.fit({}))
        self._add_strong()
        self._exchange()
        while len(self.fits) < self.refits:
            less = self._without_one()
            key = self._next() if less is None else None
            if less is None and key is None:
                if self._exchange():
                    continue
                break
            fit = self.fit(less) if less is not None else self._refit_from(self.estimates[key or frozenset()])
            self.report(", ".join(sorted(fit.members)) or "none")
            if self._log_posterior(fit) > self._top() - FAR_BELOW:
                self._linearise(fit)
        return self.table()

    def refit(self, members: frozenset[str]) -> FittedSet:
        """Return the fit of a set, made if it wasn't: after those of its members by themselves, about the empty set.

        Raises KeyError for a set that the closed form about the empty one has no estimate of."""
        if frozenset[str]() not in self.fits:
            self._linearise(self.fit({}))
        for key in (*(frozenset((name,)) for name in members), members):
            if key not in self.fits:
                self._refit_from(self.estimates[key])
        return self.fits[members]

    # --- what is refitted next ---------------------------------------------------------------------------------------

    def _log_posterior(self, fit: FittedSet) -> float:
        return fit.quick + self.prior.log(fit.members)

    def _top(self) -> float:
        return max(self._log_posterior(f) for f in self.fits.values())

    def _add_strong(self) -> None:
        """While one more hypothesis promises so much that the closed form isn't linear (`CURVED`), refit the likeliest
        set with each of those that promise half of what the best does."""
        while True:
            origin = max(self.fits.values(), key=self._log_posterior)
            if origin.members not in self.singles:
                self._linearise(origin)
            gains = self.singles[origin.members]
            top = max(gains.values(), default=0.0)
            if top < CURVED:
                return
            strong = sorted((n for n, gain in gains.items() if gain > 0.5 * top), key=lambda n: -gains[n])[:SINGLES]
            keys = [origin.members | {name} for name in strong]
            for key in keys:
                estimate = self.estimates.get(key)
                if key not in self.fits and estimate is not None and len(self.fits) < self.refits:
                    self._refit_from(estimate)
                    self.report(", ".join(sorted(key)))
            if max(self.fits.values(), key=self._log_posterior) is origin:
                return

    def _exchange(self) -> bool:
        """Where the laws of the likeliest set are inexact, look for one or two hypotheses in the place of each of its
        members, in closed form with the others as they are, and refit the best `EXCHANGES`; return whether there was
        one. About the set without a member the closed forms of the search aren't believed: it fits far worse."""
        best = max(self.fits.values(), key=self._log_posterior)
        if best.inexact <= DOUBTED or best.members in self._exchanged:
            return False
        self._exchanged.add(best.members)
        found = [one for name in best.state for one in self._in_place_of(name, best)]
        found = [one for one in found if frozenset(one[1]) not in self.fits]
        refitted = False
        for _, state in sorted(found, key=lambda one: -one[0])[:EXCHANGES]:
            if len(self.fits) >= self.refits or frozenset(state) in self.fits:
                continue
            fit = self.fit(state)
            refitted = True
            self.report(", ".join(sorted(fit.members)))
            if self._log_posterior(fit) > self._top() - FAR_BELOW:
                self._linearise(fit)
        return refitted

    def _in_place_of(self, name: str, best: FittedSet) -> list[tuple[float, State]]:
        """Return sets with one or two others in the place of a member, the likeliest of each number, from where their
        refits start, with their log posteriors in closed form up to a constant of the set."""
        rest = {n: p for n, p in best.state.items() if n != name}
        owners = [n for n, p in best.state.items() for _ in p.u]
        kept = np.array([owner != name for owner in owners], bool)
        forms = everyday_forms(self.model.has_form_error(rest))
        gaussian = self.model.gaussian(rest, forms[len(forms) // 2].share)
        groups = self.model.groups
        columns = scaled_columns(groups, best.likeliest.scales.everyday_mode, len(self.model.value))
        gaussian = with_columns(
            gaussian, np.column_stack([columns, best.jacobian[:, kept] / np.sqrt(best.precision[kept])])
        )
        residual = self.model.value - gaussian.mean
        white = gaussian.whiten(np.column_stack([self._stack, residual]))
        upper = dsyrk(1.0, white.T)
        whole = upper + np.triu(upper, 1).T
        z, gram = whole[:-1, -1], whole[:-1, :-1]
        signatures, own = self._signatures, dict[str, list[int]]()
        for i, s in enumerate(signatures):
            if s.owner not in best.state:
                own.setdefault(s.owner, []).append(i)
        outside = [i for which in own.values() for i in which]
        if not outside:
            return []
        single = dict(zip(outside, integrate_each(z, gram, [signatures[i] for i in outside]), strict=True))
        shared = {o: -float(np.log(len(which))) for o, which in own.items()}
        at = gaussian.log_likelihood(self.model.value)
        found: list[tuple[float, State]] = []

        def add(which: Sequence[int], gain: float, c: Sequence[FloatArray]) -> None:
            state = self._start(rest, which, c)
            gain += sum(shared[signatures[i].owner] for i in which)
            found.append((at + gain + self.prior.log(frozenset(state)), state))

        first = max(outside, key=lambda i: single[i][0])
        add((first,), single[first][0], (single[first][1],))
        for _, _, _, one, two in self._rank_pairs(z, gram, single, own, shared)[:TRIPLES]:
            gain, both = integrate_set(z, gram, [signatures[one], signatures[two]])
            cut = len(signatures[one].coordinates)
            add((one, two), gain, (both[:cut], both[cut:]))
        return found

    def _without_one(self) -> State | None:
        """Return the likeliest set without one of its members, from where it stands, if that was never refitted: of all
        members the one nearest to 0, unless even that is excluded."""
        best = max(self.fits.values(), key=self._log_posterior)
        best = best.given(max(best.by_groups, key=lambda u: best.by_groups[u]))
        places = coordinates_of(self.hypotheses, best.state)
        losses: list[tuple[float, str]] = []
        for name in best.state:
            own = [k for k, (owner, _, c) in enumerate(places) if owner == name and not c.is_shape]
            if best.members - {name} in self.fits:
                continue
            if not self.hypotheses[name].coordinates:  # it acts as a whole: how far from 0 isn't known
                losses.append((0.0, name))
            if not own:
                continue
            away = stacked(best.state)[own]
            covariance = best.laplace.covariance[np.ix_(own, own)] + 1e-12 * np.diag(np.square(away) + 1e-300)
            losses.append((0.5 * float(away @ np.linalg.pinv(covariance) @ away), name))
        if not losses or min(losses)[0] > HOPELESS:
            return None
        return {name: point for name, point in best.state.items() if name != min(losses)[1]}

    def _next(self) -> frozenset[str] | None:
        """Return the likeliest set that was never refitted; None where these hold less than `LEFT` together."""
        top = self._top()
        while True:
            speaking = {k: e for k, e in self.estimates.items() if k not in self.fits and e.gain > SILENT}
            near = {k: e.log_posterior for k, e in speaking.items() if self._is_near(e)}
            everything = [*near.values(), *(self._log_posterior(f) for f in self.fits.values())]
            if not near or log_sum_exp(list(near.values())) < log_sum_exp(everything) + np.log(0.5 * LEFT):
                break
            key = self._first_part(max(near, key=lambda key: near[key]))
            nearer = self._nearest_fit(key)
            if nearer.members in self.singles or self.estimates[key].gain < HALFWAY:
                return key
            self._linearise(nearer)
        far = {k: e.log_posterior for k, e in speaking.items() if k not in near and e.log_posterior > top - HOPELESS}
        if far and self._doubtful < DOUBTFUL:
            self._doubtful += 1
            return self._first_part(max(far, key=lambda key: far[key]))
        return None

    def _nearest_fit(self, members: frozenset[str]) -> FittedSet:
        """Return the largest refitted part of a set, of several the likeliest."""
        parts = [f for f in self.fits.values() if f.members < members]
        return max(parts, key=lambda f: (len(f.members), self._log_posterior(f)))

    def _is_near(self, estimate: _Estimate) -> bool:
        """Whether an estimate's origin, with the same groups unlisted, is near enough the likeliest set for its closed
        form to be believed."""
        return estimate.weight > self._top() - HOPELESS

    def _first_part(self, key: frozenset[str]) -> frozenset[str]:
        """Return the part of a set that is refitted before it: one whose gain over the same origin is at least half of
        its own. About a strong effect everything is linear again, about none it isn't."""
        whole = self.estimates[key]
        parts = [
            part for name in key - whole.origin
            if (part := key - {name}) not in self.fits and part in self.estimates
            and self.estimates[part].origin == whole.origin and self.estimates[part].gain > 0.5 * whole.gain
        ]  # fmt: skip
        if not parts or whole.gain < HOPELESS:
            return key
        return self._first_part(max(parts, key=lambda part: self.estimates[part].log_posterior))

    def _refit_from(self, estimate: _Estimate) -> FittedSet:
        origin = self.fits[estimate.origin]
        starts = [self._start(origin.state, estimate.alternatives, estimate.coefficients)]
        signatures = self._signatures
        alone = {name: self.fits.get(frozenset((name,))) for name in starts[0]}
        if len(starts[0]) > 1 and all(alone.values()):
            other: State = {name: f.state[name] for name, f in alone.items() if f is not None}
            starts = [max((starts[0], other), key=self._log_density)]
        for index in estimate.alternatives:
            owner = signatures[index].owner
            stands = self._as_it_stands.get((origin.members, owner))
            if stands is not None:
                starts = [max((starts[0], {**starts[0], owner: stands}), key=self._log_density)]
        if len(estimate.alternatives) == 1:
            owner = signatures[estimate.alternatives[0]].owner
            for index, c in self._near_alternatives(origin, owner, estimate.alternatives[0]):
                starts.append(self._start(origin.state, (index,), (c,)))
        found = [self._fit_at(state) for state in starts]
        best = max(found, key=lambda f: f.base)
        modes: list[FittedSet] = []
        for one in sorted(found, key=lambda f: -f.base):
            if all(_differ(one, m) for m in modes):
                modes.append(one)
        total = log_sum_exp([m.base for m in modes])
        merged = replace(best, shift=total - best.base, others=tuple(modes[1:]))
        merged = self._with_flips(self._by_grid_where_weak(merged, estimate))
        self.fits[merged.members] = merged
        return merged

    def _by_grid_where_weak(self, fit: FittedSet, estimate: _Estimate) -> FittedSet:
        """Return the fit with the closed form's evidence in place of Laplace's where the one hypothesis that joined its
        origin has shapes and a size compatible with 0: its shapes vanish there, and are summed over the grid of
        their prior, the alternatives."""
        joined = fit.members - estimate.origin
        if len(joined) != 1:
            return fit
        (name,) = joined
        if not any(c.is_shape for c in self.hypotheses[name].coordinates):
            return fit
        if all(c.is_shape for c in self.hypotheses[name].coordinates):
            return fit
        origin = self.fits[estimate.origin]
        gain = self.singles.get(estimate.origin, {}).get(name)
        if gain is None or max(gain, fit.base - origin.base) > WEAK:
            return fit
        return replace(fit, shift=fit.shift + origin.base + gain - fit.base)

    def _log_density(self, state: State) -> float:
        """Log of p(y | u) p(u), everyday scales and form errors at their medians."""
        forms = everyday_forms(self.model.has_form_error(state))
        value = self._gaussian(state, forms[len(forms) // 2].share).log_likelihood(self.model.value)
        places = coordinates_of(self.hypotheses, state)
        return value + sum(float(c.log_prior(float(u))) for (_, _, c), u in zip(places, stacked(state), strict=True))

    def _start(self, origin: State, which: Sequence[int], coefficients: Sequence[FloatArray]) -> State:
        state = dict(origin)
        for index, c in zip(which, coefficients, strict=True):
            signature = self._signatures[index]
            hypothesis = self.hypotheses[signature.owner]
            alternative = hypothesis.alternatives[signature.index]
            state[signature.owner] = hypothesis.start(alternative, signature.of_points(c, len(alternative.points)))
        return state

    # --- a refit -----------------------------------------------------------------------------------------------------

    def fit(self, state: State) -> FittedSet:
        """Return the fit of a set from these parameters, and keep it."""
        fit = self._with_flips(self._fit_at(state))
        self.fits[fit.members] = fit
        return fit

    def _with_flips(self, fit: FittedSet) -> FittedSet:
        """Return the fit with those about the mode given unlisted groups that make the set likelier than none does:
        such a mode is another, as the groups explain what a hypothesis would have to."""
        is_hopeless = self.fits and self._log_posterior(fit) < self._top() - HOPELESS
        if is_hopeless or not fit.precision.size or fit.single < fit.everyday + MOVED:
            return fit
        for _ in range(MOST_MOVED):
            weights = fit.by_groups
            best = max(weights, key=lambda u: weights[u])
            if not best or fit.given(best) is not fit or weights[best] < weights[frozenset()] + MOVED:
                return fit
            scales = fit.likeliest.scales.mode(best)
            fit = replace(fit, flipped={**fit.flipped, best: self._fit_at(fit.state, scales)})
        return fit

    def _gaussian(self, state: State, form: float, scales: FloatArray | None = None) -> Gaussian:
        groups = self.model.groups
        columns = self._everyday if scales is None else scaled_columns(groups, scales, len(self.model.value))
        return with_columns(self.model.gaussian(state, form), columns)

    def _fit_at(self, state: State, scales: FloatArray | None = None) -> FittedSet:
        """Return the fit from a state, with the groups at these scales; None: at their median everyday ones."""
        y = self.model.value
        at = everyday_scales(self.model.groups) if scales is None else scales
        places = coordinates_of(self.hypotheses, state)
        coords = [c for _, _, c in places]
        forms = everyday_forms(self.model.has_form_error(state))
        middle = forms[len(forms) // 2].share
        u = stacked(state)
        if len(u):
            for most in EVALUATIONS:
                before, u = (
                    u,
                    self._mode(moved(state, u), coords, u, self._gaussian(moved(state, u), middle, scales), most),
                )
                if np.all(np.abs(u - before) < 1e-3 * np.array([c.unit for c in coords])):
                    break
        state = moved(state, u)
        mean = self.model.mean(state)
        jacobian = self._jacobian(state, coords, u, mean)
        own = sum(self.hypotheses[name].log_prior(point) for name, point in state.items())
        precision, pull = _normal_prior(coords, u)
        fits: list[FormFit] = []
        found: Laplace | None = None

        def add(form: FormScale) -> Laplace:
            bare = self.model.gaussian(state, form.share)
            gaussian = with_columns(bare, scaled_columns(self.model.groups, at, len(y)))
            white = gaussian.whiten(np.column_stack([jacobian, y - mean]))
            slope = self._slope(state, coords, u, gaussian, white[:, :-1], white[:, -1])
            laplace = self._integral(state, coords, u, gaussian, white[:, :-1], white[:, -1], slope)
            free = _within_bounds(coords, u, u + laplace.mean) & (slope == white[:, :-1].T @ white[:, -1])
            integral = ScaleIntegral.of(
                bare, y - mean, self.model.groups, jacobian[:, free], precision[free], pull[free], self.any_unlisted
            )
            base = own + gaussian.log_likelihood(y) + laplace.log_integral
            start_log = integral.log_likelihood(at)
            correction = base - own - bare.log_likelihood(y) - start_log
            fits.append(FormFit(form.share, form.log_prior, base, integral, start_log, correction))
            return laplace

        for form in forms:
            laplace = add(form)
            found = laplace if form.share == middle else found
        if len(fits) > 1 and fits[-1].base > fits[-2].base + STEEP:  # else larger errors are less probable still
            for form in unlisted_forms():
                add(form)
        assert found is not None
        return FittedSet(state, tuple(coords), tuple(fits), found, jacobian, precision, pull)

    def _mode(
        self, state: State, coords: Sequence[Coordinate], u: FloatArray, gaussian: Gaussian, most: int
    ) -> FloatArray:
        y = self.model.value
        low, high = bounds(coords)
        unit = np.array([c.unit for c in coords])

        last: list[tuple[FloatArray, FloatArray, FloatArray]] = []  # u, whitened residual, whitened Jacobian

        def residual(at: FloatArray) -> FloatArray:
            white = gaussian.whiten(y - self.model.mean(moved(state, at)))
            return np.concatenate([white, [c.residual(float(x))[0] for c, x in zip(coords, at, strict=True)]])

        def slope(at: FloatArray) -> FloatArray:
            mean = self.model.mean(moved(state, at))
            white = gaussian.whiten(y - mean)
            table = _updated(last[0], at, white, unit) if last else None
            if table is None:
                table = -gaussian.whiten(self._jacobian(moved(state, at), coords, at, mean))
            last[:] = [(at.copy(), white, table)]
            return np.vstack([table, np.diag([c.residual(float(x))[1] for c, x in zip(coords, at, strict=True)])])

        inside = np.clip(u, low + 1e-9 * unit, high - 1e-9 * unit)
        found = least_squares(
            residual, inside, jac=slope, bounds=(low, high), x_scale=unit, max_nfev=most, xtol=1e-5, ftol=1e-5
        )
        return np.asarray(found.x)

    def _jacobian(self, state: State, coords: Sequence[Coordinate], u: FloatArray, mean: FloatArray) -> FloatArray:
        columns = []
        for k, c in enumerate(coords):
            step = c.step or 0.02 * c.unit
            shifted = u.copy()
            shifted[k] += -step if u[k] + step > c.upper else step
            columns.append((self.model.mean(moved(state, shifted)) - mean) / (shifted[k] - u[k]))
        return np.array(columns).T if columns else np.zeros((len(mean), 0))

    def _slope(
        self, state: State, coords: Sequence[Coordinate], u: FloatArray, gaussian: Gaussian, table: FloatArray,
        r: FloatArray,
    ) -> FloatArray:  # fmt: skip
        """Return the slope (p,) of the log likelihood at u about which it is integrated: J'r. Where the linear problem
        promises a gain within the bounds that the prediction doesn't have there, u isn't its mode, and the linear
        problem says nothing beyond it: parameters that aren't at a bound are integrated about u."""
        slope = table.T @ r
        if not len(u):
            return slope
        d, gain = best_within_bounds(table.T @ table, slope, coords, u)
        if gain < PROMISED:
            return slope
        at = zip(coords, u, strict=True)
        of_prior, precision = np.array([c.slope_and_precision(float(x)) for c, x in at]).T
        prior = float(of_prior @ d - 0.5 * precision @ np.square(d))  # as the linear problem has it
        white = gaussian.whiten(self.model.value - self.model.mean(moved(state, u + d)))
        if prior - 0.5 * (float(white @ white) - float(r @ r)) > 0.5 * gain:
            return slope
        low, high = bounds(coords)
        unit = 1e-6 * np.array([c.unit for c in coords])
        return np.where((u > low + unit) & (u < high - unit), -of_prior, slope)

    def _integral(
        self, state: State, coords: Sequence[Coordinate], u: FloatArray, gaussian: Gaussian, table: FloatArray,
        r: FloatArray, b: FloatArray,
    ) -> Laplace:  # fmt: skip
        """Return the integral over the parameters, given the slope b of the log likelihood at u."""
        a = table.T @ table
        found = integrate(a, b, coords, u)
        near = near_bound(found, coords, u, NEAR)
        if len(near) != 1:
            return found
        (k,) = near
        at = float(r @ r)

        def exact(d: FloatArray) -> float:
            white = gaussian.whiten(self.model.value - self.model.mean(moved(state, u + d)))
            return -0.5 * (float(white @ white) - at)

        def approximate(d: FloatArray) -> float:
            return float(b @ d - 0.5 * d @ a @ d)

        plain = integrate(a, b, coords, u, skip=frozenset((k,)))
        more = correct_along(plain, k, coords, u, approximate, exact)
        return Laplace(plain.log_integral + more, plain.mean, plain.covariance)

    # --- closed form about a fitted set ------------------------------------------------------------------------------

    @cached_property
    def _signatures(self) -> tuple[Signature, ...]:
        return signatures_of(self.model, self.hypotheses)

    @cached_property
    def _stack(self) -> FloatArray:
        if not self._signatures:
            return np.zeros((len(self.model.value), 0))
        return np.concatenate([s.raw for s in self._signatures], axis=1)

    def _gram(self, origin: FittedSet) -> FloatArray:
        """Return the Gram matrix of the groups' columns, the signatures and the residual about a fitted set, whitened
        by all but the groups, the set's own parameters marginalised."""
        gaussian = self.model.gaussian(origin.state, origin.likeliest.form)
        residual = self.model.value - gaussian.mean
        if len(origin.precision):
            gaussian = with_columns(gaussian, origin.jacobian / np.sqrt(origin.precision))
            residual = residual - origin.jacobian @ (origin.pull / origin.precision)
        white = gaussian.whiten(np.column_stack([*(g.columns for g in self.model.groups), self._stack, residual]))
        upper = dsyrk(1.0, white.T)
        return np.asarray(upper + np.triu(upper, 1).T)

    def _linear(self, gram: FloatArray, tau: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z and R of the signatures with the groups at these scales (G,) marginalised, given `_gram`."""
        left = project_groups(gram, np.repeat(tau, [g.columns.shape[1] for g in self.model.groups]))
        return left[:-1, -1], left[:-1, :-1]

    def _averaged_over_scales(
        self, scales: ScaleIntegral, unlisted: frozenset[int], gram: FloatArray, single: Iterable[int]
    ) -> dict[int, float]:
        """Return the log evidence ratios of single signatures over a fitted set, with the groups' scales integrated:

            p(y | A + k) / p(y | A) = mean over p(tau | y, A) of p(y | A + k, tau) / p(y | A, tau).

        A hypothesis leaves less to the groups than the set without it, so that the ratio at that set's likeliest scales
        is too small."""
        which = list(single)
        signatures = [self._signatures[i] for i in which]
        ratios = []
        for tau in scales.stratified(unlisted, SCALES_AVERAGED):
            z, square = self._linear(gram, tau)
            ratios.append(signature_log_odds(z, square, signatures))
        if not which:
            return {}
        found = log_mean_exp(np.array(ratios))
        # several columns are integrated one after the other: only how that depends on the scales is taken from it
        several = [k for k, s in enumerate(signatures) if len(s.columns) > 1]
        z, square = self._linear(gram, scales.mode(unlisted))
        found[several] -= signature_log_odds(z, square, [signatures[k] for k in several])
        found[several] += [integrate_set(z, square, [signatures[k]])[0] for k in several]
        return dict(zip(which, found.tolist(), strict=True))

    def _near_alternatives(self, origin: FittedSet, owner: str, chosen: int) -> list[tuple[int, FloatArray]]:
        """Return other alternatives of a hypothesis that are nearly as likely as the one chosen."""
        known = self._by_alternative[origin.members]
        own = {i: v for i, (v, _) in known.items() if self._signatures[i].owner == owner}
        near = [i for i in own if i != chosen and own[i] > own[chosen] - ALTERNATIVES_NEAR]
        near.sort(key=lambda i: -own[i])
        return [(i, known[i][1]) for i in near[: MOST_ALTERNATIVES - 1]]

    @cached_property
    def _by_alternative(self) -> dict[frozenset[str], dict[int, tuple[float, FloatArray]]]:
        return {}

    @cached_property
    def _as_it_stands(self) -> dict[tuple[frozenset[str], str], Point]:
        """By origin and owner, the point of an alternative that is likeliest as it stands: of large changes, scaling by
        the closed form's coefficient may be far off."""
        return {}

    def _linearise(self, origin: FittedSet) -> None:
        """Estimate all sets with one, two or three members more than a fitted one: with all groups everyday, and with
        the likeliest of them unlisted where that matters."""
        weights = origin.by_groups
        none: frozenset[int] = frozenset()
        best = max(weights, key=lambda u: weights[u])
        gram = self._gram(origin)
        for unlisted in dict.fromkeys((none, best)):
            if weights[unlisted] > weights[best] - FAR_BELOW or unlisted == none:
                about = origin.given(unlisted)
                self._linearise_with(origin, unlisted, gram if about is origin else self._gram(about))

    def _linearise_with(self, origin: FittedSet, unlisted: frozenset[int], whole: FloatArray) -> None:
        scales = origin.given(unlisted).likeliest.scales
        z, gram = self._linear(whole, scales.mode(unlisted))
        signatures = self._signatures
        owners: dict[str, list[int]] = {}
        for i, s in enumerate(signatures):
            if s.owner not in origin.state:
                owners.setdefault(s.owner, []).append(i)
        outside = [i for own in owners.values() for i in own]
        single = dict(zip(outside, integrate_each(z, gram, [signatures[i] for i in outside]), strict=True))
        ratio = self._averaged_over_scales(scales, unlisted, whole, single)
        gains = {
            o: log_sum_exp([ratio[i] + signatures[i].log_share for i in own]) - float(np.log(len(own)))
            for o, own in owners.items()
        }
        if not unlisted:
            for o, own in owners.items():
                taken = {
                    (i, point): z[k] - 0.5 * gram[k, k]
                    for i in own
                    for k, (point, _) in zip(signatures[i].columns, signatures[i].points, strict=True)
                }
                i, point = max(taken, key=lambda key: taken[key])
                alternative = self.hypotheses[o].alternatives[signatures[i].index]
                self._as_it_stands[origin.members, o] = alternative.points[point]
            self._by_alternative[origin.members] = single
            self.singles[origin.members] = gains
        best = {o: max(own, key=lambda i: single[i][0]) for o, own in owners.items()}
        # of all alternatives and scales over the best at the likeliest scales
        shared = {o: gains[o] - single[best[o]][0] for o in owners}
        for o, gain in gains.items():
            self._estimate(origin, unlisted, {o}, gain, (best[o],), (single[best[o]][1],))
        pairs = self._pairs(origin, unlisted, z, gram, single, owners, shared)
        self._triples(origin, unlisted, z, gram, pairs, best, gains, shared)

    def _estimate(
        self, origin: FittedSet, unlisted: frozenset[int], more: set[str], gain: float, which: tuple[int, ...],
        c: tuple[FloatArray, ...],
    ) -> None:  # fmt: skip
        """Note a set's log posterior beside an origin with these groups unlisted. The estimate about the largest origin
        counts, of several the likeliest; those of one origin by other groups stand beside each other."""
        key, weight = origin.members | more, origin.by_groups[unlisted]
        value, at = weight + gain + self.prior.log(key), weight + self.prior.log(origin.members)
        known = self.estimates.get(key)
        if not np.isfinite(value):
            return
        one = _Estimate({unlisted: value}, gain, at, origin.members, which, c)
        if known is not None and known.origin == origin.members:
            first = known if known.log_posterior > value else one
            self.estimates[key] = replace(first, by_groups={**known.by_groups, unlisted: value})
        elif known is None or self._is_nearer(origin, known):
            self.estimates[key] = one

    def _is_nearer(self, origin: FittedSet, known: _Estimate) -> bool:
        other = self.fits[known.origin]
        return (len(origin.members), self._log_posterior(origin)) > (len(other.members), self._log_posterior(other))

    def _pairs(
        self, origin: FittedSet, unlisted: frozenset[int], z: FloatArray, gram: FloatArray,
        single: Mapping[int, tuple[float, FloatArray]], owners: Mapping[str, list[int]], shared: Mapping[str, float],
    ) -> list[tuple[float, str, str, int, int]]:  # fmt: skip
        """Estimate all pairs, the best of them one by one; return these, likeliest first."""
        signatures = self._signatures
        exact = []
        for rank, (gain, name, other, one, two_) in enumerate(self._rank_pairs(z, gram, single, owners, shared)):
            value, c = gain, (single[one][1], single[two_][1])
            if rank < PAIRS:
                integral, both = integrate_set(z, gram, [signatures[one], signatures[two_]])
                value = integral + shared[name] + shared[other]
                cut = len(signatures[one].coordinates)
                c = (both[:cut], both[cut:])
                exact.append((value, name, other, one, two_))
            self._estimate(origin, unlisted, {name, other}, value, (one, two_), c)
        prior = {n: float(np.log(self.prior.weight[n])) for n in owners}
        return sorted(exact, key=lambda t: -(t[0] + prior[t[1]] + prior[t[2]]))

    def _rank_pairs(
        self, z: FloatArray, gram: FloatArray, single: Mapping[int, tuple[float, FloatArray]],
        owners: Mapping[str, list[int]], shared: Mapping[str, float],
    ) -> list[tuple[float, str, str, int, int]]:  # fmt: skip
        """Return all pairs of hypotheses, each by its best signatures, with an estimate of its gain of log evidence,
        likeliest first."""
        signatures = self._signatures
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        unit_z, rho = z / size, gram / np.outer(size, size)
        two = np.array([not np.isfinite(c.lower) for s in signatures for c in s.coordinates], bool)
        angle = np.maximum(1.0 - rho**2, 1e-6)
        first, second = (unit_z[:, None] - rho * unit_z) / angle, (unit_z - rho * unit_z[:, None]) / angle
        inside = ((first > 0) | two[:, None]) & ((second > 0) | two)
        alone = np.where(two, np.square(unit_z), np.square(np.maximum(unit_z, 0.0)))
        bound = np.maximum(
            np.where(inside, first * unit_z[:, None] + second * unit_z, 0.0), np.maximum(alone[:, None], alone)
        )
        occam = {}
        for i in single:
            own = list(signatures[i].columns)
            occam[i] = single[i][0] - 0.5 * float(alone[own].max())
        tried = []
        names = list(owners)
        columns = {o: np.concatenate([signatures[i].columns for i in owners[o]]).astype(int) for o in names}
        of_column = np.array([i for i, s in enumerate(signatures) for _ in s.columns], int)
        for a, name in enumerate(names):
            for other in names[:a]:
                part = bound[np.ix_(columns[name], columns[other])]
                i, j = divmod(int(np.argmax(part)), part.shape[1])
                one, two_ = int(of_column[columns[name][i]]), int(of_column[columns[other][j]])
                gain = 0.5 * float(part[i, j]) + min(occam[one], 0.0) + min(occam[two_], 0.0)
                gain += shared[name] + shared[other]
                tried.append((gain, name, other, one, two_))
        prior = {n: float(np.log(self.prior.weight[n])) for n in names}
        return sorted(tried, key=lambda t: -(t[0] + prior[t[1]] + prior[t[2]]))

    def _triples(
        self, origin: FittedSet, unlisted: frozenset[int], z: FloatArray, gram: FloatArray,
        pairs: Sequence[tuple[float, str, str, int, int]], best: Mapping[str, int],
        gains: Mapping[str, float], shared: Mapping[str, float],
    ) -> None:  # fmt: skip
        """Estimate the best pairs with the hypotheses that promise most beside them."""
        signatures = self._signatures
        for gain, name, other, one, two in pairs[:TRIPLES]:
            if gain <= max(gains[name], gains[other]) + SILENT:
                continue
            left = self._left(z, gram, [signatures[one], signatures[two]])
            promising = sorted((o for o in best if o not in (name, other)), key=lambda o: -left[best[o]])[:EXTENSIONS]
            for third in promising:
                three = [signatures[i] for i in (one, two, best[third])]
                value, c = integrate_set(z, gram, three)
                cuts = np.cumsum([len(s.coordinates) for s in three])[:-1]
                value += sum(shared[o] for o in (name, other, third))
                self._estimate(
                    origin, unlisted, {name, other, third}, value, (one, two, best[third]), tuple(np.split(c, cuts))
                )  # fmt: skip

    def _left(self, z: FloatArray, gram: FloatArray, members: Sequence[Signature]) -> FloatArray:
        """Return what one column of each signature by itself takes of the residual that `members` leave."""
        own = [k for s in members for k in s.columns]
        inner = gram[np.ix_(own, own)] + 1e-8 * np.diag(np.diag(gram)[own] + 1e-300)
        weight = np.linalg.solve(inner, np.column_stack([z[own], gram[own]]))
        rest = z - gram[:, own] @ weight[:, 0]
        square = np.maximum(np.diag(gram) - np.einsum("ij,ji->i", gram[:, own], weight[:, 1:]), 1e-6 * np.diag(gram))
        two = np.array([not np.isfinite(c.lower) for s in self._signatures for c in s.coordinates], bool)
        taken = np.square(np.where(two, rest, np.maximum(rest, 0.0))) / np.maximum(square, 1e-300)
        return np.array([taken[list(s.columns)].max() for s in self._signatures])

    def healthy_draws(self, draws: int, rng: np.random.Generator) -> FloatArray:
        """Return p(no effect, nothing unlisted) of draws without either, (draws,), lowest first. The lowest ones are
        those of the closed form about the empty set, as a measured set's; of the others a rougher one
        (`HealthyDraws.screen`), which is mostly too low: it is refined from below, until `LOWEST` are below the
        rest."""
        drawn = HealthyDraws.of(self.model, self._signatures, self.any_unlisted, draws, rng)
        found = drawn.screen(self.hypotheses, self._signatures, self.prior)
        refined: list[float] = []
        for d in np.argsort(found)[:MOST_REFINED]:
            if np.sum(np.array(refined) < found[d]) >= LOWEST:
                break
            found[d] = self._nothing(*drawn.one(int(d)))
            refined.append(float(found[d]))
        return np.sort(found)

    def _nothing(self, scales: ScaleIntegral, gram: FloatArray) -> float:
        """Return p(nothing) about the empty set in closed form."""
        none = frozenset[int]()
        ratio = self._averaged_over_scales(scales, none, gram, range(len(self._signatures)))
        gains = gains_of(np.array([ratio[i] for i in range(len(ratio))]), self.hypotheses, self._signatures)
        everyday, singles = scales.quick
        return 1.0 / (1.0 + float(np.exp(singles - everyday)) + float(others_over_empty(gains, self.prior)))

    # --- the table ---------------------------------------------------------------------------------------------------

    def table(self) -> Table:
        """Return all sets with their probabilities: of refitted ones by the groups that are unlisted."""
        top = self._top()
        log: dict[tuple[frozenset[str], frozenset[int]], float] = {}
        for key, fit in self.fits.items():
            prior = self.prior.log(key)
            if self._log_posterior(fit) > top - 2.0 * FAR_BELOW:
                log |= {(key, u): w + prior for u, w in fit.by_groups.items()}
            else:
                log[key, frozenset()] = self._log_posterior(fit)
        open_ = {k: e for k, e in self.estimates.items() if k not in self.fits and self._is_near(e)}
        log |= {(k, u): value for k, e in open_.items() for u, value in e.by_groups.items()}
        tails = {
            k: self._tail(self.fits[k]) for k in self.singles if self._log_posterior(self.fits[k]) > top - FAR_BELOW
        }
        total = log_sum_exp([*log.values(), *(t.probability for t in tails.values())])
        enough = {k for k, e in self.estimates.items() if e.gain <= SILENT}
        rows = [Row(k, u, float(np.exp(v - total)), k in self.fits, k in enough) for (k, u), v in log.items()]
        rows.sort(key=lambda r: -r.probability)
        shares = tuple(replace(t, probability=float(np.exp(t.probability - total))) for t in tails.values())
        return Table(
            tuple(rows), shares, dict(self.fits), tuple(g.name for g in self.model.groups), total, len(self.fits)
        )

    def _tail(self, origin: FittedSet) -> Tail:
        """Return the tail of a linearised set, with the log of its evidence times prior as `probability`. The evidence
        of silent hypotheses is taken as the product of those of each alone."""
        gains = {n: g for n, g in self.singles[origin.members].items() if g <= SILENT}
        weight = {n: float(self.prior.weight[n] * np.exp(g)) for n, g in gains.items()}
        most = len(self.prior.number) - 1 - len(origin.members)
        sizes = range(3, most + 1)
        inside = float(np.prod([self.prior.weight[n] for n in origin.members]))
        factor = {k: self.prior.scale(len(origin.members) + k) * inside for k in sizes}

        def mass(without: Sequence[str]) -> float:
            sums = symmetric([w for n, w in weight.items() if n not in without], max(most, 0))
            return float(sum(factor[k] * sums[k] for k in sizes if k < len(sums)))

        whole = mass(())
        if whole <= 0.0:
            return Tail(origin.members, -np.inf, {}, {})
        families: dict[str, list[str]] = {}
        for name in gains:
            families.setdefault(self.hypotheses[name].family, []).append(name)
        effects = {n: 1.0 - mass((n,)) / whole for n in gains}
        held = {f: 1.0 - mass(names) / whole for f, names in families.items()}
        unlisted: dict[str, float] = {}
        for groups, value in origin.by_groups.items():
            for name in {self.model.groups[g].name for g in groups}:
                unlisted[name] = unlisted.get(name, 0.0) + float(np.exp(value - origin.total))
        return Tail(origin.members, origin.quick + float(np.log(whole)), effects, held, unlisted)


def _updated(
    last: tuple[FloatArray, FloatArray, FloatArray], at: FloatArray, white: FloatArray, unit: FloatArray
) -> FloatArray | None:
    """Return the Jacobian (n, p) of a residual after a step that changed it nearly as the last Jacobian says (Broyden,
    Math. Comp. 19, 577, 1965); None where it didn't."""
    u, before, table = last
    step, change = (at - u) / unit, white - before
    off = change - table @ (at - u)
    square = float(step @ step)
    if square == 0.0 or np.linalg.norm(off) > NEARLY_LINEAR * np.linalg.norm(change):
        return table if square == 0.0 else None
    return np.asarray(table + np.outer(off, step / unit) / square)


def _differ(one: FittedSet, other: FittedSet) -> bool:
    """Whether two fits of a set are at different modes."""
    if any(
        one.state[n].template is not other.state[n].template and _choices(one.state[n]) != _choices(other.state[n])
        for n in one.state
    ):
        return True
    std = np.sqrt(np.diag(one.laplace.covariance) + np.diag(other.laplace.covariance))
    away = np.abs(stacked(one.state) - np.concatenate([other.state[n].u for n in one.state]))
    return bool(np.any(away > 2.0 * std))


def _within_bounds(coords: Sequence[Coordinate], u: FloatArray, mean: FloatArray) -> np.ndarray:
    """Return which parameters are marginalised with the groups' scales: those that aren't held at a bound, beyond which
    the linear problem has its mean. Without bounds they would take what a group explains, with the wrong sign."""
    low, high = bounds(coords)
    unit = 1e-3 * np.array([c.unit for c in coords])
    return np.asarray(~(((mean <= low + unit) & (u <= low + unit)) | ((mean >= high - unit) & (u >= high - unit))))


def _choices(point: Point) -> object:
    """Return what tells a point from others of its hypothesis beside u: an effect's choices; else the template."""
    template = point.template
    names = getattr(type(template), "choices", None)
    return template if names is None else tuple(getattr(template, n) for n in names())


def _normal_prior(coords: Sequence[Coordinate], u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return precision and pull = precision (centre - u) of the normal prior about each centre with the same slope at
    u."""
    precision = []
    for c, x in zip(coords, u, strict=True):
        if not np.isfinite(c.scale):
            precision.append((c.upper - c.lower) ** -2.0)
        elif c.is_shape:
            precision.append(c.scale**-2.0)
        else:
            t = np.asarray((x - c.centre) / c.scale)
            precision.append(float(size_precision(t, np.asarray(c.smaller))) / c.scale**2)
    found = np.array(precision)
    centre = np.array([c.centre if np.isfinite(c.scale) else x for c, x in zip(coords, u, strict=True)])
    return found, found * (centre - u)
