"""An exchange of frames in a photon-transfer series is proposed and not made: the captures are left out of the fit.
Series in order, and series whose other settings explain their levels, have none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lab.diagnose.metadata.frames import misplaced_frames
from lab.errors import NotDetermined
from lab.fit.noise.noise_fit import fit_noise
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.acquisition_errors import exchanged_frames
from tests.lab.fit.noise.synthetic_sensor import Sensor, recording_set, scores

CMOS = Path(__file__).parents[4] / "shared" / "data" / "emva1288_cmos_crop"
SENSOR = Sensor(shape=(64, 96), bend=0.02)
DARKS = [(0.001, 3), (1.0, 3), (2.0, 3)]
LADDER = [(round(float(light), 3), 2) for light in np.linspace(0.05, 1.1, 12)]  # the last saturates in no channel


def swapped(recordings: RecordingSet, one: list[str], other: list[str]) -> RecordingSet:
    """The recordings with the frames of captures exchanged, one by one."""
    frame = {c.id: c.frame for c in recordings.captures()}
    other_of = dict(zip([*one, *other], [*other, *one], strict=True))
    captures = tuple(
        c.model_copy(update={"frame": frame[other_of.get(c.id, c.id)]}) for c in recordings.manifest.captures
    )
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


def _of(recordings: RecordingSet, kind: str, level: int) -> list[str]:
    captures = recordings.captures(kind, "left")
    exposures = sorted({c.exposure_s for c in captures})
    return [c.id for c in captures if c.exposure_s == exposures[level]]


EXCHANGES = {
    "a frame of two levels": (("flat", 3, 1), ("flat", 7, 1)),
    "all frames of two levels": (("flat", 3, 2), ("flat", 7, 2)),
    "neighbouring levels": (("flat", 5, 1), ("flat", 6, 1)),
    "a dark and a flat": (("dark", 1, 1), ("flat", 6, 1)),
    "the dimmest and the brightest": (("flat", 0, 1), ("flat", 11, 1)),
}


@pytest.mark.parametrize("exchange", EXCHANGES)
def test_an_exchange_is_proposed_and_its_captures_are_left_out(exchange: str) -> None:
    recordings = recording_set(SENSOR, DARKS, LADDER)
    assert exchanged_frames(recordings, "left") is None
    one, other = (_of(recordings, kind, level)[:count] for kind, level, count in EXCHANGES[exchange])
    wrong = swapped(recordings, one, other)
    found = exchanged_frames(wrong, "left")
    assert found is not None
    assert set(found.captures) == {*one, *other}
    fit = fit_noise(wrong, "left")
    (line,) = [remark for remark in fit.remarks if "hold each other's frames" in remark]
    assert all(name in line for name in (*one, *other))
    assert "they are left out: if the frames were exchanged, exchange these frames" in line
    assert max(map(abs, scores(fit, SENSOR).values())) < 3.5  # of six figures
    assert not fit.inconsistent_levels
    # the fit is that of the other captures, in every figure
    without = fit_noise(recordings.without({*one, *other}), "left")
    assert without == fit.model_copy(update={"remarks": tuple(r for r in fit.remarks if r != line)})


def test_levels_in_order_have_no_exchanged_frames() -> None:
    """A lamp that drifts by 2 % from frame to frame, a response that bends by a tenth, and levels that saturate."""
    for sensor in (Sensor(shape=(64, 96), bend=0.1), Sensor(shape=(64, 96), well=5000.0, cfa="MONO")):
        assert exchanged_frames(recording_set(sensor, DARKS, LADDER), "left") is None
    rng = np.random.default_rng(7)
    recordings = recording_set(SENSOR, DARKS, LADDER)
    frames = {c.frame: recordings.frame(c) for c in recordings.captures("dark")}
    for flat in recordings.captures("flat"):
        signal = recordings.frame(flat) - SENSOR.black
        frames[flat.frame] = np.rint(SENSOR.black + signal * (1.0 + 0.02 * rng.standard_normal())).astype(np.uint16)
    drifting = RecordingSet(recordings.manifest, {k: np.minimum(v, 4095) for k, v in frames.items()})
    assert exchanged_frames(drifting, "left") is None


def test_darks_and_flats_stated_for_each_other_are_refused_with_the_remedy() -> None:
    recordings = recording_set(Sensor(shape=(32, 48)), LADDER, [(light, 2) for light, _ in LADDER])
    other = {"dark": "flat", "flat": "dark"}
    content = recordings.manifest.model_dump(mode="json")
    for capture in content["captures"]:
        capture["kind"] = other[capture["kind"]]
    exchanged = recordings.under(type(recordings.manifest).model_validate(content))
    with pytest.raises(NotDetermined, match="darks and flats may be stated for each other"):
        fit_noise(exchanged, "left")


@pytest.mark.skipif(not CMOS.is_dir(), reason="the shared recordings aren't here")
def test_exchanged_frames_of_a_real_camera_are_found() -> None:
    """Every fourth level of a CMOS camera; neighbours differ by 7 %."""
    recordings = read_emva1288(CMOS)
    assert exchanged_frames(recordings, "left") is None
    for one, other in (
        (["b_028_snap_001"], ["b_048_snap_001"]),
        (["b_048_snap_002"], ["b_052_snap_002"]),
        (["d_048_snap_001"], ["b_048_snap_001"]),
    ):
        found = exchanged_frames(swapped(recordings, one, other), "left")
        assert found is not None
        assert set(found.captures) == {*one, *other}


def dark_series(
    currents: dict[float, float], exposures_s: tuple[float, ...], repeats: int, cfa: str, flats_c: float
) -> RecordingSet:
    """Darks of a 16-bit camera of 0.25 DN/e and 6 e read noise with a dark current, e/s, at each temperature, in random
    order; flats at `flats_c`."""
    rng = np.random.default_rng(20)
    settings: list[tuple[str, float, float, float]] = [
        ("dark", t, c, rate * t) for c, rate in currents.items() for t in exposures_s for _ in range(repeats)
    ]
    settings += [("flat", 0.01 * k, flats_c, 900.0 * k + 0.01 * k * currents[flats_c]) for k in range(1, 11)] * 2
    rng.shuffle(settings)  # type: ignore[arg-type]
    captures, frames = [], {}
    for number, (kind, exposure_s, temperature_c, mean_e) in enumerate(settings):
        name = f"{kind}-{number}"
        captures.append({"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": exposure_s})
        captures[-1] |= {"temperature_c": temperature_c + 0.1 * rng.standard_normal()}
        charge = rng.poisson(mean_e, (60, 80)) + 6.0 * rng.standard_normal((60, 80))
        frames[name] = np.rint(500.0 + 0.25 * charge).astype(np.uint16)
    camera = {"rows": 60, "cols": 80, "cfa": cfa, "bit_depth": 16}
    manifest = Manifest.model_validate({"cameras": {"left": camera}, "captures": captures})
    return RecordingSet(manifest, frames)


#: Dark current, e/s, by temperature; exposures; repeats; mosaic; temperature of the flats. The first is a camera that
#: people report about, the others differ in doubling temperature, layout and number.
SERIES = {
    "10, 20 and 30 C": ({10.0: 7.43, 20.0: 20.0, 30.0: 53.8}, (0.01, 1.0, 3.0), 2, "MONO", 20.0),
    "a cooled camera": ({-20.0: 0.5, -10.0: 2.0, 0.0: 8.0}, (1.0, 60.0, 180.0), 3, "MONO", -20.0),
    "two temperatures": ({25.0: 40.0, 45.0: 320.0}, (0.1, 0.5, 2.0, 4.0), 2, "RGGB", 25.0),
    "five temperatures": (
        {c: 5.0 * 2.0 ** (c / 6.0) for c in (0.0, 8.0, 16.0, 24.0, 32.0)},
        (0.5, 5.0),
        2,
        "BGGR",
        16.0,
    ),
}


@pytest.mark.parametrize("series", SERIES)
def test_darks_of_several_temperatures_hold_their_own_frames(series: str) -> None:
    """Their levels contradict one line over the exposure, and their temperatures explain that."""
    currents, exposures_s, repeats, cfa, flats_c = SERIES[series]
    recordings = dark_series(currents, exposures_s, repeats, cfa, flats_c)
    assert exchanged_frames(recordings, "left") is None
    assert misplaced_frames(recordings, "left") is None
    fit = fit_noise(recordings, "left")
    laws = fit.dark_current_temperature
    assert laws is not None
    assert laws.temperature_c == tuple(currents)
    for rate, found, std in zip(
        currents.values(), laws.dark_current_e_per_s, laws.dark_current_e_per_s_std, strict=True
    ):
        assert abs(found - rate) < 3.0 * std
        assert std < 0.05 * rate + 0.05
    assert fit.dark_current_e_per_s == pytest.approx(laws.dark_current_e_per_s[list(currents).index(flats_c)])
    assert not any("each other's frames" in remark for remark in fit.remarks)


def test_an_exchange_among_darks_of_one_temperature_is_proposed() -> None:
    """Of darks at three temperatures; the captures stand with their temperature."""
    recordings = dark_series({10.0: 60.0, 20.0: 160.0, 30.0: 430.0}, (0.01, 1.0, 3.0), 4, "MONO", 20.0)
    darks = [c for c in recordings.captures("dark") if round(c.temperature_c or 0.0) == 30]
    one, other = (next(c.id for c in darks if c.exposure_s == t) for t in (0.01, 3.0))
    found = exchanged_frames(swapped(recordings, [one], [other]), "left")
    assert found is not None
    assert set(found.captures) == {one, other}
    assert "deg C" in found.told("left")


def test_flats_at_several_temperatures_hold_their_own_frames() -> None:
    """Most flats at 25 C; two with lights 8 % apart, the dimmer at 15 C where the camera responds by 8 % more, the
    brighter at 35 C where it responds by 8 % less: each has the level that 25 C give the other."""
    settings = [("flat", 0.01 * k, 25.0, 1.0) for k in range(1, 13) for _ in range(2)]
    settings += [("flat", 0.06, 15.0, 1.08), ("flat", 0.0648, 35.0, 1.0 / 1.08)]
    settings += [("dark", 0.01, c, 1.0) for c in (15.0, 25.0, 35.0) for _ in range(4)]
    rng = np.random.default_rng(4)
    captures, frames = [], {}
    for number, (kind, exposure_s, temperature_c, factor) in enumerate(settings):
        name = f"{kind}-{number}"
        captures.append({"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": exposure_s})
        captures[-1] |= {"temperature_c": temperature_c}
        signal = 0.5 * rng.poisson(5e4 * exposure_s * factor, (32, 48)) if kind == "flat" else 0.0
        frames[name] = np.rint(100.0 + signal + 2.0 * rng.standard_normal((32, 48))).astype(np.uint16)
    camera = {"rows": 32, "cols": 48, "cfa": "MONO", "bit_depth": 12}
    manifest = Manifest.model_validate({"cameras": {"left": camera}, "captures": captures})
    assert exchanged_frames(RecordingSet(manifest, frames), "left") is None


GAIN, READ_E, CURRENT = 0.4, 4.0, 40.0  # DN/e, e, e/s
BLACK_DN = 64.0


def long_range_series(repeats: int, exposures_s: tuple[float, ...]) -> RecordingSet:
    """Darks and flats of a camera of 16 bit, whose flats reach 14,000 DN above black and whose darks 48 DN."""
    rng = np.random.default_rng(9)
    settings = [("dark", t, CURRENT * t) for t in exposures_s for _ in range(repeats)]
    settings += [("flat", 0.02 * k, 5000.0 * k) for k in range(1, 8) for _ in range(2)]
    captures, frames = [], {}
    for number, (kind, exposure_s, electrons) in enumerate(settings):
        name = f"{kind}-{number}"
        captures.append({"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": exposure_s})
        signal = rng.poisson(electrons, (96, 128)) + rng.normal(0.0, READ_E, (96, 128))
        frames[name] = np.rint(BLACK_DN + GAIN * signal).astype(np.uint16)
    manifest = Manifest.model_validate(
        {"cameras": {"left": {"rows": 96, "cols": 128, "cfa": "MONO", "bit_depth": 16}}, "captures": captures}
    )
    return RecordingSet(manifest, frames)


@pytest.mark.parametrize("repeats", [2, 3])
def test_an_exchange_of_darks_far_below_saturation_is_proposed(repeats: int) -> None:
    """32 DN apart, 0.2 % of the range of the flats: the darks agree with each other to 0.02 DN. Without the two, every
    figure is right; a read noise of 4.7 +- 0.1 e came of them."""
    recordings = long_range_series(repeats, (0.1, 1.0, 3.0))
    assert exchanged_frames(recordings, "left") is None
    one, other = _of(recordings, "dark", 1)[:1], _of(recordings, "dark", 2)[:1]
    wrong = swapped(recordings, one, other)
    found = exchanged_frames(wrong, "left")
    assert found is not None and set(found.captures) == {*one, *other}
    fit = fit_noise(wrong, "left")
    assert any("hold each other's frames" in remark for remark in fit.remarks)
    for value, std, true in (
        (fit.read_noise_e, fit.read_noise_e_std, READ_E),
        (fit.black_level_dn, fit.black_level_dn_std, BLACK_DN),
        (fit.dark_current_e_per_s, fit.dark_current_e_per_s_std, CURRENT),
    ):
        assert value is not None and std is not None
        assert abs(value - true) < 3.0 * std


def test_darks_that_contradict_each_other_are_reported_and_in_the_uncertainties() -> None:
    """Two exposures of two darks, one of each exchanged: no frame is more credible than another, the truth is in the
    intervals, and a line says why they are wide."""
    recordings = long_range_series(2, (0.1, 2.0))
    wrong = swapped(recordings, _of(recordings, "dark", 0)[:1], _of(recordings, "dark", 1)[:1])
    fit = fit_noise(wrong, "left")
    (line,) = [remark for remark in fit.remarks if "repeated dark frames differ" in remark]
    assert "frames may be of another exposure or temperature" in line
    for value, std, true in (
        (fit.read_noise_e, fit.read_noise_e_std, READ_E),
        (fit.black_level_dn, fit.black_level_dn_std, BLACK_DN),
        (fit.dark_current_e_per_s, fit.dark_current_e_per_s_std, CURRENT),
    ):
        assert value is not None and std is not None
        assert abs(value - true) < 3.0 * std and std > 0.2 * true
    assert not any("repeated dark" in remark for remark in fit_noise(recordings, "left").remarks)


def test_single_darks_have_a_dark_current() -> None:
    """Their values spread over codes by noise, though no repeat tells the noise."""
    fit = fit_noise(long_range_series(1, (0.1, 1.0, 3.0)), "left")
    assert fit.dark_current_e_per_s is not None and fit.dark_current_e_per_s_std is not None
    assert abs(fit.dark_current_e_per_s - CURRENT) < 3.0 * fit.dark_current_e_per_s_std < 0.2 * CURRENT
    assert not any("rounding decides" in remark for remark in fit.remarks)
