"""Discover laws that no effect of the library has: tables by code, row or column that predict what they weren't taken
from.

A profile holds what the baseline and the named effects leave along one index: the counts of codes in uniform light
about a smooth curve, the means of rows and columns of flats over a running polynomial, and those of darks. Tables that
repeat after 2 to 64 indices are fitted to the seen captures by weighted least squares (F test). Of all that were tried,
those are told whose false-discovery rate is below `DecisionPolicy.discovery_rate` by Benjamini and Yekutieli (Ann.
Statist. 29, 1165, 2001), and which predict both halves of the index from the other one and the captures held out. Where
the counts of single codes repeat beyond any period, the table is one by code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.signal import savgol_coeffs
from scipy.sparse.linalg import spsolve
from scipy.stats import chi2 as chi_squared
from scipy.stats import f as f_distribution

from lab.diagnose.measurements.code_density import CodeCounts, counted, prepared, widths
from lab.diagnose.measurements.dark_readout import dark_readout
from lab.diagnose.measurements.even_flats import flats
from lab.diagnose.measurements.flat_lines import without_dark
from lab.diagnose.policy import DecisionPolicy
from lab.errors import NotDetermined
from lab.formats.results import DiscoveredLaw
from lab.measure.study import Study
from sim.camera import Side
from sim.effects.base import Effects
from sim.effects.empirical_law import Along, EmpiricalLaw, Stage
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import Uniform

PERIODS = (*range(2, 17), 20, 24, 32, 64)
LEAST_REPEATS = 6  # of a period over the index
#: Lines on either side of the running polynomial, in lines of a plane of the mosaic, and its degree.
REACH, DEGREE = 24, 2
ROBUST = 1.4826  # median absolute departure -> standard deviation of a normal distribution
LEAST_WIDTH = 0.02  # of a code: a missing code's
#: Share of what the chosen table takes off chi2 that a shorter one takes off, too, from which on that one is told
#: first.
SHORTER_SHARE = 0.9

#: What a table may come from, by stage and index: suspects, not names.
SUSPECTS: dict[tuple[Stage, Along], str] = {
    ("codes", "code"): (
        "converter bits of wrong weight do that, interleaved converters, or codes rescaled from another bit depth"
    ),
    ("charge", "row"): "phase-detection rows do that, shared read-out of neighbouring rows, or light that pulses",
    ("charge", "column"): "column amplifiers of unequal gain do that, or phase-detection columns",
    ("signal", "row"): "shared read-out of neighbouring rows does that, or pick-up at a fraction of the line rate",
    ("signal", "column"): "interleaved column converters with offsets of their own do that",
}
BY_CODE_SUSPECTS = "a converter's own differential nonlinearity does that, or a look-up table after it"
MOST_TOLD = 16  # entries of a table
LINES: tuple[Along, ...] = ("row", "column")
#: What the table is of, by stage.
QUANTITIES: dict[Stage, str] = {"codes": "code widths", "charge": "sensitivities", "signal": "dark offsets"}


@dataclass(frozen=True)
class Profile:
    """What is left along an index in some captures.

    index     (n,) index of each number
    residual  (n,) departure, filtered
    variance  (n,) of the residuals
    matrix    (n, N) sparse: departures by every index -> the residuals that they leave after the filter
    """

    index: np.ndarray
    residual: FloatArray
    variance: FloatArray
    matrix: sparse.csr_array

    @property
    def count(self) -> int:
        """The number N of indices."""
        return int(self.matrix.shape[1])

    def classes(self, period: int) -> FloatArray:
        """Return the columns (n, period) of a table with that period."""
        return np.asarray(self.matrix @ np.eye(period)[np.arange(self.count) % period])

    def left_by(self, table: FloatArray) -> FloatArray:
        """Return the residuals (n,) less a table of departures, repeated over the index."""
        return np.asarray(self.residual - self.matrix @ np.resize(table, self.count))

    def chi2(self, table: FloatArray) -> float:
        """Return chi2 of the residuals less a table of departures, repeated over the index."""
        return float(np.sum(np.square(self.left_by(table)) / self.variance))

    def part(self, used: np.ndarray) -> Profile:
        """Return the profile of some (n,) of its numbers."""
        return Profile(self.index[used], self.residual[used], self.variance[used], self.matrix[np.flatnonzero(used)])


@dataclass(frozen=True)
class Look:
    """The profiles of one quantity: of the captures that the search may use, and of those held out."""

    stage: Stage
    along: Along
    seen: Profile
    held_out: Profile | None


@dataclass(frozen=True)
class PredictiveTable:
    """A table that predicts: departures from no change by class (period,) or by index (N,)."""

    look: Look
    period: int
    departure: FloatArray
    std: FloatArray  # of each departure
    log_probability: float
    chi2: tuple[float, float, int]  # of the held-out captures (of the seen ones without any), before, after, and n
    shorter: tuple[PredictiveTable, ...] = ()  # tables of fewer numbers that it rests on, the shortest first


def discover(study: Study, effects: Effects, policy: DecisionPolicy) -> tuple[PredictiveTable, ...]:
    """Find tables that hold in what they weren't taken from, the most significant first; see the module."""
    looks = [look for make in (_codes, _light_lines, _dark_lines) for look in make(study, effects)]
    tables = [[_fitted(look.seen, period) for period in _periods(look.seen)] for look in looks]
    # Benjamini and Yekutieli: the largest k with p_(k) <= k q / (m (1 + 1/2 + ... + 1/m))
    order = np.sort([table.log_probability for own in tables for table in own])
    rank = np.arange(1, len(order) + 1)
    below = np.flatnonzero(order <= np.log(rank * policy.discovery_rate / (len(order) * np.sum(1.0 / rank))))
    limit = float(order[below[-1]]) if len(below) else -np.inf
    found = []
    for look, own in zip(looks, tables, strict=True):
        one = _periodic(look, [table for table in own if table.log_probability <= limit], policy)
        if look.stage == "codes":
            one = _by_code(look, one, policy)
        if one is not None:
            found.append(one)
    return tuple(sorted(found, key=lambda one: one.log_probability))


