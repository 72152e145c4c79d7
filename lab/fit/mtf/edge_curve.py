"""The curve of an edge in the frame, and distances from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
EDGE_ORDER = 3  # degree of the polynomial
ORDERS = np.arange(1.0, EDGE_ORDER + 1)  # of its terms beyond the constant


@dataclass(frozen=True)
class EdgeCurve:
    """An edge as a polynomial: across = poly((along - centre) / half_length), px of the full sensor.

    `transposed`: across is the row and along the column, else the reverse. `poly` (EDGE_ORDER + 1,) lowest power
    first. `sign`: +1 where the light side is at larger across, else -1. `along` arguments of the methods are in half
    lengths from the centre.
    """

    transposed: bool
    centre: tuple[float, float]
    half_length: float
    poly: Array
    sign: int

    @property
    def tilt(self) -> float:
        """Slope of the edge at its middle, px across per px along."""
        return float(self.poly[1]) / self.half_length

    @property
    def slope(self) -> Array:
        """Coefficients (EDGE_ORDER,) of the slope of the edge, px across per px along."""
        return self.poly[1:] * ORDERS / self.half_length

    def shifted(self, change: Array) -> EdgeCurve:
        """The edge with `change` (EDGE_ORDER + 1,) added to its coefficients."""
        return EdgeCurve(self.transposed, self.centre, self.half_length, self.poly + change, self.sign)

    def distance(self, along: Array, across: Array) -> tuple[Array, Array, Array]:
        """Signed distance of points from the curve (px, positive on the light side), and the foot of the
        perpendicular.

        `along` (n,) in half lengths and `across` (n,) in px. Returns (distance, foot, slope), each (n,): the foot in
        half lengths along, and the slope of the curve there. Two Newton steps; a straight line in closed form.
        """
        first = self.slope
        second = first[1:] * ORDERS[:-1] / self.half_length
        foot = along
        if not self.poly[2:].any():  # a straight line: in closed form
            gap = across - polynomial_value(along, self.poly)
            slope = np.full_like(along, first[0])
            return (
                self.sign * gap / np.sqrt(1.0 + first[0] ** 2),
                along + gap * first[0] / (1.0 + first[0] ** 2) / self.half_length,
                slope,
            )
        for _ in range(2):
            gap = across - polynomial_value(foot, self.poly)
            slope = polynomial_value(foot, first)
            lag = (foot - along) * self.half_length - gap * slope
            foot = foot - lag / (1.0 + slope * slope - gap * polynomial_value(foot, second)) / self.half_length
        slope = polynomial_value(foot, first)
        gap = across - polynomial_value(foot, self.poly)
        return self.sign * gap * np.sqrt(1.0 + slope * slope), foot, slope


def polynomial_value(x: Array, coefficients: Array) -> Array:
    """Value of a polynomial at `x` (n,); coefficients lowest power first (Horner)."""
    value = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value *= x
        value += c
    return value


def powers(x: Array, order: int) -> Array:
    """(order + 1, n): 1, x, x^2, ..."""
    rows = np.empty((order + 1, len(x)))
    rows[0] = 1.0
    for k in range(order):
        np.multiply(rows[k], x, out=rows[k + 1])
    return rows


def angle_from_vertical_deg(slope: float, transposed: bool) -> float:
    """Angle of an edge of given `slope` (px across per px along) from the vertical.

    Positive where the top turns to the right; -90 < angle <= 90 deg.
    """
    row, col = (slope, 1.0) if transposed else (1.0, slope)
    angle = float(np.degrees(np.arctan2(col, -row)))
    return angle - 180.0 * np.ceil((angle - 90.0) / 180.0)
