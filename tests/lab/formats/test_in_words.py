"""Quantities in words: digits by the uncertainty, no power of ten that a reader has to unfold."""

from __future__ import annotations

import pytest

from lab.formats.results.words import format_unit, format_value, plain_number


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (0.28034, 0.00041, "0.28034 ± 0.00041 DN"),
        (9120.4, 21.3, "9120 ± 21 DN"),
        (9120.4, 213.0, "9120 ± 210 DN"),
        (9124.4, 998.0, "9100 ± 1000 DN"),  # 998 has the digits of 1000
        (12345.6, 2.0, "12,345.6 ± 2.0 DN"),
        (-2.5, 0.5, "-2.50 ± 0.50 DN"),
        (-0.001, 0.5, "0.00 ± 0.50 DN"),  # no minus before a nought
        (1.5e7, 2.0e5, "(1.500 ± 0.020) × 10⁷ DN"),
        (3.2e-11, 4e-13, "(3.200 ± 0.040) × 10⁻¹¹ DN"),
        (0.123456, None, "0.1235 DN"),
        (14321.0, None, "14,320 DN"),
        (5.0, 0.0, "5 DN"),
        (5.0, float("nan"), "5 DN"),
        (float("nan"), 1.0, "nan DN"),
    ],
)
def test_values_are_rounded_to_their_uncertainty(value: float, std: float | None, text: str) -> None:
    assert format_value(value, std, "DN") == text


def test_an_interval_stands_in_place_of_a_standard_deviation() -> None:
    assert format_value(2.0, None, "um", (1.512, 14000.0)) == "2 (1.51 to 14,000) µm"


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.4e4, "14,000"), (9996.0, "10,000"), (131.62, "130"), (1.5e-7, "0.00000015"), (2.34e6, "2.3 × 10⁶"), (0.0, "0")],
)
def test_numbers_have_no_power_of_ten_where_a_reader_takes_the_digits(value: float, text: str) -> None:
    assert plain_number(value, 2) == text


def test_units_are_printed_as_a_reader_knows_them() -> None:
    assert [format_unit(unit) for unit in ("um", "1", "percent", "DN/e")] == ["µm", "", "%", "DN/e"]
