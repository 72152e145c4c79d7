"""The requests and responses of the service. Results are those of `lab.formats.results`, as on the command line."""

from __future__ import annotations

import re
from collections.abc import Collection
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    field_validator,
    model_validator,
)

from api.keys import Permission
from api.safety import StationSafety
from api.strict_kinds import check_kind
from lab.calibration.camera_models import Kind as CameraModelKind
from lab.calibration.camera_models import ModelOfCamera
from lab.calibration.life import CalibrationRecord
from lab.calibration.limits import CalibrationLimits, Limit, Mark
from lab.capture.plan import CapturePlan, full_plan
from lab.capture.questions import Question
from lab.capture.queue import QueuedSession
from lab.capture.records import RunRecord
from lab.capture.session import Progress
from lab.capture.station import Station
from lab.capture_kinds.base import CAPTURES, SEQUENCES
from lab.capture_kinds.lamp import LampLight
from lab.engine import DEFAULT_ENGINE, Engine
from lab.foreign_files import TableKind
from lab.foreign_recordings import importers
from lab.formats.cgats import Quantity
from lab.formats.results import ComparisonResult, DiagnosisResult, FitResult, ResolveJournal, ValidationResult
from lab.formats.results.diagnosis import DiagnosisVerdict
from lab.jobs import RemovedKind
from lab.pipeline import Step
from lab.plain_text import complaints_of
from sim.camera import Side
from sim.spectrum import Spectrum

#: Databases that forget the time zone give back UTC.
Utc = Annotated[datetime, AfterValidator(lambda at: at if at.tzinfo else at.replace(tzinfo=UTC))]


def _one_of(what: str, known: Collection[str]) -> AfterValidator:
    """Accepts the names that are in `known` when a request comes."""

    def check(name: str) -> str:
        if name not in known:
            raise ValueError(f"{name!r} is no {what}; choose from {', '.join(known)}")
        return name

    return AfterValidator(check)


SequenceName = Annotated[str, _one_of("sequence", SEQUENCES), Field(json_schema_extra={"enum": list(SEQUENCES)})]
CaptureKind = Annotated[
    str, _one_of("kind of capture", CAPTURES.models), Field(json_schema_extra={"enum": list(CAPTURES.names)})
]
SessionState = Literal[
    "created",
    "queued",
    "connecting",
    "running",
    "pausing",
    "paused",
    "packing",
    "interrupted",
    "failed",
    "finished",
]
#: Work on a session or on recordings.
JobKind = Literal["fit", "validate", "diagnose", "report", "pipeline"]
JobState = Literal["queued", "running", "done", "failed", "cancelled"]


class Schema(BaseModel):
    """Base of all schemas: immutable, and an unknown field is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class SeveralLines:
    """Marks a text field that may have newlines and tabs, as notes do."""


class Asked(Schema):
    """Base of what a request's body or query asks: no value of another kind is converted, and no text of it, at any
    depth, has a control character."""

    @model_validator(mode="before")
    @classmethod
    def _plain_and_of_their_kinds(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        fields = cls.model_fields
        lines = [
            name
            for name, field in fields.items()
            if any(isinstance(annotation, SeveralLines) for annotation in field.metadata)
        ]
        for complaint in complaints_of(data, several_lines=lines):
            raise ValueError(complaint)
        for name, field in fields.items():
            if name in data:
                check_kind(name, data[name], field.annotation)
        return data


class Health(Schema):
    """Says that the service is up. It needs no key, so it says nothing else."""

    status: Literal["ok"] = "ok"
    version: str


class Me(Schema):
    """Name and scope of the key of the request."""

    name: str
    scope: Permission


class Login(Asked):
    """A key, to be exchanged for a cookie."""

    key: str = Field(min_length=1, max_length=200)


class LeftChanged(Schema):
    """What a session changed by hand and didn't put back: it was killed, or given up."""

    session: str = Field(description="its id; the session may be deleted")
    words: str = Field(description="what stands otherwise, and how to put it back")


