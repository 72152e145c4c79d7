"""The kernel between a target and a blurred picture of it: blurred = kernel * sharp + noise, kernel >= 0, sum 1.

In the order of the file:

- the normal equations of the least squares (`normal_equations`), over the region in which the whole kernel sees the
  target. No border is used and no periodicity is assumed;
- the exact optimum under kernel >= 0, sum 1 (`on_simplex`). The sum belongs to the problem: positivity alone biases it
  upwards, and a normalisation afterwards does not correct that;
- the prior of the kernel (`KernelPrior`), a Gaussian process with covariance envelope x stationary correlation x
  envelope. Its strength and length maximise the marginal likelihood, and its envelope comes from the estimate itself;
- these three together, with the covariance (`solve_kernel`);
- where a drawn target lies against a blurred picture of it: a smooth displacement, or none, by marginal likelihood
  (`displacement`);
- `estimate_kernel`, which registers a target that was drawn a little off its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, ndimage

from lab.errors import NotDetermined
from lab.one_blas_thread import one_blas_thread

Array = NDArray[np.floating[Any]]

BRIEF_SOLVES, MOST_SOLVES = 4, 80  # factorisations of the active-set step: for an intermediate kernel, for the last one
PATIENCE = 3  # exchanges without gain

PRIOR_LENGTHS_PX = (0.0, 0.6, 1.0, 1.6, 2.5)  # of the correlation; 0: white
PRIOR_STRENGTHS = (0.25, 0.5, 1.0, 2.0, 4.0)  # relative to the maximum of the kernel

OUTSIDE_STD = 0.1  # of the prior of the share of light from beyond the support
ROUNDS = 3  # of envelope and kernel in turn; more change less than 0.1 dB

GRID_PX = 11.0  # spacing of the nodes
NODE_STD_PX = 0.5  # of the displacement of a node
NODE_CURVATURES_PX = (0.02, 0.1, 0.5)  # second differences between nodes; chosen by marginal likelihood
LEAST_LOG_BAYES_FACTOR = 3.0  # for a displacement against none

DISPLACEMENT_STEPS = 3


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of blurred = kernel * sharp: `gram` (k, k), `right` (k,), `power` = sum of blurred^2, `count`
    samples.
    """

    gram: Array
    right: Array
    power: float
    count: int

    def __add__(self, added: NormalEquations) -> NormalEquations:
        return NormalEquations(
            self.gram + added.gram, self.right + added.right, self.power + added.power, self.count + added.count
        )


def normal_equations(sharp: Array, blurred: Array, support: int) -> NormalEquations:
    """Sum the exact normal equations over the pixels for which the whole kernel sees `sharp`.

    sharp, blurred : (rows, cols)
    support : rows and columns of the kernel, odd

    The sums over the windows of all elements are those over the window of the last element, updated by the rows and
    columns that enter and leave: O(support^2 pixels) instead of O(support^4 pixels).

    >>> sharp = np.random.default_rng(1).random((12, 14))
    >>> equations = normal_equations(sharp, sharp, 3)
    >>> bool(np.allclose(np.linalg.solve(equations.gram, equations.right), [0, 0, 0, 0, 1, 0, 0, 0, 0]))
    True
    """
    s, h = support, support // 2
    rows, cols = sharp.shape
    tall, wide = rows - 2 * h, cols - 2 * h
    offset = float(sharp.mean())  # centred values: no digits are lost to the mean
    u = sharp - offset
    padded = np.pad(u, ((s - 1, 0), (s - 1, s - 1)))
    i, j = np.arange(s)[:, None, None], np.arange(s)[:, None]
    gram = np.zeros((s, s, s, s))
    for down in range(s):
        # Element (i, j) sees the window that begins at (2 h - i, 2 h - j), element (i + down, j') the one `down` rows
        # above
        sums = _sum_lagged(u, padded[s - 1 - down : s - 1 - down + rows], tall, wide)
        part = sums[s - 1 - i[: s - down], s - 1 - j, s - 1 + j - j.T]
        at = np.arange(s - down)
        gram[at, :, at + down, :] = part
        gram[at + down, :, at, :] = part.transpose(0, 2, 1)
    means = _window_sums(u, tall, wide)[::-1, ::-1].ravel()
    # Back from the centred values: sharp = u + offset
    count = tall * wide
    full = gram.reshape(s * s, s * s) + offset * (means[:, None] + means) + offset**2 * count
    return NormalEquations(full, *normal_equations_right(sharp, blurred, support), count)


