"""Watches the room on the data folder's disk while the service runs."""

from __future__ import annotations

import logging
import threading

from lab.capture.store import Store

log = logging.getLogger(__name__)
#: How often (s) the disk is looked at.
LOOK_S = 1.0


class RoomWatch:
    """Looks in a thread of its own, from `start` to `close`: gives the reserve up where the disk is full, makes it
    again where there is room, and writes both into the log."""

    def __init__(self, store: Store) -> None:
        self._store, self._ended, self._was_full = store, threading.Event(), False
        self._thread = threading.Thread(target=self._work, name="room", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        if self._thread.ident is not None:
            self._thread.join(10.0)

    def _work(self) -> None:
        while True:
            lack = self._store.look_for_room()
            if lack is not None and not self._was_full:
                log.warning("%s; until then nothing new is started, and sessions that run are paused", lack)
            elif lack is None and self._was_full:
                log.warning("%s: its disk has room again", self._store.root)
            self._was_full = lack is not None
            if self._ended.wait(LOOK_S):
                return
