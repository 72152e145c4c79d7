"""Bands of wavelength in which fitted curves differ from the maker's."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.spectral.maker_departures import compare_curves


def test_bands_that_part_are_found_where_they_are_and_nowhere_else() -> None:
    wave = np.arange(400.0, 721.0, 10.0)
    maker = np.concatenate([np.exp(-0.5 * ((wave - p) / 35.0) ** 2) for p in (600.0, 530.0, 460.0)])
    std = 0.003 * maker + 0.001
    rng = np.random.default_rng(8)
    off = maker.copy()
    off[wave.size + 8 : wave.size + 12] *= 1.06  # green, 480..510 nm
    scale, found = compare_curves(
        wave, "RGB", 0.4 * (off + std * rng.standard_normal(off.size)), np.diag((0.4 * std) ** 2), maker
    )
    assert scale == pytest.approx(0.4, rel=0.005)
    assert [d.channel for d in found] == ["G"]
    assert (found[0].from_nm, found[0].to_nm) == (pytest.approx(480.0, abs=10.0), pytest.approx(510.0, abs=10.0))
    # 4 % where an end of the band was missed.
    assert found[0].difference_percent == pytest.approx(6.0, abs=2.0)
    alarms = 0
    for _ in range(200):
        same = 0.4 * (maker + std * rng.standard_normal(maker.size))
        alarms += bool(compare_curves(wave, "RGB", same, np.diag((0.4 * std) ** 2), maker)[1])
    assert alarms <= 6  # 1 % of 200 are 2; 6 are exceeded by chance in 0.5 %
