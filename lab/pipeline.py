"""The whole job as one verb: capture, fit, validate, diagnose, resolve, report.

`run_pipeline` carries out a `PipelineRequest`. The command line, the jobs and the REST routes call it; none of them
composes the steps itself. A step starts when the step before it has ended, and its result is kept before the next one
starts.

Instruments are reached through a `Capturer`, a function of the caller: the command line captures in its own thread, on
a station or on a mock bench that it starts; the REST service captures through its live sessions."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from lab.engine import DEFAULT_ENGINE, Engine
from lab.errors import Cancelled, InputError
from lab.shown import Displayable
from sim.memory import return_freed_memory

if TYPE_CHECKING:
    from pydantic import BaseModel

    from lab.capture.plan import CapturePlan, Parameters
    from lab.capture.session import Progress as CaptureProgress
    from lab.capture.station import Drivers, Station
    from lab.capture.store import Store
    from lab.diagnose import Diagnosis
    from lab.formats.camera_file import CameraFile
    from lab.formats.recording_set import RecordingSet
    from lab.formats.results import DiagnosisResult, FitResult, ValidationResult
    from lab.resolve import ResolveLimits, Resolver
    from lab.workers import Workers
    from sim.camera import Side

M = TypeVar("M", bound="BaseModel")
Goal = Literal["capture", "fit", "validate", "diagnose", "report", "pipeline"]
Step = Literal["capture", "fit", "validate", "diagnose", "resolve", "report"]

#: The steps that lead to each goal. A pipeline captures and resolves only where its request asks for it.
STEPS: dict[Goal, tuple[Step, ...]] = {
    "capture": ("capture",),
    "fit": ("fit",),
    "validate": ("fit", "validate"),
    "diagnose": ("fit", "diagnose"),
    "report": ("fit", "validate", "diagnose", "report"),
    "pipeline": ("capture", "fit", "validate", "diagnose", "resolve", "report"),
}
#: Duration (s) of each step in a quick stereo session on the mock bench, two cores; their ratios give the share of the
#: work that is done.
TYPICAL_S: dict[Step, float] = {
    "capture": 36.0,
    "fit": 15.0,
    "validate": 7.0,
    "diagnose": 58.0,
    "resolve": 70.0,
    "report": 21.0,
}


@dataclass(frozen=True)
class CaptureRequest:
    """A session to capture: what is left of the session `session`, or a new one where that is empty.

    plan : the sequences of a new session; None: all that the station has the instruments and targets for
    quick : fewer exposures and repeats, where `plan` is None
    only : names of the sequences to take, where `plan` is None; empty: all
    parameters : values of the sequences' parameters in place of a full session's, where `plan` is None
    demands_certified : a new session runs only with cameras that have a certified calibration
    standards : take what the standards ask for, where `plan` is None, in place of `only` and `parameters`
    """

    session: str = ""
    plan: CapturePlan | None = None
    quick: bool = False
    only: tuple[str, ...] = ()
    parameters: Parameters = field(default_factory=dict)
    name: str = ""
    notes: str = ""
    demands_certified: bool = False
    standards: bool = False


@dataclass(frozen=True)
class PipelineRequest:
    """What the pipeline is to do. Either `recordings` or `capture` is given.

    goal : the last result that is wanted; `STEPS` lists what leads to it
    recordings : what is evaluated
    capture : the session that is captured first and evaluated then
    source : the session or folder that the results belong to; empty: the session of `capture`, else none
    keep : keep the results of `source` in the registry
    job_id : the job for which the goal's result is kept
    reuse : take the kept results of a finished session in place of computing the goal's inputs again. Without it a
    diagnosis is given
        only the fits that it rests on, and these aren't kept
    fit, validation, diagnosis : results to rest on in place of new ones
    improved : the cameras with the effects that `diagnosis` names, by side, for the report; where none are given, those
    that are kept with it models : camera files that replace the fitted cameras, by side, in validation and diagnosis
    resolve : after the diagnosis, take the captures that tell the remaining rivals apart, within these limits; None: no
    engine : which engine diagnoses
    station : the one that made `recordings` (`lab.resolve.station_of`), which takes these captures
    pictures : draw the residual pictures of the diagnosis
    bootstrap : healthy cameras that are drawn frame by frame for the threshold of the diagnosis
    workers : where they are drawn; None: in this computer's processes of the diagnosis
    report_file : the page to write; None: `report.html` in the session's folder, with the results and cameras beside it
    """

    goal: Goal
    recordings: RecordingSet | None = None
    capture: CaptureRequest | None = None
    source: str = ""
    keep: bool = True
    job_id: str | None = None
    reuse: bool = False
    fit: FitResult | None = None
    validation: ValidationResult | None = None
    diagnosis: DiagnosisResult | None = None
    improved: Mapping[Side, CameraFile] = field(default_factory=dict)
    models: Mapping[Side, CameraFile] = field(default_factory=dict)
    resolve: ResolveLimits | None = None
    station: Station | None = None
    pictures: bool = True
    bootstrap: int = 0
    workers: Workers | None = None
    engine: Engine = DEFAULT_ENGINE
    report_file: Path | None = None

    def __post_init__(self) -> None:
        if (self.recordings is None) == (self.capture is None):
            raise ValueError("PipelineRequest: give either recordings or capture")
        if self.station is not None and (self.capture is not None or self.resolve is None):
            raise ValueError("PipelineRequest: a station resolves recordings; a session has its own")
        if self.resolve is None:
            return
        if "resolve" not in STEPS[self.goal] or (self.capture is None and self.station is None):
            raise InputError(
                f"resolve: {self.goal} makes no diagnosis on a station's session; run the whole pipeline on one, or on "
                "recordings and the station that made them"
            )
        if self.diagnosis is not None:
            raise InputError(
                "resolve: a diagnosis that is given tells no rivals' predictions; leave it out, it is made anew"
            )

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps that this request takes."""
        left_out = {"capture": self.capture is None, "resolve": self.resolve is None}
        return tuple(step for step in STEPS[self.goal] if not left_out.get(step, False))


