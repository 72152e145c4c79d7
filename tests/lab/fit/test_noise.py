"""Photon transfer against cameras of known truth: definitions, robustness to bends, uncertainties, refusals."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.noise.defective_pixels import defective_pixels
from lab.fit.noise.level_statistics import MeasuredLevel, level_statistics
from lab.fit.noise.noise_fit import noise_fit
from lab.fit.noise.photon_transfer import fit_transfer
from lab.fit.noise.recordings import fit_noise
from lab.fit.noise.shading import shading
from lab.fit.noise.temperature_law import temperature_law
from lab.fit.weighted_lines import dark_line, linearity
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet, read
from lab.formats.results import NoiseFit
from sim.sensor.mosaic import planes

DATA = Path(__file__).parents[4] / "shared" / "data"


@dataclass(frozen=True)
class Sensor:
    """The truth of a synthetic camera; electrons unless said. Shot noise is drawn as a normal variable of the same moments."""

    shape: tuple[int, int] = (120, 160)
    cfa: str = "RGGB"
    gain: float = 0.5  # DN/e
    read: float = 3.0
    black: float = 100.0  # DN
    dark_rate: float = 20.0  # e/s
    dsnu: float = 1.5
    prnu: float = 0.008
    full: float = 7600.0  # e at light 1
    well: float = np.inf
    white: int = 4095
    bend: float = 0.0  # response e (1 - bend e / full)
    brighter_fatter: float = 0.0  # variance e (1 - bf e / full)
    channel: tuple[tuple[str, float], ...] = (("R", 0.7), ("G1", 1.0), ("G2", 1.0), ("B", 0.5), ("Y", 1.0))
    corner: float = 0.0  # loss of light in the corner, quadratic

    def pattern(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return self.prnu * rng.standard_normal(self.shape), self.dsnu * rng.standard_normal(self.shape)

    def frame(
        self, rng: np.random.Generator, light: float, exposure_s: float, pattern: tuple[np.ndarray, np.ndarray]
    ) -> np.ndarray:
        mean = np.full(self.shape, light * self.full)
        share = dict(self.channel)
        for name, plane in planes(mean, self.cfa).items():
            np.multiply(plane, share[name], out=plane)
        row, col = (np.linspace(-1, 1, n) for n in self.shape)
        mean *= 1.0 - self.corner * 0.5 * (row[:, None] ** 2 + col**2)
        mean = mean * (1.0 + pattern[0]) + self.dark_rate * exposure_s
        variance = mean * (1.0 - self.brighter_fatter * mean / self.full)
        charge = np.minimum(mean + np.sqrt(variance) * rng.standard_normal(self.shape), self.well)
        charge = charge * (1.0 - self.bend * charge / self.full) + pattern[1]
        charge += self.read * rng.standard_normal(self.shape)
        return np.clip(np.rint(self.black + self.gain * charge), 0, self.white).astype(np.uint16)

    def camera(self) -> DataSheet:
        return DataSheet(rows=self.shape[0], cols=self.shape[1], cfa=self.cfa, bit_depth=12)


def levels(
    sensor: Sensor,
    rng: np.random.Generator,
    exposures: np.ndarray,
    repeats: int,
    *,
    dark: bool = False,
    drift: float = 0.0,
    pattern: tuple[np.ndarray, np.ndarray],
) -> list[MeasuredLevel]:
    found = []
    for exposure in exposures:
        frames = (
            sensor.frame(
                rng, 0.0 if dark else exposure * (1.0 + drift * rng.standard_normal()), float(exposure), pattern
            )
            for _ in range(repeats)
        )
        found.append(
            MeasuredLevel(
                float(exposure),
                0.0 if dark else float(exposure),
                "dark" if dark else "lamp",
                level_statistics(frames, sensor.cfa, sensor.white),
            )
        )
    return found


def measured(sensor: Sensor, rng: np.random.Generator, drift: float = 0.0) -> NoiseFit:
    pattern = sensor.pattern(rng)
    darks = levels(sensor, rng, np.array([0.001, 0.5, 2.0]), 4, dark=True, pattern=pattern)
    flats = levels(sensor, rng, np.linspace(0.04, 0.98, 12), 3, pattern=pattern, drift=drift)
    return noise_fit(darks, flats, sensor.camera())


TRUTHS = {
    "conversion_gain_dn_per_e": lambda s: s.gain,
    "read_noise_e": lambda s: s.read,
    "black_level_dn": lambda s: s.black,
    "dark_current_e_per_s": lambda s: s.dark_rate,
    "dsnu_e": lambda s: s.dsnu,
    "prnu_percent": lambda s: 100.0 * s.prnu,
}


def scores(fit: NoiseFit, sensor: Sensor) -> dict[str, float]:
    """Error over stated uncertainty of each number."""
    return {key: (getattr(fit, key) - truth(sensor)) / getattr(fit, key + "_std") for key, truth in TRUTHS.items()}


# --- statistics of one level -------------------------------------------------------------------------------------------


def test_statistics_agree_with_their_definitions() -> None:
    rng = np.random.default_rng(1)
    frames = rng.integers(500, 600, (5, 40, 60)).astype(np.uint16)
    found = level_statistics(frames, "RGGB", 4095)
    blue = frames[:, 1::2, 1::2].astype(float)
    assert found["B"].mean == pytest.approx(blue.mean(), rel=1e-12)
    rest = blue - blue.mean(axis=(1, 2), keepdims=True)
    # The frames' means are taken out: (L - 1)(N - 1) degrees of freedom.
    expected = np.sum((rest - rest.mean(axis=0)) ** 2) / (4 * (blue[0].size - 1))
    assert found["B"].temporal_variance == pytest.approx(expected, rel=1e-5)
    assert found["B"].spatial_variance == pytest.approx(np.var(rest.mean(axis=0), ddof=1) - expected / 5, abs=0.02)


def test_a_drifting_lamp_is_no_temporal_noise() -> None:
    rng = np.random.default_rng(2)
    pattern = 20.0 * rng.standard_normal((80, 100))
    frames = [np.rint(1000.0 + offset + pattern).astype(np.uint16) for offset in (0, 30, -20, 75)]
    found = level_statistics(frames, "MONO", 4095)["Y"]
    assert found.temporal_variance == pytest.approx(0.0, abs=1e-6)
    assert found.spatial_variance == pytest.approx(400.0, rel=0.1)


def test_row_noise_widens_the_uncertainty_of_a_variance() -> None:
    rng = np.random.default_rng(3)
    frames = [
        np.rint(500 + 3 * rng.standard_normal((200, 300)) + 3 * rng.standard_normal((200, 1))).astype(np.uint16)
        for _ in range(2)
    ]
    found = level_statistics(frames, "MONO", 4095)["Y"]
    # Half of the variance 18 is common to a row: 9 sqrt(2 / 200) = 0.9, three times what independent pixels would say.
    assert 0.5 < found.temporal_variance_std < 1.5


def test_shading_takes_cos4_out_and_nothing_of_a_pattern() -> None:
    row, col = np.meshgrid(np.linspace(-0.25, 0.25, 240), np.linspace(-0.35, 0.35, 320), indexing="ij")
    fall_off = 1.0 / (1.0 + row**2 + col**2) ** 2
    # cos^4 to a corner of 23 deg, to a thousandth of the 0.8 % that PRNU usually is.
    assert np.max(np.abs(shading(fall_off) - fall_off)) < 1e-4
    noise = np.random.default_rng(4).standard_normal((240, 320))
    assert np.var(noise - shading(noise)) == pytest.approx(1.0, rel=0.02)


def test_hot_pixels_are_found_and_a_glow_is_not() -> None:
    rng = np.random.default_rng(5)
    image = 100 + rng.standard_normal((100, 120)) + np.linspace(0, 6, 120) ** 2
    image[[3, 50, 70], [8, 60, 119]] += 60
    assert set(zip(*np.nonzero(defective_pixels(image, "RGGB")), strict=True)) == {(3, 8), (50, 60), (70, 119)}


# --- pieces ------------------------------------------------------------------------------------------------------------


def test_transfer_is_exact_without_noise() -> None:
    x = np.linspace(0, 3000, 20)
    v = 2.0 + 0.4 * x - 5e-6 * x**2
    fit = fit_transfer(x, v, 1e-3 * v, np.zeros(20, int), x > 0, 4000.0)
    # The prior on the curvature (5 sigma from c x_sat / K = 0.05) pulls by less than 1e-4 at a noise of 1e-3.
    assert fit.gain == pytest.approx(0.4, rel=1e-4)
    assert fit.curvature == pytest.approx(-5e-6, rel=0.01)
    assert fit.floor[0] == pytest.approx(2.0, rel=1e-3)


def with_model_error(relative: float, bend: float, seed: int) -> tuple[np.ndarray, ...]:
    """Points of a camera of K = 0.4 whose flats have a `relative` error beyond their sampling noise of 0.3 %; bend at 4000 DN."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([np.zeros(5), np.linspace(100, 3500, 40)])
    v = (2.0 + 0.4 * x * (1.0 + bend * x / 4000.0)) * (1.0 + 0.003 * rng.standard_normal(x.size))
    v *= 1.0 + np.where(x > 0, relative, 0.0) * rng.standard_normal(x.size)
    return x, v, 0.003 * v, np.zeros(x.size, int), x > 0


