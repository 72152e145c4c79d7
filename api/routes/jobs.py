"""Long work as jobs: fit, validate, diagnose, report, and the whole pipeline; their results and reports."""

from __future__ import annotations

import json
from typing import Annotated, cast

from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import HTMLResponse
from sse_starlette.sse import EventSourceResponse

from api.errors import Conflict, answers, find_or_404
from api.events import describe_events, stream, watch_state
from api.keys import Permission
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, page_headers
from api.schemas import Job, JobStart, PipelineResults, PipelineStart, WorkStep
from api.security import REPORT_POLICY, Demand
from api.service import ADMIN, CALIBRATE, HEX_ID, READ, SESSION_ID, Here, HexId, Service, SessionId, camera_model
from lab.formats.results import DiagnosisResult, FitResult, ReportFile, ValidationResult
from lab.jobs import JobInfo, was_removed
from lab.pipeline import STEPS, Goal, source_recordings
from lab.resolve import resolve_limits, station_of

router = APIRouter()


def steps_of(info: JobInfo, *, captures: bool) -> tuple[WorkStep, ...]:
    """The steps of a job; its newest message begins with the one under way. `captures`: whether a pipeline captures."""
    names = tuple(name for name in STEPS.get(cast(Goal, info.kind), ()) if captures or name != "capture")
    now = info.message.partition(":")[0]
    # `resolve` is a step of those pipelines that were asked for it, which the job's row doesn't have.
    names = tuple(name for name in names if name != "resolve" or name == now)
    state = "waiting" if info.state == "queued" else info.state
    at = len(names) if state == "done" else names.index(now) if now in names else 0
    return tuple(
        WorkStep(name=name, state="done" if n < at else state if n == at else "waiting") for n, name in enumerate(names)
    )


def _job(service: Service, info: JobInfo) -> Job:
    recordings_id = service.inbox.id_of(info.source)
    return Job(
        **info.model_dump(exclude={"source", "message", "error", "cancel_requested"}),
        steps=steps_of(info, captures=recordings_id is None),
        message=service.public(info.message),
        error=service.public.or_none(info.error),
        session_id=info.source if recordings_id is None and not was_removed(info.kind) else None,
        recordings_id=recordings_id,
    )


def answer_with_job(service: Service, job_id: str, response: Response) -> Job:
    """A job that was started just now, and where to look for it."""
    response.headers["Location"] = f"/api/v1/jobs/{job_id}"
    return _job(service, service.jobs.job(job_id))


def _submit(service: Service, start: JobStart, source: str) -> str:
    """Queue a job that needs no instrument; its id. 404 for a camera model that isn't there, 409 for one without
    files."""
    if start.camera_model is not None and not camera_model(service, start.camera_model).sides:
        raise Conflict(f"camera model {start.camera_model}: no camera file was kept; fit again")
    limits = resolve_limits(start.resolve, start.resolve_minutes, start.resolve_rounds)
    return service.jobs.submit(start.kind, source, resolve=limits, camera_model=start.camera_model, engine=start.engine)


@router.post(
    "/sessions/{session_id}/jobs",
    status_code=202,
    tags=["jobs"],
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 404, 409, 422),
)
def start_session_job(
    service: Here, request: Request, session_id: SessionId, start: JobStart, response: Response
) -> Job:
    """Start work on a session; `Location` says where to look. `validate`, `diagnose` and `report` rest on the newest
    results of a finished session, and make those that are missing; 409 while the session isn't finished. `pipeline`
    captures what is left of the session, then makes all of them anew; where it captures or resolves, the key's scope
    has to be `admin`."""
    info = service.session(session_id)
    if start.kind != "pipeline":
        if start.station is not None:
            raise HTTPException(422, f"station: a job of the kind {start.kind} doesn't capture; leave it out")
        if info.state != "finished":  # its frames would be packed away under the job
            raise Conflict(
                f"session {session_id} is {service.state(info)}, not finished; wait for its end "
                "or resume it, then start the job; a pipeline does both"
            )
        return answer_with_job(service, _submit(service, start, session_id), response)
    if start.camera_model is not None:
        raise HTTPException(422, "camera_model: a pipeline fits its own; leave it out, or validate or diagnose with it")
    if start.resolve or info.state != "finished":
        Demand(Permission.ADMIN)(request, None, None)
    limits = resolve_limits(start.resolve, start.resolve_minutes, start.resolve_rounds)
    station = service.station(start.station) if start.station is not None else service.store.station(session_id)
    job_id = service.jobs.submit(
        "pipeline", session_id, resolve=limits, capturer=service.live.capturer(station), engine=start.engine
    )
    return answer_with_job(service, job_id, response)


@router.post(
    "/pipelines",
    status_code=202,
    tags=["jobs"],
    dependencies=[ADMIN],
    responses=answers(401, 403, 404, 409, 422),
)
def start_pipeline(service: Here, start: PipelineStart, response: Response) -> Job:
    """Start a session and the whole pipeline on it: capture, fit, validate, diagnose, resolve, report. The job's
    `session_id` is the session, which can be followed, paused and aborted as any other. 409 while another runs on the
    same instruments. The key's scope has to be `admin`, for this captures and computes."""
    limits = resolve_limits(start.resolve, start.resolve_minutes, start.resolve_rounds)
    station = service.station(start.station)
    plan = start.plan(station)
    session_id = service.live.start(station, plan, start.name, start.notes, start.demands_certified)
    job_id = service.jobs.submit(
        "pipeline", session_id, resolve=limits, capturer=service.live.capturer(station), engine=start.engine
    )
    return answer_with_job(service, job_id, response)


