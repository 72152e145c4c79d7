"""The prior of a curve by its second difference, and the most probable curve under it, within lower bounds.

The second difference of the curve has a normal prior (Tikhonov regularisation), with straight lines free and integrated
out. It is wider where the curve has curvature and is high: its local scale is the geometric mean of curvature and
height of a first solution, smoothed, plus a floor. Strength and floor maximise the marginal likelihood
(`likeliest_prior`). Lower bounds are S >= 0, and limits from saturated signals (`within_bounds`).

Priors are roots R of covariances R R^T on the wavelengths (m,)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize, special

from lab.fit.spectral.sensitivity import (
    COVERAGE_FACTOR,
    RADIOMETER_RELATIVE_STD,
    ChannelSignals,
    Sensitivity,
    light_errors,
)
from lab.formats.results import MakerDeparture
from sim.spectrum import FloatArray

LOCAL_WIDTH_NM = 10.0  # over which the local roughness is averaged
FINE_LENGTH_NM = 5.0  # correlation length of the fine structure


def averaging_matrix(wave: FloatArray) -> FloatArray:
    """Return the matrix (m, m) of Gaussian averages over `LOCAL_WIDTH_NM`."""
    distance = (wave[:, None] - wave) / LOCAL_WIDTH_NM
    average = np.exp(-0.5 * distance**2)
    average /= average.sum(axis=1, keepdims=True)
    return np.asarray(average)


def local_roughness(wave: FloatArray, curve: FloatArray, average: FloatArray) -> FloatArray | None:
    """Return the roughness (m,) of a curve, maximum 1: the geometric mean of its curvature and its height, both
    averaged by `average` (m, m). None for a straight line.

    `wave` (m,), nm; `curve` (m,).
    """
    if wave.size < 5:
        return None
    curvature = np.sqrt(average @ np.gradient(np.gradient(curve, wave), wave) ** 2)
    height = np.sqrt(average @ np.clip(curve, 0.0, None) ** 2)
    local = np.sqrt(curvature * height)
    return local / local.max() if local.max() > 0 else None


def smooth_root(wave: FloatArray, roughness: FloatArray) -> FloatArray:
    """Return the root (m, m) of curves whose second difference is white with standard deviation `roughness`, up to
    straight lines.

    `wave`, `roughness` (m,): wavelengths, nm, and standard deviations.
    """
    return np.clip(wave[:, None] - wave, 0.0, None) * (np.sqrt(np.gradient(wave)) * roughness)


def rough_root(wave: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """Return the root (m, m) of `smooth_root` with fine structure added (`fine_covariance`)."""
    smooth = smooth_root(wave, roughness)
    if fine_share == 0.0:
        return smooth
    return np.asarray(np.linalg.cholesky(smooth @ smooth.T + fine_covariance(wave, roughness, fine_share)))


def fine_covariance(wave: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """Return the covariance (m, m) of fine structure: exponential correlation over 5 nm, as high as `fine_share` of
    what the curvature amounts to over 10 nm.

    The lights hardly determine it; the uncertainty has to include it.
    """
    height = fine_share * LOCAL_WIDTH_NM**1.5 * roughness
    return np.asarray(np.outer(height, height) * np.exp(-np.abs(wave[:, None] - wave) / FINE_LENGTH_NM))


def signal_covariance(wave: FloatArray, operator: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """Return the covariance (n, n) of the signals `operator` S of curves S with the prior of `rough_root`, up to
    straight lines.

    `operator` (n, m); `roughness`, `fine_share`: see `rough_root`.
    """
    smooth = operator @ smooth_root(wave, roughness)
    covariance = smooth @ smooth.T
    if fine_share > 0.0:
        covariance = covariance + operator @ fine_covariance(wave, roughness, fine_share) @ operator.T
    return np.asarray(covariance)


def straight_lines(wave: FloatArray) -> FloatArray:
    """Return the constant and the slope, (m, 2): the curves without a second difference."""
    return np.stack([np.ones_like(wave), 2.0 * (wave - wave.mean()) / np.ptp(wave)], axis=1)


@dataclass(frozen=True, eq=False)
class CurvePrior:
    """The prior of a curve: roughness `shape` (m,) times `strength`, and `fine_share` of fine structure
    (`fine_covariance`).
    """

    shape: FloatArray
    strength: float
    fine_share: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior `mean` (m,) and `covariance` (m, m) of a curve.

    `gain` (m, n): Jacobian of the mean by the signals; `precision` (n, n): inverse covariance of the signals under the
    prior, whose curves aren't known.
    """

    mean: FloatArray
    covariance: FloatArray
    gain: FloatArray
    precision: FloatArray


def likeliest_prior(
    wave: FloatArray,
    operator: FloatArray,
    value: FloatArray,
    std: FloatArray,
    shapes: Sequence[FloatArray],
    fine_share: float = 0.0,
) -> CurvePrior:
    """Choose, of the prior roughnesses `shapes`, (m,) each, the one with the largest marginal likelihood at its best
    strength, for value = operator S + noise, straight lines free.

    `operator` (n, m), `value`, `std` (n,) of the signals; `fine_share`: see `fine_covariance`.
    """
    line = operator @ straight_lines(wave)
    misfits = [least_misfit(signal_covariance(wave, operator, s, fine_share), line, value, std) for s in shapes]
    best = min(range(len(shapes)), key=lambda i: misfits[i][0])
    return CurvePrior(shapes[best], misfits[best][1], fine_share)


