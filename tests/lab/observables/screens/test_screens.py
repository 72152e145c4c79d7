"""Patterns on screens: no finding on healthy cameras, and concealed effects of the second image former in the right
measurement."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator import laws as concealed
from lab.diagnose.inference.decide import Verdict, decide
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import refit
from lab.diagnose.policy import DecisionPolicy
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from lab.observables.charts.chart import measure_chart
from lab.observables.dataset import Dataset
from lab.observables.edges.slanted_edge import measure_slanted_edge
from lab.observables.observable import Observable, measurements
from lab.observables.screens.bands import GHOST, PlacedPattern
from lab.observables.screens.cell_borders import measure_cell_borders
from lab.observables.screens.contrast import measure_bernoulli
from lab.observables.screens.dark_squares import measure_screen
from lab.observables.screens.ghost import measure_ghost
from lab.observables.screens.lateral_colour import measure_lateral_colour
from lab.observables.screens.patterns import patterns
from lab.observables.screens.pixel_grid import measure_screen_grid
from lab.observables.surroundings import Surroundings, harmonics
from sim.effects.charge_diffusion import ChargeDiffusion
from sim.effects.defocus import Defocus
from sim.effects.ghost import Ghost
from sim.effects.moffat_blur import MoffatBlur
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from sim.effects.pixel_aperture import PixelAperture
from sim.effects.screen_gamma import ScreenGamma
from sim.point import halos
from tests.lab.diagnose.on_blocks import former, names, verdict

OF_SCREENS = [one for one in measurements() if 400 < one.order < 500]
PLAN = Plan(kinds=("dark", "flat", "screen"))


@cache
def recorded(*laws: Law, seed: int = 61, cfa: str = "GRBG", plan: Plan = PLAN) -> RecordingSet:
    return recordings_of(ConcealedCamera(seed, laws, cfa=cfa, f_number=2.8, rows=96, cols=128), plan)


def dataset_of(recordings: RecordingSet) -> Dataset:
    return Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))


@cache
def shared_study(*laws: Law) -> Dataset:
    """Of the camera that most tests look at: its patterns are fitted once for each law."""
    return dataset_of(recorded(*laws))


def measured_model(dataset: Dataset, make: Callable[[Dataset], Observable]) -> MeasurementModel:
    return MeasurementModel((make(dataset),), dataset.camera)


def verdict_of(dataset: Dataset, without: str = "") -> Verdict:
    blocks = []
    for measurement in OF_SCREENS:
        if measurement.name == without:
            continue
        try:
            blocks.append(measurement.make(dataset))
        except NotDetermined:
            continue
    return decide(MeasurementModel(tuple(blocks), dataset.camera), np.random.default_rng(3), DecisionPolicy())


@pytest.mark.parametrize(("seed", "cfa"), [(62, "MONO"), (63, "RGGB")])
def test_a_healthy_camera_keeps_the_contrast_that_the_model_says(seed: int, cfa: str) -> None:
    verdict = verdict_of(dataset_of(recorded(seed=seed, cfa=cfa)))
    assert not verdict.named
    assert not verdict.abstained
    assert not verdict.before
    block = verdict.model.blocks[0]
    gaussian = verdict.model.gaussian()
    at = verdict.model.slices[0]
    residual = (verdict.model.value - gaussian.mean)[at]
    chi2 = float(residual @ np.linalg.solve(gaussian.covariance[at, at], residual))
    # floors make it less than n; above it the noise's covariance would be too small: 4 sigma of a chi2 of n numbers
    assert chi2 < len(block.value) + 4 * np.sqrt(2 * len(block.value))


STEEP_GAMMA, LATERAL_COLOUR = concealed.ScreenGammaLaw(4.0, 1, 5), concealed.LateralColourLaw(3.0, 0, 5)
FOUND: list[tuple[Law, str]] = [
    (concealed.GhostLaw(0.6, 0, 5), "ghost"),
    (concealed.GhostLaw(2.0, 1, 5), "ghost"),
    (concealed.ScreenPixelStructureLaw(8.0, 0, 5), "screen_pixel_structure"),
    (concealed.ScreenGammaLaw(1.5, 0, 5), "screen_gamma"),
    (STEEP_GAMMA, "screen_gamma"),
    (LATERAL_COLOUR, "lateral_chromatic_aberration"),
]


@pytest.mark.parametrize(
    ("law", "name"),
    [  # of two variants of a law one is enough for every day
        pytest.param(law, name, id=f"{law.name}-{law.variant}", marks=pytest.mark.slow if law.variant else ())
        for law, name in FOUND
    ],
)
def test_what_a_screen_shows_is_named(law: Law, name: str) -> None:
    # this former moves a channel's image as a whole, without the blur by the light's width that the effect has
    verdict = verdict_of(shared_study(law), without="bernoulli" if law is LATERAL_COLOUR else "")
    assert [c.effect.name for c in verdict.named] == [name]


def test_a_screen_that_fills_the_frame_lights_dark_squares_from_beyond() -> None:
    """The former's screen continues beyond the frame; the uncertainty of its light is half of what an endless screen
    would add."""
    found = measured_model(shared_study(), measure_screen)
    gaussian = found.gaussian()
    away = (found.value - gaussian.mean) / np.sqrt(np.diag(gaussian.block_covariance(0)))
    assert np.all(np.abs(away) < 1.5)


def test_a_ghost_brightens_dark_squares() -> None:
    """A ghost: 1 % of the image rotated by 180 degrees. A dark square gets between 0 and 1 % of the brightest light."""
    block = measured_model(shared_study(), measure_screen).blocks[0]
    more = block.predict((Ghost(share_percent=1.0),)).mean - block.predict(()).mean
    assert np.all(more > 0.0)
    assert np.all(more < 0.011 * block.scale)


def test_lopsided_points_are_no_ghost(monkeypatch: pytest.MonkeyPatch) -> None:
    """An odd change of the OTF in rings of the fit, along rows, doesn't move the ghost's coefficient."""
    fits: list[Any] = []
    made = PlacedPattern.regress

    def regress(*arguments: Any, **keys: Any) -> Any:
        fits.append(made(*arguments, **keys))
        return fits[-1]

    monkeypatch.setattr(PlacedPattern, "regress", regress)
    patterns(dataset_of(recorded(seed=64)))
    assert fits
    for fit in fits:
        design, canvas, transfer = fit.design, fit.design.canvas, fit.placed.transfer
        fy, fx = canvas.frequencies
        ring, along_rows = np.hypot(fx, fy), np.abs(np.arctan2(fy, fx + 0.0 * fy)) < np.pi / 8
        passed = canvas.passed(transfer, transfer.fill_factor)
        odd = np.where(along_rows & (ring >= 0.08) & (ring < 0.42), 0.1j * canvas.low * passed, 0.0)
        change = canvas.picture(odd)[design.mask]
        assert np.std(change) > 1e-3
        assert abs(design.weights[design.bands + GHOST] @ change) < 1e-8


def test_a_steep_gamma_over_wide_borders_is_predicted() -> None:
    """v^5 on borders of a standard deviation of 0.4 px: lit cells of 4 px lose a quarter of their width. Contrast comes
    out within noise, the borders' grey levels to 5 %."""
    dataset = shared_study(STEEP_GAMMA)
    effect = ScreenGamma(exponent=5.0, rim_px=0.4)
    contrasts = MeasurementModel((measure_bernoulli(dataset),), dataset.camera)
    n, covariance = len(contrasts.value), contrasts.gaussian().covariance
    for effects, low, high in (((), 5.0, 1e9), ((effect,), 0.0, 1.0)):
        residual = contrasts.value - contrasts.mean(effects)
        chi2 = float(residual @ np.linalg.solve(covariance, residual))
        assert low * n < chi2 < high * n + 4 * np.sqrt(2 * n)  # 4 sigma of a chi2 of n numbers
    borders = measure_cell_borders(dataset)
    np.testing.assert_allclose(borders.predict((effect,)).mean, borders.value, rtol=0.05)


