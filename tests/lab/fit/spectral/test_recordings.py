"""Quantum efficiency of recording sets: absolute scale, saturated light, the curves of the maker, refusals."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest

from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.fit.noise.noise_fit import fit_noise
from lab.fit.spectral.maker_curves import compare_curves
from lab.fit.spectral.recordings import MIN_LIGHTS, fit_spectral
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet, read
from lab.formats.results import NoiseFit, RepeatDrift, SpectralFit
from sim.frame import Exposure, sample
from sim.scene import Darkness, UniformField
from sim.spectrum import PHOTON_ENERGY_J_NM, Spectrum
from tests.lab.fit.spectral.known_camera import WAVE, model, stated

DATA = Path(__file__).parents[5] / "shared" / "data"


def recordings(exposure_s: float = 0.1, camera: DataSheet | None = None, step_nm: float = 10.0) -> RecordingSet:
    """Darks and narrowband light, 10 nm wide, of a radiance that a pixel of QE 1 would turn into 8000 e in 0.1 s."""
    captures, frames, spectra = drawn(exposure_s, step_nm)
    manifest = Manifest(cameras={"left": camera or stated()}, captures=captures)
    return RecordingSet(manifest, dict(frames), dict(spectra))


@functools.cache
def drawn(
    exposure_s: float, step_nm: float
) -> tuple[tuple[dict[str, object], ...], dict[str, np.ndarray], dict[str, Spectrum]]:
    """Captures, frames and spectra of `recordings`."""
    rng = np.random.default_rng(4)
    captures, frames, spectra = [], {}, {}

    def add(kind: str, scene: Darkness | UniformField, seconds: float, **extra: object) -> None:
        name = f"{kind}-{len(captures)}"
        captures.append({"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": seconds, **extra})
        frames[name] = sample(model(), Exposure(scene, seconds), rng)

    for seconds in (0.001, exposure_s):
        for _ in range(2):
            add("dark", Darkness(), seconds)
    rate = np.pi / 65.0 * 0.9 * 0.8 * (4e-6) ** 2  # photons of a pixel per radiance
    for centre in np.arange(400.0, 721.0, step_nm):
        shape = np.exp(-0.5 * ((WAVE - centre) * 2.3548 / 10.0) ** 2)
        photons = 8e4 / rate * shape / np.trapezoid(shape, WAVE)
        path = f"nb{centre:.0f}.csv"
        spectra[path] = Spectrum.of(WAVE, photons * PHOTON_ENERGY_J_NM / WAVE)
        add("narrowband", UniformField(spectra[path]), exposure_s, wavelength_nm=centre, radiance=path)
    return tuple(captures), frames, spectra


NOISE = NoiseFit(conversion_gain_dn_per_e=0.4, conversion_gain_dn_per_e_std=0.0004, prnu_percent=0.5)


def rms_of_peak_percent(fit: SpectralFit, channel: str) -> float:
    truth = model().quantum_efficiency[channel].at(fit.wavelength_nm)
    return float(100 * np.sqrt(np.mean((np.array(fit.quantum_efficiency[channel]) - truth) ** 2)) / truth.max())


def test_absolute_quantum_efficiency_of_the_forward_model() -> None:
    fit = fit_spectral(recordings(), "left", NOISE)
    assert fit.wavelength_nm == tuple(np.arange(400.0, 721.0, 10.0).tolist())
    assert fit.remarks == ()
    for channel in "RGB":
        assert rms_of_peak_percent(fit, channel) < 1.0
        truth = model().quantum_efficiency[channel].at(fit.wavelength_nm)
        score = (np.array(fit.quantum_efficiency[channel]) - truth) / np.array(fit.quantum_efficiency_std[channel])
        assert np.sqrt(np.mean(score**2)) < 2.0


def test_repeats_that_drift_widen_the_quantum_efficiency_of_their_light() -> None:
    """A drift of 20 DN of the 550 nm: the standard deviation there is at least as large, less what neighbours hold."""
    drawn_set = recordings()
    (light,) = [c for c in drawn_set.captures("narrowband") if getattr(c, "wavelength_nm", None) == 550.0]
    mean = float(drawn_set.frame(light).mean())
    drift = RepeatDrift(
        shape="trend", kind="narrowband", setting="narrowband, 550 nm", captures=(light.id,), changing=(light.id,),
        amplitude_dn=70.0, amplitude_dn_std=1.0, p_value=1e-6, scatter_dn=1.0, noise_dn=1.0, level_dn_std=20.0,
        mean_dn=(mean,), curve_dn=(mean,), curve_dn_std=(1.0,),
    )  # fmt: skip
    plain, widened = (fit_spectral(drawn_set, "left", NOISE, drifts) for drifts in ((), (drift,)))
    at = plain.wavelength_nm.index(550.0)
    share = 20.0 / (mean - 64.0)
    assert widened.quantum_efficiency_std["G"][at] > 1.5 * plain.quantum_efficiency_std["G"][at]
    assert widened.quantum_efficiency_std["G"][at] < 3.0 * share * widened.quantum_efficiency["G"][at]
    far = plain.wavelength_nm.index(450.0)
    assert widened.quantum_efficiency_std["G"][far] == pytest.approx(plain.quantum_efficiency_std["G"][far], rel=0.1)


def test_the_darks_of_another_temperature_are_not_those_of_the_lights() -> None:
    """Darks at 60 C with 200 DN more at the lights' exposure, beside those at the lights' 20 C."""
    base = recordings(step_nm=20.0)
    content = base.manifest.model_dump(mode="json")
    frames = {c.frame: base.frame(c) for c in base.captures()}
    for capture in content["captures"]:
        capture["temperature_c"] = 20.0
    for capture in [c for c in content["captures"] if c["kind"] == "dark"]:
        hot = capture | {"id": f"hot-{capture['id']}", "frame": f"hot-{capture['frame']}", "temperature_c": 60.0}
        content["captures"].append(hot)
        added = np.uint16(200 * (capture["exposure_s"] > 0.01))
        frames[hot["frame"]] = frames[capture["frame"]] + added
    spectra = {c.radiance: base.spectrum(c.radiance) for c in base.captures(NarrowbandCapture)}
    hot_set = RecordingSet(Manifest.model_validate(content), frames, spectra)
    assert fit_spectral(hot_set, "left", NOISE) == fit_spectral(base, "left", NOISE)


def test_saturated_light_is_a_lower_limit_without_the_makers_curves() -> None:
    fit = fit_spectral(recordings(exposure_s=0.25), "left", NOISE)
    assert any("saturated" in remark and "smoothness alone" in remark for remark in fit.remarks)
    peak = fit.wavelength_nm.index(540.0)
    full = (4095 - 64) / 0.4 / (0.25 * 8e4)  # QE that saturates the pixel
    assert fit.quantum_efficiency["G"][peak] > 0.97 * full
    # Where nothing was measured the band says so.
    assert fit.quantum_efficiency_std["G"][peak] > 5 * fit.quantum_efficiency_std["G"][fit.wavelength_nm.index(650.0)]


def test_saturated_light_rests_on_the_makers_curves() -> None:
    base = recordings(exposure_s=0.25)
    curve = {f"qe_{c}.csv": s for c, s in model().quantum_efficiency.items()}
    off = {path: Spectrum.of(s.wavelength_nm, np.array(s.value) * (1.06 - 1e-4 * WAVE)) for path, s in curve.items()}
    camera = stated(quantum_efficiency={c: f"qe_{c}.csv" for c in "RGB"})
    spectra = {c.radiance: base.spectrum(c.radiance) for c in base.captures("narrowband")}
    whole = RecordingSet(
        base.manifest.model_copy(update={"cameras": {"left": camera}}),
        {c.frame: base.frame(c) for c in base.captures()},
        spectra | off,
    )
    fit = fit_spectral(whole, "left", NOISE)
    assert any("the maker's" in remark for remark in fit.remarks)
    for channel in "RGB":
        assert rms_of_peak_percent(fit, channel) < 1.0


@pytest.mark.parametrize(
    ("changes", "noise", "words"),
    [
        ({"f_number": None}, NOISE, "f_number unknown"),
        ({"pixel_pitch_um": None}, NOISE, "pixel_pitch_um unknown"),
        ({}, None, "conversion gain isn't known"),
    ],
)
def test_what_the_scale_needs_is_said(changes: dict[str, object], noise: NoiseFit | None, words: str) -> None:
    with pytest.raises(NotDetermined, match=words):
        fit_spectral(recordings(step_nm=40.0, camera=stated(**changes)), "left", noise)


def with_maker(base: RecordingSet, curves_of: dict[str, Spectrum]) -> RecordingSet:
    """The same recordings with a maker's curves."""
    camera = stated(quantum_efficiency={c: f"qe_{c}.csv" for c in curves_of})
    spectra = {c.radiance: base.spectrum(c.radiance) for c in base.captures("narrowband")}
    return RecordingSet(
        base.manifest.model_copy(update={"cameras": {"left": camera}}),
        {c.frame: base.frame(c) for c in base.captures()},
        spectra | {f"qe_{c}.csv": curve for c, curve in curves_of.items()},
    )


