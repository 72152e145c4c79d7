"""`calibench challenge make`, `score` and `calibrate`."""

from __future__ import annotations

import os
import random
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.cli.console import EXIT_CHECK, check_folder, check_writable
from lab.cli.sources import Scheduler
from lab.errors import InputError

if TYPE_CHECKING:
    from lab.challenge.truth import Laws
    from lab.workers import Workers

commands = typer.Typer(
    name="challenge",
    help="Concealed-effect data with sealed truths, and its scoring.",
    no_args_is_help=True,
    add_completion=False,
)

Jobs = Annotated[int | None, typer.Option("--jobs", min=1, metavar="N", help="processes (all cores)")]
#: The lists of scored seeds, in a checkout of the project; an installation has none.
PROOF_PAGE = Path(__file__).resolve().parents[2] / "docs" / "proof.md"
UNLISTED_PAGE = PROOF_PAGE.with_name("proof-unlisted.md")


def _say(text: str, share: float) -> None:
    if sys.stderr.isatty():
        print(f"\r{text} ({100 * share:.0f} %)", end="" if share < 1 else "\n", file=sys.stderr, flush=True)


def _workers(jobs: int | None, scheduler: str | None) -> Workers:
    """Return the workers. Raises InputError where they are a cluster's that isn't there."""
    from lab.workers import Workers

    workers = Workers(jobs or os.cpu_count() or 1, scheduler)
    workers.check()
    return workers


@commands.command("make")
def make_command(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="the folder to write")],
    cases: Annotated[int, typer.Option("--cases", min=1, metavar="N", help="how many recording sets")] = 40,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, metavar="S", help="seed of the cases (without: a new one)"),
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

    Example: calibench challenge make --out cases --cases 20 --seed 1
    """
    from lab.challenge.make import make
    from lab.challenge.proof import refuse_scored
    from lab.challenge.truth import FIRST_FRESH_SEED, FIRST_PROOF_SEED, purpose_of

    if seed is None:
        seed = random.SystemRandom().randrange(
            *((FIRST_PROOF_SEED, FIRST_FRESH_SEED) if proof else (0, FIRST_PROOF_SEED))
        )
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
    laws: Laws = "unlisted" if unlisted else "listed"
    made = make(out, cases, seed, file, size, _workers(jobs, scheduler), cfa=cfa, laws=laws, progress=_say)
    print(f"{out}: {len(made.truths)} cases, sealed in seals.json; the truths, seed among them, are in {file}")


@commands.command("score")
def score_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="the folder that `challenge make` wrote")],
    truths: Annotated[Path, typer.Option("--truths", metavar="FILE", help="the truths that `challenge make` wrote")],
    json: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="write the result as JSON ('-': to stdout)")
    ] = None,
    page: Annotated[
        Path | None, typer.Option("--page", metavar="FILE.md", help="write tables and a picture into this page")
    ] = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
) -> None:
    """Diagnose the cases without a result, open the seals, and score. Exit code 4 if a goal is missed.

    Example: calibench challenge score cases --truths cases.truths.json
    """
    from lab.challenge import proof, score, unlisted_score
    from lab.challenge.run import run_all
    from lab.challenge.truth import Seals, Truths, load, store

    check_writable(json)
    check_writable(page)
    seals = load(Seals, folder / "seals.json")
    cases = tuple(case for case in sorted(seals.seals) if (folder / case).is_dir())
    runs = run_all(folder, cases, _workers(jobs, scheduler), _say)
    opened = load(Truths, truths)  # only now that all diagnoses are written
    broken = score.broken_seals(folder, seals, opened)
    found: score.ChallengeScore | unlisted_score.UnlistedScore
    if opened.laws == "unlisted":
        found = unlisted_score.score(opened, seals, runs, broken)
        table, write_page = unlisted_score.table(found), partial(unlisted_score.write_page, found)
    else:
        found = score.score(opened, seals, runs, broken)
        table, write_page = proof.table(found), partial(proof.write_page, found)
    if page is not None:
        write_page(page)
    if json is not None and str(json) != "-":
        store(found, json)
    print(found.model_dump_json(indent=1) if str(json) == "-" else table)
    if not found.reached:
        raise typer.Exit(EXIT_CHECK)


@commands.command("calibrate")
def calibrate_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="the folder that `challenge make` wrote")],
    truths: Annotated[Path, typer.Option("--truths", metavar="FILE", help="the truths that `challenge make` wrote")],
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

    Example: calibench challenge calibrate cases --truths cases.truths.json
    """
    from lab.challenge.calibrate import answers, changed_policy, comparison, policies_without, refuse_proof, rule_table
    from lab.challenge.run import run_all
    from lab.challenge.score import broken_seals, score
    from lab.challenge.truth import Seals, Truths, load

    if each == bool(rules):
        raise InputError("give either --each or --rule NAME=VALUE")
    seals, opened = load(Seals, folder / "seals.json"), load(Truths, truths)
    refuse_proof(opened)
    if opened.laws == "unlisted":
        raise InputError(
            f"{truths}: conceals laws that no list has; rules are calibrated on a challenge of listed ones"
        )
    cases = tuple(case for case in sorted(seals.seals) if (folder / case).is_dir())
    broken = broken_seals(folder, seals, opened)
    if each:
        whole = [case for case in cases if case not in broken]
        folders, by_case = [folder.resolve() / case for case in whole], {}
        for number, found in _workers(jobs, scheduler).done(answers, folders, policies_without()):
            by_case[whole[number]] = found
            _say(f"{len(by_case)} of {len(whole)} cases", len(by_case) / len(whole))
        print(rule_table({case: opened.truths[case].truth for case in whole}, by_case))
        return
    policy = changed_policy(rules or ())
    under = {"results": None, f"results {' '.join(sorted(rules or ()))}": policy}
    scores = [
        score(opened, seals, run_all(folder, cases, _workers(jobs, scheduler), _say, policy=one, results=where), broken)
        for where, one in under.items()
    ]
    print(comparison(*scores))
