"""Compiled real ray tracing through sequential surfaces, with the derivatives of every ray by its position in the
entrance pupil."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.optics.prescription import ASPHERE_TERMS, Prescription
from sim.spectrum import FloatArray

STANDARD, EVEN, ODD, BREAK = 0, 1, 2, 3
NO_APERTURE, CIRCLE, RECTANGLE = 0, 1, 2
ARRIVED, MISSED, REFLECTED, TURNED = 0, 1, 2, 3

#: What became of a ray, in words.
OUTCOMES = {
    ARRIVED: "arrives",
    MISSED: "misses a surface",
    REFLECTED: "is totally reflected",
    TURNED: "turns back",
}

# Places in a surface's row of `Surfaces.shape`.
KIND, CURVATURE, CONIC, TERMS, EVEN_FROM = range(5)
ODD_FROM = EVEN_FROM + ASPHERE_TERMS
ODD_TERMS = ASPHERE_TERMS // 2

# Places in a traced ray's row.
STATUS, SURFACE, X, Y, L, M, N, PATH, CLIP, STOP_X, STOP_Y = range(11)
DL_DX, DL_DY, DM_DX, DM_DY, DS_XX, DS_XY, DS_YX, DS_YY, DX_DX, DX_DY, DY_DX, DY_DY = range(11, 23)
ROW = 23

_ITERATIONS = 60


class Surfaces(NamedTuple):
    """A prescription as arrays for compiled code; lengths in mm."""

    kind: NDArray[np.int64]
    curvature: FloatArray
    conic: FloatArray
    even: FloatArray  # of r^2, r^4, ...
    odd: FloatArray  # of r, r^3, ...
    shape: FloatArray  # (surfaces, SHAPE): all that says where a surface is, in one array that is cheap to hand on
    thickness: FloatArray
    aperture: NDArray[np.int64]
    opening: FloatArray  # half width, half height, x, y
    rotation: FloatArray  # (surfaces, 3, 3): columns are the new axes in the old frame
    decentre: FloatArray
    decentre_last: NDArray[np.bool_]
    stop: int
    stop_radius: float


def compile_surfaces(prescription: Prescription, stop_radius_mm: float, image_shift_mm: float = 0.0) -> Surfaces:
    """Arrays of a prescription; the image surface is a plane, `image_shift_mm` behind where the file has it."""
    surfaces = prescription.surfaces
    count = len(surfaces)
    kinds = {"standard": STANDARD, "even_asphere": EVEN, "odd_asphere": ODD, "coordinate_break": BREAK}
    even, odd = np.zeros((count, ASPHERE_TERMS)), np.zeros((count, ASPHERE_TERMS // 2))
    kind = np.array([kinds[surface.kind] for surface in surfaces])
    aperture = np.zeros(count, np.int64)
    opening = np.ones((count, 4))
    rotation = np.tile(np.eye(3), (count, 1, 1))
    for i, surface in enumerate(surfaces):
        terms = np.zeros(ASPHERE_TERMS)
        terms[: len(surface.coefficients_mm)] = surface.coefficients_mm
        if surface.kind == "odd_asphere":
            odd[i], even[i, : ASPHERE_TERMS // 2] = terms[0::2], terms[1::2]
            if not np.any(odd[i]):
                kind[i] = EVEN
        else:
            even[i] = terms
        if kind[i] == EVEN and not np.any(even[i]):
            kind[i] = STANDARD
        if surface.aperture is not None:
            aperture[i] = CIRCLE if surface.aperture.shape == "circle" else RECTANGLE
            opening[i] = (
                surface.aperture.half_width_mm,
                surface.aperture.half_height_mm,
                *surface.aperture.centre_mm,
            )
        rotation[i] = _rotation(surface.tilt_deg, surface.tilt_first)
    thickness = np.array([surface.thickness_mm for surface in surfaces])
    thickness[-2] += image_shift_mm
    curvature = np.array([surface.curvature_per_mm for surface in surfaces])
    conic = np.array([surface.conic for surface in surfaces])
    kind[-1], curvature[-1] = STANDARD, 0.0
    return Surfaces(
        kind,
        curvature,
        conic,
        even,
        odd,
        _shapes(kind, curvature, conic, even, odd),
        thickness,
        aperture,
        opening,
        rotation,
        np.array([surface.decentre_mm for surface in surfaces]),
        np.array([surface.tilt_first for surface in surfaces]),
        prescription.stop,
        stop_radius_mm,
    )


def _shapes(
    kind: NDArray[np.int64], curvature: FloatArray, conic: FloatArray, even: FloatArray, odd: FloatArray
) -> FloatArray:
    terms = np.array([int(np.max(np.flatnonzero(row), initial=-1)) + 1 for row in even])
    columns = np.stack([kind.astype(float), curvature, conic, terms.astype(float)], axis=1)
    return np.ascontiguousarray(np.concatenate([columns, even, odd], axis=1))


def _rotation(tilt_deg: tuple[float, float, float], reverse: bool) -> FloatArray:
    """Axes of the turned frame in the old one, as columns: Rx Ry Rz, or Rz Ry Rx where the order is reversed."""
    a, b, c = np.deg2rad(tilt_deg)
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    rz = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return np.asarray(rz @ ry @ rx if reverse else rx @ ry @ rz)


def frames(surfaces: Surfaces) -> tuple[FloatArray, FloatArray]:
    """(vertices (surfaces, 3), axes (surfaces, 3, 3)) of every surface's frame in that of the first one before any
    break.
    """
    origin, axes = np.zeros(3), np.eye(3)
    vertices, turned = [], []
    for i in range(len(surfaces.kind)):
        if surfaces.kind[i] == BREAK:
            shift = np.array([*surfaces.decentre[i], 0.0])
            if surfaces.decentre_last[i]:
                axes = axes @ surfaces.rotation[i]
                origin = origin + axes @ shift
            else:
                origin = origin + axes @ shift
                axes = axes @ surfaces.rotation[i]
        vertices.append(origin)
        turned.append(axes)
        origin = origin + axes[:, 2] * surfaces.thickness[i]
    return np.array(vertices), np.array(turned)


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _sag(shape: Any, i: int, u: float) -> Any:
    """Sag at r^2 = u with its first and second derivative by u; the last value is False outside the surface."""
    c, k, kind = shape[i, CURVATURE], shape[i, CONIC], shape[i, KIND]
    root2 = 1.0 - (1.0 + k) * c * c * u
    if root2 <= 0.0:
        return 0.0, 0.0, 0.0, False
    root = np.sqrt(root2)
    s = c * u / (1.0 + root)
    s1 = 0.5 * c / root
    s2 = 0.25 * c * c * c * (1.0 + k) / (root * root2)
    if kind != STANDARD:
        p = 0.0
        p1 = 0.0
        p2 = 0.0
        for j in range(int(shape[i, TERMS]) - 1, -1, -1):
            p2 = p2 * u + 2.0 * p1
            p1 = p1 * u + p
            p = p * u + shape[i, EVEN_FROM + j]
        # p is the polynomial over u: times u, with the product rule.
        s += p * u
        s1 += p + p1 * u
        s2 += 2.0 * p1 + p2 * u
        if kind == ODD:
            r = np.sqrt(max(u, 1e-24))
            for j in range(ODD_TERMS):
                power = 2.0 * j + 1.0
                term = shape[i, ODD_FROM + j] * r**power
                s += term
                s1 += 0.5 * power * term / (r * r)
                s2 += 0.25 * power * (power - 2.0) * term / (r * r * r * r)
    return s, s1, s2, True


def sag(surfaces: Surfaces, i: int, square_mm2: float) -> tuple[float, bool]:
    """Sag (mm) of a surface at r^2 (mm^2), and whether the surface reaches that far."""
    value, _, _, inside = _sag(surfaces.shape, i, square_mm2)
    return float(value), bool(inside)


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _step(x: float, y: float, dir_l: float, dir_m: float, dir_n: float, shape: Any, i: int) -> Any:
    """Distance from (x, y) on the vertex plane to surface i along the direction, the place there, and the sag's
    slopes.
    """
    c, k, kind = shape[i, CURVATURE], shape[i, CONIC], shape[i, KIND]
    t = 0.0
    if c != 0.0:
        a = c * (1.0 + k * dir_n * dir_n)
        b = dir_n - c * (x * dir_l + y * dir_m)
        e = c * (x * x + y * y)
        square = b * b - a * e
        if square >= 0.0:
            t = e / (b + np.sqrt(square))
        elif kind == STANDARD:
            return 0.0, x, y, 0.0, 0.0, 0.0, False
    for _ in range(_ITERATIONS):
        px, py = x + t * dir_l, y + t * dir_m
        s, s1, s2, inside = _sag(shape, i, px * px + py * py)
        if not inside:
            return 0.0, x, y, 0.0, 0.0, 0.0, False
        if kind == STANDARD:
            return t, px, py, t * dir_n, s1, s2, abs(t * dir_n - s) < 1e-6 * (1.0 + abs(s))
        slope = dir_n - 2.0 * s1 * (px * dir_l + py * dir_m)
        if slope == 0.0:
            break
        move = (t * dir_n - s) / slope
        t -= move
        if abs(move) < 1e-8 * (1.0 + abs(t)):  # Newton's method: the next step would be about 1e-16
            px, py = x + t * dir_l, y + t * dir_m
            s, s1, s2, inside = _sag(shape, i, px * px + py * py)
            return t, px, py, s, s1, s2, inside
    return 0.0, x, y, 0.0, 0.0, 0.0, False


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _turn(r: Any, a: float, b: float, c: float) -> Any:
    """Return a vector of the old frame expressed in the new one."""
    return (
        r[0, 0] * a + r[1, 0] * b + r[2, 0] * c,
        r[0, 1] * a + r[1, 1] * b + r[2, 1] * c,
        r[0, 2] * a + r[1, 2] * b + r[2, 2] * c,
    )


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _propagate_derivative(p: Any, d: Any, t: float, direction: Any, gradient: Any) -> Any:
    """Return a ray's derivative after propagation by t to a surface of the given gradient."""
    qx, qy, qz = p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2]
    across = gradient[0] * direction[0] + gradient[1] * direction[1] + gradient[2] * direction[2]
    dt = -(gradient[0] * qx + gradient[1] * qy + gradient[2] * qz) / across
    return qx + dt * direction[0], qy + dt * direction[1], qz + dt * direction[2]


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _refract_derivative(p: Any, d: Any, bend: Any, direction: Any, normal: Any, length: float, optics: Any) -> Any:
    """Return the derivative of the refracted direction: D' = mu D + gamma n, gamma = cos T - mu cos I."""
    sxx, sxy, syy = bend
    mu, cos_i, cos_t = optics
    gx, gy = -(sxx * p[0] + sxy * p[1]) / length, -(sxy * p[0] + syy * p[1]) / length
    along = normal[0] * gx + normal[1] * gy
    nx, ny, nz = gx - normal[0] * along, gy - normal[1] * along, -normal[2] * along
    d_cos_i = (
        d[0] * normal[0]
        + d[1] * normal[1]
        + d[2] * normal[2]
        + direction[0] * nx
        + direction[1] * ny
        + direction[2] * nz
    )
    d_gamma = (mu * mu * cos_i / cos_t - mu) * d_cos_i
    gamma = cos_t - mu * cos_i
    return (
        mu * d[0] + d_gamma * normal[0] + gamma * nx,
        mu * d[1] + d_gamma * normal[1] + gamma * ny,
        mu * d[2] + d_gamma * normal[2] + gamma * nz,
    )


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def trace_ray(  # noqa: PLR0912, PLR0915  (one loop, compiled as one)
    surfaces: Any, index: Any, field: Any, px: float, py: float, with_slopes: bool, out: Any, points: Any
) -> None:
    """Trace the ray of a field point through (px, py) of the entrance pupil's plane; its row goes to `out`.

    `field` is (finite, a, b, c, pupil z): direction (a, b, c) of a plane wave, or the object point (a, b, c) before the
    first vertex. PATH is the optical path in mm from the wave's plane through the entrance pupil's centre, or from the
    object point, to the image surface. CLIP is the largest excess over an aperture, as a share of its radius: above 0
    the ray is clipped (it is traced on all the same). `points` (surfaces, 3) takes the ray's points in the surfaces'
    own frames; give an empty array where they aren't wanted.
    """
    finite = field[0] != 0.0
    pupil_z = field[4]
    out[STATUS] = ARRIVED
    out[SURFACE] = -1.0
    if finite:
        vx, vy, vz = px - field[1], py - field[2], pupil_z - field[3]
        length = np.sqrt(vx * vx + vy * vy + vz * vz)
        dl, dm, dn = vx / length, vy / length, vz / length
        x, y, z = field[1], field[2], field[3]
        path = 0.0
        p1 = (0.0, 0.0, 0.0)
        p2 = (0.0, 0.0, 0.0)
        d1 = ((1.0 - dl * dl) / length, -dl * dm / length, -dl * dn / length)
        d2 = (-dl * dm / length, (1.0 - dm * dm) / length, -dm * dn / length)
    else:
        dl, dm, dn = field[1], field[2], field[3]
        x, y, z = px, py, pupil_z
        path = index[0] * (dl * px + dm * py)
        p1 = (1.0, 0.0, 0.0)
        p2 = (0.0, 1.0, 0.0)
        d1 = (0.0, 0.0, 0.0)
        d2 = (0.0, 0.0, 0.0)
    shape = surfaces.shape
    clip = -1.0
    stop_x = 0.0
    stop_y = 0.0
    for i in range(surfaces.kind.size):
        if surfaces.kind[i] == BREAK:
            r = surfaces.rotation[i]  # a view costs: only here
            sx, sy = surfaces.decentre[i, 0], surfaces.decentre[i, 1]
            if surfaces.decentre_last[i]:
                x, y, z = _turn(r, x, y, z)
                x, y = x - sx, y - sy
            else:
                x, y, z = _turn(r, x - sx, y - sy, z)
            dl, dm, dn = _turn(r, dl, dm, dn)
            if with_slopes:
                p1 = _turn(r, p1[0], p1[1], p1[2])
                p2 = _turn(r, p2[0], p2[1], p2[2])
                d1 = _turn(r, d1[0], d1[1], d1[2])
                d2 = _turn(r, d2[0], d2[1], d2[2])
            if points.size:
                points[i, 0], points[i, 1], points[i, 2] = x, y, z
            z -= surfaces.thickness[i]
            if dn <= 0.0:
                out[STATUS] = TURNED
                out[SURFACE] = i
                return
            continue
        t0 = -z / dn
        x0, y0 = x + t0 * dl, y + t0 * dm
        t, x, y, z, s1, s2, hit = _step(x0, y0, dl, dm, dn, shape, i)
        if not hit:
            out[STATUS] = MISSED
            out[SURFACE] = i
            return
        t += t0
        path += index[i] * t
        gradient = (-2.0 * x * s1, -2.0 * y * s1, 1.0)
        direction = (dl, dm, dn)
        if with_slopes:
            p1 = _propagate_derivative(p1, d1, t, direction, gradient)
            p2 = _propagate_derivative(p2, d2, t, direction, gradient)
        if points.size:
            points[i, 0], points[i, 1], points[i, 2] = x, y, z
        if i == surfaces.stop:
            stop_x, stop_y = x, y
            clip = max(clip, np.sqrt(x * x + y * y) / surfaces.stop_radius - 1.0)
            out[DS_XX], out[DS_XY], out[DS_YX], out[DS_YY] = p1[0], p2[0], p1[1], p2[1]
        if surfaces.aperture[i] != NO_APERTURE:
            ax, ay = x - surfaces.opening[i, 2], y - surfaces.opening[i, 3]
            if surfaces.aperture[i] == CIRCLE:
                clip = max(clip, np.sqrt(ax * ax + ay * ay) / surfaces.opening[i, 0] - 1.0)
            else:
                clip = max(clip, abs(ax) / surfaces.opening[i, 0] - 1.0, abs(ay) / surfaces.opening[i, 1] - 1.0)
        if index[i] != index[i + 1]:
            length = np.sqrt(gradient[0] ** 2 + gradient[1] ** 2 + 1.0)
            normal = (gradient[0] / length, gradient[1] / length, 1.0 / length)
            cos_i = dl * normal[0] + dm * normal[1] + dn * normal[2]
            mu = index[i] / index[i + 1]
            square = 1.0 - mu * mu * (1.0 - cos_i * cos_i)
            if cos_i <= 0.0 or square <= 0.0:
                out[STATUS] = REFLECTED
                out[SURFACE] = i
                return
            cos_t = np.sqrt(square)
            if with_slopes:
                bend = (2.0 * s1 + 4.0 * x * x * s2, 4.0 * x * y * s2, 2.0 * s1 + 4.0 * y * y * s2)
                optics = (mu, cos_i, cos_t)
                d1 = _refract_derivative(p1, d1, bend, direction, normal, length, optics)
                d2 = _refract_derivative(p2, d2, bend, direction, normal, length, optics)
            gamma = cos_t - mu * cos_i
            dl, dm, dn = mu * dl + gamma * normal[0], mu * dm + gamma * normal[1], mu * dn + gamma * normal[2]
            if dn <= 0.0:
                out[STATUS] = TURNED
                out[SURFACE] = i
                return
        z -= surfaces.thickness[i]
    out[X], out[Y], out[L], out[M], out[N], out[PATH] = x, y, dl, dm, dn, path
    out[CLIP], out[STOP_X], out[STOP_Y] = clip, stop_x, stop_y
    if with_slopes:
        out[DL_DX], out[DL_DY], out[DM_DX], out[DM_DY] = d1[0], d2[0], d1[1], d2[1]
        out[DX_DX], out[DX_DY], out[DY_DX], out[DY_DY] = p1[0], p2[0], p1[1], p2[1]


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def trace_rays(surfaces: Any, index: Any, field: Any, px: Any, py: Any) -> Any:
    """(rays, ROW): the rays through the places (px, py) of the entrance pupil's plane, with their derivatives."""
    out = np.zeros((px.size, ROW))
    nowhere = np.zeros((0, 3))
    for j in range(px.size):
        trace_ray(surfaces, index, field, px[j], py[j], True, out[j], nowhere)
    return out


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def aim(surfaces: Any, index: Any, field: Any, px: float, py: float) -> Any:
    """Return the point of the entrance pupil's plane whose ray passes the centre of the stop, from a start near it: (x,
    y, found).

    Newton's method with the ray's own derivatives; steps are halved until the ray arrives and comes closer.
    """
    out = np.zeros(ROW)
    trial = np.zeros(ROW)
    nowhere = np.zeros((0, 3))
    trace_ray(surfaces, index, field, px, py, True, out, nowhere)
    if out[STATUS] != ARRIVED:
        return px, py, False
    scale = surfaces.stop_radius
    for _ in range(40):
        miss = np.sqrt(out[STOP_X] ** 2 + out[STOP_Y] ** 2)
        if miss < 1e-11 * scale:
            return px, py, True
        det = out[DS_XX] * out[DS_YY] - out[DS_XY] * out[DS_YX]
        if det == 0.0:
            return px, py, False
        sx = (out[DS_YY] * out[STOP_X] - out[DS_XY] * out[STOP_Y]) / det
        sy = (out[DS_XX] * out[STOP_Y] - out[DS_YX] * out[STOP_X]) / det
        share = 1.0
        nearer = False
        for _ in range(12):
            trace_ray(surfaces, index, field, px - share * sx, py - share * sy, True, trial, nowhere)
            if trial[STATUS] == ARRIVED and np.sqrt(trial[STOP_X] ** 2 + trial[STOP_Y] ** 2) < miss:
                nearer = True
                break
            share *= 0.5
        if not nearer:
            return px, py, miss < 1e-8 * scale
        px, py = px - share * sx, py - share * sy
        out[:] = trial
    return px, py, np.sqrt(out[STOP_X] ** 2 + out[STOP_Y] ** 2) < 1e-8 * scale


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def rim(surfaces: Any, index: Any, field: Any, px: float, py: float, angle: Any, guess: float) -> Any:  # noqa: PLR0912
    """Distance from an open point of the pupil to its border in the given directions, where rays begin to be clipped
    or lost.

    The bracket grows from `guess`; then false position (Illinois) while both ends are traced, and bisection where one
    is lost.
    """
    out = np.zeros(ROW)
    nowhere = np.zeros((0, 3))
    radius = np.empty(angle.size)
    for j in range(angle.size):
        ca, sa = np.cos(angle[j]), np.sin(angle[j])
        low, f_low = 0.0, 0.0
        trace_ray(surfaces, index, field, px, py, False, out, nowhere)
        f_low = out[CLIP]
        high, f_high = guess, np.inf
        for _ in range(60):
            trace_ray(surfaces, index, field, px + high * ca, py + high * sa, False, out, nowhere)
            if out[STATUS] != ARRIVED:
                f_high = np.inf
                break
            f_high = out[CLIP]
            if f_high > 0.0:
                break
            low, f_low = high, f_high
            high *= 1.3
        side = 0
        for _ in range(100):
            if high - low < 1e-12 * high:
                break
            if f_high < np.inf:
                middle = high - f_high * (high - low) / (f_high - f_low)
                if not low < middle < high:
                    middle = 0.5 * (low + high)
            else:
                middle = 0.5 * (low + high)
            trace_ray(surfaces, index, field, px + middle * ca, py + middle * sa, False, out, nowhere)
            value = out[CLIP] if out[STATUS] == ARRIVED else np.inf
            if abs(value) < 1e-12:
                low = middle
                break
            if value > 0.0:
                high, f_high = middle, value
                if side == 1:
                    f_low *= 0.5
                side = 1
            else:
                low, f_low = middle, value
                if side == -1 and f_high < np.inf:
                    f_high *= 0.5
                side = -1
        radius[j] = low
    return radius
