"""The step of the codes, found from frames, and the rounding to it."""

import numpy as np
import pytest

from lab.fit.noise.noise_fit import fit_noise
from lab.formats.recording_set import FrameCodes, Manifest, RecordingSet
from lab.observables.codes.rounding import rounding_std_dn, variance_before_rounding, variance_rounding_std
from lab.observables.codes.step import find_code_step, step_of

SHAPE = (120, 150)
READ_E = 12.0


def recorded(
    make, *, electrons: float = 1500.0, read_e: float = READ_E, bit_depth: int = 16, seed: int = 3
) -> RecordingSet:
    """Darks and flats to 14 times `electrons`; `make`: electrons above black -> codes, and whether it is a dark."""
    rng = np.random.default_rng(seed)
    frames, captures = {}, []
    for light in (0, 1, 2, 4, 6, 8, 10, 14):
        for repeat in range(2 if light else 4):
            charge = rng.poisson(electrons * light, SHAPE) + rng.normal(0.0, read_e, SHAPE)
            path = f"frames/{light}-{repeat}.npy"
            frames[path] = make(charge, light == 0).astype(np.uint16)
            kind = "flat" if light else "dark"
            capture = {"id": f"{light}-{repeat}", "kind": kind, "side": "left", "frame": path}
            captures.append(capture | {"exposure_s": 0.01 * max(light, 1)})
    camera = {"rows": SHAPE[0], "cols": SHAPE[1], "cfa": "MONO", "bit_depth": bit_depth}
    return RecordingSet(Manifest.model_validate({"cameras": {"left": camera}, "captures": captures}), frames)


def converted(charge: np.ndarray, gain: float, bits: int, black: int = 60) -> np.ndarray:
    return np.clip(np.rint(black + gain * charge), 0, 2**bits - 1).astype(np.int64)


#: Ways to store codes of fewer bits in 16: conversion, step in DN, highest code.
STORED = {
    "12 bits shifted up by 4": (lambda e, _: converted(e, 0.15, 12) << 4, 16.0, 65520, 0.15),
    "14 bits shifted up by 2": (lambda e, _: converted(e, 0.7, 14) << 2, 4.0, 65532, 0.7),
    "multiples of 10 and a rest": (lambda e, _: 10 * converted(e, 0.15, 12) + 7, 10.0, 65527, 0.15),
    "10 bits scaled to full scale": (
        lambda e, _: np.rint(converted(e, 0.05, 10) * 65535 / 1023),
        65535 / 1023,
        65535,
        0.05,
    ),
    "10 bits repeated below": (
        lambda e, _: (converted(e, 0.05, 10) << 6) | (converted(e, 0.05, 10) >> 4),
        65535 / 1023,
        65535,
        0.05,
    ),
}


@pytest.mark.parametrize("name", STORED)
def test_figures_are_those_of_the_converter(name: str) -> None:
    """Read noise of 12 e, of which rounding alone has 1.9 to 5.8 e. Relative standard deviation of a variance of 18000
    pixels from four repeats, sqrt(2 / 54000) = 0.6 %, half of it in the noise; that of the gain is the fit's."""
    make, step_dn, highest, gain = STORED[name]
    recordings = recorded(make)
    code = find_code_step(recordings, "left")
    # of scaled codes, a mean over the neighbours that come: good to a thousandth
    assert code.step_dn == pytest.approx(step_dn, rel=0 if step_dn.is_integer() else 2e-3)
    assert code.highest_dn(65535.0) == highest
    fit = fit_noise(recordings, "left")
    assert any(f"the codes lie {code.step_dn:.5g} DN apart" in remark for remark in fit.remarks)
    assert abs(fit.conversion_gain_dn_per_e - gain * step_dn) < 3.0 * fit.conversion_gain_dn_per_e_std
    assert abs(fit.read_noise_e - READ_E) < 3.0 * fit.read_noise_e_std
    assert fit.read_noise_e_std < 0.03 * READ_E
    assert fit.defects is None