def _periodic(look: Look, kept: Sequence[Table], policy: DecisionPolicy) -> PredictiveTable | None:
    """Return the table of the least description length, n ln chi2 + k ln n, that predicts what it wasn't taken from."""
    if not kept:
        return None
    best = min(kept, key=lambda table: _description_length(look.seen, table))
    judged = _judged(look, best)
    gain = judged.chi2[0] - judged.chi2[1]
    if gain < policy.least_discovery_share * judged.chi2[0] or not _predicts_other_half(look.seen, best.period):
        return None
    shorter = (_judged(look, table) for table in kept if table.period < best.period)
    base = next((one for one in shorter if one.chi2[0] - one.chi2[1] >= SHORTER_SHARE * gain), None)
    return replace(judged, shorter=() if base is None else (base,))


def told(side: Side, study: Study, found: Sequence[PredictiveTable]) -> tuple[DiscoveredLaw, ...]:
    """Put discovered laws into results: the law as it stands in a camera file, its chi2, and sentences."""
    laws = []
    for one in found:
        shortest = (*one.shorter, one)[0]
        laws.append(
            DiscoveredLaw(
                side=side,
                stage=one.look.stage,
                along=one.look.along,
                period=one.period,
                table=law_of(one, study).table,
                shown_period=shortest.period,
                shown_departure=tuple(shortest.departure.tolist()),
                shown_std=tuple(shortest.std.tolist()),
                chi2_before=one.chi2[0],
                chi2_after=one.chi2[1],
                n=one.chi2[2],
                suspects=SUSPECTS[one.look.stage, one.look.along] if shortest.period else BY_CODE_SUSPECTS,
                statement=_statement(side, one),
            )
        )
    return tuple(laws)


