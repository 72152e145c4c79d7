"""The independent simulator against analytic limits, so that its truths are right."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j1

from evaluation.draw import recordings_of
from evaluation.independent_simulator import LISTED, OUTSIDE, WAVELENGTH_NM, ConcealedCamera, Law, Plan
from evaluation.independent_simulator.camera import poisson
from evaluation.independent_simulator.laws import (
    AstigmatismLaw,
    ChargeDiffusionLaw,
    ComaLaw,
    DefocusLaw,
    OpticalLowPassFilterLaw,
    SphericalAberrationLaw,
    VeilingGlareLaw,
)
from evaluation.independent_simulator.scenes import edge, pattern
from lab.fit.mtf import edge_mtf

LINE = np.where(WAVELENGTH_NM == 555.0, 1.0, 0.0)  # W sr^-1 m^-2 in one nm, at a node of the simulator's wavelengths
LAMP = np.full_like(WAVELENGTH_NM, 0.02)
FREQUENCY = np.linspace(0.0, 1.0, 21)


def mono(*laws: Law, seed: int = 31, rows: int = 96, cols: int = 128) -> ConcealedCamera:
    return ConcealedCamera(seed, laws, cfa="MONO", rows=rows, cols=cols)


def without_aperture(camera: ConcealedCamera, f: np.ndarray, angle: float = 0.0) -> np.ndarray:
    side = np.sqrt(camera.fill_factor) * camera.pitch_um
    across = np.sinc(side * f / camera.pitch_um * np.cos(angle)) * np.sinc(side * f / camera.pitch_um * np.sin(angle))
    return camera.lens.otf(f, angle, LINE, "Y") / across


def test_electrons_are_the_photons_of_a_line_times_efficiency() -> None:
    """555 nm: radiance L through an f/N cone of sin^2 = 1 / (4 N^2 + 1), on the pixel's sensitive area."""
    camera = mono()
    photon_j = 6.62607015e-34 * 2.99792458e8 / 555e-9
    area = camera.fill_factor * (camera.pitch_um * 1e-6) ** 2
    irradiance = np.pi * 1e-3 * camera.lens_transmittance / (4 * camera.f_number**2 + 1)
    expected = irradiance * area / photon_j * np.interp(555.0, WAVELENGTH_NM, camera.quantum_efficiency["Y"])
    assert camera.rate(1e-3 * LINE, "Y") == pytest.approx(expected, rel=1e-6)


def test_flat_frames_hold_that_energy() -> None:
    camera = mono()
    t = camera.exposure_for(LAMP, 0.5)
    dn = camera.expose(camera.uniform(LAMP), t, 0).astype(float)
    electrons = camera.rate(LAMP, "Y") * t * (camera.shading * camera.prnu_map).mean() + camera.dark_e_per_s * t
    # the fixed pattern's own mean stays; noise of the mean: sqrt(e + read^2) / sqrt(N) electrons
    expected = camera.black_level_dn + camera.gain_dn_per_e * (electrons + camera.dsnu_map_e.mean())
    std = camera.gain_dn_per_e * np.sqrt((electrons + camera.read_noise_e**2) / dn.size)
    assert abs(dn.mean() - expected) < 4 * std


def test_noise_is_poisson_s_and_the_read_out_s() -> None:
    camera = mono()
    t = camera.exposure_for(LAMP, 0.5)
    first, second = (camera.expose(camera.uniform(LAMP), t, k).astype(float) for k in (0, 1))
    electrons = camera.rate(LAMP, "Y") * t * (camera.shading * camera.prnu_map).mean() + camera.dark_e_per_s * t
    expected = camera.gain_dn_per_e**2 * (electrons + camera.read_noise_e**2) + 1 / 12  # rounding's variance
    # of N differences the variance is known to sqrt(2 / N)
    assert np.var(second - first) / 2 == pytest.approx(expected, rel=4 * np.sqrt(2 / first.size))


@pytest.mark.parametrize("mean", [0.3, 5.0, 59.0, 61.0, 1000.0])
def test_poisson_numbers_have_their_mean_and_variance(mean: float) -> None:
    z = np.random.default_rng(5).standard_normal(40_000)
    drawn = poisson(np.full(z.shape, mean), z)
    assert np.all(drawn == np.floor(drawn))
    assert abs(drawn.mean() - mean) < 4 * np.sqrt(mean / z.size)
    # the sample variance of a Poisson number has variance m^2 (2 + 1 / m) / N; the skewed normal's is good to 1e-3
    assert abs(drawn.var() / mean - 1) < 4 * np.sqrt((2 + 1 / mean) / z.size) + 1e-3


def test_more_light_never_leaves_fewer_electrons_in_the_same_draw() -> None:
    z = np.random.default_rng(6).standard_normal(4000)
    means = np.geomspace(0.1, 1e4, 60)
    drawn = np.array([poisson(np.full(z.shape, m), z) for m in means])
    assert np.all(np.diff(drawn, axis=0) >= 0)


