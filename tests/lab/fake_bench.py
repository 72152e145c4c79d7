"""Drivers without wires, for tests of the session engine: a linear camera before a lamp, all of it in this process.

Run as a script it runs a session, so that a test can kill it: `fake_bench.py DATA SESSION [delay of a frame, s]`.
"""

from __future__ import annotations

import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from drivers.camera.base import Camera, Frame, SensorInfo
from drivers.display.base import Display, Shown
from drivers.errors import Disconnected, Refused
from drivers.instrument import Identity, Setting
from drivers.monochromator.base import Monochromator
from drivers.spectroradiometer.base import RadianceMeasurement, Spectroradiometer
from drivers.stage.base import Stage
from drivers.stage.prompt import PromptStage
from lab.capture.station import Drivers, Station
from sim.spectrum import Spectrum

ROWS, COLS, BLACK, WHITE = 24, 32, 64, 4095
#: DN a second above black per unit of light, of left and right.
SLOPE = {"left": 40_000.0, "right": 55_000.0}


def station(**changes: Any) -> Station:
    """A stereo station with every instrument and target."""
    sheet = {
        "rows": ROWS,
        "cols": COLS,
        "cfa": "RGGB",
        "bit_depth": 12,
        "black_level_dn": BLACK,
        "white_level_dn": WHITE,
        "pixel_pitch_um": 3.0,
        "fill_factor": 0.9,
        "quantum_efficiency": {c: {"wavelength_nm": [400, 700], "value": [0.2, 0.5]} for c in "RGB"},
    }
    regions = [
        {"name": name, "region": [2, 2, 20, 20], "angle_deg": 5.0, "field_mm": [0.0, 0.0]}
        for name in ("centre", "mid", "corner")
    ]
    edge = {"kind": "slanted_edge", "angle_deg": 5.0, "left": {"regions": regions}, "right": {"regions": regions}}
    board = {"kind": "charuco", "dictionary": "DICT_4X4_50", "squares": [5, 7], "square_mm": 10.0, "marker_mm": 7.0}
    chart = {"corners": [[2, 2], [2, 29], [21, 29], [21, 2]]}
    seen = {"camera_px_per_screen_px": 0.5, "visible": [100, 100, 980, 1820]}
    table = {
        "name": "fake",
        "monochromator": {"driver": "fake", "address": "monochromator"},
        "spectroradiometer": {"driver": "fake", "address": "spectroradiometer"},
        "display": {"driver": "fake", "address": "display"},
        "stage": {"driver": "fake", "address": "stage"},
        "cameras": {side: {"driver": "fake", "address": side, "datasheet": sheet} for side in ("left", "right")},
        "targets": {
            "cap": {"kind": "cap"},
            "sphere": {"kind": "sphere"},
            "colorchecker": {"kind": "colorchecker", "left": chart, "right": chart},
            **{f"edge-{n}": edge for n in range(1, 5)},
            "screen": {"kind": "screen", "rows": 1080, "cols": 1920, "pixel_mm": 0.2, "left": seen, "right": seen},
            **{f"charuco-{n:02d}": board | {"pose": f"pose-{n}"} for n in range(1, 4)},
        },
    }
    return Station.model_validate(table | changes)


class Bench:
    """State that the fake instruments share, and that tests read or break."""

    def __init__(self, delay_s: float = 0.0) -> None:
        self.target, self.wavelength_nm, self.opened, self.lit = "", 0.0, True, True
        self.delay_s = delay_s
        self.shots = 0
        self.unplugged: set[str] = set()
        self.refused_nm: float | None = None
        self.log: list[str] = []
        self.serials: dict[str, str] = {}
        self.settings: dict[str, dict[str, Setting]] = {}
        self.found: dict[str, dict[str, Setting]] = {}
        self.departures: dict[str, tuple[str, ...]] = {}
        self.rng = np.random.default_rng(5)

    def check(self, name: str) -> None:
        if name in self.unplugged:
            raise Disconnected(f"{name} at here: the line is gone; plug it in again")

    @property
    def light(self) -> float:
        if self.target == "cap":
            return 0.0
        if self.target == "screen":
            return float(self.lit)
        return float(self.opened) * (1.0 if self.wavelength_nm == 0 else 0.05 * self.wavelength_nm / 500)

    def drivers(self, asked: Station | None = None) -> Drivers:
        return Drivers(
            cameras={"left": FakeCamera(self, "left"), "right": FakeCamera(self, "right")},
            stage=self._person(asked) or FakeStage(self),
            monochromator=FakeMonochromator(self),
            spectroradiometer=FakeRadiometer(self),
            display=FakeDisplay(self),
        )

    def _person(self, asked: Station | None) -> Stage | None:
        """A person as stage, where the station file has one."""
        if asked is None or asked.stage is None or asked.stage.driver != "prompt":
            return None
        person = PromptStage(**asked.stage.settings)
        person.instruct({name: target.instruction for name, target in asked.targets.items()})
        return person


