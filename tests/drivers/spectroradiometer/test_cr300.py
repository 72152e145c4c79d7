"""The CR-250's and CR-300's driver: against the golden transcript, against the mock on a real line, and when things go
wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.errors import Garbled, NoAnswer, Refused
from drivers.spectroradiometer.cr300 import Cr300
from mocks.cr300 import ColorimetryResearch
from mocks.lamp import Lamp
from mocks.wire import Pty


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    peer = scripted("cr300-driver.txt")
    with Cr300(peer.address) as radiometer:
        measured = radiometer.measure()
        assert radiometer.identity().serial_number == "A00427"
    assert measured.radiance_w_sr_m2_nm.wavelength_nm == (500.0, 501.0, 502.0)
    assert measured.radiance_w_sr_m2_nm.value == (1e-3, 2e-3, 3e-3)
    assert measured.integration_time_s == 0.0125
    assert peer.strange == []
    assert peer.requests.count(b"E\n") == 1


@pytest.mark.parametrize(("model", "step_nm"), [("CR-300", 2.0), ("CR-300", 1.0), ("CR-250", 4.0)])
@pytest.mark.parametrize("echo", [False, True])
def test_round_trip_with_the_mock(served: Callable[..., str], model: str, step_nm: float, echo: bool) -> None:
    lamp = Lamp(20.0)
    mock = ColorimetryResearch(lamp, model, step_nm=step_nm)
    mock.receive(b"E\n" * echo)
    with Cr300(served(mock, Pty())) as radiometer:
        assert radiometer.identity().model == model
        measured = radiometer.measure()
    wavelength_nm = np.arange(380.0, 780.1, step_nm)
    assert measured.radiance_w_sr_m2_nm.wavelength_nm == tuple(wavelength_nm)
    # Four digits go over the wire.
    np.testing.assert_allclose(measured.radiance_w_sr_m2_nm.value, lamp.radiance().at(wavelength_nm), rtol=5e-4)
    assert measured.integration_time_s is not None


# Connecting takes 3 answers (RC ID, RC Model, RC Firmware); then M (4), RM Spectrum (5).
@pytest.mark.parametrize(
    ("fault", "error"),
    [("never@4", NoAnswer), ("half@5", NoAnswer), ("drop@5", NoAnswer), ("wrong@4", Garbled), ("error@4", Refused)],
)
def test_a_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], fault: str, error: type[Exception]
) -> None:
    radiometer = Cr300(served(ColorimetryResearch(Lamp()), Pty(), fault), timeout_s=0.5, measure_timeout_s=0.5)
    radiometer.connect()
    with pytest.raises(error) as caught:
        radiometer.measure()
    assert "\n" not in str(caught.value)
    assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 201
    radiometer.close()
