"""Predictions of a session in another configuration, against recordings of a camera whose truth is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.cli import main
from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.refit import refit
from lab.diagnose.inference.side_model import measurement_model
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.outcome.improved_model import improved_model
from lab.diagnose.outcome.names_in_doubt import names_in_doubt
from lab.diagnose.policy import DecisionPolicy
from lab.errors import InputError
from lab.fit import fit_recording_set
from lab.formats.camera_file import CameraFile, read_camera, write_camera
from lab.formats.model_posterior import NameInDoubt, RivalModel, StoredEffect
from lab.formats.recording_set import Manifest, RecordingSet, write
from lab.formats.recording_set.files import MemoryFiles
from lab.twin import score as twin_score
from lab.twin.changes import Changes, apply_changes, parse_changes
from lab.twin.predict import correction_covariance, predict
from lab.twin.score import TwinVerdict, combine_sessions, conclusion, score
from lab.twin.sealed import PredictedNumber, open_seal, seal
from lab.twin.session import future_session
from sim.camera import CameraModel, Lens
from sim.effects.base import Effect
from sim.effects.charge_diffusion import ChargeDiffusion
from sim.effects.dark_current_temperature import DarkCurrentTemperature
from sim.effects.defocus import Defocus
from sim.effects.model_discrepancy import ModelDiscrepancy
from sim.effects.spherical_aberration import SphericalAberration
from sim.effects.veiling_glare import VeilingGlare
from sim.spectrum import Spectrum
from sim.uniform import electron_rate

ROWS, COLS = 120, 160
NM = np.arange(400.0, 721.0, 5.0)
LAMP = Spectrum.of(NM, 0.02 * (1.0 + 0.1 * np.sin(NM / 60.0)))
REGION = (20, 40, 100, 120)
TRANSFERS = {
    "f/8": Changes(f_number=8.0, radiance_factor=4.0),
    "exposure x8, gain x4": Changes(exposure_factor=8.0, gain_db=12.041, radiance_factor=1.0 / 32.0),
    "15 degrees warmer": Changes(temperature_c=40.0),
}


def _curve(centre_nm: float) -> Spectrum:
    return Spectrum.of(NM, 0.55 * np.exp(-0.5 * ((NM - centre_nm) / 40.0) ** 2) + 0.01)


TRUTH = CameraFile(
    "truth",
    CameraModel(
        rows=ROWS, cols=COLS, pixel_pitch_um=4.0, fill_factor=0.9, cfa="RGGB", bit_depth=12, black_level_dn=64.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.38, full_well_e=10500.0, read_noise_e=4.0, dark_current_e_per_s=20.0,
        dark_current_doubling_c=7.0, dsnu_e=0.8,
        prnu_percent=0.6, quantum_efficiency={"R": _curve(605.0), "G": _curve(530.0), "B": _curve(455.0)},
        lens=Lens(f_number=4.0, focal_length_mm=8.0),
    ),
)  # fmt: skip


def _plan() -> RecordingSet:
    """Darks at three temperatures, flats, the chart and four edges at f/4 and 25 C; no frames."""
    camera = TRUTH.camera
    full_s = camera.full_well_e / max(electron_rate(camera, c, LAMP) for c in camera.channels)
    captures: list[dict[str, object]] = []

    def take(kind: str, exposure_s: float, repeats: int, temperature_c: float = 25.0, **more: object) -> None:
        for _ in range(repeats):
            k = len(captures)
            time = f"2026-03-02T09:{k // 60:02d}:{k % 60:02d}Z"
            captures.append(
                {"id": f"c{k:03d}", "kind": kind, "side": "left", "frame": f"frames/{k:03d}.npy",
                "exposure_s": exposure_s,
                 "temperature_c": temperature_c, "time": time} | more
            )  # fmt: skip

    for exposure_s, temperature_c in ((0.001, 25.0), (2.0, 25.0), (5.0, 25.0), (5.0, 35.0), (5.0, 45.0)):
        take("dark", exposure_s, 4, temperature_c)
    for level in (0.05, 0.12, 0.22, 0.35, 0.5, 0.65, 0.8):
        take("flat", level * full_s, 4, radiance="lamp.csv")
    corners = ((10.0, 10.0), (10.0, 150.0), (110.0, 150.0), (110.0, 10.0))
    take("chart", 0.7 * full_s, 4, chart="ColorChecker24", corners=corners, radiance="lamp.csv")
    for angle in (5.0, 95.0):
        take(
            "slanted_edge",
            0.6 * full_s,
            4,
            region=REGION,
            angle_deg=angle,
            light_radiance="lamp.csv",
            field_mm=(0.0, 0.0),
        )
    keys = ("rows", "cols", "pixel_pitch_um", "fill_factor", "cfa", "bit_depth", "black_level_dn", "white_level_dn")
    sheet = {key: getattr(camera, key) for key in keys} | {
        "f_number": 4.0,
        "focal_length_mm": 8.0,
        "lens_transmittance": 1.0,
    }
    sheet["quantum_efficiency"] = {c: f"{c}.csv" for c in camera.channels}
    manifest = Manifest.model_validate({"name": "plan", "cameras": {"left": sheet}, "captures": captures})
    spectra = {"lamp.csv": LAMP} | {f"{c}.csv": q for c, q in camera.quantum_efficiency.items()}
    return RecordingSet(manifest, files=MemoryFiles({}, spectra, {}), source="plan")


PLAN = _plan()


def trained(seed: int, wrong: bool = False) -> CameraFile:
    """The improved model of one drawn session. `wrong`: with a veil that the camera hasn't, too."""
    session = future_session(TRUTH, PLAN, "left", Changes(), seed)
    fit = fit_recording_set(session, steps=("noise",))
    model, _ = measurement_model(session, "left", fit)
    assert model is not None
    found = refit(model, (DarkCurrentTemperature(doublings_per_c=0.1),), DecisionPolicy(), of_any_size=True).effects
    effects = (*found, VeilingGlare(share_percent=5.0)) if wrong else found
    return improved_model(session, "left", fit, None, model, effects, ())[0]


