"""Two cameras in one scene: whether they answer it as they answer uniform light, and whether they capture at the same time.

Both are looked at from the right camera's side, beside the left one. What the two sensitivities differ by is each camera's own:
only what the scene adds to it counts. A difference in time shows in what moves; where boards stand still it isn't judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.white import WhiteCapture
from lab.diagnose.measurements.board import views_of
from lab.diagnose.measurements.summaries import Block, Effects, Label, Prediction, Study
from lab.errors import NotDetermined
from lab.fit.geometry.board_detection import BoardView
from lab.fit.geometry.bundle_adjustment import board_pose
from lab.fit.geometry.calibration import Calibration, calibrate_robustly
from lab.fit.geometry.pinhole import project
from sim.camera import Side
from sim.frame import right_delay_s, right_over_left
from sim.optics.illumination import relative_illumination
from sim.sensor import mosaic
from sim.spectrum import FloatArray

# Of a ratio of the two sides, relative.
SCENE_STD = 0.01  # a scene seen from two places: gloss, angles, edges of the region that is compared
CHANNEL_STD = 0.004  # light of another colour than the uniform light's, each channel by itself
OWN_STD = 0.004  # of one channel in one scene
LIGHT_STD = 0.005  # common to all scenes: the uniform light before one side and the other
SAME_LAMP = 0.02
SAME_COLOUR = 0.04  # of a ratio of channels
FEWEST_PIXELS = 200
#: Captures of a moving board that lie further apart say nothing of its speed.
LONGEST_GAP_S = 1.0
SLOWEST_PX_PER_S = 5.0
FEWEST_PAIRS = 6
SHIFT_STD_PX = 0.05  # of a pair: the speed between captures isn't even
POINTING_STD_PX = 2.0  # of the rig's turn and the cameras' axes, over the frame

SIDES: tuple[Side, Side] = ("left", "right")


def _both(study: Study, step: str) -> None:
    if "left" not in study.recordings.sides or study.side != "right":
        raise NotDetermined(step, "a pair of cameras is looked at from its right side, beside the left one")


class _Darks:
    """A side's signal without light, DN, by exposure: of its dark frames, or the maker's black level."""

    def __init__(self, study: Study, side: Side) -> None:
        frames = study.recordings.captures(DarkCapture, side)
        t = np.array([c.exposure_s for c in frames])
        level = np.array([float(np.mean(study.recordings.frame(c))) for c in frames])
        self._slope = 0.0
        if len(frames) and np.ptp(t) > 0:
            self._slope, self._black = (float(v) for v in np.polyfit(t, level, 1))
        elif len(frames):
            self._black = float(level.mean())
        else:
            self._black = study.recordings.camera(side).black_level_dn or 0.0

    def at(self, exposure_s: float) -> float:
        return self._black + self._slope * exposure_s


def scene_gain_block(study: Study) -> Block:
    """Right over left in every scene that both see, over the same of uniform light; natural logarithms, by channel."""
    _both(study, "stereo_gain")
    darks = {side: _Darks(study, side) for side in SIDES}
    uniform = [_uniform(study, side, darks[side]) for side in SIDES]
    if not all(uniform):
        missing = " and ".join(side for side, found in zip(SIDES, uniform, strict=True) if not found)
        raise NotDetermined(
            "stereo_gain", f"no unclipped flat captures of the {missing} camera: nothing to hold scenes against"
        )
    lamps = [(left, right) for left in uniform[0] for right in uniform[1] if left.like(right)]
    if not lamps:
        raise NotDetermined("stereo_gain", "the two sides' flats are of different lamps")
    values, labels = [], []
    for scene_name, regions in _scenes(study).items():
        rates = [
            _rates(study, side, darks[side], captures, mask)
            for side, (captures, mask) in zip(SIDES, regions, strict=True)
        ]
        alike = [
            pair for pair in lamps if all(_same_colour(rate, lamp) for rate, lamp in zip(rates, pair, strict=True))
        ]
        captures = tuple(c.id for part, _ in regions for c in part)
        for channel in study.channels if alike else ():
            of_light = np.mean([np.log(right.level[channel] / left.level[channel]) for left, right in alike])
            values.append(float(np.log(rates[1][channel] / rates[0][channel]) - of_light))
            labels.append(Label(float(len(values) - 1), channel, scene_name, captures, False))
    if not values:
        raise NotDetermined(
            "stereo_gain",
            "no scene that both cameras saw in the light of their flats: capture boards with both in that light",
        )
    scenes = np.array([label.condition for label in labels])
    colours = np.array([label.channel for label in labels])
    covariance = (
        SCENE_STD**2 * (scenes[:, None] == scenes) + CHANNEL_STD**2 * (colours[:, None] == colours) + LIGHT_STD**2
    )
    covariance = covariance + np.diag(np.full(len(values), OWN_STD**2))

    def predict(effects: Effects) -> Prediction:
        gain = right_over_left(study.camera, effects)
        return Prediction(np.full(len(values), np.log(max(gain, 1e-6))), {})

    return Block(
        measurement="stereo_gain", axis="level", unit="1", reach=1e9, value=np.array(values), covariance=covariance,
        labels=tuple(labels), reads=frozenset({"light.pair_gain"}), predict=predict, scale=np.ones(len(values)),
        conditions="scene", places="scenes",
    )  # fmt: skip


@dataclass(frozen=True)
class _Lamp:
    """A lamp before one side: the shape of its spectrum, and DN a second by channel over its radiance."""

    wavelength_nm: FloatArray
    shape: FloatArray  # sum 1
    level: dict[str, float]

    def like(self, other: _Lamp) -> bool:
        """Whether it's the same lamp, read anew: 2 % of its light at other wavelengths at most."""
        there = np.interp(self.wavelength_nm, other.wavelength_nm, other.shape, left=0.0, right=0.0)
        return bool(np.abs(there / max(there.sum(), 1e-300) - self.shape).sum() < SAME_LAMP)


