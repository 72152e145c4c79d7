"""Codes in even light: converters' steps, combs and gaps, on cameras of the second image former and on drawn counts."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import AdcNonlinearityLaw, DigitalGainLaw, LossyCodesLaw, TreeRingsLaw
from lab.diagnose.inference.decide import decide
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from lab.formats.camera_model import camera_model
from lab.observables.charts.chart import measure_chart
from lab.observables.codes.density import measure_code_density
from lab.observables.codes.even_light import EvenLight, PatternSum
from lab.observables.codes.landings import widths
from lab.observables.darks.level import measure_dark
from lab.observables.dataset import Dataset
from lab.observables.flats.linearity import measure_photon_transfer
from lab.observables.flats.noise import measure_noise
from sim.effects.adc_ripple import AdcRipple
from sim.effects.bit_weights import BitWeights
from sim.effects.library import effect
from sim.spectrum import FloatArray
from sim.uniform import Uniform
from tests.lab.diagnose.on_blocks import dataset, rendered


def _dataset(seed: int, laws: Sequence[Law] = (), cfa: str | None = None) -> Dataset:
    recordings = recordings_of(
        ConcealedCamera(seed, laws, cfa=cfa, rows=96, cols=128), Plan(("dark", "flat", "narrowband"))
    )
    return Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))


@pytest.mark.parametrize("seed", [772011, 772012, 772013])
def test_even_converters_show_nothing(seed: int) -> None:
    """chi2 of n numbers over n: 1 within 3 sqrt(2 / n) above, and no place stands out."""
    dataset = _dataset(seed)
    block = measure_code_density(dataset)
    chi2 = float(block.value @ np.linalg.solve(block.covariance, block.value)) / len(block.value)
    assert chi2 < 1.0 + 3.0 * np.sqrt(2.0 / len(block.value))
    model = MeasurementModel((block,), dataset.camera)
    assert not mismatches(model, model.gaussian(), DecisionPolicy())


def _drawn_light(frames: int, pattern: FloatArray, rng: np.random.Generator) -> tuple[EvenLight, FloatArray]:
    """Light of `frames` drawn frames of one setting without black level, and the counts of their codes: 1000 DN times
    `pattern` (rows, cols), with normal noise of 12 DN."""
    drawn = np.rint(1000.0 * pattern + rng.normal(0.0, 12.0, (frames, *pattern.shape))).astype(np.float32)
    found, light = PatternSum(), EvenLight(0.0)
    for plane in drawn:
        found.add(plane, 0.0)
    for plane in drawn:
        light.add(plane, found.sensitivity())
    return light, np.bincount(drawn.astype(int).ravel(), minlength=2000).astype(float)


@pytest.mark.parametrize("frames", [4, 16])
def test_expected_counts_are_spread_as_the_frames_are(frames: int) -> None:
    """Rings of 3 % and a period of 14 pixels, with a defect of -40 % in a thousand pixels: expected and counted codes
    have equal mean and variance, and the same share about every tenth of the range. n frames have 1 / n of their noise
    in the sensitivities. Of N pixels the mean is known to s / sqrt(N), but both are of the same pixels: so are the
    shares, whose difference is smaller than 3 sqrt(q / N) of share q."""
    rng = np.random.default_rng(3)
    row, col = np.mgrid[:96, :128]
    pattern = 1.0 + 0.03 * np.cos(2.0 * np.pi * np.hypot(row + 20.0, col + 30.0) / 14.0)
    pattern[rng.integers(0, 96, 12), rng.integers(0, 128, 12)] *= 0.6
    light, counted = _drawn_light(frames, pattern, rng)
    expected = light.counts(gain=1e-6, codes=2000).expected()
    number, code = counted.sum(), np.arange(2000)
    assert expected.sum() == pytest.approx(number, rel=1e-6)
    for weight in (code, np.square(code - 1000.0)):
        scatter = np.sqrt(counted @ np.square(weight - counted @ weight / number) * number) / number
        assert expected @ weight / number == pytest.approx(counted @ weight / number, abs=0.1 * scatter)
    shares, others = (counts[940:1060].reshape(12, 10).sum(axis=1) for counts in (counted, expected))
    assert np.all(np.abs(shares - others) < 3.0 * np.sqrt(others))


@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
def test_strong_tree_rings_are_no_structure_of_the_codes(cfa: str) -> None:
    """Rings of 3 %, some 15 pixels wide, of levels that shade: half of them is finer than local means, half is not, and
    both rise and fall together. chi2 of n numbers over n: 1 within 3 sqrt(2 / n) above, and nothing stands out."""
    camera = ConcealedCamera(772302, (TreeRingsLaw(3.0),), cfa=cfa, rows=128, cols=192)
    recordings = recordings_of(camera, Plan(("dark", "flat", "narrowband")))
    block = measure_code_density(Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True)))
    chi2 = float(block.value @ np.linalg.solve(block.covariance, block.value)) / len(block.value)
    assert chi2 < 1.0 + 3.0 * np.sqrt(2.0 / len(block.value))


def test_a_fixed_pattern_is_no_step_of_the_converter() -> None:
    """Sensitivities as a wave of 5 by 7 pixels and 1.5 %, and one pixel in a thousand down by up to 30 %, on even
    converters: departures from local means have an excess kurtosis near -0.5, and defects. chi2 of n numbers over n: 1
    within 3 sqrt(2 / n) above; a step of 4 DN on the same pattern is as large as predicted, within 3.5 standard
    uncertainties."""
    seed, rows, cols = 772302, 192, 256
    row, col = np.mgrid[:rows, :cols]
    pattern = 1.0 + 0.015 * np.sin(2.0 * np.pi * (row / 5.3 + col / 7.1))
    rng = np.random.default_rng(5)
    at = rng.integers(0, rows, 50), rng.integers(0, cols, 50)
    pattern[at] *= rng.uniform(0.7, 1.0, 50)
    for laws in ((), (AdcNonlinearityLaw(4.0, 0, 2),)):
        camera = ConcealedCamera(seed, laws, cfa="MONO", rows=rows, cols=cols)
        camera.prnu_map = pattern
        block = measure_code_density(dataset(recordings_of(camera, Plan(("dark", "flat")))))
        told = block.predict(tuple(effect("adc_nonlinearity")(error_dn=law.signed_strength) for law in laws)).mean
        rest = block.value - told
        if not laws:
            assert rest @ np.linalg.solve(block.covariance, rest) / len(rest) < 1.0 + 3.0 * np.sqrt(2.0 / len(rest))
            continue
        middle = [i for i, label in enumerate(block.labels) if label.channel == "step" and label.x == 2048.0]
        assert middle
        assert np.all(np.abs(told[middle]) > 5.0 * np.sqrt(np.diag(block.covariance)[middle]))
        assert np.all(np.abs(rest[middle]) < 3.5 * np.sqrt(np.diag(block.covariance)[middle]))


@pytest.mark.parametrize("step_dn", [0.0, 3.0])
def test_steps_scatter_about_the_true_law_as_their_covariance_says(step_dn: float) -> None:
    """Three cameras of 192 x 256 px without and with a step of 3 DN, some 420 places: chi2 is their number within
    3 sqrt(2 n), the law's second order included."""
    total, number = 0.0, 0
    for seed in (21, 22, 23):
        law = AdcNonlinearityLaw(step_dn, 4, 2)
        acting = effect("adc_step")(step_dn=law.signed_strength, code_dn=4096.0 * (0.15 + 0.6 * law.uniform[1]))
        former = ConcealedCamera(seed, (law,) if step_dn else (), rows=192, cols=256, bit_depth=12)
        recordings = recordings_of(former, Plan(("dark", "flat", "narrowband")))
        at = Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))
        block = measure_code_density(at)
        steps = [k for k, label in enumerate(block.labels) if label.channel == "step"]
        away = (block.value - block.predict((acting,) if step_dn else ()).mean)[steps]
        total += float(away @ np.linalg.solve(block.covariance[np.ix_(steps, steps)], away))
        number += len(steps)
    assert abs(total - number) < 3.0 * np.sqrt(2.0 * number)