def test_defocus_changes_the_contrast_as_predicted() -> None:
    """12 um: far out of the noise, and with the effect within it, levels and the screen's own blur free."""
    dataset = dataset_of(recorded(concealed.DefocusLaw(12.0, 1)))
    model = MeasurementModel((measure_bernoulli(dataset),), dataset.camera)
    for effects, low, high in (((), 5.0, 1e9), ((Defocus(defocus_um=12.0),), 0.0, 1.0)):
        gaussian = model.gaussian(effects)
        residual = model.value - gaussian.mean
        n = len(residual)
        chi2 = float(residual @ np.linalg.solve(gaussian.covariance, residual))
        assert low * n < chi2 < high * n + 4 * np.sqrt(2 * n)  # 4 sigma of a chi2 of n numbers


@pytest.mark.parametrize(
    ("cell_px", "turn_deg"),
    [(4.0, 0.04), pytest.param(3.0, 0.0, marks=pytest.mark.slow), pytest.param(5.3, 1.7, marks=pytest.mark.slow)],
)
def test_a_filter_is_predicted_on_a_screen_of_any_geometry(cell_px: float, turn_deg: float) -> None:
    """Cells of 4.0 px, hardly turned: red and blue pixels see f and 1/2 cy/px - f as the same numbers. chi2 of n
    numbers is at most n + 3 sqrt(2 n), and a filter fits better than what else blurs."""
    law = concealed.OpticalLowPassFilterLaw(1.9, 0)
    plan = Plan(kinds=("dark", "flat", "screen"), screen_cell_px=cell_px, screen_turn_deg=turn_deg)
    camera = ConcealedCamera(61, (law,), cfa="BGGR", f_number=5.6, rows=288, cols=384)
    dataset = dataset_of(recordings_of(camera, plan))
    model = measured_model(dataset, measure_bernoulli)
    fits = {
        effect.name: refit(model, (effect,), DecisionPolicy())
        for effect in (
            OpticalLowPassFilter(displacement_x_um=1.9, displacement_y_um=1.9),
            ChargeDiffusion(length_um=1.0),
        )
    }
    found = fits["optical_low_pass_filter"]
    n = int(model.seen.sum())
    assert model.seen_gaussian(found.effects).chi2(model.seen_value) < n + 3.0 * np.sqrt(2.0 * n)
    assert found.log_posterior > fits["charge_diffusion"].log_posterior
    for name, std in found.std[0].items():
        assert std is not None
        assert abs(getattr(found.effects[0], name) - 1.9) < 3.0 * std