def test_noise_that_rounding_hides_has_a_limit_and_no_hot_pixels() -> None:
    """The kind of a camera that stores 12-bit codes left-aligned: 1.5 e at 0.25 DN/e are 0.375 steps."""
    recordings = recorded(lambda e, _: converted(e, 0.25, 12, 40) << 4, electrons=1000.0, read_e=1.5)
    fit = fit_noise(recordings, "left")
    assert fit.read_noise_e is None
    (limit,) = (remark for remark in fit.remarks if "rounding hides it" in remark)
    assert "the read noise is below 1.6" in limit  # 0.4 steps of 16 DN at 4 DN/e
    assert fit.defects is None
    assert not any("hot or dead" in remark for remark in fit.remarks)


def test_codes_of_one_dn_have_no_step_and_no_remark() -> None:
    for make in (lambda e, _: converted(e, 0.15, 12), lambda e, _: converted(e, 2.4, 16)):
        recordings = recorded(make)
        assert find_code_step(recordings, "left").lines == ()
        assert find_code_step(recordings, "left").highest_dn(65535.0) == 65535.0


def test_darks_of_another_step_are_named() -> None:
    recordings = recorded(lambda e, dark: converted(e, 0.15, 12) // 8 * 8 if dark else converted(e, 0.15, 12))
    code = find_code_step(recordings, "left")
    assert (code.step_dn, code.coarser, code.their_step_dn) == (1.0, ("0-0",), 8.0)
    assert any("0-0 lie 8 DN apart" in remark for remark in fit_noise(recordings, "left").remarks)


def test_few_pixels_off_the_step_do_not_hide_it() -> None:
    """One pixel in two thousand was replaced by the mean of its neighbours, and full scale is no multiple."""

    def make(charge: np.ndarray, _: bool) -> np.ndarray:
        stored = np.where((codes := converted(charge, 0.5, 12)) == 4095, 65535, codes << 4)
        stored[::50, ::50] = (stored[::50, 1::50] + stored[1::50, ::50]) // 2 + 3
        return stored

    assert find_code_step(recorded(make), "left").step_dn == 16.0


def test_few_codes_tell_no_step() -> None:
    """Two levels without noise, or three: any pair of codes has a common divisor of their difference."""
    frame = np.zeros((20, 30), np.uint16)
    frame[:, 15:] = 960
    assert step_of(FrameCodes.count(frame).every) == 1.0
    frame[:, 25:] = 320
    assert step_of(FrameCodes.count(frame).every) == 1.0
    assert step_of(FrameCodes.count(frame).every, has_one_mode=True) == 320.0  # no dark has such a distribution
    assert step_of(FrameCodes.count(np.full((20, 30), 64, np.uint16)).every, has_one_mode=True) == 1.0


def test_rounding_scales_with_the_step() -> None:
    """The formulas hold for drawn values: the error of a mean over levels, and a variance, at 0.3 and 0.6 steps."""
    rng = np.random.default_rng(5)
    for step_dn in (1.0, 16.0):
        for std in (0.3, 0.6):
            levels = rng.uniform(0.0, 1.0, 400)
            drawn = np.rint(levels[:, None] + std * rng.standard_normal((400, 20_000))) * step_dn
            error = drawn.mean(axis=1) - levels * step_dn
            expected = float(rounding_std_dn((std * step_dn) ** 2, step_dn))
            noise = step_dn * np.sqrt((std**2 + 1.0 / 12.0) / 20_000)
            # a root mean square of 400 values is known to 1 / sqrt(800) = 3.5 %
            assert np.sqrt(np.mean(error**2)) == pytest.approx(np.hypot(expected, noise), rel=0.11)
    measured = (0.6**2 + 1.0 / 12.0) * 256.0
    assert variance_before_rounding(measured, 16.0) == pytest.approx(0.36 * 256.0)
    assert variance_before_rounding(measured, 1.0) == pytest.approx(measured - 1.0 / 12.0)
    assert variance_before_rounding(0.29 * 256.0, 16.0) == 0.0
    assert variance_rounding_std(0.3 * 256.0, 25.6, 16.0) == pytest.approx(256.0 * variance_rounding_std(0.3, 0.1))
