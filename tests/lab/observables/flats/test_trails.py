"""Uniform light on a mosaic whose packets leave charge behind: what neighbours of other colours collect of it is
predicted, far from the output as near it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from lab.formats.recording_set import RecordingSet
from lab.observables.dataset import Dataset
from lab.observables.flats.field import measure_flat_field
from lab.observables.flats.green_balance import measure_green_balance
from lab.observables.flats.line_gains import measure_line_gains
from lab.observables.observable import Observable
from lab.observables.spectra.narrowband import measure_narrowband
from sim.effects.charge_transfer_inefficiency import ChargeTransferInefficiency
from tests.lab.diagnose.on_blocks import measured_model, rendered, sigmas

#: 8 % of the last row's charge is left behind.
TRAILS = ChargeTransferInefficiency(parallel_ppm=800.0, release_px=0.8)
BOTH_WAYS = ChargeTransferInefficiency(
    parallel_ppm=500.0, release_px=0.8, serial_ppm=400.0, serial_release_px=2.0, first_row="bottom"
)


@cache
def recorded(effect: ChargeTransferInefficiency) -> RecordingSet:
    return rendered(7, (effect,), sweep_to_nm=620, cfa="GRBG")


@pytest.mark.parametrize("effect", [TRAILS, BOTH_WAYS], ids=["rows", "rows and columns"])
@pytest.mark.parametrize("make", [measure_green_balance, measure_flat_field, measure_narrowband])
def test_what_packets_leave_to_other_colours_is_predicted(
    make: Callable[[Dataset], Observable], effect: ChargeTransferInefficiency
) -> None:
    """With the law chi2 is at most 4 of its standard deviations above its count, without it far off. It is below where
    nuisance parameters that the camera has at 0 are free."""
    model = measured_model(recorded(effect), make)
    assert sigmas(model, (effect,)) < 4.0
    assert sigmas(model) > 20.0


def test_lines_of_even_light_are_predicted() -> None:
    """The planes of a mosaic grow unlike each other along the rows: the rows' power isn't that of gains."""
    model = measured_model(recorded(TRAILS), measure_line_gains)
    assert abs(sigmas(model, (TRAILS,))) < 4.0


def test_green_ratios_of_the_cells_follow_the_number_of_transfers() -> None:
    """Of few losses, the charge that greens on red rows find beside those on blue rows grows in proportion to the
    row: the middles of the three rows of cells lie at 1/6, 1/2 and 5/6 of the frame."""
    block = measured_model(recorded(TRAILS), measure_green_balance).blocks[0]
    weak = ChargeTransferInefficiency(parallel_ppm=1.0, release_px=0.8)
    cells = block.predict((weak,)).mean[-12:].reshape(3, 4)
    np.testing.assert_allclose(cells[1] / cells[2], 0.0, atol=0.05)
    np.testing.assert_allclose(cells[0], -cells[2], rtol=0.05)
