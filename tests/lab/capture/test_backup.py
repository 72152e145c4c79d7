"""Backups: taken while sessions capture and are packed, restored unchanged, and refused where they would be useless.
What is damaged or missing in the data folder replaces no good copy, is reported, and can be brought back."""

from __future__ import annotations

import errno
import os
import pwd
import shutil
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

import lab.capture.backup
import lab.capture.generations
import lab.capture.restore
from lab.capture.backup import back_up, verify_backup
from lab.capture.generations import REGISTRY, generations_of
from lab.capture.plan import CapturePlan
from lab.capture.restore import repair, restore
from lab.capture.session import CaptureSession
from lab.capture.settings import Settings
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkSequence
from lab.cli import main
from lab.errors import InputError
from tests.lab import fake_bench

DARKS = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))
FRAMES = 8  # 2 exposures, 2 frames, 2 cameras


def captured(store: Store) -> str:
    session = CaptureSession.start(store, fake_bench.station(), DARKS, connect=fake_bench.Bench().drivers)
    session.run()
    return session.id


@pytest.fixture
def unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions keep a file a frame."""
    monkeypatch.setattr(Store, "close_session", lambda *_, **__: None)


def frames(store: Store, session: str) -> list[np.ndarray]:
    return [store.frame(one.id) for one in store.captures(session)]


def frame_files(store: Store, session: str) -> list[Path]:
    return sorted((store.folder(session) / "frames").glob("*.npy"))


def same_frames(folder: Path, store: Store, session: str) -> bool:
    opened = Store(folder)
    try:
        pairs = zip(frames(opened, session), frames(store, session), strict=True)
        return all(np.array_equal(one, other) for one, other in pairs)
    finally:
        opened.close()


def overwrite(file: Path, content: bytes) -> None:
    """As a power cut or a disk leaves it."""
    file.write_bytes(content)


def test_a_generation_is_a_data_folder(store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = captured(store)
    (store.root / "limits.toml").write_text("valid_days = 90\n")
    made = back_up(store, tmp_path / "backup")
    assert made.is_new and made.sessions == 1 and made.copied > 0
    second = captured(store)
    again = back_up(store, tmp_path / "backup")
    assert again.sessions == 2 and 0 < again.copied < again.files
    same = back_up(store, tmp_path / "backup")
    assert not same.is_new and same.copied == 0 and same.generation.name == again.generation.name
    assert main(["backup", str(tmp_path / "backup"), "--data", str(store.root)]) == 0
    assert "2 sessions" in capsys.readouterr().out
    assert verify_backup(tmp_path / "backup")[1] == ()
    for session in (first, second):
        assert same_frames(tmp_path / "backup" / "latest", store, session)
    assert (tmp_path / "backup" / "latest" / "limits.toml").exists()
    assert verify_backup(tmp_path / "backup")[1] == ()  # looking into a generation changes nothing of it


def test_what_did_not_change_is_on_the_disk_once(store: Store, tmp_path: Path) -> None:
    session = captured(store)
    one = back_up(store, tmp_path / "backup").generation.folder
    captured(store)
    other = back_up(store, tmp_path / "backup").generation.folder
    pack = f"sessions/{session}/session.nxs"
    assert (one / pack).stat().st_ino == (other / pack).stat().st_ino != (store.root / pack).stat().st_ino


@pytest.mark.parametrize("keep", [1, 3])
def test_the_newest_generations_are_kept(keep: int, store: Store, tmp_path: Path) -> None:
    for number in range(5):
        (store.root / "limits.toml").write_text(f"valid_days = {number + 1}\n")
        captured(store) if number == 0 else None
        back_up(store, tmp_path / "backup", keep)
    kept = [(one.folder / "limits.toml").read_text() for one in generations_of(tmp_path / "backup")]
    assert kept == [f"valid_days = {number}\n" for number in range(5, 5 - keep, -1)]


DAMAGES = {
    "random bytes": lambda file: overwrite(file, np.random.default_rng(3).bytes(file.stat().st_size)),
    "nothing": lambda file: overwrite(file, b""),
    "half of it": lambda file: overwrite(file, file.read_bytes()[: file.stat().st_size // 2]),
    "missing": lambda file: file.unlink(),
}


@pytest.mark.usefixtures("unpacked")
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_frame_replaces_no_good_copy(
    damage: str, store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Named in a line, exit code 4; the newest generation has the good copy, and --repair brings it back."""
    session, backup = captured(store), tmp_path / "backup"
    good = frames(store, session)
    back_up(store, backup, keep=1)
    hurt = frame_files(store, session)[3]
    DAMAGES[damage](hurt)
    arguments = ["backup", str(backup), "--data", str(store.root), "--keep", "1"]
    for _ in range(2):  # the second one has the first one's generation alone
        assert main(arguments) == 4
        (line,) = capsys.readouterr().err.splitlines()
        assert f"sessions/{session}/frames/{hurt.name}" in line and "restore --repair" in line
    with Store(backup / "latest").reading():
        assert all(np.array_equal(a, b) for a, b in zip(frames(Store(backup / "latest"), session), good, strict=True))
    assert main(["restore", str(backup), "--data", str(store.root), "--repair"]) == 0
    assert f"restored: sessions/{session}/frames/{hurt.name}" in capsys.readouterr().out
    assert all(np.array_equal(a, b) for a, b in zip(frames(store, session), good, strict=True))
    assert main(arguments) == 0
    kept = list(store.root.glob(f".before-restore-*/sessions/{session}/frames/{hurt.name}"))
    assert len(kept) == (damage != "missing")


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_pack_replaces_no_good_copy(damage: str, store: Store, tmp_path: Path) -> None:
    session, backup = captured(store), tmp_path / "backup"
    good = frames(store, session)
    back_up(store, backup)
    DAMAGES[damage](store.folder(session) / "session.nxs")
    made = back_up(store, backup, keep=1)
    (line,) = made.damaged
    assert line.startswith(f"sessions/{session}/session.nxs: ")
    assert repair(backup, store).restored == (f"sessions/{session}/session.nxs",)
    assert all(np.array_equal(a, b) for a, b in zip(frames(store, session), good, strict=True))
    assert back_up(store, backup).damaged == ()


