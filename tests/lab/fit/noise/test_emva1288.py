"""The figures of EMVA 1288 against their definitions, written out here a second time, and where they are refused."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from lab.fit.noise.emva1288 import EmvaInput, emva1288_figures
from lab.observables.noise.levels import MeasuredLevel
from lab.observables.noise.stack import SpatialVariance, level_statistics

GAIN, BLACK, READ, FULL, EFFICIENCY, DARK = 0.4, 60.0, 6.0, 6000.0, 0.5, 40.0
SHAPE = (60, 80)
LIGHTS = tuple(np.linspace(0.05, 1.3, 26))


def frame(rng: np.random.Generator, light: float, exposure_s: float, pattern: np.ndarray) -> np.ndarray:
    charge = np.minimum(rng.poisson(np.full(SHAPE, FULL * light + DARK * exposure_s)) * (1.0 + pattern), 1.1 * FULL)
    return np.clip(np.rint(BLACK + GAIN * (charge + READ * rng.standard_normal(SHAPE))), 0, 4095).astype(np.uint16)


@functools.cache
def recorded(seed: int = 1, repeats: int = 2) -> tuple[EmvaInput, dict[str, dict[float, np.ndarray]]]:
    rng = np.random.default_rng(seed)
    pattern = 0.01 * rng.standard_normal(SHAPE)
    frames: dict[str, dict[float, np.ndarray]] = {"dark": {}, "flat": {}}
    levels: dict[str, list[MeasuredLevel]] = {"dark": [], "flat": []}
    for light in LIGHTS:
        for kind in ("dark", "flat"):
            own = np.stack([frame(rng, light if kind == "flat" else 0.0, light, pattern) for _ in range(repeats)])
            frames[kind][light] = own.astype(float)
            photons = FULL * light / EFFICIENCY if kind == "flat" else 0.0
            levels[kind].append(MeasuredLevel(light, photons, kind, level_statistics(own, "MONO", 4095)))
    given = EmvaInput("Y", tuple(levels["dark"]), tuple(levels["flat"]), True, 550.0, 3000.0)
    return given, frames


def test_figures_are_those_of_the_definitions() -> None:
    given, frames = recorded()
    found = emva1288_figures(given)
    assert not isinstance(found, str)

    def pair(kind: str, light: float) -> tuple[float, float]:
        a, b = frames[kind][light]
        return float((a + b).mean() / 2.0), float(np.mean((a - b) ** 2) / 2.0 - (a.mean() - b.mean()) ** 2 / 2.0)

    mean, variance = np.array([pair("flat", light) for light in LIGHTS]).T
    dark_mean, dark_variance = np.array([pair("dark", light) for light in LIGHTS]).T
    signal, excess = mean - dark_mean, variance - dark_variance
    top = int(np.argmax(variance))
    used = signal <= 0.7 * signal[top]
    gain = float(np.sum(signal[used] * excess[used]) / np.sum(signal[used] ** 2))
    photons = FULL * np.array(LIGHTS) / EFFICIENCY
    responsivity = float(np.sum(photons[used] * signal[used]) / np.sum(photons[used] ** 2))
    # One degree of freedom of N goes with the frames' means: 1 / 4800.
    assert found.system_gain_dn_per_e == pytest.approx(gain, rel=3e-4)
    assert found.responsivity_dn_per_photon == pytest.approx(responsivity, rel=1e-6)
    assert found.quantum_efficiency == pytest.approx(responsivity / gain, rel=3e-4)
    assert found.saturation_capacity_photons == pytest.approx(photons[top])
    assert found.snr_max == pytest.approx(np.sqrt(photons[top] * responsivity / gain), rel=3e-4)
    at_zero = np.polynomial.polynomial.polyfit(LIGHTS, dark_variance, 1, w=1.0 / dark_variance)[0]
    noise_e = np.sqrt(at_zero - 1.0 / 12.0) / gain
    assert found.temporal_dark_noise_e == pytest.approx(noise_e, rel=2e-3)
    threshold = np.sqrt(at_zero / gain**2 + 0.25) + 0.5
    assert found.sensitivity_threshold_e == pytest.approx(threshold, rel=2e-3)
    assert found.sensitivity_threshold_photons == pytest.approx(threshold * gain / responsivity, rel=2e-3)
    assert found.dynamic_range == pytest.approx(photons[top] / (threshold * gain / responsivity), rel=2e-3)
    linear = (signal >= 0.05 * signal[top]) & (signal <= 0.95 * signal[top])
    a, b = np.polynomial.polynomial.polyfit(photons[linear], signal[linear], 1, w=1.0 / signal[linear])
    line = a + b * photons[linear]
    assert found.linearity_error_percent == pytest.approx(
        100.0 * np.mean(np.abs(signal[linear] - line) / line), rel=1e-6
    )
    rate = np.polynomial.polynomial.polyfit(LIGHTS, dark_mean, 1)[1] / gain
    assert found.dark_current_from_mean_e_per_s == pytest.approx(rate, rel=1e-2)


def test_truth_is_recovered() -> None:
    given, _ = recorded(2)
    found = emva1288_figures(given)
    assert not isinstance(found, str)
    truths = {
        "system_gain_dn_per_e": GAIN,
        "quantum_efficiency": EFFICIENCY,
        "responsivity_dn_per_photon": GAIN * EFFICIENCY,
        "temporal_dark_noise_e": READ,
        "dark_current_from_mean_e_per_s": DARK,
        "dark_current_from_variance_e_per_s": DARK,
        "prnu_percent": 1.0,
        "prnu_pixel_percent": 1.0,
    }
    for name, truth in truths.items():
        # Eight normal scores beyond 3.5: 0.4 % by chance, and the seed is fixed.
        assert abs(getattr(found, name) - truth) < 3.5 * getattr(found, f"{name}_std"), name


def test_rows_columns_and_pixels_are_told_apart() -> None:
    rng = np.random.default_rng(3)
    m, n = 400, 500
    image = 3.0 * rng.standard_normal((m, 1)) + 2.0 * rng.standard_normal((1, n)) + 5.0 * rng.standard_normal((m, n))
    split = SpatialVariance.split(
        float(image.var(ddof=1)), float(image.mean(axis=1).var()), float(image.mean(axis=0).var()), (m, n), 0.0, 0.0
    )
    assert split.rows + split.columns + split.pixels == pytest.approx(split.total, rel=1e-3)
    for value, std, truth in (
        (split.rows, split.rows_std, 9.0),
        (split.columns, split.columns_std, 4.0),
        (split.pixels, split.pixels_std, 25.0),
    ):
        assert abs(value - truth) < 3.5 * std


def test_what_the_recordings_lack_is_said() -> None:
    given, _ = recorded(4)
    without = emva1288_figures(EmvaInput("Y", (), given.flats, True, None, 3000.0))
    assert isinstance(without, str)
    assert "darks" in without
    few = emva1288_figures(EmvaInput("Y", given.darks, given.flats[:2], True, None, 3000.0))
    assert isinstance(few, str)
    assert "three" in few
    below = emva1288_figures(EmvaInput("Y", given.darks[:1], given.flats[:12], False, None, 3000.0))
    assert not isinstance(below, str)
    assert below.saturation_capacity_e is None
    assert below.dynamic_range is None
    assert below.quantum_efficiency is None
    assert below.dark_current_from_mean_e_per_s is None
    assert any("saturation capacity isn't determined" in remark for remark in below.remarks)
    assert any("fewer than three exposures" in remark for remark in below.remarks)


def test_rounding_hides_the_dark_noise() -> None:
    rng = np.random.default_rng(5)
    still = [np.rint(20.0 + 0.2 * rng.standard_normal(SHAPE)).astype(np.uint16) for _ in range(2)]
    dark = MeasuredLevel(0.01, 0.0, "dark", level_statistics(still, "MONO", 255))
    flats = [
        MeasuredLevel(
            float(t),
            float(t),
            "lamp",
            level_statistics(
                [np.rint(20 + 0.02 * rng.poisson(8000 * t, SHAPE)).astype(np.uint16) for _ in range(2)], "MONO", 255
            ),
        )
        for t in np.linspace(0.1, 1.0, 10)
    ]
    found = emva1288_figures(EmvaInput("Y", (dark,), tuple(flats), False, None, 235.0))
    assert not isinstance(found, str)
    assert found.temporal_dark_noise_e is None
    assert found.temporal_dark_noise_limit_e == pytest.approx(0.40 / found.system_gain_dn_per_e)
    assert found.sensitivity_threshold_e is None


def test_scatter_beyond_saturation_is_no_maximum() -> None:
    """Six levels at the full well, whose variances scatter: saturation is at the last level before them."""
    rng = np.random.default_rng(6)
    lights = [*np.linspace(0.1, 0.97, 10), 1.2, 1.4, 1.8, 2.4, 3.2, 4.5]
    levels: dict[str, list[MeasuredLevel]] = {"dark": [], "flat": []}
    for light in lights:
        for kind in ("dark", "flat"):
            charge = np.minimum(rng.poisson(np.full((2, *SHAPE), FULL * light if kind == "flat" else 0.0)), FULL)
            codes = np.rint(BLACK + GAIN * (charge + READ * rng.standard_normal((2, *SHAPE)))).astype(np.uint16)
            photons = FULL * light / EFFICIENCY if kind == "flat" else 0.0
            levels[kind].append(MeasuredLevel(light, photons, kind, level_statistics(codes, "MONO", 4095)))
    found = emva1288_figures(EmvaInput("Y", tuple(levels["dark"]), tuple(levels["flat"]), True, 550.0, 2400.0))
    assert not isinstance(found, str)
    assert found.saturation_capacity_photons == pytest.approx(0.97 * FULL / EFFICIENCY)
