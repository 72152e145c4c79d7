from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from sim.optics.diffraction import diffraction_otf
from sim.optics.pupil import pupil_otf, seidel

CUTOFF = 1 / (0.55 * 4.0)


def hopkins(share: float, w020_waves: float) -> float:
    """Defocus by Hopkins's single integral (1955), with another rule and in other coordinates than the code's."""
    a = 2 * np.pi * w020_waves * 4 * share

    def half(x: float) -> float:
        return np.cos(a * x) * np.sqrt(max(1 - (x + share) ** 2, 0.0))

    return 4 / np.pi * integrate.quad(half, 0.0, 1 - share, epsabs=1e-10, limit=400)[0]


def test_a_perfect_pupil_is_diffraction() -> None:
    f = np.linspace(0.0, 1.2, 50) * CUTOFF
    otf = pupil_otf(f, 0.3 * f, 550.0, 4.0, seidel())
    np.testing.assert_allclose(otf, diffraction_otf(np.hypot(f, 0.3 * f), 550.0, 4.0), atol=1e-6)


@pytest.mark.parametrize("waves", [0.1, 0.5, 2.0, 8.0])
def test_defocus_is_hopkins_law(waves: float) -> None:
    share = np.array([0.01, 0.1, 0.3, 0.5, 0.8, 0.99])
    angle = np.linspace(0.0, 6.0, share.size)
    f = share * CUTOFF
    otf = pupil_otf(f * np.cos(angle), f * np.sin(angle), 550.0, 4.0, seidel(defocus_um=waves * 0.55))
    np.testing.assert_allclose(otf, [hopkins(s, waves) for s in share], atol=1e-6)


def test_a_tilt_moves_the_image() -> None:
    fx, fy = np.array([0.02, 0.1, 0.3]), np.array([0.05, -0.1, 0.02])
    otf = pupil_otf(fx, fy, 550.0, 4.0, lambda x, y: 0.3 * x - 0.1 * y)
    # W = a x moves the image by 2 N a: 2.4 um along x, -0.8 um along y.
    expected = diffraction_otf(np.hypot(fx, fy), 550.0, 4.0) * np.exp(-2j * np.pi * (fx * 2.4 + fy * -0.8))
    np.testing.assert_allclose(otf, expected, atol=1e-6)


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
