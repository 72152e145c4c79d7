"""A stated size of a screen's cells that the frames contradict."""

from __future__ import annotations

from typing import Any

import numpy as np

from lab.diagnose.measurements.pattern_fit import BERNOULLI
from lab.diagnose.metadata.misstatement import Misstatement
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.measure.screen_registration import ScreenPictures, register, screen_pictures
from sim.camera import Side


def misstated_cell_size(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a `cell_camera_px` that differs by more than `cell_size_tolerance` from the size of the cells in the
    middle of the pattern; None where it fits.

    The registration finds the size by itself: the stated one is only its start.
    """
    try:
        pictures = [one for one in screen_pictures(recordings, side) if one.first.screen.cell_camera_px is not None]
    except NotDetermined:
        return None
    sizes: dict[float, float] = {}
    for one in pictures:
        stated = one.first.screen.cell_camera_px
        if stated is not None and stated not in sizes:
            measured = _cell_px(one, stated)
            if measured is not None:
                sizes[stated] = measured
    off = {stated: size for stated, size in sizes.items() if abs(size / stated - 1.0) > policy.cell_size_tolerance}
    if not off:
        return None
    std = policy.cell_size_tolerance / 5.0

    def restated(capture: Any) -> Any:
        screen = getattr(capture, "screen", None)
        if capture.side != side or screen is None or screen.cell_camera_px not in off:
            return capture
        size = {"cell_camera_px": round(off[screen.cell_camera_px], 4)}
        return capture.model_copy(update={"screen": screen.model_copy(update=size)})

    captures = tuple(restated(c) for c in recordings.manifest.captures)
    changed = tuple(new.id for old, new in zip(recordings.manifest.captures, captures, strict=True) if new is not old)
    told = ", ".join(f"{size:.3f} px and not {stated:g}" for stated, size in off.items())
    return Misstatement(
        measurement=BERNOULLI,
        where="cells of the screen",
        shape="the stated size of the screen's cells contradicts the checkerboard's corners",
        check=f"The screen's cells are {told} in the pictures of the {side} camera: correct cell_camera_px.",
        chi2_stated=float(sum((np.log(size / stated) / std) ** 2 for stated, size in off.items())),
        chi2_corrected=0.0,
        n=len(off),
        captures=changed,
        corrected=recordings.under(recordings.manifest.model_copy(update={"captures": captures})),
    )


def _cell_px(pictures: ScreenPictures, stated: float) -> float | None:
    """Side of a cell in camera px: the square root of its area in the middle of the pattern; None where the pattern
    isn't found."""
    try:
        warp = register(
            pictures.checkerboard, pictures.bernoulli, pictures.checkerboard_target, pictures.bernoulli_target, stated
        )
    except NotDetermined:
        return None
    rows, cols = np.nonzero(np.isfinite(pictures.checkerboard))
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    cells = warp.cells(corner + np.array([cols.mean(), rows.mean()]))
    (ax, ay), (bx, by) = cells[1] - cells[0], cells[2] - cells[0]
    return float(1.0 / np.sqrt(abs(ax * by - ay * bx)))