def test_a_perfect_lens_has_the_airy_transfer() -> None:
    camera = mono()
    cutoff = camera.pitch_um / (0.555 * camera.f_number)
    # (2 / pi) (acos s - s sqrt(1 - s^2)) at half the cutoff: 0.39100
    assert without_aperture(camera, np.array([0.5 * cutoff]))[0].real == pytest.approx(0.39100, abs=1e-5)
    assert abs(camera.lens.otf(np.array([1.01 * cutoff]), 0.3, LINE, "Y")[0]) < 1e-12


def test_the_pupil_s_overlap_without_aberration_is_the_same() -> None:
    perfect, numeric = mono(), mono(SphericalAberrationLaw(1e-9))
    # 20 Gauss nodes over chords that end vertically: 2e-4
    for angle in (0.0, 0.7):
        a, b = (without_aperture(c, FREQUENCY, angle) for c in (perfect, numeric))
        assert np.abs(a - b).max() < 1e-3


def test_strong_defocus_blurs_by_a_disc() -> None:
    """Geometrical limit: a disc of diameter dz / N, 2 J1(q) / q with q = pi D f; the axis between the sphere and the
    parabola."""
    camera = ConcealedCamera(31, [DefocusLaw(60.0, 1)], cfa="MONO", f_number=2.0, rows=32, cols=32)
    f = np.array([0.01, 0.02, 0.03, 0.04])
    q = np.pi * 60.0 / camera.f_number * f / camera.pitch_um
    blur = without_aperture(camera, f).real / ConcealedCamera(
        31, cfa="MONO", f_number=2.0, rows=32, cols=32
    ).lens.diffraction(f / camera.pitch_um, 0.555)
    assert blur == pytest.approx(2 * j1(q) / q, abs=0.02)


@pytest.mark.parametrize("f_number", [2.8, 4.0, 8.0])
@pytest.mark.parametrize(
    ("law", "power", "slope"),
    [
        (SphericalAberrationLaw(1.2), 4, 2.0),
        (SphericalAberrationLaw(1.2, 1), 4, None),
        (AstigmatismLaw(1.2), 2, 1.0),
        (ComaLaw(1.2), 3, 0.5),
        (ComaLaw(1.2, 1), 3, 0.5),
        (DefocusLaw(1.2 * 128.0, 1), 2, 1.0),
        (DefocusLaw(1.2 * 128.0, 2), 2, None),
    ],
)
def test_aberrations_follow_the_pupil_as_the_seidel_sums_do(
    law: Law, power: int, slope: float | None, f_number: float
) -> None:
    """Rays land 2 N dW/dx off: at low frequencies the contrast is 1 - 2 pi^2 f^2 (2 N)^2 <(dW/dx)^2> about the mean,
    which over the pupil is 2 W^2 of W r^4, W^2 of W (x^2 - y^2) and of W r^2, W^2 / 2 of W r^2 x along x, W (4 / N)^k.
    The overlap of the pupils leaves out 3 % at 0.01 of the cutoff."""
    n, share = f_number, 4.0 / f_number
    if slope is None:  # radial: <(W' cos)^2> = the integral of W'^2 r, W' by the terms' own powers
        r = np.linspace(0.0, 1.0, 2001)
        by_term = {4: 1.2, 6: 0.24} if isinstance(law, SphericalAberrationLaw) else {2: 0.9 * 1.2, 4: 0.1 * 1.2}
        steep = sum(w * share**k * k * r ** (k - 1) for k, w in by_term.items())
        rms_um = 2.0 * n * float(np.sqrt(np.trapezoid(steep**2 * r, r)))
    else:
        rms_um = 2.0 * n * 1.2 * share**power * np.sqrt(slope)
    law_there, plain = (
        ConcealedCamera(31, laws, cfa="MONO", f_number=n, rows=32, cols=32, stated_f_number=4.0) for laws in ([law], [])
    )
    along = 2.0 * np.pi * float(law.uniform[0]) if isinstance(law, ComaLaw) else 0.0
    f = np.array([min(0.02 / rms_um, 0.01 / (0.555 * n))])
    spread = law_there.lens._pupil(f, along, 555.0) / plain.lens.diffraction(f, 0.555)
    level = law_there.lens._pupil(0.0 * f, along, 555.0)
    assert 1.0 - abs(spread[0] / level[0]) == pytest.approx(2.0 * np.pi**2 * f[0] ** 2 * rms_um**2, rel=0.06)


def test_a_split_has_its_null_and_diffusion_its_gaussian() -> None:
    split, plain, spread = mono(OpticalLowPassFilterLaw(2.0)), mono(), mono(ChargeDiffusionLaw(0.8, 0))
    null = np.array([plain.pitch_um / (2 * 2.0)])
    assert abs(split.lens.otf(null, 0.0, LAMP, "Y")[0]) < 1e-9
    ratio = spread.lens.otf(FREQUENCY[:10], 0.4, LAMP, "Y") / plain.lens.otf(FREQUENCY[:10], 0.4, LAMP, "Y")
    assert ratio == pytest.approx(np.exp(-2 * (np.pi * 0.8 * FREQUENCY[:10] / plain.pitch_um) ** 2), abs=1e-9)


