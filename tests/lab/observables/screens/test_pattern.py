"""Fine structure of flat fields: green imbalance, steps between read-out taps, stripes; on cameras of the second image
former."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import (
    ColumnNoiseLaw,
    CrosstalkLaw,
    GreenImbalanceLaw,
    LightFlickerLaw,
    TapGainLaw,
    VignettingLaw,
)
from lab.diagnose.inference.decide import decide
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.observables.dataset import Dataset
from lab.observables.flats import green_balance
from lab.observables.flats.green_balance import measure_green_balance
from lab.observables.flats.images import flats
from lab.observables.flats.lines import measure_flat_lines
from lab.observables.observable import Observable
from lab.observables.spectra.narrowband import measure_narrowband


def _dataset(seed: int, laws: Sequence[Law] = (), cfa: str = "RGGB") -> Dataset:
    recordings = recordings_of(
        ConcealedCamera(seed, laws, cfa=cfa, rows=96, cols=128), Plan(("dark", "flat", "narrowband"))
    )
    return Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))


def _chi2(block: Observable) -> float:
    residual = block.value - block.predict(()).mean
    return float(residual @ np.linalg.solve(block.covariance, residual)) / len(residual)


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG", "MONO"])
def test_healthy_cameras_are_even(cfa: str) -> None:
    """chi2 of n numbers over n: 1 within 3 sqrt(2 / n) above."""
    dataset = _dataset(771011, cfa=cfa)
    blocks = (
        [measure_flat_lines(dataset)]
        if cfa == "MONO"
        else [measure_flat_lines(dataset), measure_green_balance(dataset)]
    )
    for block in blocks:
        assert _chi2(block) < 1.0 + 3.0 * np.sqrt(2.0 / len(block.value))


def test_a_mono_camera_has_no_greens() -> None:
    with pytest.raises(NotDetermined, match="mosaic"):
        measure_green_balance(_dataset(771012, cfa="MONO"))


@pytest.mark.parametrize("law", [VignettingLaw(8.0, 0, 1), LightFlickerLaw(10.0, 0, 1)], ids=lambda law: law.name)
def test_a_slope_of_the_light_is_no_green_imbalance(law: Law) -> None:
    block = measure_green_balance(_dataset(771013, (law,)))
    assert _chi2(block) < 1.0 + 3.0 * np.sqrt(2.0 / len(block.value))


def test_the_seen_image_comes_first_whichever_frames_were_read_first(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = _dataset(771013)
    levels, images = flats(dataset)
    assert set(images) == {False, True}
    found = []
    for order in ((False, True), (True, False)):
        turned = levels, {held_out: images[held_out] for held_out in order}
        monkeypatch.setattr(green_balance, "flats", lambda _, turned=turned: turned)
        found.append(measure_green_balance(dataset))
    assert found[0].labels == found[1].labels
    np.testing.assert_array_equal(found[0].covariance, found[1].covariance)


def test_unlike_greens_are_named_and_measured() -> None:
    """Concealed: 1 %, of either sign the same ratio of all levels and wavelengths."""
    dataset = _dataset(771014, (GreenImbalanceLaw(1.0),))
    verdict = decide(
        MeasurementModel((measure_green_balance(dataset),), dataset.camera), np.random.default_rng(0), DecisionPolicy()
    )
    assert [c.effect.name for c in verdict.named] == ["green_imbalance"]
    assert verdict.named[0].effect.model_dump()["imbalance_percent"] == pytest.approx(1.0, abs=0.15)


def test_crosstalk_along_rows_is_no_green_imbalance() -> None:
    """Crosstalk is half as large again along rows: greens differ by wavelength, as their neighbours do. 0.5 % and 0.75
    % are 0.625 % +- 20 %."""
    dataset = _dataset(771015, (CrosstalkLaw(0.5, 2),))
    blocks = (measure_green_balance(dataset), measure_narrowband(dataset))
    verdict = decide(MeasurementModel(blocks, dataset.camera), np.random.default_rng(0), DecisionPolicy())
    assert [c.effect.name for c in verdict.named] == ["crosstalk"]
    found = verdict.named[0].effect.model_dump()
    assert found["share_percent"] == pytest.approx(0.625, rel=0.1)
    assert found["row_excess"] == pytest.approx(0.2, abs=0.06)


def test_a_tap_gain_is_a_step_in_the_middle_and_is_named() -> None:
    dataset = _dataset(771016, (TapGainLaw(1.0),))
    block = measure_flat_lines(dataset)
    model = MeasurementModel((block,), dataset.camera)
    assert mismatches(model, model.gaussian(), DecisionPolicy())
    steps = {label.condition: v for label, v in zip(block.labels, block.value, strict=True) if not label.held_out}
    # 1 % within 3 sigma of 0.8 % PRNU over 8 columns of 96 pixels a side, with a slope fitted: 0.2 %
    assert steps["column 64"] == pytest.approx(0.01, abs=0.003)
    (named,) = decide(model, np.random.default_rng(0), DecisionPolicy()).named
    assert named.effect.name == "taps"
    assert named.std["gain_percent"] is not None
    assert named.effect.gain_percent == pytest.approx(1.0, abs=4.0 * named.std["gain_percent"])  # type: ignore[attr-defined]


def test_white_columns_are_no_steps() -> None:
    """Steps are judged by the scatter of the columns, which fixed column offsets widen."""
    model = MeasurementModel(
        (measure_flat_lines(dataset := _dataset(771017, (ColumnNoiseLaw(1.0, 0),))),), dataset.camera
    )
    assert not mismatches(model, model.gaussian(), DecisionPolicy())
