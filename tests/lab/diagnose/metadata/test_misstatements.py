"""Wrong metadata of healthy cameras of the second image former are reported with the value that fits; right ones aren't
reported."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from lab.challenge.draw import DrawnFrame, recordings_of
from lab.diagnose import diagnose
from lab.diagnose.metadata import misstatements, unchecked
from lab.diagnose.metadata.frames import misstated_dark_exposure
from lab.diagnose.policy import DecisionPolicy
from lab.formats.recording_set import InstrumentSnapshot, RecordingSet
from mocks.former import ConcealedCamera, Law, Plan
from mocks.former.laws import (
    AdcNonlinearityLaw,
    AmplifierGlowLaw,
    BlackLevelDriftLaw,
    CrosstalkLaw,
    DarkCurrentTemperatureLaw,
    HotPixelsLaw,
    InfraredCutFilterLaw,
    StrayLightLaw,
)
from tests.lab.diagnose.metadata.lies import restated, told, with_cells, with_dark_exposures, with_exchanged_wavelengths

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
    assert corrected.manifest == recordings.manifest


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
