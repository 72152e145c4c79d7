"""Spectral distributions: a curve over wavelength, energy and photons, integration, resampling that conserves."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import model_validator
from scipy import constants

from sim.parameters import Frozen

FloatArray = NDArray[np.float64]

#: h c in J nm: the energy of a photon of wavelength w nm is PHOTON_ENERGY_J_NM / w.
PHOTON_ENERGY_J_NM = constants.h * constants.c * 1e9


class Spectrum(Frozen):
    """A curve over wavelength, linear between its samples and zero outside them.

    What `value` is (radiance in W sr^-1 m^-2 nm^-1, a reflectance, a quantum efficiency) stands in the name of the
    variable that holds it. Wavelengths are in nm, strictly ascending; values are finite.
    """

    wavelength_nm: tuple[float, ...]
    value: tuple[float, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.wavelength_nm) != len(self.value) or not self.value:
            raise ValueError(
                f"{len(self.wavelength_nm)} wavelengths and {len(self.value)} values: give as many of the one as of "
                "the other"
            )
        steps = np.diff(self.wavelength_nm)
        if np.any(steps <= 0):
            at = int(np.argmax(steps <= 0))
            raise ValueError(
                f"wavelengths must ascend: {self.wavelength_nm[at + 1]} nm follows {self.wavelength_nm[at]} nm; sort "
                "the rows"
            )
        return self

    @classmethod
    def of(cls, wavelength_nm: ArrayLike, value: ArrayLike) -> Self:
        """Return a spectrum from two arrays of the same length."""
        return cls(
            wavelength_nm=tuple(np.asarray(wavelength_nm, float).tolist()),
            value=tuple(np.asarray(value, float).tolist()),
        )

    @cached_property
    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """(wavelength_nm, value) as arrays that can't be written to."""
        pair = np.array(self.wavelength_nm), np.array(self.value)
        for array in pair:
            array.flags.writeable = False
        return pair

    def at(self, wavelength_nm: ArrayLike) -> FloatArray:
        """Value at the given wavelengths (nm), linear between samples, 0 outside."""
        wanted = np.asarray(wavelength_nm, float)
        return np.interp(wanted, *self.arrays, left=0.0, right=0.0)

    def integral(self, lower_nm: float = -np.inf, upper_nm: float = np.inf) -> float:
        """Integral over wavelength (value's unit x nm) between two wavelengths, exact for the piecewise linear
        curve.
        """
        knots, value = self.arrays
        lower, upper = max(lower_nm, knots[0]), min(upper_nm, knots[-1])
        if lower >= upper:
            return 0.0
        inside = knots[(knots > lower) & (knots < upper)]
        grid = np.concatenate([[lower], inside, [upper]])
        return float(np.trapezoid(np.interp(grid, knots, value), grid))

    def scale(self, factor: float) -> Spectrum:
        """Return the same curve times a number."""
        wavelength_nm, value = self.arrays
        return Spectrum.of(wavelength_nm, value * factor)

    def resample(self, wavelength_nm: ArrayLike) -> Spectrum:
        """Return the curve on other wavelengths (at least two, ascending), conserving what it integrates to.

        v_i = integral S hat_i / integral hat_i with the triangles hat_i of the new grid: as they add up to 1 and to the
        wavelength, the result has the same integral and the same mean wavelength as `self` over the new grid's range,
        however coarse the grid (a line between two samples isn't lost, as it is by interpolation).
        """
        grid = np.asarray(wavelength_nm, float)
        if grid.ndim != 1 or grid.size < 2 or np.any(np.diff(grid) <= 0):
            raise ValueError(
                f"wavelengths to resample to have to be two or more, ascending, got {grid.tolist()[:4]}: sort them"
            )
        knots, value = self.arrays
        # Zero outside the samples: the curve is a polynomial in pieces, with a piece of zero on either side.
        low, high = min(grid[0], knots[0]) - 1.0, max(grid[-1], knots[-1]) + 1.0
        breaks = np.concatenate([[low], knots, [high]])
        slope = np.concatenate([[0.0], np.diff(value) / np.diff(knots), [0.0]])
        start = np.concatenate([[0.0], value[:-1], [0.0]])
        from scipy.interpolate import PPoly

        curve = PPoly(np.vstack([slope, start]), breaks)
        once, twice = curve.antiderivative(1)(grid), curve.antiderivative(2)(grid)
        mean = np.diff(twice) / np.diff(grid)
        moment = np.diff(mean, prepend=once[0], append=once[-1])
        width = np.diff(grid, prepend=grid[0], append=grid[-1])
        return Spectrum.of(grid, moment / (0.5 * (width[:-1] + width[1:])))


