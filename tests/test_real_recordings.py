"""The benchmark of real recordings: its small sets every day, its pages, and what it calls worse."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.real.__main__ import JSON, PAGE, main
from benchmarks.real.compare import worse
from benchmarks.real.extrapolation import extrapolate, split
from benchmarks.real.judge import JudgedFigure, JudgedMeasurement, JudgedName, SetResult, found_at, judged
from benchmarks.real.kept import kept_in
from benchmarks.real.page import EXAMPLES, MARK, example_of, page_of
from benchmarks.real.sets import declared_sets, sets_in
from benchmarks.real.take_through import Cost, take_through
from lab.capture_kinds.flat import FlatCapture
from lab.foreign_recordings import read_foreign
from lab.formats.results import CameraFit, DiagnosisResult, FitResult, NamedEffect, NoiseFit, SpectralFit
from lab.formats.results.diagnosis import ParameterValue

DATA = Path(__file__).parents[2] / "shared" / "data"
DECLARED = declared_sets()


@pytest.mark.parametrize("name", [name for name, one in DECLARED.items() if one.is_small])
def test_a_small_set_is_no_worse_than_what_is_kept(name: str, tmp_path: Path) -> None:
    one = DECLARED[name]
    recordings = DATA / (one.path or name)
    if not recordings.exists():
        pytest.skip(f"{recordings.name} isn't beside the checkout")
    before = kept_in(JSON).sets[name]
    fit, diagnosis = take_through(one, recordings, tmp_path)
    now = judged(one, Cost(state="", cpu_s=before.cpu_s, memory_mb=before.memory_mb), fit, diagnosis)
    assert not worse(before, now)
    assert not now.contradicted


def test_the_pages_say_what_is_kept() -> None:
    """Else: `make real`."""
    kept = kept_in(JSON)
    assert [name for name in DECLARED if name in kept.sets] == list(kept.sets)
    assert PAGE.read_text(encoding="utf-8") == page_of(kept, DECLARED)
    marked = set()
    for file in EXAMPLES.glob("*.md"):
        text = file.read_text(encoding="utf-8")
        assert text == example_of(text, kept), file.name
        marked |= set(MARK.findall(text))
    assert marked == {"emva1288_ccd", "flea3_darks_2", "flea3_white", "bench", "puzzle"}


def _figure(pull: float | None) -> JudgedFigure:
    value = None if pull is None else 1.0 + 0.01 * pull
    return JudgedFigure(name="gain", unit="1", value=value, std=0.01, independent=1.0, independent_std=0.0, pull=pull)


def _result(
    pull: float | None = 0.5, names: tuple[str, ...] = (), after: float = 50.0, cpu_s: float = 20.0
) -> SetResult:
    measured = JudgedMeasurement(side="left", measurement="dark", n=50, before=500.0, after=after, is_told=False)
    return SetResult(
        state="", cpu_s=cpu_s, memory_mb=400.0, verdict="explained", figures=(_figure(pull),), measurements=(measured,),
        names=tuple(
            JudgedName(name=n, sides=("left",), probability=1.0, law="exact", is_right="contradicted",
            why="") for n in names
        ),
        before=500.0, after=after, n=50,
    )  # fmt: skip


def test_what_got_worse_is_told() -> None:
    good = _result()
    assert worse(good, good) == []
    assert worse(good, _result(pull=-1.9)) == []
    assert worse(good, _result(pull=-2.5)) == ["gain: pull -2.5, was 0.5"]
    assert worse(_result(pull=2.5), _result(pull=2.6)) == []
    assert worse(_result(pull=2.5), _result(pull=3.0)) == ["gain: pull +3.0, was 2.5"]
    assert worse(good, _result(pull=None)) == ["gain: not determined any more"]
    assert worse(good, _result(names=("coma",))) == ["a name that an independent look contradicts: coma"]
    assert worse(_result(names=("coma",)), _result(names=("coma",))) == []
    assert worse(good, _result(after=60.0)) == [
        "held-out chi2 over n: 1.2, was 1",
        "worst held-out chi2 over n (dark): 1.2, was 1",
    ]
    assert worse(_result(after=1.0), _result(after=52.0)) == []  # a covariance that was too wide
    assert worse(_result(after=1.0), _result(after=60.0)) == [
        "held-out chi2 over n: 1.2, was 0.02",
        "worst held-out chi2 over n (dark): 1.2, was 0.02",
    ]
    # 1.5 and more than the 99.9 % quantile of chi2 of 50 numbers, 86.7, of which nothing tells
    assert "a remainder that isn't told: left dark" in worse(good, _result(after=90.0))
    assert worse(good, _result(cpu_s=40.0)) == ["CPU time: 40 s, was 20 s"]
    assert worse(good, good.model_copy(update={"memory_mb": 600.0})) == ["memory: 600 MB, was 400 MB"]
    assert worse(good, good.model_copy(update={"failed": "no such folder"})) == ["fails: no such folder"]


def test_places_of_figures() -> None:
    noise = NoiseFit(conversion_gain_dn_per_e=0.4, conversion_gain_dn_per_e_std=0.01, read_noise_e=3.0)
    spectral = SpectralFit(
        wavelength_nm=(500.0, 510.0), quantum_efficiency={"G": (0.4, 0.5)}, quantum_efficiency_std={"G": (0.01, 0.03)}
    )
    fit = FitResult(source="", cameras={"left": CameraFit(noise=noise, spectral=spectral)})
    shift = NamedEffect(
        name="defocus", family="f", law="exact", probability=1.0, sides=("left",), statement="",
        parameters={"defocus_um": ParameterValue(value=20.0, std=0.5, unit="um")},
    )  # fmt: skip
    diagnosis = DiagnosisResult(source="", verdict="explained", effects=(shift,))
    for at, wanted in (
        ("noise.conversion_gain_dn_per_e", (0.4, 0.01)),
        ("noise.read_noise_e", (3.0, None)),
        ("noise.black_level_dn", (None, None)),
        ("right.noise.read_noise_e", (None, None)),
        ("spectral.quantum_efficiency.G.@505", (0.45, 0.02)),
        ("spectral.quantum_efficiency.G.1", (0.5, 0.03)),
        ("stereo.baseline_mm", (None, None)),
        ("effect.defocus.defocus_um", (20.0, 0.5)),
        ("effect.coma.w131_x_um", (None, None)),
    ):
        assert found_at(at, fit, diagnosis) == pytest.approx(wanted), at


SWEEP = """kind,wavelength_nm,bandwidth_nm,exposure_s,mean_dn,mean_std_dn,photodiode_a,photodiode_a_per_w
dark,,,0.1,64,0.02,,
"""
INDEPENDENT = """
path = "means.csv"
importer = "spectral-table"
figures = [{ name = "green at 500 nm", at = "spectral.relative_sensitivity.Y.@500", value = VALUE, std = 0.01 }]
"""


def test_a_named_folder_is_taken_through_once_and_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A flat sensor of which an independent look says so, and then something else: the second fails without running
    again."""
    rows = [
        f"narrowband,{nm},10,0.1,{64 + 1000 * nm / 550:.3f},1,{1e-6 * 0.0005 * nm:.6g},{0.0005 * nm:g}"
        for nm in range(400, 701, 20)
    ]
    one = tmp_path / "sets" / "mine"
    one.mkdir(parents=True)
    (one / "means.csv").write_text(SWEEP + "\n".join(rows) + "\n", encoding="utf-8")
    (one / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n', encoding="utf-8")
    (one / "independent.toml").write_text(INDEPENDENT.replace("VALUE", "1.0"), encoding="utf-8")
    out = tmp_path / "out" / "sets"
    main(data=tmp_path, out=tmp_path / "out", more=tmp_path / "sets")
    assert "mine: fitted" in capsys.readouterr().out
    kept = kept_in(out / "kept.json").sets["mine"]
    assert kept.cpu_s > 0.1
    assert kept.memory_mb > 50.0
    assert kept.figures[0].pull is not None
    assert abs(kept.figures[0].pull) < 2.0
    assert "green at 500 nm" in (out / "page.md").read_text(encoding="utf-8")

    (one / "independent.toml").write_text(INDEPENDENT.replace("VALUE", "0.5"), encoding="utf-8")
    before = (out / "mine" / "cost.json").stat().st_mtime_ns
    with pytest.raises(SystemExit, match="green at 500 nm: pull"):
        main(data=tmp_path, out=tmp_path / "out", more=tmp_path / "sets")
    assert (out / "mine" / "cost.json").stat().st_mtime_ns == before
    assert kept_in(out / "kept.json").sets["mine"] == kept  # nothing is written


def test_sets_of_a_folder(tmp_path: Path) -> None:
    for name, file in (("a", "manifest.json"), ("b", "index.csv"), ("c", "EMVA1288_Data.txt"), ("d", "readme.txt")):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).write_text("", encoding="utf-8")
    assert {name: one.importer for name, one in sets_in(tmp_path).items()} == {
        "a": "",
        "b": "raw-folder",
        "c": "emva1288",
    }


def test_the_highest_levels_of_a_photon_transfer_set_are_predicted_from_the_lowest(tmp_path: Path) -> None:
    """EMVA 1288's simulated camera, whose response bends by 2 % at saturation: lowest 60 % of the levels."""
    source = DATA / "emva1288_simulated_crop"
    if not source.is_dir():
        pytest.skip(f"{source.name} isn't beside the checkout")
    recordings = read_foreign("emva1288", source)
    fitted, rest, low, high = split(recordings)
    assert (low, high) == (11, 7)
    brightest = max(c.photons_per_pixel for c in fitted.captures(FlatCapture, "left"))
    assert brightest < min(c.photons_per_pixel for c in rest.captures(FlatCapture, "left"))
    found = extrapolate("simulated", recordings, tmp_path)
    scores = {q.quantity: q for q in found.quantities}
    # a line through the fitted levels misses the highest by 1.5 %, and their variance by 9 %
    assert scores["photon_transfer"].largest_of_95_percent < 0.5
    assert scores["photon_transfer"].within_95_percent_interval == scores["noise"].within_95_percent_interval == 1.0
