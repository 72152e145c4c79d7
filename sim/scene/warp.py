"""Mapping of a flat pattern to the camera: a homography, then the lens's distortion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from sim.camera import Geometry
from sim.scene.projection import Projection
from sim.spectrum import FloatArray

#: Sine of the angle to the plane of the pattern below which a ray doesn't meet it, and where it is put then, cells.
PARALLEL, BEYOND_CELLS = 1e-9, 1e9

Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Warp:
    """Pattern coordinates (u to the right, v down, in cells; cell [i, j] covers u = j..j+1, v = i..i+1) to camera px.

    `homography` maps (u, v, 1) to a pinhole's (x, y, w): x = col, y = row after division by w. With `geometry`, the
    lens's projection follows: the camera matrix is inverted, and the ray projected (`sim.scene.projection`).
    """

    homography: Matrix
    geometry: Geometry | None = None

    @classmethod
    def of(cls, homography: ArrayLike, geometry: Geometry | None = None) -> Self:
        """Return a warp from a (3, 3) array."""
        a = np.asarray(homography, float)
        if a.shape != (3, 3) or not np.all(np.isfinite(a)) or abs(np.linalg.det(a)) == 0.0:
            raise ValueError(
                f"homography {a.tolist()} has to be a finite, invertible 3 x 3 matrix: check the four points"
            )
        rows = [(float(r[0]), float(r[1]), float(r[2])) for r in a]
        return cls((rows[0], rows[1], rows[2]), geometry)

    @classmethod
    def from_corners(cls, width: float, height: float, corners: ArrayLike, geometry: Geometry | None = None) -> Self:
        """Return the homography that maps the pattern's corners (0, 0), (width, 0), (width, height), (0, height) to the
        four `corners`, [row, col] in undistorted camera px."""
        source = np.array([(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)])
        target = np.asarray(corners, float)[:, ::-1]
        system, right = np.zeros((8, 8)), np.zeros(8)
        for i, ((u, v), (x, y)) in enumerate(zip(source, target, strict=True)):
            system[2 * i] = [u, v, 1, 0, 0, 0, -u * x, -v * x]
            system[2 * i + 1] = [0, 0, 0, u, v, 1, -u * y, -v * y]
            right[2 * i : 2 * i + 2] = x, y
        return cls.of(np.append(np.linalg.solve(system, right), 1.0).reshape(3, 3), geometry)

    @property
    def is_straight(self) -> bool:
        """Return whether there is no distortion."""
        return self.geometry is None or self.geometry.is_ideal

    @property
    def is_upright(self) -> bool:
        """Return whether rows and columns of the pattern are rows and columns of the camera, in the same order."""
        (a, b, _), (c, d, _), (e, f, w) = self.homography
        return self.is_straight and b == c == e == f == 0.0 and a * w > 0 and d * w > 0

    def to_camera(self, u: ArrayLike, v: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Camera (row, col) in px of pattern points."""
        col, row = _project(np.asarray(self.homography), np.asarray(u, float), np.asarray(v, float))
        if self.geometry is not None:
            col, row = distort(col, row, self.geometry)
        return row, col

    def to_pattern(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Pattern (u, v) of camera points, the inverse of `to_camera` (to 1e-9 px)."""
        x, y, back = np.asarray(col, float), np.asarray(row, float), np.linalg.inv(np.asarray(self.homography))
        if self.geometry is None:
            return _project(back, x, y)
        return _meet(back, rays(x, y, self.geometry), self.geometry)

    def grid_to_pattern(self, row: FloatArray, col: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pattern (u, v), each (len(row), len(col)), of the grid of ascending `row` and `col`; see `mapper`."""
        return self.mapper((row[0], row[-1]), col)(row)

    def mapper(
        self, rows: tuple[float, float], col: FloatArray
    ) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
        """Return a function from ascending camera `row` (px, within `rows`) to pattern (u, v) on their grid with
        ascending `col`.

        The rays are smooth: they are found on nodes some 8 px apart and interpolated by cubic splines (1e-5 px).
        """
        back = np.linalg.inv(np.asarray(self.homography))
        if self.is_straight:
            return lambda row: _project(back, col[None, :], row[:, None])
        assert self.geometry is not None
        y0, x0 = (np.linspace(low, high, max(8, int((high - low) / 8) + 2)) for low, high in (rows, (col[0], col[-1])))
        nodes = np.nan_to_num(rays(*np.meshgrid(x0, y0), self.geometry), nan=0.0)
        geometry = self.geometry
        parts = [_RowSpline.through(y0, x0, nodes[..., axis], col) for axis in range(3)]
        return lambda row: _meet(back, np.stack([part(row) for part in parts], axis=-1), geometry)


@dataclass(frozen=True)
class _RowSpline:
    """A cubic spline of two variables at given columns, as a spline down the rows: value = B(row) C, B the B-splines of
    `knots`.
    """

    knots: FloatArray
    coefficients: FloatArray

    @classmethod
    def through(cls, row_nodes: FloatArray, col_nodes: FloatArray, values: FloatArray, col: FloatArray) -> Self:
        """Return the spline that takes `values`, (rows, cols), at the nodes, at the columns `col` within them."""
        from scipy.interpolate import make_interp_spline  # here: the library takes a while to load

        across = make_interp_spline(col_nodes, values, k=3, axis=1)(col)
        down = make_interp_spline(row_nodes, across, k=3, axis=0)
        return cls(down.t, np.ascontiguousarray(down.c))

    def __call__(self, row: FloatArray) -> FloatArray:
        """Values (len(row), cols) at ascending rows within the nodes."""
        from scipy.interpolate import BSpline

        basis = BSpline.design_matrix(np.clip(row, self.knots[0], self.knots[-1]), self.knots, 3)
        used = slice(int(basis.indices.min()), int(basis.indices.max()) + 1)  # in a strip of rows, few differ from 0
        return np.asarray(basis[:, used].toarray() @ self.coefficients[used])


def _project(homography: FloatArray, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    h = homography
    w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    return (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w


def _meet(back: FloatArray, rays: FloatArray, geometry: Geometry) -> tuple[FloatArray, FloatArray]:
    """Return the pattern (u, v) that rays (..., 3) meet, with `back` (3, 3) the inverse of the homography.

    A fisheye's ray that doesn't meet the plane of the pattern is put far outside.
    """
    across = rays @ (back @ np.asarray(geometry.camera_matrix, float)).T
    if geometry.projection == "pinhole":
        return across[..., 0] / across[..., 2], across[..., 1] / across[..., 2]
    ahead = across[..., 2] > PARALLEL * np.linalg.norm(across, axis=-1)
    u, v = (np.where(ahead, across[..., k] / np.where(ahead, across[..., 2], 1.0), BEYOND_CELLS) for k in (0, 1))
    return u, v


def distort(x: ArrayLike, y: ArrayLike, geometry: Geometry) -> tuple[FloatArray, FloatArray]:
    """Pinhole px (x = col, y = row) to px of the camera's projection."""
    projection, k = Projection.of(geometry), np.asarray(geometry.camera_matrix, float)
    yn = (np.asarray(y, float) - k[1, 2]) / k[1, 1]
    xn = (np.asarray(x, float) - k[0, 2] - k[0, 1] * yn) / k[0, 0]
    coefficients = projection.intrinsics(k, geometry.distortion)[4:]
    rays = np.stack(np.broadcast_arrays(xn, yn, 1.0), axis=-1)
    xi, yi = projection.plane(rays.reshape(-1, 3))
    xd, yd = (part.reshape(rays.shape[:-1]) for part in projection.distort(xi, yi, coefficients))
    return k[0, 0] * xd + k[0, 1] * yd + k[0, 2], k[1, 1] * yd + k[1, 2]


def rays(x: ArrayLike, y: ArrayLike, geometry: Geometry) -> FloatArray:
    """Return the rays (..., 3) of px (x = col, y = row), of length 1 in front of a fisheye and with z = 1 of a pinhole.

    Where a distortion folds, the ray is one that Newton's method ends at.
    """
    projection, k = Projection.of(geometry), np.asarray(geometry.camera_matrix, float)
    yd = (np.asarray(y, float) - k[1, 2]) / k[1, 1]
    xd = (np.asarray(x, float) - k[0, 2] - k[0, 1] * yd) / k[0, 0]
    xi, yi, _ = projection.undistort(xd, yd, projection.intrinsics(k, geometry.distortion)[4:])
    if projection.kind == "pinhole":
        return np.stack([xi, yi, np.ones_like(xi)], axis=-1)
    return projection.rays(xi, yi)


def undistort(x: ArrayLike, y: ArrayLike, geometry: Geometry) -> tuple[FloatArray, FloatArray]:
    """Return the inverse of `distort`; infinite for a ray of 90 deg or more from the axis, which no pinhole has."""
    k, ray = np.asarray(geometry.camera_matrix, float), rays(x, y, geometry)
    with np.errstate(divide="ignore", invalid="ignore"):
        xn, yn = (np.where(ray[..., 2] > 0.0, ray[..., axis] / ray[..., 2], np.inf) for axis in (0, 1))
    return k[0, 0] * xn + k[0, 1] * yn + k[0, 2], k[1, 1] * yn + k[1, 2]
