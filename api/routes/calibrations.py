"""A calibration's life: what each is, certifying one, and the history of its figures."""

from __future__ import annotations

import functools
from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi.responses import HTMLResponse

from api.errors import Conflict, answers, find_or_404
from api.keys import Permission, StoredKey
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, page_headers
from api.schemas import CalibrationDetail, Certify, DraftedLimit, DraftedLimits, FigureName, FigureOfFit, Revoke
from api.security import REPORT_POLICY, Demand
from api.service import READ, Here, HexId, Service, SessionId
from lab.calibration import camera_models, life
from lab.calibration.life import CalibrationRecord, DriftBoard, History
from lab.calibration.limits import Figure, figures_of, judge_figures, standing_limits
from lab.capture.store import Store
from lab.errors import InputError
from lab.formats.results import FitResult
from lab.formats.results.words import plain_name, unit_of
from lab.report.certificate import Certificate, certificate, certificate_page, rejections

router = APIRouter(tags=["calibrations"])


def _find_calibration(service: Service, calibration_id: str) -> CalibrationRecord:
    missing = f"no calibration {calibration_id!r}; GET /api/v1/calibrations lists them"
    return find_or_404(missing, lambda: life.calibration(service.store, calibration_id))


@router.get("/calibrations", dependencies=[READ], responses=answers(401, 422) | {200: {"headers": HEADERS}})
def list_calibrations(
    service: Here, request: Request, response: Response, after: IdCursor = None, limit: Limit = PAGE
) -> list[CalibrationRecord]:
    """Calibrations, the newest first, in pages. Every fit of a session is one: a candidate, until it is certified."""
    listed = life.calibrations(service.store, after, limit)
    page_headers(
        request, response, life.count_calibrations(service.store), limit, [calibration.id for calibration in listed]
    )
    return listed


@router.get("/calibrations/{calibration_id}", dependencies=[READ], responses=answers(401, 404, 422))
def get_calibration(service: Here, calibration_id: HexId) -> CalibrationDetail:
    """One calibration. `judgements` of a candidate are by the limits of the data folder (`limits.toml`), where it has
    some; those of another are as it was certified. `warnings`: what its session's newest diagnosis says against it."""
    judged = judge_calibration(service, calibration_id)
    return CalibrationDetail(
        **dict(judged), warnings=rejections(service.store, judged), has_cameras=_has_cameras(service, judged.id)
    )


def judge_calibration(service: Service, calibration_id: str) -> CalibrationRecord:
    """A calibration; a candidate by the limits of the data folder. 404 where there is none."""
    calibration = _find_calibration(service, calibration_id)
    standing = standing_limits(service.store.root) if calibration.limits is None else None
    if standing is None:
        return calibration
    by_limit = judge_figures(life.figures(service.store, calibration.id), standing)
    return calibration.model_copy(update={"limits": standing, "judgements": by_limit})


def _has_cameras(service: Service, calibration_id: str) -> bool:
    try:
        return bool(camera_models.record(service.store, calibration_id).sides)
    except InputError:
        return False


@functools.lru_cache(maxsize=32)
def _figures(store: Store, fit: str) -> tuple[Figure, ...]:
    """Of a kept fit, which never changes, and is long."""
    return figures_of(FitResult.model_validate(store.result(fit).document))


def _figures_of_fit(service: Service, figures: tuple[Figure, ...]) -> list[FigureOfFit]:
    limits = standing_limits(service.store.root)
    listed = []
    for figure in figures:
        limit = next((limit for limit in (limits.limit if limits else ()) if limit.concerns(figure)), None)
        listed.append(
            FigureOfFit(
                figure=figure.name,
                place=figure.place,
                title=figure.title,
                unit=figure.unit,
                side=figure.side,
                value=figure.value,
                std=figure.std,
                good=None if limit is None else limit.good,
                mark=None if limit is None else limit.judge(figure),
            )
        )
    return listed


def _newest_figures(service: Service, source: str, what: str) -> list[FigureOfFit]:
    newest = service.store.newest_results(source)
    if "fit" not in newest:
        raise Conflict(f"{what}: isn't fitted yet; start a job of the kind fit")
    return _figures_of_fit(service, _figures(service.store, newest["fit"]))


@router.get("/calibrations/{calibration_id}/figures", dependencies=[READ], responses=answers(401, 404, 422))
def calibration_figures(service: Here, calibration_id: HexId) -> list[FigureOfFit]:
    """Every number of a calibration that has an uncertainty, by the data folder's limits where one concerns it."""
    return _figures_of_fit(service, life.figures(service.store, _find_calibration(service, calibration_id).id))


@router.get("/sessions/{session_id}/figures", dependencies=[READ], responses=answers(401, 404, 409, 422))
def session_figures(service: Here, session_id: SessionId) -> list[FigureOfFit]:
    """The figures of a session's newest fit. 409 before there is one."""
    service.session(session_id)
    return _newest_figures(service, session_id, f"session {session_id}")


