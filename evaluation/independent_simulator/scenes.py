"""Images of targets on the sensor, e-/s by channel before shading: edge, board, screen pattern, colour chart.

An edge is the integral of the line spread function along its normal; patterns are drawn on a grid four times finer than
the pixels. Cells of a whole number of pixels that stand square alias alike all over the frame: a screen is drawn finer
still, and what lies above the grid's frequencies is filtered out."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from evaluation.independent_simulator.camera import ConcealedCamera
from evaluation.independent_simulator.law import WAVELENGTH_NM, Array
from evaluation.independent_simulator.transfer import HIGHEST_CY_PX

FINE = 4  # samples a pixel of a pattern's image
BOARD_PARTS = 2  # parts along a side that a sample of a board averages
SUBSAMPLES = 4  # along a side of a sample of a screen
#: Weights of subsamples: of their mean over a sample, and of that mean taken three times. The latter passes a share of
#: 2e-3 of what aliases to 0.45 cy/px; the former passes 0.13.
ONCE = np.full(SUBSAMPLES, 1.0 / SUBSAMPLES)
THRICE = np.convolve(np.convolve(ONCE, ONCE), ONCE)
BLOCK_ROWS = 16  # rows of pixels of a screen that are drawn at a time
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
    r, c = ((np.arange(n * FINE) + 0.5) / FINE - 0.5 - (n - 1) / 2 for n in (camera.rows, camera.cols))
    t = np.deg2rad(turn_deg)
    middle = (camera.rows - 1) / 2, (camera.cols - 1) / 2
    coarse = _coarse_grid(camera)
    shifted = camera.lens.shifts_image
    images: dict[str, Array] = {}
    for channel in camera.quantum_efficiency:
        if images and not shifted:
            images[channel] = next(iter(images.values()))
            continue
        sources: list[RectBivariateSpline] = []
        if shifted:
            arriving = camera.lens.unshifted(coarse[0][:, None], coarse[1][None, :], channel, radiance)
            sources = [RectBivariateSpline(*coarse, m) for m in arriving]

        def cells(row: Array, col: Array, sources: list[RectBivariateSpline] = sources) -> tuple[Array, Array]:
            down, right = row[:, None], col[None, :]
            if sources:
                down, right = (m(row + middle[0], col + middle[1]) - o for m, o in zip(sources, middle, strict=True))
            i = (down * np.cos(t) - right * np.sin(t)) / cell_px + target.shape[0] / 2
            j = (down * np.sin(t) + right * np.cos(t)) / cell_px + target.shape[1] / 2
            return i, j

        fine, images[channel] = _drawn(target, cells, r, c, cell_px)
        for law in camera.laws:
            shown = law.screen_pattern(fine, r[:, None], c[None, :])
            fine, images[channel] = shown, images[channel] + (shown - fine)
    return {
        channel: camera.rate(radiance, channel) * (dark + (1 - dark) * image)
        for channel, image in camera.lens.filtered(images, radiance, FINE).items()
    }


def chart(
    camera: ConcealedCamera,
    light: Array,
    box: tuple[int, int, int, int],
    own: Callable[[Array, Array], Array] | None = None,
) -> dict[str, Array]:
    """Return a ColorChecker of published reflectances on a grey card; `box`: first and last row and column (row0, col0,
    row1, col1). `own`: maps wavelengths and published reflectances (patches, wavelengths) to the chart's own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from colour import SDS_COLOURCHECKERS
    patches = [
        np.interp(WAVELENGTH_NM, p.wavelengths, p.values) for p in SDS_COLOURCHECKERS["BabelColor Average"].values()
    ]
    if own is not None:
        patches = list(own(WAVELENGTH_NM, np.array(patches)))
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


def _drawn(
    target: Array,
    cells: Callable[[Array, Array], tuple[Array, Array]],
    row: Array,
    col: Array,
    cell_px: float,
) -> tuple[Array, Array]:
    """Return the means of a screen's cells over samples at `row` (n,) and `col` (m,), px: as they are, (n, m), and
    without what lies above the grid's highest frequency, which would alias.

    `cells`: maps rows and columns, px, to rows and columns of the pattern. Subsamples are joined by `THRICE`, and
    its response relative to that of `ONCE` is divided out."""
    step = 1.0 / (FINE * SUBSAMPLES)
    beyond = (len(THRICE) - SUBSAMPLES) // 2  # subsamples of the neighbours that a sample is joined with

    def subsamples(at: Array) -> Array:
        every = np.arange(-beyond, len(at) * SUBSAMPLES + beyond)
        return np.asarray(at[0] - 0.5 / FINE + (every + 0.5) * step)

    def joined(fine: Array, weights: Array) -> Array:
        first = (len(THRICE) - len(weights)) // 2
        for axis in (0, 1):
            count = (fine.shape[axis] - 2 * beyond) // SUBSAMPLES
            parts = (first + k + SUBSAMPLES * np.arange(count) for k in range(len(weights)))
            fine = sum(w * np.take(fine, part, axis) for w, part in zip(weights, parts, strict=True))
        return fine

    means, smooth = [], []
    for start in range(0, len(row), BLOCK_ROWS * FINE):
        at = subsamples(row[start : start + BLOCK_ROWS * FINE]), subsamples(col)
        fine = _mean_of_squares(target, *cells(*at), step / cell_px)
        means.append(joined(fine, ONCE))
        smooth.append(joined(fine, THRICE))
    pad = 24 * FINE
    padded = np.pad(np.concatenate(smooth), pad, mode="edge")
    fy, fx = np.fft.fftfreq(padded.shape[0], 1 / FINE)[:, None], np.fft.rfftfreq(padded.shape[1], 1 / FINE)[None, :]
    once = (np.sinc(fx / FINE) * np.sinc(fy / FINE)) / (np.sinc(fx * step) * np.sinc(fy * step))
    sharp = np.fft.irfft2(np.fft.rfft2(padded) / once**2, padded.shape)
    return np.concatenate(means), sharp[pad:-pad, pad:-pad]


def _mean_of_squares(picture: Array, row: Array, col: Array, side: float) -> Array:
    """Means of a picture's unit squares over squares of `side` < 1 about positions.

    The latter stand along the picture's axes: a turned one has the same second moments, and they are small."""
    out = squares_at(picture, row, col)
    meets = (np.abs(row - np.round(row)) < 0.5 * side) | (np.abs(col - np.round(col)) < 0.5 * side)
    row, col = row[meets], col[meets]
    # shares before the nearest border
    above, left = (np.clip((np.round(at) - at) / side + 0.5, 0.0, 1.0) for at in (row, col))
    total = np.zeros(row.shape)
    for y, high in ((-0.5, above), (0.5, 1.0 - above)):
        for x, wide in ((-0.5, left), (0.5, 1.0 - left)):
            total += high * wide * squares_at(picture, row + y * side, col + x * side)
    out[meets] = total
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
