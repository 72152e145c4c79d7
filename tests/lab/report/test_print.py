"""The report on paper, in a real browser."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lab.formats.recording_set import RecordingSet
from lab.report import provenance_of, render_report
from tests.peers import missing

WIDTHS = """() => [...document.querySelectorAll(".chart")].filter(box => box.querySelector(".main-svg"))
    .map(box => [box.clientWidth, box.querySelector(".main-svg").clientWidth])"""


def test_charts_are_drawn_anew_for_paper(
    small_set: Callable[..., RecordingSet], made_up: Callable[..., Any], tmp_path: Path
) -> None:
    program = shutil.which("chromium") or missing("no Chromium; `make chromium` installs it")
    from playwright.sync_api import sync_playwright

    recordings = small_set()
    file = tmp_path / "report.html"
    file.write_text(render_report(recordings, *made_up(), provenance_of(recordings, {})))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": 420, "height": 900})
        page.goto(file.as_uri())
        page.locator(".chart").first.scroll_into_view_if_needed()
        page.wait_for_selector(".chart .main-svg")
        screen = page.evaluate(WIDTHS)
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        paper = page.evaluate(WIDTHS)
        page.evaluate("dispatchEvent(new Event('afterprint'))")
        again = page.evaluate(WIDTHS)
        browser.close()
    assert all(drawn <= box < 420 for box, drawn in screen + again)
    assert all(drawn <= box and box > 420 for box, drawn in paper)  # paper has the desk's columns