def test_residuals_beyond_sampling_are_an_error_of_the_model() -> None:
    fit = fit_transfer(*with_model_error(0.02, 0.0, 6), 4000.0)
    # 37 levels: the error is known to 1 / sqrt(74) = 12 %; three of these.
    assert fit.model_error == pytest.approx(0.02, rel=0.35)
    assert fit.dark_error == 0.0
    assert abs(fit.gain - 0.4) < 3.0 * fit.gain_std
    calm = fit_transfer(*with_model_error(0.0, 0.0, 6), 4000.0)
    assert calm.model_error == 0.0
    assert not calm.by_line


def test_a_bend_is_believed_only_against_the_models_error() -> None:
    unsure = fit_transfer(*with_model_error(0.015, -0.05, 7), 4000.0)
    assert unsure.by_line
    assert unsure.gain == unsure.line_gain
    # Line and curve are both within what is stated.
    assert abs(unsure.curve_gain - 0.4) < 2.0 * unsure.curve_gain_std
    assert abs(unsure.gain - 0.4) < 2.5 * unsure.gain_std
    sure = fit_transfer(*with_model_error(0.004, -0.05, 7), 4000.0)
    assert not sure.by_line
    assert abs(sure.gain - 0.4) < 2.0 * sure.gain_std
    assert abs(sure.line_gain - 0.4) > 5.0 * sure.gain_std / 3.0


