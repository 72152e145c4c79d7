"""Spectra: resampling, integrals, quadrature rules."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import constants

from sim.spectrum import Spectrum, blackbody_radiance, gauss_rule, lagrange_shares, photons_from_energy, quadrature


@st.composite
def spectra(draw: st.DrawFn) -> Spectrum:
    steps = draw(st.lists(st.floats(0.01, 50.0), min_size=1, max_size=12))
    values = draw(st.lists(st.floats(0.0, 10.0), min_size=len(steps) + 1, max_size=len(steps) + 1))
    return Spectrum.of(400.0 + np.cumsum([0.0, *steps]), values)


@given(spectra(), st.integers(2, 60))
def test_resampling_conserves_the_integral_and_the_mean_wavelength(curve: Spectrum, count: int) -> None:
    grid = np.linspace(curve.wavelength_nm[0] - 3.0, curve.wavelength_nm[-1] + 3.0, count)
    coarse = curve.resample(grid)
    # Rounding of the twice integrated curve: some 1e-16 of (range)^2 x value over the grid's step.
    span = grid[-1] - grid[0]
    assert coarse.integral() == pytest.approx(curve.integral(), rel=1e-9, abs=1e-9 * span)
    weights, nodes = quadrature_of_moment(curve)
    step = np.diff(grid, prepend=grid[0], append=grid[-1])
    moment = np.sum(grid * coarse.value * 0.5 * (step[:-1] + step[1:]))
    assert moment == pytest.approx(np.sum(weights * nodes * curve.at(nodes)), rel=1e-8, abs=1e-6 * span)


def quadrature_of_moment(curve: Spectrum) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = quadrature([curve])
    return weights, nodes


def test_resampling_keeps_a_line_that_interpolation_would_lose() -> None:
    line = Spectrum.of([549.9, 550.0, 550.1], [0.0, 10.0, 0.0])
    assert np.all(line.at(np.arange(405.0, 700.0, 10.0)) == 0)
    assert line.resample(np.arange(405.0, 700.0, 10.0)).integral() == pytest.approx(1.0, rel=1e-9)


def test_resampling_a_straight_line_gives_the_line_inside() -> None:
    straight = Spectrum.of([400.0, 700.0], [1.0, 4.0])
    np.testing.assert_allclose(
        straight.resample(np.arange(450.0, 651.0, 10.0)).value[1:-1], np.arange(160, 350, 10) / 100
    )


def test_integral_of_a_part_is_the_trapezium() -> None:
    assert Spectrum.of([400.0, 500.0], [0.0, 1.0]).integral(450.0, 600.0) == pytest.approx(37.5)
    assert Spectrum.of([400.0, 500.0], [0.0, 1.0]).integral(600.0, 700.0) == 0.0


def test_a_black_body_obeys_stefan_and_boltzmann_and_wien() -> None:
    wavelength_nm = np.geomspace(50.0, 1e6, 20001)
    body = blackbody_radiance(3000.0, wavelength_nm)
    # The trapezium on 20001 log-spaced samples errs by 1e-7, the tails cut off at 50 nm and 1 mm by 1e-8.
    assert np.pi * body.integral() == pytest.approx(constants.Stefan_Boltzmann * 3000.0**4, rel=1e-6)
    assert wavelength_nm[np.argmax(body.value)] == pytest.approx(constants.Wien * 1e9 / 3000.0, rel=1e-3)
    with pytest.raises(ValueError, match="0 K"):
        blackbody_radiance(-1.0, [500.0])


def test_a_photon_at_500_nm_has_the_energy_of_h_c_over_wavelength() -> None:
    assert photons_from_energy(500.0, constants.h * constants.c / 500e-9) == pytest.approx(1.0, rel=1e-12)


def test_quadrature_is_exact_for_a_narrow_line_on_a_sloping_curve() -> None:
    line = Spectrum.of([549.95, 550.0, 550.05], [0.0, 20.0, 0.0])
    slope = Spectrum.of([400.0, 700.0], [0.0, 3.0])
    nodes, weights = quadrature([line, slope])
    # Integral of line x slope x wavelength: line of area 1 about 550; slope x wavelength is quadratic, variance
    # 0.05^2 / 6.
    exact = 1.5 * 550.0 + 0.01 * 0.05**2 / 6
    assert np.sum(weights * line.at(nodes) * slope.at(nodes) * nodes) == pytest.approx(exact, rel=1e-12)


@given(st.integers(1, 10), st.integers(0, 2**32 - 1))
def test_gauss_rule_has_the_moments_of_the_weight(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    position = np.sort(rng.uniform(400.0, 700.0, 80))
    weight = rng.uniform(0.0, 1.0, 80)
    weight /= weight.sum()
    nodes, shares = gauss_rule(position, weight, count)
    for power in range(2 * count):
        scaled = ((position - 550.0) / 150.0) ** power
        assert np.sum(shares * ((nodes - 550.0) / 150.0) ** power) == pytest.approx(np.sum(weight * scaled), abs=1e-10)


def test_gauss_rule_of_a_single_wavelength_is_that_wavelength() -> None:
    nodes, shares = gauss_rule(np.array([500.0, 550.0, 600.0]), np.array([0.0, 1.0, 0.0]), 5)
    np.testing.assert_allclose(nodes, [550.0])
    np.testing.assert_allclose(shares, [1.0])


def test_lagrange_shares_integrate_polynomials_exactly() -> None:
    position = np.linspace(400.0, 700.0, 50)
    weight = np.random.default_rng(1).uniform(0.0, 1.0, (3, 50))
    nodes = np.array([420.0, 500.0, 560.0, 680.0])
    shares = lagrange_shares(position, weight, nodes)
    np.testing.assert_allclose(shares.sum(axis=1), weight.sum(axis=1), rtol=1e-12)
    np.testing.assert_allclose(shares @ (nodes / 500) ** 3, weight @ (position / 500) ** 3, rtol=1e-10)


def test_spectra_refuse_disorder_in_words() -> None:
    with pytest.raises(ValueError, match=r"500\.0 nm follows 600\.0 nm; sort"):
        Spectrum.of([600.0, 500.0], [1.0, 1.0])
    with pytest.raises(ValueError, match="ascending"):
        Spectrum.of([400.0, 500.0], [1.0, 1.0]).resample([500.0, 450.0])


def test_equality_asks_for_the_fields_alone() -> None:
    """Arrays that were computed and kept on the way are neither compared nor needed."""
    one, other = Spectrum.of([400.0, 500.0], [1.0, 2.0]), Spectrum.of([400.0, 500.0], [1.0, 2.0])
    assert one.arrays[0] is not other.arrays[0]
    assert one == other
    assert hash(one) == hash(other)
    assert one != one.scale(2.0)
    assert one != "a spectrum"


def test_shares_far_beyond_the_nodes_are_those_of_the_nearest() -> None:
    """Where rounding leaves nothing of the polynomials' sum, as it does between 500 and 600 nm seen from 1e20."""
    shares = lagrange_shares(np.array([550.0, 1e20]), np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([500.0, 600.0]))
    np.testing.assert_allclose(shares[0], [0.5, 0.5])
    assert np.all(np.isfinite(shares[1]))
    assert shares[1].sum() == pytest.approx(1.0)
