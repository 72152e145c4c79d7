"""Pictures as files: TIFF, PNG, JPEG, BMP, PGM. Samples come out as they are stored: not turned, scaled, inverted or
shifted.

TIFF is read by tifffile, samples of 1 to 15 bits are unpacked here, and compressions that tifffile lacks (LZW, JPEG)
are decoded by OpenCV. OpenCV turns a picture by its Orientation tag and shifts 10 to 14 bits up to 16: the tag is
taken out first, and the shift undone."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from lab.errors import InputError, one_line

#: Endings of pictures.
IMAGES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm")
TIFFS = (".tif", ".tiff")
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
#: Bytes of a JPEG or PNG file in which what it states is looked for: it stands before the picture.
HEAD_BYTES = 1 << 20
#: TIFF's numbers of the tags and values that are used here.
PHOTOMETRIC, ORIENTATION = 262, 274
WHITE_IS_ZERO, PALETTE = 0, 3
JPEG_COMPRESSIONS = (6, 7, 34892, 33007)
#: Compressions whose segments are decoded here where samples are packed.
INFLATED = (8, 32946, 50013)
#: Samples that are unpacked at a time.
BLOCK = 1 << 20
#: Markers of JPEG that begin a frame: SOF0 to SOF15 less DHT, JPG and DAC.
START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


@dataclass(frozen=True)
class PictureFacts:
    """What the file of a picture states of its samples.

    `shape`, `dtype`: of one page, None where only decoding tells. `bits`: bits a sample, where these are fewer than
    its container's. `orientation`: EXIF's 1 to 8; 1: as stored. `is_lossy`: compressed by JPEG. `subsampling`: pixels
    (across, down) of one sample of colour difference, (1, 1) where each pixel has its own.
    """

    form: str
    pages: int = 1
    shape: tuple[int, ...] | None = None
    dtype: np.dtype[Any] | None = None
    bits: int | None = None
    orientation: int = 1
    is_lossy: bool = False
    subsampling: tuple[int, int] = (1, 1)


def picture_facts(file: Path) -> PictureFacts:
    """Return what a picture's file states, without decoding it. Raises InputError, without the path, where its header
    is damaged or its pages aren't frames of one kind."""
    if file.suffix.lower() in TIFFS:
        with _open(file) as tif:
            return _tiff_facts(tif)
    with file.open("rb") as stream:
        data = stream.read(HEAD_BYTES)
    orientation = _exif_orientation(exif_block(data))
    if data.startswith(PNG):
        return PictureFacts("PNG", bits=_significant_bits(data), orientation=orientation)
    if data.startswith(JPEG):
        return PictureFacts("JPEG", orientation=orientation, is_lossy=True, subsampling=_jpeg_subsampling(data))
    return PictureFacts(file.suffix.lstrip(".").upper())


def read_picture(file: Path, page: int | None = None) -> NDArray[Any]:
    """Return the samples of a picture as stored: (rows, cols), or (rows, cols, channels) in the order red, green, blue.

    file : TIFF, PNG, JPEG or another picture
    page : which page of a TIFF; by default its only one

    Raises InputError, without the path, where the picture is damaged, has several pages and none is chosen, or its
    codes don't rise with the light.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "flat.tif"
    ...     tifffile.imwrite(file, np.full((4, 6), 64, np.uint16))
    ...     read_picture(file).shape
    (4, 6)
    """
    if file.suffix.lower() in TIFFS:
        with _open(file) as tif:
            pages = _frames(tif)
            if page is None and len(pages) > 1:
                raise InputError(f"has {len(pages)} pages, not 1; give one picture a file")
            return _page_samples(tif, pages[page or 0], file)
    data = file.read_bytes()
    if why := _damage(data):
        raise InputError(f"damaged image ({why}); copy it again or recapture")
    if data.startswith(PNG) and (bits := data[24]) < 8:
        raise InputError(f"is a PNG of {bits} bits a sample, which a decoder scales to 8; save it with 8 or 16")
    return _by_opencv(data)


