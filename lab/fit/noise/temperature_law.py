"""The law of the dark current against temperature."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lab.fit.weighted_lines import chi2_factor, least_squares
from lab.formats.results import DarkCurrentLaws
from sim.parameters import Frozen

BOLTZMANN_EV_PER_K = 8.617333262e-5
ZERO_C_K = 273.15
#: Rise in temperature that doubles the dark current of silicon, where no fit tells it: ln 2 k T^2 / E at 300 K with an activation energy
#: between that of diffusion, 1.12 eV, and that of generation amid the band gap, 0.56 eV (Widenhorn et al. 2002, Proc. SPIE 4669, 193):
#: 4.8 to 9.6 K, of uniform probability.
DOUBLING_C, DOUBLING_C_STD = 7.2, 1.4
#: Standard deviation of the temperature of a sensor that states none: a laboratory's air of 18 to 26 degrees, and a camera that is
#: between cold and warmed up by 12 degrees, both of uniform probability: hypot(8, 12) / sqrt(12).
UNKNOWN_C_STD = 4.2
#: Standard deviation of a reading of the sensor's own thermometer against itself: a resolution of 0.125 degrees, and its noise.
THERMOMETER_C_STD = 0.1


class SensorTemperature(Frozen):
    """At which temperature a dark current was measured (None: not known), and by how much a rise doubles it."""

    temperature_c: float | None = None
    doubling_c: float = DOUBLING_C
    doubling_c_std: float = DOUBLING_C_STD

    @property
    def text(self) -> str:
        """The temperature as it stands behind the name of a dark current."""
        return "at an unknown temperature" if self.temperature_c is None else f"at {self.temperature_c:.1f} °C"

    def doublings(self, reference: SensorTemperature) -> tuple[float, float]:
        """By how many times 2 a dark current at the reference's temperature is larger than at this one, and the standard deviation.

        The doubling temperature is the better known of both. Where a temperature isn't known, the number is 0 and its standard deviation
        that of the temperatures that a laboratory's sensors have.
        """
        law = min(self, reference, key=lambda one: one.doubling_c_std)
        if self.temperature_c is None or reference.temperature_c is None:
            unknown = (self.temperature_c is None) + (reference.temperature_c is None)
            return 0.0, math.sqrt(unknown) * UNKNOWN_C_STD / law.doubling_c
        rise_c = reference.temperature_c - self.temperature_c
        of_law = rise_c * law.doubling_c_std / law.doubling_c**2
        return rise_c / law.doubling_c, math.hypot(of_law, math.sqrt(2.0) * THERMOMETER_C_STD / law.doubling_c)


def temperature_law(found: Sequence[tuple[float, float, float]], gain_error: float = 0.0) -> DarkCurrentLaws:
    """The Arrhenius law and the doubling temperature of EMVA 1288 through dark currents `found`: (deg C, e/s, its
    standard deviation).

        ln I = ln I_ref - E / k (1/T - 1/T_ref),    ln I = a + ln 2 (T - T_ref) / T_d

    Weighted lines, T_ref the coldest temperature. Only currents above three standard deviations are used; two
    temperatures are needed. `gain_error`: relative error of the gain, common to all.
    """
    listed = np.array(found, float)
    plain = DarkCurrentLaws(
        temperature_c=tuple(listed[:, 0]),
        dark_current_e_per_s=tuple(listed[:, 1]),
        dark_current_e_per_s_std=tuple(float(std) for std in np.hypot(listed[:, 2], gain_error * listed[:, 1])),
    )
    temperature, current, std = listed[listed[:, 1] > 3.0 * listed[:, 2]].T
    if np.unique(temperature).size < 2:
        return plain
    reference = float(temperature.min())
    inverse = 1.0 / (temperature + ZERO_C_K) - 1.0 / (reference + ZERO_C_K)
    fits = []
    for axis in (-inverse / BOLTZMANN_EV_PER_K, np.log(2.0) * (temperature - reference)):
        basis = np.stack([np.ones_like(axis), axis], axis=1)
        solution, covariance, chi2 = least_squares(basis, np.log(current), std / current)
        covariance *= chi2_factor(chi2, temperature.size - 2)
        fits.append((solution, covariance))
    (arrhenius, arrhenius_covariance), (doubling, doubling_covariance) = fits
    at_reference = float(np.exp(arrhenius[0]))
    update: dict[str, float] = {
        "activation_energy_ev": float(arrhenius[1]),
        "activation_energy_ev_std": float(np.sqrt(arrhenius_covariance[1, 1])),
        "reference_temperature_c": reference,
        "reference_current_e_per_s": at_reference,
        "reference_current_e_per_s_std": at_reference
        * float(np.hypot(np.sqrt(arrhenius_covariance[0, 0]), gain_error)),
    }
    if doubling[1] > 3.0 * np.sqrt(doubling_covariance[1, 1]):
        update["doubling_temperature_c"] = 1.0 / float(doubling[1])
        update["doubling_temperature_c_std"] = float(np.sqrt(doubling_covariance[1, 1]) / doubling[1] ** 2)
    return plain.model_copy(update=update)
