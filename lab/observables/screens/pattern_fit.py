"""The fit of a random (Bernoulli) pattern on a screen: its image as a linear combination of parts of the drawn pattern.

The pattern is drawn where the checkerboard captures place it (`lab.observables.screens.registration`), and blurred by
the baseline's OTF. The drawn pattern P is split into bands P_b of frequency and orientation. The recorded image, black
subtracted and divided by white less black, is fitted by least squares over the pixels of each channel:

    image = sum over bands of c_b P_b + border P (1 - P) + ghost T + constant + shifts . gradient P + parts of P beyond
    the bands

T is the recorded image, rotated by 180 degrees about the frame's middle. For the baseline camera every c_b and the
coefficients of the parts beyond are 1, all others 0. P is sampled at the same pixels as the image, so that both are
aliased alike. A channel whose image is displaced from the green one is drawn at its own place."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.interpolate import CubicSpline, RectBivariateSpline

from lab.capture_kinds.base import Capture
from lab.capture_kinds.bernoulli import BernoulliCapture
from lab.capture_kinds.black import BlackCapture
from lab.capture_kinds.checkerboard import CheckerboardCapture
from lab.capture_kinds.white import WhiteCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset, held_out_of
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import REFLECTIONS, SHOWN, acting
from lab.observables.screens.registration import ScreenWarp, draw_by_area, reference_pixels, register
from sim.camera import CameraModel
from sim.effects.base import Effect, Effects
from sim.frame import screen_light, with_reflections
from sim.optics.diffraction import aperture_otf
from sim.point import (
    TRANSFER_AT,
    common_wavelengths,
    detected_transfer,
    mix_channels,
    mixes_colours,
    optical_transfer,
    transfer_at,
)
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import Uniform, electron_rate

# --- pattern canvas --------------------------------------------------------------------------------------------------
# A random pattern on a screen, drawn at the place in the camera's frame where the registration finds it.


OVERSAMPLE = 4  # samples a pixel, along rows and columns
LARGEST_PX = 320  # largest side of the window that is fitted: enough for a band's contrast to 1e-3
MARGIN_PX = 12  # border of frame and window that isn't fitted, as the drawing lacks the light from outside
MARGIN_CELLS = 2.0  # border of the pattern that isn't fitted
#: Rings above 0.5 cy/px, by the larger of |fx| and fy, that alias. Each is one term of the fit and isn't reported. The
#: inner edges divide it into finer rings, at whose mean frequencies an effect's OTF is evaluated.
BEYOND_CY_PER_PX = ((0.5, 0.54, 0.58, 0.62), (0.62, 0.68, 0.74, 0.8), (0.8, 0.9, 1.0, 1.15, 1.35, 4.0))
LEAST_PIXELS = 1500  # of a channel


def mask_points(mask: NDArray[np.bool_], window: tuple[slice, slice]) -> FloatArray:
    """(x, y) in the frame, px, of the pixels that a mask of the window marks, (pixels, 2)."""
    row, col = np.nonzero(mask)
    return np.column_stack([col + window[1].start, row + window[0].start]).astype(float)


def from_middle(camera: CameraModel, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """x and y of points (n, 2) from the frame's middle, in half diagonals, and the squared distance; (n,) each."""
    half = camera.half_diagonal_px
    u, v = ((points - 0.5 * np.array([camera.cols - 1, camera.rows - 1])) / half).T
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
        y, x = (np.arange(w.start - 16.0, w.stop + 24.0, 8.0) for w in window)
        at = warp.cells(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x), 2)
        row, col = (w.start + (np.arange(OVERSAMPLE * (w.stop - w.start)) + 0.5) / OVERSAMPLE - 0.5 for w in window)
        cell_x, cell_y = (RectBivariateSpline(y, x, at[:, :, k])(row, col) for k in (0, 1))
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

    def passed(self, otf: CubicSpline, fill_factor: float) -> FloatArray:
        """OTF of a lens, symmetric about the axis, times that of the pixel's aperture at `frequencies`, (rows, cols / 2
        + 1)."""
        fy, fx = self.frequencies
        return np.asarray(otf(np.hypot(fx, fy)) * aperture_otf(fx, fy, fill_factor))

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

    def beyond(self, otf: CubicSpline, fill_factor: float) -> list[list[BeyondPart]]:
        """Return the aliased parts of the picture, from frequencies above 0.5 cy/px that the lens passes: a list for
        each ring and each pair of opposite sectors (|fx| >= |fy| or not), of its finer rings.

        Where cells are a whole number of pixels the spectrum repeats, and aliases are coherent with what lies below 0.5
        cy/px."""
        above = self._above(otf, fill_factor)
        found = []
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

    def _above(self, otf: CubicSpline, fill_factor: float) -> _Above:
        """Return the spectrum of the drawn pattern behind lens and pixel, up to the lens's cutoff."""
        rows, cols = (OVERSAMPLE * n for n in self.shape)
        highest = min(float(otf.x[-1]), 0.5 * OVERSAMPLE)
        keep = np.abs(fft.fftfreq(rows, 1.0 / OVERSAMPLE)) < highest
        fy = fft.fftfreq(rows, 1.0 / OVERSAMPLE)[keep, None]
        fx = fft.rfftfreq(cols, 1.0 / OVERSAMPLE)[None, :]
        fx = fx[:, fx[0] < highest]
        radius = np.hypot(fy, fx)
        high = self.drawn[keep][:, : fx.shape[1]] * otf(np.minimum(radius, highest)) * aperture_otf(fx, fy, fill_factor)
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
    """The spectrum of the drawn pattern up to the lens's cutoff."""

    spectrum: NDArray[np.complex128]  # (kept rows, kept columns)
    fx: FloatArray  # (1, kept columns), cy/px
    fy: FloatArray  # (kept rows, 1), cy/px
    rows: NDArray[np.bool_]  # mask of the kept rows

    def between(self, low: float, end: float) -> NDArray[np.bool_]:
        """Mask of the frequencies with low <= max(|fy|, fx) < end."""
        largest = np.maximum(np.abs(self.fy), self.fx)
        return np.asarray((largest >= low) & (largest < end))


