"""From electrons to codes: fixed patterns, shot noise, full well, read-out, conversion, quantisation.

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

#: From this mean on, a Poisson variable is drawn as m + sqrt(m) z + (z^2 - 1) / 6 with a normal z: its mean, variance and
#: skewness are right, and its distribution function is within 1e-3 (half the Poisson's own steps are 0.05).
MANY_ELECTRONS = 64.0


@dataclass(frozen=True)
class ReadOut:
    """What effects make of the read-out. `response`: mean or noisy electrons -> electrons, point by point; `noise_e2`: (mean
    electrons, their shot noise's variance) -> variance; `offset_dn` is added to the black level. Defaults: a linear one."""

    response: Callable[[FloatArray], FloatArray] | None = None
    noise_e2: Callable[[FloatArray, FloatArray], FloatArray] | None = None
    offset_dn: float = 0.0


LINEAR = ReadOut()


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

    With standardised limits a and b, density phi and distribution Phi of the normal law: E z = a Phi(a) + b (1 - Phi(b)) -
    phi(b) + phi(a), E z^2 = a^2 Phi(a) + b^2 (1 - Phi(b)) + Phi(b) - Phi(a) - b phi(b) + a phi(a). Values more than eight
    standard deviations from the limits are returned as they came.
    """
    mean, variance = np.broadcast_arrays(np.asarray(mean, float), np.asarray(variance, float))
    out_mean, out_variance = mean.copy(), variance.copy()
    s = np.sqrt(variance)
    near = (mean - 8.0 * s < lower) | (mean + 8.0 * s > upper)
    if not np.any(near):
        return out_mean, out_variance
    m, s = mean[near], np.maximum(s[near], 1e-12)
    first, second, inside = np.zeros_like(m), np.zeros_like(m), np.ones_like(m)
    for limit, side in ((lower, 1.0), (upper, -1.0)):
        if np.isfinite(limit):
            z = (limit - m) / s
            share, density = ndtr(side * z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
            first += z * share + side * density
            second += z * z * share + side * z * density
            inside -= share
    out_mean[near] = np.clip(m + s * first, lower, upper)
    out_variance[near] = np.maximum(second + inside - first * first, 0.0) * s * s
    return out_mean, out_variance


def dn_moments(
    electrons: FloatArray, camera: CameraModel, gain_db: float = 0.0, read_out: ReadOut = LINEAR
) -> tuple[FloatArray, FloatArray]:
    """Mean (DN, not rounded) and temporal variance (DN^2, with 1/12 for rounding) of pixels with mean `electrons`.

    Shot noise is Poisson; clipping at full well and by the converter is averaged over the noise with normal laws. The
    variance goes through the response by its slope.
    """
    check_electrons(electrons)
    noise = electrons if read_out.noise_e2 is None else np.maximum(read_out.noise_e2(electrons, electrons), 0.0)
    mean, variance = clipped_moments(electrons, noise, -np.inf, camera.full_well_e)
    if read_out.response is not None:
        step = 1e-3 * mean + 1e-3
        bent = read_out.response(mean)
        variance = variance * ((read_out.response(mean + step) - bent) / step) ** 2
        mean = bent
    gain = gain_dn_per_e(camera, gain_db)
    return clipped_moments(
        camera.black_level_dn + read_out.offset_dn + gain * mean,
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
    read_out: ReadOut = LINEAR,
) -> NDArray[np.uint16]:
    """One frame: codes (rows, cols) drawn around `expected_electrons` (the mean, of which `dark_electrons` are dark current).

    `fixed_pattern` None stands for pixels that are all alike. Raises ValueError for electrons below 0 or not finite, and for
    a white level beyond 16 bit.
    """
    if camera.white_level_dn > 65535:
        raise ValueError(
            f"the white level {camera.white_level_dn:g} DN is above the limit of 65535 DN of a 16-bit frame: give the converter's highest code"
        )
    electrons = np.asarray(expected_electrons, float)
    check_electrons(electrons)
    frame = np.empty(electrons.shape, np.uint16)
    rows = max(1, 32_768 // max(1, electrons.shape[-1]))  # strips that stay in the processor's cache
    for start in range(0, len(electrons), rows):
        strip = slice(start, start + rows)
        mean = electrons[strip].astype(np.float32)
        if fixed_pattern is not None:
            mean += (mean - np.float32(dark_electrons)) * fixed_pattern.prnu[strip].astype(np.float32)
            np.maximum(mean, np.float32(0.0), out=mean)
        charge = _read_charge(mean, camera, rng, read_out)
        if fixed_pattern is not None:
            charge += fixed_pattern.dsnu_e[strip].astype(np.float32)
        charge *= np.float32(gain_dn_per_e(camera, gain_db))
        charge += np.float32(camera.black_level_dn + read_out.offset_dn)
        np.rint(charge, out=charge)
        np.clip(charge, np.float32(0.0), np.float32(camera.white_level_dn), out=charge)
        frame[strip] = charge
    return frame


Float32Array = NDArray[np.float32]


def _read_charge(mean: Float32Array, camera: CameraModel, rng: np.random.Generator, read_out: ReadOut) -> Float32Array:
    """Electrons as they are read: shot noise, full well, response and read noise."""
    highest = float(np.max(mean, initial=0.0))
    plain = read_out.response is None and read_out.noise_e2 is None
    if plain and np.min(mean) >= MANY_ELECTRONS and highest + 8.0 * np.sqrt(highest) < camera.full_well_e:
        # Nothing comes between shot and read noise: one normal variable for both, with the skewness of the sum.
        return _normal_stand_in(mean, np.float32(camera.read_noise_e) ** 2, rng)
    charge = draw_electrons(mean, rng)
    if read_out.noise_e2 is not None:
        wanted = np.maximum(read_out.noise_e2(mean.astype(float), mean.astype(float)), 0.0)
        charge = (mean + (charge - mean) * np.sqrt(wanted / np.maximum(mean, 1e-12))).astype(np.float32)
    np.minimum(charge, np.float32(camera.full_well_e), out=charge)
    if read_out.response is not None:
        charge = read_out.response(charge.astype(float)).astype(np.float32)
    if camera.read_noise_e > 0:
        charge += rng.standard_normal(mean.shape, dtype=np.float32) * np.float32(camera.read_noise_e)
    return charge


def draw_electrons(mean: Float32Array, rng: np.random.Generator) -> Float32Array:
    """Poisson electrons around `mean` (>= 0); see `MANY_ELECTRONS` for how large means are drawn."""
    mean = np.asarray(mean, np.float32)
    few = mean < MANY_ELECTRONS
    if np.all(few):
        return rng.poisson(mean).astype(np.float32)
    charge = _normal_stand_in(mean, np.float32(0.0), rng)
    if np.any(few):
        charge[few] = rng.poisson(mean[few])
    return charge


def _normal_stand_in(mean: Float32Array, read_e2: np.float32, rng: np.random.Generator) -> Float32Array:
    """mean + s z + (mean / s^2) (z^2 - 1) / 6 with s^2 = mean + read noise squared: the third cumulant is the Poisson's."""
    z = rng.standard_normal(mean.shape, dtype=np.float32)
    variance = mean + read_e2
    charge = np.sqrt(variance)
    charge *= z
    charge += mean
    z *= z
    z -= np.float32(1.0)
    if read_e2 > 0:
        z *= mean / variance
    z *= np.float32(1.0 / 6.0)
    charge += z
    return charge


def check_electrons(electrons: FloatArray) -> None:
    """Raises ValueError where mean electrons aren't finite or are below 0."""
    lowest, highest = float(np.min(electrons, initial=np.inf)), float(np.max(electrons, initial=0.0))
    if not (lowest >= 0 and np.isfinite(highest)):  # a NaN fails either comparison
        bad = lowest if not lowest >= 0 else highest
        raise ValueError(
            f"mean electrons of a pixel are {bad:g} e, below the limit of 0 e or not finite: check the radiance and the effects' parameters"
        )
