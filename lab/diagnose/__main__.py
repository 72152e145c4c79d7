"""`python -m lab.diagnose`: diagnose one side for `processes.py`, which sends the task and reads the findings."""

from __future__ import annotations

import os
import pickle
import sys
import traceback

from lab.diagnose.side import SideFindings, diagnose_side


def _serve() -> None:
    """Read a task from standard input, diagnose that side, and write progress and findings as pickles to standard
    output."""
    with os.fdopen(os.dup(1), "wb") as to:
        os.dup2(2, 1)  # what a library prints goes to standard error

        def say(what: str | SideFindings | Exception) -> None:
            to.write(pickle.dumps(what, pickle.HIGHEST_PROTOCOL))
            to.flush()

        try:
            task = pickle.load(sys.stdin.buffer)
        except (EOFError, pickle.UnpicklingError):
            os._exit(1)  # the caller was interrupted before it had sent the task
        recordings, side, fit, baseline, policy, pictures, bootstrap, workers = task
        try:
            found = diagnose_side(
                recordings,
                side,
                fit,
                baseline,
                say,
                policy=policy,
                pictures=pictures,
                bootstrap=bootstrap,
                workers=workers,
            )
            say(found)
        except BrokenPipeError:
            os._exit(1)  # the caller is gone
        except Exception as error:
            error.add_note(traceback.format_exc())
            say(_sendable(error))


def _sendable(error: Exception) -> Exception:
    """The error itself where it can be pickled, else one with the same text."""
    try:
        return error if isinstance(pickle.loads(pickle.dumps(error)), Exception) else RuntimeError(str(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    _serve()
