"""Repeatability of the light from frame to frame: cameras of the second image former, and drawn scatter."""

from __future__ import annotations

import numpy as np
import pytest

from lab.diagnose.inference.decide import decide
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.measurements.level_repeats import level_repeats_block
from lab.diagnose.policy import DecisionPolicy
from mocks.former.laws import ImageLagLaw, LightFlickerLaw, SourceInstabilityLaw
from sim.effects.image_lag import ImageLag
from sim.effects.light_flicker import LightFlicker
from sim.effects.source_instability import SourceInstability
from tests.lab.diagnose.on_blocks import former, study


@pytest.mark.parametrize("seed", [772511, 772512, 772513, 772514])
def test_a_steady_source_is_no_finding(seed: int) -> None:
    block = level_repeats_block(study(former(seed)))
    left = block.value - block.predict(()).mean
    assert np.all(np.abs(left) < 3.0 * np.sqrt(np.diag(block.covariance)))


def test_an_unsteady_source_is_named_with_its_size() -> None:
    """1.2 % from frame to frame; with f degrees of freedom a standard deviation is known to sqrt(1 / (2 f)), 25 % for f = 8."""
    here = study(former(772521, SourceInstabilityLaw(1.2, 0, 9)))
    verdict = decide(
        MeasurementModel((level_repeats_block(here),), here.camera), np.random.default_rng(0), DecisionPolicy()
    )
    assert [c.effect.name for c in verdict.named] == ["source_instability"]
    found, std = (
        verdict.named[0].effect.model_dump()["instability_percent"],
        verdict.named[0].std["instability_percent"],
    )
    assert std is not None
    assert abs(found - 1.2) < 3.0 * std
    assert found > 0.4


def test_flicker_within_frames_moves_whole_frames_too() -> None:
    """100 Hz over 96 rows of 60 us, 0.58 of a period: whole frames scatter by what the rows' mean leaves of the modulation, and no
    other light is asked for."""
    law = LightFlickerLaw(20.0, 0, 4)
    block = level_repeats_block(study(former(772531, law)))
    flicker = LightFlicker(modulation_percent=20.0, frequency_hz=100.0, line_time_us=60.0)
    std = np.sqrt(np.diag(block.covariance))
    assert np.any(block.value - block.predict(()).mean > 3.0 * std)
    assert np.all(np.abs(block.value - block.predict((flicker,)).mean) < 3.0 * std)


@pytest.mark.parametrize("seed", [772551, 772556])
def test_image_lag_scatters_repeats_by_what_the_frames_before_left(seed: int) -> None:
    """5 % of the frame before, exposures up and down, the same noise with and without it. S = (lag + noise)^2 over 4 degrees of freedom:
    beside a change of ln S by d, the product of both scatters ln S by 2 exp(-d / 2) / sqrt(4). It was called source_instability."""
    with_lag = level_repeats_block(study(former(seed, ImageLagLaw(5.0, 0, 9), shuttle=True)))
    without = level_repeats_block(study(former(seed, shuttle=True)))
    change = with_lag.predict((ImageLag(lag_percent=5.0),)).mean - with_lag.predict(()).mean
    assert np.all(change > 2.0)
    assert np.all(np.abs(with_lag.value - without.value - change) < 3.0 * np.exp(-0.5 * change))


def test_the_law_adds_its_variance() -> None:
    """log((n + s^2 + s0^2) / (n + s0^2)) grows with s, and is 2 log(s) apart for large s."""
    block = level_repeats_block(study(former(772541)))
    one, two = (block.predict((SourceInstability(instability_percent=s),)).mean for s in (5.0, 10.0))
    np.testing.assert_allclose(two - one, 2.0 * np.log(2.0), rtol=1e-3)
