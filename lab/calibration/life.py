"""The registry of calibrations: what each is, who certified it against which limits, until when, and how its figures
drift.

Every fit of a session is a calibration of the session's cameras, which are known by what they report: maker, model and
serial number. It is a **candidate** until somebody certifies it against limits, **certified** then, **superseded** when
a later one of the same cameras is certified, and **expired** when its time is over.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

import numpy as np
import sqlalchemy as sa
from scipy import special

from lab.calibration.figures import Figure, figures_of
from lab.calibration.limits import CalibrationLimits, Judgement, Limit, Mark, judged
from lab.capture.records import RunRecord, now
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture.tables import CalibrationRow, FigureRow, ResultRow, SessionRow
from lab.errors import InputError
from lab.fit.compare import FALSE_ALARM_RATE, Numbers, sidak_part, sigma_of_probability
from lab.fit.noise.dark_current import SensorTemperature
from lab.formats.recording_set import InstrumentSnapshot, Snapshots, differences
from lab.formats.results import FitResult
from lab.formats.results.figure_names import plain_name
from sim.camera import Side
from sim.parameters import Frozen

#: Fits that are entered as calibrations in one transaction.
TOGETHER = 100
CalibrationState = Literal["candidate", "certified", "superseded", "expired"]


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


class History(Frozen):
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


# --- cameras ----------------------------------------------------------------------------------------------------------


def cameras_of(instruments: Snapshots, station: Station) -> dict[Side, str]:
    """Name of each camera of a run: maker, model and serial number as it reports them. Without a serial number it is
    known by its station and side."""
    found: dict[Side, str] = {}
    for side in station.sides:
        one = instruments.get(f"camera {side}", InstrumentSnapshot())
        parts = [one.maker, one.model, one.serial_number]
        where = [] if parts[2] else [f"({side} of {station.name or 'a station'})"]
        found[side] = " ".join([part for part in parts if part] + where)
    return found


def rig_of(cameras: Mapping[Side, str]) -> str:
    """The rig of these cameras: a calibration of it supersedes an earlier one of the same."""
    return json.dumps(dict(sorted(cameras.items())))


def check_certified(store: Store, instruments: Snapshots, station: Station) -> None:
    """Raises InputError unless the rig of these cameras has a certified calibration that isn't expired, of which they
    have the settings."""
    register(store)
    cameras = cameras_of(instruments, station)
    asked = _asked().order_by(CalibrationRow.created.desc())
    with store.reading() as db:
        of_rig = db.execute(asked.where(CalibrationRow.rig == rig_of(cameras)))
        found = [_calibration(row, name) for row, name in of_rig]
        others = [_calibration(row, name) for row, name in ([] if found else db.execute(asked))]
    for one in found:
        if one.state == "certified":
            _check_settings(store, one, instruments, cameras)
            return
    expired = [one for one in found if one.state == "expired"]
    why = (
        f"its certified calibration {expired[0].id} expired on {expired[0].expires:%Y-%m-%d}"
        if expired and expired[0].expires
        else f"{len(found)} calibrations of it are known, none is certified"
    )
    for other in [one for one in others if one.state == "certified" and one.cameras.keys() == cameras.keys()][:1]:
        changed = [
            f"{side} was {was}, is {cameras[side]}" for side, was in other.cameras.items() if was != cameras[side]
        ]
        why += f" (the newest certified one, {other.id}, is of other cameras: {'; '.join(changed)})"
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
        found = [_calibration(*row) for row in db.execute(_asked().where(CalibrationRow.session_id == session_id))]
    for one in found:
        if one.state == "certified":
            raise InputError(
                f"session {session_id}: the certified calibration {one.id} rests on it; its captures are kept until "
                "that is "
                "superseded or expired"
            )


# --- registering ------------------------------------------------------------------------------------------------------


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
        entries = [_entry(*found) for found in db.execute(asked)]
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
    """The rows of a calibration and of its figures."""
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


# --- reading ----------------------------------------------------------------------------------------------------------


def _aware(at: datetime | None) -> datetime | None:
    return at.replace(tzinfo=UTC) if at is not None and at.tzinfo is None else at


def _state(row: Any, at: datetime) -> CalibrationState:
    if row.certified is None:
        return "candidate"
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
        limits=None if row.limits is None else CalibrationLimits.model_validate(row.limits),
        judgements=tuple(Judgement.model_validate(one) for one in row.judgements or ()),
    )


def _asked() -> Any:
    """Calibrations with their sessions' names; a session that was deleted has its id for one."""
    name = sa.func.coalesce(SessionRow.name, CalibrationRow.session_id)
    return sa.select(CalibrationRow, name).outerjoin(SessionRow, SessionRow.id == CalibrationRow.session_id)


