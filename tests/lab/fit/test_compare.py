"""Comparison of two calibrations: no change is reported without one, changes are found, and a motion of the camera is
no change.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.cli import main
from lab.fit.compare import compare, numbers_of
from lab.fit.geometry import geometry_result
from lab.formats.results import (
    CameraFit,
    ComparisonResult,
    DarkCurrentLaws,
    FitResult,
    MakerDeparture,
    MtfCurve,
    NoiseFit,
    PsfKernel,
    SpectralFit,
    StereoFit,
)
from lab.observables.boards.calibration import calibrate_robustly
from tests.lab.fit.projected import SHAPE, poses, seen


@pytest.fixture(scope="module")
def geometries():
    """The same camera calibrated twice, from different poses."""
    return [
        geometry_result(calibrate_robustly(seen(np.random.default_rng(seed), poses(10, seed=seed)), SHAPE))
        for seed in (1, 2)
    ]


def made(seed: int, **noise: float) -> FitResult:
    """A fit of an unchanged rig with errors of its stated size."""
    rng = np.random.default_rng(seed)
    wave = np.arange(400.0, 701.0, 10.0)
    curve = np.exp(-0.5 * ((wave - 550) / 60) ** 2)
    frequency = np.linspace(0, 0.5, 26)
    values = {"conversion_gain_dn_per_e": 0.4, "read_noise_e": 2.3} | noise
    turn = cv2.Rodrigues(np.array([0.01, -0.06, 0.006]) + rng.normal(0, 1e-5, 3))[0]
    camera = CameraFit(
        noise=NoiseFit(
            **{name: value + rng.normal(0, 0.002) for name, value in values.items()},
            **{f"{name}_std": 0.002 for name in values},
        ),
        spectral=SpectralFit(
            wavelength_nm=tuple(wave),
            quantum_efficiency={"G": tuple(curve + rng.normal(0, 0.003, wave.size))},
            quantum_efficiency_std={"G": (0.003,) * wave.size},
        ),
        mtf=(
            MtfCurve(
                capture="edge-1", channel="G", angle_deg=5.0 + rng.normal(), angle_deg_std=0.01,
                frequency_cy_per_px=tuple(frequency), mtf=tuple(np.sinc(frequency) + rng.normal(0, 0.004, 26)),
                mtf_std=(0.004,) * 26,
            ),
        ),
    )  # fmt: skip
    stereo = StereoFit(
        rotation=tuple(map(tuple, turn.tolist())), rotation_std_rad=(1e-5, 1e-5, 1e-5),
        translation_mm=tuple(np.array([-60.0, 0.1, 0.2]) + rng.normal(0, 0.01, 3)), translation_mm_std=(0.01,) * 3,
        baseline_mm=60.0, baseline_mm_std=0.01, rms_px=0.1, pairs=10,
    )  # fmt: skip
    return FitResult(source=f"set {seed}", cameras={"left": camera}, stereo=stereo)


def test_an_unchanged_rig_is_unchanged():
    result = compare(made(1), made(2))
    assert not result.changed
    assert {row.name for row in result.changes} >= {
        "noise read_noise_e", "spectral quantum_efficiency G", "mtf edge-1 G mtf",
        "stereo translation_mm", "stereo rotation_mrad",
    }  # fmt: skip
    # an edge's angle belongs to the set-up, not to the camera
    assert not any("angle" in row.name for row in result.changes)
    assert ComparisonResult.model_validate_json(result.model_dump_json()) == result


def test_chance_of_a_false_alarm_is_at_most_the_stated_one():
    alarms = [compare(made(2 * k), made(2 * k + 1)).changed for k in range(100)]
    assert np.mean(alarms) < 0.01 + 3 * np.sqrt(0.01 * 0.99 / 100)
    assert np.mean([compare(made(2 * k), made(2 * k + 1), 0.5).changed for k in range(60)]) == pytest.approx(
        0.5, abs=0.2
    )


def test_what_changed_is_found_and_nothing_else():
    result = compare(made(1), made(2, read_noise_e=2.33))
    (row,) = [row for row in result.changes if row.changed]
    assert (row.name, row.side) == ("noise read_noise_e", "left")
    assert row.difference == pytest.approx(0.03, abs=0.01)
    assert row.difference_std == pytest.approx(0.002 * np.sqrt(2))


def known(number: int, dark_e_per_s: float = 5.0, temperature_c: float | None = 31.0, **change: float) -> FitResult:
    """A fit with the standard deviations that a quick session has; `change`: factors on gain, sensitivity and MTF50."""
    rng = np.random.default_rng(number)

    def drawn(value: float, relative_std: float) -> float:
        return value * (1.0 + relative_std * rng.standard_normal())

    gain, total, mtf50 = (change.get(name, 1.0) for name in ("gain", "sensitivity", "mtf50"))
    edges = tuple(
        MtfCurve(
            capture=f"edge-{k}", channel="G", angle_deg=5.0, frequency_cy_per_px=(0.0, 0.5), mtf=(1.0, 0.2),
            mtf_std=(0.0, 0.01),
            mtf50_cy_per_px=drawn(0.3 * mtf50, 0.008), mtf50_cy_per_px_std=0.0024,
        )
        for k in range(8)
    )  # fmt: skip
    camera = CameraFit(
        noise=NoiseFit(
            conversion_gain_dn_per_e=drawn(0.4 * gain, 0.0008), conversion_gain_dn_per_e_std=0.00032,
            dark_current_e_per_s=drawn(dark_e_per_s, 0.001), dark_current_e_per_s_std=0.005,
            dark_temperature_c=temperature_c,
        ),
        spectral=SpectralFit(
            wavelength_nm=(400.0, 700.0), quantum_efficiency={"G": (0.5, 0.5)},
            quantum_efficiency_std={"G": (0.01, 0.01)},
            integrated_efficiency_nm={"G": drawn(64.0 * total, 0.0025)}, integrated_efficiency_nm_std={"G": 0.16},
        ),
        mtf=edges,
    )  # fmt: skip
    return FitResult(source=f"known {number}", cameras={"left": camera})


@pytest.mark.parametrize(
    ("later", "title"),
    [
        (known(2, dark_e_per_s=6.5), "dark current at 31.0 °C"),
        (known(2, gain=1.02), "system gain K"),
        (known(2, sensitivity=0.97), "quantum efficiency, integrated over wavelength, G"),
        (known(2, mtf50=0.95), "MTF50, edge-"),
    ],
    ids=["dark current +30 %", "gain +2 %", "sensitivity -3 %", "MTF50 -5 %"],
)
def test_a_real_change_is_told_by_its_plain_name(later: FitResult, title: str):
    found = compare(known(1), later)
    changed = [row.title for row in found.changes if row.changed]
    assert changed and all(name.startswith(title) for name in changed)


@pytest.mark.parametrize("warmer_c", [-6.0, -0.5, 0.1, 0.5, 6.0])
def test_a_warmer_sensor_is_no_drift(warmer_c: float):
    """Silicon's dark current doubles in 7.2 +- 1.4 degrees; this one in 6.5."""
    found = compare(known(1), known(2, dark_e_per_s=5.0 * 2.0 ** (warmer_c / 6.5), temperature_c=31.0 + warmer_c))
    (row,) = [row for row in found.changes if row.name == "noise dark_current_e_per_s"]
    assert not found.changed and row.temperature_c == 31.0 and row.unit == "e/s"
    # 0.1 degrees of each thermometer, and the law's 19 % of the doublings
    expected = 5.0 * np.log(2.0) * np.hypot(np.sqrt(2.0) * 0.1 / 7.2, warmer_c * 1.4 / 7.2**2)
    assert row.difference_std == pytest.approx(expected, rel=0.2)


