"""Records a session of the worked examples as a recording set: `python docs/record_examples.py OUT PART`, PART `bench`
or `puzzle`.

`bench`: a quick session of the mock bench that `calibench run --quick` starts. `puzzle`: a camera of the independent
simulator with the same two filters concealed, of which `tests/lab/diagnose/test_example.py` makes the same recordings.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from evaluation.independent_simulator.laws import InfraredCutFilterLaw, OpticalLowPassFilterLaw
from lab.formats.recording_set import RecordingSet, write

SEED, LOW_PASS_UM, BELOW_720_NM = 20751, 1.6, 60.0  # the filter's edge lies that far below 720 nm


def puzzle() -> RecordingSet:
    """The concealed camera's session."""
    laws = [OpticalLowPassFilterLaw(LOW_PASS_UM), InfraredCutFilterLaw(BELOW_720_NM)]
    camera = ConcealedCamera(SEED, laws, cfa="RGGB", f_number=4.0, rows=180, cols=240)
    return recordings_of(camera, Plan(("dark", "flat", "narrowband", "slanted_edge")))


def bench(out: Path) -> None:
    """A quick session of the mock bench, written to `out`."""
    with tempfile.TemporaryDirectory() as data:
        run = [sys.executable, "-m", "calibench"]
        subprocess.run([*run, "capture", "--quick", "--out", data], check=True)
        (session,) = (path.name for path in (Path(data) / "sessions").iterdir())
        subprocess.run([*run, "export", session, "--to", str(out), "--data", data], check=True)


if __name__ == "__main__":
    folder = Path(sys.argv[1]) / sys.argv[2]
    if sys.argv[2] == "bench":
        bench(folder)
    else:
        write(puzzle(), folder)
