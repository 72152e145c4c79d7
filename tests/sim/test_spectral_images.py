"""Frames of multispectral images against sums band by band."""

from __future__ import annotations

import numpy as np

from sim import frame as sim_frame
from sim.camera import CameraModel, Lens
from sim.frame import Exposure
from sim.optics.illumination import relative_illumination
from sim.point import kernel
from sim.scene import (
    SpectralImage,
    UniformField,
)
from sim.spectrum import Spectrum
from sim.uniform import electron_rate
from tests.sim.local_effects import AngleCut


def _cube(lamp: Spectrum, rows: int, cols: int) -> tuple[tuple[float, ...], np.ndarray]:
    """Radiance of random smooth reflectances under the lamp, of random brightness."""
    rng = np.random.default_rng(8)
    wavelength_nm = np.arange(400.0, 701.0, 10.0)
    phase, level = rng.random((rows, cols, 1)) * 6, rng.random((rows, cols, 1))
    reflectance = level * (0.5 + 0.4 * np.sin(wavelength_nm / 60.0 + phase))
    return tuple(wavelength_nm.tolist()), reflectance * lamp.at(wavelength_nm)


def test_a_cube_of_pixels_is_summed_band_by_band_with_the_kernel(mono_camera: CameraModel, lamp: Spectrum) -> None:
    """The exact answer: every band's picture convolved with the band's own kernel. Five wavelengths stand for all
    bands.
    """
    from scipy.signal import fftconvolve

    camera = mono_camera.model_copy(update={"rows": 24, "cols": 32, "dark_current_e_per_s": 0.0})
    wavelength_nm, radiance = _cube(lamp, 24, 32)
    image = SpectralImage(wavelength_nm[::6], radiance[..., ::6])
    frame = sim_frame.expected_electrons(camera, Exposure(image, 1.0))
    exact = np.zeros((24, 32))
    for k, band in enumerate(image.bands()):
        spread = kernel(camera, "Y", band, 101, 1)
        # An Airy pattern has 2 lambda N / (pi^2 r) of its light beyond r, about 1.13 of a square's half side: the
        # kernel's sum was made 1 all the same.
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
    """A cube larger than the frame with the lamp in every sample, far from its rim, with a filter that moves with the
    angle.
    """
    camera = colour_camera.model_copy(update={"lens": Lens(f_number=4.0, focal_length_mm=0.6)})
    wavelength_nm = tuple(np.arange(380.0, 781.0, 5.0).tolist())
    cube = np.broadcast_to(lamp.at(wavelength_nm), (72, 96, len(wavelength_nm))).copy()
    for effects in ((), (AngleCut(),)):
        flat = sim_frame.expected_electrons(camera, Exposure(UniformField(lamp), 1.0), effects)
        even = sim_frame.expected_electrons(camera, Exposure(SpectralImage(wavelength_nm, cube), 1.0), effects)
        # An edge's tails, N lambda / (pi^2 d), leave 1e-3 of the light at 20 px.
        np.testing.assert_allclose(even[20:52, 20:76], flat[20:52, 20:76], rtol=6e-3)
