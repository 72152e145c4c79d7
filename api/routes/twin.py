"""Predictions of sessions that haven't been captured, kept sealed, opened against recordings, and budgets of a camera
model's uncertainty.

    DATA/predictions/ID.json           the sealed prediction, as `calibench twin predict` writes it
                     ID.json.sha256    its hash, of which ID is the beginning
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import FileResponse

from api.errors import Conflict, answers
from api.kept_sets import KeptSet, find_sent_set, session_set
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, page_headers, page_of
from api.schemas import PredictionStart, SetAsked, StoredPrediction
from api.service import CALIBRATE, READ, ROOM, Here, HexId, Service, camera_model
from lab.calibration import camera_models
from lab.capture.catalogue import step_times
from lab.errors import InputError
from lab.formats.recording_set import RecordingSet
from lab.formats.result_file import read_result
from lab.twin.budget import BudgetResult, budget, parse_uses
from lab.twin.changes import validate_changes
from lab.twin.predict import predict
from lab.twin.score import TwinScore, score
from lab.twin.sealed import SealedPrediction, open_seal, seal, seal_path
from sim.camera import Side

router = APIRouter(tags=["twin"])
_computing = threading.Lock()


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    """Computations that take seconds of a core are refused while another runs: captures need the rest."""
    if not _computing.acquire(blocking=False):
        raise Conflict("another prediction, score or budget is being computed; ask again in some seconds")
    try:
        yield
    finally:
        _computing.release()


def _set(service: Service, asked: SetAsked) -> tuple[str, KeptSet]:
    """The id and the recordings that a request names; 404 where there are none."""
    if asked.session_id is not None:
        return asked.session_id, session_set(service, asked.session_id)
    assert asked.recordings_id is not None  # the schema wants one of both
    return asked.recordings_id, find_sent_set(service, asked.recordings_id)


def _read(kept: KeptSet) -> RecordingSet:
    try:
        return kept.read()
    except InputError as error:
        raise Conflict(str(error)) from None


def _folder(service: Service) -> Path:
    return service.store.root / "predictions"


def _open_prediction(service: Service, prediction_id: str) -> SealedPrediction:
    """A prediction whose seal holds; 404 where there is none. Raises InputError where it was edited."""
    file = _folder(service) / f"{prediction_id}.json"
    if not file.is_file():
        raise HTTPException(404, f"no prediction {prediction_id!r}; GET /api/v1/predictions lists them")
    return open_seal(file)


def _fields(service: Service, prediction_id: str, prediction: SealedPrediction) -> StoredPrediction:
    file = _folder(service) / f"{prediction_id}.json"
    return StoredPrediction(
        id=prediction_id,
        sha256=seal_path(file).read_text(encoding="utf-8").split()[0],
        created=datetime.fromtimestamp(file.stat().st_mtime, UTC),
        camera_model=prediction.model,
        plan=prediction.plan,
        changes=prediction.changes.model_dump(mode="json", exclude_none=True),
        numbers={side: len(sealed_side.numbers) for side, sealed_side in prediction.sides.items()},
        names={side: tuple(name.told for name in sealed_side.names) for side, sealed_side in prediction.sides.items()},
        not_predicted=tuple(
            skipped.reason for sealed_side in prediction.sides.values() for skipped in sealed_side.skipped
        ),
    )


@router.post(
    "/predictions", status_code=201, dependencies=[CALIBRATE, ROOM], responses=answers(401, 403, 404, 409, 422)
)
def make_prediction(service: Here, asked: PredictionStart, response: Response) -> StoredPrediction:
    """Predict the measured numbers of a session that hasn't been captured, with their covariance, and seal them, as
    `calibench twin predict` does. 422, in one line, for a change that the model can't carry."""
    changes = validate_changes(asked.changes.model_dump(exclude_none=True), "changes.")
    models = camera_models.camera_files(service.store, camera_model(service, asked.camera_model))
    plan_id, plan = _set(service, asked.plan)
    fitted = None if asked.fitted is None else _read(_set(service, asked.fitted)[1])
    with _one_at_a_time():
        prediction = predict(
            models, _read(plan), changes, model=asked.camera_model, light_std=asked.light_std_percent / 100.0,
            fitted=fitted,
        ).model_copy(update={"plan": plan_id})  # fmt: skip
    folder = _folder(service)
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f".{threading.get_ident()}.json"
    id = seal(prediction, partial)[:16]
    partial.unlink()
    seal_path(partial).unlink()
    if not (folder / f"{id}.json").is_file():  # the same prediction stays the one that was sealed first
        seal(prediction, folder / f"{id}.json")
    response.headers["Location"] = f"/api/v1/predictions/{id}"
    return _fields(service, id, prediction)


