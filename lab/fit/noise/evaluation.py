"""The evaluation of the levels: which serve the lines, what their means scatter, and the state that this leaves for all
figures."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from lab.errors import NotDetermined
from lab.fit.noise.photon_transfer import TransferFit, fit_transfer
from lab.formats.recording_set import DataSheet
from lab.formats.results import InconsistentLevel
from lab.measure.level_lines import (
    CLIPPED_LIMIT,
    DarkSignal,
    RobustResponse,
    Saturation,
    dark_lines,
    refuse_light_darks,
    robust_response,
    saturation_of,
)
from lab.measure.levels import LEAST_REACH, MeasuredLevel, RecordedLevels, Remarks
from lab.measure.rounding import QUANTISATION_DN2

# --- level consistency ---------------------------------------------------------------------------------------------
# Which flats serve the lines of responsivity, linearity and gain: the level series without what contradicts it.
#
# A level whose stated light (photon number or exposure) contradicts the others is left out of the lines and named. So
# is a spatial stack, of which EMVA 1288 asks for many images at one level: it serves PRNU and DSNU.


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
    found: dict[int, InconsistentLevel] = {}
    scatter, noise, judged = 0.0, 0.0, 0
    for lamp in dict.fromkeys(level.lamp for level in recorded.flats):
        own = [level for level in recorded.flats if level.lamp == lamp]
        laws = _laws(own, [level.light for level in own], recorded, dark, saturation)
        if not laws:
            continue
        if len(own) > judged:
            scatter = float(np.mean([law.scatter for law in laws.values()]))
            noise, judged = float(np.mean([law.noise for law in laws.values()])), len(own)
        votes = np.mean([law.outlier for law in laws.values()], axis=0) >= 0.5
        for number in np.flatnonzero(votes):
            level = own[number]
            found[id(level)] = _described(level, int(number), laws, recorded, dark, lamp)
            sources = _source(own, int(number), recorded, dark, saturation)
            remarks.add(_sentence(found[id(level)], sources))
    rest = [level for level in recorded.flats if id(level) not in found]
    median = float(np.median([level.repeats for level in recorded.flats]))
    series = [level for level in rest if level.repeats < STACK_REPEATS * median]
    if len({level.light for level in series}) < LEAST_SERIES:
        series = rest
    kept = set(map(id, series))
    return LevelConsistency(
        tuple(series),
        tuple(level for level in rest if id(level) not in kept),
        tuple(found.values()),
        scatter,
        noise,
    )


def _laws(
    own: Sequence[MeasuredLevel],
    light: Sequence[float],
    recorded: RecordedLevels,
    dark: DarkSignal,
    saturation: Saturation,
) -> dict[str, RobustResponse]:
    """Response of each plane to `light` (levels,)."""
    places = {id(level): number for number, level in enumerate(recorded.flats)}
    found = {}
    for name in recorded.names:
        signal = np.array([level.plane[name].mean - dark.mean_dn(name, level.exposure_s) for level in own])
        noise = np.array([level.plane[name].mean_std for level in own])
        noise = np.where(np.isfinite(noise), noise, np.nanmax(noise, initial=0.0))
        clipped = np.array([saturation.clipped[name][places[id(level)]] for level in own])
        std = np.maximum(np.hypot(noise, _dark_scatter_dn(recorded, dark, name)), 1e-6 * saturation.signal_dn[name])
        law = robust_response(
            np.array(light), signal, std, saturation.signal_dn[name], clipped, np.random.default_rng(SEED)
        )
        if law is not None:
            found[name] = law
    return found


def _dark_scatter_dn(recorded: RecordedLevels, dark: DarkSignal, name: str) -> float:
    """Standard deviation of dark means about their line, DN: each flat has its own dark subtracted."""
    if len(recorded.darks) < 4:
        return 0.0
    line = dark.lines[name]
    rest = [level.plane[name].mean - line.at(level.exposure_s) for level in recorded.darks]
    return float(np.sqrt(np.sum(np.square(rest)) / (len(rest) - 2)))


def _described(
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
    own: Sequence[MeasuredLevel], number: int, recorded: RecordedLevels, dark: DarkSignal, saturation: Saturation
) -> str:
    """Return what the exposure says where the light is a number of photons of its own."""
    level = own[number]
    if level.light == level.exposure_s:
        return "either the exposure or the frames are of another level"
    exposures = [each.exposure_s for each in own]
    if len(set(exposures)) < LEAST_SERIES:
        return "either the photon number or the frames are of another level"
    laws = _laws(own, exposures, recorded, dark, saturation)
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


# --- lamp drift ----------------------------------------------------------------------------------------------------
# Drift of the lamp between the repeats of a level.


DRIFT_CHANCE = 1e-4  # probability below which differences of repeats are a drift


@dataclass(frozen=True)
class LampDrift:
    """Differences of the means of repeats from that of their level.

    `relative`: standard deviation beyond noise, relative to the signal; 0 where noise explains it. `std_dn`: standard
    deviation; `noise_dn`: that by noise.
    """

    relative: float
    std_dn: float
    noise_dn: float


def lamp_drift(recorded: RecordedLevels, dark: DarkSignal, saturation: Saturation) -> LampDrift:
    """Differences of the means of repeated flats, over all unsaturated levels and planes."""
    relative, square, expected, chi2, freedom = 0.0, 0.0, 0.0, 0.0, 0
    for level in recorded.flats:
        own = [n for n in recorded.names if not saturation.clipped[n][recorded.flats.index(level)]]
        if level.repeats < 2 or not own:
            continue
        planes = [level.plane[n] for n in own]
        pixels = np.array([plane.pixels for plane in planes], float)
        frames = np.average([plane.frame_means for plane in planes], axis=0, weights=pixels)
        variance = float(np.average([plane.temporal_variance for plane in planes], weights=pixels))
        rounding = max(plane.mean_rounding_std for plane in planes)
        noise = max(variance, QUANTISATION_DN2) / pixels.sum() + rounding**2
        signal = float(
            np.average([p.mean - dark.lines[n].black for p, n in zip(planes, own, strict=True)], weights=pixels)
        )
        rest = float(np.sum((frames - frames.mean()) ** 2))
        square += rest
        expected += noise * (len(frames) - 1)
        chi2 += rest / noise
        relative += (rest - noise * (len(frames) - 1)) / max(signal, 1.0) ** 2
        freedom += len(frames) - 1
    if freedom == 0:
        return LampDrift(0.0, 0.0, 0.0)
    chance = float(special.chdtrc(freedom, chi2))
    if chance > DRIFT_CHANCE or relative <= 0:
        relative = 0.0
    return LampDrift(
        float(np.sqrt(relative / freedom)), float(np.sqrt(square / freedom)), float(np.sqrt(expected / freedom))
    )


# --- evaluation ----------------------------------------------------------------------------------------------------
# The state of a noise fit once its photon transfer is solved: what all figures rest on.


MIN_LEVELS = 3


@dataclass(frozen=True)
class Evaluation:
    """One photon transfer and what it rests on; `points` are its (level, plane), in the order of `transfer.used`."""

    levels: RecordedLevels
    dark: DarkSignal
    saturation: Saturation
    consistency: LevelConsistency
    transfer: TransferFit
    points: list[tuple[MeasuredLevel, str]]
    remarks: Remarks

    @cached_property
    def plane_index(self) -> dict[str, int]:
        """Index of each plane in `transfer.floor`."""
        present = {name for _, name in self.points}
        return {name: index for index, name in enumerate(name for name in self.levels.names if name in present)}

    @cached_property
    def drift(self) -> LampDrift:
        """Drift of the lamp between repeats."""
        return lamp_drift(self.levels, self.dark, self.saturation)

    @cached_property
    def dark_drift_dn(self) -> float:
        """Standard deviation of the means of repeated dark frames about that of their level, DN."""
        rests = [
            np.array(level.plane[name].frame_means) - level.plane[name].mean
            for level in self.levels.darks
            for name in self.levels.names
            if level.repeats > 1
        ]
        freedom = sum(rest.size - 1 for rest in rests)
        return float(np.sqrt(sum(float(rest @ rest) for rest in rests) / freedom)) if freedom else 0.0

    @cached_property
    def reach(self) -> float:
        """Highest level of the photon transfer, as a share of saturation."""
        return max(
            (
                (level.plane[name].mean - self.dark.lines[name].black) / self.saturation.signal_dn[name]
                for (level, name), used in zip(self.points, self.transfer.used, strict=True)
                if used and level.lamp != "dark"
            ),
            default=0.0,
        )

    @property
    def reaches_saturation(self) -> bool:
        """Whether figures at saturation can be given (`LEAST_REACH`)."""
        return self.reach >= LEAST_REACH

    @property
    def light_scatter(self) -> float:
        """Relative standard deviation of a level's mean beyond noise: between its repeats, or about a smooth
        response."""
        return max(self.drift.relative, self.consistency.scatter)


def evaluate(
    darks: Sequence[MeasuredLevel],
    flats: Sequence[MeasuredLevel],
    camera: DataSheet,
    gain_db: float,
    defects: int,
    names: tuple[str, ...],
) -> Evaluation:
    """Solve the photon transfer of the planes `names`. Raises `NotDetermined` where the levels don't determine it."""
    remarks = Remarks()
    recorded = RecordedLevels.of(darks, flats, camera, gain_db, defects, names, remarks)
    dark = DarkSignal(recorded.darks, dark_lines(recorded, remarks))
    refuse_light_darks(recorded, dark)
    saturation = saturation_of(recorded, dark)
    consistency = level_consistency(recorded, dark, saturation, remarks)
    transfer, points = transfer_of(recorded, dark, saturation, recorded.darks, consistency.series)
    evaluation = Evaluation(recorded, dark, saturation, consistency, transfer, points, remarks)
    _remark_on_transfer(evaluation)
    return evaluation


