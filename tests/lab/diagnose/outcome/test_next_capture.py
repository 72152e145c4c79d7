"""The next capture: distances are as predicted, the best one comes first, and a station takes it where it can."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import norm

from lab.capture.plan import CapturePlan
from lab.capture.station import Station
from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.outcome.candidate_captures import CandidateCapture, Hypothesis, candidate_captures
from lab.diagnose.outcome.next_capture import next_sentence
from lab.diagnose.outcome.rivals_in_doubt import doubt_of
from lab.diagnose.outcome.settling_capture import settling_sentence
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.visibility import visibility
from lab.errors import InputError
from lab.formats.camera_file import default_camera
from lab.formats.recording_set import Manifest, RecordingSet
from lab.formats.results import NextCapture, Unexplained
from lab.observables.observable import Label, Observable, Prediction
from sim.effects.astigmatism import Astigmatism
from sim.effects.base import Effect
from sim.effects.black_level_drift import BlackLevelDrift
from sim.effects.exposure_offset import ExposureOffset
from sim.effects.infrared_cut_filter import InfraredCutFilter
from sim.effects.library import effect
from sim.effects.nonlinearity import Nonlinearity
from sim.effects.source_drift import SourceDrift
from sim.point import TRANSFER, Blur
from tests.lab import fake_bench
from tests.lab.diagnose.on_blocks import declared

CAMERA = default_camera().camera
SET = RecordingSet(
    Manifest.model_validate(
        {"cameras": {"left": {"rows": 8, "cols": 8, "cfa": "RGGB", "bit_depth": 12}}, "captures": []}
    )
)


FREQUENCY = np.linspace(0.04, 0.9, 16)


def _model(acting: Sequence[Effect] = ()) -> MeasurementModel:
    """A contrast along rows, of one wavelength: too little to tell blurs apart."""

    def predict(effects: Sequence[Effect]) -> Prediction:
        factor = Blur(CAMERA, effects).beside_lens(550.0, FREQUENCY, 0.0 * FREQUENCY)
        return Prediction(np.exp(-2.0 * FREQUENCY) * np.real(factor), {})

    block = Observable(
        measurement=declared("slanted_edge", "spatial_frequency", "cy/px"), reach=0.2, value=predict(acting).mean,
        covariance=4e-6 * np.eye(16),
        labels=tuple(Label(float(f), "G", "5 deg", ("edge-1",), False) for f in FREQUENCY), reads=TRANSFER,
        predict=predict, scale=np.ones(16),
    )  # fmt: skip
    return MeasurementModel((block,), CAMERA)


def _undecided(one: Effect, *others: tuple[str, float]) -> Verdict:
    share = 1.0 - sum(p for _, p in others)
    candidate = Candidate(one, {}, share, others, 30.0)
    return Verdict(_model((one,)), 12.0, 60.0, (), (candidate,), (), (), ())


def _best(*hypotheses: Effect) -> str:
    """The words of the candidate capture in which two effects lie furthest apart."""
    held = [Hypothesis(e.name, (e,), CAMERA) for e in hypotheses]

    def distance(predict: object, covariance: np.ndarray) -> float:
        apart = predict(held[0]) - predict(held[1])  # type: ignore[operator]
        return float(apart @ np.linalg.solve(covariance, apart))

    found = list(candidate_captures(SET, "left", _model()))
    return max(found, key=lambda d: distance(d.predict, d.covariance)).words


def test_the_proposed_capture_varies_what_the_rivals_differ_in() -> None:
    drift, bend = SourceDrift(), Nonlinearity()
    quantity = next(iter(SourceDrift.quantities()))
    drift = SourceDrift(**{quantity: 0.3})
    bend = Nonlinearity(**{next(iter(Nonlinearity.quantities())): 0.3})
    assert _best(drift, bend) == "the same flat every five minutes for an hour"
    early, late = (InfraredCutFilter(cut_wavelength_nm=nm, width_nm=4.0) for nm in (650.0, 654.0))
    words = _best(early, late)
    assert words.startswith("narrowband light at ")
    assert abs(float(words.split()[-2]) - 652.0) < 8.0  # where the one has fallen and the other hasn't
    level = BlackLevelDrift(**{next(iter(BlackLevelDrift.quantities())): 3.0})
    assert "dark frames" in _best(level, BlackLevelDrift())


def test_the_stated_probability_of_deciding_rightly_holds() -> None:
    """Numbers drawn under one rival are nearer to it than to the other with the probability that is stated: Phi(sqrt(D
    / 2)); 3 sigma of a binomial of 4000 draws are 3 sqrt(p (1 - p) / 4000) < 0.024."""
    first, second = (
        Hypothesis("a", (InfraredCutFilter(cut_wavelength_nm=nm, width_nm=4.0),), CAMERA) for nm in (650.0, 650.02)
    )
    candidate = next(d for d in candidate_captures(SET, "left", _model()) if d.words == "narrowband light at 650 nm")
    a, b = candidate.predict(first), candidate.predict(second)
    lower = np.linalg.cholesky(candidate.covariance)
    apart = np.linalg.solve(lower, a - b)
    d = 0.5 * float(apart @ apart)
    assert 0.02 < d < 4.0  # else nothing is tested
    noise = np.random.default_rng(4).standard_normal((4000, len(a)))
    nearer = np.sum(np.square(noise), axis=1) < np.sum(np.square(noise + apart), axis=1)
    assert float(np.mean(nearer)) == pytest.approx(float(norm.cdf(np.sqrt(0.5 * d))), abs=0.024)


def test_captures_are_listed_in_order_and_name_their_nearest_rivals() -> None:
    verdict = _undecided(effect("optical_low_pass_filter")(displacement_x_um=1.0), ("defocus", 0.3), ("unknown", 0.1))
    doubt = doubt_of(SET, "left", verdict, DecisionPolicy())
    assert doubt is not None
    assert doubt.rivals == ("optical_low_pass_filter", "defocus")
    assert doubt.odds == pytest.approx((0.6 / 0.9, 0.3 / 0.9))  # what is unknown counts for neither
    found = doubt.listed(DecisionPolicy())
    assert {c.rivals for c in found} == {("optical_low_pass_filter", "defocus")}
    assert "edges" in found[0].capture  # one spreads along two axes, the other all around
    assert found[0].distance > 2.0
    assert [c.distance for c in found] == sorted((c.distance for c in found), reverse=True)
    assert all(c.told_apart == pytest.approx(norm.cdf(np.sqrt(0.5 * c.distance))) for c in found)


def test_without_rivals_no_capture_is_proposed() -> None:
    assert doubt_of(SET, "left", _undecided(Nonlinearity(), ("unknown", 0.02)), DecisionPolicy()) is None
    assert next_sentence((), None, DecisionPolicy()) is None


@pytest.mark.parametrize(
    ("distance", "words"), [(8.0, "would tell defocus from vibration_blur"), (0.5, "may tell them apart")]
)
def test_the_sentence_states_how_often_the_capture_decides_rightly(distance: float, words: str) -> None:
    told = float(norm.cdf(np.sqrt(0.5 * distance)))
    capture = NextCapture(
        side="left",
        capture="edges in red light",
        rivals=("defocus", "vibration_blur"),
        distance=distance,
        told_apart=told,
    )
    sentence = next_sentence((capture,), None, DecisionPolicy())
    assert sentence is not None
    assert words in sentence
    assert f"{np.sqrt(2 * distance):.1f} standard deviations" in sentence


def _capture_told(one: str, other: str) -> str:
    capture = NextCapture(side="left", capture="x", rivals=(one, other), distance=0.001, told_apart=0.51)
    sentence = next_sentence((capture,), None, DecisionPolicy())
    assert sentence is not None
    return sentence


def test_no_lens_is_proposed_for_what_shows_in_darks_alone() -> None:
    """Line noise and telegraph noise differ in that one follows the f-number's invariance list and the other doesn't:
    no edge shows either."""
    dark_only = [name for name, seen in visibility().items() if set(seen.capture_kinds) == {"dark"}]
    assert len(dark_only) > 2
    for one, other in combinations(dark_only, 2):
        said = _capture_told(one, other)
        assert "f-number" not in said
        assert "edges" not in said
        assert "light" not in said


def test_contrast_still_asks_for_another_f_number() -> None:
    assert "f-number" in _capture_told("defocus", "charge_diffusion")


def test_captures_that_neither_rival_changes_are_not_listed() -> None:
    """A filter against defocus: dark frames, flats and narrowband levels see neither."""
    verdict = _undecided(effect("optical_low_pass_filter")(displacement_x_um=1.0), ("defocus", 0.3))
    every = DecisionPolicy(next_captures_listed=1000)
    doubt = doubt_of(SET, "left", verdict, every)
    assert doubt is not None
    found = doubt.listed(every)
    assert len(found) > 2
    assert all(c.distance >= 0.02 for c in found)
    assert all("slanted" in c.capture for c in found)


def _dark_set(repeats: int) -> RecordingSet:
    captures = [
        {"id": f"d{e}-{k}", "kind": "dark", "side": "left", "frame": f"d{e}-{k}.npy", "exposure_s": e}
        for e in (0.001, 1.0)
        for k in range(repeats)
    ]
    content = SET.manifest.model_dump(mode="json") | {"captures": captures}
    return RecordingSet(Manifest.model_validate(content))


def _dark_model(recordings: RecordingSet) -> MeasurementModel:
    """A level of each dark frame that the black level's drift moves."""

    def predict(effects: Sequence[Effect]) -> Prediction:
        moved = sum(float(getattr(e, next(iter(type(e).quantities())))) for e in effects)
        return Prediction(np.full(len(names), 64.0 + moved), {})

    names = [c.id for c in recordings.captures()]
    block = Observable(
        measurement=declared("dark", "exposure", "s"), reach=1.0, value=predict(()).mean, covariance=np.eye(len(names)),
        labels=tuple(Label(1.0, "all", "", (n,), False) for n in names), reads=frozenset({"signal.offset_dn"}),
        predict=predict, scale=np.ones(len(names)),
    )  # fmt: skip
    return MeasurementModel((block,), CAMERA)


