"""A camera that is tethered by its own software: a folder into which that software writes raw files (CR2, NEF, ARW, DNG
...).

A frame is the next raw file that appears and is complete. What triggers it: a command (`gphoto2 --trigger-capture`), or
a person. What sets the exposure: a command, or a person; either way the file's own exposure time is compared with the
one asked for. Files are read by LibRaw, through `rawpy`: codes as they left the converter, without the covered margins.
"""

from __future__ import annotations

import math
import shlex
import subprocess
import threading
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.camera.base import Camera, Frame, SensorInfo, Trigger
from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer
from drivers.instrument import Identity, Recorder

ENDINGS = (
    ".cr2",
    ".cr3",
    ".crw",
    ".nef",
    ".nrw",
    ".arw",
    ".sr2",
    ".dng",
    ".raf",
    ".orf",
    ".rw2",
    ".pef",
    ".srw",
    ".3fr",
    ".iiq",
)
#: Cameras round their exposure times to nominal ones (1/30 for 1/32): so much of the time asked for is theirs.
TOLERANCE = 0.08
_LOOK_S = 0.05


@dataclass(frozen=True)
class RawPicture:
    """What a raw file holds."""

    raw: NDArray[np.uint16]
    cfa: str
    bit_depth: int
    black_level: float
    exposure_s: float
    iso: float


