"""Power spectra of lines, over the level of white noise."""

import numpy as np

from lab.observables.noise.line_spectra import periodogram


def test_tones_are_no_part_of_the_level_of_white_noise() -> None:
    """Two plane waves in the level's band, as in EMVA's simulated camera, leave the level where it is."""
    rng = np.random.default_rng(5)
    rows = cols = 200
    white = 1.8 * rng.standard_normal((rows, cols))
    y, x = np.indices((rows, cols))
    waves = sum(1.5 * np.sin(2.0 * np.pi * f * (x + y)) for f in (0.04, 0.2))
    alone = periodogram(white.astype(np.float32))
    both = periodogram((white + waves).astype(np.float32))
    # a wave at a frequency of the transform takes one mode, whose power is then missing from the mean
    modes = alone.line("rows")[2]
    assert both.line("rows")[2] == modes - 2
    # two of the powers are missing, each of standard deviation and mean of the level: below 3 (2 / modes)
    assert abs(both.level / alone.level - 1.0) < 3.0 * 2.0 / modes
    # a level has `modes` exponential powers: a standard deviation of 1 / sqrt(modes) of it
    assert abs(both.level / 1.8**2 - 1.0) < 3.0 / np.sqrt(modes)
