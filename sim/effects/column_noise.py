"""Column noise: every column is read with a fixed offset of its own."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class ColumnNoise(Effect):
    """Offsets of a standard deviation, drawn once by `pattern_seed`, of mean 0 over the columns, on top of the camera's own."""

    name: ClassVar[str] = "column_noise"
    stage: ClassVar[Stage] = Stage.ELECTRONICS
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, spatial and temporal variances of rows and columns"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"dark", "flat"})
    rivals: ClassVar[frozenset[str]] = frozenset({"row_noise"})
    sentence: ClassVar[str] = (
        "Columns have offsets of their own: the same stripes stand in every frame, dark or bright."
    )

    offset_e: Annotated[
        float,
        Quantity("e", "standard deviation of the columns' offsets", lower=0.0, upper=1e4, prior=(0.0, 1.0), absent=0.0),
    ] = 0.0
    pattern_seed: int = 0

    def added(self, shape: tuple[int, ...], rng: np.random.Generator, camera: CameraModel) -> FloatArray | None:
        return None if self.offset_e == 0.0 else np.asarray(self.added_e(shape, camera))

    def added_e(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray | float:
        if self.offset_e == 0.0:
            return 0.0
        offset = np.random.default_rng([self.pattern_seed, 3]).standard_normal((1, shape[1]))
        return self.offset_e * (offset - offset.mean())
