"""The drawing of a random pattern on a screen, at the place in the frame where the registration finds it.

The drawing has `OVERSAMPLE` samples a pixel along rows and columns, each the mean over its area. A transfer function
blurs it, and it is sampled at the pixels as the image is, so that both are aliased alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lab.errors import NotDetermined
from lab.observables.screens.registration import ScreenWarp, draw_by_area
from sim.camera import CameraModel
from sim.effects.base import Effects
from sim.frame import screen_light
from sim.optics.diffraction import aperture_otf
from sim.spectrum import FloatArray

OVERSAMPLE = 4  # samples a pixel, along rows and columns
LARGEST_PX = 320  # largest side of the window that is fitted: enough for a band's contrast to 1e-3
MARGIN_PX = 12  # border of frame and window that isn't fitted, as the drawing lacks the light from outside
MARGIN_CELLS = 2.0  # border of the pattern that isn't fitted
#: Rings above 0.5 cy/px, by the larger of |fx| and fy, that alias. Each is one term of the fit and isn't reported. The
#: inner edges divide it into finer rings, at whose mean frequencies an effect's OTF is evaluated.
BEYOND_CY_PER_PX = ((0.5, 0.54, 0.58, 0.62), (0.62, 0.68, 0.74, 0.8), (0.8, 0.9, 1.0, 1.15, 1.35, 4.0))
LAST_BAND_CY_PER_PX = 0.5  # end of the bands of frequency
LEAST_PIXELS = 1500  # of a channel
#: Transfer function of a lens that is the same in all directions, against frequency (cy/px).
Lens = Callable[[FloatArray], FloatArray]


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


@dataclass(frozen=True)
class BeyondPart:
    """A part of the drawn pattern at frequencies beyond the bands."""

    picture: FloatArray  # at the window's pixels
    fx: tuple[float, float]  # mean |fx| and |fy| of its power, cy/px, in two quadrants: (fx, fy) and (fx, -fy)
    fy: tuple[float, float]

    @staticmethod
    def of(picture: FloatArray, fx: FloatArray, fy: FloatArray, power: FloatArray) -> BeyondPart:
        """Return the part whose power spectrum is `power` (rows, cols / 2 + 1), at the frequencies `fx` (1, cols / 2 +
        1) and `fy` (rows, 1)."""
        x, y = (float(np.average(np.broadcast_to(np.abs(f), power.shape), weights=power)) for f in (fx, fy))
        return BeyondPart(picture, (x, x), (y, -y))


@dataclass(frozen=True)
class Canvas:
    """The pattern drawn on a window of the frame, each sample the mean over its area, `OVERSAMPLE` samples a pixel."""

    warp: ScreenWarp
    window: tuple[slice, slice]
    fine: FloatArray  # (OVERSAMPLE rows, OVERSAMPLE cols): 0 on dark cells, 1 on lit ones
    inside: NDArray[np.bool_]  # (rows, cols): pixels inside the margins of pattern and window

    @staticmethod
    def of(target: FloatArray, warp: ScreenWarp, window: tuple[slice, slice]) -> Canvas:
        """Draw the cells `target` (rows, columns of the pattern), where `warp` places them."""
        row, col = (w.start + (np.arange(OVERSAMPLE * (w.stop - w.start)) + 0.5) / OVERSAMPLE - 0.5 for w in window)
        cell_x, cell_y = warp.cells_on(row, col)
        inside = np.ones((window[0].stop - window[0].start, window[1].stop - window[1].start), bool)
        for cell, count in ((cell_x, target.shape[1]), (cell_y, target.shape[0])):
            middle = cell[OVERSAMPLE // 2 :: OVERSAMPLE, OVERSAMPLE // 2 :: OVERSAMPLE]
            inside &= (middle > MARGIN_CELLS) & (middle < count - MARGIN_CELLS)
        inside[:MARGIN_PX] = inside[-MARGIN_PX:] = False
        inside[:, :MARGIN_PX] = inside[:, -MARGIN_PX:] = False
        return Canvas(warp, window, np.asarray(draw_by_area(target, cell_x, cell_y), float), inside)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window, px."""
        return self.inside.shape[0], self.inside.shape[1]

    @cached_property
    def drawn(self) -> NDArray[np.complex128]:
        """Fourier transform of `fine`, at all its frequencies."""
        return np.asarray(fft.rfft2(self.fine))

    @cached_property
    def low(self) -> NDArray[np.complex128]:
        """Fourier transform of the drawn pattern up to 0.5 cy/px, (rows, cols / 2 + 1), as of point samples at the
        pixels' centres."""
        return self._below(self.drawn)

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

    def beyond(self, lens: Lens, fill_factor: float) -> list[list[BeyondPart]]:
        """Return the aliased parts of the picture, from frequencies above 0.5 cy/px: a list for each ring and each pair
        of opposite sectors (|fx| >= |fy| or not), of its finer rings. The first list is of the frequencies below 0.5
        cy/px along both axes that no band has.

        Where cells are a whole number of pixels the spectrum repeats, and aliases are coherent with what lies below 0.5
        cy/px."""
        fy, fx = self.frequencies
        beside = (np.hypot(fx, fy) >= LAST_BAND_CY_PER_PX) & (np.abs(fy) < 0.5) & (fx < 0.5)
        corner = np.where(beside, self.low * self.passed(lens, fill_factor), 0.0)
        above = self._above(lens, fill_factor)
        found = [[BeyondPart.of(self.picture(corner), fx, fy, np.abs(corner) ** 2)]]
        for edges in BEYOND_CY_PER_PX:
            for side in (above.fx >= np.abs(above.fy), above.fx < np.abs(above.fy)):
                parts = []
                for low, end in pairwise(edges):
                    part = np.where(above.between(low, end) & side, above.spectrum, 0.0)
                    power = np.abs(part) ** 2
                    if power.any():
                        parts.append(BeyondPart.of(self._aliased(part, above.rows), above.fx, above.fy, power))
                if parts:
                    found.append(parts)
        return found

    def _above(self, lens: Lens, fill_factor: float) -> _Above:
        """Return the spectrum of the drawn pattern behind lens and pixel, up to the highest frequency drawn."""
        rows, cols = (OVERSAMPLE * n for n in self.shape)
        highest = 0.5 * OVERSAMPLE
        keep = np.abs(fft.fftfreq(rows, 1.0 / OVERSAMPLE)) < highest
        fy = fft.fftfreq(rows, 1.0 / OVERSAMPLE)[keep, None]
        fx = fft.rfftfreq(cols, 1.0 / OVERSAMPLE)[None, :]
        fx = fx[:, fx[0] < highest]
        radius = np.hypot(fy, fx)
        high = (
            self.drawn[keep][:, : fx.shape[1]] * lens(np.minimum(radius, highest)) * aperture_otf(fx, fy, fill_factor)
        )
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

    def between(self, low: float, end: float) -> NDArray[np.bool_]:
        """Mask of the frequencies with low <= max(|fy|, fx) < end."""
        largest = np.maximum(np.abs(self.fy), self.fx)
        return np.asarray((largest >= low) & (largest < end))


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
