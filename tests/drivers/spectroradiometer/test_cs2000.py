"""The CS-2000's driver: against the golden transcript, against the mock on a real line, and when things go wrong."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.errors import Garbled, InstrumentError, NoAnswer, Refused
from drivers.spectroradiometer.cs2000 import Cs2000
from mocks.cs2000 import MockCs2000
from mocks.lamp import Lamp, LampClock
from mocks.wire import Pty


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    peer = scripted("cs2000-driver.txt")
    with Cs2000(peer.address) as radiometer:
        assert radiometer.identity().model == "CS-2000A"
        with pytest.raises(Refused, match="'MEAS,1' failed: ER10, too bright; dim the light"):
            radiometer.measure()
    assert peer.strange == []
    assert peer.requests[-1] == b"RMTS,0\n"


def test_round_trip_with_the_mock(served: Callable[..., str]) -> None:
    lamp = Lamp(20.0)
    with Cs2000(served(MockCs2000(lamp), Pty())) as radiometer:
        measured = radiometer.measure()
    assert measured.serial_number == "10004711"
    wavelength_nm = np.arange(380.0, 780.5)
    assert measured.radiance_w_sr_m2_nm.wavelength_nm == tuple(wavelength_nm)
    # Four digits go over the wire.
    np.testing.assert_allclose(measured.radiance_w_sr_m2_nm.value, lamp.radiance().at(wavelength_nm), rtol=5e-4)


# Connecting takes 3 answers (MEAS,0, RMTS,1, IDDR); then MEAS,1 (4), its end (5), MEDR (6..9).
@pytest.mark.parametrize(
    ("fault", "error"),
    [
        *(("never@4", Garbled), ("half@4", Garbled), ("never@5", NoAnswer), ("half@5", NoAnswer)),
        *(
            ("half@6", NoAnswer),
            ("never@9", NoAnswer),
            ("wrong@4", Garbled),
            ("wrong@5", Garbled),
            ("wrong@9", Garbled),
        ),
        *(("error@4", Refused), ("error@7", Refused), ("drop@8", NoAnswer), ("unplug=0.3@6", InstrumentError)),
    ],
)
def test_a_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], tmp_path: Any, fault: str, error: type[Exception]
) -> None:
    line = Pty(tmp_path / "line")
    radiometer = Cs2000(served(MockCs2000(Lamp()), line, fault), timeout_s=0.5, measure_timeout_s=2.0)
    radiometer.connect()
    with pytest.raises(error) as caught:
        radiometer.measure()
    assert "\n" not in str(caught.value)
    for _ in range(100):
        try:
            assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 401
            break
        except InstrumentError:
            assert "unplug" in fault  # it is gone for a while
            time.sleep(0.05)
    else:
        pytest.fail("it never came back")
    radiometer.close()


def test_a_measurement_that_takes_too_long_is_cancelled(served: Callable[..., str]) -> None:
    with Cs2000(served(MockCs2000(Lamp(0.5)), Pty()), measure_timeout_s=60.0) as radiometer:
        with pytest.raises(InstrumentError, match="takes 80 s, more than 60 s; give it more light"):
            radiometer.measure()
        radiometer.measure_timeout_s = 90.0
        radiometer.measure()


def test_the_end_of_a_stopped_measurement_is_not_taken_for_that_of_the_next(served: Callable[..., str]) -> None:
    lamp = Lamp(20.0, LampClock(1.0))
    radiometer = Cs2000(served(MockCs2000(lamp), Pty()))
    radiometer.connect()
    ended: list[str] = []

    def measure() -> None:
        try:
            radiometer.measure()
        except InstrumentError as error:
            ended.append(str(error))

    worker = threading.Thread(target=measure)
    worker.start()
    worker.join(0.5)
    radiometer.stop()
    worker.join(30)
    assert "stopped while waiting for 'MEAS,1'" in ended[0]
    assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 401
    radiometer.close()
