"""Signal rates of the planes of a mosaic in lights of stated spectra, and the rates that sensitivity curves predict for
them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.chart import ChartCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import InputError
from lab.formats.recording_set import Frame, RecordingSet
from lab.measure.patches import patch_boxes
from sim.camera import CameraModel, Side
from sim.scene.colorchecker import reflectances
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import electron_rate

C = TypeVar("C", bound=Capture)
CLIPPED_SHARE = 0.01  # share of a plane's pixels from which on it counts as clipped
OFFSET_DN = 1.0  # uncertainty of the dark level
FEWEST_PIXELS = 8  # of a patch in a plane


@dataclass(frozen=True)
class LitPlanes:
    """The signal of a part of the frame in one light."""

    captures: tuple[str, ...]
    kind: str
    radiance: str
    wavelength_nm: float | None
    reflectance: Spectrum | None  # of a chart's patch
    rate: FloatArray  # (planes,): mean signal above dark of the mosaic's planes, row by row, DN/s; NaN where clipped
    offset: float  # uncertainty of the rates by the dark level, DN/s


def narrowband_planes(recordings: RecordingSet, side: Side) -> list[LitPlanes]:
    """Return the planes in each narrowband light: one item a wavelength, the mean of its captures."""
    darks = _dark_levels(recordings, side)
    groups: dict[float, list[NarrowbandCapture]] = {}
    for capture in _exposed(recordings.captures(NarrowbandCapture, side)):
        groups.setdefault(capture.wavelength_nm, []).append(capture)
    found = []
    for wavelength_nm, group in groups.items():
        rates = [_rates(recordings, side, capture, recordings.frame(capture), darks) for capture in group]
        found.append(
            LitPlanes(
                tuple(c.id for c in group), group[0].kind, group[0].radiance, wavelength_nm, None, np.mean(rates,
                axis=0),
                OFFSET_DN / min(c.exposure_s for c in group),
            )
        )  # fmt: skip
    return found


def chart_planes(recordings: RecordingSet, side: Side) -> list[list[LitPlanes]]:
    """Return the planes of each patch, in every light of a chart. Each plane is taken from the longest exposure that
    doesn't clip it."""
    darks = _dark_levels(recordings, side)
    groups: dict[str, list[ChartCapture]] = {}
    for capture in _exposed(recordings.captures(ChartCapture, side)):
        groups.setdefault(capture.radiance, []).append(capture)
    found = []
    for radiance, unordered in groups.items():
        group = sorted(unordered, key=lambda capture: -capture.exposure_s)
        frames = [recordings.frame(capture) for capture in group]
        known = reflectances(group[0].chart)
        patches = []
        for number, (name, *_) in enumerate(patch_boxes(group[0])):
            seen = []
            for capture, frame in zip(group, frames, strict=True):
                rows, cols = patch_boxes(capture)[number][1:3]
                even = slice(rows[0] - rows[0] % 2, rows[1]), slice(cols[0] - cols[0] % 2, cols[1])
                seen.append(_rates(recordings, side, capture, frame[even], darks))
            whole = np.array(seen)
            rate = whole[np.argmax(np.isfinite(whole), axis=0), np.arange(whole.shape[1])]
            offset = OFFSET_DN / group[0].exposure_s
            patches.append(
                LitPlanes(tuple(c.id for c in group), group[0].kind, radiance, None, known[name], rate, offset)
            )
        found.append(patches)
    return found


def _exposed(captures: Sequence[C]) -> list[C]:
    return [capture for capture in captures if capture.exposure_s > 0]


def _rates(
    recordings: RecordingSet, side: Side, capture: Capture, part: Frame, darks: Mapping[float, float]
) -> FloatArray:
    """Rates (planes,) in a part of a frame that begins at an even row and column, DN/s above dark."""
    camera = recordings.camera(side)
    step = mosaic.step(camera.cfa)
    nearest = min(darks, key=lambda exposure_s: abs(np.log(max(exposure_s, 1e-9) / capture.exposure_s)))
    dark = darks[nearest]
    found = np.full(step**2, np.nan)
    for k in range(step**2):
        plane = part[k // step :: step, k % step :: step]
        if plane.size >= FEWEST_PIXELS and np.mean(plane >= camera.saturation_dn) < CLIPPED_SHARE:
            found[k] = (float(plane.mean()) - dark) / capture.exposure_s
    return found


def _dark_levels(recordings: RecordingSet, side: Side) -> dict[float, float]:
    """Exposure -> mean of its first dark frame, DN; without dark frames, 0 s -> the stated black level."""
    first: dict[float, Capture] = {}
    for dark in recordings.captures("dark", side):
        first.setdefault(dark.exposure_s, dark)
    found = {exposure_s: float(recordings.frame(dark).mean()) for exposure_s, dark in first.items()}
    return found or {0.0: recordings.camera(side).black_level_dn or 0.0}


def predicted(recordings: RecordingSet, camera: CameraModel, seen: Sequence[LitPlanes]) -> dict[str, FloatArray]:
    """Channel -> electrons a second in each of the lights (n,); 0 where a light's spectrum can't be used."""

    def rate(one: LitPlanes, channel: str) -> float:
        try:
            light = recordings.spectrum(one.radiance)
        except InputError:
            return 0.0
        return electron_rate(camera, channel, light, kind=one.kind, reflectance=one.reflectance)

    return {channel: np.array([rate(one, channel) for one in seen]) for channel in camera.channels}
