"""Normal distributions whose covariance is block diagonal but for a few shared columns.

C = D + F F',  D block diagonal (one block a measurement),  F (n, k) of few columns

With B = D^-1/2 F = U S V', all inverses follow from the Cholesky factors of D's blocks and from U and S (Woodbury's
identity). The cost is that of the largest block.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, eigh, solve_triangular

from sim.spectrum import FloatArray

#: Relative increase of variances that keeps covariances positive definite against rounding.
ROUNDING = 1e-9
#: Smallest eigenvalue of a correlation matrix that came out indefinite.
LEAST_EIGENVALUE = 1e-4


@dataclass(frozen=True)
class BlockCovariance:
    """Covariance (n, n) of one measurement's numbers: noise, floors, form tolerances, and nuisance parameters of that
    measurement alone."""

    covariance: FloatArray

    @cached_property
    def lower(self) -> FloatArray:
        """Lower Cholesky factor. Where the covariance, estimated from frames, is indefinite, eigenvalues of the
        correlation matrix are raised to `LEAST_EIGENVALUE`."""
        try:
            return np.asarray(cholesky(self.covariance, lower=True, check_finite=False))
        except LinAlgError:
            scale = np.sqrt(np.diag(self.covariance))
            size, vectors = eigh(self.covariance / np.outer(scale, scale))
            mended = (vectors * np.maximum(size, LEAST_EIGENVALUE)) @ vectors.T
            return np.asarray(cholesky(mended * np.outer(scale, scale), lower=True, check_finite=False))


@dataclass(frozen=True)
class Gaussian:
    """N(mean, D + F F'). `blocks` are the blocks of D; F = `shared_jacobian` (n, k) is the Jacobian by nuisance
    parameters that act on several measurements, per prior standard deviation."""

    mean: FloatArray
    blocks: tuple[BlockCovariance, ...]
    shared_jacobian: FloatArray

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each block's numbers stand."""
        ends = np.cumsum([len(b.covariance) for b in self.blocks])
        return tuple(slice(int(e) - len(b.covariance), int(e)) for b, e in zip(self.blocks, ends, strict=True))

    @cached_property
    def covariance(self) -> FloatArray:
        """C as a dense matrix (n, n)."""
        whole = self.shared_jacobian @ self.shared_jacobian.T
        for block, at in zip(self.blocks, self.slices, strict=True):
            whole[at, at] += block.covariance
        return np.asarray(whole)

    def block_covariance(self, index: int) -> FloatArray:
        """Return the part of C of one block's numbers."""
        shared = self.shared_jacobian[self.slices[index]]
        return np.asarray(self.blocks[index].covariance + shared @ shared.T)

    def with_discrepancy(self, index: int, kernel: FloatArray) -> Gaussian:
        """Return the distribution with the covariance of a model discrepancy added to one block."""
        more = BlockCovariance(self.blocks[index].covariance + kernel)
        return replace(self, blocks=(*self.blocks[:index], more, *self.blocks[index + 1 :]))

    @cached_property
    def _shared_svd(self) -> tuple[FloatArray, FloatArray]:
        """U and S of B = D^-1/2 F, from the eigenvectors of B'B. Singular values that are lost beside the largest one
        are far below 1, and count for nothing."""
        split = self._whiten_blocks(self.shared_jacobian)
        square, v = eigh(split.T @ split) if split.shape[1] else (np.zeros(0), np.zeros((0, 0)))
        counts = square > 1e-12 + 1e-15 * float(square.max(initial=0.0))
        s = np.sqrt(square[counts])
        return (split @ v[:, counts]) / s, s

    def _whiten_blocks(self, table: FloatArray) -> FloatArray:
        """D^-1/2 times vectors; of each block those that are zero there are skipped."""
        out = np.zeros_like(table)
        for block, at in zip(self.blocks, self.slices, strict=True):
            use = table[at].any(axis=0)
            if np.all(use):
                out[at] = solve_triangular(block.lower, table[at], lower=True, check_finite=False)
            elif np.any(use):
                out[at, use] = solve_triangular(block.lower, table[at][:, use], lower=True, check_finite=False)
        return out

    def whiten(self, table: FloatArray) -> FloatArray:
        """Vectors (n,) or (n, m) in coordinates in which C is the identity: (1 + B B')^-1/2 D^-1/2 v."""
        split = self._whiten_blocks(table)
        u, s = self._shared_svd
        less = 1.0 / np.sqrt(1.0 + s * s) - 1.0
        return np.asarray(split + (u * less) @ (u.T @ split))

    def solve(self, table: FloatArray) -> FloatArray:
        """C^-1 v for vectors (n,) or (n, m)."""
        split = self._whiten_blocks(table)
        u, s = self._shared_svd
        split = split - (u * (s * s / (1.0 + s * s))) @ (u.T @ split)
        out = np.zeros_like(split)
        for block, at in zip(self.blocks, self.slices, strict=True):
            out[at] = solve_triangular(block.lower, split[at], lower=True, trans="T", check_finite=False)
        return out

    def chi2(self, value: FloatArray) -> float:
        """(y - m)' C^-1 (y - m)."""
        white = self.whiten(value - self.mean)
        return float(white @ white)

    def log_likelihood(self, value: FloatArray) -> float:
        """log p(y) without the constant -n/2 log(2 pi)."""
        diagonals = sum(float(np.log(np.diag(block.lower)).sum()) for block in self.blocks)
        return -0.5 * self.chi2(value) - diagonals - 0.5 * float(np.log1p(np.square(self._shared_svd[1])).sum())


def chi2(residual: FloatArray, covariance: FloatArray) -> float:
    """r' C^-1 r of a dense covariance, which estimates or rounding may leave indefinite (`BlockCovariance.lower`)."""
    white = solve_triangular(BlockCovariance(covariance).lower, residual, lower=True)
    return float(white @ white)


def conditional(
    residual: FloatArray, covariance: FloatArray, of: np.ndarray, given: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Residual and covariance of the numbers `of`, given those that `given` marks; both are masks (n,)."""
    inside = BlockCovariance(covariance[np.ix_(given, given)]).lower, True
    gain = cho_solve(inside, covariance[np.ix_(given, of)])
    return residual[of] - gain.T @ residual[given], covariance[np.ix_(of, of)] - gain.T @ covariance[np.ix_(given, of)]