@pytest.fixture(scope="module")
def content() -> CameraFile:
    return trained(1)


def captured(changes: Changes, seed: int) -> RecordingSet:
    """The session that is captured in the changed configuration, by the true camera."""
    return future_session(apply_changes(TRUTH, changes), PLAN, "left", changes, seed)


@pytest.mark.parametrize("name", TRANSFERS)
def test_intervals_hold_in_a_configuration_that_nobody_has_seen(content: CameraFile, name: str) -> None:
    found = score(predict({"left": content}, PLAN, TRANSFERS[name], light_std=0.0), captured(TRANSFERS[name], 7))
    assert {q.quantity for q in found.quantities} == {"chart", "noise", "slanted_edge", "dark"} and found.missing == 0
    inside = sum(q.n * q.within_95_percent_interval for q in found.quantities) / found.n
    # 95 % of some 300 numbers, of which errors of the parameters are common to many: 100 effectively, 4 standard
    # deviations
    assert inside > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / 100.0)
    assert found.chi2 < 1.5 * found.n


def test_an_effect_that_the_camera_lacks_is_withdrawn() -> None:
    changes = Changes(radiance_factor=0.5)
    found = score(predict({"left": trained(2, wrong=True)}, PLAN, changes, light_std=0.0), captured(changes, 8))
    verdicts = {effect.name: effect.verdict for effect in found.effects}
    assert verdicts == {"dark_current_temperature": "survives", "veiling_glare": "withdrawn"}
    assert conclusion(found.effects) == "stands: dark current temperature; withdrawn: veiling glare"


def _photons(recordings: RecordingSet, levels: slice) -> RecordingSet:
    """The darks and some levels of the flats, which state photons in place of a radiance."""
    flats = recordings.captures(FlatCapture, "left")
    steps = sorted({c.exposure_s for c in flats})[levels]
    told = [
        c.model_copy(update={"radiance": None, "photons_per_pixel": 1e6 * c.exposure_s, "wavelength_nm": 550.0})
        for c in flats
        if c.exposure_s in steps
    ]
    darks = [c for c in recordings.captures(DarkCapture, "left") if c.temperature_c == 25.0]
    captures = (*darks, *told)
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