def test_steps_are_measured_where_they_stand() -> None:
    """A highest bit that is 3 DN too heavy leaves 3 codes out at half scale: within 3.5 of the standard uncertainties
    and its law's tolerance, seen and held out. Places at 8 DN of 4096 and more beyond it see none of it."""
    law = AdcNonlinearityLaw(3.0, 0, 2)
    dataset = _dataset(772302, (law,))
    block = measure_code_density(dataset)
    std = np.sqrt(np.diag(block.covariance))
    expected = block.predict((effect("adc_nonlinearity")(error_dn=law.signed_strength),)).mean
    spacing = 4096 / 128
    steps = [i for i, label in enumerate(block.labels) if label.channel == "step"]
    beside = [i for i in steps if abs(block.labels[i].x - 2048.0) <= 4 * spacing]
    middle = [i for i in steps if block.labels[i].x == 2048.0]
    assert len(middle) == 2
    # half of a hat of 32 codes about the gap's two halves: all but 1.5 of 32 codes of it
    assert expected[middle] == pytest.approx(law.signed_strength, rel=0.3)
    for i in steps:
        allowed = np.hypot(3.5 * std[i], 0.2 * expected[i])
        assert abs(block.value[i] - (expected[i] if i in beside else 0.0)) < allowed, block.labels[i]


