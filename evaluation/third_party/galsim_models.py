"""Sensors and point spreads by GalSim: B. T. P. Rowe et al., GalSim: the modular galaxy image simulation toolkit,
Astronomy and Computing 10 (2015) 121."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import galsim
import numpy as np
from scipy.special import gamma, kv

from evaluation.third_party.camera import F_NUMBER, WAVELENGTH_NM, DrawnCamera
from evaluation.third_party.models import SimulatedOptics, SimulatedSensor, SimulatorCheck
from sim.spectrum import FloatArray

#: Steps in which a flat is collected, pixel borders being moved after each by the charge that is there.
STEPS = 12
#: Pixels around the frame that are simulated, too, as borders at the rim have no neighbours.
MARGIN_PX = 8
#: GalSim's image is good to this share.
TRANSFORM_ERROR = 2e-3
PUPIL_GRID = 512
#: Full width at half maximum of Kolmogorov's spread over the wavelength by Fried's length.
FRIED_WIDTH = 0.975863
#: Grid of a drawn point: its Nyquist frequency is beyond the cut-off of diffraction on the widest pixel.
POINT_PX, POINT_STEP_PX = 1280, 0.2
LAMBDA_UM = WAVELENGTH_NM / 1000.0


@dataclass
class Silicon(SimulatedSensor):
    """Brighter-fatter by the borders of an ITL sensor's pixels, many times as strong, as its wells are 100,000 e."""

    strength: float = 20.0
    full_well_e: float = 1e4

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> Silicon:
        return cls({}, "usual", float(rng.uniform(10.0, 25.0)) * 1e4 / camera.full_well_e, camera.full_well_e)

    def collect(self, mean_e: FloatArray, exposure_s: float, rng: np.random.Generator) -> FloatArray:
        if float(np.mean(mean_e)) < 0.02 * self.full_well_e:
            return rng.poisson(mean_e).astype(float)
        sensor = galsim.SiliconSensor(
            name="lsst_itl_50_8", strength=self.strength, rng=galsim.BaseDeviate(1), diffusion_factor=0.0
        )
        wide_e = np.pad(mean_e, MARGIN_PX, mode="symmetric")
        image = galsim.ImageD(wide_e.shape[1], wide_e.shape[0], init_value=0.0)
        for _ in range(STEPS):
            image.array[:] += rng.poisson(wide_e / STEPS * sensor.calculate_pixel_areas(image).array)
        return np.asarray(image.array[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX], float)

    def check(self) -> SimulatorCheck:
        """Charge is conserved: the variance that a pixel lacks is the covariance of its neighbours, in sum, so that
        blocks of 8 x 8 pixels have the variance of their electrons but for a quarter of it at their rims."""
        mean_e, rng = 0.8 * self.full_well_e, np.random.default_rng(1)
        drawn = self.collect(np.full((128, 128), mean_e), 0.01, rng)
        blocks = drawn.reshape(16, 8, 16, 8).sum(axis=(1, 3))
        one, many = np.var(drawn) / np.mean(drawn), np.var(blocks) / np.mean(blocks)
        tolerance = 3.0 * np.sqrt(2.0 / blocks.size) + 0.25 * abs(1.0 - float(one))
        return SimulatorCheck(1.0, float(many), tolerance)


@dataclass
class Spread(SimulatedOptics):
    """A profile of GalSim, convolved with the diffraction of the stated f-number.

    profile : pitch (um) -> GalSim's object, in pixels
    transfer : frequency along the row (cy/um) -> modulus of the closed form
    """

    profile: Callable[[float], Any] = lambda pitch_um: None
    transfer: Callable[[FloatArray], FloatArray] = lambda frequency: np.ones(frequency.shape)
    pitch_um: float = 5.0

    def edge(self, size: int, angle_deg: float, pitch_um: float) -> FloatArray:
        params = galsim.GSParams(maximum_fft_size=16384)
        width = 1.25 * size  # of the light, whose far sides lie outside of the image
        light = galsim.Box(width, 2.0 * width, flux=2.0 * width**2).shift(0.5 * width, 0.0)
        light = light.rotate(angle_deg * galsim.degrees)
        drawn = galsim.Convolve([self.profile(pitch_um), light], gsparams=params)
        return np.asarray(drawn.drawImage(nx=size, ny=size, scale=1.0, dtype=float).array)

    def check(self) -> SimulatorCheck:
        """The transfer at 0.25 cy/px of a drawn point, without the pixel."""
        image = (
            self.profile(self.pitch_um)
            .drawImage(nx=POINT_PX, ny=POINT_PX, scale=POINT_STEP_PX, method="no_pixel", dtype=float)
            .array
        )
        along = np.abs(np.fft.fft(image.sum(axis=0))) / abs(image.sum())
        frequency_px = np.fft.fftfreq(POINT_PX, POINT_STEP_PX)
        at = int(np.argmin(np.abs(frequency_px - 0.25)))
        asked = float(self.transfer(np.array([frequency_px[at] / self.pitch_um]))[0])
        return SimulatorCheck(asked, float(along[at]), TRANSFORM_ERROR)


