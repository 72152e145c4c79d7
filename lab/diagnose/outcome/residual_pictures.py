"""Residual pictures: a held-out frame of each kind, measured less predicted, before and after the named effects.

The forward model draws the mean frame (`lab.predict.replay`); the light's level, a nuisance parameter, is fitted
channel by channel. A cell of a picture is the sum of its pixels' residuals over its standard deviation, sqrt(sum
variance), with shot noise, read noise, PRNU and rounding: of noise alone, cells have variance 1."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture
from lab.capture_kinds.chart import ChartCapture
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.errors import NotDetermined
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import ResidualPicture
from lab.observables.charts.patches import PATCH_COLOUR_STD, PATCH_STD, patch_boxes
from lab.predict.replay import Replay
from sim.camera import CameraModel, Side
from sim.effects.base import Effect
from sim.sensor import mosaic
from sim.spectrum import FloatArray

KINDS = ("flat", "slanted_edge", "chart")
#: Largest number of cells of a picture.
ROWS, COLS = 48, 64


def residual_pictures(
    recordings: RecordingSet, side: Side, model: MeasurementModel, improved: CameraFile
) -> Iterator[ResidualPicture]:
    """One picture of each kind that was captured and that can be replayed, held out where possible. Before: with the
    baseline's own effects."""
    replay = Replay(recordings, side, improved.camera)
    held_out = set(model.captures(True))
    both = model.always, tuple(improved.effects)
    for kind in KINDS:
        captures = [c for c in replay.captures if c.kind == kind]
        if not captures:
            continue
        capture = max(captures, key=lambda c: (c.id in held_out, _brightness(recordings, c, improved.camera)))
        try:
            drawn = {effects: _residual(recordings, replay, capture, effects) for effects in {*both}}
        except (NotDetermined, ValueError):
            continue
        before, after = (drawn[effects] for effects in both)
        yield ResidualPicture(
            side=side, kind=kind, capture=capture.id, held_out=capture.id in held_out, before=_rows(before),
            after=_rows(after)
        )  # fmt: skip


def _brightness(recordings: RecordingSet, capture: Capture, camera: CameraModel) -> float:
    """Return a frame's 99.9 % quantile (DN); -1 where it is clipped."""
    high = float(np.quantile(recordings.frame(capture), 0.999))
    return -1.0 if high >= 0.97 * camera.white_level_dn else high


def _residual(recordings: RecordingSet, replay: Replay, capture: Capture, effects: Sequence[Effect]) -> FloatArray:
    """Cells of the frame less its prediction under the effects, each channel scaled to the frame's level."""
    camera = replay.camera
    frame = recordings.frame(capture).astype(float)
    offset = camera.black_level_dn + camera.conversion_gain_dn_per_e * camera.dark_current_e_per_s * capture.exposure_s
    predicted = replay.expected(capture, effects) - offset
    judged = _judged(capture, frame.shape)
    step = mosaic.step(camera.cfa)
    for phases in mosaic.phases(camera.cfa).values():
        parts = [(slice(r, None, step), slice(c, None, step)) for r, c in phases]
        lit = sum(float(predicted[part][judged[part]].sum()) for part in parts)
        seen = sum(float((frame[part] - offset)[judged[part]].sum()) for part in parts)
        for part in parts:
            predicted[part] *= seen / lit if lit > 0 else 1.0
    gain = camera.conversion_gain_dn_per_e
    signal = np.maximum(predicted, 0.0)
    variance = (
        gain * signal + (gain * camera.read_noise_e) ** 2 + (camera.prnu_percent / 100.0 * signal) ** 2 + 1.0 / 12.0
    )
    region = _region(capture, frame.shape)
    patch_std = np.hypot(PATCH_STD, PATCH_COLOUR_STD) if isinstance(capture, ChartCapture) else 0.0
    return _cells(
        np.where(judged, frame - offset - predicted, 0.0)[region],
        np.where(judged, variance, 0.0)[region],
        np.where(judged, patch_std * signal, 0.0)[region],
    )


def _judged(capture: Capture, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mask of the pixels that the model predicts: an edge's region, the inner halves of a chart's patches, else all."""
    inside = np.zeros(shape, bool)
    if isinstance(capture, ChartCapture):
        for _, rows, cols, *_ in patch_boxes(capture):
            inside[slice(*rows), slice(*cols)] = True
    else:
        row0, col0, row1, col1 = (isinstance(capture, SlantedEdgeCapture) and capture.region) or (0, 0, *shape)
        inside[row0:row1, col0:col1] = True
    return inside


def _region(capture: Capture, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the middle of an edge, pixel by pixel; else the whole frame."""
    if not isinstance(capture, SlantedEdgeCapture):
        return slice(None), slice(None)
    row0, col0, row1, col1 = capture.region or (0, 0, *shape)
    row, col = (row0 + row1) // 2, (col0 + col1) // 2
    high, wide = min(ROWS, row1 - row0) // 2, min(COLS, col1 - col0) // 2
    return slice(row - high, row + high), slice(col - wide, col + wide)


def _cells(residual: FloatArray, variance: FloatArray, common_std: FloatArray) -> FloatArray:
    """Sums over cells of whole mosaics, over sqrt(sum variance + (sum common_std)^2); 0 of empty cells. `common_std`:
    the standard deviation of an error that the pixels of a cell share."""
    high = max(-(-residual.shape[0] // ROWS), 1)
    wide = max(-(-residual.shape[1] // COLS), 1)
    high, wide = (size + size % 2 if size > 1 else size for size in (high, wide))
    rows, cols = residual.shape[0] // high, residual.shape[1] // wide

    def total(table: FloatArray) -> FloatArray:
        cut = table[: rows * high, : cols * wide]
        return np.asarray(cut.reshape(rows, high, cols, wide).sum(axis=(1, 3)))

    std = np.sqrt(total(variance) + np.square(total(common_std)))
    return np.asarray(total(residual) / np.where(std > 0, std, np.inf))


def _rows(table: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(round(float(v), 2) for v in row) for row in table)
