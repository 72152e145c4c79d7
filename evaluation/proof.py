"""The proof's page: tables and a confusion matrix, with the seed and the hash of the seals."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from evaluation.score import STRONG, CaseScore, ChallengeScore, Rate
from lab.effect_titles import effect_title
from lab.errors import InputError

# --- power curves ----------------------------------------------------------------------------------------------------
# Power curves of the proof as a picture: share of right answers against separability, of the diagnosis and of the
# oracle.


#: Borders of the classes of separability; values beyond them count in the first and the last class.
BORDERS = (1.0, 5.0, 10.0, 15.0, 25.0, 50.0, 100.0, 300.0, 2000.0)
WIDTH_PX, HEIGHT_PX, LEFT_PX, TOP_PX, GAP_PX = 330.0, 210.0, 62.0, 44.0, 66.0
MEASURED, ORACLE = "#1f5fa8", "#8a8f98"


def power_curves(found: ChallengeScore) -> str:
    """SVG with single effects at the left and compounds at the right. For each class of separability, at its geometric
    mean: the share of right diagnoses with its 95 % interval and the number of cases, and the mean share of the oracle
    on the same cases."""
    width, height = LEFT_PX + 2 * WIDTH_PX + GAP_PX + 24, TOP_PX + HEIGHT_PX + 92
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" font-family="sans-serif" '  # noqa: E501
            'font-size="12">'
        ),
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
    ]
    for column, (kind, title) in enumerate(
        (("single", "one effect: named first"), ("compound", "two effects: both named"))
    ):
        cases = [s for s in found.case_scores if s.kind == kind and s.separability is not None]
        parts += _panel(LEFT_PX + column * (WIDTH_PX + GAP_PX), title, cases)
    y = TOP_PX + HEIGHT_PX + 70
    for x, colour, words in (
        (LEFT_PX, MEASURED, "diagnosis"),
        (LEFT_PX + 120, ORACLE, "oracle: the best that could be"),
    ):
        parts.append(f'<rect x="{x}" y="{y - 9}" width="22" height="4" fill="{colour}"/>')
        parts.append(f'<text x="{x + 28}" y="{y - 2}" fill="#222">{words}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _panel(left: float, title: str, cases: Sequence[CaseScore]) -> list[str]:
    def across(strength: float) -> float:
        low, high = np.log(BORDERS[0]), np.log(BORDERS[-1])
        return left + WIDTH_PX * float((np.log(np.clip(strength, BORDERS[0], BORDERS[-1])) - low) / (high - low))

    def up(share: float) -> float:
        return TOP_PX + HEIGHT_PX * (1.0 - share)

    parts = [
        f'<text x="{left + WIDTH_PX / 2:.0f}" y="{TOP_PX - 18:.0f}" text-anchor="middle" fill="#222">{title}</text>'
    ]
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        parts.append(
            f'<path d="M{left:.0f} {up(share):.1f}h{WIDTH_PX:.0f}" stroke="#d5d8dd"/><text x="{left - 8:.0f}" '
            f'y="{up(share) + 4:.1f}" '
            f'text-anchor="end" fill="#222">{100 * share:.0f} %</text>'
        )
    for strength in (1, 5, 10, 25, 50, 100, 300, 2000):
        x = across(strength)
        parts.append(
            f'<path d="M{x:.1f} {up(0):.1f}v5" stroke="#222"/><text x="{x:.1f}" y="{up(0) + 18:.1f}" '
            f'text-anchor="middle" fill="#222">{strength}</text>'
        )
    parts.append(
        f'<text x="{left + WIDTH_PX / 2:.0f}" y="{up(0) + 38:.1f}" text-anchor="middle" fill="#222">separability</text>'
    )
    if not cases:
        parts.append(
            f'<text x="{left + WIDTH_PX / 2:.0f}" y="{up(0.5):.1f}" text-anchor="middle" fill="#222">no case</text>'
        )
        return parts
    classes = _by_class(cases)
    places = [
        across(float(np.exp(np.mean([np.log(max(s.separability or 0.0, BORDERS[0])) for s in held]))))
        for held in classes
    ]
    known = [
        (x, up(float(np.mean([s.oracle_share for s in held if s.oracle_share is not None]))))
        for x, held in zip(places, classes, strict=True)
        if any(s.oracle_share is not None for s in held)
    ]
    parts.append(_line(known, ORACLE))
    rates = [Rate.over(s.right for s in held) for held in classes]
    parts.append(_line([(x, up(rate.share or 0.0)) for x, rate in zip(places, rates, strict=True)], MEASURED))
    for x, rate in zip(places, rates, strict=True):
        y, low, high = (up(share or 0.0) for share in (rate.share, rate.low, rate.high))
        parts.append(
            f'<path d="M{x:.1f} {low:.1f}V{high:.1f}" stroke="{MEASURED}" stroke-opacity="0.5"/><circle cx="{x:.1f}" '
            f'cy="{y:.1f}" r="3.5" '
            f'fill="{MEASURED}"/><text x="{x + 5:.1f}" y="{y - 6:.1f}" fill="{MEASURED}" '
            f'font-size="10">{rate.of}</text>'
        )
    return parts


def _by_class(cases: Sequence[CaseScore]) -> list[list[CaseScore]]:
    """Cases by classes of separability, without empty ones."""
    at = np.clip(np.searchsorted(BORDERS, [s.separability or 0.0 for s in cases], side="right"), 1, len(BORDERS) - 1)
    held = [[s for s, k in zip(cases, at, strict=True) if k == wanted] for wanted in range(1, len(BORDERS))]
    return [group for group in held if group]


def _line(points: Sequence[tuple[float, float]], colour: str) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>'


# --- proof ------------------------------------------------------------


CELL_PX, LABEL_PX, HEAD_PX = 24, 210, 225
RIGHT, WRONG, ABSTAINED = "#2f7d4f", "#b3372f", "#8a8f98"
SAID_NOTHING = ("unexplained", "no_mismatch", "failed")


def refuse_scored(seed: int, page: Path) -> None:
    """Raises InputError where the page lists this proof seed as scored: a scored seed is never used again."""
    if page.is_file() and re.search(rf"^\| proof \| {seed} \|", page.read_text(encoding="utf-8"), re.MULTILINE):
        raise InputError(f"seed {seed}: was scored already, see {page}; leave --seed out for a fresh one")


def rate_words(rate: Rate) -> str:
    if rate.share is None or rate.low is None or rate.high is None:
        return "none"
    return f"{rate.count} of {rate.of} ({100 * rate.low:.0f}..{100 * rate.high:.0f} %)"


def _share(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"


def table(found: ChallengeScore) -> str:
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


def write_page(found: ChallengeScore, page: Path) -> None:
    """Write the section of this purpose into the page, its picture beside it, and the seed into the page's list of
    seeds."""
    text = page.read_text(encoding="utf-8") if page.is_file() else "# Proof\n"
    picture = page.with_name(f"{page.stem}-{found.purpose}.svg")
    section = (
        f"Seed {found.seed}, {found.cases} cases, {found.size} frames; SHA-256 over all seals "
        f"`{found.seals_sha256}`.\n\n"
        f"{table(found)}\n\n![What was said of what was concealed]({picture.name})"
    )
    if any(s.oracle_share is not None for s in found.case_scores):
        curves = page.with_name(f"{page.stem}-{found.purpose}-oracle.svg")
        section += f"\n\n![Right answers over separability, of the diagnosis and of the oracle]({curves.name})"
        page.parent.mkdir(parents=True, exist_ok=True)
        curves.write_text(power_curves(found), encoding="utf-8")
    row = f"| {found.purpose} | {found.seed} | {found.cases} | {found.size} | `{found.seals_sha256[:16]}` |"
    text = with_seed(placed(text, found.purpose, section), row)
    page.parent.mkdir(parents=True, exist_ok=True)
    picture.write_text(confusion(found), encoding="utf-8")
    page.write_text(text, encoding="utf-8")


def with_seed(text: str, row: str) -> str:
    """Return a page's text with a row in its list of seeds."""
    if row not in text:
        begin = text.find("<!-- seeds:end -->")
        if begin < 0:
            text += (
                "\n## Seeds\n\n| for | seed | cases | frames | seals |\n| --- | --- | --- | --- | --- |\n<!-- "
                "seeds:end -->\n"
            )
            begin = text.find("<!-- seeds:end -->")
        text = f"{text[:begin]}{row}\n{text[begin:]}"
    return text


