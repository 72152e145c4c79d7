"""The proof of discovery: of laws that no list has, concealed in sealed cases, are axis and stage reported?

A law is told where a discovered law of the result (`DiscoveredLaw`) goes along the index that the simulator declares,
or along all of a product's. Its stage is right where it is the declared one, or one from which recordings can't tell
it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Literal

import numpy as np

from evaluation.case_run import CaseRun
from evaluation.experiment import PagePicture, ScoredExperiment
from evaluation.independent_simulator import UNLISTED, UnlistedLaw
from evaluation.plots import ABSTAINED, RIGHT, WRONG, Axis, Mark, Row, row_plot
from evaluation.score import (
    CLASSES,
    EXCESS_SIGMAS,
    STRONG,
    Goal,
    Rate,
    SealedScore,
    at_least,
    at_most,
    goals_of_run,
    rate_words,
    seals_sha256,
)
from evaluation.sealed import SealedExperiment, about
from evaluation.truth import CaseTruth, Seals, Truths
from lab.effect_titles import effect_title
from lab.formats.results import DiagnosisResult, DiscoveredLaw
from sim.effects.library import effects as library
from sim.parameters import Frozen

#: Between the indices of a product.
BETWEEN = re.compile(r" and | x ")
#: How a case ends, the best first, with its colour.
Ending = Literal["right", "axis only", "nothing told", "another law told", "listed name"]
COLOURS: dict[Ending, str] = {
    "right": RIGHT,
    "axis only": "#c98a1b",
    "nothing told": ABSTAINED,
    "another law told": "#8a4fb0",
    "listed name": WRONG,
}
SEPARABILITY = Axis(3.0, 2000.0, (5, 10, 25, 50, 100, 300, 1000), STRONG, is_logarithmic=True)


class UnlistedCase(Frozen):
    """One case: what is concealed, and what the diagnosis says of it.

    `law`: None of a healthy camera. `beside`: the listed effect that stands beside it. `shown`: the non-centrality of
    the law in the diagnosis's own summaries. `told`: the discovered laws in words. `period_right`: of a rightly told
    axis, where the law has periods. `wrong_names`: names of effects and families that nothing concealed gives.
    `excess_removed`: as of `removed`."""

    case: str
    law: str | None
    beside: str | None
    separability: float | None
    shown: float | None
    verdict: str
    told: tuple[str, ...]
    axis_right: bool
    right: bool
    period_right: bool | None
    beside_named: bool | None
    wrong_names: tuple[str, ...]
    excess_removed: float | None
    cpu_s: float

    @property
    def outcome(self) -> Ending:
        """A wrong name is the worst, whatever stands beside it."""
        if self.wrong_names:
            return "listed name"
        if self.right:
            return "right"
        if self.axis_right:
            return "axis only"
        return "another law told" if self.told else "nothing told"


class LawScore(Frozen):
    """All cases of one law; rates over those of a separability above 50, but for `cases`."""

    law: str
    stage: str
    axes: str
    cases: int
    axis_right: Rate
    right: Rate
    unnamed: Rate  # without a wrong listed name, of all cases
    excess_removed: float | None
    instead: dict[str, int]  # outcomes of what isn't right, of all cases


class SeparabilityScore(Frozen):
    """Cases with a law of one class of separability."""

    separability: str
    axis_right: Rate
    right: Rate


class UnlistedScore(SealedScore):
    """All scores of a proof of discovery."""

    format: Literal["calibench-unlisted-score"] = "calibench-unlisted-score"
    version: Literal[1] = 1
    classes: tuple[SeparabilityScore, ...]
    laws: tuple[LawScore, ...]
    periods: Rate
    beside_named: Rate
    excess_removed: float | None
    cpu_median_s: float | None
    case_scores: tuple[UnlistedCase, ...]


@dataclass(frozen=True)
class UnlistedProof(SealedExperiment[UnlistedScore]):
    """Cases of laws that no list has, scored by the axis and the stage that are reported."""

    def scored(
        self, truths: Truths, seals: Seals, runs: dict[str, CaseRun], broken: Sequence[str]
    ) -> UnlistedScore:  # fmt: skip
        """Return all scores; cases with a broken seal are left out."""
        return score(truths, seals, runs, broken)

    def outcome(self, scores: UnlistedScore) -> ScoredExperiment:
        """Return tables and a picture of all cases."""
        introduction, seed_row = about(scores)
        picture = PagePicture(f"-{scores.purpose}", "What was told of each law, over its separability", drawing(scores))
        return ScoredExperiment(
            section=scores.purpose, text=table(scores), introduction=introduction, title="Proof of discovery",
            pictures=[picture], seed_row=seed_row, reached=scores.reached,
        )  # fmt: skip


# --- one law, one case ------------------------------------------------------------------------------------------------


def axes_of(along: str) -> frozenset[str]:
    """Return the indices of a discovered law. A table by row and column is one by place."""
    said = frozenset(BETWEEN.split(along))
    return said | {"place"} if said >= {"row", "column"} else said


def axis_is_right(law: type[UnlistedLaw], told: DiscoveredLaw) -> bool:
    """Return whether a discovered law goes along all axes of a law, and no other but those that may stand beside them,
    and is one of means or one of noise as that is."""
    said = axes_of(told.along)
    right = frozenset(word for alike in law.axes for word in alike)
    if "place" in said:
        said = said - ({"row", "column"} if "place" in right else {"place"})
    same = (told.of != "mean") == (law.acts in {"variance", "covariance"})
    return same and all(said & set(alike) for alike in law.axes) and said <= right | law.beside


def stage_is_right(law: type[UnlistedLaw], told: DiscoveredLaw) -> bool:
    """Return whether a discovered law acts at a law's stage, or at one from which recordings can't tell it."""
    return told.stage == law.stage or told.stage in law.alike


def period_is_right(law: type[UnlistedLaw], told: DiscoveredLaw) -> bool:
    """Return whether the shortest table of a discovered law repeats with a period of the law."""
    return told.shown_period in law.periods or told.columns in law.periods


def removed(found: DiagnosisResult | None, told: Sequence[DiscoveredLaw], strong: bool) -> float | None:
    """Share of the held-out excess chi2 that the improved model removes, (before - after) / (before - n), limited to
    -1..1.

    chi2 is that of all held-out numbers where they have an excess of 3 standard deviations, else that of the rightly
    `told` laws' own numbers, the means of their classes. 0 where neither has one and the law is `strong`: what is there
    wasn't found. Else None."""
    pairs = []
    if found is not None and found.held_out is not None:
        held = found.held_out
        after = held.chi2_after if held.chi2_discovered is None else held.chi2_discovered
        pairs.append((held.chi2_before, after, held.n))
    own = [(t.own_chi2_before, t.own_chi2_after, t.own_n) for t in told]
    kept = [(a, b, n) for a, b, n in own if a is not None and b is not None and n is not None]
    pairs.append((sum(a for a, _, _ in kept), sum(b for _, b, _ in kept), sum(n for _, _, n in kept)))
    for before, after, n in pairs:
        if n and before - n > EXCESS_SIGMAS * (2.0 * n) ** 0.5:
            return max(-1.0, min(1.0, (before - after) / (before - n)))
    return 0.0 if strong else None


