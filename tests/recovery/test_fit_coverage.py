"""Are the stated uncertainties true? Many draws of one camera: errors over uncertainties are normal with variance 1."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lab.fit.noise.noise_fit import noise_fit
from lab.fit.spectral import estimate_sensitivity
from lab.formats.recording_set import DataSheet
from lab.formats.results import NoiseFit
from lab.observables.noise.levels import MeasuredLevel
from lab.observables.noise.stack import level_statistics
from sim.camera import CameraModel, Lens
from sim.sensor.electrons import FixedPattern, sample_from
from sim.spectrum import Spectrum

DATA = Path(__file__).parents[3] / "shared" / "data"
DRAWS = 200
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


def model(cfa: str, rows: int, cols: int, **changes: float) -> CameraModel:
    known = {
        "rows": rows,
        "cols": cols,
        "pixel_pitch_um": 3.0,
        "fill_factor": 1.0,
        "cfa": cfa,
        "bit_depth": 12,
        "black_level_dn": 100.0,
        "white_level_dn": 4095,
        "conversion_gain_dn_per_e": 0.45,
        "full_well_e": 8500.0,
        "read_noise_e": 3.2,
        "dark_current_e_per_s": 15.0,
        "dsnu_e": 1.2,
        "prnu_percent": 0.7,
        "quantum_efficiency": {c: Spectrum.of([400, 700], [0.5, 0.5]) for c in ("RGB" if cfa != "MONO" else "Y")},
        "lens": Lens(f_number=4.0, focal_length_mm=6.0),
    }
    return CameraModel(**(known | changes))


def levels(
    camera: CameraModel,
    rng: np.random.Generator,
    pattern: FixedPattern,
    exposures: np.ndarray,
    repeats: int,
    rate: float,
) -> list[MeasuredLevel]:
    """Levels of light `rate` (e/s; 0: dark) in the planes R, G, B at 0.7, 1, 0.5 of it."""
    share = np.ones((camera.rows, camera.cols))
    if camera.cfa != "MONO":
        share[::2, ::2], share[1::2, 1::2] = 0.7, 0.5
    found = []
    for exposure in exposures:
        dark = camera.dark_current_e_per_s * exposure
        frames = (
            sample_from(rate * exposure * share + dark, camera, rng, pattern, dark_electrons=dark)
            for _ in range(repeats)
        )
        statistics = level_statistics(frames, camera.cfa, camera.white_level_dn)
        found.append(
            MeasuredLevel(float(exposure), float(exposure if rate else 0.0), "lamp" if rate else "dark", statistics)
        )
    return found


def test_photon_transfer_covers() -> None:
    camera = model("RGGB", 64, 96)
    stated = DataSheet(rows=64, cols=96, cfa="RGGB", bit_depth=12)
    rng = np.random.default_rng(20)
    fits: list[NoiseFit] = []
    for _ in range(DRAWS):
        pattern = FixedPattern.draw(camera, rng)
        darks = levels(camera, rng, pattern, np.array([0.001, 0.5, 2.0]), 4, 0.0)
        flats = levels(camera, rng, pattern, np.linspace(0.04, 0.95, 8), 3, 8300.0)
        fits.append(noise_fit(darks, flats, stated))
    for name in (
        "conversion_gain_dn_per_e",
        "read_noise_e",
        "black_level_dn",
        "dark_current_e_per_s",
        "dsnu_e",
        "prnu_percent",
    ):
        error = np.array([getattr(fit, name) - getattr(camera, name) for fit in fits])
        score = error / np.array([getattr(fit, name + "_std") for fit in fits])
        # 200 draws: a 95 % interval covers 95 +- 1.5 %; three of these. The mean score's standard deviation is 0.07;
        # four.
        covered = np.mean(np.abs(score) < 1.96)
        assert 0.905 <= covered <= 0.995, (name, covered)
        assert abs(score.mean()) < 0.28, (name, score.mean())
        assert 0.8 < score.std() < 1.2, (name, score.std())  # 1 +- 1 / sqrt(400) = 0.05; four


@pytest.mark.parametrize("case", ["ideal", "nonlinear", "brighter_fatter"])
def test_gain_of_full_size_frames(case: str) -> None:
    """50 levels of two 640 x 480 frames: 0.1 % rms in all three cases, where a straight line is off by 1.6 and 2.1
    %."""
    draws, gain, full = 12, 0.5, 7800.0
    rng = np.random.default_rng(21)
    stated = DataSheet(rows=480, cols=640, cfa="MONO", bit_depth=12)

    def frame(electrons: float) -> np.ndarray:
        loss = 0.02 * electrons / full if case == "brighter_fatter" else 0.0
        charge = electrons + np.sqrt(electrons * (1 - loss)) * rng.standard_normal((480, 640), dtype=np.float32)
        if case == "nonlinear":
            charge = charge * (1.0 - 0.01 * charge / full)
        charge = charge + 3.0 * rng.standard_normal((480, 640), dtype=np.float32)
        return np.clip(np.rint(100.0 + gain * charge), 0, 4095).astype(np.uint16)

    errors, scores = [], []
    for _ in range(draws):
        darks = [
            MeasuredLevel(t, 0.0, "dark", level_statistics([frame(0.0) for _ in range(2)], "MONO", 4095))
            for t in (0.02, 0.5, 1.0)
        ]
        flats = [
            MeasuredLevel(
                float(t), float(t), "lamp", level_statistics([frame(full * t) for _ in range(2)], "MONO", 4095)
            )
            for t in np.linspace(0.02, 1.0, 50)
        ]
        fit = noise_fit(darks, flats, stated)
        errors.append(fit.conversion_gain_dn_per_e / gain - 1.0)
        scores.append(errors[-1] * gain / fit.conversion_gain_dn_per_e_std)
    # The rms of 12 draws is itself known to 1 / sqrt(24) = 20 %; two of these above 0.1 %.
    assert np.sqrt(np.mean(np.square(errors))) < 0.001 * 1.4
    assert abs(np.mean(errors)) < 3.0 * 0.001 / np.sqrt(draws)
    assert np.sqrt(np.mean(np.square(scores))) < 1.6


@pytest.mark.parametrize(("width_nm", "noise", "target"), [(5.0, 0.002, 0.45), (10.0, 0.002, 1.0), (10.0, 0.01, 2.2)])
def test_sensitivity_covers(width_nm: float, noise: float, target: float) -> None:
    """The four measured cameras: median relative RMS, and the 2-standard-deviation band covers 93..97 %."""
    folder = DATA / "rawtoaces_sensitivities"
    if not folder.exists():
        pytest.skip("the shared sensitivities aren't here")
    rng = np.random.default_rng(22)
    wave = np.arange(380.0, 781.0, 1.0)
    centre = np.arange(400.0, 721.0, width_nm)
    light = np.exp(-0.5 * ((wave - centre[:, None]) * 2.3548 / width_nm) ** 2)
    inside = (wave >= 400) & (wave <= 720)
    errors, covered = [], []
    for file in sorted(folder.glob("*.json")):
        rows = json.loads(file.read_text())["spectral_data"]["data"]["main"]
        at = np.array(sorted(map(float, rows)))
        for channel in range(3):
            truth = np.interp(wave, at, [rows[f"{w:.0f}"][channel] for w in at])
            signal = np.trapezoid(light * truth, wave, axis=1)
            for _ in range(DRAWS // 12):
                found = estimate_sensitivity(
                    wave, light, signal * (1.0 + noise * rng.standard_normal(centre.size)), noise * signal
                )
                rest = (found.sensitivity - truth)[inside]
                errors.append(100.0 * np.sqrt(np.mean(rest**2) / np.mean(truth[inside] ** 2)))
                covered.append(np.mean(np.abs(rest) <= 2.0 * found.std[inside]))
    assert np.median(errors) <= target
    # A prior of one family is over curves of another: 93..97 % with 1 % for the family.
    assert 0.93 <= np.mean(covered) <= 0.98
