"""The camera abstraction: raw frames with the settings under which they were taken."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.errors import InstrumentError
from drivers.instrument import Instrument

Trigger = Literal["software", "line"]

#: How old (ns of the camera's clock) a temperature may be that stands with a streamed frame.
TEMPERATURE_NS = 250_000_000


@dataclass(frozen=True)
class SensorInfo:
    """What the camera reports of its sensor; None where it doesn't. `black_level` is in the camera's own unit, mostly
    codes.

    `exposure_s`: its shortest and longest exposure.
    """

    rows: int
    cols: int
    pixel_format: str
    cfa: str | None  # "RGGB" ..., "MONO"
    bit_depth: int | None
    pixel_pitch_um: float | None = None
    black_level: float | None = None
    exposure_s: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame as it left the converter, (rows, cols) DN, with the settings that the camera reports.

    `exposure_s` and `gain_db` are the camera's rounded settings. `time` (UTC) is the start of the exposure. `frame_id`
    counts the frames since acquisition started. `camera_time_ns`: start of the exposure on the camera's own clock,
    whose zero is its own; None where it doesn't tell.
    """

    raw: NDArray[np.uint16]
    exposure_s: float
    gain_db: float
    temperature_c: float | None
    time: datetime
    pixel_format: str
    frame_id: int
    camera_time_ns: int | None = None


class Camera(Instrument):
    """A camera that takes one frame a trigger.

    A frame is `arm` (ready for a trigger), `fire` (a software trigger) and `collect` (wait for it and read it out):
    `capture` does all three; `capture_together` interleaves them for cameras wired to trigger one another.
    """

    #: Longest time (s) beyond an exposure until its frame is there, or an error: whoever waits for `collect` waits as
    #: long.
    readout_s = 3.0

    @abstractmethod
    def sensor(self) -> SensorInfo:
        """Return size, format and colour filters as the camera reports them."""

    @abstractmethod
    def configure(self, exposure_s: float, gain_db: float = 0.0) -> None:
        """Set exposure (s) and gain (dB) of the frames to come. Raises `InstrumentError` outside the camera's
        limits."""

    def check(self, exposure_s: float, gain_db: float = 0.0) -> None:
        """Raise `InstrumentError` for an exposure (s) or a gain (dB) that `configure` would refuse; nothing is
        exposed."""
        self.configure(exposure_s, gain_db)

    def check_trigger(self, trigger: Trigger) -> None:
        """Raise `InstrumentError` for a trigger that `arm` would refuse, as far as the driver knows; nothing is
        exposed."""
        return

    @abstractmethod
    def arm(self, trigger: Trigger = "software") -> None:
        """Wait for a trigger: `fire()`, or a pulse on the camera's line."""

    @abstractmethod
    def fire(self) -> None:
        """Give the software trigger."""

    @abstractmethod
    def collect(self) -> Frame:
        """Read the frame that was triggered. Ends within exposure + time-out; afterwards the camera is ready again.

        Raises `drivers.errors.NoAnswer` if no frame, or not all of it, came.
        """

    def follow(self) -> None:
        """Note that it is right after the camera that leads was triggered: a camera that isn't wired to it is triggered
        by software here.
        """

    def capture(self) -> Frame:
        """Return one frame on a software trigger."""
        self.arm("software")
        self.fire()
        return self.collect()


class StreamingCamera(Camera):
    """A camera that keeps buffers queued from `arm` to `disarm`: it may be triggered again before a frame has been
    read.

    `drivers.camera.stream.FrameStream` takes series with such cameras. A frame that fails ends nothing: the next one
    follows."""

    #: Whether the computer triggers it after the camera that leads, as it isn't wired; set by `arm`.
    follows_by_software = False

    @abstractmethod
    def next_frame(self) -> Frame:
        """Return the frame of the oldest trigger whose frame wasn't read yet. Ends within exposure + time-out; the
        camera stays armed.

        Its temperature is at most `TEMPERATURE_NS` old on the camera's clock, read beside the stream. Raises
        `drivers.errors.Garbled` for a torn frame, `drivers.errors.Repeated` for one that came before, and `NoAnswer`.
        """

    @abstractmethod
    def disarm(self) -> None:
        """End acquisition and discard what was triggered and not read; `arm` starts anew. Never raises."""


def capture_together(cameras: Sequence[Camera]) -> tuple[Frame, ...]:
    """Return one frame of each camera, exposed at the same time: the first is triggered by software and pulses the
    others' line.

    Cameras that aren't wired follow milliseconds later (`follow`).

    All are read out even if one fails, so that none is left with an old frame; then the first failure is raised.
    """
    first, *others = cameras
    for camera in others:
        camera.arm("line")
    first.arm("software")
    first.fire()
    for camera in others:
        camera.follow()
    frames: list[Frame] = []
    failure: InstrumentError | None = None
    for camera in cameras:
        try:
            frames.append(camera.collect())
        except InstrumentError as error:
            failure = failure or error
    if failure is not None:
        raise failure
    return tuple(frames)
