"""The blur kernel by Mosleh et al., "Camera intrinsic blur kernel estimation: a reliable framework", CVPR 2015: kept so
that the comparison with `lab.fit.psf` can be run. It is not what the fits use.

    min over k >= 0 of ||k * u - b||^2 + lambda ||k||^2 + mu ||grad k||^2 + gamma || |F(k)| - |F(k')| ||^2,
    |F(k')|^2 = |F(b)|^2 / |F(u)|^2

u: the sharp target, b: the blurred one, F: the discrete Fourier transform. The kernel is normalised to a sum of 1
afterwards, as the paper does; that, and the last term, whose target is 4 to 10 % off wherever there is noise or a
border, is what it loses by.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.optimize import minimize

from lab.fit.psf.kernel import normal_equations

Array = NDArray[np.floating[Any]]


def mosleh_kernel(
    sharp: ArrayLike,
    blurred: ArrayLike,
    support: int,
    ridge: float = 1e-5,
    smoothness: float = 1e-5,
    spectrum: float = 1e-4,
) -> Array:
    """Kernel (support, support), >= 0, sum 1, of the objective above. `sharp`, `blurred`: (rows, cols) as for
    `lab.fit.psf.estimate_kernel`; `ridge`, `smoothness`, `spectrum`: lambda, mu and gamma, in units of the Gram matrix'
    mean diagonal. Minimised by L-BFGS-B from a flat kernel."""
    u, b = np.asarray(sharp, dtype=float), np.asarray(blurred, dtype=float)
    normal = normal_equations(u - u.mean(), b - b.mean(), support)
    scale = float(np.diag(normal.gram).mean())
    gram, right = normal.gram / scale, normal.right / scale
    power = np.abs(fft.fft2(b - b.mean())) ** 2 / np.maximum(np.abs(fft.fft2(u - u.mean())) ** 2, 1e-3 * scale)
    # The ratio's inverse is a correlation: its middle is all that a kernel of this support has, on a grid twice as wide
    correlation = fft.fftshift(fft.ifft2(power).real)
    middle, size = np.array(correlation.shape) // 2, 2 * support
    window = correlation[middle[0] - support : middle[0] + support, middle[1] - support : middle[1] + support]
    target = np.sqrt(np.maximum(fft.fft2(fft.ifftshift(window)).real, 0.0))

    def objective(flat: Array) -> tuple[float, Array]:
        kernel = flat.reshape(support, support)
        pull = gram @ flat
        down, across = np.diff(np.pad(kernel, 1), axis=0), np.diff(np.pad(kernel, 1), axis=1)
        seen = fft.fft2(kernel, (size, size))
        modulus = np.abs(seen)
        gap = modulus - target
        value = (
            flat @ pull
            - 2.0 * right @ flat
            + ridge * flat @ flat
            + smoothness * (np.sum(down**2) + np.sum(across**2))
            + spectrum * np.mean(gap**2)
        )
        by_spectrum = fft.ifft2(gap * seen / np.maximum(modulus, 1e-12)).real[:support, :support]
        rough = -np.diff(down, axis=0)[:, 1:-1] - np.diff(across, axis=1)[1:-1]
        slope = 2.0 * (pull - right + ridge * flat + smoothness * rough.ravel() + spectrum * by_spectrum.ravel())
        return float(value), slope

    start = np.full(support * support, 1.0 / support**2)
    found = minimize(
        objective, start, jac=True, method="L-BFGS-B", bounds=[(0.0, None)] * len(start),
        options={"maxiter": 2000, "maxfun": 4000, "ftol": 1e-14, "gtol": 1e-9},
    )  # fmt: skip
    kernel = np.asarray(found.x).reshape(support, support)
    return np.asarray(kernel / kernel.sum())
