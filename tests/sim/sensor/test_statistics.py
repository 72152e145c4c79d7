"""Frames against their moments: every noise source alone and all together, 200 frames each.

Pixels are independent but for the rows' noise, so over `n` pixels the mean's chi-squared is n within 4.5 sqrt(2 n), and
the mean of sample variance over wanted variance is 1 within 4.5 times its own scatter over the pixels divided by
sqrt(n).
"""

from __future__ import annotations

import numpy as np
import pytest

from sim.camera import CameraModel, Lens
from sim.frame import Exposure, dark_electrons
from sim.scene.scenes import Darkness
from sim.sensor.electrons import FixedPattern, ReadOut, dn_moments, sample_from
from sim.spectrum import FloatArray, Spectrum

FRAMES = 200
SHAPE = 48, 64
QUIET = CameraModel(
    rows=SHAPE[0], cols=SHAPE[1], pixel_pitch_um=3.45, fill_factor=1.0, cfa="MONO", bit_depth=12, black_level_dn=100.0,
    white_level_dn=4095.0,
    conversion_gain_dn_per_e=1.0, full_well_e=10_000.0, read_noise_e=0.0, dark_current_e_per_s=0.0, dsnu_e=0.0,
    prnu_percent=0.0,
    quantum_efficiency={"Y": Spectrum.of([400.0, 700.0], [0.5, 0.5])}, lens=Lens(f_number=4.0, focal_length_mm=8.0),
)  # fmt: skip

#: name -> (what differs from the quiet camera, mean electrons, gain in dB)
CASES: dict[str, tuple[dict[str, float], float, float]] = {
    "shot noise, few electrons": ({"read_noise_e": 1.5}, 3.0, 0.0),
    "shot noise": ({}, 700.0, 0.0),
    "shot noise, many electrons": ({"conversion_gain_dn_per_e": 0.4}, 8000.0, 0.0),
    "read noise": ({"read_noise_e": 4.0}, 0.0, 0.0),
    "row noise": ({"row_noise_e": 3.0, "read_noise_e": 1.0}, 0.0, 0.0),
    "gain": ({"read_noise_e": 2.0, "conversion_gain_dn_per_e": 0.3}, 150.0, 18.0),
    "quantisation": ({"read_noise_e": 2.0, "conversion_gain_dn_per_e": 0.15, "black_level_dn": 30.4}, 0.0, 0.0),
    "coarse quantisation of light": ({"read_noise_e": 2.0, "conversion_gain_dn_per_e": 0.03}, 300.0, 0.0),
    "clipping at black": ({"read_noise_e": 3.0, "black_level_dn": 1.0}, 0.0, 0.0),
    "clipping at the converter's end": ({"white_level_dn": 1023.0, "read_noise_e": 2.0}, 930.0, 0.0),
    "full well": ({"conversion_gain_dn_per_e": 0.35, "read_noise_e": 3.0}, 9990.0, 0.0),
    "full well beyond the converter's end": ({"conversion_gain_dn_per_e": 0.41}, 9850.0, 0.0),
    "PRNU": ({"prnu_percent": 2.0, "conversion_gain_dn_per_e": 0.4}, 4000.0, 0.0),
    "DSNU": ({"dsnu_e": 6.0, "read_noise_e": 2.0}, 0.0, 0.0),
    "column offsets": ({"column_noise_e": 5.0, "read_noise_e": 2.0}, 0.0, 0.0),
    "everything": (
        {"read_noise_e": 2.4, "row_noise_e": 1.0, "column_noise_e": 0.7, "dsnu_e": 1.5, "prnu_percent": 0.8,
         "conversion_gain_dn_per_e": 0.4},
        2500.0,
        3.0,
    ),
}  # fmt: skip


def _frames(
    camera: CameraModel,
    electrons: FloatArray,
    pattern: FixedPattern | None,
    gain_db: float = 0.0,
    read_out: ReadOut | None = None,
) -> FloatArray:
    rng = np.random.default_rng(12)
    extra = {} if read_out is None else {"read_out": read_out}
    drawn = [
        sample_from(electrons, camera, rng, pattern, dark_electrons=10.0, gain_db=gain_db, **extra)
        for _ in range(FRAMES)
    ]
    return np.stack(drawn).astype(float)


def _mean_of_variance_agrees(ratio: FloatArray) -> None:
    assert ratio.mean() == pytest.approx(1.0, abs=4.5 * ratio.std() / np.sqrt(ratio.size))


