"""Patterns on a screen: how much contrast a random pattern keeps at every frequency, what its rims lack, what lies over it
turned about the axis, where each colour's copy of it lands, and the grid of the screen's own pixels.

The Bernoulli pattern is drawn where the checkerboard says that it is (`lab.fit.psf.screen_registration`) and passed through the baseline's
transfer function. Band by band of frequency and orientation its picture is split, and what is seen is a sum of these parts:

    seen = sum over bands of c_b P_b + rim P (1 - P) + turned T + even + shifts . gradient P + P beyond the bands

by least squares over each channel's own pixels; a channel whose picture lies elsewhere than green's is drawn there. Under the
baseline every c_b is 1 and all the rest 0. Drawn and seen by the same pixels, aliasing is in both, so that a band holds its
own frequencies alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, special
from scipy.interpolate import CubicSpline, RectBivariateSpline

from lab.capture_kinds.base import Capture
from lab.capture_kinds.bernoulli import BernoulliCapture
from lab.capture_kinds.black import BlackCapture
from lab.capture_kinds.checkerboard import CheckerboardCapture
from lab.capture_kinds.white import WhiteCapture
from lab.diagnose.measurements.summaries import (
    REFLECTIONS,
    SHIFT,
    SHOWN,
    Block,
    Effects,
    Label,
    Prediction,
    Study,
    act_on,
    held_out_of,
)
from lab.errors import NotDetermined
from lab.fit.psf.drawn_pattern import area_drawn
from lab.fit.psf.screen_registration import ScreenWarp, register
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.frame import screen_light, with_reflections
from sim.optics.diffraction import aperture_otf
from sim.point import TRANSFER, common_wavelengths, displaced_um, optical_transfer, transfer_at
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import Uniform

OVERSAMPLE = 4
LARGEST_PX = 320  # a side of the part that is looked at: enough for a band's contrast to 1e-3
RIM_PX = 12  # of the frame and of that part: drawings there lack what lies beyond
PATTERN_RIM_CELLS = 2.0
#: ... and what lies beyond, along the larger of both axes: not looked at, but there.
BEYOND_CY_PER_PX = (0.5, 0.62, 0.8, 4.0)
RINGS_CY_PER_PX = (0.0, 0.03, 0.08, 0.14, 0.2, 0.27, 0.34, 0.42, 0.5)
SECTORS = 4  # orientations of a half turn: about 0, 45, 90, 135 degrees
NODES = (4, 3)  # of a band, in radius and angle, at which an effect's transfer is taken
LARGEST_STD = 0.04  # of a band's contrast: beyond, it says nothing
TURNED_BLUR_PX = 3.0
LEAST_BEYOND = 5e-4  # of the contrast: weaker parts beyond the bands are taken as drawn
REFINEMENTS = 2
LEAST_PIXELS = 1500
FEWEST_CELLS = 400

# --- what doesn't average out, and what is free ---
CONTRAST_FLOOR = 0.0015  # of a band's contrast: drawing and registration
CONTRAST_SCALE_STD = 0.01  # levels of screens are free: each channel of each part of the repeats
SCREEN_BLUR_PX = 0.08  # a target's rims needn't be sharp: standard deviation of a Gaussian
RIM_FLOOR = 0.0015
TURNED_FLOOR = 1.5e-4
COLOUR_FLOOR_PX = (
    0.012  # cells of whole pixels alias alike everywhere: what a drawing gets wrong there doesn't average out
)
MOVED_PX = 0.1  # a channel further off is drawn where it is: less shows as well where the blur is not the drawn one
CERTAIN = 8.0  # standard deviations
PLACINGS = 4  # steps in which a shifted picture is found
GRID_STD = 1.3  # of the strongest line's number: the noise's mean is measured, too
GRID_DETREND_PX = 8.0  # what is wider is shading
GRID_LOWEST = 0.12  # cycles a sample: below, what was taken off as shading still tells
GRID_LARGEST = 512  # samples a side
GRID_OF_CAMERA = 12.0  # of a flat's mean power: a line that flats have, too, is the camera's


@dataclass(frozen=True)
class Pattern:
    """A Bernoulli pattern of one pose, in one channel, in one part of its repeats: coefficients and their covariance."""

    captures: tuple[str, ...]
    held_out: bool
    channel: str
    bands: tuple[Band, ...]
    value: FloatArray  # (bands + MORE + parts beyond the bands,)
    shown: FloatArray  # covariance by what differs from repeat to repeat
    common: FloatArray  # ... and by what white, black and drawing share
    mix: FloatArray  # (bands, 4 bands): what the halves of the bands, then their phases, contribute to the bands' coefficients
    shown_by: Callable[[Effects], FloatArray]  # as `value`: what screens that show greys otherwise change
    levels_e: tuple[float, float]  # electrons of black and of white
    light: Spectrum | None
    turned: Callable[
        [Effects], float
    ]  # the coefficient of the turned picture that effects on the image as a whole make
    reach: float  # largest distance from the frame's middle in half diagonals


#: Coefficients behind the bands', in their order: rim, turned, even, shift x, shift y, radial, radial^3, across.
RIM, TURNED, EVEN, SHIFT_X, RADIAL, RADIAL3, ACROSS = 0, 1, 2, 3, 5, 6, 7


@dataclass(frozen=True)
class Band:
    """A ring's sector: the mean frequency and orientation of the pattern's power in it, and nodes with their shares of it."""

    frequency: float
    angle_deg: float
    fx: FloatArray
    fy: FloatArray
    share: FloatArray
    power: float  # of the pattern in it
    upper: NDArray[np.bool_]  # nodes of the upper half of the frequencies


def patterns(study: Study) -> list[list[Pattern]]:
    """Every Bernoulli pattern by channel and part; a list for each (pose, target), which share the light of white and black."""
    return study.once(_patterns)


def _patterns(study: Study) -> list[list[Pattern]]:
    if not study.diffraction_is_known:
        raise NotDetermined("bernoulli", "f-number or pixel pitch isn't stated: no diffraction to draw patterns with")
    captures: Any = study.recordings.captures
    groups = study.groups(BernoulliCapture, lambda c: (c.screen.pose, c.target))
    if not groups:
        raise NotDetermined("bernoulli", "no bernoulli captures")
    found, reason = [], ""
    for i, group in enumerate(groups):
        pose = group[0].screen.pose
        whites, blacks, boards = (
            [c for c in captures(k, study.side) if c.screen.pose == pose]
            for k in (WhiteCapture, BlackCapture, CheckerboardCapture)
        )
        missing = [n for n, some in (("white", whites), ("black", blacks), ("checkerboard", boards)) if not some]
        if missing:
            reason = f"pose {pose} lacks {' and '.join(missing)} captures"
            continue
        out = held_out_of(group, i, 0) if len(group) > 1 else set()
        try:
            found.append(_measured(study, group, whites, blacks, boards, out))
        except NotDetermined as refused:
            reason = refused.reason
    if not found:
        raise NotDetermined("bernoulli", reason)
    return found


def _rate(study: Study, captures: Sequence[Capture]) -> FloatArray:
    """Mean of the frames above black and dark current, DN a second of exposure."""
    recordings, noise = study.recordings, study.noise
    total = np.zeros((study.camera.rows, study.camera.cols))
    for capture in captures:
        frame = recordings.frame(capture)
        clipped = float(np.mean(frame >= study.saturation_dn))
        if clipped > 0.001:
            raise NotDetermined("bernoulli", f"{capture.id}: {100 * clipped:.1f} % of the frame is saturated")
        total += (frame - noise.black) / max(capture.exposure_s, 1e-12) - noise.dark_dn_per_s
    return total / len(captures)


def _measured(
    study: Study,
    group: Sequence[Any],
    whites: Sequence[Any],
    blacks: Sequence[Any],
    boards: Sequence[Any],
    out: set[str],
) -> list[Pattern]:
    camera = study.camera
    white, black = _rate(study, whites), _rate(study, blacks)
    contrast = white - black
    for plane in mosaic.planes(contrast, camera.cfa).values():
        plane[plane < 0.2 * np.quantile(plane, 0.98)] = np.nan  # where the screen isn't
    boards = [c for c in boards if c.target == boards[0].target]
    cells = study.recordings.target(group[0].target)
    if cells.size < FEWEST_CELLS or not 0.02 < float(np.mean(cells > 0)) < 0.98:
        raise NotDetermined("bernoulli", f"{group[0].target} holds no random pattern of {FEWEST_CELLS} cells or more")
    target = np.asarray(cells, float) / float(cells.max())
    parts = [p for p in ([c for c in group if c.id not in out], [c for c in group if c.id in out]) if p]
    seen = [(_rate(study, part) - black) / contrast for part in parts]
    whole = np.average(seen, axis=0, weights=[len(p) for p in parts])
    warp = register(
        (_rate(study, boards) - black) / contrast, whole, study.recordings.target(boards[0].target),
        (target > 0.5).astype(np.uint8), group[0].screen.cell_camera_px,
    )  # fmt: skip
    light = study.spectrum(group[0].screen.radiance) if group[0].screen.radiance else None
    window = _window(whole, warp, target.shape)
    reference = "Y" if camera.cfa == "MONO" else "G"
    for _ in range(REFINEMENTS):
        warp = _refined(study, whole, target, warp, window, reference, light)
    canvas = _Canvas.of(target, warp, window)
    # one set of frequencies for all channels, so that an effect's transfer is formed once
    otfs = [_lens_otf(study, channel, light) for channel in camera.channels]
    laid = np.sum([np.square(np.abs(canvas.low * canvas.passed(otf, camera.fill_factor))) for otf in otfs], axis=0)
    turned = ndimage.gaussian_filter(np.nan_to_num(whole), TURNED_BLUR_PX)[::-1, ::-1]
    found = []
    for channel in camera.channels:
        design = _Design.of(study, canvas, channel, light, whole, turned, laid)
        moved = design.coefficients(whole[window][design.mask])[design.shifts]
        points = _points(design.mask, window)
        field = _field(camera, points, moved)
        if channel != reference and np.abs(field).max() > MOVED_PX:
            # too far for a linear step: the pattern is drawn anew at the shifted place
            there = np.linalg.lstsq(warp.basis(points).T, field.T, rcond=1e-12)[0].T
            drawn = _Canvas.of(target, warp.displaced(there), window)
            design = _Design.of(study, drawn, channel, light, whole, turned, laid)
        else:
            drawn, moved = canvas, np.zeros(len(moved))
        area = contrast[window][design.mask]
        exposure = group[0].exposure_s
        levels = (
            float(np.nanmean(black[window][design.mask])) * exposure / study.noise.gain,
            float(np.nanmean(white[window][design.mask])) * exposure / study.noise.gain,
        )
        turned_by = _turned_by(study, design, whole, window)
        shown_by = _shown_by(study, design, drawn)
        solved = []
        for part, picture in zip(parts, seen, strict=True):
            dn = np.maximum(picture[window][design.mask] * area + black[window][design.mask], 0.0) * exposure
            temporal = (study.noise.gain * dn + study.noise.read_dn**2) / len(part) / (area * exposure) ** 2
            solved.append(design.solved(picture[window][design.mask], temporal))
        # one for all parts, or what they share could exceed what one of them has
        common = np.mean([c for *_, c in solved], axis=0)
        for value, *_ in solved:
            value[design.shifts] += moved
        for part, (value, shown, _) in zip(parts, solved, strict=True):
            found.append(
                Pattern(
                    captures=tuple(c.id for c in part), held_out=part[0].id in out, channel=channel, bands=design.bands,
                    value=value, shown=shown, common=common, mix=design.mix, shown_by=shown_by, levels_e=levels, light=light,
                    turned=turned_by, reach=design.reach,
                )
            )  # fmt: skip
    return found


def _points(mask: NDArray[np.bool_], window: tuple[slice, slice]) -> FloatArray:
    """(x, y) in the frame of a mask's pixels, (pixels, 2)."""
    row, col = np.nonzero(mask)
    return np.column_stack([col + window[1].start, row + window[0].start]).astype(float)


