"""Each unlisted law does what it declares: means and variances of frames against a direct calculation.

Frames with and without a law have the same noise, so that their difference is the law's; what rounding to electrons and
codes leaves of it is one code at most, at random, and averages out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from evaluation.independent_simulator import LISTED, OUTSIDE, UNLISTED, WAVELENGTH_NM, ConcealedCamera, UnlistedLaw
from evaluation.independent_simulator import unlisted as laws
from sim.effects.families import Family
from sim.effects.library import effects as library

LAMP = np.full_like(WAVELENGTH_NM, 0.02)
ROWS, COLS = 96, 128
#: Standard deviation of a pixel's change by rounding twice, and by whole electrons of less than a code: at most.
ROUNDING_DN = 0.75
LATE = 60  # number of a frame that is taken 1200 s after the beginning


def camera(*present: UnlistedLaw, cfa: str = "MONO") -> ConcealedCamera:
    return ConcealedCamera(31, present, cfa=cfa, rows=ROWS, cols=COLS)


def frame(of: ConcealedCamera, level: float, k: int, exposure_s: float | None = None) -> np.ndarray:
    """A flat at a share of saturation, or a dark frame of a given exposure where that is 0."""
    light = of.uniform(LAMP) if level else None
    return of.expose(light, exposure_s or of.exposure_for(LAMP, level), k).astype(float)


def change(
    law: UnlistedLaw, level: float, *, k: int = 3, exposure_s: float | None = None, cfa: str = "MONO"
) -> np.ndarray:
    """Change of a frame by the law, DN."""
    return frame(camera(law, cfa=cfa), level, k, exposure_s) - frame(camera(cfa=cfa), level, k, exposure_s)


def electrons(level: float, cfa: str = "MONO") -> np.ndarray:
    """Mean photoelectrons of a flat without a law, (rows, cols)."""
    one = camera(cfa=cfa)
    colours = np.array(list(cfa if cfa != "MONO" else "YYYY")).reshape(2, 2)
    tiled = np.tile(colours, (ROWS // 2, COLS // 2))
    rates = {c: one.rate(LAMP, c) for c in set(colours.ravel())}
    return np.vectorize(rates.get)(tiled) * one.shading * one.prnu_map * one.exposure_for(LAMP, level)


def dark_e(level: float) -> float:
    return camera().dark_e_per_s * camera().exposure_for(LAMP, level)


def assert_means(found: np.ndarray, expected: np.ndarray, gain: float) -> None:
    """Row profile, column profile and 8 x 8 cells agree within 5 standard deviations of rounding, and 1 % of the
    largest change: the spread of electrons over a curved law."""
    noise = max(ROUNDING_DN, gain)
    large = 0.01 * float(np.abs(expected).max())
    for average in (
        lambda f: f.mean(1),
        lambda f: f.mean(0),
        lambda f: f.reshape(8, ROWS // 8, 8, COLS // 8).mean((1, 3)),
    ):
        one = average(expected)
        away = np.abs(average(found) - one).max()
        assert away < 5.0 * noise / np.sqrt(found.size / one.size) + large


def test_the_twenty_are_new_and_declare_themselves() -> None:
    assert len(UNLISTED) == len({law.name for law in UNLISTED}) == 20
    others = {law.name for law in (*LISTED, *OUTSIDE)} | set(library())
    for law in UNLISTED:
        assert law.name not in others
        assert law.effect is None
        assert law.families <= {family.value for family in Family}
        assert law.stage not in law.alike
        assert len(law.periods) in {0, len(law.axes)}
    counts = {stage: sum(law.stage == stage for law in UNLISTED) for stage in ("light", "charge", "signal", "codes")}
    assert counts == {"light": 4, "charge": 4, "signal": 9, "codes": 3}


def test_every_law_is_nothing_without_strength() -> None:
    for kind in UNLISTED:
        law = kind(0.0, 0, 5)
        assert np.abs(change(law, 0.5, k=LATE, cfa="RGGB")).max() == 0.0
        assert np.abs(change(law, 0.0, k=LATE, exposure_s=1.0, cfa="RGGB")).max() == 0.0


# --- means ------------------------------------------------------------------------------------------------------------


def _saddle(law: UnlistedLaw, e: np.ndarray) -> np.ndarray:
    x, y = camera().field_position
    turn = 2.0 * np.pi * law.uniform[0]
    return e * law.strength / 100.0 * ((x * x - y * y) * np.cos(turn) + 2.0 * x * y * np.sin(turn))


def _leaf(law: UnlistedLaw, e: np.ndarray) -> np.ndarray:
    x, y = camera().field_position
    r2 = x * x + y * y
    return e / camera().exposure_for(LAMP, 0.5) * law.strength * 1e-6 * (r2.mean() - r2)


def _waves(law: UnlistedLaw, e: np.ndarray) -> np.ndarray:
    return e * law.strength / 100.0 * np.sin(2 * np.pi * (np.arange(COLS) / 37.0 + law.uniform[0]))[None, :]


def _cell(law: UnlistedLaw, e: np.ndarray) -> np.ndarray:
    table, (r, c) = law.balanced(2, 4), np.indices((ROWS, COLS))
    return e * law.strength / 100.0 * table[r % 2, c % 4]


def _amplifiers(law: UnlistedLaw, e: np.ndarray) -> np.ndarray:
    return (e + dark_e(0.5)) * law.strength / 100.0 * law.balanced(4)[np.arange(COLS) % 4][None, :]


def _pocket(law: UnlistedLaw, e: np.ndarray) -> np.ndarray:
    return -law.strength * (1.0 - np.exp(-(e + dark_e(0.5)) / (0.06 * camera().full_well_e)))


def _bend(law: UnlistedLaw, e: np.ndarray) -> np.ndarray:
    full, total = camera().full_well_e, e + dark_e(0.5)
    # E[n^2] = m^2 + m of a Poisson number
    return law.strength / 100.0 * law.balanced(COLS)[None, :] * (total**2 + total) / full


def _banks(law: UnlistedLaw, e: np.ndarray) -> np.ndarray:
    offset = law.balanced(8)[np.arange(ROWS) % 8] * law.strength / camera().gain_dn_per_e
    return np.repeat(offset[:, None], COLS, axis=1)


def _first(law: UnlistedLaw, e: np.ndarray) -> np.ndarray:
    offset = law.signed_strength / camera().gain_dn_per_e * np.exp(-np.arange(ROWS) / 12.0)
    return np.repeat(offset[:, None], COLS, axis=1)


@pytest.mark.parametrize(
    ("law", "expected_e"),
    [
        (laws.SaddleShadingLaw(6.0, 0, 5), _saddle),
        (laws.LeafShutterLaw(20.0, 0, 5), _leaf),
        (laws.WavyColumnsLaw(3.0, 0, 5), _waves),
        (laws.SharedCellLaw(3.0, 0, 5), _cell),
        (laws.ColumnAmplifiersLaw(3.0, 0, 5), _amplifiers),
        (laws.ChargePocketLaw(100.0, 0, 5), _pocket),
        (laws.BentColumnsLaw(3.0, 0, 5), _bend),
        (laws.RowBanksLaw(8.0, 0, 5), _banks),
        (laws.FirstRowsLaw(20.0, 0, 5), _first),
    ],
    ids=lambda one: getattr(one, "name", ""),
)
def test_means_of_a_flat(law: UnlistedLaw, expected_e: Callable[[UnlistedLaw, np.ndarray], np.ndarray]) -> None:
    gain = camera().gain_dn_per_e
    assert_means(change(law, 0.5), gain * expected_e(law, electrons(0.5)), gain)


def test_a_pocket_keeps_the_first_charges_only() -> None:
    law, gain, first = laws.ChargePocketLaw(100.0, 0, 5), camera().gain_dn_per_e, 0.06 * camera().full_well_e
    for level in (0.02, 0.05, 0.9):
        e = electrons(level) + dark_e(level)
        # of a Poisson number of mean m: E[exp(-n / f)] = exp(m (exp(-1 / f) - 1))
        expected = -100.0 * gain * (1.0 - np.exp(e * np.expm1(-1.0 / first)))
        assert_means(change(law, level), expected, gain)


def test_offsets_stand_in_dark_frames_and_factors_do_not() -> None:
    gain = camera().gain_dn_per_e
    for kind, expected_e in ((laws.RowBanksLaw, _banks), (laws.FirstRowsLaw, _first)):
        law = kind(8.0, 0, 5)
        assert_means(change(law, 0.0, exposure_s=0.001), gain * expected_e(law, electrons(0.5)), gain)
    for kind in (
        laws.SaddleShadingLaw,
        laws.WavyColumnsLaw,
        laws.SharedCellLaw,
        laws.LeafShutterLaw,
        laws.ReddeningLampLaw,
    ):
        assert not change(kind(5.0, 0, 5), 0.0, exposure_s=2.0, cfa="RGGB").any()


def test_a_warm_centre_grows_with_the_exposure() -> None:
    law, gain = laws.WarmCentreLaw(60.0, 0, 5), camera().gain_dn_per_e
    x, y = camera().field_position
    for exposure_s in (0.5, 2.0):
        expected = gain * exposure_s * 60.0 * (1.0 - x * x - y * y)
        # electrons of a dark frame are few: their whole numbers jump by one
        assert_means(change(law, 0.0, exposure_s=exposure_s), expected, 1.5 * gain)


def test_a_reset_settles_with_the_exposure_whatever_the_level() -> None:
    law = laws.ResetSettlingLaw(20.0, 0, 5)
    tau_s = 1e-3 * (0.3 + 0.7 * law.uniform[0])
    for level, exposure_s in ((0.0, 2e-4), (0.0, 1e-3), (0.0, 0.5), (0.2, None), (0.7, None)):
        t = exposure_s or camera().exposure_for(LAMP, level)
        expected = law.signed_strength * np.exp(-t / tau_s)
        # a dark frame's codes are few and its rounding isn't even: 0.3 DN
        assert change(law, level, exposure_s=exposure_s).mean() == pytest.approx(expected, abs=0.3)


def test_a_lamp_reddens_with_the_time() -> None:
    law, gain = laws.ReddeningLampLaw(4.0, 0, 5), camera(cfa="RGGB").gain_dn_per_e
    e = electrons(0.5, "RGGB")
    for k in (3, LATE):
        found = change(law, 0.5, k=k, cfa="RGGB")
        minutes = k * 20.0 / 60.0
        for plane, turn in (((0, 0), 1.0), ((0, 1), 0.0), ((1, 0), 0.0), ((1, 1), -1.0)):
            mine = slice(plane[0], None, 2), slice(plane[1], None, 2)
            expected = gain * turn * law.signed_strength / 100.0 * minutes / 10.0 * e[mine].mean()
            assert found[mine].mean() == pytest.approx(expected, abs=5.0 * ROUNDING_DN / np.sqrt(found[mine].size))


def test_a_screw_moves_lines_of_the_monochromator_only() -> None:
    law = laws.ScrewErrorLaw(2.0, 0, 5)
    assert law.radiance(LAMP, "flat") is LAMP
    for centre in (430.0, 455.0, 480.0, 600.0):
        line = np.exp(-0.5 * np.square((WAVELENGTH_NM - centre) / 4.0))
        moved = law.radiance(line, "narrowband")
        away = (moved * WAVELENGTH_NM).sum() / moved.sum() - centre
        expected = 2.0 * np.sin(2 * np.pi * (centre / 50.0 + law.uniform[0]))
        # interpolation over 1 nm of a line of 4 nm
        assert away == pytest.approx(expected, abs=0.02)


# --- variances --------------------------------------------------------------------------------------------------------


def spread(law: UnlistedLaw, level: float, k: int, exposure_s: float | None = None) -> np.ndarray:
    """The noise of the law alone: (rows, cols), DN. Rounding adds a variance of at most 1/6 DN^2."""
    return change(law, level, k=k, exposure_s=exposure_s)


def assert_variance(noise: np.ndarray, expected_dn2: float) -> None:
    """Within 5 standard deviations, sqrt(2 / n) of it, and the two roundings."""
    assert abs(noise.var() - expected_dn2) < 5.0 * expected_dn2 * np.sqrt(2.0 / noise.size) + 1.0 / 6.0


def test_noise_grows_with_the_time() -> None:
    law, gain = laws.WarmingNoiseLaw(20.0, 0, 5), camera().gain_dn_per_e
    for k in (10, LATE):
        assert_variance(spread(law, 0.2, k), (gain * 20.0) ** 2 * k * 20.0 / 600.0)


def test_noise_stands_about_half_of_full_well() -> None:
    law, one = laws.MidLevelNoiseLaw(40.0, 0, 5), camera()
    for level in (0.35, 0.5, 0.6, 0.9):
        e = electrons(level) + dark_e(level)
        # a Poisson number n of mean m: E[exp(-((n / f - 1/2) / 0.1)^2)] = exp(-(m / f - 1/2)^2 / (0.01 + 2 v)) /
        # sqrt(1 + 200 v)
        v = e / one.full_well_e**2
        expected = np.exp(-np.square(e / one.full_well_e - 0.5) / (0.01 + 2.0 * v)) / np.sqrt(1.0 + 200.0 * v)
        assert_variance(spread(law, level, 3), (one.gain_dn_per_e * 40.0) ** 2 * float(expected.mean()))


def test_odd_columns_are_noisier() -> None:
    noise = spread(laws.BankNoiseLaw(20.0, 0, 5), 0.2, 3)
    assert not noise[:, ::2].any()
    assert_variance(noise[:, 1::2], (camera().gain_dn_per_e * 20.0) ** 2)


def test_rows_of_a_pair_share_their_noise() -> None:
    noise = spread(laws.SharedReadLaw(20.0, 0, 5), 0.2, 3)
    variance = (camera().gain_dn_per_e * 20.0) ** 2
    assert_variance(noise, 1.0 * variance)
    within, between = (noise[0::2] * noise[1::2]).mean(), (noise[1:-1:2] * noise[2::2]).mean()
    # a product of independent numbers has the standard deviation variance / sqrt(n); n pairs, columns and rows
    assert abs(within - variance) < 5.0 * variance * np.sqrt(2.0 / (noise.size / 2))
    assert abs(between) < 5.0 * variance / np.sqrt(noise.size / 2)
    other = spread(laws.SharedReadLaw(20.0, 0, 5), 0.2, 4)
    assert abs((noise * other).mean()) < 5.0 * variance / np.sqrt(noise.size / 2)


# --- codes ------------------------------------------------------------------------------------------------------------

STEP = 0.01


def widths(law: UnlistedLaw) -> np.ndarray:
    """Widths of the codes 0 to 4095 of a 12 bit converter, DN, to `STEP`."""
    law.bind(camera(law))
    codes = np.clip(np.round(law.adc_output(np.arange(-0.5, 4095.5, STEP))), 0, 4095).astype(int)
    return np.bincount(codes, minlength=4096)[:4096] * STEP


def test_ten_widths_of_a_ring() -> None:
    law = laws.RingCodesLaw(0.2, 0, 5)
    found = widths(law)[10:4080].reshape(-1, 10)
    away = law.balanced(10)
    assert np.abs(found - (1.0 + 0.2 * away)).max() < 2.5 * STEP
    assert np.sqrt(np.mean(np.square(found.mean(0) - 1.0))) == pytest.approx(0.2, abs=STEP)


def test_codes_are_coarse_in_the_top_quarter() -> None:
    found = widths(laws.CoarseTopLaw(0.4, 0, 5))
    assert np.abs(found[1:3070] - 1.0).max() < 2.5 * STEP
    assert np.abs(found[3074:4094:2] - 1.4).max() < 2.5 * STEP
    assert np.abs(found[3075:4094:2] - 0.6).max() < 2.5 * STEP


def test_every_64th_code_is_wide_and_the_one_before_narrow() -> None:
    found = widths(laws.WideCarriesLaw(0.3, 0, 5))[64:4032].reshape(-1, 64)
    expected = np.ones(64)
    expected[0], expected[-1] = 1.3, 0.7
    assert np.abs(found - expected).max() < 2.5 * STEP