def _airy(pitch_um: float) -> Any:
    return galsim.Airy(lam_over_diam=LAMBDA_UM * F_NUMBER / pitch_um)


def _diffraction(frequency: FloatArray) -> FloatArray:
    """Transfer of a round pupil at cy/um."""
    x = np.clip(np.abs(frequency) * LAMBDA_UM * F_NUMBER, 0.0, 1.0)
    return np.asarray(2.0 / np.pi * (np.arccos(x) - x * np.sqrt(1.0 - x * x)))


def _pupil_transfer(waves: Callable[[FloatArray, FloatArray], FloatArray]) -> Callable[[FloatArray], FloatArray]:
    """Return the modulus of the transfer along the row of a pupil with a path error (waves) over its unit disc: the
    pupil's autocorrelation on a grid."""
    x, y = np.meshgrid(*(2 * (np.linspace(-1.0, 1.0, PUPIL_GRID),)))
    inside = x * x + y * y <= 1.0
    pupil = np.where(inside, np.exp(2j * np.pi * waves(x, y)), 0.0)

    def transfer(frequency: FloatArray) -> FloatArray:
        apart = np.rint(np.abs(frequency) * LAMBDA_UM * F_NUMBER * (PUPIL_GRID - 1)).astype(int)
        overlap = [np.sum(pupil[:, n:] * np.conj(pupil[:, : PUPIL_GRID - n])) for n in apart]
        return np.asarray(np.abs(overlap) / inside.sum())

    return transfer


def airy(rng: np.random.Generator, camera: DrawnCamera) -> Spread:
    """Diffraction alone: a healthy lens."""
    return Spread({}, _airy, _diffraction, camera.pitch_um)


def moffat(rng: np.random.Generator, camera: DrawnCamera) -> Spread:
    """A Moffat profile."""
    radius_um, exponent = camera.pitch_um * float(rng.uniform(0.3, 0.8)), float(rng.uniform(1.8, 3.5))

    def profile(pitch_um: float) -> Any:
        return galsim.Convolve([_airy(pitch_um), galsim.Moffat(beta=exponent, scale_radius=radius_um / pitch_um)])

    def transfer(frequency: FloatArray) -> FloatArray:
        x, order = 2.0 * np.pi * radius_um * np.abs(frequency), exponent - 1.0
        return np.asarray(_diffraction(frequency) * 2.0 * (0.5 * x) ** order * kv(order, x) / gamma(order))

    return Spread({"radius_um": radius_um, "exponent": exponent}, profile, transfer, camera.pitch_um)


def kolmogorov(rng: np.random.Generator, camera: DrawnCamera) -> Spread:
    """Seeing: the long-exposure spread of Kolmogorov's turbulence, exp(-3.44 (f scale)^(5/3))."""
    scale_um = camera.pitch_um * float(rng.uniform(0.4, 0.9))  # wavelength over Fried's length, in the image

    def profile(pitch_um: float) -> Any:
        return galsim.Convolve([_airy(pitch_um), galsim.Kolmogorov(lam_over_r0=scale_um / pitch_um)])

    def transfer(frequency: FloatArray) -> FloatArray:
        return np.asarray(_diffraction(frequency) * np.exp(-3.44 * (np.abs(frequency) * scale_um) ** (5.0 / 3.0)))

    return Spread({"width_um": FRIED_WIDTH * scale_um}, profile, transfer, camera.pitch_um)


