"""A stated exposure that the dark frames of other exposures contradict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, ndtri, stdtrit

from lab.capture_kinds.dark import DarkCapture
from lab.diagnose.measurements.dark_frames import TEMPERATURE_STEP_C
from lab.diagnose.measurements.dark_level import DARK
from lab.diagnose.metadata.misstatement import Misstatement
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.recording_set import RecordingSet
from lab.formats.recording_set.frame_files import Frame
from lab.measure.rounding import rounding_std_dn
from sim.camera import Side
from sim.spectrum import FloatArray

LEAST_EXPOSURES, LEAST_REPEATS = 3, 2
FLOOR_DN = 0.02  # standard deviation of an exposure's mean dark level beside the scatter of its repeats
ROUNDED_DN2 = 1.0 / 12.0  # variance of a pixel by rounding, its least


@dataclass(frozen=True)
class _Candidate:
    """One exposure that may be wrong: what is stated, the factor on it that fits, its standard deviation, and both
    chi2."""

    stated_s: float
    factor: float
    std: float
    chi2: float
    chi2_left: float


def misstated_dark_exposure(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """One exposure of dark frames whose mean level lies off the line of the others, as that of another exposure would.

    At one temperature the mean of dark frames is b + r t, beside a drift with time and a dark current that changes with
    time; both are fitted, as repeats show them within every exposure. Of three exposures either of two may be wrong:
    both are told. None where nothing is found, with fewer than `LEAST_EXPOSURES`, and without repeats.
    """
    darks = recordings.captures(DarkCapture, side)
    warm = [c.temperature_c for c in darks if c.temperature_c is not None]
    if darks and len(warm) not in (0, len(darks)):
        return None
    usual = float(np.median(warm)) if warm else 0.0
    alike = [c for c in darks if c.gain_db == darks[0].gain_db and (not warm or _near(c.temperature_c, usual))]
    exposure = np.array([c.exposure_s for c in alike])
    levels, count = np.unique(exposure, return_counts=True)
    if len(levels) < LEAST_EXPOSURES or count.min() < LEAST_REPEATS:
        return None
    mean, noise = np.array([_mean_and_variance(recordings.frame(c)) for c in alike]).T
    table = _drifts(exposure, [c.time.timestamp() if c.time is not None else None for c in alike])
    found = _candidates(exposure, mean, noise, table, _floor_dn(recordings, alike), policy)
    if not found:
        return None
    nearest = min(found, key=lambda one: abs(np.log(one.factor)))
    in_question = tuple(c for c in alike if c.exposure_s in {one.stated_s for one in found})
    wrong = {c.id for c in in_question if c.exposure_s == nearest.stated_s}
    told = ", or ".join(
        f"those stated with {one.stated_s:.6g} s have the level of {one.stated_s * one.factor:.6g} ± "
        f"{one.stated_s * one.std:.2g} s"
        for one in sorted(found, key=lambda one: abs(np.log(one.factor)))
    )
    which = "correct it" if len(found) == 1 else "one of the two is wrong: correct it"
    captures = tuple(
        c.model_copy(update={"exposure_s": c.exposure_s * nearest.factor}) if c.id in wrong else c
        for c in recordings.manifest.captures
    )
    return Misstatement(
        measurement=DARK,
        where=" or ".join(f"{one.stated_s:.4g} s" for one in found),
        shape="a stated exposure contradicts the dark frames of the others",
        check=f"Dark frames of the {side} camera don't lie on one line over their exposures: {told}; {which}, or take "
        "these frames again.",
        chi2_stated=nearest.chi2,
        chi2_corrected=nearest.chi2_left,
        n=len(levels),
        captures=tuple(c.id for c in in_question),
        corrected=recordings.under(recordings.manifest.model_copy(update={"captures": captures})),
    )


def _near(temperature_c: float | None, usual_c: float) -> bool:
    return temperature_c is not None and abs(temperature_c - usual_c) <= TEMPERATURE_STEP_C


def _mean_and_variance(frame: Frame) -> tuple[float, float]:
    """Mean of a frame, DN, and the variance of that mean by the spread of its pixels, DN^2."""
    return float(frame.mean()), max(float(frame.var()), ROUNDED_DN2) / frame.size


def _floor_dn(recordings: RecordingSet, darks: Sequence[DarkCapture]) -> FloatArray:
    """Standard deviation (exposures,) of a mean level beside the scatter of its repeats: rounding, where the temporal
    noise of two repeats is too small to dither, and `FLOOR_DN`."""
    before_rounding = []
    for exposure_s in sorted({c.exposure_s for c in darks}):
        one, other = [recordings.frame(c) for c in [c for c in darks if c.exposure_s == exposure_s][:2]]
        between = np.subtract(one, other, dtype=float)
        before_rounding.append(max(0.5 * float(between.var()) - ROUNDED_DN2, 0.0))
    return np.asarray(np.hypot(FLOOR_DN, rounding_std_dn(np.array(before_rounding))))


def _drifts(exposure: FloatArray, times: list[float | None]) -> FloatArray:
    """Columns (n, 0 or 2) of an offset and of a dark current in proportion to the time; none where times aren't
    stated."""
    stated = np.array([t for t in times if t is not None])
    if len(stated) < len(times) or np.ptp(stated) == 0.0:
        return np.zeros((len(exposure), 0))
    elapsed = (stated - stated.mean()) / np.ptp(stated)
    return np.column_stack([elapsed, elapsed * exposure / exposure.max()])


def _candidates(
    exposure: FloatArray,
    mean: FloatArray,
    noise: FloatArray,
    drifts: FloatArray,
    floor_dn: FloatArray,
    policy: DecisionPolicy,
) -> list[_Candidate]:
    """Return the exposures that may be the one that is wrong. `noise` (n,): variance of each mean by its pixels' noise;
    `floor_dn` (exposures,). Frames scatter by as much more as their residuals about the means of their exposures and
    the drifts do."""
    levels = np.unique(exposure)
    of = (exposure[:, None] == levels).astype(float)
    own = np.column_stack([of, drifts])
    freedom = len(mean) - own.shape[1]
    if freedom < 1:
        return []
    rest = mean - own @ np.linalg.lstsq(own, mean, rcond=None)[0]
    more = max(float(rest @ rest) / freedom - float(noise.mean()), 0.0)
    # Student's t by the effective degrees of freedom (Welch 1947): few repeats tell their scatter badly
    effective = freedom * ((float(noise.mean()) + more) / more) ** 2 if more > 0.0 else np.inf
    least = -float(
        stdtrit(effective, 0.5 * policy.dark_exposure_chance)
        if np.isfinite(effective)
        else ndtri(0.5 * policy.dark_exposure_chance)
    )
    white = np.linalg.cholesky(np.diag(noise + more) + (of * np.square(floor_dn)) @ of.T)
    line = np.column_stack([np.ones(len(mean)), exposure / levels.max(), drifts])

    def left(table: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Estimate, covariance and chi2 of a linear model."""
        a, y = np.linalg.solve(white, table), np.linalg.solve(white, mean)
        inverse = np.linalg.pinv(a.T @ a)
        estimate = inverse @ a.T @ y
        return estimate, inverse, float(np.sum(np.square(y - a @ estimate)))

    without = left(line)[2]
    tolerance, most = policy.dark_exposure_tolerance, policy.dark_exposure_most_factor
    found = []
    for k, stated_s in enumerate(levels):
        estimate, inverse, chi2 = left(np.column_stack([line, of[:, k]]))
        signal = float(estimate[1] * stated_s / levels.max())
        if stated_s <= 0.0 or signal <= 0.0 or without - chi2 < least**2:
            continue
        factor, std = 1.0 + float(estimate[-1]) / signal, float(np.sqrt(inverse[-1, -1])) / signal
        agrees = chdtrc(max(len(mean) - line.shape[1] - 1, 1), chi2) > policy.dark_exposure_least_probability
        if agrees and 1.0 / most < factor < most and abs(factor - 1.0) > tolerance + 2.0 * std:
            found.append(_Candidate(float(stated_s), factor, std, without, chi2))
    return found
