"""A law of no list, by the engine `evidence`: in the result, the improved camera, the report and a draft."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lab.inference.recordings
from evaluation.draw import recordings_of
from evaluation.independent_simulator import UNLISTED, WHOLE_SESSION, ConcealedCamera
from lab.diagnose import Diagnosis, examine
from lab.diagnose.effect_draft import draft
from lab.errors import InputError
from lab.formats.results import DiscoveredLaw
from lab.inference.posterior import LIKELIER
from lab.report.diagnosis import context
from sim.effects.empirical_law import EmpiricalLaw
from sim.effects.library import effect

PLAN = replace(WHOLE_SESSION, kinds=("dark", "flat"))
#: Hypotheses of the search: enough for rivals, few enough for the everyday suite.
HYPOTHESES = ("row_noise", "excess_noise", "nonlinearity", "source_drift", "amplifier_glow")
#: Dark current of the centre over that of the corners, e/s.
CENTRE_E_PER_S = 4.0


@pytest.fixture(scope="module")
def warm() -> Iterator[Diagnosis]:
    """Return the diagnosis of a sensor whose middle is warmer: dark current a (1 - r^2), r = 1 at the corner."""
    (law,) = (law for law in UNLISTED if law.name == "warm_centre")
    camera = ConcealedCamera(12, (law(CENTRE_E_PER_S),), cfa="MONO", rows=96, cols=128)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lab.inference.recordings, "candidates", lambda: tuple(effect(name) for name in HYPOTHESES))
        yield examine(recordings_of(camera, PLAN), engine="evidence")


@pytest.fixture(scope="module")
def law(warm: Diagnosis) -> DiscoveredLaw:
    """Return the law that shows most."""
    return warm.result.discovered[0]


def test_it_is_said_where_it_acts(warm: Diagnosis, law: DiscoveredLaw) -> None:
    (state,) = (one for one in warm.result.unlisted if one.probability >= LIKELIER)
    assert state.state == "offset"
    assert (law.stage, law.along, law.of) == ("charge", "radius", "mean")
    assert law.state == state.state
    assert law.probability == pytest.approx(state.probability)
    assert warm.result.verdict != "explained"
    assert any("dark current by radius" in line for line in warm.result.summary)


def test_its_curve_is_the_true_one_within_its_uncertainty(law: DiscoveredLaw) -> None:
    """a (1 - r^2) less its value at the corner: each point within 4 standard deviations of both, which bound that of
    the difference. Lines between four points miss the parabola by a / 36. The middle is warmer by half of a at least.
    """
    shown, std = np.array(law.shown_departure), np.array(law.shown_std)
    factor = shown[0] / law.table[0]  # DN/s of 1 e/s
    r = np.array(law.at) / law.at[-1]
    true = factor * CENTRE_E_PER_S * (1.0 - np.square(r))
    away = (shown - shown[-1]) - (true - true[-1])
    assert np.all(np.abs(away) < 4.0 * (std + std[-1]))
    assert shown[0] - shown[-1] > 0.5 * factor * CENTRE_E_PER_S


def test_it_predicts_the_captures_that_were_held_out(law: DiscoveredLaw) -> None:
    """Nine tenths of their excess chi2: the goal above a separability of 50, that of this law is some thousands."""
    assert law.n > 0
    assert law.chi2_before - law.chi2_after > 0.9 * (law.chi2_before - law.n)
    assert law.chi2_before - law.n > 5.0 * (2.0 * law.n) ** 0.5


def test_the_improved_camera_has_it(warm: Diagnosis, law: DiscoveredLaw) -> None:
    laws = [e for e in warm.improved["left"].effects if isinstance(e, EmpiricalLaw)]
    assert any((one.stage, one.along, one.table) == (law.stage, law.along, law.table) for one in laws)


def test_it_is_drawn_with_two_standard_deviations(warm: Diagnosis, law: DiscoveredLaw) -> None:
    _, figure = context(warm.result, ("left",))["discovered"][0]
    band, line = figure["data"]
    assert line["x"] == pytest.approx(law.at)
    assert line["y"] == pytest.approx(law.shown_departure)
    upper = np.array(law.shown_departure) + 2.0 * np.array(law.shown_std)
    assert band["y"][: len(law.at)] == pytest.approx(upper.tolist())


def test_it_is_drafted_as_an_effect(law: DiscoveredLaw, tmp_path: Path) -> None:
    for text in draft(law, 1, "a set", tmp_path / "warm_middle.py"):
        ast.parse(text)


def test_a_curve_of_a_measurement_is_drawn_by_channel_and_not_drafted(
    warm: Diagnosis, law: DiscoveredLaw, tmp_path: Path
) -> None:
    labels = ("G 0 deg", "G 0 deg", "R 0 deg", "R 0 deg")
    values = (0.01, 0.02, -0.01, 0.0)
    own = law.model_copy(
        update={
            "stage": "image", "along": "spatial frequency", "curve_of": "bernoulli", "at": (0.1, 0.2, 0.1, 0.2),
            "labels": labels, "table": values, "shown_departure": values, "shown_std": (0.001,) * 4,
        }
    )  # fmt: skip
    changed = warm.result.model_copy(update={"discovered": (own,)})
    ((_, figure),) = context(changed, ("left",))["discovered"]
    lines = [trace for trace in figure["data"] if "name" in trace]
    assert [line["name"] for line in lines] == ["G 0 deg", "R 0 deg"]
    assert lines[1]["y"] == [-0.01, 0.0]
    with pytest.raises(InputError, match="law 1 of a set: is a curve of the measurement bernoulli"):
        draft(own, 1, "a set", tmp_path / "other.py")
