"""The USB3 Vision driver: golden bytes without a mock, then against the mock camera in process and over USB/IP."""

from __future__ import annotations

import struct
import threading
import time
from array import array
from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
import pytest
import usb.core
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.camera.base import capture_together
from drivers.camera.gencp import GenCp
from drivers.camera.pixel_format import PIXEL_FORMATS, PixelFormat
from drivers.camera.u3v import LEADER, LEADER_MAGIC, StreamLayout, U3vCamera, U3vStream
from drivers.errors import Disconnected, Garbled, InstrumentError, NoAnswer, Refused
from mocks.bench import Bench
from mocks.ready_frames import pack_12p
from mocks.u3v import (
    BALANCE_BLUE,
    BALANCE_GREEN,
    BALANCE_RED,
    GAMMA_ENABLE,
    LIGHT_SOURCE,
    TEST_PATTERN,
    WHITE_AUTO,
    U3vDevice,
)
from mocks.usb import InProcessBackend, UsbIpServer, serve_usbip, stereo_pair
from mocks.wire import parse_faults


class Wire:
    """A pyusb device that notes what is written and reads out prepared answers."""

    def __init__(self, *answers: str | usb.core.USBError) -> None:
        self.written: list[bytes] = []
        self._answers = list(answers)

    def write(self, endpoint: int, data: bytes, timeout: int) -> int:
        assert timeout > 0
        self.written.append(bytes(data))
        return len(data)

    def read(self, endpoint: int, size: int, timeout: int) -> bytes:
        assert timeout > 0
        answer = self._answers.pop(0) if self._answers else usb.core.USBTimeoutError("Operation timed out")
        if isinstance(answer, usb.core.USBError):
            raise answer
        return bytes.fromhex(answer)


def control(wire: Wire, next_id: int = 1) -> GenCp:
    channel = GenCp(wire, 0x01, 0x81, "camera X")
    channel._request_id = next_id - 1
    return channel


SERIAL_64 = b"4103123456".ljust(64, b"\0").hex()


class TestGoldenBytes:
    def test_read_as_seen_on_a_real_wire(self) -> None:
        """The packet of spec/instruments.md: ReadMem of 64 bytes at 4, request id 0xff15."""
        wire = Wire("55335643 0000 0108 4000 15ff" + SERIAL_64)
        assert control(wire, 0xFF15).text(4) == "4103123456"
        assert wire.written == [bytes.fromhex("55335643 0040 0008 0c00 15ff 0400000000000000 0000 4000")]

    def test_write(self) -> None:
        wire = Wire("55335643 0000 0308 0400 0200 0000 0400")
        control(wire, 2).write(0x10024, bytes([1, 0, 0, 0]))
        assert wire.written == [bytes.fromhex("55335643 0040 0208 0c00 0200 2400010000000000 01000000")]

    def test_pending_acknowledge_is_waited_for(self) -> None:
        wire = Wire(
            "55335643 0000 0508 0400 0100 0000 f401",  # 500 ms more
            "55335643 0000 0108 0400 0100 78563412",
        )
        assert control(wire).integer(0) == 0x12345678
        assert len(wire.written) == 1

    def test_late_answers_are_skipped(self) -> None:
        wire = Wire("55335643 0000 0108 0400 0900 ffffffff", "55335643 0000 0108 0400 0100 01000000")
        assert control(wire).integer(0) == 1

    def test_lost_packet_is_sent_again_under_its_number(self) -> None:
        wire = Wire(usb.core.USBTimeoutError("Operation timed out"), "55335643 0000 0108 0400 0100 01000000")
        assert control(wire).integer(0) == 1
        assert len(wire.written) == 2
        assert wire.written[0] == wire.written[1]

    def test_silence(self) -> None:
        with pytest.raises(NoAnswer, match=r"camera X: no answer while accessing its memory \(0800\)"):
            control(Wire()).integer(0)

    def test_refusal(self) -> None:
        with pytest.raises(Refused, match=r"no register at this address \(0x8003\)") as caught:
            control(Wire("55335643 0380 0108 0000 0100")).integer(0x5000)
        assert caught.value.code == 0x8003

    @pytest.mark.parametrize(
        "answer", ["", "5533", "55335658 0000 0108 0400 0100 01000000", "55335643 0000 0108 4000 0100 01"]
    )
    def test_garbage(self, answer: str) -> None:
        with pytest.raises(Garbled, match="camera X"):
            control(Wire(answer)).integer(0)

    def test_unplugged(self) -> None:
        with pytest.raises(Disconnected, match="plug it in again"):
            control(Wire(usb.core.USBError("No such device", errno=19))).integer(0)

    def test_long_reads_are_divided(self) -> None:
        wire = Wire(
            "55335643 0000 0108 4000 0100" + "11" * 64,
            "55335643 0000 0108 2400 0200" + "22" * 36,
        )
        assert control(wire).read(0x100, 100) == b"\x11" * 64 + b"\x22" * 36
        assert [struct.unpack_from("<QHH", packet, 12) for packet in wire.written] == [(0x100, 0, 64), (0x140, 0, 36)]


