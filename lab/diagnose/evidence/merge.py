"""The sides as one result: what is named, the verdict, and the result in sentences.

A hypothesis on a camera is one for each side; on the light, the screen or the chart it is one for the whole set. Of
such a hypothesis h, with the sides' recordings y_s independent given it and its parameters u,

    p(h | y) / p(not h | y) = prior odds * prod_s [posterior odds_s / prior odds] * c,
    c = integral p(u | y_1) p(u | y_2) / p(u) du = N(u_1 - u_2; 0, C_1 + C_2) * E[1 / p(u)],   u ~ N(u_12, C_12)

where u_s, C_s are the mean and the covariance of its parameters by side s, and C_12^-1 = C_1^-1 + C_2^-1, u_12 = C_12
(C_1^-1 u_1 + C_2^-1 u_2) those by both: the joint fit. Sides that contradict each other have small c; one that says
nothing of u has the prior as its posterior, and c = 1."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from lab.diagnose.evidence.causes import LEAST_LISTED, Cause
from lab.diagnose.evidence.side import DRAWS, FALSE_ALARM_RATE, EvidenceFindings
from lab.diagnose.outcome.detectability import told_as
from lab.diagnose.outcome.determined import combinations
from lab.diagnose.outcome.named_in_words import (
    LEAST_CAPTURES,
    choices_of,
    combination_in_words,
    family_statement,
    plain_name,
    pooled,
)
from lab.diagnose.outcome.next_capture import next_sentence
from lab.diagnose.policy import DEFAULT_POLICY
from lab.effect_titles import effect_title
from lab.formats.results import (
    Combination,
    DiagnosisLists,
    DiagnosisResult,
    DiagnosisVerdict,
    HeldOut,
    Member,
    NamedEffect,
    ParameterValue,
    PolicyRule,
    Rival,
)
from lab.formats.results.words import format_value
from lab.inference.check import RATE as HELD_OUT_RATE
from lab.inference.posterior import LIKELIER, NAMED, Size
from lab.inference.search import REFITS
from lab.observables.observable import measurement_title
from sim.camera import Side
from sim.effects.library import effects as library
from sim.parameters import Quantity
from sim.spectrum import FloatArray

#: Sets and members that a sentence lists.
LISTED = 4
#: Draws behind the mean of 1 / p(u) over the joint fit: right to 3 % where p changes by a factor of three there.
AGREEMENT_DRAWS = 2000
#: Odds beyond which a probability is 0 or 1 to a double's rounding.
LARGEST_LOG_ODDS = 35.0


@dataclass(frozen=True)
class _Named:
    """A cause with the sides that it is named for, and its probability there."""

    sides: tuple[Side, ...]
    causes: tuple[Cause, ...]
    probability: float


def merged_evidence(source: str, found: Sequence[EvidenceFindings], warnings: Sequence[str] = ()) -> DiagnosisResult:
    """Return the findings of all sides as one result. `warnings`: of the fit."""
    found = told_by_all(found)
    lists = DiagnosisLists.joined([f.lists for f in found])
    named = _named(found)
    effects = tuple(_entry(one, found) for one in named)
    verdict = _verdict(found, named)
    held_out = _held_out(found)
    offered = tuple(capture for f in found if f.doubt is not None for capture in f.doubt.listed(DEFAULT_POLICY))
    settling = " ".join(f.settling for f in found if f.settling) or None
    return DiagnosisResult(
        **dict(lists),
        source=source,
        engine="evidence",
        verdict=verdict,
        effects=effects,
        held_out=held_out,
        next_capture=LEAST_CAPTURES
        if verdict == "nothing_judged"
        else next_sentence(offered, settling, DEFAULT_POLICY),
        next_captures=offered,
        false_alarm_rate=FALSE_ALARM_RATE if any(f.is_judged for f in found) else None,
        summary=(*_summary(verdict, lists, effects, held_out, found), *(f"Warning: {line}." for line in warnings)),
        warnings=tuple(warnings),
        policy=RULES,
    )


#: The rules of decision: what is chosen, and not measured or derived.
RULES = (
    PolicyRule(
        name="false_alarm_rate", group="verdict", value=FALSE_ALARM_RATE, unit="1",
        meaning=f"share of cameras without effects whose probability of none falls below the threshold ({DRAWS} draws)",
    ),
    PolicyRule(
        name="named_probability", group="verdict", value=NAMED, unit="1",
        meaning="posterior probability from which on an effect or a family is named",
    ),
    PolicyRule(
        name="held_out_rate", group="verdict", value=HELD_OUT_RATE, unit="1",
        meaning="family-wise rate of contradictions by held-out captures (Holm), and of places that are mismatches",
    ),
    PolicyRule(
        name="refits", group="budget of the search", value=REFITS, unit="1", meaning="sets that are refitted a side",
    ),
)  # fmt: skip


# --- names ------------------------------------------------------------------------------------------------------------


def told_by_all(found: Sequence[EvidenceFindings]) -> list[EvidenceFindings]:
    """Return the findings of each side with the probabilities of what is its own given all sides."""
    shared = {name: p for name, (p, _) in _shared(found).items()}
    return [_reweighed(one, shared) for one in found]


def _shared(found: Sequence[EvidenceFindings]) -> dict[str, tuple[float, list[tuple[EvidenceFindings, Cause]]]]:
    """Return the causes that all sides share, with their probabilities given all, and what each side says of them."""
    if len(found) < 2:
        return {}
    by_name: dict[str, list[tuple[EvidenceFindings, Cause]]] = {}
    for findings in found:
        for cause in findings.causes:
            by_name.setdefault(cause.name, []).append((findings, cause))
    return {
        name: (joint_probability(name, found, [cause for _, cause in members]), members)
        for name, members in by_name.items()
        if members[0][1].is_of_the_set
    }


def _reweighed(findings: EvidenceFindings, shared: Mapping[str, float]) -> EvidenceFindings:
    """Return a side's findings with the probabilities of its own causes, of nothing and of unlisted states given what
    all sides say of the shared hypotheses."""
    weight = np.array([row.probability for row in findings.rows])
    changed = weight.copy()
    for name, p in shared.items():
        holds = np.array([_holds(name, row.members) for row in findings.rows], bool)
        own = float(weight[holds].sum() / weight.sum()) if len(weight) else 0.0
        if 0.0 < own < 1.0:
            changed = changed * np.where(holds, p / own, (1.0 - p) / (1.0 - own))
    if not shared or not changed.sum() > 0.0:
        return findings
    before, after = weight / weight.sum(), changed / changed.sum()

    def moved(probability: float, holds: np.ndarray) -> float:
        """Return a probability as it changes by the listed sets, which hold nearly all."""
        return float(np.clip(probability + after[holds].sum() - before[holds].sum(), 0.0, 1.0))

    causes = tuple(
        cause
        if cause.is_of_the_set
        else replace(
            cause,
            probability=moved(
                cause.probability, np.array([_holds(cause.name, row.members) for row in findings.rows], bool)
            ),
        )
        for cause in findings.causes
    )
    empty = np.array([not row.members and not row.unlisted for row in findings.rows], bool)
    states = frozenset().union(*(row.unlisted for row in findings.rows))
    likely = [after[np.array([state in row.unlisted for row in findings.rows])].sum() for state in states]
    return replace(
        findings, causes=causes, nothing=moved(findings.nothing, empty), calm=not any(p >= LIKELIER for p in likely)
    )


def _holds(name: str, members: frozenset[str]) -> bool:
    """Whether a set holds an effect, or any member of a family."""
    known = library()
    return name in members or any(one in known and known[one].family.value == name for one in members)


def _named(found: Sequence[EvidenceFindings]) -> list[_Named]:
    """Return what is named: of a camera for each side, of what both sides share once, likeliest first."""
    shared = _shared(found)
    named = [
        _Named(tuple(f.side for f, _ in members), tuple(cause for _, cause in members), p)
        for p, members in shared.values()
        if p >= NAMED
    ]
    for findings in found:
        own = [c for c in findings.causes if c.probability >= NAMED and c.name not in shared]
        effects = {c.name for c in own if not c.members}
        # a family stands for what else of it acts than the effects that are named
        stands = [c for c in own if not effects & {name for name, _ in c.members}]
        named += [_Named((findings.side,), (c,), c.probability) for c in stands]
    return sorted(named, key=lambda one: -one.probability)


def joint_probability(name: str, found: Sequence[EvidenceFindings], causes: Sequence[Cause]) -> float:
    """Return the posterior probability of a hypothesis that all sides share."""
    told = [f.inclusion[name] for f in found if name in f.inclusion]
    priors = [prior for prior, _ in told]
    log_prior = float(np.mean(special.logit(priors)))
    factors = [_logit(p) - float(special.logit(prior)) for prior, p in told]
    odds = log_prior + sum(factors) + _log_agreement(causes)
    return float(special.expit(np.clip(odds, -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS)))


def _logit(probability: float) -> float:
    return float(np.clip(special.logit(min(max(probability, 1e-15), 1.0)), -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS))


def _log_agreement(causes: Sequence[Cause]) -> float:
    """Return ln c of two sides that have the same law; 0 of one, or of different laws of a family."""
    if len(causes) < 2 or causes[0].kind is not causes[1].kind:
        return 0.0
    one, other = causes[0], causes[1]
    used = np.flatnonzero((np.diag(one.covariance) > 0.0) & (np.diag(other.covariance) > 0.0))
    if not len(used):
        return 0.0
    coordinates = [one.coordinates[k] for k in used]
    first, second = (cause.covariance[np.ix_(used, used)] for cause in (one, other))
    apart, spread = (one.mean - other.mean)[used], first + second
    log_normal = -0.5 * float(apart @ np.linalg.solve(spread, apart)) - 0.5 * float(
        np.linalg.slogdet(2.0 * np.pi * spread)[1]
    )
    mean, covariance = joint_moments(one.mean[used], first, other.mean[used], second)
    draws = np.random.default_rng(0).multivariate_normal(mean, covariance, AGREEMENT_DRAWS, check_valid="ignore")
    log_prior = sum(
        (c.log_prior(np.clip(draws[:, k], c.lower, c.upper)) for k, c in enumerate(coordinates)),
        np.zeros(AGREEMENT_DRAWS),
    )
    return log_normal + float(special.logsumexp(-log_prior)) - float(np.log(AGREEMENT_DRAWS))


def joint_moments(
    mean: FloatArray, covariance: FloatArray, other_mean: FloatArray, other_covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of the normalised product of two normal distributions."""
    gain = np.linalg.solve(covariance + other_covariance, covariance).T
    joint = covariance - gain @ covariance
    return mean + gain @ (other_mean - mean), 0.5 * (joint + joint.T)


