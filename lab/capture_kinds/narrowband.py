"""Light of one wavelength after another from the monochromator: the spectral sensitivity."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from lab.capture_kinds.base import (
    Equipment,
    Level,
    Reading,
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
from lab.capture_kinds.flat import SphereTarget
from lab.capture_kinds.irradiance import IrradianceCapture
from sim.parameters import Quantity
from sim.scene.scenes import Scene, UniformField
from sim.spectrum import Spectrum


class NarrowbandSequence(Sequence):
    """Wavelengths from `from_nm` to `to_nm` by `step_nm` in `passes` passes, up and down in turn. The light is measured
    at every visit.

    Up and down together cancel a linear drift of the lamp. The exposures are found in the first pass and kept.
    """

    name: ClassVar[str] = "narrowband"
    purpose: ClassVar[str] = "spectral sensitivity, quantum efficiency"
    instruments: ClassVar[tuple[str, ...]] = ("monochromator", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (SphereTarget,)

    from_nm: Annotated[float, Quantity("nm", "first wavelength", lower=150.0, upper=3000.0)] = 400.0
    to_nm: Annotated[float, Quantity("nm", "last wavelength", lower=150.0, upper=3000.0)] = 720.0
    step_nm: Annotated[float, Quantity("nm", "from one wavelength to the next", lower=0.1, upper=500.0)] = 10.0
    passes: Annotated[int, Quantity("1", "times that every wavelength is visited", lower=1, upper=20)] = 2
    level: Level = 0.7

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        if self.to_nm < self.from_nm:
            raise ValueError(f"to_nm: {self.to_nm:g} nm is below from_nm, {self.from_nm:g} nm; exchange them")
        check_number((self.to_nm - self.from_nm) / self.step_nm * (self.passes + 1))
        return self

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        return None if station.lacks(*cls.instruments) else cls()

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """The wavelengths in ascending order, both ends included."""
        count = int((self.to_nm - self.from_nm) / self.step_nm + 1e-9) + 1
        return tuple(self.from_nm + n * self.step_nm for n in range(count))

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station)
        sphere = station.one(SphereTarget)
        made: list[Step] = []
        for turn in range(1, self.passes + 1):
            for wavelength_nm in self.wavelengths_nm if turn % 2 else self.wavelengths_nm[::-1]:
                stem = f"narrowband/{wavelength_nm:g}nm"
                lit = Setting(target=sphere, wavelength_nm=wavelength_nm, slit_um=station.limits.slit_um)
                if turn == 1:
                    what = f"narrowband {wavelength_nm:g} nm"
                    made.append(exposure_step(stem, what, lit, self.level, measures_light=False))
                id = f"{stem}/{turn}"
                path = spectrum_path(id)
                made.append(
                    Step(
                        id=id,
                        what=f"narrowband {wavelength_nm:g} nm, pass {turn} of {self.passes}",
                        setting=lit,
                        radiance=path,
                        exposure=RelativeExposure(of=f"{stem}/exposure"),
                        captures=tuple(
                            NarrowbandCapture(
                                kind="narrowband", wavelength_nm=wavelength_nm, radiance=path, **planned_keys(id, side)
                            )
                            for side in station.sides
                        ),
                    )
                )
        return tuple(made)


class NarrowbandCapture(IrradianceCapture):
    """Uniform light of one wavelength: `wavelength_nm` and `bandwidth_nm` (FWHM) as set, `radiance` as measured;
    `irradiance_w_m2` and its standard uncertainties as a reference photodiode measured them at its place, where the
    station has one."""

    shows: ClassVar[str] = "uniform diffuse light from the monochromator, filling the field"
    sequence: ClassVar[type[Sequence] | None] = NarrowbandSequence

    kind: Literal["narrowband"]
    wavelength_nm: float = Field(gt=0)
    bandwidth_nm: Annotated[float | None, Reading("bandwidth_nm")] = Field(default=None, ge=0)
    radiance: SpectrumPath

    def scene(self, spectrum: Callable[[str], Spectrum]) -> Scene | None:
        return UniformField(spectrum(self.radiance), self.kind)


KIND = NarrowbandCapture
