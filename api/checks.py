"""Self-tests of stations' instruments, one thread each, and how the latest of each went."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from api.errors import Conflict
from api.live import LiveSessions
from lab.capture.records import now
from lab.capture.self_test import SelfTest, record_transcript, self_test
from lab.capture.station import Drivers, Station
from lab.errors import DeviceError, InputError

log = logging.getLogger(__name__)
#: How long (s) the service's end waits for tests that are under way: an instrument that is let go is in its safe state.
PATIENCE_S = 30.0


@dataclass(frozen=True)
class Checked:
    """The latest self-test of one device: None while it is under way."""

    test: SelfTest | None = None
    ended: datetime | None = None

    @property
    def state(self) -> Literal["checking", "works", "fails"]:
        """In one word."""
        if self.test is None:
            return "checking"
        return "works" if self.test.works else "fails"


class DeviceChecks:
    """Checks devices in the background, one of a station at a time, and keeps sessions off its instruments meanwhile.

    `transcripts`: the folder of what went over the wires. How the checks went is kept as long as the service runs.
    """

    def __init__(self, live: LiveSessions, connect: Callable[[Station], Drivers], transcripts: Path) -> None:
        self._live, self._connect, self._transcripts = live, connect, transcripts
        self._latest: dict[tuple[str, str], Checked] = {}
        self._threads: list[threading.Thread] = []
        self._closed = False

    def latest(self, station: str, device: str) -> Checked | None:
        """How the latest check of a device went; None if there was none."""
        return self._latest.get((station, device))

    def transcript(self, station: str, device: str) -> Path:
        """Where the transcript of a device's latest check is, if one was kept."""
        return self._transcripts / station / f"{device}.txt"

    def start(self, name: str, station: Station, device: str, keep_transcript: bool) -> None:
        """Check a device in the background. Raises Conflict while a session or a check is under way on the station's
        instruments."""
        if self._closed:
            raise Conflict("the service is being stopped; check the device when it is up again")
        let_go = self._live.hold(station)
        self._latest[name, device] = Checked()
        thread = threading.Thread(
            target=self._work,
            args=(name, station, device, keep_transcript, let_go),
            name=f"check {name} {device}",
            daemon=True,
        )
        self._threads = [other for other in self._threads if other.is_alive()] + [thread]
        thread.start()

    def _work(
        self, name: str, station: Station, device: str, keep_transcript: bool, let_go: Callable[[], None]
    ) -> None:
        test = SelfTest(device, "", False, "the check failed by a defect of calibench; its log says more")
        try:
            if keep_transcript:
                file = self.transcript(name, device)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.unlink(missing_ok=True)
                test = record_transcript(station, device, file)
            else:
                test = self_test(station, device, self._connect)
        except (InputError, DeviceError) as error:
            test = SelfTest(device, "", False, str(error))
        except Exception:
            log.exception("check of %s, %s: a defect", name, device)
        finally:
            self._latest[name, device] = Checked(test, now())
            let_go()

    def close(self) -> None:
        """Wait for the checks that are under way."""
        self._closed = True
        until = time.monotonic() + PATIENCE_S
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                log.error("%s didn't end within %g s; look after the instrument", thread.name, PATIENCE_S)
