"""What is looked at along coordinates: level, time, exposure, wavelength, place and frequency of what is mismatched.

The residuals are those of all measurements at once. A point of a curve moves them as `empirical_law` does that acts on
its stage, so that a curve has to hold in every measurement that it touches.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from lab.diagnose.discovery.profile import Look, Profile
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.observables.dataset import Dataset
from lab.observables.gaussian import ROUNDING
from lab.observables.observable import Observable
from sim.effects.base import Effects
from sim.effects.empirical_law import PLACES, Along, EmpiricalLaw, Of, Stage
from sim.effects.library import list_changes
from sim.spectrum import FloatArray

MOST_POINTS, LEAST_POINTS = 16, 4
BANDS: tuple[Stage, Along, Of] = ("image", "wavelength", "mean")
#: Where curves are looked for: what levels, spectra and transfer functions feel of a law. Of those that describe as
#: much, the first is told.
CURVES: tuple[tuple[Stage, Along, Of], ...] = (
    ("light", "time", "mean"),
    ("light", "plane x time", "mean"),
    ("image", "radius", "mean"),
    BANDS,
    ("light", "wavelength", "mean"),
    ("image", "frequency", "mean"),
    ("charge", "exposure", "mean"),
    ("charge", "level", "variance"),
    ("signal", "level", "mean"),
    ("signal", "time", "mean"),
    ("signal", "exposure", "mean"),
)
MOST_PLANE_TIMES = 8
MOST_TIMES = 48  # points of time, at any of which something may happen at once
FINE_NM = 2.5  # from one wavelength to the next: a band is narrower than the steps of most sweeps
SMALL = 0.01  # change of a factor by which its slope is found
SMALL_E, SMALL_NM = 1.0, 0.1  # the same of an offset, e, and of a displacement, nm
#: Axis of the measurements whose numbers lie along a coordinate.
AXES: dict[Along, str] = {"level": "level", "wavelength": "wavelength", "frequency": "spatial_frequency"}


def curve_looks(
    model: MeasurementModel, dataset: Dataset, effects: Effects, located: Sequence[int], *, every: bool = False
) -> Iterator[Look]:
    """Yield a look for every coordinate along which a law could change the `located` blocks, beside `effects`. `every`:
    look at all blocks, but not for narrow bands of transmittance.

    The residuals are whitened, those of held-out captures given the seen ones: n numbers of variance 1.
    """
    places = tuple(place for place in CURVES if not (every and place == BANDS))
    at = range(len(model.blocks)) if every else located
    points_of = {place: _points(model, dataset, place, at) for place in places}
    points = {place: found for place, found in points_of.items() if len(found[1]) >= LEAST_POINTS}
    if not points or model.seen.all() or not model.seen.any():
        return
    gaussian = model.gaussian(effects)
    residual, covariance, seen = model.value - gaussian.mean, gaussian.covariance, model.seen
    lower = cholesky(covariance[np.ix_(seen, seen)] + _rounding(covariance, seen), lower=True)
    shared = solve_triangular(lower, covariance[np.ix_(seen, ~seen)], lower=True)
    given = covariance[np.ix_(~seen, ~seen)] - shared.T @ shared
    given = 0.5 * (given + given.T) + _rounding(covariance, ~seen)
    own_axes = {model.blocks[i].measurement.axis for i in at}
    for place, (x, known) in points.items():
        slopes, shown = _slopes(model, effects, place, x)
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
        yield Look(
            stage, along, _profile(white), held_out, of=of, at=tuple(x.tolist()), known=tuple(known.tolist()),
            shown_in=shown, channels=tuple(model.camera.channels), is_of_measurements=True,
            is_own_axis=AXES.get(along) in own_axes,
        )  # fmt: skip


def _rounding(covariance: FloatArray, where: np.ndarray) -> FloatArray:
    return np.diag(ROUNDING * np.diag(covariance)[where])


def _profile(white: FloatArray) -> Profile:
    """Return the profile of whitened columns (n, 1 + N): the residuals, and their slopes by the N points."""
    # one after the other belongs to either half: neighbours share captures
    return Profile(np.arange(len(white)) % 2, white[:, 0], np.ones(len(white)), white[:, 1:])


def _points(
    model: MeasurementModel, dataset: Dataset, place: tuple[Stage, Along, Of], located: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Return the points of a curve, and those of them that seen numbers lie at: places of the numbers of the located
    blocks that a law there could change.
    """
    along, none = place[1], np.zeros(0)
    changed = list_changes(_law(place, np.array([0.0, 1.0]), np.array([0.0, 0.1])))
    every, seen = [none], [none]
    for i in located:
        block = model.blocks[i]
        if not block.reads & changed:
            continue
        x = _coordinate(block, dataset, along)
        there = np.isfinite(x)
        every.append(x[there])
        seen.append(x[there & model.seen[model.slices[i]]])
    points = np.unique(np.concatenate(every).round(9))
    if along == "frequency":
        points = np.append(0.0, points[points > 0.0])
    most = MOST_TIMES if along in {"time", "wavelength"} else MOST_PLANE_TIMES if "plane" in along else MOST_POINTS
    if len(points) > most:
        points = points[np.unique(np.linspace(0, len(points) - 1, most).round().astype(int))]
    known = points[np.isin(points, np.concatenate(seen).round(9))]
    if place == ("image", "wavelength", "mean") and len(points):
        points = np.union1d(points, np.arange(points[0], points[-1], FINE_NM))
    return points, known


def _coordinate(block: Observable, dataset: Dataset, along: Along) -> FloatArray:
    """Return where a block's numbers lie along a coordinate (n,); NaN where it isn't one of theirs."""
    none = np.full(len(block.labels), np.nan)
    axis = block.measurement.axis
    if along in AXES:
        x = np.array([label.x for label in block.labels])
        if axis != AXES[along] or block.measurement.places:
            return none
        if along == "level":  # variances are stated by signals above black
            x = (x if block.measurement.of_variances else x - dataset.noise.black) / dataset.noise.gain
        return x / dataset.camera.pixel_pitch_um if along == "frequency" else x
    if along == "radius":
        place = block.position
        return 1e3 * np.hypot(*place.T) if axis == "field" and place.ndim == 2 else none
    captures = {c.id: c for c in dataset.recordings.captures(side=dataset.side)}
    for k, label in enumerate(block.labels):
        if len(label.captures) == 1:
            capture = captures[label.captures[0]]
            none[k] = capture.exposure_s if along == "exposure" else dataset.elapsed_s(capture)
    return none


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
    small = SMALL if PLACES[place][1] == 1.0 else SMALL_NM if place[0] == "light" else SMALL_E
    count = len(points) * (len(model.camera.channels) if "plane" in place[1] else 1)
    laws = [_law(place, points, small * one) for one in np.eye(count)]
    changed, slopes = list_changes(laws[-1]), np.zeros((len(model.value), count))
    shown = set()
    for block, at in zip(model.blocks, model.slices, strict=True):
        if not block.reads & changed:
            continue
        base = block.predict(acting).mean
        slopes[at] = np.column_stack([block.predict((*acting, law)).mean - base for law in laws]) / small
        if slopes[at].any():
            shown.add(block.measurement.name)
    return slopes, frozenset(shown)