def test_a_straight_line_starts_below_the_darks_own_shot_noise() -> None:
    """Darks with dark current aren't the floor: 2 DN^2 here, where their mean variance is 4.4."""
    x, v, _, plane, light = with_model_error(0.015, -0.05, 7)
    x[:5] = (0.0, 3.0, 6.0, 9.0, 12.0)
    v[:5] = (2.0 + 0.4 * x[:5]) * v[:5] / 2.0  # each with the error that it had
    fit = fit_transfer(x, v, 0.003 * v, plane, light, 4000.0)
    assert fit.by_line
    # Sampling 0.3 % of 2..7 DN^2 over five darks, and the line's gain, off by as much as its uncertainty says, times 3 DN.
    assert abs(float(fit.floor[0]) - 2.0) < 3.0 * float(np.sqrt(fit.covariance[2, 2]))
    assert np.sqrt(fit.covariance[2, 2]) < 0.1


def test_dark_currents_follow_arrhenius_and_double() -> None:
    kelvin = np.array([293.15, 303.15, 313.15])
    current = 20.0 * np.exp(-0.6 / 8.617333262e-5 * (1.0 / kelvin - 1.0 / kelvin[0]))
    law = temperature_law([(t - 273.15, i, 0.01 * i) for t, i in zip(kelvin, current, strict=True)])
    assert law.activation_energy_ev == pytest.approx(0.6, rel=1e-6)
    assert law.reference_current_e_per_s == pytest.approx(20.0, rel=1e-6)
    # d ln I / dT = E / k T^2 at the middle: 9.14 deg C for a factor of 2, and the law bends within these 20 by 7 %.
    assert law.doubling_temperature_c == pytest.approx(np.log(2.0) * 8.617333262e-5 * 303.15**2 / 0.6, rel=0.02)
    assert law.activation_energy_ev_std == pytest.approx(
        0.01 * np.sqrt(2) * 8.617333262e-5 / (1 / 293.15 - 1 / 313.15), rel=0.05
    )
    alone = temperature_law([(20.0, 5.0, 0.1), (30.0, 0.1, 0.1)])
    assert alone.activation_energy_ev is None
    assert alone.doubling_temperature_c is None