@router.get("/predictions", dependencies=[READ], responses=answers(401, 422) | {200: {"headers": HEADERS}})
def list_predictions(
    service: Here, request: Request, response: Response, after: IdCursor = None, limit: Limit = PAGE
) -> list[StoredPrediction]:
    """Sealed predictions, the newest first, in pages. Whether a seal holds is looked at where one is asked for."""
    there = sorted(_folder(service).glob("[0-9a-f]*.json"), key=lambda file: (-file.stat().st_mtime, file.stem))
    every = [file.stem for file in there]
    page = page_of(every, after, limit, "prediction")
    page_headers(request, response, len(every), limit, page)
    folder = _folder(service)
    return [
        _fields(service, prediction_id, read_result(SealedPrediction, folder / f"{prediction_id}.json"))
        for prediction_id in page
    ]


@router.get("/predictions/{prediction_id}", dependencies=[READ], responses=answers(401, 404, 422))
def get_prediction(service: Here, prediction_id: HexId) -> StoredPrediction:
    """One prediction: of which model, with which changes, and its hash. 422 where the file was edited."""
    return _fields(service, prediction_id, _open_prediction(service, prediction_id))


@router.get(
    "/predictions/{prediction_id}/sealed.json",
    dependencies=[READ],
    response_class=FileResponse,
    responses=answers(401, 404, 422) | {200: {"content": {"application/json": {"schema": {"type": "object"}}}}},
)
def sealed_prediction(service: Here, prediction_id: HexId) -> FileResponse:
    """The sealed file, byte by byte: its SHA-256 is `sha256` of the prediction."""
    _open_prediction(service, prediction_id)
    return FileResponse(_folder(service) / f"{prediction_id}.json", media_type="application/json")


@router.delete(
    "/predictions/{prediction_id}", status_code=204, dependencies=[CALIBRATE], responses=answers(401, 403, 404, 422)
)
def delete_prediction(service: Here, prediction_id: HexId) -> None:
    """Delete a prediction for ever."""
    file = _folder(service) / f"{prediction_id}.json"
    missing = f"no prediction {prediction_id!r}; GET /api/v1/predictions lists them"
    if not file.is_file():
        raise HTTPException(404, missing)
    seal_path(file).unlink(missing_ok=True)
    file.unlink()


@router.post("/predictions/{prediction_id}/score", dependencies=[READ], responses=answers(401, 404, 409, 422))
def score_prediction(service: Here, prediction_id: HexId, asked: SetAsked) -> TwinScore:
    """Open a prediction against the session that it foretold: deviations, intervals, and names that don't survive, as
    `calibench twin score` tells them. 422 where it was edited, and for another session."""
    sealed = _open_prediction(service, prediction_id)
    id, kept = _set(service, asked)
    recordings = _read(kept)
    with _one_at_a_time():
        return score(sealed, recordings).model_copy(update={"source": id})


@router.get("/camera-models/{model_id}/budget", dependencies=[READ], responses=answers(401, 404, 409, 422))
def camera_model_budget(
    service: Here,
    model_id: HexId,
    use: Annotated[str, Query(max_length=200, description="some of MTF50, patches, variance, dark mean, by commas")],
    station: Annotated[
        str | None,
        Query(max_length=100, description="rank its sequences by the reduction per minute of lab time"),
    ] = None,
) -> dict[Side, BudgetResult]:
    """What matters for a use of each camera at the model's present uncertainty, as `calibench twin budget` tells it."""
    uses = parse_uses_or_422(use)
    there = None if station is None else service.station(station)
    times = None if there is None else step_times(service.store, there)
    models = camera_models.camera_files(service.store, camera_model(service, model_id))
    with _one_at_a_time():
        return {side: budget(content, uses, there, times) for side, content in models.items()}


def parse_uses_or_422(text: str) -> tuple[str, ...]:
    """The uses of a request; 422 for one that isn't known."""
    try:
        return parse_uses(text)
    except InputError as error:
        raise HTTPException(422, str(error).replace("--use", "use")) from None
