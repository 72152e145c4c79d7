"""A traced lens as a table over wavelength and field, cached on disk by the hash of its input."""

from __future__ import annotations

import contextlib
import os
import tempfile
import zipfile
import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np

from sim.spectrum import FloatArray

#: Goes into every content hash: a table that an older way of computing made isn't taken from the cache.
TABLE_VERSION = 4


@dataclass(frozen=True, eq=False)
class LensTable:
    """Table of a traced lens. Arrays can't be written to; two tables are equal where their `content_hash` is.

    W wavelengths, F field points, n x n samples of the point spread function. Field angles are (theta_x, theta_y) of
    the object's direction (tan theta_x, tan theta_y, 1) in degrees; the image lies at `chief_mm` in the frame of the
    field: an object at +theta has its image at +y (Zemax's signs, that is at about +f tan theta), so that the frame's
    rows run with y. `psf` is the intensity per sample (not per area): rows are y (down in the image), columns x
    (right); its window's centre (between the middle four samples where n is even) lies at chief_mm + window_um; it sums
    to `encircled_share`, 1 being all that leaves the lens from that field point at that wavelength.
    """

    wavelength_nm: FloatArray
    field_deg: FloatArray
    grid_shape: tuple[int, ...]
    symmetric: bool
    reference_wavelength_nm: float
    focal_length_mm: float
    f_number: float
    entrance_pupil_mm: float
    chief_mm: FloatArray
    relative_illumination: FloatArray
    psf: FloatArray
    window_um: FloatArray
    sample_pitch_um: float
    encircled_share: FloatArray
    centroid_um: FloatArray
    warnings: tuple[str, ...]
    content_hash: str

    def __post_init__(self) -> None:
        for item in fields(self):
            if item.type == "FloatArray":
                array = np.ascontiguousarray(getattr(self, item.name), dtype=float)
                if array.flags.writeable:
                    array = array.copy() if array is getattr(self, item.name) else array
                    array.flags.writeable = False
                object.__setattr__(self, item.name, array)
        w, f = self.wavelength_nm.size, len(self.field_deg)
        shapes = {
            "wavelength_nm": (w,),
            "field_deg": (f, 2),
            "chief_mm": (f, 2),
            "relative_illumination": (w, f),
            "psf": (w, f, *self.psf.shape[-1:], *self.psf.shape[-1:]),
            "window_um": (f, 2),
            "encircled_share": (w, f),
            "centroid_um": (w, f, 2),
        }
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise ValueError(f"lens table: {name} has the shape {array.shape}, {shape} fits the others; correct it")
            if not np.all(np.isfinite(array)):
                raise ValueError(f"lens table: {name} holds values that aren't finite; compute the table again")
        if int(np.prod(self.grid_shape)) != f:
            raise ValueError(f"lens table: grid_shape {self.grid_shape} doesn't make {f} field points; correct it")
        if np.any(np.diff(self.wavelength_nm) <= 0):
            raise ValueError("lens table: wavelengths must ascend; sort them")
        for name in ("sample_pitch_um", "focal_length_mm", "f_number", "entrance_pupil_mm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"lens table: {name} {getattr(self, name)} is not above the limit of 0; correct it")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, LensTable) and self.content_hash == other.content_hash

    def __hash__(self) -> int:
        return hash(self.content_hash)

    def save(self, path: Path | str) -> None:
        """Write the table as .npz, completely or not at all; an existing file is replaced."""
        path = Path(path)
        values: dict[str, Any] = {item.name: np.asarray(getattr(self, item.name)) for item in fields(self)}
        handle, partial = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as stream:
                np.savez(stream, **values)
            Path(partial).chmod(0o644)
            Path(partial).replace(path)
        except BaseException:
            Path(partial).unlink(missing_ok=True)
            raise

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read what `save` wrote. ValueError, in one line, for a file that isn't there, is damaged or isn't a lens
        table.
        """
        try:
            with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
                values = {item.name: stored[item.name] for item in fields(cls)}
            plain: dict[str, Any] = {name: value.item() if value.ndim == 0 else value for name, value in values.items()}
            plain["grid_shape"] = tuple(int(count) for count in values["grid_shape"])
            plain["warnings"] = tuple(str(line) for line in values["warnings"])
            return cls(**plain)
        except (OSError, EOFError, KeyError, ValueError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{path}: not a lens table ({reason}); compute it again") from error


def load_cached(folder: Path, content_hash: str) -> LensTable | None:
    """Return the table with that hash from a cache folder; None where it isn't there, is damaged or is another's."""
    file = folder / f"{content_hash}.npz"
    if not file.is_file():
        return None
    with contextlib.suppress(ValueError):
        table = LensTable.load(file)
        if table.content_hash == content_hash:
            return table
    return None


def store_cached(folder: Path, table: LensTable) -> None:
    """Keep a table in a cache folder (made where it isn't there) under its hash."""
    folder.mkdir(parents=True, exist_ok=True)
    table.save(folder / f"{table.content_hash}.npz")
