"""The operator's page in a real Chromium: axe, light and dark, a phone's width, the keyboard, the halt button, a
calibration certified.

`make chromium peers` installs the browser and its driver. Without them these tests are skipped on a desk, and fail in
CI.
"""

from __future__ import annotations

import base64
import hashlib
import re
import shutil
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import pytest

from api.client import ServiceClient
from lab.calibration.camera_models import bring_in
from lab.capture.by_hand import ByHand, left_by_hand
from lab.capture.queue import put_into_queue
from lab.capture.station import Drivers, Station, read_station
from lab.formats.camera_file import CameraFile, default_camera, write_camera
from lab.formats.recording_set import archive, packed
from lab.formats.results import Resolution, ResolveJournal, RivalOdds
from lab.pipeline import PipelineProgress, PipelineRequest, Step
from lab.resolve import JOURNAL
from lab.twin.changes import Changes
from lab.twin.session import future_session
from sim.sensor.mosaic import first_pixels
from tests.api.conftest import STATION, Running, serving, until_state
from tests.api.routes.test_confirm import PERSON, begun, confirm
from tests.api.routes.test_findings import diagnosis
from tests.lab.calibration.test_life import fitted
from tests.lab.fake_bench import Bench
from tests.lab.twin.test_twin import PLAN, TRUTH, trained
from tests.lab.twin.test_twin import captured as twin_captured
from tests.peers import browser_program

pytestmark = pytest.mark.extra  # drives a browser

PHONE, TABLET, DESK, WIDE = ({"width": wide, "height": 860} for wide in (390, 768, 1280, 1600))
READ_NOISE_E = (2.0, 2.01, 2.15)
LIMITS = 'valid_days = 90\n[[limit]]\nfigure = "noise read_noise_e"\ngood = [1.9, 2.05]\nwarn = [1.8, 2.2]\n'
PATIENCE_MS = 60_000.0
#: Drops a file of that name and content on a place.
DROP = """async ([name, content]) => {
    const data = new DataTransfer();
    data.items.add(new File([Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0))], name));
    document.getElementById("PLACE").dispatchEvent(new DragEvent("drop", {dataTransfer: data, bubbles: true, cancelable: true})) }"""  # noqa: E501
#: Keeps every text that the answer of a halt ever shows.
ALL_TEXTS = """() => { window.haltTexts = []; const place = document.getElementById("halt-told");
    new MutationObserver(() => window.haltTexts.push(place.textContent)).observe(place, {childList: true, characterData: true, subtree: true}) }"""  # noqa: E501
#: Has the page show what the stations' instruments have answered by now.
REFRESH = """async () => (await import("/static/page.js")).tellHalts(await (await fetch("/api/v1/stations")).json())"""
#: Has nothing follow the sessions that are started: a pipeline by default.
NOTHING_FOLLOWS = """() => { const then = document.querySelector("#start-form select[name=then]");
    window.followed = then.value; then.value = ""; then.dispatchEvent(new Event("change", {bubbles: true})) }"""
#: A station's light source.
LAMP = """
[light_source]
driver = "fake"
address = "lamp"
[light_source.lights."3000 K"]
colour_temperature_k = 3000
channels = {460 = 0.14, 635 = 0.78}
[light_source.lights."460 nm"]
wavelength_nm = 460
channels = {460 = 1.0}
"""
#: Where the planes of the fakes' frames begin, by channel.
FIRSTS = first_pixels("RGGB")
#: The views by their addresses, and what stands in each when it is complete. Words in capitals: ids.
VIEWS = {
    "/": "#plan-words:has-text('3 sequences')",
    "/sessions": "#sessions tr:has(.state.finished)",
    "/sessions?search=nightly&verdict=explained": "#sessions tr:has-text('explained')",
    "/sessions/SESSION/live": "#transfer svg .c1",  # from the process that looks at the captures
    "/sessions/SESSION/findings": "#findings-proofs figure:nth-child(2) svg .c3",
    "/sessions/SESSION/figures": "#figures .mark",
    "/sessions/SESSION/frames": "#captures img",
    "/sessions/SESSION/frames/FRAME": "#inspect-profile svg .line",
    "/sessions/SESSION/jobs": "#session-tabs [aria-current]:has-text('Jobs')",
    "/recordings": "#recordings td",
    "/recordings/SENT/findings": "#no-findings:not(:empty)",
    "/recordings/SENT/figures": "#no-figures:not(:empty)",
    "/recordings/SENT/frames": "#captures img",
    "/recordings/SENT/frames/1": "#inspect-profile svg .line",
    "/recordings/SENT/jobs": "#session-tabs [aria-current]:has-text('Jobs')",
    "/calibrations": "#calibrations tr:nth-child(3)",
    "/calibrations/FIT": "#calibration-judgements .mark",
    "/drift": "#drift-rows .cell.drifted",
    "/stations/fakes": "#devices tr:nth-child(5)",
    "/jobs": "#no-jobs",
    "/models": "#models tr",
    "/predictions": "#no-predictions:not([hidden])",
    "/nothing": "#view-none a",
}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    program = browser_program()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", "--disable-gpu"])
        yield started
        started.close()


@dataclass(frozen=True)
class Prepared:
    """A data folder to copy, and the keys that it knows."""

    root: Path
    keys: dict[str, str]


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    """Three finished sessions that were fitted, the last one drifted and diagnosed; a session that is held; a recording
    set."""
    root = tmp_path_factory.mktemp("prepared") / "data"
    with serving(root) as running, running.client() as client:
        (running.store.root / "limits.toml").write_text(LIMITS)
        asked = {"station": "fakes", "quick": True, "sequences": ["dark", "flat"], "name": "nightly"}
        waits = client.post(
            "/api/v1/sessions", json=asked | {"queue": True, "not_before": "2999-01-01T00:00:00Z"}
        ).json()
        for value in READ_NOISE_E:
            started = client.post("/api/v1/sessions", json=asked).json()
            until_state(client, started["id"], "finished")
            running.store.add_result("fit", started["id"], fitted(value).model_dump(mode="json"))
        running.store.add_result("diagnose", started["id"], diagnosis().model_dump(mode="json"))
        # With a time, so that it doesn't begin when a run that held it, too, is resumed and finishes.
        put_into_queue(running.store, waits["id"], datetime(2999, 1, 1, tzinfo=UTC), held="halted by a test")
        with ServiceClient(running.url, running.keys["admin"]) as sender:
            archive = sender.fetch_session(started["id"], running.store.root / "nightly.zip")
            sender.send_recordings(archive)
        return Prepared(running.store.root, running.keys)


@pytest.fixture
def lab(prepared: Prepared, tmp_path: Path) -> Iterator[Running]:
    """A service on a copy of the prepared folder, so that no test finds what another left."""
    with serving(shutil.copytree(prepared.root, tmp_path / "lab"), keys=prepared.keys) as running:
        yield running


def views(ids: dict[str, str]) -> Iterator[tuple[str, str]]:
    """Each view's address, and what stands in it."""
    for address, there in VIEWS.items():
        yield "/".join(ids.get(part, part) for part in address.split("/")), there