@dataclass(frozen=True)
class PipelineProgress:
    """How far a pipeline is.

    share, share_of_step : the part of the whole and of the step that is done, 0..1
    capture : where the session stands, while a step captures
    remark : what the user should know: a warning, or why a step did nothing
    """

    step: Step
    what: str
    share: float
    share_of_step: float = 0.0
    capture: CaptureProgress | None = None
    remark: str | None = None


#: Called at every piece of progress. It may raise `Cancelled`, which ends the pipeline; instruments are brought to a
#: safe state first.
Tell = Callable[[PipelineProgress], None]
#: Captures a session to its end and returns its id; passes the session's progress on, and ends the session where that
#: raises `Cancelled`.
Capturer = Callable[[CaptureRequest, "Callable[[CaptureProgress], None]"], str]


@dataclass(frozen=True, repr=False)  # an IPython prompt prefers a dataclass's own text
class PipelineResult(Displayable):
    """What a pipeline found; None for what its goal doesn't need."""

    recordings: RecordingSet
    session: str | None = None
    fit: FitResult | None = None
    validation: ValidationResult | None = None
    diagnosis: DiagnosisResult | None = None
    improved: Mapping[Side, CameraFile] = field(default_factory=dict)
    report: Path | None = None


def session_recordings(store: Store, session_id: str) -> RecordingSet:
    """Return a stored session as a recording set, inspected as a folder would be. Raises InputError where it can't
    be used."""
    from lab.formats.recording_set import RecordingError, inspect

    recordings = store.recording_set(session_id)
    if not recordings.captures():
        raise InputError(f"session {session_id}: nothing was captured yet; resume it with `calibench capture --resume`")
    problems, warnings = inspect(recordings)
    if problems:
        raise RecordingError(problems)
    recordings.warnings = tuple(warnings)
    return recordings


