"""Quantities in words: a number with its uncertainty and its unit, as every statement, page and table writes it."""

from __future__ import annotations

import math

#: Units whose printed form differs from their form in names.
SHOWN_UNITS = {"um": "µm", "us": "µs", "deg": "°", "C": "°C", "percent": "%", "1": ""}
#: From this size on, numbers are written with a power of ten, and from this one on with commas.
POWER_FROM, COMMAS_FROM = 1e6, 1e4
MOST_DECIMALS = 9
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def shown_unit(unit: str) -> str:
    """Return a unit as it is printed; empty for a ratio."""
    return SHOWN_UNITS.get(unit, unit)


def plain_number(value: float, digits: int) -> str:
    """Return a number with `digits` significant digits at most, and without a power of ten where it is from 1e-9 to
    1e6."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    size = float(f"{abs(value):.{digits - 1}e}")
    decimals = digits - 1 - math.floor(math.log10(size))
    if size >= POWER_FROM or decimals > MOST_DECIMALS + digits:
        power = math.floor(math.log10(size))
        return f"{float(f'{value / 10.0**power:.{digits - 1}f}'):g}{_ten_to(power)}"
    text = f"{_to_place(value, decimals):{',' if size >= COMMAS_FROM else ''}.{max(decimals, 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def measured(
    value: float, std: float | None = None, unit: str = "", interval: tuple[float, float] | None = None
) -> str:
    """Return `value ± std unit`, the standard deviation to two digits and the value to the same place.

    Without a standard deviation the value has four digits. With an `interval` it reads `value (low to high) unit`.
    """
    if interval is not None:
        low, high = (plain_number(end, 3) for end in interval)
        return f"{plain_number(value, 3)} ({low} to {high}) {shown_unit(unit)}".rstrip()
    if std is None or not math.isfinite(std) or std <= 0 or not math.isfinite(value):
        number = plain_number(value, 4)
    else:
        place = 1 - math.floor(math.log10(float(f"{std:.1e}")))
        if abs(value) < POWER_FROM and place <= MOST_DECIMALS:
            decimals, commas = max(place, 0), "," if abs(value) >= COMMAS_FROM else ""
            number = f"{_to_place(value, place):{commas}.{decimals}f} ± {_to_place(std, place):{commas}.{decimals}f}"
        else:
            power = math.floor(math.log10(max(abs(value), std)))
            decimals = max(place + power, 0)
            number = f"({value / 10.0**power:.{decimals}f} ± {std / 10.0**power:.{decimals}f}){_ten_to(power)}"
    return f"{number} {shown_unit(unit)}".rstrip()


def _to_place(value: float, place: int) -> float:
    """Round to a decimal place; a negative one is left of the point."""
    return round(value, place) + 0.0


def _ten_to(power: int) -> str:
    return f" × 10{str(power).translate(_SUPERSCRIPTS)}"
