"""What the standard's nonuniformity holds besides the pixels': uneven light, and gains of rows and columns; and two
estimates of one figure."""

from __future__ import annotations

import numpy as np
import pytest

from lab.diagnose import diagnose
from lab.fit import fit_recording_set
from lab.fit.noise.noise_fit import fit_noise
from lab.formats.results import Emva1288, NoiseFit
from lab.report.emva import compare_estimates, table_rows
from tests.lab.mono_session import MonoSession


def fitted(session: MonoSession) -> tuple[NoiseFit, Emva1288]:
    noise = fit_noise(session.recordings(), "left")
    return noise, noise.emva1288["Y"]


@pytest.mark.parametrize(
    "session",
    [
        # as user_faults/prnu: light that falls off by 25 % to the corners, PRNU 1 %
        MonoSession(shape=(96, 120), fall_off=0.25, stacked=16, seed=6),
        MonoSession(shape=(120, 96), fall_off=0.12, stacked=16, gain=0.8, bits=14, seed=8),
        MonoSession(shape=(96, 96), fall_off=0.5, stacked=4, prnu=0.004, read_e=9.0, seed=9),
        MonoSession(shape=(128, 64), fall_off=0.08, stacked=16, prnu=0.02, efficiency=0.8, seed=10),
    ],
)
def test_uneven_light_is_reported_beside_the_nonuniformity(session: MonoSession) -> None:
    """Span and standard deviation of the light over its mean, within 4 standard deviations. That of the surface: 4
    times the pixels' scatter by chance has the shape of the light's s, of which 1 / sqrt(n) is in its amplitude."""
    noise, own = fitted(session)
    light = session.light()
    light /= light.mean()
    assert own.light_nonuniformity_percent is not None and own.light_nonuniformity_percent_std is not None
    away = abs(own.light_nonuniformity_percent - 100.0 * float(np.ptp(light)))
    assert away < 4.0 * own.light_nonuniformity_percent_std
    assert own.shading_percent == pytest.approx(100.0 * light.std(), abs=4.0 * 100.0 * session.prnu / light.size**0.5)
    (line,) = (one for one in own.remarks if "the light is uneven" in one)
    assert "above the standard's limit of 3 %" in line and "\n" not in line
    assert noise.prnu_percent is not None and noise.prnu_percent_std is not None
    assert abs(noise.prnu_percent - 100.0 * session.prnu) < 4.0 * noise.prnu_percent_std
    assert f"{own.shading_percent:.3g} % of shading" in line
    assert any(row.quantity.startswith("nonuniformity of the light") for row in table_rows(noise.emva1288))
    assert not any("gains of" in one for one in own.remarks)


@pytest.mark.parametrize("fall_off", [0.0, 0.015])
def test_even_light_is_not_reported(fall_off: float) -> None:
    _, own = fitted(MonoSession(shape=(96, 120), stacked=16, fall_off=fall_off, seed=4))
    assert not any("the light is uneven" in one or "gains of" in one for one in own.remarks)


@pytest.mark.parametrize(
    ("session", "line"),
    [
        (MonoSession(column_gain=0.01, stacked=8), "column"),
        (MonoSession(row_gain=0.006, stacked=16, shape=(80, 64), gain=0.9, bits=14, seed=3), "row"),
        (MonoSession(column_gain=0.02, stacked=4, fall_off=0.2, shape=(64, 128), prnu=0.005, seed=5), "column"),
    ],
)
def test_gains_of_rows_and_columns_are_reported(session: MonoSession, line: str) -> None:
    """The estimate is of these rows or columns as a sample: within 4 standard deviations of the truth. The other
    direction has nothing."""
    _, own = fitted(session)
    true = 100.0 * max(session.column_gain, session.row_gain)
    value, std = getattr(own, f"{line}_gain_percent"), getattr(own, f"{line}_gain_percent_std")
    assert abs(value - true) < 4.0 * std
    (sentence,) = (one for one in own.remarks if "gains of" in one)
    assert sentence.startswith(f"the gains of {line}s differ by")


@pytest.mark.extra  # whole diagnoses
@pytest.mark.parametrize(
    ("session", "name", "percent"),
    [
        (MonoSession(column_gain=0.01, stacked=8), "column_gain", 1.0),
        (MonoSession(row_gain=0.006, stacked=8, shape=(80, 64), seed=23), "row_gain", 0.6),
    ],
)
def test_the_diagnosis_names_gains_of_lines(session: MonoSession, name: str, percent: float) -> None:
    """The size is within 4 standard deviations of the truth."""
    recordings = session.recordings()
    (found,) = diagnose(recordings, fit_recording_set(recordings, steps=("noise",))).effects
    assert found.name == name
    size = found.parameters["gain_percent"]
    assert size.std is not None and abs(size.value - percent) < 4.0 * size.std


@pytest.mark.parametrize("bend", [0.0, -0.06, -0.12])
def test_two_estimates_of_the_gain_are_compared_and_the_line_knows_its_model_error(bend: float) -> None:
    """A response y = e (1 + b e / full) has the variance K y (1 + 3 b ..): the standard's line to 70 % of saturation
    is far from K at zero signal, and its standard deviation covers that: 3 of them hold the truth. The sentence has
    both, and their difference."""
    session = MonoSession(shape=(96, 96), bend=bend, levels=16, prnu=0.005, seed=2)
    noise, own = fitted(session)
    assert abs(own.system_gain_dn_per_e - session.gain) < 3.0 * own.system_gain_dn_per_e_std
    gains = [line for line in compare_estimates(noise) if "system gain" in line]
    assert len(gains) == 1 and "combined standard deviations apart: with nonlinearity or a brighter-fatter" in gains[0]
    assert noise.conversion_gain_dn_per_e is not None
    percent = 100.0 * (own.system_gain_dn_per_e / noise.conversion_gain_dn_per_e - 1.0)
    assert f"{'-' if percent < 0 else '+'}{abs(percent):.2g} %" in gains[0]


def test_estimates_of_another_amplification_are_compared_at_the_same() -> None:
    """At 20 dB, the standard's K is ten times that at 0 dB: no difference of 900 %."""
    recordings = MonoSession(gain=2.5, bits=16, black_dn=400.0).recordings()
    captures = tuple(c.model_copy(update={"gain_db": 20.0}) for c in recordings.manifest.captures)
    noise = fit_noise(recordings.under(recordings.manifest.model_copy(update={"captures": captures})), "left")
    assert noise.gain_db == 20.0 and noise.conversion_gain_dn_per_e == pytest.approx(0.25, rel=0.05)
    (line,) = (one for one in compare_estimates(noise) if "system gain" in one)
    shown = float(line.split(" DN/e, ")[2].split(" %")[0])
    assert abs(shown) < 5.0
