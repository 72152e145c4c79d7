"""Persistence: what traps took from bright frames comes out by exp(-t / tau), in proportion to short exposures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim.effects.image_lag import ImageLag
from sim.effects.persistence import Persistence
from sim.frame import Exposure, expect_sequence, expected_electrons
from sim.scene.scenes import Darkness, UniformField
from sim.stages import charge_of
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
    found = [e[10, 10] for e in expect_sequence(CAMERA, SERIES, (Persistence(share_percent=4.0, release_s=tau_s),))]
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
    frames = [e[10, 10] for e in expect_sequence(CAMERA, SERIES, acting)]
    own = [float(expected_electrons(CAMERA, one)[10, 10]) for one in SERIES]
    begin_s, exposure_s = (np.array([getattr(one, name) for one in SERIES]) for name in ("elapsed_s", "exposure_s"))
    released = Uniform(CAMERA, acting).released_e(begin_s, exposure_s, np.array(frames)[:, None])[:, 0]
    np.testing.assert_allclose(released, np.array(frames) - own, atol=1e-9)


def test_traps_take_no_more_than_the_full_well() -> None:
    """What overflows isn't trapped, and a frame that has no time comes directly after."""
    flood = Exposure(UniformField(LIGHT.scale(100.0)), 1.0)
    _, after = expect_sequence(CAMERA, [flood, DARK], (Persistence(share_percent=10.0, release_s=2.0),))
    own = float(expected_electrons(CAMERA, DARK)[0, 0])
    assert after[0, 0] == pytest.approx(own + 0.1 * CAMERA.full_well_e * (1.0 - np.exp(-1.0)))


def _sequence(*acting: Persistence | ImageLag) -> list[float]:
    return [float(e[10, 10]) for e in expect_sequence(CAMERA, SERIES, acting)]


def test_two_kinds_are_two_effects() -> None:
    """Kinds that have room fill and empty by themselves: what both release is the sum, but for what the charge that
    was released fills again."""
    one, other = Persistence(share_percent=0.2, release_s=12.0), Persistence(share_percent=0.1, release_s=200.0)
    both = Persistence(share_percent=0.2, release_s=12.0, slow_percent=0.1, slow_release_s=200.0)
    own = np.array([float(expected_electrons(CAMERA, e)[10, 10]) for e in SERIES])
    apart = (np.array(_sequence(one)) - own) + (np.array(_sequence(other)) - own)
    np.testing.assert_allclose(np.array(_sequence(both)) - own, apart, atol=0.003 * apart.max())


def test_traps_hold_no_more_than_their_capacity() -> None:
    """A full well leaves (1 - exp(-3)) / 3 of what it would without a limit, a faint frame all; and charge is
    conserved: exposures without a gap give all back that was taken."""
    full_well_e, q = CAMERA.full_well_e, 0.1
    law = Persistence(share_percent=10.0, release_s=2.0, fullness=3.0)
    (traps,) = charge_of(CAMERA, (law,)).traps
    empty = np.zeros(1)
    assert traps.fill(empty, np.array([full_well_e]))[0] == pytest.approx(q * full_well_e * (1.0 - np.exp(-3.0)) / 3.0)
    assert traps.fill(empty, np.array([1.0]))[0] == pytest.approx(q, rel=2e-4)
    full = traps.fill(empty, np.full(1, 1e9))
    assert full[0] == pytest.approx(q * full_well_e / 3.0)
    assert traps.fill(full, np.full(1, 1e9)) == pytest.approx(full)
    held, released = traps.fill(empty, np.array([5000.0])), 0.0
    taken = float(held[0])
    for _ in range(60):
        out, held = traps.release(held, 0.0, 1.0)
        released += float(out[0])
    assert released + float(held[0]) == pytest.approx(taken, rel=1e-12)
    assert released == pytest.approx(taken, rel=1e-12)  # 60 s are 30 time constants


def test_lag_that_grows_with_the_charge_is_of_full_pixels() -> None:
    """Its share of a full well is the stated one; at a tenth of it and a power of 2 a hundredth of that. None is lost:
    what a frame lacks the next has."""
    law = charge_of(CAMERA, (ImageLag(lag_percent=4.0, growth=2.0),))
    full_well_e = CAMERA.full_well_e
    found = law.hold_lag(np.array([full_well_e, 0.1 * full_well_e]))
    np.testing.assert_allclose(found, [0.04 * full_well_e, 4e-4 * 0.1 * full_well_e])
    own = [float(expected_electrons(CAMERA, e)[10, 10]) for e in SERIES]
    read = _sequence(ImageLag(lag_percent=4.0, growth=2.0))
    left = float(np.asarray(law.hold_lag(np.array(read[-1]))))  # the last frame is dark: less than 1e-3 e
    assert sum(read) == pytest.approx(sum(own), abs=max(1e-3, left))