def lens_otf(dataset: Dataset, channel: str, light: Spectrum | None) -> CubicSpline:
    """OTF of the baseline's lens without the pixel's aperture, against frequency (cy/px). On axis it is the same in all
    directions."""
    f = np.linspace(0.0, 2.0, 101)
    whole = np.real(optical_transfer(dataset.camera, channel, light, f, 0.0 * f, (), "bernoulli"))
    return CubicSpline(f, whole / aperture_otf(f, 0.0 * f, dataset.camera.fill_factor))


def channel_pixels(dataset: Dataset, canvas: Canvas, channel: str, seen: FloatArray) -> NDArray[np.bool_]:
    """Mask (rows, cols) of the window's pixels of a channel inside the pattern. `seen`: the frame, NaN where the screen
    isn't.

    Raises NotDetermined for fewer than `LEAST_PIXELS`.
    """
    mask = canvas.inside & np.isfinite(seen[canvas.window])
    step = mosaic.step(dataset.camera.cfa)
    own = np.zeros_like(mask)
    for row, col in mosaic.phases(dataset.camera.cfa)[channel]:
        own[row::step, col::step] = True
    mask &= own
    if mask.sum() < LEAST_PIXELS:
        raise NotDetermined(
            "bernoulli", f"only {mask.sum()} pixels of channel {channel} see the pattern, {LEAST_PIXELS} needed"
        )
    return mask


def below_nyquist(canvas: Canvas) -> NDArray[np.bool_]:
    """Mask of the frequencies below 0.5 cy/px along both axes."""
    fy, fx = canvas.frequencies
    return np.asarray((np.abs(fy) < 0.5) & (fx < 0.5))


# --- pattern contrast ------------------------------------------------------------------------------------------------
# Contrast of the image of a random pattern over that of the baseline camera, by spatial frequency, orientation and
# channel.


LARGEST_STD = 0.04  # bands of a larger standard deviation aren't used
CONTRAST_FLOOR = 0.0015  # standard deviation of a band's contrast beside noise: drawing and registration
CONTRAST_SCALE_STD = (
    0.01  # prior standard deviation of the contrast's scale, for each channel of seen and held-out repeats
)
SCREEN_BLUR_PX = 0.08  # prior standard deviation of the Gaussian blur of the cells' borders
PLACINGS = 4  # Gauss-Newton steps that find an image's shift


def measure_bernoulli(dataset: Dataset) -> Observable:
    """Contrast of a random pattern over that of the baseline, by frequency, orientation and channel: the bands'
    coefficients of `pattern_fit`.

    Nuisance parameters: the contrast's scale, and a blur of the screen's cells. Raises NotDetermined where no band is
    known to `LARGEST_STD`.
    """
    found = patterns(dataset)
    labels: list[Label] = []
    places: list[tuple[int, Pattern, int]] = []
    for number, group in enumerate(found):
        for p in group:
            spread = np.sqrt(np.diag(p.shown + p.common))
            for b, band in enumerate(p.bands):
                if spread[b] < LARGEST_STD and b > 0:  # the lowest band is that of white and black levels
                    places.append((number, p, b))
                    labels.append(Label(band.frequency, p.channel, f"{band.angle_deg:.0f} deg", p.captures, p.held_out))
    if not places:
        raise NotDetermined("bernoulli", "the patterns are too noisy, or too few of their cells are in view")
    value = np.array([p.value[b] for _, p, b in places])
    frequency = np.array([label.x for label in labels])
    covariance = joint_covariance(places, dataset) + np.diag(np.full(len(value), CONTRAST_FLOOR**2))
    scales = [f"pattern:{number}:{p.channel}:{p.held_out}" for number, p, _ in places]
    # seen and held-out repeats of a pattern share one prediction
    poses: list[dict[str, tuple[Pattern, list[int], list[int]]]] = [{} for _ in found]
    for k, (number, p, b) in enumerate(places):
        _, members, parts = poses[number].setdefault(p.channel, (p, [], []))
        members.append(k)
        parts.append(b)
    poses = [sights for sights in poses if sights]
    plain = [_transfers(dataset, sights, ()) for sights in poses]
    weights = {id(p): _node_weights(p) for sights in poses for p, *_ in sights.values()}

    def predict(effects: Effects) -> Prediction:
        mean = np.ones(len(places))
        if effects:
            for sights, before in zip(poses, plain, strict=True):
                changed = _transfers(dataset, sights, effects) / np.where(np.abs(before) > 1e-3, before, np.inf)
                for (p, members, parts), ratio in zip(sights.values(), changed, strict=True):
                    real, imaginary, outside = weights[id(p)]
                    within, beyond = np.split(ratio, [real.shape[1]])
                    placed = _in_place(p, within)
                    kept = real @ np.real(placed) + imaginary @ np.imag(placed) + outside @ (np.real(beyond) - 1.0)
                    kept = kept + p.shown_by(effects)[: len(real)]
                    mean[members] = kept[parts]
            mean[~np.isfinite(mean)] = 1.0
        jacobian = {"pattern:blur": -2.0 * np.square(np.pi * SCREEN_BLUR_PX * frequency) * mean}
        for name in dict.fromkeys(scales):
            jacobian[name] = CONTRAST_SCALE_STD * mean * np.array([s == name for s in scales])
        return Prediction(mean, jacobian)

    return Observable(
        measurement=BERNOULLI, reach=0.2, value=value, covariance=covariance,
        labels=tuple(labels), reads=TRANSFER_AT | SHOWN | {"image.transmittance"}, predict=predict,
        scale=np.ones(len(value)),
    )  # fmt: skip


