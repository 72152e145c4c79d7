"""Repeats over time: the false-alarm rate on white scatter is the stated one, what is drawn is found within its
uncertainty, and the figures that rest on drifting repeats keep the truth in their intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab.capture_kinds.dark import DarkCapture
from lab.diagnose import diagnose
from lab.fit import fit_recording_set
from lab.fit.noise.noise_fit import fit_noise
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.importers.raw_folder import read_raw_folder
from lab.formats.recording_set import Manifest, RecordingSet
from lab.formats.results import RepeatDrift
from lab.observables.noise.repeats import FALSE_ALARM, RepeatedSetting, drifts_of, find_drifts
from lab.recording import read
from lab.report import provenance_of, render_report
from sim.spectrum import FloatArray

SHARED = Path(__file__).parents[5] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="the shared recordings aren't here")


def setting(mean_dn: FloatArray, elapsed: FloatArray | None = None, runs: Sequence[int] = ()) -> RepeatedSetting:
    """Repeats of a dark setting whose means have a pixel noise of 0.01 DN; `runs`: length of each run."""
    n = len(mean_dn)
    captures = tuple(DarkCapture(id=f"d{k}", kind="dark", side="left", frame=f"d{k}", exposure_s=1.0) for k in range(n))
    return RepeatedSetting(
        captures=captures,
        elapsed=np.arange(n, dtype=float) if elapsed is None else elapsed,
        is_timed=elapsed is not None,
        run=np.repeat(np.arange(len(runs) or 1), runs or [n]),
        mean_dn=mean_dn,
        measure_noise_dn=lambda: 0.01,
    )


# --- false alarms ------------------------------------------------------------------------------------------------


def _white(rng: np.random.Generator, n: int, *, timed: bool = False, runs: Sequence[int] = ()) -> RepeatedSetting:
    elapsed = np.cumsum(rng.exponential(1.0, n)) if timed else None
    return setting(100.0 + 0.03 * rng.standard_normal(n), elapsed, runs)


HEALTHY: dict[str, Callable[[np.random.Generator], list[RepeatedSetting]]] = {
    "twelve repeats": lambda rng: [_white(rng, 12)],
    "five settings of four": lambda rng: [_white(rng, 4) for _ in range(5)],
    "settings of eight at random times": lambda rng: [_white(rng, 8, timed=True) for _ in range(4)],
    "two runs": lambda rng: [_white(rng, 24, timed=True, runs=(12, 12))],
    "fifty pairs": lambda rng: [_white(rng, 2) for _ in range(50)],
    "flats whose scatter grows with the signal": lambda rng: [
        setting(level * (1.0 + 1e-3 * rng.standard_normal(3))) for level in np.linspace(50.0, 3000.0, 15)
    ],
}


@pytest.mark.parametrize("healthy", HEALTHY)
def test_white_scatter_is_no_drift(healthy: str) -> None:
    """`FALSE_ALARM` of 200 sets at most, and three binomial standard deviations: 2 + 3 sqrt(2)."""
    rng, draws = np.random.default_rng(47), 200
    found = sum(bool(drifts_of(HEALTHY[healthy](rng))) for _ in range(draws))
    assert found <= draws * FALSE_ALARM + 3.0 * np.sqrt(draws * FALSE_ALARM)


def test_the_stated_rate_is_used_and_not_just_kept() -> None:
    """The bound of one long setting is nearly the rate itself: a tenth of it would cost power."""
    rng, draws = np.random.default_rng(48), 2000
    found = sum(bool(drifts_of([_white(rng, 12)])) for _ in range(draws))
    rate = draws * FALSE_ALARM
    assert 0.3 * rate < found <= rate + 3.0 * np.sqrt(rate)


# --- what is drawn is found --------------------------------------------------------------------------------------


def test_a_line_is_found_with_its_amplitude() -> None:
    rng = np.random.default_rng(1)
    t = np.linspace(0.0, 90.0, 10)
    (drift,) = drifts_of([setting(64.0 + 0.01 * t + 0.05 * rng.standard_normal(10), t)])
    assert drift.shape == "trend"
    assert abs(drift.amplitude_dn - 0.9) < 3.0 * drift.amplitude_dn_std
    # the level anywhere on the line: amplitude / sqrt(12), up to the ends of ten points
    assert drift.level_dn_std == pytest.approx(abs(drift.amplitude_dn) / np.sqrt(12.0), rel=0.15)
    assert "rise steadily" in drift.statement


@pytest.mark.parametrize(
    ("shape", "change_dn", "tau_s"), [("decay", 40.0, 9.0), ("warm_up", -12.0, 30.0), ("decay", 3.0, 4.0)]
)
def test_an_exponential_is_found_with_its_time_constant(shape: str, change_dn: float, tau_s: float) -> None:
    """Times are irregular: the time constant is in seconds."""
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(1.0, 5.0, 20))
    t -= t[0]
    mean = 500.0 + change_dn * np.exp(-t / tau_s) + 0.05 * rng.standard_normal(20)
    (drift,) = drifts_of([setting(mean, t)])
    assert drift.shape == shape
    assert drift.time_constant_s is not None
    assert drift.time_constant_s_std is not None
    assert drift.steady_dn is not None
    assert drift.steady_dn_std is not None
    assert abs(drift.time_constant_s - tau_s) < 3.0 * drift.time_constant_s_std
    assert abs(drift.steady_dn - 500.0) < 3.0 * drift.steady_dn_std
    assert drift.time_constant_frames is None
    # the mean of the repeats and the steady value are one within the level's uncertainty
    assert abs(mean.mean() - 500.0) < 3.0 * drift.level_dn_std


def test_a_step_is_found_and_a_single_frame_is_none() -> None:
    rng = np.random.default_rng(3)
    noise = 0.02 * rng.standard_normal(12)
    (drift,) = drifts_of([setting(80.0 + noise - (np.arange(12) >= 7))])
    assert drift.shape == "step"
    assert abs(drift.amplitude_dn + 1.0) < 3.0 * drift.amplitude_dn_std
    assert drifts_of([setting(80.0 + noise + (np.arange(12) == 5))]) == []


def test_a_fade_in_the_second_of_two_runs_is_found_there() -> None:
    """Darks before and after bright frames: those before are steady."""
    rng = np.random.default_rng(4)
    t = np.concatenate([4.0 * np.arange(6), 200.0 + 4.0 * np.arange(8)])
    fade = np.where(t >= 200.0, 25.0 * np.exp(-(t - 200.0) / 12.0), 0.0)
    (drift,) = drifts_of([setting(108.0 + fade + 0.03 * rng.standard_normal(14), t, (6, 8))])
    assert (drift.shape, drift.changing) == ("decay", tuple(f"d{k}" for k in range(6, 14)))
    assert drift.time_constant_s == pytest.approx(12.0, abs=3.0 * (drift.time_constant_s_std or 0.0))


def test_a_trend_that_pairs_have_in_common_is_found() -> None:
    """In single pairs it is a fifth of the scatter."""
    rng = np.random.default_rng(5)
    pairs = [setting(level + np.array([0.0, 0.4]) + 0.3 * rng.standard_normal(2)) for level in range(100, 160)]
    (drift,) = drifts_of(pairs)
    assert (drift.shape, drift.is_of_one_setting, len(drift.captures)) == ("trend", False, 120)
    assert abs(drift.amplitude_dn - 0.4) < 3.0 * drift.amplitude_dn_std
    assert "60 settings in common" in drift.statement


# --- captures ----------------------------------------------------------------------------------------------------

START = datetime(2026, 3, 2, 9, 0, tzinfo=UTC)


def captured(
    settings: Sequence[tuple[str, float, float]], cfa: str, *, timed: bool, gain: float, read_e: float, seed: int
) -> RecordingSet:
    """Frames (kind, exposure in s, mean in electrons) one after the other, of a camera of black level 200 DN."""
    rng, time = np.random.default_rng(seed), START
    captures: list[dict[str, Any]] = []
    frames = {}
    for number, (kind, exposure_s, mean_e) in enumerate(settings):
        name = f"{kind}-{number:03d}"
        capture = {"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": exposure_s}
        captures.append(capture | ({"time": time.isoformat()} if timed else {}))
        time += timedelta(seconds=exposure_s)
        charge = rng.poisson(mean_e, (48, 64)) + read_e * rng.standard_normal((48, 64))
        frames[name] = np.clip(np.rint(200.0 + gain * charge), 0, 65535).astype(np.uint16)
    if timed:  # the manifest's order isn't that of capture
        rng.shuffle(captures)  # type: ignore[arg-type]
    camera = {"rows": 48, "cols": 64, "cfa": cfa, "bit_depth": 16}
    return RecordingSet(Manifest.model_validate({"cameras": {"left": camera}, "captures": captures}), frames)


def bright() -> list[tuple[str, float, float]]:
    return [("flat", 0.05 * level, 1500.0 * level) for level in range(1, 11) for _ in range(4)]


def darks(rate: float, exposure_s: float, repeats: int, extra_e: Callable[[float], float]) -> list[Any]:
    """Darks of a dark current, e/s, with `extra_e` of the time since the first."""
    return [("dark", exposure_s, rate * exposure_s + extra_e(k * exposure_s)) for k in range(repeats)]


@cache
def drifting(case: str) -> tuple[RecordingSet, float]:
    """Sets whose longest darks don't repeat each other, and the dark current, e/s."""

    def none(_: float) -> float:
        return 0.0

    if case == "a fade after the flats":  # two exposures: nothing but the fading darks tells the dark current
        fade = darks(3.0, 6.0, 12, lambda t: 400.0 * np.exp(-t / 11.0))
        return captured(
            [*darks(3.0, 0.02, 8, none), *bright(), *fade], "MONO", timed=True, gain=0.5, read_e=4.0, seed=1
        ), 3.0
    if case == "a fade of a colour camera without times":
        fade = darks(12.0, 2.0, 10, lambda t: 250.0 * np.exp(-t / 3.0))
        first = [*darks(12.0, 0.01, 6, none), *darks(12.0, 0.5, 6, none)]
        return captured([*first, *bright(), *fade], "GBRG", timed=False, gain=0.25, read_e=6.0, seed=2), 12.0
    if case == "a sensor that warms up":  # its dark current comes to 30 e/s
        warming = darks(30.0, 5.0, 16, lambda t: -150.0 * 0.6 * np.exp(-t / 25.0))
        first = darks(30.0, 0.05, 6, none)
        return captured([*first, *warming, *bright()], "MONO", timed=True, gain=0.8, read_e=3.0, seed=3), 30.0
    if case == "an offset that drifts":
        drift = darks(8.0, 3.0, 8, lambda t: 2.0 * t)
        first = [*darks(8.0, 0.1, 8, none), *darks(8.0, 1.0, 8, none)]
        return captured([*first, *drift, *bright()], "RGGB", timed=True, gain=0.4, read_e=5.0, seed=4), 8.0
    raise ValueError(case)


