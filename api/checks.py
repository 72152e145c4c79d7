"""Self-tests of stations' instruments, one thread each, and how the latest of each went."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from api.errors import Conflict
from api.live import LiveSessions
from api.safety import StationSafety
from lab.capture.durable_files import write_durably
from lab.capture.instruments import Shutter
from lab.capture.records import now
from lab.capture.self_test import SelfTest, record_transcript, self_test
from lab.capture.station import Drivers, Station
from lab.errors import DeviceError, InputError

log = logging.getLogger(__name__)
#: How long (s) the service's end waits for tests that are under way: an instrument that is let go is in its safe state.
PATIENCE_S = 30.0
#: Instruments that let no light out, whether they work or not, by the beginning of their names.
NO_LIGHT = ("cameras.", "spectroradiometer", "photodiode", "stage")


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


_CHECKED = TypeAdapter(Checked)


class DeviceChecks:
    """Checks devices in the background, those of one station one after the other, and keeps sessions off its
    instruments meanwhile.

    `folder`: where the latest check of each device is kept, and what went over its wire.
    """

    def __init__(self, live: LiveSessions, connect: Callable[[Station], Drivers], folder: Path) -> None:
        self._live, self._connect, self._folder = live, connect, folder
        self._latest: dict[tuple[str, str], Checked | None] = {}
        self._threads: list[threading.Thread] = []
        self._closed = False

    def latest(self, station: str, device: str) -> Checked | None:
        """Return how the latest check of a device went, also before the service's start; None if there was none."""
        if (station, device) not in self._latest:
            self._latest[station, device] = self._read_kept(station, device)
        return self._latest[station, device]

    def transcript(self, station: str, device: str) -> Path:
        """Return where the transcript of a device's latest check is, if one was kept."""
        return self._folder / station / f"{device}.txt"

    def _read_kept(self, station: str, device: str) -> Checked | None:
        try:
            return _CHECKED.validate_json((self._folder / station / f"{device}.json").read_bytes())
        except (OSError, ValidationError):
            return None

    def start(self, name: str, station: Station, devices: Sequence[str], keep_transcript: bool) -> None:
        """Check devices in the background, one after the other. Raises Conflict while a session or a check is under way
        on the station's instruments."""
        if self._closed:
            raise Conflict("the service is being stopped; check the device when it is up again")
        let_go = self._live.hold(station)
        for device in devices:
            self._latest[name, device] = Checked()
        thread = threading.Thread(
            target=self._work,
            args=(name, station, devices, keep_transcript, let_go),
            name=f"check {name} {', '.join(devices)}",
            daemon=True,
        )
        self._threads = [running for running in self._threads if running.is_alive()] + [thread]
        thread.start()

    def _work(
        self, name: str, station: Station, devices: Sequence[str], keep_transcript: bool, let_go: Callable[[], None]
    ) -> None:
        checked_devices: dict[str, Checked | None] = {}
        try:
            for device in devices:
                self._latest.update(
                    {(name, checked): device_check for checked, device_check in checked_devices.items()}
                )
                checked_devices[device] = self._check_device(name, station, device, keep_transcript)
            self._note_safety(station, checked_devices)
        finally:
            let_go()
            # who reads that the last one's check has ended may use the instruments
            self._latest.update(
                {(name, device): checked_devices.get(device, self._read_kept(name, device)) for device in devices}
            )

    def _check_device(self, name: str, station: Station, device: str, keep_transcript: bool) -> Checked | None:
        if self._closed:
            return self._read_kept(name, device)
        checked = Checked(self._test(name, station, device, keep_transcript), now())
        try:
            write_durably(self._folder / name / f"{device}.json", _CHECKED.dump_json(checked))
        except (OSError, InputError) as error:
            log.warning("check of %s, %s: isn't kept: %s", name, device, error)
        return checked

    def _note_safety(self, station: Station, checked_devices: Mapping[str, Checked | None]) -> None:
        """Keep that the station is safe where each of its instruments that may let light out was checked now and is."""
        may_shine = {device for device in station.devices if not device.startswith(NO_LIGHT)}
        works = {device for device, check in checked_devices.items() if check is not None and check.state == "works"}
        if may_shine and may_shine <= works:
            shutter: Shutter = "none" if station.monochromator is None else "closed"
            self._live.safety.note(station, StationSafety(state="safe", shutter=shutter, at=now()))

    def _test(self, name: str, station: Station, device: str, keep_transcript: bool) -> SelfTest:
        if not station.devices[device].address:
            return SelfTest(device, "a person", True, "is asked on the operator's page while a session runs")
        try:
            if not keep_transcript:
                return self_test(station, device, self._connect)
            file = self.transcript(name, device)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.unlink(missing_ok=True)
            return record_transcript(station, device, file)
        except (InputError, DeviceError) as error:
            return SelfTest(device, "", False, str(error))
        except Exception:
            log.exception("check of %s, %s: a defect", name, device)
            return SelfTest(device, "", False, "the check failed by a defect of calibench; its log says more")

    def close(self) -> None:
        """Wait for the checks that are under way."""
        self._closed = True
        until = time.monotonic() + PATIENCE_S
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                log.error("%s didn't end within %g s; look after the instrument", thread.name, PATIENCE_S)
