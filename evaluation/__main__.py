"""`python -m evaluation observables | engines ...`: measure how good calibench is, from a checkout."""

from __future__ import annotations

import argparse
from pathlib import Path

from evaluation.engines import compare
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
    two = commands.add_parser("engines", help="What does the evidence engine say of recordings, and today's diagnosis?")
    two.add_argument(
        "--sets", nargs="+", required=True,
        help="folders, `own:SEED`, `former:healthy:SEED` or `former:LAW:VARIANT:STRENGTH:SEED`",
    )  # fmt: skip
    two.add_argument("--beside", action="store_true", help="today's diagnosis, too")
    asked = parser.parse_args()
    if asked.command == "engines":
        for line in compare(asked.sets, beside=asked.beside):
            print(line, flush=True)
        return
    found = calibrate(asked.out, asked.sets, tuple(asked.source or SOURCES))
    print(table(found))
    if asked.page is not None:
        text = asked.page.read_text(encoding="utf-8")
        begin, end = "<!-- observables:begin -->", "<!-- observables:end -->"
        before, after = text.split(begin)[0], text.split(end)[1]
        asked.page.write_text(f"{before}{begin}\n{table(found)}\n{end}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
