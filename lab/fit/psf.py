"""Blur kernels from a Bernoulli pattern on a screen.

Model: blurred = kernel * sharp + noise, kernel >= 0, sum 1 (`estimate_kernel`). The quadratic form of the least squares (the
Gram matrix) is built over the region where the whole kernel sees the target, so that no border is trusted and no
periodicity assumed. What the data leave open is filled by a Gaussian process of the kernel: covariance = envelope x
stationary correlation x envelope, its strength and its length chosen by evidence, its envelope from the estimate itself. The
solution is the exact optimum on the simplex, by accelerated projected gradients and then an active-set polish. Sum 1 is part
of the problem: positivity alone inflates the sum, and to normalise afterwards is no estimate any more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, ndimage

from lab.errors import NotDetermined

Array = NDArray[np.floating[Any]]

LENGTHS_PX = (0.0, 0.6, 1.0, 1.6, 2.5)  # of the prior's correlation; 0: none
STRENGTHS = (0.5, 1.0, 2.0, 4.0)  # of the prior, relative to the kernel's maximum
ROUNDS = 3  # envelope -> kernel -> envelope; more change less than 0.1 dB


@dataclass(frozen=True)
class KernelEstimate:
    """`kernel` (support, support), >= 0, sum 1, and one standard uncertainty of every value; `noise_std` of the blurred
    picture; `length_px`, `strength`: the prior that the evidence chose."""

    kernel: Array
    kernel_std: Array
    covariance: Array
    noise_std: float
    length_px: float
    strength: float


@dataclass(frozen=True)
class Normal:
    """Normal equations of blurred = kernel * sharp: `gram` (k, k), `right` (k,), `power` = blurred . blurred, `count` samples."""

    gram: Array
    right: Array
    power: float
    count: int

    def __add__(self, other: Normal) -> Normal:
        return Normal(
            self.gram + other.gram, self.right + other.right, self.power + other.power, self.count + other.count
        )


def estimate_kernel(
    sharp: ArrayLike, blurred: ArrayLike, support: int, noise_std: float | None = None
) -> KernelEstimate:
    """The kernel that blurs `sharp` into `blurred`, both (rows, cols); `support` is odd.

    blurred[r, c] = sum_ij kernel[i, j] sharp[r - i + support // 2, c - j + support // 2] + noise, on the rows and columns at
    least support // 2 from the border. `noise_std` is taken from the residual where it isn't given. Raises `NotDetermined`
    where the picture is smaller than 2 x support or holds no structure.
    """
    u, b = np.asarray(sharp, dtype=float), np.asarray(blurred, dtype=float)
    if u.shape != b.shape or u.ndim != 2:
        raise ValueError(f"sharp {u.shape} and blurred {b.shape} must be of the same two-dimensional shape")
    if support < 1 or support % 2 == 0:
        raise ValueError(f"support = {support} must be odd and positive: the kernel has a middle")
    if min(u.shape) < 2 * support:
        raise NotDetermined("psf", f"{u.shape[0]} x {u.shape[1]} px are too few for a kernel of {support} x {support}")
    return solve_kernel(normal_equations(u, b, support), support, noise_std)


def normal_equations(sharp: Array, blurred: Array, support: int) -> Normal:
    """Exact Gram matrix and right side over the region that the whole kernel sees.

    Every product of `sharp` with itself shifted is summed once over the part that all windows share and by running sums over
    the margins: O(support^2 pixels), not O(support^4 pixels).
    """
    s, h = support, support // 2
    rows, cols = sharp.shape
    tall, wide = rows - 2 * h, cols - 2 * h
    offset = float(sharp.mean())  # products of centred values: no digits lost to the mean
    u = sharp - offset
    level = float(blurred[h : rows - h, h : cols - h].mean())
    b = blurred[h : rows - h, h : cols - h] - level
    index = np.arange(s)

    def windows(product: Array) -> Array:
        """Sums over `tall` x `wide` windows that begin at every row and column 0..support-1: (support, support)."""
        by_row = np.empty((s, product.shape[1]))
        by_row[0] = product[:tall].sum(axis=0)
        by_row[1:] = by_row[0] + np.cumsum(product[tall : tall + s - 1] - product[: s - 1], axis=0)
        total = np.empty((s, s))
        total[:, 0] = by_row[:, :wide].sum(axis=1)
        total[:, 1:] = total[:, :1] + np.cumsum(by_row[:, wide : wide + s - 1] - by_row[:, : s - 1], axis=1)
        return total

    # Kernel element (i, j) sees the window that begins at (2 h - i, 2 h - j)
    gram = np.zeros((s, s, s, s))
    for di in range(s):
        for dj in range(-(s - 1) if di else 0, s):
            shifted = np.zeros_like(u)
            source = u[: rows - di, max(0, -dj) : cols - max(0, dj)]
            shifted[di:, max(0, dj) : cols - max(0, -dj)] = source
            sums = windows(u * shifted)[::-1, ::-1]  # [i, j]: window of (i, j) with that of (i + di, j + dj)
            ii, jj = np.ix_(index[: s - di], index[max(0, -dj) : s - max(0, dj)])
            part = sums[ii, jj]
            gram[ii, jj, ii + di, jj + dj] = part
            gram[ii + di, jj + dj, ii, jj] = part
    means = windows(u)[::-1, ::-1].ravel()
    right = np.empty((s, s))
    for i in range(s):
        for j in range(s):
            right[i, j] = np.vdot(u[2 * h - i : 2 * h - i + tall, 2 * h - j : 2 * h - j + wide], b)
    # Back from the centred values: sharp = u + offset, blurred = b + level, sum of b over the region 0
    count = tall * wide
    full = gram.reshape(s * s, s * s) + offset * (means[:, None] + means) + offset**2 * count
    full_right = right.ravel() + level * means + offset * level * count
    return Normal(full, full_right, float(np.vdot(b, b)) + level**2 * count, count)


def solve_kernel(normal: Normal, support: int, noise_std: float | None = None) -> KernelEstimate:
    """The kernel of given normal equations; see `estimate_kernel`."""
    size = support * support
    scale = float(np.trace(normal.gram)) / size
    spread = normal.power / normal.count - (normal.right.mean() ** 2 / max(scale, 1e-300)) / normal.count
    if not scale > 0.0 or not spread > 0.0:
        raise NotDetermined("psf", "the target shows no structure: put a Bernoulli pattern on the screen")
    first = on_simplex(normal.gram + 1e-9 * scale * np.eye(size), normal.right, np.full(size, 1.0 / size), 6)
    residual = max(normal.power - 2.0 * normal.right @ first + first @ normal.gram @ first, 0.0)
    freedom = max(normal.count - np.count_nonzero(first > 0.0), 1)
    noise = float(np.sqrt(residual / freedom)) if noise_std is None else float(noise_std)
    noise = max(noise, 1e-9 * float(np.sqrt(normal.power / normal.count)))
    information, weighted = normal.gram / noise**2, normal.right / noise**2

    kernel, at = first, (2, 1)
    for last in range(1 - ROUNDS, 1):
        prior, at = _by_evidence(information, weighted, kernel.reshape(support, support), at)
        kernel = on_simplex(information + prior.precision(), weighted, kernel, 80 if last == 0 else 6)
    posterior = prior.posterior(information)
    return KernelEstimate(
        kernel=kernel.reshape(support, support),
        kernel_std=np.sqrt(np.clip(np.diag(posterior), 0.0, None)).reshape(support, support),
        covariance=posterior,
        noise_std=noise,
        length_px=prior.length,
        strength=prior.strength,
    )


# --- the prior -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Prior:
    """k ~ N(0, strength^2 E C E): E the envelope, C a Gaussian correlation of `length` px with a share of 1e-4 of white.

    C is separable: its eigenvectors are products of those of one axis, and are applied axis by axis.
    """

    envelope: Array  # (support^2,), 1 at most
    length: float
    strength: float

    @property
    def support(self) -> int:
        return int(np.sqrt(len(self.envelope)))

    def _eigen(self) -> tuple[Array, Array]:
        """Eigenvalues (support^2,) and the eigenvectors of one axis (support, support)."""
        x = np.arange(self.support)
        if self.length <= 0.0:
            return np.ones(self.support**2), np.eye(self.support)
        power, waves = np.linalg.eigh(np.exp(-0.5 * ((x[:, None] - x) / self.length) ** 2))
        return np.clip(np.kron(power, power), 0.0, None) + 1e-4, waves

    def root(self) -> Array:
        """R with covariance R R^T."""
        power, waves = self._eigen()
        return np.asarray(self.strength * self.envelope[:, None] * np.kron(waves, waves) * np.sqrt(power))

    def precision(self) -> Array:
        """Inverse of the covariance."""
        power, waves = self._eigen()
        inverse = _along_axes(waves.T, np.diag(1.0 / power))
        envelope = self.strength * self.envelope
        return np.asarray(inverse / np.outer(envelope, envelope))

    def seen(self, information: Array) -> Array:
        """R^T information R."""
        power, waves = self._eigen()
        envelope = self.strength * self.envelope
        inner = _along_axes(waves, information * np.outer(envelope, envelope))
        return np.asarray(inner * np.sqrt(np.outer(power, power)))

    def evidence(self, information: Array, weighted: Array) -> float:
        """Log of the probability of the data under the prior, but for a constant."""
        inner = self.seen(information)
        inner[np.diag_indices_from(inner)] += 1.0
        factor = linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)
        power, waves = self._eigen()
        scaled = (self.strength * self.envelope * weighted).reshape(self.support, self.support)
        right = (waves.T @ scaled @ waves).ravel() * np.sqrt(power)
        half = linalg.solve_triangular(factor, right, lower=True, check_finite=False)
        return float(0.5 * half @ half - np.log(np.diag(factor)).sum())

    def posterior(self, information: Array) -> Array:
        """Covariance of the kernel, given the data and that the sum is 1."""
        inner = self.seen(information)
        inner[np.diag_indices_from(inner)] += 1.0
        factor = linalg.cholesky(inner, lower=True, check_finite=False)
        half = linalg.solve_triangular(factor, self.root().T, lower=True, check_finite=False)
        covariance = half.T @ half
        share = covariance.sum(axis=1)
        return np.asarray(covariance - np.outer(share, share) / share.sum())


def _along_axes(waves: Array, matrix: Array) -> Array:
    """(W x W)^T matrix (W x W)."""
    s = len(waves)
    out = np.tensordot(waves, matrix.reshape(s, s, s * s), axes=(0, 0))  # (s', s, k)
    out = np.tensordot(waves, out, axes=(0, 1)).transpose(1, 0, 2).reshape(s * s, s, s)
    out = np.tensordot(out, waves, axes=(1, 0))  # (k', s, s')
    return np.tensordot(out, waves, axes=(1, 0)).reshape(s * s, s * s)


def _envelope(kernel: Array) -> Array:
    """Local mean of the kernel, over about a pixel, with a floor; the largest is 1."""
    local = ndimage.gaussian_filter(kernel, 0.6, mode="constant")
    return np.asarray(np.maximum(local / local.max(), 5e-4).ravel())


def _by_evidence(
    information: Array, weighted: Array, kernel: Array, near: tuple[int, int]
) -> tuple[_Prior, tuple[int, int]]:
    """The prior's length and strength by evidence, uphill on their grid from `near`; the prior and where it stands."""
    envelope, top = _envelope(kernel), float(kernel.max())
    tried: dict[tuple[int, int], tuple[float, _Prior]] = {}

    def value(at: tuple[int, int]) -> float:
        if not (0 <= at[0] < len(LENGTHS_PX) and 0 <= at[1] < len(STRENGTHS)):
            return -np.inf
        if at not in tried:
            prior = _Prior(envelope, LENGTHS_PX[at[0]], STRENGTHS[at[1]] * top)
            tried[at] = prior.evidence(information, weighted), prior
        return tried[at][0]

    at = near
    while True:
        around = [(at[0] + i, at[1] + j) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        best = max(around, key=value)
        if value(best) <= value(at):
            return tried[at][1], at
        at = best


# --- the simplex -----------------------------------------------------------------------------------------------------------


def _project_on_simplex(x: Array) -> Array:
    """Nearest point with x >= 0, sum 1."""
    ordered = np.sort(x)[::-1]
    excess = (np.cumsum(ordered) - 1.0) / np.arange(1, len(x) + 1)
    return np.asarray(np.maximum(x - excess[np.flatnonzero(ordered > excess)[-1]], 0.0))


def on_simplex(quadratic: Array, linear: Array, start: Array, solves: int = 80) -> Array:
    """argmin 1/2 x Q x - c x over x >= 0, sum x = 1: projected gradients with momentum, then an exact active-set polish.

    `solves` limits the polish, each of which costs one factorisation; it ends by itself at the optimum.
    """
    scale = np.sqrt(np.diag(quadratic).mean())
    q, c = quadratic / scale**2, linear / scale**2
    vector = np.ones(len(c)) / np.sqrt(len(c))
    for _ in range(12):
        vector = q @ vector
        vector /= np.linalg.norm(vector)
    step = 1.0 / (1.05 * float(np.vdot(vector, q @ vector)))
    x = _project_on_simplex(start)
    y, momentum = x, 1.0
    for _ in range(150):
        new = _project_on_simplex(y - step * (q @ y - c))
        if (y - new) @ (new - x) > 0.0:  # restart where the momentum points uphill
            momentum = 1.0
        following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        y = new + (momentum - 1.0) / following * (new - x)
        done = np.abs(new - x).max() < 1e-9 * new.max()
        x, momentum = new, following
        if done:
            break
    return _polished(q, c, x, solves)


def _polished(q: Array, c: Array, x: Array, solves: int) -> Array:
    """Exact optimum from a nearby point: solve on the support, step back to the border, admit what the gradient wants."""
    free = x > 0.0
    for _ in range(solves):
        at = np.flatnonzero(free)
        factor = linalg.cho_factor(q[np.ix_(at, at)], check_finite=False)
        both = linalg.cho_solve(factor, np.column_stack([c[at], np.ones(len(at))]), check_finite=False)
        multiplier = (1.0 - both[:, 0].sum()) / both[:, 1].sum()
        solution = both[:, 0] + multiplier * both[:, 1]
        if solution.min() < 0.0:
            free[at[solution < 0.0]] = False
            continue
        x = np.zeros_like(x)
        x[at] = solution
        pull = c - q @ x + multiplier
        wanted = ~free & (pull > 1e-10 * np.abs(c).max())
        if not wanted.any():
            break
        # few at a time, lest they chase each other
        most = np.argsort(np.where(wanted, pull, -np.inf))[-max(1, int(wanted.sum()) // 3) :]
        free[most[wanted[most]]] = True
    return x / x.sum()
