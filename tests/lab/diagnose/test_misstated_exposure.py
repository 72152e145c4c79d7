"""One level with a misstated shutter time is reported with its captures and the exposure that fits."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.diagnose.inference.held_out import held_out_mismatches
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.outlying import freed, outlying_levels
from lab.diagnose.outcome.corrections import Correction
from lab.diagnose.outcome.mismatches import located, unexplained
from lab.diagnose.policy import DecisionPolicy
from lab.formats.recording_set import RecordingSet
from lab.observables.darks.level import measure_dark
from lab.observables.flats.linearity import measure_photon_transfer
from tests.lab.diagnose.on_blocks import measured_model, verdict

DARKS = 9


class _WrongShutter(ConcealedCamera):
    """Some frames are exposed `factor` times as long as is noted."""

    wrong: frozenset[int] = frozenset()
    factor = 1.0

    def expose(self, images: Any, exposure_s: float, k: int, temperature_c: float = 25.0) -> Any:
        return super().expose(images, exposure_s * (self.factor if k in self.wrong else 1.0), k, temperature_c)


def _recorded(seed: int, factor: float, frames: Iterable[int], *, shuttle: bool, cfa: str = "MONO") -> RecordingSet:
    camera = _WrongShutter(seed, (), cfa=cfa, rows=96, cols=128)
    camera.wrong, camera.factor = frozenset(frames), factor
    return recordings_of(camera, Plan(("dark", "flat"), shuttle=shuttle))


PLACES = {
    "a held-out level": (range(DARKS + 12, DARKS + 15), False),
    "a seen level": (range(DARKS + 9, DARKS + 12), False),
    "one pass of a level": (range(DARKS + 22, DARKS + 24), True),  # its repeats differ
}


@pytest.mark.parametrize("factor", [1.25, 0.9, 1.03])
@pytest.mark.parametrize("place", PLACES)
def test_captures_with_a_wrong_shutter_are_found(factor: float, place: str) -> None:
    frames, shuttle = PLACES[place]
    model = measured_model(_recorded(3, factor, frames, shuttle=shuttle), measure_photon_transfer)
    (level,) = outlying_levels(model, 0, (), DecisionPolicy())
    assert level.captures == tuple(f"c{k:04d}" for k in frames)
    assert abs(level.factor - factor) < 4.0 * level.factor_std
    assert level.factor_std < 1e-3
    disagreeing = (
        *mismatches(model, model.gaussian(), DecisionPolicy()),
        *held_out_mismatches(model, (), {}, DecisionPolicy()),
    )
    assert disagreeing  # no scatter of the repeats has become a tolerance


@pytest.mark.parametrize(
    "place", ["a held-out level", *(pytest.param(p, marks=pytest.mark.slow) for p in list(PLACES)[1:])]
)
def test_a_wrong_shutter_is_told_and_not_named(place: str) -> None:
    frames, shuttle = PLACES[place]
    recordings = _recorded(3, 1.1, frames, shuttle=shuttle)
    found = verdict(recordings, measure_photon_transfer)
    assert not found.named
    assert not found.kernels  # a wrong shutter is no property of the camera
    assert located("left", found)
    (told,) = unexplained(recordings, "left", found, (Correction("photon_transfer", None, ""),), DecisionPolicy())
    (level,) = found.outlying[0]
    assert told.captures == level.captures == tuple(f"c{k:04d}" for k in frames)
    stated_s = next(c.exposure_s for c in recordings.captures() if c.id == level.captures[0])
    assert f"stated with {stated_s:.6g} s" in told.check
    assert f"{stated_s * level.factor:.6g}" in told.check


def test_a_wrong_shutter_disturbs_no_other_measurement() -> None:
    """The level pulls at the black level that darks share with it: held-out darks contradict the others for that, until
    it has a factor."""
    frames, shuttle = PLACES["a seen level"]
    model = measured_model(
        _recorded(3, 1.25, frames, shuttle=shuttle, cfa="RGGB"), measure_photon_transfer, measure_dark
    )
    policy = DecisionPolicy()
    outlying = {0: outlying_levels(model, 0, (), policy)}
    assert outlying[0]
    dark = model.blocks[1]
    assert dark in [part.block for part in held_out_mismatches(model, (), {}, policy)]
    assert not held_out_mismatches(freed(model, outlying), (), {}, policy)


def test_healthy_levels_have_no_outlier() -> None:
    for seed, shuttle in ((4, False), (5, True)):
        found = verdict(_recorded(seed, 1.0, (), shuttle=shuttle, cfa="RGGB"), measure_photon_transfer)
        assert not found.before
        assert not found.held_out
        assert not found.outlying


@pytest.mark.slow
def test_factors_of_a_wrong_shutter_have_true_uncertainties() -> None:
    """20 cameras, one level off by 10 %: (factor - truth) / std has a variance of 1 +- 3 sqrt(2 / 20), and the
    covariance has floors that these cameras lack, so that it may be less."""
    pulls = []
    for seed in range(20, 40):
        (level,) = verdict(
            _recorded(seed, 1.1, range(DARKS + 12, DARKS + 15), shuttle=False), measure_photon_transfer
        ).outlying[0]
        pulls.append((level.factor - 1.1) / level.factor_std)
    assert np.mean(np.square(pulls)) < 1.0 + 3.0 * np.sqrt(2.0 / 20)
