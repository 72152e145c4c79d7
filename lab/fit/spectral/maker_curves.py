"""The curves of the maker: as prior of all channels at once, where lights saturate, and beside the fitted curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg, optimize, special

from lab.fit.spectral.curve_prior import LowerBounds, smooth_root, straight_lines, within_bounds
from lab.fit.spectral.sensitivity import (
    COVERAGE_FACTOR,
    ChannelSignals,
    Sensitivity,
    light_errors,
)
from lab.formats.results import MakerDeparture
from lab.observables.spectra.light_readings import RADIOMETER_STD
from sim.spectrum import FloatArray

COMMON_LINE_STD = 0.3  # of the factor common to the channels: a constant and a slope
OWN_LINE_STD = 0.02  # of the factor of a channel
LOCAL_LENGTH_NM = 15.0  # of the local departures

STATED_DIGITS = 1e-3  # of the maximum: precision of a stated curve


def solve_with_maker(
    wave: FloatArray, signals: Sequence[ChannelSignals], maker: Sequence[FloatArray]
) -> list[Sensitivity]:
    """Solve for the sensitivities S_c = M_c (1 + a + b_c) + d_c, with the curves M_c of the maker.

    a: common to the channels (filters in the lens, scale of the radiometer); b_c: that of a channel (a line of 2 %);
    both smooth by their second difference; d_c: small and local. The three strengths maximise the marginal likelihood
    with weak priors. `wave` (m,); `signals`, `maker` ((m,) each): in one order of the channels.
    """
    count, size = len(signals), wave.size
    offsets = np.cumsum([0, *(s.value.size for s in signals)])
    total = int(offsets[-1])
    smooth, line = smooth_root(wave, np.ones(size)), straight_lines(wave)
    smooth = smooth - line @ np.linalg.lstsq(line, smooth, rcond=None)[0]
    smooth = smooth / np.sqrt(np.mean(smooth**2) * size)  # strengths are relative deviations
    local = np.exp(-0.5 * ((wave[:, None] - wave) / LOCAL_LENGTH_NM) ** 2)
    value = np.concatenate([(s.value - s.operator @ m) / s.std for s, m in zip(signals, maker, strict=True)])
    scaled = [s.operator / s.std[:, None] for s in signals]
    through = np.concatenate([o * m for o, m in zip(scaled, maker, strict=True)])
    kernel_line, kernel_smooth = line @ line.T, smooth @ smooth.T

    def blocks(operators: Sequence[FloatArray], kernel: FloatArray) -> FloatArray:
        return linalg.block_diag(*(o @ kernel @ o.T for o in operators))

    own_of_channel = [o * m for o, m in zip(scaled, maker, strict=True)]
    pieces = [through @ kernel_smooth @ through.T, blocks(own_of_channel, kernel_smooth), blocks(scaled, local)]
    fixed = (
        COMMON_LINE_STD**2 * through @ kernel_line @ through.T
        + OWN_LINE_STD**2 * blocks(own_of_channel, kernel_line)
        + np.eye(total)
    )
    peak = max(float(m.max()) for m in maker)

    def loss(log_std: FloatArray) -> float:
        weights = np.exp(2.0 * np.asarray(log_std))
        try:
            factor = linalg.cho_factor(fixed + sum(w * p for w, p in zip(weights, pieces, strict=True)))
        except linalg.LinAlgError:
            return 1e12
        # A weak prior bounds strengths that the data don't determine
        weak = 0.5 * float(np.sum(((np.asarray(log_std) - centre) / 4.0) ** 2))
        return 0.5 * float(value @ linalg.cho_solve(factor, value)) + float(np.log(np.diag(factor[0])).sum()) + weak

    centre = np.log([0.03, 0.003, 1e-3 * peak])
    starts = [centre, centre + np.array([3.0, 0.0, 0.0])]
    maximum = min(
        (
            optimize.minimize(loss, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02})
            for start in starts
        ),
        key=lambda result: float(result.fun),
    )
    weight = np.exp(2.0 * maximum.x)
    factor = linalg.cho_factor(fixed + sum(w * p for w, p in zip(weight, pieces, strict=True)))
    common = COMMON_LINE_STD**2 * kernel_line + weight[0] * kernel_smooth
    single = OWN_LINE_STD**2 * kernel_line + weight[1] * kernel_smooth
    result = []
    errors = light_errors({str(c): s for c, s in enumerate(signals)})
    for c in range(count):
        m = maker[c]
        # Covariance of the curve with all signals, then its own
        cross = (m[:, None] * common) @ through.T
        at = slice(offsets[c], offsets[c + 1])
        cross[:, at] += (m[:, None] * single) @ own_of_channel[c].T + weight[2] * local @ scaled[c].T
        prior = np.outer(m, m) * (common + single) + weight[2] * local
        mean = m + cross @ linalg.cho_solve(factor, value)
        covariance = prior - cross @ linalg.cho_solve(factor, cross.T)
        bounds = LowerBounds(
            np.concatenate([np.eye(size), signals[c].saturated]), np.append(np.zeros(size), signals[c].limit)
        )
        result.append(
            Sensitivity(
                within_bounds(mean, covariance, bounds),
                np.sqrt(np.clip(np.diag(covariance), 0.0, None)),
                COVERAGE_FACTOR,
                covariance,
                RADIOMETER_STD * (linalg.cho_solve(factor, cross.T).T[:, at] / signals[c].std) @ errors[str(c)],
            )
        )
    return result


def compare_curves(
    wavelength_nm: FloatArray, channels: Sequence[str], value: FloatArray, covariance: FloatArray, stated: FloatArray
) -> tuple[float, tuple[MakerDeparture, ...]]:
    """Find the wavelength bands in which fitted curves differ from stated ones, up to one factor that all channels
    share.

    wavelength_nm : (m,)
    channels : their names
    value, stated : fitted and stated curves (channels x m,), channel after channel
    covariance : of `value`, without what is common to all

    The factor is the median of value / stated where `stated` is above a fifth of its maximum: bands that differ don't
    change it. Every band of neighbouring wavelengths of every channel is tested by its mean difference; the
    significance (normal, two-sided) is corrected for the number of bands. Bands are taken by significance, each apart
    from those before it, down to the level that curves which are as stated exceed in at most 1 % of fits.

    Returns the factor and the bands.

    >>> wavelength_nm = np.arange(400.0, 500.0, 10.0)
    >>> fitted = np.full(30, 0.55)
    >>> fitted[15:17] = 0.45  # G at 450 and 460 nm
    >>> factor, bands = compare_curves(wavelength_nm, ["R", "G", "B"], fitted, 0.01**2 * np.eye(30), np.full(30, 0.5))
    >>> round(factor, 3), [(band.channel, band.from_nm, band.to_nm) for band in bands]
    (1.1, [('G', 450.0, 460.0)])
    """
    high = stated > 0.2 * stated.max()
    scale = float(np.median(value[high] / stated[high]))
    # The error of the factor, as for a mean
    weight = high / (high.sum() * np.where(high, stated, 1.0))
    centre = np.eye(value.size) - np.outer(stated, weight)
    covariance_of_difference = centre @ covariance @ centre.T + (STATED_DIGITS * stated.max()) ** 2 * np.eye(value.size)
    difference = value - scale * stated
    size = wavelength_nm.size
    intervals: list[tuple[float, int, int, int]] = []
    for k in range(len(channels)):
        span = slice(k * size, (k + 1) * size)
        total = np.concatenate([[0.0], np.cumsum(difference[span])])
        square = np.zeros((size + 1, size + 1))
        square[1:, 1:] = np.cumsum(np.cumsum(covariance_of_difference[span, span], axis=0), axis=1)
        for a in range(size):
            for b in range(a + 1, size + 1):
                variance = square[b, b] - 2.0 * square[a, b] + square[a, a]
                intervals.append((abs(total[b] - total[a]) / float(np.sqrt(variance)), k, a, b))
    tests = len(intervals)
    limit = float(special.ndtri(1.0 - 0.005 / tests))
    departures: list[MakerDeparture] = []
    taken = np.zeros((len(channels), size), bool)
    for z, k, a, b in sorted(intervals, reverse=True):
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
