"""Where a pattern on a screen lies in the frame, refined on the pattern itself, and how much its image is blurred.

This is the summary of a pose that the kernel fit and the diagnosis read. It is measured once, from the levelled
pictures: no statement of the manifest enters but which pixels have one colour (green, or all).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.observables.screens.canvas import Canvas, mask_points, pattern_window, pixels_of
from lab.observables.screens.poses import ScreenPictures
from lab.observables.screens.registration import ScreenWarp, reference_pixels, register
from sim.camera import Cfa
from sim.optics.diffraction import aperture_otf
from sim.sensor import mosaic
from sim.spectrum import FloatArray

#: Highest total order, and the frequency at which the powers end, of the change of the transfer that a step fits. With
#: more freedom (order 6) it takes a displacement that goes with the phase of the cells on the pixels for a transfer:
#: 0.025 px where 0.01 px is reached.
REGISTERED_ORDER, REGISTERED_CY_PER_PX = 4, 1.5
JUDGED_ORDER = 8  # of the change of the transfer beside which a displacement has to lower the residual
PLACE_STD_PX = 0.03  # prior standard deviation of each term of the displacement: errors of the corners
LEAST_ERROR_PX = 2e-4  # of a term of the displacement; less changes a contrast by less than 1e-4
ERRORS_ORDER = 14  # of the change of the transfer that may be taken for a displacement
REFINEMENTS = 3  # most Gauss-Newton steps of the registration
BLUR_STEPS = 6  # most Gauss-Newton steps of the reference transfer
BLUR_DIFFERENCE, MOST_BLUR_STEP = 0.02, 0.5  # changes of its parameters: for derivatives, and of a step
BLUR_GAIN = 0.003  # share of the residual's power that a step has to gain for another one
#: Bounds of the reference transfer's frequency (cy/px), exponent and aperture (px). A Gaussian blur has exponent 2;
#: diffraction in a circular pupil falls nearly in proportion to frequency, exponent 1. An anti-alias filter, whose
#: transfer ends at a null, is like a wide aperture.
LOWEST, HIGHEST = np.array([0.05, 0.7, 0.3]), np.array([10.0, 3.0, 3.0])


@dataclass(frozen=True)
class ReferenceTransfer:
    """The transfer exp(-(f / frequency)^exponent) sinc(aperture fx) sinc(aperture fy) that fits a recorded image best.
    Bands of the pattern are drawn with it."""

    frequency_cy_per_px: float
    exponent: float
    aperture_px: float

    def __call__(self, radius: FloatArray) -> FloatArray:
        """Return the transfer without the aperture at frequencies, cy/px."""
        return np.asarray(np.exp(-np.power(np.abs(radius) / self.frequency_cy_per_px, self.exponent)))

    def with_aperture(self, fx: FloatArray, fy: FloatArray) -> FloatArray:
        """Return the transfer with the aperture at frequencies, cy/px."""
        return np.asarray(self(np.hypot(fx, fy)) * aperture_otf(fx, fy, self.fill_factor))

    @property
    def fill_factor(self) -> float:
        """Return the area of the aperture, px^2."""
        return self.aperture_px**2

    def changed(self, by: FloatArray) -> ReferenceTransfer:
        """Return the transfer after a change (3,) of ln(frequency), exponent and aperture, within the bounds."""
        there = np.array([self.frequency_cy_per_px * np.exp(by[0]), self.exponent + by[1], self.aperture_px + by[2]])
        return ReferenceTransfer(*np.clip(there, LOWEST, HIGHEST).tolist())


#: From which the fit of the reference transfer begins.
FIRST_TRANSFER = ReferenceTransfer(1.5, 1.2, 0.9)


@dataclass(frozen=True)
class PatternPlace:
    """Where a pattern lies for the reference pixels: `warp`, and `std` (directions, 2 terms), px, independent errors of
    its displacement, one standard deviation each. `transfer`: of these pixels' image; None, and no errors, where too
    few pixels see the pattern to refine the place that the corners give."""

    warp: ScreenWarp
    std: FloatArray
    transfer: ReferenceTransfer | None


def pattern_place(recordings: RecordingSet, pictures: ScreenPictures, whole: FloatArray, cfa: Cfa) -> PatternPlace:
    """Return the place of a pose's pattern, measured once. `whole` (rows, cols): its levelled picture, all repeats."""
    pose = pictures.pose
    first, board = pose.pattern[0], pose.checkerboard[0]
    colour = _reference(cfa)
    key = (
        "pattern place", *(tuple(c.frame for c in kind) for kind in (pose.pattern, pose.checkerboard, pose.white,
        pose.black)), first.target, board.target, first.screen.cell_camera_px, *colour,
    )  # fmt: skip
    return recordings.once(
        key,
        lambda: place_pattern(
            pictures.levelled(recordings, pose.checkerboard), whole, recordings.target(board.target),
            recordings.target(first.target), first.screen.cell_camera_px, cfa,
        ),
        whatever_is_stated=True,
    )  # fmt: skip


