"""Pictures come out as they are stored: packed samples, byte orders, compressions, pages, orientation."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from lab.errors import InputError
from lab.formats.pictures import picture_facts, read_picture
from lab.formats.recording_set import load_frame

ORIENTATION, SHORT = 274, 3


def codes(bits: int, shape: tuple[int, ...] = (21, 31), seed: int = 0) -> np.ndarray:
    values = np.random.default_rng(seed).integers(0, 2**bits, shape)
    return values.astype(np.uint8 if bits <= 8 else np.uint16)


def packed_tiff(
    frame: np.ndarray, bits: int, *, deflate: bool = False, rows_a_strip: int = 0, reverse: bool = False
) -> bytes:
    """A TIFF with `bits` bits a sample, each row on whole bytes, the highest bit first (or, reversed, last)."""
    rows, cols = frame.shape[:2]
    flat = frame.reshape(rows, -1)
    ones = (flat[..., None] >> np.arange(bits - 1, -1, -1)) & 1
    table = np.packbits(ones.astype(np.uint8).reshape(rows, -1), axis=1, bitorder="little" if reverse else "big")
    height = rows_a_strip or rows
    strips = [table[k : k + height].tobytes() for k in range(0, rows, height)]
    strips = [zlib.compress(strip) for strip in strips] if deflate else strips
    offsets = np.cumsum([8, *map(len, strips)])
    tags = [
        (256, 3, [cols]),
        (257, 3, [rows]),
        (258, 3, [bits] * (flat.shape[1] // cols)),
        (259, 3, [8 if deflate else 1]),
    ]
    tags += [(262, 3, [2 if frame.ndim == 3 else 1]), (266, 3, [2 if reverse else 1]), (273, 4, list(offsets[:-1]))]
    tags += [(277, 3, [flat.shape[1] // cols]), (278, 3, [height]), (279, 4, list(map(len, strips)))]
    at, extra, entries = int(offsets[-1]) + 2 + 12 * len(tags) + 4, b"", b""
    for tag, kind, values in tags:
        value = struct.pack(f"<{len(values)}{'H' if kind == 3 else 'I'}", *values)
        if len(value) > 4:
            value, extra = struct.pack("<I", at + len(extra)), extra + value
        entries += struct.pack("<HHI", tag, kind, len(values)) + value.ljust(4, b"\0")
    head = b"II*\0" + struct.pack("<I", int(offsets[-1]))
    return head + b"".join(strips) + struct.pack("<H", len(tags)) + entries + bytes(4) + extra


@pytest.mark.parametrize("bits", [4, 9, 10, 11, 12, 13, 14, 15])
@pytest.mark.parametrize("how", [{}, {"deflate": True, "rows_a_strip": 4}, {"rows_a_strip": 8, "reverse": True}])
def test_packed_samples_are_codes_of_their_own_bits(tmp_path: Path, bits: int, how: dict[str, bool]) -> None:
    for frame in (codes(bits), codes(bits, (9, 7, 3))):
        (tmp_path / "a.tif").write_bytes(packed_tiff(frame, bits, **how))
        np.testing.assert_array_equal(read_picture(tmp_path / "a.tif"), frame)
        assert picture_facts(tmp_path / "a.tif").bits == bits
    (tmp_path / "a.tif").write_bytes(packed_tiff(frame[..., 0], bits, **how)[:-90])
    with pytest.raises(InputError, match="damaged TIFF"):
        read_picture(tmp_path / "a.tif")


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"byteorder": ">"},
        {"rowsperstrip": 5},
        {"tile": (16, 16)},
        {"compression": "zlib", "predictor": True, "byteorder": ">"},
    ],
    ids=str,
)
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_tiff_is_read_as_stored(tmp_path: Path, how: dict[str, object], orientation: int) -> None:
    frame, tags = codes(16), [(ORIENTATION, SHORT, 1, orientation, True)]
    tifffile.imwrite(tmp_path / "a.tif", frame, photometric="minisblack", metadata=None, extratags=tags, **how)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif"), frame)
    np.testing.assert_array_equal(load_frame(tmp_path / "a.tif"), frame)
    assert picture_facts(tmp_path / "a.tif").orientation == orientation


def with_orientation(tiff: bytes, orientation: int) -> bytes:
    """A little-endian TIFF with an Orientation tag added to its first directory, which moves to the end."""
    (at,) = struct.unpack_from("<I", tiff, 4)
    (count,) = struct.unpack_from("<H", tiff, at)
    entries = [tiff[at + 2 + 12 * k : at + 14 + 12 * k] for k in range(count)]
    entries.append(struct.pack("<HHIHH", ORIENTATION, SHORT, 1, orientation, 0))
    entries.sort(key=lambda entry: struct.unpack_from("<H", entry)[0])
    directory = struct.pack("<H", count + 1) + b"".join(entries) + bytes(4)
    return tiff[:4] + struct.pack("<I", len(tiff)) + tiff[8:] + directory


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_compressions_that_opencv_decodes_are_neither_turned_nor_shifted(tmp_path: Path, orientation: int) -> None:
    """OpenCV alone turns them by the tag."""
    lzw = [cv2.IMWRITE_TIFF_COMPRESSION, 5]
    for frame in (codes(16), codes(8), codes(16, (12, 17, 3))):
        done, data = cv2.imencode(".tif", frame[..., ::-1] if frame.ndim == 3 else frame, lzw)
        assert done
        (tmp_path / "a.tif").write_bytes(with_orientation(data.tobytes(), orientation))
        np.testing.assert_array_equal(read_picture(tmp_path / "a.tif"), frame)
        assert picture_facts(tmp_path / "a.tif").orientation == orientation


@pytest.mark.parametrize("kind", ["imagej", "ome", "plain", "one directory"])
def test_each_page_of_a_stack_is_a_picture(tmp_path: Path, kind: str) -> None:
    stack, file = codes(12, (5, 20, 30)), tmp_path / ("a.ome.tif" if kind == "ome" else "a.tif")
    how = {"photometric": "minisblack"} if kind == "plain" else {"metadata": {"axes": "TYX"}}
    tifffile.imwrite(file, stack, imagej=kind in ("imagej", "one directory"), **how)
    if kind == "one directory":  # as ImageJ writes stacks beyond 4 GB
        data = bytearray(file.read_bytes())
        with tifffile.TiffFile(file) as opened:
            first, order = opened.pages[0].offset, opened.byteorder
        end = first + 2 + 12 * struct.unpack_from(f"{order}H", data, first)[0]
        data[end : end + 4] = bytes(4)
        file.write_bytes(data)
    assert picture_facts(file).pages == 5
    for page, frame in enumerate(stack):
        np.testing.assert_array_equal(read_picture(file, page), frame)
    with pytest.raises(InputError, match="has 5 pages, not 1"):
        read_picture(file)


def test_pages_that_are_no_frames_of_one_kind_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "c.tif", codes(12, (3, 2, 20, 30)), imagej=True, metadata={"axes": "TCYX"})
    with pytest.raises(InputError, match="has 2 pages that it calls channels"):
        picture_facts(tmp_path / "c.tif")
    with tifffile.TiffWriter(tmp_path / "s.tif") as writer:
        for shape in ((20, 30), (10, 30)):
            writer.write(codes(12, shape), photometric="minisblack", metadata=None)
    with pytest.raises(InputError, match="has pages of 2 shapes"):
        picture_facts(tmp_path / "s.tif")
    with tifffile.TiffWriter(tmp_path / "p.tif") as writer:  # a preview isn't a frame
        writer.write(codes(12), photometric="minisblack", metadata=None)
        writer.write(codes(12, (8, 8)), photometric="minisblack", metadata=None, subfiletype=1)
    np.testing.assert_array_equal(read_picture(tmp_path / "p.tif"), codes(12))


def test_codes_that_do_not_rise_with_the_light_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", codes(16), photometric="miniswhite")
    for read in (read_picture, load_frame):
        with pytest.raises(InputError, match="white is zero"):
            read(tmp_path / "a.tif")
    table = np.random.default_rng(1).integers(0, 65535, (3, 256), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", codes(8), photometric="palette", colormap=table)
    with pytest.raises(InputError, match="palette"):
        read_picture(tmp_path / "a.tif")
    frame = np.zeros((4, 10), np.uint8)
    rows = b"".join(b"\0" + row.tobytes() for row in np.packbits(frame, axis=1))
    head = struct.pack(">IIBBBBB", 10, 4, 1, 0, 0, 0, 0)
    parts = [(b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    png = b"".join(struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in parts)
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + png)
    with pytest.raises(InputError, match="PNG of 1 bits"):
        read_picture(tmp_path / "a.png")


@pytest.mark.parametrize(("factor", "subsampling"), [(0x111111, (1, 1)), (0x211111, (2, 1)), (0x221111, (2, 2))])
def test_a_jpeg_states_its_subsampling_and_orientation(
    tmp_path: Path, factor: int, subsampling: tuple[int, int]
) -> None:
    done, data = cv2.imencode(".jpg", codes(8, (32, 48, 3)), [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor])
    assert done
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x08\0\0\0\0\0\0"
    jpeg = data.tobytes()
    file = tmp_path / "a.jpg"
    file.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])
    facts = picture_facts(file)
    assert (facts.form, facts.is_lossy, facts.subsampling, facts.orientation) == ("JPEG", True, subsampling, 8)
    assert read_picture(file).shape == (32, 48, 3)
