"""The edge profile that a transfer function makes, by a quadrature over frequency."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lab.observables.edges.profile import GRID_PX
from sim.spectrum import FloatArray


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

    @property
    def distances(self) -> int:
        """Return the number of distances of the grid of both sides."""
        return 2 * self.odd.shape[1] - 1

    def both_sides(self) -> tuple[FloatArray, FloatArray]:
        """Return the tables (nodes, distances) at the distances of both sides, `GRID_PX` apart, ascending."""
        return (
            np.concatenate([-self.odd[:, :0:-1], self.odd], axis=1),
            np.concatenate([self.even[:, :0:-1], self.even], axis=1),
        )


def _lagrange(nodes: FloatArray, at: FloatArray) -> FloatArray:
    """Lagrange polynomials of the nodes (1 at one node, 0 at the others) at `at`, (nodes, at)."""
    basis = np.ones((len(nodes), len(at)))
    for k, node in enumerate(nodes):
        for other in np.delete(nodes, k):
            basis[k] *= (at - other) / (node - other)
    return basis
