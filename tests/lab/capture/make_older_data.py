"""The data folder of an older calibench, for `test_upgrade.py`. In a checkout of the older version:

    PYTHONPATH=. python make_older_data.py OLDER
    tar --sort=name --owner=0 --group=0 -czf data-of-revision-0007.tar.gz -C OLDER .

`data-of-revision-0007.tar.gz` is of a02419fa, the last commit whose registry has the revision 0007.
"""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

from api.keys import Permission, create_key
from lab.capture.plan import full_plan
from lab.capture.session import CaptureSession, Progress
from lab.capture.store import Store
from lab.fit import fit_recording_set
from tests.lab.fake_bench import Bench, station

#: Steps after which the second session is interrupted.
HALF = 4


def make(folder: Path) -> None:
    """A finished session with its fit, a session that was interrupted, and a key."""
    store = Store(folder)
    here = station()
    plan = full_plan(here, quick=True, only=("dark", "flat"))
    done = CaptureSession.start(store, here, plan, name="before the upgrade", connect=Bench().drivers)
    assert done.run().state == "finished"
    fit = fit_recording_set(store.recording_set(done.id))
    store.add_result("fit", done.id, fit.model_dump(mode="json"))

    def stop(now: Progress) -> None:
        if now.done >= HALF:
            raise InterruptedError("the computer is upgraded")

    half = CaptureSession.start(store, here, plan, name="interrupted", connect=Bench().drivers, on_progress=stop)
    with contextlib.suppress(Exception):  # what it raises ends the run
        half.run()
    create_key(store, "ada", Permission.OPERATE)
    store.close()


if __name__ == "__main__":
    make(Path(sys.argv[1]))
