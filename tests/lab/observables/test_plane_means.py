"""Means by plane of the 2 x 2 cell: exact in every order of the mosaic and at odd sizes, without any statement about
the camera, and taken once for the sensitivity fit and the diagnosis."""

from __future__ import annotations

import numpy as np
import pytest

from lab.capture_kinds.base import Capture
from lab.fit.spectral.recordings import fit_spectral
from lab.formats.recording_set import FrameCodes, RecordingSet
from lab.formats.results import NoiseFit
from lab.observables.plane_means import central_codes, central_part, channel_means, channel_pixels
from lab.observables.spectra.narrowband import measure_narrowband
from tests.lab.diagnose.on_blocks import UNIFORM, dataset, former


def frame(rows: int, cols: int) -> np.ndarray:
    return np.random.default_rng(rows).integers(0, 4096, (rows, cols)).astype(np.uint16)


@pytest.mark.parametrize("cfa", ["MONO", "RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("size", [(8, 12), (33, 47)])
def test_channels_have_the_mean_and_the_scatter_of_their_pixels(cfa: str, size: tuple[int, int]) -> None:
    drawn = frame(*size)
    for channel, one in channel_means(FrameCodes.count(drawn), cfa).items():
        pixels = channel_pixels(drawn, cfa, channel)
        assert one.pixels == pixels.size
        assert one.mean_dn == pixels.mean()  # sums of integers are exact
        assert one.std_dn == pytest.approx(pixels.std(), rel=1e-12)
        assert one.mean_std_dn(4.0) == pytest.approx(np.hypot(pixels.std(), 1.2) / np.sqrt(pixels.size), rel=1e-12)


def test_the_share_that_clips_is_that_of_the_cell_with_most() -> None:
    frame = np.zeros((200, 200), np.uint16)
    frame[:10:2, 0] = 1000
    one = channel_means(FrameCodes.count(frame), "RGGB")
    assert one["R"].clipped_share(1000) == 5 / 100**2
    assert one["R"].clipped_share(1001) == 0.0
    frame[0, 1:61:2] = 1000
    assert channel_means(FrameCodes.count(frame), "RGGB")["G"].clipped_share(1000) == 30 / 100**2


def test_the_central_part_holds_whole_cells() -> None:
    for size in range(2, 70):
        rows, cols = central_part((size, size + 1))
        for part, whole in ((rows, size), (cols, size + 1)):
            assert part.start % 2 == 0
            assert part.stop <= whole
            assert 2 <= part.stop - part.start <= max(0.25 * whole + 2, 4)


def test_no_statement_about_camera_or_capture_enters() -> None:
    recordings = former(3, cfa="RGGB", kinds=UNIFORM)
    stated = recordings.camera("left").model_copy(
        update={"cfa": "GBRG", "black_level_dn": 9.0, "f_number": 22.0, "white_level_dn": 60000.0, "bit_depth": 16}
    )
    captures = tuple(c.model_copy(update={"exposure_s": 77.0, "gain_db": 6.0}) for c in recordings.captures())
    other = recordings.under(recordings.manifest.model_copy(update={"cameras": {"left": stated}, "captures": captures}))
    for capture, same in zip(recordings.captures(), other.captures(), strict=True):
        for one, two in (
            (recordings.codes(capture), other.codes(same)),
            (central_codes(recordings, capture), central_codes(other, same)),
        ):
            for cell, again in zip(one.cells, two.cells, strict=True):
                np.testing.assert_array_equal(cell.code_dn, again.code_dn)
                np.testing.assert_array_equal(cell.number, again.number)


def test_the_diagnosis_reads_the_means_that_the_fit_took(monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = former(3, cfa="RGGB", kinds=UNIFORM)
    looked_at = dataset(recordings)  # looks for copies of frames, and for the level from which on they clip
    read: list[str] = []
    load = RecordingSet.frame

    def counted(self: RecordingSet, capture: Capture) -> np.ndarray:
        if capture.kind == "narrowband":
            read.append(capture.id)
        return load(self, capture)

    monkeypatch.setattr(RecordingSet, "frame", counted)
    fit_spectral(recordings, "left", NoiseFit(conversion_gain_dn_per_e=looked_at.noise.gain))
    assert set(read) == {c.id for c in recordings.captures("narrowband")}
    read.clear()
    measure_narrowband(looked_at)
    assert not read
