"""Spectra as CSV: the header `wavelength_nm,value`, then one row a sample, ascending in wavelength."""

from __future__ import annotations

import csv
import io
import math

from lab.errors import InputError, one_line
from sim.spectrum import Spectrum


def parse_spectrum(text: str) -> Spectrum:
    r"""Return a spectrum from CSV text with the header `wavelength_nm,value`.

    Blank lines and a byte-order mark are ignored. Wavelengths must ascend strictly, and all numbers must be finite.
    Raises InputError without the path, which the caller knows.

    >>> parse_spectrum("wavelength_nm,value\n400,0.5\n500,1.0\n").value
    (0.5, 1.0)
    """
    return parse_curve(text, ("value",))[1]


def parse_curve(text: str, columns: tuple[str, ...]) -> tuple[str, Spectrum]:
    r"""Return (name of the second column, curve), as `parse_spectrum` does.

    text : CSV
    columns : names that the second column may have

    >>> parse_curve("wavelength_nm,radiance\n400,0.5\n500,1.0\n", ("value", "radiance"))[0]
    'radiance'
    """
    try:
        lines = csv.reader(io.StringIO(text.removeprefix("\ufeff"), newline=None))
        rows = [row for row in lines if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"isn't CSV ({one_line(error)}); write rows of two numbers") from None
    names = [cell.strip() for cell in rows[0]] if rows else []
    if len(names) != 2 or names[0] != "wavelength_nm" or names[1] not in columns:
        head = _quoted(rows[0]) if rows else ""
        wanted = " or ".join(f"'wavelength_nm,{column}'" for column in columns)
        raise InputError(f"its first line is '{head}', not {wanted}; write that header")
    if len(rows) == 1:
        raise InputError("has no samples; write one row a sample")
    wavelength_nm: list[float] = []
    value: list[float] = []
    for number, row in enumerate(rows[1:], start=2):
        try:
            at, height = (float(cell) for cell in row)
        except ValueError:
            raise InputError(f"row {number} is '{_quoted(row)}', not two numbers; write wavelength and value") from None
        if not (math.isfinite(at) and math.isfinite(height)):
            raise InputError(f"row {number} isn't finite ({at}, {height}); leave unknown samples out")
        if wavelength_nm and at <= wavelength_nm[-1]:
            raise InputError(f"row {number}: {at:g} nm follows {wavelength_nm[-1]:g} nm; sort the rows, each nm once")
        wavelength_nm.append(at)
        value.append(height)
    return names[1], Spectrum(wavelength_nm=tuple(wavelength_nm), value=tuple(value))


def _quoted(row: list[str]) -> str:
    """Return the start of a row of cells, which may hold line breaks, on one line."""
    return " ".join(",".join(row).split())[:60]


def format_spectrum(spectrum: Spectrum) -> str:
    """Return a spectrum as CSV text; reading it gives the same numbers bit for bit.

    >>> format_spectrum(Spectrum(wavelength_nm=(400.0, 500.0), value=(0.5, 1.0))).splitlines()
    ['wavelength_nm,value', '400.0,0.5', '500.0,1.0']
    """
    rows = (f"{at!r},{height!r}\n" for at, height in zip(spectrum.wavelength_nm, spectrum.value, strict=True))
    return "wavelength_nm,value\n" + "".join(rows)