def test_dark_line_finds_black_and_rate() -> None:
    exposure = np.array([0.001, 0.5, 2.0])
    line = dark_line(exposure, 64.0 + 3.0 * exposure, np.full(3, 0.01))
    assert (line.black, line.rate) == (pytest.approx(64.0), pytest.approx(3.0))
    single = dark_line(np.array([0.1, 0.1]), np.array([64.0, 64.2]), np.array([0.1, 0.1]))
    assert single.rate is None
    assert single.black == pytest.approx(64.1)


def test_linearity_error_of_a_parabola() -> None:
    light = np.linspace(0.05, 0.95, 400)
    found = linearity(light, 3000 * light * (1 - 0.01 * light), np.full(400, 1e-6))
    # The relative deviations are those of -x about the line that minimises them, all of 1 % x 0.9 span: an independent
    # minimisation over offset and slope gives their mean modulus.
    basis = np.stack([1 / (light * (1 - 0.01 * light)), 1 / (1 - 0.01 * light)], axis=1)
    rest = 1 - basis @ np.linalg.lstsq(basis, np.ones(400), rcond=None)[0]
    assert found.error_percent == pytest.approx(100 * np.abs(rest).mean(), rel=0.01)


# --- the fit -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cfa", ["MONO", "GBRG"])
def test_truth_is_recovered(cfa: str) -> None:
    sensor = Sensor(cfa=cfa, corner=0.08)
    found = scores(measured(sensor, np.random.default_rng(7)), sensor)
    assert max(map(abs, found.values())) < 3.5, found  # six normal scores: chance 0.3 %


def test_uncertainties_are_true() -> None:
    sensor = Sensor(shape=(48, 64))
    rng = np.random.default_rng(8)
    found = [scores(measured(sensor, rng), sensor) for _ in range(30)]
    for key in TRUTHS:
        square = np.mean([one[key] ** 2 for one in found])
        # Mean of 30 squares of normal scores: 1 +- sqrt(2/30) = 0.26; four of these for six keys. Below, 0.35: the
        # prediction isn't a bound.
        assert 0.35 < square < 2.05, (key, square)


@pytest.mark.parametrize(("bend", "fat"), [(0.0, 0.0), (0.01, 0.0), (0.0, 0.02)], ids=["ideal", "bent", "fat"])
def test_bends_do_not_bias_the_gain(bend: float, fat: float) -> None:
    sensor = Sensor(shape=(480, 640), cfa="MONO", bend=bend, brighter_fatter=fat, prnu=0.0, dsnu=0.0, well=7900.0)
    rng = np.random.default_rng(9)
    pattern = (np.zeros(sensor.shape), np.zeros(sensor.shape))
    darks = levels(sensor, rng, np.array([0.01, 1.0]), 2, dark=True, pattern=pattern)
    flats = levels(sensor, rng, np.linspace(0.04, 0.98, 25), 2, pattern=pattern)
    fit = noise_fit(darks, flats, sensor.camera())
    # 25 levels are half of what the 0.1 % rms are for: sqrt(2) x 0.1 % x 2.5 sigma.
    assert abs(fit.conversion_gain_dn_per_e / sensor.gain - 1) < 0.0035
    assert fit.conversion_gain_dn_per_e_std / sensor.gain < 0.0018
    if bend or fat:
        assert any("bends" in remark for remark in fit.remarks)


def test_shading_is_no_prnu() -> None:
    sensor = Sensor(corner=0.3, prnu=0.004)
    fit = measured(sensor, np.random.default_rng(10))
    assert abs(fit.prnu_percent - 0.4) < 3.5 * fit.prnu_percent_std
    assert abs(fit.conversion_gain_dn_per_e - 0.5) < 3.5 * fit.conversion_gain_dn_per_e_std


