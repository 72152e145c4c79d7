"""Corners of boards against the geometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from lab.errors import NotDetermined
from lab.observables.boards.bundle_adjustment import BundleAdjustment, Solution
from lab.observables.boards.calibration import (
    PROJECTIONS,
    Calibration,
    calibration_of,
    free_intrinsics,
    observations_of,
)
from lab.observables.boards.projection import CameraGeometry
from lab.observables.colour_shift import REFERENCE_NM
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from sim.effects.base import Effects
from sim.point import displaced_um
from sim.scene.projection import Projection
from sim.spectrum import FloatArray

ROWS, COLS = 3, 4  # cells of the frame
FEWEST_CORNERS = 6  # of a cell
#: Prior standard deviation of a known distortion, at the frame's corner, of each of its terms.
CALIBRATED_STD_PX = 0.05
#: Share of a standard deviation that a residual may be wrong by where displacements enter linearly.
LINEAR_SHARE = 0.1
#: Steps of a fixed point: a displacement that grows by 2 % over a pixel is found to 1e-5 of it.
PLACING_STEPS = 3
HELD_OUT_FROM = 6  # views; of as many or more, every third is held out


@dataclass(frozen=True)
class CellResiduals:
    """Mean residuals of the corners, measured less predicted, by cell of the frame: m numbers of n corners.

    `value` (m,), px. `covariance` (m, m), px^2, by the errors of the corners that the fit of the camera found: their
    noise, and what neighbours share. `labels` (m): distance from the middle, half diagonals; direction; captures;
    whether held out. `place` (n, 2): the corners, (x, y) px. `operator` (m, 2 n): what a displacement of the corners
    changes, after the fitted parameters have taken up their part of it. `solution`: about which that is linear.
    `refitted`: maps a displacement of the corners (n, 2) to what it changes, whatever its size.
    """

    value: FloatArray
    covariance: FloatArray
    labels: tuple[tuple[float, str, tuple[str, ...], bool], ...]
    place: FloatArray
    operator: FloatArray
    solution: Solution
    refitted: Callable[[FloatArray], FloatArray]

    def change(self, shift_px: FloatArray) -> FloatArray:
        """Return what a displacement (n, 2) of the corners, px, adds to `value`.

        Beyond the operator it is quadratic, the displacement squared over the focal length. Where that is more than
        `LINEAR_SHARE` of a standard deviation, the camera is fitted again without the displacement."""
        focal_px = float(self.solution.state.intrinsics[0, 0])
        quadratic = float(np.max(np.sum(np.square(shift_px), axis=1), initial=0.0)) / focal_px
        if quadratic < LINEAR_SHARE * float(np.sqrt(np.min(np.diag(self.covariance)))):
            return self.operator @ shift_px.ravel()
        return self.refitted(shift_px)


def cell_residuals(calibration: Calibration, known: CameraGeometry | None = None) -> CellResiduals:
    """Average the residuals along and across the radius, by cell of the frame.

    `known`: an earlier calibration, whose distortion is held; focal length and principal point are those of these
    boards. None: they are residuals of the richest model of the calibration's projection. Raises NotDetermined where no
    cell holds `FEWEST_CORNERS` corners.
    """
    views, state, shape = calibration.views, calibration.solution.state, calibration.shape
    if known is None:
        own = calibration.camera.projection
        free = calibration.solution.free[0] | free_intrinsics(PROJECTIONS[own.kind], own)
    else:
        free = free_intrinsics(())
        start = np.array([np.concatenate([state.intrinsics[0, :4], known.intrinsics[4:]])])
        state = replace(state, projections=(known.projection,), intrinsics=start)
    bundle = BundleAdjustment(observations_of(views), free[None, :], shape)
    solution = bundle.solve(state)
    place = np.concatenate([view.image_px for view in views])
    of_view = np.concatenate([np.full(len(view.index), k) for k, view in enumerate(views)])
    cells = _cells(place, of_view, shape)
    if not cells:
        raise NotDetermined("boards", f"no part of the frame holds {FEWEST_CORNERS} corners")
    mean, labels = _averages(place, cells, shape)
    taken = _taken_up(bundle, solution)
    operator = mean - (mean @ taken) @ taken.T
    value = mean @ np.concatenate(solution.residuals).ravel()

    def refitted(shift_px: FloatArray) -> FloatArray:
        at = np.split(place - shift_px, np.cumsum([len(view.index) for view in views])[:-1])
        without = [replace(view, image_px=moved) for view, moved in zip(views, at, strict=True)]
        fitted = BundleAdjustment(observations_of(without), free[None, :], shape).solve(solution.state)
        return np.asarray(value - mean @ np.concatenate(fitted.residuals).ravel())

    captures = [view.capture.id for view in views]
    return CellResiduals(
        value=value,
        covariance=_propagated(operator, calibration),
        labels=tuple(
            (radius, way, tuple(captures[k] for k in np.unique(of_view[use])), held_out)
            for radius, way, use, held_out in labels
        ),
        place=place,
        operator=operator,
        solution=solution,
        refitted=refitted,
    )


def _taken_up(bundle: BundleAdjustment, solution: Solution) -> FloatArray:
    """Return an orthonormal basis (2 n, k) of the displacements of the corners that the fitted parameters can make."""
    shared, by_pose = bundle.jacobian(solution.state)
    poses = np.zeros((2 * len(shared), 6 * len(bundle.parts)))
    for k, part in enumerate(bundle.parts):
        poses[2 * part.start : 2 * part.stop, 6 * k : 6 * k + 6] = by_pose[part].reshape(-1, 6)
    whole = np.concatenate([shared.reshape(len(poses), -1), poses], axis=1)
    size = np.linalg.norm(whole, axis=0)
    u, s, _ = linalg.svd(whole[:, size > 0] / size[size > 0], full_matrices=False)
    return np.asarray(u[:, s > 1e-9 * s[0]])


def _propagated(operator: FloatArray, calibration: Calibration) -> FloatArray:
    """Return operator V operator^T (m, m), px^2, of the covariance V of the corners' coordinates, by view."""
    solution, found, end = calibration.solution, np.zeros((len(operator), len(operator))), 0
    for view in calibration.views:
        begin, end = end, end + 2 * len(view.index)
        own = operator[:, begin:end].reshape(len(operator), -1, 2)
        if solution.errors is None:
            errors = solution.noise_px**2 * own
        else:
            v = solution.errors.covariance(view.squares, np.zeros(len(view.index), np.int64))
            errors = np.einsum("ij,mjk->mik", v, own)
        found += own.reshape(len(own), -1) @ errors.reshape(len(own), -1).T
    return found


