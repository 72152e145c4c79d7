"""The transfer function of a fitted edge profile, its covariance, and the frequencies at which it falls to 50 and 10
%.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.interpolate import CubicSpline

from lab.fit.mtf.edge_finding import half_way_px
from lab.fit.mtf.spline import Spline

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class EdgeGeometry:
    """The linear operator of the estimator: where the samples lie with respect to the edge, and their weights.

    With n samples, k spline coefficients and g gradients of the illumination:

    `edge_px`: coefficients of the edge, a polynomial in (along - centre) / half_length, in px of the full sensor,
    lowest power first. `transposed`: the polynomial gives the row, else the column. `distance_px` (n,): signed
    distance of the samples from the edge, positive on the light side. `weight` (n,): inverse variance of the
    normalised values. `spline`: basis of the ESF. `gradients` (g, n): columns of the gradients of the illumination.
    `inverse` (k + g, k + g): inverse of the normal matrix with its prior, which takes A^T W values to the solution.
    `gram` (k + g + 1, k + g + 1): A^T W A, where A holds the columns of the spline, the gradients and the values.
    """

    angle_deg: float
    angle_deg_std: float
    transposed: bool
    edge_px: tuple[float, ...]
    centre_px: tuple[float, float]
    half_length_px: float
    distance_px: Array
    weight: Array
    spline: Spline
    gradients: Array
    inverse: Array
    gram: Array

    @property
    def reach_px(self) -> float:
        """Largest distance of a sample from the edge, px."""
        return float(np.abs(self.distance_px).max())

    @cached_property
    def basis(self) -> sparse.csr_array:
        """Basis functions of the spline at the samples, (n, k)."""
        return self.spline.design(self.distance_px)

    def coefficients(self, values: Array) -> Array:
        """Coefficients (k,) of the ESF that the estimator finds for `values` (n,) at the samples."""
        weighted = values * self.weight
        right = np.concatenate([self.basis.T @ weighted, self.gradients @ weighted])
        return np.asarray(self.inverse @ right)[: self.basis.shape[1]]

    def optical_transfer(self, coefficients: Array, frequency_cy_per_px: Array) -> NDArray[np.complex128]:
        """Complex transfer function (frequencies,) of an ESF with these coefficients: 1 at frequency 0, phase about
        the edge.
        """
        step = coefficients[-1] - coefficients[0]
        return np.asarray(self.spline.transfer_operator(frequency_cy_per_px) @ coefficients / step)

    def predict(self, profile: Callable[[Array], Array], frequency_cy_per_px: ArrayLike) -> Array:
        """MTF (frequencies,) that the estimator reports, at this very geometry, for a noise-free edge profile.

        `profile(distance_px)` gives the ESF at signed distances from the edge, rising towards positive distances, with
        any two levels and any shift: the edge is put where the profile is half way. It is called once, on an even grid
        of 0.05 px.
        """
        reach = self.reach_px + 0.1
        count = int(np.ceil(reach / 0.05))
        grid = np.arange(-count, count + 1) * 0.05
        values = np.asarray(profile(grid), dtype=float)
        middle = half_way_px(grid, (values - values[0]) / (values[-1] - values[0]))
        sampled = _cubic_interpolation(grid, values, self.distance_px + middle)
        otf = self.optical_transfer(self.coefficients(sampled), np.asarray(frequency_cy_per_px, dtype=float))
        return np.abs(otf)


def _cubic_interpolation(grid: Array, values: Array, at: Array) -> Array:
    """Catmull-Rom interpolation of `values` on the even `grid` at the places `at`: its error is of fourth order in the
    spacing.
    """
    step = grid[1] - grid[0]
    position = np.clip((at - grid[0]) / step, 1.0, len(grid) - 2.001)
    i = position.astype(np.int64)
    t = position - i
    a, b, c, d = values[i - 1], values[i], values[i + 1], values[i + 2 - (i + 2 >= len(grid))]
    return np.asarray(b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))))


@dataclass(frozen=True)
class EdgeMtf:
    """The result of one edge in one channel.

    `mtf` (frequencies,): modulus with the contribution of the noise taken out, and `mtf_std`, `covariance`
    (frequencies, frequencies) of it. `otf`: the complex transfer function as estimated, phase about the edge. `esf` (0
    dark, 1 light) and `lsf`, its derivative per px, at `distance_px`. `dark_level`, `light_level` and the standard
    deviations `noise_std_dark`, `noise_std_light` are in the unit of the region. `residual_chi2_per_sample` is near 1
    where edge, spline and noise explain the region.
    """

    frequency_cy_per_px: Array
    mtf: Array
    mtf_std: Array
    covariance: Array
    otf: NDArray[np.complex128]
    mtf50_cy_per_px: float | None
    mtf50_cy_per_px_std: float | None
    mtf10_cy_per_px: float | None
    mtf10_cy_per_px_std: float | None
    angle_deg: float
    angle_deg_std: float
    distance_px: Array
    esf: Array
    lsf: Array
    dark_level: float
    light_level: float
    noise_std_dark: float
    noise_std_light: float
    residual_chi2_per_sample: float
    geometry: EdgeGeometry

    def predict(self, profile: Callable[[Array], Array]) -> Array:
        """MTF at `frequency_cy_per_px` that this estimator reports for a predicted edge profile; see
        `EdgeGeometry.predict`.
        """
        return self.geometry.predict(profile, self.frequency_cy_per_px)


def edge_result(
    geometry: EdgeGeometry,
    esf: Array,
    covariance_of_esf: Array,
    frequency: Array,
    *,
    levels: tuple[float, float],
    noise: tuple[float, float],
    chi2: float,
) -> EdgeMtf:
    """Transfer function, its covariance, MTF50 and MTF10 from the coefficients `esf` (k,) and their covariance (k, k).

    `levels`, `noise`: (dark, light), in the unit of the region; `chi2`: of the residual per degree of freedom.
    """
    spline = geometry.spline
    otf, jacobian = transfer_and_jacobian(geometry, esf, frequency)
    modulus = np.abs(otf)
    phase = np.where(modulus > 0, otf / np.maximum(modulus, 1e-300), 1.0)
    rotated = jacobian * phase.conj()[:, None]
    along_jacobian, across_jacobian = rotated.real, rotated.imag
    covariance = along_jacobian @ covariance_of_esf @ along_jacobian.T
    across_variance = np.einsum("fi,fi->f", across_jacobian @ covariance_of_esf, across_jacobian)
    along_variance = np.clip(np.diag(covariance), 0.0, None)
    # Noise n adds to the power: E|F + n|^2 = |F|^2 + var. Its part across F does so everywhere, its part along F only
    # where |F| is small.
    power = modulus**2
    excess = across_variance + along_variance**2 / np.maximum(along_variance + power, 1e-300)
    # The last term, of fourth order where |F| is large, takes out the floor that is left where it is small
    mtf = np.sqrt(np.clip(power - excess - excess**2 / np.maximum(power, 1e-300), 0.0, None))

    (mtf50, mtf50_std), (mtf10, mtf10_std) = _falling_frequencies(geometry, esf, covariance_of_esf, (0.5, 0.1))
    step = esf[-1] - esf[0]
    count = int(geometry.reach_px / 0.125)
    distance = np.arange(-count, count + 1) * 0.125
    return EdgeMtf(
        frequency_cy_per_px=frequency,
        mtf=mtf,
        mtf_std=np.sqrt(along_variance),
        covariance=covariance,
        otf=otf,
        mtf50_cy_per_px=mtf50,
        mtf50_cy_per_px_std=mtf50_std,
        mtf10_cy_per_px=mtf10,
        mtf10_cy_per_px_std=mtf10_std,
        angle_deg=geometry.angle_deg,
        angle_deg_std=geometry.angle_deg_std,
        distance_px=distance,
        esf=(spline.values(esf, distance) - esf[0]) / step,
        lsf=spline.derivative(esf, distance) / step,
        dark_level=levels[0],
        light_level=levels[1],
        noise_std_dark=noise[0],
        noise_std_light=noise[1],
        residual_chi2_per_sample=chi2,
        geometry=geometry,
    )


def transfer_and_jacobian(
    geometry: EdgeGeometry, esf: Array, frequency: Array
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Transfer function F (frequencies,) and its Jacobian dF/d(esf) (frequencies, k).

    F = T esf / (esf[-1] - esf[0]), T the transfer operator of the spline.
    """
    operator = geometry.spline.transfer_operator(frequency)
    step = esf[-1] - esf[0]
    otf = np.asarray(operator @ esf / step)
    jacobian = operator / step
    jacobian[:, -1] -= otf / step
    jacobian[:, 0] += otf / step
    return otf, jacobian


