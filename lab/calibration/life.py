"""The registry of calibrations: what each is, who certified it against which limits, until when, and how its figures
drift.

Every fit of a session is a calibration of the session's cameras, which are known by what they report: maker, model and
serial number. It is a **candidate** until somebody certifies it against limits, **certified** then, **superseded** when
a later one of the same cameras is certified, and **expired** when its time is over.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from typing import Any, Literal

import numpy as np
import sqlalchemy as sa
from scipy import special, stats

from lab.calibration.limits import (
    COVERAGE_FACTOR,
    CalibrationLimits,
    Figure,
    Judgement,
    Limit,
    Mark,
    figures_of,
    judge_figures,
)
from lab.capture.records import RunRecord, now
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture.tables import CalibrationRow, FigureRow, ResultRow, SessionRow
from lab.errors import InputError
from lab.fit.compare import FALSE_ALARM_RATE, MATRIX_PLACES, ComparedNumbers, sidak_part, sigma_of_probability
from lab.fit.noise.dark_current import SensorTemperature
from lab.formats.recording_set import InstrumentSnapshot, Snapshots, differences
from lab.formats.results import FitResult
from lab.formats.results.words import plain_name
from lab.shown import Tabular
from sim.camera import Side
from sim.parameters import Frozen

#: Fits that are entered as calibrations in one transaction.
TOGETHER = 100
CalibrationState = Literal["candidate", "certified", "superseded", "expired", "revoked"]


class CalibrationRecord(Frozen):
    """One calibration. `cameras`: by side, the name that each camera reports."""

    id: str
    session_id: str
    name: str
    created: datetime
    cameras: dict[Side, str]
    state: CalibrationState
    certified: datetime | None = None
    certified_by: str | None = None
    expires: datetime | None = None
    superseded: datetime | None = None
    superseded_by: str | None = None
    revoked: datetime | None = None
    revoked_by: str | None = None
    revoked_why: str | None = None
    limits: CalibrationLimits | None = None
    judgements: tuple[Judgement, ...] = ()


class HistoryPoint(Frozen):
    """A figure in one calibration. `temperature_c`: of a dark current, the sensor's as it was measured. `mark`: by the
    limits, None without one. `significance_sigma`: of its difference from the reference, the calibration before it that
    was certified last, or the first of all; `drifted`: beyond the limit of the false-alarm rate."""

    calibration_id: str
    created: datetime
    state: CalibrationState
    value: float
    std: float
    temperature_c: float | None = None
    mark: Mark | None
    reference_id: str | None
    significance_sigma: float | None
    drifted: bool


class History(Tabular, Frozen):
    """A figure of a camera over its calibrations, oldest first, one entry each. `title`, `unit`: as a lab reads them.
    `threshold_sigma`: beyond it a change is called a drift."""

    camera: str
    figure: str
    place: str
    title: str = ""
    unit: str = "1"
    limit: Limit | None
    false_alarm_rate: float
    threshold_sigma: float
    points: tuple[HistoryPoint, ...]


class BoardColumn(Frozen):
    """A calibration on the board."""

    calibration_id: str
    session_id: str
    name: str
    created: datetime
    state: CalibrationState


class BoardCell(Frozen):
    """A figure in one calibration: `corrected` to the row's reference temperature or as it was measured; `mark`,
    `significance_sigma` and `drifted` as in a history."""

    value: float
    std: float
    corrected: bool
    mark: Mark | None
    significance_sigma: float | None
    drifted: bool


BoardGroup = Literal["key", "mtf", "other"]


class BoardRow(Frozen):
    """A figure over the board's calibrations; a cell is None where one doesn't have it. `reference_c`: the temperature
    to which its values are corrected, by the `law`; None where no law is known. `group`: a key figure of the camera,
    one of the many of its edges' MTFs, or another."""

    group: BoardGroup = "other"
    figure: str
    place: str
    title: str
    unit: str
    limit: Limit | None
    reference_c: float | None = None
    law: str = ""
    cells: tuple[BoardCell | None, ...]


class DriftBoard(Frozen):
    """All figures of a camera by its newest calibrations, the oldest first; key figures are the first rows, those of
    MTFs the last."""

    camera: str
    false_alarm_rate: float
    columns: tuple[BoardColumn, ...]
    rows: tuple[BoardRow, ...]