def law_of(found: PredictiveTable, study: Study) -> EmpiricalLaw:
    """Return the law as an effect that acts on its stage, in its units."""
    look = found.look
    if look.stage == "signal":
        table = found.departure / study.noise.gain
    else:
        table = np.maximum(1.0 + found.departure, LEAST_WIDTH)
        table = table / table.mean()
    return EmpiricalLaw(
        stage=look.stage,
        along=look.along,
        period=found.period,
        table=tuple(table.tolist()),
        strength=1.0,
    )


# --- the search ------------------------------------------------------------------------------------------------------


def _periods(profile: Profile) -> list[int]:
    span = int(np.ptp(profile.index)) + 1
    return [p for p in PERIODS if p * LEAST_REPEATS <= span]


@dataclass(frozen=True)
class Table:
    """A table by class: departures (period,) of mean 0, their standard deviations, and ln of the probability that
    chance gains as much.
    """

    period: int
    departure: FloatArray
    std: FloatArray
    log_probability: float


def _fitted(profile: Profile, period: int) -> Table:
    """Fit a table with a period.

    Weighted least squares of least norm, as the filter takes out what all classes share. F test of the gain: the
    scatter that the table leaves stands for the noise, so that a variance that is too small gains nothing.
    """
    weight = 1.0 / np.sqrt(profile.variance)
    columns = profile.classes(period) * weight[:, None]
    value = profile.residual * weight
    table, _, rank, _ = np.linalg.lstsq(columns, value, rcond=1e-6)
    table = table - table.mean()
    before = float(value @ value)
    after = float(np.sum(np.square(value - columns @ table)))
    freedom = max(len(value) - int(rank), 1)
    covariance = np.linalg.pinv(columns.T @ columns, rcond=1e-12, hermitian=True) * after / freedom
    without_mean = np.eye(period) - 1.0 / period
    std = np.sqrt(np.maximum(np.diag(without_mean @ covariance @ without_mean), 0.0))
    if rank == 0 or len(value) <= rank or after >= before:
        return Table(period, table, std, 0.0)
    ratio = (before - after) / rank / (after / freedom)
    return Table(period, table, std, float(f_distribution.logsf(ratio, rank, freedom)))


def _description_length(profile: Profile, table: Table) -> float:
    n = len(profile.residual)
    return float(n * np.log(profile.chi2(table.departure)) + (table.period - 1) * np.log(n))


def _predicts_other_half(profile: Profile, period: int) -> bool:
    """Whether a table from each half of the index lowers chi2 of the other half: a few outlying lines don't."""
    low = profile.index < np.median(profile.index)
    for one, other in ((low, ~low), (~low, low)):
        table, judge = _fitted(profile.part(one), period).departure, profile.part(other)
        if judge.chi2(table) >= judge.chi2(np.zeros(1)):
            return False
    return True


def _judged(look: Look, table: Table) -> PredictiveTable:
    """Return the table with chi2 of the captures held out; of the seen ones where none are."""
    judge = look.held_out or look.seen
    chi2 = judge.chi2(np.zeros(1)), judge.chi2(table.departure), len(judge.residual)
    return PredictiveTable(look, table.period, table.departure, table.std, table.log_probability, chi2)


