"""Reading a folder as a recording set."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from lab.errors import InputError, one_line
from lab.formats.recording_set.checks import inspect
from lab.formats.recording_set.files import FolderFiles
from lab.formats.recording_set.frame_files import locate
from lab.formats.recording_set.manifest import RecordingError, parse_manifest
from lab.formats.recording_set.recordings import RecordingSet


def read(path: str | os.PathLike[str], *, progress: Callable[[str], None] | None = None) -> RecordingSet:
    """Return the recording set in the folder `path`, completely checked.

    Raises RecordingError (an InputError) with one line for everything that can't be used. Unknown keys, skipped kinds
    and the like stand in `.warnings`.
    """
    root = Path(path)
    if root.name == "manifest.json" and root.is_file():
        root = root.parent
    if not root.is_dir():
        raise RecordingError([f"{root}: no such folder; give the folder of a recording set"])
    if root.is_dir() and not (root / "manifest.json").exists():
        raise RecordingError(
            [f"{root}: no recording set: it has no manifest.json; `calibench import` and `calibench export` write one"]
        )
    try:
        text = locate(root, "manifest.json").read_text(encoding="utf-8-sig")
    except (InputError, OSError, UnicodeDecodeError) as error:
        raise RecordingError([f"{root / 'manifest.json'}: {one_line(error)}"]) from error
    manifest, skipped = parse_manifest(text, str(root / "manifest.json"))
    recordings = RecordingSet(manifest, source=str(root), files=FolderFiles(root))
    if progress:
        progress(f"looking through {len(manifest.captures)} captures")
    problems, warnings = inspect(recordings)
    if problems:
        raise RecordingError([*skipped, *problems])  # a skipped capture may be the cause of a problem
    recordings.warnings = (*skipped, *warnings)
    return recordings