def source_recordings(source: str, open_store: Callable[[], Store | None]) -> RecordingSet:
    """Return the recordings of `source`, a recording set's folder or a stored session's id. Raises InputError if it is
    neither.

    The store is opened only where `source` isn't a path; `open_store` returns None where there is no data folder.
    """
    if Path(source).exists() or os.sep in source:
        from lab.formats import recording_set

        return recording_set.read(source)
    store = open_store()
    if store is None or not store.has_session(source):
        where = "there is no data folder" if store is None else f"no session in {store.root}"
        raise InputError(
            f"{source}: no such folder, and {where}; give a recording set's folder or a session's id, and its data "
            "folder with --data or as CALIBENCH_DATA"
        )
    return session_recordings(store, source)


def capture_here(
    store: Store,
    station: Station,
    request: CaptureRequest,
    tell: Callable[[CaptureProgress], None],
    connect: Callable[[Station], Drivers] | None = None,
) -> str:
    """Capture a session in this thread, on `station`; returns its id. `connect` makes the drivers, by default the
    station's.

    Raises what `CaptureSession.run` raises, and `Cancelled` if `tell` does: the session can then be resumed.
    """
    from lab.calibration.life import check_certified
    from lab.capture.plan import full_plan, standards_plan
    from lab.capture.session import CaptureSession
    from lab.capture.station import drivers_of

    drivers = connect or drivers_of
    cancelled = threading.Event()

    def told(progress: CaptureProgress) -> None:
        if cancelled.is_set():
            return
        try:
            tell(progress)
        except Cancelled:
            cancelled.set()
            # `abort` waits for the thread that calls this.
            threading.Thread(target=session.abort, args=("cancelled",), daemon=True).start()

    if request.session:
        session = CaptureSession(
            store, request.session, station=station, on_progress=told, connect=drivers, check_certified=check_certified
        )
    else:
        usual = (
            standards_plan(station, request.quick)
            if request.standards
            else full_plan(station, request.quick, request.only or None, request.parameters)
        )
        session = CaptureSession.start(
            store,
            station,
            request.plan or usual,
            name=request.name,
            notes=request.notes,
            demands_certified=request.demands_certified,
            on_progress=told,
            connect=drivers,
            check_certified=check_certified,
        )
    session.run()
    if cancelled.is_set():
        raise Cancelled
    return session.id


def run_pipeline(
    request: PipelineRequest,
    tell: Tell | None = None,
    *,
    store: Store | None = None,
    capturer: Capturer | None = None,
) -> PipelineResult:
    """Take the steps of `request` and return what they found.

    `store` keeps the results, under the request's source; without one nothing is kept. `capturer` is needed for a
    request that captures or resolves. Raises InputError, DeviceError, NotDetermined, and what `tell` raises."""
    from lab.side_processes import kept_processes

    with kept_processes():
        return _Pipeline(request, tell, store, capturer).run()


