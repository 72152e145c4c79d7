"""A backup of a data folder while it is in use: generations, each a data folder of its own.

Files of sessions never change once they are linked, so a generation takes those that the one before has as hard links.
The registry is copied first, at one moment. Every file that is copied is compared with the SHA-256 that the registry
has of it; of packed frames, each frame is. A file that is damaged or missing in the data folder replaces nothing: the
good copy of an earlier generation goes into the new one, and the file is reported.

A session that is packed meanwhile moves its frames into one file: registry and files are then taken again.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path

from lab.capture.generations import (
    KEPT,
    LATEST,
    MARK,
    RECORD,
    REGISTRY,
    FileSum,
    Generation,
    GenerationRecord,
    can_be_parsed,
    copy_hashed,
    generations_of,
    link_or_copy,
    lock_of,
    remove_tree,
    sha256_of,
    sync_folder,
    sync_folders,
)
from lab.capture.records import now
from lab.capture.registry_copy import copy_registry
from lab.capture.session_files import PACK, SessionFiles, StoredPlace
from lab.capture.store import Store
from lab.errors import InputError
from lab.formats.recording_set import DataSheet

#: Most attempts at copies of registry and files that agree.
TRIES = 5
#: Most files of one remark that are named.
_NAMED = 20
#: Folders of the data folder whose files never change once they are there, though the registry has no sums of them.
_FIXED = ("recordings", "predictions")
_NAME = "%Y%m%d-%H%M%S-%f"
_PARTIAL, _LEFT = ".partial", ".partial-before"
#: What mends damage of the backup itself.
_ANEW = "back up with --checksum, which copies it anew while the data folder has it"


@dataclass(frozen=True)
class BackupReport:
    """What a backup did. `generation`: the newest now; `is_new`: whether this call made it. `damaged`: a line for each
    file that is damaged or missing in the data folder; `remarks`: what else an owner wants to know."""

    generation: Generation
    is_new: bool
    sessions: int
    files: int
    copied: int
    copied_bytes: int
    damaged: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def back_up(store: Store, folder: Path, keep: int = KEPT, checksum: bool = False) -> BackupReport:
    """Add a generation to the backup in `folder`, or make it; keep the newest `keep` generations.

    `checksum`: read every file of the data folder, also those whose size and time are as in the newest generation. No
    generation is made where nothing changed, and none removed while a file has no good copy. Raises InputError where
    `folder` lies in the data folder or holds anything but a backup of it, where the registry is damaged or has no
    sessions any more, and where files can't be written.
    """
    target = folder.resolve()
    if store.count_sessions() == 0 and any((store.root / "sessions").glob("*/*")):
        raise InputError(
            f"{store.root}: its registry names no session, and there are folders of sessions; where the registry is a "
            "database server's, set CALIBENCH_DATABASE_URL as the service has it, else bring it back: calibench restore"
        )
    if target == store.root or target.is_relative_to(store.root) or store.root.is_relative_to(target):
        raise InputError(f"{folder}: is the data folder or lies in it; name a folder on another disk")
    try:
        target.mkdir(parents=True, exist_ok=True)
        _check_mark(store.root, target)
        lock = lock_of(target)
        if not lock.acquire():
            raise InputError(f"{folder}: another process writes into this backup; wait until it is done")
        try:
            _adopt_single_copy(store.root, target)
            return _Writer(store, target, checksum).write(keep)
        finally:
            lock.release()
    except OSError as error:
        raise InputError(
            f"{error.filename or folder}: can't be copied ({error.strerror}); make room, or name another folder. The "
            "generations of before are as they were"
        ) from error


def verify_backup(backup: Path) -> tuple[int, tuple[str, ...]]:
    """Read every file of all generations; returns how many there are, and a line for each that is damaged or missing.

    A file that several generations share is read once. Raises InputError where `backup` is none.
    """
    generations = generations_of(backup)
    if not generations:
        raise InputError(f"{backup}: holds no generation of a backup; name the folder that `calibench backup` wrote")
    damages: dict[tuple[int, int, str], str | None] = {}
    lines: list[str] = []
    for generation in generations:
        try:
            files = generation.record.files
        except InputError as error:
            lines.append(str(error))
            continue
        for path, recorded in files.items():
            with contextlib.suppress(OSError):
                there = (generation.folder / path).stat()
                key = (there.st_dev, there.st_ino, recorded.sha256)
                if key not in damages:
                    damages[key] = generation.damage(path)
                if (damage := damages[key]) is not None:
                    lines.append(f"{generation.name}/{path}: {damage}; {_ANEW}")
                continue
            lines.append(f"{generation.name}/{path}: missing; {_ANEW}")
    return len(damages), tuple(lines)


def _check_mark(root: Path, target: Path) -> None:
    """Mark an empty folder as this data folder's backup. Raises InputError for a folder that holds anything else."""
    mark = target / MARK
    if not mark.exists():
        if any(entry.name != "lost+found" for entry in target.iterdir()):
            raise InputError(f"{target}: isn't empty and no backup; name a folder of its own")
        mark.write_text(f"{root}\n")
    elif mark.read_text().strip() != str(root):
        raise InputError(f"{target}: is the backup of another data folder; name a folder of its own")


