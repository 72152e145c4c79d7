"""Image files as frames: grey PNG, JPEG, BMP, PGM, TIFF of 8 to 16 bit, FITS, camera raws, .npy. They are decoded on
access.

A channel of transparency (RGBA) is dropped, and `has_alpha` says so. Spectra beside them may have semicolons and
decimal commas."""

from __future__ import annotations

import struct
import tomllib
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from lab.errors import InputError
from lab.formats.foreign_text import read_foreign_csv, read_foreign_text
from lab.formats.importers.fits_file import FITS, GZIP, is_fits, load_fits
from lab.formats.recording_set import RAWS, DataSheet, FolderFiles, Frame, load_frame
from lab.formats.recording_set.frame_files import locate
from lab.formats.spectrum_csv import parse_spectrum
from sim.camera import Side
from sim.spectrum import Spectrum

IMAGES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm")


def read_image(file: Path) -> Frame:
    """Grey values of an image file as uint16 (rows, cols), as stored. InputError without the path."""
    suffix = file.suffix.lower()
    if suffix == ".npy" or suffix in RAWS:
        return load_frame(file)
    if is_fits(file):
        return load_fits(file)
    if suffix not in IMAGES:
        raise InputError(f"can't be read; give one of {' '.join((*IMAGES, *FITS, *RAWS, '.npy'))}")
    return grey(decoded(file))


def is_frame(file: Path) -> bool:
    """Return whether a file is one that can be read as a frame, by its ending."""
    return file.suffix.lower() in (*IMAGES, *RAWS, ".npy") or is_fits(file)


def frame_name(path: str) -> str:
    """Return the name of a frame's file without its ending, `.fits.gz` included."""
    name = path.rpartition("/")[2]
    return Path(name[: -len(GZIP)] if is_fits(Path(name)) and name.lower().endswith(GZIP) else name).stem


def has_alpha(image: NDArray[Any]) -> bool:
    """Return whether an image (rows, cols[, channels]) has a channel of transparency beside its grey values or
    colours."""
    return image.shape[2:] in ((2,), (4,))


def decoded(file: Path) -> NDArray[Any]:
    """Return an image file's samples as they're stored, channels in OpenCV's order. InputError without the path."""
    data = file.read_bytes()
    if why := _damage(data):
        raise InputError(f"damaged image ({why}); copy it again or recapture")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"damaged image ({str(error).split('error:')[-1].strip()}); copy it again") from error
    if image is None:
        raise InputError("damaged image (it can't be decoded); copy it again or recapture")
    return np.asarray(image)


def _damage(data: bytes) -> str | None:
    """Why PNG or JPEG data are incomplete. The decoder would silently fill the missing part with zeros."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        at = 8
        while at + 12 <= len(data):
            (length,) = struct.unpack(">I", data[at : at + 4])
            body, sum_ = data[at + 4 : at + 8 + length], data[at + 8 + length : at + 12 + length]
            if len(sum_) < 4:
                break
            if zlib.crc32(body) != struct.unpack(">I", sum_)[0]:
                return f"the checksum of chunk {body[:4]!r} is wrong"
            if body[:4] == b"IEND":
                return None
            at += 12 + length
        return "it ends too early"
    if data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[-1024:]:
        return "it ends too early"
    return None


def grey(image: NDArray[Any]) -> Frame:
    """Return the grey values (rows, cols) of a decoded image; a channel of transparency is dropped. InputError for
    colours and other numbers."""
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"its values are {image.dtype}; save grey values of 8 or 16 bit")
    if image.ndim == 3:
        colours = image[..., :3]
        if image.shape[2] >= 3 and not np.array_equal(colours.min(axis=2), colours.max(axis=2)):
            raise InputError("is a colour picture; give the raw mosaic, or grey values")
        image = image[..., 0]
    return np.ascontiguousarray(image, dtype=np.uint16)


class ImageFiles(FolderFiles):
    """A folder whose frames are images. `images`: the file of each frame by its path in the recording set.

    Values are shifted down by `shift` bits. The files are decoded on access and, as spectra, aren't copied byte by
    byte."""

    def __init__(self, root: Path, images: Mapping[str, Path], shift: int = 0) -> None:
        super().__init__(root)
        self.images, self.shift = dict(images), shift

    def file(self, path: str) -> Path | None:
        return None if path in self.images or path.lower().endswith(".csv") else super().file(path)

    def spectrum(self, path: str) -> Spectrum:
        return parse_spectrum(read_foreign_csv(locate(self.root, path)).text)

    def frame(self, path: str, camera: DataSheet) -> Frame:
        return np.right_shift(read_image(self.images[path]), self.shift, dtype=np.uint16)

    def where(self, path: str) -> str:
        return str(self.images[path]) if path in self.images else super().where(path)


def described_sides(file: Path) -> dict[Side, dict[str, Any]]:
    """Return what `camera.toml` says of each side: its keys at the top are of a single (left) camera, or of every side
    where it has the tables `[left]` and `[right]`. A missing file says nothing of the left one."""
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
    for side, keys in described_sides(file).items():
        known = {key: value for key, value in keys.items() if key != "taps"}  # of the readout, not of the data sheet
        try:
            cameras[side] = DataSheet.model_validate({**defaults.get(side, {}), **known})
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in first["loc"])
            raise InputError(f"{file}: {side} camera: {key}: {first['msg']}; write it in camera.toml") from error
    return cameras
