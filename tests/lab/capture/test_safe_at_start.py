"""The first thing of a start makes the stations safe that a crash left: the shutter first, for which it needs next to
nothing."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import Disconnected
from lab.capture import safe_at_start as start
from lab.capture.recovery import Recovery
from lab.capture.safe_at_start import Rescue
from lab.capture.store import Store
from tests.lab.capture.test_recovery import left_behind
from tests.lab.fake_bench import Bench, FakeMonochromator

PATIENCE_S = 30.0


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A bench whose shutter is open."""
    made = Bench()

    def driver(family: str, name: str) -> Callable[..., Any]:
        assert name == "fake"
        drivers = made.drivers()
        by_address = {**drivers.all, "left": drivers.cameras["left"], "right": drivers.cameras["right"]}

        def make(address: str, **settings: Any) -> Any:
            assert not settings and by_address[address].who.startswith(family)  # type: ignore[attr-defined]
            return by_address[address]

        return make

    monkeypatch.setattr("lab.capture.safe_at_start.driver", driver)
    return made


def rescued(root: Path, patience_s: float = PATIENCE_S) -> list[str]:
    """The sessions whose stations were made safe; their locks are released."""
    rescue = Rescue(root)
    rescue.stop_others(patience_s)
    safe = rescue.wait_until_safe(patience_s)
    for lock in safe.values():
        lock.release()
    return list(safe)


def test_the_station_is_made_safe_and_the_rest_is_left_to_the_recovery(store: Store, bench: Bench) -> None:
    session_id = left_behind(store)
    rescue = Rescue(store.root)
    assert "connect" not in bench.log and not any("camera" in line for line in bench.log)  # the shutter first
    rescue.stop_others(PATIENCE_S)
    safe = rescue.wait_until_safe(PATIENCE_S)
    assert list(safe) == [session_id]
    assert not bench.opened and not bench.lit
    who = ("monochromator", "display", "stage", "spectroradiometer", "camera left", "camera right")
    assert sorted(bench.log) == sorted(f"{what} {one}" for one in who for what in ("stop", "close"))
    assert store.under_way() == [session_id]  # the recovery still finds it,
    assert not store.lock(session_id).acquire(patience_s=0.0)  # and nobody takes it before
    bench.log.clear()
    recovery = Recovery(store, bench.drivers, made_safe=safe)
    recovery.look()
    assert bench.log == []  # nothing is done twice
    info = store.session(session_id)
    assert info.state == "interrupted" and "its station was made safe" in (info.error or "")
    assert store.lock(session_id).acquire(patience_s=0.0)


def test_locks_that_no_recovery_looked_at_are_released(store: Store, bench: Bench) -> None:
    session_id = left_behind(store)
    rescue = Rescue(store.root)
    rescue.stop_others(PATIENCE_S)
    Recovery(store, bench.drivers, made_safe=rescue.wait_until_safe(PATIENCE_S)).close()
    assert store.lock(session_id).acquire(patience_s=0.0)


def test_a_session_whose_process_lives_is_left_alone(store: Store, bench: Bench) -> None:
    lock = store.lock(left_behind(store))
    assert lock.acquire()
    assert rescued(store.root) == []
    assert bench.opened and bench.log == []
    lock.release()


def test_of_two_sessions_at_the_same_instruments_one_is_left_to_the_recovery(store: Store, bench: Bench) -> None:
    both = {left_behind(store), left_behind(store)}
    assert len(safe := rescued(store.root)) == 1 and set(safe) < both
    assert bench.log.count("stop monochromator") == 1
    for session_id in both:
        assert store.lock(session_id).acquire(patience_s=0.0)


def test_a_station_that_cannot_be_read_is_left_to_the_recovery(store: Store, bench: Bench) -> None:
    session_id = left_behind(store)
    with sqlite3.connect(store.root / "registry.sqlite") as db:
        db.execute("UPDATE sessions SET station = '[1]'")
    db.close()
    assert rescued(store.root) == [] and bench.log == []
    assert store.lock(session_id).acquire(patience_s=0.0)


