"""A frame at a glance: histogram, mean and share of saturated pixels of each channel of the mosaic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lab.formats.recording_set import DataSheet
from sim.parameters import Frozen
from sim.sensor.mosaic import planes

BINS = 64


class ChannelFigures(Frozen):
    """One channel of a frame. `counts`: pixels in each of the equal bins between 0 and the saturation;
    `saturated_share`: of its pixels, those at or above the data sheet's white level."""

    channel: str
    mean_dn: float
    saturated_share: float
    counts: tuple[int, ...]


class FrameFigures(Frozen):
    """A frame's channels: R, G1, G2, B, or Y. The bins are `bin_dn` wide and begin at 0 DN."""

    bin_dn: float
    black_level_dn: float | None
    saturation_dn: float
    channels: tuple[ChannelFigures, ...]


def frame_figures(frame: NDArray[np.uint16], camera: DataSheet) -> FrameFigures:
    """Return the figures of `frame` (rows, cols), from one count of the codes of each channel."""
    top = camera.saturation_dn
    bin_dn = (top + 1.0) / BINS
    found = []
    for name, plane in planes(frame, camera.cfa).items():
        codes = np.bincount(plane.ravel(), minlength=int(top) + 1)
        at = np.minimum((np.arange(codes.size) / bin_dn).astype(int), BINS - 1)
        found.append(
            ChannelFigures(
                channel=name,
                mean_dn=float(codes @ np.arange(codes.size) / plane.size),
                saturated_share=float(codes[int(np.ceil(top)) :].sum() / plane.size),
                counts=tuple(np.bincount(at, codes, BINS).astype(int).tolist()),
            )
        )
    return FrameFigures(bin_dn=bin_dn, black_level_dn=camera.black_level_dn, saturation_dn=top, channels=tuple(found))