def _adopt_single_copy(root: Path, target: Path) -> None:
    """Make the first generation from a backup of calibench before generations, which was one copy of the data
    folder."""
    moved = target / ".adopted"
    if (target / REGISTRY).exists() or moved.exists():
        moved.mkdir(exist_ok=True)
        for entry in target.iterdir():
            if not entry.name.startswith(".") and entry.name not in (LATEST, "lost+found"):
                entry.rename(moved / entry.name)
        registry = moved / REGISTRY
        linked = _linked_files(registry)
        files = {}
        for path in _files(moved):
            moved_sum = FileSum(sha256=sha256_of(moved / path), bytes=(moved / path).stat().st_size)
            expected = linked.files.get(str(path))
            if expected is None or expected == moved_sum:
                files[str(path)] = moved_sum
        files[REGISTRY] = FileSum(sha256=sha256_of(registry), bytes=registry.stat().st_size)
        made = datetime.fromtimestamp(registry.stat().st_mtime, UTC)
        _write_record(moved, root, linked, files, known_version=False)
        moved.rename(target / made.strftime(_NAME))


@dataclass(frozen=True)
class _LinkedFiles:
    """The content of a copied registry: the sums of files by path, and of each packed session its frames' places."""

    revision: str
    sessions: frozenset[str]
    files: dict[str, FileSum]
    packs: dict[str, dict[str, StoredPlace]]


def _linked_files(registry: Path) -> _LinkedFiles:
    asked = "SELECT session_id, path, sha256, bytes, side, pack_index FROM files"
    with contextlib.closing(sqlite3.connect(f"file:{registry}?mode=ro&immutable=1", uri=True)) as copy:
        rows = copy.execute(asked).fetchall()
        sessions = frozenset(row[0] for row in copy.execute("SELECT id FROM sessions"))
        (revision,) = copy.execute("SELECT version_num FROM alembic_version").fetchone()
    files: dict[str, FileSum] = {}
    packs: dict[str, dict[str, StoredPlace]] = {}
    for session_id, path, sha256, size, side, pack_index in rows:
        if pack_index is None:
            files[f"sessions/{session_id}/{path}"] = FileSum(sha256=sha256, bytes=size)
        else:
            packs.setdefault(f"sessions/{session_id}/{PACK}", {})[path] = StoredPlace(sha256, side, pack_index)
    return _LinkedFiles(revision, sessions, files, packs)


def _files(root: Path) -> Iterator[Path]:
    """Files to copy, relative to `root`: without registry, unfinished files, locks and links."""
    for folder, folders, names in os.walk(root):
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".") and (Path(folder) != root or name not in ("runners", "lost+found"))
        ]
        for name in names:
            file = Path(folder) / name
            if not (
                name.startswith(".")
                or name.endswith((".lock", ".partial"))
                or file.is_symlink()
                or not file.is_file()
                or name.startswith(REGISTRY)
            ):
                yield file.relative_to(root)


