"""Text that other programs wrote: its encoding, the separators of its tables, and the names of their columns.

Recording sets are UTF-8 with commas and decimal points. What a user brings may be Latin-1 or UTF-16, and a table of a
program that is set to another language has semicolons (or tabs) with decimal commas. It is read, and a remark says as
what; where two readings are possible, it is refused.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from lab.errors import InputError, one_line
from lab.formats.recording_set.frame_files import locate

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
    """Return the text of `file`: UTF-8, UTF-16 by its byte-order mark or its zeros, else Latin-1 (Windows-1252).

    Raises InputError, without the path, where the file can't be read or holds no text.
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
    found: dict[str, list[Path]] = {}
    for name in names:
        with suppress(InputError):
            for remark in read_foreign_csv(locate(folder, name)).remarks:
                found.setdefault(remark, []).append(folder / name)
    return [
        f"{of[0]}{f' and {len(of) - 1} more files' if len(of) > 1 else ''}: {remark}" for remark, of in found.items()
    ]


def read_foreign_csv(file: Path) -> ForeignText:
    """Return the table in `file` with commas between cells and decimal points, line for line. Raises InputError without
    the path.
    """
    found = read_foreign_text(file)
    text, remarks = plain_csv(found.text)
    return ForeignText(text, found.remarks + remarks)


def plain_csv(text: str) -> tuple[str, tuple[str, ...]]:
    """Return a table with semicolons or tabs as one with commas; decimal commas become points. What has commas in its
    first line stays as it is.

    Raises InputError where numbers of both kinds stand in it, or where a comma may separate decimals or thousands.
    """
    lines = text.splitlines()
    head = next((line for line in lines if line.strip()), "")
    separator = next((one for one in ";\t" if one in head), None)
    if separator is None or "," in head:
        return text, ()
    try:
        rows = list(csv.reader(lines, delimiter=separator))
    except csv.Error as error:
        raise InputError(f"isn't CSV ({one_line(error)}); write one row a line") from error
    words = [(number, word) for number, row in enumerate(rows, start=1) for cell in row for word in cell.split()]
    commas = [one for one in words if COMMA_NUMBER.fullmatch(one[1])]
    points = [one for one in words if POINT_NUMBER.fullmatch(one[1])]
    if commas and points:
        (row, number), (other_row, other) = commas[0], points[0]
        raise InputError(
            f"row {row} has {number} and row {other_row} has {other}; write all numbers with decimal points, or all "
            "with commas"
        )
    if commas and all(THOUSANDS.fullmatch(word) for _, word in commas):
        row, number = commas[0]
        raise InputError(
            f"row {row}: {number} may be {number.replace(',', '.')} or {number.replace(',', '')}; write it with a "
            "decimal point or without the comma"
        )
    made = io.StringIO()
    writer = csv.writer(made, lineterminator="\n")
    for row_cells in rows:
        writer.writerow([_with_points(cell) for cell in row_cells])
    name = "semicolons" if separator == ";" else "tabs"
    return made.getvalue(), (f"read with {name} between cells" + (" and decimal commas" if commas else ""),)


def _with_points(cell: str) -> str:
    """Return a cell with points in the place of its numbers' decimal commas."""
    return re.sub(r"\S+", lambda word: word[0].replace(",", ".") if COMMA_NUMBER.fullmatch(word[0]) else word[0], cell)


def nearest_name(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that `name` is probably meant to be: the same with another unit, its beginning, or a
    misspelling of it. None: there is none.
    """
    names = list(known)
    asked = re.sub(r"[^a-z0-9.]+", "_", name.lower()).strip("_")
    stem = asked.rpartition("_")[0]
    same = [one for one in names if one == asked] or [one for one in names if stem and one.rpartition("_")[0] == stem]
    if same:
        return same[0]
    if len(asked) >= 4 and (found := [one for one in names if one.startswith(asked)]):
        return min(found, key=len)
    return next(iter(difflib.get_close_matches(asked, names, 1, LIKENESS)), None)


def in_its_unit(name: str) -> str:
    """Return a name with the unit of its ending in words: `exposure_s, in seconds`."""
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
            found = float(text)
        except ValueError:
            found = math.nan
        if not (math.isfinite(found) and found >= least):
            raise InputError(
                f"{self.file}: row {self.number}: {name} = '{text}' isn't a number of {least:g} or more; correct it"
            )
        return found

    def known(self, name: str, least: float = 0.0) -> float | None:
        """Return the cell as a number; None where it is empty or has no column."""
        return self.value(name, least) if self.cells.get(name) else None


def table_rows(file: Path, needed: Sequence[str], known: Sequence[str]) -> list[TableRow]:
    """Return the rows of `file`, which has the columns `needed` and no others than `known`. Raises InputError with one
    line.
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
        told = [f"missing: {', '.join(missing)}"] if missing else []
        near = {name: nearest_name(name, known) for name in unknown}
        hints = [name + (f" (write {in_its_unit(one)})" if one else "") for name, one in near.items()]
        told += [f"unknown: {', '.join(hints)}"] if unknown else []
        raise InputError(f"{file}: columns {'; '.join(told)}; columns are {', '.join(known)}, in these units")
    if not rows:
        raise InputError(f"{file}: holds no levels; write one row a level and channel")
    for number, row in rows:
        if len(row) != len(header):
            raise InputError(f"{file}: row {number}: {len(row)} cells under {len(header)} columns; correct it")
    return [TableRow(file, number, dict(zip(header, row, strict=True))) for number, row in rows]
