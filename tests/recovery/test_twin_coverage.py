"""Do a twin's intervals hold? Many drawn cameras' sessions, each fitted, and predicted in three configurations that it
was never in.

`pytest -m slow -s tests/recovery/test_twin_coverage.py` prints the share of each quantity.
"""

from __future__ import annotations

import numpy as np
import pytest

from lab.twin.predict import predict
from lab.twin.score import score
from tests.lab.twin.test_twin import PLAN, TRANSFERS, captured, trained

DRAWS = 12
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def test_intervals_hold_90_to_98_percent() -> None:
    inside: dict[str, list[tuple[float, int]]] = {}
    whole: list[tuple[float, int]] = []
    for draw in range(DRAWS):
        content = trained(100 + draw)
        for name, changes in TRANSFERS.items():
            found = score(predict({"left": content}, PLAN, changes, light_std=0.0), captured(changes, 500 + draw))
            for one in found.quantities:
                inside.setdefault(f"{name}, {one.quantity}", []).append((one.within_95_percent_interval, one.n))
                whole.append((one.within_95_percent_interval, one.n))
    for name, values in inside.items():
        share, n = np.transpose(values)
        print(f"{name}: {100 * np.average(share, weights=n):.1f} % of {n.sum():.0f}")
    share, n = np.transpose(whole)
    assert 0.90 < np.average(share, weights=n) < 0.98
