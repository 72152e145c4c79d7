"""Noise by photon transfer: conversion gain, read noise, black level, dark current, DSNU, PRNU, saturation, linearity.

Definitions: EMVA Standard 1288, release 4.0 (linear). Where this departs from the letter of the standard:

- The conversion gain K is the slope of the temporal variance against the mean at zero signal, of v = v0 + K x + c x^2
  fitted to all unsaturated levels and planes at once, weighted by what the variances are worth. The curvature c takes up a
  nonlinear response and brighter-fatter, which bias the standard's straight line (to 70 % of saturation) by 1.5 times the
  curvature. What the variances scatter about the curve beyond their sampling noise is the model's error (of an uneven
  converter, mostly). Its part that is smooth over the whole range can't be seen, since the curve takes it up: it is assumed to be
  as large as the part that is. Where the curvature doesn't stand out of that, K is the standard's straight line, and its
  uncertainty spans both.
- What bends the variance is told apart by three measurements: the means against the light give the response's bend; what
  the variances bend beyond three times that is missing noise; and the temporal covariances of neighbouring pixels show
  whether it went there (brighter-fatter).
- Frames are compared after their means have been taken out plane by plane, so that a lamp that drifts between repeats
  doesn't count as temporal noise.
- PRNU is of what is left after a smooth surface (polynomial, degree 6 in rows and in columns, plane by plane) has been taken
  out: the lens's cos^4 and a lamp's shading don't count. Pixels further out than 8 standard deviations are defects: left out,
  counted and said.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from lab.errors import NotDetermined
from lab.fit.emva1288 import Recorded
from lab.fit.emva1288 import figures as emva1288_figures
from lab.fit.levels import DEFECT_SIGMA, HIDDEN_DN2, QUANTISATION_DN2, Level, defective_pixels
from lab.fit.lines import DarkLine, Linearity, dark_line, inflation, least_squares, linearity, root
from lab.fit.pixels import DarkPixels, read_noise_distribution, taken
from lab.formats.recording_set import Camera, Capture, Dark, Flat, RecordingSet
from lab.formats.results import ChannelNoise, DarkCurrentTemperature, Emva1288, NoiseFit, PhotonTransfer
from sim.camera import Side
from sim.spectrum import FloatArray, Spectrum

LINE_LIMIT = 0.7  # of saturation: EMVA's range of the photon-transfer line
CURVE_LIMIT = 0.9  # of saturation: range of the curve, whose top levels fix the curvature
LINEARITY_RANGE = (0.05, 0.95)  # of saturation: EMVA's range of the linearity line
CURVATURE_PRIOR = (
    0.1  # standard deviation of c x_saturation / K: keeps three levels solvable, is nothing against twenty
)
SCATTER_CHANCE = 1e-3  # below which the scatter of variances isn't taken for sampling noise
ESTABLISHED_SIGMA = 2.0  # of the model's error, above which a curvature is believed
SECOND_DIFFERENCE_RMS = 12.0**-0.5  # rms of x about its mean over 0..1
CLIPPED_LIMIT = 1e-4  # share of clipped pixels from which a level's variance is too small
PILED_LIMIT = 2e-3  # share of pixels on the plane's own highest code that says that it saturates there
PILED_PIXELS = 12  # a normal law that spreads over some DN puts one or two pixels of a plane on its highest
MIN_LEVELS = 3
#: Planes that a plane's pixels adjoin along rows and columns.
ADJACENT = {"Y": ("Y",), "R": ("G1", "G2"), "B": ("G1", "G2"), "G1": ("R", "B"), "G2": ("R", "B")}
ASYMMETRY = 0.002  # difference of opposite edges' light that is worth a remark, of the mean
DARKER_SHARE = 0.01  # of the range that a flat may lie below the darks: noise and drift are far less
MIN_SIZE_PX = 16


# --- photon transfer ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TransferFit:
    """Photon transfer: v = floor[plane] + gain x + curvature x^2, x the mean above black (DN), v the temporal variance.

    `covariance` is over (gain, curvature, floors...). `gain` in DN/e, `curvature` in 1/e per DN; `line_gain` is EMVA's
    straight line through the origin to 70 % of saturation; `by_line` says that it was taken for `gain`. `curve_gain` and
    `curve_bend` (c x_saturation / K) are the curve's in any case. `model_error`: relative scatter of the flats' variances beyond
    sampling, `dark_error` of the darks'.
    """

    gain: float
    curvature: float
    floor: FloatArray
    covariance: FloatArray
    chi2: float
    freedom: int
    line_gain: float
    curve_gain: float
    curve_gain_std: float
    curve_bend: float
    curve_bend_std: float
    by_line: bool
    model_error: float
    dark_error: float
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

    `signal`: mean above black, DN; `variance`: temporal, DN^2, with the uncertainty of its sampling; `plane`: index 0..; `light`:
    False for darks; `saturation`: DN above black. All points given are taken as unsaturated; those above 90 % of saturation are
    left out.
    """
    points = _Points(signal, variance, variance_std / variance, plane, light, saturation)
    for limit in (CURVE_LIMIT, LINE_LIMIT):
        used = ~light | (signal <= limit * saturation)
        if not used[light].any():  # all flats stand on the last tenth
            used = np.ones_like(light)
        curve = points.curve(used, (0.0, 0.0))
        # Towards saturation some responses bend more than a parabola: then EMVA's range is the range.
        if curve.likely or np.sum(light & (signal <= LINE_LIMIT * saturation)) < 4:
            break
    chi2, freedom = curve.chi2, curve.freedom
    errors = points.model_errors(used, curve)
    if any(errors):
        curve = points.curve(used, errors)
    dark_error, model_error = errors
    solution, covariance = curve.solution, curve.covariance
    gain, floor = float(solution[0]), solution[2:]
    # The part of the model's error that is smooth over the range, a line in the relative variance of the same rms: at zero signal
    # it is sqrt(3) times its rms, and from zero to the end of the range 1 / SECOND_DIFFERENCE_RMS times.
    highest = float(np.max(signal[used & light], initial=1e-9))
    smooth_gain = np.sqrt(3.0) * model_error * gain
    smooth_bend = model_error / SECOND_DIFFERENCE_RMS * saturation / highest
    bend = float(solution[1]) * saturation / gain
    bend_std = float(np.hypot(np.sqrt(covariance[1, 1]) * saturation / gain, smooth_bend))
    covariance = covariance.copy()
    covariance[0, 0] += smooth_gain**2
    covariance[1, 1] += (smooth_bend * gain / saturation) ** 2
    covariance[0, 1] -= smooth_gain * smooth_bend * gain / saturation
    covariance[1, 0] = covariance[0, 1]
    curve_gain_std = float(np.sqrt(covariance[0, 0]))
    on_line = light & (signal <= LINE_LIMIT * saturation)
    if not on_line.any():
        on_line = light & used
    x, v = signal[on_line], (variance - floor[plane])[on_line]
    line = float(np.sum(x * v) / np.sum(x * x))
    by_line = (
        model_error > 0 and abs(bend) < ESTABLISHED_SIGMA * bend_std and np.unique(plane[~light]).size == floor.size
    )
    curvature = float(solution[1])
    curve_gain = gain
    if by_line:
        for _ in range(3):  # the line starts at the floor, and the darks' own signal has noise by the line
            floor, floor_std, dark_signal = points.dark_variances(dark_error, line)
            v = (variance - floor[plane])[on_line]
            line = float(np.sum(x * v) / np.sum(x * x))
        line_std = float(np.sqrt(np.sum((x * (v - line * x)) ** 2)) / np.sum(x * x))
        # The gain at zero signal may lie anywhere between the line's and the curve's.
        covariance = np.zeros_like(covariance)
        covariance[0, 0] = line_std**2 + (line - gain) ** 2 / 3.0
        covariance[2:, 2:] = np.diag(floor_std**2) + covariance[0, 0] * np.outer(dark_signal, dark_signal)
        covariance[0, 2:] = covariance[2:, 0] = -covariance[0, 0] * dark_signal
        gain, curvature = line, 0.0
    return TransferFit(
        gain=gain,
        curvature=curvature,
        floor=floor,
        covariance=covariance,
        chi2=chi2,
        freedom=freedom,
        line_gain=line,
        curve_gain=curve_gain,
        curve_gain_std=curve_gain_std,
        curve_bend=bend,
        curve_bend_std=bend_std,
        by_line=bool(by_line),
        model_error=model_error,
        dark_error=dark_error,
        used=used,
    )


