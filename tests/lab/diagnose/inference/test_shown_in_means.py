"""A cause that must show in means isn't told from variances alone."""

from __future__ import annotations

from functools import cache

from lab.diagnose import diagnose
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.shown_in_means import is_judged_in_means, must_show_in_means, shown_in_means
from lab.diagnose.inference.side_model import measurement_model
from lab.diagnose.outcome.corrections import Correction
from lab.diagnose.outcome.mismatches import unexplained
from lab.diagnose.policy import DecisionPolicy
from lab.fit.noise.noise_fit import fit_noise
from lab.formats.recording_set import Manifest, RecordingSet
from lab.formats.results import CameraFit, FitResult
from lab.observables.flats.linearity import measure_photon_transfer
from lab.observables.flats.noise import measure_noise
from lab.observables.noise.neighbours import measure_noise_neighbours
from sim.effects.adc_step import AdcStep
from sim.effects.brighter_fatter import BrighterFatter
from sim.effects.inter_pixel_capacitance import InterPixelCapacitance
from sim.effects.nonlinearity import Nonlinearity
from sim.effects.row_noise import RowNoise
from tests.lab.diagnose.metadata.lies import restated
from tests.lab.diagnose.on_blocks import dataset, measured_model, names, rendered, verdict

BEND = Nonlinearity(quadratic_percent=-10.0)


@cache
def _bent() -> RecordingSet:
    return rendered(3, (BEND,))


def test_which_effects_must_show_in_means_follows_from_what_they_change() -> None:
    """A response and a converter change levels and variances alike; charge that repels charge changes variances
    alone."""
    model = measured_model(_bent(), measure_noise, measure_noise_neighbours)
    must = {
        kind
        for kind in (Nonlinearity, AdcStep, BrighterFatter, InterPixelCapacitance, RowNoise)
        if must_show_in_means(model, kind)
    }
    assert must == {Nonlinearity, AdcStep}


def test_a_bend_that_variances_alone_show_is_no_name() -> None:
    """Its means show it as well, where they are judged."""
    found = verdict(_bent(), measure_noise)
    assert not found.named
    assert [c.effect.name for c in found.abstained] == ["nonlinearity"]
    (told,) = unexplained(_bent(), "left", found, (Correction("noise", None, ""),), DecisionPolicy())
    assert "nonlinearity, which has to show in mean levels, and no light of theirs is stated" in told.shape
    assert names(verdict(_bent(), measure_noise, measure_photon_transfer)) == ["nonlinearity"]


def test_means_of_a_straight_response_contradict_a_bend() -> None:
    """Variances of a bent camera, means of a straight one."""
    bent, straight = dataset(_bent()), dataset(rendered(3))
    policy = DecisionPolicy()
    both = MeasurementModel((measure_noise(bent), measure_photon_transfer(bent)), bent.camera)
    assert shown_in_means(both, BEND, (BEND,), (), policy)
    against = MeasurementModel((measure_noise(bent), measure_photon_transfer(straight)), bent.camera)
    assert is_judged_in_means(against, Nonlinearity)
    assert not shown_in_means(against, BEND, (BEND,), (), policy)
    assert not shown_in_means(MeasurementModel((measure_noise(bent),), bent.camera), BEND, (BEND,), (), policy)


def test_an_exposure_typed_ten_times_too_long_is_told_where_no_light_is_stated() -> None:
    """Levels without a radiance aren't judged by the diagnosis; the noise fit judges them by their exposures."""
    recordings = rendered(4)
    content = recordings.manifest.model_dump(mode="json")
    exposures = sorted({c["exposure_s"] for c in content["captures"] if c["kind"] == "flat"})
    wrong = [c for c in content["captures"] if c["kind"] == "flat" and c["exposure_s"] == exposures[3]]
    for capture in content["captures"]:
        if capture["kind"] == "flat":
            capture["radiance"] = None
    for capture in wrong:
        capture["exposure_s"] *= 10.0
    content["cameras"]["left"]["quantum_efficiency"] = None
    typed = RecordingSet(
        Manifest.model_validate(content), {c.frame: recordings.frame(c) for c in recordings.manifest.captures}
    )
    fit = FitResult(source="typed", cameras={"left": CameraFit(noise=fit_noise(typed, "left"))})
    found = diagnose(typed, fit)
    assert found.effects == ()
    (told,) = found.unexplained
    assert set(told.captures) == {c["id"] for c in wrong}
    assert f"stated with {10.0 * exposures[3]:.6g} s" in told.check
    # the response's law through seven levels gives the level's exposure to some thousandths
    fits_s = float(told.check.split("have this level at ")[1].split(" s")[0])
    assert abs(fits_s / exposures[3] - 1.0) < 0.01


def test_what_refers_to_full_well_is_told_to_be_extrapolated() -> None:
    """12-bit data called 16 bits reach 6 % of the range."""
    recordings = rendered(3)
    for bit_depth, white_dn, lines in ((12, 4095.0, 0), (16, 65535.0, 1)):
        called = restated(recordings, bit_depth=bit_depth, white_level_dn=white_dn)
        _, skipped = measurement_model(called, "left")
        found = [s.reason for s in skipped if s.step == "diagnose full_well_e"]
        assert len(found) == lines
        assert all("reaches 5." in reason for reason in found)
