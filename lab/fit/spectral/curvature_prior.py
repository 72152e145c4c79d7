"""Priors of a curve by its second difference: roots R of covariances R R^T on the wavelengths (m,)."""

from __future__ import annotations

import numpy as np

from sim.spectrum import FloatArray

LOCAL_WIDTH_NM = 10.0  # over which the local roughness is averaged
FINE_LENGTH_NM = 5.0  # correlation length of the fine structure


def averaging_matrix(wave: FloatArray) -> FloatArray:
    """Gaussian averages (m, m) over `LOCAL_WIDTH_NM`."""
    distance = (wave[:, None] - wave) / LOCAL_WIDTH_NM
    average = np.exp(-0.5 * distance**2)
    average /= average.sum(axis=1, keepdims=True)
    return np.asarray(average)


def local_roughness(wave: FloatArray, curve: FloatArray, average: FloatArray) -> FloatArray | None:
    """Roughness (m,) of a curve, maximum 1: the geometric mean of its curvature and its height, both averaged by
    `average` (m, m). None for a straight line.
    """
    if wave.size < 5:
        return None
    curvature = np.sqrt(average @ np.gradient(np.gradient(curve, wave), wave) ** 2)
    height = np.sqrt(average @ np.clip(curve, 0.0, None) ** 2)
    local = np.sqrt(curvature * height)
    return local / local.max() if local.max() > 0 else None


def smooth_root(wave: FloatArray, roughness: FloatArray) -> FloatArray:
    """Root (m, m) of curves whose second difference is white with standard deviation `roughness`, up to straight
    lines.
    """
    return np.clip(wave[:, None] - wave, 0.0, None) * (np.sqrt(np.gradient(wave)) * roughness)


def rough_root(wave: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """As `smooth_root`, with fine structure added (`fine_covariance`)."""
    smooth = smooth_root(wave, roughness)
    if fine_share == 0.0:
        return smooth
    return np.asarray(np.linalg.cholesky(smooth @ smooth.T + fine_covariance(wave, roughness, fine_share)))


def fine_covariance(wave: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """Covariance (m, m) of fine structure: exponential correlation over 5 nm, as high as `fine_share` of what the curvature amounts to over
    10 nm.

    The lights hardly determine it; the uncertainty has to include it.
    """
    height = fine_share * LOCAL_WIDTH_NM**1.5 * roughness
    return np.asarray(np.outer(height, height) * np.exp(-np.abs(wave[:, None] - wave) / FINE_LENGTH_NM))


def signal_covariance(wave: FloatArray, operator: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """Covariance (n, n) of the signals `operator` S of curves S with the prior of `rough_root`, up to straight lines."""
    smooth = operator @ smooth_root(wave, roughness)
    covariance = smooth @ smooth.T
    if fine_share > 0.0:
        covariance = covariance + operator @ fine_covariance(wave, roughness, fine_share) @ operator.T
    return np.asarray(covariance)


def straight_lines(wave: FloatArray) -> FloatArray:
    """The constant and the slope, (m, 2): the curves without a second difference."""
    return np.stack([np.ones_like(wave), 2.0 * (wave - wave.mean()) / np.ptp(wave)], axis=1)
