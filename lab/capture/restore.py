"""A data folder brought back from a backup: a whole generation, or the files that are damaged or missing.

A generation is first copied into `DATA/.restore`, each file compared with its recorded SHA-256. What is there already
is as it was until then, and a process that is killed is continued by the next. Then the entries are renamed; from the
first to the last, `DATA/.restore/complete` keeps every store from opening the folder.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from lab.capture.file_lock import Lock
from lab.capture.generations import (
    REGISTRY,
    Generation,
    can_be_parsed,
    copy_hashed,
    generations_of,
    is_intact_registry,
    remove_tree,
    sha256_of,
    sync_folder,
    sync_folders,
)
from lab.capture.migrate import VERSIONS
from lab.capture.records import now
from lab.capture.registry_copy import copy_registry, count_sessions, load_registry
from lab.capture.session_files import PACK
from lab.capture.settings import Settings
from lab.capture.store import Store
from lab.capture.tables import STAGED, SWAPPING
from lab.errors import InputError

#: What stays where it is when a data folder makes room for a restored one.
_DONE = ".restore-done"
_STAYS = (STAGED.name, _DONE, ".restore.lock", "lost+found")
_BEFORE = ".before-restore-"
Advance = Callable[[str, float], None]


@dataclass(frozen=True)
class RestoreReport:
    """What was restored. `before`: where that is which was in the data folder; None: it was empty. `remarks`: what an
    owner wants to know."""

    generation: str
    files: int
    bytes: int
    before: Path | None
    remarks: tuple[str, ...] = ()


def list_generations(backup: Path) -> list[Generation]:
    """Return the generations of a backup, the newest first. Raises InputError where there is none."""
    generations = generations_of(backup)
    if not generations:
        raise InputError(f"{backup}: holds no generation of a backup; name the folder that `calibench backup` wrote")
    return generations


def restore(
    backup: Path,
    settings: Settings,
    generation: str | None = None,
    replace: bool = False,
    advance: Advance = lambda text, share: None,
) -> RestoreReport:
    """Bring a generation, by default the newest, back into a data folder and its registry.

    `replace`: where the data folder holds anything, move that into `DATA/.before-restore-TIME`. Raises InputError where
    it holds something and `replace` isn't given, where a process works with it or it belongs to another user, where
    the generation is of a newer calibench, a file of it is damaged, and where the disk hasn't the room.
    """
    chosen = _choose_generation(backup, generation)
    target = settings.data.resolve()
    if backup.resolve() == target or backup.resolve().is_relative_to(target) or target.is_relative_to(backup.resolve()):
        raise InputError(f"{target}: is the backup or lies in it; name another folder by --to")
    try:
        target.mkdir(parents=True, exist_ok=True)
        lock = Lock(target / ".restore.lock")
        if not lock.acquire():
            raise InputError(f"{target}: another process restores it; wait until it is done")
        try:
            _check_free_to_write(target, settings, replace)
            remarks = _check_version(chosen)
            if not (target / SWAPPING).exists():
                _stage(chosen, target, advance)
            elif not (target / STAGED / chosen.name).is_dir():
                (staged,) = (entry.name for entry in (target / STAGED).iterdir() if entry.is_dir())
                raise InputError(f"{target}: {staged} is half in its place; restore that first (--generation {staged})")
            before = _swap(target, settings)
        finally:
            lock.release()
            lock.path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"{error.filename or target}: can't be written ({error.strerror}); make room, or have its permissions "
            "changed, then restore again: it continues"
        ) from error
    files = chosen.record.files
    return RestoreReport(chosen.name, len(files), sum(file.bytes for file in files.values()), before, remarks)


@dataclass(frozen=True)
class RepairReport:
    """Files that were brought back, and a line for each that no generation has."""

    restored: tuple[str, ...]
    lost: tuple[str, ...]
    before: Path | None


def repair(backup: Path, store: Store, advance: Advance = lambda text, share: None) -> RepairReport:
    """Bring back the files of a data folder that its registry names and that are damaged or missing, and those that are
    empty and weren't. Nothing else is changed; a damaged file goes into `DATA/.before-restore-TIME`.

    Every such file of the data folder is read. A copy is taken from the newest generation that has the right SHA-256.
    """
    generations = list_generations(backup)
    away = store.root / f"{_BEFORE}{now():%Y%m%d-%H%M%S}"
    restored, lost = [], []
    wanted = list(_list_wanted_files(store, generations))
    for number, (path, expected) in enumerate(wanted):
        advance(path, number / len(wanted))
        file = store.root / path
        why = _damage_of(file, expected)
        if why is None or ("/frames/" in path and (file.parents[1] / PACK).exists()):  # packed meanwhile
            continue
        made = file.with_name(f".{file.name}.partial")
        for generation in generations:
            recorded = generation.sum_of(path)
            if recorded is None or (expected is not None and recorded.sha256 != expected) or generation.damage(path):
                continue
            copied = copy_hashed(generation.folder / path, made)
            if copied != recorded:
                made.unlink()
                continue
            if file.exists():
                (away / path).parent.mkdir(parents=True, exist_ok=True)
                file.rename(away / path)
            made.rename(file)
            sync_folder(file.parent)
            restored.append(path)
            break
        else:
            lost.append(f"{path}: {why}, and no generation has a good copy; capture it again, or delete the session")
    return RepairReport(tuple(restored), tuple(lost), away if away.exists() else None)


def _list_wanted_files(store: Store, generations: list[Generation]) -> Iterator[tuple[str, str | None]]:
    """Yield the files that a data folder should have, with the SHA-256 of those that never change.

    Of packed sessions and of recordings, the recorded SHA-256 of the newest generation counts. Of other files none
    does: None."""
    packed = set()
    for info in store.sessions():
        folder = f"sessions/{info.id}"
        if info.packed:
            packed.add(f"{folder}/{PACK}")
        for file in store.files(info.id):
            if not (info.packed and file.role == "frame"):
                yield f"{folder}/{file.path}", file.sha256
    for path, recorded in generations[0].record.files.items():
        if path in packed or (path.startswith(("recordings/", "predictions/")) and (store.root / path).exists()):
            packed.discard(path)
            yield path, recorded.sha256
        elif not path.startswith("sessions/") and path != REGISTRY and recorded.bytes and (store.root / path).exists():
            yield path, None
    yield from ((path, None) for path in packed if not (store.root / path).exists())


def _damage_of(file: Path, expected: str | None) -> str | None:
    try:
        if expected is None:
            return "empty" if file.stat().st_size == 0 else None if can_be_parsed(file, file) else "damaged"
        return None if sha256_of(file) == expected else "damaged"
    except OSError as error:
        return f"can't be read ({error.strerror})"


def _choose_generation(backup: Path, name: str | None) -> Generation:
    known = list_generations(backup)
    if name is None:
        return known[0]
    for generation in known:
        if generation.name == name:
            return generation
    raise InputError(
        f"{backup}: has no generation {name!r}; choose from {', '.join(generation.name for generation in known)}"
    )


def _check_version(generation: Generation) -> tuple[str, ...]:
    """Refuse a generation whose tables this calibench doesn't know; remark on one of another version."""
    known = sorted(file.name.partition("_")[0] for file in VERSIONS.glob("[0-9]*.py"))
    record = generation.record
    by = f"calibench {record.calibench}" if record.calibench else "an earlier calibench"
    if record.revision not in known:
        raise InputError(
            f"{generation.folder}: its registry has the revision {record.revision}, written by {by}, this one knows "
            f"those up to {known[-1]}; install that version to restore it"
        )
    if record.revision != known[-1]:
        return (f"its registry has the revision {record.revision} of {by}; the first start brings it to {known[-1]}",)
    return ()


