"""Parameters of effects as coordinates in which predictions have a slope where the effect is absent: those of a camera
model's posterior, and of the uses that are linear in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Effects
from sim.parameters import Quantity
from sim.spectrum import FloatArray

#: The prior's width in a fit, in declared standard deviations: a camera at hand needn't be typical.
PRIOR_WIDTH = 3.0
#: A typical size of the logarithm of a parameter, and the least value of which there is one.
TYPICAL_LOG, LEAST = 0.1, 1e-9


@dataclass(frozen=True)
class EffectCoordinate:
    """One parameter of one effect as u = sign(p - absent) |p - absent|^linear_power, in which predictions have a slope
    at `absent`; as u = ln p where it is declared logarithmic."""

    index: int  # of the effect in its set
    name: str
    quantity: Quantity

    @property
    def absent(self) -> float:
        """The parameter's value that means that the effect isn't there."""
        return self.quantity.absent or 0.0

    def to_u(self, value: float) -> float:
        """u of a parameter's value."""
        if self.quantity.logarithmic:
            return float(np.log(max(value, LEAST)))
        away = value - self.absent
        return float(np.sign(away) * abs(away) ** self.quantity.linear_power)

    def to_value(self, u: float) -> float:
        """Return the parameter's value of u, within its bounds."""
        if self.quantity.logarithmic:
            value = float(np.exp(u))
        else:
            value = self.absent + float(np.sign(u) * abs(u) ** (1.0 / self.quantity.linear_power))
        low = self.quantity.lower if self.quantity.lower is not None else -np.inf
        high = self.quantity.upper if self.quantity.upper is not None else np.inf
        return min(max(value, low), high)

    @property
    def bounds(self) -> tuple[float, float]:
        """Of u."""
        low, high = self.quantity.lower, self.quantity.upper
        return (-np.inf if low is None else self.to_u(low), np.inf if high is None else self.to_u(high))

    def typical(self, value: float) -> float:
        """Return a typical size of u for a parameter at `value`."""
        if self.quantity.logarithmic:
            return TYPICAL_LOG
        width = self.quantity.prior[1] if self.quantity.prior is not None else 5.0
        if self.quantity.linear_power == 1:
            return width
        return max(abs(self.to_u(value)), 0.05 * width**self.quantity.linear_power)


def coordinates(effects: Effects, camera: CameraModel) -> list[EffectCoordinate]:
    """Return all coordinates of a set of effects, within the bounds that hardware sets for this camera."""
    return [
        EffectCoordinate(i, name, q) for i, e in enumerate(effects) for name, q in type(e).quantities_of(camera).items()
    ]


def moved(effects: Effects, coords: Sequence[EffectCoordinate], u: FloatArray) -> tuple[Effect, ...]:
    """Return the effects with these coordinates at `u`."""
    values: list[dict[str, float]] = [{} for _ in effects]
    for c, at in zip(coords, u, strict=True):
        values[c.index][c.name] = c.to_value(float(at))
    return tuple(e.replace_fields(**v) for e, v in zip(effects, values, strict=True))


def coordinate_prior(coords: Sequence[EffectCoordinate]) -> tuple[FloatArray, FloatArray]:
    """Centre and standard deviation of every coordinate's prior, infinite where none is declared."""
    centre = np.array(
        [c.to_u(c.quantity.prior[0]) if c.quantity.prior and c.quantity.linear_power == 1 else 0.0 for c in coords]
    )
    width = [PRIOR_WIDTH * c.quantity.prior[1] if c.quantity.prior else np.inf for c in coords]
    of_u = [
        w / c.quantity.prior[0] if c.quantity.logarithmic and c.quantity.prior else w**c.quantity.linear_power
        for w, c in zip(width, coords, strict=True)
    ]
    return centre, np.array(of_u)
