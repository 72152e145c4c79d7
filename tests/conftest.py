"""Order of the whole suite's tests, and mocks on real lines."""

from __future__ import annotations

import itertools
import signal
import threading
from collections.abc import Callable, Iterator

import pytest
from hypothesis import HealthCheck, settings

from drivers.found_settings import FoundSettings
from mocks.wire import Endpoint, Grammar, Pty, parse_faults, serve

# No test states a time: a busy machine's pause of a second is no fault of what is tested.
settings.register_profile("any machine", settings.default, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

# Whoever starts the suite in the background may have it ignore Ctrl-C, and with it the commands that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


_tests = itertools.count()


@pytest.fixture(autouse=True)
def instruments_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Settings found on a mock are this test's: the next one's mock has the same serial number."""
    FoundSettings.keep_in(tmp_path_factory.getbasetemp() / "found" / str(next(_tests)) / "instruments")


@pytest.fixture
def served() -> Iterator[Callable[..., str]]:
    """Serve a mock on a real line (a pseudo-terminal, if not told) for the test's time, with the faults of a spec;
    gives its address."""
    stop = threading.Event()
    threads: list[threading.Thread] = []

    def start(grammar: Grammar, endpoint: Endpoint | None = None, faults: str = "") -> str:
        endpoint = endpoint or Pty()
        listening = threading.Event()
        options = {"faults": parse_faults(faults), "announce": lambda address: listening.set()}
        threads.append(threading.Thread(target=serve, args=(grammar, endpoint, stop), kwargs=options))
        threads[-1].start()
        assert listening.wait(30)
        return endpoint.address

    yield start
    stop.set()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run tests with a stated time limit first: a long one at the end would keep the other worker waiting."""
    items.sort(key=lambda item: item.get_closest_marker("timeout") is None)