def _window_sums(picture: Array, tall: int, wide: int) -> Array:
    """Sum a picture (rows, cols) over all its windows of `tall` x `wide`: (s, s), s = rows - tall + 1."""
    cumulative = np.pad(picture.cumsum(axis=0), ((1, 0), (0, 0)))
    by_row = np.pad((cumulative[tall:] - cumulative[: len(cumulative) - tall]).cumsum(axis=1), ((0, 0), (1, 0)))
    return np.asarray(by_row[:, wide:] - by_row[:, : by_row.shape[1] - wide])


def _sum_lagged(u: Array, v: Array, tall: int, wide: int) -> Array:
    """Sum u[r, c] v[r, c + lag] over the windows of `tall` x `wide` that begin at (row, col): (s, s, 2 s - 1).

    `u` (rows, cols), `v` (rows, cols + 2 s - 2), s = cols - wide + 1. Over the first window by matrix products of
    blocks of columns, of which the diagonals are the lags; over the others by what their rows and columns add and leave
    out.
    """
    cols = u.shape[1]
    s = cols - wide + 1
    lags = 2 * s - 1
    by_column = np.empty((cols, lags))  # over the first `tall` rows
    for first in range(0, cols, 2 * s):
        last = min(first + 2 * s, cols)
        products = u[:tall, first:last].T @ v[:tall, first : last + lags - 1]
        row, item = products.strides
        by_column[first:last] = np.lib.stride_tricks.as_strided(products, (last - first, lags), (row + item, item))
    views = np.lib.stride_tricks.sliding_window_view(v, lags, axis=1)  # (rows, cols, lags)
    enters, leaves = np.arange(tall, tall + s - 1), np.arange(s - 1)
    # Down the rows: over the first `wide` columns together, and each column that a window further right leaves out or
    # adds
    within = np.empty((s, lags))
    within[0] = by_column[:wide].sum(axis=0)
    row_sums = _row_products(u[:, :wide], v[:, : wide + lags - 1], np.concatenate([enters, leaves]))
    within[1:] = within[0] + np.cumsum(row_sums[: s - 1] - row_sums[s - 1 :], axis=0)
    change = np.empty((s, s - 1, lags))  # of a window one further right
    change[0] = by_column[wide:] - by_column[: s - 1]
    right, left = slice(wide, None), slice(None, s - 1)
    added = [u[rows, at, None] * views[rows, at] for rows in (enters, leaves) for at in (right, left)]
    change[1:] = change[0] + np.cumsum(added[0] - added[1] - added[2] + added[3], axis=0)
    out = np.empty((s, s, lags))
    out[:, 0] = within
    out[:, 1:] = within[:, None] + np.cumsum(change, axis=1)
    return out


def _row_products(u: Array, v: Array, rows: NDArray[np.int64]) -> Array:
    """Sum u[r, c] v[r, c + lag] over the columns, for chosen `rows`: (rows, lags)."""
    views = np.lib.stride_tricks.sliding_window_view(v, u.shape[1], axis=1)  # (rows, lags, cols)
    return np.array([views[r] @ u[r] for r in rows]).reshape(len(rows), views.shape[1])


def normal_equations_right(sharp: Array, blurred: Array, support: int) -> tuple[Array, float]:
    """Sum the parts of the normal equations that depend on `blurred`.

    sharp, blurred : (rows, cols)
    support : rows and columns of the kernel, odd

    Returns the right side (support^2,) and the power.

    >>> sharp = np.random.default_rng(1).random((12, 14))
    >>> right, power = normal_equations_right(sharp, sharp, 3)
    >>> bool(np.isclose(right[4], power)), bool(np.isclose(power, np.sum(sharp[1:-1, 1:-1] ** 2)))
    (True, True)
    """
    s, h = support, support // 2
    tall, wide = sharp.shape[0] - 2 * h, sharp.shape[1] - 2 * h
    seen = blurred[h : h + tall, h : h + wide]
    offset, level = float(sharp.mean()), float(seen.mean())
    u, b = sharp - offset, seen - level
    right = np.empty((s, s))
    for i in range(s):
        for j in range(s):
            part = u[2 * h - i : 2 * h - i + tall, 2 * h - j : 2 * h - j + wide]
            right[i, j] = np.vdot(part, b) + level * part.sum()
    # blurred = b + level, sum of b over the region 0
    return right.ravel() + offset * level * tall * wide, float(np.vdot(b, b)) + level**2 * tall * wide


