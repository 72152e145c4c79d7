"""Row noise: all pixels of a row share a disturbance, new in every frame."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class RowNoise(Effect):
    """A normal variable a row and frame, on top of the camera model's own row noise: covariance s^2 along a row, none across."""

    name: ClassVar[str] = "row_noise"
    stage: ClassVar[Stage] = Stage.ELECTRONICS
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, spatial and temporal variances of rows and columns"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"dark", "flat"})
    rivals: ClassVar[frozenset[str]] = frozenset({"column_noise"})
    sentence: ClassVar[str] = (
        "Rows are read with a disturbance of their own: row means scatter from frame to frame far more than single pixels would make them."
    )

    noise_e: Annotated[
        float,
        Quantity(
            "e",
            "temporal standard deviation of a row",
            lower=0.0,
            upper=1e4,
            prior=(0.0, 1.0),
            absent=0.0,
            slope_power=2,
        ),
    ] = 0.0

    def added(self, shape: tuple[int, ...], rng: np.random.Generator, camera: CameraModel) -> FloatArray | None:
        return None if self.noise_e == 0.0 else self.noise_e * rng.standard_normal((shape[0], 1))

    def added_e2(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray | float:
        return self.noise_e**2
