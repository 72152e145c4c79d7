"""Effects on charge and read-out beyond the contract of all effects: their analytic limits, and frames that agree with
their moments.
"""

from __future__ import annotations

import numpy as np
import pytest

from sim.camera import CameraModel, Lens
from sim.effects.adc_nonlinearity import AdcNonlinearity
from sim.effects.adc_ripple import AdcRipple
from sim.effects.amplifier_glow import AmplifierGlow
from sim.effects.base import Effect
from sim.effects.blooming import Blooming
from sim.effects.brighter_fatter import BrighterFatter
from sim.effects.column_noise import ColumnNoise
from sim.effects.dark_current_temperature import DarkCurrentTemperature
from sim.effects.green_imbalance import GreenImbalance
from sim.effects.hot_pixels import HotPixels
from sim.effects.image_lag import ImageLag
from sim.effects.light_flicker import LightFlicker
from sim.effects.random_telegraph_noise import RandomTelegraphNoise
from sim.effects.row_noise import RowNoise
from sim.frame import (
    Exposure,
    collected_mosaic,
    dark_electrons,
    expect_sequence,
    expected_electrons,
    moments,
    predict_frame,
    sample,
    sample_sequence,
)
from sim.scene.scenes import Darkness, UniformField
from sim.sensor.mosaic import planes
from sim.spectrum import FloatArray, Spectrum
from sim.stages import charge_of, codes_of, signal_of
from sim.uniform import Uniform

LIGHT = Spectrum.of([500.0, 600.0], [2e-3, 2e-3])
CAMERA = CameraModel(
    rows=48, cols=64, pixel_pitch_um=3.45, fill_factor=1.0, cfa="MONO", bit_depth=12, black_level_dn=100.0,
    white_level_dn=4095.0,
    conversion_gain_dn_per_e=0.5, full_well_e=7500.0, read_noise_e=2.0, dark_current_e_per_s=10.0, dsnu_e=0.0,
    prnu_percent=0.0,
    quantum_efficiency={"Y": Spectrum.of([400.0, 700.0], [0.5, 0.5])}, lens=Lens(f_number=4.0, focal_length_mm=50.0),
)  # fmt: skip
BRIGHT, DARK = Exposure(UniformField(LIGHT), 0.02), Exposure(Darkness(), 0.5, temperature_c=35.0)
FRAMES = 200


def _frames(exposure: Exposure, effects: tuple[Effect, ...]) -> FloatArray:
    rng = np.random.default_rng(41)
    return np.stack([sample(CAMERA, exposure, rng, effects) for _ in range(FRAMES)]).astype(float)


@pytest.mark.parametrize(
    "one",
    [
        HotPixels(excess_e_per_s=400.0, share_ppm=5e4),
        AmplifierGlow(glow_e_per_s=300.0, reach_mm=0.05, corner="bottom_right"),
        DarkCurrentTemperature(doublings_per_c=0.2),
        ColumnNoise(offset_e=6.0),
        RandomTelegraphNoise(amplitude_e=30.0, share_percent=10.0),
    ],
    ids=lambda one: one.name,
)
def test_frames_agree_with_expected_and_variance(one: Effect) -> None:
    """Chi-squared over 200 dark frames at 4.5 standard deviations; the mean of s^2 / variance at 4.5 of its own."""
    frames = _frames(DARK, (one,))
    mean, variance = moments(CAMERA, DARK, (one,))
    pull = (frames.mean(axis=0) - mean) / np.sqrt(variance / FRAMES)
    assert np.sum(pull**2) == pytest.approx(pull.size, abs=4.5 * np.sqrt(2.0 * pull.size))
    ratio = frames.var(axis=0, ddof=1) / variance
    assert ratio.mean() == pytest.approx(1.0, abs=4.5 * ratio.std() / np.sqrt(ratio.size))


