"""The estimator of an edge's transfer function as a linear operator on the samples' values.

The MTF's estimator finds the edge and its noise, and leaves the normal equations of the profile's spline. From these the
departures of the transfer function from the baseline's are taken at some frequencies (`Estimator`), by weighted least squares.
`Operators` applies the same to a model's transfer functions: nodes of a quadrature give the edge's profile, the profile gives the
right side of the normal equations, and this gives the reported numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import CubicSpline

from lab.fit.mtf.edge_profile import ROUGHNESS_SHARE
from lab.fit.mtf.transfer_function import EdgeGeometry
from sim.spectrum import FloatArray

ComplexArray = NDArray[np.complex128]
#: Where the transfer function is measured, in shares of the highest frequency: its real part, and its imaginary one; this is nil
#: up to `STILL`, as a phase in proportion to frequency only moves the edge.
REAL_AT = np.array([0.04, 0.09, 0.15, 0.22, 0.30, 0.39, 0.49, 0.60, 0.72, 0.86, 1.0])
IMAGINARY_AT = np.array([0.28, 0.42, 0.57, 0.72, 0.86, 1.0])
STILL = 0.14
#: Departures from the baseline's transfer that count as likely: next to nothing is said of what no sample tells.
DEPARTURE_STD = 0.5
GRID_PX, FINE_PX = 0.05, 0.0125


@dataclass(frozen=True)
class Quadrature:
    """ESF(d) = 1/2 + sum over nodes of Re H(f_k) odd[k](d) + (Im H(f_k) / f_k) even[k](d), H a polynomial in pieces.

    ESF(d) = 1/2 + integral of [Re H sin(2 pi f d) + Im H cos(2 pi f d)] / (pi f) df. Tables are at d = 0, `GRID_PX`, ...
    """

    frequency: FloatArray
    odd: FloatArray  # (nodes, d)
    even: FloatArray

    @staticmethod
    def of(highest: float, reach_px: float) -> Quadrature:
        """Up to `highest` cy/px. Pieces of 1/4, 1/2, 1 cy/px with 8, 6, 6 of Gauss's points: a copy of the image 3 px aside is
        still followed to 1e-4."""
        cuts = np.concatenate([np.arange(0.0, 1.0, 0.25), np.arange(1.0, 2.0, 0.5), np.arange(2.0, 64.0)])
        cuts = np.append(cuts[cuts < highest], highest)
        distance = np.arange(int(np.ceil(reach_px / GRID_PX)) + 2) * GRID_PX
        nodes, odd, even = [], [], []
        for low, high in pairwise(cuts):
            unit = np.polynomial.legendre.leggauss(8 if high <= 1.0 else 6)[0]
            fine, weight = np.polynomial.legendre.leggauss(int(16 + 4.0 * (high - low) * reach_px))
            f, width = 0.5 * (low + high) + 0.5 * (high - low) * fine, 0.5 * (high - low) * weight
            hats = _lagrange(unit, fine)
            phase = 2.0 * np.pi * np.outer(f, distance)
            nodes.append(0.5 * (low + high) + 0.5 * (high - low) * unit)
            odd.append((hats * (width / (np.pi * f))) @ np.sin(phase))
            even.append((hats * (width / np.pi)) @ np.cos(phase))
        return Quadrature(np.concatenate(nodes), np.concatenate(odd), np.concatenate(even))


def _lagrange(nodes: FloatArray, at: FloatArray) -> FloatArray:
    """(nodes, at): the polynomials that are 1 at one node and 0 at all others."""
    basis = np.ones((len(nodes), len(at)))
    for k, node in enumerate(nodes):
        for other in np.delete(nodes, k):
            basis[k] *= (at - other) / (node - other)
    return basis


@dataclass(frozen=True)
class Estimator:
    """How an edge's profile departs from the baseline's: weighted least squares of few shapes, linear in the samples' values.

    profile = level + contrast x (baseline + shift x slope + sum of departures x shapes) + the illumination's gradient; a shape is
    what the profile gains where the transfer function does at one frequency. So what is told of neighbouring frequencies is
    told by all samples that see it; with next to no prior, and none of what a camera is expected to do.
    """

    rows: FloatArray  # (contrast, shift, departures..., distances): of values at distances
    value: FloatArray  # (rows,): of the recording
    covariance: FloatArray  # (rows, rows): of `value`, over repeats

    @staticmethod
    def of(geometry: EdgeGeometry, spread: FloatArray, shapes: FloatArray) -> Estimator:
        """`spread` (k + g, distances): from values at distances to the normal equations' right side; `shapes` (j, distances):
        level, contrast, slope, and the departures."""
        size = geometry.spline.size
        matrix, right = geometry.gram[:-1, :-1], geometry.gram[:-1, -1]
        bridged = matrix[:size, :size] + geometry.spline.roughness(
            ROUGHNESS_SHARE * np.trace(matrix[:size, :size]) / size
        )
        count = len(shapes)
        columns = np.zeros((len(matrix), count + len(matrix) - size))
        columns[:size, :count] = np.linalg.solve(bridged, spread[:size] @ shapes.T)
        columns[size:, count:] = np.eye(len(matrix) - size)
        normal = columns.T @ matrix @ columns
        normal[np.arange(3, count), np.arange(3, count)] += DEPARTURE_STD**-2
        solve = (np.linalg.inv(normal) @ columns.T)[1:count]
        return Estimator(solve @ spread, solve @ right, solve @ matrix @ solve.T)


@dataclass(frozen=True)
class Operators:
    """The estimators of all edges, each at its own geometry; rows are contrast, shift and departures."""

    constant: FloatArray  # (edges, rows): of the profile's mean, 1/2
    odd: FloatArray  # (edges, rows, nodes)
    even: FloatArray
    profile: FloatArray  # (edges, rows, distances): of any change of the profile at `distance`
    distance: FloatArray
    offset: FloatArray  # (edges,): the dark side's light, of the contrast
    shade: FloatArray  # (edges, distances): the illumination, which is in the operators

    def report(self, otf: ComplexArray, frequency: FloatArray, change: FloatArray | None = None) -> FloatArray:
        """What is reported, (edges, rows), of the model's transfer functions (edges, nodes); `change` of the profile (edges, distances)
        beside them."""
        rows = self.constant + (self.odd @ np.real(otf)[..., None])[..., 0]
        if np.any(np.imag(otf)):
            rows = rows + (self.even @ (np.imag(otf) / frequency)[..., None])[..., 0]
        if change is not None:
            rows = rows + (self.profile @ change[..., None])[..., 0]
        return np.asarray(rows)


@lru_cache(maxsize=4)
def profile_interpolation(reach_px: float) -> tuple[FloatArray, FloatArray, sparse.csr_array]:
    """Distances of the fine and of the coarse grid, and the cubic interpolation (fine, coarse) between them."""
    count = int(np.ceil(reach_px / GRID_PX)) + 1
    coarse = GRID_PX * np.arange(-count, count + 1, dtype=float)
    ratio = round(GRID_PX / FINE_PX)
    fine = FINE_PX * np.arange(-(count - 2) * ratio, (count - 2) * ratio + 1, dtype=float)
    place = (fine - coarse[0]) / GRID_PX
    left = np.floor(place + 1e-9).astype(int)
    t = place - left
    weights = np.stack(
        [0.5 * t * (-1 + t * (2 - t)), 1 + 0.5 * t * t * (-5 + 3 * t), 0.5 * t * (1 + t * (4 - 3 * t)), 0.5 * t * t * (t - 1)], axis=1
    )  # fmt: skip
    index = left[:, None] + np.array([-1, 0, 1, 2])
    rows = np.repeat(np.arange(len(fine)), 4)
    return fine, coarse, sparse.csr_array((weights.ravel(), (rows, index.ravel())), shape=(len(fine), len(coarse)))


def spread_operator(geometry: EdgeGeometry, reach_px: float) -> FloatArray:
    """(k + g, coarse distances): from a profile to the right side of an edge's normal equations."""
    fine, _, between = profile_interpolation(reach_px)
    distance = np.asarray(geometry.distance_px, float)
    weight = _shared_out(distance, np.asarray(geometry.weight, float), fine)
    used = np.flatnonzero(weight)
    table = np.zeros((geometry.spline.size + len(geometry.gradients), len(fine)))
    table[: geometry.spline.size, used] = (geometry.spline.design(fine[used]).T * weight[used]).toarray()
    for k, row in enumerate(geometry.gradients):
        table[geometry.spline.size + k] = _shared_out(distance, np.asarray(row * geometry.weight, float), fine)
    return np.asarray(table @ between)


