"""Gains of columns and rows: one factor a line, of mean 1, on light and noise alike and not on the dark's offset."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.column_gain import ColumnGain
from sim.effects.line_gain import LineGain
from sim.effects.row_gain import RowGain
from sim.frame import Exposure, moments
from sim.scene.scenes import Darkness, UniformField
from sim.sensor.lines import LineGains
from sim.stages import Signal, signal_of
from tests.sim.effects.test_sensor_effects import CAMERA, LIGHT

SHAPE = CAMERA.rows, CAMERA.cols
KINDS = pytest.mark.parametrize("kind", [ColumnGain, RowGain])


@KINDS
def test_a_line_has_one_factor_and_the_frame_the_mean_1(kind: type[LineGain]) -> None:
    gains = signal_of(CAMERA, (kind(gain_percent=3.0, pattern_seed=4),)).gain_map(SHAPE)
    assert gains is not None
    along = gains if kind is RowGain else gains.T
    np.testing.assert_array_equal(along, np.broadcast_to(along[:, :1], along.shape))
    assert gains.mean() == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("lines", ["columns", "rows"])
def test_the_standard_deviation_is_that_of_the_gains(lines: str) -> None:
    """4000 lines: 4 / sqrt(8000) of it; neighbours have nothing in common, to 4 / sqrt(4000)."""
    drawn = LineGains(lines, 0.02, 5).factors((4000, 4000)).ravel()  # type: ignore[arg-type]
    assert drawn.std() == pytest.approx(0.02, rel=4.0 / np.sqrt(8000))
    away = drawn - 1.0
    assert abs(np.mean(away[1:] * away[:-1])) / away.var() < 4.0 / np.sqrt(4000)


@KINDS
def test_light_grows_with_the_gain_and_the_black_level_does_not(kind: type[LineGain]) -> None:
    one = kind(gain_percent=5.0)
    gains = signal_of(CAMERA, (one,)).gain_map(SHAPE)
    assert gains is not None
    dark, _ = moments(CAMERA, Exposure(Darkness(), 0.0), (one,))
    np.testing.assert_allclose(dark, CAMERA.black_level_dn, atol=2e-3)  # of rounding
    plain, plain2 = moments(CAMERA, Exposure(UniformField(LIGHT), 0.01))
    lit, lit2 = moments(CAMERA, Exposure(UniformField(LIGHT), 0.01), (one,))
    black = CAMERA.black_level_dn
    np.testing.assert_allclose(lit - black, gains * (plain - black), atol=2e-3)
    np.testing.assert_allclose(lit2 - 1.0 / 12.0, gains**2 * (plain2 - 1.0 / 12.0), rtol=1e-3)


@KINDS
def test_no_scatter_is_no_law(kind: type[LineGain]) -> None:
    assert kind().on_signal(Signal(CAMERA)) == Signal(CAMERA)


def test_rows_and_columns_are_different_draws_of_one_seed() -> None:
    rows, columns = (LineGains(lines, 0.01, 3).factors((8, 8)).ravel() for lines in ("rows", "columns"))  # type: ignore[arg-type]
    assert np.abs(np.corrcoef(rows, columns)[0, 1]) < 0.99
