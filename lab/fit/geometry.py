"""Intrinsics of a camera from views of a board, with what is known of their errors.

The boards are the `charuco` captures (see `lab.fit.board`). Solved for are OpenCV's pinhole and distortion, the poses, and the
boards' own warp, by the bundle adjustment of `lab.fit.bundle`; the full covariance follows from its Jacobian and the scatter of
the corners. Besides:

- single corners and whole views that don't fit are left out, with the reason;
- the distortion model is chosen by views that its fit has not seen: a richer model is refused where it predicts them worse;
- two halves of the views are calibrated by themselves: what they differ by beyond the corners' noise is an error of the model;
- the uncertainty of the projection is mapped over the frame (`lab.fit.projection`);
- each colour of a mosaic has its corners and its distortion: lateral colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.fit.board import MIN_CORNERS, BoardView, CornerFits, channel_corners, find_boards
from lab.fit.bundle import (
    Bundle,
    Sight,
    Solution,
    board_key,
    board_pose,
    first_intrinsics,
    first_state,
    warp_prior_mm,
    with_boards,
)
from lab.fit.pinhole import COUNT, NAMES, distortion_of, matrix_of, project_slopes, unproject
from lab.fit.projection import Difference, difference, grid, grid_points, points_at, projection_std
from lab.formats.recording_set import RecordingSet
from lab.formats.results import (
    BoardWarp,
    ChannelGeometry,
    CrossValidation,
    DistortionModel,
    GeometryFit,
    ProjectionUncertainty,
    Skipped,
    ViewResiduals,
)
from sim.camera import Side

Array = NDArray[np.floating[Any]]

MIN_VIEWS = 3
OUTLYING_VIEW = 3.0  # times the median rms of the views
OUTLYING_VIEW_PX = 0.1  # below this no view is left out
OUTLYING_CORNER = 5.0  # standard deviations of a coordinate: of 2000 good corners, one in 500 calibrations
OUTLYING_SHARE = 0.25  # of a view's corners: more, and it is the view that is wrong
NOT_A_BOARD = 0.005  # rms over the frame's diagonal, above which no camera explains the corners
FOCAL_KNOWN = 0.1  # relative uncertainty of the focal length, above which it isn't determined
PARALLEL_DEG = 5.0
FOLDS = 5
OVERFITTED = 0.05  # of the squared error of held-out views, by which a richer model has to be worse to be refused
#: From simple to rich; each model has the coefficients of those before it.
MODELS = (("k1",), ("k1", "k2", "p1", "p2"), ("k1", "k2", "p1", "p2", "k3"))
WARP_KNOWN = 0.5  # of the prior's standard deviation, above which the views have said nothing about a warp
DIFFERENT = 2.6  # sigma: two halves of the views that differ by more, at 1 %, don't follow one model


@dataclass(frozen=True)
class Calibration:
    """A camera's solution with the views it rests on, and what was left out on the way."""

    views: tuple[BoardView, ...]
    solution: Solution
    shape: tuple[int, int]  # rows, cols of the frame
    models: tuple[DistortionModel, ...] = ()
    rejected: tuple[Skipped, ...] = ()
    rejected_corners: tuple[Skipped, ...] = ()

    @property
    def intrinsics(self) -> Array:
        """(12,), see `lab.fit.pinhole`."""
        return np.asarray(self.solution.state.intrinsics[0])

    @property
    def covariance(self) -> Array:
        """(12, 12) of the intrinsics."""
        return self.solution.of_camera(0)

    @property
    def points(self) -> Array:
        """Corners (n, 3) in the camera's frame: what ties an implied motion down."""
        return placed_points(self.views, self.solution)

    def projection_std(self, image: Array, distance_mm: float | None) -> Array:
        """Standard uncertainty (n,) of projecting to `image` (n, 2) from a distance, px; NaN where nothing projects."""
        points = points_at(image, self.intrinsics, distance_mm)
        return projection_std(self.intrinsics, self.covariance, self.points, points)


def placed_points(views: Sequence[BoardView], solution: Solution, camera: int = 0) -> Array:
    """Corners (n, 3) of `views`, one pose each, in the frame of the first camera."""
    state = solution.state
    return np.concatenate(
        [view.board_mm @ state.turns[k].T + state.shifts_mm[k] for k, view in enumerate(views)]
    ).astype(float)