def _entry(one: _Named, found: Sequence[EvidenceFindings]) -> NamedEffect:
    """Return a named cause as the result lists it."""
    first = max(one.causes, key=lambda cause: cause.probability)
    kind = first.kind
    alike = [cause for cause in one.causes if cause.kind is kind]
    gain_is_known = all(f.gain_is_known for f in found if f.side in one.sides)
    parameters = {}
    for number, size in enumerate(first.sizes):
        quantity = kind.quantities()[size.parameter]
        sizes = [cause.sizes[number] for cause in alike]
        value, std = pooled([(s.mean, s.std) for s in sizes], is_shared=first.is_of_the_set)
        told, unit = told_as(size.parameter, quantity, gain_is_known=gain_is_known)
        parameters[told] = ParameterValue(
            value=value,
            std=std,
            unit=unit,
            sign_known=all(size.parameter not in cause.unsigned for cause in alike),
            interval=size.interval if len(alike) == 1 else (value - 1.96 * (std or 0.0), value + 1.96 * (std or 0.0)),
            is_determined=any(s.is_determined for s in sizes),
        )
    choices = choices_of(first.effect, first.alike)
    combined = tuple(
        c for side, cause in zip(one.sides, one.causes, strict=True) for c in _combined(side, cause, found)
    )
    shown_in = tuple(dict.fromkeys(name for cause in one.causes for name in cause.shown_in))
    rest = (1.0 - one.probability) / max(1.0 - first.probability, 1e-15)
    rivals = [(name, p * min(rest, 1.0)) for name, p in first.rivals]
    is_exact = all(cause.inexact <= LIKELIER for cause in one.causes)
    members = tuple(Member(name=n, probability=p) for n, p in first.members)
    modes = first.modes if len(alike) == 1 else ()
    return NamedEffect(
        name=first.name,
        family=kind.family.value,
        law="exact" if is_exact else "inexact",
        members=members,
        probability=one.probability,
        sides=one.sides,
        parameters=parameters,
        combinations=combined,
        choices=choices,
        modes=modes,
        shown_in=shown_in,
        rivals=tuple(Rival(name=n, probability=p) for n, p in rivals if p >= LEAST_LISTED),
        statement=_statement(one, first, parameters, combined, choices, shown_in, members, modes, is_exact),
        reference=kind.reference,
    )


