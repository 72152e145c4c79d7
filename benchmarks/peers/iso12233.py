"""The slanted-edge method as ISO 12233:2005 (annex D) writes it down, word by word: for comparison, not for use.

Every row's edge by the centroid of its windowed derivative, one straight line through them, all pixels projected along
it into bins of a quarter pixel, derivative [-1/2, 0, 1/2], Hamming window, discrete Fourier transform, the derivative's
own transfer taken out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def iso12233_mtf(region: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequencies (cy/px along rows, 0..1) and MTF of a near-vertical edge, light on the right, in (rows, cols)."""
    rows, cols = region.shape
    at = np.arange(cols)
    lines = np.zeros((rows, 2))
    centre = np.full(rows, (cols - 1) / 2.0)
    for _ in range(2):  # the window is centred first on the region, then on the line
        slope = np.gradient(region, axis=1)
        window = np.hamming(2 * cols)[np.clip(np.rint(at - centre[:, None] + cols).astype(int), 0, 2 * cols - 1)]
        found = (slope * window * at).sum(axis=1) / (slope * window).sum(axis=1)
        lines = np.polyfit(np.arange(rows), found, 1)
        centre = np.polyval(lines, np.arange(rows))
    place = (at - centre[:, None]) * 4.0
    bins = np.floor(place + 2 * cols).astype(int).ravel()
    inside = (bins >= 0) & (bins < 4 * cols)
    total = np.bincount(bins[inside], region.ravel()[inside], 4 * cols)
    count = np.bincount(bins[inside], minlength=4 * cols)
    filled = count > 0
    profile = np.interp(np.arange(4 * cols), np.flatnonzero(filled), total[filled] / count[filled])
    spread = np.convolve(profile, [0.5, 0.0, -0.5], mode="same")
    spread[[0, -1]] = 0.0
    spread *= np.hamming(4 * cols)
    mtf = np.abs(np.fft.rfft(spread))
    frequency = np.arange(len(mtf)) / cols
    correction = np.sinc(2.0 * frequency / 4.0)  # of the derivative over two bins
    mtf = mtf / mtf[0] / np.where(frequency < 1.5, correction, 1.0)
    keep = frequency <= 1.0
    return frequency[keep], mtf[keep]
