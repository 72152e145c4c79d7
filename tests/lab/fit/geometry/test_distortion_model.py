"""The choice of the distortion model, and the error of the model from two halves of the views."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.geometry.calibration import calibrate_robustly
from lab.fit.geometry.cross_validation import cross_validation
from tests.lab.fit.projected import SHAPE, poses, seen


def test_a_model_that_overfits_is_refused():
    """Six views of twelve noisy corners in the middle of the frame: the coefficients beyond k1 predict unseen views worse."""
    refused = 0
    for draw in range(2):
        views = seen(np.random.default_rng(draw), poses(6, squares=(4, 5)), noise_px=0.3, squares=(4, 5))
        models = calibrate_robustly(views, SHAPE).models
        chosen = next(model for model in models if model.chosen)
        richest = models[-1]
        assert chosen.held_out_rms_px <= 1.03 * min(model.held_out_rms_px for model in models[:1])
        if richest is not chosen:
            refused += 1
            assert richest.reason.startswith("refused")
            assert richest.held_out_rms_px > chosen.held_out_rms_px
    assert refused


def test_a_model_that_is_too_simple_is_not_chosen():
    models = calibrate_robustly(seen(np.random.default_rng(0), poses(12)), SHAPE).models
    assert not models[0].chosen  # the truth has k2, p1 and p2
    assert models[0].held_out_rms_px > 1.03 * models[-1].held_out_rms_px


def test_an_error_of_the_model_is_told_from_the_samplings():
    """A board that takes another shape in every view: the halves differ by more than the corners' noise lets them, and by
    no more than is stated.
    """
    rng = np.random.default_rng(3)
    at = poses(14)
    floppy = [tuple(rng.normal(0, 2.0, 3)) for _ in at]
    wrong = cross_validation(calibrate_robustly(seen(rng, at, noise_px=0.03, warps_mm=floppy), SHAPE))
    right = cross_validation(calibrate_robustly(seen(rng, at, noise_px=0.03), SHAPE))
    assert right.model_error_px == 0.0 or right.significance_sigma < 3.3  # 1 in 1000
    assert wrong.difference_px > 2 * right.difference_px
    assert wrong.difference_px > 3 * wrong.sampling_px
    assert wrong.significance_sigma < 3.3
    assert right.expected_px == pytest.approx(right.sampling_px)
    assert wrong.model_error_px > 3 * right.expected_px
