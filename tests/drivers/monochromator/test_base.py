"""Order-sorting filters and wavelengths."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import InstrumentError
from drivers.monochromator.base import (
    ORDER_SORTING_FILTERS,
    OrderSortingFilter,
    check_wavelength_nm,
    filter_place,
    order_sorting_filters,
)
from drivers.monochromator.cornerstone260 import Cornerstone260
from drivers.monochromator.cornerstone260b import Cornerstone260B
from mocks.light_path import FILTER_CUT_ON_NM


@given(st.floats(400.0, 1100.0, exclude_max=True))
def test_default_filters_pass_the_wavelength_and_block_its_half(wavelength_nm: float) -> None:
    """By the bench's wheel, whose long-pass edges are 6 nm wide."""
    cut_on_nm = FILTER_CUT_ON_NM[filter_place(ORDER_SORTING_FILTERS, wavelength_nm)]
    assert cut_on_nm is not None
    assert wavelength_nm / 2 + 12 < cut_on_nm < wavelength_nm - 12


def test_zero_order_is_white() -> None:
    assert FILTER_CUT_ON_NM[filter_place(ORDER_SORTING_FILTERS, 0.0)] is None


def test_the_table_of_a_station_file_is_used() -> None:
    table = order_sorting_filters(
        [{"place": 3, "from_nm": 500, "to_nm": 900}, {"place": 5, "from_nm": 0, "to_nm": 500}]
    )
    assert table == (OrderSortingFilter(5, 0.0, 500.0), OrderSortingFilter(3, 500.0, 900.0))
    assert [filter_place(table, w) for w in (0, 499.999, 500, 899)] == [5, 5, 3, 3]
    with pytest.raises(
        InstrumentError, match=r"no order-sorting filter for 900 nm, the table serves 0\.\.500, 500\.\.900"
    ):
        filter_place(table, 900)


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ([{"place": 1}], "give place, from_nm and to_nm"),
        ([{"place": 1, "from_nm": 500, "to_nm": 500}], "isn't empty"),
        ([{"place": 1, "from_nm": 0, "to_nm": 500}, {"place": 2, "from_nm": 499, "to_nm": 600}], "don't overlap"),
        (["open"], "give place"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused(table: list[object], complaint: str) -> None:
    with pytest.raises(InstrumentError, match=complaint) as caught:
        order_sorting_filters(table)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("wavelength_nm", [-1.0, 1400.1, math.nan, math.inf])
def test_wavelengths_out_of_range_are_refused(wavelength_nm: float) -> None:
    with pytest.raises(InstrumentError, match=r"outside 0\.\.1400 nm"):
        check_wavelength_nm(wavelength_nm, 1400.0)


@pytest.mark.parametrize("made", [Cornerstone260, Cornerstone260B])
def test_a_wavelength_is_checked_without_the_instrument(made: type[Cornerstone260 | Cornerstone260B]) -> None:
    driver = made("nowhere")
    driver.check_nm(500.0)
    for wrong_nm, message in (
        (5000.0, r"5000\.0 nm is outside 0\.\.1400 nm"),
        (1400.0, "no order-sorting filter for 1400 nm"),
    ):
        with pytest.raises(InstrumentError, match=message):
            driver.check_nm(wrong_nm)


@pytest.mark.parametrize("made", [Cornerstone260, Cornerstone260B])
def test_a_slit_is_checked_without_the_instrument(made: type[Cornerstone260 | Cornerstone260B]) -> None:
    driver = made("nowhere")
    driver.check_slit_um(3000.0)
    for wrong_um in (3.9, 3001.0, math.nan):
        for refuses in (driver.check_slit_um, driver.set_slit_um):
            with pytest.raises(InstrumentError, match=r"a slit of .* um is outside 4\.\.3000 um"):
                refuses(wrong_um)
