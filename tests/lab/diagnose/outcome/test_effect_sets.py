"""The sets of effects in a result, and when there are none."""

from __future__ import annotations

from collections.abc import Sequence

from lab.diagnose.inference.search import Model, ModelSet
from lab.diagnose.outcome.goodness_of_fit import set_sentences, side_models
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import NamedEffect, Rival, SideModels, Unexplained

POLICY = DecisionPolicy()


def _named(name: str, *rivals: str) -> NamedEffect:
    return NamedEffect(
        name=name, family="contrast_loss", law="exact", probability=0.7, sides=("left",), parameters={}, statement="",
        rivals=tuple(Rival(name=r, probability=0.3) for r in rivals),
    )  # fmt: skip


def _models(*sets: tuple[Sequence[str], float], left: Sequence[tuple[str, ...]] = ()) -> SideModels:
    found = ModelSet(tuple(Model(tuple(e), p) for e, p in sets), (("defocus", 1.0),), tuple(left))
    return side_models("left", found, POLICY)


def _told(models: SideModels, *effects: NamedEffect, left: Sequence[Unexplained] = ()) -> str:
    return " ".join(set_sentences([models], effects, left, POLICY))


def test_sets_are_reported_where_they_hold_an_effect_without_a_name() -> None:
    both = _models((["defocus"], 0.67), (["defocus", "coma"], 0.3))
    assert "defocus (67 %), defocus with coma (30 %)." in _told(both, _named("defocus"))
    assert _told(_models((["defocus"], 0.97)), _named("defocus")) == ""
    rivals = _models((["defocus"], 0.67), (["coma"], 0.3))
    assert _told(rivals, _named("defocus", "coma")) == ""  # said of the name already
    unlikely = _models((["defocus"], 0.91), (["defocus", "coma"], 0.03), (["defocus", "ghost"], 0.02))
    assert _told(unlikely, _named("defocus")) == ""
    left = Unexplained(
        side="left", measurement="slanted_edge", axis="spatial_frequency", where="all", shape="irregular",
        significance_sigma=9.0,
        chi2_before=300.0, chi2_after=290.0, n=60,
    )  # fmt: skip
    assert _told(both, _named("defocus"), left=[left]) == ""  # an unlisted cause is there
    assert _told(both) == ""  # nothing is named: what else it is was weighed, too


def test_sets_that_the_budget_left_out_are_listed() -> None:
    left = [("ghost",), ("ghost", "coma"), ("a",), ("b",), ("c",), ("d",), ("e",)]
    told = _told(_models((["defocus"], 0.97), left=left), _named("defocus"))
    assert "120 s of CPU time were spent" in told
    assert "Not weighed: ghost; ghost with coma; a; b; c; and 2 more" in told
