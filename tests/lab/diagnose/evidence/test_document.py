"""The result of the engine `evidence` on small sessions of the independent simulator: darks and flats alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import lab.inference.recordings
from evaluation.draw import recordings_of
from evaluation.independent_simulator import LISTED, WHOLE_SESSION, ConcealedCamera, Law
from lab.diagnose import Diagnosis, _as_given, examine
from lab.diagnose.evidence import doubt
from lab.diagnose.outcome.expected_information import entropy, expected_information
from lab.diagnose.outcome.next_capture import NOTHING, WITH
from lab.errors import InputError
from lab.formats.recording_set import RecordingSet
from lab.formats.results import CameraFit, DiagnosisResult, FitResult
from lab.inference.check import held_out_ids
from lab.inference.posterior import LIKELIER, NAMED
from lab.inference.statements.statement import restated_camera
from sim.effects.library import effect

PLAN = replace(WHOLE_SESSION, kinds=("dark", "flat"))
#: Hypotheses of the searches here: enough for rivals, few enough for the everyday suite.
HYPOTHESES = ("row_noise", "column_noise", "excess_noise", "nonlinearity", "brighter_fatter", "source_drift")


@pytest.fixture(scope="module", autouse=True)
def few_hypotheses() -> Iterator[None]:
    """Search a few hypotheses in the place of all, and doubt the likeliest sets however sure they are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lab.inference.recordings, "candidates", lambda: tuple(effect(name) for name in HYPOTHESES))
        patch.setattr(doubt, "LEAST", 1e-9)
        patch.setattr(doubt, "SHARE", 1.0)
        yield


def _recordings(*laws: Law) -> RecordingSet:
    return recordings_of(ConcealedCamera(12, laws, cfa="MONO", rows=96, cols=128), PLAN)


@pytest.fixture(scope="module")
def noisy(few_hypotheses: None) -> tuple[RecordingSet, Diagnosis]:
    """Return a session with strong row noise, and its diagnosis."""
    (row_noise,) = (law for law in LISTED if law.name == "row_noise")
    recordings = _recordings(row_noise(8.0))
    return recordings, examine(recordings, engine="evidence", pictures=True)


@pytest.fixture(scope="module")
def result(noisy: tuple[RecordingSet, Diagnosis]) -> DiagnosisResult:
    """Return the result of the session with row noise."""
    return noisy[1].result


def test_what_is_named_has_its_inclusion_probability(result: DiagnosisResult) -> None:
    """The name's probability is that of the table: the listed sets that hold it have no more, and less by what isn't
    listed."""
    (named,) = result.effects
    (models,) = result.models
    assert (named.name, named.sides) == ("row_noise", ("left",))
    assert named.probability >= NAMED
    assert {i.name: i.probability for i in models.inclusion}["row_noise"] == named.probability
    listed = sum(s.probability for s in models.sets if "row_noise" in s.effects)
    assert models.share - (1.0 - named.probability) <= listed <= named.probability + 1e-9


def test_a_size_has_its_uncertainty_and_its_interval(result: DiagnosisResult) -> None:
    for value in result.effects[0].parameters.values():
        assert value.std is not None
        assert value.interval is not None
        assert value.interval[0] <= value.value <= value.interval[1]
        assert value.std > 0.0
    noise = result.effects[0].parameters["noise_e"]
    assert noise.is_determined
    assert noise.shown_interval is None  # as a normal distribution has it


def test_held_out_captures_are_every_third_of_a_setting_and_counted_once(
    noisy: tuple[RecordingSet, Diagnosis],
) -> None:
    recordings, diagnosis = noisy
    held = diagnosis.result.held_out
    assert held is not None
    assert set(held.captures) <= held_out_ids(recordings, "left")
    used = {name for m in diagnosis.result.mismatches for name in m.captures if "held-out" not in m.where}
    assert used.isdisjoint(held.captures)
    fits = diagnosis.result.measurements
    assert held.n == sum(fit.held_out_n for fit in fits)
    assert held.chi2_after == pytest.approx(sum(fit.held_out_after for fit in fits))
    assert held.chi2_before == pytest.approx(sum(fit.held_out_before for fit in fits))
    assert held.chi2_after < held.chi2_before


def test_a_mismatch_is_where_the_effect_acts_and_goes_with_it(result: DiagnosisResult) -> None:
    strongest = max(result.mismatches, key=lambda m: m.significance_sigma)
    assert strongest.measurement == "dark_row_noise"
    (fit,) = (m for m in result.measurements if m.measurement == "dark_row_noise")
    # chi2 has mean n and variance 2 n under the right model: 5 sigma
    assert fit.chi2_before > fit.n + 50.0 * (2.0 * fit.n) ** 0.5
    assert fit.chi2_after < fit.n + 5.0 * (2.0 * fit.n) ** 0.5
    assert {p.measurement for p in result.places} == {m.measurement for m in result.measurements}


