"""From electrons to codes: fixed patterns, shot noise, full well, read-out, conversion, quantisation.

The order, for one exposure: mean electrons (light + dark current) -> x (1 + PRNU) on the light -> shot noise
(Poisson) -> full well -> the read-out's response -> + DSNU, the columns' offsets, read noise and the rows'
noise -> x conversion gain, + black level -> round, clip to [0, white_level_dn].

Shot noise is exact at every mean. The other noises are normal, in single precision: the least step of a variable of
standard deviation 1 is 1e-7, its tail ends at 6e-8 a side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve, convolve1d
from scipy.special import ndtr, ndtri

from sim.camera import CameraModel, Cfa
from sim.sensor.margins import Margins
from sim.sensor.mosaic import planes
from sim.spectrum import FloatArray

Float32Array = NDArray[np.float32]
F = TypeVar("F", bound=np.floating[Any])


class Amplifiers(Protocol):
    """How amplifiers that read parts of a frame at the same time couple; all of whole frames (rows, cols)."""

    def couple(self, electrons: FloatArray) -> FloatArray:
        """Return what is read of signals."""

    def couple_variances(self, variance_e2: FloatArray) -> FloatArray:
        """Return the variances of what is read, of independent signals."""

    def couple_noise(self, noise_e: FloatArray) -> FloatArray:
        """Return the read noise, which is coupled or not."""


#: Variance factor of a multiplication above which it is taken as continuous: the mean is then 50 and more.
GEOMETRIC_BELOW = 1.98


@dataclass(frozen=True)
class Multiplication:
    """The random multiplication of single electrons, over its mean: a number of mean 1 and variance `excess` - 1.

    "geometric": of mean M = 1 / (2 - excess) below 2, as a chain of many stages makes of one electron; from there on
    "gamma", at 2 the exponential law of a register of high gain (Basden, Haniff and Mackay, MNRAS 345, 985, 2003).
    "gamma": of any excess, as avalanche photodiodes are described.
    """

    excess: float = 1.0
    distribution: Literal["geometric", "gamma"] = "geometric"

    @property
    def is_gamma(self) -> bool:
        """Return whether the number is drawn from a gamma distribution."""
        return self.distribution == "gamma" or self.excess > GEOMETRIC_BELOW

    @property
    def skewness(self) -> float:
        """Return E g^3 / (E g^2)^2 of the number g: 1 of none, 1.5 of an exponential one."""
        if self.is_gamma:
            return 2.0 - 1.0 / self.excess
        return 1.0 + 2.0 / self.excess - 2.0 / self.excess**2

    def draw(self, charge: Float32Array, rng: np.random.Generator) -> Float32Array:
        """Return electrons of the same shape, each multiplied, over the mean multiplication."""
        if self.is_gamma:
            spread = self.excess - 1.0
            return np.asarray(rng.gamma(np.maximum(charge, 0.0) / spread, spread), np.float32)
        number, inverse_mean = np.rint(np.maximum(charge, 0.0)), 2.0 - self.excess
        further = rng.negative_binomial(np.maximum(number, 1.0), inverse_mean)
        return np.asarray(np.where(number > 0.0, (number + further) * inverse_mean, charge), np.float32)


NO_MULTIPLICATION = Multiplication()


@dataclass(frozen=True)
class ReadOut:
    """Changes of the read-out by effects; by default a linear read-out.

    response      mean or noisy electrons -> electrons, point by point
    shot_e2       mean electrons -> variance of their shot noise
    added         (shape of the frame, generator) -> electrons that one frame's read-out adds, which broadcast to that
    shape, of mean `added_e`
                  and variance `added_e2`
    codes         DN before rounding -> DN
    neighbours    mean electrons -> correlation (5, ...) of the shot noise with each neighbour, by `NEIGHBOURS`
    processing    kernel of a filter of each colour's DN before rounding
    offset_dn     added to the black level
    gain          factor (rows, cols) on what is read of every pixel, its noise alike, before `added`
    read_kernel   kernel (odd,) along the row that makes read noise of white noise
    multiplied    how each electron is multiplied at random
    amplifiers    what coupled amplifiers read of the signals of a whole frame in electrons
    """

    response: Callable[[FloatArray], FloatArray] | None = None
    shot_e2: Callable[[FloatArray], FloatArray] | None = None
    offset_dn: float = 0.0
    added: Callable[[tuple[int, ...], np.random.Generator], FloatArray] | None = None
    added_e: FloatArray | float = 0.0
    added_e2: FloatArray | float = 0.0
    codes: Callable[[FloatArray], FloatArray] | None = None
    neighbours: Callable[[FloatArray], FloatArray] | None = None
    processing: FloatArray | None = None
    gain: FloatArray | None = None
    read_kernel: FloatArray | None = None
    multiplied: Multiplication = NO_MULTIPLICATION
    amplifiers: Amplifiers | None = None


LINEAR = ReadOut()


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """Fixed pattern of one camera: what its pixels keep from frame to frame, each part of mean 0.

    `prnu`: relative deviation of the response. `dsnu_e`: deviation of the dark signal (electrons, the same at every
    exposure). Both (rows, cols). `column_e`: offsets of the columns (cols,), or None.
    """

    prnu: FloatArray
    dsnu_e: FloatArray
    column_e: FloatArray | None = None

    @cached_property
    def single_prnu(self) -> Float32Array:
        """`prnu` in single precision, as frames are drawn."""
        return self.prnu.astype(np.float32)

    @cached_property
    def single_dsnu_e(self) -> Float32Array:
        """`dsnu_e` in single precision, as frames are drawn."""
        return self.dsnu_e.astype(np.float32)

    def surrounded(self, margins: Margins) -> FixedPattern:
        """Return the pattern of frames with margins, whose pixels are all alike."""
        column_e = None if self.column_e is None else np.pad(self.column_e, margins.lines[1])
        return FixedPattern(margins.surround(self.prnu), margins.surround(self.dsnu_e), column_e)

    @classmethod
    def draw(cls, camera: CameraModel, rng: np.random.Generator) -> Self:
        """One camera's pattern: normal, with the camera's `prnu_percent`, `dsnu_e` and `column_noise_e` as standard
        deviations."""
        shape = camera.rows, camera.cols
        return cls(
            prnu=rng.standard_normal(shape) * (camera.prnu_percent / 100.0),
            dsnu_e=rng.standard_normal(shape) * camera.dsnu_e,
            column_e=rng.standard_normal(camera.cols) * camera.column_noise_e if camera.column_noise_e > 0 else None,
        )


def dark_current_e_per_s(camera: CameraModel, temperature_c: float | None = None) -> float:
    """Mean dark current at a sensor temperature: D 2^((T - T_reference) / T_doubling). Where the temperature or the
    doubling isn't known, the stated current.
    """
    if temperature_c is None or camera.dark_current_doubling_c is None:
        return camera.dark_current_e_per_s
    doublings = (temperature_c - camera.dark_current_reference_c) / camera.dark_current_doubling_c
    return float(camera.dark_current_e_per_s * 2.0**doublings)


def gain_dn_per_e(camera: CameraModel, gain_db: float) -> float:
    """Conversion gain (DN/e) at an analogue gain: K 10^(dB / 20)."""
    return camera.conversion_gain_dn_per_e * 10.0 ** (gain_db / 20.0)


def capacity_e(camera: CameraModel, gain_db: float = 0.0) -> float:
    """Electrons at which a pixel saturates: its full well, or the converter's upper end where that comes first."""
    gain = gain_dn_per_e(camera, gain_db)
    return min(camera.full_well_e, (camera.white_level_dn - camera.black_level_dn) / gain)


