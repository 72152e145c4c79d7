"""What is looked at along indices: codes, rows, columns, and cells of both, from summaries of the measurements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal, cast

import numpy as np
from scipy import ndimage, sparse
from scipy.linalg import helmert
from scipy.signal import savgol_coeffs

from lab.diagnose.discovery.images import DarkImages, Image, dark_images, flat_images, noise_by_time
from lab.diagnose.discovery.profile import Look, Profile
from lab.errors import NotDetermined
from lab.observables.codes.density import CodeHistogram, counted, counted_in_all, prepared
from lab.observables.codes.landings import widths
from lab.observables.darks.frames import cell_means
from lab.observables.darks.readout import dark_readout
from lab.observables.dataset import Dataset
from lab.observables.flats.images import FlatLevel, flats, without_dark
from lab.observables.reads import CODES, COLLECTED, GAINS, acting
from sim.camera import Cfa
from sim.effects.base import Effects
from sim.effects.empirical_law import Along, Of, Stage
from sim.frame import collected_mosaic
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import SHADING, FieldPoints, Uniform

#: Lines on either side of the running polynomial, in lines of a plane of the mosaic, and its degree.
REACH, DEGREE = 24, 2
ROBUST = 1.4826  # median absolute departure -> standard deviation of a normal distribution
LINES: tuple[Along, ...] = ("row", "column")
#: Cells of a plane of the mosaic, rows and columns, in which pixels may differ by their place.
CELLS = ((1, 2), (2, 1), (1, 4), (4, 1), (2, 2), (2, 4), (4, 2), (4, 4))
STRIPS = 16  # of a frame, each a repeat of the cell's means
SMOOTHED_CELLS = 4  # cells a side of the box whose mean is taken out
LEAST_STRIPS = 4
PLACES_A_SIDE, RADII, ANGLES = 16, 12, 24  # parts of a side whose means are looked at; points of their curves
LEAST_TIMES, MOST_TIMES = 8, 24  # from which on noise is looked at by time; points of its curve
LEAST_PATTERN_DN = 0.01  # range of offsets of lines in the dark, below which they are of no account
LEAST_OFFSET_DN = 0.1  # of a flat, by which offsets in light may differ from those in the dark
NOISE_FLOOR = 1e-3  # relative standard deviation of a variance beside that of its pixels
MOST_LINES = 512  # groups of lines whose whole course is looked at
#: Measurements that the quantities are part of, by stage.
SHOWN_IN = {
    "codes": frozenset({"code_density"}),
    "charge": frozenset({"flat_lines", "flat_field"}),
    "signal": frozenset({"dark_rows", "dark_columns", "dark_lines", "flat_lines"}),
}


def index_looks(dataset: Dataset, effects: Effects) -> Iterator[Look]:
    """Yield what the effects leave along codes, rows, columns and places of the sensor."""
    yield from _codes(dataset, effects)
    step, even = mosaic.step(dataset.camera.cfa), _lit_images(dataset, effects)
    yield from _lines_of(dataset, "charge", "mean", even, step)
    yield from _cells_of(dataset, "charge", even)
    yield from _places_of(dataset, "image", "angle", even, field=True)
    dark, mean = dataset.once(dark_images), _offsets(dataset, effects, "mean")
    yield from _lines_of(dataset, "signal", "mean", mean, 1)
    yield from _cells_of(dataset, "signal", mean)
    yield from _places_of(dataset, "signal", "radius", _offsets(dataset, effects, "offset"))
    yield from _places_of(dataset, "charge", "radius", _per_second(dataset, dark, effects))
    yield from _lines_of(dataset, "signal", "variance", _part(dark, "variance"), 1)
    yield from _lines_of(dataset, "signal", "covariance", _part(dark, "below"), 1, lines=("row",))
    yield from _lines_of(dataset, "signal", "covariance", _part(dark, "right"), 1, lines=("column",))
    yield from _noise_times(dataset)
    lit = dataset.once(flat_images)
    bend = {out: one.bend for out, one in lit.items()}
    yield from _lines_of(dataset, "signal", "mean", bend, step, times=" x level")
    fixed_s = {out: one.fixed_s for out, one in lit.items() if one.fixed_s is not None}
    # a pattern of offsets that is another in light is one of time where the signal goes by the exposure
    least_s = LEAST_OFFSET_DN / lit[False].greatest_dn_per_s if False in lit else 0.0
    yield from _places_of(dataset, "charge", "radius x exposure", fixed_s, least=least_s)


def _codes(dataset: Dataset, effects: Effects) -> Iterator[Look]:
    """Yield the counts of codes in light, seen and held out, less those that the effects' converter gives.

    Even light has to show codes by itself. Beside a converter's effect it is all that counts: there its counts are
    known best.
    """
    even_only = bool(acting(effects, CODES))
    try:
        if prepared(dataset, dataset.once(counted)[False]) is None:
            return
        counts = dataset.once(counted if even_only else counted_in_all)
    except NotDetermined:
        return
    found = {}
    for held_out in (False, True):
        codes = prepared(dataset, counts[held_out]) if counts[held_out].captures else None
        if codes is not None:
            found[held_out] = _code_profile(codes, effects, dataset)
    if False in found:
        yield Look("codes", "code", found[False], found.get(True), shown_in=SHOWN_IN["codes"])


def _code_profile(codes: CodeHistogram, effects: Effects, dataset: Dataset) -> Profile:
    used, rough = np.flatnonzero(codes.used), codes.rough
    known = rough @ (codes.expected * (widths(codes, effects, dataset) - 1.0)) if acting(effects, CODES) else 0.0
    of_widths = sparse.coo_array((rough @ sparse.diags_array(codes.smooth))[used])
    at = of_widths.coords[0], of_widths.coords[1] + codes.first
    matrix = sparse.csr_array((of_widths.data, at), shape=(len(used), int(dataset.camera.white_level_dn) + 1))
    variance = rough.power(2) @ np.maximum(codes.smooth, 1.0)
    return Profile(used + codes.first, (rough @ codes.count - known)[used], variance[used], matrix)


# --- images ----------------------------------------------------------------------------------------------------------


def _lit_images(dataset: Dataset, effects: Effects) -> dict[bool, FloatArray]:
    """Return the mean flat, each plane over its mean, less the dark offsets and over the pattern that effects give even
    light: of seen (False) and of held-out captures.
    """
    try:
        levels, images = dataset.once(flats)
    except NotDetermined:
        return {}
    dark, pattern = dataset.once(dark_readout), _pattern(dataset, levels, effects)
    found = {}
    for held_out, (image, _) in images.items():
        part = [u for u in levels if u.held_out == held_out]
        level = image if dark is None else without_dark(dataset, dark, part, image)[0]
        found[held_out] = np.asarray(level / pattern, float)
    return found


def _pattern(dataset: Dataset, levels: Sequence[FlatLevel], effects: Effects) -> FloatArray | float:
    """Return what effects make of even light (rows, cols): collected, shaded, amplified by place; 1 where none do."""
    here = acting(effects, COLLECTED | GAINS | SHADING)
    if not here:
        return 1.0
    camera, model = dataset.camera, Uniform(dataset.camera, here)
    level_e = float(np.mean([np.mean(list(u.mean.values())) for u in levels])) / dataset.noise.gain
    even = np.full((camera.rows, camera.cols), level_e)
    row, col = np.indices(even.shape)
    points = FieldPoints.at(camera, row.ravel().astype(float), col.ravel().astype(float))
    pattern = collected_mosaic(camera, even, acting(here, COLLECTED), exposure_s=1.0, elapsed_s=0.0) / level_e
    pattern = pattern * model.shade_light(np.ones(even.size), points.x_um, points.y_um).reshape(even.shape)
    gains = model.gain_map()
    return pattern if gains is None else pattern * gains


def _offsets(dataset: Dataset, effects: Effects, name: Literal["mean", "offset"]) -> dict[bool, FloatArray]:
    """Return the mean dark frame, of all exposures or at none, DN, less the offsets that the effects add."""
    added, found = Uniform(dataset.camera, effects), {}
    for out, dark in dataset.once(dark_images).items():
        image = np.array(getattr(dark, name), float)
        if added.adds_signal:
            image -= dataset.noise.gain * added.added_e
        for one in added.lines:  # of fixed offsets only their spread is known, but for the step from even to odd lines
            image -= dataset.noise.gain * replace(one, fixed_e=0.0).mean_e(image.shape)
        found[out] = image
    return found


def _per_second(dataset: Dataset, dark: dict[bool, DarkImages], effects: Effects) -> dict[bool, FloatArray]:
    """Return the dark current by pixel, DN/s, less that of the effects."""
    model = Uniform(dataset.camera, effects)
    own = dataset.noise.gain * model.dark_e_per_s(dataset.temperature_c) if model.changes_dark_current else 0.0
    return {out: np.asarray(one.per_second - own, float) for out, one in dark.items() if one.per_second is not None}


def _part(dark: dict[bool, DarkImages], name: Literal["variance", "below", "right"]) -> dict[bool, Image]:
    """Return the variances or covariances of dark frames, over the variance of most pixels."""
    found = {}
    for out, one in dark.items():
        image = getattr(one, name)
        if image is not None and one.variance is not None:
            found[out] = image / float(np.mean(one.variance, dtype=float))
    return found


def _lines_of(
    dataset: Dataset,
    stage: Stage,
    of: Of,
    images: Mapping[bool, Image],
    step: int,
    *,
    times: str = "",
    lines: Sequence[str] = LINES,
) -> Iterator[Look]:
    """Yield the looks at images along rows and columns: at what is rough, and at the whole course.

    step : period of the mosaic where its planes are looked at apart, else 1
    times : the rest of the index's name, of a product
    """
    if False not in images:
        return
    least = LEAST_PATTERN_DN if stage == "signal" and of == "mean" and not times else 0.0
    shown = frozenset({"dark_noise"}) if of != "mean" else frozenset() if times else SHOWN_IN[stage]
    cfa: Cfa = dataset.camera.cfa if step > 1 else "MONO"
    for line in lines:
        along = cast(Along, f"{line}{times}")
        rough = {out: _rough_lines(image, line, cfa) for out, image in images.items()}
        seen = rough[False]
        if seen is not None:
            yield Look(stage, along, seen, rough.get(True), of=of, step=step, shown_in=shown, least=least)
        if not times:
            whole = {out: _whole_lines(image, line, bent=stage == "charge") for out, image in images.items()}
            seen = whole[False]
            if seen is not None:
                yield Look(
                    stage, along, seen, whole.get(True), of=of, step=step, shown_in=shown, least=least, is_whole=True
                )


def _cells_of(dataset: Dataset, stage: Stage, images: Mapping[bool, Image]) -> Iterator[Look]:
    """Yield the looks within cells of rows and columns."""
    step = mosaic.step(dataset.camera.cfa)
    for cell in CELLS if False in images else ():
        if min(cell) * step < 2:
            continue
        within = {out: _within_cells(dataset, image, cell) for out, image in images.items()}
        seen = within[False]
        if seen is not None:
            yield Look(
                stage, "row and column", seen, within.get(True), columns=cell[1] * step, step=step,
                shown_in=SHOWN_IN[stage],
            )  # fmt: skip


def _places_of(
    dataset: Dataset,
    stage: Stage,
    along: Along,
    images: Mapping[bool, Image],
    *,
    field: bool = False,
    least: float = 0.0,
) -> Iterator[Look]:
    """Yield the look at images along the radius, or along the angle about the sensor's centre.

    field : whether light and lens may change the image: beside it may stand x, y, r^2 and r^4
    least : range of departures below which nothing is told
    """
    rows, cols = dataset.camera.rows, dataset.camera.cols
    if False not in images or min(rows, cols) < 4 * PLACES_A_SIDE:
        return
    pitch_um, middle = dataset.camera.pixel_pitch_um, (np.arange(PLACES_A_SIDE) + 0.5) / PLACES_A_SIDE - 0.5
    y, x = (one.ravel() for one in np.meshgrid(rows * middle * pitch_um, cols * middle * pitch_um, indexing="ij"))
    radius, most = np.hypot(x, y), 0.5 * pitch_um * float(np.hypot(rows, cols))
    beside = [np.ones(x.size), x / most, y / most]
    if field:
        beside += [(radius / most) ** 2, (radius / most) ** 4]
    if along == "angle":
        at = np.linspace(0.0, 360.0, ANGLES + 1)
        turn = np.degrees(np.arctan2(y, x)) % 360.0
        matrix = np.stack([np.interp(turn, at, one) for one in np.eye(len(at))], axis=1)
        matrix *= ((radius / most) ** 2)[:, None]
    else:
        at = np.linspace(0.0, most, RADII)
        matrix = np.stack([np.interp(radius, at, one) for one in np.eye(len(at))], axis=1)
    half = np.indices((PLACES_A_SIDE, PLACES_A_SIDE)).sum(axis=0).ravel() % 2
    found = {}
    for out, image in images.items():
        cells = cell_means(image, (PLACES_A_SIDE, PLACES_A_SIDE))
        bends = np.concatenate([np.diff(cells, 2, axis=axis).ravel() for axis in (0, 1)])
        variance = (ROBUST * float(np.median(np.abs(bends)))) ** 2 / 6.0
        if variance == 0.0:
            return
        every = Profile(half, cells.ravel(), np.full(cells.size, variance), matrix)
        found[out] = every.beside(np.stack(beside, axis=1))
    points = tuple(at.tolist())
    yield Look(stage, along, found[False], found.get(True), at=points, known=points, least=least, is_whole=True)


def _noise_times(dataset: Dataset) -> Iterator[Look]:
    """Yield the look at the variance of repeats by time, DN^2. Beside it may stand variance in proportion to the
    signal and to its square, and of each longer dark exposure.
    """
    noise = dataset.once(noise_by_time)
    if noise is None or len(np.unique(noise.elapsed_s)) < LEAST_TIMES:
        return
    at = np.unique(noise.elapsed_s)
    at = at[np.unique(np.linspace(0, len(at) - 1, MOST_TIMES).round().astype(int))]
    hats = np.stack([np.interp(noise.elapsed_s, at, one) for one in np.eye(len(at))], axis=1)
    matrix = noise.shares @ hats
    terms = [np.ones(len(noise.signal_dn)), noise.signal_dn, noise.square_dn2]
    terms += [(noise.dark_s == t).astype(float) for t in np.unique(noise.dark_s[noise.dark_s > 0.0])]
    beside = np.stack([one / max(float(np.max(one)), 1e-9) for one in terms], axis=1)
    variance = 2.0 * np.square(noise.variance_dn2) / noise.pixels + np.square(NOISE_FLOOR * noise.variance_dn2)
    found = {}
    for out in (False, True):
        own = noise.held_out == out
        if own.sum() > 2 * beside.shape[1]:
            half = np.arange(int(own.sum())) % 2
            profile = Profile(half, noise.variance_dn2[own], variance[own], matrix[own])
            found[out] = profile.beside(beside[own])
    if False in found:
        points = tuple(at.tolist())
        yield Look(
            "signal", "time", found[False], found.get(True), of="variance", at=points, known=points, is_whole=True,
            shown_in=frozenset({"dark_noise", "temporal_noise"}),
        )  # fmt: skip


def _rough_lines(image: Image, along: str, cfa: Cfa) -> Profile | None:
    """Return the profile of an image (rows, cols) along its rows or columns, each plane of the mosaic by itself.

    The filter takes a running polynomial out. The variance is the square of the residuals' robust spread.
    """
    axis, period = 0 if along == "row" else 1, mosaic.step(cfa)
    count = image.shape[axis]
    index, residual, matrix, noise = [], [], [], []
    for phases in mosaic.phases(cfa).values():
        for phase in phases:
            plane = image[phase[0] :: period, phase[1] :: period]
            mean = plane.mean(axis=1 - axis)
            taken = _polynomial_filter(len(mean))
            if taken is None:
                return None
            own = np.arange(phase[axis], count, period)[: len(mean)]
            index.append(own)
            residual.append(taken @ mean)
            noise.append(np.full(len(mean), _pixel_variance(plane) / plane.shape[1 - axis]))
            at = sparse.coo_array(taken)
            matrix.append(sparse.csr_array((at.data, (at.coords[0], own[at.coords[1]])), shape=(len(own), count)))
    left = np.concatenate(residual)
    spread = ROBUST * float(np.median(np.abs(left - np.median(left))))
    if spread == 0.0:
        return None
    every, variance = sparse.csr_array(sparse.vstack(matrix)), np.full(len(left), spread**2)
    return Profile(np.concatenate(index), left, variance, every, np.concatenate(noise))


def _pixel_variance(plane: Image) -> float:
    """Return the variance of single pixels beside what their rows and columns share."""
    twice = plane[:-1, :-1] - plane[1:, :-1] - plane[:-1, 1:] + plane[1:, 1:]
    return float(np.mean(np.square(twice))) / 4.0


def _whole_lines(image: Image, along: str, *, bent: bool) -> Profile | None:
    """Return the profile of the means of rows or columns less their mean, in at most `MOST_LINES` groups; None where
    they are smooth to the last bit.

    bent : whether light may change them along the frame: beside the lines may stand a curve of fourth degree
    """
    axis = 0 if along == "row" else 1
    line = np.asarray(image.mean(axis=1 - axis), float)
    count = len(line)
    group = np.arange(count) * min(count, MOST_LINES) // count
    share = np.zeros((int(group[-1]) + 1, count))
    share[group, np.arange(count)] = 1.0
    share /= share.sum(axis=1, keepdims=True)
    mean, place = share @ line, np.linspace(-1.0, 1.0, len(share))
    spread = ROBUST * float(np.median(np.abs(np.diff(mean, 2)))) / np.sqrt(6.0)
    if spread == 0.0:
        return None
    variance = np.full(len(mean), spread**2)
    beside = np.stack([place**k for k in range(5 if bent else 1)], axis=1)
    noise = np.full(len(mean), _pixel_variance(image) / image.shape[1 - axis] / (count / len(share)))
    return Profile(np.arange(len(mean)) % 2, mean, variance, share, noise).beside(beside)


def _polynomial_filter(count: int) -> sparse.csr_array | None:
    """Return the matrix (count, count) that takes a running polynomial out of lines; None for too few of them."""
    reach = min(REACH, (count - 1) // 4)
    size = 2 * reach + 1
    if size <= 2 * DEGREE + 1:
        return None
    weights = np.array([savgol_coeffs(size, DEGREE, pos=place, use="dot") for place in range(size)])
    line = np.arange(count)
    first = np.clip(line - reach, 0, count - size)
    at = np.repeat(line, size), (first[:, None] + np.arange(size)).ravel()
    smooth = sparse.csr_array((weights[line - first].ravel(), at), shape=(count, count))
    return sparse.csr_array(sparse.eye_array(count) - smooth)


def _within_cells(dataset: Dataset, image: Image, cell: tuple[int, int]) -> Profile | None:
    """Return how pixels differ by their place in a cell (rows, columns) of a plane of the mosaic.

    The means of the cell's pixels over each of `STRIPS` strips of the frame, in Helmert's contrasts, which are
    independent of each other.
    """
    (rows, cols), step = cell, mosaic.step(dataset.camera.cfa)
    contrasts = helmert(rows * cols)
    residual, matrix, spread = [], [], []
    for phases in mosaic.phases(dataset.camera.cfa).values():
        for phase in phases:
            plane = image[phase[0] :: step, phase[1] :: step]
            down, across = plane.shape[0] // rows, plane.shape[1] // cols
            strips = min(STRIPS, down // 2)
            if strips < LEAST_STRIPS or across < SMOOTHED_CELLS:
                return None
            plane = plane[: down * rows, : across * cols]
            rough = plane - ndimage.uniform_filter(plane, (SMOOTHED_CELLS * rows, SMOOTHED_CELLS * cols))
            means = rough.reshape(down, rows, across, cols).mean(axis=2).reshape(down, rows * cols)
            first = np.linspace(0, down, strips + 1).astype(int)[:-1]
            number = np.diff(np.append(first, down))
            found = (np.add.reduceat(means, first, axis=0) / number[:, None]) @ contrasts.T
            spread.append(found - found.mean(axis=0))
            residual.append(found.ravel())
            place = (np.arange(rows) * step + phase[0])[:, None] * cols * step + np.arange(cols) * step + phase[1]
            own = np.zeros((len(contrasts), rows * cols * step * step))
            own[:, place.ravel()] = contrasts
            matrix.append(np.tile(own, (strips, 1)))
    noise = ROBUST * float(np.median(np.abs(np.concatenate([one.ravel() for one in spread]))))
    if noise == 0.0:
        return None
    left = np.concatenate(residual)
    strip = np.concatenate([np.repeat(np.arange(len(one)), one.shape[1]) for one in spread])
    return Profile(strip, left, np.full(len(left), noise**2), np.concatenate(matrix))
