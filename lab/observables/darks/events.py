"""Events in dark frames: groups of pixels that are bright in one of several repeats alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lab.errors import NotDetermined
from lab.observables.darks.defective_pixels import COUNT_STD, rooted_counts
from lab.observables.darks.frames import DarkStatistics, captures_of, dark_frames
from lab.observables.dataset import Dataset
from lab.observables.noise.robust import sampled
from lab.observables.observable import Label, Measurement, Observable, Prediction
from sim.effects.base import Effects
from sim.spectrum import FloatArray
from sim.uniform import Uniform

#: Least brightness of an event, in standard deviations of a pixel's temporal noise and in steps of the codes.
BRIGHT, LEAST_STEPS = 12.0, 6.0
#: Lower edges of the bins of brightness, over the least.
EVENT_EDGES = 1.0, 3.0, 10.0, 30.0
LEAST_FRAMES = 3  # repeats: of two, that without the event isn't known
MOST_FRAMES, MOST_PIXELS = 12, 24e6  # of a condition; they are compared in memory
#: Eight neighbours make one event.
TOUCHING = np.ones((3, 3), bool)


@dataclass(frozen=True)
class _Events:
    """Events of one condition's frames, seen or held out: `counts` by bins of brightness."""

    dark: DarkStatistics
    held_out: bool
    frames: int  # in which they were counted
    repeats: int  # that each of these was compared with, itself included
    edges_dn: FloatArray
    counts: FloatArray


def count_events(dataset: Dataset) -> list[_Events]:
    """Return the events of all conditions of `LEAST_FRAMES` dark frames and more.

    A pixel is hit in a frame where it exceeds its value in every other one by `BRIGHT` standard deviations of its
    noise, shot noise of a hot pixel included, and by `LEAST_STEPS` steps of the codes. Neighbouring hit pixels are one
    event, as bright as its brightest.
    """
    found: list[_Events] = []
    for dark in dataset.once(dark_frames):
        size = dataset.camera.rows * dataset.camera.cols
        most = max(min(MOST_FRAMES, int(MOST_PIXELS / size)), LEAST_FRAMES)
        captures = dark.condition.captures[:most]
        moving = next((part.pixel_dn2 for part in dark.changing.values()), None)
        if len(captures) < LEAST_FRAMES or moving is None:
            continue
        frames = np.array([dataset.recordings.frame(c) for c in captures], np.float32)
        frames -= np.array([np.median(sampled(frame)) for frame in frames], np.float32)[:, None, None]
        highest, second = np.maximum(frames[0], frames[1]), np.minimum(frames[0], frames[1])
        for frame in frames[2:]:
            second = np.maximum(second, np.minimum(highest, frame))
            highest = np.maximum(highest, frame)
        # few pixels exceed what the least noise asks for: the median of the others isn't needed
        lowest = max(BRIGHT * float(np.sqrt(moving)), LEAST_STEPS * dataset.step_dn)
        row, col = np.nonzero(highest - second > lowest)
        usual = np.asarray(np.median(frames[:, row, col], axis=0), float)
        hit = highest[row, col] - second[row, col] > _least_dn(dataset, moving, usual)
        row, col, usual = row[hit], col[hit], usual[hit]
        typical = np.median(np.array([sampled(frame) for frame in frames]), axis=0)
        edges = float(np.median(_least_dn(dataset, moving, typical))) * np.array(EVENT_EDGES)
        counts = {True: np.zeros(len(edges)), False: np.zeros(len(edges))}
        seen = len(dark.condition.seen)
        for k, frame in enumerate(frames):
            own = frame[row, col] == highest[row, col]
            if own.any():
                bright = np.zeros(frame.shape, np.float32)
                bright[row[own], col[own]] = (frame[row, col] - usual)[own]
                label, number = ndimage.label(bright, TOUCHING)
                brightest = ndimage.maximum(bright, label, np.arange(1, number + 1))
                counts[k >= seen] += np.histogram(brightest, [*edges, np.inf])[0]
        numbers = {False: min(seen, len(captures)), True: max(len(captures) - seen, 0)}
        found += [
            _Events(dark, out, number, len(captures), edges, counts[out]) for out, number in numbers.items() if number
        ]
    return found


def _least_dn(dataset: Dataset, variance_dn2: float, usual_dn: FloatArray) -> FloatArray:
    """Return the least brightness of an event at pixels (n,) of a usual value, with the shot noise of that value."""
    std = np.sqrt(variance_dn2 + dataset.noise.gain * np.maximum(usual_dn, 0.0))
    return np.maximum(BRIGHT * std, LEAST_STEPS * dataset.step_dn)


def measure_dark_events(dataset: Dataset) -> Observable:
    """Anscombe-transformed numbers of events by brightness, by exposure. None are expected of normal noise; of
    telegraph noise those pixels that are at the higher level in one frame alone.

    Raises NotDetermined without `LEAST_FRAMES` repeats of a dark frame.
    """
    points = dataset.once(count_events)
    if not points:
        raise NotDetermined(
            "dark_events", f"fewer than {LEAST_FRAMES} dark frames of the same exposure and temperature"
        )
    pixels, pitch_um = dataset.camera.rows * dataset.camera.cols, dataset.camera.pixel_pitch_um
    value = rooted_counts(np.concatenate([p.counts for p in points]))

    def expected(effects: Effects) -> FloatArray:
        model = Uniform(dataset.camera, effects)
        found = []
        for p in points:
            number: FloatArray = np.zeros(len(p.edges_dn))
            for law in model.particles:
                events = law.expected_number(pixels, pitch_um, p.dark.condition.exposure_s) * p.frames
                bright = dataset.noise.gain * law.brightest_e(pitch_um)
                number = number + events * np.histogram(bright, [*p.edges_dn, np.inf])[0] / bright.size
            for jumps in model.telegraph:
                shares, distance_e = jumps.nodes()
                high = jumps.high_share
                alone = high * (1.0 - high) ** (p.repeats - 1)
                bins = np.histogram(dataset.noise.gain * distance_e, [*p.edges_dn, np.inf], weights=shares)[0]
                number = number + p.frames * pixels * alone * bins
            found.append(number)
        return np.concatenate(found)

    labels = tuple(
        Label(float(edge), "all", p.dark.condition.name, captures_of(p.dark, p.held_out), p.held_out)
        for p in points
        for edge in p.edges_dn
    )
    return Observable(
        measurement=DARK_EVENTS, reach=1.0, value=value,
        covariance=np.eye(len(value)) * (1.0 + COUNT_STD**2), labels=labels,
        reads=frozenset({"charge.particles", "signal.telegraph"}),
        predict=lambda effects: Prediction(rooted_counts(expected(effects)), {}),
        scale=np.full(len(value), 10.0), along=np.log([label.x for label in labels]),
    )  # fmt: skip


DARK_EVENTS = Measurement(
    "dark_events",
    title="events in single dark frames",
    order=198,
    axis="brightness",
    unit="DN",
    make=measure_dark_events,
    quantity="number of events, 2 sqrt(n + 3/8)",
    conditions="exposure and temperature",
)
