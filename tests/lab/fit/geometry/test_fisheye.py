"""Wide lenses: the projection is chosen by held-out views, and the intervals of the focal length hold the true one,
also where a pinhole is all that is fitted.

Corners are drawn through lenses of four laws r(theta), whose slope on the axis is the focal length.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lab.capture_kinds.charuco import CharucoCapture
from lab.fit.compare import compare
from lab.fit.geometry import geometry_result
from lab.fit.stereo import fit_pairs, rectification_maps
from lab.formats.results import CameraFit, FitResult
from lab.observables.boards.calibration import calibrate, calibrate_robustly, with_model_error
from lab.observables.boards.corners import LEAST_BEND_PX
from lab.observables.boards.detection import find_board
from lab.observables.boards.pairs import StereoPair
from lab.observables.boards.refinement import bend_px
from lab.observables.boards.views import BoardView, board_points
from sim.camera import Geometry
from sim.scene.projection import EQUIDISTANT
from sim.scene.warp import Warp
from tests.lab.fit.projected import capture

SHAPE = (480, 640)
CENTRE = np.array([322.5, 236.0])
LAWS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "equidistant": lambda angle: angle,
    "equisolid": lambda angle: 2.0 * np.sin(angle / 2.0),
    "stereographic": lambda angle: 2.0 * np.tan(angle / 2.0),
    "orthographic": np.sin,
    "pinhole": np.tan,
}


def views_through(
    law: str,
    focal_px: float,
    count: int,
    seed: int = 0,
    noise_px: float = 0.03,
    aside_mm: tuple[float, ...] = (0.0,) * 3,
) -> list[BoardView]:
    """Views of a board over the whole field, at 200 to 350 mm from the camera, which stands `aside_mm` off."""
    rng, noise, found = np.random.default_rng(seed), np.random.default_rng((seed, int(aside_mm[0]))), []
    widest = {"pinhole": 0.9, "orthographic": 1.0}.get(law, 1.3)
    for number in range(count):
        of = capture(number)
        index = np.arange((of.squares[0] - 1) * (of.squares[1] - 1))
        board = board_points(of, index)
        aim = Rotation.from_rotvec([*rng.uniform(-0.7, 0.7, 2), 0.0]).as_matrix()
        turn = aim @ Rotation.from_rotvec(rng.normal(0, [0.45, 0.45, 0.5])).as_matrix()
        middle = aim @ [0.0, 0.0, rng.uniform(200.0, 350.0)]
        placed = (board - board.mean(axis=0)) @ turn.T + middle - np.array(aside_mm)
        rho = np.hypot(*placed[:, :2].T)
        angle = np.arctan2(rho, placed[:, 2])
        with np.errstate(invalid="ignore"):
            image = CENTRE + focal_px * (LAWS[law](angle) / rho)[:, None] * placed[:, :2]
        there = (angle < widest) & np.all((image > 4) & (image < np.array(SHAPE[::-1]) - 5), axis=1)
        if there.sum() < 12:
            continue
        noisy = image[there] + noise.normal(0, noise_px, (int(there.sum()), 2))
        found.append(BoardView(of, index[there], board[there], noisy))
    return found


@pytest.mark.parametrize(
    ("law", "focal_px"),
    [  # make ci-extra calibrates the others
        ("equidistant", 260.0),
        *(
            pytest.param(*one, marks=pytest.mark.extra)
            for one in (("equisolid", 310.0), ("stereographic", 215.0), ("orthographic", 390.0))
        ),
    ],
)
def test_a_fisheye_is_chosen_and_its_interval_holds_the_focal_length(law, focal_px):
    """3.5 standard deviations: of eight focal lengths, one in 270 sets is beyond."""
    fit = geometry_result(calibrate_robustly(views_through(law, focal_px, 18), SHAPE))
    assert fit.lens_projection != "pinhole"
    assert any("projects as" in remark and "pinhole" in remark for remark in fit.remarks)
    for k in (0, 1):
        assert abs(fit.camera_matrix[k][k] - focal_px) < 3.5 * fit.camera_matrix_std[k][k]
        assert abs(fit.camera_matrix[k][2] - CENTRE[k]) < 3.5 * fit.camera_matrix_std[k][2]
        assert fit.camera_matrix_std[k][k] < 0.002 * focal_px


def test_a_narrow_lens_stays_a_pinhole():
    fit = geometry_result(calibrate_robustly(views_through("pinhole", 700.0, 12, seed=3), SHAPE))
    assert fit.lens_projection == "pinhole"
    assert abs(fit.camera_matrix[0][0] - 700.0) < 3.5 * fit.camera_matrix_std[0][0]


@pytest.mark.parametrize(("law", "focal_px", "seed"), [("equidistant", 260.0, 1), ("equisolid", 300.0, 2)])
def test_the_interval_of_a_pinhole_on_a_wide_lens_holds_the_focal_length(law, focal_px, seed):
    """Without the lens's discrepancy the same interval is short by more than five standard deviations."""
    views = views_through(law, focal_px, 20, seed)
    found = calibrate(views, SHAPE)
    whole = with_model_error(views, SHAPE, found)
    error = abs(found.state.intrinsics[0, 0] - focal_px)
    assert error > 5.0 * found.std()[0]
    assert error < 3.0 * whole.std()[0]
    assert whole.lens_px > 0.02


