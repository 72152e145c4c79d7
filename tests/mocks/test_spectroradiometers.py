"""Spectroradiometers of the bench, byte by byte."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from mocks.cr300 import TOO_HIGH, TOO_LOW, ColorimetryResearch
from mocks.lamp import Lamp, tristimulus
from mocks.pr655 import OVERLOAD, WEAK_LIGHT, PhotoResearch
from mocks.specbos1211 import MockSpecbos1211
from mocks.wire import Grammar
from sim.spectrum import Spectrum

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


# --- The mock PR-655 and PR-670: remote mode, spectra, error codes ----------------------------------------------------


@pytest.mark.parametrize("start", [b"PHOTO", b"PHOTO\r", b"PHOTO\n", b"PHOTO\r\n", b"D110\rPHPHOTO"])
@pytest.mark.parametrize("paced", [True, False])
def test_remote_mode_begins_with_five_characters(talk: Talk, start: bytes, paced: bool) -> None:
    mock = PhotoResearch(Lamp())
    said = b"".join(talk(mock, bytes((b,))) for b in start) if paced else talk(mock, start)
    assert said == b" REMOTE MODE\r\n"
    assert talk(mock, b"D110\n") == b"00000,65501234\r\n"


@pytest.mark.parametrize(("model", "step_nm", "points"), [("PR-655", 4, 101), ("PR-670", 2, 201)])
def test_spectrum_lines_follow_two_header_lines(talk: Talk, model: str, step_nm: int, points: int) -> None:
    lamp = Lamp()
    mock = PhotoResearch(lamp, model)
    talk(mock, b"PHOTO\r")
    assert talk(mock, b"M0\r") == b"00000\r\n"
    lines = talk(mock, b"D5\r").decode().split("\r\n")
    assert lines.pop() == ""
    table = np.array([[float(v) for v in line.split(",")] for line in lines[2:]])
    np.testing.assert_array_equal(table[:, 0], np.linspace(380, 780, points))
    assert table[1, 0] - table[0, 0] == step_nm
    np.testing.assert_allclose(table[:, 1], lamp.radiance().at(table[:, 0]), rtol=5e-4)  # four digits
    assert talk(mock, b"M5\r").decode().split("\r\n") == [*lines, ""]


@pytest.mark.parametrize(("luminance_cd_m2", "code"), [(1e6, OVERLOAD), (1e-5, WEAK_LIGHT)])
def test_light_out_of_range_is_told_by_its_code(talk: Talk, luminance_cd_m2: float, code: int) -> None:
    mock = PhotoResearch(Lamp(luminance_cd_m2))
    talk(mock, b"PHOTO\r")
    assert int(talk(mock, b"M5\r")) == code
    assert int(talk(mock, b"D1\r")) == code


def test_a_dark_source_takes_minutes() -> None:
    mock = PhotoResearch(Lamp(0.01))
    mock.receive(b"PHOTO\rM5\r")
    assert mock.wait_s is not None
    assert 60 <= mock.wait_s <= 300


def test_colorimetric_answers_of_illuminant_a(talk: Talk) -> None:
    mock = PhotoResearch(Lamp(100.0))
    talk(mock, b"PHOTO\rM0\r")
    status, units, luminance, u, v = talk(mock, b"D3\r").decode().split(",")
    assert (status, units, float(luminance)) == ("00000", "0", 100.0)
    assert (float(u), float(v)) == (0.2560, 0.5243)  # CIE 15, illuminant A
    # McCamy's cubic is good to 2 K here.
    assert float(talk(mock, b"D4\r").split(b",")[3]) == pytest.approx(2856, abs=2)


# --- The mock radiometer: what it measures, when it refuses, and the conversations of other people's hosts ------------


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
