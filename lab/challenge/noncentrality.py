"""How strongly a concealed law shows: the non-centrality of its change of the diagnosis's summaries.

The library of effects has no part in it. Recordings with and without the law are of the same camera with the same noise, so that their
difference is the law's. The covariance is that of the recordings with it, nuisance parameters marginalised.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.measurements.library import measurements
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.predict.camera_model import camera_model


def summaries(recordings: RecordingSet) -> MeasurementModel | None:
    """The summaries of a single camera's recordings; None where nothing can be summarised."""
    study = Study(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))
    blocks = []
    for measurement in measurements():
        try:
            blocks.append(measurement.make(study))
        except NotDetermined:
            continue
    return MeasurementModel(tuple(blocks), study.camera) if blocks else None


def _keys(found: MeasurementModel) -> list[Hashable]:
    """Identity of each summary: the same in all recordings of one session."""
    count: Counter[Hashable] = Counter()
    keys: list[Hashable] = []
    for block in found.blocks:
        for label in block.labels:
            key = block.measurement.name, label.channel, label.condition, label.captures
            keys.append((key, count[key]))
            count[key] += 1
    return keys


def _change(present: MeasurementModel, absent: MeasurementModel) -> dict[Hashable, float]:
    """Change by the law of every summary that both have and that may be used for the choice."""
    other = dict(zip(_keys(absent), absent.value, strict=True))
    seen = zip(_keys(present), present.value, present.seen, strict=True)
    return {key: value - other[key] for key, value, use in seen if use and key in other}


def noncentrality(pairs: Sequence[tuple[MeasurementModel | None, MeasurementModel | None]]) -> float:
    """d1' C^-1 d2 of two pairs (with the law, without it), never below 0; each pair is of another draw of the noise.

    d is the change of the summaries, C their covariance under the baseline in the first pair's recordings with the law. A law that moves
    an edge moves it over other noise. That noise is independent in d1 and d2 and cancels on average; |d|^2 of one pair would count it twice.
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