class TestPixelFormats:
    def test_codes_of_the_standard(self) -> None:
        names = {item.name: code for code, item in PIXEL_FORMATS.items()}
        assert names["BayerRG8"] == 0x01080009
        assert names["BayerRG10"] == 0x0110000D
        assert names["BayerRG12"] == 0x01100011
        assert names["BayerRG12p"] == 0x010C0059
        assert names["BayerRG16"] == 0x0110002F
        assert names["BayerBG12"] == 0x01100013
        for code, item in PIXEL_FORMATS.items():  # PFNC: bits 16..23 are the bits a pixel takes
            assert (code >> 16) & 0xFF == (item.bits if item.packed or item.bits == 8 else 16)

    def test_12p_by_hand(self) -> None:
        item = PIXEL_FORMATS[0x010C0059]
        assert item.unpack(bytes.fromhex("bc3a12"), 1, 2).tolist() == [[0xABC, 0x123]]

    def test_10p_by_hand(self) -> None:
        # four pixels 0x001 0x002 0x003 0x3FF in five bytes, least significant bit first
        stream = sum(pixel << 10 * k for k, pixel in enumerate([1, 2, 3, 0x3FF])).to_bytes(5, "little")
        assert PIXEL_FORMATS[0x010A0058].unpack(stream, 2, 2).tolist() == [[1, 2], [3, 0x3FF]]

    @given(st.integers(1, 6), st.integers(1, 7), st.randoms(use_true_random=False))
    def test_12p_comes_back(self, rows: int, cols: int, random: object) -> None:
        raw = np.random.default_rng(random.randrange(1000)).integers(0, 4096, (rows, cols)).astype(np.uint16)  # type: ignore[attr-defined]
        assert np.array_equal(PIXEL_FORMATS[0x010C0059].unpack(pack_12p(raw), rows, cols), raw)

    @pytest.mark.parametrize("item", PIXEL_FORMATS.values(), ids=lambda item: item.name)
    def test_every_format_has_its_size(self, item: PixelFormat) -> None:
        payload = bytes(item.payload_bytes(30))
        assert item.unpack(payload, 5, 6).shape == (5, 6)
        with pytest.raises(ValueError, match="too few"):
            item.unpack(payload[:-1], 5, 6)

    def test_padding(self) -> None:
        item = PIXEL_FORMATS[0x01080009]
        assert item.unpack(bytes([1, 2, 0, 0, 3, 4, 0, 0]), 2, 2, padding=2).tolist() == [[1, 2], [3, 4]]


# --- against the mock -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bench() -> Bench:
    bench = Bench(seed=4)
    bench.set_shutter(True)
    bench.set_filter(2)
    bench.place("sphere")
    return bench


def camera_of(device: U3vDevice, timeout_s: float = 60.0, **settings: object) -> U3vCamera:
    """Patient, for a busy machine, but where a fault is to be waited for."""
    found = usb.core.find(backend=InProcessBackend([device]))
    return U3vCamera("usb://mock", device=found, timeout_s=timeout_s, **settings)  # type: ignore[arg-type]


@pytest.fixture
def device(bench: Bench) -> U3vDevice:
    return U3vDevice(bench, "left", "CB-1")


@pytest.fixture
def impatient(device: U3vDevice, bench: Bench) -> Iterator[U3vCamera]:
    bench.expose("left", 0.002)  # the first is drawn, and its loops compiled, for longer than that time-out
    with camera_of(device, timeout_s=0.8) as camera:
        camera.configure(0.002)
        yield camera


@pytest.fixture
def camera(device: U3vDevice) -> Iterator[U3vCamera]:
    with camera_of(device) as camera:
        camera.configure(0.002)
        yield camera


