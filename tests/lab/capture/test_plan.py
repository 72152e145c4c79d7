"""Plans: number, order and ids of their steps, and the captures before they are taken."""

from collections import Counter, defaultdict

import numpy as np
import pytest
from pydantic import ValidationError

from lab.capture.plan import EMVA_LEVELS, STACK_IMAGES, STANDARDS_SEQUENCES, CapturePlan, full_plan, standards_plan
from lab.capture_kinds.base import SEQUENCES, FindExposure, RelativeExposure, Setting, Step
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.flat import FlatSequence
from lab.capture_kinds.narrowband import NarrowbandCapture, NarrowbandSequence
from lab.capture_kinds.screen import ScreenSequence
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import InputError
from tests.lab import fake_bench

STATION = fake_bench.station()


@pytest.mark.parametrize("quick", [False, True])
def test_a_full_calibration_takes_what_the_fits_need(quick: bool) -> None:
    steps = full_plan(STATION, quick).steps(STATION)
    captures = [capture for step in steps for capture in step.captures if capture.side == "left"]
    kinds = Counter(capture.kind for capture in captures)
    assert kinds["dark"] >= 4 * 4
    assert kinds["flat"] >= 8 * 4
    assert {c.wavelength_nm for c in captures if isinstance(c, NarrowbandCapture)} == set(range(400, 721, 10))
    assert min(kinds[kind] for kind in ("chart", "white", "black", "checkerboard", "bernoulli")) >= 2
    edges = Counter(capture.frame for capture in captures if isinstance(capture, SlantedEdgeCapture))
    assert len(edges) >= 4 * 2  # orientations x repeats
    assert set(edges.values()) == {3}  # regions
    assert kinds["charuco"] == 3


@pytest.mark.parametrize("quick", [False, True])
def test_the_standards_get_the_levels_and_stacks_that_they_ask_for(quick: bool) -> None:
    """EMVA 1288: 50 levels up to saturation and stacks of 16; ISO 18844: the chart and the dark screen."""
    assert set(STANDARDS_SEQUENCES) < SEQUENCES.keys()
    plan = standards_plan(STATION, quick)
    assert set(plan.names) == {*STANDARDS_SEQUENCES, "flare"}
    flats = next(one for one in plan.sequences if isinstance(one, FlatSequence))
    darks = next(one for one in plan.sequences if isinstance(one, DarkSequence))
    assert quick or len(set(flats.levels)) >= EMVA_LEVELS
    assert max(flats.levels) > 1.5
    assert flats.levels.count(0.5) * flats.frames >= STACK_IMAGES
    assert darks.frames >= STACK_IMAGES
    steps = plan.steps(STATION)
    shown = Counter(c.lit for step in steps for c in step.captures if c.kind == "flare" and c.side == "left")
    assert shown[True] == shown[False] >= 2
    assert "flare" not in full_plan(STATION, quick).names


def test_the_flare_chart_is_white_with_a_black_square_in_its_middle() -> None:
    (cells,) = (c for path, c in standards_plan(STATION).patterns(STATION).items() if path == "targets/flare.npy")
    black = np.argwhere(cells == 0)
    assert 0 < len(black) < 0.05 * cells.size
    np.testing.assert_allclose(black.mean(axis=0), 0.5 * np.array(cells.shape) - 0.5)


@pytest.mark.parametrize("quick", [False, True])
def test_ids_and_files_are_unique_and_the_same_every_time(quick: bool) -> None:
    steps = full_plan(STATION, quick).steps(STATION)
    assert steps == full_plan(STATION, quick).steps(STATION)
    ids = [step.id for step in steps]
    assert len(set(ids)) == len(ids)
    captures = [capture.id for step in steps for capture in step.captures]
    assert len(set(captures)) == len(captures)
    owners = defaultdict(set)
    for step in steps:
        for capture in step.captures:
            owners[capture.frame].add((step.id, capture.side))
    assert all(len(owner) == 1 for owner in owners.values())


def test_both_sides_are_in_every_trigger() -> None:
    for step in full_plan(STATION).steps(STATION):
        assert {capture.side for capture in step.captures} in (set(), {"left", "right"})


def test_what_a_step_relies_on_comes_before_it() -> None:
    found, measured = set(), set()
    for step in full_plan(STATION).steps(STATION):
        if isinstance(step.exposure, RelativeExposure):
            assert step.exposure.of in found
        if isinstance(step.exposure, FindExposure):
            found.add(step.id)
        if step.radiance:
            measured.add(step.radiance)
        for capture in step.captures:
            for key in ("radiance", "light_radiance"):
                assert getattr(capture, key, None) is None or getattr(capture, key) in measured


def test_ladders_cancel_a_linear_drift() -> None:
    # On a ladder taken upwards and downwards in turn, all rungs have the same mean time: a linear drift cancels.
    steps = FlatSequence(levels=(0.1, 0.4, 0.7, 1.0), frames=4).steps(STATION)
    times = defaultdict(list)
    for at, step in enumerate(step for step in steps if step.captures):
        times[step.id.split("/")[1]].append(at)
    assert len({np.mean(when) for when in times.values()}) == 1
    steps = DarkSequence(exposures_s=(0.01, 1.0, 2.0), frames=2).steps(STATION)
    assert [step.id for step in steps] == [
        "dark/0.01s/1", "dark/1s/1", "dark/2s/1", "dark/2s/2", "dark/1s/2", "dark/0.01s/2",
    ]  # fmt: skip


