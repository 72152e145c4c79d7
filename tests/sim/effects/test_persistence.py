"""Persistence: what traps took from bright frames comes out by exp(-t / tau), in proportion to short exposures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim.effects.persistence import Persistence
from sim.frame import Exposure, expected_electrons, expected_sequence
from sim.scene.scenes import Darkness, UniformField
from sim.uniform import Uniform
from tests.sim.effects.test_sensor_effects import CAMERA, LIGHT

BRIGHT = Exposure(UniformField(LIGHT), 0.002)
DARK = Exposure(Darkness(), 2.0)
SERIES = [
    BRIGHT,
    replace(BRIGHT, elapsed_s=3.0),
    replace(DARK, elapsed_s=5.0),
    replace(DARK, elapsed_s=20.0, exposure_s=0.5),
    replace(DARK, elapsed_s=90.0),
]


def test_every_frame_before_leaves_its_own_decay() -> None:
    """The sum over all frames before, which a recursion replaces in the code: exact but for rounding."""
    q, tau_s = 0.04, 12.0
    found = [e[10, 10] for e in expected_sequence(CAMERA, SERIES, (Persistence(share_percent=4.0, release_s=tau_s),))]
    read: list[float] = []
    for k, one in enumerate(SERIES):
        total = float(expected_electrons(CAMERA, one)[10, 10])
        for j, before in enumerate(SERIES[:k]):
            since_s = one.elapsed_s - before.elapsed_s - before.exposure_s
            total += q * read[j] * (np.exp(-since_s / tau_s) - np.exp(-(since_s + one.exposure_s) / tau_s))
        read.append(total)
    assert found == pytest.approx(read, rel=1e-12)
    assert read[2] > 2.0 + float(expected_electrons(CAMERA, SERIES[2])[10, 10])


def test_levels_are_those_of_frames() -> None:
    acting = (Persistence(share_percent=4.0, release_s=12.0),)
    frames = [e[10, 10] for e in expected_sequence(CAMERA, SERIES, acting)]
    own = [float(expected_electrons(CAMERA, one)[10, 10]) for one in SERIES]
    begin_s, exposure_s = (np.array([getattr(one, name) for one in SERIES]) for name in ("elapsed_s", "exposure_s"))
    released = Uniform(CAMERA, acting).released_e(begin_s, exposure_s, np.array(frames)[:, None])[:, 0]
    np.testing.assert_allclose(released, np.array(frames) - own, atol=1e-9)


def test_traps_take_no_more_than_the_full_well() -> None:
    """What overflows isn't trapped, and a frame that has no time comes directly after."""
    flood = Exposure(UniformField(LIGHT.scale(100.0)), 1.0)
    _, after = expected_sequence(CAMERA, [flood, DARK], (Persistence(share_percent=10.0, release_s=2.0),))
    own = float(expected_electrons(CAMERA, DARK)[0, 0])
    assert after[0, 0] == pytest.approx(own + 0.1 * CAMERA.full_well_e * (1.0 - np.exp(-1.0)))