class Watched:
    """A page of its own, logged in; what its console complains of and where it sends requests is kept."""

    def __init__(self, browser: Any, running: Running, scheme: str = "light", viewport: dict[str, int] = DESK) -> None:
        self.context = browser.new_context(color_scheme=scheme, viewport=viewport)
        self.page = self.context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.complaints: list[str] = []
        self.elsewhere: list[str] = []
        self.page.on("console", lambda told: told.type == "error" and self.complaints.append(told.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda asked: asked.url.startswith(running.url) or self.elsewhere.append(asked.url))
        self.page.goto(f"{running.url}/")
        self.page.wait_for_selector("#login-form")

    def log_in(self, running: Running, scope: str = "admin") -> None:
        self.page.fill("input[name=key]", running.keys[scope])
        self.page.press("input[name=key]", "Enter")
        self.page.wait_for_selector("#view-desk:not([hidden])")
        self.page.wait_for_selector("#strip li .state:not(:empty)")
        self.page.evaluate(NOTHING_FOLLOWS)

    def go(self, address: str, there: str = "") -> None:
        """Go to a view; `there`: what stands in it then."""
        self.page.evaluate("address => { location.hash = address }", address)
        self.page.wait_for_selector(there or "section.view:not([hidden]) h2", state="attached" if there else "visible")

    def faults(self) -> list[str]:
        """What axe finds."""
        from axe_playwright_python.sync_playwright import Axe

        found = Axe().run(self.page).response["violations"]
        return [f"{one['id']} {node['target']}: {node['failureSummary']}" for one in found for node in one["nodes"]]

    def sideways_px(self) -> int:
        """By how much the page is wider than the window."""
        wider = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
        found: int = self.page.evaluate(wider)
        return found

    def focused(self) -> dict[str, Any]:
        """What has the keyboard's focus, and whether one sees that."""
        code = """() => { const on = document.activeElement, style = getComputedStyle(on), box = on.getBoundingClientRect();
            const middle = (from, to, most) => (Math.max(from, 0) + Math.min(to, most)) / 2;
            const there = document.elementFromPoint(middle(box.left, box.right, innerWidth), middle(box.top, box.bottom, innerHeight));
            return {tag: on.tagName, text: on.textContent.trim().slice(0, 40), name: on.name ?? "", kind: on.matches("#captures a")
                    ? "figure" : on.type || on.tagName.toLowerCase(), outline: style.outlineStyle + " " + style.outlineWidth,
                    seen: Boolean(there) && (on.contains(there) || there.contains(on))} }"""  # noqa: E501
        found: dict[str, Any] = self.page.evaluate(code)
        return found

    def tab_to(self, wanted: str) -> None:
        """Go on with Tab until the element is reached that has that name, kind or text (a pattern); what is
        passed shows that it has the focus, and nothing covers it."""
        for _ in range(90):
            self.page.keyboard.press("Tab")
            on = self.focused()
            if on["tag"] == "BODY":  # past the last one: the browser's own
                continue
            assert on["outline"] not in ("none 0px", "none 3px"), on
            assert on["seen"], on
            if wanted in (on["name"], on["kind"]) or re.fullmatch(wanted, on["text"]):
                return
        pytest.fail(f"{wanted!r} can't be reached by the keyboard")

    def press(self, key: str, there: str = "") -> None:
        """Press a key and wait until its effect is there. Whatever became of the element that had the focus, one has
        it."""
        self.page.keyboard.press(key)
        if there:
            self.page.wait_for_selector(there)
        on = self.focused()
        assert on["tag"] != "BODY", f"{key} lost the focus on the way to {there}"

    def can_halt(self) -> bool:
        """Whether a click in the middle of the halt button reaches it."""
        code = """() => { const button = document.getElementById("halt"), box = button.getBoundingClientRect();
            return document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2) === button }"""
        found: bool = self.page.evaluate(code)
        return found

    def close(self) -> None:
        self.context.close()
        assert self.elsewhere == []  # a laboratory has no network
        # The page asks whether it is logged in before it is: the browser notes the 401.
        assert [line for line in self.complaints if "401" not in line] == []


@pytest.fixture
def ids(lab: Running) -> dict[str, str]:
    """Ids of the diagnosed session and of a frame of it, of the recording set, and of the newest calibration."""
    with lab.client() as client:
        session = next(one for one in client.get("/api/v1/sessions").json() if one["verdict"] == "explained")
        return {
            "SESSION": session["id"],
            "FRAME": str(client.get(f"/api/v1/sessions/{session['id']}/captures").json()[0]["id"]),
            "SENT": client.get("/api/v1/recordings").json()[-1]["id"],
            "FIT": client.get("/api/v1/calibrations").json()[0]["id"],
        }


@pytest.mark.parametrize(
    ("scheme", "viewport"),
    [("light", PHONE), ("dark", PHONE), ("light", TABLET), ("dark", TABLET), ("light", WIDE), ("dark", WIDE)],
)
def test_every_view_is_accessible_and_fits(
    browser: Any, lab: Running, ids: dict[str, str], scheme: str, viewport: dict[str, int]
) -> None:
    """axe finds nothing in the log-in, in any view and in the certificate's dialog; nothing runs off the screen; the
    halt is within reach wherever the page is scrolled to."""
    watched = Watched(browser, lab, scheme, viewport)
    assert watched.faults() == [] and watched.sideways_px() == 0
    watched.log_in(lab)
    found: dict[str, Any] = {}
    for address, there in views(ids):
        watched.go(address, there)
        watched.page.evaluate("scrollTo(0, document.body.scrollHeight)")
        if faults := [*watched.faults(), *([f"{px} px wider"] if (px := watched.sideways_px()) else [])]:
            found[address] = faults
        assert watched.can_halt(), address
        assert watched.page.inner_text("#view-problem") == "", address
    assert found == {}
    ends = "[...document.querySelectorAll('#nav a')].map((one) => one.getBoundingClientRect().right)"
    assert max(watched.page.evaluate(ends)) <= viewport["width"]  # no entry of the menu is cut
    assert watched.focused()["outline"].startswith("none"), "a heading that is gone to is no control"
    watched.go("/drift", "#drift-rows .cell.drifted")
    watched.page.click("#drift-rows tr:has-text('read noise') button")
    watched.page.wait_for_selector("#history .point")
    watched.page.click("#history-words")
    assert watched.faults() == [] and watched.sideways_px() == 0
    watched.go("/calibrations", "#calibrations button")
    watched.page.click("#calibrations button")
    watched.page.wait_for_selector("#certify[open] .mark")
    watched.page.click("#certify-draft")
    watched.page.wait_for_selector("#certify-limits input")
    assert watched.faults() == [] and watched.sideways_px() == 0 and watched.can_halt()
    watched.page.goto(f"{lab.url}/docs")
    watched.page.wait_for_selector("details")
    assert watched.sideways_px() == 0
    background = watched.page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(int(part) for part in background[4:-1].split(",")) > 3 * 128) == (scheme == "light")
    watched.close()


