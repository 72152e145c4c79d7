"""What read-out adds to the pixels of every frame: each measurement that it changes predicts it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest

from lab.diagnose.measurements.block import Block
from lab.diagnose.measurements.dark_readout import fixed_line_block
from lab.diagnose.measurements.darks import dark_field_block, dark_level_block
from lab.diagnose.measurements.flat_field import shading_block
from lab.diagnose.measurements.flat_rows import flicker_block
from lab.formats.recording_set import RecordingSet
from lab.measure.study import Study
from tests.lab.diagnose.on_blocks import measured_model, rendered, sigmas
from tests.sim.local_effects import ReadOutRamp

RAMP = ReadOutRamp(last_row_e=40.0)


@cache
def recorded() -> RecordingSet:
    return rendered(5, (RAMP,))


def without_darks(recordings: RecordingSet) -> RecordingSet:
    return recordings.without({c.id for c in recordings.captures("dark", "left")})


@pytest.mark.parametrize(
    ("make", "recordings"),
    [
        (dark_field_block, recorded),
        (partial(fixed_line_block, "rows"), recorded),
        (shading_block, recorded),
        (flicker_block, lambda: without_darks(recorded())),
    ],
    ids=["dark_field", "dark_row_pattern", "flat_field", "flat_rows"],
)
def test_what_read_out_adds_is_predicted(
    make: Callable[[Study], Block], recordings: Callable[[], RecordingSet]
) -> None:
    """Without the effect the numbers lie far off, with it chi-squared is within 4 of its standard deviations."""
    model = measured_model(recordings(), make)
    assert sigmas(model) > 20.0
    assert abs(sigmas(model, (RAMP,))) < 4.0


def test_the_rows_of_flats_have_the_offsets_of_dark_rows() -> None:
    """The dark frames' mean rows are subtracted: no effect has to tell them once more."""
    assert abs(sigmas(measured_model(recorded(), flicker_block))) < 4.0


def test_its_mean_is_a_part_of_the_black_level() -> None:
    """The level that dark frames have at no exposure is measured with it."""
    model = measured_model(recorded(), dark_level_block)
    assert abs(sigmas(model)) < 4.0
    np.testing.assert_array_equal(model.mean((RAMP,)), model.mean(()))