@pytest.mark.parametrize(
    "case",
    [
        "a fade after the flats",
        "a fade of a colour camera without times",
        "a sensor that warms up",
        "an offset that drifts",
    ],
)
def test_the_dark_current_of_drifting_darks_keeps_the_truth(case: str) -> None:
    recordings, rate = drifting(case)
    found = find_drifts(recordings, "left", ("dark",))
    assert len(found) == 1
    fit = fit_noise(recordings, "left")
    assert fit.dark_current_e_per_s is not None
    assert fit.dark_current_e_per_s_std is not None
    assert fit.black_level_dn is not None
    assert fit.black_level_dn_std is not None
    assert abs(fit.dark_current_e_per_s - rate) < 1.96 * fit.dark_current_e_per_s_std
    assert abs(fit.black_level_dn - 200.0) < 3.0 * fit.black_level_dn_std
    for plane in fit.emva1288.values():
        for name in ("mean", "variance"):
            value = getattr(plane, f"dark_current_from_{name}_e_per_s")
            std = getattr(plane, f"dark_current_from_{name}_e_per_s_std")
            assert value is None or abs(value - rate) < 3.0 * std


def test_exposures_that_repeat_themselves_decide_where_another_fades() -> None:
    """0.01 and 0.5 s tell 12 e/s; the fading 2 s add nothing and take nothing."""
    recordings, _ = drifting("a fade of a colour camera without times")
    fit = fit_noise(recordings, "left")
    steady = fit_noise(recordings.without({d.id for d in recordings.captures("dark") if d.exposure_s == 2.0}), "left")
    assert fit.dark_current_e_per_s == pytest.approx(steady.dark_current_e_per_s, rel=0.02)
    assert fit.dark_current_e_per_s_std == pytest.approx(steady.dark_current_e_per_s_std, rel=0.1)
    assert abs((fit.read_noise_e or 0.0) - 6.0) < 3.0 * (fit.read_noise_e_std or 0.0)


