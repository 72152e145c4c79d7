"""The mock radiometer: what it measures, when it refuses, and the conversations of other people's hosts."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from mocks.lamp import Lamp, tristimulus
from mocks.specbos1211 import MockSpecbos1211
from mocks.wire import Grammar
from sim.spectrum import Spectrum

Talk = Callable[[Grammar, bytes], bytes]


def test_the_spectrum_is_the_lamps(talk: Talk) -> None:
    lamp = Lamp(luminance_cd_m2=50.0)
    mock = MockSpecbos1211(lamp)
    assert talk(mock, b"*conf:wran 380 780 1\r*init\r") == b"\x06\x06\x07"
    lines = talk(mock, b"*fetch:sprad\r").split(b"\r")
    values = [float(line) for line in lines[2:-2]]
    # Six decimals of a mantissa: 5e-7 relative.
    np.testing.assert_allclose(values, lamp.radiance().at(np.arange(380, 781)), rtol=5e-7)
    assert lines[-2:] == [b"", b""]


def test_tristimulus_values_are_those_of_illuminant_a(talk: Talk) -> None:
    mock = MockSpecbos1211(Lamp(luminance_cd_m2=100.0))
    talk(mock, b"*init\r")
    # Over 380..780 nm, the range after power-on, A keeps all but 1e-4 of its tristimulus values.
    found = re.fullmatch(rb"X: (\S+)\rY: (\S+)\rZ: (\S+)\r", talk(mock, b"*fetch:XYZ\r"))
    assert found
    x, y, z = (float(value) for value in found.groups())
    assert y == pytest.approx(100.0, rel=1e-4)
    assert (x, z) == (pytest.approx(109.85, rel=2e-4), pytest.approx(35.585, rel=2e-4))  # CIE 15, illuminant A
    assert talk(mock, b"*fetch:chromxy\r") == b"Chrom_x: 0.4476 Chrom_y: 0.4074\r"


def test_wavelength_and_value_pairs_come_in_blocks_ended_by_an_empty_line(talk: Talk) -> None:
    mock = MockSpecbos1211(Lamp())
    talk(mock, b"*CONF:WRAN 380 780 4\r*INIT\r")
    header, pairs, rest = talk(mock, b"*FETCH:SPRAD 7\r").split(b"\r\r")
    assert header
    assert rest == b""
    table = np.array([[float(v) for v in line.split()] for line in pairs.split(b"\r")])
    np.testing.assert_array_equal(table[:, 0], np.arange(380, 781, 4))


class Adjustable(Lamp):
    """A lamp of one radiance at all wavelengths."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = value

    def radiance(self) -> Spectrum:
        return Spectrum.of([300.0, 1100.0], [self.value, self.value])


def test_too_much_light_and_too_little_are_told_apart(talk: Talk) -> None:
    light = Adjustable(10.0)
    mock = MockSpecbos1211(light)
    assert talk(mock, b"*init\r*stat:err?\r") == b"\x06\x15Error Code: 120\r"
    light.value = 1e-3
    assert talk(mock, b"*init\r") == b"\x06\x07"
    # The detector is 80 % full: 6e-4 x 0.8 / 1e-3 s.
    assert talk(mock, b"*fetch:tint\r") == b"tint[ms]: 480.000\r"
    light.value = 1e-3 / 0.79
    assert talk(mock, b"*para:expo 0\r*init\r*stat:err?\r") == b"\x06\x06\x15Error Code: 120\r"
    light.value = 1e-8
    assert talk(mock, b"*init\r*stat:err?\r") == b"\x06\x15Error Code: 121\r"
    assert talk(mock, b"*para:expo 1\r*init\r") == b"\x06\x06\x07"


def test_a_dark_measurement_takes_as_long_as_it_may(talk: Talk) -> None:
    light = Adjustable(0.0)
    mock = MockSpecbos1211(light)
    talk(mock, b"*conf:maxtin 3000\r")
    mock.receive(b"*init\r")
    assert mock.wait_s == pytest.approx(2 * 3.0 + 0.5)
    assert mock.wait_s < 5 * 3.0 + 10  # what hosts wait for


def test_escape_breaks_a_measurement_off(talk: Talk) -> None:
    mock = MockSpecbos1211(Lamp())
    assert b"".join(mock.receive(b"*init\r")) == b"\x06"
    assert b"".join(mock.receive(b"*idn?\r")) == b""
    assert b"".join(mock.receive(b"\x1b")) == b"\x15JETI_SB1211\r"
    assert talk(mock, b"*stat:err?\r") == b"Error Code: 147\r"


def test_a_hosts_session_with_probe_setup_and_terminal_counts(talk: Talk) -> None:
    """The order of commands, and the number of CR, ACK and NAK waited for, of a widely used colour-management host."""
    mock = MockSpecbos1211(Lamp())

    def terminated(command: bytes, count: int) -> bytes:
        said = talk(mock, command + b"\r")
        assert sum(said.count(end) for end in (b"\r", b"\x06", b"\x15")) == count, said[:80]
        return said

    talk(mock, b";D024\r\n")
    assert re.fullmatch(rb"JETI_SB(\d+)\r", terminated(b"*idn?", 1))
    assert re.match(rb"spectrometer number: \d+ ?", terminated(b"*para:spnum?", 1))
    for setting in (b"*conf:default", b"*para:calibn 0", b"*para:expo 1", b"*conf:maxtin 3000", b"*conf:func 6"):
        assert terminated(setting, 1) == b"\x06"
    assert terminated(b"*conf:form 4", 1) == b"\x06"
    assert terminated(b"*conf:wran 350 830 1", 1) == b"\x06"
    assert terminated(b"*conf:aver 1", 1) == b"\x06"
    assert terminated(b"*vers?", 1)
    assert terminated(b"*contr:mhead?", 1) == b"mhead: 0\r"
    assert terminated(b"*contr:laser 0", 1) == b"\x06"
    assert re.match(rb"cyctim\[ms\]: \d", terminated(b"*contr:cyctim 200 4000", 1))
    assert terminated(b"*conf:cycmod 0", 1) == b"\x06"
    assert terminated(b"*conf:cyctim 16666.667", 1) == b"\x06"
    assert terminated(b"*init", 1).endswith(b"\x07")
    assert re.match(rb"X: \S+\rY: \S+\rZ: \S+\r", terminated(b"*fetch:XYZ", 3))
    lines = terminated(b"*fetch:sprad", 2 + 481 + 1).split(b"\r")
    assert len([float(line) for line in lines[2 : 2 + 481]]) == 481
    assert re.match(rb"Luminance\[cd/m\^2\]: \S+ ?", terminated(b"*fetch:PHOTOmetric", 1))


def test_luminance_and_spectrum_agree(talk: Talk) -> None:
    lamp = Lamp(luminance_cd_m2=7.0)
    assert tristimulus(lamp.radiance())[1] == pytest.approx(7.0, rel=1e-9)