def transfer_of(
    recorded: RecordedLevels,
    dark: DarkSignal,
    saturation: Saturation,
    darks: Sequence[MeasuredLevel],
    series: Sequence[MeasuredLevel],
) -> tuple[TransferFit, list[tuple[MeasuredLevel, str]]]:
    """Photon transfer of `darks` and the unsaturated flats with repeats of the `series`, and its points (level, plane).

    Raises `NotDetermined` where fewer than three unsaturated flat levels have repeats, or where the variance doesn't
    grow with the signal.
    """
    points: list[tuple[MeasuredLevel, str]] = []
    x, v, s, plane, light = [], [], [], [], []
    for level in (*darks, *series):
        bright = level.lamp != "dark"
        for index, name in enumerate(recorded.names):
            own = level.plane[name]
            if own.repeats < 2 or own.temporal_variance <= 0:
                continue
            if bright and (saturation.clipped[name][recorded.flats.index(level)] or own.zero_share > CLIPPED_LIMIT):
                continue
            points.append((level, name))
            x.append(own.mean - dark.lines[name].black)
            v.append(own.temporal_variance)
            s.append(own.temporal_variance_std)
            plane.append(index)
            light.append(bright)
    bright_levels = {level.light for level, _ in points if level.lamp != "dark"}
    if len(bright_levels) < MIN_LEVELS:
        repeated = sum(level.repeats > 1 for level in recorded.flats)
        alike = [
            level
            for level in recorded.flats
            if level.repeats > 1 and all(level.plane[name].temporal_variance == 0 for name in recorded.names)
        ]
        if len(alike) == repeated > 0:
            raise NotDetermined(
                "noise",
                f"the repeats of all {repeated} flat levels are alike, pixel by pixel: give frames that were captured "
                "one by one, not "
                "copies, or raise the gain until noise shows",
            )
        raise NotDetermined(
            "noise",
            f"{len(bright_levels)} unsaturated flat levels with repeats (of {len(recorded.flats)} levels, {repeated} "
            "with repeats), "
            f"{MIN_LEVELS} needed: capture two frames or more at each of several exposures below saturation",
        )
    # Planes without points (all flats clip, no darks) have no floor
    present = sorted(set(plane))
    compact = np.searchsorted(present, plane)
    transfer = fit_transfer(
        np.array(x), np.array(v), np.array(s), compact, np.array(light), max(saturation.signal_dn.values())
    )
    if transfer.gain <= 0 or transfer.gain < 3.0 * transfer.gain_std:
        raise NotDetermined(
            "noise",
            "the temporal variance doesn't grow with the signal: capture repeats of flats that are steady and "
            "unprocessed",
        )
    return transfer, points