@pytest.fixture(scope="module")
def of_photons() -> tuple[CameraFile, RecordingSet, RecordingSet]:
    """A model of the lowest levels of flats that state photons, the recordings of its fit, and those of the others."""
    drawn = future_session(TRUTH, PLAN, "left", Changes(), 5)
    low, high = _photons(drawn, slice(0, 4)), _photons(drawn, slice(4, None))
    fit = fit_recording_set(low, steps=("noise",))
    model, _ = measurement_model(low, "left", fit)
    assert model is not None
    return improved_model(low, "left", fit, None, model, (), ())[0], low, high


def test_levels_of_stated_photons_are_predicted_relative_to_the_fitted_ones(
    of_photons: tuple[CameraFile, RecordingSet, RecordingSet],
) -> None:
    content, low, high = of_photons
    found = score(predict({"left": content}, high, Changes(), fitted=low), high)
    scores = {q.quantity: q for q in found.quantities}
    # three levels, of which the brightest channel clips in none: four repeats of three channels, and a variance of each
    assert scores["photon_transfer"].n == 36 and scores["noise"].n == 9
    levels = scores["photon_transfer"]
    # a line through levels up to half of these, whose bend is told to some tenths of a per cent
    assert levels.largest_of_95_percent < 1.0 and levels.chi2 < 2.0 * levels.n
    wrong = replace(content, camera=content.camera.model_copy(update={"black_level_dn": 80.0}))
    missed = score(predict({"left": wrong}, high, Changes(), fitted=low), high)
    assert missed.chi2 > 10.0 * found.chi2


def test_a_correction_is_as_wrong_elsewhere_as_it_scatters_and_drifts() -> None:
    """Of factors that scatter by s alone, the last one held is wrong by sqrt(2) s, a mean of two by sqrt(3 / 2) s, and
    held levels share the last one's s. Of a drift alone, by the root of the way beyond."""
    at, rng = np.arange(1.0, 401.0), np.random.default_rng(4)
    x = np.array([200.5, 410.0, 450.0])
    # of 400 factors the mean square is known to sqrt(2 / 400), 7 %: within four of that
    alone = ModelDiscrepancy(along="variance_signal_e", at=tuple(at), strength=1.0,
                             factor=tuple(1.0 + 0.01 * rng.standard_normal(400)))  # fmt: skip
    found = correction_covariance(alone, x) / 1e-4
    np.testing.assert_allclose(np.diag(found), [1.5, 2.0, 2.0], rtol=0.3)
    assert found[1, 2] == pytest.approx(0.5 * found[1, 1], rel=0.2) and abs(found[0, 1]) < 0.2
    walk = 1.0 + 0.001 * np.cumsum(np.random.default_rng(4).standard_normal(400))
    drifts = ModelDiscrepancy(along="variance_signal_e", at=tuple(at), factor=tuple(walk), strength=1.0)
    beyond = correction_covariance(drifts, np.array([410.0, 440.0, 480.0]))
    assert beyond[2, 2] - beyond[1, 1] == pytest.approx(40.0 / 30.0 * (beyond[1, 1] - beyond[0, 0]), rel=1e-6)
    # the lags of one walk overlap: its slope is known to a factor
    assert 0.3e-6 < (beyond[2, 2] - beyond[1, 1]) / (2.0 * 40.0) / 0.5 < 3e-6
    even = ModelDiscrepancy(along="variance_signal_e", at=tuple(at), factor=(1.02,) * 400, strength=1.0)
    np.testing.assert_allclose(correction_covariance(even, x), 0.0, atol=1e-15)


