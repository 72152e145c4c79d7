"""The public interface: what it exports, that its functions are documented, and what results show."""

from __future__ import annotations

import ast
import contextlib
import inspect
import json
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

import calibench
import lab.fit.mtf
import lab.fit.psf
import lab.fit.spectral
import lab.recording
from calibench import _LATER, InputError
from lab.calibration.life import History, HistoryPoint
from lab.capture.records import now
from lab.capture.store import Store
from lab.formats.results import (
    Check,
    CurveComparison,
    DiagnosisResult,
    HeldOut,
    NamedEffect,
    ParameterValue,
    PatchComparison,
    ResidualCurve,
    Skipped,
    SpectralFit,
    ValidationResult,
)
from lab.report import dataframes, notebook
from lab.report.dataframes import columns_of
from tests.calibench.my_camera import GAIN_DN_PER_E
from tests.lab.calibration.test_life import calibrated, fitted, limits

FUNCTIONS = sorted(name for name in calibench.__all__ if inspect.isfunction(getattr(calibench, name)))


# --- the names --------------------------------------------------------------------------------------------------------


def test_every_name_is_there_once_and_is_listed() -> None:
    tree = ast.parse(Path(calibench.__file__).read_text())
    (checked,) = (node for node in tree.body if isinstance(node, ast.If))
    for_checkers = {
        (one.module, name.name) for one in checked.body if isinstance(one, ast.ImportFrom) for name in one.names
    }
    assert for_checkers == {(module, name) for module, names in _LATER.items() for name in names}
    at_once = {
        name.name
        for one in tree.body
        if isinstance(one, ast.ImportFrom) and one.module in ("lab.errors", "lab.interface")
        for name in one.names
    }
    assert sorted(at_once | {name for _, name in for_checkers}) == sorted(calibench.__all__) == sorted(dir(calibench))
    assert all(getattr(calibench, name) is not None for name in calibench.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        calibench.nothing  # noqa: B018


def test_the_promised_names_are_those_of_their_old_places() -> None:
    assert calibench.estimate_kernel is lab.fit.psf.estimate_kernel
    assert calibench.edge_mtf is lab.fit.mtf.edge_mtf
    assert calibench.estimate_sensitivity is lab.fit.spectral.estimate_sensitivity
    assert calibench.read is lab.recording.read and calibench.write is lab.recording.write


def test_importing_it_loads_nothing_heavy() -> None:
    code = "import calibench, sys; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = "numpy scipy cv2 numba pydantic bluesky httpx fastapi sqlalchemy pandas plotly"
    assert set(heavy.split()) & set(done.stdout.split()) == set()


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name not in ("read", "write")])
def test_a_function_is_documented(name: str) -> None:
    """A sentence that begins with a verb, every argument by its name, what is returned and raised, an example."""
    function = getattr(calibench, name)
    text = inspect.getdoc(function) or ""
    assert text[0].isupper() and text.split("\n\n")[0].endswith(".")
    if not function.__module__.startswith(("lab.interface", "lab.report.plots", "api.")) or name == "charts_of":
        return  # documented where it stands; not of this interface alone
    assert ">>> import calibench" in text
    for argument in inspect.signature(function).parameters:
        assert argument in text.split(">>>")[0], argument


