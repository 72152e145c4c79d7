"""Plates and coatings before the sensor, and veiling glare: birefringent low-pass filter, cover glass, infrared cut
filter.

The effects of these names act through these functions. A camera that is known to have such a part lists the effect.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from sim.optics.pupil import Wavefront, seidel
from sim.spectrum import FloatArray

#: The line at which a birefringent plate's displacement is stated: the mean of sodium's D lines.
SODIUM_NM = 589.3


def quartz_indices(wavelength_nm: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Ordinary and extraordinary refractive index of crystal quartz, 198..2050 nm. (G. Ghosh, Opt. Commun. 163, 95
    (1999).)
    """
    w2 = (np.asarray(wavelength_nm, float) * 1e-3) ** 2
    ordinary2 = 1.28604141 + 1.07044083 * w2 / (w2 - 1.00585997e-2) + 1.10202242 * w2 / (w2 - 100.0)
    extraordinary2 = 1.28851804 + 1.09509924 * w2 / (w2 - 1.02101864e-2) + 1.15662475 * w2 / (w2 - 100.0)
    return np.sqrt(ordinary2), np.sqrt(extraordinary2)


def birefringent_displacement_um(thickness_mm: float, wavelength_nm: ArrayLike = SODIUM_NM) -> FloatArray:
    """Distance of the two rays behind a quartz plate cut at 45 degrees to its axis: d = t
    (ne^2 - no^2) / (ne^2 + no^2).

    5.88e-3 t at 589 nm, 4 % more at 400 nm, 1 % less at 700 nm.
    """
    ordinary, extraordinary = quartz_indices(wavelength_nm)
    e2, o2 = extraordinary**2, ordinary**2
    return np.asarray(thickness_mm * 1e3 * (e2 - o2) / (e2 + o2))


def birefringent_spots(displacement_x_um: float, displacement_y_um: float) -> tuple[FloatArray, FloatArray]:
    """Images of a point: positions (n, 2) in um as (x, y), and shares of the light (n,).

    One plate gives two spots `displacement` apart; two plates, with a quarter-wave plate between them, give four.
    """
    ends_x, ends_y = (
        np.array([-0.5, 0.5]) * d if d != 0.0 else np.zeros(1) for d in (displacement_x_um, displacement_y_um)
    )
    x, y = np.meshgrid(ends_x, ends_y)
    positions = np.stack([x.ravel(), y.ravel()], axis=1)
    return positions, np.full(len(positions), 1.0 / len(positions))


def birefringent_otf(
    fx_cy_per_um: ArrayLike,
    fy_cy_per_um: ArrayLike,
    displacement_x_um: float,
    displacement_y_um: float,
    beam_imbalance: float = 0.0,
) -> NDArray[np.float64] | NDArray[np.complex128]:
    """Return the transfer function of those spots: cos(pi fx dx) cos(pi fy dy), first zero at f = 1 / (2 d).

    `beam_imbalance` (0..1) is the difference m of a plate's two beams over their sum: each factor is then cos(phi) - i
    m sin(phi), phi = pi f d, whose modulus has no zero.
    """
    across, along = (
        np.pi * np.asarray(f, float) * d
        for f, d in ((fx_cy_per_um, displacement_x_um), (fy_cy_per_um, displacement_y_um))
    )
    if beam_imbalance == 0.0:
        return np.asarray(np.cos(across) * np.cos(along))
    unequal = 1j * beam_imbalance
    return np.asarray((np.cos(across) - unequal * np.sin(across)) * (np.cos(along) - unequal * np.sin(along)))


def plate_focus_shift_um(thickness_mm: float, index: float) -> float:
    """Shift of the paraxial focus, away from the lens, by a plane-parallel plate before the sensor: t (1 - 1/n)."""
    return thickness_mm * 1e3 * (1.0 - 1.0 / index)


def plate_spherical_um(thickness_mm: float, index: float, f_number: float) -> float:
    """Spherical aberration W040 at the pupil's rim of a plane-parallel plate: t (n^2 - 1) / (128 n^3 N^4).

    Third order: 1 % low at f/4, 6 % at f/1.8 for n = 1.5. (V. Mahajan, Optical Imaging and Aberrations I, section 5.8.)
    """
    return thickness_mm * 1e3 * (index**2 - 1.0) / (128.0 * index**3 * f_number**4)


def plate_wavefront(thickness_mm: float, index: float, f_number: float, *, refocused: bool = True) -> Wavefront:
    """Path error of a plate that the lens wasn't designed for.

    `refocused`: the sensor stands in the new paraxial focus. Else it stands where it was, which adds t (1 - 1/n) of
    defocus (negative: the focus lies behind the sensor).
    """
    shift = 0.0 if refocused else -plate_focus_shift_um(thickness_mm, index)
    return seidel(
        spherical_um=plate_spherical_um(thickness_mm, index, f_number), defocus_um=shift / (8.0 * f_number**2)
    )


def edge_transmittance(
    wavelength_nm: ArrayLike,
    cut_wavelength_nm: float,
    width_nm: float,
    sin_theta: ArrayLike = 0.0,
    effective_index: float | None = None,
    steepening: float = 0.0,
) -> FloatArray:
    """Transmittance of a short-pass edge, 1 / (1 + exp(u + steepening u^3)), u = (wavelength - cut) / width; the
    arguments broadcast.

    Without `steepening` the density grows linearly behind the edge; 0.0173 makes it the integral of a Gaussian of
    1.5976 widths within 2e-4 (S. R. Bowling et al., J. Ind. Eng. Manag. 2, 114, 2009).
    `effective_index`: an interference filter's edge at an angle moves to cut sqrt(1 - sin^2 / n^2), its width with it;
    None: glass that absorbs, whose edge stays. (H. A. Macleod, Thin-Film Optical Filters, chapter on tilted coatings.)
    """
    wavelength, sine = np.broadcast_arrays(np.asarray(wavelength_nm, float), np.asarray(sin_theta, float))
    moved = 1.0 if effective_index is None else np.sqrt(1.0 - (sine / effective_index) ** 2)
    away = (wavelength / moved - cut_wavelength_nm) / width_nm
    return np.asarray(expit(-(away + steepening * away**3)))


#: A veil is so wide (standard deviation, in um of the sensor) that only a scene's mean gets through: 1e5 um.
VEIL_UM = 1e5


def veil_otf(fx_cy_per_um: ArrayLike, fy_cy_per_um: ArrayLike, share: float, std_um: float = VEIL_UM) -> FloatArray:
    """Transfer function of veiling glare: `share` of the light spread by a normal distribution so wide that it is
    uniform over the frame. It is 1 at zero frequency and 1 - share at all frequencies that a frame resolves."""
    f2 = np.asarray(fx_cy_per_um, float) ** 2 + np.asarray(fy_cy_per_um, float) ** 2
    return np.asarray(1.0 - share + share * np.exp(-2.0 * np.pi**2 * std_um**2 * f2))
