"""The grid of a screen's own pixels: the strongest spectral line of the lit screen's image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, special

from lab.capture_kinds.black import BlackCapture
from lab.capture_kinds.white import WhiteCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset, mean_frame
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import SHOWN
from lab.observables.screens.poses import MOST_SATURATED
from sim.effects.base import Effects
from sim.frame import screen_light
from sim.sensor import mosaic
from sim.spectrum import FloatArray

CERTAIN = 8.0  # standard deviations beyond which strength is stated on a logarithmic scale
#: Independent frequencies, of all that a window of Hann has.
INDEPENDENT = 0.6
GRID_DETREND_PX = 8.0  # standard deviation of the Gaussian by which shading is removed
GRID_LOWEST = 0.12  # cycles a sample below which shading remains
GRID_LARGEST = 512  # largest side of the box, samples
GRID_OF_CAMERA = 12.0  # power over a flat's mean from which on a line of flats is the camera's


@dataclass(frozen=True)
class _Line:
    """The strongest spectral line of a lit screen."""

    channel: str
    captures: tuple[str, ...]
    cycles_per_px: float
    power: float  # over the noise's mean
    per_amplitude: float  # power over the noise's mean of a grid of amplitude 1
    places: int  # effective number of independent frequencies
    noise_std: float  # relative standard deviation of the noise's mean about the line

    def normal(self, power: float) -> float:
        """Standard normal quantile of the probability that the largest of `places` exponential variables of mean 1 is
        at most `power`. Above `CERTAIN`, quantile q becomes CERTAIN (1 + ln(q / CERTAIN))."""
        rare = np.log(self.places) - power  # ln of the probability to exceed it, where that is small
        normal = float(np.sqrt(-2.0 * rare)) if rare < -600.0 else -float(special.ndtri(-np.expm1(-np.exp(rare))))
        # only the order of magnitude matters there
        return normal if normal < CERTAIN else CERTAIN * (1.0 + float(np.log(normal / CERTAIN)))

    @property
    def std(self) -> float:
        """Standard deviation of the quantile: 1, and by the error of the noise's mean, which is measured."""
        low, high = (self.normal(self.power * float(np.exp(sign * self.noise_std))) for sign in (-1.0, 1.0))
        return float(np.hypot(1.0, 0.5 * (high - low)))


def measure_screen_grid(dataset: Dataset) -> Observable:
    """Strength of the strongest spectral line of the lit screen by channel, as a standard normal quantile.

    Lines along rows and columns, and lines that flats show as well, are the camera's and left out. Raises NotDetermined
    without white captures, and where the screen fills too little of the frame.
    """
    groups = dataset.groups(WhiteCapture, lambda c: (c.screen.pose, c.exposure_s))
    if not groups:
        raise NotDetermined("screen_grid", "no white captures")
    found: list[_Line] = []
    reason = ""
    for group in groups:
        for channel in dataset.channels:
            try:
                found.append(_line(dataset, group, channel))
            except NotDetermined as refused:
                reason = refused.reason
    if not found:
        raise NotDetermined("screen_grid", reason)
    half = np.arange(48) * 0.37 * dataset.camera.pixel_pitch_um
    x, y = np.meshgrid(half, half)

    def predict(effects: Effects) -> Prediction:
        shown = screen_light(dataset.camera, np.ones_like(x), x, y, effects)
        size = 2.0 * float(np.std(shown)) / float(np.mean(shown))
        return Prediction(
            np.array(
                [max(line.normal(size**2 * line.per_amplitude + 1.0), 0.0) if size > 0 else 0.0 for line in found]
            ),
            {},
        )

    return Observable(
        measurement=SCREEN_GRID, reach=1e9,
        value=np.array([line.normal(line.power) for line in found]),
        covariance=np.diag([line.std**2 for line in found]),
        labels=tuple(Label(line.cycles_per_px, line.channel, "lit screen", line.captures, False) for line in found),
        reads=SHOWN, predict=predict, scale=np.ones(len(found)),
    )  # fmt: skip


