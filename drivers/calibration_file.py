"""Calibration curves of instruments: CSV files of two columns, wavelength (nm) and a value above 0."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from drivers.errors import InstrumentError
from sim.spectrum import Spectrum


def read_calibration(path: str, columns: list[str], who: str) -> Spectrum:
    r"""Return the curve of a calibration file.

    path : CSV
    columns : names that its first line has
    who : beginning of the message

    Raises `InstrumentError`, one line.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "diode.csv"
    ...     _ = file.write_text("wavelength_nm,responsivity_a_per_w\n400,0.2\n500,0.3\n")
    ...     read_calibration(str(file), ["wavelength_nm", "responsivity_a_per_w"], "photodiode").value
    (0.2, 0.3)
    """
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
