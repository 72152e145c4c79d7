"""Coloured line noise: rows or columns share a disturbance whose power falls with the frequency, as 1/f noise does."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.lines import LineNoise
from sim.stages import Signal

#: Exponents that are tried first.
EXPONENTS = (0.7, 1.0, 1.5)


class ColouredLineNoise(Effect):
    """A normal variable a line and frame, of power f^-b at f cycles a line, level below 1e-3 cycles a line: neighbours
    have most of it in common, and far lines still some. Noise of rows that are correlated by a fixed distance is level
    below that distance's frequency.
    """

    name: ClassVar[str] = "coloured_line_noise"
    family: ClassVar[Family] = Family.LINE_NOISE
    reference: ClassVar[str] = "B. J. Rauscher, Teledyne H1RG, H2RG, and H4RG noise generator, PASP 127 (2015) 1144"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"exponent"})
    sentence: ClassVar[str] = (
        "Rows or columns share noise whose power falls with the frequency: broad bands and fine stripes in one, anew "
        "in "
        "every frame, dark or bright."
    )

    noise_e: Annotated[
        float,
        Quantity(
            "e",
            "temporal standard deviation of a line",
            lower=0.0,
            upper=1e4,
            prior=(0.0, 5.0),
            absent=0.0,
            linear_power=2,
        ),
    ] = 0.0
    exponent: Annotated[
        float,
        Quantity(
            "1",
            "power by which the noise falls with the frequency",
            lower=0.3,
            upper=2.5,
            prior=(1.0, 0.3),
            absent=1.0,
        ),
    ] = 1.0
    lines: Annotated[Literal["rows", "columns"], Field(description="lines that share the noise")] = "rows"

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple((cls(noise_e=0.5, exponent=b, lines=lines),) for lines in ("rows", "columns") for b in EXPONENTS)

    def on_signal(self, signal: Signal) -> Signal:
        if self.noise_e == 0.0:
            return signal
        return signal.add_laws(lines=LineNoise(self.lines, self.noise_e, exponent=self.exponent))
