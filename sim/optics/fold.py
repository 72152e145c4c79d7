"""Transfer functions on a pixel grid: sampling at one sample a pixel folds all frequencies into -1/2..1/2 cy/px.

A picture of uniform squares, one a pixel, imaged by a lens and collected by pixels of the same pitch, is a discrete
convolution. The Fourier transform of its kernel is the sum over all integers a, b of OTF(fx + a, fy + b) aperture(...)
sinc(fx + a) sinc(fy + b). This is exact, where drawing on finer samples has an error and needs more memory.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft

from sim.optics.diffraction import aperture_otf, diffraction_otf
from sim.spectrum import FloatArray

ComplexArray = NDArray[np.complex128]

#: Samples of the radial table from which a perfect lens's transfer is taken, linear between them: to 2e-8.
RADIAL_SAMPLES = 4096


def fold_transfer(
    transfer: Callable[[FloatArray, FloatArray], FloatArray | ComplexArray],
    shape: tuple[int, int],
    fill_factor: float,
    cutoff_cy_per_px: float,
) -> FloatArray | ComplexArray:
    """Return the folded transfer function at the frequencies of a real FFT of `shape`, (rows, cols // 2 + 1).

    `transfer(fx, fy)` takes frequencies in cy/px that broadcast, and is negligible beyond `cutoff_cy_per_px`.
    """
    fy, fx = fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :]
    orders = _orders(cutoff_cy_per_px)
    total: FloatArray | ComplexArray = np.zeros((fy.size, fx.size))
    for b in orders:
        for a in orders:
            square = _square(fx + a, fill_factor) * _square(fy + b, fill_factor)
            total = total + transfer(fx + a, fy + b) * square
    return total


def fold_diffraction(shape: tuple[int, int], fill_factor: float, cutoff_cy_per_px: float) -> FloatArray:
    """`fold_transfer` of a perfect lens with the given cutoff (pixel pitch / (wavelength f_number)), from a table along
    the radius.
    """
    table = diffraction_otf(np.arange(RADIAL_SAMPLES + 2) / RADIAL_SAMPLES, 1e3, 1.0)
    fy, fx = fft.fftfreq(shape[0]), fft.rfftfreq(shape[1])
    orders = np.array(_orders(cutoff_cy_per_px), float)
    square_x, square_y = (_square(f[None, :] + orders[:, None], fill_factor) for f in (fx, fy))
    half = shape[0] // 2 + 1  # the rest mirrors it
    out = np.empty((fy.size, fx.size))
    _fold_radial(out[:half], fx, fy[:half], orders, square_x, square_y, table, 1.0 / cutoff_cy_per_px)
    out[half:] = out[1 : shape[0] - half + 1][::-1]
    return out


def _orders(cutoff_cy_per_px: float) -> list[int]:
    most = int(np.floor(cutoff_cy_per_px + 0.5))
    return list(range(-most, most + 1))


def _square(f_cy_per_px: FloatArray, fill_factor: float) -> FloatArray:
    """Return the pixel's aperture, and the picture's square of one pixel."""
    return aperture_otf(f_cy_per_px, 0.0, fill_factor) * np.sinc(f_cy_per_px)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _fold_radial(
    out: FloatArray,
    fx: FloatArray,
    fy: FloatArray,
    orders: FloatArray,
    square_x: FloatArray,
    square_y: FloatArray,
    table: FloatArray,
    per_cutoff: float,
) -> None:
    samples = table.size - 2
    for i in range(fy.size):
        for j in range(fx.size):
            total = 0.0
            for b in range(orders.size):
                y = (fy[i] + orders[b]) * per_cutoff
                if abs(y) >= 1.0:
                    continue
                row = 0.0
                for a in range(orders.size):
                    x = (fx[j] + orders[a]) * per_cutoff
                    r2 = x * x + y * y
                    if r2 < 1.0:
                        at = np.sqrt(r2) * samples
                        k = int(at)
                        row += square_x[a, j] * (table[k] + (at - k) * (table[k + 1] - table[k]))
                total += row * square_y[b, i]
            out[i, j] = total
