"""The MTF of an edge, read from its summary: modulus of the transfer function of the profile, with its covariance, and
the frequencies at which it falls to 50 % and 10 %.

The profile is the posterior under the prior of the line spread, so that its covariance is about the truth. `edge_mtf`
is the whole estimator, on a region.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from lab.errors import NotDetermined
from lab.observables.edges.finding import Plane
from lab.observables.edges.profile import EdgeSummary, summarise_edge
from lab.observables.edges.spread import Spline

Array = NDArray[np.floating[Any]]

DEFAULT_FREQUENCY_CY_PER_PX: Array = np.arange(101) / 100.0


@dataclass(frozen=True)
class EdgeMtf:
    """The MTF of one edge in one channel.

    `mtf` (frequencies,): modulus with the contribution of the noise taken out, and `mtf_std`, `covariance`
    (frequencies, frequencies) of it. `otf`: the complex transfer function as estimated, phase about the edge. `esf` (0
    dark, 1 light) and `lsf`, its derivative per px, at `distance_px`. `dark_level`, `light_level` and the standard
    deviations `noise_std_dark`, `noise_std_light` are in the unit of the region. `residual_chi2_per_sample` is near 1
    where edge, spline and noise explain the region. `edge`: the summary that all is read from.
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
    edge: EdgeSummary

    def predict(self, profile: Callable[[Array], Array]) -> Array:
        """Predict the MTF at `frequency_cy_per_px` that this estimator reports for an edge profile; see
        `EdgeSummary.predict`.
        """
        return np.abs(optical_transfer(self.edge.spline, self.edge.predict(profile), self.frequency_cy_per_px))


def read_mtf(edge: EdgeSummary, frequency_cy_per_px: ArrayLike | None = None) -> EdgeMtf:
    """Read the MTF of an edge at `frequency_cy_per_px` (frequencies,), by default 0..1 by 0.01, with its covariance,
    MTF50 and MTF10. Raises ValueError for frequencies that are not usable.
    """
    frequency = (
        DEFAULT_FREQUENCY_CY_PER_PX if frequency_cy_per_px is None else np.asarray(frequency_cy_per_px, dtype=float)
    )
    if frequency.ndim != 1 or not np.isfinite(frequency).all() or (frequency < 0.0).any():
        raise ValueError("frequency_cy_per_px must be a list of finite frequencies that aren't negative")
    spline, esf = edge.spline, edge.esf
    otf, jacobian = transfer_and_jacobian(spline, esf, frequency)
    modulus = np.abs(otf)
    phase = np.where(modulus > 0, otf / np.maximum(modulus, 1e-300), 1.0)
    rotated = jacobian * phase.conj()[:, None]
    along_jacobian, across_jacobian = rotated.real, rotated.imag
    covariance = along_jacobian @ edge.covariance @ along_jacobian.T
    across_variance = np.einsum("fi,fi->f", across_jacobian @ edge.covariance, across_jacobian)
    along_variance = np.clip(np.diag(covariance), 0.0, None)
    # Noise n adds to the power: E|F + n|^2 = |F|^2 + var. Its part across F does so everywhere, its part along F only
    # where |F| is small.
    power = modulus**2
    excess = across_variance + along_variance**2 / np.maximum(along_variance + power, 1e-300)
    # The last term, of fourth order where |F| is large, takes out the floor that is left where it is small
    mtf = np.sqrt(np.clip(power - excess - excess**2 / np.maximum(power, 1e-300), 0.0, None))

    (mtf50, mtf50_std), (mtf10, mtf10_std) = _falling_frequencies(edge, (0.5, 0.1))
    step = esf[-1] - esf[0]
    count = int(edge.reach_px / 0.125)
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
        angle_deg=edge.angle_deg,
        angle_deg_std=edge.angle_deg_std,
        distance_px=distance,
        esf=(spline.values(esf, distance) - esf[0]) / step,
        lsf=spline.derivative(esf, distance) / step,
        dark_level=edge.levels[0],
        light_level=edge.levels[1],
        noise_std_dark=edge.noise_std[0],
        noise_std_light=edge.noise_std[1],
        residual_chi2_per_sample=edge.residual_chi2_per_sample,
        edge=edge,
    )


