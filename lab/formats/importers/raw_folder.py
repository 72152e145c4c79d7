"""A folder of camera raws or grey images with an `index.csv` that says what each is, and a `camera.toml`.

`index.csv` has a row for each image (`Index`). `side` may be left out (left), and `id` too (the file's
name). Spectra (CSV) and targets (.npy) are named as in a recording set, relative to the folder.

`camera.toml` has the keys of a recording set's camera, at the top for one camera, or in `[left]` and `[right]`. Without
`rows` and `cols` these are taken from the images, and without `bit_depth` where the files themselves have 8 bit. Its
`[[taps]]` are those of `lab.formats.importers.images`.

`read_checkerboard_pairs` (`calibench import --from raw-folder --checkerboard 6x9 --square-mm 25`) needs neither of the
two files: it takes a folder of images named `leftNN` and `rightNN` of a plain checkerboard. `read_boards` takes the
pictures of one camera, of a plain checkerboard or of a grid of dots; an `index.csv` may say what differs between them.
"""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np

from lab.capture_kinds.base import CAPTURES, Capture, Names, Open, names_in
from lab.errors import InputError, one_line
from lab.formats.cgats import in_its_unit, nearest_name, read_foreign_csv, read_foreign_text, remarks_on
from lab.formats.importers.fits_file import fits_header, has_keyword, is_fits
from lab.formats.importers.frame_settings import ALL_FRAMES, HeaderChoice, is_chosen, states, text_of
from lab.formats.importers.images import (
    Readout,
    Tap,
    TapFiles,
    frame_name,
    grey,
    has_alpha,
    is_frame,
    parse_taps,
    read_camera_file,
    read_image,
    read_sides,
    readout,
)
from lab.formats.importers.own_statements import compare_with_files, list_keys_taken, read_known_keys
from lab.formats.importers.stated_settings import check_against_frames, frame_header
from lab.formats.pictures import IMAGES, TIFFS, picture_facts, read_picture
from lab.formats.recording_set import DataSheet, Manifest, RecordingError, RecordingSet, parse_manifest
from lab.formats.recording_set.files import locate_as_written
from sim.camera import Side

# ----------------------------------------------------------------------------------------------------------------------
# `index.csv`: one row a capture, the columns a capture's keys in the recording set, the members of `screen` as
# `screen.pose`, ...
#
# Lists are written with spaces (`region`: `92 156 292 356`; `corners`: eight numbers). An empty cell is an unknown
# value. A row of kind `checkerboard` that has `squares` and `square_mm` is a printed board without markers, not a
# pattern on the screen.


@dataclass(frozen=True)
class Index:
    """The rows of an index, (row number in the file, column -> cell) each, and in sentences what was found in reading
    it."""

    rows: list[tuple[int, dict[str, str]]]
    remarks: tuple[str, ...] = ()


def read_index(file: Path, needed: tuple[str, ...] = ("frame", "kind")) -> Index:
    r"""Return the rows of an index of frames; cells without blanks, empty ones left out.

    file : CSV with a header
    needed : columns that it must have

    Raises InputError with one line where it can't be read, a column is missing, or one that isn't known is a known one
    in another unit or misspelled. Other unknown columns are left out with a remark.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "index.csv"
    ...     _ = file.write_text("frame,kind,exposure_s\nflat-1.tif,flat,0.01\n")
    ...     read_index(file).rows
    [(2, {'frame': 'flat-1.tif', 'kind': 'flat', 'exposure_s': '0.01'})]
    """
    wanted = ",".join(dict.fromkeys((*needed, "side", "exposure_s")))
    if not file.is_file():
        raise InputError(f"{file}: missing; write one row a capture: {wanted},...")
    try:
        text = read_foreign_csv(file)
        reader = csv.reader(text.text.splitlines())
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
    remarks = [f"{file}: {remark}" for remark in text.remarks]
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
        corrections = "; ".join(f"'{name}': write {in_its_unit(near)}" for name, near in meant)
        raise InputError(f"{file}: unknown column {corrections}")
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
        for key, declared in kind.model_fields.items():
            parts = [part for part in (declared.annotation, *get_args(declared.annotation)) if isinstance(part, type)]
            inner = next((part for part in parts if issubclass(part, Open)), None)
            names |= dict.fromkeys([key] if inner is None else [f"{key}.{name}" for name in inner.model_fields])
    return list(names)


