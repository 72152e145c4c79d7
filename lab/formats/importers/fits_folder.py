"""A folder of FITS frames. The header of each says what it shows, or an `index.csv` beside them, as in a folder of
raws.

Used of the header: IMAGETYP or OBSTYPE (dark, bias, zero, flat), EXPTIME or EXPOSURE (s), CCD-TEMP, DATE-OBS. An index
has one row a frame; its empty cells of exposure, temperature and time are taken from the header. GAIN and BAYERPAT have
no common meaning: state these values in `camera.toml`, which has the camera's keys, `cfa` and `bit_depth` at least.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lab.errors import InputError
from lab.formats.importers.fits_file import FITS, GZIP, FitsHeader, fits_header, is_fits
from lab.formats.importers.index_file import Index, read_index
from lab.formats.importers.raw_folder import INDEX, recordings_of_index
from lab.formats.recording_set import RecordingError, RecordingSet


def read_fits_folder(path: Path, tap: str = "") -> RecordingSet:
    """Return the FITS frames in the folder `path` as a recording set. `tap`: that tap of the sensor alone.

    Raises RecordingError with one line for every frame that can't be used: damaged, without an exposure. Frames whose
    image type is neither dark nor flat need an `index.csv`; without one they are left out with a warning.
    """
    if (path / INDEX).is_file():
        return recordings_of_index(path, _with_headers(path), str(path / INDEX), tap)
    files = sorted(file for file in path.iterdir() if is_fits(file))
    if not files:
        raise InputError(f"{path}: no FITS frames ({', '.join(FITS)}, also with {GZIP}); give their folder")
    rows: list[tuple[int, dict[str, str]]] = []
    problems: list[str] = []
    left_out: dict[str, list[str]] = {}
    for number, file in enumerate(files, start=1):
        try:
            header = fits_header(file)
        except InputError as error:
            problems.append(f"{file}: {error}")
            continue
        if header.kind is None:
            left_out.setdefault(header.image_type or "none", []).append(file.name)
        elif header.exposure_s is None:
            problems.append(f"{file}: its header has no EXPTIME; write exposure_s into {INDEX}")
        else:
            rows.append((number, {"frame": file.name, "kind": header.kind} | _cells(header)))
    if problems:
        raise RecordingError(problems)
    types = "; ".join(f"IMAGETYP {kind}: {names[0]} and {len(names) - 1} more" for kind, names in left_out.items())
    if not rows:
        raise InputError(
            f"{path}: no frame says that it is dark or flat ({types}); write {INDEX}: frame,kind,exposure_s,..."
        )
    recordings = recordings_of_index(path, Index(rows), str(path), tap)
    if left_out:
        recordings.warnings += (f"{path}: neither dark nor flat and left out: {types}; write {INDEX} to use them",)
    return recordings


def _cells(header: FitsHeader) -> dict[str, str]:
    """Return what a header states, as cells of an index."""
    stated = {
        "exposure_s": None if header.exposure_s is None else f"{header.exposure_s:.12g}",
        "temperature_c": None if header.temperature_c is None else f"{header.temperature_c:.6g}",
        "time": None if header.time is None else header.time.isoformat(),
    }
    return {key: cell for key, cell in stated.items() if cell is not None}


def _with_headers(path: Path) -> Index:
    """Return the index, with what the headers state in empty cells."""
    rows: list[tuple[int, dict[str, str]]] = []
    problems: list[str] = []
    index = read_index(path / INDEX)
    for number, row in index.rows:
        file = path / row.get("frame", "")
        if is_fits(file) and file.is_file():
            try:
                rows.append((number, _cells(fits_header(file)) | row))
            except InputError as error:
                problems.append(f"{path / INDEX}: row {number}: {row['frame']}: {error}")
        else:
            rows.append((number, row))
    if problems:
        raise RecordingError(problems)
    return replace(index, rows=rows)
