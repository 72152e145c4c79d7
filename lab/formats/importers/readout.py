"""Sensors that are read out by several taps, with overscan: `[[taps]]` of `camera.toml`.

    [[taps]]
    name = "A"
    region = [0, 0, 1024, 512]          # what collects light: row0, col0, row1, col1, end excluded
    overscan = [0, 1024, 1024, 1056]    # what the same tap reads without pixels: its bias
    black_level_dn = 100                # in place of an overscan

The regions tile a rectangle once the rows and columns that no region has are cut out: what lies between two taps has to
be overscan, that around them may be anything. `rows`, `cols` and `cfa` of the camera are those of the joined frame.
Each tap's black level is the mean of its overscan over the frames. Taps are shifted by whole DN to one black level;
codes stay codes. What is left, and unequal gains, is in the frames: `--tap NAME` imports one tap alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from lab.errors import InputError
from lab.formats.importers.images import ImageFiles, read_image
from lab.formats.recording_set import DataSheet, Frame
from sim.parameters import Frozen

#: Frames whose overscan is averaged, at most: evenly over the recording.
MOST_FRAMES = 32
#: Change of a tap's bias over the frames that is told, DN.
DRIFT_DN = 0.5

Region = tuple[int, int, int, int]


class Tap(Frozen):
    """One output of a sensor: the region that it reads, and how its black level is known."""

    name: str
    region: Region
    overscan: Region | None = None
    black_level_dn: float | None = None


@dataclass(frozen=True)
class Readout:
    """The taps of a sensor as they are imported: the rows and columns of the frame that are kept, and what is added to
    each tap's codes.

    `black_level_dn`: of the frames that come out. `remarks`: what was measured, in sentences.
    """

    taps: tuple[Tap, ...]
    rows: tuple[int, ...]
    cols: tuple[int, ...]
    shift_dn: tuple[int, ...]
    black_level_dn: float
    remarks: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frames that come out."""
        return len(self.rows), len(self.cols)

    def applied(self, frame: Frame) -> Frame:
        """Return a frame as it is stored, cropped, joined, and with its taps at one black level; codes don't fall
        below 0."""
        made = np.zeros(frame.shape, np.int64)
        for tap, shift in zip(self.taps, self.shift_dn, strict=True):
            made[_box(tap.region)] = frame[_box(tap.region)].astype(np.int64) + shift
        joined = made[np.ix_(self.rows, self.cols)]
        return np.ascontiguousarray(np.clip(joined, 0, np.iinfo(np.uint16).max), dtype=np.uint16)


class TapFiles(ImageFiles):
    """Images whose frames are cropped, joined and levelled as a `Readout` says."""

    def __init__(self, root: Path, images: Mapping[str, Path], readouts: Mapping[str, Readout]) -> None:
        """`readouts`: by the frame's path in the recording set."""
        super().__init__(root, images)
        self.readouts = dict(readouts)

    def frame(self, path: str, camera: DataSheet) -> Frame:
        frame = super().frame(path, camera)
        return self.readouts[path].applied(frame) if path in self.readouts else frame


def parse_taps(listed: Any, where: str) -> tuple[Tap, ...]:
    """`[[taps]]` of a camera file."""
    try:
        taps = tuple(Tap.model_validate(item) for item in listed)
    except (ValidationError, TypeError) as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else {"loc": ("taps",), "msg": "not a list"}
        key = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{where}: taps: {key}: {first['msg']}; write name, region and overscan of each") from error
    names = [tap.name for tap in taps]
    if len(set(names)) < len(names):
        raise InputError(f"{where}: taps: two have one name ({', '.join(names)}); rename one")
    return taps


