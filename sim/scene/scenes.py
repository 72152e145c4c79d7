"""What stands in front of a camera. A scene is frozen data in the camera's pixel coordinates; `sim.scene.render` draws it.

Radiances are W sr^-1 m^-2 nm^-1. Points are [row, col] in px with [0, 0] at the centre of the top-left pixel. `kind` is the
capture's kind as the recording-set format names it: effects on the rig may depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sim.camera import Geometry
from sim.scene.warp import Warp
from sim.spectrum import FloatArray, Spectrum

Corners = tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]


@runtime_checkable
class Scene(Protocol):
    """Any scene: what it adds is its `kind`."""

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
    """A flat chart of diffuse patches on a frame of 3 % reflectance, lit evenly.

    `corners`: outer corners [row, col] of the patch grid, in the order dark skin, bluish green, black, white (for an upright
    chart: top left, top right, bottom right, bottom left). `illuminant_radiance`: of a perfect white diffuser in the chart's
    place. `gap`: share of the distance of neighbouring patches that the frame between them takes.
    """

    corners: Corners
    illuminant_radiance: Spectrum
    name: str = "ColorChecker24"
    gap: float = 0.13
    kind: str = "chart"


@dataclass(frozen=True)
class EdgeRegion:
    """One straight edge, `region` = (row0, col0, row1, col1), end excluded.

    `angle_deg` is the edge's angle from the vertical; positive turns its top to the right. The side with larger `col` (of an
    edge near the vertical) is light: a point's signed distance is (col - c0) cos(angle) + (row - r0) sin(angle) - offset_px,
    positive on the light side, with (r0, c0) the centre of the region. Add 180 to the angle to swap dark and light.
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
    """Straight edges between dark and light, one in each region. A pixel outside all regions belongs to the nearest one, so
    that every edge goes on well past its region."""

    regions: tuple[EdgeRegion, ...]
    dark_radiance: Spectrum
    light_radiance: Spectrum
    kind: str = "slanted_edge"


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


@dataclass(frozen=True, eq=False)
class PlanarTarget:
    """A flat printed target at a pose: a ChArUco board.

    `texture` (rows, cols), 0..1, is the share of `light_radiance` (1) against `dark_radiance` (0). Its texel [i, j] covers
    j..j+1 by i..i+1 texels of `texel_mm` in the target's plane, x to the right along columns, y down along rows, z away
    from the camera: OpenCV's frame of a board. A point X goes to `rotation` X + `translation_mm` in the camera's frame and is
    projected by `geometry`. Around the texture there's `surround` (0..1).
    """

    texture: NDArray[np.uint8] | FloatArray
    texel_mm: float
    rotation: tuple[tuple[float, float, float], ...]
    translation_mm: tuple[float, float, float]
    geometry: Geometry
    dark_radiance: Spectrum
    light_radiance: Spectrum
    surround: float = 0.0
    kind: str = field(default="charuco")

    def warp(self) -> Warp:
        """From texels to camera px: camera_matrix [r1 r2 t] texel_mm, then the lens's distortion."""
        rotation = np.asarray(self.rotation, float)
        pose = np.column_stack(
            [rotation[:, 0] * self.texel_mm, rotation[:, 1] * self.texel_mm, np.asarray(self.translation_mm, float)]
        )
        return Warp.of(np.asarray(self.geometry.camera_matrix, float) @ pose, self.geometry)
