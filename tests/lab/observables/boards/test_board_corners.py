"""The corners of boards and what is read of them: no statement about the camera enters, frames are read once, and
residuals by cell are unbiased, scatter as their covariance says, and move as the chain of light predicts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from evaluation.draw import recordings_of, recordings_of_pair
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator import laws as concealed
from lab.capture_kinds.base import Capture
from lab.capture_kinds.charuco import CharucoCapture
from lab.fit.geometry import fit_geometry
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from lab.observables.boards.calibration import Calibration, calibrate, calibration_of, with_model_error
from lab.observables.boards.corners import board_corners, channel_corners, plane_corners
from lab.observables.boards.lateral_colour import measure_board_colour
from lab.observables.boards.residuals import CellResiduals, cell_residuals, measure_boards
from lab.observables.boards.views import BoardView
from lab.observables.dataset import Dataset
from sim.camera import Geometry
from sim.effects.library import effect as library_effect
from tests.lab.fit.geometry.test_bundle_adjustment import AT_EIGHT, rippled
from tests.lab.fit.projected import SHAPE, poses, seen


@cache
def recorded(*laws: Law, cfa: str = "RGGB", noise_draw: int = 0) -> RecordingSet:
    camera = ConcealedCamera(41, laws, cfa=cfa, rows=192, cols=256, noise_draw=noise_draw)
    return recordings_of(camera, Plan(kinds=("dark", "charuco")))


def dataset_of(recordings: RecordingSet) -> Dataset:
    return Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))


@pytest.mark.parametrize("cfa", ["GBRG", "MONO"])
def test_no_statement_about_camera_or_capture_enters(cfa: str) -> None:
    recordings = recorded()
    stated = recordings.camera("left").model_copy(
        update={"cfa": cfa, "black_level_dn": 9.0, "f_number": 22.0, "pixel_pitch_um": 9.9, "bit_depth": 16}
    )
    relabelled = {"exposure_s": 77.0, "gain_db": 6.0, "temperature_c": 60.0, "wavelength_nm": 640.0, "time": None}
    captures = tuple(c.model_copy(update=relabelled) for c in recordings.captures(CharucoCapture))
    manifest = recordings.manifest.model_copy(update={"cameras": {"left": stated}, "captures": captures})
    one, other = recordings, recordings.under(manifest)
    views, again = (board_corners(r, "left").views for r in (one, other))
    assert len(views) == len(again) > 8
    for view, same in zip(views, again, strict=True):
        for name in ("index", "image_px", "std_px", "board_mm"):
            np.testing.assert_array_equal(getattr(view, name), getattr(same, name))
    planes, same_planes = (plane_corners(r, v) for r, v in ((one, views[0]), (other, again[0])))
    for place, fits in planes.items():
        for a, b in zip(fits, same_planes[place], strict=True):
            np.testing.assert_array_equal(a, b)


def test_every_order_of_the_mosaic_has_the_green_of_its_two_planes() -> None:
    recordings = recorded()
    planes = plane_corners(recordings, board_corners(recordings, "left").views[0])
    for cfa, greens in (("RGGB", ((0, 1), (1, 0))), ("GRBG", ((0, 0), (1, 1)))):
        green = channel_corners(planes, cfa)["G"]
        np.testing.assert_array_equal(green.points, np.mean([planes[place].points for place in greens], axis=0))


def test_boards_are_found_once_for_fit_and_diagnosis(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the fit the diagnosis reads no frame of a board."""
    recordings = recorded(noise_draw=5)
    read: list[str] = []
    frame = RecordingSet.frame

    def counted(self: RecordingSet, capture: Capture) -> np.ndarray:
        if capture.kind == "charuco":
            read.append(capture.id)
        return frame(self, capture)

    monkeypatch.setattr(RecordingSet, "frame", counted)
    fit = fit_geometry(recordings, "left")
    assert max(read.count(name) for name in read) <= 3  # straight edges, bent ones, planes
    dataset = dataset_of(recordings)  # looks for frames that are copies of another
    read.clear()
    measure_boards(dataset)
    measure_board_colour(dataset)
    assert not read
    assert fit.views == len(calibration_of(recordings, "left").views)


def spread(found: list[CellResiduals]) -> tuple[float, float, int]:
    """Mean pull over its standard deviation, chi2 over its degrees of freedom, and their number, of all draws. The
    fitted parameters take up directions, which have no variance."""
    pulls, chi2, freedom = [], 0.0, 0
    for one in found:
        std = np.sqrt(np.diag(one.covariance))
        size, axes = np.linalg.eigh(one.covariance / np.outer(std, std))
        use = size > 1e-6
        white = axes.T[use] @ (one.value / std) / np.sqrt(size[use])
        pulls += white.tolist()
        chi2, freedom = chi2 + float(white @ white), freedom + int(use.sum())
    return float(np.mean(pulls) * np.sqrt(freedom)), chi2 / freedom, freedom


def calibrated(views: list[BoardView]) -> Calibration:
    solution = with_model_error(views, SHAPE, calibrate(views, SHAPE))
    return Calibration(tuple(views), solution, SHAPE)


