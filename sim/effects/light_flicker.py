"""Light flicker: a lamp on alternating current or pulsed, seen row by row through a rolling shutter."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light, RowLight

#: Times from row to row that are tried first, 5 to 400 us: of rolling shutters from 2000 rows in 10 ms to 100 in 40 ms.
#: Their ratio is 1.2, as rows tell bands whose number in a frame differs by half of one.
LINE_TIMES_US = tuple(5.0 * 1.2**k for k in range(25))


class LightFlicker(Effect):
    """Light x (1 + m sinc(f T) cos(2 pi f (t + T / 2))), T the exposure and t its begin: the frame's, and a line time
    later for each row. Bands that vanish where T is a multiple of 1 / f. The line time of a global shutter is 0,
    whatever is given: frames flicker as a whole.
    """

    name: ClassVar[str] = "light_flicker"
    family: ClassVar[Family] = Family.SOURCE_IN_TIME
    reference: ClassVar[str] = "IEEE Std 1789-2015, modulation of current in high-brightness LEDs"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "level"})
    shapes: ClassVar[frozenset[str]] = frozenset({"frequency_hz", "line_time_us"})
    sentence: ClassVar[str] = (
        "The light flickers: dark and bright bands move over the rows from frame to frame, and vanish at exposures of "
        "whole periods."
    )

    modulation_percent: Annotated[
        float,
        Quantity(
            "%",
            "amplitude of the light's variation over its mean",
            lower=0.0,
            upper=100.0,
            prior=(0.0, 5.0),
            absent=0.0,
        ),
    ] = 0.0
    frequency_hz: Annotated[
        float, Quantity("Hz", "frequency of the variation", lower=0.1, upper=1e6, absent=100.0, logarithmic=True)
    ] = 100.0
    line_time_us: Annotated[
        float,
        Quantity(
            "us", "time from one row's exposure to the next one's", lower=0.0, upper=1e4, absent=15.0, logarithmic=True
        ),
    ] = 15.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        lines = LINE_TIMES_US[:1] if camera.shutter == "global" else LINE_TIMES_US
        return tuple(
            (cls(modulation_percent=depth, frequency_hz=100.0, line_time_us=line),)
            for depth in (1.5, 15.0)
            for line in lines
        )

    def on_light(self, light: Light) -> Light:
        if self.modulation_percent == 0.0:
            return light

        line_s = 0.0 if light.camera.shutter == "global" else 1e-6 * self.line_time_us

        def factors(rows: int, exposure_s: float, elapsed_s: float) -> FloatArray:
            middle_s = elapsed_s + 0.5 * exposure_s + line_s * np.arange(rows)
            depth = 0.01 * self.modulation_percent * np.sinc(self.frequency_hz * exposure_s)
            return np.asarray(1.0 + depth * np.cos(2.0 * np.pi * self.frequency_hz * middle_s))

        return light.add_laws(rows=RowLight(1.0 / self.frequency_hz, factors))