def capture_of_row(row: dict[str, str]) -> dict[str, Any]:
    """Return a row of an index as a capture's keys: lists and numbers out of their cells, `screen.x` into `screen`.

    row : cells by column

    Raises InputError without the row.

    >>> capture_of_row({"frame": "edge.tif", "kind": "slanted_edge", "region": "0 0 64 64"})["region"]
    [0, 0, 64, 64]
    """
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
    for key, declared in kind.model_fields.items():
        parts = [part for part in (declared.annotation, *get_args(declared.annotation)) if get_origin(part) is tuple]
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


INDEX, CAMERA = "index.csv", "camera.toml"


def read_raw_folder(path: Path, tap: str = "", choice: HeaderChoice = ALL_FRAMES) -> RecordingSet:
    """Return the captures that `index.csv` in the folder `path` lists, as a recording set. `tap`: that tap of the
    sensor alone; `choice`: what is used of the frames' headers.

    Raises RecordingError with one line for every row that can't be used.
    """
    return recordings_of_index(path, read_index(path / INDEX), str(path / INDEX), tap, choice)


def recordings_of_index(
    path: Path, index: Index, where: str, tap: str = "", choice: HeaderChoice = ALL_FRAMES
) -> RecordingSet:
    """Return the captures of the rows of `index`, with the `camera.toml` of the folder `path`. `where`: what lists
    them, for messages."""
    cameras = path / CAMERA
    if not cameras.is_file():
        raise InputError(f"{cameras}: missing; write the camera's keys, `cfa` at least")
    taps: dict[Side, tuple[Tap, ...]] = {}
    for side, keys in read_sides(cameras).items():
        listed = parse_taps(keys.get("taps", ()), str(cameras))
        taps[side] = tuple(tap_of_side for tap_of_side in listed if tap_of_side.name == tap) if tap else listed
        if tap and not taps[side]:
            names = ", ".join(tap_of_side.name for tap_of_side in listed) or "none"
            raise InputError(f"--tap {tap}: {cameras} describes no such tap of the {side} camera; it has {names}")
    remarks = tuple(f"{cameras}: {remark}" for remark in read_foreign_text(cameras).remarks)
    index = _of_choice(path, replace(index, remarks=index.remarks + remarks), where, choice)
    return _recording_set(path, index, where, lambda measured: read_camera_file(cameras, measured), taps, choice)


def _of_choice(path: Path, index: Index, where: str, choice: HeaderChoice) -> Index:
    """Return the rows whose frames have the settings that are asked for, with a remark on the others. Raises InputError
    where none has, or no header states a keyword that is to be ignored."""
    if choice == ALL_FRAMES:
        return index
    files = [path / row.get("frame", "") for _, row in index.rows]
    stated = {file: frame_header(file) for file in files if file.is_file()}
    settings = {file: header.settings for file, header in stated.items() if header is not None}
    if choice.ignored:
        unknown = [name for name in choice.ignored if not any(_has(file, name, settings) for file in files)]
        if unknown:
            raise InputError(f"--ignore {','.join(unknown)}: no frame's header states it; correct the keyword")
    kept = [
        (number, row)
        for (number, row), file in zip(index.rows, files, strict=True)
        if file not in stated or is_chosen(choice, row.get("kind", ""), settings.get(file, {}))
    ]
    for keyword, wanted in choice.only:
        there = {text_of(header[keyword]) for header in settings.values() if keyword in header}
        if not any(states(header, keyword, wanted) for header in settings.values()):
            offered = f"they state {', '.join(sorted(there))}" if there else "none states it"
            raise InputError(f"--only {keyword}={wanted}: no frame's header states that, {offered}; correct it")
    option = ",".join("=".join(pair) for pair in choice.only)
    if not kept:
        raise InputError(f"{where}: no frame's header states all of {option} (--only); give one of them")
    remarks = [f"{where}: {', '.join(choice.ignored)} of the headers ignored (--ignore)"] if choice.ignored else []
    if dropped := [row["frame"] for number, row in index.rows if (number, row) not in kept]:
        some = f"{dropped[0]}{f' and {len(dropped) - 1} more' if len(dropped) > 1 else ''}"
        remarks.append(f"{where}: --only {option}: {len(dropped)} of {len(index.rows)} frames left out: {some}")
    return replace(index, rows=kept, remarks=(*index.remarks, *remarks))


def _has(file: Path, keyword: str, settings: Mapping[Path, Mapping[str, object]]) -> bool:
    """Return whether the header of a file has a keyword."""
    return keyword in settings.get(file, {}) or (is_fits(file) and has_keyword(file, keyword))


