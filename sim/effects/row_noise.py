"""Row noise: all pixels of a row share a disturbance."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.lines import LineNoise
from sim.stages import Signal


class RowNoise(Effect):
    """A normal variable a row and frame, and one a row for good, on top of the camera model's own row noise: covariance
    s^2 along a row; rows that are n apart have c^n of it in common.
    """

    name: ClassVar[str] = "row_noise"
    family: ClassVar[Family] = Family.LINE_NOISE
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, spatial and temporal variances of rows and columns"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"correlation"})
    sentence: ClassVar[str] = (
        "Each row is read with a disturbance of its own: row means scatter far more than the noise of single pixels "
        "explains."
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
            linear_power=2,
        ),
    ] = 0.0
    correlation: Annotated[
        float,
        Quantity(
            "1", "correlation of the noise of neighbouring rows", lower=-0.95, upper=0.95, prior=(0.0, 0.3), absent=0.0
        ),
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
    pattern_seed: Annotated[int, Field(description="which of the patterns that the law can draw")] = 0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return (*((cls(noise_e=0.5, correlation=c), cls(offset_e=0.5)) for c in (0.0, 0.5)),)

    def on_signal(self, signal: Signal) -> Signal:
        if self.noise_e == 0.0 and self.offset_e == 0.0:
            return signal
        return signal.add_laws(
            lines=LineNoise("rows", self.noise_e, self.correlation, fixed_e=self.offset_e, seed=self.pattern_seed)
        )
