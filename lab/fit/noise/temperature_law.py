"""The law of the dark current against temperature."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.fit.weighted_lines import chi2_factor, least_squares
from lab.formats.results import DarkCurrentLaws

BOLTZMANN_EV_PER_K = 8.617333262e-5
ZERO_C_K = 273.15


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
