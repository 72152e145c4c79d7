"""The distribution of the read noise over the pixels."""

from __future__ import annotations

import numpy as np
import pytest

from lab.measure.dark_pixels import DarkPixels, read_noise_distribution
from lab.measure.levels import Stack


def spread_of(read_dn: np.ndarray, repeats: int) -> DarkPixels:
    rng = np.random.default_rng(2)
    stack = Stack("MONO", 4095, None)
    for _ in range(repeats):
        stack.add(np.rint(100.0 + read_dn * rng.standard_normal(read_dn.shape)).astype(np.uint16))
    dark = DarkPixels("MONO")
    dark.take(stack, 0.01)
    return dark


def test_pixels_that_are_alike_have_no_spread() -> None:
    found = read_noise_distribution(spread_of(np.full((120, 160), 3.0), 4), 0.5)
    assert found is not None
    assert found.rms_e == pytest.approx(6.0, rel=0.01)  # sigma / sqrt(2 x 3 x 19200) = 0.3 %, three of these
    assert found.spread_percent <= 2.0 * found.spread_percent_std
    assert found.noisy_pixels == 0
    assert sum(found.pixels) <= 19200


def test_the_spread_of_read_noise_is_told_from_the_few_repeats_own() -> None:
    rng = np.random.default_rng(3)
    variance = 9.0 * np.clip(1.0 + 0.25 * rng.standard_normal((120, 160)), 0.1, None)
    variance[3, 4] = 2500.0
    found = read_noise_distribution(spread_of(np.sqrt(variance), 6), 0.5)
    assert found is not None
    assert abs(found.spread_percent - 25.0) < 3.5 * found.spread_percent_std
    assert found.noisy_pixels >= 1
