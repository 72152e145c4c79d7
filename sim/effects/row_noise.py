"""Row noise: all pixels of a row share a disturbance."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Lines, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class RowNoise(Effect):
    """A normal variable a row and frame, and one a row for good, on top of the camera model's own row noise: covariance s^2 along a
    row; rows that are n apart have c^n of it in common."""

    name: ClassVar[str] = "row_noise"
    stage: ClassVar[Stage] = Stage.ELECTRONICS
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, spatial and temporal variances of rows and columns"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"dark", "flat"})
    rivals: ClassVar[frozenset[str]] = frozenset({"column_noise"})
    shapes: ClassVar[frozenset[str]] = frozenset({"correlation"})
    sentence: ClassVar[str] = (
        "Rows are read with a disturbance of their own: row means scatter far more than single pixels would make them."
    )

    noise_e: Annotated[
        float,
        Quantity(
            "e",
            "temporal standard deviation of a row",
            lower=0.0,
            upper=1e4,
            prior=(0.0, 5.0),
            absent=0.0,
            slope_power=2,
        ),
    ] = 0.0
    correlation: Annotated[
        float,
        Quantity("1", "of a row's noise with the next row's", lower=-0.95, upper=0.95, prior=(0.0, 0.3), absent=0.0),
    ] = 0.0
    offset_e: Annotated[
        float,
        Quantity(
            "e",
            "standard deviation of the rows' fixed offsets",
            lower=0.0,
            upper=1e4,
            prior=(0.0, 5.0),
            absent=0.0,
        ),
    ] = 0.0
    pattern_seed: int = 0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return (*((cls(noise_e=0.5, correlation=c), cls(offset_e=0.5)) for c in (0.0, 0.5)),)

    def added(self, shape: tuple[int, ...], rng: np.random.Generator, camera: CameraModel) -> FloatArray | None:
        if self.noise_e == 0.0 and self.offset_e == 0.0:
            return None
        total = np.broadcast_to(np.asarray(self.added_e(shape, camera), float), (shape[0], 1))
        if self.noise_e > 0.0:
            total = total + self.noise_e * _alike(rng.standard_normal((shape[0], 1)), self.correlation)
        return total

    def added_e(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray | float:
        if self.offset_e == 0.0:
            return 0.0
        offset = np.random.default_rng([self.pattern_seed, 4]).standard_normal((shape[0], 1))
        return self.offset_e * (offset - offset.mean())

    def added_e2(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray | float:
        return self.noise_e**2

    def line_spectrum_e2(self, frequency_cy_per_px: FloatArray, lines: Lines, fixed: bool) -> FloatArray | float:
        if lines != "rows":
            return 0.0
        if fixed:
            return self.offset_e**2
        c = self.correlation
        turn = np.cos(2.0 * np.pi * np.asarray(frequency_cy_per_px))
        return np.asarray(self.noise_e**2 * (1.0 - c * c) / (1.0 - 2.0 * c * turn + c * c))


def _alike(white: FloatArray, correlation: float) -> FloatArray:
    """White noise (rows, 1) of variance 1 as a stationary process of first order, of variance 1."""
    if correlation == 0.0:
        return white
    from scipy.signal import lfilter  # here: the library takes a while to load

    fresh = np.sqrt(1.0 - correlation**2)
    return np.asarray(lfilter([fresh], [1.0, -correlation], np.vstack([white[:1] / fresh, white[1:]]), axis=0))
