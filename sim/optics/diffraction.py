"""The optical transfer function of a perfect lens and of a square pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sim.spectrum import FloatArray


def diffraction_otf(f_cy_per_um: ArrayLike, wavelength_nm: ArrayLike, f_number: float) -> FloatArray:
    """OTF of an aberration-free lens with a circular pupil, incoherent light.

    (2 / pi) (arccos s - s sqrt(1 - s^2)), s = f wavelength f_number, 0 beyond s = 1. `f_cy_per_um` and `wavelength_nm`
    broadcast against each other. (Goodman, Introduction to Fourier Optics, "frequency response for a
    diffraction-limited incoherent imaging system".)
    """
    s = np.minimum(np.abs(np.asarray(f_cy_per_um, float)) * (np.asarray(wavelength_nm, float) * 1e-3 * f_number), 1.0)
    return (2.0 / np.pi) * (np.arccos(s) - s * np.sqrt(1.0 - s * s))


def diffraction_cutoff_cy_per_um(wavelength_nm: float, f_number: float) -> float:
    """Frequency beyond which a lens passes nothing: 1 / (wavelength f_number)."""
    return 1.0 / (wavelength_nm * 1e-3 * f_number)


def aperture_otf(fx_cy_per_px: ArrayLike, fy_cy_per_px: ArrayLike, fill_factor: float) -> FloatArray:
    """OTF of a pixel's light-sensitive area, a centred square of side w = sqrt(fill_factor) px: sinc(w fx)
    sinc(w fy).
    """
    w = np.sqrt(fill_factor)
    return np.sinc(w * np.asarray(fx_cy_per_px, float)) * np.sinc(w * np.asarray(fy_cy_per_px, float))
