"""Pairs of views: one pose of a board as both cameras saw it, and the rig that they show at first sight."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.observables.boards.corners import board_corners
from lab.observables.boards.first_state import board_pose
from lab.observables.boards.projection import CameraGeometry
from lab.observables.boards.views import BoardView
from sim.camera import Side

Array = NDArray[np.floating[Any]]
SIDES: tuple[Side, Side] = ("left", "right")


@dataclass(frozen=True)
class StereoPair:
    """One pose as both cameras saw it."""

    left: BoardView
    right: BoardView

    @property
    def pose(self) -> str:
        """The name of the pose."""
        return self.left.capture.pose

    @property
    def common(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where the corners that both cameras saw stand in the left view and in the right one."""
        _, at_left, at_right = np.intersect1d(self.left.index, self.right.index, return_indices=True)
        return at_left, at_right


def pair_views(left: Iterable[BoardView], right: Iterable[BoardView]) -> list[StereoPair]:
    """Pair the views of both cameras with the same `pose`, in the order of the left camera; the first of each where a
    pose was repeated.
    """
    of_left, of_right = _first_by_pose(left), _first_by_pose(right)
    return [StereoPair(view, of_right[pose]) for pose, view in of_left.items() if pose in of_right]


def _first_by_pose(views: Iterable[BoardView]) -> dict[str, BoardView]:
    """Return the first view of each pose."""
    found: dict[str, BoardView] = {}
    for view in views:
        found.setdefault(view.capture.pose, view)
    return found


def board_pairs(recordings: RecordingSet) -> list[StereoPair]:
    """Return the pairs of all views of a recording set."""
    left, right = (board_corners(recordings, side).views for side in SIDES)
    return pair_views(left, right)


def needs_both_sides(recordings: RecordingSet, side: Side, step: str) -> None:
    """Raise NotDetermined for `step` unless `side` is the right one of a pair."""
    if "left" not in recordings.sides or side != "right":
        raise NotDetermined(step, "a pair of cameras is looked at from its right side, beside the left one")


@dataclass(frozen=True)
class RigPoses:
    """The rig by each pair alone: left to right camera, `turns` (pairs,) and `shifts_mm` (pairs, 3); and the poses of
    the board before the left camera, `rotations` (pairs, 3, 3) and `translations_mm` (pairs, 3).
    """

    turns: tuple[Rotation, ...]
    shifts_mm: Array
    rotations: Array
    translations_mm: Array

    @property
    def median(self) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,), mm, of the rig: medians over the pairs."""
        turn = np.median([one.as_rotvec() for one in self.turns], axis=0)
        return np.asarray(Rotation.from_rotvec(turn).as_matrix()), np.median(self.shifts_mm, axis=0)


def rig_poses(pairs: Sequence[StereoPair], left: CameraGeometry, right: CameraGeometry) -> RigPoses:
    """Find the pose of the board in each view of the pairs, and the rig that it gives. Raises NotDetermined where a
    view has none.
    """
    turns, shifts, rotations, translations = [], [], [], []
    for pair in pairs:
        (rotation, translation), (of_right, behind) = board_pose(pair.left, left), board_pose(pair.right, right)
        turn = of_right @ rotation.T
        turns.append(Rotation.from_matrix(turn))
        shifts.append(behind - turn @ translation)
        rotations.append(rotation)
        translations.append(translation)
    return RigPoses(tuple(turns), np.array(shifts), np.array(rotations), np.array(translations))
