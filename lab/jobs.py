"""Long work as jobs: fits, validation, diagnosis and reports on Dask, behind a table of our own.

The table is what everyone asks: state, progress, result by id. Dask only carries the work: in this process by default, or
on a cluster whose address the settings give. A task gets references (the store, a session's id or a recording set's folder),
never arrays. Cancelling is cooperative: it sets a mark in the table, and the task ends at its next word of progress.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, TypeVar

import sqlalchemy as sa
from pydantic import BaseModel, ConfigDict

from lab.capture.store import JobRow, JobState, Lock, Store, now
from lab.errors import InputError, NotDetermined
from lab.formats.recording_set import RecordingSet, read
from lab.formats.results import DiagnosisResult, FitResult, ValidationResult
from sim.parameters import Frozen

M = TypeVar("M", bound=BaseModel)
JobKind = Literal["fit", "validate", "diagnose", "report"]
#: Called with what is being done and the share of the work that is done, 0..1.
Progress = Callable[[str, float], None]
#: Words of progress are written to the table so often at most (s).
_WRITE_EVERY_S = 0.2


class JobInfo(Frozen):
    """A job as the table has it."""

    model_config = ConfigDict(frozen=True, extra="ignore", from_attributes=True)

    id: str
    kind: JobKind
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
        """Whether nothing more will come of it."""
        return self.state in ("done", "failed", "cancelled")


class Cancelled(Exception):
    """Raised in a task at its word of progress after someone asked to cancel it."""


def recordings_of(store: Store, source: str) -> RecordingSet:
    """The recordings that a command is given: a stored session's id, or a recording set's folder.

    Raises InputError if it is neither, or can't be used.
    """
    if store.has_session(source):
        return store.recording_set(source)
    if Path(source).exists():
        return read(source)
    raise InputError(f"{source}: neither a recording set's folder nor a session in {store.root}; correct it")


# --- the tasks -----------------------------------------------------------------------------------------------------------


class ReportFile(Frozen):
    """Where a report lies: `path` in the data folder."""

    path: str


class _Task:
    """What the verbs of `lab` are given: the recordings of a source, and what was found of them before."""

    def __init__(self, store: Store, source: str, job_id: str, progress: Progress) -> None:
        self.store, self.source, self.job_id, self.progress = store, source, job_id, progress
        self.recordings = recordings_of(store, source)
        #: A finished session doesn't change any more; a folder may have, so nothing old is taken for it.
        self.is_settled = store.has_session(source) and store.session(source).state == "finished"

    def _latest(self, kind: JobKind, model: type[M], make: Callable[[], M]) -> M:
        """The newest stored result of a kind, else one made now, which is stored as well."""
        if self.is_settled:
            for result in self.store.results(self.source, kind)[:1]:
                return model.model_validate(result.document)
        made = make()
        self.store.add_result(kind, self.source, made.model_dump(mode="json"))
        return made

    def fit(self) -> FitResult:
        from lab.fit import fit_recording_set

        return fit_recording_set(self.recordings, self.progress)

    def validate(self) -> ValidationResult:
        from lab.predict.validate import validate

        return validate(self.recordings, self._latest("fit", FitResult, self.fit))

    def diagnose(self) -> DiagnosisResult:
        from lab.diagnose import examine

        fitted = self._latest("fit", FitResult, self.fit)
        return examine(self.recordings, fitted, self.progress, pictures=True).result

    def report(self) -> ReportFile:
        from lab.report import provenance_of, write_report

        fitted = self._latest("fit", FitResult, self.fit)
        validated = self._latest("validate", ValidationResult, self.validate)
        diagnosed = self._latest("diagnose", DiagnosisResult, self.diagnose)
        runs = self.store.runs(self.source) if self.store.has_session(self.source) else []
        path = f"reports/{self.job_id}.html"
        self.progress("writing the report", 0.95)
        provenance = provenance_of(self.recordings, runs[-1].instruments if runs else None)
        write_report(self.store.root / path, self.recordings, fitted, validated, diagnosed, provenance)
        return ReportFile(path=path)


TASKS: dict[str, Callable[[_Task], BaseModel]] = {
    "fit": _Task.fit,
    "validate": _Task.validate,
    "diagnose": _Task.diagnose,
    "report": _Task.report,
}


class _Reporter:
    """Writes a task's progress to the table, and raises `Cancelled` where someone asked for that."""

    def __init__(self, store: Store, job_id: str) -> None:
        self.store, self.job_id = store, job_id
        self._written_s = 0.0
        self._lock = threading.Lock()

    def __call__(self, message: str, share: float) -> None:
        with self._lock:
            if time.monotonic() - self._written_s < _WRITE_EVERY_S:
                return
            self._written_s = time.monotonic()
        with self.store.transaction() as db:
            row = db.get_one(JobRow, self.job_id)
            if row.cancel_requested:
                raise Cancelled
            row.progress, row.message = min(max(share, 0.0), 1.0), message


