"""Birefringent plates, glass plates, filter edges and veils against textbook formulas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from sim.optics.filters import (
    birefringent_displacement_um,
    birefringent_otf,
    birefringent_spots,
    edge_transmittance,
    plate_focus_shift_um,
    plate_spherical_um,
    plate_wavefront,
    quartz_indices,
    veil_otf,
)


def test_quartz_is_what_the_tables_say() -> None:
    """no 1.5442, ne 1.5533 at the sodium line; 0.34 mm displace by 2 um; blue by more than red."""
    ordinary, extraordinary = quartz_indices(589.3)
    assert ordinary == pytest.approx(1.5442, abs=1e-4)
    assert extraordinary == pytest.approx(1.5533, abs=1e-4)
    assert birefringent_displacement_um(1.0) == pytest.approx(5.88, abs=0.005)
    assert birefringent_displacement_um(0.34) == pytest.approx(2.0, abs=0.005)
    np.testing.assert_allclose(birefringent_displacement_um(1.0, [400.0, 700.0]), [6.12, 5.81], atol=0.005)


@pytest.mark.parametrize(("dx", "dy", "spots"), [(2.0, 3.0, 4), (2.0, 0.0, 2), (0.0, 0.0, 1)])
def test_transfer_is_that_of_the_spots(dx: float, dy: float, spots: int) -> None:
    positions, shares = birefringent_spots(dx, dy)
    assert len(positions) == spots
    assert shares.sum() == 1.0
    fx, fy = np.array([0.0, 0.1, 0.25, -0.3]), np.array([0.0, -0.2, 0.05, 0.4])
    total = sum(
        share * np.exp(-2j * np.pi * (fx * x + fy * y)) for (x, y), share in zip(positions, shares, strict=True)
    )
    np.testing.assert_allclose(birefringent_otf(fx, fy, dx, dy), total, atol=1e-14)


def test_null_lies_at_half_the_inverse_displacement() -> None:
    """d = pitch puts it at Nyquist: 2 um and 0.25 cy/um."""
    assert birefringent_otf(0.25, 0.1, 2.0, 0.0) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(("f_number", "error"), [(8.0, 0.003), (4.0, 0.012), (1.8, 0.06)])
def test_plate_agrees_with_snells_law(f_number: float, error: float) -> None:
    """The focus of a cone at angle u moves by t (1 - cos u / sqrt(n^2 - sin^2 u)); dW = (shift less the paraxial one)
    sin u du.
    """
    t_um, n = 500.0, 1.52
    u = np.linspace(0.0, np.arcsin(0.5 / f_number), 20001)
    shift = t_um * (1.0 - np.cos(u) / np.sqrt(n**2 - np.sin(u) ** 2))
    assert plate_focus_shift_um(0.5, n) == pytest.approx(shift[0], rel=1e-12)
    path = np.trapezoid((shift - shift[0]) * np.sin(u), u)
    assert plate_spherical_um(0.5, n, f_number) == pytest.approx(path, rel=error)


def test_plate_is_spherical_aberration_with_or_without_its_defocus() -> None:
    rim, none = np.ones(1), np.zeros(1)
    w040 = plate_spherical_um(0.5, 1.52, 2.8)
    assert plate_wavefront(0.5, 1.52, 2.8)(rim, none) == pytest.approx(w040)
    left = plate_wavefront(0.5, 1.52, 2.8, refocused=False)(rim, none)
    assert left == pytest.approx(w040 - 500.0 * (1 - 1 / 1.52) / (8 * 2.8**2))


def test_a_steepened_edge_is_a_gaussian_s_integral() -> None:
    """The logistic of 1.5976 x + 0.07056 x^3 is Phi(x) within 1.4e-4."""
    x = np.linspace(-6.0, 6.0, 121)
    edge = edge_transmittance(650.0 + 10.0 * x, 650.0, 10.0 / 1.5976, steepening=0.07056 / 1.5976**3)
    np.testing.assert_allclose(edge, special.ndtr(-x), atol=1.5e-4)


def test_interference_edges_move_to_the_blue_and_glass_stays() -> None:
    """30 degrees and n = 1.8: 650 nm becomes 650 sqrt(1 - 0.25 / 3.24) = 624.4 nm."""
    moved = 650.0 * np.sqrt(1 - 0.25 / 1.8**2)
    assert edge_transmittance(moved, 650.0, 5.0, 0.5, 1.8) == pytest.approx(0.5)
    assert edge_transmittance(650.0, 650.0, 5.0, 0.5) == pytest.approx(0.5)
    field = edge_transmittance(640.0, 650.0, 5.0, np.array([0.0, 0.2, 0.4]), 1.8)
    assert np.all(np.diff(field) < 0)
    np.testing.assert_array_equal(edge_transmittance(np.array([600.0, 700.0]), 650.0, 5.0, 0.0, 1.8),
                                  edge_transmittance(np.array([600.0, 700.0]), 650.0, 5.0))  # fmt: skip


def test_a_veil_takes_its_share_at_every_frequency_but_zero() -> None:
    np.testing.assert_allclose(veil_otf(np.array([0.0, 1e-3, 0.2]), np.zeros(3), 0.03), [1.0, 0.97, 0.97], atol=1e-12)
