"""Errors of the readings of narrowband light: of a reading as a whole, which all channels share, and of its samples."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from sim.spectrum import FloatArray, Spectrum

#: Relative standard deviation of a radiometer's reading as a whole, common to the channels: the repeatability of a
#: spectroradiometer. The most that narrowband readings may have.
RADIOMETER_STD = 0.002
READING_SAMPLE_STD = 1e-3  # of a sample of a radiometer's reading, where no wavelength was read twice
MOST_SAMPLE_STD = 4e-3  # the most that is measured of it
READING_STD = 1e-4  # the least of a reading, common to the channels
_READINGS = 8  # readings from which on their standard deviation is measured


def reading_std(points: list[Any], signal: FloatArray, shot: FloatArray, expected: FloatArray) -> float:
    """Relative standard deviation s of a radiometer's readings, common to the channels, from second differences along
    wavelength.

    With u the ln of measured over expected signal at neighbouring wavelengths, u_2 - (u_1 + u_3) / 2 has the variance
    1.5 s^2 + that of the noise. The median of its magnitude isn't moved by a few outlying wavelengths. At most
    `RADIOMETER_STD`, so that structure of the light or of filters isn't taken for noise; that, too, for fewer than
    `_READINGS` readings."""
    deviation: dict[str, tuple[float, float, float]] = {}
    by_frame: dict[str, list[int]] = {}
    for i, (capture, *_) in enumerate(points):
        by_frame.setdefault(capture.id, []).append(i)
    strong = signal > 0.05 * signal.max()
    for frame, members in by_frame.items():
        use = [i for i in members if strong[i] and expected[i] > 0]
        if use:
            weight = np.square(signal[use]) / shot[use]
            ratio = np.log(signal[use] / expected[use])
            place = points[use[0]][0].wavelength_nm
            deviation[frame] = place, float(np.sum(weight * ratio) / weight.sum()), float(1.0 / weight.sum())
    found = sorted(deviation.values())
    if len(found) < _READINGS:
        return RADIOMETER_STD
    u, v = np.array([f[1] for f in found]), np.array([f[2] for f in found])
    bend = u[1:-1] - 0.5 * (u[:-2] + u[2:])
    noise = float(np.median(v[1:-1] + 0.25 * (v[:-2] + v[2:])))
    spread = float(np.median(np.abs(bend))) / 0.6745
    return float(np.sqrt(np.clip((spread**2 - noise) / 1.5, READING_STD**2, RADIOMETER_STD**2)))


def sample_std(repeats: Iterable[Sequence[Spectrum]]) -> float:
    """Relative standard deviation of a sample of a radiometer's reading, independent of its neighbours. `repeats`: the
    readings of each wavelength.

    Of two readings: the standard deviation of their log ratio over sqrt 2, at samples above a tenth of the peak. The
    median over pairs is taken, at most `MOST_SAMPLE_STD`.
    """
    found = []
    for readings in repeats:
        for first, second in pairwise(readings):
            (w, a), (v, b) = first.arrays, second.arrays
            lit = (a > 0.1 * a.max()) & (b > 0.1 * b.max()) if np.array_equal(w, v) else np.zeros(len(w), bool)
            if lit.sum() > 2:
                found.append(float(np.std(np.log(a[lit] / b[lit]), ddof=1)) / np.sqrt(2.0))
    return min(float(np.median(found)), MOST_SAMPLE_STD) if found else READING_SAMPLE_STD