def _reference(cfa: Cfa) -> tuple[tuple[tuple[int, int], ...], int]:
    """Return the places in the mosaic of green pixels, or of all, and the mosaic's period."""
    return tuple(sorted(mosaic.phases(cfa)["Y" if cfa == "MONO" else "G"])), mosaic.step(cfa)


def place_pattern(
    checkerboard: FloatArray,
    pattern: FloatArray,
    checkerboard_target: np.ndarray,
    pattern_target: np.ndarray,
    cell_px: float | None,
    cfa: Cfa,
) -> PatternPlace:
    """Find where a pattern lies: by the checkerboard's corners, then by Gauss-Newton steps on the pattern itself, each
    of which has to lower the residual.

    Pictures (rows, cols) are levelled, NaN where the screen isn't; targets hold 0 or 1 a cell; `cell_px`: nominal side
    of a cell, or None. Raises NotDetermined as `register` does.

    Where cells are a whole number of pixels and stand square, the pattern's aliases are coherent: a strong blur that
    the step's smooth transfer doesn't follow then looks like a displacement, up to 0.2 px, and the next steps go on
    from there. The residual is therefore compared with a smooth transfer of `JUDGED_ORDER`. A displacement that it
    doesn't show is left at what the corners say."""
    warp = register(
        checkerboard, pattern, checkerboard_target, pattern_target, cell_px, reference_pixels(pattern.shape, cfa)
    )
    try:
        best = _PlacedPattern.of(pattern, np.asarray(pattern_target, float), warp, *_reference(cfa))
    except NotDetermined:
        return PatternPlace(warp, np.zeros((0, 2 * len(warp.displacement[0]))), None)
    best = best.fit_blur()
    for _ in range(REFINEMENTS):
        tried = best.step()
        if tried.left_rms >= best.left_rms:
            break
        best = tried
    return PatternPlace(best.warp, best.errors(), best.fit_blur().transfer)


