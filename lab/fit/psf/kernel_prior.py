"""The prior of a kernel: a Gaussian process with an envelope, its length and strength by marginal likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, ndimage

Array = NDArray[np.floating[Any]]

PRIOR_LENGTHS_PX = (0.0, 0.6, 1.0, 1.6, 2.5)  # of the correlation; 0: white
PRIOR_STRENGTHS = (0.25, 0.5, 1.0, 2.0, 4.0)  # relative to the maximum of the kernel


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
        """Width of the kernel."""
        return int(np.sqrt(len(self.envelope)))

    def _eigen(self) -> tuple[Array, Array]:
        """Eigenvalues (support^2,) and the eigenvectors of one axis (support, support)."""
        x = np.arange(self.support)
        if self.length <= 0.0:
            return np.ones(self.support**2), np.eye(self.support)
        power, vectors = np.linalg.eigh(np.exp(-0.5 * ((x[:, None] - x) / self.length) ** 2))
        return np.clip(np.kron(power, power), 0.0, None) + 1e-4, vectors

    def precision(self) -> Array:
        """Inverse of the covariance, (k, k)."""
        power, vectors = self._eigen()
        inverse = _both_axes(vectors.T, np.diag(1.0 / power))
        envelope = self.strength * self.envelope
        return np.asarray(inverse / np.outer(envelope, envelope))

    def whitened(self, information: Array) -> Array:
        """R^T information R, (k, k), where covariance = R R^T."""
        power, vectors = self._eigen()
        envelope = self.strength * self.envelope
        inner = _both_axes(vectors, information * np.outer(envelope, envelope))
        return np.asarray(inner * np.sqrt(np.outer(power, power)))

    def whitened_right(self, weighted: Array) -> Array:
        """R^T weighted, (k,)."""
        power, vectors = self._eigen()
        scaled = (self.strength * self.envelope * weighted).reshape(self.support, self.support)
        return np.asarray((vectors.T @ scaled @ vectors).ravel() * np.sqrt(power))

    def posterior(self, information: Array) -> Array:
        """Covariance (k, k) of the kernel, given the data and that its sum is 1."""
        factor = _cholesky_of_one_more(self.whitened(information))
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
    """Log marginal likelihood of the data under a prior, up to a constant, from R^T information R (overwritten) and
    R^T weighted.
    """
    factor = _cholesky_of_one_more(inner)
    half = linalg.solve_triangular(factor, right, lower=True, check_finite=False)
    return float(0.5 * half @ half - np.log(np.diag(factor)).sum())


def _cholesky_of_one_more(matrix: Array) -> Array:
    """The lower triangular root of `matrix` + 1, (k, k) and symmetric, which is overwritten; above it stands anything."""
    matrix.flat[:: len(matrix) + 1] += 1.0
    # LAPACK's columns are the rows of a symmetric matrix: nothing is copied
    factor, failed = linalg.lapack.dpotrf(matrix.T, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise linalg.LinAlgError("the information of a kernel isn't positive definite")
    return np.asarray(factor)


def _both_axes(vectors: Array, matrix: Array) -> Array:
    """(W x W)^T matrix (W x W) of a symmetric `matrix`, x the Kronecker product."""
    s = len(vectors)
    half = (vectors.T @ matrix.reshape(-1, s, s) @ vectors).reshape(matrix.shape)  # matrix (W x W)
    return np.asarray((vectors.T @ half.T.reshape(-1, s, s) @ vectors).reshape(matrix.shape))


def envelope_of(kernel: Array) -> Array:
    """Local mean of a kernel over about a pixel, at least 5e-4 of its maximum; the largest is 1."""
    local = ndimage.gaussian_filter(kernel, 0.6, mode="constant")
    return np.asarray(np.maximum(local / local.max(), 5e-4).ravel())


def most_likely_prior(
    information: Array, weighted: Array, kernel: Array, start: tuple[int, int]
) -> tuple[KernelPrior, tuple[int, int]]:
    """The prior whose length and strength maximise the marginal likelihood, by coordinate ascent on their grid from
    the index `start`.

    `information` (k, k), `weighted` (k,): normal equations over the noise variance; `kernel`: the current estimate,
    for envelope and scale. Returns the prior and its index.
    """
    envelope, top = envelope_of(kernel), float(kernel.max())
    tried: dict[tuple[int, int], tuple[float, KernelPrior]] = {}
    unit_problem: dict[int, tuple[Array, Array]] = {}  # by length: the strength only scales it

    def likelihood(at: tuple[int, int]) -> float:
        """Log marginal likelihood at an index of the grid; minus infinity beside it."""
        if not (0 <= at[0] < len(PRIOR_LENGTHS_PX) and 0 <= at[1] < len(PRIOR_STRENGTHS)):
            return -np.inf
        if at not in tried:
            if at[0] not in unit_problem:
                unit = KernelPrior(envelope, PRIOR_LENGTHS_PX[at[0]], 1.0)
                unit_problem[at[0]] = unit.whitened(information), unit.whitened_right(weighted)
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
