"""What is stated of the frames' settings, compared with limits, the frames' own files and the times between them.

A contradiction is one line with the file and both values. Three of them can't be anything but a slip and are refused:
an exposure that no frame has, one that is off by a unit, and rows that fit their frames when all are moved by one."""

from __future__ import annotations

import io
import logging
import re
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import log10
from operator import itemgetter
from pathlib import Path
from typing import Any

import rawpy
import tifffile
from pydantic import ValidationError

from lab.capture_kinds.base import Capture
from lab.errors import InputError
from lab.formats.importers.fits_file import FitsHeader, fits_header, is_fits
from lab.formats.importers.frame_settings import (
    ALL_FRAMES,
    F_NUMBER_FACTOR,
    HeaderChoice,
    StatedFrame,
    compare_settings,
    text_of,
)
from lab.formats.raw_file import TiffDescription
from lab.formats.recording_set import RAWS, DataSheet, InstrumentSnapshot, Manifest, RecordingError
from lab.formats.recording_set.manifest import Value

# ----------------------------------------------------------------------------------------------------------------------
# What a frame's own file says of how it was taken: EXIF of JPEG, PNG and TIFF, the metadata of camera raws, the header
# of FITS frames.
#
# EXIF (CIPA DC-008) has `ExposureTime`, `FNumber` and `PhotographicSensitivity`; a file that states one of them as 0
# doesn't know it. Only headers are read. What can't be read is unknown here: that the frame itself is damaged is told
# where it is decoded.


#: Bytes of a JPEG or PNG file in which its EXIF is looked for: it stands before the picture.
HEAD_BYTES = 1 << 20
#: EXIF's WhiteBalance in words.
WHITE_BALANCE = {0: "auto", 1: "manual"}
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"


