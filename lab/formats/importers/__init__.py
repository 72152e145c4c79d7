"""Importers: other formats as recording sets. Each turns a path into a `RecordingSet` whose frames are decoded when asked for;
`lab.formats.recording_set.write` checks it and puts it on disk, completely or not at all. The set's `warnings` and `notes` say what an
importer left out, assumed or didn't find."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lab.errors import InputError
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.importers.raw_folder import read_checkerboard_pairs, read_raw_folder
from lab.formats.recording_set import RecordingSet

#: `--from KIND` -> its importer.
KINDS: dict[str, Callable[[Path], RecordingSet]] = {"emva1288": read_emva1288, "raw-folder": read_raw_folder}
__all__ = ["KINDS", "read_checkerboard_pairs", "read_emva1288", "read_foreign", "read_raw_folder"]


def read_foreign(kind: str, path: Path) -> RecordingSet:
    """The recordings at `path`, which are of `kind`; InputError where there is no such kind or they can't be used."""
    if kind not in KINDS:
        raise InputError(f"--from {kind}: no such format; choose {' or '.join(KINDS)}")
    if not path.exists():
        raise InputError(f"{path}: no such folder; give the folder of the recordings")
    return KINDS[kind](path)
