"""Cameras that expose once on a command, and whose picture is then fetched: Micro-Manager's, ASCOM's, INDI's,
gphoto2's.

What reaches the camera says how each step is done. In which order, until when, and what is restored is here.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from abc import abstractmethod
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.apart import Apart
from drivers.camera.base import Camera, Frame, SensorInfo, Trigger
from drivers.camera.found_features import RememberedFeatures
from drivers.camera.genicam_settings import AskedFeatures, CameraFeatures
from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer
from drivers.found_settings import FoundSettings, Hold
from drivers.instrument import Identity, Recorder, Setting

#: Time (s) between two looks at whether the exposure is over.
_LOOK_S = 0.01


class SingleFrameCamera(Camera):
    """A camera at an `address` of whatever reaches it.

    `timeout_s`: longest time for an answer, beyond the exposure; a call that asks many things ends within twice that.
    `trigger_line`: `Software` where the computer triggers it right after the camera that leads, milliseconds later; no
    other line can be waited for.
    `gain_db_per_unit`, `gain_at_0_db`: the gain's own unit, as these cameras' makers each have another; without it the
    gain stays as it was found, and is called 0 dB.
    """

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 5.0,
        trigger_line: str | None = None,
        gain_db_per_unit: float | None = None,
        gain_at_0_db: float = 0.0,
        recorder: Recorder | None = None,
    ) -> None:
        if trigger_line not in (None, "Software"):
            raise InstrumentError(
                f"camera {address}: trigger_line {trigger_line!r} can't be waited for by this driver; only 'Software'"
            )
        if gain_db_per_unit is not None and not (math.isfinite(gain_db_per_unit) and gain_db_per_unit > 0):
            raise InstrumentError(f"camera {address}: gain_db_per_unit is {gain_db_per_unit}; give a number above 0")
        self.address = address
        self.readout_s = self._timeout_s = timeout_s
        self._loading_s = 0.0  # what a library takes to load, beyond the time-out
        self._wanted_line = trigger_line
        self._gain_db_per_unit, self._gain_at_0_db = gain_db_per_unit, gain_at_0_db
        self._record: Recorder = recorder or (lambda direction, data: None)
        self._who = f"camera {address}"
        self._lock = threading.RLock()
        self._hold = Hold()
        self._stopped = threading.Event()
        self._features: RememberedFeatures | None = None
        self._identity = Identity("", "")
        self._until = 0.0  # when the call under way has to end
        self._calls = 0  # under way within one another
        self._exposure_s: float | None = None
        self._gain_db = 0.0
        self._armed: Trigger | None = None
        self._fired: datetime | None = None
        self._frames = 0

    # --- what reaches the camera --------------------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> tuple[CameraFeatures, Identity]:
        """Find and open the camera."""

    @abstractmethod
    def _prepare(self, features: CameraFeatures) -> None:
        """Set what a measurement wants, and end an exposure that was left running."""

    @abstractmethod
    def _sensor(self) -> SensorInfo:
        """Size, format and limits."""

    @abstractmethod
    def _check_gain(self, unit: float) -> None:
        """Raise `InstrumentError` for a gain, in its own unit, that it hasn't got."""

    @abstractmethod
    def _set(self, features: CameraFeatures, exposure_s: float, gain: float | None) -> float:
        """Set exposure (s) and gain (its own unit, None: as it is); returns the exposure as the camera has it."""

    @abstractmethod
    def _expose(self, exposure_s: float) -> None:
        """Begin an exposure and return."""

    @abstractmethod
    def _has_exposed(self) -> bool:
        """Return whether the picture is there."""

    @abstractmethod
    def _read(self) -> NDArray[np.uint16]:
        """Return the picture, (rows, cols) DN. Raises `Garbled` for one that isn't whole."""

    @abstractmethod
    def _abort(self) -> None:
        """End an exposure that is under way, and close the camera's shutter."""

    @abstractmethod
    def _release(self) -> None:
        """Let the camera go; may raise whatever it likes."""

    def _temperature_c(self) -> float | None:
        """Return the sensor's temperature, where it tells."""
        return None

    # --- the abstraction ----------------------------------------------------------------------------------------------

    def connect(self) -> None:
        with self._lock, self._timed(self._loading_s):
            self._drop()
            try:
                features, self._identity = self._open()
                name = self._identity.serial_number or self.address
                self._who = f"camera {name}"
                self._hold.take(f"camera-{name}", self._who)
                self._features = RememberedFeatures(features, FoundSettings(f"camera-{name}", self._who))
                self._features.restore()  # what a process that was killed, or an unplugged camera, left changed
                self._prepare(self._features)
            except InstrumentError:
                self._restore()
                self._drop()
                if self._exposure_s is None:
                    self._hold.let_go()
                raise

    def identity(self) -> Identity:
        with self._used():
            return self._identity

    def sensor(self) -> SensorInfo:
        with self._used():
            return self._sensor()

    def check(self, exposure_s: float, gain_db: float = 0.0) -> None:
        with self._used():
            self._check_settings(exposure_s, gain_db)

    def check_trigger(self, trigger: Trigger) -> None:
        if trigger == "line" and self._wanted_line is None:
            raise InstrumentError(
                f"{self._who}: this driver can't make it wait for a pulse; set trigger_line to Software, or let it lead"
            )

    def configure(self, exposure_s: float, gain_db: float = 0.0) -> None:
        with self._used() as features:
            gain = self._check_settings(exposure_s, gain_db)
            self._exposure_s, self._gain_db = self._set(features, exposure_s, gain), gain_db

    def _check_settings(self, exposure_s: float, gain_db: float) -> float | None:
        """Return the gain in its own unit; None: as it is. Raises `InstrumentError` for what it can't do."""
        if not (math.isfinite(exposure_s) and exposure_s > 0 and math.isfinite(gain_db)):
            raise InstrumentError(f"{self._who}: exposure {exposure_s} s at {gain_db} dB; give a positive time")
        limits = self._sensor().exposure_s
        if limits is not None and not limits[0] * (1 - 1e-9) <= exposure_s <= limits[1] * (1 + 1e-9):
            raise InstrumentError(
                f"{self._who}: exposure {exposure_s:g} s is outside {limits[0]:g}..{limits[1]:g} s; ask for a time in "
                "it"
            )
        if self._gain_db_per_unit is None:
            if gain_db:
                raise InstrumentError(
                    f"{self._who}: the unit of its gain isn't known, so {gain_db:g} dB can't be set; state "
                    "gain_db_per_unit (and gain_at_0_db) in the station file, or leave it at 0"
                )
            return None
        unit = self._gain_at_0_db + gain_db / self._gain_db_per_unit
        self._check_gain(unit)
        return unit

    def arm(self, trigger: Trigger = "software") -> None:
        self.check_trigger(trigger)
        with self._used():
            if self._exposure_s is None:
                raise InstrumentError(f"{self._who}: no exposure time was set; call configure first")
            self._end_exposure()
            self._armed = trigger

    def fire(self) -> None:
        with self._used():
            if self._armed is None or self._exposure_s is None:
                raise InstrumentError(f"{self._who}: it isn't armed for a software trigger; call arm first")
            self._end_exposure()
            self._expose(self._exposure_s)
            self._fired = datetime.now(UTC)

    def follow(self) -> None:
        if self._wanted_line == "Software" and self._armed == "line":
            self.fire()

    def collect(self) -> Frame:
        with self._used(longer_s=self._exposure_s or 0.0):
            if self._fired is None or self._exposure_s is None:
                raise InstrumentError(f"{self._who}: no frame was asked for; call arm and fire first")
            fired = self._fired
            try:
                self._await_exposed(self._exposure_s)
                raw = self._read()
            except (Disconnected, NoAnswer):
                raise
            except Garbled:  # its settings may be lost: a server that was started again has others
                with contextlib.suppress(InstrumentError):
                    self._end_exposure()
                self._drop()
                raise
            except InstrumentError:
                self._end_exposure()
                raise
            self._fired = None
            self._frames += 1
            return Frame(
                raw,
                self._exposure_s,
                self._gain_db,
                self._temperature_c(),
                fired,
                self._sensor().pixel_format,
                self._frames - 1,
            )

    def _await_exposed(self, exposure_s: float) -> None:
        until = time.monotonic() + exposure_s + self._timeout_s
        while not self._has_exposed():
            if time.monotonic() > until:
                raise NoAnswer(
                    f"{self._who}: no frame within {self._timeout_s:g} s of its exposure of {exposure_s:g} s; check "
                    "the cable and the power"
                )
            if self._stopped.wait(_LOOK_S):
                raise Interrupted(f"{self._who}: stopped while waiting for a frame; start again")

    def capture(self) -> Frame:
        with self._lock:
            return super().capture()

    def settings(self) -> dict[str, Setting]:
        with self._used():
            return self._settings()

    def _settings(self) -> dict[str, Setting]:
        """Return all that it reports of itself, by name."""
        return {}

    def stop(self) -> None:
        self._stopped.set()
        with self._lock, self._timed():
            self._stopped.clear()
            with contextlib.suppress(InstrumentError):
                self._end_exposure()

    def close(self) -> None:
        self._stopped.set()
        with self._lock, self._timed():
            self._stopped.clear()
            self._restore()
            self._drop()
            self._hold.let_go()

    # --- inside -------------------------------------------------------------------------------------------------------

    def _left_s(self) -> float:
        """Return how long (s) an answer may take: the time-out, and what is left of the call under way; 0.01 at
        least."""
        return max(0.01, min(self._timeout_s, self._until - time.monotonic()))

    @contextlib.contextmanager
    def _timed(self, longer_s: float = 0.0) -> Iterator[None]:
        """Let a call that asks many things end within twice the time-out; a call within a call has that one's end."""
        if self._calls == 0:
            self._until = time.monotonic() + 2 * self._timeout_s
        self._until += longer_s
        self._calls += 1
        try:
            yield
        finally:
            self._calls -= 1

    @contextlib.contextmanager
    def _used(self, longer_s: float = 0.0) -> Iterator[CameraFeatures]:
        """The camera, connected anew after a failure, with the exposure it had."""
        with self._lock, self._timed(longer_s):
            if self._features is None:
                self.connect()
                if self._exposure_s is not None:
                    self.configure(self._exposure_s, self._gain_db)
            assert self._features is not None
            try:
                yield self._features
            except (Disconnected, NoAnswer):
                self._drop()
                raise

    def _end_exposure(self) -> None:
        if self._fired is not None:
            self._fired = None
            self._abort()

    def _restore(self) -> None:
        """End the exposure and set everything as it was found, where the camera can be reached."""
        if self._features is not None:
            with contextlib.suppress(InstrumentError):
                self._end_exposure()
            with contextlib.suppress(InstrumentError):
                self._features.restore()

    def _drop(self) -> None:
        self._features, self._armed, self._fired = None, None, None
        with contextlib.suppress(Exception):  # the camera may be gone
            self._release()


class LibraryCamera(SingleFrameCamera):
    """A camera behind a maker's library, which runs in a process of its own: `_library`."""

    _library: Apart

    def ask(self, method: str, *arguments: Any) -> Any:
        """Ask the library, within what is left of the time of the call under way."""
        if method in ("set", "expose", "abort"):
            self._record("sent", " ".join([method, *map(str, arguments)]).encode())
        answer = self._library.call(method, *arguments, timeout_s=self._left_s())
        if method == "get":
            self._record("received", f"{arguments[0]} = {answer}".encode())
        return answer

    def _open(self) -> tuple[AskedFeatures, Identity]:
        self._library.start()
        return AskedFeatures(self.ask), Identity(*self.ask("identity"))

    def _release(self) -> None:
        self._library.end()
