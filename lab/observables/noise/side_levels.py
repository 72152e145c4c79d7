"""The darks and flats of one camera by level. Each frame is read once, for fits and diagnosis alike.

One level is all frames of one exposure, light and temperature. No more than one level is held in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.formats.recording_set import RecordingSet
from lab.formats.results import RepeatDrift
from lab.observables.darks.pixels import DarkPixels, PixelFigures, stack_of
from lab.observables.flats.stated_light import most_frequent_gain_db
from lab.observables.noise.frame_sums import BoolArray
from lab.observables.noise.levels import MeasuredLevel, rounded_c, usual_c
from lab.observables.noise.stack import PlaneStatistics
from lab.observables.noise.surface import defective_pixels
from sim.camera import Side

C = TypeVar("C", bound=Capture)


def grouped(captures: Sequence[C], key: Callable[[C], Hashable]) -> list[list[C]]:
    """Return the captures with equal `key`, in the order of the first of each."""
    groups: dict[Hashable, list[C]] = {}
    for capture in captures:
        groups.setdefault(key(capture), []).append(capture)
    return list(groups.values())


def usual_darks(recordings: RecordingSet, side: Side) -> list[DarkCapture]:
    """Return the darks at the gain of most flats; where there are none, those at the gain of most darks."""
    darks = recordings.captures(DarkCapture, side)
    gain_db = most_frequent_gain_db(recordings.captures(FlatCapture, side))
    found = [dark for dark in darks if (dark.gain_db or 0.0) == gain_db]
    if found:
        return found
    gains = [dark.gain_db for dark in darks]
    return [dark for dark in darks if dark.gain_db == max(dict.fromkeys(gains), key=gains.count)]


@dataclass(frozen=True, eq=False)
class DarkLevels:
    """The darks of one camera.

    `levels`: longest exposure first, of equal ones the warmest. `pixels`: of the usual temperature. `outlying` (n, 2):
    rows and columns of the pixels that stand out of the longest dark, which all levels leave out.
    """

    levels: tuple[MeasuredLevel, ...]
    pixels: PixelFigures
    outlying: NDArray[np.intp]
    shape: tuple[int, int]

    def with_drifts(self, drifts: Sequence[RepeatDrift]) -> DarkLevels:
        """Return the darks with the drifts over time that repeats of them have."""
        of = {name: drift for drift in drifts for name in drift.changing}
        levels = (
            replace(level, drift=next((of[name] for name in level.captures if name in of), None))
            for level in self.levels
        )
        return replace(self, levels=tuple(levels))

    def mask(self) -> BoolArray | None:
        """Return the mask (rows, cols) of the outlying pixels; None where there are none."""
        if not len(self.outlying):
            return None
        found = np.zeros(self.shape, bool)
        found[tuple(self.outlying.T)] = True
        return found


def dark_levels(
    recordings: RecordingSet, darks: Sequence[DarkCapture], flats: Sequence[FlatCapture], step_dn: float
) -> DarkLevels:
    """Return the levels of `darks`, of one side and gain. `flats`: at whose temperature pixels are looked at;
    `step_dn`: step of the codes."""
    groups = grouped(darks, lambda dark: (dark.exposure_s, rounded_c(dark.temperature_c)))
    groups.sort(key=lambda group: (-group[0].exposure_s, -(group[0].temperature_c or 0.0)))
    usual = usual_c([dark.temperature_c for dark in darks], [flat.temperature_c for flat in flats])

    def made() -> DarkLevels:
        camera = recordings.camera(darks[0].side)
        pixels = DarkPixels(camera.cfa, step_dn)
        levels: list[MeasuredLevel] = []
        for group in groups:
            stack = stack_of(recordings, group, pixels.bad, step_dn)
            if not levels and stack.mean is not None:
                bad = defective_pixels(stack.mean, camera.cfa, step_dn)
                if bad.any():
                    pixels.bad = bad
                    stack = stack_of(recordings, group, bad, step_dn)
            temperature_c = rounded_c(group[0].temperature_c)
            if temperature_c == usual:
                pixels.take(stack, group[0].exposure_s)
            levels.append(
                MeasuredLevel(
                    group[0].exposure_s,
                    0.0,
                    "dark",
                    stack.statistics(),
                    temperature_c,
                    tuple(dark.id for dark in group),
                    sensor_c=_mean_c(group),
                )
            )
        outlying = np.zeros((0, 2), np.intp) if pixels.bad is None else np.argwhere(pixels.bad)
        return DarkLevels(tuple(levels), pixels.figures(), outlying, (camera.rows, camera.cols))

    if not darks:
        return DarkLevels((), PixelFigures(), np.zeros((0, 2), np.intp), (0, 0))
    key = ("dark levels", usual, *_stated(recordings, darks[0]), step_dn, *(_frames(group) for group in groups))
    return recordings.once(key, made, whatever_is_stated=True)


def flat_statistics(
    recordings: RecordingSet, flats: Sequence[FlatCapture], darks: DarkLevels, step_dn: float
) -> dict[str, PlaneStatistics]:
    """Return the statistics by plane of flats of one level, without the pixels that stand out of the `darks`."""
    outlying = darks.outlying.tobytes()
    key = ("flat level", _frames(flats), *_stated(recordings, flats[0]), step_dn, outlying)
    return recordings.once(
        key, lambda: stack_of(recordings, flats, darks.mask(), step_dn).statistics(), whatever_is_stated=True
    )


def _frames(captures: Sequence[Capture]) -> Hashable:
    """Return what the summary of captures depends on: their frames, and what its results state of them."""
    return tuple((capture.frame, capture.id, capture.exposure_s, capture.temperature_c) for capture in captures)


def _stated(recordings: RecordingSet, capture: Capture) -> tuple[Any, ...]:
    """Return what the summary of a capture depends on that the manifest states of its camera."""
    camera = recordings.camera(capture.side)
    return camera.cfa, camera.saturation_dn, camera.rows, camera.cols


def _mean_c(captures: Sequence[Capture]) -> float | None:
    """Mean of the temperatures that the captures state, deg C; None where none does."""
    known = [capture.temperature_c for capture in captures if capture.temperature_c is not None]
    return float(np.mean(known)) if known else None