def sights_of(views: Sequence[BoardView]) -> list[Sight]:
    """Views of one camera, each its own pose; views of equal boards share the board."""
    keys = list(dict.fromkeys(board_key(view) for view in views))
    return [Sight(view, pose=k, board=keys.index(board_key(view))) for k, view in enumerate(views)]


def free_intrinsics(coefficients: Sequence[str]) -> NDArray[np.bool_]:
    """Mask (12,) of a distortion model: the pinhole and these coefficients."""
    return np.array([name in ("fx", "fy", "cx", "cy", *coefficients) for name in NAMES])


# --- the solve, and what it leaves out -------------------------------------------------------------------------------------


def calibrate(views: Sequence[BoardView], shape: tuple[int, int], coefficients: Sequence[str] = MODELS[-1]) -> Solution:
    """One camera from views in frames of `shape` (rows, cols), with the distortion `coefficients`; all views are used."""
    sights = sights_of(views)
    start = first_state(views, first_intrinsics(views, shape))
    start = with_boards(start, 1 + max(sight.board for sight in sights))
    # From the pinhole by way of k1: a rich model that starts from poses without distortion can end beside the minimum.
    rough = Bundle(sights, free_intrinsics(MODELS[0])[None, :], shape).solve(start)
    return Bundle(sights, free_intrinsics(coefficients)[None, :], shape).solve(rough.state)


def calibrate_robustly(views: Sequence[BoardView], shape: tuple[int, int], side: Side | None = None) -> Calibration:
    """`calibrate` without views and corners that don't fit, with the distortion model that predicts unseen views best.

    A corner is left out beyond 5 standard deviations of the others; a view where its rms is beyond 3 times the median, or a
    quarter of its corners would go. Raises `NotDetermined` where too few views are left, where no camera explains them, or
    where they don't determine the focal length.
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
    stray: dict[str, list[tuple[int, float]]] = {}
    while True:
        if len(kept) < MIN_VIEWS:
            why = f"; {rejected[0].step}: {rejected[0].reason}" if rejected else ""
            raise NotDetermined("geometry", f"{len(kept)} views of the board can be used, {MIN_VIEWS} are needed{why}")
        solution = calibrate(kept, shape)
        outlying = _outlying_view(kept, solution)
        if outlying is not None:
            which, reason = outlying
            rejected.append(Skipped(step=kept[which].capture.id, reason=reason, side=side))
            stray.pop(kept[which].capture.id, None)
            del kept[which]
            continue
        if not _leave_out_corners(kept, solution, stray):
            break
    _check_board(kept, solution, shape)
    coefficients, models = choose_model(kept, shape, solution)
    if coefficients != MODELS[-1]:
        solution = calibrate(kept, shape, coefficients)
    _check_focal_length(solution)
    corners = tuple(
        Skipped(step=capture, reason=_corner_reason(numbers, solution.noise_px), side=side)
        for capture, numbers in stray.items()
    )
    return Calibration(tuple(kept), solution, shape, models, tuple(rejected), corners)


def _outlying_view(views: Sequence[BoardView], solution: Solution) -> tuple[int, str] | None:
    """The view that fits worst, and why it goes."""
    squares = [np.sum(residual**2, axis=1) for residual in solution.residuals]
    rms = np.array([np.sqrt(np.mean(one)) for one in squares])
    # by the median of a view's corners: one stray corner is no reason to drop the others
    typical = np.array([np.sqrt(np.median(one)) for one in squares])
    limit = max(OUTLYING_VIEW * float(np.median(rms)), OUTLYING_VIEW_PX)
    worst = int(np.argmax(rms))
    if rms[worst] <= limit:
        return None
    far = squares[worst] > (OUTLYING_CORNER * max(solution_scatter(solution), 1e-3)) ** 2
    if far.mean() < OUTLYING_SHARE and typical[worst] <= limit and (~far).sum() >= MIN_CORNERS:
        return None
    return worst, f"rms {rms[worst]:.2f} px, where the other views have {np.median(rms):.2f} px"


def solution_scatter(solution: Solution) -> float:
    """Standard deviation of one coordinate, px, by the median: strays don't widen it."""
    return 1.4826 * float(np.median(np.abs(np.concatenate(solution.residuals))))


