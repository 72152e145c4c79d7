"""Levels and dark pixels: their statistics, and lines through them."""

from __future__ import annotations

import numpy as np
import pytest

from lab.observables.darks.pixels import DarkPixels
from lab.observables.noise.stack import Stack, level_statistics
from lab.observables.noise.surface import defective_pixels, shading
from lab.observables.weighted_lines import dark_line, linearity
from sim.camera import Cfa


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


# --- The distribution of the read noise over the pixels ---------------------------------------------------------------


def spread_of(read_dn: np.ndarray, repeats: int) -> DarkPixels:
    rng = np.random.default_rng(2)
    stack = Stack("MONO", 4095, None)
    for _ in range(repeats):
        stack.add(np.rint(100.0 + read_dn * rng.standard_normal(read_dn.shape)).astype(np.uint16))
    dark = DarkPixels("MONO")
    dark.take(stack, 0.01)
    return dark


def test_pixels_that_are_alike_have_no_spread() -> None:
    found = spread_of(np.full((120, 160), 3.0), 4).figures().at_gain(0.5).noise
    assert found is not None
    assert found.rms_e == pytest.approx(6.0, rel=0.01)  # sigma / sqrt(2 x 3 x 19200) = 0.3 %, three of these
    assert found.spread_percent <= 2.0 * found.spread_percent_std
    assert found.noisy_pixels == 0
    assert sum(found.pixels) <= 19200


def test_the_spread_of_read_noise_is_told_from_the_few_repeats_own() -> None:
    rng = np.random.default_rng(3)
    variance = 9.0 * np.clip(1.0 + 0.25 * rng.standard_normal((120, 160)), 0.1, None)
    variance[3, 4] = 2500.0
    found = spread_of(np.sqrt(variance), 6).figures().at_gain(0.5).noise
    assert found is not None
    assert abs(found.spread_percent - 25.0) < 3.5 * found.spread_percent_std
    assert found.noisy_pixels >= 1


# --- Weighted lines: dark means, linearity ----------------------------------------------------------------------------


def test_dark_line_finds_black_and_rate() -> None:
    exposure = np.array([0.001, 0.5, 2.0])
    line = dark_line(exposure, 64.0 + 3.0 * exposure, np.full(3, 0.01))
    assert (line.black, line.rate) == (pytest.approx(64.0), pytest.approx(3.0))
    single = dark_line(np.array([0.1, 0.1]), np.array([64.0, 64.2]), np.array([0.1, 0.1]))
    assert single.rate is None
    assert single.black == pytest.approx(64.1)


def test_linearity_error_of_a_parabola() -> None:
    light = np.linspace(0.05, 0.95, 400)
    found = linearity(light, 3000 * light * (1 - 0.01 * light), 1e-12 * np.eye(400))
    # The relative deviations are those of -x about the line that minimises them, all of 1 % x 0.9 span: an independent
    # minimisation over offset and slope gives their mean modulus.
    basis = np.stack([1 / (light * (1 - 0.01 * light)), 1 / (1 - 0.01 * light)], axis=1)
    rest = 1 - basis @ np.linalg.lstsq(basis, np.ones(400), rcond=None)[0]
    assert found.error_percent == pytest.approx(100 * np.abs(rest).mean(), rel=0.01)


SHARED = {"own darks": 0.0, "one dark": 0.3}  # DN: error of a dark that all levels are less


@pytest.mark.parametrize("dark_dn", SHARED.values(), ids=SHARED)
@pytest.mark.parametrize("departure_percent", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("count", [5, 20, 50])
def test_the_linearity_errors_uncertainty_holds_what_noise_adds(
    count: int, departure_percent: float, dark_dn: float
) -> None:
    """Shot noise of 0.1 % at half of saturation, and responses that depart smoothly or level by level."""
    rng, draws = np.random.default_rng(count), 300
    light = np.linspace(0.07, 0.93, count)
    for shape in (-light, rng.standard_normal(count)):
        response = 1000.0 * light * (1.0 + 0.01 * departure_percent * shape)
        covariance = np.diag(0.5 * light) + dark_dn**2
        truth = linearity(light, response, 0.0 * covariance).error_percent
        noise = np.sqrt(0.5 * light) * rng.standard_normal((draws, count)) + dark_dn * rng.standard_normal((draws, 1))
        found = [linearity(light, response + each, covariance) for each in noise]
        error = np.array([each.error_percent for each in found])
        score = (error - truth) / [each.error_percent_std for each in found]
        # 95 % of 300 draws within two standard deviations, less 3 sqrt(0.95 0.05 / 300) = 3.8 %
        assert np.mean(np.abs(score) < 2.0) > 0.91
        # The rms of 300 scores is known to 1 / sqrt(600) where they are normal; what noise adds has one sign and hardly
        # scatters, and the departure is taken one standard deviation low: up to a third too cautious, a seventh too
        # bold
        assert 0.66 < np.sqrt(np.mean(score**2)) < 1.15 + 3.0 / np.sqrt(2 * draws)
        # From draw to draw: a standard deviation of 300 is known to 4.1 %; that of the nearest smaller departure may
        # differ by a sixth
        stated = np.sqrt(np.mean([each.error_noise_percent**2 for each in found]))
        assert stated == pytest.approx(error.std(), rel=1 / 6 + 3.0 / np.sqrt(2 * draws))


@pytest.mark.parametrize("cfa", ["MONO", "GBRG"])
def test_what_pixels_of_a_row_share_is_told_from_their_own_noise(cfa: Cfa) -> None:
    """Noise of 3 DN of single pixels and of 1 DN of rows, 6 repeats: of each plane 5 contrasts of r rows, whose
    variance is known to sqrt(2 / (5 r)); three of these."""
    rng, rows = np.random.default_rng(8), 160
    stack = Stack(cfa, 4095, None)
    for _ in range(6):
        noise = 3.0 * rng.standard_normal((rows, 200)) + rng.standard_normal((rows, 1))
        stack.add(np.rint(500.0 + noise).astype(np.uint16))
    planes = stack.statistics()
    for plane in planes.values():
        assert plane.row_variance == pytest.approx(1.0, rel=3.0 * np.sqrt(2.0 / (5 * plane.shape[0])) * 1.1)
        # one of 12 of a code by rounding
        own = plane.temporal_variance - plane.row_variance
        assert own == pytest.approx(9.0 + 1.0 / 12.0, rel=3.0 * np.sqrt(2.0 / (5 * plane.pixels)))
