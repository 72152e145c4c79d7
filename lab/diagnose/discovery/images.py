"""Images of what changes from pixel to pixel in dark frames and in flats: of the offset, of the dark current, of the
temporal variance and of the covariance of neighbours; of the response, of its square term, and of light that is
collected in a fixed time. Each is that of seen (False) and of held-out captures (True).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.observables.darks.frames import DarkCondition, conditions, usual_conditions
from lab.observables.darks.readout import MOST_FRAMES, dark_readout
from lab.observables.dataset import Dataset, held_out_flats, held_out_of
from lab.observables.flats.images import LEAST_SIGNAL, dark_level_dn, flats
from lab.observables.noise.robust import CLIP, robust_std
from sim.sensor import mosaic
from sim.spectrum import FloatArray

Image = NDArray[np.floating]
NO_SETTING = {"id", "frame", "time", "temperature_c", "dummy_frames"}  # what repeats differ by
LEAST_LEVELS = 2  # from which on the response's change by level is determined


@dataclass(frozen=True)
class DarkImages:
    """Images (rows, cols) of dark frames, DN, DN/s and DN^2; None where the captures don't determine one.

    mean        of all exposures, less the frame's mean
    offset      the same at exposure 0
    per_second  its change by exposure
    variance    of a pixel from frame to frame, without noise that rows or columns share
    below       covariance of a pixel with the one below, (rows - 1, cols)
    right       the same with the one to the right, (rows, cols - 1)
    """

    mean: Image
    offset: Image
    per_second: Image | None = None
    variance: Image | None = None
    below: Image | None = None
    right: Image | None = None


@dataclass
class _Sums:
    """Sums over the captures of one condition, seen or held out."""

    frames: int
    mean: Image
    contrasts: int
    squares: Image
    below: Image
    right: Image

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> _Sums:
        """Return sums over no frames of a shape."""
        rows, cols = shape
        every = (np.zeros((rows - i, cols - j), np.float32) for i, j in ((0, 0), (0, 0), (1, 0), (0, 1)))
        mean, squares, below, right = every
        return cls(0, mean, 0, squares, below, right)

    def add_contrast(self, away: Image, step_dn: float) -> None:
        """Add a difference of frames with the variance of one; what rows and columns share is no part of it."""
        away = _pixels_alone(away, step_dn)
        self.contrasts += 1
        self.squares += np.square(away)
        self.below += away[:-1] * away[1:]
        self.right += away[:, :-1] * away[:, 1:]


def _pixels_alone(away: Image, step_dn: float = 1.0) -> Image:
    """Return a difference of frames with outlying pixels at `CLIP` standard deviations, less what rows and columns
    share. `step_dn`: step of the codes."""
    away = away - np.float32(away.mean(dtype=float))  # the light may be another
    std = robust_std(away, step_dn)
    clipped = np.clip(away, -CLIP * std, CLIP * std)
    clipped -= clipped.mean(axis=1, keepdims=True)
    clipped -= clipped.mean(axis=0, keepdims=True)
    return clipped


def dark_images(dataset: Dataset) -> dict[bool, DarkImages]:
    """Return the images of dark frames at the usual temperature; none without dark captures."""
    try:
        every = conditions(dataset)
    except NotDetermined:
        return {}
    sums = [(one.exposure_s, _summed(dataset, one)) for one in usual_conditions(dataset, every)]
    found = {}
    for out in (False, True):
        mine = [(exposure_s, own[out]) for exposure_s, own in sums if own[out].frames]
        if mine:
            found[out] = _joined(dataset, mine)
    return found


def _summed(dataset: Dataset, condition: DarkCondition) -> dict[bool, _Sums]:
    """Return the sums over a condition's frames. Contrasts are Helmert's: frame k less the mean of those before, times
    sqrt(k / (k + 1)); pixels beyond `CLIP` standard deviations count as such."""
    shape = dataset.camera.rows, dataset.camera.cols
    mean, own = np.zeros(shape, np.float32), {out: _Sums.empty(shape) for out in (False, True)}
    seen, held_out = condition.seen[:MOST_FRAMES], condition.held_out[: MOST_FRAMES // 2]
    for k, capture in enumerate((*seen, *held_out)):
        frame = dataset.recordings.frame(capture).astype(np.float32)
        frame -= np.float32(frame.mean(dtype=float))
        sums, away = own[k >= len(seen)], frame - mean
        mean += away / np.float32(k + 1)
        sums.frames += 1
        sums.mean += (frame - sums.mean) / np.float32(sums.frames)
        if k:
            sums.add_contrast(away * np.float32(np.sqrt(k / (k + 1.0))), dataset.step_dn)
    return own


def _joined(dataset: Dataset, sums: Sequence[tuple[float, _Sums]]) -> DarkImages:
    """Return the images of all exposures, weighted by their noise."""
    exposure_s = np.array([t for t, _ in sums])
    read_dn2 = max(dataset.noise.read_dn**2, dataset.noise.quantisation_dn2)
    shot_dn2 = dataset.noise.gain * max(dataset.noise.dark_dn_per_s, 0.0) * exposure_s
    weight = np.array([one.frames for _, one in sums]) / (read_dn2 + shot_dn2)
    weight /= weight.sum()
    middle = float(weight @ exposure_s)
    spread = float(weight @ np.square(exposure_s - middle))
    means = np.stack([one.mean for _, one in sums])
    mean = np.tensordot(weight.astype(np.float32), means, 1)
    offset, slope = mean, None
    if spread > 0.0:
        by_time = weight * (exposure_s - middle) / spread
        slope = _clipped(np.tensordot(by_time.astype(np.float32), means, 1))
        offset = mean - np.float32(middle) * slope
    images = DarkImages(_clipped(mean, dataset.step_dn), _clipped(offset, dataset.step_dn), slope)
    paired = [one for _, one in sums if one.contrasts and one.squares.any()]
    if not paired:
        return images
    by_noise = np.array([one.contrasts**2 / float(np.mean(one.squares)) ** 2 for one in paired])
    by_noise /= sum(w * one.contrasts for w, one in zip(by_noise, paired, strict=True))
    squares, below, right = (
        sum(np.float32(w) * getattr(one, name) for w, one in zip(by_noise, paired, strict=True))
        for name in ("squares", "below", "right")
    )
    return replace(images, variance=squares, below=below, right=right)


def _clipped(image: Image, step_dn: float = 1.0) -> Image:
    """Return an image with outlying pixels at `CLIP` standard deviations from its median."""
    middle, std = float(np.median(image)), robust_std(image, step_dn)
    return np.clip(image, middle - CLIP * std, middle + CLIP * std)


@dataclass(frozen=True)
class FlatImages:
    """Images (rows, cols) of flats, each plane of the mosaic by itself. A frame over its plane's mean, with the signal
    s and the exposure t, is taken as

    bend     1 + a + b s / s_full: b, of the square of the signal, at full well
    fixed_s  1 + a + c / t: c, s, the time in which light is collected besides, whatever is asked for
    greatest_dn_per_s  signal over exposure
    """

    bend: Image
    fixed_s: Image | None
    greatest_dn_per_s: float


def flat_images(dataset: Dataset) -> dict[bool, FlatImages]:
    """Return the images of unclipped flats of the most frequent lamp; none where they don't determine them."""
    try:
        levels, _ = dataset.once(flats)
    except NotDetermined:
        return {}

    def lamp_of(capture: Any) -> tuple[int, bool]:
        return dataset.lamps.get(capture.radiance, -1), (capture.gain_db or 0.0) == dataset.usual_gain_db

    lamps = [lamp_of(c) for u in levels for c in u.captures]
    if not lamps:
        return {}
    usual = max(dict.fromkeys(lamps), key=lamps.count)
    dark = dataset.once(dark_readout)
    full_dn = dataset.saturation_dn - dataset.noise.black
    found = {}
    for held_out in (False, True):
        captures = [
            (float(np.mean(list(u.mean.values()))) / full_dn, c)
            for u in levels
            if u.held_out == held_out and min(u.mean.values()) > LEAST_SIGNAL * dataset.noise.read_dn
            for c in u.captures[:MOST_FRAMES]
            if lamp_of(c) == usual
        ]
        if len({s for s, _ in captures}) >= LEAST_LEVELS:
            found[held_out] = _regressed(dataset, captures, full_dn, None if dark is None else dark.offsets_dn)
    return found


