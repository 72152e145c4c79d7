"""Long work as jobs: every goal of `lab.pipeline`, in the background, with a row each in a table of the registry.

The table holds state, progress and error; results are kept under the job's id. A job that needs no instrument runs on
Dask: in this process by default, or on a cluster whose address the settings give. A job that captures runs in a thread
of this process, because the instruments are connected to this computer. A job is given references (the store's address,
a session's id or a recording set's folder), never arrays. `cancel` sets a mark in the table; the job ends at its next
progress."""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from dataclasses import replace
from datetime import datetime
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, Literal, cast, get_args
from urllib.parse import urlsplit

import sqlalchemy as sa
from pydantic import ConfigDict

from lab.capture.file_lock import Lock
from lab.capture.records import JobState, now
from lab.capture.store import Store
from lab.capture.tables import JobRow
from lab.engine import DEFAULT_ENGINE, Engine
from lab.errors import Cancelled, CannotWrite, DeviceError, InputError, NoRoom, NotDetermined, failure_of_environment
from lab.pipeline import (
    STEPS,
    Capturer,
    CaptureRequest,
    Goal,
    PipelineProgress,
    PipelineRequest,
    run_pipeline,
    source_recordings,
)
from lab.workers import dask_client
from sim.parameters import Frozen

if TYPE_CHECKING:
    from lab.capture.station import Station
    from lab.formats.camera_file import CameraFile
    from lab.resolve import ResolveLimits
    from sim.camera import Side

#: Kinds of earlier versions, of which registries may hold jobs.
RemovedKind = Literal["make-challenge", "score-challenge"]

#: The least time (s) between two rows of progress.
_WRITE_EVERY_S = 0.2


class JobInfo(Frozen):
    """A job as the table has it."""

    model_config = ConfigDict(frozen=True, extra="ignore", from_attributes=True)

    id: str
    kind: Goal | RemovedKind
    source: str
    state: JobState
    progress: float
    message: str
    error: str | None
    cancel_requested: bool
    created: datetime
    started: datetime | None
    finished: datetime | None

    @property
    def is_over(self) -> bool:
        """Whether the job has ended."""
        return self.state in ("done", "failed", "cancelled")


def was_removed(kind: Goal | RemovedKind) -> bool:
    """Return whether a job's kind is of an earlier version."""
    return kind in get_args(RemovedKind)


class _Reporter:
    """Writes a job's progress to the table, and raises `Cancelled` where someone asked for that."""

    def __init__(self, store: Store, job_id: str) -> None:
        self.store, self.job_id = store, job_id
        self._written_s = 0.0
        self._lock = threading.Lock()

    def pipeline(self, progress: PipelineProgress) -> None:
        """Progress of a pipeline."""
        words = ": ".join(part for part in (progress.step, progress.remark or progress.what) if part)
        self(words, progress.share)

    def __call__(self, message: str, share: float) -> None:
        with self._lock:
            if time.monotonic() - self._written_s < _WRITE_EVERY_S:
                return
            self._written_s = time.monotonic()
        with self.store.transaction() as db:
            row = db.get_one(JobRow, self.job_id, with_for_update=True)
            if row.cancel_requested:
                raise Cancelled
            row.progress = min(max(share, 0.0), 1.0)
            row.message = message


def run_job(
    root: str,
    database_url: str | None,
    job_id: str,
    resolve: ResolveLimits | None = None,
    capturer: Capturer | None = None,
    camera_model: str | None = None,
    station: Station | None = None,
    engine: Engine = DEFAULT_ENGINE,
) -> None:
    """Carry out a job, in this process or on a worker; its result goes to the registry. Never raises."""
    store = Store(root, database_url)
    try:
        with store.transaction() as db:
            row = db.get_one(JobRow, job_id, with_for_update=True)
            if row.state != "queued":
                return
            if row.cancel_requested:
                row.state, row.finished = "cancelled", now()
                return
            row.state, row.started = "running", now()
            kind, source = cast(Goal, row.kind), row.source
        tell = _Reporter(store, job_id)
        try:
            request = replace(_request(store, kind, source, job_id, resolve, station), engine=engine)
            if camera_model is not None:
                request = replace(request, models=_models(store, request, camera_model))
            run_pipeline(request, tell.pipeline, store=store, capturer=capturer)
        except Cancelled:
            _over(store, job_id, "cancelled", None)
        except (InputError, DeviceError, NotDetermined) as error:
            _over(store, job_id, "failed", str(error))
        except Exception as error:
            if (failure := failure_of_environment(error)) is not None:
                _over(store, job_id, "failed", f"{failure}; then start the job again")
                return
            _over(store, job_id, "failed", f"{type(error).__name__}: {error}; this is a defect of calibench, report it")
        else:
            _over(store, job_id, "done", None)
    finally:
        store.close()


