"""A pattern drawn on a fine grid through a warp, and the pixels of one channel that see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline

from lab.errors import NotDetermined
from lab.fit.psf.normal_equations import NormalEquations
from lab.fit.psf.pixel_sampling import symmetric_taps
from lab.fit.psf.regularised_kernel import KernelEstimate
from lab.fit.psf.screen_registration import ScreenWarp

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class DrawnPattern:
    """The target drawn on samples of 1 / `oversample` px through `warp`, and the pixels (n,) of one channel.

    `picture`: the drawing, (oversample rows, oversample cols). `surroundings`: its local mean, which is what light
    from beyond the support sees. `row`, `col`, `value` (n,): places (px) and levelled values of the pixels. `support`:
    width of the kernel in samples, odd.
    """

    warp: ScreenWarp
    picture: Array
    surroundings: Array
    row: NDArray[np.int64]
    col: NDArray[np.int64]
    value: Array
    support: int
    oversample: int

    @staticmethod
    def of(
        seen: Array,
        pattern: NDArray[np.uint8],
        warp: ScreenWarp,
        places: Sequence[tuple[int, int]],
        step: int,
        support_px: int,
        oversample: int,
        least: int = 0,
    ) -> DrawnPattern:
        """Draw `pattern` (cells) and choose the pixels of a channel.

        `seen` (rows, cols): the levelled picture, 0 dark .. 1 lit, NaN where it isn't to be used. `places`: first
        (row, col) of the phases of the channel, `step`: period of the mosaic. Raises `NotDetermined` for fewer than
        `least` pixels; 0: twice the number of elements of the kernel.
        """
        rows, cols = seen.shape
        target = pattern.astype(float)
        # The map is smooth: on a coarse grid, interpolated by cubic splines
        y, x = np.arange(-8.0, rows + 16.0, 8.0), np.arange(-8.0, cols + 16.0, 8.0)
        at = warp.cells(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x), 2)
        fine_y, fine_x = np.arange(oversample * rows) / oversample, np.arange(oversample * cols) / oversample
        cell_x, cell_y = (RectBivariateSpline(y, x, at[:, :, k])(fine_y, fine_x) for k in (0, 1))
        picture = area_drawn(target, cell_x, cell_y)
        # Take out the squares of the drawing and of the grid of the kernel, a sample each
        taps = symmetric_taps(lambda f: np.sinc(f / oversample) ** -2, 0.6, oversample, 2)
        for axis in (0, 1):
            picture = ndimage.correlate1d(picture, taps, axis=axis, mode="nearest")
        wide = oversample * support_px
        surroundings = cv2.GaussianBlur(picture, (6 * wide + 1,) * 2, wide, borderType=cv2.BORDER_REPLICATE)

        coarse = np.gradient(at[:, :, 0])
        margin = (support_px / 2.0 + 2.0) * float(np.hypot(coarse[0].mean(), coarse[1].mean())) / 8.0  # cells
        inside = (
            (cell_x > margin)
            & (cell_x < target.shape[1] - margin)
            & (cell_y > margin)
            & (cell_y < target.shape[0] - margin)
        )
        usable = inside[::oversample, ::oversample] & np.isfinite(seen)
        usable[: support_px + 1] = usable[-support_px - 1 :] = False
        usable[:, : support_px + 1] = usable[:, -support_px - 1 :] = False
        of_channel = np.zeros_like(usable)
        for row0, col0 in places:
            of_channel[row0::step, col0::step] = True
        row, col = np.nonzero(usable & of_channel)
        support = oversample * support_px + 1  # odd, as oversample x support_px is even
        if len(row) < (least or 2 * support**2):
            raise NotDetermined(
                "psf", f"only {len(row)} pixels of the channel see the pattern: let it fill more of the frame"
            )
        return DrawnPattern(warp, picture, surroundings, row, col, seen[row, col], support, oversample)

    def parts(self, count: int) -> list[DrawnPattern]:
        """The pattern in `count` x `count` parts of about equal rows and columns, without parts of too few pixels."""
        across = [np.linspace(v.min(), v.max() + 1, count + 1) for v in (self.row, self.col)]
        found = []
        for top, bottom in zip(across[0][:-1], across[0][1:], strict=True):
            for left, right in zip(across[1][:-1], across[1][1:], strict=True):
                chosen = (self.row >= top) & (self.row < bottom) & (self.col >= left) & (self.col < right)
                if np.count_nonzero(chosen) >= 2 * self.support**2:
                    found.append(self.within(chosen))
        return found

    def within(self, chosen: NDArray[np.bool_]) -> DrawnPattern:
        """Only the pixels `chosen`, (n,)."""
        return replace(self, row=self.row[chosen], col=self.col[chosen], value=self.value[chosen])

    def normal(self) -> NormalEquations:
        """Normal equations of the elements of the kernel and, last, of the light from beyond its support."""
        s, h = self.support, self.support // 2
        size = s * s + 1
        gram, right = np.zeros((size, size)), np.zeros(size)
        # Rotated by 180 degrees: a convolution
        windows = np.lib.stride_tricks.sliding_window_view(self.picture[::-1, ::-1], (s, s))
        last = np.array(windows.shape[:2]) - 1
        for start in range(0, len(self.row), 4096):
            part = slice(start, start + 4096)
            row, col, value = self.oversample * self.row[part], self.oversample * self.col[part], self.value[part]
            design = np.empty((len(row), size))
            design[:, :-1] = windows[last[0] - row + h, last[1] - col + h].reshape(len(row), -1)
            design[:, -1] = self.surroundings[row, col]
            gram += design.T @ design
            right += value @ design
        return NormalEquations(gram, right, float(self.value @ self.value), len(self.row))

    def blurred(self, estimate: KernelEstimate) -> Array:
        """The drawing blurred by the estimate, on its own samples."""
        from scipy.signal import fftconvolve  # here: the library takes a while to load

        return np.asarray(
            (1.0 - estimate.outside) * fftconvolve(self.picture, estimate.kernel, mode="same")
            + estimate.outside * self.surroundings
        )

    def refined(self, estimate: KernelEstimate) -> ScreenWarp:
        """The warp after one Gauss-Newton step of its displacement, without a common shift, which belongs to the
        kernel.
        """
        blurred, at = self.blurred(estimate), (self.oversample * self.row, self.oversample * self.col)
        down, across = (np.gradient(blurred, 1.0 / self.oversample, axis=axis)[at] for axis in (0, 1))
        residual = self.value - blurred[at]
        terms = self.warp.basis(np.column_stack([self.col, self.row]).astype(float))[1:]
        mean = terms.mean(axis=1)
        terms = terms - mean[:, None]
        columns = np.concatenate([across * terms, down * terms])
        inlier = np.abs(residual) < 5.0 * np.sqrt(np.mean(residual**2))
        step = np.linalg.lstsq((columns * inlier) @ columns.T, (columns * inlier) @ residual, rcond=1e-10)[0]
        step = step.reshape(2, -1)
        return self.warp.displaced(np.column_stack([-step @ mean, step]))


def area_drawn(target: Array, cell_x: Array, cell_y: Array) -> Array:
    """Mean of `target` (cells) over squares the size of a sample about the points `cell_x`, `cell_y`; dark outside.

    The squares are aligned with the cells: the error is of second order in their rotation. A square may hold any
    number of cells.
    """
    from sim.scene.area import aligned_means  # here: the compiler's library takes a while to load

    table = np.pad(target.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    wide, high = (
        float(sum(np.abs(part).mean() for part in np.gradient(cell[::16, ::16]))) / 16.0 for cell in (cell_x, cell_y)
    )
    return np.asarray(aligned_means(table, cell_x, cell_y, wide, high))
