from __future__ import annotations

import numpy as np
import pytest

from sim.camera import CameraModel, Lens
from sim.spectrum import Spectrum, blackbody_radiance


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
    return blackbody_radiance(3000.0, np.arange(380.0, 781.0, 5.0)).scaled(6e-7)
