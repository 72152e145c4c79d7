"""A peer that follows a golden transcript and knows nothing else: what a driver is tested against, apart from its
mock."""

from __future__ import annotations

import socket
import threading
from types import TracebackType
from typing import Self

from drivers.transcript import parse


class ScriptedPeer:
    """Answers on a TCP port what a transcript of one conversation says to each request, in order; the last answer to a
    request is repeated.

    `address`: what a driver opens. `requests`: what was asked that the transcript knows. `strange`: what it doesn't
    know."""

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
        """End it."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(30)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
