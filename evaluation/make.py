"""Write sealed cases: recording sets in a folder, and their truths outside it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from evaluation.draw import draw
from evaluation.draw_unlisted import draw_unlisted
from evaluation.truth import SIZES, CaseTruth, Laws, Seals, Truths, digest, load, purpose_of, salted, seal, store
from lab.errors import InputError
from lab.formats import recording_set
from lab.one_blas_thread import one_blas_thread
from lab.workers import Workers

#: Modification time of all files of the cases, s since 1970, so that times reveal nothing.
FILE_TIME_S = 1_772_442_000


@one_blas_thread
def _write_case(index: int, out: Path, seed: int, size: str, cfa: str | None, laws: Laws) -> CaseTruth:
    """Draw one case and write its recording set; the truth with the set's digest."""
    folder = out / case_name(index)
    case = (draw if laws == "listed" else draw_unlisted)(seed, index, size, cfa=cfa)
    if folder.exists():  # of a run that was stopped between this set and its truth
        shutil.rmtree(folder)
    recording_set.write(case.recordings, folder)
    for path in (folder, *folder.rglob("*")):
        os.utime(path, (FILE_TIME_S, FILE_TIME_S))
    return case.truth.model_copy(update={"recordings_sha256": digest(folder)})


def case_name(index: int) -> str:
    return f"case-{index:04d}"


def make(
    out: Path, cases: int, seed: int, truths_file: Path, size: str, workers: Workers, *, cfa: str | None = None,
    laws: Laws = "listed", progress: Callable[[str, float], None] = lambda _text, _share: None,
) -> Truths:  # fmt: skip
    """Write the cases that are missing.

    Raises InputError where the truths would lie among the recordings, or where cases of another seed, size or
    number, or of other laws, exist there.
    """
    out, truths_file = out.resolve(), truths_file.resolve()
    if out in truths_file.parents or truths_file == out:
        raise InputError(f"{truths_file}: lies within the folder of the cases {out}; give a file outside it")
    if size not in SIZES:
        raise InputError(f"size {size!r}: there is none; take one of {', '.join(SIZES)}")
    held = Truths(purpose=purpose_of(seed), seed=seed, size=size, cases=cases, laws=laws)
    if truths_file.exists():
        there = load(Truths, truths_file)
        if (there.seed, there.size, there.cases, there.laws) != (seed, size, cases, laws):
            raise InputError(
                f"{truths_file}: holds the truths of {there.cases} cases of size {there.size} with {there.laws} laws, "
                "of another seed, size, number or other laws than asked for; give another file, or remove it"
            )
        held = there
    elif out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: isn't empty, and {truths_file} isn't there to go on from; give a new folder")
    out.mkdir(parents=True, exist_ok=True)
    truths = dict(held.truths)
    missing = [i for i in range(1, cases + 1) if case_name(i) not in truths or not (out / case_name(i)).is_dir()]

    def keep(index: int, truth: CaseTruth) -> None:
        nonlocal held
        truths[case_name(index)] = salted(truth)
        held = held.model_copy(update={"truths": dict(sorted(truths.items()))})
        store(held, truths_file, mode=0o600)
        store(Seals(seals={name: seal(item) for name, item in held.truths.items()}), out / "seals.json")
        progress(f"{len(truths)} of {cases} cases", len(truths) / cases)

    for number, truth in workers.done(_write_case, missing, out, seed, size, cfa, laws):
        keep(missing[number], truth)
    return held
