"""Scenes in front of a camera, as frozen data in its pixel coordinates; `sim.scene.render` draws them.

Radiances are W sr^-1 m^-2 nm^-1. Points are [row, col] in px with [0, 0] at the centre of the top-left pixel. `kind`
is the capture's kind in the recording-set format; effects of the rig may depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sim.camera import Geometry, StereoRig
from sim.scene.screen import Screen
from sim.scene.warp import Matrix, Warp
from sim.spectrum import FloatArray, Spectrum, energy_from_photons

Corners = tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]


@runtime_checkable
class Scene(Protocol):
    """Any scene, identified by its `kind`."""

    @property
    def kind(self) -> str: ...


@dataclass(frozen=True)
class Darkness:
    """No light: shutter or cap closed."""

    kind: str = "dark"


@dataclass(frozen=True)
class UniformField:
    """Uniform diffuse light of `radiance` that fills the field."""

    radiance: Spectrum
    kind: str = "flat"


@dataclass(frozen=True)
class ReflectanceChart:
    """A flat chart of diffuse patches on a frame of 3 % reflectance, uniformly lit: ColorChecker24 or ColorCheckerSG.

    `corners`: outer corners [row, col] of the patch grid, in the order dark skin, bluish green, black, white (SG: A1,
    N1, N10, A10; for an upright chart: top left, top right, bottom right, bottom left). `illuminant_radiance`: of a
    perfect white diffuser at the chart. `gap`: share of the pitch of the patches that the frame between them takes.
    `geometry`: of a lens with distortion; the corners are then those in a pinhole camera, and every patch's corners
    are distorted. `reflectances`: of this chart's own patches, in the chart's order; None: the published ones.
    """

    corners: Corners
    illuminant_radiance: Spectrum
    name: str = "ColorChecker24"
    gap: float = 0.13
    kind: str = "chart"
    geometry: Geometry | None = None
    reflectances: tuple[Spectrum, ...] | None = None


@dataclass(frozen=True)
class EdgeRegion:
    """One straight edge, `region` = (row0, col0, row1, col1), end excluded.

    `angle_deg` is the edge's angle from the vertical; positive turns its top to the right. The side with larger `col`
    (of an edge near the vertical) is light: a point's signed distance is (col - c0) cos(angle) + (row - r0)
    sin(angle) - offset_px, positive on the light side, with (r0, c0) the centre of the region. Add 180 to the angle to
    swap dark and light.
    """

    region: tuple[int, int, int, int]
    angle_deg: float
    offset_px: float = 0.0

    def distance_px(self, row: FloatArray, col: FloatArray) -> FloatArray:
        """Signed perpendicular distance (px) of points from the edge, positive on the light side."""
        row0, col0, row1, col1 = self.region
        angle = np.deg2rad(self.angle_deg)
        across = (np.asarray(col, float) - 0.5 * (col0 + col1 - 1)) * np.cos(angle)
        down = (np.asarray(row, float) - 0.5 * (row0 + row1 - 1)) * np.sin(angle)
        return across + down - self.offset_px


@dataclass(frozen=True)
class KnifeEdge:
    """Straight edges between dark and light, one in each region. A pixel outside all regions belongs to the nearest
    one, so that every edge extends well beyond its region."""

    regions: tuple[EdgeRegion, ...]
    dark_radiance: Spectrum
    light_radiance: Spectrum
    kind: str = "slanted_edge"

    def owner(self, row: FloatArray, col: FloatArray) -> NDArray[np.intp]:
        """Index of the region that each point belongs to, the nearest one."""
        if not self.regions:
            raise ValueError("a knife edge with no region shows nothing: give at least one edge region")
        away = []
        for edge in self.regions:
            row0, col0, row1, col1 = edge.region
            down = np.maximum(np.maximum(row0 - row, row - (row1 - 1)), 0.0)
            across = np.maximum(np.maximum(col0 - col, col - (col1 - 1)), 0.0)
            away.append(np.hypot(down, across))
        return np.argmin(np.stack(away), axis=0)


@dataclass(frozen=True, eq=False)
class ScreenPattern:
    """A pattern of square cells on a screen. `pattern` (0..1: 0 dark, 1 lit; usually uint8 of 0/1) is seen through
    `to_camera`, from cells to camera px; around the pattern the screen is dark. `kind`: white, black, checkerboard or
    bernoulli."""

    pattern: NDArray[np.uint8] | FloatArray
    to_camera: Warp
    dark_radiance: Spectrum
    light_radiance: Spectrum
    kind: str = "bernoulli"


class Posed:
    """A flat thing at a pose: a point X of its plane (x to the right along columns, y down along rows, z away from the
    camera, mm; OpenCV's frame of a board) goes to `rotation` X + `translation_mm` in the camera's frame and is
    projected by `geometry`.
    """

    rotation: Matrix
    translation_mm: tuple[float, float, float]
    geometry: Geometry

    def plane_warp(self, unit_mm: float) -> Warp:
        """From the plane's coordinates in units of `unit_mm` to camera px: camera_matrix [r1 r2 t] unit_mm, then the
        distortion.
        """
        turn = np.asarray(self.rotation, float)
        pose = np.column_stack([turn[:, 0] * unit_mm, turn[:, 1] * unit_mm, np.asarray(self.translation_mm, float)])
        return Warp.of(np.asarray(self.geometry.camera_matrix, float) @ pose, self.geometry)

    def pose_for_rig(self, rig: StereoRig) -> tuple[Self, Self]:
        """Return the same thing before both cameras of a rig, this pose being that in the left one's frame: what stands
        at x before the left camera stands at rotation x + translation_mm before the right one. Geometries are the
        cameras'.
        """
        pair = rig.left.geometry, rig.right.geometry
        if pair[0] is None or pair[1] is None:
            raise ValueError(
                f"the {'left' if pair[0] is None else 'right'} camera has no geometry: give its camera matrix"
            )
        between = np.asarray(rig.rotation, float)
        turn = between @ np.asarray(self.rotation, float)
        x, y, z = (between @ np.asarray(self.translation_mm, float) + np.asarray(rig.translation_mm, float)).tolist()
        first, second, third = ((float(a), float(b), float(c)) for a, b, c in turn)
        moved = {"rotation": (first, second, third), "translation_mm": (x, y, z), "geometry": pair[1]}
        return replace(self, geometry=pair[0]), replace(self, **moved)  # type: ignore[type-var]


@dataclass(frozen=True, eq=False)
class PlanarTarget(Posed):
    """A flat printed target at a pose: a ChArUco board.

    `texture` (rows, cols), 0..1, is the share of `light_radiance` (1) against `dark_radiance` (0). Its texel [i, j]
    covers j..j+1 by i..i+1 texels of `texel_mm` in the plane of `Posed`. Around the texture there's `surround` (0..1).
    """

    texture: NDArray[np.uint8] | FloatArray
    texel_mm: float
    rotation: Matrix
    translation_mm: tuple[float, float, float]
    geometry: Geometry
    dark_radiance: Spectrum
    light_radiance: Spectrum
    surround: float = 0.0
    kind: str = field(default="charuco")

    def warp(self) -> Warp:
        """From texels to camera px: camera_matrix [r1 r2 t] texel_mm, then the lens's distortion."""
        return self.plane_warp(self.texel_mm)


@dataclass(frozen=True)
class PlaneEdge:
    """One straight edge in a target's plane: through the point `through_mm` [x, y], `angle_deg` from the y axis
    (positive turns its top to the right), light on the side of larger x. It rules the points that lie nearest to
    `centre_mm` [x, y].
    """

    centre_mm: tuple[float, float]
    through_mm: tuple[float, float]
    angle_deg: float


@dataclass(frozen=True, eq=False)
class PosedEdges(Posed):
    """Knife edges in one plane at a pose, seen in perspective and through the lens's distortion, which bends them."""

    edges: tuple[PlaneEdge, ...]
    rotation: Matrix
    translation_mm: tuple[float, float, float]
    geometry: Geometry
    dark_radiance: Spectrum
    light_radiance: Spectrum
    kind: str = "slanted_edge"

    def __post_init__(self) -> None:
        if not self.edges:
            raise ValueError("a knife edge with no edge shows nothing: give at least one")

    def warp(self) -> Warp:
        """From the plane (mm) to camera px."""
        return self.plane_warp(1.0)

    def distances(self, row: FloatArray, col: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """On the grid of ascending `row` x `col` (px): the index of the edge that rules each point, and the signed
        distance of each point from each edge in mm, positive on the light side; (rows, cols) and
        (edges, rows, cols).
        """
        x, y = self.warp().grid_to_pattern(row, col)
        owner = np.argmin([np.hypot(x - e.centre_mm[0], y - e.centre_mm[1]) for e in self.edges], axis=0)
        away = []
        for edge in self.edges:
            angle = np.deg2rad(edge.angle_deg)
            away.append((x - edge.through_mm[0]) * np.cos(angle) + (y - edge.through_mm[1]) * np.sin(angle))
        return owner, np.stack(away)


@dataclass(frozen=True)
class ZonePlate:
    """Rings of decreasing pitch: level 1/2 + 1/2 cos(pi k r^2), k = highest_cy_per_px / radius_px.

    The local frequency k r rises in proportion to the distance r from `centre` [row, col], to `highest_cy_per_px` at
    `radius_px`. Level 0 is `dark_radiance`, 1 `light_radiance`; outside the radius it is 1/2. Over the outermost share
    `taper` of the radius the contrast falls to 0 as a raised cosine, so that the border is no edge.
    """

    centre: tuple[float, float]
    radius_px: float
    highest_cy_per_px: float
    dark_radiance: Spectrum
    light_radiance: Spectrum
    taper: float = 0.1
    kind: str = "zone_plate"

    def __post_init__(self) -> None:
        _above_zero("the zone plate's radius", self.radius_px, "px")
        _above_zero("the zone plate's highest frequency", self.highest_cy_per_px, "cy/px")
        if not 0.0 < self.taper <= 1.0:
            raise ValueError(f"the zone plate's taper is {self.taper}, outside the limits 0..1: 0.1 is usual")


@dataclass(frozen=True)
class SiemensStar:
    """`spokes` light triangles on dark from `centre` [row, col], their outer corners on the circle of `radius_px`.

    Dark sectors between them have the same width: half of every circle within is light, at spokes / (2 pi r) cy/px at
    a radius of r px. The first spoke begins `turn_deg` from the right, clockwise.
    """

    centre: tuple[float, float]
    radius_px: float
    spokes: int
    dark_radiance: Spectrum
    light_radiance: Spectrum
    turn_deg: float = 0.0
    kind: str = "siemens_star"

    def __post_init__(self) -> None:
        _above_zero("the star's radius", self.radius_px, "px")
        if self.spokes < 2:
            raise ValueError(f"a star of {self.spokes} spokes is below the limit of 2: 36 or 72 are usual")

    def triangles(self) -> FloatArray:
        """Corners [row, col] of the light triangles, (spokes, 3, 2)."""
        angle = np.deg2rad(self.turn_deg) + np.pi * np.arange(2 * self.spokes) / self.spokes
        rim = np.stack([np.sin(angle), np.cos(angle)], axis=-1) * self.radius_px + self.centre
        return np.stack([np.broadcast_to(self.centre, rim[::2].shape), rim[::2], rim[1::2]], axis=1)


@dataclass(frozen=True)
class Ramp:
    """Level 0 (`dark_radiance`) to 1 (`light_radiance`) over `length_px` about `centre` [row, col], rising towards
    `angle_deg` (0: to the right, 90: down). Linear with `steps` 0; else that number of equal bands of levels 0, 1 /
    (steps - 1), ..., 1."""

    centre: tuple[float, float]
    length_px: float
    dark_radiance: Spectrum
    light_radiance: Spectrum
    angle_deg: float = 0.0
    steps: int = 0
    kind: str = "ramp"

    def __post_init__(self) -> None:
        _above_zero("the ramp's length", self.length_px, "px")
        if self.steps == 1 or self.steps < 0:
            raise ValueError(f"a ramp of {self.steps} steps has no slope: give 0 for a linear one, or 2 or more")


@dataclass(frozen=True)
class PointArray:
    """Square holes of `side_px` at `points` ([row, col] of their centres), `light_radiance` in `dark_radiance`. The
    light of a hole, radiance x side_px^2, is drawn exactly, however small the hole."""

    points: tuple[tuple[float, float], ...]
    side_px: float
    dark_radiance: Spectrum
    light_radiance: Spectrum
    kind: str = "points"

    def __post_init__(self) -> None:
        _above_zero("the points' side", self.side_px, "px")
        if not np.all(np.isfinite(self.points)):
            raise ValueError("a point's place isn't finite: give [row, col] in px")


@dataclass(frozen=True, eq=False)
class ScreenImage(Posed):
    """A picture of digital codes on a screen at a pose: what any `Screen` shows of any image.

    `codes` (rows, cols, 3) uint8, red, green, blue; a code fills one pixel of the screen, `pixel_mm` wide, in the
    plane of `Posed`. It is dark around the picture, as a screen ends there.
    """

    screen: Screen
    codes: NDArray[np.uint8]
    pixel_mm: float
    rotation: Matrix
    translation_mm: tuple[float, float, float]
    geometry: Geometry
    kind: str = "screen"

    def __post_init__(self) -> None:
        if self.codes.ndim != 3 or self.codes.shape[2] != 3 or not self.codes.size or self.codes.dtype != np.uint8:
            raise ValueError(
                f"codes of shape {self.codes.shape} and type {self.codes.dtype} have to be (rows, cols, 3) uint8: "
                "convert the picture to 8-bit RGB"
            )
        _above_zero("the screen's pixel", self.pixel_mm, "mm")

    def warp(self) -> Warp:
        """From the screen's pixels to camera px."""
        return self.plane_warp(self.pixel_mm)

    def cosine(self, row: FloatArray, col: FloatArray) -> FloatArray:
        """Cosine of the angle between the screen's normal and the ray to the camera, (row.size, col.size), at the
        screen points seen at ascending camera `row` x `col` (px)."""
        turn = np.asarray(self.rotation, float)
        eye = -turn.T @ np.asarray(self.translation_mm, float)  # the camera in the screen's frame
        warp = self.warp()
        if warp.is_upright:  # a sum of a term a row and one a column
            u, v = warp.to_pattern(row[0], col)[0][None, :], warp.to_pattern(row, col[0])[1][:, None]
        else:
            u, v = warp.grid_to_pattern(row, col)
        away2 = (u * self.pixel_mm - eye[0]) ** 2 + (v * self.pixel_mm - eye[1]) ** 2
        return np.abs(eye[2]) / np.sqrt(away2 + eye[2] ** 2)


@dataclass(frozen=True, eq=False)
class SpectralImage:
    """A picture with a spectrum in every sample: a multispectral cube.

    `radiance` (rows, cols, bands), W sr^-1 m^-2 nm^-1, float32 or float64, finite and >= 0, at `wavelength_nm` (nm,
    ascending, two or more); linear between the bands, zero beyond them, as a `Spectrum` is. Sample [i, j] is a uniform
    square that covers u = j..j+1, v = i..i+1 of `to_camera`; None: sample [i, j] fills the camera's pixel [i, j]. It
    is dark around the picture. Raises ValueError that names the quantity, the value and the remedy.
    """

    wavelength_nm: tuple[float, ...]
    radiance: NDArray[np.floating]
    to_camera: Warp | None = None
    kind: str = "image"

    def __post_init__(self) -> None:
        step = np.diff(self.wavelength_nm)
        if len(self.wavelength_nm) < 2 or not np.all(np.isfinite(self.wavelength_nm)):
            raise ValueError(
                f"a spectral image of {len(self.wavelength_nm)} wavelengths needs two or more, all finite: give the "
                "bands' centres in nm"
            )
        if not np.all(step > 0):
            at = int(np.argmax(step <= 0))
            raise ValueError(
                f"wavelengths must ascend: {self.wavelength_nm[at + 1]:g} nm follows {self.wavelength_nm[at]:g} nm; "
                "sort the bands"
            )
        if self.radiance.ndim != 3 or not self.radiance.size or self.radiance.shape[2] != len(self.wavelength_nm):
            raise ValueError(
                f"radiance of shape {self.radiance.shape} has to be (rows, cols, {len(self.wavelength_nm)} bands): "
                "move the bands to the last axis"
            )
        if self.radiance.dtype not in (np.float32, np.float64):
            raise ValueError(
                f"radiance is {self.radiance.dtype}, and has to be float32 or float64: scale codes to W sr^-1 m^-2 "
                "nm^-1"
            )
        # One pass for all three faults: a NaN makes the minimum a NaN.
        if not (np.min(self.radiance) >= 0 and np.max(self.radiance) < np.inf):
            i, j, k = (int(n) for n in np.argwhere(~((self.radiance >= 0) & (self.radiance < np.inf)))[0])
            raise ValueError(
                f"radiance is {self.radiance[i, j, k]:g} W sr^-1 m^-2 nm^-1 at row {i}, column {j}, "
                f"{self.wavelength_nm[k]:g} nm, below the limit of 0 or not finite: correct the cube, or set what "
                "noise left below 0 to 0"
            )

    @classmethod
    def from_photons(
        cls, wavelength_nm: tuple[float, ...], photons: NDArray[np.floating], to_camera: Warp | None = None
    ) -> Self:
        """Return the same from `photons`, s^-1 sr^-1 m^-2 nm^-1: radiance = photons x h c / wavelength at every
        band."""
        photons = np.asarray(photons)
        if photons.ndim != 3 or photons.shape[2] != len(wavelength_nm):
            raise ValueError(
                f"photons of shape {photons.shape} have to be (rows, cols, {len(wavelength_nm)} bands): move the bands "
                "to the last axis"
            )
        return cls(wavelength_nm, np.asarray(energy_from_photons(wavelength_nm, photons), float), to_camera)

    def warp(self) -> Warp:
        """From samples (u, v) to camera px; without `to_camera`, sample [i, j] has its centre at pixel [i, j]."""
        return self.to_camera or Warp(((1.0, 0.0, -0.5), (0.0, 1.0, -0.5), (0.0, 0.0, 1.0)))

    def bands(self) -> tuple[Spectrum, ...]:
        """One curve a band, 1 at its wavelength and 0 at its neighbours: radiance = sum of plane x curve, exactly."""
        rows = np.eye(len(self.wavelength_nm))
        return tuple(Spectrum.of(self.wavelength_nm, row) for row in rows)


def _above_zero(what: str, value: float, unit: str) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{what} is {value} {unit}, below the limit of 0 {unit} or not finite: give a number above 0")
