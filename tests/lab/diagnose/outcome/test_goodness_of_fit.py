"""Places and measurements: chi2 before and after, on made-up edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.measurements.block import Prediction
from lab.diagnose.measurements.linearity import linearity_block
from lab.diagnose.measurements.spectral import narrowband_block
from lab.diagnose.outcome.goodness_of_fit import measurement_fits, places, residual_curves
from lab.diagnose.policy import DecisionPolicy
from sim.effects.infrared_cut_filter import InfraredCutFilter
from tests.lab.diagnose.on_blocks import measured_model, rendered
from tests.lab.diagnose.outcome.filtered_edges import TRUTH, filtered_edges


def test_measurements_fit_with_the_truth_and_not_without() -> None:
    (fit,) = measurement_fits("left", filtered_edges((TRUTH,)))
    model = filtered_edges().model
    assert (fit.n, fit.held_out_n) == (36, 36)
    assert fit.held_out_before == pytest.approx(model.held_out()[0])
    assert fit.held_out_after == pytest.approx(model.held_out((TRUTH,))[0])
    assert fit.chi2_after < stats.chi2.ppf(0.999, 36) < fit.chi2_before


def test_every_place_has_its_chi2_before_and_after() -> None:
    found = list(places("left", filtered_edges((TRUTH,)), DecisionPolicy()))
    assert {p.axis for p in found} == {"spatial_frequency", "orientation"}
    assert max(p.sigma_before for p in found) > 5.0
    assert max(p.sigma_after for p in found) < 3.0
    assert all(p.chi2_after < p.chi2_before for p in found)


def test_the_baseline_is_drawn_as_a_camera_without_the_effect() -> None:
    """Each line is exposed to 0.7 of the full well of a camera without the filter: 2772 DN above 128 DN. The filter
    cuts the light from 600 nm on, and the level falls; the baseline's curve stays. (The baseline's own fit would follow
    the filter with its nuisance parameters.)"""
    truth = InfraredCutFilter(cut_wavelength_nm=600.0, width_nm=5.0)
    model = measured_model(rendered(6, (truth,), sweep_to_nm=720, repeats=2), linearity_block, narrowband_block)
    assert np.ptp(model.fitted_mean()[model.slices[1]]) > 2000.0
    named = Verdict(model, 12.0, 60.0, (), (Candidate(truth, {}, 1.0, (), 100.0),), (), (), ())
    curves = [curve for curve in residual_curves("left", named) if curve.measurement == "narrowband"]
    measured, before, after = (np.concatenate([getattr(c, f) for c in curves]) for f in ("measured", "before", "after"))
    assert measured.min() < 200.0
    # noise of a level and the reading of its light (0.3 %) leave the rate of a line open by less than a per cent
    np.testing.assert_allclose(before, 128.0 + 2772.0, rtol=0.03)
    np.testing.assert_allclose(after, measured, rtol=0.02)
    assert {curve.quantity for curve in curves} == {"mean level, DN"}


@pytest.mark.parametrize(("is_level", "drawn"), [(True, (0.0, 4095.0)), (False, (-20.0, 9000.0))])
def test_levels_that_the_baseline_has_end_where_a_camera_s_do(is_level: bool, drawn: tuple[float, float]) -> None:
    found = filtered_edges()
    (edges,) = found.model.blocks
    levels = replace(
        edges,
        measurement=replace(edges.measurement, is_level=is_level),
        predict=lambda _: Prediction(np.resize([-20.0, 9000.0], len(edges.value)), {}),
    )
    assert found.model.camera.white_level_dn == 4095.0
    for curve in residual_curves("left", replace(found, model=MeasurementModel((levels,), found.model.camera))):
        assert (min(curve.before), max(curve.before)) == drawn
