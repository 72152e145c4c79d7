"""Kernels of recordings of a screen drawn in closed form: squares blurred by a Gaussian are products of normal
distribution functions. And the test of radial symmetry on kernels over the field.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.special import ndtr

from lab.capture_kinds.bernoulli import BernoulliCapture
from lab.capture_kinds.black import BlackCapture
from lab.capture_kinds.checkerboard import CheckerboardCapture
from lab.capture_kinds.screen import ScreenState
from lab.capture_kinds.white import WhiteCapture
from lab.errors import NotDetermined
from lab.fit.psf import recordings
from lab.fit.psf.recordings import PsfFit, fit_psf_field, radial_symmetry
from lab.fit.psf.screen_kernel import ScreenField, ScreenKernel, measure_field
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.observables.screens.placement import place_pattern
from lab.observables.screens.poses import ScreenPictures, screen_poses
from lab.observables.screens.registration import register, target_corners
from tests.lab.fit.psf.drawn_targets import (
    gaussian,
)

SHAPE = (200, 250)
CELL_PX, TURN = 4.1, np.radians(1.7)
SIGMA_PX = {"R": 0.75, "G": 0.6, "B": 0.5}
BOARD = (np.indices((40, 50)) // 5).sum(axis=0).astype(np.uint8) % 2
PATTERN = np.random.default_rng(77).integers(0, 2, (40, 50)).astype(np.uint8)


def cells(row, col):
    """Camera px -> cells (y, x): turned by TURN about the frame's middle."""
    dy, dx = row - SHAPE[0] / 2 + 0.3, col - SHAPE[1] / 2 - 0.2
    y = (np.cos(TURN) * dy - np.sin(TURN) * dx) / CELL_PX
    x = (np.sin(TURN) * dy + np.cos(TURN) * dx) / CELL_PX
    return y + 20, x + 25


