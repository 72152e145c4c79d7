"""Kernels of a recording set: of every screen pose, Bernoulli target and channel, and over the field.

The kernels over the field are tested: do they fit a lens that is symmetric about its axis (`radial_symmetry`)?
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from lab.errors import NotDetermined
from lab.fit.psf.screen_kernel import ScreenField, ScreenKernel, measure_field
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.formats.results import PsfKernel, PsfSymmetry
from lab.observables.screens.placement import pattern_place
from lab.observables.screens.poses import ScreenPictures, ScreenPose, refuse_saturated, screen_poses
from sim.camera import Side

Array = NDArray[np.floating[Any]]
MOMENT_WINDOW_PX = 2.0  # standard deviation of the window of the moments


def radial_symmetry(parts: Sequence[ScreenKernel], axis_px: tuple[float, float]) -> PsfSymmetry:
    """Test whether kernels at several places fit a lens that is symmetric about its axis at `axis_px`, (row, col).

    Of each kernel the second moments under a Gaussian window about its centroid are rotated into radial, tangential
    and mixed ones. For a symmetric lens the mixed moment is 0, and the others are even polynomials of the distance r
    from the axis that agree on it: a0 + a r^2 and a0 + b r^2. Generalised least squares with the covariances of the
    kernels. The lens is called symmetric where chi2 is below its 99.9 % quantile. Raises `NotDetermined` below five
    kernels, or where they lie at one distance.
    """
    radius = np.array([np.hypot(k.centre_px[0] - axis_px[0], k.centre_px[1] - axis_px[1]) for k in parts])
    if len(parts) < 5 or np.ptp(radius) < 10.0:
        raise NotDetermined(
            "psf", f"{len(parts)} kernels over the field don't test radial symmetry: 5 at unequal distances do"
        )
    top = float(radius.max())
    values, weights, designs = [], [], []
    for kernel, r in zip(parts, radius, strict=True):
        moments, covariance = _window_moments(kernel)
        offset = np.array(kernel.centre_px) - axis_px
        u = offset / r if r > 1e-6 else np.array([1.0, 0.0])
        v = np.array([-u[1], u[0]])
        rotation = np.array(  # of (row row, row col, col col) into (radial, tangential, mixed)
            [
                [u[0] ** 2, 2 * u[0] * u[1], u[1] ** 2],
                [v[0] ** 2, 2 * v[0] * v[1], v[1] ** 2],
                [u[0] * v[0], u[0] * v[1] + u[1] * v[0], u[1] * v[1]],
            ]
        )
        values.append(rotation @ moments)
        weights.append(np.linalg.inv(rotation @ covariance @ rotation.T))
        x = (r / top) ** 2
        designs.append(np.array([[1.0, x, 0.0], [1.0, 0.0, x], [0.0, 0.0, 0.0]]))
    normal = sum(d.T @ w @ d for d, w in zip(designs, weights, strict=True))
    right = sum(d.T @ w @ v for d, w, v in zip(designs, weights, values, strict=True))
    solution = np.linalg.solve(normal, right)
    residuals = [v - d @ solution for v, d in zip(values, designs, strict=True)]
    chi2 = float(sum(g @ w @ g for g, w in zip(residuals, weights, strict=True)))
    freedom = 3 * len(parts) - 3
    pulls = [float(g[2] * np.sqrt(w[2, 2])) for g, w in zip(residuals, weights, strict=True)]
    return PsfSymmetry(
        kernels=len(parts),
        chi2=chi2,
        degrees_of_freedom=freedom,
        probability=float(special.chdtrc(freedom, chi2)),
        symmetric=chi2 < float(special.chdtri(freedom, 0.001)),
        variance_on_axis_px2=float(solution[0]),
        radial_growth_px2=float(solution[1]),
        tangential_growth_px2=float(solution[2]),
        largest_mixed_sigma=max(pulls, key=abs),
    )


def _window_moments(kernel: ScreenKernel) -> tuple[Array, Array]:
    """Measure the second moments (row row, row col, col col) of a kernel under a Gaussian window about its centroid,
    px^2, and their covariance (3, 3).
    """
    half = len(kernel.kernel) // 2
    row, col = np.meshgrid(*(np.arange(-half, half + 1.0),) * 2, indexing="ij")
    centre = np.zeros(2)
    for _ in range(8):  # fixed point: the window is centred on the windowed centroid
        r, c = row - centre[0], col - centre[1]
        window = np.exp(-0.5 * (r**2 + c**2) / MOMENT_WINDOW_PX**2) * kernel.kernel
        centre += np.array([(window * r).sum(), (window * c).sum()]) / window.sum()
    weight = np.exp(-0.5 * (r**2 + c**2) / MOMENT_WINDOW_PX**2)
    total = float((weight * kernel.kernel).sum())
    terms = np.stack([r * r, r * c, c * c]).reshape(3, -1) * weight.ravel() / total
    moments = terms @ kernel.kernel.ravel()
    jacobian = terms - moments[:, None] * weight.ravel() / total
    return moments, jacobian @ kernel.covariance @ jacobian.T


@dataclass(frozen=True)
class PsfFit:
    """`kernels`: one for every pose, Bernoulli target and channel. `parts`: of the green (or only) channel, over the
    field. `symmetry`: the test of radial symmetry of the parts, None where they don't determine it.
    """

    kernels: tuple[PsfKernel, ...]
    parts: tuple[PsfKernel, ...]
    symmetry: PsfSymmetry | None


def fit_psf_field(recordings: RecordingSet, side: Side, patches: int = 3) -> PsfFit:
    """Fit the kernels of every pose of the screen, Bernoulli target and channel of `side`; those of `patches` x
    `patches` parts of every pattern; and test their radial symmetry.

    `field_mm` of a kernel is the middle of the pattern from the middle of the frame. The noise is the residual of the
    levelled picture, which includes the photo response non-uniformity of all four captures. Raises `NotDetermined`
    where captures are missing or no pose can be registered.
    """
    camera = recordings.camera(side)
    kernels: list[PsfKernel] = []
    parts: list[PsfKernel] = []
    measured: list[ScreenKernel] = []
    reason = ""
    for pose in screen_poses(recordings, side, "psf"):
        first = pose.pattern[0].id
        try:
            field = _field_of(recordings, camera, pose, patches)
        except NotDetermined as refused:
            reason = f"{first}: {refused.reason}"
            continue
        kernels += [_result(camera, first, kernel) for kernel in field.kernels.values()]
        parts += [_result(camera, first, kernel) for kernel in field.parts]
        measured += field.parts
    if not kernels:
        raise NotDetermined("psf", reason)
    try:
        symmetry = radial_symmetry(measured, ((camera.rows - 1) / 2.0, (camera.cols - 1) / 2.0))
    except NotDetermined:
        symmetry = None
    return PsfFit(tuple(kernels), tuple(parts), symmetry)


def _field_of(recordings: RecordingSet, camera: DataSheet, pose: ScreenPose, patches: int) -> ScreenField:
    """Measure the kernels of one pose, and of `patches` x `patches` parts of its pattern."""
    refuse_saturated(recordings, pose, camera.saturation_dn, "psf")
    pictures = ScreenPictures.of(recordings, pose)
    picture = pictures.levelled(recordings, pose.pattern)
    place = pattern_place(recordings, pictures, picture, camera.cfa)
    first = pose.pattern[0]
    shares = pictures.shares(picture, first, camera.black_level_dn or 0.0)
    return measure_field(shares, recordings.target(first.target), place.warp, camera.cfa, patches=patches)


def _result(camera: DataSheet, capture: str, kernel: ScreenKernel) -> PsfKernel:
    """State a kernel as it stands in the results."""
    return PsfKernel(
        capture=capture,
        channel=kernel.channel,
        field_mm=_field_mm(camera, kernel.centre_px),
        sample_pitch_px=1.0,
        psf=tuple(tuple(float(v) for v in values) for values in kernel.kernel),
        psf_std=tuple(tuple(float(v) for v in values) for values in kernel.kernel_std),
    )


def _field_mm(camera: DataSheet, at_px: tuple[float, float]) -> tuple[float, float] | None:
    """Return the place on the sensor, (row, col) from the middle of the frame, mm; None without a pixel pitch."""
    if camera.pixel_pitch_um is None:
        return None
    pitch_mm = 1e-3 * camera.pixel_pitch_um
    return pitch_mm * (at_px[0] - (camera.rows - 1) / 2.0), pitch_mm * (at_px[1] - (camera.cols - 1) / 2.0)
