"""One camera from views of a board, without the corners and views that don't fit (`calibrate_robustly`).

The distortion model is chosen by views that its fit has not seen (`choose_model`). The error of the camera model shows
where two halves of the views, calibrated separately, differ beyond their uncertainties (`cross_validation`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.formats.results import CrossValidation, DistortionModel, Skipped
from lab.measure.board_detection import MIN_CORNERS, BoardView
from lab.measure.bundle_adjustment import (
    BundleAdjustment,
    CorrelatedErrors,
    Observation,
    RigParameters,
    Solution,
    board_key,
    board_pose,
    first_intrinsics,
    first_state,
    rms_px,
    with_boards,
)
from lab.measure.pinhole import COUNT, NAMES, Difference, difference, points_at, projection_std
from sim.camera import Side

Array = NDArray[np.floating[Any]]
FOLDS = 5
#: Of the squared error of held-out views, by which a richer model has to be worse to be refused.
OVERFITTING_SHARE = 0.05
#: From simple to rich; each model has the coefficients of those before it.
MODELS = (("k1",), ("k1", "k2", "p1", "p2"), ("k1", "k2", "p1", "p2", "k3"))

MIN_VIEWS = 3
OUTLYING_VIEW_RATIO = 3.0  # rms of a view over the median rms, above which it is left out
OUTLYING_VIEW_PX = 0.1  # rms below which no view is left out
OUTLYING_CORNER_STD = 5.0  # standard deviations of a coordinate; of 2000 good corners, one in 500 calibrations
OUTLYING_CORNER_SHARE = 0.25  # of the corners of a view, above which the view is left out
LARGEST_RMS_SHARE = 0.005  # rms over the diagonal of the frame, above which no camera explains the corners
LARGEST_FOCAL_STD = 0.1  # relative; above it the focal length isn't determined
PARALLEL_DEG = 5.0
MOST_LISTED = 3  # views named in a refusal

DIFFERENCE_SIGMA = 2.6  # significance of 1 %, above which two halves of the views differ beyond their uncertainties


def free_intrinsics(coefficients: Sequence[str], *, centre: bool = True) -> NDArray[np.bool_]:
    """Return the mask (12,) of the intrinsics that a distortion model fits: the pinhole and these coefficients; without
    `centre` the principal point is held.
    """
    pinhole = ("fx", "fy", "cx", "cy") if centre else ("fx", "fy")
    return np.array([name in (*pinhole, *coefficients) for name in NAMES])


def choose_model(
    views: Sequence[BoardView], shape: tuple[int, int], solution: Solution
) -> tuple[tuple[str, ...], tuple[DistortionModel, ...]]:
    """Choose the coefficients of the distortion model by cross-validation, and list how well each of `MODELS` predicts
    held-out views.

    Each model is fitted to the other views; of a held-out view only the pose is fitted. The richest model is taken
    unless a simpler one predicts the held-out views better, by more than its standard deviation and by 5 % of the
    squared error. A coefficient is never dropped for being small: this would claim that it is known to be 0, and make
    the uncertainty of the others too small.
    """
    folds = [np.arange(start, len(views), min(FOLDS, len(views))) for start in range(min(FOLDS, len(views)))]
    scores = {model: np.zeros(len(views)) for model in MODELS}
    for fold in folds:
        rest = [k for k in range(len(views)) if k not in fold]
        chosen = [views[k] for k in rest]
        if len(chosen) < 2:
            continue
        start = solution.state
        start = replace(start, rotations=start.rotations[rest], translations_mm=start.translations_mm[rest])
        boards = {board_key(view): number for number, view in enumerate(first_view_of_boards(views))}
        for model in MODELS:
            free = free_intrinsics(model)
            held = replace(start, intrinsics=np.where(free, start.intrinsics, 0.0))
            observations = [Observation(view, pose=k, board=boards[board_key(view)]) for k, view in enumerate(chosen)]
            trained = BundleAdjustment(observations, free[None, :], shape, boards=len(boards)).solve(held).state
            for k in map(int, fold):
                scores[model][k] = _held_out_square(views[k], trained, boards[board_key(views[k])], solution, k, shape)
    counts = sum(len(view.index) for view in views)
    best = MODELS[-1]
    reasons = dict.fromkeys(MODELS, "")
    for model in reversed(MODELS[:-1]):
        worse = scores[best] - scores[model]
        error = float(np.std(worse, ddof=1) * np.sqrt(len(worse)))
        if worse.sum() > max(error, OVERFITTING_SHARE * scores[model].sum()):
            reasons[best] = "refused: it predicts held-out views worse than a simpler one does"
            best = model
    listed = []
    for model in MODELS:
        reason = reasons[model]
        if model == best:
            reason = "chosen: no simpler model predicts held-out views better"
        elif not reason:
            change = 100.0 * (np.sqrt(scores[model].sum() / scores[best].sum()) - 1.0)
            reason = f"simpler, and no better: held-out views change by {change:+.2g} %"
        listed.append(
            DistortionModel(
                coefficients=model,
                held_out_rms_px=float(np.sqrt(scores[model].sum() / counts)),
                chosen=model == best,
                reason=reason,
            )
        )
    return best, tuple(listed)


def first_view_of_boards(views: Sequence[BoardView]) -> list[BoardView]:
    """Return the first view of each board."""
    first: dict[tuple[object, ...], BoardView] = {}
    for view in views:
        first.setdefault(board_key(view), view)
    return list(first.values())


def _held_out_square(
    view: BoardView, trained: RigParameters, board: int, solution: Solution, pose: int, shape: tuple[int, int]
) -> float:
    """Return the sum of squared residuals, px^2, of a view that the camera `trained` has not seen.

    `board`: number of the board of `view`; `solution`, `pose`: where its pose is begun from; `shape`: (rows, cols) of
    the frame.
    """
    state = replace(
        trained,
        warps_mm=trained.warps_mm[board : board + 1],
        rotations=solution.state.rotations[pose : pose + 1],
        translations_mm=solution.state.translations_mm[pose : pose + 1],
    )
    only = BundleAdjustment([Observation(view, pose=0)], np.zeros((1, COUNT), dtype=bool), shape, only_poses=True)
    return float(np.sum(only.solve(state).residuals[0] ** 2))


@dataclass(frozen=True)
class Calibration:
    """A camera with the views that it rests on, and what was left out.

    `shape`: (rows, cols) of the frame. `models`: the distortion models that were compared.
    """

    views: tuple[BoardView, ...]
    solution: Solution
    shape: tuple[int, int]  # rows, cols of the frame
    models: tuple[DistortionModel, ...] = ()
    rejected: tuple[Skipped, ...] = ()
    rejected_corners: tuple[Skipped, ...] = ()

    @property
    def intrinsics(self) -> Array:
        """Return the intrinsics (12,); see `lab.measure.pinhole`."""
        return np.asarray(self.solution.state.intrinsics[0])

    @property
    def covariance(self) -> Array:
        """Return the covariance (12, 12) of the intrinsics."""
        return self.solution.of_camera(0)

    @property
    def points(self) -> Array:
        """Return the corners (n, 3), mm, in the frame of the camera; they determine the motion that two calibrations
        imply.
        """
        return points_in_camera(self.views, self.solution)

    def projection_std(self, image: Array, distance_mm: float | None) -> Array:
        """Return the standard deviation (n,), px, of projecting to `image` (n, 2) from a distance; NaN where nothing
        projects.
        """
        points = points_at(image, self.intrinsics, distance_mm)
        return projection_std(self.intrinsics, self.covariance, self.points, points)


def points_in_camera(views: Sequence[BoardView], solution: Solution, camera: int = 0) -> Array:
    """Return the corners (n, 3), mm, of `views`, one pose each, in the frame of the first camera."""
    state = solution.state
    return np.concatenate(
        [view.board_mm @ state.rotations[k].T + state.translations_mm[k] for k, view in enumerate(views)]
    ).astype(float)


def observations_of(views: Sequence[BoardView]) -> list[Observation]:
    """Make observations of the views of one camera, each with its own pose; views of equal boards share the board."""
    keys = list(dict.fromkeys(board_key(view) for view in views))
    return [Observation(view, pose=k, board=keys.index(board_key(view))) for k, view in enumerate(views)]


def calibrate(views: Sequence[BoardView], shape: tuple[int, int], coefficients: Sequence[str] = MODELS[-1]) -> Solution:
    """Calibrate one camera from all views, in frames of `shape` (rows, cols), with the distortion `coefficients`.

    The solve starts from a pinhole and goes by way of k1 about the middle of the frame: started without distortion, a
    rich model may end in another minimum. With a free centre k1 alone takes a decentred lens for one whose centre is
    far off, from where the richer model doesn't come back.
    """
    observations = observations_of(views)
    start = first_state(views, first_intrinsics(views, shape))
    start = with_boards(start, 1 + max(observation.board for observation in observations))
    rough = BundleAdjustment(observations, free_intrinsics(MODELS[0], centre=False)[None, :], shape).solve(start)
    return BundleAdjustment(observations, free_intrinsics(coefficients)[None, :], shape).solve(rough.state)


def with_model_error(
    views: Sequence[BoardView], shape: tuple[int, int], solution: Solution, errors: CorrelatedErrors | None = None
) -> Solution:
    """Return the solution of `calibrate` with the errors that neighbouring corners share in its covariance: `errors`,
    or those that its residuals show.
    """
    return BundleAdjustment(observations_of(views), solution.free, shape).with_correlated_errors(solution, errors)


def calibrate_robustly(views: Sequence[BoardView], shape: tuple[int, int], side: Side | None = None) -> Calibration:
    """Calibrate without the corners and views that don't fit, with the distortion model that predicts unseen views
    best. The errors that neighbouring corners share are in the covariance.

    A corner is left out beyond 5 standard deviations of the others. A view is left out where its rms is beyond 3 times
    the median, or where a quarter of its corners would go. Raises `NotDetermined` where too few views are left, where
    no camera explains them, or where they don't determine the focal length.
    """
    kept: list[BoardView] = []
    rejected: list[Skipped] = []
    start = first_intrinsics(views, shape)
    for view in views:
        try:
            board_pose(view, start)
            kept.append(view)
        except NotDetermined as refused:
            rejected.append(Skipped(step=view.capture.id, reason=refused.reason, side=side))
    outliers: dict[str, list[tuple[int, float]]] = {}
    while True:
        if len(kept) < MIN_VIEWS:
            raise NotDetermined(
                "geometry",
                f"{len(kept)} views of the board can be used, {MIN_VIEWS} are needed{list_reasons(rejected)}",
            )
        solution = calibrate(kept, shape)
        outlying = _outlying_view(kept, solution)
        if outlying is not None:
            which, reason = outlying
            rejected.append(Skipped(step=kept[which].capture.id, reason=reason, side=side))
            outliers.pop(kept[which].capture.id, None)
            del kept[which]
            continue
        if not _remove_outlying_corners(kept, solution, outliers):
            break
    _check_board(kept, solution, shape, rejected)
    coefficients, models = choose_model(kept, shape, solution)
    if coefficients != MODELS[-1]:
        solution = calibrate(kept, shape, coefficients)
    solution = with_model_error(kept, shape, solution)
    _check_focal_length(solution)
    corners = tuple(
        Skipped(step=capture, reason=_corner_reason(numbers, solution.noise_px), side=side)
        for capture, numbers in outliers.items()
    )
    return Calibration(tuple(kept), solution, shape, models, tuple(rejected), corners)


def _outlying_view(views: Sequence[BoardView], solution: Solution) -> tuple[int, str] | None:
    """Find the view that fits worst and the reason to leave it out; None where all fit."""
    squares = [np.sum(residual**2, axis=1) for residual in solution.residuals]
    rms = np.array([np.sqrt(np.mean(one)) for one in squares])
    # The median of a view: a single outlying corner is no reason to leave out the others
    typical = np.array([np.sqrt(np.median(one)) for one in squares])
    limit = max(OUTLYING_VIEW_RATIO * float(np.median(rms)), OUTLYING_VIEW_PX)
    worst = int(np.argmax(rms))
    if rms[worst] <= limit:
        return None
    outlying = squares[worst] > (OUTLYING_CORNER_STD * max(coordinate_std_px(solution), 1e-3)) ** 2
    if outlying.mean() < OUTLYING_CORNER_SHARE and typical[worst] <= limit and (~outlying).sum() >= MIN_CORNERS:
        return None
    return worst, f"rms {rms[worst]:.2f} px, where the other views have {np.median(rms):.2f} px"


def coordinate_std_px(solution: Solution) -> float:
    """Return the standard deviation of one coordinate, px, by the median modulus: outliers do not widen it."""
    return 1.4826 * float(np.median(np.abs(np.concatenate(solution.residuals))))


def _remove_outlying_corners(
    kept: list[BoardView], solution: Solution, outliers: dict[str, list[tuple[int, float]]]
) -> bool:
    """Remove the outlying corners from `kept` and record them in `outliers`. Returns whether there were any."""
    std = max(coordinate_std_px(solution), 1e-3)
    found = False
    for k, (view, residual) in enumerate(zip(kept, solution.residuals, strict=True)):
        distance = np.linalg.norm(residual, axis=1)
        outlying = distance > OUTLYING_CORNER_STD * std
        # The worst ones first: they bias the others
        outlying &= distance > 0.5 * distance.max(initial=0.0)
        if not outlying.any() or (~outlying).sum() < MIN_CORNERS:
            continue
        noted = outliers.setdefault(view.capture.id, [])
        noted += [(int(index), float(px)) for index, px in zip(view.index[outlying], distance[outlying], strict=True)]
        kept[k] = view.only(~outlying)
        found = True
    return found


def _corner_reason(numbers: list[tuple[int, float]], noise_px: float) -> str:
    """Say which corners were left out and why."""
    which = ", ".join(f"{index} ({px:.2f} px)" for index, px in sorted(numbers))
    return f"corners {which} lie off, where the others have a standard deviation of {noise_px:.3f} px"


def list_reasons(rejected: Sequence[Skipped]) -> str:
    """Say what was left out and why, for the end of a sentence: the first three, and how many more."""
    more = f"; and {len(rejected) - MOST_LISTED} more" if len(rejected) > MOST_LISTED else ""
    return "".join(f"; {one.step}: {one.reason}" for one in rejected[:MOST_LISTED]) + more


def _check_board(
    views: Sequence[BoardView], solution: Solution, shape: tuple[int, int], rejected: Sequence[Skipped]
) -> None:
    """Raise `NotDetermined` where the rms is too large for any camera."""
    diagonal = float(np.hypot(*shape))
    if not solution.rms_px < LARGEST_RMS_SHARE * diagonal:
        capture = views[0].capture
        of_views = [rms_px(residual) for residual in solution.residuals]
        worst = int(np.argmax(of_views))
        raise NotDetermined(
            "geometry",
            f"no camera explains the corners (rms {solution.rms_px:.1f} px, worst: {views[worst].capture.id}, "
            f"{of_views[worst]:.1f} px{list_reasons(rejected)}): check that the board has {capture.squares[0]} x "
            f"{capture.squares[1]} squares, that it is flat, and that it didn't move while it was exposed",
        )


def _check_focal_length(solution: Solution) -> None:
    """Raise `NotDetermined` where the focal length is uncertain by more than 10 %."""
    focal = float(solution.state.intrinsics[0, 0])
    uncertain = float(solution.std()[0]) / focal if solution.determined and focal > 0 else np.inf
    if uncertain <= LARGEST_FOCAL_STD:
        return
    normals = solution.state.rotations[:, :, 2]
    apart = np.rad2deg(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))).max()
    why = (
        f"all views are parallel within {apart:.0f} deg, so that focal length and distance can't be told apart"
        if apart < PARALLEL_DEG
        else f"its standard deviation is {100 * min(uncertain, 9.99):.0f} %"
    )
    raise NotDetermined(
        "geometry", f"the focal length isn't determined: {why}; tilt the board by 20..40 deg in several views"
    )


def cross_validation(calibration: Calibration) -> CrossValidation | None:
    """Return the difference of two halves (`compare_halves`) as a result: the error of the model apart from that of the
    sampling.
    """
    found = compare_halves(calibration)
    if found is None:
        return None
    whole, sampling_px = found
    explained = whole.rms_px if whole.significance_sigma > DIFFERENCE_SIGMA else 0.0
    beyond = max(explained, whole.expected_px) ** 2 - sampling_px**2
    return CrossValidation(
        difference_px=whole.rms_px,
        expected_px=whole.expected_px,
        sampling_px=sampling_px,
        significance_sigma=whole.significance_sigma,
        model_error_px=float(np.sqrt(max(beyond, 0.0) / 2.0)),
    )


def compare_halves(calibration: Calibration) -> tuple[Difference, float] | None:
    """Compare two cameras, each calibrated from every other view, at the places of the corners. Returns their
    difference and its expected rms, px, by the independent noise of the corners alone; None where the halves are too
    small.

    The errors that neighbouring corners share are those of all views.
    """
    views, coefficients = calibration.views, distortion_coefficients(calibration.solution)
    halves = [views[0::2], views[1::2]]
    if min(len(half) for half in halves) < MIN_VIEWS:
        return None
    solved = [calibrate(half, calibration.shape, coefficients) for half in halves]
    if not all(one.determined for one in solved):
        return None
    errors = calibration.solution.errors
    if errors is not None:
        solved = [
            with_model_error(half, calibration.shape, one, errors) for half, one in zip(halves, solved, strict=True)
        ]
    one, two = solved
    points = calibration.points
    points = points[:: max(1, len(points) // 300)]
    covariances = (
        one.of_camera() + two.of_camera(),
        one.of_camera(only_sampling=True) + two.of_camera(only_sampling=True),
    )
    whole, sampling = (
        difference(one.state.intrinsics[0], two.state.intrinsics[0], covariance, calibration.points, points)
        for covariance in covariances
    )
    return whole, sampling.expected_px


def widen_covariance(calibration: Calibration, validation: CrossValidation | None) -> Calibration:
    """Multiply the covariance by the square of what the halves differ by beyond their uncertainties; it stays where
    they agree.
    """
    if validation is None or validation.significance_sigma <= DIFFERENCE_SIGMA:
        return calibration
    factor = max(1.0, validation.difference_px / validation.expected_px)
    solution = calibration.solution
    return replace(
        calibration,
        solution=replace(
            solution,
            covariance=factor**2 * solution.covariance,
            sampling_covariance=solution.covariance_by_sampling,
        ),
    )


def distortion_coefficients(solution: Solution) -> tuple[str, ...]:
    """Return the names of the distortion coefficients that were fitted."""
    return tuple(name for name, free in zip(NAMES[4:], solution.free[0, 4:], strict=True) if free)
