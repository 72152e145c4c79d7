"""What stands in front of a camera. A scene is frozen data in the camera's pixel coordinates; `sim.scene.render` draws it.

Radiances are W sr^-1 m^-2 nm^-1. Points are [row, col] in px with [0, 0] at the centre of the top-left pixel. `kind` is the
capture's kind as the recording-set format names it: effects on the rig may depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sim.camera import Geometry
from sim.scene.warp import Warp
from sim.spectrum import FloatArray, Spectrum, energy_from_photons

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


@dataclass(frozen=True, eq=False)
class SpectralImage:
    """A picture with a spectrum in every sample: a multispectral cube.

    `radiance` (rows, cols, bands), W sr^-1 m^-2 nm^-1, float32 or float64, finite and >= 0, at `wavelength_nm` (nm,
    ascending, two or more); between the bands it's linear, beyond them zero, as a `Spectrum` is. Sample [i, j] is an even
    square that covers u = j..j+1, v = i..i+1 of `to_camera`; None: sample [i, j] fills the camera's pixel [i, j]. Around
    the picture it's dark. Raises ValueError that names the quantity, the value and the remedy.
    """

    wavelength_nm: tuple[float, ...]
    radiance: NDArray[np.floating]
    to_camera: Warp | None = None
    kind: str = "image"

    def __post_init__(self) -> None:
        step = np.diff(self.wavelength_nm)
        if len(self.wavelength_nm) < 2 or not np.all(np.isfinite(self.wavelength_nm)):
            raise ValueError(
                f"a spectral image of {len(self.wavelength_nm)} wavelengths needs two or more, all finite: give the bands' centres in nm"
            )
        if not np.all(step > 0):
            at = int(np.argmax(step <= 0))
            raise ValueError(
                f"wavelengths must ascend: {self.wavelength_nm[at + 1]:g} nm follows {self.wavelength_nm[at]:g} nm; sort the bands"
            )
        if self.radiance.ndim != 3 or not self.radiance.size or self.radiance.shape[2] != len(self.wavelength_nm):
            raise ValueError(
                f"radiance of shape {self.radiance.shape} has to be (rows, cols, {len(self.wavelength_nm)} bands): move the bands to the last axis"
            )
        if self.radiance.dtype not in (np.float32, np.float64):
            raise ValueError(
                f"radiance is {self.radiance.dtype}, and has to be float32 or float64: scale codes to W sr^-1 m^-2 nm^-1"
            )
        # One pass for all three faults: a NaN makes the minimum a NaN.
        if not (np.min(self.radiance) >= 0 and np.max(self.radiance) < np.inf):
            i, j, k = (int(n) for n in np.argwhere(~((self.radiance >= 0) & (self.radiance < np.inf)))[0])
            raise ValueError(
                f"radiance is {self.radiance[i, j, k]:g} W sr^-1 m^-2 nm^-1 at row {i}, column {j}, {self.wavelength_nm[k]:g} nm, below the limit of 0 or not finite: correct the cube, or set what noise left below 0 to 0"
            )

    @classmethod
    def from_photons(
        cls, wavelength_nm: tuple[float, ...], photons: NDArray[np.floating], to_camera: Warp | None = None
    ) -> Self:
        """The same from `photons`, s^-1 sr^-1 m^-2 nm^-1: radiance = photons x h c / wavelength at every band."""
        photons = np.asarray(photons)
        if photons.ndim != 3 or photons.shape[2] != len(wavelength_nm):
            raise ValueError(
                f"photons of shape {photons.shape} have to be (rows, cols, {len(wavelength_nm)} bands): move the bands to the last axis"
            )
        return cls(wavelength_nm, np.asarray(energy_from_photons(wavelength_nm, photons), float), to_camera)

    def warp(self) -> Warp:
        """From samples (u, v) to camera px; without `to_camera`, sample [i, j] has its centre at pixel [i, j]."""
        return self.to_camera or Warp(((1.0, 0.0, -0.5), (0.0, 1.0, -0.5), (0.0, 0.0, 1.0)))

    def bands(self) -> tuple[Spectrum, ...]:
        """One curve a band, 1 at its wavelength and 0 at its neighbours: radiance = sum of plane x curve, exactly."""
        rows = np.eye(len(self.wavelength_nm))
        return tuple(Spectrum.of(self.wavelength_nm, row) for row in rows)
