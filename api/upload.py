"""Recording sets that are sent in: streamed to the disk and unpacked, both with upper limits, into a folder of their
own, and checked there.

`api.unpacking` looks at what the archive states before it writes a byte; the reader of recording sets then checks the
content."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import time
import zipfile
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

from api.unpacking import TooMuch, inside, unpack
from lab.calibration.camera_models import SIDES
from lab.errors import InputError
from lab.foreign_files import put_lens_before
from lab.formats import recording_set as recording
from lab.formats.camera_file import CameraFile, read_camera
from lab.formats.importers.single_picture import ImportOptions
from lab.formats.recording_set import FolderFiles, RecordingSet
from sim.camera import Side

_ID = re.compile(r"[0-9a-f]{16}")
_MANIFEST = "manifest.json"
#: A folder of an upload that a crash left behind is removed when it is older than this (s).
_STALE_S = 86400.0
#: Files of a camera model or of another program's file, at most: two cameras, their curves and arrays.
_MODEL_FILES = 64


def is_recordings(source: str) -> bool:
    """Return whether an id is one of recordings that were sent in, not of a session.

    >>> is_recordings("20300101-101500-7f3ad2")
    False
    """
    return _ID.fullmatch(source) is not None


def check_size(size_bytes: int, limit_bytes: int) -> None:
    """Check the size of an archive, stated or received. Raises TooMuch beyond the limit.

    >>> check_size(100, 1000)
    """
    if size_bytes > limit_bytes:
        raise TooMuch(f"the archive is larger than {limit_bytes} bytes; send less at a time")


async def receive(body: AsyncIterator[bytes], file: BinaryIO, limit_bytes: int) -> int:
    """Write a body to `file` while it arrives; returns its size. Raises TooMuch beyond `limit_bytes`."""
    taken = 0
    async for chunk in body:
        taken += len(chunk)
        check_size(taken, limit_bytes)
        file.write(chunk)
    return taken


@dataclass(frozen=True)
class Foreign:
    """What an archive holds that isn't a recording set: the format, which file or folder of it, and what the format
    doesn't say.

    The files that `statements` name (`camera`, `light`, `white_patch`) are in the archive.
    """

    format: str
    path: str
    statements: ImportOptions

    def read(self, folder: Path) -> RecordingSet:
        """Return the recordings below `folder`. Raises InputError."""
        from lab.foreign_recordings import importers, read_foreign

        known = importers()
        of_a_file = self.format in known and known[self.format].of_a_file
        if of_a_file and not self.path:
            raise InputError(f"path: a recording of the format {self.format} is one file; name it as in the archive")
        stated = self.statements
        there = replace(
            stated,
            camera=stated.camera and located(folder, "camera", str(stated.camera)),
            light=stated.light and located(folder, "light", str(stated.light)),
            white_patch=stated.white_patch and located(folder, "white_patch", str(stated.white_patch)),
        )
        at = located(folder, "path", self.path, a_file=of_a_file) if self.path else folder
        return read_foreign(self.format, at, there)


def located(folder: Path, name: str, path: str, a_file: bool = True) -> Path:
    """Return a file or folder of an unpacked archive. Raises InputError where it isn't in it.

    folder : the archive's, or the one folder in it
    name, path : the parameter that names it, and the name
    """
    named = inside(path)
    place = folder / named
    if not place.exists() and named.parts[0] == folder.name:  # the one folder in which all of the archive is
        place = folder.parent / named
    if not (place.is_file() or (place.is_dir() and not a_file)):
        raise InputError(f"{name} {path[:80]!r}: isn't in the archive; name it as in the archive")
    return place


@dataclass(frozen=True)
class ForeignFile:
    """An unpacked archive with a file of another program and the files that it names."""

    folder: Path

    @classmethod
    def unpacked(cls, place: Path, archive: Path, limit_bytes: int) -> ForeignFile:
        """Unpack it. Raises InputError, and TooMuch beyond the limits."""
        unpack(archive, place / "sent", limit_bytes, _MODEL_FILES)
        return cls(_top(place / "sent", None))

    def file(self, path: str, suffixes: tuple[str, ...]) -> Path:
        """Return the file of that name, or without one the only file that ends so. Raises InputError."""
        if path:
            return located(self.folder, "path", path)
        fitting = [one for one in sorted(self.folder.iterdir()) if one.is_file() and one.suffix.lower() in suffixes]
        if len(fitting) != 1:
            raise InputError(
                f"path: the archive has {len(fitting)} files that end in {', '.join(suffixes)}; name the one that is "
                "meant as in the archive"
            )
        return fitting[0]


@dataclass(frozen=True)
class Inbox:
    """The recording sets that were sent in: `DATA/recordings/ID/`."""

    root: Path

    def ids(self) -> list[str]:
        """Return the ids of all, the newest first."""
        entries = [entry for entry in self.root.glob("*") if _ID.fullmatch(entry.name) and entry.is_dir()]
        return [entry.name for entry in sorted(entries, key=lambda entry: (-entry.stat().st_mtime_ns, entry.name))]

    def folder(self, id: str) -> Path:
        """Return the recording set's folder. Raises InputError where there is none of that id."""
        if not _ID.fullmatch(id) or not (self.root / id).is_dir():
            raise InputError(f"no recordings {id[:60]!r}; list those that were sent in")
        return _top(self.root / id)

    def id_of(self, folder: str) -> str | None:
        """Return the id of the recordings whose folder this is, or None."""
        with contextlib.suppress(ValueError):
            return Path(folder).relative_to(self.root).parts[0]
        return None

    @contextlib.contextmanager
    def receiving(self) -> Iterator[Path]:
        """Yield a temporary folder for an archive while it arrives."""
        self.root.mkdir(parents=True, exist_ok=True)
        for left in self.root.glob(".*-*"):  # what a crash left
            if left.lstat().st_mtime < time.time() - _STALE_S:
                shutil.rmtree(left, ignore_errors=True)
        place = self.root / f".incoming-{secrets.token_hex(8)}"
        place.mkdir(mode=0o700)
        try:
            yield place
        finally:
            shutil.rmtree(place, ignore_errors=True)

    def take_in(
        self, place: Path, archive: Path, limit_bytes: int, limit_files: int, foreign: Foreign | None = None
    ) -> tuple[str, RecordingSet]:
        """Unpack a recording set, or what `foreign` says, check it completely, and keep it as a recording set. Raises
        InputError with all problems; nothing is kept then."""
        unpacked = place / "set"
        sent = unpacked if foreign is None else place / "sent"
        remarks = unpack(archive, sent, limit_bytes, limit_files)
        try:
            if foreign is None:
                recordings = recording.read(_top(sent))
            else:
                recordings = foreign.read(_top(sent, None))
                notes = name_as_in_archive(recordings.manifest.notes, place)
                recordings = recordings.under(recordings.manifest.model_copy(update={"notes": notes}))
                warnings: list[str] = []
                recording.write(recordings, unpacked, report_warnings=warnings.extend)
                recordings.warnings += tuple(warnings)
        except InputError as error:
            raise InputError(name_as_in_archive(str(error), place)) from None
        recordings.warnings = (*remarks, *recordings.warnings)
        id = secrets.token_hex(8)
        unpacked.rename(self.root / id)
        os.utime(self.root / id)  # by which they are listed
        return id, recordings

    def remove(self, id: str) -> None:
        """Take recordings away. Raises InputError where there are none of that id."""
        self.folder(id)
        away = self.root / f".removed-{id}"
        (self.root / id).rename(away)  # gone at once
        shutil.rmtree(away)

    def manifest(self, id: str) -> dict[str, Any]:
        """Return the manifest of kept recordings as it is written: it was checked when they were sent in."""
        manifest: dict[str, Any] = json.loads((self.folder(id) / _MANIFEST).read_text(encoding="utf-8-sig"))
        return manifest

    def recordings(self, id: str) -> RecordingSet:
        """Return kept recordings, whose frames are checked when they are read."""
        folder = self.folder(id)
        manifest, _ = recording.parse_manifest((folder / _MANIFEST).read_text(encoding="utf-8-sig"), _MANIFEST)
        return RecordingSet(manifest, source=id, files=FolderFiles(folder))