def test_drift_is_said_and_a_steady_lamp_is_not_accused() -> None:
    sensor = Sensor()
    drifting = measured(sensor, np.random.default_rng(11), drift=0.003)
    steady = measured(sensor, np.random.default_rng(11))
    assert any("lamp drifted" in remark for remark in drifting.remarks)
    assert not any("lamp" in remark for remark in steady.remarks)
    assert abs(drifting.conversion_gain_dn_per_e - 0.5) < 3.5 * drifting.conversion_gain_dn_per_e_std


@pytest.mark.parametrize("well", [np.inf, 6500.0], ids=["converter", "pixel"])
def test_saturation_is_seen_and_left_out(well: float) -> None:
    sensor = Sensor(cfa="MONO", well=well)
    rng = np.random.default_rng(12)
    pattern = sensor.pattern(rng)
    darks = levels(sensor, rng, np.array([0.001, 1.0]), 4, dark=True, pattern=pattern)
    flats = levels(sensor, rng, np.linspace(0.05, 1.6, 20), 2, pattern=pattern)
    fit = noise_fit(darks, flats, sensor.camera())
    truth = min(well, (4095 - 100) / 0.5)
    # The plateau of a pixel's own full well is known to the read noise of many pixels, the converter's to its step.
    assert fit.full_well_e == pytest.approx(truth, rel=0.01)
    assert abs(fit.conversion_gain_dn_per_e - 0.5) < 4.0 * fit.conversion_gain_dn_per_e_std
    assert not any(
        used
        for used, dn in zip(fit.photon_transfer.used, fit.photon_transfer.signal_dn, strict=True)
        if dn > 0.97 * truth
    )
    assert any("saturate" in remark for remark in fit.remarks)


def test_quantum_efficiency_of_a_mono_camera() -> None:
    sensor = Sensor(cfa="MONO")
    rng = np.random.default_rng(13)
    pattern = sensor.pattern(rng)
    darks = levels(sensor, rng, np.array([0.001, 1.0]), 3, dark=True, pattern=pattern)
    flats = [
        MeasuredLevel(level.exposure_s, sensor.full * level.light / 0.6, ("", True, 550.0), level.plane)
        for level in levels(sensor, rng, np.linspace(0.05, 0.95, 10), 2, pattern=pattern)
    ]
    fit = noise_fit(darks, flats, sensor.camera())
    assert abs(fit.quantum_efficiency - 0.6) < 3.5 * fit.quantum_efficiency_std
    assert fit.quantum_efficiency_std < 0.01
    assert fit.quantum_efficiency_wavelength_nm == 550.0


def recording_set(
    sensor: Sensor, darks: list[tuple[float, int]], flats: list[tuple[float, int]], **extra: object
) -> RecordingSet:
    rng = np.random.default_rng(14)
    pattern = sensor.pattern(rng)
    captures, frames = [], {}
    for kind, wanted in (("dark", darks), ("flat", flats)):
        for exposure, repeats in wanted:
            for _ in range(repeats):
                name = f"{kind}-{len(captures)}"
                captures.append(
                    {"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": exposure, **extra}
                )
                frames[name] = sensor.frame(rng, exposure if kind == "flat" else 0.0, exposure, pattern)
    manifest = Manifest(cameras={"left": sensor.camera()}, captures=tuple(captures))
    return RecordingSet(manifest, frames)


LADDER = [(0.1, 2), (0.3, 2), (0.5, 2), (0.7, 2), (0.9, 2)]


def test_fit_noise_reads_a_recording_set() -> None:
    sensor = Sensor()
    fit = fit_noise(recording_set(sensor, [(0.001, 4), (1.0, 4)], LADDER, temperature_c=25.0), "left")
    assert max(map(abs, scores(fit, sensor).values())) < 3.5
    assert fit.photon_transfer.channel == ("R", "G", "B") * 5
    assert any("25 deg C" in remark for remark in fit.remarks)


def test_gain_is_given_for_0_db() -> None:
    fit = fit_noise(recording_set(Sensor(), [(0.001, 2)], LADDER, gain_db=6.0), "left")
    assert fit.conversion_gain_dn_per_e == pytest.approx(0.5 / 10**0.3, rel=0.03)
    assert any("6 dB" in remark for remark in fit.remarks)
    assert fit.dark_current_e_per_s is None


