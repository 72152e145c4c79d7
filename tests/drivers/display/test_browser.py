"""The browser display: its page, its messages, and the mock page on a real WebSocket."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from drivers.display.browser import BrowserDisplay
from drivers.errors import Disconnected, Garbled, InstrumentError, NoAnswer, Refused
from mocks.bench import Bench
from mocks.display import Page, browse
from mocks.wire import parse_faults

CHECKERS = np.array([[0, 1], [1, 0]], np.uint8)


@pytest.fixture
def address() -> str:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return f"127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def browsing(address: str) -> Iterator[Callable[..., None]]:
    """Open the mock page at the display's address, with the faults of a spec."""
    stop = threading.Event()
    threads: list[threading.Thread] = []

    def start(page: Page, faults: str = "") -> None:
        threads.append(threading.Thread(target=browse, args=(page, address, stop, parse_faults(faults))))
        threads[-1].start()

    yield start
    stop.set()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()


class Screen:
    """Remembers what it was told to show."""

    def __init__(self) -> None:
        self.shown: list[tuple[np.ndarray | None, int]] = []

    def show(self, pattern: np.ndarray | None, cell_px: int = 1) -> None:
        self.shown.append((pattern, cell_px))


def test_a_pattern_reaches_the_screen_and_is_confirmed(address: str, browsing: Callable[..., None]) -> None:
    screen = Screen()
    browsing(Page(screen))
    display = BrowserDisplay(address)
    shown = display.show(CHECKERS, 12)
    assert (shown.device_pixel_ratio, shown.canvas_px, shown.screen_px, shown.cell_px) == (
        *(1.0, (1080, 1920)),
        *((1080, 1920), 12),
    )
    pattern, cell_px = screen.shown[-1]
    assert pattern is not None
    np.testing.assert_array_equal(pattern, CHECKERS)
    assert cell_px == 12
    assert display.screen_px() == (1080, 1920)
    assert display.identity().model == "browser"
    display.close()
    assert screen.shown[-1][0] is None  # left dark
    display.close()


def test_the_bench_shows_what_the_driver_sends(address: str, browsing: Callable[..., None]) -> None:
    bench = Bench()
    browsing(Page(bench))
    with BrowserDisplay(address) as display:
        full = np.random.default_rng(1).integers(0, 2, (1080, 1920), dtype=np.uint8)
        assert display.show(full).canvas_px == (1080, 1920)
        with pytest.raises(Refused, match="don't fit"):
            display.show(full, 2)


def test_the_page_comes_back_after_the_driver_was_gone(address: str, browsing: Callable[..., None]) -> None:
    browsing(Page(Screen()))
    for _ in range(2):
        with BrowserDisplay(address) as display:
            display.show(CHECKERS, 3)


@pytest.mark.parametrize(("canvas_px", "ratio"), [((1000, 1920), 1.0), ((1080, 1900), 1.0), ((540, 960), 2.0)])
def test_a_page_that_does_not_fill_its_screen_is_refused(
    address: str, browsing: Callable[..., None], canvas_px: tuple[int, int], ratio: float
) -> None:
    browsing(Page(Screen(), canvas_px=canvas_px, device_pixel_ratio=ratio))
    with BrowserDisplay(address) as display, pytest.raises(Refused, match="full-screen"):
        display.show(CHECKERS)


def test_a_page_that_claims_to_have_shown_on_other_pixels_is_refused(address: str) -> None:
    """The driver looks at the sizes itself."""

    def lie() -> None:
        with connect(f"ws://{address}/ws", proxy=None) as page:
            geometry = {"device_pixel_ratio": 1.25, "canvas_px": [864, 1536], "screen_px": [1080, 1920]}
            page.send(json.dumps({"type": "page", **geometry}))
            number = json.loads(page.recv())["id"]
            page.recv()
            page.send(json.dumps({"type": "shown", "id": number, **geometry}))
            page.recv()

    display = BrowserDisplay(address)
    display._listen()
    liar = threading.Thread(target=lie)
    liar.start()
    with pytest.raises(
        Refused, match=r"a canvas of 864 x 1536 px on a screen of 1080 x 1920 px: one canvas pixel isn't"
    ):
        display.show(CHECKERS)
    display.close()
    liar.join(30)


