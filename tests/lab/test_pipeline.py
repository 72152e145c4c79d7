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
import lab.resolve
from lab.capture.catalogue import StepTimes
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession, Progress
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture.take_step import DUMMY_FRAMES
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.stopped_edge import StoppedEdgeSequence
from lab.diagnose import Diagnosis
from lab.diagnose.outcome.next_capture import Doubt
from lab.errors import Cancelled, InputError
from lab.formats import recording_set
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DiagnosisResult, DiagnosisVerdict, FitResult, ValidationResult
from lab.pipeline import (
    STEPS,
    CaptureRequest,
    Goal,
    PipelineProgress,
    PipelineRequest,
    PipelineResult,
    capture_here,
    run_pipeline,
    source_recordings,
)
from lab.resolve import ResolveLimits, check_same_cameras, read_journal, resolving_folder, station_of
from tests.lab import fake_bench
from tests.lab.doubts import DARKS, doubt, offered


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


TIE: DiagnosisVerdict = "partly_explained"
UNTAKEN = offered("edges at f/8", plan=None)
#: A quarter of an hour at the typical time of a pair of frames.
LONG = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=900),))


def resolving(
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    doubts: list[list[Doubt]],
    limits: ResolveLimits | None = None,
    tell: Callable[[PipelineProgress], None] | None = None,
    session: str = "",
    verdict: DiagnosisVerdict = "explained",
) -> tuple[PipelineResult, list[int]]:
    """A pipeline whose diagnoses leave these doubts one after the other; and how many captures each diagnosis saw."""
    seen: list[int] = []

    def examine(recordings: RecordingSet, fitted: FitResult, tell: Any, **_: Any) -> Diagnosis:
        left = doubts[len(seen)]
        seen.append(len(recordings.captures()))
        said = DiagnosisResult(source=recordings.source, verdict=TIE if left else verdict, next_capture="Take darks.")
        return Diagnosis(said, {}, tuple(left))

    monkeypatch.setattr(lab.diagnose, "examine", examine)
    monkeypatch.setattr(
        lab.resolve, "step_times", lambda *_: StepTimes({})
    )  # typical times, whatever this computer does
    capture = CaptureRequest(session=session) if session else CaptureRequest(plan=DARKS, name="one")
    request = PipelineRequest("pipeline", capture=capture, resolve=limits or ResolveLimits())
    return run_pipeline(request, tell, store=store, capturer=Bench(store)), seen


