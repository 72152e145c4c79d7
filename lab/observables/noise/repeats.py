"""Repeats of one setting over time: trend, decay, warm-up or step, tested against white scatter.

Repeats count as scatter only where their order tells nothing. Each setting of every capture kind is looked at:

    y_i = a + b f(t_i; theta) + e_i,    e_i ~ N(0, s^2), independent, s not known

y_i: mean of frame i, DN; t_i: its time where all captures state one, else its number. f is a line, exp(-t / tau) since
the first repeat, the same since the first repeat of one uninterrupted run or of every run, or a step. The statistic is
the largest correlation w of the repeats with any f. It doesn't depend on s, so that no scatter has to be assumed:
under white scatter the repeats less their mean, divided by their norm, are uniform on the sphere of d = n - 1
dimensions. The f are points of a curve of length kappa on that sphere, and Naiman's inequality (Ann. Statist. 14, 896,
1986; Hotelling's volume of tubes) bounds the probability by chance, of either sign of b:

    P <= 2 [kappa / (2 pi) (1 - w^2)^((d - 2) / 2) + 1/2 P(Beta(1/2, (d - 1) / 2) >= w^2)]

With d = 2 the first term doesn't depend on w: four repeats are the fewest (`LEAST_REPEATS`).

A trend that settings of two or three repeats have in common is tested by the seasonal Kendall statistic (Hirsch and
Slack, Water Resour. Res. 20, 727, 1984): concordant less discordant pairs, summed over the settings.

The probabilities are multiplied by the number of tests of a kind (Bonferroni): a camera with white scatter gets a
finding in `FALSE_ALARM` of all recordings of a kind at most.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special, stats

from lab.capture_kinds.base import Capture
from lab.capture_kinds.charuco import CharucoCapture
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DriftShape, RepeatDrift
from lab.observables.codes.rounding import QUANTISATION_DN2
from lab.observables.noise.levels import rounded_c
from sim.camera import Side
from sim.spectrum import FloatArray

FALSE_ALARM = 0.01  # probability of a finding in white scatter, over all settings of one kind
LEAST_REPEATS = 4  # see the module
TIME_CONSTANTS = 24  # of the grid, on a log scale from one interval between repeats to `LONGEST` times their span
LONGEST = 3.0  # spans: an exponential of that time constant correlates with a line by 0.9995
STEP_REPEATS = 2  # fewest on each side of a step: one frame that is off is an outlier, not a step


@dataclass(frozen=True)
class RepeatedSetting:
    """The n repeats of one setting in order of capture.

    `elapsed` (n,): s since the first where `is_timed`, else numbers of frames; `run` (n,): number of the uninterrupted
    run of this setting; `mean_dn` (n,); `measure_noise_dn`: returns `noise_dn`, and is called where a drift is found.
    """

    captures: tuple[Capture, ...]
    elapsed: FloatArray
    is_timed: bool
    run: NDArray[np.integer[Any]]
    mean_dn: FloatArray
    measure_noise_dn: Callable[[], float]

    @cached_property
    def noise_dn(self) -> float:
        """Standard deviation of a mean by the noise of its pixels, DN."""
        return self.measure_noise_dn()

    @property
    def text(self) -> str:
        """The setting in words."""
        first = self.captures[0]
        return ", ".join(_setting_words(first))


def find_drifts(
    recordings: RecordingSet, side: Side, kinds: Collection[str] | None = None, left_out: Collection[str] = ()
) -> tuple[RepeatDrift, ...]:
    """Return what repeats of one camera show over time beyond white scatter, the most significant of a kind first.

    `kinds`: capture kinds to look at, None: all; `left_out`: ids of captures that aren't used. Boards are left out, as
    they move between captures. Frames are read where a drift is found, no more than two at a time.
    """
    by_kind: dict[str, list[RepeatedSetting]] = {}
    for setting in _settings(recordings, side, kinds, frozenset(left_out)):
        by_kind.setdefault(setting.captures[0].kind, []).append(setting)
    return tuple(drift for own in by_kind.values() for drift in drifts_of(own))


def drifts_of(settings: Sequence[RepeatedSetting]) -> list[RepeatDrift]:
    """Return the drifts of the settings of one kind, with probabilities for the number of settings tested."""
    tested = [(one, found) for one in settings if (found := _largest_correlation(one)) is not None]
    several = [one for one in settings if len(one.captures) > 1]
    tests = len(tested) + (len(several) > 1)
    drifts = [
        _described(one, found, min(found.p_value * tests, 1.0))
        for one, found in tested
        if found.p_value * tests < FALSE_ALARM
    ]
    if drifts or len(several) < 2:
        return sorted(drifts, key=lambda drift: drift.p_value)
    p_value = min(_common_trend(several) * tests, 1.0)
    return [_described_common(several, p_value)] if p_value < FALSE_ALARM else []


# --- settings ------------------------------------------------------------------------------------------------------


def _settings(
    recordings: RecordingSet, side: Side, kinds: Collection[str] | None, left_out: frozenset[str]
) -> Iterator[RepeatedSetting]:
    """Yield the settings with two repeats or more. Captures that share a frame count once."""
    of_frame: dict[str, list[Capture]] = {}
    for capture in recordings.captures(side=side):
        of_frame.setdefault(capture.frame, []).append(capture)
    key_of = {frame: tuple(sorted(map(_key, own))) for frame, own in of_frame.items()}
    order = [own[0] for own in of_frame.values()]
    if all(capture.time is not None for capture in order):
        order.sort(key=_seconds)

    def is_wanted(capture: Capture) -> bool:
        is_of_kind = kinds is None or capture.kind in kinds
        return is_of_kind and capture.id not in left_out and not isinstance(capture, CharucoCapture)

    # frames of any other setting end a run
    runs: dict[tuple[str, ...], list[list[Capture]]] = {}
    for key, own in groupby(order, lambda capture: key_of[capture.frame]):
        runs.setdefault(key, []).append(list(own))
    for parts in runs.values():
        every = [(number, capture) for number, part in enumerate(parts) for capture in part if is_wanted(capture)]
        if len(every) < 2:
            continue
        means = _means(recordings, [capture for _, capture in every])
        repeats = [(run, capture, mean) for (run, capture), mean in zip(every, means, strict=True) if mean is not None]
        if len(repeats) < 2:
            continue
        seconds = np.array([_seconds(capture) for _, capture, _ in repeats])
        # equal time stamps are those of copying
        has_times = bool(np.all(np.diff(seconds) > 0))
        captures = tuple(capture for _, capture, _ in repeats)
        yield RepeatedSetting(
            captures=captures,
            elapsed=seconds - seconds[0] if has_times else np.arange(len(repeats), dtype=float),
            is_timed=has_times,
            run=np.array([run for run, _, _ in repeats]),
            mean_dn=np.array([mean for _, _, mean in repeats]),
            measure_noise_dn=partial(_noise_of_means_dn, recordings, captures),
        )


def _seconds(capture: Capture) -> float:
    return 0.0 if capture.time is None else capture.time.timestamp()


def _key(capture: Capture) -> str:
    """Everything that is stated of a capture's setting, the temperature to a degree."""
    stated = set(type(capture).model_fields) - {"id", "frame", "time", "temperature_c"}
    return f"{capture.model_dump_json(include=stated)} {rounded_c(capture.temperature_c)}"


