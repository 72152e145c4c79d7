"""The slanted-edge estimator of the diagnosis, as a linear operator on the values of an edge's pixels.

`lab.fit.mtf` locates the edge, measures its noise, and sets up the normal equations of the spline that describes its
edge spread function (ESF). From these, `Estimator` estimates by weighted least squares how the optical transfer
function (OTF) departs from the baseline's at a few frequencies. `Operators` applies the same estimator to a model: OTF
-> ESF (`Quadrature`) -> right side of the normal equations -> reported numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import CubicSpline

from lab.measure.edge_mtf import ROUGHNESS_SHARE, EdgeGeometry
from sim.spectrum import FloatArray

ComplexArray = NDArray[np.complex128]
#: Frequencies at which the OTF's real and imaginary parts are measured, as shares of the highest one. The imaginary
#: part is taken as 0 up to `STILL`, as a phase in proportion to frequency only moves the edge.
REAL_AT = np.array([0.04, 0.09, 0.15, 0.22, 0.30, 0.39, 0.49, 0.60, 0.72, 0.86, 1.0])
IMAGINARY_AT = np.array([0.28, 0.42, 0.57, 0.72, 0.86, 1.0])
STILL = 0.14
#: Prior standard deviation of a departure of the OTF: so wide that it matters only where samples tell nothing.
DEPARTURE_STD = 0.5
GRID_PX, FINE_PX = 0.05, 0.0125  # steps of the grids of distances from the edge: of profiles, and of the pixels' values


@dataclass(frozen=True)
class Quadrature:
    """The ESF as a weighted sum of the OTF H at nodes f_k.

    ESF(d) = 1/2 + integral over f > 0 of [Re H sin(2 pi f d) + Im H cos(2 pi f d)] / (pi f) df
           = 1/2 + sum over k of Re H(f_k) odd[k](d) + (Im H(f_k) / f_k) even[k](d)

    with H interpolated by piecewise polynomials. The tables are at the distances d = 0, `GRID_PX`, 2 `GRID_PX`, ...
    """

    frequency: FloatArray  # (nodes,), cy/px
    odd: FloatArray  # (nodes, distances)
    even: FloatArray  # (nodes, distances)

    @staticmethod
    def of(highest: float, reach_px: float) -> Quadrature:
        """For frequencies up to `highest` (cy/px) and distances up to `reach_px`.

        Pieces are 1/4 cy/px wide below 1 cy/px, 1/2 below 2, and 1 above, with 8, 6 and 6 Gauss-Legendre nodes. A
        double image 3 px away is integrated to 1e-4.
        """
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
    """Lagrange polynomials of the nodes (1 at one node, 0 at the others) at `at`, (nodes, at)."""
    basis = np.ones((len(nodes), len(at)))
    for k, node in enumerate(nodes):
        for other in np.delete(nodes, k):
            basis[k] *= (at - other) / (node - other)
    return basis


@dataclass(frozen=True)
class Estimator:
    """Weighted least squares of how an edge's profile departs from the baseline's, linear in the pixels' values.

    profile = level + contrast x (baseline + shift x slope + sum of departures x shapes) + gradients of the illumination

    A shape is the change of the profile by a unit change of the OTF at one frequency. The rows of the result are
    contrast, then contrast x shift, and contrast x departures.
    """

    rows: FloatArray  # (rows, distances): the operator on a profile
    value: FloatArray  # (rows,): estimate from the recording
    covariance: FloatArray  # (rows, rows): of `value`

    @staticmethod
    def of(geometry: EdgeGeometry, spread: FloatArray, shapes: FloatArray) -> Estimator:
        """The estimator at an edge's geometry. `spread` (k + g, distances): takes a profile to the right side of the
        normal equations of k spline and g gradient coefficients (`spread_operator`). `shapes` (j, distances): level,
        contrast, slope, departures."""
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
    """The estimators of all edges as operators on OTFs, each at its own geometry; rows as in `Estimator`."""

    constant: FloatArray  # (edges, rows): by the constant part of the profile
    odd: FloatArray  # (edges, rows, nodes): on the OTF's real part
    even: FloatArray  # (edges, rows, nodes): on the OTF's imaginary part over frequency
    profile: FloatArray  # (edges, rows, distances): on any other change of the profile
    distance: FloatArray  # (distances,), px
    offset: FloatArray  # (edges,): level of the dark side over the contrast
    shade: FloatArray  # (edges, distances): relative illumination, which the operators contain

    def report(self, otf: ComplexArray, frequency: FloatArray, change: FloatArray | None = None) -> FloatArray:
        """The estimates (edges, rows) for a model's OTFs (edges, nodes), at the quadrature's `frequency`, and a further
        `change` of its profiles (edges, distances)."""
        rows = self.constant + (self.odd @ np.real(otf)[..., None])[..., 0]
        if np.any(np.imag(otf)):
            rows = rows + (self.even @ (np.imag(otf) / frequency)[..., None])[..., 0]
        if change is not None:
            rows = rows + (self.profile @ change[..., None])[..., 0]
        return np.asarray(rows)


@lru_cache(maxsize=4)
def profile_interpolation(reach_px: float) -> tuple[FloatArray, FloatArray, sparse.csr_array]:
    """Distances of the fine and of the coarse grid, px, and the cubic interpolation matrix (fine, coarse)."""
    count = int(np.ceil(reach_px / GRID_PX)) + 1
    coarse = GRID_PX * np.arange(-count, count + 1, dtype=float)
    ratio = round(GRID_PX / FINE_PX)
    fine = FINE_PX * np.arange(-(count - 2) * ratio, (count - 2) * ratio + 1, dtype=float)
    place = (fine - coarse[0]) / GRID_PX
    left = np.floor(place + 1e-9).astype(int)
    t = place - left
    weights = np.stack(
        [0.5 * t * (-1 + t * (2 - t)), 1 + 0.5 * t * t * (-5 + 3 * t), 0.5 * t * (1 + t * (4 - 3 * t)),
        0.5 * t * t * (t - 1)], axis=1
    )  # fmt: skip
    index = left[:, None] + np.array([-1, 0, 1, 2])
    rows = np.repeat(np.arange(len(fine)), 4)
    return fine, coarse, sparse.csr_array((weights.ravel(), (rows, index.ravel())), shape=(len(fine), len(coarse)))


def spread_operator(geometry: EdgeGeometry, reach_px: float) -> FloatArray:
    """Operator (k + g, coarse distances) that takes a profile to the right side of an edge's normal equations: k spline
    and g gradient coefficients."""
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
    """Cubic splines that are 1 at one of the measured frequencies and 0 at the others, at the quadrature's nodes:
    (nodes, real parts) and (nodes, imaginary parts). All are 0 at frequency 0 and from 1.25 `top` on; `top` is the
    highest measured frequency, cy/px."""
    f = quadrature.frequency
    tables = []
    for at, still in ((REAL_AT, np.zeros(1)), (IMAGINARY_AT, np.array([0.0, 0.5 * STILL, STILL]))):
        knots = np.concatenate([still, at, [1.25, 1.6]]) * top
        cardinal = CubicSpline(knots, np.eye(len(knots))[:, len(still) : -2], bc_type="natural")
        tables.append(np.where((f < knots[-1])[:, None], cardinal(np.minimum(f, knots[-1])), 0.0))
    return tables[0], tables[1]


def _shared_out(distance: FloatArray, amount: FloatArray, grid: FloatArray) -> FloatArray:
    """Sums (grid,) of amounts at any distances, each shared between the two nearest points of a regular grid as in
    linear interpolation."""
    place = (distance - grid[0]) / FINE_PX
    left = place.astype(int)
    right_part = amount * (place - left)
    return np.asarray(np.bincount(left, amount - right_part, len(grid)) + np.bincount(left + 1, right_part, len(grid)))


def relative_covariance(covariance: FloatArray, rows: FloatArray) -> FloatArray:
    """Covariance of the departures over the contrast, to first order, from an estimate's `rows` and their
    `covariance`."""
    departure = rows[2:] / rows[0]
    jacobian = (
        np.concatenate([-departure[:, None], np.zeros((len(departure), 1)), np.eye(len(departure))], axis=1) / rows[0]
    )
    return np.asarray(jacobian @ covariance @ jacobian.T)
