"""The camera models that fits and diagnoses found or that were sent in, and two calibrations compared."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import HTMLResponse

from api.archives import ARCHIVE, Form, Packed, stream_archive
from api.errors import Conflict, answers
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, page_headers
from api.schemas import CameraModels, Comparison, SentCamera
from api.security import REPORT_POLICY
from api.sending import BODY, as_parameters, receive_archive
from api.service import CALIBRATE, READ, Here, HexId, Service, camera_model
from api.upload import take_cameras
from lab.calibration import camera_models, life
from lab.calibration.camera_models import CameraModelRecord
from lab.errors import InputError
from lab.fit.compare import FailRule, compare, failures
from lab.formats.recording_set import packed
from lab.formats.results import ComparisonResult, FitResult, ReportFile
from lab.report.compare import render_comparison

router = APIRouter(tags=["calibrations"])


def _fields(service: Service, record: CameraModelRecord) -> CameraModels:
    recordings_id = service.inbox.id_of(record.source)
    of_session = recordings_id is None and record.kind != "sent"
    return CameraModels(
        id=record.id,
        kind=record.kind,
        session_id=record.source if of_session else None,
        recordings_id=recordings_id,
        created=record.created,
        sides=record.sides,
    )


def _whole(service: Service, model_id: str) -> CameraModels:
    record = camera_model(service, model_id)
    return _fields(service, record).model_copy(update={"cameras": camera_models.cameras(service.store, record)})


@router.get("/camera-models", dependencies=[READ], responses=answers(401, 422) | {200: {"headers": HEADERS}})
def list_camera_models(
    service: Here, request: Request, response: Response, after: IdCursor = None, limit: Limit = PAGE
) -> list[CameraModels]:
    """The camera models of fits (`fitted`), of diagnoses (`improved`: with the effects that were named), and those that
    were sent in (`sent`), the newest first, in pages. `sides` is empty for results from before models were kept."""
    models = camera_models.records(service.store, after, limit)
    page_headers(request, response, camera_models.count(service.store), limit, [model.id for model in models])
    return [_fields(service, model) for model in models]


@router.post(
    "/camera-models",
    status_code=201,
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 413, 422, 503),
    openapi_extra=BODY,
)
async def send_camera_model(
    service: Here, request: Request, response: Response, asked: Annotated[SentCamera, Query()]
) -> CameraModels:
    """Send in camera files, left.toml or right.toml or both, with the arrays that they name beside them, as a .zip,
    .tar or .tar.gz. Each is read completely before it is kept. A traced lens is sent as its table, for no lens is
    traced here. With `lensfun`, a lens of that file in the archive is put before the cameras, as `calibench import
    --from lensfun` does; `warnings` says what was left out."""
    if asked.lens and not asked.lensfun:
        raise HTTPException(422, "lens: is one of a lensfun file; name that as lensfun, or leave lens out")
    limit = service.limits.model_bytes
    async with receive_archive(service, request, limit) as came:
        try:
            content, remarks = await asyncio.to_thread(
                take_cameras, came.place, came.archive, limit, asked.lensfun, asked.lens
            )
        except InputError as error:
            raise InputError(as_parameters(str(error))) from None
        warnings = tuple(came.name_as_sent(remark) for remark in remarks)
        id = await asyncio.to_thread(camera_models.bring_in, service.store, content)
    response.headers["Location"] = f"/api/v1/camera-models/{id}"
    return (await asyncio.to_thread(_whole, service, id)).model_copy(update={"warnings": warnings})


@router.get("/camera-models/{model_id}", dependencies=[READ], responses=answers(401, 404, 422))
def get_camera_model(service: Here, model_id: HexId) -> CameraModels:
    """One camera model: the parameters of each camera with unit and meaning, what is known of their uncertainty, and
    the effects that act."""
    return _whole(service, model_id)


@router.delete(
    "/camera-models/{model_id}", status_code=204, dependencies=[CALIBRATE], responses=answers(401, 403, 404, 409, 422)
)
def delete_camera_model(service: Here, model_id: HexId) -> None:
    """Delete a camera model that was sent in, for ever. 409 for one that a fit or a diagnosis found: it is part of that
    result."""
    camera_model(service, model_id)
    try:
        camera_models.remove(service.store, model_id)
    except InputError as error:
        raise Conflict(str(error)) from None


@router.get(
    "/camera-models/{model_id}/archive.{form}",
    dependencies=[READ],
    response_class=Packed,
    responses=answers(401, 404, 409, 422) | ARCHIVE,
)
def camera_model_archive(service: Here, model_id: HexId, form: Form) -> Response:
    """Its camera files, SIDE.toml with the arrays beside them, as `calibench simulate --camera` and `--model` take
    them. 409 where none were kept."""
    record = camera_model(service, model_id)
    if not record.sides:
        raise Conflict(f"camera model {model_id}: no camera file was kept; fit again")
    files = list(camera_models.files(service.store, model_id))
    return stream_archive(packed(((file.name, file.read_bytes()) for file in files), form), f"camera-{model_id}", form)


Source = Annotated[
    str,
    Query(
        pattern=r"^[0-9A-Za-z-]{1,40}$",
        description="id of a calibration, of a job that fitted, or of a session or recordings: their newest fit",
    ),
]


def _source(service: Service, id: str) -> str:
    """What results of a session, or of recordings that were sent in, are kept under."""
    with contextlib.suppress(InputError):
        return str(service.inbox.folder(id))
    return id


def _fit(service: Service, what: str, id: str) -> FitResult:
    """The fit that an id stands for; 404 where there is none."""
    store = service.store
    try:
        result = store.result(id)
    except InputError:
        kept = store.results(_source(service, id), "fit")[:1]
        if not kept:
            raise HTTPException(
                404, f"{what}: {id!r} has no fit; GET /api/v1/calibrations lists those of sessions, or start a fit"
            ) from None
        return FitResult.model_validate(kept[0].document)
    if result.kind in ("report", "pipeline"):
        result = store.result(ReportFile.model_validate(result.document).results["fit"])
    if result.kind != "fit":
        raise HTTPException(404, f"{what}: {id!r} is a result of the kind {result.kind}; give one of a fit")
    return FitResult.model_validate(result.document)


def _name_of(service: Service, id: str) -> str:
    """What the source of a fit is called, where it has a name, with its time and id."""
    with contextlib.suppress(InputError):
        calibration = life.calibration(service.store, id)
        return f"{calibration.name}, fitted {calibration.created:%Y-%m-%d %H:%M} UTC ({id})"
    with contextlib.suppress(InputError):
        session = service.store.session(id)
        return f"{session.name or id}, the newest fit ({id})"
    return id


def _compare(service: Service, a: str, b: str) -> ComparisonResult:
    return compare(_fit(service, "a", a), _fit(service, "b", b)).model_copy(update={"a": a, "b": b})


@router.get("/comparisons", dependencies=[READ], responses=answers(401, 404, 422))
def compare_calibrations(
    service: Here,
    a: Source,
    b: Source,
    fail_on: Annotated[
        list[Annotated[str, Query(max_length=200)]],
        Query(
            max_length=100,
            description="[SIDE:]FIGURE[>AMOUNT[%]]: such a change, beyond its uncertainty, stands in `failing`",
        ),
    ] = [],  # noqa: B006  (FastAPI copies it)
) -> Comparison:
    """Two calibrations: what changed beyond its uncertainty, as `calibench compare A B` tells it."""
    result = _compare(service, a, b)
    try:
        failed = failures(result, [FailRule.parse(rule) for rule in fail_on])
    except InputError as error:
        problem = (
            str(error)
            .replace("--fail-on", "fail_on")
            .replace("`calibench compare A B --all`", "`changes` of the answer without it")
        )
        raise HTTPException(422, problem) from None
    return Comparison(comparison=result, failing=tuple(failed))


@router.get("/comparisons/page", dependencies=[READ], response_class=HTMLResponse, responses=answers(401, 404, 422))
def comparison_page(service: Here, a: Source, b: Source) -> HTMLResponse:
    """The comparison with its pictures, one page that needs no network, as `calibench compare --report` writes it."""
    names = {"a": _name_of(service, a), "b": _name_of(service, b)}
    page = render_comparison(_compare(service, a, b).model_copy(update=names))
    return HTMLResponse(service.public.within(page), headers={"Content-Security-Policy": REPORT_POLICY})
