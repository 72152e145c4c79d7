"""The grid of a screen's own pixels, seen through the lens."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light


class ScreenPixelStructure(Effect):
    """Factor 1 + a cos(2 pi x / p) cos(2 pi y / p) on a lit screen's light, x and y from the frame's centre, p the
    period at the sensor (px), which a drawing has to choose and a fit doesn't ask for: the grid's first harmonic, which
    is what a lens passes. Where it is finer than half the pixels it beats.
    """

    name: ClassVar[str] = "screen_pixel_structure"
    family: ClassVar[Family] = Family.SCREEN
    reference: ClassVar[str] = "I. Amidror, The Theory of the Moire Phenomenon, Springer 2009"
    form_tolerance: ClassVar[float] = 0.3
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time"})
    sentence: ClassVar[str] = (
        "The screen's own pixels are resolved: a fine grid lies over everything that it shows, and over nothing else."
    )

    amplitude_percent: Annotated[
        float,
        Quantity(
            "%",
            "amplitude of the grid's modulation, before the blur of the lens",
            lower=0.0,
            upper=100.0,
            prior=(0.0, 10.0),
            absent=0.0,
        ),
    ] = 0.0
    period_px: Annotated[float, Field(description="period of the grid on the sensor, px")] = 3.5

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return ((cls(amplitude_percent=20.0),),)

    def on_light(self, light: Light) -> Light:
        if self.amplitude_percent == 0.0:
            return light
        turns = 2.0 * np.pi / (self.period_px * light.camera.pixel_pitch_um)

        def show(share: FloatArray, x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            return np.asarray(
                share * (1.0 + 0.01 * self.amplitude_percent * np.cos(turns * x_um) * np.cos(turns * y_um))
            )

        return light.add_laws(screen=show)