def test_a_session_by_keyboard_alone(browser: Any, lab: Running) -> None:
    """From the log-in to the exported session: started, paused, halted by the key for it, resumed, its frames and
    verdict looked at, fetched; then the newest calibration is certified. Nothing but keys; the focus is never lost."""
    watched = Watched(browser, lab)
    page, keyboard = watched.page, watched.page.keyboard
    assert watched.focused()["name"] == "key"
    keyboard.type(lab.keys["admin"])
    watched.press("Enter", "#plan-words:has-text('3 sequences')")
    watched.tab_to("name")
    keyboard.type("by keyboard")
    watched.tab_to("quick")
    keyboard.press("Space")
    watched.tab_to("3 sequences.*")  # the summary: opened, a sequence is left out and taken again
    watched.press("Enter", "#plan[open] #plan-rows input")
    watched.tab_to("checkbox")
    watched.press("Space", "#plan-words:has-text('2 sequences')")
    watched.press("Space", "#plan-words:has-text('3 sequences')")
    watched.tab_to("Then: .*")
    watched.press("Enter", "#then[open] select[name=then]")
    watched.tab_to("then")
    watched.press("Home", "#then-words:text-is('Then: nothing')")  # a pipeline's fit would be newer than the test's
    lab.bench.delay_s = 0.2
    watched.tab_to("Start a session")
    watched.press("Enter", ".station.busy a:has-text('by keyboard')")
    watched.tab_to("Pause")
    watched.press("Enter", ".station.busy .state.paused")
    watched.tab_to("Resume")
    watched.press("Enter", ".station.busy .state.running")
    watched.tab_to("Sessions")
    watched.press("Enter", "#sessions tr:has-text('by keyboard') .state.running")
    watched.tab_to("by keyboard")
    # The list is drawn anew while the session goes on; the focus stays where it was.
    steps = page.inner_text("#sessions tr:has-text('by keyboard') .number:nth-last-child(2)")
    page.wait_for_function(
        """seen => [...document.querySelectorAll('#sessions tr')].some((row) => row.textContent.includes('by keyboard')
            && row.children[row.children.length - 2].textContent !== seen)""",
        arg=steps,
    )
    assert watched.focused()["text"] == "by keyboard"
    watched.press("Enter", "#panel-live:not([hidden]) #watch-histogram svg .line")
    page.wait_for_selector("#watch-step:has-text('step')")
    watched.tab_to("Frames")
    watched.press("Enter", "#captures img")
    assert watched.focused()["text"] == "Frames"
    watched.press("F9", "#halt-told:has-text('shutter closed')")
    page.wait_for_selector("#session-facts .state.interrupted")
    lab.bench.delay_s = 0.0
    assert not lab.bench.opened  # the shutter
    watched.tab_to("Resume")
    watched.press("Enter", "#session-facts .state.finished")
    # What a fit and a diagnosis by a job leave.
    session = page.evaluate("location.hash").split("/")[2]
    lab.store.add_result("fit", session, fitted(2.0).model_dump(mode="json"))
    lab.store.add_result("diagnose", session, diagnosis().model_dump(mode="json"))
    watched.tab_to("notes")
    keyboard.type("#keys")
    watched.press("Enter", "#session-facts:has-text('explained')")
    watched.tab_to("Findings")
    watched.press("Enter", "#findings-headline strong:has-text('explained')")
    watched.tab_to("Frames")
    watched.press("Enter", "#captures a")
    watched.tab_to("figure")
    watched.press("Enter", "#inspect-profile svg")
    watched.tab_to("canvas")
    keyboard.press("ArrowRight")
    before = page.inner_text("#inspect-readout")
    keyboard.press("Shift+ArrowDown")
    assert page.inner_text("#inspect-readout") != before
    watched.tab_to("Back to the frames")
    watched.press("Enter", "#captures img")
    watched.tab_to("Download")
    with page.expect_download() as fetched:
        watched.press("Enter")
    assert zipfile.is_zipfile(fetched.value.path())
    with lab.client() as client:
        assert client.get(f"/api/v1/sessions/{session}").json()["tags"] == ["keys"]
    watched.tab_to("Calibrations")
    watched.press("Enter", "#calibrations tr:has-text('by keyboard')")
    watched.tab_to("Certify …")
    watched.press("Enter", "#certify[open] .mark.good")
    watched.tab_to("Certify")
    watched.press("Enter", "#calibrations tr:has-text('by keyboard') .state.certified")
    watched.tab_to("Log out")
    watched.press("Enter", "#login-form")
    assert watched.focused()["name"] == "key"
    watched.close()


@pytest.mark.parametrize(
    ("view", "control"),
    [
        ("/", "#stations .run a"),
        ("/stations/fakes", "#station-run .run a"),
        ("/sessions", "#sessions tr:has(.state.finished) input:enabled"),
        ("/sessions/RUNS/live", "#session-facts a"),
        ("/calibrations/FIT", "#calibration-facts a"),
    ],
)
def test_the_focus_stays_on_its_control_while_the_page_is_drawn_anew(
    browser: Any, lab: Running, ids: dict[str, str], view: str, control: str
) -> None:
    """Two rounds of the page while a session goes on: what had the focus has it still, so that no key is lost."""
    watched = Watched(browser, lab)
    page = watched.page
    page.clock.install()
    watched.log_in(lab)
    lab.bench.delay_s = 0.1
    page.click("#start")
    runs = page.wait_for_selector(".station.busy .run a").get_attribute("href").split("/")[2]
    watched.go("/".join((ids | {"RUNS": runs}).get(part, part) for part in view.split("/")), control)
    page.focus(control)
    before = watched.focused()
    for _ in range(2):
        page.clock.run_for(5000)
        page.wait_for_load_state("networkidle")
        assert watched.focused() == before
    page.click("#halt")
    page.wait_for_selector("#halt-told:has-text('shutter closed')")
    lab.bench.delay_s = 0.0
    watched.close()


def test_two_stations_a_queue_and_a_halt(browser: Any, lab: Running) -> None:
    other = STATION.replace('address = "', 'address = "other ').replace("a bench of fakes", "another bench")
    (lab.store.root / "stations" / "other.toml").write_text(other)
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab)
    page.wait_for_selector(".station:nth-child(2)")
    page.wait_for_selector("#strip li:nth-child(2)")
    lab.bench.delay_s = 0.2
    page.fill("#start-form input[name=name]", "watched")
    page.click("#start")
    page.wait_for_selector(".station.busy progress")
    assert len(page.query_selector_all(".station.busy")) == 1
    page.wait_for_selector(".station.busy dd:has-text('closed')")  # darks: the shutter
    page.wait_for_selector("#strip li:has-text('running'):has-text('shutter closed')")
    page.wait_for_selector("#start:has-text('Queue a session')")
    page.fill("#start-form input[name=name]", "next")
    page.click("#start")
    page.click("#queue tr:has-text('next') button:has-text('Earlier')")
    page.wait_for_selector("#queue tr:first-child:has-text('1. next')")
    page.click("#queue tr:has-text('next') button:has-text('Later')")
    page.wait_for_selector("#queue tr:nth-child(2):has-text('2. next')")
    page.click("#queue tr:has-text('next') button:has-text('Remove')")
    page.wait_for_selector("#queue tr:has-text('next')", state="detached")
    page.click(".station.busy a:has-text('watched')")
    page.wait_for_selector("#panel-live:not([hidden])")
    page.click("#strip li:has-text('running') button")  # on every view
    page.wait_for_selector("#session-facts .state.interrupted")
    lab.bench.delay_s = 0.0
    assert not lab.bench.opened
    watched.go("/", "#queue .reason:has-text('halted by the key')")
    watched.close()


def test_recordings_that_are_dropped_have_a_view(browser: Any, lab: Running) -> None:
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab)
    watched.go("/recordings", "#recordings tr")
    there = len(page.query_selector_all("#recordings tr"))
    page.set_input_files("#drop-file", lab.store.root / "nightly.zip")
    page.wait_for_selector(f"#recordings tr:nth-child({there + 1})")
    code = DROP.replace("PLACE", "drop")
    page.evaluate(code, ["wrong.zip", base64.b64encode(b"no archive").decode()])
    page.wait_for_selector("#recordings-problem:has-text('wrong.zip: archive: can')")
    content = (lab.store.root / "nightly.zip").read_bytes()
    page.evaluate(code, ["dropped.zip", base64.b64encode(content).decode()])
    page.wait_for_selector(f"#recordings tr:nth-child({there + 2})")
    assert page.inner_text("#recordings-problem") == ""
    page.click("#recordings tr:first-child a:has-text('nightly')")
    page.wait_for_selector("#view-source:not([hidden]) #session-facts:has-text('Captures')")
    page.click("#session-tabs a:has-text('Frames')")
    page.click("#captures figure:first-child a")
    page.wait_for_selector("#inspect-readout:has-text('DN')")
    page.go_back()
    page.wait_for_selector("#captures img")
    page.on("dialog", lambda asked: asked.accept())
    page.click("#session-actions button:has-text('Delete')")
    page.wait_for_selector("#view-recordings:not([hidden])")
    page.wait_for_selector(f"#recordings tr:nth-child({there + 2})", state="detached")
    watched.complaints = [line for line in watched.complaints if "422" not in line]  # the refused one
    watched.close()