def _setting_words(capture: Capture) -> Iterator[str]:
    yield capture.kind
    wavelength_nm = getattr(capture, "wavelength_nm", None)
    if wavelength_nm is not None:
        yield f"{wavelength_nm:g} nm"
    if capture.exposure_s is not None:
        yield f"{capture.exposure_s:.4g} s"
    if capture.gain_db:
        yield f"{capture.gain_db:g} dB"
    if capture.temperature_c is not None:
        yield f"{rounded_c(capture.temperature_c):g} deg C"


def _means(recordings: RecordingSet, captures: Iterable[Capture]) -> list[float | None]:
    """Return the means of frames, DN; None of a copy of an earlier one."""
    means: list[float | None] = []
    known: set[bytes] = set()
    for capture in captures:
        codes = recordings.codes(capture)
        means.append(None if codes.digest in known else codes.every.mean_dn)
        known.add(codes.digest)
    return means


def _noise_of_means_dn(recordings: RecordingSet, captures: Sequence[Capture]) -> float:
    """Return the standard deviation of a frame's mean by the noise of its pixels, DN, from differences of successive
    frames, two in memory at a time."""
    squares, pixels = [], 1
    before: NDArray[np.float32] | None = None
    for capture in captures:
        frame = recordings.frame(capture).astype(np.float32)
        if before is not None:
            squares.append(0.5 * float(np.var(frame - before, dtype=np.float64)))
        before, pixels = frame, frame.size
    return math.sqrt(max(float(np.median(squares)), QUANTISATION_DN2) / pixels)


