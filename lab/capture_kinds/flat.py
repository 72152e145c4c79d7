"""Flat fields in white light, from near dark to beyond saturation: photon transfer, PRNU and linearity."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from lab.capture_kinds.base import (
    LONGEST_EXPOSURE_S,
    Equipment,
    FindExposure,
    FixedExposure,
    Level,
    RelativeExposure,
    Sequence,
    Setting,
    SpectrumPath,
    Step,
    Target,
    check_number,
    exposure_step,
    planned_keys,
    spectrum_path,
)
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.irradiance import IrradianceCapture
from lab.capture_kinds.lamp import LAMP_INSTRUMENTS, ColourTemperature, LampLevel, check_lamp, lamp_channels, lamp_words
from sim.parameters import Quantity
from sim.scene.scenes import Scene, UniformField
from sim.spectrum import Spectrum

#: Levels, shares of the brightest channel's saturation: dense where the photon transfer curve bends, and beyond 1 so
#: that the frame's corners and the darker channels saturate, too.
LEVELS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.15, 1.4, 1.8, 2.3)
#: Share of saturation, and number, of the bright flats before dark frames.
BRIGHT, BRIGHT_FRAMES = 0.9, 3
QUICK_LEVELS = (0.03, 0.1, 0.25, 0.4, 0.55, 0.7, 0.87, 1.2, 1.6)


class SphereTarget(Target):
    """The port of the integrating sphere: uniform diffuse light from the monochromator."""

    kind: Literal["sphere"]

    @property
    def instruction(self) -> str:
        return "put the port of the integrating sphere before the cameras, so that it fills both fields"


class FlatSequence(Sequence):
    """`frames` flats at each of `levels`, shares of the exposure at which the brightest channel saturates.

    Each camera has exposures of its own, scaled from that found for `level_found`. The series of levels is taken
    upwards and downwards in turn. The radiance is measured before each turn, so that a drift of the lamp shows as a
    difference between turns. `wavelength_nm`: of the light, 0 is white; with one wavelength a photodiode measures the
    irradiance before each frame (EMVA 1288). `gains_db`: further gains of the cameras at which the whole is taken
    again, with exposures found anew: with the gain of a multiplying register its excess noise changes, while that of
    an amplifier keeps the shot noise of electrons. `darks_after`: dark frames of `dark_after_s` that follow bright
    flats at the end, the light closed: they show charge that stays behind (image lag, persistence), which dark frames
    before any light don't. With a `lamp_level` above 0 the light source lights the sphere in place of the
    monochromator: its light of `colour_temperature_k`, or of `wavelength_nm`, else the first of the station file."""

    name: ClassVar[str] = "flat"
    purpose: ClassVar[str] = "conversion gain, PRNU, full well, linearity (photon transfer)"
    instruments: ClassVar[tuple[str, ...]] = ("monochromator", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (SphereTarget,)

    levels: Annotated[
        tuple[float, ...], Quantity("1", "levels of the series, shares of saturation", lower=1e-4, upper=20.0)
    ] = Field(min_length=1, max_length=200)
    frames: Annotated[int, Quantity("1", "frames at each level", lower=1, upper=20_000)]
    level_found: Level = 0.75
    wavelength_nm: Annotated[float, Quantity("nm", "wavelength of the light; 0: white", lower=0.0, upper=5000.0)] = 0.0
    gains_db: Annotated[
        tuple[float, ...], Quantity("dB", "further gains at which flats are taken", lower=-40.0, upper=80.0)
    ] = Field(default=(), max_length=20)
    darks_after: Annotated[
        int, Quantity("1", "dark frames after bright flats, the light's shutter closed", lower=0, upper=1000)
    ] = 0
    dark_after_s: Annotated[float, Quantity("s", "exposure of each of them", lower=1e-6, upper=LONGEST_EXPOSURE_S)] = (
        2.0
    )
    lamp_level: LampLevel = 0.0
    colour_temperature_k: ColourTemperature = None

    @model_validator(mode="after")
    def _check_bounds(self) -> Self:
        check_lamp(self.lamp_level, self.colour_temperature_k)
        check_number(len(self.levels) * self.frames * (1 + len(self.gains_db)) + self.darks_after)
        return self

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        levels = QUICK_LEVELS if quick else LEVELS
        if station.lacks(*cls.instruments):
            return None if station.lacks(*LAMP_INSTRUMENTS) else cls(levels=levels, frames=4, lamp_level=1.0)
        return cls(levels=levels, frames=4, wavelength_nm=station.limits.flat_wavelength_nm or 0.0)

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station, LAMP_INSTRUMENTS if self.lamp_level else None)
        gains: tuple[float | None, ...] = (None, *self.gains_db)
        series = [self._series(station, gain_db) for gain_db in gains]
        return (*(step for steps in series for step in steps), *self._after(station, series[0]))

    def _after(self, station: Equipment, series: list[Step]) -> list[Step]:
        """Return the steps of the dark frames after bright flats, whose light and exposure are those of a series."""
        if not self.darks_after:
            return []
        searched = next(step for step in series if isinstance(step.exposure, FindExposure))
        light = next(step for step in series[::-1] if step.radiance is not None)
        stem = searched.id.removesuffix("/exposure")
        made = []
        for frame in range(1, BRIGHT_FRAMES + 1):
            id = f"{stem}/before-dark/{frame}"
            captures = tuple(
                FlatCapture(kind="flat", radiance=light.radiance, wavelength_nm=self.wavelength_nm or None,
                            colour_temperature_k=self.colour_temperature_k, **planned_keys(id, side))
                for side in station.sides
            )  # fmt: skip
            exposure = RelativeExposure(of=searched.id, factor=BRIGHT / self.level_found)
            what = f"bright flat {frame} of {BRIGHT_FRAMES}, before dark frames"
            made.append(Step(id=id, what=what, setting=searched.setting, exposure=exposure, captures=captures))
        closed = searched.setting.model_copy(update={"wavelength_nm": None, "slit_um": None, "lamp": {}})
        for frame in range(1, self.darks_after + 1):
            id = f"{stem}/dark-after/{frame}"
            darks = tuple(DarkCapture(kind="dark", **planned_keys(id, side)) for side in station.sides)
            what = f"dark frame {frame} of {self.darks_after} after bright flats"
            exposure_s = FixedExposure(exposure_s=self.dark_after_s)
            made.append(Step(id=id, what=what, setting=closed, exposure=exposure_s, captures=darks))
        return made

    def _series(self, station: Equipment, gain_db: float | None) -> list[Step]:
        """Return the steps of all levels at one gain; None: the station's."""
        stem, what = f"flat/{self.wavelength_nm:g}nm" if self.wavelength_nm else "flat", "flat field"
        sphere = station.one(SphereTarget)
        if self.lamp_level:
            channels = lamp_channels(station.lights, self.lamp_level, self.colour_temperature_k, self.wavelength_nm)
            lit = Setting(target=sphere, lamp=channels, gain_db=gain_db)
            stem = f"{stem}/{lamp_words(self.lamp_level, self.colour_temperature_k)}"
        else:
            slit_um = station.limits.slit_um if self.wavelength_nm else None
            lit = Setting(target=sphere, wavelength_nm=self.wavelength_nm, slit_um=slit_um, gain_db=gain_db)
        if gain_db is not None:
            stem, what = f"{stem}/{gain_db:g}dB", f"{what} at {gain_db:g} dB"
        search = exposure_step(stem, what, lit, self.level_found, measures_light=False)
        made = [search]
        for frame in range(1, self.frames + 1):
            light = f"{stem}/light/{frame}"
            made.append(Step(id=light, what=f"{what}: measuring the light", setting=lit, radiance=spectrum_path(light)))
            numbered = list(enumerate(self.levels, start=1))
            for number, level in numbered if frame % 2 else numbered[::-1]:
                id = f"{stem}/level-{number:02d}/{frame}"
                made.append(
                    Step(
                        id=id,
                        what=f"{what}, level {number} of {len(self.levels)}, frame {frame} of {self.frames}",
                        setting=lit,
                        exposure=RelativeExposure(of=search.id, factor=level / self.level_found),
                        captures=tuple(
                            FlatCapture(
                                kind="flat",
                                radiance=spectrum_path(light),
                                wavelength_nm=self.wavelength_nm or None,
                                colour_temperature_k=self.colour_temperature_k,
                                **planned_keys(id, side),
                            )
                            for side in station.sides
                        ),
                    )
                )
        return made


class FlatCapture(IrradianceCapture):
    """Uniform light: `radiance` (CSV, W sr^-1 m^-2 nm^-1), or `photons_per_pixel` in this exposure at `wavelength_nm`,
    or `irradiance_w_m2` with its standard uncertainties, of light of this wavelength where the sensor is."""

    shows: ClassVar[str] = "uniform diffuse light filling the field"
    sequence: ClassVar[type[Sequence] | None] = FlatSequence

    kind: Literal["flat"]
    radiance: SpectrumPath | None = None
    photons_per_pixel: float | None = Field(default=None, ge=0)

    def remarks(self) -> Iterator[str]:
        yield from super().remarks()
        if self.irradiance_w_m2 is not None and self.wavelength_nm is None:
            yield "irradiance_w_m2 without wavelength_nm: the number of photons isn't known; add the wavelength"
        if self.radiance is None and self.photons_per_pixel is None and self.irradiance_w_m2 is None:
            yield "neither radiance nor photons_per_pixel: it determines noise, but no sensitivity; add what is known"

    def scene(self, spectrum: Callable[[str], Spectrum]) -> Scene | None:
        return None if self.radiance is None else UniformField(spectrum(self.radiance), self.kind)


KIND = FlatCapture
