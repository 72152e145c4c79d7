"""Kernels of all channels of a screen pose, and of parts of the field: registration and kernel in turn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.fit.psf.drawn_pattern import DrawnPattern
from lab.fit.psf.levelled_captures import ScreenPictures
from lab.fit.psf.pixel_sampling import on_pixels, pixel_matrix
from lab.fit.psf.regularised_kernel import KernelEstimate, solve_kernel
from lab.fit.psf.screen_registration import register
from lab.fit.psf.simplex import on_simplex
from lab.one_blas_thread import one_blas_thread
from sim.camera import Cfa
from sim.sensor.mosaic import phases
from sim.sensor.mosaic import step as period

Array = NDArray[np.floating[Any]]

REGISTRATION_STEPS = 3
RIM_SHARE = 0.04  # of a kernel in its outermost pixels, above which the support is doubled
GRID_STD = 5e-4  # of the maximum of the kernel: error of five taps on half pixels for a diffraction-limited kernel
SHIFT_STD_PX = 0.005  # common to all corners, beside their noise: shading differs between neighbouring squares


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
        """Kernel on the pixels of the sensor that this estimator reports, noise-free and at this very place, for a
        predicted one.

        `fine_kernel` is on the grid of `fine.kernel`: `sim.point.kernel(..., support=len(fine.kernel),
        oversample=oversample)`.
        """
        fine = self.fine
        size = fine.kernel.size
        data = fine.information[:, :size] @ (np.asarray(fine_kernel, dtype=float).ravel() * (1.0 - self.outside))
        data = data + fine.information[:, size] * self.outside
        found = on_simplex(fine.information + fine.precision, data, np.append(fine.kernel.ravel(), self.outside))
        return on_pixels(found[:size].reshape(fine.kernel.shape), self.oversample)


@dataclass(frozen=True)
class ScreenField:
    """Kernels of one pose: of every channel over the whole pattern, and of parts of it, row by row."""

    kernels: dict[str, ScreenKernel]
    parts: tuple[ScreenKernel, ...]


@one_blas_thread
def measure_field(
    pictures: ScreenPictures, cfa: Cfa, support_px: int = 9, oversample: int = 2, patches: int = 3
) -> ScreenField:
    """Kernels of all channels of one pose, `support_px` (odd) wide, and of parts of the pattern.

    The support is doubled once where a kernel doesn't fit. The registration from the corners is refined with the
    kernel, except a common shift, by Gauss-Newton on the residual: first on the green (or only) channel, then on each.
    `oversample` samples per pixel (2 or 4) resolve the kernel: 4 is worth its time where the cells of the target are
    about a quarter of a pixel, or the noise is low. With `patches` > 1, `patches` x `patches` parts of the pattern
    have a kernel each, of the green (or only) channel, with the registration and the prior of the whole. Raises
    `NotDetermined` where the pattern can't be registered, ValueError for another `oversample`.
    """
    if oversample not in (2, 4):
        raise ValueError(f"oversample = {oversample} must be 2 or 4 samples a pixel")
    cell = pictures.first.screen.cell_camera_px
    warp = register(
        pictures.checkerboard, pictures.bernoulli, pictures.checkerboard_target, pictures.bernoulli_target, cell
    )
    places, step = phases(cfa), period(cfa)
    reference = "Y" if cfa == "MONO" else "G"
    found: dict[str, ScreenKernel] = {}
    local: list[ScreenKernel] = []
    size = support_px

    def drawn_for(channel: str) -> DrawnPattern:
        return DrawnPattern.of(
            pictures.bernoulli, pictures.bernoulli_target, warp, places[channel], step, size, oversample
        )

    for channel in (reference, *(name for name in places if name != reference)):
        for _ in range(REGISTRATION_STEPS if channel == reference else 1):
            drawn = drawn_for(channel)
            estimate = solve_kernel(drawn.normal(), drawn.support, outside=True, rounds=1)
            if size == support_px and _rim_share(estimate.kernel, oversample) > RIM_SHARE:
                size = 2 * support_px - 1
                continue
            warp = drawn.refined(estimate)
        drawn = drawn_for(channel)
        whole = solve_kernel(drawn.normal(), drawn.support, outside=True)
        found[channel] = screen_kernel(drawn, channel, whole)
        if channel == reference and patches > 1:
            local = [
                screen_kernel(part, channel, solve_kernel(part.normal(), part.support, outside=True, prior_of=whole))
                for part in drawn.parts(patches)
            ]
    return ScreenField({channel: found[channel] for channel in places}, tuple(local))


def _rim_share(kernel: Array, oversample: int) -> float:
    """Share of a kernel in its outermost pixel."""
    inside = slice(oversample, -oversample)
    return float(1.0 - kernel[inside, inside].sum() / kernel.sum())


def screen_kernel(drawn: DrawnPattern, channel: str, estimate: KernelEstimate) -> ScreenKernel:
    """The estimate on the pixels of the sensor, with the covariance of the estimate, of a common shift of the corners,
    and of the grid.
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
