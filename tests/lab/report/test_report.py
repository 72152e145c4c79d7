"""The report: one self-contained page that says what the results say, whatever is missing from them."""

import base64
import gzip
import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lab.calibration.limits import CalibrationLimits
from lab.errors import NoRoom
from lab.formats.recording_set import DataSheet, InstrumentSnapshot, RecordingSet
from lab.formats.results import (
    CameraFit,
    DiagnosisResult,
    DiscoveredLaw,
    EffectSet,
    FitResult,
    MakerDeparture,
    ParameterValue,
    PatchComparison,
    PolicyRule,
    ResidualCurve,
    Resolution,
    RivalOdds,
    SideModels,
    SpectralFit,
    Unexplained,
    Unlisted,
    ValidationResult,
)
from lab.predict.validate import BothModels, SensitivityCurve
from lab.report import charts, provenance_of, render_report, write_report
from lab.report.answers import odds
from lab.report.charts import figure_json, plotly_base64
from lab.report.diagnosis import context
from lab.report.figures import KeyFigure, by_side, rotation_vector_mrad
from lab.report.pictures import (
    difference_picture,
    frame_picture,
    kernel_picture,
    patch_colours,
    png_data_uri,
    trim_margin,
)

MadeUp = Callable[..., Any]


def figures_in(charts: str) -> list[dict[str, Any]]:
    """The figures of a page's chart data, typed arrays as lists."""

    def plain(found: dict[str, Any]) -> Any:
        if "bdata" not in found:
            return found
        shape = [int(size) for size in found.get("shape", "-1").split(",")]
        return np.frombuffer(base64.b64decode(found["bdata"]), "<f4").reshape(shape).tolist()

    lines = gzip.decompress(base64.b64decode(charts)).decode().splitlines()
    return [json.loads(line, object_hook=plain) for line in lines]


