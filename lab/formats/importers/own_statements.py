"""What the file of a frame states of its samples and of the sensor, compared with what is stated for it.

A file's own mosaic is written by the camera: one that contradicts a stated mosaic is refused. Other differences are one
line each. Frames stay as stored, whatever an Orientation asks a viewer to do."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import rawpy
import tifffile
from pydantic import ValidationError

from lab.errors import InputError
from lab.formats.importers.fits_file import fits_header, is_fits
from lab.formats.pictures import IMAGES, TIFFS, PictureFacts, picture_facts
from lab.formats.raw_file import TiffDescription
from lab.formats.recording_set import RAWS, DataSheet
from sim.camera import Cfa

#: Orientation of EXIF for each turn that LibRaw states.
RAW_TURNS = {3: 3, 5: 8, 6: 6}
MOSAICS = tuple(name for name in get_args(Cfa) if name != "MONO")
#: Letters of the colours in a TIFF's CFAPattern, in its order (TIFF/EP).
CFA_COLOURS = "RGBCMYW"
#: Difference of two levels from which on they contradict each other, DN: files state whole numbers.
SAME_DN = 1.0


@dataclass(frozen=True)
class SensorFacts:
    """What a frame's file states of the sensor. None: not stated.

    `cfa`: of the frame as it is read, from pixel [0, 0]; `mosaic_source`: by what, in words. `black_dn`: of each
    colour; `white_dn`: the highest code.
    """

    cfa: str | None = None
    bit_depth: int | None = None
    black_dn: tuple[float, ...] = ()
    white_dn: float | None = None
    orientation: int = 1
    mosaic_source: str = ""

    @property
    def black_level_dn(self) -> float | None:
        """Mean black level of the colours, DN; None where none is stated."""
        return float(np.mean(self.black_dn)) if any(self.black_dn) else None


def sensor_facts(file: Path, shape: tuple[int, int] | None = None, ignored: Collection[str] = ()) -> SensorFacts:
    """Return what a raw file, a FITS header without `ignored` keywords, or a TIFF by its CFAPattern or a description by
    calibench, states of its sensor; `shape`: of the frame that is read from a raw. Raises InputError, without the path,
    for a mosaic that calibench has no name for."""
    suffix = file.suffix.lower()
    if suffix in TIFFS:
        return _tiff_facts(file)
    if suffix not in RAWS:
        return _fits_facts(file, ignored) if is_fits(file) else SensorFacts()
    try:
        with rawpy.imread(str(file)) as raw:
            turned = RAW_TURNS.get(int(raw.sizes.flip), 1)
            levels = tuple(float(level) for level in raw.black_level_per_channel)
            if raw.raw_pattern is None or raw.num_colors == 1:
                return SensorFacts(
                    "MONO" if raw.num_colors == 1 else None, None, levels, float(raw.white_level), turned
                )
            period, names = raw.raw_pattern.shape, raw.color_desc.decode()
            # LibRaw's colours count from the visible area
            is_visible = shape in (None, (raw.sizes.height, raw.sizes.width))
            row, col = (0, 0) if is_visible else (raw.sizes.top_margin, raw.sizes.left_margin)
            letters = "".join(names[raw.raw_color((row + i) % 2, (col + j) % 2)] for i in range(2) for j in range(2))
            white = float(raw.white_level)
    except rawpy.LibRawError:
        return SensorFacts()
    return SensorFacts(_known_mosaic(period, letters, names), None, levels, white, turned)


def _known_mosaic(period: tuple[int, ...], letters: str, names: str) -> str:
    """Return the letters of a mosaic of 2 x 2 pixels, row by row. Raises InputError where calibench has no name for it;
    `names`: of its colours."""
    if period != (2, 2) or letters not in MOSAICS:
        raise InputError(
            f"has a mosaic of {period[0]} x {period[1]} pixels in the colours {names}, not one of "
            f"{', '.join(MOSAICS)}; give frames of such a sensor"
        )
    return letters


def _tiff_facts(file: Path) -> SensorFacts:
    try:
        with tifffile.TiffFile(file) as tif:
            tags = tif.pages[0].tags
            description = str(tags.valueof("ImageDescription"))
            period, pattern = tags.valueof("CFARepeatPatternDim"), tags.valueof("CFAPattern")
    except (OSError, ValueError, IndexError, tifffile.TiffFileError):
        return SensorFacts()
    try:
        parsed = TiffDescription.model_validate_json(description)
        return SensorFacts(parsed.cfa, parsed.bit_depth, (parsed.black_level_dn,), parsed.white_level_dn)
    except ValidationError:
        pass
    if period is None or not isinstance(pattern, bytes) or len(period) != 2 or max(pattern) >= len(CFA_COLOURS):
        return SensorFacts()
    letters = "".join(CFA_COLOURS[colour] for colour in pattern)
    return SensorFacts(_known_mosaic(tuple(period), letters, "".join(dict.fromkeys(letters))))


def _fits_facts(file: Path, ignored: Collection[str]) -> SensorFacts:
    header = fits_header(file, with_image=False, ignored=ignored)
    return SensorFacts(header.cfa, mosaic_source=header.mosaic_source)


def read_known_keys(file: Path, shape: tuple[int, int], ignored: Collection[str] = ()) -> dict[str, Any]:
    """Return the keys of a camera that a frame's file states, for a camera file that leaves them out."""
    facts = sensor_facts(file, shape, ignored)
    bits = picture_facts(file).bits if file.suffix.lower() in TIFFS else None
    known = {"cfa": facts.cfa, "bit_depth": facts.bit_depth or bits, "black_level_dn": facts.black_level_dn}
    return {key: value for key, value in known.items() if value is not None}