def test_row_noise_is_shared_along_rows_only() -> None:
    frames = _frames(DARK, (RowNoise(noise_e=5.0),))
    mean, variance = moments(CAMERA, DARK, (RowNoise(noise_e=5.0),))
    plain = moments(CAMERA, DARK)[1]
    np.testing.assert_allclose(variance - plain, (0.5 * 5.0) ** 2, atol=1e-3)
    rest = frames - frames.mean(axis=0)
    along = (rest[:, :, 1:] * rest[:, :, :-1]).sum(axis=0).mean(axis=1) / (FRAMES - 1)
    across = (rest[:, 1:] * rest[:, :-1]).sum(axis=0).mean(axis=1) / (FRAMES - 1)
    assert along.mean() == pytest.approx((0.5 * 5.0) ** 2, abs=4.5 * along.std() / np.sqrt(along.size))
    assert across.mean() == pytest.approx(0.0, abs=4.5 * across.std() / np.sqrt(across.size))
    assert frames.mean() == pytest.approx(mean.mean(), abs=4.5 * 2.5 / np.sqrt(FRAMES * 48))


def test_column_offsets_stay_and_have_no_mean() -> None:
    one = ColumnNoise(offset_e=6.0)
    offset = (predict_frame(CAMERA, DARK, (one,)) - predict_frame(CAMERA, DARK))[0] / 0.5
    assert np.ptp(predict_frame(CAMERA, DARK, (one,)) - predict_frame(CAMERA, DARK), axis=0).max() < 1e-9
    assert offset.mean() == pytest.approx(0.0, abs=1e-3)
    assert offset.std() == pytest.approx(6.0, rel=4.5 / np.sqrt(2 * 64))
    bright = predict_frame(CAMERA, BRIGHT, (one,)) - predict_frame(CAMERA, BRIGHT)
    np.testing.assert_allclose(bright[0] / 0.5, offset, atol=1e-2)  # the dark frame's noise rounds to 1e-2
    (drawn,), (other,) = (signal_of(CAMERA, (e,)).lines for e in (one, ColumnNoise(offset_e=6.0, pattern_seed=1)))
    assert np.any(drawn.mean_e((48, 64)) != other.mean_e((48, 64)))


def test_hot_pixels_are_as_many_and_as_hot_as_stated() -> None:
    camera = CAMERA.model_copy(update={"rows": 400, "cols": 500})
    one = HotPixels(excess_e_per_s=100.0, share_ppm=5000.0)
    more = expected_electrons(camera, Exposure(Darkness(), 2.0), (one,)) - 20.0
    hot = more[more > 0]
    assert hot.size == 1000
    # exponential: standard deviation equal to the mean, and so the mean's error is 1/sqrt(n) of it
    assert hot.mean() == pytest.approx(200.0, rel=4.5 / np.sqrt(1000))
    assert hot.std() == pytest.approx(200.0, rel=4.5 * np.sqrt(8 / 4 / 1000))
    # in proportion to the exposure, and the same pixels
    short = expected_electrons(camera, Exposure(Darkness(), 1.0), (one,)) - 10.0
    np.testing.assert_allclose(2.0 * short, more, atol=1e-9)


def test_glow_falls_from_its_corner() -> None:
    for corner, at in {
        "top_left": (0, 0),
        "top_right": (0, 63),
        "bottom_left": (47, 0),
        "bottom_right": (47, 63),
    }.items():
        one = AmplifierGlow(glow_e_per_s=40.0, reach_mm=0.069, corner=corner)
        rate = np.asarray(dark_electrons(CAMERA, Exposure(Darkness(), 1.0), (one,)))
        assert rate[at] == pytest.approx(50.0)
        assert rate.max() == rate[at]
        row = rate[at[0]] if at[1] == 0 else rate[at[0], ::-1]
        # 20 px of 3.45 um are one reach
        assert row[20] - 10.0 == pytest.approx(40.0 / np.e)


