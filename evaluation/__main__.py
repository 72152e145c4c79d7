"""`python -m evaluation COMMAND`: measure how good calibench is, from a checkout."""

from __future__ import annotations

import json as json_text
import os
import random
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.cli.console import EXIT_CHECK, check_folder, check_writable
from lab.cli.entry import run_command_line
from lab.cli.help import complete_help
from lab.cli.sources import Scheduler
from lab.errors import InputError

if TYPE_CHECKING:
    from lab.workers import Workers

app = typer.Typer(
    help="Measures how good calibench is, on cameras whose truth is known.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

#: The lists of scored seeds.
PROOF_PAGE = Path(__file__).resolve().parents[1] / "docs" / "proof.md"
UNLISTED_PAGE = PROOF_PAGE.with_name("proof-unlisted.md")

Cases = Annotated[Path, typer.Argument(metavar="DIR", help="the folder that `make` wrote")]
TruthsFile = Annotated[Path, typer.Option("--truths", metavar="FILE", help="the truths that `make` wrote")]
Results = Annotated[Path, typer.Option("--out", metavar="DIR", help="where results are kept")]
Only = Annotated[
    list[str] | None, typer.Option("--only", metavar="CASE", help="this case; may be repeated (without: all)")
]
Page = Annotated[
    Path | None, typer.Option("--page", metavar="FILE.md", help="write tables and a picture into this page")
]
Jobs = Annotated[int | None, typer.Option("--jobs", min=1, metavar="N", help="processes (all cores)")]


def _show_progress(text: str, share: float) -> None:
    if sys.stderr.isatty():
        print(f"\r{text} ({100 * share:.0f} %)", end="" if share < 1 else "\n", file=sys.stderr, flush=True)


def _workers(jobs: int | None, scheduler: str | None) -> Workers:
    """Return the workers. Raises InputError where they are a cluster's that isn't there."""
    from lab.workers import Workers

    workers = Workers(jobs or os.cpu_count() or 1, scheduler)
    workers.check()
    return workers


@app.command("make")
def make_command(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="the folder to write")],
    cases: Annotated[int, typer.Option("--cases", min=1, metavar="N", help="how many recording sets")] = 40,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, metavar="S", help="seed of the cases (without: a new one)")
    ] = None,
    truths: Annotated[
        Path | None, typer.Option("--truths", metavar="FILE", help="where the truths go (DIR.truths.json beside DIR)")
    ] = None,
    size: Annotated[
        str,
        typer.Option(
            "--size", help="small, medium or full frames; foreign: frames, converters and screens of all sizes"
        ),
    ] = "medium",
    cfa: Annotated[str | None, typer.Option("--cfa", help="MONO, RGGB, ... for all cases (without: as drawn)")] = None,
    proof: Annotated[
        bool, typer.Option("--proof", help="a proof: its seed is scored once, and never tuned on")
    ] = False,
    unlisted: Annotated[
        bool, typer.Option("--unlisted", help="conceal laws that no list has, for a proof of discovery")
    ] = False,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
) -> None:
    """Write sealed recording sets with concealed truths. Run it again to continue after an interruption.

    Example: python -m evaluation make --out cases --cases 20 --seed 1
    """
    from evaluation.make import make
    from evaluation.page import refuse_scored
    from evaluation.truth import FIRST_FRESH_SEED, FIRST_PROOF_SEED, purpose_of

    if seed is None:
        first, end = (FIRST_PROOF_SEED, FIRST_FRESH_SEED) if proof else (0, FIRST_PROOF_SEED)
        seed = random.SystemRandom().randrange(first, end)
    if proof and purpose_of(seed) == "tuning":
        raise InputError(
            f"seed {seed}: seeds below {FIRST_PROOF_SEED} are for tuning; give a proof one from {FIRST_PROOF_SEED} on"
        )
    if not proof and purpose_of(seed) == "proof":
        raise InputError(
            f"seed {seed}: seeds from {FIRST_PROOF_SEED} to {FIRST_FRESH_SEED - 1} are for proofs; give one below to "
            "tune, or --proof"
        )
    if proof:
        refuse_scored(seed, UNLISTED_PAGE if unlisted else PROOF_PAGE)
    file = truths if truths is not None else out.parent / f"{out.resolve().name}.truths.json"
    check_folder(out)
    check_writable(file)
    made = make(
        out, cases, seed, file, size, _workers(jobs, scheduler), cfa=cfa, laws="unlisted" if unlisted else "listed",
        progress=_show_progress,
    )  # fmt: skip
    print(f"{out}: {len(made.truths)} cases, sealed in seals.json; the truths, seed among them, are in {file}")