@dataclass
class _Writer:
    """Writes one generation."""

    store: Store
    target: Path
    checksum: bool
    copied: int = 0
    copied_bytes: int = 0
    damaged: dict[str, str] = field(default_factory=dict)
    lost: set[str] = field(default_factory=set)

    def write(self, keep: int) -> BackupReport:
        """Write a generation, unless the newest is the same; remove those that are too old."""
        before = generations_of(self.target)
        for left in self.target.glob(".removed-*"):
            remove_tree(left)
        linked, files = self._write_registry_and_files(before)
        made = self._partial / RECORD
        if before and (newest := _record_or_none(before[0])) is not None:
            if newest.sessions and not linked.sessions:
                raise InputError(
                    f"{self.store.root}: its registry names no session, the newest generation has {newest.sessions}; "
                    "look whether its disk is mounted, or, if all were deleted, back up into a new folder"
                )
            if newest.files == files and not self.copied:
                remove_tree(self._partial)
                remove_tree(self.target / _LEFT)
                return self._report(before[0], False, linked, files, ())
        remarks = self._gone(before, linked, files)
        _write_record(self._partial, self.store.root, linked, files)
        with made.open("rb") as written:
            os.fsync(written.fileno())
        sync_folders(self._partial)
        generation = Generation(self.target / _name_after(before))
        self._partial.rename(generation.folder)
        sync_folder(self.target)
        self._point_to(generation)
        remove_tree(self.target / _LEFT)
        if self.lost:
            remarks += ("no generation is removed while files have no good copy",)
        else:
            for old in generations_of(self.target)[keep:]:
                remove_tree(old.folder)
        return self._report(generation, True, linked, files, remarks)

    @property
    def _partial(self) -> Path:
        return self.target / _PARTIAL

    def _report(
        self,
        generation: Generation,
        is_new: bool,
        linked: _LinkedFiles,
        files: dict[str, FileSum],
        remarks: tuple[str, ...],
    ) -> BackupReport:
        return BackupReport(
            generation,
            is_new,
            len(linked.sessions),
            len(files),
            self.copied,
            self.copied_bytes,
            tuple(f"{path}: {words}" for path, words in sorted(self.damaged.items())),
            remarks,
        )

    def _point_to(self, generation: Generation) -> None:
        """Let `latest` lead to a generation; not on a disk that has no links."""
        link = self.target / f".{LATEST}"
        with contextlib.suppress(OSError):
            link.unlink(missing_ok=True)
            link.symlink_to(generation.name, target_is_directory=True)
            link.rename(self.target / LATEST)

    # --- registry and files, until they agree -----------------------------------------------------------------------

    def _write_registry_and_files(self, before: list[Generation]) -> tuple[_LinkedFiles, dict[str, FileSum]]:
        """Write registry and files into the partial generation, again while a session is packed or deleted."""
        damaged_before: dict[str, str] | None = None
        for _ in range(TRIES):
            if self._partial.exists():  # of the attempt before, or of a process that was killed
                if (self.target / _LEFT).exists():
                    _merge(self._partial, self.target / _LEFT)
                else:
                    self._partial.rename(self.target / _LEFT)
            self._partial.mkdir()
            self.damaged, self.lost = {}, set()
            registry = self._partial / REGISTRY
            copy_registry(self.store.settings.url, registry)
            linked = _linked_files(registry)
            files = self._copy_all(linked, before)
            with registry.open("rb") as written:
                os.fsync(written.fileno())
            files[REGISTRY] = FileSum(sha256=sha256_of(registry), bytes=registry.stat().st_size)
            if not self.damaged or self.damaged == damaged_before:
                break
            damaged_before = self.damaged
        return linked, dict(sorted(files.items()))

    def _copy_all(self, linked: _LinkedFiles, before: list[Generation]) -> dict[str, FileSum]:
        files: dict[str, FileSum] = {}
        for path in (str(file) for file in _files(self.store.root)):
            taken = self._take(path, linked, before)
            if taken is not None:
                files[path] = taken
        for path in (*linked.files, *linked.packs):
            if path not in files and path not in self.damaged:
                carried = self._carry_forward(path, linked.files.get(path), before, "missing in the data folder")
                if carried is not None:
                    files[path] = carried
        return files

    def _take(self, path: str, linked: _LinkedFiles, before: list[Generation]) -> FileSum | None:
        """Put a file into the partial generation: linked where it is unchanged, copied and checked where it isn't.
        Returns its sum; None where it vanished, or has no good copy."""
        source, made = self.store.root / path, self._partial / path
        expected = linked.files.get(path)
        known = self._newest_sum(path, before)
        if known is not None and (expected is None or known == expected):
            previous = before[0].folder / path
            with contextlib.suppress(OSError):
                if _same_size_and_time(source, previous) and not (
                    self.checksum and (sha256_of(source) != known.sha256 or before[0].damage(path))
                ):
                    link_or_copy(previous, made)
                    return known
        left = self.target / _LEFT / path
        with contextlib.suppress(OSError):
            reusable = expected is not None and not self.checksum and _same_size_and_time(source, left)
            if expected is not None and reusable and sha256_of(left) == expected.sha256:
                link_or_copy(left, made)
                return expected
        partial = made.with_name(f".{made.name}.partial")
        try:
            copied = copy_hashed(source, partial)
        except FileNotFoundError:
            return None
        why = None
        if expected is not None:
            why = _difference(copied, expected)
        elif copied != known and path in linked.packs:
            why = _damaged_pack(partial, linked.packs[path])
        elif copied != known and known is not None:
            why = _suspicion(path, partial, copied, known)
        if why is not None:
            partial.unlink()
            return self._carry_forward(path, expected or known, before, why)
        if known == copied and not before[0].damage(path):
            partial.unlink()
            link_or_copy(before[0].folder / path, made)
            return copied
        partial.rename(made)
        self.copied, self.copied_bytes = self.copied + 1, self.copied_bytes + copied.bytes
        return copied

    def _newest_sum(self, path: str, before: list[Generation]) -> FileSum | None:
        return before[0].sum_of(path) if before else None

    def _carry_forward(self, path: str, expected: FileSum | None, before: list[Generation], why: str) -> FileSum | None:
        """Link the good copy of an earlier generation into this one, and report the file. Without an expected sum, as
        of a pack, the recorded one counts: it was checked when it was written."""
        for generation in before:
            recorded = generation.sum_of(path)
            if recorded is None or (expected is not None and recorded != expected) or generation.damage(path):
                continue
            link_or_copy(generation.folder / path, self._partial / path)
            self.damaged[path] = (
                f"{why}; the backup keeps the good copy of {generation.name}, `calibench restore --repair` brings it "
                "back"
            )
            return recorded
        self.lost.add(path)
        frames = f"{path.removesuffix(PACK)}frames/"
        unpacked = next(
            (generation.name for generation in before if any(file.startswith(frames) for file in _paths(generation))),
            None,
        )
        if path.endswith(f"/{PACK}") and unpacked is not None:
            self.damaged[path] = (
                f"{why}; the generation {unpacked} has its frames of before they were packed: calibench restore "
                f"--generation {unpacked} --to another folder"
            )
        else:
            self.damaged[path] = f"{why}, and no generation has a good copy; capture it again, or delete the session"
        return None

    def _gone(self, before: list[Generation], linked: _LinkedFiles, files: dict[str, FileSum]) -> tuple[str, ...]:
        """Return a remark for what the newest generation has and the data folder no longer has."""
        if not before:
            return ()
        packed = {path.removesuffix(PACK) for path in linked.packs}
        gone: dict[str, int] = {}
        for path in _paths(before[0]):
            parts = path.split("/")
            if path in files or path in self.damaged or path.startswith(tuple(f"{folder}frames/" for folder in packed)):
                continue
            name = "/".join(parts[:2])
            gone[name] = gone.get(name, 0) + 1
        lines = [
            f"{name}: {_count_in_words(number)} no longer in the data folder" for name, number in sorted(gone.items())
        ]
        if len(lines) > _NAMED:
            lines = [*lines[:_NAMED], f"and {len(lines) - _NAMED} more"]
        return tuple(f"{line}; the generation {before[0].name} has what it was, if nobody deleted it" for line in lines)


