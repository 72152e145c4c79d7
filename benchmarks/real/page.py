"""The page of the benchmark, and the figures in the pages of the examples."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from benchmarks.real.compare import PULL
from benchmarks.real.judge import EXPLAINED, QUANTILE, JudgedFigure, SetResult
from benchmarks.real.kept import Kept
from benchmarks.real.sets import DeclaredSet
from evaluation.page import placed
from lab.observables.observable import measurement_title

HEAD = """# Real recordings

`make real` takes every set of recordings that lies beside the checkout through import, fit and diagnose, and writes
this page. Each figure stands beside one that was found by other means: another program, a few lines of numpy, a
published value, or the truth of a simulated camera. A *pull* is their difference over its standard uncertainty;
beyond 2 it is set in bold. What got worse since the last run fails the command.

Held-out chi2 is of captures that neither fit nor diagnosis has used. Over their number n it is 1 where the model
predicts them within their noise. The worst measurement is the one in which it is largest after the diagnosis. CPU
time and memory are those of the whole process, import to diagnosis, on one core; memory is the largest of any
process.
"""

TAIL = """## What isn't taken through

A photograph of a printed noise target (`delbracio_noise_target`) has no importer: `make bench` fits its kernel.
Measured sensitivities, radiances of a chart and lens prescriptions hold no recordings: tests of the fits and of the
lens read them.

## Sets of your own

`make real ARGS="--more DIR"` takes the sets in the folders of DIR: recording sets, folders of frames with an index,
and EMVA 1288 sessions. A file `independent.toml` beside the recordings states how else a set is brought in, and the
independent figures, with the keys of `benchmarks/real/sets.toml`. Page and results go to `calibench-data/real/DIR`;
the next run is compared with them.
"""

#: Pages with findings of sets, each between marks that have the set's name.
EXAMPLES = Path(__file__).parents[2] / "docs" / "explanation" / "examples"
MARK = re.compile(r"<!-- ([\w-]+):begin -->")


def page_of(kept: Kept, declared: Mapping[str, DeclaredSet]) -> str:
    """The page as Markdown."""
    sets = {name: (one, kept.sets[name]) for name, one in declared.items() if name in kept.sets}
    parts = [HEAD, _wrong(sets), _overview(sets)]
    without = [name for name in declared if name not in kept.sets]
    if without:
        parts.append(f"Not run yet: {', '.join(without)}.\n")
    parts += [_section(name, one, result) for name, (one, result) in sets.items()]
    return "\n".join([*parts, TAIL])


def write_examples(kept: Kept, folder: Path = EXAMPLES) -> None:
    """Write the figures into the pages of the examples."""
    for file in sorted(folder.glob("*.md")):
        file.write_text(example_of(file.read_text(encoding="utf-8"), kept), encoding="utf-8")


def example_of(text: str, kept: Kept) -> str:
    """An example's page with the findings of sets between the marks that have their names."""
    for name in MARK.findall(text):
        if name in kept.sets:
            text = placed(text, name, findings(kept.sets[name]))
    return text


def findings(result: SetResult) -> str:
    """What a diagnosis says, and held-out chi2 of the measurements in which it is or was largest, as Markdown."""
    lines = [f"> **{result.verdict}**"]
    lines += [f"> {sentence}" for sentence in result.summary]
    text = "  \n".join(lines)
    held = _held_out(result, 8)
    return f"{text}\n\n{held}" if held else text


def _wrong(sets: Mapping[str, tuple[DeclaredSet, SetResult]]) -> str:
    """What isn't as it should be, in all sets."""
    found = []
    for name, (_, result) in sets.items():
        said = [f"fails: {result.failed}"] if result.failed else []
        said += [f"{f.name} {_number(f)}, independently {f.independent:g}: pull {f.pull:+.1f}" for f in _off(result)]
        said += [
            f"{f.name} isn't determined; independently {f.independent:g}" for f in result.figures if f.value is None
        ]
        said += [f"{at} is given, which these recordings can't determine" for at in result.made_up]
        said += [
            f"the name `{name.name}` is contradicted: {name.why or 'it isn’t in the truth'}"
            for name in result.names
            if name.is_right == "contradicted"
        ]
        said += [f"the name `{name}` isn't given" for name in result.missing]
        said += [f"{measurement_title(m.measurement)}: held-out chi2 over n is {m.after_over_n:.3g}, and nothing "
            "tells of it" for m in result.measurements if m.is_silent]  # fmt: skip
        found += [f"- [{name}](#{name}): {words}" for words in said]
    lines = found or ["Nothing."]
    note = (
        f"Wanted: pulls within 2, no name that is contradicted, and held-out chi2 over n of {EXPLAINED:g} at most "
        "where nothing more is told "
        f"(or below the {QUANTILE:.1%} quantile of chi2, which few numbers exceed by chance)."
    )
    return "\n".join(["## What is wrong", "", note, "", *lines, ""])


