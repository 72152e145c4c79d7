"""Where a recording set's frames, spectra and targets come from: a folder, memory, or a combination of other
sources."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np
import rawpy
from numpy.typing import NDArray

from lab.errors import InputError, one_line
from lab.formats.pictures import picture_facts, read_picture
from lab.formats.recording_set.manifest import DataSheet
from lab.formats.spectrum_csv import parse_spectrum
from sim.spectrum import Spectrum

Frame = NDArray[np.uint16]
Target = NDArray[np.uint8]

#: Endings of camera raws that LibRaw reads.
RAWS = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")


def locate(root: Path, path: str) -> Path:
    """Return the file of a recording set at a path in its folder.

    root : the folder
    path : as the manifest states it, with forward slashes

    Raises InputError for a path that is absolute or leads out of the folder, isn't there, or can't be read.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     (Path(folder) / "frames").mkdir()
    ...     (Path(folder) / "frames" / "dark-1.npy").touch()
    ...     locate(Path(folder), "frames/dark-1.npy").name
    'dark-1.npy'
    """
    pure = PurePosixPath(path)
    if not path or "\\" in path or pure.is_absolute() or (len(path) > 1 and path[1] == ":"):
        raise InputError("not a path relative to the folder with '/'; move the file into the folder and name it so")
    file = root / pure
    try:
        inside, exists, is_file = file.resolve().is_relative_to(root.resolve()), file.exists(), file.is_file()
    except (OSError, ValueError, RuntimeError) as error:  # a loop of links, a NUL, a name too long
        raise InputError(f"no usable path ({one_line(error)}); rename the file") from error
    if not inside:
        raise InputError("leads out of the folder; copy the file into the folder and name it by its relative path")
    if not exists:
        others = _in_other_case(root, pure)
        near = f" (there is {', '.join(others)}: capitals count; rename it)" if others else ""
        raise InputError(f"no such file{near}; add it, or take what needs it out of the manifest")
    if not is_file:
        raise InputError("not a file; name the file itself")
    if not os.access(file, os.R_OK):
        raise InputError(
            "can't be read (Permission denied); run it as the user to whom it belongs, or have its permissions changed"
        )
    return file


def _in_other_case(root: Path, path: PurePosixPath) -> list[str]:
    """Return the paths below `root` that differ from `path` by capitals alone."""
    reached = [root]
    for part in path.parts:
        if part == "..":
            return []
        reached = [
            entry
            for folder in reached
            if folder.is_dir()
            for entry in folder.iterdir()
            if entry.name.casefold() == part.casefold()
        ]
    return [entry.relative_to(root).as_posix() for entry in reached]


def locate_as_written(root: Path, path: str) -> tuple[Path, str | None]:
    """Return the file at a path of an index that a person or another system wrote, and a remark where its name isn't
    exactly that: separators as Windows has them, or other capitals, where just one file is meant. Raises InputError as
    `locate`."""
    named = path.replace("\\", "/") if "/" not in path else path
    others = [] if (root / named).exists() else _in_other_case(root, PurePosixPath(named))
    taken = others[0] if len(others) == 1 else named
    file = locate(root, taken)
    return file, None if taken == path else f"{path} is taken to be {taken}"


def _load_npy(file: Path, dtype: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """Return a two-dimensional .npy of `dtype` in either byte order."""
    try:
        # Mapped: a damaged header may announce terabytes, which must not be allocated.
        mapped = np.load(file, mmap_mode="r", allow_pickle=False)
    except Exception as error:
        raise InputError(f"damaged .npy ({one_line(error)}); write it again or recapture") from error
    if not isinstance(mapped, np.ndarray):
        raise InputError("an archive of arrays; save one array with numpy.save")
    wanted = np.dtype(dtype)
    if mapped.dtype != wanted and mapped.dtype.newbyteorder("=") != wanted:
        raise InputError(f"its numbers are {mapped.dtype}, not {wanted}; save raw DN as {wanted}")
    if mapped.ndim != 2:
        raise InputError(f"has {mapped.ndim} dimensions, not 2; save one (rows, cols) array")
    return np.array(mapped, dtype=wanted, order="C")


def _load_tif(file: Path, wanted: tuple[int, int] | None = None) -> NDArray[Any]:
    """Return a TIFF of one page, 16 bit, one sample a pixel. One of another shape than `wanted` isn't decoded: it may
    be far larger than its file."""
    facts = picture_facts(file)
    shape = facts.shape or ()
    if facts.pages != 1:
        raise InputError(f"has {facts.pages} pages, not 1; save one file a frame")
    if facts.dtype != np.uint16:
        raise InputError(f"its samples are {facts.dtype}, not uint16; save raw DN as 16 bit")
    if len(shape) != 2:
        raise InputError(f"has the shape {shape}, not (rows, cols); save the mosaic, not colours")
    if wanted is not None and wanted != shape:
        raise InputError(
            f"{shape[0]} x {shape[1]} pixels (rows x cols), but the manifest says {wanted[0]} x {wanted[1]}; "
            "recapture, or correct rows and cols"
        )
    return read_picture(file)


def _load_raw(file: Path, shape: tuple[int, int] | None = None) -> NDArray[Any]:
    """Return the mosaic of a camera raw: its visible area, or the whole sensor where only that has `shape`."""
    try:
        with rawpy.imread(str(file)) as raw:
            visible, whole = raw.raw_image_visible, raw.raw_image
            chosen = whole if shape not in (None, visible.shape) and whole.shape == shape else visible
            frame = np.array(chosen, dtype=np.uint16, order="C")
    except Exception as error:
        raise InputError(f"damaged raw ({one_line(error)}); copy it again or recapture") from error
    if frame.ndim != 2:
        raise InputError("holds no mosaic (a linear DNG); save the raw itself")
    return frame


def load_frame(file: Path, shape: tuple[int, int] | None = None) -> Frame:
    """Return a frame as stored: uint16 (rows, cols).

    file : .npy, .tif, .tiff or a camera raw
    shape : rows and columns that it has, where they are known

    Raises InputError, without the path, for what isn't a frame.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "dark-1.npy"
    ...     np.save(file, np.full((4, 6), 64, np.uint16))
    ...     load_frame(file, (4, 6)).shape
    (4, 6)
    """
    suffix = file.suffix.lower()
    if suffix == ".npy":
        return _load_npy(file, np.uint16)
    if suffix in (".tif", ".tiff"):
        return _load_tif(file, shape)
    if suffix in RAWS:
        return _load_raw(file, shape)
    raise InputError(f"a frame can't be {suffix or 'without an ending'}; give .npy, .tif or .dng")


def load_target(file: Path) -> Target:
    """Return a screen's pattern from an .npy file: uint8 (rows, cols) of 0 and 1. Its InputError leaves the path to the
    caller."""
    if file.suffix.lower() != ".npy":
        raise InputError(f"a target can't be {file.suffix or 'without an ending'}; give .npy (uint8)")
    return checked_target(_load_npy(file, np.uint8))


def checked_target(target: Target) -> Target:
    """Return the target itself. Raises InputError where it holds other numbers than 0 and 1."""
    if target.size == 0 or int(target.max()) > 1:
        raise InputError("holds other numbers than 0 and 1; save what was shown as 0 (dark) and 1 (lit)")
    return target


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
        return load_frame(locate(self.root, path), camera.frame_shape)

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