def read_checkerboard_pairs(path: Path, corners: tuple[int, int], square_mm: float) -> RecordingSet:
    """Read pairs of images `leftNN` and `rightNN` of a plain checkerboard as a recording set of two grey cameras.

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
    """Read pictures of a plane board, each in another pose, as a recording set of one camera.

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
    """Read pictures of a plane grid of `dots` (rows, cols): see `read_boards`."""
    return read_boards(path, "dots", dots, spacing_mm)


def _recording_set(
    path: Path,
    index: Index,
    where: str,
    cameras: Callable[[dict[Side, dict[str, Any]]], dict[Side, DataSheet]],
    taps: Mapping[Side, tuple[Tap, ...]] = {},
    choice: HeaderChoice = ALL_FRAMES,
) -> RecordingSet:
    listed = _list_frames(path, index, where)
    captures, images, numbers = listed.captures, listed.images, listed.numbers
    measured, known, remarks = _measure_frames(listed, choice.ignored)
    if listed.stacks:
        more = f" and {len(listed.stacks) - 3} more" if len(listed.stacks) > 3 else ""
        remarks.append(
            f"{where}: each page of {', '.join(listed.stacks[:3])}{more} is a frame of its own, in the order of the "
            "pages (a time in the index isn't used for them)"
        )
    readouts: dict[Side, Readout] = {}
    for side, own_taps in taps.items():
        if own_taps and side in measured:
            files_of_side = [images[capture["frame"]] for capture in captures if capture["side"] == side]
            cut = readout(own_taps, files_of_side, (measured[side]["rows"], measured[side]["cols"]), str(path / CAMERA))
            measured[side] |= {"rows": cut.shape[0], "cols": cut.shape[1], "black_level_dn": cut.black_level_dn}
            for key in ("cfa", "black_level_dn"):  # of the whole sensor
                if known[side].pop(key, None) is not None and key == "cfa":
                    del measured[side]["cfa"]
            readouts[side] = cut
    if listed.renamed:
        more = f" (and {len(listed.renamed) - 1} more)" if len(listed.renamed) > 1 else ""
        remarks.append(f"{where}: {listed.renamed[0]}{more}; write the names as the files have them")
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
    remarks += [remark for side_readout in readouts.values() for remark in side_readout.remarks]
    remarks += remarks_on(path, _spectra(manifest))
    manifest, said = check_against_frames(manifest, images, where, choice)
    remarks += said
    statements = read_sides(path / CAMERA)
    for side, camera in described.items():
        files = {images[capture["frame"]]: capture["kind"] for capture in captures if capture["side"] == side}
        stated = statements.get(side, {})
        if files:
            boards = [file for file, kind in files.items() if kind == "charuco"]
            remarks += list_keys_taken(stated, known[side], next(iter(files)))
            remarks += compare_with_files(camera, stated, files, boards, choice.ignored, is_whole=side not in readouts)
    by_frame = {capture["frame"]: readouts[capture["side"]] for capture in captures if capture["side"] in readouts}
    return RecordingSet(
        manifest,
        source=str(path),
        warnings=tuple(dict.fromkeys((*index.remarks, *warnings, *remarks))),
        files=TapFiles(path, images, by_frame, listed.pages),
    )


@dataclass
class _ListedFrames:
    """What the rows of an index list, a capture for each frame. `images`: file of each frame by its path in the
    recording set; `pages`: its page, where the file has several; `numbers`: row of each capture; `stacks`: files of
    several pages, with their number; `renamed`: remarks on names that the files have otherwise."""

    captures: list[dict[str, Any]] = field(default_factory=list)
    images: dict[str, Path] = field(default_factory=dict)
    pages: dict[str, int] = field(default_factory=dict)
    numbers: list[int] = field(default_factory=list)
    stacks: list[str] = field(default_factory=list)
    renamed: list[str] = field(default_factory=list)