class Page(HTMLParser):
    """What a browser would find: text, outside addresses, figures; and that every element is closed."""

    EMPTY = frozenset({"meta", "img", "br", "link", "input", "hr"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.addresses: list[str] = []
        self.figures: list[dict[str, Any]] = []
        self.open: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.addresses += [value for key, value in found.items() if key in ("src", "href", "data") and value]
        if tag not in self.EMPTY:
            self.open.append((tag, found))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop()[0] == tag

    def handle_data(self, data: str) -> None:
        tag, attrs = self.open[-1] if self.open else ("", {})
        if tag == "script":
            if attrs.get("id") == "charts":
                self.figures = figures_in(data)
        elif tag != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture
def page(small_set: Callable[..., RecordingSet], made_up: MadeUp) -> Page:
    recordings = small_set()
    there = {
        "monochromator": InstrumentSnapshot(model="Cornerstone 260", serial_number="C-1"),
        "camera left": InstrumentSnapshot(
            settings={"BalanceRatio[Red]": 1.0, "Gamma": 0.8},
            found={"BalanceRatio[Red]": 1.8},
            departures=("Gamma = 0.8: its codes aren't the converter's",),
        ),
    }
    manifest = recordings.manifest.model_copy(update={"instruments": there, "changes": ("camera left: it differs",)})
    recordings = recordings.under(manifest)
    return Page(render_report(recordings, *made_up(), provenance_of(recordings)))


def test_page_needs_nothing_from_elsewhere(page: Page) -> None:
    assert all(
        address.startswith(("#", "data:image/png;base64,", "data:image/webp;base64,")) for address in page.addresses
    )


def test_every_anchor_leads_somewhere(small_set: Callable[..., RecordingSet], made_up: MadeUp) -> None:
    recordings = small_set()
    text = render_report(recordings, *made_up(), provenance_of(recordings))
    for anchor in re.findall(r'href="#(\w+)"', text):
        assert f'id="{anchor}"' in text


def test_page_says_what_the_results_say(page: Page) -> None:
    for words in (
        "The baseline model leaves physics out; the named effects account for it.",
        "Optical low-pass filter, left: distance of the two copies along columns at 589 nm 2.104 ± 0.051 µm",
        "Optical low-pass filter: probability 99.4 %; rivals: defocus (0.006)",
        "What was found",
        "What to do",
        "The right camera shows no mismatch in these recordings.",
        "0.18..0.41 cy/px, all channels",
        "χ² falls from 9120 to 480 over 468 numbers",
        "defocus (0.006)",
        "0.42000 ± 0.00090 DN/e",
        "the lamp drifted by 0.08 % between repeats",
        "baseline 60.020 ± 0.021 mm",
        "no bernoulli captures of pose p2; capture one",
        "serial number C-1",
        "Settings of the camera left: 2 before the first capture, 1 of them found otherwise",
        "BalanceRatio[Red] 1 1.8",
        "Gamma = 0.8: its codes aren't the converter's",
        "camera left: it differs",
        "numpy",
    ):
        assert words in page.text, words


def test_charts_carry_uncertainty_and_labelled_axes(page: Page) -> None:
    assert (
        len(page.figures) >= 2 + 2 + 4 + 2 + 2 + 2
    )  # diagnosis, residuals (one a measurement), transfer, QE, MTF, chart
    for figure in page.figures:
        axes = [value for key, value in figure["layout"].items() if re.fullmatch(r"[xy]axis\d*", key)]
        assert axes
        assert all("gridcolor" in one for one in axes)
    transfer = [figure for figure in page.figures if "variance" in json.dumps(figure["layout"])]
    assert len(transfer) == 2 + 1  # one on the first screen, too: the made-up diagnosis has curves of one measurement
    for figure in transfer:
        points = [trace for trace in figure["data"] if trace["mode"] == "markers"]
        assert all(len(trace["error_y"]["array"]) == len(trace["x"]) for trace in points)
    bands = [trace for figure in page.figures for trace in figure["data"] if trace.get("fill") == "toself"]
    assert len(bands) >= 3 * 2 + 3 * 12 * 2  # QE, and every MTF


def test_line_of_the_photon_transfer_has_the_fitted_slope(made_up: MadeUp) -> None:
    noise = made_up()[0].cameras["left"].noise
    figure = charts.photon_transfer(noise)
    assert figure is not None
    (line,) = (trace for trace in figure["data"] if trace["mode"] == "lines")
    assert line["y"][1] / line["x"][1] == pytest.approx(noise.conversion_gain_dn_per_e, rel=1e-12)


def test_nothing_determined_still_makes_a_page(small_set: Callable[..., RecordingSet]) -> None:
    recordings = small_set(sides=("left",))
    fit = FitResult(source="x", cameras={"left": CameraFit()})
    page = Page(render_report(recordings, fit, None, None, provenance_of(recordings)))
    assert "they were not diagnosed" in page.text
    assert page.figures == []


def test_baseline_that_explains_everything(small_set: Callable[..., RecordingSet], made_up: MadeUp) -> None:
    recordings = small_set(sides=("left",))
    page = Page(render_report(recordings, *made_up(verdict="no_mismatch", sides=("left",)), provenance_of(recordings)))
    assert "The baseline model explains these recordings." in page.text
    assert "false-alarm rate of 0.01" in page.text
    assert "shows no mismatch" not in page.text
    assert "Decision policy" not in page.text


def test_mismatch_without_a_name(small_set: Callable[..., RecordingSet], made_up: MadeUp) -> None:
    recordings = small_set()
    fit, validation, diagnosis = made_up()
    nameless = Unexplained(
        side="left", measurement="flat", axis="time", where="0..10 s", shape="a slow fall", significance_sigma=9.1,
        chi2_before=300.0, chi2_after=98.0, n=100, check="The left camera looks as if the pitch were 3 um: check it.",
    )  # fmt: skip
    rule = PolicyRule(name="false_alarm_rate", group="significance", value=0.01, unit="1", meaning="healthy cameras")
    changed = diagnosis.model_copy(
        update={"verdict": "unexplained", "effects": (), "unexplained": (nameless, nameless), "policy": (rule,)}
    )
    page = Page(render_report(recordings, fit, validation, changed, provenance_of(recordings)))
    assert "no family of effects accounts for" in page.text
    assert "a slow fall" in page.text
    assert page.text.count(nameless.check) == 1  # whatever the number of measurements that say so
    assert page.text.index(nameless.check) < page.text.index("a slow fall")
    assert "significance false alarm rate 0.01 healthy cameras" in page.text


def test_a_law_without_a_name_is_told_and_drawn(small_set: Callable[..., RecordingSet], made_up: MadeUp) -> None:
    """Its table with two standard deviations in per cent, on an axis that says by what it repeats."""
    recordings = small_set()
    fit, validation, diagnosis = made_up()
    law = DiscoveredLaw(
        side="left", stage="codes", along="code", period=2, table=(1.04, 0.96), shown_period=2, shown_departure=(0.04,
        -0.04),
        shown_std=(0.01, 0.01), chi2_before=900.0, chi2_after=120.0, n=100, suspects="a heavy bit",
        statement="Codes repeat.",
    )  # fmt: skip
    changed = diagnosis.model_copy(update={"verdict": "partly_explained", "discovered": (law,)})
    page = Page(render_report(recordings, fit, validation, changed, provenance_of(recordings)))
    assert "Codes repeat." in page.text
    ((_, figure),) = context(changed, ("left",))["discovered"]
    (points,) = figure["data"]
    assert points["y"] == pytest.approx([4.0, -4.0])
    assert points["error_y"]["array"] == pytest.approx([2.0, 2.0])
    assert figure["layout"]["xaxis"]["title"]["text"] == "code mod 2"


def _law(departure: list[float], **fields: Any) -> DiscoveredLaw:
    return DiscoveredLaw(
        side="left", period=fields.pop("period", 0), table=tuple(1.0 + d for d in departure),
        shown_period=fields.pop("shown_period", 0), shown_departure=tuple(departure),
        shown_std=(0.01,) * len(departure), chi2_before=900.0, chi2_after=120.0, n=100, suspects="a lamp",
        statement="It steps.", **fields,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("law", "x", "y", "title"),
    [
        (
            _law([0.0, 0.02, 0.02], stage="light", along="time", form="step", at=(10.0, 40.0, 90.0)),
            [10.0, 40.0, 90.0], [0.0, 2.0, 2.0], "time, s after the first capture",
        ),
        (
            _law([-0.01, -0.01, 0.01, 0.01], stage="charge", along="column", form="step", at=(0.375, 0.625)),
            [0.0, 1.0, 2.0, 3.0], [-1.0, -1.0, 1.0, 1.0], "column",
        ),
        (
            _law([0.1, -0.1], stage="codes", along="code", form="by index", first=500),
            [500.0, 501.0], [10.0, -10.0], "code",
        ),
    ],
)  # fmt: skip
def test_curves_steps_and_codes_are_drawn_along_their_index(
    law: DiscoveredLaw, x: list[float], y: list[float], title: str, made_up: MadeUp
) -> None:
    changed = made_up()[2].model_copy(update={"discovered": (law,)})
    ((_, figure),) = context(changed, ("left",))["discovered"]
    points = figure["data"][-1]
    assert (points["x"], points["y"]) == (pytest.approx(x), pytest.approx(y))
    assert figure["layout"]["xaxis"]["title"]["text"] == title


def test_a_table_by_row_and_column_is_a_map(made_up: MadeUp) -> None:
    law = _law([0.01, -0.01, 0.02, -0.02], stage="charge", along="row and column", period=2, columns=2, shown_period=4)
    changed = made_up()[2].model_copy(update={"discovered": (law,)})
    ((_, figure),) = context(changed, ("left",))["discovered"]
    (cells,) = figure["data"]
    assert np.array(cells["z"]) == pytest.approx(np.array([[1.0, -1.0], [2.0, -2.0]]))


def test_each_capture_that_settled_a_tie_is_told_with_what_stood_before_it(
    small_set: Callable[..., RecordingSet], made_up: MadeUp
) -> None:
    recordings = small_set()
    fit, validation, diagnosis = made_up()
    odds = [
        tuple(RivalOdds(name=name, probability=p) for name, p in stage)
        for stage in ((("defocus", 0.6), ("coma", 0.4)), (("defocus", 0.9), ("coma", 0.1)), (("defocus", 0.998),))
    ]
    taken = tuple(
        Resolution(
            capture=f"{what} frames",
            session=f"s-{what}",
            verdict_before=verdict,
            effects_before=(),
            rivals=odds[k],
            rivals_after=odds[k + 1],
            information_nat=0.25,
            expected_s=12.0,
            spent_s=17.0,
        )
        for k, (what, verdict) in enumerate((("dark", "unexplained"), ("flat", "partly_explained")))
    )
    ended = {"resolutions": taken, "resolve_end": "settled", "resolve_reason": "no rivals are left"}
    settled = diagnosis.model_copy(update=ended)
    page = Page(render_report(recordings, fit, validation, settled, provenance_of(recordings)))
    told = " ".join(page.text.split())
    assert "Settled: no rivals are left." in told
    rows = [told.index(words) for words in ("dark frames (session s-dark)", "flat frames (session s-flat)")]
    assert rows == sorted(rows)
    first, second = told[rows[0] : rows[1]], told[rows[1] :]
    assert "0.25 nat" in first and "17 s" in first
    assert re.search(r"defocus 0.9, coma 0.1", first, re.IGNORECASE)
    assert re.search(r"defocus 1\b", second, re.IGNORECASE)


def test_the_first_screen_answers_and_all_else_is_folded(
    page: Page, small_set: Callable[..., RecordingSet], made_up: MadeUp
) -> None:
    recordings = small_set()
    text = render_report(recordings, *made_up(), provenance_of(recordings))
    screen, _, rest = text[text.index("<body>") :].partition("<details")
    for question in ("What was found", "How sure", "What it means", "What to do"):
        assert question in screen
    assert screen.count('class="chart"') == 2  # the two that prove it
    assert page.figures[0]["data"][0]["name"] == "measured"  # and the first of them has both models
    assert {trace["name"] for trace in page.figures[0]["data"]} == {"measured", "baseline", "improved model"}
    assert rest.count('class="chart"') == len(page.figures) - 2
    assert f"<h1>{recordings.manifest.name}</h1>" in screen


def test_numbers_travel_as_typed_arrays() -> None:
    z = [[0.5, None, 2.0], [1.0, 3.0, 4.0]] * 4
    figure = {"data": [{"x": list(range(9)), "y": ["a"] * 9, "z": z, "text": [1.0] * 9}], "layout": {"height": 1 / 3}}
    sent = json.loads(figure_json(figure))
    trace = sent["data"][0]
    assert trace["x"]["dtype"] == "f4" and trace["z"]["shape"] == "8, 3"
    assert trace["y"] == ["a"] * 9 and trace["text"] == [1.0] * 9
    np.testing.assert_array_equal(np.frombuffer(base64.b64decode(trace["x"]["bdata"]), "<f4"), np.arange(9))
    back = np.frombuffer(base64.b64decode(trace["z"]["bdata"]), "<f4").reshape(8, 3)
    np.testing.assert_array_equal(back, np.array(z, float).astype("f4"))  # a missing number is NaN


def test_the_charts_library_is_whole() -> None:
    assert gzip.decompress(base64.b64decode(plotly_base64()))[:80].startswith(
        b"/**\n* plotly.js (cartesian - minified) v4.1.1"
    )


def test_text_from_outside_stays_text(small_set: Callable[..., RecordingSet], made_up: MadeUp) -> None:
    recordings = small_set()
    evil = '</script><script>alert("x")</script><img src=x onerror=alert(1)>'
    manifest = recordings.manifest.model_copy(update={"name": evil, "notes": evil})
    recordings = RecordingSet(manifest, files=recordings._files, source=evil, warnings=(evil,))
    fit, validation, diagnosis = made_up()
    check = validation.checks[0]
    curve = check.curves[0].model_copy(update={"label": evil})
    checks = (check.model_copy(update={"curves": (curve,), "capture": evil}), *validation.checks[1:])
    page = Page(
        render_report(
            recordings, fit, validation.model_copy(update={"checks": checks}), diagnosis, provenance_of(recordings)
        )
    )
    assert page.text.count('alert("x")') >= 4
    assert not any("onerror" in address for address in page.addresses)


def test_writing_is_whole_or_not_at_all(
    small_set: Callable[..., RecordingSet], made_up: MadeUp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings, results = small_set(), made_up()
    file = write_report(tmp_path / "deep" / "report.html", recordings, *results)
    assert file.read_text().startswith("<!doctype html>")
    assert file.stat().st_size < 2e6

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(NoRoom, match="No space left"):
        write_report(tmp_path / "deep" / "other.html", recordings, *results)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["report.html"]


def test_provenance_has_a_digest_of_every_frame(small_set: Callable[..., RecordingSet]) -> None:
    one, same, other = small_set(1), small_set(1), small_set(2)
    first = provenance_of(one)
    assert set(first.frame_sha256) == {capture.id for capture in one.captures()}
    assert first.frame_sha256 == provenance_of(same).frame_sha256
    assert not set(first.frame_sha256.values()) & set(provenance_of(other).frame_sha256.values())
    assert {"python", "calibench", "numpy"} <= set(first.versions)


# --- figures and pictures ---------------------------------------------------------------------------------------------


def test_what_one_side_lacks_keeps_its_place(made_up: MadeUp) -> None:
    fit = made_up()[0]
    noise = fit.cameras["left"].noise.model_copy(update={"full_well_e": None})
    left = fit.cameras["left"].model_copy(update={"noise": noise})
    names = [
        name
        for name, _ in by_side(fit.model_copy(update={"cameras": {"left": left, "right": fit.cameras["right"]}}), {})
    ]
    assert names.index("saturation capacity (full well)") == names.index("dark current") + 1


def test_rotation_vector_of_known_turns() -> None:
    angle = 0.02
    about_y = ((np.cos(angle), 0, np.sin(angle)), (0, 1, 0), (-np.sin(angle), 0, np.cos(angle)))
    assert rotation_vector_mrad(about_y) == pytest.approx((0, 20, 0), abs=1e-9)
    assert rotation_vector_mrad(((1, 0, 0), (0, 1, 0), (0, 0, 1))) == (0, 0, 0)


def decoded(uri: str) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    return cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def test_pictures_have_the_right_way_up_and_the_right_colours() -> None:
    image = np.zeros((3, 5, 3), np.uint8)
    image[0, 4] = (255, 0, 10)
    np.testing.assert_array_equal(decoded(png_data_uri(image)), image)
    sign = decoded(difference_picture(np.array([[-1.0, 0.0, 1.0]]), 1.0))
    assert sign[0, 0, 2] > sign[0, 0, 0]  # too little: blue
    assert tuple(sign[0, 1]) == (255, 255, 255)
    assert sign[0, 2, 0] > sign[0, 2, 2]  # too much: red
    kernel = np.zeros((5, 5))
    kernel[1, 3] = 1
    assert decoded(kernel_picture(kernel, 1.0))[1, 3].sum() > decoded(kernel_picture(kernel, 1.0))[3, 1].sum()


def test_frame_picture_puts_the_mosaic_channels_where_they_belong() -> None:
    camera = DataSheet(rows=4, cols=4, cfa="GBRG", bit_depth=12, black_level_dn=10)
    frame = np.full((4, 4), 10, np.uint16)
    frame[0::2, 1::2] = 1000  # blue of GBRG
    assert tuple(decoded(frame_picture(frame, camera))[0, 0]) == (0, 0, 255)


def test_border_that_holds_nothing_is_cut_off() -> None:
    kernel = np.zeros((21, 21))
    kernel[10, 10], kernel[10, 14] = 1.0, 0.1
    assert trim_margin([kernel]) == 6
    assert trim_margin([np.ones((9, 9))]) == 0


def test_patch_colours_are_balanced_on_the_measured_white() -> None:
    values = {"R": 500.0, "G": 1000.0, "B": 250.0}
    white = [
        PatchComparison(patch="white", channel=c, predicted_dn=v, predicted_dn_std=1, measured_dn=v, measured_dn_std=1)
        for c, v in values.items()
    ]
    red = [
        PatchComparison(patch="red", channel=c, predicted_dn=0.5 * v, predicted_dn_std=1,
        measured_dn=v * (0.5 if c == "R" else 0.0), measured_dn_std=1)
        for c, v in values.items()
    ]  # fmt: skip
    colours = patch_colours((*white, *red))
    level = round(255 * 0.9 ** (1 / 2.2))
    assert colours["white"] == (f"#{level:02x}" + f"{level:02x}" * 2,) * 2
    assert colours["red"][0].endswith("0000")
    assert len(set(re.findall("..", colours["red"][1][1:]))) == 1  # the prediction is grey


def test_departures_from_the_makers_curves_are_drawn_where_they_are(small_set: Callable[..., RecordingSet]) -> None:
    recordings = small_set()
    departure = MakerDeparture(
        channel="G",
        from_nm=540.0,
        to_nm=560.0,
        difference=-0.04,
        difference_std=0.005,
        difference_percent=-8.0,
        significance_sigma=7.0,
    )
    wave = tuple(np.arange(400.0, 701.0, 10.0))
    fit = SpectralFit(
        wavelength_nm=wave,
        quantum_efficiency={c: (0.5,) * len(wave) for c in "RGB"},
        quantum_efficiency_std={c: (0.01,) * len(wave) for c in "RGB"},
        maker_scale=0.98,
        maker_departures=(departure,),
    )
    drawn = charts.quantum_efficiency(fit, recordings, "left")["layout"]
    # Half a step to either side: the band's outer wavelengths belong to it.
    assert {(shape["x0"], shape["x1"]) for shape in drawn["shapes"]} == {(535.0, 565.0)}
    (note,) = drawn["annotations"]
    assert note["text"] == "-8.0 %" and note["x"] == 550.0 and "7.0 sigma" in note["hovertext"]
    assert drawn["yaxis"]["range"][1] > 0.5 / 0.85  # room for the strips
    plain = charts.quantum_efficiency(fit.model_copy(update={"maker_departures": ()}), recordings, "left")["layout"]
    assert plain["shapes"] == [] and plain["annotations"] == []


def residual_panel(curve: ResidualCurve) -> list[dict[str, Any]]:
    return [trace for trace in charts.residual_curve(curve)["data"] if trace.get("yaxis") == "y2"]


def a_curve(before: tuple[float, ...]) -> ResidualCurve:
    count = len(before)
    return ResidualCurve(
        side="left", measurement="slanted_edge", label="5 deg", channel="G", axis="spatial frequency, cy/px",
        x=tuple(0.1 * k for k in range(count)), measured=(1.0,) * count, measured_std=(0.1,) * count, before=before,
        after=(1.0,) * count, held_out=False,
    )  # fmt: skip


def test_residuals_beyond_five_sigma_are_triangles_at_the_edge_with_their_count() -> None:
    drawn = charts.residual_curve(a_curve((1.4, 9.0, -2.0, 1.0)))  # residuals -4, -80, +30, 0 sigma
    panel = residual_panel(a_curve((1.4, 9.0, -2.0, 1.0)))
    found = {trace["marker"]["symbol"]: (trace["x"], trace["y"]) for trace in panel if trace["name"] == "baseline"}
    assert found["triangle-down"] == ([0.1], [-5.0]) and found["triangle-up"] == ([0.2], [5.0])
    assert found["circle"][1] == pytest.approx([-4.0, 0.0])
    low, high = drawn["layout"]["yaxis2"]["range"]
    assert all(low < y < high for trace in panel for y in trace["y"])
    (note,) = drawn["layout"]["annotations"]
    assert note["text"] == "baseline: 2 of 4 beyond ±5 σ, to −80 σ"
    low, high = drawn["layout"]["yaxis"]["range"]
    assert low < -2.0 and high > 9.0  # the baseline is drawn whole
    assert charts.residual_curve(a_curve((1.1, 0.9)))["layout"]["annotations"] == []


def test_a_figure_whose_uncertainty_exceeds_it_is_not_determined() -> None:
    assert KeyFigure("radial distortion k3", "1", -2.0, 17.0).text == "not determined (-2 ± 17)"
    assert KeyFigure("DSNU", "e", 1.3, 0.05).text == "1.300 ± 0.050 e"
    assert KeyFigure("stereo translation y", "mm", 0.01, 0.02, may_be_zero=True).text == "0.010 ± 0.020 mm"


def both_models(validation: ValidationResult, diagnosis: DiagnosisResult, fit: FitResult) -> BothModels:
    """The baseline's checks, and the improved model's that all pass."""
    mended = tuple(
        check.model_copy(update={"passed": True, "chi2": 1.0 * check.n, "rms_relative_percent": 0.41})
        for check in validation.checks
    )
    spectral = fit.cameras["left"].spectral
    assert spectral is not None
    curve = SensitivityCurve(spectral.wavelength_nm, (0.9,) * 33, (0.2,) * 33)
    return BothModels(validation.checks, mended, {"left": dict.fromkeys("RGB", curve)})


def test_both_models_stand_beside_what_was_measured(small_set: Callable[..., RecordingSet], made_up: MadeUp) -> None:
    recordings, (fit, validation, diagnosis) = small_set(), made_up()
    both = both_models(validation, diagnosis, fit)
    page = Page(render_report(recordings, fit, validation, diagnosis, provenance_of(recordings), both))
    assert (
        "The baseline of the left camera misses MTF by 9.1 % rms, PSF by 12 % rms; the improved model: 0.41 %"
        in page.text
    )
    assert "ColorChecker baseline 1.2 % rms" in page.text and "fitted camera 1.2 % rms" in page.text
    assert "It can predict a chart well where the baseline departs from it" in page.text
    names = [{trace.get("name") for trace in figure["data"]} for figure in page.figures]
    assert sum({"baseline", "improved model", "measured"} <= one for one in names) >= 2  # the charts of both sides
    assert sum({"baseline", "improved model", "R measured"} <= one for one in names) >= 2 + 1  # MTF, sensitivity
    alone = Page(render_report(recordings, fit, validation, diagnosis, provenance_of(recordings)))
    assert "Predicted by the fitted camera" in alone.text and "improved camera is known here" in alone.text


def test_figures_are_judged_by_the_limits_that_are_stated(
    small_set: Callable[..., RecordingSet], made_up: MadeUp
) -> None:
    recordings, results = small_set(), made_up()
    limits = CalibrationLimits.model_validate(
        {"limit": [{"figure": "noise read_noise_e", "good": [0, 3]}, {"figure": "noise dsnu_e", "good": [0, 1]}]}
    )
    text = Page(render_report(recordings, *results, provenance_of(recordings), None, limits)).text
    assert "left 2.600 ± 0.031 e 0 .. 3 pass" in text and "left 1.300 ± 0.050 e 0 .. 1 fail" in text


def test_the_odds_hold_all_models_and_add_up(made_up: MadeUp) -> None:
    diagnosis = made_up()[2]
    sets = (
        EffectSet(effects=("optical_low_pass_filter",), probability=0.9),
        EffectSet(effects=(), probability=0.04),
    )
    models = SideModels(side="left", share=0.95, sets=sets, inclusion=())
    ((side, rows),) = odds(diagnosis.model_copy(update={"models": (models,)}))
    assert side == "left"
    assert rows[0] == ("optical low-pass filter, none further", 0.9) and rows[1] == ("no effect: the baseline", 0.04)
    assert sum(probability for label, probability in rows if not label.startswith("rival")) == pytest.approx(1.0)
    assert rows[-1] == ("rival of optical low-pass filter: defocus", 0.006)


def test_a_table_of_sets_is_shown_with_what_is_unlisted(
    small_set: Callable[..., RecordingSet], made_up: MadeUp
) -> None:
    """By the engine `evidence`: no condition on listed causes, unlisted physics beside each set and by itself, rivals
    among the sets, and a size that isn't determined told so."""
    recordings, (fit, validation, diagnosis) = small_set(), made_up()
    sets = (
        EffectSet(effects=("optical_low_pass_filter",), probability=0.6),
        EffectSet(effects=("optical_low_pass_filter",), probability=0.38, unlisted=("transfer",)),
    )
    models = SideModels(side="left", share=0.95, sets=sets, inclusion=(), never_refitted=0.004)
    size = ParameterValue(value=2.0, std=1.5, unit="um", interval=(0.0, 5.5), is_determined=False)
    told = diagnosis.effects[0].model_copy(update={"parameters": {"displacement_x_um": size}})
    unlisted = Unlisted(
        side="left", state="transfer", measurements=("slanted_edge",), probability=0.61, where="0.2..0.4 cy/px"
    )  # fmt: skip
    by_table = diagnosis.model_copy(
        update={"engine": "evidence", "models": (models,), "unlisted": (unlisted,), "effects": (told,)}
    )
    text = Page(render_report(recordings, fit, validation, by_table, provenance_of(recordings))).text
    assert "If every cause is a listed effect" not in text
    assert "Posterior probabilities; unlisted physics is among them." in text
    assert "optical low-pass filter + unlisted physics of the transfer, none further" in text
    assert "Unlisted physics acts on the transfer of the left camera: probability 0.61." in text
    assert "Left: 0.4 % of the probability belongs to sets that were not refitted." in text
    assert "2 (0 to 5.5) µm, not determined" in text
    none = SideModels(side="left", share=0.95, sets=(EffectSet(effects=(), probability=0.961),), inclusion=())
    clean = by_table.model_copy(update={"verdict": "no_mismatch", "models": (none,), "effects": (), "unlisted": ()})
    clean_text = Page(render_report(recordings, fit, validation, clean, provenance_of(recordings))).text
    assert "No effect and nothing unlisted in the left camera: probability 0.961." in clean_text
    ((_, rows),) = odds(by_table)
    assert sum(probability for _, probability in rows) == pytest.approx(1.0)


def test_an_interval_is_shown_where_a_normal_distribution_has_another() -> None:
    """Of mean 10 and standard deviation 1, 95 % lie between 8.04 and 11.96."""
    normal = ParameterValue(value=10.0, std=1.0, unit="um", interval=(8.1, 11.9))
    skewed = ParameterValue(value=10.0, std=1.0, unit="um", interval=(9.2, 12.9))
    assert normal.shown_interval is None
    assert skewed.shown_interval == (9.2, 12.9)
    assert ParameterValue(value=10.0, std=None, unit="um", interval=(8.1, 11.9)).shown_interval == (8.1, 11.9)
