"""The blind proof: effects of the library, two at once, and what no list names, concealed in sealed cases."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.case_run import CaseRun
from evaluation.experiment import PagePicture, ScoredExperiment
from evaluation.plots import ABSTAINED, RIGHT, WRONG, Axis, Cell, Panel, matrix_plot, power_plot
from evaluation.score import STRONG, BlindScore, CaseScore, Rate, rate_words, score
from evaluation.sealed import SealedExperiment, about
from evaluation.truth import Seals, Truths
from lab.effect_titles import effect_title

#: Borders of the classes of separability; values beyond them count in the first and the last class.
BORDERS = (1.0, 5.0, 10.0, 15.0, 25.0, 50.0, 100.0, 300.0, 2000.0)
SEPARABILITY = Axis(BORDERS[0], BORDERS[-1], (1, 5, 10, 25, 50, 100, 300, 2000), 50, is_logarithmic=True)
#: Verdicts and ends without a name.
UNNAMED = ("unexplained", "no_mismatch", "failed")


@dataclass(frozen=True)
class BlindProof(SealedExperiment[BlindScore]):
    """Cases of listed effects, scored by the names that they get."""

    def scored(
        self, truths: Truths, seals: Seals, runs: dict[str, CaseRun], broken: Sequence[str]
    ) -> BlindScore:  # fmt: skip
        """Return all scores; cases with a broken seal are left out."""
        return score(truths, seals, runs, broken)

    def outcome(self, scores: BlindScore) -> ScoredExperiment:
        """Return tables, the confusion matrix, and power curves where the oracle was computed."""
        introduction, seed_row = about(scores)
        pictures = [PagePicture(f"-{scores.purpose}", "What was said of what was concealed", confusion(scores))]
        if any(s.oracle_share is not None for s in scores.case_scores):
            shows = "Right answers over separability, of the diagnosis and of the oracle"
            pictures.append(PagePicture(f"-{scores.purpose}-oracle", shows, power_curves(scores)))
        return ScoredExperiment(
            section=scores.purpose, text=table(scores), introduction=introduction, pictures=pictures,
            seed_row=seed_row, reached=scores.reached,
        )  # fmt: skip


def _share(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"


def table(found: BlindScore) -> str:
    """Return the scores as Markdown tables, with 95 % intervals (Clopper-Pearson)."""
    lines = ["| goal | wanted | reached | oracle | |", "| --- | --- | --- | --- | --- |"]
    lines += [
        f"| {goal.name} | {goal.wanted} | {goal.reached} | {_share(goal.oracle)} | {goal.verdict} |"
        for goal in found.goals
    ]
    lines += [
        "",
        "| single effects of non-centrality | first name right | it alone | nothing named |",
        "| --- | --- | --- | --- |",
    ]
    lines += [
        f"| {s.noncentrality} | {rate_words(s.top_1)} | {rate_words(s.alone)} | {rate_words(s.unnamed)} |"
        for s in found.singles
    ]
    if any(f.right.of for f in found.fair):
        lines += ["", "| separability | right | oracle | of the oracle |", "| --- | --- | --- | --- |"]
        lines += [
            f"| {f.kind}, {f.separability} | {rate_words(f.right)} | {_share(f.oracle)} | {_share(f.of_oracle)} |"
            for f in found.fair
        ]
    lines += ["", "| also | |", "| --- | --- |"]
    for what, rate in (
        ("concealed effects above 25, every one named as such", found.families.right_effects),
        ("compounds, one member named at least", found.compounds_one_named),
        ("compounds with both members above 50, both named", found.compounds_strong_both_named),
        ("healthy, a mismatch where there is none", found.false_alarms),
        ("outside the library above 25, the mismatch is seen", found.outside_located),
    ):
        lines.append(f"| {what} | {rate_words(rate)} |")
    for what, share in (
        ("held-out excess chi2 removed, median", found.excess_removed_median),
        ("the same outside the library, median", found.outside_excess_removed_median),
    ):
        if share is not None:
            lines.append(f"| {what} | {100 * share:.1f} % |")
    if found.cpu_median_s is not None and found.memory_max_mib is not None:
        lines.append(
            f"| CPU time of a case, median; memory, largest | {found.cpu_median_s:.1f} s; {found.memory_max_mib:.0f} "
            "MiB |"
        )
    lines += ["", "| concealed alone | right | right above 50 | else |", "| --- | --- | --- | --- |"]
    for e in found.effects:
        instead = ", ".join(f"{name} {n}" for name, n in e.instead.items()) or "-"
        lines.append(
            f"| {e.effect} | {e.top_1.count} of {e.top_1.of} | {e.strong_top_1.count} of {e.strong_top_1.of} | "
            f"{instead} |"
        )
    lines += ["", "| outside the library, named | as |", "| --- | --- |"]
    wrong = [s for s in found.case_scores if s.kind == "outside" and not s.right]
    lines += [f"| {s.fault or s.truth[0]} ({s.case}) | {', '.join(s.named) or s.verdict} |" for s in wrong] or [
        "| none | |"
    ]
    lines += [f"\n{case} failed: {error}" for case, error in found.failed.items()]
    return "\n".join(lines)


def power_curves(scores: BlindScore) -> str:
    """Return single effects and compounds as SVG: for each class of separability, at its geometric mean, the share of
    right diagnoses with its 95 % interval, and the mean share of the oracle on the same cases."""
    panels = []
    for kind, title in (("single", "one effect: named first"), ("compound", "two effects: both named")):
        classes = _by_class([s for s in scores.case_scores if s.kind == kind and s.separability is not None])
        points, oracle = [], []
        for cases in classes:
            strength = float(np.exp(np.mean([np.log(max(s.separability or 0.0, BORDERS[0])) for s in cases])))
            rate = Rate.over(s.right for s in cases)
            points.append((strength, rate.share or 0.0, rate.low or 0.0, rate.high or 0.0, rate.of))
            if shares := [s.oracle_share for s in cases if s.oracle_share is not None]:
                oracle.append((strength, float(np.mean(shares))))
        panels.append(Panel(title, points, oracle))
    return power_plot(SEPARABILITY, "separability", panels)


def _by_class(cases: Sequence[CaseScore]) -> list[list[CaseScore]]:
    """Return cases by classes of separability, without empty ones."""
    at = np.clip(np.searchsorted(BORDERS, [s.separability or 0.0 for s in cases], side="right"), 1, len(BORDERS) - 1)
    held = [[s for s, k in zip(cases, at, strict=True) if k == wanted] for wanted in range(1, len(BORDERS))]
    return [group for group in held if group]


def confusion(scores: BlindScore) -> str:
    """Return the confusion matrix as SVG: numbers of cases by what was concealed (rows: single effects of
    non-centrality above 50, healthy, outside the library) and by the first name or the verdict (columns)."""
    shown = [
        s
        for s in scores.case_scores
        if s.kind in {"healthy", "outside"} or (s.kind == "single" and s.noncentrality[0] > STRONG)
    ]
    count = Counter((_row(s), s.named[0] if s.named else s.verdict) for s in shown)
    right = {(_row(s), s.named[0] if s.named else s.verdict) for s in shown if s.right}
    answers = {answer for _, answer in count}
    columns = [*sorted(answers - set(UNNAMED)), *(one for one in UNNAMED if one in answers)]
    rows = sorted({row for row, _ in count}, key=lambda row: (row.startswith("("), row))
    cells = {at: Cell(n, RIGHT if at in right else ABSTAINED if at[1] in UNNAMED else WRONG) for at, n in count.items()}
    titles = {name: effect_title(name) for name in (*rows, *columns)}
    legend = {"right": RIGHT, "nothing named": ABSTAINED, "a wrong name": WRONG}
    return matrix_plot(rows, columns, cells, titles, legend)


def _row(case: CaseScore) -> str:
    if case.kind == "single":
        return case.truth[0]
    return "(healthy)" if case.kind == "healthy" else "(outside the library)"