class _Contiguous:
    """A page of an ImageJ stack whose file has one directory for all of its pages."""

    def __init__(self, first: Any, number: int) -> None:
        self.first, self.number = first, number


def _open(file: Path) -> Any:
    try:
        return tifffile.TiffFile(file)
    except Exception as error:
        raise InputError(f"damaged TIFF ({one_line(error)}); write it again or recapture") from error


def _frames(tif: Any) -> list[Any]:
    """Return the pages that are frames: previews and masks aren't. Raises InputError where they differ in shape, or are
    the channels of one frame."""
    try:
        pages = [page for page in tif.pages if not (page.is_reduced or page.is_mask)] or [tif.pages[0]]
        axes = tif.series[0].axes if len(pages) > 1 or tif.is_imagej else ""
        stored = dict(zip(axes, tif.series[0].shape, strict=False))
    except Exception as error:
        raise InputError(f"damaged TIFF ({one_line(error)}); write it again or recapture") from error
    if (channels := stored.get("C", 1)) > 1:
        raise InputError(
            f"has {channels} pages that it calls channels (axes {axes}); save repeats as frames (axis T), and "
            "channels as a file each"
        )
    shapes = list(dict.fromkeys(page.shape for page in pages))
    if len(shapes) > 1:
        listed = ", ".join(" x ".join(map(str, shape)) for shape in shapes[:3])
        raise InputError(f"has pages of {len(shapes)} shapes ({listed}); save one file a frame")
    count = int(np.prod([size for axis, size in stored.items() if axis not in "YXS"])) if stored else 1
    if tif.is_imagej and len(pages) == 1 and count > 1:
        return [_Contiguous(pages[0], number) for number in range(count)]
    return pages


def _tiff_facts(tif: Any) -> PictureFacts:
    pages = _frames(tif)
    page = pages[0].first if isinstance(pages[0], _Contiguous) else pages[0]
    try:
        bits = page.bitspersample
        across, down = page.subsampling if page.photometric == 6 and page.subsampling else (1, 1)
        return PictureFacts(
            "TIFF",
            len(pages),
            tuple(page.shape),
            np.dtype(page.dtype) if page.dtype is not None else None,
            bits if isinstance(bits, int) and bits not in (8, 16, 32, 64) else None,
            _plain_orientation(page.tags.valueof(ORIENTATION)),
            page.compression in JPEG_COMPRESSIONS,
            (int(across), int(down)),
        )
    except Exception as error:
        raise InputError(f"damaged TIFF ({one_line(error)}); write it again or recapture") from error


def _plain_orientation(value: Any) -> int:
    return int(value) if isinstance(value, int) and 1 <= value <= 8 else 1


def _page_samples(tif: Any, page: Any, file: Path) -> NDArray[Any]:
    first = page.first if isinstance(page, _Contiguous) else page
    photometric = first.tags.valueof(PHOTOMETRIC)
    if photometric == WHITE_IS_ZERO:
        raise InputError(
            "its PhotometricInterpretation is 0 (white is zero): its codes fall as light rises; save it with 1 (black "
            "is zero)"
        )
    if photometric == PALETTE:
        raise InputError("has a palette: its codes are places in a table of colours; save it as grey values")
    try:
        if isinstance(page, _Contiguous):
            series = tif.series[0]
            return np.array(series.asarray().reshape(-1, *first.shape)[page.number])
        if any(count == 0 for count in page.databytecounts) or not page.dataoffsets:
            raise InputError("damaged TIFF (strips are missing); write it again or recapture")  # noqa: TRY301
        bits = page.bitspersample
        if isinstance(bits, int) and bits < 16 and bits != 8:
            return _packed_samples(tif, page, bits, file)
        if _needs_opencv(page):
            return _tiff_by_opencv(tif, page, file)
        samples = page.asarray()
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"damaged TIFF ({one_line(error)}); write it again or recapture") from error
    if samples.ndim == 3 and page.axes.startswith("S"):  # one plane a channel
        samples = np.moveaxis(samples, 0, -1)
    return np.ascontiguousarray(samples)


