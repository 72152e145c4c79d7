"""Drift of the lamp between the repeats of a level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from lab.observables.flats.level_lines import (
    DarkSignal,
    Saturation,
)
from lab.observables.noise.levels import RecordedLevels

DRIFT_CHANCE = 1e-4  # probability below which differences of repeats are a drift


@dataclass(frozen=True)
class LampDrift:
    """Differences of the means of repeats from that of their level.

    `relative`: standard deviation beyond noise, relative to the signal; 0 where noise explains it. `std_dn`: standard
    deviation; `noise_dn`: that by noise.
    """

    relative: float
    std_dn: float
    noise_dn: float


def lamp_drift(recorded: RecordedLevels, dark: DarkSignal, saturation: Saturation) -> LampDrift:
    """Compare the means of repeated flats, over all unsaturated levels and planes."""
    relative, square, expected, chi2, freedom = 0.0, 0.0, 0.0, 0.0, 0
    for level in recorded.flats:
        unclipped = [n for n in recorded.names if not saturation.clipped[n][recorded.flats.index(level)]]
        if level.repeats < 2 or not unclipped:
            continue
        planes = [level.plane[n] for n in unclipped]
        pixels = np.array([plane.pixels for plane in planes], float)
        frames = np.average([plane.frame_means for plane in planes], axis=0, weights=pixels)
        variance = float(np.average([plane.temporal_variance for plane in planes], weights=pixels))
        rounding = max(plane.mean_rounding_std for plane in planes)
        noise = max(variance, recorded.quantisation_dn2) / pixels.sum() + rounding**2
        signal = float(
            np.average([p.mean - dark.lines[n].black for p, n in zip(planes, unclipped, strict=True)], weights=pixels)
        )
        rest = float(np.sum((frames - frames.mean()) ** 2))
        square += rest
        expected += noise * (len(frames) - 1)
        chi2 += rest / noise
        relative += (rest - noise * (len(frames) - 1)) / max(signal, 1.0) ** 2
        freedom += len(frames) - 1
    if freedom == 0:
        return LampDrift(0.0, 0.0, 0.0)
    chance = float(special.chdtrc(freedom, chi2))
    if chance > DRIFT_CHANCE or relative <= 0:
        relative = 0.0
    return LampDrift(
        float(np.sqrt(relative / freedom)), float(np.sqrt(square / freedom)), float(np.sqrt(expected / freedom))
    )
