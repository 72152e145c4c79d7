"""The fit of a random pattern on a screen: a picture as a sum of parts of the drawn pattern.

The Bernoulli pattern is drawn where the checkerboard says that it is (`lab.fit.psf.screen_registration`) and passed through the
baseline's transfer function. The drawing P is split into bands P_b of frequency and orientation, and the picture is

    picture = sum over bands of c_b P_b + border P (1 - P) + ghost T + constant + shifts . gradient P + P beyond the bands

with T the picture turned by half a turn about the frame's middle. The coefficients come from least squares over each channel's own
pixels; a channel whose picture is displaced from green's is drawn at its own place. Under the baseline every c_b is 1 and all other
coefficients are 0. Drawing and picture are sampled by the same pixels: aliasing is in both, and a band holds its own frequencies
alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.capture_kinds.base import Capture
from lab.capture_kinds.bernoulli import BernoulliCapture
from lab.capture_kinds.black import BlackCapture
from lab.capture_kinds.checkerboard import CheckerboardCapture
from lab.capture_kinds.white import WhiteCapture
from lab.diagnose.measurements.block import Effects
from lab.diagnose.measurements.held_out import held_out_of
from lab.diagnose.measurements.pattern_canvas import (
    BeyondPart,
    Canvas,
    below_nyquist,
    channel_pixels,
    from_middle,
    lens_otf,
    mask_points,
    pattern_window,
)
from lab.diagnose.measurements.reads import SHOWN, acting
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from lab.fit.psf.screen_registration import ScreenWarp, register
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.frame import with_reflections
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum

RINGS_CY_PER_PX = (0.0, 0.03, 0.08, 0.14, 0.2, 0.27, 0.34, 0.42, 0.5)
SECTORS = 4  # orientations of a half turn: about 0, 45, 90, 135 degrees
NODES = (4, 3)  # of a band, in radius and angle, at which an effect's transfer is taken
#: Even powers of the frequency, up to this order in both directions together, in which a transfer's change is smooth over all bands; the
#: rest acts by halves of bands. A pattern is strongest at low frequencies, and where its cells are a whole number of pixels, a mosaic's
#: red and blue pixels see the same numbers at f and 1/2 cy/px - f: what is drawn wrongly within a strong band leaks into a weak one.
EVEN_ORDER = 8
EVEN_TERMS = sum(order + 1 for order in range(0, EVEN_ORDER + 1, 2))
GHOST_BLUR_PX = 3.0
LEAST_BEYOND = 5e-4  # of the contrast: weaker parts beyond the bands are taken as drawn
REFINEMENTS = 2
FEWEST_CELLS = 400
MOST_MOVES = 4  # of a channel's drawing: a linear step finds some half of a shift of half a cell
SCALING = np.array([0.0, 0.0, 1.0, 1.0, 1.0])  # of the shifts (x, y, radial, radial^3, across): what an axis keeps
MOVED_PX = 0.1  # a channel further off is drawn where it is: less shows as well where the blur is not the drawn one


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
    mix: FloatArray  # (bands, EVEN_TERMS + 4 bands + parts): what even powers of the frequency, halves of bands, their phases, and parts beyond do to them
    beyond: FloatArray  # (parts, 2, 2): frequencies (fx of two places, fy of two places) of the parts beyond the bands
    shown_by: Callable[[Effects], FloatArray]  # as `value`: what screens that show greys otherwise change
    levels_e: tuple[float, float]  # electrons of black and of white
    light: Spectrum | None
    ghost: Callable[[Effects], float]  # the coefficient of the ghost under effects on the image as a whole
    reach: float  # largest distance from the frame's middle in half diagonals
    places_um: tuple[
        tuple[float, float], ...
    ]  # (x, y) from the frame's middle, of the mean and the variances of the pixels that it was fitted to


#: Coefficients behind the bands', in their order: cell borders, ghost, constant, shift x, shift y, radial, radial^3, across.
BORDER, GHOST, CONSTANT, SHIFT_X, RADIAL, RADIAL3, ACROSS = 0, 1, 2, 3, 5, 6, 7


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


def mean_rate(study: Study, captures: Sequence[Capture]) -> FloatArray:
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
    white, black = mean_rate(study, whites), mean_rate(study, blacks)
    contrast = white - black
    for plane in mosaic.planes(contrast, camera.cfa).values():
        plane[plane < 0.2 * np.quantile(plane, 0.98)] = np.nan  # where the screen isn't
    boards = [c for c in boards if c.target == boards[0].target]
    cells = study.recordings.target(group[0].target)
    if cells.size < FEWEST_CELLS or not 0.02 < float(np.mean(cells > 0)) < 0.98:
        raise NotDetermined("bernoulli", f"{group[0].target} holds no random pattern of {FEWEST_CELLS} cells or more")
    target = np.asarray(cells, float) / float(cells.max())
    parts = [p for p in ([c for c in group if c.id not in out], [c for c in group if c.id in out]) if p]
    seen = [(mean_rate(study, part) - black) / contrast for part in parts]
    whole = np.average(seen, axis=0, weights=[len(p) for p in parts])
    warp = register(
        (mean_rate(study, boards) - black) / contrast, whole, study.recordings.target(boards[0].target),
        (target > 0.5).astype(np.uint8), group[0].screen.cell_camera_px,
    )  # fmt: skip
    light = study.spectrum(group[0].screen.radiance) if group[0].screen.radiance else None
    window = pattern_window(whole, warp, target.shape)
    reference = "Y" if camera.cfa == "MONO" else "G"
    for _ in range(REFINEMENTS):
        warp = _refined(study, whole, target, warp, window, reference, light)
    canvas = Canvas.of(target, warp, window)
    # one set of frequencies for all channels, so that an effect's transfer is formed once
    otfs = [lens_otf(study, channel, light) for channel in camera.channels]
    laid = np.sum([np.square(np.abs(canvas.low * canvas.passed(otf, camera.fill_factor))) for otf in otfs], axis=0)
    turned = ndimage.gaussian_filter(np.nan_to_num(whole), GHOST_BLUR_PX)[::-1, ::-1]
    found = []
    for channel in camera.channels:
        design = _Design.of(study, canvas, channel, light, whole, turned, laid)
        picture = whole[window]
        points = mask_points(design.mask, window)
        drawn, moved = canvas, np.zeros(len(design.coefficients(picture[design.mask])[design.shifts]))
        # too far for a linear step: the pattern is drawn anew at the shifted place, until the rest is small
        for _ in range(MOST_MOVES if channel != reference else 0):
            step = design.coefficients(picture[design.mask])[design.shifts]
            if np.abs(_field(camera, points, step)).max() <= MOVED_PX:
                break
            # where cells are a whole number of pixels, a loss of contrast looks like a shift of the whole: a lens scales colours
            tried = []
            for part in (step, step * SCALING):
                field = _field(camera, points, moved + part)
                there = np.linalg.lstsq(warp.basis(points).T, field.T, rcond=1e-12)[0].T
                displaced = Canvas.of(target, warp.displaced(there), window)
                tried.append((part, displaced, _Design.of(study, displaced, channel, light, whole, turned, laid)))
            part, displaced, anew = min(tried, key=lambda one: one[2].left_rms(picture))
            if anew.left_rms(picture) >= design.left_rms(picture):
                break
            design, drawn, moved = anew, displaced, moved + part
        area = contrast[window][design.mask]
        exposure = group[0].exposure_s
        levels = (
            float(np.nanmean(black[window][design.mask])) * exposure / study.noise.gain,
            float(np.nanmean(white[window][design.mask])) * exposure / study.noise.gain,
        )
        ghost_by = _ghost_by(study, design, whole, window)
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
                    value=value, shown=shown, common=common, mix=design.mix, beyond=design.beyond, shown_by=shown_by, levels_e=levels, light=light,
                    ghost=ghost_by, reach=design.reach, places_um=_places_um(camera, points),
                )
            )  # fmt: skip
    return found


def _places_um(camera: CameraModel, points: FloatArray) -> tuple[tuple[float, float], ...]:
    """Four places (x, y) from the frame's middle, of the mean and the variances of pixels' places, (pixels, 2)."""
    middle, spread = (
        np.mean(points, axis=0) - 0.5 * np.array([camera.cols - 1, camera.rows - 1]),
        np.std(points, axis=0),
    )
    corners = camera.pixel_pitch_um * (middle + spread * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]))
    return tuple((float(x), float(y)) for x, y in corners)


def _field(camera: CameraModel, points: FloatArray, shifts: FloatArray) -> FloatArray:
    """Where a pixel sees what would lie at itself without these shifts (x, y, radial, radial^3, across), less where it is: (2, pixels), px."""
    u, v, r2 = from_middle(camera, points)
    x, y, radial, radial3, across = shifts
    outwards = radial + radial3 * r2
    return np.array([x - outwards * u + across * v, y - outwards * v - across * u])


def _ghost_by(
    study: Study, design: _Design, seen: FloatArray, window: tuple[slice, slice]
) -> Callable[[Effects], float]:
    """Change of the ghost's coefficient by effects on the whole image: of the pattern's picture through them, over that of the lit screen."""
    picture, lit = np.nan_to_num(seen), np.isfinite(seen).astype(float)
    weight = (design.inverse[len(design.bands) + GHOST] @ design.columns).astype(np.float32)
    before = picture[window][design.mask]

    def coefficient(effects: Effects) -> float:
        shown, white = picture, lit
        shown, white = (with_reflections(study.camera, image, effects) for image in (shown, white))
        after = shown[window][design.mask] / np.maximum(white[window][design.mask], 1e-6)
        return float(weight @ (after - before))

    return coefficient


def _shown_by(study: Study, design: _Design, canvas: Canvas) -> Callable[[Effects], FloatArray]:
    """What effects on a screen's light do to a pattern's coefficients: it is drawn as the screen shows it, over the lit screen."""
    none = np.zeros(len(design.inverse))

    @lru_cache(maxsize=8)
    def changed(showing: tuple[Effect, ...]) -> FloatArray:
        change = canvas.picture((canvas.as_shown(showing, study.camera) - canvas.low) * design.passed)
        return np.asarray(design.inverse @ (design.columns @ change[design.mask]))

    def coefficients(effects: Effects) -> FloatArray:
        showing = acting(effects, SHOWN)
        return changed(showing) if showing else none

    return coefficients


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
    canvas, otf = Canvas.of(target, warp, window), lens_otf(study, channel, light)
    fy, fx = canvas.frequencies
    spectrum = canvas.low * canvas.passed(otf, study.camera.fill_factor)
    mask = channel_pixels(study, canvas, channel, seen)
    picture, across, down = (
        canvas.picture(part * spectrum)[mask] for part in (below_nyquist(canvas), 2j * np.pi * fx, 2j * np.pi * fy)
    )
    picture = picture + canvas.beyond_picture(otf, study.camera.fill_factor)[mask]
    terms = warp.basis(mask_points(mask, window))
    # with contrasts of their own: where cells are a whole number of pixels, a loss of contrast looks like a displacement
    bands = [canvas.picture(np.where(part, spectrum, 0.0))[mask] for *_, part in _band_masks(canvas)]
    columns = np.concatenate([across * terms, down * terms, bands, [np.ones_like(picture)]])
    scale = np.sqrt(np.mean(columns**2, axis=1))[:, None]
    columns = columns / scale
    step = np.linalg.lstsq(columns @ columns.T, columns @ (seen[window][mask] - picture), rcond=1e-12)[0] / scale[:, 0]
    return warp.displaced(step[: 2 * len(terms)].reshape(2, -1))


def _band_masks(canvas: Canvas) -> Iterator[tuple[tuple[float, float], float | None, NDArray[np.bool_]]]:
    """Every band that has frequencies: the ends of its ring, the middle of its sector (none: the whole ring), and where it lies."""
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
    """Angles from the middle of a sector, of directions without a sense: -pi/2..pi/2."""
    return np.asarray(np.mod(angle - middle + 0.5 * np.pi, np.pi) - 0.5 * np.pi)


@dataclass(frozen=True)
class _Design:
    """The linear model of a channel's pixels: columns (coefficients, pixels), and the part without a coefficient, (pixels,)."""

    mask: NDArray[np.bool_]
    bands: tuple[Band, ...]
    columns: FloatArray
    fixed: FloatArray
    inverse: FloatArray  # of the normal matrix
    mix: FloatArray  # (bands, EVEN_TERMS + 4 bands + parts): what even powers of the frequency, halves of bands, their phases, and parts beyond do to them
    beyond: FloatArray  # (parts, 2, 2): frequencies (fx of two places, fy of two places) of the parts beyond the bands
    passed: FloatArray  # the transfer that the picture was drawn with: (rows, cols / 2 + 1)
    reach: float

    @staticmethod
    def of(
        study: Study,
        canvas: Canvas,
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
        otf = lens_otf(study, channel, light)
        passed = canvas.passed(otf, camera.fill_factor)
        spectrum = canvas.low * passed
        mask = channel_pixels(study, canvas, channel, seen)
        power = np.abs(spectrum) ** 2
        bands, columns, halves, turned_halves = [], [], [], []
        inside = radius < RINGS_CY_PER_PX[-1]
        smooth = [canvas.picture(np.where(inside, term * spectrum, 0.0))[mask] for term in even_powers(fx, fy)]
        low_part = np.zeros(canvas.shape)
        for (low, high), sector, part in _band_masks(canvas):
            middle = sector or 0.0
            away = _away(angle, middle)
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
            bands.append(_band(part, radius, away, middle, laid, power, (low, high), whole=sector is None))
        corner = (radius >= RINGS_CY_PER_PX[-1]) & below_nyquist(canvas)
        parts = [[BeyondPart.of(canvas.picture(np.where(corner, spectrum, 0.0)), fx, fy, np.where(corner, power, 0.0))]]
        parts += canvas.beyond(otf, camera.fill_factor)
        beyond = [np.sum([part.picture for part in together], axis=0) for together in parts]
        outside = [part for together in parts for part in together]
        picture = (low_part + np.sum(beyond, axis=0))[mask]
        across, down = (canvas.picture(2j * np.pi * f * spectrum)[mask] for f in (fx, fy))
        u, v, r2 = from_middle(camera, mask_points(mask, canvas.window))
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
        pieces = [*smooth, *halves, *turned_halves, *(part.picture[mask] for part in outside)]
        mix = (inverse @ (table @ np.array(pieces).T))[: len(bands)]
        beyond_f = np.array([part.fx + part.fy for part in outside]).reshape(len(outside), 2, 2)
        return _Design(mask, tuple(bands), table, fixed, inverse, mix, beyond_f, passed, float(np.sqrt(r2.max())))

    @property
    def shifts(self) -> slice:
        """Of the coefficients, those by how far the picture is moved: x, y, radial, radial^3, across."""
        return slice(len(self.bands) + SHIFT_X, len(self.bands) + ACROSS + 1)

    def coefficients(self, seen: FloatArray) -> FloatArray:
        return np.asarray(self.inverse @ (self.columns @ (seen - self.fixed)))

    def left_rms(self, picture: FloatArray) -> float:
        """Root mean square of what the fit leaves of the window's picture, at the channel's pixels."""
        seen = picture[self.mask]
        left = seen - self.fixed - self.coefficients(seen) @ self.columns
        return float(np.sqrt(np.mean(np.square(left))))

    def solved(self, seen: FloatArray, temporal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coefficients; their covariance by `temporal`, the variance (pixels,) that repeats average out; and by the rest.

        The pixels' variances differ: the covariance is that of the residuals as they are (White 1980).
        """
        value = self.coefficients(seen)
        left = seen - self.fixed - value @ self.columns
        spread = self.inverse @ ((self.columns * left**2) @ self.columns.T) @ self.inverse
        shown = self.inverse @ ((self.columns * temporal) @ self.columns.T) @ self.inverse
        share = max(1.0 - float(temporal.mean() / np.mean(left**2)), 0.0)
        return value, shown, share * spread


def even_powers(fx: FloatArray, fy: FloatArray) -> list[FloatArray]:
    """fx^i fy^j of even i + j up to `EVEN_ORDER`, in units of the highest frequency of the bands."""
    x, y = fx / RINGS_CY_PER_PX[-1], fy / RINGS_CY_PER_PX[-1]
    return [x ** (n - k) * y**k for n in range(0, EVEN_ORDER + 1, 2) for k in range(n + 1)]


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


def joint_covariance(places: Sequence[tuple[int, Pattern, int]], study: Study) -> FloatArray:
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
