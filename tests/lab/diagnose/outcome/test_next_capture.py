"""The next capture: as far apart as it says, the best one first, and taken by a station where it can."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import norm

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.measurements.block import Block, Label, Prediction
from lab.diagnose.outcome.candidate_captures import Hypothesis, designs
from lab.diagnose.outcome.next_capture import next_sentence, proposals
from lab.diagnose.policy import DecisionPolicy
from lab.formats.camera_file import default_camera
from lab.formats.recording_set import Manifest, RecordingSet
from lab.formats.results import NextCapture
from sim.effects.base import Effect
from sim.effects.black_level_drift import BlackLevelDrift
from sim.effects.infrared_cut_filter import InfraredCutFilter
from sim.effects.library import effect
from sim.effects.nonlinearity import Nonlinearity
from sim.effects.source_drift import SourceDrift
from sim.point import TRANSFER, Blur
from tests.lab.diagnose.on_blocks import declared

CAMERA = default_camera().camera
SET = RecordingSet(
    Manifest.model_validate(
        {"cameras": {"left": {"rows": 8, "cols": 8, "cfa": "RGGB", "bit_depth": 12}}, "captures": []}
    )
)


FREQUENCY = np.linspace(0.04, 0.9, 16)


def _model(acting: Sequence[Effect] = ()) -> MeasurementModel:
    """A contrast along rows, of one wavelength: too little to tell blurs apart."""

    def predict(effects: Sequence[Effect]) -> Prediction:
        factor = Blur(CAMERA, effects).beside_lens(550.0, FREQUENCY, 0.0 * FREQUENCY)
        return Prediction(np.exp(-2.0 * FREQUENCY) * np.real(factor), {})

    block = Block(
        measurement=declared("slanted_edge", "spatial_frequency", "cy/px"), reach=0.2, value=predict(acting).mean, covariance=4e-6 * np.eye(16),
        labels=tuple(Label(float(f), "G", "5 deg", ("edge-1",), False) for f in FREQUENCY), reads=TRANSFER,
        predict=predict, scale=np.ones(16),
    )  # fmt: skip
    return MeasurementModel((block,), CAMERA)


def _undecided(one: Effect, *others: tuple[str, float]) -> Verdict:
    share = 1.0 - sum(p for _, p in others)
    candidate = Candidate(one, {}, share, others, 30.0)
    return Verdict(_model((one,)), 12.0, 60.0, (), (candidate,), (), (), ())


def _best(*hypotheses: Effect) -> str:
    """The words of the design in which two effects lie furthest apart."""
    held = [Hypothesis(e.name, (e,), CAMERA) for e in hypotheses]

    def distance(predict: object, covariance: np.ndarray) -> float:
        apart = predict(held[0]) - predict(held[1])  # type: ignore[operator]
        return float(apart @ np.linalg.solve(covariance, apart))

    found = list(designs(SET, "left", _model()))
    return max(found, key=lambda d: distance(d.predict, d.covariance)).words


def test_the_design_follows_what_the_rivals_differ_in() -> None:
    drift, bend = SourceDrift(), Nonlinearity()
    quantity = next(iter(SourceDrift.quantities()))
    drift = SourceDrift(**{quantity: 0.3})
    bend = Nonlinearity(**{next(iter(Nonlinearity.quantities())): 0.3})
    assert _best(drift, bend) == "the same flat every five minutes for an hour"
    early, late = (InfraredCutFilter(cut_wavelength_nm=nm, width_nm=4.0) for nm in (650.0, 654.0))
    words = _best(early, late)
    assert words.startswith("narrowband light at ")
    assert abs(float(words.split()[-2]) - 652.0) < 8.0  # where the one has fallen and the other hasn't
    level = BlackLevelDrift(**{next(iter(BlackLevelDrift.quantities())): 3.0})
    assert "dark frames" in _best(level, BlackLevelDrift())


def test_distance_is_what_decides() -> None:
    """Numbers drawn under one rival are nearer to it than to the other with the probability that is stated: Phi(sqrt(D
    / 2)); 3 sigma of a binomial of 4000 draws are 3 sqrt(p (1 - p) / 4000) < 0.024."""
    first, second = (
        Hypothesis("a", (InfraredCutFilter(cut_wavelength_nm=nm, width_nm=4.0),), CAMERA) for nm in (650.0, 650.02)
    )
    design = next(d for d in designs(SET, "left", _model()) if d.words == "narrowband light at 650 nm")
    a, b = design.predict(first), design.predict(second)
    lower = np.linalg.cholesky(design.covariance)
    apart = np.linalg.solve(lower, a - b)
    d = 0.5 * float(apart @ apart)
    assert 0.02 < d < 4.0  # else nothing is tested
    noise = np.random.default_rng(4).standard_normal((4000, len(a)))
    nearer = np.sum(np.square(noise), axis=1) < np.sum(np.square(noise + apart), axis=1)
    assert float(np.mean(nearer)) == pytest.approx(float(norm.cdf(np.sqrt(0.5 * d))), abs=0.024)


def test_proposals_are_sorted_and_name_their_nearest_rivals() -> None:
    verdict = _undecided(effect("optical_low_pass_filter")(displacement_x_um=1.0), ("defocus", 0.3), ("unknown", 0.1))
    found = [p.capture for p in proposals(SET, "left", verdict, DecisionPolicy())]
    assert {c.rivals for c in found} == {("optical_low_pass_filter", "defocus")}
    assert "edges" in found[0].capture  # one spreads along two axes, the other all around
    assert found[0].distance > 2.0
    assert [c.distance for c in found] == sorted((c.distance for c in found), reverse=True)
    assert all(c.told_apart == pytest.approx(norm.cdf(np.sqrt(0.5 * c.distance))) for c in found)


def test_nothing_undecided_needs_no_capture() -> None:
    assert proposals(SET, "left", _undecided(Nonlinearity(), ("unknown", 0.02)), DecisionPolicy()) == ()
    assert next_sentence((), False, DecisionPolicy()) is None


@pytest.mark.parametrize(
    ("distance", "words"), [(8.0, "would tell defocus from vibration_blur"), (0.5, "may tell them apart")]
)
def test_the_sentence_says_what_can_be_hoped(distance: float, words: str) -> None:
    told = float(norm.cdf(np.sqrt(0.5 * distance)))
    capture = NextCapture(
        side="left",
        capture="edges in red light",
        rivals=("defocus", "vibration_blur"),
        distance=distance,
        told_apart=told,
    )
    sentence = next_sentence((capture,), False, DecisionPolicy())
    assert sentence is not None
    assert words in sentence
    assert f"{np.sqrt(2 * distance):.1f} standard deviations" in sentence
