"""What is looked at along indices: codes, rows, columns, and cells of both, from summaries of the measurements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage, sparse
from scipy.linalg import helmert
from scipy.signal import savgol_coeffs

from lab.diagnose.discovery.profile import Look, Profile
from lab.diagnose.measurements.code_density import CodeCounts, counted, prepared, widths
from lab.diagnose.measurements.dark_frames import dark_frames
from lab.diagnose.measurements.dark_readout import dark_readout
from lab.diagnose.measurements.flat_field import FlatLevel, flats, without_dark
from lab.errors import NotDetermined
from lab.measure.reads import COLLECTED, GAINS, acting
from lab.measure.study import Study
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
CELLS = ((2, 2), (2, 4), (4, 2), (4, 4))
STRIPS = 16  # of a frame, each a repeat of the cell's means
SMOOTHED_CELLS = 4  # cells a side of the box whose mean is taken out
LEAST_STRIPS = 4
#: Measurements that the quantities are part of, by stage.
SHOWN_IN = {
    "codes": frozenset({"code_density"}),
    "charge": frozenset({"flat_lines", "flat_field"}),
    "signal": frozenset({"dark_rows", "dark_columns", "dark_lines", "flat_lines"}),
}


def index_looks(study: Study, effects: Effects) -> Iterator[Look]:
    """Yield what the effects leave along codes, rows and columns."""
    yield from _codes(study, effects)
    yield from _of_images(study, "charge", "mean", _lit_images(study, effects))
    yield from _of_images(study, "signal", "mean", _dark_images(study, effects))
    yield from _of_images(study, "signal", "variance", _dark_variances(study), cells=False)


def _codes(study: Study, effects: Effects) -> Iterator[Look]:
    """Yield the counts of codes in uniform light, seen and held out, less those that the effects' converter gives."""
    try:
        counts = study.once(counted)
    except NotDetermined:
        return
    found = {}
    for held_out in (False, True):
        codes = prepared(study, counts[held_out]) if counts[held_out].captures else None
        if codes is not None:
            found[held_out] = _code_profile(codes, effects, study)
    if False in found:
        yield Look("codes", "code", found[False], found.get(True), shown_in=SHOWN_IN["codes"])


def _code_profile(codes: CodeCounts, effects: Effects, study: Study) -> Profile:
    used, rough = np.flatnonzero(codes.used), codes.rough
    known = rough @ (codes.expected * (widths(codes, effects, study) - 1.0)) if effects else 0.0
    of_widths = sparse.coo_array((rough @ sparse.diags_array(codes.smooth))[used])
    at = of_widths.coords[0], of_widths.coords[1] + codes.first
    matrix = sparse.csr_array((of_widths.data, at), shape=(len(used), int(study.camera.white_level_dn) + 1))
    variance = rough.power(2) @ np.maximum(codes.smooth, 1.0)
    return Profile(used + codes.first, (rough @ codes.count - known)[used], variance[used], matrix)


# --- images ----------------------------------------------------------------------------------------------------------


def _lit_images(study: Study, effects: Effects) -> dict[bool, FloatArray]:
    """Return the mean flat, each plane over its mean, less the dark offsets and over the pattern that effects give even
    light: of seen (False) and of held-out captures.
    """
    try:
        levels, images = study.once(flats)
    except NotDetermined:
        return {}
    dark, pattern = study.once(dark_readout), _pattern(study, levels, effects)
    found = {}
    for held_out, (image, _) in images.items():
        part = [u for u in levels if u.held_out == held_out]
        level = image if dark is None else without_dark(study, dark, part, image)[0]
        found[held_out] = np.asarray(level / pattern, float)
    return found


def _pattern(study: Study, levels: Sequence[FlatLevel], effects: Effects) -> FloatArray | float:
    """Return what effects make of even light (rows, cols): collected, shaded, amplified by place; 1 where none do."""
    here = acting(effects, COLLECTED | GAINS | SHADING)
    if not here:
        return 1.0
    camera, model = study.camera, Uniform(study.camera, here)
    level_e = float(np.mean([np.mean(list(u.mean.values())) for u in levels])) / study.noise.gain
    even = np.full((camera.rows, camera.cols), level_e)
    row, col = np.indices(even.shape)
    points = FieldPoints.at(camera, row.ravel().astype(float), col.ravel().astype(float))
    pattern = collected_mosaic(camera, even, acting(here, COLLECTED), exposure_s=1.0, elapsed_s=0.0) / level_e
    pattern = pattern * model.shade_light(np.ones(even.size), points.x_um, points.y_um).reshape(even.shape)
    gains = model.gain_map()
    return pattern if gains is None else pattern * gains


