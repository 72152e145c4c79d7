"""Signals of one scene in both cameras of a pair: the ratio of their gains."""

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
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.observables.boards.pairs import SIDES, StereoPair, board_pairs, needs_both_sides
from lab.observables.dataset import Dataset
from lab.observables.flats.row_light import ROW_LIGHT, nuisances, row_light_variance
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.screens.dark_squares import measure_screen
from sim.camera import Side
from sim.effects.base import Effects
from sim.effects.veiling_glare import VeilingGlare
from sim.frame import pair_gain_factor
from sim.optics.illumination import relative_illumination
from sim.point import even_share
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import Uniform

# Relative standard deviations of the ratio of the two sides.
SCENE_STD = 0.01  # common to a scene's channels: gloss, viewing angles, borders of the compared region
CHANNEL_STD = 0.004  # common to a channel in all scenes: light of another colour than the flats'
OWN_STD = 0.004  # of one channel in one scene
LIGHT_STD = 0.005  # common to all: a change of the uniform light between the two sides
GLARE_STD = 0.02  # prior standard deviation of the share of a camera's light that is scattered evenly over its frame
SAME_LAMP = 0.02  # largest difference of two normalised spectra of one lamp, summed over wavelengths
SAME_COLOUR = 0.04  # largest relative difference between channel ratios in one light
FEWEST_PIXELS = 200  # of a channel in the region that is compared


class _Darks:
    """A side's mean signal without light by exposure: a line through its dark frames, else the stated black level."""

    def __init__(self, dataset: Dataset, side: Side) -> None:
        frames = dataset.recordings.captures(DarkCapture, side)
        t = np.array([c.exposure_s for c in frames])
        level = np.array([dataset.recordings.codes(c).every.mean_dn for c in frames])
        self._slope = 0.0
        if len(frames) and np.ptp(t) > 0:
            self._slope, self._black = (float(v) for v in np.polyfit(t, level, 1))
        elif len(frames):
            self._black = float(level.mean())
        else:
            self._black = dataset.recordings.camera(side).black_level_dn or 0.0

    def at(self, exposure_s: float) -> float:
        """Return the mean signal without light, DN."""
        return self._black + self._slope * exposure_s


def measure_stereo_gain(dataset: Dataset) -> Observable:
    """ln(right / left) of the signals in every scene that both cameras see, less that in uniform light, by channel.

    Veiling glare, which scatters a share g of a camera's light evenly over the frame, changes a region's signal by the
    factor 1 + g (mean of the frame / mean of the region - 1). The right camera's g is predicted by effects. The left
    camera's g is estimated from the dark squares of its screens and corrected for; its uncertainty is a nuisance
    parameter. Raises NotDetermined without unclipped flats of one lamp on both sides, and without a scene that both saw
    in that lamp's light."""
    needs_both_sides(dataset.recordings, dataset.side, "stereo_gain")
    darks = {side: _Darks(dataset, side) for side in SIDES}
    uniform = [_uniform(dataset, side, darks[side]) for side in SIDES]
    if not all(uniform):
        missing = " and ".join(side for side, found in zip(SIDES, uniform, strict=True) if not found)
        raise NotDetermined(
            "stereo_gain", f"no unclipped flat captures of the {missing} camera: nothing to hold scenes against"
        )
    lamps = [(left, right) for left in uniform[0] for right in uniform[1] if left.like(right)]
    if not lamps:
        raise NotDetermined("stereo_gain", "the two sides' flats are of different lamps")
    values, labels, lifts, exposures = [], [], [], []
    for scene_name, regions in _scenes(dataset).items():
        rates = [
            _rates(dataset, side, darks[side], captures, mask)
            for side, (captures, mask) in zip(SIDES, regions, strict=True)
        ]
        alike = [
            pair for pair in lamps if all(_same_colour(rate, lamp) for rate, lamp in zip(rates, pair, strict=True))
        ]
        captures = tuple(c.id for part, _ in regions for c in part)
        for channel in dataset.channels if alike else ():
            of_light = np.mean([np.log(right.level[channel] / left.level[channel]) for left, right in alike])
            values.append(float(np.log(rates[1][channel].rate / rates[0][channel].rate) - of_light))
            of_lamp = np.mean([[side.lift[channel] for side in pair] for pair in alike], axis=0)
            lifts.append(np.array([side[channel].lift for side in rates]) - of_lamp)
            labels.append(Label(float(len(values) - 1), channel, scene_name, captures, False))
            exposures.append(tuple(c.exposure_s for part, _ in regions for c in part))
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
    glare, glare_std = _glare(dataset, "left")

    def predict(effects: Effects) -> Prediction:
        gain = np.log(max(pair_gain_factor(dataset.camera, effects), 1e-6))
        scattered = even_share(dataset.camera, effects) * right_lift
        jacobian = {"stereo_gain:glare of the left camera": -glare_std * left_lift}
        jacobian |= _row_light(Uniform(dataset.camera, effects), dataset.camera.rows, scenes, exposures)
        return Prediction(gain + scattered - glare * left_lift, jacobian)

    return Observable(
        measurement=STEREO_GAIN, reach=1e9, value=np.array(values), covariance=covariance,
        labels=tuple(labels), reads=frozenset({"light.pair_gain", "image.veils"}), scattered_by=ROW_LIGHT,
        predict=predict, scale=np.ones(len(values)),
    )  # fmt: skip


