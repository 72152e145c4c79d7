"""What read-out does in dark frames, in the predictions for light: coloured noise of rows and fixed offsets of rows and
columns aren't flicker, nor steps of the sensor's response."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from evaluation.independent_simulator.laws import TapOffsetLaw
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.darks.readout import DarkReadOut
from lab.observables.flats.level_repeats import measure_level_repeats
from lab.observables.flats.lines import measure_flat_lines
from lab.observables.flats.rows import measure_flat_rows
from sim.camera import Shutter
from sim.effects.light_flicker import LightFlicker
from sim.spectrum import FloatArray
from tests.lab.diagnose.on_blocks import dataset, measured_model, names, sigmas, verdict

DATA = Path(__file__).resolve().parents[5] / "shared" / "data"
GAIN_DN_PER_E, BLACK_DN, READ_DN = 0.42, 64.3, 0.6
#: Noise of rows: an autoregressive process with this power at low frequencies, which 0.05 cy/row halves.
ROW_DN2, CORRELATION = 0.1, 0.7
CYCLES_PER_ROW = 0.03


def session(
    seed: int,
    dark_repeats: int,
    *,
    flicker: float = 0.0,
    shutter: Shutter | None = None,
    row_dn2: float = ROW_DN2,
    levels_dn: tuple[float, ...] = (30.0, 50.0, 80.0, 400.0, 1500.0),
    shape: tuple[int, int] = (80, 768),
    repeats: int = 10,
) -> RecordingSet:
    """Darks and flats of a camera whose rows share noise of `row_dn2` at low frequencies, in the dark and in light.
    `flicker`: amplitude of the light's 100 Hz over its mean, in bands of `CYCLES_PER_ROW` from a random phase."""
    rng = np.random.default_rng(seed)
    rows, cols = shape
    frames: dict[str, np.ndarray] = {}
    captures: list[dict[str, object]] = []

    def take(kind: str, exposure_s: float, signal_dn: float, **more: object) -> None:
        k = len(captures)
        white = np.sqrt(row_dn2) * (1.0 - CORRELATION) * rng.standard_normal(rows + 300)
        own = lfilter([1.0], [1.0, -CORRELATION], white)[300:, None]
        wave = np.cos(2.0 * np.pi * (CYCLES_PER_ROW * np.arange(rows)[:, None] + rng.random()))
        light = signal_dn * (1.0 + flicker * np.sinc(100.0 * exposure_s) * wave)
        dn = GAIN_DN_PER_E * rng.poisson(np.broadcast_to(light / GAIN_DN_PER_E, shape)) + own + BLACK_DN
        frames[f"{k}.npy"] = np.round(dn + READ_DN * rng.standard_normal(shape)).clip(0, 4095).astype(np.uint16)
        when = datetime(2026, 3, 2, tzinfo=UTC) + timedelta(seconds=20 * k)
        captures.append(
            {
                "id": f"c{k}",
                "kind": kind,
                "side": "left",
                "frame": f"{k}.npy",
                "exposure_s": exposure_s,
                "time": when,
                **more,
            }
        )

    for _ in range(dark_repeats):
        take("dark", 1e-3, 0.0)
    for signal_dn in levels_dn:
        for _ in range(repeats):
            take("flat", 2e-6 * signal_dn, signal_dn, photons_per_pixel=signal_dn / 0.25, wavelength_nm=530.0)
    stated = {
        "rows": rows,
        "cols": cols,
        "cfa": "MONO",
        "bit_depth": 12,
        "black_level_dn": BLACK_DN,
        "shutter": shutter,
    }
    manifest = Manifest.model_validate({"name": "rows", "cameras": {"left": stated}, "captures": captures})
    return RecordingSet(manifest, frames, {}, source="rows")


@pytest.mark.parametrize(("seed", "dark_repeats"), [(100, 10), (101, 2), (102, 0)])
def test_coloured_noise_of_rows_is_no_flicker(seed: int, dark_repeats: int) -> None:
    """Seen in bands of rows and, as rows of a frame share it, in the means of whole frames."""
    assert names(verdict(session(seed, dark_repeats), measure_flat_rows, measure_level_repeats)) == []


def test_frames_means_scatter_as_those_of_dark_frames() -> None:
    """Noise of rows leaves `ROW_DN2` / 80 in a frame's mean: the darkest number's variance is 1 + that over the pixels'
    noise; ten dark frames know it to sqrt(2 / 9) = 47 %, so within 3 of these."""
    block = measure_level_repeats(dataset(session(100, 10, shape=(80, 768))))
    pixels_dn2 = (30.0 * GAIN_DN_PER_E + READ_DN**2 + 1.0 / 12.0) / (80 * 768)
    expected = 1.0 + ROW_DN2 / 80 / pixels_dn2
    assert expected > 4.0
    assert 1.0 + 0.2 * (expected - 1.0) < block.predict(()).mean[0] ** 3 / (1.0 - 2.0 / 9.0 / 5.0) ** 3 < 2.5 * expected


@pytest.mark.parametrize("dark_repeats", [10, 0])
def test_flicker_beside_it_is_named(dark_repeats: int) -> None:
    """1 % of the light, with dark frames and without: it grows with the light, which noise of rows doesn't."""
    found = verdict(session(700, dark_repeats, flicker=0.01), measure_flat_rows, measure_level_repeats)
    assert names(found) == ["light_flicker"]
    effect, std = found.named[0].effect, found.named[0].std
    assert isinstance(effect, LightFlicker)
    assert abs(effect.modulation_percent - 1.0) < 3.0 * (std["modulation_percent"] or 0.0)
    assert effect.frequency_hz * effect.line_time_us * 1e-6 == pytest.approx(CYCLES_PER_ROW, rel=0.1)


