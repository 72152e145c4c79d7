"""The regression of a pattern's image on parts of the drawn pattern, in the pixels of one colour.

The drawn pattern P, blurred by the reference transfer (`placement`), is split into bands P_b of frequency and
orientation. The recorded image, levelled between black and white, is fitted by least squares:

    image = sum over bands of c_b P_b + border P (1 - P) + ghost T + constant + shifts . gradient P + parts of P beyond
    the bands

T is the recorded image, rotated by 180 degrees about the frame's middle. P is sampled at the same pixels as the image,
so that both are aliased alike. c_b is the contrast of the image in a band over that of the reference. A colour whose
image is displaced from the green one is drawn at its own place.

No statement of the manifest enters but which pixels have one colour: `patterns` says what a camera model predicts of
the same coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.observables.screens.canvas import LAST_BAND_CY_PER_PX, BeyondPart, Canvas, from_middle, mask_points, pixels_of
from lab.observables.screens.placement import ReferenceTransfer, place_slopes
from lab.observables.screens.registration import ScreenWarp
from sim.spectrum import FloatArray

#: Edges of the bands in frequency.
RINGS_CY_PER_PX = (0.0, 0.03, 0.08, 0.14, 0.2, 0.27, 0.34, 0.42, LAST_BAND_CY_PER_PX)
SECTORS = 4  # bands in orientation: about 0, 45, 90, 135 degrees
NODES = (4, 3)  # of a band, in radius and angle, at which an effect's OTF is evaluated
GHOST_BLUR_PX = 3.0  # standard deviation of the Gaussian blur of the ghost's term
LEAST_BEYOND = (
    5e-4  # contrast (rms) of the parts beyond the bands from which on they are fitted; weaker ones are taken as drawn
)
LEAST_ODD = 1e-9  # contrast (rms) of an odd part below which it is rounding
MOST_MOVES = 4  # times that a displaced channel is drawn anew: a linear step finds about half of a shift by half a cell
SCALING = np.array(
    [0.0, 0.0, 1.0, 1.0, 1.0]
)  # the shifts (x, y, radial, radial^3, tangential) of a lens that scales an image
MOVED_PX = 0.1  # a channel displaced by more is drawn anew; less may come from another blur than the drawn one
#: Indices of the coefficients after the bands': cell borders, ghost, constant, shift x, shift y, radial, radial^3,
#: tangential.
BORDER, GHOST, CONSTANT, SHIFT_X, RADIAL, RADIAL3, ACROSS = 0, 1, 2, 3, 5, 6, 7


#: Transfer with which the parts beyond the bands are drawn: of a good lens. Drawn with a strong blur they would have no
#: term, and the other terms would take what the baseline or a weaker blur has of them.
SHARP = ReferenceTransfer(1.5, 1.2, 0.9)


@dataclass(frozen=True)
class Band:
    """A band of frequency and orientation, and the nodes at which an effect's OTF is evaluated."""

    frequency: float  # mean over the pattern's power, cy/px
    angle_deg: float
    reference: float  # mean transfer of the drawn pattern
    fx: FloatArray  # (nodes,), cy/px
    fy: FloatArray  # (nodes,), cy/px
    share: FloatArray  # (nodes,): share of the band's power
    power: float  # of the pattern
    upper: NDArray[np.bool_]  # (nodes,): in the upper half of the band's frequencies
    mask: NDArray[np.bool_]  # (rows, cols / 2 + 1): its frequencies
    middle: float  # of its orientations, rad