def clip_moments(
    mean: FloatArray, variance: FloatArray, lower: float, upper: float, skewness: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Compute mean and variance of a variable after clipping, which is normal but for a small skewness g.

    mean, variance, skewness : arrays that broadcast; lower, upper : the limits, either may be infinite

    With standardised limits a and b, density phi and distribution function Phi of the normal distribution: E z = a
    Phi(a) + b (1 - Phi(b)) - phi(b) + phi(a), E z^2 = a^2 Phi(a) + b^2 (1 - Phi(b)) + Phi(b) - Phi(a) - b phi(b) + a
    phi(a). A density times 1 + g (z^3 - 3 z) / 6 adds, to first order in g, g (a phi(a) - b phi(b)) / 6 and g ((1 +
    a^2) phi(a) - (1 + b^2) phi(b)) / 3. Values more than eight standard deviations from the limits are returned
    unchanged.

    >>> mean, variance = clip_moments(np.zeros(1), np.ones(1), 0.0, np.inf)
    >>> round(float(mean[0]), 4), round(float(variance[0]), 4)  # 1 / sqrt(2 pi), 1/2 - 1 / (2 pi)
    (0.3989, 0.3408)
    """
    mean, variance, skewness = np.broadcast_arrays(
        np.asarray(mean, float), np.asarray(variance, float), np.asarray(skewness, float)
    )
    out_mean, out_variance = mean.copy(), variance.copy()
    s = np.sqrt(variance)
    near = (mean - 8.0 * s < lower) | (mean + 8.0 * s > upper)
    if not np.any(near):
        return out_mean, out_variance
    m, s, g = mean[near], np.maximum(s[near], 1e-12), skewness[near]
    first, second, inside = np.zeros_like(m), np.zeros_like(m), np.ones_like(m)
    for limit, side in ((lower, 1.0), (upper, -1.0)):
        if np.isfinite(limit):
            z = (limit - m) / s
            share, density = ndtr(side * z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
            first += z * share + side * density * (1.0 + g * z / 6.0)
            second += z * z * share + side * density * (z + g * (1.0 + z * z) / 3.0)
            inside -= share
    out_mean[near] = np.clip(m + s * first, lower, upper)
    out_variance[near] = np.maximum(second + inside - first * first, 0.0) * s * s
    return out_mean, out_variance


def encode_moments(
    mean: FloatArray, variance: FloatArray, highest: float, skewness: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Compute mean and variance of a variable, normal but for a small skewness, after rounding to whole numbers and
    clipping.

    mean, variance, skewness : arrays that broadcast, DN, DN^2, 1; highest : the highest code, DN, may be infinite

    With a standard deviation of 0.9 and more (1 near a limit): mean and variance of the clipped variable, and what
    rounding adds. With f the density and P the share between the limits a = 0 and b that is f(b) / 24 - f(a) / 24 to
    the mean and P / 12 + (M - a) f(a) / 12 + (b - M) f(b) / 12 to the variance (sums of the distribution function at
    half codes as integrals, by Euler and Maclaurin): 1/12 far from the limits. Narrower: far from the limits by
    `_round_moments`, near them the sum over the codes within 8. Good to 1e-3 DN at a limit and 1e-6 DN far from any.

    >>> mean, variance = encode_moments(np.array([100.0]), np.array([4.0]), 4095.0)
    >>> round(float(mean[0]), 6), round(float(variance[0]), 6)  # rounding adds 1/12
    (100.0, 4.083333)
    """
    mean, variance = np.broadcast_arrays(np.asarray(mean, float), np.asarray(variance, float))
    out_mean, out_variance = clip_moments(mean, variance, 0.0, highest, skewness)
    narrow = variance < 0.81
    wide = ~narrow
    out_variance[wide] += 1.0 / 12.0
    s = np.sqrt(variance)
    clipped = (mean - 8.0 * s < 1.0) | (mean + 8.0 * s > highest - 1.0)
    near = clipped & (variance >= 1.0)
    if np.any(near):
        m, sigma, middle = mean[near], s[near], out_mean[near]
        below, above = (0.0 - m) / sigma, (highest - m) / sigma
        density_0, density_1 = (np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * sigma) for z in (below, above))
        shift = (density_1 - density_0) / 24.0
        more = (ndtr(above) - ndtr(below) - 1.0 + middle * density_0) / 12.0
        if np.isfinite(highest):
            more += (highest - middle) * density_1 / 12.0
        out_mean[near] = middle + shift
        out_variance[near] = np.maximum(out_variance[near] + more - shift**2, 0.0)
    smooth = narrow & ~clipped & (variance > 0.1)
    if np.any(smooth):
        out_mean[smooth], out_variance[smooth] = _round_moments(mean[smooth], variance[smooth])
    summed = (narrow & ~smooth) | (clipped & (variance < 1.0))
    if np.any(summed):
        m, sigma = mean[summed], np.maximum(s[summed], 1e-9)
        nearest = np.rint(m)
        total, first, second = np.zeros_like(m), np.zeros_like(m), np.zeros_like(m)
        under = np.zeros_like(m)
        for away in range(-8, 9):
            up_to = ndtr((nearest + away + 0.5 - m) / sigma)
            code = np.clip(nearest + away, 0.0, highest) - nearest
            total += up_to - under
            first += (up_to - under) * code
            second += (up_to - under) * code * code
            under = up_to
        out_mean[summed] = nearest + first / total
        out_variance[summed] = np.maximum(second / total - (first / total) ** 2, 0.0)
    return out_mean, out_variance


