"""Numbers with units in the answers of instruments."""

from __future__ import annotations

import math

import pytest

from drivers.quantity import read_number, read_quantity


@pytest.mark.parametrize(
    ("text", "current_a"),
    [
        ("+1.040564E-06A,+2.3E+02,+0", 1.040564e-6),
        ("+1.0E-06A,+2.3E+02,+2", 1.0e-6),
        ("+1.040564E-06NADC", 1.040564e-6),
        ("-2.5E-9LADC,+0.0secs,+00001RDNG#", -2.5e-9),
        ("12.5uA", 12.5e-6),
        ("12.5 \N{MICRO SIGN}A", 12.5e-6),
        ("12.5\N{GREEK SMALL LETTER MU}A", 12.5e-6),
        ("1.25 mA", 1.25e-3),
        ("1.25 MA", 1.25e-3),  # IEEE 488.2: milli, in either case
        ("830 pA", 830e-12),
        ("830nADC", 830e-9),
        ("4 fA", 4e-15),
        (".5E-06", 0.5e-6),
        ("5.", 5.0),
        ("-3E-07;+1", -3e-7),
        ("7E-9 amps", 7e-9),
    ],
)
def test_a_current_is_read_in_amperes(text: str, current_a: float) -> None:
    assert read_quantity(text, "A") == current_a


@pytest.mark.parametrize(
    "text", ["9.9E37,+1,+0", "-9.9E+37", "INF", "-INF", "+OVLD", "OL", "+1.0E-3OADC", "-9.910000E+37"]
)
def test_marks_of_overload_are_infinite(text: str) -> None:
    assert math.isinf(read_quantity(text, "A"))


def test_a_reading_that_isnt_one_is_nan() -> None:
    assert math.isnan(read_quantity("NAN", "A"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("+1.2E-03NVDC", "its unit is 'VDC', not A"),
        ("1.25E-06 W", "its unit is 'W', not A"),
        ("1.25 mV", "its unit is 'mV', not A"),
        ("12.5 ohm", "its unit is 'ohm', not A"),
        ("1.25E-06 dBm", "its unit is 'dBm', not A"),
        ("1,25E-06", "it may have a decimal comma"),
        ("-1,25 mA", "it may have a decimal comma"),
        ("+0.000000E-12ZADC", "zero check is on"),
        ("+1.0E-6RADC", "it is relative to a reference"),
        ("", "it isn't a number"),
        ("1.2.3", "it isn't a number"),
        ("KEITHLEY", "it isn't a number"),
    ],
)
def test_other_answers_are_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        read_quantity(text, "A")


def test_times_have_their_units() -> None:
    assert [read_quantity(text, "s") for text in ("12.5 msec", "340 us", "2 s", "2.5 sec")] == [
        0.0125,
        340e-6,
        2.0,
        2.5,
    ]
    with pytest.raises(ValueError, match="its unit is 'min', not s"):
        read_quantity("2 min", "s")


def test_a_number_is_decimal_and_finite() -> None:
    assert [read_number(text) for text in ("+1.5E-3", " 400.000 ", ".5")] == [0.0015, 400.0, 0.5]
    for text in ("nan", "inf", "1e999", "1_000", "1,5", "0x10", "1.5 nm", ""):
        with pytest.raises(ValueError, match="isn't a finite number"):
            read_number(text)
