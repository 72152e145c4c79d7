"""Dark current against temperature."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.noise.dark_current import temperature_law


def test_dark_currents_follow_arrhenius_and_double() -> None:
    kelvin = np.array([293.15, 303.15, 313.15])
    current = 20.0 * np.exp(-0.6 / 8.617333262e-5 * (1.0 / kelvin - 1.0 / kelvin[0]))
    law = temperature_law([(t - 273.15, i, 0.01 * i) for t, i in zip(kelvin, current, strict=True)])
    assert law.activation_energy_ev == pytest.approx(0.6, rel=1e-6)
    assert law.reference_current_e_per_s == pytest.approx(20.0, rel=1e-6)
    # d ln I / dT = E / k T^2 at the middle: 9.14 deg C for a factor of 2, and the law bends within these 20 by 7 %.
    assert law.doubling_temperature_c == pytest.approx(np.log(2.0) * 8.617333262e-5 * 303.15**2 / 0.6, rel=0.02)
    assert law.activation_energy_ev_std == pytest.approx(
        0.01 * np.sqrt(2) * 8.617333262e-5 / (1 / 293.15 - 1 / 313.15), rel=0.05
    )
    alone = temperature_law([(20.0, 5.0, 0.1), (30.0, 0.1, 0.1)])
    assert alone.activation_energy_ev is None
    assert alone.doubling_temperature_c is None
