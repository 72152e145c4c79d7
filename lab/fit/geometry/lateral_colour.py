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

HUBER_STD = 1.5  # standard deviations of a coordinate from which residuals lose weight
MOST_ITERATIONS = 50


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
    """Robust least squares of shift (n, 2) = jacobian (n, 2, p) values: Huber's, with the spread of the residuals by their median.

    Corners have errors by the demosaicing that aren't normal. Cut off at some residual, another set of them counts in each session, and
    the values jump by more than their standard deviation; Huber's weights change smoothly. Returns values (p,), covariance (p, p) by
    Huber's sandwich formula, rms (px) and number of corners, outliers left out; None where too few corners are trusted.
    """
    if trusted.sum() < 4 * MIN_CORNERS:
        return None
    jacobian, shift = jacobian[trusted], shift[trusted]
    scale = np.maximum(np.linalg.norm(jacobian, axis=(0, 1)), 1e-12)
    design = jacobian / scale
    weight = np.ones(len(shift))
    values = np.zeros(len(scale))
    for _ in range(MOST_ITERATIONS):
        root, before = np.sqrt(weight)[:, None], values
        weighted = (design * root[..., None]).reshape(-1, len(scale))
        values = np.linalg.lstsq(weighted, (shift * root).ravel(), rcond=1e-12)[0]
        rest = shift - design @ values
        away = np.linalg.norm(rest, axis=1)
        std = max(1.4826 * float(np.median(np.abs(rest))), 1e-6)
        weight = np.minimum(1.0, HUBER_STD * std / np.maximum(away, 1e-12))
        if np.max(np.abs(values - before)) < 1e-3 * std:  # the design's columns have norm 1: `std` is that of a value
            break
    # Beyond the bend, Huber's influence has no slope along the residual and that of its weight across
    slope = np.where(weight < 1.0, 0.5 * weight, 1.0)
    bread = np.linalg.pinv(np.einsum("n,nij,nik->jk", slope, design, design))
    influence = np.einsum("n,nij,ni->nj", weight, design, rest)
    freedom = len(shift) * 2 / max(len(shift) * 2 - len(values), 1)
    covariance = freedom * bread @ (influence.T @ influence) @ bread / np.outer(scale, scale)
    near = away < OUTLYING_CORNER_STD * std
    return values / scale, covariance, float(np.sqrt(np.mean(away[near] ** 2))), int(near.sum())
