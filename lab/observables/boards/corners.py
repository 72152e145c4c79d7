"""Corners of the boards of one side: what fits and diagnosis take of its `charuco` captures.

Boards are found once in a recording set, and their corners are fitted once in each plane of the 2 x 2 cell of the
mosaic. Neither the mosaic's colours nor levels, exposures or the lens are used. What is used of the statements is the
board: its dictionary, its numbers of squares, and the side of a marker over that of a square, which says where markers
are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.charuco import CharucoCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import CELLS, RecordingSet
from lab.formats.results import Skipped
from lab.observables.boards.corner_fits import CornerFits
from lab.observables.boards.detection import find_board, levelled, luminance
from lab.observables.boards.dots import dot_centres
from lab.observables.boards.refinement import bend_px, refine_corners
from lab.observables.boards.views import BoardView
from sim.camera import Cfa, Side
from sim.sensor.mosaic import phases

#: Displacement of corners by the curvature of their edges (rms; median over the views), below which edges are taken as
#: straight: half of the hundredth of a pixel that corners are fitted to. Pictures through a pinhole show 0.001 px.
LEAST_BEND_PX = 0.005


@dataclass(frozen=True)
class BoardCorners:
    """The corners of a side's boards, in `views` by capture, each with its standard deviation by the noise of the
    picture.

    `missed`: captures in which no board is found, with the reason.
    """

    views: tuple[BoardView, ...]
    missed: tuple[Skipped, ...]

    def by_capture(self) -> dict[str, BoardView]:
        """Return the views by the id of their capture."""
        return {view.capture.id: view for view in self.views}


def board_corners(recordings: RecordingSet, side: Side) -> BoardCorners:
    """Return the corners of all `charuco` captures of `side`, found once. Where the lens bends edges so far that it
    counts, they are found again by corners of bent edges.
    """

    def found() -> BoardCorners:
        straight = _find_boards(recordings, side, bent=False)
        bends = [bend_px(view) for view in straight.views if view.capture.dictionary != "dots"]
        if bends and float(np.median(bends)) > LEAST_BEND_PX:
            return _find_boards(recordings, side, bent=True)
        return straight

    return recordings.once(("corners of boards", side), found)


def _find_boards(recordings: RecordingSet, side: Side, *, bent: bool) -> BoardCorners:
    """Find the boards of all captures, with edges that are straight or `bent`."""
    views, missed = [], []
    for capture in recordings.captures(CharucoCapture, side):
        try:
            views.append(find_board(luminance(recordings.frame(capture)), capture, bent=bent))
        except NotDetermined as refused:
            missed.append(Skipped(step=capture.id, reason=refused.reason, side=side))
    return BoardCorners(tuple(views), tuple(missed))


def plane_corners(recordings: RecordingSet, view: BoardView) -> dict[tuple[int, int], CornerFits]:
    """Return the corners of a view of `board_corners`, fitted once in each plane of the 2 x 2 cell, in px of the frame,
    by the first pixel (row, column) of the plane.
    """

    def fitted() -> dict[tuple[int, int], CornerFits]:
        frame = recordings.frame(view.capture)
        return {place: _fit_plane(frame, place, view) for place in CELLS}

    return recordings.once(("corners of planes", view.capture.id), fitted)


def _fit_plane(frame: NDArray[np.generic], place: tuple[int, int], view: BoardView) -> CornerFits:
    """Fit the corners of a view on the pixels of one plane of its `frame` (rows, cols), DN."""
    (row, col), capture = place, view.capture
    rows, cols = capture.squares
    plane = levelled(np.asarray(frame[row::2, col::2], dtype=float))
    guess = (view.image_px - [col, row]) / 2.0
    if capture.dictionary == "dots":
        fits = dot_centres(plane, guess, rows - 1, cols - 1, view.index)
    else:
        marker_mm = float(capture.marker_mm or 0.0) if capture.has_markers else 0.0
        fits = refine_corners(
            plane, guess, view.board_mm[:, :2], capture.square_mm, marker_mm, rows, cols, bent=view.bent
        )
    return CornerFits(2.0 * fits.points + [col, row], fits.trusted, 2.0 * fits.std_px)


def channel_corners(planes: Mapping[tuple[int, int], CornerFits], cfa: Cfa) -> dict[str, CornerFits]:
    """Return the corners in each channel of a colour mosaic, from those in the planes of its cell: of green, their mean
    in its two planes.
    """
    found: dict[str, CornerFits] = {}
    for channel, places in phases(cfa).items():
        fits = [planes[place] for place in places]
        found[channel] = CornerFits(
            np.mean([one.points for one in fits], axis=0),
            np.all([one.trusted for one in fits], axis=0),
            np.sqrt(np.mean([one.std_px**2 for one in fits], axis=0) / len(fits)),
        )
    return found