def _statement(
    one: _Named,
    first: Cause,
    parameters: dict[str, ParameterValue],
    combined: Sequence[Combination],
    choices: dict[str, str],
    shown_in: Sequence[str],
    members: Sequence[Member],
    modes: Sequence[Mapping[str, float]],
    is_exact: bool,
) -> str:
    """Return a named cause as a sentence: what physics was left out, how that shows, and its size."""
    kind = first.kind
    sizes = [*(_size(field, p) for field, p in parameters.items()), *map(combination_in_words, combined)]
    sizes += [f"{field} {value}".replace("_", " ") for field, value in choices.items()]
    values = ", ".join(sizes)
    if any(not p.sign_known for p in parameters.values()):
        values += "; sign unknown"
    for mode in modes:
        told = ", ".join(f"{plain_name(f, parameters[f].unit)} {v:.3g}" for f, v in mode.items() if f in parameters)
        values += f"; {told} fits as well" if told else ""
    shown = sorted({measurement_title(name) for name in shown_in})
    seen = f"Seen in {' and '.join(shown)} of the {' and '.join(one.sides)} camera"
    if members:
        return family_statement(kind.family, members, is_exact, seen, values, ())
    return f"{kind.sentence} {seen}: {values}."


def _combined(side: Side, cause: Cause, found: Sequence[EvidenceFindings]) -> tuple[Combination, ...]:
    """Return what the recordings of a side determine of a cause's sizes, where they can't tell these apart."""
    declared = cause.kind.quantities()
    sizes = [k for k, s in enumerate(cause.sizes) if s.parameter not in cause.kind.shapes and _is_size(declared, s)]
    parameters = [(cause.sizes[k].parameter, declared[cause.sizes[k].parameter]) for k in sizes]
    gain_is_known = all(f.gain_is_known for f in found if f.side == side)
    return combinations(
        side, parameters, cause.mean[sizes], cause.covariance[np.ix_(sizes, sizes)], gain_is_known=gain_is_known
    )


