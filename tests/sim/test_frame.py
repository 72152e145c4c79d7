"""Whole frames: means, moments, reproducibility, and the baseline without effects."""

from __future__ import annotations

from typing import ClassVar

import cv2
import numpy as np
import pytest

from sim import frame as sim_frame
from sim.camera import CameraModel, Geometry, Lens
from sim.effects import library
from sim.frame import Exposure, predict_frame, sample
from sim.optics.diffraction import diffraction_otf
from sim.optics.illumination import irradiance_factor, relative_illumination
from sim.point import Blur
from sim.scene import (
    Darkness,
    EdgeRegion,
    KnifeEdge,
    PlanarTarget,
    ReflectanceChart,
    ScreenPattern,
    UniformField,
    Warp,
)
from sim.sensor import mosaic
from sim.sensor.electrons import FixedPattern
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import electron_rate
from tests.sim.local_effects import AngleCut, Birefringent, EveryStage, Local, Shift, scenes


def test_an_edge_by_its_profile_is_the_edge_drawn_and_blurred(mono_camera: CameraModel, lamp: Spectrum) -> None:
    effects = (Birefringent(d_um=2.0), Shift(x_um=0.6, y_um=0.3))
    angle = np.deg2rad(8.0)
    dark = lamp.scale(0.02)
    by_profile = sim_frame.expected_electrons(
        mono_camera, Exposure(KnifeEdge((EdgeRegion((0, 0, 72, 96), 8.0, 1.25),), dark, lamp), 0.05), effects
    )
    # The same as two cells, 1000 px wide: u along the normal (cos, sin) in (col, row), the border at u = 1.
    along, across = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    corner = np.array([47.5, 35.5]) + 1.25 * across - 1000 * across - 500 * along
    warp = Warp.of(np.column_stack([[*(1000 * across), 0.0], [*(1000 * along), 0.0], [*corner, 1.0]]))
    scene = ScreenPattern(np.array([[0, 1]], np.uint8), warp, dark, lamp, kind="slanted_edge")
    drawn = sim_frame.expected_electrons(mono_camera, Exposure(scene, 0.05), effects, oversample=8, margin_px=96)
    # The drawing wraps round 96 px away, where a lens's tails of 1 / (pi^2 d) leave 1e-3 / 2; 8 x 8 samples leave 2e-4.
    error = (drawn - by_profile) / by_profile.max()
    assert np.sqrt(np.mean(error**2)) < 3e-4
    assert np.max(np.abs(error)) < 1.2e-3


def test_blur_conserves_light(mono_camera: CameraModel, lamp: Spectrum) -> None:
    """A small lit square far from the borders: all electrons together are its area's, and where its centre was is
    theirs.
    """
    camera = mono_camera.model_copy(
        update={"dark_current_e_per_s": 0.0, "lens": Lens(f_number=4.0, focal_length_mm=5000.0)}
    )
    square = Warp.from_corners(1, 1, [(30.2, 40.1), (30.2, 46.6), (36.7, 46.6), (36.7, 40.1)])
    scene = ScreenPattern(np.ones((1, 1), np.uint8), square, lamp.scale(0.0), lamp)
    frame = sim_frame.expected_electrons(camera, Exposure(scene, 1.0), (Birefringent(d_um=2.0),), oversample=3)
    light = frame.sum() / electron_rate(camera, "Y", lamp)
    # Diffraction's tails outside the frame (some 35 px away) hold about 2 N lambda / (pi^2 35 p) = 0.4 %; clipping of
    # ringing at 0 adds less.
    assert light == pytest.approx(6.5**2, rel=8e-3)
    row = frame.sum(1) @ np.arange(72) / frame.sum()
    assert row == pytest.approx(33.45, abs=0.05)


def test_a_flat_field_is_rate_times_time_times_cos4(colour_camera: CameraModel, lamp: Spectrum) -> None:
    mean = predict_frame(colour_camera, Exposure(UniformField(lamp), 0.1, gain_db=6.0))
    for channel, places in mosaic.phases("GBRG").items():
        electrons = electron_rate(colour_camera, channel, lamp) * 0.1
        for row0, col0 in places:
            fall = relative_illumination(
                colour_camera, np.arange(row0, 72, 2)[:, None], np.arange(col0, 96, 2)[None, :]
            )
            wanted = 240 + 0.35 * 10**0.3 * (electrons * fall + 3.0 * 0.1)
            np.testing.assert_allclose(mean[row0::2, col0::2], wanted, rtol=1e-10)


