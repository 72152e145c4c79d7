"""Two cameras in one scene: the ratio of their signals against that of uniform light.

It is judged on the right camera's side, beside the left one. The difference of the two sensitivities is each camera's own: only what
the scene adds to it counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.white import WhiteCapture
from lab.diagnose.measurements.block import Block, Effects, Label, Measurement, Prediction
from lab.diagnose.measurements.boards import views_of
from lab.diagnose.measurements.dark_squares import screen_block
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from lab.fit.geometry.board_detection import BoardView
from lab.predict.camera_model import camera_model
from sim.camera import Side
from sim.effects.veiling_glare import VeilingGlare
from sim.frame import right_over_left
from sim.optics.illumination import relative_illumination
from sim.point import even_share
from sim.sensor import mosaic
from sim.spectrum import FloatArray

# Of a ratio of the two sides, relative.
SCENE_STD = 0.01  # a scene seen from two places: gloss, angles, edges of the region that is compared
CHANNEL_STD = 0.004  # light of another colour than the uniform light's, each channel by itself
OWN_STD = 0.004  # of one channel in one scene
LIGHT_STD = 0.005  # common to all scenes: the uniform light before one side and the other
GLARE_STD = (
    0.02  # of a camera's light, scattered evenly over its frame, where its screens' dark squares don't say how much
)
SAME_LAMP = 0.02
SAME_COLOUR = 0.04  # of a ratio of channels
FEWEST_PIXELS = 200
SIDES: tuple[Side, Side] = ("left", "right")


def needs_both_sides(study: Study, step: str) -> None:
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
    """ln(right / left) of the signals in every scene that both cameras see, less that in uniform light, by channel.

    A share g of a camera's light that is scattered evenly changes a region's signal by the factor 1 + g (mean of the frame / mean of the
    region - 1). The right camera's share is predicted; the left one's, as far as its screens' dark squares tell, is taken out, and what
    they leave open is a nuisance parameter.
    """
    needs_both_sides(study, "stereo_gain")
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
    values, labels, lifts = [], [], []
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
            values.append(float(np.log(rates[1][channel].rate / rates[0][channel].rate) - of_light))
            of_lamp = np.mean([[side.lift[channel] for side in pair] for pair in alike], axis=0)
            lifts.append(np.array([side[channel].lift for side in rates]) - of_lamp)
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

    left_lift, right_lift = np.array(lifts).T
    glare, glare_std = _glare(study, "left")

    def predict(effects: Effects) -> Prediction:
        gain = np.log(max(right_over_left(study.camera, effects), 1e-6))
        scattered = even_share(study.camera, effects) * right_lift
        of_left = {"stereo_gain:glare of the left camera": -glare_std * left_lift}
        return Prediction(gain + scattered - glare * left_lift, of_left)

    return Block(
        measurement=STEREO_GAIN, reach=1e9, value=np.array(values), covariance=covariance,
        labels=tuple(labels), reads=frozenset({"light.pair_gain", "image.veils"}), predict=predict, scale=np.ones(len(values)),
    )  # fmt: skip


@dataclass(frozen=True)
class _Seen:
    """A channel in the region of a frame: DN a second, corrected for the lens's fall-off, and mean of the frame / mean of the region - 1."""

    rate: float
    lift: float


@dataclass(frozen=True)
class _Lamp:
    """A lamp before one side: the shape of its spectrum, DN a second by channel over its radiance, and `_Seen.lift`."""

    wavelength_nm: FloatArray
    shape: FloatArray  # sum 1
    level: dict[str, float]
    lift: dict[str, float]

    def like(self, other: _Lamp) -> bool:
        """Whether it's the same lamp, read anew: 2 % of its light at other wavelengths at most."""
        there = np.interp(self.wavelength_nm, other.wavelength_nm, other.shape, left=0.0, right=0.0)
        return bool(np.abs(there / max(there.sum(), 1e-300) - self.shape).sum() < SAME_LAMP)


def _uniform(study: Study, side: Side, dark: _Darks) -> list[_Lamp]:
    recordings = study.recordings
    white = recordings.camera(side).saturation_dn
    gathered: dict[str, dict[str, list[_Seen]]] = {}
    for capture in recordings.captures(FlatCapture, side):
        if capture.gain_db or capture.radiance is None:
            continue
        total = float(recordings.spectrum(capture.radiance).arrays[1].sum())
        for channel, seen in _signals(study, capture, side, dark, None).items():
            if seen.rate * capture.exposure_s > 0.02 * white:
                levels = gathered.setdefault(capture.radiance, {}).setdefault(channel, [])
                levels.append(_Seen(seen.rate / total, seen.lift))
    found = []
    for path, by_channel in gathered.items():
        if set(by_channel) >= set(study.channels):
            wavelength, radiance = recordings.spectrum(path).arrays
            middle = {c: float(np.median([seen.rate for seen in v])) for c, v in by_channel.items()}
            lift = {c: float(np.mean([seen.lift for seen in v])) for c, v in by_channel.items()}
            found.append(_Lamp(wavelength, radiance / max(float(radiance.sum()), 1e-300), middle, lift))
    return found


