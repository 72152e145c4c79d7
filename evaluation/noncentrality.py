"""The strength of a concealed law: the non-centrality of its change of the summaries, and how well it can be
identified.

Summaries are the measured numbers of a diagnosis. Recordings with and without the law are of the same camera with the
same noise, so that their difference is the law's change. Its covariance is that of the recordings with the law,
nuisance parameters and everyday small physics marginalised: what the model calls everyday isn't strong. Which law it
is, is known less well still: separability and the oracle have the errors of the concealed laws, at their declared form
tolerances, in the covariance, too. The library of effects has no part in the non-centrality. It enters as rivals, by
its effects' changes of the healthy camera (`evaluation.noncentrality`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.stats import chi2

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from lab.inference.discrepancy import depends_not_on_axis, groups_of, law_error, observable_kernel
from lab.inference.model import scaled_columns
from lab.observables.dataset import Dataset
from lab.observables.observable import measurements
from sim.effects.library import candidates
from sim.spectrum import FloatArray

# --- fair strength ---------------------------------------------------------------------------------------------------
# How well the concealed laws of one case can be identified at best: a linear Gaussian problem.
#
# All vectors are changes of the summaries (the measured numbers), (n,), whitened: noise, everyday small physics and the
# laws' form errors have unit variance together, and nuisance parameters are marginalised. P[J] is the projection
# orthogonal to directions J, and d the change by the concealed law i:
#
#     conditional non-centrality   lambda(i | j) = |P[J_j] d|^2               the part that the other concealed law
# can't
#     imitate separability                 min over rivals k of |P[J_j, J_k] d|^2     the part that no rival beside it
# can
#     imitate, either
#
# They are the minimal detectable and the minimal identifiable bias of geodesy (Baarda 1968; Teunissen 2018, J Geod
# 92:59). The oracle knows all directions and only has to choose among them. Its share of right answers, found by Monte
# Carlo, is the best that a method can reach on these summaries, except for the information in the signs of parameters.


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
    """Return the basis (n, m) of an effect whose concealed law changes the summaries by `change` (n,): its direction
    nearest to that of `change` is replaced by that of `change`."""
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
    """Return the least squared length of a change orthogonal to `beside` and to any one rival, and that rival; without
    rivals None.

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
    """Return the chi2 that each candidate has to gain: a quantile of chi2 with as many degrees of freedom as the
    candidate has directions.

    The quantile is the same for all, such that pure noise exceeds the threshold of any candidate in `FALSE_ALARMS` of
    the draws."""
    noise = rng.standard_normal((NOISE_DRAWS, len(bases[0])))
    freedom = [basis.shape[1] for basis in bases]
    most = {m: np.zeros(NOISE_DRAWS) for m in freedom}
    for basis, m in zip(bases, freedom, strict=True):
        np.maximum(most[m], np.square(noise @ basis).sum(axis=1), out=most[m])
    rarest = np.min([chi2.sf(gain, m) for m, gain in most.items()], axis=0)
    return [float(chi2.isf(np.quantile(rarest, FALSE_ALARMS), m)) for m in freedom]


# --- noncentrality ------------------------------------------------------------


@dataclass(frozen=True)
class Summaries:
    """The summaries of a single camera's recordings."""

    model: MeasurementModel
    dataset: Dataset

    @cached_property
    def everyday(self) -> FloatArray:
        """Changes (n, R) by everyday small physics, whose coefficients are independent standard normal numbers."""
        n = len(self.model.value)
        groups = groups_of(self.model, self.dataset, n)
        return scaled_columns(groups, np.array([g.everyday for g in groups]), n)


#: Summaries of one camera with two draws of the noise.
TwoDraws = Sequence[Summaries | None]


def summaries(recordings: RecordingSet) -> Summaries | None:
    """Return the summaries of a single camera's recordings; None where no measurement is determined."""
    dataset = Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))
    blocks = []
    for measurement in measurements():
        try:
            blocks.append(measurement.make(dataset))
        except NotDetermined:
            continue
    return Summaries(MeasurementModel(tuple(blocks), dataset.camera), dataset) if blocks else None


def _keys(found: Summaries) -> list[Hashable]:
    """Return a key for each summary, the same in all recordings of one session."""
    count: Counter[Hashable] = Counter()
    keys: list[Hashable] = []
    for block in found.model.blocks:
        for label in block.labels:
            key = block.measurement.name, label.channel, label.condition, label.captures
            keys.append((key, count[key]))
            count[key] += 1
    return keys


def _change(present: Summaries, absent: Summaries) -> dict[Hashable, float]:
    """Key -> change by the law, of every summary that both have and that isn't held out."""
    other = dict(zip(_keys(absent), absent.model.value, strict=True))
    seen = zip(_keys(present), present.model.value, present.model.seen, strict=True)
    return {key: value - other[key] for key, value, use in seen if use and key in other}


def _covariance(
    present: Summaries, changes: Sequence[FloatArray] = (), effects: Sequence[str | None] = ()
) -> FloatArray:
    """Covariance (n, n) of the summaries under the baseline, with everyday small physics, and with the errors of
    effects' laws at their form tolerances, given the laws' changes (n,)."""
    model = present.model
    total = model.gaussian(()).covariance + present.everyday @ present.everyday.T
    laws = {kind.name: kind for kind in candidates()}
    for change, name in zip(changes, effects, strict=True):
        if name not in laws:
            continue
        for block, at in zip(model.blocks, model.slices, strict=True):
            if change[at].any():
                is_invariant = depends_not_on_axis(block, laws[name])
                kernel = observable_kernel(block, is_invariant=is_invariant)
                error = laws[name].form_tolerance * change[at]
                total[at, at] += law_error(block, kernel, error, is_invariant)
    return np.asarray(total)