def _transfers(
    dataset: Dataset, sights: dict[str, tuple[Pattern, list[int], list[int]]], effects: Effects
) -> NDArray[np.complex128]:
    """OTFs of the channels of one pose, (channels, nodes), at the nodes of all bands and then of the parts beyond the
    bands."""
    camera, first = dataset.camera, next(iter(sights.values()))[0]
    fx = np.concatenate([*(b.fx for b in first.bands), first.beyond[:, 0].ravel()])
    fy = np.concatenate([*(b.fy for b in first.bands), first.beyond[:, 1].ravel()])
    mixing = mixes_colours(camera, effects)
    channels = camera.channels if mixing else tuple(sights)  # neighbours of other colours count
    nodes, shares = common_wavelengths(camera, [(c, first.light) for c in channels], effects, "bernoulli")
    whole = np.array([transfer_at(camera, float(w), fx, fy, effects, moving=not mixing) for w in nodes])
    found = detected_transfer(camera, nodes, shares, whole, fx, fy, effects, first.places_um)
    if not mixing:
        return found
    rates = [1.0 if first.light is None else max(electron_rate(camera, c, first.light), 0.0) for c in channels]
    return mix_channels(camera, found, np.array(rates), fx, fy, effects)[[channels.index(c) for c in sights]]


def _node_weights(p: Pattern) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weights that take a ratio of OTFs to the bands' coefficients: of its real part and of its imaginary part at the
    bands' nodes, (bands, nodes) each, and of its real part at the frequencies of the parts beyond, (bands,
    frequencies).

    The real part is split into even powers of the frequency, fitted over the nodes by least squares, and a rest. The
    rest, and the imaginary part, enter by their means over the lower and the upper half of each band.
    """
    fx, fy = (np.concatenate([getattr(band, name) for band in p.bands]) for name in ("fx", "fy"))
    halves = np.zeros((2 * len(p.bands), len(fx)))
    start = 0
    for k, band in enumerate(p.bands):
        own = slice(start, start + len(band.fx))
        start += len(band.fx)
        for row, use in zip(halves[2 * k : 2 * k + 2], (~band.upper, band.upper), strict=True):
            share = np.where(use, band.share, 0.0)
            row[own] = share / share.sum() if share.sum() > 0 else band.share
    ends = np.cumsum([EVEN_TERMS, len(halves), len(halves)])
    smooth, by_half, by_phase, by_part = np.split(p.mix, ends, axis=1)
    powers = np.transpose(even_powers(fx, fy))
    weight = np.sqrt(np.concatenate([band.power * band.share for band in p.bands]))
    fit = np.linalg.pinv(weight[:, None] * powers) * weight
    outside = 0.5 * np.repeat(by_part, 2, axis=1)  # two frequencies each
    return smooth @ fit + by_half @ (halves - halves @ powers @ fit), by_phase @ halves, outside


def _in_place(p: Pattern, ratio: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return a ratio of OTFs without the shift s that the registration would take up.

    s solves sum over nodes of P f Im(ratio exp(-2 pi i f s)) = 0 along both axes, P the power of the pattern, by
    Gauss-Newton steps."""
    if not np.any(np.abs(np.imag(ratio)) > 1e-6):
        return ratio
    turn = 2.0 * np.pi * np.array([np.concatenate([b.fx for b in p.bands]), np.concatenate([b.fy for b in p.bands])])
    weight = np.concatenate([b.power * b.share for b in p.bands])
    for _ in range(PLACINGS):
        slope = (turn * weight * np.maximum(np.real(ratio), 0.0)) @ turn.T
        shift = np.linalg.lstsq(slope, (turn * weight) @ np.imag(ratio), rcond=1e-9)[0]
        ratio = ratio * np.exp(-1j * shift @ turn)
    return ratio


BERNOULLI = Measurement(
    "bernoulli",
    title="contrast of random patterns",
    order=410,
    axis="spatial_frequency",
    unit="cy/px",
    make=measure_bernoulli,
    quantity="contrast over the baseline's",
    conditions="orientation",
    conditions_words="bands at",
)


# --- pattern fit ------------------------------------------------------------


RINGS_CY_PER_PX = (0.0, 0.03, 0.08, 0.14, 0.2, 0.27, 0.34, 0.42, 0.5)  # edges of the bands in frequency
SECTORS = 4  # bands in orientation: about 0, 45, 90, 135 degrees
NODES = (4, 3)  # of a band, in radius and angle, at which an effect's OTF is evaluated
#: Highest total order of the even powers of (fx, fy) that describe an effect's change of the OTF over all bands; the
#: rest enters by halves of bands. Where cells are a whole number of pixels, a mosaic's red and blue pixels have the
#: same samples at f and 1/2 cy/px - f. Errors within a strong band at low frequencies would then leak into a weak one
#: at high frequencies.
EVEN_ORDER = 8
#: Highest total order, and the frequency at which the powers end, of the change of the OTF that the registration fits.
#: With more freedom (order 6) it takes a displacement that goes with the phase of the cells on the pixels for an OTF:
#: 0.025 px where 0.01 px is reached.
REGISTERED_ORDER, REGISTERED_CY_PER_PX = 4, 1.5
JUDGED_ORDER = 8  # of the change of the OTF beside which a displacement has to lower the residual
EVEN_TERMS = sum(order + 1 for order in range(0, EVEN_ORDER + 1, 2))
GHOST_BLUR_PX = 3.0  # standard deviation of the Gaussian blur of the ghost's term
LEAST_BEYOND = (
    5e-4  # contrast (rms) of the parts beyond the bands from which on they are fitted; weaker ones are taken as drawn
)
LEAST_ODD = 1e-9  # contrast (rms) of an odd part below which it is rounding
REFINEMENTS = 3  # most Gauss-Newton steps of the registration
FEWEST_CELLS = 400  # of a random pattern, whose spectrum is then even to 5 %
MOST_MOVES = 4  # times that a displaced channel is drawn anew: a linear step finds about half of a shift by half a cell
SCALING = np.array(
    [0.0, 0.0, 1.0, 1.0, 1.0]
)  # the shifts (x, y, radial, radial^3, tangential) of a lens that scales an image
MOVED_PX = 0.1  # a channel displaced by more is drawn anew; less may come from another blur than the drawn one


