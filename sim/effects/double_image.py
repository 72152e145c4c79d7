"""Double image: a second, weaker image beside the first, by reflection between the faces of a plate."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import ComplexArray, Image

#: Displacements (px) that are tried first, along columns and rows.
PLACES_PX = (-12.0, -6.0, -2.5, 0.0, 2.5, 6.0, 12.0)


class DoubleImage(Effect):
    """H = (1 - q) + q exp(-2 pi i (fx dx + fy dy)): a share q of the light lands at (dx, dy), in focus.

    A tilted cover glass or filter of thickness t, index n and wedge or tilt a sends the light that its two faces
    reflect aside by about 2 t a / n; uncoated faces reflect 4 % each, 0.16 % both, and cemented or coated ones
    otherwise.
    """

    name: ClassVar[str] = "double_image"
    family: ClassVar[Family] = Family.COPIES_AND_VEILS
    reference: ClassVar[str] = "E. Oleszko et al., Computer Graphics Forum 36, 165 (2017)"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"displacement_x_px", "displacement_y_px"})
    sentence: ClassVar[str] = (
        "A second image lies beside the first, by reflection between the faces of a plate: contrast oscillates with "
        "spatial frequency, the faster the farther the copy lies."
    )

    share_percent: Annotated[
        float, Quantity("%", "the copy's light over all", lower=0.0, upper=50.0, prior=(0.0, 3.0), absent=0.0)
    ] = 0.0
    displacement_x_px: Annotated[
        float, Quantity("px", "of the copy along columns, to the right", lower=-40.0, upper=40.0, absent=5.0)
    ] = 5.0
    displacement_y_px: Annotated[
        float, Quantity("px", "of the copy along rows, downwards", lower=-40.0, upper=40.0, absent=0.0)
    ] = 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            (cls(share_percent=1.0, displacement_x_px=across, displacement_y_px=down),)
            for across in PLACES_PX
            for down in PLACES_PX
            if across or down
        )

    def on_image(self, image: Image) -> Image:
        if self.share_percent == 0.0:
            return image
        share, pitch = 0.01 * self.share_percent, image.camera.pixel_pitch_um
        dx, dy = pitch * self.displacement_x_px, pitch * self.displacement_y_px

        def transfer(fx: FloatArray, fy: FloatArray, wavelength_nm: float) -> FloatArray | ComplexArray:
            return np.asarray(1.0 - share + share * np.exp(-2j * np.pi * (fx * dx + fy * dy)))

        return image.add_laws(transfer=transfer)
