"""Flicker as a scatter of single frames, against its analytic covariance over the phase: d^2 / 2 cos(2 pi f t), d the
depth, t the time between two rows."""

from __future__ import annotations

import numpy as np
import pytest

from lab.observables.flats.row_light import row_light_scatter, row_light_variance
from sim.effects.light_flicker import LightFlicker
from sim.uniform import Uniform
from tests.lab.diagnose.on_blocks import dataset, former

ROWS, EXPOSURE_S = 96, 2e-3
FLICKER = LightFlicker(modulation_percent=6.0, frequency_hz=100.0, line_time_us=150.0)
DEPTH = 0.06 * float(np.sinc(100.0 * EXPOSURE_S))
PHASE = 2.0 * np.pi * 100.0 * 150e-6 * np.arange(ROWS)


def _model(*effects: LightFlicker) -> Uniform:
    return Uniform(dataset(former(1, kinds=("dark",))).camera, effects)


def test_rows_scatter_together() -> None:
    """Of the mean of four frames, a fourth. Of a sinusoid in few phases the sums are exact."""
    at = np.array([0, 10, 40, 95])
    vectors = row_light_scatter(_model(FLICKER), ROWS, EXPOSURE_S, 4, lambda light: light[:, at])
    wanted = DEPTH**2 / 2.0 * np.cos(PHASE[at][:, None] - PHASE[at]) / 4.0
    np.testing.assert_allclose(np.transpose(vectors) @ np.array(vectors), wanted, atol=1e-12)


def test_a_frames_level_scatters_by_what_its_rows_leave() -> None:
    part = slice(24, 72)
    wanted = DEPTH**2 / 2.0 * abs(np.mean(np.exp(1j * PHASE[part]))) ** 2
    assert row_light_variance(_model(FLICKER), ROWS, EXPOSURE_S, part) == pytest.approx(wanted, rel=1e-9)


def test_steady_light_scatters_nothing() -> None:
    assert row_light_scatter(_model(), ROWS, EXPOSURE_S, 1, lambda light: light) == []
    assert row_light_variance(_model(), ROWS, EXPOSURE_S) == 0.0