class StationState(Schema):
    """A station file of the data folder; `problem` says why it can't be used."""

    name: str = Field(description="what `POST /sessions` takes: the station file's name without `.toml`")
    title: str = Field(description="name of the station, from its file")
    cameras: tuple[Side, ...] = ()
    instruments: dict[str, str] = Field(default={}, description="family of the instrument -> its driver")
    targets: tuple[str, ...] = ()
    lights: dict[str, LampLight] = Field(
        default={}, description="of its light source, by name: what `lamp_level` and `colour_temperature_k` ask for"
    )
    sequences: tuple[SequenceName, ...] = Field(default=(), description="what it has the instruments and targets for")
    busy_with: str | None = Field(default=None, description="id of a session that uses its instruments now")
    safety: StationSafety | None = Field(
        default=None, description="null: its instruments haven't answered since the service's start, or a run uses them"
    )
    left_by_hand: tuple[LeftChanged, ...] = Field(
        default=(),
        description="what was changed by hand and not put back; the next session asks for it before all else",
    )
    asks: Question | None = Field(
        default=None, description="what the session that runs on it waits for an operator to do"
    )
    problem: str | None = None


class PlanAsked(Asked):
    """Which sequences to take, and how."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "quick": True,
                "sequences": ["dark", "narrowband"],
                "parameters": {"narrowband": {"step_nm": 5}},
            }
        }
    )

    quick: bool = Field(default=False, description="fewer frames of each")
    sequences: tuple[SequenceName, ...] | None = Field(
        default=None, min_length=1, description="only these; without it, all that the station can do"
    )
    parameters: dict[SequenceName, dict[str, int | float | tuple[float, ...]]] = Field(
        default={},
        description="values in place of those that a full session has: sequence, parameter, a number or several; "
        "`GET /sequences` lists them with unit and bounds",
    )

    def plan(self, station: Station) -> CapturePlan:
        """Return the plan on a station. Raises InputError."""
        return full_plan(station, self.quick, self.sequences, self.parameters)


class CaptureStart(PlanAsked):
    """What to capture, and on which station."""

    station: str = Field(max_length=100)
    name: str = Field(default="", max_length=120)
    notes: Annotated[str, SeveralLines()] = Field(default="", max_length=4000)
    demands_certified: bool = Field(
        default=False, description="end the run when it has connected, unless the cameras have a certified calibration"
    )


_WEB_ADDRESS = r"^https?://[^\s/@]+(/\S*)?$"


class Then(Asked):
    """What follows a session's end, when it has finished."""

    kind: Literal["fit", "diagnose", "pipeline"] | None = Field(
        default=None,
        description="what to compute; `diagnose` fits and validates before, `pipeline` writes a report, too",
    )
    resolve: bool = Field(
        default=False, description="of a pipeline: while rivals are left, take the capture that tells them apart"
    )
    compare: bool = Field(default=False, description="compare the fit with the cameras' certified calibration")
    webhook: str | None = Field(
        default=None,
        max_length=400,
        pattern=_WEB_ADDRESS,
        description="is told by a POST how it ended, also where the session ended early; on a host that the service "
        "was started with (`--webhook-host`)",
    )

    @field_validator("webhook", mode="before")
    @classmethod
    def _web_address(cls, value: Any) -> Any:
        if isinstance(value, str) and not re.match(_WEB_ADDRESS, value):
            raise ValueError(
                f"{value[:60]!r} isn't the URL of a web server; give one, such as https://lab.example/hook"
            )
        return value

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        if self.resolve and self.kind != "pipeline":
            raise ValueError("resolve: goes with kind = pipeline; give both")
        if self.compare and self.kind is None:
            raise ValueError("compare: needs a fit; give a kind")
        if self.kind is None and self.webhook is None:
            raise ValueError("then: asks for nothing; give a kind or a webhook, or leave it out")
        return self

    @property
    def in_words(self) -> str:
        """What was asked for, in a few words."""
        words = (self.kind, self.resolve and "resolve", self.compare and "compare", self.webhook and "tell")
        return ", ".join(word for word in words if word)


class WorkStep(Schema):
    """A step of an analysis, and how far it is."""

    name: Step
    state: Literal["waiting", "running", "done", "failed", "cancelled"]


