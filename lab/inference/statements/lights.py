"""Two lights under each other's captures: an exchange permutes predictions.

The level of a capture above the dark is in proportion to its exposure, which isn't exchanged: of the captures i and j,

    m'_i = d_i + (m_j - d_j) t_i / t_j,   d = b + r t the level of the dark"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import partial
from itertools import combinations

import numpy as np

from lab.formats.recording_set import RecordingSet
from lab.inference.statements.statement import AffineChange, Changes, Numbers, Restatement, Statement, Told, light_of
from lab.observables.charts.chart import CHART
from lab.observables.observable import Measurement
from lab.observables.spectra.narrowband import NARROWBAND
from sim.camera import Side
from sim.spectrum import FloatArray

#: Lights that there have to be.
LEAST_LIGHTS = 3
#: Rate, e/s, below which a level tells nothing of that in another light.
LEAST_RATE = 1e-3
#: What the improved model says of captures that aren't used.
LEFT_OUT = "the captures are left out"


def _restatements(numbers: Numbers) -> Sequence[Restatement]:
    found: list[Restatement] = []
    for measurement in (NARROWBAND, CHART):
        lights = list(dict.fromkeys(light_of(captures[0]) for _, _, captures in numbers.of(measurement)))
        if len(lights) < LEAST_LIGHTS:
            continue
        found += [
            Restatement(partial(_on, measurement, pair), partial(_told, measurement, pair), measurement=measurement)
            for pair in combinations(lights, 2)
        ]
    return found


def _on(measurement: Measurement, pair: tuple[Hashable, Hashable], numbers: Numbers) -> Changes:
    noise = numbers.model.noise
    assert noise is not None
    every = [(k, label, c[0]) for k, label, c in numbers.of(measurement) if light_of(c[0]) in pair]
    place = {} if measurement is NARROWBAND else {k: label.condition for k, label, _ in every}  # the patch
    rows = np.array([k for k, _, _ in every], int)
    found = {light_of(c): c for _, _, c in every}
    matrix, offset, spread = np.zeros((len(rows), len(rows))), np.zeros(len(rows)), np.zeros(len(rows))
    for i, (k, label, capture) in enumerate(every):
        own_s = float(capture.exposure_s or 0.0)
        there = [
            (j, float(c.exposure_s or 0.0))
            for j, (other, one, c) in enumerate(every)
            if light_of(c) != light_of(capture) and one.channel == label.channel and place.get(other) == place.get(k)
        ]
        if not there:  # it clips in the other light: by the ratio of the rates
            (wanted,) = (light for light in pair if light != light_of(capture))
            rates = [numbers.rate(c, label, label.channel) for c in (capture, found[wanted])]
            if rates[0] < LEAST_RATE:  # nor that: any level
                matrix[i, i], spread[i] = 1.0, max(abs(float(numbers.model.value[k])), 1.0)
                continue
            matrix[i, i] = rates[1] / rates[0]
            offset[i] = (1.0 - matrix[i, i]) * noise.black
            continue
        offset[i] = noise.black
        for j, other_s in there:
            share = own_s / other_s / len(there)
            matrix[i, j] += share
            offset[i] -= share * noise.black  # dark current grows with the exposure, as light does
    change = AffineChange(rows, matrix, offset, spread)
    return lambda u: change


def _told(
    measurement: Measurement, pair: tuple[Hashable, Hashable], recordings: RecordingSet, side: Side, u: FloatArray,
    std: FloatArray,
) -> Told:  # fmt: skip
    kind = "narrowband" if measurement is NARROWBAND else "chart"
    names = [f"{one:g} nm" if isinstance(one, float) else str(one) for one in pair]
    captures = [[c.id for c in recordings.captures(kind, side) if light_of(c) == one] for one in pair]
    of = [f"{own[0]}{' ..' if len(own) > 1 else ''}" for own in captures]
    every = tuple(name for own in captures for name in own)
    return Told(
        where=" and ".join(names),
        shape="two stated lights contradict their captures, and each fits the other's",
        check=f"The captures {of[0]} of the {side} camera, stated with {names[0]}, fit {names[1]}, and {of[1]}, stated "
        f"with {names[1]}, fit {names[0]}: they are left out; if they were exchanged, exchange the two lights, or the "
        "frames.",
        captures=every,
        corrected=recordings.without(set(every)),
        correction=LEFT_OUT,
    )


EXCHANGED_LIGHTS = Statement("exchanged_lights", (), _restatements)
