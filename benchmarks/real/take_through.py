"""One set through import, fit and diagnose, and what that takes.

`python -m benchmarks.real.take_through FOLDER OUT [--engine evidence]` is the process of one set: FOLDER holds the
recordings, OUT what is declared of them, and then `fit.json` and `diagnose.json`.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import get_args

from benchmarks.real.sets import TABLE, DeclaredSet
from evaluation.truth import load, store
from lab.engine import DEFAULT_ENGINE, Engine
from lab.errors import InputError
from lab.formats.results import DiagnosisResult, FitResult
from sim.parameters import Frozen

ROOT = Path(__file__).parents[2]
DECLARED, FIT, DIAGNOSIS, COST = "declared.json", "fit.json", "diagnose.json", "cost.json"
#: CPU time (s) after which a process is ended.
LONGEST_S = 1800


class Cost(Frozen):
    """What a set took, in CPU seconds of its process and of those that it started, and in the largest resident memory
    of one of them, MB (2^20 bytes). `state`: of code and recordings. `failed`: the last line that it told, where it
    ended otherwise."""

    state: str
    cpu_s: float
    memory_mb: float
    failed: str = ""


def take_through(
    one: DeclaredSet, folder: Path, scratch: Path, engine: Engine = DEFAULT_ENGINE
) -> tuple[FitResult, DiagnosisResult | None]:
    """Import, fit and diagnose a set.

    folder   of the recordings
    scratch  an empty folder, for what the import writes
    engine   which one diagnoses

    Returns the fit and the diagnosis; None for a table of means, which has no frames to diagnose. Raises InputError.
    """
    from lab.diagnose import diagnose
    from lab.fit import FOR_DIAGNOSIS, fit_recording_set
    from lab.fit.spectral.mean_table import fit_mean_table
    from lab.foreign_recordings import read_foreign
    from lab.formats.importers import ImportOptions
    from lab.formats.importers.images import read_camera_file
    from lab.formats.recording_set import read, write

    path = folder
    if one.prepare:
        script = [sys.executable, str(ROOT / "docs" / one.prepare), *([str(folder)] if one.path != "" else [])]
        subprocess.run([*script, str(scratch / "prepared"), one.part], cwd=ROOT, check=True)
        path = scratch / "prepared" / one.part
    if one.importer == TABLE:
        sheet = read_camera_file(path.with_name("camera.toml"), {"left": {"rows": 1, "cols": 1}})
        return fit_mean_table(path, sheet["left"]), None
    if one.importer:
        camera = scratch / "camera.toml" if one.camera else None
        if camera is not None:
            camera.write_text(one.camera, encoding="utf-8")
        options = ImportOptions(
            checkerboard=one.checkerboard,
            square_mm=one.square_mm,
            camera=camera,
            exposure_s=one.exposure_s,
            transfer=one.transfer,
            channel=one.channel,
        )
        path = write(read_foreign(one.importer, path, options), scratch / "set")
    recordings = read(path)
    fit = fit_recording_set(recordings)
    refit = partial(fit_recording_set, steps=FOR_DIAGNOSIS)
    return fit, diagnose(recordings, fit, engine=engine, refit=refit)


def run_set(one: DeclaredSet, folder: Path, out: Path, engine: Engine = DEFAULT_ENGINE) -> Cost:
    """Take a set through in a process of its own. Where `out` holds its results by this code and of these recordings,
    they stand."""
    state = state_of(one, folder) + ("" if engine == DEFAULT_ENGINE else f" {engine}")
    if (out / COST).is_file() and (kept := load(Cost, out / COST)).state == state:
        return kept
    for file in (FIT, DIAGNOSIS, COST):
        (out / file).unlink(missing_ok=True)
    store(one, out / DECLARED)
    command = [sys.executable, "-m", "benchmarks.real.take_through", str(folder), str(out), f"--engine={engine}"]
    with (out / "log.txt").open("w+", encoding="utf-8") as log:
        process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
        _, status, usage = os.wait4(process.pid, 0)
        log.seek(0)
        said = log.read().strip().splitlines() or [f"ended with {status}"]
    process.returncode = os.waitstatus_to_exitcode(status)
    cost = Cost(
        state=state,
        cpu_s=usage.ru_utime + usage.ru_stime,
        memory_mb=usage.ru_maxrss / 1024.0,
        failed=said[-1].replace(str(folder), folder.name) if status else "",
    )
    store(cost, out / COST)
    return cost


def state_of(one: DeclaredSet, folder: Path) -> str:
    """SHA-256, shortened, over the code that decides a set's results, how the set is brought in, and its files' names
    and sizes."""
    found = hashlib.sha256(one.brought_in().encode())
    for part in ("sim", "lab"):
        for file in sorted((ROOT / part).rglob("*")):
            if file.suffix in {".py", ".toml", ".csv"}:
                found.update(str(file.relative_to(ROOT)).encode() + file.read_bytes())
    if one.prepare:
        found.update((ROOT / "docs" / one.prepare).read_bytes())
    if one.path == "":
        return found.hexdigest()[:16]
    for file in sorted(path for path in (folder if folder.is_dir() else folder.parent).rglob("*") if path.is_file()):
        found.update(f"{file.relative_to(folder.parent)} {file.stat().st_size}".encode())
    return found.hexdigest()[:16]


def main(folder: Path, out: Path, engine: Engine = DEFAULT_ENGINE) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (LONGEST_S, LONGEST_S))
    with tempfile.TemporaryDirectory() as scratch:
        try:
            fit, diagnosis = take_through(load(DeclaredSet, out / DECLARED), folder, Path(scratch), engine)
        except InputError as error:
            sys.exit(str(error))
    store(fit, out / FIT)
    if diagnosis is not None:
        store(diagnosis, out / DIAGNOSIS)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--engine", choices=get_args(Engine), default=DEFAULT_ENGINE)
    given = parser.parse_args()
    main(given.folder, given.out, given.engine)
