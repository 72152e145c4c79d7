"""Rows of a CSV with named columns of numbers, as other programs write them."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lab.errors import InputError, one_line
from lab.formats.foreign_text import in_its_unit, nearest_name, read_foreign_csv


@dataclass(frozen=True)
class TableRow:
    """One row: its number in the file, and its cells by column."""

    file: Path
    number: int
    cells: dict[str, str]

    def value(self, name: str, least: float = 0.0) -> float:
        """The cell as a number of `least` or more. Raises InputError."""
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
        """The cell as a number; None where it is empty or has no column."""
        return self.value(name, least) if self.cells.get(name) else None


def table_rows(file: Path, needed: Sequence[str], known: Sequence[str]) -> list[TableRow]:
    """The rows of `file`, which has the columns `needed` and no others than `known`. Raises InputError with one line."""
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
        told += (
            [
                f"unknown: {', '.join(name + (f' (write {in_its_unit(one)})' if one else '') for name, one in near.items())}"
            ]
            if unknown
            else []
        )
        raise InputError(f"{file}: columns {'; '.join(told)}; columns are {', '.join(known)}, in these units")
    if not rows:
        raise InputError(f"{file}: holds no levels; write one row a level and channel")
    for number, row in rows:
        if len(row) != len(header):
            raise InputError(f"{file}: row {number}: {len(row)} cells under {len(header)} columns; correct it")
    return [TableRow(file, number, dict(zip(header, row, strict=True))) for number, row in rows]
