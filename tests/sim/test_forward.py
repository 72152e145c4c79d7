from __future__ import annotations

from typing import ClassVar

import cv2
import numpy as np
import pytest
from scipy import integrate

from sim import frame as sim_frame
from sim.camera import CameraModel, Geometry, Lens
from sim.detection import responsivity
from sim.effects import library
from sim.effects.base import Effect
from sim.effects.infrared_cut_filter import InfraredCutFilter
from sim.frame import Exposure, expected, sample
from sim.optics.diffraction import aperture_otf, diffraction_otf
from sim.optics.illumination import irradiance_factor, relative_illumination
from sim.point import TRANSFER, Blur, common_wavelengths, edge_profile, kernel, optical_transfer, wavelength_shares
from sim.scene import (
    Darkness,
    EdgeRegion,
    KnifeEdge,
    PlanarTarget,
    ReflectanceChart,
    Scene,
    ScreenPattern,
    SpectralImage,
    UniformField,
    Warp,
)
from sim.sensor import electrons as sensor
from sim.sensor import mosaic
from sim.sensor.electrons import FixedPattern
from sim.spectrum import FloatArray, Spectrum, photons_from_energy
from sim.stages import Charge, Image, Light, Signal, charge_of
from sim.uniform import Uniform, electron_rate


class Local(Effect):
    """Base of the effects that only these tests know."""

    reference: ClassVar[str] = "tests"
    sentence: ClassVar[str] = "tests"


class Birefringent(Local):
    name: ClassVar[str] = "test_birefringent"
    d_um: float = 0.0

    def on_image(self, image: Image) -> Image:
        return image.adding(
            transfer=lambda fx, fy, wavelength_nm: np.cos(np.pi * fx * self.d_um) * np.cos(np.pi * fy * self.d_um)
        )


class Shift(Local):
    name: ClassVar[str] = "test_shift"
    x_um: float = 0.0
    y_um: float = 0.0

    def on_image(self, image: Image) -> Image:
        return image.adding(
            transfer=lambda fx, fy, wavelength_nm: np.exp(-2j * np.pi * (fx * self.x_um + fy * self.y_um))
        )


class Veil(Local):
    name: ClassVar[str] = "test_veil"
    share: float = 0.0

    def on_image(self, image: Image) -> Image:
        return image.adding(
            transfer=lambda fx, fy, wavelength_nm: np.where(np.hypot(fx, fy) > 0, 1.0 - self.share, 1.0)
        )


class AngleCut(Local):
    """A filter's edge that moves to the blue with the ray's angle."""

    name: ClassVar[str] = "test_angle_cut"

    def on_image(self, image: Image) -> Image:
        return image.adding(transmittance=self.through)

    def through(self, wavelength_nm: FloatArray, sin_theta: FloatArray | float) -> FloatArray:
        cut = 650.0 * np.sqrt(1 - np.asarray(sin_theta) ** 2 / 2.25)
        return 1 / (1 + np.exp((wavelength_nm - cut) / 5.0))


class EveryStage(Local):
    name: ClassVar[str] = "test_every_stage"

    def on_light(self, light: Light) -> Light:
        return light.adding(
            spectrum=lambda wavelength_nm, radiance, kind: radiance * (1.1 if kind == "flat" else 1.0),
            level=lambda elapsed_s: 1.0 + 0.01 * elapsed_s,
            shading=lambda x_um, y_um: 1.0 + 0.001 * x_um + 0.0 * y_um,
            ambient_e_per_s={"R": 100.0, "G": 200.0, "B": 300.0}.__getitem__,
        )

    def on_charge(self, charge: Charge) -> Charge:
        return charge.adding(
            exposure_s=lambda exposure_s: exposure_s + 0.002,
            overflow=lambda electrons: electrons + 7.0,
            variance_e2=lambda electrons, variance_e2: variance_e2 * 0.5,
        )

    def on_signal(self, signal: Signal) -> Signal:
        return signal.adding(
            response=lambda electrons: electrons * 0.98,
            offset_dn=lambda elapsed_s, temperature_c: 0.5 * elapsed_s + (temperature_c or 0.0),
        )


