"""`index.csv`: one row a capture, the columns a capture's keys in the recording set, the members of `screen` as
`screen.pose`, ...

Lists are written with spaces (`region`: `92 156 292 356`; `corners`: eight numbers). An empty cell is an unknown value.
A row of kind `checkerboard` that has `squares` and `square_mm` is a printed board without markers, not a pattern on the
screen."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin

from lab.capture_kinds.base import CAPTURES, Capture, Open
from lab.errors import InputError, one_line
from lab.formats.foreign_text import in_its_unit, nearest_name, read_foreign_csv


@dataclass(frozen=True)
class Index:
    """The rows of an index, (row number in the file, column -> cell) each, and in sentences what was found in reading
    it."""

    rows: list[tuple[int, dict[str, str]]]
    remarks: tuple[str, ...] = ()


def read_index(file: Path, needed: tuple[str, ...] = ("frame", "kind")) -> Index:
    """Return the rows of `file`, whose header has the columns `needed`; cells without blanks, empty ones left out.

    Raises InputError with one line where it can't be read, a column is missing, or one that isn't known is a known one
    in another unit or misspelled. Other unknown columns are left out with a remark.
    """
    wanted = ",".join(dict.fromkeys((*needed, "side", "exposure_s")))
    if not file.is_file():
        raise InputError(f"{file}: missing; write one row a capture: {wanted},...")
    try:
        found = read_foreign_csv(file)
        reader = csv.reader(found.text.splitlines())
        header = [cell.strip() for cell in next(reader, [])]
        listed = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise InputError(f"{file}: isn't CSV ({one_line(error)}); write one row a capture: {wanted},...") from error
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    unused = _check_header(file, header, needed)
    rows = []
    for number, row in listed:
        if not any(row):
            continue
        if len(row) > len(header):
            raise InputError(f"{file}: row {number}: {len(row)} cells under {len(header)} columns; correct it")
        cells = {key: cell for key, cell in zip(header, row, strict=False) if cell and key not in unused}
        rows.append((number, cells))
    if not rows:
        raise InputError(f"{file}: lists no captures; write one row a capture")
    remarks = [f"{file}: {remark}" for remark in found.remarks]
    if unused:
        remarks.append(f"{file}: columns that no capture has are left out: {', '.join(unused)}")
    return Index(rows, tuple(remarks))


def _check_header(file: Path, header: list[str], needed: tuple[str, ...]) -> list[str]:
    """Return the columns that aren't used. Raises InputError for one that is missing, stands twice, or is meant to be a
    known one."""
    known = _columns()
    unknown = [name for name in header if name and name not in known]
    meant = [(name, near) for name in unknown if (near := nearest_name(name, known)) is not None and near not in header]
    if meant:
        told = "; ".join(f"'{name}': write {in_its_unit(near)}" for name, near in meant)
        raise InputError(f"{file}: unknown column {told}")
    missing = [f"'{name}'" for name in needed if name not in header]
    if missing:
        raise InputError(
            f"{file}: the header has no columns {' and '.join(missing)} (it is "
            f"'{' '.join(','.join(header).split())[:60]}'); "
            "name the columns as the capture's keys"
        )
    if twice := sorted({name for name in header if name and header.count(name) > 1}):
        raise InputError(f"{file}: the column {', '.join(twice)} stands twice; take one out")
    return unknown


def _columns() -> list[str]:
    """Return the keys of all kinds of capture, those of objects in them with a dot."""
    names: dict[str, None] = {}
    for kind in CAPTURES.models.values():
        for key, field in kind.model_fields.items():
            parts = [part for part in (field.annotation, *get_args(field.annotation)) if isinstance(part, type)]
            inner = next((part for part in parts if issubclass(part, Open)), None)
            names |= dict.fromkeys([key] if inner is None else [f"{key}.{name}" for name in inner.model_fields])
    return list(names)


def capture_of_row(row: dict[str, str]) -> dict[str, Any]:
    """Return a row as a capture's keys: lists and numbers out of their cells, `screen.x` into `screen`. Raises
    InputError without the row."""
    if "frame" not in row or "kind" not in row:
        raise InputError("the frame or its kind is missing; write both")
    if row["kind"] == "checkerboard" and "squares" in row and "square_mm" in row:
        row = row | {"kind": "charuco", "dictionary": "none"}
    kind = CAPTURES.models.get(row["kind"])
    sizes = _list_sizes(kind) if kind is not None else {}
    capture: dict[str, Any] = {}
    for key, cell in row.items():
        value: Any = cell
        if key in sizes:
            value = _list(key, cell, sizes[key])
        if key.startswith("screen."):
            capture.setdefault("screen", {})[key.removeprefix("screen.")] = value
        else:
            capture[key] = value
    return capture


def _list_sizes(kind: type[Capture]) -> dict[str, int]:
    """Keys of a kind that hold several numbers, and how many make a group (0: a flat list)."""
    sizes = {}
    for key, field in kind.model_fields.items():
        parts = [part for part in (field.annotation, *get_args(field.annotation)) if get_origin(part) is tuple]
        if parts:
            sizes[key] = len(get_args(get_args(parts[0])[0]))
    return sizes


def _list(key: str, cell: str, size: int) -> list[Any]:
    try:
        numbers = [float(word) for word in re.split(r"[\s;]+", cell)]
    except ValueError:
        raise InputError(f"{key}: '{cell}' isn't a list of numbers; write them with spaces between") from None
    whole = [int(number) if number.is_integer() else number for number in numbers]
    return [whole[k : k + size] for k in range(0, len(whole), size)] if size else whole
