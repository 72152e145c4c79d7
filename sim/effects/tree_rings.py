"""Tree rings: the doping of a silicon crystal varies in rings as it is grown, and its fields push charge sideways."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import GainPattern, Image

#: Periods that are tried first, px.
PERIODS_PX = 6.0, 9.0, 13.0, 20.0, 30.0


class TreeRings(Effect):
    """Sensitivity 1 + a cos(2 pi r / p) at the distance r from the rings' centre: pixels of unequal effective area. The
    centre is that of the wafer, `centre_x` and `centre_y` half-widths and half-heights of the frame from its middle,
    mostly outside of it.

    Amplitudes are below 1 %. The period is nearly even over a sensor that is small beside the wafer; that the rings are
    fainter in red light, whose charge drifts less far, is in the form tolerance.
    """

    name: ClassVar[str] = "tree_rings"
    family: ClassVar[Family] = Family.FIELD_OF_LIGHT
    reference: ClassVar[str] = (
        "A. A. Plazas, G. M. Bernstein and E. S. Sheldon, On-sky measurements of the transverse electric fields' "
        "effects in the Dark Energy Camera CCDs, PASP 126 (2014) 750"
    )
    form_tolerance: ClassVar[float] = 0.3
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"period_um"})
    sentence: ClassVar[str] = (
        "Flat fields have faint concentric rings, which stand in the sensor's silicon: the same in every bright frame, "
        "in proportion to the light."
    )

    amplitude_percent: Annotated[
        float,
        Quantity("%", "amplitude of the rings in even light", lower=0.0, upper=10.0, prior=(0.0, 0.5), absent=0.0),
    ] = 0.0
    period_um: Annotated[
        float, Quantity("um", "distance of the rings", lower=2.0, upper=1e4, absent=100.0, logarithmic=True)
    ] = 100.0
    centre_x: Annotated[
        float, Field(ge=-50.0, le=50.0, description="centre to the right of the frame's middle, half-widths")
    ] = 1.6
    centre_y: Annotated[
        float, Field(ge=-50.0, le=50.0, description="centre below the frame's middle, half-heights")
    ] = 1.6

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple((cls(amplitude_percent=0.3, period_um=px * camera.pixel_pitch_um),) for px in PERIODS_PX)

    def on_image(self, image: Image) -> Image:
        if self.amplitude_percent == 0.0:
            return image
        camera = image.camera
        centre_um = (
            0.5 * self.centre_x * camera.cols * camera.pixel_pitch_um,
            0.5 * self.centre_y * camera.rows * camera.pixel_pitch_um,
        )

        def distance(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            return np.hypot(x_um - centre_um[0], y_um - centre_um[1])

        def factor(wavelength_nm: FloatArray, distance_um: FloatArray) -> FloatArray:
            rings = 0.01 * self.amplitude_percent * np.cos(2.0 * np.pi * distance_um / self.period_um)
            return np.asarray(1.0 + rings)

        return image.add_laws(patterns=GainPattern(distance, factor, is_grey=True))
