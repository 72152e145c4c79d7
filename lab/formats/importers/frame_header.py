"""What a frame's own file says of how it was taken: EXIF of JPEG, PNG and TIFF, the metadata of camera raws, the header
of FITS frames.

EXIF (CIPA DC-008) has `ExposureTime`, `FNumber` and `PhotographicSensitivity`; a file that states one of them as 0
doesn't know it. Only headers are read. What can't be read is unknown here: that the frame itself is damaged is told
where it is decoded."""

from __future__ import annotations

import io
import logging
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rawpy
import tifffile
from pydantic import ValidationError

from lab.errors import InputError
from lab.formats.importers.fits_file import fits_header, is_fits
from lab.formats.raw_file import TiffDescription
from lab.formats.recording_set import RAWS, InstrumentSnapshot
from lab.formats.recording_set.snapshot import Value

#: Bytes of a JPEG or PNG file in which its EXIF is looked for: it stands before the picture.
HEAD_BYTES = 1 << 20
#: EXIF's WhiteBalance in words.
WHITE_BALANCE = {0: "auto", 1: "manual"}
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"


@dataclass(frozen=True)
class FrameHeader:
    """How a frame was taken, by its own file. None: not stated. `source`: what states it, in a word; `camera`: which
    camera did, and how it was set."""

    source: str
    exposure_s: float | None = None
    f_number: float | None = None
    iso: float | None = None
    gain_db: float | None = None
    temperature_c: float | None = None
    camera: InstrumentSnapshot | None = None

    @property
    def is_marked(self) -> bool:
        """Whether a camera wrote its settings as its dials are marked, in thirds of a stop."""
        return self.source in ("EXIF", "metadata")


def frame_header(file: Path) -> FrameHeader | None:
    """Return the header of a frame's file; None where it states nothing that is known here."""
    suffix = file.suffix.lower()
    found: FrameHeader | None = None
    try:
        if is_fits(file):
            header = fits_header(file, with_image=False)
            found = FrameHeader("FITS header", exposure_s=header.exposure_s, temperature_c=header.temperature_c)
        elif suffix in RAWS:
            found = _of_raw(file)
        elif suffix in (".tif", ".tiff"):
            with file.open("rb") as stream:
                found = _of_tiff(stream)
        elif suffix in (".jpg", ".jpeg", ".png"):
            with file.open("rb") as stream:
                data = stream.read(HEAD_BYTES)
            block = _exif_of_png(data) if data.startswith(PNG) else _exif_of_jpeg(data)
            found = _of_tiff(io.BytesIO(block)) if block is not None else None
    except (OSError, InputError, rawpy.LibRawError):
        return None
    return found


def _of_raw(file: Path) -> FrameHeader | None:
    with file.open("rb") as stream:  # most raws are TIFF
        told = _of_tiff(stream)
    with rawpy.imread(str(file)) as raw:
        taken = getattr(raw, "other", None)  # older versions don't tell it
        if taken is None:
            return None
        return FrameHeader(
            "metadata",
            exposure_s=_above_zero(taken.shutter_speed),
            f_number=_above_zero(taken.aperture),
            iso=_above_zero(taken.iso_speed),
            camera=told.camera if told is not None else None,
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
        own = TiffDescription.model_validate_json(str(tags.get("ImageDescription", "")))
        return FrameHeader("description", exposure_s=_above_zero(own.exposure_s), gain_db=own.gain_db)
    except ValidationError:
        pass
    return FrameHeader(
        "EXIF",
        exposure_s=_above_zero(tags.get("ExposureTime")),
        f_number=_above_zero(tags.get("FNumber")),
        iso=_above_zero(tags.get("PhotographicSensitivity", tags.get("ISOSpeedRatings"))),
        camera=_camera(tags),
    )


def _camera(tags: Mapping[str, Any]) -> InstrumentSnapshot | None:
    """Return the camera that EXIF names, with what else it says of its settings; None where it names none."""
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
    """The library's remarks on a directory without a picture, as EXIF is, aren't told."""
    log = logging.getLogger("tifffile")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before