def take_cameras(
    place: Path, archive: Path, limit_bytes: int, lensfun: str = "", lens: str = ""
) -> tuple[dict[Side, CameraFile], tuple[str, ...]]:
    """Return the camera files of an archive, SIDE.toml with the curves and arrays that they name beside them, and what
    is remarked. Raises InputError.

    lensfun, lens : the archive's file of a lensfun lens that is put before the cameras, and which of its lenses
    """
    sent = place / "sent"
    unpack(archive, sent, limit_bytes, _MODEL_FILES)
    folder = _top(sent, None)
    named: dict[Side, Path] = {side: file for side in SIDES if (file := folder / f"{side}.toml").is_file()}
    if not named:
        raise InputError(
            f"the archive has none of {', '.join(f'{side}.toml' for side in SIDES)}; pack the camera files themselves"
        )
    try:
        for arrays in folder.glob("*.npz"):
            with zipfile.ZipFile(arrays) as packed:  # it may be compressed: what it states is what is read
                check_size(sum(entry.file_size for entry in packed.infolist()), limit_bytes)
        cameras = {side: read_camera(file, sent=True) for side, file in named.items()}
        if not lensfun:
            return cameras, ()
        xml = located(folder, "lensfun", lensfun)
        behind = {side: put_lens_before(xml, content, named[side], lens) for side, content in cameras.items()}
        remarks = tuple(dict.fromkeys(remark for made in behind.values() for remark in made.remarks))
        return {side: made.content for side, made in behind.items()}, remarks
    except TooMuch:
        raise
    except InputError as error:
        raise InputError(name_as_in_archive(str(error), place)) from None
    except (zipfile.BadZipFile, MemoryError) as error:
        raise InputError(f"the archive's arrays can't be read ({type(error).__name__}); save them with numpy") from None


def _top(folder: Path, holds: str | None = _MANIFEST) -> Path:
    """Return the folder that holds the file `holds`: `folder`, or the only folder in it. None: the only folder where no
    file is beside it."""
    entries = list(folder.iterdir())
    inner = [entry for entry in entries if entry.is_dir()]
    is_holder = (folder / holds).exists() if holds is not None else len(entries) > 1
    return inner[0] if not is_holder and len(inner) == 1 else folder


def name_as_in_archive(text: str, place: Path) -> str:
    """Return a message with the archive's files named as in the archive."""
    for part in ("set", "sent"):
        for top in place.glob(f"{part}/*"):
            if top.is_dir() and len(list((place / part).iterdir())) == 1:
                text = text.replace(f"{top}/", "").replace(str(top), "the archive")
        text = text.replace(f"{place / part}/", "").replace(str(place / part), "the archive")
    return text
