"""A folder of camera raws or grey images with an `index.csv` that says what each is, and a `camera.toml`.

`index.csv` has one row a capture; its columns are a capture's keys in the recording set (`frame,kind,side,exposure_s,...`), the
members of `screen` as `screen.pose`, `screen.cell_camera_px`, `screen.radiance`. Lists are written with spaces
(`region`: `92 156 292 356`; `corners`: eight numbers). An empty cell is an unknown value. `side` may be left out (left), and
`id` too (the file's name). Spectra (CSV) and targets (.npy) are named as in a recording set, relative to the folder.

`camera.toml` has the keys of a recording set's camera, at the top for one camera, or in `[left]` and `[right]`. Without `rows`
and `cols` these are taken from the images, and without `bit_depth` where the files themselves have 8 bit. Its `[[taps]]` are those of
`lab.formats.importers.readout`.

A board without markers is a `charuco` capture with `dictionary` `none`. The stereo pairs of OpenCV's samples, for example
(6 x 9 inner corners, so 7 x 10 squares; how long they were exposed isn't known), with `cfa = "MONO"` in `[left]` and in
`[right]` of `camera.toml`:

    frame,kind,side,exposure_s,dictionary,squares,square_mm,pose
    left01.jpg,charuco,left,,none,7 10,25,01
    right01.jpg,charuco,right,,none,7 10,25,01

`read_checkerboard_pairs` (`calibench import --from raw-folder --checkerboard 6x9 --square-mm 25`) does the same for a folder of
images named `leftNN` and `rightNN`, without the two files.
"""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args, get_origin

import numpy as np

from lab.capture_kinds.base import CAPTURES, Capture
from lab.errors import InputError
from lab.formats.importers.fits_file import FITS
from lab.formats.importers.images import IMAGES, decoded, described_sides, read_camera_file, read_image
from lab.formats.importers.readout import Readout, Tap, TapFiles, parse_taps, readout
from lab.formats.recording_set import RAWS, DataSheet, FolderFiles, RecordingError, RecordingSet, parse_manifest
from sim.camera import Side

INDEX, CAMERA = "index.csv", "camera.toml"


def read_raw_folder(path: Path, tap: str = "") -> RecordingSet:
    """The captures that `index.csv` in the folder `path` lists, as a recording set. `tap`: that tap of the sensor alone.

    Raises RecordingError with one line for every row that can't be used.
    """
    index = path / INDEX
    return recordings_of_rows(path, list(index_rows(index)), str(index), tap)


def recordings_of_rows(path: Path, rows: list[tuple[int, dict[str, str]]], where: str, tap: str = "") -> RecordingSet:
    """The captures of `rows`, (number, column -> cell) each, with the `camera.toml` of the folder `path`."""
    cameras = path / CAMERA
    if not cameras.is_file():
        raise InputError(f"{cameras}: missing; write the camera's keys, `cfa` at least")
    taps: dict[Side, tuple[Tap, ...]] = {}
    for side, keys in described_sides(cameras).items():
        listed = parse_taps(keys.get("taps", ()), str(cameras))
        taps[side] = tuple(one for one in listed if one.name == tap) if tap else listed
        if tap and not taps[side]:
            names = ", ".join(one.name for one in listed) or "none"
            raise InputError(f"--tap {tap}: {cameras} describes no such tap of the {side} camera; it has {names}")
    return _recording_set(path, rows, where, lambda measured: read_camera_file(cameras, measured), taps)


def read_checkerboard_pairs(path: Path, corners: tuple[int, int], square_mm: float) -> RecordingSet:
    """Pairs of images `leftNN` and `rightNN` of a plain checkerboard as a recording set of two grey cameras.

    `corners`: inner corners of the board, (rows, cols), one less than its squares. Only whole pairs are taken; the warnings say
    which images were left out.
    """
    pairs: dict[str, dict[str, str]] = {}
    for file in sorted(path.iterdir()):
        if file.suffix.lower() in IMAGES and (match := re.fullmatch(r"(left|right)[_-]?(\w+)", file.stem, re.I)):
            pairs.setdefault(match[2], {})[match[1].lower()] = file.name
    whole = {pose: names for pose, names in pairs.items() if len(names) == 2}
    if not whole:
        raise InputError(f"{path}: no pairs of images leftNN and rightNN; name them so, or write {INDEX}")
    board = {"dictionary": "none", "squares": f"{corners[0] + 1} {corners[1] + 1}", "square_mm": f"{square_mm:g}"}
    rows = [
        {"frame": names[side], "kind": "charuco", "side": side, "pose": pose} | board
        for pose, names in whole.items()
        for side in get_args(Side)
    ]
    recordings = _recording_set(
        path,
        list(enumerate(rows, start=1)),
        str(path),
        lambda measured: {side: DataSheet.model_validate({"cfa": "MONO"} | keys) for side, keys in measured.items()},
    )
    single = [name for names in pairs.values() if len(names) == 1 for name in names.values()]
    if single:
        recordings.warnings += (f"{path}: {', '.join(single)} left out; the other side of the pair is missing",)
    return recordings