def cameras_of(instruments: Snapshots, station: Station) -> dict[Side, str]:
    """Name of each camera of a run: maker, model and serial number as it reports them. Without a serial number it is
    known by its station and side."""
    cameras: dict[Side, str] = {}
    for side in station.sides:
        camera = instruments.get(f"camera {side}", InstrumentSnapshot())
        parts = [camera.maker, camera.model, camera.serial_number]
        where = [] if parts[2] else [f"({side} of {station.name or 'a station'})"]
        cameras[side] = " ".join([part for part in parts if part] + where)
    return cameras


def rig_of(cameras: Mapping[Side, str]) -> str:
    """Return the rig of cameras by side: a calibration of it supersedes an earlier one of the same.

    >>> rig_of({"right": "cam-2", "left": "cam-1"})
    '{"left": "cam-1", "right": "cam-2"}'
    """
    return json.dumps(dict(sorted(cameras.items())))


def check_certified(store: Store, instruments: Snapshots, station: Station) -> None:
    """Raises InputError unless the rig of these cameras has a certified calibration that isn't expired, of which they
    have the settings."""
    register(store)
    cameras = cameras_of(instruments, station)
    asked = _select_rows().order_by(CalibrationRow.created.desc())
    with store.reading() as db:
        of_rig = db.execute(asked.where(CalibrationRow.rig == rig_of(cameras)))
        history = [_calibration(row, name) for row, name in of_rig]
        others = [_calibration(row, name) for row, name in ([] if history else db.execute(asked))]
    for calibration in history:
        if calibration.state == "certified":
            _check_settings(store, calibration, instruments, cameras)
            return
    expired = [calibration for calibration in history if calibration.state == "expired"]
    why = (
        f"its certified calibration {expired[0].id} expired on {expired[0].expires:%Y-%m-%d}"
        if expired and expired[0].expires
        else f"{len(history)} calibrations of it are known, none is certified"
    )
    for certified in [
        calibration
        for calibration in others
        if calibration.state == "certified" and calibration.cameras.keys() == cameras.keys()
    ][:1]:
        changed = [
            f"{side} was {was}, is {cameras[side]}" for side, was in certified.cameras.items() if was != cameras[side]
        ]
        why += f" (the newest certified one, {certified.id}, is of other cameras: {'; '.join(changed)})"
    raise InputError(
        f"cameras {', '.join(cameras.values())}: the session demands a certified calibration, and {why}; certify one "
        "with "
        "`calibench calibrations certify ID`, or start without --certified"
    )


def _check_settings(
    store: Store, certified: CalibrationRecord, instruments: Snapshots, cameras: Mapping[Side, str]
) -> None:
    """Raises InputError where a camera is set otherwise than when the calibration was captured."""
    if not store.has_session(certified.session_id) or not (runs := store.runs(certified.session_id)):
        return
    names = [f"camera {side}" for side in cameras]
    then, now = ({name: of[name] for name in names if name in of} for of in (runs[-1].instruments, instruments))
    if changed := differences(then, now):
        raise InputError(
            f"{'; '.join(changed)}: so the certified calibration {certified.id}, which the session demands, isn't of "
            "these cameras as they are; set them as they were, or start without --certified and certify a new one"
        )


def check_nothing_rests_on(store: Store, session_id: str) -> None:
    """Raises InputError where a calibration that is certified now rests on the session; enters the others, which stay
    without it."""
    register(store)
    with store.reading() as db:
        calibrations = [
            _calibration(*row) for row in db.execute(_select_rows().where(CalibrationRow.session_id == session_id))
        ]
    for calibration in calibrations:
        if calibration.state == "certified":
            raise InputError(
                f"session {session_id}: the certified calibration {calibration.id} rests on it; its captures are kept "
                "until "
                "that is "
                "superseded or expired"
            )


def register(store: Store) -> None:
    """Enter the fits of sessions that aren't in the registry of calibrations yet, with their figures."""
    with store.reading() as db:
        missing = db.scalars(
            sa.select(ResultRow.id)
            .join(SessionRow, SessionRow.id == ResultRow.source)
            .outerjoin(CalibrationRow, CalibrationRow.id == ResultRow.id)
            .where(ResultRow.kind == "fit", CalibrationRow.id.is_(None))
        ).all()
    for begin in range(0, len(missing), TOGETHER):
        _register(store, missing[begin : begin + TOGETHER])


