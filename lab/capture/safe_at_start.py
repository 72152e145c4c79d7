"""The first step of a start: make the stations safe whose session ended by a crash.

The shutter comes first. Closing it needs the standard library and the monochromator's driver alone, less than a tenth
of a second of CPU. Then the other instruments are stopped, whose drivers need half a second of it. The command line's
and the registry's own libraries take as long again, and the service two seconds more: on a busy computer that is many
seconds of light. `lab.capture.recovery` then records what happened, and looks after what wasn't reached here. A
registry that isn't SQLite is left to it.
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
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from drivers.found_settings import FoundSettings, making_safe
from drivers.registry import driver
from lab.capture.file_lock import Lock
from lab.plain_text import escaped

log = logging.getLogger(__name__)
#: Longest time (s) that a registry which is locked is waited for.
REGISTRY_S = 1.0
#: How long (s) the start waits for the shutters to be asked, and for all instruments to answer.
SHUTTERS_S, INSTRUMENTS_S = 3.0, 3.0
#: Keys of an instrument's table in a station file that its driver isn't given.
_NOT_ITS_DRIVERS = ("driver", "address", "datasheet", "quantum_efficiency", "lights")
#: The families after the monochromator's, those first whose drivers load fast; with the cameras in their place.
_OTHERS = ("light_source", "display", "stage", "cameras", "photodiode", "spectroradiometer")


class _Station:
    """A session's station: its instruments being stopped, each by a thread of its own."""

    def __init__(self, session_id: str, document: dict[str, Any], lock: Lock, tell: Callable[[str], None]) -> None:
        self.session_id, self.lock = session_id, lock
        self.shutter_asked = threading.Event()
        self._document, self._tell = document, tell
        self._threads: list[threading.Thread] = []
        others = [entry["address"] for _, entry in self._entries(*_OTHERS)]
        self.addresses = {*others, *(entry["address"] for _, entry in self._entries("monochromator"))}
        self._left = 1 + len(
            others
        )  # instruments that aren't safe yet; a station without a monochromator counts it, too
        self._counting = threading.Lock()

    def close_shutter(self) -> None:
        """Stop the monochromator, by a thread; `shutter_asked` tells when it was asked, or gave no way to."""
        for _, entry in self._entries("monochromator"):
            self._start(self._close_shutter, entry)
            return
        self._is_safe()
        self.shutter_asked.set()

    def stop_others(self) -> None:
        """Stop the other instruments. Their drivers are loaded here, one after the other: threads that import the same
        modules can disturb each other."""
        for family, entry in self._entries(*_OTHERS):
            try:
                instrument = driver(family, entry["driver"])(entry["address"], **_settings(entry))
            except Exception:
                log.debug("session %s: no driver of its %s", self.session_id, family, exc_info=True)
            else:
                self._start(self._stop, instrument)

    def is_safe(self, until_s: float) -> bool:
        """Wait, until `time.monotonic()` is `until_s` at most, for the instruments; whether all are safe."""
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))
        return self._left == 0 and not any(thread.is_alive() for thread in self._threads)

    def _entries(self, *families: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """(family, table) of its instruments. Those without an address are people, whom nothing stops."""
        for family in families:
            table = self._document.get(family) or {}
            every = [("camera", camera) for camera in table.values()] if family == "cameras" else [(family, table)]
            yield from ((name, entry) for name, entry in every if entry.get("address"))

    def _start(self, work: Callable[[Any], None], of: object) -> None:
        thread = threading.Thread(target=work, args=(of,), daemon=True, name="safe at start")
        self._threads.append(thread)
        thread.start()

    def _close_shutter(self, entry: dict[str, Any]) -> None:
        try:
            monochromator = driver("monochromator", entry["driver"])(entry["address"], **_settings(entry))
            if monochromator.shut_at_once():
                self.shutter_asked.set()
            message = f"session {self.session_id}: its process ended without a word; its shutter was closed"
            self._stop(monochromator, message)
        except Exception:
            log.debug("session %s: its shutter wasn't closed", self.session_id, exc_info=True)
        finally:
            self.shutter_asked.set()

    def _stop(self, instrument: Any, message: str = "") -> None:
        try:
            with contextlib.ExitStack() as whatever_the_disk_does:
                whatever_the_disk_does.enter_context(making_safe())
                whatever_the_disk_does.callback(instrument.close)
                instrument.connect()
                instrument.stop()
                if message:
                    _check_shut(instrument)
                    self._tell(message)
            self._is_safe()
        except Exception:
            log.debug("session %s: an instrument wasn't made safe", self.session_id, exc_info=True)

    def _is_safe(self) -> None:
        with self._counting:
            self._left -= 1
            if self._left == 0:
                self._tell(f"session {self.session_id}: its station was made safe")


class Rescue:
    """The stations of all sessions that are recorded as under way and that no process runs, being made safe: motion
    ends, shutters close, screens go dark.

    Raises nothing: what doesn't succeed here is tried again, and reported, by the recovery. `tell`: called with a line
    where a shutter is closed, and where a whole station is safe.
    """

    def __init__(self, data: Path, tell: Callable[[str], None] = lambda _: None) -> None:
        FoundSettings.keep_in(data / "instruments")
        self._stations: list[_Station] = []
        taken: set[str] = set()
        for session_id, document in _under_way(data / "registry.sqlite"):
            lock = Lock(data / "sessions" / session_id / ".lock")
            try:
                if not lock.acquire(patience_s=0.0):  # its process lives
                    continue
                station = _Station(session_id, document, lock, tell)
                if taken.isdisjoint(station.addresses):  # two at one instrument would garble each other's words
                    self._stations.append(station)
                    taken |= station.addresses
                else:
                    lock.release()
            except Exception:
                log.debug("session %s: its station wasn't looked after", session_id, exc_info=True)
                lock.release()
        for station in self._stations:
            station.close_shutter()

    def stop_others(self, patience_s: float) -> None:
        """Wait, for `patience_s` at most, until every shutter was asked to close, then have all other instruments
        stopped."""
        until_s = time.monotonic() + patience_s
        for station in self._stations:
            station.shutter_asked.wait(max(0.0, until_s - time.monotonic()))
        for station in self._stations:
            station.stop_others()

    def wait_until_safe(self, patience_s: float) -> dict[str, Lock]:
        """Wait, for `patience_s` at most, for the instruments. The sessions whose stations are safe, with their locks,
        which are held; those of the others are released, as the recovery takes them while an instrument that doesn't
        answer is still waited for here."""
        until_s = time.monotonic() + patience_s
        safe: dict[str, Lock] = {}
        for station in self._stations:
            if station.is_safe(until_s):
                safe[station.session_id] = station.lock
            else:
                station.lock.release()
        self._stations = []
        return safe


_at_start: list[Rescue] = []


def make_safe_at_start(arguments: Sequence[str]) -> None:
    """Make the stations safe whose sessions ended by a crash, and report when they are: what `calibench serve` does
    first.

    arguments : of `calibench serve`, for the data folder

    While the instruments answer, the service may be loaded; `wait_until_safe_at_start` waits for them.
    """
    if "CALIBENCH_DATABASE_URL" in os.environ:
        return
    data = os.environ.get("CALIBENCH_DATA", "calibench-data")
    for given, following in zip(arguments, [*arguments[1:], ""], strict=True):
        name, is_joined, value = given.partition("=")
        if name == "--data":
            data = value if is_joined else following
    _at_start.append(rescue := Rescue(Path(data), _say))
    rescue.stop_others(SHUTTERS_S)


def _say(line: str) -> None:
    print(escaped(line), file=sys.stderr, flush=True)


def wait_until_safe_at_start() -> dict[str, Lock]:
    """Return the sessions whose stations `make_safe_at_start` made safe, with their locks, which are held. To be called
    before somebody else speaks to the same instruments."""
    return {name: lock for rescue in _at_start for name, lock in rescue.wait_until_safe(INSTRUMENTS_S).items()}


def _check_shut(monochromator: Any) -> None:
    """Raise OSError where a monochromator says that its shutter is open, also after it was closed."""
    if monochromator.shutter_is_open():
        monochromator.close_shutter()
        if monochromator.shutter_is_open():
            raise OSError("the shutter is open though it was told to close")


def _settings(entry: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key not in _NOT_ITS_DRIVERS}


def _under_way(registry: Path) -> list[tuple[str, dict[str, Any]]]:
    """(session, its station's document) of those that are recorded as running or paused."""
    if not registry.is_file():
        return []
    # On a full or a read-only disk SQLite reads only what is taken as immutable, without what its log has.
    for more in ("", "?immutable=1"):
        try:
            address = f"{registry.absolute().as_uri()}{more}"
            with contextlib.closing(sqlite3.connect(address, uri=True, timeout=REGISTRY_S)) as db:
                rows = db.execute("SELECT id, station FROM sessions WHERE state IN ('running', 'paused')").fetchall()
            return [(session_id, json.loads(station)) for session_id, station in rows]
        except (sqlite3.Error, ValueError):  # an older revision, another file: the recovery says what
            log.debug("%s: not read", registry, exc_info=True)
    return []
