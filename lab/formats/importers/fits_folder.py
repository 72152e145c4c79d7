"""A folder of FITS frames. The header of each says what it shows, or an `index.csv` beside them, as of raws.

Used of the header: the image type (dark, bias, zero, offset, flat), exposure, temperature and time (`fits_file`), and
the settings of `frame_settings`, which have to be the same in frames that are fitted together. An index has one row a
frame; its empty cells of exposure, temperature and time are taken from the header. `camera.toml` has the camera's keys:
`bit_depth`, and `cfa` where no header has BAYERPAT. Where the folder itself holds no frames, those of its subfolders
are read."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

from lab.errors import InputError
from lab.formats.importers.fits_file import FITS, PACKED, FitsHeader, fits_header, is_fits
from lab.formats.importers.frame_settings import ALL_FRAMES, HeaderChoice
from lab.formats.importers.raw_folder import INDEX, Index, read_index, recordings_of_index
from lab.formats.importers.stated_settings import join_alike
from lab.formats.recording_set import RecordingError, RecordingSet


def read_fits_folder(path: Path, tap: str = "", choice: HeaderChoice = ALL_FRAMES) -> RecordingSet:
    """Return the FITS frames in the folder `path` as a recording set. `tap`: that tap of the sensor alone; `choice`:
    what is used of the headers.

    Raises RecordingError with one line for every frame that can't be used: damaged, without an exposure. Frames whose
    image type is neither dark nor flat need an `index.csv`; without one they are left out with a warning.
    """
    if (path / INDEX).is_file():
        return recordings_of_index(path, _with_headers(path, choice), str(path / INDEX), tap, choice)
    files, remarks = _list_files(path)
    rows: list[tuple[int, dict[str, str]]] = []
    problems: list[tuple[Path | str, str]] = []
    left_out: dict[str, list[str]] = {}
    for number, file in enumerate(files, start=1):
        try:
            header = fits_header(file, ignored=choice.ignored)
        except InputError as error:
            problems.append((file, str(error)))
            continue
        name = file.relative_to(path).as_posix()
        if header.stacked is not None:
            left_out.setdefault(f"{header.stacked} (made of several frames)", []).append(name)
        elif header.kind is None:
            left_out.setdefault(f"IMAGETYP {header.image_type or 'none'}", []).append(name)
        elif header.problems:
            problems += [(file, line) for _, line in header.problems]
        elif header.exposure_s is None:
            problems.append((file, f"its header has no EXPTIME; write exposure_s into {INDEX}"))
        else:
            rows.append((number, {"frame": name, "kind": header.kind} | _cells(header)))
    if problems:
        raise RecordingError(join_alike(problems))
    types = "; ".join(
        f"{kind}: {names[0]}{f' and {len(names) - 1} more' if len(names) > 1 else ''}"
        for kind, names in left_out.items()
    )
    if not rows:
        raise InputError(
            f"{path}: no frame says that it is dark or flat ({types}); write {INDEX}: frame,kind,exposure_s,..."
        )
    recordings = recordings_of_index(path, Index(rows, tuple(remarks)), str(path), tap, choice)
    if left_out:
        recordings.warnings += (f"{path}: neither dark nor flat and left out: {types}; write {INDEX} to use them",)
    return recordings


def _list_files(path: Path) -> tuple[list[Path], list[str]]:
    """Return the FITS files of a folder, or where it has none those of its subfolders, and what is to be told of
    subfolders. Raises InputError where there are none."""
    files = sorted(file for file in path.iterdir() if is_fits(file))
    inner = sorted(file for file in path.rglob("*") if file.parent != path and is_fits(file) and file.is_file())
    frames_of_folder = Counter(file.parent.relative_to(path).as_posix() for file in inner)
    folders = ", ".join(f"{name} ({number})" for name, number in frames_of_folder.items())
    if files:
        remark = f"{path}: frames in its subfolders are left out: {folders}; move them here, or write {INDEX}"
        return files, [remark] if inner else []
    if not inner:
        raise InputError(
            f"{path}: no FITS frames ({', '.join(FITS)}, also with {', '.join(PACKED)}); give their folder"
        )
    return inner, [f"{path}: the frames are those of its subfolders: {folders}"]


def _cells(header: FitsHeader) -> dict[str, str]:
    """Return what a header states, as cells of an index."""
    stated = {
        "exposure_s": None if header.exposure_s is None else f"{header.exposure_s:.12g}",
        "temperature_c": None if header.temperature_c is None else f"{header.temperature_c:.6g}",
        "time": None if header.time is None else header.time.isoformat(),
    }
    return {key: cell for key, cell in stated.items() if cell is not None}


def _with_headers(path: Path, choice: HeaderChoice) -> Index:
    """Return the index, with what the headers state in empty cells. Raises RecordingError where a header's value that
    is needed can't be used."""
    rows: list[tuple[int, dict[str, str]]] = []
    problems: list[tuple[Path | str, str]] = []
    index = read_index(path / INDEX)
    for number, row in index.rows:
        file = path / row.get("frame", "")
        if is_fits(file) and file.is_file():
            where = f"{path / INDEX}: row {number}: {row['frame']}"
            try:
                header = fits_header(file, ignored=choice.ignored)
            except InputError as error:
                problems.append((where, str(error)))
                continue
            problems += [(where, line) for key, line in header.problems if key not in row]
            rows.append((number, _cells(header) | row))
        else:
            rows.append((number, row))
    if problems:
        raise RecordingError(join_alike(problems))
    return replace(index, rows=rows)