@dataclass(frozen=True)
class FrameHeader:
    """How a frame was taken, by its own file. None: not stated. `source`: what states it, in a word; `camera`: which
    camera did, and how it was set; `stacked`: that the frame is made of several; `settings`: those of `frame_settings`,
    by keyword; `problems`: (key of the capture, line) of values that can't be used; `remarks`: values that were
    converted."""

    source: str
    exposure_s: float | None = None
    f_number: float | None = None
    iso: float | None = None
    gain_db: float | None = None
    temperature_c: float | None = None
    camera: InstrumentSnapshot | None = None
    pixel_pitch_um: float | None = None
    stacked: str | None = None
    settings: Mapping[str, str | float] = field(default_factory=dict)
    problems: tuple[tuple[str, str], ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def is_marked(self) -> bool:
        """Whether a camera wrote its settings as its dials are marked, in thirds of a stop."""
        return self.source in ("EXIF", "metadata")


def frame_header(file: Path, ignored: Collection[str] = ()) -> FrameHeader | None:
    """Return the header of a frame's file without `ignored` keywords; None where it states nothing that is known
    here."""
    suffix = file.suffix.lower()
    header: FrameHeader | None = None
    try:
        if is_fits(file):
            return _of_fits(fits_header(file, with_image=False, ignored=ignored))
        if suffix in RAWS:
            header = _of_raw(file)
        elif suffix in (".tif", ".tiff"):
            with file.open("rb") as stream:
                header = _of_tiff(stream)
        elif suffix in (".jpg", ".jpeg", ".png"):
            with file.open("rb") as stream:
                data = stream.read(HEAD_BYTES)
            block = _exif_of_png(data) if data.startswith(PNG) else _exif_of_jpeg(data)
            header = _of_tiff(io.BytesIO(block)) if block is not None else None
    except (OSError, InputError, rawpy.LibRawError):
        return None
    if header is None or not ignored:
        return header
    return replace(header, settings={key: value for key, value in header.settings.items() if key not in ignored})


def _of_fits(header: FitsHeader) -> FrameHeader:
    settings = dict(header.settings)
    model, serial = (text_of(settings[key]) if key in settings else "" for key in ("INSTRUME", "SERNO"))
    camera = InstrumentSnapshot(model=model, serial_number=serial, settings=settings) if model or serial else None
    return FrameHeader(
        "FITS header",
        exposure_s=header.exposure_s,
        temperature_c=header.temperature_c,
        camera=camera,
        pixel_pitch_um=header.pixel_pitch_um,
        settings=settings,
        stacked=header.stacked,
        problems=header.problems,
        remarks=header.remarks,
    )


def _of_raw(file: Path) -> FrameHeader | None:
    with file.open("rb") as stream:  # most raws are TIFF
        tags = _of_tiff(stream)
    with rawpy.imread(str(file)) as raw:
        taken = getattr(raw, "other", None)  # older versions don't tell it
        if taken is None:
            return None
        f_number, iso = _above_zero(taken.aperture), _above_zero(taken.iso_speed)
        settings = dict(tags.settings) if tags is not None else {}
        of_dials = {"FNumber": f_number, "ISO": iso, "FocalLength": _above_zero(taken.focal_length)}
        return FrameHeader(
            "metadata",
            exposure_s=_above_zero(taken.shutter_speed),
            f_number=f_number,
            iso=iso,
            camera=tags.camera if tags is not None else None,
            settings=settings | {key: value for key, value in of_dials.items() if value is not None},
        )


def _of_tiff(stream: Any) -> FrameHeader | None:
    """Return the tags of a TIFF, which EXIF is too, in its first directory and in the one of EXIF."""
    with _silent():
        try:
            with tifffile.TiffFile(stream) as opened:
                tags: dict[str, Any] = {tag.name: tag.value for tag in opened.pages[0].tags.values()}
        except Exception:  # damaged: nothing is known
            return None
    inner = tags.get("ExifTag")
    tags |= inner if isinstance(inner, dict) else {}
    try:
        description = TiffDescription.model_validate_json(str(tags.get("ImageDescription", "")))
        return FrameHeader("description", exposure_s=_above_zero(description.exposure_s), gain_db=description.gain_db)
    except ValidationError:
        pass
    f_number = _above_zero(tags.get("FNumber"))
    iso = _above_zero(tags.get("PhotographicSensitivity", tags.get("ISOSpeedRatings")))
    stated: dict[str, str | float | None] = {"FNumber": f_number, "ISO": iso}
    stated["FocalLength"] = _above_zero(tags.get("FocalLength"))
    stated |= {key: _text(tags.get(key)) or None for key in ("Model", "BodySerialNumber")}
    return FrameHeader(
        "EXIF",
        exposure_s=_above_zero(tags.get("ExposureTime")),
        f_number=f_number,
        iso=iso,
        camera=_camera(tags),
        settings={key: value for key, value in stated.items() if value is not None},
    )


def _camera(tags: Mapping[str, Any]) -> InstrumentSnapshot | None:
    """Return the camera that EXIF names, with its settings as EXIF states them; None where it names none."""
    maker, model, serial = (_text(tags.get(name)) for name in ("Make", "Model", "BodySerialNumber"))
    if not (maker or model or serial):
        return None
    settings: dict[str, Value] = {name: text for name in ("LensModel", "Software") if (text := _text(tags.get(name)))}
    if (balance := tags.get("WhiteBalance")) in WHITE_BALANCE:
        settings["WhiteBalance"] = WHITE_BALANCE[balance]
    return InstrumentSnapshot(maker=maker, model=model, serial_number=serial, settings=settings)


def _text(value: Any) -> str:
    return " ".join(str(value).split("\0")[0].split()) if isinstance(value, str) else ""


def _above_zero(value: Any) -> float | None:
    """Return a number or a fraction (numerator, denominator); None where it isn't one, or isn't above 0."""
    try:
        if isinstance(value, tuple) and len(value) == 2:
            value = value[0] / value[1]
        elif isinstance(value, tuple):
            value = value[0]
        number = float(value)
    except (TypeError, ValueError, ArithmeticError, IndexError):
        return None
    return number if 0.0 < number < float("inf") else None


def _exif_of_jpeg(data: bytes) -> bytes | None:
    at = 2
    while data[:2] == JPEG and at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:  # up to the picture
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return data[at + 10 : at + 2 + length]
        at += 2 + length
    return None


def _exif_of_png(data: bytes) -> bytes | None:
    at = len(PNG)
    while at + 8 <= len(data):
        length, name = struct.unpack(">I4s", data[at : at + 8])
        if name == b"eXIf":
            return data[at + 8 : at + 8 + length]
        at += 12 + length
    return None


@contextmanager
def _silent() -> Iterator[None]:
    """Drop the library's remarks on a directory without a picture, as EXIF is."""
    log = logging.getLogger("tifffile")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before


#: Longest exposure that is taken without a header that says it (that of a sequence's darks), and of one with light that
#: isn't told, s.
LONGEST_S, LONGEST_LIT_S = 3600.0, 60.0
#: Factor within which a shutter that is marked in thirds of a stop is meant, half of a third: 1/60 s is 1/64 s. Others
#: are measured: relative.
MARKED_FACTOR, MEASURED_SHARE = 2.0 ** (1.0 / 6.0), 0.02
#: Difference of two gains that ISO speeds, marked in thirds of a stop (2 dB), leave open, dB; and of temperatures,
#: degree C.
GAIN_DB, TEMPERATURE_C = 1.0, 1.0
#: Relative difference of two pixel pitches that rounding leaves open: data sheets have two to three digits.
PITCH_SHARE = 0.02
#: What a time that is written to the second leaves open, s.
CLOCK_S = 1.0
#: Factors between units of time.
UNIT_FACTORS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
#: Fewest frames that tell whether all rows are moved, and that contradict theirs.
FEWEST_ROWS, FEWEST_OFF = 4, 2


def check_against_frames(
    manifest: Manifest, images: Mapping[str, Path], where: str, choice: HeaderChoice = ALL_FRAMES
) -> tuple[Manifest, list[str]]:
    """Return the manifest with what the frames' own files add to it: cameras, temperatures and gains (dB) that it
    leaves open; and one line for each quantity that these files contradict or convert, and for exposures that are
    hardly meant in seconds.

    `images`: the file of each frame by its path. Raises InputError where the exposures can't be right, frames are made
    of several, or settings differ between frames that are fitted together: `where` names what lists
    them."""
    by_file = {file: frame_header(file, choice.ignored) for file in dict.fromkeys(images.values())}
    seen = [
        _HeaderSeen(capture, images[capture.frame], header)
        for capture in manifest.captures
        if (header := by_file[images[capture.frame]]) is not None
    ]
    whole, lines = _complete_from_headers(manifest, seen)
    places = {id(capture): place for place, capture in enumerate(manifest.captures)}
    seen = [replace(frame, capture=whole.captures[places[id(frame.capture)]]) for frame in seen]
    manifest = whole
    lines += _contradictions(manifest, seen, images, where)
    problems, uneven = compare_settings(
        [StatedFrame(frame.capture, frame.file, frame.header.settings) for frame in seen], where
    )
    for side, camera in manifest.cameras.items():
        frames = [frame for frame in seen if frame.capture.side == side]
        problems += _stacked_line(frames)
        lines += _other_pitch(frames, camera)
    if problems:
        raise RecordingError(problems)
    cameras = {
        f"camera {side}": _named_camera([frame for frame in seen if frame.capture.side == side])
        for side in manifest.cameras
    }
    there = {name: camera for name, camera in cameras.items() if camera is not None}
    return manifest.model_copy(update={"instruments": there}) if there else manifest, lines + uneven + _remarks(seen)


def _complete_from_headers(manifest: Manifest, seen: Sequence[_HeaderSeen]) -> tuple[Manifest, list[str]]:
    """Return the manifest with temperatures and gains that it leaves open and the frames' own files state, and a line
    for each quantity."""
    captures = {id(capture): capture for capture in manifest.captures}
    lines = []
    for key, unit in (("temperature_c", "degree C"), ("gain_db", "dB")):
        added = [
            frame for frame in seen if getattr(frame.capture, key) is None and getattr(frame.header, key) is not None
        ]
        for frame in added:
            known = {key: getattr(frame.header, key)}
            captures[id(frame.capture)] = captures[id(frame.capture)].model_copy(update=known)
        if added:
            values = [getattr(frame.header, key) for frame in added]
            span = f"{min(values):g}" + (f" .. {max(values):g}" if max(values) > min(values) else "")
            lines.append(f"{added[0].file}: {key} = {span} {unit} by its {added[0].header.source}{_and(added)}")
    if not lines:
        return manifest, []
    return manifest.model_copy(update={"captures": tuple(captures.values())}), lines


def _named_camera(frames: Sequence[_HeaderSeen]) -> InstrumentSnapshot | None:
    """Return the camera that the frames of one side name, with the settings that all of them share."""
    named = [frame.header.camera for frame in frames if frame.header.camera is not None]
    if not named:
        return None
    shared = {
        key: value
        for key, value in named[0].settings.items()
        if all(camera.settings.get(key) == value for camera in named)
    }
    return named[0].model_copy(update={"settings": shared})


def _stacked_line(frames: Sequence[_HeaderSeen]) -> list[str]:
    """Return the line for frames that are means or sums of several."""
    off = [frame for frame in frames if frame.header.stacked is not None and frame.capture.codes_are_fitted]
    if not off:
        return []
    line = (
        f"{off[0].file}: {off[0].header.stacked}{_and(off)}: made of several frames, whose noise isn't one frame's; "
        "give the single frames, or where the header is wrong, --ignore its keyword"
    )
    return [line]


def _other_pitch(frames: Sequence[_HeaderSeen], camera: DataSheet) -> list[str]:
    """Return the line for frames whose headers state another pixel pitch than the camera's."""
    pitch_um = camera.pixel_pitch_um
    line = _difference_line(
        "pixel_pitch_um",
        "um",
        [
            (frame, pitch_um, frame.header.pixel_pitch_um)
            for frame in frames
            if _differ(pitch_um, frame.header.pixel_pitch_um, PITCH_SHARE * (pitch_um or 0.0))
        ],
    )
    return [line] if line else []


def _remarks(seen: Sequence[_HeaderSeen]) -> list[str]:
    """Return the headers' remarks, and problems with what the captures don't state either, one line for all frames
    that have the same but for numbers."""
    texts: list[tuple[Path | str, str]] = []
    for frame in {frame.file: frame for frame in seen}.values():
        open_ones = [line for key, line in frame.header.problems if getattr(frame.capture, key) is None]
        texts += [(frame.file, text) for text in (*open_ones, *frame.header.remarks)]
    return join_alike(texts)


def join_alike(texts: Sequence[tuple[Path | str, str]]) -> list[str]:
    """Return one line for all files with the same text but for numbers: the first file, its text, how many more, and
    whether these have other numbers.

    texts : (file, text) of each

    >>> join_alike([("a.fits", "EXPTIME 1 s"), ("b.fits", "EXPTIME 2 s")])
    ['a.fits and 1 more: EXPTIME 1 s (others have other values)']
    """
    alike_texts: dict[str, list[tuple[Path | str, str]]] = {}
    for file, text in texts:
        alike_texts.setdefault(re.sub(r"[\d.+-]+", "#", text), []).append((file, text))
    return [
        f"{alike[0][0]}{f' and {len(alike) - 1} more' if len(alike) > 1 else ''}: {alike[0][1]}"
        f"{' (others have other values)' if len({text for _, text in alike}) > 1 else ''}"
        for alike in alike_texts.values()
    ]


def _contradictions(
    manifest: Manifest, seen: Sequence[_HeaderSeen], images: Mapping[str, Path], where: str
) -> list[str]:
    """Return the lines of `check_against_frames` on quantities."""
    timed = [frame for frame in seen if frame.capture.exposure_s is not None and frame.header.exposure_s is not None]
    off = [frame for frame in timed if not same_exposure(frame.capture.exposure_s, frame.header)]
    if off and (unit := _unit(off)):
        first = off[0]
        raise InputError(
            f"{first.file}: exposure_s = {first.capture.exposure_s:g} s, its {first.header.source} says "
            f"{first.header.exposure_s:g} s{_and(off)}: "
            f"it seems to be in {unit}; write seconds"
        )
    confirmed = {frame.capture.id for frame in timed} - {frame.capture.id for frame in off}
    doubted = [c for c in manifest.captures if c.exposure_s is not None and c.id not in confirmed]
    _check_limit([c for c in doubted if c.exposure_s > LONGEST_S], images)
    if moved := _find_shifted_rows(timed, off):
        raise InputError(
            f"{where}: {len(off)} of {len(timed)} exposures contradict their frames ({off[0].file.name}: "
            f"{off[0].capture.exposure_s:g} s, its "
            f"{off[0].header.source} says {off[0].header.exposure_s:g} s), and fit those of the frames of {moved}: "
            "move the column of the "
            "frames by one row"
        )
    lines = [
        _difference_line(
            "exposure_s", "s", [(frame, frame.capture.exposure_s, frame.header.exposure_s) for frame in off]
        )
    ]
    warm = [(frame, frame.capture.temperature_c, frame.header.temperature_c) for frame in seen]
    lines.append(
        _difference_line(
            "temperature_c", "degree C", [compared for compared in warm if _differ(*compared[1:], TEMPERATURE_C)]
        )
    )
    gains = [(frame, frame.capture.gain_db, frame.header.gain_db) for frame in seen]
    lines.append(_difference_line("gain_db", "dB", [compared for compared in gains if _differ(*compared[1:], GAIN_DB)]))
    lines += [_gain_of_some([c for c in manifest.captures if c.side == side], images) for side in manifest.cameras]
    for side, camera in manifest.cameras.items():
        frames = [frame for frame in seen if frame.capture.side == side]
        f_number, key = camera.f_number, "f_number"
        if f_number is None and (opened := [frame for frame in frames if frame.header.f_number is not None]):
            f_number, key = opened[0].header.f_number, f"f_number (of {opened[0].file.name})"
        wide = [(frame, f_number, frame.header.f_number) for frame in frames]
        lines += [
            _difference_line(key, "", [compared for compared in wide if not same_f_number(*compared[1:])]),
            _uneven_gain(frames),
        ]
    return [line for line in (*lines, _long(doubted, images)) if line] + _overlapping(manifest.captures, images)


@dataclass(frozen=True)
class _HeaderSeen:
    """A capture with its file and what that says."""

    capture: Capture
    file: Path
    header: FrameHeader


def _check_limit(too_long: Sequence[Capture], images: Mapping[str, Path]) -> None:
    """Refuse exposures beyond the limit that no file confirms: InputError with one line."""
    if too_long:
        more = f", and {len(too_long) - 1} more" if len(too_long) > 1 else ""
        raise InputError(
            f"{images[too_long[0].frame]}: exposure_s = {too_long[0].exposure_s:g} is beyond the limit of "
            f"{LONGEST_S:g} s{more}, and no header says "
            "so; write seconds (microseconds over 1e6)"
        )


def same_exposure(stated_s: float | None, header: FrameHeader) -> bool:
    """Return whether an exposure is that of a header, as far as this is rounded; yes where one is unknown."""
    header_s = header.exposure_s
    if not stated_s or not header_s:
        return True
    allowed = MARKED_FACTOR if header.is_marked else 1.0 + MEASURED_SHARE
    return max(stated_s / header_s, header_s / stated_s) <= allowed


def same_f_number(stated: float | None, header: float | None) -> bool:
    """Return whether two f-numbers are one marking; yes where one is unknown.

    >>> same_f_number(2.8, 2.83), same_f_number(2.8, 4.0), same_f_number(None, 4.0)
    (True, False, True)
    """
    return not stated or not header or max(stated / header, header / stated) <= F_NUMBER_FACTOR


def _differ(stated: float | None, header: float | None, allowed: float) -> bool:
    return stated is not None and header is not None and abs(stated - header) > allowed


def _unit(off: Sequence[_HeaderSeen]) -> str | None:
    """Return the unit in which all these exposures are, where it isn't the second."""
    for factor, name in UNIT_FACTORS.items():
        if all(same_exposure((frame.capture.exposure_s or 0.0) / factor, frame.header) for frame in off):
            return name
    return None


def _find_shifted_rows(timed: Sequence[_HeaderSeen], off: Sequence[_HeaderSeen]) -> str | None:
    """Return the rows whose frames all exposures fit, where these aren't their own."""
    if len(timed) < FEWEST_ROWS or len(off) < FEWEST_OFF:
        return None
    stated, taken = [frame.capture.exposure_s for frame in timed], [frame.header for frame in timed]
    for rows, pairs in (
        ("the next rows", zip(stated, taken[1:], strict=False)),
        ("the rows before", zip(stated[1:], taken, strict=False)),
    ):
        if all(same_exposure(exposure_s, header) for exposure_s, header in pairs):
            return rows
    return None


def _and(off: Sequence[object]) -> str:
    return f" (so do {len(off) - 1} more)" if len(off) > 1 else ""


def _difference_line(key: str, unit: str, off: Sequence[tuple[_HeaderSeen, float | None, float | None]]) -> str:
    """Return the line for a quantity of which frames, what is stated and what their files say differ; empty where none
    does."""
    if not off:
        return ""
    (frame, stated, header), of = off[0], f" {unit}" if unit else ""
    return (
        f"{frame.file}: {key} = {stated:g}{of}, its {frame.header.source} says {header:g}{of}{_and(off)}; the former "
        "is used: correct what is wrong"
    )


def _uneven_gain(frames: Sequence[_HeaderSeen]) -> str:
    """Return the line for frames of one side whose ISO speeds differ otherwise than their gains. Other ISO speeds at
    one gain are a difference of settings."""
    known = [frame for frame in frames if frame.header.iso is not None]
    if not known:
        return ""
    first = known[0]
    iso, gain_db = first.header.iso or 1.0, first.capture.gain_db or 0.0
    off = [
        frame
        for frame in known
        if (frame.capture.gain_db or 0.0) != gain_db
        and abs((frame.capture.gain_db or 0.0) - gain_db - 20.0 * log10((frame.header.iso or iso) / iso)) > GAIN_DB
    ]
    if not off:
        return ""
    differing = off[0]
    stated = "unknown" if differing.capture.gain_db is None else f"{differing.capture.gain_db:g} dB"
    return (
        f"{differing.file}: its {differing.header.source} says ISO {differing.header.iso:g} and that of "
        f"{first.file.name} ISO {iso:g}, {20.0 * log10((differing.header.iso or iso) / iso):+.1f} dB, but gain_db is "
        f"{stated}{_and(off)}; write the gain of each into the column gain_db"
    )


def _gain_of_some(captures: Sequence[Capture], images: Mapping[str, Path]) -> str:
    """Return the line for frames of one side that state no gain where others do; empty where there is none."""
    without = [capture for capture in captures if capture.gain_db is None]
    gains = sorted({capture.gain_db for capture in captures if capture.gain_db is not None})
    if not without or not any(gains):
        return ""
    return (
        f"{images[without[0].frame]}: no gain_db{_and(without)}, where others state "
        f"{', '.join(f'{gain:g}' for gain in gains)} dB: taken as 0 dB; write the gain of each into the column gain_db"
    )


def _long(doubted: Sequence[Capture], images: Mapping[str, Path]) -> str:
    """Return the line for exposures with light that are longer than usual; empty where there is none."""
    long = [c for c in doubted if c.kind != "dark" and c.exposure_s > LONGEST_LIT_S]
    if not long:
        return ""
    more = f", and {len(long) - 1} more" if len(long) > 1 else ""
    return (
        f"{images[long[0].frame]}: exposure_s = {long[0].exposure_s:g} of a {long[0].kind}{more}, beyond "
        f"{LONGEST_LIT_S:g} s of light: "
        "check that it is in seconds, not in milliseconds or microseconds"
    )


def _overlapping(captures: Sequence[Capture], images: Mapping[str, Path]) -> list[str]:
    """Return the line for the first exposure of each side that is longer than the time to the next frame."""
    lines = []
    timed = [(c.time.timestamp(), c) for c in captures if c.time is not None and c.exposure_s is not None]
    for side in dict.fromkeys(c.side for _, c in timed):
        in_time = sorted(((at_s, c) for at_s, c in timed if c.side == side), key=itemgetter(0))
        for (at_s, capture), (later_s, following) in pairwise(in_time):
            # times are of the beginning or of the end of an exposure
            shorter_s = min(capture.exposure_s, following.exposure_s)
            if capture.frame != following.frame and later_s - at_s + CLOCK_S < shorter_s * (1.0 - MEASURED_SHARE):
                lines.append(
                    f"{images[capture.frame]}: exposure_s = {capture.exposure_s:g}, but "
                    f"{images[following.frame].name} of {following.exposure_s:g} s was taken "
                    f"{later_s - at_s:g} s later; check that exposures are in seconds, and the times"
                )
                break
    return lines
