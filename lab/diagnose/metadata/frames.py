"""Statements about frames and their exposures that darks and flats contradict; and those that no recording can check.

Unit and value of exposures, frames under each other's captures, bit depth, black level."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, ndtri, stdtrit

from lab.capture_kinds.base import LONGEST_EXPOSURE_S
from lab.capture_kinds.charuco import CharucoCapture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.diagnose.metadata.misstatement import LEFT_OUT, Misstatement, restated_camera
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.recording_set import CodeCounts, RecordingSet
from lab.formats.results import Skipped
from lab.observables.acquisition_errors import exchanged_frames
from lab.observables.codes.rounding import QUANTISATION_DN2, rounding_std_dn
from lab.observables.codes.step import find_code_step
from lab.observables.darks.frames import TEMPERATURE_STEP_C
from lab.observables.darks.level import BLACK_LEVEL, DARK
from lab.observables.flats.level_lines import DARKER_SHARE
from lab.observables.flats.linearity import PHOTON_TRANSFER
from sim.camera import Side
from sim.spectrum import FloatArray

UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6}


def misstated_exposure_unit(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return exposures above `LONGEST_EXPOSURE_S`, read in the larger unit in which none is above
    `longest_usual_exposure_s`; None where they fit.

    The times of captures tell nothing of it: they may be those of copying, or of a clock that runs fast, as the mock
    bench's does."""
    captures = [c for c in recordings.captures(side=side) if c.exposure_s is not None]  # boards may state none
    longest = max((c.exposure_s for c in captures), default=0.0)
    if longest <= LONGEST_EXPOSURE_S:
        return None
    unit = next(
        (name for name, unit_s in UNITS.items() if unit_s * longest <= policy.longest_usual_exposure_s), "microseconds"
    )
    scaled = tuple(
        c.model_copy(update={"exposure_s": UNITS[unit] * c.exposure_s})
        if c.side == side and c.exposure_s is not None
        else c
        for c in recordings.manifest.captures
    )
    return Misstatement(
        measurement=DARK,
        where=f"{len(captures)} captures",
        shape="the stated exposures are too long for seconds",
        check=f"The exposures of the {side} camera aren't in seconds: the longest is {longest:.6g} s, above "
        f"{LONGEST_EXPOSURE_S:g} s. They are "
        f"read as {unit}, the longest as {UNITS[unit] * longest:.4g} s: state exposure_s in seconds.",
        chi2_stated=(longest / LONGEST_EXPOSURE_S) ** 2,
        chi2_corrected=0.0,
        n=1,
        captures=tuple(c.id for c in captures if c.exposure_s == longest),
        corrected=recordings.under(recordings.manifest.model_copy(update={"captures": scaled})),
    )


# --- Frames that stand under each other's captures, and darks and flats stated for each other -------------------------


