"""Weighted lines: dark means, linearity."""

from __future__ import annotations

import numpy as np
import pytest

from lab.measure.weighted_lines import dark_line, linearity


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
