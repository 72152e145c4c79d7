"""Diffraction by an aberrated circular pupil, as a ratio to the perfect one: what the even aberrations among the effects share.

H(s) = (1/pi) integral over the overlap of two unit discs, a distance s = 2 f / cut-off apart, of cos(2 pi dW / lambda), dW the
difference of the path errors at the two pupil points. Source: J. Goodman, Introduction to Fourier Optics, section 6.4.
(`sim.optics.pupil` has the OTF of any path error, complex; these two are for the fits of a diagnosis, which call them a hundred
thousand times: a single integral where dW is linear, a table along the radius where it doesn't depend on direction.)
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from sim.spectrum import FloatArray

#: dW in um of the pupil points (u + s/2, v) and (u - s/2, v), u along the frequency; all broadcast.
PathDifference = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
NODES_LINE, NODES_PLANE = 32, 16


@lru_cache(maxsize=8)
def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    node, weight = np.polynomial.legendre.leggauss(count)
    return 0.5 * (node + 1.0), 0.5 * weight


def quadratic_ratio(
    fx_cy_per_um: FloatArray,
    fy_cy_per_um: FloatArray,
    wavelength_nm: float,
    f_number: float,
    path_um: tuple[float, float],
) -> FloatArray:
    """OTF ratio of the path error path_um[0] x^2 + path_um[1] y^2 (x along columns): defocus where both are alike.

    dW is linear over the overlap, so that the integral across is a sinc: what remains is one along the frequency. Shape of the
    frequencies; 1 beyond the cut-off, where both are 0.
    """
    fx, fy = np.broadcast_arrays(np.asarray(fx_cy_per_um, float), np.asarray(fy_cy_per_um, float))
    shape, radius = fx.shape, np.hypot(fx, fy).ravel()
    s = 2.0 * radius * (wavelength_nm * 1e-3 * f_number)
    safe = np.where(radius > 0, radius, 1.0)
    cos, sin = np.where(radius > 0, fx.ravel() / safe, 1.0), fy.ravel() / safe
    wave = 2.0 * np.pi / (wavelength_nm * 1e-3) * 2.0 * s
    along = wave * (path_um[0] * cos**2 + path_um[1] * sin**2)
    across = wave * (path_um[1] - path_um[0]) * cos * sin
    node, weight = _nodes(NODES_LINE)
    half = np.clip(0.5 * s, 0.0, 1.0 - 1e-9)[:, None]
    # u = (1 - s/2) (1 - t^2) takes the chord's square root at the rim away
    u = (1.0 - half) * (1.0 - node[None, :] ** 2)
    chord = np.sqrt(np.maximum(1.0 - (u + half) ** 2, 0.0))
    area = weight * node * chord
    wavy = np.cos(along[:, None] * u)
    if np.any(across):
        wavy = wavy * np.sinc(across[:, None] * chord / np.pi)
    ratio = (area * wavy).sum(1) / np.maximum(area.sum(1), 1e-300)
    return np.where(s < 2.0, ratio, 1.0).reshape(shape)


def isotropic_ratio(
    fx_cy_per_um: FloatArray,
    fy_cy_per_um: FloatArray,
    wavelength_nm: float,
    f_number: float,
    path_difference_um: PathDifference,
) -> FloatArray:
    """OTF ratio of a path error that depends on the pupil's radius only; shape of the frequencies, 1 beyond the cut-off."""
    radius = np.hypot(*np.broadcast_arrays(np.asarray(fx_cy_per_um, float), np.asarray(fy_cy_per_um, float)))
    share = radius * (wavelength_nm * 1e-3 * f_number)
    # the same radius comes again at other angles
    grid, place = np.unique(np.round(share, 9), return_inverse=True)
    if grid.size > 600:
        table = np.linspace(0.0, min(1.0, float(grid[-1])), 301)
        return np.where(
            share < 1.0, np.interp(share, table, _plane(2.0 * table, wavelength_nm, path_difference_um)), 1.0
        )
    return np.asarray(_plane(2.0 * grid, wavelength_nm, path_difference_um)[place.reshape(radius.shape)])


def _plane(s: FloatArray, wavelength_nm: float, path_difference_um: PathDifference) -> FloatArray:
    node, weight = _nodes(NODES_PLANE)
    inside = np.clip(s, 0.0, 2.0 - 1e-9)[:, None, None]
    # the overlap's quarter u, v > 0: v = v_max sin(t), u = u_max(v) p
    t = 0.5 * np.pi * node[None, :, None]
    v_max = np.sqrt(1.0 - 0.25 * inside**2)
    v = v_max * np.sin(t)
    u_max = np.sqrt(np.maximum(1.0 - v**2, 0.0)) - 0.5 * inside
    area = weight[None, :, None] * weight[None, None, :] * v_max * np.cos(t) * u_max
    phase = 2.0 * np.pi / (wavelength_nm * 1e-3) * path_difference_um(u_max * node[None, None, :], v, inside)
    ratio = (area * np.cos(phase)).sum((1, 2)) / np.maximum(area.sum((1, 2)), 1e-300)
    return np.where(s < 2.0, ratio, 1.0)
