"""The mock USB2000+ by its bytes."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from mocks.bench import Bench
from mocks.usb2000plus import (
    DARK_COUNTS,
    DARK_PIXELS,
    NOISE_COUNTS,
    PIXELS,
    SATURATION_COUNTS,
    MockUsb2000Plus,
    calibration_csv,
)
from mocks.usb_device import Abandoned, Stalled


@pytest.fixture
def device() -> MockUsb2000Plus:
    bench = Bench()
    bench.place("sphere")
    bench.set_wavelength(0.0)
    bench.set_shutter(True)
    return MockUsb2000Plus(bench)


def ask(device: MockUsb2000Plus, data: bytes, endpoint: int = 0x81, length: int = 64) -> bytes:
    device.transfer(0x01, bytes(8), data, 0, lambda: False)
    return device.transfer(endpoint, bytes(8), None, length, lambda: True)


def scan(device: MockUsb2000Plus) -> np.ndarray:
    packet = ask(device, b"\x09", 0x82, 4097)
    assert len(packet) == 2 * PIXELS + 1
    assert packet[-1] == 0x69
    return np.frombuffer(packet[:-1], "<u2").astype(float)


def test_slots_are_texts_of_a_fixed_length(device: MockUsb2000Plus) -> None:
    answer = ask(device, b"\x05\x00")
    assert len(answer) == 17
    assert answer[:2] == b"\x05\x00"
    assert answer[2:].rstrip(b"\0") == b"USB2+F00001"
    assert float(ask(device, b"\x05\x01")[2:].rstrip(b"\0")) == pytest.approx(339.82)
    assert struct.unpack_from("<H", ask(device, b"\x05\x11"), 6) == (SATURATION_COUNTS,)
    with pytest.raises(Stalled):
        device.transfer(0x01, bytes(8), b"\x05\xf0", 0, lambda: False)


def test_status_tells_the_integration_time(device: MockUsb2000Plus) -> None:
    device.transfer(0x01, bytes(8), b"\x02" + struct.pack("<I", 20_000), 0, lambda: False)
    status = struct.unpack("<HIBBBBBBBBBB", ask(device, b"\xfe"))
    assert status[:2] == (PIXELS, 20_000)
    assert status[10] == 0x80  # high speed


def test_covered_pixels_stay_dark_and_full_scale_clips(device: MockUsb2000Plus) -> None:
    device.transfer(0x01, bytes(8), b"\x02" + struct.pack("<I", 60_000_000), 0, lambda: False)
    before = device._light.clock.now()
    counts = scan(device)
    assert device._light.clock.now() - before >= 60.0
    assert counts.max() == SATURATION_COUNTS
    # 15 pixels of the stated noise, 4 standard deviations
    assert counts[DARK_PIXELS].mean() == pytest.approx(DARK_COUNTS, abs=4 * NOISE_COUNTS / np.sqrt(15))


def test_what_it_does_not_know_it_passes_over(device: MockUsb2000Plus) -> None:
    for data in (b"\x77", b"\x02\x01", b"\x09\x09"):
        device.transfer(0x01, bytes(8), data, 0, lambda: False)
    with pytest.raises(Abandoned):
        device.transfer(0x81, bytes(8), None, 64, lambda: True)


def test_a_calibration_may_be_off_as_real_ones_are() -> None:
    exact, off = (
        np.array([[float(v) for v in line.split(",")] for line in calibration_csv(percent).splitlines()[1:]])
        for percent in (0.0, 2.0)
    )
    departure = off[:, 1] / exact[:, 1] - 1.0
    assert np.max(np.abs(departure)) == pytest.approx(0.02, rel=0.01)  # the file holds seven digits
    assert np.max(np.abs(np.diff(departure))) < 1e-3  # smooth
