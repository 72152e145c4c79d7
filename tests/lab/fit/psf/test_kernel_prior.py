"""The prior's computation axis by axis against whole matrices."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.psf.kernel_prior import KernelPrior, log_likelihood

SUPPORT = 7


@pytest.fixture(params=[0.0, 1.6])
def prior(request: pytest.FixtureRequest) -> KernelPrior:
    return KernelPrior(np.random.default_rng(2).uniform(0.01, 1.0, SUPPORT**2), request.param, 0.3)


@pytest.fixture
def covariance(prior: KernelPrior) -> np.ndarray:
    """strength^2 E C E, element by element from the definition."""
    row, col = np.divmod(np.arange(SUPPORT**2), SUPPORT)
    apart2 = (row[:, None] - row) ** 2 + (col[:, None] - col) ** 2
    same = np.eye(SUPPORT**2)
    correlation = np.exp(-0.5 * apart2 / prior.length**2) + 1e-4 * same if prior.length else same
    return prior.strength**2 * np.outer(prior.envelope, prior.envelope) * correlation


@pytest.fixture
def information() -> np.ndarray:
    design = np.random.default_rng(3).normal(size=(200, SUPPORT**2))
    return 40.0 * design.T @ design


def test_precision_and_posterior_are_those_of_the_covariance(
    prior: KernelPrior, covariance: np.ndarray, information: np.ndarray
):
    """Bayes' rule for Gaussians, and the condition that the sum is 1. The covariance's condition is 1e8, hence 1e-7."""
    precision = prior.precision()
    np.testing.assert_allclose(precision @ covariance, np.eye(SUPPORT**2), atol=1e-7 * np.abs(precision).max())
    free = np.linalg.inv(information + np.linalg.inv(covariance))
    share = free.sum(axis=1)
    expected = free - np.outer(share, share) / share.sum()
    np.testing.assert_allclose(prior.posterior(information), expected, atol=1e-9 * np.abs(expected).max())


def test_the_marginal_likelihood_is_that_of_the_whole_covariance(
    prior: KernelPrior, covariance: np.ndarray, information: np.ndarray
):
    """ln N(y; 0, 1 + A C A^T) by the matrix determinant lemma, up to what doesn't depend on C, on arbitrary data."""
    weighted = np.random.default_rng(4).normal(size=SUPPORT**2)
    size = SUPPORT**2
    inner = np.linalg.inv(np.linalg.inv(covariance) + information)
    expected = 0.5 * weighted @ inner @ weighted - 0.5 * np.linalg.slogdet(np.eye(size) + covariance @ information)[1]
    found = log_likelihood(prior.whitened(information), prior.whitened_right(weighted))
    assert found == pytest.approx(expected, rel=1e-8)
