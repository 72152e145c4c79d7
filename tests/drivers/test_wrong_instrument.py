"""A driver at another instrument's address: one line that says so, and the instrument is left in peace."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import usb.core

from drivers.camera.u3v import U3vCamera
from drivers.errors import InstrumentError, InUse
from drivers.monochromator.cornerstone260 import Cornerstone260
from drivers.monochromator.cornerstone260b import Cornerstone260B
from drivers.spectroradiometer.cr300 import Cr300
from drivers.spectroradiometer.specbos1211 import Specbos1211
from drivers.stage.operator import OperatorStage
from mocks.bench import Bench
from mocks.cornerstone260 import MockCornerstone260
from mocks.cornerstone260b import MockCornerstone260B
from mocks.cr300 import ColorimetryResearch
from mocks.lamp import Lamp
from mocks.specbos1211 import MockSpecbos1211
from mocks.u3v import U3vDevice
from mocks.usb import InProcessBackend, serve_usbip
from mocks.wire import Pty

NOT_THIS = "check that it is this instrument that is connected there"


@pytest.mark.parametrize(
    ("driver", "message"),
    [(Cornerstone260, NOT_THIS), (Cr300, "no answer within .* to 'RC ID'")],  # to CR-300's line ends it is silent
)
def test_at_a_specbos(
    served: Callable[..., str], tmp_path: Path, driver: type[Cornerstone260 | Cr300], message: str
) -> None:
    refused_at(served(MockSpecbos1211(Lamp(20.0)), Pty(tmp_path / "line")), driver, message)


@pytest.mark.parametrize(
    ("driver", "message"), [(Specbos1211, "check that a specbos is at this address"), (Cr300, NOT_THIS)]
)
def test_at_a_monochromator(
    served: Callable[..., str], tmp_path: Path, driver: type[Specbos1211 | Cr300], message: str
) -> None:
    address = served(MockCornerstone260(Bench()), Pty(tmp_path / "line"))
    refused_at(address, driver, message)
    with Cornerstone260(address) as rightly:
        assert not rightly.shutter_is_open()


@pytest.mark.parametrize(
    ("driver", "message"),
    [
        (Cornerstone260, r"answered 'INFO\?' with 'ER:-500:.*; check that a Cornerstone 260 is at this address"),
        (OperatorStage, r"answered 'PLACED\?' with 'ER:-500:.*; check that a stage is at this address"),
    ],
)
def test_at_a_cr300(
    served: Callable[..., str], tmp_path: Path, driver: type[Cornerstone260 | OperatorStage], message: str
) -> None:
    refused_at(served(ColorimetryResearch(Lamp(20.0)), Pty(tmp_path / "line")), driver, message)


def test_one_that_is_in_use_is_said_to_be() -> None:
    bench = Bench()
    with serve_usbip([MockCornerstone260B(bench)]) as server:
        address = server.url("CB-260B-01")
        with (
            Cornerstone260B(address),
            pytest.raises(InUse, match="there are: none, and 1 in use by another program or another instrument"),
        ):
            Cornerstone260B(address).connect()


def refused_at(address: str, driver: type[Cornerstone260 | Specbos1211 | Cr300 | OperatorStage], message: str) -> None:
    with pytest.raises(InstrumentError, match=message) as caught:
        driver(address, timeout_s=0.3).connect()
    assert "\n" not in str(caught.value)


def test_on_usb() -> None:
    bench = Bench()
    camera = usb.core.find(backend=InProcessBackend([U3vDevice(bench, "left", "CB-1")]))
    with pytest.raises(InstrumentError, match=r"is neither CS260B .* nor CS130B .*: correct the address"):
        Cornerstone260B("usb://CB-1", device=camera).connect()
    mono = usb.core.find(backend=InProcessBackend([MockCornerstone260B(bench)]))
    with pytest.raises(InstrumentError, match="this USB device is no USB3 Vision camera"):
        U3vCamera("usb://mono", device=mono).connect()