def test_a_narrow_aperture_is_predicted_beyond_the_null_of_the_stated_one() -> None:
    """An aperture 0.9 um narrower than stated: where the stated one's OTF is 0, a ratio to it has no bound. With the
    effect chi2 of n numbers is at most n + 3 sqrt(2 n), and 25 (5 sigma of one parameter) below that without it."""
    law = concealed.PixelApertureLaw(0.9, 0, 1)
    plan = Plan(kinds=("dark", "flat", "screen"), screen_cell_px=4.0, screen_turn_deg=0.5)
    camera = ConcealedCamera(62, (law,), rows=288, cols=384)
    dataset = dataset_of(recordings_of(camera, plan))
    model = measured_model(dataset, measure_bernoulli)
    n = int(model.seen.sum())
    effect = PixelAperture(side_change_um=law.signed_strength)
    chi2 = model.seen_gaussian((effect,)).chi2(model.seen_value)
    assert chi2 < n + 3.0 * np.sqrt(2.0 * n)
    assert model.seen_gaussian(()).chi2(model.seen_value) > chi2 + 25.0


def test_pattern_fits_are_freed_with_their_study() -> None:
    """A dataset's fits are freed with it (30 MB a set): a service diagnoses one set after another."""
    dataset = dataset_of(recorded())
    measure_bernoulli(dataset)
    kept = weakref.ref(dataset)
    del dataset
    gc.collect()
    assert kept() is None


def test_a_colours_contrast_is_that_of_its_own_place() -> None:
    """Red and blue are displaced by half a pixel and more. Drawn at green's place, their contrast would be 2 to 4 % too
    low below 0.25 cy/px."""
    plain, moved = (measure_bernoulli(shared_study(*laws)) for laws in ((), (concealed.LateralColourLaw(4.0, 0, 5),)))
    # over the healthy camera's, by frequencies: the two are drawn with slightly different references
    kept, moved_over = (
        {
            (k.channel, k.condition, round(k.x, 2)): v
            for k, v in zip(block.labels, block.value / block.predict(()).mean, strict=True)
        }
        for block in (plain, moved)
    )
    lost = [kept[k] - v for k, v in moved_over.items() if k in kept and k[0] in "RB" and k[2] < 0.25]
    assert len(lost) > 20
    # a band's contrast is good to 0.3 %: 4 standard errors of two dozen
    assert abs(np.mean(lost)) < 0.0025


def test_lateral_colour_is_measured_along_the_radius_alone() -> None:
    """3 um a 100 nm in the corner: what each colour's light is apart from green's, by the block's own prediction at
    that size."""
    from sim.effects.lateral_chromatic_aberration import LateralChromaticAberration

    law = LATERAL_COLOUR
    block = measure_lateral_colour(shared_study(law))
    prediction = block.predict((LateralChromaticAberration(slope_um=law.signed_strength),))
    expected, reading = prediction.mean, np.sum(np.square(list(prediction.jacobian.values())), axis=0)
    std = np.sqrt(np.diag(block.covariance) + reading)
    assert np.abs(expected).max() > 8 * std.max()
    assert np.all(np.abs(block.value - expected) < 4 * std)