def test_dark_current_doubles_with_the_temperature() -> None:
    one = DarkCurrentTemperature(doublings_per_c=1 / 7)
    at = {t: dark_electrons(CAMERA, Exposure(Darkness(), 1.0, temperature_c=t), (one,)) for t in (18.0, 25.0, 39.0)}
    assert at == pytest.approx({18.0: 5.0, 25.0: 10.0, 39.0: 40.0})
    assert dark_electrons(CAMERA, Exposure(Darkness(), 1.0), (one,)) == 10.0  # no temperature is known
    # as the camera's own doubling does, and one on top of the other
    warm = CAMERA.model_copy(update={"dark_current_doubling_c": 7.0})
    assert dark_electrons(warm, Exposure(Darkness(), 1.0, temperature_c=32.0), (one,)) == pytest.approx(40.0)


def test_lag_leaves_powers_of_its_share_and_loses_nothing() -> None:
    q = 0.08
    exposures = [BRIGHT, BRIGHT, BRIGHT, DARK, DARK, DARK]
    read = [float(e[10, 10]) for e in expect_sequence(CAMERA, exposures, (ImageLag(lag_percent=8.0),))]
    bright, dark = (float(expected_electrons(CAMERA, exposure)[10, 10]) for exposure in (BRIGHT, DARK))
    # the k-th of equal frames: 1 - q^k of it; the k-th dark frame after them: what is left of it, and its own
    for k in (1, 2, 3):
        assert read[k - 1] == pytest.approx(bright * (1 - q**k))
    left = bright * q * (1 - q**3) / (1 - q)
    for k in (1, 2, 3):
        assert read[2 + k] == pytest.approx(dark * (1 - q**k) + left * (1 - q) * q ** (k - 1))
    # what was collected was read, or is left at the end
    kept = (sum([bright] * 3 + [dark] * 3) - sum(read)) / q * (1 - q)
    assert read[-1] == pytest.approx(kept)
    # without lag a sequence is its frames
    for frame, exposure in zip(expect_sequence(CAMERA, exposures), exposures, strict=True):
        np.testing.assert_array_equal(frame, expected_electrons(CAMERA, exposure))


def test_lag_keeps_to_the_full_well() -> None:
    """What overflows isn't left behind."""
    flood = Exposure(UniformField(LIGHT.scale(100.0)), 1.0)
    _, after = expect_sequence(CAMERA, [flood, DARK], (ImageLag(lag_percent=2.0),))
    assert after[0, 0] == pytest.approx((5.0 + 0.02 * 7500.0) * 0.98)


def test_frames_of_a_sequence_are_drawn_around_its_means() -> None:
    lag = (ImageLag(lag_percent=5.0),)
    exposures = [BRIGHT, DARK] * FRAMES
    frames = np.stack(list(sample_sequence(CAMERA, exposures, np.random.default_rng(43), lag)))[3::2].astype(float)
    means = list(expect_sequence(CAMERA, exposures[:20], lag))
    dark = means[-1]
    wanted = 100.0 + 0.5 * dark
    variance = 0.25 * (dark + 4.0) + 1 / 12
    pull = (frames.mean(axis=0) - wanted) / np.sqrt(variance / len(frames))
    assert np.sum(pull**2) == pytest.approx(pull.size, abs=4.5 * np.sqrt(2.0 * pull.size))
    ratio = frames.var(axis=0, ddof=1) / variance
    assert ratio.mean() == pytest.approx(1.0, abs=4.5 * ratio.std() / np.sqrt(ratio.size))


