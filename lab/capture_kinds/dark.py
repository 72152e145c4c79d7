"""Dark frames: black level, read noise, DSNU, and the dark current from a series of exposures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from lab.capture_kinds.base import (
    LONGEST_EXPOSURE_S,
    Capture,
    Equipment,
    FixedExposure,
    Sequence,
    Setting,
    Step,
    Target,
    check_number,
    planned_keys,
)
from sim.parameters import Quantity
from sim.scene.scenes import Darkness
from sim.spectrum import Spectrum

DARK_S = (0.0005, 0.05, 0.5, 2.0, 5.0)
QUICK_DARK_S = (0.0005, 0.5, 2.0, 5.0)


class CapTarget(Target):
    """No light reaches the cameras."""

    kind: Literal["cap"]

    @property
    def instruction(self) -> str:
        return "close every lens with its cap"


class DarkSequence(Sequence):
    """`frames` dark frames at each exposure time `exposures_s`.

    The series of exposures is taken upwards and downwards in turn, so that a linear drift of the temperature doesn't
    bias the dark current."""

    name: ClassVar[str] = "dark"
    purpose: ClassVar[str] = "black level, read noise, DSNU, dark current"
    targets: ClassVar[tuple[type[Target], ...]] = (CapTarget,)

    exposures_s: Annotated[
        tuple[float, ...], Quantity("s", "exposures of the series", lower=1e-6, upper=LONGEST_EXPOSURE_S)
    ] = Field(min_length=1, max_length=200)
    frames: Annotated[int, Quantity("1", "frames at each exposure", lower=1, upper=20_000)]

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        check_number(len(self.exposures_s) * self.frames)
        return self

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        limits = station.limits
        within = {
            min(max(exposure_s, limits.exposure_min_s), limits.exposure_max_s)
            for exposure_s in (QUICK_DARK_S if quick else DARK_S)
        }
        return cls(exposures_s=tuple(sorted(within)), frames=4)

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        cap = station.one(CapTarget)
        made: list[Step] = []
        for frame in range(1, self.frames + 1):
            series = self.exposures_s if frame % 2 else self.exposures_s[::-1]
            for exposure_s in series:
                id = f"dark/{exposure_s:g}s/{frame}"
                made.append(
                    Step(
                        id=id,
                        what=f"dark frame {frame} of {self.frames}, {exposure_s:g} s",
                        setting=Setting(target=cap),
                        exposure=FixedExposure(exposure_s=exposure_s),
                        captures=tuple(DarkCapture(kind="dark", **planned_keys(id, side)) for side in station.sides),
                    )
                )
        return tuple(made)


class DarkCapture(Capture):
    """No light."""

    shows: ClassVar[str] = "nothing: shutter or cap closed"
    sequence: ClassVar[type[Sequence] | None] = DarkSequence
    clipping_matters: ClassVar[bool] = False

    kind: Literal["dark"]

    def scene(self, spectrum: Callable[[str], Spectrum]) -> Darkness:
        return Darkness()


KIND = DarkCapture