def test_without_a_browser_it_says_what_to_open(address: str) -> None:
    display = BrowserDisplay(address, connect_timeout_s=0.2)
    with pytest.raises(NoAnswer, match=f"no browser within 0.2 s; open http://{address}/ on the target screen"):
        display.connect()
    display.close()


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("never@1", NoAnswer, "wasn't on the glass within 1 s"),
        ("late=1.5@1", NoAnswer, "wasn't on the glass within 1 s"),
        ("half@1", Garbled, "the page answered"),
        ("wrong@1", Garbled, "the page answered"),
        ("error@1", Refused, "isn't full-screen any more"),
        ("drop@1", NoAnswer, "wasn't on the glass within 1 s"),
        ("unplug=0.2@1", Disconnected, "the browser left"),
    ],
)
def test_every_fault_is_one_error_and_then_it_works_again(
    address: str, browsing: Callable[..., None], fault: str, error: type[Exception], message: str
) -> None:
    browsing(Page(Screen()), fault)
    display = BrowserDisplay(address, timeout_s=1.0)
    display.connect()
    with pytest.raises(error, match=message) as caught:
        display.show(CHECKERS)
    assert "\n" not in str(caught.value)
    if fault.startswith("late"):
        time.sleep(1.0)
    assert display.show(CHECKERS).canvas_px == (1080, 1920)
    display.close()


@pytest.mark.parametrize(
    "pattern",
    [
        np.zeros((2, 2)),
        np.zeros(4, np.uint8),
        np.full((2, 2), 255, np.uint8),
        np.zeros((0, 4), np.uint8),
    ],
)
def test_what_is_no_pattern_is_refused_before_it_is_sent(address: str, pattern: np.ndarray) -> None:
    with pytest.raises(InstrumentError, match=r"a pattern is \(rows, cols\) uint8 of 0 and 1"):
        BrowserDisplay(address).show(pattern)


@pytest.mark.parametrize("wrong", ["8765", "127.0.0.1", "127.0.0.1:x", "127.0.0.1:99999"])
def test_an_address_that_is_none_is_refused(wrong: str) -> None:
    with pytest.raises(InstrumentError, match="no address to listen at"):
        BrowserDisplay(wrong)


def test_the_network_is_refused_unless_it_is_asked_for() -> None:
    with pytest.raises(InstrumentError, match="allow_remote"):
        BrowserDisplay("0.0.0.0:0")
    BrowserDisplay("0.0.0.0:0", allow_remote=True).close()


def test_a_taken_port_is_one_error(address: str) -> None:
    host, _, port = address.rpartition(":")
    with socket.create_server((host, int(port))), pytest.raises(Disconnected, match="can't listen there"):
        BrowserDisplay(address).connect()


def test_a_page_that_has_left_is_not_asked_twice(address: str, browsing: Callable[..., None]) -> None:
    """Its own thread may notice later than who sends to it."""

    class Left:
        def send(self, message: object) -> None:
            raise OSError("closed")

    display = BrowserDisplay(address, connect_timeout_s=30.0)
    display._page = Left()  # type: ignore[assignment]
    with pytest.raises(Disconnected, match="the browser left"):
        display.show(np.ones((2, 2), np.uint8), 4)
    browsing(Page(Screen()))
    assert display.show(np.ones((2, 2), np.uint8), 4).cell_px == 4
    display.close()


def test_files_are_served_to_this_page_alone(address: str) -> None:
    display = BrowserDisplay(address, connect_timeout_s=0.05)
    with pytest.raises(NoAnswer):
        display.connect()

    def get(path: str, host: str = address) -> tuple[int, str, str]:
        connection = http.client.HTTPConnection(address, timeout=30)
        connection.request("GET", path, headers={"Host": host})
        response = connection.getresponse()
        kind, text = response.getheader("Content-Type", ""), response.read().decode()
        connection.close()
        return response.status, kind, text

    status, kind, page = get("/")
    assert (status, kind) == (200, "text/html; charset=utf-8")
    assert '<script type="module" src="page.js">' in page
    assert "https://" not in page  # a lab is offline
    status, kind, script = get("/page.js")
    assert (status, kind) == (200, "text/javascript; charset=utf-8")
    assert "requestAnimationFrame(() => requestAnimationFrame(" in script
    assert get("/../browser.py")[0] == 404
    assert get("/", host="evil.example")[0] == 403
    for origin in ("http://evil.example", f"http://{address}.evil.example"):
        with pytest.raises(InvalidStatus), connect(f"ws://{address}/ws", proxy=None, origin=origin):  # type: ignore[arg-type]
            pass
    with connect(f"ws://{address}/ws", proxy=None, origin=f"http://{address}"):  # type: ignore[arg-type]
        pass
    display.close()
