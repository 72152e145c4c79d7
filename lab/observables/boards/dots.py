"""Grids of dots: where the dots are, and their centroids."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.observables.boards.corner_fits import CornerFits

Array = NDArray[np.floating[Any]]


#: Radius of the window about a dot, over the spacing of the dots; and the share of that radius beyond which is
#: background.
DOT_WINDOW, DOT_BACKGROUND = 0.5, 0.8
#: Share of a dot's contrast that is subtracted from the weights; least contrast of a dot, in a picture of 0..1.
LEAST_DOT_SHARE, LEAST_DOT_CONTRAST = 0.1, 0.1
CENTROID_PASSES = 4


def dot_grid(grey: NDArray[np.uint8], rows: int, cols: int) -> Array:
    """Find a grid of dots: first estimates of their centres, (rows, cols, 2), (x, y) px. Dots are dark on light or
    light on dark, and all are in view.

    Raises `NotDetermined` where no grid of that size is found.
    """
    for picture in (grey, np.ascontiguousarray(255 - grey)):
        for flags in (cv2.CALIB_CB_SYMMETRIC_GRID, cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
            found, centres = cv2.findCirclesGrid(picture, (cols, rows), flags=flags)
            if found:
                return np.asarray(centres.reshape(rows, cols, 2), float)
    raise NotDetermined("geometry", f"no grid of {rows} x {cols} dots found: all of it has to be in view, and in focus")


def dot_centres(
    picture: Array, points: Array, rows: int, cols: int, index: NDArray[np.int64] | None = None
) -> CornerFits:
    """Measure the centroids of the dots at `points` (n, 2), (x, y), in a picture (rows, cols) of 0..1.

        c = sum w r / sum w,   w = max((I - background) / (peak - background) - `LEAST_DOT_SHARE`, 0)

    within half a spacing. The background is the median beyond 0.8 of that radius. A coordinate has the standard
    deviation s sqrt(sum |r - c|^2 / 2) / sum w, with s the noise of the background over the contrast. In perspective,
    the centroid of the ellipse isn't the image of the dot's centre: for dots of radius a at distance z and a focal
    length of f px they differ by about f (a / z)^2 sin(2 tilt) / 2 px.
    """
    points = np.array(points, float)
    index = np.arange(rows * cols) if index is None else index
    spacing = _spacing(points, index, cols)
    radius = np.maximum(DOT_WINDOW * spacing, 2.0)
    size = int(np.ceil(radius.max())) + 1
    offset = np.arange(-size, size + 1)
    dx, dy = (grid.ravel() for grid in np.meshgrid(offset, offset))
    std = np.full(len(points), np.inf)
    trusted = np.zeros(len(points), bool)
    for k in range(len(points)):
        found = _centroid(picture, points[k], float(radius[k]), dx, dy)
        if found is not None:
            points[k], std[k], trusted[k] = found[0], found[1], True
    return CornerFits(points, trusted, std)


def _centroid(
    picture: Array, start: Array, radius: float, dx: NDArray[np.int64], dy: NDArray[np.int64]
) -> tuple[Array, float] | None:
    """Measure the centroid of one dot and the standard deviation of a coordinate; None where there is no dot, or it
    touches the frame's border.

    `picture` (rows, cols), `start` (2,), (x, y), and `radius` of the window in px; `dx`, `dy`: places of its pixels
    from the middle.
    """
    height, width = picture.shape
    at, std = start, np.inf
    for _ in range(CENTROID_PASSES):
        x, y = np.rint(at[0]) + dx, np.rint(at[1]) + dy
        away = np.hypot(x - at[0], y - at[1])
        near = away <= radius
        x, y, away = x[near], y[near], away[near]
        if min(x.min(), y.min()) < 0 or x.max() >= width or y.max() >= height:
            return None
        value = picture[y.astype(int), x.astype(int)]
        rim, inner, inside = (
            value[away > DOT_BACKGROUND * radius],
            value[away < 0.3 * radius],
            away <= DOT_BACKGROUND * radius,
        )
        background = float(np.median(rim)) if rim.size else np.nan
        contrast = float(np.mean(inner)) - background if inner.size else np.nan
        if not abs(contrast) >= LEAST_DOT_CONTRAST:
            return None
        share = (value - background) / contrast
        weight = np.where(inside, np.maximum(share - LEAST_DOT_SHARE, 0.0), 0.0)
        total = float(weight.sum())
        at = np.array([weight @ x, weight @ y]) / total
        noise = float(np.median(np.abs(rim - background))) / 0.6745 / abs(contrast)
        std = noise * float(np.sqrt(0.5 * np.sum(np.square(away[weight > 0])))) / total
    return (at, std) if np.hypot(*(at - start)) < 0.5 * radius else None


def _spacing(points: Array, index: NDArray[np.int64], cols: int) -> Array:
    """Return the distance of each dot to the nearest of its neighbours in the grid, px."""
    place = {int(number): k for k, number in enumerate(index)}
    found = np.full(len(points), np.inf)
    for number, k in place.items():
        for other in (number + cols, number + 1 if (number + 1) % cols else -1):
            if other in place:
                distance = float(np.hypot(*(points[place[other]] - points[k])))
                found[k], found[place[other]] = min(found[k], distance), min(found[place[other]], distance)
    return np.where(np.isfinite(found), found, np.nanmedian(found))