def test_sessions_are_searched_named_and_two_compared(browser: Any, lab: Running, ids: dict[str, str]) -> None:
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab)
    watched.go(f"/sessions/{ids['SESSION']}/frames", "#captures img")
    page.fill("#session-notes input[name=notes]", "after the move #lens-b")
    page.click("#session-notes button")
    watched.go("/sessions", "#sessions a.tag:has-text('#lens-b')")
    page.click("#sessions a.tag:has-text('#lens-b')")
    page.wait_for_selector("#sessions tr:nth-child(2)", state="detached")
    assert page.input_value("#sessions-search input[name=search]") == "#lens-b"
    row = page.inner_text("#sessions tr")
    assert "explained" in row and "0.25" in row and "2.15" in row and "a bench of fakes" in row
    page.fill("#sessions-search input[name=search]", "no such thing")
    page.press("#sessions-search input[name=search]", "Enter")
    page.wait_for_selector("#no-sessions:has-text('No matching sessions')")
    with lab.client() as client:  # another one that is fitted
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"], "name": "to compare"}
        other = client.post("/api/v1/sessions", json=asked).json()["id"]
        until_state(client, other, "finished")
    fit = lab.store.add_result("fit", other, fitted(2.02).model_dump(mode="json"))
    watched.go("/sessions", "#sessions tr:has-text('to compare') input:enabled")
    assert page.is_disabled("#compare")
    page.check("#sessions tr:has-text('to compare') input")
    page.check("#sessions tr:has-text('#lens-b') input")
    with page.expect_popup() as opened:
        page.click("#compare")
    opened.value.wait_for_selector("h1:has-text('changed')")
    opened.value.close()
    with lab.client() as client:
        assert client.delete(f"/api/v1/sessions/{other}").status_code == 204
    assert fit
    watched.close()


def test_a_figure_of_the_drift_board_has_its_history(browser: Any, lab: Running) -> None:
    """Coloured by limits, a drift by its shape too; searched; a click tells the history."""
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab, "read")
    watched.go("/drift", "#drift-rows .cell.drifted")
    names = page.locator("#drift-rows th").all_inner_texts()
    assert any("temporal dark noise (read noise)" in name and name.endswith(" e") for name in names)
    assert "\u25c6" in page.inner_text("#drift-rows .cell.drifted")
    # The many figures of the edges are folded, until they are asked for.
    shown = page.locator("#drift-rows tr:has-text('MTF50')")
    assert shown.count() == 0
    page.click("#drift-rows .fold button:has-text('MTF by edge and channel')")
    assert shown.count() > 0
    assert watched.focused()["text"].startswith("MTF by edge")
    page.keyboard.press("Enter")
    assert shown.count() == 0
    page.fill("#drift-form input[name=search]", "mtf50")
    page.wait_for_selector("#drift-rows tr:nth-child(2)", state="detached")
    page.fill("#drift-form input[name=search]", "")
    page.check("#drift-form input[name=attention]")
    page.wait_for_selector("#drift-rows tr:nth-child(2)", state="detached")
    page.focus("#drift-rows button")
    page.keyboard.press("Enter")
    page.wait_for_selector("#history .point")
    assert len(page.query_selector_all("#history .point")) >= 3 and len(page.query_selector_all("#history .band")) == 2
    assert len(page.query_selector_all("#history path")) == 1  # the drift has a shape of its own
    assert "1 drifted" in page.inner_text("#history-words") and " UTC, " in page.inner_text("#history-words")
    times = page.locator("#history text").all_text_contents()
    assert "fitted (UTC)" in times and sum(bool(re.fullmatch(r"\d\d-\d\d \d\d:\d\d", one)) for one in times) >= 3
    watched.close()


def test_a_frame_is_inspected(browser: Any, lab: Running, ids: dict[str, str]) -> None:
    """The readout is the frame's own value in DN; the profile follows the cross, and so does the
    difference of two frames."""
    with lab.client() as client:
        captures = client.get(f"/api/v1/sessions/{ids['SESSION']}/captures?kind=flat&side=left").json()
    first, second = captures[0]["id"], captures[1]["id"]
    frames = [lab.store.frame(id).astype(int) for id in (first, second)]
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab, "read")
    watched.go(f"/sessions/{ids['SESSION']}/frames/{first}", "#inspect-readout:has-text('DN')")
    rows, cols = frames[0].shape
    row, col = rows // 2, cols // 2

    def channel(row: int, col: int) -> str:
        return next(name for name, at in FIRSTS.items() if at == (row % 2, col % 2))

    at = f"column {col}, row {row}, {channel(row, col)}: {frames[0][row, col]} DN"
    assert page.inner_text("#inspect-readout").startswith(at)
    page.focus("#inspect-canvas")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowDown")
    at = f"column {col + 1}, row {row + 1}, {channel(row + 1, col + 1)}: {frames[0][row + 1, col + 1]} DN"
    assert page.inner_text("#inspect-readout").startswith(at)
    along = frames[0][row + 1, (col + 1) % 2 :: 2]  # of one channel
    profile = page.inner_text("#inspect-profile")
    assert f"{along.size} pixels, at most {along.max()} DN, of channel {channel(row + 1, col + 1)}" in profile
    pictures = set()
    for name in ("", *FIRSTS):  # the mosaic, and each channel alone
        page.select_option("#inspect-form select[name=channel]", name)
        pictures.add(page.evaluate("document.getElementById('inspect-canvas').toDataURL()"))
        assert (f"picture of channel {name}" in page.inner_text("#inspect-readout")) == bool(name)
    assert len(pictures) == 5
    page.select_option("#inspect-form select[name=channel]", "")
    page.keyboard.press("m")
    page.keyboard.press("Shift+ArrowLeft")
    assert "Profile along the line" in page.inner_text("#inspect-profile")
    before = page.evaluate("document.getElementById('inspect-canvas').toDataURL()")
    page.keyboard.press("+")
    assert page.evaluate("document.getElementById('inspect-canvas').toDataURL()") != before
    others = page.locator("#inspect-form select[name=minus] option")
    many = others.count()
    page.fill("#inspect-form input[name=find]", captures[1]["name"].upper())
    assert 2 <= others.count() < many
    page.select_option("#inspect-form select[name=minus]", str(second))
    difference = (frames[0] - frames[1])[row + 1, col + 1 - 10]
    page.wait_for_selector(f"#inspect-readout:has-text('is {difference} DN')")
    assert watched.faults() == []
    watched.go(f"/sessions/{ids['SESSION']}/frames", "#captures img")
    page.fill("#capture-filter input[name=search]", captures[1]["name"].upper())
    page.press("#capture-filter input[name=search]", "Enter")
    with lab.client() as client:
        found = client.get(f"/api/v1/sessions/{ids['SESSION']}/captures", params={"search": captures[1]["name"]})
        (sent,) = client.get("/api/v1/recordings").json()[-1:]
        same = client.get(f"/api/v1/recordings/{sent['id']}/captures", params={"search": captures[1]["name"].upper()})
    number = int(found.headers["X-Total-Count"])
    assert 1 <= number < many and [one["name"] for one in same.json()] == [one["name"] for one in found.json()]
    page.wait_for_selector(f"#capture-count:has-text('{number} captures; ')")
    page.fill("#capture-filter input[name=search]", "no_such%name")
    page.press("#capture-filter input[name=search]", "Enter")
    page.wait_for_selector("#capture-count:has-text('No matching frames.')")
    watched.close()


def test_every_instrument_is_checked_before_the_night(browser: Any, lab: Running) -> None:
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab, "operate")
    watched.go("/stations/fakes", "#devices tr:nth-child(5)")
    page.click("#check-all")
    page.wait_for_selector("#devices-told:has-text('work')")
    page.wait_for_selector("#devices tr:has-text('cameras.left'):has-text('fake camera left SN-1') .state.finished")
    page.wait_for_selector("#check-all:enabled")
    page.wait_for_selector("#station-run .station")  # what runs there, and its halt
    watched.go("/", "#stations .station")
    watched.close()


