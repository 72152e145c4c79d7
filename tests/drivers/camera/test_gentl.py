"""Cameras through GenTL, on the producer that GenICam's package brings: three cameras, in this process, described as
triggered ones."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from drivers.camera.base import capture_together
from drivers.camera.gentl import SEARCH_PATH, GentlCamera
from drivers.errors import Disconnected, InstrumentError, InUse, NoAnswer
from mocks.peers import VikyCamera
from tests.peers import missing

RED, GREEN = "VikyTL_DEV_red", "1"  # an identifier, and a serial number


@pytest.fixture(scope="module")
def viky() -> VikyCamera:
    try:
        return VikyCamera()
    except InstrumentError as error:
        missing(str(error))


def test_two_cameras_of_one_producer_are_a_pair_by_software(viky: VikyCamera) -> None:
    with (
        GentlCamera(RED, **viky.settings) as left,
        GentlCamera(GREEN, **viky.settings, trigger_line="Software") as right,
    ):
        assert left.identity().maker == "Machine Vision Games Ltd."
        assert (left.identity().serial_number, right.identity().serial_number) == ("0", "1")
        for camera in (left, right):
            camera.configure(0.002)
        pairs = [capture_together([left, right]) for _ in range(3)]
        with pytest.raises(InUse, match="in use by another program or another instrument of the station"):
            GentlCamera("0", **viky.settings).connect()
    assert np.diff([[frame.frame_id for frame in pair] for pair in pairs], axis=0).tolist() == [[1, 1], [1, 1]]
    for frame in pairs[0]:
        assert (frame.raw.shape, frame.raw.dtype, frame.pixel_format) == ((400, 400), np.uint16, "Mono8")
        assert (frame.exposure_s, frame.camera_time_ns, frame.temperature_c) == (0.002, None, None)
    # the balls have moved: these are the producer's own pictures, one after the other
    assert any(np.any(first.raw != last.raw) for first, last in zip(pairs[0], pairs[2], strict=True))


def test_what_bends_the_codes_is_switched_off_and_limits_are_the_cameras_own(viky: VikyCamera) -> None:
    with GentlCamera(RED, **viky.settings, timeout_s=0.05) as camera:
        features = camera._features
        assert features is not None
        assert (features.get("GammaEnable"), features.get("ExposureAuto")) == (False, "Off")
        with pytest.raises(InstrumentError, match=r"ExposureTime 1e\+09 us is outside 20\.\.1e\+07 us"):
            camera.configure(1000.0)
        with pytest.raises(InstrumentError, match="Gain 60 dB is outside 0"):
            camera.configure(0.01, 60.0)
        camera.configure(0.01, 6.0)
        with pytest.raises(InstrumentError, match="no trigger line Line0; it has Line1"):
            camera.arm("line")
        camera.arm()
        camera.fire()  # the frame comes later than that
        with pytest.raises(NoAnswer, match=r"no frame within 0\.05 s of its exposure of 0\.01 s; check the cable"):
            camera.collect()


def test_a_transcript_tells_the_features_that_were_written_and_read(viky: VikyCamera) -> None:
    pieces: list[tuple[str, bytes]] = []
    with GentlCamera(RED, **viky.settings, recorder=lambda way, data: pieces.append((way, data))) as camera:
        camera.configure(0.002)
        camera.capture()
    written = [("sent", b"GammaEnable = False"), ("sent", b"ExposureTime = 2000.0"), ("sent", b"TriggerSoftware")]
    assert [piece for piece in pieces if piece in written] == written
    assert ("received", b"ExposureTime = 2000.0") in pieces


def test_ctrl_c_stays_pythons(viky: VikyCamera) -> None:
    before = signal.getsignal(signal.SIGINT)
    with GentlCamera(RED, **viky.settings):
        assert signal.getsignal(signal.SIGINT) is before


def test_what_isnt_there_is_told_in_one_line(
    viky: VikyCamera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv(SEARCH_PATH, raising=False)
    assert list(GentlCamera.enumerate_cameras()) == []
    with pytest.raises(InstrumentError, match="no GenTL producer is installed; install the maker's software"):
        GentlCamera(RED).connect()
    monkeypatch.setenv(SEARCH_PATH, str(Path(viky.settings["producer"]).parent))
    assert dict(GentlCamera.enumerate_cameras())["1"] == "Machine Vision Games Ltd. Viky 1"
    with pytest.raises(Disconnected, match="the GenTL producers find no such camera; there are: 0, 1, 2; is it"):
        GentlCamera("4711").connect()
    with pytest.raises(InstrumentError, match="it has no TriggerMode, so that its exposures can't be triggered"):
        GentlCamera(RED).connect()  # by its own description
    with pytest.raises(InstrumentError, match=r"none\.cti: it isn't a GenTL producer \(no such file\)"):
        GentlCamera(RED, producer=str(tmp_path / "none.cti")).connect()
    (tmp_path / "text.cti").write_text("no library")
    with pytest.raises(InstrumentError, match=r"text\.cti: it isn't a GenTL producer"):
        GentlCamera(RED, producer=str(tmp_path / "text.cti")).connect()
    assert capfd.readouterr().err == ""


def test_a_description_that_fails_leaves_the_camera_free(viky: VikyCamera, tmp_path: Path) -> None:
    (tmp_path / "broken.xml").write_text("<no>")
    (tmp_path / "other.xml").write_text("<other/>")
    with GentlCamera(RED, **viky.settings):  # the producer stays open
        for name, message in (
            ("none.xml", r"its description .*none\.xml can't be read \(.*No such file"),
            ("broken.xml", "can't be read .*; correct it in the station file"),
            ("other.xml", "camera 1: can't be opened"),
        ):
            with pytest.raises(InstrumentError, match=message):
                GentlCamera(GREEN, **viky.settings | {"description": str(tmp_path / name)}).connect()
        with GentlCamera(GREEN, **viky.settings) as camera:
            assert camera.identity().serial_number == "1"
