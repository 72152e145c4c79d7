"""Hypotheses of a camera and of what both cameras share, over two sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit, logit

from lab.diagnose.evidence.causes import Cause
from lab.diagnose.evidence.merge import joint_moments, joint_probability, merged_evidence, told_by_all
from lab.diagnose.evidence.side import EvidenceFindings, SetRow
from lab.diagnose.evidence.side_table import SideTable
from lab.diagnose.outcome.expected_information import Forecast, settling_probability
from lab.diagnose.outcome.next_capture import NOTHING, next_sentence
from lab.diagnose.policy import DEFAULT_POLICY
from lab.formats.results import DiagnosisLists, NextCapture
from lab.inference.hypotheses import Coordinate, SetPrior
from lab.inference.posterior import Size
from sim.camera import Side
from sim.effects.axial_chromatic_aberration import AxialChromaticAberration
from sim.effects.base import Effect
from sim.effects.defocus import Defocus
from sim.effects.source_drift import SourceDrift

PRIOR = 0.01


def _cause(effect: Effect, probability: float, size: float, std: float, parameter: str) -> Cause:
    """Return a cause of one size, of a prior that is Student's t of scale 1."""
    return Cause(
        name=effect.name, effect=effect, probability=probability, prior=PRIOR,
        sizes=(Size(parameter, size, std, (size - 2.0 * std, size + 2.0 * std), True),),
        mean=np.array([size]), covariance=np.array([[std**2]]), inexact=0.0, shown_in=("dark",),
        coordinates=(Coordinate(parameter, 1.0),),
    )  # fmt: skip


def _side(side: Side, cause: Cause) -> EvidenceFindings:
    return EvidenceFindings(
        side, DiagnosisLists(), is_judged=True, said="explained", causes=(cause,),
        inclusion={cause.name: (PRIOR, cause.probability)},
    )  # fmt: skip


def _drift(probability: float, size: float = 0.5, std: float = 0.1) -> Cause:
    return _cause(SourceDrift(drift_percent_per_min=size), probability, size, std, "drift_percent_per_min")


def _pair(causes: Sequence[Cause]) -> tuple[EvidenceFindings, EvidenceFindings]:
    return _side("left", causes[0]), _side("right", causes[1])


def test_a_side_that_says_nothing_leaves_the_others_probability() -> None:
    """Posterior equal to the prior: a Bayes factor of 1."""
    told = _drift(0.7)
    other = EvidenceFindings("right", DiagnosisLists(), is_judged=True, inclusion={told.name: (PRIOR, PRIOR)})
    assert joint_probability(told.name, (_side("left", told), other), [told]) == pytest.approx(0.7)


def test_sides_that_agree_multiply_their_bayes_factors() -> None:
    """Odds: prior times both factors times c = N(0; 0, 2 s^2) / p(0.5) of equal sizes: p is nearly linear over their
    posterior, whose standard deviation is 0.07, and curved by some 1e-3 of itself there."""
    causes = [_drift(0.8), _drift(0.7)]
    factors = (logit(0.8) - logit(PRIOR)) + (logit(0.7) - logit(PRIOR))
    agreement = -0.5 * np.log(2.0 * np.pi * 2.0 * 0.1**2) - float(Coordinate("size", 1.0).log_prior(0.5))
    expected = expit(logit(PRIOR) + factors + agreement)
    found = joint_probability("source_drift", _pair(causes), causes)
    assert logit(found) == pytest.approx(logit(expected), abs=0.02)
    (named,) = merged_evidence("made up", _pair(causes)).effects
    assert named.sides == ("left", "right")
    assert named.probability == found


