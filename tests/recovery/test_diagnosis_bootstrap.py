"""Whether the threshold holds on images: healthy cameras drawn frame by frame by the forward model, through every
estimator."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.diagnose.inference.bootstrap import healthy_draws
from lab.diagnose.inference.score import signatures
from lab.diagnose.inference.side_model import measurement_model
from sim.effects.library import candidates

DRAWS = 24


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "cfa"), [(3, "MONO"), (4, "RGGB"), (5, "MONO")])
def test_the_threshold_holds_on_images(seed: int, cfa: str) -> None:
    """Of 24 draws at a rate of 1 %, more than 3 exceed it with a probability of 1e-5. No measurement's chi2 is above
    its number of values by more than 4 sigmas of a mean of 24: then its covariance would be too narrow."""
    recordings = recordings_of(ConcealedCamera(seed, cfa=cfa, rows=96, cols=128), Plan())
    model, _ = measurement_model(recordings, "left")
    assert model is not None
    known = candidates()
    threshold = signatures(model, model.camera, (), known).threshold(np.random.default_rng(0), 0.99, 400)
    draws = healthy_draws(recordings, "left", model, DRAWS, np.random.default_rng(seed))
    tops = sorted(d.top_score for d in draws)
    print(f"{cfa}: threshold {threshold:.1f}, scores {tops[len(tops) // 2]:.1f} in the middle, {tops[-1]:.1f} at most")
    assert len(draws) == DRAWS
    assert sum(top > threshold for top in tops) <= 3
    for name in draws[0].chi2:
        found = [d.chi2[name] for d in draws if name in d.chi2]
        mean, n = float(np.mean([c for c, _ in found])), found[0][1]
        print(f"  {name}: chi2 {mean:.1f} of {n}")
        assert mean < n + 4.0 * np.sqrt(2.0 * n / len(found))
