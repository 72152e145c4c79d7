"""The smallest detectable size of each effect in these recordings, and the effect that is most like it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import optimize, special

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.score import signatures
from lab.diagnose.outcome.in_dn import told_as
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import Visibility
from sim.camera import Side
from sim.effects.base import Effect
from sim.effects.library import candidates
from sim.effects.library import effects as library
from sim.spectrum import FloatArray


def detectable(threshold: float, probability: float = DecisionPolicy().detection_probability) -> float:
    """Return the non-centrality lambda with P(chi2_1(lambda) > threshold) = probability."""
    return float(
        optimize.brentq(lambda x: 1.0 - special.chndtr(threshold, 1, x) - probability, 1e-6, 10.0 * threshold + 100.0)
    )


def detectability(side: Side, verdict: Verdict, policy: DecisionPolicy) -> Iterator[Visibility]:
    """For every effect that acts on what was recorded: the smallest detectable size of each parameter, and the nearest
    effect.

    The non-centrality |L^-1 dm|^2 of a signature grows as the square of the coordinate u, so that the size follows from
    one instance. Two effects of cosine rho are told apart with probability Phi(1/2 sqrt(lambda (1 - rho^2))).
    """
    model = verdict.model
    if not np.isfinite(verdict.threshold):
        return
    sets: dict[str, list[tuple[tuple[Effect, ...], FloatArray]]] = {}
    for effect, prototypes, table in signatures(model, model.camera, (), candidates()).columns:
        sets.setdefault(effect.name, []).append((prototypes, table))
    unit = {
        name: np.concatenate([t / np.maximum(np.linalg.norm(t, axis=0), 1e-300) for _, t in members], axis=1)
        for name, members in sets.items()
    }
    needed = detectable(verdict.threshold, policy.detection_probability)
    for name, members in sets.items():
        cosines = {other: float(np.abs(unit[name].T @ unit[other]).max()) for other in unit if other != name}
        nearest = max(cosines, key=lambda other: cosines[other], default=None)
        cosine = min(cosines[nearest], 1.0) if nearest is not None else 0.0
        yield Visibility(
            side=side,
            effect=name,
            smallest={
                told_as(field, library()[name].quantities()[field], gain_is_known=model.gain_is_known)[0]: size
                for field, size in _smallest(library()[name], members, needed).items()
            },
            nearest=nearest,
            cosine=cosine,
            told_apart=float(special.ndtr(0.5 * np.sqrt(needed * (1.0 - cosine**2)))),
        )


def _smallest(
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
