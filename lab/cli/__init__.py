"""The command line: `calibench COMMAND`. Parses, calls one verb of `lab`, prints, and turns errors into exit codes.

0 done; 2 the input can't be used; 3 a device failed; 4 a check failed; 1 a defect of calibench; 130 interrupted.
An error is one line on stderr (one for each problem of a folder), never a traceback; CALIBENCH_DEBUG=1 shows that too.
"""

# ruff: noqa: E402  (libraries read the number of threads when they are imported)
from __future__ import annotations

import os
import sys

# Both cameras are fitted at the same time; libraries that start threads of their own under these take four times as
# long.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from sim.memory import share_arenas

share_arenas()

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["serve"] and "--help" not in given:
        # Before anything that takes time is loaded, the command line's own library among it: a shutter may be open.
        from lab.capture.safe_at_start import make_safe_at_start

        make_safe_at_start(given)
    from lab.cli.entry import main as run

    return run(arguments)
