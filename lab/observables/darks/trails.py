"""Trails of hot pixels in dark frames: by how much the pixels behind a hot one are brighter than those before it.

Charge between neighbours goes both ways and cancels; charge that is left behind on its way to the output doesn't.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lab.errors import NotDetermined
from lab.observables.darks.frames import DarkStatistics, captures_of, dark_frames
from lab.observables.dataset import Dataset
from lab.observables.noise.robust import MEDIAN_OF, Image, from_surroundings, sampled
from lab.observables.observable import Label, Measurement, Observable, Prediction
from sim.effects.base import Effects
from sim.point import trail_behind
from sim.spectrum import FloatArray

TRAIL_LAGS = 1, 2, 3, 4, 6, 9  # px from the hot pixel
HOT = 12.0  # local standard deviations from which on a pixel counts as hot
LEAST_HOT = 12  # hot pixels of a half of the frame
#: Ratio of the variances of the median and of the mean of many normal numbers.
MEDIAN_VARIANCE = np.pi / 2.0


@dataclass(frozen=True)
class _Trail:
    """Of the hot pixels of half a frame: share of their signal by which the pixel `lag` behind exceeds that before."""

    axis: Literal[0, 1]
    lag: int
    line: float  # mean place of the hot pixels along the axis, weighted by their signal, px
    share: float
    std: float


def _trails(away: Image, local: Image, below_dn: Image) -> list[_Trail]:
    """Return the trails along rows and columns, in both halves of the frame.

    away, local : departures from the surroundings and their local standard deviation (rows, cols), DN
    below_dn : how far the pixels are below saturation (rows, cols), DN

    The share A minimises the sum of |d_k - A s_k| over hot pixels k of signal s_k, d_k the difference of the pixels
    behind and before: the weighted median of d_k / s_k, which other hot pixels don't move. Its variance is
    1 / (4 f(0)^2 sum s_k^2), f the density of the differences' noise at 0.
    """
    found: list[_Trail] = []
    hot = (away > HOT * local) & (below_dn > 0.0)
    rows, cols = np.nonzero(hot)
    axes: tuple[Literal[0, 1], ...] = (0, 1)
    for axis in axes:
        place = (rows, cols)[axis]
        length = away.shape[axis]
        for half in (place < length // 2, place >= length // 2):
            for lag in TRAIL_LAGS:
                use = half & (place >= lag) & (place < length - lag)
                if np.count_nonzero(use) < LEAST_HOT:
                    continue
                r, c = rows[use], cols[use]
                step = (lag, 0) if axis == 0 else (0, lag)
                signal = away[r, c].astype(float)
                apart = away[r + step[0], c + step[1]].astype(float) - away[r - step[0], c - step[1]]
                ratio = apart / signal
                order = np.argsort(ratio)
                below = np.cumsum(signal[order])
                share = float(ratio[order][np.searchsorted(below, 0.5 * below[-1])])
                spread = 1.4826 * float(np.median(np.abs(apart - share * signal)))
                spread = max(spread, np.sqrt(2.0) * float(np.median(local[r, c])))
                std = spread * np.sqrt(MEDIAN_VARIANCE / float(signal @ signal))
                line = float(place[use] @ signal / signal.sum())
                found.append(_Trail(axis, lag, line, share, std))
    return found


def measure_dark_trails(dataset: Dataset) -> Observable:
    """Signal behind hot pixels less that before them, over the hot pixels', by distance, along rows and columns, in
    both halves of the frame, of the median of repeated dark frames of the condition of most dark signal.

    Raises NotDetermined where no half of the frame has `LEAST_HOT` hot pixels.
    """
    frames = [f for f in dataset.once(dark_frames) if f.fixed]
    if not frames:
        raise NotDetermined("dark_trails", "no dark captures")
    warmest = max(frames, key=lambda f: (f.condition.temperature_c or 0.0, f.condition.exposure_s))
    values: list[_Trail] = []
    labels: list[Label] = []
    common: list[float] = []
    for held_out in warmest.fixed:
        trails, fixed_share = _of_part(dataset, warmest, held_out)
        for one in trails:
            side = "first" if one.line < 0.5 * (dataset.camera.rows, dataset.camera.cols)[one.axis] else "second"
            condition = f"{('rows', 'columns')[one.axis]}, {side} half"
            labels.append(Label(float(one.lag), "all", condition, captures_of(warmest, held_out), held_out))
        values += trails
        common += [fixed_share] * len(trails)
    if not values:
        raise NotDetermined(
            "dark_trails",
            f"fewer than {LEAST_HOT} hot pixels in each half of the dark frames: a longer exposure has more",
        )
    std = np.array([one.std for one in values])
    covariance = np.diag(np.square(std))
    for i, one in enumerate(values):  # the fixed pattern is the same in both parts
        for j in range(i):
            other = values[j]
            if (one.axis, one.lag, labels[i].condition) == (other.axis, other.lag, labels[j].condition):
                covariance[i, j] = covariance[j, i] = std[i] * std[j] * np.sqrt(common[i] * common[j])

    def predict(effects: Effects) -> Prediction:
        return Prediction(
            np.array([trail_behind(dataset.camera, effects, one.axis, one.line, one.lag) for one in values]), {}
        )

    return Observable(
        measurement=DARK_TRAILS, reach=2.0, value=np.array([one.share for one in values]),
        covariance=covariance, labels=tuple(labels),
        reads=frozenset({"charge.trails"}), predict=predict, scale=np.full(len(values), 0.01),
    )  # fmt: skip


def _of_part(dataset: Dataset, dark: DarkStatistics, held_out: bool) -> tuple[list[_Trail], float]:
    """Return the trails in a part's frames, and the share of their variance that is the fixed pattern's."""
    captures = (dark.condition.held_out if held_out else dark.condition.seen)[:MEDIAN_OF]
    raw = [dataset.recordings.frame(c).astype(np.float32) for c in captures]
    away, local = from_surroundings([f - np.float32(f.mean(dtype=np.float64)) for f in raw], dataset.step_dn)
    below = np.float32(0.9 * dataset.saturation_dn) - np.max(raw, axis=0)
    moving = next((part.pixel_dn2 for part in dark.changing.values()), 0.0)
    variance: FloatArray = np.square(np.median(sampled(local)))
    factor = 1.0 if len(raw) == 1 else MEDIAN_VARIANCE / len(raw)
    return _trails(away, local, below), float(np.clip(1.0 - factor * moving / variance, 0.0, 1.0))


DARK_TRAILS = Measurement(
    "dark_trails",
    title="trails of hot pixels",
    order=197,
    axis="distance",
    unit="px",
    make=measure_dark_trails,
    quantity="signal behind a hot pixel less that before it, over the hot pixel's",
    conditions="direction and half of the frame",
)
