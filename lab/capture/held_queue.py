"""Holds on queued sessions, as the registry has them."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from lab.capture.station import Station
from lab.capture.tables import SessionRow

#: Prefix of the reason of a hold in the registry.
HELD = "held: "


def hold_queue(db: Session, why: str, station: dict[str, Any] | None = None) -> None:
    """Hold the queued sessions that need an instrument of `station` (as the registry has it); None: all queued
    sessions."""
    addresses = None if station is None else Station.model_validate(station).addresses
    for row in waiting_rows(db):
        if addresses is None or addresses & Station.model_validate(row.station).addresses:
            row.error = f"{HELD}{why}"


def release_held_by(db: Session, session_id: str) -> None:
    """Release the sessions that this one held, once it has finished."""
    for row in waiting_rows(db):
        if row.error is not None and row.error.startswith(f"{HELD}session {session_id} "):
            row.error = None


def waiting_rows(db: Session) -> list[SessionRow]:
    """Return the rows of the queued sessions in their order."""
    asked = sa.select(SessionRow).where(SessionRow.queue_place.is_not(None))
    return list(db.scalars(asked.order_by(SessionRow.queue_place, SessionRow.created)))