def test_a_fitted_doubling_temperature_converts_in_place_of_silicons():
    laws = DarkCurrentLaws(
        temperature_c=(31.0,), dark_current_e_per_s=(5.0,), dark_current_e_per_s_std=(0.005,),
        doubling_temperature_c=5.0, doubling_temperature_c_std=0.05,
    )  # fmt: skip
    one = known(1)
    noise = one.cameras["left"].noise.model_copy(update={"dark_current_temperature": laws})
    one = FitResult(source="a", cameras={"left": CameraFit(noise=noise)})
    row = compare(one, known(2, dark_e_per_s=10.0, temperature_c=36.0)).changes[1]
    assert row.name == "noise dark_current_e_per_s" and row.b == pytest.approx(5.0, rel=0.01)


@pytest.mark.parametrize("factor", [0.4, 2.5])
def test_a_dark_current_of_unknown_temperature_is_no_drift_and_that_is_said(factor: float):
    found = compare(known(1, temperature_c=None), known(2, dark_e_per_s=5.0 * factor))
    assert not found.changed
    assert ["A without a stated sensor temperature" in item.reason for item in found.skipped] == [True]
    assert "at an unknown temperature" in found.changes[1].title


def test_bands_that_each_fit_chooses_are_not_compared():
    """Two fits of one camera name other bands in which it departs from its maker's curve."""
    fits = []
    for bands in ([(400.0, 450.0, -0.02)], [(400.0, 500.0, -0.04), (600.0, 700.0, -0.45)]):
        departures = tuple(
            MakerDeparture(
                channel="R", from_nm=low, to_nm=high, difference=value, difference_std=3e-4, difference_percent=-5.0,
                significance_sigma=9.0,
            )
            for low, high, value in bands
        )  # fmt: skip
        spectral = SpectralFit(
            wavelength_nm=(), quantum_efficiency={}, quantum_efficiency_std={}, maker_departures=departures
        )
        fits.append(FitResult(source="x", cameras={"left": CameraFit(spectral=spectral)}))
    assert compare(*fits).changes == ()