# --- the test ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Curve:
    """One f: `value` (n,), and where it is an exponential the frames (n,) in which it acts and its time since
    (n,)."""

    shape: DriftShape
    value: FloatArray
    acts: FloatArray
    since: FloatArray
    time_constant: float | None = None


@dataclass(frozen=True)
class _Correlation:
    """The curve of the largest correlation with the repeats, and the probability of that by chance."""

    curve: _Curve
    p_value: float


def _largest_correlation(setting: RepeatedSetting) -> _Correlation | None:
    """Return the curve that the repeats follow best; None with too few repeats, or where all means are equal."""
    rest = setting.mean_dn - setting.mean_dn.mean()
    total = float(rest @ rest)
    if len(rest) < LEAST_REPEATS or total <= 0.0:
        return None
    curves = list(_curves(setting))
    unit = np.array([curve.value - curve.value.mean() for curve in curves])
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    left = np.array([float(np.sum(np.square(rest - (row @ rest) * row))) for row in unit]) / total
    length = float(sum(np.arccos(min(abs(float(a @ b)), 1.0)) for a, b in pairwise(unit)))
    best, free = int(np.argmin(left)), len(rest) - 1
    by_length = length / (2.0 * np.pi) * left[best] ** (0.5 * (free - 2))
    p_value = 2.0 * (by_length + 0.5 * float(special.betainc(0.5 * (free - 1), 0.5, left[best])))
    # A line has one parameter less: another shape replaces it where that lowers the Bayesian information criterion
    lines = [number for number, curve in enumerate(curves) if curve.shape == "trend"]
    line = min(lines, key=lambda number: left[number])
    if len(rest) * math.log(max(left[line], 1e-300) / max(left[best], 1e-300)) < math.log(len(rest)):
        best = line
    return _Correlation(curves[best], min(p_value, 1.0))


def _curves(setting: RepeatedSetting) -> Iterator[_Curve]:
    """Yield the curves in an order in which neighbours resemble each other."""
    t, run = setting.elapsed, setting.run
    everywhere = np.ones_like(t)
    yield _Curve("trend", t, everywhere, t)
    starts = np.array([t[run == number].min() for number in run])
    parts = [(everywhere, t)]
    if run.max() > 0 and max(np.bincount(run)) >= LEAST_REPEATS:
        parts.append((everywhere, t - starts))
        for number in np.unique(run):
            own = (run == number).astype(float)
            if own.sum() >= LEAST_REPEATS:
                parts.append((own, (t - starts) * own))
    for acts, since in parts:
        steps = np.diff(since[acts > 0])
        shortest, longest = float(np.median(steps[steps > 0])), LONGEST * float(np.ptp(since))
        for tau in np.geomspace(longest, shortest, TIME_CONSTANTS):
            yield _Curve("decay", acts * np.exp(-since / tau), acts, since, float(tau))
    for first in range(STEP_REPEATS, len(t) - STEP_REPEATS + 1):
        yield _Curve("step", (np.arange(len(t)) >= first).astype(float), everywhere, t)


