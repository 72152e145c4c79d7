"""A test of kernels over the field: do they fit a lens that is symmetric about its axis?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from lab.errors import NotDetermined
from lab.fit.psf.screen_kernel import ScreenKernel
from lab.formats.results import PsfSymmetry

Array = NDArray[np.floating[Any]]

MOMENT_WINDOW_PX = 2.0  # standard deviation of the window of the moments


def radial_symmetry(parts: Sequence[ScreenKernel], axis_px: tuple[float, float]) -> PsfSymmetry:
    """Test whether kernels at several places fit a lens that is symmetric about its axis at `axis_px`, (row, col).

    Of each kernel the second moments under a Gaussian window about its centroid are rotated into radial, tangential
    and mixed ones. For a symmetric lens the mixed moment is 0, and the others are even polynomials of the distance r
    from the axis that agree on it: a0 + a r^2 and a0 + b r^2. Generalised least squares with the covariances of the
    kernels. The lens is called symmetric where chi2 is below its 99.9 % quantile. Raises `NotDetermined` below five
    kernels, or where they lie at one distance.
    """
    radius = np.array([np.hypot(k.centre_px[0] - axis_px[0], k.centre_px[1] - axis_px[1]) for k in parts])
    if len(parts) < 5 or np.ptp(radius) < 10.0:
        raise NotDetermined(
            "psf", f"{len(parts)} kernels over the field don't test radial symmetry: 5 at unequal distances do"
        )
    top = float(radius.max())
    values, weights, designs = [], [], []
    for kernel, r in zip(parts, radius, strict=True):
        moments, covariance = _windowed_moments(kernel)
        offset = np.array(kernel.centre_px) - axis_px
        u = offset / r if r > 1e-6 else np.array([1.0, 0.0])
        v = np.array([-u[1], u[0]])
        rotation = np.array(  # of (row row, row col, col col) into (radial, tangential, mixed)
            [
                [u[0] ** 2, 2 * u[0] * u[1], u[1] ** 2],
                [v[0] ** 2, 2 * v[0] * v[1], v[1] ** 2],
                [u[0] * v[0], u[0] * v[1] + u[1] * v[0], u[1] * v[1]],
            ]
        )
        values.append(rotation @ moments)
        weights.append(np.linalg.inv(rotation @ covariance @ rotation.T))
        x = (r / top) ** 2
        designs.append(np.array([[1.0, x, 0.0], [1.0, 0.0, x], [0.0, 0.0, 0.0]]))
    normal = sum(d.T @ w @ d for d, w in zip(designs, weights, strict=True))
    right = sum(d.T @ w @ v for d, w, v in zip(designs, weights, values, strict=True))
    solution = np.linalg.solve(normal, right)
    residuals = [v - d @ solution for v, d in zip(values, designs, strict=True)]
    chi2 = float(sum(g @ w @ g for g, w in zip(residuals, weights, strict=True)))
    freedom = 3 * len(parts) - 3
    pulls = [float(g[2] * np.sqrt(w[2, 2])) for g, w in zip(residuals, weights, strict=True)]
    return PsfSymmetry(
        kernels=len(parts),
        chi2=chi2,
        degrees_of_freedom=freedom,
        probability=float(special.chdtrc(freedom, chi2)),
        symmetric=chi2 < float(special.chdtri(freedom, 0.001)),
        variance_on_axis_px2=float(solution[0]),
        radial_growth_px2=float(solution[1]),
        tangential_growth_px2=float(solution[2]),
        largest_mixed_sigma=max(pulls, key=abs),
    )


def _windowed_moments(kernel: ScreenKernel) -> tuple[Array, Array]:
    """Second moments (row row, row col, col col) of a kernel under a Gaussian window about its centroid, px^2, and
    their covariance (3, 3).
    """
    half = len(kernel.kernel) // 2
    row, col = np.meshgrid(*(np.arange(-half, half + 1.0),) * 2, indexing="ij")
    centre = np.zeros(2)
    for _ in range(8):  # fixed point: the window is centred on the windowed centroid
        r, c = row - centre[0], col - centre[1]
        window = np.exp(-0.5 * (r**2 + c**2) / MOMENT_WINDOW_PX**2) * kernel.kernel
        centre += np.array([(window * r).sum(), (window * c).sum()]) / window.sum()
    weight = np.exp(-0.5 * (r**2 + c**2) / MOMENT_WINDOW_PX**2)
    total = float((weight * kernel.kernel).sum())
    terms = np.stack([r * r, r * c, c * c]).reshape(3, -1) * weight.ravel() / total
    moments = terms @ kernel.kernel.ravel()
    jacobian = terms - moments[:, None] * weight.ravel() / total
    return moments, jacobian @ kernel.covariance @ jacobian.T
