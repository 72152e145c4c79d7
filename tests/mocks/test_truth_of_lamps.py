"""The bench's lamps: rendered finer than the laws that a diagnosis fits, and the same in their limits."""

from __future__ import annotations

import numpy as np
import pytest

from mocks.conceal import parse
from mocks.truth import hidden_truth
from sim.effects.base import Effect
from sim.effects.lamp_ageing import LampAgeing
from sim.effects.source_drift import SourceDrift
from sim.stages import light_of

SHAPE = (16, 16)
WAVELENGTH_NM = np.arange(380.0, 731.0, 1.0)


def _hidden(spec: str) -> Effect:
    (effect,) = hidden_truth(1, parse([spec]), SHAPE).cameras["left"].effects
    return effect


def test_a_warm_up_has_two_stages() -> None:
    """Its first slope is the one stated; its end lies 0.06 (1 - 1/4) = 4.5 % of the whole change short of that."""
    stated = SourceDrift(drift_percent_per_min=2.0, settling_min=8.0)
    hidden = _hidden("both:source_drift:drift_percent_per_min=2,settling_min=8")
    camera = hidden_truth(1, {}, SHAPE).cameras["left"].model
    one, two = (light_of(camera, (effect,)) for effect in (stated, hidden))
    assert two.source(1.0) - 1.0 == pytest.approx(one.source(1.0) - 1.0, rel=5e-3)
    assert (two.source(1e5) - 1.0) / (one.source(1e5) - 1.0) == pytest.approx(1.0 - 0.045)
    linear = _hidden("both:source_drift:drift_percent_per_min=2")
    assert light_of(camera, (linear,)).source(600.0) == pytest.approx(1.2, rel=2e-4)


def test_an_aged_lamp_bends_and_keeps_its_integral() -> None:
    hidden = _hidden("both:lamp_ageing:reddening_percent=10")
    camera = hidden_truth(1, {}, SHAPE).cameras["left"].model
    even = np.full(WAVELENGTH_NM.shape, 0.01)
    aged = light_of(camera, (hidden,)).radiance(WAVELENGTH_NM, even, "flat")
    assert np.trapezoid(aged, WAVELENGTH_NM) == pytest.approx(np.trapezoid(even, WAVELENGTH_NM))
    tilt = np.log(aged[WAVELENGTH_NM == 650.0] / aged[WAVELENGTH_NM == 450.0])
    assert tilt == pytest.approx(0.2)  # the bend is even about 550 nm
    middle = np.log(aged[WAVELENGTH_NM == 550.0] / np.sqrt(aged[WAVELENGTH_NM == 650.0] * aged[WAVELENGTH_NM == 450.0]))
    assert middle == pytest.approx(0.1 * 0.05)
    fitted = light_of(camera, (LampAgeing(reddening_percent=10.0),)).radiance(WAVELENGTH_NM, even, "flat")
    # what the law leaves is within its form tolerance, a fifth of its change
    assert np.std(np.log(aged / fitted)) < 0.2 * np.std(np.log(fitted / even))
    np.testing.assert_array_equal(light_of(camera, (hidden,)).radiance(WAVELENGTH_NM, even, "narrowband"), even)