def _common_trend(settings: Sequence[RepeatedSetting]) -> float:
    """Probability by chance of the seasonal Kendall statistic of the settings, both signs."""
    score, variance = 0.0, 0.0
    for one in settings:
        n = len(one.mean_dn)
        first, second = np.triu_indices(n, 1)
        score += float(np.sign(one.mean_dn[second] - one.mean_dn[first]).sum())
        variance += n * (n - 1) * (2 * n + 5) / 18.0
    # less 1: the correction for continuity of a statistic that changes by 2
    return float(2.0 * special.ndtr(-max(abs(score) - 1.0, 0.0) / math.sqrt(variance)))


# --- what is found -------------------------------------------------------------------------------------------------


def _described(setting: RepeatedSetting, found: _Correlation, p_value: float) -> RepeatDrift:
    """Return a drift with its curve refitted: by least squares, with Gauss-Newton's covariance."""
    y, curve = setting.mean_dn, found.curve
    time_constant = _refined(y, curve) if curve.time_constant is not None else None
    value = curve.value if time_constant is None else curve.acts * np.exp(-curve.since / time_constant)
    basis = np.column_stack([np.ones_like(y), value])
    (level, change), *_ = np.linalg.lstsq(basis, y, rcond=None)
    fitted = basis @ np.array([level, change])
    if time_constant is not None:  # derivative by ln(tau)
        basis = np.column_stack([basis, change * value * curve.since / time_constant])
    free = max(len(y) - basis.shape[1], 1)
    scatter = max(math.sqrt(float(np.sum(np.square(y - fitted))) / free), setting.noise_dn)
    covariance = scatter**2 * np.linalg.pinv(basis.T @ basis)
    acting = np.flatnonzero(curve.acts > 0)
    across = basis[acting[-1]] - basis[acting[0]]
    shape: DriftShape = "warm_up" if curve.shape == "decay" and change < 0 else curve.shape
    steady = None if time_constant is None else float(level)
    # The level is taken at any time of its repeats: the standard deviation of the curve over them (that of a rectangle
    # for a line). Where the curve has a steady value that the repeats don't average to, it is their distance.
    away = float(np.std(fitted))
    if steady is not None:
        away = math.hypot(max(away, abs(float(y.mean()) - steady)), math.sqrt(float(covariance[0, 0])))
    tau_std = None if time_constant is None else time_constant * math.sqrt(float(covariance[2, 2]))
    return _worded(
        RepeatDrift(
            shape=shape,
            kind=setting.captures[0].kind,
            setting=setting.text,
            captures=tuple(capture.id for capture in setting.captures),
            changing=tuple(setting.captures[number].id for number in acting),
            amplitude_dn=float(fitted[acting[-1]] - fitted[acting[0]]),
            amplitude_dn_std=math.sqrt(max(float(across @ covariance @ across), 0.0)),
            time_constant_s=time_constant if setting.is_timed else None,
            time_constant_s_std=tau_std if setting.is_timed else None,
            time_constant_frames=None if setting.is_timed else time_constant,
            time_constant_frames_std=None if setting.is_timed else tau_std,
            steady_dn=steady,
            steady_dn_std=None if steady is None else math.sqrt(float(covariance[0, 0])),
            p_value=p_value,
            scatter_dn=scatter,
            noise_dn=setting.noise_dn,
            level_dn_std=away,
            elapsed_s=tuple(setting.elapsed.tolist()) if setting.is_timed else None,
            mean_dn=tuple(y.tolist()),
            curve_dn=tuple(fitted.tolist()),
            curve_dn_std=tuple(np.sqrt(np.einsum("ij,jk,ik->i", basis, covariance, basis)).tolist()),
        )
    )


def _refined(y: FloatArray, curve: _Curve) -> float:
    """Time constant of least squares near that of the grid."""
    assert curve.time_constant is not None
    middle = math.log(curve.time_constant)

    def left(log_tau: float) -> float:
        basis = np.column_stack([np.ones_like(y), curve.acts * np.exp(-curve.since / math.exp(log_tau))])
        return float(np.sum(np.square(y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0])))

    found = optimize.minimize_scalar(left, bounds=(middle - 1.0, middle + 1.0), method="bounded")
    return math.exp(float(found.x))