def readout(taps: Sequence[Tap], files: Sequence[Path], shape: tuple[int, int], where: str) -> Readout:
    """Return how frames of `shape` (rows, cols) are cropped and levelled. Raises InputError where a region isn't inside
    the frame, the regions don't tile a rectangle, or a black level isn't known."""
    for tap in taps:
        _check_inside(tap, shape, where)
    kept_rows, kept_cols, cut = _tiled(taps, shape, where)
    unknown = [tap.name for tap in taps if tap.overscan is None and tap.black_level_dn is None]
    if unknown:
        raise InputError(
            f"{where}: tap {', '.join(unknown)}: neither overscan nor black_level_dn; write one of them for each tap"
        )
    measured = _overscan_means(taps, files)
    levels = []
    remarks = [f"{where}: overscan between the taps is cut out and the rest joined: {', '.join(cut)}"] if cut else []
    for tap in taps:
        means = measured.get(tap.name)
        if means is None:
            levels.append(float(tap.black_level_dn or 0.0))
            continue
        levels.append(float(np.mean(means)))
        std = float(np.std(means, ddof=1)) if len(means) > 1 else 0.0
        drift = f", which changes by {np.ptp(means):.2g} DN over the frames" if np.ptp(means) > DRIFT_DN else ""
        remarks.append(
            f"{where}: tap {tap.name}: overscan of {len(means)} frames {levels[-1]:.2f} +- "
            f"{std / np.sqrt(len(means)):.2g} DN{drift}"
        )
    common = min(levels)
    shift = tuple(-round(level - common) for level in levels)
    left = [level + moved for level, moved in zip(levels, shift, strict=True)]
    if len(taps) > 1:
        said = ", ".join(f"{tap.name} {moved:+d}" for tap, moved in zip(taps, shift, strict=True))
        remarks.append(
            f"{where}: taps shifted by whole DN to one black level ({said}); they still differ by {np.ptp(left):.2g} "
            "DN, and by their "
            "gains: --tap NAME imports one alone"
        )
    return Readout(tuple(taps), kept_rows, kept_cols, shift, float(np.mean(left)), tuple(remarks))


def _box(region: Region) -> tuple[slice, slice]:
    return slice(region[0], region[2]), slice(region[1], region[3])


def _check_inside(tap: Tap, shape: tuple[int, int], where: str) -> None:
    for name, region in (("region", tap.region), ("overscan", tap.overscan)):
        if region is None:
            continue
        row0, col0, row1, col1 = region
        if not (0 <= row0 < row1 <= shape[0] and 0 <= col0 < col1 <= shape[1]):
            raise InputError(
                f"{where}: tap {tap.name}: {name} {list(region)} isn't inside the frame of {shape[0]} x {shape[1]}; "
                "give [row0, col0, row1, col1], end excluded"
            )


def _tiled(
    taps: Sequence[Tap], shape: tuple[int, int], where: str
) -> tuple[tuple[int, ...], tuple[int, ...], list[str]]:
    """Return the rows and the columns that the regions tile, and the runs between them that are cut out, in words."""
    count, overscan = np.zeros(shape, np.uint8), np.zeros(shape, bool)
    for tap in taps:
        count[_box(tap.region)] += 1
        if tap.overscan is not None:
            overscan[_box(tap.overscan)] = True
    rows, cols = np.flatnonzero(count.any(axis=1)), np.flatnonzero(count.any(axis=0))
    for tap in taps:
        if tap.overscan is not None and count[_box(tap.overscan)].any():
            raise InputError(
                f"{where}: tap {tap.name}: overscan {list(tap.overscan)} holds pixels of a tap's region; correct one "
                "of them"
            )
    cut = []
    for name, kept, blank in (
        ("row", rows, np.asarray(overscan[:, cols].all(axis=1))),
        ("column", cols, np.asarray(overscan[rows].all(axis=0))),
    ):
        between = np.setdiff1d(np.arange(kept[0], kept[-1] + 1), kept)
        for run in np.split(between, np.flatnonzero(np.diff(between) > 1) + 1) if between.size else ():
            if not blank[run].all():
                raise InputError(
                    f"{where}: the taps' regions leave gaps: {name} {run[0]}..{run[-1]} belongs to no region, and "
                    "isn't all overscan; "
                    "correct the regions, or state the overscan"
                )
            cut.append(f"{name} {run[0]}..{run[-1]}")
    if np.any(count[np.ix_(rows, cols)] != 1):
        box = [int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1]
        raise InputError(f"{where}: the taps' regions leave gaps or overlap; they have to tile {box}: correct them")
    return tuple(rows.tolist()), tuple(cols.tolist()), cut


def _overscan_means(taps: Sequence[Tap], files: Sequence[Path]) -> dict[str, list[float]]:
    """Means of each tap's overscan in some of the frames, DN."""
    chosen = [files[int(i)] for i in np.unique(np.linspace(0, len(files) - 1, MOST_FRAMES).round())]
    means: dict[str, list[float]] = {}
    if all(tap.overscan is None for tap in taps):
        return means
    for file in chosen:
        frame = read_image(file)
        for tap in taps:
            if tap.overscan is not None:
                means.setdefault(tap.name, []).append(float(frame[_box(tap.overscan)].mean()))
    return means
