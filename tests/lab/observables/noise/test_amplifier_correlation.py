"""Noise of pixels that are read together: none on healthy cameras, and what coupled amplifiers leave."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.independent_simulator import Law
from evaluation.independent_simulator.laws import (
    AmplifierCrosstalkLaw,
    ColumnNoiseLaw,
    OnChipSmoothingLaw,
    PinkNoiseLaw,
    RowNoiseLaw,
    TapGainLaw,
)
from lab.errors import NotDetermined
from lab.observables.flats.field import measure_flat_field
from lab.observables.flats.linearity import measure_photon_transfer
from lab.observables.noise.amplifier_correlation import RELATIONS, measure_amplifier_correlation
from sim.effects.base import Effect
from sim.effects.library import effect
from tests.lab.diagnose.on_blocks import dataset, former, measured_model, sigmas
from tests.lab.inference.on_blocks import judge
from tests.lab.mono_session import MonoSession


@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
def test_healthy_cameras_have_none(cfa: str) -> None:
    """8 relations in the dark and in light, seen and held out, of 5 cameras: mean pull to 4 / sqrt(n), mean square to
    4 sqrt(2 / n), n = 160."""
    blocks = [measure_amplifier_correlation(dataset(former(4100 + seed, cfa=cfa))) for seed in range(5)]
    pulls = np.concatenate([b.value / np.sqrt(np.diag(b.covariance)) for b in blocks])
    assert abs(pulls.mean()) < 4.0 / np.sqrt(len(pulls))
    assert abs(np.mean(np.square(pulls)) - 1.0) < 4.0 * np.sqrt(2.0 / len(pulls))


@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
@pytest.mark.parametrize("law", [RowNoiseLaw(4.0, 1, 3), ColumnNoiseLaw(4.0, 1, 3), OnChipSmoothingLaw(0.3, 1, 3)])
def test_other_noise_that_pixels_share_is_none(law: Law, cfa: str) -> None:
    """Row noise goes with the rows' means, and what neighbours share widens the scatter that is measured."""
    assert sigmas(measured_model(former(4201, law, cfa=cfa), measure_amplifier_correlation)) < 4.0


@pytest.mark.parametrize(
    ("law", "known"),
    [
        (AmplifierCrosstalkLaw(4.0, 0, 3), effect("amplifier_crosstalk")(share_percent=4.0, order="turned")),
        (
            AmplifierCrosstalkLaw(4.0, 1, 3),
            effect("amplifier_crosstalk")(share_percent=4.0, far_share=0.3, layout="four columns"),
        ),
        (AmplifierCrosstalkLaw(4.0, 2, 3), effect("amplifier_crosstalk")(share_percent=4.0, excess_percent=4.0)),
        # slow waves of the rows' common part are few: within the scatter of parts
        (PinkNoiseLaw(4.0, 0, 3), effect("reading_order_noise")(noise_e=4.6)),
    ],
    ids=["turned", "four", "one way", "reading order"],
)
def test_what_couples_is_predicted(law: Law, known: Effect) -> None:
    """chi2 of all numbers within 4 of its standard deviations with the effect, and far beyond without."""
    model = measured_model(former(4301, law), measure_amplifier_correlation)
    assert sigmas(model, (known,)) < 4.0
    if law.effect == "amplifier_crosstalk":
        assert sigmas(model) > 8.0


def test_small_frames_are_skipped_and_every_relation_pairs_all_pixels() -> None:
    frame = np.arange(32 * 64).reshape(32, 64)
    for one in RELATIONS.values():
        here, there = one(frame)
        assert here.shape == there.shape
        assert not np.any(here == there)
    with pytest.raises(NotDetermined, match=r"frames of 24 px.*from 32 px"):
        measure_amplifier_correlation(dataset(MonoSession(shape=(24, 64), levels=4).recordings()))


@pytest.mark.parametrize(
    ("law", "name"), [(TapGainLaw(1.0), "taps"), (AmplifierCrosstalkLaw(4.0, 2, 3), "amplifier_crosstalk")]
)
def test_a_step_of_gain_is_told_from_crosstalk_by_what_areas_share(law: Law, name: str) -> None:
    """Both change the gains of areas; crosstalk lets their noise be alike."""
    found = judge(former(24, law), measure_flat_field, measure_photon_transfer, measure_amplifier_correlation)
    assert found.names == [name]
