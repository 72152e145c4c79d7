"""The pipeline: which steps each goal takes, what is kept, cancelling, and resolving. The steps themselves are
stand-ins."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import pytest

import lab.diagnose
import lab.fit
import lab.predict.validate
import lab.report
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession, Progress
from lab.capture.store import Store
from lab.capture.take_step import DUMMY_FRAMES
from lab.capture_kinds.dark import DarkSequence
from lab.diagnose import Diagnosis
from lab.diagnose.outcome.next_capture import CaptureProposal
from lab.diagnose.policy import DecisionPolicy
from lab.errors import Cancelled, InputError
from lab.formats import recording_set
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DiagnosisResult, FitResult, NextCapture, ValidationResult
from lab.pipeline import (
    STEPS,
    CaptureRequest,
    Goal,
    PipelineProgress,
    PipelineRequest,
    capture_here,
    run_pipeline,
    source_recordings,
)
from tests.lab import fake_bench

DARKS = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The steps that were taken, in their order; each is a stand-in that costs nothing."""
    taken: list[str] = []

    def fit(recordings: RecordingSet, tell: Callable[[str, float], None], parts: Collection[str]) -> FitResult:
        taken.append("fit")
        tell("half of it", 0.5)
        return FitResult(source=recordings.source, cameras={})

    def validate(
        recordings: RecordingSet, fitted: FitResult, models: Any = None, progress: Any = None
    ) -> ValidationResult:
        taken.append("validate")
        return ValidationResult(source=recordings.source, checks=())

    def examine(recordings: RecordingSet, fitted: FitResult, tell: Any, **_: Any) -> Diagnosis:
        taken.append("diagnose")
        return Diagnosis(DiagnosisResult(source=recordings.source, verdict="no_mismatch"), {})

    def write_report(file: Path, *_: object) -> Path:
        taken.append("report")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("a page")
        return file

    monkeypatch.setattr(lab.fit, "fit_recording_set", fit)
    monkeypatch.setattr(lab.predict.validate, "validate", validate)
    monkeypatch.setattr(lab.diagnose, "examine", examine)
    monkeypatch.setattr(lab.report, "write_report", write_report)
    return taken


class Bench:
    """Captures on instruments that are not there, and counts the sessions."""

    def __init__(self, store: Store) -> None:
        self.store, self.bench = store, fake_bench.Bench()
        self.asked: list[CaptureRequest] = []

    def __call__(self, request: CaptureRequest, tell: Callable[[Progress], None]) -> str:
        self.asked.append(request)
        return capture_here(self.store, fake_bench.station(), request, tell, self.bench.drivers)


# --- goals ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("goal", ["fit", "validate", "diagnose", "report"])
def test_a_goal_takes_what_leads_to_it_and_keeps_it_for_the_job(
    goal: Goal, small_set: Callable[..., RecordingSet], store: Store, steps: list[str]
) -> None:
    page = store.root / "reports" / "j.html"
    request = PipelineRequest(goal, recordings=small_set(), source="a folder", reuse=True, report_file=page)
    found = run_pipeline(request, store=store)
    assert steps == list(STEPS[goal])
    assert [kept.kind for kept in reversed(store.results("a folder"))] == steps
    made = {"fit": found.fit, "validate": found.validation, "diagnose": found.diagnosis, "report": found.report}
    assert {step for step, result in made.items() if result is not None} == set(steps)
    if goal == "report":
        shown = store.results("a folder", "report")[0].document
        assert shown["path"] == "reports/j.html"
        assert {kind: store.result(id).kind for kind, id in shown["results"].items()} == {k: k for k in STEPS[goal][:3]}


def test_a_finished_sessions_results_are_reused_and_its_goal_is_made_anew(store: Store, steps: list[str]) -> None:
    session = CaptureSession.start(store, fake_bench.station(), DARKS, connect=fake_bench.Bench().drivers).run().id
    recordings = store.recording_set(session)
    for _ in range(2):
        run_pipeline(PipelineRequest("diagnose", recordings=recordings, source=session, reuse=True), store=store)
    assert steps == ["fit", "diagnose", "diagnose"]
    run_pipeline(PipelineRequest("diagnose", recordings=recordings, source=session), store=store)
    assert steps == ["fit", "diagnose", "diagnose", "fit", "diagnose"]
    # A folder may have changed: nothing old is taken for it.
    for _ in range(2):
        run_pipeline(PipelineRequest("diagnose", recordings=recordings, source="folder", reuse=True), store=store)
    assert steps[5:] == ["fit", "diagnose"] * 2


def test_results_that_are_given_are_not_made_again(
    small_set: Callable[..., RecordingSet], tmp_path: Path, steps: list[str]
) -> None:
    given = {
        "fit": FitResult(source="given", cameras={}),
        "validation": ValidationResult(source="given", checks=()),
        "diagnosis": DiagnosisResult(source="given", verdict="no_mismatch"),
    }
    request = PipelineRequest("report", recordings=small_set(), report_file=tmp_path / "page.html", **given)  # type: ignore[arg-type]
    found = run_pipeline(request)
    assert steps == ["report"]
    assert {name: getattr(found, name) for name in given} == given