def test_a_trend_that_dark_pairs_have_in_common_is_in_their_uncertainty() -> None:
    """The second of two frames is 0.5 DN higher at every exposure."""
    exposures_s = np.geomspace(0.01, 8.0, 24)
    pairs = [("dark", float(t), 6.0 * float(t) + more) for t in exposures_s for more in (0.0, 1.0)]
    recordings = captured([*pairs, *bright()], "MONO", timed=True, gain=0.5, read_e=4.0, seed=6)
    (drift,) = find_drifts(recordings, "left", ("dark",))
    assert not drift.is_of_one_setting
    fit = fit_noise(recordings, "left")
    # either frame may be the right one: 0.25 DN of each level, over 24 of them
    assert (fit.black_level_dn_std or 0.0) >= 0.25 / np.sqrt(24)
    assert abs((fit.dark_current_e_per_s or 0.0) - 6.0) < 3.0 * (fit.dark_current_e_per_s_std or 0.0)


def test_a_drift_is_a_line_of_the_fit_and_a_picture_of_the_report() -> None:
    recordings, _ = drifting("a fade after the flats")
    result = fit_recording_set(recordings)
    (drift,) = result.cameras["left"].repeat_drifts
    assert (drift.shape, drift.kind, len(drift.changing)) == ("decay", "dark", 12)
    assert drift.statement in result.cameras["left"].remarks
    assert "\n" not in drift.statement
    assert RepeatDrift.model_validate_json(drift.model_dump_json()) == drift
    page = render_report(recordings, result, None, None, provenance_of(recordings))
    assert "Repeats over time" in page
    steady = recordings.without({c.id for c in recordings.captures("dark") if c.exposure_s == 6.0})
    again = fit_recording_set(steady)
    assert again.cameras["left"].repeat_drifts == ()
    assert "Repeats over time" not in render_report(steady, again, None, None, provenance_of(steady))