def _uniform(study: Study, side: Side, dark: _Darks) -> list[_Lamp]:
    recordings = study.recordings
    white = recordings.camera(side).saturation_dn
    gathered: dict[str, dict[str, list[float]]] = {}
    for capture in recordings.captures(FlatCapture, side):
        if capture.gain_db or capture.radiance is None:
            continue
        total = float(recordings.spectrum(capture.radiance).arrays[1].sum())
        for channel, level in _means(study, recordings.frame(capture), side, None, white).items():
            signal = level - dark.at(capture.exposure_s)
            if signal > 0.02 * white:
                levels = gathered.setdefault(capture.radiance, {}).setdefault(channel, [])
                levels.append(signal / capture.exposure_s / total)
    found = []
    for path, by_channel in gathered.items():
        if set(by_channel) >= set(study.channels):
            wavelength, radiance = recordings.spectrum(path).arrays
            middle = {c: float(np.median(v)) for c, v in by_channel.items()}
            found.append(_Lamp(wavelength, radiance / max(float(radiance.sum()), 1e-300), middle))
    return found


def _means(study: Study, frame: Any, side: Side, mask: np.ndarray | None, white: float) -> dict[str, float]:
    """Mean DN by channel of the frame's middle, or of a mask's pixels, with the lens's fall-off taken out; clipped ones left out."""
    rows, cols = frame.shape
    row, col = np.arange(rows)[:, None], np.arange(cols)[None, :]
    if mask is None:
        mask = (np.abs(row - rows / 2) < rows / 4) & (np.abs(col - cols / 2) < cols / 4)
    cfa = study.recordings.camera(side).cfa
    step = mosaic.step(cfa)
    found = {}
    for channel, places in mosaic.phases(cfa).items():
        own = np.zeros_like(mask)
        for i, j in places:
            own[i::step, j::step] = True
        use = mask & own
        if use.sum() < FEWEST_PIXELS or np.mean(frame[use] >= white) > 1e-3:
            continue
        at = np.nonzero(use)
        found[channel] = float(
            frame[use].mean() / relative_illumination(study.camera, *(a.astype(float) for a in at)).mean()
        )
    return found


def _rates(
    study: Study, side: Side, dark: _Darks, captures: Sequence[Capture], mask: np.ndarray | None
) -> dict[str, float]:
    white = study.recordings.camera(side).saturation_dn
    levels: dict[str, list[float]] = {}
    for capture in captures:
        for channel, level in _means(study, study.recordings.frame(capture), side, mask, white).items():
            signal = level - dark.at(capture.exposure_s)
            if signal > 0.01 * white:
                levels.setdefault(channel, []).append(signal / capture.exposure_s)
    return {channel: float(np.mean(v)) for channel, v in levels.items()}


def _scenes(study: Study) -> dict[str, list[tuple[list[Any], np.ndarray | None]]]:
    """What both sides saw, by name: each side's captures, and the pixels that show the same part of it."""
    found: dict[str, list[tuple[list[Any], np.ndarray | None]]] = {}
    views = [{v.capture.pose: v for v in views_of(study, side)[0]} for side in SIDES]
    for pose in views[0]:
        if pose in views[1]:
            masks = _board_masks(study, views[0][pose], views[1][pose])
            if masks is not None:
                found[f"board {pose}"] = [([v[pose].capture], m) for v, m in zip(views, masks, strict=True)]
    screens = [_groups(study, side) for side in SIDES]
    for pose in screens[0]:
        if pose in screens[1]:
            found[f"screen {pose}"] = [(part[pose], None) for part in screens]
    return found


def _groups(study: Study, side: Side) -> dict[str, list[Any]]:
    """The lit screen's captures at the plain gain, by pose."""
    found: dict[str, list[Any]] = {}
    for capture in study.recordings.captures(WhiteCapture, side):
        if not capture.gain_db:
            found.setdefault(capture.screen.pose, []).append(capture)
    return found