@pytest.mark.parametrize(
    ("doubts", "limits", "taken", "end", "said"),
    [
        pytest.param([[]], None, [], "settled", "no rivals are left", id="no tie"),
        pytest.param([doubt(offered("darks")), []], None, ["darks"], "settled", "no rivals are left", id="by one"),
        pytest.param(
            [doubt(offered("darks")), doubt(offered("darks"), offered("more", 8.0)), []],
            None,
            ["darks", "more"],
            "settled",
            "no rivals are left",
            id="by two, none of them taken twice",
        ),
        pytest.param(
            [doubt(UNTAKEN, offered("darks", 8.0)), []], None, ["darks"], "settled", "no rivals", id="what it can take"
        ),
        pytest.param(
            [doubt(offered("darks", 0.2), UNTAKEN)],
            None,
            [],
            "this station can't",
            "to tell defocus from coma, you need edges at f/8: a lens is lacking",
            id="too little",
        ),
        pytest.param(
            [doubt(offered("edges at f/8", plan=CapturePlan((StoppedEdgeSequence(f_number=8.0),))))],
            None,
            [],
            "this station can't",
            "you need edges at f/8: station: no target of kind 'aperture' with f_number = 8; it has none",
            id="a device that isn't there",
        ),
        pytest.param(
            [doubt(offered("darks", 0.2))],
            None,
            [],
            "this station can't",
            "no capture that can be predicted",
            id="none",
        ),
        pytest.param(
            [doubt(offered("darks")), doubt(offered("more"))],
            ResolveLimits(rounds=1),
            ["darks"],
            "budget spent",
            "1 captures were taken of 1; more would go on telling defocus from coma",
            id="rounds",
        ),
        pytest.param(
            [doubt(offered("long", plan=LONG), offered("darks", 6.0)), doubt(offered("long", plan=LONG))],
            ResolveLimits(minutes=1.0),
            ["darks"],
            "budget spent",
            "of 1 min are spent; long would go on telling defocus from coma, in ",
            id="minutes",
        ),
    ],
)
def test_resolving_captures_and_diagnoses_until_it_is_settled(
    doubts: list[list[Doubt]],
    limits: ResolveLimits | None,
    taken: list[str],
    end: str,
    said: str,
    store: Store,
    steps: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    remarks: list[str] = []
    found, seen = resolving(
        store, monkeypatch, doubts, limits, lambda progress: remarks.extend(filter(None, [progress.remark]))
    )
    told = found.diagnosis
    assert told is not None and found.session is not None
    assert [one.capture for one in told.resolutions] == taken
    assert (told.resolve_end, said in told.resolve_reason) == (end, True)
    assert all(one.verdict_before == TIE for one in told.resolutions)
    assert all([r.name for r in one.rivals] == ["defocus", "coma"] for one in told.resolutions)
    assert all(one.spent_s is not None for one in told.resolutions)
    assert all(one.rivals_after is not None for one in told.resolutions)
    assert [store.session(one.session).name for one in told.resolutions] == ["one resolve"] * len(taken)
    assert seen == [8 * (1 + number) for number in range(len(taken) + 1)]  # each diagnosis sees all captures before it
    assert len(remarks) == 1 and remarks[0] == f"resolve: {end}: {told.resolve_reason}"
    journal = read_journal(store.folder(found.session))
    assert journal is not None and (journal.resolutions, journal.end) == (told.resolutions, told.resolve_end)
    assert store.results(found.session, "diagnose")[0].document == told.model_dump(mode="json")


@pytest.mark.parametrize(
    ("verdict", "said"),
    [
        ("unexplained", "no rivals are left, but a mismatch; Take darks"),
        ("nothing_judged", "nothing is judged; Take darks"),
    ],
)
def test_what_has_no_name_is_not_settled(
    verdict: DiagnosisVerdict, said: str, store: Store, steps: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, _ = resolving(store, monkeypatch, [[]], verdict=verdict)
    assert found.diagnosis is not None
    assert (found.diagnosis.resolve_end, found.diagnosis.resolve_reason) == ("this station can't", said)


@pytest.mark.parametrize("when", ["capture", "diagnosis"])
def test_a_resolving_that_ended_in_the_middle_goes_on_where_it_was(
    when: str, store: Store, steps: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends while the first capture is taken, or before the diagnosis with it; then it begins with that capture,
    takes no frame twice, and keeps what was in doubt."""

    class KilledError(BaseException):
        pass

    def kill(progress: PipelineProgress) -> None:
        in_middle = progress.capture is not None and progress.capture.done == 2
        if progress.step == "resolve" and (in_middle if when == "capture" else progress.what == "done"):
            raise KilledError

    first = [doubt(offered("darks", 6.0)), doubt(offered("more"))]
    if when == "diagnosis":

        def examine(recordings: RecordingSet, *_: Any, **__: Any) -> Diagnosis:
            if len(recordings.captures()) > 8:
                raise KilledError
            return Diagnosis(DiagnosisResult(source="x", verdict=TIE), {}, tuple(first[0]))

        monkeypatch.setattr(lab.diagnose, "examine", examine)
        request = PipelineRequest("pipeline", capture=CaptureRequest(plan=DARKS, name="one"), resolve=ResolveLimits())
        with pytest.raises(KilledError):
            run_pipeline(request, store=store, capturer=Bench(store))
    else:
        with pytest.raises(KilledError):
            resolving(store, monkeypatch, first, tell=kill)
    base = next(one.id for one in store.sessions() if one.name == "one")
    journal = read_journal(store.folder(base))
    assert journal is not None
    (begun,) = journal.resolutions
    assert (begun.capture, begun.rivals_after, journal.end) == ("darks", None, None)
    done = store.session(begun.session).steps_done

    found, seen = resolving(store, monkeypatch, [doubt(offered("darks"), offered("more")), []], session=base)
    told = found.diagnosis
    assert told is not None
    assert seen == [16, 24]  # the first diagnosis sees the capture that was begun
    assert [one.capture for one in told.resolutions] == ["darks", "more"]
    assert told.resolutions[0].session == begun.session
    assert told.resolutions[0].effects_before == begun.effects_before
    assert [one.rivals_after is not None for one in told.resolutions] == [True, True]
    assert told.resolve_end == "settled"
    assert len(store.sessions()) == 3
    assert done == (4 if when == "diagnosis" else 2)


@pytest.mark.parametrize(
    ("goal", "more", "said"),
    [
        ("fit", {}, "resolve: fit makes no diagnosis"),
        ("capture", {"capture": CaptureRequest()}, "resolve: capture makes no diagnosis"),
        (
            "pipeline",
            {"capture": CaptureRequest(), "diagnosis": DiagnosisResult(source="x", verdict=TIE)},
            "a diagnosis that is given tells no rivals' predictions",
        ),
    ],
)
def test_without_a_diagnosis_of_its_own_nothing_is_resolved(
    goal: Goal, more: dict[str, Any], said: str, small_set: Callable[..., RecordingSet]
) -> None:
    source = {} if "capture" in more else {"recordings": small_set()}
    with pytest.raises(InputError, match=said) as refused:
        PipelineRequest(goal, resolve=ResolveLimits(), **source, **more)
    assert "\n" not in str(refused.value)


# --- recordings with a station ----------------------------------------------------------------------------------------


def sent_in(store: Store, folder: Path) -> RecordingSet:
    """A recording set that the fake station has made, as somebody sends it in."""
    found = run_pipeline(
        PipelineRequest("capture", capture=CaptureRequest(plan=DARKS)), store=store, capturer=Bench(store)
    )
    assert found.session is not None
    recording_set.write(store.recording_set(found.session), folder)
    store.delete_session(found.session)
    return recording_set.read(folder)


def test_what_recordings_leave_in_doubt_is_settled_on_the_station_that_made_them(
    store: Store, steps: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It ends while the capture is taken; the same request goes on with it, and the recordings are left as they are."""
    recordings, bench, seen = sent_in(store, tmp_path / "set"), Bench(store), []
    own = station_of(recordings, fake_bench.station(), bench.bench.drivers)
    assert bench.bench.shots == 0

    def examine(given: RecordingSet, *_: Any, **more: Any) -> Diagnosis:
        assert more["station"] == own
        seen.append(len(given.captures()))
        left = tuple(doubt(offered("darks"))) if len(given.captures()) == 8 else ()
        return Diagnosis(DiagnosisResult(source="x", verdict=TIE if left else "explained"), {}, left)

    monkeypatch.setattr(lab.diagnose, "examine", examine)
    monkeypatch.setattr(lab.resolve, "step_times", lambda *_: StepTimes({}))
    request = PipelineRequest("pipeline", recordings=recordings, resolve=ResolveLimits(), station=own)

    def cancel(progress: PipelineProgress) -> None:
        if progress.step == "resolve" and progress.capture is not None and progress.capture.done == 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        run_pipeline(request, cancel, store=store, capturer=bench)
    (begun,) = store.sessions()
    found = run_pipeline(request, store=store, capturer=bench)
    assert [one.id for one in store.sessions()] == [begun.id]
    assert seen == [8, 16]
    assert found.diagnosis is not None and found.diagnosis.resolve_end == "settled"
    assert found.report == resolving_folder(store.root, recordings) / "report.html"
    journal = read_journal(resolving_folder(store.root, recordings))
    assert journal is not None and [one.session for one in journal.resolutions] == [begun.id]
    assert len(recording_set.read(tmp_path / "set").captures()) == 8


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("another camera", "was recorded with the left camera SN-1, the station has SN-2; connect that one, or name"),
        ("no serial number", "doesn't say a serial number; only SN-1 can settle"),
        ("nobody knows", "doesn't say the serial number of its left camera"),
        ("another data sheet", "the left camera's data sheet says bit_depth = 12, the station file 10"),
        ("one camera", "has a right camera, and the station has none"),
    ],
)
def test_another_station_is_refused_in_one_line(what: str, said: str, store: Store, tmp_path: Path) -> None:
    recordings, bench = sent_in(store, tmp_path / "set"), fake_bench.Bench()
    table = fake_bench.station().model_dump(mode="json")
    if what in ("another camera", "no serial number"):
        bench.serials[fake_bench.FakeCamera(bench, "left").who] = "SN-2" if what == "another camera" else ""
    elif what == "nobody knows":
        recordings = recordings.under(recordings.manifest.model_copy(update={"instruments": {}}))
    elif what == "another data sheet":
        table["cameras"]["left"]["datasheet"]["bit_depth"] = 10
    else:
        del table["cameras"]["right"]
    with pytest.raises(InputError, match=said) as refused:
        station_of(recordings, Station.model_validate(table), bench.drivers)
    assert "\n" not in str(refused.value) and bench.shots == 0


def test_a_station_with_more_cameras_settles_with_those_of_the_recordings(store: Store, tmp_path: Path) -> None:
    recordings = sent_in(store, tmp_path / "set")
    cameras = {"left": recordings.manifest.cameras["left"]}
    left = tuple(c for c in recordings.captures() if c.side == "left")
    manifest = recordings.manifest.model_copy(update={"cameras": cameras, "captures": left})
    own = station_of(recordings.under(manifest), fake_bench.station(), fake_bench.Bench().drivers)
    assert own.sides == ("left",)


def test_a_camera_that_is_exchanged_between_captures_is_refused(store: Store, tmp_path: Path) -> None:
    recordings, other = sent_in(store, tmp_path / "set"), Bench(store)
    other.bench.serials[fake_bench.FakeCamera(other.bench, "left").who] = "SN-2"
    found = run_pipeline(PipelineRequest("capture", capture=CaptureRequest(plan=DARKS)), store=store, capturer=other)
    with pytest.raises(InputError, match="the station has SN-2"):
        check_same_cameras(recordings, found.recordings)