class ThenState(Schema):
    """How far that is which follows a session's end. `words`: what was asked for, and what came of it."""

    state: Literal["waiting", "running", "done", "failed"]
    steps: tuple[WorkStep, ...] = Field(
        default=(), description="what is computed, in order, until there is a job, which then has them"
    )
    words: str
    job_id: str | None = Field(default=None, description="of the job that computes it")
    comparison: str | None = Field(default=None, description="path of the page that compares with the certified one")
    told: str | None = Field(default=None, description="what came of telling the webhook")


class SessionStart(CaptureStart):
    """A new session, started now or when its turn comes."""

    model_config = ConfigDict(
        json_schema_extra={"example": {"station": "bench", "name": "after the move", "quick": True}}
    )

    queue: bool = Field(default=False, description="wait in the queue until the instruments are free")
    not_before: AwareDatetime | None = Field(default=None, description="with `queue`: the earliest time, with its zone")
    then: Then | None = Field(default=None, description="what follows its end; needs a key of the scope `admin`")

    @model_validator(mode="after")
    def _time_of_a_queued_one(self) -> Self:
        if self.not_before is not None and not self.queue:
            raise ValueError("not_before: goes with queue = true; give both")
        return self


class QueuePlace(Asked):
    """Where in the queue a session waits, and until when at least. A session that is held is released by it."""

    place: int | None = Field(default=None, ge=1, le=100_000, description="1: first; null: where it is, or last")
    not_before: AwareDatetime | None = Field(default=None, description="the earliest time, with its zone")


class QueueEntry(QueuedSession):
    """A session in the queue, and when it is expected to run: by what the instruments' finished sessions took, and by
    what waits before it. null: held, or what is before it isn't known."""

    expected_start: datetime | None = None
    expected_end: datetime | None = None
    then: str | None = Field(default=None, description="what follows its end, in words")
    can_copy: bool = Field(default=False, description="whether `GET /sessions/ID/request` has what it was asked with")


class Halt(Asked):
    """What to halt."""

    station: str | None = Field(default=None, max_length=100, description="null: every station")


class MayHalt(Schema):
    """Whether the client may halt."""

    may_halt: bool


class HaltedStation(Schema):
    """A station after a halt."""

    name: str
    safety: StationSafety


class Halted(Schema):
    """Ids of the sessions that a halt ended, each can be resumed; and what the stations' instruments answered within
    1.5 s."""

    sessions: tuple[str, ...]
    stations: tuple[HaltedStation, ...] = ()


class DraftedLimit(Schema):
    """A drafted limit, with the names that a lab reads."""

    figure: str
    title: str
    unit: str
    side: Side | None
    place: str
    good: tuple[float | None, float | None]


class DraftedLimits(Schema):
    """Limits drafted from the history of a calibration's cameras. `words`: from what they were drafted."""

    words: str
    valid_days: float | None = Field(description="that of the data folder's limits")
    limits: tuple[DraftedLimit, ...]

    def stated(self) -> CalibrationLimits:
        """Return them as limits to certify against. Raises pydantic's ValidationError: there is none, or a band has no
        end."""
        kept = tuple(
            Limit(figure=limit.figure, side=limit.side, place=limit.place, good=limit.good) for limit in self.limits
        )
        return CalibrationLimits(valid_days=self.valid_days, limit=kept)


def _kind_of_limits(given: object) -> str:
    """Tell drafted limits, as they were answered, from a laboratory's own."""
    return "drafted" if isinstance(given, DraftedLimits) or (isinstance(given, dict) and "limits" in given) else "own"


