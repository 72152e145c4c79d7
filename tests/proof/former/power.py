"""How strongly a concealed law shows: its non-centrality, by recordings with and without it and the diagnosis's own summaries.

The library of effects has no part in it. Both recordings are of the same camera with the same noise, so that their difference is
the law's; the covariance is that of the recordings with it, free quantities marginalised.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from lab.diagnose import BLOCKS
from lab.diagnose.inference.evidence import Evidence
from lab.diagnose.measurements.summaries import Study
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.predict.camera_model import camera_model


def evidence(recordings: RecordingSet) -> Evidence | None:
    """The summaries of the only side; None where nothing can be summarised."""
    study = Study(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))
    blocks = []
    for make in BLOCKS:
        try:
            blocks.append(make(study))
        except NotDetermined:
            continue
    return Evidence(tuple(blocks), study.camera) if blocks else None


def _keys(found: Evidence) -> list[Hashable]:
    """What each number is of, alike in recordings of the same session."""
    count: Counter[Hashable] = Counter()
    keys: list[Hashable] = []
    for block in found.blocks:
        for label in block.labels:
            key = block.measurement, label.channel, label.condition, label.captures
            keys.append((key, count[key]))
            count[key] += 1
    return keys


def _change(present: Evidence, absent: Evidence) -> dict[Hashable, float]:
    """What the law does to every number that both have and choice may see."""
    other = dict(zip(_keys(absent), absent.value, strict=True))
    seen = zip(_keys(present), present.value, present.seen, strict=True)
    return {key: value - other[key] for key, value, use in seen if use and key in other}


def noncentrality(pairs: Sequence[tuple[Evidence | None, Evidence | None]]) -> float:
    """d1' C^-1 d2 of two pairs (with the law, without it), each of another draw of the noise, never below 0.

    d is the difference of what both have, C the covariance under the baseline of the first pair's recordings with the law. Noise
    that the difference leaves (a law that moves an edge moves it over other noise) is independent in d1 and d2, so that it doesn't
    count; |d|^2 of one pair would have it twice.
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
