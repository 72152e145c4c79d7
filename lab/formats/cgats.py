"""Spectra in CGATS text, as ArgyllCMS and makers' programs exchange them: `.sp` (one or several spectra) and `.ti3`.

CGATS.17 has tables: a header of keywords, a list of fields, and rows of data each. Argyll's keywords
`SPECTRAL_START_NM`, `SPECTRAL_END_NM` and `SPECTRAL_BANDS` give evenly spaced wavelengths, `SPECTRAL_NORM` the value
that stands for 1, and `MEAS_TYPE` the quantity. Radiances are in mW sr^-1 m^-2 nm^-1 there, in W sr^-1 m^-2 nm^-1 here.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from lab.errors import InputError, one_line
from lab.formats.raw_file import replacing
from lab.formats.recording_set.files import locate
from sim.spectrum import Spectrum

#
# Recording sets are UTF-8 with commas and decimal points. What a user brings may be Latin-1 or UTF-16, and a table of
# a program that is set to another language has semicolons (or tabs) with decimal commas. It is read, and a remark says
# as what; where two readings are possible, it is refused.


#: A number with a decimal comma, one that may as well have a separator of thousands, and one with a decimal point.
COMMA_NUMBER = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
POINT_NUMBER = re.compile(r"[-+]?\d*\.\d+(?:[eE][-+]?\d+)?")
#: Endings of names and the units that they stand for.
UNITS = {
    "a_per_w": "amperes per watt",
    "w_per_sr_m2": "W sr^-1 m^-2",
    "w_m2": "W m^-2",
    "dn_per_e": "DN an electron",
    "e_per_s": "electrons a second",
    "dn2": "DN squared",
    "dn": "DN",
    "s": "seconds",
    "nm": "nanometres",
    "um": "micrometres",
    "mm": "millimetres",
    "px": "pixels",
    "deg": "degrees",
    "c": "degrees Celsius",
    "db": "decibels",
    "a": "amperes",
    "e": "electrons",
}
#: Least likeness of two names (difflib's ratio) for one to be a misspelling of the other.
LIKENESS = 0.7


@dataclass(frozen=True)
class ForeignText:
    """The text of a file, and in sentences what was found beside plain UTF-8 with commas."""

    text: str
    remarks: tuple[str, ...] = ()


def read_foreign_text(file: Path) -> ForeignText:
    r"""Return the text of a file: UTF-8, UTF-16 by its byte-order mark or its zeros, else Latin-1 (Windows-1252).

    Returns the text with remarks on what was converted. Raises InputError, without the path, where the file can't be
    read or holds no text.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "light.csv"
    ...     _ = file.write_bytes("wavelength_nm,value\r\n400,0.5\r\n".encode("utf-16"))
    ...     read_foreign_text(file).text.splitlines()
    ['wavelength_nm,value', '400,0.5']
    """
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"can't be read ({error.strerror or one_line(error)}); give a text file") from error
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encoding = "utf-16"
    elif b"\0" in data:
        encoding = "utf-16-le" if 0 in data[1::2] and 0 not in data[::2] else "utf-16-be"
        if encoding == "utf-16-be" and 0 in data[1::2]:
            raise InputError("holds zero bytes, so it isn't text; save it as text (CSV, UTF-8)")
    else:
        encoding = "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        if encoding != "utf-8-sig":
            raise InputError(f"is damaged UTF-16 ({one_line(error)}); save it as UTF-8") from error
        try:
            text = data.decode("cp1252")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
        return ForeignText(text, ("read as Latin-1, since it isn't UTF-8; check names with accents",))
    return ForeignText(text, ("read as UTF-16",) if encoding.startswith("utf-16") else ())


def remarks_on(folder: Path, names: Iterable[str]) -> list[str]:
    """Return what was found in tables in `folder` beside plain UTF-8 with commas, one line for all that have it in
    common. Those that can't be read have none.
    """
    files_of_remark: dict[str, list[Path]] = {}
    for name in names:
        with suppress(InputError):
            for remark in read_foreign_csv(locate(folder, name)).remarks:
                files_of_remark.setdefault(remark, []).append(folder / name)
    return [
        f"{of[0]}{f' and {len(of) - 1} more files' if len(of) > 1 else ''}: {remark}"
        for remark, of in files_of_remark.items()
    ]


def read_foreign_csv(file: Path) -> ForeignText:
    r"""Return the table in `file` with commas between cells and decimal points, line for line, and remarks.

    Raises InputError without the path.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "light.csv"
    ...     _ = file.write_text("wavelength_nm;value\n400;0,5\n")
    ...     read_foreign_csv(file).text
    'wavelength_nm,value\n400,0.5\n'
    """
    table = read_foreign_text(file)
    text, remarks = plain_csv(table.text)
    return ForeignText(text, table.remarks + remarks)


def plain_csv(text: str) -> tuple[str, tuple[str, ...]]:
    r"""Bring a table with semicolons or tabs to commas between cells and decimal points.

    text : the table; what has commas in its first line stays as it is

    Returns the table and remarks on what was changed. Raises InputError where numbers of both kinds stand in it, or
    where a comma may separate decimals or thousands.

    >>> plain_csv("wavelength_nm;value\n400;0,5\n")
    ('wavelength_nm,value\n400,0.5\n', ('read with semicolons between cells and decimal commas',))
    """
    lines = text.splitlines()
    head = next((line for line in lines if line.strip()), "")
    separator = next((character for character in ";\t" if character in head), None)
    if separator is None or "," in head:
        return text, ()
    try:
        rows = list(csv.reader(lines, delimiter=separator))
    except csv.Error as error:
        raise InputError(f"isn't CSV ({one_line(error)}); write one row a line") from error
    words = [(number, word) for number, row in enumerate(rows, start=1) for cell in row for word in cell.split()]
    commas = has_decimal_commas(words)
    made = io.StringIO()
    writer = csv.writer(made, lineterminator="\n")
    for row_cells in rows:
        writer.writerow([_with_points(cell) for cell in row_cells])
    name = "semicolons" if separator == ";" else "tabs"
    return made.getvalue(), (f"read with {name} between cells" + (" and decimal commas" if commas else ""),)


def has_decimal_commas(words: Sequence[tuple[int, str]]) -> bool:
    """Return whether the numbers of a table have decimal commas.

    words : (row, word) of each word of the table

    Raises InputError where numbers of both kinds stand in it, or where a comma may separate decimals or thousands.

    >>> has_decimal_commas([(2, "400"), (2, "0,5")])
    True
    """
    commas = [word for word in words if COMMA_NUMBER.fullmatch(word[1])]
    points = [word for word in words if POINT_NUMBER.fullmatch(word[1])]
    if commas and points:
        (row, comma_number), (other_row, point_number) = commas[0], points[0]
        raise InputError(
            f"row {row} has {comma_number} and row {other_row} has {point_number}; write all numbers with decimal "
            "points, or all with commas"
        )
    if commas and all(THOUSANDS.fullmatch(word) for _, word in commas):
        row, number = commas[0]
        raise InputError(
            f"row {row}: {number} may be {number.replace(',', '.')} or {number.replace(',', '')}; write it with a "
            "decimal point or without the comma"
        )
    return bool(commas)


def _with_points(cell: str) -> str:
    """Return a cell with points in the place of its numbers' decimal commas."""
    return re.sub(r"\S+", lambda word: word[0].replace(",", ".") if COMMA_NUMBER.fullmatch(word[0]) else word[0], cell)


