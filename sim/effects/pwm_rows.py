"""PWM rows: a lamp that is dimmed by switching it off and on, seen row by row through a rolling shutter."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light, RowLight

#: Frequencies that are tried first; not round, as round exposures hold a whole number of round periods.
FREQUENCIES_HZ = (470.0, 1900.0, 9300.0)
#: Times from row to row that are tried first, 5 to 80 us; their ratio is 1.25, that of the bands of frequency in which
#: rows are measured.
LINE_TIMES_US = tuple(5.0 * 1.25**k for k in range(13))


class PwmRows(Effect):
    """The lamp is on for the share 1 - d of each period 1 / f, as bright as gives the mean that the radiometer reads. A
    row collects what its exposure T holds of that: w(t) / (T (1 - d)), w the time on between its begin t and t + T.
    Rows begin a line time after each other; those of a global shutter begin together, whatever is given.
    """

    name: ClassVar[str] = "pwm_rows"
    title: ClassVar[str] = "PWM rows"
    family: ClassVar[Family] = Family.SOURCE_IN_TIME
    reference: ClassVar[str] = (
        "IEEE Std 1789-2015, pulse-width modulation; B. Behmann et al., LED flicker, IEEE Std P2020 white paper, 2018"
    )
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "level"})
    shapes: ClassVar[frozenset[str]] = frozenset({"frequency_hz", "line_time_us"})
    sentence: ClassVar[str] = (
        "The lamp is switched off and on fast: rows are bright or dark by how many of its pulses their exposure holds, "
        "in stripes that are sharp at exposures of about a period."
    )

    off_percent: Annotated[
        float,
        Quantity(
            "%",
            "share of a period in which the lamp is off",
            lower=0.0,
            upper=99.0,
            prior=(0.0, 30.0),
            absent=0.0,
        ),
    ] = 0.0
    frequency_hz: Annotated[
        float, Quantity("Hz", "frequency of the pulses", lower=50.0, upper=1e6, absent=1130.0, logarithmic=True)
    ] = 1130.0
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
            (cls(off_percent=30.0, frequency_hz=frequency, line_time_us=line),)
            for frequency in FREQUENCIES_HZ
            for line in lines
        )

    def on_light(self, light: Light) -> Light:
        if self.off_percent == 0.0:
            return light
        line_s = 0.0 if light.camera.shutter == "global" else 1e-6 * self.line_time_us
        on = 1.0 - 0.01 * self.off_percent

        def lit_periods(periods: FloatArray) -> FloatArray:
            """Return for how many periods the lamp has been on since a pulse began."""
            whole = np.floor(periods)
            return np.asarray(whole * on + np.minimum(periods - whole, on))

        def factors(rows: int, exposure_s: float, elapsed_s: float) -> FloatArray:
            begin = self.frequency_hz * (elapsed_s + line_s * np.arange(rows))
            length = max(self.frequency_hz * exposure_s, 1e-9)
            return np.asarray((lit_periods(begin + length) - lit_periods(begin)) / (length * on))

        return light.add_laws(rows=RowLight(1.0 / self.frequency_hz, factors))