def on_simplex(quadratic: Array, linear: Array, start: Array, solves: int = MOST_SOLVES) -> Array:
    """Minimise 1/2 x^T Q x - c^T x over x >= 0, sum x = 1.

    quadratic : Q (n, n), positive definite
    linear : c (n,)
    start : x to begin with, (n,)
    solves : limit of the active-set step, each iteration of which costs one factorisation; it ends by itself at the
        optimum

    Returns x (n,). Accelerated projected gradients with restarts (O'Donoghue and Candes 2015), then an exact active-set
    step.

    >>> on_simplex(np.eye(3), np.array([0.9, 0.3, -1.0]), np.full(3, 1.0 / 3.0)).round(6).tolist()
    [0.8, 0.2, 0.0]
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
        if (y - new) @ (new - x) > 0.0:  # the momentum points uphill: restart
            momentum = 1.0
        following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        y = new + (momentum - 1.0) / following * (new - x)
        done = np.abs(new - x).max() < 1e-9 * new.max()
        x, momentum = new, following
        if done:
            break
    return _polish(q, c, x, solves)


def _project_on_simplex(x: Array) -> Array:
    """Project on x >= 0, sum x = 1: the nearest point."""
    ordered = np.sort(x)[::-1]
    excess = (np.cumsum(ordered) - 1.0) / np.arange(1, len(x) + 1)
    return np.asarray(np.maximum(x - excess[np.flatnonzero(ordered > excess)[-1]], 0.0))


def _polish(q: Array, c: Array, x: Array, solves: int) -> Array:
    """Find the exact optimum from a nearby point by block principal pivoting (Portugal, Judice and Vicente 1994).

    Solve on the support, then exchange all elements that violate the optimality conditions. Where this stops to gain,
    exchange only the last of them, which terminates.
    """
    free = x > 0.0
    fewest, patience = len(c) + 1, PATIENCE
    tolerance = 1e-10 * np.abs(c).max()
    for _ in range(solves):
        at = np.flatnonzero(free)
        factor = linalg.cho_factor(q[np.ix_(at, at)], check_finite=False)
        both = linalg.cho_solve(factor, np.column_stack([c[at], np.ones(len(at))]), check_finite=False)
        multiplier = (1.0 - both[:, 0].sum()) / both[:, 1].sum()
        solution = np.zeros_like(x)
        solution[at] = both[:, 0] + multiplier * both[:, 1]
        gradient = c - q[:, at] @ solution[at] + multiplier
        violated = np.flatnonzero((free & (solution < 0.0)) | (~free & (gradient > tolerance)))
        x = solution
        if not len(violated):
            break
        if len(violated) < fewest:
            fewest, patience = len(violated), PATIENCE
        elif patience > 0:
            patience -= 1
        else:
            violated = violated[-1:]
        free[violated] = ~free[violated]
    x = np.maximum(x, 0.0)
    return np.asarray(x / x.sum())


@dataclass(frozen=True)
class KernelPrior:
    """k ~ N(0, strength^2 E C E) for the elements of a kernel (support, support), row by row.

    E = diag(`envelope`), (support^2,), at most 1. C: Gaussian correlation of `length` px plus 1e-4 of white noise. C
    is separable: its eigenvectors are products of those of one axis, and are applied axis by axis.
    """

    envelope: Array  # (support^2,), 1 at most
    length: float
    strength: float

    @property
    def support(self) -> int:
        """Return the width of the kernel."""
        return int(np.sqrt(len(self.envelope)))

    def _eigen(self) -> tuple[Array, Array]:
        """Return the eigenvalues (support^2,) and the eigenvectors of one axis (support, support)."""
        x = np.arange(self.support)
        if self.length <= 0.0:
            return np.ones(self.support**2), np.eye(self.support)
        power, vectors = np.linalg.eigh(np.exp(-0.5 * ((x[:, None] - x) / self.length) ** 2))
        return np.clip(np.kron(power, power), 0.0, None) + 1e-4, vectors

    def precision(self) -> Array:
        """Return the inverse of the covariance, (k, k)."""
        power, vectors = self._eigen()
        inverse = _both_axes(vectors.T, np.diag(1.0 / power))
        envelope = self.strength * self.envelope
        return np.asarray(inverse / np.outer(envelope, envelope))

    def whiten(self, information: Array) -> Array:
        """Whiten the information of the data: R^T information R, (k, k), where covariance = R R^T."""
        power, vectors = self._eigen()
        envelope = self.strength * self.envelope
        inner = _both_axes(vectors, information * np.outer(envelope, envelope))
        return np.asarray(inner * np.sqrt(np.outer(power, power)))

    def whiten_right(self, weighted: Array) -> Array:
        """Whiten the right side of the normal equations: R^T weighted, (k,)."""
        power, vectors = self._eigen()
        scaled = (self.strength * self.envelope * weighted).reshape(self.support, self.support)
        return np.asarray((vectors.T @ scaled @ vectors).ravel() * np.sqrt(power))

    def posterior(self, information: Array) -> Array:
        """Return the covariance (k, k) of the kernel, given the data and that its sum is 1."""
        factor = _cholesky_of_one_more(self.whiten(information))
        lower, failed = linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)
        if failed:
            raise linalg.LinAlgError("the information of a kernel isn't positive definite")
        inverse = np.tril(lower) + np.tril(lower, -1).T
        power, vectors = self._eigen()
        envelope = self.strength * self.envelope
        covariance = _both_axes(vectors.T, inverse * np.sqrt(np.outer(power, power))) * np.outer(envelope, envelope)
        share = covariance.sum(axis=1)
        return np.asarray(covariance - np.outer(share, share) / share.sum())


def log_likelihood(inner: Array, right: Array) -> float:
    """Return the log marginal likelihood of the data under a prior, up to a constant, from R^T information R
    (overwritten) and R^T weighted.

    `inner` (k, k), `right` (k,): see `KernelPrior.whiten`, `KernelPrior.whiten_right`.
    """
    factor = _cholesky_of_one_more(inner)
    half = linalg.solve_triangular(factor, right, lower=True, check_finite=False)
    return float(0.5 * half @ half - np.log(np.diag(factor)).sum())


def _cholesky_of_one_more(matrix: Array) -> Array:
    """Return the lower triangular root of `matrix` + 1, (k, k) and symmetric, which is overwritten; above it stands
    anything.
    """
    matrix.flat[:: len(matrix) + 1] += 1.0
    # LAPACK's columns are the rows of a symmetric matrix: nothing is copied
    factor, failed = linalg.lapack.dpotrf(matrix.T, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise linalg.LinAlgError("the information of a kernel isn't positive definite")
    return np.asarray(factor)


def _both_axes(vectors: Array, matrix: Array) -> Array:
    """Multiply a symmetric `matrix` from both sides: (W x W)^T matrix (W x W), x the Kronecker product.

    `vectors` W (s, s), `matrix` (s^2, s^2).
    """
    s = len(vectors)
    half = (vectors.T @ matrix.reshape(-1, s, s) @ vectors).reshape(matrix.shape)  # matrix (W x W)
    return np.asarray((vectors.T @ half.T.reshape(-1, s, s) @ vectors).reshape(matrix.shape))


def envelope_of(kernel: Array) -> Array:
    """Return the local mean of a kernel over about a pixel, at least 5e-4 of its maximum; the largest is 1.

    kernel : (support, support)

    Returns (support^2,).

    >>> float(envelope_of(np.pad([[1.0]], 2)).reshape(5, 5)[2, 2])
    1.0
    """
    local = ndimage.gaussian_filter(kernel, 0.6, mode="constant")
    return np.asarray(np.maximum(local / local.max(), 5e-4).ravel())


def find_most_likely_prior(
    information: Array, weighted: Array, kernel: Array, start: tuple[int, int]
) -> tuple[KernelPrior, tuple[int, int]]:
    """Find the prior whose length and strength maximise the marginal likelihood, by coordinate ascent on their grid
    from the index `start`.

    `information` (k, k), `weighted` (k,): normal equations over the noise variance; `kernel`: the current estimate,
    for envelope and scale. Returns the prior and its index.
    """
    envelope, top = envelope_of(kernel), float(kernel.max())
    tried: dict[tuple[int, int], tuple[float, KernelPrior]] = {}
    unit_problem: dict[int, tuple[Array, Array]] = {}  # by length: the strength only scales it

    def likelihood(at: tuple[int, int]) -> float:
        """Return the log marginal likelihood at an index of the grid; minus infinity beside it."""
        if not (0 <= at[0] < len(PRIOR_LENGTHS_PX) and 0 <= at[1] < len(PRIOR_STRENGTHS)):
            return -np.inf
        if at not in tried:
            if at[0] not in unit_problem:
                unit = KernelPrior(envelope, PRIOR_LENGTHS_PX[at[0]], 1.0)
                unit_problem[at[0]] = unit.whiten(information), unit.whiten_right(weighted)
            prior = KernelPrior(envelope, PRIOR_LENGTHS_PX[at[0]], PRIOR_STRENGTHS[at[1]] * top)
            inner, right = unit_problem[at[0]]
            tried[at] = log_likelihood(inner * prior.strength**2, right * prior.strength), prior
        return tried[at][0]

    at = start
    while True:
        neighbours = [(at[0] + i, at[1] + j) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        best = max(neighbours, key=likelihood)
        if likelihood(best) <= likelihood(at):
            return tried[at][1], at
        at = best


@dataclass(frozen=True)
class KernelEstimate:
    """A kernel and its uncertainty.

    `kernel` (support, support), >= 0, sum 1; `kernel_std` its standard deviation; `covariance` (k, k) over the
    elements, row by row. `noise_std`: of the blurred picture. `length_px`, `strength`: the prior of largest marginal
    likelihood. `outside`: share of the light from beyond the support. `information`, `precision`: the contributions of
    the data and of the prior to the quadratic form that was minimised.
    """

    kernel: Array
    kernel_std: Array
    covariance: Array
    noise_std: float
    length_px: float
    strength: float
    outside: float
    information: Array
    precision: Array


def solve_kernel(
    normal: NormalEquations,
    support: int,
    noise_std: float | None = None,
    *,
    outside: bool = False,
    rounds: int = ROUNDS,
    prior_of: KernelEstimate | None = None,
    start_from: KernelEstimate | None = None,
    solves: int = MOST_SOLVES,
) -> KernelEstimate:
    """Solve for the kernel (support, support) of given normal equations; see `estimate_kernel`.

    With `outside` the last element of the normal equations is the light from beyond the support, which is part of the
    sum. The prior maximises the marginal likelihood over `rounds` of envelope and kernel in turn; or it is that of the
    estimate `prior_of`, with its noise. `start_from`: an estimate from which the search begins. `solves`: see
    `on_simplex`. Raises `NotDetermined` for a target without structure, ValueError where the number of elements does
    not fit.
    """
    size, total = support * support, len(normal.right)
    if total != size + outside:
        raise ValueError(f"normal equations of {total} elements don't fit a support of {support} x {support}")
    scale = float(np.trace(normal.gram)) / total
    contrast = normal.power / normal.count - (normal.right.mean() ** 2 / max(scale, 1e-300)) / normal.count
    if not scale > 0.0 or not contrast > 0.0:
        raise NotDetermined("psf", "the target shows no structure: put a Bernoulli pattern on the screen")
    given = prior_of or start_from
    if given is None:
        flat = np.full(total, 1.0 / total)
        solution = on_simplex(normal.gram + 1e-9 * scale * np.eye(total), normal.right, flat, 6)
    else:
        solution = np.append(given.kernel.ravel() * (1.0 - given.outside), [given.outside] * outside)
    residual = max(
        normal.power - 2.0 * float(np.vdot(normal.right, solution)) + float(np.vdot(solution, normal.gram @ solution)),
        0.0,
    )
    freedom = max(normal.count - int(np.count_nonzero(solution > 0.0)), 1)
    if noise_std is None and prior_of is not None:
        noise_std = prior_of.noise_std
    noise = float(np.sqrt(residual / freedom)) if noise_std is None else float(noise_std)
    noise = max(noise, 1e-9 * float(np.sqrt(normal.power / normal.count)))
    information, weighted = normal.gram / noise**2, normal.right / noise**2

    # The likelihood of the kernel alone: the light from beyond is integrated out
    reduced, reduced_right = information[:size, :size], weighted[:size]
    if outside:
        elimination = information[:size, size] / (information[size, size] + OUTSIDE_STD**-2)
        reduced, reduced_right = (
            reduced - np.outer(elimination, information[:size, size]),
            reduced_right - elimination * weighted[size],
        )
    precision = np.zeros_like(information)
    if outside:
        precision[size, size] = OUTSIDE_STD**-2
    at = (2, 1)
    for last in range(1 - rounds if prior_of is None else 1, 1):
        prior, at = find_most_likely_prior(reduced, reduced_right, solution[:size].reshape(support, support), at)
        precision[:size, :size] = prior.precision()
        solution = on_simplex(information + precision, weighted, solution, solves if last == 0 else 3)
    if prior_of is not None:
        prior, precision = (
            KernelPrior(envelope_of(prior_of.kernel), prior_of.length_px, prior_of.strength),
            prior_of.precision,
        )
        solution = on_simplex(information + precision, weighted, solution, solves)
    share = float(solution[:size].sum())
    posterior = prior.posterior(reduced) / share**2
    return KernelEstimate(
        kernel=solution[:size].reshape(support, support) / share,
        kernel_std=np.sqrt(np.clip(np.diag(posterior), 0.0, None)).reshape(support, support),
        covariance=posterior,
        noise_std=noise,
        length_px=prior.length,
        strength=prior.strength,
        outside=1.0 - share if outside else 0.0,
        information=information,
        precision=precision,
    )


def displace(picture: Array, field: Array) -> Array:
    """Read `picture` at each pixel's place plus `field`, by splines of order 5.

    picture : (rows, cols)
    field : displacement in rows and in columns, (2, rows, cols), px

    >>> ramp = np.tile(np.arange(20.0), (20, 1))
    >>> float(displace(ramp, np.full((2, 20, 20), 0.25))[10, 10].round(3))
    10.25
    """
    rows, cols = np.indices(picture.shape, dtype=float)
    return np.asarray(ndimage.map_coordinates(picture, [rows + field[0], cols + field[1]], order=5, mode="nearest"))


@overload
def displacement(predicted: Array, seen: Array, border: int, start: Array) -> Array: ...


@overload
def displacement(predicted: Array, seen: Array, border: int) -> Array | None: ...


def displacement(predicted: Array, seen: Array, border: int, start: Array | None = None) -> Array | None:
    """Find the field (2, rows, cols), px, such that `predicted` read at the displaced places agrees with `seen`.

    Bilinear between the nodes of a grid of about `GRID_PX`, with mean 0. Gauss-Newton on the residual beyond `border`
    px of the frame; the nodes have a Gaussian prior of `NODE_STD_PX`, and of second differences whose size maximises
    the marginal likelihood. None where the log Bayes factor against no displacement is below `LEAST_LOG_BAYES_FACTOR`,
    except with `start`, a field to begin with.
    """
    inner = np.s_[border : seen.shape[0] - border, border : seen.shape[1] - border]
    hats = [_hats(n, max(2, round(n / GRID_PX) + 1)) for n in seen[inner].shape]
    shape = hats[0].shape[1], hats[1].shape[1]
    nodes = shape[0] * shape[1]
    field, at = np.zeros((2, *seen.shape)), np.zeros(2 * nodes)
    if start is not None:
        field = start
        at = np.concatenate([(_pinv(hats[0]) @ part[inner] @ _pinv(hats[1]).T).ravel() for part in start])
    precisions = [
        _node_precision(shape, curvature) + np.eye(nodes) / NODE_STD_PX**2 for curvature in NODE_CURVATURES_PX
    ]
    precision = precisions[0]
    for iteration in range(2):
        moved = displace(predicted, field)
        residual = (seen - moved)[inner]
        noise2 = float(np.mean(residual**2))
        gradients = [np.gradient(moved, axis=axis)[inner] for axis in (0, 1)]
        gram = np.block([[_hat_gram(hats, a * b) for b in gradients] for a in gradients]) / noise2
        right = np.concatenate([(hats[0].T @ (a * residual) @ hats[1]).ravel() for a in gradients]) / noise2
        if iteration == 0:
            log_factors = [_log_bayes_factor(gram, right + gram @ at, p) for p in precisions]
            if start is None and max(log_factors) < LEAST_LOG_BAYES_FACTOR:
                return None
            precision = linalg.block_diag(*[precisions[int(np.argmax(log_factors))]] * 2)
        factor = linalg.cho_factor(gram + precision, lower=True, check_finite=False)
        at = at + linalg.cho_solve(factor, right - precision @ at, check_finite=False)
        parts = [hats[0] @ part.reshape(shape) @ hats[1].T for part in np.split(at, 2)]
        field = np.stack([np.pad(part - part.mean(), border, mode="edge") for part in parts])
    return field


def _pinv(hats: Array) -> Array:
    """Return the pseudo-inverse of the basis of one axis."""
    return np.asarray(np.linalg.pinv(hats))


def _node_precision(shape: tuple[int, int], curvature_px: float) -> Array:
    """Return the precision (nodes, nodes) of a grid whose second differences, along both axes and mixed, are about
    `curvature_px`.
    """
    down, across = (np.eye(n) for n in shape)
    differences = [np.kron(np.diff(down, 2, axis=0), across), np.kron(down, np.diff(across, 2, axis=0))]
    differences.append(np.kron(np.diff(down, axis=0), np.diff(across, axis=0)))
    return np.asarray(sum(b.T @ b for b in differences) / curvature_px**2)


def _log_bayes_factor(gram: Array, right: Array, precision: Array) -> float:
    """Return the log Bayes factor of a displacement with given `precision` (of one axis) against none.

    `gram` (2 nodes, 2 nodes), `right` (2 nodes,): normal equations over the noise variance; `precision` (nodes, nodes).
    """
    factor = linalg.cholesky(gram + linalg.block_diag(precision, precision), lower=True, check_finite=False)
    half = linalg.solve_triangular(factor, right, lower=True, check_finite=False)
    prior = linalg.cholesky(precision, lower=True, check_finite=False)
    return float(0.5 * half @ half - np.log(np.diag(factor)).sum() + 2.0 * np.log(np.diag(prior)).sum())


def _hats(count: int, nodes: int) -> Array:
    """Return the basis (count, nodes) of linear interpolation between evenly spaced nodes: hat functions."""
    at = np.linspace(0.0, nodes - 1.0, count)
    return np.clip(1.0 - np.abs(at[:, None] - np.arange(nodes)), 0.0, None)


def _hat_gram(hats: Sequence[Array], weight: Array) -> Array:
    """Return the Gram matrix (nodes, nodes) of the products of row and column hat functions under a `weight` (rows,
    cols).
    """
    down, across = hats
    # By rows first, then by columns
    row_products = np.einsum("ri,rj->rij", down, down).reshape(len(down), -1)  # (rows, a a')
    half = row_products.T @ weight  # (a a', cols)
    full = half @ np.einsum("ci,cj->cij", across, across).reshape(len(across), -1)  # (a a', b b')
    a, b = down.shape[1], across.shape[1]
    return np.asarray(full.reshape(a, a, b, b).transpose(0, 2, 1, 3).reshape(a * b, a * b))


@one_blas_thread
def estimate_kernel(
    sharp: ArrayLike,
    blurred: ArrayLike,
    support: int,
    noise_std: float | None = None,
    *,
    register: bool = True,
) -> KernelEstimate:
    """Estimate the kernel that blurs `sharp` into `blurred`.

        blurred[r, c] = sum_ij kernel[i, j] sharp[r - i + support // 2, c - j + support // 2] + noise

    on the rows and columns at least support // 2 from the border; kernel >= 0, sum 1.

    sharp, blurred : (rows, cols)
    support : rows and columns of the kernel, odd
    noise_std : standard deviation of the noise, in the unit of `blurred`; by default it is estimated from the residual
    register : where the residual shows that `sharp` was drawn a little off its place (`displacement`), refine the
        places together with the kernel, except a common shift, which belongs to the kernel

    Returns the kernel and its standard deviation, (support, support). Raises ValueError for arguments of the wrong
    shape or size; `NotDetermined` where the picture is smaller than 2 x support, isn't finite or has no structure, or
    where `sharp` doesn't explain `blurred`.

    >>> import calibench
    >>> import numpy as np
    >>> from scipy.signal import convolve
    >>> rng = np.random.default_rng(1)
    >>> sharp = rng.random((60, 60))
    >>> truth = np.array([[0.0, 0.1, 0.0], [0.1, 0.5, 0.2], [0.0, 0.1, 0.0]])
    >>> blurred = convolve(sharp, truth, mode="same") + 1e-3 * rng.standard_normal((60, 60))
    >>> estimate = calibench.estimate_kernel(sharp, blurred, 3, noise_std=1e-3)
    >>> estimate.kernel.round(2).tolist()[1]
    [0.1, 0.5, 0.2]
    """
    u, b = np.asarray(sharp, dtype=float), np.asarray(blurred, dtype=float)
    if u.shape != b.shape or u.ndim != 2:
        raise ValueError(f"sharp {u.shape} and blurred {b.shape} must be of the same two-dimensional shape")
    if support != int(support) or support < 1 or support % 2 == 0:
        raise ValueError(f"support = {support} must be a whole number, odd and positive: the kernel has a middle")
    if noise_std is not None and not 0.0 <= noise_std < np.inf:
        raise ValueError(f"noise_std = {noise_std} must be finite and not negative")
    if min(u.shape) < 2 * support:
        raise NotDetermined("psf", f"{u.shape[0]} x {u.shape[1]} px are too few for a kernel of {support} x {support}")
    for name, picture in (("sharp", u), ("blurred", b)):
        if not np.isfinite(picture).all():
            raise NotDetermined(
                "psf", f"{int((~np.isfinite(picture)).sum())} pixels of the {name} picture aren't finite"
            )
    from scipy.signal import fftconvolve  # here: the library takes a while to load

    normal = normal_equations(u, b, support)
    solved = solve_kernel(normal, support, noise_std, rounds=1, solves=BRIEF_SOLVES)
    inner = np.s_[support // 2 : u.shape[0] - support // 2, support // 2 : u.shape[1] - support // 2]
    kernel, predicted = solved.kernel, fftconvolve(u, solved.kernel, mode="same")
    _refuse_unrelated(predicted[inner], b[inner])
    field = displacement(predicted, b, support // 2) if register else None
    if field is not None:
        # Gauss-Newton: the Jacobian by the kernel is the displaced target
        carried = displace(u, field)
        normal = normal_equations(carried, b, support)
        for step in range(DISPLACEMENT_STEPS):
            moved = displace(predicted, field)
            linear = b - moved + fftconvolve(carried, kernel, mode="same")
            right = normal_equations_right(carried, linear, support)
            normal = replace(normal, right=right[0], power=right[1])
            if step < DISPLACEMENT_STEPS - 1:
                noise2 = float(np.mean((b - moved)[inner] ** 2))
                elements = on_simplex(
                    normal.gram + noise2 * solved.precision, normal.right, kernel.ravel(), BRIEF_SOLVES
                )
                kernel = elements.reshape(support, support)
                predicted = fftconvolve(u, kernel, mode="same")
                field = displacement(predicted, b, support // 2, field)
        solved = replace(solved, kernel=kernel)
    return solve_kernel(normal, support, noise_std, start_from=solved, rounds=ROUNDS - 1)


def _refuse_unrelated(predicted: Array, seen: Array) -> None:
    """Raise `NotDetermined` where the predicted picture is unrelated to the one seen, is unlevelled, or this one is
    clipped.
    """
    if not seen.std() > 0.0:
        raise NotDetermined(
            "psf", f"the blurred picture is uniform at {seen.flat[0]:g}: is the target lit, or is it saturated?"
        )
    agreement = float(np.corrcoef(predicted.ravel(), seen.ravel())[0, 1]) if predicted.std() > 0.0 else 0.0
    if not agreement**2 > 0.25:
        raise NotDetermined(
            "psf",
            f"the sharp picture explains {100 * max(agreement, 0.0) ** 2:.0f} % of the blurred one: is it that "
            "pattern?",
        )
    contrast = agreement * float(seen.std() / predicted.std())
    if not 0.5 < contrast < 2.0:
        raise NotDetermined(
            "psf",
            f"the blurred picture has {contrast:.2g} times the contrast of the sharp one: level it between white and "
            "black, or widen the support",
        )
    for name, end in (("lowest", seen.min()), ("highest", seen.max())):
        standing = seen == end
        share = float(standing.mean())
        # Pixels at one value although the pattern predicts different ones
        if share > 0.02 and float(predicted[standing].std()) > 0.1 * float(predicted.std()):
            raise NotDetermined(
                "psf",
                f"{100 * share:.0f} % of the blurred picture stand at its {name} value, {end:g}: it is clipped, "
                "expose it anew",
            )