def _difference(actual: FileSum, expected: FileSum) -> str | None:
    """Return how a copy differs from what the registry has; None where it doesn't."""
    if actual == expected:
        return None
    if actual.bytes != expected.bytes:
        return f"damaged in the data folder: {actual.bytes} bytes, the registry has {expected.bytes}"
    return f"damaged in the data folder: its SHA-256 is {actual.sha256[:12]}, the registry has {expected.sha256[:12]}"


def _suspicion(path: str, copy: Path, actual: FileSum, known: FileSum) -> str | None:
    """Return why a file that the registry doesn't name, and that changed since the newest generation, is damaged; None
    where nothing indicates that it is."""
    if actual.bytes == 0:
        return f"empty in the data folder, {known.bytes} bytes before"
    if path.partition("/")[0] in _FIXED:
        return "changed in the data folder, where such files never change"
    if not can_be_parsed(copy, Path(path)):
        return f"damaged in the data folder: can't be read as {Path(path).suffix[1:].upper()}"
    return None


def _name_after(before: list[Generation]) -> str:
    """Return the time, UTC, as a generation's name; later than those of before, also where the clock was set back."""
    at = now()
    if before:
        newest = datetime.strptime(before[0].name, _NAME).replace(tzinfo=UTC)
        at = max(at, newest + timedelta(microseconds=1))
    return at.strftime(_NAME)


