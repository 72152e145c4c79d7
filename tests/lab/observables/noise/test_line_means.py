"""Row noise in the means of frames: its covariance between channels against drawn frames."""

from __future__ import annotations

import numpy as np
import pytest

from lab.observables.flats.linearity import measure_photon_transfer
from lab.observables.noise.line_means import LineMeans
from sim.effects.row_noise import RowNoise
from sim.sensor import mosaic
from sim.sensor.lines import LineNoise
from tests.lab.diagnose.on_blocks import dataset, rendered

DRAWS = 4000


@pytest.mark.parametrize("correlation", [0.0, 0.5, -0.5])
def test_means_scatter_as_drawn_rows_do(correlation: float) -> None:
    """Covariances of N draws within 4 sqrt(2 / N) of the largest variance."""
    at = dataset(rendered(3))
    capture = at.recordings.captures("flat", "left")[0]
    effects = (RowNoise(noise_e=3.0, correlation=correlation),)
    jacobian = np.array(list(LineMeans(at, [(capture, c) for c in at.channels]).jacobian(effects).values()))
    rng, shape, step = np.random.default_rng(5), (at.camera.rows, at.camera.cols), mosaic.step(at.camera.cfa)
    noise = LineNoise("rows", 3.0, correlation)
    means = np.zeros((DRAWS, len(at.channels)))
    for k in range(DRAWS):
        rows = at.noise.gain * noise.draw(shape, rng)[:, 0]
        for i, channel in enumerate(at.channels):
            phases = mosaic.phases(at.camera.cfa)[channel]
            means[k, i] = np.mean([rows[row::step].mean() for row, _ in phases])
    expected = jacobian.T @ jacobian
    assert (
        np.abs(np.cov(means.T) - expected).max()
        < 4.0 * np.sqrt(2.0 / DRAWS) * expected.max() + _ends(at.camera.rows) * expected.max()
    )


def _ends(rows: int) -> float:
    """First-order correction of a mean over a finite number of correlated rows against the spectrum at 0: 2 / rows for
    |correlation| = 1/2."""
    return 2.0 / rows


def test_flats_of_a_camera_without_line_noise_have_no_such_terms() -> None:
    at = dataset(rendered(3))
    block = measure_photon_transfer(at)
    assert not [name for name in block.predict(()).jacobian if name.startswith("rows:")]
    assert [name for name in block.predict((RowNoise(noise_e=2.0),)).jacobian if name.startswith("rows:")]
