"""The findings of all sides as one result: verdict, named effects, held-out chi2, and sentences."""

from __future__ import annotations

from collections.abc import Sequence

from scipy import special

from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.outcome.detectability import told_as
from lab.diagnose.outcome.determined import is_determined
from lab.diagnose.outcome.goodness_of_fit import set_sentences
from lab.diagnose.outcome.named_in_words import (
    LEAST_CAPTURES,
    choices_of,
    combination_in_words,
    family_statement,
    plain_name,
    pooled,
)
from lab.diagnose.outcome.next_capture import next_sentence
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.side import NamedCandidate, SideFindings
from lab.formats.results import (
    DiagnosisLists,
    DiagnosisResult,
    DiagnosisVerdict,
    HeldOut,
    Member,
    NamedEffect,
    ParameterValue,
    Rival,
)
from lab.formats.results.words import format_value
from lab.observables.observable import measurement_title
from sim.camera import Side
from sim.effects.library import effects as library


def merged(
    source: str, found: Sequence[SideFindings], policy: DecisionPolicy, warnings: Sequence[str] = ()
) -> DiagnosisResult:
    """One result of all sides. An effect that several sides show is one entry, with its weighted mean parameters.
    `warnings`: of the fit, which the summary repeats."""
    lists = DiagnosisLists.joined([f.lists for f in found])
    effects = tuple(_named(found, policy))
    verdict: DiagnosisVerdict = "unexplained"
    if not any(f.is_judged for f in found):
        verdict = "nothing_judged"
    elif not effects and not lists.unexplained and not lists.mismatches and not lists.discovered:
        verdict = "no_mismatch"
    elif effects:
        is_inexact = any(e.members and e.law == "inexact" for e in effects)
        is_whole = not lists.unexplained and not lists.discovered and not is_inexact
        verdict = "explained" if is_whole else "partly_explained"
    held_out = _held_out(found)
    offered = tuple(capture for f in found if f.doubt is not None for capture in f.doubt.listed(policy))
    return DiagnosisResult(
        **dict(lists),
        source=source,
        verdict=verdict,
        effects=effects,
        held_out=held_out,
        next_capture=LEAST_CAPTURES
        if verdict == "nothing_judged"
        else next_sentence(offered, " ".join(f.settling for f in found if f.settling) or None, policy),
        next_captures=offered,
        threshold=max((f.threshold for f in found if f.threshold is not None), default=None),
        false_alarm_rate=policy.false_alarm_rate if any(f.is_judged for f in found) else None,
        summary=(*_summary(verdict, lists, effects, held_out, policy), *(f"Warning: {line}." for line in warnings)),
        warnings=tuple(warnings),
        policy=policy.told(),
    )


def _named(found: Sequence[SideFindings], policy: DecisionPolicy) -> list[NamedEffect]:
    """Return the named effects of all sides, one item a name."""
    by_name: dict[str, list[tuple[Side, NamedCandidate]]] = {}
    with_gain = {findings.side for findings in found if findings.gain_is_known}
    for findings in found:
        for one in findings.named:
            by_name.setdefault(one.candidate.told_name, []).append((findings.side, one))
    named = []
    for name, members in by_name.items():
        held = _members([one.candidate for _, one in members])
        # of sides whose nearest laws differ, the parameters are those of the likelier one
        kind = library()[held[0].name if held else name]
        alike = [one.candidate for _, one in members if one.candidate.effect.name == kind.name]
        in_electrons = [one.candidate for side, one in members if side in with_gain and one.candidate in alike]
        alike = in_electrons or alike
        candidates = alike or [max((one.candidate for _, one in members), key=lambda c: c.log_odds)]
        kind = type(candidates[0].effect)
        rivals: dict[str, float] = {}
        for _, one in members:
            for rival, probability in one.candidate.rivals:
                if probability >= policy.least_rival_probability:
                    rivals[rival] = max(rivals.get(rival, 0.0), probability)
        parameters = {}
        for field, quantity in kind.quantities().items():
            if quantity.dispensable and all(c.std.get(field) is None for c in candidates):
                continue
            values_of_sides = [(float(getattr(c.effect, field)), c.std.get(field)) for c in candidates]
            value, std = pooled(values_of_sides, is_shared="light" in kind.stages())
            told, unit = told_as(field, quantity, gain_is_known=bool(in_electrons))
            is_signed = all(field not in c.unsigned for c in candidates)
            interval = _interval(field, candidates)
            is_size = quantity.absent is not None and field not in kind.shapes
            parameters[told] = ParameterValue(
                value=value,
                std=None if interval else std,
                unit=unit,
                sign_known=is_signed,
                interval=interval,
                is_determined=not is_size or is_determined(value, quantity.absent or 0.0, std, interval),
            )
        chosen = [choices_of(c.effect, c.alike) for c in candidates]
        choices = {
            field: " and ".join(dict.fromkeys(one[field] for one in chosen if field in one)) for field in chosen[0]
        }
        combined = tuple(c for _, one in members if one.candidate in candidates for c in one.combinations)
        shown_in = tuple(dict.fromkeys(measurement for _, one in members for measurement in one.shown_in))
        shown = sorted({measurement_title(measurement) for measurement in shown_in})
        values = ", ".join(
            (
                *(_size(f, p) for f, p in parameters.items()),
                *(combination_in_words(c) for c in combined),
                *(f"{f} {value}".replace("_", " ") for f, value in choices.items()),
            )
        )
        if any(not p.sign_known for p in parameters.values()):
            values += "; sign unknown"
        modes = candidates[0].modes if len(candidates) == 1 else ()
        for mode in modes:
            told = ", ".join(f"{plain_name(f, parameters[f].unit)} {v:.3g}" for f, v in mode.items())
            values += f"; {told} fits as well"
        sides = tuple(side for side, _ in members)
        is_exact = all(one.candidate.is_closed for _, one in members)
        corrections = tuple(dict.fromkeys(c for _, one in members for c in one.corrections))
        seen = f"Seen in {' and '.join(shown)} of the {' and '.join(sides)} camera"
        if held:
            statement = family_statement(kind.family, held, is_exact, seen, values, corrections)
        else:
            statement = f"{kind.sentence} {seen}: {values}."
        named.append(
            NamedEffect(
                name=name,
                family=kind.family.value,
                law="exact" if is_exact else "inexact",
                members=held,
                probability=min(one.candidate.probability for _, one in members),
                sides=sides,
                parameters=parameters,
                combinations=combined,
                choices=choices,
                modes=modes,
                shown_in=shown_in,
                rivals=tuple(Rival(name=n, probability=p) for n, p in sorted(rivals.items(), key=lambda r: -r[1])),
                statement=statement,
                reference=kind.reference,
                corrections=corrections,
            )
        )
    return named


