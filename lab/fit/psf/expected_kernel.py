"""The kernel that `measure_field` converges to for a given transfer function."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.fit.psf.pixel_sampling import on_pixels, symmetric_taps

Array = NDArray[np.floating[Any]]


def expected_kernel(
    transfer: Callable[[Array, Array], NDArray[np.complex128]], support_px: int, cell_px: float, oversample: int = 2
) -> Array:
    """Kernel on the pixels of the sensor, (support, support), sum 1, that `measure_field` converges to for a
    transfer function of lens and pixel.

    `transfer(fx, fy)`, in cy/px, broadcasts over both. `cell_px`: size of a cell of the pattern. The kernel is the
    least-squares solution on samples of 1 / `oversample` px that maps the drawing of a random pattern to what the
    pixels record of it. Where a lens passes detail beyond what these samples resolve, it differs from samples of the
    point-spread function, because borders of cells lie between the samples. With P the power spectrum of the pattern,
    D the response of the drawing and H the transfer function, the normal equations at samples n, m are

        sum_m k(m) integral P D^2 exp(2 pi i f (n - m)) df = integral P D H exp(2 pi i f n) df
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
    own = np.fft.irfft2(power * drawn**2, (count, count))[::every, ::every]
    cross = np.fft.irfft2(power * drawn * transfer(fx[None, :], fy[:, None]), (count, count))[::every, ::every]
    place = np.arange(support) - support // 2
    lag = place[:, None] - place
    matrix = own[lag[:, None, :, None], lag[None, :, None, :]].reshape(support**2, support**2)
    # A small ridge where the pattern has no power; the sum is known far better, from the mean of the pattern
    matrix = matrix + 1e-4 * own[0, 0] * np.eye(support**2)
    mean = 1e3 * own[0, 0]
    kernel = np.linalg.solve(matrix + mean, cross[place[:, None], place].ravel() + mean)
    return on_pixels(kernel.reshape(support, support), oversample)
