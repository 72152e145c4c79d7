"""Long work: fit, validate, diagnose and report as jobs; their results and reports."""

from __future__ import annotations

from fastapi import APIRouter, HTTPException, Response
from fastapi.responses import HTMLResponse, JSONResponse
from sse_starlette.sse import EventSourceResponse

from api.errors import Conflict, answers, known
from api.events import described, stream, watched
from api.schemas import Job, JobStart
from api.security import REPORT_POLICY
from api.service import CALIBRATE, READ, Here, HexId, Service, SessionId
from lab.formats.results import DiagnosisResult, FitResult, ValidationResult
from lab.jobs import JobInfo

router = APIRouter()


def _job(service: Service, info: JobInfo) -> Job:
    recordings_id = service.inbox.id_of(info.source)
    return Job(
        **info.model_dump(exclude={"source", "options", "cancel_requested"}),
        session_id=info.source if recordings_id is None else None,
        recordings_id=recordings_id,
    )


def _started(service: Service, start: JobStart, source: str, response: Response) -> Job:
    job = _job(service, service.jobs.job(service.jobs.submit(start.kind, source)))
    response.headers["Location"] = f"/api/v1/jobs/{job.id}"
    return job


@router.post(
    "/sessions/{session_id}/jobs",
    status_code=202,
    tags=["jobs"],
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 404, 422),
)
def start_session_job(service: Here, session_id: SessionId, start: JobStart, response: Response) -> Job:
    """Start work on a session; `Location` says where to look. Validation, diagnosis and report rest on the newest fit, and
    make one where there is none."""
    service.session(session_id)
    return _started(service, start, session_id, response)


@router.post(
    "/recordings/{recordings_id}/jobs",
    status_code=202,
    tags=["jobs"],
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 404, 422),
)
def start_recordings_job(service: Here, recordings_id: HexId, start: JobStart, response: Response) -> Job:
    """Start work on recordings that were sent in; as on a session."""
    return _started(service, start, str(service.recordings(recordings_id)), response)


@router.get("/jobs", tags=["jobs"], dependencies=[READ], responses=answers(401))
def list_jobs(service: Here) -> list[Job]:
    """All jobs, the newest first."""
    return [_job(service, info) for info in service.jobs.jobs()]


@router.get("/jobs/{job_id}", tags=["jobs"], dependencies=[READ], responses=answers(401, 404, 422))
def get_job(service: Here, job_id: HexId) -> Job:
    """One job."""
    return _job(service, service.job(job_id))


@router.post(
    "/jobs/{job_id}/cancel",
    status_code=202,
    tags=["jobs"],
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 404, 422),
)
def cancel_job(service: Here, job_id: HexId) -> Job:
    """Ask a job to end: at once if it is queued, else at its next word of progress. A finished one stays as it is."""
    service.job(job_id)
    return _job(service, service.jobs.cancel(job_id))


@router.get(
    "/jobs/{job_id}/events",
    tags=["jobs"],
    dependencies=[READ],
    response_class=EventSourceResponse,
    responses=answers(401, 404, 422)
    | described(("progress", Job, "at once and at every change"), ("end", Job, "when the job is over")),
)
def job_events(service: Here, job_id: HexId) -> EventSourceResponse:
    """Follow a job."""
    service.job(job_id)
    over = ("done", "failed", "cancelled")

    def look() -> Job:
        return _job(service, service.jobs.job(job_id))

    return stream(lambda stopping: watched(look, lambda job: job.state in over, "progress", stopping))


def _done(service: Service, job_id: str) -> JobInfo:
    info = service.job(job_id)
    if info.state != "done":
        why = f": {info.error}" if info.error else ""
        raise Conflict(f"job {job_id} is {info.state}{why}; it has no result")
    return info


@router.get(
    "/jobs/{job_id}/result",
    tags=["jobs"],
    dependencies=[READ],
    response_model=FitResult | ValidationResult | DiagnosisResult,
    responses=answers(401, 404, 409, 422),
)
def job_result(service: Here, job_id: HexId) -> JSONResponse:
    """What `calibench fit`, `validate` or `diagnose` write with `--json`."""
    if _done(service, job_id).kind == "report":
        raise HTTPException(404, f"job {job_id} made a report; GET /api/v1/jobs/{job_id}/report")
    # As it was stored, byte for byte the schema: no second serialisation that could differ.
    return JSONResponse(service.store.result(job_id).document)


@router.get(
    "/jobs/{job_id}/report",
    tags=["jobs"],
    dependencies=[READ],
    response_class=HTMLResponse,
    responses=answers(401, 404, 409, 422),
)
def job_report(service: Here, job_id: HexId) -> HTMLResponse:
    """The report of a job of the kind `report`: one page that needs no network, and is given none."""
    if _done(service, job_id).kind != "report":
        raise HTTPException(404, f"job {job_id} made no report; GET /api/v1/jobs/{job_id}/result")
    page = known(f"the report of job {job_id} is gone; start it again", lambda: service.report(job_id))
    return HTMLResponse(page, headers={"Content-Security-Policy": REPORT_POLICY})
