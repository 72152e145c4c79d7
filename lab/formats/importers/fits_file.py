"""FITS files: their frames, and what a header states of the settings of a camera.

What a header leaves open isn't guessed: a value without a usable unit is a problem, with the key of the capture that
it concerns, and a value that was converted by the unit in its comment is a remark."""

from __future__ import annotations

import gzip
import io
import re
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, get_args

import numpy as np
from numpy.typing import NDArray

from lab.errors import InputError, one_line
from lab.formats.importers.frame_settings import KEYWORDS, Value, setting_of, text_of
from lab.formats.recording_set import Frame
from sim.camera import Cfa

#: Endings of FITS files; what gzip and fpack add to them; bytes that one may hold, at most: 32768 x 32768 pixels of 16
#: bit.
FITS = (".fits", ".fit", ".fts")
PACKED = (".gz", ".fz")
LARGEST_BYTES = 2 << 30
#: Planes of a cube that may be the colours of one picture as well (MaxIm, Siril).
COLOURS = 3

#: Keywords of the kind of a frame; words of their values, in small letters, and the kind of capture.
IMAGE_TYPE_KEYS = ("IMAGETYP", "OBSTYPE", "FRAMETYP", "IMGTYPE", "FRAME")
IMAGE_TYPES = {"dark": "dark", "bias": "dark", "zero": "dark", "offset": "dark", "flat": "flat"}
#: Keywords of the number of frames that were averaged or added, and the word of an image type that means so.
STACKED_KEYS, STACKED_WORD = ("NCOMBINE", "STACKCNT", "SNAPSHOT"), "master"
#: Keywords of the exposure, s where nothing states another unit, and one whose name states microseconds.
EXPOSURE_KEYS, EXPOSURE_US_KEY = ("EXPTIME", "EXPOSURE"), "EXPOINUS"
#: Relative difference of two exposures of one header up to which they are one, rounded.
SAME_EXPOSURE = 0.02
#: Keywords of the sensor's temperature as measured, and of its set point, degree C.
TEMPERATURE_KEYS = ("CCD-TEMP", "CCD_TEMP", "CCDTEMP", "DET-TEMP", "DETTEMP", "SENSTEMP", "CAMTEMP", "TEMPERAT", "TEMP")
SET_POINT_KEYS = ("SET-TEMP", "SET_TEMP", "SETTEMP")
#: Temperatures that a sensor can have, degree C: from absolute zero to the highest junction temperature of automotive
#: silicon, 125 degree C. Above it, a number is in kelvin.
ABSOLUTE_ZERO_C, HOTTEST_C = -273.15, 125.0
#: Keywords of the time of day where DATE-OBS holds a date alone, and of the time where there is no DATE-OBS.
TIME_OF_DAY_KEYS, OTHER_TIME_KEYS = ("TIME-OBS", "UTC-OBS", "UT", "UTSTART"), ("DATE-BEG", "FRAME")
#: Keywords of the pixel pitch along both axes, with binning, um.
PITCH_KEYS = ("XPIXSZ", "YPIXSZ")

#: Units of time in words, and their number of seconds.
SECONDS = {
    r"nano-?sec\w*|nsecs?|ns": 1e-9,
    r"micro-?sec\w*|usecs?|us|µs": 1e-6,
    r"milli-?sec\w*|msecs?|ms": 1e-3,
    r"seconds?|secs?|s": 1.0,
    r"minutes?": 60.0,
}
_KELVIN = re.compile(r"^\s*\[K\]|\bkelvin\b|\(K\)|\bin K\b", re.I)
_FAHRENHEIT = re.compile(r"^\s*\[F\]|\bfahrenheit\b|\(F\)|\bdeg(?:rees?)?\.?\s?F\b|°\s?F\b", re.I)


