"""Peers for the drivers: one that follows a golden transcript and knows nothing else, and the mocks on real lines."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.contract.scripted import ScriptedPeer
from mocks.wire import Endpoint, Grammar, parse_faults, serve

GOLDEN = Path(__file__).parent.parent / "wire"


@pytest.fixture
def scripted() -> Iterator[Callable[[str], ScriptedPeer]]:
    """Start a peer on the named golden transcript."""
    peers: list[ScriptedPeer] = []

    def start(name: str) -> ScriptedPeer:
        peers.append(ScriptedPeer((GOLDEN / name).read_text(encoding="ascii")))
        return peers[-1]

    yield start
    for peer in peers:
        peer.close()


@pytest.fixture
def served() -> Iterator[Callable[..., str]]:
    """Serve a mock on a real line for the test's time, with the faults of a spec; gives its address."""
    stop = threading.Event()
    threads: list[threading.Thread] = []

    def start(grammar: Grammar, endpoint: Endpoint, faults: str = "") -> str:
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
