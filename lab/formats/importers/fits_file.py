"""FITS frames, also compressed by gzip: one image of integers, and what its header says of the exposure.

The first row of the array is row 0, as it is stored; some programs show it at the bottom.
"""

from __future__ import annotations

import gzip
import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

import numpy as np

from lab.errors import InputError, one_line
from lab.formats.recording_set import Frame

#: Endings of FITS files, and of what gzip makes of them; bytes that one may hold, at most: 32768 x 32768 pixels of 16
#: bit.
FITS = (".fits", ".fit", ".fts")
GZIP = ".gz"
LARGEST_BYTES = 2 << 30
#: Words of IMAGETYP, in small letters, and the kind of capture.
IMAGE_TYPES = {"dark": "dark", "bias": "dark", "zero": "dark", "flat": "flat"}


@dataclass(frozen=True)
class FitsHeader:
    """What a header states; None where it has no such keyword.

    `kind` of IMAGETYP or OBSTYPE; `exposure_s` of EXPTIME or EXPOSURE; `temperature_c` of CCD-TEMP; `time` of DATE-OBS
    (UTC)."""

    image_type: str | None
    kind: str | None
    exposure_s: float | None
    temperature_c: float | None
    time: datetime | None


def is_fits(file: Path) -> bool:
    """Return whether a file is a FITS file by its ending, `.fits.gz` included."""
    return file.name.lower().removesuffix(GZIP).endswith(FITS)


def load_fits(file: Path) -> Frame:
    """Return the only image of a FITS file, uint16 (rows, cols) with BZERO and BSCALE applied. InputError without
    the path."""
    found, _ = _opened(file)
    if found.ndim != 2:
        raise InputError(f"has the shape {found.shape}, not (rows, cols); save one file a frame")
    if found.dtype.kind not in "iu" and not np.array_equal(found, np.rint(found)):
        raise InputError(f"its values are {found.dtype} with fractions; save raw DN as integers")
    if found.size and (found.min() < 0 or found.max() > np.iinfo(np.uint16).max):
        raise InputError(
            f"its values are {found.min():g} .. {found.max():g}; raw DN are 0 .. 65535: save them unscaled"
        )
    return np.ascontiguousarray(found, dtype=np.uint16)


def fits_header(file: Path, *, with_image: bool = True) -> FitsHeader:
    """Return what the header says; InputError without the path. Without `with_image`, the image isn't read, and damage
    in it stays unseen."""
    header = _opened(file)[1] if with_image else _header(file)
    stated = header.get("IMAGETYP", header.get("OBSTYPE"))
    words = str(stated).lower() if stated is not None else ""
    kind = next((kind for word, kind in IMAGE_TYPES.items() if word in words), None)
    return FitsHeader(
        str(stated).strip() if stated is not None else None,
        kind,
        _number(header, "EXPTIME", "EXPOSURE"),
        _number(header, "CCD-TEMP"),
        _time(header.get("DATE-OBS")),
    )


@contextmanager
def _stream(file: Path) -> Iterator[IO[bytes]]:
    """The file's bytes, uncompressed. Raises InputError where there are too many of them."""
    if not file.name.lower().endswith(GZIP):
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


def _header(file: Path) -> Any:
    """Return the header of the first image that isn't empty, with that of the file's beginning."""
    from astropy.io import fits

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with _stream(file) as stream, fits.open(stream, memmap=False, lazy_load_hdus=True) as opened:
                first = opened[0]
                image = next((hdu for hdu in opened if getattr(hdu, "is_image", False) and hdu.header["NAXIS"]), first)
                return first.header if image is first else first.header + image.header
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"damaged FITS ({one_line(error)}); copy it again or recapture") from error


def _opened(file: Path) -> tuple[Any, Any]:
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
                first = opened[0]
                found = [
                    (np.asarray(hdu.data), hdu.header if hdu is first else first.header + hdu.header) for hdu in images
                ]
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"damaged FITS ({one_line(error)}); copy it again or recapture") from error
    if len(found) != 1:
        raise InputError(f"holds {len(found)} images, not 1; save one file a frame")
    return found[0]


def _number(header: Any, *names: str) -> float | None:
    for name in names:
        value = header.get(name)
        if value is None:
            continue
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = np.nan
        if not np.isfinite(number):
            raise InputError(f"{name} = {value!r} isn't a number; correct the header")
        return number
    return None


def _time(stated: Any) -> datetime | None:
    try:
        time = datetime.fromisoformat(str(stated))
    except ValueError:
        return None
    return time if time.tzinfo is not None else time.replace(tzinfo=UTC)