@dataclass(frozen=True)
class _Curve:
    """A solution of the photon-transfer curve; `residual` and `std` (DN^2) and `leverage` of the points used."""

    solution: FloatArray
    covariance: FloatArray
    chi2: float
    freedom: int
    residual: FloatArray
    std: FloatArray
    fitted: FloatArray
    leverage: FloatArray

    @property
    def likely(self) -> bool:
        return self.freedom < 1 or bool(special.chdtrc(self.freedom, self.chi2) > SCATTER_CHANCE)


@dataclass(frozen=True)
class _Points:
    """The points that a photon-transfer curve is fitted to; `relative`: sampling uncertainty of a variance over itself."""

    signal: FloatArray
    variance: FloatArray
    relative: FloatArray
    plane: NDArray[np.integer[Any]]
    light: NDArray[np.bool_]
    saturation: float

    def curve(self, used: NDArray[np.bool_], errors: tuple[float, float]) -> _Curve:
        """Weighted least squares of the curve, with a normal prior on its curvature. `errors`: relative errors of the model in
        darks and in flats, on top of the sampling's."""
        count = int(self.plane.max()) + 1
        x, v = self.signal[used], self.variance[used]
        basis = np.concatenate([np.stack([x, x**2], axis=1), np.eye(count)[self.plane[used]]], axis=1)
        relative = np.hypot(self.relative, np.where(self.light, errors[1], errors[0]))[used]
        std = relative * v
        prior = np.zeros((1, 2 + count))
        prior[0, 1] = 1.0
        gain = max(float(np.median(np.diff(np.sort(v)) / np.maximum(np.diff(np.sort(x)), 1e-9))), 1e-6)
        for _ in range(4):
            prior_std = np.array([CURVATURE_PRIOR * gain / self.saturation])
            solution, covariance, chi2 = least_squares(
                np.concatenate([basis, prior]), np.append(v, 0.0), np.append(std, prior_std)
            )
            gain = max(float(solution[0]), 1e-6)
            # Weights from the fitted, not the measured variances: low ones would otherwise pull.
            fitted = np.maximum(basis @ solution, 0.1 * v)
            std = relative * fitted
        leverage = np.einsum("ij,jk,ik->i", basis, covariance, basis) / std**2
        freedom = int(used.sum()) - 2 - count + 1  # the prior counts as one value
        return _Curve(solution, covariance, chi2, freedom, v - basis @ solution, std, fitted, leverage)

    def model_errors(self, used: NDArray[np.bool_], curve: _Curve) -> tuple[float, float]:
        """Relative errors of the model in darks and in flats: what makes their chi2 what it should be (Paule and Mandel, J. Res.
        Natl. Bur. Stand. 87, 377, 1982); 0 where sampling explains the scatter."""
        light = self.light[used]
        squares = [0.0, 0.0]
        active = [False, False]
        for index, group in enumerate((~light, light)):
            freedom = float(np.sum(1.0 - curve.leverage[group])) if group.any() else 0.0
            chi2 = float(np.sum((curve.residual[group] / curve.std[group]) ** 2))
            active[index] = freedom >= 1.0 and bool(special.chdtrc(freedom, chi2) < SCATTER_CHANCE)
        for _ in range(40):
            before = list(squares)
            for index, group in enumerate((~light, light)):
                if not active[index]:
                    continue
                weighted = (curve.residual[group] / curve.std[group]) ** 2
                excess = float(weighted.sum()) - float(np.sum(1.0 - curve.leverage[group]))
                slope = float(np.sum(weighted * (curve.fitted[group] / curve.std[group]) ** 2))
                squares[index] = max(squares[index] + excess / max(slope, 1e-30), 0.0)
            if np.allclose(squares, before, rtol=1e-3, atol=0.0):
                break
            curve = self.curve(used, (np.sqrt(squares[0]), np.sqrt(squares[1])))
        return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))

    def dark_variances(self, error: float, gain: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """By plane, the darks' variances less the shot noise of their own signal (`gain` times it): weighted mean, standard
        uncertainty, and the signal that was allowed for."""
        values, stds, signals = [], [], []
        for index in range(int(self.plane.max()) + 1):
            own = ~self.light & (self.plane == index)
            weight = 1.0 / (np.hypot(self.relative[own], error) * self.variance[own]) ** 2
            values.append(float(np.average(self.variance[own] - gain * self.signal[own], weights=weight)))
            signals.append(float(np.average(self.signal[own], weights=weight)))
            stds.append(float(weight.sum() ** -0.5))
        return np.array(values), np.array(stds), np.array(signals)


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
    dark_levels, pixels = _dark_levels(recordings, darks, camera)
    lamps = _lamps(recordings, flats)
    flat_levels = [
        Level(
            group[0].exposure_s,
            _light(group[0]),
            lamps[group[0].id],
            taken(recordings, group, pixels.bad).statistics(),
            group[0].temperature_c,
        )
        for group in _groups(flats, lambda flat: (flat.exposure_s, _light(flat), lamps[flat.id]))
    ]
    return noise_fit(dark_levels, flat_levels, camera, gain_db, pixels=pixels)


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


def _dark_levels(recordings: RecordingSet, darks: Sequence[Dark], camera: Camera) -> tuple[list[Level], DarkPixels]:
    """Statistics of the darks, longest exposure first: it shows the hot pixels, which are left out from there on."""
    pixels = DarkPixels(camera.cfa)
    levels = []
    groups = _groups(darks, lambda dark: (dark.exposure_s, _rounded(dark.temperature_c)))
    for group in sorted(groups, key=lambda group: -group[0].exposure_s):
        stack = taken(recordings, group, pixels.bad)
        if pixels.longest is None and stack.mean is not None:
            bad = defective_pixels(stack.mean, camera.cfa)
            if bad.any():
                pixels.bad = bad
                stack = taken(recordings, group, bad)
        pixels.take(stack, group[0].exposure_s)
        levels.append(Level(group[0].exposure_s, 0.0, "dark", stack.statistics(), _rounded(group[0].temperature_c)))
    return levels, pixels


def _rounded(temperature_c: float | None) -> float | None:
    return None if temperature_c is None else float(round(temperature_c))


def noise_fit(
    darks: Sequence[Level],
    flats: Sequence[Level],
    camera: Camera,
    gain_db: float = 0.0,
    defects: int = 0,
    pixels: DarkPixels | None = None,
) -> NoiseFit:
    """The fit on levels' statistics; see the module for what is computed. `defects`: pixels that were left out of all; `pixels`:
    what the darks say of single ones.

    Raises NotDetermined where fewer than three unsaturated flat levels have repeats.
    """
    if pixels is not None and pixels.bad is not None:
        defects = int(np.count_nonzero(pixels.bad))
    return _Evaluation(darks, flats, camera, gain_db, defects).result(pixels)


class _Evaluation:
    """The steps of one fit, in order; each leaves what later ones need."""

    def __init__(
        self,
        darks: Sequence[Level],
        flats: Sequence[Level],
        camera: Camera,
        gain_db: float,
        defects: int,
        names: tuple[str, ...] | None = None,
    ) -> None:
        self.camera, self.gain_db, self.defects = camera, gain_db, defects
        self.remarks: list[str] = []
        self.white = camera.saturation_dn
        self.flats = sorted(flats, key=lambda level: (level.light, level.exposure_s))
        self.names = names or tuple(flats[0].plane)
        self.all_darks = sorted(darks, key=lambda level: level.exposure_s)
        self.darks = self._darks_of_one_temperature()
        self.black_clipped = any(level.plane[name].zero_share > 1e-3 for level in self.darks for name in self.names)
        if self.black_clipped:
            self._remark(
                "dark frames are clipped at 0 DN: black level, read noise, dark current and DSNU aren't determined; raise the black level"
            )
            self.darks = []
        self.lines = self._dark_lines()
        self._check_darks_are_dark()
        self.saturation, self.saturation_seen = self._saturation()
        self.transfer, self.points = self._transfer(self.darks)
        present = {name for _, name in self.points}
        self.plane_index = {name: i for i, name in enumerate(n for n in self.names if n in present)}
        self._remark_on_transfer()

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
        means, stds, rounding, excess, freedom = [], [], [], 0.0, 0
        for level in levels:
            own = [level.plane[n] for n in (self.names if name is None else (name,))]
            pixels = np.array([plane.pixels for plane in own])
            rounding.append(max(plane.mean_rounding_std for plane in own))  # planes stand on like values
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
        return np.array(means), np.hypot(frame_std / np.sqrt([level.repeats for level in levels]), rounding)

    def _dark_lines(self) -> dict[str | None, DarkLine]:
        """Dark mean against exposure, by plane and (None) over all."""
        if self.darks:
            exposure = np.array([level.exposure_s for level in self.darks])
            return {name: dark_line(exposure, *self._mean_std(self.darks, name)) for name in (None, *self.names)}
        black = self._black_without_darks()
        return dict.fromkeys((None, *self.names), DarkLine(black, 0.0, np.zeros((2, 2))))

    def _black_without_darks(self) -> float:
        if not self.black_clipped:
            self._remark(
                "no darks: read noise, dark current and DSNU aren't determined; capture darks at two exposures or more"
            )
        if self.camera.black_level_dn is not None:
            return self.camera.black_level_dn
        if self.black_clipped:
            return 0.0
        raise NotDetermined("noise", "neither darks nor a stated black level: capture darks at the flats' exposures")

    def _check_darks_are_dark(self) -> None:
        """Flats can't be darker than darks: light reached these, or they are of other settings."""
        for level in self.flats if self.darks else ():
            for name in self.names:
                dark = self.lines[name].at(level.exposure_s)
                short = dark - level.plane[name].mean
                if short > max(DARKER_SHARE * (self.white - dark), 1.0):
                    raise NotDetermined(
                        "noise",
                        f"a flat of {level.exposure_s:g} s has {level.plane[name].mean:.0f} DN and is darker than darks of as long, {dark:.0f} DN: "
                        "capture the darks again, with the cap on and at the flats' settings",
                    )

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
            piled = plane.piled_share > max(PILED_LIMIT, PILED_PIXELS / plane.pixels) and plane.temporal_variance > 4.0
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
        seen: dict[str, float | None] = {}
        for name in self.names:
            self.clipped[name], plateau = self._saturated(name)
            seen[name] = None if plateau is None else plateau - self.lines[name].black
        # Planes differ in their light, not in their pixels: one that stays below saturation has the others'.
        found = [value for value in seen.values() if value is not None]
        saturation = {}
        for name, value in seen.items():
            black = self.lines[name].black
            limit = max(found) if found else self.white - black
            highest = max(level.plane[name].mean for level in self.flats) - black
            saturation[name] = value if value is not None else max(limit, highest)
        return saturation, seen

    # --- photon transfer ---

    def _transfer(self, darks: Sequence[Level]) -> tuple[TransferFit, list[tuple[Level, str]]]:
        points: list[tuple[Level, str]] = []
        x, v, s, plane, light = [], [], [], [], []
        for level in (*darks, *self.flats):
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
            alike = [
                level
                for level in self.flats
                if level.repeats > 1 and all(level.plane[name].temporal_variance == 0 for name in self.names)
            ]
            if len(alike) == repeated > 0:
                raise NotDetermined(
                    "noise",
                    f"the repeats of all {repeated} flat levels are alike, pixel by pixel: give frames that were captured one by one, not "
                    "copies, or raise the gain until noise shows",
                )
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
        if transfer.gain <= 0 or transfer.gain < 3.0 * transfer.gain_std:
            raise NotDetermined(
                "noise",
                "the temporal variance doesn't grow with the signal: capture repeats of flats that are steady and unprocessed",
            )
        return transfer, points

    def _remark_on_transfer(self) -> None:
        t = self.transfer
        if t.model_error > 0:
            self._remark(
                f"the variances of the flats scatter about their curve by {100 * t.model_error:.2g} % beyond what sampling explains "
                "(an uneven converter does that): it is in the uncertainties"
            )
        if t.by_line:
            self._remark(
                f"the bend of the variances ({100 * t.curve_bend:+.1f} +- {100 * t.curve_bend_std:.1f} % at saturation) isn't "
                "established against that scatter: the conversion gain is EMVA's straight line to 70 % of saturation; at zero signal "
                f"the curve has {t.curve_gain:.4g} +- {t.curve_gain_std:.2g} DN/e"
            )
        elif abs(t.curve_bend) > 4.0 * t.curve_bend_std:
            self._remark(
                f"the variance bends by {100 * t.curve_bend:+.1f} +- {100 * t.curve_bend_std:.1f} % of its line at saturation "
                "(nonlinear response or brighter-fatter); the conversion gain is that at zero signal"
            )

    # --- what follows from K ---

    def _read_noise(self) -> tuple[float | None, float | None]:
        t = self.transfer
        if not any(level.lamp == "dark" for level, _ in self.points):
            if any(level.repeats > 1 for level in self.darks):
                self._remark(
                    f"repeated dark frames are all alike: rounding hides the read noise, which is below {0.4 / t.gain:.2f} e"
                )
            return None, None
        count = t.floor.size
        own = t.covariance[2:, 2:]
        weight = 1.0 / np.diag(own)
        weight /= weight.sum()
        floor = float(weight @ t.floor)
        if floor < HIDDEN_DN2:
            self._remark(
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
            self._remark(
                "all darks have one exposure: the dark current isn't determined; capture darks of a longer one"
            )
            return None, None
        if self._hidden():
            return None, None
        return self._quotient(line.rate, float(np.sqrt(line.covariance[1, 1])))

    def _hidden(self) -> bool:
        """Does rounding hide the dark signal? Where neither noise nor pattern spreads the values over codes, means stand still."""
        spread = min(level.plane[name].spread for level in self.darks for name in self.names)
        if spread >= HIDDEN_DN2:
            return False
        self._remark(
            f"noise and pattern of the darks spread over {np.sqrt(spread):.2f} DN only, so rounding decides their means: dark current "
            "and DSNU aren't determined, and the black level to its rounding; a higher gain would show them"
        )
        return True

    def _remark(self, sentence: str) -> None:
        if sentence not in self.remarks:
            self.remarks.append(sentence)

    def _dark_current_from_variance(self) -> tuple[float | None, float | None]:
        """The dark current's own shot noise: growth of the dark variance with exposure over K^2, planes together. K here is that of
        the flats: the darks' own says the same as their growth."""
        repeated = [level for level in self.darks if level.repeats > 1]
        exposure = np.array([level.exposure_s for level in repeated])
        if np.unique(exposure).size < 3 or self._hidden():
            return None, None
        rates, weights = [], []
        for name in self.names:
            own = [level.plane[name] for level in repeated]
            variance = np.array([plane.temporal_variance for plane in own])
            std = np.array([plane.temporal_variance_std for plane in own])
            if variance.min() < HIDDEN_DN2:
                return None, None
            line = dark_line(exposure, variance, std)
            if line.rate is not None:
                rates.append(line.rate)
                weights.append(1.0 / line.covariance[1, 1])
        try:
            flats = self._transfer([level for level in repeated if level.exposure_s == exposure.min()])[0]
        except NotDetermined:
            return None, None
        rate = float(np.average(rates, weights=weights))
        relative = 2.0 * flats.gain_std / flats.gain
        std_of_rate = float(np.hypot(np.sum(weights) ** -0.5, rate * relative))
        return rate / flats.gain**2, std_of_rate / flats.gain**2

    def _temperatures(self) -> DarkCurrentTemperature | None:
        """Dark current at every temperature with darks of two exposures, and the laws through those that are above 0."""
        found: list[tuple[float, float, float]] = []
        temperatures = {level.temperature_c for level in self.all_darks if level.temperature_c is not None}
        for temperature in sorted(temperatures):
            own = [level for level in self.all_darks if level.temperature_c == temperature]
            line = dark_line(np.array([level.exposure_s for level in own]), *self._mean_std(own, None))
            if line.rate is not None:
                std = float(np.sqrt(line.covariance[1, 1]))
                found.append((temperature, line.rate / self.transfer.gain, std / self.transfer.gain))
                own_value = ", the value given" if temperature == self.temperature else ""
                self._remark(f"the dark current at {temperature:g} deg C is {found[-1][1]:.4g} e/s{own_value}")
        return temperature_law(found, self.transfer.gain_std / self.transfer.gain) if found else None

    def _black(self) -> tuple[float | None, float | None]:
        if not self.darks:
            return None, None
        line, patterns = self.lines[None], []
        for name in self.names:
            plane = self.darks[0].plane[name]
            if plane.every_pixel is not None and np.isfinite(
                plane.temporal_variance
            ):  # one frame can't tell it from noise
                patterns.append(plane.every_pixel.mean_std(plane.shape))
        pattern = float(np.sqrt(np.sum(np.square(patterns)))) / max(len(patterns), 1)
        return line.black, float(np.hypot(np.sqrt(line.covariance[0, 0]), pattern))

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
        if pattern is None or self._hidden():
            return None, None
        level, square, std = pattern
        if min(level.plane[name].temporal_variance for name in self.names) < HIDDEN_DN2:
            std = float(np.hypot(std, QUANTISATION_DN2))  # each pixel's own mean is rounded
        return self._quotient(*root(square, std))

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
            spread, spread_std = root(plane.pattern_variance - dark_variance, plane.pattern_variance_std)
            values.append(100.0 * spread / signal)
            stds.append(100.0 * spread_std / signal)
            levels.append((distance, plane.defects))
        if not values:
            self._remark("no unsaturated flats above 10 % of saturation: the PRNU isn't determined; expose longer")
            return None, None
        farthest = -min(levels)[0]
        if farthest > 0.2:
            self._remark(
                f"PRNU comes from flats as far as {100 * farthest:.0f} % from half of saturation, where it should be taken"
            )
        outliers = sum(count for _, count in levels) - self.defects
        if outliers > 0:
            self._remark(
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
            self._remark(
                f"no flat saturates (the brightest reaches {100 * highest:.0f} % of the range): the full well isn't determined; expose longer"
            )
            return None, None
        value, name = max(seen)
        limit = self.white - self.lines[name].black
        if value >= limit - 0.5:
            self._remark(
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
            self._remark(
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
        shot = self.transfer.gain * np.maximum(signal, 0.0) + QUANTISATION_DN2
        noise = np.where(np.isfinite(noise), noise, np.sqrt(shot / levels[0].plane[name].pixels))
        drift = self._drift
        return np.array([level.light for level in levels]), signal, np.hypot(noise, drift[0] * signal)

    @cached_property
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
            variance = float(np.average([plane.temporal_variance for plane in planes_], weights=pixels))
            rounding = max(plane.mean_rounding_std for plane in planes_)
            noise = max(variance, QUANTISATION_DN2) / pixels.sum() + rounding**2
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
        chance = float(special.chdtrc(freedom, chi2))
        if chance > 1e-4 or relative <= 0:
            return 0.0, float(np.sqrt(square / freedom)), float(np.sqrt(expected / freedom)), chance
        return (
            float(np.sqrt(relative / freedom)),
            float(np.sqrt(square / freedom)),
            float(np.sqrt(expected / freedom)),
            chance,
        )

    def _remark_on_lamp(self) -> None:
        relative, scatter, expected, _ = self._drift
        if relative > 0:
            self._remark(
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
            self._remark(
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

    # --- what bends ---

    def _response_bend(self) -> tuple[float, float] | None:
        """Departure of the response from its slope at zero, relative, at saturation: from means against light, planes together.

        x = o + S l + q l^2 with an offset for light that the exposure's clock doesn't count; the bend is q x_sat / S^2."""
        values, weights, highest = [], [], max(self.saturation.values())
        for name in self.names:
            levels = self._linear_levels(name, 0.0, CURVE_LIMIT)
            if len({level.light for level in levels}) < 5:
                continue
            light, signal, std = self._response(name, levels)
            # The response bends with all its charge, the dark current's included: as light, that is below / slope.
            below = np.array([self._dark_mean(name, level.exposure_s) - self.lines[name].black for level in levels])
            slope = float(np.sum(light * signal) / np.sum(light * light))
            for _ in range(2):
                charge = light + below / slope
                basis = np.stack([np.ones_like(light), charge, charge**2], axis=1)
                solution, covariance, chi2 = least_squares(basis, signal + below, std)
                slope = float(solution[1])
            covariance *= inflation(chi2, len(levels) - 3)
            _, slope, square = solution
            gradient = highest * np.array([0.0, -2.0 * square / slope**3, 1.0 / slope**2])
            values.append(float(square * highest / slope**2))
            weights.append(1.0 / float(gradient @ covariance @ gradient))
        if not values:
            return None
        mean = float(np.average(values, weights=weights))
        chi2 = float(np.sum(np.array(weights) * (np.array(values) - mean) ** 2))
        return mean, float(np.sqrt(inflation(chi2, len(values) - 1) / np.sum(weights)))

    def _neighbours(self) -> tuple[float, float] | None:
        """Temporal covariance of a pixel with its eight neighbours, of the share of its shot noise's variance, at saturation:
        4 (adjacent + diagonal) less the darks' = share K x x_beside / x_sat, x_beside the mean of the planes it adjoins."""
        highest, gain = max(self.saturation.values()), self.transfer.gain
        rows: list[tuple[float, float, float]] = []
        dark: dict[str, tuple[float, float]] = {}
        for name in self.names:
            own = [level.plane[name] for level in self.darks if np.isfinite(level.plane[name].covariance_std)]
            if own:
                weight = np.array([1.0 / max(plane.covariance_std, 1e-9) ** 2 for plane in own])
                both = np.array([4.0 * (plane.adjacent_covariance + plane.diagonal_covariance) for plane in own])
                dark[name] = float(np.average(both, weights=weight)), float(np.sqrt(32.0 / weight.sum()))
        for level, name in self.points:
            plane = level.plane[name]
            signal = plane.mean - self.lines[name].black
            if (
                level.lamp == "dark"
                or not np.isfinite(plane.covariance_std)
                or signal > CURVE_LIMIT * self.saturation[name]
            ):
                continue
            adjacent = [level.plane[n].mean - self.lines[n].black for n in ADJACENT[name]]
            number = self.flats.index(level)
            if any(
                self.clipped[n][number] or value > CURVE_LIMIT * self.saturation[n]
                for n, value in zip(ADJACENT[name], adjacent, strict=True)
            ):
                continue
            beside = float(np.mean(adjacent))
            below, below_std = dark.get(name, (0.0, 0.0))
            value = 4.0 * (plane.adjacent_covariance + plane.diagonal_covariance) - below
            # The neighbours' noise counts as the pixel's own does.
            std_of_both = np.sqrt(32.0 * max(beside / max(signal, 1e-9), 0.1)) * plane.covariance_std
            rows.append((gain * signal * beside / highest, value, float(np.hypot(std_of_both, below_std))))
        if len(rows) < 3:
            return None
        x, y, std = np.array(rows).T
        norm = float(np.sum((x / std) ** 2))
        product = float(np.sum(x * y / std**2)) / norm
        chi2, freedom = float(np.sum(((y - product * x) / std) ** 2)), len(rows) - 1
        # Each pair of a colour mosaic is counted in both its planes.
        counted = 1.0 if self.camera.cfa == "MONO" else 2.0
        return product, float(np.sqrt(counted * inflation(chi2, freedom) / norm))

    def _bends(self) -> dict[str, float]:
        """Percent at saturation: the response's bend, the variance's, what the variance lacks beyond the response's, and what
        neighbours have in common; with standard uncertainties. Says in a remark what bends the variance."""
        t = self.transfer
        found = {
            "variance_bend_percent": 100.0 * t.curve_bend,
            "variance_bend_percent_std": 100.0 * t.curve_bend_std,
        }
        shared = self._neighbours()
        if shared is not None:
            found["neighbour_covariance_percent"] = 100.0 * shared[0]
            found["neighbour_covariance_percent_std"] = 100.0 * shared[1]
        response = self._response_bend()
        if response is None:
            return found
        found["response_bend_percent"], found["response_bend_percent_std"] = 100.0 * response[0], 100.0 * response[1]
        # v = K (dy/de)^2 e: a response that bends by b at saturation bends the variance by 3 b.
        missing = 3.0 * response[0] - t.curve_bend
        missing_std = float(np.hypot(3.0 * response[1], t.curve_bend_std))
        found["brighter_fatter_percent"], found["brighter_fatter_percent_std"] = 100.0 * missing, 100.0 * missing_std
        causes = []
        if abs(response[0]) > 4.0 * response[1] and abs(3.0 * response[0]) > 2.0 * missing_std:
            causes.append(f"a response that bends by {100 * response[0]:+.2g} +- {100 * response[1]:.1g} %")
        if missing > 4.0 * missing_std:
            seen = shared is not None and shared[0] > 4.0 * shared[1]
            where = (
                "and it is seen in the neighbours' covariances"
                if seen
                else "which the neighbours' covariances don't show"
            )
            causes.append(
                f"{100 * missing:.2g} +- {100 * missing_std:.1g} % of the noise that is missing beyond that (brighter-fatter, {where})"
            )
        if causes and abs(t.curve_bend) > 2.0 * t.curve_bend_std:
            self._remark(f"at saturation, the variance bends by {' and '.join(causes)}")
        return found

    # --- the letter of the standard ---

    def _emva1288(self) -> dict[str, Emva1288]:
        """By plane; what a plane lacks is said in the remarks."""
        found: dict[str, Emva1288] = {}
        main = sorted(self._main_lamp(), key=lambda level: level.light)
        lamp = main[0].lamp
        photons = isinstance(lamp, tuple) and len(lamp) == 3 and bool(lamp[1])
        for name in self.names:
            given = Recorded(
                plane=name,
                darks=tuple(self.darks),
                flats=tuple(level for level in main if level.light > 0),
                in_photons=photons,
                wavelength_nm=lamp[2] if photons and isinstance(lamp, tuple) else None,
                saturation_dn=self.saturation[name],
                variance_error=self.transfer.model_error,
                lamp_error=self._drift[0],
            )
            figures = emva1288_figures(given)
            if isinstance(figures, str):
                self._remark(f"no EMVA 1288 figures: {figures}")
            else:
                found[name] = figures
        return found

    def _channels(self, principal: dict[str, float | None]) -> dict[str, ChannelNoise]:
        """Each colour by itself; a channel that its levels don't determine is left out, and said."""
        found: dict[str, ChannelNoise] = {}
        for channel in dict.fromkeys(name[0] for name in self.names):
            own = tuple(name for name in self.names if name[0] == channel)
            try:
                part = principal if own == self.names else self._part(own).principal()
            except NotDetermined as refused:
                self._remark(f"channel {channel} alone: {refused.reason}")
                continue
            found[channel] = ChannelNoise(**part)
        return found

    def _part(self, names: tuple[str, ...]) -> _Evaluation:
        return _Evaluation(self.all_darks, self.flats, self.camera, self.gain_db, 0, names)

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
            self._remark(f"{clipped} of {len(self.flats)} flat levels saturate in a channel: left out there")
        single = sum(level.repeats < 2 for level in self.flats)
        if single:
            self._remark(f"{single} of {len(self.flats)} flat levels have no repeat: only their means are used")
        if self.defects:
            self._remark(f"{self.defects} hot or dead pixels stand out of the longest darks: left out of everything")
        if self.gain_db:
            self._remark(f"recorded at a gain of {self.gain_db:g} dB: the conversion gain is given for 0 dB")
        self._remark_on_planes()

    def _remark_on_shading(self) -> None:
        """Is the light on opposite edges alike? cos^4 is; a lamp off the axis, or a lens that isn't centred, isn't."""
        edges: list[tuple[float, ...]] = []
        for level in self.flats:
            for name in self.names:
                plane = level.plane[name]
                share = (plane.mean - self.lines[name].black) / self.saturation[name]
                if 0.3 <= share <= 0.7 and not self.clipped[name][self.flats.index(level)]:
                    lift = plane.mean / (plane.mean - self.lines[name].black)
                    edges.append(tuple(1.0 + lift * (e - 1.0) for e in (*plane.shading_rows, *plane.shading_columns)))
        if not edges:
            return
        first_row, last_row, first_col, last_col = np.mean(edges, axis=0)
        found = [
            f"{axis} from {first:.3f} in their first tenth to {last:.3f} in their last"
            for axis, first, last in (("rows", first_row, last_row), ("columns", first_col, last_col))
            if abs(last - first) > ASYMMETRY
        ]
        if found:
            self._remark(f"the flats' shading is asymmetric: {'; '.join(found)}, of the mean")

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
            weight = (
                signal / np.hypot([p.temporal_variance_std for p, _ in own], self.transfer.model_error * excess)
            ) ** 2
            values.append(float(np.sum(weight * excess / signal) / weight.sum()))
            weights.append(float(weight.sum()))
        if len(values) < 2:
            return
        mean = np.average(values, weights=weights)
        if special.chdtrc(len(values) - 1, float(np.sum(np.array(weights) * (np.array(values) - mean) ** 2))) < 1e-4:
            listed = ", ".join(f"{name} {value:.4g}" for name, value in zip(self.names, values, strict=False))
            self._remark(f"the planes differ in conversion gain ({listed} DN/e): the one given is their mean")

    def principal(self) -> dict[str, float | None]:
        """The figures that stand for the sensor and for each channel, with their uncertainties."""
        scale = 10.0 ** (-self.gain_db / 20.0)
        errors = list(self._linearity()[0].values())
        # Planes see the same lamp: where it drifts, their errors go together.
        together = 1.0 if self._drift[0] > 0 else float(np.sqrt(max(len(errors), 1)))
        found: dict[str, tuple[float | None, float | None]] = {
            "conversion_gain_dn_per_e": (self.transfer.gain * scale, self.transfer.gain_std * scale),
            "read_noise_e": self._read_noise(),
            "black_level_dn": self._black(),
            "dark_current_e_per_s": self._dark_current(),
            "dsnu_e": self._dsnu(),
            "prnu_percent": self._prnu(),
            "full_well_e": self._full_well(),
            "linearity_error_percent": (
                float(np.mean([e.error_percent for e in errors])) if errors else None,
                float(np.mean([e.error_percent_std for e in errors])) / together if errors else None,
            ),
        }
        values = {name: value for name, (value, _) in found.items()}
        return values | {f"{name}_std": std for name, (_, std) in found.items()}

    def result(self, pixels: DarkPixels | None) -> NoiseFit:
        t = self.transfer
        scale = 10.0 ** (-self.gain_db / 20.0)
        self._remark_on_lamp()
        self._remark_on_levels()
        self._remark_on_shading()
        principal = self.principal()
        qe, qe_std, qe_at = self._quantum_efficiency()
        from_variance, from_variance_std = self._dark_current_from_variance()
        dark = pixels is not None and self.darks
        return NoiseFit(
            **principal,
            quantum_efficiency=qe,
            quantum_efficiency_std=qe_std,
            quantum_efficiency_wavelength_nm=qe_at,
            conversion_gain_at_zero_dn_per_e=t.curve_gain * scale,
            conversion_gain_at_zero_dn_per_e_std=t.curve_gain_std * scale,
            variance_model_error_percent=100.0 * t.model_error,
            **self._bends(),
            dark_current_from_variance_e_per_s=from_variance,
            dark_current_from_variance_e_per_s_std=from_variance_std,
            dark_current_temperature=self._temperatures(),
            read_noise_distribution=read_noise_distribution(pixels, t.gain) if dark and pixels is not None else None,
            defects=pixels.defects(t.gain) if dark and pixels is not None else None,
            channels=self._channels(principal),
            emva1288=self._emva1288(),
            photon_transfer=self._photon_transfer(self._linearity()[1]),
            remarks=tuple(self.remarks),
        )


BOLTZMANN_EV_PER_K = 8.617333262e-5
ZERO_C_K = 273.15


def temperature_law(found: Sequence[tuple[float, float, float]], gain_error: float = 0.0) -> DarkCurrentTemperature:
    """The Arrhenius law and EMVA's doubling temperature through dark currents: `found`: (deg C, e/s, its standard uncertainty).

    ln I = ln I_ref - E / k (1/T - 1/T_ref), weighted, T_ref the coldest; and ln I = a + ln 2 (T - T_ref) / T_d likewise. Only currents
    above three uncertainties are used; two temperatures are needed. `gain_error`: relative, common to all.
    """
    listed = np.array(found, float)
    plain = DarkCurrentTemperature(
        temperature_c=tuple(listed[:, 0]),
        dark_current_e_per_s=tuple(listed[:, 1]),
        dark_current_e_per_s_std=tuple(float(std) for std in np.hypot(listed[:, 2], gain_error * listed[:, 1])),
    )
    temperature, current, std = listed[listed[:, 1] > 3.0 * listed[:, 2]].T
    if np.unique(temperature).size < 2:
        return plain
    reference = float(temperature.min())
    inverse = 1.0 / (temperature + ZERO_C_K) - 1.0 / (reference + ZERO_C_K)
    fits = []
    for axis in (-inverse / BOLTZMANN_EV_PER_K, np.log(2.0) * (temperature - reference)):
        basis = np.stack([np.ones_like(axis), axis], axis=1)
        solution, covariance, chi2 = least_squares(basis, np.log(current), std / current)
        covariance *= inflation(chi2, temperature.size - 2)
        fits.append((solution, covariance))
    (arrhenius, arrhenius_covariance), (doubling, doubling_covariance) = fits
    at_reference = float(np.exp(arrhenius[0]))
    update: dict[str, float] = {
        "activation_energy_ev": float(arrhenius[1]),
        "activation_energy_ev_std": float(np.sqrt(arrhenius_covariance[1, 1])),
        "reference_temperature_c": reference,
        "reference_current_e_per_s": at_reference,
        "reference_current_e_per_s_std": at_reference
        * float(np.hypot(np.sqrt(arrhenius_covariance[0, 0]), gain_error)),
    }
    if doubling[1] > 3.0 * np.sqrt(doubling_covariance[1, 1]):
        update["doubling_temperature_c"] = 1.0 / float(doubling[1])
        update["doubling_temperature_c_std"] = float(np.sqrt(doubling_covariance[1, 1]) / doubling[1] ** 2)
    return plain.model_copy(update=update)
