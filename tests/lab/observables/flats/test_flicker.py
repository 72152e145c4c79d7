"""Flickering light in the rows of flat frames: laws of the second image former and of `sim`, and look-alikes that
aren't flicker."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.independent_simulator.laws import LightFlickerLaw, PeriodicBandingLaw, RowNoiseLaw
from lab.errors import NotDetermined
from lab.observables.flats.field import measure_flat_field
from lab.observables.flats.linearity import measure_photon_transfer
from lab.observables.flats.rows import measure_flat_rows
from sim.effects.light_flicker import LightFlicker
from tests.lab.diagnose.on_blocks import dataset, former, measured_model, names, rendered, sigmas, verdict

LOOKED_AT = (measure_flat_rows, measure_photon_transfer, measure_flat_field)


def test_rows_of_healthy_frames_are_noise() -> None:
    """chi2 of about 60 numbers: its mean over 4 cameras within 3 / sqrt(4) of its standard deviation, and 0.3 for what
    is free."""
    found = [sigmas(measured_model(former(s, cfa=c), measure_flat_rows)) for s in (1, 2) for c in ("MONO", "RGGB")]
    assert abs(np.mean(found)) < 3.0 / np.sqrt(4) + 0.3
    assert max(found) < 4.0


@pytest.mark.parametrize(("variant", "cfa"), [(0, "MONO"), pytest.param(1, "GRBG", marks=pytest.mark.slow)])
def test_flicker_of_another_former_is_named(variant: int, cfa: str) -> None:
    """A sinusoidal and a rectified modulation: half a period over the frame, 0.3 % of the light at 5 ms."""
    found = verdict(former(11, LightFlickerLaw(1.0, variant, 3), cfa=cfa), *LOOKED_AT)
    assert names(found) == ["light_flicker"]


def test_flicker_of_sim_is_named_with_its_bands() -> None:
    """The bands' frequency, frequency x line time, is what rows show: 2.976 periods a frame. Of the light's frequency
    only the loss of depth at longer exposures tells."""
    truth = LightFlicker(modulation_percent=6.0, frequency_hz=100.0, line_time_us=310.0)
    found = verdict(rendered(5, (truth,)), *LOOKED_AT)
    assert names(found) == ["light_flicker"]
    effect = found.named[0].effect
    assert isinstance(effect, LightFlicker)
    assert effect.frequency_hz * effect.line_time_us * 96e-6 == pytest.approx(2.976, rel=0.03)
    for name in ("frequency_hz", "line_time_us", "modulation_percent"):
        std = found.named[0].std[name]
        assert std is not None
        assert abs(getattr(effect, name) - getattr(truth, name)) < 3.0 * std


def test_bands_that_move_from_repeat_to_repeat_are_no_shot_noise() -> None:
    """The first guess of the gain, from differences of repeats, beside the same camera in steady light: within 5 %."""
    steady, flickering = (dataset(former(11, *laws)).noise.gain for laws in ((), (LightFlickerLaw(10.0, 0, 9),)))
    assert flickering == pytest.approx(steady, rel=0.05)


def test_noise_of_rows_is_no_flicker() -> None:
    """Row noise that dark frames have, too: white, and a ripple of a fixed period."""
    for law in (RowNoiseLaw(4.0), PeriodicBandingLaw(3.0, 0, 5)):
        assert "light_flicker" not in names(verdict(former(12, law), *LOOKED_AT))


def test_recordings_that_determine_no_flicker_are_refused() -> None:
    with pytest.raises(NotDetermined, match="repeated"):
        measured_model(former(1, kinds=("dark",)), measure_flat_rows)
