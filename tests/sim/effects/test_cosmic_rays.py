"""Cosmic rays: their number, their charge, and how long their tracks are."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.cosmic_rays import CosmicRays
from sim.frame import Exposure, read_out
from sim.scene.scenes import Darkness
from sim.sensor.particles import MOYAL_MEAN, TRACK_E_PER_UM, TRACK_WIDTH, Particles
from tests.sim.effects.test_sensor_effects import CAMERA

PITCH_UM = 5.0


def test_charge_of_tracks_is_that_of_their_paths() -> None:
    """Mean path of depth / c over the density 4 c^3: 4 / 3 of the depth; its variance is 2 - 16 / 9, and the loss's
    pi^2 / 2 of its width squared. N = 2000 events."""
    law = Particles(1.0, 20.0, 0.0, 1.0)
    wanted = 4.0 / 3.0 * 20.0 * TRACK_E_PER_UM * (1.0 + TRACK_WIDTH * MOYAL_MEAN)
    spread = np.hypot(np.sqrt(2.0) * np.sqrt(2.0 - 16.0 / 9.0) / (4.0 / 3.0), TRACK_WIDTH * np.pi / np.sqrt(2.0))
    assert law.moments_e(PITCH_UM)[0] == pytest.approx(wanted, rel=4.0 * spread / np.sqrt(2000.0))


def test_a_track_is_a_straight_line_of_neighbouring_pixels() -> None:
    rng, law = np.random.default_rng(7), Particles(1.0, 200.0, 0.0, 1.0)
    longest = 0.0
    for _ in range(100):
        rows, cols, electrons = law.draw_event(rng, PITCH_UM)
        assert np.all(electrons > 0.0)
        order = np.lexsort((rows, cols)) if np.ptp(cols) >= np.ptp(rows) else np.lexsort((cols, rows))
        steps = np.maximum(np.abs(np.diff(rows[order])), np.abs(np.diff(cols[order])))
        assert steps.max(initial=1) <= 2  # a corner that is cut between two places of the track
        if rows.size > 2:  # all pixels' centres within a pixel's diagonal of a line
            points = np.stack([rows, cols]) - np.mean([rows, cols], axis=1, keepdims=True)
            assert np.linalg.svd(points)[1][1] / np.sqrt(rows.size) < np.sqrt(0.5)
        longest = max(longest, float(np.hypot(np.ptp(rows), np.ptp(cols))))
    assert longest > 40.0  # 200 um at 45 degrees are 40 px


def test_frames_have_the_stated_number_and_moments() -> None:
    """400 points in 40 frames, at 10 a frame: their number within four standard deviations of Poisson; the mean of a
    pixel is that of `read_out`."""
    camera = CAMERA.model_copy(update={"read_noise_e": 0.0})
    area_cm2 = camera.rows * camera.cols * (1e-4 * camera.pixel_pitch_um) ** 2
    effect = CosmicRays(rate_per_cm2_s=5.0 / area_cm2, point_share=1.0, point_e=1000.0)
    out = read_out(camera, Exposure(Darkness(), 2.0), (effect,))
    assert out.added is not None
    rng = np.random.default_rng(8)
    frames = [out.added((camera.rows, camera.cols), rng) for _ in range(40)]
    number = sum(int(np.count_nonzero(frame)) for frame in frames)
    assert number == pytest.approx(400, abs=4.0 * np.sqrt(400.0) + 5)  # a few fall on one pixel
    assert float(np.mean(frames)) == pytest.approx(float(np.mean(out.added_e)), rel=4.0 * np.sqrt(2.0 / 400.0))


def test_twice_the_exposure_has_twice_the_events_and_none_are_none() -> None:
    law = Particles(3.0, 10.0, 0.5, 100.0)
    assert law.expected_number(10_000, 10.0, 2.0) == pytest.approx(3.0 * 2.0 * 0.01)
    assert read_out(CAMERA, Exposure(Darkness(), 2.0), (CosmicRays(),)).added is None