def calibrations(store: Store, after: str | None = None, limit: int | None = None) -> list[CalibrationRecord]:
    """Calibrations, the newest first: `limit` at most, those that follow the calibration `after` in this order."""
    register(store)
    asked = _asked().order_by(CalibrationRow.created.desc(), CalibrationRow.id.desc()).limit(limit)
    with store.reading() as db:
        if after is not None:
            last = db.get(CalibrationRow, after)
            if last is None:
                raise InputError(f"calibration {after!r} isn't known; list the calibrations for their ids")
            asked = asked.where(sa.tuple_(CalibrationRow.created, CalibrationRow.id) < sa.tuple_(last.created, last.id))
        return [_calibration(row, name) for row, name in db.execute(asked)]


def count_calibrations(store: Store) -> int:
    """How many calibrations there are."""
    register(store)
    with store.reading() as db:
        return db.scalars(sa.select(sa.func.count()).select_from(CalibrationRow)).one()


def calibration(store: Store, id: str) -> CalibrationRecord:
    """One calibration, by its own id or by its session's: the newest of that. Raises InputError where there is none."""
    register(store)
    wanted = _asked().where(sa.or_(CalibrationRow.id == id, CalibrationRow.session_id == id))
    with store.reading() as db:
        found = db.execute(wanted.order_by(CalibrationRow.created.desc())).first()
    if found is None:
        raise InputError(f"calibration {id!r} isn't known; `calibench calibrations list` lists those that are")
    return _calibration(*found)


def _figure(row: Any) -> Figure:
    """The figure of a row, which has the columns of `FigureRow`."""
    sensor = None
    if row.doubling_c is not None:
        sensor = SensorTemperature.model_validate({name: getattr(row, name) for name in SensorTemperature.model_fields})
    return Figure(name=row.name, side=row.side, place=row.place, value=row.value, std=row.std, sensor=sensor)


def figures(store: Store, calibration_id: str) -> tuple[Figure, ...]:
    """The figures of a calibration."""
    asked = sa.select(FigureRow).where(FigureRow.calibration_id == calibration_id).order_by(FigureRow.id)
    with store.reading() as db:
        return tuple(_figure(row) for row in db.scalars(asked))


def figure_names(store: Store) -> list[tuple[str, str, str]]:
    """(camera, figure, place) of every history."""
    register(store)
    asked = sa.select(FigureRow.camera, FigureRow.name, FigureRow.place).distinct()
    with store.reading() as db:
        return [(camera, name, place) for camera, name, place in sorted(db.execute(asked))]


# --- certifying -------------------------------------------------------------------------------------------------------


def certify(
    store: Store, id: str, by: str, limits: CalibrationLimits, *, accept_warnings: bool = False
) -> CalibrationRecord:
    """Certify a calibration against `limits`; what the same cameras had before is superseded.

    Raises InputError, a line for each, for figures that are bad or missing, and for those in the warning band unless
    `accept_warnings`; and where it is certified or superseded already.
    """
    wanted = calibration(store, id)
    if wanted.state != "candidate":
        raise InputError(
            f"calibration {wanted.id}: is {wanted.state}, only a candidate can be certified; fit the session again"
        )
    found = judged(figures(store, wanted.id), limits)
    refused = ("bad", "missing") if accept_warnings else ("warn", "bad", "missing")
    if lines := [_refusal(wanted.id, one) for one in found if one.mark in refused]:
        raise InputError("\n".join(lines))
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
        for one in earlier:
            one.superseded, one.superseded_by = at, row.id
        row.certified, row.certified_by = at, by[:100]
        row.limits = limits.model_dump(mode="json")
        row.judgements = [one.model_dump(mode="json") for one in found]
        row.expires = None if limits.valid_days is None else at + timedelta(days=limits.valid_days)
    return calibration(store, wanted.id)


