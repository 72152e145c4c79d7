"""The page on the live proof: a table of concealed and named effects, and a picture of their parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from html import escape
from pathlib import Path

from lab.challenge.live import FoundParameter, LiveRun, every_case, names_of
from lab.challenge.proof import ABSTAINED, RIGHT, WRONG, placed
from lab.effect_titles import effect_title
from sim.effects.library import effects as library

ROW_PX, LABEL_PX, PLOT_PX, HEAD_PX = 18, 400, 380, 40
#: Found over true, at the plot's ends.
LOW, HIGH = 0.0, 2.0
COLOURS = {"named": RIGHT, "healthy": RIGHT, "among rivals": ABSTAINED, "not named": ABSTAINED}


def write_page(runs: Mapping[str, LiveRun], page: Path) -> None:
    """Write the section into the page, and its picture beside the page."""
    text = page.read_text(encoding="utf-8") if page.is_file() else "# Proof\n"
    picture = page.with_name(f"{page.stem}-live.svg")
    section = f"{summary(runs)}\n\n{table(runs)}\n\n![Parameters found over concealed ones]({picture.name})"
    picture.write_text(drawing(runs), encoding="utf-8")
    page.write_text(placed(text, "live", section), encoding="utf-8")


def summary(runs: Mapping[str, LiveRun]) -> str:
    """Number of cases by outcome, as Markdown."""
    groups = {
        "single effects": [run for run in runs.values() if len(run.case.concealed) == 1 and not run.case.resolve],
        "pairs": [run for run in runs.values() if len(run.case.concealed) > 1],
        "healthy cameras": [run for run in runs.values() if not run.case.concealed],
        "benches to resolve": [run for run in runs.values() if run.case.resolve],
    }
    lines = [f"{len(runs)} of {len(every_case())} cases run.", "", "| | cases | outcomes |", "| --- | --- | --- |"]
    for name, group in groups.items():
        counts = ", ".join(f"{outcome} {n}" for outcome, n in Counter(run.outcome for run in group).most_common())
        lines.append(f"| {name} | {len(group)} | {counts or '-'} |")
    by_commit: dict[str, list[str]] = {}
    for name, run in runs.items():
        by_commit.setdefault(run.commit or "unknown", []).append(name)
    usual = max(by_commit, key=lambda commit: len(by_commit[commit]), default="unknown")
    lines.append(f"\nRun at commit {usual}" + ("." if len(by_commit) < 2 else ", except:"))
    lines += [f"- {commit}: {', '.join(names)}" for commit, names in by_commit.items() if commit != usual]
    unseen = sorted(name for name in runs if name in library() and name not in names_of(name))
    if unseen:
        lines.append(f"\nNot looked for, or shown by no measurement, so that no name is right: {', '.join(unseen)}.")
    return "\n".join(lines)


def table(runs: Mapping[str, LiveRun]) -> str:
    """Markdown table with a row for each case."""
    lines = [
        (
            "| concealed | outcome | named (sides) | rivals | parameter: found, concealed | held-out chi2 / n, before | "  # noqa: E501
            "after |"
        ),
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, run in runs.items():
        named = ", ".join(f"{effect} ({' '.join(sides)})" for effect, sides in run.named.items())
        rivals = ", ".join(sorted({rival for told in run.rivals.values() for rival in told}))
        found = "; ".join(_words(parameter) for parameter in run.parameters)
        before, after = (
            "-" if chi2 is None or not run.n else f"{chi2 / run.n:.3g}" for chi2 in (run.chi2_before, run.chi2_after)
        )
        what = ", ".join(spec.partition(":")[2].replace(":", " ") for spec in run.case.concealed) or f"nothing ({name})"
        if run.case.resolve:
            first = ", ".join((*run.first_named, *run.first_rivals)) or "nothing"
            what += f"; at first {first}, then {', '.join(run.captures) or 'no capture taken'}"
        said = run.outcome if run.error is None else f"failed: {run.error}"
        lines.append(
            f"| {what} | {said} | {named or run.verdict} | {rivals or '-'} | {found or '-'} | {before} | {after} |"
        )
    return "\n".join(lines)


def _words(parameter: FoundParameter) -> str:
    doubt = "" if parameter.std is None else f" ± {parameter.std:.2g}"
    if parameter.interval is not None:
        doubt = f" ({parameter.interval[0]:.3g} to {parameter.interval[1]:.3g})"
    return f"{parameter.parameter} {parameter.value:.3g}{doubt} {parameter.unit}, {parameter.truth:g}"


def drawing(runs: Mapping[str, LiveRun]) -> str:
    """SVG: the parameters of singles and pairs, found over concealed, with two standard deviations; grey or red where
    it wasn't named."""
    rows: list[tuple[str, str, FoundParameter | None]] = []
    for run in runs.values():
        if run.case.resolve or not run.case.concealed:
            continue
        colour = COLOURS.get(run.outcome, WRONG)
        sized = [p for p in run.parameters if library()[p.effect].quantities()[p.parameter].absent != p.truth]
        words = " + ".join(effect_title(effect) for effect in run.case.effects)
        rows += [(f"{words}: {p.parameter.replace('_', ' ')}", colour, p) for p in sized] or [(words, colour, None)]
    width, height = LABEL_PX + PLOT_PX + 30, HEAD_PX + ROW_PX * len(rows) + 30
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" '
            'font-size="11">'
        ),
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        f'<text x="{LABEL_PX}" y="16" fill="#222">found / concealed, two standard deviations</text>',
    ]

    def x_of(ratio: float) -> float:
        return LABEL_PX + PLOT_PX * (min(max(ratio, LOW), HIGH) - LOW) / (HIGH - LOW)

    for ratio in (0.0, 0.5, 1.0, 1.5, 2.0):
        x, ink = x_of(ratio), "#888" if ratio == 1.0 else "#ddd"
        parts.append(f'<path d="M{x:.0f} {HEAD_PX - 8}V{height - 20}" stroke="{ink}"/>')
        parts.append(f'<text x="{x:.0f}" y="{height - 6}" text-anchor="middle" fill="#222">{ratio:g}</text>')
    for k, (label, colour, parameter) in enumerate(rows):
        y = HEAD_PX + ROW_PX * (k + 0.5)
        parts.append(f'<text x="{LABEL_PX - 8}" y="{y + 4:.0f}" text-anchor="end" fill="#222">{escape(label)}</text>')
        if parameter is None:
            parts.append(f'<text x="{LABEL_PX + 6}" y="{y + 4:.0f}" fill="{colour}">no value</text>')
            continue
        ratio, half = parameter.value / parameter.truth, 2.0 * (parameter.std or 0.0) / abs(parameter.truth)
        ends = ratio - half, ratio + half
        if parameter.interval is not None:
            ends = parameter.interval[0] / parameter.truth, parameter.interval[1] / parameter.truth
        parts.append(f'<path d="M{x_of(ends[0]):.1f} {y:.1f}H{x_of(ends[1]):.1f}" stroke="{colour}" stroke-width="2"/>')
        parts.append(f'<circle cx="{x_of(ratio):.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/>')
    return "\n".join([*parts, "</svg>\n"])
