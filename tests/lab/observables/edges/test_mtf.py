"""MTF of slanted edges against truths in closed form, and the spline's fast formulas against the plain ones, to
rounding errors.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.interpolate import BSpline
from scipy.special import erf, ndtr

from lab.errors import NotDetermined
from lab.fit.mtf import edge_mtf
from lab.observables.edges.finding import Plane, half_way_px
from lab.observables.edges.mtf import read_mtf
from lab.observables.edges.profile import summarise_edge
from lab.observables.edges.spread import SortedSamples, Spline
from tests.lab.observables.edges.drawn_edges import edge, gaussian_mtf, gaussian_mtf50, noisy, squares

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


@pytest.mark.parametrize("bend_px", [0.0, 2.0])
@pytest.mark.parametrize("sigma_px", [0.55, 1.5])
@pytest.mark.parametrize("angle_deg", [5.0, -12.0, 30.0, 95.0, 130.0, 185.0, 355.0])
def test_noise_free_curve_is_the_gaussians(angle_deg, sigma_px, bend_px):
    found = edge_mtf(edge(200, angle_deg, sigma_px, bend_px))
    # the goal is 0.02 % of MTF50; the spline's own error is two orders below
    assert found.mtf50_cy_per_px == pytest.approx(gaussian_mtf50(sigma_px), rel=2e-4)
    # 2 px of bend turn the edge by +-2.3 deg: of an isotropic blur nothing is seen of that
    np.testing.assert_allclose(found.mtf, gaussian_mtf(sigma_px, found.frequency_cy_per_px), atol=4e-4)
    turned = (found.angle_deg - angle_deg + 90) % 180 - 90
    assert abs(turned) < (0.03 if bend_px else 1e-3)  # a bent edge's angle is that at the region's centre
    assert -90 < found.angle_deg <= 90


def test_undersampled_blur_keeps_its_curve_beyond_nyquist():
    found = edge_mtf(edge(400, 5.0, 0.3))
    np.testing.assert_allclose(found.mtf, gaussian_mtf(0.3, found.frequency_cy_per_px), atol=3e-4)


def test_standard_deviation_is_as_predicted_and_near_the_bound():
    rng = np.random.default_rng(11)
    mean = edge(400, 5.0, 0.55)
    found = [edge_mtf(noisy(mean, rng)) for _ in range(30)]
    relative = np.array([f.mtf50_cy_per_px for f in found]) / gaussian_mtf50(0.55) - 1
    predicted = np.mean([f.mtf50_cy_per_px_std for f in found]) / gaussian_mtf50(0.55)
    # Cramer-Rao bound of this noise with a free line spread of +-4 px: 0.256 % (hats of 0.25 px, levels free)
    assert predicted < 1.1 * 0.00256
    assert abs(relative.mean()) < 3 * predicted / np.sqrt(30) + 2e-4
    # a standard deviation of 30 values is uncertain by 1 / sqrt(58) = 13 %: three of these
    assert 0.6 < relative.std(ddof=1) / predicted < 1.4


@pytest.mark.parametrize("dark_dn", [0.06, 0.5])
def test_standard_deviation_is_as_predicted_where_the_dark_side_has_one_code(dark_dn):
    """Eight bits, 120 DN of contrast, 50 e/DN: noise of 0.05 to 0.15 DN on the dark side leaves one code there, or two.
    40 edges, so that a sum of squares has a standard deviation of 0.22; held to 4 of them above, as rounding's error is
    no normal one.
    """
    rng = np.random.default_rng(31)
    frequency = np.array([0.05, 0.1, 0.2, 0.3, 0.5])
    pulls = []
    for k in range(40):
        light = 120.0 * edge(90, 5.0, 0.6, offset_px=0.05 * k, dark=0.0) + dark_dn + 0.01 * k
        seen = np.round(10.0 + light + np.sqrt(light / 50.0 + 0.0025) * rng.standard_normal(light.shape))
        found = read_mtf(summarise_edge([Plane(seen)], code=1.0), frequency)
        pulls.append((found.mtf - gaussian_mtf(0.6, frequency)) / found.mtf_std)
    assert np.mean(np.square(pulls), axis=0) == pytest.approx(np.full(5, 1.0), abs=0.9)


def test_covariance_covers_the_whole_curve():
    """A skewed line spread, which the prior's Gaussian part doesn't know: shares, places and widths of three spots."""
    rng = np.random.default_rng(5)
    frequency = np.arange(0.05, 0.5, 0.05)
    spots = [(0.6, -0.3, 0.45), (0.25, 0.5, 0.6), (0.15, 1.6, 0.9)]
    truth = np.abs(sum(w * np.exp(-2j * np.pi * frequency * x) * gaussian_mtf(s, frequency) for w, x, s in spots))
    chi2, pulls = [], []
    for _ in range(40):
        mean = 0.1 + sum(w * (edge(160, 7.0, s, offset_px=0.3 + x) - 0.1) for w, x, s in spots)
        found = edge_mtf(noisy(mean, rng), frequency)
        gap = found.mtf - truth
        chi2.append(gap @ np.linalg.solve(found.covariance, gap))
        np.testing.assert_allclose(found.mtf_std, np.sqrt(np.diag(found.covariance)))
        pulls.append(gap / found.mtf_std)
    n = len(frequency)
    # mean of 40 chi2 of n degrees of freedom: n +- sqrt(2 n / 40), 4 of these; less where the truth is smoother than
    # the prior has to allow for, but not by more than half
    assert 0.5 * n < np.mean(chi2) < n + 4 * np.sqrt(2 * n / 40)
    # neighbouring frequencies move together: some 3 independent numbers an edge, 120 in all: 95 % +- 2 %, 4 of these
    assert np.mean(np.abs(pulls) < 2) > 0.87


def test_no_noise_floor_above_nyquist():
    rng = np.random.default_rng(3)
    found = [edge_mtf(noisy(edge(400, 5.0, 0.9), rng)) for _ in range(8)]
    above = found[0].frequency_cy_per_px > 0.6  # the Gaussian itself is below 0.003 there
    assert np.mean([f.mtf[above] for f in found]) < 0.004


def test_a_prediction_through_the_operator_is_what_the_estimator_reports():
    """An asymmetric line spread with long tails, which every estimator truncates: the operator has the same bias."""

    def profile(d):
        return 0.9 * 0.5 * (1 + erf(d / 0.6 / np.sqrt(2))) + 0.1 * (0.5 + np.arctan(d / 3.0 - 0.2) / np.pi)

    r, c = np.indices((200, 200)) - 99.5
    a = np.radians(6.0)
    d = c * np.cos(a) + r * np.sin(a) - 0.2
    found = edge_mtf(100 + 1000 * profile(d))
    # what is left is the asymmetry, which shifts the edge against the profile's own zero
    signal = found.frequency_cy_per_px < 0.8
    np.testing.assert_allclose(found.predict(profile)[signal], found.mtf[signal], atol=4e-4)
    assert np.abs(found.mtf - found.predict(lambda x: 0.5 * (1 + erf(x / 0.6 / np.sqrt(2))))).max() > 0.03


def test_a_gradient_of_the_illumination_is_taken_out():
    r, c = np.indices((200, 200)) - 99.5
    shaded = edge(200, 5.0, 0.7) * (1 + 4e-4 * c - 6e-4 * r)
    found = edge_mtf(shaded)
    # what no plane describes, 4e-5 of the light, counts as noise
    assert (np.abs(found.mtf - gaussian_mtf(0.7, found.frequency_cy_per_px)) < 5e-4 + 2 * found.mtf_std).all()
    assert found.mtf50_cy_per_px == pytest.approx(gaussian_mtf50(0.7), rel=5e-4)


def test_two_planes_of_unequal_gain_on_their_own_grids():
    planes = [
        Plane(1.00 * edge(100, 5.0, 0.6, row0=0, col0=1, step=2), 0, 1, 2),
        Plane(1.07 * edge(100, 5.0, 0.6, row0=1, col0=0, step=2), 1, 0, 2),
    ]
    found = read_mtf(summarise_edge(planes))
    # frequencies are of the full sensor although each plane is sampled at every second pixel
    np.testing.assert_allclose(found.mtf, gaussian_mtf(0.6, found.frequency_cy_per_px), atol=2e-4)


def test_hot_pixels_are_left_out():
    rng = np.random.default_rng(2)
    image = noisy(edge(200, 5.0, 0.7), rng)
    image.ravel()[rng.integers(0, image.size, 60)] += 3000
    found = edge_mtf(image)
    assert found.mtf50_cy_per_px == pytest.approx(gaussian_mtf50(0.7), abs=4 * found.mtf50_cy_per_px_std)


@pytest.mark.parametrize(
    "region",
    [
        np.ones((200, 200)),
        np.random.default_rng(0).normal(100, 3, (200, 200)),
        np.where(np.abs(np.arange(200) - 100) < 30, 100.0, 10.0) * np.ones((200, 1)),
        (np.arange(200)[:, None] // 25 + np.arange(200) // 25) % 2 * 100.0,
        np.arange(200.0) * np.ones((200, 1)),
        np.ones((10, 10)),
        np.full((64, 64), np.nan),
    ],
    ids=["uniform", "noise", "two edges", "checkerboard", "ramp", "tiny", "not finite"],
)
def test_no_single_edge_is_not_determined(region):
    with pytest.raises(NotDetermined):
        edge_mtf(region)


@pytest.mark.parametrize("angle_deg", [0.0, 0.3, 45.0, 44.8, 90.0, 89.6, 26.565])
def test_edges_along_the_pixels_rows_and_diagonals(angle_deg):
    found = edge_mtf(noisy(edge(200, angle_deg, 0.55), np.random.default_rng(9)))
    # where all samples fall on few distances the interval is wide, and it holds
    assert found.mtf50_cy_per_px == pytest.approx(gaussian_mtf50(0.55), abs=4 * found.mtf50_cy_per_px_std)
    assert found.mtf50_cy_per_px_std < 0.1 * found.mtf50_cy_per_px


@pytest.mark.parametrize("offset_px", [-1.7, 0.0, 0.3, 2.6])
def test_the_edge_lies_half_way_where_its_samples_fall_on_few_distances(offset_px):
    """At atan(3/4) the distances of one colour's pixels are multiples of 0.4 px, and few are as far out as the last of
    them.
    """
    rng = np.random.default_rng(5)
    for _ in range(10):
        image = noisy(edge(60, np.degrees(np.arctan2(3, 4)), 0.7, offset_px=offset_px, step=2), rng)
        found = read_mtf(summarise_edge([Plane(image, step=2)]))
        # its standard deviation is 0.01 px; a tenth of the blur's width is next to nothing for the estimator
        assert abs(half_way_px(found.distance_px, found.esf)) < 0.07


def test_greens_of_an_edge_at_45_deg_are_refused():
    image = noisy(edge(200, 45.0, 0.55), np.random.default_rng(9))
    with pytest.raises(NotDetermined, match=r"1\.4 px apart"):
        summarise_edge([Plane(image[0::2, 1::2], 0, 1, 2), Plane(image[1::2, 0::2], 1, 0, 2)])


def test_mtf10_and_the_profiles_are_the_gaussians():
    found = edge_mtf(noisy(edge(200, 5.0, 0.7), np.random.default_rng(1)))
    mtf10 = np.sqrt(2 * np.log(10)) / (2 * np.pi * 0.7)
    assert found.mtf10_cy_per_px == pytest.approx(mtf10, abs=4 * found.mtf10_cy_per_px_std)
    assert found.mtf10_cy_per_px_std < 0.02 * mtf10
    # the edge's place is known to 0.01 px: 0.006 of the profile at its steepest, and of the slope as much
    np.testing.assert_allclose(found.esf, ndtr(found.distance_px / 0.7), atol=0.012)
    np.testing.assert_allclose(
        found.lsf, np.exp(-0.5 * (found.distance_px / 0.7) ** 2) / 0.7 / np.sqrt(2 * np.pi), atol=0.02
    )


def test_the_tail_of_diffraction_is_followed_beyond_the_region():
    """LSF with a tail 0.13 / d^2, as a lens with its cutoff at 1 cy/px has: 2 % of the contrast is beyond 12 px."""

    def profile(d):  # FT: exp(-2 pi a f) mixed with a Gaussian; a Cauchy's tail is (a / pi) / d^2
        return 0.5 * (0.5 + np.arctan(d / 0.8) / np.pi) + 0.5 * ndtr(d / 0.5)

    r, c = np.indices((200, 200)) - 99.5
    d = c * np.cos(np.radians(5)) + r * np.sin(np.radians(5))
    found = edge_mtf(noisy(0.1 + profile(d), np.random.default_rng(4)), [0.05, 0.1, 0.2])
    truth = 0.5 * np.exp(-2 * np.pi * 0.8 * found.frequency_cy_per_px) + 0.5 * gaussian_mtf(
        0.5, found.frequency_cy_per_px
    )
    assert (np.abs(found.mtf - truth) < 3 * found.mtf_std).all()
    assert found.mtf_std.max() < 0.012


def test_a_clipped_edge_and_a_corner_are_refused():
    rng = np.random.default_rng(3)
    with pytest.raises(NotDetermined, match="clipped at 3000"):
        edge_mtf(np.minimum(noisy(edge(200, 5.0, 0.6), rng), 3000.0))
    corner = noisy(0.1 + squares((300, 300), [(150, 150, 80, 45.0)], 0.6), rng)
    with pytest.raises(NotDetermined, match="more than one edge"):
        edge_mtf(corner[5:175, 5:175])


def test_an_edge_wider_than_its_region_and_unusable_settings_are_refused():
    with pytest.raises(NotDetermined, match="widen the region"):
        edge_mtf(noisy(edge(200, 5.0, 25.0), np.random.default_rng(0)))
    with pytest.raises(ValueError, match="frequencies"):
        edge_mtf(edge(64, 5.0, 0.6), [np.nan])
    with pytest.raises(ValueError, match="noise_std"):
        edge_mtf(edge(64, 5.0, 0.6), noise_std=0.0)
