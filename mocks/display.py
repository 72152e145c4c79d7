"""The mock display: the messages of `drivers/display/page.js` without a browser.

`Page` is the grammar, pure: messages in, messages out. `browse` connects one to a driver's WebSocket, and again
whenever the driver comes back, as a page left open in a browser does.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from mocks.wire import Fault, FaultPlan

#: How long a page waits before it tries the driver again.
RETRY_S = 0.1


class MockScreen(Protocol):
    """What shows patterns: `mocks.bench.Bench`, or `mocks.lamp.Lamp` alone."""

    def show(self, pattern: NDArray[np.uint8] | None, cell_px: int = 1) -> None: ...


class Page:
    """The page's state machine, on a screen of `rows` x `cols` pixels of which its canvas covers `canvas_px`."""

    def __init__(
        self,
        screen: MockScreen,
        rows: int = 1080,
        cols: int = 1920,
        device_pixel_ratio: float = 1,
        canvas_px: tuple[int, int] | None = None,
    ) -> None:
        self._screen = screen
        self._screen_px = (rows, cols)
        self._canvas_px = canvas_px or (rows, cols)
        self._device_pixel_ratio = device_pixel_ratio
        self._announced: dict[str, Any] | None = None

    def opened(self) -> list[str]:
        """Return what the page says when it has connected."""
        self._announced = None
        return [self._tell({"type": "page", "user_agent": "calibench mock display"})]

    def receive(self, message: str | bytes) -> list[str]:
        """Return what the page answers to one message; a page ignores what it doesn't understand."""
        if isinstance(message, str):
            try:
                announced = json.loads(message)
            except ValueError:
                announced = None
            self._announced = announced if isinstance(announced, dict) else None
            return []
        request, self._announced = self._announced, None
        size = [request.get(key) for key in ("rows", "cols", "cell_px")] if request else []
        if request is None or request.get("type") != "show" or not all(isinstance(n, int) and n >= 0 for n in size):
            return []
        return self._paint(message, request.get("id"), *(int(str(n)) for n in size))

    def _paint(self, cells: bytes, number: object, rows: int, cols: int, cell_px: int) -> list[str]:
        if self._canvas_px != self._screen_px:
            return [self._refuse(number, "the page doesn't fill the screen; make it full-screen")]
        if rows * cell_px > self._canvas_px[0] or cols * cell_px > self._canvas_px[1]:
            return [self._refuse(number, f"{rows * cell_px} x {cols * cell_px} px don't fit; ask for smaller cells")]
        if len(cells) != rows * cols:
            return []
        self._screen.show(np.frombuffer(cells, np.uint8).reshape(rows, cols) if rows * cols else None, max(1, cell_px))
        return [self._tell({"type": "shown", "id": number, "cell_px": cell_px})]

    def _refuse(self, number: object, reason: str) -> str:
        return self._tell({"type": "refused", "id": number, "reason": reason})

    def _tell(self, message: dict[str, Any]) -> str:
        geometry = {
            "device_pixel_ratio": self._device_pixel_ratio,
            "canvas_px": list(self._canvas_px),
            "screen_px": list(self._screen_px),
        }
        return json.dumps(message | geometry)


def browse(page: Page, address: str, stop: threading.Event, faults: Iterable[Fault] = ()) -> None:
    """Keep `page` connected to the driver at `address` (host:port) until `stop`; faults count its answers."""
    broken = FaultPlan(faults)
    answers = 0
    while not stop.is_set():
        try:
            with connect(
                f"ws://{address}/ws", open_timeout=5, max_size=1 << 24, compression=None, proxy=None
            ) as socket:
                for answer in page.opened():
                    socket.send(answer)
                while not stop.is_set():
                    try:
                        message = socket.recv(timeout=0.05)
                    except TimeoutError:
                        continue
                    for answer in page.receive(message):
                        answers += 1
                        if not _answer(socket, answer, broken.of(answers), stop):
                            break
        except (OSError, WebSocketException):
            stop.wait(RETRY_S)


def _answer(socket: ClientConnection, answer: str, faults: list[Fault], stop: threading.Event) -> bool:
    """Send an answer as the faults will have it; False once the page is gone."""
    for fault in faults:
        if fault.kind == "late":
            stop.wait(3.0 if fault.value is None else fault.value)
        elif fault.kind in {"never", "drop"}:
            return True
        elif fault.kind == "half":
            answer = answer[: len(answer) // 2]
        elif fault.kind == "wrong":
            answer = json.dumps({"type": "error"})
        elif fault.kind == "error":
            answer = json.dumps(
                {**json.loads(answer), "type": "refused", "reason": "the page isn't full-screen any more"}
            )
        elif fault.kind == "unplug":
            with contextlib.suppress(OSError):
                socket.close()
            stop.wait(1.0 if fault.value is None else min(fault.value, threading.TIMEOUT_MAX))
            return False
    socket.send(answer)
    return True
