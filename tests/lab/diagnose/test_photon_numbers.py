"""Flats with stated photon numbers, as in EMVA 1288 descriptors, are compared with these."""

from __future__ import annotations

import numpy as np
import pytest

from lab.diagnose import diagnose
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.side_model import measurement_model
from lab.diagnose.policy import DecisionPolicy
from lab.errors import NotDetermined
from lab.fit.noise.noise_fit import fit_noise
from lab.formats.camera_model import assumptions, camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.formats.results import CameraFit, FitResult
from lab.observables.flats.linearity import measure_photon_transfer, misstated_levels
from sim.effects.base import Effect
from sim.effects.nonlinearity import Nonlinearity
from tests.lab.diagnose.on_blocks import dataset, measured_model, names, rendered, sigmas, verdict

PHOTONS_PER_S = 4.0e6
WAVELENGTH_NM = 540.0


def _by_photons(recordings: RecordingSet, *, misstated: float = 1.0, level: int = 3) -> RecordingSet:
    """The same frames; each flat states photons in place of a radiance, those of one level `misstated` times as
    many."""
    content = recordings.manifest.model_dump(mode="json")
    exposures = sorted({c["exposure_s"] for c in content["captures"] if c["kind"] == "flat"})
    for capture in content["captures"]:
        if capture["kind"] == "flat":
            factor = misstated if capture["exposure_s"] == exposures[level] else 1.0
            capture["photons_per_pixel"] = factor * PHOTONS_PER_S * capture["exposure_s"]
            capture |= {"radiance": None, "wavelength_nm": WAVELENGTH_NM}
    content["cameras"]["left"]["quantum_efficiency"] = None
    frames = {c.frame: recordings.frame(c) for c in recordings.manifest.captures}
    return RecordingSet(Manifest.model_validate(content), frames, source="photons")


def _recorded(*effects: Effect, seed: int = 3, misstated: float = 1.0) -> RecordingSet:
    return _by_photons(rendered(seed, effects), misstated=misstated)


def _fit(recordings: RecordingSet) -> FitResult:
    return FitResult(source="photons", cameras={"left": CameraFit(noise=fit_noise(recordings, "left"))})


def test_a_linear_camera_agrees_with_its_photon_numbers() -> None:
    """chi2 / n within 4 standard deviations above its mean; it may be less, as readings have a tolerance."""
    model = measured_model(_recorded(), measure_photon_transfer)
    assert len(model.value) == 24  # eight levels, three repeats
    assert sigmas(model) < 4.0
    assert not mismatches(model, model.gaussian(), DecisionPolicy())


def test_a_bent_response_is_named_from_photon_numbers() -> None:
    """3 % at full scale, which exposures alone would show, too; the photons vary with them here."""
    assert names(verdict(_recorded(Nonlinearity(quadratic_percent=-3.0)), measure_photon_transfer)) == ["nonlinearity"]


def test_photons_at_one_exposure_are_levels() -> None:
    """A lamp that is dimmed: all exposures equal, photon numbers apart."""
    recordings = _recorded()
    content = recordings.manifest.model_dump(mode="json")
    for capture in content["captures"]:
        if capture["kind"] == "flat":
            capture["exposure_s"] = 0.01
    frames = {c.frame: recordings.frame(c) for c in recordings.manifest.captures}
    dimmed = RecordingSet(Manifest.model_validate(content), frames, source="dimmed")
    model = measured_model(dimmed, measure_photon_transfer)
    assert not mismatches(model, model.gaussian(), DecisionPolicy())
    assert len({label.condition for label in model.blocks[0].labels}) == 8


def test_a_wrong_photon_number_is_told_and_moves_nothing_else() -> None:
    recordings = _recorded(misstated=1.3)
    fit = _fit(recordings)
    (level,) = misstated_levels(fit.cameras["left"])
    truth = level.light / 1.3
    assert level.expected_light == pytest.approx(truth, rel=5e-3)  # the response's law through seven levels
    model, _ = measurement_model(recordings, "left", fit)
    assert model is not None
    (block,) = (b for b in model.blocks if b.measurement.name == "photon_transfer")
    assert not {name for label in block.labels for name in label.captures} & set(level.captures)
    found = diagnose(recordings, fit)
    (told,) = found.unexplained
    assert told.captures == level.captures
    assert f"stated with {level.light:.6g} photons" in told.check
    assert f"{level.expected_light:.6g} photons" in told.check
    assert (found.verdict, found.effects, found.mismatches) == ("unexplained", (), ())


def test_flats_of_which_no_light_is_stated_are_refused() -> None:
    content = (recordings := _recorded()).manifest.model_dump(mode="json")
    for capture in content["captures"]:
        capture["photons_per_pixel"] = None
    unlit = RecordingSet(
        Manifest.model_validate(content), {c.frame: recordings.frame(c) for c in recordings.manifest.captures}
    )
    with pytest.raises(NotDetermined, match="without a radiance file or photon numbers"):
        measure_photon_transfer(dataset(unlit))


def test_the_measured_efficiency_is_the_models_at_its_wavelength() -> None:
    """K and responsivity give the quantum efficiency; the baseline's typical curve goes through it."""
    recordings = _recorded()
    fitted = _fit(recordings).cameras["left"]
    assert fitted.noise is not None
    assert fitted.noise.quantum_efficiency is not None
    model = camera_model(recordings, "left", fitted)
    at = float(np.asarray(model.quantum_efficiency["Y"].at(WAVELENGTH_NM)))
    # the curve's samples are 5 nm apart, 540 among them
    assert at == pytest.approx(fitted.noise.quantum_efficiency, rel=1e-9)
    said = {a.quantity: a.value for a in assumptions(recordings.camera("left"), fitted)}
    assert "as measured at 540 nm" in said["quantum_efficiency"]
    assert {a.quantity: a.value for a in assumptions(recordings.camera("left"))}[
        "quantum_efficiency"
    ] == "typical curves"