@pytest.mark.parametrize("variant", [0, 1])
def test_wrong_bits_are_named(variant: int) -> None:
    law = AdcNonlinearityLaw(4.0, variant, 2)
    dataset = _dataset(772302, (law,))
    blocks = (measure_photon_transfer(dataset), measure_noise(dataset), measure_code_density(dataset))
    verdict = decide(MeasurementModel(blocks, dataset.camera), np.random.default_rng(0), DecisionPolicy())
    assert [c.effect.name for c in verdict.named] == ["adc_nonlinearity"]
    found, std = verdict.named[0].effect.model_dump(), verdict.named[0].std["error_dn"]
    assert std is not None
    assert abs(found["error_dn"] - law.signed_strength) < 3.0 * std


def test_a_step_at_any_code_is_named() -> None:
    """A comparator that is off by 4 DN at 1664 codes: no bit stands there, and no response to light does that to
    histograms. Height and place within three standard deviations; the place is looked for from 64 codes apart, and told
    to a few."""
    law = AdcNonlinearityLaw(4.0, 4, 7)
    place = 4096.0 * (0.15 + 0.6 * law.uniform[1])
    dataset = _dataset(772302, (law,))
    blocks = (measure_photon_transfer(dataset), measure_noise(dataset), measure_code_density(dataset))
    verdict = decide(MeasurementModel(blocks, dataset.camera), np.random.default_rng(0), DecisionPolicy())
    assert [c.told_name for c in verdict.named] == ["adc_step"]
    found, std = verdict.named[0].effect.model_dump(), verdict.named[0].std
    assert abs(found["code_dn"] - place) < 3.0 * (std["code_dn"] or 0.0)
    assert (std["code_dn"] or np.inf) < 4096 / 128
    assert abs(found["step_dn"] - law.signed_strength) < 3.0 * (std["step_dn"] or 0.0)


@pytest.mark.parametrize("law", [DigitalGainLaw(10.0), LossyCodesLaw(0.05)], ids=lambda law: law.name)
def test_other_combs_are_located_and_at_most_their_family_is_named(law: Law) -> None:
    dataset = _dataset(772021, (law,))
    model = MeasurementModel((measure_code_density(dataset),), dataset.camera)
    verdict = decide(model, np.random.default_rng(0), DecisionPolicy())
    assert verdict.before[0].block.measurement.name == "code_density"
    assert {c.told_name for c in verdict.named} <= {"converter"}


