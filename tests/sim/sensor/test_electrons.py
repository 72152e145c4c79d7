"""From electrons to codes: moments of clipped and rounded noise, dark current, fixed patterns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sim.camera import CameraModel
from sim.sensor import mosaic
from sim.sensor.electrons import (
    FixedPattern,
    ReadOut,
    clip_moments,
    dark_current_e_per_s,
    dn_moments,
    encode_moments,
    gain_dn_per_e,
    sample_from,
)
from sim.sensor.shot import FROM_NORMAL, draw_poisson


@pytest.mark.parametrize(("lower", "upper"), [(-np.inf, 1.0), (0.0, np.inf), (-0.5, 0.7), (3.0, 4.0)])
def test_moments_of_a_clipped_normal_variable(lower: float, upper: float) -> None:
    z = stats.norm(0.3, 1.7)
    x = np.linspace(0.3 - 12 * 1.7, 0.3 + 12 * 1.7, 400_001)
    weight, clipped = z.pdf(x) * (x[1] - x[0]), np.clip(x, lower, upper)
    mean, variance = clip_moments(np.array([0.3]), np.array([1.7**2]), lower, upper)
    # A sum at steps of 1e-4 with kinks at the limits errs by about the step squared.
    assert mean[0] == pytest.approx(weight @ clipped, abs=1e-7)
    assert variance[0] == pytest.approx(weight @ clipped**2 - (weight @ clipped) ** 2, abs=1e-6)


def test_far_from_the_limits_nothing_changes_to_the_last_bit() -> None:
    mean, variance = clip_moments(np.array([500.1]), np.array([33.3]), 0.0, 4095.0)
    assert (mean[0], variance[0]) == (500.1, 33.3)


@pytest.mark.parametrize("sigma", [0.05, 0.3, 0.35, 0.8, 0.89, 0.91, 1.1, 3.0])
@pytest.mark.parametrize("mean", [-0.7, 0.0, 0.4, 2.3, 7.5, 9.9, 10.3, 19.8, 20.6])
def test_moments_of_codes(mean: float, sigma: float) -> None:
    """Against the sum over all codes 0..20 of a normal variable's probabilities."""
    codes = np.arange(21)
    up_to = stats.norm(mean, sigma).cdf(codes + 0.5)
    up_to[-1] = 1.0
    share = np.diff(up_to, prepend=0.0)
    found_mean, found_variance = encode_moments(np.array([mean]), np.array([sigma**2]), 20.0)
    # 1e-3 DN at a limit is what the two terms of Euler and Maclaurin leave.
    assert found_mean[0] == pytest.approx(share @ codes, abs=1e-3)
    assert found_variance[0] == pytest.approx(share @ codes**2 - (share @ codes) ** 2, abs=2e-3)


def test_wide_noise_is_rounded_for_a_twelfth() -> None:
    mean, variance = encode_moments(np.array([100.3]), np.array([2.0]), 4095.0)
    assert (mean[0], variance[0]) == (100.3, 2.0 + 1.0 / 12.0)


def test_dark_current_doubles(colour_camera: CameraModel) -> None:
    camera = colour_camera.model_copy(update={"dark_current_doubling_c": 7.0, "dark_current_reference_c": 30.0})
    assert dark_current_e_per_s(camera) == dark_current_e_per_s(camera, 30.0) == 3.0
    assert dark_current_e_per_s(camera, 44.0) == pytest.approx(12.0)
    assert dark_current_e_per_s(colour_camera, 60.0) == 3.0  # no doubling is known


@pytest.mark.parametrize("level_e", [0.0, 2.0, 50.0, 3000.0, 10_480.0, 11_500.0])
def test_frames_have_the_moments(colour_camera: CameraModel, level_e: float) -> None:
    camera = colour_camera.model_copy(update={"rows": 300, "cols": 400, "black_level_dn": 2.0, "read_noise_e": 4.0})
    electrons = np.full((300, 400), level_e)
    mean, variance = (float(m[0, 0]) for m in dn_moments(electrons, camera, 3.0))
    frame = sample_from(electrons, camera, np.random.default_rng(7), gain_db=3.0).astype(float)
    n = frame.size
    # Rounding is uniform noise only where the noise is wide against a code (here 1.9 DN at least, clipped at black): 1
    # %.
    assert frame.mean() == pytest.approx(mean, abs=4.5 * np.sqrt(variance / n) + 0.01)
    kurtosis = 3.0 if level_e < 10_000 else 12.0
    assert frame.var() == pytest.approx(variance, rel=4.5 * np.sqrt((kurtosis - 1) / n) + 0.02, abs=1e-3)


