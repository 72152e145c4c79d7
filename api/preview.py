"""A raw frame as a small picture: black subtracted, one value per colour and mosaic cell, reduced, gamma-encoded."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.formats.recording_set import DataSheet
from sim.sensor.mosaic import planes

Form = Literal["png", "webp"]
#: The power law that approximates sRGB's encoding.
GAMMA = 2.2


#: Quality (of 100) of a picture as WebP: a tenth of the PNG's bytes, as noise isn't kept grain by grain.
WEBP_QUALITY = 80


def preview(
    frame: NDArray[np.uint16], camera: DataSheet, width_px: int, stretch: bool = False, form: Form = "png"
) -> bytes:
    """Return a picture of a frame, lossless as PNG or small as WebP. There is no white balance.

    frame : (rows, cols), DN
    camera : its data sheet; black is its black level, white its white level
    width_px : greatest width
    stretch : take the frame's 99.9th percentile as white, so that dark frames show what is in them

    >>> sheet = DataSheet(rows=4, cols=4, cfa="MONO", bit_depth=12)
    >>> preview(np.zeros((4, 4), np.uint16), sheet, 4)[1:4]
    b'PNG'
    """
    black = camera.black_level_dn or 0.0
    mosaic = {name: plane.astype(np.float32) for name, plane in planes(frame, camera.cfa).items()}
    if camera.cfa == "MONO":
        picture = mosaic["Y"]
    else:
        rows = min(plane.shape[0] for plane in mosaic.values())
        cols = min(plane.shape[1] for plane in mosaic.values())
        cut = {name: plane[:rows, :cols] for name, plane in mosaic.items()}
        picture = np.stack([cut["B"], (cut["G1"] + cut["G2"]) / 2, cut["R"]], axis=-1)  # OpenCV's order
    if picture.shape[1] > width_px:
        height_px = max(1, round(picture.shape[0] * width_px / picture.shape[1]))
        picture = cv2.resize(picture, (width_px, height_px), interpolation=cv2.INTER_AREA)
    white = float(np.percentile(picture, 99.9)) if stretch else camera.saturation_dn
    level = np.clip((picture - black) / max(white - black, 1.0), 0.0, 1.0)
    quality = [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY] if form == "webp" else []
    done, encoded = cv2.imencode(f".{form}", np.rint(255.0 * level ** (1.0 / GAMMA)).astype(np.uint8), quality)
    if not done:
        raise ValueError(f"OpenCV couldn't encode a picture of shape {picture.shape}")
    return encoded.tobytes()
