"""Non-centralities of concealed laws from made-up summaries with known noise and changes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from evaluation.noncentrality import LibraryChanges, fair_strengths, noncentrality
from sim.effects.defocus import Defocus

AXES = np.eye(6)
#: Of the summaries, so that whitened changes are half of what they are in numbers.
STD = 2.0


def summaries(change: np.ndarray, everyday: np.ndarray | None = None) -> SimpleNamespace:
    """Six summaries of one measurement, displaced by `change` standard deviations from those of a healthy camera, with
    everyday small physics of these changes, in standard deviations."""
    labels = [SimpleNamespace(channel="Y", condition=k, captures=("a",)) for k in range(6)]
    measurement = SimpleNamespace(name="made_up", axis="level", conditions="")
    block = SimpleNamespace(
        measurement=measurement, labels=labels, value=np.zeros(6), position=100.0 * np.arange(6.0), reach=1.0,
        scale=np.ones(6),
    )  # fmt: skip
    model = SimpleNamespace(
        blocks=(block,),
        slices=(slice(0, 6),),
        value=100.0 + STD * change,
        seen=np.ones(6, bool),
        gaussian=lambda _effects: SimpleNamespace(covariance=STD**2 * np.eye(6)),
    )
    columns = np.zeros((6, 0)) if everyday is None else STD * everyday[:, None]
    return SimpleNamespace(model=model, everyday=columns)


def library(**directions: np.ndarray) -> LibraryChanges:
    row = {(("made_up", "Y", k, ("a",)), 0): k for k in range(6)}
    return LibraryChanges(row, tuple((name, STD * 0.3 * vector[:, None]) for name, vector in directions.items()))


def test_a_single_effect_beside_its_nearest_rival() -> None:
    """6 sigma along the first axis; beside a rival at 30 degrees 36 sin^2 = 9 is left, beside one at right angles
    everything."""
    absent, present = summaries(0.0 * AXES[0]), summaries(6.0 * AXES[0])
    rivals = library(mine=AXES[0], near=np.cos(np.pi / 6) * AXES[0] + np.sin(np.pi / 6) * AXES[1], far=AXES[2])
    whole, without = [present, present], [[absent, absent]]
    assert noncentrality([(present, absent), (present, absent)]) == pytest.approx(36.0)
    (found,), share = fair_strengths(whole, without, rivals, ["mine"], (), np.random.default_rng(0))
    assert (found.conditional, found.rival) == (None, "near")
    assert found.separability == pytest.approx(9.0)
    assert share is not None
    # told from the rival by the difference of their gains, 6 sin(30 deg) = 3 sigma apart: nearly always
    assert 0.85 < share <= 1.0
    (found,), _ = fair_strengths(whole, without, rivals, ["mine"], ("near",), np.random.default_rng(0))
    assert (found.separability, found.rival) == (pytest.approx(36.0), "far")


def test_what_is_everyday_isnt_strong() -> None:
    """6 sigma where everyday small physics has a standard deviation of 3 sigma: 36 / (1 + 9)."""
    absent, present = (summaries(size * AXES[0], 3.0 * AXES[0]) for size in (0.0, 6.0))
    assert noncentrality([(present, absent), (present, absent)]) == pytest.approx(3.6)
    (found,), _ = fair_strengths(
        [present, present], [[absent, absent]], library(far=AXES[2]), [None], (), np.random.default_rng(0)
    )
    assert found.separability == pytest.approx(3.6)


def test_a_law_is_told_from_others_as_well_as_its_form_is_known() -> None:
    """36 sigma by a law that is known to a share e of its change: 36^2 / (1 + 36^2 e^2) are left to tell which it is;
    the non-centrality is that of the change itself."""
    absent, present = summaries(0.0 * AXES[0]), summaries(36.0 * AXES[0])
    assert noncentrality([(present, absent), (present, absent)]) == pytest.approx(1296.0)
    (found,), _ = fair_strengths(
        [present, present], [[absent, absent]], library(defocus=AXES[0], far=AXES[2]), ["defocus"], (),
        np.random.default_rng(0),
    )  # fmt: skip
    assert found.separability == pytest.approx(1296.0 / (1.0 + 1296.0 * Defocus.form_tolerance**2))


def test_a_pair_of_which_one_imitates_the_other() -> None:
    """The second law lies at 30 degrees to the first: a quarter of the squared length of each is left beyond the
    other."""
    oblique = np.cos(np.pi / 6) * AXES[0] + np.sin(np.pi / 6) * AXES[1]
    one, two = 10.0 * AXES[0], 4.0 * oblique
    whole, without = [summaries(one + two)] * 2, [[summaries(two)] * 2, [summaries(one)] * 2]
    found, share = fair_strengths(
        whole, without, library(one=AXES[0], two=oblique, far=AXES[2]), ["one", "two"], (), np.random.default_rng(0)
    )
    assert [strength.conditional for strength in found] == pytest.approx([25.0, 4.0])
    assert [strength.separability for strength in found] == pytest.approx([25.0, 4.0])
    # of a conditional non-centrality of 4, a threshold at 1 % over three effects takes about one in five
    assert share is not None
    assert share < 0.4


def test_a_law_outside_the_list_has_no_oracle() -> None:
    absent, present = summaries(0.0 * AXES[0]), summaries(6.0 * AXES[0])
    (found,), share = fair_strengths(
        [present, present], [[absent, absent]], library(far=AXES[2]), [None], (), np.random.default_rng(0)
    )
    assert (found.separability, share) == (pytest.approx(36.0), None)


def test_without_summaries_nothing_is_measured() -> None:
    (found,), share = fair_strengths([None, None], [[None, None]], library(), ["one"], (), np.random.default_rng(0))
    assert (found.conditional, found.separability, found.rival, share) == (None, None, None, None)
