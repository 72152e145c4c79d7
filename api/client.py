"""A client of the REST service: `calibench.connect`.

    with connect("http://127.0.0.1:8000", key) as client:
        session = client.capture("bench", quick=True, sequences=("dark", "flat"))
        fit = client.fit(session)

Its types are the classes that the service's OpenAPI document is made from (`api.schemas` and the results): there is one
list of them, and a test compares every method with the document. While a session or a job runs, a bar shows how far
it is. What the service refuses is an exception with the service's one line.
"""

from __future__ import annotations

import contextlib
import io
import os
import secrets
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, TypeVar

import httpx
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, TypeAdapter, ValidationError

from api.schemas import (
    CalibrationDetail,
    CameraModels,
    Certify,
    Comparison,
    ConnectedDevice,
    DeviceCheck,
    DeviceState,
    DraftedLimits,
    FigureName,
    FigureOfFit,
    Halt,
    Halted,
    Health,
    Job,
    JobKind,
    JobStart,
    ListedSession,
    Me,
    PipelineResults,
    PipelineStart,
    PlanAsked,
    PredictionStart,
    QueueEntry,
    QueuePlace,
    RecordedCapture,
    Recordings,
    RecordingsDetail,
    Revoke,
    SentAs,
    SessionDetail,
    SessionStart,
    SessionWords,
    SetAsked,
    StationState,
    StepDone,
    StoredCapture,
    StoredPrediction,
    StoredSession,
)
from lab.calibration.life import BOARD_COLUMNS, CalibrationRecord, DriftBoard, History
from lab.calibration.limits import CalibrationLimits
from lab.capture.catalogue import PlanEstimate, SequenceDescription
from lab.capture.plan import Parameters
from lab.capture.session import Progress
from lab.diagnose.visibility import EffectDescription, ParameterDescription
from lab.engine import DEFAULT_ENGINE, Engine
from lab.errors import InputError, one_line
from lab.formats.recording_set import RecordingSet, archive, read
from lab.formats.results import DiagnosisResult, FitResult, ValidationResult
from lab.progress_bar import progress_bar
from lab.quick_look.curves import Curves, FrameFigures
from lab.report.certificate import Certificate
from lab.report.findings import DiagnosisFindings
from lab.twin.budget import BudgetResult
from lab.twin.score import TwinScore
from sim.camera import Side

M = TypeVar("M", bound=BaseModel)
T = TypeVar("T")
W = TypeVar("W", SessionDetail, Job)
#: What work is done on: a session or recordings that were sent in; a text is a session's id.
Source = str | StoredSession | Recordings
#: How often (s) a client that waits looks, and how long it waits unless it is told.
LOOK_S, PATIENCE_S = 0.2, 600.0
#: How long (s) a stream of events may be silent: it says something every 15 s.
EVENTS_S = 60.0
#: Where a service is that runs on this computer.
HERE = "http://127.0.0.1:8000"


class ServiceProblem(Exception):
    """The service refused a request: its status and its one line."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(f"{status}: {detail}")
        self.status, self.detail = status, detail


class ServiceUnreachable(httpx.TransportError):
    """The service isn't reached, or the connection broke: where, why and the remedy, in one line."""


class OtherVersion(ServiceProblem):
    """The service's answer isn't one of this version of calibench."""


class _Connection(httpx.Client):
    """Connections whose failures are one line with a remedy."""

    def send(self, request: httpx.Request, **options: Any) -> httpx.Response:
        with _raise_unreachable(str(self.base_url.copy_with(path="/"))):
            return super().send(request, **options)


@contextlib.contextmanager
def _raise_unreachable(url: str) -> Iterator[None]:
    """Raise ServiceUnreachable where httpx doesn't reach the service, or loses it while an answer arrives."""
    try:
        yield
    except ServiceUnreachable:
        raise
    except httpx.TimeoutException as error:
        raise ServiceUnreachable(
            f"{url}: no answer in time ({type(error).__name__}); look after the service"
        ) from error
    except httpx.TransportError as error:
        raise ServiceUnreachable(
            f"{url}: {one_line(error)}; start `calibench serve` there, or correct the address"
        ) from error


def _read(model: type[M], content: bytes | str) -> M:
    """Return an answer in its type. Raises OtherVersion where it isn't of that type."""
    return _understood(lambda: model.model_validate_json(content))


