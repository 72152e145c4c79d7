"""How much light reaches the sensor: the image's irradiance on axis, and its fall-off."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sim.camera import CameraModel
from sim.spectrum import FloatArray


def irradiance_factor(f_number: float, magnification: float = 0.0) -> float:
    """Image irradiance over scene radiance (sr) of a lossless lens on axis: pi / (1 + 4 N^2 (1 + |m|)^2), as in ISETCam."""
    return np.pi / (1.0 + 4.0 * f_number**2 * (1.0 + abs(magnification)) ** 2)


def optical_axis_px(camera: CameraModel) -> tuple[float, float]:
    """(row, col) of the optical axis: the principal point where the geometry is known, else the frame's centre."""
    if camera.geometry is None:
        return 0.5 * (camera.rows - 1), 0.5 * (camera.cols - 1)
    return camera.geometry.camera_matrix[1][2], camera.geometry.camera_matrix[0][2]


def from_axis_um(x_um: ArrayLike, y_um: ArrayLike, camera: CameraModel) -> tuple[FloatArray, FloatArray, float]:
    """Places on the sensor, um from its centre (x along columns, y along rows), as um from the optical axis; and half the diagonal."""
    row0, col0 = optical_axis_px(camera)
    pitch = camera.pixel_pitch_um
    x = np.asarray(x_um, float) - (col0 - 0.5 * (camera.cols - 1)) * pitch
    y = np.asarray(y_um, float) - (row0 - 0.5 * (camera.rows - 1)) * pitch
    return x, y, 0.5 * float(np.hypot(camera.cols, camera.rows)) * pitch


def sin_theta(camera: CameraModel, row: ArrayLike, col: ArrayLike) -> FloatArray:
    """Sine of the chief ray's angle atan(r / focal length) at the sensor, for points in px that broadcast."""
    row0, col0 = optical_axis_px(camera)
    pitch_mm = camera.pixel_pitch_um * 1e-3
    square = ((np.asarray(row, float) - row0) ** 2 + (np.asarray(col, float) - col0) ** 2) * pitch_mm**2
    return np.sqrt(square / (square + camera.lens.focal_length_mm**2))


def relative_illumination(camera: CameraModel, row: ArrayLike, col: ArrayLike) -> FloatArray:
    """Light relative to the optical axis, cos^4 of the chief ray's angle, for points in px that broadcast."""
    row0, col0 = optical_axis_px(camera)
    scale = (camera.pixel_pitch_um * 1e-3 / camera.lens.focal_length_mm) ** 2
    square = (np.asarray(row, float) - row0) ** 2 + (np.asarray(col, float) - col0) ** 2
    return 1.0 / (1.0 + scale * square) ** 2
