"""Logarithmic axes are labelled in whole numbers and hold what is drawn."""

import math

import pytest

from lab.report.charts import log_axis


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([3.0, 70.0], ["5", "10", "20", "50"]),
        ([0.002, 30.0], ["0.01", "0.1", "1", "10"]),
        ([2.0, 3e7], ["10", "100", "1000", "10000", "100000", "10<sup>6</sup>", "10<sup>7</sup>"]),
        ([0.0, -1.0, 4.0, 6.0], ["5"]),  # values without a logarithm have no place
    ],
)
def test_ticks_are_whole_numbers(values: list[float], text: list[str]) -> None:
    drawn = log_axis("signal, e", values)
    assert [one for one in drawn["ticktext"] if one in text] == text
    assert len(drawn["tickvals"]) == len(drawn["ticktext"])
    low, high = drawn["range"]
    assert all(low < math.log10(value) < high for value in values if value > 0.0)
    assert all(low <= math.log10(tick) <= high for tick in drawn["tickvals"])