def _register(store: Store, missing: Sequence[str]) -> None:
    """Enter some fits in one transaction: each of its own would wait for the disk."""
    columns = (ResultRow.id, ResultRow.created, ResultRow.document, SessionRow.id, SessionRow.station, SessionRow.runs)
    asked = sa.select(*columns).join(SessionRow, SessionRow.id == ResultRow.source).where(ResultRow.id.in_(missing))
    with store.reading() as db:
        entries = [_entry(*entry) for entry in db.execute(asked)]
    with store.transaction() as db:
        known = set(db.scalars(sa.select(CalibrationRow.id).where(CalibrationRow.id.in_(missing))))
        fresh = [entry for entry in entries if entry[0]["id"] not in known]  # else another process was faster
        if fresh:
            db.execute(sa.insert(CalibrationRow), [row for row, _ in fresh])
        if of_them := [figure for _, figures in fresh for figure in figures]:
            db.execute(sa.insert(FigureRow), of_them)


def _entry(
    result_id: str, created: datetime, document: Any, session_id: str, station: Any, runs: Sequence[Any]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the rows of a calibration and of its figures."""
    run = RunRecord.model_validate(runs[-1]) if runs else None
    cameras = cameras_of(run.instruments if run is not None else {}, Station.model_validate(station))
    rig = rig_of(cameras)
    row = {
        "id": result_id,
        "session_id": session_id,
        "created": created,
        "rig": rig,
        "cameras": {str(side): name for side, name in cameras.items()},
    }
    figures = [
        {
            "calibration_id": result_id,
            "camera": cameras.get(figure.side, rig) if figure.side else rig,
            "side": figure.side,
            "name": figure.name[:200],
            "place": figure.place[:60],
            "value": figure.value,
            "std": figure.std,
            **(dict.fromkeys(SensorTemperature.model_fields) if figure.sensor is None else figure.sensor.model_dump()),
        }
        for figure in figures_of(FitResult.model_validate(document))
    ]
    return row, figures


def _aware(at: datetime | None) -> datetime | None:
    return at.replace(tzinfo=UTC) if at is not None and at.tzinfo is None else at


def _state(row: Any, at: datetime) -> CalibrationState:
    if row.certified is None:
        return "candidate"
    if row.revoked is not None:
        return "revoked"
    if row.superseded is not None:
        return "superseded"
    expires = _aware(row.expires)
    return "expired" if expires is not None and expires <= at else "certified"


def _calibration(row: CalibrationRow, name: str) -> CalibrationRecord:
    return CalibrationRecord(
        id=row.id,
        session_id=row.session_id,
        name=name or row.session_id,
        created=_aware(row.created) or now(),
        cameras=row.cameras,  # type: ignore[arg-type]
        state=_state(row, now()),
        certified=_aware(row.certified),
        certified_by=row.certified_by,
        expires=_aware(row.expires),
        superseded=_aware(row.superseded),
        superseded_by=row.superseded_by,
        revoked=_aware(row.revoked),
        revoked_by=row.revoked_by,
        revoked_why=row.revoked_why,
        limits=None if row.limits is None else CalibrationLimits.model_validate(row.limits),
        judgements=tuple(Judgement.model_validate(judgement) for judgement in row.judgements or ()),
    )


def _select_rows() -> Any:
    """Calibrations with their sessions' names; a session that was deleted has its id for one."""
    name = sa.func.coalesce(SessionRow.name, CalibrationRow.session_id)
    return sa.select(CalibrationRow, name).outerjoin(SessionRow, SessionRow.id == CalibrationRow.session_id)


def calibrations(store: Store, after: str | None = None, limit: int | None = None) -> list[CalibrationRecord]:
    """Return calibrations, the newest first.

    after : id of the calibration that they follow in this order
    limit : how many at most

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     calibrations(Store(Path(folder)))
    []
    """
    register(store)
    asked = _select_rows().order_by(CalibrationRow.created.desc(), CalibrationRow.id.desc()).limit(limit)
    with store.reading() as db:
        if after is not None:
            last = db.get(CalibrationRow, after)
            if last is None:
                raise InputError(f"calibration {after!r} isn't known; list the calibrations for their ids")
            asked = asked.where(sa.tuple_(CalibrationRow.created, CalibrationRow.id) < sa.tuple_(last.created, last.id))
        return [_calibration(row, name) for row, name in db.execute(asked)]


def count_calibrations(store: Store) -> int:
    """Return how many calibrations there are.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     count_calibrations(Store(Path(folder)))
    0
    """
    register(store)
    with store.reading() as db:
        return db.scalars(sa.select(sa.func.count()).select_from(CalibrationRow)).one()


def calibration(store: Store, id: str) -> CalibrationRecord:
    """Return a calibration, by its own id or by its session's: the newest of that. Raises InputError where there is
    none.
    """
    register(store)
    wanted = _select_rows().where(sa.or_(CalibrationRow.id == id, CalibrationRow.session_id == id))
    with store.reading() as db:
        newest = db.execute(wanted.order_by(CalibrationRow.created.desc())).first()
    if newest is None:
        raise InputError(f"calibration {id!r} isn't known; `calibench calibrations list` lists those that are")
    return _calibration(*newest)


def _figure(row: Any) -> Figure:
    """Return the figure of a row, which has the columns of `FigureRow`."""
    sensor = None
    if row.doubling_c is not None:
        sensor = SensorTemperature.model_validate({name: getattr(row, name) for name in SensorTemperature.model_fields})
    return Figure(name=row.name, side=row.side, place=row.place, value=row.value, std=row.std, sensor=sensor)


#: Earlier versions registered a camera matrix's constants, too.
_FITTED = sa.or_(FigureRow.name.not_like("%camera_matrix"), FigureRow.place.in_(MATRIX_PLACES))


def figures(store: Store, calibration_id: str) -> tuple[Figure, ...]:
    """Return the figures of a calibration."""
    asked = sa.select(FigureRow).where(FigureRow.calibration_id == calibration_id, _FITTED).order_by(FigureRow.id)
    with store.reading() as db:
        return tuple(_figure(row) for row in db.scalars(asked))


def figure_names(store: Store) -> list[tuple[str, str, str]]:
    """Return (camera, figure, place) of every history."""
    register(store)
    asked = sa.select(FigureRow.camera, FigureRow.name, FigureRow.place).where(_FITTED).distinct()
    with store.reading() as db:
        return [(camera, name, place) for camera, name, place in sorted(db.execute(asked))]


def certify(
    store: Store, id: str, by: str, limits: CalibrationLimits, *, accept_warnings: bool = False
) -> CalibrationRecord:
    """Certify a calibration against `limits`; what the same cameras had before is superseded.

    Raises InputError, a line for each, for figures that are bad or missing, and for those in the warning band unless
    `accept_warnings`; and where it is certified or superseded already. Limits that are drafted ones are kept as such,
    whoever sends them: a calibration always lies within those that were drafted from it.
    """
    wanted = calibration(store, id)
    if wanted.state != "candidate":
        raise InputError(
            f"calibration {wanted.id}: is {wanted.state}, only a candidate can be certified; fit the session again"
        )
    judgements = judge_figures(figures(store, wanted.id), limits)
    refused = ("bad", "missing") if accept_warnings else ("warn", "bad", "missing")
    if lines := [_refusal(wanted.id, judgement) for judgement in judgements if judgement.mark in refused]:
        raise InputError("\n".join(lines))
    drafts, whence = draft_limits(store, wanted.id)
    bands = {(draft.figure, draft.side, draft.place, draft.good) for draft in drafts}
    is_drafted = any((limit.figure, limit.side, limit.place, limit.good) in bands for limit in limits.limit)
    limits = limits.model_copy(update={"drafted_from": whence if is_drafted else ()})
    at = now()
    with store.transaction() as db:
        row = db.get_one(CalibrationRow, wanted.id, with_for_update=True)
        if row.certified is not None:
            raise InputError(f"calibration {wanted.id}: was certified just now by {row.certified_by}; look at it again")
        earlier = db.scalars(
            sa.select(CalibrationRow).where(
                CalibrationRow.rig == row.rig,
                CalibrationRow.certified.is_not(None),
                CalibrationRow.superseded.is_(None),
            )
        ).all()
        for predecessor in earlier:
            predecessor.superseded, predecessor.superseded_by = at, row.id
        row.certified, row.certified_by = at, by[:100]
        row.limits = limits.model_dump(mode="json")
        row.judgements = [judgement.model_dump(mode="json") for judgement in judgements]
        row.expires = None if limits.valid_days is None else at + timedelta(days=limits.valid_days)
    return calibration(store, wanted.id)


def revoke(store: Store, id: str, by: str, why: str) -> CalibrationRecord:
    """Take a certificate back, with the reason; the calibration stays, and isn't certified again.

    What it had superseded stays superseded. Raises InputError where it isn't certified, or was revoked already.
    """
    wanted = calibration(store, id)
    with store.transaction() as db:
        row = db.get_one(CalibrationRow, wanted.id, with_for_update=True)
        if row.certified is None or row.revoked is not None or row.superseded is not None:
            state = _state(row, now())
            raise InputError(f"calibration {wanted.id}: is {state}; only what is certified, or has expired, is revoked")
        row.revoked, row.revoked_by, row.revoked_why = now(), by[:100], why
    return calibration(store, wanted.id)


def _refusal(id: str, judgement: Judgement) -> str:
    where = " ".join(part for part in (judgement.side, judgement.figure, judgement.place) if part)
    if judgement.value is None:
        return (
            f"calibration {id}: {where}: the calibration doesn't have it; capture what determines it, or take the "
            "limit out"
        )
    return (
        f"calibration {id}: {where} = {judgement.value:.6g} +- {judgement.std:.2g} is {judgement.mark}, good is "
        f"{judgement.limit.good_text}; "
        + (
            "find out why, or accept warnings"
            if judgement.mark == "warn"
            else "find out why and fit a new session; a bad one can't be accepted"
        )
    )


#: What a row of a history has of its calibration.
_LIFE = (
    CalibrationRow.created,
    CalibrationRow.certified,
    CalibrationRow.superseded,
    CalibrationRow.expires,
    CalibrationRow.revoked,
)


def history(
    store: Store,
    camera: str,
    figure: str,
    place: str = "",
    limits: CalibrationLimits | None = None,
    false_alarm_rate: float = FALSE_ALARM_RATE,
) -> History:
    """Return a figure of a camera over its calibrations. A session that was fitted again with the same outcome is
    entered
    once: by its newest fit, or by that which was certified.

    Each is compared with its reference as `compare` does, by the standard deviation of the difference, dark currents at
    the sensor temperature of the reference. The threshold is that at which an unchanged camera has any drift called in
    its whole history with the probability `false_alarm_rate` (Sidak). `limits`: by default those of the camera's newest
    certificate. Raises InputError where the camera or the figure isn't known."""
    register(store)
    of_figure = (FigureRow.camera == camera, FigureRow.name == figure, FigureRow.place == place)
    columns = (*FigureRow.__table__.columns, CalibrationRow.session_id, *_LIFE)
    asked = sa.select(*columns).join(CalibrationRow, CalibrationRow.id == FigureRow.calibration_id)
    asked = asked.where(*of_figure).order_by(CalibrationRow.created, CalibrationRow.id)
    certificates = sa.select(CalibrationRow.limits).join(FigureRow, CalibrationRow.id == FigureRow.calibration_id)
    certificates = certificates.where(
        *of_figure, CalibrationRow.certified.is_not(None), CalibrationRow.revoked.is_(None)
    )
    with store.reading() as db:
        rows = _once_a_session(db.execute(asked).all())
        stated = None if limits else db.scalars(certificates.order_by(CalibrationRow.certified.desc()).limit(1)).first()
    if not rows:
        raise InputError(
            f"{camera}: no calibration of it has the figure {figure!r} {place}".rstrip()
            + "; list the figures for their names"
        )
    if stated is not None:
        limits = CalibrationLimits.model_validate(stated)
    newest = _figure(rows[-1])
    limit = next((candidate for candidate in (limits.limit if limits else ()) if candidate.concerns(newest)), None)
    threshold = sigma_of_probability(sidak_part(false_alarm_rate, len(rows) - 1))
    return History(
        camera=camera,
        figure=figure,
        place=place,
        title=plain_name(figure, place),
        unit=newest.unit,
        limit=limit,
        false_alarm_rate=false_alarm_rate,
        threshold_sigma=threshold,
        points=tuple(_points(rows, limit, threshold)),
    )


def _once_a_session(rows: Sequence[Any]) -> list[Any]:
    """Return the rows, oldest first, less those that a later fit of the same session found again; what was certified
    stays."""
    newest = {(row.session_id, row.value, row.std): row.calibration_id for row in rows}
    return [
        row
        for row in rows
        if row.certified is not None or newest[row.session_id, row.value, row.std] == row.calibration_id
    ]


def _points(rows: Sequence[Any], limit: Limit | None, threshold_sigma: float) -> Iterator[HistoryPoint]:
    """Yield a point for each row, oldest first. The reference is the last one before that was ever certified, else the
    first."""
    at = now()
    reference = None
    for row in rows:
        figure = _figure(row)
        significance = None if reference is None else _significance(_figure(reference), figure)
        yield HistoryPoint(
            calibration_id=row.calibration_id,
            created=_aware(row.created) or at,
            state=_state(row, at),
            value=row.value,
            std=row.std,
            temperature_c=row.temperature_c,
            mark=None if limit is None else limit.judge(figure),
            reference_id=None if reference is None else reference.calibration_id,
            significance_sigma=significance,
            drifted=significance is not None and significance > threshold_sigma,
        )
        if reference is None or (row.certified is not None and row.revoked is None):
            reference = row


def _significance(a: Figure, b: Figure) -> float:
    """Of the difference of two figures in standard deviations, two-sided."""
    first, two = (
        ComparedNumbers(figure.name, np.array([figure.value]), np.array([figure.std]), sensor=figure.sensor)
        for figure in (a, b)
    )
    at_same_temperature, std = two.at_temperature_of(first)
    difference = float(at_same_temperature.value[0]) - a.value
    if std[0] == 0.0:
        return 0.0 if difference == 0.0 else sigma_of_probability(0.0)
    return sigma_of_probability(2.0 * float(special.ndtr(-abs(difference) / std[0])))


#: Calibrations that a board shows, the newest, unless it is told.
BOARD_COLUMNS = 20


def drift_board(
    store: Store,
    camera: str,
    limits: CalibrationLimits | None = None,
    *,
    reference_c: float | None = None,
    newest: int = BOARD_COLUMNS,
    false_alarm_rate: float = FALSE_ALARM_RATE,
) -> DriftBoard:
    """Return all figures of a camera by its `newest` calibrations, one of each session, and the one that is certified.

    A cell is judged and compared as in `history`. Dark currents are shown at `reference_c` (deg C), by default the
    median of the temperatures at which they were measured; a limit judges them as they were measured. Raises InputError
    where the camera isn't known."""
    register(store)
    columns = _board_columns(store, camera, newest)
    if not columns:
        raise InputError(f"{camera[:100]}: no calibration of it is known; list the figures for the cameras' names")
    ids = [row.id for row, _ in columns]
    with store.reading() as db:
        asked = sa.select(*FigureRow.__table__.columns, CalibrationRow.session_id, *_LIFE)
        asked = asked.join(CalibrationRow, CalibrationRow.id == FigureRow.calibration_id)
        asked = asked.where(FigureRow.camera == camera, FigureRow.calibration_id.in_(ids), _FITTED)
        rows: dict[tuple[str, str], list[Any]] = {}
        for row in db.execute(asked.order_by(CalibrationRow.created, CalibrationRow.id, FigureRow.id)):
            rows.setdefault((row.name, row.place), []).append(row)
    if limits is None:
        valid = [row for row, _ in columns if row.limits is not None and row.revoked is None]
        stated = max(valid, key=lambda row: _aware(row.certified) or now()).limits if valid else None
        limits = None if stated is None else CalibrationLimits.model_validate(stated)
    if reference_c is None:
        measured = [row.temperature_c for of in rows.values() for row in of if row.temperature_c is not None]
        reference_c = round(float(np.median(measured)), 1) if measured else None
    at = now()
    return DriftBoard(
        camera=camera,
        false_alarm_rate=false_alarm_rate,
        columns=tuple(
            BoardColumn(
                calibration_id=row.id,
                session_id=row.session_id,
                name=name or row.session_id,
                created=_aware(row.created) or at,
                state=_state(row, at),
            )
            for row, name in columns
        ),
        rows=tuple(
            _board_row(rows[name, place], ids, limits, reference_c, false_alarm_rate)
            for name, place in sorted(rows, key=lambda of: _board_order(of[0]))
        ),
    )


def _board_group(figure: str) -> BoardGroup:
    if figure.startswith("mtf "):
        return "mtf"
    return "key" if any(fnmatchcase(figure, name) for name in DRAFTED) else "other"


def _board_order(figure: str) -> tuple[int, int]:
    """Return where a figure stands on the board: by its group, and key figures as limits of them are drafted."""
    at = next((n for n, name in enumerate(DRAFTED) if fnmatchcase(figure, name)), len(DRAFTED))
    return ("key", "other", "mtf").index(group := _board_group(figure)), at if group == "key" else 0


def _board_columns(store: Store, camera: str, newest: int) -> list[tuple[CalibrationRow, str]]:
    """Return the camera's newest calibrations with their sessions' names, the oldest first: the newest of each session,
    and the newest of all that was certified."""
    has = sa.select(FigureRow.calibration_id).where(FigureRow.camera == camera)
    with store.reading() as db:
        rows = list(db.execute(_select_rows().where(CalibrationRow.id.in_(has)).order_by(CalibrationRow.created)))
    certified = [row.id for row, _ in rows if row.certified is not None and row.revoked is None]
    last = {row.session_id: row.id for row, _ in rows}
    kept = [of for of in rows if last[of[0].session_id] == of[0].id or of[0].certified is not None]
    shown = {row.id for row, _ in kept[-newest:]} | set(certified[-1:])
    return [of for of in kept if of[0].id in shown]


def _board_row(
    rows: Sequence[Any],
    ids: Sequence[str],
    limits: CalibrationLimits | None,
    reference_c: float | None,
    false_alarm_rate: float,
) -> BoardRow:
    """Return the board's row of one figure, of which `rows` has those calibrations that have it."""
    figure = _figure(rows[-1])
    limit = next((candidate for candidate in (limits.limit if limits else ()) if candidate.concerns(figure)), None)
    threshold = sigma_of_probability(sidak_part(false_alarm_rate, max(len(rows) - 1, 1)))
    known = reference_c is not None and figure.sensor is not None
    cells = {
        row.calibration_id: _cell(_figure(row), point, reference_c if known else None)
        for row, point in zip(rows, _points(rows, limit, threshold), strict=True)
    }
    return BoardRow(
        group=_board_group(figure.name),
        figure=figure.name,
        place=figure.place,
        title=plain_name(figure.name, figure.place),
        unit=figure.unit,
        limit=limit,
        reference_c=reference_c if known else None,
        law=f"doubles every {figure.sensor.doubling_c:.1f} ± {figure.sensor.doubling_c_std:.1f} °C"
        if known and figure.sensor is not None
        else "",
        cells=tuple(cells.get(id) for id in ids),
    )


def _cell(figure: Figure, point: HistoryPoint, reference_c: float | None) -> BoardCell:
    """Return a cell; a dark current whose temperature is known at `reference_c`, uncertain by the conversion, too."""
    value, std, corrected = point.value, point.std, False
    if reference_c is not None and figure.sensor is not None and figure.sensor.temperature_c is not None:
        doublings, doublings_std = figure.sensor.doublings(SensorTemperature(temperature_c=reference_c))
        factor = 2.0**doublings
        value, std, corrected = factor * value, factor * math.hypot(std, math.log(2.0) * doublings_std * value), True
    return BoardCell(
        value=value,
        std=std,
        corrected=corrected,
        mark=point.mark,
        significance_sigma=point.significance_sigma,
        drifted=point.drifted,
    )


#: Figures for which limits are drafted, by their names as a limit writes them, and which ends a drafted one has.
DRAFTED: dict[str, Literal["both", "low", "high"]] = {
    "noise conversion_gain_dn_per_e": "both",
    "noise read_noise_e": "high",
    "noise full_well_e": "low",
    "noise dsnu_e": "high",
    "noise prnu_percent": "high",
    "noise linearity_error_percent": "high",
    "noise dark_current_e_per_s": "high",
    "mtf * mtf50_cy_per_px": "low",
    "geometry camera_matrix": "both",
    "stereo baseline_mm": "both",
}
#: Calibrations from which limits are drafted: the newest earlier ones, so many at most, and with the calibration itself
#: where there are fewer than `DRAFTED_LEAST`.
DRAFTED_FROM, DRAFTED_LEAST = 30, 3
#: Probability that the next calibration of an unchanged camera lies within a drafted limit.
DRAFTED_COVERAGE = 1.0 - FALSE_ALARM_RATE


def draft_limits(store: Store, id: str) -> tuple[tuple[Limit, ...], tuple[str, ...]]:
    """Return limits drafted from what the cameras of a calibration had before it, and the ids of the calibrations that
    they were drafted from, the newest last.

    The ends are those of a prediction interval for the next calibration of an unchanged camera (Student's t, Hahn and
    Meeker 1991, section 4.8): mean +- t sqrt(s^2 (1 + 1/n)) with s at least the root mean square of the stated standard
    deviations, and from a single calibration that alone; widened by the two standard deviations with which a figure is
    judged. A draft says what is usual, not what a camera has to reach: somebody decides that."""
    wanted = calibration(store, id)
    rig = rig_of(wanted.cameras)
    asked = _select_rows().where(CalibrationRow.rig == rig, CalibrationRow.revoked.is_(None))
    with store.reading() as db:
        known = [row for row, _ in db.execute(asked.order_by(CalibrationRow.created))]
    last = {row.session_id: row.id for row in known}
    earlier = [
        row.id for row in known if last[row.session_id] == row.id and (_aware(row.created) or now()) < wanted.created
    ]
    ids = earlier[-DRAFTED_FROM:] if len(earlier) >= DRAFTED_LEAST else [*earlier, wanted.id]
    by_figure: dict[tuple[str, Side | None, str], list[Figure]] = {}
    for calibration_id in ids:
        for figure in figures(store, calibration_id):
            pattern = next((name for name in DRAFTED if fnmatchcase(figure.name, name)), None)
            if pattern is not None and (pattern != "geometry camera_matrix" or figure.place in ("fx", "fy")):
                by_figure.setdefault((figure.name, figure.side, figure.place), []).append(figure)
    drafted: dict[tuple[str, Side | None, str], tuple[float, float]] = {}
    for (name, side, place), history in by_figure.items():
        pattern = next(of for of in DRAFTED if fnmatchcase(name, of))
        low, high = _usual(history)
        before = drafted.get((pattern, side, place))
        drafted[pattern, side, place] = (low, high) if before is None else (min(low, before[0]), max(high, before[1]))
    return tuple(
        Limit(
            figure=pattern,
            side=side,
            place=place,
            good=(
                None if DRAFTED[pattern] == "high" else low,
                None if DRAFTED[pattern] == "low" else high,
            ),
        )
        for (pattern, side, place), (low, high) in sorted(
            drafted.items(), key=lambda item: ([*DRAFTED].index(item[0][0]), str(item[0][1]), item[0][2])
        )
    ), tuple(ids)


def _usual(history: Sequence[Figure]) -> tuple[float, float]:
    """Between which values the next one of an unchanged camera lies, with the interval in which it is judged."""
    values = np.array([figure.value for figure in history])
    std = math.sqrt(float(np.mean([figure.std**2 for figure in history])))
    n = values.size
    spread = max(float(values.std(ddof=1)) if n > 1 else 0.0, std)
    quantile = (
        stats.t.ppf((1.0 + DRAFTED_COVERAGE) / 2.0, n - 1) if n > 2 else stats.norm.ppf((1.0 + DRAFTED_COVERAGE) / 2.0)
    )
    half = float(quantile) * spread * math.sqrt(1.0 + 1.0 / n) + COVERAGE_FACTOR * std
    mean = float(values.mean())
    half = half or 1e-3 * abs(mean) or 1e-9  # without a stated or a seen spread: the fourth digit
    step = 10.0 ** (math.floor(math.log10(half)) - 1)  # the ends are rounded outwards, to two digits of the half
    digits = max(0, -round(math.log10(step)))
    return round(math.floor((mean - half) / step) * step, digits), round(math.ceil((mean + half) / step) * step, digits)