@router.post(
    "/recordings/{recordings_id}/jobs",
    status_code=202,
    tags=["jobs"],
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 404, 409, 422),
)
def start_recordings_job(
    service: Here, request: Request, recordings_id: HexId, start: JobStart, response: Response
) -> Job:
    """Start work on recordings that were sent in. A `pipeline` with `resolve` and `station` settles what they leave in
    doubt by captures of the station that made them: its cameras are asked for their serial numbers first, and the
    key's scope has to be `admin`. 409 while a session runs on it."""
    folder = str(service.recordings(recordings_id))
    if start.station is None and not start.resolve:
        return answer_with_job(service, _submit(service, start, folder), response)
    if start.station is None or not start.resolve or start.kind != "pipeline":
        raise HTTPException(
            422,
            "resolve, station: recordings are settled by a pipeline on the station that made them; give both, or none",
        )
    Demand(Permission.ADMIN)(request, None, None)
    limits = resolve_limits(start.resolve, start.resolve_minutes, start.resolve_rounds)
    station = service.station(start.station)
    let_go = service.live.hold(station)
    try:
        station_of_set = station_of(source_recordings(folder, lambda: None), station, service.live.connect)
    finally:
        let_go()
    capturer = service.live.capturer(station_of_set)
    job_id = service.jobs.submit(
        "pipeline", folder, resolve=limits, capturer=capturer, station=station_of_set, engine=start.engine
    )
    return answer_with_job(service, job_id, response)


@router.get(
    "/jobs",
    tags=["jobs"],
    dependencies=[READ],
    responses=answers(401, 404, 422) | {200: {"headers": HEADERS}},
)
def list_jobs(
    service: Here,
    request: Request,
    response: Response,
    after: IdCursor = None,
    limit: Limit = PAGE,
    session_id: Annotated[str | None, Query(pattern=SESSION_ID, description="only those on this session")] = None,
    recordings_id: Annotated[str | None, Query(pattern=HEX_ID, description="only those on these recordings")] = None,
) -> list[Job]:
    """Jobs, the newest first, in pages: all, or those of one session or recording set."""
    if session_id is not None and recordings_id is not None:
        raise HTTPException(422, "session_id, recordings_id: a job has one source; leave one out")
    source = session_id if recordings_id is None else str(service.recordings(recordings_id))
    jobs = service.jobs.jobs(after, limit, source)
    page_headers(request, response, service.jobs.count_jobs(source), limit, [info.id for info in jobs])
    return [_job(service, info) for info in jobs]


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
    """Ask a job to end: at once if it is queued, else at its next progress; a session that it captures is aborted and
    can be resumed. A finished job stays as it is."""
    service.job(job_id)
    return _job(service, service.jobs.cancel(job_id))


@router.get(
    "/jobs/{job_id}/events",
    tags=["jobs"],
    dependencies=[READ],
    response_class=EventSourceResponse,
    responses=answers(401, 404, 422)
    | describe_events(("progress", Job, "at once and at every change"), ("end", Job, "when the job is over")),
)
def job_events(service: Here, job_id: HexId) -> EventSourceResponse:
    """Follow a job."""
    service.job(job_id)
    over = ("done", "failed", "cancelled")

    def look() -> Job:
        return _job(service, service.jobs.job(job_id))

    return stream(
        lambda stopping: watch_state(look, lambda job: job.state in over, "progress", stopping, service.changed)
    )


def _done(service: Service, job_id: str) -> JobInfo:
    info = service.job(job_id)
    if info.state != "done":
        why = f": {info.error}" if info.error else ""
        raise Conflict(f"job {job_id} is {info.state}{why}; it has no result")
    return info


REPORTS = ("report", "pipeline")


@router.get(
    "/jobs/{job_id}/result",
    tags=["jobs"],
    dependencies=[READ],
    response_model=FitResult | ValidationResult | DiagnosisResult | PipelineResults,
    responses=answers(401, 404, 409, 422),
)
def job_result(service: Here, job_id: HexId) -> Response:
    """What `calibench fit`, `validate` or `diagnose` write with `--json`; of a pipeline, all three."""
    kind = _done(service, job_id).kind
    if kind == "report":
        raise HTTPException(404, f"job {job_id} made a report; GET /api/v1/jobs/{job_id}/report")
    if was_removed(kind):
        raise HTTPException(404, f"job {job_id}: its kind, {kind}, was removed; its result isn't in the registry")
    # As it was stored: no second serialisation that could differ.
    document = service.store.result(job_id).document
    if kind == "pipeline":
        kept = ReportFile.model_validate(document).results
        parts = {"fit": "fit", "validation": "validate", "diagnosis": "diagnose"}
        document = {part: service.store.result(kept[goal]).document for part, goal in parts.items()}
    return Response(service.public.within(json.dumps(document)), media_type="application/json")


@router.get(
    "/jobs/{job_id}/report",
    tags=["jobs"],
    dependencies=[READ],
    response_class=HTMLResponse,
    responses=answers(401, 404, 409, 422),
)
def job_report(service: Here, job_id: HexId) -> HTMLResponse:
    """The report of a job of the kind `report` or `pipeline`: one page that needs no network, and is given none."""
    if _done(service, job_id).kind not in REPORTS:
        raise HTTPException(404, f"job {job_id} made no report; GET /api/v1/jobs/{job_id}/result")
    page = find_or_404(f"the report of job {job_id} is gone; start it again", lambda: service.report(job_id))
    return HTMLResponse(service.public.within(page), headers={"Content-Security-Policy": REPORT_POLICY})
