"""Weighted lines: dark means, linearity."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.weighted_lines import dark_line, linearity


def test_dark_line_finds_black_and_rate() -> None:
    exposure = np.array([0.001, 0.5, 2.0])
    line = dark_line(exposure, 64.0 + 3.0 * exposure, np.full(3, 0.01))
    assert (line.black, line.rate) == (pytest.approx(64.0), pytest.approx(3.0))
    single = dark_line(np.array([0.1, 0.1]), np.array([64.0, 64.2]), np.array([0.1, 0.1]))
    assert single.rate is None
    assert single.black == pytest.approx(64.1)


def test_linearity_error_of_a_parabola() -> None:
    light = np.linspace(0.05, 0.95, 400)
    found = linearity(light, 3000 * light * (1 - 0.01 * light), np.full(400, 1e-6))
    # The relative deviations are those of -x about the line that minimises them, all of 1 % x 0.9 span: an independent
    # minimisation over offset and slope gives their mean modulus.
    basis = np.stack([1 / (light * (1 - 0.01 * light)), 1 / (1 - 0.01 * light)], axis=1)
    rest = 1 - basis @ np.linalg.lstsq(basis, np.ones(400), rcond=None)[0]
    assert found.error_percent == pytest.approx(100 * np.abs(rest).mean(), rel=0.01)
