"""Wrong metadata of healthy cameras of the second image former are reported with the value that fits; right ones aren't
reported."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.draw import DrawnFrame, recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import (
    AdcNonlinearityLaw,
    AmplifierGlowLaw,
    BlackLevelDriftLaw,
    CrosstalkLaw,
    DarkCurrentTemperatureLaw,
    HotPixelsLaw,
    InfraredCutFilterLaw,
    StrayLightLaw,
)
from lab.diagnose import diagnose
from lab.diagnose.metadata import misstatements, unchecked
from lab.diagnose.metadata.frames import misstated_dark_exposure, misstated_exposure_unit
from lab.diagnose.metadata.lights import misstated_mosaic
from lab.diagnose.metadata.targets import misstated_board
from lab.diagnose.policy import DecisionPolicy
from lab.fit.noise.noise_fit import fit_noise
from lab.formats.importers import read_checkerboard_pairs
from lab.formats.importers.emva1288 import read_emva1288
from lab.formats.recording_set import InstrumentSnapshot, Manifest, RecordingSet, inspect
from tests.lab.diagnose.metadata.lies import restated, told, with_cells, with_dark_exposures, with_exchanged_wavelengths
from tests.lab.diagnose.on_blocks import former
from tests.lab.fit.noise.synthetic_sensor import Sensor, recording_set
from tests.lab.observables.test_exchanged_frames import swapped

MOSAICS = ("RGGB", "BGGR", "GRBG", "GBRG")


@cache
def _recorded(seed: int, cfa: str, kinds: tuple[str, ...], *laws: Law) -> RecordingSet:
    return recordings_of(ConcealedCamera(seed, laws, cfa=cfa, rows=96, cols=128), Plan(kinds))


LIGHTS = ("dark", "narrowband", "chart")


@pytest.mark.parametrize("cfa", MOSAICS)
@pytest.mark.parametrize("kinds", [("dark", "narrowband"), ("dark", "chart")], ids=lambda kinds: kinds[1])
def test_a_wrong_mosaic_phase_is_reported(cfa: str, kinds: tuple[str, ...]) -> None:
    recordings = _recorded(11, cfa, kinds)
    assert told(recordings) == []
    for wrong in MOSAICS:
        if wrong != cfa:
            (line,) = told(restated(recordings, cfa=wrong))
            assert f"correct cfa to {cfa}" in line


def test_a_wrong_mosaic_phase_is_reported_without_the_makers_curves() -> None:
    recordings = restated(_recorded(11, "GRBG", LIGHTS), quantum_efficiency=None)
    assert told(recordings) == []
    (line,) = told(restated(recordings, cfa="BGGR"))
    assert "correct cfa to GRBG" in line


@pytest.mark.parametrize("cfa", ["RGGB", "MONO"])
@pytest.mark.parametrize(("first_nm", "second_nm"), [(450.0, 460.0), (500.0, 600.0), (520.0, 540.0)])
def test_exchanged_narrowband_lights_are_told(cfa: str, first_nm: float, second_nm: float) -> None:
    """450 and 460 nm differ by 19 % in a grey sensor's signal, where noise and the maker's curves leave less than 1
    %."""
    recordings = _recorded(12, cfa, ("dark", "narrowband"))
    corrected, (found,) = misstatements(with_exchanged_wavelengths(recordings, first_nm, second_nm), "left")
    assert found.where in (f"{first_nm:g} nm and {second_nm:g} nm", f"{second_nm:g} nm and {first_nm:g} nm")
    assert {c.wavelength_nm for c in recordings.captures("narrowband") if c.id in found.captures} == {
        first_nm,
        second_nm,
    }
    assert "if they were exchanged, exchange the two lights" in found.check
    assert found.told("left").correction == "the captures are left out"
    assert corrected.manifest == recordings.without(set(found.captures)).manifest


@pytest.mark.parametrize("off_dn", [8.0, -8.0])
def test_a_black_level_that_is_not_that_of_the_darks_is_told(off_dn: float) -> None:
    """At 12 bits. The means of dark frames tell it within 0.02 DN."""
    recordings = _recorded(11, "RGGB", ("dark", "narrowband"))
    true_dn = recordings.camera("left").black_level_dn
    assert true_dn is not None
    corrected, (found,) = misstatements(restated(recordings, black_level_dn=true_dn + off_dn), "left")
    assert corrected.camera("left").black_level_dn == pytest.approx(true_dn, abs=0.1)
    assert f"black_level_dn = {true_dn + off_dn:g} is stated" in found.check
    assert told(restated(recordings, black_level_dn=true_dn + 3.0)) == []  # a data sheet's rounding
    strict = DecisionPolicy(black_level_tolerance=2.0 / 4096.0)
    assert len(misstatements(restated(recordings, black_level_dn=true_dn + 3.0), "left", strict)[1]) == 1


@pytest.mark.parametrize(("exposure_s", "factor"), [(2.0, 0.8), (2.0, 1.25), (0.5, 0.8), (0.5, 1.25)])
def test_a_wrong_exposure_of_darks_is_told(exposure_s: float, factor: float) -> None:
    """Of three exposures, two may be the wrong one: the level of the true one is told within three standard
    deviations."""
    recordings = _recorded(11, "RGGB", ("dark", "narrowband"))
    corrected, (found,) = misstatements(with_dark_exposures(recordings, exposure_s, factor), "left")
    stated = f"those stated with {factor * exposure_s:.6g} s have the level of "
    fits_s, std_s = found.check.split(stated)[1].split(" s")[0].split(" ± ")
    assert abs(float(fits_s) - exposure_s) < 3.0 * float(std_s)
    assert {c.id for c in recordings.captures("dark") if c.exposure_s == exposure_s} <= set(found.captures)
    assert misstatements(corrected, "left")[1] == ()
    assert misstatements(recordings, "left")[1] == ()


@pytest.mark.parametrize(
    "law", [BlackLevelDriftLaw, DarkCurrentTemperatureLaw, AmplifierGlowLaw, HotPixelsLaw, AdcNonlinearityLaw]
)
def test_what_changes_dark_levels_is_no_wrong_exposure(law: type[Law]) -> None:
    """Each at four times its nominal strength, in all forms."""
    for variant in range(law.variants):
        recordings = _recorded(14, "MONO", ("dark",), law(min(4.0 * law.nominal, law.limits[1]), variant, 3))
        assert misstated_dark_exposure(recordings, "left") is None


@pytest.mark.parametrize("factor", [1.1, 0.9])
def test_cells_of_another_size_than_stated_are_told(factor: float) -> None:
    recordings = _recorded(11, "RGGB", ("dark", "screen"))
    assert told(recordings) == []
    corrected, (found,) = misstatements(with_cells(recordings, factor), "left")
    (cells,) = {c.screen.cell_camera_px for c in corrected.captures("bernoulli")}
    # 4 px by plan; the corners tell the mean size within some thousandths
    assert cells == pytest.approx(4.0, rel=0.005)
    assert found.check.startswith("The screen's cells are 4.0")


def _clipped(recordings: RecordingSet, highest: int) -> RecordingSet:
    """The recordings of a converter that ends at `highest`."""
    frames = {c.frame: np.minimum(recordings.frame(c), highest) for c in recordings.manifest.captures}
    return RecordingSet(recordings.manifest, frames, source="clipped")


def test_a_bit_depth_that_is_stated_too_large_is_told() -> None:
    recordings = _recorded(13, "MONO", ("dark", "flat"))
    clipped = _clipped(recordings, 1023)
    corrected, (found,) = misstatements(clipped, "left")
    assert (corrected.camera("left").bit_depth, corrected.camera("left").white_level_dn) == (10, 1023.0)
    assert "correct bit_depth to 10" in found.check
    # what is stated so is right, and a white level below a power of two is no bit depth
    assert told(restated(clipped, bit_depth=10, white_level_dn=1023.0)) == []
    assert told(restated(clipped, white_level_dn=1023.0)) == []
    assert told(_clipped(recordings, 1000)) == []


def test_metadata_that_no_recording_can_check_are_listed() -> None:
    """At 12 bits, pixels above half of the range use the highest bit."""
    recordings = _recorded(13, "MONO", ("dark", "flat"))
    assert [*unchecked(recordings, "left")] == []
    (one,) = unchecked(_clipped(recordings, 1000), "left")
    assert (one.step, one.side) == ("bit_depth", "left")
    assert "no pixel is above 1000 DN" in one.reason
    assert "bit_depth = 12" in one.reason


def test_what_an_instrument_said_could_not_be_set_is_listed() -> None:
    recordings = _recorded(13, "MONO", ("dark", "flat"))
    there = {
        "camera left": InstrumentSnapshot(departures=("BalanceRatio[Red] = 1.8: its codes aren't the converter's",)),
        "monochromator": InstrumentSnapshot(departures=("the bandwidth of its light isn't known",)),
    }
    told = [*unchecked(recordings.under(recordings.manifest.model_copy(update={"instruments": there})), "left")]
    assert [(one.step, one.side) for one in told] == [("instrument_settings", "left"), ("instrument_settings", None)]
    assert "BalanceRatio[Red] = 1.8" in told[0].reason and "bandwidth" in told[1].reason


@pytest.mark.parametrize(
    "law",
    [InfraredCutFilterLaw, StrayLightLaw, CrosstalkLaw, BlackLevelDriftLaw],
    ids=lambda law: law.name,
)
def test_effects_are_not_reported_as_wrong_metadata(law: type[Law]) -> None:
    for seed in (14, 15):
        assert told(_recorded(seed, "RGGB", LIGHTS, law(law.nominal, 0))) == []


def test_healthy_cameras_have_no_wrong_metadata() -> None:
    for seed, cfa in ((21, "GBRG"), (22, "MONO")):
        assert told(_recorded(seed, cfa, ("dark", "flat", "narrowband", "chart", "screen"))) == []


@pytest.mark.slow
def test_sixty_drawn_healthy_cameras_have_no_wrong_metadata() -> None:
    """Frames, converters and screens of all kinds. None of 60: below 5 % with 95 % confidence (0.95 ** 60 = 0.046)."""
    for seed in range(820_000, 820_060):
        frame = DrawnFrame.drawn(np.random.default_rng([seed, 5]))
        camera = ConcealedCamera(seed, rows=min(frame.rows, 96), cols=min(frame.cols, 128), bit_depth=frame.bit_depth)
        plan = Plan(screen_cell_px=frame.screen_cell_px, screen_turn_deg=frame.screen_turn_deg, warm=bool(seed % 2))
        assert told(recordings_of(camera, plan)) == [], seed


def test_a_diagnosis_goes_on_with_the_corrected_metadata() -> None:
    """A healthy camera with two exchanged lights: these are reported, and nothing else."""
    recordings = with_exchanged_wavelengths(_recorded(12, "RGGB", ("dark", "narrowband")), 500.0, 600.0)
    found = diagnose(recordings)
    assert (found.verdict, found.effects, found.mismatches) == ("unexplained", (), ())
    (one,) = found.unexplained
    assert one.measurement == "narrowband"
    assert "exchange the two lights" in one.check
    assert one.check in found.summary
    assert found.next_capture == "Correct what is stated of the captures above, or take them again."


# --- Boards whose squares or markers are stated wrongly: told with the numbers that their pictures fit ----------------


PAIRS = Path(__file__).parents[4].parent / "shared" / "data" / "opencv_stereo"


@cache
def _boards() -> RecordingSet:
    """6 x 8 squares of 9 mm, markers of 6 mm, in ten poses; of 13 px a marker."""
    return recordings_of(ConcealedCamera(41, (), cfa="RGGB", rows=192, cols=256), Plan(kinds=("charuco",)))


def _stated(recordings: RecordingSet, **values: Any) -> RecordingSet:
    captures = tuple(one.model_copy(update=values) for one in recordings.manifest.captures)
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


def test_a_board_that_is_as_stated_is_no_finding() -> None:
    assert misstated_board(_boards(), "left") is None


@pytest.mark.parametrize("squares", [(6, 9), (8, 6), (7, 8), (5, 8), (8, 8), (5, 7)])
def test_another_number_of_squares_is_told(squares: tuple[int, int]) -> None:
    found = misstated_board(_stated(_boards(), squares=squares), "left")
    assert found is not None
    assert f"6 x 8 squares and not {squares[0]} x {squares[1]}: correct squares to [6, 8]" in found.check
    assert len(found.captures) == 10
    assert found.corrected.manifest == _boards().manifest


def test_markers_of_another_size_are_told() -> None:
    """6 mm of 9; a detector finds them up to 7 % too small."""
    found = misstated_board(_stated(_boards(), marker_mm=4.5), "left")
    assert found is not None
    assert "and not 50 %" in found.check
    (size,) = {one.marker_mm for one in found.corrected.manifest.captures}
    assert size == pytest.approx(6.0, rel=0.08)


def test_the_length_of_a_square_cannot_be_told() -> None:
    assert misstated_board(_stated(_boards(), square_mm=18.0, marker_mm=12.0), "left") is None


@pytest.mark.skipif(not PAIRS.is_dir(), reason="the public stereo pairs aren't here")
@pytest.mark.parametrize("corners", [(6, 8), (5, 9)])
def test_public_plain_boards_have_the_squares_that_are_counted(corners: tuple[int, int]) -> None:
    assert misstated_board(read_checkerboard_pairs(PAIRS, (6, 9), 25.0), "left") is None
    found = misstated_board(read_checkerboard_pairs(PAIRS, corners, 25.0), "left")
    assert found is not None
    assert "7 x 10 squares and not" in found.check


# --- Frames that are exchanged in an index are told as metadata, and no physics is made of them -----------------------


@cache
def _recorded_pairs() -> RecordingSet:
    return former(12, kinds=("dark", "flat"))


def test_exchanged_frames_of_two_levels_are_told_and_nothing_else() -> None:
    """A converter whose codes are unequal explains such means, too."""
    recordings = _recorded_pairs()
    flats = recordings.captures("flat")
    one, other = (next(c.id for c in flats if c.exposure_s == t) for t in sorted({c.exposure_s for c in flats})[2:6:3])
    wrong = swapped(recordings, [one], [other])
    corrected, (found,) = misstatements(wrong, "left")
    assert set(found.captures) == {one, other}
    assert corrected.manifest == recordings.without({one, other}).manifest
    result = diagnose(wrong)
    assert (result.verdict, result.effects, result.mismatches) == ("unexplained", (), ())
    (item,) = result.unexplained
    assert one in item.check
    assert other in item.check
    assert "exchange these frames" in item.check
    assert item.correction == "the captures are left out"


def test_a_dark_and_a_flat_exchanged_are_told() -> None:
    recordings = _recorded_pairs()
    one, other = recordings.captures("dark")[1].id, recordings.captures("flat")[9].id
    (line,) = told(swapped(recordings, [one], [other]))
    assert one in line
    assert other in line


def test_darks_and_flats_stated_for_each_other_are_told() -> None:
    recordings = _recorded_pairs()
    content = recordings.manifest.model_dump(mode="json")
    for capture in content["captures"]:
        capture["kind"] = {"dark": "flat", "flat": "dark"}.get(capture["kind"], capture["kind"])
    corrected, (found,) = misstatements(recordings.under(Manifest.model_validate(content)), "left")
    assert "darks and flats are stated for each other" in found.check
    assert not corrected.captures()


# --- Exposures in other units than seconds, and a mono sensor that is stated with a mosaic, are told in one line ------


CMOS = Path(__file__).resolve().parents[5] / "shared" / "data" / "emva1288_cmos_crop"
DARKS, LADDER = [(0.001, 2), (2.0, 2)], [(0.1, 2), (0.3, 2), (0.5, 2), (0.7, 2), (0.9, 2)]


def _changed(recordings: RecordingSet, **of: Any) -> RecordingSet:
    """The recordings with keys of each capture from functions of its number and itself."""
    captures = tuple(
        c.model_copy(update={key: value(k, c) for key, value in of.items()})
        for k, c in enumerate(recordings.manifest.captures)
    )
    return recordings.under(recordings.manifest.model_copy(update={"captures": captures}))


def test_microseconds_given_as_seconds_are_told() -> None:
    """2 s are 2e6 us, which no plan allows; the corrected exposures are those that were meant."""
    recordings = recording_set(Sensor(shape=(32, 48), cfa="MONO"), DARKS, LADDER)
    assert misstated_exposure_unit(recordings, "left") is None
    wrong = _changed(recordings, exposure_s=lambda _, c: 1e6 * c.exposure_s)
    found = misstated_exposure_unit(wrong, "left")
    assert found is not None
    assert "aren't in seconds: the longest is 2e+06 s, above 3600 s. They are read as microseconds" in found.check
    for right, one in zip(recordings.captures(), found.corrected.captures(), strict=True):
        assert one.exposure_s == pytest.approx(right.exposure_s)
    (warning,) = [w for w in inspect(wrong)[1] if "not in milliseconds or microseconds" in w]
    assert "12 captures" in warning  # darks of a millisecond are 1000 us


def test_captures_without_a_stated_exposure_say_nothing_of_its_unit() -> None:
    """Imported pictures of boards may state none; the others' exposures are still told and corrected."""
    recordings = recording_set(Sensor(shape=(32, 48), cfa="MONO"), DARKS, LADDER)
    assert misstated_exposure_unit(_changed(recordings, exposure_s=lambda _, c: None), "left") is None
    found = misstated_exposure_unit(
        _changed(recordings, exposure_s=lambda k, c: 1e6 * c.exposure_s if k else None), "left"
    )
    assert found is not None
    for k, (right, one) in enumerate(zip(recordings.captures(), found.corrected.captures(), strict=True)):
        assert one.exposure_s == (pytest.approx(right.exposure_s) if k else None)


