"""Column noise: every column is read with an offset of its own."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.lines import LineNoise
from sim.stages import Signal


class ColumnNoise(Effect):
    """On top of the camera's own: fixed offsets of a standard deviation, drawn once by `pattern_seed`, of mean 0 over
    the columns; a difference of odd columns from even ones, which two ways of read-out leave; a normal variable a
    column and frame.
    """

    name: ClassVar[str] = "column_noise"
    family: ClassVar[Family] = Family.LINE_NOISE
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, spatial and temporal variances of rows and columns"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
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
            linear_power=2,
        ),
    ] = 0.0
    pattern_seed: Annotated[int, Field(description="which of the patterns that the law can draw")] = 0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return ((cls(offset_e=0.3), cls(noise_e=0.3), cls(odd_even_e=0.3), cls(odd_even_e=-0.3)),)

    def on_signal(self, signal: Signal) -> Signal:
        if self.offset_e == 0.0 and self.odd_even_e == 0.0 and self.noise_e == 0.0:
            return signal
        return signal.add_laws(
            lines=LineNoise(
                "columns", self.noise_e, fixed_e=self.offset_e, odd_even_e=self.odd_even_e, seed=self.pattern_seed
            )
        )
