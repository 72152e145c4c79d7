"""The first step of a start: close the shutters of stations whose session ended by a crash.

It needs the standard library and the monochromator's driver alone, a tenth of a second of CPU, where the registry's own libraries take
more than half a second: on a busy computer that is several seconds of light. `lab.capture.recovery` then does the whole work: all instruments,
the reason, the session's state. A registry that isn't SQLite is left to it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sqlite3
import threading
import time
from pathlib import Path
from typing import Any

from drivers.registry import driver
from lab.capture.file_lock import Lock

log = logging.getLogger(__name__)
#: Longest time (s) that a registry which is locked is waited for.
REGISTRY_S = 1.0


def close_shutters(data: Path, patience_s: float) -> list[str]:
    """Stop the monochromator of every session that is recorded as under way and that no process runs: motion ends, the shutter closes.

    Waits for them for `patience_s` at most. Returns the ids of the sessions whose shutter is closed. Raises nothing: what doesn't succeed here is
    tried again, and told, by the recovery.
    """
    closed: list[str] = []
    threads = []
    for session_id, station in _under_way(data / "registry.sqlite"):
        work = threading.Thread(target=_close, args=(data, session_id, station, closed), daemon=True, name="shutter")
        work.start()
        threads.append(work)
    until = time.monotonic() + patience_s
    for work in threads:
        work.join(max(0.0, until - time.monotonic()))
    return list(closed)


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


def _close(data: Path, session_id: str, station: dict[str, Any], closed: list[str]) -> None:
    entry = station.get("monochromator")
    # No shutter, or the session's process lives. The lock isn't kept: the recovery takes it while an instrument that doesn't answer is
    # still waited for here.
    if not entry or Lock(data / "sessions" / session_id / ".lock").is_held():
        return
    try:
        settings = {key: value for key, value in entry.items() if key not in ("driver", "address")}
        monochromator = driver("monochromator", entry["driver"])(entry["address"], **settings)
        monochromator.connect()
        try:
            monochromator.stop()
            closed.append(session_id)
        finally:
            monochromator.close()
    except Exception:
        log.debug("session %s: its shutter wasn't closed", session_id, exc_info=True)