def _regressed(
    dataset: Dataset, captures: Sequence[tuple[float, Any]], full_dn: float, offsets_dn: Image | None
) -> FlatImages:
    """Return the terms by least squares, weighted by shot and read noise, pixel by pixel."""
    signal = np.array([s for s, _ in captures])
    inverse = np.array([1.0 / max(float(c.exposure_s), 1e-9) for _, c in captures])
    noise = (dataset.noise.gain * signal * full_dn + dataset.noise.read_dn**2) / np.square(signal * full_dn)
    weights = [_slope(x, 1.0 / noise) for x in (signal, inverse)]
    total = np.zeros((2, dataset.camera.rows, dataset.camera.cols), np.float32)
    for k, (_, capture) in enumerate(captures):
        frame = np.asarray(dataset.recordings.frame(capture), np.float32) - np.float32(dark_level_dn(dataset, capture))
        if offsets_dn is not None:
            frame -= offsets_dn
        for plane in mosaic.planes(frame, dataset.camera.cfa).values():
            np.divide(plane, np.float32(plane.mean(dtype=float)), out=plane)
        total += np.array([weight[k] for weight in weights], np.float32)[:, None, None] * frame
    for term in total:
        for plane in mosaic.planes(term, dataset.camera.cfa).values():
            plane[...] = _clipped(plane)
    fixed_s = total[1] if np.ptp(inverse) > 0.0 else None
    return FlatImages(total[0], fixed_s, float(np.max(signal * full_dn * inverse)))


