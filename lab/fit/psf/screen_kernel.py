"""Kernels of all channels of a screen pose, and of parts of the field: registration and kernel in turn.

The pattern is drawn on samples of a part of a pixel (`DrawnPattern`), since on samples of a pixel the sharp borders of
its cells can't be placed. The kernel is solved on these samples and brought to the pixels of the sensor (`on_pixels`),
for each channel on its own pixels of the mosaic. `expected_kernel` says to which kernel this converges for a given
transfer function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.errors import NotDetermined
from lab.fit.psf.kernel import KernelEstimate, NormalEquations, on_simplex, solve_kernel
from lab.observables.screens.registration import ScreenWarp, draw_by_area
from lab.one_blas_thread import one_blas_thread
from sim.camera import Cfa
from sim.sensor.mosaic import phases
from sim.sensor.mosaic import step as period

Array = NDArray[np.floating[Any]]

RIM_SHARE = 0.04  # of a kernel in its outermost pixels, above which the support is doubled
GRID_STD = 5e-4  # of the maximum of the kernel: error of five taps on half pixels for a diffraction-limited kernel
SHIFT_STD_PX = 0.005  # common to all corners, beside their noise: shading differs between neighbouring squares


def on_pixels(fine: Array, oversample: int) -> Array:
    """Bring a kernel from samples of 1 / `oversample` px to pixels, sum 1.

    fine : (size, size), size = 2 n + 1 samples
    oversample : samples in a pixel

    >>> bool(np.isclose(on_pixels(np.pad([[1.0]], 12), 4).sum(), 1.0))
    True
    """
    matrix = pixel_matrix(len(fine), oversample)
    kernel = matrix @ fine @ matrix.T
    return np.asarray(kernel / kernel.sum())


def pixel_matrix(size: int, oversample: int) -> Array:
    """Return the matrix (pixels, size) of one axis of `on_pixels`.

    size : samples of the kernel along the axis, odd
    oversample : samples in a pixel

    Light spread over a pixel is light spread over `oversample` adjacent samples: a filter with the response sinc(f) /
    sinc(f / oversample).

    >>> pixel_matrix(25, 4).shape
    (5, 25)
    """
    reach = oversample
    half = (size // 2 - oversample // 2) // oversample
    taps = symmetric_taps(lambda f: np.sinc(f) / np.sinc(f / oversample), 0.8, oversample, reach)
    matrix = np.zeros((2 * half + 1, size + 2 * reach))
    for row in range(2 * half + 1):
        middle = size // 2 + reach + oversample * (row - half)
        matrix[row, middle - reach : middle + reach + 1] = taps
    return matrix[:, reach : matrix.shape[1] - reach]


def symmetric_taps(response: Callable[[Array], Array], highest_cy_per_px: float, oversample: int, reach: int) -> Array:
    """Design 2 reach + 1 symmetric filter taps on samples of 1 / `oversample` px, sum 1.

    response : frequency response, a function of frequencies (n,), cy/px
    highest_cy_per_px : up to which the response is fitted by least squares
    oversample : samples in a pixel
    reach : taps on each side of the middle one

    >>> taps = symmetric_taps(np.ones_like, 0.5, 1, 2)
    >>> bool(np.allclose(taps, [0.0, 0.0, 1.0, 0.0, 0.0]))
    True
    """
    frequency = np.linspace(0.0, highest_cy_per_px, 61)
    order = np.arange(reach + 1)
    terms = np.cos(2.0 * np.pi * frequency[:, None] * order / oversample) * np.where(order > 0, 2.0, 1.0)
    weight = np.where(frequency == 0.0, 1e3, 1.0)
    # At fine sampling the taps are nearly collinear over the band: the solution of least norm
    taps = np.linalg.lstsq(terms * weight[:, None], weight * response(frequency), rcond=1e-9)[0]
    taps = np.concatenate([taps[:0:-1], taps])
    return np.asarray(taps / taps.sum())


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
        fine_row, fine_col = np.arange(oversample * rows) / oversample, np.arange(oversample * cols) / oversample
        cell_x, cell_y = warp.cells_on(fine_row, fine_col)
        picture = draw_by_area(target, cell_x, cell_y)
        # Take out the squares of the drawing and of the grid of the kernel, a sample each
        taps = symmetric_taps(lambda f: np.sinc(f / oversample) ** -2, 0.6, oversample, 2)
        for axis in (0, 1):
            picture = ndimage.correlate1d(picture, taps, axis=axis, mode="nearest")
        wide = oversample * support_px
        surroundings = cv2.GaussianBlur(picture, (6 * wide + 1,) * 2, wide, borderType=cv2.BORDER_REPLICATE)

        down, across = (np.mean(np.gradient(cell_x[::8, ::8], 8.0 / oversample, axis=axis)) for axis in (0, 1))
        margin = (support_px / 2.0 + 2.0) * float(np.hypot(down, across))  # cells
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

    def split(self, count: int) -> list[DrawnPattern]:
        """Split the pattern into `count` x `count` parts of about equal rows and columns, without parts of too few
        pixels.
        """
        across = [np.linspace(v.min(), v.max() + 1, count + 1) for v in (self.row, self.col)]
        parts = []
        for top, bottom in zip(across[0][:-1], across[0][1:], strict=True):
            for left, right in zip(across[1][:-1], across[1][1:], strict=True):
                chosen = (self.row >= top) & (self.row < bottom) & (self.col >= left) & (self.col < right)
                if np.count_nonzero(chosen) >= 2 * self.support**2:
                    parts.append(self.within(chosen))
        return parts

    def within(self, chosen: NDArray[np.bool_]) -> DrawnPattern:
        """Return the pattern with the pixels `chosen`, (n,), alone."""
        return replace(self, row=self.row[chosen], col=self.col[chosen], value=self.value[chosen])

    def normal(self) -> NormalEquations:
        """Sum the normal equations of the elements of the kernel and, last, of the light from beyond its support."""
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

    def blur(self, estimate: KernelEstimate) -> Array:
        """Blur the drawing by the estimate, on its own samples."""
        from scipy.signal import fftconvolve  # here: the library takes a while to load

        return np.asarray(
            (1.0 - estimate.outside) * fftconvolve(self.picture, estimate.kernel, mode="same")
            + estimate.outside * self.surroundings
        )

    def refine_warp(self, estimate: KernelEstimate) -> ScreenWarp:
        """Refine the warp by one Gauss-Newton step of its displacement, without a common shift, which belongs to the
        kernel.
        """
        blurred, at = self.blur(estimate), (self.oversample * self.row, self.oversample * self.col)
        down, across = (np.gradient(blurred, 1.0 / self.oversample, axis=axis)[at] for axis in (0, 1))
        residual = self.value - blurred[at]
        terms = self.warp.basis(np.column_stack([self.col, self.row]).astype(float))[1:]
        mean = terms.mean(axis=1)
        terms = terms - mean[:, None]
        columns = np.concatenate([across * terms, down * terms])
        inlier = np.abs(residual) < 5.0 * np.sqrt(np.mean(residual**2))
        step = np.linalg.lstsq((columns * inlier) @ columns.T, (columns * inlier) @ residual, rcond=1e-10)[0]
        step = step.reshape(2, -1)
        return self.warp.displace(np.column_stack([-step @ mean, step]))


@dataclass(frozen=True)
class ScreenKernel:
    """Kernel of one channel from one pose.

    `kernel` (support, support), sum 1, on the pixels of the sensor, with `kernel_std` and the `covariance` of its
    elements, row by row. `fine`: the kernel as it was solved, on samples of 1 / `oversample` px. `outside`: share of
    the light beyond the support. `centre_px`: mean (row, col) of the pixels used.
    """

    channel: str
    kernel: Array
    kernel_std: Array
    covariance: Array
    fine: KernelEstimate
    oversample: int
    outside: float
    corner_rms_px: float
    centre_px: tuple[float, float]  # (row, col) of the samples' middle

    def predict(self, fine_kernel: Array) -> Array:
        """Predict the kernel on the pixels of the sensor that this estimator reports, noise-free and at this very
        place, for a given one.

        `fine_kernel` is on the grid of `fine.kernel`: `sim.point.kernel(..., support=len(fine.kernel),
        oversample=oversample)`.
        """
        fine = self.fine
        size = fine.kernel.size
        data = fine.information[:, :size] @ (np.asarray(fine_kernel, dtype=float).ravel() * (1.0 - self.outside))
        data = data + fine.information[:, size] * self.outside
        solution = on_simplex(fine.information + fine.precision, data, np.append(fine.kernel.ravel(), self.outside))
        return on_pixels(solution[:size].reshape(fine.kernel.shape), self.oversample)


@dataclass(frozen=True)
class ScreenField:
    """Kernels of one pose: of every channel over the whole pattern, and of parts of it, row by row."""

    kernels: dict[str, ScreenKernel]
    parts: tuple[ScreenKernel, ...]


@one_blas_thread
def measure_field(
    picture: Array,
    pattern: NDArray[np.uint8],
    warp: ScreenWarp,
    cfa: Cfa,
    support_px: int = 9,
    oversample: int = 2,
    patches: int = 3,
) -> ScreenField:
    """Measure the kernels of all channels of one pose, `support_px` (odd) wide, and of parts of the pattern.

    `picture` (rows, cols): the levelled picture of the `pattern` (cells), 0 dark .. 1 lit, NaN where the screen isn't;
    `warp`: where green (or all) pixels see the pattern (`lab.observables.screens.placement`). The place of red and blue
    is refined with the kernel, except a common shift, by Gauss-Newton on the residual. The support is doubled once
    where a kernel doesn't fit. `oversample` samples per pixel (2 or 4) resolve the kernel: 4 is worth its time where
    the cells of the target are about a quarter of a pixel, or the noise is low. With `patches` > 1, `patches` x
    `patches` parts of the pattern have a kernel each, of the green (or only) channel, with the prior of the whole.
    Raises `NotDetermined` where too few pixels see the pattern, ValueError for another `oversample`.
    """
    if oversample not in (2, 4):
        raise ValueError(f"oversample = {oversample} must be 2 or 4 samples a pixel")
    places, step = phases(cfa), period(cfa)
    reference = "Y" if cfa == "MONO" else "G"
    kernel_of_channel: dict[str, ScreenKernel] = {}
    local: list[ScreenKernel] = []
    size = support_px

    def draw_for(channel: str, place: ScreenWarp) -> DrawnPattern:
        return DrawnPattern.of(picture, pattern, place, places[channel], step, size, oversample)

    for channel in (reference, *(name for name in places if name != reference)):
        drawn = draw_for(channel, warp)
        estimate = solve_kernel(drawn.normal(), drawn.support, outside=True, rounds=1)
        if size == support_px and _rim_share(estimate.kernel, oversample) > RIM_SHARE:
            size = 2 * support_px - 1
            drawn = draw_for(channel, warp)
            estimate = solve_kernel(drawn.normal(), drawn.support, outside=True, rounds=1)
        if channel != reference:
            drawn = draw_for(channel, drawn.refine_warp(estimate))
        whole = solve_kernel(drawn.normal(), drawn.support, outside=True)
        kernel_of_channel[channel] = screen_kernel(drawn, channel, whole)
        if channel == reference and patches > 1:
            local = [
                screen_kernel(part, channel, solve_kernel(part.normal(), part.support, outside=True, prior_of=whole))
                for part in drawn.split(patches)
            ]
    return ScreenField({channel: kernel_of_channel[channel] for channel in places}, tuple(local))


def _rim_share(kernel: Array, oversample: int) -> float:
    """Return the share of a kernel in its outermost pixel."""
    inside = slice(oversample, -oversample)
    return float(1.0 - kernel[inside, inside].sum() / kernel.sum())


def screen_kernel(drawn: DrawnPattern, channel: str, estimate: KernelEstimate) -> ScreenKernel:
    """Bring the estimate to the pixels of the sensor, with the covariance of the estimate, of a common shift of the
    corners, and of the grid.
    """
    matrix = pixel_matrix(drawn.support, drawn.oversample)
    pixels = np.kron(matrix, matrix)
    raw = pixels @ estimate.kernel.ravel()
    total = raw.sum()
    jacobian = pixels / total - np.outer(raw, pixels.sum(axis=0)) / total**2
    shape = (len(matrix), len(matrix))
    # The corners determine where the pattern lies as a whole: their common error shifts the kernel
    shifts = [np.gradient(np.pad((raw / total).reshape(shape), 1), axis=axis)[1:-1, 1:-1].ravel() for axis in (0, 1)]
    shift_std = float(np.hypot(drawn.warp.corner_std_px, SHIFT_STD_PX))
    covariance = jacobian @ estimate.covariance @ jacobian.T + shift_std**2 * sum(np.outer(v, v) for v in shifts)
    covariance = covariance + (GRID_STD * raw.max() / total) ** 2 * np.eye(len(raw))
    return ScreenKernel(
        channel=channel,
        kernel=(raw / total).reshape(shape),
        kernel_std=np.sqrt(np.clip(np.diag(covariance), 0.0, None)).reshape(shape),
        covariance=covariance,
        fine=estimate,
        oversample=drawn.oversample,
        outside=estimate.outside,
        corner_rms_px=drawn.warp.corner_rms_px,
        centre_px=(float(drawn.row.mean()), float(drawn.col.mean())),
    )


def expected_kernel(
    transfer: Callable[[Array, Array], NDArray[np.complex128]], support_px: int, cell_px: float, oversample: int = 2
) -> Array:
    """Return the kernel on the pixels of the sensor, (support, support), sum 1, that `measure_field` converges to for a
    transfer function of lens and pixel.

    transfer : transfer(fx, fy), frequencies in cy/px, which broadcast against each other
    support_px : size of the kernel, px
    cell_px : size of a cell of the pattern, px
    oversample : samples in a pixel

    The kernel is the least-squares solution on samples of 1 / `oversample` px that maps the drawing of a random pattern
    to what the pixels record of it. Where a lens passes detail beyond what these samples resolve, it differs from
    samples of the point-spread function, because borders of cells lie between the samples. With P the power spectrum of
    the pattern, D the response of the drawing and H the transfer function, the normal equations at samples n, m are

        sum_m k(m) integral P D^2 exp(2 pi i f (n - m)) df = integral P D H exp(2 pi i f n) df

    >>> gaussian = lambda fx, fy: np.exp(-2.0 * (np.pi * 0.6) ** 2 * (fx**2 + fy**2)).astype(complex)
    >>> kernel = expected_kernel(gaussian, 5, 2.0)
    >>> kernel.shape, bool(kernel[2, 2] == kernel.max())
    ((5, 5), True)
    """
    support = oversample * support_px + 1
    fine = 4 * oversample
    count = max(32, 4 * support_px) * fine
    fy, fx = np.fft.fftfreq(count, 1.0 / fine), np.fft.rfftfreq(count, 1.0 / fine)
    taps = symmetric_taps(lambda f: np.sinc(f / oversample) ** -2, 0.6, oversample, 2)
    order = np.arange(len(taps)) - len(taps) // 2
    drawn_y, drawn_x = (
        np.sinc(f / oversample) * (np.cos(2.0 * np.pi * f[:, None] * order / oversample) @ taps) for f in (fy, fx)
    )
    power = np.square(np.sinc(cell_px * fy))[:, None] * np.square(np.sinc(cell_px * fx))
    drawn = drawn_y[:, None] * drawn_x
    every = fine // oversample
    autocorrelation = np.fft.irfft2(power * drawn**2, (count, count))[::every, ::every]
    cross = np.fft.irfft2(power * drawn * transfer(fx[None, :], fy[:, None]), (count, count))[::every, ::every]
    place = np.arange(support) - support // 2
    lag = place[:, None] - place
    matrix = autocorrelation[lag[:, None, :, None], lag[None, :, None, :]].reshape(support**2, support**2)
    # A small ridge where the pattern has no power; the sum is known far better, from the mean of the pattern
    matrix = matrix + 1e-4 * autocorrelation[0, 0] * np.eye(support**2)
    mean = 1e3 * autocorrelation[0, 0]
    kernel = np.linalg.solve(matrix + mean, cross[place[:, None], place].ravel() + mean)
    return on_pixels(kernel.reshape(support, support), oversample)
