"""Blur that differs over the field: every point of the scene spreads its own point spread function onto the pixels.

A picture on an ideal (undistorted) grid is carried to where the lens images it (`Distortion`), its light conserved, and from there
scattered with the lens table's point spread function of the *source's* field (`scatter`):

    image(x) = sum over sources s of light(s) PSF(x - s; field of s)

The picture is first averaged over the pixel's aperture, once for all: that is alike everywhere, and a lens changes too little across a
pixel to tell the order. It is then cut into tiles of sources, small where the lens changes fast. Between 4 x 4 nodes of a tile the
function of a source at s is a cubic polynomial in its row and column, sum_n L_n(s) PSF_n(x - s); a polynomial in s is one in x of the
same degree, tap by tap, so that what a tile gives a pixel is a blend of sixteen sums over the tile. PSF_n is sampled as the drawing is,
without what such samples can't hold, and has the sum that the light from there has: no source gains or loses. Only the pixels that are
asked for are computed. What the table's window doesn't hold (and what lies in its corners) is spread as 1 / r^3 beyond it, as
diffraction by an edge does.

Lengths are in um from the optical axis, x along columns (right), y along rows (down). Energy is conserved: the light of a source
arrives with the share 1, on or off the frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft
from scipy.interpolate import CubicSpline, RectBivariateSpline

from sim.optics.table import LensTable
from sim.scene.render import Grid
from sim.spectrum import FloatArray

Float32Array = NDArray[np.float32]

#: Nodes a tile and direction, less one: functions are polynomials of this degree across a tile.
DEGREE = 3
_NODES = np.arange(DEGREE + 1) / DEGREE
#: Sides (px) of the largest and the smallest tiles: they are cut in four until the polynomial's error is below the limit.
LARGEST_TILE_PX, SMALLEST_TILE_PX = 128, 12
#: Relative rms error of a function half way between nodes, and relative error of its light before that is put right.
KERNEL_ERROR = 2e-3
LIGHT_ERROR = 1e-4
#: The table is refined to so many samples a period of the highest frequency that is left in it, and heights so many times.
SAMPLES_PER_PERIOD = 3.0
#: Functions are cut off around the highest frequency of the drawing's samples, by a cosine so wide either way of it (as a share),
#: and reach so many samples at least, for what that makes ring.
ROLL_OFF = 0.3
LEAST_REACH = 8.0
HEIGHTS_REFINED = 8
#: Pixels of a row that are summed at once.
BLOCK_PX = 16
#: Half the side, px, of the squares on which what lies beyond the table's window is spread.
WING_CELL_PX = 4


@dataclass(frozen=True)
class Frame:
    """The pixels of an image: `rows` x `cols` of `pitch_um` with the optical axis at px `axis` [row, col]; the light-sensitive
    part is a centred square that takes `fill_factor` of the area."""

    rows: int
    cols: int
    pitch_um: float
    fill_factor: float
    axis: tuple[float, float]

    def um(self, row: FloatArray, col: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(x, y) in um from the axis."""
        return (col - self.axis[1]) * self.pitch_um, (row - self.axis[0]) * self.pitch_um

    def px(self, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(row, col) of points."""
        return y_um / self.pitch_um + self.axis[0], x_um / self.pitch_um + self.axis[1]


class Distortion:
    """Where a lens images what: from the ideal image point f tan(theta) to the centre of its point spread window, and back.

    A symmetric lens has a function of the radius, any other one of the plane. Beyond the table's outermost field they go on
    straight (or shifted alike): light there is `outside`.
    """

    def __init__(self, table: LensTable) -> None:
        self.symmetric = table.symmetric
        ideal = table.focal_length_mm * 1e3 * np.tan(np.deg2rad(table.field_deg))
        real = table.chief_mm * 1e3 + table.window_um
        if table.symmetric:
            self._ideal, self._real = ideal[:, 1], real[:, 1]
            # The ratio of the radii is even: a spline in the radius's square, from the first height on.
            square = self._ideal[1:] ** 2
            ratio = CubicSpline(square, self._real[1:] / self._ideal[1:])
            dense = np.sqrt(np.linspace(0.0, square[-1], 4001))
            real = dense * ratio(dense**2)
            # Beyond the last height it goes on straight, so that the frame's corners have no kink.
            slope = (real[-1] - real[-2]) / (dense[-1] - dense[-2])
            beyond = dense[-1] * np.linspace(1.0, 2.0, 1001)[1:]
            self._dense = np.append(dense, beyond), np.append(real, real[-1] + slope * (beyond - dense[-1]))
            self.reach_um = float(self._ideal[-1])
        else:
            fy, fx = table.grid_shape
            self._y, self._x = ideal[:, 1].reshape(fy, fx)[:, 0], ideal[:, 0].reshape(fy, fx)[0]
            degree_y, degree_x = min(3, fy - 1), min(3, fx - 1)
            self._to_x, self._to_y = (
                RectBivariateSpline(self._y, self._x, real[:, axis].reshape(fy, fx), kx=degree_y, ky=degree_x)
                for axis in (0, 1)
            )

    def real_um(self, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Image points of ideal points, of their broadcast shape."""
        if self.symmetric:
            return self._scaled(x_um, y_um, *self._dense)
        x, y = np.broadcast_arrays(x_um, y_um)
        held_x, held_y = np.clip(x, self._x[0], self._x[-1]), np.clip(y, self._y[0], self._y[-1])
        return (
            self._to_x(held_y, held_x, grid=False) + (x - held_x),
            self._to_y(held_y, held_x, grid=False) + (y - held_y),
        )

    def ideal_um(self, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The inverse of `real_um`, to 1e-6 um."""
        if self.symmetric:
            return self._scaled(x_um, y_um, *self._dense[::-1])
        x, y = np.broadcast_arrays(np.asarray(x_um, float), np.asarray(y_um, float))
        ideal_x, ideal_y = x.copy(), y.copy()
        for _ in range(40):
            at_x, at_y = self.real_um(ideal_x, ideal_y)
            ideal_x, ideal_y = ideal_x + (x - at_x), ideal_y + (y - at_y)
            if max(np.max(np.abs(x - at_x), initial=0.0), np.max(np.abs(y - at_y), initial=0.0)) < 1e-6:
                break
        return ideal_x, ideal_y

    def outside(self, x_um: FloatArray, y_um: FloatArray) -> NDArray[np.bool_]:
        """Whether ideal points lie beyond the table's outermost fields."""
        if self.symmetric:
            return np.asarray(np.hypot(x_um, y_um) > self.reach_um * (1.0 + 1e-9))
        within_x = (x_um >= self._x[0]) & (x_um <= self._x[-1])
        return np.asarray(~(within_x & (y_um >= self._y[0]) & (y_um <= self._y[-1])))

    def heights(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Of a symmetric lens: image radii (um, ascending, dense) and the place of each among `count` refined heights, 0..count-1."""
        ideal, real = self._dense
        place = np.interp(ideal, self._ideal, np.linspace(0.0, count - 1.0, self._ideal.size))
        return real, place

    def radial(self, most_um2: float) -> tuple[FloatArray, FloatArray, float]:
        """Of a symmetric lens: the ratio of image and ideal radius, and of areas there, at 8192 squares of the ideal radius up to
        `most_um2`, and their distance (um^2)."""
        ideal, real = self._dense
        square = np.linspace(0.0, most_um2 * 1.001, 8192)
        curve = CubicSpline(ideal[1:] ** 2, real[1:] / ideal[1:])
        ratio = curve(square)
        # d(r ratio)/dr = ratio + 2 r^2 d(ratio)/d(r^2)
        return ratio, ratio * (ratio + 2.0 * square * curve(square, 1)), float(square[1])

    def places(self, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of any other lens: the places (down, across) of image points among the table's field grid."""
        ideal_x, ideal_y = self.ideal_um(x_um, y_um)
        down = np.interp(ideal_y, self._y, np.arange(self._y.size))
        across = np.interp(ideal_x, self._x, np.arange(self._x.size))
        return down, across

    @staticmethod
    def _scaled(
        x_um: FloatArray, y_um: FloatArray, radius: FloatArray, becomes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        r = np.hypot(x_um, y_um)
        first = becomes[1] / radius[1]
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(r > radius[1], np.interp(r, radius, becomes) / r, first)
        ratio = np.where(r > radius[-1], becomes[-1] / radius[-1], ratio)
        return ratio * x_um, ratio * y_um


@lru_cache(maxsize=4)
def distortion(table: LensTable) -> Distortion:
    """A table's distortion, kept."""
    return Distortion(table)


def margin_px(table: LensTable, pitch_um: float) -> int:
    """Pixels around a frame from which light gets into it: half the table's window and the sampling's reach."""
    return int(np.ceil(0.5 * table.psf.shape[-1] * table.sample_pitch_um / pitch_um)) + 4


def source_grid(table: LensTable, frame: Frame, oversample: int, margin_px: int) -> Grid:
    """The ideal grid on which to draw what is imaged onto the frame and `margin_px` around it."""
    row = np.array([-margin_px, 0.5 * frame.rows, frame.rows - 1.0 + margin_px])
    col = np.array([-margin_px, 0.5 * frame.cols, frame.cols - 1.0 + margin_px])
    at = np.meshgrid(row, col, indexing="ij")
    ideal_row, ideal_col = frame.px(*distortion(table).ideal_um(*frame.um(*at)))
    moved = max(float(np.max(np.abs(ideal_row - at[0]))), float(np.max(np.abs(ideal_col - at[1]))))
    return Grid(frame.rows, frame.cols, oversample, margin_px + int(np.ceil(moved)) + 2)


def carry(picture: FloatArray, source: Grid, target: Grid, table: LensTable, frame: Frame) -> Float32Array:
    """A picture of even samples on the ideal grid `source`, carried to where the lens images it, on the grid `target`.

    Every sample's light, its value times the area that its square has in the image, is laid down around its image point with the
    weights of a cubic B-spline, which add up to 1: light is conserved. (`scatter` undoes the spline's blur.) A picture that is
    even stays so. What falls off the target is dropped.
    """
    lens = distortion(table)
    row, col = source.axes_px()
    first_row, first_col = (axis[0] for axis in target.axes_px())
    out = np.zeros(target.shape, np.float32)
    picture = _visible(picture, row, col, frame, lens)
    if lens.symmetric:
        x, y = frame.um(row, col)
        scale = target.oversample / frame.pitch_um
        origin = (
            (frame.axis[0] - first_row) * target.oversample,
            (frame.axis[1] - first_col) * target.oversample,
        )
        ratio, area, apart = lens.radial(float(np.max(np.abs(x))) ** 2 + float(np.max(np.abs(y))) ** 2)
        _lay_down_radially(out, picture, x, y, ratio, area, apart, scale, *origin)
        return out
    step = 2 * source.oversample
    nodes = [np.arange(-step, n + 2 * step, step, dtype=float) for n in (row.size, col.size)]
    node_row, node_col = (axis[0] + n / source.oversample for axis, n in zip((row, col), nodes, strict=True))
    at = np.meshgrid(node_row, node_col, indexing="ij")
    real_row, real_col = frame.px(*lens.real_um(*frame.um(*at)))
    _lay_down(
        out,
        picture,
        (real_row - first_row) * target.oversample,
        (real_col - first_col) * target.oversample,
        step,
    )
    return out


def _visible(picture: FloatArray, row: FloatArray, col: FloatArray, frame: Frame, lens: Distortion) -> FloatArray:
    """The picture without what the lens doesn't image, where the frame reaches beyond the lens's field."""
    if not _cut(frame, lens):
        return picture
    return np.where(lens.outside(*frame.um(row[:, None], col[None, :])), 0.0, picture)


def _cut(frame: Frame, lens: Distortion) -> bool:
    """Whether the frame's corners lie more than half a pixel beyond the lens's field (nearer, its outermost field stands)."""
    row, col = np.array([0.0, 0.0, frame.rows - 1.0, frame.rows - 1.0]), np.array([0.0, frame.cols - 1.0] * 2)
    x, y = lens.ideal_um(*frame.um(row, col))
    shrink = 1.0 - frame.pitch_um / np.maximum(np.hypot(x, y), frame.pitch_um)
    return bool(np.any(lens.outside(x * shrink, y * shrink)))


def illumination(
    table: LensTable, weight: FloatArray, frame: Frame, first: tuple[int, int] = (0, 0), period: int = 1
) -> FloatArray:
    """An even field's image, at every `period`-th row and column from pixel `first` on: sum over wavelengths of weight x relative illumination, by place in the image.

    `weight` (F, W): light of every wavelength of the table at every field (the same at all, or as filters pass it there).
    """
    lens = distortion(table)
    row, col = (np.arange(k, n, period, dtype=float) for k, n in zip(first, (frame.rows, frame.cols), strict=True))
    x, y = frame.um(row[:, None], col[None, :])
    image = over_field(table, np.sum(weight * table.relative_illumination.T, axis=1), x, y)
    if _cut(frame, lens):
        image = np.where(lens.outside(*lens.ideal_um(x, y)), 0.0, image)
    return image


def over_field(table: LensTable, value: FloatArray, x_um: FloatArray, y_um: FloatArray) -> FloatArray:
    """Smooth quantities of the table's fields (..., F) at image points: (..., *points)."""
    return field_function(table, value)(x_um, y_um)


def field_function(table: LensTable, value: FloatArray) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """`over_field` as a function of points: cubic in the square of the height, or in row and column of the field grid; held beyond."""
    lens = distortion(table)
    if table.symmetric:
        square = (table.focal_length_mm * 1e3 * np.tan(np.deg2rad(table.field_deg[:, 1]))) ** 2
        curve = CubicSpline(square, value, axis=-1)

        def along_radius(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            ideal_x, ideal_y = lens.ideal_um(x_um, y_um)
            return np.asarray(curve(np.minimum(ideal_x**2 + ideal_y**2, square[-1])))

        return along_radius
    fy, fx = table.grid_shape
    splines = [
        RectBivariateSpline(np.arange(fy), np.arange(fx), one.reshape(fy, fx), kx=min(3, fy - 1), ky=min(3, fx - 1))
        for one in value.reshape(-1, fy * fx)
    ]

    def over_plane(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
        places = lens.places(x_um, y_um)
        return np.stack([spline(*places, grid=False) for spline in splines]).reshape(
            *value.shape[:-1], *places[0].shape
        )

    return over_plane


@dataclass(frozen=True)
class Tile:
    """Sources of the rows top..bottom and the columns left..right, in px of the frame."""

    top: int
    bottom: int
    left: int
    right: int

    def place(self, down: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(row, col) in px of places 0..1 in it."""
        return self.top - 0.5 + down * (self.bottom - self.top), self.left - 0.5 + across * (self.right - self.left)

    def quarters(self) -> list[Tile]:
        """Cut in four."""
        row, col = (self.top + self.bottom) // 2, (self.left + self.right) // 2
        return [
            Tile(top, bottom, left, right)
            for top, bottom in ((self.top, row), (row, self.bottom))
            for left, right in ((self.left, col), (col, self.right))
        ]


class Kernels:
    """The point spread functions of some channels, ready to be turned, placed and sampled.

    `weight` (C, F, W): light of every channel, field and wavelength of the table. Tables are summed over wavelength with the
    relative illumination, cut to the window's circle, refined by Fourier series (less what the drawing's samples can't hold), and over
    the heights of a symmetric lens by cubic splines. `light` (C, F) is all of a source's light, `lost` (C, F) what lies outside the circle.
    """

    def __init__(self, table: LensTable, weight: FloatArray, frame: Frame, oversample: int, *, carried: bool) -> None:
        self.table, self.frame, self.oversample = table, frame, oversample
        self.lens = distortion(table)
        n = table.psf.shape[-1]
        self.radius_um = 0.5 * n * table.sample_pitch_um
        light = weight * table.relative_illumination.T  # (C, F, W)
        self.light = np.sum(light, axis=2)
        psf = np.stack([light[:, f] @ table.psf[:, f].reshape(-1, n * n) for f in range(light.shape[1])])
        at = (np.arange(n) - 0.5 * (n - 1)) * table.sample_pitch_um
        # An edge of two samples, so that the circle has no teeth.
        inside = np.clip(
            (self.radius_um - np.hypot(at[:, None], at[None, :])) / (2.0 * table.sample_pitch_um), 0.0, 1.0
        )
        psf *= inside.ravel()
        self.lost = self.light - np.sum(psf, axis=2).T
        self.held = field_function(table, self.light - self.lost)
        if table.symmetric and len(psf) > 3:
            heights = np.arange(len(psf), dtype=float)
            dense = np.linspace(0.0, heights[-1], HEIGHTS_REFINED * (len(psf) - 1) + 1)
            psf = CubicSpline(heights, psf)(dense)
        # What the samples can't hold is taken away gently, so that little rings: no farther than a few samples.
        self.step_um = frame.pitch_um / oversample
        self.reach_um = max(self.radius_um, LEAST_REACH * self.step_um)
        around = int(np.ceil((self.reach_um - self.radius_um) / table.sample_pitch_um))
        psf = np.pad(psf.reshape(*psf.shape[:2], n, n), [(0, 0), (0, 0), (around, around), (around, around)])
        n += 2 * around
        # Samples are per area from here on; a frame of zeros for the interpolation at the rim.
        finest = 0.5 / self.step_um
        shortest = float(np.min(table.wavelength_nm)) * 1e-3 * table.f_number
        refine = max(
            1, int(np.ceil(table.sample_pitch_um * SAMPLES_PER_PERIOD * min((1.0 + ROLL_OFF) * finest, 1.0 / shortest)))
        )
        self.sample_um = table.sample_pitch_um / refine
        f = fft.fftfreq(n * refine, self.sample_um)
        beyond = np.hypot(f[:, None], f[None, : n * refine // 2 + 1]) / finest
        passed = 0.5 + 0.5 * np.cos(np.pi * np.clip((beyond - 1.0 + ROLL_OFF) / (2.0 * ROLL_OFF), 0.0, 1.0))
        # What is interpolated with cubic B-splines are the splines' coefficients.
        inverse = 3.0 / (2.0 + np.cos(2.0 * np.pi * fft.fftfreq(n * refine)))
        spline = (
            inverse[:, None] * inverse[None, : n * refine // 2 + 1] * passed * (refine / table.sample_pitch_um) ** 2
        )
        spline = spline.astype(np.float32)
        # Four channels to a sample, used or not, which the processor adds at once.
        self.channels = len(light)
        self.samples = np.zeros((len(psf), n * refine + 4, n * refine + 4, 4), np.float32)
        for field, functions in enumerate(psf.astype(np.float32)):
            spectrum = _padded(fft.rfft2(functions), n, refine)
            spectrum *= spline
            self.samples[field, 2:-2, 2:-2, : self.channels] = np.moveaxis(
                fft.irfft2(spectrum, (n * refine, n * refine)), 0, -1
            )
        self.first_um = -0.5 * (n - 1) * table.sample_pitch_um - 2.0 * self.sample_um  # of the padded table's sample 0
        # Full pixels are put into the functions: the sums over a pixel's samples then leave no source with less light than another,
        # whatever the lens changes in between. Pixels with gaps don't conserve light anyway, and are put into the picture.
        self.box = oversample if frame.fill_factor == 1.0 else 1
        reach = self.reach_um / self.step_um + 1.0 + 0.5 * (self.box - 1)
        self.size = int(np.ceil(2.0 * reach))
        if (self.size - oversample) % 2:  # a pixel's centre has as many samples on either side
            self.size += 1
        # Sources farther than this from the frame don't reach it.
        self.halo_px = -(-((self.size - oversample) // 2) // oversample)
        self._undo = 5 if carried else 1
        self._kept: dict[Tile, Float32Array] = {}

    def through_pixels(self, picture: Float32Array) -> Float32Array:
        """A picture with the blur of its own samples (and of `carry`) undone, as the pixels' aperture averages it where that isn't in
        the functions: after the former, a full pixel is just the mean of its samples."""
        s, side, undo = self.oversample, np.sqrt(self.frame.fill_factor), self._undo
        if self.box > 1:
            side, undo = 0.0, undo - 1
        if undo == 0:
            return picture
        shape = [fft.next_fast_len(n) for n in picture.shape]
        fy, fx = fft.fftfreq(shape[0], 1.0 / s), fft.rfftfreq(shape[1], 1.0 / s)
        down, across = ((np.sinc(side * f) / np.sinc(f / s) ** undo).astype(np.float32) for f in (fy, fx))
        spectrum = fft.rfft2(picture, shape)
        spectrum *= down[:, None]
        spectrum *= across
        return np.asarray(fft.irfft2(spectrum, shape, overwrite_x=True)[: picture.shape[0], : picture.shape[1]])

    def at(self, x_um: FloatArray, y_um: FloatArray) -> Float32Array:
        """Functions of sources at image points (N,): (N, C, size, size), what a pixel gets of the light on its k-th sample's square."""
        table, size = self.table, self.size - self.box + 1
        # The sample of index k lies (k - (size - 1) / 2) steps from the pixel's centre.
        offset = (np.arange(size) - 0.5 * (size - 1)) * self.step_um
        sampled = np.zeros((x_um.size, self.channels, size, size), np.float32)
        if table.symmetric:
            radius, place = self.lens.heights(len(self.samples))
            r = np.hypot(x_um, y_um)
            down, across, columns = np.interp(r, radius, place), np.zeros(r.size), 1
            turn = np.arctan2(x_um, y_um)
        else:
            down, across = self.lens.places(x_um, y_um)
            turn, columns = np.zeros(x_um.size), table.grid_shape[1]
        _sample(sampled, down, across, columns, np.cos(turn), np.sin(turn), offset, self.samples, self.first_um,
                self.sample_um, self.reach_um)  # fmt: skip
        # Sampling leaves 1e-5 of the light; each channel gets its own, where its function has any.
        functions = np.zeros((x_um.size, self.channels, self.size, self.size), np.float32)
        _finish(sampled, self.box, (self.step_um / self.box) ** 2, self.held(x_um, y_um), functions)
        return functions

    def at_nodes(self, tile: Tile) -> Float32Array:
        """Functions at a tile's nodes, (4, 4, C, size, size). Those that `tiles` found good enough are handed out once."""
        if tile in self._kept:
            return self._kept.pop(tile)
        nodes = self.at(*self.frame.um(*(a.ravel() for a in tile.place(*np.meshgrid(_NODES, _NODES, indexing="ij")))))
        return nodes.reshape(_NODES.size, _NODES.size, *nodes.shape[1:])

    def error(self, tile: Tile, at_nodes: Float32Array) -> float:
        """Error of a tile's polynomials half way between nodes, as a share of what is allowed: the worst of a few places."""
        nodes, worst = at_nodes.reshape(_NODES.size**2, -1), 0.0
        down, across = (np.array(a) / DEGREE for a in ((0.5, 2.5, 0.5, 2.5), (0.5, 0.5, 2.5, 2.5)))
        wanted = self.at(*self.frame.um(*tile.place(down, across)))
        share = np.einsum("ip,jp->pij", lagrange(down), lagrange(across)).reshape(down.size, -1).astype(np.float32)
        off = (share @ nodes).reshape(wanted.shape) - wanted
        norm, away = (np.sqrt(np.sum(k**2, axis=(2, 3))) for k in (wanted, off))
        whole, gained = (np.abs(np.sum(k, axis=(2, 3), dtype=float)) for k in (wanted, off))
        for error, of, limit in ((away, norm, KERNEL_ERROR), (gained, whole, LIGHT_ERROR)):
            worst = max(worst, float(np.max(error / np.maximum(of, 1e-30))) / limit)
        return worst

    def tiles(self, grid: Grid) -> list[Tile]:
        """Tiles that cover what reaches the frame, as large as the polynomials are good enough in them."""
        margin = min(grid.margin_px, self.halo_px)
        bounds = (
            np.linspace(-margin, n + margin, max(1, round((n + 2 * margin) / LARGEST_TILE_PX)) + 1)
            for n in (grid.rows, grid.cols)
        )
        rows, cols = (edge.round().astype(int).tolist() for edge in bounds)
        return [
            part
            for top, bottom in pairwise(rows)
            for left, right in pairwise(cols)
            for part in self._good(Tile(top, bottom, left, right))
        ]

    def _good(self, tile: Tile) -> Iterator[Tile]:
        """A tile, or the parts of it in which the polynomials are good enough."""
        nodes = self.at_nodes(tile)
        if min(tile.bottom - tile.top, tile.right - tile.left) < 2 * SMALLEST_TILE_PX or self.error(tile, nodes) <= 1.0:
            self._kept[tile] = nodes
            yield tile
        else:
            for part in tile.quarters():
                yield from self._good(part)


def scatter(
    picture: Float32Array,
    grid: Grid,
    kernels: Kernels,
    places: Sequence[Sequence[tuple[int, int]]],
    period: int,
    image: FloatArray,
    tiles: Sequence[Tile] | None = None,
) -> None:
    """Add to `image` (rows, cols) what a picture on the image's grid (see `carry`) gives the pixels of every channel.

    `places`: for every channel of `kernels`, the first [row, col] of each of its lattices of `period` px; only those pixels change.
    `tiles` None: as large as the kernels' polynomials allow.
    """
    frame, s = kernels.frame, grid.oversample
    half = (kernels.size - s) // 2  # samples before a pixel's first
    halo = kernels.halo_px
    if grid.margin_px < halo:
        raise ValueError(
            f"the margin of {grid.margin_px} px is below the limit of {halo} px that the lens's window of {2 * kernels.radius_um:g} um asks for: take a wider margin"
        )
    seen = kernels.through_pixels(picture)
    taps = _taps_in_circle(kernels)
    for tile in kernels.tiles(grid) if tiles is None else tiles:
        top, bottom, left, right = tile.top, tile.bottom, tile.left, tile.right
        g = _by_pixel(kernels.at_nodes(tile), kernels, bottom - top, right - left)
        # The tile's sources alone, with nothing around them, columns sorted by their place in the lattice.
        origin = (top - halo) * s - half, (left - halo) * s - half
        high = (bottom + halo) * s + half - origin[0]
        stride = period * s
        # Wider by the taps that fill up a row's fours, and by the pixels that fill up the last block.
        wide = (right + halo) * s + half + 4 - origin[1] + BLOCK_PX * stride
        local = np.zeros((high, -(-wide // stride) * stride), np.float32)
        part = seen[
            (top + grid.margin_px) * s : (bottom + grid.margin_px) * s,
            (left + grid.margin_px) * s : (right + grid.margin_px) * s,
        ]
        down, across = top * s - origin[0], left * s - origin[1]
        owed = _owed(kernels, tile, part.shape)
        local[down : down + part.shape[0], across : across + part.shape[1]] = part if owed is None else part * owed
        columns = np.ascontiguousarray(local.reshape(high, -1, stride).transpose(2, 0, 1))
        seen_rows = max(top - halo, 0), min(bottom + halo, frame.rows)
        seen_cols = max(left - halo, 0), min(right + halo, frame.cols)
        for channel, lattices in enumerate(places):
            for row0, col0 in lattices:
                first = seen_rows[0] + (row0 - seen_rows[0]) % period, seen_cols[0] + (col0 - seen_cols[0]) % period
                _gather(
                    image, columns, g[channel], taps, (first[0], seen_rows[1]), (first[1], seen_cols[1]), period, s,
                    (half + origin[0], half + origin[1]), (top - 0.5, bottom - 0.5), (left - 0.5, right - 0.5),
                )  # fmt: skip
    _spread_wings(picture, grid, kernels, places, period, image)


def _taps_in_circle(kernels: Kernels) -> NDArray[np.int64]:
    """(size, 2): of every row of a kernel, the first tap that may differ from 0 and the one after the last, by fours."""
    away = np.arange(kernels.size) - 0.5 * (kernels.size - 1)
    radius = kernels.reach_um / kernels.step_um + (kernels.box - 1) / np.sqrt(2.0)
    wide = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    first = np.ceil(0.5 * (kernels.size - 1) - wide).astype(np.int64)
    count = np.where(wide > 0, kernels.size - 2 * first, 0)
    return np.stack([first, first + count + (-count) % 4], axis=1)


def _owed(kernels: Kernels, tile: Tile, shape: tuple[int, ...]) -> Float32Array | None:
    """What a tile's sources are to be multiplied with, so that their light isn't the polynomials' but the table's: of 17 x 17
    points, straight between them. None where the channels' light has both signs, so that there's no ratio."""
    if np.min(kernels.light) < 0 or np.min(np.sum(kernels.light - kernels.lost, axis=0)) <= 0:
        return None
    at = np.linspace(0.0, 1.0, 17)
    light = [
        np.sum(kernels.held(*kernels.frame.um(*tile.place(*np.meshgrid(t, t, indexing="ij")))), axis=0)
        for t in (at, _NODES)
    ]
    share = lagrange(at)
    ratio = light[0] / (share.T @ light[1] @ share)
    down, across = (
        np.maximum(1.0 - np.abs((np.arange(n) + 0.5)[:, None] * (at.size - 1) / n - np.arange(at.size)), 0.0)
        for n in shape
    )
    return np.asarray(down @ ratio @ across.T, np.float32)


def _by_pixel(at_nodes: Float32Array, kernels: Kernels, height: int, width: int) -> Float32Array:
    """(C, 4, 4, size, size) from a tile's nodes' (4, 4, C, size, size): polynomials in the place of the *pixel* instead of the source.

    L_i(t + tau) = sum_m L_i(t_m + tau) L_m(t) with the nodes t_m: what is a polynomial in the source's place, tau from the
    pixel's, is one in the pixel's.
    """
    tau_px = (np.arange(kernels.size) - 0.5 * (kernels.size - 1)) / kernels.oversample
    by_row, by_col = (
        np.moveaxis(lagrange(_NODES[:, None] + tau_px[None, :] / n), 0, -1).astype(np.float32)  # [node, tap, i]
        for n in (height, width)
    )
    g = np.einsum("mai,ijcab->mjcab", by_row, at_nodes)
    return np.ascontiguousarray(np.einsum("kbj,mjcab->cmkab", by_col, g))


def _padded(spectrum: NDArray[np.complex64], n: int, refine: int) -> NDArray[np.complex64]:
    """A real FFT of n x n samples, zero-padded to refine times as many; the samples' places stay where they were."""
    if refine == 1:
        return spectrum
    out = np.zeros((*spectrum.shape[:-2], n * refine, n * refine // 2 + 1), spectrum.dtype)
    half = n // 2
    spectrum = spectrum.copy()
    if n % 2 == 0:  # the highest frequency stands for both signs
        spectrum[..., half, :] *= 0.5
        spectrum[..., :, half] *= 0.5
        out[..., half, : half + 1] = spectrum[..., half, :]
        out[..., -half, : half + 1] = spectrum[..., half, :]
        out[..., :half, : half + 1] = spectrum[..., :half, :]
        out[..., -half + 1 :, : half + 1] = spectrum[..., half + 1 :, :]
    else:
        out[..., : half + 1, : half + 1] = spectrum[..., : half + 1, :]
        out[..., -half:, : half + 1] = spectrum[..., half + 1 :, :]
    return out


def lagrange(t: FloatArray) -> FloatArray:
    """Weights of the DEGREE + 1 nodes of a tile for places t (0..1 across it): (DEGREE + 1, *t.shape)."""
    return np.stack([np.prod([(t - b) / (a - b) for b in _NODES if b != a], axis=0) for a in _NODES])


def _spread_wings(
    picture: Float32Array,
    grid: Grid,
    kernels: Kernels,
    places: Sequence[Sequence[tuple[int, int]]],
    period: int,
    image: FloatArray,
) -> None:
    """What the table's circle of radius a doesn't hold, as a / (2 pi r^3) per area beyond it, on cells of a few pixels."""
    frame, table = kernels.frame, kernels.table
    if not np.any(np.abs(kernels.lost) > 1e-9 * np.abs(kernels.lost).max(initial=0.0)):
        return
    cell = WING_CELL_PX * grid.oversample
    whole = [n // cell * cell for n in picture.shape]  # some of the margin is left out
    light = (
        picture[: whole[0], : whole[1]].reshape(whole[0] // cell, cell, -1, cell).sum(axis=3).sum(axis=1, dtype=float)
    )
    light /= grid.oversample**2  # in pixels' light
    rows, cols = light.shape
    middle = (0.5 * (WING_CELL_PX - 1)) - grid.margin_px
    row, col = np.arange(rows) * WING_CELL_PX + middle, np.arange(cols) * WING_CELL_PX + middle
    kernel = _wing(rows, cols, WING_CELL_PX * frame.pitch_um, kernels.radius_um)
    shape = tuple(fft.next_fast_len(2 * n, real=True) for n in light.shape)
    transfer = fft.rfft2(kernel, shape)
    x, y = frame.um(row[:, None], col[None, :])
    at_row = (np.arange(frame.rows) - row[0]) / WING_CELL_PX
    at_col = (np.arange(frame.cols) - col[0]) / WING_CELL_PX
    for lattices, lost in zip(places, kernels.lost, strict=True):
        share = over_field(table, lost, *np.broadcast_arrays(x, y))
        spread = fft.irfft2(fft.rfft2(light * share, shape) * transfer, shape)[
            rows - 1 : 2 * rows - 1, cols - 1 : 2 * cols - 1
        ]
        spread = spread / WING_CELL_PX**2
        for row0, col0 in lattices:
            image[row0::period, col0::period] += _bilinear(spread, at_row[row0::period], at_col[col0::period])


def _wing(rows: int, cols: int, cell_um: float, radius_um: float) -> FloatArray:
    """Share of a cell's light in every cell around it, (2 rows - 1, 2 cols - 1), cells sampled 8 x 8 where they matter."""
    y, x = (np.arange(1 - n, n) * cell_um for n in (rows, cols))
    r = np.hypot(y[:, None], x[None, :])
    out = np.where(r > 0, radius_um * cell_um**2 / (2.0 * np.pi * np.maximum(r, 1e-9) ** 3), 0.0)
    near = int(np.ceil(2.0 * radius_um / cell_um)) + 2
    fine = ((np.arange(16) + 0.5) / 16 - 0.5) * cell_um
    for i in range(-min(near, rows - 1), min(near, rows - 1) + 1):
        for j in range(-min(near, cols - 1), min(near, cols - 1) + 1):
            d = np.hypot(i * cell_um + fine[:, None], j * cell_um + fine[None, :])
            density = np.where(d > radius_um, radius_um / (2.0 * np.pi * np.maximum(d, radius_um) ** 3), 0.0)
            out[rows - 1 + i, cols - 1 + j] = float(np.mean(density)) * cell_um**2
    return out


def _bilinear(values: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
    i = np.clip(row.astype(int), 0, values.shape[0] - 2)
    j = np.clip(col.astype(int), 0, values.shape[1] - 2)
    v, u = (row - i)[:, None], (col - j)[None, :]
    above = values[i][:, j] * (1 - u) + values[i][:, j + 1] * u
    below = values[i + 1][:, j] * (1 - u) + values[i + 1][:, j + 1] * u
    return above * (1 - v) + below * v


# --- compiled loops ------------------------------------------------------------------------------------------------------


@njit(cache=True)
def _lay_down(out, picture, node_row, node_col, step):  # type: ignore[no-untyped-def]
    """Lay every sample's light (value x the determinant of the map) around its image point; the map is bilinear between nodes."""
    ny, nx = picture.shape
    inverse = 1.0 / step
    for i in range(ny):
        a = i // step + 1
        v = (i - (a - 1) * step) * inverse
        for j in range(nx):
            value = picture[i, j]
            if value == 0.0:
                continue
            b = j // step + 1
            u = (j - (b - 1) * step) * inverse
            r00, r01, r10, r11 = node_row[a, b], node_row[a, b + 1], node_row[a + 1, b], node_row[a + 1, b + 1]
            c00, c01, c10, c11 = node_col[a, b], node_col[a, b + 1], node_col[a + 1, b], node_col[a + 1, b + 1]
            row_v = ((r10 - r00) * (1.0 - u) + (r11 - r01) * u) * inverse
            row_u = ((r01 - r00) * (1.0 - v) + (r11 - r10) * v) * inverse
            col_v = ((c10 - c00) * (1.0 - u) + (c11 - c01) * u) * inverse
            col_u = ((c01 - c00) * (1.0 - v) + (c11 - c10) * v) * inverse
            row = (r00 * (1.0 - u) + r01 * u) * (1.0 - v) + (r10 * (1.0 - u) + r11 * u) * v
            col = (c00 * (1.0 - u) + c01 * u) * (1.0 - v) + (c10 * (1.0 - u) + c11 * u) * v
            light = value * abs(row_v * col_u - row_u * col_v)
            _drop(out, row, col, light)


@njit(cache=True)
def _lay_down_radially(out, picture, x_um, y_um, ratio, area, apart, scale, row0, col0):  # type: ignore[no-untyped-def]
    """`_lay_down` for a map along the radius, from tables over the radius's square."""
    inverse = 1.0 / apart
    for i in range(y_um.size):
        for j in range(x_um.size):
            value = picture[i, j]
            if value == 0.0:
                continue
            at = (x_um[j] * x_um[j] + y_um[i] * y_um[i]) * inverse
            k = int(at)
            t = at - k
            by = ratio[k] + t * (ratio[k + 1] - ratio[k])
            light = value * (area[k] + t * (area[k + 1] - area[k]))
            _drop(out, row0 + y_um[i] * by * scale, col0 + x_um[j] * by * scale, light)


@njit(cache=True, inline="always")
def _drop(out, row, col, light):  # type: ignore[no-untyped-def]
    """Spread light around a point with a cubic B-spline."""
    k, m = int(np.floor(row)), int(np.floor(col))
    if k >= 1 and m >= 1 and k < out.shape[0] - 2 and m < out.shape[1] - 2:
        a0, a1, a2, a3 = _spline_weights(row - k)
        b0, b1, b2, b3 = _spline_weights(col - m)
        _add_four(out, k - 1, m - 1, light * a0, b0, b1, b2, b3)
        _add_four(out, k, m - 1, light * a1, b0, b1, b2, b3)
        _add_four(out, k + 1, m - 1, light * a2, b0, b1, b2, b3)
        _add_four(out, k + 2, m - 1, light * a3, b0, b1, b2, b3)


@njit(cache=True, inline="always")
def _add_four(out, k, m, light, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    out[k, m] += light * b0
    out[k, m + 1] += light * b1
    out[k, m + 2] += light * b2
    out[k, m + 3] += light * b3


@njit(cache=True, inline="always")
def _spline_weights(t):  # type: ignore[no-untyped-def]
    """Cubic B-spline at the samples -1, 0, 1, 2 around a point t beyond sample 0."""
    s = 1.0 - t
    return (
        s * s * s / 6.0,
        (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
        t * t * t / 6.0,
    )


@njit(cache=True)
def _sample(  # type: ignore[no-untyped-def]  # noqa: PLR0912
    raw, down, across, columns, cosine, sine, offset, samples, first, step, radius
):
    """Functions turned by an angle, at minus the offsets: linear between the four fields around (down, across), by cubic B-splines
    between samples. A symmetric lens's have (0, 1) of the table in the direction (sine, cosine) [x, y]."""
    channels = raw.shape[1]
    rows = samples.shape[0] // columns
    fields, shares = np.empty(4, np.int64), np.empty(4)
    # The fields are blended first.
    blend = np.zeros((samples.shape[1], samples.shape[2], 4), np.float32)
    value = np.empty(4, np.float32)
    highest = samples.shape[1] - 2.001
    for n in range(down.size):
        p, q = min(int(down[n]), max(rows - 2, 0)), min(int(across[n]), max(columns - 2, 0))
        v, u = down[n] - p, across[n] - q
        used = 0
        for i in range(2):
            for j in range(2):
                share = (v if i else 1.0 - v) * (u if j else 1.0 - u)
                if share > 0.0:
                    fields[used], shares[used] = (p + i) * columns + q + j, share
                    used += 1
        blend[:] = 0.0
        for f in range(used):
            share = np.float32(shares[f])
            for i in range(samples.shape[1]):
                for j in range(samples.shape[2]):
                    for c in range(4):
                        blend[i, j, c] += share * samples[fields[f], i, j, c]
        for i in range(offset.size):
            for j in range(offset.size):
                x, y = -offset[j], -offset[i]
                if x * x + y * y >= radius * radius:
                    continue
                row = (x * sine[n] + y * cosine[n] - first) / step
                col = (x * cosine[n] - y * sine[n] - first) / step
                if row < 1.0 or col < 1.0 or row > highest or col > highest:
                    continue
                k, m = int(row), int(col)
                weight_row, weight_col = _spline_weights(row - k), _spline_weights(col - m)
                b0, b1 = np.float32(weight_col[0]), np.float32(weight_col[1])
                b2, b3 = np.float32(weight_col[2]), np.float32(weight_col[3])
                value[:] = 0.0
                for a in range(4):
                    w = np.float32(weight_row[a])
                    for c in range(4):
                        value[c] += w * (
                            b0 * blend[k - 1 + a, m - 1, c]
                            + b1 * blend[k - 1 + a, m, c]
                            + b2 * blend[k - 1 + a, m + 1, c]
                            + b3 * blend[k - 1 + a, m + 2, c]
                        )
                for c in range(channels):
                    raw[n, c, i, j] = value[c]


@njit(cache=True)
def _finish(sampled, box, scale, light, out):  # type: ignore[no-untyped-def]
    """Functions times `scale`, summed over box x box samples, and with the `light` (C, N) that they are to have."""
    size = sampled.shape[2]
    across = np.empty((size, out.shape[2]), np.float32)
    for n in range(sampled.shape[0]):
        for c in range(sampled.shape[1]):
            across[:] = 0.0
            for i in range(size):
                for k in range(box):
                    for j in range(size):
                        across[i, j + k] += sampled[n, c, i, j]
            for i in range(size):
                for k in range(box):
                    for j in range(out.shape[3]):
                        out[n, c, i + k, j] += across[i, j]
            held, weight = 0.0, 0.0
            for i in range(out.shape[2]):
                for j in range(out.shape[3]):
                    value = np.float32(scale) * out[n, c, i, j]
                    out[n, c, i, j] = value
                    held += value
                    weight += abs(value)
            share = np.float32((light[c, n] - held) / max(weight, 1e-300))
            for i in range(out.shape[2]):
                for j in range(out.shape[3]):
                    out[n, c, i, j] += share * abs(out[n, c, i, j])


@njit(cache=True, inline="always")
def _cubic(t, out):  # type: ignore[no-untyped-def]
    """`lagrange` for a degree of 3."""
    a, b, c, d = t, t - 1.0 / 3.0, t - 2.0 / 3.0, t - 1.0
    out[0] = -4.5 * b * c * d
    out[1] = 13.5 * a * c * d
    out[2] = -13.5 * a * b * d
    out[3] = 4.5 * a * b * c


@njit(cache=True, fastmath={"contract"})
def _gather(image, columns, g, within, rows, cols, period, oversample, origin, row_range, col_range):  # type: ignore[no-untyped-def]
    """Add what a tile gives the pixels of one lattice: kernels blended for a row, then four sums a pixel blended along it.

    `columns` [k, row, i] is the tile's column stride i + k: neighbouring pixels of the lattice lie side by side in it. `origin`:
    its first row and column, in samples from the first that pixel 0 takes. `within`: a kernel's taps, row by row. `row_range`, `col_range`: where the tile lies, px.
    """
    size = g.shape[2]
    stride = period * oversample
    count = (cols[1] - cols[0] + period - 1) // period
    if count <= 0:
        return
    # The tile's samples are reached by unsigned offsets into one flat array: views would be counted, signs looked at.
    flat = columns.ravel()
    plane, line = columns.shape[1] * columns.shape[2], columns.shape[2]
    blend = np.zeros((4, size, size + 4), np.float32)
    share = np.empty(4)
    blocks = (count + BLOCK_PX - 1) // BLOCK_PX
    sums = np.empty((4, blocks * BLOCK_PX), np.float32)
    height, width = row_range[1] - row_range[0], col_range[1] - col_range[0]
    fine_col = cols[0] * oversample - origin[1]
    for row in range(rows[0], rows[1], period):
        _cubic((row - row_range[0]) / height, share)
        w0, w1, w2, w3 = np.float32(share[0]), np.float32(share[1]), np.float32(share[2]), np.float32(share[3])
        for j in range(4):
            for a in range(size):
                for b in range(size):
                    blend[j, a, b] = w0 * g[0, j, a, b] + w1 * g[1, j, a, b] + w2 * g[2, j, a, b] + w3 * g[3, j, a, b]
        sums[:] = 0.0
        base = row * oversample - origin[0]
        for a in range(size):
            at = (base + a) * line
            for b in range(within[a, 0], within[a, 1], 4):
                q = fine_col + b
                o0 = np.uintp((q % stride) * plane + at + q // stride)
                o1 = np.uintp(((q + 1) % stride) * plane + at + (q + 1) // stride)
                o2 = np.uintp(((q + 2) % stride) * plane + at + (q + 2) // stride)
                o3 = np.uintp(((q + 3) % stride) * plane + at + (q + 3) // stride)
                a0, a1, a2, a3 = blend[0, a, b], blend[0, a, b + 1], blend[0, a, b + 2], blend[0, a, b + 3]
                b0, b1, b2, b3 = blend[1, a, b], blend[1, a, b + 1], blend[1, a, b + 2], blend[1, a, b + 3]
                c0, c1, c2, c3 = blend[2, a, b], blend[2, a, b + 1], blend[2, a, b + 2], blend[2, a, b + 3]
                d0, d1, d2, d3 = blend[3, a, b], blend[3, a, b + 1], blend[3, a, b + 2], blend[3, a, b + 3]
                for i in range(blocks * BLOCK_PX):
                    n = np.uintp(i)
                    p0, p1, p2, p3 = flat[o0 + n], flat[o1 + n], flat[o2 + n], flat[o3 + n]
                    sums[0, n] += a0 * p0 + a1 * p1 + a2 * p2 + a3 * p3
                    sums[1, n] += b0 * p0 + b1 * p1 + b2 * p2 + b3 * p3
                    sums[2, n] += c0 * p0 + c1 * p1 + c2 * p2 + c3 * p3
                    sums[3, n] += d0 * p0 + d1 * p1 + d2 * p2 + d3 * p3
        for i in range(count):
            col = cols[0] + i * period
            _cubic((col - col_range[0]) / width, share)
            image[row, col] += (
                share[0] * sums[0, i] + share[1] * sums[1, i] + share[2] * sums[2, i] + share[3] * sums[3, i]
            )