def test_telegraph_pixels_have_two_levels() -> None:
    one = RandomTelegraphNoise(amplitude_e=40.0, share_percent=5.0)
    (noise,) = signal_of(CAMERA, (one,)).random
    drawn = np.stack([noise.draw((48, 64), np.random.default_rng(k)) for k in range(400)])
    blinking = np.any(drawn != 0, axis=0)
    assert blinking.sum() == round(0.05 * 48 * 64)
    assert set(np.unique(drawn[:, blinking])) == {-20.0, 20.0}
    variance = np.asarray(noise.variance_e2((48, 64)))
    assert set(np.unique(variance)) == {0.0, 400.0}
    assert np.all(variance[blinking] == 400.0)
    # each half of the time: the mean of 400 x 154 signs
    assert drawn[:, blinking].mean() == pytest.approx(0.0, abs=4.5 * 20.0 / np.sqrt(400 * blinking.sum()))


def test_full_pixels_lose_to_empty_ones_and_none_is_lost() -> None:
    """c of a full pixel whose four next ones are empty, a quarter of it to each; equal pixels exchange nothing."""
    frame = np.zeros((9, 9))
    frame[4, 4] = CAMERA.full_well_e
    state = charge_of(CAMERA, (BrighterFatter(exchanged_percent=2.0),))
    after = state.move_charge(frame)
    assert after[4, 4] == pytest.approx(0.98 * CAMERA.full_well_e)
    assert after[4, 5] == pytest.approx(0.005 * CAMERA.full_well_e)
    assert after.sum() == pytest.approx(CAMERA.full_well_e)
    np.testing.assert_array_equal(state.move_charge(np.full((5, 5), 4e3)), np.full((5, 5), 4e3))


def test_a_ripple_lifts_and_lowers_codes_in_turn() -> None:
    law = codes_of(CAMERA, (AdcRipple(sine_dn=3.0, cosine_dn=4.0, period_dn=512.0),))
    dn = np.array([0.0, 128.0, 256.0, 512.0])
    np.testing.assert_allclose(law.convert(dn) - dn, [4.0, 3.0, -4.0, 4.0], atol=1e-12)


def test_the_converters_bits_jump_where_they_stand() -> None:
    one = Uniform(CAMERA, (AdcNonlinearity(error_dn=3.0, second_dn=-1.0, third_dn=0.5),))
    below, above = one.codes(np.array([2047.999, 2048.0]))
    # at half scale the highest bit comes and the two below it go
    assert above - below == pytest.approx(3.0 - (-1.0 + 0.5), abs=0.01)
    assert one.codes(np.array([0.0]))[0] == 0.0
    # nothing changes at code 2^bits: the last code has all bits
    assert one.codes(np.array([4095.999]))[0] == pytest.approx(4095.999, abs=0.01)
    # between jumps, a line
    step = np.diff(one.codes(np.arange(1024.0, 1536.0)))
    np.testing.assert_allclose(step, 1.0 - 2.5 / 4096.0, atol=1e-9)
    twice = Uniform(CAMERA, (AdcNonlinearity(error_dn=6.0, second_dn=-2.0, third_dn=1.0),))
    two = twice.codes(np.array([3000.0])) - 3000.0
    assert two[0] == pytest.approx(2.0 * (one.codes(np.array([3000.0]))[0] - 3000.0))


@pytest.mark.parametrize("at", [(20, 30), (24, 5)])
def test_blooming_conserves_charge_and_keeps_to_the_column(at: tuple[int, int]) -> None:
    full = CAMERA.full_well_e
    before = np.full((48, 64), 500.0)
    before[at] = 6.0 * full
    after = charge_of(CAMERA, (Blooming(share_percent=60.0),)).overflow_wells(before)
    assert after.sum() == pytest.approx(before.sum(), rel=1e-12)  # none reaches the rim
    changed = after != before
    assert set(np.flatnonzero(changed.any(axis=0))) == {at[1]}
    # 60 % of 5 full wells, half of it each way, fills 1.5 full wells of room: 1.6 pixels of 7000 e
    column = after[:, at[1]]
    np.testing.assert_allclose(column[at[0] + 1 : at[0] + 9], column[at[0] - 8 : at[0]][::-1], atol=1e-6)
    assert column[at[0] + 1] == full and 500.0 < column[at[0] + 2] < full and column[at[0] + 3] == 500.0
    assert column[at[0]] == pytest.approx(6.0 * full - 0.6 * 5.0 * full)
    assert np.array_equal(before, np.where(changed, before, after))