def test_makers_curves_are_held_against_the_fit() -> None:
    base = recordings()
    right = dict(model().quantum_efficiency)
    fit = fit_spectral(with_maker(base, right), "left", NOISE)
    assert fit.maker_scale == pytest.approx(1.0, abs=0.005)
    assert fit.maker_departures == ()
    dented = Spectrum.of(WAVE, np.array(right["G"].value) * (1 - 0.1 * np.exp(-0.5 * ((WAVE - 560.0) / 12.0) ** 2)))
    fit = fit_spectral(with_maker(base, right | {"G": dented}), "left", NOISE)
    first = fit.maker_departures[0]
    assert first.channel == "G"
    assert 530 <= first.from_nm <= 560 <= first.to_nm <= 590
    assert first.difference > 0
    assert first.significance_sigma > 5


def test_relative_curves_do_not_know_the_scale() -> None:
    gain = NoiseFit(conversion_gain_dn_per_e=0.4, conversion_gain_dn_per_e_std=0.02, prnu_percent=0.5)
    fit = fit_spectral(recordings(), "left", gain)
    assert max(max(row) for row in fit.relative_sensitivity.values()) == 1.0
    at = fit.wavelength_nm.index(530.0)
    # 5 % of scale in the one, not in the other.
    assert fit.quantum_efficiency_std["G"][at] > 0.045 * fit.quantum_efficiency["G"][at]
    assert fit.relative_sensitivity_std["G"][at] < 0.01


