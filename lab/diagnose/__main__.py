"""`python -m lab.diagnose`: one side of a recording set for `processes.py`, which hands over the work and hears what was found."""

from __future__ import annotations

import os
import pickle
import sys
import traceback

from lab.diagnose.side import SideFindings, diagnose_side


def _serve() -> None:
    """What a process does: one side, and everything that it says as pickles on what was the standard output."""
    with os.fdopen(os.dup(1), "wb") as to:
        os.dup2(2, 1)  # what a library prints mustn't get between

        def say(what: str | SideFindings | Exception) -> None:
            to.write(pickle.dumps(what, pickle.HIGHEST_PROTOCOL))
            to.flush()

        try:
            task = pickle.load(sys.stdin.buffer)
        except (EOFError, pickle.UnpicklingError):
            os._exit(1)  # who started this was interrupted before it had handed over the work
        recordings, side, fit, baseline, pictures, bootstrap = task
        try:
            say(diagnose_side(recordings, side, fit, baseline, say, pictures=pictures, bootstrap=bootstrap))
        except BrokenPipeError:
            os._exit(1)  # nobody listens any more
        except Exception as error:
            error.add_note(traceback.format_exc())
            say(_sendable(error))


def _sendable(error: Exception) -> Exception:
    """The error itself where it survives being sent, else one of the same words."""
    try:
        return error if isinstance(pickle.loads(pickle.dumps(error)), Exception) else RuntimeError(str(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    _serve()