def test_a_global_shutter_has_no_bands() -> None:
    """The same rows, of a camera whose sheet says so: flicker changes no prediction for rows, and isn't named for
    them."""
    flicker = LightFlicker(modulation_percent=5.0, frequency_hz=100.0, line_time_us=120.0)
    shutters: tuple[Shutter | None, ...] = "global", "rolling", None
    for shutter in shutters:
        model = measured_model(
            session(103, 2, flicker=0.02, shutter=shutter, repeats=2, shape=(80, 64)), measure_flat_rows
        )
        assert bool(np.any(model.mean((flicker,)) != model.mean())) == (shutter != "global")
    found = verdict(session(103, 2, flicker=0.02, shutter="global", repeats=2, shape=(80, 64)), measure_flat_rows)
    assert "light_flicker" not in names(found)


def test_numbers_scatter_about_what_dark_frames_predict() -> None:
    """Mean pulls over N draws: of a level's numbers within 3 standard errors of the draws' scatter, and 0.1, which
    moves no decision. chi2 is within 3 / sqrt(N) of its standard deviation, and 0.6 for what is free."""
    pulls, chi2 = [], []
    for seed in range(8):
        recordings = session(500 + seed, 6, levels_dn=(60.0, 200.0, 1500.0), shape=(64, 256), repeats=3)
        model = measured_model(recordings, measure_flat_rows)
        gaussian = model.gaussian()
        pulls.append(((model.value - gaussian.mean) / np.sqrt(np.diag(gaussian.covariance))).reshape(3, -1).mean(1))
        chi2.append(sigmas(model))
    error = np.std(pulls, axis=0, ddof=1) / np.sqrt(len(pulls))
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 3.0 * error + 0.1)
    assert abs(np.mean(chi2)) < 3.0 / np.sqrt(len(chi2)) + 0.6
    assert max(chi2) < 4.0


def test_strong_noise_of_rows_scatters_as_it_is_strong() -> None:
    """Rows of 50 times the pixels' power: a band's power has the relative scatter of chi2 whatever it is, so that its
    cube root is 3.7 times as wide as that of the pixels' noise. chi2 of 8 draws within 3 / sqrt(8) of its standard
    deviation, and 0.6 for what is free; it is 4.6 of them too large where the scatter is taken as that of pixels.
    """
    found = []
    for seed in range(8):
        recordings = session(800 + seed, 6, row_dn2=8.0, levels_dn=(60.0, 200.0, 1500.0), shape=(64, 256), repeats=3)
        found.append(sigmas(measured_model(recordings, measure_flat_rows)))
    assert np.max(measured_model(recordings, measure_flat_rows).value) > 3.0
    assert abs(np.mean(found)) < 3.0 / np.sqrt(len(found)) + 0.6


@pytest.mark.parametrize("contrasts", [1, 3, 20])
def test_the_spectrum_of_dark_rows_has_a_true_uncertainty(contrasts: int) -> None:
    """Of a flat spectrum of power 1, from one difference of repeats on: N = 400 draws of five bands. The cube root's
    mean is right to 0.08, and intervals of two standard deviations hold the truth in 95 %, in 90 % where a power is
    small by chance; 3 sqrt(0.09 / N) less."""
    bands = [range(1, 2), range(2, 3), range(3, 5), range(5, 8), range(8, 12)]
    rng = np.random.default_rng(7)
    root: list[FloatArray] = []
    holds: list[FloatArray] = []
    for _ in range(400):
        power = rng.gamma(contrasts, 1.0 / contrasts, 12)
        noise = DarkReadOut(contrasts, power, 0.0, np.zeros((24, 4), np.float32), contrasts + 1).noise(bands)
        root.append(np.cbrt(noise.power_dn2))
        holds.append(np.abs(noise.power_dn2 - 1.0) < 2.0 * noise.std_dn2)
    assert np.all(np.abs(np.mean(root, axis=0) - 1.0) < 0.08)
    assert np.all(np.mean(holds, axis=0) > 0.85)


def test_a_step_of_the_dark_is_no_step_of_the_response() -> None:
    """An offset of half of the columns, 20 e, in dark frames and flats: a step of 0.4 % of the mean signal, which isn't
    left."""
    camera = ConcealedCamera(771016, (TapOffsetLaw(20.0),), cfa="RGGB", rows=96, cols=128)
    looked_at = dataset(recordings_of(camera, Plan(("dark", "flat"))))
    model = MeasurementModel((measure_flat_lines(looked_at),), looked_at.camera)
    assert not mismatches(model, model.gaussian(), DecisionPolicy())


def test_a_real_camera_with_noisy_rows() -> None:
    """Its rows are 3.3 times as noisy in the dark as its pixels allow. Its means scatter by 0.05 DN in the dark, and by
    as much in light. Even and odd rows differ by 0.09 DN in the dark and not in light, which stays within what offsets
    may."""
    if not (folder := DATA / "emva1288_cmos_crop").exists():
        pytest.skip("the shared recordings aren't here")
    looked_at = dataset(read_emva1288(folder))
    for make in (measure_level_repeats, measure_flat_lines):
        assert sigmas(MeasurementModel((make(looked_at),), looked_at.camera)) < 4.0
