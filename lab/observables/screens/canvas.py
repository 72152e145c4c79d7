"""The drawing of a random pattern on a screen, at the place in the frame where the registration finds it.

The drawing has `OVERSAMPLE` samples a pixel along rows and columns, each the mean over its area. A transfer function
blurs it, and it is sampled at the pixels as the image is, so that both are aliased alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.interpolate import CubicSpline

from lab.errors import NotDetermined
from lab.observables.screens.registration import ScreenWarp, draw_by_area
from sim.camera import CameraModel
from sim.effects.base import Effects
from sim.frame import screen_light
from sim.optics.diffraction import aperture_otf
from sim.spectrum import FloatArray

OVERSAMPLE = 4  # samples a pixel, along rows and columns
LARGEST_PX = 320  # largest side of the window that is fitted: enough for a band's contrast to 1e-3
#: Weights by which samples half as wide are joined: of their mean, and of a filter that passes a tenth as much of what
#: aliases. Cells that stand square and are a whole number of pixels alias alike all over the frame.
PAIRS, TAPS = np.array([0.5, 0.5]), np.array([0.125, 0.375, 0.375, 0.125])
MARGIN_PX = 12  # border of frame and window that isn't fitted, as the drawing lacks the light from outside
MARGIN_CELLS = 2.0  # border of the pattern that isn't fitted
#: Edges of the rings above 0.5 cy/px, by the larger of |fx| and fy, that alias. Each is one term of the fit and isn't
#: reported.
BEYOND_CY_PER_PX = (0.5, 0.62, 0.8, 4.0)
#: Frequencies between which an effect's change of the OTF is a cubic spline: of the rings, by the larger and by the
#: smaller of |fx| and fy; of the corners between the bands and 0.5 cy/px, by hypot(fx, fy).
RING_NODES_CY_PER_PX = (0.5, 0.56, 0.62, 0.7, 0.78, 0.86, 0.95, 1.05, 1.2, 1.35, 1.6, 2.0)
LESSER_NODES_CY_PER_PX = (0.0, 0.15, 0.3, 0.5)
CORNER_NODES_CY_PER_PX = (0.5, 0.57, 0.64, 0.71)
LAST_BAND_CY_PER_PX = 0.5  # end of the bands of frequency
LEAST_PIXELS = 1500  # of a channel
#: Transfer function of a lens that is the same in all directions, against frequency (cy/px).
Lens = Callable[[FloatArray], FloatArray]
#: Transfer function of fx and fy (cy/px).
Transfer = Callable[[FloatArray, FloatArray], FloatArray]


def mask_points(mask: NDArray[np.bool_], window: tuple[slice, slice]) -> FloatArray:
    """(x, y) in the frame, px, of the pixels that a mask of the window marks, (pixels, 2)."""
    row, col = np.nonzero(mask)
    return np.column_stack([col + window[1].start, row + window[0].start]).astype(float)


def from_middle(shape: tuple[int, ...], points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """x and y of points (n, 2) from the middle of a frame of `shape` (rows, cols), in half diagonals, and the squared
    distance; (n,) each."""
    rows, cols = shape
    u, v = ((points - 0.5 * np.array([cols - 1, rows - 1])) / (0.5 * np.hypot(rows, cols))).T
    return u, v, u * u + v * v


def pattern_window(seen: FloatArray, warp: ScreenWarp, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the window of the frame that is fitted: rows and columns about the pattern's middle, in even numbers and
    beginning at even ones.

    Raises NotDetermined where the pattern lies outside the frame.
    """
    row, col = (np.arange(0, n, 4) for n in seen.shape)
    x, y = np.meshgrid(col, row)
    cells = warp.cells(np.column_stack([x.ravel(), y.ravel()]).astype(float)).reshape(*x.shape, 2)
    inside = (cells[..., 0] > 0) & (cells[..., 0] < shape[1]) & (cells[..., 1] > 0) & (cells[..., 1] < shape[0])
    if not inside.any():
        raise NotDetermined("bernoulli", "the pattern lies outside the frame")
    slices = []
    for at, length in ((y[inside], seen.shape[0]), (x[inside], seen.shape[1])):
        low, high = max(int(at.min()) - MARGIN_PX, 0), min(int(at.max()) + MARGIN_PX + 4, length)
        size = 2 * (min(high - low, LARGEST_PX) // 2)
        low += (high - low - size) // 2
        low -= low % 2  # the mosaic keeps its phase
        slices.append(slice(low, low + size))
    return slices[0], slices[1]


def beyond_reference(fx: FloatArray, fy: FloatArray) -> FloatArray:
    """Return the transfer over which changes of the OTF beyond the bands are interpolated between their nodes: of a
    sharp lens, without an aperture, so that it has no null."""
    return np.asarray(np.exp(-np.power(np.hypot(fx, fy) / 1.5, 1.2)))


@dataclass(frozen=True)
class BeyondPart:
    """What a change of the OTF by `beyond_reference` at one node beyond the bands changes, where it is a spline with 0
    at the other nodes."""

    picture: FloatArray  # at the window's pixels
    fx: tuple[float, float]  # cy/px, in two quadrants: (fx, fy) and (fx, -fy)
    fy: tuple[float, float]


@dataclass(frozen=True)
class Canvas:
    """The pattern drawn on a window of the frame, each sample the mean over its area, `OVERSAMPLE` samples a pixel."""

    warp: ScreenWarp
    window: tuple[slice, slice]
    fine: FloatArray  # (OVERSAMPLE rows, OVERSAMPLE cols): 0 on dark cells, 1 on lit ones
    smooth: FloatArray  # (OVERSAMPLE rows, OVERSAMPLE cols): the same by `TAPS`, without aliases
    inside: NDArray[np.bool_]  # (rows, cols): pixels inside the margins of pattern and window

    @staticmethod
    def of(target: FloatArray, warp: ScreenWarp, window: tuple[slice, slice]) -> Canvas:
        """Draw the cells `target` (rows, columns of the pattern), where `warp` places them."""
        twice = 2 * OVERSAMPLE
        row, col = (w.start + (np.arange(twice * (w.stop - w.start)) + 0.5) / twice - 0.5 for w in window)
        cell_x, cell_y = warp.cells_on(row, col)
        inside = np.ones((window[0].stop - window[0].start, window[1].stop - window[1].start), bool)
        for cell, count in ((cell_x, target.shape[1]), (cell_y, target.shape[0])):
            middle = cell[OVERSAMPLE::twice, OVERSAMPLE::twice]
            inside &= (middle > MARGIN_CELLS) & (middle < count - MARGIN_CELLS)
        inside[:MARGIN_PX] = inside[-MARGIN_PX:] = False
        inside[:, :MARGIN_PX] = inside[:, -MARGIN_PX:] = False
        finest = np.asarray(draw_by_area(target, cell_x, cell_y), float)
        return Canvas(warp, window, _halved(finest, PAIRS), _halved(finest, TAPS), inside)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window, px."""
        return self.inside.shape[0], self.inside.shape[1]

    @cached_property
    def drawn(self) -> NDArray[np.complex128]:
        """Fourier transform of the drawing, at all its frequencies."""
        rows, cols = self.smooth.shape
        fy, fx = fft.fftfreq(rows, 1.0 / OVERSAMPLE)[:, None], fft.rfftfreq(cols, 1.0 / OVERSAMPLE)[None, :]
        # of `TAPS` over `PAIRS`, along both axes
        response = np.square(np.cos(np.pi * fx / (2 * OVERSAMPLE)) * np.cos(np.pi * fy / (2 * OVERSAMPLE)))
        return np.asarray(fft.rfft2(self.smooth) / response)

    @cached_property
    def low(self) -> NDArray[np.complex128]:
        """Fourier transform of the drawn pattern up to 0.5 cy/px, (rows, cols / 2 + 1), as of point samples at the
        pixels' centres."""
        return self._below(self.drawn)

    def image(self, transfer: Transfer) -> FloatArray:
        """Return the picture (rows, cols) of the drawn pattern behind a transfer function of fx and fy (cy/px), aliases
        included."""
        return self.sampled(self.whole.spectrum * transfer(self.whole.fx, self.whole.fy))

    def as_shown(self, effects: Effects, camera: CameraModel) -> NDArray[np.complex128]:
        """As `low`, for the pattern as a screen with effects shows it, over the lit screen with the same effects."""
        y, x = (
            (w.start + (np.arange(n) + 0.5) / OVERSAMPLE - 0.5 * whole) * camera.pixel_pitch_um
            for w, n, whole in zip(self.window, self.fine.shape, (camera.rows, camera.cols), strict=True)
        )
        shown, lit = self.fine, np.ones_like(self.fine)
        shown, lit = (screen_light(camera, part, x[None, :], y[:, None], effects) for part in (shown, lit))
        return self._below(np.asarray(fft.rfft2(shown / lit)))

    def _below(self, whole: NDArray[np.complex128]) -> NDArray[np.complex128]:
        rows, cols = self.shape
        part = whole[:, : cols // 2 + 1] / OVERSAMPLE**2
        part = np.concatenate([part[: rows // 2], part[len(part) - rows // 2 :]])
        fy, fx = self.frequencies
        # divided by the sinc of a sample's square, and shifted from the first sample's centre to the pixel's
        turn = np.exp(1j * np.pi * (fx + fy) * (1.0 - 1.0 / OVERSAMPLE))
        return np.asarray(part * turn / (np.sinc(fx / OVERSAMPLE) * np.sinc(fy / OVERSAMPLE)))

    @property
    def frequencies(self) -> tuple[FloatArray, FloatArray]:
        """fy (rows, 1) and fx (1, cols / 2 + 1), cy/px."""
        return fft.fftfreq(self.shape[0])[:, None], fft.rfftfreq(self.shape[1])[None, :]

    def passed(self, lens: Lens, fill_factor: float) -> FloatArray:
        """OTF of a lens times that of the pixel's aperture at `frequencies`, (rows, cols / 2 + 1)."""
        fy, fx = self.frequencies
        return np.asarray(lens(np.hypot(fx, fy)) * aperture_otf(fx, fy, fill_factor))

    def picture(self, spectrum: NDArray[np.complex128]) -> FloatArray:
        """Inverse Fourier transform: the picture (rows, cols) at the window's pixels."""
        return np.asarray(fft.irfft2(spectrum, self.shape))

    @cached_property
    def whole(self) -> _Spectrum:
        """Spectrum of the drawn pattern at all frequencies of the drawing, as of point samples at the pixels'
        centres."""
        rows, cols = self.fine.shape
        fy, fx = fft.fftfreq(rows, 1.0 / OVERSAMPLE)[:, None], fft.rfftfreq(cols, 1.0 / OVERSAMPLE)[None, :]
        # divided by the sinc of a sample's square, and shifted from the first sample's centre to the pixel's
        across, down = (np.exp(1j * np.pi * f * (1.0 - 1.0 / OVERSAMPLE)) / np.sinc(f / OVERSAMPLE) for f in (fx, fy))
        return _Spectrum(self.drawn * across * down / OVERSAMPLE**2, fx, fy)

    def sampled(self, spectrum: NDArray[np.complex128]) -> FloatArray:
        """Return the picture (rows, cols) of a spectrum like `whole`'s, sampled at the pixels, aliases included."""
        cols = self.fine.shape[1]
        folded = spectrum.reshape(OVERSAMPLE, self.shape[0], -1).sum(axis=0) * OVERSAMPLE
        return np.asarray(fft.irfft(fft.ifft(folded, axis=0), cols, axis=1)[:, ::OVERSAMPLE])

    def beyond(self, transfer: Transfer) -> list[FloatArray]:
        """Return the aliased parts of the picture behind a transfer function, from frequencies above 0.5 cy/px: a
        picture for each ring and each pair of opposite sectors (|fx| >= |fy| or not). The first is of the frequencies
        below 0.5 cy/px along both axes that no band has.

        Where cells are a whole number of pixels the spectrum repeats, and aliases are coherent with what lies below 0.5
        cy/px."""
        found = [self.picture(self._corner(transfer))]
        above = self._above(transfer)
        for low, end in pairwise(BEYOND_CY_PER_PX):
            for side in above.sides:
                part = np.where((above.largest >= low) & (above.largest < end) & side, above.spectrum, 0.0)
                if part.any():
                    found.append(self._aliased(part, above.rows))
        return found

    def beyond_parts(self) -> Iterator[BeyondPart]:
        """Yield what changes of the OTF beyond the bands change, by their nodes."""
        fy, fx = self.frequencies
        corner, radius = self._corner(beyond_reference), np.hypot(fx, fy)
        for side, flat in ((fx >= np.abs(fy), True), (fx < np.abs(fy), False)):
            power = np.where(side, np.abs(corner) ** 2, 0.0)
            lesser = np.arctan2(np.minimum(fx, np.abs(fy)), np.maximum(fx, np.abs(fy)))
            angle = float(np.average(lesser, weights=power))
            for node, weight in _splines(radius, CORNER_NODES_CY_PER_PX):
                x, y = node * np.cos(angle), node * np.sin(angle)
                x, y = (x, y) if flat else (y, x)
                yield BeyondPart(self.picture(np.where(side, weight * corner, 0.0)), (x, x), (y, -y))
        above = self._above(beyond_reference)
        lesser = np.minimum(above.fx, np.abs(above.fy))
        outside = np.where(above.largest >= LAST_BAND_CY_PER_PX, above.spectrum, 0.0)
        across = list(_splines(lesser, LESSER_NODES_CY_PER_PX, even=True))
        for larger, weight in _splines(above.largest, RING_NODES_CY_PER_PX):
            for side, flat in zip(above.sides, (True, False), strict=True):
                part: NDArray[np.complex128] = np.where(side, weight * outside, 0.0)
                for smaller, share in across:
                    x, y = (larger, smaller) if flat else (smaller, larger)
                    yield BeyondPart(self._aliased(np.asarray(part * share, complex), above.rows), (x, x), (y, -y))

    def _corner(self, transfer: Transfer) -> NDArray[np.complex128]:
        """Return the spectrum behind a transfer function at the frequencies below 0.5 cy/px that no band has."""
        fy, fx = self.frequencies
        inside = (np.hypot(fx, fy) >= LAST_BAND_CY_PER_PX) & (np.abs(fy) < 0.5) & (fx < 0.5)
        return np.where(inside, self.low * transfer(fx, fy), 0.0)

    def _above(self, transfer: Transfer) -> _Above:
        """Return the spectrum of the drawn pattern behind a transfer function, up to the highest frequency drawn."""
        rows, cols = (OVERSAMPLE * n for n in self.shape)
        highest = 0.5 * OVERSAMPLE
        keep = np.abs(fft.fftfreq(rows, 1.0 / OVERSAMPLE)) < highest
        fy = fft.fftfreq(rows, 1.0 / OVERSAMPLE)[keep, None]
        fx = fft.rfftfreq(cols, 1.0 / OVERSAMPLE)[None, :]
        fx = fx[:, fx[0] < highest]
        radius = np.hypot(fy, fx)
        high = self.drawn[keep][:, : fx.shape[1]] * transfer(fx, fy)
        high *= np.exp(1j * np.pi * fx * (1.0 - 1.0 / OVERSAMPLE)) / np.sinc(fx / OVERSAMPLE)
        high *= np.exp(1j * np.pi * fy * (1.0 - 1.0 / OVERSAMPLE)) / np.sinc(fy / OVERSAMPLE)
        return _Above(np.where(radius < highest, high, 0.0), fx, fy, keep)

    def _aliased(self, part: NDArray[np.complex128], rows: NDArray[np.bool_]) -> FloatArray:
        """Return the picture (rows, cols) of a part of that spectrum, sampled at the pixels. `rows`: which rows of the
        full spectrum it has."""
        cols = OVERSAMPLE * self.shape[1]
        spread = np.zeros((len(rows), part.shape[1]), complex)
        spread[rows] = part
        folded = np.zeros((self.shape[0], cols // 2 + 1), complex)
        folded[:, : part.shape[1]] = spread.reshape(OVERSAMPLE, self.shape[0], -1).sum(axis=0) / OVERSAMPLE
        return np.asarray(fft.irfft(fft.ifft(folded, axis=0), cols, axis=1)[:, ::OVERSAMPLE])


@dataclass(frozen=True)
class _Spectrum:
    """The spectrum of the drawn pattern, and its frequencies, cy/px."""

    spectrum: NDArray[np.complex128]  # (OVERSAMPLE rows, OVERSAMPLE cols / 2 + 1)
    fx: FloatArray  # (1, OVERSAMPLE cols / 2 + 1)
    fy: FloatArray  # (OVERSAMPLE rows, 1)


@dataclass(frozen=True)
class _Above:
    """The spectrum of the drawn pattern up to the highest frequency drawn."""

    spectrum: NDArray[np.complex128]  # (kept rows, kept columns)
    fx: FloatArray  # (1, kept columns), cy/px
    fy: FloatArray  # (kept rows, 1), cy/px
    rows: NDArray[np.bool_]  # mask of the kept rows

    @cached_property
    def largest(self) -> FloatArray:
        """Larger of |fy| and fx, cy/px."""
        return np.asarray(np.maximum(np.abs(self.fy), self.fx))

    @property
    def sides(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Masks of the frequencies with fx >= |fy|, and of the others."""
        return self.fx >= np.abs(self.fy), self.fx < np.abs(self.fy)


def _splines(value: FloatArray, nodes: Sequence[float], *, even: bool = False) -> Iterator[tuple[float, FloatArray]]:
    """Yield each node with the weight by which a cubic spline through values at `nodes` takes its own at `value`,
    constant beyond the last node. `even`: the spline's slope at the first node is 0."""
    ends = ((1, 0.0) if even else "not-a-knot", "not-a-knot")
    at = np.clip(value, nodes[0], nodes[-1])
    for node, own in zip(nodes, np.eye(len(nodes)), strict=True):
        yield node, np.asarray(CubicSpline(nodes, own, bc_type=ends)(at))


def pixels_of(canvas: Canvas, seen: FloatArray, places: Sequence[tuple[int, int]], step: int) -> NDArray[np.bool_]:
    """Mask (rows, cols) of the window's pixels of one colour inside the pattern.

    `seen` (rows, cols): the recorded frame, NaN where the screen isn't. `places`: (row, column) of the colour in the
    mosaic, whose period is `step`. Raises NotDetermined for fewer than `LEAST_PIXELS`.
    """
    mask = canvas.inside & np.isfinite(seen[canvas.window])
    own = np.zeros_like(mask)
    for row, col in places:
        own[row::step, col::step] = True
    mask &= own
    if mask.sum() < LEAST_PIXELS:
        raise NotDetermined(
            "bernoulli", f"only {mask.sum()} pixels of one colour see the pattern, {LEAST_PIXELS} needed"
        )
    return mask


def _halved(samples: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the weighted means of neighbouring samples, half as many along rows and columns. `weights`: an even
    number, symmetric about the middle of each pair."""
    out = samples
    for axis in (0, 1):
        beyond = len(weights) // 2 - 1
        padded = np.pad(out, [(beyond, beyond) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
        count = out.shape[axis] // 2
        out = sum(weight * padded.take(range(k, k + 2 * count, 2), axis=axis) for k, weight in enumerate(weights))
    return np.asarray(out)
