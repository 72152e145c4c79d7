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
from lab.capture.close_shutters import close_shutters
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
    assert close_shutters(store.root, PATIENCE_S) == [session_id]
    assert not bench.opened and bench.log == ["stop monochromator", "close monochromator"]
    assert store.under_way() == [session_id]  # the recovery still finds it
    lock = store.lock(session_id)
    assert lock.acquire(patience_s=0.0)
    lock.release()


def test_a_session_whose_process_lives_is_left_alone(store: Store, bench: Bench) -> None:
    lock = store.lock(left_behind(store))
    assert lock.acquire()
    assert close_shutters(store.root, PATIENCE_S) == []
    assert bench.opened and bench.log == []
    lock.release()


def test_a_finished_session_is_left_alone(store: Store, bench: Bench) -> None:
    store.set_state(left_behind(store), "finished")
    assert close_shutters(store.root, PATIENCE_S) == [] and bench.opened


def test_an_instrument_that_does_not_answer_holds_nothing_up(
    store: Store, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    session_id = left_behind(store)
    bench.unplugged.add("monochromator")
    assert close_shutters(store.root, PATIENCE_S) == []
    released = threading.Event()

    def hangs(self: FakeMonochromator) -> None:
        released.wait(PATIENCE_S)
        raise Disconnected("gone")

    monkeypatch.setattr(FakeMonochromator, "connect", hangs)
    assert close_shutters(store.root, 0.0) == []
    assert store.lock(session_id).acquire(patience_s=0.0)  # the recovery may begin
    released.set()


def test_a_registry_that_cannot_be_read_is_no_matter(tmp_path: Path) -> None:
    assert close_shutters(tmp_path / "none", PATIENCE_S) == []
    (tmp_path / "registry.sqlite").write_bytes(b"not a registry" * 100)
    assert close_shutters(tmp_path, PATIENCE_S) == []
    (tmp_path / "registry.sqlite").write_bytes(b"")
    assert close_shutters(tmp_path, PATIENCE_S) == []


def test_it_loads_no_library_that_takes_time() -> None:
    code = (
        "import sys; import lab.capture.close_shutters, drivers.monochromator.cornerstone260, api.command; "
        "print(sorted({'numpy', 'pydantic', 'sqlalchemy', 'asyncio', 'fastapi'} & set(sys.modules)))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
