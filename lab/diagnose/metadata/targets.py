"""Statements about screens and boards that their frames contradict: squares, markers and the size of cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.charuco import CharucoCapture
from lab.diagnose.metadata.misstatement import Misstatement
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.observables.boards.detection import as_grey, luminance
from lab.observables.boards.residuals import BOARDS
from lab.observables.screens.contrast import BERNOULLI
from lab.observables.screens.placement import pattern_place
from lab.observables.screens.poses import ScreenPictures, ScreenPose, refuse_saturated, screen_poses
from sim.camera import Side

Array = NDArray[np.floating[Any]]
Grey = NDArray[np.uint8]
FEWEST_MARKERS = 6  # of a frame: a homography has 8 parameters, and a marker's centre gives two equations
MOST_COLUMNS = 40  # of a board, squares
LARGEST_PX = 1000.0  # side of a frame in which a plain board's corners are counted; larger frames are reduced
SMALLEST_GRID = (3, 3)  # inner corners from which the search for a plain board starts

LOOKED_AT = 6  # most frames of a board that are used


@dataclass(frozen=True)
class BoardLayout:
    """The layout that frames of a board fit."""

    squares: tuple[int, int]  # rows, columns
    marker_share: float | None  # a marker's side over a square's; None without markers
    marker_px: float | None  # a marker's side; None without markers
    rms: (
        float | None
    )  # rms distance of the markers' centres from their places, over a marker's side; None without markers
    rms_stated: float | None  # the same with the stated squares; None without markers, or where no homography fits
    pictures: int  # number of frames used


@dataclass(frozen=True)
class _Markers:
    """The n markers found in one frame."""

    number: NDArray[np.int64]
    corners: Array  # (n, 4, 2), px
    centres: Array  # (n, 2), px
    shape: tuple[int, int]  # of the frame: rows, columns

    @property
    def side_px(self) -> float:
        """Return the median side of a marker, px."""
        return float(np.median(np.linalg.norm(np.roll(self.corners, 1, axis=1) - self.corners, axis=2)))


def board_layout(
    pictures: Sequence[Grey], capture: CharucoCapture, policy: DecisionPolicy = DEFAULT_POLICY
) -> BoardLayout | None:
    """Find the layout that frames (rows, cols) of one board fit; None where they don't determine it. `capture`: what is
    stated about it.
    """
    if capture.dictionary == "none":
        return _plain_layout(pictures)
    code = getattr(cv2.aruco, capture.dictionary, None)
    if not capture.has_markers or not isinstance(code, int):
        return None
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(code))
    seen = [found for picture in pictures if (found := _markers(detector, picture)) is not None]
    if not seen:
        return None
    stated_cols = capture.squares[1]
    of_stated = {(stated_cols, parity): _rms(seen, stated_cols, parity) for parity in (0, 1)}
    rms_stated = min(of_stated.values())
    rms = of_stated
    if rms_stated > policy.board_fit:
        rms = {(count, parity): _rms(seen, count, parity) for count in range(2, MOST_COLUMNS + 1) for parity in (0, 1)}
    (cols, parity), best = min(rms.items(), key=lambda item: item[1])
    if best > policy.board_fit or any(
        other < policy.board_rival_ratio * best for (count, _), other in rms.items() if count != cols
    ):
        return None
    rows = 1 + max(int(_places(one.number, cols, parity)[:, 1].max()) for one in seen)
    stated_rows = capture.squares[0]
    if stated_rows > rows and _absent(seen, cols, parity, rows, stated_rows) < policy.absent_markers:
        rows = stated_rows
    return BoardLayout(
        squares=(rows, cols),
        marker_share=float(np.median(np.concatenate([_sides(one, cols, parity) for one in seen]))),
        marker_px=float(np.median([one.side_px for one in seen])),
        rms=best,
        rms_stated=rms_stated if np.isfinite(rms_stated) else None,
        pictures=len(seen),
    )


def _markers(detector: Any, picture: Grey) -> _Markers | None:
    """Find the markers whose number occurs once in a frame; None for fewer than `FEWEST_MARKERS`."""
    corners, ids, _ = detector.detectMarkers(picture)
    if ids is None:
        return None
    number = ids.ravel().astype(np.int64)
    quads = np.asarray(corners, float).reshape(-1, 4, 2)
    once = np.array([np.count_nonzero(number == one) == 1 for one in number])
    if once.sum() < FEWEST_MARKERS:
        return None
    number, quads = number[once], quads[once]
    # the centre is where the diagonals meet, which a projection keeps
    along, across = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    between = quads[:, 1] - quads[:, 0]
    share = (between[:, 0] * across[:, 1] - between[:, 1] * across[:, 0]) / (
        along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    )
    rows, cols = picture.shape
    return _Markers(number, quads, quads[:, 0] + share[:, None] * along, (rows, cols))


def _places(number: NDArray[np.int64], cols: int, parity: int) -> Array:
    """Return the places (n, 2), (x, y) in squares, of markers on a board of `cols` columns, whose first light square is
    the first (parity 0) or the second (parity 1).
    """
    rows = 2 * (int(number.max()) // cols + 2)
    row, col = np.nonzero((np.indices((rows, cols)).sum(axis=0) + parity) % 2 == 0)
    return np.column_stack([col, row])[number].astype(float)


def _homography(one: _Markers, cols: int, parity: int) -> tuple[Array, float] | None:
    """Fit the homography from the board (squares) to the frame (px) to all markers. Returns it with the rms distance of
    their centres from it, px; None where none fits.
    """
    places = _places(one.number, cols, parity)
    if np.ptp(places[:, 0]) == 0 or np.ptp(places[:, 1]) == 0:
        return None
    found, _ = cv2.findHomography(places, one.centres, 0)
    if found is None:
        return None
    left = cv2.perspectiveTransform(places[:, None], found)[:, 0] - one.centres
    return found, float(np.sqrt(np.mean(np.sum(left**2, axis=1))))


def _rms(seen: Sequence[_Markers], cols: int, parity: int) -> float:
    """Return the rms distance of the markers' centres from the homographies of all frames, over a marker's side;
    infinite where a frame has none.
    """
    total, count = 0.0, 0
    for one in seen:
        fitted = _homography(one, cols, parity)
        if fitted is None or not np.isfinite(fitted[1]):
            return np.inf
        total += len(one.number) * (fitted[1] / one.side_px) ** 2
        count += len(one.number)
    return float(np.sqrt(total / count))


def _sides(one: _Markers, cols: int, parity: int) -> Array:
    """Return the sides (n,) of the markers, in squares."""
    fitted = _homography(one, cols, parity)
    assert fitted is not None  # the layout fits
    flat = cv2.perspectiveTransform(one.corners.reshape(-1, 1, 2), np.linalg.inv(fitted[0])).reshape(-1, 4, 2)
    return np.asarray(np.linalg.norm(np.roll(flat, 1, axis=1) - flat, axis=2).mean(axis=1))


def _absent(seen: Sequence[_Markers], cols: int, parity: int, rows: int, stated: int) -> int:
    """Count the markers of the rows from `rows` to `stated` that should lie inside frames in which they aren't
    found."""
    row, col = np.nonzero((np.indices((stated, cols)).sum(axis=0) + parity) % 2 == 0)
    beyond = np.column_stack([col, row])[row >= rows].astype(float)
    absent = 0
    for one in seen:
        fitted = _homography(one, cols, parity)
        if fitted is None:
            continue
        at = cv2.perspectiveTransform(beyond[:, None], fitted[0])[:, 0]
        margin = 1.5 * one.side_px
        absent += int(np.all((at > margin) & (at < np.array(one.shape[::-1]) - margin), axis=1).sum())
    return absent


def _plain_layout(pictures: Sequence[Grey]) -> BoardLayout | None:
    """Count the squares of a plain checkerboard, the smaller number first, where most frames show the same number; else
    None.

    A board that is stated too small would be found anywhere on the larger one, at unrelated poses in the frames of a
    pair.
    """
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    counts: list[tuple[int, int]] = []
    for picture in pictures:
        shrink = min(1.0, LARGEST_PX / max(picture.shape))
        small = (
            cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1.0 else picture
        )
        found, _, meta = cv2.findChessboardCornersSBWithMeta(small, SMALLEST_GRID, flags)
        if found:
            rows, cols = sorted(meta.shape[:2])
            counts.append((rows + 1, cols + 1))
    if not counts:
        return None
    squares = max(set(counts), key=counts.count)
    if 2 * counts.count(squares) <= len(counts):
        return None
    return BoardLayout(squares, None, None, None, None, counts.count(squares))


def misstated_board(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return the boards whose frames fit another number of squares, or another ratio of marker to square, than stated;
    None where all fit.

    The length of a square can't be checked: a board twice as large at twice the distance gives the same image.
    """
    boards: dict[tuple[Any, ...], list[CharucoCapture]] = {}
    for capture in recordings.captures(CharucoCapture, side):
        boards.setdefault((capture.dictionary, capture.squares, capture.square_mm, capture.marker_mm), []).append(
            capture
        )
    lines: list[str] = []
    changed: dict[str, dict[str, Any]] = {}
    chi2, n = 0.0, 0
    for captures in boards.values():
        stated = captures[0]
        spread = captures[:: max(1, len(captures) // LOOKED_AT)][:LOOKED_AT]
        layout = board_layout([as_grey(luminance(recordings.frame(one))) for one in spread], stated, policy)
        if layout is None or layout.pictures < policy.board_frames:
            continue
        update, told = _contradicted(stated, layout, policy)
        if not update:
            continue
        lines += told
        changed |= {one.id: update for one in captures}
        off = layout.rms_stated / layout.rms if layout.rms and layout.rms_stated else 10.0
        chi2, n = chi2 + layout.pictures * max(off, 10.0) ** 2, n + layout.pictures
    if not changed:
        return None

    def restated(capture: Any) -> Any:
        return capture.model_copy(update=changed[capture.id]) if capture.id in changed else capture

    manifest = recordings.manifest
    captures_now = tuple(restated(one) for one in manifest.captures)
    return Misstatement(
        measurement=BOARDS,
        where="boards",
        shape="what is stated of a board contradicts its pictures",
        check=f"In the pictures of the {side} camera {'; '.join(lines)}. No picture tells the length of a square: "
        "square_mm stays as stated.",
        chi2_stated=chi2,
        chi2_corrected=float(n),
        n=n,
        captures=tuple(changed),
        corrected=recordings.under(manifest.model_copy(update={"captures": captures_now})),
    )


def _contradicted(
    stated: CharucoCapture, layout: BoardLayout, policy: DecisionPolicy
) -> tuple[dict[str, Any], list[str]]:
    """Return the fields of a board that its frames contradict, and the sentences that say so."""
    update: dict[str, Any] = {}
    told = []
    same = layout.squares == stated.squares or (not stated.has_markers and layout.squares == stated.squares[::-1])
    if not same:
        update["squares"] = layout.squares
        (rows, cols), (rows_stated, cols_stated) = layout.squares, stated.squares
        told.append(
            f"a board has {rows} x {cols} squares and not {rows_stated} x {cols_stated}: correct squares to [{rows}, "
            f"{cols}]"
        )
    if layout.marker_share is not None and layout.marker_px is not None and stated.marker_mm is not None:
        measured = layout.marker_share * stated.square_mm
        if abs(measured / stated.marker_mm - 1.0) > max(
            policy.marker_tolerance, policy.marker_tolerance_px / layout.marker_px
        ):
            update["marker_mm"] = round(measured, 2)
            told.append(
                f"markers are {100 * layout.marker_share:.0f} % of a square's side and not "
                f"{100 * stated.marker_mm / stated.square_mm:.0f} %: correct marker_mm to about {measured:.2g}, or "
                "square_mm"
            )
    return update, told


# --- A stated size of a screen's cells that the frames contradict -----------------------------------------------------


def misstated_cell_size(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a `cell_camera_px` that differs by more than `cell_size_tolerance` from the size of the cells in the
    middle of the pattern; None where it fits.

    The registration finds the size by itself: the stated one is only its start.
    """
    try:
        poses = screen_poses(recordings, side, "psf")
    except NotDetermined:
        return None
    sizes: dict[float, float] = {}
    for pose in poses:
        stated = pose.pattern[0].screen.cell_camera_px
        if stated is not None and stated not in sizes:
            measured = _cell_px(recordings, pose)
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


def _cell_px(recordings: RecordingSet, pose: ScreenPose) -> float | None:
    """Side of a cell in camera px: the square root of its area in the middle of the pattern; None where the pattern
    isn't found."""
    camera = recordings.camera(pose.pattern[0].side)
    try:
        refuse_saturated(recordings, pose, camera.saturation_dn, "psf")
        pictures = ScreenPictures.of(recordings, pose)
        warp = pattern_place(recordings, pictures, pictures.levelled(recordings, pose.pattern), camera.cfa).warp
    except NotDetermined:
        return None
    rows, cols = np.nonzero(np.isfinite(pictures.contrast))
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    cells = warp.cells(corner + np.array([cols.mean(), rows.mean()]))
    (ax, ay), (bx, by) = cells[1] - cells[0], cells[2] - cells[0]
    return float(1.0 / np.sqrt(abs(ax * by - ay * bx)))