@dataclass(frozen=True)
class Pattern:
    """The fit of one pattern, at one pose of the screen, in one channel, to its seen or its held-out repeats."""

    captures: tuple[str, ...]
    held_out: bool
    channel: str
    bands: tuple[Band, ...]
    value: (
        FloatArray  # coefficients (k,): of the bands, the eight of `BORDER` to `ACROSS`, and the parts beyond the bands
    )
    shown: FloatArray  # (k, k): covariance by temporal noise of the repeats
    common: FloatArray  # (k, k): covariance by what seen and held-out repeats share: white, black, registration
    # (bands, EVEN_TERMS + 4 bands + parts): change of the bands' coefficients by a unit of `_LinearModel.mix`'s terms
    mix: FloatArray
    beyond: FloatArray  # (parts, 2, 2): (fx, fy) of the parts beyond the bands, cy/px, each at two frequencies
    shown_by: Callable[[Effects], FloatArray]  # change of the coefficients by effects on the screen's light
    levels_e: tuple[float, float]  # electrons on dark and on lit cells
    light: Spectrum | None
    ghost: Callable[[Effects], float]  # change of the ghost's coefficient by reflections of the whole image
    reach: float  # largest distance of its pixels from the frame's middle, half diagonals
    places_um: tuple[
        tuple[float, float], ...
    ]  # four points (x, y) from the frame's middle with the mean and the variances of its pixels


#: Indices of the coefficients after the bands': cell borders, ghost, constant, shift x, shift y, radial, radial^3,
#: tangential.
BORDER, GHOST, CONSTANT, SHIFT_X, RADIAL, RADIAL3, ACROSS = 0, 1, 2, 3, 5, 6, 7


@dataclass(frozen=True)
class Band:
    """A band of frequency and orientation, and the nodes at which an effect's OTF is evaluated."""

    frequency: float  # mean over the pattern's power, cy/px
    angle_deg: float
    fx: FloatArray  # (nodes,), cy/px
    fy: FloatArray  # (nodes,), cy/px
    share: FloatArray  # (nodes,): share of the band's power
    power: float  # of the pattern
    upper: NDArray[np.bool_]  # (nodes,): in the upper half of the band's frequencies


def patterns(dataset: Dataset) -> list[list[Pattern]]:
    """Return the fits of all Bernoulli patterns, computed once a dataset: a list for each (pose, target), by channel,
    seen and held out.

    Raises NotDetermined where f-number or pixel pitch isn't stated, and where no pattern is fitted.
    """
    return dataset.once(_patterns)


def _patterns(dataset: Dataset) -> list[list[Pattern]]:
    if not dataset.diffraction_is_known:
        raise NotDetermined("bernoulli", "f-number or pixel pitch isn't stated: no diffraction to draw patterns with")
    captures: Any = dataset.recordings.captures
    groups = dataset.groups(BernoulliCapture, lambda c: (c.screen.pose, c.target))
    if not groups:
        raise NotDetermined("bernoulli", "no bernoulli captures")
    found, reason = [], ""
    for i, group in enumerate(groups):
        pose = group[0].screen.pose
        whites, blacks, boards = (
            [c for c in captures(k, dataset.side) if c.screen.pose == pose]
            for k in (WhiteCapture, BlackCapture, CheckerboardCapture)
        )
        missing = [n for n, some in (("white", whites), ("black", blacks), ("checkerboard", boards)) if not some]
        if missing:
            reason = f"pose {pose} lacks {' and '.join(missing)} captures"
            continue
        out = held_out_of(group, i, 0) if len(group) > 1 else set()
        try:
            found.append(_measured(dataset, group, whites, blacks, boards, out))
        except NotDetermined as refused:
            reason = refused.reason
    if not found:
        raise NotDetermined("bernoulli", reason)
    return found


def mean_rate(dataset: Dataset, captures: Sequence[Capture]) -> FloatArray:
    """Mean of the captures' frames above black level and dark current, DN/s. Raises NotDetermined where one is
    saturated."""
    recordings, noise = dataset.recordings, dataset.noise
    total = np.zeros((dataset.camera.rows, dataset.camera.cols))
    for capture in captures:
        frame = recordings.frame(capture)
        clipped = float(np.mean(frame >= dataset.saturation_dn))
        if clipped > 0.001:
            raise NotDetermined("bernoulli", f"{capture.id}: {100 * clipped:.1f} % of the frame is saturated")
        total += (frame - noise.black) / max(capture.exposure_s, 1e-12) - noise.dark_dn_per_s
    return total / len(captures)


