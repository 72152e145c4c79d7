"""The PR-655's and PR-670's driver: against the golden transcript, against the mock on a real line, and when things go
wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.errors import Garbled, NoAnswer, Refused
from drivers.spectroradiometer.pr655 import Pr655
from mocks.lamp import Lamp
from mocks.pr655 import DIALECTS, PhotoResearch
from mocks.wire import Pty, Reply


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    peer = scripted("pr655-driver.txt")
    with Pr655(peer.address) as radiometer:
        measured = radiometer.measure()
        assert radiometer.identity().serial_number == "65501234"
    assert measured.radiance_w_sr_m2_nm.wavelength_nm == (380.0, 580.0, 780.0)
    assert measured.radiance_w_sr_m2_nm.value == (1e-3, 2.5e-3, 3e-3)
    assert measured.integration_time_s == 0.25
    assert peer.strange == []
    assert peer.requests[-1] == b"Q"  # remote mode is left


@pytest.mark.parametrize(("model", "step_nm"), [("PR-655", 4), ("PR-670", 2)])
@pytest.mark.parametrize("dialect", DIALECTS)
def test_round_trip_with_the_mock(served: Callable[..., str], model: str, step_nm: int, dialect: str) -> None:
    lamp = Lamp(20.0)
    with Pr655(served(PhotoResearch(lamp, model, dialect=dialect), Pty())) as radiometer:
        assert radiometer.identity().model == model
        measured = radiometer.measure()
    wavelength_nm = np.arange(380, 781, step_nm)
    assert measured.radiance_w_sr_m2_nm.wavelength_nm == tuple(wavelength_nm)
    # Four digits go over the wire.
    np.testing.assert_allclose(measured.radiance_w_sr_m2_nm.value, lamp.radiance().at(wavelength_nm), rtol=5e-4)
    assert measured.integration_time_s is not None


# Connecting takes 4 answers; the measurement is the fifth.
@pytest.mark.parametrize(
    ("fault", "error"),
    [("never@5", NoAnswer), ("half@5", NoAnswer), ("wrong@5", Garbled), ("error@5", Refused)],
)
def test_a_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], fault: str, error: type[Exception]
) -> None:
    radiometer = Pr655(served(PhotoResearch(Lamp()), Pty(), fault), timeout_s=0.5, measure_timeout_s=0.5)
    radiometer.connect()
    with pytest.raises(error) as caught:
        radiometer.measure()
    assert "\n" not in str(caught.value)
    assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 101
    radiometer.close()


class _Behind(PhotoResearch):
    """One that answers what an earlier connection asked before it greets, and greets that one, too."""

    def _listen(self, value: int) -> list[bytes]:
        greeting = super()._listen(value)
        return [Reply(b"00000,Normal,1000\r\n"), *greeting, *greeting] if greeting else []


def test_late_answers_to_an_earlier_connection_are_left_out(served: Callable[..., str]) -> None:
    with Pr655(served(_Behind(Lamp()), Pty()), timeout_s=2.0) as radiometer:
        assert radiometer.identity().serial_number == "65501234"
        assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 101


def test_too_little_light_is_told_with_its_remedy(served: Callable[..., str]) -> None:
    with (
        Pr655(served(PhotoResearch(Lamp(1e-5)), Pty())) as radiometer,
        pytest.raises(Refused, match="-8, under-exposed; give it more light"),
    ):
        radiometer.measure()
