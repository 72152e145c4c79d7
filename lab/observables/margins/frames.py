"""Statistics of the margins of dark frames and flats, from which their measurements take numbers. Each frame is read
once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.observables.darks.frames import conditions
from lab.observables.dataset import Dataset, held_out_flats
from lab.observables.flats.stated_light import most_frequent_gain_db
from sim.effects.base import Effects
from sim.spectrum import FloatArray
from sim.uniform import Uniform

#: Active lines next to a margin whose mean is the signal there: an even number, as mosaics alternate.
LAST_LINES = 8
#: Fewest lines of overscan at an end in which deferred charge, and the offset behind it, are told apart.
LEAST_LINES = 4
#: Standard deviation of a pixel, in steps of the codes, below which rounding moves the mean.
LEAST_NOISE_STEPS = 0.4

Axis = Literal[0, 1]


@dataclass(frozen=True)
class Strip:
    """The margin at one end of the rows (`axis` 0) or the columns (1): `masked` lines next to the active area, then
    `overscan` lines."""

    axis: Axis
    is_behind: bool  # behind the last line, else before the first
    masked: int
    overscan: int

    @property
    def name(self) -> str:
        """The end in words."""
        lines = ("rows", "columns")[self.axis]
        return f"{lines} behind the last" if self.is_behind else f"{lines} before the first"

    @property
    def base(self) -> int:
        """Number of overscan lines farthest from the active area, whose mean is the offset."""
        return max(2, self.overscan // 3)

    def cut(self, along: FloatArray) -> FloatArray:
        """Return the values of its lines, from the active area outwards, of those of all lines of a frame (n,)."""
        size = self.masked + self.overscan
        return along[len(along) - size :] if self.is_behind else along[:size][::-1]


@dataclass(frozen=True)
class MarginFrame:
    """One capture's means: of the lines of each strip from the active area outwards, DN, and of the active lines along
    both axes."""

    capture: Capture
    is_held_out: bool
    lines: tuple[FloatArray, ...]  # by strip: (masked + overscan,)
    active: tuple[FloatArray, FloatArray]  # (rows,), (cols,)

    def offset_dn(self, strips: tuple[Strip, ...], number: int) -> float:
        """Return the mean of the far overscan lines of a strip."""
        return float(np.mean(self.lines[number][-strips[number].base :]))

    def signal_dn(self, strips: tuple[Strip, ...], number: int) -> float:
        """Return the mean of the `LAST_LINES` active lines next to a strip above its offset."""
        strip = strips[number]
        along = self.active[strip.axis]
        near = along[-LAST_LINES:] if strip.is_behind else along[:LAST_LINES]
        return float(near.mean()) - self.offset_dn(strips, number)


@dataclass(frozen=True)
class MarginFrames:
    """The frames of dark frames and unsaturated flats at the usual gain, in the order in which they were taken.

    strips : ends that have margins
    pixel_dn : standard deviation of a pixel of overscan
    profiles : mean of the flats' active lines above their offset, along rows and columns, over its mean
    """

    strips: tuple[Strip, ...]
    frames: tuple[MarginFrame, ...]
    pixel_dn: float
    profiles: tuple[FloatArray, FloatArray]


def strips_of(dataset: Dataset) -> tuple[Strip, ...]:
    """Return the ends at which frames of a side have margins."""
    margins = dataset.stated.margins
    axes: tuple[tuple[Axis, tuple[int, int], tuple[int, int]], ...] = (
        (0, margins.masked_rows, margins.overscan_rows),
        (1, margins.masked_cols, margins.overscan_cols),
    )
    found = (Strip(axis, bool(end), masked[end], overscan[end]) for axis, masked, overscan in axes for end in (0, 1))
    return tuple(strip for strip in found if strip.masked + strip.overscan)


def margin_frames(dataset: Dataset) -> MarginFrames:
    """Return the statistics of all frames with margins. Raises NotDetermined where there are none."""
    strips = strips_of(dataset)
    if not strips:
        raise NotDetermined("margins", "the camera states no margins: its frames have neither overscan nor masked rows")
    dark = conditions(dataset)
    gain_db = most_frequent_gain_db(dataset.recordings.captures(FlatCapture, dataset.side))
    out_flats = held_out_flats(dataset)
    use: list[tuple[Capture, bool]] = [(c, False) for one in dark for c in one.seen]
    use += [(c, True) for one in dark for c in one.held_out]
    for flat in dataset.recordings.captures(FlatCapture, dataset.side):
        if (flat.gain_db or 0.0) == gain_db and None not in dataset.levels(flat).mean.values():
            use.append((flat, flat.id in out_flats))
    order = {c.id: k for k, c in enumerate(dataset.in_time_order)}
    frames: list[MarginFrame] = []
    spreads: list[float] = []
    for capture, is_held_out in sorted(use, key=lambda pair: order[pair[0].id]):
        whole = dataset.recordings.whole_frame(capture)
        if whole.shape != dataset.stated.frame_shape:
            continue  # stored without its margins
        means, spread_dn = _line_means(dataset, whole, strips)
        active = dataset.stated.margins.active(whole)
        frames.append(
            MarginFrame(
                capture,
                is_held_out,
                means,
                (active.mean(axis=1, dtype=np.float64), active.mean(axis=0, dtype=np.float64)),
            )
        )
        spreads.append(spread_dn)
    if not frames:
        raise NotDetermined("margins", "no frame was stored with its margins")
    profiles = tuple(_profile(strips, frames, axis) for axis in (0, 1))
    return MarginFrames(strips, tuple(frames), float(np.median(spreads)), (profiles[0], profiles[1]))


def _line_means(
    dataset: Dataset, whole: NDArray[np.uint16], strips: tuple[Strip, ...]
) -> tuple[tuple[FloatArray, ...], float]:
    """Return the means of the strips' lines beside the active area, and the median standard deviation of the pixels of
    a line of overscan."""
    margins = dataset.stated.margins
    means, spreads = [], [np.inf]
    for strip in strips:
        (top, bottom), (left, right) = margins.lines
        rows, columns = whole[:, left : whole.shape[1] - right], whole[top : whole.shape[0] - bottom].T
        beside = (rows, columns)[strip.axis]
        lines = strip.cut(np.arange(float(len(beside)))).astype(np.intp)
        pixels = beside[lines].astype(np.float64)
        means.append(pixels.mean(axis=1))
        if strip.overscan:
            spreads.append(float(np.median(pixels[strip.masked :].std(axis=1))))
    return tuple(means), float(np.min(spreads))


def _profile(strips: tuple[Strip, ...], frames: list[MarginFrame], axis: Axis) -> FloatArray:
    """Return the mean of the flats' active lines along an axis, above the frames' offset, over its mean."""
    total: FloatArray = np.zeros(len(frames[0].active[axis]))
    with_overscan = [k for k, strip in enumerate(strips) if strip.overscan >= LEAST_LINES]
    for frame in frames:
        if isinstance(frame.capture, FlatCapture) and with_overscan:
            total += frame.active[axis] - np.mean([frame.offset_dn(strips, k) for k in with_overscan])
    return total / total.mean() if total.mean() > 0.0 else np.ones(total.shape)


def deferred_shares(dataset: Dataset, made: MarginFrames, effects: Effects) -> list[FloatArray]:
    """Return, by strip, the charge that is read in each of its lines from the active area outwards, over the signal of
    the `LAST_LINES` next to it."""
    model = Uniform(dataset.camera, effects)
    shares = []
    for strip in made.strips:
        profile = made.profiles[strip.axis]
        along = model.clock_profile(strip.axis, profile, dataset.stated.margins)
        before, behind = dataset.stated.margins.lines[strip.axis]
        active = along[before : len(along) - behind]
        near = active[-LAST_LINES:] if strip.is_behind else active[:LAST_LINES]
        shares.append(strip.cut(along) / near.mean())
    return shares
