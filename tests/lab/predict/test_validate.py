"""Validation on recordings of the second image former: a healthy camera passes, a concealed filter fails, and passes
with its model."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator import laws as concealed_laws
from lab.diagnose.outcome.improved_model import IN_CURVES
from lab.errors import Cancelled
from lab.fit import fit_recording_set
from lab.fit.psf.screen_kernel import expected_kernel
from lab.formats.camera_file import fitted_camera
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DiagnosisResult, FitResult, Unexplained, ValidationResult
from lab.predict.validate import baseline_of, predict_both, validate
from sim.effects.infrared_cut_filter import InfraredCutFilter
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from sim.point import kernel, optical_transfer

DISPLACEMENT_UM = 1.6


@cache
def _fitted(*concealed: Law) -> tuple[RecordingSet, FitResult]:
    # f/2: the lens leaves much beyond the pixels' Nyquist frequency
    recordings = recordings_of(ConcealedCamera(931, concealed, cfa="MONO", f_number=2.0, rows=256, cols=320))
    return recordings, fit_recording_set(recordings)


def _passed(result: ValidationResult) -> dict[str, bool]:
    return {name: all(c.passed for c in result.checks if c.name == name) for name in {c.name for c in result.checks}}


def test_a_healthy_camera_is_predicted_within_its_uncertainty() -> None:
    result = validate(*_fitted())
    assert _passed(result) == {"colorchecker": True, "mtf": True, "psf": True}
    assert not result.skipped
    assert all(check.n > 0 and check.chi2 > 0 for check in result.checks)


def test_a_concealed_filter_shows_in_edges_and_kernels_and_its_model_mends_it() -> None:
    recordings, fit = _fitted(concealed_laws.OpticalLowPassFilterLaw(DISPLACEMENT_UM))
    plain = validate(recordings, fit)
    assert _passed(plain) == {"colorchecker": True, "mtf": False, "psf": False}
    known = OpticalLowPassFilter(displacement_x_um=DISPLACEMENT_UM, displacement_y_um=DISPLACEMENT_UM)
    camera = fitted_camera(recordings, "left", fit.cameras["left"])
    mended = validate(recordings, fit, {"left": replace(camera, effects=(known,))})
    before = {c.capture: c.chi2 for c in plain.checks if c.name == "mtf"}
    for check in mended.checks:
        if check.name == "mtf":
            assert check.chi2 < 0.1 * before[check.capture]


def test_it_tells_what_it_checks_and_ends_where_that_raises() -> None:
    told: list[tuple[str, float]] = []

    def tell(what: str, share: float) -> None:
        told.append((what, share))
        if what.startswith("mtf, left: "):  # within the edges, not between two kinds of check
            raise Cancelled

    with pytest.raises(Cancelled):
        validate(*_fitted(), progress=tell)
    assert [share for _, share in told] == sorted(share for _, share in told) and told[-1][1] < 1.0


def test_what_isn_t_there_is_skipped_with_its_reason() -> None:
    result = validate(
        recordings_of(ConcealedCamera(931, cfa="MONO", rows=64, cols=80), Plan(("dark",))),
        FitResult(source="", cameras={}),
    )
    assert not result.checks
    assert {s.step for s in result.skipped} == {"validate colorchecker", "validate mtf", "validate psf"}
    assert all(s.reason for s in result.skipped)


def test_the_expected_kernel_of_a_soft_lens_is_the_forward_models() -> None:
    """Without detail that half a pixel's samples can't hold, least squares on any pattern find the transfer's own
    kernel: five taps leave some 1e-3 of the maximum in the core. Of a sharp one the rims of the cells make it
    another."""
    for f_number, apart in ((8.0, (0.0, 6e-3)), (1.8, (2e-2, 0.2))):
        model = camera_model(
            recordings_of(ConcealedCamera(931, cfa="MONO", f_number=f_number, rows=32, cols=32), Plan(("dark",))),
            "left",
        )
        expected = expected_kernel(partial(optical_transfer, model, "Y", None), 9, 4.0)
        plain = kernel(model, "Y", None, 9)
        assert expected.sum() == pytest.approx(1.0)
        assert apart[0] <= np.abs(expected - plain)[2:-2, 2:-2].max() / plain.max() <= apart[1]


# --- The baseline and the improved model of the same recordings: which effects act in which, and what each predicts ---


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
