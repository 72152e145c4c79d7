"""Frames and targets in files: .npy, 16-bit TIFF, and the raws that LibRaw reads."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import rawpy
import tifffile
from numpy.typing import NDArray

from lab.errors import InputError, one_line

Frame = NDArray[np.uint16]
Target = NDArray[np.uint8]

#: Endings of camera raws that LibRaw reads.
RAWS = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")


def locate(root: Path, path: str) -> Path:
    """Return the file at a manifest's `path`. Raises InputError for a path that is absolute, missing, or outside
    `root`."""
    pure = PurePosixPath(path)
    if not path or "\\" in path or pure.is_absolute() or (len(path) > 1 and path[1] == ":"):
        raise InputError("not a path relative to the folder with '/'; move the file into the folder and name it so")
    found = root / pure
    try:
        inside, exists, is_file = found.resolve().is_relative_to(root.resolve()), found.exists(), found.is_file()
    except (OSError, ValueError, RuntimeError) as error:  # a loop of links, a NUL, a name too long
        raise InputError(f"no usable path ({one_line(error)}); rename the file") from error
    if not inside:
        raise InputError("leads out of the folder; copy the file into the folder and name it by its relative path")
    if not exists:
        raise InputError("no such file; add it, or take what needs it out of the manifest")
    if not is_file:
        raise InputError("not a file; name the file itself")
    if not os.access(found, os.R_OK):
        raise InputError(
            "can't be read (Permission denied); run it as the user to whom it belongs, or have its permissions changed"
        )
    return found


def _load_npy(file: Path, dtype: type[np.unsignedinteger[Any]]) -> NDArray[Any]:
    """Return a two-dimensional .npy of `dtype` in either byte order."""
    try:
        # Mapped: a damaged header may announce terabytes, which must not be allocated.
        mapped = np.load(file, mmap_mode="r", allow_pickle=False)
    except Exception as error:
        raise InputError(f"damaged .npy ({one_line(error)}); write it again or recapture") from error
    if not isinstance(mapped, np.ndarray):
        raise InputError("an archive of arrays; save one array with numpy.save")
    wanted = np.dtype(dtype)
    if mapped.dtype != wanted and mapped.dtype.newbyteorder("=") != wanted:
        raise InputError(f"its numbers are {mapped.dtype}, not {wanted}; save raw DN as {wanted}")
    if mapped.ndim != 2:
        raise InputError(f"has {mapped.ndim} dimensions, not 2; save one (rows, cols) array")
    return np.array(mapped, dtype=wanted, order="C")


def _load_tif(file: Path, wanted: tuple[int, int] | None = None) -> NDArray[Any]:
    """Return a TIFF of one page, 16 bit, one sample a pixel. One of another shape than `wanted` isn't decoded: it may
    be far larger than its file."""
    frame = None
    try:
        with tifffile.TiffFile(file) as tif:
            pages, page = len(tif.pages), tif.pages[0]
            shape, dtype = tuple(page.shape), np.dtype(page.dtype)
            if pages == 1 and dtype == np.uint16 and len(shape) == 2 and wanted in (None, shape):
                frame = np.ascontiguousarray(page.asarray())
    except Exception as error:
        raise InputError(f"damaged TIFF ({one_line(error)}); write it again or recapture") from error
    if pages != 1:
        raise InputError(f"has {pages} pages, not 1; save one file a frame")
    if dtype != np.uint16:
        raise InputError(f"its samples are {dtype}, not uint16; save raw DN as 16 bit")
    if frame is None and len(shape) == 2 and wanted is not None:
        raise InputError(
            f"{shape[0]} x {shape[1]} pixels (rows x cols), but the manifest says {wanted[0]} x {wanted[1]}; "
            "recapture, or correct rows and cols"
        )
    if frame is None:
        raise InputError(f"has the shape {shape}, not (rows, cols); save the mosaic, not colours")
    return frame


def _load_raw(file: Path, shape: tuple[int, int] | None = None) -> NDArray[Any]:
    """Return the mosaic of a camera raw: its visible area, or the whole sensor where only that has `shape`."""
    try:
        with rawpy.imread(str(file)) as raw:
            visible, whole = raw.raw_image_visible, raw.raw_image
            chosen = whole if shape not in (None, visible.shape) and whole.shape == shape else visible
            frame = np.array(chosen, dtype=np.uint16, order="C")
    except Exception as error:
        raise InputError(f"damaged raw ({one_line(error)}); copy it again or recapture") from error
    if frame.ndim != 2:
        raise InputError("holds no mosaic (a linear DNG); save the raw itself")
    return frame


def load_frame(file: Path, shape: tuple[int, int] | None = None) -> Frame:
    """One frame from an .npy, .tif/.tiff or camera-raw file: uint16 (rows, cols) as stored. Its InputError leaves the
    path to the caller."""
    suffix = file.suffix.lower()
    if suffix == ".npy":
        return _load_npy(file, np.uint16)
    if suffix in (".tif", ".tiff"):
        return _load_tif(file, shape)
    if suffix in RAWS:
        return _load_raw(file, shape)
    raise InputError(f"a frame can't be {suffix or 'without an ending'}; give .npy, .tif or .dng")


def load_target(file: Path) -> Target:
    """Return a screen's pattern from an .npy file: uint8 (rows, cols) of 0 and 1. Its InputError leaves the path to the
    caller."""
    if file.suffix.lower() != ".npy":
        raise InputError(f"a target can't be {file.suffix or 'without an ending'}; give .npy (uint8)")
    return checked_target(_load_npy(file, np.uint8))


def checked_target(target: Target) -> Target:
    """Return the target itself. Raises InputError where it holds other numbers than 0 and 1."""
    if target.size == 0 or int(target.max()) > 1:
        raise InputError("holds other numbers than 0 and 1; save what was shown as 0 (dark) and 1 (lit)")
    return target