def test_a_calibration_is_certified_and_revoked(browser: Any, lab: Running) -> None:
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab)
    watched.go("/calibrations", "#calibrations tr:has-text('nightly')")
    mine = "#calibrations tr:has-text('nightly')"
    page.click(f":nth-match({mine}, 1) button")  # 2.15 e: warn
    page.wait_for_selector("#certify[open] .mark.warn")
    assert "rejects the model" in page.inner_text("#certify-rejects")
    page.click("#certify-go")
    page.wait_for_selector("#certify-problem:not(:empty)")
    assert "is warn" in page.inner_text("#certify-problem")
    page.keyboard.press("Escape")
    page.wait_for_selector("#certify", state="hidden")
    page.click(f":nth-match({mine}, 3) button")
    page.wait_for_selector("#certify[open] .mark.good")
    page.click("#certify-go")
    page.wait_for_selector(f"{mine} .state.certified")
    assert "admin, " in page.inner_text(f"{mine}:has(.certified)")
    page.click(f"{mine}:has(.certified) a:has-text('nightly')")
    page.wait_for_selector("#calibration-actions button:has-text('Revoke')")
    with page.expect_popup() as opened:
        page.click("#calibration-actions a:has-text('Certificate')")
    certificate = opened.value
    certificate.wait_for_selector("h1:has-text('Certificate')")
    words = certificate.inner_text("body")
    assert "2.000 \u00b1 0.010 e" in words and "SN-1" in words and "admin" in words and "SHA-256" in words
    assert "isn't diagnosed" in words
    certificate.close()
    page.click("#calibration-actions button:has-text('Revoke')")
    page.keyboard.type("the lens was touched")
    page.keyboard.press("Enter")
    page.wait_for_selector("#calibration-facts .state.revoked")
    assert "the lens was touched" in page.inner_text("#calibration-facts")
    # Another one, against limits that are drafted from the history and edited.
    watched.go("/calibrations", f"{mine} button")
    page.click(f":nth-match({mine}, 2) button")
    page.click("#certify-draft")
    page.wait_for_selector("#certify-limits tr:has-text('read noise')")
    for field in page.query_selector_all("#certify-limits tr:has-text('read noise') td:nth-child(4) input"):
        field.fill("3")
    page.click("#certify-go")
    page.wait_for_selector(f"{mine} .state.certified")
    watched.complaints = [line for line in watched.complaints if "422" not in line]  # the refused one
    watched.close()


def test_a_key_that_may_only_read_gets_no_halt_button(browser: Any, lab: Running) -> None:
    watched = Watched(browser, lab)
    watched.log_in(lab, "read")
    assert not watched.page.is_visible("#halt")
    watched.page.click("#logout")
    watched.page.wait_for_selector("#login-form")
    watched.close()


def test_a_missing_browser_fails_in_ci_and_is_skipped_on_a_desk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match=r"make (chromium|peers)"):
        browser_program()
    monkeypatch.delenv("CI")
    with pytest.raises(pytest.skip.Exception):
        browser_program()


def test_a_session_is_planned_on_the_page(browser: Any, lab: Running) -> None:
    """The estimate changes with a parameter, and the session that is started takes it."""
    watched = Watched(browser, lab)
    watched.log_in(lab, "operate")
    page = watched.page
    page.wait_for_selector("#plan-words:has-text('3 sequences')")
    page.press("#plan-words", "Enter")
    for name in ("flat", "narrowband"):
        page.uncheck(f"#plan-rows li:has(strong:text-is('{name}')) input[type=checkbox]")
    page.wait_for_selector("#plan-words:has-text('1 sequence, 40 captures')")
    page.click("#plan-rows li:first-child summary")
    assert watched.faults() == []
    page.fill("#plan-rows li:first-child label:has-text('frames at each exposure') input", "2")
    page.press("#plan-rows li:first-child label:has-text('frames at each exposure') input", "Tab")
    page.wait_for_selector("#plan-words:has-text('1 sequence, 20 captures')")
    page.fill("#start-form input[name=name]", "as planned")
    page.click("#start")
    watched.go("/sessions", "#sessions tr:has-text('as planned') td:has-text('/10')")
    watched.close()


def test_a_light_source_is_shown_and_set_in_the_plan(browser: Any, lab: Running) -> None:
    with_lamp = STATION.replace('address = "', 'address = "other ').replace("a bench of fakes", "lamp bench") + LAMP
    (lab.store.root / "stations" / "lamp.toml").write_text(with_lamp)
    watched = Watched(browser, lab)
    watched.log_in(lab)
    page = watched.page
    page.reload()
    page.wait_for_selector("#start-station option[value=lamp]", state="attached")
    page.select_option("#start-station", "lamp")
    page.wait_for_selector(
        "#plan-lights:has-text('3000 K (460 at 14 %, 635 at 78 %); 460 nm (460 at 100 %)')", state="attached"
    )
    page.click("#plan > summary")
    flat = page.locator("#plan-rows li", has=page.locator("strong:text-is('flat')"))
    flat.locator("summary").click()
    flat.locator("label:has(span[title=lamp_level]) input").fill("0.5")
    flat.locator("label:has(span[title=colour_temperature_k]) input").fill("5000")
    page.keyboard.press("Tab")
    page.wait_for_selector("#plan-problem:has-text('no light of colour_temperature_k = 5000; it has 3000 K')")
    flat.locator("label:has(span[title=colour_temperature_k]) input").fill("3000")
    page.keyboard.press("Tab")
    page.wait_for_selector("#plan-words:has-text('captures')")
    assert page.inner_text("#plan-problem") == ""
    assert watched.faults() == [] and watched.sideways_px() == 0
    watched.complaints = [line for line in watched.complaints if "422" not in line]  # the refused colour temperature
    watched.close()


def test_the_steps_of_an_analysis_are_followed_to_its_report(
    browser: Any, lab: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the capture to the report in one view, whose part that stands there stays. The pipeline itself is a stand-in
    that ends a step when it is told to."""
    steps = {name: threading.Event() for name in ("fit", "validate", "diagnose", "report")}

    def pipeline(request: PipelineRequest, tell: Callable[[PipelineProgress], None], **_: Any) -> None:
        for number, (name, go_on) in enumerate(steps.items()):
            tell(PipelineProgress(cast(Step, name), "the left camera", number / len(steps)))
            assert go_on.wait(60.0)
        page = lab.store.root / "reports" / f"{request.job_id}.html"
        page.parent.mkdir(exist_ok=True)
        page.write_text("<title>a report</title><h1>What was found</h1>")
        lab.store.add_result("report", request.source, {"path": f"reports/{page.name}"}, request.job_id)

    monkeypatch.setattr("lab.jobs.run_pipeline", pipeline)
    monkeypatch.setattr("lab.jobs._WRITE_EVERY_S", 0.0)
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab)
    page.fill("#start-form input[name=name]", "followed")
    page.evaluate("""() => { document.querySelector("#start-form select[name=then]").value = "pipeline" }""")
    lab.bench.delay_s = 0.5  # until its steps were looked at
    page.click("#start")
    page.wait_for_selector(".station.busy a:has-text('followed')")
    watched.go("/sessions", "#sessions a:text-is('followed')")
    page.click("#sessions a:text-is('followed')")  # an address that names no part
    page.wait_for_selector("#session-steps .running:has-text('capture')")
    assert page.locator("#session-steps li").all_inner_texts()[1:] == [f"{name} waiting" for name in steps]
    lab.bench.delay_s = 0.0
    for name, go_on in steps.items():
        page.wait_for_selector(f"#session-steps .running:has-text('{name}')")
        page.wait_for_selector("#session-message:has-text('the left camera')")
        assert page.is_visible("#panel-live") and page.is_hidden("#panel-frames")
        assert watched.faults() == []
        go_on.set()
    page.wait_for_selector("#session-steps .done:has-text('report')")
    assert page.is_visible("#panel-live") and page.is_hidden("#session-bar")
    with page.expect_popup() as opened:
        page.click("#session-facts a:has-text('Open report')")
    opened.value.wait_for_selector("h1:has-text('What was found')")
    opened.value.close()
    watched.tab_to("Findings")
    watched.press("Enter", "#panel-findings:not([hidden])")
    assert watched.faults() == []
    watched.close()


def test_a_doubt_is_settled_on_the_page(
    browser: Any, lab: Running, ids: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Resolve is pressed, and each capture stands there with what was in doubt before and after it. The pipeline itself
    is a stand-in that takes one capture when it is told to."""
    go_on = threading.Event()
    doubt = (RivalOdds(name="charge_diffusion", probability=0.9), RivalOdds(name="defocus", probability=0.1))
    taken = Resolution(
        capture="slanted edges at f/8",
        session=ids["SESSION"],
        verdict_before="explained",
        effects_before=(),
        rivals=doubt,
        information_nat=0.22,
        expected_s=13.0,
        spent_s=12.0,
    )
    journal = ResolveJournal(budget_min=20.0, resolutions=(taken,))
    folder = lab.store.folder(ids["SESSION"])

    def pipeline(request: PipelineRequest, tell: Callable[[PipelineProgress], None], **_: Any) -> None:
        assert request.resolve is not None
        (folder / JOURNAL).write_text(journal.model_dump_json())
        tell(PipelineProgress(cast(Step, "resolve"), taken.capture, 0.5))
        assert go_on.wait(60.0)
        settled = taken.model_copy(update={"rivals_after": (RivalOdds(name="charge_diffusion", probability=1.0),)})
        ended = {"resolutions": (settled,), "end": "settled", "reason": "no rivals are left"}
        (folder / JOURNAL).write_text(journal.model_copy(update=ended).model_dump_json())

    monkeypatch.setattr("lab.jobs.run_pipeline", pipeline)
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab)
    watched.go(f"/sessions/{ids['SESSION']}/findings", "#findings-headline strong")
    assert page.is_hidden("#resolving")
    page.click("#session-actions button:has-text('Resolve')")
    page.wait_for_selector("#resolving-rows td:has-text('charge diffusion 0.90, defocus 0.10 (left)')")
    page.wait_for_selector("#resolving-rows td:has-text('being diagnosed')")
    assert "goes on" in page.inner_text("#resolving-end")
    go_on.set()
    page.wait_for_selector("#resolving-rows td:has-text('charge diffusion 1.00')")
    assert page.inner_text("#resolving-end") == "settled: no rivals are left. Lab time: 0.2 min of 20 min."
    assert watched.faults() == [] and watched.sideways_px() == 0
    watched.close()