def test_broadband_lights_do_where_they_span_and_say_where_not() -> None:
    rng = np.random.default_rng(9)
    captures, frames, spectra = [], {}, {}

    def add(kind: str, scene: Darkness | UniformField, **extra: object) -> None:
        name = f"{kind}-{len(captures)}"
        captures.append({"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": 0.1, **extra})
        frames[name] = sample(model(), Exposure(scene, 0.1), rng)

    add("dark", Darkness())
    rate = np.pi / 65.0 * 0.9 * 0.8 * (4e-6) ** 2
    for centre in np.arange(420.0, 661.0, 20.0):  # LEDs, 30 nm wide
        shape = np.exp(-0.5 * ((WAVE - centre) * 2.3548 / 30.0) ** 2)
        spectra[f"led{centre:.0f}.csv"] = Spectrum.of(
            WAVE, 8e4 / rate * shape / np.trapezoid(shape, WAVE) * PHOTON_ENERGY_J_NM / WAVE
        )
        add("flat", UniformField(spectra[f"led{centre:.0f}.csv"]), radiance=f"led{centre:.0f}.csv")
    fit = fit_spectral(
        RecordingSet(Manifest(cameras={"left": stated()}, captures=tuple(captures)), frames, spectra), "left", NOISE
    )
    for channel in "RGB":
        truth = model().quantum_efficiency[channel].at(fit.wavelength_nm)
        score = (np.array(fit.quantum_efficiency[channel]) - truth) / np.array(fit.quantum_efficiency_std[channel])
        assert np.sqrt(np.mean(score**2)) < 2.0, channel
    few = captures[:1] + captures[1:4] * 3  # three LEDs, each three times
    few = [capture | {"id": f"{k}"} for k, capture in enumerate(few)]
    with pytest.raises(NotDetermined, match="narrowband light over the visible"):
        fit_spectral(
            RecordingSet(Manifest(cameras={"left": stated()}, captures=tuple(few)), frames, spectra), "left", NOISE
        )


def test_negative_light_is_left_out_and_named() -> None:
    base = recordings()
    wrong = base.spectrum("nb540.csv")
    spectra = {c.radiance: base.spectrum(c.radiance) for c in base.captures("narrowband")}
    spectra["nb540.csv"] = wrong.scale(-1.0)
    fit = fit_spectral(
        RecordingSet(base.manifest, {c.frame: base.frame(c) for c in base.captures()}, spectra), "left", NOISE
    )
    assert any("nb540.csv is left out" in remark for remark in fit.remarks)
    assert rms_of_peak_percent(fit, "G") < 2.0


