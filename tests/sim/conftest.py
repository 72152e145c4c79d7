"""A lens in closed form, as a traced table, for the tests of `sim`."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from sim.camera import CameraModel, Lens
from sim.optics.table import LensTable
from sim.spectrum import FloatArray, Spectrum, blackbody_radiance


def curve(centre_nm: float, width_nm: float, peak: float) -> Spectrum:
    wavelength_nm = np.arange(380.0, 781.0, 10.0)
    return Spectrum.of(wavelength_nm, peak * np.exp(-0.5 * ((wavelength_nm - centre_nm) / width_nm) ** 2))


@pytest.fixture
def colour_camera() -> CameraModel:
    return CameraModel(
        rows=72,
        cols=96,
        pixel_pitch_um=3.0,
        fill_factor=0.9,
        cfa="GBRG",
        bit_depth=12,
        black_level_dn=240.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.35,
        full_well_e=10500.0,
        read_noise_e=2.5,
        dark_current_e_per_s=3.0,
        dsnu_e=1.0,
        prnu_percent=0.8,
        quantum_efficiency={"R": curve(610, 40, 0.5), "G": curve(540, 40, 0.6), "B": curve(460, 35, 0.5)},
        lens=Lens(f_number=4.0, focal_length_mm=8.0, transmittance=0.9),
    )


@pytest.fixture
def mono_camera(colour_camera: CameraModel) -> CameraModel:
    return colour_camera.model_copy(update={"cfa": "MONO", "quantum_efficiency": {"Y": curve(550, 60, 0.7)}})


@pytest.fixture
def lamp() -> Spectrum:
    return blackbody_radiance(3000.0, np.arange(380.0, 781.0, 5.0)).scale(6e-7)


class SyntheticLens:
    """A lens whose point spread function is known in closed form: two Gaussians, the second one displaced along the
    radius (coma) in proportion to the height h (0..1 at the corner), both displaced with the wavelength
    (lateral colour); wider along the radius than across it (astigmatism). RI = 1 - 0.35 h^2, image radius = ideal
    radius x (1 + k h^2).
    """

    f_mm, pitch_um, samples = 8.0, 0.5, 64
    wavelength_nm = np.arange(400.0, 721.0, 10.0)

    def __init__(self, corner_um: float = 2500.0, k: float = -0.02, colour: float = 0.8, grid: bool = False) -> None:
        self.corner_um, self.k, self.colour, self.grid = corner_um, k, colour, grid

    def blobs(self, h: FloatArray, wavelength_nm: float) -> list[tuple[float, FloatArray, FloatArray, FloatArray]]:
        """(share, place along the radius, standard deviations along and across it), in um from the chief ray."""
        place = (wavelength_nm - 550.0) / 100.0 * self.colour * h
        return [
            (0.7, place, 1.5 * (1 + 0.8 * h * h), 1.5 * (1 + 0.1 * h * h)),
            (0.3, place + 3.0 * h, 2.0 * (1 + 0.5 * h * h), 2.0 + 0.0 * h),
        ]

    def illumination(self, h: FloatArray) -> FloatArray:
        return 1.0 - 0.35 * h * h

    def image_um(self, r_um: FloatArray) -> FloatArray:
        """Radius of the window's centre, 0.9 h um beyond the chief ray's."""
        h = r_um / self.corner_um
        return r_um * (1.0 + self.k * h * h) + 0.9 * h

    def area(self, r_um: FloatArray) -> FloatArray:
        """Area in the image over area in the ideal image: r' / r dr' / dr."""
        h = r_um / self.corner_um
        extra = 0.9 / self.corner_um
        return (1.0 + self.k * h * h + extra) * (1.0 + 3.0 * self.k * h * h + extra)

    def table(self) -> LensTable:
        """The lens as a table of 21 heights, or of 15 x 17 fields as a lens without symmetry has it; made once a
        session.
        """
        return _table(self.corner_um, self.k, self.colour, self.grid)

    def made(self) -> LensTable:
        heights = np.linspace(0.0, self.corner_um, 21)
        x, y = np.zeros(21), heights
        shape: tuple[int, ...] = (21,)
        if self.grid:
            side = self.corner_um / np.sqrt(2.0)
            shape = 15, 17
            x, y = (a.ravel() for a in np.meshgrid(np.linspace(-side, side, 17), np.linspace(-side, side, 15)))
        r = np.hypot(x, y)
        h = r / self.corner_um
        ex, ey = (np.divide(a, r, out=np.full(r.size, b), where=r > 0) for a, b in ((x, 0.0), (y, 1.0)))
        at = (np.arange(self.samples) - 0.5 * (self.samples - 1)) * self.pitch_um
        v, u = at[:, None], at[None, :]
        psf = np.zeros((self.wavelength_nm.size, r.size, self.samples, self.samples))
        for i, wavelength_nm in enumerate(self.wavelength_nm):
            for j in range(r.size):
                along, across = u * ex[j] + v * ey[j] + 0.9 * h[j], u * ey[j] - v * ex[j]
                for share, place, sigma, other in self.blobs(h[j], wavelength_nm):
                    shape_of = np.exp(-0.5 * ((along - place) / sigma) ** 2 - 0.5 * (across / other) ** 2)
                    psf[i, j] += share / (2 * np.pi * sigma * other) * shape_of * self.pitch_um**2
        window = 0.9 * h[:, None] * np.stack([ex, ey], axis=1)
        chief = r[:, None] * (1 + self.k * h[:, None] ** 2) * np.stack([ex, ey], axis=1)
        w, f = self.wavelength_nm.size, r.size
        return LensTable(
            wavelength_nm=self.wavelength_nm,
            field_deg=np.rad2deg(np.arctan(np.stack([x, y], axis=1) / (self.f_mm * 1e3))),
            grid_shape=shape,
            symmetric=not self.grid,
            reference_wavelength_nm=550.0,
            focal_length_mm=self.f_mm,
            f_number=4.0,
            entrance_pupil_mm=2.0,
            chief_mm=chief * 1e-3,
            relative_illumination=np.broadcast_to(self.illumination(h), (w, f)),
            psf=psf,
            window_um=window,
            sample_pitch_um=self.pitch_um,
            encircled_share=np.minimum(psf.sum(axis=(2, 3)), 1.0),
            centroid_um=np.zeros((w, f, 2)),
            warnings=(),
            content_hash=f"synthetic {self.corner_um} {self.k} {self.colour} {self.grid}",
        )


@lru_cache
def _table(corner_um: float, k: float, colour: float, grid: bool) -> LensTable:
    return SyntheticLens(corner_um, k, colour, grid).made()


@pytest.fixture(scope="session")
def synthetic_lens() -> type[SyntheticLens]:
    return SyntheticLens
