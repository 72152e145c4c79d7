"""Taps: the frame is read by several amplifiers side by side, which have gains and offsets of their own."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import PatternNoise, Signal

#: Where an area may end, as shares of the side.
BORDERS = (0.25, 0.5, 0.75)


def _gain(border: str, dispensable: bool = True) -> Quantity:
    meaning = f"gain beyond {border} over that before it, less 1"
    return Quantity("%", meaning, lower=-50.0, upper=50.0, prior=(0.0, 1.0), absent=0.0, dispensable=dispensable)


def _offset(border: str, dispensable: bool = True) -> Quantity:
    meaning = f"by how much dark pixels beyond {border} lie above those before it"
    return Quantity("e", meaning, lower=-1e4, upper=1e4, prior=(0.0, 5.0), absent=0.0, dispensable=dispensable)


class Taps(Effect):
    """Steps of the gain and of the offset at a half and at the quarters of a side: two or four areas, each read by an
    amplifier of its own. The frame's mean gain is 1 and its mean offset 0, as both are part of the camera's own.
    """

    name: ClassVar[str] = "taps"
    family: ClassVar[Family] = Family.READ_OUT_AREAS
    reference: ClassVar[str] = (
        "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE 2001, multiple amplifiers; EMVA Standard 1288 release "
        "4.0, profiles"
    )
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "level", "time"})
    sentence: ClassVar[str] = (
        "The frame is read by several amplifiers: where their areas meet, light or dark frames have a step, always at "
        "the same line."
    )

    gain_percent: Annotated[float, _gain("the half", dispensable=False)] = 0.0
    quarter_gain_percent: Annotated[float, _gain("the first quarter")] = 0.0
    last_gain_percent: Annotated[float, _gain("the third quarter")] = 0.0
    offset_e: Annotated[float, _offset("the half", dispensable=False)] = 0.0
    quarter_offset_e: Annotated[float, _offset("the first quarter")] = 0.0
    last_offset_e: Annotated[float, _offset("the third quarter")] = 0.0
    across: Annotated[Literal["columns", "rows"], Field(description="lines between which the areas meet")] = "columns"

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        steps = {name: 0.3 if name.endswith("percent") else 1.0 for name in cls.quantities()}
        return tuple(
            tuple(cls(across=across, **{name: sign * size}) for name, size in steps.items() for sign in (1.0, -1.0))
            for across in ("columns", "rows")
        )

    def _by_line(self, line: FloatArray, count: int, steps: tuple[float, float, float]) -> FloatArray:
        """Return a staircase of `steps` up at the borders, of mean 0 over `count` lines."""

        def stairs(at: FloatArray) -> FloatArray:
            above = [step * (at >= share * count) for share, step in zip(BORDERS, steps, strict=True)]
            return np.asarray(np.sum(above, axis=0), np.float64)

        return stairs(line) - float(np.mean(stairs(np.arange(float(count)))))

    def on_signal(self, signal: Signal) -> Signal:
        gains = (self.quarter_gain_percent, self.gain_percent, self.last_gain_percent)
        offsets = (self.quarter_offset_e, self.offset_e, self.last_offset_e)
        camera = signal.camera
        count = camera.cols if self.across == "columns" else camera.rows
        if any(gains):

            def factor(row: FloatArray, col: FloatArray) -> FloatArray:
                line = col if self.across == "columns" else row
                return np.asarray(1.0 + 0.01 * self._by_line(line, count, gains))

            signal = signal.add_laws(gains=factor)
        if any(offsets):
            line = self._by_line(np.arange(float(count)), count, offsets)
            signal = signal.add_laws(
                disturbances=PatternNoise(
                    line[None, :] if self.across == "columns" else line[:, None], np.zeros((1, 1))
                )
            )
        return signal