def test_blooming_of_neighbours_adds_up_and_runs_off_the_frame() -> None:
    full = CAMERA.full_well_e
    before = np.zeros((10, 2))
    before[0, 0], before[1, 0] = 3.0 * full, 2.0 * full
    after = charge_of(CAMERA, (Blooming(share_percent=100.0),)).overflow_wells(before)
    # downwards 1 + 0.5 full wells; upwards from row 1 through the full row 0, and from row 0, off the frame
    np.testing.assert_allclose(after[:, 0], [full, full, full, 0.5 * full, *[0.0] * 6])
    np.testing.assert_array_equal(after[:, 1], 0.0)
    even = np.full((10, 2), 0.9 * full)
    np.testing.assert_array_equal(charge_of(CAMERA, (Blooming(share_percent=50.0),)).overflow_wells(even), even)


def test_greens_differ_by_their_ratio_and_keep_their_mean() -> None:
    curve = Spectrum.of([400.0, 700.0], [0.5, 0.5])
    camera = CAMERA.model_copy(update={"cfa": "GRBG", "quantum_efficiency": dict.fromkeys("RGB", curve),
                                       "dark_current_e_per_s": 0.0})  # fmt: skip
    far = camera.model_copy(update={"lens": Lens(f_number=4.0, focal_length_mm=5000.0)})
    plain = expected_electrons(far, BRIGHT)
    frame = expected_electrons(far, BRIGHT, (GreenImbalance(imbalance_percent=3.0),))
    part, same = planes(frame, "GRBG"), planes(plain, "GRBG")
    assert part["G1"].mean() / same["G1"].mean() == pytest.approx(1.015)
    assert part["G2"].mean() / same["G2"].mean() == pytest.approx(0.985)
    assert frame.mean() == pytest.approx(plain.mean(), rel=1e-9)
    np.testing.assert_array_equal(part["R"], same["R"])
    np.testing.assert_array_equal(predict_frame(CAMERA, BRIGHT, (GreenImbalance(imbalance_percent=3.0),)),
                                  predict_frame(CAMERA, BRIGHT))  # fmt: skip


def _lit(one: LightFlicker, even: FloatArray, exposure_s: float, elapsed_s: float) -> FloatArray:
    return collected_mosaic(CAMERA, even, (one,), exposure_s=exposure_s, elapsed_s=elapsed_s)


def test_flicker_has_its_period_its_null_and_its_mean() -> None:
    one = LightFlicker(modulation_percent=20.0, frequency_hz=100.0, line_time_us=100.0)
    even = np.full((200, 3), 1000.0)  # 200 rows of 0.1 ms: two periods
    short = _lit(one, even, 1e-6, 0.0)[:, 0]
    assert short.mean() == pytest.approx(1000.0, rel=1e-9)
    assert short.max() == pytest.approx(1200.0, rel=1e-5) and short.min() == pytest.approx(800.0, rel=1e-5)
    np.testing.assert_allclose(short[100:], short[:100], rtol=1e-9)
    for periods in (1, 2, 5):
        np.testing.assert_allclose(_lit(one, even, periods / 100.0, 0.3), even, rtol=1e-9)
    # half a period later light and dark change places
    np.testing.assert_allclose(_lit(one, even, 1e-6, 0.005)[:, 0], 2000.0 - short, rtol=1e-6)
    # half a period long: sinc(1/2) = 2 / pi
    assert _lit(one, even, 0.005, 0.0).max() == pytest.approx(1000.0 * (1 + 0.2 * 2 / np.pi), rel=1e-3)
    whole = _lit(LightFlicker(modulation_percent=20.0, line_time_us=0.0), even, 0.002, 0.0013)
    assert np.ptp(whole) == 0.0