@pytest.mark.parametrize("name", CASES)
def test_frames_agree_with_expected_and_variance(name: str) -> None:
    changes, level, gain_db = CASES[name]
    camera = QUIET.model_copy(update=changes)
    pattern = FixedPattern.draw(camera, np.random.default_rng(11))
    # Levels that differ by a few codes: rounding is met at every phase.
    electrons = level + 10.0 + np.linspace(0.0, 7.0, SHAPE[1]) * np.ones(SHAPE)
    frames = _frames(camera, electrons, pattern, gain_db)
    mean, variance = dn_moments(electrons, camera, gain_db, fixed_pattern=pattern, dark_electrons=10.0)
    row = (camera.row_noise_e * camera.conversion_gain_dn_per_e * 10 ** (gain_db / 20)) ** 2
    pull = (frames.mean(axis=0) - mean) / np.sqrt(variance / FRAMES)
    if row == 0.0:
        assert np.sum(pull**2) == pytest.approx(pull.size, abs=4.5 * np.sqrt(2.0 * pull.size))
        assert abs(pull.sum()) < 4.5 * np.sqrt(pull.size)
    else:
        # Means of whole rows: the shared noise stays, the rest goes down with the pixels.
        wanted = (row + (variance - row).mean(axis=1) / SHAPE[1]) / FRAMES
        pull = (frames.mean(axis=0) - mean).mean(axis=1) / np.sqrt(wanted)
        assert np.sum(pull**2) == pytest.approx(SHAPE[0], abs=4.5 * np.sqrt(2.0 * SHAPE[0]))
        # Covariance of neighbours in a row is the rows' variance, of neighbours in a column none.
        rest = frames - frames.mean(axis=0)
        along = (rest[:, :, 1:] * rest[:, :, :-1]).sum(axis=0).mean(axis=1) / (FRAMES - 1)
        across = (rest[:, 1:] * rest[:, :-1]).sum(axis=0).mean(axis=1) / (FRAMES - 1)
        assert along.mean() == pytest.approx(row, abs=4.5 * along.std() / np.sqrt(along.size))
        assert across.mean() == pytest.approx(0.0, abs=4.5 * across.std() / np.sqrt(across.size))
    ratio = frames.var(axis=0, ddof=1) / variance
    # Pixels of a row share the row's noise: one figure a row is independent of the others.
    _mean_of_variance_agrees(ratio if row == 0.0 else ratio.mean(axis=1))


@pytest.mark.parametrize(
    ("source", "size"), [("dsnu_e", 5.0), ("column_noise_e", 4.0), ("prnu_percent", 1.5), ("row_noise_e", 0.0)]
)
def test_fixed_patterns_have_their_spatial_variance(source: str, size: float) -> None:
    """Variance over the pixels of the mean of 200 frames: the pattern's and what the temporal noise leaves, 1/200 of
    it.
    """
    camera = QUIET.model_copy(
        update={"read_noise_e": 2.0, "conversion_gain_dn_per_e": 0.4, "rows": 96, "cols": 400, source: size}
    )
    pattern = FixedPattern.draw(camera, np.random.default_rng(21))
    electrons = np.full((96, 400), 2010.0)
    mean = _frames(camera, electrons, pattern).mean(axis=0)
    temporal = dn_moments(electrons, camera)[1].mean() / FRAMES
    in_e = {"prnu_percent": 2000.0 * size / 100.0}.get(source, size)
    if source == "column_noise_e":  # one value a column
        assert mean.mean(axis=0).var() == pytest.approx((0.4 * in_e) ** 2 + temporal / 96, rel=4.5 * np.sqrt(2 / 400))
    else:
        assert mean.var() == pytest.approx((0.4 * in_e) ** 2 + temporal, rel=4.5 * np.sqrt(2 / mean.size))


def test_dark_current_is_shot_noise_that_grows_with_temperature() -> None:
    camera = QUIET.model_copy(
        update={"dark_current_e_per_s": 8.0, "dark_current_doubling_c": 6.0, "read_noise_e": 1.0, "prnu_percent": 5.0}
    )
    exposure = Exposure(Darkness(), 2.0, temperature_c=37.0)
    dark = dark_electrons(camera, exposure)
    assert dark == pytest.approx(8.0 * 2.0 * 4.0)
    pattern = FixedPattern.draw(camera, np.random.default_rng(31))  # PRNU doesn't act on it
    rng = np.random.default_rng(32)
    electrons = np.full(SHAPE, dark)
    frames = np.stack(
        [sample_from(electrons, camera, rng, pattern, dark_electrons=dark) for _ in range(FRAMES)]
    ).astype(float)
    pull = (frames.mean(axis=0) - 100.0 - dark) / np.sqrt((dark + 1.0 + 1.0 / 12.0) / FRAMES)
    assert np.sum(pull**2) == pytest.approx(pull.size, abs=4.5 * np.sqrt(2.0 * pull.size))
    _mean_of_variance_agrees(frames.var(axis=0, ddof=1) / (dark + 1.0 + 1.0 / 12.0))


def test_what_effects_add_to_the_read_out_is_in_the_moments() -> None:
    """An added noise with a mean and a converter that bends: K 1 DN/e, slope 0.9."""
    camera = QUIET.model_copy(update={"read_noise_e": 2.0, "row_noise_e": 1.0})
    read_out = ReadOut(
        added=lambda shape, rng: 3.0 + 2.0 * rng.standard_normal(shape),
        added_e=3.0,
        added_e2=4.0,
        codes=lambda dn: 10.0 + 0.9 * dn,
    )
    electrons = np.full(SHAPE, 40.0)
    frames = _frames(camera, electrons, None, read_out=read_out)
    mean, variance = dn_moments(electrons, camera, read_out=read_out)
    assert mean[0, 0] == pytest.approx(10.0 + 0.9 * 143.0)
    assert variance[0, 0] == pytest.approx(0.81 * (40.0 + 4.0 + 1.0 + 4.0) + 1.0 / 12.0)
    ratio = frames.var(axis=0, ddof=1) / variance
    _mean_of_variance_agrees(ratio.mean(axis=1))
    pull = (frames.mean(axis=(0, 2)) - mean[:, 0]) / np.sqrt((0.81 + (variance[0, 0] - 0.81) / SHAPE[1]) / FRAMES)
    assert np.sum(pull**2) == pytest.approx(SHAPE[0], abs=4.5 * np.sqrt(2.0 * SHAPE[0]))