def departure_shapes(quadrature: Quadrature, top: float) -> tuple[FloatArray, FloatArray]:
    """(nodes of the quadrature, numbers): transfer functions that are 1 at one of the frequencies measured and 0 at the others,
    real and imaginary, cubic between; nil at no frequency and well beyond the highest."""
    f = quadrature.frequency
    tables = []
    for at, still in ((REAL_AT, np.zeros(1)), (IMAGINARY_AT, np.array([0.0, 0.5 * STILL, STILL]))):
        knots = np.concatenate([still, at, [1.25, 1.6]]) * top
        cardinal = CubicSpline(knots, np.eye(len(knots))[:, len(still) : -2], bc_type="natural")
        tables.append(np.where((f < knots[-1])[:, None], cardinal(np.minimum(f, knots[-1])), 0.0))
    return tables[0], tables[1]


def _shared_out(distance: FloatArray, amount: FloatArray, grid: FloatArray) -> FloatArray:
    """Amounts at any distances laid on an even grid, each on its two neighbours: sums over them are linear between grid points."""
    place = (distance - grid[0]) / FINE_PX
    left = place.astype(int)
    right_part = amount * (place - left)
    return np.asarray(np.bincount(left, amount - right_part, len(grid)) + np.bincount(left + 1, right_part, len(grid)))


def relative_covariance(covariance: FloatArray, rows: FloatArray) -> FloatArray:
    """Covariance of departures relative to the contrast, of what was reported."""
    departure = rows[2:] / rows[0]
    jacobian = (
        np.concatenate([-departure[:, None], np.zeros((len(departure), 1)), np.eye(len(departure))], axis=1) / rows[0]
    )
    return np.asarray(jacobian @ covariance @ jacobian.T)