@pytest.mark.parametrize(
    ("flats", "words"),
    [
        ([], "no flats"),
        ([(0.1, 1), (0.4, 1), (0.8, 1)], "0 unsaturated flat levels with repeats"),
        ([(0.1, 2), (3.0, 2), (4.0, 2)], "1 unsaturated flat levels"),
    ],
)
def test_what_the_flats_do_not_determine_is_said(flats: list[tuple[float, int]], words: str) -> None:
    with pytest.raises(NotDetermined, match=words):
        fit_noise(recording_set(Sensor(), [(0.001, 2)], flats), "left")


def test_copies_are_no_repeats() -> None:
    recordings = recording_set(Sensor(), [(0.001, 2)], LADDER)
    flats = recordings.captures("flat")
    first = {flat.exposure_s: flat for flat in reversed(flats)}
    frames = {c.frame: recordings.frame(c) for c in recordings.captures()}
    frames |= {flat.frame: recordings.frame(first[flat.exposure_s]) for flat in flats}
    with pytest.raises(NotDetermined, match="alike, pixel by pixel"):
        fit_noise(RecordingSet(recordings.manifest, frames), "left")


def test_darks_that_are_lighter_than_flats_are_refused() -> None:
    recordings = recording_set(Sensor(), [(0.001, 2), (0.5, 2)], LADDER)
    frames = {c.frame: recordings.frame(c) for c in recordings.captures()}
    frames |= {c.frame: frames[c.frame] + np.uint16(1500) for c in recordings.captures("dark")}
    with pytest.raises(NotDetermined, match="darker than darks"):
        fit_noise(RecordingSet(recordings.manifest, frames), "left")


def test_without_darks_the_gain_is_found_and_the_rest_is_not() -> None:
    sensor = Sensor()
    recordings = recording_set(sensor, [], LADDER)
    with pytest.raises(NotDetermined, match="black level"):
        fit_noise(recordings, "left")
    camera = sensor.camera().model_copy(update={"black_level_dn": 100.0})
    stated = RecordingSet(
        recordings.manifest.model_copy(update={"cameras": {"left": camera}}),
        {c.frame: recordings.frame(c) for c in recordings.captures()},
    )
    fit = fit_noise(stated, "left")
    assert abs(fit.conversion_gain_dn_per_e - 0.5) < 3.5 * fit.conversion_gain_dn_per_e_std
    assert (fit.read_noise_e, fit.dsnu_e, fit.dark_current_e_per_s) == (None, None, None)
    assert any("no darks" in remark for remark in fit.remarks)


def test_clipped_black_is_said() -> None:
    fit = fit_noise(recording_set(Sensor(black=1.0), [(0.001, 2)], LADDER), "left")
    assert fit.read_noise_e is None
    assert any("clipped at 0 DN" in remark for remark in fit.remarks)
    assert fit.conversion_gain_dn_per_e == pytest.approx(0.5, rel=0.03)


def test_rounding_hides_a_small_read_noise_and_that_is_said() -> None:
    sensor = Sensor(read=0.2, dsnu=0.0)  # 0.1 DN about a whole DN: all dark pixels are alike
    fit = fit_noise(recording_set(sensor, [(0.001, 4)], LADDER), "left")
    assert fit.read_noise_e is None
    assert any("rounding hides" in remark for remark in fit.remarks)
    assert abs(fit.conversion_gain_dn_per_e - 0.5) < 3.5 * fit.conversion_gain_dn_per_e_std