def test_a_diagnosis_that_nothing_is_reused_of_takes_the_fits_it_rests_on_alone(
    small_set: Callable[..., RecordingSet], store: Store, monkeypatch: pytest.MonkeyPatch, steps: list[str]
) -> None:
    asked: list[tuple[str, ...]] = []

    def fit(recordings: RecordingSet, tell: Callable[[str, float], None], parts: Collection[str]) -> FitResult:
        asked.append(tuple(parts))
        return FitResult(source=recordings.source, cameras={})

    monkeypatch.setattr(lab.fit, "fit_recording_set", fit)
    for goal in ("diagnose", "fit"):
        run_pipeline(PipelineRequest(goal, recordings=small_set(), source="a folder"), store=store)
    assert asked == [lab.fit.FOR_DIAGNOSIS, lab.fit.STEPS]
    assert sorted(kept.kind for kept in store.results("a folder")) == ["diagnose", "fit"]  # the whole fit alone is kept


def test_a_given_fit_is_not_made_again_and_nothing_is_kept_without_leave(
    small_set: Callable[..., RecordingSet], store: Store, steps: list[str]
) -> None:
    given = FitResult(source="given", cameras={})
    request = PipelineRequest("validate", recordings=small_set(), source="s", keep=False, fit=given)
    assert run_pipeline(request, store=store).fit is given
    assert steps == ["validate"]
    assert store.results() == []


def test_a_request_has_one_source(small_set: Callable[..., RecordingSet]) -> None:
    with pytest.raises(ValueError, match="either recordings or capture"):
        PipelineRequest("fit")
    with pytest.raises(ValueError, match="either recordings or capture"):
        PipelineRequest("fit", recordings=small_set(), capture=CaptureRequest())


def test_a_source_is_a_folder_or_a_session(
    store: Store, tmp_path: Path, small_set: Callable[..., RecordingSet]
) -> None:
    folder = recording_set.write(small_set(), tmp_path / "set")
    assert source_recordings(str(folder), lambda: pytest.fail("opened a store")).source == str(folder)
    unfinished = CaptureSession.start(store, fake_bench.station(), DARKS, connect=fake_bench.Bench().drivers).id
    for source, opened, said in (
        (unfinished, store, "nothing was captured yet"),
        ("20260101-000000-abcdef", store, "no session in"),
        ("20260101-000000-abcdef", None, "there is no data folder"),
        (str(tmp_path / "nowhere"), None, "no such folder"),
    ):
        with pytest.raises(InputError, match=said):
            source_recordings(source, lambda opened=opened: opened)


# --- the whole pipeline -----------------------------------------------------------------------------------------------


def test_the_whole_pipeline_captures_and_leaves_everything_in_the_sessions_folder(
    store: Store, steps: list[str]
) -> None:
    told: list[PipelineProgress] = []
    request = PipelineRequest("pipeline", capture=CaptureRequest(plan=DARKS, name="darks"))
    found = run_pipeline(request, told.append, store=store, capturer=Bench(store))
    assert steps == ["fit", "validate", "diagnose", "report"]
    assert found.session is not None
    folder = store.folder(found.session)
    assert found.report == folder / "report.html"
    assert FitResult.model_validate_json((folder / "fit.json").read_text()) == found.fit
    assert DiagnosisResult.model_validate_json((folder / "diagnose.json").read_text()) == found.diagnosis
    assert (folder / "validate.json").exists()
    assert [kept.kind for kept in reversed(store.results(found.session))] == [*steps[:3], "pipeline"]
    assert [step for step, _ in itertools.groupby(one.step for one in told)] == ["capture", *steps]
    shares = [one.share for one in told]
    assert shares == sorted(shares) and shares[0] >= 0.0 and shares[-1] < 1.0
    captured = [one.capture for one in told if one.capture is not None]
    assert captured[-1].done == captured[-1].total == 4


def test_a_cancelled_capture_is_resumed_by_the_next_pipeline(store: Store, steps: list[str]) -> None:
    def cancel(progress: PipelineProgress) -> None:
        if progress.capture is not None and progress.capture.done == 2:
            raise Cancelled

    bench = Bench(store)
    with pytest.raises(Cancelled):
        run_pipeline(
            PipelineRequest("pipeline", capture=CaptureRequest(plan=DARKS)), cancel, store=store, capturer=bench
        )
    assert steps == []
    (session,) = store.sessions()
    assert session.state == "interrupted" and session.steps_done >= 2
    shots = bench.bench.shots
    found = run_pipeline(
        PipelineRequest("pipeline", capture=CaptureRequest(session=session.id)), store=store, capturer=bench
    )
    assert found.session == session.id
    # nothing is taken twice; dummy frames come first, as what the cameras hold isn't known
    assert bench.bench.shots - shots == session.steps - session.steps_done + DUMMY_FRAMES
    # A finished session needs no instrument.
    run_pipeline(PipelineRequest("pipeline", capture=CaptureRequest(session=session.id)), store=store)


