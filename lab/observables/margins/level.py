"""The level of overscan and of masked pixels in dark frames and flats, in the order in which they were taken: the black
level as it was in each frame, lit or dark."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lab.capture_kinds.base import Capture
from lab.errors import NotDetermined
from lab.observables.darks.level import dark_current_map
from lab.observables.dataset import Dataset
from lab.observables.margins.frames import (
    LEAST_LINES,
    LEAST_NOISE_STEPS,
    MarginFrame,
    deferred_shares,
    margin_frames,
)
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import DARK_CURRENT, LINES, TRAILS
from sim.effects.base import Effects
from sim.spectrum import FloatArray
from sim.uniform import Uniform

#: Groups of successive frames of one part whose mean is a number, at most.
MOST_GROUPS = 12
#: Prior standard deviation of the level of margins against that of the active area, DN: only its change is used.
OFFSET_DN = 50.0
#: Of |x| of a normal variable, the median over the standard deviation.
MEDIAN_OF_NORMAL = 0.6745


@dataclass(frozen=True)
class _Place:
    """Lines whose mean is one level: of overscan far from the active area, or of masked pixels."""

    name: str
    strips: tuple[int, ...]
    is_masked: bool


def measure_margin_level(dataset: Dataset) -> Observable:
    """Mean of overscan, and of masked pixels, over groups of frames that followed one another, DN.

    Nuisance parameters: the levels of both against the active area's, and the dark current of masked pixels. Effects
    may add an offset that drifts with time, temperature or exposure, dark current, and deferred charge. The scatter is
    that of successive frames. Raises NotDetermined without overscan and masked lines, for fewer than 6 frames of a
    part, and where noise doesn't dither the codes."""
    made = dataset.once(margin_frames)
    if made.pixel_dn < LEAST_NOISE_STEPS * dataset.step_dn:
        raise NotDetermined(
            "margin_level",
            f"noise of overscan is {made.pixel_dn / dataset.step_dn:.2g} steps of the codes, below the limit of "
            f"{LEAST_NOISE_STEPS:g}: rounding hides changes of its level; raise the gain",
        )
    far = tuple(k for k, strip in enumerate(made.strips) if strip.overscan >= LEAST_LINES)
    masked = tuple(k for k, strip in enumerate(made.strips) if strip.masked)
    kinds = (_Place("overscan", far, False), _Place("masked pixels", masked, True))
    places = [place for place in kinds if place.strips]
    groups = [g for held_out in (False, True) for g in _groups(made.frames, held_out)]
    if not places or not groups:
        raise NotDetermined(
            "margin_level", f"no end of the frames has {LEAST_LINES} lines of overscan or a masked line, in 6 frames"
        )

    def lines(place: _Place, strip: int) -> slice:
        one = made.strips[strip]
        return slice(0, one.masked) if place.is_masked else slice(-one.base, None)

    def level(frame: MarginFrame, place: _Place) -> float:
        return float(np.mean([frame.lines[k][lines(place, k)].mean() for k in place.strips]))

    every = np.array([[level(frame, place) for place in places] for frame in made.frames])  # (frames, places)
    index = {frame.capture.id: i for i, frame in enumerate(made.frames)}
    means = np.array([np.mean(every[[index[f.capture.id] for f in g]], axis=0) for g in groups])  # (groups, places)
    captures = [f.capture for f in made.frames]
    dark_dn = np.array([dataset.noise.dark_dn_per_s * c.exposure_s for c in captures])
    is_masked = np.array([place.is_masked for place in places], float)
    own_dn2 = _scatter(every - np.outer(dark_dn, is_masked))

    def mean_of_groups(values: FloatArray) -> FloatArray:
        """Return the means over the groups, place by place, of values of the frames (frames, places)."""
        return np.array([np.mean(values[[index[f.capture.id] for f in g]], axis=0) for g in groups]).T.ravel()

    def predict(effects: Effects) -> Prediction:
        offset, dark_e = dataset.offset(effects), _added_dark_e(dataset, effects)
        shares = deferred_shares(dataset, made, effects)
        mean = np.full(every.shape, dataset.noise.black) + np.outer(dark_dn, is_masked)
        for i, frame in enumerate(made.frames):
            mean[i] += offset(frame.capture)
            for j, place in enumerate(places):
                deferred = [
                    frame.signal_dn(made.strips, k) * float(shares[k][lines(place, k)].mean())
                    for k in place.strips
                    if made.strips[k].overscan >= LEAST_LINES
                ]
                mean[i, j] += float(np.mean(deferred)) if deferred else 0.0
                if place.is_masked:
                    mean[i, j] += dataset.noise.gain * dark_e(frame.capture)
        columns = {
            f"offset of {place.name}": np.repeat([OFFSET_DN * (k == j) for k in range(len(places))], len(groups))
            for j, place in enumerate(places)
        }
        exposures = np.array([c.exposure_s for c in captures])
        for name, column in (dataset.free_offsets(exposures) | dataset.free_warmth(captures)).items():
            if name != "black":  # of the active area
                columns[name] = mean_of_groups(np.outer(column, is_masked))
        return Prediction(mean_of_groups(mean), columns)

    size = [len(g) for g in groups]
    covariance: FloatArray = np.asarray(np.kron(own_dn2, np.diag(1.0 / np.array(size))), np.float64)
    labels = tuple(
        Label(
            float(np.mean([dataset.elapsed_s(f.capture) for f in g])) / 60.0, "all", place.name,
            tuple(f.capture.id for f in g), g[0].is_held_out,
        )
        for place in places
        for g in groups
    )  # fmt: skip
    reads = {"signal.offset_dn", "signal.exposure_offset_dn"} | TRAILS | (DARK_CURRENT if masked else frozenset())
    return Observable(
        measurement=MARGIN_LEVEL, reach=float(max(np.ptp([label.x for label in labels]) / 4.0, 1e-3)),
        value=means.T.ravel(), covariance=covariance, labels=labels, reads=frozenset(reads), scattered_by=LINES,
        predict=predict, scale=np.ones(len(labels)),
    )  # fmt: skip


