"""Spectral distributions: a curve over wavelength, energy and photons, resampling that conserves."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import model_validator
from scipy import constants

from sim.parameters import Frozen

FloatArray = NDArray[np.float64]

#: h c in J nm: the energy of a photon of wavelength w nm is PHOTON_ENERGY_J_NM / w.
PHOTON_ENERGY_J_NM = constants.h * constants.c * 1e9


class Spectrum(Frozen):
    """A curve over wavelength, linear between its samples and zero outside them.

    What `value` is (radiance in W sr^-1 m^-2 nm^-1, a reflectance, a quantum efficiency) stands in the name of the
    variable that holds it. Wavelengths are in nm, strictly ascending; values are finite.
    """

    wavelength_nm: tuple[float, ...]
    value: tuple[float, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.wavelength_nm) != len(self.value) or not self.value:
            raise ValueError(
                f"{len(self.wavelength_nm)} wavelengths and {len(self.value)} values: give as many of the one as of the other"
            )
        steps = np.diff(self.wavelength_nm)
        if np.any(steps <= 0):
            at = int(np.argmax(steps <= 0))
            raise ValueError(
                f"wavelengths must ascend: {self.wavelength_nm[at + 1]} nm follows {self.wavelength_nm[at]} nm; sort the rows"
            )
        return self

    @classmethod
    def of(cls, wavelength_nm: ArrayLike, value: ArrayLike) -> Self:
        """A spectrum from two arrays of the same length."""
        return cls(
            wavelength_nm=tuple(np.asarray(wavelength_nm, float).tolist()),
            value=tuple(np.asarray(value, float).tolist()),
        )

    def at(self, wavelength_nm: ArrayLike) -> FloatArray:
        """Value at the given wavelengths (nm), linear between samples, 0 outside."""
        wanted = np.asarray(wavelength_nm, float)
        return np.interp(wanted, self.wavelength_nm, self.value, left=0.0, right=0.0)


def photons_from_energy(wavelength_nm: ArrayLike, energy: ArrayLike) -> FloatArray:
    """Photons per (s nm ...) of a quantity in W per (nm ...): value x w / (h c)."""
    return np.asarray(energy, float) * np.asarray(wavelength_nm, float) / PHOTON_ENERGY_J_NM
