"""Etaloning and tree rings: fringes of a wedge, the visible light's null limit, rings, and that no light is lost."""

from __future__ import annotations

import numpy as np
import pytest

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.etaloning import INDEX, Etaloning
from sim.effects.tree_rings import TreeRings
from sim.frame import Exposure, expected_electrons
from sim.scene.scenes import UniformField
from sim.spectrum import FloatArray, Spectrum
from sim.stages import image_of
from tests.sim.effects.test_sensor_effects import CAMERA

NEAR_IR = np.arange(380.0, 1001.0)
FLAT = Spectrum.of(NEAR_IR, np.full(NEAR_IR.shape, 0.5))


def _camera(rows: int = 60, cols: int = 80) -> CameraModel:
    curves = dict.fromkeys(CAMERA.channels, FLAT)
    return CAMERA.model_copy(update={"rows": rows, "cols": cols, "quantum_efficiency": curves})


def _pattern(effect: Effect, light: Spectrum, camera: CameraModel) -> FloatArray:
    """Electrons in even light over those without the effect."""
    plain, with_it = (
        expected_electrons(camera, Exposure(UniformField(light), 0.01), acting) for acting in ((), (effect,))
    )
    dark = camera.dark_current_e_per_s * 0.01
    return np.asarray((with_it - dark) / (plain - dark))


def _line(nm: float) -> Spectrum:
    """Return light of one wavelength: a triangle of 0.1 nm."""
    return Spectrum.of(nm + np.array([-0.1, 0.0, 0.1]), np.array([0.0, 1.0, 0.0]))


def test_a_wedge_has_fringes_of_half_a_wavelength() -> None:
    """From crest to crest the thickness grows by wavelength / 2 n: a wedge of 1 um has 2 n / 0.9 fringes over the
    frame. Their amplitude is a exp(-2 L alpha) with alpha = 0.0306 / um at 900 nm, L between 5 and 6 um: the factor
    follows the cosine to the interpolation's 1e-4 of it, over its own mean."""
    camera = _camera()
    effect = Etaloning(strength_percent=20.0, thickness_um=5.5, wedge_x_um=1.0, wedge_y_um=0.0, bow_um=0.0)
    found = _pattern(effect, _line(900.0), camera)
    thickness = 5.5 + (np.arange(80) - 39.5) / 80.0
    wanted = 1.0 + 0.2 * np.exp(-2.0 * thickness * 0.0306) * np.cos(4.0 * np.pi * INDEX * thickness / 0.9)
    # the triangle's mean over 0.1 nm turns the phase by 0.02: a relative 2e-4 of the amplitude
    np.testing.assert_allclose(found, np.broadcast_to(wanted / wanted.mean(), found.shape), atol=2e-3 * 0.2)
    crests = np.count_nonzero((wanted[1:-1] > wanted[:-2]) & (wanted[1:-1] > wanted[2:]))
    assert crests == pytest.approx(2.0 * INDEX / 0.9, abs=1.0)


def test_visible_and_white_light_have_no_fringes() -> None:
    """At 500 nm exp(-2 L alpha) is exp(-2 x 15 x 1.11) = 3e-15. White light of 620 nm has some 80 fringes in its
    spectrum, over which the cosine averages out to less than 1 / 80 of the amplitude."""
    effect = Etaloning(strength_percent=20.0)
    np.testing.assert_allclose(_pattern(effect, _line(500.0), _camera()), 1.0, atol=1e-12)
    white = _pattern(effect, FLAT, _camera())
    assert np.abs(white - 1.0).max() < 0.2 / 80.0
    assert np.abs(_pattern(effect, _line(950.0), _camera()) - 1.0).max() > 0.05


def test_rings_are_concentric() -> None:
    """About a centre in the frame's middle the factor is the cosine of the distance; the grid of 4800 distances leaves
    (pi / 160)^2 / 2 of the amplitude."""
    camera = _camera()
    effect = TreeRings(amplitude_percent=0.5, period_um=10.0 * camera.pixel_pitch_um, centre_x=0.0, centre_y=0.0)
    found = _pattern(effect, FLAT, camera)
    row, col = np.indices(found.shape)
    distance = np.hypot(row - 29.5, col - 39.5)
    wanted = 1.0 + 0.005 * np.cos(2.0 * np.pi * distance / 10.0)
    np.testing.assert_allclose(found, wanted / wanted.mean(), atol=1e-3 * 0.005)
    np.testing.assert_allclose(found, _pattern(effect, _line(800.0), camera), atol=1e-12)


@pytest.mark.parametrize(
    "effect",
    [Etaloning(strength_percent=30.0, thickness_um=4.0), TreeRings(amplitude_percent=1.0)],
    ids=lambda e: e.name,
)
@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
def test_no_light_is_lost(effect: Effect, cfa: str) -> None:
    """The mean over the frame is that of the quantum efficiency; of a mosaic's colour, of which each has a part of the
    pixels, within the pattern's scatter over as many."""
    curves = dict.fromkeys("Y" if cfa == "MONO" else "RGB", FLAT)
    camera = _camera().model_copy(update={"cfa": cfa, "quantum_efficiency": curves})
    found = _pattern(effect, _line(900.0), camera)
    assert found.std() > 1e-3
    assert found.mean() == pytest.approx(1.0, abs=1e-12 if cfa == "MONO" else 3.0 * found.std() / np.sqrt(found.size))


def test_absent_there_is_no_law() -> None:
    assert image_of(CAMERA, (Etaloning(), TreeRings())).patterns == ()