def _refusal(id: str, one: Judgement) -> str:
    where = " ".join(part for part in (one.side, one.figure, one.place) if part)
    if one.value is None:
        return (
            f"calibration {id}: {where}: the calibration doesn't have it; capture what determines it, or take the "
            "limit out"
        )
    return (
        f"calibration {id}: {where} = {one.value:.6g} +- {one.std:.2g} is {one.mark}, good is {one.limit.good_text}; "
        + (
            "find out why, or accept warnings"
            if one.mark == "warn"
            else "find out why and fit a new session; a bad one can't be accepted"
        )
    )


# --- history ----------------------------------------------------------------------------------------------------------


def history(
    store: Store,
    camera: str,
    figure: str,
    place: str = "",
    limits: CalibrationLimits | None = None,
    false_alarm_rate: float = FALSE_ALARM_RATE,
) -> History:
    """A figure of a camera over its calibrations. A session that was fitted again with the same outcome is entered
    once: by its newest fit, or by that which was certified.

    Each is compared with its reference as `compare` does, by the standard deviation of the difference, dark currents at
    the sensor temperature of the reference. The threshold is that at which
    an unchanged camera has any drift called in its whole history with the probability `false_alarm_rate` (Sidak).
    `limits`: by default those of the camera's newest certificate. Raises InputError where the camera or the figure
    isn't known."""
    register(store)
    of_figure = (FigureRow.camera == camera, FigureRow.name == figure, FigureRow.place == place)
    life = (CalibrationRow.created, CalibrationRow.certified, CalibrationRow.superseded, CalibrationRow.expires)
    columns = (*FigureRow.__table__.columns, CalibrationRow.session_id, *life)
    asked = sa.select(*columns).join(CalibrationRow, CalibrationRow.id == FigureRow.calibration_id)
    asked = asked.where(*of_figure).order_by(CalibrationRow.created, CalibrationRow.id)
    certificates = sa.select(CalibrationRow.limits).join(FigureRow, CalibrationRow.id == FigureRow.calibration_id)
    certificates = certificates.where(*of_figure, CalibrationRow.certified.is_not(None))
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
    one = _figure(rows[-1])
    limit = next((found for found in (limits.limit if limits else ()) if found.concerns(one)), None)
    threshold = sigma_of_probability(sidak_part(false_alarm_rate, len(rows) - 1))
    return History(
        camera=camera,
        figure=figure,
        place=place,
        title=plain_name(figure, place),
        unit=one.unit,
        limit=limit,
        false_alarm_rate=false_alarm_rate,
        threshold_sigma=threshold,
        points=tuple(_points(rows, limit, threshold)),
    )


def _once_a_session(rows: Sequence[Any]) -> list[Any]:
    """The rows, oldest first, less those that a later fit of the same session found again; what was certified stays."""
    newest = {(row.session_id, row.value, row.std): row.calibration_id for row in rows}
    return [
        row
        for row in rows
        if row.certified is not None or newest[row.session_id, row.value, row.std] == row.calibration_id
    ]


def _points(rows: Sequence[Any], limit: Limit | None, threshold_sigma: float) -> Iterator[HistoryPoint]:
    """A point for each row, oldest first. The reference is the last one before that was ever certified, else the
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
        if reference is None or row.certified is not None:
            reference = row


def _significance(a: Figure, b: Figure) -> float:
    """Of the difference of two figures in standard deviations, two-sided."""
    one, two = (
        Numbers(figure.name, np.array([figure.value]), np.array([figure.std]), sensor=figure.sensor)
        for figure in (a, b)
    )
    beside, std = two.beside(one)
    difference = float(beside.value[0]) - a.value
    if std[0] == 0.0:
        return 0.0 if difference == 0.0 else sigma_of_probability(0.0)
    return sigma_of_probability(2.0 * float(special.ndtr(-abs(difference) / std[0])))