def _is_size(declared: Mapping[str, Quantity], size: Size) -> bool:
    return declared[size.parameter].absent is not None


def _size(field: str, value: ParameterValue) -> str:
    text = f"{plain_name(field, value.unit)} {format_value(value.value, value.std, value.unit, value.shown_interval)}"
    return text if value.is_determined else f"{text}, not determined"


# --- the verdict ------------------------------------------------------------------------------------------------------


def _verdict(found: Sequence[EvidenceFindings], named: Sequence[_Named]) -> DiagnosisVerdict:
    """Return the verdict on all sides: `explained` where names stand, every side is explained or has no mismatch, and
    no statement about it is wrong."""
    judged = [f for f in found if f.is_judged]
    if not judged:
        return "nothing_judged"
    metadata = any(f.metadata for f in found)
    whole = all(_is_whole(f, named) for f in judged)
    if named:
        return "explained" if whole and not metadata else "partly_explained"
    return "no_mismatch" if whole and not metadata else "unexplained"


def _is_whole(findings: EvidenceFindings, named: Sequence[_Named]) -> bool:
    """Return whether a side has no mismatch; or its names hold, nothing unlisted is likelier than not, and the check
    passed. No name stands for boards whose corners depart."""
    if findings.boards_depart:
        return False
    if findings.nothing > findings.least_nothing and findings.check_passed:
        return True
    here = any(findings.side in one.sides for one in named)
    return here and findings.calm and findings.check_passed