class Certify(Asked):
    """Certifies a calibration."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "limits": {
                    "valid_days": 90,
                    "limit": [{"figure": "noise read_noise_e", "good": [0, 2.5], "warn": [0, 3]}],
                }
            }
        }
    )

    limits: (
        Annotated[
            Annotated[CalibrationLimits, Tag("own")] | Annotated[DraftedLimits, Tag("drafted")],
            Discriminator(_kind_of_limits),
        ]
        | None
    ) = Field(
        default=None,
        description="null: those of the data folder, `limits.toml`; what `drafted-limits` answered is taken, too",
    )
    accept_warnings: bool = Field(default=False, description="certify with figures in the warning band")

    @model_validator(mode="after")
    def _state_drafted(self) -> Self:
        self.stated()
        return self

    def stated(self) -> CalibrationLimits | None:
        """Return the limits to certify against; None: those of the data folder."""
        return self.limits.stated() if isinstance(self.limits, DraftedLimits) else self.limits


class CameraModels(Schema):
    """Camera models: `fitted` by a fit, `improved` with what a diagnosis named, or `sent` in."""

    id: str
    kind: CameraModelKind
    session_id: str | None
    recordings_id: str | None
    created: Utc
    sides: tuple[Side, ...]
    cameras: dict[Side, ModelOfCamera] = Field(default={}, description="what each is; empty in a list")
    warnings: tuple[str, ...] = Field(default=(), description="what was left out of a lens that was sent in with it")


class Comparison(Schema):
    """Two calibrations compared, and the changes that fail the rules of the request, by name."""

    comparison: ComparisonResult
    failing: tuple[str, ...] = ()


class NamedFigure(Schema):
    """A figure. `title`, `unit`: as a lab reads them."""

    figure: str
    place: str
    title: str = ""
    unit: str = "1"


class FigureName(NamedFigure):
    """A figure of a camera, or of the pair, that has a history."""

    camera: str


class FigureOfFit(NamedFigure):
    """A figure of a fit, with its uncertainty, and by the data folder's limits where one concerns it."""

    side: Side | None = Field(description="null: of the pair")
    value: float
    std: float
    good: tuple[float | None, float | None] | None = Field(default=None, description="the good band of its limit")
    mark: Mark | None = Field(default=None, description="by its limit; null without one")


class Revoke(Asked):
    """Takes a certificate back."""

    why: str = Field(min_length=1, max_length=400)


class CalibrationDetail(CalibrationRecord):
    """A calibration with what speaks against certifying it."""

    warnings: tuple[str, ...] = ()
    has_cameras: bool = Field(default=False, description="whether its camera files are kept")


class SessionResume(Asked):
    """On which station a session continues."""

    station: str | None = Field(
        default=None,
        max_length=100,
        description="a station with the same instruments at other addresses; null: as in its last run",
    )


class StoredSession(Schema):
    """A session; `state` is `pausing` until the step under way is done."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": "20300101-120000-abcdef",
                "name": "after the move",
                "notes": "",
                "created": "2030-01-01T12:00:00Z",
                "closed": None,
                "state": "running",
                "error": None,
                "steps": 310,
                "steps_done": 42,
            }
        }
    )

    id: str
    name: str
    notes: str
    created: Utc
    closed: Utc | None
    state: SessionState
    error: str | None = Field(description="why it ended early, and the remedy")
    steps: int
    steps_done: int
    demands_certified: bool = Field(
        default=False, description="it runs only with a certified calibration of its cameras"
    )


class ListedSession(StoredSession):
    """A session with what its cameras and its newest results say of it."""

    station: str = Field(default="", description="what the station calls itself")
    tags: tuple[str, ...] = Field(default=(), description="the words of its notes that begin with #")
    cameras: dict[Side, str] = Field(default={}, description="as each reported itself")
    calibration_id: str | None = Field(default=None, description="of its newest fit")
    mtf50_cy_per_px: dict[Side, float] = Field(
        default={}, description="by camera: green, the mean over its edges, of the newest fit"
    )
    read_noise_e: dict[Side, float] = Field(default={}, description="by camera, of the newest fit")
    verdict: DiagnosisVerdict | None = Field(default=None, description="of its newest diagnosis")


class SessionWords(Asked):
    """What a session is called, and the notes of it; what is left out stays."""

    name: str | None = Field(default=None, max_length=120)
    notes: Annotated[str | None, SeveralLines()] = Field(
        default=None, max_length=4000, description="a word that begins with # is a tag"
    )


class StepDone(Asked):
    """What an operator has done, as `asks` of the session named it."""

    model_config = ConfigDict(json_schema_extra={"example": {"target": "edge-1"}})

    target: str = Field(max_length=200)
    since: AwareDatetime | None = Field(
        default=None,
        description="that of `asks`: a question for the same target that was asked at another time isn't meant",
    )


class CaptureCount(Schema):
    """How many captures a session has of a kind and a side."""

    kind: str
    side: Side
    captures: int


class SessionDetail(ListedSession):
    """A session with its progress and its provenance."""

    can_copy: bool = Field(default=False, description="whether `GET /sessions/ID/request` has what it was asked with")
    then: ThenState | None = Field(default=None, description="how far that is which follows its end")
    progress: Progress | None = Field(description="null unless this service runs it now")
    asks: Question | None = Field(
        default=None,
        description="what it waits for an operator to do; `POST /sessions/ID/confirm` says that it is done",
    )
    runs: tuple[RunRecord, ...] = Field(description="provenance: each run's instruments, serial numbers and versions")
    captures: tuple[CaptureCount, ...] = Field(description="how many there are of each kind and side")
    results: dict[str, str] = Field(
        description="kind -> id of the newest `fit` (also the id of its calibration and camera model), `validate`, "
        "`diagnose`, `report`"
    )
    resolving: ResolveJournal | None = Field(
        default=None, description="what was in doubt, taken and said while it was resolved; null: it never was"
    )


class RecordedCapture(Schema):
    """One capture. `document` is its entry in the recording set's manifest."""

    id: int
    name: str
    kind: str
    side: Side
    exposure_s: float | None
    document: dict[str, Any]
    preview: str = Field(description="path of its picture")
    frame: str = Field(description="path of its raw frame, .npy, uint16 (rows, cols)")


