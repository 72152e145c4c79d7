"""The diagnosis of one case: a case that fails is a result, too."""

from __future__ import annotations

import contextlib
import resource
import time
import traceback
from pathlib import Path

from evaluation.experiment import CaseResult
from lab.diagnose.policy import DecisionPolicy
from lab.engine import DEFAULT_ENGINE, Engine
from lab.formats.results import DiagnosisResult


class CaseRun(CaseResult):
    """The diagnosis of one case, without its curves, and its cost; `error`: why there is none. `memory_mib`: peak of
    the process."""

    case: str
    wall_s: float
    cpu_s: float
    memory_mib: float
    error: str | None = None
    diagnosis: DiagnosisResult | None = None


def _peak_mib() -> float:
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def run_case(folder: Path, policy: DecisionPolicy | None = None, engine: Engine = DEFAULT_ENGINE) -> CaseRun:
    """Diagnose the recording set in `folder`. `policy`: the rules of decision; None: the default ones. An exception
    becomes `error`."""
    from lab.diagnose import examine
    from lab.formats import recording_set as recording

    with contextlib.suppress(OSError):  # Linux: the peak begins anew
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    wall, cpu = time.perf_counter(), time.process_time()
    found, error = None, None
    try:
        result = examine(recording.read(folder), at_once=False, policy=policy, engine=engine).result
        found = result.model_copy(update={"curves": (), "source": folder.name})
    except Exception as caught:  # any error is the result of its case
        at = traceback.extract_tb(caught.__traceback__)[-1]
        error = f"{type(caught).__name__}: {' '.join(str(caught).split())} ({Path(at.filename).name}:{at.lineno})"
    return CaseRun(
        case=folder.name, wall_s=time.perf_counter() - wall, cpu_s=time.process_time() - cpu, memory_mib=_peak_mib(),
        error=error, diagnosis=found
    )  # fmt: skip
