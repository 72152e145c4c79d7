"""Noise in reading order: amplifiers have 1/f noise while they read pixel after pixel, of all columns, or of odd and
even ones apart."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.reading_order import OrderedNoise
from sim.stages import Signal

#: Exponents that are tried first.
EXPONENTS = (0.7, 1.0, 1.4)


class ReadingOrderNoise(Effect):
    """Noise of power f^-b at f cycles a pixel in the order in which pixels are read, level below 1 / S. Neighbours in
    the row have much of it in common, and rows its slow part, which shows as bands. Beside it the same of two
    amplifiers that take turns, of even and odd columns: noise of alternating columns.
    """

    name: ClassVar[str] = "reading_order_noise"
    title: ClassVar[str] = "reading-order noise"
    family: ClassVar[Family] = Family.READ_NOISE
    reference: ClassVar[str] = "B. J. Rauscher, Teledyne H1RG, H2RG, and H4RG noise generator, PASP 127 (2015) 1144"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"exponent", "span_log10_px"})
    sentence: ClassVar[str] = (
        "The amplifier's noise is slow: pixels that are read one after the other share a part of it, so that frames "
        "have bands and streaks that are others in every frame, dark or bright."
    )

    noise_e: Annotated[
        float,
        Quantity(
            "e",
            "standard deviation of the 1/f noise of a pixel",
            lower=0.0,
            upper=1e4,
            prior=(0.0, 5.0),
            absent=0.0,
            linear_power=2,
        ),
    ] = 0.0
    alternating_e: Annotated[
        float,
        Quantity(
            "e",
            "the same of the amplifiers of even and of odd columns, each for itself",
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
            upper=2.0,
            prior=(1.0, 0.3),
            absent=1.0,
        ),
    ] = 1.0

    span_log10_px: Annotated[
        float,
        Quantity(
            "1",
            "logarithm to base 10 of the period S beyond which the noise is level, px",
            lower=1.5,
            upper=8.0,
            prior=(6.0, 1.5),
            absent=6.0,
            dispensable=True,
        ),
    ] = 6.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        shapes = (*({"exponent": b} for b in EXPONENTS), {"span_log10_px": 3.0})
        return tuple((cls(noise_e=0.5, **shape), cls(alternating_e=0.5, **shape)) for shape in shapes)

    def on_signal(self, signal: Signal) -> Signal:
        if self.noise_e == 0.0 and self.alternating_e == 0.0:
            return signal
        knee = 10.0**-self.span_log10_px
        return signal.add_laws(reading_order=OrderedNoise(self.noise_e, self.alternating_e, self.exponent, knee))
