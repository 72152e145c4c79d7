"""Vignetting: the lens loses more light towards the corners than cos^4 says."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class Vignetting(Effect):
    """Light factor 1 - v (r / r_corner)^2."""

    name: ClassVar[str] = "vignetting"
    stage: ClassVar[Stage] = Stage.OPTICS
    reference: ClassVar[str] = "ISO 17957:2015"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "wavelength", "level", "time"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"flat", "narrowband"})
    rivals: ClassVar[frozenset[str]] = frozenset({"non_uniform_illumination"})
    sentence: ClassVar[str] = (
        "The lens vignettes: flat fields fall towards the corners more than the cosine law says, alike in all channels."
    )

    corner_loss_percent: Annotated[
        float,
        Quantity(
            "%",
            "light lost in the corner beyond cos^4",
            lower=-50.0,
            upper=100.0,
            prior=(0.0, 3.0),
            absent=0.0,
            slope_power=1,
        ),
    ] = 0.0

    def illumination(self, x_um: FloatArray, y_um: FloatArray, camera: CameraModel) -> FloatArray:
        corner2 = 0.25 * (camera.cols**2 + camera.rows**2) * camera.pixel_pitch_um**2
        return np.asarray(1.0 - self.corner_loss_percent / 100.0 * (x_um**2 + y_um**2) / corner2)
