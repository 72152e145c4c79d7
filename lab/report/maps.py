"""Maps of single pixels as files: arrays for the correction of frames, and pictures of them."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.errors import InputError
from lab.fit.noise.pixel_maps import PixelMaps
from lab.formats.raw_file import replacing
from lab.report.pictures import map_picture, png

#: Field of `PixelMaps` -> (title, unit).
MAPS = {
    "offset_dn": ("Offset", "DN"),
    "dark_dn_per_s": ("Dark current", "DN/s"),
    "gain": ("Gain, shading removed", "of the neighbourhood"),
}


def _npy(values: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def _files(maps: PixelMaps) -> Iterator[tuple[str, bytes]]:
    """(name, content) of each file: arrays in single precision, pictures of the same size, and the range of the
    pictures' colours."""
    stated: dict[str, dict[str, object]] = {}
    for name, (title, unit) in MAPS.items():
        values = getattr(maps, name)
        if values is None:
            continue
        yield f"{name}.npy", _npy(np.asarray(values, np.float32))
        yield f"{name}_std.npy", _npy(np.asarray(getattr(maps, f"{name}_std"), np.float32))
        picture, low, high = map_picture(values)
        yield f"{name}.png", png(picture)
        stated[name] = {"shows": title, "unit": unit, "picture_from": low, "picture_to": high}
    yield "defective.npy", _npy(maps.defective)
    # A single pixel of a large picture isn't seen: each is drawn 3 px wide.
    yield "defective.png", png(cv2.dilate(255 * maps.defective.astype(np.uint8), np.ones((3, 3), np.uint8)))
    stated["defective"] = {"shows": "Defective pixels in the longest dark", "pixels": int(maps.defective.sum())}
    yield "maps.json", (json.dumps(stated, indent=1) + "\n").encode()


def write_maps(folder: Path, maps: PixelMaps) -> tuple[str, ...]:
    """Write the maps into `folder`; returns the names of the files written.

    They are `offset_dn`, `dark_dn_per_s`, `gain`, each with `_std`, and `defective`, as .npy (rows, cols) and as .png;
    and their description as maps.json. Maps that aren't determined are left out. Raises InputError where a file can't
    be written."""
    names = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in _files(maps):
            with replacing(folder / name) as partial:
                partial.write_bytes(content)
            names.append(name)
    except OSError as error:
        raise InputError(f"{folder}: can't be written ({error.strerror}); name a folder that is yours") from error
    return tuple(names)