def test_flats_are_taken_at_every_gain() -> None:
    """Each gain has steps of its own, which have the gain; without one it is the station's, and none is stated."""
    one, two = (FlatSequence(levels=(0.2, 0.6), frames=2, gains_db=gains) for gains in ((), (6.0, 20.0)))
    steps = two.steps(STATION)
    assert steps[: len(one.steps(STATION))] == one.steps(STATION)
    assert [s.setting.gain_db for s in steps if isinstance(s.exposure, FindExposure)] == [None, 6.0, 20.0]
    assert {s.id.split("/")[1] for s in steps if s.setting.gain_db is not None} == {"6dB", "20dB"}
    with pytest.raises(InputError, match=r"flat.gains_db: .*90.0 dB is above the upper limit 80.0 dB"):
        full_plan(STATION, only=("flat",), parameters={"flat": {"gains_db": [90.0]}})
    CapturePlan((two,)).steps(STATION)


def test_flats_go_from_near_dark_to_beyond_saturation() -> None:
    levels = next(one for one in full_plan(STATION).sequences if isinstance(one, FlatSequence))
    assert min(levels.levels) <= 0.05
    assert max(levels.levels) > 1.0
    factors = {s.exposure.factor for s in levels.steps(STATION) if isinstance(s.exposure, RelativeExposure)}
    assert max(factors) == pytest.approx(max(levels.levels) / levels.level_found)


def test_wavelengths_include_both_ends() -> None:
    assert NarrowbandSequence(from_nm=400, to_nm=720, step_nm=10).wavelengths_nm == tuple(range(400, 721, 10))
    assert NarrowbandSequence(from_nm=400, to_nm=401, step_nm=0.1).wavelengths_nm[-1] == pytest.approx(401.0)


def test_the_screens_patterns_fit_what_the_cameras_see() -> None:
    sequence = ScreenSequence()
    patterns = sequence.patterns(STATION)
    board, coins = patterns["targets/checkerboard.npy"], patterns["targets/bernoulli.npy"]
    assert board.shape == coins.shape
    grid = sequence.grid(STATION)
    assert grid.cell_px == 8  # 4 camera px at half a camera px a screen px
    assert grid.rows * grid.cell_px <= 880
    assert grid.cols * grid.cell_px <= 1720
    assert np.array_equal(board, np.kron(board[::8, ::8], np.ones((8, 8))))
    assert board[0, 0] == 0
    assert board[0, 8] == board[8, 0] == 1
    # A fair coin: the share of ones lies within 5 sigma of 1/2, sigma = 1/(2 sqrt(n)).
    assert abs(coins.mean() - 0.5) < 5 / (2 * np.sqrt(coins.size))
    assert np.array_equal(coins, sequence.patterns(STATION)["targets/bernoulli.npy"])
    assert patterns["targets/white.npy"].all()


def test_a_screen_too_small_to_align_is_refused() -> None:
    with pytest.raises(InputError, match="larger visible rectangle or smaller cells"):
        ScreenSequence(cell_camera_px=80.0).steps(STATION)


@pytest.mark.parametrize("family", ["monochromator", "spectroradiometer", "display"])
def test_without_an_instrument_the_sequences_that_need_it_are_left_out(family: str) -> None:
    station = fake_bench.station(**{family: None})
    chosen = full_plan(station)
    assert "dark" in chosen.names
    assert ("flat" in chosen.names) == (family == "display")
    assert ("screen" in chosen.names) == (family == "monochromator")
    assert chosen.steps(station)
    wanted = full_plan(STATION)
    with pytest.raises(InputError, match=rf"needs a {family}"):
        wanted.steps(station)


def test_specs_refuse_unknown_axes() -> None:
    with pytest.raises(ValueError, match="wavelength"):
        DarkSequence.model_validate({"exposures_s": [1], "frames": 1, "wavelength": 3})
    with pytest.raises(ValueError, match="need an exposure"):
        captures = DarkSequence(exposures_s=(1.0,), frames=1).steps(STATION)[0].captures
        Step(id="x", what="x", setting=Setting(target="cap"), captures=captures)


def test_only_the_sequences_that_are_named_are_planned_in_their_order() -> None:
    assert full_plan(STATION, only=["flat", "dark"]).names == ("dark", "flat")
    with pytest.raises(InputError, match="there is no moon; name some of " + ", ".join(SEQUENCES)):
        full_plan(STATION, only=["dark", "moon"])
    without_screen = STATION.model_copy(update={"display": None})
    with pytest.raises(InputError, match="lacks instruments or targets for screen; leave it out"):
        full_plan(without_screen, only=["dark", "screen"])


def test_darks_stay_within_the_stations_exposures() -> None:
    station = fake_bench.station(limits={"exposure_min_s": 0.001, "exposure_max_s": 1.0})
    assert DarkSequence.planned(station, quick=False) == DarkSequence(exposures_s=(0.001, 0.05, 0.5, 1.0), frames=4)
    with pytest.raises(ValidationError, match="exposure_min_s: 2 s is above exposure_max_s, 1 s; exchange them"):
        fake_bench.station(limits={"exposure_min_s": 2.0, "exposure_max_s": 1.0})


def test_a_plan_is_kept_with_every_sequence_and_none_is_taken_twice() -> None:
    white, green = (FlatSequence(levels=(0.5,), frames=1, wavelength_nm=nm) for nm in (0.0, 530.0))
    assert [one["wavelength_nm"] for one in CapturePlan((white, green)).document()["flat"]] == [0.0, 530.0]
    assert CapturePlan((white,)).document()["flat"]["wavelength_nm"] == 0.0
    with pytest.raises(InputError, match="the step flat/exposure is there 2 times; take each sequence once"):
        CapturePlan((white, green, white)).steps(STATION)
