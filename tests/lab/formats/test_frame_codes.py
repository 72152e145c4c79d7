"""Counts of codes: what follows from them is what the pixels themselves give, for every mosaic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.formats.recording_set import CodeCounts, DataSheet, FrameCodes, Manifest, RecordingSet, inspect
from sim.camera import Cfa
from sim.sensor.mosaic import phases, step

CFAS: tuple[Cfa, ...] = ("RGGB", "BGGR", "GRBG", "GBRG", "MONO")


@st.composite
def frames(draw: st.DrawFn) -> NDArray[np.uint16]:
    """Frames of at least 2 x 2 px, odd sizes too, with few or with many codes."""
    rows, cols = draw(st.integers(2, 9)), draw(st.integers(2, 9))
    highest = draw(st.sampled_from([0, 3, 255, 65535]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return rng.integers(0, highest + 1, (rows, cols)).astype(np.uint16)


@given(frames())
def test_counts_give_what_the_pixels_give(frame: NDArray[np.uint16]) -> None:
    every = FrameCodes.count(frame).every
    assert every.pixels == frame.size
    assert every.mean_dn == pytest.approx(float(frame.mean(dtype=float)), rel=1e-12)
    assert every.variance_dn2 == pytest.approx(float(frame.var(dtype=float)), rel=1e-9, abs=1e-9)
    assert (every.code_dn[0], every.highest_dn) == (int(frame.min()), int(frame.max()))
    shares = (0.0, 0.25, 0.5, 0.97, 0.999, 1.0)
    assert every.quantiles(shares) == pytest.approx(np.quantile(frame.astype(float), shares), rel=1e-12, abs=1e-9)
    for code in (0.0, 2.5, 254.0, 255.0, 65535.0, 65536.0):
        assert every.share_from(code) == pytest.approx(float(np.mean(frame >= code)), abs=1e-12)
    assert np.array_equal(every.dense(), np.bincount(frame.ravel(), minlength=65536))


@pytest.mark.parametrize("cfa", CFAS)
@given(frame=frames())
def test_channels_are_those_of_the_mosaic(cfa: Cfa, frame: NDArray[np.uint16]) -> None:
    codes, period = FrameCodes.count(frame), step(cfa)
    for channel, places in phases(cfa).items():
        pixels = np.concatenate([frame[row::period, col::period].ravel() for row, col in places])
        assert np.array_equal(
            CodeCounts.total(codes.channels(cfa)[channel]).dense(), np.bincount(pixels, minlength=65536)
        )


@pytest.mark.parametrize("shape", [(1, 8), (8, 1), (1, 1)])
def test_frames_of_one_row_or_column_have_the_channels_that_they_hold(shape: tuple[int, int]) -> None:
    """Of RGGB a first row holds R and G, a first column too; the set of such frames is checked and read."""
    frame = np.full(shape, 500, np.uint16)
    held = FrameCodes.count(frame).channels("RGGB")
    assert set(held) == ({"R"} if shape == (1, 1) else {"R", "G"})
    assert sum(cell.pixels for cells in held.values() for cell in cells) == frame.size
    camera = DataSheet(rows=shape[0], cols=shape[1], cfa="RGGB", bit_depth=12)
    flat = FlatCapture(id="f", kind="flat", side="left", frame="f.npy", exposure_s=1.0)
    manifest = Manifest.model_validate({"name": "one", "cameras": {"left": camera}, "captures": [flat]})
    problems, _ = inspect(RecordingSet(manifest, {"f.npy": frame}))
    assert problems == []


def test_equal_frames_have_equal_digests() -> None:
    rng = np.random.default_rng(3)
    one = rng.integers(0, 4096, (8, 6)).astype(np.uint16)
    other = one.copy()
    other[3, 4] ^= 1
    marks = [FrameCodes.count(frame, with_digest=True).digest for frame in (one, one.copy(), other)]
    assert marks[0] == marks[1] != marks[2]


def test_nothing_counts_as_nothing() -> None:
    assert CodeCounts.total([]).pixels == 0
    assert CodeCounts.of(np.zeros(65536, np.int64)).highest_dn == 0


def test_a_recording_set_counts_a_frame_once_whatever_is_stated() -> None:
    """Copies with other statements share the counts; a set with other frames doesn't."""
    rng = np.random.default_rng(4)
    frame = rng.integers(60, 70, (8, 6)).astype(np.uint16)
    camera = DataSheet(rows=8, cols=6, cfa="RGGB", bit_depth=12)
    capture = DarkCapture(id="d", kind="dark", side="left", frame="d.npy", exposure_s=1.0)
    manifest = Manifest.model_validate({"name": "one", "cameras": {"left": camera}, "captures": [capture]})
    recordings = RecordingSet(manifest, {"d.npy": frame})
    counted = recordings.codes(capture)
    restated = camera.model_copy(update={"cfa": "GBRG", "black_level_dn": 3.0, "white_level_dn": 100.0})
    other = recordings.under(manifest.model_copy(update={"cameras": {"left": restated}}))
    assert other.codes(capture) is counted
    assert recordings.with_frames({"d.npy": frame + 1}).codes(capture).every.mean_dn == counted.every.mean_dn + 1.0
