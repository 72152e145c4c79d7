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
    """Compute the refractive indices of crystal quartz (G. Ghosh, Opt. Commun. 163, 95 (1999)).

    wavelength_nm : 198..2050 nm

    Returns the ordinary and the extraordinary index.

    >>> [round(float(index), 4) for index in quartz_indices(589.3)]
    [1.5442, 1.5533]
    """
    w2 = (np.asarray(wavelength_nm, float) * 1e-3) ** 2
    ordinary2 = 1.28604141 + 1.07044083 * w2 / (w2 - 1.00585997e-2) + 1.10202242 * w2 / (w2 - 100.0)
    extraordinary2 = 1.28851804 + 1.09509924 * w2 / (w2 - 1.02101864e-2) + 1.15662475 * w2 / (w2 - 100.0)
    return np.sqrt(ordinary2), np.sqrt(extraordinary2)


def birefringent_displacement_um(thickness_mm: float, wavelength_nm: ArrayLike = SODIUM_NM) -> FloatArray:
    """Compute the distance of the two rays behind a quartz plate cut at 45 degrees to its axis, t (ne^2 - no^2) /
    (ne^2 + no^2): 5.88e-3 t at 589 nm, 4 % more at 400 nm, 1 % less at 700 nm.

    thickness_mm : mm; wavelength_nm : nm

    Returns um.

    >>> round(float(birefringent_displacement_um(1.0)), 2)
    5.88
    """
    ordinary, extraordinary = quartz_indices(wavelength_nm)
    e2, o2 = extraordinary**2, ordinary**2
    return np.asarray(thickness_mm * 1e3 * (e2 - o2) / (e2 + o2))


def birefringent_spots(displacement_x_um: float, displacement_y_um: float) -> tuple[FloatArray, FloatArray]:
    """Locate the images of a point: one plate gives two spots, two plates with a quarter-wave plate between them
    four.

    displacement_x_um, displacement_y_um : distance of the spots, um; 0: no plate

    Returns positions (n, 2) as (x, y), um, and shares of the light (n,).

    >>> positions, shares = birefringent_spots(6.0, 0.0)
    >>> positions.tolist(), shares.tolist()
    ([[-3.0, 0.0], [3.0, 0.0]], [0.5, 0.5])
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
    """Compute the transfer function of these spots, cos(pi fx dx) cos(pi fy dy), whose first zero is at f = 1 / (2
    d).

    fx_cy_per_um, fy_cy_per_um : arrays that broadcast, cycles per um
    displacement_x_um, displacement_y_um : um
    beam_imbalance : difference m of a plate's two beams over their sum, 0..1: each factor is cos(phi) - i m
        sin(phi), phi = pi f d, whose modulus has no zero

    Returns the transfer function, complex where the beams differ.

    >>> round(float(birefringent_otf(0.25 / 6.0, 0.0, 6.0, 0.0)), 6)  # cos(pi / 4)
    0.707107
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
    """Compute the shift of the paraxial focus, away from the lens, by a plane-parallel plate before the sensor: t (1
    - 1/n).

    thickness_mm : mm; index : refractive index

    Returns um.

    >>> round(plate_focus_shift_um(0.6, 1.5), 9)
    200.0
    """
    return thickness_mm * 1e3 * (1.0 - 1.0 / index)


def plate_spherical_um(thickness_mm: float, index: float, f_number: float) -> float:
    """Compute the spherical aberration W040 at the pupil's rim of a plane-parallel plate, t (n^2 - 1) / (128 n^3
    N^4), in third order: 1 % low at f/4, 6 % at f/1.8 for n = 1.5 (V. Mahajan, Optical Imaging and Aberrations I,
    section 5.8).

    thickness_mm : mm; index : refractive index; f_number : N

    Returns um.

    >>> f"{plate_spherical_um(1.0, 1.5, 2.0):.4f}"
    '0.1808'
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
    """Compute the transmittance of a short-pass edge, 1 / (1 + exp(u + steepening u^3)), u = (wavelength - cut) /
    width.

    wavelength_nm, sin_theta : arrays that broadcast: nm, sine of the angle of incidence
    cut_wavelength_nm, width_nm : where the transmittance is 1/2, and its width, nm
    effective_index : of an interference filter, whose edge moves to cut sqrt(1 - sin^2 / n^2) and its width with it
        (H. A. Macleod, Thin-Film Optical Filters, chapter on tilted coatings); None: absorbing glass, whose edge
        stays
    steepening : 0: the density grows linearly beyond the edge; 0.0173: the integral of a Gaussian of 1.5976 widths
        within 2e-4 (S. R. Bowling et al., J. Ind. Eng. Manag. 2, 114, 2009)

    Returns the transmittance, 0..1.

    >>> edge_transmittance([640.0, 650.0, 660.0], 650.0, 5.0).round(3).tolist()
    [0.881, 0.5, 0.119]
    """
    wavelength, sine = np.broadcast_arrays(np.asarray(wavelength_nm, float), np.asarray(sin_theta, float))
    moved = 1.0 if effective_index is None else np.sqrt(1.0 - (sine / effective_index) ** 2)
    away = (wavelength / moved - cut_wavelength_nm) / width_nm
    return np.asarray(expit(-(away + steepening * away**3)))


#: A veil is so wide (standard deviation, in um of the sensor) that only a scene's mean gets through: 1e5 um.
VEIL_UM = 1e5


def veil_otf(fx_cy_per_um: ArrayLike, fy_cy_per_um: ArrayLike, share: float, std_um: float = VEIL_UM) -> FloatArray:
    """Compute the transfer function of veiling glare: 1 at zero frequency, 1 - share at all that a frame resolves.

    fx_cy_per_um, fy_cy_per_um : arrays that broadcast, cycles per um
    share : of the light, spread by a normal distribution; std_um : its standard deviation, um

    Returns the transfer function.

    >>> veil_otf([0.0, 0.01], 0.0, share=0.02).round(9).tolist()
    [1.0, 0.98]
    """
    f2 = np.asarray(fx_cy_per_um, float) ** 2 + np.asarray(fy_cy_per_um, float) ** 2
    return np.asarray(1.0 - share + share * np.exp(-2.0 * np.pi**2 * std_um**2 * f2))
