"""Which flats serve the lines of responsivity, linearity and gain: the level series without what contradicts it.

A level whose stated light (photon number or exposure) contradicts the others is left out of the lines and reported. So
is a spatial stack, of which EMVA 1288 asks for many images at one level: it is used for PRNU and DSNU.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from lab.formats.results import InconsistentLevel
from lab.observables.flats.level_lines import (
    DarkSignal,
    RobustResponse,
    Saturation,
    robust_response,
)
from lab.observables.noise.levels import MeasuredLevel, RecordedLevels, Remarks

STACK_REPEATS = 4  # times the median number of repeats, from which a level is a spatial stack
LEAST_SERIES = 5  # levels that have to remain where the stacks are left out
SEED = 1288  # of the subsets of levels that the robust fit draws


@dataclass(frozen=True)
class LevelConsistency:
    """Flats by what they serve. `inconsistent`: their stated light contradicts the others; `stacks`: spatial stacks;
    `series`: the rest. `scatter`: relative standard deviation of the levels of the main lamp about a smooth response
    beyond noise, 0 where noise explains it; `noise`: their relative rms by noise.
    """

    series: tuple[MeasuredLevel, ...]
    stacks: tuple[MeasuredLevel, ...]
    inconsistent: tuple[InconsistentLevel, ...]
    scatter: float
    noise: float


def level_consistency(
    recorded: RecordedLevels, dark: DarkSignal, saturation: Saturation, remarks: Remarks
) -> LevelConsistency:
    """Judge the flats of each lamp against each other, and report those that contradict the others."""
    inconsistent: dict[int, InconsistentLevel] = {}
    scatter, noise, judged = 0.0, 0.0, 0
    for lamp in dict.fromkeys(level.lamp for level in recorded.flats):
        lamp_levels = [level for level in recorded.flats if level.lamp == lamp]
        laws = _laws(lamp_levels, [level.light for level in lamp_levels], recorded, dark, saturation)
        if not laws:
            continue
        if len(lamp_levels) > judged:
            scatter = float(np.mean([law.scatter for law in laws.values()]))
            noise, judged = float(np.mean([law.noise for law in laws.values()])), len(lamp_levels)
        votes = np.mean([law.outlier for law in laws.values()], axis=0) >= 0.5
        for number in np.flatnonzero(votes):
            level = lamp_levels[number]
            inconsistent[id(level)] = _describe(level, int(number), laws, recorded, dark, lamp)
            sources = _source(lamp_levels, int(number), recorded, dark, saturation)
            remarks.add(_sentence(inconsistent[id(level)], sources))
    rest = [level for level in recorded.flats if id(level) not in inconsistent]
    median = float(np.median([level.repeats for level in recorded.flats]))
    series = [level for level in rest if level.repeats < STACK_REPEATS * median]
    if len({level.light for level in series}) < LEAST_SERIES:
        series = rest
    kept = set(map(id, series))
    return LevelConsistency(
        tuple(series),
        tuple(level for level in rest if id(level) not in kept),
        tuple(inconsistent.values()),
        scatter,
        noise,
    )


def _laws(
    levels: Sequence[MeasuredLevel],
    light: Sequence[float],
    recorded: RecordedLevels,
    dark: DarkSignal,
    saturation: Saturation,
) -> dict[str, RobustResponse]:
    """Response of each plane to `light` (levels,)."""
    places = {id(level): number for number, level in enumerate(recorded.flats)}
    laws = {}
    for name in recorded.names:
        signal = np.array([level.plane[name].mean - dark.mean_dn(name, level.exposure_s) for level in levels])
        noise = np.array([level.plane[name].mean_std for level in levels])
        noise = np.where(np.isfinite(noise), noise, np.nanmax(noise, initial=0.0))
        clipped = np.array([saturation.clipped[name][places[id(level)]] for level in levels])
        std = np.maximum(np.hypot(noise, _dark_scatter_dn(recorded, dark, name)), 1e-6 * saturation.signal_dn[name])
        law = robust_response(
            np.array(light), signal, std, saturation.signal_dn[name], clipped, np.random.default_rng(SEED)
        )
        if law is not None:
            laws[name] = law
    return laws


def _dark_scatter_dn(recorded: RecordedLevels, dark: DarkSignal, name: str) -> float:
    """Standard deviation of dark means about their line, DN: each flat has its own dark subtracted."""
    steady = [level for level in recorded.darks if level.drift is None]
    if len(steady) < 4:
        return 0.0
    line = dark.lines[name]
    rest = [level.plane[name].mean - line.at(level.exposure_s) for level in steady]
    return float(np.sqrt(np.sum(np.square(rest)) / (len(rest) - 2)))


def _describe(
    level: MeasuredLevel,
    number: int,
    laws: dict[str, RobustResponse],
    recorded: RecordedLevels,
    dark: DarkSignal,
    lamp: Hashable,
) -> InconsistentLevel:
    signal = [level.plane[name].mean - dark.mean_dn(name, level.exposure_s) for name in laws]
    photons = isinstance(lamp, tuple) and len(lamp) > 1 and bool(lamp[1])
    return InconsistentLevel(
        captures=level.captures,
        exposure_s=level.exposure_s,
        light=level.light,
        light_unit="photons" if photons else "s",
        expected_light=float(np.median([law.expected_light[number] for law in laws.values()])),
        signal_dn=float(np.mean(signal)),
        expected_signal_dn=float(np.mean([law.expected_signal[number] for law in laws.values()])),
    )


def _source(
    levels: Sequence[MeasuredLevel], number: int, recorded: RecordedLevels, dark: DarkSignal, saturation: Saturation
) -> str:
    """Return what the exposure says where the light is a number of photons of its own."""
    level = levels[number]
    if level.light == level.exposure_s:
        return "either the exposure or the frames are of another level"
    exposures = [each.exposure_s for each in levels]
    if len(set(exposures)) < LEAST_SERIES:
        return "either the photon number or the frames are of another level"
    laws = _laws(levels, exposures, recorded, dark, saturation)
    if not laws:
        return "either the photon number or the frames are of another level"
    if np.mean([law.outlier[number] for law in laws.values()]) >= 0.5:
        return "its exposure contradicts them too, so that the frames may be of another level"
    return "its exposure agrees with them, so that the photon number is wrong"


def _sentence(level: InconsistentLevel, source: str) -> str:
    unit = "photons" if level.light_unit == "photons" else "s"
    named = ", ".join(level.captures[:1]) + (f" .. {level.captures[-1]}" if len(level.captures) > 1 else "")
    which = f"{len(level.captures)} captures {named}" if level.captures else f"exposure {level.exposure_s:g} s"
    return (
        f"one level contradicts the others and is left out of responsivity, linearity and gain: {which}, stated "
        f"{level.light:.6g} {unit}, "
        f"has {level.signal_dn:.4g} DN above dark, where the others have {level.expected_signal_dn:.4g} DN; they have "
        "its signal at "
        f"{level.expected_light:.6g} {unit}; {source}: correct it"
    )