def _aberrated(truth: Mapping[str, float], camera: DrawnCamera, waves: Any, **terms: Any) -> Spread:
    def profile(pitch_um: float) -> Any:
        return galsim.OpticalPSF(
            lam_over_diam=LAMBDA_UM * F_NUMBER / pitch_um, oversampling=2.0, pad_factor=2.0, **terms
        )

    return Spread(truth, profile, _pupil_transfer(waves), camera.pitch_um)


def defocus(rng: np.random.Generator, camera: DrawnCamera) -> Spread:
    """Noll's fourth term, sqrt 3 (2 r^2 - 1)."""
    c = float(rng.uniform(0.04, 0.12))
    truth = {"defocus_um": 8.0 * F_NUMBER**2 * 2.0 * np.sqrt(3.0) * c * LAMBDA_UM}
    return _aberrated(truth, camera, lambda x, y: c * np.sqrt(3.0) * (2.0 * (x * x + y * y) - 1.0), defocus=c)


def astigmatism(rng: np.random.Generator, camera: DrawnCamera) -> Spread:
    """Noll's sixth term, sqrt 6 (x^2 - y^2), with a part of the fourth: foci at unequal distances, as edges along rows
    and columns don't tell equal ones from a defocus."""
    c = float(rng.uniform(0.05, 0.12))
    d = float(rng.uniform(0.2, 0.5)) * c
    along, both = np.sqrt(6.0) * c, 2.0 * np.sqrt(3.0) * d
    focus_um = 8.0 * F_NUMBER**2 * LAMBDA_UM
    truth = {"defocus_x_um": focus_um * (along + both), "defocus_y_um": focus_um * (along - both)}
    return _aberrated(
        truth, camera, lambda x, y: along * (x * x - y * y) + both * (x * x + y * y - 0.5), astig2=c, defocus=d
    )


def coma(rng: np.random.Generator, camera: DrawnCamera) -> Spread:
    """Noll's eighth term, sqrt 8 (3 r^3 - 2 r) cos; GalSim counts paths the other way."""
    c = float(rng.uniform(0.05, 0.12))
    truth = {"w131_x_um": -3.0 * np.sqrt(8.0) * c * LAMBDA_UM}
    return _aberrated(truth, camera, lambda x, y: c * np.sqrt(8.0) * (3.0 * (x * x + y * y) - 2.0) * x, coma2=c)


def trefoil(rng: np.random.Generator, camera: DrawnCamera) -> Spread:
    """Noll's tenth term, sqrt 8 r^3 cos of three times the angle; GalSim counts paths the other way."""
    c = float(rng.uniform(0.06, 0.14))
    truth = {"w333_x_um": -np.sqrt(8.0) * c * LAMBDA_UM}
    return _aberrated(truth, camera, lambda x, y: c * np.sqrt(8.0) * (x**3 - 3.0 * x * y * y), trefoil2=c)


def secondary_coma(rng: np.random.Generator, camera: DrawnCamera) -> Spread:
    """Noll's sixteenth term, sqrt 12 (10 r^5 - 12 r^3 + 3 r) cos; GalSim counts paths the other way."""
    c = float(rng.uniform(0.06, 0.12))

    def waves(x: FloatArray, y: FloatArray) -> FloatArray:
        square = x * x + y * y
        return np.asarray(c * np.sqrt(12.0) * (10.0 * square**2 - 12.0 * square + 3.0) * x)

    return _aberrated({"cos_um": -np.sqrt(12.0) * c * LAMBDA_UM}, camera, waves, aberrations=[0.0] * 16 + [c])


def tetrafoil(rng: np.random.Generator, camera: DrawnCamera) -> Spread:
    """Noll's fourteenth term, sqrt 10 r^4 cos of four times the angle."""
    c = float(rng.uniform(0.08, 0.14))

    def waves(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(c * np.sqrt(10.0) * np.real((x + 1j * y) ** 4))

    return _aberrated({"cos_um": np.sqrt(10.0) * c * LAMBDA_UM}, camera, waves, aberrations=[0.0] * 14 + [c])
