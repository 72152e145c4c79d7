"""Calibration curves of instruments: CSV files of two columns, wavelength (nm) and a value above 0."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from drivers.errors import InstrumentError
from sim.spectrum import Spectrum


def read_calibration(path: str, columns: list[str], who: str) -> Spectrum:
    """Return the curve of a file whose first line names `columns`. Raises `InstrumentError`, one line that begins with
    `who`."""
    file = Path(path)
    try:
        with file.open(newline="", encoding="utf-8") as lines:
            head, *rows = [row for row in csv.reader(lines) if row]
        return _curve([name.strip() for name in head], rows, columns)
    except (OSError, ValueError) as error:
        raise InstrumentError(f"{who}: calibration file {file.name}: {' '.join(str(error).split())}") from error


def _curve(head: list[str], rows: list[list[str]], columns: list[str]) -> Spectrum:
    if head != columns:
        raise ValueError(f"the columns are {','.join(head)}, and have to be {','.join(columns)}")
    table = np.array(rows, float)
    if table.ndim != 2 or table.shape[1] != 2:
        raise ValueError(f"every row has {len(columns)} numbers")
    if not np.all(np.isfinite(table)) or np.any(table[:, 1] <= 0):
        raise ValueError("values have to be finite and above 0")
    return Spectrum.of(table[:, 0], table[:, 1])
