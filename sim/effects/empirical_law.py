"""Empirical law: a table or a curve along one index of a camera that recordings show and no effect of the list has."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.stages import Charge, Codes, Disturbance, Image, Light, PatternNoise, SharedNoise, Signal

Stage = Literal["light", "image", "charge", "signal", "codes"]
Along = Literal[
    "code", "row", "column", "row and column", "radius", "angle", "level", "time", "exposure", "wavelength",
    "frequency", "row x level", "column x level", "radius x exposure", "plane x time",
]  # fmt: skip
Of = Literal["mean", "variance", "covariance"]

#: What the numbers are by stage, index, and mean or variance; the values that change nothing; and the coordinate of a
#: curve's points.
PLACES: dict[tuple[Stage, Along, Of], tuple[str, float, str]] = {
    ("light", "time", "mean"): ("factor on the source", 1.0, "s after the first capture"),
    ("light", "plane x time", "mean"): ("factor on the source by channel", 1.0, "s after the first capture"),
    ("light", "wavelength", "mean"): ("displacement of the monochromator's line, nm", 0.0, "nm"),
    ("image", "radius", "mean"): ("factor on the light", 1.0, "um from the sensor's centre"),
    ("image", "angle", "mean"): ("factor on the light in the corners, else by r^2 less", 1.0, "deg"),
    ("image", "wavelength", "mean"): ("transmittance", 1.0, "nm"),
    ("image", "frequency", "mean"): ("factor on the transfer function", 1.0, "cycles per um"),
    ("charge", "row", "mean"): ("factor on the electrons of light", 1.0, "share of the rows"),
    ("charge", "column", "mean"): ("factor on the electrons of light", 1.0, "share of the columns"),
    ("charge", "row and column", "mean"): ("factor on the electrons of light", 1.0, ""),
    ("charge", "exposure", "mean"): ("factor on the time in which light is collected", 1.0, "s"),
    ("charge", "radius", "mean"): ("dark current, e/s", 0.0, "um from the sensor's centre"),
    ("charge", "radius x exposure", "mean"): (
        "time in which light is collected besides, s",
        0.0,
        "um from the sensor's centre",
    ),
    ("charge", "level", "variance"): ("factor on the shot noise's variance", 1.0, "e"),
    ("signal", "row", "mean"): ("offset, e", 0.0, "share of the rows"),
    ("signal", "column", "mean"): ("offset, e", 0.0, "share of the columns"),
    ("signal", "row and column", "mean"): ("offset, e", 0.0, ""),
    ("signal", "row", "variance"): ("variance beside the read noise's, e^2", 0.0, "share of the rows"),
    ("signal", "column", "variance"): ("variance beside the read noise's, e^2", 0.0, "share of the columns"),
    ("signal", "row", "covariance"): ("covariance with the next row, e^2", 0.0, "share of the rows"),
    ("signal", "column", "covariance"): ("covariance with the next column, e^2", 0.0, "share of the columns"),
    ("signal", "radius", "mean"): ("offset, e", 0.0, "um from the sensor's centre"),
    ("signal", "row x level", "mean"): ("change of the response, at full well", 0.0, "share of the rows"),
    ("signal", "column x level", "mean"): ("change of the response at full well", 0.0, "share of the columns"),
    ("signal", "level", "mean"): ("factor on the response", 1.0, "e"),
    ("signal", "time", "mean"): ("offset, e", 0.0, "s after the first capture"),
    ("signal", "time", "variance"): ("variance beside the read noise's, e^2", 0.0, "s after the first capture"),
    ("signal", "exposure", "mean"): ("offset, e", 0.0, "s"),
    ("codes", "code", "mean"): ("width of a code", 1.0, ""),
}


#: Those of which a table has entries.
INDICES = frozenset({"code", "row", "column", "row and column", "row x level", "column x level"})


class EmpiricalLaw(Effect):
    """A table by index, or a curve, that changes one quantity of one stage (`PLACES`).

    A table: the entry of index i is that of i - `first`, or of i mod `period`; along "row and column" the entry of (row
    mod `period`, column mod `columns`), rows first. Where a table ends nothing changes, and below `first`. A curve,
    where `at` has points: linear between them, and held beyond them; along "plane x time" the curves of the channels,
    one after the other. It describes and predicts; it names no cause, so that a diagnosis never looks for it.
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
        elif self.along not in INDICES:
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
        if self.of != "mean" and least < 0.0:
            raise ValueError(f"table: {least:g} is the least entry: a {self.of} is 0 or more")
        if self.stage == "codes" and self.period and abs(float(np.mean(self.table)) - 1.0) > 1e-6:
            raise ValueError(f"table: the mean width is {np.mean(self.table):.7g}: divide by it, so that it is 1")
        return self

    def _check_curve(self) -> None:
        if self.along in {"code", "row and column"}:
            raise ValueError(f"at: {len(self.at)} points along {self.along!r}, which has indices: give a table")
        curves = len(self.table) // len(self.at) if self.along == "plane x time" else 1
        if curves * len(self.at) != len(self.table) or list(self.at) != sorted(set(self.at)):
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
                reach = {"wavelength": 1000.0, "level": camera.full_well_e, "radius": 1e4, "radius x exposure": 1e4,
                         "angle": 360.0}.get(along, 1.0)  # fmt: skip
                at = np.linspace(0.0, reach, 5)
                curves = len(camera.channels) if along == "plane x time" else 1
                size = 1e-3 if along == "radius x exposure" else 1.0
                table = tuple(np.tile(none + size * np.array([0.0, 0.1, 0.3, 0.1, 0.2]), curves).tolist())
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
            return np.concatenate([np.zeros(min(self.first, count)), np.resize(change, max(count - self.first, 0))])
        padded = np.zeros(max(count, self.first + len(change)))
        padded[self.first : self.first + len(change)] = change
        return padded[:count]

    def _over(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the departure from no change shaped to broadcast over a frame of that shape."""
        if self.along == "row and column":
            cell = self._change.reshape(self.period, self.columns)
            return cell[np.ix_(np.arange(shape[0]) % self.period, np.arange(shape[1]) % self.columns)]
        by_row = self.along.startswith("row")
        return self._by_line(shape[0])[:, None] if by_row else self._by_line(shape[1])[None, :]

    def _by_radius(self, camera: CameraModel) -> FloatArray:
        """Return the departure from no change of every pixel (rows, cols), by its distance from the sensor's centre."""
        y, x = (camera.pixel_pitch_um * (np.arange(n) - 0.5 * (n - 1)) for n in (camera.rows, camera.cols))
        return self._at(np.hypot(y[:, None], x[None, :]))

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
        if self.along == "plane x time":
            change = self._change.reshape(-1, len(self.at))
            of_channel = dict(zip(light.camera.channels, np.resize(change, (len(light.camera.channels), len(self.at))),
                                  strict=True))  # fmt: skip
            return light.add_laws(
                level_by_channel=lambda channel, elapsed_s: (
                    1.0 + float(np.interp(elapsed_s, self.at, of_channel[channel]))
                )
            )
        if self.along == "wavelength":
            return light.add_laws(spectrum=self._displace)
        return light.add_laws(level=lambda elapsed_s: 1.0 + float(self._at(np.asarray(elapsed_s))))

    def _displace(self, wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
        """Return the spectrum of narrowband light at its true wavelengths, given the stated one."""
        total = float(np.sum(radiance))
        if kind != "narrowband" or total <= 0.0:
            return radiance
        away_nm = float(self._at(np.asarray(np.sum(radiance * wavelength_nm) / total)))
        return np.asarray(np.interp(wavelength_nm - away_nm, wavelength_nm, radiance))

    def on_image(self, image: Image) -> Image:
        if not self._acts("image"):
            return image
        if self.along == "radius":
            return image.add_laws(shading=lambda x_um, y_um: 1.0 + self._at(np.hypot(x_um, y_um)))
        if self.along == "angle":
            most = 0.5 * image.camera.pixel_pitch_um * float(np.hypot(image.camera.rows, image.camera.cols))

            def shading(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
                share = (np.square(x_um) + np.square(y_um)) / most**2
                return 1.0 + share * self._at(np.degrees(np.arctan2(y_um, x_um)) % 360.0)

            return image.add_laws(shading=shading)
        if self.along == "wavelength":
            return image.add_laws(transmittance=lambda wavelength_nm, sine: 1.0 + self._at(wavelength_nm))
        return image.add_laws(transfer=lambda fx, fy, wavelength_nm: 1.0 + self._at(np.hypot(fx, fy)))

    def on_charge(self, charge: Charge) -> Charge:
        if not self._acts("charge"):
            return charge
        if self.along == "radius":
            added = self._by_radius(charge.camera)
            return charge.add_laws(dark_current=lambda e_per_s, _: np.maximum(e_per_s + added, 0.0))
        if self.along == "radius x exposure":
            return charge.add_laws(leak_s=self._leak(charge.camera))
        if self.along == "exposure":
            return charge.add_laws(exposure_s=lambda asked_s: asked_s * (1.0 + float(self._at(np.asarray(asked_s)))))
        if self.along == "level":
            return charge.add_laws(variance_e2=lambda mean_e, variance: variance * (1.0 + self._at(mean_e)))
        if not self.at:
            charge = charge.add_laws(collected=lambda electrons: electrons * self._even(electrons.shape, charge.camera))
        return charge

    def _leak(self, camera: CameraModel) -> Callable[[FloatArray, FloatArray], FloatArray]:
        """Return the time in which light is collected besides, by the place down and across the frame, 0..1."""
        down_um, across_um = ((n - 1) * camera.pixel_pitch_um for n in (camera.rows, camera.cols))
        return lambda down, across: self._at(np.hypot((down - 0.5) * down_um, (across - 0.5) * across_um))

    def on_signal(self, signal: Signal) -> Signal:
        if self._acts("charge") and self.at and self.along in {"row", "column"}:
            # what isn't periodic acts by place: small tiles don't tell where in the frame they are
            return signal.add_laws(gains=self._gains(signal.camera))
        if not self._acts("signal"):
            return signal
        gain = signal.camera.conversion_gain_dn_per_e
        laws: dict[tuple[Along, Of], dict[str, Any]] = {
            ("level", "mean"): {"response": lambda electrons: electrons * (1.0 + self._at(electrons))},
            ("time", "variance"): {"noise_e2": lambda elapsed_s: max(float(self._at(np.asarray(elapsed_s))), 0.0)},
            ("time", "mean"): {"offset_dn": lambda elapsed_s, _: gain * float(self._at(np.asarray(elapsed_s)))},
            ("exposure", "mean"): {"exposure_offset_dn": lambda t: gain * float(self._at(np.asarray(t)))},
        }
        if (self.along, self.of) in laws:
            return signal.add_laws(**laws[self.along, self.of])
        shape = signal.camera.rows, signal.camera.cols
        if self.along in {"row x level", "column x level"}:
            return signal.add_laws(response=self._bend(shape, signal.camera.full_well_e))
        return signal.add_laws(disturbances=self._pattern(signal.camera, shape))

    def _gains(self, camera: CameraModel) -> Callable[[FloatArray, FloatArray], FloatArray]:
        """Return the factor on what is read by row and column, over its mean: the frame's gain is the camera's own."""
        by_row = self.along == "row"
        count = camera.rows if by_row else camera.cols
        mean = float(np.mean(1.0 + self._by_line(count)))
        return lambda row, col: (1.0 + self._at(((row if by_row else col) + 0.5) / count)) / mean

    def _bend(self, shape: tuple[int, int], full_well_e: float) -> Callable[[FloatArray], FloatArray]:
        """Return the response of a whole frame. Levels of a few points don't ask where they lie: over the lines its
        mean change is none."""
        bend = self._over(shape)
        return lambda e: e * (1.0 + bend * e / full_well_e) if np.shape(e) == shape else e

    def _pattern(self, camera: CameraModel, shape: tuple[int, int]) -> Disturbance:
        """Return offsets or noise of lines, of cells or by the radius."""
        if self.of == "covariance":
            axis = 0 if self.along == "row" else 1
            return SharedNoise(np.maximum(self._by_line(shape[axis]), 0.0), axis)
        change = self._by_radius(camera) if self.along == "radius" else self._over(shape)
        none = np.zeros_like(change)
        return PatternNoise(change, none) if self.of == "mean" else PatternNoise(none, change)

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
            counts = above >= 0.0 if self.period else (within >= 0.0) & (within <= ideal[-1])
            moved = np.where(counts, np.interp(within, border, ideal), within)
            return np.asarray(whole + moved - 0.5 + self.first)

        return codes.add_laws(codes=convert)
