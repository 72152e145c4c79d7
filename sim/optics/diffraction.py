"""The optical transfer function of a perfect lens and of a square pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sim.spectrum import FloatArray


def diffraction_otf(f_cy_per_um: ArrayLike, wavelength_nm: ArrayLike, f_number: float) -> FloatArray:
    """Compute the OTF of an aberration-free lens with a circular pupil in incoherent light: (2 / pi) (arccos s - s
    sqrt(1 - s^2)), s = f wavelength f_number, 0 beyond s = 1 (Goodman, Introduction to Fourier Optics, "frequency
    response for a diffraction-limited incoherent imaging system").

    f_cy_per_um, wavelength_nm : arrays that broadcast, cycles per um and nm; f_number : N

    Returns the OTF, 0..1.

    >>> round(float(diffraction_otf(0.25, 500.0, 4.0)), 4)  # half the cutoff of 0.5 cycles per um
    0.391
    """
    s = np.minimum(np.abs(np.asarray(f_cy_per_um, float)) * (np.asarray(wavelength_nm, float) * 1e-3 * f_number), 1.0)
    return (2.0 / np.pi) * (np.arccos(s) - s * np.sqrt(1.0 - s * s))


def diffraction_cutoff_cy_per_um(wavelength_nm: float, f_number: float) -> float:
    """Compute the frequency beyond which a lens passes nothing, 1 / (wavelength f_number), cycles per um.

    >>> diffraction_cutoff_cy_per_um(500.0, 4.0)
    0.5
    """
    return 1.0 / (wavelength_nm * 1e-3 * f_number)


def aperture_otf(fx_cy_per_px: ArrayLike, fy_cy_per_px: ArrayLike, fill_factor: float) -> FloatArray:
    """Compute the OTF of a pixel's light-sensitive area, a centred square of side w = sqrt(fill_factor) px: sinc(w
    fx) sinc(w fy).

    fx_cy_per_px, fy_cy_per_px : arrays that broadcast, cycles per px; fill_factor : 0..1

    Returns the OTF.

    >>> round(float(aperture_otf(0.5, 0.0, 1.0)), 4)  # 2 / pi at Nyquist
    0.6366
    """
    w = np.sqrt(fill_factor)
    return np.sinc(w * np.asarray(fx_cy_per_px, float)) * np.sinc(w * np.asarray(fy_cy_per_px, float))
