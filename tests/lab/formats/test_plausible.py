"""Figures outside the range of working cameras are reported in one line, and the camera file says what the fit said."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from lab.diagnose import diagnose
from lab.fit import fit_recording_set
from lab.formats.camera_file import fitted_camera, read_camera, write_camera
from lab.formats.plausible_range import OUTSIDE_SIGMA, STATED, Plausible
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.formats.results import CameraFit, FitResult, GeometryFit, MtfCurve, NoiseFit, SpectralFit, StereoFit
from lab.formats.results.plausible import FIGURES, highest_mtf50_cy_per_px, implausible_figures
from tests.lab.mono_session import MonoSession

SHEET = DataSheet(rows=480, cols=640, cfa="MONO", bit_depth=12, black_level_dn=100.0)
PITCH_UM, FOCAL_MM = 3.45, 8.0


def warnings_of(sheet: DataSheet = SHEET, stereo: StereoFit | None = None, **parts: object) -> tuple[str, ...]:
    fit = FitResult(source="x", cameras={"left": CameraFit.model_validate(parts)}, stereo=stereo)
    return implausible_figures(fit, {"left": sheet})


def geometry(fx: float = 2319.0, fy: float = 2319.0, cx: float = 320.0, cy: float = 240.0) -> GeometryFit:
    """2319 px of 3.45 um: 8 mm."""
    std = ((5.0, 0.0, 5.0), (0.0, 5.0, 5.0), (0.0, 0.0, 0.0))
    matrix = ((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0))
    return GeometryFit(camera_matrix=matrix, camera_matrix_std=std, distortion=(0.0,), rms_px=0.1)


def edge(mtf50: float, std: float = 0.005, **keys: object) -> MtfCurve:
    told = {"capture": "e", "channel": "Y", "angle_deg": 5.0, "frequency_cy_per_px": (), "mtf": (), "mtf_std": ()}
    return MtfCurve.model_validate(told | {"mtf50_cy_per_px": mtf50, "mtf50_cy_per_px_std": std} | keys)


def test_every_range_has_a_cause_and_a_remedy() -> None:
    for name, limits in (FIGURES | STATED).items():
        for limit, cause in ((limits.lower, limits.below), (limits.upper, limits.above)):
            assert limit is None or len(cause) > 8, name
        assert limits.lower is None or limits.upper is None or limits.lower < limits.upper


def test_a_figure_is_outside_by_more_than_its_uncertainty() -> None:
    limits = Plausible(0.0, 1.0, "cause below", "cause above")
    inside, beyond = 1.0 + 0.99 * OUTSIDE_SIGMA * 0.1, 1.0 + 1.01 * OUTSIDE_SIGMA * 0.1
    assert limits.sentence("share", inside, 0.1) is None
    assert limits.sentence("share", 0.0 - inside + 1.0, 0.1) is None
    assert limits.sentence("share", beyond, 0.1) == "share 1.30 ± 0.10 is above the limit of 1: cause above"
    assert limits.sentence("share", -0.1, None) == "share -0.1 is below the limit of 0: cause below"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("conversion_gain_dn_per_e", 1e-6),
        ("read_noise_e", 1e4),
        ("full_well_e", 5.0),
        ("black_level_dn", -30.0),
        ("black_level_dn", 2200.0),
        ("dark_current_e_per_s", -8.0),
        ("dsnu_e", 1e6),
        ("prnu_percent", 40.0),
        ("linearity_error_percent", 22.0),
        ("quantum_efficiency", 1.2),
        ("quantum_efficiency", 0.004),
    ],
)
def test_each_figure_of_the_noise_is_judged(name: str, value: float) -> None:
    (line,) = warnings_of(noise=NoiseFit.model_validate({name: value, f"{name}_std": 0.01 * abs(value)}))
    assert line.startswith("left: ") and "the limit of" in line and "\n" not in line
    # within three standard deviations of the range, nothing is said
    assert not warnings_of(noise=NoiseFit.model_validate({name: value, f"{name}_std": 2.0 * abs(value) + 1e4}))


def test_a_usual_camera_has_no_warning() -> None:
    noise = NoiseFit(
        conversion_gain_dn_per_e=0.38, read_noise_e=2.4, full_well_e=10500.0, black_level_dn=100.0,
        dark_current_e_per_s=-2.0, dark_current_e_per_s_std=1.5, dsnu_e=0.8, prnu_percent=0.6,
        linearity_error_percent=0.2, quantum_efficiency=0.62, quantum_efficiency_std=0.01,
    )  # fmt: skip
    sheet = SHEET.model_copy(update={"pixel_pitch_um": PITCH_UM, "focal_length_mm": FOCAL_MM, "f_number": 4.0})
    assert not warnings_of(sheet, noise=noise, geometry=geometry(), mtf=(edge(0.35),))


def test_curves_are_judged_at_their_peak() -> None:
    """One channel that a filter keeps dark is no warning, three are; above 1 each is."""

    def curves(**peaks: float) -> SpectralFit:
        return SpectralFit(
            wavelength_nm=(500.0, 600.0),
            quantum_efficiency={channel: (0.5 * peak, peak) for channel, peak in peaks.items()},
            quantum_efficiency_std=dict.fromkeys(peaks, (0.0001, 0.0001)),
        )

    assert not warnings_of(spectral=curves(R=0.4, G=0.3, B=0.004))
    assert len(warnings_of(spectral=curves(R=0.004, G=0.003, B=0.001))) == 3
    (line,) = warnings_of(spectral=curves(R=1.4, G=0.3, B=0.2))
    assert "peak quantum efficiency R at 600 nm 1.40000 ± 0.00010 is above the limit of 1" in line


def test_the_highest_mtf50_is_that_of_aperture_and_diffraction() -> None:
    """Aperture alone: sinc(f) = 1/2 at 0.603355 cy/px. With diffraction in 380 nm: sinc(f) times (2 / pi) (acos s - s
    sqrt(1 - s^2)) is 1/2 there, s = f wavelength f_number / pitch."""
    whole = SHEET.model_copy(update={"fill_factor": 1.0})
    assert highest_mtf50_cy_per_px(whole) == pytest.approx(0.603355, abs=1e-5)
    # an aperture of half the side has twice that
    assert highest_mtf50_cy_per_px(SHEET) == pytest.approx(2 * 0.603355, abs=1e-5)
    slow = whole.model_copy(update={"f_number": 8.0, "pixel_pitch_um": PITCH_UM})
    found = highest_mtf50_cy_per_px(slow)
    s = found / PITCH_UM * 0.38 * 8.0
    product = np.sinc(found) * 2.0 / np.pi * (np.arccos(s) - s * np.sqrt(1.0 - s * s))
    assert product == pytest.approx(0.5, abs=1e-9)


def test_a_sharpened_edge_is_above_the_limit_and_one_noisy_edge_of_many_is_not() -> None:
    sheet = SHEET.model_copy(update={"fill_factor": 1.0})
    (line,) = warnings_of(sheet, mtf=(edge(0.75),))
    assert "MTF50 Y of e 0.7500" in line and "above the limit of 0.604 cy/px" in line and "may sharpen" in line
    assert not warnings_of(sheet, mtf=(edge(0.5), edge(0.75), edge(0.5)))


@pytest.mark.parametrize(("peak", "std", "is_reported"), [(1.05, 0.01, True), (1.03, 0.01, False), (1.0, 0.0, False)])
def test_a_modulation_above_one_is_reported(peak: float, std: float, is_reported: bool) -> None:
    """By three standard deviations of noise and of the estimate, 0.5 %: 1 + 3 * 0.0112 = 1.0335."""
    curve = {
        "frequency_cy_per_px": (0.0, 0.1, 0.2, 0.6),
        "mtf": (1.0, peak, 0.7, 1.4),
        "mtf_std": (0.0, std, 0.01, 0.1),
    }
    lines = warnings_of(mtf=(edge(0.3, **curve),))
    assert len(lines) == is_reported
    if is_reported:
        assert lines[0].startswith("left: highest MTF Y of e 1.050 ± 0.011 is above the limit of 1: the camera may")


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        ({"fx": 1159.5, "fy": 1159.5}, "focal length over the stated one 0.5000"),  # binned by two
        ({"fx": 2319.0, "fy": 1159.5}, "focal length x over y 2.0000"),  # one direction only
        ({"cx": 40.0}, "principal point x over the width 0.0625"),
        ({"fx": 2e5, "fy": 2e5}, "focal length over the frame's diagonal 250"),
    ],
)
def test_a_geometry_that_contradicts_the_data_sheet_is_reported(matrix: dict[str, float], words: str) -> None:
    sheet = SHEET.model_copy(update={"pixel_pitch_um": PITCH_UM, "focal_length_mm": FOCAL_MM})
    assert any(words in line for line in warnings_of(sheet, geometry=geometry(**matrix)))


def test_lengths_in_other_units_are_asked_about() -> None:
    assert "pixel_pitch_um 0.00345 µm is below" in warnings_of(SHEET.model_copy(update={"pixel_pitch_um": 0.00345}))[0]
    fit = FitResult(source="x", cameras={})
    assert implausible_figures(fit, {}, (0.03, 0.03)) == (
        "boards: square_mm 0.03 mm is below the limit of 0.2 mm: a length in another unit, as metres? give it in mm",
    )
    pair = StereoFit(
        rotation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), translation_mm=(-0.1, 0.0, 0.0),
        baseline_mm=0.1, baseline_mm_std=0.001, rms_px=0.1, pairs=9,
    )  # fmt: skip
    (line,) = warnings_of(stereo=pair)
    assert "stereo: stereo baseline 0.1000 ± 0.0010 mm is below the limit of 1 mm: square_mm or marker_mm" in line


def test_codes_of_the_file_are_not_those_of_the_converter() -> None:
    (line,) = warnings_of(SHEET.model_copy(update={"bit_depth": 16, "white_level_dn": 4095.0}))
    assert "white_level_dn over the highest code 0.06249 is below the limit of 0.4" in line


# --- whole sessions ---------------------------------------------------------------------------------------------------


def efficiency(recordings: RecordingSet) -> tuple[FitResult, float, float]:
    fit = fit_recording_set(recordings, steps=("noise",))
    noise = fit.cameras["left"].noise
    assert noise is not None and noise.quantum_efficiency is not None and noise.quantum_efficiency_std is not None
    return fit, noise.quantum_efficiency, noise.quantum_efficiency_std


@pytest.mark.parametrize(
    ("session", "true"),
    [
        # of user_faults/emva-photons: numbers of photons x 0.3, a quantum efficiency of 0.5
        (MonoSession(photons_stated=0.3), 0.5 / 0.3),
        # other sensors: 14 bit at a high gain; a dim sensor whose numbers are of another pixel's area
        (
            MonoSession(
                shape=(48, 96), efficiency=0.8, gain=1.5, read_e=2.0, bits=14, full_e=9000.0, photons_stated=0.5, seed=7
            ),
            0.8 / 0.5,
        ),
        (
            MonoSession(
                shape=(80, 64), efficiency=0.3, gain=0.04, read_e=12.0, bits=12, full_e=80e3, photons_stated=0.04
            ),
            0.3 / 0.04,
        ),
    ],
)
def test_more_electrons_than_photons_is_reported_everywhere(session: MonoSession, true: float, tmp_path: Path) -> None:
    """By fit, diagnosis and camera file; the estimate itself is right within 4 standard deviations."""
    recordings = session.recordings()
    fit, value, std = efficiency(recordings)
    assert abs(value - true) < 4.0 * std
    (line,) = fit.warnings
    assert (
        line.startswith("left: quantum efficiency at 530 nm") and "there can't be more electrons than photons" in line
    )
    found = diagnose(recordings, fit)
    assert found.verdict != "no_mismatch"
    assert any("fewer than the electrons" in item.shape for item in found.unexplained)
    assert found.warnings == fit.warnings and any(line in sentence for sentence in found.summary)

    content = fitted_camera(recordings, "left", fit.cameras["left"])
    file = tmp_path / "left.toml"
    write_camera(file, content)
    text = file.read_text(encoding="utf-8")
    assert "# quantum_efficiency: neither fitted nor stated; taken as typical curves (the measured" in text
    assert "isn't used: it is beyond 0..1" in text
    assert max(read_camera(file).camera.quantum_efficiency["Y"].value) == pytest.approx(0.5)


@pytest.mark.parametrize(
    "session",
    [
        MonoSession(photons_stated=100.0),  # of user_faults/emva-photons
        MonoSession(shape=(96, 48), efficiency=0.7, gain=0.8, bits=14, photons_stated=5000.0, wavelength_nm=470.0),
        MonoSession(shape=(64, 64), efficiency=0.04, gain=0.1, full_e=30e3, photons_stated=6.0, wavelength_nm=850.0),
    ],
)
def test_a_quantum_efficiency_below_one_per_cent_is_asked_about(session: MonoSession) -> None:
    recordings = session.recordings()
    fit, value, std = efficiency(recordings)
    assert abs(value - session.efficiency / session.photons_stated) < 4.0 * std
    (line,) = fit.warnings
    assert "is below the limit of 0.01" in line and "check the numbers of photons" in line
    assert line in " ".join(diagnose(recordings, fit).summary)


def test_right_photons_are_no_warning_and_the_camera_file_has_the_measured_value(tmp_path: Path) -> None:
    recordings = MonoSession(seed=3).recordings()
    fit, value, _ = efficiency(recordings)
    assert fit.warnings == ()
    content = fitted_camera(recordings, "left", fit.cameras["left"])
    assert float(content.camera.quantum_efficiency["Y"].at(530.0)) == pytest.approx(value, rel=1e-9)


def test_a_camera_file_says_what_nobody_stated(tmp_path: Path) -> None:
    """No lens of 5000 mm: the focal length isn't set. Comments name what was taken, and what isn't the fitted value."""
    recordings = MonoSession(wavelength_nm=None).recordings()
    fit = fit_recording_set(recordings, steps=("noise",)).cameras["left"]
    assert fit.noise is not None
    cold = fit.model_copy(update={"noise": fit.noise.model_copy(update={"dark_current_e_per_s": -3.0})})
    content = fitted_camera(recordings, "left", cold)
    file = tmp_path / "left.toml"
    write_camera(file, content)
    text = file.read_text(encoding="utf-8")
    assert "5000.0" not in text and "# focal_length_mm is not set" in text
    assert read_camera(file) == content
    assert "focal_length_mm" not in tomllib.loads(text)["lens"]
    for name in ("f_number", "pixel_pitch_um", "full_well_e"):
        assert f"# {name}: neither fitted nor stated; taken as" in text
    assert "# dark_current_e_per_s: the fitted -3.0" in text and "is below the limit of 0; written as 0" in text