def _by_code(look: Look, periodic: PredictiveTable | None, policy: DecisionPolicy) -> PredictiveTable | None:
    """Return a table by every code where the captures held out show that widths differ beyond a period's, else that.

    The widths beyond the periodic table are normal with a variance tau^2 that is what the counts' noise doesn't explain
    (empirical Bayes): d minimises |(r - A d) / sigma|^2 + |d|^2 / tau^2. The standard deviations are those given all
    other widths. It has to take twice the standard deviation off chi2 of the captures held out, and
    `least_discovery_share` of it.
    """
    if look.held_out is None:
        return periodic
    seen, base = look.seen, np.zeros(1) if periodic is None else periodic.departure
    own = np.asarray(seen.matrix[np.arange(len(seen.index)), seen.index]).ravel()  # change by the code's own width
    left = seen.left_by(base)
    excess = float(np.mean(np.square(left / own) - seen.variance / np.square(own)))
    if excess <= 0.0:
        return periodic
    weighted = sparse.csr_array(seen.matrix / seen.variance[:, None])
    normal = sparse.csc_array(seen.matrix.T @ weighted + sparse.eye_array(seen.count) / excess)
    every = np.resize(base, seen.count) + spsolve(normal, weighted.T @ left)
    std = 1.0 / np.sqrt(normal.diagonal())
    n = len(look.held_out.residual)
    first, before, after = (look.held_out.chi2(table) for table in (np.zeros(1), base, every))
    if before - after < max(2.0 * np.sqrt(2.0 * n), policy.least_discovery_share * before):
        return periodic
    # chi2 of what the table takes off, as of one number
    log_p = float(chi_squared.logsf(before - after, 1)) if periodic is None else periodic.log_probability
    return PredictiveTable(
        look, 0, every, std, log_p, (first, after, n), () if periodic is None else (*periodic.shorter, periodic)
    )


# --- the profiles ----------------------------------------------------------------------------------------------------


def _codes(study: Study, effects: Effects) -> list[Look]:
    """Counts of codes in uniform light, seen and held out, less those that the effects' converter gives."""
    try:
        counts = study.once(counted)
    except NotDetermined:
        return []
    found = {}
    for held_out in (False, True):
        codes = prepared(study, counts[held_out]) if counts[held_out].captures else None
        if codes is not None:
            found[held_out] = _code_profile(codes, effects, study)
    return [Look("codes", "code", found[False], found.get(True))] if False in found else []


def _code_profile(codes: CodeCounts, effects: Effects, study: Study) -> Profile:
    used, rough = np.flatnonzero(codes.used), codes.rough
    known = rough @ (codes.expected * (widths(codes, effects, study) - 1.0)) if effects else 0.0
    of_widths = sparse.coo_array((rough @ sparse.diags_array(codes.smooth))[used])
    at = of_widths.coords[0], of_widths.coords[1] + codes.first
    matrix = sparse.csr_array((of_widths.data, at), shape=(len(used), int(study.camera.white_level_dn) + 1))
    variance = rough.power(2) @ np.maximum(codes.smooth, 1.0)
    return Profile(used + codes.first, (rough @ codes.count - known)[used], variance[used], matrix)


def _light_lines(study: Study, effects: Effects) -> list[Look]:
    """Means of rows and columns of the flats over the mean of their plane, less the dark offsets."""
    try:
        levels, images = study.once(flats)
    except NotDetermined:
        return []
    if False not in images:
        return []
    dark = study.once(dark_readout)
    looks = []
    for along in LINES:
        made: dict[bool, Profile | None] = {}
        for held_out, (image, _) in images.items():
            part = [u for u in levels if u.held_out == held_out]
            level = image if dark is None else without_dark(study, dark, part, image)[0]
            made[held_out] = _lines(study, np.asarray(level, float), along)
        seen = made[False]
        if seen is not None:
            looks.append(Look("charge", along, seen, made.get(True)))
    return looks


def _dark_lines(study: Study, effects: Effects) -> list[Look]:
    """Means of rows and columns of the darks, DN, less the offsets that the effects add."""
    dark = study.once(dark_readout)
    if dark is None:
        return []
    added = Uniform(study.camera, effects)
    image = np.asarray(dark.offsets_dn, float).copy()
    if added.adds_signal:
        image -= study.noise.gain * added.added_e
    for one in added.lines:  # of fixed offsets only their spread is known, but for the step from even to odd lines
        image -= study.noise.gain * replace(one, fixed_e=0.0).mean_e(image.shape)
    profiles = {along: _lines(study, image, along) for along in LINES}
    return [Look("signal", along, profile, None) for along, profile in profiles.items() if profile is not None]