@app.command("score")
def score_command(
    folder: Cases,
    truths: TruthsFile,
    json: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="write the result as JSON ('-': to stdout)")
    ] = None,
    page: Page = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
) -> None:
    """Diagnose the cases without a result, open the seals, and score. Exit code 4 if a goal is missed.

    Example: python -m evaluation score cases --truths cases.truths.json
    """
    from evaluation.blind import BlindProof
    from evaluation.sealed import sealed_cases
    from evaluation.truth import Truths, load, store
    from evaluation.unlisted import UnlistedProof

    check_writable(json)
    check_writable(page)
    proof: BlindProof | UnlistedProof = BlindProof(folder, sealed_cases(folder), truths)
    runs = proof.run(folder, workers=_workers(jobs, scheduler), progress=_show_progress)
    if load(Truths, truths).laws == "unlisted":  # opened only now that all diagnoses are written
        proof = UnlistedProof(folder, proof.cases, truths)
    scores = proof.opened(runs)
    outcome = proof.outcome(scores)  # type: ignore[arg-type]
    if page is not None:
        outcome.write(page)
    if json is not None and str(json) != "-":
        store(scores, json)
    print(scores.model_dump_json(indent=1) if str(json) == "-" else outcome.text)
    if not outcome.reached:
        raise typer.Exit(EXIT_CHECK)


@app.command("calibrate")
def calibrate_command(
    folder: Cases,
    truths: TruthsFile,
    rules: Annotated[
        list[str] | None,
        typer.Option("--rule", metavar="NAME=VALUE", help="another value of a decision rule; may be repeated"),
    ] = None,
    each: Annotated[
        bool, typer.Option("--each", help="remove each rule that has no derivation in turn, and print a table")
    ] = False,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
) -> None:
    """Score tuning cases under changed decision rules and under the default ones; results are kept in DIR.

    Example: python -m evaluation calibrate cases --truths cases.truths.json --each
    """
    from evaluation.blind import BlindProof
    from evaluation.calibrate import answers, changed_policy, comparison, policies_without, refuse_proof, rule_table
    from evaluation.score import broken_seals
    from evaluation.sealed import sealed_cases
    from evaluation.truth import Seals, Truths, load

    if each == bool(rules):
        raise InputError("give either --each or --rule NAME=VALUE")
    opened = load(Truths, truths)
    refuse_proof(opened)
    if opened.laws == "unlisted":
        raise InputError(f"{truths}: conceals laws that no list has; rules are calibrated on cases of listed ones")
    cases = sealed_cases(folder)
    workers = _workers(jobs, scheduler)
    if each:
        broken = broken_seals(folder, load(Seals, folder / "seals.json"), opened)
        whole = [case for case in cases if case not in broken]
        folders, by_case = [folder.resolve() / case for case in whole], {}
        for number, answer in workers.done(answers, folders, policies_without()):
            by_case[whole[number]] = answer
            _show_progress(f"{len(by_case)} of {len(whole)} cases", len(by_case) / len(whole))
        print(rule_table({case: opened.truths[case].truth for case in whole}, by_case))
        return
    under = {"results": None, f"results {' '.join(sorted(rules or ()))}": changed_policy(rules or ())}
    proofs = [BlindProof(folder, cases, truths, policy, results) for results, policy in under.items()]
    scores = [proof.opened(proof.run(folder, workers=workers, progress=_show_progress)) for proof in proofs]
    print(comparison(*scores))


@app.command("observables")
def observables_command(
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="file of the results, one line a set; it is continued there")
    ],
    sets: Annotated[int, typer.Option("--sets", min=1, metavar="N", help="healthy sets of each simulator")] = 200,
    source: Annotated[
        list[str] | None, typer.Option("--source", metavar="NAME", help="this simulator (without: every one)")
    ] = None,
    page: Page = None,
) -> None:
    """Test the covariances of the observables on healthy cameras.

    Example: python -m evaluation observables --out observables.jsonl --sets 24
    """
    from evaluation.observables import SOURCES, calibrate, table
    from evaluation.page import placed

    check_writable(out)
    check_writable(page)
    unknown = sorted(set(source or ()) - set(SOURCES))
    if unknown:
        raise InputError(f"--source {unknown[0]}: no such simulator; there are {', '.join(SOURCES)}")
    found = calibrate(out, sets, tuple(source or SOURCES))
    print(table(found))
    if page is not None:
        page.write_text(placed(page.read_text(encoding="utf-8"), "observables", table(found)), encoding="utf-8")


@app.command("third-party")
def third_party_command(
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="file of the results, one line a set; it is continued there")
    ],
    sets: Annotated[
        int, typer.Option("--sets", min=0, metavar="N", help="sets of each model; 0: the table of what FILE holds")
    ] = 20,
    effect: Annotated[
        list[str] | None,
        typer.Option("--effect", metavar="NAME", help="this model, by its effect's name (without: every one)"),
    ] = None,
    page: Page = None,
) -> None:
    """Diagnose sets of third parties' simulators: are their effects named and sized?

    Example: python -m evaluation third-party --out third-party.jsonl --sets 2
    """
    from evaluation.page import placed

    missing = [package for package in ("pyxel", "galsim") if find_spec(package) is None]
    if missing:
        raise InputError(f"{' and '.join(missing)}: not installed; `make third-party` installs what is needed")
    from evaluation.third_party import experiment  # needs the simulators
    from evaluation.third_party.score import size_table, table

    check_writable(out)
    check_writable(page)
    unknown = sorted(set(effect or ()) - set(experiment.SOURCES))
    if unknown:
        raise InputError(f"--effect {unknown[0]}: no such model; there are {', '.join(experiment.SOURCES)}")
    results = experiment.diagnose_sets(out, sets, tuple(effect or experiment.SOURCES))
    text = f"{table(results)}\n\n{size_table(results)}"
    print(text)
    if page is not None:
        page.write_text(placed(page.read_text(encoding="utf-8"), "third-party", text), encoding="utf-8")


