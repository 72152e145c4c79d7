"""A recording set as a folder: read, written, and packed as one archive."""

from __future__ import annotations

import io
import os
import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
import tifffile

from lab.capture_kinds.base import Capture, Names, names_in
from lab.errors import InputError, one_line
from lab.formats.recording_set.checks import inspect
from lab.formats.recording_set.files import FolderFiles, Frame, locate
from lab.formats.recording_set.manifest import RecordingError, manifest_json, parse_manifest
from lab.formats.recording_set.recordings import RecordingSet
from lab.formats.spectrum_csv import format_spectrum


def read(path: str | os.PathLike[str], *, progress: Callable[[str], None] | None = None) -> RecordingSet:
    """Return the recording set in the folder `path`, completely checked.

    path : the folder, or its manifest.json
    progress : called with a line of text when the captures are looked through

    Raises RecordingError (an InputError) with one line for everything that can't be used. Unknown keys, skipped kinds
    and the like stand in `.warnings`.

    >>> import calibench
    >>> calibench.write(calibench.open_recordings("my-camera"), "my-set").name
    'my-set'
    >>> recordings = calibench.read("my-set")
    >>> recordings.sides
    ('left',)
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


MANIFEST = "manifest.json"


def _place(recordings: RecordingSet, root: Path, path: str) -> Path:
    """Return the file below `root` that the manifest calls `path`; its folder is made."""
    pure = PurePosixPath(path)
    if "\\" in path or pure.is_absolute() or ".." in pure.parts or path == MANIFEST:
        raise InputError(f"{recordings.source}: the path '{path}' leaves the folder; name it frames/..., spectra/...")
    file = root / pure
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


def _frame_content(recordings: RecordingSet, path: str, frame: Frame) -> bytes:
    """Return a frame as a file of the format that its name says: the set's own file, byte by byte, where it has one."""
    if (there := recordings.file(path)) is not None:
        return there.read_bytes()
    buffer, suffix = io.BytesIO(), PurePosixPath(path).suffix
    if suffix == ".npy":
        np.save(buffer, frame, allow_pickle=False)
    elif suffix in (".tif", ".tiff"):
        tifffile.imwrite(buffer, frame, photometric="minisblack", metadata=None)
    else:
        raise InputError(f"{recordings.source}: can't write a frame to '{path}'; name it .npy or .tif")
    return buffer.getvalue()


def _rest(recordings: RecordingSet) -> Iterator[tuple[str, bytes]]:
    """Path and content of spectra, targets and lens files."""
    manifest = recordings.manifest
    named = [(what, path) for capture in manifest.captures for _, what, path in names_in(capture)]
    spectra = {path for what, path in named if what is Names.SPECTRUM}
    for camera in manifest.cameras.values():
        spectra |= set((camera.quantum_efficiency or {}).values())
        if camera.lens_file is not None and (there := recordings.file(camera.lens_file)) is not None:
            yield camera.lens_file, there.read_bytes()
    for path in sorted(spectra):
        there = recordings.file(path)
        yield path, format_spectrum(recordings.spectrum(path)).encode() if there is None else there.read_bytes()
    for path in sorted({path for what, path in named if what is Names.TARGET}):
        buffer = io.BytesIO()
        np.save(buffer, recordings.target(path), allow_pickle=False)
        yield path, buffer.getvalue()


def contents(recordings: RecordingSet) -> Iterator[tuple[str, bytes]]:
    """Path and content of every file of the set as a folder, frames first, one at a time. Each frame is checked as it
    is read."""
    written: set[str] = set()
    for capture in recordings.manifest.captures:
        if capture.frame not in written:
            written.add(capture.frame)
            yield capture.frame, _frame_content(recordings, capture.frame, recordings.whole_frame(capture))
    yield from _rest(recordings)
    yield MANIFEST, manifest_json(recordings.manifest).encode()


def write(
    recordings: RecordingSet,
    path: str | os.PathLike[str],
    *,
    progress: Callable[[str, float], None] | None = None,
    report_warnings: Callable[[list[str]], None] | None = None,
) -> Path:
    """Write a recording set as the folder `path`: completely, or not at all. Frames stay bit-exact; each is read once.

    recordings : the set
    path : a new or an empty folder
    progress : called after each frame with its capture's id and the share of them
    report_warnings : called with the warnings of the checks, which `read` gives again

    Returns the folder. Raises InputError where `path` exists and isn't an empty folder, and RecordingError where the
    set itself would be refused by `read`.

    >>> import calibench
    >>> folder = calibench.write(calibench.open_recordings("my-camera"), "my-set")
    >>> (folder / "manifest.json").is_file()
    True
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
                content = _frame_content(recordings, capture.frame, frame)
                _place(recordings, partial, capture.frame).write_bytes(content)
            if progress is not None:
                progress(capture.id, share)

        problems, warnings = inspect(recordings, loaded)
        if problems:
            raise RecordingError(problems)  # noqa: TRY301
        for name, content in _rest(recordings):
            _place(recordings, partial, name).write_bytes(content)
        (partial / MANIFEST).write_text(manifest_json(recordings.manifest), encoding="utf-8")
        partial.chmod(0o755)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
        if report_warnings is not None:
            report_warnings(warnings)
    except BaseException as error:
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)
        if not isinstance(error, OSError):
            raise
        raise InputError(
            f"{folder}: can't be written ({one_line(error)}); make room or choose another folder"
        ) from error
    return folder


#: A .zip has its list of files at the end; a .tar can be unpacked while it arrives.
ArchiveForm = Literal["zip", "tar"]


class _Sent(io.RawIOBase):
    """A write-only file whose content is taken away piece by piece."""

    def __init__(self) -> None:
        self._held = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, piece: object) -> int:
        written = bytes(piece)  # type: ignore[call-overload]
        self._held += written
        return len(written)

    def taken(self) -> bytes:
        """Return what came since the last call."""
        held, self._held = bytes(self._held), bytearray()
        return held


def packed(files: Iterable[tuple[str, bytes]], form: ArchiveForm = "zip") -> Iterator[bytes]:
    """Yield the pieces of an archive of files, (path, content) each: one of them in memory at a time, stored without
    compression. Where `files` raises, the archive has no end (a .zip: no list of files), so nobody takes it for a whole
    one."""
    sent = _Sent()
    if form == "tar":
        with tarfile.open(fileobj=sent, mode="w|") as tar:
            for path, content in files:
                member = tarfile.TarInfo(path)
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
                yield sent.taken()
    else:
        # Closed after an error, too; what that writes isn't sent.
        with zipfile.ZipFile(sent, "w", zipfile.ZIP_STORED) as made:
            for path, content in files:
                made.writestr(zipfile.ZipInfo(path), content)
                yield sent.taken()
    yield sent.taken()


def archive(recordings: RecordingSet, form: ArchiveForm = "zip") -> Iterator[bytes]:
    """Yield the pieces of an archive of the set, as `packed` makes it. Raises InputError where a frame is missing or
    damaged."""
    return packed(contents(recordings), form)
