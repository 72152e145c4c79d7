"""EMVA 1288 General: linear and logarithmic cameras whose signal-to-noise ratios are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.standards.emva1288_general import CharacteristicCurve, count_unsaturated

GAIN, EFFICIENCY, READ_DN, FULL = 0.5, 0.6, 3.0, 3000.0
PIXELS, REPEATS = 10_000, 2


def linear_camera(rng: np.random.Generator | None = None, levels: int = 50) -> CharacteristicCurve:
    """A camera of K = 0.5 DN/e, eta = 0.6, that saturates at 3000 DN."""
    top = FULL / GAIN / EFFICIENCY
    light = np.concatenate(
        [[0.0], np.geomspace(2.0, 0.1 * top, levels // 2), np.linspace(0.13, 1.3, levels // 2) * top]
    )
    return camera(light, GAIN * EFFICIENCY * light, GAIN * GAIN * EFFICIENCY * light, FULL, rng)


def camera(
    light: np.ndarray, signal: np.ndarray, shot: np.ndarray, full: float, rng: np.random.Generator | None
) -> CharacteristicCurve:
    lit = signal < full
    variance = np.where(lit, READ_DN**2 + shot, 0.0)
    mean_std = np.sqrt(np.maximum(variance, 1e-4) / PIXELS / REPEATS)
    variance_std = np.maximum(variance, 1e-4) * np.sqrt(2.0 / PIXELS)
    mean = 64.0 + np.minimum(signal, full)
    if rng is not None:
        mean = mean + mean_std * rng.standard_normal(light.size)
        variance = variance + variance_std * rng.standard_normal(light.size)
    return CharacteristicCurve(light, mean, mean_std, variance, variance_std, np.full(light.size, 4.0), int(lit.sum()))


def test_linear_camera_has_the_closed_forms() -> None:
    curve = linear_camera()
    lit = (curve.light > 0) & (curve.light < 0.9 * FULL / GAIN / EFFICIENCY)
    electrons = EFFICIENCY * curve.light
    expected = electrons / np.sqrt((READ_DN / GAIN) ** 2 + electrons)
    np.testing.assert_allclose(curve.snr[lit], expected[lit], rtol=1e-9)
    threshold, _ = curve.threshold()
    noise = READ_DN / GAIN
    # SNR 1: e^2 = noise^2 + e
    assert threshold == pytest.approx((0.5 + np.sqrt(noise**2 + 0.25)) / EFFICIENCY, rel=2e-3)
    saturation, std = curve.saturation()
    assert abs(saturation - FULL / GAIN / EFFICIENCY) < np.sqrt(12.0) * std


def test_logarithmic_camera() -> None:
    """y = A ln(1 + p / p0): slope A / (p + p0), input ratio p A / (p + p0) / sigma, and no photon transfer curve."""
    light = np.concatenate([[0.0], np.geomspace(1.0, 1e6, 121)])
    scale, begin = 300.0, 50.0
    curve = camera(light, scale * np.log1p(light / begin), np.zeros(light.size), np.inf, None)
    # the parabola errs by step^2 / 6 of the third derivative: steps of 12 % of p leave 0.3 % at most
    inner = slice(2, -1)
    expected = light * scale / (light + begin) / READ_DN
    np.testing.assert_allclose(curve.snr[inner], expected[inner], rtol=6e-3)
    with pytest.raises(NotDetermined, match="stays above 1"):
        curve.saturation()


def test_total_ratio_includes_the_nonuniformity() -> None:
    curve = linear_camera()
    k = 20
    assert curve.total_snr[k] == pytest.approx(
        curve.snr[k] * np.sqrt(curve.variance[k] / (curve.variance[k] + 4.0)), rel=1e-9
    )


def test_intervals_hold() -> None:
    """The ratio at a level and the threshold, over 100 draws of means and variances as 10,000 pixels give them."""
    rng, exact = np.random.default_rng(5), linear_camera()
    truth = exact.threshold()[0]
    held = np.zeros(3, int)
    for _ in range(100):
        own = linear_camera(rng)
        value, std = own.threshold()
        held[0] += abs(value - truth) < 1.96 * std
        for place, k in ((1, 10), (2, 40)):
            held[place] += abs(own.snr[k] - exact.snr[k]) < 1.96 * own.snr_std[k]
    assert np.all((held >= 90) & (held <= 99)), held


def test_dark_alone_is_refused() -> None:
    light = np.linspace(0.0, 1e-3, 8)
    curve = camera(light, 0.3 * light, 0.1 * light, FULL, None)
    for figure in (curve.threshold, curve.saturation):
        with pytest.raises(NotDetermined, match="above 1; expose longer"):
            figure()


def test_saturation_is_found_by_codes_by_levels_and_by_noise() -> None:
    """Ten levels, the last three beyond saturation: at the highest code; at a full well below it, whose codes scatter
    by the read-out; and a level that is about to saturate, of which half of the noise is cut off."""
    mean = np.array([64.0, *(64.0 + 3000.0 * np.minimum(np.linspace(0.1, 1.3, 9), 1.0))])
    variance = np.where(mean < 3060.0, 9.0 + 0.5 * (mean - 64.0), 9.0)
    none, codes = np.zeros(10), np.where(mean > 3060.0, 1.0, 0.0)
    assert count_unsaturated(mean, variance, codes) == count_unsaturated(mean, variance, none) == 7
    cut = variance.copy()
    cut[7] *= 0.5
    near = mean.copy()
    near[7] = 3050.0
    assert count_unsaturated(near, cut, none) == 7


def test_logarithmic_and_linear_levels_without_saturation() -> None:
    """A logarithmic curve rises by 1 / 14 of its range in each decade: steps of 5 % of the light are 0.15 % of it."""
    light = np.concatenate([[0.0], np.geomspace(1.0, 1e6, 283)])
    assert (
        count_unsaturated(300.0 * np.log1p(light / 50.0), np.full(light.size, 9.0), np.zeros(light.size)) == light.size
    )
    dim = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 40)])
    assert count_unsaturated(3000.0 * dim, 9.0 + 1500.0 * dim, np.zeros(41)) == 41
