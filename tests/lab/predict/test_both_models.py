"""The baseline and the improved model of the same recordings: which effects act in which, and what each predicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lab.diagnose.outcome.improved_model import IN_CURVES
from lab.formats.camera_file import fitted_camera
from lab.formats.results import DiagnosisResult, Unexplained
from lab.predict.both_models import baseline_of, predict_both
from mocks.former import laws as concealed_laws
from sim.effects.infrared_cut_filter import InfraredCutFilter
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from tests.lab.predict.test_validate import DISPLACEMENT_UM, _fitted

NOTHING_LEFT = DiagnosisResult(source="", verdict="explained")


def test_the_baseline_fails_where_the_improved_model_holds() -> None:
    recordings, fit = _fitted(concealed_laws.OpticalLowPassFilterLaw(DISPLACEMENT_UM))
    known = OpticalLowPassFilter(displacement_x_um=DISPLACEMENT_UM, displacement_y_um=DISPLACEMENT_UM)
    camera = replace(fitted_camera(recordings, "left", fit.cameras["left"]), effects=(known,))
    both = predict_both(recordings, fit, {"left": camera}, NOTHING_LEFT)
    assert both is not None
    assert [(c.name, c.capture) for c in both.baseline] == [(c.name, c.capture) for c in both.improved]
    edges = [(a, b) for a, b in zip(both.baseline, both.improved, strict=True) if a.name == "mtf"]
    assert edges and all(not a.passed and b.chi2 < 0.1 * a.chi2 for a, b in edges)
    (curve,) = both.sensitivity["left"].values()
    # A plate that splits rays takes no light: 1e-9 is rounding.
    assert curve.improved == pytest.approx(curve.baseline, rel=1e-9)


def test_a_filter_shows_in_the_sensitivity_and_nothing_judged_gives_no_models() -> None:
    recordings, fit = _fitted()
    assert predict_both(recordings, fit, {}, NOTHING_LEFT) is None
    camera = replace(
        fitted_camera(recordings, "left", fit.cameras["left"]),
        effects=(InfraredCutFilter(cut_wavelength_nm=600.0, width_nm=5.0),),
    )
    told: list[float] = []
    both = predict_both(recordings, fit, {"left": camera}, NOTHING_LEFT, progress=lambda _, share: told.append(share))
    assert both is not None
    assert told == sorted(told) and told[-1] < 1.0
    (curve,) = both.sensitivity["left"].values()
    share = np.array(curve.improved) / np.maximum(np.array(curve.baseline), 1e-12)
    at = np.array(curve.wavelength_nm)
    assert share[at == 600.0] == pytest.approx(
        0.5, abs=0.01
    )  # half of the light; the line is +-2 nm wide and the law odd about it
    assert share[at <= 560.0] == pytest.approx(1.0, abs=0.01)
    assert np.all(share[at >= 650.0] < 0.01)


def test_without_a_named_effect_the_baseline_is_all_there_is() -> None:
    recordings, fit = _fitted()
    camera = fitted_camera(recordings, "left", fit.cameras["left"])
    both = predict_both(recordings, fit, {"left": camera}, NOTHING_LEFT)
    assert both is not None and both.baseline and both.improved == ()
    left_over = Unexplained(
        side="left", measurement="narrowband", axis="wavelength", where="", shape="", significance_sigma=9.0,
        chi2_before=9.0, chi2_after=1.0, n=1, correction=f"signal: {IN_CURVES}, by wavelength and channel",
    )  # fmt: skip
    discrepant = NOTHING_LEFT.model_copy(update={"unexplained": (left_over,)})
    both = predict_both(recordings, fit, {"left": camera}, discrepant)
    assert both is not None and both.improved  # the correction is in its curves, and no effect


def test_what_the_diagnosis_began_with_stays_in_the_baseline() -> None:
    recordings, fit = _fitted()
    began = replace(fitted_camera(recordings, "left", fit.cameras["left"]), effects=(InfraredCutFilter(),))
    improved = replace(began, effects=(*began.effects, OpticalLowPassFilter()))
    assert baseline_of(improved, began, None).effects == began.effects
    assert baseline_of(improved, None, None).effects == ()
