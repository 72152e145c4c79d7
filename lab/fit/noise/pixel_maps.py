"""Maps of single pixels: offset, dark current, relative gain, and which pixels are defective."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.observables.codes.rounding import QUANTISATION_DN2
from lab.observables.codes.step import find_code_step
from lab.observables.darks.pixels import stack_of
from lab.observables.noise.frame_sums import BoolArray
from lab.observables.noise.levels import darks_near, rounded_c
from lab.observables.noise.side_levels import grouped
from lab.observables.noise.stack import Stack
from lab.observables.noise.surface import defective_pixels, shading
from sim.camera import Cfa, Side
from sim.sensor.mosaic import planes
from sim.spectrum import FloatArray

LOW, HIGH = 0.1, 0.9  # of saturation: flats that determine the gains of pixels


@dataclass(frozen=True, eq=False)
class PixelMaps:
    """Maps (rows, cols) of one camera, each with `_std`, the standard deviation of a pixel.

    `offset_dn`: mean in the dark at no exposure. `dark_dn_per_s`: dark current, None with darks of one exposure.
    `gain`: response over that of the neighbourhood in its plane, without shading; None without flats. `defective`:
    mask.
    """

    offset_dn: FloatArray
    offset_dn_std: FloatArray
    dark_dn_per_s: FloatArray | None
    dark_dn_per_s_std: FloatArray | None
    gain: FloatArray | None
    gain_std: FloatArray | None
    defective: BoolArray


def pixel_maps(recordings: RecordingSet, side: Side) -> PixelMaps:
    """Return maps of offset, dark current and relative gain of the pixels of `side`.

    Offset and dark current: a weighted line through the dark means of each pixel against exposure, of the darks of the
    temperature at which most flats, or else most darks, were taken. Gain: the weighted
    mean over the flats between 10 and 90 % of saturation. Raises `NotDetermined` without darks.
    """
    camera = recordings.camera(side)
    flats = recordings.captures(FlatCapture, side)
    darks_at_temperature = darks_near(recordings.captures(DarkCapture, side), flats)
    darks = sorted(_levels(darks_at_temperature), key=lambda group: -group[0].exposure_s)
    if not darks:
        raise NotDetermined("noise", "no darks: capture two or more at each of two exposures for maps of single pixels")
    step_dn = find_code_step(recordings, side).step_dn
    offset, dark, defective = _dark_maps(recordings, darks, camera.cfa, step_dn)
    white = camera.saturation_dn - float(np.median(offset[0]))
    total, square, weight = np.zeros(offset[0].shape), 0.0, 0.0
    for group in _levels(flats):
        stack = stack_of(recordings, group, defective, step_dn)
        image = stack.image()
        signal = image - offset[0] - (dark[0] * group[0].exposure_s if dark is not None else 0.0)
        share = float(np.median(signal)) / white
        if not LOW <= share <= HIGH or float(np.percentile(image, 99.9)) >= camera.saturation_dn:
            continue
        for plane in planes(signal, camera.cfa).values():
            np.divide(plane, shading(plane), out=plane)
        level = share * stack.count  # weight of shot noise
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


C = TypeVar("C", DarkCapture, FlatCapture)
Map = tuple[FloatArray, FloatArray]  # values and standard deviations


def _levels(captures: list[C]) -> list[list[C]]:
    """Repeats: captures of the same exposure, light, gain and temperature (to a degree)."""

    def setting(capture: C) -> Hashable:
        light = (capture.photons_per_pixel, capture.radiance) if isinstance(capture, FlatCapture) else None
        return capture.exposure_s, capture.gain_db, rounded_c(capture.temperature_c), light

    return grouped(captures, setting)


def _pixel_std(stack: Stack) -> float:
    """Standard deviation of the mean of a pixel over the repeats of a stack, DN; that of rounding with one image."""
    quantisation_dn2 = QUANTISATION_DN2 * stack.step_dn**2
    if stack.squares is None:
        return float(np.sqrt(quantisation_dn2))
    variance = float(np.mean(stack.squares)) / (stack.count - 1)
    return float(np.sqrt(max(variance, quantisation_dn2) / stack.count))


def _dark_maps(
    recordings: RecordingSet, darks: list[list[DarkCapture]], cfa: Cfa, step_dn: float
) -> tuple[Map, Map | None, BoolArray]:
    """Offset, dark current (with two exposures) and the mask of pixels that stand out of the longest dark."""
    exposure, weight, means = [], [], []
    for group in darks:
        stack = stack_of(recordings, group, step_dn=step_dn)
        exposure.append(group[0].exposure_s)
        weight.append(_pixel_std(stack) ** -2)
        means.append(stack.image())
    defective = defective_pixels(means[0], cfa, step_dn)
    t, w = np.array(exposure), np.array(weight)
    middle = float(np.sum(w * t) / w.sum())
    mean = sum(dark_mean * share for dark_mean, share in zip(means, w / w.sum(), strict=True))
    shape = means[0].shape
    norm = float(np.sum(w * (t - middle) ** 2))
    if norm <= 1e-12 * w.sum() * max(middle, 1e-12) ** 2:
        return (np.asarray(mean, float), np.full(shape, w.sum() ** -0.5)), None, defective
    slope = sum(dark_mean * share for dark_mean, share in zip(means, w * (t - middle) / norm, strict=True))
    offset = np.asarray(mean - slope * middle, float)
    offset_std = float(np.sqrt(1.0 / w.sum() + middle**2 / norm))
    return (
        (offset, np.full(shape, offset_std)),
        (np.asarray(slope, float), np.full(shape, norm**-0.5)),
        defective,
    )
