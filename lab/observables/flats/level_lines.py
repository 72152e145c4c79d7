"""Lines through the means of levels: dark signal against exposure, saturation, and a response that outliers don't
move."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from lab.errors import NotDetermined
from lab.observables.noise.levels import MeasuredLevel, RecordedLevels, Remarks
from lab.observables.weighted_lines import DarkLine, chi2_factor, dark_line, least_squares
from sim.spectrum import FloatArray

# --- dark signal ---------------------------------------------------------------------------------------------------
# The dark signal: means of darks against exposure, and the black level where there are none.


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
        """Darks of that exposure that don't drift, the first where there are several."""
        alike = (
            level
            for level in self.darks
            if level.drift is None and abs(level.exposure_s - exposure_s) <= 1e-6 * exposure_s
        )
        return next(alike, None)


def mean_and_std(levels: Sequence[MeasuredLevel], names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Mean of each level over the planes `names`, DN, and its standard deviation: by temporal noise and rounding,
    increased where repeats differ by more, and by a drift of the repeats.
    """
    means, stds, rounding, excess, freedom = [], [], [], 0.0, 0
    for level in levels:
        own = [level.plane[n] for n in names]
        pixels = sum(plane.pixels for plane in own)
        rounding.append(max(plane.mean_rounding_std for plane in own))  # the errors of the planes are correlated
        frames = level.frame_means(names)
        means.append(float(frames.mean()))
        stds.append(np.sqrt(level.pixel_variance_dn2(names) / pixels))
        if len(frames) > 1:
            rest, free = level.scatter(frames)
            excess += float(np.sum(rest**2) / stds[-1] ** 2)
            freedom += free
    known = np.array(stds)
    if np.isnan(known).any():
        known = np.where(np.isnan(known), np.nanmax(known) if np.isfinite(known).any() else 1.0, known)
    frame_std = known * np.sqrt(chi2_factor(excess, freedom))
    std = np.hypot(frame_std / np.sqrt([level.repeats for level in levels]), rounding)
    return np.array(means), np.hypot(std, [level.drift_std_dn for level in levels])


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
    """Return the stated black level, DN."""
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
            if short > max(DARKER_SHARE * (recorded.white_dn - expected), recorded.step_dn):
                raise NotDetermined(
                    "noise",
                    f"a flat of {level.exposure_s:g} s has {level.plane[name].mean:.0f} DN and is darker than darks "
                    f"of as long, {expected:.0f} DN: "
                    "darks and flats may be stated for each other: exchange them, or capture the darks again, with "
                    "the cap on and at the flats' "
                    "settings",
                )


# --- saturation ----------------------------------------------------------------------------------------------------
# Which flats saturate in which plane, and at what signal.


CLIPPED_LIMIT = 1e-4  # share of clipped pixels above which the variance of a level is too small
PILED_LIMIT = 2e-3  # share of pixels at the highest code of their plane above which the plane saturates there
PILED_PIXELS = 12  # and their number: normal noise of some DN puts one or two on the highest code


@dataclass(frozen=True)
class Saturation:
    """Saturation by plane.

    `signal_dn`: DN above black; the limit of the converter where it wasn't seen. `seen_dn`: the same where it was
    seen, else None. `clipped`: by plane, for each flat, whether it saturates.
    """

    signal_dn: dict[str, float]
    seen_dn: dict[str, float | None]
    clipped: dict[str, list[bool]]


def saturation_of(recorded: RecordedLevels, dark: DarkSignal) -> Saturation:
    """Saturation of each plane. Planes differ in their light, not in their pixels: one that stays below saturation has
    that of the others.
    """
    clipped: dict[str, list[bool]] = {}
    seen: dict[str, float | None] = {}
    for name in recorded.names:
        clipped[name], plateau = _clipped_flats(recorded, dark, name)
        seen[name] = None if plateau is None else plateau - dark.lines[name].black
    found = [value for value in seen.values() if value is not None]
    saturation = {}
    for name, value in seen.items():
        black = dark.lines[name].black
        limit = max(found) if found else recorded.white_dn - black
        highest = max(level.plane[name].mean for level in recorded.flats) - black
        saturation[name] = value if value is not None else max(limit, highest)
    return Saturation(saturation, seen, clipped)


def _clipped_flats(recorded: RecordedLevels, dark: DarkSignal, name: str) -> tuple[list[bool], float | None]:
    """Return which flats clip in a plane, and the DN at which they do where this was seen: all pixels there, or
    piled up."""
    flags: list[tuple[MeasuredLevel, bool]] = []
    ratios: list[float] = []
    plateau: float | None = None
    for level in sorted(recorded.flats, key=lambda level: level.plane[name].mean):
        plane = level.plane[name]
        signal = plane.mean - dark.lines[name].at(level.exposure_s)
        noise = min((d.plane[name].temporal_variance for d in recorded.darks), default=0.0)
        excess = plane.temporal_variance - (noise if np.isfinite(noise) else 0.0)
        ratio = excess / signal if signal > 0 else np.nan
        typical = float(np.median(ratios)) if ratios else np.nan
        at_white = plane.clipped_share > CLIPPED_LIMIT
        piled = (
            plane.piled_share > max(PILED_LIMIT, PILED_PIXELS / plane.pixels)
            and plane.temporal_variance > 4.0 * plane.step_dn**2
        )
        saturates = signal > 0.2 * (recorded.white_dn - dark.lines[name].black) and (
            ratio < 0.5 * typical or plane.temporal_variance < 0.01 * plane.step_dn**2
        )
        if at_white:
            plateau = recorded.white_dn
        elif piled:
            plateau = max(plateau or 0.0, plane.highest)
        elif saturates and ratio < 0.1 * typical:
            plateau = max(plateau or 0.0, plane.mean)
        clipped = at_white or piled or bool(saturates)
        flags.append((level, clipped))
        if not clipped and np.isfinite(ratio):
            ratios.append(ratio)
    by_level = {id(level): clipped for level, clipped in flags}
    return [by_level[id(level)] for level in recorded.flats], plateau


# --- robust response -----------------------------------------------------------------------------------------------
# A robust response to light: which levels contradict the others, and how far the rest scatter about a smooth law.
#
# The signal of a level is measured; its light is stated (a number of photons, or an exposure) and may be wrong. The law
# is therefore one of the stated light against the measured signal x, in which no error has leverage:
#
#     log(light / x) = a + b u + c u^2 + ... + o / u,   u = x / saturation
#
# o is an offset (light that the clock of the exposure doesn't count, an error of the dark), with a normal prior.
# Least trimmed squares finds the law (Rousseeuw, J. Am. Stat. Assoc. 79, 871 (1984)): the quarter of the levels that
# fits worst doesn't count. Which of these are outliers is tested from the many to the few (Rosner, Technometrics 25,
# 165 (1983)), so that outliers don't hide each other.


LEAST_LEVELS = 5  # with fewer, one wrong level can't be told from the others
TRIMMED_SHARE = 0.25  # of the levels; a fifth may be wrong
LAW_RANGE = (0.01, 0.9)  # of saturation: levels that determine the law
SQUARE_FROM, CUBE_FROM = 8, 16  # levels from which the law has a square, a cube: the trimmed rest still determines it
OFFSET_STD = 1e-3  # of saturation
FALSE_ALARM = 1e-3  # probability that one of the levels of a sound series is called an outlier
LEAST_DEPARTURE = 0.005  # of the light: smaller departures are scatter
DIM_DEPARTURE = 4.0 * OFFSET_STD  # of saturation, of levels below the range of the law
BRIGHT_DEPARTURE = 0.05  # of the light, of levels above it that state too little
BRIGHT_EXCESS = 1.25  # light over that expected, of levels above it: the response may roll off there
SUBSETS = 600  # elemental subsets; 20 % wrong levels leave 250 of them clean with four numbers to determine
EXCESS_CHANCE = 1e-3  # probability below which residuals are more than the stated noise

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class RobustResponse:
    """The law, and the levels (n,) against it.

    `outlier`: stated light contradicts the other levels. `expected_light`: light at which the others have the measured
    signal; `expected_signal`: signal that they have at the stated light, at most saturation. `scatter`: relative
    standard deviation of the sound levels beyond the stated noise, 0 where noise explains them; `noise`: their
    relative rms by that noise.
    """

    outlier: BoolArray
    expected_light: FloatArray
    expected_signal: FloatArray
    scatter: float
    noise: float


def robust_response(
    light: FloatArray,
    signal: FloatArray,
    signal_std: FloatArray,
    saturation: float,
    clipped: BoolArray,
    rng: np.random.Generator,
) -> RobustResponse | None:
    """Return the response that most of the levels (n,) follow; None with fewer than five unsaturated levels.

    `light`: as stated, in any unit; `signal`, `signal_std`, `saturation`: DN above dark; `clipped`: levels that
    saturate. `rng` draws the subsets of the levels.
    """
    low, high = LAW_RANGE
    inside = ~clipped & (light > 0) & (signal >= low * saturation) & (signal <= high * saturation)
    if np.count_nonzero(inside) < LEAST_LEVELS:
        return None
    law = _LightLaw.of(light[inside], signal[inside], signal_std[inside], saturation)
    sound = law.sound_levels(rng)
    solution, scatter = law.fitted(sound)
    outlier = np.zeros(light.size, bool)
    outlier[inside] = ~sound
    expected_light = _light_at(signal / saturation, solution)
    u = np.linspace(-0.05, 1.0, 4201)
    expected = saturation * np.interp(light, np.maximum.accumulate(_light_at(u, solution)), u)
    dim = ~clipped & (signal < low * saturation)
    outlier |= dim & (np.abs(signal - expected) > DIM_DEPARTURE * saturation)
    bright = ~clipped & (signal > high * saturation)
    short = expected_light > (1.0 + BRIGHT_DEPARTURE) * light  # too little light for the signal
    outlier |= bright & (short | (light > BRIGHT_EXCESS * expected_light))
    outlier |= clipped & (expected < (1.0 - 4.0 * BRIGHT_DEPARTURE) * saturation)
    noise = float(np.sqrt(np.mean(law.noise[sound] ** 2)))
    return RobustResponse(outlier, expected_light, expected, scatter, noise)


def _light_at(u: FloatArray, solution: FloatArray) -> FloatArray:
    """Light at the signals u (of saturation); `solution`: offset, then the polynomial's coefficients."""
    return np.asarray((u + solution[0]) * np.exp(np.polynomial.polynomial.polyval(u, solution[1:])))


@dataclass(frozen=True)
class _LightLaw:
    """A law of the light over n levels, linear in its coefficients: log(light / u) = basis @ coefficients. `basis` (n,
    1 + p), the offset first; `value` (n,) is log(light / u); `noise` (n,) is the relative standard deviation of the
    signal."""

    basis: FloatArray
    value: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, light: FloatArray, signal: FloatArray, signal_std: FloatArray, saturation: float) -> _LightLaw:
        u = signal / saturation
        degree = 1 + (u.size >= SQUARE_FROM) + (u.size >= CUBE_FROM)
        basis = np.concatenate([1.0 / u[:, None], np.polynomial.polynomial.polyvander(u, degree)], axis=1)
        return cls(basis, np.log(light / u), signal_std / signal)

    def solved(self, chosen: BoolArray, scatter: float) -> tuple[FloatArray, FloatArray]:
        """Solution and covariance over the levels `chosen` (n,), with `scatter` added to their noise."""
        prior = np.zeros((1, self.basis.shape[1]))
        prior[0, 0] = 1.0
        solution, covariance, _ = least_squares(
            np.concatenate([self.basis[chosen], prior]),
            np.append(self.value[chosen], 0.0),
            np.append(np.hypot(self.noise[chosen], scatter), OFFSET_STD),
        )
        return solution, covariance

    def freedom(self, chosen: BoolArray, covariance: FloatArray, std: FloatArray) -> float:
        """Degrees of freedom of the residuals of the levels `chosen`."""
        taken = np.einsum("ij,jk,ik->i", self.basis[chosen], covariance, self.basis[chosen]) / std[chosen] ** 2
        return max(float(np.count_nonzero(chosen) - taken.sum()), 1.0)

    def scattered(self, chosen: BoolArray) -> tuple[FloatArray, FloatArray, float, float]:
        """Solution, covariance, scatter and degrees of freedom of the levels `chosen`: the scatter with which chi2 has
        its expected value (Paule and Mandel).
        """

        def excess(log_scatter: float) -> float:
            scatter = math.exp(log_scatter)
            solution, covariance = self.solved(chosen, scatter)
            std = np.hypot(self.noise, scatter)
            rest = ((self.value - self.basis @ solution) / std)[chosen]
            return float(rest @ rest) / self.freedom(chosen, covariance, std) - 1.0

        least, most = math.log(1e-7), math.log(10.0)
        scatter = 1e-7
        if excess(least) > 0:
            scatter = math.exp(optimize.brentq(excess, least, most, xtol=1e-2)) if excess(most) < 0 else 10.0
        solution, covariance = self.solved(chosen, scatter)
        return solution, covariance, scatter, self.freedom(chosen, covariance, np.hypot(self.noise, scatter))

    def fitted(self, sound: BoolArray) -> tuple[FloatArray, float]:
        """Solution over the `sound` levels, and their scatter where noise doesn't explain their residuals."""
        solution, covariance = self.solved(sound, 0.0)
        rest = ((self.value - self.basis @ solution) / self.noise)[sound]
        freedom = self.freedom(sound, covariance, self.noise)
        if special.chdtrc(freedom, float(rest @ rest)) > EXCESS_CHANCE:
            return solution, 0.0
        solution, _, scatter, _ = self.scattered(sound)
        return solution, scatter

    def sound_levels(self, rng: np.random.Generator) -> BoolArray:
        """Levels (n,) that aren't outliers: the largest number of outliers that are all significant is left out."""
        count = self.value.size
        wrong = max(int(TRIMMED_SHARE * count), 1)
        start = self._trimmed(count - wrong, rng)
        for number in range(wrong, 0, -1):
            chosen = self._concentrated(start, count - number)
            solution, covariance, scatter, freedom = self.scattered(chosen)
            out = ~chosen
            rest = np.abs(self.value - self.basis @ solution)[out]
            leverage = np.einsum("ij,jk,ik->i", self.basis[out], covariance, self.basis[out])
            std = np.sqrt(self.noise[out] ** 2 + scatter**2 + leverage)
            # With `number` levels out, one of `count - number + 1` is the next candidate
            limit = -special.stdtrit(freedom, FALSE_ALARM / (2.0 * (count - number + 1)))
            if np.all((rest > limit * std) & (rest > LEAST_DEPARTURE)):
                return chosen
        return np.ones(count, bool)

    def _trimmed(self, kept: int, rng: np.random.Generator) -> BoolArray:
        """Return the `kept` levels of least trimmed squares."""
        count, terms = self.value.size, self.basis.shape[1] - 1
        if math.comb(count, terms) <= SUBSETS:
            subsets = np.array(list(combinations(range(count), terms)))
        else:
            subsets = np.array([rng.choice(count, terms, replace=False) for _ in range(SUBSETS)])
        polynomial = self.basis[:, 1:]
        parts = polynomial[subsets]
        usable = np.abs(np.linalg.det(parts)) > 1e-12
        solutions = np.linalg.solve(parts[usable], self.value[subsets[usable]][..., None])[..., 0]
        squares = (self.value - solutions @ polynomial.T) ** 2
        best = np.argsort(np.sort(squares, axis=1)[:, :kept].sum(axis=1))[:5]
        found: tuple[float, BoolArray] | None = None
        for row in squares[best]:
            chosen = self._concentrated(_smallest(row, kept), kept)
            scatter = self.scattered(chosen)[2]
            if found is None or scatter < found[0]:
                found = scatter, chosen
        if found is None:  # levels of one signal
            return np.ones(count, bool)
        return found[1]

    def _concentrated(self, chosen: BoolArray, kept: int) -> BoolArray:
        """Return the `kept` levels nearest to the law of the levels `chosen`, and so on until these don't change."""
        scatter = 0.0
        for _ in range(10):
            solution, _ = self.solved(chosen, scatter)
            rest = np.abs(self.value - self.basis @ solution)
            scatter = float(np.sqrt(np.mean(rest[chosen] ** 2)))
            nearer = _smallest(rest / np.hypot(self.noise, scatter), kept)
            if np.array_equal(nearer, chosen):
                break
            chosen = nearer
        return chosen


def _smallest(values: FloatArray, kept: int) -> BoolArray:
    chosen = np.zeros(values.size, bool)
    chosen[np.argsort(values, kind="stable")[:kept]] = True
    return chosen