def scenes(lamp: Spectrum) -> list[Scene]:
    pattern = np.random.default_rng(0).integers(0, 2, (20, 20)).astype(np.uint8)
    return [
        Darkness(),
        UniformField(lamp),
        KnifeEdge(
            (EdgeRegion((10, 10, 40, 40), 5.0), EdgeRegion((10, 50, 40, 90), -80.0, 2.5)), lamp.scaled(0.02), lamp
        ),
        ReflectanceChart(((8.0, 10.0), (9.0, 88.0), (64.0, 86.0), (62.0, 8.0)), lamp),
        ScreenPattern(
            pattern, Warp.from_corners(20, 20, [(5, 8), (6, 90), (66, 88), (64, 6)]), lamp.scaled(0.01), lamp
        ),
        planar(pattern, lamp),
    ]


def planar(texture: np.ndarray, lamp: Spectrum) -> PlanarTarget:
    rotation = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0]
    geometry = Geometry(
        camera_matrix=((300.0, 0.0, 48.0), (0.0, 300.0, 36.0), (0.0, 0.0, 1.0)), distortion=(-0.1, 0.02)
    )
    return PlanarTarget(
        texture,
        4.0,
        tuple(map(tuple, rotation.tolist())),
        (-40.0, -40.0, 400.0),
        geometry,
        lamp.scaled(0.02),
        lamp,
        1.0,
    )


# --- spectra -----------------------------------------------------------------------------------------------------------


def test_a_laser_line_gives_the_closed_form(mono_camera: CameraModel) -> None:
    """A line of 1 pm at 550 nm with radiance 0.01 W sr^-1 m^-2. QE's peak has its kink there: 5e-7."""
    line = Spectrum.of([549.999, 550.0, 550.001], [0.0, 10.0, 0.0])
    qe = float(mono_camera.quantum_efficiency["Y"].at(550.0))
    photons = float(photons_from_energy(550.0, 0.01))
    wanted = photons * irradiance_factor(4.0) * (3e-6) ** 2 * 0.9 * 0.9 * qe
    assert electron_rate(mono_camera, "Y", line) == pytest.approx(wanted, rel=1e-6)
    assert electron_rate(mono_camera, "Y", line, magnification=-1.0) == pytest.approx(
        wanted * irradiance_factor(4.0, 1.0) / irradiance_factor(4.0), rel=1e-6
    )


def test_electrons_are_linear_in_light_and_follow_the_aperture(colour_camera: CameraModel, lamp: Spectrum) -> None:
    rate = electron_rate(colour_camera, "G", lamp)
    assert electron_rate(colour_camera, "G", lamp.scaled(3.0)) == pytest.approx(3 * rate, rel=1e-12)
    slow = colour_camera.model_copy(update={"lens": Lens(f_number=8.0, focal_length_mm=8.0, transmittance=0.45)})
    assert electron_rate(slow, "G", lamp) == pytest.approx(rate / 2 * (1 + 4 * 16) / (1 + 4 * 64), rel=1e-12)
    half = Spectrum.of([300.0, 800.0], [0.5, 0.5])
    assert electron_rate(colour_camera, "G", lamp, reflectance=half) == pytest.approx(rate / 2, rel=1e-6)


def test_responsivity_is_the_product_of_its_parts(colour_camera: CameraModel) -> None:
    w = np.array([450.0, 550.0, 655.0])
    plain = responsivity(colour_camera, "R", w)
    np.testing.assert_allclose(plain, colour_camera.quantum_efficiency["R"].at(w) * 0.9)
    sine = np.array([0.0, 0.3])[:, None]
    cut = responsivity(colour_camera, "R", w, (AngleCut(),), sine)
    assert cut.shape == (2, 3)
    np.testing.assert_allclose(cut[1], plain * AngleCut().through(w, 0.3))


class Broken(Local):
    name: ClassVar[str] = "test_broken"

    def on_light(self, light: Light) -> Light:
        return light.adding(
            spectrum=lambda wavelength_nm, radiance, kind: np.where(wavelength_nm == 550.0, np.nan, radiance)
        )