def test_a_side_that_learns_nothing_of_a_shape_agrees_with_any() -> None:
    """A normal prior, and one side whose posterior is that prior: p(u | y_1) p(u) / p(u) has the integral 1. The mean
    of 1 / p over the joint fit varies as a lognormal number of sigma^2 below 0.1: 3 sqrt(0.1 / 2000) = 0.02."""
    told, quiet = _drift(0.9, 0.3, 0.1), _drift(0.9, 0.0, 1.0)
    shape = (Coordinate("drift_percent_per_min", 1.0, is_shape=True),)
    causes = [replace(told, coordinates=shape), replace(quiet, coordinates=shape)]
    factors = 2.0 * (logit(0.9) - logit(PRIOR))
    found = joint_probability("source_drift", _pair(causes), causes)
    assert logit(found) == pytest.approx(logit(PRIOR) + factors, abs=0.02)


def test_a_joint_fit_has_the_precision_of_both_sides() -> None:
    """Precisions add; means are weighed by them."""
    rng = np.random.default_rng(2)
    covariances = [a @ a.T + 0.1 * np.eye(3) for a in rng.standard_normal((2, 3, 3))]
    means = rng.standard_normal((2, 3))
    mean, covariance = joint_moments(means[0], covariances[0], means[1], covariances[1])
    precisions = [np.linalg.inv(c) for c in covariances]
    np.testing.assert_allclose(np.linalg.inv(covariance), precisions[0] + precisions[1], rtol=1e-6)
    np.testing.assert_allclose(mean, covariance @ (precisions[0] @ means[0] + precisions[1] @ means[1]), rtol=1e-6)


def test_sides_that_contradict_each_other_name_no_common_cause() -> None:
    """Drifts of opposite signs, ten standard deviations apart: exp(-50 / 2) outweighs factors of some hundred."""
    causes = [_drift(0.97, 0.5), _drift(0.97, -0.5)]
    assert joint_probability("source_drift", _pair(causes), causes) < 0.5
    result = merged_evidence("made up", _pair(causes))
    assert not result.effects
    assert result.verdict == "unexplained"


def test_a_rival_of_what_both_sides_share_falls_with_what_the_other_side_says() -> None:
    """Left: the lamp's drift or a defocus, one of the two, equally probable. Right: the drift, nearly surely. Given
    both, the drift has p, and the defocus, which is in all of left's other sets, 1 - p."""
    drift, defocus = _drift(0.5), _cause(Defocus(defocus_um=3.0), 0.5, 3.0, 0.1, "defocus_um")
    left = replace(
        _side("left", drift), causes=(drift, defocus),
        rows=(
            SetRow(frozenset({"source_drift"}), frozenset(), 0.5),
            SetRow(frozenset({"defocus"}), frozenset({"response"}), 0.5),
        ),
        calm=True,
    )  # fmt: skip
    sure = _drift(0.9999)
    right = replace(
        _side("right", sure), rows=(SetRow(frozenset({"source_drift"}), frozenset(), 1.0),)
    )  # of one set: nothing to reweigh
    p = joint_probability("source_drift", (left, right), [drift, sure])
    assert p > 0.99
    told, other = told_by_all((left, right))
    assert {c.name: c.probability for c in told.causes} == pytest.approx({"source_drift": 0.5, "defocus": 1.0 - p})
    assert told.calm
    assert other == right
    (named,) = merged_evidence("made up", (left, right)).effects
    assert (named.name, named.sides, named.probability) == ("source_drift", ("left", "right"), pytest.approx(p))


def test_one_side_tells_what_it_tells() -> None:
    alone = replace(_side("left", _drift(0.97)), rows=(SetRow(frozenset({"source_drift"}), frozenset(), 1.0),))
    assert told_by_all((alone,)) == [alone]


def test_an_effect_of_a_camera_has_an_entry_for_each_side() -> None:
    first, second = (_cause(Defocus(defocus_um=s), 0.97, s, 0.1, "defocus_um") for s in (3.0, 5.0))
    effects = merged_evidence("made up", _pair([first, second])).effects
    assert {e.sides: e.parameters["defocus_um"].value for e in effects} == {("left",): 3.0, ("right",): 5.0}
    assert all(e.probability == 0.97 for e in effects)


def test_a_name_on_one_side_leaves_the_other_without_it() -> None:
    first, second = (_cause(Defocus(defocus_um=3.0), p, 3.0, 0.1, "defocus_um") for p in (0.97, 0.5))
    (named,) = merged_evidence("made up", _pair([first, second])).effects
    assert named.sides == ("left",)