def posterior_under_prior(
    wave: FloatArray, operator: FloatArray, value: FloatArray, std: FloatArray, prior: CurvePrior
) -> Posterior:
    """Return the posterior of S with value = operator S + noise under `prior`, straight lines free.

    `operator` (n, m), `value`, `std` (n,) of the signals.
    """
    line = straight_lines(wave)
    rough = rough_root(wave, prior.shape, prior.fine_share)
    rough = rough - line @ np.linalg.lstsq(line, rough, rcond=None)[0]  # straight lines are free
    # Straight lines have a normal prior a thousand times as wide as the curve is high. Singular values keep well and
    # poorly determined directions apart; differences of covariances lose digits where noise is small.
    height = float(np.max(np.abs(value / operator.sum(axis=1))))
    root = np.concatenate([1e3 * height * line, prior.strength * rough], axis=1)
    left, singular, right = np.linalg.svd(operator @ root / std[:, None], full_matrices=True)
    known = np.append(1.0 / np.sqrt(1.0 + singular**2), np.ones(right.shape[0] - singular.size))
    half = root @ right.T * known
    share = singular / (1.0 + singular**2)
    gain = (root @ right[: singular.size].T * share) @ (left[:, : singular.size] / std[:, None]).T
    unknown = left / std[:, None] / np.sqrt(1.0 + np.append(singular, np.zeros(left.shape[1] - singular.size)) ** 2)
    return Posterior(gain @ value, half @ half.T, gain, unknown @ unknown.T)


def least_misfit(covariance: FloatArray, line: FloatArray, value: FloatArray, std: FloatArray) -> tuple[float, float]:
    """Minimise the negative log marginal likelihood of value = line a + strength u + noise over the strength. Returns
    it and that strength.

    u is normal with `covariance` (n, n), a (2,) is free and integrated out. `line` (n, 2), `value`, `std` (n,).
    """
    z, h = value / std, line / std[:, None]
    rest = linalg.qr(h)[0][:, line.shape[1] :]
    eigenvalue, vector = np.linalg.eigh(rest.T @ (covariance / np.outer(std, std)) @ rest)
    eigenvalue = np.clip(eigenvalue, 0.0, None)
    power = (vector.T @ (rest.T @ z)) ** 2

    def loss(log_square: float) -> float:
        variance = np.exp(log_square) * eigenvalue + 1.0
        return 0.5 * float(np.sum(power / variance + np.log(variance)))

    start = -np.log(max(float(eigenvalue.max()), 1e-300))
    grid = start + np.linspace(-2.0, 40.0, 85)
    best = int(np.argmin([loss(g) for g in grid]))
    found = optimize.minimize_scalar(
        loss, bounds=(grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]), method="bounded"
    )
    return float(found.fun), float(np.exp(0.5 * found.x))


@dataclass(frozen=True, eq=False)
class LowerBounds:
    """operator (k, m) S >= limit (k,): positivity, and what saturated signals say."""

    operator: FloatArray
    limit: FloatArray


def within_bounds(mean: FloatArray, covariance: FloatArray, bounds: LowerBounds) -> FloatArray:
    """Find the most probable curve (m,) within bounds, of a normal distribution: an active set on its dual, S = mean +
    V G^T multiplier.

    `mean` (m,), `covariance` (m, m) of the normal distribution.
    """
    cross = covariance @ bounds.operator.T
    inner = bounds.operator @ cross
    slack = bounds.operator @ mean - bounds.limit
    ridge = 1e-9 * float(np.mean(np.diag(inner))) + 1e-300
    active = np.zeros(slack.size, bool)
    multiplier = np.zeros(slack.size)
    for _ in range(50):
        now = slack + inner @ multiplier
        worst = np.where(active, np.inf, now)
        # New bounds in batches, as neighbours are violated together; the tolerance is relative to the curve
        entering = worst < -1e-6 * float(np.max(np.abs(mean)))
        if not entering.any():
            break
        active |= entering
        while active.any():
            index = np.flatnonzero(active)
            solved = np.linalg.solve(inner[np.ix_(index, index)] + ridge * np.eye(index.size), -slack[index])
            if np.all(solved >= 0):
                break
            active[index[solved < 0]] = False
        multiplier = np.zeros(slack.size)
        if active.any():
            multiplier[active] = solved
    return np.clip(mean + cross @ multiplier, 0.0, None)


# --- The curves of the maker: as prior of all channels at once, where lights saturate, and beside the fitted curves ---


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

    own = [o * m for o, m in zip(scaled, maker, strict=True)]
    pieces = [through @ kernel_smooth @ through.T, blocks(own, kernel_smooth), blocks(scaled, local)]
    fixed = (
        COMMON_LINE_STD**2 * through @ kernel_line @ through.T
        + OWN_LINE_STD**2 * blocks(own, kernel_line)
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
    found = min(
        (
            optimize.minimize(loss, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02})
            for start in starts
        ),
        key=lambda result: float(result.fun),
    )
    weight = np.exp(2.0 * found.x)
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
        cross[:, at] += (m[:, None] * single) @ own[c].T + weight[2] * local @ scaled[c].T
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
                RADIOMETER_RELATIVE_STD
                * (linalg.cho_solve(factor, cross.T).T[:, at] / signals[c].std)
                @ errors[str(c)],
            )
        )
    return result


def compare_curves(
    wavelength_nm: FloatArray, channels: Sequence[str], value: FloatArray, covariance: FloatArray, stated: FloatArray
) -> tuple[float, tuple[MakerDeparture, ...]]:
    """Find the wavelength bands in which fitted curves differ from stated ones, up to one factor that all channels
    share.

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
