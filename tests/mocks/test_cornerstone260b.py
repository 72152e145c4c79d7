"""The USBTMC monochromator by its bytes, and through plain pyusb."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import usb.core
import usb.util
from hypothesis import given, settings
from hypothesis import strategies as st

from mocks import usb as mock_usb
from mocks.bench import Bench
from mocks.cornerstone260b import MockCornerstone260B
from mocks.usb_device import Abandoned, Stalled


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench()


class Host:
    """A USBTMC host written from the standard."""

    def __init__(self, device: MockCornerstone260B) -> None:
        self.device = device
        self.tag = 0

    def out(self, data: bytes) -> None:
        self.device.transfer(0x02, bytes(8), data, 0, lambda: False)

    def into(self, patience_s: float = 2.0) -> bytes:
        deadline = time.monotonic() + patience_s
        return self.device.transfer(0x82, bytes(8), None, 4096, lambda: time.monotonic() > deadline)

    def say(self, text: str) -> None:
        self.tag = self.tag % 255 + 1
        data = text.encode() + b"\r\n"
        self.out(
            bytes([1, self.tag, self.tag ^ 0xFF, 0])
            + len(data).to_bytes(4, "little")
            + bytes([1, 0, 0, 0])
            + data
            + bytes(-len(data) % 4)
        )

    def hear(self) -> str:
        self.tag = self.tag % 255 + 1
        self.out(bytes([2, self.tag, self.tag ^ 0xFF, 0]) + (1024).to_bytes(4, "little") + bytes(4))
        answer = self.into()
        assert answer[:4] == bytes([2, self.tag, self.tag ^ 0xFF, 0])
        assert answer[8] & 1
        assert len(answer) % 4 == 0
        return answer[12 : 12 + int.from_bytes(answer[4:8], "little")].decode().strip()

    def ask(self, text: str) -> str:
        self.say(text)
        return self.hear()


@pytest.fixture
def host(bench: Bench) -> Iterator[Host]:
    yield Host(MockCornerstone260B(bench))


def test_golden_bytes(host: Host) -> None:
    """The transfers of spec/instruments.md."""
    host.out(bytes.fromhex("01 01 fe 00  07 00 00 00  01 00 00 00") + b"*IDN?\r\n\0")
    host.out(bytes.fromhex("02 02 fd 00  00 50 00 00  00 00 00 00"))
    text = b"Newport,CS260B,CB-260B-01,1.0\r\n"
    assert (
        host.into()
        == bytes.fromhex("02 02 fd 00") + len(text).to_bytes(4, "little") + bytes([1, 0, 0, 0]) + text + b"\0"
    )


def test_a_move_changes_the_light(host: Host, bench: Bench) -> None:
    before = bench.clock.now()
    host.say("gowave 400.0")
    assert host.ask("*opc?") == "1"
    assert host.ask("idle?") == "1"
    assert host.ask("wave?") == "400.000"
    assert bench.light.wavelength_nm == 400.0
    assert bench.clock.now() - before == pytest.approx(400 / 175)
    host.say("shutter 1")
    host.say("FILTER 2; grating 2; outport 2; *wai")
    assert [host.ask(f"{what}?") for what in ("shutter", "filter", "grating", "outport")] == ["1", "2", "2", "2"]
    assert bench.light.shutter_open
    assert bench.light.filter_place == 2


def test_units(host: Host, bench: Bench) -> None:
    host.say("units um")
    host.say("gowave 0.55; *wai")
    assert host.ask("wave?") == "0.550"
    assert bench.light.wavelength_nm == pytest.approx(550.0)
    host.say("units wn")
    assert float(host.ask("wave?")) == pytest.approx(1e7 / 550, abs=1e-3)


@pytest.mark.parametrize(
    ("command", "error"),
    [("dance", "-113"), ("gowave 9000", "-222"), ("gowave red", "-104"), ("filter 7", "-222"), ("units ft", "-222")],
)
def test_errors_are_queued(host: Host, command: str, error: str) -> None:
    assert host.ask("system:error?") == "0, No Error"
    host.say(command)
    assert host.ask("*opc?") == "1"
    assert host.ask("system:error?").startswith(error)
    assert host.ask("system:error?") == "0, No Error"


def test_it_is_busy_while_it_moves() -> None:
    host = Host(MockCornerstone260B(Bench(real_time_factor=0.2)))
    host.say("gowave 350")  # 2 s, a fifth of it really
    assert host.ask("idle?") == "0"
    host.say("abort")
    assert host.ask("wave?") == "0.000"


def test_a_read_without_a_question_waits(host: Host) -> None:
    host.out(bytes.fromhex("02 01 fe 00  00 04 00 00  00 00 00 00"))
    with pytest.raises(Abandoned):
        host.into(0.05)


def test_capabilities(host: Host) -> None:
    answer = host.device.transfer(0x80, bytes.fromhex("a107000000001800"), None, 24, lambda: False)
    assert (len(answer), answer[0]) == (24, 1)


@settings(max_examples=60)
@given(st.binary(max_size=80), st.booleans())
def test_no_bytes_break_it(bench: Bench, data: bytes, framed: bool) -> None:
    host = Host(MockCornerstone260B(bench))
    try:
        if framed:
            host.say(data.decode("latin-1").lower())
        else:
            host.out(data)
    except Stalled:
        pass
    host.device.plug()
    assert host.ask("*idn?").startswith("Newport,CS260B")


def test_plain_pyusb(bench: Bench) -> None:
    device = usb.core.find(idVendor=0x1FDE, idProduct=0x0014, backend=mock_usb.backend("cornerstone260b", bench))
    device.write(0x02, bytes.fromhex("01 01 fe 00  07 00 00 00  01 00 00 00") + b"*IDN?\r\n\0", 1000)
    device.write(0x02, bytes.fromhex("02 02 fd 00  00 50 00 00  00 00 00 00"), 1000)
    assert bytes(device.read(0x82, 20480, 1000))[12:].startswith(b"Newport,CS260B")
    usb.util.dispose_resources(device)
