"""Sessions at a glance: what each calibrated, how sharp and how quiet its cameras were, what its diagnosis said."""

from __future__ import annotations

import functools
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from lab.calibration.life import register
from lab.capture.store import Store
from lab.capture.tables import CalibrationRow, FigureRow, ResultRow, SessionRow
from lab.formats.results.diagnosis import DiagnosisVerdict
from sim.camera import Side
from sim.parameters import Frozen

#: Figures that stand in a list: their field here, and the names of their figures (SQL's LIKE). MTF50 is green's, or of
#: a camera without colours; the mean over a session's edges is told.
_SHOWN = {
    "mtf50_cy_per_px": ("mtf % G mtf50_cy_per_px", "mtf % Y mtf50_cy_per_px"),
    "read_noise_e": ("noise read_noise_e",),
}
_TAG = re.compile(r"(?<!\w)#(\w[\w-]*)")


class SessionOverview(Frozen):
    """One session. `cameras`: by side, what each reports. `calibration_id`: of its newest fit. `mtf50_cy_per_px`,
    `read_noise_e`: by side, of that. `verdict`: of its newest diagnosis."""

    station: str = ""
    cameras: dict[Side, str] = {}
    calibration_id: str | None = None
    mtf50_cy_per_px: dict[Side, float] = {}
    read_noise_e: dict[Side, float] = {}
    verdict: DiagnosisVerdict | None = None


def tags_of(notes: str) -> tuple[str, ...]:
    """Return the tags of a session: the words of its notes that begin with #, each once, without it.

    >>> tags_of("new lens #wide, again #wide #cold")
    ('wide', 'cold')
    """
    return tuple(dict.fromkeys(_TAG.findall(notes)))


@functools.lru_cache(maxsize=20_000)
def verdict_of(store: Store, diagnosis: str) -> DiagnosisVerdict:
    """Return the verdict of a kept diagnosis, which never changes, and is long."""
    with store.reading() as db:
        verdict = db.scalars(
            sa.select(ResultRow.document["verdict"].as_string()).where(ResultRow.id == diagnosis)
        ).one()
    return verdict


def _diagnoses(store: Store, sessions: Sequence[str] | None) -> dict[str, DiagnosisVerdict]:
    """Session -> what its newest diagnosis said, of some sessions or all."""
    asked = sa.select(ResultRow.source, ResultRow.id).where(ResultRow.kind == "diagnose").order_by(ResultRow.created)
    with store.reading() as db:
        rows = db.execute(asked if sessions is None else asked.where(ResultRow.source.in_(sessions))).all()
    newest = {source: id for source, id in rows}  # noqa: C416  (rows, not pairs, to a type checker)
    return {source: verdict_of(store, id) for source, id in newest.items()}


def sessions_of_verdict(store: Store, verdict: DiagnosisVerdict) -> list[str]:
    """Return the ids of the sessions (and folders of recordings) whose newest diagnosis said this."""
    return [source for source, its_verdict in _diagnoses(store, None).items() if its_verdict == verdict]


def overviews(store: Store, sessions: Sequence[str]) -> dict[str, SessionOverview]:
    """Return what a list shows of each session, by id."""
    register(store)
    of_sessions = sa.select(SessionRow.id, SessionRow.station["name"].as_string(), SessionRow.runs)
    fits = sa.select(CalibrationRow.session_id, CalibrationRow.id, CalibrationRow.cameras)
    fits = fits.where(CalibrationRow.session_id.in_(sessions)).order_by(CalibrationRow.created)
    with store.reading() as db:
        kept = list(db.execute(of_sessions.where(SessionRow.id.in_(sessions))))
        newest = {session: (id, cameras) for session, id, cameras in db.execute(fits)}
        ids = [id for id, _ in newest.values()]
        figures = {name: _means(db, ids, patterns) for name, patterns in _SHOWN.items()}
    verdicts = _diagnoses(store, sessions)
    overviews = {}
    for session, station, runs in kept:
        id, cameras = newest.get(session, (None, _list_reported(runs)))
        shown: dict[str, Any] = {name: of.get(id or "", {}) for name, of in figures.items()}
        overviews[session] = SessionOverview(
            station=station or "", cameras=cameras, calibration_id=id, verdict=verdicts.get(session), **shown
        )
    return overviews


def _means(db: Any, calibrations: Sequence[str], patterns: Sequence[str]) -> dict[str, dict[str, float]]:
    """Calibration -> side -> mean of the figures of these names."""
    asked = sa.select(FigureRow.calibration_id, FigureRow.side, sa.func.avg(FigureRow.value))
    asked = asked.where(FigureRow.calibration_id.in_(calibrations), FigureRow.side.is_not(None))
    asked = asked.where(sa.or_(*(FigureRow.name.like(pattern) for pattern in patterns)))
    figures: dict[str, dict[str, float]] = defaultdict(dict)
    for id, side, mean in db.execute(asked.group_by(FigureRow.calibration_id, FigureRow.side)):
        figures[id][side] = mean
    return figures


def _list_reported(runs: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the cameras of a session's last run as they reported themselves, by side."""
    instruments: Mapping[str, Mapping[str, str]] = runs[-1]["instruments"] if runs else {}
    return {
        name.removeprefix("camera "): " ".join(
            part for key in ("maker", "model", "serial_number") if (part := identity.get(key, ""))
        )
        for name, identity in instruments.items()
        if name.startswith("camera ")
    }
