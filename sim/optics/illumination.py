"""Irradiance of the image on the axis, and its fall-off over the field of a camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sim.camera import CameraModel
from sim.optics.fall_off import MeasuredIllumination, RadialIllumination
from sim.spectrum import FloatArray


def irradiance_factor(f_number: float, magnification: float = 0.0) -> float:
    """Compute image irradiance over scene radiance of a lossless lens on the axis, pi / (1 + 4 N^2 (1 + |m|)^2), as
    in ISETCam.

    f_number : N; magnification : m

    Returns sr.

    >>> round(irradiance_factor(4.0), 5)  # pi / 65
    0.04833
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
