"""Transfer functions of aberrated pupils against closed forms, sums and FFTs."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy import integrate

from sim.optics.diffraction import diffraction_otf
from sim.optics.pupil import (
    Wavefront,
    _mean,
    _octave,
    _ratio_along,
    noll_order,
    osa_order,
    pupil_otf,
    pupil_ratio,
    seidel,
    zernike,
)

CUTOFF = 1 / (0.55 * 4.0)


def hopkins(share: float, w020_waves: float) -> float:
    """Defocus by Hopkins's single integral (1955), with another rule and in other coordinates than the code's."""
    a = 2 * np.pi * w020_waves * 4 * share

    def half(x: float) -> float:
        return np.cos(a * x) * np.sqrt(max(1 - (x + share) ** 2, 0.0))

    return 4 / np.pi * integrate.quad(half, 0.0, 1 - share, epsabs=1e-10, limit=400)[0]


def by_brute_force(wavefront: Wavefront, share: float, angle: float) -> complex:
    """The overlap of two discs row by row, each row by Gauss's rule: coordinates that don't know of the overlap's other
    rim.
    """
    node, weight = np.polynomial.legendre.leggauss(120)
    dx, dy = share * np.cos(angle), share * np.sin(angle)
    # across the frequency v = v_max sin(t), along it from rim to rim
    t = 0.5 * np.pi * node[:, None]
    v = np.sqrt(1 - share**2) * np.sin(t)
    reach = np.sqrt(1 - v**2) - share
    u = reach * node[None, :]
    area = 0.5 * np.pi * weight[:, None] * weight * np.sqrt(1 - share**2) * np.cos(t) * reach
    x, y = u * np.cos(angle) - v * np.sin(angle), u * np.sin(angle) + v * np.cos(angle)
    path = wavefront(x + dx, y + dy) - wavefront(x - dx, y - dy)
    return complex(np.sum(area * np.exp(-2j * np.pi / 0.55 * path))) / np.pi


def test_a_perfect_pupil_is_diffraction() -> None:
    f = np.linspace(0.0, 1.2, 50) * CUTOFF
    otf = pupil_otf(f, 0.3 * f, 550.0, 4.0, seidel())
    np.testing.assert_array_equal(otf, diffraction_otf(np.hypot(f, 0.3 * f), 550.0, 4.0))


@pytest.mark.parametrize("waves", [0.1, 0.5, 2.0, 8.0])
def test_defocus_is_hopkins_law(waves: float) -> None:
    share = np.array([0.01, 0.1, 0.3, 0.5, 0.8, 0.99])
    angle = np.linspace(0.0, 6.0, share.size)
    f = share * CUTOFF
    otf = pupil_otf(f * np.cos(angle), f * np.sin(angle), 550.0, 4.0, seidel(defocus_um=waves * 0.55))
    np.testing.assert_allclose(otf, [hopkins(s, waves) for s in share], atol=1e-6)


def test_a_tilt_moves_the_image() -> None:
    fx, fy = np.array([0.02, 0.1, 0.3]), np.array([0.05, -0.1, 0.02])
    otf = pupil_otf(fx, fy, 550.0, 4.0, Wavefront.of({(1, 0): 0.3, (0, 1): -0.1}))
    # W = a x moves the image by 2 N a: 2.4 um along x, -0.8 um along y.
    expected = diffraction_otf(np.hypot(fx, fy), 550.0, 4.0) * np.exp(-2j * np.pi * (fx * 2.4 + fy * -0.8))
    np.testing.assert_allclose(otf, expected, atol=1e-12)


WAVEFRONTS = {
    "spherical": seidel(defocus_um=-0.3, spherical_um=0.4),
    "astigmatism": seidel(defocus_um=0.1, astigmatism_um=0.4, astigmatism_deg=30.0),
    "coma": seidel(coma_um=(0.3, -0.1)),
    "all": seidel(defocus_um=0.2, spherical_um=-0.3, coma_um=(0.15, 0.2), astigmatism_um=0.2, astigmatism_deg=70.0),
    "trefoil": (zernike(3, 3) + zernike(5, -1)).scale(0.1).plus({(1, 0): 0.2}),
}


@pytest.mark.parametrize("name", WAVEFRONTS)
@pytest.mark.parametrize("many", [False, True], ids=["few", "many"])
def test_every_kind_of_wavefront_agrees_with_a_sum_over_rows(name: str, many: bool) -> None:
    """Both ways: each frequency integrated, and, of many, interpolated in a table."""
    wavefront = WAVEFRONTS[name]
    share, angle = np.array([0.02, 0.2, 0.45, 0.7, 0.95, 0.999]), np.array([0.1, 1.0, -2.0, 3.1, 4.4, 0.0])
    fx, fy = share * CUTOFF * np.cos(angle), share * CUTOFF * np.sin(angle)
    if many:
        # scattered ones, so that no few directions hold them
        fx, fy = (
            np.concatenate([f, f0]) for f, f0 in zip((fx, fy), np.random.default_rng(1).random((2, 2000)), strict=True)
        )
    otf = pupil_otf(fx, fy, 550.0, 4.0, wavefront)[:6]
    wanted = [by_brute_force(wavefront, s, a) for s, a in zip(share, angle, strict=True)]
    # the rows' own rule, and 3 waves of high order in a table: 1e-5; few at a time 1e-6
    np.testing.assert_allclose(otf, wanted, atol=1e-5 if many else 1e-6)


@pytest.mark.parametrize("name", WAVEFRONTS)
def test_frequencies_along_few_directions_agree_with_few_frequencies(name: str) -> None:
    """Expanded along each direction, for sizes below and above which a table is drawn through: to 1e-6."""
    f, wavefront = np.linspace(0.0, 1.05, 1000) * CUTOFF, WAVEFRONTS[name]
    cos, sin = np.cos([0.1, 1.7, -2.0]), np.sin([0.1, 1.7, -2.0])
    many = pupil_otf(np.outer(cos, f), np.outer(sin, f), 550.0, 4.0, wavefront)
    few = pupil_otf(np.outer(cos, f[::25]), np.outer(sin, f[::25]), 550.0, 4.0, wavefront)
    np.testing.assert_allclose(many[:, ::25], few, atol=1e-6)
    if wavefront.is_isotropic:
        tiled = pupil_otf(np.tile(f, 40), np.zeros(40_000), 550.0, 4.0, wavefront)
        np.testing.assert_allclose(tiled[:1000], many[0], atol=1e-6)


def test_aberrations_agree_with_a_sampled_pupil() -> None:
    """The squared modulus of the pupil's FFT on 1024 x 1024 points, padded: good to the rim's staircase, 1e-3."""
    wavefront = seidel(defocus_um=0.1, spherical_um=0.2, coma_um=(0.15, 0.05), astigmatism_um=0.1, astigmatism_deg=30)
    size, radius = 1024, 250
    y, x = (np.mgrid[:size, :size] - size / 2) / radius
    pupil = (np.hypot(x, y) <= 1) * np.exp(2j * np.pi / 0.55 * wavefront(x, y))
    spread = np.abs(np.fft.fft2(pupil)) ** 2
    # One step of the autocorrelation is 1/radius of the pupil: a share 1/(2 radius) of the cutoff.
    auto = np.fft.fft2(spread)
    auto /= auto[0, 0]
    for i, j in [(0, 40), (40, 0), (100, 60), (-80, 200), (0, 400)]:
        share = np.array([j, i]) / (2 * radius) * CUTOFF
        assert pupil_otf(share[0], share[1], 550.0, 4.0, wavefront) == pytest.approx(auto[i, j], abs=2e-3)


def test_no_aberration_raises_contrast() -> None:
    f = np.linspace(0.0, 1.0, 40) * CUTOFF
    otf = pupil_otf(f, 0 * f, 550.0, 4.0, seidel(spherical_um=0.3, coma_um=(0.2, 0.0)))
    assert np.all(np.abs(otf) <= diffraction_otf(f, 550.0, 4.0) + 1e-6)


def test_ratio_is_real_for_even_wavefronts_and_one_where_nothing_passes() -> None:
    f = np.array([0.0, 0.3, 1.0, 1.5]) * CUTOFF
    even = pupil_ratio(f, 0 * f, 550.0, 4.0, seidel(spherical_um=0.3, astigmatism_um=0.2))
    odd = pupil_ratio(f, 0 * f, 550.0, 4.0, seidel(coma_um=(0.3, 0.0)).plus({(1, 0): 0.2}))
    assert even.dtype == float
    assert odd.dtype == complex
    for ratio in (even, odd):
        assert ratio[0] == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_array_equal(ratio[2:], 1.0)
    # a real image: H(-f) is the conjugate
    np.testing.assert_allclose(
        pupil_ratio(-f, 0 * f, 550.0, 4.0, seidel(coma_um=(0.3, 0.0))),
        np.conj(pupil_ratio(f, 0 * f, 550.0, 4.0, seidel(coma_um=(0.3, 0.0)))),
        atol=1e-12,
    )


def test_zernike_polynomials_are_orthonormal() -> None:
    node, weight = np.polynomial.legendre.leggauss(20)
    radius, phi = np.sqrt(0.5 * (node + 1)), np.arange(32) * 2 * np.pi / 32
    x, y = np.outer(radius, np.cos(phi)), np.outer(radius, np.sin(phi))
    all_of_them = np.array([zernike(*osa_order(j))(x, y) for j in range(36)])
    gram = np.einsum("iab,jab,a->ij", all_of_them, all_of_them, weight / 64)
    np.testing.assert_allclose(gram, np.eye(36), atol=1e-12)


def test_index_schemes_are_the_published_ones() -> None:
    """Noll (1976), table I; ANSI Z80.28, table 1."""
    noll = [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3), (4, 0), (4, 2), (4, -2),
            (4, 4), (4, -4)]  # fmt: skip
    assert [noll_order(j) for j in range(1, 16)] == noll
    osa = [(n, m) for n in range(6) for m in range(-n, n + 1, 2)]
    assert [osa_order(j) for j in range(len(osa))] == osa
    # primary spherical aberration: sqrt(5) (6 r^4 - 6 r^2 + 1)
    r = np.linspace(0.0, 1.0, 5)
    np.testing.assert_allclose(zernike(4, 0)(r, 0 * r), np.sqrt(5) * (6 * r**4 - 6 * r**2 + 1), atol=1e-12)


@pytest.mark.parametrize("order", [(2, 1), (1, 2), (3, -5)])
def test_orders_that_arent_are_refused(order: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="even and >= 0"):
        zernike(*order)


def test_wavefronts_add_and_know_their_symmetry() -> None:
    both = seidel(spherical_um=0.2) + seidel(defocus_um=0.1, coma_um=(0.0, 0.3))
    x, y = np.array([0.3, -0.5]), np.array([0.2, 0.1])
    r2 = x**2 + y**2
    np.testing.assert_allclose(both(x, y), 0.2 * r2**2 + 0.1 * r2 + 0.3 * r2 * y, rtol=1e-12)
    assert [w.is_isotropic for w in (seidel(), seidel(spherical_um=1.0, defocus_um=2.0), zernike(6, 0))] == [True] * 3
    assert not any(w.is_isotropic for w in (both, zernike(2, 2), zernike(4, -4), Wavefront.of({(1, 1): 0.1})))
    assert all(seidel(astigmatism_um=a, astigmatism_deg=d).is_isotropic == (a == 0.0) for a,
               d in product((0.0, 0.1), (0.0, 20.0)))  # fmt: skip


def test_one_table_serves_all_sizes_and_wavelengths_of_a_shape() -> None:
    """The table's expansion against the overlap integrated anew: sizes in every octave of it and beyond, wavelengths at
    random.
    """
    rng = np.random.default_rng(4)
    share = np.linspace(0.05, 0.95, 19)
    for waves in (0.03, 0.125, 0.2, 0.4, 0.9, 1.7):
        wavelength_um = float(rng.uniform(0.4, 0.7))
        bend = seidel(
            coma_um=(0.8 * waves * wavelength_um, 0.6 * waves * wavelength_um), spherical_um=0.1 * wavelength_um
        )
        exact = _mean(share, np.full(19, np.cos(0.3)), np.full(19, np.sin(0.3)), wavelength_um, bend)
        assert np.allclose(_ratio_along(share, 0.3, wavelength_um, bend), exact, atol=1e-6)
    _octave.cache_clear()
    for size_um in (0.02, 0.03, 0.06):
        _ratio_along(share, 0.3, 0.5, seidel(spherical_um=size_um / 2))
    assert _octave.cache_info().misses == 1