def _line(dataset: Dataset, group: Sequence[Any], channel: str) -> _Line:
    """Return the strongest line in one channel of the mean of some captures."""
    step = mosaic.step(dataset.camera.cfa)
    row, col = mosaic.phases(dataset.camera.cfa)[channel][0]
    for capture in group:
        if (clipped := dataset.recordings.codes(capture).every.share_from(dataset.saturation_dn)) > MOST_SATURATED:
            raise NotDetermined("screen_grid", f"{capture.id}: {100 * clipped:.1f} % of the frame is saturated")
    plane = mean_frame(dataset.recordings, group)[row::step, col::step]
    blacks = [
        c for c in dataset.recordings.captures(BlackCapture, dataset.side) if c.screen.pose == group[0].screen.pose
    ]
    dark = np.median(mean_frame(dataset.recordings, blacks)) if blacks else dataset.noise.black
    bright = plane > 0.5 * (np.quantile(plane, 0.98) + dark)
    box = _box(bright)
    power, noise, noise_std, window = _power(plane[box], step)
    fy, fx = fft.fftfreq(window.shape[0])[:, None], fft.rfftfreq(window.shape[1])[None, :]
    count = (fx > 2.5 / window.shape[1]) & (np.abs(fy) > 2.5 / window.shape[0]) & (np.hypot(fx, fy) > GRID_LOWEST)
    flats = dataset.flat_levels()
    if flats:
        lit = mean_frame(dataset.recordings, flats[len(flats) // 2])[row::step, col::step]
        of_flats, level, *_ = _power(lit[box], step)
        count &= ndimage.maximum_filter(of_flats / level, 3) < GRID_OF_CAMERA
    relative = np.where(count, power / noise, 0.0)
    i, j = np.unravel_index(int(np.argmax(relative)), relative.shape)
    # a product of two cosines of amplitude 1 has four lines of a quarter; codes are relative to light and black level
    share = max(1.0 - dataset.noise.black / float(plane[box].mean()), 0.0)
    unit = (0.25 * share * window.sum()) ** 2 / noise[i, j]
    return _Line(
        channel, tuple(c.id for c in group), float(np.hypot(fy[i, 0], fx[0, j])) / step, float(relative[i, j]),
        float(unit), int(INDEPENDENT * count.sum()), float(noise_std[i, j])
    )  # fmt: skip


def _box(bright: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return a rectangle inside the lit part. Raises NotDetermined where that is too small."""
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


def _power(plane: FloatArray, step: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Power spectrum of a plane over its smooth part less 1, the mean power of noise at every frequency, its relative
    standard deviation, and the window (Hann).

    The mean is the median of a ring of frequencies over ln 2, that of an exponential distribution: of m independent
    ones its relative standard deviation is 1 / (ln 2 sqrt(m))."""
    smooth = ndimage.gaussian_filter(plane, GRID_DETREND_PX / step, mode="nearest")
    window = np.outer(np.hanning(plane.shape[0]), np.hanning(plane.shape[1]))
    relative = plane / np.maximum(smooth, 1e-12) - 1.0
    # outlying pixels are clipped
    relative = np.clip(relative, *np.quantile(relative, [0.0005, 0.9995]))
    power = np.abs(fft.rfft2(relative * window)) ** 2
    fy, fx = fft.fftfreq(plane.shape[0])[:, None], fft.rfftfreq(plane.shape[1])[None, :]
    ring = np.minimum((np.hypot(fy, fx) * 20.0).astype(int), 13)
    noise, std = np.ones_like(power), np.zeros_like(power)
    for k in range(14):
        if np.any(ring == k):
            noise[ring == k] = np.median(power[ring == k]) / np.log(2.0)
            std[ring == k] = 1.0 / (np.log(2.0) * np.sqrt(INDEPENDENT * np.sum(ring == k)))
    return power, np.maximum(noise, 1e-300), std, window


SCREEN_GRID = Measurement(
    "screen_grid",
    title="pixel grid of the screen",
    order=450,
    axis="spatial_frequency",
    unit="cy/px",
    make=measure_screen_grid,
    quantity="strength of the line, sigma",
)