def test_the_improved_camera_has_the_name_and_what_stands_in_its_place(
    noisy: tuple[RecordingSet, Diagnosis],
) -> None:
    camera = noisy[1].improved["left"]
    assert [e.name for e in camera.effects] == ["row_noise"]
    assert camera.posterior is not None
    assert "row_noise.noise_e" in camera.posterior.names
    (name,) = camera.posterior.doubts
    assert (name.effect, name.named) == ("row_noise", ("row_noise",))
    assert name.rivals[0].name == ""  # nothing in its place
    assert not name.rivals[0].effects


def test_curves_show_used_and_held_out_captures(result: DiagnosisResult) -> None:
    assert {c.held_out for c in result.curves} == {False, True}
    assert all(len(c.x) == len(c.measured) == len(c.before) == len(c.after) for c in result.curves)


def test_the_result_reads_back(result: DiagnosisResult) -> None:
    assert result.engine == "evidence"
    assert DiagnosisResult.model_validate_json(result.model_dump_json()) == result


def test_no_statement_contradicts_another(result: DiagnosisResult) -> None:
    """A verdict of `explained` has names, nothing unlisted and no contradiction; what contradicts is told."""
    contradictions = [u for u in result.unexplained if "held-out" in u.where]
    unlisted = [u for u in result.unlisted if u.probability >= LIKELIER]
    assert (result.verdict == "explained") == (not contradictions and not unlisted)
    assert any("agree with" in line for line in result.summary) == (not contradictions)


def test_smallest_magnitudes_are_of_what_was_searched(result: DiagnosisResult) -> None:
    seen = {v.effect for v in result.visibility}
    assert seen <= set(HYPOTHESES) | {"other_f_number"}
    for one in result.visibility:
        assert all(size > 0.0 for size in one.smallest.values())
        assert not effect(one.effect).shapes or not one.smallest  # its signature is no power of a size
    assert any(one.smallest for one in result.visibility)


def test_a_doubt_is_about_what_the_likeliest_sets_differ_by(noisy: tuple[RecordingSet, Diagnosis]) -> None:
    """Row noise is in all of them: the rivals are what acts beside it. What a capture tells is at most what is open,
    and it settles no more than all."""
    (open_,) = noisy[1].doubts
    assert NOTHING in open_.rivals
    assert all("row_noise" not in rival.split(WITH) for rival in open_.rivals)
    assert sum(open_.odds) == pytest.approx(1.0)
    assert open_.captures
    for capture in open_.captures:
        assert 0.0 <= expected_information([capture.forecast], open_.odds) <= entropy(open_.odds) + 1e-9
        assert np.all(np.isfinite(capture.forecast.mean))
    for offered in noisy[1].result.next_captures:
        assert offered.settles is not None
        assert max(open_.odds) >= NAMED or offered.settles <= 1.0


def test_the_same_captures_again_tell_no_two_sets_apart_that_fit_them_alike(
    noisy: tuple[RecordingSet, Diagnosis],
) -> None:
    """Sets of which the recordings say so little that both keep their prior odds have the same predictions within the
    noise of these recordings: below 5 standard deviations."""
    (open_,) = noisy[1].doubts
    again = [c for c in open_.captures if "again" in c.words]
    assert again
    for capture in again:
        assert float(np.sqrt(2.0 * capture.forecast.distances().max())) < 5.0, capture.words


def test_a_camera_without_effects_has_no_mismatch(few_hypotheses: None) -> None:
    found = examine(_recordings(), engine="evidence")
    assert found.result.verdict == "no_mismatch"
    assert not found.result.effects
    assert not found.result.mismatches
    assert not found.improved["left"].effects
    assert found.result.false_alarm_rate == pytest.approx(0.01)


def test_a_fit_that_mixed_the_planes_of_a_wrong_mosaic_is_no_baseline() -> None:
    """Of a fit that is given, the cameras whose stated mosaic was corrected are left out."""
    recordings = _recordings()
    fit = FitResult(source="made up", cameras={"left": CameraFit()})
    assert _as_given(fit, recordings.manifest, recordings) == fit
    restated = restated_camera(recordings, "left", cfa="RGGB", quantum_efficiency=None)
    assert _as_given(fit, recordings.manifest, restated).cameras == {}


def test_an_engine_takes_what_is_its_own() -> None:
    with pytest.raises(InputError, match="engine 'odds': isn't one"):
        examine(_recordings(), engine="odds")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="takes no bootstrap"):
        examine(_recordings(), engine="evidence", bootstrap=10)