@dataclass(frozen=True)
class FitsHeader:
    """What a header states; None where it doesn't.

    `image_type`: as written; `kind`: of capture; `time`: of the first frame, UTC; `frames`: in the file; `stacked`:
    that the image is made of several frames, as stated; `cfa`: from the first stored pixel on, `mosaic_source`: by
    which keywords; `settings`: by keyword. `problems`: (key of the capture, line) of values that can't be used;
    `remarks`: what was converted or left out, in sentences without the file."""

    image_type: str | None
    kind: str | None
    exposure_s: float | None
    temperature_c: float | None
    time: datetime | None
    frames: int = 1
    stacked: str | None = None
    cfa: Cfa | None = None
    mosaic_source: str = ""
    pixel_pitch_um: float | None = None
    settings: Mapping[str, Value] = field(default_factory=dict)
    problems: tuple[tuple[str, str], ...] = ()
    remarks: tuple[str, ...] = ()


def is_fits(file: Path) -> bool:
    """Return whether a file is a FITS file by its ending, `.fits.gz` and `.fits.fz` included.

    >>> is_fits(Path("flat-1.fits.fz")), is_fits(Path("flat-1.tif"))
    (True, False)
    """
    return unpacked_name(file.name).lower().endswith(FITS)


def unpacked_name(name: str) -> str:
    """Return the name of a FITS file without the ending of its packing; other names as they are.

    >>> unpacked_name("flat-1.fits.gz"), unpacked_name("notes.gz")
    ('flat-1.fits', 'notes.gz')
    """
    inner = name[: -len(PACKED[0])] if name.lower().endswith(PACKED) else name
    return inner if inner.lower().endswith(FITS) else name


def load_fits(file: Path, plane: int | None = None) -> Frame:
    """Return the only frame of a FITS file, or that `plane` of a cube, uint16 (rows, cols) with BZERO and BSCALE
    applied. InputError without the path."""
    values, _ = _read_image(file)
    planes = _planes(values.shape)
    if planes > 1 and plane is None:
        raise InputError(f"holds {planes} frames, not 1; give a folder of frames, or save one file a frame")
    frame = values.reshape(planes, *values.shape[-2:])[plane or 0]
    if frame.dtype.kind not in "iu" and not np.array_equal(frame, np.rint(frame)):
        raise InputError(f"its values are {frame.dtype} with fractions; save raw DN as integers")
    if frame.size and (frame.min() < 0 or frame.max() > np.iinfo(np.uint16).max):
        raise InputError(
            f"its values are {frame.min():g} .. {frame.max():g}; raw DN are 0 .. 65535: save them unscaled"
        )
    return np.ascontiguousarray(frame, dtype=np.uint16)


def fits_header(file: Path, *, with_image: bool = True, ignored: Collection[str] = ()) -> FitsHeader:
    """Return what the header says; InputError without the path. Without `with_image`, the image isn't read, and damage
    in it stays unseen. `ignored`: keywords that count as not there."""
    header = (_read_image(file)[1] if with_image else _header(file)).copy()
    for keyword in ignored:
        header.remove(keyword, ignore_missing=True, remove_all=True)
    fields = _Reading(header)
    exposure_s = fields.exposure_s()
    temperature_c = fields.temperature_c()
    time = fields.time()
    cfa = _cfa(header)
    if header.get("BSCALE", 1) != 1:
        fields.remarks.append(f"BSCALE = {header['BSCALE']:g}: codes are multiples of it")
    stated = next((str(header[key]).strip() for key in IMAGE_TYPE_KEYS if _kind_of(header.get(key))), None)
    written = next((str(header[key]).strip() for key in IMAGE_TYPE_KEYS[:-1] if header.get(key) is not None), None)
    stacked = next((f"{key} = {header[key]}" for key in STACKED_KEYS if _is_above_one(header.get(key))), None)
    if stacked is None and STACKED_WORD in (stated or written or "").lower():
        stacked = f"image type {stated or written}"
    return FitsHeader(
        image_type=stated or written,
        kind=_kind_of(stated),
        exposure_s=exposure_s,
        temperature_c=temperature_c,
        time=time,
        frames=_planes_of(header),
        stacked=stacked,
        cfa=cfa,
        mosaic_source="" if cfa is None else _mosaic_source(header),
        pixel_pitch_um=_pitch_um(header),
        settings=_settings(header),
        problems=tuple(fields.problems),
        remarks=tuple(fields.remarks),
    )


def has_keyword(file: Path, keyword: str) -> bool:
    """Return whether the header of a FITS file has a keyword."""
    return keyword in _header(file)