def test_the_screen_s_grid_is_seen_in_white_frames_alone() -> None:
    """Other lit screens don't show the screen's pixel grid, and a single channel doesn't show lateral colour."""
    mono = dataset_of(recorded(cfa="MONO"))
    assert abs(float(measure_screen_grid(mono).value[0])) < 4.0
    with pytest.raises(NotDetermined, match="one channel"):
        measure_lateral_colour(mono)
    with pytest.raises(NotDetermined, match="no white captures"):
        measure_screen_grid(dataset_of(recorded(plan=Plan(kinds=("dark", "flat")))))
    with pytest.raises(NotDetermined, match="no bernoulli captures"):
        measure_ghost(dataset_of(recorded(plan=Plan(kinds=("dark", "flat")))))


@pytest.mark.parametrize("seed", [1000, 1004])
def test_dark_squares_that_the_border_cuts_are_looked_at_inside_only(seed: int) -> None:
    """A screen that covers a frame of 64 px: beyond the border a lit square may follow. chi2 of n numbers, 5 sigma."""
    camera = ConcealedCamera(seed, cfa="RGGB", rows=64, cols=64)
    block = measure_screen(dataset_of(recordings_of(camera, PLAN)))
    away = block.value - block.predict(()).mean
    n = len(away)
    assert n == 6
    assert away @ np.linalg.solve(block.covariance, away) < n + 5.0 * np.sqrt(2.0 * n)


@pytest.mark.slow
def test_a_displaced_colour_before_an_aligned_screen_keeps_its_contrast() -> None:
    """Cells of 4 px, straight: red and blue are displaced by 0.6 px in the corners. The camera of this former only
    displaces a channel, so that each band's contrast is 1 but for what the last step leaves, 0.1 px: 1 - cos(2 pi 0.1
    0.3) = 2 % up to 0.3 cy/px, and the noise of 1 %. Drawn anew once it was 8 %."""
    law = concealed.LateralColourLaw(3.5, 0, 7)
    plan = Plan(kinds=("dark", "flat", "screen"), screen_turn_deg=0.0)
    dataset = dataset_of(recordings_of(ConcealedCamera(5, (law,), cfa="BGGR", rows=112, cols=144), plan))
    for group in patterns(dataset):
        for one in group:
            bands = slice(len(one.bands))
            left = np.abs(one.value[bands] / one.baseline[bands] - 1.0)
            assert np.all(left[[band.frequency < 0.3 for band in one.bands]] < 0.03), one.channel


# --- Veiling glare: uniform over the frame, or a halo about its source ------------------------------------------------


@pytest.mark.parametrize("std_px", [6.0, 20.0, 60.0])
def test_surroundings_are_what_a_filter_leaves(std_px: float) -> None:
    rng = np.random.default_rng(3)
    picture = ndimage.uniform_filter(rng.random((60, 90)), 7)
    where = np.zeros(picture.shape, bool)
    where[20:26, 50:58] = True
    expected = ndimage.gaussian_filter(picture, std_px, mode="reflect", truncate=6.0)[where].mean()
    low = harmonics(picture)
    assert Surroundings.of(low, where).mean(std_px) == pytest.approx(expected, abs=1e-6)
    box = Surroundings.of_box(low, picture.shape, slice(20, 26), slice(50, 58))
    assert box.mean(std_px) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("variant", [0, 1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_glare_has_its_name_whatever_its_reach(variant: int) -> None:
    """Evenly spread; half of it within a halo of a quarter of the frame; fading from the middle."""
    law = concealed.VeilingGlareLaw(2.0, variant, 9)
    recordings = former(104, law, cfa="RGGB", kinds=("dark", "flat", "chart", "slanted_edge", "screen"))
    found = verdict(recordings, measure_slanted_edge, measure_chart, measure_screen)
    assert names(found) == ["veiling_glare"]
    # of what a lens spreads a halo's share is told apart only where there is one
    assert bool(halos(found.model.camera, (found.named[0].effect,))) == (variant == 1)


def test_wide_wings_light_dark_squares_as_predicted() -> None:
    """Wings of Moffat's profile, 2.7 px wide at half maximum, bring a fifth of a per cent of the lit squares' light to
    the dark ones. Both repeats' numbers share their floor: chi2 of two lies below 9.2 in 99 % of draws."""
    law = concealed.SeeingLaw(8.0, 0, 9)
    recordings = recordings_of(ConcealedCamera(930, (law,), cfa="MONO", rows=192, cols=256), Plan(("screen",)))
    block = measure_screen(Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True)))
    away = [block.value - block.predict(effects).mean for effects in ((), (MoffatBlur(**law.library_parameters()),))]
    without, with_it = (float(left @ np.linalg.solve(block.covariance, left)) for left in away)
    assert with_it < 9.2 < without
