"""The quick look at a session under way: a frame's histogram, and curves of frames with a known law."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from lab.capture.records import CaptureInfo
from lab.capture.store import Store
from lab.errors import InputError
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.quick_look.curves import BINS, GrowingCurves, frame_figures
from lab.quick_look.process import QuickLook
from sim.spectrum import Spectrum

ROWS, COLS, BLACK, WHITE = 200, 240, 64, 4095
CAMERA = {"rows": ROWS, "cols": COLS, "cfa": "RGGB", "bit_depth": 12, "black_level_dn": BLACK, "white_level_dn": WHITE}
GAIN_DN_PER_E, LIGHT = 0.5, Spectrum.of([400.0, 500.0], [0.1, 0.3])


def test_a_frames_figures_are_those_of_its_pixels() -> None:
    frame = np.full((4, 4), 100, np.uint16)
    frame[0, 0], frame[1, 1] = WHITE, 2000  # red, blue
    found = frame_figures(frame, DataSheet.model_validate(CAMERA | {"rows": 4, "cols": 4}))
    red, green, _, blue = found.channels
    assert [one.channel for one in found.channels] == ["R", "G1", "G2", "B"] and found.bin_dn * BINS == WHITE + 1
    assert red.saturated_share == 0.25 and red.mean_dn == (WHITE + 300) / 4 and red.counts[-1] == 1
    assert green.saturated_share == 0.0 and green.counts[int(100 / found.bin_dn)] == 4
    assert blue.counts[int(2000 / found.bin_dn)] == 1 and all(sum(one.counts) == 4 for one in found.channels)


class KnownCaptures:
    """A store's captures, of a linear camera with Poisson noise alone."""

    def __init__(self) -> None:
        self.taken: list[tuple[dict[str, Any], np.ndarray[Any, Any]]] = []
        self.rng = np.random.default_rng(8)
        self.asked = 0

    def take(self, electrons: float, **document: Any) -> None:
        counts = self.rng.poisson(electrons, (ROWS, COLS))
        frame = np.clip(np.rint(BLACK + GAIN_DN_PER_E * counts), 0, WHITE).astype(np.uint16)
        id = f"{document['kind']}/{len(self.taken)}"
        self.taken.append((document | {"id": id, "side": "left", "frame": f"frames/{len(self.taken)}.npy"}, frame))

    def captures(self, _: str, after: int | None, limit: int) -> list[CaptureInfo]:
        first = after or 0
        return [
            CaptureInfo(id=at, session_id="s", name=one["id"], kind=one["kind"], side="left", document=one)
            for at, (one, _) in enumerate(self.taken, start=1)
            if at > first
        ][:limit]

    def count_captures(self, _: str) -> dict[tuple[str, str], int]:
        return {("all", "left"): len(self.taken)}

    def recording_set(self, _: str, only: tuple[int]) -> RecordingSet:
        self.asked += 1
        document, frame = self.taken[only[0] - 1]
        manifest = Manifest.model_validate({"cameras": {"left": CAMERA}, "captures": [document]})
        return RecordingSet(manifest, {document["frame"]: frame}, {"light.csv": LIGHT})


def test_the_curves_grow_and_say_what_the_frames_are() -> None:
    store = KnownCaptures()
    growing = GrowingCurves(cast(Store, store), "s")
    store.take(500.0, kind="flat", exposure_s=0.01)
    assert growing.look().transfer == ()  # a pair is needed
    for electrons, exposure_s in ((500.0, 0.01), (500.0, 0.01), (4000.0, 0.08), (4000.0, 0.08)):
        store.take(electrons, kind="flat", exposure_s=exposure_s)
    store.take(1000.0, kind="narrowband", wavelength_nm=450.0, exposure_s=0.1, radiance="light.csv")
    store.take(1000.0, kind="narrowband", wavelength_nm=450.0, exposure_s=0.1, radiance="light.csv")
    store.take(10.0, kind="dark", exposure_s=0.1)
    found = growing.look()
    assert (found.captures, found.looked_at) == (8, 8) and len(found.transfer) == 8 and len(found.sensitivity) == 4
    pixels = ROWS * COLS / 4 / 4  # a channel of the middle quarter
    for point in found.transfer:
        electrons = 500.0 if point.exposure_s == 0.01 else 4000.0
        mean, variance = GAIN_DN_PER_E * electrons, GAIN_DN_PER_E**2 * electrons + 1 / 12
        # 5 sigma of the mean of two frames, and of half the variance of a difference: sqrt(2 / N) of itself
        assert point.mean_dn == pytest.approx(mean, abs=5 * np.sqrt(variance / 2 / pixels))
        assert point.variance_dn2 == pytest.approx(variance, rel=5 * np.sqrt(2 / pixels))
        assert not point.saturated
    radiance = 20.0  # of LIGHT, a trapezium
    expected = GAIN_DN_PER_E * 1000.0 / 0.1 / radiance
    error = GAIN_DN_PER_E * np.sqrt(1000.0 / pixels) / 0.1 / radiance
    assert [one.dn_per_s_and_radiance for one in found.sensitivity] == pytest.approx([expected] * 4, abs=5 * error)
    asked = store.asked
    assert growing.look() == found and store.asked == asked  # each capture once


def test_a_session_that_is_not_there_has_no_curves(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with pytest.raises(InputError):
        GrowingCurves(store, "none").look()
    look = QuickLook(store)
    assert look.curves("none").looked_at == 0
    look.close()
    store.close()