def test_impossible_radiance_is_named(colour_camera: CameraModel, lamp: Spectrum) -> None:
    light = Spectrum.of([500.0, 550.0, 600.0], [1e-3, -1e-5, 1e-3])
    message = r"radiance is {} W sr\^-1 m\^-2 nm\^-1 at 550 nm, below the limit of 0 or not finite: subtract"
    with pytest.raises(ValueError, match=message.format("-1e-05")):
        electron_rate(colour_camera, "G", light)
    with pytest.raises(ValueError, match=message.format("-1e-05")):
        expected(colour_camera, Exposure(UniformField(light), 0.01))
    with pytest.raises(ValueError, match=message.format("nan")):
        electron_rate(colour_camera, "G", lamp, (Broken(),))


def test_other_impossible_input_is_named(colour_camera: CameraModel, lamp: Spectrum) -> None:
    with pytest.raises(ValueError, match=r"exposure -0.1 s is below the limit of 0 s"):
        Exposure(Darkness(), -0.1)
    with pytest.raises(
        ValueError, match=r"channel 'Y' has no quantum efficiency in this GBRG camera \(known: R, G, B\)"
    ):
        electron_rate(colour_camera, "Y", lamp)
    with pytest.raises(ValueError, match="distance from the edge is nan px"):
        edge_profile(colour_camera, "G", lamp, 0.0, [0.0, np.nan])
    with pytest.raises(ValueError, match="support 4 of the kernel has to be odd"):
        kernel(colour_camera, "G", lamp, 4)
    with pytest.raises(ValueError, match="give at least one edge region"):
        expected(colour_camera, Exposure(KnifeEdge((), lamp, lamp), 0.01))


# --- blur --------------------------------------------------------------------------------------------------------------


def test_transfer_is_the_wavelengths_average(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """Ten Gauss wavelengths against 1 nm steps: 1e-4, up to beyond the cutoff."""
    f = np.linspace(0.0, 2.0, 81)
    for channel in "RGB":
        w = np.arange(380.0, 780.5, 1.0)
        weight = photons_from_energy(w, lamp.at(w)) * colour_camera.quantum_efficiency[channel].at(w)
        sums = sum(a * diffraction_otf(f / 3.0, b, 4.0) for a, b in zip(weight / weight.sum(), w, strict=True))
        wanted = sums * aperture_otf(f, 0.0, 0.9)
        np.testing.assert_allclose(optical_transfer(colour_camera, channel, lamp, f, 0 * f), wanted, atol=1e-4)


def test_transfer_in_a_line_is_diffraction_times_aperture_times_the_effect(colour_camera: CameraModel) -> None:
    line = Spectrum.of([549.9, 550.0, 550.1], [0.0, 1.0, 0.0])
    fx, fy = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(0, 1, 5))
    wanted = diffraction_otf(np.hypot(fx, fy) / 3.0, 550.0, 4.0) * aperture_otf(fx, fy, 0.9)
    wanted = wanted * np.cos(np.pi * fx * 0.7) * np.cos(np.pi * fy * 0.7)
    got = optical_transfer(colour_camera, "G", line, fx, fy, (Birefringent(d_um=2.1),))
    np.testing.assert_allclose(got, wanted, atol=1e-6)
    assert got.dtype == complex and got[0, 4] == pytest.approx(1.0)


@pytest.mark.parametrize("angle_deg", [0.0, 7.0, -83.0, 135.0])
def test_edge_profile_is_the_integral_of_its_definition(
    colour_camera: CameraModel, lamp: Spectrum, angle_deg: float
) -> None:
    effects = (Shift(x_um=1.2, y_um=-0.6), Birefringent(d_um=1.5))
    a = np.deg2rad(angle_deg)
    d = np.array([-6.0, -1.3, -0.2, 0.0, 0.35, 0.8, 2.0, 9.0])
    f = np.linspace(1e-6, 2.5, 40_001)
    h = optical_transfer(colour_camera, "G", lamp, f * np.cos(a), f * np.sin(a), effects)
    wanted = [
        0.5
        + integrate.simpson(
            (h.real * np.sin(2 * np.pi * f * x) + h.imag * np.cos(2 * np.pi * f * x)) / (np.pi * f), x=f
        )
        for x in d
    ]
    # The table's period of 1024 px leaves tails of 1e-6; its cubic spline 2e-6; the integral from 0 to 1e-6 cy/px 2e-6 d.
    np.testing.assert_allclose(edge_profile(colour_camera, "G", lamp, angle_deg, d, effects), wanted, atol=3e-5)


