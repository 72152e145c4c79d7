"""Noise that neighbours share: the correlations that are stated are drawn, and unequal capacitance has its kernel's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import convolve2d

from sim.effects.brighter_fatter import BrighterFatter
from sim.effects.inter_pixel_capacitance import InterPixelCapacitance
from sim.sensor.electrons import NEIGHBOURS, interpolate_passed_shares, share_departures, solve_passed_share
from sim.stages import charge_of
from tests.sim.effects.test_sensor_effects import CAMERA

SIDE = 1024


def _autocorrelation(shares: np.ndarray) -> np.ndarray:
    """Correlation of white noise that takes over these shares (5,) of its neighbours, by kind."""
    kernel = np.zeros((5, 5))
    kernel[2, 2] = 1.0
    for share, places in zip(shares, NEIGHBOURS, strict=True):
        for down, right in places:
            kernel[2 + down, 2 + right] = share
    whole = convolve2d(kernel, kernel)
    return np.array([whole[4 + down, 4 + right] for (down, right), *_ in NEIGHBOURS]) / whole[4, 4]


@pytest.mark.parametrize(
    "stated",
    [
        (0.0, 0.0, 0.0, 0.0, 0.0),
        (0.05, 0.0, 0.0, 0.0, 0.0),
        (0.03, 0.06, 0.02, 0.004, 0.01),
        (0.2, 0.1, 0.05, 0.02, 0.02),
    ],
)
def test_shares_lead_to_the_correlations_that_are_stated(stated: tuple[float, ...]) -> None:
    """The steps leave less than a hundredth of what a correlation is measured to, 3e-4."""
    shares = solve_passed_share(np.array(stated)[:, None])[:, 0]
    np.testing.assert_allclose(_autocorrelation(shares), stated, atol=3e-6)


def test_capacitance_shares_noise_as_its_kernel_shares_charge() -> None:
    """Unequal axes and corners: the shares are the kernel over its middle, and so every other correlation is right."""
    one = InterPixelCapacitance(share_percent=1.5, row_excess=0.4, corner_share=0.3)
    charge = charge_of(CAMERA, (one,))
    kernel = one.kernel()
    shares = solve_passed_share(charge.neighbour_correlation(np.array([1000.0])))[:, 0]
    wanted = np.array([kernel[1, 0], kernel[0, 1], kernel[0, 0], 0.0, 0.0]) / kernel[1, 1]
    np.testing.assert_allclose(shares, wanted, atol=1e-6)
    # variance of white noise through the kernel
    assert charge.shot_e2(np.array([1000.0]))[0] == pytest.approx(1000.0 * np.sum(np.square(kernel)), rel=1e-12)


def test_equal_axes_without_corners_are_the_textbooks_kernel() -> None:
    """2 c / (1 - 4 c) of the next pixel, over 1 + 4 c^2 / (1 - 4 c)^2 of the variance."""
    c, one = 0.01, InterPixelCapacitance(share_percent=1.0)
    row, column, corner, *_ = charge_of(CAMERA, (one,)).neighbour_correlation(np.array(1.0))
    own = 1.0 - 4.0 * c
    assert row == pytest.approx(2.0 * c * own / (own**2 + 4.0 * c * c), rel=1e-12)
    assert column == row
    assert corner == pytest.approx(2.0 * c * c / (own**2 + 4.0 * c * c), rel=1e-12)


def test_brighter_fatter_reaches_corners_and_second_pixels_only_as_a_form() -> None:
    plain = BrighterFatter(loss_percent=10.0, shared_percent=10.0, row_excess=0.2)
    forms = plain.other_forms()
    levels = np.array([0.0, 0.5 * CAMERA.full_well_e, CAMERA.full_well_e])
    own = charge_of(CAMERA, (plain,)).neighbour_correlation(levels)
    assert not own[:, 0].any() and not own[2:].any()
    np.testing.assert_allclose(own[0], 0.25 * 0.1 * 1.2 * levels / CAMERA.full_well_e)
    corner, second = (charge_of(CAMERA, (one,)).neighbour_correlation(levels) for one in forms)
    np.testing.assert_allclose(corner[2, 2], 0.4 * 0.025)
    np.testing.assert_allclose(second[3:, 2], [0.15 * 0.03, 0.15 * 0.02])
    for form in (corner, second):
        np.testing.assert_array_equal(form[:2], own[:2])


def test_drawn_departures_have_these_correlations_and_keep_their_variance() -> None:
    """2^20 pixels: 1e-3 a correlation and 1.4e-3 the variance, of which 4 are allowed."""
    one = BrighterFatter(loss_percent=10.0, shared_percent=20.0, corner_share=0.4, second_share=0.15)
    charge = charge_of(CAMERA, (one,))
    mean = np.full((SIDE, SIDE), 0.8 * CAMERA.full_well_e)
    white = np.sqrt(mean) * np.random.default_rng(3).standard_normal(mean.shape)
    drawn = share_departures(white, mean, interpolate_passed_shares(charge.neighbour_correlation, mean))
    variance = drawn.var()
    assert variance == pytest.approx(mean[0, 0], rel=4.0 * 1.4e-3)
    stated = charge.neighbour_correlation(mean[0, 0])
    for told, ((down, right), *_) in zip(stated, NEIGHBOURS, strict=True):
        there = np.roll(drawn, (-down, -right), axis=(0, 1))
        assert np.mean(drawn * there) / variance == pytest.approx(told, abs=4.0 / SIDE)


def test_charge_that_is_shared_is_conserved() -> None:
    """Of a pixel's excess nothing is lost: the kernel's sum is 1, whatever its axes and corners."""
    one = InterPixelCapacitance(share_percent=3.0, row_excess=-0.7, corner_share=0.9)
    frame = np.full((17, 17), 1000.0)
    frame[8, 8] = 6000.0
    after = charge_of(CAMERA, (one,)).move_charge(frame.copy())
    assert after.sum() == pytest.approx(frame.sum(), rel=1e-12)
    assert after[8, 9] / after[9, 8] == pytest.approx((1000.0 + 5000.0 * 0.009) / (1000.0 + 5000.0 * 0.051), rel=1e-9)
