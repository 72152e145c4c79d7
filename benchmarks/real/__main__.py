"""The benchmark of real recordings: `make real`, or `python -m benchmarks.real --data FOLDER --out DIR`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.real.compare import worse
from benchmarks.real.judge import SetResult, judged
from benchmarks.real.kept import Kept, kept_in
from benchmarks.real.page import page_of, write_examples
from benchmarks.real.sets import DeclaredSet, declared_sets, sets_in
from benchmarks.real.take_through import DIAGNOSIS, FIT, ROOT, run_set
from evaluation.truth import load, store
from lab.engine import DEFAULT_ENGINE, Engine
from lab.errors import InputError
from lab.formats.results import DiagnosisResult, FitResult

PAGE, JSON = ROOT / "docs" / "real-recordings.md", ROOT / "docs" / "real-recordings.json"


def main(
    data: Annotated[Path, typer.Option("--data", metavar="DIR", help="the folder of the sets that sets.toml declares")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="where results are kept, set by set")],
    more: Annotated[
        Path | None,
        typer.Option(
            "--more", metavar="DIR", help="take the sets in this folder instead; page and JSON go to --out/DIR"
        ),
    ] = None,
    only: Annotated[list[str] | None, typer.Option("--only", metavar="SET", help="this set; may be repeated")] = None,
    accept: Annotated[bool, typer.Option("--accept", help="keep results that got worse")] = False,
    engine: Annotated[
        Engine, typer.Option(help="what diagnoses; results by another than the default stay in the working folder")
    ] = DEFAULT_ENGINE,
) -> None:
    """Take real recordings through import, fit and diagnose, and compare with the results that were kept. Goes on where
    it stopped."""
    page, json, folder, out = PAGE, JSON, data.resolve(), out.resolve()
    if more is not None:
        folder = more.resolve()
        out /= folder.name
        page, json = out / "page.md", out / "kept.json"
    if engine != DEFAULT_ENGINE:
        out /= engine
        out.mkdir(parents=True, exist_ok=True)
        page = out / "page.md"
    declared = declared_sets() if more is None else sets_in(more)
    unknown = sorted(set(only or ()) - set(declared))
    if unknown:
        raise InputError(f"--only {unknown[0]}: no such set; there are {', '.join(declared)}")
    before, results, said = kept_in(json), {}, []
    for name, one in declared.items():
        recordings = folder / (name if one.path is None else one.path)
        if only and name not in only:
            continue
        if one.path != "" and not recordings.exists():
            print(f"{name}: {recordings} isn't there; left out", flush=True)
            continue
        results[name] = now = result_of(one, recordings, out / name, engine)
        found = worse(before.sets[name], now) if name in before.sets else []
        said += [f"{name}: {words}" for words in found]
        print(
            f"{name}: {now.failed or now.verdict or 'fitted'}, {now.cpu_s:.0f} s{', worse' if found else ''}",
            flush=True,
        )
    if said and not accept:
        sys.exit("\n".join(["Worse than what was kept; nothing is written (--accept keeps it):", *said]))
    kept = Kept(
        sets={name: (before.sets | results)[name] for name in declared if name in before.sets or name in results}
    )
    store(kept, json if engine == DEFAULT_ENGINE else out / "kept.json")
    page.write_text(page_of(kept, declared), encoding="utf-8")
    if more is None and engine == DEFAULT_ENGINE:
        write_examples(kept)
    print(f"{len(results)} sets; {page}")


def result_of(one: DeclaredSet, recordings: Path, out: Path, engine: Engine = DEFAULT_ENGINE) -> SetResult:
    """A set's row, by what `out` holds of this code and these recordings, else by running it."""
    cost = run_set(one, recordings, out, engine)
    fit = load(FitResult, out / FIT) if (out / FIT).is_file() else None
    diagnosis = load(DiagnosisResult, out / DIAGNOSIS) if (out / DIAGNOSIS).is_file() else None
    return judged(one, cost, fit, diagnosis)


if __name__ == "__main__":
    typer.run(main)
