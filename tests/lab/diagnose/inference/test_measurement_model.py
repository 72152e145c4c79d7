"""The measurement model: held-out numbers given the seen ones."""

from __future__ import annotations

import numpy as np

from lab.observables.observable import Prediction
from sim.effects.library import effect
from tests.lab.diagnose.inference.made_up import contrast_model


def test_held_out_chi2_is_its_number_for_the_truth() -> None:
    """46 numbers: mean 46, standard deviation sqrt(92) = 9.6; over 30 draws of the mean 3 sigma are 5.3."""
    truth = (effect("defocus")(defocus_um=8.0),)
    found = [contrast_model(np.random.default_rng(s), truth).held_out(truth) for s in range(30)]
    assert {n for _, n in found} == {46}
    # the form tolerance widens the distribution: never above, little below
    assert 46 - 12 < np.mean([c for c, _ in found]) < 46 + 5.3
    assert np.mean([contrast_model(np.random.default_rng(s), truth).held_out()[0] for s in range(5)]) > 200


def test_a_jacobian_is_computed_when_it_is_first_asked_for() -> None:
    asked = []

    def columns() -> dict[str, np.ndarray]:
        asked.append(1)
        return {"black": np.ones(2)}

    prediction = Prediction(np.zeros(2), columns)
    assert not asked
    assert prediction.jacobian is prediction.jacobian
    assert list(prediction.jacobian) == ["black"] and asked == [1]
