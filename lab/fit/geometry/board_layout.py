"""How many squares a board has, by its pictures, whatever is stated of it.

Markers are numbered row by row over a board's light squares: their numbers and places are a plane's picture for one number of columns
only. A plain checkerboard's corners are counted by OpenCV's detector, which grows a grid from its middle. What no picture tells is the
length of a square: a board twice as large at twice the distance has the same picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.charuco import CharucoCapture

Array = NDArray[np.floating[Any]]
Grey = NDArray[np.uint8]

FEWEST_MARKERS = 6  # of a picture: a homography has 8 parameters, two of which a marker's centre gives
MOST_COLUMNS = 40
#: Rms distance of markers' centres from a homography, of a marker's side: a layout that fits has less (lenses bend a board by some
#: hundredths), one that doesn't has so many times that of the one that fits.
FITS, WORSE = 0.15, 5.0
FEWEST_ABSENT = 4  # markers in sight that no picture shows, from which on a row counts as not there
LARGEST_PX = 1000.0  # of a picture in which a plain board's corners are counted: larger ones are shrunk
SMALLEST_GRID = (3, 3)  # inner corners that the search for a plain board starts from


@dataclass(frozen=True)
class BoardLayout:
    """What pictures of a board fit. `squares`: (rows, cols). `marker_share`: a marker's side over a square's; None: no markers. `rms`,
    `rms_stated`: distances of the markers' centres from their places, of a marker's side, with these squares and with those stated;
    None: the stated squares have no such markers, or there are none. `pictures`: on which it rests."""

    squares: tuple[int, int]
    marker_share: float | None
    marker_px: float | None
    rms: float | None
    rms_stated: float | None
    pictures: int


@dataclass(frozen=True)
class _Markers:
    """Markers of one picture: numbers (n,), corners (n, 4, 2) and centres (n, 2), px; size of the picture (rows, cols)."""

    number: NDArray[np.int64]
    corners: Array
    centres: Array
    shape: tuple[int, int]

    @property
    def side_px(self) -> float:
        return float(np.median(np.linalg.norm(np.roll(self.corners, 1, axis=1) - self.corners, axis=2)))


def board_layout(pictures: Sequence[Grey], capture: CharucoCapture) -> BoardLayout | None:
    """The layout that pictures (rows, cols) of one board fit; None where they don't tell it. `capture`: what is stated of it."""
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
    if rms_stated > FITS:
        rms = {(count, parity): _rms(seen, count, parity) for count in range(2, MOST_COLUMNS + 1) for parity in (0, 1)}
    (cols, parity), best = min(rms.items(), key=lambda item: item[1])
    if best > FITS or any(other < WORSE * best for (count, _), other in rms.items() if count != cols):
        return None
    rows = 1 + max(int(_places(one.number, cols, parity)[:, 1].max()) for one in seen)
    if capture.squares[0] > rows and not _lacks_rows(seen, cols, parity, rows, capture.squares[0]):
        rows = capture.squares[0]
    return BoardLayout(
        squares=(rows, cols),
        marker_share=float(np.median(np.concatenate([_sides(one, cols, parity) for one in seen]))),
        marker_px=float(np.median([one.side_px for one in seen])),
        rms=best,
        rms_stated=rms_stated if np.isfinite(rms_stated) else None,
        pictures=len(seen),
    )


def _markers(detector: Any, picture: Grey) -> _Markers | None:
    corners, ids, _ = detector.detectMarkers(picture)
    if ids is None:
        return None
    number = ids.ravel().astype(np.int64)
    quads = np.asarray(corners, float).reshape(-1, 4, 2)
    once = np.array([np.count_nonzero(number == one) == 1 for one in number])
    if once.sum() < FEWEST_MARKERS:
        return None
    number, quads = number[once], quads[once]
    # a projection keeps where diagonals meet
    along, across = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    between = quads[:, 1] - quads[:, 0]
    share = (between[:, 0] * across[:, 1] - between[:, 1] * across[:, 0]) / (
        along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    )
    rows, cols = picture.shape
    return _Markers(number, quads, quads[:, 0] + share[:, None] * along, (rows, cols))


def _places(number: NDArray[np.int64], cols: int, parity: int) -> Array:
    """Centres (n, 2), (x, y) in squares, of markers on a board of so many columns, whose first light square is the first (parity 0) or second."""
    rows = 2 * (int(number.max()) // cols + 2)
    row, col = np.nonzero((np.indices((rows, cols)).sum(axis=0) + parity) % 2 == 0)
    return np.column_stack([col, row])[number].astype(float)


def _homography(one: _Markers, cols: int, parity: int) -> tuple[Array, float] | None:
    """From the board, in squares, to the picture, by all markers; and the rms distance of their centres, px."""
    places = _places(one.number, cols, parity)
    if np.ptp(places[:, 0]) == 0 or np.ptp(places[:, 1]) == 0:
        return None
    found, _ = cv2.findHomography(places, one.centres, 0)
    if found is None:
        return None
    left = cv2.perspectiveTransform(places[:, None], found)[:, 0] - one.centres
    return found, float(np.sqrt(np.mean(np.sum(left**2, axis=1))))


def _rms(seen: Sequence[_Markers], cols: int, parity: int) -> float:
    """Over all pictures, of a marker's side; infinite where one has no homography."""
    total, count = 0.0, 0
    for one in seen:
        fitted = _homography(one, cols, parity)
        if fitted is None or not np.isfinite(fitted[1]):
            return np.inf
        total += len(one.number) * (fitted[1] / one.side_px) ** 2
        count += len(one.number)
    return float(np.sqrt(total / count))


def _sides(one: _Markers, cols: int, parity: int) -> Array:
    """Sides (n,) of the markers, in squares."""
    fitted = _homography(one, cols, parity)
    assert fitted is not None  # the layout fits
    flat = cv2.perspectiveTransform(one.corners.reshape(-1, 1, 2), np.linalg.inv(fitted[0])).reshape(-1, 4, 2)
    return np.asarray(np.linalg.norm(np.roll(flat, 1, axis=1) - flat, axis=2).mean(axis=1))


def _lacks_rows(seen: Sequence[_Markers], cols: int, parity: int, rows: int, stated: int) -> bool:
    """Whether markers of rows from `rows` on, up to the stated number, would lie well inside pictures that don't show them."""
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
    return absent >= FEWEST_ABSENT


def _plain_layout(pictures: Sequence[Grey]) -> BoardLayout | None:
    """A plain checkerboard's squares, the fewer first, where most pictures show the same number.

    A board that is stated too small is found, too, anywhere on the larger one: poses of a pair don't belong together then.
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