def test_inclusion_priors_sum_to_the_expected_number() -> None:
    """Sum over hypotheses of p(member) = sum over k of k p_k, where each number has sets."""
    prior = SetPrior({name: name[0] for name in ("a1", "a2", "a3", "b1", "b2", "c1", "d1", "e1", "f1")})
    reading = SideTable.__new__(SideTable)
    object.__setattr__(reading, "search", type("_Search", (), {"prior": prior})())
    total = sum(reading.inclusion_prior.values())
    assert total == pytest.approx(sum(k * p for k, p in enumerate(prior.number)))


@pytest.mark.parametrize("apart", [1.0, 3.0, 5.0])
def test_a_capture_settles_as_often_as_the_normal_distribution_says(apart: float) -> None:
    """ln(odds) of two rivals `apart` standard deviations apart is N(+-d^2 / 2, d^2). Tolerance: 3 sigma of 400 draws of
    each, 3 * 0.5 / sqrt(400) = 0.075."""
    from scipy.special import ndtr

    none = [np.zeros((1, 0))] * 2
    forecast = Forecast.of(np.array([[0.0], [apart]]), none, none, np.eye(1))
    limit = logit(0.95)
    expected = ndtr((0.5 * apart**2 - limit) / apart) + ndtr((-0.5 * apart**2 - limit) / apart)
    found = settling_probability([forecast], (0.5, 0.5), 0.95)
    assert found == pytest.approx(float(expected), abs=0.075)


def test_what_tells_nothing_settles_nothing() -> None:
    none = [np.zeros((1, 0))] * 2
    forecast = Forecast.of(np.zeros((2, 1)), none, none, np.eye(1))
    assert settling_probability([forecast], (0.6, 0.4), 0.95) == 0.0
    assert settling_probability([forecast], (0.96, 0.04), 0.95) == 1.0


def test_sizes_that_one_side_cannot_tell_apart_are_reported_by_their_sum() -> None:
    """Coordinates u = p^2 of 15 and 12 um with standard deviations of 100 um^2 and a correlation of -0.99: their sum
    has sqrt(2 (1 - 0.99)) 100 = 14 um^2, and neither is determined."""
    spread = 100.0**2 * np.array([[1.0, -0.99], [-0.99, 1.0]])
    names, u = ("slope_um", "curvature_um"), np.array([150.0, 140.0])
    cause = Cause(
        name="axial_chromatic_aberration",
        effect=AxialChromaticAberration(slope_um=12.0, curvature_um=12.0),
        probability=0.99,
        prior=PRIOR,
        sizes=tuple(Size(name, 12.0, 5.0, (-6.0, 18.0), False) for name in names),
        mean=u,
        covariance=spread,
        inexact=0.0,
        shown_in=("slanted_edge",),
    )
    (named,) = merged_evidence("made up", [_side("left", cause)]).effects
    (one,) = named.combinations
    assert (one.side, one.parameters, one.power, one.unit) == ("left", names, 2, "um^2")
    assert one.weights == pytest.approx((1.0, 1.0))
    assert (one.value, one.std) == (pytest.approx(290.0), pytest.approx(100.0 * np.sqrt(0.02)))
    assert "slope_um^2 + curvature_um^2 = 290 ± 14 um^2 is, of the left camera" in named.statement
    assert not any(value.is_determined for value in named.parameters.values())


def test_a_rival_without_an_effect_is_told_as_such() -> None:
    """Defocus depends on the f-number, nothing doesn't: another f-number may tell them apart."""
    offered = NextCapture(
        side="left", capture="edges", rivals=(NOTHING, "defocus"), distance=0.1, told_apart=0.6, settles=0.0
    )
    sentence = next_sentence((offered,), None, DEFAULT_POLICY)
    assert sentence is not None
    assert "no capture that can be predicted tells defocus from no further effect" in sentence
    assert sentence.endswith("defocus changes.")
