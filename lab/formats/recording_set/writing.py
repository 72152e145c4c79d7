"""Writing a recording set as a folder: completely, or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path, PurePosixPath

import numpy as np
import tifffile

from lab.capture_kinds.base import Names, names_in
from lab.errors import InputError, one_line
from lab.formats.recording_set.checks import inspect
from lab.formats.recording_set.manifest import RecordingError, manifest_json
from lab.formats.recording_set.recordings import RecordingSet
from lab.formats.spectrum_csv import format_spectrum


def _write_into(recordings: RecordingSet, root: Path) -> None:
    def place(path: str) -> Path:
        pure = PurePosixPath(path)
        if "\\" in path or pure.is_absolute() or ".." in pure.parts or path == "manifest.json":
            raise InputError(
                f"{recordings.source}: the path '{path}' leaves the folder; name it frames/..., spectra/..."
            )
        file = root / pure
        file.parent.mkdir(parents=True, exist_ok=True)
        return file

    manifest = recordings.manifest
    written: set[str] = set()
    for capture in manifest.captures:
        if capture.frame in written:
            continue
        written.add(capture.frame)
        file, there = place(capture.frame), recordings.file(capture.frame)
        if there is not None:
            shutil.copyfile(there, file)  # byte by byte, whatever the format
            continue
        frame = recordings.frame(capture)
        if file.suffix == ".npy":
            np.save(file, frame, allow_pickle=False)
        elif file.suffix in (".tif", ".tiff"):
            tifffile.imwrite(file, frame, photometric="minisblack", metadata=None)
        else:
            raise InputError(f"{recordings.source}: can't write a frame to '{capture.frame}'; name it .npy or .tif")
    named = [(what, path) for capture in manifest.captures for _, what, path in names_in(capture)]
    spectra = {path for what, path in named if what is Names.SPECTRUM}
    for camera in manifest.cameras.values():
        spectra |= set((camera.quantum_efficiency or {}).values())
        if camera.lens_file is not None and (there := recordings.file(camera.lens_file)) is not None:
            shutil.copyfile(there, place(camera.lens_file))
    for path in spectra:
        there = recordings.file(path)
        text = format_spectrum(recordings.spectrum(path)) if there is None else there.read_text(encoding="utf-8")
        place(path).write_text(text, encoding="utf-8")
    for path in {path for what, path in named if what is Names.TARGET}:
        np.save(place(path), recordings.target(path), allow_pickle=False)
    (root / "manifest.json").write_text(manifest_json(manifest), encoding="utf-8")


def write(recordings: RecordingSet, path: str | os.PathLike[str]) -> Path:
    """Write a recording set as the folder `path`: completely, or not at all. Frames stay bit-exact.

    Raises InputError where `path` exists and isn't an empty folder, and RecordingError where the set itself would be
    refused by `read`.
    """
    folder = Path(path)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: already exists; give a new folder, or take that one away")
    problems, _ = inspect(recordings)
    if problems:
        raise RecordingError(problems)
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".partial", dir=folder.parent))
    try:
        _write_into(recordings, partial)
        partial.chmod(0o755)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise InputError(
            f"{folder}: can't be written ({one_line(error)}); make room or choose another folder"
        ) from error
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return folder