@router.get("/recordings/{recordings_id}/figures", dependencies=[READ], responses=answers(401, 404, 409, 422))
def recordings_figures(service: Here, recordings_id: HexId) -> list[FigureOfFit]:
    """The figures of the newest fit of recordings that were sent in."""
    return _newest_figures(service, str(service.recordings(recordings_id)), f"recordings {recordings_id}")


@router.get("/calibrations/{calibration_id}/drafted-limits", dependencies=[READ], responses=answers(401, 404, 422))
def drafted_limits(service: Here, calibration_id: HexId) -> DraftedLimits:
    """Limits drafted from what the same cameras had before: where the next calibration of an unchanged camera lies with
    99 %. They say what is usual; what a camera has to reach, somebody decides. Nothing is kept."""
    wanted = _find_calibration(service, calibration_id).id
    drafts, whence = life.draft_limits(service.store, wanted)
    words = f"Drafted from {len(whence)} earlier calibrations of these cameras: what is usual for them."
    if wanted in whence:
        others = f" and {len(whence) - 1} earlier" if len(whence) > 1 else " alone"
        words = f"Drafted from this calibration{others}: that it lies within them is not an independent check."
    standing = standing_limits(service.store.root)
    return DraftedLimits(
        words=words,
        valid_days=standing.valid_days if standing else None,
        limits=tuple(
            DraftedLimit(
                figure=draft.figure,
                title=plain_name(draft.figure, draft.place).replace(", *", ", every edge"),
                unit=unit_of(draft.figure),
                side=draft.side,
                place=draft.place,
                good=draft.good,
            )
            for draft in drafts
        ),
    )


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
    calibration = _find_calibration(service, calibration_id)
    if calibration.state != "candidate":
        raise Conflict(f"calibration {calibration_id} is {calibration.state}; only a candidate can be certified")
    limits = asked.stated() or standing_limits(service.store.root)
    if limits is None:
        raise HTTPException(422, "limits: the data folder has no limits.toml; put one there, or send the limits")
    return life.certify(service.store, calibration_id, key.name, limits, accept_warnings=asked.accept_warnings)


def _find_certified(service: Service, calibration_id: str) -> CalibrationRecord:
    calibration = _find_calibration(service, calibration_id)
    if calibration.certified is None:
        raise Conflict(f"calibration {calibration_id} is a {calibration.state}; certify it, then it has a certificate")
    return calibration


@router.get(
    "/calibrations/{calibration_id}/certificate",
    dependencies=[READ],
    response_class=HTMLResponse,
    responses=answers(401, 404, 409, 422),
)
def certificate_of_calibration(service: Here, calibration_id: HexId) -> HTMLResponse:
    """The certificate as a page to print, or to keep as a PDF: limits, figures with their uncertainties, verdict,
    serial numbers, hash. 409 before it is certified."""
    certified = _find_certified(service, calibration_id)
    try:
        runs = service.public_runs(service.store.runs(certified.session_id))
    except InputError:  # the session was deleted
        runs = ()
    page = certificate_page(service.store, certified, runs)
    return HTMLResponse(service.public.within(page), headers={"Content-Security-Policy": REPORT_POLICY})


@router.get(
    "/calibrations/{calibration_id}/certificate.json", dependencies=[READ], responses=answers(401, 404, 409, 422)
)
def certificate_content(service: Here, calibration_id: HexId) -> Certificate:
    """What the certificate states, and its hashes: whoever has it sees whether it was changed."""
    return certificate(service.store, _find_certified(service, calibration_id))


@router.post("/calibrations/{calibration_id}/revoke", responses=answers(401, 403, 404, 409, 422))
def revoke_calibration(
    service: Here,
    calibration_id: HexId,
    asked: Revoke,
    key: Annotated[StoredKey, Depends(Demand(Permission.CALIBRATE))],
) -> CalibrationRecord:
    """Take a certificate back, with the reason, by the holder of the key. 409 for a calibration without one."""
    calibration = _find_calibration(service, calibration_id)
    try:
        return life.revoke(service.store, calibration.id, key.name, asked.why)
    except InputError as error:
        raise Conflict(str(error)) from None


@router.get("/drift", dependencies=[READ], responses=answers(401, 404, 422))
def drift(
    service: Here,
    camera: Annotated[str, Query(max_length=400, description="as `/figures` names it")],
    reference_c: Annotated[
        float | None,
        Query(ge=-200, le=200, description="deg C, to which dark currents are corrected; null: the usual one"),
    ] = None,
    newest: Annotated[int, Query(ge=1, le=200, description="how many calibrations, the newest")] = life.BOARD_COLUMNS,
) -> DriftBoard:
    """All figures of a camera, or of the pair, by its calibrations: in which band each lies, and whether it drifted."""
    limits = standing_limits(service.store.root)
    try:
        return life.drift_board(service.store, camera, limits, reference_c=reference_c, newest=newest)
    except InputError as error:
        raise HTTPException(404, str(error)) from None


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
