"""The figures of a calibration: every number of a fit that has a standard deviation, by the name that `compare` gives
it.

Curves and kernels are left out: they have no single value that a limit could bound. What is read off them (MTF50) is
there."""

from __future__ import annotations

from lab.fit.compare import FEW, numbers_of, place_of
from lab.fit.noise.dark_current import SensorTemperature
from lab.formats.results import FitResult
from lab.formats.results.figure_names import plain_name, unit_of
from sim.camera import Side
from sim.parameters import Frozen


class Figure(Frozen):
    """One number of a calibration. `side` None: of the pair; `place`: which of several numbers under one name (`fx`),
    else empty. `sensor`: of a dark current, at which temperature it was measured."""

    name: str
    side: Side | None = None
    place: str = ""
    value: float
    std: float
    sensor: SensorTemperature | None = None

    @property
    def title(self) -> str:
        """The plain name: `focal length x`, `dark current at 31.0 °C`."""
        name = plain_name(self.name, self.place)
        return name if self.sensor is None else f"{name} {self.sensor.text}"

    @property
    def unit(self) -> str:
        """The unit, "1" for a ratio."""
        return unit_of(self.name)


def figures_of(fit: FitResult) -> tuple[Figure, ...]:
    """All figures of a fit, each once."""
    found: list[Figure] = []
    models = [(side, camera, "") for side, camera in fit.cameras.items()]
    parts = [*models, (None, fit.stereo, "stereo ")] if fit.stereo is not None else models
    for side, model, prefix in parts:
        for name, numbers in numbers_of(model, prefix):
            if numbers.value.size > FEW:
                continue
            for at, (value, std) in enumerate(zip(numbers.value.ravel(), numbers.std.ravel(), strict=True)):
                if abs(value) < float("inf") and 0.0 <= std < float("inf"):
                    place = place_of(numbers, at)
                    found.append(
                        Figure(
                            name=name, side=side, place=place, value=float(value), std=float(std), sensor=numbers.sensor
                        )
                    )
    return tuple(found)