def test_a_budget_is_shown_and_a_prediction_sealed_and_opened(browser: Any, lab: Running, tmp_path: Path) -> None:
    model = bring_in(lab.store, {"left": trained(1)})
    with ServiceClient(lab.url, lab.keys["calibrate"], timeout_s=120.0) as sender:
        for name, recordings in (
            ("plan", future_session(TRUTH, PLAN, "left", Changes(), 1)),
            ("taken", twin_captured(Changes(f_number=8.0, radiance_factor=4.0), 7)),
        ):
            (tmp_path / f"{name}.zip").write_bytes(b"".join(archive(recordings, "zip")))
        plan, taken = (sender.send_recordings(tmp_path / f"{name}.zip").id for name in ("plan", "taken"))
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab, "calibrate")
    watched.go("/models", f"#models a:text-is('{model}')")
    page.click(f"#models a:text-is('{model}')")
    page.wait_for_selector("#predict-plan option", state="attached")
    page.select_option("#budget-form select[name=use]", "variance")
    page.select_option("#budget-station", "fakes")
    page.click("#budget-form button")
    page.wait_for_selector("#budget h4:has-text('variance, left camera: standard uncertainty')")
    page.wait_for_selector("#budget p:has-text('limits it')")
    assert page.locator("#budget table").count() == 2  # contributions, and the station's sequences
    assert watched.faults() == [] and watched.sideways_px() == 0

    page.select_option("#predict-plan", f"recordings/{plan}")
    page.fill("#predict-form input[name=f_number]", "8")
    page.fill("#predict-form input[name=distance_mm]", "9")
    page.click("#predict-form button")
    page.wait_for_selector("#model-problem:has-text('twice the focal length')")
    page.fill("#predict-form input[name=distance_mm]", "")
    page.fill("#predict-form input[name=radiance_factor]", "4")
    page.click("#predict-form button")
    page.wait_for_selector("#view-prediction:not([hidden]) .hash")
    assert re.fullmatch("[0-9a-f]{64}", page.inner_text("#prediction-facts .hash"))
    assert "f number 8, radiance factor 4" in page.inner_text("#prediction-facts")
    with page.expect_download() as fetched:
        page.click("#prediction-actions a:has-text('Sealed file')")
    sealed = Path(fetched.value.path()).read_bytes()
    assert hashlib.sha256(sealed).hexdigest() == page.inner_text("#prediction-facts .hash")
    page.select_option("#score-against", f"recordings/{plan}")
    page.click("#score-form button")
    page.wait_for_selector("#prediction-problem:has-text('the session that was predicted')")
    page.select_option("#score-against", f"recordings/{taken}")
    page.click("#score-form button")
    page.wait_for_selector("#score li:has-text('dark current temperature, left camera: confirmed')")
    assert page.inner_text("#prediction-problem") == "" and page.locator("#score tbody tr").count() > 1
    assert watched.faults() == [] and watched.sideways_px() == 0
    page.on("dialog", lambda asked: asked.accept())
    page.click("#prediction-actions button:has-text('Delete')")
    page.wait_for_selector("#no-predictions:not([hidden])")
    watched.complaints = [line for line in watched.complaints if "422" not in line]  # the two that were refused
    watched.close()


def test_an_error_of_the_start_form_names_the_field(browser: Any, lab: Running) -> None:
    """A text in place of a number, two numbers in place of one, and what the service refuses: in plain words, with the
    field named as the form names it, and nothing is started."""
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab)
    page.wait_for_selector("#plan-words:has-text('3 sequences')")
    page.press("#plan-words", "Enter")
    page.click("#plan-rows li:first-child summary")
    field = "#plan-rows li:first-child label:has-text('frames at each exposure') input"
    for text in ("five", "2, 3", "1e999"):
        page.fill(field, text)
        page.press(field, "Tab")
        page.wait_for_selector(f"#plan-problem:has-text('dark, frames at each exposure: \u201c{text}\u201d isn')")
        assert page.get_attribute(field, "aria-invalid") == "true"
        page.click("#start")
        page.wait_for_selector(f"#start-problem:has-text('dark, frames at each exposure: \u201c{text}\u201d isn')")
        assert page.inner_text("#plan-problem") == ""
    assert watched.faults() == []
    page.fill(field, "2")
    page.press(field, "Tab")
    page.wait_for_selector("#plan-problem:empty", state="attached")
    page.press("#then-words", "Enter")
    page.fill("#start-form input[name=webhook]", "https://lab.example/hook")
    page.click("#start")
    page.wait_for_selector("#start-problem:has-text('Webhook URL: ')")
    assert "'lab.example' isn't a host that the service tells" in page.inner_text("#start-problem")
    assert page.query_selector(".station.busy") is None
    watched.complaints = [line for line in watched.complaints if "422" not in line]  # the refused one
    watched.close()


