"""Small pictures as PNG data for the page: kernels, colour patches, the chart as the camera saw it."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.errors import cannot_write
from lab.fit.noise.pixel_maps import PixelMaps
from lab.formats.raw_file import replacing
from lab.formats.recording_set import DataSheet
from lab.formats.results import PatchComparison
from sim.sensor.mosaic import planes

DISPLAY_GAMMA = 2.2
WEBP_QUALITY = 85


def png(image: NDArray[np.uint8]) -> bytes:
    """Return an image (rows, cols) or (rows, cols, 3: R, G, B) as a PNG file's content.

    >>> png(np.zeros((2, 2), np.uint8))[1:4]
    b'PNG'
    """
    pixels = image if image.ndim == 2 else image[..., ::-1]
    _, data = cv2.imencode(".png", np.ascontiguousarray(pixels))
    return data.tobytes()


def png_data_uri(image: NDArray[np.uint8]) -> str:
    """Return an image (rows, cols) or (rows, cols, 3: R, G, B) as the text of a PNG data URI.

    >>> png_data_uri(np.zeros((2, 2), np.uint8))[:22]
    'data:image/png;base64,'
    """
    return "data:image/png;base64," + base64.b64encode(png(image)).decode("ascii")


def photograph_data_uri(image: NDArray[np.uint8]) -> str:
    """Return an image to look at, not to measure in: a WebP data URI, a tenth of the PNG's size.

    image : (rows, cols) or (rows, cols, 3: R, G, B)

    >>> photograph_data_uri(np.zeros((8, 8), np.uint8))[:15]
    'data:image/webp'
    """
    pixels = image if image.ndim == 2 else image[..., ::-1]
    _, data = cv2.imencode(".webp", np.ascontiguousarray(pixels), [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY])
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def kernel_picture(kernel: ArrayLike, peak: float, margin: int = 0) -> str:
    """Return a kernel in colours from 0 to `peak` on a square-root scale, as the text of a PNG data URI.

    kernel : (n, n)
    peak : value of the brightest colour
    margin : cells that are cut off at each border

    >>> kernel_picture(np.eye(9) / 9.0, 0.2, margin=1)[:14]
    'data:image/png'
    """
    values = np.asarray(kernel, float)
    if margin:
        values = values[margin:-margin, margin:-margin]
    scaled = np.sqrt(np.clip(values / peak, 0.0, 1.0))
    coloured = cv2.applyColorMap((255 * scaled).round().astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return png_data_uri(np.ascontiguousarray(coloured[..., ::-1], dtype=np.uint8))


def map_picture(values: ArrayLike, width_px: int | None = None) -> tuple[NDArray[np.uint8], float, float]:
    """Return a map in colours from its 1st percentile (dark) to its 99th (bright), and these two.

    values : (rows, cols)
    width_px : columns to which it is averaged down where it has more

    Returns the picture (rows, cols, 3: R, G, B) and both percentiles, in the unit of the map.

    >>> picture, low, high = map_picture(np.linspace(0.0, 1.0, 101)[None].repeat(4, axis=0))
    >>> picture.shape, round(low, 2), round(high, 2)
    ((4, 101, 3), 0.01, 0.99)
    """
    given = np.asarray(values, float)
    low, high = (float(limit) for limit in np.percentile(given, [1.0, 99.0]))
    share = np.clip((given - low) / max(high - low, 1e-12), 0.0, 1.0)
    if width_px is not None and (scale := width_px / share.shape[1]) < 1:
        share = cv2.resize(share, (width_px, round(share.shape[0] * scale)), interpolation=cv2.INTER_AREA)
    coloured = cv2.applyColorMap((255 * share).round().astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(coloured[..., ::-1], dtype=np.uint8), low, high


def difference_picture(difference: ArrayLike, limit: float, margin: int = 0) -> str:
    """Return a signed difference in blue (-limit) through white (0) to red (+limit), as the text of a PNG data URI.

    difference : (n, n)
    limit : of the colours
    margin : cells that are cut off at each border

    >>> difference_picture(np.zeros((9, 9)), 0.1)[:14]
    'data:image/png'
    """
    values = np.asarray(difference, float)
    if margin:
        values = values[margin:-margin, margin:-margin]
    share = np.clip(values / limit, -1.0, 1.0)
    red, blue = np.array([178, 24, 43]), np.array([33, 102, 172])
    towards = np.where(share[..., None] > 0, red, blue)
    mixed = 255 + np.abs(share)[..., None] * (towards - 255.0)
    return png_data_uri(mixed.round().astype(np.uint8))


def trim_margin(kernels: list[NDArray[np.float64]], share: float = 0.02) -> int:
    """Return the width of the border, in cells, in which all `kernels` stay below `share` of their highest value.

    kernels : (n, n) each; at least 7 cells of them are left

    >>> trim_margin([np.pad([[1.0]], 10)])
    7
    """
    highest = max(float(kernel.max()) for kernel in kernels)
    size = min(min(kernel.shape) for kernel in kernels)
    margin = 0
    while size - 2 * (margin + 1) >= 7 and all(
        np.abs(np.concatenate([k[margin], k[-1 - margin], k[:, margin], k[:, -1 - margin]])).max() < share * highest
        for k in kernels
    ):
        margin += 1
    return margin


def patch_colours(patches: tuple[PatchComparison, ...]) -> dict[str, tuple[str, str]]:
    """Return (measured, predicted) of each patch as CSS colours: camera R, G, B balanced on the measured white patch,
    gamma 2.2.

    These are camera colours, not colorimetry. Both get the same balance, so that a difference on the page is one in the
    recording.

    >>> from lab.formats.results.validation import PatchComparison
    >>> white = [PatchComparison(patch="white 9.5 (.05 D)", channel=c, predicted_dn=900.0, predicted_dn_std=1.0,
    ...     measured_dn=1000.0, measured_dn_std=1.0) for c in "RGB"]
    >>> len(patch_colours(tuple(white))["white 9.5 (.05 D)"])
    2
    """
    measured: dict[str, dict[str, float]] = {}
    predicted: dict[str, dict[str, float]] = {}
    for patch in patches:
        measured.setdefault(patch.patch, {})[patch.channel] = patch.measured_dn
        predicted.setdefault(patch.patch, {})[patch.channel] = patch.predicted_dn
    channels = ("R", "G", "B") if any("R" in values for values in measured.values()) else ("Y", "Y", "Y")
    whitest = max(measured.values(), key=lambda values: min(values.get(channel, 0.0) for channel in channels))

    def css(values: dict[str, float]) -> str:
        share = [values.get(channel, 0.0) / max(whitest.get(channel, 1.0), 1e-9) * 0.9 for channel in channels]
        return "#" + "".join(f"{round(255 * min(max(value, 0.0), 1.0) ** (1 / DISPLAY_GAMMA)):02x}" for value in share)

    return {name: (css(measured[name]), css(predicted[name])) for name in measured}


def frame_picture(frame: NDArray[np.uint16], camera: DataSheet, width_px: int = 480) -> str:
    """Return a frame for display, as the text of a data URI: one pixel per Bayer cell, black subtracted, each channel
    scaled to its 99.5 % quantile.

    frame : (rows, cols), DN
    camera : its data sheet
    width_px : greatest width

    >>> sheet = DataSheet(rows=8, cols=8, cfa="RGGB", bit_depth=12)
    >>> frame_picture(np.full((8, 8), 100, np.uint16), sheet)[:11]
    'data:image/'
    """
    split: dict[str, Any] = planes(frame.astype(np.float32) - float(camera.black_level_dn or 0.0), camera.cfa)
    if camera.cfa == "MONO":
        colours = np.stack([split["Y"]] * 3, axis=-1)
    else:
        colours = np.stack([split["R"], (split["G1"] + split["G2"]) / 2, split["B"]], axis=-1)
    tops = np.percentile(colours, 99.5, axis=(0, 1))
    display = np.clip(colours / np.maximum(tops, 1e-6), 0.0, 1.0) ** (1 / DISPLAY_GAMMA)
    factor = width_px / display.shape[1]
    if factor < 1:
        size = (width_px, max(1, round(display.shape[0] * factor)))
        display = cv2.resize(display, size, interpolation=cv2.INTER_AREA)
    return photograph_data_uri((255 * display).round().astype(np.uint8))


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
        raise cannot_write(folder, error, "name another folder") from error
    return tuple(names)
