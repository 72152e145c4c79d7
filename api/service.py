"""The service behind the routes of one application, and the dependencies that routes declare."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, HTTPException, Request
from fastapi import Path as PathParameter

from api.checks import DeviceChecks
from api.errors import Conflict, find_or_404
from api.keys import Permission
from api.live import LiveSessions
from api.pictures import Pictures
from api.public_text import PublicText
from api.safety import StationSafety
from api.security import Demand, Gate
from api.then import ThenRunner
from api.upload import Inbox
from api.waiting import QueueRunner
from lab.calibration import camera_models
from lab.calibration.camera_models import CameraModelRecord
from lab.capture.questions import Question, question_of
from lab.capture.records import RunRecord, SessionInfo
from lab.capture.session import Progress
from lab.capture.station import Station, read_station
from lab.capture.store import Store
from lab.errors import InputError
from lab.formats.results import ReportFile
from lab.jobs import JobInfo, JobRunner
from lab.quick_look.process import QuickLook

#: States of a session that nothing works on.
OVER = frozenset({"created", "queued", "interrupted", "failed", "finished"})


@dataclass(frozen=True)
class Limits:
    """Upper limits of request bodies and archives."""

    body_bytes: int = 1 << 20
    upload_bytes: int = 4 << 30
    unpacked_bytes: int = 16 << 30
    unpacked_files: int = 20_000
    #: Of a camera model, packed and unpacked: its files are read into memory.
    model_bytes: int = 64 << 20


@dataclass(frozen=True)
class Service:
    """What the routes work on; one per application."""

    store: Store
    stations: Path
    live: LiveSessions
    waiting: QueueRunner
    then: ThenRunner
    quick_look: QuickLook
    pictures: Pictures
    jobs: JobRunner
    inbox: Inbox
    gate: Gate
    limits: Limits
    public: PublicText
    checks: DeviceChecks
    #: To be called where a state was seen to change that no request changed.
    changed: Callable[[], None]

    def station_files(self) -> dict[str, Path]:
        """Return the station files by name."""
        return {file.stem: file for file in sorted(self.stations.glob("*.toml")) if file.is_file()}

    def station_file(self, name: str) -> Path:
        """Return a station's file; 404 where there is none."""
        file = self.station_files().get(name)  # looked up, never joined: a name can't leave the folder
        if file is None:
            raise HTTPException(404, f"no station {name[:100]!r}; GET /api/v1/stations lists them")
        return file

    def station(self, name: str) -> Station:
        """Return a station by its file's name; 404 where there is none. Raises InputError where the file can't be
        used."""
        file = self.station_file(name)
        with os.scandir(self.stations) as entries:  # a station's curves are files beside it
            there = frozenset(
                (file.name, (at := file.stat()).st_mtime_ns, at.st_size) for file in entries if file.is_file()
            )
        return _read_station(file, there)

    def safety(self, station: Station) -> StationSafety | None:
        """Return what is known of a station's safe state, as an answer may have it."""
        safety = self.live.safety.find(station)
        return safety and safety.model_copy(update={"words": self.public(safety.words)})

    def session(self, session_id: str) -> SessionInfo:
        """Return a session; 404 where there is none."""
        return find_or_404(missing_session(session_id), lambda: self.store.session(session_id))

    def state(self, info: SessionInfo) -> Any:
        """Return what state a session is in: as this service runs it, else as the registry has it."""
        live = self.live.find(info.id)
        if live is None:
            return info.state
        if live.latest is None:
            return "connecting"
        return "pausing" if live.pausing and live.latest.state == "running" else live.latest.state

    def job(self, job_id: str) -> JobInfo:
        """Return a job; 404 where there is none."""
        return find_or_404(f"no job {job_id[:60]!r}; GET /api/v1/jobs lists them", lambda: self.jobs.job(job_id))

    def check_no_job(self, source: str, what: str) -> None:
        """Raises Conflict where a job on this source is queued or runs."""
        for job in self.jobs.under_way(source):
            raise Conflict(f"{what}: job {job.id} ({job.kind}) is {job.state}; wait for its end or cancel it")

    def recordings(self, recordings_id: str) -> Path:
        """Return the folder of recordings that were sent in; 404 where there are none of that id."""
        return find_or_404(
            f"no recordings {recordings_id[:60]!r}; GET /api/v1/recordings lists them",
            lambda: self.inbox.folder(recordings_id),
        )

    def report(self, job_id: str) -> str:
        """Return the page that a job of the kind `report` or `pipeline` wrote. Raises InputError where it is gone."""
        written = ReportFile.model_validate(self.store.result(job_id).document)
        try:
            return (self.store.root / written.path).read_text(encoding="utf-8")
        except OSError as error:
            raise InputError(f"{written.path}: can't be read ({error.strerror}); make the report again") from error

    def progress(self, session_id: str) -> Progress | None:
        """Return the latest progress of a session that this process runs, else None."""
        live = self.live.find(session_id)
        return self.make_public(live.latest) if live is not None and live.latest is not None else None

    def make_public(self, progress: Progress) -> Progress:
        """Return a session's progress as an answer may have it."""
        texts = {
            "what": self.public(progress.what),
            "remark": self.public.or_none(progress.remark),
            "asks": self._public_question(progress.asks),
        }
        return progress.model_copy(update=texts)

    def asks(self, session_id: str | None) -> Question | None:
        """Return what a session waits for an operator to do, as an answer may have it; None: nothing."""
        return self._public_question(question_of(self.store, session_id)) if session_id else None

    def _public_question(self, question: Question | None) -> Question | None:
        return question and question.model_copy(update={"instruction": self.public(question.instruction)})

    def public_runs(self, runs: Iterable[RunRecord]) -> tuple[RunRecord, ...]:
        """Return the provenance of a session. An address that is a folder of the server is only its name."""
        return tuple(
            run.model_copy(
                update={
                    "instruments": {
                        name: instrument.model_copy(
                            update={key: self.public(value) for key, value in instrument if isinstance(value, str)}
                        )
                        for name, instrument in run.instruments.items()
                    },
                    "changes": tuple(map(self.public, run.changes)),
                }
            )
            for run in runs
        )


