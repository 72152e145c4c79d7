"""What is known of stations' safe states, by their instruments' own answers: after a run, after a halt, and since
before the service's start."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from datetime import datetime
from typing import Literal

from lab.capture.instruments import SafeState, Shutter
from lab.capture.records import now
from lab.capture.session import UNSAFE
from lab.capture.station import Station
from lab.capture.store import Store
from sim.parameters import Frozen

log = logging.getLogger(__name__)
#: Sessions that are looked at for stations that an earlier service left unsafe, the newest ones.
LOOKED_AT = 50


class StationSafety(Frozen):
    """Whether a station is safe: `halting` until its instruments have answered, `safe` when all did, else `not
    confirmed`, and somebody has to go to the bench. `shutter` as the monochromator answered, `at` (UTC) when; `words`:
    why it isn't confirmed."""

    state: Literal["halting", "safe", "not confirmed"]
    shutter: Shutter
    at: datetime
    words: str = ""

    @classmethod
    def of(cls, state: SafeState) -> StationSafety:
        """Return the state of a station from what its instruments answered."""
        if state.complaints:
            return cls(state="not confirmed", shutter=state.shutter, at=state.at, words="; ".join(state.complaints))
        return cls(state="safe", shutter=state.shutter, at=state.at)


class KnownSafety:
    """The latest of each station. Stations that share a monochromator share it. `changed` is called at every change, by
    any thread."""

    def __init__(self, store: Store, changed: Callable[[], None] = lambda: None) -> None:
        self._changed, self._lock = changed, threading.Lock()
        self._known: dict[str, StationSafety] = {}
        names: set[str] = set()
        for info in store.sessions(None, LOOKED_AT):  # the newest first
            if info.state in ("created", "queued") or (key := shutter_key(store.station(info.id))) in names:
                continue
            names.add(key)
            if info.state == "failed" and UNSAFE in (info.error or ""):
                self._known[key] = StationSafety(
                    state="not confirmed", shutter="unknown", at=info.created, words=f"session {info.id}: {info.error}"
                )

    def find(self, station: Station) -> StationSafety | None:
        """Return what is known of a station; None where its instruments haven't answered since the service's start, or
        a run uses them now."""
        return self._known.get(shutter_key(station))

    def note(self, station: Station, safety: StationSafety | None) -> None:
        """Keep what is known now, unless something newer is."""
        with self._lock:
            before = self._known.get(shutter_key(station))
            if safety is None:
                self._known.pop(shutter_key(station), None)
            elif before is None or before.at <= safety.at:
                self._known[shutter_key(station)] = safety
        self._changed()

    def note_found(self, station: Station, state: SafeState) -> None:
        """Keep what the instruments answered when they were made safe."""
        self.note(station, StationSafety.of(state))

    def note_asked(self, station: Station) -> None:
        """Keep that the instruments are asked now."""
        self.note(station, StationSafety(state="halting", shutter="unknown", at=now()))

    def note_shut(self, station: Station) -> None:
        """Keep that the shutter was closed just now, while the other instruments are still being stopped."""
        self.note(station, StationSafety(state="halting", shutter="closed", at=now()))

    def note_trouble(self, station: Station, words: str) -> None:
        """Keep that the shutter's state isn't known, and why."""
        self.note(station, StationSafety(state="not confirmed", shutter="unknown", at=now(), words=words))


def shutter_key(station: Station) -> str:
    """Return what tells stations apart that have shutters of their own."""
    monochromator = station.monochromator
    return (
        monochromator.address
        if monochromator is not None and monochromator.address
        else " ".join(sorted(station.addresses))
    )