def test_identity_and_sensor(camera: U3vCamera) -> None:
    identity, sensor = camera.identity(), camera.sensor()
    assert (identity.maker, identity.serial_number, identity.firmware) == ("calibench", "CB-1", "1.0.2")
    assert (sensor.rows, sensor.cols, sensor.pixel_format, sensor.cfa, sensor.bit_depth) == (
        480,
        640,
        "BayerRG12",
        "RGGB",
        12,
    )
    assert sensor.pixel_pitch_um == pytest.approx(3.0)


def test_frames_follow_the_exposure(camera: U3vCamera, bench: Bench) -> None:
    camera.configure(0.001)
    short = camera.capture()
    camera.configure(0.002, 6.0206)
    long = camera.capture()
    assert short.raw.dtype == np.uint16
    assert short.raw.shape == (480, 640)
    assert (short.exposure_s, short.gain_db, long.exposure_s) == (pytest.approx(0.001), 0.0, pytest.approx(0.002))
    assert long.gain_db == pytest.approx(6.0206, abs=1e-5)
    assert short.temperature_c == pytest.approx(bench.sensor_temperature_c("left"), abs=0.006)
    # twice the time at twice the gain: four times the signal over black, to far better than 1 %
    assert (long.raw.mean() - 64.3) / (short.raw.mean() - 64.3) == pytest.approx(4.0, rel=0.01)
    assert (short.frame_id, long.frame_id) == (0, 1)
    assert short.time < long.time


@pytest.mark.parametrize("name", ["BayerRG12", "BayerRG12p", "BayerRG8"])
def test_formats_agree(device: U3vDevice, bench: Bench, name: str) -> None:
    with camera_of(device, pixel_format=name) as camera:
        camera.configure(0.002)
        frame = camera.capture()
    assert frame.pixel_format == name
    scale = 16.0 if name == "BayerRG8" else 1.0
    # 8 bits drop the lowest four: half of 15 DN on average
    dropped = 7.5 if name == "BayerRG8" else 0.0
    # PRNU's mean is zero and shot noise over 77k pixels is below 0.2 DN
    assert frame.raw.mean() * scale + dropped == pytest.approx(bench.expose("left", 0.002).mean(), abs=1.0)


def test_a_format_that_is_not_offered(device: U3vDevice) -> None:
    with pytest.raises(
        InstrumentError, match="Mono8 isn't offered or known; it offers BayerRG8, BayerRG12, BayerRG12p"
    ):
        camera_of(device, pixel_format="Mono8").connect()


@pytest.mark.parametrize(
    ("exposure_s", "gain_db"), [(100.0, 0.0), (1e-6, 0.0), (0.01, 30.0), (0.0, 0.0), (float("nan"), 0.0)]
)
def test_settings_outside_the_limits(camera: U3vCamera, exposure_s: float, gain_db: float) -> None:
    with pytest.raises(InstrumentError, match=r"camera"):
        camera.configure(exposure_s, gain_db)
    camera.configure(0.01)  # and it goes on
    assert camera.capture().exposure_s == pytest.approx(0.01)


def test_calls_out_of_order(device: U3vDevice) -> None:
    with camera_of(device) as camera:
        with pytest.raises(InstrumentError, match="call configure first"):
            camera.arm()
        camera.configure(0.001)
        with pytest.raises(InstrumentError, match="call arm first"):
            camera.fire()
        with pytest.raises(InstrumentError, match="call arm and fire first"):
            camera.collect()


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("never", NoAnswer, r"no frame within 0\.8 s of its exposure of 0\.002 s; check the cable and the power"),
        ("late", NoAnswer, "no frame within"),
        ("short", Garbled, r"is torn: \d+ of 614400 bytes came"),
        ("torn", Garbled, r"is torn: \d+ of 614400 bytes came"),
        ("lost-trailer", Garbled, "is torn: its trailer was lost"),
        ("damaged", Garbled, "data discarded"),
        ("halt", NoAnswer, "halted its endpoint while reading a frame of 0.002 s; the halt is cleared"),
        ("unplug", Disconnected, "the connection was lost"),
        ("busy", Refused, "busy"),
        ("garbled", Garbled, "answered"),
    ],
)
def test_faults_are_told_and_got_over(
    impatient: U3vCamera, device: U3vDevice, fault: str, error: type[Exception], message: str
) -> None:
    impatient.capture()
    device.inject(fault)
    with pytest.raises(error, match=message) as caught:
        impatient.capture()
    assert "\n" not in str(caught.value)
    if fault == "unplug":
        device.plug()
    if fault == "late":
        time.sleep(1.0)  # let it come, to be thrown away
    frame = impatient.capture()
    assert frame.raw.mean() > 500


