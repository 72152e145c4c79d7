"""Freedom of a maker's sensitivity curve: a constant leak, what lies beyond its ends, and the rounding of its
values."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.independent_simulator import Law
from evaluation.independent_simulator.laws import StrayLightLaw
from lab.diagnose.inference.refit import refit
from lab.diagnose.policy import DecisionPolicy
from lab.formats.recording_set import RecordingSet
from lab.observables.spectra.curves import BEYOND_STD, LEAK_STD, CurveJacobian, _last_place
from lab.observables.spectra.narrowband import measure_narrowband
from sim.effects.stray_light import StrayLight
from sim.spectrum import Spectrum
from sim.uniform import electron_rate
from tests.lab.diagnose.on_blocks import dataset, former, measured_model


def test_decimals_of_a_curve_are_counted() -> None:
    assert _last_place(np.array([0.12, 0.5, 0.047])) == pytest.approx(1e-3)
    assert _last_place(np.array([0.1234567, 0.5])) == pytest.approx(1e-6)


def test_a_leak_is_a_flat_sensitivity_and_a_scale_the_curve_itself() -> None:
    """The leak's column against the forward model with a curve of LEAK_STD of the peak: sums at 1 nm, good to 1e-3."""
    recordings = former(3, kinds=("dark", "narrowband"))
    looked_at = dataset(recordings)
    capture = recordings.captures("narrowband")[8]
    curves = CurveJacobian(looked_at, [(capture.radiance, "Y", capture.exposure_s, "narrowband", None)])
    columns = list(curves.jacobian(()).values())
    camera = looked_at.camera
    level = LEAK_STD * max(camera.quantum_efficiency["Y"].value)
    flat = camera.model_copy(update={"quantum_efficiency": {"Y": Spectrum.of((300.0, 1100.0), (level, level))}})
    expected = electron_rate(flat, "Y", recordings.spectrum(capture.radiance))
    assert columns[-2][0] == pytest.approx(expected, rel=1e-3)
    assert columns[-1][0] == 0.0  # no light beyond the curve's ends
    assert columns[0][0] == pytest.approx(0.2 * curves.rates(())[0], rel=1e-6)


def test_rounding_of_unrounded_curves_is_next_to_nothing() -> None:
    recordings = former(3, kinds=("dark", "narrowband"))
    capture = recordings.captures("narrowband")[8]
    curves = CurveJacobian(dataset(recordings), [(capture.radiance, "Y", capture.exposure_s, "narrowband", None)])
    assert curves.rounding[0] < 1e-5 * curves.rates(())[0]


END_NM = 680.0


def _short_curves(*laws: Law) -> RecordingSet:
    """A colour camera's sweep to `END_NM`, whose maker states its curves to there."""
    whole = former(3, *laws, cfa="RGGB", kinds=("dark", "narrowband"))
    sweep = whole.captures("narrowband")
    spectra = {c.radiance: whole.spectrum(c.radiance) for c in sweep}
    for name in whole.camera("left").quantum_efficiency.values():
        wavelength, value = whole.spectrum(name).arrays
        spectra[name] = Spectrum.of(wavelength[wavelength <= END_NM], value[wavelength <= END_NM])
    frames = {c.frame: whole.frame(c) for c in whole.captures()}
    short = RecordingSet(whole.manifest, frames, spectra, source="former")
    return short.without({c.id for c in sweep if c.wavelength_nm > END_NM})


def test_what_a_curve_leaves_out_beyond_its_end_is_in_the_uncertainty_of_stray_light() -> None:
    """A sensor sees more of the stray light than the stated part of its curve does: the share is found too large by as
    much."""
    model = measured_model(_short_curves(StrayLightLaw(1.0)), measure_narrowband)
    fit = refit(model, (StrayLight(share_percent=0.5),), DecisionPolicy())
    std = fit.std[0]["share_percent"]
    assert std is not None
    assert abs(fit.effects[0].share_percent - 1.0) < 3.0 * std  # type: ignore[attr-defined]


def test_sensitivity_beyond_a_curve_falls_to_where_silicon_ends() -> None:
    """The column against the forward model with a curve that falls from the last value to 0 at 1107 nm; light there
    only by the stray share."""
    recordings, stray = _short_curves(), (StrayLight(share_percent=5.0),)
    looked_at = dataset(recordings)
    capture = recordings.captures("narrowband")[3]
    curves = CurveJacobian(looked_at, [(capture.radiance, "R", capture.exposure_s, "narrowband", None)])
    last = looked_at.camera.quantum_efficiency["R"].value[-1]
    wavelength = np.arange(END_NM, 1108.0)
    outside = BEYOND_STD * last * (1107.0 - wavelength) / (1107.0 - END_NM)
    camera = looked_at.camera.model_copy(update={"quantum_efficiency": {"R": Spectrum.of(wavelength, outside)}})
    expected = electron_rate(camera, "R", recordings.spectrum(capture.radiance), stray, kind="narrowband")
    assert list(curves.jacobian(stray).values())[-1][0] == pytest.approx(
        expected, rel=1e-2
    )  # half a nm of 100 at the end
