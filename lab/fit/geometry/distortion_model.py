"""The choice of the distortion model, by views that its fit has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.fit.geometry.board_detection import BoardView
from lab.fit.geometry.bundle_adjustment import BundleAdjustment, Observation, RigParameters, Solution, board_key
from lab.fit.geometry.pinhole import COUNT, NAMES
from lab.formats.results import DistortionModel

Array = NDArray[np.floating[Any]]

FOLDS = 5
OVERFITTING_SHARE = (
    0.05  # of the squared error of held-out views, by which a richer model has to be worse to be refused
)
#: From simple to rich; each model has the coefficients of those before it.
MODELS = (("k1",), ("k1", "k2", "p1", "p2"), ("k1", "k2", "p1", "p2", "k3"))


def free_intrinsics(coefficients: Sequence[str], *, centre: bool = True) -> NDArray[np.bool_]:
    """Mask (12,) of the intrinsics that a distortion model fits: the pinhole and these coefficients; without `centre`
    the principal point is held.
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
    """The first view of each board."""
    first: dict[tuple[object, ...], BoardView] = {}
    for view in views:
        first.setdefault(board_key(view), view)
    return list(first.values())


def _held_out_square(
    view: BoardView, trained: RigParameters, board: int, solution: Solution, pose: int, shape: tuple[int, int]
) -> float:
    """Sum of squared residuals, px^2, of a view that the camera `trained` has not seen."""
    state = replace(
        trained,
        warps_mm=trained.warps_mm[board : board + 1],
        rotations=solution.state.rotations[pose : pose + 1],
        translations_mm=solution.state.translations_mm[pose : pose + 1],
    )
    only = BundleAdjustment([Observation(view, pose=0)], np.zeros((1, COUNT), dtype=bool), shape, only_poses=True)
    return float(np.sum(only.solve(state).residuals[0] ** 2))
