"""Where a recording set's frames, spectra and targets come from: a folder, memory, or a combination of other
sources."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lab.errors import InputError, one_line
from lab.formats.recording_set.frame_files import Frame, Target, checked_target, load_frame, load_target, locate
from lab.formats.recording_set.manifest import DataSheet
from lab.formats.spectrum_csv import parse_spectrum
from sim.spectrum import Spectrum


class RecordingFiles(Protocol):
    """Frames, spectra and targets by the manifest's path. An InputError says what is wrong, without the path."""

    def frame(self, path: str, camera: DataSheet) -> Frame: ...
    def spectrum(self, path: str) -> Spectrum: ...
    def target(self, path: str) -> Target: ...
    def file(self, path: str) -> Path | None: ...
    def where(self, path: str) -> str: ...


class FolderFiles:
    """Frames, spectra and targets as files below `root`. Importers override what they decode themselves."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def __getstate__(self) -> dict[str, Any]:
        """For another process, which may have another working directory."""
        return self.__dict__ | {"root": self.root.resolve()}

    def file(self, path: str) -> Path | None:
        return locate(self.root, path)

    def frame(self, path: str, camera: DataSheet) -> Frame:
        return load_frame(locate(self.root, path), (camera.rows, camera.cols))

    def spectrum(self, path: str) -> Spectrum:
        try:
            text = locate(self.root, path).read_text(encoding="utf-8")
        except (UnicodeDecodeError, OSError) as error:
            raise InputError(f"can't be read as text ({one_line(error)}); save it as CSV in UTF-8") from error
        return parse_spectrum(text)

    def target(self, path: str) -> Target:
        return load_target(locate(self.root, path))

    def where(self, path: str) -> str:
        return str(self.root / path) if not PurePosixPath(path).is_absolute() else path


class MemoryFiles:
    """Frames, spectra and targets in memory, by the manifest's path."""

    def __init__(
        self, frames: Mapping[str, NDArray[Any]], spectra: Mapping[str, Spectrum], targets: Mapping[str, NDArray[Any]]
    ) -> None:
        # Not copied: `frames` may be a mapping that decodes on access.
        self.frames, self.spectra, self.targets = frames, spectra, targets

    def file(self, path: str) -> Path | None:
        return None

    def frame(self, path: str, camera: DataSheet) -> Frame:
        if path not in self.frames:
            raise InputError("no such frame; give it in `frames`")
        frame = np.asarray(self.frames[path])
        if frame.dtype != np.uint16 or frame.ndim != 2:
            raise InputError(
                f"is {frame.dtype} with {frame.ndim} dimensions; give raw DN as a 2-dimensional uint16 array"
            )
        return frame.copy()

    def spectrum(self, path: str) -> Spectrum:
        if path not in self.spectra:
            raise InputError("no such spectrum; give it in `spectra`")
        spectrum = self.spectra[path]
        if not (np.all(np.isfinite(spectrum.wavelength_nm)) and np.all(np.isfinite(spectrum.value))):
            raise InputError("isn't finite; leave unknown samples out")
        return spectrum

    def target(self, path: str) -> Target:
        if path not in self.targets:
            raise InputError("no such target; give it in `targets`")
        target = np.asarray(self.targets[path])
        if target.dtype != np.uint8 or target.ndim != 2:
            raise InputError(f"is {target.dtype} with {target.ndim} dimensions; give a 2-dimensional uint8 array")
        return checked_target(target.copy())

    def where(self, path: str) -> str:
        return path


class OverlaidFiles:
    """Other files with some of the frames replaced."""

    def __init__(self, below: RecordingFiles, frames: Mapping[str, NDArray[Any]]) -> None:
        self._below, self._above = below, MemoryFiles(frames, {}, {})

    def file(self, path: str) -> Path | None:
        return self._below.file(path)

    def frame(self, path: str, camera: DataSheet) -> Frame:
        return (self._above if path in self._above.frames else self._below).frame(path, camera)

    def spectrum(self, path: str) -> Spectrum:
        return self._below.spectrum(path)

    def target(self, path: str) -> Target:
        return self._below.target(path)

    def where(self, path: str) -> str:
        return self._below.where(path)


class JoinedFiles:
    """`first`, and `later` under paths that begin with `folder`."""

    def __init__(self, first: RecordingFiles, later: RecordingFiles, folder: str) -> None:
        self._first, self._later, self._folder = first, later, f"{folder}/"

    def _of(self, path: str) -> tuple[RecordingFiles, str]:
        return (self._later, path.removeprefix(self._folder)) if path.startswith(self._folder) else (self._first, path)

    def file(self, path: str) -> Path | None:
        files, its = self._of(path)
        return files.file(its)

    def frame(self, path: str, camera: DataSheet) -> Frame:
        files, its = self._of(path)
        return files.frame(its, camera)

    def spectrum(self, path: str) -> Spectrum:
        files, its = self._of(path)
        return files.spectrum(its)

    def target(self, path: str) -> Target:
        files, its = self._of(path)
        return files.target(its)

    def where(self, path: str) -> str:
        files, its = self._of(path)
        return files.where(its)
