"""The CS260B's driver: golden USBTMC bytes without a mock, then against the mock on USB."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
import usb.core

from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer, Refused
from drivers.monochromator.cornerstone260b import Cornerstone260B
from drivers.usbtmc import UsbTmc
from mocks.bench import Bench
from mocks.cornerstone260b import MockCornerstone260B as Mock
from mocks.usb import InProcessBackend
from mocks.wire import parse_faults


class _Wire:
    """A USBTMC device that notes what is written and answers what was prepared."""

    idVendor, idProduct = 0x1FDE, 0x0014

    class _End:
        bmAttributes = 2

        def __init__(self, address: int) -> None:
            self.bEndpointAddress = address

    class _Interface(list):  # type: ignore[type-arg]
        bInterfaceClass, bInterfaceSubClass, bInterfaceNumber = 0xFE, 0x03, 0

    def __init__(self, *answers: bytes) -> None:
        self.written: list[bytes] = []
        self._answers = list(answers)

    def get_active_configuration(self) -> list[list[object]]:
        return [self._Interface([self._End(0x02), self._End(0x82)])]

    def is_kernel_driver_active(self, number: int) -> bool:
        return False

    def ctrl_transfer(self, *arguments: int) -> bytes:
        return b"\x01\x00"

    def clear_halt(self, endpoint: int) -> None:
        pass

    def write(self, endpoint: int, data: bytes, timeout: int) -> None:
        self.written.append(bytes(data))

    def read(self, endpoint: int, size: int, timeout: int) -> bytes:
        return self._answers.pop(0)


def test_golden_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The transfers of the wire's specification: `*IDN?`, and the request for its answer."""
    monkeypatch.setattr("usb.util.claim_interface", lambda device, interface: None)
    text = b"Newport,CS260B,0815,1.0\r\n"
    wire = _Wire(
        bytes.fromhex("02 02 fd 00") + len(text).to_bytes(4, "little") + bytes([1, 0, 0, 0]) + text + b"\0\0\0"
    )
    tmc = UsbTmc(wire, "CS260B at X", timeout_s=1.0)
    assert tmc.ask("*IDN?") == "Newport,CS260B,0815,1.0"
    assert wire.written[0] == bytes.fromhex("01 01 fe 00  07 00 00 00  01 00 00 00") + b"*IDN?\r\n\0"
    assert wire.written[1] == bytes.fromhex("02 02 fd 00  00 50 00 00  00 00 00 00")


@pytest.fixture
def device() -> Mock:
    return Mock(Bench())


def driver_of(device: Mock, **settings: float) -> Cornerstone260B:
    found = usb.core.find(backend=InProcessBackend([device]))
    return Cornerstone260B("usb://mock", device=found, **settings)  # type: ignore[arg-type]


@pytest.fixture
def mono(device: Mock) -> Iterator[Cornerstone260B]:
    with driver_of(device, timeout_s=0.5) as mono:
        yield mono


def test_light_follows_the_driver(mono: Cornerstone260B, device: Mock) -> None:
    bench = device._light
    assert isinstance(bench, Bench)
    assert (mono.identity().model, mono.identity().serial_number) == ("CS260B", "CB-260B-01")
    for wavelength_nm, place in ((400.0, 2), (720.0, 3)):
        mono.move_nm(wavelength_nm)
        assert (mono.wavelength_nm(), bench.light.wavelength_nm, bench.light.filter_place) == (
            wavelength_nm,
            wavelength_nm,
            place,
        )
    mono.open_shutter()
    assert mono.shutter_is_open()
    assert bench.light.shutter_open
    mono.set_slit_um(1000)
    assert (mono.slit_um(), mono.bandwidth_nm()) == (1000, pytest.approx(3.16, rel=1e-3))
    mono.close()
    assert not bench.light.shutter_open


def test_what_it_refuses_carries_its_code(device: Mock) -> None:
    with driver_of(device, upper_nm=2000.0) as mono:
        mono.filters = ()
        with pytest.raises(Refused, match=r"refused 'gowave 1500.000': error -222, Data out of range") as caught:
            mono.move_nm(1500)
        assert caught.value.code == -222
        mono.move_nm(600)
        assert mono.wavelength_nm() == 600


def test_units_are_left_as_they_were_found(device: Mock) -> None:
    device._units = "WN"
    mono = driver_of(device)
    mono.move_nm(500)
    assert device._units == "NM"
    mono.close()
    end = time.monotonic() + 30
    while device._units != "WN" and time.monotonic() < end:
        time.sleep(0.01)
    assert device._units == "WN"


# Answers count from the moment the faults are set: the first is that to idle?, after the command.
@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("never@1", NoAnswer),
        ("half@1", InstrumentError),
        ("wrong@2", Garbled),
        ("error@1", NoAnswer),
        ("unplug=0.2@1", Disconnected),
    ],
)
def test_a_fault_is_one_error_and_then_it_works_again(
    mono: Cornerstone260B, device: Mock, fault: str, error: type[Exception]
) -> None:
    device.fail(parse_faults(fault))
    with pytest.raises(error) as caught:
        mono.open_shutter()
    assert "\n" not in str(caught.value)
    end = time.monotonic() + 30
    opened = False
    while not opened and time.monotonic() < end:
        try:
            mono.open_shutter()
            opened = mono.shutter_is_open()
        except InstrumentError:
            time.sleep(0.05)
    assert opened


def test_a_silent_instrument_that_is_asked_for_its_slits_is_one_error(mono: Cornerstone260B, device: Mock) -> None:
    """No answer may mean slits that a micrometer sets: it is cleared then, which nobody answers either."""
    mono.connect()
    device.mute(True)
    with pytest.raises(NoAnswer, match="no answer while clearing its line"):
        mono.slit_um()
    device.mute(False)
    assert mono.slit_um() > 0.0


def test_stop_ends_a_motion_and_closes_the_shutter() -> None:
    bench = Bench(real_time_factor=1.0)
    begun = threading.Event()
    found = usb.core.find(backend=InProcessBackend([Mock(bench)]))
    mono = Cornerstone260B(
        "usb://mock", device=found, filters=[], recorder=lambda way, data: begun.set() if b"gowave" in data else None
    )
    mono.open_shutter()
    errors: list[Exception] = []

    def move() -> None:
        try:
            mono.move_nm(700)  # 4 s
        except InstrumentError as error:
            errors.append(error)

    mover = threading.Thread(target=move)
    mover.start()
    assert begun.wait(30)
    mono.stop()
    mover.join(30)
    assert [type(error) for error in errors] == [Interrupted]
    assert not bench.light.shutter_open
    assert bench.light.wavelength_nm == 0
    mono.close()


def test_another_device_is_refused() -> None:
    from mocks.usb2000plus import MockUsb2000Plus

    found = usb.core.find(backend=InProcessBackend([MockUsb2000Plus(Bench())]))
    with pytest.raises(InstrumentError, match="2457:101e is neither CS260B"):
        Cornerstone260B("usb://x", device=found).connect()