def test_unequal_codes_show_alike_in_seen_and_in_held_out_frames() -> None:
    """Over the block's scale, which holds the number of counted pixels, the counts' excess variance is the variance of
    the codes' widths. A gain of 1.1 leaves one code of eleven out and makes the others 1.1 wide: 1.1^2 10 / 11 - 1 =
    0.1. Filters and unequal counts add some per cent, which a part of a few hundred codes knows to 3 sqrt(2 / 300) = 25
    %."""
    block = measure_code_density(_dataset(772302, (DigitalGainLaw(10.0),)))
    at = [i for i, label in enumerate(block.labels) if label.channel == "variance"]
    held_out = np.array([block.labels[i].held_out for i in at])
    assert block.value[at][~held_out].mean() > 1.5 * block.value[at][held_out].mean()
    assert block.value[at] / block.scale[at] == pytest.approx(np.full(len(at), 0.1), rel=0.25)


def test_the_excess_of_unequal_codes_scatters_as_a_noncentral_chi2() -> None:
    """Of six cameras with widths of 1.4, 0.3, 1.4 and 0.9: the mean square of N = 48 pulls of the excess variance under
    the true law is below 1 + 4 sqrt(2 / N). Their excess is up to 900 standard deviations of an even converter's, which
    would scatter a tenth as much."""
    law, pulls = BitWeights(last_dn=0.4, second_dn=-0.3), list[float]()
    for seed in range(6):
        block = measure_code_density(dataset(rendered(900 + seed, (law,))))
        told = block.predict((law,))
        std = np.sqrt(np.diag(block.covariance) + np.square(list(told.jacobian.values())).sum(axis=0))
        of_variance = [label.channel == "variance" for label in block.labels]
        pulls += ((block.value - told.mean) / std)[of_variance].tolist()
    assert np.mean(np.square(pulls)) < 1.0 + 4.0 * np.sqrt(2.0 / len(pulls))


@pytest.mark.parametrize("variant", [2, 3])
def test_a_ripple_is_named_and_a_saw_tooth_is_the_converter(variant: int) -> None:
    """2.5 DN sin(2 pi code / 512 + phase): amplitude and period within three standard deviations. A saw tooth over 1024
    codes is off by its converter's gain where a boundary stands: its bits' weights are the nearest law, or hold."""
    law = AdcNonlinearityLaw(2.5 if variant == 2 else 5.0, variant, 3)
    dataset = _dataset(772302, (law,))
    blocks = (measure_photon_transfer(dataset), measure_noise(dataset), measure_code_density(dataset))
    verdict = decide(MeasurementModel(blocks, dataset.camera), np.random.default_rng(0), DecisionPolicy())
    assert [type(c.effect).family.value for c in verdict.named] == ["converter"]
    if variant == 3:
        assert verdict.named[0].effect.name == "adc_nonlinearity"
        return
    found, std = verdict.named[0].effect, verdict.named[0].std
    assert isinstance(found, AdcRipple)
    assert verdict.named[0].told_name == "adc_ripple"
    amplitude = np.hypot(found.sine_dn, found.cosine_dn)
    assert abs(amplitude - 2.5) < 3.0 * np.hypot(std["sine_dn"] or 0.0, std["cosine_dn"] or 0.0)
    assert abs(found.period_dn - 512.0) < 3.0 * (std["period_dn"] or 0.0)


def test_codes_are_averaged_over_noise_in_a_mean() -> None:
    """Far from its step a converter's error is itself; on it, half; offset and gain as without."""
    camera = _dataset(772011, cfa="MONO").camera
    one = effect("adc_nonlinearity")(error_dn=4.0)
    for level, wanted in ((1000.0, -4.0 * 1000.0 / 4096.0), (2048.0, 2.0 - 2.0), (3000.0, 4.0 - 4.0 * 3000.0 / 4096.0)):
        electrons = np.array([(level - camera.black_level_dn) / camera.conversion_gain_dn_per_e])
        plain, coded = (Uniform(camera, acting).mean_dn({"Y": electrons})["Y"] for acting in ((), (one,)))
        assert coded - plain == pytest.approx(wanted, abs=0.1)  # 48 values stand for the noise: 4 DN / 48