def test_times_of_copying_say_nothing_of_the_unit() -> None:
    """A ladder up to seconds whose files were written within a tenth of a second."""
    begin = datetime(2026, 3, 2, tzinfo=UTC)
    recordings = _changed(
        recording_set(Sensor(shape=(32, 48), cfa="MONO"), DARKS, LADDER),
        time=lambda k, _: begin + timedelta(milliseconds=k),
    )
    assert misstated_exposure_unit(recordings, "left") is None


def test_a_mono_sensor_stated_with_a_mosaic_is_told() -> None:
    recordings = former(5, kinds=("dark", "flat", "narrowband"))
    assert misstated_mosaic(recordings, "left") is None
    wrong = restated(recordings, cfa="RGGB", quantum_efficiency=None)
    corrected, (found,) = misstatements(wrong, "left")
    assert "but cfa = RGGB is stated: correct cfa to MONO" in found.check
    assert corrected.camera("left").cfa == "MONO"
    assert any("correct cfa to MONO" in remark for remark in fit_noise(wrong, "left").remarks)


def test_colours_that_differ_are_a_mosaic() -> None:
    """Also those that analogue gains make alike under one lamp: their variances differ."""
    assert misstated_mosaic(former(5, cfa="GRBG", kinds=("dark", "flat", "narrowband")), "left") is None
    sensor = Sensor(shape=(64, 96))
    recordings = recording_set(sensor, DARKS, LADDER)
    frames = {c.frame: recordings.frame(c) for c in recordings.captures("dark")}
    for flat in recordings.captures("flat"):
        frame = (recordings.frame(flat) - sensor.black).astype(float)
        for (row, col), share in (((0, 0), 0.7), ((1, 1), 0.5)):
            frame[row::2, col::2] /= share
        frames[flat.frame] = np.clip(np.rint(frame + sensor.black), 0, 4095).astype(np.uint16)
    balanced = RecordingSet(recordings.manifest, frames)
    assert misstated_mosaic(balanced, "left") is None


@pytest.mark.skipif(not CMOS.is_dir(), reason="the shared recordings aren't here")
def test_a_real_mono_camera_stated_with_a_mosaic_is_told() -> None:
    found = misstated_mosaic(restated(read_emva1288(CMOS), cfa="RGGB"), "left")
    assert found is not None
    assert "answer 1 light alike within 0.0" in found.check
