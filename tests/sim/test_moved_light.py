"""Displaced light: the lens's geometry acts on the scene before the blur; wavelengths that are displaced differently
blur.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest

from sim.camera import CameraModel
from sim.effects.lateral_chromatic_aberration import LateralChromaticAberration
from sim.frame import Exposure, expected_electrons
from sim.point import dispersal, optical_transfer
from sim.scene import EdgeRegion, KnifeEdge, Scene, ScreenPattern, Warp
from sim.spectrum import FloatArray, Spectrum
from sim.stages import Image
from tests.sim.local_effects import Local

LIGHT = Spectrum.of([380.0, 780.0], [1e-6, 1e-6])
RED = Spectrum.of([630.0, 640.0, 650.0], [0.0, 0.5, 0.0])


class Magnified(Local):
    """The image, larger by `percent`, at all wavelengths."""

    name: ClassVar[str] = "test_magnified"
    percent: float = 0.0

    def on_image(self, image: Image) -> Image:
        def shift(x_um: FloatArray, y_um: FloatArray, wavelength_nm: float) -> tuple[FloatArray, FloatArray]:
            return self.percent / 100.0 * x_um, self.percent / 100.0 * y_um

        return image.add_laws(shift=shift)


@pytest.fixture
def mono(colour_camera: CameraModel) -> CameraModel:
    return colour_camera.model_copy(update={"rows": 49, "cols": 65, "cfa": "MONO", "quantum_efficiency": {"Y": RED}})


def _screen(scale: float) -> Scene:
    """11 x 15 cells of 4 px about the frame's middle, scaled about it."""
    pattern = np.random.default_rng(3).integers(0, 2, (11, 15)).astype(np.uint8)
    half_y, half_x = 22.0 * scale, 30.0 * scale
    warp = Warp.from_corners(11, 15, [(24 - half_y, 32 - half_x), (24 - half_y, 32 + half_x),
                                      (24 + half_y, 32 + half_x), (24 + half_y, 32 - half_x)])  # fmt: skip
    return ScreenPattern(pattern, warp, LIGHT.scale(0.01), LIGHT)


def _edge(scale: float) -> Scene:
    """An edge of 8 degrees, 5 px off the frame's middle, as the same magnification leaves it."""
    return KnifeEdge((EdgeRegion((0, 0, 49, 65), 8.0, 5.0 * scale),), LIGHT.scale(0.01), LIGHT)


@pytest.mark.parametrize(("scene", "rms"), [(_screen, 3e-3), (_edge, 1e-6)])
def test_magnifying_the_scene_leaves_the_blur_as_it_is(mono: CameraModel, scene, rms: float) -> None:  # type: ignore[no-untyped-def]
    """A scene magnified by the lens is the larger scene: exactly for an edge's profile, and for a screen as nearly as
    one is drawn with 3 samples a pixel. Were the blurred image magnified, the blur would be 5 % wider: 5e-3.
    """
    by_lens = expected_electrons(mono, Exposure(scene(1.0), 1.0), (Magnified(percent=5.0),))
    larger = expected_electrons(mono, Exposure(scene(1.05), 1.0))
    inside = slice(4, -4), slice(4, -4)
    away = np.abs(by_lens - larger)[inside] / np.ptp(larger)
    assert np.sqrt(np.mean(away**2)) < rms


def test_two_lines_that_land_apart_are_a_double_image(mono: CameraModel) -> None:
    """Two narrow lines of equal electrons, 2 a apart at a place: |H / H without| = |cos(2 pi a f)| where the lens
    passes both alike.
    """
    wavelength_nm = np.array([540.0, 560.0])
    one = LateralChromaticAberration(slope_um=20.0)
    place = (0.5 * mono.half_diagonal_um, 0.0)
    f = np.linspace(0.0, 0.6, 13)
    factor = dispersal(mono, wavelength_nm, np.array([[0.5, 0.5]]), f, 0.0 * f, (one,), [place])
    assert factor is not None
    half_apart_px = 0.5 * 20.0 * 0.1 / mono.pixel_pitch_um
    np.testing.assert_allclose(factor[0].mean(axis=0), np.cos(2 * np.pi * half_apart_px * f), atol=1e-12)
    np.testing.assert_allclose(np.abs(factor), 1.0, atol=1e-12)


def test_lateral_colour_blurs_a_channel_along_the_radius_alone(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """At a place on the x axis contrast is lost along x, by 2 (pi f)^2 times the variance of the shift over the
    channel's light; none is along y, and none in the middle.
    """
    one = LateralChromaticAberration(slope_um=2.0)
    f = np.array([0.05])
    place = (colour_camera.half_diagonal_um, 0.0)

    def kept(fx: FloatArray, fy: FloatArray, at_um: tuple[float, float]) -> float:
        sides = [optical_transfer(colour_camera, "R", lamp, fx, fy, acting, place_um=at_um) for acting in ((one,), ())]
        return float(np.abs(sides[0] / sides[1])[0])

    assert kept(0.0 * f, f, place) == pytest.approx(1.0, abs=1e-9)
    assert kept(f, 0.0 * f, (0.0, 0.0)) == pytest.approx(1.0, abs=1e-9)
    grid_nm = np.arange(380.0, 781.0, 1.0)
    light = lamp.at(grid_nm) * grid_nm * colour_camera.quantum_efficiency["R"].at(grid_nm)
    spread_nm2 = np.average((grid_nm - np.average(grid_nm, weights=light)) ** 2, weights=light)
    variance_px2 = spread_nm2 * (2.0 / 100.0 / colour_camera.pixel_pitch_um) ** 2
    assert 1.0 - kept(f, 0.0 * f, place) == pytest.approx(2.0 * np.pi**2 * 0.05**2 * variance_px2, rel=0.03)


def test_light_that_is_moved_alike_is_not_dispersed(mono: CameraModel) -> None:
    f = np.linspace(0.0, 0.5, 5)
    alike = dispersal(
        mono, np.array([500.0, 600.0]), np.array([[0.5, 0.5]]), f, f, (Magnified(percent=5.0),), [(30.0, 20.0)]
    )
    assert alike is None
