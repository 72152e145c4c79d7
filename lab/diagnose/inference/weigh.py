"""Weigh one member of a set of effects: its probability against rivals in its place, an unknown cause, and misstated
metadata."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lab.diagnose.inference.discrepancy import likeliest_discrepancy
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import Fit, log_likelihood
from lab.diagnose.inference.search import Search
from lab.diagnose.policy import DecisionPolicy
from lab.observables.gaussian import Gaussian
from sim.effects.base import Effect
from sim.effects.library import list_changes
from sim.effects.other_f_number import OtherFNumber
from sim.point import TRANSFER

#: Name of the hypothesis that no effect of the library is the cause.
UNKNOWN = "unknown"
#: Ratios to the stated f-number from which its fit starts.
F_NUMBER_RATIOS = (0.75, 1.35)
#: Rivals below this probability aren't kept.
LEAST_KEPT_PROBABILITY = 1e-4


@dataclass(frozen=True)
class Candidate:
    """An effect that may be named, with the probabilities of its name and of what else may be meant.

    `log_odds`: log posterior of its set over that of the set without it.
    `explained_share`: of the excess chi2 in the measurements that it acts on.
    `is_closed`: what is left there is within noise and the form tolerances of the named laws. `is_closed_somewhere`: it
    is in one of the measurements that show the effect.
    `remark`: metadata that would explain the recordings as well, in words.
    `among_listed`: probabilities of the effect and its rivals if the cause is one of them, likeliest first; empty where
    none was weighed. `intervals`: of sizes that no normal distribution describes, from low to high; their standard
    deviation is None. `unsigned`: parameters whose sign, turned together, the recordings don't tell. `modes`: values of
    the parameters in other modes of the posterior that are as likely. `alike`: the effect by others of its choices, of
    which the recordings don't tell it. `members`: where the family is named and not the effect, the family's effects
    with their probabilities, likeliest first."""

    effect: Effect
    std: dict[str, float | None]
    probability: float
    rivals: tuple[tuple[str, float], ...]
    log_odds: float
    explained_share: float = 1.0
    is_closed: bool = True
    is_closed_somewhere: bool = True
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    unsigned: frozenset[str] = frozenset()
    modes: tuple[dict[str, float], ...] = ()
    alike: tuple[Effect, ...] = ()
    remark: str = ""
    among_listed: tuple[tuple[str, float], ...] = ()
    members: tuple[tuple[str, float], ...] = ()

    @property
    def told_name(self) -> str:
        """The name that is given: the effect's, or its family's."""
        return type(self.effect).family.value if self.members else self.effect.name

    @property
    def alternatives(self) -> tuple[tuple[str, float], ...]:
        """What may be meant besides the effect, likeliest first: the other members of a family that is named, and
        rivals."""
        others = [(n, p) for n, p in self.members if n != self.effect.name]
        return tuple(sorted([*others, *self.rivals], key=lambda item: -item[1]))

    @property
    def sizes(self) -> dict[str, float]:
        """The fitted parameters that size the effect, with their values without it: all but shapes, or all where there
        is nothing else."""
        kind = type(self.effect)
        absent = {name: q.absent for name, q in kind.quantities().items() if q.absent is not None and name in self.std}
        return {name: value for name, value in absent.items() if name not in kind.shapes} or absent

    def is_compatible_with_absence(self, sigma: float) -> bool:
        """Say whether every parameter that sizes the effect lies within `sigma` standard deviations of its value
        without it. A parameter whose standard deviation isn't known isn't compatible."""
        sizes = self.sizes

        def is_near(name: str, value: float) -> bool:
            std = self.std[name]
            return std is not None and abs(float(getattr(self.effect, name)) - value) < sigma * std

        return bool(sizes) and all(is_near(name, value) for name, value in sizes.items())

    @property
    def holds_a_remainder(self) -> bool:
        """Whether what its law leaves is a part of what is named: of a family no law of which is exact."""
        return bool(self.members) and not self.is_closed


def weigh(search: Search, fit: Fit, index: int) -> tuple[Candidate, Fit | None]:
    """One member of a fitted set as a candidate; and the set with a rival in its place, where that is likelier.

    Hypotheses, each with its log posterior:

    - the member, and every effect whose score is near its own in its place. Where both act, a model discrepancy is
      allowed beside either,
      so that neither is preferred for what both leave;
    - where no law holds, for the family's sake: the same with a discrepancy in each measurement that the member acts
      on, beside every effect;
    - unknown: discrepancies in place of the member, with the other members as they are or refitted, or misstated
      metadata."""
    model, policy, effect = search.model, search.policy, fit.effects[index]
    rest = (*fit.effects[:index], *fit.effects[index + 1 :])
    without, affected = search.without(fit, index), model.affected_blocks(effect)
    log_odds = fit.log_posterior - without.log_posterior
    misstated, remark = _misstated_metadata(search, fit, index)
    if misstated > fit.log_posterior + policy.sure_misstated_log_odds:
        return Candidate(effect, fit.std[index], 0.0, ((UNKNOWN, 1.0),), log_odds, remark=remark), None

    def with_discrepancies(gaussian: Gaussian, blocks: Sequence[int]) -> float:
        return sum(likeliest_discrepancy(model, gaussian, i, policy).log_odds for i in blocks)

    fits = {effect.name: fit} | _rival_fits(search, fit, index, without)
    weights = {}
    for name, tried in fits.items():
        weights[name] = tried.log_posterior
        if tried.log_posterior > fit.log_posterior - policy.hopeless_log_odds:
            kind = next(type(e) for e in tried.effects if e.name == name)
            common = [i for i in affected if model.blocks[i].touched_by(kind)]
            weights[name] += with_discrepancies(model.seen_gaussian(tried.effects), common)
    log_prior = fit.log_posterior - fit.log_likelihood
    as_they_are = (
        log_likelihood(model, rest, policy) + log_prior + with_discrepancies(model.seen_gaussian(rest), affected)
    )
    refitted = without.log_posterior + with_discrepancies(model.seen_gaussian(without.effects), affected)
    weights[UNKNOWN] = max(as_they_are, refitted, misstated)

    top = max(weights.values())
    odds = {name: float(np.exp(w - top)) for name, w in weights.items()}
    total = sum(odds.values())
    rivals = [(n, o / total) for n, o in odds.items() if n != effect.name and o / total > LEAST_KEPT_PROBABILITY]
    share, is_closed = explained(model, fit, without, affected, policy)
    first = max((n for n in odds if n != UNKNOWN), key=lambda n: odds[n])
    better = fits[first] if odds[first] > odds[effect.name] else None
    candidate = Candidate(
        effect,
        fit.std[index],
        odds[effect.name] / total,
        tuple(sorted(rivals, key=lambda r: -r[1])),
        log_odds,
        share,
        is_closed,
        is_closed or closes_somewhere(model, fit, index, policy),
        remark=remark if misstated >= top else "",
        among_listed=_among_listed(
            {n: weights[n] for n in fits}
            if is_closed
            else {
                n: f.log_posterior + with_discrepancies(model.seen_gaussian(f.effects), affected)
                for n, f in fits.items()
            }
        ),
    )
    return candidate, better


def _among_listed(weights: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """Probabilities by log posterior, likeliest first."""
    top = max(weights.values())
    odds = {name: float(np.exp(w - top)) for name, w in weights.items()}
    total = sum(odds.values())
    kept = [(n, o / total) for n, o in odds.items() if o / total > LEAST_KEPT_PROBABILITY]
    return tuple(sorted(kept, key=lambda item: -item[1]))


def _rival_fits(search: Search, fit: Fit, index: int, without: Fit) -> dict[str, Fit]:
    """Return the set with each effect in the place of a member that promises enough in closed form: fitted roughly, and
    to convergence where it isn't far behind. What the budget leaves is noted."""
    policy = search.policy
    log_odds = fit.log_posterior - without.log_posterior
    scores = [s for s in search.signatures(without).scores() if s.effect.name not in fit.names]
    found = {}
    for score in [s for s in scores if 0.5 * s.value > policy.promised_share * log_odds][: policy.refitted_sets]:
        start = (*fit.effects[:index], score.start, *fit.effects[index + 1 :])
        if search.is_spent and not search.is_known(start):
            search.leave(start)
            continue
        rough = search.fitted(start, beside=fit)
        is_near = search.promised_log_odds(rough) > search.log_odds(fit) - policy.hopeless_log_odds
        found[score.effect.name] = search.fitted(start, converged=True) if is_near else rough
    return found