def test_each_number_has_a_name_of_its_own():
    """Kernels of parts of the pattern are told apart by their numbers."""
    kernel = PsfKernel(capture="b", channel="G", sample_pitch_px=1.0, psf=((1.0,),), psf_std=((0.1,),))
    names = [name for name, _ in numbers_of(CameraFit(psf=(kernel,), psf_field=(kernel, kernel)), "")]
    assert names == ["psf b G psf", "psf_field b G part 1 psf", "psf_field b G part 2 psf"]


def test_every_row_has_a_plain_name():
    found = compare(made(1), made(2))
    assert all(row.title for row in found.changes)
    assert {row.title: row.unit for row in found.changes}["stereo rotation about x"] == "mrad"


def test_one_point_of_a_curve_is_found_with_its_place():
    other = made(2)
    curve = list(other.cameras["left"].spectral.quantum_efficiency["G"])
    curve[20] += 0.04
    spectral = other.cameras["left"].spectral.model_copy(update={"quantum_efficiency": {"G": tuple(curve)}})
    camera = other.cameras["left"].model_copy(update={"spectral": spectral})
    result = compare(made(1), other.model_copy(update={"cameras": {"left": camera}}))
    (row,) = [row for row in result.changes if row.changed]
    assert row.name == "spectral quantum_efficiency G"
    assert row.where == "wavelength 600 nm"
    assert row.n == 31


def test_rounding_is_no_change():
    """A normalised curve is 1 at frequency 0 up to rounding, and states an uncertainty of that size."""
    one, two = (
        FitResult(
            source="m",
            cameras={
                "left": CameraFit(
                    mtf=(
                        MtfCurve(
                            capture="edge-1", channel="G", angle_deg=5.0, frequency_cy_per_px=(0.0, 0.1),
                            mtf=(1.0 - off, 0.9), mtf_std=(1e-17, 0.01),
                        ),
                    )
                )
            },
        )
        for off in (0.0, 5e-16)
    )  # fmt: skip
    result = compare(one, two)
    assert not result.changed
    assert [row.where for row in result.changes] == ["frequency 0.1 cy/px"]


def test_a_curve_on_another_axis_is_compared_where_both_reach():
    other = made(2)
    spectral = SpectralFit(
        wavelength_nm=(500.0, 550.0, 600.0),
        quantum_efficiency={"G": (0.706, 1.0, 0.706)}, quantum_efficiency_std={"G": (0.05, 0.05, 0.05)},
    )  # fmt: skip
    camera = other.cameras["left"].model_copy(update={"spectral": spectral})
    result = compare(made(1), other.model_copy(update={"cameras": {"left": camera}}))
    row = next(row for row in result.changes if "quantum" in row.name)
    assert row.n == 11


def test_what_only_one_has_is_said():
    bare = FitResult(source="bare", cameras={"left": CameraFit()})
    result = compare(made(1), bare)
    reasons = [item.reason for item in result.skipped]
    assert any("only A has noise" in reason for reason in reasons)
    assert any(item.step == "stereo" for item in result.skipped)
    assert (
        compare(bare, FitResult(source="x", cameras={"right": CameraFit()})).skipped[0].reason == "only A has this side"
    )


def with_geometry(geometry) -> FitResult:
    return FitResult(source="g", cameras={"left": CameraFit(geometry=geometry)})


