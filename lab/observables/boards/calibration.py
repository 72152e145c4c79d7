"""One camera from views of a board, without the corners and views that don't fit (`calibrate_robustly`).

The distortion model is chosen by views that its fit has not seen (`choose_model`). The error of the camera model shows
where two halves of the views, calibrated separately, differ beyond their uncertainties (`cross_validation`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.formats.results import CrossValidation, DistortionModel, Skipped
from lab.observables.boards.bundle_adjustment import BundleAdjustment, Observation, RigParameters, Solution, rms_px
from lab.observables.boards.corners import board_corners
from lab.observables.boards.correlated_errors import CorrelatedErrors
from lab.observables.boards.first_state import board_pose, first_camera, first_state, splined, with_boards
from lab.observables.boards.projection import CameraGeometry, Difference, difference, points_at, projection_std
from lab.observables.boards.views import MIN_CORNERS, BoardView, board_key
from sim.camera import ProjectionKind, Side
from sim.scene.projection import CAMERA, COUNT, EQUIDISTANT, PINHOLE, Projection

Array = NDArray[np.floating[Any]]
FOLDS = 5
#: Of the squared error of held-out views, by which a richer model has to be worse to be refused.
OVERFITTING_SHARE = 0.05
#: Chance of taking another projection where both predict alike.
PROJECTION_FALSE_ALARM = 0.01
#: Of a pinhole, from simple to rich; each model has the coefficients of those before it.
MODELS = (("k1",), ("k1", "k2", "p1", "p2"), ("k1", "k2", "p1", "p2", "k3"))
#: The projections, from the most usual one, with the coefficients of their richest model.
PROJECTIONS: dict[ProjectionKind, tuple[str, ...]] = {
    "pinhole": MODELS[-1],
    "equidistant": EQUIDISTANT.coefficients,
    "splined_stereographic": Projection("splined_stereographic", 90.0).coefficients,
}

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


def free_intrinsics(
    coefficients: Sequence[str], projection: Projection = PINHOLE, *, centre: bool = True
) -> NDArray[np.bool_]:
    """Return the mask (12,) of the intrinsics that a distortion model fits: the camera matrix and these coefficients;
    without `centre` the principal point is held.
    """
    matrix = CAMERA if centre else CAMERA[:2]
    return np.array([name in (*matrix, *coefficients) for name in projection.names])


@dataclass(frozen=True)
class _Model:
    """A projection with the coefficients of its distortion."""

    kind: ProjectionKind
    coefficients: tuple[str, ...]


def choose_model(
    views: Sequence[BoardView], shape: tuple[int, int], solutions: Mapping[ProjectionKind, Solution]
) -> tuple[ProjectionKind, tuple[str, ...], tuple[DistortionModel, ...]]:
    """Choose the projection and the coefficients of its distortion by cross-validation, and list how well each model
    predicts held-out views. `solutions`: of all `views`, by projection.

    Each model is fitted to the other views; of a held-out view only the pose is fitted. Of the pinholes the richest is
    taken unless a simpler one predicts the held-out views better, by more than its standard deviation and by 5 % of the
    squared error. A coefficient is never dropped for being small: this would claim that it is known to be 0, and make
    the uncertainty of the others too small. Another projection is taken where it predicts the held-out views better
    (`_projects_better`).
    """
    models = [
        _Model(kind, coefficients)
        for kind in solutions
        for coefficients in (MODELS if kind == "pinhole" else (PROJECTIONS[kind],))
    ]
    scores = {model: _held_out_squares(views, shape, model, solutions[model.kind]) for model in models}
    counts = sum(len(view.index) for view in views)
    best, reasons = models[0], dict.fromkeys(models, "")
    for kind in solutions:
        own = [model for model in models if model.kind == kind]
        richest = own[-1]
        for model in reversed(own[:-1]):
            if _is_better(scores[model], scores[richest], 1.0):
                reasons[richest] = "refused: it predicts held-out views worse than a simpler one does"
                richest = model
        if best.kind == kind or _projects_better(scores[richest], scores[best]):
            best = richest
    listed = []
    for model in models:
        reason = reasons[model]
        change = 100.0 * (np.sqrt(scores[model].sum() / scores[best].sum()) - 1.0)
        if model == best:
            reason = "chosen: no simpler model predicts held-out views better"
        elif model.kind != best.kind:
            reason = f"another projection, and no better: held-out views change by {change:+.2g} %"
        elif not reason:
            reason = f"simpler, and no better: held-out views change by {change:+.2g} %"
        listed.append(
            DistortionModel(
                lens_projection=model.kind,
                coefficients=model.coefficients,
                held_out_rms_px=float(np.sqrt(scores[model].sum() / counts)),
                chosen=model == best,
                reason=reason,
            )
        )
    return best.kind, best.coefficients, tuple(listed)


def _is_better(one: Array, other: Array, sigma: float) -> bool:
    """Tell whether the squared errors (views,) of `one` are smaller, by more than `sigma` standard deviations of the
    sum of the differences and by 5 %.
    """
    worse = other - one
    error = float(np.std(worse, ddof=1) * np.sqrt(len(worse)))
    return float(worse.sum()) > max(sigma * error, OVERFITTING_SHARE * float(one.sum()))


def _projects_better(one: Array, other: Array) -> bool:
    """Tell whether the squared errors (views,) of `one` are smaller, by 5 % in sum and by Wilcoxon's signed-rank test
    at 1 %, which one bad view doesn't sway. With fewer than seven views, whose test has no such level: in every view.
    """
    if not float(other.sum()) > (1.0 + OVERFITTING_SHARE) * float(one.sum()):
        return False
    chance = float(stats.wilcoxon(other, one, alternative="greater", method="auto").pvalue)
    return chance <= max(PROJECTION_FALSE_ALARM, 0.5 ** len(one))


def _held_out_squares(views: Sequence[BoardView], shape: tuple[int, int], model: _Model, solution: Solution) -> Array:
    """Return the sum of squared residuals, px^2, of each view (views,), predicted by the `model` of the other folds."""
    found = np.zeros(len(views))
    boards = {board_key(view): number for number, view in enumerate(first_view_of_boards(views))}
    free = free_intrinsics(model.coefficients, solution.state.projections[0])
    for first in range(min(FOLDS, len(views))):
        fold = range(first, len(views), FOLDS)
        rest = [k for k in range(len(views)) if k not in fold]
        if len(rest) < 2:
            continue
        start = solution.state
        held = replace(
            start,
            intrinsics=np.where(free, start.intrinsics, 0.0),
            rotations=start.rotations[rest],
            translations_mm=start.translations_mm[rest],
        )
        observations = [
            Observation(views[k], pose=number, board=boards[board_key(views[k])]) for number, k in enumerate(rest)
        ]
        trained = BundleAdjustment(observations, free[None, :], shape, boards=len(boards)).solve(held).state
        for k in fold:
            found[k] = _held_out_square(views[k], trained, boards[board_key(views[k])], solution, k, shape)
    return found


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
    square = float(np.sum(only.solve(state).residuals[0] ** 2))
    # Where the projection isn't defined for a corner, it is off by as much as the frame is wide
    return square if np.isfinite(square) else len(view.index) * float(np.hypot(*shape)) ** 2


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
        """Return the intrinsics (12,); see `sim.scene.projection`."""
        return np.asarray(self.solution.state.intrinsics[0])

    @property
    def camera(self) -> CameraGeometry:
        """Return the camera."""
        return self.solution.state.camera()

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
        points = points_at(image, self.camera, distance_mm)
        return projection_std(self.camera, self.covariance, self.points, points)


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


def calibrate(
    views: Sequence[BoardView],
    shape: tuple[int, int],
    coefficients: Sequence[str] = (),
    kind: ProjectionKind = "pinhole",
) -> Solution:
    """Calibrate one camera from all views, in frames of `shape` (rows, cols), with a projection of `kind` and the
    distortion `coefficients`; none given: those of its richest model.

    The solve starts without distortion and goes by way of k1 about the middle of the frame: otherwise a rich model may
    end in another minimum. With a free centre k1 alone takes a decentred lens for one whose centre is far off, from
    where the richer model doesn't come back. A splined projection starts from the equidistant one.
    """
    observations = observations_of(views)
    boards = 1 + max(observation.board for observation in observations)
    coefficients = coefficients or PROJECTIONS[kind]
    if kind == "splined_stereographic":
        start = calibrate(views, shape, (), "equidistant").state
        camera = splined(start.camera(), shape)
        start = replace(start, projections=(camera.projection,), intrinsics=camera.intrinsics[None, :])
    else:
        projection = PINHOLE if kind == "pinhole" else EQUIDISTANT
        start = with_boards(first_state(views, first_camera(views, shape, projection)), boards)
        free = free_intrinsics(MODELS[0], projection, centre=False)
        start = BundleAdjustment(observations, free[None, :], shape).solve(start).state
    free = free_intrinsics(coefficients, start.projections[0])
    return BundleAdjustment(observations, free[None, :], shape).solve(start)


def with_model_error(
    views: Sequence[BoardView], shape: tuple[int, int], solution: Solution, errors: CorrelatedErrors | None = None
) -> Solution:
    """Return the solution of `calibrate` with the errors that neighbouring corners share in its covariance: `errors`,
    or those that its residuals show.
    """
    return BundleAdjustment(observations_of(views), solution.free, shape).with_correlated_errors(solution, errors)


def calibration_of(recordings: RecordingSet, side: Side) -> Calibration:
    """Return the camera of `side`, calibrated once by the boards of its `charuco` captures.

    Raises `NotDetermined` below 3 good views, where the board isn't what the captures say, or where all views are
    parallel to each other: without perspective, focal length and distance can't be separated.
    """

    def made() -> Calibration:
        boards, camera = board_corners(recordings, side), recordings.camera(side)
        if not boards.views and not boards.missed:
            raise NotDetermined("geometry", "no charuco captures")
        if len(boards.views) < MIN_VIEWS:
            raise NotDetermined(
                "geometry",
                f"{len(boards.views)} views of the board can be used, {MIN_VIEWS} are needed"
                f"{list_reasons(boards.missed)}",
            )
        return calibrate_robustly(boards.views, (camera.rows, camera.cols), side)

    return recordings.once(("calibration by boards", side), made)


def calibrate_robustly(views: Sequence[BoardView], shape: tuple[int, int], side: Side | None = None) -> Calibration:
    """Calibrate without the corners and views that don't fit, with the projection and the distortion model that predict
    unseen views best. The errors that neighbouring corners share are in the covariance.

    A corner is left out beyond 5 standard deviations of the others. A view is left out where its rms is beyond 3 times
    the median, or where a quarter of its corners would go. What a projection can't follow it takes for outliers:
    projections are compared on the corners of that which leaves out the fewest. Raises `NotDetermined` where too few
    views are left, where no camera explains them, or where they don't determine the focal length.
    """
    fits: dict[ProjectionKind, _RobustFit] = {}
    refused: NotDetermined | None = None
    for kind in PROJECTIONS:
        try:
            fits[kind] = _fit_without_outliers(views, shape, kind, side)
        except NotDetermined as reason:
            refused = refused or reason
    if refused is not None and not fits:
        raise refused
    common = max(fits.values(), key=lambda fit: fit.corners).views
    solutions = {
        kind: fit.solution if fit.views is common else calibrate(common, shape, (), kind) for kind, fit in fits.items()
    }
    chosen, coefficients, models = choose_model(common, shape, solutions)
    kept, rejected, outliers, solution = (
        getattr(fits[chosen], name) for name in ("views", "rejected", "outliers", "solution")
    )
    _check_board(kept, solution, shape, rejected)
    if coefficients != PROJECTIONS[chosen]:
        solution = calibrate(kept, shape, coefficients, chosen)
    solution = with_model_error(kept, shape, solution)
    _check_focal_length(solution)
    corners = tuple(
        Skipped(step=capture, reason=_corner_reason(numbers, solution.noise_px), side=side)
        for capture, numbers in outliers.items()
    )
    return Calibration(tuple(kept), solution, shape, models, tuple(rejected), corners)


@dataclass(frozen=True)
class _RobustFit:
    """A fit of one projection to the views and corners that it explains.

    `outliers`: capture -> (number, distance in px) of the corners that were left out of it.
    """

    views: list[BoardView]
    solution: Solution
    rejected: list[Skipped]
    outliers: dict[str, list[tuple[int, float]]]

    @property
    def corners(self) -> int:
        """Return the number of corners that were kept."""
        return sum(len(view.index) for view in self.views)


def _fit_without_outliers(
    views: Sequence[BoardView], shape: tuple[int, int], kind: ProjectionKind, side: Side | None
) -> _RobustFit:
    """Fit the richest model of a projection without the corners and views that don't fit."""
    kept: list[BoardView] = []
    rejected: list[Skipped] = []
    start = first_camera(views, shape, PINHOLE if kind == "pinhole" else EQUIDISTANT)
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
        solution = calibrate(kept, shape, (), kind)
        outlying = _outlying_view(kept, solution)
        if outlying is not None:
            which, reason = outlying
            rejected.append(Skipped(step=kept[which].capture.id, reason=reason, side=side))
            outliers.pop(kept[which].capture.id, None)
            del kept[which]
            continue
        if not _remove_outlying_corners(kept, solution, outliers):
            return _RobustFit(kept, solution, rejected, outliers)


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
    kind = calibration.camera.projection.kind
    solved = [calibrate(half, calibration.shape, coefficients, kind) for half in halves]
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
    whole, sampling = (
        difference(
            one.state.camera(),
            two.state.camera(),
            (one.of_camera(only_sampling=only_sampling), two.of_camera(only_sampling=only_sampling)),
            calibration.points,
            points,
        )
        for only_sampling in (False, True)
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
    names = solution.state.projections[0].names
    return tuple(name for name, free in zip(names[4:], solution.free[0, 4:], strict=True) if free)