def test_a_correction_of_variances_holds_what_unnamed_laws_do_there(
    of_photons: tuple[CameraFile, RecordingSet, RecordingSet],
) -> None:
    """A bend that nobody named, at 1 % more by the posterior, moves no variance where a correction was read, and beyond
    its last level by the change from there alone; without a correction, by all of it."""
    content, low, high = of_photons
    posterior = content.posterior
    assert posterior is not None
    mean = np.array(posterior.mean)
    mean[posterior.names.index("nonlinearity.quadratic_percent")] += 1.0
    bent = replace(content, posterior=posterior.model_copy(update={"mean": tuple(mean.tolist())}))
    levels_e = np.array([n.x for n in _noise(content, high, low)]) / content.camera.conversion_gain_dn_per_e

    def moved(effects: tuple[Effect, ...]) -> np.ndarray:
        before, after = (_noise(replace(one, effects=effects), high, low) for one in (content, bent))
        # the rate of the light is another, too: at the same level
        same = [b.predicted + b.level_slope * (a.x - b.x) for a, b in zip(before, after, strict=True)]
        return np.array(same) / [a.predicted for a in before] - 1.0

    def held_to(last_e: float) -> np.ndarray:
        correction = ModelDiscrepancy(along="variance_signal_e", at=(10.0, last_e), factor=(1.0, 1.0), strength=1.0)
        return moved((correction,))

    by_all, middle_e = moved(()), float(np.median(levels_e))
    assert np.abs(by_all).max() > 0.005  # 1 % at full well changes the slope, and its square by twice that
    assert np.abs(held_to(1.01 * levels_e.max())).max() < 0.02 * np.abs(by_all).max()
    beyond, at_middle = levels_e > middle_e, np.interp(middle_e, np.sort(levels_e), by_all[np.argsort(levels_e)])
    np.testing.assert_allclose(held_to(middle_e)[beyond], (by_all - at_middle)[beyond], atol=0.1 * np.ptp(by_all))


def _noise(content: CameraFile, plan: RecordingSet, fitted: RecordingSet) -> list[PredictedNumber]:
    found = predict({"left": content}, plan, Changes(), fitted=fitted).sides["left"].numbers
    return [n for n in found if n.quantity == "noise"]


def test_a_model_without_a_correction_has_no_wider_intervals(content: CameraFile) -> None:
    """What a correction is wrong by is in the intervals of variances alone, and of a model that has one."""

    def std(one: CameraFile) -> dict[str, np.ndarray]:
        numbers = predict({"left": one}, PLAN, Changes(), light_std=0.0).sides["left"].numbers
        kinds = {n.quantity for n in numbers}
        return {kind: np.array([n.std for n in numbers if n.quantity == kind]) for kind in kinds}

    scatters = ModelDiscrepancy(along="variance_signal_e", at=(10.0, 2000.0, 4000.0, 6000.0, 9000.0),
                                factor=(1.0, 1.02, 0.98, 1.02, 0.98), strength=1.0)  # fmt: skip
    plain, corrected = std(content), std(replace(content, effects=(*content.effects, scatters)))
    assert np.all(corrected["noise"] > 2.0 * plain["noise"])
    # factors of 0.98 and 1.02 of the variance are 1 % of a standard deviation; drawn frames differ by 1 % in that of an
    # edge's transfer, three times that at most
    for kind, tolerance in (("chart", 0.01), ("slanted_edge", 0.01 + 3 * 0.011), ("dark", 0.01)):
        np.testing.assert_allclose(corrected[kind], plain[kind], rtol=tolerance)


def test_stated_photons_need_the_fitted_recordings(of_photons: tuple[CameraFile, RecordingSet, RecordingSet]) -> None:
    content, _, high = of_photons
    with pytest.raises(InputError, match="states photons and no radiance; give the fitted recordings"):
        predict({"left": content}, high, Changes())


