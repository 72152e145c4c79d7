"""Levels with wrongly stated light are found; right ones aren't reported; uncertainties stay right."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.noise.noise_fit import noise_fit
from lab.formats.results import NoiseFit
from lab.observables.flats.level_lines import RobustResponse, robust_response
from lab.observables.noise.levels import MeasuredLevel
from tests.lab.fit.noise.synthetic_sensor import Sensor, levels

BEND = 0.02  # of the response at saturation


def series(
    rng: np.random.Generator, count: int, wrong: int, scatter: float, offset: float = 0.0
) -> tuple[RobustResponse, np.ndarray]:
    """A response that bends, with `wrong` levels whose light is stated wrong by 5 % to a factor of 10 either way."""
    light = np.linspace(1.0 / count, 0.95, count)
    signal = light * (1.0 - BEND * light) + offset
    noise = 3e-4 * np.sqrt(signal)
    measured = signal * (1.0 + scatter * rng.standard_normal(count)) + noise * rng.standard_normal(count)
    is_wrong = np.zeros(count, bool)
    is_wrong[rng.choice(count, wrong, replace=False)] = True
    size = rng.uniform(np.log(1.05), np.log(10.0), count) * rng.choice([-1, 1], count)
    stated = 1000.0 * light * np.exp(np.where(is_wrong, size, 0.0))
    found = robust_response(stated, measured, noise, 1.0, np.zeros(count, bool), rng)
    assert found is not None
    return found, is_wrong


@pytest.mark.parametrize("count", [12, 20, 50])
def test_a_fifth_of_the_levels_may_be_wrong(count: int) -> None:
    rng = np.random.default_rng(count)
    draws = [series(rng, count, count // 5, 1e-3) for _ in range(15)]
    missed = sum(int(np.count_nonzero(wrong & ~found.outlier)) for found, wrong in draws)
    accused = sum(int(np.count_nonzero(found.outlier & ~wrong)) for found, wrong in draws)
    # Levels above 90 % of saturation are held to 25 %, as the response may roll off there: one in ten, of which one in
    # eight is off by less. Otherwise 5 % is 50 standard deviations.
    assert missed <= max(0.04 * 15 * (count // 5), 1)
    assert accused == 0  # FALSE_ALARM: one set in a thousand
    for found, wrong in draws:
        light = np.linspace(1.0 / count, 0.95, count) * 1000.0
        inside = light < 900.0
        # The law leaves its noise and the level's own scatter
        assert np.abs(found.expected_light / light - 1.0)[inside].max() < 8e-3
        assert wrong.sum() == count // 5


@pytest.mark.parametrize("count", [8, 12, 50])
def test_sound_levels_are_not_accused(count: int) -> None:
    rng = np.random.default_rng(count + 1)
    draws = [
        series(rng, count, 0, scatter, offset)[0] for scatter in (0.0, 2e-3) for offset in (0.0, 1e-3) for _ in range(8)
    ]
    assert sum(int(found.outlier.sum()) for found in draws) == 0  # 32 draws of FALSE_ALARM 0.001


def test_the_scatter_of_sound_levels_is_told() -> None:
    rng = np.random.default_rng(3)
    scatter = [series(rng, 50, 5, 4e-3)[0].scatter for _ in range(12)]
    # 45 levels less five numbers: 1 / sqrt(80) each; mean of 12, 3.5 sigma
    assert np.sqrt(np.mean(np.square(scatter))) == pytest.approx(4e-3, rel=3.5 / np.sqrt(80 * 12))
    assert series(rng, 50, 0, 0.0)[0].scatter == 0.0


def test_two_contradicting_levels_alone_exclude_neither() -> None:
    light, rng = np.array([1.0, 2.0, 3.0, 40.0]), np.random.default_rng(0)
    assert robust_response(light, np.array([0.1, 0.2, 0.3, 0.4]), np.full(4, 1e-4), 1.0, np.zeros(4, bool), rng) is None


def photon_fit(seed: int, factors: dict[int, float], scatter: float = 0.0) -> NoiseFit:
    """A mono camera of quantum efficiency 0.6 with 20 levels, of which some state a wrong photon number."""
    sensor = Sensor(cfa="MONO", shape=(48, 64), dsnu=0.0, prnu=0.0)
    rng = np.random.default_rng(seed)
    pattern = (np.zeros(sensor.shape), np.zeros(sensor.shape))
    darks = levels(sensor, rng, np.array([0.01, 0.5, 1.0]), 4, dark=True, pattern=pattern)
    exposures = np.linspace(0.05, 0.95, 20) * (1.0 + scatter * rng.standard_normal(20))
    flats = []
    for number, level in enumerate(levels(sensor, rng, exposures, 2, pattern=pattern)):
        photons = sensor.full * np.linspace(0.05, 0.95, 20)[number] / 0.6 * factors.get(number, 1.0)
        flats.append(
            MeasuredLevel(
                level.exposure_s,
                photons,
                ("", True, 550.0),
                level.plane,
                captures=(f"flat-{number}a", f"flat-{number}b"),
            )
        )
    return noise_fit(darks, flats, sensor.camera())


@pytest.mark.parametrize("factors", [{9: 0.1}, {0: 10.0, 7: 0.5, 12: 0.96, 15: 3.0}], ids=["one", "a fifth"])
def test_a_bad_level_costs_one_level(factors: dict[int, float]) -> None:
    sound, fit = photon_fit(5, {}), photon_fit(5, factors)
    assert sound.inconsistent_levels == ()
    assert sorted(level.captures[0] for level in fit.inconsistent_levels) == sorted(f"flat-{k}a" for k in factors)
    for level in fit.inconsistent_levels:
        number = int(level.captures[0][5:-1])
        # Shot noise of 3072 pixels and two frames at the dimmest level: 0.1 %; its offset is less certain
        assert level.expected_light == pytest.approx(level.light / factors[number], rel=0.02)
    assert abs(fit.quantum_efficiency - 0.6) < 3.5 * fit.quantum_efficiency_std
    assert abs(fit.conversion_gain_dn_per_e - 0.5) < 3.5 * fit.conversion_gain_dn_per_e_std
    # The linearity error is that of the noise, as without the bad levels, not the per cents of a wrong photon number
    assert fit.linearity_error_percent < 3.0 * sound.linearity_error_percent
    assert abs(fit.emva1288["Y"].quantum_efficiency - 0.6) < 3.5 * fit.emva1288["Y"].quantum_efficiency_std
    assert any("flat-9a .. flat-9b" in remark for remark in fit.remarks) == (9 in factors)
    assert not any("lamp" in remark for remark in fit.remarks)


def test_uncertainties_include_the_scatter_of_the_levels() -> None:
    fits = [photon_fit(100 + seed, {}, scatter=5e-3) for seed in range(25)]
    for figure in ("quantum_efficiency", "responsivity_dn_per_photon"):
        truth = 0.6 if figure == "quantum_efficiency" else 0.3
        score = [
            (getattr(fit.emva1288["Y"], figure) - truth) / getattr(fit.emva1288["Y"], f"{figure}_std") for fit in fits
        ]
        # Mean of 25 squares of normal scores: 1 +- 0.28; four of these
        assert 0.2 < np.mean(np.square(score)) < 2.15, figure
    assert all("it is in the uncertainties" in " ".join(fit.remarks) for fit in fits if fit.response_scatter_percent)


def test_a_curvature_that_the_levels_do_not_determine_is_not_reported() -> None:
    rng = np.random.default_rng(6)
    fit = photon_fit(7, dict(zip(range(20), np.exp(rng.uniform(-1.5, 1.5, 20)), strict=True)))
    assert fit.response_bend_percent is None and fit.brighter_fatter_percent is None
    assert any("curvature of the response" in remark for remark in fit.remarks)
    # The error of the line is of the size of its deviations, and so is what is not known of it
    assert fit.linearity_error_percent_std > 0.05 * fit.linearity_error_percent
