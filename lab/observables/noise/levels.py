"""Statistics of the repeats of one level: means, temporal and spatial variances, defective pixels, shading.

One level is all frames of one exposure, light and temperature. Its frames are read once, and no more than one level is
held in memory."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.formats.recording_set import DataSheet
from lab.formats.results import RepeatDrift
from lab.observables.codes.rounding import (
    HIDDEN_DN2,
    QUANTISATION_DN2,
    rounding_std_dn,
    variance_before_rounding,
    variance_rounding_std,
)
from sim.camera import Cfa
from sim.sensor.mosaic import planes, step
from sim.spectrum import FloatArray

# --- frame sums ----------------------------------------------------------------------------------------------------
# Compiled loops over the pixels of a frame: sums by plane, Welford's recursion, spatial sums.


# mypy: disallow-untyped-decorators=False


Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@njit(cache=True)
def plane_sums(frame: NDArray[np.uint16], bad: BoolArray, period: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Sums of a frame (rows, cols) by phase of the mosaic.

    Sums over all pixels and over the good ones (2, phases); the highest code, how often it and 0 come, and less the
    number of bad pixels (4, phases).
    """
    phases = period * period
    sums = np.zeros((2, phases))
    counts = np.zeros((4, phases), np.int64)
    rows, cols = frame.shape
    for i in range(rows):
        for offset in range(period):
            p = (i % period) * period + offset
            total, highest, zeros = np.int64(0), np.int64(0), np.int64(0)
            for j in range(offset, cols, period):
                value = np.int64(frame[i, j])
                total += value
                highest = max(highest, value)
                zeros += value == 0
            sums[0, p] += total
            counts[2, p] += zeros
            if highest > counts[0, p]:
                counts[0, p], counts[1, p] = highest, 0
            if highest == counts[0, p]:
                for j in range(offset, cols, period):
                    counts[1, p] += frame[i, j] == highest
    sums[1] = sums[0]
    if bad.size > 0:
        for i in range(rows):
            for j in range(cols):
                if bad[i, j]:
                    p = (i % period) * period + j % period
                    sums[1, p] -= frame[i, j]
                    counts[3, p] -= 1
    return sums, counts


@njit(cache=True)
def add_frame(
    frame: NDArray[np.uint16],
    mean: Float32Array,
    squares: Float32Array,
    shift: FloatArray,
    bad: BoolArray,
    period: int,
    count: int,
    products: FloatArray,
    pairs: NDArray[np.int64],
) -> None:
    """Add frame number `count` (from 2) to `mean` and `squares`, by Welford's recursion.

    `shift` (phases,): by how much the mean of each phase lies above that of `mean`. `products`, `pairs` (2, phases):
    sums of products of adjacent and of diagonal neighbours, and their numbers.
    """
    rows, cols = frame.shape
    share, inverse = np.float32((count - 1) / count), np.float32(1.0 / count)
    above, row = np.zeros(cols, np.float32), np.zeros(cols, np.float32)
    some_bad = bad.size > 0
    for i in range(rows):
        first = (i % period) * period
        for j in range(cols):
            delta = np.float32(frame[i, j]) - mean[i, j] - np.float32(shift[first + j % period])
            mean[i, j] += delta * inverse
            squares[i, j] += delta * delta * share
            row[j] = np.float32(0.0) if some_bad and bad[i, j] else delta
        # Sums of a row in single precision, of the frame in double: exact to 1e-6
        for offset in range(period):
            here, there = first + offset, first + (offset + 1) % period
            beside = np.float32(0.0)
            for j in range(offset, cols - 1, period):
                beside += row[j] * row[j + 1]
            number = len(range(offset, cols - 1, period))
            for p in (here, there):
                products[0, p] += share * beside
                pairs[0, p] += number
            if i == 0:
                continue
            upper = ((i - 1) % period) * period
            straight = np.float32(0.0)
            for j in range(offset, cols, period):
                straight += row[j] * above[j]
            for p in (here, upper + offset):
                products[0, p] += share * straight
                pairs[0, p] += len(range(offset, cols, period))
            left, right = np.float32(0.0), np.float32(0.0)
            for j in range(offset, cols - 1, period):
                right += row[j] * above[j + 1]
                left += row[j + 1] * above[j]
            other = upper + (offset + 1) % period
            for p in (here, other):
                products[1, p] += share * right
                pairs[1, p] += number
            for p in (there, upper + offset):
                products[1, p] += share * left
                pairs[1, p] += number
        above, row = row, above


