"""Empirical law: a table or a curve along one index of a camera that recordings show and no effect of the list has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.stages import Charge, Codes, Image, Light, Signal

Stage = Literal["light", "image", "charge", "signal", "codes"]
Along = Literal[
    "code", "row", "column", "row and column", "radius", "level", "time", "exposure", "wavelength", "frequency"
]
Of = Literal["mean", "variance"]

#: What the numbers are by stage, index, and mean or variance; the values that change nothing; and the coordinate of a
#: curve's points.
PLACES: dict[tuple[Stage, Along, Of], tuple[str, float, str]] = {
    ("light", "time", "mean"): ("factor on the source", 1.0, "s after the first capture"),
    ("image", "radius", "mean"): ("factor on the light", 1.0, "um from the sensor's centre"),
    ("image", "wavelength", "mean"): ("transmittance", 1.0, "nm"),
    ("image", "frequency", "mean"): ("factor on the transfer function", 1.0, "cycles per um"),
    ("charge", "row", "mean"): ("factor on the electrons of light", 1.0, "share of the rows"),
    ("charge", "column", "mean"): ("factor on the electrons of light", 1.0, "share of the columns"),
    ("charge", "row and column", "mean"): ("factor on the electrons of light", 1.0, ""),
    ("charge", "exposure", "mean"): ("factor on the time in which light is collected", 1.0, "s"),
    ("charge", "level", "variance"): ("factor on the shot noise's variance", 1.0, "e"),
    ("signal", "row", "mean"): ("offset, e", 0.0, "share of the rows"),
    ("signal", "column", "mean"): ("offset, e", 0.0, "share of the columns"),
    ("signal", "row and column", "mean"): ("offset, e", 0.0, ""),
    ("signal", "row", "variance"): ("variance beside the read noise's, e^2", 0.0, "share of the rows"),
    ("signal", "column", "variance"): ("variance beside the read noise's, e^2", 0.0, "share of the columns"),
    ("signal", "level", "mean"): ("factor on the response", 1.0, "e"),
    ("signal", "time", "mean"): ("offset, e", 0.0, "s after the first capture"),
    ("codes", "code", "mean"): ("width of a code", 1.0, ""),
}


@dataclass(frozen=True)
class PatternNoise:
    """Offsets that stand in every frame, and noise beside them, of rows (rows, 1), of columns (1, cols) or of pixels: a
    `Disturbance`.
    """

    offset_e: FloatArray
    added_e2: FloatArray

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Draw the offsets of one frame, in electrons."""
        if not self.added_e2.any():
            return self.offset_e
        return np.asarray(self.offset_e + np.sqrt(self.added_e2) * rng.standard_normal(shape))

    def mean_e(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the offsets of every pixel."""
        return np.broadcast_to(self.offset_e, shape)

    def variance_e2(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the variance of every pixel beside the read noise's."""
        return np.broadcast_to(self.added_e2, shape)


class EmpiricalLaw(Effect):
    """A table by index, or a curve, that changes one quantity of one stage (`PLACES`).

    A table: the entry of index i is that of i - `first`, or of i mod `period`; along "row and column" the entry of
    (row mod `period`, column mod `columns`), rows first. Where a table ends nothing changes. A curve, where `at` has
    points: linear between them, and held beyond them. It describes and predicts; it names no cause, so that a diagnosis
    never looks for it.
    """

    name: ClassVar[str] = "empirical_law"
    family: ClassVar[Family] = Family.DISCREPANCY
    is_candidate: ClassVar[bool] = False
    reference: ClassVar[str] = (
        "IEEE Std 1241-2010, differential nonlinearity by code density; EMVA Standard 1288 release 4.0, profiles"
    )
    form_tolerance: ClassVar[float] = 0.02
    sentence: ClassVar[str] = (
        "Recordings depart from the model by a table or a curve along one index of the camera that holds in captures "
        "it wasn't taken from. No effect of the library says why."
    )

    stage: Annotated[Stage, Field(description="stage on which the law acts")] = "charge"
    along: Annotated[Along, Field(description="index of the table, or coordinate of the curve")] = "row"
    of: Annotated[Of, Field(description="whether it changes a mean or a variance")] = "mean"
    period: Annotated[int, Field(ge=0, description="indices after which the table repeats; 0: it doesn't")] = 8
    columns: Annotated[int, Field(ge=0, description="the same of columns, along `row and column`; else 0")] = 0
    first: Annotated[int, Field(ge=0, description="index of the first entry of a table that doesn't repeat")] = 0
    at: Annotated[tuple[float, ...], Field(description="points of a curve, ascending; none of a table")] = ()
    table: Annotated[
        tuple[float, ...], Field(min_length=2, description="factors, widths, offsets in e, or variances in e^2")
    ] = (0.8, 1.0, 1.0, 1.0, 1.2, 1.0, 1.0, 1.0)
    strength: Annotated[
        float, Quantity("1", "share of the law that acts", lower=0.0, upper=2.0, prior=(0.0, 1.0), absent=0.0)
    ] = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.stage, self.along, self.of) not in PLACES:
            known = ", ".join(f"{stage} along {along} ({of})" for stage, along, of in PLACES)
            raise ValueError(f"no law of stage {self.stage!r} along {self.along!r} ({self.of}); there are: {known}")
        if self.at:
            self._check_curve()
        elif self.along not in {"code", "row", "column", "row and column"}:
            raise ValueError(f"along {self.along!r}: has no index; give the curve's points `at`")
        elif self.period and len(self.table) != self.period * (self.columns or 1):
            entries = f"{self.period * (self.columns or 1)}"
            raise ValueError(f"table: {len(self.table)} entries where the period has {entries}: give one each")
        if (self.along == "row and column") != bool(self.columns):
            raise ValueError(
                f"columns: {self.columns} along {self.along!r}: a table by row and column has a period of each"
            )
        least = min(self.table)
        if self._none == 1.0 and least <= 0.0:
            raise ValueError(f"table: {least:g} is the least entry: widths and factors are above 0")
        if self.of == "variance" and least < 0.0:
            raise ValueError(f"table: {least:g} is the least entry: a variance is 0 or more")
        if self.stage == "codes" and self.period and abs(float(np.mean(self.table)) - 1.0) > 1e-6:
            raise ValueError(f"table: the mean width is {np.mean(self.table):.7g}: divide by it, so that it is 1")
        return self

    def _check_curve(self) -> None:
        if self.along in {"code", "row and column"}:
            raise ValueError(f"at: {len(self.at)} points along {self.along!r}, which has indices: give a table")
        if len(self.at) != len(self.table) or list(self.at) != sorted(set(self.at)):
            raise ValueError(f"at: {len(self.at)} points for {len(self.table)} values: give one each, ascending")
        if self.along == "frequency" and (self.at[0] != 0.0 or self.table[0] != 1.0):
            raise ValueError("at: a transfer function is 1 at frequency 0: begin with that point")

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        """Return the default, and for every other place of `PLACES` one law of the size of some per cent."""
        others = []
        for (stage, along, of), (_, none, _) in PLACES.items():
            if along == "code":
                law = cls(stage=stage, along=along, period=4, table=(1.1, 0.9, 1.1, 0.9), strength=0.3)
            elif along == "row and column":
                table = (none + 0.3, *[none] * 14, none - 0.3)
                law = cls(stage=stage, along=along, period=4, columns=4, table=table, strength=0.3)
            else:
                reach = {"wavelength": 1000.0, "level": camera.full_well_e, "radius": 1e4}.get(along, 1.0)
                at = np.linspace(0.0, reach, 5)
                table = tuple((none + np.array([0.0, 0.1, 0.3, 0.1, 0.2])).tolist())
                law = cls(stage=stage, along=along, of=of, at=tuple(at.tolist()), table=table, strength=0.3)
            others.append((law,))
        return ((cls(strength=0.3),), *others)

    @property
    def _none(self) -> float:
        return PLACES[self.stage, self.along, self.of][1]

    @property
    def _change(self) -> FloatArray:
        """The table's departure from no change, times the strength."""
        return np.asarray(self.strength * (np.array(self.table) - self._none))

    def _acts(self, stage: Stage) -> bool:
        return self.strength != 0.0 and self.stage == stage

    def _at(self, x: FloatArray) -> FloatArray:
        """Return the curve's departure from no change at places of its coordinate."""
        return np.asarray(np.interp(x, self.at, self._change))

    def _by_line(self, count: int) -> FloatArray:
        """Return the departure from no change for lines 0 to count - 1, (count,)."""
        if self.at:
            return self._at((np.arange(count) + 0.5) / count)
        change = self._change
        if self.period:
            return np.asarray(np.resize(change, count))
        found = np.zeros(max(count, self.first + len(change)))
        found[self.first : self.first + len(change)] = change
        return found[:count]

    def _over(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the departure from no change shaped to broadcast over a frame of that shape."""
        if self.along == "row and column":
            cell = self._change.reshape(self.period, self.columns)
            return cell[np.ix_(np.arange(shape[0]) % self.period, np.arange(shape[1]) % self.columns)]
        return self._by_line(shape[0])[:, None] if self.along == "row" else self._by_line(shape[1])[None, :]

    def _even(self, shape: tuple[int, ...], camera: CameraModel) -> FloatArray:
        """Return factors over a frame whose mean over the pixels of each colour is 1."""
        factor = np.array(np.broadcast_to(1.0 + self._over(shape), shape))
        step = mosaic.step(camera.cfa)
        for phases in mosaic.phases(camera.cfa).values():
            mean = float(np.mean([factor[row::step, col::step].mean() for row, col in phases]))
            for row, col in phases:
                factor[row::step, col::step] /= mean
        return factor

    def on_light(self, light: Light) -> Light:
        if not self._acts("light"):
            return light
        return light.add_laws(level=lambda elapsed_s: 1.0 + float(self._at(np.asarray(elapsed_s))))

    def on_image(self, image: Image) -> Image:
        if not self._acts("image"):
            return image
        if self.along == "radius":
            return image.add_laws(shading=lambda x_um, y_um: 1.0 + self._at(np.hypot(x_um, y_um)))
        if self.along == "wavelength":
            return image.add_laws(transmittance=lambda wavelength_nm, sine: 1.0 + self._at(wavelength_nm))
        return image.add_laws(transfer=lambda fx, fy, wavelength_nm: 1.0 + self._at(np.hypot(fx, fy)))

    def on_charge(self, charge: Charge) -> Charge:
        if not self._acts("charge"):
            return charge
        if self.along == "exposure":
            return charge.add_laws(exposure_s=lambda asked_s: asked_s * (1.0 + float(self._at(np.asarray(asked_s)))))
        if self.along == "level":
            return charge.add_laws(variance_e2=lambda mean_e, variance: variance * (1.0 + self._at(mean_e)))
        if self.at:
            return charge
        return charge.add_laws(collected=lambda electrons: electrons * self._even(electrons.shape, charge.camera))

    def on_signal(self, signal: Signal) -> Signal:
        if self._acts("charge") and self.at and self.along in {"row", "column"}:
            # what isn't periodic acts by place: small tiles don't tell where in the frame they are
            by_row, camera = self.along == "row", signal.camera
            count = camera.rows if by_row else camera.cols
            mean = float(np.mean(1.0 + self._by_line(count)))  # of the frame's gain: the camera's own

            def gains(row: FloatArray, col: FloatArray) -> FloatArray:
                return (1.0 + self._at(((row if by_row else col) + 0.5) / count)) / mean

            return signal.add_laws(gains=gains)
        if not self._acts("signal"):
            return signal
        if self.along == "level":
            return signal.add_laws(response=lambda electrons: electrons * (1.0 + self._at(electrons)))
        if self.along == "time":
            gain = signal.camera.conversion_gain_dn_per_e
            return signal.add_laws(offset_dn=lambda elapsed_s, _: gain * float(self._at(np.asarray(elapsed_s))))
        change = self._over((signal.camera.rows, signal.camera.cols))
        none = np.zeros_like(change)
        pattern = PatternNoise(change, none) if self.of == "mean" else PatternNoise(none, change)
        return signal.add_laws(disturbances=pattern)

    def on_codes(self, codes: Codes) -> Codes:
        if not self._acts("codes"):
            return codes
        width = 1.0 + self._change
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
