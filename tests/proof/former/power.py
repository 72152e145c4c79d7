"""How strongly a concealed law shows: its non-centrality, by recordings with and without it and the diagnosis's own summaries.

The library of effects has no part in it. Both recordings are of the same camera with the same noise, so that their difference is
the law's; the covariance is that of the recordings with it, free quantities marginalised.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from lab.diagnose import BLOCKS
from lab.diagnose.evidence import Evidence
from lab.diagnose.summaries import Study
from lab.errors import NotDetermined
from lab.predict import camera_model
from lab.recording import RecordingSet


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


def noncentrality(present: Evidence | None, absent: Evidence | None) -> float:
    """d' C^-1 d, d the difference of what both have, C the covariance under the baseline of the one with the law."""
    if present is None or absent is None:
        return 0.0
    other = dict(zip(_keys(absent), absent.value, strict=True))
    keys = _keys(present)
    where = np.array([key in other and seen for key, seen in zip(keys, present.seen, strict=True)])
    if not where.any():
        return 0.0
    change = np.array([value - other[key] for key, value, use in zip(keys, present.value, where, strict=True) if use])
    covariance = present.gaussian(()).covariance[np.ix_(where, where)]
    return float(change @ cho_solve(cho_factor(covariance, lower=True), change))