def _added_dark_e(dataset: Dataset, effects: Effects) -> Callable[[Capture], float]:
    """Function of a capture that returns the change of a masked pixel's dark charge by effects: that of the median
    pixel, e."""
    if not Uniform(dataset.camera, effects).changes_dark_current:
        return lambda capture: 0.0
    at = dark_current_map(dataset, effects)

    def added(capture: Capture) -> float:
        rate = float(np.median(at(capture.temperature_c)))
        return (rate - dataset.camera.dark_current_e_per_s) * capture.exposure_s

    return added


def _groups(frames: tuple[MarginFrame, ...], held_out: bool) -> list[list[MarginFrame]]:
    """Return successive frames of a part in at most `MOST_GROUPS` groups of about equal number."""
    part = [f for f in frames if f.is_held_out == held_out]
    if len(part) < 6:
        return []
    ends = np.linspace(0, len(part), min(MOST_GROUPS, len(part) // 2) + 1).round().astype(int)
    return [part[start:end] for start, end in pairwise(ends)]


def _scatter(level: FloatArray) -> FloatArray:
    """Return the covariance (places, places) of the levels of one frame, from the differences of successive ones
    (frames, places), robustly: drifts are slow, and changes of the exposure seldom."""
    step = np.diff(level, axis=0) / np.sqrt(2.0)
    std = np.median(np.abs(step), axis=0) / MEDIAN_OF_NORMAL
    std = np.maximum(std, 1e-6)
    pulls = step / std
    inside = np.all(np.abs(pulls) < 4.0, axis=1)
    together = pulls[inside].T @ pulls[inside] / max(int(inside.sum()), 1)
    norm = np.sqrt(np.diag(together))
    correlation = np.clip(together / np.outer(norm, norm), -0.95, 0.95)
    correlation[np.diag_indices(len(std))] = 1.0
    return np.asarray(correlation * np.outer(std, std))


MARGIN_LEVEL = Measurement(
    "margin_level",
    title="level of overscan and masked pixels",
    order=192,
    axis="time",
    unit="min",
    make=measure_margin_level,
    quantity="mean level, DN",
    is_level=True,
    conditions="place",
)
