"""Flat fields in white light, from near dark to beyond saturation: photon transfer, PRNU and linearity."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import ClassVar, Literal, Self

from pydantic import Field

from lab.capture_kinds.base import (
    Capture,
    Equipment,
    RelativeExposure,
    Sequence,
    Setting,
    SpectrumPath,
    Step,
    Target,
    exposure_step,
    planned_keys,
    spectrum_path,
)
from sim.scene.scenes import Scene, UniformField
from sim.spectrum import Spectrum

#: Levels, shares of the brightest channel's saturation: dense where the photon transfer curve bends, and beyond 1 so that the frame's
#: corners and the darker channels saturate, too.
LEVELS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.15, 1.4, 1.8, 2.3)
QUICK_LEVELS = (0.03, 0.1, 0.25, 0.4, 0.55, 0.7, 0.87, 1.2, 1.6)


class SphereTarget(Target):
    """The port of the integrating sphere: uniform diffuse light from the monochromator."""

    kind: Literal["sphere"]

    @property
    def instruction(self) -> str:
        return "put the port of the integrating sphere before the cameras, so that it fills both fields"


class FlatSequence(Sequence):
    """`frames` flats at each of `levels`, shares of the exposure at which the brightest channel saturates.

    Each camera has exposures of its own, found at `level_found`. The ladder is taken upwards and downwards in turn, and the
    radiance is measured before each turn: a drift of the lamp is a difference between the turns.
    """

    name: ClassVar[str] = "flat"
    instruments: ClassVar[tuple[str, ...]] = ("monochromator", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (SphereTarget,)

    levels: tuple[float, ...] = Field(min_length=1)
    frames: int = Field(ge=1)
    level_found: float = 0.75

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        if station.lacks(*cls.instruments):
            return None
        return cls(levels=QUICK_LEVELS if quick else LEVELS, frames=4)

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station)
        lit = Setting(target=station.one(SphereTarget), wavelength_nm=0.0)
        found = exposure_step("flat", "flat field", lit, self.level_found, measures_light=False)
        made = [found]
        for frame in range(1, self.frames + 1):
            light = f"flat/light/{frame}"
            made.append(
                Step(id=light, what="flat field: measuring the light", setting=lit, radiance=spectrum_path(light))
            )
            numbered = list(enumerate(self.levels, start=1))
            for number, level in numbered if frame % 2 else numbered[::-1]:
                id = f"flat/level-{number:02d}/{frame}"
                made.append(
                    Step(
                        id=id,
                        what=f"flat field, level {number} of {len(self.levels)}, frame {frame} of {self.frames}",
                        setting=lit,
                        exposure=RelativeExposure(of=found.id, factor=level / self.level_found),
                        captures=tuple(
                            FlatCapture(kind="flat", radiance=spectrum_path(light), **planned_keys(id, side))
                            for side in station.sides
                        ),
                    )
                )
        return tuple(made)


class FlatCapture(Capture):
    """Uniform light: `radiance` (CSV, W sr^-1 m^-2 nm^-1), or `photons_per_pixel` in this exposure at `wavelength_nm`."""

    shows: ClassVar[str] = "uniform diffuse light filling the field"
    sequence: ClassVar[type[Sequence] | None] = FlatSequence

    kind: Literal["flat"]
    radiance: SpectrumPath | None = None
    photons_per_pixel: float | None = Field(default=None, ge=0)
    wavelength_nm: float | None = Field(default=None, gt=0)

    def remarks(self) -> Iterator[str]:
        if self.radiance is None and self.photons_per_pixel is None:
            yield "neither radiance nor photons_per_pixel: it tells of noise, not of sensitivity; add what is known"

    def scene(self, spectrum: Callable[[str], Spectrum]) -> Scene | None:
        return None if self.radiance is None else UniformField(spectrum(self.radiance), self.kind)


KIND = FlatCapture
