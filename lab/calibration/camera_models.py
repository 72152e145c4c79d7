"""The camera models of the registry, kept as camera files: `DATA/cameras/RESULT/SIDE.toml`.

A fit's model is the baseline with what was fitted; a diagnosis' has the effects that it named, too. They stay when the
session is deleted. What was kept before there were such files has none: fit again. A model that was sent in belongs to
no session."""

from __future__ import annotations

import logging
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, get_args

import sqlalchemy as sa
from pydantic import BaseModel

from lab.capture.records import now
from lab.capture.store import Store
from lab.capture.tables import ResultRow
from lab.errors import InputError
from lab.formats.camera_file import CameraFile, fitted_camera, read_camera, write_camera
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult
from sim.camera import Side
from sim.parameters import Frozen, read_quantities

log = logging.getLogger(__name__)
Kind = Literal["fitted", "improved", "sent"]
#: The kind of result that a model which was sent in is registered as; nothing else has it.
_SENT = "camera-model"
#: A result's kind, and what its cameras are.
KINDS: dict[str, Kind] = {"fit": "fitted", "diagnose": "improved", _SENT: "sent"}
SIDES: tuple[Side, ...] = get_args(Side)
_ID = re.compile(r"[0-9a-f]{16}")


class ModelParameter(Frozen):
    """A parameter of a camera model as it is declared, with its value; `std`: one standard uncertainty, None where none
    is known."""

    name: str
    unit: str
    meaning: str
    value: float | tuple[float, ...]
    std: float | None = None


class ModelEffect(Frozen):
    """An effect that acts in a camera model."""

    name: str
    parameters: tuple[ModelParameter, ...]


class ModelOfCamera(Frozen):
    """One camera of a model. `imaging`, `illumination`: kinds of the lens' laws; the camera file has them whole."""

    name: str
    cfa: str
    channels: tuple[str, ...]
    parameters: tuple[ModelParameter, ...]
    imaging: str
    illumination: str
    effects: tuple[ModelEffect, ...]


class CameraModelRecord(Frozen):
    """The cameras of one result, by side. `source`: the session, or the folder of recordings; empty for what was sent
    in."""

    id: str
    kind: Kind
    source: str
    created: datetime
    sides: tuple[Side, ...]


def _folder(store: Store, result_id: str) -> Path:
    if not _ID.fullmatch(result_id):
        raise InputError(f"no camera model {result_id[:60]!r}; list them for their ids")
    return store.root / "cameras" / result_id


