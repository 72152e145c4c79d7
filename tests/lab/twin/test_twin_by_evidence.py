"""The twin and its budget from an improved model that the table of sets gives."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import lab.inference.recordings
from lab.diagnose import examine
from lab.fit import fit_recording_set
from lab.formats.camera_file import CameraFile
from lab.twin.budget import budget
from lab.twin.changes import Changes
from lab.twin.predict import predict
from lab.twin.score import score
from lab.twin.session import future_session
from sim.effects.library import effect
from tests.lab.twin.test_twin import PLAN, TRANSFERS, TRUTH, captured

HYPOTHESES = ("dark_current_temperature", "black_level_drift", "nonlinearity", "veiling_glare", "defocus")
NOISE = partial(fit_recording_set, steps=("noise",))


@pytest.fixture(scope="module")
def content() -> CameraFile:
    """Return the improved model of one drawn session, with what the table of a few hypotheses names."""
    session = future_session(TRUTH, PLAN, "left", Changes(), 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lab.inference.recordings, "candidates", lambda: tuple(effect(name) for name in HYPOTHESES))
        found = examine(session, NOISE(session), engine="evidence", refit=NOISE)
    assert [e.name for e in found.result.effects] == ["dark_current_temperature"]
    return found.improved["left"]


def test_the_size_is_that_of_the_camera(content: CameraFile) -> None:
    """Doubling every 7 C is 1 / 7 doublings per C, within 4 posterior standard deviations (u is the parameter)."""
    assert content.posterior is not None
    at = content.posterior.names.index("dark_current_temperature.doublings_per_c")
    std = float(np.sqrt(content.posterior.covariance[at][at]))
    (named,) = content.effects
    assert abs(named.doublings_per_c - 1.0 / 7.0) < 4.0 * std  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["15 degrees warmer"])
def test_intervals_hold_in_a_configuration_that_nobody_has_seen(content: CameraFile, name: str) -> None:
    found = score(predict({"left": content}, PLAN, TRANSFERS[name], light_std=0.0), captured(TRANSFERS[name], 7))
    inside = sum(q.n * q.within_95_percent_interval for q in found.quantities) / found.n
    # 95 % of some 300 numbers, of which errors of the parameters are common to many: 100 effectively, 4 standard
    # deviations
    assert inside > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / 100.0)
    assert found.chi2 < 1.5 * found.n
    assert {e.name: e.verdict for e in found.effects} == {"dark_current_temperature": "survives"}


def test_the_budget_of_the_dark_signal_has_the_named_law(content: CameraFile) -> None:
    (use,) = budget(content, ("dark mean",)).uses
    assert {"dark_current_temperature", "dark"} & {one.name for one in use.contributions}
    assert use.std_percent > 0.0