def placed(text: str, name: str, section: str) -> str:
    """Return a page's text with the section `name` between its marks replaced, or added at the end."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    if begin not in text:
        return f"{text.rstrip()}\n\n## Results, {name}\n\n{begin}\n{section}\n{end}\n"
    head, rest = text.split(begin, 1)
    return f"{head}{begin}\n{section}\n{end}{rest.split(end, 1)[1]}"


# --- the picture ------------------------------------------------------------------------------------------------------


def _row(case: CaseScore) -> str:
    if case.kind == "single":
        return case.truth[0]
    return "(healthy)" if case.kind == "healthy" else "(outside the library)"


def confusion(found: ChallengeScore) -> str:
    """Confusion matrix as SVG: numbers of cases by what was concealed (rows: single effects of non-centrality above 50,
    healthy, outside the library) and by the first name or the verdict (columns)."""
    shown = [
        s
        for s in found.case_scores
        if s.kind in {"healthy", "outside"} or (s.kind == "single" and s.noncentrality[0] > STRONG)
    ]
    count = Counter((_row(s), s.named[0] if s.named else s.verdict) for s in shown)
    rightly = {(_row(s), s.named[0] if s.named else s.verdict) for s in shown if s.right}
    rows = sorted({row for row, _ in count}, key=lambda row: (row.startswith("("), row))
    said = {column for _, column in count}
    columns = [*sorted(said - set(SAID_NOTHING)), *(c for c in SAID_NOTHING if c in said)]
    width, height = LABEL_PX + CELL_PX * len(columns) + 130, HEAD_PX + CELL_PX * len(rows) + 50
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" '
            'font-size="12">'
        ),
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for j, column in enumerate(columns):
        x = LABEL_PX + CELL_PX * (j + 0.5)
        words = escape(effect_title(column))
        parts.append(
            f'<text x="{x + 4:.0f}" y="{HEAD_PX - 6}" transform="rotate(-55 {x + 4:.0f} {HEAD_PX - 6})" '
            f'fill="#222">{words}</text>'
        )
    for i, row in enumerate(rows):
        y = HEAD_PX + CELL_PX * i
        total = sum(count[row, column] for column in columns)
        words = escape(effect_title(row))
        parts.append(f'<text x="{LABEL_PX - 8}" y="{y + 16}" text-anchor="end" fill="#222">{words}</text>')
        for j, column in enumerate(columns):
            x, n = LABEL_PX + CELL_PX * j, count[row, column]
            right = (row, column) in rightly
            colour = RIGHT if right else ABSTAINED if column in SAID_NOTHING else WRONG
            shade = 0.25 + 0.75 * n / total if n else 0.0
            parts.append(
                f'<rect x="{x}" y="{y}" width="{CELL_PX}" height="{CELL_PX}" fill="{colour}" '
                f'fill-opacity="{shade:.2f}" stroke="#d5d8dd"/>'
            )
            if n:
                ink = "#fff" if shade > 0.55 else "#111"
                parts.append(
                    f'<text x="{x + CELL_PX / 2:.0f}" y="{y + 16}" text-anchor="middle" fill="{ink}">{n}</text>'
                )
    y = HEAD_PX + CELL_PX * len(rows) + 30
    for k, (colour, words) in enumerate(((RIGHT, "right"), (ABSTAINED, "nothing named"), (WRONG, "a wrong name"))):
        x = LABEL_PX + 130 * k - 150
        parts.append(
            f'<rect x="{x}" y="{y - 11}" width="12" height="12" fill="{colour}"/><text x="{x + 18}" y="{y}" '
            f'fill="#222">{words}</text>'
        )
    return "\n".join([*parts, "</svg>\n"])