def test_edge_profile_of_an_aperture_alone_is_a_ramp(colour_camera: CameraModel) -> None:
    """At f/0.5 and 100 um the lens blurs by 0.003 px: what is left is the square. 64 cy/px end the integral: 1 / (2 pi^2 64)
    = 0.0008 at the ramp's ends, and the lens rounds them by 0.0011."""
    camera = colour_camera.model_copy(
        update={"pixel_pitch_um": 100.0, "fill_factor": 1.0, "lens": Lens(f_number=0.5, focal_length_mm=8.0)}
    )
    d = np.linspace(-1.0, 1.0, 41)
    np.testing.assert_allclose(edge_profile(camera, "G", None, 0.0, d), np.clip(d + 0.5, 0, 1), atol=2.5e-3)


def test_edge_profile_moves_with_the_image(colour_camera: CameraModel, lamp: Spectrum) -> None:
    d = np.linspace(-5.0, 5.0, 101)
    moved = edge_profile(colour_camera, "G", lamp, 30.0, d, (Shift(x_um=3.0, y_um=1.5),))
    along = np.cos(np.deg2rad(30.0)) + 0.5 * np.sin(np.deg2rad(30.0))
    np.testing.assert_allclose(moved, edge_profile(colour_camera, "G", lamp, 30.0, d - along), atol=1e-5)


def test_a_veil_lies_even_on_both_sides_of_an_edge(colour_camera: CameraModel, lamp: Spectrum) -> None:
    d = np.array([-60.0, -2.0, 0.0, 2.0, 60.0])
    clear = edge_profile(colour_camera, "G", lamp, 0.0, d)
    veiled = edge_profile(colour_camera, "G", lamp, 0.0, d, (Veil(share=0.04),))
    np.testing.assert_allclose(veiled, 0.96 * clear + 0.02, atol=1e-6)


def test_a_kernel_is_normalised_centred_and_consistent(colour_camera: CameraModel, lamp: Spectrum) -> None:
    psf = kernel(colour_camera, "G", lamp, 85, 5, (Shift(x_um=1.5, y_um=-0.75),))
    at = (np.arange(85) - 42) / 5
    assert psf.sum() == pytest.approx(1.0, abs=1e-12)
    # The centre of mass moves by 0.5 and -0.25 px; the tails beyond +-8 px and their renormalisation leave 1 %.
    assert (psf.sum(0) @ at, psf.sum(1) @ at) == pytest.approx((0.5, -0.25), abs=0.01)
    plain = kernel(colour_camera, "G", lamp, 85, 5)
    np.testing.assert_allclose(plain, plain[::-1, ::-1], atol=1e-12)
    # What light of a whole pixel does is what its 5 x 5 parts do together.
    coarse = kernel(colour_camera, "G", lamp, 17, 1)
    np.testing.assert_allclose(coarse, plain.reshape(17, 5, 17, 5).sum(axis=(1, 3)), atol=1e-5)


def test_a_coarse_kernel_convolves_pixel_aligned_cells(mono_camera: CameraModel, lamp: Spectrum) -> None:
    """One lit cell of exactly one pixel: the frame around it is the kernel."""
    cell = np.zeros((41, 41), np.uint8)
    cell[20, 20] = 1
    at = np.array([(-0.5, -0.5), (-0.5, 40.5), (40.5, 40.5), (40.5, -0.5)]) + np.array([15.0, 27.0])
    camera = mono_camera.model_copy(update={"dark_current_e_per_s": 0.0})
    scene = ScreenPattern(cell, Warp.from_corners(41, 41, at), lamp.scaled(0.0), lamp)
    frame = sim_frame.expected_electrons(camera, Exposure(scene, 1.0), (Shift(x_um=1.5, y_um=0.0),), oversample=8)
    frame /= electron_rate(camera, "Y", lamp) * relative_illumination(camera, 35.0, 47.0)
    wanted = kernel(camera, "Y", lamp, 33, 1, (Shift(x_um=1.5, y_um=0.0),))
    # The kernel's share outside its support (1 %) is put back by the sum; drawing on 8 x 8 samples leaves 2e-3 of white.
    np.testing.assert_allclose(
        frame[35 - 5 : 35 + 6, 47 - 5 : 47 + 6], wanted[11:22, 11:22] * frame[19:52, 31:64].sum(), atol=3e-3
    )
    assert frame[35, 48] > frame[35, 46]  # moved to the right


