"""Memory of the diagnosis: it doesn't grow with the number of repeats, as frames are summed one by one."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.diagnose.metadata.frames import misstated_dark_exposure
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.acquisition_errors import exchanged_frames
from lab.observables.darks.frames import dark_frames
from lab.observables.dataset import Dataset, mean_frame

SIDE_PX = 256  # the counts of codes, which are kept of every frame, take some 4 kB whatever its size
BLACK_DN, READ_DN, GAIN = 64.0, 3.0, 0.4
#: Kind, exposure (s) and signal (DN) of the settings.
SETTINGS = [("dark", 0.01, 0.1), ("dark", 0.1, 1.0), ("dark", 1.0, 10.0)]
SETTINGS += [("flat", 0.01 * level, 10.0 * level) for level in (30, 100, 200)]


class _DrawnFrames(Mapping[str, NDArray[np.uint16]]):
    """Frames by `setting-repeat`, drawn whenever they are asked for: a set that takes no memory itself."""

    def __init__(self, repeats: int) -> None:
        self._names = [f"{setting}-{repeat}" for setting in range(len(SETTINGS)) for repeat in range(repeats)]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, name: str) -> NDArray[np.uint16]:
        setting, repeat = (int(part) for part in name.split("-"))
        signal = SETTINGS[setting][2]
        noise = np.random.default_rng([setting, repeat]).standard_normal((SIDE_PX, SIDE_PX), np.float32)
        std = np.float32(np.sqrt(READ_DN**2 + GAIN * signal))
        return np.rint(np.float32(BLACK_DN + signal) + std * noise).astype(np.uint16)


def _recordings(repeats: int) -> RecordingSet:
    frames = _DrawnFrames(repeats)
    captures = []
    for name in frames:
        kind, exposure_s, _ = SETTINGS[int(name.split("-")[0])]
        captures.append({"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": exposure_s})
    stated = {"rows": SIDE_PX, "cols": SIDE_PX, "cfa": "MONO", "bit_depth": 12, "black_level_dn": BLACK_DN}
    manifest = Manifest.model_validate({"cameras": {"left": stated}, "captures": captures})
    return RecordingSet(manifest, frames, cache_bytes=0)


def _dataset(recordings: RecordingSet) -> Dataset:
    return Dataset(recordings, "left", camera_model(recordings, "left"))


STEPS: dict[str, Callable[[RecordingSet], Any]] = {
    "exposures of darks": lambda recordings: misstated_dark_exposure(recordings, "left"),
    "exchanged frames": lambda recordings: exchanged_frames(recordings, "left"),
    "first estimates": _dataset,
    "dark frames": lambda recordings: dark_frames(_dataset(recordings)),
    "mean frame": lambda recordings: mean_frame(recordings, recordings.captures("flat")),
}


@pytest.mark.parametrize("step", STEPS)
def test_repeats_take_no_memory(step: str) -> None:
    """Three times the repeats of every setting take less additional memory than half of the frames that one setting has
    more, as they are stored: 2 bytes a pixel. 16 repeats are enough for the few frames that are kept for medians."""

    def peak_bytes(repeats: int) -> int:
        recordings = _recordings(repeats)
        tracemalloc.start()
        try:
            STEPS[step](recordings)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    STEPS[step](_recordings(2))  # loads what is loaded once
    few, many = 16, 48
    assert peak_bytes(many) - peak_bytes(few) < 0.5 * (many - few) * 2 * SIDE_PX**2
