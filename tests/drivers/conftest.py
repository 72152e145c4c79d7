"""Peers for the drivers: one that follows a golden transcript and knows nothing else, and the mocks on real lines."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.transcript import parse
from mocks.wire import Endpoint, Grammar, parse_faults, serve

GOLDEN = Path(__file__).parent.parent / "wire"


class ScriptedPeer:
    """Answers what the transcript says to each request, in order; the last answer to a request is repeated."""

    def __init__(self, transcript: str) -> None:
        self.answers: dict[bytes, list[bytes]] = {}
        self.requests: list[bytes] = []
        self.strange: list[bytes] = []
        (pieces,) = parse(transcript)
        for at, piece in enumerate(pieces):
            if piece.direction == "sent":
                follows = at + 1 < len(pieces) and pieces[at + 1].direction == "received"
                self.answers.setdefault(piece.data, []).append(pieces[at + 1].data if follows else b"")
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                host, _ = self._listener.accept()
            except OSError:
                return
            with host:
                self._talk(host)

    def _talk(self, host: socket.socket) -> None:
        heard = b""
        while data := host.recv(4096):
            heard += data
            while heard:
                known = [request for request in self.answers if heard.startswith(request)]
                if not known:
                    if not any(request.startswith(heard) for request in self.answers):
                        self.strange.append(heard)
                        heard = b""
                    break
                request = max(known, key=len)
                heard = heard[len(request) :]
                self.requests.append(request)
                answers = self.answers[request]
                host.sendall(answers.pop(0) if len(answers) > 1 else answers[0])

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(30)


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