def optical_transfer(spline: Spline, esf: Array, frequency_cy_per_px: Array) -> NDArray[np.complex128]:
    """Return the complex transfer function (frequencies,) of a profile with the coefficients `esf` (k,): 1 at frequency
    0, phase about the edge.
    """
    return np.asarray(spline.transfer_operator(frequency_cy_per_px) @ esf / (esf[-1] - esf[0]))


def transfer_and_jacobian(
    spline: Spline, esf: Array, frequency_cy_per_px: Array
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the transfer function F (frequencies,) and its Jacobian dF/d(esf) (frequencies, k).

    F = T esf / (esf[-1] - esf[0]), T the transfer operator of the spline.
    """
    operator = spline.transfer_operator(frequency_cy_per_px)
    step = esf[-1] - esf[0]
    otf = np.asarray(operator @ esf / step)
    jacobian = operator / step
    jacobian[:, -1] -= otf / step
    jacobian[:, 0] += otf / step
    return otf, jacobian


def _falling_frequencies(edge: EdgeSummary, levels: Sequence[float]) -> list[tuple[float | None, float | None]]:
    """Find the first frequency at which the MTF falls to each level, and its standard deviation, cy/px.

    None where it doesn't fall so far up to 1.5 cy/px, or where the standard deviation of the MTF there is above 0.3 of
    the level.
    """
    grid = 1.5 * (np.arange(2, 81) / 80.0) ** 2
    mtf = np.abs(optical_transfer(edge.spline, edge.esf, grid))
    # The first frequency of the grid below each level; 0 where there is none
    first = [int(np.argmax(mtf < level)) for level in levels]
    spans = np.array([np.linspace(grid[k - 1], grid[k], 9) for k in first if k])
    if not len(spans):
        return [(None, None) for _ in levels]
    curves = np.abs(optical_transfer(edge.spline, edge.esf, spans.ravel())).reshape(spans.shape)
    fallen = [level for level, k in zip(levels, first, strict=True) if k]
    # Between the points of the grid: a cubic spline through nine
    splines = [CubicSpline(span, curve - level) for span, curve, level in zip(spans, curves, fallen, strict=True)]
    crossings = np.array([float(f.roots(extrapolate=False)[0]) for f in splines])
    otf, jacobian = transfer_and_jacobian(edge.spline, edge.esf, crossings)
    by_esf = (jacobian * (otf.conj() / np.abs(otf))[:, None]).real
    stds = np.sqrt(np.einsum("fi,fi->f", by_esf @ edge.covariance, by_esf))
    found = {
        level: (float(at), float(std / abs(f(at, 1))))
        for level, at, std, f in zip(fallen, crossings, stds, splines, strict=True)
        if std < 0.3 * level
    }
    return [found.get(level, (None, None)) for level in levels]


def edge_mtf(
    region: ArrayLike, frequency_cy_per_px: ArrayLike | None = None, noise_std: float | None = None
) -> EdgeMtf:
    """Estimate the MTF of a linear region that holds one straight or gently bent edge at any angle.

    region : (rows, cols)
    frequency_cy_per_px : (frequencies,), 0..1 by 0.01 by default
    noise_std : in the unit of the region; by default it is estimated from the residuals on both sides of the edge

    Returns MTF, its standard deviation, MTF50 and the angle: from the vertical, -90 to 90 deg, positive where the top
    of the edge turns to the right. Raises `NotDetermined` where there is no single edge, ValueError for frequencies or
    a `noise_std` that are not usable. The method: `lab.fit.mtf`.

    >>> import calibench
    >>> import numpy as np
    >>> from scipy.special import ndtr
    >>> rows, cols = np.mgrid[0:60, 0:60]
    >>> edge = 1000.0 * ndtr((cols - 30.0 + 0.1 * (rows - 30.0)) / 0.8)  # a Gaussian blur of 0.8 px
    >>> measured = calibench.edge_mtf(edge + np.random.default_rng(1).normal(0.0, 1.0, edge.shape))
    >>> round(measured.mtf50_cy_per_px, 2)  # sqrt(ln 2 / 2) / (pi 0.8 cos 5.7 deg) = 0.235
    0.24
    """
    values = np.asarray(region, dtype=float)
    if values.ndim != 2:
        raise NotDetermined("mtf", f"a region has two dimensions, this one has {values.ndim}")
    if noise_std is not None and not 0.0 < noise_std < np.inf:
        raise ValueError(f"noise_std = {noise_std} must be positive and finite; without it the residual says it")
    return read_mtf(summarise_edge([Plane(values)], noise_std), frequency_cy_per_px)