def _measured(
    dataset: Dataset,
    group: Sequence[Any],
    whites: Sequence[Any],
    blacks: Sequence[Any],
    boards: Sequence[Any],
    out: set[str],
) -> list[Pattern]:
    """Return the fits of one pattern at one pose. `group`: its captures, of which those in `out` are held out;
    `boards`: checkerboards."""
    camera = dataset.camera
    white, black = mean_rate(dataset, whites), mean_rate(dataset, blacks)
    contrast = white - black
    for plane in mosaic.planes(contrast, camera.cfa).values():
        plane[plane < 0.2 * np.quantile(plane, 0.98)] = np.nan  # beside the screen
    boards = [c for c in boards if c.target == boards[0].target]
    cells = dataset.recordings.target(group[0].target)
    if cells.size < FEWEST_CELLS or not 0.02 < float(np.mean(cells > 0)) < 0.98:
        raise NotDetermined("bernoulli", f"{group[0].target} holds no random pattern of {FEWEST_CELLS} cells or more")
    target = np.asarray(cells, float) / float(cells.max())
    parts = [p for p in ([c for c in group if c.id not in out], [c for c in group if c.id in out]) if p]
    seen = [(mean_rate(dataset, part) - black) / contrast for part in parts]
    whole = np.average(seen, axis=0, weights=[len(p) for p in parts])
    warp = register(
        (mean_rate(dataset, boards) - black) / contrast, whole, dataset.recordings.target(boards[0].target),
        (target > 0.5).astype(np.uint8), group[0].screen.cell_camera_px, reference_pixels(whole.shape, camera.cfa),
    )  # fmt: skip
    light = dataset.spectrum(group[0].screen.radiance) if group[0].screen.radiance else None
    window = pattern_window(whole, warp, target.shape)
    reference = "Y" if camera.cfa == "MONO" else "G"
    warp = _refine_warp(dataset, whole, target, warp, window, reference, light)
    canvas = Canvas.of(target, warp, window)
    # the same nodes for all channels, so that an effect's OTF is evaluated once
    otfs = [lens_otf(dataset, channel, light) for channel in camera.channels]
    laid = np.sum([np.square(np.abs(canvas.low * canvas.passed(otf, camera.fill_factor))) for otf in otfs], axis=0)
    turned = ndimage.gaussian_filter(np.nan_to_num(whole), GHOST_BLUR_PX)[::-1, ::-1]
    found = []
    for channel in camera.channels:
        design = _LinearModel.of(dataset, canvas, channel, light, whole, turned, laid)
        picture = whole[window]
        points = mask_points(design.mask, window)
        drawn, moved = canvas, np.zeros(len(design.coefficients(picture[design.mask])[design.shifts]))
        # a shift too large for a linear step: the pattern is drawn anew at the displaced place, until the rest is small
        for _ in range(MOST_MOVES if channel != reference else 0):
            step = design.coefficients(picture[design.mask])[design.shifts]
            if np.abs(_field(camera, points, step)).max() <= MOVED_PX:
                break
            # where cells are a whole number of pixels, a loss of contrast looks like a common shift: a step without one
            # is tried as well
            tried = []
            for part in (step, step * SCALING):
                field = _field(camera, points, moved + part)
                there = np.linalg.lstsq(warp.basis(points).T, field.T, rcond=1e-12)[0].T
                displaced = Canvas.of(target, warp.displace(there), window)
                tried.append(
                    (part, displaced, _LinearModel.of(dataset, displaced, channel, light, whole, turned, laid))
                )
            part, displaced, anew = min(tried, key=lambda one: one[2].left_rms(picture))
            if anew.left_rms(picture) >= design.left_rms(picture):
                break
            design, drawn, moved = anew, displaced, moved + part
        area = contrast[window][design.mask]
        exposure = group[0].exposure_s
        levels = (
            float(np.nanmean(black[window][design.mask])) * exposure / dataset.noise.gain,
            float(np.nanmean(white[window][design.mask])) * exposure / dataset.noise.gain,
        )
        ghost_by, shown_by = _ghost_by(dataset, design, whole, window), _shown_by(dataset, design, drawn)
        solved = []
        for part, picture in zip(parts, seen, strict=True):
            dn = np.maximum(picture[window][design.mask] * area + black[window][design.mask], 0.0) * exposure
            temporal = (dataset.noise.gain * dn + dataset.noise.read_dn**2) / len(part) / (area * exposure) ** 2
            solved.append(design.solved(picture[window][design.mask], temporal))
        # one matrix for seen and held-out repeats, so that their joint covariance stays positive definite
        common = np.mean([c for *_, c in solved], axis=0)
        for value, *_ in solved:
            value[design.shifts] += moved
        for part, (value, shown, _) in zip(parts, solved, strict=True):
            found.append(
                Pattern(
                    captures=tuple(c.id for c in part), held_out=part[0].id in out, channel=channel, bands=design.bands,
                    value=value, shown=shown, common=common, mix=design.mix, beyond=design.beyond, shown_by=shown_by,
                    levels_e=levels, light=light,
                    ghost=ghost_by, reach=design.reach, places_um=_places_um(camera, points),
                )
            )  # fmt: skip
    return found


def _places_um(camera: CameraModel, points: FloatArray) -> tuple[tuple[float, float], ...]:
    """Four points (x, y) from the frame's middle, um, whose mean and variances are those of `points` (pixels, 2),
    px."""
    middle, spread = (
        np.mean(points, axis=0) - 0.5 * np.array([camera.cols - 1, camera.rows - 1]),
        np.std(points, axis=0),
    )
    corners = camera.pixel_pitch_um * (middle + spread * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]))
    return tuple((float(x), float(y)) for x, y in corners)


def _field(camera: CameraModel, points: FloatArray, shifts: FloatArray) -> FloatArray:
    """Displacement (2, pixels), px, at which a drawing is sampled for an image with these shifts (x, y, radial,
    radial^3, tangential)."""
    u, v, r2 = from_middle(camera, points)
    x, y, radial, radial3, across = shifts
    outwards = radial + radial3 * r2
    return np.array([x - outwards * u + across * v, y - outwards * v - across * u])


def _ghost_by(
    dataset: Dataset, design: _LinearModel, seen: FloatArray, window: tuple[slice, slice]
) -> Callable[[Effects], float]:
    """Function of effects: change of the ghost's coefficient by their reflections. They act on the pattern's and on the
    lit screen's image, whose ratio is fitted."""
    picture, lit = np.nan_to_num(seen), np.isfinite(seen).astype(float)
    weight = design.weights[len(design.bands) + GHOST].astype(np.float32)
    before = picture[window][design.mask]

    def coefficient(effects: Effects) -> float:
        shown, white = picture, lit
        shown, white = (with_reflections(dataset.camera, image, effects) for image in (shown, white))
        after = shown[window][design.mask] / np.maximum(white[window][design.mask], 1e-6)
        return float(weight @ (after - before))

    return coefficient


def _shown_by(dataset: Dataset, design: _LinearModel, canvas: Canvas) -> Callable[[Effects], FloatArray]:
    """Function of effects: change (k,) of a pattern's coefficients by those on the screen's light. The pattern is drawn
    as such a screen shows it, over the lit screen."""
    none = np.zeros(len(design.weights))

    @lru_cache(maxsize=8)
    def changed(showing: tuple[Effect, ...]) -> FloatArray:
        change = canvas.picture((canvas.as_shown(showing, dataset.camera) - canvas.low) * design.passed)
        return np.asarray(design.weights @ change[design.mask])

    def coefficients(effects: Effects) -> FloatArray:
        showing = acting(effects, SHOWN)
        return changed(showing) if showing else none

    return coefficients