def _misstated_metadata(search: Search, fit: Fit, index: int) -> tuple[float, str]:
    """Log posterior, less prior odds, of the set with another f-number or pitch than stated in the place of an effect
    that blurs; and that in words. -inf for effects that don't blur, and where the fitted ratio is below
    `misstated_ratio`."""
    model, policy, effect = search.model, search.policy, fit.effects[index]
    if TRANSFER.isdisjoint(list_changes(effect)):
        return -np.inf, ""
    rest = (*fit.effects[:index], *fit.effects[index + 1 :])
    starts = [(*rest, OtherFNumber(ratio=ratio)) for ratio in F_NUMBER_RATIOS]
    if search.is_spent and not search.is_known(starts[0]):
        search.leave(starts[0])
        return -np.inf, ""
    tried = search.fitted(max(starts, key=lambda s: log_likelihood(model, s, policy)), beside=fit)
    if tried.log_posterior < fit.log_posterior - policy.hopeless_log_odds:
        return -np.inf, ""
    tried = search.fitted(tried.effects, converged=True)
    ratio = next(e.ratio for e in tried.effects if isinstance(e, OtherFNumber))
    if abs(np.log(ratio)) <= np.log(policy.misstated_ratio):
        return -np.inf, ""
    stated, pitch = model.camera.lens.f_number, model.camera.pixel_pitch_um
    return (
        tried.log_posterior,
        (
            f"as if the lens worked at f/{stated * ratio:.3g} in place of f/{stated:.3g}, "
            f"or the pixels' pitch were {pitch / ratio:.3g} um in place of {pitch:.3g}"
        ),
    )


