"""Which captures are held out: neither the choice of effects nor the fit sees them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.capture_kinds.base import Capture
from lab.diagnose.measurements.study import Study


def held_out_of(group: Sequence[Capture], index: int, groups: int) -> set[str]:
    """Ids of the held-out captures of a group of repeats: the last third, at least one. Of groups without repeats,
    every third is held out, where there are three or more (`groups`: their number, `index`: this one's)."""
    if len(group) > 1:
        return {c.id for c in group[len(group) - max(len(group) // 3, 1) :]}
    return {group[0].id} if groups >= 3 and index % 3 == 1 else set()


def held_out_flats(study: Study) -> frozenset[str]:
    """Ids of held-out flats: the last third of a level's repeats where it has six or more, as temporal noise needs
    pairs. Of other levels, every third from the darkest on, never the brightest."""
    groups = study.flat_levels()
    size = {id(g): float(np.mean(list(study.levels(g[0]).whole.values()))) for g in groups}
    out: set[str] = set()
    for rank, group in enumerate(sorted(groups, key=lambda g: size[id(g)])):
        if len(group) >= 6:
            out |= {c.id for c in group[len(group) - len(group) // 3 :]}
        elif rank % 3 == 1 and rank < len(groups) - 1:
            out |= {c.id for c in group}
    return frozenset(out)
