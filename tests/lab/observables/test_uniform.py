"""Levels of flat fields and narrowband light: nonlinearity, drift and wrong wavelengths are told apart, with right
covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import (
    AbsorptionBandLaw,
    CoverGlassFringeLaw,
    ExposureOffsetLaw,
    NonlinearityLaw,
    RedLeakLaw,
    SourceBandwidthLaw,
    SourceDriftLaw,
    StrayLightLaw,
    WavelengthOffsetLaw,
)
from lab.diagnose.inference.side_model import measurement_model
from lab.observables.codes.rounding import rounding_std_dn
from lab.observables.darks.frames import cell_means
from lab.observables.darks.level import added_dark_dn, dark_current_map
from lab.observables.flats.field import measure_flat_field
from lab.observables.flats.linearity import measure_photon_transfer
from lab.observables.gaussian import chi2
from lab.observables.noise.repeatability import level_repeatability, repeated_levels
from lab.observables.spectra.light_readings import (
    MOST_SAMPLE_STD,
    RADIOMETER_STD,
    READING_SAMPLE_STD,
    READING_STD,
    reading_std,
    sample_std,
)
from lab.observables.spectra.narrowband import measure_narrowband
from sim.effects.amplifier_glow import AmplifierGlow
from sim.effects.image_lag import ImageLag
from sim.effects.persistence import Persistence
from sim.effects.second_order_light import SecondOrderLight
from sim.spectrum import Spectrum
from sim.uniform import Uniform
from tests.lab.diagnose.on_blocks import UNIFORM, dataset, former, measured_model, names, rendered, sigmas, verdict

LEVELS: list[tuple[Law, bool]] = [
    (law, shuttle)
    for shuttle in (False, True)
    for law in (SourceDriftLaw(0.1, 0, 1), SourceDriftLaw(0.2, 1, 1), NonlinearityLaw(0.5, 1), ExposureOffsetLaw(2.0))
]


@pytest.mark.parametrize(
    ("law", "shuttle"),
    [*LEVELS[:1], *(pytest.param(*case, marks=pytest.mark.slow) for case in LEVELS[1:])],
    ids=lambda value: f"{value.name}-{value.variant}" if isinstance(value, Law) else f"shuttle-{value}",
)
def test_effects_on_levels_are_told_apart(law: Law, shuttle: bool) -> None:
    """A series of levels upwards only, in which time and level go together except in repeats; and one up and down. The
    cells of the flats say that no row has more time than another."""
    found = verdict(former(31, law, shuttle=shuttle), measure_photon_transfer, measure_flat_field)
    assert names(found) == [law.effect]
    for name, value in law.library_parameters().items():
        std = found.named[0].std[name]
        assert std is not None
        assert abs(found.named[0].effect.model_dump()[name] - value) < 3.5 * std


@pytest.mark.parametrize(
    "law",
    [
        StrayLightLaw(0.8, 1),
        CoverGlassFringeLaw(2.0, 0, 3),
        pytest.param(SourceBandwidthLaw(3.0, 1), marks=pytest.mark.slow),
        pytest.param(WavelengthOffsetLaw(-0.5, 0), marks=pytest.mark.slow),
    ],
    ids=lambda law: law.name,
)
def test_effects_on_narrowband_light_are_told_apart(law: Law) -> None:
    found = verdict(former(32, law, cfa="RGGB", kinds=UNIFORM), measure_photon_transfer, measure_narrowband)
    assert names(found) == [law.effect]


@pytest.mark.parametrize(
    "law",
    [AbsorptionBandLaw(3.0, 0, 3), pytest.param(RedLeakLaw(8.0, 0, 3), marks=pytest.mark.slow)],
    ids=lambda law: law.name,
)
def test_structure_that_no_law_has_is_located_and_gets_no_name(law: Law) -> None:
    """The red leak of a MONO sensor isn't told by its colour: the radiometer's law explained a part of it, and left
    more."""
    cfa = "MONO" if isinstance(law, RedLeakLaw) else "RGGB"
    found = verdict(former(33, law, cfa=cfa, kinds=UNIFORM), measure_photon_transfer, measure_narrowband)
    assert not found.named
    assert {s.block.measurement.name for s in found.before} == {"narrowband"}


def test_second_order_light_shows_where_half_the_wavelength_is_seen() -> None:
    """A sweep to 900 nm: beyond 800 nm a line at half the wavelength is visible. Share within 3 standard
    uncertainties."""
    truth = SecondOrderLight(share_percent=3.0)
    found = verdict(rendered(6, (truth,), sweep_to_nm=900, repeats=2), measure_photon_transfer, measure_narrowband)
    assert names(found) == ["second_order_light"]
    std = found.named[0].std["share_percent"]
    assert std is not None
    assert abs(found.named[0].effect.model_dump()["share_percent"] - 3.0) < 3.0 * std


def test_healthy_levels_agree_with_their_covariance() -> None:
    """4 cameras: no more than noise; less, as a few numbers in ten are free."""
    for seed, cfa in ((1, "MONO"), (2, "RGGB"), (3, "GBRG"), (4, "MONO")):
        found = measured_model(former(seed, cfa=cfa, kinds=UNIFORM), measure_photon_transfer, measure_narrowband)
        assert -6.0 < sigmas(found) < 3.0


def test_a_drifting_lamp_is_repeatable() -> None:
    """0.5 % a minute makes repeats differ by 0.17 %; a trend common to all levels leaves the repeatability that there
    was, 0."""
    for shuttle in (False, True):
        looked_at = dataset(former(34, SourceDriftLaw(0.5), shuttle=shuttle))
        noise = looked_at.noise
        found = level_repeatability(repeated_levels(looked_at, noise.black, noise.gain, noise.read_dn))
        assert found < 4e-4


class _Reading:
    """The keys of a capture that the standard deviation of readings depends on."""

    def __init__(self, name: str, wavelength_nm: float) -> None:
        self.id, self.wavelength_nm = name, wavelength_nm


@pytest.mark.parametrize("std", [0.0, 1e-3, 0.02])
def test_standard_deviation_of_readings_is_measured_and_capped(std: float) -> None:
    """From 60 second differences, the median modulus is good to 20 %; the cap is the largest noise that a radiometer
    may have."""
    rng = np.random.default_rng(7)
    points = [(_Reading(f"c{i}", 400.0 + 5.0 * i), "Y") for i in range(62)]
    signal = 1e4 * (1.0 + std * rng.standard_normal(62))
    found = reading_std(points, signal, np.full(62, 1e-2), np.full(62, 1e4))
    assert found == pytest.approx(min(max(std, READING_STD), RADIOMETER_STD), rel=0.4)


def test_rounding_moves_means_of_quiet_pixels_only() -> None:
    """Means of 4000 rounded normal numbers of spread 0.3 about levels over one code: root mean square within 10 %."""
    rng = np.random.default_rng(8)
    level = np.arange(50) / 50
    error = np.round(level[:, None] + 0.3 * rng.standard_normal((50, 4000))).mean(1) - level
    assert np.sqrt(np.mean(error**2)) == pytest.approx(rounding_std_dn(np.array(0.09)), rel=0.1)
    assert rounding_std_dn(np.array(1.0)) < 1e-8


@pytest.mark.parametrize("std", [0.0, 1.5e-3, 0.02])
def test_standard_deviation_within_readings_is_measured_and_capped(std: float) -> None:
    """24 pairs of some 16 samples: their median is good to 5 %. A level that changed between two readings is none."""
    rng = np.random.default_rng(8)
    wavelength = np.arange(540.0, 581.0)
    line = np.exp(-0.5 * ((wavelength - 560.0) / 4.0) ** 2)
    pairs = [
        [Spectrum.of(wavelength, level * line * (1.0 + std * rng.standard_normal(41))) for level in (1.0, 1.1)]
        for _ in range(24)
    ]
    assert sample_std(pairs) == pytest.approx(min(std, MOST_SAMPLE_STD), rel=0.15, abs=1e-12)
    assert sample_std(readings[:1] for readings in pairs) == READING_SAMPLE_STD


def test_a_warmer_frame_s_dark_current_is_free() -> None:
    """A tenth of the dark current for each degree above the dark frames; nothing where no temperature is stated."""
    recordings = former(35, kinds=UNIFORM)
    looked_at = dataset(recordings)
    capture = recordings.captures("narrowband")[0]
    assert looked_at.noise.dark_c is not None
    warm = capture.model_copy(update={"temperature_c": looked_at.noise.dark_c + 3.0})
    slope = looked_at.free_warmth([capture.model_copy(update={"temperature_c": None}), warm])["warmth"]
    assert slope == pytest.approx([0.0, 0.3 * looked_at.noise.dark_dn_per_s * capture.exposure_s])
    looked_at.noise = replace(looked_at.noise, dark_c=None)
    assert looked_at.free_warmth([capture]) == {}


def test_after_dummy_frames_image_lag_holds_nothing_of_the_capture_before() -> None:
    at = dataset(rendered(3))
    bright, dark = at.recordings.captures("flat", "left")[-1], at.recordings.captures("dark", "left")[0]
    lag = (ImageLag(lag_percent=2.0),)
    assert at.carried_e(lag)(bright, at.channels[0]) != 0.0
    manifest = at.recordings.manifest
    after = [c.model_copy(update={"dummy_frames": 2}) for c in manifest.captures]
    at.recordings.manifest = manifest.model_copy(update={"captures": tuple(after)})
    again = dataset(at.recordings)
    for capture in (bright, dark):
        assert again.carried_e(lag)(capture, again.channels[0]) == 0.0


def test_traps_fill_with_measured_levels_and_dummy_frames() -> None:
    """As `Uniform.released_e` says of the levels that were read; two dummy frames before each flat fill traps, too.
    Without times nothing is known."""
    camera = ConcealedCamera(35, cfa="MONO", rows=96, cols=128)
    at = dataset(recordings_of(camera, Plan(UNIFORM, dark_again=True)))
    traps = (Persistence(share_percent=2.0, release_s=30.0),)
    last, channel = at.recordings.captures("dark")[-1], at.channels[0]
    order = sorted(at.recordings.captures(), key=at.elapsed_s)
    before = [c for c in order if at.elapsed_s(c) < at.elapsed_s(last)]
    wanted = dummies = 0.0
    for c in before:
        read_e = (at.levels(c).whole[channel] - at.noise.black) / at.noise.gain
        ended_s = at.elapsed_s(last) - at.elapsed_s(c) - c.exposure_s
        taken = 0.02 * max(read_e, 0.0) * (np.exp(-ended_s / 30.0) - np.exp(-(ended_s + last.exposure_s) / 30.0))
        wanted += taken
        if c.kind == "flat":
            dummies += taken * (np.exp(-c.exposure_s / 30.0) + np.exp(-2.0 * c.exposure_s / 30.0))
    assert wanted > 0.1
    assert at.carried_e(traps)(last, channel) == pytest.approx(wanted, rel=1e-9)

    manifest = at.recordings.manifest
    two = [c.model_copy(update={"dummy_frames": 2 if c.kind == "flat" else None}) for c in manifest.captures]
    at.recordings.manifest = manifest.model_copy(update={"captures": tuple(two)})
    assert dataset(at.recordings).carried_e(traps)(last, channel) == pytest.approx(wanted + dummies, rel=1e-9)

    undated = [c.model_copy(update={"time": None}) for c in manifest.captures]
    at.recordings.manifest = manifest.model_copy(update={"captures": tuple(undated)})
    assert dataset(at.recordings).carried_e(traps)(last, channel) == 0.0


def test_a_glow_that_brightens_darks_brightens_light_frames_as_much() -> None:
    """Dark current is one nuisance parameter of darks, flats and narrowband light: what an effect adds is the same in
    all."""
    at = dataset(rendered(3))
    glow = (AmplifierGlow(glow_e_per_s=40.0, reach_mm=0.3),)
    more = added_dark_dn(at, glow)
    block = measure_photon_transfer(at)
    change = block.predict(glow).mean - block.predict(()).mean
    captures = {c.id: c for c in at.recordings.captures("flat", "left")}
    wanted = [more(captures[label.captures[0]]) for label in block.labels]
    assert min(wanted) > 0.0
    np.testing.assert_allclose(change, wanted, rtol=1e-9)


def test_a_dark_current_over_the_field_is_that_of_the_pixels() -> None:
    """A coarse grid would move the glow's corner and the cells' borders: by 4 % of a cell's mean at 8 px a point."""
    at = dataset(rendered(3))
    glow = (AmplifierGlow(glow_e_per_s=60.0, reach_mm=0.5, corner="bottom_right"),)
    at.camera = at.camera.model_copy(update={"rows": 384, "cols": 512})
    found = cell_means(dark_current_map(at, glow)(None).astype(np.float32))
    expected = cell_means(Uniform(at.camera, glow).dark_e_per_s(None).astype(np.float32))
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
@pytest.mark.parametrize("side_px", [16, 24])
def test_frames_of_few_pixels_are_judged_or_skipped(cfa: str, side_px: int) -> None:
    camera = ConcealedCamera(4, cfa=cfa, rows=side_px, cols=side_px)
    recordings = recordings_of(camera, Plan(UNIFORM))
    model, _ = measurement_model(recordings, "left")
    assert model is not None
    gaussian = model.gaussian()
    assert np.isfinite(chi2(model.value - gaussian.mean, gaussian.covariance))