def _request(
    store: Store, kind: Goal, source: str, job_id: str, resolve: ResolveLimits | None, station: Station | None
) -> PipelineRequest:
    """Return what a job asks of the pipeline. A pipeline on a session captures what is left of it, and computes every
    step anew."""
    page = store.root / "reports" / f"{job_id}.html"
    if kind in ("capture", "pipeline") and store.has_session(source):
        capture = CaptureRequest(session=source)
        return PipelineRequest(kind, capture=capture, source=source, job_id=job_id, resolve=resolve)
    return PipelineRequest(
        kind,
        recordings=source_recordings(source, lambda: store),
        source=source,
        job_id=job_id,
        reuse=kind != "pipeline",
        report_file=page,
        resolve=None if station is None else resolve,
        station=station,
    )


def _models(store: Store, request: PipelineRequest, camera_model: str) -> dict[Side, CameraFile]:
    """Return the cameras that stand in for the fitted ones. Raises InputError where the model lacks one."""
    from lab.calibration import camera_models

    assert request.recordings is not None
    found = camera_models.camera_files(store, camera_models.record(store, camera_model))
    if missing := [side for side in request.recordings.sides if side not in found]:
        raise InputError(f"camera model {camera_model}: has no {' and no '.join(missing)} camera; name one that has")
    return {side: found[side] for side in request.recordings.sides}


def _over(store: Store, job_id: str, state: JobState, error: str | None) -> None:
    """Record how a job ended. On a full disk the reserve makes way for it; where even that isn't enough, the job stays
    as it was until the next runner starts."""
    try:
        _record_end(store, job_id, state, error)
    except CannotWrite:
        store.room.give_up()
        with contextlib.suppress(CannotWrite):
            _record_end(store, job_id, state, error)


def _record_end(store: Store, job_id: str, state: JobState, error: str | None) -> None:
    with store.transaction() as db:
        row = db.get_one(JobRow, job_id, with_for_update=True)
        row.state, row.error, row.finished = state, error, now()
        if state == "done":
            row.progress, row.message = 1.0, ""


def check_scheduler(address: str) -> None:
    """Raises InputError for a scheduler that others could pose as: whoever is the scheduler runs code in this process.
    It is on this computer, or speaks TLS with the certificates of Dask's own settings (`distributed.comm.tls`)."""
    scheme, _, place = address.rpartition("://")
    host = urlsplit(f"//{place}").hostname or ""
    with contextlib.suppress(ValueError):
        if ip_address(host).is_loopback:
            return
    if scheme not in ("tls", "inproc") and host != "localhost":
        raise InputError(
            f"Dask scheduler {address}: isn't on this computer and doesn't speak TLS; give tls://HOST:PORT, with the "
            "certificates in "
            "Dask's settings (distributed.comm.tls)"
        )