@app.command("engines")
def engines_command(
    sets: Annotated[
        list[str],
        typer.Argument(
            metavar="SET...", help="folders, own:SEED, former:healthy:SEED or former:LAW:VARIANT:STRENGTH:SEED"
        ),
    ],
    with_diagnosis: Annotated[bool, typer.Option("--with-diagnosis", help="also run today's diagnosis")] = False,
    scales: Annotated[
        bool, typer.Option("--scales", help="instead: count names that change with everyday scales halved and doubled")
    ] = False,
) -> None:
    """Print what the evidence engine reports of recordings.

    Example: python -m evaluation engines own:1 --with-diagnosis
    """
    from evaluation.engines import compare, vary_scales

    for line in vary_scales(sets) if scales else compare(sets, with_diagnosis=with_diagnosis):
        print(line, flush=True)


@app.command("compare")
def compare_command(
    folder: Cases,
    truths: TruthsFile,
    page: Page = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
) -> None:
    """Diagnose tuning cases by both engines, and compare their proper scores in pairs. Results are kept in DIR.

    Example: python -m evaluation compare cases --truths cases.truths.json
    """
    from evaluation.blind import BlindProof
    from evaluation.calibrate import refuse_proof
    from evaluation.page import placed
    from evaluation.proper_scores import case_statements, comparison_table
    from evaluation.score import broken_seals
    from evaluation.sealed import sealed_cases
    from evaluation.truth import Seals, Truths, load
    from lab.engine import Engine

    check_writable(page)
    opened = load(Truths, truths)
    refuse_proof(opened)
    if opened.laws == "unlisted":
        raise InputError(
            f"{truths}: conceals laws that no list has; engines are compared on cases of `make` without it"
        )
    broken = broken_seals(folder, load(Seals, folder / "seals.json"), opened)
    cases = tuple(case for case in sealed_cases(folder) if case not in broken)
    engines: tuple[tuple[Engine, str], ...] = (("today", "results"), ("evidence", "results-evidence"))
    told = {}
    for engine, results in engines:
        proof = BlindProof(folder, cases, truths, results=results, engine=engine)
        runs = proof.run(folder, workers=_workers(jobs, scheduler), progress=_show_progress)
        told[engine] = [case_statements(case, opened.truths[case].truth, run) for case, run in runs.items()]
    text = comparison_table(told)  # type: ignore[arg-type]
    print(text)
    if page is not None:
        page.write_text(placed(page.read_text(encoding="utf-8"), "engines", text), encoding="utf-8")


@app.command("live")
def live_command(
    out: Results,
    only: Only = None,
    page: Page = None,
    cases: Annotated[bool, typer.Option("--cases", help="list the cases as JSON, and end")] = False,
    isotropic: Annotated[
        bool, typer.Option("--isotropic", help="instead: resolve weak isotropic losses of contrast, and print a table")
    ] = False,
) -> None:
    """Conceal every effect on the mock bench, capture, diagnose, and report. Continues where an earlier run stopped.

    Example: python -m evaluation live --out live --only defocus
    """
    from evaluation.live import IsotropicProof, LiveProof

    proof = IsotropicProof() if isotropic else LiveProof()
    if cases:
        print(json_text.dumps({name: case.concealed for name, case in proof.draw().items()}, indent=1))
        return
    proof.prove(out, only, page)


@app.command("names")
def names_command(
    out: Results,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="CLASS", help="this class; may be repeated (without: all)")
    ] = None,
    most: Annotated[int | None, typer.Option("--most", metavar="N", min=1, help="cases of each class at most")] = None,
) -> None:
    """Count false names on cameras of four classes. Continues where an earlier run stopped.

    Exit code 4 if there are too many.

    Example: python -m evaluation names --out names --only bench --most 5
    """
    from evaluation.names import NamesExperiment

    if not NamesExperiment.of(only, most).prove(out).reached:
        raise typer.Exit(EXIT_CHECK)


@app.command("twin")
def twin_command(
    out: Results,
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed", min=0, metavar="S", help="of the drawn cameras: another draws cameras that nobody has seen"
        ),
    ] = None,
    only: Only = None,
    page: Page = None,
) -> None:
    """Predict concealed cameras in configurations that they weren't fitted in. Continues where an earlier run stopped.

    Example: python -m evaluation twin --out twin --only double-3
    """
    from evaluation.twin import SEED, TwinProof

    TwinProof(SEED if seed is None else seed).prove(out, only, page)


def command_tree() -> Any:
    """Return all commands with their whole help."""
    return complete_help(typer.main.get_command(app))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    return run_command_line(command_tree, "python -m evaluation", arguments)


if __name__ == "__main__":
    sys.exit(main())
