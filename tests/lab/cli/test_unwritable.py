"""Every command that writes, on a full disk, a read-only one, and in another user's folder: one line, and the remedy
that helps."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from api.keys import Permission, create_key
from lab import cli
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkSequence
from tests.lab import fake_bench
from tests.small_disk import fill, read_only, small_disk

#: DISK, DATA, ID: the disk, its data folder, the session in that.
COMMANDS = (
    "key create other --data DATA",
    "key remove ada --data DATA",
    "key list --data DATA",
    "sessions --data DATA",
    "calibrations list --data DATA",
    "put-back --data DATA",
    "fit ID --data DATA",
    "fit ID --data DATA --json DISK/out/fit.json",
    "report ID --data DATA --out DISK/out/report.html",
    "backup DISK/out/backup --data DATA",
    "serve --port 0 --data DATA",
    "simulate uniform --out DISK/out/frame.npy",
)
WRONG = ("defect", "start it", "DATABASE_URL", "Traceback", "is yours")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A small disk with a data folder, and the id of a session in that."""
    with small_disk(tmp_path / "disk", 16 << 10) as made:
        store, bench = Store(made / "data"), fake_bench.Bench()
        plan = CapturePlan(sequences=(DarkSequence(exposures_s=(0.01,), frames=2),))
        session = CaptureSession.start(store, fake_bench.station(), plan, connect=bench.drivers)
        session.run()
        create_key(store, "ada", Permission.READ)
        store.close()
        (made / "out").mkdir()
        yield made, session.id
        gc.collect()


def arguments(command: str, disk: tuple[Path, str]) -> list[str]:
    made, session = disk
    return command.replace("DATA", f"{made}/data").replace("DISK", str(made)).replace("ID", session).split()


def said(run: Callable[[list[str]], tuple[int, str]], disk: tuple[Path, str], command: str, wanted: str) -> None:
    code, text = run(arguments(command, disk))
    lines = [line for line in text.splitlines() if line]
    assert code == 2 and len(lines) == 1 and wanted in lines[0], (command, code, text)
    assert not any(words in text for words in WRONG), text


@pytest.fixture
def here(capsys: pytest.CaptureFixture[str]) -> Callable[[list[str]], tuple[int, str]]:
    def run(given: list[str]) -> tuple[int, str]:
        code = cli.main(given)
        return code, capsys.readouterr().err

    return run


def test_on_a_read_only_disk(disk: tuple[Path, str], here: Callable[[list[str]], tuple[int, str]]) -> None:
    gc.collect()
    with read_only(disk[0]):
        for command in COMMANDS:
            said(here, disk, command, "mount it writable")


def test_on_a_full_disk(disk: tuple[Path, str], here: Callable[[list[str]], tuple[int, str]]) -> None:
    (disk[0] / "data" / ".reserve").unlink()
    fill(disk[0])
    for command in COMMANDS:
        if not command.startswith("serve"):  # which starts, and can halt and delete
            said(here, disk, command, "make room")


def test_in_a_folder_of_another_user(disk: tuple[Path, str]) -> None:
    """In a process that may not write everywhere, as root may."""
    if os.geteuid() != 0:
        pytest.skip("only root can give a folder to another user")
    subprocess.run(["chown", "--recursive", "12345", str(disk[0])], check=True)
    bounded = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"]

    def run(given: list[str]) -> tuple[int, str]:
        code = "import sys; from lab.cli import main; sys.exit(main(sys.argv[1:]))"
        done = subprocess.run(
            [*bounded, sys.executable, "-c", code, *given], check=False, capture_output=True, text=True
        )
        return done.returncode, done.stderr

    for command in ("key list --data DATA", "simulate uniform --out DISK/out/frame.npy"):
        said(run, disk, command, "have its permissions changed")


def test_the_reserve_makes_way_for_reading(
    disk: tuple[Path, str], here: Callable[[list[str]], tuple[int, str]]
) -> None:
    fill(disk[0])
    assert here(arguments("sessions --data DATA", disk))[0] == 0
