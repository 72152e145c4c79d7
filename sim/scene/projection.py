"""Projection of a ray to the frame: an ideal plane, its distortion, and the camera matrix.

A ray (X, Y, Z) is in the frame of the camera: x right, y down, z forward. With R its length, rho = hypot(X, Y) and
theta = atan2(rho, Z), its angle from the axis, the ideal plane is one of

    pinhole                 (x, y) = (X, Y) / Z                       radius tan theta
    equidistant             (x, y) = (X, Y) theta / rho               radius theta (OpenCV's fisheye)
    splined_stereographic   (x, y) = (X, Y) 2 / (R + Z)               radius 2 tan (theta / 2) (D. Kogan, mrcal)

The distortion follows, with r2 = x^2 + y^2, and p1 = p2 = 0 in the equidistant projection:

    xd = x g(r2) + 2 p1 x y + p2 (r2 + 2 x^2)          yd = y g(r2) + p1 (r2 + 2 y^2) + 2 p2 x y
    pinhole                 g = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    equidistant             g = 1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4
    splined_stereographic   g = 1 + sum_j s_j B_j(r2 / r_end^2)

B_j: cubic B-splines on four equal intervals of 0..1, clamped, without the one that isn't 0 at 0; r_end: the radius at
the angle `spline_angle_deg`. So g is 1 on the axis in each projection, and the focal length is the slope there. mrcal
splines the plane in two dimensions; here the radial part is a spline, and what isn't radial is p1 and p2.

Then u = fx xd + cx, v = fy yd + cy, px; (0, 0) is the centre of the top-left pixel. Intrinsics are one vector (12,) in
the order of `Projection.names`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.camera import Geometry, ProjectionKind
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

Array = NDArray[np.floating[Any]]
COUNT = 12  # intrinsics of any projection; a projection that has fewer leaves the others at 0
CAMERA = ("fx", "fy", "cx", "cy")
#: Coefficients by their places 4.. in the vector of intrinsics; an empty name: not used.
_COEFFICIENTS: dict[ProjectionKind, tuple[str, ...]] = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "", "", "k3", "k4", "", ""),
    "splined_stereographic": ("s1", "s2", "p1", "p2", "s3", "s4", "s5", "s6"),
}
TANGENTIAL = (6, 7)  # places of p1 and p2
RADIAL = (4, 5, 8, 9, 10, 11)  # places of the radial coefficients
INTERVALS = 4  # of the spline
#: Angle up to which the fisheye projections are used: at 180 deg a point is a circle.
WIDEST_DEG = 170.0
NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-9  # of the radius of the plane


@dataclass(frozen=True)
class Projection:
    """A kind of projection. `spline_angle_deg`: angle from the axis at which a spline ends; None without one."""

    kind: ProjectionKind = "pinhole"
    spline_angle_deg: float | None = None

    def __post_init__(self) -> None:
        if (self.kind == "splined_stereographic") != (self.spline_angle_deg is not None):
            raise ValueError(
                f"spline_angle_deg is {self.spline_angle_deg} of a {self.kind} projection: a splined projection states "
                "the angle at which its spline ends, and no other does"
            )

    @classmethod
    def of(cls, geometry: Geometry) -> Projection:
        """Return the projection that a camera's geometry states."""
        return cls(geometry.projection, geometry.spline_angle_deg)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names (12,) of the intrinsics; empty where one isn't used."""
        return (*CAMERA, *_COEFFICIENTS[self.kind])

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Return the names of the distortion coefficients, in the order in which results state them."""
        return tuple(name for name in _COEFFICIENTS[self.kind] if name)

    @property
    def _places(self) -> list[int]:
        """Return the places of `coefficients` in the vector of intrinsics."""
        return [self.names.index(name) for name in self.coefficients]

    def intrinsics(self, camera_matrix: ArrayLike, distortion: Sequence[float] = ()) -> FloatArray:
        """Return the vector (12,) of a camera matrix (3, 3) and the first of the `coefficients`."""
        if len(distortion) > len(self.coefficients):
            raise ValueError(
                f"distortion has {len(distortion)} coefficients, and the {self.kind} projection takes "
                f"{' '.join(self.coefficients)}: fit with those"
            )
        matrix, intrinsics = np.asarray(camera_matrix, float), np.zeros(COUNT)
        intrinsics[:4] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        intrinsics[self._places[: len(distortion)]] = distortion
        return intrinsics

    def distortion(self, intrinsics: Array) -> FloatArray:
        """Return the distortion coefficients; of a pinhole five, or eight where the denominator of g is used."""
        coefficients = np.asarray(intrinsics, float)[self._places]
        return coefficients[:5] if self.kind == "pinhole" and not np.any(coefficients[5:]) else coefficients

    @cached_property
    def _spline(self) -> BSpline:
        """Return the B-splines of g over r2 / r_end^2."""
        from scipy.interpolate import BSpline  # here: the library takes a while to load

        knots = np.concatenate([np.zeros(4), np.arange(1, INTERVALS) / INTERVALS, np.ones(4)])
        return BSpline(knots, np.eye(INTERVALS + 3)[:, 1:], 3)

    @property
    def _square_end(self) -> float:
        """Return r_end^2."""
        assert self.spline_angle_deg is not None
        return float(2.0 * np.tan(np.deg2rad(self.spline_angle_deg) / 2.0)) ** 2

    def sees(self, points: Array) -> NDArray[np.bool_]:
        """Tell which points (n, 3) the projection is defined for: before a pinhole; up to 170 deg off a fisheye's
        axis.
        """
        if self.kind == "pinhole":
            return np.asarray(points[:, 2] > 0.0)
        return np.asarray(points[:, 2] > np.cos(np.deg2rad(WIDEST_DEG)) * np.linalg.norm(points, axis=1))

    def plane(self, points: Array) -> tuple[FloatArray, FloatArray]:
        """Return where points (n, 3) are in the ideal plane: x and y (n,)."""
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        if self.kind == "pinhole":
            return x / z, y / z
        if self.kind == "equidistant":
            scale = _angle_over_rho(np.hypot(x, y), z)
            return x * scale, y * scale
        scale = 2.0 / (np.linalg.norm(points, axis=1) + z)
        return x * scale, y * scale

    def _plane_jacobian(self, points: Array) -> FloatArray:
        """Return the Jacobian (n, 2, 3) of `plane`."""
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        rho2 = x * x + y * y
        if self.kind == "pinhole":
            scale, by_rho, by_z = 1.0 / z, np.zeros_like(z), -1.0 / z**2
        elif self.kind == "equidistant":
            rho = np.sqrt(rho2)
            square = rho2 + z * z
            scale = _angle_over_rho(rho, z)
            with np.errstate(divide="ignore", invalid="ignore"):
                by_rho = np.where(rho < 1e-4 * np.abs(z), -2.0 / (3.0 * z**3), (z / square - scale) / rho2)
            by_z = -1.0 / square
        else:
            length = np.sqrt(rho2 + z * z)
            scale = 2.0 / (length + z)
            by_rho, by_z = -0.5 * scale**2 / length, -scale / length
        # (x, y) scale(rho, z): `by_rho` is the derivative of the scale by rho, over rho
        jacobian = np.empty((len(points), 2, 3))
        jacobian[:, 0, 0], jacobian[:, 1, 1] = scale + x * x * by_rho, scale + y * y * by_rho
        jacobian[:, 0, 1] = jacobian[:, 1, 0] = x * y * by_rho
        jacobian[:, 0, 2], jacobian[:, 1, 2] = x * by_z, y * by_z
        return jacobian

    def rays(self, x: Array, y: Array) -> FloatArray:
        """Return the rays (n, 3) of length 1 to places (n,) in the ideal plane; NaN beyond the sphere."""
        r2 = x * x + y * y
        if self.kind == "pinhole":
            return np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(1.0 + r2)[..., None]
        if self.kind == "equidistant":
            angle = np.sqrt(r2)
            across = np.where(angle < np.pi, np.sinc(angle / np.pi), np.nan)
            return np.stack([x * across, y * across, np.where(angle < np.pi, np.cos(angle), np.nan)], axis=-1)
        below = 1.0 + 0.25 * r2
        return np.stack([x / below, y / below, (2.0 - below) / below], axis=-1)

    def _radial(self, r2: Array, k: Array) -> tuple[FloatArray, FloatArray]:
        """Return g and dg/dr2 at r2. `k` (8,): coefficients, places 4.. of the intrinsics."""
        if self.kind == "pinhole":
            above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
            below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
            g = above / below
            by_above = k[0] + r2 * (2.0 * k[1] + 3.0 * r2 * k[4])
            return g, (by_above - g * (k[5] + r2 * (2.0 * k[6] + 3.0 * r2 * k[7]))) / below
        if self.kind == "equidistant":
            slope = k[0] + r2 * (2.0 * k[1] + r2 * (3.0 * k[4] + 4.0 * r2 * k[5]))
            return 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * (k[4] + r2 * k[5]))), slope
        weights = k[[place - 4 for place in RADIAL]]
        at = np.minimum(r2 / self._square_end, 1.0)
        return 1.0 + self._radial_terms(r2, k) @ weights, self._spline(at, 1) @ weights / self._square_end

    def _radial_terms(self, r2: Array, k: Array) -> FloatArray:
        """Return dg by each of the six radial coefficients (n, 6), 0 where one isn't used."""
        derivatives = np.zeros((*r2.shape, 6))
        if self.kind == "pinhole":
            g = self._radial(r2, k)[0]
            below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
            for power in (1, 2, 3):
                derivatives[..., power - 1] = r2**power / below
                derivatives[..., power + 2] = -g * r2**power / below
        elif self.kind == "equidistant":
            for power in (1, 2, 3, 4):
                derivatives[..., power - 1] = r2**power
        else:
            at = r2 / self._square_end
            end = np.minimum(at, 1.0)  # beyond its end the spline goes on as a straight line
            derivatives[...] = self._spline(end) + self._spline(end, 1) * (at - end)[..., None]
        return derivatives

    def distort(self, x: Array, y: Array, k: Array) -> tuple[FloatArray, FloatArray]:
        """Return where the distortion moves places (n,) of the ideal plane to. `k` (8,): places 4.. of the
        intrinsics.
        """
        xd, yd, *_ = self._distort(x, y, k)
        return xd, yd

    def _distort(self, x: Array, y: Array, k: Array) -> tuple[FloatArray, ...]:
        """Return xd, yd, and dxd/dx, dxd/dy (= dyd/dx), dyd/dy."""
        r2 = x * x + y * y
        g, slope = self._radial(r2, k)
        p1, p2 = k[2], k[3]
        return (
            x * g + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * g + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            g + 2.0 * (x * x * slope + p1 * y + 3.0 * p2 * x),
            2.0 * (x * y * slope + p1 * x + p2 * y),
            g + 2.0 * (y * y * slope + 3.0 * p1 * y + p2 * x),
        )

    def undistort(self, xd: Array, yd: Array, k: Array) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Return the inverse of `distort` by Newton's method, and where it is one: a distortion that folds maps two
        rays to one pixel, and the valid one has a positive Jacobian.
        """
        x, y = np.array(xd, float), np.array(yd, float)
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                at_x, at_y, xx, cross, yy = self._distort(x, y, k)
                determinant = xx * yy - cross * cross
                miss_x, miss_y = at_x - xd, at_y - yd
                x = x - (yy * miss_x - cross * miss_y) / determinant
                y = y - (xx * miss_y - cross * miss_x) / determinant
                if max(np.max(np.abs(miss_x), initial=0.0), np.max(np.abs(miss_y), initial=0.0)) < 1e-13:
                    break
            at_x, at_y, xx, cross, yy = self._distort(x, y, k)
            valid = (np.hypot(at_x - xd, at_y - yd) < NEWTON_TOLERANCE) & (xx * yy - cross * cross > 0) & (xx > 0)
        return x, y, valid

    def project(self, points: Array, intrinsics: Array) -> FloatArray:
        """Project points (n, 3) in the frame of the camera to px (n, 2)."""
        xd, yd = self.distort(*self.plane(points), intrinsics[4:])
        return np.column_stack([intrinsics[0] * xd + intrinsics[2], intrinsics[1] * yd + intrinsics[3]])

    def project_with_jacobian(self, points: Array, intrinsics: Array) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Project points (n, 3) to px (n, 2). Returns these and their Jacobians by the point (n, 2, 3) and by the
        intrinsics (n, 2, 12).
        """
        focal, k = intrinsics[:2], intrinsics[4:]
        x, y = self.plane(points)
        xd, yd, xx, cross, yy = self._distort(x, y, k)
        inner = np.empty((len(points), 2, 2))
        inner[:, 0, 0], inner[:, 0, 1], inner[:, 1, 0], inner[:, 1, 1] = xx, cross, cross, yy
        by_point = focal[:, None] * (inner @ self._plane_jacobian(points))
        by_camera = np.zeros((len(points), 2, COUNT))
        by_camera[:, 0, 0], by_camera[:, 1, 1] = xd, yd
        by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
        r2 = x * x + y * y
        terms = self._radial_terms(r2, k)
        by_camera[:, 0, RADIAL] = focal[0] * x[:, None] * terms
        by_camera[:, 1, RADIAL] = focal[1] * y[:, None] * terms
        if self.kind != "equidistant":
            by_camera[:, 0, 6], by_camera[:, 0, 7] = focal[0] * 2.0 * x * y, focal[0] * (r2 + 2.0 * x * x)
            by_camera[:, 1, 6], by_camera[:, 1, 7] = focal[1] * (r2 + 2.0 * y * y), focal[1] * 2.0 * x * y
        return np.column_stack([focal[0] * xd + intrinsics[2], focal[1] * yd + intrinsics[3]]), by_point, by_camera

    def unproject(self, image: Array, intrinsics: Array) -> FloatArray:
        """Find the rays (n, 3) of length 1 of px (n, 2); NaN where the projection has no inverse."""
        x, y, valid = self.undistort(
            (image[:, 0] - intrinsics[2]) / intrinsics[0], (image[:, 1] - intrinsics[3]) / intrinsics[1], intrinsics[4:]
        )
        return self.rays(np.where(valid, x, np.nan), np.where(valid, y, np.nan))


PINHOLE, EQUIDISTANT = Projection("pinhole"), Projection("equidistant")


def _angle_over_rho(rho: Array, z: Array) -> FloatArray:
    """Return theta / rho, with theta = atan2(rho, z); on the axis 1 / z."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(rho < 1e-6 * np.abs(z), 1.0 / z, np.arctan2(rho, z) / rho))
