"""Diagnosis of the cases of a challenge, each by itself: existing results are kept, and a case that fails doesn't end
the run."""

from __future__ import annotations

import contextlib
import resource
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from evaluation.truth import load, store
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import DiagnosisResult
from lab.workers import Workers
from sim.parameters import Frozen


class CaseRun(Frozen):
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


def run_case(folder: Path, policy: DecisionPolicy | None = None) -> CaseRun:
    """Diagnose the recording set in `folder`. `policy`: the rules of decision; None: the default ones. An exception
    becomes `error`."""
    from lab.diagnose import examine
    from lab.formats import recording_set as recording

    with contextlib.suppress(OSError):  # Linux: the peak begins anew
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    wall, cpu = time.perf_counter(), time.process_time()
    found, error = None, None
    try:
        result = examine(recording.read(folder), at_once=False, policy=policy).result
        found = result.model_copy(update={"curves": (), "source": folder.name})
    except Exception as caught:  # any error is the result of its case
        at = traceback.extract_tb(caught.__traceback__)[-1]
        error = f"{type(caught).__name__}: {' '.join(str(caught).split())} ({Path(at.filename).name}:{at.lineno})"
    return CaseRun(
        case=folder.name, wall_s=time.perf_counter() - wall, cpu_s=time.process_time() - cpu, memory_mib=_peak_mib(),
        error=error, diagnosis=found
    )  # fmt: skip


def run_all(
    folder: Path,
    cases: tuple[str, ...],
    workers: Workers,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    *,
    policy: DecisionPolicy | None = None,
    results: str = "results",
) -> dict[str, CaseRun]:
    """Case -> result: from FOLDER/RESULTS/CASE.json where it exists, else diagnosed now and written there."""
    file = {case: folder / results / f"{case}.json" for case in cases}
    runs = {case: load(CaseRun, file[case]) for case in cases if file[case].exists()}
    missing = [case for case in cases if case not in runs]

    def keep(result: CaseRun) -> None:
        store(result, file[result.case])
        runs[result.case] = result
        progress(f"{len(runs)} of {len(cases)} cases", len(runs) / len(cases))

    # workers elsewhere know the folder by its whole path
    for _, result in workers.done(run_case, [folder.resolve() / case for case in missing], policy):
        keep(result)
    return runs
