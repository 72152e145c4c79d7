"""What darks say of single pixels: defects, and the distribution of the read noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Defect, PixelDefects, ReadNoiseDistribution
from lab.observables.codes.rounding import QUANTISATION_DN2
from lab.observables.noise.frame_sums import BoolArray, Float32Array
from lab.observables.noise.stack import Stack
from lab.observables.weighted_lines import root
from sim.camera import Cfa
from sim.sensor.mosaic import planes

LISTED_DEFECTS = 32
SAME_NOISE = 1.1  # ratio of variances up to which darks are pooled
HISTOGRAM_BINS = 48
NOISY_CHANCE = 0.01  # probability that any pixel of a uniform sensor is called noisy
VISIBLE_DN2 = 0.24  # below: rounding hides the noise


def stack_of(
    recordings: RecordingSet,
    captures: Sequence[DarkCapture] | Sequence[FlatCapture],
    bad: BoolArray | None = None,
    step_dn: float = 1.0,
) -> Stack:
    """Return the repeats of one level as a stack; every frame is read once. `bad` (rows, cols): pixels to leave out;
    `step_dn`: step of the codes."""
    camera = recordings.camera(captures[0].side)
    stack = Stack(camera.cfa, camera.saturation_dn, bad, step_dn)
    for capture in captures:
        stack.add(recordings.frame(capture))
    return stack


@dataclass(frozen=True)
class PixelFigures:
    """What darks say of single pixels. Electrons are those of a gain of 1 DN/e, until `at_gain` counts them."""

    noise: ReadNoiseDistribution | None = None
    defects: PixelDefects | None = None

    @property
    def number(self) -> int:
        """Number of defective pixels."""
        return 0 if self.defects is None else self.defects.hot + self.defects.cold

    def at_gain(self, gain_dn_per_e: float) -> PixelFigures:
        """Return the figures at a conversion gain."""
        noise, defects = self.noise, self.defects
        if noise is not None:
            names = "rms_e", "median_e", "percentile_95_e", "percentile_99_e"
            update: dict[str, Any] = {name: getattr(noise, name) / gain_dn_per_e for name in names}
            update["noise_e"] = tuple(edge / gain_dn_per_e for edge in noise.noise_e)
            noise = noise.model_copy(update=update)
        if defects is not None:
            currents = [pixel.dark_current_e_per_s for pixel in defects.listed]
            scaled = [None if current is None else current / gain_dn_per_e for current in currents]
            listed = (
                pixel.model_copy(update={"dark_current_e_per_s": current})
                for pixel, current in zip(defects.listed, scaled, strict=True)
            )
            defects = defects.model_copy(update={"listed": tuple(listed)})
        return PixelFigures(noise, defects)


@dataclass
class DarkPixels:
    """Single pixels in the darks, gathered level by level.

    `squares` (rows, cols), `freedom`: pooled sum of squared temporal deviations, DN^2, and its degrees of freedom.
    `longest`, `shortest` (rows, cols): mean frames of the longest and the shortest exposure, DN. `bad`: mask of
    defective pixels. `step_dn`: step of the codes.
    """

    cfa: Cfa
    step_dn: float = 1.0
    bad: BoolArray | None = None
    squares: Float32Array | None = None
    freedom: int = 0
    longest: Float32Array | None = None
    longest_s: float = 0.0
    shortest: Float32Array | None = None
    shortest_s: float = 0.0

    def take(self, stack: Stack, exposure_s: float) -> None:
        """Add a level; levels come in the order of falling exposure."""
        if stack.squares is not None:
            variance = _median_variance(stack.squares) / (stack.count - 1)
            # Darks with more noise than this one contain shot noise of the dark current
            if self.squares is None or variance * SAME_NOISE < _median_variance(self.squares) / self.freedom:
                self.squares, self.freedom = stack.squares, stack.count - 1
            else:
                self.squares, self.freedom = self.squares + stack.squares, self.freedom + stack.count - 1
        if self.longest is None:
            self.longest, self.longest_s = stack.mean, exposure_s
        self.shortest, self.shortest_s = stack.mean, exposure_s

    def figures(self) -> PixelFigures:
        """Return what was gathered, small against frames."""
        return PixelFigures(read_noise_distribution(self), self.defects())

    def defects(self) -> PixelDefects | None:
        """Pixels that stand out of the longest dark, the strongest listed; None without darks or defects mask."""
        if self.bad is None or self.longest is None:
            return None
        above = np.zeros(self.longest.shape)
        for image, rest in zip(planes(self.longest, self.cfa).values(), planes(above, self.cfa).values(), strict=True):
            rest[...] = image - np.median(image)
        growth = None
        if self.shortest is not None and self.longest_s > self.shortest_s:
            growth = self.longest - self.shortest
            for image in planes(growth, self.cfa).values():
                np.subtract(image, np.median(image), out=image)
            growth = growth / (self.longest_s - self.shortest_s)
        where = np.argwhere(self.bad)
        strongest = where[np.argsort(-np.abs(above[self.bad]), kind="stable")][:LISTED_DEFECTS]
        return PixelDefects(
            exposure_s=self.longest_s,
            hot=int(np.count_nonzero(above[self.bad] > 0)),
            cold=int(np.count_nonzero(above[self.bad] <= 0)),
            listed=tuple(
                Defect(
                    row=int(row),
                    col=int(col),
                    dark_dn=float(above[row, col]),
                    dark_current_e_per_s=None if growth is None else float(growth[row, col]),
                )
                for row, col in strongest
            ),
        )


def _median_variance(squares: Float32Array) -> float:
    """Median over some ten thousand pixels, which noisy ones don't change."""
    apart = max(1, min(squares.shape) // 128)
    return float(np.median(squares[::apart, ::apart]))


def read_noise_distribution(dark: DarkPixels) -> ReadNoiseDistribution | None:
    """Distribution of the temporal noise of the pixels in the dark, at a gain of 1 DN/e; None without repeats, or where
    rounding hides the noise.

    The sample variance of a pixel with nu degrees of freedom varies by itself: var(s^2) = 2 sigma^4 / nu + (1 + 2 /
    nu) var(sigma^2) over the pixels. This is solved for the true relative spread var(sigma^2)^(1/2) / sigma^2.
    Percentiles are of the measured values, not of the true ones.
    """
    if dark.squares is None or dark.freedom < 1:
        return None
    good = dark.squares if dark.bad is None else dark.squares[~dark.bad]
    variance = good.ravel().astype(float) / dark.freedom
    mean, count, nu = float(variance.mean()), variance.size, dark.freedom
    quantisation_dn2 = QUANTISATION_DN2 * dark.step_dn**2
    if mean < VISIBLE_DN2 * dark.step_dn**2:
        return None
    # Noisy pixels are counted, not averaged: the tail would dominate
    limit = mean * special.chdtri(nu, NOISY_CHANCE / count) / nu
    regular = variance[variance <= limit]
    middle = float(regular.mean())
    rest = (regular / middle - 1.0) ** 2
    measured = float(rest.mean())
    spread2 = (measured - 2.0 / nu) / (1.0 + 2.0 / nu)
    influence = rest - 2.0 * measured * (regular / middle - 1.0)  # influence function of one pixel
    spread2_std = float(influence.std()) / np.sqrt(count) / (1.0 + 2.0 / nu)
    spread, spread_std = root(spread2, spread2_std)
    rounding = middle / (middle - quantisation_dn2)  # the variance of rounding is common to all pixels
    noise = np.sqrt(np.maximum(variance - quantisation_dn2, 0.0))
    pixels, edges = np.histogram(noise, HISTOGRAM_BINS, (0.0, float(np.percentile(noise, 99.9)) * 1.2))
    return ReadNoiseDistribution(
        degrees_of_freedom=nu,
        rms_e=float(np.sqrt(np.mean(noise**2))),
        median_e=float(np.median(noise)),
        percentile_95_e=float(np.percentile(noise, 95)),
        percentile_99_e=float(np.percentile(noise, 99)),
        spread_percent=100.0 * spread * rounding,
        spread_percent_std=100.0 * spread_std * rounding,
        noisy_pixels=int(np.count_nonzero(variance > limit)),
        noise_e=tuple(float(edge) for edge in edges),
        pixels=tuple(int(number) for number in pixels),
    )
