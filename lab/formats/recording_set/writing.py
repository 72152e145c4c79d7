"""Writing a recording set as a folder: completely, or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path, PurePosixPath

import numpy as np
import tifffile

from lab.capture_kinds.base import Capture, Names, names_in
from lab.errors import InputError, one_line
from lab.formats.recording_set.checks import inspect
from lab.formats.recording_set.frame_files import Frame
from lab.formats.recording_set.manifest import RecordingError, manifest_json
from lab.formats.recording_set.recordings import RecordingSet
from lab.formats.spectrum_csv import format_spectrum


def _place(recordings: RecordingSet, root: Path, path: str) -> Path:
    """The file below `root` that the manifest calls `path`; its folder is made."""
    pure = PurePosixPath(path)
    if "\\" in path or pure.is_absolute() or ".." in pure.parts or path == "manifest.json":
        raise InputError(f"{recordings.source}: the path '{path}' leaves the folder; name it frames/..., spectra/...")
    file = root / pure
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


def _write_frame(recordings: RecordingSet, root: Path, path: str, frame: Frame) -> None:
    file, there = _place(recordings, root, path), recordings.file(path)
    if there is not None:
        shutil.copyfile(there, file)  # byte by byte, whatever the format
    elif file.suffix == ".npy":
        np.save(file, frame, allow_pickle=False)
    elif file.suffix in (".tif", ".tiff"):
        tifffile.imwrite(file, frame, photometric="minisblack", metadata=None)
    else:
        raise InputError(f"{recordings.source}: can't write a frame to '{path}'; name it .npy or .tif")


def _write_rest(recordings: RecordingSet, root: Path) -> None:
    """Spectra, targets, lens files and the manifest."""
    manifest = recordings.manifest
    named = [(what, path) for capture in manifest.captures for _, what, path in names_in(capture)]
    spectra = {path for what, path in named if what is Names.SPECTRUM}
    for camera in manifest.cameras.values():
        spectra |= set((camera.quantum_efficiency or {}).values())
        if camera.lens_file is not None and (there := recordings.file(camera.lens_file)) is not None:
            shutil.copyfile(there, _place(recordings, root, camera.lens_file))
    for path in spectra:
        there = recordings.file(path)
        text = format_spectrum(recordings.spectrum(path)) if there is None else there.read_text(encoding="utf-8")
        _place(recordings, root, path).write_text(text, encoding="utf-8")
    for path in {path for what, path in named if what is Names.TARGET}:
        np.save(_place(recordings, root, path), recordings.target(path), allow_pickle=False)
    (root / "manifest.json").write_text(manifest_json(manifest), encoding="utf-8")


def write(
    recordings: RecordingSet, path: str | os.PathLike[str], *, progress: Callable[[str, float], None] | None = None
) -> Path:
    """Write a recording set as the folder `path`: completely, or not at all. Frames stay bit-exact; each is read once. `progress` is called
    after each with its capture's id and the share of them.

    Raises InputError where `path` exists and isn't an empty folder, and RecordingError where the set itself would be
    refused by `read`.
    """
    folder = Path(path)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: already exists; give a new folder, or take that one away")
    made: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".partial", dir=folder.parent))
        written: set[str] = set()

        def loaded(capture: Capture, frame: Frame, share: float) -> None:
            if capture.frame not in written:
                written.add(capture.frame)
                _write_frame(recordings, partial, capture.frame, frame)
            if progress is not None:
                progress(capture.id, share)

        problems, _ = inspect(recordings, loaded)
        if problems:
            raise RecordingError(problems)  # noqa: TRY301
        _write_rest(recordings, partial)
        partial.chmod(0o755)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    except BaseException as error:
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)
        if not isinstance(error, OSError):
            raise
        raise InputError(
            f"{folder}: can't be written ({one_line(error)}); make room or choose another folder"
        ) from error
    return folder