def _field(camera: CameraModel, points: FloatArray, shifts: FloatArray) -> FloatArray:
    """Where a pixel sees what would lie at itself without these shifts (x, y, radial, radial^3, across), less where it is: (2, pixels), px."""
    u, v, r2 = _from_middle(camera, points)
    x, y, radial, radial3, across = shifts
    outwards = radial + radial3 * r2
    return np.array([x - outwards * u + across * v, y - outwards * v - across * u])


def _from_middle(camera: CameraModel, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Along columns and rows from the frame's middle, in half diagonals, and the squared distance."""
    half = camera.half_diagonal_px
    u, v = ((points - 0.5 * np.array([camera.cols - 1, camera.rows - 1])) / half).T
    return u, v, u * u + v * v


def _turned_by(
    study: Study, design: _Design, seen: FloatArray, window: tuple[slice, slice]
) -> Callable[[Effects], float]:
    """What effects on the whole image do to the coefficient of the turned picture: pattern and lit screen through them, levelled."""
    picture, lit = np.nan_to_num(seen), np.isfinite(seen).astype(float)
    weight = (design.inverse[len(design.bands) + TURNED] @ design.columns).astype(np.float32)
    before = picture[window][design.mask]

    def coefficient(effects: Effects) -> float:
        shown, white = picture, lit
        shown, white = (with_reflections(study.camera, image, effects) for image in (shown, white))
        after = shown[window][design.mask] / np.maximum(white[window][design.mask], 1e-6)
        return float(weight @ (after - before))

    return coefficient


def _shown_by(study: Study, design: _Design, canvas: _Canvas) -> Callable[[Effects], FloatArray]:
    """What effects on a screen's light do to a pattern's coefficients: it is drawn as the screen shows it, over the lit screen."""
    none = np.zeros(len(design.inverse))

    @lru_cache(maxsize=8)
    def changed(acting: tuple[Effect, ...]) -> FloatArray:
        change = canvas.picture((canvas.as_shown(acting, study.camera) - canvas.low) * design.passed)
        return np.asarray(design.inverse @ (design.columns @ change[design.mask]))

    def coefficients(effects: Effects) -> FloatArray:
        acting = tuple(e for e, on in zip(effects, act_on(effects, SHOWN), strict=True) if on)
        return changed(acting) if acting else none

    return coefficients


def _window(seen: FloatArray, warp: ScreenWarp, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The part of the frame that is looked at: the pattern's middle, even numbers of rows and columns."""
    row, col = (np.arange(0, n, 4) for n in seen.shape)
    x, y = np.meshgrid(col, row)
    cells = warp.cells(np.column_stack([x.ravel(), y.ravel()]).astype(float)).reshape(*x.shape, 2)
    inside = (cells[..., 0] > 0) & (cells[..., 0] < shape[1]) & (cells[..., 1] > 0) & (cells[..., 1] < shape[0])
    if not inside.any():
        raise NotDetermined("bernoulli", "the pattern lies outside the frame")
    slices = []
    for at, length in ((y[inside], seen.shape[0]), (x[inside], seen.shape[1])):
        low, high = max(int(at.min()) - RIM_PX, 0), min(int(at.max()) + RIM_PX + 4, length)
        size = 2 * (min(high - low, LARGEST_PX) // 2)
        low += (high - low - size) // 2
        low -= low % 2  # mosaics keep their phase
        slices.append(slice(low, low + size))
    return slices[0], slices[1]


@dataclass(frozen=True)
class _Canvas:
    """The pattern drawn by area on a window of the frame, `OVERSAMPLE` samples a pixel."""

    warp: ScreenWarp
    window: tuple[slice, slice]
    fine: FloatArray
    inside: NDArray[np.bool_]  # pixels well inside the pattern

    @staticmethod
    def of(target: FloatArray, warp: ScreenWarp, window: tuple[slice, slice]) -> _Canvas:
        y, x = (np.arange(w.start - 16.0, w.stop + 24.0, 8.0) for w in window)
        at = warp.cells(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x), 2)
        row, col = (w.start + (np.arange(OVERSAMPLE * (w.stop - w.start)) + 0.5) / OVERSAMPLE - 0.5 for w in window)
        cell_x, cell_y = (RectBivariateSpline(y, x, at[:, :, k])(row, col) for k in (0, 1))
        inside = np.ones((window[0].stop - window[0].start, window[1].stop - window[1].start), bool)
        for cell, count in ((cell_x, target.shape[1]), (cell_y, target.shape[0])):
            middle = cell[OVERSAMPLE // 2 :: OVERSAMPLE, OVERSAMPLE // 2 :: OVERSAMPLE]
            inside &= (middle > PATTERN_RIM_CELLS) & (middle < count - PATTERN_RIM_CELLS)
        inside[:RIM_PX] = inside[-RIM_PX:] = False
        inside[:, :RIM_PX] = inside[:, -RIM_PX:] = False
        return _Canvas(warp, window, np.asarray(area_drawn(target, cell_x, cell_y), float), inside)

    @property
    def shape(self) -> tuple[int, int]:
        """Of the window, px."""
        return self.inside.shape[0], self.inside.shape[1]

    @cached_property
    def drawn(self) -> NDArray[np.complex128]:
        """The picture's transform, at all frequencies of its samples."""
        return np.asarray(fft.rfft2(self.fine))

    @cached_property
    def low(self) -> NDArray[np.complex128]:
        """The picture's transform below half a cycle a pixel: (rows, cols / 2 + 1), as of the window's own pixels."""
        return self._below(self.drawn)

    def as_shown(self, effects: Effects, camera: CameraModel) -> NDArray[np.complex128]:
        """As `low`, of the picture as a screen with effects shows it, over its lit state there."""
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
        # a sample is a mean over its square; a pixel's centre lies between samples
        turn = np.exp(1j * np.pi * (fx + fy) * (1.0 - 1.0 / OVERSAMPLE))
        return np.asarray(part * turn / (np.sinc(fx / OVERSAMPLE) * np.sinc(fy / OVERSAMPLE)))

    @property
    def frequencies(self) -> tuple[FloatArray, FloatArray]:
        """fy (rows, 1) and fx (1, cols / 2 + 1), cy/px."""
        return fft.fftfreq(self.shape[0])[:, None], fft.rfftfreq(self.shape[1])[None, :]

    def passed(self, otf: CubicSpline, fill_factor: float) -> FloatArray:
        """Transfer of a lens and of the pixel at these frequencies, (rows, cols / 2 + 1)."""
        fy, fx = self.frequencies
        return np.asarray(otf(np.hypot(fx, fy)) * aperture_otf(fx, fy, fill_factor))

    def picture(self, spectrum: NDArray[np.complex128]) -> FloatArray:
        """Back to the window's pixels."""
        return np.asarray(fft.irfft2(spectrum, self.shape))

    def beyond(self, otf: CubicSpline, fill_factor: float) -> list[FloatArray]:
        """What the lens passes above half a cycle a pixel, at the pixels: by ring and by whether it lies nearer to rows or columns.

        Cells of whole pixels repeat their spectrum: what aliases is coherent with what doesn't.
        """
        rows, cols = (OVERSAMPLE * n for n in self.shape)
        highest = min(float(otf.x[-1]), 0.5 * OVERSAMPLE)
        keep = np.abs(fft.fftfreq(rows, 1.0 / OVERSAMPLE)) < highest
        fy = fft.fftfreq(rows, 1.0 / OVERSAMPLE)[keep, None]
        fx = fft.rfftfreq(cols, 1.0 / OVERSAMPLE)[None, :]
        fx = fx[:, fx[0] < highest]
        high = (
            self.drawn[keep][:, : fx.shape[1]]
            * otf(np.minimum(np.hypot(fy, fx), highest))
            * aperture_otf(fx, fy, fill_factor)
        )
        high *= np.exp(1j * np.pi * fx * (1.0 - 1.0 / OVERSAMPLE)) / np.sinc(fx / OVERSAMPLE)
        high *= np.exp(1j * np.pi * fy * (1.0 - 1.0 / OVERSAMPLE)) / np.sinc(fy / OVERSAMPLE)
        largest, across = np.maximum(np.abs(fy), fx), fx >= np.abs(fy)
        found = []
        for low, end in pairwise(BEYOND_CY_PER_PX):
            for side in (across, ~across):
                part = np.where((largest >= low) & (largest < end) & (np.hypot(fy, fx) < highest) & side, high, 0.0)
                spread = np.zeros((rows, part.shape[1]), complex)
                spread[keep] = part
                folded = np.zeros((self.shape[0], cols // 2 + 1), complex)
                folded[:, : part.shape[1]] = spread.reshape(OVERSAMPLE, self.shape[0], -1).sum(axis=0) / OVERSAMPLE
                found.append(np.asarray(fft.irfft(fft.ifft(folded, axis=0), cols, axis=1)[:, ::OVERSAMPLE]))
        return found


def _lens_otf(study: Study, channel: str, light: Spectrum | None) -> CubicSpline:
    """The baseline's transfer without the pixel's aperture: it looks the same all around the axis."""
    f = np.linspace(0.0, 2.0, 101)
    whole = np.real(optical_transfer(study.camera, channel, light, f, 0.0 * f, (), "bernoulli"))
    return CubicSpline(f, whole / aperture_otf(f, 0.0 * f, study.camera.fill_factor))


def _refined(
    study: Study,
    seen: FloatArray,
    target: FloatArray,
    warp: ScreenWarp,
    window: tuple[slice, slice],
    channel: str,
    light: Spectrum | None,
) -> ScreenWarp:
    """The registration from the corners, improved by the pattern itself: a step of Gauss and Newton's method."""
    canvas, otf = _Canvas.of(target, warp, window), _lens_otf(study, channel, light)
    fy, fx = canvas.frequencies
    spectrum = canvas.low * canvas.passed(otf, study.camera.fill_factor)
    mask = _pixels(study, canvas, channel, seen)
    picture, across, down = (
        canvas.picture(part * spectrum)[mask] for part in (_below(canvas), 2j * np.pi * fx, 2j * np.pi * fy)
    )
    picture = picture + np.sum(canvas.beyond(otf, study.camera.fill_factor), axis=0)[mask]
    terms = warp.basis(_points(mask, window))
    columns = np.concatenate([across * terms, down * terms, [picture, np.ones_like(picture)]])
    step = np.linalg.lstsq(columns @ columns.T, columns @ (seen[window][mask] - picture), rcond=1e-12)[0]
    return warp.displaced(step[:-2].reshape(2, -1))


def _pixels(study: Study, canvas: _Canvas, channel: str, seen: FloatArray) -> NDArray[np.bool_]:
    mask = canvas.inside & np.isfinite(seen[canvas.window])
    step = mosaic.step(study.camera.cfa)
    own = np.zeros_like(mask)
    for row, col in mosaic.phases(study.camera.cfa)[channel]:
        own[row::step, col::step] = True
    mask &= own
    if mask.sum() < LEAST_PIXELS:
        raise NotDetermined(
            "bernoulli", f"only {mask.sum()} pixels of channel {channel} see the pattern, {LEAST_PIXELS} needed"
        )
    return mask


@dataclass(frozen=True)
class _Design:
    """What a channel's pixels are explained by: columns (coefficients, pixels), and what isn't free, (pixels,)."""

    mask: NDArray[np.bool_]
    bands: tuple[Band, ...]
    columns: FloatArray
    fixed: FloatArray
    inverse: FloatArray  # of the normal matrix
    mix: FloatArray  # (bands, 4 bands): what the halves of the bands, then their phases, contribute to the bands' coefficients
    passed: FloatArray  # the transfer that the picture was drawn with: (rows, cols / 2 + 1)
    reach: float

    @staticmethod
    def of(
        study: Study,
        canvas: _Canvas,
        channel: str,
        light: Spectrum | None,
        seen: FloatArray,
        turned: FloatArray,
        laid: FloatArray,
    ) -> _Design:
        """`laid`: where bands' nodes lie, the power that is their weight: (rows, cols / 2 + 1)."""
        camera = study.camera
        fy, fx = canvas.frequencies
        radius, angle = np.hypot(fx, fy), np.arctan2(fy, fx + 0.0 * fy)
        otf = _lens_otf(study, channel, light)
        passed = canvas.passed(otf, camera.fill_factor)
        spectrum = canvas.low * passed
        mask = _pixels(study, canvas, channel, seen)
        power = np.abs(spectrum) ** 2
        bands, columns, halves, turned_halves = [], [], [], []
        low_part = np.zeros(canvas.shape)
        for i, (low, high) in enumerate(pairwise(RINGS_CY_PER_PX)):
            ring = (radius >= low) & (radius < high)
            for k in range(SECTORS if i else 1):
                middle = k * np.pi / SECTORS
                away = np.mod(angle - middle + 0.5 * np.pi, np.pi) - 0.5 * np.pi
                part = ring & (np.abs(away) <= 0.5 * np.pi / SECTORS) if i else ring
                if not part.any():
                    continue
                # in two halves, so that what a transfer does within the band is known
                sides = [part & (radius < 0.5 * (low + high)), part & (radius >= 0.5 * (low + high))]
                pieces = [canvas.picture(np.where(side, spectrum, 0.0)) for side in sides]
                # a quarter of a period on along the band's direction: what a transfer's phase adds
                on = 1j * np.where(np.cos(angle - middle) >= 0, spectrum, -spectrum)
                turned_halves += [canvas.picture(np.where(side, on, 0.0))[mask] for side in sides]
                picture = pieces[0] + pieces[1]
                low_part += picture
                columns.append(picture[mask])
                halves += [piece[mask] for piece in pieces]
                bands.append(_band(part, radius, away, middle, laid, power, (low, high), whole=not i))
        beyond = [canvas.picture(np.where((radius >= RINGS_CY_PER_PX[-1]) & _below(canvas), spectrum, 0.0))]
        beyond += canvas.beyond(otf, camera.fill_factor)
        picture = (low_part + np.sum(beyond, axis=0))[mask]
        across, down = (canvas.picture(2j * np.pi * f * spectrum)[mask] for f in (fx, fy))
        u, v, r2 = _from_middle(camera, _points(mask, canvas.window))
        # light that lands further out by s has the picture of a place nearer by s
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
        normal = (table / scale[:, None]) @ (table / scale[:, None]).T
        inverse = np.linalg.inv(normal) / np.outer(scale, scale)
        mix = (inverse @ (table @ np.array(halves + turned_halves).T))[: len(bands)]
        return _Design(mask, tuple(bands), table, fixed, inverse, mix, passed, float(np.sqrt(r2.max())))

    @property
    def shifts(self) -> slice:
        """Of the coefficients, those by how far the picture is moved: x, y, radial, radial^3, across."""
        return slice(len(self.bands) + SHIFT_X, len(self.bands) + ACROSS + 1)

    def coefficients(self, seen: FloatArray) -> FloatArray:
        return np.asarray(self.inverse @ (self.columns @ (seen - self.fixed)))

    def solved(self, seen: FloatArray, temporal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients; their covariance by `temporal`, the variance (pixels,) that repeats average out; and by the rest.

        Pixels scatter unequally: the covariance is that of the residuals as they are (White 1980).
        """
        value = self.coefficients(seen)
        left = seen - self.fixed - value @ self.columns
        spread = self.inverse @ ((self.columns * left**2) @ self.columns.T) @ self.inverse
        shown = self.inverse @ ((self.columns * temporal) @ self.columns.T) @ self.inverse
        share = max(1.0 - float(temporal.mean() / np.mean(left**2)), 0.0)
        return value, shown, share * spread


def _below(canvas: _Canvas) -> NDArray[np.bool_]:
    """Frequencies below half a cycle a pixel along both axes."""
    fy, fx = canvas.frequencies
    return np.asarray((np.abs(fy) < 0.5) & (fx < 0.5))


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
    """Nodes where the power `laid` is in a band, its cells gathered by radius and angle, and the shares of `power` there."""
    r, a = radius[part], away[part]
    on, p = (np.where(r > 0, at[part], 0.0) for at in (laid, power))  # the mean isn't blurred
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


# --- blocks ----------------------------------------------------------------------------------------------------------------


def contrast_block(study: Study) -> Block:
    """Contrast that a random pattern keeps, over the baseline's, by frequency, orientation and channel."""
    found = patterns(study)
    labels: list[Label] = []
    places: list[tuple[int, Pattern, int]] = []
    for number, group in enumerate(found):
        for p in group:
            spread = np.sqrt(np.diag(p.shown + p.common))
            for b, band in enumerate(p.bands):
                if spread[b] < LARGEST_STD and b > 0:  # the lowest band is the levels'
                    places.append((number, p, b))
                    labels.append(Label(band.frequency, p.channel, f"{band.angle_deg:.0f} deg", p.captures, p.held_out))
    if not places:
        raise NotDetermined("bernoulli", "the patterns are too noisy, or too few of their cells are in view")
    value = np.array([p.value[b] for _, p, b in places])
    frequency = np.array([label.x for label in labels])
    covariance = _joint(places, study) + np.diag(np.full(len(value), CONTRAST_FLOOR**2))
    scales = [f"pattern:{number}:{p.channel}:{p.held_out}" for number, p, _ in places]
    # drawn alike and seen in the same light, what is held out has its twin's prediction
    poses: list[dict[str, tuple[Pattern, list[int], list[int]]]] = [{} for _ in found]
    for k, (number, p, b) in enumerate(places):
        _, members, parts = poses[number].setdefault(p.channel, (p, [], []))
        members.append(k)
        parts.append(b)
    poses = [sights for sights in poses if sights]
    plain = [_transfers(study, sights, ()) for sights in poses]
    weights = {id(p): _node_weights(p) for sights in poses for p, *_ in sights.values()}

    def predict(effects: Effects) -> Prediction:
        mean = np.ones(len(places))
        if effects:
            for sights, before in zip(poses, plain, strict=True):
                changed = _transfers(study, sights, effects) / np.where(np.abs(before) > 1e-3, before, np.inf)
                for (p, members, parts), ratio in zip(sights.values(), changed, strict=True):
                    placed, (real, imaginary) = _in_place(p, ratio), weights[id(p)]
                    kept = real @ np.real(placed) + imaginary @ np.imag(placed) + p.shown_by(effects)[: len(real)]
                    mean[members] = kept[parts]
            mean[~np.isfinite(mean)] = 1.0
        jacobian = {"pattern:blur": -2.0 * np.square(np.pi * SCREEN_BLUR_PX * frequency) * mean}
        for name in dict.fromkeys(scales):
            jacobian[name] = CONTRAST_SCALE_STD * mean * np.array([s == name for s in scales])
        return Prediction(mean, jacobian)

    return Block(
        measurement="bernoulli", axis="spatial_frequency", unit="cy/px", reach=0.2, value=value, covariance=covariance,
        labels=tuple(labels), reads=TRANSFER | SHOWN | {"image.transmittance"}, predict=predict,
        scale=np.ones(len(value)), conditions="orientation", conditions_words="patterns' parts at",
    )  # fmt: skip


def _joint(places: Sequence[tuple[int, Pattern, int]], study: Study) -> FloatArray:
    """Covariance of coefficients: parts of one pattern in one channel share white, black and drawing."""
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


def _transfers(
    study: Study, sights: dict[str, tuple[Pattern, list[int], list[int]]], effects: Effects
) -> NDArray[np.complex128]:
    """Of a pose's channels at the frequencies of all bands, one after another: (channels, nodes)."""
    first = next(iter(sights.values()))[0]
    fx, fy = np.concatenate([b.fx for b in first.bands]), np.concatenate([b.fy for b in first.bands])
    lit = [(channel, first.light) for channel in sights]
    nodes, shares = common_wavelengths(study.camera, lit, effects, "bernoulli")
    whole = [transfer_at(study.camera, float(w), fx, fy, effects) for w in nodes]
    return np.asarray(np.tensordot(shares, np.array(whole), 1), complex)


def _node_weights(p: Pattern) -> tuple[FloatArray, FloatArray]:
    """What a transfer's real and its imaginary part at all bands' nodes do to the bands' coefficients, (bands, nodes) each: by its means
    over the lower and the upper half of every band."""
    halves = np.zeros((2 * len(p.bands), sum(len(b.fx) for b in p.bands)))
    start = 0
    for k, band in enumerate(p.bands):
        own = slice(start, start + len(band.fx))
        start += len(band.fx)
        for row, use in zip(halves[2 * k : 2 * k + 2], (~band.upper, band.upper), strict=True):
            share = np.where(use, band.share, 0.0)
            row[own] = share / share.sum() if share.sum() > 0 else band.share
    return p.mix[:, : len(halves)] @ halves, p.mix[:, len(halves) :] @ halves


def _in_place(p: Pattern, ratio: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """A change of transfer where the drawing is laid over the picture: a shift s that least squares find, of which
    sum P f Im(ratio exp(-2 pi i f s)) = 0 along both axes (Gauss and Newton), isn't a loss of contrast."""
    if not np.any(np.abs(np.imag(ratio)) > 1e-6):
        return ratio
    turn = 2.0 * np.pi * np.array([np.concatenate([b.fx for b in p.bands]), np.concatenate([b.fy for b in p.bands])])
    weight = np.concatenate([b.power * b.share for b in p.bands])
    for _ in range(PLACINGS):
        slope = (turn * weight * np.maximum(np.real(ratio), 0.0)) @ turn.T
        shift = np.linalg.lstsq(slope, (turn * weight) @ np.imag(ratio), rcond=1e-9)[0]
        ratio = ratio * np.exp(-1j * shift @ turn)
    return ratio


def rim_block(study: Study) -> Block:
    """What rims between lit and dark cells lack or have too much of: greys that screen or camera show otherwise."""
    found = patterns(study)
    points = [(g, p, len(p.bands) + RIM) for g, group in enumerate(found) for p in group]
    value = np.array([p.value[b] for _, p, b in points])

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(points))
        model = Uniform(study.camera, effects)
        for k, (_, p, b) in enumerate(points):
            mean[k] = p.shown_by(effects)[b]
            if not model.is_linear:
                low, high = p.levels_e
                out = model.response(np.array([low, 0.5 * (low + high), high]))
                # a bend a y (1 - y) lifts the middle by a / 4
                mean[k] += 4.0 * float((out[1] - out[0]) / (out[2] - out[0]) - 0.5)
        return Prediction(mean, {})

    return Block(
        measurement="screen_rims", axis="level", unit="1", reach=1e9, value=value,
        covariance=_joint(points, study) + np.diag(np.full(len(value), RIM_FLOOR**2)),
        labels=tuple(Label(float(i), p.channel, "rims of cells", p.captures, p.held_out) for i, (_, p, _) in enumerate(points)),
        reads=SHOWN | {"signal.response"}, predict=predict, scale=np.ones(len(value)), places="rims",
    )  # fmt: skip


def turned_block(study: Study) -> Block:
    """How much of a pattern lies over it once more, turned by half a turn about the frame's middle."""
    points = [(g, p, len(p.bands) + TURNED) for g, group in enumerate(patterns(study)) for p in group]
    value = np.array([p.value[b] for _, p, b in points])

    def predict(effects: Effects) -> Prediction:
        acting = any(act_on(effects, REFLECTIONS))
        return Prediction(np.array([p.turned(effects) if acting else 0.0 for _, p, _ in points]), {})

    return Block(
        measurement="turned_copy", axis="level", unit="1", reach=1e9, value=value,
        covariance=_joint(points, study) + np.diag(np.full(len(value), TURNED_FLOOR**2)),
        labels=tuple(Label(float(i), p.channel, "pattern turned over", p.captures, p.held_out) for i, (_, p, _) in enumerate(points)),
        reads=REFLECTIONS, predict=predict, scale=np.ones(len(value)), places="copies",
    )  # fmt: skip


def colour_block(study: Study) -> Block:
    """How far out red and blue detail of a pattern lies against green, at two distances from the frame's middle, and its turn."""
    if "G" not in study.channels:
        raise NotDetermined("lateral_colour", "one channel: nothing to hold it against")
    points: list[tuple[Pattern, Pattern]] = []
    for group in patterns(study):
        for p in group:
            if p.channel != "G":
                green = next(q for q in group if q.channel == "G" and q.held_out == p.held_out)
                points.append((p, green))
    values, labels, places = [], [], []
    n = len(points)
    covariance = np.zeros((3 * n, 3 * n))
    for i, (p, green) in enumerate(points):
        near, far = 0.5 * p.reach, p.reach
        table = np.array([[near, near**3, 0.0], [far, far**3, 0.0], [0.0, 0.0, far]])
        at = np.array([len(p.bands) + k for k in (RADIAL, RADIAL3, ACROSS)])
        values.append(table @ (p.value[at] - green.value[at]))
        for j, (q, other) in enumerate(points):
            if p.channel != q.channel or p.light is not q.light:
                continue
            # parts beyond the bands, which stand last, needn't be as many for every channel
            own = np.ix_(at, at)
            both = 0.5 * np.sum([one.common[own] for one in (p, q, green, other)], axis=0)
            if i == j:
                both = both + p.shown[own] + green.shown[own]
            covariance[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = table @ both @ table.T
        for k, (distance, way) in enumerate(((near, "outwards"), (far, "outwards"), (far, "around"))):
            labels.append(Label(distance, p.channel, way, p.captures, p.held_out))
            places.append((p, distance, k < 2))

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(places))
        if effects:
            for k, (p, distance, outwards) in enumerate(places):
                if outwards:
                    mean[k] = colour_shift_px(study, p.channel, distance, p.light, effects)
        return Prediction(mean, {})

    return Block(
        measurement="lateral_colour", axis="field", unit="half diagonals", reach=0.5, value=np.concatenate(values),
        covariance=covariance + np.diag(np.full(3 * n, COLOUR_FLOOR_PX**2)), labels=tuple(labels),
        reads=SHIFT, predict=predict, scale=np.ones(3 * n), conditions="direction",
    )  # fmt: skip


def colour_shift_px(
    study: Study, channel: str, distance: float, light: Spectrum | None, effects: Effects, kind: str = "bernoulli"
) -> float:
    """How far a channel's detail lands outside of green's, px, at a distance from the middle in half diagonals: the mean of four
    directions, by the light that each channel detects."""
    camera = study.camera
    wavelength = np.arange(400.0, 721.0, 10.0)
    half_um = camera.half_diagonal_um
    turn = np.pi / 4.0 + np.pi / 2.0 * np.arange(4)
    x, y = distance * half_um * np.cos(turn), distance * half_um * np.sin(turn)
    outwards = np.zeros(len(wavelength))
    for i, w in enumerate(wavelength):
        shift = displaced_um(camera, x, y, float(w), effects)
        if shift is not None:
            outwards[i] = float(np.mean(shift[0] * np.cos(turn) + shift[1] * np.sin(turn)))
    if not outwards.any():
        return 0.0
    radiance = np.ones_like(wavelength) if light is None else light.at(wavelength)
    model = Uniform(camera, effects)
    radiance = model.radiance(wavelength, radiance, kind) * model.transmittance(wavelength)
    seen = [radiance * wavelength * camera.quantum_efficiency[c].at(wavelength) for c in (channel, "G")]
    own, green = (float(s @ outwards / max(s.sum(), 1e-300)) for s in seen)
    return (own - green) / camera.pixel_pitch_um


# --- the screen's own pixels -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Line:
    """The strongest line in a lit screen's spectrum, over what noise leaves anywhere."""

    channel: str
    captures: tuple[str, ...]
    cycles_per_px: float
    power: float  # over the noise's mean
    per_amplitude: float  # power of a line that a grid of amplitude 1 gives
    places: int

    def normal(self, power: float) -> float:
        """The standard normal number that is as rare as the largest of `places` exponential numbers being `power`."""
        rare = np.log(self.places) - power  # logarithm of the probability, far out
        normal = float(np.sqrt(-2.0 * rare)) if rare < -600.0 else -float(special.ndtri(-np.expm1(-np.exp(rare))))
        # beyond any doubt what matters is the order of magnitude
        return normal if normal < CERTAIN else CERTAIN * (1.0 + float(np.log(normal / CERTAIN)))


def grid_block(study: Study) -> Block:
    """The strongest line in the spectrum of the lit screen by channel, as a standard normal number: rows' and columns' lines, and
    lines that uniform light shows as well, are the camera's and don't count."""
    groups = study.groups(WhiteCapture, lambda c: (c.screen.pose, c.exposure_s))
    if not groups:
        raise NotDetermined("screen_grid", "no white captures")
    found: list[_Line] = []
    reason = ""
    for group in groups:
        for channel in study.channels:
            try:
                found.append(_line(study, group, channel))
            except NotDetermined as refused:
                reason = refused.reason
    if not found:
        raise NotDetermined("screen_grid", reason)
    half = np.arange(48) * 0.37 * study.camera.pixel_pitch_um
    x, y = np.meshgrid(half, half)

    def predict(effects: Effects) -> Prediction:
        shown = screen_light(study.camera, np.ones_like(x), x, y, effects)
        size = 2.0 * float(np.std(shown)) / float(np.mean(shown))
        return Prediction(
            np.array(
                [max(line.normal(size**2 * line.per_amplitude + 1.0), 0.0) if size > 0 else 0.0 for line in found]
            ),
            {},
        )

    return Block(
        measurement="screen_grid", axis="spatial_frequency", unit="cy/px", reach=1e9,
        value=np.array([line.normal(line.power) for line in found]), covariance=GRID_STD**2 * np.eye(len(found)),
        labels=tuple(Label(line.cycles_per_px, line.channel, "lit screen", line.captures, False) for line in found),
        reads=SHOWN, predict=predict, scale=np.ones(len(found)),
    )  # fmt: skip


def _line(study: Study, group: Sequence[Any], channel: str) -> _Line:
    step = mosaic.step(study.camera.cfa)
    row, col = mosaic.phases(study.camera.cfa)[channel][0]
    plane = _rate(study, group)[row::step, col::step]
    bright = plane > 0.5 * np.quantile(plane, 0.98)
    box = _box(bright)
    power, noise, window = _power(plane[box], step)
    fy, fx = fft.fftfreq(window.shape[0])[:, None], fft.rfftfreq(window.shape[1])[None, :]
    count = (fx > 2.5 / window.shape[1]) & (np.abs(fy) > 2.5 / window.shape[0]) & (np.hypot(fx, fy) > GRID_LOWEST)
    flats = study.flat_levels()
    if flats:
        lit = [study.recordings.frame(c)[row::step, col::step] - study.noise.black for c in flats[len(flats) // 2]]
        of_flats, level, _ = _power(np.mean(lit, axis=0)[box], step)
        count &= ndimage.maximum_filter(of_flats / level, 3) < GRID_OF_CAMERA
    relative = np.where(count, power / noise, 0.0)
    i, j = np.unravel_index(int(np.argmax(relative)), relative.shape)
    # a cos a cos is four lines of a quarter each
    unit = (0.25 * window.sum()) ** 2 / noise[i, j]
    return _Line(
        channel, tuple(c.id for c in group), float(np.hypot(fy[i, 0], fx[0, j])) / step, float(relative[i, j]), float(unit), int(0.6 * count.sum())
    )  # fmt: skip


def _box(bright: NDArray[np.bool_]) -> tuple[slice, slice]:
    """A rectangle well inside the lit part."""
    slices = []
    for axis in (0, 1):
        share = bright.mean(axis=1 - axis)
        use = np.flatnonzero(share > 0.9 * share.max())
        low, high = int(use[0]) + 4, int(use[-1]) - 3
        spare = max(high - low - GRID_LARGEST, 0) // 2
        slices.append(slice(low + spare, high - spare))
    box = slices[0], slices[1]
    if min(s.stop - s.start for s in box) < 24 or bright[box].mean() < 0.98:
        raise NotDetermined("screen_grid", "the lit screen fills too little of the frame")
    return box


def _power(plane: FloatArray, step: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Power spectrum of a plane over its smooth part, the mean that noise has at every frequency, and the window."""
    smooth = ndimage.gaussian_filter(plane, GRID_DETREND_PX / step, mode="nearest")
    window = np.outer(np.hanning(plane.shape[0]), np.hanning(plane.shape[1]))
    relative = plane / np.maximum(smooth, 1e-12) - 1.0
    # one pixel that is far off is no line
    relative = np.clip(relative, *np.quantile(relative, [0.0005, 0.9995]))
    power = np.abs(fft.rfft2(relative * window)) ** 2
    fy, fx = fft.fftfreq(plane.shape[0])[:, None], fft.rfftfreq(plane.shape[1])[None, :]
    ring = np.minimum((np.hypot(fy, fx) * 20.0).astype(int), 13)
    noise = np.ones_like(power)
    for k in range(14):
        if np.any(ring == k):
            noise[ring == k] = np.median(power[ring == k]) / np.log(2.0)
    return power, np.maximum(noise, 1e-300), window


#: Makers of blocks, in the order of the report.
SCREEN_BLOCKS = (contrast_block, rim_block, turned_block, colour_block, grid_block)