def _read_list(model: type[M], content: bytes) -> list[M]:
    """Return the items of an answer. Raises as `_read`."""
    return _understood(lambda: TypeAdapter(list[model]).validate_json(content))  # type: ignore[valid-type]


def _understood(parse: Callable[[], T]) -> T:
    try:
        return parse()
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in (error.title, *first["loc"]))
        remedy = "install the version of calibench that the service has"
        raise OtherVersion(200, f"the answer isn't of this version ({where}: {first['msg']}); {remedy}") from error


def _problem(response: httpx.Response) -> ServiceProblem:
    try:
        detail = str(response.json()["detail"])
    except (ValueError, KeyError, TypeError):
        detail = response.text[:200]
    return ServiceProblem(response.status_code, detail)


def _id_of(source: Source) -> str:
    return source if isinstance(source, str) else source.id


def _standing(of: SessionDetail | Job) -> tuple[str, float]:
    """Return what is under way, and the share of the work that is done."""
    if isinstance(of, Job):
        return of.message or f"{of.kind} {of.state}", of.progress
    return f"session {of.state}", of.steps_done / max(of.steps, 1)


def connect(
    url: str = HERE, key: str | None = None, *, progress: bool | None = None, timeout_s: float = 30.0
) -> ServiceClient:
    """Connect to a service, and look whether it takes the key.

    url : address of the service, `http://HOST:PORT`
    key : a key of the service (`calibench keys create`); None: what CALIBENCH_KEY says
    progress : show a bar while a session or a job runs; None: on a terminal and in a notebook
    timeout_s : how long the service may take for an answer

    Returns the client; use it as a context manager, or `close` it. Raises InputError without a key, ServiceUnreachable
    where nothing answers, ServiceProblem where the key isn't valid.

    >>> import calibench
    >>> calibench.connect("http://127.0.0.1:1", "calibench_none")
    Traceback (most recent call last):
        ...
    api.client.ServiceUnreachable: http://127.0.0.1:1/: [Errno 111] Connection refused; start `calibench serve` there, \
or correct the address
    """
    key = os.environ.get("CALIBENCH_KEY", "") if key is None else key
    if not key:
        raise InputError("connect: no key; give one that `calibench keys create` printed, or set CALIBENCH_KEY")
    client = ServiceClient(url.rstrip("/"), key, timeout_s, progress=progress)
    try:
        client.me()
    except BaseException:
        client.close()
        raise
    return client


