"""Talking to a grammar without a line: bytes in, everything it says until it is idle out."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest

from mocks.wire import Grammar, Pty, serve

Talk = Callable[[Grammar, bytes], bytes]


@pytest.fixture(scope="session")
def talk() -> Talk:
    def talk_to(grammar: Grammar, data: bytes) -> bytes:
        said = b"".join(grammar.receive(data))
        for _ in range(10_000):
            wait_s = grammar.wait_s
            if wait_s is None:
                return said
            grammar.clock.sleep(wait_s)
            said += b"".join(grammar.elapse())
        raise AssertionError(f"{type(grammar).__name__} never comes to rest")

    return talk_to


@pytest.fixture
def served() -> Iterator[Callable[[Grammar], str]]:
    """Serve a grammar on a pseudo-terminal for the test's time; gives its address."""
    stop = threading.Event()
    threads: list[threading.Thread] = []

    def start(grammar: Grammar) -> str:
        endpoint, listening = Pty(), threading.Event()
        announce = {"announce": lambda address: listening.set()}
        threads.append(threading.Thread(target=serve, args=(grammar, endpoint, stop), kwargs=announce))
        threads[-1].start()
        assert listening.wait(30)
        return endpoint.address

    yield start
    stop.set()
    for thread in threads:
        thread.join(30)
