"""The engine on recordings of the independent simulator: darks and flats alone, small frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import LISTED, WHOLE_SESSION, ConcealedCamera, Law
from lab.inference.check import check_held_out, held_out_ids, passes
from lab.inference.hypotheses import effect_at, hypothesis_of, parameters_of
from lab.inference.posterior import read_table
from lab.inference.recordings import SideModel, SideProblem, measure_side, search_side
from sim.effects.empirical_law import EmpiricalLaw
from sim.effects.library import candidates, effect

PLAN = replace(WHOLE_SESSION, kinds=("dark", "flat"))


def _problem(*laws: Law) -> SideProblem:
    camera = ConcealedCamera(12, laws, cfa="MONO", rows=96, cols=128)
    problem = measure_side(recordings_of(camera, PLAN), "left", None)
    assert problem is not None
    return problem


def _law(name: str, strength: float) -> Law:
    (kind,) = (law for law in LISTED if law.name == name)
    return kind(strength)


@pytest.fixture(scope="module")
def healthy() -> SideProblem:
    """Return the measurements of a camera that does as its data sheet says."""
    return _problem()


def test_no_number_that_is_used_is_of_a_held_out_capture(healthy: SideProblem) -> None:
    used = {c for b in healthy.measured.blocks for label in b.labels for c in label.captures}
    held = {c for b in healthy.held_out for label in b.labels for c in label.captures}
    assert held
    assert used.isdisjoint(held)
    everything = recordings_of(ConcealedCamera(12, cfa="MONO", rows=96, cols=128), PLAN)
    assert held <= held_out_ids(everything, "left")


def test_without_form_errors_the_gaussian_is_the_measurement_models(healthy: SideProblem) -> None:
    """At form scale 0 of any effect: mean and covariance, to rounding. With a form scale the covariance grows by a
    positive semidefinite part: no variance falls."""
    model = SideModel(healthy.measured, healthy.groups)
    kind = effect("nonlinearity")
    hypothesis = hypothesis_of(kind, healthy.measured.camera)
    state = {kind.name: hypothesis.alternatives[0].points[0]}
    plain, wide = model.gaussian(state, 0.0), model.gaussian(state, 1.0)
    expected = healthy.measured.gaussian(model.effects(state), None, 0.0)
    np.testing.assert_allclose(plain.mean, expected.mean)
    np.testing.assert_allclose(plain.covariance, expected.covariance)
    assert np.all(np.diag(wide.covariance) >= np.diag(plain.covariance))
    assert np.any(np.diag(wide.covariance) > np.diag(plain.covariance))


def test_an_effect_is_itself_at_its_own_parameters(healthy: SideProblem) -> None:
    """What was predicted of a prototype isn't predicted once more of the same values to rounding."""
    camera = healthy.measured.camera
    for kind in candidates():
        for alternative in hypothesis_of(kind, camera).alternatives:
            for point in alternative.points:
                assert effect_at(point, parameters_of(kind, camera)) is point.template, kind.name


def test_an_effect_acts_on_the_blocks_that_it_changes_as_it_stands(healthy: SideProblem) -> None:
    """A law of any stage, here of the response, leaves blocks alone that others of its kind change; its prediction is
    that of each block."""
    law = EmpiricalLaw(stage="signal", along="level", of="mean", at=(100.0, 5000.0), table=(1.0, 1.01), strength=1.0)
    model = healthy.measured
    (numbered,) = model._numbered((law,))
    assert 0 < sum(numbered.acts) < sum(model.acts(EmpiricalLaw))
    np.testing.assert_array_equal(model.mean((law,)), np.concatenate([b.predict((law,)).mean for b in model.blocks]))
    assert np.any(model.mean((law,)) != model.mean())


def test_groups_move_held_out_numbers_by_the_same_disturbance(healthy: SideProblem) -> None:
    """As many columns there as at the numbers that are used, and not all of them 0."""
    for group in healthy.groups:
        assert group.held_out is not None
        assert group.held_out.shape == (sum(len(b.value) for b in healthy.held_out), group.columns.shape[1])
    assert any(np.any(group.held_out) for group in healthy.groups if group.held_out is not None)


@pytest.mark.slow
def test_a_healthy_camera_has_nothing_and_passes_the_check(healthy: SideProblem) -> None:
    search, table = search_side(healthy)
    posterior = read_table(table, search.hypotheses)
    assert not posterior.named
    assert posterior.nothing > 0.5
    assert passes(check_held_out(healthy, search, table))


@pytest.mark.slow
def test_strong_row_noise_is_named_alone() -> None:
    search, table = search_side(_problem(_law("row_noise", 8.0)))
    posterior = read_table(table, search.hypotheses)
    assert [f.name for f in posterior.named] == ["row_noise"]
    assert not table.is_undecided