def _members(candidates: Sequence[Candidate]) -> tuple[Member, ...]:
    """Return the effects of a named family over all sides, by their mean probability, likeliest first."""
    total: dict[str, float] = {}
    for candidate in candidates:
        for name, probability in candidate.members:
            total[name] = total.get(name, 0.0) + probability / len(candidates)
    return tuple(Member(name=n, probability=p) for n, p in sorted(total.items(), key=lambda item: -item[1]))


def _size(field: str, value: ParameterValue) -> str:
    """Return a parameter in words, with what its interval tells."""
    text = f"{plain_name(field, value.unit)} {format_value(value.value, value.std, value.unit, value.interval)}"
    return text if value.is_determined else f"{text}, not determined"


def _interval(field: str, candidates: Sequence[Candidate]) -> tuple[float, float] | None:
    """Return the interval of a parameter that at least one side tells by an interval: it holds those of all sides."""
    if all(field not in c.intervals for c in candidates):
        return None
    ends = list[tuple[float, float]]()
    for c in candidates:
        value, std = float(getattr(c.effect, field)), c.std.get(field)
        ends.append(c.intervals.get(field) or (value - 2.0 * (std or 0.0), value + 2.0 * (std or 0.0)))
    return min(low for low, _ in ends), max(high for _, high in ends)


def _held_out(found: Sequence[SideFindings]) -> HeldOut | None:
    """Sum over the sides on which something was found; over all, where nothing was."""
    told = [f for f in found if f.named or f.lists.unexplained or f.lists.discovered]
    parts = [f.held_out for f in told or found if f.held_out is not None]
    if not parts:
        return None
    return HeldOut(
        captures=tuple(capture for part in parts for capture in part.captures),
        chi2_before=sum(part.chi2_before for part in parts),
        chi2_after=sum(part.chi2_after for part in parts),
        chi2_discovered=None
        if all(part.chi2_discovered is None for part in parts)
        else sum(part.chi2_after if part.chi2_discovered is None else part.chi2_discovered for part in parts),
        n=sum(part.n for part in parts),
    )


def _agreement(held_out: HeldOut, policy: DecisionPolicy) -> str:
    """Say whether held-out captures agree with the model, for the end of a sentence: by the probability that chi2 is as
    large where they do.
    """
    chance = float(special.chdtrc(max(held_out.n, 1), held_out.chi2_after))
    numbers = f"chi2 {held_out.chi2_after:.0f} of {held_out.n} numbers, p = {chance:.2g}"
    if chance < policy.false_alarm_rate:
        return f", but held-out captures do not agree with it ({numbers})"
    return f", and held-out captures agree ({numbers})"


def _summary(
    verdict: DiagnosisVerdict,
    lists: DiagnosisLists,
    effects: Sequence[NamedEffect],
    held_out: HeldOut | None,
    policy: DecisionPolicy,
) -> list[str]:
    """Return the diagnosis in sentences."""
    lines = []
    if verdict == "nothing_judged":
        lines.append("These recordings determine no measurement, so nothing is said about the camera.")
    if verdict == "no_mismatch":
        agree = "; no captures are held out" if held_out is None else _agreement(held_out, policy)
        lines.append(
            "The baseline explains everything that could be judged, at a false-alarm rate of "
            f"{100 * policy.false_alarm_rate:.0f} %{agree}."
        )
    lines += [
        f"{measurement_title(m.measurement)} of the {m.side} camera departs from the baseline: {m.where} "
        f"({m.significance_sigma:.1f} sigma)."
        for m in lists.mismatches
    ]
    lines += [e.statement for e in effects]
    lines += [
        f"Not explained: {measurement_title(u.measurement)} of the {u.side} camera, {u.where}: {u.shape}."
        f"{' ' if u.would_help else ''}{u.would_help}"
        for u in lists.unexplained
    ]
    lines += [d.statement for d in lists.discovered]
    lines += dict.fromkeys(u.check for u in lists.unexplained if u.check)
    lines += [v.statement for v in lists.vetoed]
    lines += set_sentences(lists.models, effects, lists.unexplained, policy)
    if held_out is not None and held_out.chi2_after != held_out.chi2_before:
        before, after = f"{held_out.chi2_before:.0f}", f"{held_out.chi2_after:.0f}"
        way = "falls" if held_out.chi2_after < held_out.chi2_before else "rises"
        change = f"stays at {after}" if before == after else f"{way} from {before} to {after}"
        lines.append(f"On captures that neither choice nor fit has seen, chi2 {change} for {held_out.n} numbers.")
    return lines