# --- frames ------------------------------------------------------------------------------------------------------------


def test_an_edge_by_its_profile_is_the_edge_drawn_and_blurred(mono_camera: CameraModel, lamp: Spectrum) -> None:
    effects = (Birefringent(d_um=2.0), Shift(x_um=0.6, y_um=0.3))
    angle = np.deg2rad(8.0)
    dark = lamp.scaled(0.02)
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
    """A small lit square far from the borders: all electrons together are its area's, and where its centre was is theirs."""
    camera = mono_camera.model_copy(
        update={"dark_current_e_per_s": 0.0, "lens": Lens(f_number=4.0, focal_length_mm=5000.0)}
    )
    square = Warp.from_corners(1, 1, [(30.2, 40.1), (30.2, 46.6), (36.7, 46.6), (36.7, 40.1)])
    scene = ScreenPattern(np.ones((1, 1), np.uint8), square, lamp.scaled(0.0), lamp)
    frame = sim_frame.expected_electrons(camera, Exposure(scene, 1.0), (Birefringent(d_um=2.0),), oversample=3)
    light = frame.sum() / electron_rate(camera, "Y", lamp)
    # Diffraction's tails outside the frame (some 35 px away) hold about 2 N lambda / (pi^2 35 p) = 0.4 %; clipping of ringing
    # at 0 adds less.
    assert light == pytest.approx(6.5**2, rel=8e-3)
    row = frame.sum(1) @ np.arange(72) / frame.sum()
    assert row == pytest.approx(33.45, abs=0.05)


def test_a_flat_field_is_rate_times_time_times_cos4(colour_camera: CameraModel, lamp: Spectrum) -> None:
    mean = expected(colour_camera, Exposure(UniformField(lamp), 0.1, gain_db=6.0))
    for channel, places in mosaic.phases("GBRG").items():
        electrons = electron_rate(colour_camera, channel, lamp) * 0.1
        for row0, col0 in places:
            fall = relative_illumination(
                colour_camera, np.arange(row0, 72, 2)[:, None], np.arange(col0, 96, 2)[None, :]
            )
            wanted = 240 + 0.35 * 10**0.3 * (electrons * fall + 3.0 * 0.1)
            np.testing.assert_allclose(mean[row0::2, col0::2], wanted, rtol=1e-10)


def test_a_dark_frame_is_black_and_dark_current(colour_camera: CameraModel) -> None:
    np.testing.assert_allclose(expected(colour_camera, Exposure(Darkness(), 10.0)), 240 + 0.35 * 30.0, rtol=1e-12)
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
    np.testing.assert_array_equal(mean, expected(colour_camera, exposure))
    np.testing.assert_array_equal(variance, sim_frame.variance(colour_camera, exposure))
    rng = np.random.default_rng(11 + index)
    electrons = sim_frame.expected_electrons(colour_camera, exposure)
    frames = np.stack([_draw(colour_camera, exposure, electrons, rng) for _ in range(12)])
    n = frames.size
    z = (frames - mean) / np.sqrt(variance)
    # chi^2 of n values has the standard deviation sqrt(2 n), skewness of shot noise adds little: 4.5 of them, and 0.2 % for
    # rounding, which is uniform only where noise is wider than a code (here 1.2 DN).
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
    mean = expected(colour_camera, exposure)
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
    np.testing.assert_array_equal(expected(colour_camera, exposure), expected(colour_camera, exposure, absent))
    np.testing.assert_array_equal(
        sample(colour_camera, exposure, np.random.default_rng(4)),
        sample(colour_camera, exposure, np.random.default_rng(4), absent),
    )


def test_every_library_effect_absent_is_the_baseline(colour_camera: CameraModel, lamp: Spectrum) -> None:
    effects = tuple(effect() for effect in library.effects().values())
    for scene in scenes(lamp)[1:5]:
        exposure = Exposure(scene, 0.02, elapsed_s=100.0, temperature_c=30.0)
        np.testing.assert_array_equal(expected(colour_camera, exposure), expected(colour_camera, exposure, effects))


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
        lamp.scaled(0.1),
        lamp,
        kind="white",
    )
    screen = sim_frame.expected_electrons(camera, Exposure(lit, 1.0), effect)
    # Blurring a field that varies over the frame, and its wrap at the border, leave 2 % at the corner and 0.1 % inside.
    np.testing.assert_allclose(screen[20:52, 20:76], flat[20:52, 20:76], rtol=2e-3)