@contextmanager
def _stream(file: Path) -> Iterator[IO[bytes]]:
    """The file's bytes, uncompressed. Raises InputError where there are too many of them."""
    if not file.name.lower().endswith(".gz"):
        with file.open("rb") as stream:
            yield stream
        return
    held = io.BytesIO()
    with gzip.open(file) as packed:
        while part := packed.read(1 << 20):
            held.write(part)
            if held.tell() > LARGEST_BYTES:
                raise InputError(f"holds more than the limit of {LARGEST_BYTES} bytes; save one frame a file")
    held.seek(0)
    yield held


def _join_headers(first: Any, image: Any) -> Any:
    """Return the header of an image with what that of the file's beginning adds to it."""
    if image is first:
        return image.header
    header = image.header.copy()
    header.extend(first.header, unique=True)
    return header


def _header(file: Path) -> Any:
    """Return the header of the first image that isn't empty, with that of the file's beginning."""
    from astropy.io import fits

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with _stream(file) as stream, fits.open(stream, memmap=False, lazy_load_hdus=True) as opened:
                first = opened[0]
                image = next((hdu for hdu in opened if getattr(hdu, "is_image", False) and hdu.header["NAXIS"]), first)
                return _join_headers(first, image)
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"damaged FITS ({one_line(error)}); copy it again or recapture") from error


def _read_image(file: Path) -> tuple[NDArray[Any], Any]:
    """Return the image's values and header. A file whose data or checksum is damaged is refused."""
    from astropy.io import fits
    from astropy.io.fits.verify import VerifyWarning
    from astropy.utils.exceptions import AstropyUserWarning

    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyUserWarning)  # truncated, or a wrong checksum
        warnings.simplefilter("ignore", VerifyWarning)  # a header that is only untidy
        try:
            with _stream(file) as stream, fits.open(stream, memmap=False, checksum=True) as opened:
                images = [hdu for hdu in opened if getattr(hdu, "is_image", False) and hdu.data is not None]
                names = [hdu.name or f"extension {opened.index_of(hdu)}" for hdu in images]
                values_and_headers = [(np.asarray(hdu.data), _join_headers(opened[0], hdu)) for hdu in images]
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"damaged FITS ({one_line(error)}); copy it again or recapture") from error
    if not values_and_headers:
        raise InputError("holds no image; save one image a file")
    if len(values_and_headers) > 1:
        raise InputError(
            f"holds {len(values_and_headers)} images, not 1 ({', '.join(names)}); where they are the outputs of one "
            "sensor, join them to one image and describe them by [[taps]] in camera.toml; where they are frames, save "
            "one file a frame"
        )
    return values_and_headers[0]


def _planes(shape: tuple[int, ...]) -> int:
    """Return the number of frames in an array of a shape; InputError where that can't be known."""
    outer = [size for size in shape[:-2] if size != 1]
    if len(shape) < 2 or len(outer) > 1:
        raise InputError(f"has the shape {shape}, not (rows, cols) or (frames, rows, cols); save one file a frame")
    if outer == [COLOURS]:
        raise InputError(
            f"has the shape {shape}: its {COLOURS} planes may be colours or frames; save the raw mosaic, or one file "
            "a frame"
        )
    return outer[0] if outer else 1


def _planes_of(header: Any) -> int:
    """Return the number of frames that a header announces; 1 where its shape is none of a frame."""
    shape = tuple(int(header.get(f"NAXIS{axis}", 1)) for axis in range(int(header.get("NAXIS", 0)), 0, -1))
    try:
        return _planes(shape)
    except InputError:
        return 1


def _kind_of(value: Any) -> str | None:
    """Return the kind of capture that an image type means; None for any other."""
    words = str(value).lower() if value is not None else ""
    return next((kind for word, kind in IMAGE_TYPES.items() if word in words), None)


