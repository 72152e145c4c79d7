"""Trefoil against plain formulas: its three arms, its mean square slope, the light that it keeps."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.trefoil import Trefoil
from sim.optics.pupil import pupil_otf, seidel
from sim.stages import Image
from tests.sim.test_stop_down import CAMERA


def _path(effect: Trefoil):
    return effect.on_image(Image(CAMERA)).wavefront(550.0)


def _otf(effect: Trefoil, fx, fy):
    return pupil_otf(np.atleast_1d(fx), np.atleast_1d(fy), 550.0, 4.0, _path(effect))


def test_a_turn_by_a_third_leaves_it_as_it_is() -> None:
    """r^3 (Wx cos 3t + Wy sin 3t)."""
    angle, radius = np.linspace(0.0, 2.0 * np.pi, 25), 0.7
    path = _path(Trefoil(w333_x_um=0.3, w333_y_um=-0.2))
    wanted = radius**3 * (0.3 * np.cos(3.0 * angle) - 0.2 * np.sin(3.0 * angle))
    np.testing.assert_allclose(path(radius * np.cos(angle), radius * np.sin(angle)), wanted, atol=1e-12)


def test_the_transfer_has_three_arms_and_no_shift() -> None:
    """Alike after 120 degrees, and real along rows (W is even in y). Along columns the mean path difference of the two
    pupils, s apart in radii, is 3 W s <x^2 - y^2> = -2 W s^2 / pi over their overlap: the phase goes with the square of
    the frequency, where a shift's is in proportion. At s = 0.02 the next terms, 2 s / pi of it for the overlap's area
    and s pi / 8 for s^3 / 4, are 1.3 and 0.8 %."""
    effect, f = Trefoil(w333_x_um=0.2), np.array([0.06])
    turn = 2.0 * np.pi / 3.0
    np.testing.assert_allclose(_otf(effect, f, 0.0), _otf(effect, f * np.cos(turn), f * np.sin(turn)), atol=1e-9)
    assert abs(np.imag(_otf(effect, 0.0, f))[0]) < 1e-9
    s = 0.02
    phase = float(np.angle(_otf(effect, s / (2.0 * 0.55 * 4.0), 0.0))[0])
    assert abs(phase) == pytest.approx(2.0 * np.pi / 0.55 * 0.2 * 2.0 * s**2 / np.pi, rel=0.03)


def test_a_weak_one_loses_contrast_as_its_mean_square_slope() -> None:
    """Rays land 2 N dW/dx off; dW/dx = 3 (x^2 - y^2) has mean 0 and mean square 3/2 over the pupil. The next term is a
    sixth of the loss squared, below 1 %; the pupils' overlap at 1 % of the cutoff leaves 3 % out."""
    effect, f = Trefoil(w333_x_um=1.0), np.array([0.004])
    kept = abs(_otf(effect, f, 0.0)[0]) / abs(pupil_otf(f, 0.0 * f, 550.0, 4.0, seidel())[0])
    assert 1.0 - kept == pytest.approx(2.0 * np.pi**2 * f[0] ** 2 * (8.0 * 1.0) ** 2 * 1.5, rel=0.06)


def test_it_keeps_the_light_and_the_place() -> None:
    assert _otf(Trefoil(w333_x_um=0.5, w333_y_um=0.3), 0.0, 0.0) == pytest.approx(1.0, abs=1e-12)
    path = _path(Trefoil(w333_x_um=0.5, w333_y_um=0.3))
    assert path.tilt_um == (0.0, 0.0)


def test_absent_it_is_the_lens_alone() -> None:
    image = Image(CAMERA)
    assert Trefoil().on_image(image) is image
