"""The camera models that fits and diagnoses found, and two calibrations compared."""

from __future__ import annotations

import contextlib
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import HTMLResponse

from api.archives import Zip, zipped
from api.errors import Conflict, answers, known
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, page_headers
from api.schemas import CameraModels, Comparison
from api.security import REPORT_POLICY
from api.service import READ, Here, HexId, Service
from lab.calibration import camera_models
from lab.calibration.camera_models import CameraModelRecord
from lab.errors import InputError
from lab.fit.changes_that_fail import FailRule, failing
from lab.fit.compare import compare
from lab.formats.recording_set import packed
from lab.formats.results import ComparisonResult, FitResult, ReportFile
from lab.report.compare import render_comparison

router = APIRouter(tags=["calibrations"])


# --- camera models -----------------------------------------------------------------------------------------------------


def _fields(service: Service, record: CameraModelRecord) -> CameraModels:
    recordings_id = service.inbox.id_of(record.source)
    return CameraModels(
        id=record.id,
        kind=record.kind,
        session_id=record.source if recordings_id is None else None,
        recordings_id=recordings_id,
        created=record.created,
        sides=record.sides,
    )


def _record(service: Service, model_id: str) -> CameraModelRecord:
    missing = f"no camera model {model_id!r}; GET /api/v1/camera-models lists them"
    return known(missing, lambda: camera_models.record(service.store, model_id))


@router.get("/camera-models", dependencies=[READ], responses=answers(401, 422) | {200: {"headers": HEADERS}})
def list_camera_models(
    service: Here, request: Request, response: Response, after: IdCursor = None, limit: Limit = PAGE
) -> list[CameraModels]:
    """The camera models of fits (`fitted`) and diagnoses (`improved`: with the effects that were named), the newest first, in pages. `sides` is
    empty for results from before models were kept."""
    found = camera_models.records(service.store, after, limit)
    page_headers(request, response, camera_models.count(service.store), limit, [one.id for one in found])
    return [_fields(service, one) for one in found]


@router.get("/camera-models/{model_id}", dependencies=[READ], responses=answers(401, 404, 422))
def get_camera_model(service: Here, model_id: HexId) -> CameraModels:
    """One camera model: the parameters of each camera with unit and meaning, what is known of their uncertainty, and the effects that act."""
    record = _record(service, model_id)
    return _fields(service, record).model_copy(update={"cameras": camera_models.cameras(service.store, record)})


@router.get(
    "/camera-models/{model_id}/archive.zip",
    dependencies=[READ],
    response_class=Zip,
    responses=answers(401, 404, 409, 422),
)
def camera_model_archive(service: Here, model_id: HexId) -> Response:
    """Its camera files, SIDE.toml with the arrays beside them, as `calibench simulate --camera` and `--model` take them. 409 where none were
    kept."""
    record = _record(service, model_id)
    if not record.sides:
        raise Conflict(f"camera model {model_id}: no camera file was kept; fit again")
    files = list(camera_models.files(service.store, model_id))
    return zipped(packed((file.name, file.read_bytes()) for file in files), f"camera-{model_id}")


# --- comparisons -------------------------------------------------------------------------------------------------------

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
        found = store.result(id)
    except InputError:
        kept = store.results(_source(service, id), "fit")[:1]
        if not kept:
            raise HTTPException(
                404, f"{what}: {id!r} has no fit; GET /api/v1/calibrations lists those of sessions, or start a fit"
            ) from None
        return FitResult.model_validate(kept[0].document)
    if found.kind in ("report", "pipeline"):
        found = store.result(ReportFile.model_validate(found.document).results["fit"])
    if found.kind != "fit":
        raise HTTPException(404, f"{what}: {id!r} is a result of the kind {found.kind}; give one of a fit")
    return FitResult.model_validate(found.document)


def _compared(service: Service, a: str, b: str) -> ComparisonResult:
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
    result = _compared(service, a, b)
    try:
        failed = failing(result, [FailRule.parse(rule) for rule in fail_on])
    except InputError as error:
        said = (
            str(error)
            .replace("--fail-on", "fail_on")
            .replace("`calibench compare A B --all`", "`changes` of the answer without it")
        )
        raise HTTPException(422, said) from None
    return Comparison(comparison=result, failing=tuple(failed))


@router.get("/comparisons/page", dependencies=[READ], response_class=HTMLResponse, responses=answers(401, 404, 422))
def comparison_page(service: Here, a: Source, b: Source) -> HTMLResponse:
    """The comparison with its pictures, one page that needs no network, as `calibench compare --report` writes it."""
    page = render_comparison(_compared(service, a, b))
    return HTMLResponse(service.public.within(page), headers={"Content-Security-Policy": REPORT_POLICY})
