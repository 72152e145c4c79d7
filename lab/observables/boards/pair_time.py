"""Delay between the two cameras of a pair, from where each sees a moving board. Boards that stand still don't tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.errors import NotDetermined
from lab.observables.boards.calibration import calibration_of
from lab.observables.boards.corners import board_corners
from lab.observables.boards.pairs import SIDES, StereoPair, board_pairs, needs_both_sides, rig_poses
from lab.observables.boards.projection import CameraGeometry
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from sim.effects.base import Effects
from sim.frame import right_delay_s
from sim.spectrum import FloatArray

LONGEST_GAP_S = 1.0  # between captures from which a board's speed is taken
SLOWEST_PX_PER_S = 5.0  # speed of the fastest board from which on the delay is measured
FEWEST_PAIRS = 6  # of pictures of a moving board, for one delay and two offsets
SHIFT_STD_PX = 0.05  # standard deviation of a pair's displacement beside noise, as the speed varies between captures
POINTING_STD_PX = 2.0  # prior standard deviation of the displacement by the rig's rotation and the optical axes


def measure_stereo_time(dataset: Dataset) -> Observable:
    """Displacement (px) of a moving board in the right image from where the left camera's pose puts it, perpendicular
    to the rig's baseline.

    A delay t of the right camera displaces it by speed x t. Nuisance parameters: a common displacement, and its
    gradients over the frame. Raises NotDetermined where the cameras can't be calibrated, and for fewer than
    `FEWEST_PAIRS` pairs of a moving board."""
    needs_both_sides(dataset.recordings, dataset.side, "stereo_time")
    moving = _moving(dataset)
    try:
        left, right = (calibration_of(dataset.recordings, side) for side in SIDES)
    except NotDetermined as refused:
        raise NotDetermined("stereo_time", refused.reason) from refused
    of_pose = {pair.pose: pair for pair in board_pairs(dataset.recordings)}
    pairs = [of_pose[pose] for pose in moving if pose in of_pose]
    if len(pairs) < FEWEST_PAIRS:
        raise NotDetermined("stereo_time", f"{len(pairs)} pairs of a moving board, {FEWEST_PAIRS} needed")
    gaps, across = _gaps(pairs, left.camera, right.camera)
    speed = np.array([across @ moving[pair.pose] for pair in pairs])
    place = np.array([pair.right.image_px.mean(axis=0) for pair in pairs])
    place = (place - place.mean(axis=0)) / (0.5 * float(np.hypot(dataset.camera.rows, dataset.camera.cols)))
    noise = np.array([right.solution.noise_px**2 * 2.0 / len(pair.right.index) for pair in pairs])
    pointing = {
        "stereo:turn": np.full(len(pairs), POINTING_STD_PX),
        "stereo:x": POINTING_STD_PX * place[:, 0],
        "stereo:y": POINTING_STD_PX * place[:, 1],
    }

    def predict(effects: Effects) -> Prediction:
        return Prediction(right_delay_s(dataset.camera, effects) * speed, pointing)

    return Observable(
        measurement=STEREO_TIME, reach=1e9, value=gaps, covariance=np.diag(noise + SHIFT_STD_PX**2),
        labels=tuple(
            Label(float(v), "Y", pair.pose, (pair.left.capture.id, pair.right.capture.id), i % 3 == 1)
            for i, (v, pair) in enumerate(zip(speed, pairs, strict=True))
        ),
        reads=frozenset({"light.pair_delay_s"}), predict=predict, scale=np.ones(len(pairs)),
    )  # fmt: skip


def _moving(dataset: Dataset) -> dict[str, FloatArray]:
    """Pose -> speed (x, y) of the board in the right image, px/s, from the captures just before and after it.

    Raises NotDetermined where no board moves.
    """
    views = board_corners(dataset.recordings, "right").views
    timed = [(dataset.elapsed_s(v.capture), v) for v in views if v.capture.time is not None]
    timed.sort(key=lambda one: one[0])
    found = {}
    for (start, before), (_, here), (end, after) in zip(timed, timed[1:], timed[2:], strict=False):
        lasted = end - start
        index, first, last = np.intersect1d(before.index, after.index, return_indices=True)
        if not 0.0 < lasted <= 2.0 * LONGEST_GAP_S or len(index) < 4:
            continue
        found[here.capture.pose] = np.asarray(
            (after.image_px[last] - before.image_px[first]).mean(axis=0) / lasted, float
        )
    fastest = max((float(np.hypot(*v)) for v in found.values()), default=0.0)
    if fastest < SLOWEST_PX_PER_S:
        raise NotDetermined(
            "stereo_time",
            f"no board moves between captures less than {LONGEST_GAP_S:g} s apart: only what moves shows whether both "
            "sides capture at the same time",
        )
    return found


def _gaps(pairs: Sequence[StereoPair], left: CameraGeometry, right: CameraGeometry) -> tuple[FloatArray, FloatArray]:
    """Mean displacement (pairs,), px, of each pair's corners in the right image, perpendicular to the rig's baseline
    there; and the unit vector (x, y) of that direction. The rig's pose is the median over pairs."""
    poses = rig_poses(pairs, left, right)
    rotation, translation = poses.median
    along = translation[:2] / max(float(np.hypot(*translation[:2])), 1e-12)
    across = np.array([-along[1], along[0]])
    gaps = []
    for pair, turn, shift in zip(pairs, poses.rotations, poses.translations_mm, strict=True):
        points = (pair.right.board_mm @ turn.T + shift) @ rotation.T + translation
        gaps.append(float(((pair.right.image_px - right.project(points)) @ across).mean()))
    return np.array(gaps), across


STEREO_TIME = Measurement(
    "stereo_time",
    title="capture times of the two cameras",
    order=610,
    axis="time",
    unit="px/s",
    make=measure_stereo_time,
    quantity="displacement, px",
)
