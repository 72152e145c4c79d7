"""Pictures as frames: TIFF, PNG and raw files, FITS by `fits_file`, and how a sensor was read out."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from lab.errors import InputError
from lab.formats.cgats import read_foreign_csv, read_foreign_text
from lab.formats.importers.fits_file import FITS, is_fits, load_fits, unpacked_name
from lab.formats.pictures import IMAGES, read_picture
from lab.formats.recording_set import RAWS, DataSheet, FolderFiles, Frame, load_frame
from lab.formats.recording_set.files import locate
from lab.formats.spectrum_csv import parse_spectrum
from sim.camera import Side
from sim.parameters import Frozen
from sim.spectrum import Spectrum

# ----------------------------------------------------------------------------------------------------------------------
# Image files as frames: grey PNG, JPEG, BMP, PGM, TIFF of 1 to 16 bit, FITS, camera raws, .npy. They are decoded on
# access.
#
# A channel of transparency (RGBA) is dropped, and `has_alpha` says so. Spectra beside them may have semicolons and
# decimal commas.


def read_image(file: Path, page: int | None = None) -> Frame:
    """Return the grey values of an image file as uint16 (rows, cols), as stored; `page`: of a TIFF with several, or the
    plane of a FITS cube. InputError without the path."""
    suffix = file.suffix.lower()
    if suffix == ".npy" or suffix in RAWS:
        return load_frame(file)
    if is_fits(file):
        return load_fits(file, page)
    if suffix not in IMAGES:
        raise InputError(f"can't be read; give one of {' '.join((*IMAGES, *FITS, *RAWS, '.npy'))}")
    return grey(read_picture(file, page))


def is_frame(file: Path) -> bool:
    """Return whether a file is one that can be read as a frame, by its ending.

    >>> is_frame(Path("flat-1.dng")), is_frame(Path("notes.txt"))
    (True, False)
    """
    return file.suffix.lower() in (*IMAGES, *RAWS, ".npy") or is_fits(file)


def frame_name(path: str) -> str:
    """Return the name of a frame's file without its ending, `.fits.gz` and `.fits.fz` included.

    >>> frame_name("frames/flat-1.fits.gz")
    'flat-1'
    """
    return Path(unpacked_name(path.rpartition("/")[2])).stem


def has_alpha(image: NDArray[Any]) -> bool:
    """Return whether an image has a channel of transparency beside its grey values or colours.

    image : (rows, cols[, channels])

    >>> has_alpha(np.zeros((4, 4, 4), np.uint8)), has_alpha(np.zeros((4, 4, 3), np.uint8))
    (True, False)
    """
    return image.shape[2:] in ((2,), (4,))


def grey(image: NDArray[Any]) -> Frame:
    """Return the grey values (rows, cols), uint16, of a decoded image; a channel of transparency is dropped.

    image : (rows, cols[, channels])

    Raises InputError for colours, and for numbers that aren't codes of 0 to 65535.

    >>> grey(np.full((2, 2, 3), 7, np.uint8)).tolist()
    [[7, 7], [7, 7]]
    """
    if image.ndim == 3:
        colours = image[..., :3]
        if image.shape[2] >= 3 and not np.array_equal(colours.min(axis=2), colours.max(axis=2)):
            raise InputError("is a colour picture; give the raw mosaic, or grey values")
        image = image[..., 0]
    return codes_of(image)


def codes_of(image: NDArray[Any]) -> Frame:
    """Return numbers as codes, uint16, DN. Raises InputError for fractions and for numbers beyond 0 to 65535.

    >>> codes_of(np.array([[64.0, 4095.0]])).tolist()
    [[64, 4095]]
    """
    if image.dtype not in (np.uint8, np.uint16):
        if image.dtype.kind not in "iuf" or not np.array_equal(image, np.rint(image)):
            raise InputError(f"its values are {image.dtype} with fractions; save raw DN as integers of 8 or 16 bit")
        if image.size and (image.min() < 0 or image.max() > np.iinfo(np.uint16).max):
            raise InputError(f"its values are {image.min():g} .. {image.max():g}; save raw DN, 0 .. 65535, unscaled")
    return np.ascontiguousarray(image, dtype=np.uint16)


class ImageFiles(FolderFiles):
    """A folder whose frames are images. `images`: the file of each frame by its path in the recording set; `pages`: its
    page in there, where that has several.

    Values are shifted down by `shift` bits. The files are decoded on access and, as spectra, aren't copied byte by
    byte."""

    def __init__(
        self, root: Path, images: Mapping[str, Path], shift: int = 0, pages: Mapping[str, int] | None = None
    ) -> None:
        super().__init__(root)
        self.images, self.shift, self.pages = dict(images), shift, dict(pages or {})

    def file(self, path: str) -> Path | None:
        return None if path in self.images or path.lower().endswith(".csv") else super().file(path)

    def spectrum(self, path: str) -> Spectrum:
        return parse_spectrum(read_foreign_csv(locate(self.root, path)).text)

    def frame(self, path: str, camera: DataSheet) -> Frame:
        frame = read_image(self.images[path], self.pages.get(path))
        if np.any(frame & ((1 << self.shift) - 1)):
            raise InputError(
                f"its codes aren't multiples of {1 << self.shift}, as those of other images of the set are; give "
                "images of one bit depth"
            )
        return np.right_shift(frame, self.shift, dtype=np.uint16)

    def where(self, path: str) -> str:
        return str(self.images[path]) if path in self.images else super().where(path)


def read_sides(file: Path) -> dict[Side, dict[str, Any]]:
    r"""Return what `camera.toml` states of each side.

    file : its keys at the top are of a single (left) camera, or of every side where it has the tables `[left]` and
        `[right]`; a missing file states nothing of the left one

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "camera.toml"
    ...     _ = file.write_text('cfa = "RGGB"\n[left]\nrows = 480\n[right]\nrows = 960\n')
    ...     read_sides(file)["right"]
    {'cfa': 'RGGB', 'rows': 960}
    """
    written: dict[str, Any] = {}
    if file.is_file():
        try:
            written = tomllib.loads(read_foreign_text(file).text)
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"{file}: isn't TOML ({error}); correct it") from error
        except InputError as error:
            raise InputError(f"{file}: {error}") from error
    sides: dict[Side, dict[str, Any]] = {}
    for side in ("left", "right"):
        if isinstance(written.get(side), dict):
            sides[side] = written.pop(side)
    if not sides:
        sides, written = {"left": written}, {}
    return {side: written | keys for side, keys in sides.items()}


def read_camera_file(file: Path, defaults: Mapping[Side, Mapping[str, Any]]) -> dict[Side, DataSheet]:
    """Return the cameras that `camera.toml` describes, by the keys of a recording set's camera. Keys that it leaves out
    come from that side's `defaults`; a missing file is an empty one."""
    cameras = {}
    for side, keys in read_sides(file).items():
        known = {key: value for key, value in keys.items() if key != "taps"}  # of the readout, not of the data sheet
        try:
            cameras[side] = DataSheet.model_validate({**defaults.get(side, {}), **known})
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in first["loc"])
            said = "is missing" if first["type"] == "missing" else first["msg"]
            raise InputError(f"{file}: {side} camera: {key}: {said}; write it in camera.toml") from error
    return cameras