@pytest.mark.parametrize("black", [5.0, 5.3, 5.5])
def test_eight_bits_say_what_they_hide(black: float) -> None:
    """Dark noise of 0.13 DN: whether 5.5 flickers between two codes or 5.0 stands still, the figures aren't there."""
    sensor = Sensor(cfa="MONO", gain=0.025, read=5.0, black=black, dark_rate=20.0, dsnu=1.0, full=9500.0, white=255)
    ladder = [(float(t), 2) for t in np.linspace(0.05, 1.0, 20)]
    darks = [(float(t), 2) for t in (0.01, 0.3, 0.6, 1.0)]
    fit = fit_noise(recording_set(sensor, darks, ladder), "left")
    for name in ("read_noise_e", "dark_current_e_per_s", "dsnu_e", "dark_current_from_variance_e_per_s"):
        assert getattr(fit, name) is None, name
    assert any(
        "rounding hides the read noise" in remark or "where rounding hides it" in remark for remark in fit.remarks
    )
    assert any("dark current and DSNU aren't determined" in remark for remark in fit.remarks)
    assert abs(fit.black_level_dn - black) < 3.0 * fit.black_level_dn_std
    assert abs(fit.conversion_gain_dn_per_e - 0.025) < 3.0 * fit.conversion_gain_dn_per_e_std


def test_a_level_taken_twice_is_a_level_with_more_repeats() -> None:
    sensor = Sensor()
    fit = fit_noise(recording_set(sensor, [(0.001, 4), (1.0, 4)], LADDER + LADDER), "left")
    assert len(fit.photon_transfer.exposure_s) == 3 * len(LADDER)
    assert abs(fit.conversion_gain_dn_per_e - 0.5) < 3.5 * fit.conversion_gain_dn_per_e_std


def test_every_channel_has_its_own_figures() -> None:
    sensor = Sensor()
    fit = fit_noise(recording_set(sensor, [(0.001, 4), (1.0, 4)], LADDER), "left")
    assert set(fit.channels) == {"R", "G", "B"}
    for name, channel in fit.channels.items():
        for key in ("conversion_gain_dn_per_e", "read_noise_e", "dark_current_e_per_s", "dsnu_e"):
            error = getattr(channel, key) - TRUTHS[key](sensor)
            assert abs(error) < 3.5 * getattr(channel, f"{key}_std"), (name, key)
    assert set(fit.emva1288) == {"R", "G1", "G2", "B"}


def test_what_bends_the_variance_is_told_apart() -> None:
    bent = measured(Sensor(shape=(240, 320), cfa="MONO", bend=0.03), np.random.default_rng(15))
    assert abs(bent.response_bend_percent - -3.0 * 7990 / 7600) < 0.2  # at the converter's limit, 7990 e of signal
    assert abs(bent.brighter_fatter_percent) < 3.5 * bent.brighter_fatter_percent_std
    assert any("a response that bends" in remark for remark in bent.remarks)
    fat = measured(Sensor(shape=(240, 320), cfa="MONO", brighter_fatter=0.06), np.random.default_rng(16))
    assert abs(fat.response_bend_percent) < 4.0 * fat.response_bend_percent_std
    assert abs(fat.brighter_fatter_percent - 6.0 * 7990 / 7600) < 3.5 * fat.brighter_fatter_percent_std
    # This one's noise is missing without having gone to the neighbours.
    assert abs(fat.neighbour_covariance_percent) < 4.0 * fat.neighbour_covariance_percent_std
    assert any("neighbours' covariances don't show" in remark for remark in fat.remarks)


def test_a_lamp_off_the_axis_is_said() -> None:
    sensor = Sensor(cfa="MONO", prnu=0.0)
    rng = np.random.default_rng(17)
    slope = np.linspace(-0.01, 0.01, sensor.shape[0])[:, None] * np.ones(sensor.shape)
    darks = levels(sensor, rng, np.array([0.001, 1.0]), 3, dark=True, pattern=(slope, 0.0 * slope))
    flats = levels(sensor, rng, np.linspace(0.1, 0.9, 8), 3, pattern=(slope, 0.0 * slope))
    fit = noise_fit(darks, flats, sensor.camera())
    assert any(
        "asymmetric: rows from 0.991 in their first tenth to 1.009 in their last" in remark for remark in fit.remarks
    )


def test_a_frame_of_a_few_pixels_is_refused() -> None:
    with pytest.raises(NotDetermined, match="too few"):
        fit_noise(recording_set(Sensor(shape=(4, 4)), [(0.001, 2)], LADDER), "left")