def _remark_on_transfer(e: Evaluation) -> None:
    """Report an error of the model, a straight line taken for the gain, and a significant curvature."""
    t = e.transfer
    if t.model_error > 0:
        e.remarks.add(
            f"the variances of the flats depart from their curve by {100 * t.model_error:.2g} % (rms) beyond what "
            "sampling explains "
            "(an uneven converter does that): it is in the uncertainties"
        )
    share = 1.0 if e.reaches_saturation else e.reach
    at = "at saturation" if e.reaches_saturation else f"at the highest level, {100 * e.reach:.2g} % of saturation"
    bend, bend_std = 100 * share * t.relative_curvature, 100 * share * t.relative_curvature_std
    if not e.reaches_saturation:
        e.remarks.add(
            f"the highest level of the photon transfer is {100 * e.reach:.2g} % of saturation, "
            f"{100 * LEAST_REACH:.0f} % are needed: curvatures at "
            "saturation aren't given; expose longer, or correct bit_depth or white_level_dn"
        )
    if t.by_line:
        e.remarks.add(
            f"the bend of the variances ({bend:+.1f} +- {bend_std:.1f} % {at}) isn't "
            "significant against that: the conversion gain is EMVA's straight line to 70 % of saturation; at zero "
            "signal "
            f"the curve has {t.curve_gain:.4g} +- {t.curve_gain_std:.2g} DN/e"
        )
    elif abs(t.relative_curvature) > 4.0 * t.relative_curvature_std:
        e.remarks.add(
            f"the variance bends by {bend:+.1f} +- {bend_std:.1f} % of its line {at} "
            "(nonlinear response or brighter-fatter); the conversion gain is that at zero signal"
        )


def in_electrons(e: Evaluation, value: float, std: float) -> tuple[float, float]:
    """Return a `value` in DN with its standard deviation in electrons, with that of the gain."""
    gain = e.transfer.gain
    return value / gain, float(np.hypot(std / gain, value * e.transfer.gain_std / gain**2))
