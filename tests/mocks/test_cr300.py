"""The mock CR-300 and CR-250."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mocks.cr300 import TOO_HIGH, TOO_LOW, ColorimetryResearch
from mocks.lamp import Lamp
from mocks.wire import Grammar

Talk = Callable[[Grammar, bytes], bytes]


@pytest.mark.parametrize(("model", "step_nm"), [("CR-300", 2.0), ("CR-250", 4.0)])
def test_a_spectrum_is_announced_and_follows_one_value_a_line(talk: Talk, model: str, step_nm: float) -> None:
    lamp = Lamp()
    mock = ColorimetryResearch(lamp, model)
    assert talk(mock, b"M\n") == b"OK:0:M:No errors\r\n"
    head, *values = talk(mock, b"RM Spectrum\n").decode().splitlines()
    kind, code, command, told = head.split(":")
    first_nm, last_nm, step, count = (float(v) for v in told.split(","))
    assert (kind, code, command) == ("OK", "0", "RM Spectrum")
    assert (first_nm, last_nm, step, count) == (380.0, 780.0, step_nm, len(values))
    wavelength_nm = np.arange(first_nm, last_nm + 0.1, step)
    np.testing.assert_allclose([float(v) for v in values], lamp.radiance().at(wavelength_nm), rtol=5e-4)


@pytest.mark.parametrize(("luminance_cd_m2", "code"), [(1e6, TOO_HIGH), (1e-5, TOO_LOW)])
def test_light_out_of_range_is_an_error(talk: Talk, luminance_cd_m2: float, code: int) -> None:
    assert talk(ColorimetryResearch(Lamp(luminance_cd_m2)), b"M\n").startswith(f"ER:{code}:".encode())


def test_nothing_is_told_before_a_measurement(talk: Talk) -> None:
    assert talk(ColorimetryResearch(Lamp()), b"RM XYZ\n").startswith(b"ER:")


def test_echo_can_be_switched(talk: Talk) -> None:
    mock = ColorimetryResearch(Lamp())
    assert talk(mock, b"E\nRC ID\n") == b"RC ID\nOK:0:RC ID:A00427\r\n"
    assert talk(mock, b"E\nRC ID\n") == b"E\nOK:0:RC ID:A00427\r\n"


def test_settings_keep_to_their_limits(talk: Talk) -> None:
    mock = ColorimetryResearch(Lamp())
    assert talk(mock, b"SM Speed 4\n").startswith(b"ER:-519:")
    assert talk(mock, b"SM ExposureX 5\nRS ExposureX\n").endswith(b"OK:0:RS ExposureX:5\r\n")
