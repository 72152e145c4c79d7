"""The noise fit against cameras of known truth: robustness to curvature, shading, drift and saturation,
uncertainties."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.noise.noise_fit import noise_fit
from lab.measure.levels import MeasuredLevel
from tests.lab.fit.noise.synthetic_sensor import TRUTHS, Sensor, levels, measured, scores


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
