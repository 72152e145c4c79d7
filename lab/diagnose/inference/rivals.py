"""Rivals: pairs of effects whose signatures are nearly parallel in what was measured, so that either may be taken for
the other.

With whitened signatures a and b of non-centrality lambda (nuisance parameters marginalised), two effects are told apart
with probability Phi(1/2 sqrt(lambda (1 - rho^2))), rho = a'b / (|a| |b|). The relation is symmetric by construction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations

import numpy as np

from lab.diagnose.inference.measurement_model import MeasurementModel
from sim.effects.base import Effect
from sim.spectrum import FloatArray

#: Signatures of a smaller norm, at the effect's typical size, aren't compared: nothing can be told from them.
LEAST_NORM = 0.3


def signature_changes(model: MeasurementModel, kinds: Iterable[type[Effect]]) -> dict[str, FloatArray]:
    """Changes of the baseline's prediction by every effect's prototypes, (n, prototypes), of those effects that change
    any."""
    base, found = model.mean(), {}
    for kind in kinds:
        if model.affected(kind).any():
            prototypes = [p for alternative in kind.prototypes(model.camera) for p in alternative]
            table = np.stack([model.mean((p,)) - base for p in prototypes], axis=1)
            if table.any():
                found[kind.name] = table
    return found


def whitened(model: MeasurementModel, changes: Mapping[str, FloatArray], where: np.ndarray) -> dict[str, FloatArray]:
    """Changes of the numbers that `where` (n,) marks, as a session with these alone would have them whitened."""
    if not where.any():
        return {}
    gaussian = model.gaussian((), where)
    return {name: gaussian.whiten(table[where]) for name, table in changes.items() if table[where].any()}


def parallel_pairs(
    signatures: Mapping[str, FloatArray], cosine: float, least_norm: float = LEAST_NORM
) -> set[tuple[str, str]]:
    """Pairs of names of which any two columns have at least this cosine. Signs count: a one-sided effect is no rival of
    its opposite; an effect of either sign has columns of both."""
    unit = {}
    for name, table in signatures.items():
        norm = np.linalg.norm(table, axis=0)
        if (norm > least_norm).any():
            unit[name] = table[:, norm > least_norm] / norm[norm > least_norm]
    return {(a, b) for a, b in combinations(unit, 2) if float((unit[a].T @ unit[b]).max()) >= cosine}


def symmetric(names: Iterable[str], pairs: Iterable[tuple[str, str]]) -> dict[str, frozenset[str]]:
    """Return the pairs as a mapping from each name to its partners."""
    partners: dict[str, set[str]] = {name: set() for name in names}
    for a, b in pairs:
        partners[a].add(b)
        partners[b].add(a)
    return {name: frozenset(others) for name, others in partners.items()}