def _count_in_words(number: int) -> str:
    return "is" if number == 1 else f"{number} files are"


def _paths(generation: Generation) -> tuple[str, ...]:
    record = _record_or_none(generation)
    return () if record is None else tuple(record.files)


def _record_or_none(generation: Generation) -> GenerationRecord | None:
    with contextlib.suppress(InputError):
        return generation.record
    return None


def _same_size_and_time(file: Path, second: Path) -> bool:
    a, b = file.lstat(), second.lstat()
    return (a.st_size, a.st_mtime_ns) == (b.st_size, b.st_mtime_ns)


def _damaged_pack(file: Path, places: dict[str, StoredPlace]) -> str | None:
    """Read every frame of a packed session and compare it with the registry's SHA-256; what is wrong, or None."""
    packed = SessionFiles(file.parent, places, pack=file)
    for path in places:
        try:
            packed.frame(path, _ANY_CAMERA)
        except InputError as error:
            words = str(error).replace(f" from {file}", "").partition("; restore")[0]
            return f"damaged in the data folder: {path}: {words}"
    return None


#: A packed frame has its own size: the camera isn't asked.
_ANY_CAMERA = DataSheet.model_validate({"rows": 2, "cols": 2, "cfa": "MONO", "bit_depth": 8})


def _merge(source: Path, target: Path) -> None:
    """Move what `source` has and `target` hasn't, and remove the rest."""
    for path in _files(source):
        made = target / path
        if not made.exists():
            made.parent.mkdir(parents=True, exist_ok=True)
            (source / path).rename(made)
    remove_tree(source)


def _write_record(
    folder: Path, root: Path, linked: _LinkedFiles, files: dict[str, FileSum], known_version: bool = True
) -> None:
    record = GenerationRecord(
        data_folder=str(root),
        made=now(),
        calibench=version("calibench") if known_version else "",
        revision=linked.revision,
        sessions=len(linked.sessions),
        files=files,
    )
    (folder / RECORD).write_text(record.model_dump_json(indent=0), encoding="utf-8")
