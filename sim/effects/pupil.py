"""Diffraction by an aberrated circular pupil: what the aberrations among the effects share."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from sim.spectrum import FloatArray

#: Path difference in um of two pupil points (u + s/2, v) and (u - s/2, v), u along the frequency's direction, at the
#: angle (rad) of the frequency from x; pupil radius 1, s = 2 f / cut-off.
PathDifference = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]


@lru_cache(maxsize=8)
def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    node, weight = np.polynomial.legendre.leggauss(count)
    return 0.5 * (node + 1.0), 0.5 * weight


def aberration_ratio(
    fx_cy_per_um: FloatArray,
    fy_cy_per_um: FloatArray,
    wavelength_nm: float,
    f_number: float,
    path_difference_um: PathDifference,
    *,
    isotropic: bool,
    along_only: bool = False,
    nodes: int = 16,
) -> FloatArray:
    """OTF of an aberrated circular pupil over that of the perfect one; shape of `fx_cy_per_um`; 1 beyond the cut-off.

    H(s) = (1/pi) integral over the overlap of two unit discs a distance s apart of cos(2 pi dW / lambda), for aberrations
    whose dW is odd in u (all even ones, such as defocus, spherical aberration and astigmatism). Gauss-Legendre in
    coordinates that take the square roots at the rim away. `isotropic`: dW doesn't depend on the angle; `along_only`: nor on v.
    Source: J. Goodman, Introduction to Fourier Optics, section 6.4.
    """
    fx, fy = np.broadcast_arrays(np.asarray(fx_cy_per_um, float), np.asarray(fy_cy_per_um, float))
    radius = np.hypot(fx, fy)
    cutoff = 1.0 / (wavelength_nm * 1e-3 * f_number)
    if not isotropic:
        angle = np.arctan2(fy, fx).ravel()
        return _ratio(radius.ravel() / cutoff * 2.0, angle, wavelength_nm, path_difference_um, nodes).reshape(
            radius.shape
        )
    # the same radius comes again at other angles
    grid, place = np.unique(np.round(radius / cutoff, 9), return_inverse=True)
    if grid.size > 600:
        table = np.linspace(0.0, min(1.0, float(grid[-1])), 301)
        coarse = aberration_ratio(
            table * cutoff, np.zeros_like(table), wavelength_nm, f_number, path_difference_um,
            isotropic=True, along_only=along_only, nodes=nodes,
        )  # fmt: skip
        return np.where(radius < cutoff, np.interp(radius / cutoff, table, coarse), 1.0)
    if along_only:
        values = _ratio_along(2.0 * grid, wavelength_nm, path_difference_um, 2 * nodes)
    else:
        values = _ratio(2.0 * grid, np.zeros_like(grid), wavelength_nm, path_difference_um, nodes)
    return np.asarray(values[place.reshape(radius.shape)])


def _ratio_along(s: FloatArray, wavelength_nm: float, path_difference_um: PathDifference, nodes: int) -> FloatArray:
    """For path errors that don't depend on v: the overlap's chord sqrt(1 - (u + s/2)^2) is the weight, u from 0 to 1 - s/2."""
    node, weight = _nodes(nodes)
    inside = np.clip(s, 0.0, 2.0 - 1e-9)[:, None]
    # u = (1 - s/2) (1 - t^2) takes the chord's square root at the rim away
    u = (1.0 - 0.5 * inside) * (1.0 - node[None, :] ** 2)
    area = weight * node * np.sqrt(np.maximum(1.0 - (u + 0.5 * inside) ** 2, 0.0))
    phase = (
        2.0 * np.pi / (wavelength_nm * 1e-3) * path_difference_um(u, np.zeros_like(u), inside, np.zeros_like(inside))
    )
    return np.where(s < 2.0, (area * np.cos(phase)).sum(1) / np.maximum(area.sum(1), 1e-300), 1.0)


def _ratio(
    s: FloatArray, angle: FloatArray, wavelength_nm: float, path_difference_um: PathDifference, nodes: int
) -> FloatArray:
    node, weight = _nodes(nodes)
    inside = np.clip(s, 0.0, 2.0 - 1e-9)[:, None, None]
    # the overlap's half with v > 0: v = v_max sin(t), u = u_max(v) * p with p in -1..1
    t = 0.5 * np.pi * node[None, :, None]
    v_max = np.sqrt(1.0 - 0.25 * inside**2)
    v = v_max * np.sin(t)
    u_max = np.sqrt(np.maximum(1.0 - v**2, 0.0)) - 0.5 * inside
    p = (2.0 * node - 1.0)[None, None, :]
    area = weight[None, :, None] * weight[None, None, :] * v_max * np.cos(t) * u_max
    phase = 2.0 * np.pi / (wavelength_nm * 1e-3) * path_difference_um(u_max * p, v, inside, angle[:, None, None])
    # v -> -v is folded in by averaging, for aberrations that mix u and v
    mirrored = 2.0 * np.pi / (wavelength_nm * 1e-3) * path_difference_um(u_max * p, -v, inside, angle[:, None, None])
    above = (area * 0.5 * (np.cos(phase) + np.cos(mirrored))).sum((1, 2))
    below = area.sum((1, 2))
    return np.where(s < 2.0, above / np.maximum(below, 1e-300), 1.0)