def test_gain_in_db_is_of_amplitude(colour_camera: CameraModel) -> None:
    assert gain_dn_per_e(colour_camera, 20.0) == pytest.approx(3.5)
    mean, variance = dn_moments(np.array([[100.0]]), colour_camera, 6.0)
    gain = 0.35 * 10 ** (6 / 20)
    assert mean[0, 0] == pytest.approx(240 + 100 * gain)
    assert variance[0, 0] == pytest.approx((100 + 2.5**2) * gain**2 + 1 / 12)


def test_fixed_patterns_stay_and_have_their_size(colour_camera: CameraModel) -> None:
    camera = colour_camera.model_copy(update={"rows": 200, "cols": 300})
    rng = np.random.default_rng(8)
    pattern = FixedPattern.draw(camera, rng)
    n = pattern.prnu.size
    assert pattern.prnu.std() == pytest.approx(0.008, rel=4 / np.sqrt(2 * n))
    assert pattern.dsnu_e.std() == pytest.approx(1.0, rel=4 / np.sqrt(2 * n))
    electrons = np.full(pattern.prnu.shape, 5000.0)
    mean = np.mean([sample_from(electrons, camera, rng, pattern, dark_electrons=5.0) for _ in range(30)], axis=0)
    wanted = 240 + 0.35 * (5000 + 4995 * pattern.prnu + pattern.dsnu_e)
    # What 30 frames of shot and read noise and rounding leave.
    error = np.sqrt((0.35**2 * (5000 + 2.5**2) + 1 / 12) / 30)
    assert np.std(mean - wanted) == pytest.approx(error, rel=4 / np.sqrt(2 * n))


def test_dark_frames_keep_their_mean_under_dsnu(colour_camera: CameraModel) -> None:
    """DSNU is an offset behind the shot noise: it doesn't bend at 0 electrons."""
    camera = colour_camera.model_copy(update={"rows": 200, "cols": 300, "dsnu_e": 20.0})
    pattern = FixedPattern(prnu=np.zeros((200, 300)), dsnu_e=np.tile([-20.0, 20.0], (200, 150)))
    frame = sample_from(np.full((200, 300), 0.1), camera, np.random.default_rng(9), pattern, dark_electrons=0.1)
    assert frame[:, ::2].mean() == pytest.approx(240 + 0.35 * (0.1 - 20), abs=0.05)
    assert frame[:, 1::2].mean() == pytest.approx(240 + 0.35 * (0.1 + 20), abs=0.05)


def test_read_out_response_and_noise_are_in_the_moments(colour_camera: CameraModel) -> None:
    camera = colour_camera.model_copy(update={"rows": 200, "cols": 300})
    read_out = ReadOut(lambda e: e * (1 - 1e-5 * e), lambda e: e * 0.9, 3.0)
    electrons = np.full((200, 300), 6000.0)
    mean, variance = (float(m[0, 0]) for m in dn_moments(electrons, camera, 0.0, read_out))
    assert mean == pytest.approx(243 + 0.35 * 6000 * 0.94)
    # The slope is taken over 0.1 % of the signal, 6 e: 1 - 2e-5 x 6003.
    assert variance == pytest.approx(0.35**2 * (5400 * (1 - 0.12) ** 2 + 2.5**2) + 1 / 12, rel=3e-4)
    frame = sample_from(electrons, camera, np.random.default_rng(10), read_out=read_out).astype(float)
    n = frame.size
    # The bend takes 1e-5 x var = 0.05 e off the mean of noisy electrons: 0.02 DN.
    assert frame.mean() == pytest.approx(mean, abs=4.5 * np.sqrt(variance / n) + 0.02)
    assert frame.var() == pytest.approx(variance, rel=4.5 * np.sqrt(2 / n))


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_impossible_electrons_are_named(colour_camera: CameraModel, bad: float) -> None:
    electrons = np.full((72, 96), 10.0)
    electrons[3, 4] = bad
    for call in (
        lambda: dn_moments(electrons, colour_camera),
        lambda: sample_from(electrons, colour_camera, np.random.default_rng(1)),
    ):
        with pytest.raises(
            ValueError, match=r"mean electrons of a pixel are .* e, below the limit of 0 e or not finite: check"
        ):
            call()