def missing_session(session_id: str) -> str:
    """Return the message on a session that isn't there.

    >>> missing_session("20300101")
    "no session '20300101'; GET /api/v1/sessions lists them"
    """
    return f"no session {session_id[:60]!r}; GET /api/v1/sessions lists them"


def camera_model(service: Service, model_id: str) -> CameraModelRecord:
    """Return a camera model; 404 where there is none."""
    missing = f"no camera model {model_id!r}; GET /api/v1/camera-models lists them"
    return find_or_404(missing, lambda: camera_models.record(service.store, model_id))


@functools.lru_cache(maxsize=64)
def _read_station(file: Path, there: frozenset[tuple[str, int, int]]) -> Station:
    """Return a station's file, parsed once as long as the files `there` beside it are the same. Raises InputError."""
    return read_station(file)


async def _service(request: Request) -> Service:  # not in a thread: it has nothing to wait for
    service: Service = request.app.state.service
    return service


Here = Annotated[Service, Depends(_service)]


async def _check_room(service: Here) -> None:
    """Raises NoRoom where the disk is full: of a change that is no safety, and no deletion."""
    service.store.room.check()


#: Of routes that keep something new.
ROOM = Depends(_check_room)
READ = Depends(Demand(Permission.READ))
OPERATE = Depends(Demand(Permission.OPERATE))
CALIBRATE = Depends(Demand(Permission.CALIBRATE))
ADMIN = Depends(Demand(Permission.ADMIN))
SESSION_ID, HEX_ID = r"^[0-9A-Za-z-]{1,40}$", r"^[0-9a-f]{16}$"
SessionId = Annotated[str, PathParameter(pattern=SESSION_ID)]
HexId = Annotated[str, PathParameter(pattern=HEX_ID)]
RegistryId = Annotated[int, PathParameter(ge=1, le=2**31 - 1)]