def _slope(x: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the weights by which values (n,) give their slope by x; none where x is the same of all."""
    if np.ptp(x) == 0.0:
        return np.zeros(len(x))
    away = weight * (x - np.average(x, weights=weight))
    return np.asarray(away / float(away @ x))


# --- noise by time ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NoiseByTime:
    """The variance of differences of repeats, dark and lit: Helmert's contrasts, frame k less the mean of those before.

    variance_dn2  (n,) of a pixel
    pixels        of each
    shares        (n, captures): how much of the variance is that of each capture's frame
    elapsed_s     (captures,)
    signal_dn     (n,) mean signal above black, and
    square_dn2    (n,) mean of its square
    dark_s        (n,) exposure of dark frames but the shortest, else 0: hot pixels add noise of their own
    held_out      (n,)
    """

    variance_dn2: FloatArray
    pixels: float
    shares: FloatArray
    elapsed_s: FloatArray
    signal_dn: FloatArray
    square_dn2: FloatArray
    dark_s: FloatArray
    held_out: NDArray[np.bool_]


def noise_by_time(dataset: Dataset) -> NoiseByTime | None:
    """Return the variance of repeats by time; None where no time is stated, or nothing is repeated."""
    captures = dataset.recordings.captures(side=dataset.side)
    if not captures or any(c.time is None for c in captures):
        return None
    by_setting: dict[str, list[Any]] = {}
    for c in sorted(captures, key=dataset.elapsed_s):
        by_setting.setdefault(c.model_dump_json(exclude=NO_SETTING), []).append(c)
    groups = [group[:MOST_FRAMES] for group in by_setting.values() if len(group) > 1]
    every = [c for group in groups for c in group]
    place = {c.id: i for i, c in enumerate(every)}
    shortest_s = min((c.exposure_s for c in every if c.kind == "dark"), default=0.0)
    rows: list[tuple[float, FloatArray, float, float, float, bool]] = []
    for number, group in enumerate(groups):
        out = _held_out(dataset, group, number, len(groups))
        mean = np.zeros((dataset.camera.rows, dataset.camera.cols), np.float32)
        for k, capture in enumerate(group):
            frame = dataset.recordings.frame(capture).astype(np.float32)
            if k == 0:
                signal = frame - np.float32(dataset.noise.black)
                level, square = float(signal.mean(dtype=float)), float(np.mean(np.square(signal), dtype=float))
            away = frame - mean
            mean += away / np.float32(k + 1)
            if k == 0 or any(v is None for v in dataset.levels(capture).mean.values()):
                continue
            share = np.zeros(len(every))
            share[[place[c.id] for c in group[:k]]] = 1.0 / (k * (k + 1.0))
            share[place[capture.id]] = k / (k + 1.0)
            away *= np.float32(np.sqrt(k / (k + 1.0)))
            for plane in mosaic.planes(away, dataset.camera.cfa).values():
                plane[...] = _pixels_alone(plane)
            own = capture.exposure_s if capture.kind == "dark" and capture.exposure_s > shortest_s else 0.0
            rows.append((float(np.mean(np.square(away), dtype=float)), share, level, square, own, capture.id in out))
    if not rows:
        return None
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    elapsed_s = np.array([dataset.elapsed_s(c) for c in every])
    pixels = float((dataset.camera.rows - 2) * (dataset.camera.cols - 2))
    return NoiseByTime(columns[0], pixels, columns[1], elapsed_s, *columns[2:])


def _held_out(dataset: Dataset, group: Sequence[Any], number: int, groups: int) -> set[str]:
    """Return the ids of a setting's held-out captures."""
    if group[0].kind == "dark":
        return {c.id for condition in conditions(dataset) for c in condition.held_out}
    return set(dataset.once(held_out_flats)) if group[0].kind == "flat" else held_out_of(group, number, groups)
