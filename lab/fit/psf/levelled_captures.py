"""Captures of a screen pose, averaged and levelled between black and white."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.bernoulli import BernoulliCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from sim.camera import Side
from sim.sensor.mosaic import planes

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class ScreenPictures:
    """Pictures of one pose of the screen, repeats averaged: 0 as black, 1 as white, NaN where the screen isn't.

    `first` is the first of the Bernoulli captures; `checkerboard`, `bernoulli` are (rows, cols) of the frame, their
    targets (rows, cols) of cells.
    """

    first: BernoulliCapture
    checkerboard: Array
    bernoulli: Array
    checkerboard_target: NDArray[np.uint8]
    bernoulli_target: NDArray[np.uint8]


def screen_pictures(recordings: RecordingSet, side: Side) -> list[ScreenPictures]:
    """Levelled pictures (p - black) / (white - black) for every pose and Bernoulli target of `side`.

    A pose that lacks one of the four kinds of captures is left out. Raises `NotDetermined` where none is left.
    """
    shown: dict[str, dict[tuple[str, str], list[Any]]] = {}
    for kind in ("white", "black", "checkerboard", "bernoulli"):
        for capture in recordings.captures(kind, side):
            key = (kind, getattr(capture, "target", ""))
            shown.setdefault(capture.screen.pose, {}).setdefault(key, []).append(capture)
    if not any(kind == "bernoulli" for kinds in shown.values() for kind, _ in kinds):
        raise NotDetermined("psf", "no bernoulli captures")
    found, reason = [], ""
    for pose, kinds in shown.items():
        present = {kind for kind, _ in kinds}
        if "bernoulli" not in present:
            continue
        missing = [kind for kind in ("white", "black", "checkerboard") if kind not in present]
        if missing:
            reason = f"pose {pose} lacks a {' and a '.join(missing)} capture: take it before the screen moves"
            continue
        boards = next(key for key in kinds if key[0] == "checkerboard")
        for key in [key for key in kinds if key[0] == "bernoulli"]:
            try:
                white, black, board, pattern = (
                    _mean_rate(recordings, kinds[name]) for name in (("white", ""), ("black", ""), boards, key)
                )
            except NotDetermined as refused:
                reason = refused.reason
                continue
            contrast = white - black
            for plane in planes(contrast, recordings.camera(side).cfa).values():
                plane[plane < 0.2 * np.quantile(plane, 0.98)] = np.nan
            found.append(
                ScreenPictures(
                    first=kinds[key][0],
                    checkerboard=(board - black) / contrast,
                    bernoulli=(pattern - black) / contrast,
                    checkerboard_target=recordings.target(boards[1]),
                    bernoulli_target=recordings.target(key[1]),
                )
            )
    if not found:
        raise NotDetermined("psf", reason)
    return found


def _mean_rate(recordings: RecordingSet, captures: Sequence[Any]) -> Array:
    """Mean of the frames above black, DN/s. Raises `NotDetermined` where one is saturated."""
    camera = recordings.camera(captures[0].side)
    total = np.zeros((camera.rows, camera.cols))
    for capture in captures:
        frame = recordings.frame(capture)
        saturated = float(np.mean(frame >= camera.saturation_dn))
        if saturated > 0.001:
            raise NotDetermined(
                "psf", f"{capture.id}: {100 * saturated:.1f} % of the frame is saturated; expose it shorter"
            )
        total += (frame.astype(float) - (camera.black_level_dn or 0.0)) / max(capture.exposure_s, 1e-12)
    return total / len(captures)