def test_a_lens_that_sees_behind_itself_is_calibrated():
    """Boards 75 to 105 deg off the axis beside those before it."""
    focal, rng, views = 130.0, np.random.default_rng(4), []
    for number in range(16):
        of = capture(number, squares=(6, 8))
        index = np.arange(35)
        board = board_points(of, index)
        about = 2 * np.pi * number / 16
        aim = Rotation.from_rotvec(rng.uniform(0.2, 1.55) * np.array([np.cos(about), np.sin(about), 0.0])).as_matrix()
        turn = aim @ Rotation.from_rotvec(rng.normal(0, 0.4, 3)).as_matrix()
        placed = (board - board.mean(axis=0)) @ turn.T + aim @ [0.0, 0.0, 260.0]
        rho = np.hypot(*placed[:, :2].T)
        image = CENTRE + focal * (np.arctan2(rho, placed[:, 2]) / rho)[:, None] * placed[:, :2]
        views.append(BoardView(of, index, board, image + rng.normal(0, 0.03, image.shape)))
    fit = geometry_result(calibrate_robustly(views, SHAPE))
    assert fit.lens_projection == "equidistant"
    assert fit.views == 16
    assert min(z for view in fit.residuals for z in view.depth_mm) < 0.0
    assert abs(fit.camera_matrix[0][0] - focal) < 3.5 * fit.camera_matrix_std[0][0]


@pytest.mark.extra  # two whole calibrations
def test_a_rig_of_two_fisheyes_is_found_and_rectified():
    left, right = (
        views_through("equidistant", 260.0, 14, 6, aside_mm=aside) for aside in ((0.0,) * 3, (60.0, 0.0, 0.0))
    )
    fits = [geometry_result(calibrate_robustly(views, SHAPE)) for views in (left, right)]
    of_right = {view.capture.pose: view for view in right}
    pairs = [StereoPair(view, of_right[view.capture.pose]) for view in left if view.capture.pose in of_right]
    fit = fit_pairs(pairs, *fits, (SHAPE, SHAPE))
    np.testing.assert_array_less(
        np.abs(np.array(fit.translation_mm) - [-60.0, 0.0, 0.0]), 3.5 * np.array(fit.translation_mm_std)
    )
    # rows of both corners: sqrt 2 of a corner's 0.03 px, stretched by up to 1 / cos^2 of 60 deg
    assert fit.rectification.row_rms_px < 4.0 * np.sqrt(2.0) * 0.03
    x, y = rectification_maps(fit, SHAPE)["left"]
    assert x.shape == y.shape == SHAPE and np.isfinite(x).all()