def test_a_knife_edge_gives_each_pixel_to_the_nearest_region(colour_camera: CameraModel, lamp: Spectrum) -> None:
    scene = KnifeEdge((EdgeRegion((10, 10, 60, 40), 0.0), EdgeRegion((10, 50, 60, 90), 180.0)), lamp.scaled(0.0), lamp)
    image = sim_frame.expected_electrons(colour_camera, Exposure(scene, 1.0))
    level = electron_rate(colour_camera, "G", lamp)
    greens = mosaic.planes(image, "GBRG")["G2"] / level
    # Columns 0..23 dark, 25..44 light; 46..68 light, 71.. dark (180 degrees swaps the sides).
    assert greens[18, 2] < 0.05 and greens[18, 18] > 0.9
    assert greens[18, 28] > 0.9 and greens[18, 46] < 0.05


def test_a_charuco_boards_corners_are_found_where_they_were_put() -> None:
    """OpenCV's detector, an independent judge, on a board at a tilted pose through a distorting lens: within 0.1 px rms, without a bias."""
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
        dsnu_e=0.0, prnu_percent=0.0, quantum_efficiency={"Y": qe}, lens=Lens(f_number=4.0, focal_length_mm=20.0), geometry=geometry,
    )  # fmt: skip
    light = Spectrum.of([400.0, 700.0], [1.0, 1.0])
    light = light.scaled(1800.0 / electron_rate(camera, "Y", light))
    rotation = cv2.Rodrigues(np.array([0.25, -0.3, 0.08]))[0]
    target = PlanarTarget(
        texture,
        0.25 * 8 / 8,
        tuple(map(tuple, rotation.tolist())),
        (-20.0, -15.0, 110.0),
        geometry,
        light.scaled(0.03),
        light,
        1.0,
    )
    frame = np.rint(expected(camera, Exposure(target, 1.0))).astype(np.uint8)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(frame)
    assert ids is not None and len(ids) >= 12
    # Corner k of 5 x 3 stands at 8 mm steps: 32 texels of 0.25 mm.
    k = ids.ravel()
    row, col = target.warp().to_camera((k % 5 + 1) * 32.0, (k // 5 + 1) * 32.0)
    error = corners.reshape(-1, 2) - np.column_stack([col, row])
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.1
    assert np.all(np.abs(error.mean(0)) < 0.03)


# --- the lens's imaging model ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", range(1, 6))
def test_a_lens_is_diffraction_limited_unless_it_says_otherwise(
    colour_camera: CameraModel, lamp: Spectrum, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The formula that stood here before lenses had imaging models, to the last bit."""
    exposure = Exposure(scenes(lamp)[index], 0.02)
    effects = (Birefringent(d_um=2.1),)
    now = expected(colour_camera, exposure, effects)

    def before(
        self: Blur, wavelength_nm: float, fx: FloatArray, fy: FloatArray, place_um: tuple[float, float] = (0.0, 0.0)
    ) -> FloatArray:
        fx_um, fy_um = fx / self.camera.pixel_pitch_um, fy / self.camera.pixel_pitch_um
        value = diffraction_otf(np.hypot(fx_um, fy_um), wavelength_nm, self.camera.lens.f_number)
        for law in self.image.transfer:
            value = value * law(fx_um, fy_um, wavelength_nm)
        return value

    monkeypatch.setattr(Blur, "at", before)
    np.testing.assert_array_equal(now, expected(colour_camera, exposure, effects))


def test_wavelengths_share_a_sight_s_light(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """Means of what is linear in the wavelength are those of the detected light, and an effect on its colour is in them."""
    grid = np.linspace(380.0, 780.0, 90)
    sights = [(channel, light) for channel in "RGB" for light in (lamp, None)]
    shares = wavelength_shares(colour_camera, sights, grid)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, rtol=1e-12)
    nodes, few = common_wavelengths(colour_camera, sights)
    np.testing.assert_allclose(shares @ grid, few @ nodes, rtol=1e-10)
    cut = InfraredCutFilter(cut_wavelength_nm=600.0, width_nm=1.0)
    without_red = wavelength_shares(colour_camera, sights, grid, (cut,))
    assert np.all(without_red[:, grid > 615.0].sum(axis=1) < 1e-5)  # e^-12 of a width's light behind the edge


def test_magnification_dims_a_whole_frame_as_in_iset(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """E = pi T L / (1 + 4 N^2 (1 + |m|)^2), for every kind of scene; the light that doesn't come through the lens stays."""
    camera = colour_camera.model_copy(update={"dark_current_e_per_s": 0.0})
    ratio = irradiance_factor(4.0, 0.5) / irradiance_factor(4.0)
    for scene in scenes(lamp)[1:]:
        far = sim_frame.expected_electrons(camera, Exposure(scene, 0.02))
        near = sim_frame.expected_electrons(camera, Exposure(scene, 0.02, magnification=-0.5))
        np.testing.assert_allclose(near, ratio * far, rtol=1e-12)


# --- effects act once ------------------------------------------------------------------------------------------------------


def _two_cells(lamp: Spectrum) -> tuple[Scene, Scene]:
    """An upright edge between columns 47 and 48, as a knife edge and as a drawn screen."""
    dark = lamp.scaled(0.02)
    edge = KnifeEdge((EdgeRegion((0, 0, 72, 96), 0.0),), dark, lamp)
    warp = Warp.from_corners(2, 1, [(-1000.0, -952.5), (-1000.0, 1047.5), (1000.0, 1047.5), (1000.0, -952.5)])
    return edge, ScreenPattern(np.array([[0, 1]], np.uint8), warp, dark, lamp, kind="slanted_edge")


def _one_deviation(kind: type[Effect]) -> Effect:
    """The effect at one standard deviation of its first parameter's prior."""
    name, quantity = next(iter(kind.quantities().items()))
    assert quantity.prior is not None
    return kind.from_slopes({name: quantity.prior[1] ** quantity.slope_power})


SPREADING = [
    _one_deviation(kind)
    for kind in library.effects().values()
    if TRANSFER & library.may_change(kind)
    and kind.name not in {"veiling_glare", "field_curvature"}  # on axis what grows with the field does nothing
]


@pytest.mark.parametrize("one", SPREADING, ids=lambda e: e.name)
def test_a_blur_acts_once_in_a_frame_as_in_an_edges_profile(
    mono_camera: CameraModel, lamp: Spectrum, one: Effect
) -> None:
    """What an effect changes in a MONO frame across an edge is what it changes in the edge's profile, whether the frame is drawn
    or taken from the profile, and whether the effect blurs the image, moves the charge or filters the codes. The drawing's own
    error, and its other end, change by 2 % of what the effect does."""
    camera = mono_camera.model_copy(
        update={"dark_current_e_per_s": 0.0, "lens": Lens(f_number=4.0, focal_length_mm=5000.0)}
    )
    distance = np.arange(96.0) - 47.5
    level = 0.98 * electron_rate(camera, "Y", lamp)
    with_it, without = (edge_profile(camera, "Y", lamp, 0.0, distance, acting) for acting in ((one,), ()))
    wanted = with_it - without
    assert np.abs(wanted).max() > 3e-3  # it does act
    processing = Uniform(camera, (one,)).filter_kernel()
    for scene in _two_cells(lamp):
        with_it, without = (
            sim_frame.expected_electrons(camera, Exposure(scene, 1.0), acting, oversample=6) / level
            for acting in ((one,), ())
        )
        with_it = with_it if processing is None else sensor.filtered(with_it, processing, camera.cfa)
        np.testing.assert_allclose((with_it - without)[36, 8:-8], wanted[8:-8], atol=0.03 * np.abs(wanted).max())


def test_crosstalk_acts_once_in_a_mosaic(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """A frame with crosstalk is the frame without it, its charge moved between neighbours once: nothing else happens."""
    kind = library.effects()["crosstalk"](share_percent=4.0)
    for scene in scenes(lamp)[1:]:
        without = sim_frame.expected_electrons(colour_camera, Exposure(scene, 0.02))
        with_it = sim_frame.expected_electrons(colour_camera, Exposure(scene, 0.02), (kind,))
        np.testing.assert_allclose(with_it, charge_of(colour_camera, (kind,)).moved(without), rtol=1e-12)
        assert np.abs(with_it - without).max() > 1.0


# --- cubes of spectra --------------------------------------------------------------------------------------------------------


def _cube(lamp: Spectrum, rows: int, cols: int) -> tuple[tuple[float, ...], np.ndarray]:
    """Radiance of random smooth reflectances under the lamp, of random brightness."""
    rng = np.random.default_rng(8)
    wavelength_nm = np.arange(400.0, 701.0, 10.0)
    phase, level = rng.random((rows, cols, 1)) * 6, rng.random((rows, cols, 1))
    reflectance = level * (0.5 + 0.4 * np.sin(wavelength_nm / 60.0 + phase))
    return tuple(wavelength_nm.tolist()), reflectance * lamp.at(wavelength_nm)


def test_a_cube_of_pixels_is_summed_band_by_band_with_the_kernel(mono_camera: CameraModel, lamp: Spectrum) -> None:
    """The exact answer: every band's picture convolved with the band's own kernel. Five wavelengths stand for all bands."""
    from scipy.signal import fftconvolve

    camera = mono_camera.model_copy(update={"rows": 24, "cols": 32, "dark_current_e_per_s": 0.0})
    wavelength_nm, radiance = _cube(lamp, 24, 32)
    image = SpectralImage(wavelength_nm[::6], radiance[..., ::6])
    frame = sim_frame.expected_electrons(camera, Exposure(image, 1.0))
    exact = np.zeros((24, 32))
    for k, band in enumerate(image.bands()):
        spread = kernel(camera, "Y", band, 101, 1)
        # An Airy pattern has 2 lambda N / (pi^2 r) of its light beyond r, about 1.13 of a square's half side: the kernel's sum
        # was made 1 all the same.
        beyond = 2e-3 * image.wavelength_nm[k] * 4.0 / (np.pi**2 * 1.13 * 50.5 * 3.0)
        exact += electron_rate(camera, "Y", band) * (1 - beyond) * fftconvolve(image.radiance[..., k], spread, "same")
    exact *= relative_illumination(camera, np.arange(24)[:, None], np.arange(32)[None, :])
    assert np.sqrt(np.mean((frame - exact) ** 2)) < 5e-4 * exact.mean()


def test_a_cube_on_pixels_is_the_limit_of_finer_drawing(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """Random pixels drawn on s x s samples leave an error that falls as 1 / s^2; the folded transfer leaves none."""
    camera = colour_camera.model_copy(update={"rows": 24, "cols": 32})
    wavelength_nm, radiance = _cube(lamp, 24, 32)
    image = SpectralImage(wavelength_nm, radiance)
    folded = sim_frame.expected_electrons(camera, Exposure(image, 0.01))
    drawn = SpectralImage(wavelength_nm, radiance, image.warp())
    error = [
        np.sqrt(np.mean((sim_frame.expected_electrons(camera, Exposure(drawn, 0.01), oversample=s) - folded) ** 2))
        / folded.mean()
        for s in (3, 9)
    ]
    assert error[0] < 4e-2
    assert error[1] < 0.2 * error[0]


def test_an_even_cube_is_a_flat_field(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """A cube larger than the frame with the lamp in every sample, far from its rim, with a filter that moves with the angle."""
    camera = colour_camera.model_copy(update={"lens": Lens(f_number=4.0, focal_length_mm=0.6)})
    wavelength_nm = tuple(np.arange(380.0, 781.0, 5.0).tolist())
    cube = np.broadcast_to(lamp.at(wavelength_nm), (72, 96, len(wavelength_nm))).copy()
    for effects in ((), (AngleCut(),)):
        flat = sim_frame.expected_electrons(camera, Exposure(UniformField(lamp), 1.0), effects)
        even = sim_frame.expected_electrons(camera, Exposure(SpectralImage(wavelength_nm, cube), 1.0), effects)
        # An edge's tails, N lambda / (pi^2 d), leave 1e-3 of the light at 20 px.
        np.testing.assert_allclose(even[20:52, 20:76], flat[20:52, 20:76], rtol=6e-3)