def explained(
    model: MeasurementModel, fit: Fit, without: Fit, affected: Sequence[int], policy: DecisionPolicy
) -> tuple[float, bool]:
    """Share of the excess chi2 that an effect explains in the blocks it acts on; and whether what is left there is
    closed.

    share = (chi2 without - chi2 with) / (chi2 without - n), by the baseline's covariance, so that an effect's own form
    tolerance explains nothing; 1 where chi2 with it is within `noise_sigma` of n. Closed: chi2 by the covariance with
    form tolerances is within `noise_sigma` of n; the standard deviation of chi2 is sqrt(2 n).
    """
    if not affected:
        return 1.0, True
    where = np.any([model.mask(i) for i in affected], axis=0) & model.seen
    n = int(where.sum())
    sigma = np.sqrt(2.0 * n)
    left = model.gaussian(fit.effects, where).chi2(model.value[where]) / (1.0 + policy.covariance_slack) ** 2
    is_closed = left - n < policy.noise_sigma * sigma
    gaussian = model.gaussian((), where)
    after, before = (
        float(np.sum(np.square(gaussian.whiten((model.value - model.mean(f.effects))[where])))) for f in (fit, without)
    )
    if after - n < policy.noise_sigma * sigma:
        return 1.0, is_closed
    return max(before - after, 0.0) / max(before - n, 1e-9), is_closed


def closes_somewhere(model: MeasurementModel, fit: Fit, index: int, policy: DecisionPolicy) -> bool:
    """Say whether the law of a member holds in one of the measurements that show it: chi2 of its seen numbers there, by
    the covariance with form tolerances, is within `noise_sigma` of their count. A measurement shows it as `shown_chi2`
    and `shown_share` say."""
    effect = fit.effects[index]
    others = tuple(e for e in fit.effects if e is not effect)
    changes = {i: model.change_chi2(effect, others, i) for i in model.affected_blocks(effect)}
    least = max(policy.shown_chi2, policy.shown_share * max(changes.values(), default=0.0))
    for block, change in changes.items():
        where = model.mask(block) & model.seen
        n = int(where.sum())
        if n and change > least:
            left = model.gaussian(fit.effects, where).chi2(model.value[where]) / (1.0 + policy.covariance_slack) ** 2
            if left - n < policy.noise_sigma * np.sqrt(2.0 * n):
                return True
    return False