@pytest.mark.parametrize("step", ["fit", "validate", "diagnose", "report"])
def test_cancelling_ends_the_pipeline_before_the_next_step(
    step: str, small_set: Callable[..., RecordingSet], store: Store, steps: list[str]
) -> None:
    def cancel(progress: PipelineProgress) -> None:
        if progress.step == step:
            raise Cancelled

    request = PipelineRequest("report", recordings=small_set(), source="s", report_file=store.root / "r.html")
    with pytest.raises(Cancelled):
        run_pipeline(request, cancel, store=store)
    done = list(STEPS["report"][: STEPS["report"].index(step)])  # type: ignore[arg-type]
    assert steps == done
    assert [kept.kind for kept in reversed(store.results("s"))] == done  # what was done stays


def test_a_session_takes_only_the_sequences_that_are_named(store: Store) -> None:
    request = CaptureRequest(quick=True, only=("dark",))
    found = run_pipeline(PipelineRequest("capture", capture=request), store=store, capturer=Bench(store))
    assert found.session is not None
    captures = store.captures(found.session)
    assert captures and {capture.kind for capture in captures} == {"dark"}


def test_only_with_a_station_is_anything_captured(store: Store) -> None:
    with pytest.raises(InputError, match="no station to capture on"):
        run_pipeline(PipelineRequest("capture", capture=CaptureRequest()), store=store)


# --- resolving --------------------------------------------------------------------------------------------------------


def proposal(capture: str, distance: float = 9.0, told_apart: float = 0.98, can_take: bool = True) -> CaptureProposal:
    wanted = NextCapture(
        side="left", capture=capture, rivals=("defocus", "coma"), distance=distance, told_apart=told_apart
    )
    return CaptureProposal(wanted, DARKS if can_take else None)


TIE = "partly_explained"


@pytest.mark.parametrize(
    ("proposed", "taken", "said"),
    [
        pytest.param([[]], [], "no rivals are left", id="no tie"),
        pytest.param([[proposal("darks")], []], ["darks"], "no rivals are left", id="settled by one"),
        pytest.param(
            [[proposal("darks", told_apart=0.9)], [proposal("darks"), proposal("more darks")], []],
            ["darks", "more darks"],
            "no rivals are left",
            id="settled by two, none of them taken twice",
        ),
        pytest.param(
            [[proposal("edges", can_take=False), proposal("darks")], []],
            ["darks"],
            "no rivals are left",
            id="the best that the station takes by itself",
        ),
        pytest.param(
            [[proposal("darks", distance=0.9 * DecisionPolicy().next_capture_distance)]],
            [],
            "no capture that the station takes by itself would tell defocus from coma",
            id="not worth it",
        ),
        pytest.param(
            [[proposal("darks", told_apart=0.98)], [proposal("more", told_apart=0.98)], [proposal("most")]],
            ["darks", "more"],
            "the captures that were taken didn't tell defocus from coma",
            id="given up: both failed with a probability of 0.0004",
        ),
    ],
)
def test_resolving_captures_and_diagnoses_until_nothing_can_settle_the_tie(
    proposed: list[list[CaptureProposal]],
    taken: list[str],
    said: str,
    store: Store,
    steps: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[int] = []

    def examine(recordings: RecordingSet, fitted: FitResult, tell: Any, **_: Any) -> Diagnosis:
        at = len(seen)
        seen.append(len(recordings.captures()))
        verdict = "explained" if at == len(proposed) - 1 else TIE
        return Diagnosis(DiagnosisResult(source=recordings.source, verdict=verdict), {}, tuple(proposed[at]))

    monkeypatch.setattr(lab.diagnose, "examine", examine)
    bench, remarks = Bench(store), []
    request = PipelineRequest("pipeline", capture=CaptureRequest(plan=DARKS, name="one"), resolve=True)

    def tell(progress: PipelineProgress) -> None:
        if progress.remark:
            remarks.append(progress.remark)

    found = run_pipeline(request, tell, store=store, capturer=bench)
    assert found.diagnosis is not None and found.diagnosis.verdict == "explained"
    assert [one.capture for one in found.diagnosis.resolutions] == taken
    assert all(one.verdict_before == TIE for one in found.diagnosis.resolutions)
    assert [one.name for one in bench.asked] == ["one", *["one resolve"] * len(taken)]
    assert seen == [8 * (1 + number) for number in range(len(taken) + 1)]  # each diagnosis sees all captures before it
    assert len(remarks) == 1 and said in remarks[0]
    kept = store.results(found.session, "diagnose")
    assert len(kept) == len(taken) + 1 and kept[0].document == found.diagnosis.model_dump(mode="json")