@dataclass(frozen=True)
class PlacedPattern:
    """A pattern drawn for the reference pixels of a frame of `shape` (rows, cols), and the recorded image."""

    target: FloatArray  # cells
    warp: ScreenWarp
    transfer: ReferenceTransfer
    canvas: Canvas
    bands: tuple[Band, ...]
    seen: FloatArray  # (rows, cols): levelled, NaN where the screen isn't
    turned: FloatArray  # (rows, cols): the same, blurred and rotated by 180 degrees

    @staticmethod
    def of(
        target: FloatArray, warp: ScreenWarp, transfer: ReferenceTransfer, window: tuple[slice, slice], seen: FloatArray
    ) -> PlacedPattern:
        """Draw the cells `target` for the `window` of the recorded image `seen`."""
        canvas = Canvas.of(target, warp, window)
        turned = ndimage.gaussian_filter(np.nan_to_num(seen), GHOST_BLUR_PX)[::-1, ::-1]
        return PlacedPattern(target, warp, transfer, canvas, tuple(_bands(canvas, transfer)), seen, turned)

    def regress(self, places: Sequence[tuple[int, int]], period: int, *, displaced: bool) -> ColourRegression:
        """Return the regression in the pixels of one colour: its `places` in the mosaic of that `period`.

        `displaced`: its image may lie elsewhere than the reference pixels'. Raises NotDetermined for too few pixels.
        """
        design = self._design(self.canvas, places, period)
        picture = self.seen[self.canvas.window]
        points = mask_points(design.mask, self.canvas.window)
        moved = np.zeros(len(SCALING))
        # a shift too large for a linear step: the pattern is drawn anew at the displaced place, until the rest is small
        for _ in range(MOST_MOVES if displaced else 0):
            step = design.coefficients(picture[design.mask])[design.shifts]
            if np.abs(self._field(points, step)).max() <= MOVED_PX:
                break
            # where cells are a whole number of pixels, a loss of contrast looks like a common shift: a step without one
            # is tried as well
            tried = []
            for part in (step, step * SCALING):
                field = self._field(points, moved + part)
                there = np.linalg.lstsq(self.warp.basis(points).T, field.T, rcond=1e-12)[0].T
                canvas = Canvas.of(self.target, self.warp.displace(there), self.canvas.window)
                tried.append((part, self._design(canvas, places, period)))
            part, anew = min(tried, key=lambda one: one[1].left_rms(picture))
            if anew.left_rms(picture) >= design.left_rms(picture):
                break
            design, moved = anew, moved + part
        return ColourRegression(self, design, moved, points)

    def _field(self, points: FloatArray, shifts: FloatArray) -> FloatArray:
        """Displacement (2, pixels), px, at which a drawing is sampled for an image with these shifts (x, y, radial,
        radial^3, tangential)."""
        u, v, r2 = from_middle(self.seen.shape, points)
        x, y, radial, radial3, across = shifts
        outwards = radial + radial3 * r2
        return np.array([x - outwards * u + across * v, y - outwards * v - across * u])

    def _design(self, canvas: Canvas, places: Sequence[tuple[int, int]], period: int) -> Design:
        """Return the design of a colour's regression with the pattern as `canvas` draws it."""
        spectrum = canvas.low * canvas.passed(self.transfer, self.transfer.fill_factor)
        mask = pixels_of(canvas, self.seen, places, period)
        fy, fx = canvas.frequencies
        pictures = [canvas.picture(np.where(band.mask, spectrum, 0.0)) for band in self.bands]
        # with a phase of 90 degrees along the band's direction: the imaginary part of the OTF
        odd = np.array(self.odd_pieces(canvas, spectrum, mask))
        beyond = self.beyond
        if canvas is not self.canvas:
            beyond = canvas.beyond(SHARP.with_aperture)
        picture = (np.sum(pictures, axis=0) + np.sum(beyond, axis=0))[mask]
        across, down = (canvas.picture(2j * np.pi * f * spectrum)[mask] for f in (fx, fy))
        u, v, r2 = from_middle(self.seen.shape, mask_points(mask, canvas.window))
        # an image displaced outwards by s has, at a place, what lay further in by s
        outwards, around = -(u * across + v * down), -(u * down - v * across)
        grey = np.clip(picture, 0.0, 1.0)
        more = [
            grey * (1.0 - grey),
            self.turned[canvas.window][mask],
            np.ones_like(picture),
            across,
            down,
            outwards,
            r2 * outwards,
            around,
        ]
        strong = [part[mask] for part in beyond if np.std(part[mask]) > LEAST_BEYOND]
        fixed = sum((part[mask] for part in beyond if not np.std(part[mask]) > LEAST_BEYOND), np.zeros(len(u)))
        table = np.array([part[mask] for part in pictures] + more + strong)
        scale = np.sqrt(np.mean(table**2, axis=1))
        unit = table / scale[:, None]
        weights = np.linalg.solve(unit @ unit.T, unit) / scale[:, None]
        # Pictures are divided by the lit screen, which tails of the point spread function make uneven by 0.2 % towards
        # its border. It would look like light at borders of cells, and like a ghost: their coefficients are those of a
        # fit with a smooth unevenness. The bands' aren't: of a displaced colour it takes up contrast.
        uneven = np.array([part * term for term in (u, v, u * u, u * v, v * v) for part in (np.ones_like(grey), grey)])
        # An odd change of the OTF (coma) isn't fitted, as the registration takes up most of it. What is left would look
        # like a weak ghost, too.
        for at, beside in ((BORDER, uneven), (GHOST, np.concatenate([uneven, odd]))):
            row = len(self.bands) + at
            # in a small window half a band may hold no frequency
            size = np.maximum(np.sqrt(np.mean(beside**2, axis=1)), LEAST_ODD)[:, None]
            with_it = np.concatenate([unit, beside / size])
            alone = np.eye(len(with_it))[row]
            weights[row] = np.linalg.lstsq(with_it @ with_it.T, alone, rcond=1e-10)[0] @ with_it / scale[row]
        slopes = place_slopes(canvas, mask, self.warp, self.transfer)
        return Design(
            canvas, mask, len(self.bands), table, fixed, weights, weights @ slopes.T, float(np.sqrt(r2.max()))
        )

    @cached_property
    def beyond(self) -> list[FloatArray]:
        """Return the parts of the pattern beyond the bands, as drawn for the reference pixels."""
        return self.canvas.beyond(SHARP.with_aperture)

    @cached_property
    def beyond_parts(self) -> list[BeyondPart]:
        """Return what changes of the OTF beyond the bands change, as drawn for the reference pixels; pictures in single
        precision, as they are many."""
        return [replace(p, picture=np.asarray(p.picture, np.float32)) for p in self.canvas.beyond_parts()]

    @cached_property
    def halves(self) -> list[NDArray[np.bool_]]:
        """Masks of the frequencies of the lower and the upper half of every band."""
        radius = np.hypot(*self.canvas.frequencies)
        found = []
        for band, (low, high) in zip(self.bands, self._edges, strict=True):
            found += [band.mask & (radius < 0.5 * (low + high)), band.mask & (radius >= 0.5 * (low + high))]
        return found

    @property
    def _edges(self) -> list[tuple[float, float]]:
        """Return the edges of the ring of every band, cy/px."""
        return [edges for edges, *_ in _band_masks(self.canvas)]

    def odd_pieces(self, canvas: Canvas, spectrum: NDArray[np.complex128], mask: NDArray[np.bool_]) -> list[FloatArray]:
        """Return the pictures, at the pixels of `mask`, of the halves of all bands of a `spectrum` with a phase of 90
        degrees along the band's direction, as an imaginary part of the OTF gives it."""
        fy, fx = canvas.frequencies
        angle = np.arctan2(fy, fx + 0.0 * fy)
        found = []
        for k, half in enumerate(self.halves):
            along = np.cos(angle - self.bands[k // 2].middle) >= 0
            found.append(canvas.picture(np.where(half, 1j * np.where(along, spectrum, -spectrum), 0.0))[mask])
        return found


@dataclass(frozen=True)
class Design:
    """The linear model of one colour's pixels with k coefficients."""

    canvas: Canvas
    mask: NDArray[np.bool_]  # (rows, cols): the pixels in the window
    bands: int
    columns: FloatArray  # (k, pixels)
    fixed: FloatArray  # (pixels,): weak parts beyond the bands, which have no coefficient
    weights: FloatArray  # (k, pixels): from pixels to coefficients
    by_place: FloatArray  # (k, 2 terms): change of the coefficients by a displacement of the pattern, per px
    reach: float  # largest distance of the pixels from the frame's middle, half diagonals

    @property
    def shifts(self) -> slice:
        """Indices of the coefficients that displace the image: x, y, radial, radial^3, tangential."""
        return slice(self.bands + SHIFT_X, self.bands + ACROSS + 1)

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


@dataclass(frozen=True)
class ColourRegression:
    """The regression in the pixels of one colour, drawn at its own place: `moved` by shifts from the reference's."""

    placed: PlacedPattern
    design: Design
    moved: FloatArray  # (5,): x, y, radial, radial^3, tangential, px
    points: FloatArray  # (pixels, 2): places in the frame, px


def _bands(canvas: Canvas, transfer: ReferenceTransfer) -> Iterator[Band]:
    """Yield all bands, with their nodes by the power of the pattern behind the reference transfer."""
    fy, fx = canvas.frequencies
    radius, angle = np.hypot(fx, fy), np.arctan2(fy, fx + 0.0 * fy)
    passed = canvas.passed(transfer, transfer.fill_factor)
    sharp = np.square(np.abs(canvas.low))
    for edges, sector, part in _band_masks(canvas):
        middle = sector or 0.0
        yield _band(part, radius, _away(angle, middle), middle, sharp, passed, edges, whole=sector is None)


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


def _band(
    part: NDArray[np.bool_],
    radius: FloatArray,
    away: FloatArray,
    middle: float,
    sharp: FloatArray,
    passed: FloatArray,
    ends: tuple[float, float],
    *,
    whole: bool,
) -> Band:
    """Return the band of the frequencies `part` and its nodes: the band is divided into `NODES` cells in radius and
    angle, and each has its node at the mean of the pattern's power behind the transfer `passed`, and its share of it.
    `sharp`: power of the drawn pattern."""
    r, a = radius[part], away[part]
    power = np.where(r > 0, sharp[part] * passed[part] ** 2, 0.0)  # no blur changes frequency 0
    span = np.pi if whole else np.pi / SECTORS
    i = np.minimum(((r - ends[0]) / (ends[1] - ends[0]) * NODES[0]).astype(int), NODES[0] - 1)
    j = np.clip(((a / span + 0.5) * NODES[1]).astype(int), 0, NODES[1] - 1)
    cell = i * NODES[1] + j
    total = np.bincount(cell, power, NODES[0] * NODES[1])
    keep = total > 0
    at_r = np.bincount(cell, power * r, len(total))[keep] / total[keep]
    at_a = middle + np.bincount(cell, power * a, len(total))[keep] / total[keep]
    share = total[keep] / max(float(power.sum()), 1e-300)
    return Band(
        frequency=float(share @ at_r),
        angle_deg=float(np.rad2deg(middle)),
        reference=float(power.sum() / max(float((sharp[part] * passed[part] * (r > 0)).sum()), 1e-300)),
        fx=at_r * np.cos(at_a),
        fy=at_r * np.sin(at_a),
        share=share,
        power=float(power.sum()),
        upper=np.flatnonzero(keep) // NODES[1] >= NODES[0] // 2,
        mask=part,
        middle=middle,
    )