class RawFolderCamera(Camera):
    """The folder `address`; it holds one raw file of the camera at least, which says what its frames are like.

    `trigger_command`, `settings_command`: programs with their arguments, in which `{exposure_s}` and `{iso}` are
    replaced; None: a person does it. `base_iso`: the camera's sensitivity at 0 dB. `timeout_s`: longest time from the
    trigger, beyond the exposure, until the file is there. `settle_s`: a file that hasn't grown for so long is complete.
    """

    def __init__(
        self,
        address: str,
        *,
        trigger_command: str | None = None,
        settings_command: str | None = None,
        base_iso: float = 100.0,
        timeout_s: float = 60.0,
        settle_s: float = 0.5,
        recorder: Recorder | None = None,
    ) -> None:
        self.folder = Path(address)
        self.trigger_command, self.settings_command, self.base_iso = trigger_command, settings_command, base_iso
        self.timeout_s, self.settle_s = timeout_s, settle_s
        self.readout_s = timeout_s
        self._record = recorder or (lambda direction, data: None)
        self._who = f"camera folder {address}"
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._sample: RawPicture | None = None
        self._exposure_s: float | None = None
        self._gain_db = 0.0
        self._seen: frozenset[Path] | None = None
        self._fired: datetime | None = None
        self._frames = 0

    def connect(self) -> None:
        with self._lock:
            files = self._files()
            if not files:
                raise InstrumentError(
                    f"{self._who}: no raw file in it; take one picture with the camera, so that its size and colour "
                    "filters are known"
                )
            latest = max(files, key=lambda file: file.stat().st_mtime)
            self._sample = read_raw(latest, latest.name, self._who)

    def identity(self) -> Identity:
        with self._lock:
            self._ready()
            return Identity("", "tethered camera", self.folder.name)

    def sensor(self) -> SensorInfo:
        with self._lock:
            sample = self._ready()
            rows, cols = sample.raw.shape
            return SensorInfo(rows, cols, "raw file", sample.cfa, sample.bit_depth, black_level=sample.black_level)

    def check(self, exposure_s: float, gain_db: float = 0.0) -> None:
        if not (math.isfinite(exposure_s) and 0 < exposure_s <= 3600 and math.isfinite(gain_db)):
            raise InstrumentError(
                f"{self._who}: exposure {exposure_s} s at {gain_db} dB is outside 0..3600 s; give a time in it"
            )

    def configure(self, exposure_s: float, gain_db: float = 0.0) -> None:
        self.check(exposure_s, gain_db)
        with self._lock:
            self._ready()
            changed = (exposure_s, gain_db) != (self._exposure_s, self._gain_db)
            self._exposure_s, self._gain_db = exposure_s, gain_db
            if self.settings_command is not None and changed:
                self._run(self.settings_command)

    def arm(self, trigger: Trigger = "software") -> None:
        with self._lock:
            if self._exposure_s is None:
                raise InstrumentError(f"{self._who}: no exposure time was set; call configure first")
            self._ready()
            self._stopped.clear()
            self._seen = self._files()
            self._fired = datetime.now(UTC)

    def fire(self) -> None:
        with self._lock:
            if self._seen is None:
                raise InstrumentError(f"{self._who}: it isn't armed; call arm first")
            self._fired = datetime.now(UTC)
            if self.trigger_command is not None:
                self._run(self.trigger_command)

    def collect(self) -> Frame:
        with self._lock:
            if self._seen is None or self._exposure_s is None or self._fired is None:
                raise InstrumentError(f"{self._who}: no frame was asked for; call arm and fire first")
            known, self._seen = self._seen, None
            file = self._await_file(known, self._exposure_s)
            self._record("received", file.name.encode())
            picture, sample = read_raw(file, file.name, self._who), self._ready()
            if picture.raw.shape != sample.raw.shape or picture.cfa != sample.cfa:
                raise Garbled(
                    f"{self._who}: {file.name} has {picture.raw.shape} pixels of {picture.cfa}, the files before had "
                    f"{sample.raw.shape} of "
                    f"{sample.cfa}; keep the camera's picture size"
                )
            exposure_s = picture.exposure_s or self._exposure_s
            if abs(exposure_s - self._exposure_s) > TOLERANCE * self._exposure_s:
                raise InstrumentError(
                    f"{self._who}: {file.name} was exposed for {exposure_s:g} s, and {self._exposure_s:g} s were "
                    "asked for: set the camera "
                    "to manual and to that time"
                )
            self._frames += 1
            return Frame(picture.raw, exposure_s, self._gain_db, None, self._fired, "raw file", self._frames - 1)

    def capture(self) -> Frame:
        """Return one frame on a software trigger; of two threads the second waits."""
        with self._lock:
            return super().capture()

    def stop(self) -> None:
        """End the wait for a file."""
        self._stopped.set()

    def close(self) -> None:
        self._stopped.set()
        with self._lock:
            self._sample = self._seen = None

    # --- inside -----------------------------------------------------------------------------------------------------

    def _ready(self) -> RawPicture:
        if self._sample is None:
            self.connect()
        self._files()
        assert self._sample is not None
        return self._sample

    def _files(self) -> frozenset[Path]:
        try:
            return frozenset(
                file for file in self.folder.iterdir() if file.suffix.lower() in ENDINGS and file.is_file()
            )
        except OSError as error:
            self._sample = None
            raise Disconnected(
                f"{self._who}: can't be read ({error.strerror}); correct the address, or connect the disk it is on"
            ) from error

    def _run(self, command: str) -> None:
        iso = self.base_iso * 10 ** (self._gain_db / 20.0)
        words = [word.format(exposure_s=self._exposure_s, iso=round(iso)) for word in shlex.split(command)]
        self._record("sent", shlex.join(words).encode())
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=self.timeout_s, check=False)
        except subprocess.TimeoutExpired as error:
            raise NoAnswer(f"{self._who}: {words[0]} didn't end within {self.timeout_s:g} s; try it by hand") from error
        except OSError as error:
            raise InstrumentError(
                f"{self._who}: {words[0]} can't be run ({error.strerror}); correct the command in the station file"
            ) from error
        if done.returncode:
            message = " ".join((done.stderr or done.stdout).split())[-160:]
            raise InstrumentError(
                f"{self._who}: {words[0]} failed with code {done.returncode} ({message}); try it by hand"
            )

    def _await_file(self, known: frozenset[Path], exposure_s: float) -> Path:
        """Return the file that wasn't there before, once it is complete. Raises `NoAnswer`, `Interrupted`, `Garbled`
        for two."""
        until = time.monotonic() + exposure_s + self.timeout_s
        size, since = -1, time.monotonic()
        while True:
            new = sorted(self._files() - known)
            if len(new) > 1:
                raise Garbled(
                    f"{self._who}: {len(new)} files came for one trigger ({', '.join(file.name for file in new[:3])}); "
                    "let the camera write one raw file a picture, and nothing else trigger it"
                )
            if new:
                now = new[0].stat().st_size
                if now != size:
                    size, since = now, time.monotonic()
                elif now > 0 and time.monotonic() - since >= self.settle_s:
                    return new[0]
            if time.monotonic() > until:
                raise NoAnswer(
                    f"{self._who}: no {'complete ' if new else ''}raw file within {self.timeout_s:g} s of the "
                    "exposure; check that the "
                    "camera's software writes into it"
                )
            if self._stopped.wait(_LOOK_S):
                raise Interrupted(f"{self._who}: stopped while waiting for a file; start again")


def read_raw(source: Path | BytesIO, name: str, who: str) -> RawPicture:
    """Return what a raw file holds. Raises `Garbled` for one that LibRaw can't read. `name`: the file's in messages."""
    import rawpy

    try:
        with rawpy.imread(str(source) if isinstance(source, Path) else source) as raw:
            codes = np.array(raw.raw_image_visible, np.uint16)
            names = raw.color_desc.decode("ascii")
            if codes.ndim != 2:
                raise Garbled(f"{who}: {name} isn't one code a pixel; let the camera write raw files")
            cfa = "MONO" if raw.raw_pattern is None else "".join(names[k] for k in np.ravel(raw.raw_pattern))
            black = float(np.mean(raw.black_level_per_channel))
            bits = max(int(raw.white_level).bit_length(), int(codes.max(initial=0)).bit_length())
            return RawPicture(codes, cfa, bits, black, float(raw.other.shutter_speed), float(raw.other.iso_speed))
    except (rawpy.LibRawError, OSError, ValueError, TypeError) as error:
        raise Garbled(
            f"{who}: {name} can't be read ({' '.join(str(error).split())}); let the camera write raw files, complete "
            "ones"
        ) from error