def measure_boards(dataset: Dataset) -> Observable:
    """Mean residual of the corners (px), along and across the radius, by cell of the frame.

    Raises NotDetermined without charuco captures, where they don't determine the camera, and where no cell holds
    `FEWEST_CORNERS` corners.
    """
    try:
        calibration = calibration_of(dataset.recordings, dataset.side)
    except NotDetermined as refused:
        raise NotDetermined("boards", refused.reason) from refused
    known = dataset.camera.geometry
    earlier = None if known is None else CameraGeometry.of(known.camera_matrix, known.distortion, Projection.of(known))
    found = cell_residuals(calibration, earlier)
    count = len(found.value)
    jacobian = {} if known is None else _calibrated(found, calibration.shape)

    def predict(effects: Effects) -> Prediction:
        return Prediction(found.change(shifts_px(dataset, found.place, effects)), jacobian)

    return Observable(
        measurement=BOARDS, reach=0.4, value=found.value,
        covariance=found.covariance,
        labels=tuple(Label(radius, "Y", way, captures, out) for radius, way, captures, out in found.labels),
        reads=frozenset({"image.shift"}), predict=predict, scale=np.ones(count),
    )  # fmt: skip


def shifts_px(dataset: Dataset, place: FloatArray, effects: Effects) -> FloatArray:
    """Return the displacement (n, 2), px, by the effects at `REFERENCE_NM` of what is found at `place` (n, 2), (x, y)
    px: without them, it would be found at `place` less the displacement."""
    camera = dataset.camera
    pitch, middle = camera.pixel_pitch_um, 0.5 * (np.array([camera.cols, camera.rows]) - 1.0)
    found = np.zeros_like(place)
    for _ in range(PLACING_STEPS if effects else 0):
        x_um, y_um = ((place - found - middle) * pitch).T
        shift = displaced_um(camera, x_um, y_um, REFERENCE_NM, effects)
        if shift is None:
            break
        found = np.column_stack(shift) / pitch
    return found


def _cells(
    place: FloatArray, of_view: NDArray[np.int64], shape: tuple[int, int]
) -> list[tuple[NDArray[np.bool_], bool]]:
    """(mask of its corners (n,), whether held out) of each cell of the frame with corners enough, seen and held-out
    views apart."""
    rows, cols = shape
    row = np.clip((place[:, 1] + 0.5) / rows * ROWS, 0, ROWS - 1e-9).astype(int)
    col = np.clip((place[:, 0] + 0.5) / cols * COLS, 0, COLS - 1e-9).astype(int)
    out = (of_view % 3 == 1) & (of_view.max() + 1 >= HELD_OUT_FROM)
    found = []
    for cell in range(ROWS * COLS):
        for held_out in (False, True):
            use = (row * COLS + col == cell) & (out == held_out)
            if use.sum() >= FEWEST_CORNERS:
                found.append((use, held_out))
    return found


def _averages(
    place: FloatArray, cells: Sequence[tuple[NDArray[np.bool_], bool]], shape: tuple[int, int]
) -> tuple[FloatArray, list[tuple[float, str, NDArray[np.bool_], bool]]]:
    """Weights (2 cells, 2 n) that average shifts along and across the radius, and (radius, direction, mask of corners,
    whether held out) of each."""
    rows, cols = shape
    away = place - 0.5 * (np.array([cols, rows]) - 1.0)
    radius = np.hypot(*away.T)
    unit = away / np.maximum(radius, 1e-9)[:, None]
    half = 0.5 * float(np.hypot(rows, cols))
    weights, labels = [], []
    for use, held_out in cells:
        for way, direction in (("along the radius", unit), ("across it", unit[:, ::-1] * [-1.0, 1.0])):
            weights.append(np.where(use[:, None], direction / use.sum(), 0.0).ravel())
            labels.append((float(radius[use].mean() / half), way, use, held_out))
    return np.array(weights), labels


def _calibrated(found: CellResiduals, shape: tuple[int, int]) -> dict[str, FloatArray]:
    """Jacobian by the terms of a known distortion, as nuisance parameters: name -> (2 cells,), px per
    `CALIBRATED_STD_PX` at the frame's corner."""
    intrinsics = found.solution.state.intrinsics[0]
    focal = float(intrinsics[0])
    x, y = ((found.place[:, k] - intrinsics[2 + k]) / focal for k in (0, 1))
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
        f"boards:{name}": CALIBRATED_STD_PX / size * found.operator @ np.column_stack([dx, dy]).ravel()
        for name, (dx, dy, size) in terms.items()
    }


BOARDS = Measurement(
    "boards",
    title="corners of boards",
    order=500,
    axis="field",
    unit="half diagonals",
    make=measure_boards,
    quantity="shift of corners, px",
    conditions="direction",
    conditions_words="corners",
)
