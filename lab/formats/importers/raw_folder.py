"""A folder of camera raws or grey images with an `index.csv` that says what each is, and a `camera.toml`.

`index.csv` is that of `lab.formats.importers.index_file`. `side` may be left out (left), and `id` too (the file's
name). Spectra (CSV) and targets (.npy) are named as in a recording set, relative to the folder.

`camera.toml` has the keys of a recording set's camera, at the top for one camera, or in `[left]` and `[right]`. Without
`rows` and `cols` these are taken from the images, and without `bit_depth` where the files themselves have 8 bit. Its
`[[taps]]` are those of `lab.formats.importers.readout`.

`read_checkerboard_pairs` (`calibench import --from raw-folder --checkerboard 6x9 --square-mm 25`) needs neither of the
two files: it takes a folder of images named `leftNN` and `rightNN` of a plain checkerboard. `read_boards` takes the
pictures of one camera, of a plain checkerboard or of a grid of dots; an `index.csv` may say what differs between them.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from lab.capture_kinds.base import Names, names_in
from lab.errors import InputError
from lab.formats.foreign_text import read_foreign_text, remarks_on
from lab.formats.importers.images import (
    IMAGES,
    decoded,
    described_sides,
    frame_name,
    grey,
    has_alpha,
    is_frame,
    read_camera_file,
    read_image,
)
from lab.formats.importers.index_file import Index, capture_of_row, read_index
from lab.formats.importers.readout import Readout, Tap, TapFiles, parse_taps, readout
from lab.formats.importers.stated_settings import held_against_frames
from lab.formats.recording_set import DataSheet, FolderFiles, Manifest, RecordingError, RecordingSet, parse_manifest
from sim.camera import Side

INDEX, CAMERA = "index.csv", "camera.toml"


def read_raw_folder(path: Path, tap: str = "") -> RecordingSet:
    """Return the captures that `index.csv` in the folder `path` lists, as a recording set. `tap`: that tap of the
    sensor alone.

    Raises RecordingError with one line for every row that can't be used.
    """
    return recordings_of_index(path, read_index(path / INDEX), str(path / INDEX), tap)


def recordings_of_index(path: Path, index: Index, where: str, tap: str = "") -> RecordingSet:
    """Return the captures of the rows of `index`, with the `camera.toml` of the folder `path`. `where`: what lists
    them, for messages."""
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
    remarks = tuple(f"{cameras}: {remark}" for remark in read_foreign_text(cameras).remarks)
    index = replace(index, remarks=index.remarks + remarks)
    return _recording_set(path, index, where, lambda measured: read_camera_file(cameras, measured), taps)


def read_checkerboard_pairs(path: Path, corners: tuple[int, int], square_mm: float) -> RecordingSet:
    """Pairs of images `leftNN` and `rightNN` of a plain checkerboard as a recording set of two grey cameras.

    `corners`: inner corners of the board, (rows, cols), one less than its squares. Only whole pairs are taken; the
    warnings say which images were left out.
    """
    pairs: dict[str, dict[str, str]] = {}
    for file in sorted(path.iterdir()):
        if file.suffix.lower() in IMAGES and (match := re.fullmatch(r"(left|right)[_-]?(\w+)", file.stem, re.I)):
            pairs.setdefault(match[2], {})[match[1].lower()] = file.name
    whole = {pose: names for pose, names in pairs.items() if len(names) == 2}
    if not whole:
        raise InputError(
            f"{path}: no pairs of images leftNN and rightNN; name them so, or give a single camera's to --from "
            "checkerboard"
        )
    board = {"dictionary": "none", "squares": f"{corners[0] + 1} {corners[1] + 1}", "square_mm": f"{square_mm:g}"}
    rows = [
        {"frame": names[side], "kind": "charuco", "side": side, "pose": pose} | board
        for pose, names in whole.items()
        for side in get_args(Side)
    ]
    recordings = _recording_set(
        path,
        Index(list(enumerate(rows, start=1))),
        str(path),
        lambda measured: {side: DataSheet.model_validate({"cfa": "MONO"} | keys) for side, keys in measured.items()},
    )
    single = [name for names in pairs.values() if len(names) == 1 for name in names.values()]
    if single:
        recordings.warnings += (f"{path}: {', '.join(single)} left out; the other side of the pair is missing",)
    return recordings


def read_boards(
    path: Path, dictionary: Literal["none", "dots"], points: tuple[int, int], spacing_mm: float
) -> RecordingSet:
    """Pictures of a plane board, each in another pose, as a recording set of one camera.

    `points`: inner corners of a plain checkerboard (`dictionary` none) or dots, (rows, cols). `path`: a folder of
    images in the order of their names, or one image; `camera.toml` beside them has the camera's keys, `cfa` at least.
    An `index.csv` there lists the pictures in place of the
    folder: its column `frame`, and where known `pose`, `exposure_s`, `wavelength_nm` (light of one wavelength), ...
    """
    board = {
        "kind": "charuco",
        "dictionary": dictionary,
        "squares": f"{points[0] + 1} {points[1] + 1}",
        "square_mm": f"{spacing_mm:g}",
    }
    folder = path.parent if path.is_file() else path
    if path.is_dir() and (folder / INDEX).is_file():
        index = read_index(folder / INDEX, ("frame",))
        where = str(folder / INDEX)
    else:
        files = [path] if path.is_file() else [file for file in sorted(folder.iterdir()) if is_frame(file)]
        if not files:
            raise InputError(f"{path}: no images; give the folder of the pictures")
        index = Index([(number, {"frame": file.name}) for number, file in enumerate(files, start=1)])
        where = str(path)
    rows = [(number, {"pose": f"p{k:03d}"} | row | board) for k, (number, row) in enumerate(index.rows)]
    return recordings_of_index(folder, replace(index, rows=rows), where)


def read_dot_grids(path: Path, dots: tuple[int, int], spacing_mm: float) -> RecordingSet:
    """Pictures of a plane grid of `dots` (rows, cols): see `read_boards`."""
    return read_boards(path, "dots", dots, spacing_mm)


def _recording_set(
    path: Path,
    index: Index,
    where: str,
    cameras: Callable[[dict[Side, dict[str, Any]]], dict[Side, DataSheet]],
    taps: Mapping[Side, tuple[Tap, ...]] = {},
) -> RecordingSet:
    folder = FolderFiles(path)
    images: dict[str, Path] = {}
    captures: list[dict[str, Any]] = []
    numbers: list[int] = []
    problems: list[str] = []
    used: Counter[str] = Counter()
    for number, row in index.rows:
        try:
            capture = capture_of_row(row)
            found = folder.file(capture["frame"])
        except InputError as error:
            problems.append(f"{where}: row {number}: {row.get('frame', '')}: {error}")
            continue
        stem = re.sub(r"[^\w.-]+", "_", str(capture.get("id") or frame_name(capture["frame"])))
        used[stem] += 1
        frame = f"frames/{stem if used[stem] == 1 else f'{stem}-{used[stem]}'}.npy"
        captures.append({"id": stem, "side": "left", "exposure_s": None} | capture | {"frame": frame})
        images[frame] = found or path / capture["frame"]
        numbers.append(number)
    if problems:
        raise RecordingError(problems)
    measured, remarks = _measured(captures, images)
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
    try:
        manifest, warnings = parse_manifest(text, where)
    except RecordingError as error:
        raise RecordingError(_by_row(error.problems, numbers)) from error
    warnings = _by_row(warnings, numbers)
    remarks += [remark for one in readouts.values() for remark in one.remarks]
    remarks += remarks_on(path, _spectra(manifest))
    manifest, said = held_against_frames(manifest, images, where)
    remarks += said
    by_frame = {capture["frame"]: readouts[capture["side"]] for capture in captures if capture["side"] in readouts}
    return RecordingSet(
        manifest,
        source=str(path),
        warnings=tuple(dict.fromkeys((*index.remarks, *warnings, *remarks))),
        files=TapFiles(path, images, by_frame),
    )


def _by_row(lines: Sequence[str], numbers: Sequence[int]) -> list[str]:
    """Lines on captures as lines on their rows, one for all rows of which the same is said."""
    found: dict[tuple[str, str], list[str]] = {}
    for line in lines:
        parts = re.fullmatch(r"(.*: )captures\[(\d+)\]( \(.*?\))?(: .*)", line, re.S)
        key, row = (
            ((parts[1], parts[4]), f"row {numbers[int(parts[2])]}{parts[3] or ''}") if parts else ((line, ""), "")
        )
        found.setdefault(key, []).append(row)
    return [
        f"{before}{of[0]}{f' and {len(of) - 1} more' if len(of) > 1 else ''}{after}"
        for (before, after), of in found.items()
    ]


def _spectra(manifest: Manifest) -> list[str]:
    """Paths of the spectra that the captures and cameras name."""
    named = [path for capture in manifest.captures for _, what, path in names_in(capture) if what is Names.SPECTRUM]
    named += [path for camera in manifest.cameras.values() for path in (camera.quantum_efficiency or {}).values()]
    return list(dict.fromkeys(named))


def _measured(captures: list[dict[str, Any]], images: dict[str, Path]) -> tuple[dict[Side, dict[str, Any]], list[str]]:
    """Rows and columns of each side's first image, and the bit depth of files of 8 bit: what `camera.toml` may leave
    out. And what is dropped of the images, in sentences."""
    measured: dict[Side, dict[str, Any]] = {}
    remarks = []
    for side in get_args(Side):
        first = next((images[capture["frame"]] for capture in captures if capture["side"] == side), None)
        if first is None:
            continue
        try:
            image = decoded(first) if first.suffix.lower() in IMAGES else None
            frame = read_image(first) if image is None else grey(image)
        except InputError as error:
            raise InputError(f"{first}: {error}") from error
        measured[side] = {"rows": frame.shape[0], "cols": frame.shape[1]}
        if image is not None and image.dtype == np.uint8:
            measured[side]["bit_depth"] = 8
        if image is not None and has_alpha(image):
            remarks.append(f"{first}: has a channel of transparency, which is dropped, as in the others of this side")
    return measured, remarks