class ServiceClient:
    """The service at `url`, with a key. Every method raises ServiceProblem where the service refuses,
    ServiceUnreachable where it isn't reached, and those that wait TimeoutError. `progress`: of those that wait, show a
    bar; None: on a terminal and in a notebook."""

    def __init__(self, url: str, key: str, timeout_s: float = 30.0, *, progress: bool | None = None) -> None:
        self.url, self.progress = url, progress
        headers = {"Authorization": f"Bearer {key}"}
        self.http = _Connection(base_url=f"{url}/api/v1", headers=headers, timeout=timeout_s, trust_env=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self.http.close()

    # --- requests -----------------------------------------------------------------------------------------------------

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send any request below `/api/v1`; a POST has a key, so that it is carried out once."""
        if method == "POST":
            options["headers"] = {"Idempotency-Key": secrets.token_hex(16)} | dict(options.get("headers") or {})
        response = self.http.request(method, path, **options)
        if response.is_error:
            raise _problem(response)
        return response

    def _fetch(self, path: str, file: Path) -> Path:
        """Write the archive of a path to `file`, a .tar where its name ends so, else a .zip, as it arrives: completely,
        or not at all."""
        partial = file.with_name(f".{file.name}.partial")
        try:
            with (
                _raise_unreachable(self.url),
                self.http.stream("GET", f"{path}{file.suffix or '.zip'}") as response,
                partial.open("wb") as to,
            ):
                if response.is_error:
                    response.read()
                    raise _problem(response)
                for piece in response.iter_bytes():
                    to.write(piece)
            partial.replace(file)
        finally:
            partial.unlink(missing_ok=True)
        return file

    def _get(self, model: type[M], path: str, **params: Any) -> M:
        return _read(model, self.request("GET", path, params=params).content)

    def _post(self, model: type[M], path: str, body: BaseModel | None = None) -> M:
        content = {} if body is None else {"json": body.model_dump(mode="json")}
        return _read(model, self.request("POST", path, **content).content)

    def _send(self, model: type[M], path: str, archive: Path, **params: Any) -> M:
        """Send a .zip, .tar or .tar.gz piece by piece: it may be larger than the memory."""
        sent = {".zip": "application/zip", ".tar": "application/x-tar"}.get(archive.suffix, "application/gzip")
        headers = {"Content-Type": sent, "Content-Length": str(archive.stat().st_size)}
        with archive.open("rb") as file:
            response = self.request("POST", path, content=file, headers=headers, params=params)
        return _read(model, response.content)

    def _events(self, path: str) -> Iterator[tuple[str, str]]:
        """(name, data) of each event of a stream, as it arrives."""
        name = ""
        with _raise_unreachable(self.url), self.http.stream("GET", path, timeout=EVENTS_S) as response:
            if response.is_error:
                response.read()
                raise _problem(response)
            for line in response.iter_lines():
                key, _, value = line.partition(": ")
                if key == "event":
                    name = value
                elif key == "data":
                    yield name, value
                    if name == "end":
                        return

    def _pages(self, model: type[M], path: str, **params: Any) -> Iterator[M]:
        """All items of a list, page by page."""
        response = self.request("GET", path, params=params)
        while True:
            yield from _read_list(model, response.content)
            following = response.links.get("next", {}).get("url")
            if following is None:
                return
            response = self.request("GET", f"{self.url}{following}")

    def _wait_for_end(self, what: str, look: Callable[[], W], ends: tuple[str, ...], patience_s: float) -> W:
        """Return what `look` finds once its state is one of `ends`. Raises ServiceProblem unless that is the first of
        them, the good one."""
        until = time.monotonic() + patience_s
        with progress_bar(self.progress) as advance:
            while (present := look()).state not in ends:
                if time.monotonic() > until:
                    raise TimeoutError(f"after {patience_s:g} s: {what} is {present.state}")
                advance(*_standing(present))
                time.sleep(LOOK_S)
        if present.state != ends[0]:
            raise ServiceProblem(409, f"{what} is {present.state}: {present.error}")
        return present

    def health(self) -> Health:
        """Return whether the service is up, and its version."""
        return _read(Health, self.http.get(f"{self.url}/health").raise_for_status().content)

    def ready(self) -> Health:
        """Return whether the service can work: its registry answers, its data folder takes files."""
        response = self.http.get(f"{self.url}/healthz")
        if response.is_error:
            raise _problem(response)
        return _read(Health, response.content)

    def metrics(self) -> str:
        """Return requests, sessions and jobs, as Prometheus reads them."""
        return self.request("GET", f"{self.url}/metrics").text

    def me(self) -> Me:
        """Name and scope of the key."""
        return self._get(Me, "/me")

    # --- stations and sessions ----------------------------------------------------------------------------------------

    def stations(self) -> list[StationState]:
        """Return the stations that the service knows."""
        return list(self._pages(StationState, "/stations"))

    def station(self, name: str) -> StationState:
        """Return a station."""
        return self._get(StationState, f"/stations/{name}")

    def connected(self) -> list[ConnectedDevice]:
        """Return what is connected to the service's computer, and what drives it."""
        return list(self._pages(ConnectedDevice, "/devices"))

    def devices(self, station: str) -> list[DeviceState]:
        """Return a station's instruments, and how their latest self-tests went."""
        return list(self._pages(DeviceState, f"/stations/{station}/devices"))

    def device(self, station: str, device: str) -> DeviceState:
        """Return an instrument of a station."""
        return self._get(DeviceState, f"/stations/{station}/devices/{device}")

    def start_check(self, station: str, device: str, *, transcript: bool = False) -> DeviceState:
        """Let an instrument work once, in the background."""
        return self._post(
            DeviceState, f"/stations/{station}/devices/{device}/check", DeviceCheck(transcript=transcript)
        )

    def check_device(
        self, station: str, device: str, *, transcript: bool = False, patience_s: float = PATIENCE_S
    ) -> DeviceState:
        """Let an instrument work once and wait for the end of that; its `state` says whether it works."""
        check = self.start_check(station, device, transcript=transcript)
        until = time.monotonic() + patience_s
        while check.state == "checking":
            if time.monotonic() > until:
                raise TimeoutError(f"after {patience_s:g} s: {check!r}")
            time.sleep(LOOK_S)
            check = self.device(station, device)
        return check

    def put_back(self, station: str) -> StationState:
        """Say that what sessions left changed by hand on a station is put back."""
        return _read(StationState, self.request("POST", f"/stations/{station}/put-back").content)

    def start_checks(self, station: str, *, transcript: bool = False) -> list[DeviceState]:
        """Let every instrument of a station work once, one after the other, in the background."""
        body = DeviceCheck(transcript=transcript).model_dump(mode="json")
        response = self.request("POST", f"/stations/{station}/check", json=body)
        return _read_list(DeviceState, response.content)

    def transcript(self, station: str, device: str) -> str:
        """Return what went over an instrument's wire in the latest check that kept it."""
        return self.request("GET", f"/stations/{station}/devices/{device}/transcript").text

    def sequences(self) -> list[SequenceDescription]:
        """Return the catalogue of sequences."""
        return list(self._pages(SequenceDescription, "/sequences"))

    def sequence(self, name: str) -> SequenceDescription:
        """Return a sequence of the catalogue."""
        return self._get(SequenceDescription, f"/sequences/{name}")

    def estimate(self, station: str, asked: PlanAsked | None = None) -> PlanEstimate:
        """Return what a session would take on a station: captures and time."""
        return self._post(PlanEstimate, f"/stations/{station}/estimate", asked or PlanAsked())

    def sessions(self, **only: str) -> Iterator[ListedSession]:
        """Yield sessions, the newest first; `only`: those that a `search` finds, or of a `verdict`."""
        return self._pages(ListedSession, "/sessions", **only)

    def session(self, session_id: str) -> SessionDetail:
        """Return a session, with its provenance."""
        return self._get(SessionDetail, f"/sessions/{session_id}")

    def start_session(self, start: SessionStart) -> StoredSession:
        """Start a session, which runs in the background."""
        return self._post(StoredSession, "/sessions", start)

    def describe_session(self, session_id: str, *, name: str | None = None, notes: str | None = None) -> StoredSession:
        """Give a session another name, or other notes."""
        body = SessionWords(name=name, notes=notes).model_dump(mode="json")
        response = self.request("PATCH", f"/sessions/{session_id}", json=body)
        return _read(StoredSession, response.content)

    def session_request(self, session_id: str) -> SessionStart:
        """Return what a session was asked to start with."""
        return self._get(SessionStart, f"/sessions/{session_id}/request")

    def change_request(self, session_id: str, start: SessionStart) -> StoredSession:
        """Let another session take the place of one that waits in the queue and never ran."""
        response = self.request("PUT", f"/sessions/{session_id}/request", json=start.model_dump(mode="json"))
        return _read(StoredSession, response.content)

    def queue(self) -> list[QueueEntry]:
        """Return the sessions that wait for their instruments, in their order."""
        return list(self._pages(QueueEntry, "/queue"))

    def queue_session(self, session_id: str, asked: QueuePlace | None = None) -> list[QueueEntry]:
        """Let a session wait for its turn, move one that waits, or release one that is held; the queue then."""
        body = (asked or QueuePlace()).model_dump(mode="json")
        response = self.request("PUT", f"/sessions/{session_id}/queue", json=body)
        return _read_list(QueueEntry, response.content)

    def unqueue_session(self, session_id: str) -> list[QueueEntry]:
        """Take a session out of the queue; the queue then."""
        response = self.request("DELETE", f"/sessions/{session_id}/queue")
        return _read_list(QueueEntry, response.content)

    def confirm(self, session_id: str, target: str, since: datetime | None = None) -> StoredSession:
        """Say that what a session waits for an operator to do (its `asks`) is done."""
        return self._post(StoredSession, f"/sessions/{session_id}/confirm", StepDone(target=target, since=since))

    def halt(self, station: str | None = None) -> tuple[str, ...]:
        """End every session now, or those on one station, and hold the queue; the ids of the sessions that ran."""
        return self._post(Halted, "/halt", Halt(station=station)).sessions

    def pause(self, session_id: str) -> StoredSession:
        """Pause a session at the end of its step."""
        return self._post(StoredSession, f"/sessions/{session_id}/pause")

    def resume(self, session_id: str) -> StoredSession:
        """Continue a session."""
        return self._post(StoredSession, f"/sessions/{session_id}/resume")

    def abort(self, session_id: str) -> StoredSession:
        """End a session's run now."""
        return self._post(StoredSession, f"/sessions/{session_id}/abort")

    def wait_session(self, session_id: str, patience_s: float = PATIENCE_S) -> SessionDetail:
        """Wait until a session's run is over. Raises ServiceProblem unless it finished."""
        ends = ("finished", "interrupted", "failed")
        return self._wait_for_end(f"session {session_id}", lambda: self.session(session_id), ends, patience_s)

    def capture(
        self,
        station: str,
        *,
        quick: bool = False,
        sequences: tuple[str, ...] | None = None,
        parameters: Parameters | None = None,
        name: str = "",
        demands_certified: bool = False,
        patience_s: float = PATIENCE_S,
    ) -> SessionDetail:
        """Start a session and wait for its end. `parameters`: values in place of a full session's, as `{"narrowband":
        {"step_nm": 5}}`."""
        start = SessionStart.model_validate(
            {
                "station": station,
                "quick": quick,
                "sequences": sequences,
                "parameters": parameters or {},
                "name": name,
                "demands_certified": demands_certified,
            }
        )
        return self.wait_session(self.start_session(start).id, patience_s)

    def captures(self, session_id: str, **only: str) -> Iterator[StoredCapture]:
        """Yield the captures of a session; `only`: of a `kind`, a `side`."""
        return self._pages(StoredCapture, f"/sessions/{session_id}/captures", **only)

    def follow_session(self, session_id: str) -> Iterator[StoredSession | Progress]:
        """Yield a session's state and progress as they change, until its run is over."""
        for name, data in self._events(f"/sessions/{session_id}/events"):
            yield _read(Progress, data) if name == "progress" else _read(StoredSession, data)

    def stored_capture(self, session_id: str, capture_id: int) -> StoredCapture:
        """Return a capture."""
        return self._get(StoredCapture, f"/sessions/{session_id}/captures/{capture_id}")

    def preview(
        self,
        session_id: str,
        capture_id: int,
        *,
        width_px: int = 480,
        stretch: bool = False,
        picture: Literal["png", "webp"] = "png",
    ) -> bytes:
        """Return a capture's small picture. `stretch`: white is the frame's own brightest; `picture`: its format."""
        asked = {"width": width_px, "stretch": stretch}
        return self.request(
            "GET", f"/sessions/{session_id}/captures/{capture_id}/preview.{picture}", params=asked
        ).content

    def capture_figures(self, session_id: str, capture_id: int) -> FrameFigures:
        """Return histogram, mean and saturated share of each channel of a frame."""
        return self._get(FrameFigures, f"/sessions/{session_id}/captures/{capture_id}/figures")

    def curves(self, session_id: str) -> Curves:
        """Return photon transfer, sensitivity and MTF as a session's captures so far show them."""
        return self._get(Curves, f"/sessions/{session_id}/curves")

    def frame(self, capture: StoredCapture) -> NDArray[np.uint16]:
        """Return the raw frame of a capture: uint16 (rows, cols)."""
        content = self.request("GET", f"/sessions/{capture.session_id}/captures/{capture.id}/frame.npy").content
        frame: NDArray[np.uint16] = np.load(io.BytesIO(content), allow_pickle=False)
        return frame

    def session_figures(self, session_id: str) -> list[FigureOfFit]:
        """Return the figures of a session's newest fit."""
        return list(self._pages(FigureOfFit, f"/sessions/{session_id}/figures"))

    # --- recordings and jobs ------------------------------------------------------------------------------------------

    def send_recordings(self, recordings: RecordingSet | str | Path, asked: SentAs | None = None) -> Recordings:
        """Send in a recording set: the set, its folder, or a .zip, .tar or .tar.gz of it; with `asked`, an archive of
        recordings of another format, which become one."""
        stated = {} if asked is None else asked.model_dump(mode="json", exclude_unset=True)
        if not isinstance(recordings, RecordingSet) and not Path(recordings).is_dir():
            return self._send(Recordings, "/recordings", Path(recordings), **stated)
        opened = recordings if isinstance(recordings, RecordingSet) else read(recordings)
        with tempfile.TemporaryDirectory(prefix="calibench-") as folder:
            packed = Path(folder) / "recordings.tar"
            with packed.open("wb") as file:
                file.writelines(archive(opened, "tar"))
            return self._send(Recordings, "/recordings", packed, **stated)

    def recordings(self) -> Iterator[Recordings]:
        """Yield all recording sets that were sent in, the newest first."""
        return self._pages(Recordings, "/recordings")

    def recording_set(self, recordings_id: str) -> RecordingsDetail:
        """Return a recording set that was sent in."""
        return self._get(RecordingsDetail, f"/recordings/{recordings_id}")

    def recorded_captures(self, recordings_id: str, **only: str) -> Iterator[RecordedCapture]:
        """Yield the captures of a recording set; `only`: of a `kind`, a `side`."""
        return self._pages(RecordedCapture, f"/recordings/{recordings_id}/captures", **only)

    def recorded_capture(self, recordings_id: str, number: int) -> RecordedCapture:
        """Return a capture of a recording set, by its number from 1."""
        return self._get(RecordedCapture, f"/recordings/{recordings_id}/captures/{number}")

    def recorded_preview(self, recordings_id: str, number: int, *, picture: Literal["png", "webp"] = "png") -> bytes:
        """Return the small picture of a recording set's capture."""
        return self.request("GET", f"/recordings/{recordings_id}/captures/{number}/preview.{picture}").content

    def recorded_frame(self, recordings_id: str, number: int) -> NDArray[np.uint16]:
        """Return the raw frame of a recording set's capture: uint16 (rows, cols)."""
        content = self.request("GET", f"/recordings/{recordings_id}/captures/{number}/frame.npy").content
        frame: NDArray[np.uint16] = np.load(io.BytesIO(content), allow_pickle=False)
        return frame

    def recorded_capture_figures(self, recordings_id: str, number: int) -> FrameFigures:
        """Return histogram, mean and saturated share of each channel of a recording set's frame."""
        return self._get(FrameFigures, f"/recordings/{recordings_id}/captures/{number}/figures")

    def recordings_figures(self, recordings_id: str) -> list[FigureOfFit]:
        """Return the figures of the newest fit of recordings."""
        return list(self._pages(FigureOfFit, f"/recordings/{recordings_id}/figures"))

    def fetch_recordings(self, recordings_id: str, file: Path) -> Path:
        """Write a recording set that was sent in to `file`, a .zip or .tar."""
        return self._fetch(f"/recordings/{recordings_id}/archive", file)

    def delete_recordings(self, recordings_id: str) -> None:
        """Delete a recording set for ever."""
        self.request("DELETE", f"/recordings/{recordings_id}")

    def fetch_session(self, session_id: str, file: Path) -> Path:
        """Write a session to `file`, a .zip or .tar of a recording set."""
        return self._fetch(f"/sessions/{session_id}/archive", file)

    def delete_session(self, session_id: str) -> None:
        """Delete a session for ever; its results and calibrations stay."""
        self.request("DELETE", f"/sessions/{session_id}")

    def start_job(
        self, kind: JobKind, session_id: str, camera_model: str | None = None, engine: Engine = DEFAULT_ENGINE
    ) -> Job:
        """Start work on a finished session; validate and diagnose may begin with a `camera_model`. `engine`: which one
        diagnoses."""
        start = JobStart(kind=kind, camera_model=camera_model, engine=engine)
        return self._post(Job, f"/sessions/{session_id}/jobs", start)

    def start_recordings_job(
        self, kind: JobKind, recordings_id: str, camera_model: str | None = None, engine: Engine = DEFAULT_ENGINE
    ) -> Job:
        """Start work on recordings that were sent in, as `start_job`."""
        start = JobStart(kind=kind, camera_model=camera_model, engine=engine)
        return self._post(Job, f"/recordings/{recordings_id}/jobs", start)

    def follow_job(self, job_id: str) -> Iterator[Job]:
        """Yield a job as it changes, until it is over."""
        for _, data in self._events(f"/jobs/{job_id}/events"):
            yield _read(Job, data)

    def start_pipeline(self, start: PipelineStart) -> Job:
        """Start a session and the whole pipeline on it."""
        return self._post(Job, "/pipelines", start)

    def job(self, job_id: str) -> Job:
        """Return a job."""
        return self._get(Job, f"/jobs/{job_id}")

    def jobs(self, **only: str) -> Iterator[Job]:
        """Yield all jobs, the newest first."""
        return self._pages(Job, "/jobs")

    def cancel(self, job_id: str) -> Job:
        """Ask a job to end."""
        return self._post(Job, f"/jobs/{job_id}/cancel")

    def wait_job(self, job_id: str, patience_s: float = PATIENCE_S) -> Job:
        """Wait until a job is over. Raises ServiceProblem unless it is done."""
        return self._wait_for_end(
            f"job {job_id}", lambda: self.job(job_id), ("done", "failed", "cancelled"), patience_s
        )

    def _make(
        self, model: type[M], kind: JobKind, source: Source, patience_s: float, engine: Engine = DEFAULT_ENGINE
    ) -> M:
        start = self.start_recordings_job if isinstance(source, Recordings) else self.start_job
        job = self.wait_job(start(kind, _id_of(source), engine=engine).id, patience_s)
        return self._get(model, f"/jobs/{job.id}/result")

    def fit(self, source: Source, patience_s: float = PATIENCE_S) -> FitResult:
        """Fit a finished session, or recordings that were sent in, and wait for the result."""
        return self._make(FitResult, "fit", source, patience_s)

    def validate(self, source: Source, patience_s: float = PATIENCE_S) -> ValidationResult:
        """Validate the fit of a finished session, or of recordings, and wait for the result."""
        return self._make(ValidationResult, "validate", source, patience_s)

    def diagnose(
        self, source: Source, patience_s: float = PATIENCE_S, *, engine: Engine = DEFAULT_ENGINE
    ) -> DiagnosisResult:
        """Diagnose a finished session, or recordings that were sent in, and wait for the result. `engine`: `evidence`
        or `today`."""
        return self._make(DiagnosisResult, "diagnose", source, patience_s, engine)

    def findings(self, session_id: str) -> DiagnosisFindings:
        """Return what a session's newest diagnosis found, in words."""
        return self._get(DiagnosisFindings, f"/sessions/{session_id}/findings")

    def recordings_findings(self, recordings_id: str) -> DiagnosisFindings:
        """Return what the newest diagnosis of recordings found, in words."""
        return self._get(DiagnosisFindings, f"/recordings/{recordings_id}/findings")

    def pipeline_results(self, job_id: str) -> PipelineResults:
        """Return what a pipeline found."""
        return self._get(PipelineResults, f"/jobs/{job_id}/result")

    def report(self, job_id: str) -> str:
        """Return the page of a job of the kind `report` or `pipeline`."""
        return self.request("GET", f"/jobs/{job_id}/report").text

    # --- calibrations -------------------------------------------------------------------------------------------------

    def calibrations(self) -> Iterator[CalibrationRecord]:
        """Yield all calibrations, the newest first."""
        return self._pages(CalibrationRecord, "/calibrations")

    def calibration(self, calibration_id: str) -> CalibrationDetail:
        """Return a calibration, with its judgements, and what speaks against it."""
        return self._get(CalibrationDetail, f"/calibrations/{calibration_id}")

    def calibration_figures(self, calibration_id: str) -> list[FigureOfFit]:
        """Return every figure of a calibration."""
        return list(self._pages(FigureOfFit, f"/calibrations/{calibration_id}/figures"))

    def drafted_limits(self, calibration_id: str) -> DraftedLimits:
        """Return limits drafted from what the same cameras had before."""
        return self._get(DraftedLimits, f"/calibrations/{calibration_id}/drafted-limits")

    def certificate(self, calibration_id: str) -> Certificate:
        """Return what a certificate states, and its hashes."""
        return self._get(Certificate, f"/calibrations/{calibration_id}/certificate.json")

    def certificate_page(self, calibration_id: str) -> str:
        """Return a certificate as a page to print."""
        return self.request("GET", f"/calibrations/{calibration_id}/certificate").text

    def revoke(self, calibration_id: str, why: str) -> CalibrationRecord:
        """Take a certificate back."""
        return self._post(CalibrationRecord, f"/calibrations/{calibration_id}/revoke", Revoke(why=why))

    def certify(
        self,
        calibration_id: str,
        limits: CalibrationLimits | DraftedLimits | None = None,
        *,
        accept_warnings: bool = False,
    ) -> CalibrationRecord:
        """Certify a candidate, against `limits`, drafted ones among them, or those of the service's data folder."""
        asked = Certify(limits=limits, accept_warnings=accept_warnings)
        return self._post(CalibrationRecord, f"/calibrations/{calibration_id}/certify", asked)

    def camera_models(self) -> Iterator[CameraModels]:
        """Yield the camera models of fits and diagnoses, the newest first."""
        return self._pages(CameraModels, "/camera-models")

    def camera_model(self, model_id: str) -> CameraModels:
        """Return a camera model, with the parameters of each camera."""
        return self._get(CameraModels, f"/camera-models/{model_id}")

    def send_camera_model(self, archive: Path) -> CameraModels:
        """Send in camera files, left.toml or right.toml or both, as a .zip, .tar or .tar.gz."""
        return self._send(CameraModels, "/camera-models", archive)

    def delete_camera_model(self, model_id: str) -> None:
        """Delete a camera model that was sent in, for ever."""
        self.request("DELETE", f"/camera-models/{model_id}")

    def fetch_camera_model(self, model_id: str, file: Path) -> Path:
        """Write the camera files of a model to `file`, a .zip or .tar."""
        return self._fetch(f"/camera-models/{model_id}/archive", file)

    def predict(self, asked: PredictionStart) -> StoredPrediction:
        """Predict a session that hasn't been captured, and seal that."""
        return self._post(StoredPrediction, "/predictions", asked)

    def predictions(self) -> Iterator[StoredPrediction]:
        """Yield the sealed predictions, the newest first."""
        return self._pages(StoredPrediction, "/predictions")

    def prediction(self, prediction_id: str) -> StoredPrediction:
        """Return a prediction."""
        return self._get(StoredPrediction, f"/predictions/{prediction_id}")

    def sealed_prediction(self, prediction_id: str) -> bytes:
        """Return the sealed file, whose SHA-256 is that of the prediction."""
        return self.request("GET", f"/predictions/{prediction_id}/sealed.json").content

    def delete_prediction(self, prediction_id: str) -> None:
        """Delete a prediction for ever."""
        self.request("DELETE", f"/predictions/{prediction_id}")

    def score_prediction(self, prediction_id: str, asked: SetAsked) -> TwinScore:
        """Open a prediction against the recordings of the session that it foretold."""
        return self._post(TwinScore, f"/predictions/{prediction_id}/score", asked)

    def budget(self, model_id: str, use: str, station: str | None = None) -> dict[Side, BudgetResult]:
        """Return what matters for a use of each camera of a model; with a station, which of its sequences to take
        next."""
        params = {"use": use} | ({} if station is None else {"station": station})
        budgets = self.request("GET", f"/camera-models/{model_id}/budget", params=params).json()
        return {side: BudgetResult.model_validate(budget) for side, budget in budgets.items()}

    def compare(self, a: str, b: str, fail_on: Sequence[str] = ()) -> Comparison:
        """Compare two calibrations, by id, as `calibench compare` does."""
        return self._get(Comparison, "/comparisons", a=a, b=b, fail_on=list(fail_on))

    def comparison_page(self, a: str, b: str) -> str:
        """Return the comparison with its pictures, one page."""
        return self.request("GET", "/comparisons/page", params={"a": a, "b": b}).text

    def figures(self) -> list[FigureName]:
        """Return what there is a history of."""
        return list(self._pages(FigureName, "/figures"))

    def history(self, camera: str, figure: str, place: str = "") -> History:
        """Return a figure of a camera over its calibrations."""
        return self._get(History, "/history", camera=camera, figure=figure, place=place)

    def drift(self, camera: str, *, reference_c: float | None = None, newest: int = BOARD_COLUMNS) -> DriftBoard:
        """Return all figures of a camera by its newest calibrations, dark currents at a reference temperature."""
        asked: dict[str, Any] = {"camera": camera, "newest": newest}
        return self._get(DriftBoard, "/drift", **asked | ({} if reference_c is None else {"reference_c": reference_c}))

    # --- what the models know -----------------------------------------------------------------------------------------

    def parameters(self) -> list[ParameterDescription]:
        """Return the parameters of the camera model, with unit, bounds and prior."""
        return list(self._pages(ParameterDescription, "/parameters"))

    def effects(self) -> list[EffectDescription]:
        """Return the library that a diagnosis chooses from."""
        return list(self._pages(EffectDescription, "/effects"))

    def effect(self, name: str) -> EffectDescription:
        """Return an effect."""
        return self._get(EffectDescription, f"/effects/{name}")