def _needs_opencv(page: Any) -> bool:
    """Return whether tifffile lacks the decoder of a page's compression (it has those of imagecodecs where this is
    installed)."""
    try:
        tifffile.TIFF.DECOMPRESSORS[page.compression]
        tifffile.TIFF.UNPREDICTORS[page.predictor]
    except (KeyError, ImportError, ValueError):
        return True
    return bool(page.photometric == 6)  # YCbCr: to red, green, blue


def _tiff_by_opencv(tif: Any, page: Any, file: Path) -> NDArray[Any]:
    """Decode a page by OpenCV, with its Orientation as stored."""
    data = bytearray(file.read_bytes())
    for page_of_series in tif.pages:
        tag = page_of_series.tags.get(ORIENTATION)
        if tag is not None:
            data[tag.valueoffset : tag.valueoffset + 2] = struct.pack(f"{tif.byteorder}H", 1)
    return _by_opencv(bytes(data), page.index)


def _packed_samples(tif: Any, page: Any, bits: int, file: Path) -> NDArray[Any]:
    """Unpack samples of `bits` bits: the highest bit first, each row begins on a byte (TIFF 6.0)."""
    rows, across = page.imagelength, page.imagewidth * page.samplesperpixel
    many = page.samplesperpixel > 1
    if page.is_tiled or page.predictor > 1 or (many and page.planarconfig != 1):
        raise InputError(f"has samples of {bits} bits in tiles, planes or differences; save it with 16 bits a sample")
    if page.compression != 1 and page.compression not in INFLATED:
        shifted = _tiff_by_opencv(tif, page, file)
        shift = np.iinfo(shifted.dtype).bits - bits if shifted.dtype in (np.uint8, np.uint16) else 0
        if bits < 8 or shift <= 0 or np.any(shifted & ((1 << shift) - 1)):
            raise InputError(f"has compressed samples of {bits} bits; save it uncompressed, or with 16 bits a sample")
        return shifted >> np.array(shift, shifted.dtype)
    samples = np.empty((rows, across), np.uint8 if bits < 8 else np.uint16)
    stride, height = -(-across * bits // 8), page.rowsperstrip or rows
    order = "little" if page.fillorder == 2 else "big"
    per_block = max(1, BLOCK // across)
    for number, (offset, size) in enumerate(zip(page.dataoffsets, page.databytecounts, strict=True)):
        first = number * height
        tif.filehandle.seek(offset)
        data = tif.filehandle.read(size)
        if page.compression in INFLATED:
            data = zlib.decompress(data)
        count = min(height, rows - first)
        strip = np.frombuffer(data, np.uint8, count * stride).reshape(count, stride)
        for at in range(0, count, per_block):
            part = strip[at : at + per_block]
            each = np.zeros((len(part), across, 16), np.uint8)
            ones = np.unpackbits(part, axis=1, count=across * bits, bitorder=order)  # type: ignore[call-overload]
            each[:, :, 16 - bits :] = ones.reshape(len(part), across, bits)
            samples[first + at : first + at + len(part)] = np.packbits(each, axis=2).view(">u2")[..., 0]
    return samples.reshape(rows, page.imagewidth, -1) if many else samples


def _by_opencv(data: bytes, page: int = 0) -> NDArray[Any]:
    """Decode a picture with its samples unchanged; colours come out as red, green, blue."""
    buffer = np.frombuffer(data, np.uint8)
    try:
        if page:
            done, images = cv2.imdecodemulti(buffer, cv2.IMREAD_UNCHANGED, range=(page, page + 1))
            image = images[0] if done and images else None
        else:
            image = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise InputError(f"damaged image ({str(error).split('error:')[-1].strip()}); copy it again") from error
    if image is None:
        raise InputError("damaged image (it can't be decoded); copy it again or recapture")
    image = np.asarray(image)
    if image.ndim == 3 and image.shape[2] >= 3:
        image = image[..., [2, 1, 0, 3][: image.shape[2]]]
    return np.ascontiguousarray(image)


def png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes, bytes]]:
    """Yield name, content and checksum of each chunk; the last may be cut off.

    data : the file's content, its signature included (Portable Network Graphics, W3C, section 5.3)

    >>> head = PNG + (2).to_bytes(4, "big") + b"sBIT" + b"ab" + b"sum."
    >>> list(png_chunks(head))
    [(b'sBIT', b'ab', b'sum.')]
    """
    at = len(PNG)
    while at + 8 <= len(data):
        length, name = struct.unpack(">I4s", data[at : at + 8])
        end = at + 8 + length
        yield name, data[at + 8 : end], data[end : end + 4]
        at = end + 4


def jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield marker and content of each segment up to the picture.

    data : the file's content, from its first byte (ITU-T T.81, annex B)

    >>> list(jpeg_segments(bytes([0xFF, 0xD8, 0xFF, 0xE1, 0, 4, 65, 66, 0xFF, 0xDA])))
    [(225, b'AB')]
    """
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        if data[at + 1] == 0xFF:  # a fill byte
            at += 1
            continue
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        yield data[at + 1], data[at + 4 : at + 2 + length]
        at += 2 + length


def exif_block(data: bytes) -> bytes | None:
    """Return the EXIF of a PNG or JPEG file, a TIFF without a picture; None where it has none."""
    if data.startswith(PNG):
        return next((content for name, content, _ in png_chunks(data) if name == b"eXIf"), None)
    if data.startswith(JPEG):
        segments = (content for marker, content in jpeg_segments(data) if marker == 0xE1)
        return next((content[6:] for content in segments if content.startswith(b"Exif\0\0")), None)
    return None


def _exif_orientation(block: bytes | None) -> int:
    """Return the Orientation of EXIF's first directory; 1 where it isn't stated."""
    if block is None or block[:2] not in (b"II", b"MM"):
        return 1
    order = "<" if block[:2] == b"II" else ">"
    try:
        (at,) = struct.unpack_from(f"{order}I", block, 4)
        (count,) = struct.unpack_from(f"{order}H", block, at)
        for number in range(count):
            tag, kind = struct.unpack_from(f"{order}HH", block, at + 2 + 12 * number)
            if (tag, kind) == (ORIENTATION, 3):
                return _plain_orientation(struct.unpack_from(f"{order}H", block, at + 10 + 12 * number)[0])
    except struct.error:
        pass
    return 1


def _significant_bits(data: bytes) -> int | None:
    """Return the significant bits a sample that a PNG states (its chunk sBIT), where these are fewer than stored."""
    bits = next((content for name, content, _ in png_chunks(data) if name == b"sBIT"), b"")
    return max(bits) if bits and max(bits) < data[24] else None


def _jpeg_subsampling(data: bytes) -> tuple[int, int]:
    """Return the pixels (across, down) of one sample of colour difference: ratios of the sampling factors in the SOF
    segment."""
    for marker, content in jpeg_segments(data):
        if marker in START_OF_FRAME and len(content) >= 6 and content[5] >= 3:
            factors = [divmod(factor, 16) for factor in content[7 : 7 + 3 * content[5] : 3]]
            across, down = (max(axis) // max(min(axis), 1) for axis in zip(*factors, strict=True))
            return across, down
    return 1, 1


def _damage(data: bytes) -> str | None:
    """Why PNG or JPEG data are incomplete. The decoder would silently fill the missing part with zeros."""
    if data.startswith(PNG):
        for name, content, checksum in png_chunks(data):
            if len(checksum) < 4:
                break
            if zlib.crc32(name + content) != struct.unpack(">I", checksum)[0]:
                return f"the checksum of chunk {name!r} is wrong"
            if name == b"IEND":
                return None
        return "it ends too early"
    if data.startswith(JPEG) and b"\xff\xd9" not in data[-1024:]:
        return "it ends too early"
    return None
