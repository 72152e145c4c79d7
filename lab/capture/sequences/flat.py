"""Flat fields in white light, from near dark to beyond saturation: the photon transfer, PRNU and linearity."""

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
from lab.formats.recording_set import Flat


class FlatSequence(Sequence):
    """`frames` flats at each of `levels`, shares of the exposure at which the brightest channel saturates.

    The exposures are those of one camera each, found at `level_found`. The ladder is gone up and down by turns, and the
    radiance is measured before each turn: a drift of the lamp shows as a difference of the turns.
    """

    levels: tuple[float, ...] = Field(min_length=1)
    frames: int = Field(ge=1)
    level_found: float = 0.75

    def steps(self, station: Station) -> tuple[Step, ...]:
        """See `Sequence.steps`."""
        needs(station, "flat", "monochromator", "spectroradiometer")
        lit = Setting(target=station.one(Sphere), wavelength_nm=0.0)
        found = Step(
            id="flat/exposure",
            what="flat field: finding the exposure",
            setting=lit,
            exposure=FindExposure(level=self.level_found),
        )
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
                            Flat.model_validate(common(id, side) | {"kind": "flat", "radiance": spectrum_path(light)})
                            for side in station.sides
                        ),
                    )
                )
        return tuple(made)
