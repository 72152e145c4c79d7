"""A camera that its own software tethers: a thread that writes a DNG into a folder whenever a picture is asked for.

Two files in the folder control its "software": `.shoot` asks for a picture, `.exposure` holds the exposure time (s).
"""

from __future__ import annotations

import threading
import time
from collections import deque
from fractions import Fraction
from pathlib import Path

import numpy as np
import tifffile

from mocks.bench import Bench, UInt16Array
from mocks.wire import Fault
from sim.camera import Side

_BLACK, _WHITE = 64, 4095


def write_dng(file: Path, raw: UInt16Array, exposure_s: float) -> None:
    """Write a DNG of an RGGB sensor of 12 bits (Adobe, Digital Negative Specification 1.7.1): its least set of tags."""
    exposure = Fraction(exposure_s).limit_denominator(10**6)
    tags = [
        (50706, 1, 4, (1, 4, 0, 0), True),  # DNGVersion
        (50708, 2, 0, "calibench tethered mock", True),  # UniqueCameraModel
        (33421, 3, 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, 1, 4, (0, 1, 1, 2), True),  # CFAPattern: RGGB
        (50714, 4, 1, _BLACK, True),  # BlackLevel
        (50717, 4, 1, _WHITE, True),  # WhiteLevel
        (33434, 5, 1, (exposure.numerator, exposure.denominator), True),  # ExposureTime
        (50721, 10, 9, tuple(v for k in range(9) for v in (int(k % 4 == 0), 1)), True),  # ColorMatrix1
        (50778, 3, 1, 21, True),  # CalibrationIlluminant1: D65
    ]
    tifffile.imwrite(file, raw, photometric=32803, extratags=tags, metadata=None)


class TetheredCamera:
    """The camera and its software, on a thread of its own from `start` to `close`; it begins with one picture in the
    folder."""

    def __init__(self, folder: Path, bench: Bench | None = None, side: Side = "left") -> None:
        self.folder = folder
        self._bench = bench if bench is not None else Bench()
        self._side: Side = side
        self._stop = threading.Event()
        self._faults: deque[Fault] = deque()
        self._pictures = 0
        self._thread = threading.Thread(target=self._serve, name="tethered", daemon=True)

    @property
    def settings(self) -> dict[str, str]:
        """The driver's commands that talk to this software."""
        return {
            "trigger_command": f"touch {self.folder}/.shoot",
            "settings_command": f"sh -c 'echo {{exposure_s}} > {self.folder}/.exposure'",
        }

    def start(self) -> None:
        self.shoot()
        self._thread.start()

    def fail(self, faults: tuple[Fault, ...]) -> None:
        """Break the pictures to come, counted from the next one: `late`, `never`, `half`, `wrong`, or the folder gone
        (`unplug`)."""
        self._faults = deque(faults)
        self._pictures = 0

    def shoot(self) -> None:
        """Take one picture and write it."""
        exposure_file = self.folder / ".exposure"
        exposure_s = float(exposure_file.read_text()) if exposure_file.is_file() else 0.01
        raw = self._bench.expose(self._side, exposure_s)
        self._pictures += 1
        kinds = {fault.kind: fault for fault in self._faults if fault.hits(self._pictures)}
        if "never" in kinds or "drop" in kinds:
            return
        if "unplug" in kinds:
            gone = self.folder.with_name(f"{self.folder.name}.gone")
            self.folder.rename(gone)
            self._stop.wait(1.0 if kinds["unplug"].value is None else kinds["unplug"].value)
            gone.rename(self.folder)
            return
        if "late" in kinds:
            time.sleep(kinds["late"].value or 1.0)
        hidden = self.folder / ".writing"
        write_dng(hidden, raw.astype(np.uint16), exposure_s)
        data = b"?" * 4096 if "wrong" in kinds else hidden.read_bytes()
        if "half" in kinds:
            data = data[: len(data) // 2]
        hidden.unlink()
        with (self.folder / f"IMG_{time.time_ns() // 1000:016d}.dng").open("wb") as file:  # as it comes over the cable
            file.write(data[: len(data) // 3])
            file.flush()
            time.sleep(0.02)
            file.write(data[len(data) // 3 :])

    def _serve(self) -> None:
        order = self.folder / ".shoot"
        while not self._stop.wait(0.01):
            if order.is_file():
                order.unlink()
                self.shoot()

    def close(self) -> None:
        """End the software."""
        self._stop.set()
        self._thread.join(30)