def _signals(study: Study, capture: Any, side: Side, dark: _Darks, mask: np.ndarray | None) -> dict[str, _Seen]:
    """By channel what a frame's middle or a mask's pixels see; without clipped channels."""
    camera, frame = study.recordings.camera(side), study.recordings.frame(capture)
    rows, cols = frame.shape
    row, col = np.arange(rows)[:, None], np.arange(cols)[None, :]
    if mask is None:
        mask = (np.abs(row - rows / 2) < rows / 4) & (np.abs(col - cols / 2) < cols / 4)
    step, black = mosaic.step(camera.cfa), dark.at(capture.exposure_s)
    found = {}
    for channel, places in mosaic.phases(camera.cfa).items():
        own = np.zeros_like(mask)
        for i, j in places:
            own[i::step, j::step] = True
        use = mask & own
        if use.sum() < FEWEST_PIXELS or np.mean(frame[use] >= camera.saturation_dn) > 1e-3:
            continue
        signal, whole = float(frame[use].mean()) - black, float(frame[own].mean()) - black
        fall_off = relative_illumination(study.camera, *(a.astype(float) for a in np.nonzero(use))).mean()
        found[channel] = _Seen(
            rate=signal / float(fall_off) / capture.exposure_s, lift=whole / signal - 1.0 if signal > 0.0 else 0.0
        )
    return found


def _rates(
    study: Study, side: Side, dark: _Darks, captures: Sequence[Capture], mask: np.ndarray | None
) -> dict[str, _Seen]:
    white = study.recordings.camera(side).saturation_dn
    found: dict[str, list[_Seen]] = {}
    for capture in captures:
        for channel, seen in _signals(study, capture, side, dark, mask).items():
            if seen.rate * capture.exposure_s > 0.01 * white:
                found.setdefault(channel, []).append(seen)
    return {
        c: _Seen(float(np.mean([s.rate for s in v])), float(np.mean([s.lift for s in v]))) for c, v in found.items()
    }


def _scenes(study: Study) -> dict[str, list[tuple[list[Any], np.ndarray | None]]]:
    """Scenes that both sides saw, by name: each side's captures, and the pixels that show the same part of the scene."""
    found: dict[str, list[tuple[list[Any], np.ndarray | None]]] = {}
    views = [{v.capture.pose: v for v in views_of(study, side)[0]} for side in SIDES]
    for pose in views[0]:
        if pose in views[1]:
            masks = _board_masks(study, views[0][pose], views[1][pose])
            if masks is not None:
                found[f"board {pose}"] = [([v[pose].capture], m) for v, m in zip(views, masks, strict=True)]
    screens = [_screen_captures(study, side) for side in SIDES]
    for pose in screens[0]:
        if pose in screens[1]:
            found[f"screen {pose}"] = [(part[pose], None) for part in screens]
    return found


def _screen_captures(study: Study, side: Side) -> dict[str, list[Any]]:
    """The lit screen's captures at the plain gain, by pose."""
    found: dict[str, list[Any]] = {}
    for capture in study.recordings.captures(WhiteCapture, side):
        if not capture.gain_db:
            found.setdefault(capture.screen.pose, []).append(capture)
    return found


def _glare(study: Study, side: Side) -> tuple[float, float]:
    """Share of a camera's light that is scattered evenly, and its standard deviation: weighted least squares of the light in the dark
    squares of its screens beside `GLARE_STD`; never below 0."""
    camera = camera_model(study.recordings, side, None, maker_curves=True)
    try:
        squares = screen_block(Study(study.recordings, side, camera))
    except NotDetermined:
        return 0.0, GLARE_STD
    seen = np.array([not label.held_out for label in squares.labels])
    without = squares.predict(()).mean
    per_share = (squares.predict((VeilingGlare(share_percent=1.0),)).mean - without)[seen] / 0.01
    weighted = np.linalg.solve(squares.covariance[np.ix_(seen, seen)], per_share)
    precision = float(per_share @ weighted) + GLARE_STD**-2
    return max(float((squares.value - without)[seen] @ weighted) / precision, 0.0), precision**-0.5


def _same_colour(rates: dict[str, _Seen], lamp: _Lamp) -> bool:
    """Whether a grey scene is lit by the lamp of the flats: the ratios of its channels agree. Under another light a difference of the
    cameras' filters would look like a gain. A camera of one channel can't tell: False."""
    if len(lamp.level) < 2 or set(rates) != set(lamp.level):
        return False
    gap = np.array([np.log(seen.rate / lamp.level[c]) for c, seen in rates.items()])
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


STEREO_GAIN = Measurement(
    "stereo_gain",
    title="signal ratio of the two cameras",
    order=600,
    axis="level",
    unit="1",
    make=scene_gain_block,
    quantity="right over left, ln",
    conditions="scene",
    places="scenes",
)
