"""How a traced lens maps the field: from ideal image points to real ones and back, and smooth functions of the field in
the image.

Lengths are in um from the optical axis, x along columns (right), y along rows (down).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RectBivariateSpline

from sim.optics.table import LensTable
from sim.scene.render import Grid
from sim.spectrum import FloatArray


@dataclass(frozen=True)
class ImageFrame:
    """The pixels of an image: `rows` x `cols` of `pitch_um` with the optical axis at px `axis` [row, col]; the
    light-sensitive part is a centred square that takes `fill_factor` of the area.
    """

    rows: int
    cols: int
    pitch_um: float
    fill_factor: float
    axis: tuple[float, float]

    def um(self, row: FloatArray, col: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(x, y) in um from the axis."""
        return (col - self.axis[1]) * self.pitch_um, (row - self.axis[0]) * self.pitch_um

    def px(self, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(row, col) of points."""
        return y_um / self.pitch_um + self.axis[0], x_um / self.pitch_um + self.axis[1]


class FieldMapping:
    """Distortion of a traced lens: from the ideal image point f tan(theta) to the centre of its point spread window,
    and back.

    A symmetric lens has a function of the radius, any other lens one of the plane. Beyond the table's outermost field
    the function is extrapolated (linearly along the radius, or by the shift at the border); for such points
    `lies_outside` is true.
    """

    def __init__(self, table: LensTable) -> None:
        self.symmetric = table.symmetric
        ideal = table.focal_length_mm * 1e3 * np.tan(np.deg2rad(table.field_deg))
        real = table.chief_mm * 1e3 + table.window_um
        if table.symmetric:
            self._ideal, self._real = ideal[:, 1], real[:, 1]
            # The ratio of the radii is an even function: a spline in the squared radius, from the first height on.
            square = self._ideal[1:] ** 2
            ratio = CubicSpline(square, self._real[1:] / self._ideal[1:])
            dense = np.sqrt(np.linspace(0.0, square[-1], 4001))
            real = dense * ratio(dense**2)
            # Extrapolated linearly, so that the frame's corners have no kink.
            slope = (real[-1] - real[-2]) / (dense[-1] - dense[-2])
            beyond = dense[-1] * np.linspace(1.0, 2.0, 1001)[1:]
            self._dense = np.append(dense, beyond), np.append(real, real[-1] + slope * (beyond - dense[-1]))
            self.reach_um = float(self._ideal[-1])
        else:
            fy, fx = table.grid_shape
            self._y, self._x = ideal[:, 1].reshape(fy, fx)[:, 0], ideal[:, 0].reshape(fy, fx)[0]
            degree_y, degree_x = min(3, fy - 1), min(3, fx - 1)
            self._to_x, self._to_y = (
                RectBivariateSpline(self._y, self._x, real[:, axis].reshape(fy, fx), kx=degree_y, ky=degree_x)
                for axis in (0, 1)
            )

    def real_um(self, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Real image points (um) of ideal ones; arrays broadcast."""
        if self.symmetric:
            return self._scale_to_radius(x_um, y_um, *self._dense)
        x, y = np.broadcast_arrays(x_um, y_um)
        held_x, held_y = np.clip(x, self._x[0], self._x[-1]), np.clip(y, self._y[0], self._y[-1])
        return (
            self._to_x(held_y, held_x, grid=False) + (x - held_x),
            self._to_y(held_y, held_x, grid=False) + (y - held_y),
        )

    def ideal_um(self, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Ideal image points (um) of real ones: the inverse of `real_um`, to 1e-6 um."""
        if self.symmetric:
            return self._scale_to_radius(x_um, y_um, *self._dense[::-1])
        x, y = np.broadcast_arrays(np.asarray(x_um, float), np.asarray(y_um, float))
        ideal_x, ideal_y = x.copy(), y.copy()
        for _ in range(40):
            at_x, at_y = self.real_um(ideal_x, ideal_y)
            ideal_x, ideal_y = ideal_x + (x - at_x), ideal_y + (y - at_y)
            if max(np.max(np.abs(x - at_x), initial=0.0), np.max(np.abs(y - at_y), initial=0.0)) < 1e-6:
                break
        return ideal_x, ideal_y

    def lies_outside(self, x_um: FloatArray, y_um: FloatArray) -> NDArray[np.bool_]:
        """Return whether ideal points lie beyond the table's outermost fields."""
        if self.symmetric:
            return np.asarray(np.hypot(x_um, y_um) > self.reach_um * (1.0 + 1e-9))
        within_x = (x_um >= self._x[0]) & (x_um <= self._x[-1])
        return np.asarray(~(within_x & (y_um >= self._y[0]) & (y_um <= self._y[-1])))

    def heights(self, count: int) -> tuple[FloatArray, FloatArray]:
        """For a symmetric lens: dense image radii (um, ascending), and the fractional index of each among `count`
        refined field heights.
        """
        ideal, real = self._dense
        place = np.interp(ideal, self._ideal, np.linspace(0.0, count - 1.0, self._ideal.size))
        return real, place

    def radial(self, most_um2: float) -> tuple[FloatArray, FloatArray, float]:
        """For a symmetric lens: ratio of real and ideal radius, ratio of areas, and the step (um^2) of the 8192 squared
        ideal radii up to `most_um2` at which both are given.
        """
        ideal, real = self._dense
        square = np.linspace(0.0, most_um2 * 1.001, 8192)
        curve = CubicSpline(ideal[1:] ** 2, real[1:] / ideal[1:])
        ratio = curve(square)
        # d(r ratio)/dr = ratio + 2 r^2 d(ratio)/d(r^2)
        return ratio, ratio * (ratio + 2.0 * square * curve(square, 1)), float(square[1])

    def places(self, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """For any other lens: fractional indices (row, column) of image points in the table's field grid."""
        ideal_x, ideal_y = self.ideal_um(x_um, y_um)
        down = np.interp(ideal_y, self._y, np.arange(self._y.size))
        across = np.interp(ideal_x, self._x, np.arange(self._x.size))
        return down, across

    @staticmethod
    def _scale_to_radius(
        x_um: FloatArray, y_um: FloatArray, radius: FloatArray, becomes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        r = np.hypot(x_um, y_um)
        first = becomes[1] / radius[1]
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(r > radius[1], np.interp(r, radius, becomes) / r, first)
        ratio = np.where(r > radius[-1], becomes[-1] / radius[-1], ratio)
        return ratio * x_um, ratio * y_um


@lru_cache(maxsize=4)
def field_mapping(table: LensTable) -> FieldMapping:
    """Return the mapping of a table, cached."""
    return FieldMapping(table)


def margin_px(table: LensTable, pitch_um: float) -> int:
    """Width (px) of the margin around a frame from which light reaches it: half the table's window and some samples."""
    return int(np.ceil(0.5 * table.psf.shape[-1] * table.sample_pitch_um / pitch_um)) + 4


def source_grid(table: LensTable, frame: ImageFrame, oversample: int, margin_px: int) -> Grid:
    """Ideal grid that covers all that is imaged onto the frame and `margin_px` around it."""
    row = np.array([-margin_px, 0.5 * frame.rows, frame.rows - 1.0 + margin_px])
    col = np.array([-margin_px, 0.5 * frame.cols, frame.cols - 1.0 + margin_px])
    at = np.meshgrid(row, col, indexing="ij")
    ideal_row, ideal_col = frame.px(*field_mapping(table).ideal_um(*frame.um(*at)))
    moved = max(float(np.max(np.abs(ideal_row - at[0]))), float(np.max(np.abs(ideal_col - at[1]))))
    return Grid(frame.rows, frame.cols, oversample, margin_px + int(np.ceil(moved)) + 2)


def exceeds_field(frame: ImageFrame, lens: FieldMapping) -> bool:
    """Return whether the frame's corners lie more than half a pixel beyond the lens's outermost field."""
    row, col = np.array([0.0, 0.0, frame.rows - 1.0, frame.rows - 1.0]), np.array([0.0, frame.cols - 1.0] * 2)
    x, y = lens.ideal_um(*frame.um(row, col))
    shrink = 1.0 - frame.pitch_um / np.maximum(np.hypot(x, y), frame.pitch_um)
    return bool(np.any(lens.lies_outside(x * shrink, y * shrink)))


def illumination(
    table: LensTable, weight: FloatArray, frame: ImageFrame, first: tuple[int, int] = (0, 0), period: int = 1
) -> FloatArray:
    """Image of a uniform field: the sum over wavelengths of weight x relative illumination, at every `period`-th row
    and column from pixel `first` on.

    `weight` (F, W): light by field point and wavelength of the table, filters included.
    """
    lens = field_mapping(table)
    row, col = (np.arange(k, n, period, dtype=float) for k, n in zip(first, (frame.rows, frame.cols), strict=True))
    x, y = frame.um(row[:, None], col[None, :])
    image = over_field(table, np.sum(weight * table.relative_illumination.T, axis=1), x, y)
    if exceeds_field(frame, lens):
        image = np.where(lens.lies_outside(*lens.ideal_um(x, y)), 0.0, image)
    return image


def over_field(table: LensTable, value: FloatArray, x_um: FloatArray, y_um: FloatArray) -> FloatArray:
    """Return a smooth quantity of the table's field points (..., F), interpolated at image points: (..., *points)."""
    return field_function(table, value)(x_um, y_um)


def field_function(table: LensTable, value: FloatArray) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """`over_field` as a function of points: cubic splines over the squared height, or over rows and columns of the
    field grid; constant beyond.
    """
    lens = field_mapping(table)
    if table.symmetric:
        square = (table.focal_length_mm * 1e3 * np.tan(np.deg2rad(table.field_deg[:, 1]))) ** 2
        curve = CubicSpline(square, value, axis=-1)

        def along_radius(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            ideal_x, ideal_y = lens.ideal_um(x_um, y_um)
            return np.asarray(curve(np.minimum(ideal_x**2 + ideal_y**2, square[-1])))

        return along_radius
    fy, fx = table.grid_shape
    splines = [
        RectBivariateSpline(np.arange(fy), np.arange(fx), values.reshape(fy, fx), kx=min(3, fy - 1), ky=min(3, fx - 1))
        for values in value.reshape(-1, fy * fx)
    ]

    def over_plane(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
        places = lens.places(x_um, y_um)
        return np.stack([spline(*places, grid=False) for spline in splines]).reshape(
            *value.shape[:-1], *places[0].shape
        )

    return over_plane
