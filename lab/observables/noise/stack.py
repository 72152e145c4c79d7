"""Statistics of the repeats of one level: means, temporal and spatial variances, covariances of neighbours.

Repeats are read one after the other and not kept. Each frame is compared with the mean of those before it, plane by
plane, after the difference of the means of the two planes has been subtracted (Welford's recursion). A lamp that
drifts between repeats is then no temporal noise. This costs one of the N degrees of freedom of a plane for each
frame, as in EMVA 1288 with two frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.observables.codes.rounding import (
    HIDDEN_DN2,
    QUANTISATION_DN2,
    rounding_std_dn,
    variance_before_rounding,
    variance_rounding_std,
)
from lab.observables.noise.frame_sums import BoolArray, Float32Array, add_frame, pattern_sums, plane_sums
from lab.observables.noise.surface import DEFECT_SIGMA, SHADING_DEGREE, shading_factors, surface_degree
from sim.camera import Cfa
from sim.sensor.mosaic import planes, step
from sim.spectrum import FloatArray


@dataclass(frozen=True)
class SpatialVariance:
    """Variance over the pixels of a mean frame (rows x cols; EMVA: M x N), split; DN^2, less the temporal share.

    `rows`, `columns`, `pixels`: variances of what the pixels of a row share, of a column, and of single pixels; they
    sum to `total`. Standard deviations: of normal patterns.
    """

    total: float
    total_std: float
    rows: float
    rows_std: float
    columns: float
    columns_std: float
    pixels: float
    pixels_std: float

    def mean_std(self, shape: tuple[int, int]) -> float:
        """Standard deviation of the mean of a plane as a figure of the camera, DN: its rows, columns and pixels are a
        sample.

        Parts that are not significant count as 0; noise would add up otherwise.
        """
        m, n = shape
        rows = self.rows if self.rows > 2.0 * self.rows_std else 0.0
        columns = self.columns if self.columns > 2.0 * self.columns_std else 0.0
        return float(np.sqrt(rows / m + columns / n + max(self.pixels, 0.0) / (m * n)))

    @classmethod
    def split(
        cls, total: float, rows_mean: float, columns_mean: float, shape: tuple[int, int], share: float, share_std: float
    ) -> SpatialVariance:
        """Split by EMVA 1288 release 4.0.

        `total`, `rows_mean`, `columns_mean`: measured variances of the mean frame, of the averages of its rows
        (s^2_rav) and of its columns (s^2_cav); `share`: the temporal variance over L in `total`.

            s^2 = s_row^2 + s_col^2 + s_pixel^2
            s_rav^2 = s_row^2 + s_pixel^2 / N,   s_cav^2 = s_col^2 + s_pixel^2 / M
            s_pixel^2 = M N / (M N - M - N) (s^2 - s_cav^2 - s_rav^2)
        """
        m, n = shape
        pixels = m * n / (m * n - m - n) * (total - columns_mean - rows_mean)
        rows, columns = rows_mean - pixels / n, columns_mean - pixels / m
        pixels_std = max(pixels, 0.0) * np.sqrt(2.0 / (m * n))
        rows_std, columns_std = rows_mean * np.sqrt(2.0 / (m - 1)), columns_mean * np.sqrt(2.0 / (n - 1))
        # The uncertainty is that of a sample of rows, columns and pixels; the average is exact for these pixels
        return cls(
            total=total - share,
            total_std=float(np.sqrt(pixels_std**2 + rows_std**2 + columns_std**2 + share_std**2)),
            rows=rows,
            rows_std=float(rows_std),
            columns=columns,
            columns_std=float(columns_std),
            pixels=pixels - share,
            pixels_std=float(np.hypot(pixels_std, share_std)),
        )


@dataclass(frozen=True)
class PlaneStatistics:
    """One plane of the mosaic over the repeats of one level; DN and DN^2, of pixels that aren't defects.

    `temporal_variance` is NaN with a single frame. `spatial_variance` is that of the mean frame less the temporal
    share; `pattern_variance` the same after the shading has been subtracted, `pattern` its split. `every_pixel` and
    `temporal_variance_of_all` include defects, as in EMVA 1288. `adjacent_covariance`, `diagonal_covariance`: temporal
    covariance of a pixel with one of its four neighbours along rows and columns, and across corners, on the mosaic (of
    any plane). `shading_rows`, `shading_columns`: mean of the smooth surface over the first and the last tenth of the
    rows (columns), over `mean`, dark included. `shading_span`: highest less lowest value of that surface, DN, and its
    standard deviation by the pixels' scatter. `step_dn`: step of the codes. `mean_frame_variance`: of the mean frame
    over its pixels, temporal share included. `row_variance`: the part of `temporal_variance` that the
    pixels of a row share.
    """

    pixels: int
    mean: float
    frame_means: tuple[float, ...]
    temporal_variance: float
    temporal_variance_std: float
    spatial_variance: float
    spatial_variance_std: float
    pattern_variance: float
    pattern_variance_std: float
    defects: int
    clipped_share: float
    piled_share: float
    zero_share: float
    highest: float
    shape: tuple[int, int] = (0, 0)
    mean_of_all: float = np.nan
    temporal_variance_of_all: float = np.nan
    every_pixel: SpatialVariance | None = None
    pattern: SpatialVariance | None = None
    adjacent_covariance: float = np.nan
    diagonal_covariance: float = np.nan
    covariance_std: float = np.nan
    shading_rows: tuple[float, float] = (1.0, 1.0)
    shading_columns: tuple[float, float] = (1.0, 1.0)
    shading_span: tuple[float, float] = (0.0, 0.0)
    step_dn: float = 1.0
    mean_frame_variance: float = 0.0
    row_variance: float = 0.0

    @property
    def repeats(self) -> int:
        """Number of frames."""
        return len(self.frame_means)

    @property
    def mean_std(self) -> float:
        """Standard deviation of `mean` by temporal noise and by rounding, DN."""
        variance = self.temporal_variance / self.repeats
        if self.temporal_variance < HIDDEN_DN2 * self.step_dn**2:  # each pixel's mean is rounded: repeats don't help
            variance = max(variance, QUANTISATION_DN2 * self.step_dn**2)
        return float(np.hypot(np.sqrt(variance / self.pixels), self.mean_rounding_std))

    @property
    def spread(self) -> float:
        """Variance of single values over pixels and repeats, DN^2; it dithers the rounding."""
        if not np.isfinite(self.temporal_variance):  # of one frame, whose values hold noise and pattern
            return self.mean_frame_variance
        return max(self.spatial_variance, 0.0) + self.temporal_variance

    @property
    def mean_rounding_std(self) -> float:
        """Standard deviation of `mean` by rounding, DN, which no averaging reduces."""
        return float(rounding_std_dn(variance_before_rounding(self.spread, self.step_dn), self.step_dn))


_NONE = np.zeros((0, 0), bool)


class Stack:
    """Repeats of one level, read one after the other.

    `mean`, `squares` (rows, cols): mean and sum of squared deviations over the repeats, by pixel. `bad` (rows, cols):
    pixels to leave out. `step_dn`: step of the codes.
    """

    def __init__(self, cfa: Cfa, white_dn: float, bad: BoolArray | None, step_dn: float = 1.0) -> None:
        self.cfa, self.white_dn, self.step_dn = cfa, white_dn, step_dn
        self.period = step(cfa)
        self.bad = bad if bad is not None and bad.any() else None
        self.count = 0
        self.mean: Float32Array | None = None
        self.squares: Float32Array | None = None
        self._phases: dict[str, int] = {}
        self._frame_means: list[FloatArray] = []
        self._means_of_all: list[FloatArray] = []
        self._shares: list[FloatArray] = []

    def add(self, frame: NDArray[np.integer[Any]]) -> None:
        """Add a frame (rows, cols), DN."""
        frame = np.ascontiguousarray(frame, np.uint16)
        bad = _NONE if self.bad is None else self.bad
        sums, counts = plane_sums(frame, bad, self.period)
        if self.mean is None:
            rows, cols = frame.shape
            labels = np.arange(self.period**2).reshape(self.period, self.period)
            tiled = np.tile(labels, (rows // self.period + 1, cols // self.period + 1))[:rows, :cols]
            self._phases = {name: int(plane[0, 0]) for name, plane in planes(tiled, self.cfa).items()}
            self._sizes = np.array(
                [tiled[p // self.period :: self.period, p % self.period :: self.period].size for p in labels.ravel()]
            )
            self._good = self._sizes + counts[3]
            self.products = np.zeros((2, self.period**2))
            self.pairs = np.zeros((2, self.period**2), np.int64)
            self.row_squares = np.zeros(self.period**2)
        means = sums[1] / np.maximum(self._good, 1)
        highest, top, zero = counts[0].astype(float), counts[1] / self._sizes, counts[2] / self._sizes
        self._shares.append(
            np.stack(
                [
                    np.where(highest >= self.white_dn, top, 0.0),
                    top,
                    np.where(means < 50 * self.step_dn, zero, 0.0),
                    highest,
                ]
            )
        )
        self._frame_means.append(means)
        self._means_of_all.append(sums[0] / self._sizes)
        self.count += 1
        if self.mean is None:
            self.mean = frame.astype(np.float32)
            return
        if self.squares is None:
            self.squares = np.zeros_like(self.mean)
        # The mean frame keeps the plane means of the first: only its pattern is used
        shift = means - self._frame_means[0]
        add_frame(
            frame,
            self.mean,
            self.squares,
            shift,
            bad,
            self.period,
            self.count,
            self.products,
            self.pairs,
            self.row_squares,
        )

    def image(self) -> Float32Array:
        """Mean of the repeats (rows, cols), DN."""
        if self.mean is None:
            raise ValueError("a level has no frames: give one at least")
        image = self.mean.copy()
        for name, plane in planes(image, self.cfa).items():
            means = [frame[self._phases[name]] for frame in self._frame_means]
            np.add(plane, np.float32(np.mean(means) - means[0]), out=plane)
        return image

    def statistics(self) -> dict[str, PlaneStatistics]:
        """Statistics by plane."""
        if self.mean is None:
            raise ValueError("a level has no frames: give one at least")
        squares = None if self.squares is None else self._temporal()
        return {name: self._plane(name, squares) for name in self._phases}

    def _temporal(self) -> dict[str, tuple[float, float, float]]:
        """By plane: temporal variance of the good pixels, its standard deviation, and the variance of all pixels."""
        assert self.squares is not None
        freedom, found = self.count - 1, {}
        for name, plane in planes(self.squares, self.cfa).items():
            by_row = plane.sum(axis=1, dtype=np.float64) / freedom
            every = float(by_row.sum())
            good = np.full(len(by_row), float(plane.shape[1]))
            if self.bad is not None:
                bad = planes(self.bad, self.cfa)[name]
                good -= bad.sum(axis=1)
                by_row = by_row - np.where(bad, plane, np.float32(0)).sum(axis=1, dtype=np.float64) / freedom
            pixels = int(good.sum())
            # The mean of each frame takes one degree of freedom of the plane
            variance = float(by_row.sum()) / max(pixels - 1, 1)
            found[name] = (
                variance,
                _mean_variance_std(by_row / np.maximum(good, 1.0), variance, pixels, self.count),
                every / max(plane.size - 1, 1),
            )
        return found

    def _plane(self, name: str, temporal: dict[str, tuple[float, float, float]] | None) -> PlaneStatistics:
        assert self.mean is not None
        phase, repeats = self._phases[name], self.count
        image = planes(self.mean, self.cfa)[name]
        bad = _NONE if self.bad is None else planes(self.bad, self.cfa)[name]
        pixels, rows, cols = int(self._good[phase]), *image.shape
        variance, variance_std, of_all = temporal[name] if temporal is not None else (np.nan, np.nan, np.nan)
        down, across = shading_factors(image, SHADING_DEGREE)
        surface = down @ across
        first = max(self._frame_means[0][phase], 1e-9), self._means_of_all[0][phase]
        sums, row_sums, col_sums, row_rest, col_rest = pattern_sums(
            image, surface, bad, float(first[1]), float(first[0])
        )
        share, share_std = variance / repeats, variance_std / repeats
        every = SpatialVariance.split(
            (sums[0] - row_sums.sum() ** 2 / image.size) / (image.size - 1),
            float(np.var(row_sums / cols)),
            float(np.var(col_sums / rows)),
            (rows, cols),
            of_all / repeats,
            share_std,
        )
        spatial = (sums[2] - sums[1] ** 2 / pixels) / (pixels - 1)
        if np.isfinite(variance):
            variance_std = float(np.hypot(variance_std, variance_rounding_std(variance, spatial - share, self.step_dn)))
        pattern, outliers = (sums[4] - sums[3] ** 2 / pixels) / (pixels - 1), 0
        good = (cols, rows) if bad.size == 0 else (cols - bad.sum(axis=1), rows - bad.sum(axis=0))
        rows_mean, cols_mean = (
            float(np.var(rest / np.maximum(number, 1))) for rest, number in zip((row_rest, col_rest), good, strict=True)
        )
        # The largest of 10^5 normal pixels is at 5 standard deviations: look for outliers only beyond
        if pattern > 0 and sums[5] > DEFECT_SIGMA * np.sqrt(pattern):
            rest = image - surface
            values = rest[~bad] if bad.size else rest.ravel()
            limit = DEFECT_SIGMA * 1.4826 * float(np.median(np.abs(values)))
            inside = np.abs(rest) <= limit
            if bad.size:
                inside &= ~bad
            outliers = pixels - int(np.count_nonzero(inside))
            pattern = float(np.var(rest[inside], dtype=np.float64, ddof=1))
            clean = np.where(inside, rest, np.float32(0))
            rows_mean = float(np.var(clean.sum(axis=1, dtype=float) / np.maximum(inside.sum(axis=1), 1)))
            cols_mean = float(np.var(clean.sum(axis=0, dtype=float) / np.maximum(inside.sum(axis=0), 1)))
        # The surface takes degrees of freedom from the averages of rows and of columns and from the pixels
        order = surface_degree(rows) + 1, surface_degree(cols) + 1
        more = rows_mean * order[0] / (rows - order[0]), cols_mean * order[1] / (cols - order[1])
        pattern = pattern * (pixels - 1) / max(pixels - order[0] * order[1], 1) + sum(more)
        rows_mean, cols_mean = rows_mean + more[0], cols_mean + more[1]
        split = SpatialVariance.split(pattern, rows_mean, cols_mean, (rows, cols), share, share_std)
        shares = np.mean([share[:3, phase] for share in self._shares], axis=0)
        adjacent, diagonal, covariance_std = self._covariances(phase, variance)
        tenth = max(rows // 10, 1), max(cols // 10, 1)
        # In a corner, where it is least certain, a surface of k x l Legendre polynomials has the leverage k^2 l^2 / n:
        # the sum of 2 i + 1 over an axis is the square of their number. The span is the difference of two such values.
        corner_std = order[0] * order[1] * float(np.sqrt(max(pattern, 0.0) / pixels))
        span = float(surface.max() - surface.min()), float(np.sqrt(2.0)) * corner_std
        return PlaneStatistics(
            pixels=pixels,
            mean=float(np.mean([means[phase] for means in self._frame_means])),
            frame_means=tuple(float(means[phase]) for means in self._frame_means),
            temporal_variance=variance,
            temporal_variance_std=variance_std,
            spatial_variance=spatial - share,
            spatial_variance_std=every.total_std,
            pattern_variance=pattern - share,
            pattern_variance_std=split.total_std,
            defects=image.size - pixels + outliers,
            clipped_share=float(shares[0]),
            piled_share=float(shares[1]),
            zero_share=float(shares[2]),
            highest=max(float(share[3, phase]) for share in self._shares),
            shape=(rows, cols),
            mean_of_all=float(np.mean([means[phase] for means in self._means_of_all])),
            temporal_variance_of_all=of_all,
            every_pixel=every,
            pattern=split,
            adjacent_covariance=adjacent,
            diagonal_covariance=diagonal,
            covariance_std=covariance_std,
            shading_rows=(float(surface[: tenth[0]].mean() / first[0]), float(surface[-tenth[0] :].mean() / first[0])),
            shading_columns=(
                float(surface[:, : tenth[1]].mean() / first[0]),
                float(surface[:, -tenth[1] :].mean() / first[0]),
            ),
            shading_span=span,
            step_dn=self.step_dn,
            mean_frame_variance=spatial,
            row_variance=self._row_variance(phase, variance, rows, cols),
        )

    def _row_variance(self, phase: int, variance: float, rows: int, cols: int) -> float:
        """Return the variance that pixels of a row share: the mean square of the sum of n pixels is n s^2 + n^2 r^2,
        with s^2 of single pixels, r^2 shared, and s^2 + r^2 the temporal `variance`."""
        if self.count < 2:
            return 0.0
        return float((self.row_squares[phase] / rows / (self.count - 1) - variance) / (cols - 1))

    def _covariances(self, phase: int, variance: float) -> tuple[float, float, float]:
        """Adjacent and diagonal temporal covariance of the pixels of a phase, and the standard deviation of either."""
        freedom = self.count - 1
        if freedom < 1:
            return np.nan, np.nan, np.nan
        # `pairs` counts each pair once a frame; in a MONO sensor from both its ends, which see the same noise
        pairs = self.pairs[:, phase] / freedom
        adjacent, diagonal = self.products[:, phase] / freedom / np.maximum(pairs, 1)
        independent = pairs[0] / (2.0 if self.period == 1 else 1.0)
        if self.period == 1:  # the subtracted mean of a frame includes the neighbours
            adjacent, diagonal = (value + variance / self._good[phase] for value in (adjacent, diagonal))
        return float(adjacent), float(diagonal), float(variance / np.sqrt(max(independent, 1.0) * freedom))


def _mean_variance_std(by_row: FloatArray, variance: float, pixels: int, repeats: int) -> float:
    """Standard deviation of a mean temporal variance: that of normal noise, or by the means of its rows (`by_row`)
    where these differ more.

    Row noise makes the pixels of a row vary together.
    """
    normal = variance * np.sqrt(2.0 / (pixels * (repeats - 1)))
    rows = len(by_row)
    if rows < 32:
        return float(normal)
    # Neighbouring rows have the same shading: their differences are noise
    from_rows = float(np.sqrt(np.mean(np.diff(by_row) ** 2) / 2.0 / rows))
    # This estimate has a relative standard deviation of sqrt(3 / rows) / 2: it is used where it is significantly larger
    return from_rows if from_rows > normal * (1.0 + 2.0 * np.sqrt(3.0 / rows)) else float(normal)


def level_statistics(
    frames: Iterable[NDArray[np.integer[Any]]], cfa: Cfa, white_dn: float, bad: BoolArray | None = None
) -> dict[str, PlaneStatistics]:
    """Statistics of the repeats of one level, by plane (`R`, `G1`, `G2`, `B` or `Y`).

    `frames`: (rows, cols) DN, read one after the other and not kept. `white_dn`: highest code. `bad`: pixels to leave
    out. The temporal variance is the mean over the pixels of the variance over the repeats, after the mean of each
    frame has been subtracted. Source: EMVA 1288 release 4.0.
    """
    stack = Stack(cfa, white_dn, bad)
    for frame in frames:
        stack.add(frame)
    return stack.statistics()