def _check_free_to_write(target: Path, settings: Settings, replace: bool) -> None:
    """Refuse a data folder that isn't this user's, that a process works with, or that holds anything unless that is to
    be replaced."""
    if os.geteuid() != target.stat().st_uid:
        raise InputError(
            f"{target}: belongs to another user; restore as that user (sudo -u USER calibench restore ...)"
        )
    for file in (*target.glob("sessions/*/.lock"), *target.glob("runners/*.lock")):
        if Lock(file).is_held():
            raise InputError(f"{target}: a process works with it; stop the service and end what captures")
    if (target / SWAPPING).exists() or replace:
        return
    if present := [entry.name for entry in _entries(target)]:
        raise InputError(
            f"{target}: isn't empty (it has {', '.join(sorted(present)[:3])}); give --replace, which moves this "
            f"to {_BEFORE}TIME in it, or another folder by --to"
        )
    if settings.database_url and (number := count_sessions(settings.database_url)):
        raise InputError(
            f"the database of CALIBENCH_DATABASE_URL has {number} sessions; give --replace, which writes its registry "
            f"to {_BEFORE}TIME first, or name an empty database"
        )


def _entries(target: Path) -> list[Path]:
    """What a data folder holds, without what belongs to restoring."""
    return [entry for entry in target.iterdir() if entry.name not in _STAYS and not entry.name.startswith(_BEFORE)]


