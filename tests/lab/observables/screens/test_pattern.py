"""Fine structure of flat fields: green imbalance, steps between read-out taps, stripes; on cameras of the second image
former."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from lab.challenge.draw import recordings_of
from lab.diagnose.inference.decide import decide
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.observables.dataset import Study
from lab.observables.flats import green_balance
from lab.observables.flats.field import flats, line_block
from lab.observables.flats.green_balance import green_block
from lab.observables.observable import Block
from lab.observables.spectra.narrowband import narrowband_block
from mocks.former import ConcealedCamera, Law, Plan
from mocks.former.laws import (
    ColumnNoiseLaw,
    CrosstalkLaw,
    GreenImbalanceLaw,
    LightFlickerLaw,
    TapGainLaw,
    VignettingLaw,
)


def _study(seed: int, laws: Sequence[Law] = (), cfa: str = "RGGB") -> Study:
    recordings = recordings_of(
        ConcealedCamera(seed, laws, cfa=cfa, rows=96, cols=128), Plan(("dark", "flat", "narrowband"))
    )
    return Study(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))


def _chi2(block: Block) -> float:
    residual = block.value - block.predict(()).mean
    return float(residual @ np.linalg.solve(block.covariance, residual)) / len(residual)


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG", "MONO"])
def test_healthy_cameras_are_even(cfa: str) -> None:
    """chi2 of n numbers over n: 1 within 3 sqrt(2 / n) above."""
    study = _study(771011, cfa=cfa)
    blocks = [line_block(study)] if cfa == "MONO" else [line_block(study), green_block(study)]
    for block in blocks:
        assert _chi2(block) < 1.0 + 3.0 * np.sqrt(2.0 / len(block.value))


def test_a_mono_camera_has_no_greens() -> None:
    with pytest.raises(NotDetermined, match="mosaic"):
        green_block(_study(771012, cfa="MONO"))


@pytest.mark.parametrize("law", [VignettingLaw(8.0, 0, 1), LightFlickerLaw(10.0, 0, 1)], ids=lambda law: law.name)
def test_a_slope_of_the_light_is_no_green_imbalance(law: Law) -> None:
    block = green_block(_study(771013, (law,)))
    assert _chi2(block) < 1.0 + 3.0 * np.sqrt(2.0 / len(block.value))


def test_the_seen_image_comes_first_whichever_frames_were_read_first(monkeypatch: pytest.MonkeyPatch) -> None:
    study = _study(771013)
    levels, images = flats(study)
    assert set(images) == {False, True}
    found = []
    for order in ((False, True), (True, False)):
        turned = levels, {held_out: images[held_out] for held_out in order}
        monkeypatch.setattr(green_balance, "flats", lambda _, turned=turned: turned)
        found.append(green_block(study))
    assert found[0].labels == found[1].labels
    np.testing.assert_array_equal(found[0].covariance, found[1].covariance)


def test_unlike_greens_are_named_and_measured() -> None:
    """Concealed: 1 %, of either sign the same ratio of all levels and wavelengths."""
    study = _study(771014, (GreenImbalanceLaw(1.0),))
    verdict = decide(MeasurementModel((green_block(study),), study.camera), np.random.default_rng(0), DecisionPolicy())
    assert [c.effect.name for c in verdict.named] == ["green_imbalance"]
    assert verdict.named[0].effect.model_dump()["imbalance_percent"] == pytest.approx(1.0, abs=0.15)


def test_crosstalk_along_rows_is_no_green_imbalance() -> None:
    """Crosstalk is half as large again along rows: greens differ by wavelength, as their neighbours do. 0.5 % and 0.75
    % are 0.625 % +- 20 %."""
    study = _study(771015, (CrosstalkLaw(0.5, 2),))
    blocks = (green_block(study), narrowband_block(study))
    verdict = decide(MeasurementModel(blocks, study.camera), np.random.default_rng(0), DecisionPolicy())
    assert [c.effect.name for c in verdict.named] == ["crosstalk"]
    found = verdict.named[0].effect.model_dump()
    assert found["share_percent"] == pytest.approx(0.625, rel=0.1)
    assert found["row_excess"] == pytest.approx(0.2, abs=0.06)


def test_a_tap_gain_is_a_step_in_the_middle_and_is_named() -> None:
    study = _study(771016, (TapGainLaw(1.0),))
    block = line_block(study)
    model = MeasurementModel((block,), study.camera)
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
    model = MeasurementModel((line_block(study := _study(771017, (ColumnNoiseLaw(1.0, 0),))),), study.camera)
    assert not mismatches(model, model.gaussian(), DecisionPolicy())