def test_the_command_line_is_its_main_module() -> None:
    done = subprocess.run([sys.executable, "-m", "calibench", "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "diagnose" in done.stdout


# --- recordings -------------------------------------------------------------------------------------------------------


def test_a_folder_of_raw_files_is_opened_and_shows_its_captures(recordings: calibench.RecordingSet) -> None:
    assert recordings.sides == ("left",) and len(recordings.captures("dark")) == 8
    assert any("photons_per_pixel" in line for line in recordings.warnings)
    text = notebook.text(recordings)
    assert text.startswith("Recording set") and "slanted_edge left 2" in text
    html = recordings._repr_html_()
    assert html is not None and html.count("<img") == 3 and "Warning: " in html
    columns = columns_of(recordings)
    assert columns["kind"].count("flat") == 16 and "dark_radiance" not in columns  # no capture states any


def test_recordings_become_a_recording_set(recordings: calibench.RecordingSet, tmp_path: Path) -> None:
    folder = calibench.write(recordings, tmp_path / "set")
    opened = calibench.open_recordings(folder)
    first = recordings.captures()[0]
    assert (opened.frame(opened.captures()[0]) == recordings.frame(first)).all()


@pytest.mark.parametrize(
    ("given", "stated", "line"),
    [
        ("nothing-here", {}, "no such folder"),
        (".", {"square_mm": 3.0}, "takes none of square_mm; state kind, one of"),
        (".", {"kind": "dot-grid"}, "is empty; give the folder of the recordings"),
        (".", {"kind": "raw-folder", "square_cm": 3.0}, "unexpected keyword argument 'square_cm'"),
        (".", {"kind": "none"}, "none"),
    ],
)
def test_what_cant_be_opened_is_one_line(
    given: str, stated: dict[str, object], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CALIBENCH_DATA", raising=False)
    with pytest.raises(InputError) as refused:
        calibench.open_recordings(given, **stated)  # type: ignore[arg-type]
    assert line in str(refused.value) and "\n" not in str(refused.value)
    assert not any(tmp_path.iterdir())  # reading makes no data folder


# --- results ----------------------------------------------------------------------------------------------------------


def test_a_fit_finds_the_camera_and_shows_it(fit: calibench.FitResult) -> None:
    noise = fit.cameras["left"].noise
    assert noise is not None and noise.conversion_gain_dn_per_e is not None
    std = noise.conversion_gain_dn_per_e_std
    assert std is not None and abs(noise.conversion_gain_dn_per_e - GAIN_DN_PER_E) < 4 * std  # by chance 1 in 16,000
    html, text = fit._repr_html_(), notebook.text(fit)
    assert html is not None and "system gain K" in html and html.count("data:image/svg+xml") == 2
    assert "system gain K" in text and "not determined: psf (left)" in text
    columns = columns_of(fit)
    at = columns["figure"].index("noise conversion_gain_dn_per_e")
    assert columns["value"][at] == noise.conversion_gain_dn_per_e and columns["unit"][at] == "DN/e"
    assert len({len(values) for values in columns.values()}) == 1


def test_a_prompt_shows_the_text(fit: calibench.FitResult) -> None:
    class Printer:
        shown = ""

        def text(self, text: str) -> None:
            self.shown += text

    printer = Printer()
    fit._repr_pretty_(printer, cycle=False)
    assert printer.shown == notebook.text(fit)


def test_charts_are_plotly_figures_and_pictures(fit: calibench.FitResult, tmp_path: Path) -> None:
    charts = list(calibench.charts_of(fit))
    assert [one.what for one in charts] == ["left photon_transfer", "left linearity", "left mtf"]
    for chart in charts:
        figure = chart.to_dict()
        assert "@" not in json.dumps(figure)  # no colour of the page is left
        assert figure["layout"]["title"]["text"] == chart.title
        picture = ElementTree.fromstring(chart.to_svg())
        assert picture.tag.endswith("svg") and len(list(picture.iter())) > 20
        bundle = chart._repr_mimebundle_()
        assert set(bundle) == {"application/vnd.plotly.v1+json", "text/html", "text/plain"}
    assert calibench.plot(fit).what == calibench.plot(fit, "photon_transfer").what == charts[0].what
    assert json.loads(charts[0].write(tmp_path / "chart.json").read_text())["data"]
    assert charts[0].write(tmp_path / "chart.svg").read_text().startswith("<svg")
    with pytest.raises(InputError, match=r"chart\.png: no format of a chart"):
        charts[0].write(tmp_path / "chart.png")
    with pytest.raises(InputError, match="no chart psf; take one of left photon_transfer, left linearity, left mtf"):
        calibench.plot(fit, "psf")
    with pytest.raises(InputError, match="str: no chart at all; it has none"):
        calibench.plot("fit")


@pytest.mark.parametrize("package", ["pandas", "plotly"])
def test_a_package_that_isnt_installed_is_one_line(
    package: str, fit: calibench.FitResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (package, f"{package}.graph_objects"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=rf"{package} isn't installed; pip install 'calibench\[notebook\]'"):
        fit.to_dataframe() if package == "pandas" else calibench.plot(fit).to_plotly()


CURVE = CurveComparison(
    label="edge", channel="G", axis="spatial frequency, cy/px", x=(0.0, 0.25), predicted=(1.0, 0.5),
    measured=(1.0, 0.4), measured_std=(0.01, 0.01),
)  # fmt: skip
PATCHES = tuple(
    PatchComparison(
        patch=name, channel="G", predicted_dn=level, predicted_dn_std=1.0, measured_dn=level + 1.0, measured_dn_std=1.0
    )
    for name, level in (("white", 900.0), ("black", 30.0))
)


def test_a_validation_shows_its_worst_check() -> None:
    check = {"side": "left", "capture": "a", "rms_relative_percent": 1.0}
    result = ValidationResult(
        source="set",
        checks=(
            Check(name="mtf", n=2, chi2=2.0, passed=True, curves=(CURVE,), **check),
            Check(name="colorchecker", n=2, chi2=50.0, passed=False, patches=PATCHES, **check),
        ),
        skipped=(Skipped(step="psf", reason="no kernel"),),
    )
    assert [one.what for one in calibench.charts_of(result)] == ["left colorchecker a", "left mtf a"]
    for one in calibench.charts_of(result):
        ElementTree.fromstring(one.to_svg())
    assert notebook.text(result).startswith("Validation of set: 1 of 2 checks passed")
    assert columns_of(result)["passed"] == [True, False] and "curves" not in columns_of(result)


def test_a_diagnosis_shows_effects_and_the_measurement_that_shows_them() -> None:
    effect = NamedEffect(
        name="defocus", family="isotropic_contrast", law="exact", probability=0.98, sides=("left",), statement="",
        parameters={"defocus_um": ParameterValue(value=29.2, std=0.6, unit="um")}, shown_in=("slanted_edge",),
    )  # fmt: skip
    x = (0.0, 0.1, 0.2, 0.3)
    curve = ResidualCurve(
        side="left", measurement="slanted_edge", label="edges at 5 deg", channel="Y", axis="spatial frequency, cy/px",
        x=x, measured=(1.0, 0.8, 0.5, 0.3), measured_std=(0.01,) * 4, before=(1.0, 0.9, 0.8, 0.7),
        after=(1.0, 0.8, 0.5, 0.31), held_out=True,
    )  # fmt: skip
    held_out = HeldOut(captures=("edge-3",), chi2_before=406.4, chi2_after=25.5, n=34)
    result = DiagnosisResult(source="set", verdict="explained", effects=(effect,), curves=(curve,), held_out=held_out)
    (chart,) = calibench.charts_of(result)
    assert chart.what == "left slanted_edge" and chart.title.startswith("Transfer function of slanted edges, left, Y. ")
    ElementTree.fromstring(chart.to_svg())
    text = notebook.text(result)
    assert "Defocus, left" in text and "29.20 ± 0.60 µm" in text
    assert "Held-out captures: chi2 406.4 before, 25.5 after, of n = 34." in text
    columns = columns_of(result)
    assert columns["parameter"] == ["defocus_um"] and columns["value"] == [29.2] and columns["unit"] == ["um"]


def test_curves_are_tables_too(fit: calibench.FitResult) -> None:
    camera = fit.cameras["left"]
    mtf = columns_of(camera.mtf[0])
    assert mtf["mtf"] == list(camera.mtf[0].mtf) and set(mtf["channel"]) == {camera.mtf[0].channel}
    assert "region" not in mtf  # it is of the edge, not of a frequency
    assert camera.noise is not None and camera.noise.photon_transfer is not None
    points = columns_of(camera.noise.photon_transfer)
    assert len({len(values) for values in points.values()}) == 1
    spectral = SpectralFit(wavelength_nm=(400.0, 410.0), quantum_efficiency={"G": (0.1, 0.2)},
                           quantum_efficiency_std={"G": (0.01, 0.02)})  # fmt: skip
    columns = columns_of(spectral)
    assert list(columns) == ["wavelength_nm", "quantum_efficiency_G", "quantum_efficiency_G_std"]
    assert calibench.plot(spectral).what == "quantum_efficiency"
    for part in (camera.mtf[0], camera.noise.photon_transfer, camera.noise.emva1288["G1"].points, spectral):
        ElementTree.fromstring(calibench.plot(part).to_svg())
    with pytest.raises(InputError, match="CameraFit: is no table"):
        columns_of(camera)


def test_two_calibrations_are_compared(fit: calibench.FitResult, tmp_path: Path) -> None:
    kept = calibench.write_result(fit, tmp_path / "fit.json")
    same = calibench.compare(kept, fit)
    assert not same.changed and "0 of " in notebook.text(same)
    other = calibench.compare(fitted(2.0), fitted(3.0))
    rows = columns_of(other)
    assert other.changed and rows["changed"][rows["name"].index("noise read_noise_e")]
    assert "changed" in (other._repr_html_() or "")


def test_a_history_shows_what_drifted() -> None:
    point = HistoryPoint(calibration_id="c", created=now(), state="candidate", value=2.0, std=0.1, mark=None,
                         reference_id=None, significance_sigma=None, drifted=False)  # fmt: skip
    points = (point, point.model_copy(update={"value": 3.0, "drifted": True, "significance_sigma": 7.1}))
    history = History(camera="L1", figure="noise read_noise_e", place="", title="read noise", unit="e", limit=None,
                      false_alarm_rate=0.01, threshold_sigma=2.6, points=points)  # fmt: skip
    assert "read noise of L1 over 2 calibrations: 1 drifted" in notebook.text(history)
    assert columns_of(history)["value"] == [2.0, 3.0]
    ElementTree.fromstring(calibench.plot(history).to_svg())


def test_a_simulated_frame_shows_itself() -> None:
    frame = calibench.simulate("uniform", exposure_s=0.01, seed=1, progress=False)
    assert "Simulated frame of uniform" in notebook.text(frame) and "<img" in (frame._repr_html_() or "")


def test_results_are_read_in_their_own_type(fit: calibench.FitResult, tmp_path: Path) -> None:
    file = calibench.write_result(fit, tmp_path / "fit.json")
    assert calibench.read_result(file) == fit
    file.write_text('{"format": "other"}')
    with pytest.raises(InputError, match="its format is 'other', none that is read; give one of calibench-fit"):
        calibench.read_result(file)
    file.write_text("[]")
    with pytest.raises(InputError, match="can't be read as a result"):
        calibench.read_result(file)


def test_an_evaluation_states_its_page_or_none() -> None:
    with pytest.raises(InputError, match="goal report needs report"):
        calibench.evaluate("my-camera")
    with pytest.raises(InputError, match="goal fit takes no report"):
        calibench.evaluate("my-camera", "fit", report="page.html")


def test_a_data_sheet_is_one_page(recordings: calibench.RecordingSet, fit: calibench.FitResult, tmp_path: Path) -> None:
    page = calibench.write_report(recordings, tmp_path / "sheet.html", fit)
    assert "EMVA 1288" in page.read_text() and "not diagnosed" in page.read_text()


def test_a_table_of_nothing_has_its_columns() -> None:
    assert columns_of(DiagnosisResult(source="set", verdict="no_mismatch"))["effect"] == []
    assert dataframes.columns_of(ValidationResult(source="set", checks=())) == {}


# --- certificates -----------------------------------------------------------------------------------------------------


def test_a_stored_session_is_certified_and_its_certificate_written(tmp_path: Path) -> None:
    with contextlib.closing(Store(tmp_path / "data")) as store:
        session = store.result(calibrated(store, 2.0)).source
    data = tmp_path / "data"
    with pytest.raises(InputError, match="no certificate states it; certify it first"):
        calibench.write_certificate(session, tmp_path / "page.html", data=data)
    record = calibench.certify(session, limits(), by="Ada Lovelace", data=data)
    assert record.state == "certified" and record.certified_by == "Ada Lovelace"
    certificate = calibench.write_certificate(session, tmp_path / "page.html", data=data)
    page = (tmp_path / "page.html").read_text()
    assert "Ada Lovelace" in page and certificate.sha256 in page and certificate.fit_sha256 in page
