"""Where fitted curves differ from those of the maker."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from lab.formats.results import MakerDeparture
from sim.spectrum import FloatArray

STATED_DIGITS = 1e-3  # of the maximum: precision of a stated curve


def compare_curves(
    wavelength_nm: FloatArray, channels: Sequence[str], value: FloatArray, covariance: FloatArray, stated: FloatArray
) -> tuple[float, tuple[MakerDeparture, ...]]:
    """Wavelength bands in which fitted curves differ from stated ones, up to one factor that all channels share.

    `value`, `stated` (channels x wavelengths,), channel after channel; `covariance` of `value` without what is common
    to all. The factor is the median of value / stated where `stated` is above a fifth of its maximum: bands that
    differ don't change it. Every band of neighbouring wavelengths of every channel is tested by its mean difference;
    the significance (normal, two-sided) is corrected for the number of bands. Bands are taken by significance, each
    apart from those before it, down to the level that curves which are as stated exceed in at most 1 % of fits.
    Returns the factor and the bands.
    """
    high = stated > 0.2 * stated.max()
    scale = float(np.median(value[high] / stated[high]))
    # The error of the factor, as for a mean
    weight = high / (high.sum() * np.where(high, stated, 1.0))
    centre = np.eye(value.size) - np.outer(stated, weight)
    covariance_of_difference = centre @ covariance @ centre.T + (STATED_DIGITS * stated.max()) ** 2 * np.eye(value.size)
    difference = value - scale * stated
    size = wavelength_nm.size
    found: list[tuple[float, int, int, int]] = []
    for k in range(len(channels)):
        own = slice(k * size, (k + 1) * size)
        total = np.concatenate([[0.0], np.cumsum(difference[own])])
        square = np.zeros((size + 1, size + 1))
        square[1:, 1:] = np.cumsum(np.cumsum(covariance_of_difference[own, own], axis=0), axis=1)
        for a in range(size):
            for b in range(a + 1, size + 1):
                variance = square[b, b] - 2.0 * square[a, b] + square[a, a]
                found.append((abs(total[b] - total[a]) / float(np.sqrt(variance)), k, a, b))
    tests = len(found)
    limit = float(special.ndtri(1.0 - 0.005 / tests))
    departures: list[MakerDeparture] = []
    taken = np.zeros((len(channels), size), bool)
    for z, k, a, b in sorted(found, reverse=True):
        if z <= limit:
            break
        if taken[k, a:b].any():
            continue
        taken[k, max(a - 1, 0) : b + 1] = True
        part = slice(k * size + a, k * size + b)
        mean, expected = float(difference[part].mean()), float(scale * stated[part].mean())
        log_p = min(float(special.log_ndtr(-z)) + float(np.log(tests)), -0.7)
        departures.append(
            MakerDeparture(
                channel=channels[k],
                from_nm=float(wavelength_nm[a]),
                to_nm=float(wavelength_nm[b - 1]),
                difference=mean,
                difference_std=abs(mean) / z,
                difference_percent=100.0 * mean / expected if expected > 0 else None,
                significance_sigma=float(-special.ndtri_exp(log_p)),
            )
        )
    return scale, tuple(departures)