def test_an_edge_has_the_transfer_it_was_made_from() -> None:
    """Through the slanted-edge estimator, within four of its standard uncertainties and 0.003 for the short region's
    levels."""
    camera = mono(rows=200, cols=200)
    frequency = np.arange(1, 11) * 0.05
    light = edge(camera, 5.0, LAMP, 0.08)["Y"] / camera.rate(LAMP, "Y")
    noisy = np.random.default_rng(8).poisson(20_000.0 * light).astype(float)
    found = edge_mtf(noisy[10:-10, 10:-10], frequency)
    truth = np.abs(camera.lens.otf(frequency, np.deg2rad(5.0), LAMP, "Y"))
    assert np.all(np.abs(found.mtf - truth) < 4 * found.mtf_std + 0.003)


def test_a_pattern_keeps_its_light() -> None:
    """All lit, the middle has the rate itself; the sum over a pattern is that of its cells, but for what leaves at the
    rim."""
    camera = mono(DefocusLaw(12.0))
    white = pattern(camera, np.ones((80, 104)), LAMP, 0.0)["Y"]
    assert white[48, 64] == pytest.approx(camera.rate(LAMP, "Y"), rel=1e-6)
    dot = np.zeros((80, 104))
    dot[38:42, 50:54] = 1.0
    lit = pattern(camera, dot, LAMP, 0.0)["Y"].sum() / camera.rate(LAMP, "Y")
    assert lit == pytest.approx(16 * 4.0**2, rel=0.01)  # the turned square's rim on the fine grid


@pytest.mark.parametrize("turn_deg", [0.0, 0.07, 0.6])
@pytest.mark.parametrize("cell_px", [4.0, 4.1])
def test_a_pattern_of_stripes_is_its_fourier_series(cell_px: float, turn_deg: float) -> None:
    """Stripes are a square wave: each odd harmonic n, of amplitude 2 / (pi n), passes the lens by its own transfer.

    Cells of a whole number of pixels that stand square alias alike all over the frame. The blur (0.37 px) leaves
    nothing above 2 cy/px, the highest frequency of the grid."""
    camera = mono(ChargeDiffusionLaw(0.37 * mono().pitch_um, 0, 1), rows=48, cols=256)
    stripes = np.tile(np.arange(80.0) % 2, (60, 1))
    seen = pattern(camera, stripes, LAMP, 0.0, cell_px, turn_deg)["Y"] / camera.rate(LAMP, "Y")
    turn = np.deg2rad(turn_deg)
    down, right = (at - 0.5 * (n - 1) for at, n in zip(np.indices(seen.shape), seen.shape, strict=True))
    phase = np.pi * (down * np.sin(turn) + right * np.cos(turn)) / cell_px
    harmonic = np.arange(1, 4.0 * cell_px, 2.0)
    frequency = harmonic / (2.0 * cell_px)
    amplitude = 2.0 / (np.pi * harmonic) * camera.lens.otf(frequency, turn, LAMP, "Y")
    series = 0.5 - np.tensordot(amplitude, np.sin(np.multiply.outer(harmonic, phase)), 1)
    middle = (slice(12, -12), slice(80, -80))  # the lens's tails carry the continued border less than 1e-4 so far
    # 16 samples a pixel: harmonics at 16 m -+ f cy/px, weaker by f / 16 m and passed by f / 16 m, alias to f; the sum
    # of 1 / m^2 is pi^2 / 6
    aliased = float(np.sum(np.abs(amplitude) * 2.0 * np.square(frequency / 16.0))) * np.pi**2 / 6.0
    assert np.abs(seen - series)[middle].max() < aliased + 1e-4


def test_glare_moves_light_and_makes_none() -> None:
    camera = mono(VeilingGlareLaw(3.0))
    image = np.random.default_rng(1).random((96, 128))
    for law in camera.laws:
        assert law.image(image).mean() == pytest.approx(image.mean(), rel=1e-12)


@pytest.mark.parametrize("kind", [*LISTED, *OUTSIDE], ids=lambda kind: kind.__name__)
def test_a_law_changes_frames_and_nothing_else(kind: type[Law]) -> None:
    cfa = "RGGB" if kind.needs == "bayer" else "MONO"
    shown = {"screen" if k == "checkerboard" else k for k in kind.shown_by}
    plan = Plan(("dark", *sorted(shown - {"dark"})), warm=True, repeats=2)
    healthy = recordings_of(ConcealedCamera(5, cfa=cfa, rows=32, cols=40), plan)
    other = recordings_of(ConcealedCamera(5, [kind(kind.nominal, 0, 9)], cfa=cfa, rows=32, cols=40), plan)
    assert other.manifest == healthy.manifest
    for path in healthy.manifest.cameras["left"].quantum_efficiency.values():
        assert other.spectrum(path) == healthy.spectrum(path)
    captures = healthy.manifest.captures
    assert any(np.any(other.frame(c) != healthy.frame(c)) for c in captures)


def test_there_are_enough_of_them() -> None:
    assert len(LISTED) >= 35
    assert len(OUTSIDE) >= 15
    names = [kind.name for kind in (*LISTED, *OUTSIDE)]
    assert len(set(names)) == len(names)
    assert all(kind.effect is None for kind in OUTSIDE)