def _held_out(found: Sequence[EvidenceFindings]) -> HeldOut | None:
    parts = [f.held_out for f in found if f.held_out is not None]
    if not parts:
        return None
    return HeldOut(
        captures=tuple(capture for part in parts for capture in part.captures),
        chi2_before=sum(part.chi2_before for part in parts),
        chi2_after=sum(part.chi2_after for part in parts),
        n=sum(part.n for part in parts),
    )


# --- sentences --------------------------------------------------------------------------------------------------------


def _summary(
    verdict: DiagnosisVerdict,
    lists: DiagnosisLists,
    effects: Sequence[NamedEffect],
    held_out: HeldOut | None,
    found: Sequence[EvidenceFindings],
) -> Iterator[str]:
    """Yield the result in sentences."""
    if verdict == "nothing_judged":
        yield "These recordings determine no measurement, so nothing is reported about the camera."
    for one in found:
        if one.is_judged and one.nothing > one.least_nothing and one.check_passed:
            yield (
                f"The baseline explains the recordings of the {one.side} camera: the posterior probability that no "
                f"effect and nothing unlisted acts is {one.nothing:.3f}; {100 * FALSE_ALARM_RATE:.0f} % of cameras "
                f"without any fall below {one.least_nothing:.3f}."
            )
    for m in lists.mismatches:
        yield (
            f"{measurement_title(m.measurement)} of the {m.side} camera departs from the baseline: {m.where} "
            f"({m.significance_sigma:.1f} sigma)."
        )
    yield from (effect.statement for effect in effects)
    for state in lists.unlisted:
        if state.probability >= LIKELIER:
            places = " and ".join(measurement_title(name) for name in state.measurements)
            yield (
                f"Unlisted physics acts on the {state.state} of the {state.side} camera, with probability "
                f"{state.probability:.3f}; it shows in {places}."
            )
    yield from (law.statement for law in lists.discovered)
    for item in lists.unexplained:
        place = f"{measurement_title(item.measurement)} of the {item.side} camera, {item.where}"
        yield f"Not explained: {place}: {item.shape}."
    yield from dict.fromkeys(item.check for item in lists.unexplained if item.check)
    named = {(side, effect.name) for effect in effects for side in effect.sides}
    for models in lists.models:
        if models.sets and models.sets[0].probability < NAMED:
            sets = ", ".join(
                f"{_words(s.effects, s.unlisted)} ({100 * s.probability:.0f} %)" for s in models.sets[:LISTED]
            )
            yield f"The likeliest sets of effects for the {models.side} camera: {sets}."
        open_ = [i for i in models.inclusion if i.probability >= LIKELIER and (models.side, i.name) not in named]
        if open_:
            names = ", ".join(f"{effect_title(i.name)} ({i.probability:.2f})" for i in open_)
            yield f"More likely than not for the {models.side} camera, below the threshold of a name: {names}."
        if models.never_refitted is not None and any(f.is_undecided for f in found if f.side == models.side):
            yield (
                f"Undecided for the {models.side} camera: sets that hold {100 * models.never_refitted:.1f} % of the "
                f"probability were not refitted within the budget of {REFITS} refits."
            )
    if held_out is not None:
        chance = float(special.chdtrc(max(held_out.n, 1), held_out.chi2_after))
        agrees = all(f.check_passed for f in found if f.is_judged)
        yield (
            f"Held-out captures {'agree with' if agrees else 'contradict'} the prediction: chi2 "
            f"{held_out.chi2_after:.0f} for {held_out.n} numbers (p = {chance:.2g}), {held_out.chi2_before:.0f} by the "
            "baseline."
        )


def _words(effects: Sequence[str], unlisted: Sequence[str]) -> str:
    parts = [effect_title(name) for name in effects] + [f"unlisted: {state}" for state in unlisted]
    return " with ".join(parts) if parts else "none"
