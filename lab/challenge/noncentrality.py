"""The strength of a concealed law: the non-centrality of its change of the summaries, and how well it can be
identified.

Summaries are the measured numbers of a diagnosis. Recordings with and without the law are of the same camera with the
same noise, so that their difference is the law's change. Its covariance is that of the recordings with the law,
nuisance parameters marginalised. The library of effects has no part in the non-centrality. It enters as rivals, by its
effects' changes of the healthy camera (`lab.challenge.fair_strength`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from lab.challenge.fair_strength import Directions, beyond, joined, oracle_share, separability, span, with_direction
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.measurements.library import measurements
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from lab.measure.study import Study
from sim.effects.library import candidates
from sim.spectrum import FloatArray

#: Measurement models of one camera with two draws of the noise.
TwoDraws = Sequence[MeasurementModel | None]


def summaries(recordings: RecordingSet) -> MeasurementModel | None:
    """The summaries of a single camera's recordings; None where no measurement is determined."""
    study = Study(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))
    blocks = []
    for measurement in measurements():
        try:
            blocks.append(measurement.make(study))
        except NotDetermined:
            continue
    return MeasurementModel(tuple(blocks), study.camera) if blocks else None


def _keys(found: MeasurementModel) -> list[Hashable]:
    """A key for each summary, the same in all recordings of one session."""
    count: Counter[Hashable] = Counter()
    keys: list[Hashable] = []
    for block in found.blocks:
        for label in block.labels:
            key = block.measurement.name, label.channel, label.condition, label.captures
            keys.append((key, count[key]))
            count[key] += 1
    return keys


def _change(present: MeasurementModel, absent: MeasurementModel) -> dict[Hashable, float]:
    """Key -> change by the law, of every summary that both have and that isn't held out."""
    other = dict(zip(_keys(absent), absent.value, strict=True))
    seen = zip(_keys(present), present.value, present.seen, strict=True)
    return {key: value - other[key] for key, value, use in seen if use and key in other}


def noncentrality(pairs: Sequence[tuple[MeasurementModel | None, MeasurementModel | None]]) -> float:
    """d1' C^-1 d2, at least 0, of two pairs (with the law, without it), each with its own draw of the noise.

    d is the change of the summaries, C their covariance under the baseline, from the first recordings with the law. A
    law that moves an edge changes the noise under it, too. That part is independent in d1 and d2 and cancels on
    average; |d|^2 of one pair would be biased by it.
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
    covariance = present.gaussian(()).covariance[np.ix_(where, where)]
    return max(float(first @ cho_solve(cho_factor(covariance, lower=True), second)), 0.0)


@dataclass(frozen=True)
class FairStrength:
    """How well one concealed law can be identified (`lab.challenge.fair_strength`)."""

    conditional: float | None  # conditional non-centrality; None where no other law is concealed
    separability: float | None
    rival: str | None  # that is nearest to it


@dataclass(frozen=True)
class LibraryChanges:
    """The changes of one camera's n summaries by the candidates of the library."""

    row: dict[Hashable, int]  # of each summary
    changes: tuple[tuple[str, FloatArray], ...]  # name and changes (n, prototypes) of each set of prototypes


def library_changes(healthy: MeasurementModel | None) -> LibraryChanges:
    """The changes by every candidate about the healthy camera; none where no measurement is determined."""
    if healthy is None:
        return LibraryChanges({}, ())
    base = healthy.mean()
    found = [
        (effect.name, np.stack([healthy.mean((one,)) - base for one in prototypes], axis=1))
        for effect in candidates()
        if healthy.affected(effect).any()
        for prototypes in effect.prototypes(healthy.camera)
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
    lower = cholesky(present.gaussian(()).covariance[np.ix_(where, where)], lower=True)

    def white(table: FloatArray) -> FloatArray:
        return np.asarray(solve_triangular(lower, table, lower=True))

    first, second = (white(np.array([[pair[k][key] for pair in tables] for key in common])) for k in (0, 1))
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
