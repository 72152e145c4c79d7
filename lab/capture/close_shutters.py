"""The first step of a start: close the shutters of stations whose session ended by a crash.

It needs the standard library and the monochromator's driver alone, less than a tenth of a second of CPU, where the command line's and the
registry's own libraries take most of a second: on a busy computer that is several seconds of light. `lab.capture.recovery` then does the whole work: all instruments,
the reason, the session's state. A registry that isn't SQLite is left to it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sqlite3
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from drivers.registry import driver
from lab.capture.file_lock import Lock

log = logging.getLogger(__name__)
#: Longest time (s) that a registry which is locked is waited for.
REGISTRY_S = 1.0
#: How long (s) the start waits for the shutters.
SHUTTERS_S = 3.0


class Closing:
    """The monochromators of all sessions that are recorded as under way and that no process runs, being stopped in a thread each: motion ends, the
    shutter closes. Raises nothing: what doesn't succeed here is tried again, and told, by the recovery. `tell`: called with the id of each session
    whose shutter is closed, by its thread."""

    def __init__(self, data: Path, tell: Callable[[str], None] = lambda _: None) -> None:
        self._closed: list[str] = []
        self._tell = tell
        self._works: list[tuple[threading.Thread, threading.Event]] = []
        for session_id, station in _under_way(data / "registry.sqlite"):
            asked = threading.Event()
            of = (data, session_id, station, asked, self._told)
            work = threading.Thread(target=_close, args=of, daemon=True, name="shutter")
            work.start()
            self._works.append((work, asked))

    def _told(self, session_id: str) -> None:
        self._closed.append(session_id)
        self._tell(session_id)

    def asked(self, patience_s: float) -> None:
        """Wait, for `patience_s` at most, until every shutter was asked to close, or gave no way to."""
        until = time.monotonic() + patience_s
        for _, asked in self._works:
            asked.wait(max(0.0, until - time.monotonic()))

    def closed(self, patience_s: float) -> list[str]:
        """Wait, for `patience_s` at most, until they have said that they are closed; the ids of their sessions."""
        until = time.monotonic() + patience_s
        for work, _ in self._works:
            work.join(max(0.0, until - time.monotonic()))
        return list(self._closed)


_at_start: list[Closing] = []


def close_at_start(arguments: Sequence[str]) -> None:
    """What `calibench serve ARGUMENTS` does first: ask the shutters of its data folder's sessions that ended by a crash to close, and say when they
    are. While they answer, the service may be loaded; `closed_at_start` waits for them."""
    if "CALIBENCH_DATABASE_URL" in os.environ:
        return
    data = os.environ.get("CALIBENCH_DATA", "calibench-data")
    for given, following in zip(arguments, [*arguments[1:], ""], strict=True):
        name, is_joined, value = given.partition("=")
        if name == "--data":
            data = value if is_joined else following
    _at_start.append(closing := Closing(Path(data), _say))
    closing.asked(SHUTTERS_S)


def _say(session_id: str) -> None:
    said = f"session {session_id}: its process ended without a word; its shutter was closed"
    print(said, file=sys.stderr, flush=True)


def closed_at_start() -> list[str]:
    """The ids of the sessions whose shutters `close_at_start` closed. To be called before somebody else speaks to the same instruments."""
    return [session_id for closing in _at_start for session_id in closing.closed(SHUTTERS_S)]


def _under_way(registry: Path) -> list[tuple[str, dict[str, Any]]]:
    """(session, its station's document) of those that are recorded as running or paused."""
    if not registry.is_file():
        return []
    try:
        with contextlib.closing(sqlite3.connect(registry, timeout=REGISTRY_S)) as db:
            rows = db.execute("SELECT id, station FROM sessions WHERE state IN ('running', 'paused')").fetchall()
        return [(session_id, json.loads(station)) for session_id, station in rows]
    except (sqlite3.Error, ValueError):  # an older revision, another file: the recovery says what
        log.debug("%s: not read", registry, exc_info=True)
        return []


def _close(
    data: Path, session_id: str, station: dict[str, Any], asked: threading.Event, told: Callable[[str], None]
) -> None:
    entry = station.get("monochromator")
    # No shutter, or the session's process lives. The lock isn't kept: the recovery takes it while an instrument that doesn't answer is
    # still waited for here.
    if not entry or Lock(data / "sessions" / session_id / ".lock").is_held():
        asked.set()
        return
    try:
        settings = {key: value for key, value in entry.items() if key not in ("driver", "address")}
        monochromator = driver("monochromator", entry["driver"])(entry["address"], **settings)
        if monochromator.shut_at_once():
            asked.set()
        monochromator.connect()
        try:
            monochromator.stop()
            told(session_id)
        finally:
            monochromator.close()
    except Exception:
        log.debug("session %s: its shutter wasn't closed", session_id, exc_info=True)
    finally:
        asked.set()
