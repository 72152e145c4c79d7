"""What all GenICam cameras have in common, whatever reaches them: the project's own USB3 Vision (`drivers.camera.u3v`),
or a library.

What reaches the camera finds it, reads its XML and queues the buffers. What is asked of the camera, in which order, and
what counts as a good frame is here.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from abc import abstractmethod
from collections.abc import Collection, Iterator
from datetime import UTC, datetime

from drivers.camera.base import TEMPERATURE_NS, Frame, SensorInfo, StreamingCamera, Trigger
from drivers.camera.buffers import Grabbed
from drivers.camera.found_features import RememberedFeatures
from drivers.camera.genicam_settings import (
    CameraFeatures,
    black_level,
    give_pulses,
    make_neutral,
    set_if_there,
    snapshot,
    trigger_line,
)
from drivers.camera.pixel_format import PREFERENCE, PixelFormat
from drivers.errors import Disconnected, InstrumentError, Interrupted, NoAnswer, Repeated
from drivers.found_settings import FoundSettings
from drivers.instrument import Identity, Recorder, Setting

_LOOK_S = 0.1
#: The exposure time's names: SFNC's, and that of cameras before it.
_EXPOSURES = ("ExposureTime", "ExposureTimeAbs")


class NoFrame(NoAnswer):
    """A frame is missing from a camera that answers otherwise."""


class _Transcribed:
    """Features whose values go into a transcript: what a library puts on the wire nobody sees."""

    def __init__(self, features: CameraFeatures, recorder: Recorder) -> None:
        self._features, self._record = features, recorder

    def has(self, name: str) -> bool:
        return self._features.has(name)

    def get(self, name: str) -> Setting:
        value = self._features.get(name)
        self._record("received", f"{name} = {value}".encode())
        return value

    def set(self, name: str, value: Setting) -> None:
        self._record("sent", f"{name} = {value}".encode())
        self._features.set(name, value)

    def entries(self, name: str) -> Collection[str]:
        return self._features.entries(name)

    def limits(self, name: str) -> tuple[float, float]:
        return self._features.limits(name)

    def execute(self, name: str) -> None:
        self._record("sent", name.encode())
        self._features.execute(name)


class GenicamCamera(StreamingCamera):
    """One camera at an `address` of whatever reaches it.

    `pixel_format`: a format's name, or None for the deepest raw one of up to 14 bits (16 only if it has no other).
    `timeout_s`: longest time beyond the exposure until a frame has arrived. `trigger_line`: the input wired to the
    camera that leads, None: Line0; `Software`: none is wired, the computer triggers it right after the other,
    milliseconds apart. `output_line`: the output of the camera that leads, on which `output_source` gives the pulses;
    None: it gives none.
    """

    #: Whether the recorder is given the bytes on the wire; otherwise it is given the features that are read and
    #: written.
    _records_bytes = False

    def __init__(
        self,
        address: str,
        *,
        pixel_format: str | None = None,
        timeout_s: float = 3.0,
        trigger_line: str | None = None,
        output_line: str | None = None,
        output_source: str = "ExposureActive",
        recorder: Recorder | None = None,
    ) -> None:
        self.address = address
        self._wanted_format, self._timeout_s = pixel_format, timeout_s
        self.readout_s = timeout_s
        self._wanted_line, self._output_line, self._output_source = trigger_line, output_line, output_source
        self._recorder = recorder
        self._who = f"camera {address}"
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._features: RememberedFeatures | None = None
        self._identity = Identity("", "")
        self._format: PixelFormat = PREFERENCE[0]
        self._armed: Trigger | None = None
        self._exposure_s: float | None = None
        self._gain_db = 0.0
        self._fired: datetime | None = None
        self._owed = 0  # frames of software triggers that didn't come yet
        self._before: tuple[int, int | None] | None = None  # number and time of the frame before
        self._departures: tuple[str, ...] = ()
        self._has_temperature = False
        self._temperature: tuple[int, float] | None = None  # when (ns of the camera's clock), and degrees

    # --- what reaches the camera --------------------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> tuple[CameraFeatures, Identity]:
        """Find and open the camera, and end an acquisition that was left running."""

    @abstractmethod
    def _start(self) -> None:
        """Queue buffers and start acquisition."""

    @abstractmethod
    def _halt(self) -> None:
        """Stop acquisition, discard what is queued."""

    @abstractmethod
    def _grab(self, timeout_s: float) -> Grabbed | None:
        """Return the next buffer; None if none came in time."""

    @abstractmethod
    def _release(self) -> None:
        """Let the camera go; may raise whatever the library raises."""

    def _await_trigger_ready(self) -> None:
        """Return once a software trigger will be heard: from the start of acquisition, where the camera says no
        more."""

    def _give_trigger(self, features: CameraFeatures) -> None:
        """The software trigger."""
        features.execute("TriggerSoftware")

    # --- the abstraction --------------------------------------------------------------------------------------------

    def connect(self) -> None:
        with self._lock:
            self._drop()
            try:
                features, self._identity = self._open()
                if self._recorder is not None and not self._records_bytes:
                    features = _Transcribed(features, self._recorder)
                name = self._identity.serial_number or self.address
                self._who = f"camera {name}"
                self._features = RememberedFeatures(features, FoundSettings(f"camera-{name}", self._who))
                self._features.restore()  # what a process that was killed, or an unplugged camera, left changed
                self._prepare(self._features)
            except InstrumentError:
                self._restore()
                self._drop()
                raise

    def _prepare(self, features: CameraFeatures) -> None:
        set_if_there(features, "AcquisitionMode", "Continuous")
        set_if_there(features, "ExposureMode", "Timed")
        self._departures = make_neutral(features, self._who)
        for name in (
            "All",
            "AnalogAll",
        ):  # the gain that is set is the one before the converter, where there are several
            set_if_there(features, "GainSelector", name)
        set_if_there(features, "TriggerSelector", "FrameStart")
        if not features.has("TriggerMode"):
            raise InstrumentError(
                f"{self._who}: it has no TriggerMode, so that its exposures can't be triggered; use a camera whose can "
                "be triggered"
            )
        features.set("TriggerMode", "On")
        offered = features.entries("PixelFormat")
        names = [item.name for item in PREFERENCE] if self._wanted_format is None else [self._wanted_format]
        known = {item.name: item for item in PREFERENCE}
        chosen = next((name for name in names if name in offered and name in known), None)
        if chosen is None:
            raise InstrumentError(
                f"{self._who}: pixel format {self._wanted_format or 'raw'} isn't offered or known; it offers "
                f"{', '.join(offered)}"
            )
        features.set("PixelFormat", chosen)
        self._format = known[chosen]
        if self._wanted_line not in (None, "Software"):
            trigger_line(features, self._who, self._wanted_line)
        if self._output_line is not None:
            give_pulses(features, self._who, self._output_line, self._output_source)
        self._has_temperature = features.has("DeviceTemperature")

    def identity(self) -> Identity:
        with self._used():
            return self._identity

    def settings(self) -> dict[str, Setting]:
        with self._used() as features:
            return snapshot(features)

    def found(self) -> dict[str, Setting]:
        with self._lock:
            return {} if self._features is None else self._features.found

    def departures(self) -> tuple[str, ...]:
        with self._used():
            return tuple(f"{departure}: its codes aren't the converter's" for departure in self._departures)

    def sensor(self) -> SensorInfo:
        with self._used() as features:
            pitch = float(features.get("SensorPixelWidth")) if features.has("SensorPixelWidth") else None
            return SensorInfo(
                rows=int(features.get("Height")),
                cols=int(features.get("Width")),
                pixel_format=self._format.name,
                cfa=self._format.cfa,
                bit_depth=self._format.bits,
                pixel_pitch_um=pitch,
                black_level=black_level(features),
                exposure_s=self._exposure_limits_s(features),
            )

    def check_trigger(self, trigger: Trigger) -> None:
        with self._used() as features:
            self._trigger_source(features, trigger)

    def configure(self, exposure_s: float, gain_db: float = 0.0) -> None:
        if not (math.isfinite(exposure_s) and exposure_s > 0 and math.isfinite(gain_db)):
            raise InstrumentError(f"{self._who}: exposure {exposure_s} s at {gain_db} dB; give a positive time")
        with self._used() as features:
            name = self._exposure_name(features)
            self._set_within(features, name, exposure_s * 1e6, "us")
            if features.has("Gain"):
                self._set_within(features, "Gain", gain_db, "dB")
            elif gain_db:
                raise InstrumentError(f"{self._who}: it has no gain to set to {gain_db} dB; leave it at 0")
            self._exposure_s = float(features.get(name)) * 1e-6
            self._gain_db = float(features.get("Gain")) if features.has("Gain") else 0.0

    def _exposure_name(self, features: CameraFeatures) -> str:
        name = next((name for name in _EXPOSURES if features.has(name)), None)
        if name is None:
            raise InstrumentError(f"{self._who}: it has no exposure time that can be set; use a camera that has")
        return name

    def _exposure_limits_s(self, features: CameraFeatures) -> tuple[float, float] | None:
        for name in _EXPOSURES:
            if features.has(name):
                low, high = features.limits(name)
                return low * 1e-6, high * 1e-6
        return None

    def _set_within(self, features: CameraFeatures, name: str, value: float, unit: str) -> None:
        low, high = features.limits(name)
        within = min(max(value, low), high)
        if not math.isclose(within, value, rel_tol=1e-9):  # a library may clamp it without a word
            raise InstrumentError(
                f"{self._who}: {name} {value:g} {unit} is outside {low:g}..{high:g} {unit}; ask for a value in it"
            )
        features.set(name, within)

    def arm(self, trigger: Trigger = "software") -> None:
        with self._used() as features:
            if self._exposure_s is None:
                raise InstrumentError(f"{self._who}: no exposure time was set; call configure first")
            self.follows_by_software = trigger == "line" and self._wanted_line == "Software"
            if self._armed != trigger:
                self._stop_acquisition()
                features.set("TriggerSource", self._trigger_source(features, trigger))
                self._before, self._owed = None, 0
                self._start()
                self._armed = trigger
            self._fired = datetime.now(UTC)

    def _trigger_source(self, features: CameraFeatures, trigger: Trigger) -> str:
        """Return what triggers it: a line of its own, or the computer. Raises `InstrumentError` where it hasn't got
        that."""
        if trigger == "line" and self._wanted_line != "Software":
            return trigger_line(features, self._who, self._wanted_line)
        if "Software" not in features.entries("TriggerSource"):
            raise InstrumentError(f"{self._who}: it has no software trigger; use a camera that has")
        return "Software"

    def fire(self) -> None:
        with self._used() as features:
            if self._armed != "software" and not (self._armed == "line" and self.follows_by_software):
                raise InstrumentError(f"{self._who}: it isn't armed for a software trigger; call arm first")
            self._await_trigger_ready()
            self._fired = datetime.now(UTC)
            self._give_trigger(features)
            self._owed += 1

    def follow(self) -> None:
        if self.follows_by_software:
            self.fire()

    def collect(self) -> Frame:
        with self._lock:
            while True:
                try:
                    return self._next_frame(0)
                except Repeated:
                    continue  # of a trigger before this one
                except InstrumentError:
                    self.disarm()  # nothing of it may be taken for the next frame
                    raise

    def next_frame(self) -> Frame:
        return self._next_frame(TEMPERATURE_NS)

    def _next_frame(self, temperature_ns: int) -> Frame:
        with self._used() as features:
            by_software = self._armed == "software" or self.follows_by_software
            if (
                self._armed is None
                or self._exposure_s is None
                or self._fired is None
                or (by_software and not self._owed)
            ):
                raise InstrumentError(f"{self._who}: no frame was asked for; call arm and fire first")
            grabbed = self._await_frame(self._exposure_s)
            try:
                if not grabbed.damage:
                    self._refuse_repeated(grabbed)
                self._owed = max(0, self._owed - 1)
                raw, pixel_format = grabbed.unpack(self._who)
            finally:
                grabbed.give_back()
            return Frame(
                raw,
                self._exposure_s,
                self._gain_db,
                self._temperature_c(features, grabbed.camera_time_ns, temperature_ns),
                self._fired,
                pixel_format.name,
                grabbed.frame_id,
                grabbed.camera_time_ns,
            )

    def _refuse_repeated(self, grabbed: Grabbed) -> None:
        """Raise `Repeated` for the frame before once more. A camera that doesn't count says 0: its clock tells then."""
        now = grabbed.frame_id, grabbed.camera_time_ns
        before, self._before = self._before, now
        if before is not None and before[0] == now[0] and (now[0] != 0 or before[1] == now[1] is not None):
            raise Repeated(f"{self._who}: frame {grabbed.frame_id} came twice; it is dropped")

    def _temperature_c(self, features: CameraFeatures, time_ns: int | None, most_ns: int) -> float | None:
        """Return the sensor's temperature, read again where the one before is `most_ns` older than the frame."""
        if not self._has_temperature:
            return None
        at_ns = time.monotonic_ns() if time_ns is None else time_ns
        if self._temperature is None or not 0 <= at_ns - self._temperature[0] < most_ns:
            self._temperature = at_ns, float(features.get("DeviceTemperature"))
        return self._temperature[1]

    def disarm(self) -> None:
        with self._lock:
            try:
                self._stop_acquisition()
            except InstrumentError:
                self._drop()

    def capture(self) -> Frame:
        with self._lock:
            return super().capture()

    def _await_frame(self, exposure_s: float) -> Grabbed:
        deadline = time.monotonic() + exposure_s + self._timeout_s
        while True:
            if self._stopped.is_set():
                raise Interrupted(f"{self._who}: stopped while waiting for a frame; start again")
            grabbed = self._grab(min(_LOOK_S, max(0.0, deadline - time.monotonic())))
            if grabbed is not None:
                return grabbed
            if time.monotonic() >= deadline:
                waited = ""
                if self._armed == "line" and not self.follows_by_software:
                    waited = f"; it waited for {self._wanted_line or 'Line0'}: the camera that leads needs output_line"
                raise NoFrame(
                    f"{self._who}: no frame within {self._timeout_s:g} s of its exposure of {exposure_s:g} s; check "
                    f"the cable and the power{waited}"
                )

    def stop(self) -> None:
        self._stopped.set()
        with self._lock:
            self._stopped.clear()
            with contextlib.suppress(InstrumentError):
                self._stop_acquisition()

    def close(self) -> None:
        self._stopped.set()
        with self._lock:
            self._stopped.clear()
            self._restore()
            self._drop()

    # --- inside -----------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _used(self) -> Iterator[CameraFeatures]:
        """The camera, connected anew after a failure, with the exposure it had."""
        with self._lock:
            if self._features is None:
                self.connect()
                if self._exposure_s is not None:
                    self.configure(self._exposure_s, self._gain_db)
            assert self._features is not None
            try:
                yield self._features
            except NoFrame:
                raise
            except (Disconnected, NoAnswer):
                self._drop()
                raise

    def _stop_acquisition(self) -> None:
        if self._armed is not None:
            self._armed = None
            self._halt()

    def _restore(self) -> None:
        """Set everything as it was found, where the camera can be reached."""
        if self._features is not None:
            with contextlib.suppress(InstrumentError):
                self._stop_acquisition()
                self._features.restore()

    def _drop(self) -> None:
        with contextlib.suppress(Exception):  # libraries raise what they like, and the camera may be gone
            self._stop_acquisition()
        self._features, self._armed = None, None
        with contextlib.suppress(Exception):
            self._release()