def test_no_light_and_too_much_light_are_said() -> None:
    base = recordings(step_nm=40.0)
    darks = base.manifest.model_copy(update={"captures": tuple(base.captures("dark"))})
    frames = {c.frame: base.frame(c) for c in base.captures()}
    with pytest.raises(NotDetermined, match="no narrowband captures"):
        fit_spectral(RecordingSet(darks, frames), "left", NOISE)
    with pytest.raises(NotDetermined, match="unsaturated"):
        fit_spectral(recordings(exposure_s=8.0, step_nm=40.0), "left", NOISE)
    closed = frames | {c.frame: base.frame(base.captures("dark")[0]) for c in base.captures("narrowband")}
    spectra = {c.radiance: base.spectrum(c.radiance) for c in base.captures("narrowband")}
    with pytest.raises(NotDetermined, match="show no light"):
        fit_spectral(RecordingSet(base.manifest, closed, spectra), "left", NOISE)
    few = base.manifest.model_copy(
        update={"captures": (*base.captures("dark"), *base.captures("narrowband")[: MIN_LIGHTS - 1])}
    )
    with pytest.raises(NotDetermined, match=f"{MIN_LIGHTS - 1} different lights, {MIN_LIGHTS} needed"):
        fit_spectral(RecordingSet(few, frames, spectra), "left", NOISE)
    once = base.manifest.model_copy(
        update={
            "captures": tuple(
                c if c.kind == "dark" else c.model_copy(update={"radiance": "nb560.csv"}) for c in base.captures()
            )
        }
    )
    with pytest.raises(NotDetermined, match=f"1 different lights, {MIN_LIGHTS} needed"):
        fit_spectral(RecordingSet(once, frames, spectra), "left", NOISE)


def test_unknown_lens_is_said_and_counts_as_part_of_the_sensor() -> None:
    fit = fit_spectral(recordings(step_nm=20.0, camera=stated(lens_transmittance=None)), "left", NOISE)
    assert any("lens_transmittance" in remark for remark in fit.remarks)
    at = fit.wavelength_nm.index(540.0)
    truth = float(model().quantum_efficiency["G"].at(540.0))
    assert fit.quantum_efficiency["G"][at] == pytest.approx(0.9 * truth, rel=0.02)


@pytest.mark.parametrize("name", ["foreign_healthy", "foreign_two_effects"])
def test_another_image_formers_truth(name: str) -> None:
    if not (DATA / name).exists():
        pytest.skip("the shared recordings aren't here")
    truth = json.loads((DATA / name / "truth.json").read_text())
    recorded = read(DATA / name)
    fit = fit_spectral(recorded, "left", fit_noise(recorded, "left"))
    for channel in "RGB":
        curve = np.interp(fit.wavelength_nm, truth["wl"], truth["qe"][channel])
        rest = np.array(fit.quantum_efficiency[channel]) - curve
        assert np.sqrt(np.mean(rest**2)) < 0.02 * curve.max(), channel
        assert np.sqrt(np.mean((rest / np.array(fit.quantum_efficiency_std[channel])) ** 2)) < 2.0


def test_bands_that_part_are_found_where_they_are_and_nowhere_else() -> None:
    wave = np.arange(400.0, 721.0, 10.0)
    maker = np.concatenate([np.exp(-0.5 * ((wave - p) / 35.0) ** 2) for p in (600.0, 530.0, 460.0)])
    std = 0.003 * maker + 0.001
    rng = np.random.default_rng(8)
    off = maker.copy()
    off[wave.size + 8 : wave.size + 12] *= 1.06  # green, 480..510 nm
    scale, found = compare_curves(
        wave, "RGB", 0.4 * (off + std * rng.standard_normal(off.size)), np.diag((0.4 * std) ** 2), maker
    )
    assert scale == pytest.approx(0.4, rel=0.005)
    assert [d.channel for d in found] == ["G"]
    assert (found[0].from_nm, found[0].to_nm) == (pytest.approx(480.0, abs=10.0), pytest.approx(510.0, abs=10.0))
    # 4 % where an end of the band was missed.
    assert found[0].difference_percent == pytest.approx(6.0, abs=2.0)
    alarms = 0
    for _ in range(200):
        same = 0.4 * (maker + std * rng.standard_normal(maker.size))
        alarms += bool(compare_curves(wave, "RGB", same, np.diag((0.4 * std) ** 2), maker)[1])
    assert alarms <= 6  # 1 % of 200 are 2; 6 are exceeded by chance in 0.5 %
