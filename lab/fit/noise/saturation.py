"""Which flats saturate in which plane, and at what signal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.fit.noise.dark_signal import DarkSignal
from lab.fit.noise.level_statistics import MeasuredLevel
from lab.fit.noise.recorded_levels import RecordedLevels

CLIPPED_LIMIT = 1e-4  # share of clipped pixels above which the variance of a level is too small
PILED_LIMIT = 2e-3  # share of pixels at the highest code of their plane above which the plane saturates there
PILED_PIXELS = 12  # and their number: normal noise of some DN puts one or two on the highest code


@dataclass(frozen=True)
class Saturation:
    """Saturation by plane.

    `signal_dn`: DN above black; the limit of the converter where it wasn't seen. `seen_dn`: the same where it was
    seen, else None. `clipped`: by plane, for each flat, whether it saturates.
    """

    signal_dn: dict[str, float]
    seen_dn: dict[str, float | None]
    clipped: dict[str, list[bool]]


def saturation_of(recorded: RecordedLevels, dark: DarkSignal) -> Saturation:
    """Saturation of each plane. Planes differ in their light, not in their pixels: one that stays below saturation has
    that of the others.
    """
    clipped: dict[str, list[bool]] = {}
    seen: dict[str, float | None] = {}
    for name in recorded.names:
        clipped[name], plateau = _clipped_flats(recorded, dark, name)
        seen[name] = None if plateau is None else plateau - dark.lines[name].black
    found = [value for value in seen.values() if value is not None]
    saturation = {}
    for name, value in seen.items():
        black = dark.lines[name].black
        limit = max(found) if found else recorded.white_dn - black
        highest = max(level.plane[name].mean for level in recorded.flats) - black
        saturation[name] = value if value is not None else max(limit, highest)
    return Saturation(saturation, seen, clipped)


def _clipped_flats(recorded: RecordedLevels, dark: DarkSignal, name: str) -> tuple[list[bool], float | None]:
    """Which flats clip in a plane, and the DN at which they do where this was seen: all pixels there, or piled up."""
    flags: list[tuple[MeasuredLevel, bool]] = []
    ratios: list[float] = []
    plateau: float | None = None
    for level in sorted(recorded.flats, key=lambda level: level.plane[name].mean):
        plane = level.plane[name]
        signal = plane.mean - dark.lines[name].at(level.exposure_s)
        noise = min((d.plane[name].temporal_variance for d in recorded.darks), default=0.0)
        excess = plane.temporal_variance - (noise if np.isfinite(noise) else 0.0)
        ratio = excess / signal if signal > 0 else np.nan
        typical = float(np.median(ratios)) if ratios else np.nan
        at_white = plane.clipped_share > CLIPPED_LIMIT
        piled = plane.piled_share > max(PILED_LIMIT, PILED_PIXELS / plane.pixels) and plane.temporal_variance > 4.0
        saturates = signal > 0.2 * (recorded.white_dn - dark.lines[name].black) and (
            ratio < 0.5 * typical or plane.temporal_variance < 0.01
        )
        if at_white:
            plateau = recorded.white_dn
        elif piled:
            plateau = max(plateau or 0.0, plane.highest)
        elif saturates and ratio < 0.1 * typical:
            plateau = max(plateau or 0.0, plane.mean)
        clipped = at_white or piled or bool(saturates)
        flags.append((level, clipped))
        if not clipped and np.isfinite(ratio):
            ratios.append(ratio)
    by_level = {id(level): clipped for level, clipped in flags}
    return [by_level[id(level)] for level in recorded.flats], plateau
