"""Light of one wavelength after another from the monochromator: the spectral sensitivity."""

from __future__ import annotations

from pydantic import Field

from lab.capture.sequences.steps import (
    FindExposure,
    RelativeExposure,
    Sequence,
    Setting,
    Step,
    common,
    needs,
    spectrum_path,
)
from lab.capture.station import Sphere, Station
from lab.formats.recording_set import Narrowband


class NarrowbandSequence(Sequence):
    """From `from_nm` to `to_nm` by `step_nm` and back, `passes` times in all; the light is measured at every visit.

    Going there and back cancels a linear drift of the lamp. The exposures are found on the first pass and kept.
    """

    from_nm: float = Field(default=400.0, gt=0)
    to_nm: float = Field(default=720.0, gt=0)
    step_nm: float = Field(default=10.0, gt=0)
    passes: int = Field(default=2, ge=1)
    level: float = 0.7

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """The wavelengths in ascending order, both ends included."""
        count = int((self.to_nm - self.from_nm) / self.step_nm + 1e-9) + 1
        return tuple(self.from_nm + n * self.step_nm for n in range(count))

    def steps(self, station: Station) -> tuple[Step, ...]:
        """See `Sequence.steps`."""
        needs(station, "narrowband", "monochromator", "spectroradiometer")
        sphere = station.one(Sphere)
        made: list[Step] = []
        for turn in range(1, self.passes + 1):
            for wavelength_nm in self.wavelengths_nm if turn % 2 else self.wavelengths_nm[::-1]:
                stem = f"narrowband/{wavelength_nm:g}nm"
                lit = Setting(target=sphere, wavelength_nm=wavelength_nm, slit_um=station.limits.slit_um)
                if turn == 1:
                    made.append(
                        Step(
                            id=f"{stem}/exposure",
                            what=f"narrowband {wavelength_nm:g} nm: finding the exposure",
                            setting=lit,
                            exposure=FindExposure(level=self.level),
                        )
                    )
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
                            Narrowband.model_validate(
                                common(id, side)
                                | {"kind": "narrowband", "wavelength_nm": wavelength_nm, "radiance": path}
                            )
                            for side in station.sides
                        ),
                    )
                )
        return tuple(made)