class _Fake:
    who = "instrument"

    def __init__(self, bench: Bench) -> None:
        self.bench = bench

    def connect(self) -> None:
        self.bench.check(self.who)

    def identity(self) -> Identity:
        return Identity("fake", self.who, self.bench.serials.get(self.who, "SN-1"))

    def settings(self) -> dict[str, Setting]:
        return self.bench.settings.get(self.who, {})

    def found(self) -> dict[str, Setting]:
        return self.bench.found.get(self.who, {})

    def departures(self) -> tuple[str, ...]:
        return self.bench.departures.get(self.who, ())

    def stop(self) -> None:
        self.bench.check(self.who)
        self.bench.log.append(f"stop {self.who}")

    def close(self) -> None:
        self.bench.log.append(f"close {self.who}")


class FakeStage(_Fake, Stage):
    who = "stage"

    def place(self, target: str) -> None:
        self.bench.check(self.who)
        self.bench.target = target

    def placed(self) -> str:
        return self.bench.target

    def targets(self) -> tuple[str, ...]:
        return ()


class FakeMonochromator(_Fake, Monochromator):
    who = "monochromator"

    def stop(self) -> None:
        super().stop()
        self.bench.opened = False

    def move_nm(self, wavelength_nm: float) -> None:
        self.bench.check(self.who)
        self.bench.wavelength_nm = wavelength_nm

    def wavelength_nm(self) -> float:
        return self.bench.wavelength_nm

    def open_shutter(self) -> None:
        self.bench.check(self.who)
        self.bench.opened = True

    def close_shutter(self) -> None:
        self.bench.check(self.who)
        self.bench.opened = False

    def shutter_is_open(self) -> bool:
        return self.bench.opened

    def select_filter(self, place: int) -> None:
        pass

    def selected_filter(self) -> int:
        return 1

    def slit_um(self) -> float:
        return 3000.0

    def set_slit_um(self, width_um: float) -> None:
        pass

    def bandwidth_nm(self) -> float:
        return 9.48


class FakeRadiometer(_Fake, Spectroradiometer):
    who = "spectroradiometer"

    def measure(self) -> RadianceMeasurement:
        self.bench.check(self.who)
        if self.bench.wavelength_nm == self.bench.refused_nm:
            raise Refused("spectroradiometer at here: error 121, under-exposed; give it more light", 121)
        return RadianceMeasurement(Spectrum.of([400, 700], [self.bench.light, self.bench.light]), 0.1, "SN-1")


class FakeDisplay(_Fake, Display):
    who = "display"

    def stop(self) -> None:
        super().stop()
        self.bench.lit = False

    def show(self, pattern: Any, cell_px: int = 1) -> Shown:
        self.bench.check(self.who)
        self.bench.lit = bool(pattern.any())
        return Shown(1.0, (1080, 1920), (1080, 1920), cell_px)

    def screen_px(self) -> tuple[int, int]:
        return (1080, 1920)


class FakeCamera(_Fake, Camera):
    def __init__(self, bench: Bench, side: str) -> None:
        super().__init__(bench)
        self.side, self.who = side, f"camera {side}"
        self.exposure_s, self.gain_db = 0.0, 0.0

    def sensor(self) -> SensorInfo:
        return SensorInfo(ROWS, COLS, "BayerRG12", "RGGB", 12)

    def configure(self, exposure_s: float, gain_db: float = 0.0) -> None:
        self.bench.check(self.who)
        self.exposure_s, self.gain_db = exposure_s, gain_db

    def arm(self, trigger: Any = "software") -> None:
        self.bench.check(self.who)

    def fire(self) -> None:
        self.bench.shots += 1
        if self.bench.delay_s:
            time.sleep(self.bench.delay_s)

    def collect(self) -> Frame:
        self.bench.check(self.who)
        dn = BLACK + SLOPE[self.side] * self.bench.light * self.exposure_s * 10.0 ** (self.gain_db / 20.0)
        raw = np.clip(self.bench.rng.normal(dn, 2.0, (ROWS, COLS)), 0, WHITE).astype(np.uint16)
        return Frame(raw, self.exposure_s, self.gain_db, 25.0, datetime.now(UTC), "BayerRG12", self.bench.shots)


if __name__ == "__main__":
    from lab.capture.session import CaptureSession
    from lab.capture.store import Store

    bench = Bench(float(sys.argv[3]) if len(sys.argv) > 3 else 0.0)
    CaptureSession(
        Store(Path(sys.argv[1])), sys.argv[2], connect=bench.drivers, on_progress=lambda p: print(p.done, flush=True)
    ).run()
