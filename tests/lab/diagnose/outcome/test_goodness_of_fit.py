"""Places and measurements: chi2 before and after, on made-up edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from evaluation.independent_simulator.laws import RowNoiseLaw
from lab.diagnose import diagnose
from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.search import Model, ModelSet
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.outcome.detectability import detectable, told_as
from lab.diagnose.outcome.goodness_of_fit import (
    detectability,
    measurement_fits,
    places,
    residual_curves,
    set_sentences,
    side_models,
)
from lab.diagnose.policy import DecisionPolicy
from lab.formats.recording_set import RecordingSet
from lab.formats.results import NamedEffect, Rival, SideModels, Unexplained, Visibility
from lab.observables.flats.linearity import measure_photon_transfer
from lab.observables.observable import Prediction
from lab.observables.spectra.narrowband import measure_narrowband
from lab.report.diagnosis import _visibility
from sim.effects.amplifier_glow import AmplifierGlow
from sim.effects.defocus import Defocus
from sim.effects.infrared_cut_filter import InfraredCutFilter
from sim.effects.row_noise import RowNoise
from tests.lab.diagnose.metadata.lies import restated
from tests.lab.diagnose.on_blocks import former, measured_model, rendered
from tests.lab.diagnose.outcome.filtered_edges import NOISE, TRUTH, filtered_edges


def test_measurements_fit_with_the_truth_and_not_without() -> None:
    (fit,) = measurement_fits("left", filtered_edges((TRUTH,)))
    model = filtered_edges().model
    assert (fit.n, fit.held_out_n) == (36, 36)
    assert fit.held_out_before == pytest.approx(model.held_out()[0])
    assert fit.held_out_after == pytest.approx(model.held_out((TRUTH,))[0])
    assert fit.chi2_after < stats.chi2.ppf(0.999, 36) < fit.chi2_before


def test_every_place_has_its_chi2_before_and_after() -> None:
    found = list(places("left", filtered_edges((TRUTH,)), DecisionPolicy()))
    assert {p.axis for p in found} == {"spatial_frequency", "orientation"}
    assert max(p.sigma_before for p in found) > 5.0
    assert max(p.sigma_after for p in found) < 3.0
    assert all(p.chi2_after < p.chi2_before for p in found)


def test_the_baseline_is_drawn_as_a_camera_without_the_effect() -> None:
    """Each line is exposed to 0.7 of the full well of a camera without the filter: 2772 DN above 128 DN. The filter
    cuts the light from 600 nm on, and the level falls; the baseline's curve stays. (The baseline's own fit would follow
    the filter with its nuisance parameters.)"""
    truth = InfraredCutFilter(cut_wavelength_nm=600.0, width_nm=5.0)
    model = measured_model(
        rendered(6, (truth,), sweep_to_nm=720, repeats=2), measure_photon_transfer, measure_narrowband
    )
    assert np.ptp(model.fitted_mean()[model.slices[1]]) > 2000.0
    named = Verdict(model, 12.0, 60.0, (), (Candidate(truth, {}, 1.0, (), 100.0),), (), (), ())
    curves = [curve for curve in residual_curves("left", named) if curve.measurement == "narrowband"]
    measured, before, after = (np.concatenate([getattr(c, f) for c in curves]) for f in ("measured", "before", "after"))
    assert measured.min() < 200.0
    # noise of a level and the reading of its light (0.3 %) leave the rate of a line open by less than a per cent
    np.testing.assert_allclose(before, 128.0 + 2772.0, rtol=0.03)
    np.testing.assert_allclose(after, measured, rtol=0.02)
    assert {curve.quantity for curve in curves} == {"mean level, DN"}


@pytest.mark.parametrize(("is_level", "drawn"), [(True, (0.0, 4095.0)), (False, (-20.0, 9000.0))])
def test_levels_that_the_baseline_has_end_where_a_camera_s_do(is_level: bool, drawn: tuple[float, float]) -> None:
    found = filtered_edges()
    (edges,) = found.model.blocks
    levels = replace(
        edges,
        measurement=replace(edges.measurement, is_level=is_level),
        predict=lambda _: Prediction(np.resize([-20.0, 9000.0], len(edges.value)), {}),
    )
    assert found.model.camera.white_level_dn == 4095.0
    for curve in residual_curves("left", replace(found, model=MeasurementModel((levels,), found.model.camera))):
        assert (min(curve.before), max(curve.before)) == drawn


# --- Sizes from which effects can be detected, and told apart ---------------------------------------------------------


def test_a_detectable_size_is_detected_at_the_stated_rate() -> None:
    """200 000 draws of a squared normal: 3 sigma of the rate are 0.002."""
    size = np.sqrt(detectable(12.0))
    score = np.square(np.random.default_rng(1).standard_normal(200_000) + size)
    assert np.mean(score > 12.0) == pytest.approx(0.9, abs=0.002)


def test_the_detectable_size_has_the_stated_non_centrality() -> None:
    """The change by the effect at that size, whitened: lambda to 5 %, as blurs bend a little beyond the slope at
    zero."""
    verdict = filtered_edges()
    found = {item.effect: item for item in detectability("left", verdict, DecisionPolicy())}
    size = found["defocus"].smallest["defocus_um"]
    model = verdict.model
    change = (model.mean((Defocus(defocus_um=size),)) - model.mean())[model.seen] / NOISE
    assert float(change @ change) == pytest.approx(detectable(12.0), rel=0.05)
    assert 0.9 < found["defocus"].cosine <= 1.0  # all blurs are alike in so few numbers
    assert found["defocus"].told_apart == pytest.approx(
        stats.norm.cdf(0.5 * np.sqrt(detectable(12.0) * (1.0 - found["defocus"].cosine ** 2)))
    )


# --- The sets of effects in a result, and when there are none ---------------------------------------------------------


POLICY = DecisionPolicy()


def _named(name: str, *rivals: str) -> NamedEffect:
    return NamedEffect(
        name=name, family="contrast_loss", law="exact", probability=0.7, sides=("left",), parameters={}, statement="",
        rivals=tuple(Rival(name=r, probability=0.3) for r in rivals),
    )  # fmt: skip


def _models(*sets: tuple[Sequence[str], float], left: Sequence[tuple[str, ...]] = ()) -> SideModels:
    found = ModelSet(tuple(Model(tuple(e), p) for e, p in sets), (("defocus", 1.0),), tuple(left))
    return side_models("left", found, POLICY)


def _told(models: SideModels, *effects: NamedEffect, left: Sequence[Unexplained] = ()) -> str:
    return " ".join(set_sentences([models], effects, left, POLICY))


def test_sets_are_reported_where_they_hold_an_effect_without_a_name() -> None:
    both = _models((["defocus"], 0.67), (["defocus", "coma"], 0.3))
    assert "defocus (67 %), defocus with coma (30 %)." in _told(both, _named("defocus"))
    assert _told(_models((["defocus"], 0.97)), _named("defocus")) == ""
    rivals = _models((["defocus"], 0.67), (["coma"], 0.3))
    assert _told(rivals, _named("defocus", "coma")) == ""  # said of the name already
    unlikely = _models((["defocus"], 0.91), (["defocus", "coma"], 0.03), (["defocus", "ghost"], 0.02))
    assert _told(unlikely, _named("defocus")) == ""
    left = Unexplained(
        side="left", measurement="slanted_edge", axis="spatial_frequency", where="all", shape="irregular",
        significance_sigma=9.0,
        chi2_before=300.0, chi2_after=290.0, n=60,
    )  # fmt: skip
    assert _told(both, _named("defocus"), left=[left]) == ""  # an unlisted cause is there
    assert _told(both) == ""  # nothing is named: what else it is was weighed, too


def test_sets_that_the_budget_left_out_are_listed() -> None:
    left = [("ghost",), ("ghost", "coma"), ("a",), ("b",), ("c",), ("d",), ("e",)]
    told = _told(_models((["defocus"], 0.97), left=left), _named("defocus"))
    assert "120 s of CPU time were spent" in told
    assert "Not weighed: ghost; ghost with coma; a; b; c; and 2 more" in told


# --- Without a known conversion gain nothing is told in electrons: figures are in DN ----------------------------------


def test_only_electrons_are_told_in_dn() -> None:
    glow, rows = AmplifierGlow.quantities(), RowNoise.quantities()
    assert told_as("glow_e_per_s", glow["glow_e_per_s"], gain_is_known=False) == ("glow_dn_per_s", "DN/s")
    assert told_as("noise_e", rows["noise_e"], gain_is_known=False) == ("noise_dn", "DN")
    assert told_as("noise_e", rows["noise_e"], gain_is_known=True) == ("noise_e", "e")
    assert told_as("correlation", rows["correlation"], gain_is_known=False) == ("correlation", "1")


def _darks() -> RecordingSet:
    return former(5, RowNoiseLaw(RowNoiseLaw.nominal, 0), kinds=("dark",))


def test_dark_frames_of_a_camera_of_unknown_gain_have_row_noise_in_dn() -> None:
    """The same frames with and without a stated gain: the figures differ by it."""
    recordings = _darks()
    gain = 0.5
    with_gain, without = (
        diagnose(restated(recordings, conversion_gain_dn_per_e=value, read_noise_e=None)) for value in (gain, None)
    )
    (known,), (unknown,) = with_gain.effects, without.effects
    assert (known.name, unknown.name) == ("row_noise", "row_noise")
    in_e, in_dn = known.parameters["noise_e"], unknown.parameters["noise_dn"]
    assert (in_e.unit, in_dn.unit) == ("e", "DN")
    # the priors of sizes are in electrons: they move the estimate by less than its standard deviation
    assert abs(in_dn.value - gain * in_e.value) < in_dn.std
    assert f"{in_dn.std:.3f} DN" in unknown.statement
    assert " e," not in unknown.statement
    assert any(s.step == "diagnose conversion_gain_dn_per_e" and "in DN" in s.reason for s in without.skipped)
    assert not any(s.step == "diagnose conversion_gain_dn_per_e" for s in with_gain.skipped)
    sizes = {field for item in without.visibility for field in item.smallest}
    assert not any(field.endswith("_e") or "_e_per_s" in field for field in sizes)


def test_the_table_of_detectable_sizes_has_their_units() -> None:
    for field, unit in (("rate_dn_per_s", "DN/s"), ("rate_e_per_s", "e/s")):
        item = Visibility(
            side="left", effect="ambient_light", smallest={field: 2.0}, nearest=None, cosine=0.0, told_apart=1.0
        )
        assert _visibility([item])["ambient_light"]["left"].smallest.endswith(f"2 {unit}")