def test_what_waits_is_edited_and_copied_with_what_follows(browser: Any, lab: Running) -> None:
    """What was asked with stands in the form again; the edited one keeps its place."""
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab)
    page.wait_for_selector("#plan-words:has-text('3 sequences')")
    assert page.evaluate("window.followed") == "pipeline"  # a session that is started gets its report
    page.fill("#start-form input[name=name]", "for the night")
    page.fill("#start-form input[name=notes]", "cold #night")
    page.fill("#start-form input[name=not_before]", "2999-01-01T20:00")
    page.press("#then-words", "Enter")
    assert page.is_disabled("#start-form input[name=compare]")
    page.select_option("#start-form select[name=then]", "pipeline")
    page.check("#start-form input[name=resolve]")
    page.check("#start-form input[name=compare]")
    page.wait_for_selector("#then-words:has-text('the whole pipeline, with a report, resolve, compare')")
    assert watched.faults() == []
    page.click("#start:has-text('Queue a session')")
    row = "#queue tr:has-text('for the night')"
    page.wait_for_selector(f"{row}:has-text('pipeline, resolve, compare')")
    place = page.inner_text(f"{row} td").split(".")[0]
    page.click(f"{row} a:has-text('Edit')")
    page.wait_for_selector("#start:has-text('Keep the changes')")
    page.wait_for_function("() => document.querySelector('#start-form input[name=name]').value === 'for the night'")
    assert page.input_value("#start-form input[name=not_before]") == "2999-01-01T20:00"
    assert page.is_checked("#start-form input[name=compare]")
    page.fill("#start-form input[name=name]", "for the next night")
    page.select_option("#start-form select[name=then]", "fit")
    page.click("#start")
    row = "#queue tr:has-text('for the next night')"
    page.wait_for_selector(f"{row}:has-text('fit, compare')")
    assert page.inner_text(f"{row} td").split(".")[0] == place
    page.wait_for_selector("#start:not(:has-text('Keep the changes'))")
    page.click(f"{row} a:has-text('Copy')")
    page.wait_for_function(
        "() => document.querySelector('#start-form input[name=name]').value === 'for the next night'"
    )
    page.fill("#start-form input[name=name]", "once more")
    page.fill("#start-form input[name=not_before]", "2999-01-02T20:00")
    page.click("#start:has-text('Queue a session')")
    page.wait_for_selector("#queue tr:has-text('once more'):has-text('fit, compare')")
    for name in ("for the next night", "once more"):
        page.click(f"#queue tr:has-text('{name}') button:has-text('Remove')")
        page.wait_for_selector(f"#queue tr:has-text('{name}')", state="detached")
    watched.close()


def test_a_camera_model_is_sent_in_and_deleted(browser: Any, lab: Running, tmp_path: Path) -> None:
    """Chosen, and dropped; an archive that is none is told in a line."""
    write_camera(tmp_path / "left.toml", CameraFile("from elsewhere", default_camera().camera))
    content = b"".join(packed([("left.toml", (tmp_path / "left.toml").read_bytes())], "zip"))
    (tmp_path / "camera.zip").write_bytes(content)
    watched = Watched(browser, lab)
    watched.log_in(lab, "calibrate")
    page = watched.page
    watched.go("/models", "#models tr")  # those of the fits
    page.wait_for_selector("#model-drop-file")
    page.focus("#models-title")
    for _ in range(20):  # the browser's own chooser, reached by the keyboard
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.id") == "model-drop-file":
            break
    else:
        pytest.fail("the file chooser can't be reached by the keyboard")
    page.set_input_files("#model-drop-file", tmp_path / "camera.zip")
    page.wait_for_selector("#model-drop-told:has-text('left camera from elsewhere')")
    page.wait_for_selector("#models tr:first-child:has-text('sent')")
    code = DROP.replace("PLACE", "model-drop")
    page.evaluate(code, ["wrong.zip", base64.b64encode(b"no archive").decode()])
    page.wait_for_selector("#models-problem:has-text('wrong.zip: archive: can')")
    assert watched.faults() == [] and watched.sideways_px() == 0
    page.evaluate(code, ["dropped.zip", base64.b64encode(content).decode()])
    page.wait_for_selector("#models tr:nth-child(2):has-text('sent')")
    assert page.inner_text("#models-problem") == ""
    page.on("dialog", lambda asked: asked.accept())
    for _ in range(2):
        page.click("#models tr:first-child button:has-text('Delete')")
        page.wait_for_selector("#models tr:nth-child(2):has-text('sent')", state="detached")
    page.wait_for_selector("#models tr:has-text('sent')", state="detached")
    watched.complaints = [line for line in watched.complaints if "422" not in line]  # the refused one
    watched.close()


def test_a_halt_is_answered_beside_its_button_also_without_a_network(browser: Any, lab: Running) -> None:
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab, "calibrate")
    assert page.is_visible("#halt") and not page.is_visible("#start-form")
    page.click("#halt")
    page.wait_for_selector("#halt-told:has-text('shutter closed')")
    page.wait_for_selector(".station dd:has-text('closed')")
    lab.bench.unplugged.add("monochromator")
    page.click(".station button:has-text('Halt')")
    page.wait_for_selector(".station .halted.unsafe:has-text('NOT CONFIRMED: go to the bench')")
    page.wait_for_selector(".station .state.unsafe:has-text('NOT CONFIRMED')")
    assert watched.faults() == []
    lab.bench.unplugged.clear()
    watched.context.set_offline(True)
    page.click("#halt")
    page.wait_for_selector("#halt-told.unsafe:has-text('NOT CONFIRMED: go to the bench')")
    page.wait_for_selector("#lost:has-text('No connection')")
    assert "free" not in page.inner_text(".station .state")
    watched.context.set_offline(False)
    page.wait_for_selector("#lost", state="hidden")
    page.click("#halt")
    page.wait_for_selector(".station .state:text-is('free')")
    # Both places tell what the instruments answered last, whoever asked.
    page.wait_for_selector(".station .halted:not(.unsafe):has-text('shutter closed')")
    lab.bench.unplugged.add("monochromator")
    page.click("#halt")
    page.wait_for_selector("#halt-told.unsafe:has-text('NOT CONFIRMED')")
    lab.bench.unplugged.clear()
    for asked in lab.app.state.service.live._asked.values():  # a question that is under way is shared, with its failure
        asked.result(60.0)
    page.click(".station button:has-text('Halt')")
    page.wait_for_selector("#halt-told:not(.unsafe):has-text('shutter closed')")
    watched.complaints = [line for line in watched.complaints if "ERR_INTERNET_DISCONNECTED" not in line]
    watched.close()


