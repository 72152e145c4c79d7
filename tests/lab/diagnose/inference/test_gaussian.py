"""Normal distributions with shared columns agree with their dense formulas."""

from __future__ import annotations

import numpy as np
import pytest

from lab.observables.gaussian import BlockCovariance, Gaussian, chi2


def test_gaussians_agree_with_their_formulas() -> None:
    """Blocks by themselves, tied by free quantities: whitened, solved and weighed as the dense matrix is."""
    rng = np.random.default_rng(5)
    blocks = [a @ a.T + np.eye(len(a)) for a in (rng.standard_normal((4, 4)), rng.standard_normal((3, 3)))]
    free = rng.standard_normal((7, 2)) * (1.0, 1e3)  # one all but undetermined beforehand
    gaussian = Gaussian(rng.standard_normal(7), tuple(BlockCovariance(b) for b in blocks), free)
    dense = free @ free.T
    dense[:4, :4] += blocks[0]
    dense[4:, 4:] += blocks[1]
    np.testing.assert_allclose(gaussian.covariance, dense)
    np.testing.assert_allclose(gaussian.block_covariance(1), dense[4:, 4:])
    y = gaussian.mean + rng.standard_normal(7)
    r = y - gaussian.mean
    # the dense inverse is good to 1e-16 of the condition of 1e7
    solved = np.linalg.solve(dense, r)
    np.testing.assert_allclose(gaussian.solve(r), solved, rtol=1e-4, atol=1e-6)
    white = gaussian.whiten(np.column_stack([r, free]))
    np.testing.assert_allclose(
        white.T @ white, np.column_stack([r, free]).T @ gaussian.solve(np.column_stack([r, free])), rtol=1e-6, atol=1e-9
    )
    assert gaussian.chi2(y) == pytest.approx(r @ solved, rel=1e-4)
    assert chi2(r, dense) == pytest.approx(r @ solved, rel=1e-4)
    assert gaussian.log_likelihood(y) == pytest.approx(-0.5 * r @ solved - 0.5 * np.linalg.slogdet(dense)[1], rel=1e-4)
    more = gaussian.with_discrepancy(0, np.eye(4))
    np.testing.assert_allclose(more.covariance - dense, np.diag([1.0] * 4 + [0.0] * 3), atol=1e-4)


def test_a_variance_beyond_rounding_leaves_a_chi2() -> None:
    """One free quantity with a variance of 1e20 in numbers of unit noise: rounding leaves the dense covariance
    indefinite. What lies across that quantity keeps a chi2, of at most what unit noise gives."""
    rng = np.random.default_rng(1)
    free = rng.standard_normal((30, 1)) * 1e10
    residual = rng.standard_normal(30)
    covariance = np.eye(30) + free @ free.T
    value = chi2(residual, covariance)
    assert np.isfinite(value)
    assert 0.0 <= value <= float(residual @ residual)