def case_score(case: str, truth: CaseTruth, run: CaseRun) -> UnlistedCase:
    """Return the score of one case."""
    found = run.diagnosis
    discovered = found.discovered if found is not None else ()
    kinds = {law.name: law for law in UNLISTED}
    hidden = next((c for c in truth.concealed if c.effect is None), None)
    law = kinds[hidden.name] if hidden is not None else None
    on_axis = [t for t in discovered if law is not None and axis_is_right(law, t)]
    rightly = [t for t in on_axis if law is not None and stage_is_right(law, t)]
    beside = next(iter(truth.names), None)
    families = {library()[name].family.value for name in (*truth.names, *truth.accepts)}
    families |= set(law.families) if law is not None else set()
    allowed = {*truth.names, *truth.accepts, *families}
    named = [e.name for e in found.effects] if found is not None else []
    strong = hidden is not None and (hidden.separability or 0.0) > STRONG
    return UnlistedCase(
        case=case,
        law=law.name if law is not None else None,
        beside=beside,
        separability=hidden.separability if hidden is not None else None,
        shown=hidden.noncentrality if hidden is not None else None,
        verdict=found.verdict if found is not None else "failed",
        told=tuple(_words(t) for t in discovered),
        axis_right=bool(on_axis),
        right=bool(rightly),
        period_right=any(period_is_right(law, t) for t in on_axis) if law and law.periods and on_axis else None,
        beside_named=None if beside is None else beside in named,
        wrong_names=tuple(name for name in named if name not in allowed),
        excess_removed=removed(found, rightly, strong) if law is not None else None,
        cpu_s=run.cpu_s,
    )


def _words(told: DiscoveredLaw) -> str:
    what = told.stage if told.of == "mean" else f"{told.of} of {told.stage}"
    return f"{what} by {told.along}" + f" mod {told.shown_period}" * bool(told.shown_period)


# --- sums -------------------------------------------------------------------------------------------------------------