class _Pipeline:
    """One run of the pipeline: the steps, and what the steps before have found."""

    def __init__(
        self, request: PipelineRequest, tell: Tell | None, store: Store | None, capturer: Capturer | None
    ) -> None:
        self.request, self.store, self.capturer = request, store, capturer
        self._tell = tell
        self._source = request.source
        self._session = self._known_session(request.source)
        self._recordings = request.recordings
        self._results: dict[str, str] = {}
        self._fit = request.fit
        self._validation: ValidationResult | None = None
        self._diagnosis: DiagnosisResult | None = None
        self._examined: Diagnosis | None = None
        self._resolver: Resolver | None = None
        self._report: Path | None = None

    def run(self) -> PipelineResult:
        steps: dict[Step, Callable[[], None]] = {
            "capture": self._capture_step,
            "fit": self._fit_step,
            "validate": self._validate_step,
            "diagnose": self._diagnose_step,
            "resolve": self._resolve_step,
            "report": self._report_step,
        }
        for step in self.request.steps:
            self._say(step, "")
            steps[step]()
            if self._recordings is not None:
                self._recordings.let_go()  # the next step computes in processes of its own, or reads other frames
            return_freed_memory()
        return PipelineResult(
            recordings=self.recordings,
            session=self._session,
            fit=self._fit,
            validation=self._validation,
            diagnosis=self._diagnosis,
            improved=self._examined.improved if self._examined is not None else {},
            report=self._report,
        )

    @property
    def recordings(self) -> RecordingSet:
        assert self._recordings is not None  # `capture` is the first step of a request without recordings
        return self._recordings

    @property
    def fitted(self) -> FitResult:
        assert self._fit is not None  # `fit` is a step of every goal
        return self._fit

    def _say(
        self,
        step: Step,
        what: str,
        share: float = 0.0,
        capture: CaptureProgress | None = None,
        remark: str | None = None,
    ) -> None:
        if self._tell is None:
            return
        durations = [TYPICAL_S[one] for one in self.request.steps]
        at = self.request.steps.index(step)
        done = (sum(durations[:at]) + share * durations[at]) / sum(durations)
        self._tell(PipelineProgress(step, what, done, share, capture, remark))

    # --- keeping ------------------------------------------------------------------------------------------------------

    def _known_session(self, source: str) -> str | None:
        return source if source and self.store is not None and self.store.has_session(source) else None

    def _keep(self, kind: Goal, result: BaseModel) -> None:
        """Keep a result in the registry, under the job's id if it is what the job is for."""
        if self.store is None or not self._source or not self.request.keep:
            return
        job_id = self.request.job_id if kind == self.request.goal else None
        self._results[kind] = self.store.add_result(kind, self._source, result.model_dump(mode="json"), job_id)

    def _keep_improved(self, examined: Diagnosis) -> None:
        """Keep the camera files of the diagnosis that was kept just now."""
        if self.store is not None and "diagnose" in self._results:
            from lab.calibration.camera_models import keep

            keep(self.store, self._results["diagnose"], examined.improved)

    def _kept(self, kind: Goal, model: type[M]) -> M | None:
        """Return the newest kept result of a kind, where it may be reused: a folder, unlike a finished session, may
        have changed."""
        if not self.request.reuse or kind == self.request.goal or self.store is None or self._session is None:
            return None
        if self.store.session(self._session).state != "finished":
            return None
        for found in self.store.results(self._session, kind):
            # of the fitted cameras, not of others that stood in for them, and by the engine that is asked for
            is_by_another = self.request.engine != found.document.get("engine", "today")
            if found.document.get("baseline") is None and not (kind == "diagnose" and is_by_another):
                self._results[kind] = found.id
                return model.model_validate(found.document)
        return None

    # --- the steps ----------------------------------------------------------------------------------------------------

    def _capture_step(self) -> None:
        assert self.request.capture is not None
        assert self.store is not None
        self._session = self._captured("capture", self.request.capture)
        self._source = self._source or self._session
        if self.request.goal == "capture":
            self._recordings = self.store.recording_set(self._session)
            return
        self._recordings = session_recordings(self.store, self._session)
        for warning in self._recordings.warnings:
            self._say("capture", "done", 1.0, remark=f"warning: {warning}")

    def _captured(self, step: Step, request: CaptureRequest) -> str:
        """Capture a session, or what is left of it; its id."""
        assert self.store is not None
        if request.session and self.store.session(request.session).state == "finished":
            return request.session
        if self.capturer is None:
            raise InputError(f"{step}: no station to capture on; name one")

        def told(standing: CaptureProgress) -> None:
            what = f"{standing.sequence} {standing.what}".strip()
            share = standing.done / max(standing.total, 1)
            # Of resolving, the capture is about a tenth; the diagnosis after it is the rest.
            self._say(step, what, share if step == "capture" else 0.1 * share, standing, standing.remark)

        return self.capturer(request, told)

    def _fit_step(self) -> None:
        from lab.fit import FOR_DIAGNOSIS, STEPS, fit_recording_set
        from lab.formats.results import FitResult

        if self._fit is None:
            self._fit = self._kept("fit", FitResult)
        if self._fit is None:
            whole = self.request.goal != "diagnose" or self.request.reuse
            self._fit = fit_recording_set(
                self.recordings,
                lambda what, share: self._say("fit", what, share),
                STEPS if whole else FOR_DIAGNOSIS,
            )
            if whole:
                self._keep("fit", self._fit)
                if self.store is not None and "fit" in self._results:
                    from lab.calibration.camera_models import keep_fitted

                    keep_fitted(self.store, self._results["fit"], self.recordings, self._fit)

    def _validate_step(self) -> None:
        from lab.formats.results import ValidationResult
        from lab.predict.validate import validate

        self._validation = self.request.validation or self._kept("validate", ValidationResult)
        if self._validation is None:
            self._validation = validate(
                self.recordings,
                self.fitted,
                models=self.request.models,
                progress=lambda what, share: self._say("validate", what, share),
            ).model_copy(update={"baseline": self._baseline})
            self._keep("validate", self._validation)

    def _diagnose_step(self) -> None:
        from lab.formats.results import DiagnosisResult

        self._diagnosis = self.request.diagnosis or self._kept("diagnose", DiagnosisResult)
        if self._diagnosis is None:
            if self.request.resolve is not None:
                from lab.resolve import Resolver

                assert self.store is not None
                station = self._station()
                assert station is not None
                self._resolver = Resolver(self.store, self._folder(), station, self.request.resolve)
            self._examined = self._diagnosed(self._with_resolved("diagnose"), "diagnose")
            self._diagnosis = self._examined.result
            self._keep("diagnose", self._diagnosis)
            self._keep_improved(self._examined)

    def _diagnosed(self, recordings: RecordingSet, step: Step) -> Diagnosis:
        from lab.diagnose import examine
        from lab.fit import FOR_DIAGNOSIS, fit_recording_set

        begun = 0.1 if step == "resolve" else 0.0
        found = examine(
            recordings,
            self.fitted,
            lambda what, share: self._say(step, what, begun + (1.0 - begun) * share),
            baseline=self.request.models,
            pictures=self.request.pictures,
            bootstrap=self.request.bootstrap,
            workers=self.request.workers,
            station=self._station(),
            engine=self.request.engine,
            refit=partial(fit_recording_set, steps=FOR_DIAGNOSIS),
        )
        return replace(found, result=found.result.model_copy(update={"baseline": self._baseline}))

    def _station(self) -> Station | None:
        """Return the station that can take further captures; None: there is none."""
        if self.store is None or self._session is None:
            return self.request.station
        return self.store.station(self._session)

    def _folder(self) -> Path:
        """Return where the files of this pipeline lie: the session's folder, or that of resolved recordings."""
        from lab.resolve import resolving_folder

        assert self.store is not None
        if self._session is not None:
            return self.store.folder(self._session)
        assert self.request.recordings is not None
        return resolving_folder(self.store.root, self.request.recordings)

    @property
    def _baseline(self) -> str | None:
        """Names of the camera files that stand in for the fitted cameras."""
        return ", ".join(dict.fromkeys(one.name for one in self.request.models.values())) or None

    def _resolve_step(self) -> None:
        """Take the capture that tells most per second, and diagnose with it again, until no rivals are left, no capture
        of the station is worth taking, or the budget is spent."""
        assert self._resolver is not None
        assert self.store is not None
        assert self._examined is not None
        resolver, name = self._resolver, f"{self.recordings.manifest.name} resolve".strip()
        resolver.note(self._examined.result, self._examined.doubts)
        choice = resolver.next(self._examined.result, self._examined.doubts)
        while choice is not None:
            self._say("resolve", f"{choice.first.capture.words}, to tell {' from '.join(choice.doubt.rivals)}")
            resolver.begin(choice, self._examined.result, name)
            self._examined = self._diagnosed(self._with_resolved("resolve"), "resolve")
            resolver.note(self._examined.result, self._examined.doubts)
            choice = resolver.next(self._examined.result, self._examined.doubts)
            self._keep_resolved()
        self._keep_resolved()
        journal = resolver.journal
        self._say("resolve", "done", 1.0, remark=f"resolve: {journal.end}: {journal.reason}")

    def _with_resolved(self, step: Step) -> RecordingSet:
        """Return the recordings with all captures of the resolving, which are taken first where they haven't been."""
        recordings = self.recordings
        for number, taken in enumerate(self._resolver.journal.resolutions if self._resolver is not None else (), 1):
            assert self.store is not None
            session = self._captured(step, CaptureRequest(session=taken.session))
            folder = "resolve" if number == 1 else f"resolve-{number}"
            later = session_recordings(self.store, session)
            if self.request.recordings is not None:
                from lab.resolve import check_same_cameras

                check_same_cameras(self.request.recordings, later)
            recordings = recordings.joined(later, folder)
        return recordings

    def _keep_resolved(self) -> None:
        """Keep the present diagnosis with the journal."""
        assert self._resolver is not None
        assert self._examined is not None
        journal = self._resolver.journal
        told = {"resolutions": journal.resolutions, "resolve_end": journal.end, "resolve_reason": journal.reason}
        self._examined = replace(self._examined, result=self._examined.result.model_copy(update=told))
        if self._examined.result == self._diagnosis:
            return
        self._diagnosis = self._examined.result
        self._keep("diagnose", self._diagnosis)
        self._keep_improved(self._examined)

    def _report_step(self) -> None:
        from lab.calibration.limits import standing_limits
        from lab.formats.results import ReportFile
        from lab.predict.validate import predict_both
        from lab.report import provenance_of, write_report

        file = self.request.report_file or self._session_files()
        provenance = provenance_of(self.recordings)
        both = predict_both(
            self.recordings,
            self.fitted,
            self._improved(),
            self._diagnosis,
            self.request.models,
            progress=lambda what, share: self._say("report", what, share),
        )
        limits = standing_limits(self.store.root) if self.store is not None else None
        results = (self.fitted, self._validation, self._diagnosis)
        self._report = write_report(file, self.recordings, *results, provenance, both, limits)
        within = self.store is not None and self._report.is_relative_to(self.store.root)
        path = self._report.relative_to(self.store.root) if self.store is not None and within else self._report
        self._keep(self.request.goal, ReportFile(path=str(path), results=dict(self._results)))

    def _improved(self) -> Mapping[Side, CameraFile]:
        """Return the cameras with the effects that the diagnosis names: those it made, that were given with it, or that
        are kept with it."""
        if self._examined is not None or self.request.diagnosis is not None or self.store is None:
            return self._examined.improved if self._examined is not None else self.request.improved
        from lab.calibration import camera_models

        return camera_models.camera_files(self.store, camera_models.record(self.store, self._results["diagnose"]))

    def _session_files(self) -> Path:
        """Write the results and the improved cameras into the folder of this pipeline; where its report belongs."""
        from lab.formats.camera_file import write_camera
        from lab.formats.result_file import write_result

        folder = self._folder()
        folder.mkdir(parents=True, exist_ok=True)
        for kind, result in (("fit", self._fit), ("validate", self._validation), ("diagnose", self._diagnosis)):
            if result is not None:
                write_result(result, folder / f"{kind}.json")
        cameras = self._examined.improved if self._examined is not None else {}
        (folder / "cameras").mkdir(exist_ok=True)
        for side, content in cameras.items():
            write_camera(folder / "cameras" / f"{side}.toml", content)
        return folder / "report.html"
