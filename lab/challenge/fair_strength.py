"""How well the concealed laws of one case can be identified at best: a linear Gaussian problem.

All vectors are changes of the summaries (the measured numbers), (n,), whitened: noise has unit variance, and nuisance
parameters are marginalised. P[J] is the projection orthogonal to directions J, and d the change by the concealed law i:

    conditional non-centrality   lambda(i | j) = |P[J_j] d|^2               the part that the other concealed law can't
    imitate separability                 min over rivals k of |P[J_j, J_k] d|^2     the part that no rival beside it can
    imitate, either

They are the minimal detectable and the minimal identifiable bias of geodesy (Baarda 1968; Teunissen 2018, J Geod
92:59). The oracle knows all directions and only has to choose among them. Its share of right answers, found by Monte
Carlo, is the best that a method can reach on these summaries, except for the information in the signs of parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import chi2

from sim.spectrum import FloatArray

#: Ratio to the largest singular value below which a direction isn't counted: two instances of one effect differ by
#: curvature.
DISTINCT = 0.1
#: The oracle's rate of false alarms on healthy cameras, and the draws of the noise that set its thresholds: the rate is
#: known to 1 / sqrt(FALSE_ALARMS * NOISE_DRAWS) = 10 %.
FALSE_ALARMS, NOISE_DRAWS = 0.01, 10000


@dataclass(frozen=True)
class Directions:
    """Orthonormal basis (n, m) of the changes that an effect can make. A name may have several, of which one
    applies."""

    name: str
    basis: FloatArray


def span(vectors: FloatArray) -> FloatArray:
    """Orthonormal basis (n, m) of the distinct directions of `vectors` (n, k), without those of length 0."""
    size = np.linalg.norm(vectors, axis=0)
    unit = vectors[:, size > 0.0] / size[size > 0.0]
    if not unit.shape[1]:
        return np.zeros((len(vectors), 0))
    left, values, _ = np.linalg.svd(unit, full_matrices=False)
    return np.asarray(left[:, values > DISTINCT * values[0]])


def joined(*bases: FloatArray) -> FloatArray:
    """Orthonormal basis of the space that several bases span together."""
    table = np.concatenate(bases, axis=1)
    left, values, _ = np.linalg.svd(table, full_matrices=False)
    return np.asarray(left[:, values > 1e-6 * max(float(values.max(initial=0.0)), 1e-300)])


def with_direction(basis: FloatArray, change: FloatArray) -> FloatArray:
    """The basis (n, m) of an effect whose concealed law changes the summaries by `change` (n,): its direction nearest
    to that of `change` is replaced by that of `change`."""
    unit = change[:, None] / max(float(np.linalg.norm(change)), 1e-300)
    if not basis.shape[1]:
        return unit
    nearest = basis @ (basis.T @ unit)
    return joined(unit, span(basis - nearest @ (nearest.T @ basis) / max(float(np.sum(nearest**2)), 1e-300)))


def beyond(first: FloatArray, second: FloatArray, basis: FloatArray) -> float:
    """d1' P d2, at least 0: squared length of a change's part orthogonal to `basis` (n, m). d1 and d2 (n,) are measured
    with two draws of the noise."""
    return max(float(first @ second - (first @ basis) @ (second @ basis)), 0.0)


def separability(
    first: FloatArray, second: FloatArray, beside: FloatArray, rivals: Sequence[Directions]
) -> tuple[float, str | None]:
    """The least squared length of a change orthogonal to `beside` and to any one rival, and that rival; without rivals
    None.

    `beside` (n, m): the directions of the other concealed laws.
    """
    left = [(beyond(first, second, joined(beside, rival.basis)), rival.name) for rival in rivals]
    return min(left, default=(beyond(first, second, beside), None))


def oracle_share(
    mean: FloatArray, candidates: Sequence[Directions], truth: Sequence[str], rng: np.random.Generator, draws: int = 400
) -> float:
    """Share of draws of the noise in which the oracle is right: one true name comes first; of two, exactly both are
    named.

    `mean` (n,): change by all concealed laws together. The oracle names none, one or two candidates, those with the
    largest gain in chi2 less a threshold for each (`_prices`). Raises ValueError for more than two true names, and
    where one of them isn't a candidate."""
    if not 1 <= len(truth) <= 2 or not {c.name for c in candidates} >= set(truth):
        raise ValueError(f"{', '.join(truth)}: the oracle tells one or two of its candidates")
    whole = joined(*(c.basis for c in candidates), mean[:, None] / max(float(np.linalg.norm(mean)), 1e-300))
    bases = [whole.T @ c.basis for c in candidates]
    seen = mean @ whole + rng.standard_normal((draws, whole.shape[1]))
    price = _prices(bases, rng)
    alone = np.array([np.square(seen @ basis).sum(axis=1) for basis in bases])
    best, answer = np.zeros(draws), np.full((draws, 2), -1)
    for k, cost in enumerate(price):
        better = alone[k] - cost > best
        best[better], answer[better] = (alone[k] - cost)[better], (k, -1)
    for k, other in combinations(range(len(candidates)), 2):
        if candidates[k].name == candidates[other].name:
            continue
        gain = np.square(seen @ joined(bases[k], bases[other])).sum(axis=1) - price[k] - price[other]
        better = gain > best
        best[better] = gain[better]
        first = alone[k][better] >= alone[other][better]
        answer[better] = np.where(first[:, None], (k, other), (other, k))
    told = np.array([*(c.name for c in candidates), ""], dtype=object)[answer]
    if len(truth) == 1:
        return float(np.mean(told[:, 0] == truth[0]))
    return float(np.mean([set(pair) == set(truth) for pair in told]))


def _prices(bases: Sequence[FloatArray], rng: np.random.Generator) -> list[float]:
    """The chi2 that each candidate has to gain: a quantile of chi2 with as many degrees of freedom as the candidate has
    directions.

    The quantile is the same for all, such that pure noise exceeds the threshold of any candidate in `FALSE_ALARMS` of
    the draws."""
    noise = rng.standard_normal((NOISE_DRAWS, len(bases[0])))
    freedom = [basis.shape[1] for basis in bases]
    most = {m: np.zeros(NOISE_DRAWS) for m in freedom}
    for basis, m in zip(bases, freedom, strict=True):
        np.maximum(most[m], np.square(noise @ basis).sum(axis=1), out=most[m])
    rarest = np.min([chi2.sf(gain, m) for m, gain in most.items()], axis=0)
    return [float(chi2.isf(np.quantile(rarest, FALSE_ALARMS), m)) for m in freedom]