def test_two_calibrations_of_one_camera_project_alike(geometries):
    result = compare(*(with_geometry(geometry) for geometry in geometries))
    (projection,) = result.projection
    assert not result.changed
    assert projection.significance_sigma < 3.3
    assert 0.3 * projection.expected_px < projection.difference_px < 2 * projection.expected_px
    # as they stand, the two differ by more: the rest is a motion that their corners can't see
    assert projection.difference_px < projection.as_stated_px


def test_a_principal_point_that_moved_is_mostly_a_motion(geometries):
    """8 px of the centre: the parameters differ by 8 px, the projections by what a turn can't undo; both are found."""
    matrix = [list(row) for row in geometries[0].camera_matrix]
    matrix[0][2] += 8.0
    moved = geometries[0].model_copy(update={"camera_matrix": tuple(map(tuple, matrix))})
    result = compare(with_geometry(geometries[0]), with_geometry(moved))
    (projection,) = result.projection
    assert projection.as_stated_px == pytest.approx(8.0)
    assert projection.difference_px < 0.1 * projection.as_stated_px
    assert projection.implied_turn_mrad[1] == pytest.approx(-8e3 / 1400, rel=0.2)
    assert projection.changed
    assert [row.where for row in result.changes if row.changed] == ["cx"]


def test_a_longer_lens_is_a_change_although_each_number_is_uncertain(geometries):
    """Distances are known, so a focal length is no motion."""
    matrix = [list(row) for row in geometries[0].camera_matrix]
    matrix[0][0] *= 1.01
    matrix[1][1] *= 1.01
    longer = geometries[0].model_copy(update={"camera_matrix": tuple(map(tuple, matrix))})
    (projection,) = compare(with_geometry(geometries[0]), with_geometry(longer)).projection
    assert projection.changed
    assert projection.significance_sigma > 6


def test_geometry_without_covariance_is_skipped_with_its_reason(geometries):
    old = geometries[0].model_copy(update={"covariance": None})
    result = compare(with_geometry(old), with_geometry(geometries[1]))
    assert result.projection == ()
    assert "A states no covariance" in result.skipped[-1].reason


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    files = []
    for name, fit in (("a", made(1)), ("b", made(2)), ("c", made(3, read_noise_e=2.5))):
        files.append(tmp_path / f"{name}.json")
        files[-1].write_text(fit.model_dump_json())
    assert main(["compare", str(files[0]), str(files[1]), "--check"]) == 0
    assert "none of" in capsys.readouterr().out
    assert main(["compare", str(files[0]), str(files[2]), "--json", str(tmp_path / "out.json")]) == 0
    said = capsys.readouterr().out
    assert "noise read_noise_e" in said and "yes" in said
    assert ComparisonResult.model_validate_json((tmp_path / "out.json").read_text()).changed
    assert main(["compare", str(files[0]), str(files[2]), "--check"]) == 4
    capsys.readouterr()
    assert main(["compare", str(files[0]), str(files[2]), "--json", "-", "--report", str(tmp_path / "page")]) == 0
    said = capsys.readouterr()
    assert ComparisonResult.model_validate_json(said.out).changed  # the page's place goes to stderr
    assert "compare.html" in said.err and (tmp_path / "page" / "compare.html").stat().st_size > 10_000
    assert main(["compare", str(files[0]), str(tmp_path / "out.json")]) == 2
    assert main(["compare", str(files[0]), str(tmp_path / "nothing")]) == 2


@pytest.mark.parametrize(
    ("rule", "code"),
    [
        ("noise read_noise_e", 4),
        ("*", 4),
        ("left:noise *", 4),
        ("noise read_noise_e>0.05", 4),
        ("noise read_noise_e > 0.2", 0),
        ("noise read_noise_e>3%", 4),
        ("noise read_noise_e>6%", 0),
        ("noise conversion_gain_dn_per_e", 0),
        ("noise read_nose_e", 2),
        ("right:noise read_noise_e", 2),
        ("noise read_noise_e>much", 2),
        ("noise read_noise_e>-1", 2),
        (">1", 2),
    ],
)
def test_a_check_fails_on_the_named_figures_only(
    tmp_path: Path, rule: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """A read noise of 2.3 e became 2.4 e: by 0.1 or 4.3 %, 35 sigma. A rule that concerns no figure is an error, not a
    pass.
    """
    for name, fit in (("a", made(1)), ("b", made(2, read_noise_e=2.4))):
        (tmp_path / name).write_text(fit.model_dump_json())
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--fail-on", rule]) == code
    error = capsys.readouterr().err
    assert ("left noise read_noise_e changed" in error) == (code == 4) and ("--fail-on" in error) == (code != 0)