@pytest.mark.parametrize("fault", ["pending", "silent", "lost-ack"])
def test_faults_that_a_driver_gets_over_by_itself(camera: U3vCamera, device: U3vDevice, fault: str) -> None:
    device.inject(fault)
    camera.configure(0.001)
    assert camera.capture().exposure_s == pytest.approx(0.001)


def test_a_camera_that_answers_nothing(camera: U3vCamera, device: U3vDevice) -> None:
    device.inject("silent", 3)
    with pytest.raises(NoAnswer, match="check the cable"):
        camera.configure(0.001)


def test_transcript(device: U3vDevice) -> None:
    pieces: list[tuple[str, bytes]] = []
    with camera_of(device, recorder=lambda way, data: pieces.append((way, data))):
        pass
    assert pieces[0] == ("sent", bytes.fromhex("55335643 0040 0008 0c00 0100 cc01000000000000 0000 0400"))
    assert pieces[1][0] == "received"


@pytest.fixture
def server(bench: Bench) -> Iterator[UsbIpServer]:
    with serve_usbip(stereo_pair(bench)) as server:
        yield server


def test_over_usbip_both_cameras_are_triggered_together(server: UsbIpServer, bench: Bench) -> None:
    with (
        U3vCamera(server.url("CB-U3V-0001"), output_line="Line1") as left,
        U3vCamera(server.url("CB-U3V-0002")) as right,
    ):
        left.configure(0.002)
        right.configure(0.001)
        assert (left.identity().serial_number, right.identity().serial_number) == ("CB-U3V-0001", "CB-U3V-0002")
        before = bench.clock.now()
        pair = capture_together([left, right])
        # side by side, not one after the other: the bench's clock went on by the longer exposure
        assert bench.clock.now() - before == pytest.approx(0.002, abs=1e-6)
        again = capture_together([left, right])
    assert [frame.frame_id for frame in pair] == [0, 0]
    assert [frame.frame_id for frame in again] == [1, 1]
    assert all(frame.raw.shape == (480, 640) and frame.raw.mean() > 200 for frame in pair)


