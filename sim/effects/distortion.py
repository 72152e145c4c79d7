"""Distortion: the image's scale changes with the distance from the axis."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from sim.camera import Geometry
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.illumination import from_axis_um
from sim.parameters import Quantity
from sim.scene.warp import distort
from sim.spectrum import FloatArray
from sim.stages import Image


class Distortion(Effect):
    """Radial, of the third order: light lands at r (1 + k (r / R)^2), on top of what the camera's geometry says, R half
    the frame's diagonal, r from the optical axis.

    `geometry` is for scenes that an ideal pinhole placed: its whole projection acts on top, as the distance from the
    pinhole's place. Scenes that are projected by the camera's geometry have it already.
    """

    name: ClassVar[str] = "distortion"
    family: ClassVar[Family] = Family.GEOMETRY
    reference: ClassVar[str] = "D. C. Brown, Photogramm. Eng. 37, 855 (1971)"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "level", "time"})
    sentence: ClassVar[str] = (
        "The lens distorts otherwise than the geometry says: straight lines bend, and corners lie off along the radius."
    )

    corner_percent: Annotated[
        float,
        Quantity("%", "shift in the frame's corner over its distance from the axis, outwards", lower=-40.0, upper=40.0,
                 prior=(0.0, 0.5), absent=0.0),
    ] = 0.0  # fmt: skip

    geometry: Annotated[
        Geometry | None, Field(description="camera matrix and distortion, in place of the camera's")
    ] = None

    def on_image(self, image: Image) -> Image:
        camera = image.camera
        bent = self.geometry is not None and not self.geometry.is_ideal
        if self.corner_percent == 0.0 and not bent:
            return image

        def shift(x_um: FloatArray, y_um: FloatArray, wavelength_nm: float) -> tuple[FloatArray, FloatArray]:
            x, y, corner = from_axis_um(x_um, y_um, camera)
            share = self.corner_percent / 100.0 * (x * x + y * y) / corner**2
            if self.geometry is None or not bent:
                return share * x, share * y
            pitch = camera.pixel_pitch_um
            col, row = np.broadcast_arrays(
                np.asarray(x_um) / pitch + 0.5 * (camera.cols - 1), np.asarray(y_um) / pitch + 0.5 * (camera.rows - 1)
            )
            to_col, to_row = distort(col, row, self.geometry)
            return share * x + (to_col - col) * pitch, share * y + (to_row - row) * pitch

        return image.add_laws(shift=shift)
