"""Masked pixels and overscan: empty without light, the active area as without them, and charge that traps defer."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.base import Effect
from sim.effects.charge_transfer_inefficiency import ChargeTransferInefficiency
from sim.effects.library import effects
from sim.effects.taps import Taps
from sim.frame import Exposure, collect_electrons, dark_electrons, read_out, scene_light
from sim.scene.scenes import Darkness, UniformField
from sim.sensor.electrons import FixedPattern, sample_from
from sim.sensor.margins import NO_MARGINS, Margins
from sim.sensor.trails import Trails
from sim.spectrum import FloatArray
from sim.stages import charge_of
from tests.sim.effects.test_sensor_effects import CAMERA, LIGHT

MARGINS = Margins(masked_rows=(4, 0), masked_cols=(2, 0), overscan_rows=(2, 12), overscan_cols=(0, 10))
BRIGHT = Exposure(UniformField(LIGHT), 0.02, temperature_c=30.0)


def whole(exposure: Exposure, acting: tuple[Effect, ...] = (), margins: Margins = MARGINS) -> FloatArray:
    light = scene_light(CAMERA, exposure.scene, acting)
    return collect_electrons(light, CAMERA, exposure, acting, margins=margins)


@pytest.mark.parametrize(
    ("axis", "output", "margins"),
    [(0, "first", (6, 12)), (0, "last", (12, 6)), (1, "first", (2, 10)), (1, "last", (10, 0))],
)
def test_the_first_overscan_pixel_holds_what_a_fast_trap_defers(
    axis: int, output: str, margins: tuple[int, int]
) -> None:
    """Deferred charge = loss x transfers x signal (Janesick 2001, section 5.2.2) of traps that release within the next
    transfer: 1 - exp(-1 / 0.05) = 1 within 2e-9. The next order is (n loss)^2 = 2.3e-5 of the signal."""
    loss, lines, signal_e = 1e-4, 48, 5000.0
    frame = np.full((lines, lines), signal_e)
    around = (margins, (0, 0)) if axis == 0 else ((0, 0), margins)
    read = Trails(axis, loss, ((1.0, 0.05),), output).clock(np.pad(frame, around), margins)
    along = np.moveaxis(read, axis, 0)[:, 0]
    first, second = (
        (margins[0] + lines, margins[0] + lines + 1) if output == "first" else (margins[0] - 1, margins[0] - 2)
    )
    assert along[first] == pytest.approx(loss * lines * signal_e, abs=(loss * lines) ** 2 * signal_e)
    assert along[second] < (loss * lines) ** 2 * signal_e
    # and nothing before the line that is read first
    before = along[: margins[0]] if output == "first" else along[margins[0] + lines :]
    assert not before.any()


def test_electrons_are_kept_but_for_those_of_traps_that_are_taken_as_empty() -> None:
    """Of n lines of even light N, the law of the active area lacks n loss N / (1 - b) - loss N b / (1 - b)^2, and the
    overscan reads n loss N of it: what is missing is a share loss b / (1 - b) of all but for the first lines. Of traps
    of 1 px, exp(-12) of it is behind the overscan; terms of second order are n loss of it."""
    one, n, held = ChargeTransferInefficiency(parallel_ppm=200.0, release_px=1.0), 48, float(np.exp(-1.0))
    exposure = Exposure(UniformField(LIGHT), 0.02)
    light = scene_light(CAMERA, exposure.scene).scene.sum() * 0.02
    missing = whole(exposure).sum() - whole(exposure, (one,)).sum()
    wanted = 200e-6 * light * (held / (1.0 - held) - held / (1.0 - held) ** 2 / n)
    # the lens shades the last rows by less than 1 %
    assert missing == pytest.approx(wanted, rel=200e-6 * n + 0.01)


def test_overscan_holds_nothing_and_masked_pixels_dark_current() -> None:
    read = whole(BRIGHT)
    assert read.shape == MARGINS.frame_shape(48, 64) == (66, 76)
    inside = MARGINS.surround(np.full((48, 64), 7.0), masked=3.0, overscan=1.0)
    assert np.unique(inside).tolist() == [1.0, 3.0, 7.0]
    dark_e = 10.0 * 0.02
    np.testing.assert_array_equal(read[inside == 1.0], 0.0)
    np.testing.assert_allclose(read[inside == 3.0], dark_e, rtol=1e-12)
    np.testing.assert_array_equal(MARGINS.active(read), whole(BRIGHT, margins=NO_MARGINS))
    np.testing.assert_array_equal(np.unique(dark_electrons(CAMERA, BRIGHT, (), MARGINS)), [0.0, dark_e])


@pytest.mark.parametrize("name", sorted(effects()))
def test_the_active_area_is_that_of_a_frame_without_margins(name: str) -> None:
    """Of every effect, in its means; and a frame of it can be drawn, with nothing but the offset's noise in overscan
    far from the pixels: 20 standard deviations and 10 DN leave room for any noise of the prototypes."""
    (one, *_), *_ = effects()[name].prototypes(CAMERA)
    acting = (one,)
    read = whole(BRIGHT, acting)
    np.testing.assert_allclose(MARGINS.active(read), whole(BRIGHT, acting, NO_MARGINS), rtol=1e-9, atol=1e-9)
    pattern = FixedPattern.draw(CAMERA, np.random.default_rng(2)).surrounded(MARGINS)
    frame = sample_from(
        read, CAMERA, np.random.default_rng(1), pattern,
        dark_electrons=dark_electrons(CAMERA, BRIGHT, acting, MARGINS), gain_db=0.0,
        read_out=read_out(CAMERA, BRIGHT, acting, MARGINS),
    )  # fmt: skip
    assert frame.shape == MARGINS.frame_shape(48, 64)
    assert float(np.median(frame[60:, 70:])) == pytest.approx(100.0, abs=30.0)


def test_saturated_packets_leave_a_full_well_behind() -> None:
    """However much light falls: loss x transfers x full well, and five standard deviations of its noise, 6 %."""
    one = ChargeTransferInefficiency(parallel_ppm=100.0, release_px=0.1)
    first_e = whole(Exposure(UniformField(LIGHT), 10.0), (one,))[6 + 48, 2 + 32]
    lost_e = 1e-4 * 48 * CAMERA.full_well_e
    assert lost_e * (1.0 - 1e-4 * 48) < first_e < lost_e * 1.06


def test_areas_of_amplifiers_stay_those_of_the_active_area() -> None:
    """A step of 40 e at half of the columns: 20 DN. Of 48 rows with 2 e of noise, 1 DN, a column's mean scatters by
    0.15 DN."""
    exposure, acting = Exposure(Darkness(), 0.0), (Taps(offset_e=40.0),)
    frame = sample_from(
        whole(exposure, acting), CAMERA, np.random.default_rng(1), read_out=read_out(CAMERA, exposure, acting, MARGINS)
    ).astype(float)
    step = np.where(np.arange(64) < 32, -10.0, 10.0)
    np.testing.assert_allclose(MARGINS.active(frame).mean(axis=0), 100.0 + step, atol=5 * 0.15)
    np.testing.assert_allclose(frame[:, 66:].mean(axis=0), 100.0, atol=5 * 0.15)


def test_a_profile_is_clocked_as_the_frame_is() -> None:
    law = ChargeTransferInefficiency(
        parallel_ppm=300.0, release_px=2.0, slow_share=0.3, slow_release_px=8.0, first_row="bottom"
    )
    profile = np.linspace(100.0, 200.0, 48)
    charge = charge_of(CAMERA, (law,))
    around = Margins(overscan_rows=(9, 3))
    frame = around.surround(np.repeat(profile[:, None], 64, axis=1))
    along = charge.clock_profile(0, profile, around)
    np.testing.assert_allclose(along, charge.clock_out(frame, around)[:, 0], rtol=1e-12)
    assert charge.clock_profile(1, np.ones(64), around).sum() == 64.0