def score(truths: Truths, seals: Seals, runs: dict[str, CaseRun], broken: Sequence[str] = ()) -> UnlistedScore:
    """All scores. Cases with a broken seal are left out; in cases that failed nothing is told."""
    cases = [case for case in sorted(runs) if case in truths.truths and case not in broken]
    scored = [case_score(case, truths.truths[case].truth, runs[case]) for case in cases]
    hidden = [s for s in scored if s.law is not None]
    healthy = [s for s in scored if s.law is None]
    strong = [s for s in hidden if (s.separability or 0.0) > STRONG]
    ran = [case for case in cases if runs[case].error is None]
    whole = _mean(strong)
    goals = (
        *goals_of_run(seals, broken, len(ran), len(cases)),
        at_least("axis and stage right above a separability of 50", Rate.over(s.right for s in strong), 0.90),
        Goal(
            name="held-out excess chi2 removed above 50, mean",
            wanted=">= 90 %",
            reached="no case" if whole is None else f"{100 * whole:.1f} %",
            met=None if whole is None else whole >= 0.9,
        ),
        at_least("no listed name for an unlisted law", Rate.over(not s.wrong_names for s in hidden), 0.95),
        at_most("healthy cameras with a discovery", Rate.over(bool(s.told) for s in healthy), 0.01),
    )
    return UnlistedScore(
        purpose=truths.purpose,
        seed=truths.seed,
        size=truths.size,
        cases=len(cases),
        seals_sha256=seals_sha256(seals),
        broken_seals=tuple(broken),
        failed={case: error for case in cases if (error := runs[case].error) is not None},
        classes=tuple(
            SeparabilityScore(
                separability=name,
                axis_right=Rate.over(s.axis_right for s in hidden if above < (s.separability or 0.0) <= most),
                right=Rate.over(s.right for s in hidden if above < (s.separability or 0.0) <= most),
            )
            for name, above, most in CLASSES
        ),
        laws=tuple(_law_score(law, [s for s in hidden if s.law == law.name]) for law in UNLISTED),
        periods=Rate.over(s.period_right for s in hidden if s.period_right is not None),
        beside_named=Rate.over(s.beside_named for s in hidden if s.beside_named is not None),
        excess_removed=whole,
        cpu_median_s=float(np.median([runs[case].cpu_s for case in ran])) if ran else None,
        goals=goals,
        case_scores=tuple(scored),
    )


def _mean(cases: Iterable[UnlistedCase]) -> float | None:
    shares = [s.excess_removed for s in cases if s.excess_removed is not None]
    return fmean(shares) if shares else None


def _law_score(law: type[UnlistedLaw], cases: Sequence[UnlistedCase]) -> LawScore:
    strong = [s for s in cases if (s.separability or 0.0) > STRONG]
    periods = (*law.periods, *[0] * len(law.axes))
    axes = " x ".join(axis + f" mod {p}" * bool(p) for (axis, *_), p in zip(law.axes, periods, strict=False))
    return LawScore(
        law=law.name,
        stage=law.stage,
        axes=axes,
        cases=len(cases),
        axis_right=Rate.over(s.axis_right for s in strong),
        right=Rate.over(s.right for s in strong),
        unnamed=Rate.over(not s.wrong_names for s in cases),
        excess_removed=_mean(strong),
        instead=dict(Counter(_instead(s) for s in cases if s.outcome != "right").most_common()),
    )


def _instead(case: UnlistedCase) -> str:
    if case.outcome == "listed name":
        return ", ".join(case.wrong_names)
    return ", ".join(case.told) if case.told else "nothing told"


# --- the page ---------------------------------------------------------------------------------------------------------


def table(found: UnlistedScore) -> str:
    """Return the scores as Markdown tables, with 95 % intervals (Clopper-Pearson)."""
    lines = ["| goal | wanted | reached | |", "| --- | --- | --- | --- |"]
    lines += [f"| {goal.name} | {goal.wanted} | {goal.reached} | {goal.verdict} |" for goal in found.goals]
    lines += ["", "| separability | axis right | axis and stage right |", "| --- | --- | --- |"]
    lines += [f"| {c.separability} | {rate_words(c.axis_right)} | {rate_words(c.right)} |" for c in found.classes]
    lines += ["", "| also | |", "| --- | --- |"]
    lines.append(f"| period right, where the axis is | {rate_words(found.periods)} |")
    lines.append(f"| listed effect beside a law named | {rate_words(found.beside_named)} |")
    if found.cpu_median_s is not None:
        lines.append(f"| CPU time of a diagnosis, median | {found.cpu_median_s:.1f} s |")
    lines += [
        "",
        "| law | stage | along | cases | axis right | axis and stage | excess removed | no wrong name | told instead |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for law in found.laws:
        share = "-" if law.excess_removed is None else f"{100 * law.excess_removed:.0f} %"
        instead = "; ".join(f"{what} ({n})" for what, n in law.instead.items()) or "-"
        lines.append(
            f"| {law.law} | {law.stage} | {law.axes} | {law.cases} | {rate_words(law.axis_right)} | "
            f"{rate_words(law.right)} | {share} | {rate_words(law.unnamed)} | {instead} |"
        )
    lines += [f"\n{case} failed: {error}" for case, error in found.failed.items()]
    return "\n".join(lines)


def drawing(scores: UnlistedScore) -> str:
    """Return a row for each law and one for the healthy cameras as SVG; each case a dot at its separability, coloured
    by how it ended; a ring where a listed effect stands beside the law."""
    rows = [
        Row(
            f"{effect_title(law.law)}: {law.stage}, {law.axes}",
            tuple(
                Mark(s.separability or 0.0, COLOURS[s.outcome], ringed=s.beside is not None)
                for s in scores.case_scores
                if s.law == law.law
            ),
        )
        for law in scores.laws
    ]
    healthy = Counter(s.outcome for s in scores.case_scores if s.law is None)
    rows.append(Row("healthy cameras", note=", ".join(f"{n} {end}" for end, n in healthy.most_common()) or "none"))
    title = "separability; a ring: beside a listed effect"
    return row_plot(title, SEPARABILITY, rows, tuple(COLOURS.items()))