# --- Shot noise is Poisson, at every mean -----------------------------------------------------------------------------


@pytest.mark.parametrize("mean", [0.0, 0.3, 1.0, 2.7, FROM_NORMAL - 0.01, FROM_NORMAL, 10.3, 17.7, 64.2, 300.0, 9000.0])
def test_counts_are_poisson(mean: float) -> None:
    """A chi-squared test of all counts that are wanted 20 times and more, at 4.5 standard deviations; 2e6 draws."""
    n, mean = 2_000_000, float(np.float32(mean))
    drawn = draw_poisson(np.full(n, mean, np.float32), np.random.default_rng(3)).astype(int)
    counts = np.bincount(drawn)
    wanted = stats.poisson(mean).pmf(np.arange(counts.size)) * n
    often = wanted > 20
    chi2 = float(np.sum((counts[often] - wanted[often]) ** 2 / wanted[often]))
    assert chi2 <= often.sum() + 4.5 * np.sqrt(2.0 * often.sum())
    if mean > 0:
        assert drawn.mean() == pytest.approx(mean, abs=4.5 * np.sqrt(mean / n))


def test_means_may_differ_from_pixel_to_pixel() -> None:
    mean = np.linspace(0.0, 40.0, 400_000, dtype=np.float32).reshape(400, 1000)
    drawn = draw_poisson(mean, np.random.default_rng(4))
    assert drawn.shape == mean.shape and drawn.dtype == np.float32
    assert np.all(drawn == np.floor(drawn))
    # Each row of 1000 draws by its own mean: chi-squared with 400 degrees of freedom (the first row's mean is near 0).
    pull = (drawn.mean(axis=1) - mean.mean(axis=1)) / np.sqrt(mean.mean(axis=1) / 1000)
    assert np.sum(pull**2) == pytest.approx(400, abs=4.5 * np.sqrt(800))


def test_the_means_are_left_as_they_are() -> None:
    mean = np.full((3, 4), 20.0, np.float32)
    mean.flags.writeable = False
    assert draw_poisson(mean, np.random.default_rng(5)).shape == (3, 4)
    assert draw_poisson(np.empty((0, 4), np.float32), np.random.default_rng(5)).shape == (0, 4)


# --- Colour filter mosaics: phases, planes, channels ------------------------------------------------------------------


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_phases_spell_the_mosaic(cfa: str) -> None:
    places = {place: channel for channel, where in mosaic.phases(cfa).items() for place in where}
    assert "".join(places[i, j] for i in (0, 1) for j in (0, 1)) == cfa
    red_row = mosaic.phases(cfa)["R"][0][0]
    assert [row == red_row for row, _ in mosaic.phases(cfa)["G"]] == [True, False]


def test_planes_are_views_and_assemble_puts_them_back() -> None:
    frame = np.arange(6 * 8).reshape(6, 8)
    planes = mosaic.planes(frame, "GBRG")
    assert list(planes) == ["R", "G1", "G2", "B"]
    assert planes["G2"][0, 0] == 0 and planes["B"][0, 0] == 1 and planes["R"][0, 0] == 8 and planes["G1"][0, 0] == 9
    assert all(np.shares_memory(plane, frame) for plane in planes.values())
    images = {"R": frame, "G": frame + 100, "B": frame + 200}
    together = mosaic.planes(mosaic.assemble(images, "GBRG"), "GBRG")
    for name, plane in planes.items():
        np.testing.assert_array_equal(together[name], plane + {"R": 0, "G": 100, "B": 200}[name[0]])


def test_mono_has_one_plane() -> None:
    frame = np.arange(6).reshape(2, 3)
    assert mosaic.phases("MONO") == {"Y": [(0, 0)]}
    np.testing.assert_array_equal(mosaic.planes(frame, "MONO")["Y"], frame)
    np.testing.assert_array_equal(mosaic.assemble({"Y": frame}, "MONO"), frame)


def test_missing_or_unequal_channels_are_named() -> None:
    frame = np.zeros((2, 2))
    with pytest.raises(ValueError, match="no image came for B"):
        mosaic.assemble({"R": frame, "G": frame}, "RGGB")
    with pytest.raises(ValueError, match="differ in shape"):
        mosaic.assemble({"R": frame, "G": frame, "B": np.zeros((4, 4))}, "RGGB")