def test_a_transfer_tells_which_of_two_rivals_blurs() -> None:
    """Charge diffusion and defocus lose contrast alike at one aperture; at another only defocus changes."""
    blurred = replace(TRUTH, effects=(Defocus(defocus_um=14.0),))
    session = future_session(blurred, PLAN, "left", Changes(), 11)
    fit = fit_recording_set(session, steps=("noise",))
    model, _ = measurement_model(session, "left", fit)
    assert model is not None
    policy = DecisionPolicy()
    warm = DarkCurrentTemperature(doublings_per_c=0.1)
    found = refit(model, (warm, ChargeDiffusion(length_um=0.8)), policy).effects
    named = Candidate(found[1], {}, 0.6, (), 100.0, members=(("charge_diffusion", 0.6), ("defocus", 0.4)))
    verdict = Verdict(model, 0.0, 0.0, (), (named, Candidate(found[0], {}, 1.0, (), 100.0)), (), (), ())
    content = improved_model(session, "left", fit, None, model, found, ())[0]
    assert content.posterior is not None
    doubts = names_in_doubt(verdict, policy)
    content = replace(content, posterior=content.posterior.model_copy(update={"doubts": doubts}))

    changes = Changes(f_number=8.0, radiance_factor=4.0)
    taken = future_session(apply_changes(blurred, changes), PLAN, "left", changes, 12)
    tests = score(predict({"left": content}, PLAN, changes, light_std=0.0), taken).effects
    family = next(one for one in tests if one.effect == "charge_diffusion")
    assert (family.name, family.verdict, family.becomes) == ("isotropic_contrast_loss", "named", "defocus")
    assert family.probability > 0.95 and "is defocus" in family.words
    # told as a name, it falls
    alone = replace(named, members=(), rivals=(("defocus", 0.4),))
    doubts = names_in_doubt(replace(verdict, named=(alone, verdict.named[1])), policy)
    content = replace(content, posterior=content.posterior.model_copy(update={"doubts": doubts}))
    tests = score(predict({"left": content}, PLAN, changes, light_std=0.0), taken).effects
    name = next(one for one in tests if one.effect == "charge_diffusion")
    assert (name.verdict, name.becomes) == ("withdrawn", "defocus")
    assert combine_sessions([tests, tests])[0].gain == pytest.approx(2.0 * tests[0].gain)


def test_the_conclusion_says_what_became_of_every_name() -> None:
    def one(name: str, verdict: TwinVerdict, becomes: str | None = None) -> twin_score.TestedEffect:
        return twin_score.TestedEffect(side="left", name=name, effect="defocus", gain=1.0, before=0.5, verdict=verdict,
                            becomes=becomes)  # fmt: skip

    said = conclusion([one("coma", "survives"), one("isotropic_contrast_loss", "named", "defocus"),
                       one("ghost", "withdrawn"), one("row_noise", "untested"),
                       one("defocus", "withdrawn", "charge_diffusion")])  # fmt: skip
    assert said == (
        "stands: coma, defocus, charge diffusion in place of defocus; withdrawn: ghost, defocus; untested: row noise"
    )
    assert conclusion([one("ghost", "withdrawn")]) == "stands: no name; withdrawn: ghost"


def test_the_surroundings_of_chart_and_edge_are_those_of_the_plans_frames() -> None:
    drawn = future_session(TRUTH, PLAN, "left", Changes(), 3)
    bright = {}
    for capture in drawn.captures(side="left"):
        frame = drawn.frame(capture).copy()
        if capture.kind == "chart":
            frame[:9] = 2000  # a white wall above the chart
        bright[capture.frame] = frame
    spectra = {path: drawn.spectrum(path) for path in ("lamp.csv", *drawn.camera("left").quantum_efficiency.values())}
    plan = RecordingSet(drawn.manifest, files=MemoryFiles(bright, spectra, {}), source="plan")
    again = future_session(TRUTH, plan, "left", Changes(radiance_factor=0.5), 4)
    chart = next(c for c in again.captures(side="left") if c.kind == "chart")
    frame = again.frame(chart).astype(float)
    # half the light: half the level above black, in the patches and around them
    assert frame[:9].mean() - 64.0 == pytest.approx(0.5 * (2000.0 - 64.0), rel=0.02)
    inside = (slice(20, 100), slice(20, 140))
    before = drawn.frame(chart)[inside].mean() - 64.0
    assert frame[inside].mean() - 64.0 == pytest.approx(0.5 * before, rel=0.02)


