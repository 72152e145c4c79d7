"""Per pixel: offset, dark current, relative gain, read noise, and which pixels are defective."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy import special

from lab.errors import NotDetermined
from lab.fit.levels import QUANTISATION_DN2, BoolArray, Float32Array, Stack, defective_pixels, shading
from lab.fit.lines import root
from lab.formats.recording_set import Dark, Flat, RecordingSet
from lab.formats.results import Defect, PixelDefects, ReadNoiseDistribution
from sim.camera import Cfa, Side
from sim.sensor.mosaic import planes
from sim.spectrum import FloatArray

LISTED_DEFECTS = 32
SAME_NOISE = 1.1  # ratio of variances up to which darks are pooled
HISTOGRAM_BINS = 48
NOISY_CHANCE = 0.01  # that any pixel of a sensor whose pixels are alike is called noisy
LOW, HIGH = 0.1, 0.9  # of saturation: flats that tell pixels' gains


def taken(recordings: RecordingSet, captures: Sequence[Dark] | Sequence[Flat], bad: BoolArray | None = None) -> Stack:
    """The repeats of one level as a stack. Every frame is read once."""
    camera = recordings.camera(captures[0].side)
    stack = Stack(camera.cfa, camera.saturation_dn, bad)
    for capture in captures:
        stack.add(recordings.frame(capture))
    return stack


@dataclass
class DarkPixels:
    """What darks say of single pixels, gathered level by level: the pooled temporal scatter (DN^2) and its degrees of freedom, and
    the mean frames of the longest and the shortest exposure."""

    cfa: Cfa
    bad: BoolArray | None = None
    scatter: Float32Array | None = None
    freedom: int = 0
    longest: Float32Array | None = None
    longest_s: float = 0.0
    shortest: Float32Array | None = None
    shortest_s: float = 0.0

    def take(self, stack: Stack, exposure_s: float) -> None:
        """A level, after those of longer exposure."""
        if stack.scatter is not None:
            variance = _usual(stack.scatter) / (stack.count - 1)
            # Darks that are noisier than this one have dark current in them: then it isn't the read-out's noise alone.
            if self.scatter is None or variance * SAME_NOISE < _usual(self.scatter) / self.freedom:
                self.scatter, self.freedom = stack.scatter, stack.count - 1
            else:
                self.scatter, self.freedom = self.scatter + stack.scatter, self.freedom + stack.count - 1
        if self.longest is None:
            self.longest, self.longest_s = stack.mean, exposure_s
        self.shortest, self.shortest_s = stack.mean, exposure_s

    def defects(self, gain_dn_per_e: float) -> PixelDefects | None:
        """The pixels that stand out of the longest dark, the strongest listed."""
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
            growth = growth / (self.longest_s - self.shortest_s) / gain_dn_per_e
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


def _usual(scatter: Float32Array) -> float:
    """Median over some ten thousand pixels: noisy ones don't count."""
    apart = max(1, min(scatter.shape) // 128)
    return float(np.median(scatter[::apart, ::apart]))


def read_noise_distribution(dark: DarkPixels, gain_dn_per_e: float) -> ReadNoiseDistribution | None:
    """How the pixels' temporal noise in the dark is distributed; None without repeats, or where rounding hides the noise.

    A pixel's variance over nu degrees of freedom scatters by itself: var(s^2) = 2 sigma^4 / nu + (1 + 2 / nu) var(sigma^2) over the
    pixels, solved for the true spread var(sigma^2)^(1/2) / sigma^2. Percentiles are of the measured values, not of the true ones.
    """
    if dark.scatter is None or dark.freedom < 1:
        return None
    good = dark.scatter if dark.bad is None else dark.scatter[~dark.bad]
    variance = good.ravel().astype(float) / dark.freedom
    mean, count, nu = float(variance.mean()), variance.size, dark.freedom
    if mean < 0.24:
        return None
    # Tails would decide alone otherwise: noisy pixels are counted, not averaged.
    limit = mean * special.chdtri(nu, NOISY_CHANCE / count) / nu
    usual = variance[variance <= limit]
    middle = float(usual.mean())
    rest = (usual / middle - 1.0) ** 2
    measured = float(rest.mean())
    spread2 = (measured - 2.0 / nu) / (1.0 + 2.0 / nu)
    influence = rest - 2.0 * measured * (usual / middle - 1.0)  # of one pixel, the mean it is compared with included
    spread2_std = float(influence.std()) / np.sqrt(count) / (1.0 + 2.0 / nu)
    spread, spread_std = root(spread2, spread2_std)
    rounding = middle / (middle - QUANTISATION_DN2)  # the pixels differ in what isn't rounding's
    noise = np.sqrt(np.maximum(variance - QUANTISATION_DN2, 0.0)) / gain_dn_per_e
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


# --- maps --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PixelMaps:
    """One camera's pixels, arrays (rows, cols): `offset_dn` (mean at no exposure in the dark), `dark_dn_per_s` (None with darks of
    one exposure), `gain` (response over that of its neighbourhood in its plane, shading taken out; None without flats), each with
    `_std`, one standard uncertainty of a pixel; `defective`."""

    offset_dn: FloatArray
    offset_dn_std: FloatArray
    dark_dn_per_s: FloatArray | None
    dark_dn_per_s_std: FloatArray | None
    gain: FloatArray | None
    gain_std: FloatArray | None
    defective: BoolArray


def pixel_maps(recordings: RecordingSet, side: Side) -> PixelMaps:
    """Offset and dark current by a weighted line through each pixel's dark means against exposure, relative gain by the weighted
    mean over the flats between 10 and 90 % of saturation. Raises NotDetermined without darks."""
    camera = recordings.camera(side)
    darks = sorted(_levels(recordings.captures("dark", side)), key=lambda group: -group[0].exposure_s)
    if not darks:
        raise NotDetermined("noise", "no darks: capture two or more at each of two exposures for maps of single pixels")
    offset, dark, defective = _dark_maps(recordings, darks, camera.cfa)
    white = camera.saturation_dn - float(np.median(offset[0]))
    total, square, weight = np.zeros(offset[0].shape), 0.0, 0.0
    for group in _levels(recordings.captures("flat", side)):
        stack = taken(recordings, group, defective)
        image = stack.image()
        signal = image - offset[0] - (dark[0] * group[0].exposure_s if dark is not None else 0.0)
        share = float(np.median(signal)) / white
        if not LOW <= share <= HIGH or float(np.percentile(image, 99.9)) >= camera.saturation_dn:
            continue
        for plane in planes(signal, camera.cfa).values():
            np.divide(plane, shading(plane), out=plane)
        level = share * stack.count  # shot noise: the weight goes with the electrons
        total += level * signal
        square += (level * _pixel_std(stack) / share / white) ** 2
        weight += level
    return PixelMaps(
        offset_dn=offset[0],
        offset_dn_std=offset[1],
        dark_dn_per_s=dark[0] if dark is not None else None,
        dark_dn_per_s_std=dark[1] if dark is not None else None,
        gain=total / weight if weight > 0 else None,
        gain_std=np.full(total.shape, np.sqrt(square) / weight) if weight > 0 else None,
        defective=defective,
    )


C = TypeVar("C", Dark, Flat)
Map = tuple[FloatArray, FloatArray]  # values and standard uncertainties


def _levels(captures: list[C]) -> list[list[C]]:
    """Repeats: captures of the same exposure, light, gain and temperature (to a degree)."""
    groups: dict[Hashable, list[C]] = {}
    for capture in captures:
        light = (capture.photons_per_pixel, capture.radiance) if isinstance(capture, Flat) else None
        temperature_c = None if capture.temperature_c is None else round(capture.temperature_c)
        groups.setdefault((capture.exposure_s, capture.gain_db, temperature_c, light), []).append(capture)
    return list(groups.values())


def _pixel_std(stack: Stack) -> float:
    """Standard uncertainty of a pixel's mean over a stack's repeats, DN: the usual pixel's noise, or rounding's with one image."""
    if stack.scatter is None:
        return float(np.sqrt(QUANTISATION_DN2))
    variance = float(np.mean(stack.scatter)) / (stack.count - 1)
    return float(np.sqrt(max(variance, QUANTISATION_DN2) / stack.count))


def _dark_maps(recordings: RecordingSet, darks: list[list[Dark]], cfa: Cfa) -> tuple[Map, Map | None, BoolArray]:
    """Offset and (with two exposures) dark current of every pixel, and which are defective: out of line in the longest dark."""
    exposure, weight, means = [], [], []
    for group in darks:
        stack = taken(recordings, group)
        exposure.append(group[0].exposure_s)
        weight.append(_pixel_std(stack) ** -2)
        means.append(stack.image())
    defective = defective_pixels(means[0], cfa)
    t, w = np.array(exposure), np.array(weight)
    middle = float(np.sum(w * t) / w.sum())
    mean = sum(one * share for one, share in zip(means, w / w.sum(), strict=True))
    shape = means[0].shape
    norm = float(np.sum(w * (t - middle) ** 2))
    if norm <= 1e-12 * w.sum() * max(middle, 1e-12) ** 2:
        return (np.asarray(mean, float), np.full(shape, w.sum() ** -0.5)), None, defective
    slope = sum(one * share for one, share in zip(means, w * (t - middle) / norm, strict=True))
    offset = np.asarray(mean - slope * middle, float)
    offset_std = float(np.sqrt(1.0 / w.sum() + middle**2 / norm))
    return (
        (offset, np.full(shape, offset_std)),
        (np.asarray(slope, float), np.full(shape, norm**-0.5)),
        defective,
    )
