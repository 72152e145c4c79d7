"""`python -m evaluation observables | third-party ...`: measure how good calibench is, from a checkout."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from evaluation.observables import SOURCES, calibrate, table


def main() -> None:
    """Run the experiment that is asked for."""
    parser = argparse.ArgumentParser(prog="python -m evaluation", description="Measure how good calibench is.")
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("observables", help="Are the covariances of the observables true on healthy cameras?")
    one.add_argument("--out", type=Path, required=True, help="file of the results, one line a set; it goes on there")
    one.add_argument("--sets", type=int, default=200, help="healthy sets of each simulator")
    one.add_argument("--source", choices=tuple(SOURCES), action="append", help="a simulator; default: every one")
    one.add_argument("--page", type=Path, help="page whose table is written anew")
    one = commands.add_parser("third-party", help="Are effects of third parties' simulators named and sized?")
    one.add_argument("--out", type=Path, required=True, help="file of the results, one line a set; it goes on there")
    one.add_argument("--sets", type=int, default=20, help="sets of each model")
    one.add_argument("--effect", action="append", help="a model, by its effect's name; default: every one")
    one.add_argument("--page", type=Path, help="page whose table is written anew")
    asked = parser.parse_args()
    if asked.command == "observables":
        text = table(calibrate(asked.out, asked.sets, tuple(asked.source or SOURCES)))
    else:
        text = _of_third_parties(asked.out, asked.sets, tuple(asked.effect or ()))
    print(text)
    if asked.page is not None:
        page = asked.page.read_text(encoding="utf-8")
        begin, end = f"<!-- {asked.command}:begin -->", f"<!-- {asked.command}:end -->"
        before, after = page.split(begin)[0], page.split(end)[1]
        asked.page.write_text(f"{before}{begin}\n{text}\n{end}{after}", encoding="utf-8")


def _of_third_parties(file: Path, sets: int, effects: Sequence[str]) -> str:
    """Return the table of third parties' sets; exit in one line where a simulator isn't installed."""
    missing = [package for package in ("pyxel", "galsim") if find_spec(package) is None]
    if missing:
        sys.exit(f"third-party: {' and '.join(missing)} not installed; `make third-party` installs what it needs")
    from evaluation.third_party import experiment  # needs the simulators
    from evaluation.third_party.score import table as table_of_sets

    unknown = sorted(set(effects) - set(experiment.SOURCES))
    if unknown:
        sys.exit(f"--effect {unknown[0]}: no such model; there are {', '.join(experiment.SOURCES)}")
    return table_of_sets(experiment.diagnose_sets(file, sets, effects or tuple(experiment.SOURCES)))


if __name__ == "__main__":
    main()
