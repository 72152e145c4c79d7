"""Deferred charge in overscan, and the level of margins over time: what is drawn is predicted, nothing is seen where
nothing is, and numbers scatter as their covariance says."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from lab.diagnose import diagnose
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.observables.margins.deferred_charge import measure_overscan_charge
from lab.observables.margins.level import measure_margin_level
from sim.camera import Cfa
from sim.effects.base import Effect
from sim.effects.black_level_drift import BlackLevelDrift
from sim.effects.charge_transfer_inefficiency import ChargeTransferInefficiency
from sim.sensor.margins import Margins
from tests.lab.diagnose.on_blocks import dataset, measured_model, rendered, sigmas

MARGINS = Margins(masked_rows=(4, 0), masked_cols=(4, 0), overscan_rows=(2, 12), overscan_cols=(0, 12))
FAST = ChargeTransferInefficiency(parallel_ppm=100.0, release_px=0.2)
SLOW = ChargeTransferInefficiency(serial_ppm=60.0, serial_release_px=4.0, first_column="left")
DRIFT = BlackLevelDrift(drift_dn_per_min=0.2)


@cache
def _recorded(*effects: Effect, seed: int = 5, cfa: Cfa = "MONO") -> RecordingSet:
    return rendered(seed, effects, margins=MARGINS, cfa=cfa)


def test_the_first_line_holds_loss_times_transfers_of_the_signal() -> None:
    """Of a fast trap, in even light: 1e-4 x 96 transfers = 0.96 % in the first row, exp(-1 / 0.2) = 0.7 % of that in
    the second, and nothing in columns. Terms of second order: 0.96 % of that."""
    block = measured_model(_recorded(FAST), measure_overscan_charge).blocks[0]
    std = np.sqrt(np.diag(block.covariance))
    first = [k for k, one in enumerate(block.labels) if one.condition == "rows behind the last" and one.x == 1.0]
    assert len(first) == 2  # seen and held out
    np.testing.assert_allclose(block.value[first], 0.0096, atol=4.0 * std[first].max() + 0.0096**2)
    assert std[first].max() < 0.0096 / 20.0
    others = [k for k, one in enumerate(block.labels) if one.condition != "rows behind the last" or one.x > 2.0]
    # the largest of 20 numbers is below 4 standard deviations
    assert np.max(np.abs(block.value[others] / std[others])) < 4.0


@pytest.mark.parametrize(("effect", "cfa"), [(FAST, "MONO"), (SLOW, "MONO"), (SLOW, "RGGB"), (FAST, "GBRG")])
def test_deferred_charge_is_predicted(effect: Effect, cfa: Cfa) -> None:
    """Chi2 within four of its standard deviations; without the effect far off."""
    model = measured_model(_recorded(effect, cfa=cfa), measure_overscan_charge)
    assert abs(sigmas(model, (effect,))) < 4.0
    assert sigmas(model) > 20.0


def test_nothing_is_deferred_without_traps() -> None:
    model = measured_model(_recorded(), measure_overscan_charge, measure_margin_level)
    assert abs(sigmas(model)) < 4.0
    assert set(model.blocks[0].labels[0].captures) <= {c.id for c in _recorded().captures()}


def test_pulls_have_a_standard_deviation_of_1() -> None:
    """Chi2 over 8 sets of n numbers: its mean is n within three of its standard deviations, sqrt(2 / 8 n) relative,
    and 5 % more for the scatter that is estimated from the frames themselves."""
    found = {measure_overscan_charge: [], measure_margin_level: []}  # type: ignore[var-annotated]
    for seed in range(30, 38):
        for make, ratios in found.items():
            model = measured_model(_recorded(seed=seed), make)
            gaussian = model.gaussian(())
            away = model.value - gaussian.mean
            ratios.append((float(away @ np.linalg.solve(gaussian.covariance, away)), len(away)))
    for ratios in found.values():
        total, count = (sum(column) for column in zip(*ratios, strict=True))
        assert total / count == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / count) + 0.05)


def test_the_black_level_drifts_in_margins_as_in_dark_frames() -> None:
    model = measured_model(_recorded(DRIFT), measure_margin_level)
    assert abs(sigmas(model, (DRIFT,))) < 4.0
    assert sigmas(model) > 20.0
    assert {label.condition for label in model.blocks[0].labels} == {"overscan", "masked pixels"}


def test_frames_without_margins_have_none_of_it() -> None:
    plain = dataset(rendered(5))
    for make in (measure_overscan_charge, measure_margin_level):
        with pytest.raises(NotDetermined, match="states no margins"):
            make(plain)


@pytest.mark.extra  # whole diagnoses
@pytest.mark.parametrize(
    ("effect", "parameter"),
    [
        (None, ""),
        (ChargeTransferInefficiency(parallel_ppm=60.0, release_px=1.5), "parallel_ppm"),
        (BlackLevelDrift(drift_dn_per_min=0.15), "drift_dn_per_min"),
    ],
)
def test_a_diagnosis_sizes_what_margins_show_and_nothing_else(effect: Effect | None, parameter: str) -> None:
    """Within three of the standard deviations that are reported; no second name, and none of a nominal camera."""
    found = diagnose(_recorded(*([] if effect is None else [effect]), seed=11), at_once=False)
    if effect is None:
        assert (found.verdict, found.effects) == ("no_mismatch", ())
        return
    (named,) = found.effects
    estimate = named.parameters[parameter]
    assert named.name == effect.name
    assert estimate.std is not None
    assert estimate.value == pytest.approx(getattr(effect, parameter), abs=3.0 * estimate.std)
