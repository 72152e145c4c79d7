"""Files that are written completely or not at all."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def npy_bytes(array: NDArray[Any]) -> bytes:
    """Return an array as the bytes of its .npy file.

    >>> npy_bytes(np.zeros((2, 2), np.uint16))[1:6]
    b'NUMPY'
    """
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def write_durably(path: Path, content: bytes) -> None:
    """Write a file completely or not at all, and flush it to the disk.

    path : to be written
    content : its bytes

    It gets a temporary name, fsync, its own name, and an fsync of the folder. Raises OSError.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_durably(Path(folder) / "frame.npy", npy_bytes(np.zeros((2, 2), np.uint16)))
    ...     np.load(Path(folder) / "frame.npy").tolist()
    [[0, 0], [0, 0]]
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:  # of a full disk, the system names no file
        raise OSError(error.errno, error.strerror, error.filename or str(path)) from error
    partial.rename(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