def noncentrality(pairs: Sequence[tuple[Summaries | None, Summaries | None]]) -> float:
    """d1' C^-1 d2, at least 0, of two pairs (with the law, without it), each with its own draw of the noise.

    d is the change of the summaries, C their covariance under the baseline with everyday small physics, from the first
    recordings with the law. A law that moves an edge changes the noise under it, too. That part is independent in d1
    and d2 and cancels on average; |d|^2 of one pair would be biased by it.
    """
    (present, absent), (again, without) = pairs
    if present is None or absent is None or again is None or without is None:
        return 0.0
    one, two = _change(present, absent), _change(again, without)
    keys = _keys(present)
    where = np.array([key in one and key in two for key in keys])
    if not where.any():
        return 0.0
    first, second = (np.array([d[key] for key, use in zip(keys, where, strict=True) if use]) for d in (one, two))
    covariance = _covariance(present)[np.ix_(where, where)]
    return max(float(first @ cho_solve(cho_factor(covariance, lower=True), second)), 0.0)


@dataclass(frozen=True)
class FairStrength:
    """How well one concealed law can be identified (`evaluation.noncentrality`)."""

    conditional: float | None  # conditional non-centrality; None where no other law is concealed
    separability: float | None
    rival: str | None  # that is nearest to it


@dataclass(frozen=True)
class LibraryChanges:
    """The changes of one camera's n summaries by the candidates of the library."""

    row: dict[Hashable, int]  # of each summary
    changes: tuple[tuple[str, FloatArray], ...]  # name and changes (n, prototypes) of each set of prototypes


def library_changes(healthy: Summaries | None) -> LibraryChanges:
    """Return the changes by every candidate about the healthy camera; none where no measurement is determined."""
    if healthy is None:
        return LibraryChanges({}, ())
    model = healthy.model
    base = model.mean()
    found = [
        (effect.name, np.stack([model.mean((one,)) - base for one in prototypes], axis=1))
        for effect in candidates()
        if model.affected(effect).any()
        for prototypes in effect.prototypes(model.camera)
    ]
    return LibraryChanges({key: row for row, key in enumerate(_keys(healthy))}, tuple(found))


def fair_strengths(
    whole: TwoDraws,
    without: Sequence[TwoDraws],
    library: LibraryChanges,
    effects: Sequence[str | None],
    accepts: Collection[str],
    rng: np.random.Generator,
) -> tuple[list[FairStrength], float | None]:
    """Conditional non-centrality and separability of each concealed law, and the oracle's share of right answers on the
    case.

    `whole`: summaries with all laws; `without`: without each law in turn; `effects`: the laws' names in the library,
    None outside it; `accepts`: names that are no rivals. Of a concealed effect, the law's measured change replaces one
    direction. The share is None where a law isn't in the library, or its effect changes no summary.
    """
    present, again = whole
    absent = [(one, other) for one, other in without if one is not None and other is not None]
    if present is None or again is None or len(absent) < len(without):
        return [FairStrength(None, None, None) for _ in without], None
    tables = [(_change(present, one), _change(again, other)) for one, other in absent]
    keys = _keys(present)
    where = np.array([key in library.row and all(key in d for pair in tables for d in pair) for key in keys])
    if not where.any():
        return [FairStrength(None, None, None) for _ in without], None
    common = [key for key, use in zip(keys, where, strict=True) if use]
    one, two = (np.array([[pair[k][key] for pair in tables] for key in common]) for k in (0, 1))
    mean = np.zeros((len(keys), len(tables)))
    mean[where] = 0.5 * (one + two)
    lower = cholesky(_covariance(present, list(mean.T), effects)[np.ix_(where, where)], lower=True)

    def white(table: FloatArray) -> FloatArray:
        return np.asarray(solve_triangular(lower, table, lower=True))

    first, second = white(one), white(two)
    own = 0.5 * (first + second)
    rows = [library.row[key] for key in common]
    listed: list[Directions] = []
    for effect, changes in library.changes:
        basis = span(white(changes[rows]))
        for law, name in enumerate(effects):
            if name == effect:
                basis = with_direction(basis, own[:, law])
        if basis.shape[1]:
            listed.append(Directions(effect, basis))
    found = []
    for law, name in enumerate(effects):
        others = [k for k in range(len(effects)) if k != law]
        of_others = {effects[k] for k in others}
        beside = joined(*(c.basis for c in listed if c.name in of_others), span(own[:, others]))
        rivals = [c for c in listed if c.name not in {name, *of_others, *accepts}]
        left, rival = separability(first[:, law], second[:, law], beside, rivals)
        conditional = beyond(first[:, law], second[:, law], beside) if others else None
        found.append(FairStrength(conditional, left, rival))
    names = [name for name in effects if name is not None]
    asked = [c for c in listed if c.name in names or c.name not in accepts]
    if not names or len(names) < len(effects) or not {c.name for c in asked} >= set(names):
        return found, None
    return found, oracle_share(own.sum(axis=1), asked, names, rng)
