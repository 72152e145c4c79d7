"""A folder of camera raws or grey images with an `index.csv` that says what each is, and a `camera.toml`.

`index.csv` has one row a capture; its columns are a capture's keys in the recording set (`frame,kind,side,exposure_s,...`), the
members of `screen` as `screen.pose`, `screen.cell_camera_px`, `screen.radiance`. Lists are written with spaces
(`region`: `92 156 292 356`; `corners`: eight numbers). An empty cell is an unknown value. `side` may be left out (left), and
`id` too (the file's name). Spectra (CSV) and targets (.npy) are named as in a recording set, relative to the folder.

`camera.toml` has the keys of a recording set's camera, at the top for one camera, or in `[left]` and `[right]`. Without `rows`,
`cols` and `bit_depth`, these are taken from the images.

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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

from lab.capture_kinds.base import CAPTURES, Capture
from lab.errors import InputError
from lab.formats.importers.images import IMAGES, ImageFiles, read_camera_file, read_image
from lab.formats.recording_set import DataSheet, FolderFiles, RecordingError, RecordingSet, parse_manifest
from sim.camera import Side

INDEX, CAMERA = "index.csv", "camera.toml"


def read_raw_folder(path: Path) -> RecordingSet:
    """The captures that `index.csv` in the folder `path` lists, as a recording set.

    Raises RecordingError with one line for every row that can't be used.
    """
    index, cameras = path / INDEX, path / CAMERA
    rows = list(_rows(index))
    if not cameras.is_file():
        raise InputError(f"{cameras}: missing; write the camera's keys, `cfa` at least")
    return _recording_set(path, rows, str(index), lambda measured: read_camera_file(cameras, measured))


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


def _recording_set(
    path: Path,
    rows: list[tuple[int, dict[str, str]]],
    where: str,
    cameras: Callable[[dict[Side, dict[str, Any]]], dict[Side, DataSheet]],
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
    described = cameras(_measured(captures, images))
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
    return RecordingSet(manifest, source=str(path), warnings=tuple(warnings), files=ImageFiles(path, images))


def _rows(index: Path) -> Iterator[tuple[int, dict[str, str]]]:
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
    """Rows, columns and the least bit depth of each side's first image: what `camera.toml` may leave out."""
    measured: dict[Side, dict[str, Any]] = {}
    for side in get_args(Side):
        first = next((images[capture["frame"]] for capture in captures if capture["side"] == side), None)
        if first is None:
            continue
        try:
            frame = read_image(first)
        except InputError as error:
            raise InputError(f"{first}: {error}") from error
        bits = next(bits for bits in (8, 10, 12, 14, 16) if int(frame.max()) < 2**bits)
        measured[side] = {"rows": frame.shape[0], "cols": frame.shape[1], "bit_depth": bits}
    return measured