@njit(cache=True)
def pattern_sums(
    image: Float32Array, surface: Float32Array, bad: BoolArray, mean: float, good_mean: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Spatial sums of an image.

    Of image - mean over all pixels: sum of squares, sums of rows and of columns. Of image - good_mean over good
    pixels: sum and sum of squares. Of image - surface over good pixels: sum, sum of squares, largest modulus, sums of
    rows and of columns.
    """
    rows, cols = image.shape
    sums = np.zeros(6)
    row_sums, col_sums, row_rest, col_rest = np.zeros(rows), np.zeros(cols), np.zeros(rows), np.zeros(cols)
    some_bad = bad.size > 0
    for i in range(rows):
        for j in range(cols):
            value = float(image[i, j])
            from_mean = value - mean
            sums[0] += from_mean * from_mean
            row_sums[i] += from_mean
            col_sums[j] += from_mean
            if some_bad and bad[i, j]:
                continue
            good = value - good_mean
            sums[1] += good
            sums[2] += good * good
            rest = value - surface[i, j]
            sums[3] += rest
            sums[4] += rest * rest
            sums[5] = max(sums[5], abs(rest))
            row_rest[i] += rest
            col_rest[j] += rest
    return sums, row_sums, col_sums, row_rest, col_rest


# --- shading -------------------------------------------------------------------------------------------------------
# The smooth surface of an image: shading of the lens and the lamp.


SHADING_DEGREE = 6
#: Share of saturation that the levels of a figure at saturation have to reach: a parabola through less says nothing of
#: what it does beyond twice their range.
LEAST_REACH = 0.5
F = TypeVar("F", bound=np.floating[Any])


def shading_factors(image: NDArray[F], degree: int) -> tuple[NDArray[F], NDArray[F]]:
    """Return the smooth surface as a product (rows, k) @ (k, cols), in the precision of the image. Least squares on
    means of blocks.
    """
    rows, cols = image.shape
    # At most 32 blocks an axis; each degree needs three
    counts = [int(np.clip(size // 8, 1, 32)) for size in (rows, cols)]
    block = rows // counts[0], cols // counts[1]
    inner = image[: counts[0] * block[0], : counts[1] * block[1]]
    means = inner.reshape(counts[0], block[0], counts[1], block[1]).mean(axis=(1, 3), dtype=float)
    full, small = [], []
    for size, count, width in zip((rows, cols), counts, block, strict=True):
        order = surface_degree(size, degree)
        at = 2.0 * (np.arange(size) + 0.5) / size - 1.0
        basis = np.polynomial.legendre.legvander(at, order)
        full.append(basis)
        small.append(basis[: count * width].reshape(count, width, -1).mean(axis=1))
    coefficients = np.linalg.pinv(small[0]) @ means @ np.linalg.pinv(small[1]).T
    return (full[0] @ coefficients).astype(image.dtype), np.ascontiguousarray(full[1].T.astype(image.dtype))


def surface_degree(size: int, degree: int = SHADING_DEGREE) -> int:
    """Degree of the surface along an axis of `size` pixels; small images have too few blocks for the full one."""
    return min(degree, int(np.clip(size // 8, 1, 32)) // 3)


def shading(image: NDArray[F], degree: int = SHADING_DEGREE) -> NDArray[F]:
    """Smooth surface of an image (rows, cols): the polynomial of `degree` in rows and in columns nearest to its block
    means.
    """
    down, across = shading_factors(image, degree)
    return down @ across


# --- defective pixels ----------------------------------------------------------------------------------------------
# Pixels that stand out of their plane.


DEFECT_SIGMA = 8.0  # a normal pattern of a million pixels doesn't reach that far


def defective_pixels(image: NDArray[np.floating[Any]], cfa: Cfa, step_dn: float = 1.0) -> BoolArray:
    """Pixels of a mean frame (rows, cols) beyond 8 robust standard deviations of their plane, as a mask (rows, cols).

    Robust: 1.4826 times the median modulus of the residual from the smooth surface. `step_dn`: step of the codes.
    """
    bad = np.zeros(image.shape, bool)
    for name, plane in planes(image, cfa).items():
        rest = plane - np.median(plane)
        # Most pixels of a rounded plane may be equal: the least scale is then that of rounding, else a tenth of a step
        least = step_dn * (np.sqrt(QUANTISATION_DN2) if not np.median(np.abs(rest)) > 0 else 0.1)
        for _ in range(2):  # glow widens the first scale, hot pixels distort the first surface
            limit = DEFECT_SIGMA * max(1.4826 * float(np.median(np.abs(rest))), least)
            rest = rest - shading(np.clip(rest, -limit, limit))
        limit = DEFECT_SIGMA * max(1.4826 * float(np.median(np.abs(rest))), least)
        planes(bad, cfa)[name][...] = np.abs(rest) > limit
    return bad


# --- level statistics ----------------------------------------------------------------------------------------------
# Statistics of the repeats of one level: means, temporal and spatial variances, covariances of neighbours.
#
# Repeats are read one after the other and not kept. Each frame is compared with the mean of those before it, plane by
# plane, after the difference of the means of the two planes has been subtracted (Welford's recursion). A lamp that
# drifts between repeats is then no temporal noise. This costs one of the N degrees of freedom of a plane for each
# frame, as in EMVA 1288 with two frames.


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
    over its pixels, temporal share included.
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


@dataclass(frozen=True)
class MeasuredLevel:
    """One level of light (0: dark): its setting, and the statistics of its planes by name.

    `light` is proportional to the photons among the levels of the same `lamp`. `captures`: ids of the frames.
    `light_std`, `light_calibration_std`: relative standard uncertainties of `light`, of its own, and common to all
    levels of the lamp. `temperature_c`: to a degree where it groups darks; `sensor_c`: the frames' mean, not rounded.
    `drift`: of the repeats over time, where there is one.
    """

    exposure_s: float
    light: float
    lamp: Hashable
    plane: dict[str, PlaneStatistics]
    temperature_c: float | None = None
    captures: tuple[str, ...] = ()
    light_std: float = 0.0
    light_calibration_std: float = 0.0
    sensor_c: float | None = None
    drift: RepeatDrift | None = None

    @property
    def repeats(self) -> int:
        """Number of frames."""
        return next(iter(self.plane.values())).repeats

    @property
    def drift_std_dn(self) -> float:
        """Standard uncertainty of the mean by a drift of the repeats, DN."""
        return 0.0 if self.drift is None else self.drift.level_dn_std

    def scatter(self, frame_means: FloatArray) -> tuple[FloatArray, int]:
        """Return frame means (n,) less their mean and less the drift in proportion, and the degrees of freedom."""
        rest = frame_means - frame_means.mean()
        if self.drift is None or set(self.captures) != set(self.drift.captures):
            return rest, rest.size - 1
        at = dict(zip(self.drift.captures, self.drift.curve_dn, strict=True))
        curve = np.array([at[name] for name in self.captures])
        curve -= curve.mean()
        return rest - float(curve @ rest) / float(curve @ curve) * curve, rest.size - 2


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
        add_frame(frame, self.mean, self.squares, shift, bad, self.period, self.count, self.products, self.pairs)

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
        )

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


# --- recorded levels -----------------------------------------------------------------------------------------------
# The levels of one camera that the noise fit works on: flats, and the darks of one temperature.


BLACK_CLIPPED_SHARE = 1e-3  # of pixels at 0 in a dark, above which darks are clipped


@dataclass(frozen=True)
class Remarks:
    """What a fit has to say beside its figures, each sentence once."""

    sentences: list[str] = field(default_factory=list)

    def add(self, sentence: str) -> None:
        """Add a sentence where it isn't there yet."""
        if sentence not in self.sentences:
            self.sentences.append(sentence)


@dataclass(frozen=True)
class RecordedLevels:
    """Levels of one camera at one gain.

    `names`: planes of the mosaic. `flats`: in ascending light. `all_darks`: in ascending exposure; `darks`: those of
    `temperature_c`, none where they are clipped at 0 (`black_clipped`). `defects`: pixels that were left out of all
    levels.
    """

    camera: DataSheet
    gain_db: float
    defects: int
    names: tuple[str, ...]
    flats: tuple[MeasuredLevel, ...]
    all_darks: tuple[MeasuredLevel, ...]
    darks: tuple[MeasuredLevel, ...]
    temperature_c: float | None
    black_clipped: bool

    @property
    def white_dn(self) -> float:
        """Highest code."""
        return self.camera.saturation_dn

    @property
    def step_dn(self) -> float:
        """Step of the codes, DN."""
        return self.flats[0].plane[self.names[0]].step_dn

    @property
    def quantisation_dn2(self) -> float:
        """Variance of rounding to the step of the codes, DN^2."""
        return QUANTISATION_DN2 * self.step_dn**2

    @property
    def hidden_dn2(self) -> float:
        """Variance, DN^2, below which rounding to the step of the codes hides the noise."""
        return HIDDEN_DN2 * self.step_dn**2

    @classmethod
    def of(
        cls,
        darks: Sequence[MeasuredLevel],
        flats: Sequence[MeasuredLevel],
        camera: DataSheet,
        gain_db: float,
        defects: int,
        names: tuple[str, ...],
        remarks: Remarks,
    ) -> RecordedLevels:
        """Choose the darks of the temperature at which most flats (or else most darks) were taken."""
        bright = tuple(sorted(flats, key=lambda level: (level.light, level.exposure_s)))
        every = tuple(sorted(darks, key=lambda level: level.exposure_s))
        temperature = usual_c([level.temperature_c for level in every], [level.temperature_c for level in bright])
        own = tuple(level for level in every if level.temperature_c == temperature)
        clipped = any(level.plane[name].zero_share > BLACK_CLIPPED_SHARE for level in own for name in names)
        if clipped:
            remarks.add(
                "dark frames are clipped at 0 DN: black level, read noise, dark current and DSNU aren't determined; "
                "raise the black level"
            )
        return cls(camera, gain_db, defects, names, bright, every, () if clipped else own, temperature, clipped)


def usual_c(dark_c: Sequence[float | None], bright_c: Sequence[float | None]) -> float | None:
    """Return the temperature, to a degree, of the darks (`dark_c`) at which most bright captures were taken, or else
    most darks."""
    present = [rounded_c(one) for one in dark_c]
    wanted = [rounded_c(one) for one in bright_c]
    return max(dict.fromkeys(present), key=lambda t: (wanted.count(t), present.count(t)), default=None)


#: Darks within this of the usual temperature belong to it: their dark current differs by 10 % (it doubles in some 7 C),
#: and a sensor that stands between two whole degrees keeps all of its darks.
NEAR_C = 1.0


def darks_near(darks: Sequence[DarkCapture], bright: Sequence[Capture]) -> list[DarkCapture]:
    """Return the darks of the temperature at which most of the captures `bright` were taken, or else most darks; all
    where none is stated."""
    usual = usual_c([dark.temperature_c for dark in darks], [capture.temperature_c for capture in bright])
    if usual is None:
        return [dark for dark in darks if dark.temperature_c is None]
    return [dark for dark in darks if dark.temperature_c is not None and abs(dark.temperature_c - usual) <= NEAR_C]


def rounded_c(temperature_c: float | None) -> float | None:
    """Return a temperature to a degree; levels of one degree belong together."""
    return None if temperature_c is None else float(round(temperature_c))