#
#     [[taps]]
#     name = "A"
#     region = [0, 0, 1024, 512]          # what collects light: row0, col0, row1, col1, end excluded
#     overscan = [0, 1024, 1024, 1056]    # what the same tap reads without pixels: its bias
#     black_level_dn = 100                # in place of an overscan
#
# The regions tile a rectangle once the rows and columns that no region has are cut out: what lies between two taps has
# to be overscan, that around them may be anything. `rows`, `cols` and `cfa` of the camera are those of the joined
# frame. Each tap's black level is the mean of its overscan over the frames. Taps are shifted by whole DN to one black
# level; codes stay codes. What is left, and unequal gains, is in the frames: `--tap NAME` imports one tap alone.


#: Frames whose overscan is averaged, at most: evenly over the recording.
MOST_FRAMES = 32
#: Change of a tap's bias over the frames that is told, DN.
DRIFT_DN = 0.5

Region = tuple[int, int, int, int]


class Tap(Frozen):
    """One output of a sensor: the region that it reads, and how its black level is known."""

    name: str
    region: Region
    overscan: Region | None = None
    black_level_dn: float | None = None


@dataclass(frozen=True)
class Readout:
    """The taps of a sensor as they are imported: the rows and columns of the frame that are kept, and what is added to
    each tap's codes.

    `black_level_dn`: of the frames that come out. `remarks`: what was measured, in sentences.
    """

    taps: tuple[Tap, ...]
    rows: tuple[int, ...]
    cols: tuple[int, ...]
    shift_dn: tuple[int, ...]
    black_level_dn: float
    remarks: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frames that come out."""
        return len(self.rows), len(self.cols)

    def apply(self, frame: Frame) -> Frame:
        """Return a frame as it is stored, cropped, joined, and with its taps at one black level; codes don't fall
        below 0."""
        made = np.zeros(frame.shape, np.int64)
        for tap, shift in zip(self.taps, self.shift_dn, strict=True):
            made[_box(tap.region)] = frame[_box(tap.region)].astype(np.int64) + shift
        joined = made[np.ix_(self.rows, self.cols)]
        return np.ascontiguousarray(np.clip(joined, 0, np.iinfo(np.uint16).max), dtype=np.uint16)


class TapFiles(ImageFiles):
    """Images whose frames are cropped, joined and levelled as a `Readout` says."""

    def __init__(
        self,
        root: Path,
        images: Mapping[str, Path],
        readouts: Mapping[str, Readout],
        pages: Mapping[str, int] | None = None,
    ) -> None:
        """`readouts`: by the frame's path in the recording set."""
        super().__init__(root, images, pages=pages)
        self.readouts = dict(readouts)

    def frame(self, path: str, camera: DataSheet) -> Frame:
        frame = super().frame(path, camera)
        return self.readouts[path].apply(frame) if path in self.readouts else frame


