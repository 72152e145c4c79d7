"""The evaluation of the levels: the photon transfer of those that serve it, and the state that this leaves for all
figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lab.errors import NotDetermined
from lab.fit.noise.consistency import LevelConsistency, level_consistency
from lab.fit.noise.lamp_drift import LampDrift, lamp_drift
from lab.fit.noise.transfer import TransferFit, fit_transfer
from lab.formats.recording_set import DataSheet
from lab.observables.flats.level_lines import (
    CLIPPED_LIMIT,
    DarkSignal,
    Saturation,
    dark_lines,
    refuse_light_darks,
    saturation_of,
)
from lab.observables.noise.levels import LEAST_REACH, MeasuredLevel, RecordedLevels, Remarks

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
        return self.dark_scatter_dn(self.levels.darks)

    def dark_scatter_dn(self, darks: Sequence[MeasuredLevel]) -> float:
        """Return the standard deviation of the means of repeated frames of `darks` about that of their level, DN."""
        rests = [
            np.array(level.plane[name].frame_means) - level.plane[name].mean
            for level in darks
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
    # the mean of repeats that drift isn't that of the charge behind their variance
    steady = tuple(level for level in recorded.darks if level.drift is None)
    transfer, points = transfer_of(recorded, dark, saturation, steady or recorded.darks, consistency.series)
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
    """Fit the photon transfer of `darks` and the unsaturated flats with repeats of the `series`, and its points (level,
    plane).

    Raises `NotDetermined` where fewer than three unsaturated flat levels have repeats, or where the variance doesn't
    grow with the signal.
    """
    points: list[tuple[MeasuredLevel, str]] = []
    x, v, s, plane, light = [], [], [], [], []
    for level in (*darks, *series):
        bright = level.lamp != "dark"
        for index, name in enumerate(recorded.names):
            measured = level.plane[name]
            if measured.repeats < 2 or measured.temporal_variance <= 0:
                continue
            if bright and (
                saturation.clipped[name][recorded.flats.index(level)] or measured.zero_share > CLIPPED_LIMIT
            ):
                continue
            points.append((level, name))
            x.append(measured.mean - dark.lines[name].black)
            v.append(recorded.pixel_variance_dn2(level, name))
            s.append(measured.temporal_variance_std)
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


def _remark_on_transfer(evaluation: Evaluation) -> None:
    """Report an error of the model, a straight line taken for the gain, and a significant curvature."""
    t = evaluation.transfer
    if t.model_error > 0:
        evaluation.remarks.add(
            f"the variances of the flats depart from their curve by {100 * t.model_error:.2g} % (rms) beyond what "
            "sampling explains "
            "(an uneven converter does that): it is in the uncertainties"
        )
    share = 1.0 if evaluation.reaches_saturation else evaluation.reach
    at = (
        "at saturation"
        if evaluation.reaches_saturation
        else f"at the highest level, {100 * evaluation.reach:.2g} % of saturation"
    )
    bend, bend_std = 100 * share * t.relative_curvature, 100 * share * t.relative_curvature_std
    if not evaluation.reaches_saturation:
        evaluation.remarks.add(
            f"the highest level of the photon transfer is {100 * evaluation.reach:.2g} % of saturation, "
            f"{100 * LEAST_REACH:.0f} % are needed: curvatures at "
            "saturation aren't given; expose longer, or correct bit_depth or white_level_dn"
        )
    if t.by_line:
        evaluation.remarks.add(
            f"the bend of the variances ({bend:+.1f} +- {bend_std:.1f} % {at}) isn't "
            "significant against that: the conversion gain is EMVA's straight line to 70 % of saturation; at zero "
            "signal "
            f"the curve has {t.curve_gain:.4g} +- {t.curve_gain_std:.2g} DN/e"
        )
    elif abs(t.relative_curvature) > 4.0 * t.relative_curvature_std:
        evaluation.remarks.add(
            f"the variance bends by {bend:+.1f} +- {bend_std:.1f} % of its line {at} "
            "(nonlinear response or brighter-fatter); the conversion gain is that at zero signal"
        )


def in_electrons(evaluation: Evaluation, value: float, std: float) -> tuple[float, float]:
    """Return a `value` in DN with its standard deviation in electrons, with that of the gain."""
    gain = evaluation.transfer.gain
    return value / gain, float(np.hypot(std / gain, value * evaluation.transfer.gain_std / gain**2))
