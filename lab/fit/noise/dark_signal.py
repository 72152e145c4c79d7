"""The dark signal: means of darks against exposure, and the black level where there are none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.errors import NotDetermined
from lab.fit.noise.level_statistics import MeasuredLevel
from lab.fit.noise.recorded_levels import RecordedLevels, Remarks
from lab.fit.rounding import QUANTISATION_DN2
from lab.fit.weighted_lines import DarkLine, chi2_factor, dark_line
from sim.spectrum import FloatArray

DARKER_SHARE = 0.01  # of the range that a flat may lie below the darks; noise and drift are far less


@dataclass(frozen=True)
class DarkSignal:
    """Dark means, DN: `lines` by plane and (None) over all planes, and the darks that they rest on."""

    darks: tuple[MeasuredLevel, ...]
    lines: dict[str | None, DarkLine]

    def mean_dn(self, name: str, exposure_s: float) -> float:
        """Mean of a dark frame of a plane: of the darks of that exposure where there are any, else by the line."""
        own = self._own(exposure_s)
        return own.plane[name].mean if own is not None else self.lines[name].at(exposure_s)

    def mean_covariance_dn2(self, name: str, exposures_s: Sequence[float]) -> FloatArray:
        """Covariance of `mean_dn` at several exposures (n, n): those of one dark share its error, those of the line its
        covariance.
        """
        own = [self._own(exposure_s) for exposure_s in exposures_s]
        on_line = np.array([level is None for level in own], float)
        gradient = on_line[:, None] * np.stack([np.ones(len(own)), np.array(exposures_s)], axis=1)
        found = gradient @ self.lines[name].covariance @ gradient.T
        for level in {id(level): level for level in own if level is not None}.values():
            shared = np.array([each is level for each in own], float)
            std = level.plane[name].mean_std
            found += np.outer(shared, shared) * (std**2 if np.isfinite(std) else 0.0)
        return np.asarray(found)

    def _own(self, exposure_s: float) -> MeasuredLevel | None:
        """Darks of that exposure, the first where there are several."""
        alike = (level for level in self.darks if abs(level.exposure_s - exposure_s) <= 1e-6 * exposure_s)
        return next(alike, None)


def mean_and_std(levels: Sequence[MeasuredLevel], names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Mean of each level over the planes `names`, DN, and its standard deviation: by temporal noise and rounding,
    increased where repeats differ by more.
    """
    means, stds, rounding, excess, freedom = [], [], [], 0.0, 0
    for level in levels:
        own = [level.plane[n] for n in names]
        pixels = np.array([plane.pixels for plane in own])
        rounding.append(max(plane.mean_rounding_std for plane in own))  # the errors of the planes are correlated
        frames = np.average([plane.frame_means for plane in own], axis=0, weights=pixels)
        variance = np.average([plane.temporal_variance for plane in own], weights=pixels)
        noise = max(float(variance), QUANTISATION_DN2) if np.isfinite(variance) else float("nan")
        means.append(float(frames.mean()))
        stds.append(np.sqrt(noise / pixels.sum()))
        if len(frames) > 1:
            excess += float(np.sum((frames - frames.mean()) ** 2) / stds[-1] ** 2)
            freedom += len(frames) - 1
    known = np.array(stds)
    if np.isnan(known).any():
        known = np.where(np.isnan(known), np.nanmax(known) if np.isfinite(known).any() else 1.0, known)
    frame_std = known * np.sqrt(chi2_factor(excess, freedom))
    return np.array(means), np.hypot(frame_std / np.sqrt([level.repeats for level in levels]), rounding)


def dark_lines(recorded: RecordedLevels, remarks: Remarks) -> dict[str | None, DarkLine]:
    """Dark mean against exposure, by plane and (None) over all planes.

    Without darks the stated black level stands for it. Raises `NotDetermined` where there is none either.
    """
    if recorded.darks:
        exposure = np.array([level.exposure_s for level in recorded.darks])
        planes = {None: recorded.names} | {name: (name,) for name in recorded.names}
        return {name: dark_line(exposure, *mean_and_std(recorded.darks, own)) for name, own in planes.items()}
    black = _black_without_darks(recorded, remarks)
    return dict.fromkeys((None, *recorded.names), DarkLine(black, 0.0, np.zeros((2, 2))))


def _black_without_darks(recorded: RecordedLevels, remarks: Remarks) -> float:
    """The stated black level, DN."""
    if not recorded.black_clipped:
        remarks.add(
            "no darks: read noise, dark current and DSNU aren't determined; capture darks at two exposures or more"
        )
    if recorded.camera.black_level_dn is not None:
        return recorded.camera.black_level_dn
    if recorded.black_clipped:
        return 0.0
    raise NotDetermined("noise", "neither darks nor a stated black level: capture darks at the flats' exposures")


def refuse_light_darks(recorded: RecordedLevels, dark: DarkSignal) -> None:
    """Raise `NotDetermined` where flats are darker than darks: light reached these, or they are of other settings."""
    for level in recorded.flats if recorded.darks else ():
        for name in recorded.names:
            expected = dark.lines[name].at(level.exposure_s)
            short = expected - level.plane[name].mean
            if short > max(DARKER_SHARE * (recorded.white_dn - expected), 1.0):
                raise NotDetermined(
                    "noise",
                    f"a flat of {level.exposure_s:g} s has {level.plane[name].mean:.0f} DN and is darker than darks of as long, {expected:.0f} DN: "
                    "darks and flats may be stated for each other: exchange them, or capture the darks again, with the cap on and at the flats' "
                    "settings",
                )