@pytest.mark.parametrize(("repeats", "told"), [(2, True), (12, False)])
def test_more_darks_are_asked_for_where_they_are_few(repeats: int, told: bool) -> None:
    """Eight times as many repeats have an eighth of the variance."""
    recordings = _dark_set(repeats)
    model = _dark_model(recordings)
    again = [d for d in candidate_captures(recordings, "left", model) if "again" in d.words]
    assert len(again) == 1
    assert ("16 at each setting in place of 2" in again[0].words) == told
    assert again[0].covariance[0, 0] == pytest.approx(repeats / 16 if told else 1.0)
    assert (again[0].plan is not None) == told


def _left(measurement: str, axis: str, captures: tuple[str, ...], check: str = "") -> Unexplained:
    return Unexplained(
        side="left", measurement=measurement, axis=axis, where="", shape="", significance_sigma=9.0, chi2_before=90.0,
        chi2_after=1.0, n=4, captures=captures, check=check,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("repeats", "words"), [(2, "16 dark frames at each setting (there are 2)"), (12, "another sensor temperature")]
)
def test_a_mismatch_in_darks_asks_for_darks(repeats: int, words: str) -> None:
    recordings = _dark_set(repeats)
    said = settling_sentence(recordings, "left", [_left("dark_row_noise", "spatial_frequency", ("d1.0-0",))])
    assert said is not None
    assert words in said
    assert "f-number" not in said
    assert settling_sentence(recordings, "left", []) is None


