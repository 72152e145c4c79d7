"""Bit weights against a converter that weighs bit by bit, and as one that lacks two bits."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.bit_weights import PERIOD, BitWeights
from sim.sensor.electrons import ReadOut, dn_moments, sample_from
from sim.stages import Codes
from tests.sim.effects.test_sensor_effects import CAMERA


def _codes(one: BitWeights, dn: np.ndarray) -> np.ndarray:
    return np.rint(one.on_codes(Codes(CAMERA)).convert(dn))


def _approximated(dn: np.ndarray, errors: tuple[float, float, float]) -> np.ndarray:
    """Successive approximation: from the highest bit down, a bit is set where what is left reaches its weight."""
    left, code = dn + 0.5, np.zeros_like(dn)
    for bit in range(11, -1, -1):
        weight = 2.0**bit + (errors[bit] if bit < 3 else 0.0)
        taken = left >= weight
        left, code = left - weight * taken, code + 2.0**bit * taken
    return code


@pytest.mark.parametrize("errors", [(0.3, 0.0, 0.0), (-0.4, 0.5, 0.2), (0.0, 0.0, -0.7), (0.6, -0.6, 0.0)])
def test_codes_are_those_of_a_converter_that_weighs(errors: tuple[float, float, float]) -> None:
    """But for the mean error, which is black level."""
    one = BitWeights(last_dn=errors[0], second_dn=errors[1], third_dn=errors[2])
    dn = np.linspace(100.0, 200.0, 20011)  # no level of these is a threshold
    off = one.thresholds()[0] + 0.5
    np.testing.assert_array_equal(_codes(one, dn + off), _approximated(dn, errors))
    if one.last_dn <= one.second_dn + 1.0:  # no code is missing
        assert off == pytest.approx(-0.5 * sum(errors))


def test_ten_bits_written_as_twelve_are_multiples_of_four() -> None:
    codes = _codes(BitWeights(last_dn=-1.0, second_dn=-2.0), np.linspace(0.1, 800.0, 7919))
    steps = np.unique(np.diff(np.unique(codes)))
    np.testing.assert_array_equal(steps, [4.0])


def test_widths_repeat_and_sum_to_their_period() -> None:
    levels = BitWeights(last_dn=0.2, second_dn=-0.3, pair_dn=0.1, third_dn=0.4).thresholds()
    widths = np.diff(levels)
    np.testing.assert_allclose(widths[:3], [1.2, 0.5, 1.3], atol=1e-12)  # 1 + e0, 1 + e1 - e0, 1 + e0 + pair
    assert widths.sum() == pytest.approx(PERIOD)
    assert np.mean(levels[:-1] - np.arange(PERIOD)) == pytest.approx(-0.5)


def test_moments_are_those_of_frames() -> None:
    """600 000 dark pixels whose noise is 2 DN. Codes twice as wide as others round with a bias that moments leave out:
    0.04 DN. The mean of a single level would be 0.3 DN off.
    """
    camera = CAMERA.model_copy(update={"read_noise_e": 4.0})
    out = ReadOut(codes=BitWeights(third_dn=1.0).on_codes(Codes(camera)).convert)
    frame = sample_from(np.zeros((600, 1000)), camera, np.random.default_rng(5), read_out=out).astype(float)
    mean, variance = dn_moments(np.zeros((1, 1)), camera, read_out=out)
    assert frame.mean() == pytest.approx(float(mean[0, 0]), abs=4.5 * frame.std() / np.sqrt(frame.size) + 0.04)
    assert frame.var() == pytest.approx(float(variance[0, 0]), rel=0.02)
    single = float(out.codes(np.array(camera.black_level_dn)))  # type: ignore[misc]
    assert abs(frame.mean() - single) > 0.1