def misplaced_frames(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Pairs of darks and flats that seem to hold each other's frames (`lab.observables.acquisition_errors`); None
    where none is found. They are left out."""
    found = exchanged_frames(recordings, side)
    if found is None:
        return None
    every = [one for pair in found.pairs for one in pair]
    return Misstatement(
        measurement=PHOTON_TRANSFER,
        where=found.where,
        shape="captures hold each other's frames",
        check=found.told(side),
        chi2_stated=float(sum(((one.mean_dn - one.expected_dn) / one.tolerance_dn) ** 2 for one in every)),
        chi2_corrected=0.0,
        n=len(every),
        captures=found.captures,
        corrected=recordings.without(set(found.captures)),
        correction=LEFT_OUT,
    )


def exchanged_kinds(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """All flats darker than the darks, which grow with their exposure, by more than `DARKER_SHARE` of the range: the
    two kinds are stated for each other. Both are left out, as the light of those that are stated as darks isn't known.
    None where nothing is found."""
    darks, flats = recordings.captures(DarkCapture, side), recordings.captures(FlatCapture, side)
    if min(len(darks), len(flats)) < policy.least_swapped_frames:
        return None
    exposure, level = (
        np.array(v) for v in zip(*((c.exposure_s, recordings.codes(c).every.mean_dn) for c in darks), strict=True)
    )
    lit = np.array([recordings.codes(c).every.mean_dn for c in flats])
    longest = level[exposure == exposure.max()].mean()
    least = DARKER_SHARE * recordings.camera(side).saturation_dn
    if float(np.median(level)) < float(lit.max()) + least or longest < float(level.min()) + least:
        return None
    captures = tuple(c.id for c in (*darks, *flats))
    return Misstatement(
        measurement=DARK,
        where=f"{len(darks)} darks and {len(flats)} flats",
        shape="darks and flats contradict their kinds",
        check=f"The darks of the {side} camera have {level.min():.4g} to {level.max():.4g} DN and grow with the "
        f"exposure, its flats {lit.min():.4g} to "
        f"{lit.max():.4g} DN: darks and flats are stated for each other. Both are left out: exchange their kinds, and "
        "state the flats' light.",
        chi2_stated=((float(np.median(level)) - float(lit.max())) / least) ** 2,
        chi2_corrected=0.0,
        n=1,
        captures=captures,
        corrected=recordings.without(set(captures)),
        correction=LEFT_OUT,
    )


# --- A bit depth that is stated too large: pixels pile up at the highest code of fewer bits ---------------------------


def misstated_bit_depth(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a bit depth that is stated too large: no frame has a code above 2^k - 1, k less than the stated bits, and
    pixels are clipped there.

    Pixels at a full well below the converter's range are spread over codes by read noise, and that well is 2^k - 1 with
    a probability of one in thousands. A bit depth that is stated too small is refused when the recording set is read.
    None where nothing is found."""
    camera = recordings.camera(side)
    piled: dict[str, int] = {}
    highest = 0
    for capture in recordings.captures(side=side):
        counts = recordings.codes(capture).every
        top = counts.highest_dn
        if top.bit_length() >= camera.bit_depth:
            return None
        if top < highest:
            continue
        if top > highest:
            highest, piled = top, {}
        count = int(counts.number[-1])
        if count >= max(policy.clipped_pixels, policy.clipped_frame_share * counts.pixels):
            piled[capture.id] = count
    bits = highest.bit_length()
    if (
        not piled
        or highest != 2**bits - 1
        or not policy.least_bit_depth <= bits < camera.bit_depth
        or highest >= camera.saturation_dn
    ):
        return None
    count = sum(piled.values())
    return Misstatement(
        measurement=PHOTON_TRANSFER,
        where=f"code {highest}",
        shape="the stated bit depth contradicts the code at which pixels are clipped",
        check=f"The frames of the {side} camera are clipped at {highest} DN ({count} pixels in {len(piled)} "
        f"captures), the highest code of {bits} "
        f"bits, but bit_depth = {camera.bit_depth} and a white level of {camera.saturation_dn:g} DN are stated: "
        f"correct bit_depth to {bits} and "
        f"white_level_dn to {highest}.",
        # noise would put about as many pixels above that code, and none is there
        chi2_stated=float(count),
        chi2_corrected=0.0,
        n=len(piled),
        captures=tuple(piled),
        corrected=restated_camera(recordings, side, bit_depth=bits, white_level_dn=float(highest)),
    )


# --- A stated exposure that the dark frames of other exposures contradict ---------------------------------------------


LEAST_EXPOSURES, LEAST_REPEATS = 3, 2  # of dark frames: a line has two numbers, and repeats tell the scatter
FLOOR_DN = 0.02  # standard deviation of an exposure's mean dark level beside the scatter of its repeats


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
    step_dn = find_code_step(recordings, side).step_dn
    mean, noise = np.array([_mean_and_variance(recordings.codes(c).every, step_dn) for c in alike]).T
    table = _drifts(exposure, [c.time.timestamp() if c.time is not None else None for c in alike])
    found = _candidates(exposure, mean, noise, table, _floor_dn(recordings, alike, step_dn), policy)
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


def _mean_and_variance(counts: CodeCounts, step_dn: float) -> tuple[float, float]:
    """Mean of a frame, DN, and the variance of that mean by the spread of its pixels, DN^2."""
    return counts.mean_dn, max(counts.variance_dn2, QUANTISATION_DN2 * step_dn**2) / counts.pixels


def _floor_dn(recordings: RecordingSet, darks: Sequence[DarkCapture], step_dn: float) -> FloatArray:
    """Standard deviation (exposures,) of a mean level beside the scatter of its repeats: rounding, where the temporal
    noise of two repeats is too small to dither, and `FLOOR_DN`."""
    before_rounding = []
    for exposure_s in sorted({c.exposure_s for c in darks}):
        one, other = [recordings.frame(c) for c in [c for c in darks if c.exposure_s == exposure_s][:2]]
        between = np.subtract(one, other, dtype=float)
        before_rounding.append(max(0.5 * float(between.var()) - QUANTISATION_DN2 * step_dn**2, 0.0))
    return np.asarray(np.hypot(FLOOR_DN * step_dn, rounding_std_dn(np.array(before_rounding), step_dn)))


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


# --- A stated black level that the dark frames contradict -------------------------------------------------------------


def misstated_black_level(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a black level that differs from the dark frames' mean, extrapolated to zero exposure, by more than
    `black_level_tolerance`.

    A line is fitted to the means by exposure, of the frames at the gain and temperature of the shortest. With a single
    exposure, dark current can't be told from black level. None where nothing is found.
    """
    stated = recordings.camera(side).black_level_dn
    darks = recordings.captures(DarkCapture, side)
    if stated is None or not darks:
        return None
    first = min(darks, key=lambda c: c.exposure_s)
    alike = [c for c in darks if (c.gain_db, c.temperature_c) == (first.gain_db, first.temperature_c)]
    exposure = np.array([c.exposure_s for c in alike])
    mean = np.array([recordings.codes(c).every.mean_dn for c in alike])
    if np.ptp(exposure) == 0.0:
        return None
    scale = float(exposure.max())
    table = np.column_stack([np.ones(len(alike)), exposure / scale])
    (black, _), *_ = np.linalg.lstsq(table, mean, rcond=None)
    freedom = max(len(alike) - 2, 1)
    scatter = float(np.sqrt(np.sum(np.square(mean - table @ np.linalg.lstsq(table, mean, rcond=None)[0])) / freedom))
    std = float(np.hypot(scatter, 0.01) * np.sqrt(np.linalg.inv(table.T @ table)[0, 0]))
    tolerance = max(
        policy.black_level_tolerance * 2.0 ** recordings.camera(side).bit_depth, policy.black_level_least_tolerance_dn
    )
    off = float(black) - stated
    if abs(off) < tolerance + policy.black_level_sigma * std or float(black) < 0.0:
        return None
    return Misstatement(
        measurement=BLACK_LEVEL,
        where="dark frames, extrapolated to zero exposure",
        shape="the stated black level contradicts the dark frames",
        check=f"The dark frames of the {side} camera have a black level of {black:.2f} ± {std:.2g} DN, but "
        f"black_level_dn = {stated:g} is stated: "
        f"correct it to {black:.1f}, or the darks are of another camera or setting.",
        chi2_stated=(off / np.hypot(std, tolerance / policy.black_level_sigma)) ** 2,
        chi2_corrected=0.0,
        n=1,
        captures=tuple(c.id for c in alike),
        corrected=restated_camera(recordings, side, black_level_dn=round(float(black), 3)),
    )


# --- Statements that determine results and that no recording of the set can check -------------------------------------


def unchecked(recordings: RecordingSet, side: Side) -> Iterator[Skipped]:
    """Yield the bit depth, where no pixel reaches its highest bit, and the length of a board's squares; and what the
    instruments themselves said couldn't be set as a measurement wants it."""
    own = f"camera {side}"
    for name, one in recordings.manifest.instruments.items():
        if name == own or (not name.startswith("camera ") and side == recordings.sides[0]):
            for told in one.departures:
                yield Skipped(step="instrument_settings", side=side if name == own else None, reason=told)
    for line in find_code_step(recordings, side).lines:
        yield Skipped(step="code_step", side=side, reason=line)
    camera = recordings.camera(side)
    highest = 0
    for capture in recordings.captures(side=side):
        highest = max(highest, recordings.codes(capture).every.highest_dn)
        if highest.bit_length() >= camera.bit_depth:
            break
    else:
        if highest:
            yield Skipped(
                step="bit_depth",
                side=side,
                reason=f"no pixel is above {highest} DN, so that bit_depth = {camera.bit_depth} and a white level of "
                f"{camera.saturation_dn:g} DN are "
                "taken as stated: they decide full well and saturation; a flat that clips would check them",
            )
    boards = recordings.captures(CharucoCapture, side)
    if boards:
        sizes = " and ".join(f"{size:g}" for size in sorted({one.square_mm for one in boards}))
        yield Skipped(
            step="square_mm",
            side=side,
            reason=f"squares of {sizes} mm are taken as stated: a board twice as large at twice the distance has the "
            "same picture. Distances and a "
            "pair's baseline grow in proportion; a baseline, or a board, that was measured would check it",
        )