def test_a_finished_session_is_left_alone(store: Store, bench: Bench) -> None:
    store.set_state(left_behind(store), "finished")
    assert rescued(store.root) == [] and bench.opened


def test_a_person_is_not_asked(store: Store, bench: Bench) -> None:
    session_id = left_behind(store, stage={"driver": "prompt", "address": ""}, monochromator=None)
    assert store.station(session_id).machines.stage is None
    assert rescued(store.root) == [session_id]
    assert not bench.lit and not any("stage" in line for line in bench.log)


def test_an_instrument_that_does_not_answer_holds_nothing_up(
    store: Store, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    session_id = left_behind(store)
    bench.unplugged.add("camera left")
    assert rescued(store.root) == [] and not bench.opened and not bench.lit
    released = threading.Event()

    def hangs(self: FakeMonochromator) -> None:
        released.wait(PATIENCE_S)
        raise Disconnected("gone")

    bench.unplugged.clear()
    bench.lit = True
    monkeypatch.setattr(FakeMonochromator, "connect", hangs)
    assert rescued(store.root, patience_s=0.0) == []
    assert store.lock(session_id).acquire(patience_s=0.0)  # the recovery may begin
    released.set()


def test_a_registry_that_cannot_be_read_is_no_matter(tmp_path: Path) -> None:
    assert rescued(tmp_path / "none") == []
    (tmp_path / "registry.sqlite").write_bytes(b"not a registry" * 100)
    assert rescued(tmp_path) == []
    (tmp_path / "registry.sqlite").write_bytes(b"")
    assert rescued(tmp_path) == []


@pytest.mark.parametrize(
    ("arguments", "environment", "folder"),
    [
        (["serve", "--data", "here"], "elsewhere", "here"),
        (["serve", "--port", "1", "--data=here"], "", "here"),
        (["serve"], "elsewhere", "elsewhere"),
        (["serve", "--data"], "", ""),  # refused later
        (["serve"], "", "calibench-data"),
    ],
)
def test_the_start_looks_into_the_folder_that_the_service_will_use(
    arguments: list[str], environment: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[Path] = []

    class Looking(Rescue):
        def __init__(self, data: Path, tell: Callable[[str], None]) -> None:
            super().__init__(data, tell)
            looked.append(data)

    monkeypatch.setattr(start, "Rescue", Looking)
    monkeypatch.setattr(start, "_at_start", [])
    monkeypatch.delenv("CALIBENCH_DATA", raising=False)
    if environment:
        monkeypatch.setenv("CALIBENCH_DATA", environment)
    monkeypatch.chdir(tmp_path)
    start.make_safe_at_start(arguments)
    assert looked == [Path(folder)] and start.wait_until_safe_at_start() == {}
    monkeypatch.setenv("CALIBENCH_DATABASE_URL", "postgresql://elsewhere")
    start.make_safe_at_start(arguments)
    assert len(looked) == 1  # left to the recovery


def test_the_service_is_loaded_while_the_instrument_answers(
    store: Store, bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    session_id = left_behind(store)
    answers = threading.Event()

    def shut(monochromator: FakeMonochromator) -> bool:
        bench.opened = False
        return True

    monkeypatch.setattr(FakeMonochromator, "shut_at_once", shut)
    monkeypatch.setattr(FakeMonochromator, "connect", lambda _: answers.wait(PATIENCE_S))
    monkeypatch.setattr(start, "_at_start", [])
    start.make_safe_at_start(["serve", "--data", str(store.root)])
    assert not bench.opened and not answers.is_set()
    answers.set()
    safe = start.wait_until_safe_at_start()
    assert list(safe) == [session_id]
    safe[session_id].release()
    shutter, whole = capsys.readouterr().err.splitlines()
    assert shutter == f"session {session_id}: its process ended without a word; its shutter was closed"
    assert whole == f"session {session_id}: its station was made safe"


def test_it_loads_no_library_that_takes_time() -> None:
    code = (
        "import sys; import lab.cli, lab.capture.safe_at_start, drivers.monochromator.cornerstone260; "
        "print(sorted({'numpy', 'pydantic', 'sqlalchemy', 'asyncio', 'fastapi', 'typer', 'rich'} & set(sys.modules)))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