class JobRunner:
    """Queues jobs and has them carried out. One per process; `close` it, or use it in `with`, so that no job is left
    running.

    A runner holds a lock as long as it lives. Jobs of a runner whose process ended are marked as failed by the next
    runner that starts."""

    def __init__(
        self, store: Store, scheduler: str | None = None, workers: int = 1, connect_timeout_s: float = 10.0
    ) -> None:
        self.connect_timeout_s = connect_timeout_s
        self.store = store
        self.scheduler = scheduler or store.settings.scheduler
        if self.scheduler is not None:
            check_scheduler(self.scheduler)
        self.workers = workers
        self.id = secrets.token_hex(6)
        self._lock = self._lock_of(self.id)
        self._lock.acquire()
        self._client: Any = None
        self._started: dict[str, Any] = {}  # Dask forgets a task whose future nobody holds
        self._starting = threading.Lock()
        with contextlib.suppress(NoRoom):  # then the next runner does it
            self.fail_orphans()

    def __enter__(self) -> JobRunner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _lock_of(self, runner: str) -> Lock:
        return Lock(self.store.root / "runners" / f"{runner}.lock")

    def fail_orphans(self) -> int:
        """Mark the unfinished jobs of runners whose process ended as failed; returns how many there were."""
        with self.store.transaction() as db:
            rows = db.scalars(sa.select(JobRow).where(JobRow.state.in_(("queued", "running")))).all()
            gone = {runner for runner in {row.runner for row in rows} if not self._lock_of(runner).is_held()}
            orphans = [row for row in rows if row.runner in gone and row.runner != self.id]
            for row in orphans:
                row.state, row.finished = "failed", now()
                row.error = "the process that did this job ended before it was done; start the job again"
        for runner in gone - {self.id}:
            self._lock_of(runner).path.unlink(missing_ok=True)
        return len(orphans)

    def _dask(self) -> Any:
        """Return the Dask client, started at the first job."""
        import dask
        from distributed import Client

        with self._starting:
            if self._client is None:
                if self.scheduler is not None:
                    self._client = dask_client(self.scheduler, self.connect_timeout_s)
                    return self._client
                # Dask opens its HTTP servers to the whole network, even with no dashboard asked for, the
                # scheduler's at one fixed port: here they are on loopback, at any port, and answer nothing.
                quiet: dict[str, list[str]] = {
                    f"distributed.{part}.http.routes": [] for part in ("scheduler", "worker")
                }
                with dask.config.set(quiet):
                    self._client = Client(
                        processes=False,
                        n_workers=1,
                        threads_per_worker=self.workers,
                        dashboard_address="127.0.0.1:0",
                        worker_dashboard_address="127.0.0.1:0",
                        set_as_default=False,
                    )
            return self._client

    def submit(
        self,
        kind: Goal,
        source: str,
        *,
        resolve: ResolveLimits | None = None,
        capturer: Capturer | None = None,
        camera_model: str | None = None,
        station: Station | None = None,
        engine: Engine = DEFAULT_ENGINE,
    ) -> str:
        """Queue a job on a session's id or a recording set's folder; returns the job's id.

        `capturer`: how the job reaches the instruments; with one, the job runs in a thread of this process. `resolve`:
        of a pipeline, take the captures that tell the remaining rivals apart, within these limits. `station`: the one
        that made the recordings, for `resolve` on a set's folder (`lab.resolve.station_of`). `camera_model`: id of one
        that stands in for the fitted cameras of a validation or a diagnosis. `engine`: which one diagnoses.
        Raises InputError for an unknown kind, and for `resolve`, `camera_model` or `engine` where the job
        can't take it; NoRoom where the disk is full.
        """
        if kind not in STEPS:
            raise InputError(f"job {kind!r}: no such work; choose from {', '.join(STEPS)}")
        if resolve is not None and (kind != "pipeline" or capturer is None):
            raise InputError(f"job {kind}: only a pipeline on a session's station can resolve; leave resolve out")
        if camera_model is not None and kind not in ("validate", "diagnose"):
            raise InputError(
                f"camera_model: a job of the kind {kind} takes none; leave it out, or validate or diagnose with it"
            )
        if engine != DEFAULT_ENGINE and "diagnose" not in STEPS[kind]:
            raise InputError(f"engine: a job of the kind {kind} makes no diagnosis; leave it out, or diagnose")
        self.store.room.check()
        client = self._dask() if capturer is None else None
        job_id = secrets.token_hex(8)
        with self.store.transaction() as db:
            db.add(
                JobRow(
                    id=job_id,
                    kind=kind,
                    source=source,
                    state="queued",
                    runner=self.id,
                    created=now(),
                )
            )
        work = (str(self.store.root), self.store.settings.database_url, job_id)
        if client is None:
            thread = threading.Thread(
                target=run_job,
                args=(*work, resolve, capturer, None, station, engine),
                name=f"job {job_id}",
                daemon=True,
            )
            self._started[job_id] = thread
            thread.start()
        else:
            future = client.submit(
                run_job, *work, camera_model=camera_model, engine=engine, key=f"job-{job_id}", pure=False
            )
            self._started[job_id] = future
            future.add_done_callback(lambda _: self._left(job_id))
        return job_id

    def _left(self, job_id: str) -> None:
        """Fail a job that no worker holds any more and that isn't over: its worker died (kill -9, out of memory). Dask
        may give it to another worker, which refuses a job that had begun."""
        with contextlib.suppress(InputError, sa.exc.SQLAlchemyError):
            if not self.job(job_id).is_over:
                why = (
                    "the worker that did this job ended before it was done (kill -9, or memory was short); start the "
                    "job again"
                )
                _over(self.store, job_id, "failed", why)

    def job(self, job_id: str) -> JobInfo:
        """One job. Raises InputError if there is none of that id."""
        with self.store.reading() as db:
            row = db.get(JobRow, job_id)
            if row is None:
                raise InputError(f"job {job_id!r} isn't in {self.store.root}; list the jobs for their ids")
            return JobInfo.model_validate(row)

    def jobs(self, after: str | None = None, limit: int | None = None, source: str | None = None) -> list[JobInfo]:
        """Jobs, the newest first: `limit` at most, those that follow the job `after` in this order. `source`: only
        those on it."""
        asked = sa.select(JobRow).order_by(JobRow.created.desc(), JobRow.id.desc()).limit(limit)
        if source is not None:
            asked = asked.where(JobRow.source == source)
        with self.store.reading() as db:
            if after is not None:
                last = db.get(JobRow, after)
                if last is None:
                    raise InputError(f"job {after!r} isn't in {self.store.root}; list the jobs for their ids")
                asked = asked.where(sa.tuple_(JobRow.created, JobRow.id) < sa.tuple_(last.created, last.id))
            return [JobInfo.model_validate(row) for row in db.scalars(asked)]

    def under_way(self, source: str) -> list[JobInfo]:
        """Jobs on a source that aren't over."""
        asked = sa.select(JobRow).where(JobRow.source == source, JobRow.state.in_(("queued", "running")))
        with self.store.reading() as db:
            return [JobInfo.model_validate(row) for row in db.scalars(asked)]

    def count_jobs(self, source: str | None = None) -> int:
        """Return how many jobs there are, or on one source."""
        asked = sa.select(sa.func.count()).select_from(JobRow)
        with self.store.reading() as db:
            return db.scalars(asked if source is None else asked.where(JobRow.source == source)).one()

    def count_states(self) -> dict[str, int]:
        """State -> how many jobs are in it."""
        with self.store.reading() as db:
            counted = db.execute(sa.select(JobRow.state, sa.func.count()).group_by(JobRow.state))
            return {state: number for state, number in counted}  # noqa: C416  (rows, not pairs, to a type checker)

    def cancel(self, job_id: str) -> JobInfo:
        """Ask a job to end: at once if it is queued, else at its next progress. A finished job stays as it is."""
        with self.store.transaction() as db:
            row = db.get(JobRow, job_id, with_for_update=True)
            if row is not None:
                row.cancel_requested = True
                if row.state == "queued":
                    row.state, row.finished = "cancelled", now()
        return self.job(job_id)

    def wait(self, job_id: str, timeout_s: float | None = None) -> JobInfo:
        """Observable until a job is over, or for so long at most."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while not (info := self.job(job_id)).is_over:
            if until is not None and time.monotonic() > until:
                break
            time.sleep(0.05)
        return info

    def close(self) -> None:
        """Cancel the jobs that are under way, wait for their end, and let go of Dask."""
        for info in self.jobs():
            if info.id in self._started and not info.is_over:
                self.cancel(info.id)
        with contextlib.suppress(InputError, sa.exc.SQLAlchemyError):
            for job_id in self._started:
                self.wait(job_id, timeout_s=10.0)
        if self._client is not None:
            with contextlib.suppress(Exception):
                self._client.close()
            self._client = None
        self._lock.release()
        self._lock.path.unlink(missing_ok=True)
