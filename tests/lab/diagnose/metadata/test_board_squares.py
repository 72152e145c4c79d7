"""Boards whose squares or markers are stated wrongly: told with the numbers that their pictures fit."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import pytest

from lab.challenge.draw import recordings_of
from lab.diagnose.metadata.targets import misstated_board
from lab.formats.importers import read_checkerboard_pairs
from lab.formats.recording_set import RecordingSet
from mocks.former import ConcealedCamera, Plan

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