def _refine_warp(
    dataset: Dataset,
    seen: FloatArray,
    target: FloatArray,
    warp: ScreenWarp,
    window: tuple[slice, slice],
    channel: str,
    light: Spectrum | None,
) -> ScreenWarp:
    """Improve the registration `warp` on the pattern itself, by Gauss-Newton steps, each of which has to lower the
    residual.

    Where cells are a whole number of pixels and stand square, the pattern's aliases are coherent: a strong blur that
    the step's smooth OTF doesn't follow then looks like a displacement, up to 0.2 px, and the next steps go on from
    there. The residual is therefore compared with a smooth OTF of `JUDGED_ORDER`. A displacement that it doesn't show
    is left at what the corners say."""
    best = _PlacedPattern.of(dataset, seen, target, warp, window, channel, light)
    for _ in range(REFINEMENTS):
        tried = _PlacedPattern.of(dataset, seen, target, best.step(), window, channel, light)
        if tried.left_rms >= best.left_rms:
            break
        best = tried
    return best.warp


@dataclass(frozen=True)
class _PlacedPattern:
    """A pattern drawn where `warp` places it, and what of the recorded image it leaves in one channel's n pixels."""

    warp: ScreenWarp
    slopes: FloatArray  # (2 terms, n): change of the drawn picture by each term of the displacement in x, then in y
    #: (k, n): products of even powers of the frequency and the lens's OTF, by their order, and last a constant
    smooth: FloatArray
    residual: FloatArray  # (n,): recorded less drawn image

    @staticmethod
    def of(
        dataset: Dataset,
        seen: FloatArray,
        target: FloatArray,
        warp: ScreenWarp,
        window: tuple[slice, slice],
        channel: str,
        light: Spectrum | None,
    ) -> _PlacedPattern:
        """Draw the cells `target` for the window of the recorded image `seen`. Raises NotDetermined for too few
        pixels."""
        canvas, otf = Canvas.of(target, warp, window), lens_otf(dataset, channel, light)
        mask = channel_pixels(dataset, canvas, channel, seen)
        whole = canvas.whole
        lens = whole.spectrum * otf(np.minimum(np.hypot(whole.fx, whole.fy), otf.x[-1]))
        drawn = lens * aperture_otf(whole.fx, whole.fy, dataset.camera.fill_factor)
        picture, across, down = (
            canvas.sampled(part)[mask] for part in (drawn, 2j * np.pi * whole.fx * drawn, 2j * np.pi * whole.fy * drawn)
        )
        terms = warp.basis(mask_points(mask, window))
        # a smooth change of the OTF is fitted as well: with the phase of the cells on the pixels, aliases look like a
        # displacement
        fx, fy = (np.clip(f, -REGISTERED_CY_PER_PX, REGISTERED_CY_PER_PX) for f in (whole.fx, whole.fy))
        powers = even_powers(fx, fy, JUDGED_ORDER, REGISTERED_CY_PER_PX)
        smooth = [canvas.sampled(term * lens)[mask] for term in powers]
        return _PlacedPattern(
            warp,
            np.concatenate([across * terms, down * terms]),
            np.array([*smooth, np.ones_like(picture)]),
            seen[window][mask] - picture,
        )

    @cached_property
    def left_rms(self) -> float:
        """Root mean square residual with a free smooth change of the OTF."""
        left = self.residual - _solve(self.smooth, self.residual) @ self.smooth
        return float(np.sqrt(np.mean(np.square(left))))

    def step(self) -> ScreenWarp:
        """Return the registration after a Gauss-Newton step, with a smooth OTF of `REGISTERED_ORDER`."""
        powers = (REGISTERED_ORDER // 2 + 1) ** 2
        columns = np.concatenate([self.slopes, self.smooth[:powers], self.smooth[-1:]])
        change = _solve(columns, self.residual)[: len(self.slopes)]
        return self.warp.displace(change.reshape(2, -1))


def _solve(columns: FloatArray, value: FloatArray) -> FloatArray:
    """Return the least squares coefficients (k,) of `columns` (k, n) for `value` (n,)."""
    scale = np.sqrt(np.mean(columns**2, axis=1))
    unit = columns / scale[:, None]
    return np.asarray(np.linalg.lstsq(unit @ unit.T, unit @ value, rcond=1e-12)[0] / scale)


def _band_masks(canvas: Canvas) -> Iterator[tuple[tuple[float, float], float | None, NDArray[np.bool_]]]:
    """(edges of its ring in cy/px, middle of its sector in rad, mask of its frequencies) of every band that isn't
    empty. The lowest ring is one band, with None for the sector."""
    fy, fx = canvas.frequencies
    radius, angle = np.hypot(fx, fy), np.arctan2(fy, fx + 0.0 * fy)
    for i, (low, high) in enumerate(pairwise(RINGS_CY_PER_PX)):
        ring = (radius >= low) & (radius < high)
        for k in range(SECTORS if i else 1):
            away = _away(angle, k * np.pi / SECTORS)
            part = ring & (np.abs(away) <= 0.5 * np.pi / SECTORS) if i else ring
            if part.any():
                yield (low, high), k * np.pi / SECTORS if i else None, part


def _away(angle: FloatArray, middle: float) -> FloatArray:
    """Angles from the middle of a sector, of undirected orientations: -pi/2..pi/2."""
    return np.asarray(np.mod(angle - middle + 0.5 * np.pi, np.pi) - 0.5 * np.pi)


@dataclass(frozen=True)
class _LinearModel:
    """The linear model of one channel's pixels with k coefficients."""

    mask: NDArray[np.bool_]  # (rows, cols): its pixels in the window
    bands: tuple[Band, ...]
    columns: FloatArray  # (k, pixels)
    fixed: FloatArray  # (pixels,): weak parts beyond the bands, which have no coefficient
    weights: FloatArray  # (k, pixels): from pixels to coefficients
    #: (bands, EVEN_TERMS + 4 bands + parts): coefficients of the bands in least squares fits of even powers of the
    #: frequency times P, of the halves of the bands, of these with a phase of 90 degrees, and of the parts beyond the
    #: bands.
    mix: FloatArray
    beyond: FloatArray  # as in Pattern
    passed: FloatArray  # (rows, cols / 2 + 1): OTF that P was drawn with
    reach: float  # as in Pattern

    @staticmethod
    def of(
        dataset: Dataset,
        canvas: Canvas,
        channel: str,
        light: Spectrum | None,
        seen: FloatArray,
        turned: FloatArray,
        laid: FloatArray,
    ) -> _LinearModel:
        """Return the model of a channel. `seen`: the recorded image; `turned`: the same, blurred and rotated by 180
        degrees; `laid` (rows, cols / 2 + 1): power spectrum by which the nodes of the bands are placed."""
        camera = dataset.camera
        fy, fx = canvas.frequencies
        radius, angle = np.hypot(fx, fy), np.arctan2(fy, fx + 0.0 * fy)
        otf = lens_otf(dataset, channel, light)
        passed = canvas.passed(otf, camera.fill_factor)
        spectrum = canvas.low * passed
        mask = channel_pixels(dataset, canvas, channel, seen)
        power = np.abs(spectrum) ** 2
        bands, columns, halves, turned_halves = [], [], [], []
        inside = radius < RINGS_CY_PER_PX[-1]
        smooth = [canvas.picture(np.where(inside, term * spectrum, 0.0))[mask] for term in even_powers(fx, fy)]
        low_part = np.zeros(canvas.shape)
        for (low, high), sector, part in _band_masks(canvas):
            middle = sector or 0.0
            away = _away(angle, middle)
            # in two halves, for changes of the OTF within the band
            sides = [part & (radius < 0.5 * (low + high)), part & (radius >= 0.5 * (low + high))]
            pieces = [canvas.picture(np.where(side, spectrum, 0.0)) for side in sides]
            # with a phase of 90 degrees along the band's direction: the imaginary part of the OTF
            on = 1j * np.where(np.cos(angle - middle) >= 0, spectrum, -spectrum)
            turned_halves += [canvas.picture(np.where(side, on, 0.0))[mask] for side in sides]
            picture = pieces[0] + pieces[1]
            low_part += picture
            columns.append(picture[mask])
            halves += [piece[mask] for piece in pieces]
            bands.append(_band(part, radius, away, middle, laid, power, (low, high), whole=sector is None))
        corner = (radius >= RINGS_CY_PER_PX[-1]) & below_nyquist(canvas)
        parts = [[BeyondPart.of(canvas.picture(np.where(corner, spectrum, 0.0)), fx, fy, np.where(corner, power, 0.0))]]
        parts += canvas.beyond(otf, camera.fill_factor)
        beyond = [np.sum([part.picture for part in together], axis=0) for together in parts]
        outside = [part for together in parts for part in together]
        picture = (low_part + np.sum(beyond, axis=0))[mask]
        across, down = (canvas.picture(2j * np.pi * f * spectrum)[mask] for f in (fx, fy))
        u, v, r2 = from_middle(camera, mask_points(mask, canvas.window))
        # an image displaced outwards by s has, at a place, what lay further in by s
        outwards, around = -(u * across + v * down), -(u * down - v * across)
        grey = np.clip(picture, 0.0, 1.0)
        more = [
            grey * (1.0 - grey),
            turned[canvas.window][mask],
            np.ones_like(picture),
            across,
            down,
            outwards,
            r2 * outwards,
            around,
        ]
        strong = [part[mask] for part in beyond if np.std(part[mask]) > LEAST_BEYOND]
        fixed = sum((part[mask] for part in beyond if not np.std(part[mask]) > LEAST_BEYOND), np.zeros(len(u)))
        table = np.array(columns + more + strong)
        scale = np.sqrt(np.mean(table**2, axis=1))
        unit = table / scale[:, None]
        weights = np.linalg.solve(unit @ unit.T, unit) / scale[:, None]
        # An odd change of the OTF (coma) isn't fitted, as the registration takes up most of it. What is left would look
        # like a weak ghost, whose coefficient is therefore that of a fit with it.
        ghost = len(bands) + GHOST
        odd = np.array(turned_halves)
        # in a small window half a band may hold no frequency
        unit = np.concatenate([unit, odd / np.maximum(np.sqrt(np.mean(odd**2, axis=1)), LEAST_ODD)[:, None]])
        alone = np.eye(len(unit))[ghost]
        weights[ghost] = np.linalg.lstsq(unit @ unit.T, alone, rcond=1e-10)[0] @ unit / scale[ghost]
        pieces = [*smooth, *halves, *turned_halves, *(part.picture[mask] for part in outside)]
        mix = weights[: len(bands)] @ np.array(pieces).T
        beyond_f = np.array([part.fx + part.fy for part in outside]).reshape(len(outside), 2, 2)
        return _LinearModel(mask, tuple(bands), table, fixed, weights, mix, beyond_f, passed, float(np.sqrt(r2.max())))

    @property
    def shifts(self) -> slice:
        """Indices of the coefficients that displace the image: x, y, radial, radial^3, tangential."""
        return slice(len(self.bands) + SHIFT_X, len(self.bands) + ACROSS + 1)

    def coefficients(self, seen: FloatArray) -> FloatArray:
        """Least squares coefficients (k,) for the values `seen` (pixels,)."""
        return np.asarray(self.weights @ (seen - self.fixed))

    def left_rms(self, picture: FloatArray) -> float:
        """Root mean square residual of the fit to an image (rows, cols) of the window."""
        seen = picture[self.mask]
        left = seen - self.fixed - self.coefficients(seen) @ self.columns
        return float(np.sqrt(np.mean(np.square(left))))

    def solved(self, seen: FloatArray, temporal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients (k,); their covariance by temporal noise of variance `temporal` (pixels,); and their covariance
        by the rest of the residuals.

        As the pixels' variances differ, the latter is estimated from the squared residuals (White 1980).
        """
        value = self.coefficients(seen)
        left = seen - self.fixed - value @ self.columns
        spread = (self.weights * left**2) @ self.weights.T
        shown = (self.weights * temporal) @ self.weights.T
        share = max(1.0 - float(temporal.mean() / np.mean(left**2)), 0.0)
        return value, shown, share * spread


def even_powers(
    fx: FloatArray, fy: FloatArray, order: int = EVEN_ORDER, end: float = RINGS_CY_PER_PX[-1]
) -> list[FloatArray]:
    """Return the products fx^i fy^j of even i + j up to `order`, frequencies over `end`."""
    x, y = fx / end, fy / end
    return [x ** (n - k) * y**k for n in range(0, order + 1, 2) for k in range(n + 1)]


def _band(
    part: NDArray[np.bool_],
    radius: FloatArray,
    away: FloatArray,
    middle: float,
    laid: FloatArray,
    power: FloatArray,
    ends: tuple[float, float],
    *,
    whole: bool,
) -> Band:
    """Return the band of the frequencies `part` and its nodes: the band is divided into `NODES` cells in radius and
    angle, and each has its node at the mean of the power `laid`, and its share of `power`."""
    r, a = radius[part], away[part]
    on, p = (np.where(r > 0, at[part], 0.0) for at in (laid, power))  # no blur changes frequency 0
    span = np.pi if whole else np.pi / SECTORS
    i = np.minimum(((r - ends[0]) / (ends[1] - ends[0]) * NODES[0]).astype(int), NODES[0] - 1)
    j = np.clip(((a / span + 0.5) * NODES[1]).astype(int), 0, NODES[1] - 1)
    cell = i * NODES[1] + j
    total = np.bincount(cell, on, NODES[0] * NODES[1])
    keep = total > 0
    at_r = np.bincount(cell, on * r, len(total))[keep] / total[keep]
    at_a = middle + np.bincount(cell, on * a, len(total))[keep] / total[keep]
    share = np.bincount(cell, p, len(total))[keep] / max(float(p.sum()), 1e-300)
    return Band(
        float(share @ at_r),
        float(np.rad2deg(middle)),
        at_r * np.cos(at_a),
        at_r * np.sin(at_a),
        share,
        float(p.sum()),
        np.flatnonzero(keep) // NODES[1] >= NODES[0] // 2,
    )


def joint_covariance(places: Sequence[tuple[int, Pattern, int]], dataset: Dataset) -> FloatArray:
    """Covariance (n, n) of n coefficients, each (number of the group, pattern, index).

    Seen and held-out repeats of one pattern in one channel share `Pattern.common`.
    """
    n = len(places)
    table = np.zeros((n, n))
    for i, (g, p, b) in enumerate(places):
        for j in range(i, n):
            h, q, c = places[j]
            if g != h or p.channel != q.channel:
                continue
            both = p.common[b, c] if p is q else 0.5 * (p.common[b, c] + q.common[b, c])
            table[i, j] = table[j, i] = both + (p.shown[b, c] if p is q else 0.0)
    return table


# --- Excess of light at the borders between lit and dark cells of a random pattern, where grey levels are seen --------


BORDER_FLOOR = 0.0015  # standard deviation of the light at borders beside noise


def measure_cell_borders(dataset: Dataset) -> Observable:
    """Coefficient of P (1 - P) in the fit of the pattern P, which is 0 on dark and 1 on lit cells (`pattern_fit`).

    It is the excess of light where the blurred picture is grey: at borders of cells. A nonlinear response of the camera
    and the grey levels of the screen change it.
    """
    found = patterns(dataset)
    points = [(g, p, len(p.bands) + BORDER) for g, group in enumerate(found) for p in group]
    value = np.array([p.value[b] for _, p, b in points])

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(points))
        model = Uniform(dataset.camera, effects)
        for k, (_, p, b) in enumerate(points):
            mean[k] = p.shown_by(effects)[b]
            if not model.is_linear:
                low, high = p.levels_e
                out = model.response(np.array([low, 0.5 * (low + high), high]))
                # a term a y (1 - y) of the response lifts its middle, y = 1/2, by a / 4
                mean[k] += 4.0 * float((out[1] - out[0]) / (out[2] - out[0]) - 0.5)
        return Prediction(mean, {})

    return Observable(
        measurement=CELL_BORDERS, reach=1e9, value=value,
        covariance=joint_covariance(points, dataset) + np.diag(np.full(len(value), BORDER_FLOOR**2)),
        labels=tuple(Label(float(i), p.channel, "borders of cells", p.captures, p.held_out) for i, (_, p,
        _) in enumerate(points)),
        reads=SHOWN | {"signal.response"}, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


CELL_BORDERS = Measurement(
    "cell_borders",
    title="borders of pattern cells",
    order=420,
    axis="level",
    unit="1",
    make=measure_cell_borders,
    quantity="excess light at borders, share",
    places="borders",
)


# --- The ghost of a pattern: its image, rotated by 180 degrees about the frame's middle -------------------------------


GHOST_FLOOR = 1.5e-4  # standard deviation of a ghost's share beside noise


def measure_ghost(dataset: Dataset) -> Observable:
    """Coefficient of the rotated image in the fit of the pattern: the ghost's share of the light."""
    points = [(g, p, len(p.bands) + GHOST) for g, group in enumerate(patterns(dataset)) for p in group]
    value = np.array([p.value[b] for _, p, b in points])

    def predict(effects: Effects) -> Prediction:
        reflecting = acting(effects, REFLECTIONS)
        return Prediction(np.array([p.ghost(effects) if reflecting else 0.0 for _, p, _ in points]), {})

    return Observable(
        measurement=PATTERN_GHOST, reach=1e9, value=value,
        covariance=joint_covariance(points, dataset) + np.diag(np.full(len(value), GHOST_FLOOR**2)),
        labels=tuple(Label(float(i), p.channel, "ghost", p.captures, p.held_out) for i, (_, p, _) in enumerate(points)),
        reads=REFLECTIONS, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


PATTERN_GHOST = Measurement(
    "ghost",
    title="ghost of the pattern",
    order=430,
    axis="level",
    unit="1",
    make=measure_ghost,
    quantity="ghost's share of the light",
    places="ghosts",
)
