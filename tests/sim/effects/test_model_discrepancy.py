"""Model discrepancies of the transfer function by direction and by wavelength."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.model_discrepancy import ModelDiscrepancy
from sim.stages import image_of
from tests.sim.effects.test_sensor_effects import CAMERA

FX, FY = np.array([0.05, 0.0, 0.05]), np.array([0.0, 0.05, 0.05])


def _transfer(shape: str, wavelength_nm: float) -> np.ndarray:
    along = f"{shape}_frequency_cy_per_um"
    effect = ModelDiscrepancy.model_validate({"along": along, "at": (0.0, 0.1), "factor": (1.0, 1.2), "strength": 1.0})
    (law,) = image_of(CAMERA, (effect,)).transfer
    return np.asarray(law(FX, FY, wavelength_nm))


def test_its_shapes_are_those_of_two_phi_and_of_the_wavelength() -> None:
    """At 0.05 cycles per um half of the change of 20 % at 0.1: +-10 % across and down, none along the diagonal, where
    the frequency is larger by sqrt 2."""
    np.testing.assert_allclose(_transfer("astigmatic", 550.0), [1.1, 0.9, 1.0], atol=1e-12)
    np.testing.assert_allclose(_transfer("diagonal", 550.0), [1.0, 1.0, 1.0 + 0.1 * np.sqrt(2.0)], atol=1e-12)
    np.testing.assert_allclose(_transfer("chromatic", 550.0), 1.0, atol=1e-12)
    np.testing.assert_allclose(_transfer("chromatic", 700.0), 1.0 + 0.1 * np.array([1, 1, np.sqrt(2.0)]), atol=1e-12)


@pytest.mark.parametrize("shape", ["astigmatic", "diagonal", "chromatic"])
def test_it_keeps_the_light_and_is_nothing_by_default(shape: str) -> None:
    """At frequency 0 nothing changes, whatever the factor there; without strength nothing does."""
    effect = ModelDiscrepancy.model_validate(
        {"along": f"{shape}_frequency_cy_per_um", "at": (0.0, 0.1), "factor": (0.8, 1.2), "strength": 1.0}
    )
    (law,) = image_of(CAMERA, (effect,)).transfer
    assert float(law(np.zeros(1), np.zeros(1), 700.0)[0]) == pytest.approx(1.0, abs=1e-15)
    assert image_of(CAMERA, (effect.replace_fields(strength=0.0),)).transfer == ()