def test_wrong_metadata_is_corrected_before_anything_is_captured() -> None:
    recordings = _dark_set(2)
    wrong = _left("photon_transfer", "level", ("d1.0-0",), check="stated with 3 photons")
    assert settling_sentence(recordings, "left", [wrong]) == (
        "Correct what is stated of the captures above, or take them again."
    )
    said = settling_sentence(recordings, "left", [wrong, _left("dark", "exposure", ("d1.0-0",))])
    assert said is not None
    assert "dark frames" in said


def _station(targets: dict[str, object]) -> Station:
    """The fake station with one knife edge, and these targets beside."""
    table = fake_bench.station().model_dump(mode="json")
    kept = {name: one for name, one in table["targets"].items() if not name.startswith("edge-") or name == "edge-1"}
    for camera in table["cameras"].values():
        camera["datasheet"]["f_number"] = CAMERA.lens.f_number
    return Station.model_validate(table | {"targets": kept | targets})


def _offered(**targets: object) -> dict[str, CapturePlan | None]:
    """What is considered on that station, by words."""
    there = _station(targets)
    return {one.words: one.plan for one in candidate_captures(SET, "left", _model(), there)}


def test_a_turned_edge_is_considered_where_it_is_a_new_direction() -> None:
    """Astigmatism at 45 degrees from one edge: the turned edge shows it, by the forward model."""
    turns = {f"turn {deg}": {"kind": "turn", "angle_deg": deg} for deg in (0, 10, 45)}
    found = _offered(**turns)
    turned = [words for words in found if "turned by" in words]
    assert {words.partition(" turned by ")[2].split()[0] for words in turned} == {"45"}  # 10 is too near to 0
    plan = found[turned[0]]
    assert plan is not None and plan.sequences[0].turn_deg == 45.0  # type: ignore[attr-defined]
    held = [Hypothesis("", (), CAMERA), Hypothesis("", (Astigmatism(defocus_x_um=20.0),), CAMERA)]
    captures = {one.words: one for one in candidate_captures(SET, "left", _model(), _station(turns))}
    apart = [captures[turned[0]].predict(h) for h in held]
    assert float(np.abs(apart[0] - apart[1]).max()) > 0.01