def _described_common(settings: Sequence[RepeatedSetting], p_value: float) -> RepeatDrift:
    """Return a trend that settings have in common: departures from each setting's mean by number of the repeat."""
    most = max(len(one.mean_dn) for one in settings)
    table = np.full((len(settings), most), np.nan)
    for row, one in zip(table, settings, strict=True):
        row[: len(one.mean_dn)] = one.mean_dn - one.mean_dn.mean()
    mean = np.nanmean(table, axis=0)
    spread = np.array([float(stats.sem(column[np.isfinite(column)])) for column in table.T if _many(column)])
    std = np.append(spread, np.full(most - spread.size, spread.max(initial=0.0)))
    change = np.array([one.mean_dn[-1] - one.mean_dn[0] for one in settings])
    captures = tuple(capture.id for one in settings for capture in one.captures)
    return _worded(
        RepeatDrift(
            shape="trend",
            kind=settings[0].captures[0].kind,
            setting=f"{settings[0].captures[0].kind}, {len(settings)} settings in common",
            captures=captures,
            changing=captures,
            amplitude_dn=float(change.mean()),
            amplitude_dn_std=float(stats.sem(change)),
            p_value=p_value,
            scatter_dn=float(np.nanstd(table)),
            noise_dn=float(np.median([one.noise_dn for one in settings])),
            level_dn_std=float(np.nanstd(mean)),
            mean_dn=tuple(mean.tolist()),
            curve_dn=tuple(mean.tolist()),
            curve_dn_std=tuple(std.tolist()),
        )
    )


def _many(column: FloatArray) -> bool:
    return int(np.isfinite(column).sum()) > 1


_CAUSES = {
    "dark": "persistence of a bright frame before, a sensor that warms up or cools, a drifting offset, or a light leak "
    "does that",
}
_LIT_CAUSES = "a lamp or a screen that warms up or drifts, or image lag does that"
_USES = {
    "dark": "it is in the uncertainty of black level and dark current",
    "flat": "it is in the uncertainty of responsivity, linearity and quantum efficiency",
    "narrowband": "it is in the uncertainty of the quantum efficiency",
}
_OTHER_USE = "MTF and kernels are relative to the contrast of each frame"
_VERBS: dict[DriftShape, tuple[str, str]] = {
    "trend": ("fall steadily", "rise steadily"),
    "decay": ("fade", "fade"),
    "warm_up": ("rise to a steady level", "rise to a steady level"),
    "step": ("step down", "step up"),
}


def _worded(drift: RepeatDrift) -> RepeatDrift:
    """Return the drift with its statement."""
    first, last = drift.changing[0], drift.changing[-1]
    verb = _VERBS[drift.shape][drift.amplitude_dn > 0]
    tau = ""
    if drift.time_constant_s is not None:
        tau = f", time constant {drift.time_constant_s:.3g} ± {drift.time_constant_s_std:.2g} s"
    elif drift.time_constant_frames is not None:
        tau = f", time constant {drift.time_constant_frames:.3g} ± {drift.time_constant_frames_std:.2g} frames"
    where = [drift.curve_dn[drift.captures.index(name)] for name in (first, last)] if drift.is_of_one_setting else []
    ends = f" from {where[0]:.5g} to {where[1]:.5g} DN," if where else ""
    text = (
        f"the means of repeats {verb}: {drift.setting}, {len(drift.changing)} captures {first} .. {last},{ends} by "
        f"{drift.amplitude_dn:+.3g} ± {drift.amplitude_dn_std:.2g} DN{tau} (probability by chance {drift.p_value:.1g}; "
        f"noise {drift.noise_dn:.2g} DN): {_CAUSES.get(drift.kind, _LIT_CAUSES)}; "
        f"{_USES.get(drift.kind, _OTHER_USE)}; wait until repeats are steady, or leave these captures out"
    )
    return drift.model_copy(update={"statement": text})
