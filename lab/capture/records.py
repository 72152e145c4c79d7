"""Records of the store: sessions, captures, results, files and steps."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

from pydantic import ConfigDict

from lab.capture_kinds.base import Step
from lab.formats.recording_set import InstrumentSnapshot
from sim.camera import Side
from sim.parameters import Frozen

SessionState = Literal["created", "queued", "running", "paused", "interrupted", "failed", "finished"]
JobState = Literal["queued", "running", "done", "failed", "cancelled"]
Role = Literal["frame", "spectrum", "target"]


class _Record(Frozen):
    model_config = ConfigDict(frozen=True, extra="forbid", from_attributes=True)


class SessionInfo(_Record):
    """A session as the registry has it."""

    id: str
    name: str
    notes: str
    created: datetime
    closed: datetime | None
    state: SessionState
    error: str | None
    packed: bool
    demands_certified: bool = False
    steps: int
    steps_done: int


class CaptureInfo(_Record):
    """A capture as the registry has it; `document`: its entry in a manifest."""

    id: int
    session_id: str
    name: str
    kind: str
    side: str
    document: dict[str, Any]


class ResultInfo(_Record):
    """A stored result; `document`: as in `docs/reference/results.md`."""

    id: str
    job_id: str | None
    source: str
    kind: str
    created: datetime
    document: dict[str, Any]


class RunRecord(Frozen):
    """Provenance of one run of a session: when, after how many finished steps, with which instruments and versions.

    `changes`: what differs of the instruments from the run before, which was of the session `compared_with`.
    """

    started: datetime
    steps_done: int = 0
    instruments: dict[str, InstrumentSnapshot]
    versions: dict[str, str]
    compared_with: str = ""
    changes: tuple[str, ...] = ()


@dataclass(frozen=True)
class SessionDetails:
    """A session with what its station calls itself, and its runs in their order."""

    info: SessionInfo
    station: str
    runs: tuple[RunRecord, ...]


@dataclass(frozen=True)
class StoredFile:
    """A file of a session on the disk: its path in the session, SHA-256 and size; `side`: of a frame."""

    role: Role
    path: str
    sha256: str
    bytes: int
    side: Side | None = None


@dataclass(frozen=True)
class JournalEntry:
    """A step of the journal and its result; `finished` None: still to do."""

    step: Step
    finished: datetime | None
    result: dict[str, Any]


def now() -> datetime:
    """Return the time, UTC.

    >>> now().tzname()
    'UTC'
    """
    return datetime.now(UTC)