RESOLVE_MINUTES = Field(
    default=None, gt=0, le=1e5, description="with `resolve`: lab time that its captures may take, min; null: any"
)
ENGINE = Field(
    default=DEFAULT_ENGINE,
    description="what diagnoses: `evidence`, one table of sets of effects with their posterior probabilities; `today`, "
    "the engine before it",
)
RESOLVE_ROUNDS = Field(
    default=None, ge=1, le=100, description="with `resolve`: how many captures it takes at most; null: 6"
)


class StoredCapture(RecordedCapture):
    """One capture of a session."""

    session_id: str


class JobStart(Asked):
    """What to compute. `pipeline`: everything, from what is left to capture to the report."""

    model_config = ConfigDict(json_schema_extra={"example": {"kind": "diagnose"}})

    kind: JobKind
    resolve: bool = Field(
        default=False,
        description="pipeline of a session, or of recordings with their `station`: while rivals are left, take the "
        "capture that tells them apart and diagnose again",
    )
    resolve_minutes: float | None = RESOLVE_MINUTES
    resolve_rounds: int | None = RESOLVE_ROUNDS
    engine: Engine = ENGINE
    camera_model: str | None = Field(
        default=None,
        pattern=r"^[0-9a-f]{16}$",
        description="validate, diagnose: id of a camera model that stands in for the fitted cameras, with its "
        "effects, as "
        "`--model` of the command line does; later reports don't rest on the result",
    )
    station: str | None = Field(
        default=None,
        max_length=100,
        description="pipeline of a session: a station with the same instruments at other addresses; null: as in its "
        "last run. Of recordings, with `resolve`: the station that made them",
    )


class PipelineStart(CaptureStart):
    """A new session, and the whole pipeline on it."""

    model_config = ConfigDict(json_schema_extra={"example": {"station": "bench", "quick": True, "resolve": True}})

    resolve: bool = Field(
        default=False,
        description="while rivals are left, take the capture that tells them apart and diagnose again",
    )
    resolve_minutes: float | None = RESOLVE_MINUTES
    resolve_rounds: int | None = RESOLVE_ROUNDS
    engine: Engine = ENGINE


class PipelineResults(Schema):
    """What a pipeline found; each part as `calibench fit`, `validate` and `diagnose` write it with `--json`."""

    fit: FitResult
    validation: ValidationResult
    diagnosis: DiagnosisResult


