"""Numbers with units in the answers of instruments: read in the unit that a driver asks for, or refused.

Sources: IEEE 488.2 (suffixes, in either case; M is milli but for hertz and ohms); SCPI-99 (9.9E37 stands for infinity,
9.91E37 for no reading); manuals of Keithley's electrometers (a letter of the reading's state before the unit: NADC).
"""

from __future__ import annotations

import math
import re

#: What SCPI meters report instead of a reading beyond their range, or of none (9.91E37).
OVERLOAD = 9.8e37

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_FIELD = re.compile(rf"\s*(?P<number>{_NUMBER})\s*(?P<suffix>[^\d\s,;.+-][^\s,;]*)?\s*(?:[,;].*)?", re.S)
#: Suffix with the reading's state before it: normal, zero check, overflow, underflow, relative, beyond a limit.
_STATE = re.compile(r"(?P<state>[NZOURL])(?P<unit>[AV]DC|OHM|COUL)")
#: A whole number, a comma, and digits without a sign: 1,25E-06.
_COMMA = re.compile(r"\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?\s*[^\d\s,;]*\s*")
_STATES = {"Z": "zero check is on", "R": "it is relative to a reference", "U": "the reading is below its range"}
_PREFIXES = {"f": 1e-15, "p": 1e-12, "n": 1e-9, "u": 1e-6, "\N{MICRO SIGN}": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3}
#: Words for a unit, in lower case, by its symbol.
_WORDS = {"A": ("a", "adc", "amp", "amps"), "s": ("s", "sec", "secs")}


def read_number(text: str) -> float:
    """Return a number in decimal notation. Raises ValueError for another text, NaN and infinities among them.

    >>> read_number("+1.5E-3")
    0.0015
    """
    if re.fullmatch(rf"\s*{_NUMBER}\s*", text) is None or not math.isfinite(number := float(text)):
        raise ValueError(f"{text!r} isn't a finite number")
    return number


def read_quantity(text: str, unit: str) -> float:
    """Return the first field of an answer in a unit, which it may state with a prefix or not at all.

    Infinite for a mark of overload, NaN for one of no reading. Raises ValueError, one clause, for another unit, a state
    in which the reading isn't the quantity, and what isn't a number.

    >>> read_quantity("12.5uA", "A")
    1.25e-05
    """
    first = text.partition(",")[0].strip().upper().lstrip("+-")
    if first in ("INF", "INFINITY", "NAN", "OVERFLOW", "OVLD", "OVERLOAD", "OL"):
        return math.nan if first == "NAN" else math.inf
    if _COMMA.fullmatch(text):
        raise ValueError("it may have a decimal comma; set the instrument to decimal points")
    match = _FIELD.fullmatch(text)
    if match is None:
        raise ValueError("it isn't a number")
    value, suffix = float(match["number"]), match["suffix"] or ""
    if "e" in match["number"].lower() and (state := _STATE.fullmatch(suffix)):  # without an exponent, N is nano
        suffix = state["unit"]
        if state["state"] == "O":
            return math.inf
        if state["state"] in _STATES:
            raise ValueError(_STATES[state["state"]])
    factor = _factor(suffix, unit)
    if abs(value) >= OVERLOAD:
        return math.inf
    return _scale(match["number"], factor)


def _factor(suffix: str, unit: str) -> float:
    """Return the value of a suffix in a unit, 1 where there is none."""
    if not suffix:
        return 1.0
    for word in _WORDS[unit]:
        prefix = suffix.lower().removesuffix(word)
        if suffix.lower().endswith(word) and prefix.replace("\N{GREEK SMALL LETTER MU}", "u") in _PREFIXES:
            return _PREFIXES[prefix.replace("\N{GREEK SMALL LETTER MU}", "u")]
    raise ValueError(f"its unit is {suffix!r}, not {unit}")


def _scale(number: str, factor: float) -> float:
    """Return a number times a power of ten, rounded once."""
    exponent = round(math.log10(factor))
    mantissa, _, exponent_of_number = number.lower().partition("e")
    return float(f"{mantissa}e{int(exponent_of_number or 0) + exponent}")