def test_repeats_of_every_kind_are_looked_at_and_other_settings_are_none() -> None:
    """Narrowband light whose lamp warms up; the same frames at rising temperatures or wavelengths are no repeats."""
    rng = np.random.default_rng(9)
    frames = {
        f"n{k}": np.rint(400.0 + 5.0 * k + 3.0 * rng.standard_normal((24, 32))).astype(np.uint16) for k in range(8)
    }

    def recordings(**stated: Callable[[int], float]) -> RecordingSet:
        base = {"kind": "narrowband", "side": "left", "exposure_s": 0.1, "radiance": "lamp.csv", "wavelength_nm": 550.0}
        captures = [
            base | {"id": f"n{k}", "frame": f"n{k}", "bandwidth_nm": 5.0} | {key: of(k) for key, of in stated.items()}
            for k in range(8)
        ]
        camera = {"rows": 24, "cols": 32, "cfa": "MONO", "bit_depth": 12}
        return RecordingSet(Manifest.model_validate({"cameras": {"left": camera}, "captures": captures}), frames)

    (drift,) = find_drifts(recordings(), "left")
    assert (drift.shape, drift.kind) == ("trend", "narrowband")
    assert "narrowband, 550 nm, 0.1 s" in drift.statement
    assert find_drifts(recordings(wavelength_nm=lambda k: 500.0 + 5.0 * k), "left") == ()
    assert find_drifts(recordings(temperature_c=lambda k: 20.0 + 3.0 * k), "left") == ()
    assert find_drifts(recordings(gain_db=lambda k: 1.0 * k), "left") == ()
    assert find_drifts(recordings(), "left", ("dark",)) == ()
    assert find_drifts(recordings(), "left", left_out=[f"n{k}" for k in range(6)]) == ()