def list_keys_taken(stated: Collection[str], known: Mapping[str, Any], file: Path) -> list[str]:
    """Return the line for keys of a camera that nobody states and that its first frame's file has.

    stated : keys that somebody states
    known : of the file, as `read_known_keys` returns them
    file : the frame's

    >>> len(list_keys_taken([], {"cfa": "RGGB"}, Path("flat-1.dng")))
    1
    """
    taken = [f"{key} = {_text(value)}" for key, value in known.items() if key not in stated]
    return [f"{file}: {', '.join(taken)}: not stated, and taken from this file"] if taken else []


def compare_with_files(
    camera: DataSheet,
    stated: Collection[str],
    files: Iterable[Path],
    boards: Collection[Path] = (),
    ignored: Collection[str] = (),
    *,
    is_whole: bool = True,
) -> list[str]:
    """Return one line for each kind of thing that the files of a camera's frames state and that isn't as stated, or
    that changes the codes. Raises InputError where a file's own mosaic isn't the stated one.

    `stated`: keys of the camera that somebody states. `boards`: files of boards, whose corners JPEG hardly moves.
    `is_whole`: the camera's frames are the files', not joined of the parts that taps read. `ignored`: keywords of
    headers that aren't used."""
    files_of_line: dict[str, list[Path]] = {}
    for file in dict.fromkeys(files):
        try:
            facts = sensor_facts(file, (camera.rows, camera.cols), ignored) if is_whole else SensorFacts()
            picture = picture_facts(file) if file.suffix.lower() in IMAGES else PictureFacts("")
        except InputError as error:
            raise InputError(f"{file}: {error}") from error
        if facts.cfa is not None and camera.cfa not in (facts.cfa, "MONO") and facts.cfa != "MONO":
            raise InputError(
                f"{file}: cfa = {camera.cfa} is stated, but the file's own mosaic is {facts.cfa}{facts.mosaic_source}: "
                "correct cfa, or leave it out"
            )
        lines = (*_sensor_lines(camera, stated, facts), *_picture_lines(camera, picture, is_board=file in boards))
        for line in lines:
            files_of_line.setdefault(line, []).append(file)
        if turned := {facts.orientation, picture.orientation} - {1}:
            files_of_line.setdefault(
                f"its Orientation is {turned.pop()}, which turns it for a viewer: the frame is taken as stored, and "
                "cfa, regions and corners count from its first stored pixel",
                [],
            ).append(file)
    return [f"{concerned[0]}{_more(concerned)}: {line}" for line, concerned in files_of_line.items()]


def _sensor_lines(camera: DataSheet, stated: Collection[str], facts: SensorFacts) -> Iterable[str]:
    if facts.cfa is not None and camera.cfa != facts.cfa:
        yield f"cfa = {camera.cfa} is stated, but the file's own mosaic is {facts.cfa}; the former is used"
    if len({round(level, 3) for level in facts.black_dn}) > 1:
        levels = ", ".join(f"{level:g}" for level in facts.black_dn)
        yield f"its file states one black level a colour ({levels} DN): black_level_dn is one for all"
    for key, of_file in (
        ("bit_depth", facts.bit_depth),
        ("black_level_dn", facts.black_level_dn),
        ("white_level_dn", facts.white_dn),
    ):
        value = camera.saturation_dn if key == "white_level_dn" else getattr(camera, key)
        if of_file is None or value is None or abs(value - of_file) <= (SAME_DN if key.endswith("_dn") else 0):
            continue
        if key in stated:
            yield f"{key} = {value:g}, its file states {of_file:g}; the former is used: correct what is wrong"
        elif key == "white_level_dn":
            yield f"the highest code is taken as {value:g} DN (bit_depth), its file states {of_file:g}: state {key}"


def _picture_lines(camera: DataSheet, picture: PictureFacts, *, is_board: bool) -> Iterable[str]:
    if picture.form == "TIFF" and picture.bits is not None and picture.bits != camera.bit_depth:
        yield f"its file states {picture.bits} bits a sample, bit_depth is {camera.bit_depth}; correct what is wrong"
    if picture.form == "PNG" and picture.bits is not None:
        yield f"its file states {picture.bits} significant bits a sample (sBIT): codes may be multiples of a step"
    if picture.is_lossy and not is_board:
        yield (
            "is a JPEG: its codes are rounded by the compression, which changes noise and sharpness, and usually "
            "follow a screen's tone curve; give raw frames or PNG for figures"
        )


def subsampling_remark(picture: PictureFacts) -> str | None:
    """Return what subsampled colour differences do to the channels of a picture; None where there are none."""
    across, down = picture.subsampling
    if across * down == 1:
        return None
    return (
        f"a JPEG with one sample of colour difference for {across} x {down} pixels: fine detail of each channel is "
        "that of the luminance, so that no channel's sharpness is its own"
    )


def _more(files: Sequence[Path]) -> str:
    return f" and {len(files) - 1} more" if len(files) > 1 else ""


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
