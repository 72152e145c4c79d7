"""Images of targets on the sensor, e-/s by channel before shading: edge, board, screen pattern, colour chart.

An edge is the integral of the line spread function along its normal; patterns are drawn on a grid four times finer than
the pixels."""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from evaluation.independent_simulator.camera import ConcealedCamera
from evaluation.independent_simulator.law import WAVELENGTH_NM, Array
from evaluation.independent_simulator.transfer import HIGHEST_CY_PX

FINE = 4  # samples a pixel of a pattern's image
BOARD_PARTS, SCREEN_PARTS = (
    2,
    14,
)  # parts along a side that a sample averages, of a board, and where a screen's cells meet
PERIOD_PX, STEP_PX = 204.8, 0.025  # of the line spread function
TURN_DEG = 0.6  # of a screen pattern


@dataclass(frozen=True)
class BoardPose:
    """A board before a camera: its centre at `centre_mm` (x right, y down, z away), turned about x, then y, then z."""

    centre_mm: tuple[float, float, float]
    turn_deg: tuple[float, float, float]


def edge(camera: ConcealedCamera, angle_deg: float, radiance: Array, dark: float) -> dict[str, Array]:
    """Return a straight edge between `dark` and 1: the running integral of the line spread function along the
    normal."""
    a = np.deg2rad(angle_deg)
    x, y = camera.field_position
    distance = camera.half_diagonal_px * (x * np.cos(a) + y * np.sin(a))
    n = round(PERIOD_PX / STEP_PX)
    f = np.fft.rfftfreq(n, STEP_PX)
    position = (np.arange(n) - n // 2) * STEP_PX
    out = {}
    for channel in camera.quantum_efficiency:
        h = np.where(f < HIGHEST_CY_PX, camera.lens.otf(np.minimum(f, HIGHEST_CY_PX), a, radiance, channel), 0.0)
        # the line spread function's integral over each step, summed from the left
        spread = np.fft.fftshift(np.fft.irfft(h * np.sinc(f * STEP_PX) * np.exp(1j * np.pi * f * STEP_PX), n))
        step = np.concatenate([[0.0], np.cumsum(spread)[:-1]])
        out[channel] = camera.rate(radiance, channel) * (dark + (1 - dark) * np.interp(distance, position, step))
    return out


def board(
    camera: ConcealedCamera, texture: Array, texel_mm: float, pose: BoardPose, radiance: Array
) -> dict[str, Array]:
    """Return a flat printed board of `texture` (0 black .. 1 white) through pinhole, distortion and blur; dark
    around it."""
    a, b, c = np.deg2rad(pose.turn_deg)
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    turn = about_z @ about_y @ about_x
    centre = np.array(pose.centre_mm) - [camera.offset_mm, 0, 0]
    # the position on the board is a smooth function of the pixel: computed every few pixels, interpolated by splines
    coarse = _coarse_grid(camera)
    fine_row, fine_col = ((np.arange(n * FINE) + 0.5) / FINE - 0.5 for n in (camera.rows, camera.cols))
    inside = (np.arange(BOARD_PARTS) + 0.5) / BOARD_PARTS / FINE - 0.5 / FINE
    images: dict[str, Array] = {}
    for channel in camera.quantum_efficiency:
        if images and not camera.lens.shifts_image:
            images[channel] = next(iter(images.values()))
            continue
        row, col = camera.lens.unshifted(coarse[0][:, None], coarse[1][None, :], channel, radiance)
        x0, y0 = camera.principal_point_px
        xd, yd = np.broadcast_arrays((col - x0) / camera.focal_length_px, (row - y0) / camera.focal_length_px)
        xu, yu = xd, yd
        for _ in range(6):
            r2 = xu * xu + yu * yu
            stretch = 1 + camera.distortion[0] * r2 + camera.distortion[1] * r2 * r2
            xu, yu = xd / stretch, yd / stretch
        # the ray meets the plane of normal turn[:, 2] through the centre
        depth = (turn[:, 2] @ centre) / (turn[0, 2] * xu + turn[1, 2] * yu + turn[2, 2])
        from_centre = xu * depth - centre[0], yu * depth - centre[1], depth - centre[2]
        across, down = (
            RectBivariateSpline(*coarse, sum(turn[k, axis] * from_centre[k] for k in range(3)) / texel_mm)
            for axis in (0, 1)
        )
        fine = np.zeros((camera.rows * FINE, camera.cols * FINE))
        for y, x in itertools.product(inside, inside):
            i = down(fine_row + y, fine_col + x) + texture.shape[0] / 2
            j = across(fine_row + y, fine_col + x) + texture.shape[1] / 2
            fine += squares_at(texture, i, j) / 4
        images[channel] = fine
    filtered = camera.lens.filtered(images, radiance, FINE)
    return {ch: camera.rate(radiance, ch) * (0.04 + 0.86 * image) for ch, image in filtered.items()}


def pattern(
    camera: ConcealedCamera,
    target: Array,
    radiance: Array,
    dark: float,
    cell_px: float = 4.0,
    turn_deg: float = TURN_DEG,
) -> dict[str, Array]:
    """Cells of `cell_px` on a screen, turned by `turn_deg`, of brightness `dark` to 1."""
    r = ((np.arange(camera.rows * FINE) + 0.5) / FINE - 0.5 - (camera.rows - 1) / 2)[:, None]
    c = ((np.arange(camera.cols * FINE) + 0.5) / FINE - 0.5 - (camera.cols - 1) / 2)[None, :]
    t = np.deg2rad(turn_deg)
    middle = (camera.rows - 1) / 2, (camera.cols - 1) / 2
    coarse = _coarse_grid(camera)
    shifted = camera.lens.shifts_image
    images: dict[str, Array] = {}
    for channel in camera.quantum_efficiency:
        if images and not shifted:
            images[channel] = next(iter(images.values()))
            continue
        down, right = r, c
        if shifted:
            sources = camera.lens.unshifted(coarse[0][:, None], coarse[1][None, :], channel, radiance)
            at = r[:, 0] + middle[0], c[0] + middle[1]
            down, right = (RectBivariateSpline(*coarse, m)(*at) - o for m, o in zip(sources, middle, strict=True))
        i = (down * np.cos(t) - right * np.sin(t)) / cell_px + target.shape[0] / 2
        j = (down * np.sin(t) + right * np.cos(t)) / cell_px + target.shape[1] / 2
        fine = _mean_of_squares(target, i, j, t, 1.0 / (FINE * cell_px))
        for law in camera.laws:
            fine = law.screen_pattern(fine, r, c)
        images[channel] = fine
    return {
        channel: camera.rate(radiance, channel) * (dark + (1 - dark) * image)
        for channel, image in camera.lens.filtered(images, radiance, FINE).items()
    }


def chart(camera: ConcealedCamera, light: Array, box: tuple[int, int, int, int]) -> dict[str, Array]:
    """Return a ColorChecker of published reflectances on a grey card; `box`: first and last row and column (row0, col0,
    row1, col1)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from colour import SDS_COLOURCHECKERS
    patches = [
        np.interp(WAVELENGTH_NM, p.wavelengths, p.values) for p in SDS_COLOURCHECKERS["BabelColor Average"].values()
    ]
    row0, col0, row1, col1 = box
    gap = max(1, round(0.01 * camera.rows))
    images = {}
    for channel in camera.quantum_efficiency:
        image = np.full((camera.rows, camera.cols), camera.rate(0.18 * light, channel))
        h, w = (row1 - row0) / 4, (col1 - col0) / 6
        for k, reflectance in enumerate(patches):
            i, j = divmod(k, 6)
            rows = slice(round(row0 + i * h) + gap, round(row0 + (i + 1) * h) - gap)
            cols = slice(round(col0 + j * w) + gap, round(col0 + (j + 1) * w) - gap)
            image[rows, cols] = camera.rate(reflectance * light, channel)
        images[channel] = image
    return camera.lens.filtered(images, light, 1)


def _mean_of_squares(picture: Array, row: Array, col: Array, turn_rad: float, side: float) -> Array:
    """Means of a picture's unit squares over squares of `side`, turned by `turn_rad`, about positions.

    One that lies within a single unit square has its value; others average parts, so that turned borders aren't jagged.
    """
    out = squares_at(picture, row, col)
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    reach = 0.5 * side * (abs(cos) + abs(sin))
    meets = (np.abs(row - np.round(row)) < reach) | (np.abs(col - np.round(col)) < reach)
    row, col = row[meets], col[meets]
    inside = ((np.arange(SCREEN_PARTS) + 0.5) / SCREEN_PARTS - 0.5) * side
    total = np.zeros(row.shape)
    for y, x in itertools.product(inside, inside):
        total += squares_at(picture, row + y * cos - x * sin, col + y * sin + x * cos)
    out[meets] = total / SCREEN_PARTS**2
    return out


def squares_at(picture: Array, row: Array, col: Array) -> Array:
    """Values of the unit squares of a picture in which positions lie, its first corner at (0, 0); 0 beyond it."""
    framed = np.pad(picture.astype(float), 1)
    i, j = (
        np.clip(np.floor(at).astype(np.int32), -1, count) + 1
        for at, count in zip((row, col), picture.shape, strict=True)
    )
    return np.asarray(framed[i, j])


def _coarse_grid(camera: ConcealedCamera) -> list[Array]:
    return [np.linspace(-2.0, n + 1.0, n // 6 + 4) for n in (camera.rows, camera.cols)]
