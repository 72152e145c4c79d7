"""Dark frames: black level, read noise, DSNU, and the dark current from a ladder of exposures."""

from __future__ import annotations

from pydantic import Field

from lab.capture.sequences.steps import FixedExposure, Sequence, Setting, Step, common
from lab.capture.station import Cap, Station
from lab.formats.recording_set import Dark


class DarkSequence(Sequence):
    """`frames` dark frames at each of `exposures_s`; the ladder is gone up and down by turns, so that a drift of the
    temperature doesn't look like dark current."""

    exposures_s: tuple[float, ...] = Field(min_length=1)
    frames: int = Field(ge=1)

    def steps(self, station: Station) -> tuple[Step, ...]:
        """See `Sequence.steps`."""
        cap = station.one(Cap)
        made: list[Step] = []
        for frame in range(1, self.frames + 1):
            ladder = self.exposures_s if frame % 2 else self.exposures_s[::-1]
            for exposure_s in ladder:
                id = f"dark/{exposure_s:g}s/{frame}"
                made.append(
                    Step(
                        id=id,
                        what=f"dark frame {frame} of {self.frames}, {exposure_s:g} s",
                        setting=Setting(target=cap),
                        exposure=FixedExposure(exposure_s=exposure_s),
                        captures=tuple(
                            Dark.model_validate(common(id, side) | {"kind": "dark"}) for side in station.sides
                        ),
                    )
                )
        return tuple(made)
