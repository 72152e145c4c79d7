"""Alternating row noise: two amplifiers read even and odd columns, each with a disturbance of its own a row."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.alternating_rows import AlternatingRows
from sim.stages import Signal


class AlternatingRowNoise(Effect):
    """A normal variable a row, frame and amplifier, of even and of odd columns: pixels of a row an even number of
    columns apart share s^2, all others nothing. Row noise that both amplifiers have in common is `row_noise`.
    """

    name: ClassVar[str] = "alternating_row_noise"
    family: ClassVar[Family] = Family.LINE_NOISE
    reference: ClassVar[str] = "B. J. Rauscher, Teledyne H1RG, H2RG, and H4RG noise generator, PASP 127 (2015) 1144"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    sentence: ClassVar[str] = (
        "Even and odd columns are read by two amplifiers, each with an offset of its own in every row: in a row "
        "every other pixel shares noise over the whole width, anew in every frame."
    )

    noise_e: Annotated[
        float,
        Quantity(
            "e",
            "temporal standard deviation of a row of each amplifier",
            lower=0.0,
            upper=1e4,
            prior=(0.0, 5.0),
            absent=0.0,
            linear_power=2,
        ),
    ] = 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return ((cls(noise_e=0.5),),)

    def on_signal(self, signal: Signal) -> Signal:
        if self.noise_e == 0.0:
            return signal
        return signal.add_laws(reading_order=AlternatingRows(self.noise_e, signal.camera.cols))
