"""Dark frames: black level, read noise, DSNU, and the dark current from a series of exposures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from lab.capture_kinds.base import (
    LONGEST_EXPOSURE_S,
    Adjustment,
    Capture,
    Equipment,
    FixedExposure,
    Sequence,
    Setting,
    Step,
    Target,
    back_step,
    check_number,
    planned_keys,
)
from lab.errors import InputError
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


class TemperatureTarget(Adjustment):
    """A temperature that an operator brings the sensors to: by the cooler, by what warms them, or by waiting. None:
    their usual one, whatever that is."""

    changes: ClassVar[str] = "the sensors' temperature"

    kind: Literal["sensor_temperature"]
    sensor_c: float | None = Field(default=None, ge=-150.0, le=150.0)

    @property
    def instruction(self) -> str:
        if self.sensor_c is None:
            return "set cooler or heater as usual, and wait until the sensors have their usual temperature"
        return f"bring the sensors to {self.sensor_c:g} C, and wait until they stay there"

    def is_usual(self, station: Equipment) -> bool:
        return self.sensor_c is None


class DarkSequence(Sequence):
    """`frames` dark frames at each exposure time `exposures_s`. `sensor_c`: the temperature that an operator brings the
    sensors to for it, and back at its end; None: they are as they are.

    The series of exposures is taken upwards and downwards in turn, so that a linear drift of the temperature doesn't
    bias the dark current."""

    name: ClassVar[str] = "dark"
    purpose: ClassVar[str] = "black level, read noise, DSNU, dark current"
    targets: ClassVar[tuple[type[Target], ...]] = (CapTarget,)
    adjustments: ClassVar[tuple[type[Adjustment], ...]] = (TemperatureTarget,)

    exposures_s: Annotated[
        tuple[float, ...], Quantity("s", "exposures of the series", lower=1e-6, upper=LONGEST_EXPOSURE_S)
    ] = Field(min_length=1, max_length=200)
    frames: Annotated[int, Quantity("1", "frames at each exposure", lower=1, upper=20_000)]

    sensor_c: Annotated[
        float | None, Quantity("C", "temperature that a hand brings the sensors to", lower=-150.0, upper=150.0)
    ] = None

    @model_validator(mode="after")
    def _check_bounds(self) -> Self:
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
        stem = "dark" if self.sensor_c is None else f"dark/{self.sensor_c:g}C"
        by_hand = () if self.sensor_c is None else (_temperature_of(station, self.sensor_c),)
        keys = {} if self.sensor_c is None else {"temperature_c": self.sensor_c}  # where the camera says none
        made: list[Step] = []
        if by_hand:
            what = f"sensors at {self.sensor_c:g} C"
            made.append(Step(id=f"{stem}/set", what=what, setting=Setting(target=cap, by_hand=by_hand)))
        for frame in range(1, self.frames + 1):
            series = self.exposures_s if frame % 2 else self.exposures_s[::-1]
            for exposure_s in series:
                id = f"{stem}/{exposure_s:g}s/{frame}"
                made.append(
                    Step(
                        id=id,
                        what=f"dark frame {frame} of {self.frames}, {exposure_s:g} s",
                        setting=Setting(target=cap, by_hand=by_hand),
                        exposure=FixedExposure(exposure_s=exposure_s),
                        captures=tuple(
                            DarkCapture.model_validate({"kind": "dark"} | planned_keys(id, side) | keys)
                            for side in station.sides
                        ),
                    )
                )
        return (*made, back_step(stem, TemperatureTarget, station)) if by_hand else tuple(made)


def _temperature_of(station: Equipment, sensor_c: float) -> str:
    """Return the name of the target that is the temperature. Raises InputError where the station has none."""
    there = station.list_targets(TemperatureTarget).items()
    known = {target.sensor_c: name for name, target in there if target.sensor_c is not None}
    if sensor_c in known:
        return known[sensor_c]
    have = ", ".join(f"{temperature_c:g} C" for temperature_c in sorted(known)) or "none"
    raise InputError(
        f"station: no target of kind 'sensor_temperature' with sensor_c = {sensor_c:g}; it has {have}; add "
        f'[targets."{sensor_c:g} C"] to the station file if the sensors can be brought there'
    )


class DarkCapture(Capture):
    """No light."""

    shows: ClassVar[str] = "nothing: shutter or cap closed"
    sequence: ClassVar[type[Sequence] | None] = DarkSequence
    clipping_matters: ClassVar[bool] = False

    kind: Literal["dark"]

    def scene(self, spectrum: Callable[[str], Spectrum]) -> Darkness:
        return Darkness()


KIND = DarkCapture
