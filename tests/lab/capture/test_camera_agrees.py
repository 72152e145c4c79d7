"""A camera against its data sheet before anything is captured, and how long a session waits for its frames."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.camera.base import SensorInfo
from drivers.camera.stream import MOST_LOST
from drivers.camera.u3v import U3vCamera
from lab.capture import devices
from lab.capture.devices import READOUT_S, CamerasDevice, Shot
from lab.capture.instruments import contradiction
from lab.formats.recording_set import DataSheet

SHEET = DataSheet.model_validate({"rows": 480, "cols": 640, "cfa": "RGGB", "bit_depth": 12})


def _sensor(**other: Any) -> SensorInfo:
    return SensorInfo(
        **({"rows": 480, "cols": 640, "pixel_format": "BayerRG12", "cfa": "RGGB", "bit_depth": 12} | other)
    )


@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        (_sensor(), None),
        (_sensor(cfa=None, bit_depth=None), None),
        (_sensor(bit_depth=10), "camera left: its codes have 10 bits, .* says 12; correct bit_depth there"),
        (_sensor(rows=240), "has 240 x 640 pixels, .* says 480 x 640; correct rows and cols"),
        (_sensor(cfa="BGGR"), "says its colour filters are BGGR, .* says RGGB; correct cfa there"),
    ],
)
def test_what_the_data_sheet_contradicts_is_told_in_one_line(sensor: SensorInfo, said: str | None) -> None:
    found = contradiction("left", sensor, SHEET)
    if said is None:
        assert found is None
    else:
        assert found is not None
        assert "\n" not in found
        with pytest.raises(AssertionError, match=said):
            raise AssertionError(found)


def test_a_session_waits_longer_than_its_cameras_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mock bench's own station file gives its cameras 60 s, longer than a session waited: a dropped frame was never
    taken again."""
    waits: list[float] = []
    monkeypatch.setattr(devices, "Status", lambda who, call, timeout_s: waits.append(timeout_s))
    camera = U3vCamera("usb://1", timeout_s=60.0)
    device = CamerasDevice({"left": camera}, {"left": SHEET}, lambda path, side, raw: pytest.fail("no frame"))
    device.prepare(Shot({"left": 2.0}, 0.0, {}))
    device.trigger()
    assert waits == [60.0 + READOUT_S, (1 + MOST_LOST) * (2.0 + 60.0) + READOUT_S]