def nearest_name(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that `name` is probably meant to be: the same with another unit, its beginning, or a
    misspelling of it; None where there is none.

    name : as somebody wrote it
    known : names that there are

    >>> nearest_name("exposure_ms", ["frame", "exposure_s"])
    'exposure_s'
    """
    names = list(known)
    asked = re.sub(r"[^a-z0-9.]+", "_", name.lower()).strip("_")
    stem = asked.rpartition("_")[0]
    same = [candidate for candidate in names if candidate == asked] or [
        candidate for candidate in names if stem and candidate.rpartition("_")[0] == stem
    ]
    if same:
        return same[0]
    if len(asked) >= 4 and (beginning := [candidate for candidate in names if candidate.startswith(asked)]):
        return min(beginning, key=len)
    return next(iter(difflib.get_close_matches(asked, names, 1, LIKENESS)), None)


def in_its_unit(name: str) -> str:
    """Return a name with the unit of its ending in words.

    >>> in_its_unit("exposure_s")
    'exposure_s, in seconds'
    """
    unit = next((words for ending, words in UNITS.items() if name.endswith(f"_{ending}")), None)
    return f"{name}, in {unit}" if unit else name


@dataclass(frozen=True)
class TableRow:
    """One row: its number in the file, and its cells by column."""

    file: Path
    number: int
    cells: dict[str, str]

    def value(self, name: str, least: float = 0.0) -> float:
        """Return the cell as a number of `least` or more. Raises InputError."""
        text = self.cells[name]
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not (math.isfinite(number) and number >= least):
            raise InputError(
                f"{self.file}: row {self.number}: {name} = '{text}' isn't a number of {least:g} or more; correct it"
            )
        return number

    def known(self, name: str, least: float = 0.0) -> float | None:
        """Return the cell as a number; None where it is empty or has no column."""
        return self.value(name, least) if self.cells.get(name) else None


def table_rows(file: Path, needed: Sequence[str], known: Sequence[str]) -> list[TableRow]:
    r"""Return the rows of a table.

    file : CSV in any of the forms that `plain_csv` knows
    needed, known : columns that it must have, and those that it may have

    Raises InputError with one line for an unknown or a missing column.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "levels.csv"
    ...     _ = file.write_text("exposure_s,mean_dn\n0.01,100\n")
    ...     table_rows(file, ["exposure_s"], ["exposure_s", "mean_dn"])[0].value("mean_dn")
    100.0
    """
    try:
        reader = csv.reader(read_foreign_csv(file).text.splitlines())
        header = [cell.strip() for cell in next(reader, [])]
        rows = [
            (reader.line_num, [cell.strip() for cell in row]) for row in reader if any(cell.strip() for cell in row)
        ]
    except (InputError, csv.Error) as error:
        raise InputError(f"{file}: can't be read ({one_line(error)}); give a CSV") from error
    unknown = [name for name in header if name not in known]
    missing = [name for name in needed if name not in header]
    if unknown or missing:
        problems = [f"missing: {', '.join(missing)}"] if missing else []
        near = {name: nearest_name(name, known) for name in unknown}
        hints = [name + (f" (write {in_its_unit(hint)})" if hint else "") for name, hint in near.items()]
        problems += [f"unknown: {', '.join(hints)}"] if unknown else []
        raise InputError(f"{file}: columns {'; '.join(problems)}; columns are {', '.join(known)}, in these units")
    if not rows:
        raise InputError(f"{file}: holds no levels; write one row a level and channel")
    for number, row in rows:
        if len(row) != len(header):
            raise InputError(f"{file}: row {number}: {len(row)} cells under {len(header)} columns; correct it")
    return [TableRow(file, number, dict(zip(header, row, strict=True))) for number, row in rows]


Quantity = Literal["radiance", "reflectance", "transmittance", "sensitivity"]

#: Quantity -> Argyll's MEAS_TYPE, the norm that is written, and the factor from a value here to one of that norm 1.
_WRITTEN: dict[Quantity, tuple[str, float, float]] = {
    "radiance": ("EMISSION", 1.0, 1e3),
    "reflectance": ("REFLECTIVE", 100.0, 1.0),
    "transmittance": ("TRANSMISSIVE", 100.0, 1.0),
    "sensitivity": ("SENSITIVITY", 1.0, 1.0),
}
#: Names of a field that holds a wavelength: Argyll's, and those of makers' programs. PCT: its values are percent.
_FIELD = re.compile(
    r"(?:SPEC(?:TRAL)?_(?:NM_?|DEC_?|(?P<percent>PCT_?))?|NM_?|R_?)(?P<last>\d{3,4}(?:\.\d+)?)"
    r"|(?P<first>\d{3,4}(?:\.\d+)?)_?NM",
    re.I,
)
#: Keywords that state the condition of a measurement (M0, M1, ...), by which the tables of a file differ.
_CONDITION = ("FILTER", "MEASUREMENT_SOURCE", "MEASUREMENT_CONDITION")
#: A reflectance or transmittance above this is in percent: fluorescent papers stay below 1.5.
MOST_SHARE = 2.0
#: Most bands that Argyll reads.
MOST_BANDS = 601
#: A step between wavelengths may differ from the mean by this share and count as even.
EVEN = 1e-6


@dataclass(frozen=True)
class CgatsSpectra:
    """Spectra by their names. `quantity` None: the file doesn't state it; the values are then the file's over its norm.

    Radiances are in W sr^-1 m^-2 nm^-1; reflectances, transmittances and sensitivities have no unit.
    """

    spectra: Mapping[str, Spectrum]
    quantity: Quantity | None
    remarks: tuple[str, ...] = ()


def get_quantity(name: str) -> Quantity:
    """Return the quantity of a name, as a type checker knows it. Raises InputError for another.

    >>> get_quantity("radiance")
    'radiance'
    """
    for known in _WRITTEN:
        if name == known:
            return known
    raise InputError(f"--quantity {name}: isn't known; give one of {', '.join(_WRITTEN)}")


def read_cgats(file: Path) -> CgatsSpectra:
    """Read the spectra of a CGATS file's tables.

    Raises InputError, one line that begins with the file, where it isn't CGATS or holds no spectra.
    """
    try:
        text = read_foreign_text(file)
        parsed = parse_cgats(text.text)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    return CgatsSpectra(parsed.spectra, parsed.quantity, (*text.remarks, *parsed.remarks))


def parse_cgats(text: str) -> CgatsSpectra:
    """Return the spectra in CGATS text.

    A spectrum has its SAMPLE_NAME where these differ, else its SAMPLE_ID, or both; of several tables, the table's
    condition or number before it where the names don't differ. Raises InputError without the path, which the caller
    knows.

    >>> text = '''CGATS.17
    ... SPECTRAL_BANDS "2"
    ... SPECTRAL_START_NM "400"
    ... SPECTRAL_END_NM "500"
    ... BEGIN_DATA_FORMAT
    ... SAMPLE_ID SPEC_400 SPEC_500
    ... END_DATA_FORMAT
    ... BEGIN_DATA
    ... white 0.25 0.5
    ... END_DATA
    ... '''
    >>> parse_cgats(text).spectra["white"].value
    (0.25, 0.5)
    """
    tables = _tables(text)
    remarks: list[str] = []
    read: list[tuple[str, CgatsSpectra]] = []
    for number, table in enumerate(tables, start=1):
        try:
            spectra_of_table = _spectra(table)
        except InputError as error:
            raise InputError(f"table {number}: {error}" if len(tables) > 1 else str(error)) from error
        if spectra_of_table is None:
            remarks.append(f"table {number} is left out: it has no spectral fields")
            continue
        remarks += spectra_of_table.remarks
        read.append((table.condition or f"table {number}", spectra_of_table))
    if not read:
        raise InputError("has no fields SPEC_nnn of two wavelengths or more; give a file with spectral data")
    quantities = {spectra_of_table.quantity for _, spectra_of_table in read}
    if len(quantities) > 1:
        stated = ", ".join(sorted(name or "not stated" for name in quantities))
        raise InputError(f"its {len(read)} tables are of several quantities ({stated}); give one file a quantity")
    names = [name for _, spectra_of_table in read for name in spectra_of_table.spectra]
    if len(set(names)) == len(names):
        spectra = {name: value for _, spectra_of_table in read for name, value in spectra_of_table.spectra.items()}
    else:
        titles = [title for title, _ in read]
        if len(set(titles)) < len(titles):
            titles = [f"table {number}" for number in range(1, len(read) + 1)]
        spectra = {
            f"{title} {name}": value
            for title, (_, spectra_of_table) in zip(titles, read, strict=True)
            for name, value in spectra_of_table.spectra.items()
        }
        remarks.append(f"{len(read)} tables with the same samples: named {', '.join(titles)}")
    return CgatsSpectra(spectra, quantities.pop(), tuple(dict.fromkeys(remarks)))


@dataclass(frozen=True)
class _Table:
    """One table of a file: keywords of its header, names of its fields, and its rows."""

    keywords: Mapping[str, str]
    fields: list[str]
    rows: list[list[str]]

    @property
    def condition(self) -> str:
        """The condition of its measurement (M0, M1, ...), or nothing."""
        stated = next((self.keywords[key] for key in _CONDITION if key in self.keywords), "")
        return stated.rpartition("=")[2].strip()


def _spectra(table: _Table) -> CgatsSpectra | None:
    """Return the spectra of one table, None where it has none."""
    keywords, fields, rows = table.keywords, table.fields, table.rows
    matches = {at: match for at, field in enumerate(fields) if (match := _FIELD.fullmatch(field))}
    if len(matches) < 2:
        return None
    columns = {at: float(match["last"] or match["first"]) for at, match in matches.items()}
    remarks: list[str] = []
    words = [(number, row[at]) for number, row in enumerate(rows, start=1) for at in columns]
    if has_decimal_commas(words):
        rows = [[_with_points(cell) if at in columns else cell for at, cell in enumerate(row)] for row in rows]
        remarks.append("read with decimal commas")
    wavelength_nm = _wavelengths(keywords, list(columns.values()))
    values = np.array(
        [
            [_number(row[at], f"row {number}, {fields[at]}") for at in columns]
            for number, row in enumerate(rows, start=1)
        ]
    )
    stated = keywords.get("MEAS_TYPE", "").upper()
    quantity = next((name for name, (said, _, _) in _WRITTEN.items() if said == stated), None)
    norm, more = _norm(keywords, quantity, all(match["percent"] for match in matches.values()), float(values.max()))
    values = values / norm / (_WRITTEN[quantity][2] if quantity else 1.0)
    names, others = _sample_names(fields, rows)
    return CgatsSpectra(
        {name: Spectrum.of(wavelength_nm, row) for name, row in zip(names, values.tolist(), strict=True)},
        quantity,
        (*remarks, *more, *others),
    )


def _norm(
    keywords: Mapping[str, str], quantity: Quantity | None, percent: bool, greatest: float
) -> tuple[float, tuple[str, ...]]:
    """Return the value that stands for 1, and remarks on where it comes from. `percent`: the fields' names say so."""
    if "SPECTRAL_NORM" in keywords:
        norm = _number(keywords["SPECTRAL_NORM"], "SPECTRAL_NORM")
        if not norm > 0:
            raise InputError(f"SPECTRAL_NORM is {norm:g}, not above the limit of 0; correct it")
    else:
        norm = 100.0 if percent else 1.0
    if quantity in ("reflectance", "transmittance") and greatest / norm > MOST_SHARE:
        if "SPECTRAL_NORM" in keywords:
            impossible = (
                f"a {quantity} of {greatest / norm:g} is above the limit of {MOST_SHARE:g}; check SPECTRAL_NORM"
            )
            return norm, (impossible,)
        if greatest > 100.0 * MOST_SHARE:
            raise InputError(f"a {quantity} of {greatest:g} is neither a share nor percent; state SPECTRAL_NORM")
        return 100.0, (f"SPECTRAL_NORM isn't stated: values up to {greatest:g} are taken as percent of {quantity}",)
    remarks = ["the fields SPECTRAL_PCT are percent: divided by 100"] if percent and norm == 100.0 else []
    if quantity is None:
        remarks.append("MEAS_TYPE isn't stated: values over the norm, their unit unknown")
        if greatest / norm > MOST_SHARE:
            remedy = 'add the lines MEAS_TYPE "REFLECTIVE" and SPECTRAL_NORM "100" to its header'
            remarks.append(f"values reach {greatest / norm:g}: if they are percent of a reflectance, {remedy}")
    return norm, tuple(remarks)


def _sample_names(fields: list[str], rows: list[list[str]]) -> tuple[list[str], tuple[str, ...]]:
    """Return a name for each row, and a remark where the numbers of the samples repeat."""

    def column(*known: str) -> list[str] | None:
        at = next((at for at, field in enumerate(fields) if field.upper() in known), None)
        return None if at is None else [row[at] for row in rows]

    def differ(names: list[str] | None) -> bool:
        return names is not None and len(set(names)) == len(names) and all(names)

    numbers, called = column("SAMPLE_ID", "SAMPLEID"), column("SAMPLE_NAME", "SAMPLENAME")
    if called is not None and differ(called):
        repeated = "SAMPLE_ID repeats: spectra are named by SAMPLE_NAME"
        return called, (repeated,) if numbers is not None and not differ(numbers) else ()
    if called is not None and numbers is not None and any(called):
        numbers = [f"{number} {name}".strip() for number, name in zip(numbers, called, strict=True)]
    numbers = numbers or called
    if numbers is None:
        return [str(number) for number in range(1, len(rows) + 1)], ()
    if not differ(numbers):
        twice = next(name for name in numbers if numbers.count(name) > 1 or not name)
        raise InputError(f"SAMPLE_ID {twice} stands twice; number the samples")
    return numbers, ()


def _tables(text: str) -> list[_Table]:
    """Return the tables of a file. One without a header or a list of fields has those of the table before."""
    tables: list[_Table] = []
    keywords: dict[str, str] = {}
    fields: list[str] = []
    data: list[str] = []
    part = "head"
    for number, line in enumerate(text.splitlines(), start=1):
        words = _words(line, number)
        if not words:
            continue
        first = words[0].upper()
        if first in ("BEGIN_DATA_FORMAT", "BEGIN_DATA"):
            part, words = first, words[1:]
        if part == "head" and len(words) > 1:
            keywords.setdefault(first, words[1])
        elif first == "END_DATA_FORMAT":
            part = "head"
        elif first == "END_DATA":
            tables.append(_table(keywords, fields, data, tables))
            part, keywords, fields, data = "head", {}, [], []
        elif part == "BEGIN_DATA_FORMAT":
            fields += words
        elif part == "BEGIN_DATA":
            data += words
    if not tables or fields or data:
        raise InputError("isn't a whole CGATS file: it has no END_DATA; give one, or copy it again")
    return tables


def _table(keywords: dict[str, str], fields: list[str], data: list[str], before: list[_Table]) -> _Table:
    fields = fields or (before[-1].fields if before else [])
    if not fields or not data or len(data) % len(fields):
        raise InputError(f"has {len(data)} values for {len(fields)} fields, not whole rows; copy it again")
    sets = keywords.get("NUMBER_OF_SETS", "")
    rows = [data[at : at + len(fields)] for at in range(0, len(data), len(fields))]
    if sets.isdigit() and int(sets) != len(rows):
        raise InputError(f"NUMBER_OF_SETS is {sets}, and {len(rows)} rows are there; copy it again, or correct it")
    return _Table(keywords or (before[-1].keywords if before else {}), fields, rows)


def _words(line: str, number: int) -> list[str]:
    lexer = shlex.shlex(line, posix=True)
    lexer.whitespace_split, lexer.commenters, lexer.quotes, lexer.escape = True, "#", '"', ""
    try:
        return list(lexer)
    except ValueError as error:
        raise InputError(f"line {number} isn't CGATS ({one_line(error)}); close its quotes") from error


def _wavelengths(keywords: Mapping[str, str], named_nm: list[float]) -> list[float]:
    """Return the wavelengths (nm) of the fields: those that Argyll's keywords give, else those in the fields' names."""
    keys = ("SPECTRAL_START_NM", "SPECTRAL_END_NM", "SPECTRAL_BANDS")
    if any(key not in keywords for key in keys):
        exact = named_nm
    else:
        start, end, bands = (_number(keywords[key], key) for key in keys)
        if bands != len(named_nm):
            raise InputError(f"SPECTRAL_BANDS is {bands:g}, and {len(named_nm)} fields SPEC_nnn are there; correct one")
        exact = np.linspace(start, end, len(named_nm)).tolist()
        for name, at in zip(named_nm, exact, strict=True):
            if abs(name - at) > 1.0:  # the names are rounded to whole nanometres
                raise InputError(f"the field of {name:g} nm is at {at:g} nm by SPECTRAL_START_NM; correct one")
    for lower_nm, upper_nm in pairwise(exact):
        if not lower_nm < upper_nm:
            raise InputError(f"{upper_nm:g} nm follows {lower_nm:g} nm; let the wavelengths ascend")
    return exact


def _number(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{what} is '{text[:40]}', not a number; correct it")
    return value


def write_cgats(file: Path, content: CgatsSpectra) -> tuple[str, ...]:
    """Write spectra as `.ti3` where the name ends so, else as `.sp`.

    file : to be written
    content : spectra by name, and their quantity

    All spectra get one grid of even steps, the finest of them, as the format has no other. Returns what was changed for
    the format. Raises InputError where that has more bands than Argyll reads, or the quantity isn't stated.

    >>> from tempfile import TemporaryDirectory
    >>> white = Spectrum(wavelength_nm=(400.0, 500.0, 600.0), value=(0.25, 0.5, 1.0))
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "white.sp"
    ...     _ = write_cgats(file, CgatsSpectra({"white": white}, "radiance"))
    ...     [spectrum.wavelength_nm for spectrum in read_cgats(file).spectra.values()]
    [(400.0, 500.0, 600.0)]
    """
    if content.quantity is None:
        raise InputError(f"{file}: the quantity isn't stated; give one of {', '.join(_WRITTEN)}")
    try:
        grid_nm, remarks = _grid(content.spectra)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    text = "\n".join(_lines(content.spectra, content.quantity, grid_nm, ti3=file.suffix.lower() == ".ti3")) + "\n"
    with replacing(file) as partial:
        partial.write_text(text, encoding="utf-8")
    return remarks


def _grid(spectra: Mapping[str, Spectrum]) -> tuple[list[float], tuple[str, ...]]:
    """Evenly spaced wavelengths (nm) for all spectra, and what was changed for that."""
    if not spectra:
        raise InputError("there is no spectrum to write; give one at least")
    grids = {spectrum.wavelength_nm for spectrum in spectra.values()}
    if len(min(grids, key=len)) < 2:
        raise InputError("a spectrum of one sample has no step; give two or more")
    step_nm = min(float(np.diff(grid).min()) for grid in grids)
    first, last = min(grid[0] for grid in grids), max(grid[-1] for grid in grids)
    steps = max(round((last - first) / step_nm), 1)
    if steps + 1 > MOST_BANDS:
        raise InputError(
            f"{first:g} to {last:g} nm by {step_nm:g} nm are {steps + 1} bands, over the limit of {MOST_BANDS}"
        )
    even = [first + k * (last - first) / steps for k in range(steps + 1)]
    same = len(grids) == 1 and len(even) == len(next(iter(grids)))
    if same and all(abs(a - b) <= EVEN * step_nm for a, b in zip(even, next(iter(grids)), strict=True)):
        return list(next(iter(grids))), ()
    return even, (f"resampled to {steps + 1} even steps of {(last - first) / steps:g} nm, 0 beyond a spectrum's ends",)


def _lines(spectra: Mapping[str, Spectrum], quantity: Quantity, grid_nm: list[float], ti3: bool) -> Iterator[str]:
    said, norm, factor = _WRITTEN[quantity]
    yield from ("CTI3   " if ti3 else "SPECT  ", "")
    yield from ('DESCRIPTOR "spectra of calibench"', 'ORIGINATOR "calibench"')
    if ti3:
        yield from ('KEYWORD "DEVICE_CLASS"', f'DEVICE_CLASS "{"DISPLAY" if quantity == "radiance" else "OUTPUT"}"')
        yield from ('KEYWORD "COLOR_REP"', 'COLOR_REP "XYZ"')
    yield from ('KEYWORD "MEAS_TYPE"', f'MEAS_TYPE "{said}"')
    for key, value in (
        ("SPECTRAL_BANDS", str(len(grid_nm))),
        ("SPECTRAL_START_NM", repr(grid_nm[0])),
        ("SPECTRAL_END_NM", repr(grid_nm[-1])),
        ("SPECTRAL_NORM", f"{norm:.6f}"),
    ):
        yield from (f'KEYWORD "{key}"', f'{key} "{value}"')
    fields = [f"SPEC_{int(nm + 0.5):03d}" for nm in grid_nm]
    named = ti3 or len(spectra) > 1
    yield from ("", *(f'KEYWORD "{field}"' for field in fields))
    yield f"NUMBER_OF_FIELDS {len(fields) + named}"
    yield from ("BEGIN_DATA_FORMAT", " ".join([*(["SAMPLE_ID"] if named else []), *fields]), "END_DATA_FORMAT", "")
    yield from (f"NUMBER_OF_SETS {len(spectra)}", "BEGIN_DATA")
    for name, spectrum in spectra.items():
        quoted = [f'"{" ".join(name.split())}"'.replace("\\", "/")] if named else []
        yield " ".join([*quoted, *(repr(float(value)) for value in np.asarray(spectrum.at(grid_nm)) * factor * norm)])
    yield "END_DATA"
