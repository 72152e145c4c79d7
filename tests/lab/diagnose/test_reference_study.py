"""The reference session's screens are drawn as exactly as the estimators read them."""

from __future__ import annotations

import numpy as np
import pytest

from lab.diagnose.reference_study import (
    CELL_PX,
    SCREEN_OFFSET_PX,
    SCREEN_SAMPLES,
    WAVELENGTH_NM,
    reference_camera,
    screen_pattern,
)
from sim.camera import Geometry, Lens
from sim.frame import Exposure, expected_electrons
from sim.spectrum import FloatArray, Spectrum

SHAPE = (56, 64)
FINE = 30  # samples a pixel


def drawn(f_number: float, samples: int) -> FloatArray:
    """Return the Fourier transform of the image of random cells that fill the frame, without its mean."""
    camera = reference_camera()
    matrix = ((750.0, 0.0, 0.5 * (SHAPE[1] - 1)), (0.0, 750.0, 0.5 * (SHAPE[0] - 1)), (0.0, 0.0, 1.0))
    camera = camera.model_copy(
        update={
            "rows": SHAPE[0],
            "cols": SHAPE[1],
            "cfa": "MONO",
            "quantum_efficiency": {"Y": camera.quantum_efficiency["G"]},
            "lens": Lens(f_number=f_number, focal_length_mm=3.0),
            "geometry": Geometry(camera_matrix=matrix),
        }
    )
    cells = np.random.default_rng(3).integers(0, 2, (SHAPE[0] // int(CELL_PX), SHAPE[1] // int(CELL_PX)))
    scene = screen_pattern(cells, SHAPE, Spectrum.of(WAVELENGTH_NM, 0.004 + 0.0 * WAVELENGTH_NM), "bernoulli")
    image = expected_electrons(camera, Exposure(scene, 1e-3, placed="image"), oversample=samples, margin_px=8)
    return np.asarray(np.fft.rfft2(image - image.mean()))


@pytest.mark.parametrize(("f_number", "error"), [(2.8, 4e-4), (4.0, 2e-4), (5.6, 1e-4)])
def test_screens_are_drawn_to_the_stated_error_of_the_contrast(f_number: float, error: float) -> None:
    """Against a drawing with `FINE` samples a pixel. There borders lie at the share p = 0.79 of a sample, so that its
    own aliases change the contrast at 0.45 cy/px by 2 (pi 0.45 / 30)^2 (p^2 - p + 1/6) = 1e-5. With 3 samples a pixel
    and borders at p = 0 it is off by 6 % at 0.3 cy/px and f/4."""
    share = (SCREEN_OFFSET_PX * FINE) % 1.0
    own = abs(2.0 * np.square(np.pi * 0.45 / FINE) * (share**2 - share + 1.0 / 6.0))
    assert own < 2e-5
    image, true = drawn(f_number, SCREEN_SAMPLES), drawn(f_number, FINE)
    fy, fx = np.fft.fftfreq(SHAPE[0])[:, None], np.fft.rfftfreq(SHAPE[1])[None, :]
    radius = np.hypot(fx, fy)
    for low, high in ((0.03, 0.14), (0.14, 0.27), (0.27, 0.36), (0.36, 0.45)):
        band = (radius >= low) & (radius < high)
        contrast = float(np.sum(np.real(image * np.conj(true))[band]) / np.sum(np.abs(true[band]) ** 2))
        assert abs(contrast - 1.0) < error + own
