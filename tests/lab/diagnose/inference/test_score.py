"""The scores of effects: a likelihood ratio, with a threshold that holds its rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.score import Signatures, signatures
from lab.observables.observable import Observable
from sim.effects.base import Effect
from sim.effects.library import effect, effects
from tests.lab.diagnose.inference.made_up import CAMERA, FREQUENCY, NOISE, contrast_model


def test_score_is_the_likelihood_ratio_of_a_small_effect() -> None:
    """Noise-free, S = |whitened change|^2; the change of defocus is linear in u to better than 5 % here."""
    truth = effect("defocus")(defocus_um=5.0)
    model = contrast_model(np.random.default_rng(1), (truth,))
    exact = model.mean((truth,))
    clean = MeasurementModel((Observable(**{**model.blocks[0].__dict__, "value": exact}),), CAMERA)
    change = (exact - clean.mean())[clean.seen] / NOISE
    score = next(s for s in signatures(clean, CAMERA, (), [effect("defocus")]).scores())
    assert score.value == pytest.approx(float(change @ change), rel=0.05)


def test_threshold_holds_its_rate() -> None:
    """Of 300 healthy draws 1 % may exceed the 99 % quantile; 3 sigma of a binomial is 3 + 5.2 = 8 of them."""
    rng = np.random.default_rng(2)
    kinds = list(effects().values())
    first = signatures(contrast_model(rng), CAMERA, (), kinds)
    threshold = first.threshold(np.random.default_rng(0), 0.99, 400)
    exceeded = 0
    for _ in range(300):
        draw = replace(first, white=rng.standard_normal(len(first.white)))
        exceeded += max(s.value for s in draw.scores()) > threshold
    assert exceeded <= 8


def test_a_refit_begins_at_the_prototype_that_lies_nearest() -> None:
    """Ten times the first prototype promises most, but is far off where it isn't small; the second one is half of the
    residual."""
    few, many = (effect("hot_pixels")(excess_e_per_s=100.0, share_ppm=ppm) for ppm in (20.0, 200.0))
    white, promised, near = np.array([10.0, 1.0]), np.array([1.0, 0.0]), np.array([5.0, 1.0])

    def table_of(prototypes: Sequence[Effect]) -> np.ndarray:
        return np.array([[100.0, 100.0] for _ in prototypes]).T

    columns = [(type(few), (one,), table[:, None]) for one, table in ((few, promised), (many, near))]
    (score,) = Signatures(CAMERA, white, columns, table_of).scores()
    assert score.value == pytest.approx(51.0**2 / 26.0)
    assert score.start == many
    (score,) = Signatures(CAMERA, white, columns, lambda one: white[:, None]).scores()  # the scaled one is all of it
    assert score.start.replace_fields(excess_e_per_s=100.0) == many
    assert score.start != many


def test_score_of_a_one_sided_effect_is_never_negative() -> None:
    """A contrast that is too high can't be a blur."""
    model = contrast_model(np.random.default_rng(3), (), 0.05 * np.exp(-FREQUENCY))
    scores = {
        s.effect.name: s.value
        for s in signatures(model, CAMERA, (), [effect("defocus"), effect("pixel_aperture")]).scores()
    }
    assert scores["defocus"] >= 0.0
    assert scores["defocus"] < 0.05 * scores["pixel_aperture"]
