"""Point spread functions of a lens table as sampled kernels, and the tiles of the image in which they are polynomials.

The kernel of a source at s is, between 4 x 4 nodes of a tile, a cubic polynomial in the row and column of s: sum_n
L_n(s) PSF_n. Tiles are cut in four until the polynomial's error is below a limit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft
from scipy.interpolate import CubicSpline

from sim.optics.bspline import spline_weights
from sim.optics.field_mapping import ImageFrame, field_function, field_mapping
from sim.optics.table import LensTable
from sim.scene.render import Grid
from sim.spectrum import FloatArray

Float32Array = NDArray[np.float32]

#: Degree of the polynomials across a tile.
DEGREE = 3
#: Positions of a tile's nodes across it.
NODES = np.arange(DEGREE + 1) / DEGREE
#: Largest and smallest side of a tile, px.
LARGEST_TILE_PX, SMALLEST_TILE_PX = 128, 12
#: Limits of a tile's polynomials half way between nodes: relative rms error of a kernel, and relative error of its sum.
KERNEL_ERROR = 2e-3
LIGHT_ERROR = 1e-4
#: Samples of the refined table in a period of the highest frequency that is left in it.
SAMPLES_PER_PERIOD = 3.0
#: Kernels are low-passed at the drawing's Nyquist frequency by a cosine from (1 - ROLL_OFF) to (1 + ROLL_OFF) of it,
#: and extend over LEAST_REACH samples at least, for the ringing of that filter.
ROLL_OFF = 0.3
LEAST_REACH = 8.0
#: Refinement of a symmetric lens's field heights.
HEIGHTS_REFINED = 8


@dataclass(frozen=True)
class Tile:
    """A rectangle of sources: rows top..bottom and columns left..right, px of the frame."""

    top: int
    bottom: int
    left: int
    right: int

    def place(self, down: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(row, col) in px of positions 0..1 across the tile."""
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
    """Point spread functions of some channels, prepared to be rotated, placed and sampled.

    `weight` (C, F, W): light by channel, field point and wavelength of the table. The table is summed over wavelength
    with its relative illumination, cut to the circle of its window, low-passed to what the drawing's samples resolve,
    and refined: by Fourier series in the window, by cubic splines over the field heights of a symmetric lens. `light`
    (C, F) is a source's total light, `lost` (C, F) the light outside the circle. `distorted`: the pictures come from
    `distort`, whose blur is undone.
    """

    def __init__(
        self, table: LensTable, weight: FloatArray, frame: ImageFrame, oversample: int, *, distorted: bool
    ) -> None:
        self.table, self.frame, self.oversample = table, frame, oversample
        self.lens = field_mapping(table)
        n = table.psf.shape[-1]
        self.radius_um = 0.5 * n * table.sample_pitch_um
        light = weight * table.relative_illumination.T  # (C, F, W)
        self.light = np.sum(light, axis=2)
        psf = np.stack([light[:, f] @ table.psf[:, f].reshape(-1, n * n) for f in range(light.shape[1])])
        at = (np.arange(n) - 0.5 * (n - 1)) * table.sample_pitch_um
        # the circle's border is two samples wide, so that it isn't jagged
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
        # the low-pass filter rolls off slowly, so that its ringing ends within a few samples
        self.step_um = frame.pitch_um / oversample
        self.reach_um = max(self.radius_um, LEAST_REACH * self.step_um)
        around = int(np.ceil((self.reach_um - self.radius_um) / table.sample_pitch_um))
        psf = np.pad(psf.reshape(*psf.shape[:2], n, n), [(0, 0), (0, 0), (around, around), (around, around)])
        n += 2 * around
        # samples are per area from here on, with a border of zeros for the interpolation
        finest = 0.5 / self.step_um
        shortest = float(np.min(table.wavelength_nm)) * 1e-3 * table.f_number
        refine = max(
            1, int(np.ceil(table.sample_pitch_um * SAMPLES_PER_PERIOD * min((1.0 + ROLL_OFF) * finest, 1.0 / shortest)))
        )
        self.sample_um = table.sample_pitch_um / refine
        f = fft.fftfreq(n * refine, self.sample_um)
        beyond = np.hypot(f[:, None], f[None, : n * refine // 2 + 1]) / finest
        passed = 0.5 + 0.5 * np.cos(np.pi * np.clip((beyond - 1.0 + ROLL_OFF) / (2.0 * ROLL_OFF), 0.0, 1.0))
        # cubic B-splines interpolate the inverse-filtered samples
        inverse = 3.0 / (2.0 + np.cos(2.0 * np.pi * fft.fftfreq(n * refine)))
        spline = (
            inverse[:, None] * inverse[None, : n * refine // 2 + 1] * passed * (refine / table.sample_pitch_um) ** 2
        )
        spline = spline.astype(np.float32)
        # always four channels a sample, so that the processor adds them at once
        self.channels = len(light)
        self.samples = np.zeros((len(psf), n * refine + 4, n * refine + 4, 4), np.float32)
        for field, functions in enumerate(psf.astype(np.float32)):
            spectrum = _pad_spectrum(fft.rfft2(functions), n, refine)
            spectrum *= spline
            self.samples[field, 2:-2, 2:-2, : self.channels] = np.moveaxis(
                fft.irfft2(spectrum, (n * refine, n * refine)), 0, -1
            )
        self.first_um = -0.5 * (n - 1) * table.sample_pitch_um - 2.0 * self.sample_um  # of the padded table's sample 0
        # A fill factor of 1 is averaged in the kernels: their sums over pixels then conserve the light of every source.
        # Other apertures don't conserve light and are averaged in the picture.
        self.box = oversample if frame.fill_factor == 1.0 else 1
        reach = self.reach_um / self.step_um + 1.0 + 0.5 * (self.box - 1)
        self.size = int(np.ceil(2.0 * reach))
        if (self.size - oversample) % 2:  # a pixel's centre has as many samples on either side
            self.size += 1
        # sources farther than this from the frame don't reach it
        self.halo_px = -(-((self.size - oversample) // 2) // oversample)
        self._undo = 5 if distorted else 1
        self._kept: dict[Tile, Float32Array] = {}

    def through_pixels(self, picture: Float32Array) -> Float32Array:
        """Return a picture averaged over the pixels' aperture, the blur of its own samples and of `distort` undone;
        where the kernels hold the aperture, only the latter.
        """
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
        """Kernels of sources at image points (N,): (N, C, size, size), the share of the light on the k-th sample's
        square that a pixel gets.
        """
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
        # sampling changes the sum by 1e-5: kernels are corrected to the table's light
        functions = np.zeros((x_um.size, self.channels, self.size, self.size), np.float32)
        _finish(sampled, self.box, (self.step_um / self.box) ** 2, self.held(x_um, y_um), functions)
        return functions

    def at_nodes(self, tile: Tile) -> Float32Array:
        """Kernels at a tile's nodes, (4, 4, C, size, size). Those that `tiles` computed are kept until they are asked
        for.
        """
        if tile in self._kept:
            return self._kept.pop(tile)
        nodes = self.at(*self.frame.um(*(a.ravel() for a in tile.place(*np.meshgrid(NODES, NODES, indexing="ij")))))
        return nodes.reshape(NODES.size, NODES.size, *nodes.shape[1:])

    def error(self, tile: Tile, at_nodes: Float32Array) -> float:
        """Error of a tile's polynomials half way between nodes, relative to its limit: the largest at four
        positions.
        """
        nodes, worst = at_nodes.reshape(NODES.size**2, -1), 0.0
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
        """Tiles that cover all sources that reach the frame, as large as the polynomials' error allows."""
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
        """Yield the tile, or its parts in which the polynomials' error is below the limit."""
        nodes = self.at_nodes(tile)
        if min(tile.bottom - tile.top, tile.right - tile.left) < 2 * SMALLEST_TILE_PX or self.error(tile, nodes) <= 1.0:
            self._kept[tile] = nodes
            yield tile
        else:
            for part in tile.quarters():
                yield from self._good(part)


def lagrange(t: FloatArray) -> FloatArray:
    """Lagrange polynomials of a tile's nodes at positions t (0..1 across it): (DEGREE + 1, *t.shape)."""
    return np.stack([np.prod([(t - b) / (a - b) for b in NODES if b != a], axis=0) for a in NODES])


def _pad_spectrum(spectrum: NDArray[np.complex64], n: int, refine: int) -> NDArray[np.complex64]:
    """Real FFT of n x n samples, zero-padded to `refine` times as many frequencies; sample 0 keeps its position."""
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


@njit(cache=True)
def _sample(  # type: ignore[no-untyped-def]  # noqa: PLR0912
    raw, down, across, columns, cosine, sine, offset, samples, first, step, radius
):
    """Sample rotated kernels at minus the offsets: bilinear between the field points around (down, across), cubic
    B-splines between samples. The y axis of a symmetric lens's table points along (sine, cosine) [x, y].
    """
    channels = raw.shape[1]
    rows = samples.shape[0] // columns
    fields, shares = np.empty(4, np.int64), np.empty(4)
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
                weight_row, weight_col = spline_weights(row - k), spline_weights(col - m)
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
    """Kernels times `scale`, summed over box x box samples, and corrected to the sum `light` (C, N)."""
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