def test_distortions_of_different_projections_are_not_compared():
    """A pinhole's k1 beside a fisheye's would be a change of a lens that didn't change."""
    views = views_through("equidistant", 260.0, 14)
    one, other = (
        FitResult(source=name, cameras={"left": CameraFit(geometry=geometry_result(calibrated))})
        for name, calibrated in (
            ("a", calibrate_robustly(views, SHAPE)),
            ("b", calibrate_robustly(views_through("pinhole", 700.0, 12, seed=3), SHAPE)),
        )
    )
    found = compare(one, other)
    assert not [row for row in found.changes if row.name.endswith("distortion")]
    same = compare(one, one)
    assert {row.where for row in same.changes if row.name.endswith("distortion")} == {"k1", "k2", "k3", "k4"}


@pytest.mark.parametrize(("focal_px", "distance_mm"), [(260.0, 220.0), (180.0, 150.0)])
def test_corners_of_bent_edges_are_unbiased(focal_px, distance_mm):
    """A frontal board through an equidistant lens, drawn by the projection of `sim` with 8 x 8 samples a pixel. Fitted
    by straight edges, corners lie towards the axis by curvature x window^2 / 6, 0.02 px and more.

    Noise of 0.5 % displaces a corner by some 0.01 px; the mean over 60 corners by 0.0013 px, three times that is 0.004.
    """
    of = CharucoCapture(
        id="a", kind="charuco", side="left", frame="a.npy", exposure_s=0.01, dictionary="none", squares=(7, 10),
        square_mm=30.0, pose="a",
    )  # fmt: skip
    matrix = ((focal_px, 0.0, 319.5), (0.0, focal_px, 239.5), (0.0, 0.0, 1.0))
    geometry = Geometry(camera_matrix=matrix, projection="equidistant")
    shift = np.array([-150.0, -105.0, distance_mm])
    warp = Warp.of(np.array(matrix) @ np.column_stack([np.eye(3)[:, 0], np.eye(3)[:, 1], shift]), geometry)
    fine_row, fine_col = ((np.arange(8 * n) + 0.5) / 8 - 0.5 for n in SHAPE)
    u, v = warp.grid_to_pattern(fine_row, fine_col)
    dark = (np.floor(u / 30.0) + np.floor(v / 30.0)) % 2 == 0
    inside = (u >= 0) & (u < 300) & (v >= 0) & (v < 210)
    fine = np.where(inside & dark, 0.1, 0.9).astype(np.float32)
    picture = fine.reshape(SHAPE[0], 8, SHAPE[1], 8).mean(axis=(1, 3))
    picture = cv2.GaussianBlur(picture, (0, 0), 0.5) + np.random.default_rng(0).normal(0, 0.005, SHAPE)
    straight = find_board(picture.astype(float), of)
    assert bend_px(straight) > LEAST_BEND_PX
    view = find_board(picture.astype(float), of, bent=True)
    assert len(view.index) > 50
    truth = EQUIDISTANT.project(view.board_mm + shift, EQUIDISTANT.intrinsics(matrix))
    away = truth - [319.5, 239.5]
    outwards = np.sum((view.image_px - truth) * away, axis=1) / np.linalg.norm(away, axis=1)
    assert abs(np.mean(outwards)) < 0.004
    assert np.std(outwards) < 0.03


def test_the_remark_of_a_lens_names_its_discrepancy():
    views = views_through("equidistant", 260.0, 20, 1)
    found = with_model_error(views, SHAPE, calibrate(views, SHAPE))
    calibration = SimpleNamespace(camera=found.state.camera(), solution=found, models=(), views=views)
    from lab.fit.geometry import _projection_remarks

    remarks = _projection_remarks(calibration)  # type: ignore[arg-type]
    assert (
        len(remarks) == 1
        and f"departs from a pinhole with Brown's distortion by about {found.lens_px:.3f} px" in remarks[0]
    )
