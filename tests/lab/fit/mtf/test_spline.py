"""The spline's fast formulas against the plain ones, to rounding errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.interpolate import BSpline

from lab.fit.mtf.spline import SortedSamples, Spline

KNOTS_PX = np.array([-40.0, -9.0, -4.0, -2.5, *np.arange(-8, 9) * 0.25, 2.5, 4.0, 9.0, 40.0])
SPLINE = Spline(KNOTS_PX)


def test_the_pieces_are_the_basis_functions():
    """Against scipy's B-splines within each interval; values are at most 1, so that 1e-13 is a thousand roundings."""
    t = np.array([0.03, 0.4, 0.98])
    basis = BSpline(np.r_[[KNOTS_PX[0]] * 3, KNOTS_PX, [KNOTS_PX[-1]] * 3], np.eye(SPLINE.size), 3)
    powers = np.vander(t, 4, increasing=True)
    for i, piece in enumerate(SPLINE.pieces):
        expected = basis(KNOTS_PX[i] + t * (KNOTS_PX[i + 1] - KNOTS_PX[i]))
        np.testing.assert_allclose(powers @ piece, expected[:, i : i + 4], atol=1e-13)


@pytest.mark.parametrize("weighted", [True, False])
def test_the_gram_matrix_is_that_of_the_columns(weighted: bool):
    rng = np.random.default_rng(4)
    distance = rng.uniform(-45.0, 45.0, 3000)
    placed = SortedSamples.of(SPLINE, distance)
    columns, weight = rng.normal(size=(3, 3000)), rng.uniform(0.0, 2.0, 3000) if weighted else None
    design = np.column_stack([SPLINE.design(distance[placed.order]).toarray(), columns.T])
    expected = (design * (1.0 if weight is None else weight[:, None])).T @ design
    np.testing.assert_allclose(placed.gram(columns, weight), expected, atol=1e-12 * np.abs(expected).max())


def test_values_and_derivatives_at_sorted_samples_are_those_of_the_spline():
    rng = np.random.default_rng(5)
    distance, coefficients = rng.uniform(-39.0, 39.0, 500), rng.normal(size=SPLINE.size)
    placed = SortedSamples.of(SPLINE, distance)
    at = distance[placed.order]
    np.testing.assert_allclose(SPLINE.values(coefficients, at), SPLINE.design(at) @ coefficients, atol=1e-13)
    np.testing.assert_allclose(placed.values(coefficients), SPLINE.values(coefficients, at), atol=1e-12)
    np.testing.assert_allclose(placed.derivatives(coefficients), SPLINE.derivative(coefficients, at), atol=1e-11)


def test_the_transfer_operator_is_the_fourier_integral():
    rng = np.random.default_rng(6)
    coefficients, frequency = rng.normal(size=SPLINE.size), np.array([0.0, 0.02, 0.31, 1.1])

    def integrand(x: float) -> np.ndarray:
        return SPLINE.derivative(coefficients, np.array([x])) * np.exp(-2j * np.pi * frequency * x)

    expected, error = quad_vec(integrand, KNOTS_PX[0], KNOTS_PX[-1], epsabs=1e-10, limit=20000, points=KNOTS_PX[1:-1])
    assert error < 1e-8
    np.testing.assert_allclose(SPLINE.transfer_operator(frequency) @ coefficients, expected, atol=1e-8)