def _list_frames(path: Path, index: Index, where: str) -> _ListedFrames:
    """Return the captures of an index with ids that are unique where the rows state none. Raises RecordingError with
    one line for each row whose frame can't be used."""
    listed = _ListedFrames()
    problems: list[str] = []
    used: set[str] = set()
    stems = Counter(_stem(frame_name(row.get("frame", ""))) for _, row in index.rows if "id" not in row)
    for number, row in index.rows:
        try:
            capture = capture_of_row(row)
            file, renamed = locate_as_written(path, capture["frame"])
            many = _pages(file)
        except InputError as error:
            problems.append(f"{where}: row {number}: {row.get('frame', '')}: {error}")
            continue
        listed.renamed += [renamed] if renamed else []
        stem = _stem(str(capture.get("id") or frame_name(capture["frame"])))
        if "id" not in capture and stems[stem] > 1:  # of several folders
            stem = _stem(capture["frame"].rpartition("/")[0].replace("/", "-") + "-" + stem).lstrip("-")
        if many > 1:
            listed.stacks.append(f"{capture['frame']} ({many})")
        for page in range(many):
            name = _make_unique(stem if many == 1 else f"{stem}-p{page + 1}", used)
            frame = f"frames/{name}.npy"
            keys = {"id": name, "side": "left", "exposure_s": None} | capture | {"frame": frame}
            if many > 1:
                listed.pages[frame] = page
                keys |= {"id": name} | ({"pose": f"{capture['pose']}-p{page + 1}"} if "pose" in capture else {})
                keys.pop("time", None)  # of one page, and which isn't known
            listed.captures.append(keys)
            listed.images[frame] = file
            listed.numbers.append(number)
    if problems:
        raise RecordingError(problems)
    return listed


def _stem(name: str) -> str:
    """Return a name with the letters that ids and files have."""
    return re.sub(r"[^\w.-]+", "_", name)


def _make_unique(name: str, used: set[str]) -> str:
    """Return the name, with the first number behind it that makes it a new one where it is used; it is used from now
    on."""
    numbered = (name if number == 1 else f"{name}-{number}" for number in count(1))
    free = next(candidate for candidate in numbered if candidate not in used)
    used.add(free)
    return free


def _pages(file: Path) -> int:
    """Return the pages of a TIFF, or the frames of a FITS file; 1 of other files."""
    if is_fits(file):
        return fits_header(file, with_image=False).frames
    return picture_facts(file).pages if file.suffix.lower() in TIFFS else 1


def _by_row(lines: Sequence[str], numbers: Sequence[int]) -> list[str]:
    """Lines on captures as lines on their rows, one for all rows that share a text."""
    rows_of_line: dict[tuple[str, str], list[str]] = {}
    for line in lines:
        parts = re.fullmatch(r"(.*: )captures\[(\d+)\]( \(.*?\))?(: .*)", line, re.S)
        key, row = (
            ((parts[1], parts[4]), f"row {numbers[int(parts[2])]}{parts[3] or ''}") if parts else ((line, ""), "")
        )
        rows_of_line.setdefault(key, []).append(row)
    return [
        f"{before}{of[0]}{f' and {len(of) - 1} more' if len(of) > 1 else ''}{after}"
        for (before, after), of in rows_of_line.items()
    ]


def _spectra(manifest: Manifest) -> list[str]:
    """Paths of the spectra that the captures and cameras name."""
    named = [path for capture in manifest.captures for _, what, path in names_in(capture) if what is Names.SPECTRUM]
    named += [path for camera in manifest.cameras.values() for path in (camera.quantum_efficiency or {}).values()]
    return list(dict.fromkeys(named))


def _measure_frames(
    listed: _ListedFrames, ignored: Collection[str]
) -> tuple[dict[Side, dict[str, Any]], dict[Side, dict[str, Any]], list[str]]:
    """What each side's first image tells and `camera.toml` may leave out: rows and columns, and the bit depth of files
    of 8 bit; of these, what its file states (mosaic, black level, bits a sample). And what is dropped of the images, in
    sentences."""
    measured: dict[Side, dict[str, Any]] = {}
    known: dict[Side, dict[str, Any]] = {}
    remarks = []
    for side in get_args(Side):
        name = next((capture["frame"] for capture in listed.captures if capture["side"] == side), None)
        if name is None:
            continue
        first = listed.images[name]
        try:
            image = read_picture(first, listed.pages.get(name)) if first.suffix.lower() in IMAGES else None
            frame = read_image(first, listed.pages.get(name)) if image is None else grey(image)
            known[side] = read_known_keys(first, (frame.shape[0], frame.shape[1]), ignored)
        except InputError as error:
            raise InputError(f"{first}: {error}") from error
        measured[side] = {"rows": frame.shape[0], "cols": frame.shape[1]}
        if image is not None and image.dtype == np.uint8:
            measured[side]["bit_depth"] = 8
        measured[side] |= known[side]
        if image is not None and has_alpha(image):
            remarks.append(f"{first}: has a channel of transparency, which is dropped, as in the others of this side")
    return measured, known, remarks