def run_job(root: str, database_url: str | None, job_id: str) -> None:
    """Do a job, wherever this runs; everything that comes of it goes to the table. Never raises."""
    store = Store(root, database_url)
    try:
        with store.transaction() as db:
            row = db.get_one(JobRow, job_id)
            if row.state != "queued":
                return
            if row.cancel_requested:
                row.state, row.finished = "cancelled", now()
                return
            row.state, row.started = "running", now()
            kind, source = row.kind, row.source
        try:
            result = TASKS[kind](_Task(store, source, job_id, _Reporter(store, job_id)))
        except Cancelled:
            _over(store, job_id, "cancelled", None)
        except (InputError, NotDetermined) as error:
            _over(store, job_id, "failed", str(error))
        except Exception as error:
            _over(store, job_id, "failed", f"{type(error).__name__}: {error}; this is a defect of calibench, report it")
        else:
            store.add_result(kind, source, result.model_dump(mode="json"), job_id)
            _over(store, job_id, "done", None)
    finally:
        store.close()


def _over(store: Store, job_id: str, state: JobState, error: str | None) -> None:
    with store.transaction() as db:
        row = db.get_one(JobRow, job_id)
        row.state, row.error, row.finished = state, error, now()
        if state == "done":
            row.progress, row.message = 1.0, ""


# --- the runner ----------------------------------------------------------------------------------------------------------


class JobRunner:
    """Takes jobs and has them done. One per process; `close` it (or use it in `with`) so that none is left behind.

    Jobs of a runner whose process ended are marked failed by whichever runner starts next: a runner holds a lock as long
    as it lives.
    """

    def __init__(
        self, store: Store, scheduler: str | None = None, workers: int = 1, connect_timeout_s: float = 10.0
    ) -> None:
        self.connect_timeout_s = connect_timeout_s
        self.store = store
        self.scheduler = scheduler or store.settings.scheduler
        self.workers = workers
        self.id = secrets.token_hex(6)
        self._lock = self._lock_of(self.id)
        self._lock.acquire()
        self._client: Any = None
        self._futures: dict[str, Any] = {}
        self._starting = threading.Lock()
        self.fail_orphans()

    def __enter__(self) -> JobRunner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _lock_of(self, runner: str) -> Lock:
        return Lock(self.store.root / "runners" / f"{runner}.lock")

    def fail_orphans(self) -> int:
        """Mark the unfinished jobs of runners that are gone as failed; how many there were."""
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
        """The Dask client, started at the first job."""
        import dask
        from distributed import Client

        with self._starting:
            if self._client is None:
                try:
                    if self.scheduler is None:
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
                    else:
                        self._client = Client(self.scheduler, timeout=self.connect_timeout_s, set_as_default=False)
                except OSError as error:
                    raise InputError(
                        f"Dask scheduler {self.scheduler}: not reached ({error}); start it or unset CALIBENCH_SCHEDULER"
                    ) from error
            return self._client

    def submit(self, kind: JobKind, source: str) -> str:
        """Queue a job on a session's id or a recording set's folder; its id is returned. Raises InputError for a kind
        that there is no task for."""
        if kind not in TASKS:
            raise InputError(f"job {kind!r}: no such work; choose from {', '.join(TASKS)}")
        client = self._dask()
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
        self._futures[job_id] = client.submit(
            run_job, str(self.store.root), self.store.settings.database_url, job_id, key=f"job-{job_id}", pure=False
        )
        return job_id

    def job(self, job_id: str) -> JobInfo:
        """One job. Raises InputError if there is none of that id."""
        with self.store.reading() as db:
            row = db.get(JobRow, job_id)
            if row is None:
                raise InputError(f"job {job_id!r} isn't in {self.store.root}; list the jobs for their ids")
            return JobInfo.model_validate(row)

    def jobs(self) -> list[JobInfo]:
        """All jobs, the newest first."""
        with self.store.reading() as db:
            rows = db.scalars(sa.select(JobRow).order_by(JobRow.created.desc()))
            return [JobInfo.model_validate(row) for row in rows]

    def cancel(self, job_id: str) -> JobInfo:
        """Ask a job to end: at once if it is queued, else at its next word of progress. A finished job stays as it is."""
        with self.store.transaction() as db:
            row = db.get(JobRow, job_id)
            if row is not None:
                row.cancel_requested = True
                if row.state == "queued":
                    row.state, row.finished = "cancelled", now()
        return self.job(job_id)

    def wait(self, job_id: str, timeout_s: float | None = None) -> JobInfo:
        """Block until a job is over, or for so long at most."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while not (info := self.job(job_id)).is_over:
            if until is not None and time.monotonic() > until:
                break
            time.sleep(0.05)
        return info

    def close(self) -> None:
        """End in good order: jobs that are under way are cancelled and marked so."""
        for info in self.jobs():
            if info.id in self._futures and not info.is_over:
                self.cancel(info.id)
        if self._client is not None:
            with contextlib.suppress(Exception):
                for job_id in self._futures:
                    self.wait(job_id, timeout_s=10.0)
            self._client.close()
            self._client = None
        self._lock.release()
        self._lock.path.unlink(missing_ok=True)
