"""Patterns of flats by spatial frequency: true covariance, rings, fringes of near-infrared light."""

from __future__ import annotations

import numpy as np
import pytest

from lab.observables.flats.pattern import (
    BAND_EDGES,
    OWN_BAND,
    _modes,
    _powers,
    _without_tones,
    measure_flat_pattern,
)
from sim.effects.etaloning import Etaloning
from sim.effects.tree_rings import TreeRings
from tests.lab.diagnose.on_blocks import measured_model, rendered, sigmas

RINGS = TreeRings(amplitude_percent=0.6, period_um=30.0)  # of 10 px
FRINGES = Etaloning(strength_percent=15.0, thickness_um=4.0, wedge_x_um=0.8, wedge_y_um=0.7, bow_um=0.2)


def test_powers_are_those_of_white_pixels() -> None:
    """Independent pixels have their variance in every band: within 3 / sqrt(modes), and the modes are how many
    independent frequencies a band is worth: over 200 images the power scatters by 1 / sqrt(modes), to 3 / sqrt(400);
    of the lowest band with its few frequencies, a tenth more, as surface and lines that are taken out are nearby."""
    rng = np.random.default_rng(2)
    every = np.ones((80, 49), bool)
    drawn = [_powers(2.0 * rng.standard_normal((80, 96)), every) for _ in range(200)]
    power = np.array([[*bands, own] for bands, own in drawn])
    modes = _modes((80, 96))
    np.testing.assert_allclose(power.mean(axis=0), 4.0, rtol=0.0, atol=float(3.0 * 4.0 / np.sqrt(200.0 * modes[0])))
    scatter = power.std(axis=0) / power.mean(axis=0) * np.sqrt(modes)
    assert np.all(np.abs(scatter - 1.0) < 0.1 + 3.0 / np.sqrt(400.0))


def test_a_wave_has_its_power_in_its_band_alone() -> None:
    """A wave of amplitude a has the variance a^2 / 2, in the window's frequencies about its own, all of which lie in
    the band of 0.08 to 0.125 cycles a pixel: the mean over the band's frequencies times their share of all is that.
    The window leaves less than 1e-4 of it in any other band."""
    row, col = np.indices((120, 160))
    wave = 0.01 * np.cos(2.0 * np.pi * (0.07 * row + 0.072 * col))
    bands, own = _powers(1.0 + wave, np.ones((120, 81), bool))
    count = sum(
        low <= np.hypot(fy, fx) < high
        for fy in np.fft.fftfreq(120)
        for fx in np.fft.rfftfreq(160)[2:]
        if abs(fy) * 120 > 1.5
        for low, high in [BAND_EDGES[2:4]]
    )
    # each frequency of the half plane stands for two of 120 x 160
    assert bands[2] * count * 2.0 / (120 * 160) == pytest.approx(0.5e-4, rel=0.02)
    assert max(bands[0], bands[1], bands[3], own) < 1e-4 * bands[2]
    assert OWN_BAND[0] > BAND_EDGES[-1]


def test_stripes_of_one_frequency_are_left_out() -> None:
    """Stripes a fifth as strong as the pixels' own pattern, 400 times its power at their frequency: beside the
    frequencies about theirs the power is that of pixels, within 4 / sqrt(modes); white noise has none in 97 of 100
    images at least (five bands at 1e-4, correlated). Rings have waves of many directions, which are all kept."""
    rng = np.random.default_rng(3)
    row, col = np.indices((120, 160))
    stripes = 0.2 * np.sqrt(2.0) * np.cos(2.0 * np.pi * (0.04 * row + 0.04 * col))
    noise = rng.standard_normal((120, 160))
    used = _without_tones(noise + stripes)
    assert 0 < np.count_nonzero(~used) <= 25
    bands, _ = _powers(noise + stripes, used)
    assert np.all(np.abs(bands - 1.0) < 4.0 / np.sqrt(_modes((120, 160))[:-1]))
    rings = 0.5 * np.cos(2.0 * np.pi * np.hypot(row + 40.0, col + 40.0) / 10.0)
    assert np.count_nonzero(~_without_tones(noise + rings)) < 25
    assert np.mean([_without_tones(rng.standard_normal((80, 96))).all() for _ in range(100)]) >= 0.97


def test_healthy_flats_agree_with_their_covariance() -> None:
    """Chi-squared of the numbers of three cameras: within 4 of its standard deviations."""
    for seed in (1, 2, 3):
        assert abs(sigmas(measured_model(rendered(seed, sweep_to_nm=740), measure_flat_pattern))) < 4.0


@pytest.mark.parametrize(("acting", "last_nm"), [(RINGS, 0), (FRINGES, 800)], ids=["rings", "fringes"])
def test_patterns_are_predicted(acting: TreeRings | Etaloning, last_nm: int) -> None:
    """With the effect within the noise, without it far beyond."""
    model = measured_model(rendered(4, (acting,), sweep_to_nm=last_nm), measure_flat_pattern)
    assert abs(sigmas(model, (acting,))) < 4.0
    assert sigmas(model) > 12.0


def test_fringes_are_those_of_near_infrared_light() -> None:
    """Flats in white light have none: their power stays that of pixels."""
    model = measured_model(rendered(4, (FRINGES,), sweep_to_nm=800), measure_flat_pattern)
    (block,) = model.blocks
    white = np.array([label.condition == "all flats" for label in block.labels])
    away = np.abs(block.value) / np.sqrt(np.diag(block.covariance))
    assert away[white].max() < 4.0
    assert away[~white].max() > 10.0