def test_a_camera_that_is_told_no_output_line_triggers_no_other(server: UsbIpServer) -> None:
    with (
        U3vCamera(server.url("CB-U3V-0001")) as left,
        U3vCamera(server.url("CB-U3V-0002"), timeout_s=0.5) as right,
    ):
        left.configure(0.001)
        right.configure(0.001)
        left.capture()
        with pytest.raises(NoAnswer, match="it waited for Line0: the camera that leads needs output_line"):
            capture_together([left, right])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trigger_line": "Line3"}, "no trigger line Line3; it has Line0: name the one that is wired"),
        ({"output_line": "Line7"}, "no line Line7; it has Line0, Line1: correct output_line"),
        ({"output_line": "Line0"}, "Line0 can't be an output"),
        (
            {"output_line": "Line1", "output_source": "Timer9"},
            "Line1 can't follow Timer9; it offers Off, ExposureActive",
        ),
    ],
)
def test_lines_are_checked_against_the_cameras_own(device: U3vDevice, settings: dict[str, str], message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        camera_of(device, **settings).connect()


def test_processing_of_codes_is_switched_off_and_the_black_level_read(device: U3vDevice) -> None:
    with camera_of(device) as camera:
        assert camera.nodes.get("GammaEnable") is False
        assert camera.sensor().black_level == 64.0


def test_a_camera_that_keeps_its_gamma_is_refused(device: U3vDevice, monkeypatch: pytest.MonkeyPatch) -> None:
    write = U3vDevice._write_feature

    def stubborn(self: U3vDevice, register: int, data: bytes) -> None:
        if register != GAMMA_ENABLE:
            write(self, register, data)

    monkeypatch.setattr(U3vDevice, "_write_feature", stubborn)
    with pytest.raises(InstrumentError, match="GammaEnable is True and can't be set to False: its codes aren't"):
        camera_of(device).connect()


@pytest.mark.parametrize(
    ("spec", "error"),
    [
        ("half@2", Garbled),
        ("wrong@2", Garbled),
        ("error@2", NoAnswer),
        ("drop@2", Garbled),
        ("unplug=0.2@2", Disconnected),
    ],
)
def test_faults_of_the_command_line_reach_cameras(
    impatient: U3vCamera, device: U3vDevice, spec: str, error: type[Exception]
) -> None:
    device.fail(parse_faults(spec))
    impatient.capture()
    with pytest.raises(error):
        impatient.capture()
    end = time.monotonic() + 30
    frame = None
    while frame is None and time.monotonic() < end:
        try:
            frame = impatient.capture()
        except Disconnected:
            time.sleep(0.05)
    assert frame is not None
    assert frame.raw.mean() > 500


def test_addresses(server: UsbIpServer) -> None:
    host, port = server.address
    with pytest.raises(
        Disconnected, match="no USB device with serial number NONE; there are: CB-U3V-0001, CB-U3V-0002"
    ):
        U3vCamera(f"usbip://{host}:{port}/NONE").connect()
    with pytest.raises(InstrumentError, match="write usbip://HOST:PORT/SERIAL"):
        U3vCamera("tcp://somewhere").connect()
    with pytest.raises(Disconnected, match="no USB/IP server"):
        U3vCamera("usbip://127.0.0.1:1/X").connect()


def test_a_server_that_goes_away(bench: Bench) -> None:
    devices = stereo_pair(bench)
    server = serve_usbip(devices)
    camera = U3vCamera(server.url("CB-U3V-0001"))
    camera.connect()
    camera.configure(0.001)
    server.close()
    with pytest.raises(Disconnected):
        camera.capture()
    camera.close()


@settings(max_examples=25)
@given(st.binary(min_size=0, max_size=80))
def test_no_answer_breaks_the_control_channel(answer: bytes) -> None:
    with pytest.raises(InstrumentError):
        control(Wire(answer.hex()), 7).read(0, 1 << 14)


class _Slow:
    """A pyusb device that gives a leader and nothing more until its time-outs have passed; then the parts that are left
    in `parts`."""

    def __init__(self, parts: Sequence[bytes] = ()) -> None:
        self.leader, self.waits, self.parts = True, threading.Event(), list(parts)

    def read(self, endpoint: int, into: Any, timeout_ms: int) -> int:
        if self.leader:
            self.leader = False
            head = LEADER.pack(LEADER_MAGIC, 0, LEADER.size, 1, 0, 1, 0, 0x01080001, 4, 4, 0, 0, 0, 0)
            into[: len(head)] = array("B", head)
            return len(head)
        self.waits.set()
        time.sleep(timeout_ms / 1000)
        if not self.parts:
            raise usb.core.USBTimeoutError("Operation timed out")
        part = self.parts.pop(0)
        into[: len(part)] = array("B", part)
        return len(part)


def test_a_stream_ends_while_a_long_exposure_is_waited_for() -> None:
    device = _Slow()
    stream = U3vStream(cast(Any, device), 0x81, StreamLayout(64, 64, (16,)), timeout_s=600.0)
    assert device.waits.wait(30.0)
    stream.close()
    assert not stream._thread.is_alive()


def test_a_transfer_that_comes_while_a_wait_ends_is_taken_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.camera.u3v._WAIT_S", 0.01)
    device = _Slow([b"01234", b"56789abcdef"])
    device.leader = False
    stream = U3vStream.__new__(U3vStream)
    stream._device, stream._endpoint, stream._ending = cast(Any, device), 0x81, threading.Event()
    piece = array("B", bytes(16))
    assert stream._fill(piece, time.monotonic() + 30.0) == 16 and piece.tobytes() == b"0123456789abcdef"


def test_codes_are_the_converters(bench: Bench) -> None:
    """The mock powers up with a preset for daylight and a white balance; a second camera without either has the same
    codes."""
    balanced, plain = U3vDevice(bench, "left", "CB-8"), U3vDevice(bench, "left", "CB-9")
    for at, register in enumerate((BALANCE_RED, BALANCE_GREEN, BALANCE_BLUE)):
        balanced._put(register, int.from_bytes(struct.pack("<f", 1.8 + at), "little"))
    balanced._put(WHITE_AUTO, 2)
    balanced._put(TEST_PATTERN, 1)
    plain._put(LIGHT_SOURCE, 0)
    means = []
    for device in (balanced, plain):
        with camera_of(device) as camera:
            camera.configure(0.002)
            means.append([camera.capture().raw[row::2, col::2].mean() for row in (0, 1) for col in (0, 1)])
            told = camera.settings()
            assert camera.departures() == ()
        assert (told["LightSourcePreset"], told["BalanceWhiteAuto"], told["TestPattern"]) == ("Off", "Off", "Off")
        assert [told[f"BalanceRatio[{name}]"] for name in ("Red", "Green", "Blue")] == [1.0, 1.0, 1.0]
    # noise of a mean over 76800 pixels of some hundred codes: below 0.1 %
    np.testing.assert_allclose(means[0], means[1], rtol=0.005)
