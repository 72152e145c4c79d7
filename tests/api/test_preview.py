"""A preview shows light as light and colours as colours."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from api.preview import GAMMA, preview
from lab.formats.recording_set import DataSheet
from sim.sensor.mosaic import phases


def camera(cfa: str, rows: int = 40, cols: int = 60) -> DataSheet:
    return DataSheet(rows=rows, cols=cols, cfa=cfa, bit_depth=12, black_level_dn=100, white_level_dn=4000)  # type: ignore[arg-type]


def picture(*args: Any, **options: Any) -> np.ndarray[Any, Any]:
    found = cv2.imdecode(np.frombuffer(preview(*args, **options), np.uint8), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return found


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_each_channel_has_its_colour(cfa: Any) -> None:
    for channel, shown in (("B", 0), ("G", 1), ("R", 2)):
        frame = np.full((40, 60), 100, np.uint16)
        for row, col in phases(cfa)[channel]:
            frame[row::2, col::2] = 4000
        found = picture(frame, camera(cfa), 480)
        assert found.shape == (20, 30, 3)
        assert np.all(found[..., shown] == 255) and np.all(np.delete(found, shown, axis=2) == 0)


@pytest.mark.parametrize("level", [0.0, 0.1, 0.5, 1.0])
def test_levels_follow_gamma_between_black_and_white(level: float) -> None:
    frame = np.full((40, 60), round(100 + level * 3900), np.uint16)
    found = picture(frame, camera("MONO"), 480)
    assert found.shape == (40, 60)
    assert np.all(np.abs(found - 255 * level ** (1 / GAMMA)) <= 0.5 + 1e-6)  # rounding to 8 bits


def test_shrinking_keeps_the_mean_light() -> None:
    frame = np.where(np.indices((40, 60)).sum(0) % 2, 4000, 100).astype(np.uint16)
    found = picture(frame, camera("MONO"), 30)
    assert found.shape == (20, 30)
    assert np.all(np.abs(found - 255 * 0.5 ** (1 / GAMMA)) <= 0.5 + 1e-6)


def test_odd_sizes_and_dark_frames() -> None:
    frame = np.full((41, 61), 90, np.uint16)
    assert picture(frame, camera("RGGB", 41, 61), 480).max() == 0
    assert picture(frame, camera("RGGB", 41, 61), 480, stretch=True).max() == 0
