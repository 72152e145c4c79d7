"""Non-uniform illumination: the source's light falls off across the field."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light


class NonUniformIllumination(Effect):
    """Light factor 1 + s + k s^2 / g, s = gx x + gy y and g = |(gx, gy)|, x and y from -1 to 1 across the frame: a
    slope, with a bow along it as a lamp beside the axis leaves it.
    """

    name: ClassVar[str] = "non_uniform_illumination"
    title: ClassVar[str] = "non-uniform illumination"
    family: ClassVar[Family] = Family.FIELD_OF_LIGHT
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, homogeneity of the source"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"bow"})
    sentence: ClassVar[str] = (
        "The illumination is not uniform: flat fields slope across the frame, alike in all channels."
    )

    gradient_x_percent: Annotated[
        float,
        Quantity(
            "%",
            "slope along columns, centre to rim",
            lower=-50.0,
            upper=50.0,
            prior=(0.0, 1.0),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0
    gradient_y_percent: Annotated[
        float,
        Quantity(
            "%",
            "slope along rows, centre to rim",
            lower=-50.0,
            upper=50.0,
            prior=(0.0, 1.0),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0

    bow: Annotated[
        float,
        Quantity(
            "1", "bend along the slope, in parts of the slope", lower=-1.0, upper=1.0, prior=(0.0, 0.15), absent=0.0
        ),
    ] = 0.0

    def on_light(self, light: Light) -> Light:
        steepest = float(np.hypot(self.gradient_x_percent, self.gradient_y_percent)) / 100.0
        if steepest == 0.0:
            return light
        camera = light.camera
        half_x, half_y = 0.5 * camera.cols * camera.pixel_pitch_um, 0.5 * camera.rows * camera.pixel_pitch_um

        def shading(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            slope = self.gradient_x_percent / 100.0 * x_um / half_x + self.gradient_y_percent / 100.0 * y_um / half_y
            return np.asarray(1.0 + slope + self.bow * slope**2 / steepest)

        return light.add_laws(shading=shading)
