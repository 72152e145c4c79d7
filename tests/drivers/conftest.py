"""Peers for the drivers: one that follows a golden transcript and knows nothing else, and the mocks on real lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.contract.scripted import ScriptedPeer

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
