"""A calibration's life: what each is, certifying one, and the history of its figures."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response

from api.errors import Conflict, answers, known
from api.keys import Permission, StoredKey
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, page_headers
from api.schemas import Certify, FigureName
from api.security import Demand
from api.service import READ, Here, HexId, Service
from lab.calibration import life
from lab.calibration.life import CalibrationRecord, History
from lab.calibration.limits import judged, standing_limits
from lab.errors import InputError
from lab.formats.results.figure_names import plain_name, unit_of

router = APIRouter(tags=["calibrations"])


def _known(service: Service, calibration_id: str) -> CalibrationRecord:
    missing = f"no calibration {calibration_id!r}; GET /api/v1/calibrations lists them"
    return known(missing, lambda: life.calibration(service.store, calibration_id))


@router.get("/calibrations", dependencies=[READ], responses=answers(401, 422) | {200: {"headers": HEADERS}})
def list_calibrations(
    service: Here, request: Request, response: Response, after: IdCursor = None, limit: Limit = PAGE
) -> list[CalibrationRecord]:
    """Calibrations, the newest first, in pages. Every fit of a session is one: a candidate, until it is certified."""
    found = life.calibrations(service.store, after, limit)
    page_headers(request, response, life.count_calibrations(service.store), limit, [one.id for one in found])
    return found


@router.get("/calibrations/{calibration_id}", dependencies=[READ], responses=answers(401, 404, 422))
def get_calibration(service: Here, calibration_id: HexId) -> CalibrationRecord:
    """One calibration. `judgements` of a candidate are by the limits of the data folder (`limits.toml`), where it has
    some; those of another are as it was certified."""
    found = _known(service, calibration_id)
    standing = standing_limits(service.store.root) if found.limits is None else None
    if standing is None:
        return found
    by_limit = judged(life.figures(service.store, found.id), standing)
    return found.model_copy(update={"limits": standing, "judgements": by_limit})


@router.post("/calibrations/{calibration_id}/certify", responses=answers(401, 403, 404, 409, 422))
def certify_calibration(
    service: Here,
    calibration_id: HexId,
    asked: Certify,
    key: Annotated[StoredKey, Depends(Demand(Permission.CALIBRATE))],
) -> CalibrationRecord:
    """Certify a candidate against limits, by the holder of the key; what the same cameras had before is superseded.
    422, with a reason for each, where figures are bad or missing, or in the warning band and that isn't accepted; 409
    for what is no candidate."""
    found = _known(service, calibration_id)
    if found.state != "candidate":
        raise Conflict(f"calibration {calibration_id} is {found.state}; only a candidate can be certified")
    limits = asked.limits or standing_limits(service.store.root)
    if limits is None:
        raise HTTPException(422, "limits: the data folder has no limits.toml; put one there, or send the limits")
    return life.certify(service.store, calibration_id, key.name, limits, accept_warnings=asked.accept_warnings)


@router.get("/figures", dependencies=[READ], responses=answers(401))
def list_figures(service: Here) -> list[FigureName]:
    """What there is a history of."""
    return [
        FigureName(camera=camera, figure=figure, place=place, title=plain_name(figure, place), unit=unit_of(figure))
        for camera, figure, place in life.figure_names(service.store)
    ]


@router.get("/history", dependencies=[READ], responses=answers(401, 404, 422))
def figure_history(
    service: Here,
    camera: Annotated[str, Query(max_length=400, description="as `/figures` names it")],
    figure: Annotated[str, Query(max_length=200)],
    place: Annotated[str, Query(max_length=60, description="of a figure of several numbers: which")] = "",
) -> History:
    """A figure of a camera over all its calibrations, oldest first: its band, and whether it drifted from the certified
    one before."""
    limits = standing_limits(service.store.root)
    try:
        return life.history(service.store, camera, figure, place, limits)
    except InputError as error:
        raise HTTPException(404, str(error)) from None