def _lines(study: Study, image: FloatArray, along: Along) -> Profile | None:
    """Return the profile of an image (rows, cols) along its rows or columns, each plane of the mosaic by itself.

    The filter takes a running polynomial out. The variance is the square of the residuals' robust spread.
    """
    axis, period = 0 if along == "row" else 1, mosaic.step(study.camera.cfa)
    count = image.shape[axis]
    index, residual, matrix = [], [], []
    for phases in mosaic.phases(study.camera.cfa).values():
        for phase in phases:
            mean = image[phase[0] :: period, phase[1] :: period].mean(axis=1 - axis)
            taken = _polynomial_filter(len(mean))
            if taken is None:
                return None
            own = np.arange(phase[axis], count, period)
            index.append(own)
            residual.append(taken @ mean)
            at = sparse.coo_array(taken)
            matrix.append(sparse.csr_array((at.data, (at.coords[0], own[at.coords[1]])), shape=(len(own), count)))
    left = np.concatenate(residual)
    spread = ROBUST * float(np.median(np.abs(left - np.median(left))))
    if spread == 0.0:
        return None
    return Profile(np.concatenate(index), left, np.full(len(left), spread**2), sparse.csr_array(sparse.vstack(matrix)))


def _polynomial_filter(count: int) -> sparse.csr_array | None:
    """Return the matrix (count, count) that takes a running polynomial out of lines; None for too few of them."""
    reach = min(REACH, (count - 1) // 4)
    size = 2 * reach + 1
    if size <= 2 * DEGREE + 1:
        return None
    weights = np.array([savgol_coeffs(size, DEGREE, pos=place, use="dot") for place in range(size)])
    line = np.arange(count)
    first = np.clip(line - reach, 0, count - size)
    at = np.repeat(line, size), (first[:, None] + np.arange(size)).ravel()
    smooth = sparse.csr_array((weights[line - first].ravel(), at), shape=(count, count))
    return sparse.csr_array(sparse.eye_array(count) - smooth)


# --- in words --------------------------------------------------------------------------------------------------------


def _statement(side: Side, found: PredictiveTable) -> str:
    """Say which entries differ, what that may be, and by how much held-out captures are predicted better.

    The shortest table is told, and what longer ones take off chi2 besides.
    """
    look, steps = found.look, (*found.shorter, found)
    line = "code" if look.along == "code" else look.along
    base, n = steps[0], found.chi2[2]
    what = f"No named effect accounts for this: the {QUANTITIES[look.stage]} of the {side} camera"
    if base.period:
        shown = ", ".join(_entry(look, value) for value in base.departure[:MOST_TOLD])
        more = ", ..." if base.period > MOST_TOLD else ""
        each = f"each ± {_entry(look, float(np.median(base.std)), '')}"
        what += f" repeat every {base.period} {line}s; by {line} mod {base.period}: {shown}{more} ({each})"
        suspects = SUSPECTS[look.stage, look.along]
    else:
        rms = float(np.std(base.departure[look.seen.index]))
        what += f" differ by {_entry(look, rms, '')} rms, without a period"
        suspects = BY_CODE_SUSPECTS
    where = " of held-out captures" if look.held_out is not None else ""
    falls = ", ".join(
        f"to {one.chi2[1] / n:.3g} with {f'{one.period} numbers' if one.period else 'a width for every code'}"
        for one in steps
    )
    return (
        f"{what}. {suspects[0].upper()}{suspects[1:]}. "
        f"By such a table chi2 over n{where} falls from {found.chi2[0] / n:.3g} {falls}."
    )


def _entry(look: Look, value: float, sign: str = "+") -> str:
    return f"{value:{sign}.2g} DN" if look.stage == "signal" else f"{100.0 * value:{sign}.2g} %"