def read_dot_grids(path: Path, dots: tuple[int, int], spacing_mm: float) -> RecordingSet:
    """Pictures of a plane grid of `dots` (rows, cols), each in another pose, as a recording set of one camera.

    Images in the folder `path` in the order of their names; `camera.toml` beside them has the camera's keys, `cfa` at least.
    """
    files = [file.name for file in sorted(path.iterdir()) if file.suffix.lower() in (*IMAGES, *FITS, *RAWS, ".npy")]
    if not files:
        raise InputError(f"{path}: no images; give the folder of the pictures")
    board = {"dictionary": "dots", "squares": f"{dots[0] + 1} {dots[1] + 1}", "square_mm": f"{spacing_mm:g}"}
    rows = [{"frame": name, "kind": "charuco", "pose": f"p{k:03d}"} | board for k, name in enumerate(files)]
    return recordings_of_rows(path, list(enumerate(rows, start=1)), str(path))


def _recording_set(
    path: Path,
    rows: list[tuple[int, dict[str, str]]],
    where: str,
    cameras: Callable[[dict[Side, dict[str, Any]]], dict[Side, DataSheet]],
    taps: Mapping[Side, tuple[Tap, ...]] = {},
) -> RecordingSet:
    folder = FolderFiles(path)
    images: dict[str, Path] = {}
    captures: list[dict[str, Any]] = []
    problems: list[str] = []
    used: Counter[str] = Counter()
    for number, row in rows:
        try:
            capture = _capture(row)
            found = folder.file(capture["frame"])
        except InputError as error:
            problems.append(f"{where}: row {number}: {row.get('frame', '')}: {error}")
            continue
        stem = re.sub(r"[^\w.-]+", "_", str(capture.get("id") or Path(capture["frame"]).stem))
        used[stem] += 1
        frame = f"frames/{stem if used[stem] == 1 else f'{stem}-{used[stem]}'}.npy"
        captures.append({"id": stem, "side": "left", "exposure_s": None} | capture | {"frame": frame})
        images[frame] = found or path / capture["frame"]
    if problems:
        raise RecordingError(problems)
    measured = _measured(captures, images)
    readouts: dict[Side, Readout] = {}
    for side, listed in taps.items():
        if listed and side in measured:
            own = [images[capture["frame"]] for capture in captures if capture["side"] == side]
            cut = readout(listed, own, (measured[side]["rows"], measured[side]["cols"]), str(path / CAMERA))
            measured[side] |= {"rows": cut.shape[0], "cols": cut.shape[1], "black_level_dn": cut.black_level_dn}
            readouts[side] = cut
    described = cameras(measured)
    text = json.dumps(
        {
            "format": "calibench-recording",
            "version": 1,
            "name": path.resolve().name,
            "notes": "imported from a folder of images",
            "cameras": {side: camera.model_dump(exclude_unset=True) for side, camera in described.items()},
            "captures": captures,
        }
    )
    manifest, warnings = parse_manifest(text, where)
    warnings += [remark for one in readouts.values() for remark in one.remarks]
    by_frame = {capture["frame"]: readouts[capture["side"]] for capture in captures if capture["side"] in readouts}
    return RecordingSet(
        manifest, source=str(path), warnings=tuple(dict.fromkeys(warnings)), files=TapFiles(path, images, by_frame)
    )


def index_rows(index: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """(row number in the file, column -> cell), cells without blanks, empty ones left out."""
    try:
        text = index.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{index}: can't be read ({type(error).__name__}); write one row a capture: frame,kind,side,exposure_s,..."
        ) from error
    reader = csv.reader(text.splitlines())
    header = [cell.strip() for cell in next(reader, [])]
    if "frame" not in header or "kind" not in header:
        raise InputError(
            f"{index}: the header has no columns 'frame' and 'kind'; name the columns as the capture's keys"
        )
    some = False
    for row in reader:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) > len(header):
            raise InputError(
                f"{index}: row {reader.line_num}: {len(row)} cells under {len(header)} columns; correct it"
            )
        some = True
        yield reader.line_num, {key: cell.strip() for key, cell in zip(header, row, strict=False) if cell.strip()}
    if not some:
        raise InputError(f"{index}: lists no captures; write one row a capture")


def _capture(row: dict[str, str]) -> dict[str, Any]:
    """A row as a capture's keys: lists and numbers out of their cells, `screen.x` into `screen`."""
    if "frame" not in row or "kind" not in row:
        raise InputError("the frame or its kind is missing; write both")
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


def _measured(captures: list[dict[str, Any]], images: dict[str, Path]) -> dict[Side, dict[str, Any]]:
    """Rows and columns of each side's first image, and the bit depth of files of 8 bit: what `camera.toml` may leave out."""
    measured: dict[Side, dict[str, Any]] = {}
    for side in get_args(Side):
        first = next((images[capture["frame"]] for capture in captures if capture["side"] == side), None)
        if first is None:
            continue
        try:
            frame = read_image(first)
        except InputError as error:
            raise InputError(f"{first}: {error}") from error
        measured[side] = {"rows": frame.shape[0], "cols": frame.shape[1]}
        if first.suffix.lower() in IMAGES and decoded(first).dtype == np.uint8:
            measured[side]["bit_depth"] = 8
    return measured
