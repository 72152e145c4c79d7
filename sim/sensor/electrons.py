"""From electrons to codes: fixed patterns, shot noise, full well, read noise, conversion, quantisation.

The order, for one exposure: mean electrons (light + dark current) -> x (1 + PRNU) on the light -> shot noise (Poisson) -> full
well -> the read-out's response -> + DSNU and read noise -> x conversion gain, + black level -> round, clip to
[0, white_level_dn].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sim.camera import CameraModel
from sim.spectrum import FloatArray

Response = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """What one camera's pixels keep from frame to frame: relative deviation of the response `prnu`, and deviation of the dark
    signal `dsnu_e` (electrons, the same at every exposure), both (rows, cols) and of mean 0."""

    prnu: FloatArray
    dsnu_e: FloatArray

    @classmethod
    def draw(cls, camera: CameraModel, rng: np.random.Generator) -> Self:
        """One camera's pattern: normal, with the camera's `prnu_percent` and `dsnu_e` as standard deviations."""
        shape = camera.rows, camera.cols
        return cls(
            prnu=rng.standard_normal(shape) * (camera.prnu_percent / 100.0),
            dsnu_e=rng.standard_normal(shape) * camera.dsnu_e,
        )


def gain_dn_per_e(camera: CameraModel, gain_db: float) -> float:
    """Conversion gain (DN/e) at an analogue gain: K 10^(dB / 20)."""
    return camera.conversion_gain_dn_per_e * 10.0 ** (gain_db / 20.0)


def clipped_moments(
    mean: FloatArray, variance: FloatArray, lower: float, upper: float
) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of a normal variable after clipping to [lower, upper] (either may be infinite).

    With standardised limits a, b, density phi and distribution Phi of the normal law:
    E = lower Phi(a) + upper (1 - Phi(b)) + mean (Phi(b) - Phi(a)) - s (phi(b) - phi(a)), and E of the square in the same way.
    """
    mean, variance = np.broadcast_arrays(np.asarray(mean, float), np.asarray(variance, float))
    s = np.sqrt(variance)
    # Eight standard deviations from the limits nothing is clipped (1e-15), and bits shouldn't change.
    near = (mean - 8.0 * s < lower) | (mean + 8.0 * s > upper)
    if not np.any(near):
        return mean.copy(), variance.copy()
    out_mean, out_variance = mean.copy(), variance.copy()
    m, s = mean[near], np.maximum(s[near], 1e-12)
    below = above = np.zeros_like(m)
    phi_a = phi_b = a_phi_a = b_phi_b = np.zeros_like(m)
    low = high = np.zeros_like(m)
    if np.isfinite(lower):
        a = (lower - m) / s
        below, phi_a, low = ndtr(a), _normal_density(a), a
        a_phi_a = a * phi_a
    if np.isfinite(upper):
        b = (upper - m) / s
        above, phi_b, high = ndtr(-b), _normal_density(b), b
        b_phi_b = b * phi_b
    inside = 1.0 - below - above
    # Moments of the standardised clipped variable, which avoids the cancellation of large means.
    first = low * below + high * above - (phi_b - phi_a)
    second = low**2 * below + high**2 * above + inside - (b_phi_b - a_phi_a)
    out_mean[near] = np.clip(m + s * first, lower, upper)
    out_variance[near] = np.maximum(second - first**2, 0.0) * s * s
    return out_mean, out_variance


def _normal_density(x: FloatArray) -> FloatArray:
    return np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)


def dn_moments(
    electrons: FloatArray, camera: CameraModel, gain_db: float = 0.0, response: Response | None = None
) -> tuple[FloatArray, FloatArray]:
    """Mean (DN, not rounded) and temporal variance (DN^2, with 1/12 for rounding) of pixels with mean `electrons`.

    Shot noise is Poisson; the clipping at full well and by the converter is taken into account with normal laws. The variance
    goes through `response` by its slope.
    """
    check_electrons(electrons)
    mean, variance = clipped_moments(electrons, electrons, -np.inf, camera.full_well_e)
    if response is not None:
        step = np.maximum(1e-3 * mean, 1e-3)
        slope = (response(mean + step) - response(mean)) / step
        mean, variance = response(mean), variance * slope**2
    gain = gain_dn_per_e(camera, gain_db)
    return clipped_moments(
        camera.black_level_dn + gain * mean,
        gain**2 * (variance + camera.read_noise_e**2) + 1.0 / 12.0,
        0.0,
        camera.white_level_dn,
    )


def sample_from(
    expected_electrons: FloatArray,
    camera: CameraModel,
    rng: np.random.Generator,
    fixed_pattern: FixedPattern | None = None,
    *,
    dark_electrons: float = 0.0,
    gain_db: float = 0.0,
    response: Response | None = None,
) -> NDArray[np.uint16]:
    """One frame: codes (rows, cols) drawn around `expected_electrons` (mean, with the dark current's `dark_electrons`).

    `fixed_pattern` None stands for pixels that are all alike. `response` is the read-out's (None: linear).
    """
    check_electrons(expected_electrons)
    mean = expected_electrons
    if fixed_pattern is not None:
        mean = np.maximum(mean + (mean - dark_electrons) * fixed_pattern.prnu, 0.0)
    charge = np.minimum(rng.poisson(mean).astype(float), camera.full_well_e)
    if response is not None:
        charge = response(charge)
    if fixed_pattern is not None:
        charge = charge + fixed_pattern.dsnu_e
    if camera.read_noise_e > 0:
        charge = charge + rng.standard_normal(mean.shape) * camera.read_noise_e
    codes = np.rint(camera.black_level_dn + gain_dn_per_e(camera, gain_db) * charge)
    return np.clip(codes, 0.0, camera.white_level_dn).astype(np.uint16)


def check_electrons(electrons: FloatArray) -> None:
    """Raises ValueError where mean electrons aren't finite or are below 0."""
    lowest = float(np.min(electrons, initial=np.inf))
    if lowest < 0 or not np.all(np.isfinite(electrons)):
        bad = lowest if lowest < 0 else float(np.asarray(electrons)[~np.isfinite(electrons)][0])
        raise ValueError(
            f"mean electrons of a pixel are {bad:g} e, below the limit of 0 e or not finite: check the radiance and the effects' parameters"
        )