def _falling_frequencies(
    geometry: EdgeGeometry, esf: Array, covariance: Array, levels: Sequence[float]
) -> list[tuple[float | None, float | None]]:
    """First frequency at which the MTF falls to each level, and its standard deviation, cy/px.

    None where it doesn't fall so far up to 1.5 cy/px, or where the standard deviation of the MTF there is above 0.3 of
    the level.
    """
    grid = 1.5 * (np.arange(2, 81) / 80.0) ** 2
    mtf = np.abs(geometry.optical_transfer(esf, grid))
    # The first frequency of the grid below each level; 0 where there is none
    first = [int(np.argmax(mtf < level)) for level in levels]
    spans = np.array([np.linspace(grid[k - 1], grid[k], 9) for k in first if k])
    if not len(spans):
        return [(None, None) for _ in levels]
    curves = np.abs(geometry.optical_transfer(esf, spans.ravel())).reshape(spans.shape)
    fallen = [level for level, k in zip(levels, first, strict=True) if k]
    # Between the points of the grid: a cubic spline through nine
    splines = [CubicSpline(span, curve - level) for span, curve, level in zip(spans, curves, fallen, strict=True)]
    crossings = np.array([float(f.roots(extrapolate=False)[0]) for f in splines])
    otf, jacobian = transfer_and_jacobian(geometry, esf, crossings)
    by_esf = (jacobian * (otf.conj() / np.abs(otf))[:, None]).real
    stds = np.sqrt(np.einsum("fi,fi->f", by_esf @ covariance, by_esf))
    found = {
        level: (float(at), float(std / abs(f(at, 1))))
        for level, at, std, f in zip(fallen, crossings, stds, splines, strict=True)
        if std < 0.3 * level
    }
    return [found.get(level, (None, None)) for level in levels]