def _leave_out_corners(kept: list[BoardView], solution: Solution, stray: dict[str, list[tuple[int, float]]]) -> bool:
    """Take the stray corners out of `kept`, note them in `stray`; whether there were any."""
    scatter = max(solution_scatter(solution), 1e-3)
    found = False
    for k, (view, residual) in enumerate(zip(kept, solution.residuals, strict=True)):
        away = np.linalg.norm(residual, axis=1)
        far = away > OUTLYING_CORNER * scatter
        # the worst ones first: they pull others with them
        far &= away > 0.5 * away.max(initial=0.0)
        if not far.any() or (~far).sum() < MIN_CORNERS:
            continue
        noted = stray.setdefault(view.capture.id, [])
        noted += [(int(index), float(px)) for index, px in zip(view.index[far], away[far], strict=True)]
        kept[k] = view.only(~far)
        found = True
    return found


def _corner_reason(numbers: list[tuple[int, float]], noise_px: float) -> str:
    which = ", ".join(f"{index} ({px:.2f} px)" for index, px in sorted(numbers))
    return f"corners {which} lie off, where the others scatter by {noise_px:.3f} px"


def _check_board(views: Sequence[BoardView], solution: Solution, shape: tuple[int, int]) -> None:
    diagonal = float(np.hypot(*shape))
    if not solution.rms_px < NOT_A_BOARD * diagonal:
        capture = views[0].capture
        raise NotDetermined(
            "geometry",
            f"no camera explains the corners (rms {solution.rms_px:.1f} px): check that the board has {capture.squares[0]} x "
            f"{capture.squares[1]} squares, that it is flat, and that it didn't move while it was exposed",
        )


def _check_focal_length(solution: Solution) -> None:
    focal = float(solution.state.intrinsics[0, 0])
    uncertain = float(solution.std()[0]) / focal if solution.determined and focal > 0 else np.inf
    if uncertain <= FOCAL_KNOWN:
        return
    normals = solution.state.turns[:, :, 2]
    apart = np.rad2deg(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))).max()
    why = (
        f"all views are parallel within {apart:.0f} deg, so that focal length and distance can't be told apart"
        if apart < PARALLEL_DEG
        else f"it is open by {100 * min(uncertain, 9.99):.0f} %"
    )
    raise NotDetermined(
        "geometry", f"the focal length isn't determined: {why}; tilt the board by 20..40 deg in several views"
    )


# --- the distortion model, by views that its fit has not seen --------------------------------------------------------------


def choose_model(
    views: Sequence[BoardView], shape: tuple[int, int], solution: Solution
) -> tuple[tuple[str, ...], tuple[DistortionModel, ...]]:
    """The distortion model, and how each of `MODELS` predicts held-out views: fitted to the others, each held-out view gets a
    pose and nothing else.

    The richest model is taken unless a simpler one predicts the held-out views better, by more than chance and by enough to matter. A
    coefficient is thus never dropped for being small: that would claim that it is known to be 0, and its neighbours' uncertainties
    would be too small.
    """
    folds = [np.arange(start, len(views), min(FOLDS, len(views))) for start in range(min(FOLDS, len(views)))]
    scores = {model: np.zeros(len(views)) for model in MODELS}
    for fold in folds:
        rest = [k for k in range(len(views)) if k not in fold]
        chosen = [views[k] for k in rest]
        if len(chosen) < 2:
            continue
        start = solution.state
        start = replace(start, turns=start.turns[rest], shifts_mm=start.shifts_mm[rest])
        boards = {board_key(view): number for number, view in enumerate(_one_a_board(views))}
        for model in MODELS:
            free = free_intrinsics(model)
            held = replace(start, intrinsics=np.where(free, start.intrinsics, 0.0))
            sights = [Sight(view, pose=k, board=boards[board_key(view)]) for k, view in enumerate(chosen)]
            trained = Bundle(sights, free[None, :], shape, boards=len(boards)).solve(held).state
            for k in map(int, fold):
                scores[model][k] = _held_out(views[k], trained, boards[board_key(views[k])], solution, k, shape)
    counts = sum(len(view.index) for view in views)
    best = MODELS[-1]
    reasons = dict.fromkeys(MODELS, "")
    for model in reversed(MODELS[:-1]):
        worse = scores[best] - scores[model]
        error = float(np.std(worse, ddof=1) * np.sqrt(len(worse)))
        if worse.sum() > max(error, OVERFITTED * scores[model].sum()):
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


def _one_a_board(views: Sequence[BoardView]) -> list[BoardView]:
    first: dict[tuple[object, ...], BoardView] = {}
    for view in views:
        first.setdefault(board_key(view), view)
    return list(first.values())