def photons_from_energy(wavelength_nm: ArrayLike, energy: ArrayLike) -> FloatArray:
    """Convert energy to photons: value x w / (h c).

    wavelength_nm, energy : arrays that broadcast, nm and W per (nm ...)

    Returns photons per (s nm ...).

    >>> f"{photons_from_energy(500.0, 1.0):.4g}"
    '2.517e+18'
    """
    return np.asarray(energy, float) * np.asarray(wavelength_nm, float) / PHOTON_ENERGY_J_NM


def energy_from_photons(wavelength_nm: ArrayLike, photons: ArrayLike) -> FloatArray:
    """Convert photons to energy: value x h c / w, the inverse of `photons_from_energy`.

    wavelength_nm, photons : arrays that broadcast, nm and photons per (s nm ...)

    Returns W per (nm ...).

    >>> float(energy_from_photons(500.0, photons_from_energy(500.0, 3.0)))
    3.0
    """
    return np.asarray(photons, float) * PHOTON_ENERGY_J_NM / np.asarray(wavelength_nm, float)


def blackbody_radiance(temperature_k: float, wavelength_nm: ArrayLike) -> Spectrum:
    """Compute Planck's law, 2 h c^2 / w^5 / (exp(h c / (w k T)) - 1).

    temperature_k : K; wavelength_nm : ascending, nm

    Returns the radiance, W sr^-1 m^-2 nm^-1. Raises ValueError for a temperature that isn't above 0.

    >>> f"{blackbody_radiance(5800.0, [500.0, 600.0]).at(500.0):.3g}"
    '2.69e+04'
    """
    if not temperature_k > 0:
        raise ValueError(f"temperature {temperature_k} K is not above the limit of 0 K: give the kelvins of a source")
    w = np.asarray(wavelength_nm, float) * 1e-9
    exponent = constants.h * constants.c / (w * constants.k * temperature_k)
    return Spectrum.of(wavelength_nm, 1e-9 * 2.0 * constants.h * constants.c**2 / w**5 / np.expm1(exponent))


def quadrature(spectra: Iterable[Spectrum], step_nm: float = 5.0) -> tuple[FloatArray, FloatArray]:
    """Choose a quadrature for a product of the given curves: Simpson's rule between all their knots.

    spectra : the factors; step_nm : the widest interval, nm

    Returns wavelengths (nm) and weights (nm), of which sum weight x product is the integral: exact for a product of
    two piecewise linear curves and the wavelength, however narrow a line is; good to 1e-6 for smooth factors
    besides.

    >>> w, weight = quadrature([Spectrum.of([400.0, 500.0], [0.0, 1.0])])
    >>> round(float(weight @ ((w - 400.0) / 100.0) ** 2), 9)  # integral of x^2, 100 nm / 3
    33.333333333
    """
    knots = np.unique(np.concatenate([spectrum.arrays[0] for spectrum in spectra]))
    if knots.size < 2:
        return knots, np.zeros(knots.size)
    gap = np.diff(knots)
    parts = np.maximum(1, np.ceil(gap / step_nm - 1e-9)).astype(int)
    width = np.repeat(gap / parts, parts)
    within = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    left = np.repeat(knots[:-1], parts) + within * width
    nodes = np.empty(2 * left.size + 1)
    nodes[:-1:2], nodes[1::2], nodes[-1] = left, left + 0.5 * width, knots[-1]
    weights = np.zeros(nodes.size)
    weights[:-1:2] += width / 6.0
    weights[2::2] += width / 6.0
    weights[1::2] = width * (2.0 / 3.0)
    return nodes, weights


