"""Freedom of a maker's sensitivity curve: a constant leak, and the rounding of its values."""

from __future__ import annotations

import numpy as np
import pytest

from lab.diagnose.measurements.curves import LEAK_STD, CurveJacobian, _last_place
from sim.spectrum import Spectrum
from sim.uniform import electron_rate
from tests.lab.diagnose.on_blocks import former, study


def test_decimals_of_a_curve_are_counted() -> None:
    assert _last_place(np.array([0.12, 0.5, 0.047])) == pytest.approx(1e-3)
    assert _last_place(np.array([0.1234567, 0.5])) == pytest.approx(1e-6)


def test_a_leak_is_a_flat_sensitivity_and_a_scale_the_curve_itself() -> None:
    """The leak's column against the forward model with a curve of LEAK_STD of the peak: sums at 1 nm, good to 1e-3."""
    recordings = former(3, kinds=("dark", "narrowband"))
    looked_at = study(recordings)
    capture = recordings.captures("narrowband")[8]
    curves = CurveJacobian(looked_at, [(capture.radiance, "Y", capture.exposure_s, "narrowband", None)])
    columns = list(curves.jacobian(()).values())
    camera = looked_at.camera
    level = LEAK_STD * max(camera.quantum_efficiency["Y"].value)
    flat = camera.model_copy(update={"quantum_efficiency": {"Y": Spectrum.of((300.0, 1100.0), (level, level))}})
    expected = electron_rate(flat, "Y", recordings.spectrum(capture.radiance))
    assert columns[-1][0] == pytest.approx(expected, rel=1e-3)
    assert columns[0][0] == pytest.approx(0.2 * curves.rates(())[0], rel=1e-6)


def test_rounding_of_unrounded_curves_is_next_to_nothing() -> None:
    recordings = former(3, kinds=("dark", "narrowband"))
    capture = recordings.captures("narrowband")[8]
    curves = CurveJacobian(study(recordings), [(capture.radiance, "Y", capture.exposure_s, "narrowband", None)])
    assert curves.rounding[0] < 1e-5 * curves.rates(())[0]
