"""Ambient light: light of the room reaches the sensor beside the source."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Light


class AmbientLight(Effect):
    """Electrons a second added while the shutter is open: e in green (and in a camera without colour), e sqrt(c) in
    red, e / sqrt(c) in blue.
    """

    name: ClassVar[str] = "ambient_light"
    family: ClassVar[Family] = Family.FIELD_OF_LIGHT
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, measuring set-up"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "level", "orientation", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"red_over_blue"})
    sentence: ClassVar[str] = (
        "Light of the room reaches the sensor: all lit captures carry a signal that grows with the exposure and not "
        "with the source."
    )

    rate_e_per_s: Annotated[
        float,
        Quantity(
            "e/s",
            "electrons a second a pixel",
            lower=0.0,
            upper=10000000.0,
            prior=(0.0, 50.0),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0

    red_over_blue: Annotated[
        float,
        Quantity(
            "1",
            "electrons in red over those in blue: the room's colour",
            lower=0.05,
            upper=20.0,
            prior=(1.0, 1.0),
            absent=1.0,
        ),
    ] = 1.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        colours = (1.0,) if camera.cfa == "MONO" else (1.0, 3.0, 0.4)
        return tuple((cls(rate_e_per_s=15.0, red_over_blue=c),) for c in colours)

    def on_light(self, light: Light) -> Light:
        if self.rate_e_per_s == 0.0:
            return light
        share = {"R": 0.5, "B": -0.5}
        return light.add_laws(
            ambient_e_per_s=lambda channel: self.rate_e_per_s * self.red_over_blue ** share.get(channel, 0.0)
        )