def _overview(sets: Mapping[str, tuple[DeclaredSet, SetResult]]) -> str:
    lines = [
        "## All sets",
        "",
        (
            "| set | figures within 2 | worst pull | names | held-out chi2 / n, before | after | worst measurement "
            "after "
            "| CPU, s | memory, MB |"
        ),
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, (_, result) in sets.items():
        judged = [f for f in result.figures if f.pull is not None]
        worst = max((abs(f.pull or 0.0) for f in judged), default=None)
        names = ", ".join(f"{n.name} ({n.is_right})" for n in result.names) or result.verdict.replace("_", " ") or "-"
        before, after = (
            "-" if x is None or not result.n else f"{x / result.n:.3g}" for x in (result.before, result.after)
        )
        weak = (
            "-"
            if result.worst is None
            else f"{measurement_title(result.worst.measurement)} {result.worst.after_over_n:.3g}"
        )
        lines.append(
            f"| [{name}](#{name}) | "
            f"{f'{len(judged) - len(_off(result))} of {len(result.figures)}' if result.figures else '-'} "
            f"| {'-' if worst is None else f'{worst:.1f}'} | {result.failed or names} | {before} | {after} | {weak} "
            f"| {result.cpu_s:.0f} | {result.memory_mb:.0f} |"
        )
    return "\n".join([*lines, ""])


def _section(name: str, one: DeclaredSet, result: SetResult) -> str:
    parts = [f"## {name}", "", f"{one.title}. {one.story}".rstrip(), ""]
    if result.failed:
        return "\n".join([*parts, f"It fails: {result.failed}", ""])
    if result.figures:
        parts += ["| figure | here | independent | pull |", "| --- | --- | --- | --- |"]
        for f in result.figures:
            pull = "-" if f.pull is None else f"**{f.pull:+.1f}**" if abs(f.pull) > PULL else f"{f.pull:+.1f}"
            beside = f"{f.independent:g}" + (f" ± {f.independent_std:.2g}" if f.independent_std else "")
            unit = "" if f.unit == "1" else f", {f.unit}"
            parts.append(f"| {f.name}{unit} | {_number(f)} | {beside} | {pull} |")
        parts.append("")
    if result.made_up:
        parts += [f"Given, though these recordings can't determine it: {', '.join(result.made_up)}.", ""]
    if not result.verdict:
        return "\n".join([*parts, "A table of means holds no frames: there is nothing to diagnose.", ""])
    for found in result.names:
        said = {"agrees": "an independent look agrees", "contradicted": "an independent look contradicts it"}
        judged = said.get(found.is_right, "no independent look says whether it is right")
        why = f": {found.why}" if found.why else ""
        parts.append(f"- `{found.name}` ({' and '.join(found.sides)}, probability {found.probability:.3g}): "
            f"{judged}{why}.")  # fmt: skip
    parts += [f"- `{missing}` isn't given: {one.agrees[missing]}." for missing in result.missing]
    if not result.names:
        parts.append(f"Verdict: {result.verdict.replace('_', ' ')}; no name is given.")
    parts += ["", *filter(None, [_held_out(result, 4)])]
    return "\n".join(parts)


def _held_out(result: SetResult, most: int) -> str:
    """Table of the measurements of the largest held-out chi2, before or after."""
    if not result.measurements or result.before is None or result.after is None:
        return ""
    lines = [
        "| held-out captures | n | chi2, baseline | chi2, with what was found | over n |",
        "| --- | --- | --- | --- | --- |",
    ]
    ranked = sorted(result.measurements, key=lambda m: -max(m.before, m.after) / m.n)
    rows = [
        (
            measurement_title(m.measurement) + (f", {m.side}" if len({o.side for o in ranked}) > 1 else ""),
            m.n,
            m.before,
            m.after,
        )
        for m in ranked[:most]
    ]
    rows.append(("all", result.n, result.before, result.after))
    lines += [
        f"| {what} | {n} | {_chi2(before)} | {_chi2(after)} | {after / n:.3g} |" for what, n, before, after in rows
    ]
    return "\n".join([*lines, ""])


def _chi2(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"


def _off(result: SetResult) -> list[JudgedFigure]:
    return [f for f in result.figures if f.pull is not None and abs(f.pull) > PULL]


def _number(figure: JudgedFigure) -> str:
    if figure.value is None:
        return "not determined"
    return f"{figure.value:.4g}" + ("" if figure.std is None else f" ± {figure.std:.2g}")