def keep(store: Store, result_id: str, cameras: Mapping[Side, CameraFile]) -> None:
    """Write the camera files of a result, all of them or none."""
    if not cameras:
        return
    folder = _folder(store, result_id)
    partial = folder.with_name(f".{result_id}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        for side, content in cameras.items():
            # The table of a traced lens goes beside the file: a prescription's path would only be good on this
            # computer.
            write_camera(partial / f"{side}.toml", replace(content, prescription=None))
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def bring_in(store: Store, cameras: Mapping[Side, CameraFile]) -> str:
    """Keep cameras that were sent in; the id of their model."""
    id = secrets.token_hex(8)
    keep(store, id, cameras)
    with store.transaction() as db:
        db.add(ResultRow(id=id, job_id=None, source="", kind=_SENT, created=now(), document={}))
    return id


def remove(store: Store, model_id: str) -> None:
    """Delete a model that was sent in, for ever. Raises InputError where there is none, and for one that a fit or a
    diagnosis found."""
    model = record(store, model_id)
    if model.kind != "sent":
        raise InputError(
            f"camera model {model_id}: is {model.kind}, part of a result; only those that were sent in can be deleted"
        )
    with store.transaction() as db:
        db.execute(sa.delete(ResultRow).where(ResultRow.id == model_id))
    shutil.rmtree(_folder(store, model_id))


def keep_fitted(store: Store, result_id: str, recordings: RecordingSet, fit: FitResult) -> None:
    """Keep the cameras of a fit. One that its figures make none of is left out, and the log says why."""
    cameras: dict[Side, CameraFile] = {}
    for side, fitted in fit.cameras.items():
        try:
            cameras[side] = fitted_camera(recordings, side, fitted)
        except (InputError, ValueError) as error:
            log.warning("camera model %s (%s): %s", result_id, side, " ".join(str(error).split()))
    keep(store, result_id, cameras)


def _record(store: Store, row: Any) -> CameraModelRecord:
    folder = _folder(store, row.id)
    sides: tuple[Side, ...] = tuple(side for side in SIDES if (folder / f"{side}.toml").is_file())
    return CameraModelRecord(id=row.id, kind=KINDS[row.kind], source=row.source, created=row.created, sides=sides)


def _select_models() -> Any:
    return sa.select(ResultRow.id, ResultRow.kind, ResultRow.source, ResultRow.created).where(ResultRow.kind.in_(KINDS))


def records(store: Store, after: str | None = None, limit: int | None = None) -> list[CameraModelRecord]:
    """Return camera models, the newest first.

    after : id of the model that they follow in this order
    limit : how many at most

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     records(Store(Path(folder)))
    []
    """
    asked = _select_models().order_by(ResultRow.created.desc(), ResultRow.id.desc()).limit(limit)
    with store.reading() as db:
        if after is not None:
            last = db.execute(_select_models().where(ResultRow.id == after)).first()
            if last is None:
                raise InputError(f"camera model {after!r} isn't known; list them for their ids")
            asked = asked.where(sa.tuple_(ResultRow.created, ResultRow.id) < sa.tuple_(last.created, last.id))
        rows = db.execute(asked).all()
    return [_record(store, row) for row in rows]


def count(store: Store) -> int:
    """Return how many results have a place for camera models."""
    with store.reading() as db:
        return db.scalars(sa.select(sa.func.count()).select_from(ResultRow).where(ResultRow.kind.in_(KINDS))).one()


def record(store: Store, result_id: str) -> CameraModelRecord:
    """Return a camera model. Raises InputError where there is none."""
    with store.reading() as db:
        row = db.execute(_select_models().where(ResultRow.id == result_id)).first()
    if row is None:
        raise InputError(f"no camera model {result_id[:60]!r}; list them for their ids")
    return _record(store, row)


def files(store: Store, result_id: str) -> Iterator[Path]:
    """Yield the files of a model: each side's, and the arrays beside it."""
    yield from sorted(_folder(store, result_id).iterdir())


def camera_files(store: Store, model: CameraModelRecord) -> dict[Side, CameraFile]:
    """Return the cameras themselves."""
    folder = _folder(store, model.id)
    return {side: read_camera(folder / f"{side}.toml") for side in model.sides}


def cameras(store: Store, model: CameraModelRecord) -> dict[Side, ModelOfCamera]:
    """Return what each camera file says."""
    return {side: _camera(content) for side, content in camera_files(store, model).items()}


def _camera(content: CameraFile) -> ModelOfCamera:
    model = content.camera
    lens = [
        parameter.model_copy(update={"name": f"lens.{parameter.name}"}) for parameter in _parameters(model.lens, {})
    ]
    return ModelOfCamera(
        name=content.name,
        cfa=model.cfa,
        channels=tuple(model.channels),
        parameters=(*_parameters(model, model.std), *lens),
        imaging=model.lens.imaging.kind,
        illumination=model.lens.illumination.kind,
        effects=tuple(
            ModelEffect(name=effect.name, parameters=tuple(_parameters(effect, {}))) for effect in content.effects
        ),
    )


def _parameters(model: BaseModel, std: Mapping[str, float]) -> Iterator[ModelParameter]:
    """Yield the declared quantities of a model that are set."""
    for name, quantity in read_quantities(type(model)).items():
        value = getattr(model, name)
        if isinstance(value, int | float | tuple):
            yield ModelParameter(
                name=name, unit=quantity.unit, meaning=quantity.meaning, value=value, std=std.get(name)
            )