def parse_taps(listed: Any, where: str) -> tuple[Tap, ...]:
    """Return the taps that `[[taps]]` of a camera file lists, checked.

    listed : tables with `name`, `region` and `overscan`
    where : beginning of the message

    Raises InputError for a table that isn't a tap, and for a name that two have.

    >>> parse_taps([{"name": "A", "region": [0, 0, 10, 10]}], "camera.toml")[0].name
    'A'
    """
    try:
        taps = tuple(Tap.model_validate(item) for item in listed)
    except (ValidationError, TypeError) as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else {"loc": ("taps",), "msg": "not a list"}
        key = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{where}: taps: {key}: {first['msg']}; write name, region and overscan of each") from error
    names = [tap.name for tap in taps]
    if len(set(names)) < len(names):
        raise InputError(f"{where}: taps: two have one name ({', '.join(names)}); rename one")
    return taps


def readout(taps: Sequence[Tap], files: Sequence[Path], shape: tuple[int, int], where: str) -> Readout:
    """Return how frames of `shape` (rows, cols) are cropped and levelled. Raises InputError where a region isn't inside
    the frame, the regions don't tile a rectangle, or a black level isn't known."""
    for tap in taps:
        _check_inside(tap, shape, where)
    kept_rows, kept_cols, cut = _tile_regions(taps, shape, where)
    unknown = [tap.name for tap in taps if tap.overscan is None and tap.black_level_dn is None]
    if unknown:
        raise InputError(
            f"{where}: tap {', '.join(unknown)}: neither overscan nor black_level_dn; write one of them for each tap"
        )
    measured = _overscan_means(taps, files)
    levels = []
    remarks = [f"{where}: overscan between the taps is cut out and the rest joined: {', '.join(cut)}"] if cut else []
    for tap in taps:
        means = measured.get(tap.name)
        if means is None:
            levels.append(float(tap.black_level_dn or 0.0))
            continue
        levels.append(float(np.mean(means)))
        std = float(np.std(means, ddof=1)) if len(means) > 1 else 0.0
        drift = f", which changes by {np.ptp(means):.2g} DN over the frames" if np.ptp(means) > DRIFT_DN else ""
        remarks.append(
            f"{where}: tap {tap.name}: overscan of {len(means)} frames {levels[-1]:.2f} +- "
            f"{std / np.sqrt(len(means)):.2g} DN{drift}"
        )
    common = min(levels)
    shift = tuple(-round(level - common) for level in levels)
    left = [level + moved for level, moved in zip(levels, shift, strict=True)]
    if len(taps) > 1:
        said = ", ".join(f"{tap.name} {moved:+d}" for tap, moved in zip(taps, shift, strict=True))
        remarks.append(
            f"{where}: taps shifted by whole DN to one black level ({said}); they still differ by {np.ptp(left):.2g} "
            "DN, and by their "
            "gains: --tap NAME imports one alone"
        )
    return Readout(tuple(taps), kept_rows, kept_cols, shift, float(np.mean(left)), tuple(remarks))


