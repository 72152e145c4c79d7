"""Even patches of known relative luminance in one plane of the mosaic: levels of flats, or neutral patches of a chart.

Both ISO 14524 (OECF) and ISO 15739 (noise) read them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.formats.results.standards import Deviation
from lab.formats.results.words import format_value
from lab.observables.flats.stated_light import light_of
from lab.observables.noise.levels import MeasuredLevel
from lab.observables.noise.stack import PlaneStatistics
from lab.standards.standard import MeasuredSide
from sim.spectrum import FloatArray

LEAST_LEVELS = 4
#: Largest nonuniformity of the light over the patch that is read.
LARGEST_SPAN_PERCENT = 2.0


@dataclass(frozen=True)
class ToneSteps:
    """Levels of one plane in ascending light, (n,) each, and the dark.

    `exposure`: focal-plane exposure, photons a pixel or in units of the lamp's light in a second; `signal`,
    `signal_std`: DN above the dark; `temporal`, `fixed`: variances, DN^2, with their standard deviations; `dark`: the
    dark of most repeats; `frames`: images of a level, the fewest; `highest_dn`: largest signal of the plane.
    """

    plane: str
    exposure: FloatArray
    exposure_unit: str
    signal: FloatArray
    signal_std: FloatArray
    temporal: FloatArray
    temporal_std: FloatArray
    fixed: FloatArray
    fixed_std: FloatArray
    dark: PlaneStatistics
    frames: int
    span_percent: float
    span_percent_std: float

    @property
    def gain(self) -> tuple[FloatArray, FloatArray]:
        """Incremental gain at each level (n,), DN per unit of exposure, and its standard deviation: slope of the
        parabola through a level and its neighbours."""
        weights = slope_weights(self.exposure)
        return weights @ self.signal, np.sqrt(weights**2 @ self.signal_std**2)

    def unevenness(self, clause: str) -> Iterator[Deviation]:
        """Yield the deviation of light that is uneven by more than `LARGEST_SPAN_PERCENT`, two standard deviations
        allowed for."""
        if self.span_percent - 2.0 * self.span_percent_std > LARGEST_SPAN_PERCENT:
            yield Deviation(
                clause=clause,
                quantity="nonuniformity of the light (highest less lowest over the mean)",
                found=format_value(self.span_percent, self.span_percent_std, "%"),
                limit=f"{LARGEST_SPAN_PERCENT:g} % at most",
                remedy="light the sensor evenly, or read a smaller part of the frame",
            )


def slope_weights(x: FloatArray) -> FloatArray:
    """Return the weights (n, n) of values at `x` (n,), three or more, in the slope at each: that of the parabola
    through a point and its two neighbours."""
    n = x.size
    covariance = np.zeros((n, n))
    for k in range(n):
        at = np.arange(3) + min(max(k - 1, 0), n - 3)
        apart = x[at] - x[k]
        # derivative at 0 of the Lagrange polynomials of three nodes
        for i in range(3):
            others = np.delete(apart, i)
            covariance[k, at[i]] = -(others[0] + others[1]) / np.prod(apart[i] - others)
    return covariance


@dataclass(frozen=True)
class LevelSeries:
    """The series of most levels of one lamp: `amounts` (n,) of light in ascending order, `unit` and relative standard
    uncertainties of these, exposures (n,), statistics by plane of each level, and the darks in repeats."""

    amounts: FloatArray
    unit: str
    amount_std: FloatArray
    exposure_s: FloatArray
    stacks: list[dict[str, PlaneStatistics]]
    darks: list[MeasuredLevel]


def level_series(side: MeasuredSide, step: str) -> LevelSeries:
    """Return the longest series of flats, without levels whose stated light contradicts the others (`NoiseFit`).

    Raises NotDetermined of `step` with fewer than four levels or without darks, in repeats each."""
    data = side.dataset
    noise = side.fit.noise
    contradicting = {name for level in (noise.inconsistent_levels if noise else ()) for name in level.captures}
    groups = [
        group for group in data.flat_levels() if len(group) > 1 and not contradicting & {flat.id for flat in group}
    ]
    light = light_of([c for group in groups for c in group], side.camera)
    series: dict[object, dict[float, list[FlatCapture]]] = {}
    for group in groups:
        first = light[group[0].id]
        if first.amount <= 0:
            continue
        lamp = (first.lamp, data.lamps.get(group[0].radiance, -1), group[0].gain_db)
        kept = series.setdefault(lamp, {})
        if len(group) > len(kept.get(first.amount, ())):
            kept[first.amount] = group
    longest = max(series.values(), key=len, default={})
    darks = [level for level in data.darks.levels if level.repeats > 1]
    if len(longest) < LEAST_LEVELS or not darks:
        raise NotDetermined(
            step,
            f"{len(longest)} levels of one lamp and {len(darks)} of darks in repeats; capture four levels or more, and "
            "darks",
        )
    amounts = sorted(longest)
    heads = [longest[amount][0] for amount in amounts]
    return LevelSeries(
        amounts=np.array(amounts),
        unit=light[heads[0].id].unit,
        amount_std=np.array([light[capture.id].std for capture in heads]),
        exposure_s=np.array([capture.exposure_s for capture in heads]),
        stacks=[data.flat_statistics(longest[amount]) for amount in amounts],
        darks=darks,
    )


def repeated_mean_std(plane: PlaneStatistics) -> float:
    """Return the standard deviation of a level's mean, DN: by the noise of its pixels, or by the scatter of its
    repeats' means, where that is larger, as of a lamp that flickers."""
    scatter = float(np.std(plane.frame_means, ddof=1)) / float(np.sqrt(plane.repeats)) if plane.repeats > 1 else 0.0
    return max(plane.mean_std, scatter)


def tone_steps(side: MeasuredSide, step: str) -> list[ToneSteps]:
    """Return the levels of the longest series of flats by plane. Raises NotDetermined of `step` with fewer than four
    levels or without darks, in repeats each."""
    series = level_series(side, step)
    best = max(series.darks, key=lambda level: (level.repeats, -level.exposure_s))
    steps = []
    for name, dark in best.plane.items():
        planes = [stack[name] for stack in series.stacks]
        below = side.dataset.noise.dark_dn_per_s * (series.exposure_s - best.exposure_s) + dark.mean
        signal = np.array([plane.mean for plane in planes]) - below
        middle = planes[int(np.argmin(np.abs(signal - 0.5 * signal.max())))]
        span, span_std = middle.shading_span
        level = middle.mean_of_all - dark.mean_of_all
        steps.append(
            ToneSteps(
                plane=name,
                exposure=series.amounts,
                exposure_unit=series.unit,
                signal=signal,
                signal_std=np.sqrt(
                    np.array([repeated_mean_std(plane) for plane in planes]) ** 2
                    + dark.mean_std**2
                    + (series.amount_std * signal) ** 2
                ),
                temporal=np.array([plane.temporal_variance for plane in planes]),
                temporal_std=np.array([plane.temporal_variance_std for plane in planes]),
                fixed=np.maximum([plane.pattern_variance for plane in planes], 0.0),
                fixed_std=np.array([plane.pattern_variance_std for plane in planes]),
                dark=dark,
                frames=min(plane.repeats for plane in planes),
                span_percent=100.0 * span / level,
                span_percent_std=100.0 * span_std / level,
            )
        )
    return steps
