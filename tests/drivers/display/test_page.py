"""The page's own script, run by node with the least of a browser around it, against the driver."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import drivers.display
from drivers.display.browser import BrowserDisplay
from drivers.errors import Refused

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="node is not installed: the page's script can't be run")
PAGE = Path(drivers.display.__file__).parent / "page.js"


@pytest.fixture
def display() -> Iterator[BrowserDisplay]:
    made = BrowserDisplay("127.0.0.1:0")
    made._listen()
    yield made
    made.close()


@pytest.fixture
def page(display: BrowserDisplay) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    running: list[subprocess.Popen[str]] = []

    def load(rows: int, cols: int, ratio: float, canvas: tuple[int, int]) -> subprocess.Popen[str]:
        harness = Path(__file__).parent / "page_without_browser.mjs"
        numbers = [str(n) for n in (rows, cols, ratio, *canvas)]
        command = [str(NODE), "--experimental-websocket", "--no-warnings", str(harness)]
        address = f"127.0.0.1:{display.port}"
        running.append(subprocess.Popen([*command, address, str(PAGE), *numbers], stdout=subprocess.PIPE, text=True))
        return running[-1]

    yield load
    for process in running:
        process.kill()
        process.communicate()


def painted(process: subprocess.Popen[str]) -> list[str]:
    assert process.stdout is not None
    return process.stdout.readline().split()


def test_the_script_paints_centred_cells_and_says_so(
    display: BrowserDisplay, page: Callable[..., subprocess.Popen[str]]
) -> None:
    process = page(60, 100, 2.0, (60, 100))
    assert painted(process) == ["painted", "0", "-", "-", "-", "-"]  # dark when it has its size
    shown = display.show(np.array([[1, 0, 0], [0, 0, 1]], np.uint8), 10)
    assert (shown.device_pixel_ratio, shown.canvas_px, shown.screen_px) == (2.0, (60, 100), (60, 100))
    # 2 x 3 cells of 10 px in the middle of 60 x 100 px begin at [20, 35] and end before [40, 65].
    assert painted(process) == ["painted", "200", "20", "35", "39", "64"]
    display.stop()
    assert painted(process)[1] == "0"


def test_a_screen_that_the_system_scales_by_a_fraction_is_one_to_one(
    display: BrowserDisplay, page: Callable[..., subprocess.Popen[str]]
) -> None:
    page(1440, 2560, 1.5, (1440, 2560))  # 960 x 1707 CSS pixels, and 1707 x 1.5 = 2560.5
    shown = display.show(np.ones((2, 2), np.uint8))
    assert (shown.canvas_px, shown.screen_px) == ((1440, 2560), (1440, 2560))


@pytest.mark.parametrize(("ratio", "canvas"), [(1.0, (50, 100)), (1.1, (54, 91)), (1.5, (58, 100))])
def test_the_script_refuses_what_is_not_pixel_on_pixel(
    display: BrowserDisplay, page: Callable[..., subprocess.Popen[str]], ratio: float, canvas: tuple[int, int]
) -> None:
    page(60, 100, ratio, canvas)
    with pytest.raises(Refused, match="one canvas pixel isn't one screen pixel"):
        display.show(np.ones((2, 2), np.uint8))


def test_the_script_refuses_what_does_not_fit(
    display: BrowserDisplay, page: Callable[..., subprocess.Popen[str]]
) -> None:
    page(60, 100, 1.0, (60, 100))
    with pytest.raises(Refused, match="61 x 10 px don't fit a screen of 60 x 100 px"):
        display.show(np.ones((61, 10), np.uint8))
