"""Corners of boards against the geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from lab.errors import NotDetermined
from lab.observables.boards.bundle_adjustment import BundleAdjustment, Solution
from lab.observables.boards.calibration import PROJECTIONS, calibration_of, free_intrinsics, observations_of
from lab.observables.boards.projection import CameraGeometry
from lab.observables.boards.views import BoardView
from lab.observables.colour_shift import REFERENCE_NM
from lab.observables.dataset import Study
from lab.observables.observable import Block, Label, Measurement, Prediction
from sim.effects.base import Effects
from sim.point import displaced_um
from sim.scene.projection import Projection
from sim.spectrum import FloatArray

ROWS, COLS = 3, 4  # cells of the frame
FEWEST_CORNERS = 6  # of a cell
CELL_FLOOR_PX = 0.006  # standard deviation of a cell's displacement beside noise
#: Prior standard deviation of a known distortion, at the frame's corner, of each of its terms.
CALIBRATED_STD_PX = 0.05
HELD_OUT_FROM = 6  # views; of as many or more, every third is held out


@dataclass(frozen=True)
class _Corners:
    """The n corners of all views, linearised about the solution of the bundle adjustment."""

    place: FloatArray  # (n, 2), (x, y) px
    left: FloatArray  # (n, 2), residuals: measured less predicted, px
    taken: FloatArray  # (2 n, k), orthonormal: spans the shifts that the fitted parameters can make
    noise_px: float  # standard deviation of a coordinate
    view: FloatArray  # (n,) number of the corner's view

    @staticmethod
    def of(views: Sequence[BoardView], solution: Solution, bundle: BundleAdjustment) -> _Corners:
        shared, by_pose = bundle.jacobian(solution.state)
        n = len(shared)
        free = shared.reshape(2 * n, -1)
        poses = np.zeros((2 * n, 6 * len(views)))
        for k, part in enumerate(bundle.parts):
            poses[2 * part.start : 2 * part.stop, 6 * k : 6 * k + 6] = by_pose[part].reshape(-1, 6)
        whole = np.concatenate([free, poses], axis=1)
        size = np.linalg.norm(whole, axis=0)
        u, s, _ = linalg.svd(whole[:, size > 0] / size[size > 0], full_matrices=False)
        return _Corners(
            place=np.concatenate([v.image_px for v in views]),
            left=np.asarray(bundle.residuals(solution.state), float),
            taken=np.asarray(u[:, s > 1e-9 * s[0]]),
            noise_px=solution.noise_px,
            view=np.concatenate([np.full(len(v.index), k) for k, v in enumerate(views)]),
        )


def board_block(study: Study) -> Block:
    """Mean residual of the corners (px), along and across the radius, by cell of the frame.

    Raises NotDetermined without charuco captures, where they don't determine the camera, and where no cell holds
    `FEWEST_CORNERS` corners.
    """
    try:
        found = calibration_of(study.recordings, study.side)
    except NotDetermined as refused:
        raise NotDetermined("boards", refused.reason) from refused
    known = study.camera.geometry
    views, state, shape = found.views, found.solution.state, found.shape
    if known is None:
        own = found.camera.projection
        free = found.solution.free[0] | free_intrinsics(PROJECTIONS[own.kind], own)
    else:
        free = free_intrinsics(())
        # focal length and principal point as of these boards, distortion as of the earlier calibration
        fixed = CameraGeometry.of(known.camera_matrix, known.distortion, Projection.of(known))
        start = np.array([np.concatenate([state.intrinsics[0, :4], fixed.intrinsics[4:]])])
        state = replace(state, projections=(fixed.projection,), intrinsics=start)
    bundle = BundleAdjustment(observations_of(views), free[None, :], shape)
    solution = bundle.solve(state)
    corners = _Corners.of(views, solution, bundle)
    noise_px = min(corners.noise_px, found.solution.noise_px)
    cells = _cells(study, corners, len(views))
    if not cells:
        raise NotDetermined("boards", f"no part of the frame holds {FEWEST_CORNERS} corners")
    mean, labels, views_of_cell = _averages(study, corners, cells)
    projected = mean - (mean @ corners.taken) @ corners.taken.T
    covariance = noise_px**2 * projected @ projected.T
    covariance += np.diag(np.full(len(labels), CELL_FLOOR_PX**2))
    covariance += np.diag(_between_views(corners, mean, noise_px) / np.maximum(views_of_cell, 1.0))
    jacobian = {} if known is None else _calibrated(corners, projected, solution, shape)
    captures = [v.capture.id for v in views]

    def predict(effects: Effects) -> Prediction:
        shifts = shifts_px(study, corners.place, effects)
        return Prediction(projected @ shifts.ravel(), jacobian)

    return Block(
        measurement=BOARDS, reach=0.4, value=mean @ corners.left.ravel(),
        covariance=covariance,
        labels=tuple(Label(r, "Y", way, tuple(captures[k] for k in used), out) for r, way, used, out in labels),
        reads=frozenset({"image.shift"}), predict=predict, scale=np.ones(len(labels)),
    )  # fmt: skip


def shifts_px(study: Study, place: FloatArray, effects: Effects) -> FloatArray:
    """Displacement (n, 2) of the image by the effects, px, at `place` (n, 2), (x, y) px, at `REFERENCE_NM`."""
    camera = study.camera
    pitch = camera.pixel_pitch_um
    x, y = ((place[:, k] - 0.5 * (n - 1)) * pitch for k, n in ((0, camera.cols), (1, camera.rows)))
    shift = displaced_um(camera, x, y, REFERENCE_NM, effects)
    return np.zeros_like(place) if shift is None else np.column_stack(shift) / pitch


def _cells(study: Study, corners: _Corners, views: int) -> list[tuple[np.ndarray, bool]]:
    """(mask of its corners (n,), whether held out) of each cell of the frame with corners enough, seen and held-out
    views apart."""
    camera = study.camera
    row = np.clip((corners.place[:, 1] + 0.5) / camera.rows * ROWS, 0, ROWS - 1e-9).astype(int)
    col = np.clip((corners.place[:, 0] + 0.5) / camera.cols * COLS, 0, COLS - 1e-9).astype(int)
    out = (corners.view % 3 == 1) & (views >= HELD_OUT_FROM)
    found = []
    for cell in range(ROWS * COLS):
        for held_out in (False, True):
            use = (row * COLS + col == cell) & (out == held_out)
            if use.sum() >= FEWEST_CORNERS:
                found.append((use, held_out))
    return found


def _averages(
    study: Study, corners: _Corners, cells: Sequence[tuple[np.ndarray, bool]]
) -> tuple[FloatArray, list[tuple[float, str, list[int], bool]], FloatArray]:
    """Weights (2 cells, 2 n) that average shifts along and across the radius; (radius, direction, views, held out) and
    the number of views of each."""
    camera = study.camera
    away = corners.place - 0.5 * (np.array([camera.cols, camera.rows]) - 1.0)
    radius = np.hypot(*away.T)
    unit = away / np.maximum(radius, 1e-9)[:, None]
    half = camera.half_diagonal_px
    rows, labels, counts = [], [], []
    for use, held_out in cells:
        seen = sorted({int(k) for k in corners.view[use]})
        for way, direction in (("along the radius", unit), ("across it", unit[:, ::-1] * [-1.0, 1.0])):
            rows.append(np.where(use[:, None], direction / use.sum(), 0.0).ravel())
            labels.append((float(radius[use].mean() / half), way, seen, held_out))
            counts.append(float(len(seen)))
    return np.array(rows), labels, np.array(counts)


def _between_views(corners: _Corners, mean: FloatArray, noise_px: float) -> float:
    """Variance (px^2) of a view's mean residual over a cell beyond that of independent corners: imperfect prints,
    motion, shading.

    The mean over views of (mean residual)^2 - noise^2 / n, of views with n >= 4 corners in the cell; at least 0.
    """
    excess, count = 0.0, 0
    for weight in mean:
        members = weight.reshape(-1, 2)
        for k in np.unique(corners.view[np.any(members != 0, axis=1)]):
            part = np.where((corners.view == k)[:, None], members, 0.0)
            total = float(np.linalg.norm(part, axis=1).sum())
            n = int(np.any(part != 0, axis=1).sum())
            if n >= 4:
                excess += float(np.sum(part * corners.left) / total) ** 2 - noise_px**2 / n
                count += 1
    return max(excess / count, 0.0) if count else 0.0


def _calibrated(
    corners: _Corners, projected: FloatArray, solution: Solution, shape: tuple[int, int]
) -> dict[str, FloatArray]:
    """Jacobian by the terms of a known distortion, as nuisance parameters: name -> (2 cells,), px per
    `CALIBRATED_STD_PX` at the frame's corner."""
    intrinsics = solution.state.intrinsics[0]
    focal = float(intrinsics[0])
    x, y = ((corners.place[:, k] - intrinsics[2 + k]) / focal for k in (0, 1))
    r2 = x * x + y * y
    corner = 0.25 * float(np.hypot(*shape)) ** 2 / focal**2
    terms = {
        "k1": (x * r2, y * r2, corner**1.5),
        "k2": (x * r2**2, y * r2**2, corner**2.5),
        "k3": (x * r2**3, y * r2**3, corner**3.5),
        "p1": (2 * x * y, r2 + 2 * y * y, 3 * corner),
        "p2": (r2 + 2 * x * x, 2 * x * y, 3 * corner),
    }
    return {
        f"boards:{name}": CALIBRATED_STD_PX / size * projected @ np.column_stack([dx, dy]).ravel()
        for name, (dx, dy, size) in terms.items()
    }


BOARDS = Measurement(
    "boards",
    title="corners of boards",
    order=500,
    axis="field",
    unit="half diagonals",
    make=board_block,
    quantity="shift of corners, px",
    conditions="direction",
    conditions_words="corners",
)