class Job(Schema):
    """A job on one source: a session, or recordings that were sent in. Of kinds that were removed, neither is
    stated."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": "6f1d2c3b4a596877",
                "kind": "fit",
                "session_id": "20300101-120000-abcdef",
                "recordings_id": None,
                "state": "running",
                "progress": 0.4,
                "message": "noise of the left camera",
                "error": None,
                "created": "2030-01-01T12:20:00Z",
                "started": "2030-01-01T12:20:00Z",
                "finished": None,
            }
        }
    )

    id: str
    kind: JobKind | RemovedKind
    session_id: str | None
    recordings_id: str | None
    state: JobState
    steps: tuple[WorkStep, ...] = Field(default=(), description="of work on a session or on recordings, in order")
    progress: float = Field(ge=0, le=1)
    message: str
    error: str | None
    created: Utc
    started: Utc | None
    finished: Utc | None


class SentAs(Schema):
    """What an archive holds: a recording set, or with `format` recordings as `calibench import` takes them."""

    format: (
        Annotated[str, _one_of("format", importers()), Field(json_schema_extra={"enum": list(importers())})] | None
    ) = Field(default=None, description="null: the archive is a recording set")
    path: str = Field(default="", max_length=400, description="the picture, or the folder, inside the archive")
    checkerboard: str = Field(
        default="", max_length=9, description="checkerboard, raw-folder: ROWSxCOLS of inner corners"
    )
    dots: str = Field(default="", max_length=9, description="dot-grid: ROWSxCOLS")
    square_mm: float | None = Field(
        default=None, gt=0, le=1e6, description="the checkerboard's squares, the dots' spacing"
    )
    tap: str = Field(default="", max_length=100, description="raw-folder, fits: this tap of the sensor alone")
    only: str = Field(
        default="",
        max_length=400,
        description="raw-folder, fits: frames alone whose headers state these settings, KEY=VALUE,...",
    )
    ignore: str = Field(
        default="", max_length=400, description="raw-folder, fits: keywords of the headers that are wrong, KEY,..."
    )
    camera: str = Field(default="", max_length=400, description="a picture's camera.toml inside the archive")
    exposure_s: float | None = Field(default=None, gt=0, le=1e6, description="a picture's exposure")
    transfer: Literal["linear", "srgb"] | None = Field(default=None, description="what a picture's codes are")
    channel: Literal["R", "G", "B"] | None = Field(default=None, description="slanted-edge: of a colour picture")
    corners: str = Field(
        default="", max_length=200, description="colorchecker: ROW,COL of dark skin, bluish green, black, white"
    )
    light: str = Field(default="", max_length=400, description="colorchecker: CSV inside the archive")
    white_patch: str = Field(default="", max_length=400, description="colorchecker: CSV inside the archive")


class SentCamera(Schema):
    """What is done with camera files that are sent in."""

    lensfun: str = Field(default="", max_length=400, description="a lensfun file inside the archive")
    lens: str = Field(default="", max_length=200, description="the model of the lens, where that file has several")


class SentSpectra(Schema):
    """Where the spectra are."""

    path: str = Field(default="", max_length=400, description="the file inside the archive; empty: its only one")


class ForeignSpectra(Schema):
    """The spectra of another program's file, by name. `quantity` null: the file doesn't state it."""

    quantity: Quantity | None
    spectra: dict[str, Spectrum]
    warnings: tuple[str, ...] = ()


class SentTable(Schema):
    """A table of levels: means and variances of channels (`photon-transfer-table`), or means by wavelength
    (`spectral-table`)."""

    format: TableKind
    path: str = Field(default="", max_length=400, description="the CSV inside the archive; empty: its only one")
    camera: str = Field(default="camera.toml", max_length=400, description="the data sheet inside the archive")


class TableFitted(Schema):
    """The fit of a table."""

    fit: FitResult
    warnings: tuple[str, ...] = ()


class Recordings(Schema):
    """A recording set that was sent in."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": "0123456789abcdef",
                "name": "another lab's camera",
                "notes": "",
                "cameras": ["left"],
                "captures": 212,
                "warnings": [],
            }
        }
    )

    id: str
    name: str
    notes: str
    cameras: tuple[Side, ...]
    captures: int
    warnings: tuple[str, ...] = ()