@pytest.mark.parametrize("ripples", [False, True])
def test_residuals_scatter_as_their_covariance_says(ripples: bool) -> None:
    """Corners with independent noise, and with errors that neighbours share, whose size the fit of the camera finds."""
    rng, at, found = np.random.default_rng(7), poses(8, seed=8), []
    for _ in range(10):
        views = rippled(rng) if ripples else seen(rng, at, noise_px=0.03)
        found.append(cell_residuals(calibrated(views)))
    pull, share, count = spread(found)
    assert abs(pull) < 3.0
    # the errors' size is known from some 1200 coordinates a draw, or 8 ripples: 3 to 10 % of the variance a draw
    assert abs(share - 1.0) < 3.0 * np.sqrt(2.0 / count) + (0.10 if ripples else 0.03)


def test_residuals_of_drawn_frames_scatter_as_their_covariance_says() -> None:
    found = [cell_residuals(calibration_of(recorded(cfa=cfa), "left")) for cfa in ("RGGB", "MONO")]
    pull, share, count = spread(found)
    assert abs(pull) < 3.0
    assert abs(share - 1.0) < 3.0 * np.sqrt(2.0 / count)


def test_a_displacement_moves_residuals_as_the_operator_says() -> None:
    """A displacement along x of 0.2 px at the half diagonal, three periods around the axis, which no camera's terms
    make, without noise. What is left out is quadratic in it: 0.2 px squared over a focal length of 1400 px is 3e-5 px.
    """
    views = seen(np.random.default_rng(1), AT_EIGHT, noise_px=0.0)
    plain = calibrated(views)
    shifts = []
    for view in views:
        x, y = (view.image_px - 0.5 * (np.array(SHAPE[::-1]) - 1.0)).T / (0.5 * float(np.hypot(*SHAPE)))
        shifts.append(np.column_stack([0.2 * np.hypot(x, y) ** 2 * np.cos(3.0 * np.arctan2(y, x)), 0.0 * x]))
    moved = [replace(v, image_px=v.image_px + s) for v, s in zip(views, shifts, strict=True)]
    before = cell_residuals(plain)
    change = cell_residuals(replace(plain, views=tuple(moved))).value - before.value
    np.testing.assert_allclose(change, before.operator @ np.concatenate(shifts).ravel(), atol=1e-4)
    assert np.abs(change).max() > 1e-2


def test_distortion_of_drawn_frames_is_predicted_through_the_fit() -> None:
    """Beside an earlier calibration of the same camera: chi2 of what the true effect leaves, within 3 sigma above n."""
    camera = calibration_of(recorded(), "left").camera
    rows = tuple(tuple(float(v) for v in row) for row in camera.matrix)
    law = concealed.LensDistortionLaw(2.0, 0, 7)
    dataset = dataset_of(recorded(law, noise_draw=1))
    geometry = Geometry(camera_matrix=rows, distortion=tuple(float(v) for v in camera.distortion))  # type: ignore[arg-type]
    dataset.camera = dataset.camera.model_copy(update={"geometry": geometry})
    block = measure_boards(dataset)
    effect = library_effect(law.effect)(**law.library_parameters())
    without, rest = (block.value - block.predict(effects).mean for effects in ((), (effect,)))
    jacobian = np.array([*block.predict(()).jacobian.values()])
    covariance = block.covariance + jacobian.T @ jacobian
    chi2 = float(rest @ np.linalg.solve(covariance, rest))
    assert chi2 < len(rest) + 3.0 * np.sqrt(2.0 * len(rest))
    assert float(without @ np.linalg.solve(covariance, without)) > 10.0 * len(rest)


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG", *(pytest.param(c, marks=pytest.mark.slow) for c in ("BGGR", "GRBG"))])
def test_lateral_colour_of_drawn_frames_is_predicted(cfa: str) -> None:
    """3 um at the corner is a pixel. chi2 within 3 sigma above n."""
    law = concealed.LateralColourLaw(3.0, 0, 5)
    block = measure_board_colour(dataset_of(recorded(law, cfa=cfa)))
    effect = library_effect(law.effect)(**law.library_parameters())
    for effects, least in (((effect,), 0.0), ((), 10.0 * len(block.value))):
        rest = block.value - block.predict(effects).mean
        chi2 = float(rest @ np.linalg.solve(block.covariance, rest))
        assert chi2 >= least
        assert effects == () or chi2 < len(rest) + 3.0 * np.sqrt(2.0 * len(rest))


def test_boards_aligned_with_the_pixels_show_no_lateral_colour() -> None:
    """The right camera's first board stands parallel to it, with squares of 24.0 px: in a plane, all edges along a row
    have one phase on the samples, and red lies 0.25 px from green all over the view. chi2 within 3 sigma above n."""
    left, right = (
        ConcealedCamera(seed, cfa="RGGB", rows=192, cols=256, side=side, offset_mm=offset_mm, pair_middle_mm=5.0)
        for seed, side, offset_mm in ((51, "left", 0.0), (52, "right", 10.0))
    )
    recordings = recordings_of_pair(left, right, Plan(kinds=("dark", "charuco")))
    view = board_corners(recordings, "right").views[0]
    fits = channel_corners(plane_corners(recordings, view), "RGGB")
    assert np.hypot(*np.mean(fits["R"].points - fits["G"].points, axis=0)) > 0.1
    block = measure_board_colour(
        Dataset(recordings, "right", camera_model(recordings, "right", None, maker_curves=True))
    )
    chi2 = float(block.value @ np.linalg.solve(block.covariance, block.value))
    assert chi2 < len(block.value) + 3.0 * np.sqrt(2.0 * len(block.value))
