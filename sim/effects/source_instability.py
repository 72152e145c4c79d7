"""Source instability: the light differs at random from frame to frame."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Light, Unsteadiness


class SourceInstability(Effect):
    """Radiance factor 1 + s z in each frame, z normal and anew in each: levels scatter, alike at all exposures; no
    frame's picture does.

    An arc that wanders, a supply that isn't regulated, or a shutter whose time isn't repeatable.
    """

    name: ClassVar[str] = "source_instability"
    family: ClassVar[Family] = Family.SOURCE_IN_TIME
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, irradiation"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "level", "orientation", "time"}
    )
    sentence: ClassVar[str] = (
        "The light is unsteady: repeats of one setting scatter in their level, all pixels of a frame together, by far "
        "more than their noise."
    )

    instability_percent: Annotated[
        float,
        Quantity(
            "%",
            "standard deviation of the light from frame to frame",
            lower=0.0,
            upper=30.0,
            prior=(0.0, 1.0),
            absent=0.0,
            linear_power=2,
        ),
    ] = 0.0
    draw_seed: Annotated[int, Field(description="which of the sequences of levels that the law can draw")] = 0

    def on_light(self, light: Light) -> Light:
        if self.instability_percent == 0.0:
            return light
        return light.add_laws(unsteadiness=Unsteadiness(0.01 * self.instability_percent, self.draw_seed))
