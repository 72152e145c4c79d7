"""What a camera model predicts of the regressions of random patterns (`bands`): of the same coefficients, through the
same weights.

The baseline camera's image is drawn with its own transfer function and goes through the regression as the recorded one
does. Effects change the transfer function by a ratio, which is evaluated at the bands' nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain

import numpy as np
from scipy.interpolate import CubicSpline

from lab.capture_kinds.bernoulli import BernoulliCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset, held_out_of
from lab.observables.reads import SHOWN, acting
from lab.observables.screens.bands import ACROSS, GHOST, RINGS_CY_PER_PX, Band, ColourRegression, PlacedPattern
from lab.observables.screens.canvas import pattern_window
from lab.observables.screens.placement import PatternPlace, even_powers, pattern_place
from lab.observables.screens.poses import ScreenPictures, ScreenPose, refuse_saturated, screen_poses
from sim.camera import CameraModel
from sim.effects.base import Effect, Effects
from sim.frame import with_reflections
from sim.optics.diffraction import aperture_otf
from sim.point import optical_transfer
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum

#: Highest total order of the even powers of (fx, fy) that describe an effect's change of the OTF over all bands; the
#: rest enters by halves of bands. Where cells are a whole number of pixels, a mosaic's red and blue pixels have the
#: same samples at f and 1/2 cy/px - f. Errors within a strong band at low frequencies would then leak into a weak one
#: at high frequencies.
EVEN_ORDER = 8
EVEN_TERMS = sum(order + 1 for order in range(0, EVEN_ORDER + 1, 2))
FEWEST_CELLS = 400  # of a random pattern, whose spectrum is then even to 5 %


@dataclass(frozen=True)
class Pattern:
    """The regression of one pattern at one pose of the screen, in one channel, for its seen or its held-out repeats."""

    captures: tuple[str, ...]
    held_out: bool
    channel: str
    bands: tuple[Band, ...]
    #: Coefficients (k,): of the bands, the eight of `BORDER` to `ACROSS`, and the parts beyond the bands.
    value: FloatArray
    baseline: FloatArray  # (k,): those predicted of the baseline camera
    shown: FloatArray  # (k, k): covariance by temporal noise of the repeats
    common: FloatArray  # (k, k): covariance by what seen and held-out repeats share: white and black
    by_place: FloatArray  # (k, directions): change by the independent errors of the pattern's place
    #: (bands + ACROSS + 1, EVEN_TERMS + 4 bands + parts): change of these coefficients by a unit of even powers of the
    #: frequency times the baseline's P, of the halves of the bands, of these with a phase of 90 degrees, and of changes
    #: of the OTF by `beyond_reference` at the nodes beyond the bands.
    mix: FloatArray
    beyond: FloatArray  # (nodes, 2, 2): (fx, fy) of the nodes beyond the bands, cy/px, each in two quadrants
    shown_by: Callable[[Effects], FloatArray]  # change of the coefficients by effects on the screen's light
    levels_e: tuple[float, float]  # electrons on dark and on lit cells
    light: Spectrum | None
    ghost: Callable[[Effects], float]  # change of the ghost's coefficient by reflections of the whole image
    reach: float  # largest distance of its pixels from the frame's middle, half diagonals
    places_um: tuple[
        tuple[float, float], ...
    ]  # four points (x, y) from the frame's middle with the mean and the variances of its pixels


def patterns(dataset: Dataset) -> list[list[Pattern]]:
    """Return the regressions of all Bernoulli patterns, computed once a dataset: a list for each (pose, target), by
    channel, seen and held out.

    Raises NotDetermined where f-number or pixel pitch isn't stated, and where no pattern is fitted.
    """
    return dataset.once(_patterns)


def _patterns(dataset: Dataset) -> list[list[Pattern]]:
    if not dataset.diffraction_is_known:
        raise NotDetermined("bernoulli", "f-number or pixel pitch isn't stated: no diffraction to draw patterns with")
    found, reason = [], ""
    for pose in screen_poses(dataset.recordings, dataset.side, "bernoulli"):
        try:
            found.append(_measured(dataset, pose))
        except NotDetermined as refused:
            reason = refused.reason
    if not found:
        raise NotDetermined("bernoulli", reason)
    return found


def _measured(dataset: Dataset, pose: ScreenPose) -> list[Pattern]:
    """Return the regressions of one pattern at one pose."""
    camera, recordings, first = dataset.camera, dataset.recordings, pose.pattern[0]
    refuse_saturated(recordings, pose, dataset.saturation_dn, "bernoulli")
    cells = recordings.target(first.target)
    if cells.size < FEWEST_CELLS or not 0.02 < float(np.mean(cells > 0)) < 0.98:
        raise NotDetermined("bernoulli", f"{first.target} holds no random pattern of {FEWEST_CELLS} cells or more")
    pictures = ScreenPictures.of(recordings, pose)
    whole = pictures.levelled(recordings, pose.pattern)
    place = pattern_place(recordings, pictures, whole, camera.cfa)
    if place.transfer is None:
        raise NotDetermined("bernoulli", "too few pixels of one colour see the pattern: let it fill more of the frame")
    target = np.asarray(cells, float)
    window = pattern_window(whole, place.warp, target.shape)
    placed = PlacedPattern.of(target, place.warp, place.transfer, window, whole)
    out = held_out_of(pose.pattern, 0, 0) if len(pose.pattern) > 1 else set()
    parts = [p for p in ([c for c in pose.pattern if c.id not in out], [c for c in pose.pattern if c.id in out]) if p]
    seen = [pictures.levelled(recordings, part) for part in parts]
    reference = "Y" if camera.cfa == "MONO" else "G"
    found = []
    for channel in camera.channels:
        places = mosaic.phases(camera.cfa)[channel]
        regression = placed.regress(places, mosaic.step(camera.cfa), displaced=channel != reference)
        found += _of_channel(dataset, pictures, regression, place, channel, parts, seen, out)
    return found


def _of_channel(
    dataset: Dataset,
    pictures: ScreenPictures,
    regression: ColourRegression,
    place: PatternPlace,
    channel: str,
    parts: Sequence[Sequence[BernoulliCapture]],
    seen: Sequence[FloatArray],
    out: set[str],
) -> list[Pattern]:
    """Return what a channel's regression says of the seen and of the held-out repeats, `parts`, of which `seen` are the
    levelled pictures; captures in `out` are held out."""
    camera, noise, design = dataset.camera, dataset.noise, regression.design
    screen = parts[0][0].screen
    light = dataset.spectrum(screen.radiance) if screen.radiance else None
    baseline = _Baseline.of(dataset, regression, channel, light, pictures.gain)
    area, black = (part[regression.placed.canvas.window][design.mask] for part in (pictures.contrast, pictures.black))
    solved = []
    for part, picture in zip(parts, seen, strict=True):
        value = picture[regression.placed.canvas.window][design.mask]
        signal = np.maximum(value * area + black - noise.black, 0.0)
        temporal = (noise.gain * signal + noise.read_dn**2) / len(part) / area**2
        solved.append(design.solved(value, temporal))
    # one matrix for seen and held-out repeats, so that their joint covariance stays positive definite
    common = np.mean([c for *_, c in solved], axis=0)
    for value, *_ in solved:
        value[design.shifts] += regression.moved
    dark_e, lit_e = (
        (float(np.mean(level)) - noise.black) / noise.gain * parts[0][0].exposure_s / capture.exposure_s
        for level, capture in ((black, pictures.pose.black[0]), (black + area, pictures.pose.white[0]))
    )
    ghost_by, places_um = _ghost_by(dataset, regression), _places_um(camera, regression.points)
    return [
        Pattern(
            captures=tuple(c.id for c in part),
            held_out=part[0].id in out,
            channel=channel,
            bands=regression.placed.bands,
            value=value,
            baseline=baseline.coefficients,
            shown=shown,
            common=common,
            by_place=design.by_place @ place.std.T,
            mix=baseline.mix,
            beyond=baseline.beyond,
            shown_by=baseline.shown_by,
            levels_e=(dark_e, lit_e),
            light=light,
            ghost=ghost_by,
            reach=design.reach,
            places_um=places_um,
        )
        for part, (value, shown, _) in zip(parts, solved, strict=True)
    ]


def lens_otf(dataset: Dataset, channel: str, light: Spectrum | None) -> CubicSpline:
    """OTF of the baseline's lens without the pixel's aperture, against frequency (cy/px). On axis it is the same in all
    directions."""
    f = np.linspace(0.0, 2.0, 101)
    whole = np.real(optical_transfer(dataset.camera, channel, light, f, 0.0 * f, (), "bernoulli"))
    return CubicSpline(f, whole / aperture_otf(f, 0.0 * f, dataset.camera.fill_factor))


@dataclass(frozen=True)
class _Baseline:
    """What a regression finds of the baseline camera's image, and of changes of it."""

    coefficients: FloatArray  # (k,)
    mix: FloatArray  # as in Pattern
    beyond: FloatArray  # as in Pattern
    shown_by: Callable[[Effects], FloatArray]  # as in Pattern

    @staticmethod
    def of(
        dataset: Dataset, regression: ColourRegression, channel: str, light: Spectrum | None, gain: float
    ) -> _Baseline:
        """Draw the image of the baseline. `gain`: what a lit cell is levelled to."""
        design, camera, placed = regression.design, dataset.camera, regression.placed
        canvas, mask = design.canvas, design.mask
        otf = lens_otf(dataset, channel, light)

        def lens(radius: FloatArray) -> FloatArray:
            return gain * np.asarray(otf(np.minimum(radius, otf.x[-1])))

        def transfer(fx: FloatArray, fy: FloatArray) -> FloatArray:
            return np.asarray(lens(np.hypot(fx, fy)) * aperture_otf(fx, fy, camera.fill_factor))

        image = canvas.image(transfer)[mask]
        passed = canvas.passed(lens, camera.fill_factor)
        spectrum = canvas.low * passed
        fy, fx = canvas.frequencies
        inside = np.hypot(fx, fy) < RINGS_CY_PER_PX[-1]
        powers = even_powers(fx, fy, EVEN_ORDER, RINGS_CY_PER_PX[-1])
        parts = placed.beyond_parts if canvas is placed.canvas else canvas.beyond_parts()
        pieces = chain(
            (canvas.picture(np.where(inside, term * spectrum, 0.0))[mask] for term in powers),
            (canvas.picture(np.where(half, spectrum, 0.0))[mask] for half in placed.halves),
            placed.odd_pieces(canvas, spectrum, mask),
            (gain * part.picture[mask] for part in parts),
        )
        at = placed.beyond_parts

        @lru_cache(maxsize=8)
        def changed(showing: tuple[Effect, ...]) -> FloatArray:
            change = canvas.picture((canvas.as_shown(showing, camera) - canvas.low) * passed)
            return np.asarray(design.weights @ change[mask])

        none = np.zeros(len(design.weights))

        def shown_by(effects: Effects) -> FloatArray:
            showing = acting(effects, SHOWN)
            return changed(showing) if showing else none

        return _Baseline(
            coefficients=design.coefficients(image),
            mix=np.column_stack([design.weights[: design.bands + ACROSS + 1] @ piece for piece in pieces]),
            beyond=np.array([part.fx + part.fy for part in at]).reshape(len(at), 2, 2),
            shown_by=shown_by,
        )