def _dark_images(study: Study, effects: Effects) -> dict[bool, FloatArray]:
    """Return the mean dark frame, DN, less the offsets that the effects add."""
    dark = study.once(dark_readout)
    if dark is None:
        return {}
    added = Uniform(study.camera, effects)
    image = np.asarray(dark.offsets_dn, float).copy()
    if added.adds_signal:
        image -= study.noise.gain * added.added_e
    for one in added.lines:  # of fixed offsets only their spread is known, but for the step from even to odd lines
        image -= study.noise.gain * replace(one, fixed_e=0.0).mean_e(image.shape)
    return {False: image}


def _dark_variances(study: Study) -> dict[bool, FloatArray]:
    """Return the temporal variance of dark frames over that of their surroundings, without noise of lines, of the
    condition with most repeats.
    """
    try:
        most = max(study.once(dark_frames), key=lambda one: len(one.condition.captures))
    except NotDetermined:
        return {}
    return {out: np.asarray(part.squares, float) / part.contrasts for out, part in most.changing.items()}


def _of_images(
    study: Study, stage: Stage, of: Of, images: dict[bool, FloatArray], *, cells: bool = True
) -> Iterator[Look]:
    """Yield the looks at images along rows, along columns, and within cells of both."""
    if False not in images:
        return
    step, shown = mosaic.step(study.camera.cfa), SHOWN_IN[stage] if of == "mean" else frozenset({"dark_noise"})
    for along in LINES:
        lines = {out: _lines(study, image, along) for out, image in images.items()}
        seen = lines[False]
        if seen is not None:
            yield Look(stage, along, seen, lines.get(True), of=of, step=step, shown_in=shown)
    for cell in CELLS if cells else ():
        within = {out: _within_cells(study, image, cell) for out, image in images.items()}
        seen = within[False]
        if seen is not None:
            yield Look(
                stage, "row and column", seen, within.get(True), columns=cell[1] * step, step=step, shown_in=shown
            )


def _lines(study: Study, image: FloatArray, along: Along) -> Profile | None:
    """Return the profile of an image (rows, cols) along its rows or columns, each plane of the mosaic by itself.

    The filter takes a running polynomial out. The variance is the square of the residuals' robust spread.
    """
    axis, period = 0 if along == "row" else 1, mosaic.step(study.camera.cfa)
    count = image.shape[axis]
    index, residual, matrix = [], [], []
    for phases in mosaic.phases(study.camera.cfa).values():
        for phase in phases:
            mean = image[phase[0] :: period, phase[1] :: period].mean(axis=1 - axis)
            taken = _polynomial_filter(len(mean))
            if taken is None:
                return None
            own = np.arange(phase[axis], count, period)
            index.append(own)
            residual.append(taken @ mean)
            at = sparse.coo_array(taken)
            matrix.append(sparse.csr_array((at.data, (at.coords[0], own[at.coords[1]])), shape=(len(own), count)))
    left = np.concatenate(residual)
    spread = ROBUST * float(np.median(np.abs(left - np.median(left))))
    if spread == 0.0:
        return None
    return Profile(np.concatenate(index), left, np.full(len(left), spread**2), sparse.csr_array(sparse.vstack(matrix)))


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


def _within_cells(study: Study, image: FloatArray, cell: tuple[int, int]) -> Profile | None:
    """Return how pixels differ by their place in a cell (rows, columns) of a plane of the mosaic, beyond what whole
    rows and columns do.

    The means of the cell's pixels over each of `STRIPS` strips of the frame, in the orthogonal contrasts of Helmert
    along rows times those along columns: these are independent of each other, and free of rows and columns.
    """
    (rows, cols), step = cell, mosaic.step(study.camera.cfa)
    contrasts = np.kron(helmert(rows), helmert(cols))
    residual, matrix, spread = [], [], []
    for phases in mosaic.phases(study.camera.cfa).values():
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
