"""The figures of a calibration: every number of a fit that has a standard deviation, by the name that `compare` gives it.

Curves and kernels are left out: they have no single value that a limit could bound. What is read off them (MTF50) is there.
"""

from __future__ import annotations

from lab.fit.compare import FEW, numbers_of, place_of
from lab.formats.results import FitResult
from sim.camera import Side
from sim.parameters import Frozen


class Figure(Frozen):
    """One number of a calibration. `side` None: of the pair; `place`: which of several numbers under one name (`fx`), else empty."""

    name: str
    side: Side | None = None
    place: str = ""
    value: float
    std: float


def figures_of(fit: FitResult) -> tuple[Figure, ...]:
    """All figures of a fit."""
    found: list[Figure] = []
    models = [(side, camera, "") for side, camera in fit.cameras.items()]
    parts = [*models, (None, fit.stereo, "stereo ")] if fit.stereo is not None else models
    for side, model, prefix in parts:
        for name, numbers in numbers_of(model, prefix):
            if numbers.value.size > FEW:
                continue
            for at, (value, std) in enumerate(zip(numbers.value.ravel(), numbers.std.ravel(), strict=True)):
                if abs(value) < float("inf") and 0.0 <= std < float("inf"):
                    figure = Figure(
                        name=name, side=side, place=place_of(numbers, at), value=float(value), std=float(std)
                    )
                    found.append(figure)
    return tuple(found)
