"""Irradiance of the image on the axis, and its fall-off over the field: by law, by table, or from a flat field."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from sim.parameters import Frozen
from sim.spectrum import FloatArray

if TYPE_CHECKING:  # a lens's fall-off is a part of the camera
    from scipy.interpolate import PchipInterpolator, RectBivariateSpline

    from sim.camera import CameraModel


class CosineFourth(Frozen):
    """cos^4 of the chief ray's angle atan(r / focal length)."""

    kind: Literal["cosine_fourth"] = "cosine_fourth"


class RadialIllumination(Frozen):
    """A lens maker's curve: `relative_illumination` at `radius_mm` from the optical axis, monotone cubic between,
    constant beyond.

    It replaces cos^4, which it includes. Radii ascend from 0, where the value is 1.
    """

    kind: Literal["radial"] = "radial"
    radius_mm: tuple[float, ...]
    relative_illumination: tuple[float, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        radius, value = self.radius_mm, self.relative_illumination
        if len(radius) != len(value) or len(radius) < 2:
            raise ValueError(
                f"{len(radius)} radii and {len(value)} values: give as many of the one as of the other, two or more"
            )
        if radius[0] != 0.0 or np.any(np.diff(radius) <= 0):
            raise ValueError(f"radii {list(radius[:4])} mm have to ascend from 0: sort them, and begin on the axis")
        if abs(value[0] - 1.0) > 1e-6 or min(value) < 0:
            raise ValueError(
                f"relative illumination is {value[0]:g} on the axis and {min(value):g} at least: divide by its value "
                "on the axis, and leave out what is below 0"
            )
        return self

    @cached_property
    def _curve(self) -> PchipInterpolator:
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(self.radius_mm, self.relative_illumination)

    def at(self, radius_mm: FloatArray) -> FloatArray:
        """Relative illumination at distances from the axis."""
        return np.asarray(self._curve(np.minimum(radius_mm, self.radius_mm[-1])))


class MeasuredIllumination(Frozen):
    """A map over the frame, measured on a flat field of a uniform source.

    `values` lie on an even grid from the first to the last pixel's centre in each direction, with cubic interpolation,
    and are divided by their value on the optical axis. The map replaces cos^4, which it includes.
    """

    kind: Literal["measured"] = "measured"
    values: tuple[tuple[float, ...], ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        lengths = {len(row) for row in self.values}
        if len(self.values) < 2 or len(lengths) != 1 or min(lengths) < 2:
            raise ValueError(
                f"an illumination map of {len(self.values)} rows of {sorted(lengths)} values: give two or more each "
                "way, rows of one length"
            )
        lowest = min(min(row) for row in self.values)
        if not lowest > 0:
            raise ValueError(
                f"illumination is {lowest:g} in the map, below the limit of 0: subtract no more than the dark frame"
            )
        return self

    @classmethod
    def from_flat(cls, flat: FloatArray, degree: int = 6, nodes: tuple[int, int] = (25, 33)) -> Self:
        """Return the map of a flat field (rows, cols): any unit, dark subtracted, one channel or an even mosaic's mean.

        A polynomial of total degree `degree` in x and y through the means of square blocks, by least squares: noise and
        dust average out, and so does anything sharper than about 1/degree of the frame. Raises ValueError for a flat
        that isn't positive on average.
        """
        rows, cols = flat.shape
        size = 2 * max(1, min(rows, cols) // 96)
        down, across = rows // size, cols // size
        if min(down, across) <= degree:
            raise ValueError(
                f"a flat of {rows} x {cols} px has too few blocks for degree {degree}: give a lower degree"
            )
        means = flat[: down * size, : across * size].reshape(down, size, across, size).mean(axis=(1, 3))
        if not float(np.mean(means)) > 0:
            raise ValueError(
                f"the flat's mean is {float(np.mean(means)):g}, not above the limit of 0: subtract the dark frame once"
            )
        y, x = (
            2.0 * ((np.arange(n) + 0.5) * size - 0.5) / (full - 1) - 1.0 for n, full in ((down, rows), (across, cols))
        )
        terms = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]

        def design(y: FloatArray, x: FloatArray) -> FloatArray:
            py, px = (np.polynomial.legendre.legvander(axis, degree) for axis in (y, x))
            return np.stack([np.outer(py[:, i], px[:, j]).ravel() for i, j in terms], axis=1)

        found = np.linalg.lstsq(design(y, x), means.ravel() / means.mean(), rcond=None)[0]
        grid = design(np.linspace(-1.0, 1.0, nodes[0]), np.linspace(-1.0, 1.0, nodes[1])) @ found
        return cls(values=tuple(map(tuple, grid.reshape(nodes).tolist())))

    @cached_property
    def _surface(self) -> RectBivariateSpline:
        from scipy.interpolate import RectBivariateSpline

        values = np.array(self.values)
        y, x = (np.linspace(0.0, 1.0, n) for n in values.shape)
        return RectBivariateSpline(y, x, values, kx=min(3, len(y) - 1), ky=min(3, len(x) - 1))

    def at(self, down: FloatArray, across: FloatArray) -> FloatArray:
        """Return the map at fractions 0..1 of the frame's height and width, which broadcast; constant beyond."""
        down, across = np.clip(down, 0.0, 1.0), np.clip(across, 0.0, 1.0)
        if down.ndim == across.ndim == 2 and down.shape[1] == 1 and across.shape[0] == 1:
            return np.asarray(self._surface(down[:, 0], across[0]))
        return np.asarray(self._surface.ev(*np.broadcast_arrays(down, across)))


#: What `Lens.illumination` holds.
Illumination = Annotated[CosineFourth | RadialIllumination | MeasuredIllumination, Field(discriminator="kind")]


def irradiance_factor(f_number: float, magnification: float = 0.0) -> float:
    """Image irradiance over scene radiance (sr) of a lossless lens on axis: pi / (1 + 4 N^2 (1 + |m|)^2), as in
    ISETCam.
    """
    return np.pi / (1.0 + 4.0 * f_number**2 * (1.0 + abs(magnification)) ** 2)


def optical_axis_px(camera: CameraModel) -> tuple[float, float]:
    """(row, col) of the optical axis: the principal point where the geometry is known, else the frame's centre."""
    if camera.geometry is None:
        return 0.5 * (camera.rows - 1), 0.5 * (camera.cols - 1)
    return camera.geometry.camera_matrix[1][2], camera.geometry.camera_matrix[0][2]


def from_axis_um(x_um: ArrayLike, y_um: ArrayLike, camera: CameraModel) -> tuple[FloatArray, FloatArray, float]:
    """Sensor positions relative to the optical axis (um), given relative to the sensor's centre (x along columns, y
    along rows); and half the diagonal."""
    row0, col0 = optical_axis_px(camera)
    pitch = camera.pixel_pitch_um
    x = np.asarray(x_um, float) - (col0 - 0.5 * (camera.cols - 1)) * pitch
    y = np.asarray(y_um, float) - (row0 - 0.5 * (camera.rows - 1)) * pitch
    return x, y, 0.5 * float(np.hypot(camera.cols, camera.rows)) * pitch


def sin_theta(camera: CameraModel, row: ArrayLike, col: ArrayLike) -> FloatArray:
    """Sine of the chief ray's angle atan(r / focal length) at the sensor, for points in px that broadcast; 0 where the
    focal length isn't known."""
    focal_mm = camera.lens.focal_length_mm
    if focal_mm is None:
        return np.zeros(np.broadcast_shapes(np.shape(row), np.shape(col)))
    row0, col0 = optical_axis_px(camera)
    pitch_mm = camera.pixel_pitch_um * 1e-3
    square = ((np.asarray(row, float) - row0) ** 2 + (np.asarray(col, float) - col0) ** 2) * pitch_mm**2
    return np.sqrt(square / (square + focal_mm**2))


def relative_illumination(camera: CameraModel, row: ArrayLike, col: ArrayLike) -> FloatArray:
    """Light relative to the optical axis at points in px that broadcast: by `Lens.illumination`, by cos^4 where that
    isn't stated, the same everywhere where the focal length isn't known either."""
    row0, col0 = optical_axis_px(camera)
    row, col = np.asarray(row, float), np.asarray(col, float)
    law = camera.lens.illumination
    if isinstance(law, MeasuredIllumination):
        down, across = max(camera.rows - 1, 1), max(camera.cols - 1, 1)
        axis = float(law.at(np.array(row0 / down), np.array(col0 / across)))
        return law.at(row / down, col / across) / axis
    square = (row - row0) ** 2 + (col - col0) ** 2
    pitch_mm = camera.pixel_pitch_um * 1e-3
    if isinstance(law, RadialIllumination):
        return law.at(pitch_mm * np.sqrt(square))
    focal_mm = camera.lens.focal_length_mm
    scale = 0.0 if focal_mm is None else (pitch_mm / focal_mm) ** 2
    return 1.0 / (1.0 + scale * square) ** 2
