"""Column noise: every column is read with an offset of its own."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Lines, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class ColumnNoise(Effect):
    """On top of the camera's own: fixed offsets of a standard deviation, drawn once by `pattern_seed`, of mean 0 over the columns;
    a difference of odd columns from even ones, which two ways of read-out leave; a normal variable a column and frame."""

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
        Quantity(
            "e",
            "standard deviation of the columns' offsets",
            lower=0.0,
            upper=1e4,
            prior=(0.0, 5.0),
            absent=0.0,
        ),
    ] = 0.0
    odd_even_e: Annotated[
        float,
        Quantity(
            "e", "by how much odd columns lie above even ones", lower=-1e4, upper=1e4, prior=(0.0, 5.0), absent=0.0
        ),
    ] = 0.0
    noise_e: Annotated[
        float,
        Quantity(
            "e",
            "temporal standard deviation of a column",
            lower=0.0,
            upper=1e4,
            prior=(0.0, 5.0),
            absent=0.0,
            slope_power=2,
        ),
    ] = 0.0
    pattern_seed: int = 0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return ((cls(offset_e=0.3), cls(noise_e=0.3), cls(odd_even_e=0.3), cls(odd_even_e=-0.3)),)

    def added(self, shape: tuple[int, ...], rng: np.random.Generator, camera: CameraModel) -> FloatArray | None:
        if self.offset_e == 0.0 and self.odd_even_e == 0.0 and self.noise_e == 0.0:
            return None
        total = np.broadcast_to(np.asarray(self.added_e(shape, camera), float), (1, shape[1]))
        return total if self.noise_e == 0.0 else total + self.noise_e * rng.standard_normal((1, shape[1]))

    def added_e(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray | float:
        if self.offset_e == 0.0 and self.odd_even_e == 0.0:
            return 0.0
        offset = np.random.default_rng([self.pattern_seed, 3]).standard_normal((1, shape[1]))
        odd = np.arange(shape[1])[None, :] % 2 - 0.5
        return self.offset_e * (offset - offset.mean()) + self.odd_even_e * odd

    def added_e2(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray | float:
        return self.noise_e**2

    def line_spectrum_e2(self, frequency_cy_per_px: FloatArray, lines: Lines, fixed: bool) -> FloatArray | float:
        if lines != "columns":
            return 0.0
        return self.offset_e**2 if fixed else self.noise_e**2

    def line_parity_e(self, lines: Lines) -> float:
        return self.odd_even_e if lines == "columns" else 0.0
