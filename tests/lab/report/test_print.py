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
    file.write_text(render_report(recordings, *made_up(), provenance_of(recordings)))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        # As a print sees it that is made before the script has drawn: the first screen's two charts are there.
        page = browser.new_page(java_script_enabled=False)
        page.goto(file.as_uri())
        stills = [still.bounding_box() for still in page.locator("svg.still").all()]
        page.close()
        page = browser.new_page(viewport={"width": 420, "height": 900})
        page.goto(file.as_uri())
        page.locator(".chart").first.scroll_into_view_if_needed()
        page.wait_for_selector(".chart .main-svg")
        screen = page.evaluate(WIDTHS)
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        paper = page.evaluate(WIDTHS)
        page.evaluate("dispatchEvent(new Event('afterprint'))")
        again = page.evaluate(WIDTHS)
        left = page.evaluate("() => document.querySelectorAll('.chart:has(.main-svg) .still').length")
        browser.close()
    assert len(stills) == 2 and all(box is not None and box["width"] > 400 and box["height"] > 200 for box in stills)
    assert left == 0  # each gave its place to the chart proper
    assert all(drawn <= box < 420 for box, drawn in screen + again)
    assert all(drawn <= box and box > 420 for box, drawn in paper)  # paper has the desk's columns


def test_axe_finds_nothing_and_a_phone_needs_no_scroll_sideways(
    small_set: Callable[..., RecordingSet], made_up: Callable[..., Any], tmp_path: Path
) -> None:
    program = shutil.which("chromium") or missing("no Chromium; `make chromium` installs it")
    from axe_playwright_python.sync_playwright import Axe
    from playwright.sync_api import sync_playwright

    recordings = small_set()
    file = tmp_path / "report.html"
    file.write_text(render_report(recordings, *made_up(), provenance_of(recordings)))
    found: list[Any] = []
    sideways: list[int] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        for scheme in ("light", "dark"):
            for width in (420, 1440):
                page = browser.new_page(color_scheme=scheme, viewport={"width": width, "height": 900})
                page.goto(file.as_uri())
                page.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true; })")
                page.wait_for_function(
                    "[...document.querySelectorAll('.chart')].some(one => one.querySelector('.main-svg'))"
                )
                found += [
                    (scheme, width, one["id"], len(one["nodes"])) for one in Axe().run(page).response["violations"]
                ]
                sideways.append(
                    page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
                )
                page.close()
        browser.close()
    assert found == []
    assert sideways == [0] * 4