@functools.cache
def light_of(kind, seed=77):
    """What the whole mosaic sees of a pattern, each pixel through its own channel's blur."""
    pattern = {WhiteCapture: np.ones((40, 50)), BlackCapture: np.zeros((40, 50)), CheckerboardCapture: BOARD}.get(kind)
    if pattern is None:
        pattern = PATTERN if seed == 77 else np.random.default_rng(seed).integers(0, 2, (40, 50))
    light = np.zeros(SHAPE)
    for phase, channel in enumerate("GRBG"):
        at = np.s_[phase // 2 :: 2, phase % 2 :: 2]
        light[at] = shown(pattern, SIGMA_PX[channel])[at]
    return light


def shown(pattern, sigma_px):
    """The pattern blurred by an isotropic Gaussian: exact, for a Gaussian is the same in the turned frame."""
    row, col = np.indices(SHAPE, dtype=float)
    y, x = (v.ravel() for v in cells(row, col))
    sigma = sigma_px / CELL_PX
    reach = np.arange(-2, 3)
    light = np.zeros(y.size)
    padded = np.pad(pattern.astype(float), 60)
    at_y, at_x = np.floor(y).astype(int), np.floor(x).astype(int)
    for i in reach:
        wide = ndtr((y - at_y - i) / sigma) - ndtr((y - at_y - i - 1) / sigma)
        for j in reach:
            high = ndtr((x - at_x - j) / sigma) - ndtr((x - at_x - j - 1) / sigma)
            light += padded[np.clip(at_y + i + 60, 0, 159), np.clip(at_x + j + 60, 0, 169)] * wide * high
    return light.reshape(SHAPE)


def screen_recordings(electrons=9000.0, seed=5, **changed):
    rng = np.random.default_rng(seed)
    camera = DataSheet(
        rows=SHAPE[0], cols=SHAPE[1], pixel_pitch_um=3.0, fill_factor=1.0, cfa="GRBG", bit_depth=12, black_level_dn=64.0
    )
    gains = np.tile(np.array([[1.0, 0.6], [0.45, 1.04]]), (SHAPE[0] // 2, SHAPE[1] // 2))
    response = gains * (1 + 0.008 * rng.normal(size=SHAPE))
    screen = ScreenState(pose="p0", cell_camera_px=4.0)
    captures, frames = [], {}
    for kind in (WhiteCapture, BlackCapture, CheckerboardCapture, BernoulliCapture):
        light = light_of(kind, changed.get("pattern_seed", 77))
        for repeat in range(2):
            shown = kind.__name__.removesuffix("Capture").lower()
            name = f"{shown}-{repeat}"
            mean = electrons * response * (0.01 + 0.99 * light)
            frames[f"frames/{name}.npy"] = np.minimum(64 + np.round(0.4 * rng.poisson(mean)), 4095).astype(np.uint16)
            target = {} if kind in (WhiteCapture, BlackCapture) else {"target": f"targets/{shown}.npy"}
            captures.append(
                kind(
                    id=name,
                    kind=shown,
                    side="left",
                    frame=f"frames/{name}.npy",
                    exposure_s=0.01,
                    screen=screen,
                    **target,
                )
            )
    targets = {"targets/checkerboard.npy": BOARD, "targets/bernoulli.npy": PATTERN}
    kept = tuple(c for c in captures if c.kind not in changed.get("without", ()))
    return RecordingSet(Manifest(cameras={"left": camera}, captures=kept), frames=frames, targets=targets)


@pytest.fixture(scope="module")
def screen() -> RecordingSet:
    return screen_recordings()


@pytest.fixture(scope="module")
def pictures(screen):
    """The levelled pictures of `screen`: of the checkerboard, and of the pattern."""
    (pose,) = screen_poses(screen, "left", "psf")
    found = ScreenPictures.of(screen, pose)
    return found.levelled(screen, pose.checkerboard), found.levelled(screen, pose.pattern)


@pytest.fixture(scope="module")
def fitted(screen) -> tuple[PsfFit, ScreenField]:
    """The kernels of `screen` as results, and as they were measured for them."""
    measured = []

    def recorded(*arguments, **keys):
        measured.append(measure_field(*arguments, **keys))
        return measured[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recordings, "measure_field", recorded)
        fit = fit_psf_field(screen, "left", patches=3)
    return fit, measured[0]


def pixel_gaussian(sigma_px, support):
    """The Gaussian averaged over pixels: light of a whole pixel."""
    x = np.arange(support) - support // 2
    grid = np.linspace(-0.5, 0.5, 201)
    one = np.trapezoid(np.exp(-0.5 * ((x[:, None] + grid) / sigma_px) ** 2), grid, axis=1)
    kernel = np.outer(one, one)
    return kernel / kernel.sum()


def test_registration_finds_the_screen_to_a_hundredth_of_a_pixel(pictures):
    warp = register(*pictures, BOARD, PATTERN, 4.0, np.ones(pictures[0].shape, bool))
    row, col = np.meshgrid(np.arange(40, 160, 10.0), np.arange(40, 210, 10.0), indexing="ij")
    found = warp.cells(np.column_stack([col.ravel(), row.ravel()]))
    y, x = cells(row.ravel(), col.ravel())
    gap_px = (found - np.column_stack([x, y])) * CELL_PX
    assert np.abs(gap_px.mean(axis=0)).max() < 0.01
    assert gap_px.std() < 0.02


def test_registration_works_where_the_screen_is_larger_than_the_frame(pictures):
    part = np.s_[40:170, 50:230]
    checkerboard, pattern = (picture[part] for picture in pictures)
    warp = register(checkerboard, pattern, BOARD, PATTERN, 4.0, np.ones(checkerboard.shape, bool))
    y, x = cells(100.0, 140.0)
    found = warp.cells(np.array([[90.0, 60.0]]))[0]
    assert np.abs(found - [x, y]).max() * CELL_PX < 0.03


def test_corners_of_a_target():
    rows, cols = target_corners(BOARD)
    np.testing.assert_array_equal(rows, np.arange(5, 40, 5))
    np.testing.assert_array_equal(cols, np.arange(5, 50, 5))
    with pytest.raises(NotDetermined):
        target_corners(PATTERN)


def test_kernels_of_all_channels_are_the_gaussians(fitted):
    kernels = fitted[0].kernels
    assert [k.channel for k in kernels] == ["R", "G", "B"]
    for found in kernels:
        kernel = np.array(found.psf)
        truth = pixel_gaussian(SIGMA_PX[found.channel], len(kernel))
        assert kernel.sum() == pytest.approx(1, abs=1e-9)
        assert found.capture == "bernoulli-0"
        # 10 ke-, four captures a level, PRNU levelled out: the noise alone explains 1 %
        assert np.linalg.norm(kernel - truth) / np.linalg.norm(truth) < 0.025
        pull = (kernel - truth) / np.array(found.psf_std)
        assert np.sqrt(np.mean(pull**2)) < 2


def test_a_predicted_kernel_goes_through_the_same_estimator(fitted):
    found = fitted[1].kernels["G"]
    size = len(found.fine.kernel)
    x = (np.arange(size) - size // 2) / 2
    grid = np.linspace(-0.25, 0.25, 101)
    one = np.trapezoid(np.exp(-0.5 * ((x[:, None] + grid) / SIGMA_PX["G"]) ** 2), grid, axis=1)
    fine = np.outer(one, one) / one.sum() ** 2
    predicted = found.predict(fine)
    truth = pixel_gaussian(SIGMA_PX["G"], len(predicted))
    # noise-free, only the grid and the prior are left of the error
    assert np.linalg.norm(predicted - truth) / np.linalg.norm(truth) < 0.01


def test_parts_of_the_pattern_have_kernels_of_their_own(fitted):
    found = fitted[0]
    assert len(found.parts) == 9
    for part in found.parts:
        kernel = np.array(part.psf)
        truth = pixel_gaussian(SIGMA_PX["G"], len(kernel))
        # a ninth of the pixels, three times the noise; 81 numbers of which a dozen are free
        assert np.linalg.norm(kernel - truth) / np.linalg.norm(truth) < 0.06
    # 64 um / 3 um by 10: places spread over the pattern
    assert np.ptp([p.field_mm[1] for p in found.parts]) > 0.25
    assert found.symmetry is not None
    assert found.symmetry.symmetric


@pytest.mark.slow
def test_a_finer_grid_gives_the_same_kernel(pictures):
    warp = place_pattern(*pictures, BOARD, PATTERN, 4.0, "GRBG").warp
    two, four = (
        measure_field(pictures[1], PATTERN, warp, "GRBG", 5, oversample, patches=0).kernels["G"]
        for oversample in (2, 4)
    )
    assert four.fine.kernel.shape == (21, 21)
    # the two differ by what the noise and the grids make: 1 % each
    assert np.linalg.norm(four.kernel - two.kernel) / np.linalg.norm(two.kernel) < 0.02
    with pytest.raises(ValueError, match="oversample"):
        measure_field(pictures[1], PATTERN, warp, "GRBG", 5, 3)


def test_missing_captures_are_named():
    with pytest.raises(NotDetermined, match="no bernoulli"):
        fit_psf_field(screen_recordings(without=("bernoulli",)), "left", patches=0)
    with pytest.raises(NotDetermined, match="white"):
        fit_psf_field(screen_recordings(without=("white",)), "left", patches=0)


def test_another_pattern_than_the_target_is_refused():
    with pytest.raises(NotDetermined, match="screen moved"):
        fit_psf_field(screen_recordings(pattern_seed=1), "left", patches=0)


def test_a_saturated_screen_is_refused():
    with pytest.raises(NotDetermined, match="saturated"):
        fit_psf_field(screen_recordings(electrons=10100.0), "left", patches=0)


def kernel_at(row_px, col_px, sigma_row, sigma_col, angle_deg, rng):
    size, std = 9, 2e-4
    kernel = gaussian(size, sigma_row, sigma_col, angle_deg) + rng.normal(0, std, (size, size))
    return ScreenKernel(
        channel="G",
        kernel=kernel,
        kernel_std=np.full((size, size), std),
        covariance=std**2 * np.eye(size * size),
        fine=None,
        oversample=2,
        outside=0.0,
        corner_rms_px=0.0,
        centre_px=(row_px, col_px),
    )


def field(blur, seed=0):
    rng = np.random.default_rng(seed)
    places = [(r, c) for r in (-200, 0, 200) for c in (-300, 0, 300)]
    return [kernel_at(r, c, *blur(r, c), rng) for r, c in places]


def test_a_symmetric_lens_passes_and_an_asymmetric_one_does_not():
    def symmetric(r, c):  # longer along the radius, the farther out
        return 0.8 + 0.4 * (r * r + c * c) / 130000, 0.8, np.degrees(np.arctan2(c, r)) if r or c else 0.0

    passed = [radial_symmetry(field(symmetric, seed), (0.0, 0.0)) for seed in range(20)]
    # a Gaussian's second moment grows with sigma^2: not quite the parabola of the test, but by less than the noise
    assert sum(p.symmetric for p in passed) >= 18
    assert passed[0].radial_growth_px2 > 5 * abs(passed[0].tangential_growth_px2)
    tilted = radial_symmetry(field(lambda r, c: (0.8 + 0.1 * c / 300, 0.8 + 0.1 * c / 300, 0.0)), (0.0, 0.0))
    assert not tilted.symmetric
    astigmatic = radial_symmetry(field(lambda r, c: (0.9, 0.8, 0.0)), (0.0, 0.0))
    assert not astigmatic.symmetric
    with pytest.raises(NotDetermined, match="5 at unequal distances"):
        radial_symmetry(field(symmetric)[:4], (0.0, 0.0))