def _held_out(
    view: BoardView, trained: Any, board: int, solution: Solution, pose: int, shape: tuple[int, int]
) -> float:
    """Sum of squared residuals (px^2) of a view that the camera `trained` has not seen."""
    state = replace(
        trained,
        warps_mm=trained.warps_mm[board : board + 1],
        turns=solution.state.turns[pose : pose + 1],
        shifts_mm=solution.state.shifts_mm[pose : pose + 1],
    )
    only = Bundle([Sight(view, pose=0)], np.zeros((1, COUNT), dtype=bool), shape, only_poses=True)
    return float(np.sum(only.solve(state).residuals[0] ** 2))


# --- what the errors are ----------------------------------------------------------------------------------------------------


def halves_differ(calibration: Calibration) -> Difference | None:
    """Two halves of the views, every other one, each calibrated by itself, compared where the corners were seen; None where the
    halves would be too small."""
    views, coefficients = calibration.views, _coefficients(calibration.solution)
    halves = [views[0::2], views[1::2]]
    if min(len(half) for half in halves) < MIN_VIEWS:
        return None
    one, two = (calibrate(half, calibration.shape, coefficients) for half in halves)
    if not (one.determined and two.determined):
        return None
    points = calibration.points
    points = points[:: max(1, len(points) // 300)]
    return difference(
        one.state.intrinsics[0], two.state.intrinsics[0], one.of_camera() + two.of_camera(), calibration.points, points
    )


def _coefficients(solution: Solution) -> tuple[str, ...]:
    return tuple(name for name, free in zip(NAMES[4:], solution.free[0, 4:], strict=True) if free)


def cross_validation(calibration: Calibration) -> CrossValidation | None:
    """`halves_differ` as a result: error of the model apart from error of the sampling."""
    found = halves_differ(calibration)
    if found is None:
        return None
    beyond = max(found.rms_px**2 - found.expected_px**2, 0.0) / 2.0
    sigma = found.significance_sigma
    return CrossValidation(
        difference_px=found.rms_px,
        expected_px=found.expected_px,
        significance_sigma=sigma,
        model_error_px=float(np.sqrt(beyond)) if sigma > DIFFERENT else 0.0,
    )


def projection_maps(calibration: Calibration) -> tuple[ProjectionUncertainty, ...]:
    """At the boards' middle distance, and at infinity."""
    x, y = grid(calibration.shape)
    image = grid_points(x, y)
    distances = (float(np.median(np.linalg.norm(calibration.points, axis=1))), None)
    found = []
    for distance_mm in distances:
        std = calibration.projection_std(image, distance_mm).reshape(len(y), len(x))
        if not np.isfinite(std).all():  # outside of where the distortion has an inverse
            std = np.where(np.isfinite(std), std, np.nanmax(std))
        found.append(
            ProjectionUncertainty(
                distance_mm=distance_mm, x_px=_numbers(x), y_px=_numbers(y), projection_px_std=_rows(std)
            )
        )
    return tuple(found)


def board_warps(views: Sequence[BoardView], warps_mm: Array, covariance: Array) -> tuple[BoardWarp, ...]:
    """The warps (boards, 3) as results; `covariance` of them all, in order. What the views say little about is None."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(-1, 3)
    found = []
    for number, view in enumerate(_one_a_board(views)):
        capture = view.capture
        known = std[number] < WARP_KNOWN * warp_prior_mm(view)
        fields: dict[str, float | None] = {}
        for k, field in enumerate(("bend_x_mm", "bend_y_mm", "twist_mm")):
            fields[field] = float(warps_mm[number, k]) if known[k] else None
            fields[f"{field}_std"] = float(std[number, k]) if known[k] else None
        name = f"{capture.squares[0]} x {capture.squares[1]} squares of {capture.square_mm:g} mm, {capture.dictionary}"
        found.append(BoardWarp(board=name, **fields))
    return tuple(found)


# --- lateral colour ----------------------------------------------------------------------------------------------------------


def channel_geometry(calibration: Calibration, corners: Sequence[dict[str, CornerFits]]) -> tuple[ChannelGeometry, ...]:
    """Each colour's camera, from where its corners (one entry for each view) lie beside the luminance's.

    Poses and boards are the same for all colours, so that only differences count: scale, principal point, k1 and k2 of each
    colour by least squares, dq = J dtheta. A colour's radial shift is its own less green's, over the distance from the principal
    point, positive outwards.
    """
    if not corners or "G" not in corners[0]:
        return ()
    intrinsics = calibration.intrinsics
    seen = np.concatenate([view.image_px for view in calibration.views])
    rays = unproject(seen, intrinsics)
    by_camera = project_slopes(rays, intrinsics)[2]
    directions = _colour_directions(intrinsics)
    slopes = by_camera @ directions
    farthest = float(np.linalg.norm(seen - intrinsics[2:4], axis=1).max())
    radius = np.linspace(0.0, farthest, 16)
    found = []
    for channel in corners[0]:
        trusted = np.concatenate([fits[channel].trusted & fits["G"].trusted for fits in corners])
        at = np.concatenate([fits[channel].points for fits in corners])
        green = np.concatenate([fits["G"].points for fits in corners])
        own = _fit_shift(at - seen, slopes, trusted)
        beside = _fit_shift(at - green, slopes, trusted) if channel != "G" else None
        if own is None or (channel != "G" and beside is None):
            continue
        theta = intrinsics + directions @ own[0]
        result = ChannelGeometry(
            channel=channel,
            camera_matrix=_matrix_rows(theta),
            distortion=_numbers(distortion_of(theta)),
            rms_px=own[2],
            corners=int(own[3]),
        )
        if beside is not None:
            # along the frame's diagonal: the radial part is the same in all directions but for fx/fy
            along = np.array([0.8, 0.6])
            line = unproject(intrinsics[2:4] + radius[:, None] * along, intrinsics)
            radial = np.einsum("i,nij->nj", along, project_slopes(line, intrinsics)[2] @ directions)
            radial[:, 1:3] = 0.0  # what is the same over the whole frame isn't radial
            result = result.model_copy(
                update={
                    "centre_shift_px": (float(beside[0][1]), float(beside[0][2])),
                    "centre_shift_px_std": _pair(np.sqrt(np.diag(beside[1])[1:3])),
                    "radius_px": _numbers(radius),
                    "radial_shift_px": _numbers(radial @ beside[0]),
                    "radial_shift_px_std": _numbers(np.sqrt(np.einsum("ni,ij,nj->n", radial, beside[1], radial))),
                }
            )
        found.append(result)
    return tuple(found)


def _colour_directions(intrinsics: Array) -> Array:
    """(12, 5): how scale, cx, cy, k1 and k2 move the intrinsics."""
    directions = np.zeros((COUNT, 5))
    directions[0, 0], directions[1, 0] = intrinsics[0], intrinsics[1]
    for column, row in ((1, 2), (2, 3), (3, 4), (4, 5)):
        directions[row, column] = 1.0
    return directions


def _fit_shift(shift: Array, slopes: Array, trusted: NDArray[np.bool_]) -> tuple[Array, Array, float, int] | None:
    """Parameters, covariance, rms (px) and number of corners of shift (n, 2) = slopes (n, 2, p) parameters; strays left out."""
    used = trusted.copy()
    for _ in range(4):
        if used.sum() < 4 * MIN_CORNERS:
            return None
        design = slopes[used].reshape(-1, slopes.shape[2])
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
        values = np.linalg.lstsq(design / scale, shift[used].ravel(), rcond=1e-12)[0] / scale
        rest = shift - slopes @ values
        away = np.linalg.norm(rest, axis=1)
        scatter = 1.4826 * float(np.median(np.abs(rest[used])))
        kept = trusted & (away < OUTLYING_CORNER * max(scatter, 1e-6))
        if np.array_equal(kept, used):
            break
        used = kept
    variance = float(np.sum(rest[used] ** 2)) / max(2 * used.sum() - len(values), 1)
    covariance = variance * np.linalg.pinv((design / scale).T @ (design / scale)) / np.outer(scale, scale)
    return values, covariance, float(np.sqrt(np.mean(away[used] ** 2))), int(used.sum())


# --- all of it ----------------------------------------------------------------------------------------------------------------


def fit_geometry(recordings: RecordingSet, side: Side) -> GeometryFit:
    """Camera matrix and distortion of `side` from its `charuco` captures (plain checkerboards: see `lab.fit.board`).

    Raises `NotDetermined` below 3 good views, where the board isn't what the captures say, or where all views are parallel to each
    other (no perspective: focal length and distance can't be told apart).
    """
    if not recordings.captures("charuco", side):
        raise NotDetermined("geometry", "no charuco captures")
    views, missed = find_boards(recordings, side)
    camera = recordings.camera(side)
    shape = (camera.rows, camera.cols)
    if len(views) < MIN_VIEWS:
        why = f"; {missed[0].step}: {missed[0].reason}" if missed else ""
        raise NotDetermined("geometry", f"{len(views)} views of the board can be used, {MIN_VIEWS} are needed{why}")
    calibration = calibrate_robustly(views, shape, side)
    channels: tuple[ChannelGeometry, ...] = ()
    if camera.cfa != "MONO":
        frames = (channel_corners(recordings.frame(view.capture), camera.cfa, view) for view in calibration.views)
        channels = channel_geometry(calibration, list(frames))
    return geometry_result(calibration, missed, channels)


def geometry_result(
    calibration: Calibration,
    missed: Sequence[Skipped] = (),
    channels: tuple[ChannelGeometry, ...] = (),
) -> GeometryFit:
    """A calibration with its errors as a result; `missed` are captures in which no board was found."""
    solution = calibration.solution
    validation = cross_validation(calibration)
    noises = [view.std_px for view in calibration.views if view.std_px is not None]
    of_pictures = float(np.sqrt(np.mean(np.concatenate(noises) ** 2))) if noises else None
    std = solution.std()
    intrinsics_only = int(solution.free.sum())
    warps = solution.covariance[intrinsics_only:, intrinsics_only:]
    fx, fy, cx, cy = (float(value) for value in std[:4])
    intrinsics = calibration.intrinsics
    return GeometryFit(
        camera_matrix=_matrix_rows(intrinsics),
        camera_matrix_std=((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 0.0)),
        distortion=_numbers(distortion_of(intrinsics)),
        distortion_std=_numbers(std[4 : 4 + len(distortion_of(intrinsics))]),
        rms_px=solution.rms_px,
        views=len(calibration.views),
        rejected=(*missed, *calibration.rejected),
        rejected_corners=calibration.rejected_corners,
        parameters=solution.names,
        covariance=_rows(solution.covariance),
        corner_px_std=solution.noise_px,
        corner_noise_px=of_pictures,
        board_warp=board_warps(calibration.views, solution.state.warps_mm, warps),
        distortion_models=calibration.models,
        cross_validation=validation,
        projection=projection_maps(calibration),
        channels=channels,
        residuals=view_residuals(calibration),
        remarks=tuple(_remarks(solution, validation, of_pictures)),
    )


def view_residuals(calibration: Calibration) -> tuple[ViewResiduals, ...]:
    """Where each view's corners were seen, and how far from their predictions."""
    state = calibration.solution.state
    found = []
    for k, (view, rest) in enumerate(zip(calibration.views, calibration.solution.residuals, strict=True)):
        depth = (view.board_mm @ state.turns[k].T + state.shifts_mm[k])[:, 2]
        found.append(
            ViewResiduals(
                capture=view.capture.id,
                corner=tuple(int(index) for index in view.index),
                x_px=_numbers(np.round(view.image_px[:, 0], 5)),
                y_px=_numbers(np.round(view.image_px[:, 1], 5)),
                dx_px=_numbers(np.round(rest[:, 0], 5)),
                dy_px=_numbers(np.round(rest[:, 1], 5)),
                depth_mm=_numbers(np.round(depth, 3)),
            )
        )
    return tuple(found)


def _remarks(solution: Solution, validation: CrossValidation | None, of_pictures: float | None) -> list[str]:
    said = []
    if of_pictures is not None and solution.noise_px > 2.0 * max(of_pictures, 1e-3):
        said.append(
            f"The corners scatter by {solution.noise_px:.3f} px about the model, where the pictures' noise accounts for "
            f"{of_pictures:.3f} px: the rest is the board's print and shape, motion, or the lens model."
        )
    if validation is None:
        said.append(f"Fewer than {2 * MIN_VIEWS} views: the model's own error can't be told from the sampling's.")
    elif validation.model_error_px > 0:
        said.append(
            f"Two halves of the views differ by {validation.difference_px:.3f} px over the frame, where the corners' noise lets "
            f"them differ by {validation.expected_px:.3f} px: the model is off by about {validation.model_error_px:.3f} px, which "
            "the standard uncertainties leave out."
        )
    return said


def _matrix_rows(intrinsics: Array) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(a), float(b), float(c)) for a, b, c in matrix_of(intrinsics))


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _rows(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(_numbers(row) for row in values)
