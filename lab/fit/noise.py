"""Noise by photon transfer: conversion gain, read noise, black level, dark current, DSNU, PRNU, saturation, linearity.

Definitions: EMVA Standard 1288, release 4.0 (linear). Where this departs from the letter of the standard:

- The conversion gain K is the slope of the temporal variance against the mean at zero signal, of v = v0 + K x + c x^2
  fitted to all unsaturated levels and planes at once, weighted by what the variances are worth. The curvature c takes up a
  nonlinear response and brighter-fatter, which bias the standard's straight line (to 70 % of saturation) by 1.5 times the
  curvature. Where the variances scatter about the curve far beyond their noise, the curvature isn't trusted: then K is the
  standard's straight line, and its uncertainty spans both.
- Frames are compared after their means have been taken out plane by plane, so that a lamp that drifts between repeats
  doesn't count as temporal noise.
- PRNU is of what is left after a smooth surface (polynomial, degree 6 in rows and in columns, plane by plane) has been taken
  out: the lens's cos^4 and a lamp's shading don't count. Pixels further out than 8 standard deviations are defects: left out,
  counted and said.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from lab.errors import NotDetermined
from lab.fit.levels import DEFECT_SIGMA, Level, Stack, defective_pixels, level_statistics
from lab.fit.lines import DarkLine, Linearity, dark_line, inflation, least_squares, linearity
from lab.recording import Camera, Capture, Dark, Flat, RecordingSet
from lab.results import NoiseFit, PhotonTransfer
from sim.camera import Side
from sim.spectrum import FloatArray, Spectrum

QUANTISATION_DN2 = 1.0 / 12.0
LINE_LIMIT = 0.7  # of saturation: EMVA's range of the photon-transfer line
CURVE_LIMIT = 0.9  # of saturation: range of the curve, whose top levels fix the curvature
LINEARITY_RANGE = (0.05, 0.95)  # of saturation: EMVA's range of the linearity line
CURVATURE_PRIOR = (
    0.1  # standard deviation of c x_saturation / K: keeps three levels solvable, is nothing against twenty
)
TRUSTED_SCATTER = 3.0  # chi2 per degree of freedom above which the curve isn't what the camera does
CLIPPED_LIMIT = 1e-4  # share of clipped pixels from which a level's variance is too small
PILED_LIMIT = 2e-3  # share of pixels on the plane's own highest code that says that it saturates there
MIN_LEVELS = 3
MIN_SIZE_PX = 16


# --- photon transfer ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TransferFit:
    """Photon transfer: v = floor[plane] + gain x + curvature x^2, x the mean above black (DN), v the temporal variance.

    `covariance` is over (gain, curvature, floors...). `gain` in DN/e, `curvature` in 1/e per DN; `line_gain` is EMVA's
    straight line through the origin to 70 % of saturation; `by_line` says that it was taken for `gain`.
    """

    gain: float
    curvature: float
    floor: FloatArray
    covariance: FloatArray
    chi2: float
    freedom: int
    line_gain: float
    curve_gain: float
    by_line: bool
    used: NDArray[np.bool_]

    @property
    def gain_std(self) -> float:
        return float(np.sqrt(self.covariance[0, 0]))


def fit_transfer(
    signal: FloatArray,
    variance: FloatArray,
    variance_std: FloatArray,
    plane: NDArray[np.integer[Any]],
    light: NDArray[np.bool_],
    saturation: float,
) -> TransferFit:
    """Conversion gain, curvature and dark variances from points (n,) of all planes.

    `signal`: mean above black, DN; `variance`: temporal, DN^2; `plane`: index 0..; `light`: False for darks; `saturation`: DN
    above black. All points given are taken as unsaturated; those above 90 % of saturation are left out.
    """
    relative = variance_std / variance
    for limit in (CURVE_LIMIT, LINE_LIMIT):
        used = ~light | (signal <= limit * saturation)
        solution, covariance, chi2, freedom = _curve(signal, variance, relative, plane, used, saturation)
        # Towards saturation some responses bend more than a parabola: then EMVA's range is the range.
        if (
            freedom < 1
            or stats.chi2.sf(chi2, freedom) > 1e-3
            or np.sum(light & (signal <= LINE_LIMIT * saturation)) < 4
        ):
            break
    floor = solution[2:]
    on_line = light & (signal <= LINE_LIMIT * saturation)
    if not on_line.any():
        on_line = light & used
    excess = variance - floor[plane]
    x, v = signal[on_line], excess[on_line]
    line = float(np.sum(x * v) / np.sum(x * x))
    if freedom >= 3 and chi2 / freedom > TRUSTED_SCATTER and np.unique(plane[~light]).size == floor.size:
        # The levels scatter for a reason that isn't in the model, and the curvature would amplify it.
        covariance = covariance * (chi2 / freedom)
        rest = v - line * x
        line_std = float(np.sqrt(np.sum((x * rest) ** 2)) / np.sum(x * x))
        spread = line_std**2 + ((line - solution[0]) / 2.0) ** 2
        by_line = True
        by_line_covariance = covariance.copy()
        by_line_covariance[0, :] = by_line_covariance[:, 0] = 0.0
        by_line_covariance[0, 0] = spread
        dark = np.array([np.average(variance[~light & (plane == p)]) for p in range(floor.size)])
        gain, curvature, floor, covariance = line, 0.0, dark, by_line_covariance
    else:
        by_line = False
        gain, curvature = float(solution[0]), float(solution[1])
        covariance = covariance * inflation(chi2, freedom)
    return TransferFit(
        gain=gain,
        curvature=curvature,
        floor=floor,
        covariance=covariance,
        chi2=chi2,
        freedom=freedom,
        line_gain=line,
        curve_gain=float(solution[0]),
        by_line=by_line,
        used=used,
    )


def _curve(
    signal: FloatArray,
    variance: FloatArray,
    relative: FloatArray,
    plane: NDArray[np.integer[Any]],
    used: NDArray[np.bool_],
    saturation: float,
) -> tuple[FloatArray, FloatArray, float, int]:
    """Weighted least squares of the curve, with a normal prior on its curvature. Returns solution, covariance, chi2, freedom."""
    count = int(plane.max()) + 1
    x, v = signal[used], variance[used]
    basis = np.concatenate([np.stack([x, x**2], axis=1), np.eye(count)[plane[used]]], axis=1)
    std = relative[used] * v
    prior = np.zeros((1, 2 + count))
    prior[0, 1] = 1.0
    gain = max(float(np.median(np.diff(np.sort(v)) / np.maximum(np.diff(np.sort(x)), 1e-9))), 1e-6)
    for _ in range(4):
        prior_std = np.array([CURVATURE_PRIOR * gain / saturation])
        solution, covariance, chi2 = least_squares(
            np.concatenate([basis, prior]), np.append(v, 0.0), np.append(std, prior_std)
        )
        gain = max(float(solution[0]), 1e-6)
        # Weights from the fitted, not the measured variances: low ones would otherwise pull.
        std = relative[used] * np.maximum(basis @ solution, 0.1 * v)
    return solution, covariance, chi2, int(used.sum()) - 2 - count + 1  # the prior counts as one value


# --- a recording set ---------------------------------------------------------------------------------------------------

C = TypeVar("C", bound=Capture)


def fit_noise(recordings: RecordingSet, side: Side) -> NoiseFit:
    """Photon transfer of one camera from its darks and flats (two repeats or more per level).

    Flats and darks of the commonest `gain_db` are used; the conversion gain is given for 0 dB. Every frame is read once, and
    not more than one level is held. Raises NotDetermined where the flats don't determine the conversion gain.
    """
    camera = recordings.camera(side)
    flats = recordings.captures("flat", side)
    if not flats:
        raise NotDetermined("noise", "no flats: capture two or more at each of several exposures up to saturation")
    if min(camera.rows, camera.cols) < MIN_SIZE_PX:
        raise NotDetermined(
            "noise",
            f"{camera.rows} x {camera.cols} px are too few for a variance: give frames of {MIN_SIZE_PX} x {MIN_SIZE_PX} or more",
        )
    gains = [flat.gain_db or 0.0 for flat in flats]
    gain_db = max(sorted(set(gains)), key=gains.count)
    flats = [flat for flat in flats if (flat.gain_db or 0.0) == gain_db]
    darks = [dark for dark in recordings.captures("dark", side) if (dark.gain_db or 0.0) == gain_db]
    dark_levels, bad = _dark_levels(recordings, darks, camera)
    lamps = _lamps(recordings, flats)
    flat_levels = [
        Level(
            group[0].exposure_s,
            _light(group[0]),
            lamps[group[0].id],
            level_statistics((recordings.frame(capture) for capture in group), camera.cfa, camera.saturation_dn, bad),
            group[0].temperature_c,
        )
        for group in _groups(flats, lambda flat: (flat.exposure_s, _light(flat), lamps[flat.id]))
    ]
    return noise_fit(dark_levels, flat_levels, camera, gain_db, 0 if bad is None else int(bad.sum()))


def _groups(captures: Sequence[C], key: Callable[[C], Hashable]) -> list[list[C]]:
    groups: dict[Hashable, list[C]] = {}
    for capture in captures:
        groups.setdefault(key(capture), []).append(capture)
    return list(groups.values())


def _light(flat: Flat) -> float:
    return flat.photons_per_pixel if flat.photons_per_pixel is not None else flat.exposure_s


#: Radiances that differ by less than this are one lamp, measured twice.
_SAME_LAMP = 0.02


def _lamps(recordings: RecordingSet, flats: Sequence[Flat]) -> dict[str, Hashable]:
    """What light each flat (by its id) saw: a lamp that is measured before every pass over the levels is one lamp."""
    seen: list[tuple[str, Spectrum]] = []
    names: dict[str | None, str | None] = {None: None}
    for path in dict.fromkeys(flat.radiance for flat in flats):
        if path is None:
            continue
        spectrum = recordings.spectrum(path)
        wavelength_nm = np.array(spectrum.wavelength_nm)
        value = np.array(spectrum.value)
        for name, other in seen:
            if np.abs(value - other.at(wavelength_nm)).sum() <= _SAME_LAMP * np.abs(value).sum():
                names[path] = name
                break
        else:
            seen.append((path, spectrum))
            names[path] = path
    return {flat.id: (names[flat.radiance], flat.photons_per_pixel is not None, flat.wavelength_nm) for flat in flats}


def _dark_levels(
    recordings: RecordingSet, darks: Sequence[Dark], camera: Camera
) -> tuple[list[Level], NDArray[np.bool_] | None]:
    """Statistics of the darks, longest exposure first: it shows the hot pixels, which are left out from there on."""
    bad: NDArray[np.bool_] | None = None
    levels = []
    groups = _groups(darks, lambda dark: (dark.exposure_s, _rounded(dark.temperature_c)))
    for group in sorted(groups, key=lambda group: -group[0].exposure_s):
        stack = Stack(camera.cfa, camera.saturation_dn, bad)
        for dark in group:
            stack.add(recordings.frame(dark))
        if bad is None and stack.mean is not None:
            bad = stack.bad = defective_pixels(stack.mean, camera.cfa)
            if not bad.any():
                stack.bad = None
        levels.append(Level(group[0].exposure_s, 0.0, "dark", stack.statistics(), _rounded(group[0].temperature_c)))
    return levels, bad


def _rounded(temperature_c: float | None) -> float | None:
    return None if temperature_c is None else float(round(temperature_c))


def noise_fit(
    darks: Sequence[Level], flats: Sequence[Level], camera: Camera, gain_db: float = 0.0, defects: int = 0
) -> NoiseFit:
    """The fit on levels' statistics; see the module for what is computed. `defects`: pixels that were left out of all.

    Raises NotDetermined where fewer than three unsaturated flat levels have repeats.
    """
    return _Evaluation(darks, flats, camera, gain_db, defects).result()


class _Evaluation:
    """The steps of one fit, in order; each leaves what later ones need."""

    def __init__(
        self, darks: Sequence[Level], flats: Sequence[Level], camera: Camera, gain_db: float, defects: int
    ) -> None:
        self.camera, self.gain_db, self.defects = camera, gain_db, defects
        self.remarks: list[str] = []
        self.white = camera.saturation_dn
        self.flats = sorted(flats, key=lambda level: (level.light, level.exposure_s))
        self.names = tuple(flats[0].plane)
        self.all_darks = sorted(darks, key=lambda level: level.exposure_s)
        self.darks = self._darks_of_one_temperature()
        self.black_clipped = any(level.plane[name].zero_share > 1e-3 for level in self.darks for name in self.names)
        if self.black_clipped:
            self.remarks.append(
                "dark frames are clipped at 0 DN: black level, read noise, dark current and DSNU aren't determined; raise the black level"
            )
            self.darks = []
        self.lines = self._dark_lines()
        self.saturation, self.saturation_seen = self._saturation()
        self.transfer, self.points = self._transfer()

    def _darks_of_one_temperature(self) -> list[Level]:
        """Darks of the temperature that most flats were taken at (or that most darks have)."""
        present = [level.temperature_c for level in self.all_darks]
        if not present:
            return []
        wanted = [_rounded(level.temperature_c) for level in self.flats]
        self.temperature = max(dict.fromkeys(present), key=lambda t: (wanted.count(t), present.count(t)))
        return [level for level in self.all_darks if level.temperature_c == self.temperature]

    # --- dark ---

    def _mean_std(self, levels: Sequence[Level], name: str | None) -> tuple[FloatArray, FloatArray]:
        """Mean (over planes for name None) of each level and its standard uncertainty: temporal noise, or the scatter of the
        repeats where that is larger."""
        means, stds, excess, freedom = [], [], 0.0, 0
        for level in levels:
            own = [level.plane[n] for n in (self.names if name is None else (name,))]
            pixels = np.array([plane.pixels for plane in own])
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
        frame_std = known * np.sqrt(inflation(excess, freedom))
        return np.array(means), frame_std / np.sqrt([level.repeats for level in levels])

    def _dark_lines(self) -> dict[str | None, DarkLine]:
        """Dark mean against exposure, by plane and (None) over all."""
        if self.darks:
            exposure = np.array([level.exposure_s for level in self.darks])
            return {name: dark_line(exposure, *self._mean_std(self.darks, name)) for name in (None, *self.names)}
        black = self._black_without_darks()
        return dict.fromkeys((None, *self.names), DarkLine(black, 0.0, np.zeros((2, 2))))

    def _black_without_darks(self) -> float:
        if not self.black_clipped:
            self.remarks.append(
                "no darks: read noise, dark current and DSNU aren't determined; capture darks at two exposures or more"
            )
        if self.camera.black_level_dn is not None:
            return self.camera.black_level_dn
        if self.black_clipped:
            return 0.0
        raise NotDetermined("noise", "neither darks nor a stated black level: capture darks at the flats' exposures")

    def _dark_mean(self, name: str, exposure_s: float) -> float:
        """Mean of a dark frame of that exposure: recorded where there is one, else by the line."""
        for level in self.darks:
            if abs(level.exposure_s - exposure_s) <= 1e-6 * exposure_s:
                return level.plane[name].mean
        return self.lines[name].at(exposure_s)

    # --- saturation ---

    def _saturated(self, name: str) -> tuple[list[bool], float | None]:
        """Which flats clip in a plane, and the DN at which they do if that was seen (all pixels there, or piled up)."""
        flags: list[tuple[Level, bool]] = []
        ratios: list[float] = []
        plateau: float | None = None
        for level in sorted(self.flats, key=lambda level: level.plane[name].mean):
            plane = level.plane[name]
            signal = plane.mean - self.lines[name].at(level.exposure_s)
            dark = min((d.plane[name].temporal_variance for d in self.darks), default=0.0)
            excess = plane.temporal_variance - (dark if np.isfinite(dark) else 0.0)
            ratio = excess / signal if signal > 0 else np.nan
            usual = float(np.median(ratios)) if ratios else np.nan
            at_white = plane.clipped_share > CLIPPED_LIMIT
            piled = plane.piled_share > PILED_LIMIT and plane.temporal_variance > 4.0
            flat = signal > 0.2 * (self.white - self.lines[name].black) and (
                ratio < 0.5 * usual or plane.temporal_variance < 0.01
            )
            if at_white:
                plateau = self.white
            elif piled:
                plateau = max(plateau or 0.0, plane.highest)
            elif flat and ratio < 0.1 * usual:
                plateau = max(plateau or 0.0, plane.mean)
            clipped = at_white or piled or bool(flat)
            flags.append((level, clipped))
            if not clipped and np.isfinite(ratio):
                ratios.append(ratio)
        by_level = {id(level): clipped for level, clipped in flags}
        return [by_level[id(level)] for level in self.flats], plateau

    def _saturation(self) -> tuple[dict[str, float], dict[str, float | None]]:
        """Saturation of each plane, DN above black (the converter's limit where it wasn't seen), and what was seen."""
        self.clipped: dict[str, list[bool]] = {}
        saturation, seen = {}, {}
        for name in self.names:
            self.clipped[name], plateau = self._saturated(name)
            seen[name] = None if plateau is None else plateau - self.lines[name].black
            saturation[name] = (plateau if plateau is not None else self.white) - self.lines[name].black
        return saturation, seen

    # --- photon transfer ---

    def _transfer(self) -> tuple[TransferFit, list[tuple[Level, str]]]:
        points: list[tuple[Level, str]] = []
        x, v, s, plane, light = [], [], [], [], []
        for level in (*self.darks, *self.flats):
            bright = level.lamp != "dark"
            for index, name in enumerate(self.names):
                own = level.plane[name]
                if own.repeats < 2 or own.temporal_variance <= 0:
                    continue
                if bright and (self.clipped[name][self.flats.index(level)] or own.zero_share > CLIPPED_LIMIT):
                    continue
                points.append((level, name))
                x.append(own.mean - self.lines[name].black)
                v.append(own.temporal_variance)
                s.append(own.temporal_variance_std)
                plane.append(index)
                light.append(bright)
        bright_levels = {level.light for level, _ in points if level.lamp != "dark"}
        if len(bright_levels) < MIN_LEVELS:
            repeated = sum(level.repeats > 1 for level in self.flats)
            raise NotDetermined(
                "noise",
                f"{len(bright_levels)} unsaturated flat levels with repeats (of {len(self.flats)} levels, {repeated} with repeats), "
                f"{MIN_LEVELS} needed: capture two frames or more at each of several exposures below saturation",
            )
        # A plane that has no points at all (all its flats clip, no darks) would leave its floor free.
        present = sorted(set(plane))
        compact = np.searchsorted(present, plane)
        transfer = fit_transfer(
            np.array(x), np.array(v), np.array(s), compact, np.array(light), max(self.saturation.values())
        )
        self.plane_index = {self.names[p]: i for i, p in enumerate(present)}
        if transfer.by_line:
            self.remarks.append(
                f"the variances scatter about their curve by {np.sqrt(transfer.chi2 / transfer.freedom):.1f} times what noise "
                f"explains, so the curvature isn't trusted: the conversion gain is EMVA's straight line to 70 % of saturation; with "
                f"curvature it would be {transfer.curve_gain:.4g} DN/e at zero signal"
            )
        elif transfer.chi2 / max(transfer.freedom, 1) > TRUSTED_SCATTER:
            self.remarks.append(
                f"the variances scatter about their curve by {np.sqrt(transfer.chi2 / transfer.freedom):.1f} times what noise explains"
            )
        if not transfer.by_line:
            bend = transfer.curvature * max(self.saturation.values()) / transfer.gain
            bend_std = float(np.sqrt(transfer.covariance[1, 1])) * max(self.saturation.values()) / transfer.gain
            if abs(bend) > 4.0 * bend_std:
                self.remarks.append(
                    f"the variance bends by {100 * bend:+.1f} +- {100 * bend_std:.1f} % of its line at saturation "
                    "(nonlinear response or brighter-fatter); the conversion gain is that at zero signal"
                )
        if transfer.gain <= 0 or transfer.gain < 3.0 * transfer.gain_std:
            raise NotDetermined(
                "noise",
                "the temporal variance doesn't grow with the signal: capture repeats of flats that are steady and unprocessed",
            )
        return transfer, points

    # --- what follows from K ---

    def _read_noise(self) -> tuple[float | None, float | None]:
        t = self.transfer
        if not any(level.lamp == "dark" for level, _ in self.points):
            if any(level.repeats > 1 for level in self.darks):
                self.remarks.append(
                    f"repeated dark frames are all alike: rounding hides the read noise, which is below {0.4 / t.gain:.2f} e"
                )
            return None, None
        count = t.floor.size
        own = t.covariance[2:, 2:]
        weight = 1.0 / np.diag(own)
        weight /= weight.sum()
        floor = float(weight @ t.floor)
        if floor < 0.24:
            self.remarks.append(
                f"the temporal noise of dark frames is {np.sqrt(max(floor, 0)):.2f} DN, where rounding hides it: the read noise is below "
                f"{0.4 / t.gain:.2f} e; a higher gain would show it"
            )
            return None, None
        between = float(np.sum((t.floor - floor) ** 2 / np.diag(own)))
        gradient = np.zeros(2 + count)
        noise = float(np.sqrt(floor - QUANTISATION_DN2))
        gradient[0] = -noise / t.gain**2
        gradient[2:] = weight / (2.0 * noise * t.gain)
        inflated = t.covariance.copy()
        inflated[2:, 2:] *= inflation(between, count - 1)
        return noise / t.gain, float(np.sqrt(gradient @ inflated @ gradient))

    def _quotient(self, value: float, std: float) -> tuple[float, float]:
        """value (DN) in electrons, with the gain's uncertainty."""
        gain = self.transfer.gain
        return value / gain, float(np.hypot(std / gain, value * self.transfer.gain_std / gain**2))

    def _dark_current(self) -> tuple[float | None, float | None]:
        if not self.darks:
            return None, None
        line = self.lines[None]
        if line.rate is None:
            self.remarks.append(
                "all darks have one exposure: the dark current isn't determined; capture darks of a longer one"
            )
            return None, None
        for temperature in dict.fromkeys(level.temperature_c for level in self.all_darks):
            others = [level for level in self.all_darks if level.temperature_c == temperature]
            exposure = np.array([level.exposure_s for level in others])
            if temperature is None:
                continue
            rate = dark_line(exposure, *self._mean_std(others, None)).rate
            if rate is not None:
                own = ", the value given" if temperature == self.temperature else ""
                self.remarks.append(
                    f"the dark current at {temperature:g} deg C is {rate / self.transfer.gain:.4g} e/s{own}"
                )
        return self._quotient(line.rate, float(np.sqrt(line.covariance[1, 1])))

    def _black(self) -> tuple[float | None, float | None]:
        if not self.darks:
            return None, None
        pixels = sum(self.darks[0].plane[name].pixels for name in self.names)
        variances = [self.darks[0].plane[name].spatial_variance for name in self.names]
        pattern = max(float(np.nan_to_num(np.mean(variances))), 0.0)  # a single frame can't tell it from noise
        line = self.lines[None]
        return line.black, float(np.sqrt(line.covariance[0, 0] + pattern / pixels))

    def _dark_pattern(self) -> tuple[Level, float, float] | None:
        """The darks that show the fixed pattern best (most repeats, then shortest), its variance in DN^2 and uncertainty."""
        repeated = [level for level in self.darks if level.repeats > 1]
        if not repeated:
            return None
        level = max(repeated, key=lambda level: (level.repeats, -level.exposure_s))
        own = [level.plane[name] for name in self.names]
        pixels = np.array([plane.pixels for plane in own], float)
        pixels /= pixels.sum()
        value = float(pixels @ [plane.spatial_variance for plane in own])
        return level, value, float(np.sqrt(np.sum((pixels * [plane.spatial_variance_std for plane in own]) ** 2)))

    def _dsnu(self) -> tuple[float | None, float | None]:
        pattern = self._dark_pattern()
        return (None, None) if pattern is None else self._quotient(*_root(pattern[1], pattern[2]))

    def _prnu(self) -> tuple[float | None, float | None]:
        dark = self._dark_pattern()
        dark_variance = max(dark[1], 0.0) if dark else 0.0
        values, stds, levels = [], [], []
        for name in self.names:
            candidates = []
            for level, clipped in zip(self.flats, self.clipped[name], strict=True):
                plane = level.plane[name]
                signal = plane.mean - self._dark_mean(name, level.exposure_s)
                share = signal / self.saturation[name]
                if clipped or plane.repeats < 2 or share < 0.1:
                    continue
                candidates.append((0.3 <= share <= 0.7, plane.repeats, -abs(share - 0.5), signal, plane))
            if not candidates:
                continue
            _, _, distance, signal, plane = max(candidates, key=lambda c: c[:3])
            root, root_std = _root(plane.pattern_variance - dark_variance, plane.pattern_variance_std)
            values.append(100.0 * root / signal)
            stds.append(100.0 * root_std / signal)
            levels.append((distance, plane.defects))
        if not values:
            self.remarks.append(
                "no unsaturated flats above 10 % of saturation: the PRNU isn't determined; expose longer"
            )
            return None, None
        farthest = -min(levels)[0]
        if farthest > 0.2:
            self.remarks.append(
                f"PRNU comes from flats as far as {100 * farthest:.0f} % from half of saturation, where it should be taken"
            )
        outliers = sum(count for _, count in levels) - self.defects
        if outliers > 0:
            self.remarks.append(
                f"{outliers} pixels respond more than {DEFECT_SIGMA:g} standard deviations off: left out of PRNU"
            )
        weight = 1.0 / np.maximum(np.array(stds), 1e-9) ** 2
        value = float(np.sum(weight * values) / weight.sum())
        chi2 = float(np.sum(weight * (np.array(values) - value) ** 2))
        return value, float(np.sqrt(inflation(chi2, len(values) - 1) / weight.sum()))

    def _full_well(self) -> tuple[float | None, float | None]:
        seen = [(value, name) for name, value in self.saturation_seen.items() if value is not None]
        if not seen:
            highest = max(
                level.plane[name].mean - self.lines[name].black for level in self.flats for name in self.names
            ) / (self.white - self.lines[None].black)
            self.remarks.append(
                f"no flat saturates (the brightest reaches {100 * highest:.0f} % of the range): the full well isn't determined; expose longer"
            )
            return None, None
        value, name = max(seen)
        limit = self.white - self.lines[name].black
        if value >= limit - 0.5:
            self.remarks.append(
                f"saturation is the converter's limit ({self.white:g} DN): full_well_e is the signal there, and the pixel may hold more"
            )
        # A plateau is rounded to whole DN where the converter sets it, and known to its noise otherwise.
        return self._quotient(value, np.sqrt(QUANTISATION_DN2))

    # --- linearity, quantum efficiency, the lamp ---

    def _main_lamp(self) -> list[Level]:
        lamps = [level.lamp for level in self.flats]
        lamp = max(dict.fromkeys(lamps), key=lamps.count)
        return [level for level in self.flats if level.lamp == lamp]

    def _linearity(self) -> tuple[dict[str, Linearity], dict[tuple[int, str], float]]:
        """Linearity by plane, and the deviation (percent) of every level and plane that has one."""
        found: dict[str, Linearity] = {}
        deviation: dict[tuple[int, str], float] = {}
        for name in self.names:
            chosen = self._linear_levels(name, *LINEARITY_RANGE)
            if len({level.light for level in chosen}) < 4:
                continue
            light, signal, std = self._response(name, chosen)
            found[name] = linearity(light, signal, std)
            for level, percent in zip(chosen, found[name].deviation_percent, strict=True):
                deviation[id(level), name] = float(percent)
        if not found:
            self.remarks.append(
                "fewer than four levels of one lamp between 5 and 95 % of saturation: the linearity error isn't determined"
            )
        return found, deviation

    def _linear_levels(self, name: str, low: float, high: float) -> list[Level]:
        clipped = dict(zip(map(id, self.flats), self.clipped[name], strict=True))
        return [
            level
            for level in self._main_lamp()
            if not clipped[id(level)]
            and low <= (level.plane[name].mean - self.lines[name].at(level.exposure_s)) / self.saturation[name] <= high
        ]

    def _response(self, name: str, levels: Sequence[Level]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Light, signal (DN above dark) and its standard uncertainty (noise or scatter of repeats, which also stands for
        levels without repeats)."""
        signal = np.array([level.plane[name].mean - self._dark_mean(name, level.exposure_s) for level in levels])
        noise = np.array([level.plane[name].mean_std for level in levels])
        noise = np.where(np.isfinite(noise), noise, np.sqrt(self.transfer.gain * signal / levels[0].plane[name].pixels))
        drift = self._drift()
        return np.array([level.light for level in levels]), signal, np.hypot(noise, drift[0] * signal)

    def _drift(self) -> tuple[float, float, float, float]:
        """Scatter of the repeats' means about their level's, relative to the signal, beyond noise; the scatter and the noise
        in DN; and the probability of so much by chance."""
        relative, square, expected, chi2, freedom = 0.0, 0.0, 0.0, 0.0, 0
        for level in self.flats:
            own = [n for n in self.names if not self.clipped[n][self.flats.index(level)]]
            if level.repeats < 2 or not own:
                continue
            planes_ = [level.plane[n] for n in own]
            pixels = np.array([plane.pixels for plane in planes_], float)
            frames = np.average([plane.frame_means for plane in planes_], axis=0, weights=pixels)
            noise = float(np.average([plane.temporal_variance for plane in planes_], weights=pixels) / pixels.sum())
            signal = float(
                np.average([p.mean - self.lines[n].black for p, n in zip(planes_, own, strict=True)], weights=pixels)
            )
            rest = float(np.sum((frames - frames.mean()) ** 2))
            square += rest
            expected += noise * (len(frames) - 1)
            chi2 += rest / noise
            relative += (rest - noise * (len(frames) - 1)) / max(signal, 1.0) ** 2
            freedom += len(frames) - 1
        if freedom == 0:
            return 0.0, 0.0, 0.0, 1.0
        chance = float(stats.chi2.sf(chi2, freedom))
        if chance > 1e-4 or relative <= 0:
            return 0.0, float(np.sqrt(square / freedom)), float(np.sqrt(expected / freedom)), chance
        return (
            float(np.sqrt(relative / freedom)),
            float(np.sqrt(square / freedom)),
            float(np.sqrt(expected / freedom)),
            chance,
        )

    def _remark_on_lamp(self) -> None:
        relative, scatter, expected, _ = self._drift()
        if relative > 0:
            self.remarks.append(
                f"the lamp drifted: the means of repeated flat frames scatter by {scatter:.2g} DN where noise explains "
                f"{expected:.2g} DN ({100 * relative:.2g} % of the signal)"
            )
            return
        # Drift between levels: what is left of a cubic through the means, all planes together.
        rests, noises = [], []
        for name in self.names:
            levels = self._linear_levels(name, *LINEARITY_RANGE)
            if len({level.light for level in levels}) < 7:
                continue
            light, signal, std = self._response(name, levels)
            basis = np.polynomial.legendre.legvander(2.0 * (light - light.min()) / np.ptp(light) - 1.0, 3)
            solution, _, _ = least_squares(basis, signal, std)
            rests.append(np.sqrt(np.sum((signal - basis @ solution) ** 2) / (len(levels) - 4)))
            noises.append(np.sqrt(np.mean(std**2)))
        if rests and np.mean(rests) > 4.0 * np.mean(noises):
            self.remarks.append(
                f"the lamp drifted between levels: their means scatter by {np.mean(rests):.2g} DN about a smooth response where noise "
                f"explains {np.mean(noises):.2g} DN"
            )

    def _quantum_efficiency(self) -> tuple[float | None, float | None, float | None]:
        """EMVA: responsivity R (slope of signal against photons, to 70 % of saturation) over K."""
        levels = self._main_lamp()
        lamp = levels[0].lamp
        if self.camera.cfa != "MONO" or not (isinstance(lamp, tuple) and lamp[1]):
            return None, None, None
        chosen = self._linear_levels("Y", 0.0, LINE_LIMIT)
        chosen = [level for level in chosen if level.light > 0]
        if len({level.light for level in chosen}) < 3:
            return None, None, None
        line = linearity(*self._response("Y", chosen))
        value, std = self._quotient(line.slope, line.slope_std)
        return value, std, lamp[2]

    # --- all ---

    def _photon_transfer(self, deviation: dict[tuple[int, str], float]) -> PhotonTransfer:
        """The plot's points: flats by channel, means over the channel's planes."""
        used = {
            (id(level), name): bool(flag) for (level, name), flag in zip(self.points, self.transfer.used, strict=True)
        }
        rows: list[tuple[str, float, float, float, float, float, bool, float | None]] = []
        channels = dict.fromkeys(name[0] for name in self.names)
        for level in self.flats:
            for channel in channels:
                own = [name for name in self.names if name[0] == channel and level.repeats > 1]
                if not own:
                    continue
                planes_ = [level.plane[name] for name in own]
                signal = [p.mean - self._dark_mean(n, level.exposure_s) for p, n in zip(planes_, own, strict=True)]
                index = [self.plane_index.get(n) for n in own]
                floor = [0.0 if i is None else float(self.transfer.floor[i]) for i in index]
                dark = [
                    f + self.transfer.gain * (self._dark_mean(n, level.exposure_s) - self.lines[n].black)
                    for f, n in zip(floor, own, strict=True)
                ]
                variance = [p.temporal_variance - d for p, d in zip(planes_, dark, strict=True)]
                shares = [deviation[id(level), n] for n in own if (id(level), n) in deviation]
                rows.append(
                    (
                        channel,
                        level.exposure_s,
                        float(np.mean(signal)),
                        float(np.sqrt(np.sum([p.mean_std**2 for p in planes_])) / len(own)),
                        float(np.mean(variance)),
                        float(np.sqrt(np.sum([p.temporal_variance_std**2 for p in planes_])) / len(own)),
                        all(used.get((id(level), n), False) for n in own),
                        float(np.mean(shares)) if shares else None,
                    )
                )
        return PhotonTransfer(
            **dict(zip(PhotonTransfer.model_fields, (tuple(column) for column in zip(*rows, strict=True)), strict=True))
        )

    def _remark_on_levels(self) -> None:
        clipped = sum(any(flags) for flags in zip(*self.clipped.values(), strict=True))
        if clipped:
            self.remarks.append(f"{clipped} of {len(self.flats)} flat levels saturate in a channel: left out there")
        single = sum(level.repeats < 2 for level in self.flats)
        if single:
            self.remarks.append(f"{single} of {len(self.flats)} flat levels have no repeat: only their means are used")
        if self.defects:
            self.remarks.append(
                f"{self.defects} hot or dead pixels stand out of the longest darks: left out of everything"
            )
        if self.gain_db:
            self.remarks.append(f"recorded at a gain of {self.gain_db:g} dB: the conversion gain is given for 0 dB")
        self._remark_on_planes()

    def _remark_on_planes(self) -> None:
        """Do the planes agree on K? Read-out channels of their own don't."""
        values, weights = [], []
        for name in self.names:
            own = [
                (level.plane[name], level)
                for (level, plane), used in zip(self.points, self.transfer.used, strict=True)
                if plane == name and used and level.lamp != "dark"
            ]
            if not own or self.transfer.by_line:
                continue
            signal = np.array([p.mean - self.lines[name].black for p, _ in own])
            excess = np.array([p.temporal_variance for p, _ in own]) - self.transfer.floor[self.plane_index[name]]
            excess -= self.transfer.curvature * signal**2
            weight = (signal / np.array([p.temporal_variance_std for p, _ in own])) ** 2
            values.append(float(np.sum(weight * excess / signal) / weight.sum()))
            weights.append(float(weight.sum()))
        if len(values) < 2:
            return
        mean = np.average(values, weights=weights)
        if stats.chi2.sf(float(np.sum(np.array(weights) * (np.array(values) - mean) ** 2)), len(values) - 1) < 1e-4:
            listed = ", ".join(f"{name} {value:.4g}" for name, value in zip(self.names, values, strict=False))
            self.remarks.append(f"the planes differ in conversion gain ({listed} DN/e): the one given is their mean")

    def result(self) -> NoiseFit:
        t = self.transfer
        scale = 10.0 ** (-self.gain_db / 20.0)
        found, deviation = self._linearity()
        self._remark_on_lamp()
        self._remark_on_levels()
        read_noise, read_noise_std = self._read_noise()
        black, black_std = self._black()
        dark_current, dark_current_std = self._dark_current()
        dsnu, dsnu_std = self._dsnu()
        prnu, prnu_std = self._prnu()
        full_well, full_well_std = self._full_well()
        qe, qe_std, qe_at = self._quantum_efficiency()
        errors = list(found.values())
        return NoiseFit(
            conversion_gain_dn_per_e=t.gain * scale,
            conversion_gain_dn_per_e_std=t.gain_std * scale,
            read_noise_e=read_noise,
            read_noise_e_std=read_noise_std,
            black_level_dn=black,
            black_level_dn_std=black_std,
            dark_current_e_per_s=dark_current,
            dark_current_e_per_s_std=dark_current_std,
            dsnu_e=dsnu,
            dsnu_e_std=dsnu_std,
            prnu_percent=prnu,
            prnu_percent_std=prnu_std,
            full_well_e=full_well,
            full_well_e_std=full_well_std,
            linearity_error_percent=float(np.mean([e.error_percent for e in errors])) if errors else None,
            # Planes see the same lamp: their errors go together.
            linearity_error_percent_std=float(np.mean([e.error_percent_std for e in errors])) if errors else None,
            quantum_efficiency=qe,
            quantum_efficiency_std=qe_std,
            quantum_efficiency_wavelength_nm=qe_at,
            photon_transfer=self._photon_transfer(deviation),
            remarks=tuple(self.remarks),
        )


def _root(square: float, square_std: float) -> tuple[float, float]:
    """Square root of a variance that noise may have made negative, with its standard uncertainty."""
    value = float(np.sqrt(max(square, 0.0)))
    # Far from 0 this is std / (2 value); at 0 the root is known to sqrt(std).
    return value, square_std / (value + float(np.sqrt(max(square, square_std))))