def _round_moments(mean: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of a normal variable of variance 0.1 and more after rounding to whole numbers.

    With r(y) = (1 / pi) sum_k (-1)^k sin(2 pi k y) / k what rounding adds and d_k = exp(-2 pi^2 k^2 variance): E
    r = (1 / pi) sum (-1)^k d_k sin(2 pi k mean) / k; variance + 2 variance E r' + E r^2 - (E r)^2 with E r' = 2 sum
    (-1)^k d_k cos(2 pi k mean) and E r^2 = 1 / 12 + (1 / pi^2) sum (-1)^k d_k cos(2 pi k mean) / k^2. Three terms: d_4
    is 2e-14.
    """
    shift, slope, square = np.zeros_like(mean), np.zeros_like(mean), np.full_like(mean, 1.0 / 12.0)
    for k in (1, 2, 3):
        weight = (-1.0) ** k * np.exp(-2.0 * np.pi**2 * k**2 * variance)
        along, across = np.sin(2.0 * np.pi * k * mean) * weight, np.cos(2.0 * np.pi * k * mean) * weight
        shift += along / (np.pi * k)
        slope += 2.0 * across
        square += across / (np.pi * k) ** 2
    return mean + shift, variance + 2.0 * variance * slope + square - shift**2


def dn_moments(
    electrons: FloatArray,
    camera: CameraModel,
    gain_db: float = 0.0,
    read_out: ReadOut = LINEAR,
    fixed_pattern: FixedPattern | None = None,
    *,
    dark_electrons: FloatArray | float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Mean (DN, that of the rounded codes) and temporal variance (DN^2) of pixels with mean `electrons`.

    Shot noise is Poisson; clipping (at full well, or by the converter where that comes first) and rounding are averaged
    over the noise (`clip_moments`, `encode_moments`): to first order in its skewness, and not over single electrons
    that are wider than the read noise and a code. The variance goes through the response by its slope. `fixed_pattern`:
    the moments of those pixels, in place of pixels that are all alike; then `dark_electrons` of `electrons` are dark
    current.
    """
    check_electrons(electrons)
    if fixed_pattern is not None:
        electrons = np.maximum(electrons + (electrons - dark_electrons) * fixed_pattern.prnu, 0.0)
    gain = gain_dn_per_e(camera, gain_db)
    zero_dn = camera.black_level_dn + read_out.offset_dn
    full = np.array(camera.full_well_e)
    full_dn = zero_dn + gain * float(full if read_out.response is None else read_out.response(full))
    by_charge = full_dn < camera.white_level_dn
    noise = electrons if read_out.shot_e2 is None else np.maximum(read_out.shot_e2(electrons), 0.0)
    if read_out.multiplied.excess != 1.0:
        noise = noise * read_out.multiplied.excess
    mean, variance = electrons, noise
    if by_charge:
        # to DN as it is, as the full well's own noise is none: what is clipped isn't clipped again
        skewness = electrons / np.maximum(noise, 1e-12) ** 1.5
        mean, variance = clip_moments(electrons, noise, -np.inf, camera.full_well_e, np.minimum(skewness, 1.0))
    if read_out.response is not None:
        beyond = mean + (1e-3 * mean + 1e-3)
        bent = read_out.response(mean)
        variance = variance * ((read_out.response(beyond) - bent) / (beyond - mean)) ** 2  # exactly 1 of a straight one
        mean = bent
    if read_out.amplifiers is not None:
        mean, variance = read_out.amplifiers.couple(mean), read_out.amplifiers.couple_variances(variance)
    if fixed_pattern is not None:
        mean = mean + fixed_pattern.dsnu_e
        if fixed_pattern.column_e is not None:
            mean = mean + fixed_pattern.column_e
    noise_e2 = variance + camera.read_noise_e**2
    if read_out.gain is not None:
        mean, noise_e2 = mean * read_out.gain, noise_e2 * np.square(read_out.gain)
    dn = zero_dn + gain * (mean + read_out.added_e)
    noise_e2 = noise_e2 + camera.row_noise_e**2 + read_out.added_e2
    dn2 = gain**2 * noise_e2
    if read_out.codes is not None:
        dn, dn2 = _convert_moments(read_out.codes, dn, dn2)
    if read_out.processing is not None:
        dn = filter_planes(dn, read_out.processing, camera.cfa)
        dn2 = filter_planes(np.broadcast_to(dn2, dn.shape), np.square(read_out.processing), camera.cfa)
    skewness = np.minimum(electrons / np.maximum(noise_e2, 1e-12) ** 1.5, 1.0)
    return encode_moments(dn, dn2, np.inf if by_charge else camera.white_level_dn, skewness)


#: Equal parts of a normal distribution over which a converter's law is averaged.
CODE_PARTS = 24


def _convert_moments(
    codes: Callable[[FloatArray], FloatArray], dn: FloatArray, dn2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of normal levels after the converter's law, which may differ from code to code: over the
    middles of `CODE_PARTS` equal parts of the distribution.
    """
    middle = ndtri((np.arange(CODE_PARTS) + 0.5) / CODE_PARTS)
    std = np.sqrt(dn2)
    first, second = np.zeros(np.broadcast_shapes(dn.shape, std.shape)), np.zeros(())
    for z in middle / middle.std():
        away = codes(dn + std * z) - dn
        first = first + away / CODE_PARTS
        second = second + np.square(away) / CODE_PARTS
    return dn + first, np.maximum(second - np.square(first), 0.0)


def sample_from(
    expected_electrons: FloatArray,
    camera: CameraModel,
    rng: np.random.Generator,
    fixed_pattern: FixedPattern | None = None,
    *,
    dark_electrons: FloatArray | float = 0.0,
    gain_db: float = 0.0,
    read_out: ReadOut = LINEAR,
) -> NDArray[np.uint16]:
    """One frame: codes (rows, cols) drawn around `expected_electrons` (the mean, of which `dark_electrons` are dark
    current).

    `fixed_pattern` None stands for pixels that are all alike. Raises ValueError for electrons below 0 or not finite,
    and for a white level beyond 16 bit.
    """
    if camera.white_level_dn > 65535:
        raise ValueError(
            f"the white level {camera.white_level_dn:g} DN is above the limit of 65535 DN of a 16-bit frame: give the "
            "converter's highest code"
        )
    electrons = np.asarray(expected_electrons, float)
    check_electrons(electrons)
    frame = np.empty(electrons.shape, np.uint16)
    dark = np.broadcast_to(np.asarray(dark_electrons, np.float32), electrons.shape)
    added = _draw_added_electrons(electrons.shape, camera, rng, read_out)
    gain = np.float32(gain_dn_per_e(camera, gain_db))
    rows = max(1, 32_768 // max(1, electrons.shape[-1]))  # strips that stay in the processor's cache
    if read_out.neighbours is not None or read_out.processing is not None or read_out.amplifiers is not None:
        rows = len(electrons)  # pixels act on one another
    for start in range(0, len(electrons), rows):
        strip = slice(start, start + rows)
        mean = electrons[strip].astype(np.float32)
        if fixed_pattern is not None:
            mean += (mean - dark[strip]) * fixed_pattern.single_prnu[strip]
            np.maximum(mean, np.float32(0.0), out=mean)
        charge = _read_charge(mean, camera, rng, read_out)
        if fixed_pattern is not None:
            charge += fixed_pattern.single_dsnu_e[strip]
            if fixed_pattern.column_e is not None:
                charge += fixed_pattern.column_e.astype(np.float32)
        if read_out.gain is not None:
            charge *= read_out.gain[strip].astype(np.float32)
        if added is not None:
            charge += added[strip]
        charge *= gain
        charge += np.float32(camera.black_level_dn + read_out.offset_dn)
        if read_out.codes is not None:
            charge = read_out.codes(charge.astype(float)).astype(np.float32)
        if read_out.processing is not None:
            charge = filter_planes(charge, read_out.processing, camera.cfa)
        np.rint(charge, out=charge)
        np.clip(charge, np.float32(0.0), np.float32(camera.white_level_dn), out=charge)
        frame[strip] = charge
    return frame


def _draw_added_electrons(
    shape: tuple[int, ...], camera: CameraModel, rng: np.random.Generator, read_out: ReadOut
) -> Float32Array | None:
    """Electrons that one frame's read-out adds besides every pixel's own read noise: row noise, and noise of
    effects.
    """
    total: FloatArray | None = None
    if camera.row_noise_e > 0:
        total = rng.standard_normal((*shape[:-1], 1)) * camera.row_noise_e
    if read_out.added is not None:
        more = read_out.added(shape, rng)
        total = more if total is None else total + more
    return None if total is None else np.broadcast_to(total.astype(np.float32), shape)


def _read_charge(mean: Float32Array, camera: CameraModel, rng: np.random.Generator, read_out: ReadOut) -> Float32Array:
    """Electrons after shot noise, full well, response and read noise."""
    charge = draw_electrons(mean, rng)
    if read_out.shot_e2 is not None:
        wanted = np.maximum(read_out.shot_e2(mean.astype(float)), 0.0)
        charge = (mean + (charge - mean) * np.sqrt(wanted / np.maximum(mean, 1e-12))).astype(np.float32)
    if read_out.neighbours is not None:
        shares = interpolate_passed_shares(read_out.neighbours, mean.astype(float))
        charge = (mean + share_departures(charge - mean, mean, shares)).astype(np.float32)
    np.minimum(charge, np.float32(camera.full_well_e), out=charge)
    if read_out.multiplied.excess != 1.0:
        charge = read_out.multiplied.draw(charge, rng)
    if read_out.response is not None:
        charge = read_out.response(charge.astype(float)).astype(np.float32)
    if read_out.amplifiers is not None:
        charge = read_out.amplifiers.couple(charge.astype(float)).astype(np.float32)
    if camera.read_noise_e > 0:
        noise = rng.standard_normal(mean.shape, dtype=np.float32)
        noise *= np.float32(camera.read_noise_e)
        if read_out.read_kernel is not None:
            noise = convolve1d(noise, read_out.read_kernel, axis=-1, mode="wrap")
        if read_out.amplifiers is not None:
            noise = read_out.amplifiers.couple_noise(noise.astype(float)).astype(np.float32)
        charge += noise
    return charge


#: The neighbours with which a pixel may share noise, (rows down, columns to the right), by kind: the next ones in its
#: row and its column, those across corners, the second ones in its row and its column.
NEIGHBOURS: tuple[tuple[tuple[int, int], ...], ...] = (
    ((0, 1), (0, -1)),
    ((1, 0), (-1, 0)),
    ((1, 1), (1, -1), (-1, 1), (-1, -1)),
    ((0, 2), (0, -2)),
    ((2, 0), (-2, 0)),
)
#: Steps by which shares follow from correlations: each takes the error down by about a correlation's size.
SHARE_STEPS = 12
#: Levels at which shares are solved for a frame; between them they are interpolated.
SHARE_LEVELS = 65


def _products() -> tuple[tuple[tuple[int, int], ...], ...]:
    """For each kind of neighbour, the pairs of kinds whose shares' product adds to its covariance, one pair for each
    pair of places; the pixel itself isn't among them."""
    places = [(kind, place) for kind, every in enumerate(NEIGHBOURS) for place in every]
    pairs_of_kind = []
    for first, *_ in NEIGHBOURS:
        pairs_of_kind.append(
            tuple(
                (this, other)
                for this, (down, right) in places
                for other, (below, beyond) in places
                if (down - below, right - beyond) == first
            )
        )
    return tuple(pairs_of_kind)


_PRODUCTS = _products()


def solve_passed_share(correlation: FloatArray) -> FloatArray:
    """Shares g (5, ...) of each neighbour's deviation that a pixel takes over, by `NEIGHBOURS`, given the correlations
    r (5, ...) that result between equal pixels: r = (2 g + sum g_a g_b) / n, where n = 1 + sum of all squares, and the
    sum is over the neighbours a and b that lie as far apart as the two pixels. Solved by fixed-point steps.
    """
    r = np.clip(np.asarray(correlation, float), -0.49, 0.49)
    if not r.any():
        return np.zeros(r.shape)
    counts = [len(places) for places in NEIGHBOURS]
    g = 0.5 * r
    for _ in range(SHARE_STEPS):
        squares = sum((m * np.square(shares) for m, shares in zip(counts, g, strict=True)), np.ones(r.shape[1:]))
        mixed = [sum((g[a] * g[b] for a, b in pairs), np.zeros(r.shape[1:])) for pairs in _PRODUCTS]
        g = 0.5 * (r * squares - np.array(mixed))
    return np.asarray(g)


def interpolate_passed_shares(correlation: Callable[[FloatArray], FloatArray], mean: FloatArray) -> FloatArray:
    """Return the shares (5, rows, cols) of `solve_passed_share` in a frame of `mean` electrons (rows, cols).

    correlation : mean electrons (...) -> correlations (5, ...), linear between `SHARE_LEVELS` levels
    """
    levels = np.linspace(0.0, max(float(np.max(mean, initial=0.0)), 1.0), SHARE_LEVELS)
    shares = solve_passed_share(correlation(levels))
    return np.array([np.interp(mean, levels, of_kind) for of_kind in shares])


def share_departures(departure: NDArray[F], mean: NDArray[F], shares: FloatArray) -> FloatArray:
    """Deviations (rows, cols) of Poisson variables of given means after every pixel has taken over a share of its
    neighbours', with unchanged variances: d_i + sum g_i d_j, over sqrt(1 + sum g_i^2 v_j / v_i). `shares` (5, rows,
    cols): of each neighbour, by `NEIGHBOURS`."""
    taken, spread = np.asarray(departure, float), np.ones(departure.shape)
    for share, places in zip(shares, NEIGHBOURS, strict=True):
        if not np.any(share):
            continue
        reach = max(abs(step) for place in places for step in place)
        kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
        for down, right in places:
            kernel[reach + down, reach + right] = 1.0
        taken = taken + share * convolve(departure, kernel, mode="mirror")
        around = convolve(np.asarray(mean, float), kernel, mode="mirror")
        spread = spread + np.square(share) * around / np.maximum(mean, 1e-12)
    return np.asarray(taken / np.sqrt(spread))


def filter_planes(frame: NDArray[F], kernel: FloatArray, cfa: Cfa) -> NDArray[F]:
    """Each colour's plane of a frame (rows, cols) convolved with one kernel; mirrored about the outermost pixels."""
    out = np.array(frame)
    for plane in planes(out, cfa).values():
        plane[...] = convolve(plane, kernel, mode="mirror")
    return out


def draw_electrons(mean: Float32Array, rng: np.random.Generator) -> Float32Array:
    """Poisson electrons around `mean` (>= 0), exact at every mean."""
    from sim.sensor.shot import draw_poisson  # here, as numba takes a second to import

    return draw_poisson(mean, rng)


def check_electrons(electrons: FloatArray) -> None:
    """Raises ValueError where mean electrons aren't finite or are below 0."""
    lowest, highest = float(np.min(electrons, initial=np.inf)), float(np.max(electrons, initial=0.0))
    if not (lowest >= 0 and np.isfinite(highest)):  # a NaN fails either comparison
        bad = lowest if not lowest >= 0 else highest
        raise ValueError(
            f"mean electrons of a pixel are {bad:g} e, below the limit of 0 e or not finite: check the radiance and "
            "the effects' parameters"
        )