def _places_um(camera: CameraModel, points: FloatArray) -> tuple[tuple[float, float], ...]:
    """Four points (x, y) from the frame's middle, um, whose mean and variances are those of `points` (pixels, 2),
    px."""
    middle, spread = (
        np.mean(points, axis=0) - 0.5 * np.array([camera.cols - 1, camera.rows - 1]),
        np.std(points, axis=0),
    )
    corners = camera.pixel_pitch_um * (middle + spread * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]))
    return tuple((float(x), float(y)) for x, y in corners)


def _ghost_by(dataset: Dataset, regression: ColourRegression) -> Callable[[Effects], float]:
    """Function of effects: change of the ghost's coefficient by their reflections. They act on the pattern's and on the
    lit screen's image, whose ratio is fitted."""
    design, seen = regression.design, regression.placed.seen
    window = design.canvas.window
    picture, lit = np.nan_to_num(seen), np.isfinite(seen).astype(float)
    weight = design.weights[design.bands + GHOST].astype(np.float32)
    before = picture[window][design.mask]

    def coefficient(effects: Effects) -> float:
        shown, white = picture, lit
        shown, white = (with_reflections(dataset.camera, image, effects) for image in (shown, white))
        after = shown[window][design.mask] / np.maximum(white[window][design.mask], 1e-6)
        return float(weight @ (after - before))

    return coefficient


def joint_covariance(places: Sequence[tuple[int, Pattern, int]]) -> FloatArray:
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


def drawing_covariance(places: Sequence[tuple[int, Pattern, int]], std: float) -> FloatArray:
    """Covariance (n, n) of n coefficients by the error of the drawing, which all of a pattern have in common."""
    group = np.array([number for number, *_ in places])
    return np.asarray(std**2 * (group[:, None] == group))


def place_jacobian(places: Sequence[tuple[int, FloatArray]]) -> dict[str, FloatArray]:
    """Jacobian of n numbers by errors of their patterns' places, per standard deviation: name -> (n,). `places`: number
    of the group and change by each error, of every number."""
    found: dict[str, FloatArray] = {}
    for k, (number, change) in enumerate(places):
        for direction, size in enumerate(change):
            found.setdefault(f"pattern:{number}:place {direction}", np.zeros(len(places)))[k] = size
    return found