@pytest.mark.parametrize("seed", range(16))
def test_poor_recordings_end_in_figures_or_in_a_reason(seed: int) -> None:
    """Few levels, single frames, all-dark and all-white flats, coarse codes, clipped blacks, temperatures and gains mixed: what comes
    out is finite, or a reason. Warnings are errors in these tests."""
    rng = np.random.default_rng(seed)
    bits = int(rng.choice([8, 12]))
    white = 2**bits - 1
    sensor = Sensor(
        shape=(int(rng.integers(16, 60)), int(rng.integers(16, 60))),
        cfa=str(rng.choice(["MONO", "GRBG"])),
        gain=white / 9000.0,
        read=float(rng.choice([0.0, 3.0, 40.0])),
        black=float(rng.choice([0.0, 0.4, 0.02 * white])),
        dsnu=float(rng.choice([0.0, 2.0])),
        full=9000.0 * float(rng.choice([0.3, 0.9, 1.3, 30.0])),
        white=white,
    )
    exposures = np.linspace(0.001, 1.0, int(rng.choice([1, 3, 8])))
    flats = [(float(t), int(rng.choice([1, 2, 3]))) for t in exposures]
    darks = [(float(t), int(rng.choice([1, 2]))) for t in exposures[:: int(rng.choice([1, 2]))]] if seed % 4 else []
    recordings = recording_set(sensor, darks, flats, **({"temperature_c": 20.0 + seed % 3} if seed % 2 else {}))
    try:
        fit = fit_noise(recordings, "left")
    except NotDetermined as refused:
        assert len(refused.reason) > 20
        return
    assert np.isfinite(fit.conversion_gain_dn_per_e)
    assert fit.conversion_gain_dn_per_e_std > 0
    json.loads(fit.model_dump_json(), parse_constant=lambda name: pytest.fail(f"{name} in the results"))


# --- recordings of others ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["foreign_healthy", "foreign_two_effects"])
def test_another_image_formers_truth(name: str) -> None:
    if not (DATA / name).exists():
        pytest.skip("the shared recordings aren't here")
    truth = json.loads((DATA / name / "truth.json").read_text())
    fit = fit_noise(read(DATA / name), "left")
    names = {
        "conversion_gain_dn_per_e": "K",
        "read_noise_e": "read_noise_e",
        "black_level_dn": "black",
        "dark_current_e_per_s": "dark",
        "dsnu_e": "dsnu",
        "prnu_percent": "prnu_percent",
    }
    for key, theirs in names.items():
        assert abs(getattr(fit, key) - truth[theirs]) < 3.0 * getattr(fit, key + "_std"), key
    # What the issue asks of the bench: 1 % and 3 %.
    assert fit.conversion_gain_dn_per_e == pytest.approx(truth["K"], rel=0.01)
    assert fit.read_noise_e == pytest.approx(truth["read_noise_e"], rel=0.03)
    assert not any("drift" in remark for remark in fit.remarks)


def test_a_real_ccd() -> None:
    folder = DATA / "emva1288_ccd"
    if not folder.exists():
        pytest.skip("the shared recordings aren't here")
    fit = fit_noise(read_emva1288(folder), "left")
    assert fit.conversion_gain_dn_per_e == pytest.approx(0.280, rel=0.02)
    assert fit.read_noise_e == pytest.approx(10.9, rel=0.1)
    assert fit.quantum_efficiency == pytest.approx(0.453, rel=0.03)
    assert any("lamp drifted" in remark for remark in fit.remarks)
    assert any(
        "shading is asymmetric: rows from 0.999 in their first tenth to 1.007" in remark for remark in fit.remarks
    )
    own = fit.emva1288["Y"]
    # By the reference implementation, on the same frames: 0.27986, 0.45286, 0.4325.
    assert own.system_gain_dn_per_e == pytest.approx(0.27986, rel=1e-3)
    assert own.quantum_efficiency == pytest.approx(0.45286, rel=2e-3)
    assert own.prnu_percent == pytest.approx(0.4325, rel=2e-3)
    assert own.saturation_capacity_photons == 30957.0
    # The curve's gain at zero signal is within what is stated, too.
    assert (
        abs(fit.conversion_gain_at_zero_dn_per_e - fit.conversion_gain_dn_per_e)
        < 2.0 * fit.conversion_gain_dn_per_e_std
    )