def test_a_frame_of_a_pack_that_was_damaged_before_the_first_backup_is_found(store: Store, tmp_path: Path) -> None:
    """No generation has a good copy then: told so, the rest is backed up, and no generation is removed meanwhile."""
    session, other, backup = captured(store), captured(store), tmp_path / "backup"
    pack = store.folder(session) / "session.nxs"
    content = bytearray(pack.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 2000] = bytes(2000)
    pack.write_bytes(content)
    made = back_up(store, backup, keep=1)
    (line,) = made.damaged
    assert "session.nxs" in line and "no generation has a good copy" in line
    assert same_frames(made.generation.folder, store, other) if not made.damaged else len(made.damaged) == 1
    (store.root / "limits.toml").write_text("valid_days = 90\n")
    assert "no generation is removed" in back_up(store, backup, keep=1).remarks[-1]
    assert len(generations_of(backup)) == 2


def test_a_pack_that_was_lost_after_its_frames_were_backed_up(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = Store.close_session
    monkeypatch.setattr(Store, "close_session", lambda *_, **__: None)
    session, backup = captured(store), tmp_path / "backup"
    first = back_up(store, backup).generation
    close(store, session)
    (store.folder(session) / "session.nxs").write_bytes(b"")
    made = back_up(store, backup, keep=1)
    (line,) = made.damaged
    assert f"--generation {first.name}" in line and len(generations_of(backup)) == 2
    restore(backup, Settings(data=tmp_path / "again"), first.name)
    again = Store(tmp_path / "again")
    assert len(frames(again, session)) == FRAMES
    again.close()


@pytest.mark.parametrize(
    ("path", "good", "bad"),
    [
        ("stations/bench.toml", b'name = "bench"\n', b""),
        ("stations/left.toml", b'name = "left"\n', b"\x00\x8f" * 40),
        ("instruments/camera.json", b'{"gain_db": 3.5}', b'{"gain_db": 3.'),
        ("recordings/0123456789abcdef/frames/a.tif", b"II*\0" + bytes(99), b"II*\0" + bytes(98) + b"\1"),
    ],
)
def test_a_damaged_file_that_the_registry_does_not_name(
    path: str, good: bytes, bad: bytes, store: Store, tmp_path: Path
) -> None:
    captured(store)
    file, backup = store.root / path, tmp_path / "backup"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(good)
    back_up(store, backup)
    file.write_bytes(bad)
    made = back_up(store, backup, keep=1)
    (line,) = made.damaged
    assert line.startswith(f"{path}: ") and (made.generation.folder / path).read_bytes() == good
    assert repair(backup, store).restored == (path,)
    assert file.read_bytes() == good


def test_what_was_edited_or_deleted_is_no_damage(store: Store, tmp_path: Path) -> None:
    """A deleted file is a remark that names the generation with it: nobody may have deleted it."""
    session, other, backup = captured(store), captured(store), tmp_path / "backup"
    for name in ("bench", "spare"):
        (store.root / "stations").mkdir(exist_ok=True)
        (store.root / "stations" / f"{name}.toml").write_text(f'name = "{name}"\n')
    first = back_up(store, backup).generation
    (store.root / "stations" / "bench.toml").write_text('name = "other bench"\n')
    (store.root / "stations" / "spare.toml").unlink()
    store.delete_session(session)
    made = back_up(store, backup)
    assert made.damaged == () and len(made.remarks) == 2
    assert f"sessions/{session}: " in made.remarks[0] and first.name in made.remarks[0]
    assert "stations/spare.toml: is no longer" in made.remarks[1]
    assert same_frames(made.generation.folder, store, other)
    assert (made.generation.folder / "stations" / "bench.toml").read_text() == 'name = "other bench"\n'


@pytest.mark.usefixtures("unpacked")
def test_a_bit_that_changes_without_a_trace_is_found_by_checksum(store: Store, tmp_path: Path) -> None:
    session, backup = captured(store), tmp_path / "backup"
    back_up(store, backup)
    hurt = frame_files(store, session)[0]
    there, content = hurt.stat(), bytearray(hurt.read_bytes())
    content[-5] ^= 4
    hurt.write_bytes(content)
    os.utime(hurt, ns=(there.st_atime_ns, there.st_mtime_ns))
    assert back_up(store, backup).damaged == ()  # same size, same time
    assert hurt.name in back_up(store, backup, checksum=True).damaged[0]
    assert repair(backup, store).restored == (f"sessions/{session}/frames/{hurt.name}",)


def test_verify_finds_what_was_damaged_in_the_backup(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, backup = captured(store), tmp_path / "backup"
    made = back_up(store, backup).generation
    assert main(["backup", str(backup), "--verify"]) == 0
    pack = made.folder / "sessions" / session / "session.nxs"
    pack.write_bytes(pack.read_bytes()[:-1] + b"?")
    next(made.folder.glob("sessions/*/documents.jsonl")).unlink()
    assert main(["backup", str(backup), "--verify"]) == 4
    lines = sorted(capsys.readouterr().err.splitlines())
    assert ["missing" in lines[0], "damaged" in lines[1]] == [True, True] and len(lines) == 2
    with pytest.raises(InputError, match="restore another generation"):
        restore(backup, Settings(data=tmp_path / "again"))
    assert not (tmp_path / "again" / REGISTRY).exists()


def test_damage_of_the_backup_is_mended_by_checksum(store: Store, tmp_path: Path) -> None:
    """A file of the backup that rotted, of the same size and time as the good one of the data folder."""
    session, backup = captured(store), tmp_path / "backup"
    rotten = back_up(store, backup).generation.folder / "sessions" / session / "session.nxs"
    there, content = rotten.stat(), bytearray(rotten.read_bytes())
    content[len(content) // 2] ^= 8
    rotten.write_bytes(content)
    os.utime(rotten, ns=(there.st_atime_ns, there.st_mtime_ns))
    (line,) = verify_backup(backup)[1]
    assert "back up with --checksum" in line
    made = back_up(store, backup, keep=1, checksum=True)
    assert made.is_new and made.copied == 1 and verify_backup(backup)[1] == ()


def test_the_newest_generation_is_the_last_one_whatever_the_clock(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    captured(store)
    first = back_up(store, tmp_path / "backup").generation
    (store.root / "limits.toml").write_text("valid_days = 90\n")
    monkeypatch.setattr(lab.capture.backup, "now", lambda: datetime(2001, 1, 1, tzinfo=UTC))
    made = back_up(store, tmp_path / "backup", keep=1)
    assert generations_of(tmp_path / "backup")[0].name == made.generation.name > first.name


def test_a_session_that_is_packed_meanwhile_is_whole_in_the_backup(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is packed between the registry's copy and the copy of its frames: what was taken first names frames that are
    gone."""
    closed = Store.close_session
    monkeypatch.setattr(Store, "close_session", lambda *_, **__: None)
    session = captured(store)
    monkeypatch.setattr(Store, "close_session", closed)
    assert not store.session(session).packed
    taken = lab.capture.backup._files
    times = 0

    def packed_first(root: Path):
        nonlocal times
        if root == store.root:
            times += 1
            if times == 1:
                store.close_session(session)
        return taken(root)

    monkeypatch.setattr(lab.capture.backup, "_files", packed_first)
    made = back_up(store, tmp_path / "backup")
    assert times == 2 and made.damaged == ()
    restored = Store(made.generation.folder)
    assert restored.session(session).packed and len(frames(restored, session)) == FRAMES
    restored.close()


def test_useless_backups_are_refused(store: Store, tmp_path: Path) -> None:
    captured(store)
    for folder in (store.root, store.root / "backup", tmp_path):
        with pytest.raises(InputError, match="lies in it"):
            back_up(store, folder)
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").touch()
    with pytest.raises(InputError, match="isn't empty"):
        back_up(store, other)
    back_up(store, tmp_path / "backup")
    elsewhere = Store(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="another data folder"):
        back_up(elsewhere, tmp_path / "backup")
    elsewhere.close()
    lock = lab.capture.generations.lock_of(tmp_path / "backup")
    assert lock.acquire()
    with pytest.raises(InputError, match="another process"):
        back_up(store, tmp_path / "backup")
    lock.release()


def test_a_data_folder_that_lost_its_sessions_is_not_backed_up(store: Store, tmp_path: Path) -> None:
    """An empty folder where a disk isn't mounted, or a registry that was made anew: good generations would be
    followed by empty ones until none is left."""
    session, backup = captured(store), tmp_path / "backup"
    back_up(store, backup, keep=1)
    with store.transaction() as db:
        for table in ("captures", "files", "steps", "sessions"):
            db.execute(sa.text(f"DELETE FROM {table}"))
    with pytest.raises(InputError, match="names no session, and there are folders"):
        back_up(store, backup, keep=1)
    shutil.rmtree(store.root / "sessions")
    with pytest.raises(InputError, match="the newest generation has 1; look whether its disk is mounted"):
        back_up(store, backup, keep=1)
    again = tmp_path / "again"
    restore(backup, Settings(data=again))
    assert len(frames(Store(again), session)) == FRAMES


def test_a_damaged_registry_is_not_backed_up(store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    captured(store)
    backup = tmp_path / "backup"
    back_up(store, backup)
    store.close()
    registry = store.root / REGISTRY
    content = bytearray(registry.read_bytes())
    for page in range(4, len(content) // 4096, 2):
        content[page * 4096 : page * 4096 + 3000] = b"\xa5" * 3000
    registry.write_bytes(content)
    assert main(["backup", str(backup), "--data", str(store.root)]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "registry" in said
    assert len(generations_of(backup)) == 1 and verify_backup(backup)[1] == ()


def test_a_backup_of_before_generations_becomes_the_first_one(store: Store, tmp_path: Path) -> None:
    """It was one copy of the data folder, with its mark."""
    session, backup = captured(store), tmp_path / "backup"
    store.close()  # all of it is in registry.sqlite then
    shutil.copytree(store.root, backup)
    for left in backup.rglob("*.lock"):
        left.unlink()
    (backup / ".backup-of").write_text(f"{store.root}\n")
    captured(store)
    back_up(store, backup)
    newest, oldest = generations_of(backup)
    assert [oldest.record.sessions, newest.record.sessions] == [1, 2] and verify_backup(backup)[1] == ()
    assert {one.name for one in backup.iterdir() if not one.name.startswith(".")} == {
        "latest",
        newest.name,
        oldest.name,
    }
    restore(backup, Settings(data=tmp_path / "again"), oldest.name)
    assert same_frames(tmp_path / "again", store, session)


# --- restore ----------------------------------------------------------------------------------------------------------


def test_restore_brings_any_generation_back(store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, backup = captured(store), tmp_path / "backup"
    old = back_up(store, backup).generation
    second = captured(store)
    back_up(store, backup)
    assert main(["restore", str(backup), "--list"]) == 0
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()[1:]] == ["2", "1"]
    assert main(["restore", str(backup), "--to", str(tmp_path / "new")]) == 0
    assert same_frames(tmp_path / "new", store, first) and same_frames(tmp_path / "new", store, second)
    assert not list((tmp_path / "new").glob(".restore*"))
    assert main(["restore", str(backup), "--to", str(tmp_path / "old"), "--generation", old.name]) == 0
    assert [one.id for one in Store(tmp_path / "old").sessions()] == [first]
    assert main(["restore", str(backup), "--to", str(tmp_path / "x"), "--generation", "yesterday"]) == 2
    assert old.name in capsys.readouterr().err


def test_live_data_are_moved_away_only_when_asked(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, backup = captured(store), tmp_path / "backup"
    back_up(store, backup)
    second = captured(store)
    store.close()
    arguments = ["restore", str(backup), "--data", str(store.root)]
    assert main(arguments) == 2 and "--replace" in capsys.readouterr().err
    assert Store(store.root).has_session(second)
    assert main([*arguments, "--replace"]) == 0
    restored = Store(store.root)
    assert [one.id for one in restored.sessions()] == [first] and len(frames(restored, first)) == FRAMES
    (before,) = store.root.glob(".before-restore-*")
    assert Store(before).has_session(second)


def test_a_folder_that_a_process_works_with_is_left_alone(store: Store, tmp_path: Path) -> None:
    session, backup = captured(store), tmp_path / "backup"
    back_up(store, backup)
    lock = store.lock(session)
    assert lock.acquire()
    with pytest.raises(InputError, match="a process works with it"):
        restore(backup, store.settings, replace=True)
    lock.release()
    restore(backup, store.settings, replace=True)


def test_a_generation_of_a_newer_version_is_refused(store: Store, tmp_path: Path) -> None:
    captured(store)
    backup = tmp_path / "backup"
    made = back_up(store, backup).generation
    record = made.record.model_copy(update={"revision": "9999", "calibench": "99.0"})
    (made.folder / ".generation.json").write_text(record.model_dump_json())
    with pytest.raises(InputError, match=r"revision 9999, written by calibench 99\.0"):
        restore(backup, Settings(data=tmp_path / "again"))
    older = record.model_copy(update={"revision": "0001", "calibench": ""})
    (made.folder / ".generation.json").write_text(older.model_dump_json())
    assert "the first start brings it to" in restore(backup, Settings(data=tmp_path / "again")).remarks[0]


@pytest.mark.parametrize("at", ["the files", "the entries"])
def test_a_restore_that_failed_is_continued(
    at: str, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a full disk, in the middle: what was there is as it was until all files are staged, and no store opens a
    folder whose entries are half in place."""
    session, backup = captured(store), tmp_path / "backup"
    back_up(store, backup)
    second = captured(store)
    store.close()
    with monkeypatch.context() as broken:
        if at == "the files":
            copied, calls = lab.capture.restore.copy_hashed, []

            def full(source: Path, made: Path):
                calls.append(source)
                if len(calls) == 4:
                    raise OSError(errno.ENOSPC, "No space left on device", str(made))
                return copied(source, made)

            broken.setattr(lab.capture.restore, "copy_hashed", full)
        else:
            renamed, moved = Path.rename, []

            def cut(self: Path, target: Path) -> Path:
                if self.parent == store.root or self.parent.parent == store.root / ".restore":
                    moved.append(self)
                    if len(moved) == 3:
                        raise OSError(errno.EIO, "Input/output error", str(self))
                return renamed(self, target)

            broken.setattr(Path, "rename", cut)
        with pytest.raises(InputError, match="restore again: it continues"):
            restore(backup, store.settings, replace=True)
    if at == "the files":
        assert Store(store.root).has_session(second)
    else:
        with pytest.raises(InputError, match="a restore ended while it put files in place"):
            Store(store.root)
    done = restore(backup, store.settings, replace=True)
    restored = Store(store.root)
    assert [one.id for one in restored.sessions()] == [session] and len(frames(restored, session)) == FRAMES
    assert done.before is not None and Store(done.before).has_session(second)


# --- processes that are killed, full disks, other users ---------------------------------------------------------------


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "calibench", *arguments]


def kill_when(process: subprocess.Popen[bytes], reached: Path, pattern: str) -> bool:
    """Kill it as soon as a file of the pattern is there; whether it was still at work."""
    until = time.monotonic() + 30
    while process.poll() is None and not any(reached.glob(pattern)) and time.monotonic() < until:
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    return process.wait(30) == -signal.SIGKILL


@pytest.mark.usefixtures("unpacked")
def test_kill_during_backup_and_restore(store: Store, tmp_path: Path) -> None:
    session, backup, again = captured(store), tmp_path / "backup", tmp_path / "again"
    good = back_up(store, backup).generation
    captured(store)
    for number in range(60):
        (store.root / "transcripts").mkdir(exist_ok=True)
        (store.root / "transcripts" / f"{number}.txt").write_bytes(bytes([number]) * 100_000)
    process = subprocess.Popen(command("backup", str(backup), "--data", str(store.root)), stdout=subprocess.DEVNULL)
    killed = kill_when(process, backup, ".partial/transcripts/*.txt")
    known = [one.name for one in generations_of(backup)]
    assert (known == [good.name]) == killed and verify_backup(backup)[1] == ()
    made = back_up(store, backup)
    assert made.damaged == () and made.sessions == 2 and verify_backup(backup)[1] == ()
    assert not (backup / ".partial").exists() and not (backup / ".partial-before").exists()
    process = subprocess.Popen(command("restore", str(backup), "--to", str(again)), stdout=subprocess.DEVNULL)
    if kill_when(process, again, ".restore/*/transcripts/*.txt"):
        assert not (again / REGISTRY).exists()
        restore(backup, Settings(data=again))
    assert same_frames(again, store, session) and len(list((again / "transcripts").iterdir())) == 60


def small_disk(folder: Path, size: str) -> None:
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("no right to mount a small disk")


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a small disk")
def test_full_disks(store: Store, tmp_path: Path) -> None:
    session, disk = captured(store), tmp_path / "disk"
    small_disk(disk, "3m")
    try:
        back_up(store, disk)
        large = store.root / "transcripts" / "large.bin"
        large.parent.mkdir()
        large.write_bytes(bytes(4 << 20))
        with pytest.raises(InputError, match=r"No space left.*make room.*are as they were"):
            back_up(store, disk)
        assert len(generations_of(disk)) == 1 and verify_backup(disk)[1] == ()
        large.unlink()
        (store.root / "limits.toml").write_text("valid_days = 90\n")
        assert back_up(store, disk).is_new and verify_backup(disk)[1] == ()
        large.write_bytes(bytes(4 << 20))
        back_up(store, tmp_path / "backup")
        with pytest.raises(InputError, match=r"bytes are to be restored, its disk has .* free; make room"):
            restore(tmp_path / "backup", Settings(data=disk / "data"))
        assert not (disk / "data" / REGISTRY).exists()
    finally:
        subprocess.run(["umount", str(disk)], check=True)
    assert same_frames(tmp_path / "backup" / "latest", store, session)


@pytest.mark.skipif(os.geteuid() != 0, reason="acts as two users")
def test_root_backs_up_and_restores_as_the_owner(tmp_path: Path) -> None:
    """Files that root makes belong to the data folder's user, so that the service may read and restore them."""
    user = pwd.getpwnam("nobody")
    tmp_path.chmod(0o755)
    for above in tmp_path.parents:
        if above.stat().st_uid == 0 and above != Path("/") and not above.stat().st_mode & 0o005:
            above.chmod(0o755)
    data = tmp_path / "data"
    store = Store(data)
    captured(store)
    store.close()
    for one in (data, *data.rglob("*")):
        os.chown(one, user.pw_uid, user.pw_gid)

    def strangers(folder: Path) -> list[Path]:
        return [one for one in (folder, *folder.rglob("*")) if one.lstat().st_uid != user.pw_uid]

    backup, again = tmp_path / "backup", tmp_path / "again"
    assert main(["backup", str(backup), "--data", str(data)]) == 0
    assert os.geteuid() == 0 and strangers(backup) == [] and strangers(data) == []
    assert main(["restore", str(backup), "--to", str(again)]) == 0
    assert os.geteuid() == 0 and strangers(again) == []
    theirs = tmp_path / "root's"
    theirs.mkdir()
    assert main(["backup", str(theirs), "--data", str(data)]) == 2
    assert list(theirs.iterdir()) == []


def test_a_registry_of_a_newer_version_is_left_alone(store: Store, tmp_path: Path) -> None:
    with store.transaction() as db:
        db.execute(sa.text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(InputError, match="revision 9999, written by a newer calibench"):
        Store(store.root)