class RecordingsDetail(Recordings):
    """A recording set that was sent in, with how many captures it has of each kind and its results."""

    counts: tuple[CaptureCount, ...]
    verdict: DiagnosisVerdict | None = Field(default=None, description="of its newest diagnosis")
    results: dict[str, str] = Field(description="kind -> id of the newest `fit`, `validate`, `diagnose`, `report`")


class SetAsked(Asked):
    """Recordings: a session's, or some that were sent in."""

    model_config = ConfigDict(json_schema_extra={"example": {"session_id": "20300101-120000-abcdef"}})

    session_id: str | None = Field(default=None, pattern=r"^[0-9A-Za-z-]{1,40}$")
    recordings_id: str | None = Field(default=None, pattern=r"^[0-9a-f]{16}$")

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.session_id is None) == (self.recordings_id is None):
            raise ValueError("session_id, recordings_id: give one of both")
        return self


class LampAsked(Asked):
    """The radiance of a lamp, W sr^-1 m^-2 nm^-1, over the wavelength."""

    wavelength_nm: tuple[float, ...] = Field(min_length=2, max_length=10_000)
    value: tuple[float, ...] = Field(min_length=2, max_length=10_000)


class ChangesAsked(Asked):
    """What is changed between the session that a model was fitted to and the one that is predicted; null: as in the
    plan. Another lens is another camera model: send that in."""

    f_number: float | None = None
    temperature_c: float | None = Field(default=None, description="of the sensor, in all captures")
    lamp: LampAsked | None = Field(default=None, description="in place of that of flats, chart and edges")
    distance_mm: float | None = Field(default=None, description="of the scene")
    exposure_factor: float | None = None
    gain_db: float | None = None
    radiance_factor: float | None = Field(default=None, description="on all light")


class PredictionStart(Asked):
    """What to predict."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "camera_model": "0123456789abcdef",
                "plan": {"session_id": "20300101-120000-abcdef"},
                "changes": {"f_number": 8, "radiance_factor": 4},
            }
        }
    )

    camera_model: str = Field(pattern=r"^[0-9a-f]{16}$")
    plan: SetAsked = Field(description="its captures are planned again; only its manifest and spectra are used")
    changes: ChangesAsked = ChangesAsked()
    fitted: SetAsked | None = Field(
        default=None, description="the recordings of the fit: levels of flats are predicted relative to theirs"
    )
    light_std_percent: float = Field(default=0.3, ge=0, le=100, description="standard deviation of the light to come")


class StoredPrediction(Schema):
    """A sealed prediction. `plan`: id of the session or recordings that were planned again."""

    id: str
    sha256: str = Field(description="of the sealed file; give it to someone else before you capture")
    created: Utc
    camera_model: str
    plan: str
    changes: dict[str, Any]
    numbers: dict[Side, int] = Field(description="how many numbers are predicted")
    names: dict[Side, tuple[str, ...]] = Field(description="the names that the session will test")
    not_predicted: tuple[str, ...] = Field(default=(), description="why other numbers aren't predicted")


class DeviceState(Schema):
    """One instrument of a station, and how its latest self-test went."""

    name: str = Field(description="its table in the station file: `monochromator`, `cameras.left`")
    driver: str = Field(description="`family.name` of what drives it")
    address: str
    state: Literal["unknown", "in use", "checking", "works", "fails"] = Field(
        description="`unknown`: never checked; `in use`: a session works with it now"
    )
    used_by: str | None = Field(default=None, description="id of the session that works with it now")
    checked: Utc | None = Field(default=None, description="when the latest self-test ended")
    identity: str = Field(default="", description="maker, model, serial number and firmware, as it told them then")
    words: str = Field(default="", description="how the latest self-test went, in one line")
    transcript: str | None = Field(
        default=None, description="where what went over its wire can be fetched; null: not kept"
    )


class ConnectedDevice(Schema):
    """Something that is connected to the service's computer."""

    address: str
    what: str = Field(description="what it says it is")
    driver: str = Field(description="`family.name` of what drives it; empty where none is known, as of a serial port")


class DeviceCheck(Asked):
    """How a device is checked, or all of a station."""

    transcript: bool = Field(default=False, description="keep what goes over its wire meanwhile")