def gauss_rule(position: FloatArray, weight: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Compute Gauss's quadrature for a discrete weight (Golub and Welsch 1969).

    position : (n,), ascending; weight : (n,), >= 0, of sum 1; count : the most nodes

    Returns nodes and shares, (count,) or fewer, with the same moments up to 2 count - 1: the eigenvalues of
    Lanczos's tridiagonal matrix of the positions in the weight's inner product, and the squares of its eigenvectors'
    first entries.

    >>> nodes, shares = gauss_rule(np.array([0.0, 1.0, 2.0]), np.array([0.25, 0.5, 0.25]), 2)
    >>> nodes.round(6).tolist(), shares.round(6).tolist()  # mean 1, variance 1/2
    ([0.292893, 1.707107], [0.5, 0.5])
    """
    used = weight > 0
    x, w = position[used], weight[used]
    centre, half = 0.5 * (x[0] + x[-1]), max(0.5 * (x[-1] - x[0]), 1e-9)
    t = (x - centre) / half
    basis = np.empty((min(count, x.size), x.size))
    basis[0] = np.sqrt(w)
    size = len(basis)
    matrix = np.zeros((size, size))
    for k in range(size):
        residual = t * basis[k]
        matrix[k, k] = basis[k] @ residual
        for _ in range(2):  # twice is enough to stay orthogonal
            residual -= (basis[: k + 1] @ residual) @ basis[: k + 1]
        norm = float(np.linalg.norm(residual))
        if k + 1 == size:
            break
        if norm < 1e-9:
            matrix = matrix[: k + 1, : k + 1]
            break
        matrix[k, k + 1] = matrix[k + 1, k] = norm
        basis[k + 1] = residual / norm
    values, vectors = np.linalg.eigh(matrix)
    return centre + half * values, vectors[0] ** 2


def linear_shares(position: FloatArray, weight: FloatArray, nodes: FloatArray) -> FloatArray:
    """Compute how much each node counts in sum weight x g, for g that is linear between the nodes.

    position, weight : (n,); nodes : (m,), ascending. Positions beyond the nodes count for the outermost

    Returns (m,), of the weights' sum.

    >>> linear_shares(np.array([1.0]), np.array([1.0]), np.array([0.0, 4.0])).tolist()
    [0.75, 0.25]
    """
    left = np.clip(np.searchsorted(nodes, position) - 1, 0, len(nodes) - 2)
    on = np.clip((position - nodes[left]) / (nodes[left + 1] - nodes[left]), 0.0, 1.0)
    lower, upper = np.bincount(left, weight * (1.0 - on), len(nodes)), np.bincount(left + 1, weight * on, len(nodes))
    return np.asarray(lower + upper, float)


def lagrange_shares(position: FloatArray, weight: FloatArray, nodes: FloatArray) -> FloatArray:
    """Compute how much each node counts in sum weight x g, for the polynomial g through its values at the nodes.

    position : (n,); weight : (curves, n); nodes : (m,)

    Returns (curves, m); the shares of a curve add up to the sum of its weights, exactly.

    >>> lagrange_shares(np.array([1.0]), np.array([[1.0]]), np.array([0.0, 1.0, 2.0])).tolist()
    [[0.0, 1.0, 0.0]]
    """
    # the barycentric form: as exact as the products, at a cost of nodes x positions (Berrut and Trefethen 2004)
    apart = (nodes[:, None] - nodes) / max(float(np.ptp(nodes)), 1e-300)
    np.fill_diagonal(apart, 1.0)
    away = position - nodes[:, None]
    met = away == 0.0
    basis = (1.0 / np.prod(apart, axis=1))[:, None] / np.where(met, 1.0, away)
    total = np.sum(basis, axis=0)
    # a node's own place, and far beyond all nodes, where the sum is lost in rounding: what the nearest one has
    lost = met.any(axis=0) | (total == 0.0)
    basis /= np.where(lost, 1.0, total)
    if lost.any():
        basis[:, lost] = np.argmin(np.abs(away[:, lost]), axis=0) == np.arange(len(nodes))[:, None]
    shares = weight @ basis.T
    shares[:, -1] += np.sum(weight, axis=1) - np.sum(shares, axis=1)
    return shares