def _row_light(
    model: Uniform, rows: int, scenes: np.ndarray, exposures: Sequence[tuple[float, ...]]
) -> dict[str, FloatArray]:
    """Jacobian of the scenes' ratios by a light that varies while a frame is taken. Regions are taken as the frame's
    middle half; the frames of both sides begin at times of their own. `exposures`: of a scene's frames, by number."""
    if not model.varies_by_row:
        return {}
    middle = slice(rows // 4, rows - rows // 4)
    variance = {t: row_light_variance(model, rows, t, middle) for t in set().union(*exposures)}
    vectors = []
    for scene in dict.fromkeys(scenes):
        own = scenes == scene
        of_scene = exposures[int(np.argmax(own))]
        # a frame is a part of its side's mean
        vectors.append(np.sqrt(sum(variance[t] for t in of_scene)) / (len(of_scene) / 2.0) * own)
    return nuisances("stereo_gain", vectors)


@dataclass(frozen=True)
class _Seen:
    """One channel in a region of a frame."""

    rate: float  # mean signal, DN/s, corrected for the lens's fall-off
    lift: float  # mean of the frame / mean of the region - 1


@dataclass(frozen=True)
class _UniformLight:
    """Uniform light before one side, as of one radiance file."""

    wavelength_nm: FloatArray
    shape: FloatArray  # spectral radiance, normalised to the sum 1
    level: dict[str, float]  # by channel: median signal over radiance, DN/s
    lift: dict[str, float]  # by channel: mean `_Seen.lift`

    def like(self, other: _UniformLight) -> bool:
        """Return whether both are readings of one lamp: their normalised spectra differ by less than `SAME_LAMP`."""
        there = np.interp(self.wavelength_nm, other.wavelength_nm, other.shape, left=0.0, right=0.0)
        return bool(np.abs(there / max(there.sum(), 1e-300) - self.shape).sum() < SAME_LAMP)


def _uniform(dataset: Dataset, side: Side, dark: _Darks) -> list[_UniformLight]:
    """Return the uniform lights of a side's flats, by radiance file, in which every channel has an unclipped signal."""
    recordings = dataset.recordings
    white = recordings.camera(side).saturation_dn
    gathered: dict[str, dict[str, list[_Seen]]] = {}
    for capture in recordings.captures(FlatCapture, side):
        if capture.gain_db or capture.radiance is None:
            continue
        total = float(recordings.spectrum(capture.radiance).arrays[1].sum())
        for channel, seen in _signals(dataset, capture, side, dark, None).items():
            if seen.rate * capture.exposure_s > 0.02 * white:
                levels = gathered.setdefault(capture.radiance, {}).setdefault(channel, [])
                levels.append(_Seen(seen.rate / total, seen.lift))
    found = []
    for path, by_channel in gathered.items():
        if set(by_channel) >= set(dataset.channels):
            wavelength, radiance = recordings.spectrum(path).arrays
            middle = {c: float(np.median([seen.rate for seen in v])) for c, v in by_channel.items()}
            lift = {c: float(np.mean([seen.lift for seen in v])) for c, v in by_channel.items()}
            found.append(_UniformLight(wavelength, radiance / max(float(radiance.sum()), 1e-300), middle, lift))
    return found


def _signals(dataset: Dataset, capture: Any, side: Side, dark: _Darks, mask: np.ndarray | None) -> dict[str, _Seen]:
    """Return the unclipped channels of a capture in the pixels of `mask`, or in the middle half of the frame."""
    camera, frame = dataset.recordings.camera(side), dataset.recordings.frame(capture)
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
        fall_off = relative_illumination(dataset.camera, *(a.astype(float) for a in np.nonzero(use))).mean()
        found[channel] = _Seen(
            rate=signal / float(fall_off) / capture.exposure_s, lift=whole / signal - 1.0 if signal > 0.0 else 0.0
        )
    return found


def _rates(
    dataset: Dataset, side: Side, dark: _Darks, captures: Sequence[Capture], mask: np.ndarray | None
) -> dict[str, _Seen]:
    """Return the channels in a region, means over captures."""
    white = dataset.recordings.camera(side).saturation_dn
    found: dict[str, list[_Seen]] = {}
    for capture in captures:
        for channel, seen in _signals(dataset, capture, side, dark, mask).items():
            if seen.rate * capture.exposure_s > 0.01 * white:
                found.setdefault(channel, []).append(seen)
    return {
        c: _Seen(float(np.mean([s.rate for s in v])), float(np.mean([s.lift for s in v]))) for c, v in found.items()
    }


def _scenes(dataset: Dataset) -> dict[str, list[tuple[list[Any], np.ndarray | None]]]:
    """Scenes that both sides saw, by name: for each side its captures, and the mask of the pixels that show the same
    part of the scene (None: the middle of the frame)."""
    found: dict[str, list[tuple[list[Any], np.ndarray | None]]] = {}
    for pair in board_pairs(dataset.recordings):
        masks = _board_masks(dataset, pair)
        if masks is not None:
            captures = (pair.left.capture, pair.right.capture)
            found[f"board {pair.pose}"] = [([c], m) for c, m in zip(captures, masks, strict=True)]
    screens = [_screen_captures(dataset, side) for side in SIDES]
    for pose in screens[0]:
        if pose in screens[1]:
            found[f"screen {pose}"] = [(part[pose], None) for part in screens]
    return found


def _screen_captures(dataset: Dataset, side: Side) -> dict[str, list[Any]]:
    """Return the captures of the lit screen without gain in dB, by pose."""
    found: dict[str, list[Any]] = {}
    for capture in dataset.recordings.captures(WhiteCapture, side):
        if not capture.gain_db:
            found.setdefault(capture.screen.pose, []).append(capture)
    return found


def _glare(dataset: Dataset, side: Side) -> tuple[float, float]:
    """Share of a camera's light that is scattered evenly over its frame, and its standard deviation.

    Weighted least squares of the light in the dark squares of its screens, with the prior 0 +- `GLARE_STD`; at least 0.
    """
    camera = camera_model(dataset.recordings, side, None, maker_curves=True)
    try:
        squares = measure_screen(Dataset(dataset.recordings, side, camera))
    except NotDetermined:
        return 0.0, GLARE_STD
    seen = np.array([not label.held_out for label in squares.labels])
    without = squares.predict(()).mean
    per_share = (squares.predict((VeilingGlare(share_percent=1.0),)).mean - without)[seen] / 0.01
    weighted = np.linalg.solve(squares.covariance[np.ix_(seen, seen)], per_share)
    precision = float(per_share @ weighted) + GLARE_STD**-2
    return max(float((squares.value - without)[seen] @ weighted) / precision, 0.0), precision**-0.5


def _same_colour(rates: dict[str, _Seen], lamp: _UniformLight) -> bool:
    """Return whether a grey scene is lit by the lamp of the flats: its channel ratios agree to `SAME_COLOUR`.

    In another light a difference of the two cameras' filters would look like a gain. False for a camera of one channel.
    """
    if len(lamp.level) < 2 or set(rates) != set(lamp.level):
        return False
    gap = np.array([np.log(seen.rate / lamp.level[c]) for c, seen in rates.items()])
    return bool(np.ptp(gap) < SAME_COLOUR)


def _board_masks(dataset: Dataset, pair: StereoPair) -> list[np.ndarray] | None:
    """Masks of the convex hull of the corners that both cameras saw, in each frame; None for fewer than six corners."""
    at_left, at_right = pair.common
    if len(at_left) < 6:
        return None
    masks = []
    for side, points in zip(SIDES, (pair.left.image_px[at_left], pair.right.image_px[at_right]), strict=True):
        camera = dataset.recordings.camera(side)
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
    make=measure_stereo_gain,
    quantity="right over left, ln",
    conditions="scene",
    places="scenes",
)
