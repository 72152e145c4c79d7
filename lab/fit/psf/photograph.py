"""The kernel from a single photograph of a pattern: no white and black captures, no checkerboard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from lab.errors import NotDetermined
from lab.fit.psf.kernel import KernelEstimate, solve_kernel
from lab.fit.psf.screen_kernel import DrawnPattern, screen_kernel
from lab.observables.screens.registration import LEAST_CORRELATION, ScreenWarp
from lab.one_blas_thread import one_blas_thread

Array = NDArray[np.floating[Any]]

MARGIN_PX = 16  # about the pattern
ROUNDS = 4  # of kernel and registration in turn
ALIGN_STEPS = 4  # for each blur of the registration by the pattern alone


@dataclass(frozen=True)
class PhotographedKernel:
    """Kernel from one photograph of a pattern, with its standard deviation.

    `kernel`: on the pixels of the sensor; `fine`: on samples of 1 / `oversample` px. `explained`: share of the
    variance of the pixels over the pattern that the kernel explains; `explained_by_box`: that a homography and the
    square of the pixel explain without it.
    """

    kernel: Array
    kernel_std: Array
    fine: KernelEstimate
    oversample: int
    warp: ScreenWarp
    explained: float
    explained_by_box: float
    samples: int


@one_blas_thread
def estimate_from_photograph(
    photo: ArrayLike,
    pattern: NDArray[np.uint8],
    support_px: int = 5,
    oversample: int = 4,
    corners: ArrayLike | None = None,
) -> PhotographedKernel:
    """Estimate the kernel from a single photograph of a printed or shown pattern.

    photo : (rows, cols), linear, one channel
    pattern : cells (rows, cols), 0 dark, 1 lit
    support_px : rows and columns of the kernel, odd
    oversample : samples of the kernel in a pixel
    corners : (4, 2), (x, y) of the corners of the pattern, clockwise from its own top left; by default the place where
        the picture has most fine structure, in any quarter turn

    Dark level and contrast are planes in the frame, fitted with the kernel; then homography, cubic displacement and
    kernel in turn. Raises `NotDetermined` where the pattern isn't seen.
    """
    seen, target = np.asarray(photo, dtype=float), np.asarray(pattern, dtype=np.uint8)
    if seen.ndim != 2 or target.ndim != 2 or not np.isfinite(seen).all():
        raise NotDetermined("psf", "photograph and pattern have to be two-dimensional, the photograph finite")
    quad = busiest_quadrilateral(seen) if corners is None else np.asarray(corners, dtype=float)
    # Only the surroundings of the pattern
    first = np.maximum(np.floor(quad.min(axis=0)).astype(int) - MARGIN_PX, 0)
    last = np.ceil(quad.max(axis=0)).astype(int) + MARGIN_PX + 1
    seen, quad = seen[first[1] : last[1], first[0] : last[0]], quad - first
    orientations = [np.roll(quad, orientation, axis=0) for orientation in range(4 if corners is None else 1)]
    rough = [
        _align(seen, target, ScreenWarp.of_corners(orientation, target.shape), (2.5, 1.5))
        for orientation in orientations
    ]
    warp, _ = max(rough, key=lambda warp_and_score: warp_and_score[1])
    warp, correlation = _align(seen, target, warp, (1.0, 0.7, 0.5))
    if correlation < LEAST_CORRELATION:
        raise NotDetermined("psf", f"the photograph doesn't show the pattern (correlation {max(correlation, 0.0):.2f})")
    by_box = _share_of_pixel_box(seen, target, warp)
    light = seen
    for _ in range(ROUNDS):
        drawn = DrawnPattern.of(light, target, warp, [(0, 0)], 1, support_px, oversample)
        at = (drawn.row, drawn.col)
        if light is seen:
            predicted = ndimage.gaussian_filter(drawn.picture, 0.6 * oversample)
        predicted = predicted[oversample * drawn.row, oversample * drawn.col]
        dark_level, contrast = _fit_levels(seen[at], predicted, *at, seen.shape)
        light = (seen - dark_level) / contrast
        drawn = replace(drawn, value=light[at])
        estimate = solve_kernel(drawn.normal(), drawn.support, outside=True, rounds=1)
        predicted = drawn.blur(estimate)
        warp = drawn.refine_warp(estimate)
    drawn = DrawnPattern.of(light, target, warp, [(0, 0)], 1, support_px, oversample)
    estimate = solve_kernel(drawn.normal(), drawn.support, outside=True)
    described = screen_kernel(drawn, "Y", estimate)
    at = (drawn.row, drawn.col)
    model = (dark_level + contrast * drawn.blur(estimate)[::oversample, ::oversample])[at]
    return PhotographedKernel(
        kernel=described.kernel,
        kernel_std=described.kernel_std,
        fine=estimate,
        oversample=oversample,
        warp=warp.shift_origin(first),
        explained=1.0 - float(np.sum((seen[at] - model) ** 2) / np.sum((seen[at] - seen[at].mean()) ** 2)),
        explained_by_box=by_box,
        samples=len(drawn.row),
    )


def busiest_quadrilateral(picture: Array) -> Array:
    """Find the corners (4, 2), (x, y), clockwise from the top left, of the largest part of a picture that is full of
    fine structure.
    """
    fine = np.abs(picture - ndimage.gaussian_filter(picture, 1.0))
    # A pattern has fine structure everywhere, a marker or an edge only along lines: the lower quartile separates them
    busy = ndimage.percentile_filter(fine, 25, size=11)
    busy = ndimage.gaussian_filter(busy, 1.0)
    mask = busy > 0.5 * np.quantile(busy, 0.99)
    narrow = max(4, int(np.sqrt(mask.sum()) / 8.0))  # what touches the pattern is narrower than it
    part, count = ndimage.label(ndimage.binary_opening(mask, np.ones((3, 3)), iterations=narrow))
    if not count:
        raise NotDetermined("psf", "the photograph shows no pattern: nothing in it is full of fine structure")
    largest = part == 1 + int(np.argmax(ndimage.sum_labels(part > 0, part, np.arange(1, count + 1))))
    points = np.argwhere(largest)[:, ::-1].astype(np.float32)
    box = cv2.boxPoints(cv2.minAreaRect(points))
    box += (
        3.5 * (box - box.mean(axis=0)) / np.linalg.norm(box - box.mean(axis=0), axis=1).mean()
    )  # the quartile shrinks it
    around = np.arctan2(*(box - box.mean(axis=0)).T[::-1])
    ordered = box[np.argsort(around)]  # clockwise, for y goes down
    return np.asarray(np.roll(ordered, -int(np.argmin(ordered.sum(axis=1))), axis=0), dtype=float)


def _fit_levels(
    seen: Array, predicted: Array, row: NDArray[np.int64], col: NDArray[np.int64], shape: tuple[int, ...]
) -> tuple[Array, Array]:
    """Fit dark level and contrast, (rows, cols), as planes in the frame, by least squares of seen = dark level +
    contrast x predicted.

    `seen`, `predicted`, `row`, `col` (n,): values and places of the pixels; `shape`: (rows, cols). Raises
    `NotDetermined` where the contrast isn't positive.
    """

    def plane(r: Array, c: Array) -> Array:
        return np.stack([np.ones(np.broadcast(r, c).shape), r / shape[0] + 0.0 * c, c / shape[1] + 0.0 * r])

    terms = plane(row.astype(float), col.astype(float))
    solution = np.linalg.lstsq(np.concatenate([terms, terms * predicted]).T, seen, rcond=None)[0]
    everywhere = plane(np.arange(shape[0], dtype=float)[:, None], np.arange(shape[1], dtype=float)[None])
    dark_level, contrast = (np.tensordot(part, everywhere, axes=1) for part in (solution[:3], solution[3:]))
    if not (contrast[row, col] > 0.0).all():
        raise NotDetermined("psf", "the photograph shows the pattern with no contrast, or reversed")
    return dark_level, np.where(contrast > 0.0, contrast, np.nan)


def _align(
    seen: Array, target: NDArray[np.uint8], warp: ScreenWarp, blurs_px: Sequence[float]
) -> tuple[ScreenWarp, float]:
    """Improve the warp by Gauss-Newton on the picture blurred by ever less. Returns it and the correlation at the last
    step.

    `seen` (rows, cols), `target` (cells), `blurs_px`: standard deviations of the blurs.
    """
    correlation = -1.0
    for blur in blurs_px:
        smooth = ndimage.gaussian_filter(seen, blur)
        for _ in range(ALIGN_STEPS):
            # Far enough inside that the surroundings of the pattern are not blurred in
            drawn = DrawnPattern.of(smooth, target, warp, [(0, 0)], 1, int(5.0 * blur) | 1, 2, least=200)
            predicted = ndimage.gaussian_filter(drawn.picture, 2.0 * float(np.hypot(blur, 0.4)))
            at = (2 * drawn.row, 2 * drawn.col)
            value, there = drawn.value, predicted[at]
            correlation = float(np.corrcoef(value, there)[0, 1])
            gain, dark_level = np.polyfit(there, value, 1)
            gain = max(float(gain), 1e-6)
            down, across = (np.gradient(predicted, 0.5, axis=axis)[at] for axis in (0, 1))
            terms = warp.basis(np.column_stack([drawn.col, drawn.row]).astype(float))
            terms = terms[: 3 if blur > 2.0 else 6 if blur > 0.9 else len(terms)]
            columns = np.concatenate([gain * across * terms, gain * down * terms, terms[:3], there * terms[:3]])
            step = np.linalg.lstsq(columns @ columns.T, columns @ (value - dark_level - gain * there), rcond=1e-9)[0][
                :-6
            ]
            change = np.zeros((2, len(warp.displacement[0])))
            change[:, : len(terms)] = np.clip(step, -blur, blur).reshape(2, -1)
            warp = warp.displace(change)
    return warp, correlation


def _share_of_pixel_box(seen: Array, target: NDArray[np.uint8], warp: ScreenWarp) -> float:
    """Return the share of the variance that the pattern explains, averaged over a pixel's square, with free levels."""
    drawn = DrawnPattern.of(seen, target, warp, [(0, 0)], 1, 1, 2)
    pixel = ndimage.correlate1d(drawn.picture, [0.25, 0.5, 0.25], axis=0)
    pixel = ndimage.correlate1d(pixel, [0.25, 0.5, 0.25], axis=1)[2 * drawn.row, 2 * drawn.col]
    return float(np.corrcoef(pixel, drawn.value)[0, 1] ** 2)
