"""The smallest detectable magnitude of a parameter, and the name and unit by which a result states it."""

from __future__ import annotations

import numpy as np
from scipy import optimize, special

from lab.diagnose.policy import DecisionPolicy
from sim.effects.base import Effect
from sim.parameters import Quantity
from sim.spectrum import FloatArray


def told_as(field: str, quantity: Quantity, *, gain_is_known: bool) -> tuple[str, str]:
    """Name and unit of an effect's parameter in a result. Without a known gain the baseline has 1 DN/e, so that its
    electrons are DN."""
    if gain_is_known or quantity.unit not in ("e", "e/s"):
        return field, quantity.unit
    stem, _, more = field.rpartition("_e")
    return f"{stem}_dn{more}", quantity.unit.replace("e", "DN")


def detectable(threshold: float, probability: float = DecisionPolicy().detection_probability) -> float:
    """Return the non-centrality lambda with P(chi2_1(lambda) > threshold) = probability."""
    return float(
        optimize.brentq(lambda x: 1.0 - special.chndtr(threshold, 1, x) - probability, 1e-6, 10.0 * threshold + 100.0)
    )


def smallest_sizes(
    effect: type[Effect], members: list[tuple[tuple[Effect, ...], FloatArray]], needed: float
) -> dict[str, float]:
    """Parameter -> least departure from `absent` at which the non-centrality is `needed`. Empty for effects with
    prototypes of shape, whose signature isn't a power of the size."""
    found: dict[str, float] = {}
    if effect.shapes:
        return found
    for prototypes, table in members:
        for prototype, column in zip(prototypes, table.T, strict=True):
            size = float(np.linalg.norm(column))
            moved = {f: q for f, q in effect.quantities().items() if getattr(prototype, f) != (q.absent or 0.0)}
            if size <= 0 or len(moved) != 1:
                continue
            ((field, quantity),) = moved.items()
            away = abs(float(getattr(prototype, field)) - (quantity.absent or 0.0))
            least = away * (np.sqrt(needed) / size) ** (1.0 / quantity.linear_power)
            found[field] = min(found.get(field, np.inf), float(least))
    return {field: value for field, value in found.items() if np.isfinite(value)}
