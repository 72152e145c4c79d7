"""Empirical law: a table by code, row or column that recordings show and no effect of the library has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge, Codes, Signal

Along = Literal["code", "row", "column"]
Stage = Literal["charge", "signal", "codes"]


@dataclass(frozen=True)
class LineOffsets:
    """Offsets that stand in every frame, of rows (rows, 1) or of columns (1, cols), in electrons: a `Disturbance`
    without noise.
    """

    offset_e: FloatArray

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Return the offsets."""
        return self.offset_e

    def mean_e(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the offsets of every pixel."""
        return np.broadcast_to(self.offset_e, shape)

    def variance_e2(self, shape: tuple[int, ...]) -> float:
        """Return 0."""
        return 0.0


class EmpiricalLaw(Effect):
    """A table by code, row or column on one stage: the entry of index i is that of i - `first`, or of i mod `period`.

    `stage` says on what. `charge`: a factor on the electrons of light. `signal`: an offset in electrons. `codes`: the
    width of a code, the interval of the converter's input that gives it; the mean of the widths is 1. Where the table
    ends nothing changes. It describes and predicts; it names no cause, so that a diagnosis never looks for it.
    """

    name: ClassVar[str] = "empirical_law"
    family: ClassVar[Family] = Family.DISCREPANCY
    is_candidate: ClassVar[bool] = False
    reference: ClassVar[str] = (
        "IEEE Std 1241-2010, differential nonlinearity by code density; EMVA Standard 1288 release 4.0, profiles"
    )
    form_tolerance: ClassVar[float] = 0.02
    sentence: ClassVar[str] = (
        "Recordings depart from the model by a table along codes, rows or columns that holds in captures it wasn't "
        "taken from. No effect of the library says why."
    )

    stage: Annotated[Stage, Field(description="stage on which the table acts")] = "charge"
    along: Annotated[Along, Field(description="index of the table: `code` with `codes`, `row` or `column` else")] = (
        "row"
    )
    period: Annotated[int, Field(ge=0, description="indices after which the table repeats; 0: it doesn't")] = 8
    first: Annotated[int, Field(ge=0, description="index of the first entry of a table that doesn't repeat")] = 0
    table: Annotated[
        tuple[float, ...], Field(min_length=2, description="relative widths, factors, or offsets in e")
    ] = (0.8, 1.0, 1.0, 1.0, 1.2, 1.0, 1.0, 1.0)
    strength: Annotated[
        float, Quantity("1", "share of the law that acts", lower=0.0, upper=2.0, prior=(0.0, 1.0), absent=0.0)
    ] = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.period and len(self.table) != self.period:
            raise ValueError(f"table: {len(self.table)} entries for a period of {self.period}: give one each")
        if (self.along == "code") != (self.stage == "codes"):
            raise ValueError(f"along {self.along!r} with stage {self.stage!r}: codes have `code`, other stages lines")
        if self.stage != "signal" and min(self.table) <= 0.0:
            raise ValueError(f"table: {min(self.table):g} is the least entry: widths and factors are above 0")
        if self.stage == "codes" and abs(float(np.mean(self.table)) - 1.0) > 1e-6:
            raise ValueError(f"table: the mean width is {np.mean(self.table):.7g}: divide by it, so that it is 1")
        return self

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        widths = cls(stage="codes", along="code", period=4, table=(1.1, 0.9, 1.1, 0.9), strength=0.3)
        return (cls(strength=0.3),), (widths,)

    def _by_line(self, count: int) -> FloatArray:
        """Return the table's departure from no change for lines 0 to count - 1, (count,)."""
        none = 0.0 if self.stage == "signal" else 1.0
        change = self.strength * (np.array(self.table) - none)
        if self.period:
            return np.asarray(np.resize(change, count))
        found = np.zeros(max(count, self.first + len(change)))
        found[self.first : self.first + len(change)] = change
        return found[:count]

    def _over(self, shape: tuple[int, ...]) -> FloatArray:
        """Return `_by_line` shaped to broadcast over a frame of that shape."""
        return self._by_line(shape[0])[:, None] if self.along == "row" else self._by_line(shape[1])[None, :]

    def on_charge(self, charge: Charge) -> Charge:
        if self.strength == 0.0 or self.stage != "charge":
            return charge
        return charge.add_laws(collected=lambda electrons: electrons * (1.0 + self._over(electrons.shape)))

    def on_signal(self, signal: Signal) -> Signal:
        if self.strength == 0.0 or self.stage != "signal":
            return signal
        return signal.add_laws(disturbances=LineOffsets(self._over((signal.camera.rows, signal.camera.cols))))

    def on_codes(self, codes: Codes) -> Codes:
        if self.strength == 0.0 or self.stage != "codes":
            return codes
        width = 1.0 + self.strength * (np.array(self.table) - 1.0)
        border = np.append(0.0, np.cumsum(width))  # of the input, where the ideal converter has 0, 1, 2, ...
        border *= len(width) / border[-1]
        ideal = np.arange(len(border), dtype=float)

        def convert(dn: FloatArray) -> FloatArray:
            above = np.asarray(dn, float) + 0.5 - self.first
            whole = np.floor(above / self.period) * self.period if self.period else np.zeros_like(above)
            within = above - whole
            inside = np.interp(within, border, ideal)
            moved = inside if self.period else np.where((within >= 0) & (within <= ideal[-1]), inside, within)
            return np.asarray(whole + moved - 0.5 + self.first)

        return codes.add_laws(codes=convert)