def _stage(generation: Generation, target: Path, advance: Advance) -> None:
    """Copy a generation into `.restore`, each file compared with its recorded SHA-256. What an earlier call copied
    stays: a file has its name only when it is whole and on the disk."""
    staging = target / STAGED
    folder = staging / generation.name
    shutil.rmtree(target / _DONE, ignore_errors=True)
    for previous in staging.glob("[!.]*"):
        if previous.name != generation.name:
            remove_tree(previous)
    folder.mkdir(parents=True, exist_ok=True)
    files = generation.record.files
    missing = [
        path
        for path, recorded in files.items()
        if not (folder / path).is_file() or (folder / path).stat().st_size != recorded.bytes
    ]
    wanted_bytes, free_bytes = sum(files[path].bytes for path in missing), shutil.disk_usage(target).free
    if wanted_bytes > free_bytes:
        raise InputError(
            f"{target}: {wanted_bytes} bytes are to be restored, its disk has {free_bytes} free; make room"
        )
    for number, path in enumerate(missing):
        advance(path, number / len(missing))
        made = folder / path
        partial = made.with_name(f".{made.name}.partial")
        try:
            copied = copy_hashed(generation.folder / path, partial)
        except FileNotFoundError as error:
            if (generation.folder / path).exists():
                raise
            raise InputError(
                f"{generation.folder / path}: missing; restore another generation (--generation)"
            ) from error
        if copied != files[path] and not (path == REGISTRY and is_intact_registry(generation.folder / path)):
            partial.unlink()
            raise InputError(
                f"{generation.folder / path}: damaged: its SHA-256 is {copied.sha256[:12]}, recorded is "
                f"{files[path].sha256[:12]}; restore another generation (--generation)"
            )
        partial.rename(made)
    sync_folders(staging)


def _swap(target: Path, settings: Settings) -> Path | None:
    """Put the staged entries in the place of those that are there. Continues where an earlier call was killed."""
    staging, swapping = target / STAGED, target / SWAPPING
    if not swapping.exists():
        (staging / ".before").write_text(f"{_BEFORE}{now():%Y%m%d-%H%M%S}")
        sync_folder(staging)
        swapping.touch()
        sync_folder(staging)
    before = target / (staging / ".before").read_text()
    (folder,) = (entry for entry in staging.iterdir() if entry.is_dir())
    moved = staging / ".moved"
    if not moved.exists():
        for entry in _entries(target):
            before.mkdir(exist_ok=True)
            entry.rename(before / entry.name)
        if settings.database_url:
            if count_sessions(settings.database_url):
                before.mkdir(exist_ok=True)
                if not (before / REGISTRY).exists():
                    partial = before / f".{REGISTRY}.partial"
                    copy_registry(settings.database_url, partial)
                    partial.rename(before / REGISTRY)
            load_registry(folder / REGISTRY, settings.database_url)
        sync_folder(target)
        moved.touch()
        sync_folder(staging)
    for entry in folder.iterdir():
        if not entry.name.startswith(".") and not (settings.database_url and entry.name.startswith(REGISTRY)):
            entry.rename(target / entry.name)
    sync_folder(target)
    staging.rename(target / _DONE)  # and with it the mark
    shutil.rmtree(target / _DONE)
    return before if before.exists() else None