def test_the_posterior_goes_through_the_camera_file(content: CameraFile, tmp_path: Path) -> None:
    write_camera(tmp_path / "left.toml", content)
    assert read_camera(tmp_path / "left.toml").posterior == content.posterior


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("fnumber=8", "isn't a change"),
        ("f_number=soon", "f_number=soon"),
        ("lamp=none.csv", "lamp: none.csv can't be read"),
        ("lens=none.zmx", "lens: none.zmx isn't there"),
        ("distance_mm=9", "twice the focal length"),
    ],
)
def test_a_change_that_cant_be_carried_is_one_line(content: CameraFile, change: str, said: str) -> None:
    with pytest.raises(InputError) as refused:
        predict({"left": content}, PLAN, parse_changes(change))
    assert said in str(refused.value) and "\n" not in str(refused.value)


def test_aberrations_say_at_which_aperture_they_were_fitted() -> None:
    """W040 of f/4 is a sixteenth at f/8, in the effects of the model, and in a rival's."""
    spherical, changes = SphericalAberration(w040_um=0.3), Changes(f_number=8.0, radiance_factor=4.0)
    model = replace(trained(3), effects=(DarkCurrentTemperature(doublings_per_c=0.14), spherical))
    there = apply_changes(model, changes)
    assert there.effects[1] == SphericalAberration(w040_um=0.3, stated_f_number=4.0)
    posterior = model.posterior
    assert posterior is not None
    beside = StoredEffect.of(model.effects[0])
    rival = RivalModel(name="coma", probability=0.5, effects=(beside, StoredEffect.of(spherical)), shift={})
    doubt = NameInDoubt(effect="spherical_aberration", told="isotropic_contrast_loss", probability=0.5,
                        named=tuple(e.name for e in model.effects), rivals=(rival,))  # fmt: skip
    model = replace(model, posterior=posterior.model_copy(update={"doubts": (doubt,)}))
    found = predict({"left": model}, PLAN, changes, light_std=0.0).sides["left"]
    weak = replace(model, effects=(model.effects[0], SphericalAberration(w040_um=0.3 / 16.0, stated_f_number=8.0)))
    same = predict({"left": weak}, PLAN, changes, light_std=0.0).sides["left"]
    np.testing.assert_allclose([n.predicted for n in same.numbers], [n.predicted for n in found.numbers], rtol=1e-9)
    # the rival is the same effect: of 9 digits that are sealed, the same numbers
    np.testing.assert_allclose(found.names[0].rivals[0].numbers, [n.predicted for n in found.numbers], rtol=1e-6)


def test_a_temperature_needs_a_law_of_dark_current(content: CameraFile) -> None:
    without = CameraFile(content.name, content.camera, (), None, content.posterior)
    with pytest.raises(InputError, match="no law of dark current"):
        predict({"left": without}, PLAN, Changes(temperature_c=60.0))


def test_an_edited_seal_and_another_session_are_refused(content: CameraFile, tmp_path: Path) -> None:
    changes = Changes(f_number=8.0, radiance_factor=4.0)
    file = tmp_path / "sealed.json"
    prediction = predict({"left": content}, PLAN, changes)
    hashed = seal(prediction, file)
    assert open_seal(file, hashed) == open_seal(file) == prediction
    for other, said in ((Changes(), "f_number"), (changes.model_copy(update={"gain_db": 6.0}), "gain_db")):
        with pytest.raises(InputError, match=said):
            score(prediction, captured(other, 9))
    file.write_text(file.read_text().replace('"n', '"m', 1))
    with pytest.raises(InputError, match="was edited"):
        open_seal(file)


def test_the_commands_predict_and_score(content: CameraFile, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    changes = TRANSFERS["f/8"]
    write(captured(Changes(), 1), tmp_path / "plan")
    write(captured(changes, 7), tmp_path / "taken")
    write_camera(tmp_path / "left.toml", content)
    sealed, result = str(tmp_path / "sealed.json"), tmp_path / "score.json"
    given = ["twin", "predict", str(tmp_path), "--plan", str(tmp_path / "plan"), "--out", sealed]
    assert main([*given, "--change", "f_number=8,radiance_factor=4"]) == 0
    assert main(["twin", "score", sealed, str(tmp_path / "taken"), "--json", str(result)]) == 0
    assert json.loads(result.read_text())["n"] > 100
    assert main([*given, "--change", "colour=red"]) == 2
    assert "isn't a change" in capfd.readouterr().err
