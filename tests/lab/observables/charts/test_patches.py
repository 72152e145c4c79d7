"""Patches of charts: counted once a frame, by cell of the mosaic."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.capture_kinds.chart import ChartCapture
from lab.diagnose.inference.side_model import dataset_of
from lab.formats.recording_set import RecordingSet
from lab.observables.charts.patches import patch_boxes, patch_codes, patch_levels
from sim.sensor import mosaic


def recorded(cfa: str) -> RecordingSet:
    return recordings_of(ConcealedCamera(7, cfa=cfa, rows=100, cols=130), Plan(("dark", "flat", "chart")))


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG", "MONO"])
def test_a_level_is_the_mean_of_its_channel_s_pixels_in_all_repeats(cfa: str) -> None:
    """Of boxes that begin at even and at odd rows and columns; equal but for rounding, 1e-12."""
    recordings = recorded(cfa)
    begins = {(rows[0] % 2, cols[0] % 2) for _, rows, cols, *_ in patch_boxes(recordings.captures(ChartCapture)[0])}
    assert len(begins) > 1
    points = patch_levels(dataset_of(recordings, "left"))
    assert points
    for point in points:
        rows, cols = next(box[1:3] for box in patch_boxes(point.captures[0]) if box[0] == point.name)
        mask = np.zeros((100, 130), bool)
        step = mosaic.step(cfa)
        for row, col in mosaic.phases(cfa)[point.channel]:
            mask[row::step, col::step] = True
        inside = slice(*rows), slice(*cols)
        pixels = [recordings.frame(capture)[inside][mask[inside]] for capture in point.captures]
        assert point.level == pytest.approx(np.mean(pixels), rel=1e-12)
        assert point.pixels == pixels[0].size


def test_a_chart_is_read_once_for_all_statements() -> None:
    recordings = recorded("RGGB")
    capture = recordings.captures(ChartCapture)[0]
    first = patch_codes(recordings, capture)
    restated = recordings.under(recordings.manifest.model_copy(update={"name": "another"}))
    assert patch_codes(restated, capture) is first
