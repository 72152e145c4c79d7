"""The optical transfer function (OTF) of an edge at a few frequencies, read from its summary, with the covariance of
its noise and the operator that gives the same numbers for any other profile.

Weighted least squares of how a profile departs from the recorded one:

profile = level + contrast x (recorded + shift x slope + sum of departures x shapes) + gradients of the illumination

A shape is the change of the profile by a unit change of the OTF at one frequency. The recorded profile is that of the
summary, and its transfer function is what departures add to. The estimate is linear in the pixels' values but for its
division by the contrast, so that a prediction goes through it exactly. What the estimator leaves out of a recording, it
leaves out of the prediction, too. No prior of the line spread enters: the covariance is that of the noise alone.

A gradient of the illumination across the edge is free where the edge adds light. What it does to the dark side depends
on how much of the dark codes is light, which only a black level tells. The prediction adds it (`predicted`), from the
gradient on the light side by which the recording departs from the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from lab.observables.edges.finding import ACROSS
from lab.observables.edges.mtf import optical_transfer, read_mtf
from lab.observables.edges.profile import ROUGHNESS_SHARE, EdgeSummary
from lab.observables.edges.quadrature import Quadrature
from sim.spectrum import FloatArray

#: Frequencies at which the OTF's real and imaginary parts are measured, as shares of the highest one. The imaginary
#: part is taken as 0 up to `STILL`, as a phase in proportion to frequency only moves the edge.
REAL_AT = np.array([0.04, 0.09, 0.15, 0.22, 0.30, 0.39, 0.49, 0.60, 0.72, 0.86, 1.0])
IMAGINARY_AT = np.array([0.28, 0.42, 0.57, 0.72, 0.86, 1.0])
STILL = 0.14
#: Shapes fade out up to this share of the highest frequency.
SHAPES_END = 1.6
#: Prior standard deviation of a departure of the OTF: so wide that it matters only where samples tell nothing.
DEPARTURE_STD = 0.5
#: Bounds and step of the highest measured frequency, cy/px. It ends where the MTF of three quarters of the edges stays
#: below `SEEN_STD` of its standard deviations, or below `LEAST_MTF`.
LEAST_HIGHEST, MOST_HIGHEST, HIGHEST_STEP = 0.2, 1.15, 0.05
SEEN_STD, LEAST_MTF = 4.0, 0.005


@dataclass(frozen=True)
class EdgeTransfer:
    """The OTF of one edge: real parts at `REAL_AT`, then imaginary parts at `IMAGINARY_AT`, of the highest frequency.

    The estimator's rows are the contrast, then contrast x shift, contrast x departures, and contrast x relative
    gradient of the illumination across the edge, per px.
    """

    operator: FloatArray  # (rows, distances): from a profile at the summary's `grid_px` to the rows
    recorded: FloatArray  # (rows,)
    reference: FloatArray  # (numbers,): of the recorded profile
    covariance: FloatArray  # (numbers + 1, numbers + 1): of the noise of the numbers and of the gradient
    rounding: FloatArray  # (waves, numbers): changes by rounding to whole codes, one standard deviation each
    by_slope: FloatArray  # (numbers,): changes by a slope of the profile of the contrast per px

    @property
    def value(self) -> FloatArray:
        """Return the numbers."""
        return self._numbers(self.recorded)

    @property
    def shift_px(self) -> float:
        """Return the shift of the recorded profile against itself by the estimator, px: nearly 0."""
        return float(self.recorded[1] / self.recorded[0])

    def _numbers(self, rows: FloatArray) -> FloatArray:
        """Return the numbers of the estimator's `rows`."""
        return np.asarray(rows[2:-1] / rows[0] + self.reference)

    def predicted(self, rows: FloatArray, dark_share: float) -> FloatArray:
        """Return the numbers for the `rows` of a model's profile whose dark side has light, `dark_share` of the
        contrast: with the gradient of that light by which the recording departs from the model.
        """
        departs = self.recorded[-1] / self.recorded[0] - rows[-1] / rows[0]
        return np.asarray(self._numbers(rows) + dark_share * departs * self.by_slope)

    def covariance_of(self, dark_share: float) -> FloatArray:
        """Return the covariance (numbers, numbers) of the numbers about those of `predicted`."""
        change = np.concatenate([np.eye(len(self.by_slope)), -dark_share * self.by_slope[:, None]], axis=1)
        return np.asarray(change @ self.covariance @ change.T)