def _float(value: Any) -> float | None:
    """Return a finite number, written with a decimal comma or point; None where a value isn't one."""
    text = str(value).strip()
    if re.fullmatch(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?", text) and not re.fullmatch(r"[-+]?[1-9]\d{0,2},\d{3}", text):
        text = text.replace(",", ".")  # 1,250 may be a thousand
    try:
        number = float(text) if not isinstance(value, bool) else np.nan
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def _is_above_one(value: Any) -> bool:
    number = _float(value)
    return number is not None and number > 1


def _setting(value: Any) -> Value | None:
    """Return a setting as a number or a text; None where it is empty."""
    if isinstance(value, bool) or value is None:
        return None if value is None else str(value)
    number = _float(value)
    return number if number is not None else (" ".join(str(value).split()) or None)


def _settings(header: Any) -> dict[str, Value]:
    """Return the listed settings that a header states, in the order of the list, and what else seems to be one."""
    others = sorted(key for key in set(header) - set(KEYWORDS) if setting_of(key) is not None)
    return {key: value for key in (*KEYWORDS, *others) if (value := _setting(header.get(key))) is not None}


def _pitch_um(header: Any) -> float | None:
    pitches_um = {number for key in PITCH_KEYS if (number := _float(header.get(key)))}
    return pitches_um.pop() if len(pitches_um) == 1 else None


def _cfa(header: Any) -> Cfa | None:
    """Return the mosaic from the first stored pixel on; None where none is stated, or where binning has mixed it.

    BAYERPAT begins at the first pixel of the picture's top row, XBAYROFF and YBAYROFF pixels into the pattern. With
    ROWORDER BOTTOM-UP the top row is stored last."""
    pattern = str(header.get("BAYERPAT", header.get("COLORTYP", ""))).strip().upper()
    if pattern not in get_args(Cfa) or pattern == "MONO":
        return None
    if any(_is_above_one(header.get(key)) for key in ("XBINNING", "YBINNING")):
        return None
    col0, row0 = (int(_float(header.get(key)) or 0) for key in ("XBAYROFF", "YBAYROFF"))
    if "BOTTOM" in str(header.get("ROWORDER", "")).upper():
        row0, down = row0 + int(header.get("NAXIS2", 0)) - 1, -1
    else:
        down = 1
    places = [((row0 + down * row) % 2, (col0 + col) % 2) for row in (0, 1) for col in (0, 1)]
    made = "".join(pattern[2 * row + col] for row, col in places)
    return next(cfa for cfa in get_args(Cfa) if cfa == made)


def _mosaic_source(header: Any) -> str:
    """Return by what a header states its mosaic, and how that is set aside, in words."""
    keys = ("BAYERPAT", "COLORTYP", "XBAYROFF", "YBAYROFF", "ROWORDER")
    stated = ", ".join(f"{key} = {text_of(value)}" for key in keys if (value := _setting(header.get(key))) is not None)
    return f" from the first stored pixel on ({stated}; where that is wrong, --ignore {stated.partition(' ')[0]})"


class _Reading:
    """The quantities of one header, with what was found in reading them."""

    def __init__(self, header: Any) -> None:
        self.header = header
        self.problems: list[tuple[str, str]] = []
        self.remarks: list[str] = []

    def exposure_s(self) -> float | None:
        stated_s: dict[str, float] = {}
        for key in EXPOSURE_KEYS:
            if self.header.get(key) is not None:
                seconds = self._seconds(key)
                if seconds is None:
                    return None
                stated_s[key] = seconds
        if not stated_s and (us := _float(self.header.get(EXPOSURE_US_KEY))) is not None:
            self.remarks.append(f"{EXPOSURE_US_KEY} = {us:g} is in us by its name: read as {us / 1e6:g} s")
            return us / 1e6
        if len(stated_s) > 1 and np.ptp(list(stated_s.values())) > SAME_EXPOSURE * max(stated_s.values()):
            listed = ", ".join(f"{key} = {value:g} s" for key, value in stated_s.items())
            line = (
                f"its header states two exposures ({listed}); write exposure_s into index.csv, or ignore one, "
                f"--ignore {list(stated_s)[-1]}"
            )
            self.problems.append(("exposure_s", line))
            return None
        return next(iter(stated_s.values()), None)

    def _seconds(self, key: str) -> float | None:
        value, comment = self.header[key], str(self.header.comments[key])
        parts = re.fullmatch(r"\s*([-+\d.,eE]+?)\s*([a-zA-Zµ]*)\.?\s*", str(value))
        number = _float(parts[1]) if parts else None
        if number is None or parts is None or (parts[2] and not _units(parts[2])):
            self.problems.append(("exposure_s", f"{key} = {value!r} isn't a number; write exposure_s into index.csv"))
            return None
        bracket = re.match(r"\s*[\[(]([^\])]*)[\])]", comment)
        of_comment = _units(bracket[1]) if bracket and _units(bracket[1]) else _units(comment)
        units = _units(parts[2]) if parts[2] else of_comment
        if len(units) > 1 or (parts[2] and of_comment and units != of_comment):
            line = f"{key} = {value} / {comment}: states several units; write exposure_s into index.csv"
            self.problems.append(("exposure_s", line))
            return None
        (factor,) = units or {1.0}
        if factor != 1.0:
            self.remarks.append(
                f"{key} = {value} is in units of {factor:g} s by its {'value' if parts[2] else 'comment'}: read as "
                f"{number * factor:g} s"
            )
        return number * factor

    def temperature_c(self) -> float | None:
        for key in (*TEMPERATURE_KEYS, *SET_POINT_KEYS):
            value = self.header.get(key)
            if value is None or not str(value).strip():
                continue
            celsius = self._celsius(key, value)
            if key in SET_POINT_KEYS and celsius is not None:
                self.remarks.append(f"no measured temperature: the set point {key} = {celsius:g} degree C is used")
            return celsius
        return None

    def _celsius(self, key: str, value: Any) -> float | None:
        number = _float(re.sub(r"\s*(deg(ree)?s?)?\.?\s*[°]?C\s*$", "", str(value)))
        if number is None:
            line = f"{key} = {value!r} isn't a number; write temperature_c into index.csv, or --ignore {key}"
            self.problems.append(("temperature_c", line))
            return None
        if _KELVIN.search(str(self.header.comments[key])):
            celsius = number + ABSOLUTE_ZERO_C
            self.remarks.append(f"{key} = {number:g} is in kelvin by its comment: read as {celsius:g} degree C")
            return round(celsius, 9)
        if _FAHRENHEIT.search(str(self.header.comments[key])):
            celsius = (number - 32.0) / 1.8
            self.remarks.append(f"{key} = {number:g} is in degree F by its comment: read as {celsius:g} degree C")
            return round(celsius, 9)
        if not ABSOLUTE_ZERO_C <= number <= HOTTEST_C:
            meant = f", {number + ABSOLUTE_ZERO_C:g} degree C if in kelvin" if number > HOTTEST_C else ""
            line = (
                f"{key} = {number:g} is outside the {ABSOLUTE_ZERO_C:g} .. {HOTTEST_C:g} degree C of a sensor{meant}; "
                f"write temperature_c into index.csv, begin the comment of {key} with [K], or --ignore {key}"
            )
            self.problems.append(("temperature_c", line))
            return None
        return number

    def time(self) -> datetime | None:
        stated = self.header.get("DATE-OBS")
        if stated is None:
            return next((time for key in OTHER_TIME_KEYS if (time := _time(self.header.get(key))) is not None), None)
        date = str(stated).strip()
        if re.fullmatch(r"\d{4}-\d{2}-\d{2}", date):
            of_day = next((str(self.header[key]).strip() for key in TIME_OF_DAY_KEYS if self.header.get(key)), "")
            time = _time(f"{date}T{of_day}") if of_day else None
        else:
            of_day, time = "", _time(date)
        scale = str(self.header.get("TIMESYS", "UTC")).strip().upper()
        if scale not in ("UTC", "UT", ""):
            self.remarks.append(f"times in {scale} (TIMESYS) aren't UTC and are left out")
            return None
        if time is None:
            also = f" with {of_day}" if of_day else ""
            self.remarks.append(f"DATE-OBS{also} states no time of day that is ISO 8601: time is left out")
        return time


def _units(text: str) -> set[float]:
    """Return the units of time that a text names, in seconds."""
    return {factor for words, factor in SECONDS.items() if re.search(rf"(?<![\w'])(?:{words})(?![\w'])", text, re.I)}


def _time(stated: Any) -> datetime | None:
    text = str(stated).strip()
    if not re.match(r"\d{4}-\d{2}-\d{2}[T ]\d", text):
        return None
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return None
    return time if time.tzinfo is not None else time.replace(tzinfo=UTC)
