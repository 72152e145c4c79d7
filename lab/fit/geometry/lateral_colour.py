"""Lateral colour: the camera of each colour of a mosaic, from where its corners lie beside those of the luminance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.fit.geometry.board_detection import MIN_CORNERS
from lab.fit.geometry.calibration import OUTLYING_CORNER_STD, Calibration
from lab.fit.geometry.corners import CornerFits
from lab.fit.geometry.pinhole import COUNT, distortion_of, matrix_of, project_with_jacobian, unproject
from lab.fit.tuples import numbers, triples
from lab.formats.results import ChannelGeometry

Array = NDArray[np.floating[Any]]


def channel_geometry(calibration: Calibration, corners: Sequence[dict[str, CornerFits]]) -> tuple[ChannelGeometry, ...]:
    """The camera of each colour from its corners, one entry of `corners` for each view.

    Poses and boards are the same for all colours, so that only differences count: scale, principal point, k1 and k2 of
    each colour by least squares, dq = J dtheta. The radial shift of a colour is its own less that of green, against
    the distance from the principal point, positive outwards.
    """
    if not corners or "G" not in corners[0]:
        return ()
    intrinsics = calibration.intrinsics
    seen = np.concatenate([view.image_px for view in calibration.views])
    rays = unproject(seen, intrinsics)
    by_camera = project_with_jacobian(rays, intrinsics)[2]
    parameters = _colour_parameters(intrinsics)
    jacobian = by_camera @ parameters
    farthest = float(np.linalg.norm(seen - intrinsics[2:4], axis=1).max())
    radius = np.linspace(0.0, farthest, 16)
    found = []
    for channel in corners[0]:
        trusted = np.concatenate([fits[channel].trusted & fits["G"].trusted for fits in corners])
        at = np.concatenate([fits[channel].points for fits in corners])
        green = np.concatenate([fits["G"].points for fits in corners])
        own = _fitted_shift(at - seen, jacobian, trusted)
        beside = _fitted_shift(at - green, jacobian, trusted) if channel != "G" else None
        if own is None or (channel != "G" and beside is None):
            continue
        theta = intrinsics + parameters @ own[0]
        result = ChannelGeometry(
            channel=channel,
            camera_matrix=triples(matrix_of(theta)),
            distortion=numbers(distortion_of(theta)),
            rms_px=own[2],
            corners=int(own[3]),
        )
        if beside is not None:
            # Along the diagonal of the frame; the radial part hardly depends on the direction
            along = np.array([0.8, 0.6])
            line = unproject(intrinsics[2:4] + radius[:, None] * along, intrinsics)
            radial = np.einsum("i,nij->nj", along, project_with_jacobian(line, intrinsics)[2] @ parameters)
            radial[:, 1:3] = 0.0  # a common shift of the frame isn't radial
            shift_std = numbers(np.sqrt(np.diag(beside[1])[1:3]))
            result = result.model_copy(
                update={
                    "centre_shift_px": (float(beside[0][1]), float(beside[0][2])),
                    "centre_shift_px_std": (shift_std[0], shift_std[1]),
                    "radius_px": numbers(radius),
                    "radial_shift_px": numbers(radial @ beside[0]),
                    "radial_shift_px_std": numbers(np.sqrt(np.einsum("ni,ij,nj->n", radial, beside[1], radial))),
                }
            )
        found.append(result)
    return tuple(found)


def _colour_parameters(intrinsics: Array) -> Array:
    """Directions (12, 5) of the intrinsics for scale, cx, cy, k1 and k2."""
    parameters = np.zeros((COUNT, 5))
    parameters[0, 0], parameters[1, 0] = intrinsics[0], intrinsics[1]
    for column, row in ((1, 2), (2, 3), (3, 4), (4, 5)):
        parameters[row, column] = 1.0
    return parameters


def _fitted_shift(shift: Array, jacobian: Array, trusted: NDArray[np.bool_]) -> tuple[Array, Array, float, int] | None:
    """Least squares of shift (n, 2) = jacobian (n, 2, p) values, without outliers.

    Returns values (p,), covariance (p, p), rms (px) and number of corners; None where too few corners are trusted.
    """
    used = trusted.copy()
    for _ in range(4):
        if used.sum() < 4 * MIN_CORNERS:
            return None
        design = jacobian[used].reshape(-1, jacobian.shape[2])
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
        values = np.linalg.lstsq(design / scale, shift[used].ravel(), rcond=1e-12)[0] / scale
        rest = shift - jacobian @ values
        away = np.linalg.norm(rest, axis=1)
        std = 1.4826 * float(np.median(np.abs(rest[used])))
        kept = trusted & (away < OUTLYING_CORNER_STD * max(std, 1e-6))
        if np.array_equal(kept, used):
            break
        used = kept
    variance = float(np.sum(rest[used] ** 2)) / max(2 * used.sum() - len(values), 1)
    covariance = variance * np.linalg.pinv((design / scale).T @ (design / scale)) / np.outer(scale, scale)
    return values, covariance, float(np.sqrt(np.mean(away[used] ** 2))), int(used.sum())
