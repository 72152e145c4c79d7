"""The grid of a screen's own pixels: the strongest line in the spectrum of the lit screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, special

from lab.capture_kinds.white import WhiteCapture
from lab.diagnose.measurements.block import Block, Effects, Label, Measurement, Prediction
from lab.diagnose.measurements.pattern_fit import mean_rate
from lab.diagnose.measurements.reads import SHOWN
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from sim.frame import screen_light
from sim.sensor import mosaic
from sim.spectrum import FloatArray

CERTAIN = 8.0  # standard deviations
GRID_STD = 1.3  # of the strongest line's number: the noise's mean is measured, too
GRID_DETREND_PX = 8.0  # what is wider is shading
GRID_LOWEST = 0.12  # cycles a sample: below, what was taken off as shading still tells
GRID_LARGEST = 512  # samples a side
GRID_OF_CAMERA = 12.0  # of a flat's mean power: a line that flats have, too, is the camera's


@dataclass(frozen=True)
class _Line:
    """The strongest line in a lit screen's spectrum."""

    channel: str
    captures: tuple[str, ...]
    cycles_per_px: float
    power: float  # over the noise's mean
    per_amplitude: float  # power of a line that a grid of amplitude 1 gives
    places: int

    def normal(self, power: float) -> float:
        """The standard normal quantile of the probability that the largest of `places` exponential variables is `power` or less."""
        rare = np.log(self.places) - power  # logarithm of the probability, far out
        normal = float(np.sqrt(-2.0 * rare)) if rare < -600.0 else -float(special.ndtri(-np.expm1(-np.exp(rare))))
        # far out the logarithm is taken: only the order of magnitude matters
        return normal if normal < CERTAIN else CERTAIN * (1.0 + float(np.log(normal / CERTAIN)))


def grid_block(study: Study) -> Block:
    """Strength of the strongest line in the spectrum of the lit screen by channel, as a standard normal number.

    Lines along rows and columns, and lines that uniform light shows as well, are the camera's and don't count.
    """
    groups = study.groups(WhiteCapture, lambda c: (c.screen.pose, c.exposure_s))
    if not groups:
        raise NotDetermined("screen_grid", "no white captures")
    found: list[_Line] = []
    reason = ""
    for group in groups:
        for channel in study.channels:
            try:
                found.append(_line(study, group, channel))
            except NotDetermined as refused:
                reason = refused.reason
    if not found:
        raise NotDetermined("screen_grid", reason)
    half = np.arange(48) * 0.37 * study.camera.pixel_pitch_um
    x, y = np.meshgrid(half, half)

    def predict(effects: Effects) -> Prediction:
        shown = screen_light(study.camera, np.ones_like(x), x, y, effects)
        size = 2.0 * float(np.std(shown)) / float(np.mean(shown))
        return Prediction(
            np.array(
                [max(line.normal(size**2 * line.per_amplitude + 1.0), 0.0) if size > 0 else 0.0 for line in found]
            ),
            {},
        )

    return Block(
        measurement=SCREEN_GRID, reach=1e9,
        value=np.array([line.normal(line.power) for line in found]), covariance=GRID_STD**2 * np.eye(len(found)),
        labels=tuple(Label(line.cycles_per_px, line.channel, "lit screen", line.captures, False) for line in found),
        reads=SHOWN, predict=predict, scale=np.ones(len(found)),
    )  # fmt: skip


def _line(study: Study, group: Sequence[Any], channel: str) -> _Line:
    step = mosaic.step(study.camera.cfa)
    row, col = mosaic.phases(study.camera.cfa)[channel][0]
    plane = mean_rate(study, group)[row::step, col::step]
    bright = plane > 0.5 * np.quantile(plane, 0.98)
    box = _box(bright)
    power, noise, window = _power(plane[box], step)
    fy, fx = fft.fftfreq(window.shape[0])[:, None], fft.rfftfreq(window.shape[1])[None, :]
    count = (fx > 2.5 / window.shape[1]) & (np.abs(fy) > 2.5 / window.shape[0]) & (np.hypot(fx, fy) > GRID_LOWEST)
    flats = study.flat_levels()
    if flats:
        lit = [study.recordings.frame(c)[row::step, col::step] - study.noise.black for c in flats[len(flats) // 2]]
        of_flats, level, _ = _power(np.mean(lit, axis=0)[box], step)
        count &= ndimage.maximum_filter(of_flats / level, 3) < GRID_OF_CAMERA
    relative = np.where(count, power / noise, 0.0)
    i, j = np.unravel_index(int(np.argmax(relative)), relative.shape)
    # a cos a cos is four lines of a quarter each
    unit = (0.25 * window.sum()) ** 2 / noise[i, j]
    return _Line(
        channel, tuple(c.id for c in group), float(np.hypot(fy[i, 0], fx[0, j])) / step, float(relative[i, j]), float(unit), int(0.6 * count.sum())
    )  # fmt: skip


def _box(bright: NDArray[np.bool_]) -> tuple[slice, slice]:
    """A rectangle well inside the lit part."""
    slices = []
    for axis in (0, 1):
        share = bright.mean(axis=1 - axis)
        use = np.flatnonzero(share > 0.9 * share.max())
        low, high = int(use[0]) + 4, int(use[-1]) - 3
        spare = max(high - low - GRID_LARGEST, 0) // 2
        slices.append(slice(low + spare, high - spare))
    box = slices[0], slices[1]
    if min(s.stop - s.start for s in box) < 24 or bright[box].mean() < 0.98:
        raise NotDetermined("screen_grid", "the lit screen fills too little of the frame")
    return box


def _power(plane: FloatArray, step: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Power spectrum of a plane over its smooth part, the mean that noise has at every frequency, and the window."""
    smooth = ndimage.gaussian_filter(plane, GRID_DETREND_PX / step, mode="nearest")
    window = np.outer(np.hanning(plane.shape[0]), np.hanning(plane.shape[1]))
    relative = plane / np.maximum(smooth, 1e-12) - 1.0
    # outlying pixels are clipped: they aren't lines
    relative = np.clip(relative, *np.quantile(relative, [0.0005, 0.9995]))
    power = np.abs(fft.rfft2(relative * window)) ** 2
    fy, fx = fft.fftfreq(plane.shape[0])[:, None], fft.rfftfreq(plane.shape[1])[None, :]
    ring = np.minimum((np.hypot(fy, fx) * 20.0).astype(int), 13)
    noise = np.ones_like(power)
    for k in range(14):
        if np.any(ring == k):
            noise[ring == k] = np.median(power[ring == k]) / np.log(2.0)
    return power, np.maximum(noise, 1e-300), window


SCREEN_GRID = Measurement(
    "screen_grid",
    title="pixel grid of the screen",
    order=450,
    axis="spatial_frequency",
    unit="cy/px",
    make=grid_block,
    quantity="strength of the line, sigma",
)
