"""The improved model: written, read, taken as the baseline, and simulated with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from evaluation.independent_simulator import laws as concealed_laws
from lab.diagnose import Diagnosis, examine
from lab.diagnose.inference.discrepancy import likeliest_discrepancy
from lab.diagnose.inference.measurement_model import MeasurementModel, form_name
from lab.diagnose.outcome.corrections import nearest_form
from lab.diagnose.outcome.improved_model import improved_model
from lab.diagnose.outcome.residual_pictures import residual_pictures
from lab.diagnose.policy import DecisionPolicy
from lab.formats.camera_file import CameraFile, default_camera, read_camera, write_camera
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.gaussian import chi2
from lab.observables.observable import Label, Observable, Prediction
from lab.predict.simulate import SimulateOptions, simulate
from sim.effects.base import Effect
from sim.effects.model_discrepancy import ModelDiscrepancy
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from sim.point import TRANSFER, Blur
from sim.uniform import Uniform
from tests.lab.diagnose.on_blocks import declared
from tests.lab.diagnose.outcome.filtered_edges import filtered_edges

SET = RecordingSet(
    Manifest.model_validate(
        {"cameras": {"left": {"rows": 8, "cols": 8, "cfa": "MONO", "bit_depth": 12}}, "captures": []}
    )
)
KINDS = ("dark", "flat", "narrowband", "slanted_edge")


def _found(seed: int, law: concealed_laws.Law) -> tuple[RecordingSet, Diagnosis]:
    recordings = recordings_of(ConcealedCamera(seed, [law], cfa="MONO", f_number=4.0, rows=240, cols=240), Plan(KINDS))
    return recordings, examine(recordings)


@pytest.fixture(scope="module")
def filtered() -> tuple[RecordingSet, Diagnosis]:
    return _found(20731, concealed_laws.InfraredCutFilterLaw(60.0))


def _through_a_file(content: CameraFile, folder: Path) -> CameraFile:
    write_camera(folder / "camera.toml", content)
    return read_camera(folder / "camera.toml")


def test_a_saved_model_explains_the_recordings(filtered: tuple[RecordingSet, Diagnosis], tmp_path: Path) -> None:
    recordings, found = filtered
    assert [e.name for e in found.result.effects] == ["infrared_cut_filter"]
    saved = _through_a_file(found.improved["left"], tmp_path)
    assert [e.name for e in saved.effects] == ["infrared_cut_filter"]
    again = examine(recordings, baseline={"left": saved})
    assert again.result.verdict == "no_mismatch"
    assert again.improved["left"].effects == saved.effects


def test_a_saved_model_simulates_with_the_named_effect(
    filtered: tuple[RecordingSet, Diagnosis], tmp_path: Path
) -> None:
    """Red light through the saved camera is dimmer by the loss of the filter that was found."""
    saved = _through_a_file(filtered[1].improved["left"], tmp_path)
    light = tmp_path / "red.csv"
    light.write_text("wavelength_nm,radiance_w_sr_m2_nm\n690,0\n695,0.05\n700,0\n", encoding="utf-8")
    options = SimulateOptions(scene="uniform", illuminant=str(light), exposure_s=0.01, expected=True)
    with_it, without = (
        float(simulate(options, content).frame.mean()) - saved.camera.black_level_dn
        for content in (saved, replace(saved, effects=()))
    )
    passed = float(Uniform(saved.camera, saved.effects).transmittance(np.array([695.0]))[0])
    assert without > 50.0
    assert with_it == pytest.approx(passed * without, rel=0.05, abs=1.0)  # codes are whole numbers; a line 5 nm wide


# --- what has no name -------------------------------------------------------------------------------------------------

FREQUENCY = np.linspace(0.02, 0.9, 23)
NOISE = 0.004


def _edges(departs: np.ndarray) -> tuple[Observable, CameraFile]:
    """Contrasts exp(-2 f) of two channels, off by `departs`; a model without effects, with corrections only."""
    content = default_camera()
    labels = tuple(Label(float(f), c, "5 deg", ("edge-1",), False) for c in "RG" for f in FREQUENCY)
    contrast = np.tile(np.exp(-2.0 * FREQUENCY), 2)

    def predict(acting: Sequence[Effect]) -> Prediction:
        factor = Blur(content.camera, acting).beside_lens(550.0, np.tile(FREQUENCY, 2), np.zeros(46))
        return Prediction(contrast * np.real(factor), {})

    value = contrast * np.tile(1.0 + departs, 2) + NOISE * np.random.default_rng(3).standard_normal(46)
    block = Observable(
        measurement=declared("slanted_edge", "spatial_frequency", "cy/px", conditions="orientation"), reach=0.2,
        value=value, covariance=NOISE**2 * np.eye(46),
        labels=labels, reads=TRANSFER, predict=predict, scale=np.ones(46),
    )  # fmt: skip
    return block, content


def test_a_mismatch_without_a_name_is_saved_as_a_correction() -> None:
    """A ripple of 10 % of the contrast: the saved correction follows it within the noise 0.004 / exp(-2 f) of 46
    points, and the model with it explains the numbers."""
    ripple = 0.1 * np.sin(9.0 * FREQUENCY)
    block, content = _edges(ripple)
    model = MeasurementModel((block,), content.camera)
    gap = likeliest_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy())
    improved, corrections = improved_model(SET, "left", None, content, model, (), (gap,))
    assert [(c.measurement, c.kind) for c in corrections] == [("slanted_edge", "transfer")]
    (one,) = improved.effects
    assert isinstance(one, ModelDiscrepancy)
    follows = np.real(Blur(content.camera, (one,)).beside_lens(550.0, FREQUENCY, 0 * FREQUENCY)) - 1.0 - ripple
    assert np.abs(follows[FREQUENCY < 0.6]).max() < 3 * NOISE / np.sqrt(2) / np.exp(-1.2)
    mended = MeasurementModel((replace(block, predict=lambda acting: block.predict((one, *acting))),), content.camera)
    assert chi2(mended.value - mended.mean(), block.covariance) < 46 + 3 * np.sqrt(92)


def test_a_discrepancy_that_the_model_cannot_hold_is_reported() -> None:
    block, content = _edges(0.1 * np.sin(9.0 * FREQUENCY))
    model = MeasurementModel(
        (replace(block, measurement=replace(block.measurement, title="patches of light", places="patches")),),
        content.camera,
    )
    gap = likeliest_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy())
    improved, corrections = improved_model(SET, "left", None, content, model, (), (gap,))
    assert not improved.effects
    assert corrections[0].kind is None
    assert (
        corrections[0].said
        == "patches of light: no correction in the improved model; the model has no place for one there"
    )


@pytest.mark.parametrize(
    ("axis", "unit", "quantity", "along"),
    [("field", "mm", "image.shading", "radius_um"), ("level", "DN", "signal.response", "signal_e"), ("level", "DN",
    "charge.variance_e2", "variance_signal_e")],
)  # fmt: skip
def test_a_correction_acts_on_the_stage_of_its_measurement(axis: str, unit: str, quantity: str, along: str) -> None:
    block, content = _edges(0.1 * np.sin(9.0 * FREQUENCY))
    other = replace(block, measurement=declared("other", axis, unit), reads=frozenset({quantity}))
    model = MeasurementModel((other,), content.camera)
    gap = likeliest_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy())
    improved, _ = improved_model(SET, "left", None, content, model, (), (gap,))
    assert [e.along for e in improved.effects if isinstance(e, ModelDiscrepancy)] == [along]


def test_the_form_that_the_recordings_show_is_saved() -> None:
    """Of a filter's forms, quartz's dispersion at 0.9 of its strength; neither at 0.3."""
    plain = OpticalLowPassFilter(displacement_x_um=2.0)
    assert nearest_form(plain, {form_name(plain, 0): 0.9, form_name(plain, 1): 0.2}).plate == "quartz"  # type: ignore[attr-defined]
    assert nearest_form(plain, {form_name(plain, 0): 0.3}) == plain


# --- Residual pictures of recordings: structure without the effect in the model, noise with it ------------------------


def test_pictures_show_what_the_model_lacks_and_noise_once_it_has_it() -> None:
    """Cells' residuals of a right model are normal, of rms 1; the sensor's own patterns differ from their mean standard
    deviation by some per cent."""
    law = concealed_laws.OpticalLowPassFilterLaw(1.8)
    camera = ConcealedCamera(20771, [law], cfa="MONO", f_number=4.0, rows=160, cols=200)
    recordings = recordings_of(camera, Plan(("flat", "slanted_edge")))
    model = camera_model(recordings, "left").model_copy(
        update={"black_level_dn": camera.black_level_dn, "conversion_gain_dn_per_e": camera.gain_dn_per_e,
        "read_noise_e": camera.read_noise_e,
                "prnu_percent": camera.prnu_percent, "dark_current_e_per_s": camera.dark_e_per_s,
                "full_well_e": camera.full_well_e}
    )  # fmt: skip
    known = CameraFile("known", model, (OpticalLowPassFilter(displacement_x_um=1.8, displacement_y_um=1.8),))
    found = {p.kind: p for p in residual_pictures(recordings, "left", filtered_edges().model, known)}
    assert set(found) == {"flat", "slanted_edge"}

    def rms(table: tuple[tuple[float, ...], ...]) -> float:
        return float(np.sqrt(np.mean(np.square(table))))

    edge = found["slanted_edge"]
    # where the edge lies is known to some hundredths of a pixel only: it keeps a thin trace
    assert rms(edge.after) < 1.4
    assert rms(edge.before) > rms(edge.after) + 0.1
    assert rms(found["flat"].after) == pytest.approx(1.0, abs=0.15)