def test_temperatures_are_those_that_the_station_can_be_brought_to() -> None:
    found = _offered(usual={"kind": "sensor_temperature"}, warm={"kind": "sensor_temperature", "sensor_c": 33.0})
    plan = found["dark frames with the sensor at 33 C"]
    assert plan is not None
    assert [one.sensor_c for one in plan.sequences] == [None, 33.0]  # type: ignore[attr-defined]


def test_a_station_without_these_targets_lacks_them_in_one_line() -> None:
    there = _station({})
    found = _offered()
    for words in (
        "dark frames with the sensor 10 and 20 degrees warmer",
        next(w for w in found if "turned by 45" in w),
    ):
        plan = found[words]
        assert plan is not None
        with pytest.raises(InputError, match="add ") as refused:
            plan.steps(there)
        assert "\n" not in str(refused.value)


LAMP = fake_bench.station(
    light_source={
        "driver": "fake",
        "address": "lamp",
        "lights": {
            "3000 K": {"colour_temperature_k": 3000, "channels": {"460": 0.14, "635": 0.78}},
            "6500 K": {"colour_temperature_k": 6500, "channels": {"460": 0.46, "635": 0.30}},
        },
    }
)


def _lamp_captures(station: Station | None) -> dict[str, CandidateCapture]:
    every = candidate_captures(SET, "left", _model(), station)
    return {one.words: one for one in every if "light source" in one.words}


def test_a_station_with_a_light_source_is_offered_its_levels_and_colour_temperatures() -> None:
    found = _lamp_captures(LAMP)
    assert list(found) == [
        "flats in the light source's light of 3000 K",
        "flats in the light source's light of 6500 K",
        "flats at the light source's full level and at 10 % of it, exposed 10 times as long",
    ]
    for one in found.values():
        assert one.plan is not None
        steps = one.plan.steps(LAMP)
        assert {bool(step.setting.lamp) for step in steps if step.captures} == {True}
        assert np.all(np.linalg.eigvalsh(one.covariance) > 0.0)
    dimmed = found["flats at the light source's full level and at 10 % of it, exposed 10 times as long"].plan
    assert dimmed is not None
    assert {round(step.setting.lamp["460"], 6) for step in dimmed.steps(LAMP)} == {0.14, 0.014}
    assert not _lamp_captures(fake_bench.station()) and not _lamp_captures(None)


def _apart(capture: CandidateCapture, one: Effect, other: Effect) -> float:
    difference = capture.predict(Hypothesis("", (one,), CAMERA)) - capture.predict(Hypothesis("", (other,), CAMERA))
    return float(difference @ np.linalg.solve(capture.covariance, difference))


def test_a_dimmed_light_tells_an_exposure_offset_from_a_brighter_lamp() -> None:
    """A level that is off by a share is a nuisance parameter of each level: null limit. An offset of the exposure
    isn't: at the same signal it is a tenth of the share where exposures are ten times as long."""
    dimmed = next(one for words, one in _lamp_captures(LAMP).items() if "exposed" in words)
    none = ExposureOffset(offset_us=0.0)
    assert _apart(dimmed, ExposureOffset(offset_us=20.0), none) > 100.0
    # A drift by time changes nothing: all predictions are of the same moment.
    assert _apart(dimmed, SourceDrift(drift_percent_per_min=5.0), none) == pytest.approx(0.0, abs=1e-9)
    # In proportion to the offset squared, as the law is linear in it: 4, to the noise of the black level's freedom.
    ratio = _apart(dimmed, ExposureOffset(offset_us=40.0), none) / _apart(dimmed, ExposureOffset(offset_us=20.0), none)
    assert ratio == pytest.approx(4.0, rel=1e-3)


def test_colour_temperatures_tell_a_spectral_effect_and_no_nonlinearity_of_a_camera_without_colour() -> None:
    warm, cold = (one for words, one in _lamp_captures(LAMP).items() if "exposed" not in words)
    cut, wider = InfraredCutFilter(cut_wavelength_nm=650.0), InfraredCutFilter(cut_wavelength_nm=640.0)
    assert _apart(warm, cut, wider) > _apart(cold, cut, wider) > 1.0  # more of the warm light is red
    mono = CAMERA.model_copy(update={"cfa": "MONO", "quantum_efficiency": {"Y": CAMERA.quantum_efficiency["G"]}})
    model = MeasurementModel(_model().blocks, mono)
    words = [one.words for one in candidate_captures(SET, "left", model, LAMP)]
    assert not any("light of 3000 K" in one for one in words)
