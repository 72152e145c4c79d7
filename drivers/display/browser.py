"""A browser, full-screen on the target screen, as display.

The driver serves one page and a WebSocket on the same port. A request is a JSON text and the cells as one binary
message; the page answers once the pattern is on the glass:

    -> {"type": "show", "id": 7, "rows": 64, "cols": 64, "cell_px": 4}   and 4096 bytes of 0 and 1
    <- {"type": "shown", "id": 7, "device_pixel_ratio": 1, "canvas_px": [1080, 1920], "screen_px": [1080, 1920]}
    <- {"type": "refused", "id": 7, "reason": "...", ...}

On its own the page says `{"type": "page", "user_agent": "...", ...}` when it connects and when it changes size.
"""

from __future__ import annotations

import itertools
import json
import queue
import threading
import time
from contextlib import suppress
from http import HTTPStatus
from importlib.resources import files
from ipaddress import ip_address
from typing import Any

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from drivers.display.base import Display, Shown
from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer, Refused
from drivers.instrument import Identity, Recorder

_FILES = {"/": ("page.html", "text/html; charset=utf-8"), "/page.js": ("page.js", "text/javascript; charset=utf-8")}
_NOT_ONE_TO_ONE = 1
_NO_PAGE = object()


class BrowserDisplay(Display):
    """Serves the page at `address` (host:port) and shows patterns on it.

    The newest page is the screen. `connect_timeout_s`: how long to wait for one to open the address; `timeout_s`: for
    a pattern to be on the glass. Addresses other than this machine's own need `allow_remote`.
    """

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 5.0,
        connect_timeout_s: float = 20.0,
        allow_remote: bool = False,
        recorder: Recorder | None = None,
    ) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or int(port) > 65535:
            raise InstrumentError(
                f"display: {address!r} is no address to listen at; write host:port in the station file"
            )
        self.host, self.port = host.strip("[]"), int(port)
        if not allow_remote and not _is_loopback(self.host):
            raise InstrumentError(
                f"display at {address}: anyone on the network could open it; listen at 127.0.0.1 or set allow_remote "
                "= true"
            )
        self.timeout_s = timeout_s
        self.connect_timeout_s = connect_timeout_s
        self._allow_remote = allow_remote
        self._record = recorder or (lambda direction, data: None)
        self._lock = threading.RLock()
        self._stopping = threading.Lock()  # a stop ends what others wait for, but no stop
        self._change = threading.Condition()
        self._page: ServerConnection | None = None
        self._geometry: dict[str, Any] = {}
        self._answers: queue.Queue[object] = queue.Queue()
        self._interrupted = threading.Event()
        self._numbers = itertools.count(1)
        self._server: Server | None = None

    @property
    def url(self) -> str:
        """What to open on the target screen."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/"

    # --- the abstraction --------------------------------------------------------------------------------------------

    def connect(self) -> None:
        with self._lock:
            self._listen()
            self._await_page()

    def identity(self) -> Identity:
        with self._lock:
            self.connect()
            return Identity("", "browser", "", str(self._geometry.get("user_agent", "")))

    def screen_px(self) -> tuple[int, int]:
        with self._lock:
            self.connect()
            return _size(self._geometry.get("screen_px"), self._name)

    def show(self, pattern: NDArray[np.uint8], cell_px: int = 1) -> Shown:
        cells = np.ascontiguousarray(pattern)
        if cells.ndim != 2 or cells.dtype != np.uint8 or cells.size == 0 or cells.max() > 1:
            raise InstrumentError(
                f"{self._name}: a pattern is (rows, cols) uint8 of 0 and 1; this one isn't: convert it"
            )
        if cell_px < 1:
            raise InstrumentError(f"{self._name}: cells of {cell_px} screen pixels can't be shown; give 1 or more")
        return self._request(cells, cell_px)

    def stop(self) -> None:
        if self._page is None:
            return
        with self._stopping:
            self._interrupted.set()
            with self._lock:
                self._interrupted.clear()
                if self._page is not None:
                    self._request(np.zeros((0, 0), np.uint8), 1)

    def close(self) -> None:
        with suppress(InstrumentError):
            self.stop()
        with self._lock:
            server, self._server = self._server, None
            page, self._page = self._page, None
            if page is not None:
                with suppress(OSError, WebSocketException):
                    page.close()
            if server is not None:
                server.shutdown()

    # --- the wire ---------------------------------------------------------------------------------------------------

    @property
    def _name(self) -> str:
        return f"display at {self.host}:{self.port}"

    def _listen(self) -> None:
        if self._server is not None:
            return
        try:
            self._server = serve(
                self._serve_page,
                self.host,
                self.port,
                process_request=self._serve_file,
                max_size=1 << 16,
                compression=None,
            )
        except OSError as error:
            raise Disconnected(
                f"{self._name}: can't listen there ({error.strerror or error}); free the port or choose another in "
                "the station file"
            ) from error
        self.port = self._server.socket.getsockname()[1]
        threading.Thread(target=self._server.serve_forever, name=f"{self._name} server", daemon=True).start()

    def _await_page(self) -> ServerConnection:
        with self._change:
            end = time.monotonic() + self.connect_timeout_s
            while self._page is None:
                left = end - time.monotonic()
                if self._interrupted.is_set():
                    raise Interrupted(f"{self._name}: stopped while waiting for a browser; start again")
                if left <= 0:
                    raise NoAnswer(
                        f"{self._name}: no browser within {self.connect_timeout_s:g} s; "
                        f"open {self.url} on the target screen and make it full-screen"
                    )
                self._change.wait(min(left, 0.1))
            return self._page

    def _request(self, cells: NDArray[np.uint8], cell_px: int) -> Shown:
        with self._lock:
            self._listen()
            page = self._await_page()
            number = next(self._numbers)
            rows, cols = cells.shape
            while not self._answers.empty():
                self._answers.get_nowait()
            header = json.dumps({"type": "show", "id": number, "rows": rows, "cols": cols, "cell_px": int(cell_px)})
            try:
                page.send(header)
                page.send(cells.tobytes())
            except (OSError, WebSocketException) as error:
                with self._change:
                    if self._page is page:  # its own thread may not have noticed yet
                        self._page = None
                raise self._gone() from error
            self._record("sent", header.encode() + f" + {cells.size} cells".encode())
            return self._await_answer(number, int(cell_px))

    def _await_answer(self, number: int, cell_px: int) -> Shown:
        end = time.monotonic() + self.timeout_s
        while True:
            if self._interrupted.is_set():
                raise Interrupted(f"{self._name}: stopped while a pattern was to be shown; start again")
            try:
                answer = self._answers.get(timeout=max(0.0, min(0.05, end - time.monotonic())))
            except queue.Empty:
                if time.monotonic() >= end:
                    raise NoAnswer(
                        f"{self._name}: the pattern wasn't on the glass within {self.timeout_s:g} s; "
                        "check that the page is in front, not minimised or asleep"
                    ) from None
                continue
            if answer is _NO_PAGE:
                raise self._gone()
            if not isinstance(answer, dict) or answer.get("type") not in {"shown", "refused"}:
                raise Garbled(f"{self._name}: the page answered {str(answer)[:60]!r}; load {self.url} again")
            if answer.get("id") != number:
                continue
            if answer["type"] == "refused":
                raise Refused(f"{self._name}: {' '.join(str(answer.get('reason', '')).split())}", _NOT_ONE_TO_ONE)
            return self._check_answer(answer, cell_px)

    def _check_answer(self, answer: dict[str, Any], cell_px: int) -> Shown:
        canvas_px, screen_px = (_size(answer.get(key), self._name) for key in ("canvas_px", "screen_px"))
        if canvas_px != screen_px:
            raise Refused(
                f"{self._name}: a canvas of {canvas_px[0]} x {canvas_px[1]} px on a screen of {screen_px[0]} x "
                f"{screen_px[1]} px: "
                "one canvas pixel isn't one screen pixel; make the page full-screen at a zoom of 100 %",
                _NOT_ONE_TO_ONE,
            )
        ratio = answer.get("device_pixel_ratio")
        if not isinstance(ratio, int | float) or not ratio > 0:
            raise Garbled(f"{self._name}: the page reports a device pixel ratio of {ratio!r}; load {self.url} again")
        return Shown(float(ratio), canvas_px, screen_px, cell_px)

    def _gone(self) -> Disconnected:
        return Disconnected(f"{self._name}: the browser left while a pattern was to be shown; open {self.url} again")

    # --- in the server's threads ------------------------------------------------------------------------------------

    def _serve_file(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the page and its script; None lets a WebSocket through.

        Host and Origin are checked: another page in the same browser must not pass for the screen.
        """
        host = request.headers.get("Host", "")
        name = host.rpartition(":")[0] or host
        origin = request.headers.get("Origin")
        if not self._allow_remote and not _is_loopback(name.strip("[]")):
            return connection.respond(HTTPStatus.FORBIDDEN, "Open this page by its own address.\n")
        if origin is not None and origin.partition("://")[2] != host:
            return connection.respond(HTTPStatus.FORBIDDEN, "Another page may not use this display.\n")
        if request.path == "/ws":
            return None
        if request.path not in _FILES:
            return connection.respond(HTTPStatus.NOT_FOUND, "There is nothing here.\n")
        file, kind = _FILES[request.path]
        response = connection.respond(HTTPStatus.OK, (files("drivers.display") / file).read_text(encoding="utf-8"))
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = kind
        response.headers["Cache-Control"] = "no-store"
        return response

    def _serve_page(self, connection: ServerConnection) -> None:
        with suppress(ConnectionClosed):
            for message in connection:
                data = message if isinstance(message, bytes) else message.encode("utf-8")
                self._record("received", data)
                try:
                    answer = json.loads(data)
                except ValueError:
                    answer = data.decode("latin-1")
                if isinstance(answer, dict) and answer.get("type") == "page":
                    self._welcome(connection, answer)
                elif connection is self._page:
                    self._answers.put(answer)
        with self._change:
            if self._page is connection:
                self._page = None
                self._answers.put(_NO_PAGE)

    def _welcome(self, connection: ServerConnection, geometry: dict[str, Any]) -> None:
        with self._change:
            self._page = connection
            self._geometry = geometry
            self._change.notify_all()


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def _size(value: object, name: str) -> tuple[int, int]:
    if not (isinstance(value, list) and len(value) == 2 and all(isinstance(v, int) and v > 0 for v in value)):
        raise Garbled(f"{name}: the page reports a size of {str(value)[:40]!r}; load it again")
    return value[0], value[1]
