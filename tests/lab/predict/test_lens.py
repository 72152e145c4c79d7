"""`calibench lens`: the result's form, the page, and one line for what can't be used."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from lab import cli
from lab.errors import InputError
from lab.predict import lens
from lab.predict.lens import LensResult, TracedPrescription, parse_glasses, trace_prescription, with_glasses
from lab.report.lens import write_lens_report
from sim.optics.zmx import parse_zmx

LENS = Path(__file__).parents[2] / "sim/optics/lenses/doublet.zmx"
TILTED = LENS.with_name("tilted.zmx")


@pytest.fixture(scope="module")
def traced() -> TracedPrescription:
    return trace_prescription(LENS)


def test_the_result_has_the_stated_form(traced: TracedPrescription) -> None:
    document = json.loads(traced.result.model_dump_json())
    assert document["format"] == "calibench-lens" and document["version"] == 1
    assert document["focal_length_mm"] == pytest.approx(9.7658, abs=1e-3)
    assert document["f_number"] == pytest.approx(document["focal_length_mm"] / 1.2)
    assert document["entrance_pupil_mm"] == 1.2 and document["maximum_field_deg"] == pytest.approx(18.0)
    fields = document["fields"]
    assert len(fields) == 21
    centre, corner = fields[0], fields[-1]
    assert centre["angle_deg"] == 0.0 and centre["height_mm"] == pytest.approx(0.0, abs=1e-12)
    assert centre["relative_illumination"] == 1.0 and centre["distortion_percent"] == 0.0
    assert corner["angle_deg"] == pytest.approx(18.0) and 0 < corner["relative_illumination"] < 1.1
    assert [entry["wavelength_nm"] for entry in corner["psf"]] == [400.0 + 10 * k for k in range(33)]
    assert all(0 < entry["encircled_share"] < 1 and len(entry["centroid_um"]) == 2 for entry in corner["psf"])
    curves = {entry["wavelength_nm"]: entry for entry in centre["mtf"]}
    assert 550.0 in curves and curves[550.0]["frequency_lp_per_mm"] == [30.0, 60.0, 100.0]
    assert curves[550.0]["sagittal"] == pytest.approx(curves[550.0]["tangential"], abs=1e-6)
    assert 1 > curves[550.0]["sagittal"][0] > curves[550.0]["sagittal"][2] > 0
    assert LensResult.model_validate(document) == traced.result


def test_the_page_holds_every_picture_and_nothing_from_elsewhere(traced: TracedPrescription, tmp_path: Path) -> None:
    page = write_lens_report(tmp_path / "new", traced).read_text(encoding="utf-8")
    for heading in (
        "Layout",
        "Relative illumination",
        "Distortion",
        "Lateral colour",
        "MTF against field",
        "Point spread",
    ):
        assert heading in page
    assert page.count('class="chart"') == 6 and page.count('<img src="data:image/png;base64,') == 15
    markup = page[: page.rindex("<h2>Fields</h2>")]  # the plotting library behind it holds addresses in its own text
    assert "http" not in markup
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["lens.html"]


@pytest.mark.slow
def test_the_page_of_a_tilted_lens(tmp_path: Path) -> None:
    traced = trace_prescription(TILTED)
    assert traced.result.fields[0].height_mm != 0.0 and len(traced.result.fields) == 21
    assert write_lens_report(tmp_path, traced).stat().st_size > 10_000


def test_the_command_prints_and_writes(
    traced: TracedPrescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(
        lens, "trace_prescription", lambda file, **options: asked.append({"file": file} | options) or traced
    )
    out = tmp_path / "lens.json"
    options = ["--field-deg", "9", "--focus", "best", "--glass", "A=N-BK7", "--report", str(tmp_path / "page")]
    assert cli.main(["lens", str(LENS), "--json", str(out), *options]) == 0
    (given,) = asked
    assert (given["file"], given["maximum_field_deg"], given["focus"]) == (LENS, 9.0, "best")
    assert given["glasses"] == parse_glasses(["A=N-BK7"])
    shown = capsys.readouterr().out
    assert "f = 9.7658 mm" in shown and "lens.html" in shown
    assert LensResult.model_validate_json(out.read_text()) == traced.result


@pytest.mark.parametrize(
    ("change", "arguments", "said"),
    [
        (("___BLANK 1 0 1.6355 23.9 0", "UNOBTAINIUM 0 0"), (), "surface 4: the glass UNOBTAINIUM"),
        (("TYPE EVENASPH", "TYPE GRINSUR5"), (), "GRINSUR5"),
        (("DISZ 2.4", "DISZ two"), (), "two"),
        (("", ""), ("--focus", "near"), "--focus near"),
        (("", ""), ("--field-deg", "120"), "120"),
        (("", ""), ("--glass", "X=1.5"), "X"),
        (("", ""), ("--glass", "X"), "NAME=OTHER"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_exit_2(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: tuple[str, str],
    arguments: tuple[str, ...],
    said: str,
) -> None:
    file = tmp_path / "lens.zmx"
    text = LENS.read_text()
    file.write_text(text.replace(*change, 1) if change[0] else text)
    assert cli.main(["lens", str(file), *arguments]) == 2
    errors = capsys.readouterr().err.strip()
    assert said in errors and len(errors.splitlines()) == 1


def test_a_replaced_glass_is_a_warning() -> None:
    text = LENS.read_text().replace("___BLANK 1 0 1.6355 23.9 0", "MOULDED 0 0")
    replaced = with_glasses(parse_zmx(text), parse_glasses(["MOULDED=1.6355,23.9"]))
    glass = replaced.surfaces[3].glass
    assert glass is not None and glass.model and (glass.index_d, glass.abbe_d) == (1.6355, 23.9)
    assert any("MOULDED" in line for line in replaced.warnings)
    other = with_glasses(parse_zmx(text), parse_glasses(["moulded=N-SF2"])).surfaces[3].glass
    assert other is not None and other.name == "N-SF2" and not other.model
    with pytest.raises(InputError, match="no surface"):
        with_glasses(parse_zmx(text), parse_glasses(["NONE=N-SF2"]))
    for bad in ("A=0.5,20", "A=1.5,-3", "A=x,y", "=N-BK7"):
        with pytest.raises(InputError):
            parse_glasses([bad])


def test_distortion_is_against_the_axis_own_scale(traced: TracedPrescription) -> None:
    """Near the axis distortion falls with the square of the height, wherever the image plane lies."""
    one, two = traced.result.fields[1], traced.result.fields[2]
    ratio = two.distortion_percent / one.distortion_percent
    assert ratio == pytest.approx(
        (math.tan(math.radians(two.angle_deg)) / math.tan(math.radians(one.angle_deg))) ** 2, rel=0.02
    )
