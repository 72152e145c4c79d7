"""Frames in place of a bench."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mocks.ready_frames import ReadyFrames


def save(folder: Path, name: str, value: int, shape: tuple[int, int] = (4, 6)) -> None:
    np.save(folder / name, np.full(shape, value, np.uint16))


def test_a_folders_frames_come_in_turn_and_in_real_time(tmp_path: Path) -> None:
    for number in (1, 2):
        save(tmp_path, f"{number}-left.npy", number)
    save(tmp_path, "1-right.npy", 7)
    ready = ReadyFrames.of_folder(tmp_path, ("left", "right"))
    assert ready.sensor("left")[:2] == (4, 6)
    begin_s = ready.clock.now()
    assert [int(ready.expose("left", 0.01, 0.0, begin_s)[0, 0]) for _ in range(3)] == [1, 2, 1]
    assert ready.clock.now() >= begin_s + 0.01
    assert int(ready.expose("right", 0.0, 0.0, begin_s)[0, 0]) == 7


@pytest.mark.parametrize(
    ("shape", "value", "message"),
    [((4, 6), 5000, "aren't uint16 of 12 bits"), ((3, 6), 1, r"have the shapes \(3, 6\); one even size is needed")],
)
def test_frames_that_no_camera_here_has(tmp_path: Path, shape: tuple[int, int], value: int, message: str) -> None:
    save(tmp_path, "1-left.npy", value, shape)
    with pytest.raises(ValueError, match=message):
        ReadyFrames.of_folder(tmp_path, ("left",))
    with pytest.raises(ValueError, match=r"holds no \*-right.npy"):
        ReadyFrames.of_folder(tmp_path, ("right",))
    (tmp_path / "1-right.npy").write_bytes(b"no array")
    with pytest.raises(ValueError, match=r"1-right\.npy: can't be read"):
        ReadyFrames.of_folder(tmp_path, ("right",))
