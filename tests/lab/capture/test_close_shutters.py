"""The first thing of a start closes the shutters that a crash left open, and needs next to nothing for it."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import Disconnected
from lab.capture import close_shutters as close
from lab.capture.close_shutters import Closing
from lab.capture.store import Store
from tests.lab.capture.test_recovery import left_behind
from tests.lab.fake_bench import Bench, FakeMonochromator

PATIENCE_S = 30.0


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store(tmp_path)
    yield opened
    opened.close()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A bench whose shutter is open."""
    made = Bench()

    def driver(family: str, name: str) -> Callable[..., Any]:
        assert (family, name) == ("monochromator", "fake")
        return lambda address, **settings: FakeMonochromator(made)

    monkeypatch.setattr("lab.capture.close_shutters.driver", driver)
    return made


def test_the_shutter_is_closed_and_the_rest_is_left_to_the_recovery(store: Store, bench: Bench) -> None:
    session_id = left_behind(store)
    assert Closing(store.root).closed(PATIENCE_S) == [session_id]
    assert not bench.opened and bench.log == ["stop monochromator", "close monochromator"]
    assert store.under_way() == [session_id]  # the recovery still finds it
    lock = store.lock(session_id)
    assert lock.acquire(patience_s=0.0)
    lock.release()


def test_a_session_whose_process_lives_is_left_alone(store: Store, bench: Bench) -> None:
    lock = store.lock(left_behind(store))
    assert lock.acquire()
    assert Closing(store.root).closed(PATIENCE_S) == []
    assert bench.opened and bench.log == []
    lock.release()


def test_a_finished_session_is_left_alone(store: Store, bench: Bench) -> None:
    store.set_state(left_behind(store), "finished")
    assert Closing(store.root).closed(PATIENCE_S) == [] and bench.opened


def test_an_instrument_that_does_not_answer_holds_nothing_up(
    store: Store, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    session_id = left_behind(store)
    bench.unplugged.add("monochromator")
    assert Closing(store.root).closed(PATIENCE_S) == []
    released = threading.Event()

    def hangs(self: FakeMonochromator) -> None:
        released.wait(PATIENCE_S)
        raise Disconnected("gone")

    monkeypatch.setattr(FakeMonochromator, "connect", hangs)
    assert Closing(store.root).closed(0.0) == []
    assert store.lock(session_id).acquire(patience_s=0.0)  # the recovery may begin
    released.set()


def test_a_registry_that_cannot_be_read_is_no_matter(tmp_path: Path) -> None:
    assert Closing(tmp_path / "none").closed(PATIENCE_S) == []
    (tmp_path / "registry.sqlite").write_bytes(b"not a registry" * 100)
    assert Closing(tmp_path).closed(PATIENCE_S) == []
    (tmp_path / "registry.sqlite").write_bytes(b"")
    assert Closing(tmp_path).closed(PATIENCE_S) == []


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

    class Looking(Closing):
        def __init__(self, data: Path, tell: Callable[[str], None]) -> None:
            super().__init__(data, tell)
            looked.append(data)

    monkeypatch.setattr(close, "Closing", Looking)
    monkeypatch.setattr(close, "_at_start", [])
    monkeypatch.delenv("CALIBENCH_DATA", raising=False)
    if environment:
        monkeypatch.setenv("CALIBENCH_DATA", environment)
    monkeypatch.chdir(tmp_path)
    close.close_at_start(arguments)
    assert looked == [Path(folder)] and close.closed_at_start() == []
    monkeypatch.setenv("CALIBENCH_DATABASE_URL", "postgresql://elsewhere")
    close.close_at_start(arguments)
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
    monkeypatch.setattr(close, "_at_start", [])
    close.close_at_start(["serve", "--data", str(store.root)])
    assert not bench.opened and not answers.is_set()
    answers.set()
    assert close.closed_at_start() == [session_id]
    assert capsys.readouterr().err.startswith(f"session {session_id}: its process ended without a word; its shutter")


def test_it_loads_no_library_that_takes_time() -> None:
    code = (
        "import sys; import lab.cli, lab.capture.close_shutters, drivers.monochromator.cornerstone260; "
        "print(sorted({'numpy', 'pydantic', 'sqlalchemy', 'asyncio', 'fastapi', 'typer', 'rich'} & set(sys.modules)))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