def test_what_the_converter_does_at_black_moves_darks_as_all_other_levels() -> None:
    """A ripple of 16 times the range is nearly an offset: of darks and flats alike, so that the black level takes it
    up. One of a quarter of the range moves darks by its value there, averaged over their noise."""
    dataset = _dataset(7)
    white, wide = dataset.camera.white_level_dn, AdcRipple(cosine_dn=0.5, period_dn=65536.0)
    for make in (measure_dark, measure_photon_transfer):
        block = make(dataset)
        before = block.predict(()).mean
        wanted = 0.5 * np.cos(2.0 * np.pi * before / wide.period_dn)
        np.testing.assert_allclose(block.predict((wide,)).mean - before, wanted, atol=2e-3)
    dark, short = measure_dark(dataset), AdcRipple(sine_dn=0.4, cosine_dn=0.3, period_dn=0.25 * white)
    before = dark.predict(()).mean
    turn = 2.0 * np.pi * before / short.period_dn
    blurred = np.exp(-0.5 * (2.0 * np.pi * dataset.noise.gain * dataset.camera.read_noise_e / short.period_dn) ** 2)
    wanted = blurred * (0.4 * np.sin(turn) + 0.3 * np.cos(turn))
    np.testing.assert_allclose(dark.predict((short,)).mean - before, wanted, atol=1e-3)


def test_patches_of_a_chart_lie_off_by_what_the_converter_does_at_their_level() -> None:
    """A ripple of a quarter of the range: its value at each patch, averaged over the noise there. The mean over noise
    by 48 values is good to 1e-3; levels that shot noise and shading move by less than 1e-3 of a period aren't
    counted."""
    recordings = recordings_of(ConcealedCamera(7, (), cfa="RGGB", rows=96, cols=128), Plan(("dark", "flat", "chart")))
    looked_at = Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))
    block, white = measure_chart(looked_at), looked_at.camera.white_level_dn
    ripple = AdcRipple(sine_dn=0.4, cosine_dn=0.3, period_dn=0.25 * white)
    before, gain = block.predict(()).mean, looked_at.noise.gain
    noise_dn = gain * np.sqrt((before - looked_at.noise.black) / gain + looked_at.camera.read_noise_e**2)
    turn = 2.0 * np.pi * before / ripple.period_dn
    blurred = np.exp(-0.5 * (2.0 * np.pi * noise_dn / ripple.period_dn) ** 2)
    wanted = blurred * (0.4 * np.sin(turn) + 0.3 * np.cos(turn))
    np.testing.assert_allclose(block.predict((ripple,)).mean - before, wanted, atol=2e-3)


def test_widths_of_codes_are_what_fine_samples_of_the_input_give() -> None:
    """A step between two codes, a step of many, a saw tooth of three bits and a ripple with a step, against 512 samples
    a code: an interval that straddles a step is sampled 64 times, so that a width is off by 1 / 64 of a code at most,
    and by less than 1e-3 elsewhere."""
    dataset = _dataset(7)
    first, size = 300, 3000
    codes = SimpleNamespace(count=np.zeros(size), first=first)
    steps = effect("adc_step")
    laws = (
        (steps(step_dn=-2.3, code_dn=1234.2),),
        (steps(step_dn=17.0, code_dn=2048.0),),
        (effect("adc_nonlinearity")(error_dn=4.0),),
        (AdcRipple(sine_dn=1.0, period_dn=256.0), steps(step_dn=0.7, code_dn=900.0)),
    )
    x = (np.arange((size + 200) * 512) + 0.5) / 512 - 0.5 + first - 100
    for acting in laws:
        landed = np.rint(Uniform(dataset.camera, acting).codes(x)).astype(int) - first
        wanted = np.bincount(landed[(landed >= 0) & (landed < size)], minlength=size) / 512
        off = np.abs(widths(codes, acting, dataset) - wanted)  # type: ignore[arg-type]
        assert off.max() < 1.0 / 64.0 + 1e-3
        assert np.sum(off > 5e-3) <= 8