def _same_colour(rates: dict[str, float], lamp: _Lamp) -> bool:
    """Whether a grey scene is lit by the lamp of the flats, as far as the camera's own channels tell: another light's share of
    what a filter takes away would pass for a gain. One channel tells nothing."""
    if len(lamp.level) < 2 or set(rates) != set(lamp.level):
        return False
    gap = np.array([np.log(rates[c] / lamp.level[c]) for c in rates])
    return bool(np.ptp(gap) < SAME_COLOUR)


def _board_masks(study: Study, left: BoardView, right: BoardView) -> list[np.ndarray] | None:
    """The hull of the corners that both cameras saw, in each frame."""
    index, at_left, at_right = np.intersect1d(left.index, right.index, return_indices=True)
    if len(index) < 6:
        return None
    masks = []
    for side, points in ((SIDES[0], left.image_px[at_left]), (SIDES[1], right.image_px[at_right])):
        camera = study.recordings.camera(side)
        mask = np.zeros((camera.rows, camera.cols), np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull(np.round(points).astype(np.int32)), 1)
        masks.append(mask.astype(bool))
    return masks


def time_block(study: Study) -> Block:
    """Where the right camera sees a moving board, across the baseline, against where the left one's pose puts it."""
    _both(study, "stereo_time")
    moving = _moving(study)
    views = [{v.capture.pose: v for v in views_of(study, side)[0]} for side in SIDES]
    try:
        left, right = (
            calibrate_robustly(list(v.values()), (study.camera.rows, study.camera.cols), side)
            for v, side in zip(views, SIDES, strict=True)
        )
    except NotDetermined as refused:
        raise NotDetermined("stereo_time", refused.reason) from refused
    pairs = [(pose, views[0][pose], views[1][pose]) for pose in moving if pose in views[0] and pose in views[1]]
    if len(pairs) < FEWEST_PAIRS:
        raise NotDetermined("stereo_time", f"{len(pairs)} pairs of a moving board, {FEWEST_PAIRS} needed")
    gaps, across = _gaps(pairs, left, right)
    speed = np.array([across @ moving[pose] for pose, *_ in pairs])
    place = np.array([v.image_px.mean(axis=0) for _, _, v in pairs])
    place = (place - place.mean(axis=0)) / (0.5 * float(np.hypot(study.camera.rows, study.camera.cols)))
    noise = np.array([right.solution.noise_px**2 * 2.0 / len(v.index) for _, _, v in pairs])
    pointing = {
        "stereo:turn": np.full(len(pairs), POINTING_STD_PX),
        "stereo:x": POINTING_STD_PX * place[:, 0],
        "stereo:y": POINTING_STD_PX * place[:, 1],
    }

    def predict(effects: Effects) -> Prediction:
        return Prediction(right_delay_s(study.camera, effects) * speed, pointing)

    return Block(
        measurement="stereo_time", axis="time", unit="px/s", reach=1e9, value=gaps, covariance=np.diag(noise + SHIFT_STD_PX**2),
        labels=tuple(
            Label(float(v), "Y", pose, (a.capture.id, b.capture.id), i % 3 == 1) for i, (v, (pose, a, b)) in enumerate(zip(speed, pairs, strict=True))
        ),
        reads=frozenset({"light.pair_delay_s"}), predict=predict, scale=np.ones(len(pairs)),
    )  # fmt: skip


def _moving(study: Study) -> dict[str, FloatArray]:
    """Speed (x, y), px/s, of the board's middle in the right picture, of poses between others that lie close in time."""
    timed = [(study.elapsed_s(v.capture), v) for v in views_of(study, "right")[0] if v.capture.time is not None]
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
            f"no board moves between captures less than {LONGEST_GAP_S:g} s apart: only what moves shows whether both sides capture at the same time",
        )
    return found


def _gaps(
    pairs: Sequence[tuple[str, BoardView, BoardView]], left: Calibration, right: Calibration
) -> tuple[FloatArray, FloatArray]:
    """Mean gap of each pair's corners in the right picture across the baseline's direction there, px; that direction (x, y)."""
    turns, shifts = [], []
    poses = []
    for _, one, two in pairs:
        (turn, shift), (turn_two, shift_two) = board_pose(one, left.intrinsics), board_pose(two, right.intrinsics)
        between = turn_two @ turn.T
        turns.append(Rotation.from_matrix(between).as_rotvec())
        shifts.append(shift_two - between @ shift)
        poses.append((turn, shift))
    rotation, translation = Rotation.from_rotvec(np.median(turns, axis=0)).as_matrix(), np.median(shifts, axis=0)
    along = translation[:2] / max(float(np.hypot(*translation[:2])), 1e-12)
    across = np.array([-along[1], along[0]])
    gaps = []
    for (_, _, two), (turn, shift) in zip(pairs, poses, strict=True):
        points = (two.board_mm @ turn.T + shift) @ rotation.T + translation
        gaps.append(float(((two.image_px - project(points, right.intrinsics)) @ across).mean()))
    return np.array(gaps), across


#: Makers of blocks, in the order of the report.
STEREO_BLOCKS = (scene_gain_block, time_block)
