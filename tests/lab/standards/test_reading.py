"""All standards on a camera of known truth: figures, requirements, pages, and the command."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lab.capture_kinds.flat import FlatCapture
from lab.cli import main
from lab.fit import fit_recording_set
from lab.formats.recording_set import RecordingSet, write
from lab.formats.results import FitResult, StandardReading, StandardsResult
from lab.report.standards import file_name, sections, write_standards
from lab.report.standards_pdf import has_matplotlib, write_standards_pdf
from lab.standards.reading import STANDARDS, read_standards
from lab.standards.standard import ClauseFigure, Standard
from tests.lab.standards.conftest import EDGE_SIGMA_PX, EFFICIENCY, FULL_E, GAIN, READ_E
from tests.lab.standards.edges import gaussian_transfer
from tests.peers import missing

Made = tuple[RecordingSet, FitResult, StandardsResult]


def every_standard(kind: type[Standard] = Standard) -> set[type[Standard]]:
    found = set(kind.__subclasses__())
    return found | {one for child in found for one in every_standard(child)}


@pytest.fixture(scope="module")
def even(make_mono_set: Callable[..., RecordingSet]) -> Made:
    recordings = make_mono_set()
    fit = fit_recording_set(recordings)
    return recordings, fit, read_standards(recordings, fit)


def of(made: Made, standard: str) -> StandardReading:
    return next(one for one in made[2].readings if one.standard == standard and one.subject != "whole frame")


def test_every_figure_is_declared_once() -> None:
    """Each docstring holds clause, symbol, unit and formula; symbols of one standard differ."""
    assert {one.name for one in every_standard()} == set(STANDARDS)
    for kind in every_standard():
        declared = kind.declarations().values()
        assert declared, kind
        assert len({one.symbol for one in declared}) == len(declared), kind
        assert all(one.formula and one.clause for one in declared)


def test_docstring_without_a_declaration_is_refused() -> None:
    with pytest.raises(ValueError, match="its docstring declares no figure"):

        @ClauseFigure
        def gain(self: object) -> object:
            """Return the gain."""


def test_units_are_those_declared(even: Made) -> None:
    for reading in even[2].readings:
        for one in reading.figures:
            assert one.estimate is None or one.estimate.unit == one.unit, (reading.standard, one.name)
            assert (one.estimate is None) == bool(one.reason)


def test_truth_is_recovered(even: Made) -> None:
    """Nine figures within 3.5 standard deviations: by chance one is beyond in 0.4 % of all sets, and the seed is
    fixed."""
    general, linear = of(even, "EMVA 1288 R4.0 General"), of(even, "EMVA 1288 R4.0 Linear")
    reference = 0.13 * GAIN * FULL_E  # DN above dark
    noise = np.sqrt(GAIN * reference + (GAIN * READ_E) ** 2 + 1.0 / 12.0)
    truths = {
        (linear.standard, "system_gain"): GAIN,
        (linear.standard, "responsivity"): GAIN * EFFICIENCY,
        (linear.standard, "quantum_efficiency"): 100.0 * EFFICIENCY,
        (linear.standard, "temporal_dark_noise"): READ_E,
        (linear.standard, "prnu"): 1.0,
        (general.standard, "nonlinearity"): 1.0,
        ("ISO 14524:2009", "oecf_slope"): 1.0,
        ("ISO 15739:2023", "temporal_snr"): reference / noise,
        ("ISO 15739:2023", "fixed_pattern_snr"): 100.0,
    }
    for (standard, name), truth in truths.items():
        one = next(figure for figure in of(even, standard).figures if figure.name == name)
        assert one.estimate is not None, one.reason
        assert one.estimate.std is not None
        assert abs(one.estimate.value - truth) < 3.5 * one.estimate.std, (standard, name, one.estimate, truth)
    saturation = next(one for one in general.figures if one.name == "saturation_irradiation").estimate
    assert saturation is not None
    assert abs(saturation.value - FULL_E / EFFICIENCY) < np.sqrt(12.0) * saturation.std


def test_edge_has_its_transfer_function(even: Made) -> None:
    frequency = np.linspace(0.0, 0.5, 2001)
    truth = float(np.interp(-0.5, -gaussian_transfer(EDGE_SIGMA_PX, 5.0, frequency), frequency))
    found = {one.name: one.estimate for one in of(even, "ISO 12233:2023").figures}
    free, letter = found["unbiased_mtf50"], found["sfr50"]
    assert free is not None
    assert letter is not None
    assert abs(free.value - truth) < 3.5 * (free.std or 0.0)
    # the window over 96 px and the bins move it by 0.05 %; the rest is noise
    assert abs(letter.value - truth) < 3.5 * (letter.std or 0.0) + 1e-3 * truth


def test_light_that_falls_off_by_a_quarter_is_told(make_mono_set: Callable[..., RecordingSet], even: Made) -> None:
    """Light 25 % lower in the corners: one line, with value, limit and remedy, and no figure is by the standard.
    Even light has no such line."""
    uneven = make_mono_set(falloff=0.25, seed=2)
    fit = fit_recording_set(uneven)
    reading = of((uneven, fit, read_standards(uneven, fit)), "EMVA 1288 R4.0 Linear")
    (line,) = (one.line for one in reading.deviations if one.quantity.startswith("nonuniformity"))
    assert "3 % at most (6.1): light the bare sensor evenly" in line
    assert "\n" not in line
    assert not any(one.by_the_standard for one in reading.figures)
    assert not any(one.quantity.startswith("nonuniformity") for one in of(even, reading.standard).deviations)


def test_level_whose_light_is_misstated_is_left_out(make_mono_set: Callable[..., RecordingSet]) -> None:
    """One level states ten times its photons: the fit reports it, and no slope rests on it."""
    recordings = make_mono_set(seed=3)
    flats = recordings.captures(FlatCapture, "left")
    wrong = {flat.id for flat in flats if flat.exposure_s == flats[16].exposure_s}
    captures = tuple(
        one.model_copy(update={"photons_per_pixel": 10.0 * one.photons_per_pixel}) if one.id in wrong else one
        for one in recordings.captures()
    )
    misstated = recordings.under(recordings.manifest.model_copy(update={"captures": captures}))
    fit = fit_recording_set(misstated)
    made = misstated, fit, read_standards(misstated, fit)
    found = {one.name: one.estimate for one in of(made, "EMVA 1288 R4.0 General").figures}
    slope = found["nonlinearity"]
    assert slope is not None
    assert abs(slope.value - 1.0) < 3.5 * (slope.std or 0.0)
    ratio = next(one.estimate for one in of(made, "ISO 15739:2023").figures if one.name == "fixed_pattern_snr")
    assert ratio is not None
    assert abs(ratio.value - 100.0) < 3.5 * (ratio.std or 0.0)


def test_bias_of_the_gain_under_brighter_fatter_is_that_of_the_line_and_is_told(
    make_mono_set: Callable[..., RecordingSet],
) -> None:
    """Of a variance K x (1 - a x), the standard's line through the origin over levels x_i has K (1 - a sum x^3 / sum
    x^2). The page states the difference from the slope at zero signal of the joint fit, which is K."""
    loss = 0.1
    recordings = make_mono_set(levels=20, seed=4, variance_loss=loss)
    fit = fit_recording_set(recordings)
    reading = of((recordings, fit, read_standards(recordings, fit)), "EMVA 1288 R4.0 Linear")
    noise = fit.cameras["left"].noise
    assert noise is not None
    shares = np.linspace(0.02, 0.9, 18)
    used = shares[shares <= 0.7 * 0.9]  # the largest variance is that of the level of 0.9
    expected = GAIN * (1.0 - loss * np.sum(used**3) / np.sum(used**2))
    assert 1.0 - expected / GAIN > 0.03
    line = next(one.estimate for one in reading.figures if one.name == "system_gain")
    assert line is not None
    # 6144 pixels, 3 degrees of freedom each: a variance to 1.0 %, the slope of 12 levels, the brighter ones mostly, to
    # 0.4 %
    assert line.value == pytest.approx(expected, rel=3.5 * 0.004)
    at_zero, std = noise.conversion_gain_at_zero_dn_per_e, noise.conversion_gain_at_zero_dn_per_e_std
    assert at_zero is not None
    assert std is not None
    assert abs(at_zero - GAIN) < 3.5 * std
    assert any("brighter-fatter effect bend" in line for line in reading.remarks)


def test_few_levels_and_images_are_told(even: Made) -> None:
    lines = [one.line for one in of(even, "EMVA 1288 R4.0 Linear").deviations]
    assert any(line.startswith("levels of light: 12; the standard asks for 50 at least") for line in lines)
    assert any(line.startswith("images of a spatial stack: 4; the standard asks for 16") for line in lines)


def test_deviation_of_some_figures_leaves_the_others(even: Made) -> None:
    """Two edges of 4:1 at 5 degrees over 64 lines of a monochrome camera meet all that is asked for."""
    edge = of(even, "ISO 12233:2023")
    assert not edge.deviations
    assert all(one.by_the_standard for one in edge.figures if one.estimate is not None)


def test_what_is_missing_is_skipped_with_its_remedy(even: Made) -> None:
    skipped = {one.step: one.reason for one in even[2].skipped}
    assert skipped["ISO 17321-1:2012"] == "a monochrome camera has no colour matrix"
    assert "capture views of a ChArUco board" in skipped["ISO 17850:2015"]


def test_result_is_read_back(even: Made) -> None:
    assert StandardsResult.model_validate_json(even[2].model_dump_json()) == even[2]


def test_pages(even: Made, tmp_path: Path) -> None:
    recordings, fit, result = even
    found = sections(result, recordings, fit)
    overview = write_standards(tmp_path, result, recordings, found).read_text(encoding="utf-8")
    for one in found:
        assert f'href="{file_name(one.standard)}.html"' in overview
    page = (tmp_path / "emva-1288-r4-0-linear.html").read_text(encoding="utf-8")
    assert "levels of light: 12; the standard asks for 50 at least" in page
    titles = {picture.title for one in found for picture in one.pictures}
    wanted = ("Spectrograms of the PRNU", "Histograms of the DSNU", "Profiles of the DSNU", "Photon transfer")
    assert {f"{title}, plane Y" for title in wanted} <= titles


def test_command(
    make_mono_set: Callable[..., RecordingSet], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(make_mono_set(levels=8, repeats=2), tmp_path / "set")
    code = main(["standards", str(tmp_path / "set"), "--json", str(tmp_path / "out.json"), "--report", str(tmp_path)])
    assert code == 0
    told = capsys.readouterr()
    assert "overall system gain" in told.out
    assert "not by the standard" in " ".join(told.out.split())
    assert json.loads((tmp_path / "out.json").read_text())["format"] == "calibench-standards"
    assert (tmp_path / "iso-12233-2023.html").exists()


@pytest.mark.extra
def test_pdf_holds_all_pages(even: Made, tmp_path: Path) -> None:
    if not has_matplotlib():
        missing("matplotlib isn't installed; `make peers` installs it")
    recordings, fit, result = even
    found = sections(result, recordings, fit)
    file = write_standards_pdf(tmp_path / "all.pdf", result, found, "known camera")
    data = file.read_bytes()
    assert data.startswith(b"%PDF")
    # an overview, and a page at least for each standard; three rows of two pictures fill one
    least = 1 + sum(max(1, len(one.pictures) // 6) for one in found)
    assert data.count(b"/Type /Page ") + data.count(b"/Type /Page\n") >= least


def test_pdf_without_matplotlib_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lab.report.standards_pdf.has_matplotlib", lambda: False)
    assert main(["standards", str(tmp_path / "nothing"), "--pdf", str(tmp_path / "all.pdf")]) == 2
    assert "pip install 'calibench[pdf]'" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("option", ["--resolve", "--only=dark", "--set=dark.frames=3"])
def test_session_of_the_standards_takes_no_other_plan(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "--standards", "--out", str(tmp_path), option]) == 2
    assert "--standards: takes its own sequences and no diagnosis" in " ".join(capsys.readouterr().err.split())
