"""The mock PR-655 and PR-670: remote mode, spectra, error codes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mocks.lamp import Lamp
from mocks.pr655 import OVERLOAD, WEAK_LIGHT, PhotoResearch
from mocks.wire import Grammar

Talk = Callable[[Grammar, bytes], bytes]


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