def test_a_dark_frame_is_black_and_dark_current(colour_camera: CameraModel) -> None:
    np.testing.assert_allclose(predict_frame(colour_camera, Exposure(Darkness(), 10.0)), 240 + 0.35 * 30.0, rtol=1e-12)
    np.testing.assert_allclose(
        sim_frame.variance(colour_camera, Exposure(Darkness(), 10.0)), 0.35**2 * (30.0 + 2.5**2) + 1 / 12, rtol=1e-12
    )


def test_patches_in_their_middle_are_flat_fields_of_their_radiance(colour_camera: CameraModel, lamp: Spectrum) -> None:
    from sim.scene.colorchecker import reflectances

    camera = colour_camera.model_copy(
        update={"rows": 160, "cols": 240, "lens": Lens(f_number=1.4, focal_length_mm=5000.0)}
    )
    corners = ((1.0, 1.0), (1.0, 238.0), (158.0, 238.0), (158.0, 1.0))
    image = sim_frame.expected_electrons(camera, Exposure(ReflectanceChart(corners, lamp), 1.0))
    white = electron_rate(camera, "G", lamp)
    for index, reflectance in enumerate(reflectances().values()):
        row = round(1 + (index // 6 + 0.435) * 157 / 3.87)
        col = round(1 + (index % 6 + 0.435) * 237 / 5.87)
        planes = mosaic.planes(image[row // 2 * 2 - 4 : row // 2 * 2 + 4, col // 2 * 2 - 4 : col // 2 * 2 + 4], "GBRG")
        for name, plane in planes.items():
            wanted = electron_rate(camera, name[0], lamp, reflectance=reflectance) + 3.0
            # A lens's edge has tails of N lambda / (pi^2 d): 0.15 % at f/1.4 and 17 px from each of four sides.
            assert plane.mean() == pytest.approx(wanted, abs=0.006 * white)


@pytest.mark.parametrize("index", range(6))
def test_samples_scatter_as_expected_and_variance_say(colour_camera: CameraModel, lamp: Spectrum, index: int) -> None:
    exposure = Exposure(scenes(lamp)[index], 0.3, gain_db=3.0)
    mean, variance = sim_frame.moments(colour_camera, exposure)
    np.testing.assert_array_equal(mean, predict_frame(colour_camera, exposure))
    np.testing.assert_array_equal(variance, sim_frame.variance(colour_camera, exposure))
    rng = np.random.default_rng(11 + index)
    electrons = sim_frame.expected_electrons(colour_camera, exposure)
    frames = np.stack([_draw(colour_camera, exposure, electrons, rng) for _ in range(12)])
    n = frames.size
    z = (frames - mean) / np.sqrt(variance)
    # chi^2 of n values has the standard deviation sqrt(2 n), skewness of shot noise adds little: 4.5 of them, and 0.2 %
    # for rounding, which is uniform only where noise is wider than a code (here 1.2 DN).
    assert np.mean(z**2) == pytest.approx(1.0, abs=4.5 * np.sqrt(2.2 / n) + 0.002)
    assert np.mean(z) == pytest.approx(0.0, abs=4.5 / np.sqrt(n))


def _draw(camera: CameraModel, exposure: Exposure, electrons: FloatArray, rng: np.random.Generator) -> FloatArray:
    from sim.sensor.electrons import sample_from

    return sample_from(
        electrons, camera, rng, dark_electrons=sim_frame.dark_electrons(camera, exposure), gain_db=exposure.gain_db
    ).astype(float)


def test_a_sample_is_reproducible_and_carries_the_pattern(colour_camera: CameraModel, lamp: Spectrum) -> None:
    exposure = Exposure(UniformField(lamp), 0.2)
    pattern = FixedPattern(prnu=np.full((72, 96), 0.1), dsnu_e=np.full((72, 96), 40.0))
    one = sample(colour_camera, exposure, np.random.default_rng(3), fixed_pattern=pattern)
    two = sample(colour_camera, exposure, np.random.default_rng(3), fixed_pattern=pattern)
    assert one.dtype == np.uint16
    np.testing.assert_array_equal(one, two)
    mean = predict_frame(colour_camera, exposure)
    wanted = 240 + (mean - 240 - 0.35 * 0.6) * 1.1 + 0.35 * (40.0 + 0.6)
    noise = np.sqrt(sim_frame.variance(colour_camera, exposure) * 1.1)
    assert np.mean(one - wanted) == pytest.approx(0.0, abs=4.5 * noise.max() / np.sqrt(one.size))


@pytest.mark.parametrize("index", range(6))
def test_effects_at_their_absent_values_are_the_baseline_bit_for_bit(
    colour_camera: CameraModel, lamp: Spectrum, index: int
) -> None:
    exposure = Exposure(scenes(lamp)[index], 0.02)

    class Nothing(Local):
        name: ClassVar[str] = "test_nothing"

    absent = (Nothing(), Birefringent())
    np.testing.assert_array_equal(
        predict_frame(colour_camera, exposure), predict_frame(colour_camera, exposure, absent)
    )
    np.testing.assert_array_equal(
        sample(colour_camera, exposure, np.random.default_rng(4)),
        sample(colour_camera, exposure, np.random.default_rng(4), absent),
    )


def test_every_library_effect_absent_is_the_baseline(colour_camera: CameraModel, lamp: Spectrum) -> None:
    effects = tuple(effect() for effect in library.effects().values())
    for scene in scenes(lamp)[1:5]:
        exposure = Exposure(scene, 0.02, elapsed_s=100.0, temperature_c=30.0)
        np.testing.assert_array_equal(
            predict_frame(colour_camera, exposure), predict_frame(colour_camera, exposure, effects)
        )


def test_every_stage_acts_once(colour_camera: CameraModel, lamp: Spectrum) -> None:
    exposure = Exposure(UniformField(lamp), 0.05, temperature_c=2.0, elapsed_s=10.0)
    mean, variance = sim_frame.moments(colour_camera, exposure, (EveryStage(),))
    col = np.arange(0, 96, 2)
    rate = electron_rate(colour_camera, "G", lamp) * 1.1 * 1.1
    fall = relative_illumination(colour_camera, 0.0, col) * (1 + 0.001 * (col - 47.5) * 3.0)
    electrons = (rate * fall + 200.0) * 0.052 + 3.0 * 0.05 + 7.0
    np.testing.assert_allclose(mean[0, ::2], 240 + 5 + 2 + 0.35 * 0.98 * electrons, rtol=1e-9)
    np.testing.assert_allclose(variance[0, ::2], 0.35**2 * (0.5 * electrons * 0.98**2 + 2.5**2) + 1 / 12, rtol=1e-9)


def test_a_filter_that_shifts_with_the_angle_shades_the_corners(colour_camera: CameraModel, lamp: Spectrum) -> None:
    camera = colour_camera.model_copy(update={"lens": Lens(f_number=4.0, focal_length_mm=0.3)})
    effect = (AngleCut(),)
    flat = sim_frame.expected_electrons(camera, Exposure(UniformField(lamp), 1.0), effect)
    from sim.optics.illumination import sin_theta

    for row, col, channel in [(0, 0, "G"), (1, 0, "R"), (0, 1, "B"), (71, 94, "R")]:
        sine = float(sin_theta(camera, row, col))
        wanted = (
            electron_rate(camera, channel, lamp, effect, sin_theta=sine) * relative_illumination(camera, row, col) + 3.0
        )
        # A cubic spline through 17 angles: 1e-5.
        assert flat[row, col] == pytest.approx(wanted, rel=1e-4)
    # A screen all lit is a flat field, edges far outside.
    lit = ScreenPattern(
        np.ones((1, 1)),
        Warp.from_corners(1, 1, [(-300, -300), (-300, 400), (400, 400), (400, -300)]),
        lamp.scale(0.1),
        lamp,
        kind="white",
    )
    screen = sim_frame.expected_electrons(camera, Exposure(lit, 1.0), effect)
    # Blurring a field that varies over the frame, and its wrap at the border, leave 2 % at the corner and 0.1 % inside.
    np.testing.assert_allclose(screen[20:52, 20:76], flat[20:52, 20:76], rtol=2e-3)


def test_a_knife_edge_gives_each_pixel_to_the_nearest_region(colour_camera: CameraModel, lamp: Spectrum) -> None:
    scene = KnifeEdge((EdgeRegion((10, 10, 60, 40), 0.0), EdgeRegion((10, 50, 60, 90), 180.0)), lamp.scale(0.0), lamp)
    image = sim_frame.expected_electrons(colour_camera, Exposure(scene, 1.0))
    level = electron_rate(colour_camera, "G", lamp)
    greens = mosaic.planes(image, "GBRG")["G2"] / level
    # Columns 0..23 dark, 25..44 light; 46..68 light, 71.. dark (180 degrees swaps the sides).
    assert greens[18, 2] < 0.05 and greens[18, 18] > 0.9
    assert greens[18, 28] > 0.9 and greens[18, 46] < 0.05


def test_a_charuco_boards_corners_are_found_where_they_were_put() -> None:
    """OpenCV's detector, an independent judge, on a board at a tilted pose through a distorting lens: within 0.1 px
    rms, without a bias.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    # Six cells to a marker and one on each side: eight texels to the square.
    board = cv2.aruco.CharucoBoard((6, 4), 8.0, 6.0, dictionary)
    texture = (board.generateImage((6 * 8 * 4, 4 * 8 * 4)) > 127).astype(np.uint8)
    assert texture.shape == (128, 192)
    qe = Spectrum.of([400.0, 700.0], [0.5, 0.5])
    geometry = Geometry(
        camera_matrix=((700.0, 0.0, 190.0), (0.0, 700.0, 140.0), (0.0, 0.0, 1.0)),
        distortion=(-0.15, 0.05, 0.001, -0.001, 0.0),
    )
    camera = CameraModel(
        rows=280, cols=380, pixel_pitch_um=3.0, fill_factor=0.9, cfa="MONO", bit_depth=8, black_level_dn=8.0,
        white_level_dn=255.0, conversion_gain_dn_per_e=0.1, full_well_e=1e5, read_noise_e=1.0, dark_current_e_per_s=0.0,
        dsnu_e=0.0, prnu_percent=0.0, quantum_efficiency={"Y": qe}, lens=Lens(f_number=4.0, focal_length_mm=20.0),
        geometry=geometry,
    )  # fmt: skip
    light = Spectrum.of([400.0, 700.0], [1.0, 1.0])
    light = light.scale(1800.0 / electron_rate(camera, "Y", light))
    rotation = cv2.Rodrigues(np.array([0.25, -0.3, 0.08]))[0]
    target = PlanarTarget(
        texture,
        0.25 * 8 / 8,
        tuple(map(tuple, rotation.tolist())),
        (-20.0, -15.0, 110.0),
        geometry,
        light.scale(0.03),
        light,
        1.0,
    )
    frame = np.rint(predict_frame(camera, Exposure(target, 1.0))).astype(np.uint8)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(frame)
    assert ids is not None and len(ids) >= 12
    # Corner k of 5 x 3 stands at 8 mm steps: 32 texels of 0.25 mm.
    k = ids.ravel()
    row, col = target.warp().to_camera((k % 5 + 1) * 32.0, (k // 5 + 1) * 32.0)
    error = corners.reshape(-1, 2) - np.column_stack([col, row])
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.1
    assert np.all(np.abs(error.mean(0)) < 0.03)


@pytest.mark.parametrize("index", range(1, 6))
def test_a_lens_is_diffraction_limited_unless_it_says_otherwise(
    colour_camera: CameraModel, lamp: Spectrum, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The formula that stood here before lenses had imaging models, to the last bit."""
    exposure = Exposure(scenes(lamp)[index], 0.02)
    effects = (Birefringent(d_um=2.1),)
    now = predict_frame(colour_camera, exposure, effects)

    def before(
        self: Blur, wavelength_nm: float, fx: FloatArray, fy: FloatArray, place_um: tuple[float, float] = (0.0, 0.0)
    ) -> FloatArray:
        fx_um, fy_um = fx / self.camera.pixel_pitch_um, fy / self.camera.pixel_pitch_um
        value = diffraction_otf(np.hypot(fx_um, fy_um), wavelength_nm, self.camera.lens.f_number)
        for law in self.image.transfer:
            value = value * law(fx_um, fy_um, wavelength_nm)
        return value

    monkeypatch.setattr(Blur, "at", before)
    np.testing.assert_array_equal(now, predict_frame(colour_camera, exposure, effects))


def test_magnification_dims_a_whole_frame_as_in_iset(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """E = pi T L / (1 + 4 N^2 (1 + |m|)^2), for every kind of scene; the light that doesn't come through the lens
    stays.
    """
    camera = colour_camera.model_copy(update={"dark_current_e_per_s": 0.0})
    ratio = irradiance_factor(4.0, 0.5) / irradiance_factor(4.0)
    for scene in scenes(lamp)[1:]:
        far = sim_frame.expected_electrons(camera, Exposure(scene, 0.02))
        near = sim_frame.expected_electrons(camera, Exposure(scene, 0.02, magnification=-0.5))
        np.testing.assert_allclose(near, ratio * far, rtol=1e-12)