def highest_frequency(edges: Sequence[EdgeSummary]) -> float:
    """Return the frequency, cy/px, up to which the OTF of the edges is measured: where they still show contrast."""
    grid = HIGHEST_STEP * np.arange(1.0, round(MOST_HIGHEST / HIGHEST_STEP) + 1)
    last = []
    for edge in edges:
        found = read_mtf(edge, grid)
        shows = np.abs(found.otf) > np.maximum(SEEN_STD * found.mtf_std, LEAST_MTF)
        last.append(float(grid[shows].max(initial=LEAST_HIGHEST)))
    return float(np.quantile(last, 0.75, method="higher"))


def departure_shapes(highest: float, reach_px: float) -> FloatArray:
    """Return the changes of a profile (numbers, distances), at `GRID_PX` on both sides up to `reach_px`, by unit
    changes of the OTF at the measured frequencies: cubic splines that are 1 at one of them, 0 at the others, at
    frequency 0 and from 1.25 `highest` on.
    """
    quadrature = Quadrature.of(SHAPES_END * highest, reach_px)
    f = quadrature.frequency
    odd, even = quadrature.both_sides()
    shapes = []
    for at, still, table in (
        (REAL_AT, np.zeros(1), odd),
        (IMAGINARY_AT, np.array([0.0, 0.5 * STILL, STILL]), even / f[:, None]),
    ):
        knots = np.concatenate([still, at, [1.25, SHAPES_END]]) * highest
        cardinal = CubicSpline(knots, np.eye(len(knots))[:, len(still) : -2], bc_type="natural")
        shapes.append(cardinal(f).T @ table)
    return np.concatenate(shapes)


def read_transfer(edge: EdgeSummary, highest: float, shapes: FloatArray) -> EdgeTransfer:
    """Read the OTF of an edge up to `highest` (cy/px) with the `shapes` of `departure_shapes`, which reach at least as
    far as the edge's samples.
    """
    spline, esf = edge.spline, edge.esf
    size, grid = spline.size, edge.grid_px
    matrix, right = edge.gram[:-1, :-1], edge.gram[:-1, -1]
    bridged = matrix[:size, :size] + spline.roughness(ROUGHNESS_SHARE * np.trace(matrix[:size, :size]) / size)
    step = esf[-1] - esf[0]
    beyond = (shapes.shape[1] - len(grid)) // 2
    changes = np.concatenate([spline.derivative(esf, grid)[None] / step, shapes[:, beyond : beyond + len(grid)]])
    count = 2 + len(changes)
    columns = np.zeros((len(matrix), count + len(matrix) - size))
    columns[:size, 0] = 1.0
    columns[:size, 1] = (esf - esf[0]) / step
    columns[:size, 2:count] = np.linalg.solve(bridged, edge.right_side[:size] @ changes.T)
    columns[size:, count:] = np.eye(len(matrix) - size)
    normal = columns.T @ matrix @ columns
    normal[np.arange(3, count), np.arange(3, count)] += DEPARTURE_STD**-2
    used = slice(0, count + min(len(matrix) - size, ACROSS + 1))  # not the gradient of the dark side
    solve = np.zeros((count, len(matrix)))
    solve[:-1] = (np.linalg.inv(normal[used, used]) @ columns[:, used].T)[1:count]
    if edge.has_gradient_across:
        solve[-1] = (np.linalg.inv(normal) @ columns.T)[count + ACROSS] / 100.0
    recorded = solve @ right

    departure = recorded[2:] / recorded[0]
    jacobian = np.concatenate([-departure[:, None], np.zeros((len(departure), 1)), np.eye(len(departure))], axis=1)
    by_right = jacobian @ solve / recorded[0]
    split = len(REAL_AT)
    otf = optical_transfer(spline, esf, measured_at(highest))
    return EdgeTransfer(
        operator=np.asarray(solve @ edge.right_side),
        recorded=recorded,
        reference=np.concatenate([otf[:split].real, otf[split:].imag]),
        covariance=by_right @ matrix @ by_right.T,
        rounding=edge.rounding @ by_right[:-1].T,
        by_slope=by_right[:-1] @ (edge.right_side @ grid),
    )


def measured_at(highest: float) -> FloatArray:
    """Return the frequencies of the numbers, cy/px."""
    return np.concatenate([REAL_AT, IMAGINARY_AT]) * highest