def test_copies_of_frames_are_no_repeats() -> None:
    """Four copies of one frame and four of another would be a step without scatter."""
    rng = np.random.default_rng(10)
    two = [np.rint(100.0 + 3.0 * rng.standard_normal((24, 32))).astype(np.uint16) for _ in range(2)]
    base = {"kind": "dark", "side": "left", "exposure_s": 0.1}
    captures = [base | {"id": f"d{k}", "frame": f"d{k}"} for k in range(8)]
    camera = {"rows": 24, "cols": 32, "cfa": "MONO", "bit_depth": 12}
    manifest = Manifest.model_validate({"cameras": {"left": camera}, "captures": captures})
    assert find_drifts(RecordingSet(manifest, {f"d{k}": two[k // 4] for k in range(8)}), "left") == ()


# --- recordings of others ----------------------------------------------------------------------------------------


@needs_shared
def test_persistence_of_another_simulator_is_found_and_its_dark_current_is_right() -> None:
    """Pyxel: 5.0 e/s, 3.0 e, 100 DN; one trap species of 10 s, of which the simulator keeps 1 - 4 s / 10 s from frame
    to frame of 4 s: a time constant of -4 s / ln 0.6 = 7.83 s."""
    recordings = read(SHARED / "pyxel_persistence")
    (drift,) = find_drifts(recordings, "left", ("dark",))
    assert drift.shape == "decay"
    assert drift.changing == tuple(f"dark-{k}" for k in range(132, 144))
    assert drift.time_constant_s == pytest.approx(7.83, abs=3.0 * (drift.time_constant_s_std or 0.0))
    fit = fit_noise(recordings, "left")
    for name, truth in (
        ("dark_current_e_per_s", 5.0), ("read_noise_e", 3.0), ("black_level_dn", 100.0),
        ("conversion_gain_dn_per_e", 0.4),
    ):  # fmt: skip
        assert abs(getattr(fit, name) - truth) < 1.96 * getattr(fit, f"{name}_std"), name
    (plane,) = fit.emva1288.values()
    for name in ("mean", "variance"):
        value = getattr(plane, f"dark_current_from_{name}_e_per_s")
        assert abs(value - 5.0) < 1.96 * getattr(plane, f"dark_current_from_{name}_e_per_s_std")


@needs_shared
def test_persistence_of_another_simulator_is_named() -> None:
    """Its traps exchange charge in steps of 4 s over 10 s: 0.6 of it stays from frame to frame, as of a time constant
    of 4 / ln(1 / 0.6) = 7.83 s. They take up by that time constant, too, and from what they release."""
    result = diagnose(read(SHARED / "pyxel_persistence"))
    (named,) = result.effects
    assert named.name == "persistence"
    assert named.parameters["release_s"].value == pytest.approx(4.0 / np.log(1.0 / 0.6), rel=0.02)


@needs_shared
def test_real_lamps_that_scatter_at_random_have_no_drift() -> None:
    """The CCD's flats scatter by 0.94 DN where noise explains 0.04, from pair to pair at random: of 38 unsaturated
    pairs as many rise as fall, and its stack of twelve has no order."""
    for name in ("emva1288_ccd", "emva1288_cmos_crop", "emva1288_simulated_crop"):
        assert find_drifts(read_emva1288(SHARED / name), "left") == ()
    for day in ("d1", "d2"):
        assert find_drifts(read_raw_folder(SHARED / "llanos_darks" / day), "left") == ()