def _box(region: Region) -> tuple[slice, slice]:
    return slice(region[0], region[2]), slice(region[1], region[3])


def _check_inside(tap: Tap, shape: tuple[int, int], where: str) -> None:
    for name, region in (("region", tap.region), ("overscan", tap.overscan)):
        if region is None:
            continue
        row0, col0, row1, col1 = region
        if not (0 <= row0 < row1 <= shape[0] and 0 <= col0 < col1 <= shape[1]):
            raise InputError(
                f"{where}: tap {tap.name}: {name} {list(region)} isn't inside the frame of {shape[0]} x {shape[1]}; "
                "give [row0, col0, row1, col1], end excluded"
            )


def _tile_regions(
    taps: Sequence[Tap], shape: tuple[int, int], where: str
) -> tuple[tuple[int, ...], tuple[int, ...], list[str]]:
    """Return the rows and the columns that the regions tile, and the runs between them that are cut out, in words."""
    count, overscan = np.zeros(shape, np.uint8), np.zeros(shape, bool)
    for tap in taps:
        count[_box(tap.region)] += 1
        if tap.overscan is not None:
            overscan[_box(tap.overscan)] = True
    rows, cols = np.flatnonzero(count.any(axis=1)), np.flatnonzero(count.any(axis=0))
    for tap in taps:
        if tap.overscan is not None and count[_box(tap.overscan)].any():
            raise InputError(
                f"{where}: tap {tap.name}: overscan {list(tap.overscan)} holds pixels of a tap's region; correct one "
                "of them"
            )
    cut = []
    for name, kept, blank in (
        ("row", rows, np.asarray(overscan[:, cols].all(axis=1))),
        ("column", cols, np.asarray(overscan[rows].all(axis=0))),
    ):
        between = np.setdiff1d(np.arange(kept[0], kept[-1] + 1), kept)
        for run in np.split(between, np.flatnonzero(np.diff(between) > 1) + 1) if between.size else ():
            if not blank[run].all():
                raise InputError(
                    f"{where}: the taps' regions leave gaps: {name} {run[0]}..{run[-1]} belongs to no region, and "
                    "isn't all overscan; "
                    "correct the regions, or state the overscan"
                )
            cut.append(f"{name} {run[0]}..{run[-1]}")
    if np.any(count[np.ix_(rows, cols)] != 1):
        box = [int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1]
        raise InputError(f"{where}: the taps' regions leave gaps or overlap; they have to tile {box}: correct them")
    return tuple(rows.tolist()), tuple(cols.tolist()), cut


def _overscan_means(taps: Sequence[Tap], files: Sequence[Path]) -> dict[str, list[float]]:
    """Means of each tap's overscan in some of the frames, DN."""
    chosen = [files[int(i)] for i in np.unique(np.linspace(0, len(files) - 1, MOST_FRAMES).round())]
    means: dict[str, list[float]] = {}
    if all(tap.overscan is None for tap in taps):
        return means
    for file in chosen:
        frame = read_image(file, 0)
        for tap in taps:
            if tap.overscan is not None:
                means.setdefault(tap.name, []).append(float(frame[_box(tap.overscan)].mean()))
    return means
