"""What is looked at along coordinates: level, time, exposure, wavelength, place and frequency of what is mismatched.

The residuals are those of all measurements at once. A point of a curve moves them as `empirical_law` does that acts on
its stage, so that a curve has to hold in every measurement that it touches.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from lab.diagnose.discovery.profile import Look, Profile
from lab.diagnose.inference.gaussian import ROUNDING
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.measurements.block import Block, Effects
from lab.diagnose.measurements.study import Study
from sim.effects.empirical_law import PLACES, Along, EmpiricalLaw, Of, Stage
from sim.effects.library import list_changes
from sim.spectrum import FloatArray

MOST_POINTS, LEAST_POINTS = 16, 4
SMALL = 0.01  # change of a factor by which its slope is found
SMALL_E = 1.0  # the same of an offset, e
#: Axis of the measurements whose numbers lie along a coordinate.
AXES: dict[Along, str] = {"level": "level", "wavelength": "wavelength", "frequency": "spatial_frequency"}


def curve_looks(model: MeasurementModel, study: Study, effects: Effects, located: Sequence[int]) -> Iterator[Look]:
    """Yield a look for every coordinate along which a law could change the `located` blocks, beside `effects`.

    The residuals are whitened, those of held-out captures given the seen ones: n numbers of variance 1.
    """
    places = [
        (place, points) for place in PLACES if len(points := _points(model, study, place, located)) >= LEAST_POINTS
    ]
    if not places or model.seen.all() or not model.seen.any():
        return
    gaussian = model.gaussian(effects)
    residual, covariance, seen = model.value - gaussian.mean, gaussian.covariance, model.seen
    lower = cholesky(covariance[np.ix_(seen, seen)] + _rounding(covariance, seen), lower=True)
    shared = solve_triangular(lower, covariance[np.ix_(seen, ~seen)], lower=True)
    given = covariance[np.ix_(~seen, ~seen)] - shared.T @ shared
    given = 0.5 * (given + given.T) + _rounding(covariance, ~seen)
    for place, points in places:
        slopes, shown = _slopes(model, effects, place, points)
        if not slopes[seen].any():
            continue
        white = solve_triangular(lower, np.column_stack([residual[seen], slopes[seen]]), lower=True)
        out = np.column_stack([residual[~seen], slopes[~seen]]) - shared.T @ white
        judged = np.isin(np.flatnonzero(~seen), np.flatnonzero(slopes.any(axis=1)))
        held_out = None
        if judged.any():
            own = cholesky(given[np.ix_(judged, judged)], lower=True)
            held_out = _profile(solve_triangular(own, out[judged], lower=True))
        stage, along, of = place
        yield Look(stage, along, _profile(white), held_out, of=of, at=tuple(points.tolist()), shown_in=shown)


def _rounding(covariance: FloatArray, where: np.ndarray) -> FloatArray:
    return np.diag(ROUNDING * np.diag(covariance)[where])


def _profile(white: FloatArray) -> Profile:
    """Return the profile of whitened columns (n, 1 + N): the residuals, and their slopes by the N points."""
    # one after the other belongs to either half: neighbours share captures
    return Profile(np.arange(len(white)) % 2, white[:, 0], np.ones(len(white)), white[:, 1:])


def _points(
    model: MeasurementModel, study: Study, place: tuple[Stage, Along, Of], located: Sequence[int]
) -> FloatArray:
    """Return the points of a curve: places of the seen numbers of the blocks that a law there could change."""
    along = place[1]
    if along in {"code", "row", "column", "row and column"}:
        return np.zeros(0)
    changed = list_changes(_law(place, np.array([0.0, 1.0]), np.array([0.0, 0.1])))
    found = [_coordinate(model.blocks[i], study, along) for i in located if model.blocks[i].reads & changed]
    every = np.unique(np.concatenate([np.zeros(0), *found]).round(9))
    if along == "frequency":
        every = np.append(0.0, every[every > 0.0])
    if len(every) > MOST_POINTS:
        every = every[np.unique(np.linspace(0, len(every) - 1, MOST_POINTS).round().astype(int))]
    return every


def _coordinate(block: Block, study: Study, along: Along) -> FloatArray:
    """Return where a block's seen numbers lie along a coordinate; none where it isn't one of the block's."""
    seen = np.array([not label.held_out for label in block.labels])
    axis = block.measurement.axis
    if along in AXES:
        x = np.array([label.x for label in block.labels])[seen]
        if axis != AXES[along] or block.measurement.places:
            return np.zeros(0)
        if along == "level":  # variances are stated by signals above black
            x = (x if block.measurement.of_variances else x - study.noise.black) / study.noise.gain
        return x / study.camera.pixel_pitch_um if along == "frequency" else x
    if along == "radius":
        place = block.position
        return 1e3 * np.hypot(*place[seen].T) if axis == "field" and place.ndim == 2 else np.zeros(0)
    captures = {c.id: c for c in study.recordings.captures(side=study.side)}
    single = [captures[label.captures[0]] for label in block.labels if not label.held_out and len(label.captures) == 1]
    return np.array([study.elapsed_s(c) if along == "time" else c.exposure_s for c in single], float)


def _law(place: tuple[Stage, Along, Of], points: FloatArray, departure: FloatArray) -> EmpiricalLaw:
    """Return the law of a curve's departures from no change at its points."""
    stage, along, of = place
    none = PLACES[place][1]
    change = departure.copy()
    if along == "frequency":
        change[0] = 0.0
    table = tuple((none + change).tolist())
    return EmpiricalLaw(stage=stage, along=along, of=of, period=0, at=tuple(points.tolist()), table=table, strength=1.0)


def _slopes(
    model: MeasurementModel, effects: Effects, place: tuple[Stage, Along, Of], points: FloatArray
) -> tuple[FloatArray, frozenset[str]]:
    """Return the slopes (n, N) of all numbers by the curve's N points, and the measurements that it changes."""
    acting = (*model.always, *effects)
    small = SMALL if PLACES[place][1] == 1.0 else SMALL_E
    laws = [_law(place, points, small * one) for one in np.eye(len(points))]
    changed, slopes = list_changes(laws[-1]), np.zeros((len(model.value), len(points)))
    shown = set()
    for block, at in zip(model.blocks, model.slices, strict=True):
        if not block.reads & changed:
            continue
        base = block.predict(acting).mean
        slopes[at] = np.column_stack([block.predict((*acting, law)).mean - base for law in laws]) / small
        if slopes[at].any():
            shown.add(block.measurement.name)
    return slopes, frozenset(shown)
