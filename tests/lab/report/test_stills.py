"""The first screen's charts as static SVG: in place, in range, well-formed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from lab.cli import main
from lab.errors import InputError
from lab.fit.noise.pixel_maps import PixelMaps
from lab.formats.recording_set import Manifest, RecordingSet, write
from lab.report import charts, provenance_of, render_report
from lab.report.answers import proofs
from lab.report.pictures import map_picture, write_maps
from lab.report.stills import LEFT, RIGHT, WIDTH, still
from tests.peers import browser_program


def numbers(path: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?[0-9.]+", path)]


def drawn(figure: charts.Figure) -> ElementTree.Element:
    return ElementTree.fromstring(str(still(figure, 0)).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1))


def texts(svg: ElementTree.Element) -> list[str]:
    return [found.text or "" for found in svg.iter() if found.tag.endswith("text")]


def simple(**more: Any) -> charts.Figure:
    trace = {
        "mode": "lines",
        "name": "a < b",
        "x": [0.0, 5.0, None, 10.0],
        "y": [0.0, 1.0, 2.0, -2.0],
        "line": {"color": "@fg", "width": 1},
    }
    layout = charts.layout(
        330, xaxis=charts.axis("x", range=[0.0, 10.0]), yaxis=charts.axis("y<br>z", range=[-4.0, 4.0])
    )
    return {"data": [trace | more], "layout": layout}


def test_values_stand_where_the_axes_say() -> None:
    svg = drawn(simple())
    (line,) = (one for one in svg.iter() if "clip-path" in one.attrib for one in one)
    x0, y0, x1, y1, x2, y2 = numbers(line.attrib["d"])
    # written with one decimal: within 0.05
    assert (x0, x2) == pytest.approx((LEFT, WIDTH - RIGHT), abs=0.06)
    assert x1 == pytest.approx((x0 + x2) / 2, abs=0.11)
    assert y0 - y1 == pytest.approx((y2 - y0) / 2, abs=0.16)  # 1 up, 2 down
    assert {"a < b", "x", "y", "z", "0", "10", "\N{MINUS SIGN}2"} <= set(texts(svg))


def test_error_bars_open_markers_and_names_of_points() -> None:
    figure = simple(
        mode="markers",
        marker={"color": "#123456", "size": 6, "symbol": "circle-open"},
        error_y={"array": [1.0, None, 1.0, 2.0]},
    )
    figure["layout"]["xaxis"] |= {"tickvals": [0.0, 10.0], "ticktext": ["dark skin", "white & grey"]}
    svg = drawn(figure)
    bars, rings = (one.attrib["d"] for group in svg.iter() if "clip-path" in group.attrib for one in group)
    assert bars.count("M") == 2 and rings.count("M") == 3
    (x, low, high, *_) = numbers(bars)
    assert x == pytest.approx(LEFT, abs=0.06) and low > high  # upwards is less
    assert {"dark skin", "white & grey"} <= set(texts(svg))


@pytest.mark.parametrize("diagnosed", [True, False])
def test_every_chart_of_the_first_screen_has_one(made_up: Callable[..., Any], diagnosed: bool) -> None:
    fit, _, diagnosis = made_up()
    shown = proofs(fit, diagnosis if diagnosed else None)
    assert shown
    for proof in shown:
        svg = drawn(proof.figure)
        named = {trace["name"] for trace in proof.figure["data"] if trace.get("showlegend", True)}
        assert named <= set(texts(svg)) and len(still(proof.figure, 0)) < 40_000
        assert "nan" not in still(proof.figure, 0) and "inf" not in still(proof.figure, 0)


@pytest.mark.parametrize("stated", [[1.0, 1.0], [float("nan"), float("nan")], None])
@pytest.mark.parametrize("values", [[3.0] * 4, [0.0] * 4, [float("nan")] * 4, [None] * 4, [1e-30, 2e-30, 0.0, 1e-30]])
def test_values_without_a_range_are_drawn_all_the_same(stated: list[float] | None, values: list[float]) -> None:
    figure = simple(mode="markers", y=values, marker={"color": "@fg", "size": 4}, error_y={"array": [float("nan")] * 4})
    figure["layout"]["yaxis"] = charts.axis("y") | ({"range": stated} if stated is not None else {})
    assert "nan" not in (text := still(figure, 0)) and "inf" not in text


# --- Maps of single pixels as files: they hold the fitted values, and undetermined ones are left out ------------------


SHAPE = (24, 40)


def maps(**changes: object) -> PixelMaps:
    row, col = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    bad = np.zeros(SHAPE, bool)
    bad[10, 20] = True
    known = {
        "offset_dn": 64.0 + row,
        "offset_dn_std": np.full(SHAPE, 0.5),
        "dark_dn_per_s": None,
        "dark_dn_per_s_std": None,
        "gain": 1.0 + 0.001 * col,
        "gain_std": np.full(SHAPE, 0.002),
        "defective": bad,
    }
    return PixelMaps(**(known | changes))  # type: ignore[arg-type]


def test_what_is_written_is_what_was_found(tmp_path: Path) -> None:
    found = maps()
    names = write_maps(tmp_path / "new" / "left", found)
    assert set(names) == {path.name for path in (tmp_path / "new" / "left").iterdir()}
    assert not any("dark" in name for name in names)
    for name in ("offset_dn", "offset_dn_std", "gain", "gain_std"):
        stored = np.load(tmp_path / "new" / "left" / f"{name}.npy")
        assert stored.dtype == np.float32
        assert np.allclose(stored, getattr(found, name), rtol=1e-6)
    assert np.array_equal(np.load(tmp_path / "new" / "left" / "defective.npy"), found.defective)
    said = json.loads((tmp_path / "new" / "left" / "maps.json").read_text())
    assert said["defective"]["pixels"] == 1 and said["offset_dn"]["unit"] == "DN"
    dots = cv2.imread(str(tmp_path / "new" / "left" / "defective.png"), cv2.IMREAD_GRAYSCALE)
    assert dots is not None and dots.shape == SHAPE and np.count_nonzero(dots) == 9
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="can't be written"):
        write_maps(tmp_path / "file", found)


def test_pictures_go_from_dark_to_bright_over_98_percent_of_the_pixels() -> None:
    values = np.arange(1000.0).reshape(20, 50)
    picture, low, high = map_picture(values)
    assert (low, high) == pytest.approx((9.99, 989.01))
    luminance = picture.astype(int).sum(axis=2)
    assert picture.shape == (20, 50, 3) and luminance[0, 0] < luminance[-1, -1]
    assert map_picture(values, 25)[0].shape == (10, 25, 3)


def test_the_command_writes_them_and_says_where_there_are_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(1)
    captures, frames = [], {}
    for side, kinds in (("left", {0.01: "dark", 1.0: "dark"}), ("right", {0.02: "flat", 0.05: "flat"})):
        for exposure_s, kind in kinds.items():
            for _ in range(2):
                name = f"frames/{len(captures)}.npy"
                captures.append(
                    {"id": str(len(captures)), "kind": kind, "side": side, "frame": name, "exposure_s": exposure_s}
                )
                frames[name] = np.rint(100.0 + 20.0 * exposure_s + 3.0 * rng.standard_normal(SHAPE)).astype(np.uint16)
    camera = {"rows": SHAPE[0], "cols": SHAPE[1], "cfa": "MONO", "bit_depth": 12}
    manifest = Manifest.model_validate({"cameras": {"left": camera, "right": camera}, "captures": captures})
    folder = write(RecordingSet(manifest, frames), tmp_path / "set")
    assert main(["fit", str(folder), "--json", "-", "--maps", str(tmp_path / "maps")]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["format"] == "calibench-fit"
    assert "offset_dn.npy" in said.err and "maps (right): none: no darks" in " ".join(said.err.split())
    rate = np.load(tmp_path / "maps" / "left" / "dark_dn_per_s.npy")
    # 3 DN of noise, two frames at either end of 1 s: 3 DN/s a pixel, 0.1 over all; three of these.
    assert rate.mean() == pytest.approx(20.0, abs=3 * 3.0 / np.sqrt(rate.size))
    assert not (tmp_path / "maps" / "right").exists()


# --- The report on paper, in a real browser ---------------------------------------------------------------------------


WIDTHS = """() => [...document.querySelectorAll(".chart")].filter(box => box.querySelector(".main-svg"))
    .map(box => [box.clientWidth, box.querySelector(".main-svg").clientWidth])"""


@pytest.mark.extra
def test_charts_are_drawn_anew_for_paper(
    small_set: Callable[..., RecordingSet], made_up: Callable[..., Any], tmp_path: Path
) -> None:
    program = browser_program()
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


@pytest.mark.extra
def test_axe_finds_nothing_and_a_phone_needs_no_scroll_sideways(
    small_set: Callable[..., RecordingSet], made_up: Callable[..., Any], tmp_path: Path
) -> None:
    program = browser_program()
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