def test_no_station_s_answer_reads_as_that_of_all(
    browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the shutter of the station that runs still hangs, the idle one has answered already."""
    hangs, go_on, drivers = threading.Event(), threading.Event(), Bench.drivers

    def hanging(self: Bench, asked: Station | None = None) -> Drivers:
        made = drivers(self, asked)
        if asked is not None and asked.name == "a bench of fakes":
            assert made.monochromator is not None
            stop = made.monochromator.stop

            def late() -> None:
                if halted.is_set():
                    hangs.set()
                    assert go_on.wait(30.0)
                stop()

            monkeypatch.setattr(made.monochromator, "stop", late)
            monkeypatch.setattr(made.monochromator, "close_shutter", late)
        return made

    halted = threading.Event()
    monkeypatch.setattr(Bench, "drivers", hanging)
    with serving(tmp_path, delay_s=0.05) as running:
        other = STATION.replace('address = "', 'address = "other ').replace("a bench of fakes", "another bench")
        (running.store.root / "stations" / "other.toml").write_text(other)
        watched = Watched(browser, running)
        page = watched.page
        watched.log_in(running)
        page.fill("#start-form input[name=name]", "hangs")
        page.select_option("#start-station", "fakes")
        page.click("#start")
        page.wait_for_selector(".station.busy progress")
        page.evaluate(ALL_TEXTS)
        halted.set()
        page.keyboard.press("F9")
        assert hangs.wait(30.0)
        service = running.app.state.service
        while (found := service.live.safety.find(service.station("other"))) is None or found.state != "safe":
            page.wait_for_timeout(20)
        page.evaluate(REFRESH)
        page.wait_for_selector("#halt-told.unsafe:has-text('go to the bench of fakes')")
        told = page.inner_text("#halt-told")
        assert "other: shutter closed" in told
        go_on.set()
        page.wait_for_selector(
            "#halt-told:not(.unsafe):has-text('fakes: shutter closed'):has-text('other: shutter closed')"
        )
        # Never one answer alone, and none without its station's name.
        for text in page.evaluate("window.haltTexts"):
            assert text in ("", "halting …") or all(f"{name}" in text for name in ("fakes", "other")), text
        watched.close()


def test_a_page_halts_after_a_restart_of_the_service(browser: Any, tmp_path: Path) -> None:
    with serving(tmp_path) as running:
        watched = Watched(browser, running)
        page, keys, port = watched.page, running.keys, int(running.url.rpartition(":")[2])
        watched.log_in(running, "operate")
    page.wait_for_selector("#lost:has-text('No connection')")
    with serving(tmp_path, keys=keys, port=port) as running:
        page.wait_for_selector("#login:not([hidden])")
        page.wait_for_selector("#halt-hint:not([hidden])")
        running.bench.opened = True
        assert watched.can_halt() and watched.faults() == []
        page.keyboard.press("F9")
        page.wait_for_selector("#halt-told:not(.unsafe):has-text('fakes: shutter closed')")
        assert not running.bench.opened
        watched.log_in(running, "operate")
        assert page.is_hidden("#halt-hint")
        page.click("#logout")
        page.wait_for_selector("#login:not([hidden])")
        assert page.is_hidden("#halt")
        watched.complaints = []  # of the time without a service
        watched.close()


def test_a_key_that_may_only_read_gets_no_button_that_fails(browser: Any, lab: Running, ids: dict[str, str]) -> None:
    watched = Watched(browser, lab)
    watched.log_in(lab, "read")
    page = watched.page
    harmless = {
        "Show more",
        "Show older ones",
        "Search",
        "Compare the two chosen",
        "Auto",
        "+",
        "\u2212",
        "Fit",
        "Mark",
    }
    for address, there in views(ids):
        watched.go(address, "section.view:not([hidden]) h2")
        if there != "#plan-words:has-text('3 sequences')":
            page.wait_for_selector(there, state="attached")
        words = {button.inner_text() for button in page.query_selector_all("main button") if button.is_visible()}
        assert address == "/drift" or words <= harmless, address
    watched.close()


def test_what_a_hand_changed_is_told_until_somebody_says_that_it_is_put_back(browser: Any, tmp_path: Path) -> None:
    with serving(tmp_path) as running:
        station = running.store.root / "stations" / "fakes.toml"
        stops = "".join(f'\n[targets."f/{n}"]\nkind = "aperture"\nf_number = {n}\n' for n in (4, 8))
        station.write_text(station.read_text().replace("rows =", "f_number = 4.0, rows =") + stops)
        by_hand = ByHand(running.store.root, "20260101-000000-abcdef", read_station(station))
        by_hand.note_asked("f/8")
        by_hand.note_done("f/8")
        watched = Watched(browser, running)
        watched.log_in(running, "operate")
        told = watched.page.wait_for_selector("#stations .by-hand:has-text('stands at f/8')")
        assert "turn the aperture ring of each lens to f/4" in told.inner_text()
        assert watched.faults() == []
        watched.page.click("text=It is put back")
        watched.page.wait_for_selector("#stations .by-hand:empty", state="attached")
        assert left_by_hand(running.store.root) == ()
        watched.close()


def test_an_operators_step_is_confirmed_on_the_page(browser: Any, tmp_path: Path) -> None:
    """On the station's line by the keyboard, in the session's view by a click; who may only read sees the question."""
    with serving(tmp_path) as running, running.client("operate") as client:
        (running.store.root / "stations" / "fakes.toml").write_text(PERSON)
        session = begun(client, parameters={"dark": {"sensor_c": 35.0}})
        reading, watched = Watched(browser, running), Watched(browser, running, "dark", PHONE)
        reading.log_in(running, "read")
        told = reading.page.wait_for_selector("#strip .asks:has-text('bring the sensors to 35 C')")
        assert told.query_selector("button:visible") is None
        watched.log_in(running, "operate")
        watched.page.wait_for_selector("#strip .asks button:has-text('Done: 35 C is there')")
        assert watched.faults() == [] and watched.sideways_px() == 0 and watched.can_halt()
        watched.tab_to("Done: 35 C is there")
        watched.press("Enter", "#strip .asks:has-text('(cap)')")
        reading.page.wait_for_selector("#strip .asks:has-text('(cap)')")
        reading.go(f"/sessions/{session}/live", "#session-asks .asks:has-text('(cap)')")
        assert reading.faults() == [] and not reading.page.is_visible("#session-asks button")
        watched.go(f"/sessions/{session}/live", "#session-asks .asks:has-text('(cap)')")
        assert watched.faults() == [] and watched.sideways_px() == 0 and watched.can_halt()
        watched.page.click("#session-asks button:has-text('Done: cap is there')")
        watched.page.wait_for_selector("#session-asks .asks:has-text('(usual temperature)')")
        assert confirm(client, session, "usual temperature").status_code == 200  # by somebody else
        watched.page.wait_for_selector("#session-facts .state.finished")
        for page in (watched.page, reading.page):
            page.wait_for_selector(".asks:not([hidden])", state="detached")
        watched.close()
        reading.close()


def test_what_was_chosen_stays_chosen(browser: Any, lab: Running) -> None:
    other = STATION.replace('address = "', 'address = "other ').replace("a bench of fakes", "another bench")
    watched = Watched(browser, lab)
    page = watched.page
    watched.log_in(lab)
    lab.bench.delay_s = 0.1
    page.fill("#start-form input[name=name]", "in view")
    page.click("#start")
    page.wait_for_selector(".station.busy a:has-text('in view')")
    assert page.evaluate("scrollY") == 0
    (lab.store.root / "stations" / "another.toml").write_text(other)  # before the chosen one in the list
    page.wait_for_selector("#start-station option:nth-child(2)", state="attached")
    assert page.input_value("#start-station") == "fakes"
    watched.go("/sessions", "#sessions tr:has(.state.finished) a")
    page.click("#sessions tr:has(.state.finished) a:not(.tag)")
    page.wait_for_selector("#view-source:not([hidden])")
    page.wait_for_selector("#strip li:has-text('running') a[href*='/live']")  # what runs is one click away
    page.wait_for_selector("#session-title:focus")
    assert watched.can_halt()
    watched.tab_to("Fit")
    page.click("#halt")
    page.wait_for_selector("#halt-told:has-text('shutter closed')")
    lab.bench.delay_s = 0.0
    watched.close()


def test_sessions_beyond_the_first_page_are_reached(browser: Any, tmp_path: Path) -> None:
    with serving(tmp_path) as running, running.client() as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"], "queue": True}
        for number in range(53):
            late = asked | {"name": f"number {number}", "not_before": "2999-01-01T00:00:00Z"}
            assert client.post("/api/v1/sessions", json=late).status_code == 201
        watched = Watched(browser, running)
        page = watched.page
        page.fill("input[name=key]", running.keys["read"])
        page.press("input[name=key]", "Enter")
        page.wait_for_selector("#view-desk:not([hidden])")
        watched.go("/sessions", "#sessions tr:nth-child(50)")
        page.click("#more-sessions")
        page.wait_for_selector("#sessions tr:nth-child(53):has-text('number 0')")
        page.wait_for_selector("#more-sessions", state="hidden")
        watched.close()


@pytest.mark.parametrize("at", ["the desk", "the session"])
def test_a_running_page_asks_for_little(browser: Any, lab: Running, at: str) -> None:
    """Below 60 requests and 2 MB in 30 s of the page's clock, while a session runs."""
    watched = Watched(browser, lab)
    page = watched.page
    page.clock.install()
    watched.log_in(lab)
    lab.bench.delay_s = 0.1
    page.click("#start")
    page.wait_for_selector(".station.busy progress")
    if at == "the session":
        page.click(".station.busy .run a")
        page.wait_for_selector("#watch-histogram svg .line")
    asked: list[Any] = []
    page.on("requestfinished", lambda request: asked.append(request))  # noqa: PLW0108 - the binding marks the function
    for _ in range(6):  # 30 s
        page.clock.run_for(5000)
        page.wait_for_load_state("networkidle")
    sizes = [sum(one.sizes()[key] for key in ("responseBodySize", "responseHeadersSize")) for one in asked]
    assert 6 * 2 <= len(asked) < 60 and sum(sizes) < 2_000_000
    page.click("#halt")
    page.wait_for_selector("#halt-told:has-text('shutter closed')")
    lab.bench.delay_s = 0.0
    watched.close()