@dataclass(frozen=True)
class _PlacedPattern:
    """A pattern drawn where `warp` places it, blurred by `transfer`, and what of the recorded image it leaves in the n
    pixels of one colour."""

    seen: FloatArray  # (rows, cols): the recorded image
    target: FloatArray  # cells
    places: Sequence[tuple[int, int]]  # of the colour in the mosaic
    period: int  # of the mosaic
    warp: ScreenWarp
    transfer: ReferenceTransfer
    canvas: Canvas
    mask: np.ndarray  # (rows, cols): the pixels in the canvas's window

    @staticmethod
    def of(
        seen: FloatArray,
        target: FloatArray,
        warp: ScreenWarp,
        places: Sequence[tuple[int, int]],
        period: int,
        transfer: ReferenceTransfer | None = None,
    ) -> _PlacedPattern:
        """Draw the cells `target` for the recorded image `seen`. Raises NotDetermined for too few pixels."""
        canvas = Canvas.of(target, warp, pattern_window(seen, warp, target.shape))
        mask = pixels_of(canvas, seen, places, period)
        return _PlacedPattern(seen, target, places, period, warp, transfer or FIRST_TRANSFER, canvas, mask)

    def _drawn(self, transfer: ReferenceTransfer) -> FloatArray:
        """Return the pattern's image (n,) behind a transfer and the pixel's aperture."""

        return np.asarray(self.canvas.image(transfer.with_aperture)[self.mask])

    def fit_blur(self) -> _PlacedPattern:
        """Fit the reference transfer: Gauss-Newton steps with free levels of dark and lit cells."""
        seen = self.seen[self.canvas.window][self.mask]

        def left(drawn: FloatArray) -> FloatArray:
            columns = np.array([drawn, np.ones_like(drawn)])
            return np.asarray(seen - _solve(columns, seen) @ columns)

        transfer, drawn = self.transfer, self._drawn(self.transfer)
        residual = left(drawn)
        for _ in range(BLUR_STEPS):
            changes = []
            for by in BLUR_DIFFERENCE * np.eye(3):
                way = -by if transfer.changed(by) == transfer else by  # away from a bound
                changes.append((self._drawn(transfer.changed(way)) - drawn) / way.sum())
            change = _solve(np.array([*changes, drawn, np.ones_like(drawn)]), seen)[:3]
            tried = transfer.changed(change * min(1.0, MOST_BLUR_STEP / float(np.abs(change).max())))
            drawn_anew = self._drawn(tried)
            anew = left(drawn_anew)
            gained = 1.0 - float(anew @ anew) / float(residual @ residual)
            if gained > 0.0:
                transfer, drawn, residual = tried, drawn_anew, anew
            if gained < BLUR_GAIN:
                break
        return _PlacedPattern(
            self.seen, self.target, self.places, self.period, self.warp, transfer, self.canvas, self.mask
        )

    @cached_property
    def _spectrum(self) -> np.ndarray:
        """Return the spectrum of the pattern behind the transfer, without the pixel's aperture."""
        whole = self.canvas.whole
        return np.asarray(whole.spectrum * self.transfer(np.hypot(whole.fx, whole.fy)))

    @cached_property
    def residual(self) -> FloatArray:
        """Recorded less drawn image, (n,)."""
        return np.asarray(self.seen[self.canvas.window][self.mask] - self._drawn(self.transfer))

    @cached_property
    def smooth(self) -> FloatArray:
        """Products (k, n) of even powers of the frequency, up to `JUDGED_ORDER`, and the transfer, and last a constant.

        A smooth change of the transfer is fitted with a displacement: with the phase of the cells on the pixels,
        aliases look like one."""
        return self._smooth(JUDGED_ORDER)

    def _smooth(self, order: int) -> FloatArray:
        """Return such products up to an `order`."""
        whole = self.canvas.whole
        fx, fy = (np.clip(f, -REGISTERED_CY_PER_PX, REGISTERED_CY_PER_PX) for f in (whole.fx, whole.fy))
        powers = even_powers(fx, fy, order, REGISTERED_CY_PER_PX)
        columns = [self.canvas.sampled(term * self._spectrum)[self.mask] for term in powers]
        return np.array([*columns, np.ones(len(columns[0]))])

    @cached_property
    def slopes(self) -> FloatArray:
        """Change (2 terms, n) of the drawn image by each term of the displacement in x, then in y."""
        return place_slopes(self.canvas, self.mask, self.warp, self.transfer)

    def errors(self) -> FloatArray:
        """Return the independent errors of the displacement (directions, 2 terms), px, one standard deviation each:
        with a smooth transfer of `ERRORS_ORDER` free, the prior of the corners, and the residual as noise.

        Where cells are a whole number of pixels and stand square, some displacements look like a change of the
        transfer, and are known no better than from the corners.
        """
        columns = np.concatenate([self.slopes, self._smooth(ERRORS_ORDER)])
        precision = columns @ columns.T / self.left_rms**2
        own = np.arange(len(self.slopes))
        precision[own, own] += PLACE_STD_PX**-2
        unit = np.sqrt(np.diag(precision))
        covariance = np.linalg.pinv(precision / np.outer(unit, unit), rcond=1e-12, hermitian=True)
        covariance = (covariance / np.outer(unit, unit))[np.ix_(own, own)]
        variance, direction = np.linalg.eigh(covariance)
        known = variance > LEAST_ERROR_PX**2
        return np.asarray((direction[:, known] * np.sqrt(variance[known])).T)

    @cached_property
    def left_rms(self) -> float:
        """Root mean square residual with a free smooth change of the transfer."""
        left = self.residual - _solve(self.smooth, self.residual) @ self.smooth
        return float(np.sqrt(np.mean(np.square(left))))

    def step(self) -> _PlacedPattern:
        """Return the pattern after a Gauss-Newton step of its place, with a smooth transfer of `REGISTERED_ORDER`."""
        powers = (REGISTERED_ORDER // 2 + 1) ** 2
        columns = np.concatenate([self.slopes, self.smooth[:powers], self.smooth[-1:]])
        change = _solve(columns, self.residual)[: len(self.slopes)]
        warp = self.warp.displace(change.reshape(2, -1))
        return _PlacedPattern.of(self.seen, self.target, warp, self.places, self.period, self.transfer)


def place_slopes(canvas: Canvas, mask: np.ndarray, warp: ScreenWarp, transfer: ReferenceTransfer) -> FloatArray:
    """Return the change (2 terms, n) of the drawn image at the n pixels of `mask` by each term of the displacement of
    `warp` in x, then in y."""
    whole = canvas.whole
    drawn = whole.spectrum * transfer.with_aperture(whole.fx, whole.fy)
    across, down = (canvas.sampled(2j * np.pi * f * drawn)[mask] for f in (whole.fx, whole.fy))
    terms = warp.basis(mask_points(mask, canvas.window))
    return np.concatenate([across * terms, down * terms])


def even_powers(fx: FloatArray, fy: FloatArray, order: int, end: float) -> list[FloatArray]:
    """Return the products fx^i fy^j of even i + j up to `order`, frequencies over `end`, by i + j."""
    x, y = fx / end, fy / end
    return [x ** (n - k) * y**k for n in range(0, order + 1, 2) for k in range(n + 1)]


def _solve(columns: FloatArray, value: FloatArray) -> FloatArray:
    """Return the least squares coefficients (k,) of `columns` (k, n) for `value` (n,)."""
    scale = np.sqrt(np.mean(columns**2, axis=1))
    unit = columns / scale[:, None]
    return np.asarray(np.linalg.lstsq(unit @ unit.T, unit @ value, rcond=1e-12)[0] / scale)
