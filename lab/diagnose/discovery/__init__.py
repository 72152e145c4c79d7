"""Discover laws that no effect of the library has: tables and curves along what a camera has, that predict what they
weren't taken from.

Looked at are the summaries that the measurements made, less what the baseline and the named effects predict: along
codes, rows, columns, and cells of both (`looks.py`), and, for measurements that are mismatched, along level, time,
exposure, wavelength, radius and frequency (`curves.py`). Forms from a table to a short symbolic law are fitted to the
seen captures (`profile.py`). Of all that were tried, those are told whose false-discovery rate is below
`DecisionPolicy.discovery_rate` by Benjamini and Yekutieli (Ann. Statist. 29, 1165, 2001), and which predict both halves
of the index from the other one and the captures held out. Where the counts of single codes differ beyond any period,
the table is one by code.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.signal import savgol_filter
from scipy.sparse.linalg import spsolve
from scipy.stats import chi2 as chi_squared

from lab.diagnose.discovery.curves import curve_looks
from lab.diagnose.discovery.looks import index_looks
from lab.diagnose.discovery.profile import (
    Form,
    Look,
    PredictiveTable,
    Profile,
    Table,
    angle_forms,
    chi2_within,
    curve_forms,
    description_length,
    end_forms,
    fitted,
    formulas,
    periodic_forms,
    plane_forms,
    tap_forms,
    upper_forms,
    wave_forms,
)
from lab.diagnose.discovery.words import (
    BEYOND_TABLE,
    entry,
    entry_unit,
    place_in_words,
    statement,
    suspects_of,
    unit_of,
)
from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.held_out import held_out_mismatches
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import DiscoveredLaw, VetoedName
from lab.observables.codes.density import WIDEST
from lab.observables.dataset import Dataset
from sim.camera import Side
from sim.effects.base import Effects
from sim.effects.empirical_law import PLACES, EmpiricalLaw
from sim.effects.library import effects as library
from sim.effects.library import list_changes
from sim.sensor import mosaic
from sim.spectrum import FloatArray

LEAST_WIDTH = 0.02  # of a code: a missing code's
#: Share of what the chosen table takes off chi2 from which on a shorter one that takes it off is told first.
SHORTER_SHARE = 0.9
#: The same of a curve in place of one of more numbers.
NEARLY_ALL = 0.95
#: Lines by which steps are moved to see whether they are sharp, and the most that these may gain, over the gain.
BESIDE_LINES, SHARP_SHARE = 2, 0.75
#: Least gain in chi2, and share of what a law says of captures that it wasn't taken from.
LEAST_GAIN, PREDICTED_SHARE = 4.0, 0.5
OTHER_HALF_SHARE = 0.15
LEAST_SAID = 1.0  # expected fall of chi2 below which captures say nothing of a law
MOST_BY_CODE = 4096  # entries of a table by code
#: Relative difference of even and odd lines by which its slope is found, and the chi2 from which on it is told.
PARITY, LEAST_PARITY_CHI2 = 1e-3, 9.0
MOST_LAWS = 6  # along indices, one after the other
MOST_CURVES = 2  # laws along coordinates, one after the other
#: Description length by which a form of fewer numbers may be longer and is told, and another place in the chain told
#: beside.
EQUAL_LENGTH = 6.0


def discover(
    dataset: Dataset, effects: Effects, policy: DecisionPolicy, left: Verdict | None = None
) -> tuple[PredictiveTable, ...]:
    """Find laws that hold in what they weren't taken from, the most significant first; see the package.

    `effects`: those of the baseline, and the named ones. `left`: the verdict, whose measurements are looked at along
    coordinates: those that are mismatched, or all where none is. Without, only indices are looked at.
    """
    found: list[PredictiveTable] = []
    every: list[float] = []
    named = frozenset().union(*(list_changes(effect) for effect in effects))
    while len(found) < MOST_LAWS:
        acting = (*effects, *(law_of(one, dataset) for one in found))
        looks = [look for look in index_looks(dataset, acting) if not any(_is_at(look, one.look) for one in found)]
        tables = [_fitted(look, _index_forms(look)) for look in looks]
        every = [_likeliest(own) for own in tables]
        limit = _limit(every, policy)
        beside = _of_each_place(
            one
            for one in _told(looks, tables, limit, policy)
            if not named & list_changes(law_of(one, dataset)) or _exceeds_tolerance(one, policy)
        )
        if not beside:
            break
        found.append(min(beside, key=lambda one: one.log_probability))
    if left is not None:
        found = [_with_parity(dataset, left.model, left.effects, one) for one in found]
        found += _curves(dataset, left, found, every, policy)
    return tuple(sorted(found, key=lambda one: one.log_probability))


def _with_parity(dataset: Dataset, model: MeasurementModel, effects: Effects, one: PredictiveTable) -> PredictiveTable:
    """Return a table of sensitivities by lines of a mosaic with the difference of even and odd lines that the two
    greens tell, where they do. Within a plane of the mosaic it can't be seen, as all its pixels have one parity."""
    look = one.look
    count = look.columns or one.period
    if look.stage != "charge" or mosaic.step(dataset.camera.cfa) == 1 or not one.period or count % 2 or one.form.first:
        return one
    parity = np.resize([1.0, -1.0], one.period)
    even, odd = (
        model.gaussian((*effects, law_of(replace(one, departure=one.departure + size * parity), dataset)))
        for size in (0.0, PARITY)
    )
    seen = model.seen
    slope = (odd.mean - even.mean)[seen] / PARITY
    weighted = np.linalg.solve(even.covariance[np.ix_(seen, seen)], slope)
    total = float(weighted @ slope)
    size = float(weighted @ (model.value - even.mean)[seen]) / max(total, 1e-300)
    if size**2 * total < LEAST_PARITY_CHI2:
        return one
    return replace(one, departure=one.departure + size * parity)


def _exceeds_tolerance(one: PredictiveTable, policy: DecisionPolicy) -> bool:
    """Return whether a law takes `least_discovery_share` off chi2 where a named effect acts on the same quantity: less
    may be what that effect's law lacks."""
    judge = _judge(one.look, one)
    before = judge.chi2(np.zeros(1))
    return before - judge.chi2(one.over(judge.count)) >= policy.least_discovery_share * before


def _is_at(look: Look, other: Look) -> bool:
    return (look.stage, look.along, look.of) == (other.stage, other.along, other.of)


def _told(
    looks: Sequence[Look], tables: Sequence[Sequence[Table]], limit: float, policy: DecisionPolicy
) -> Iterator[PredictiveTable]:
    """Yield of each look the law that predicts, where there is one."""
    for look, own in zip(looks, tables, strict=True):
        one = _predictive(look, [table for table in own if table.log_probability <= limit], policy)
        one = _by_code(look, one, policy) if look.stage == "codes" else one
        if one is not None:
            yield one


def _limit(log_probabilities: Sequence[float], policy: DecisionPolicy) -> float:
    """Return ln of k q / (m (1 + 1/2 + ... + 1/m)) for the largest k whose p_(k) is below (Benjamini and Yekutieli)."""
    order = np.sort(log_probabilities)
    rank = np.arange(1, len(order) + 1)
    least = np.log(rank * policy.discovery_rate / (len(order) * np.sum(1.0 / rank)))
    below = np.flatnonzero(order <= least)
    return float(least[below[-1]]) if len(below) else -np.inf


def _fitted(look: Look, forms: Iterable[Form]) -> list[Table]:
    """Return the forms fitted that have fewer numbers than a third of what they describe."""
    most = len(look.seen.residual) / 3.0
    return [fitted(look.seen, form) for form in forms if form.numbers <= most]


def _likeliest(tables: Sequence[Table]) -> float:
    return min((table.log_probability for table in tables), default=0.0)


def _index_forms(look: Look) -> Iterator[Form]:
    if look.at:
        yield from _place_forms(look)
    elif look.is_whole:
        yield from end_forms(look, entry(look))
    else:
        yield from periodic_forms(look)
        if look.stage == "codes":
            yield from upper_forms(look)
        elif not look.columns:
            yield from wave_forms(look, entry(look))
        if look.along in {"row", "column"} and look.of == "mean":
            yield from tap_forms(look, entry(look))


def _place_forms(look: Look) -> Iterator[Form]:
    x = np.array(look.at)
    if look.along == "angle":
        yield from angle_forms(x, entry(look))
    else:
        yield from curve_forms(look.seen, x, x, unit_of(look), entry(look))
        yield from formulas(look.seen, x, unit_of(look), by_inverse=False)


def _predictive(look: Look, kept: Sequence[Table], policy: DecisionPolicy) -> PredictiveTable | None:
    """Return the form of the least description length that predicts what it wasn't taken from, with a shorter one."""
    if not kept:
        return None
    length = [description_length(look.seen, table) for table in kept]
    near = [table for table, own in zip(kept, length, strict=True) if own < min(length) + EQUAL_LENGTH]
    best = min(near, key=lambda table: (table.form.numbers, description_length(look.seen, table)))
    if best.form.name == "lines":  # what rows and columns do by themselves
        return None
    judged = _judged(look, best)
    is_judged_apart = look.is_whole and look.held_out is not None
    if not _takes_enough(judged, policy) or not (is_judged_apart or _predicts_other_half(look.seen, best.form)):
        return None
    if best.form.name == "step" and not look.at and not _is_sharp(look, best):
        return None
    if not best.period:
        return judged
    shorter = (_judged(look, table) for table in kept if table.period and table.period < best.period)
    base = next((one for one in shorter if _gain(one) >= SHORTER_SHARE * _gain(judged)), None)
    return replace(judged, shorter=() if base is None else (base,))


def _gain(one: PredictiveTable) -> float:
    return one.chi2[0] - one.chi2[1]


def _takes_enough(one: PredictiveTable, policy: DecisionPolicy) -> bool:
    """Return whether it takes at least `least_discovery_share` of what isn't noise off chi2, and half of what it says
    of the captures that judge it."""
    if float(np.ptp(one.departure)) < one.look.least:
        return False
    judge = _judge(one.look, one)
    said = judge.said_by(one.over(judge.count))
    return _gain(one) >= max(policy.least_discovery_share * judge.excess, PREDICTED_SHARE * said, LEAST_GAIN)


def _smallest_cells(found: Sequence[PredictiveTable]) -> list[PredictiveTable]:
    """Return of each stage's tables by row and column that of the smallest cell that takes as much off chi2 as any, in
    what is seen of the largest one.
    """
    kept = []
    for stage in dict.fromkeys(one.look.stage for one in found if one.look.columns):
        mine = sorted(
            (one for one in found if one.look.columns and one.look.stage == stage), key=lambda one: one.period
        )
        largest = mine[-1].look
        judge = largest.held_out or largest.seen
        rows = judge.count // largest.columns
        gains = []
        for one in mine:
            cell = one.departure.reshape(-1, one.look.columns)
            repeated = np.resize(cell, (rows, one.look.columns))
            table = np.tile(repeated, (1, largest.columns // one.look.columns))
            gains.append(judge.chi2(np.zeros(1)) - judge.chi2(table.ravel()))
        kept.append(next(one for one, gain in zip(mine, gains, strict=True) if gain >= SHORTER_SHARE * max(gains)))
    return kept


def _predicts_other_half(profile: Profile, form: Form) -> bool:
    """Return whether a form fitted to each half of the index lowers chi2 of the other half by `OTHER_HALF_SHARE` of
    what it says of it: a few outlying lines don't, nor what is alike over some lines alone."""
    if form.first:
        profile = profile.part(profile.index >= form.first)
    for one, other in ((profile.low, ~profile.low), (~profile.low, profile.low)):
        table, judge = fitted(profile.part(one), form).over(profile.count), profile.part(other)
        if judge.chi2(np.zeros(1)) - judge.chi2(table) < OTHER_HALF_SHARE * judge.said_by(table):
            return form.name == "step" and not form.period and _lies_in_one_half(profile, form)
    return True


def _is_sharp(look: Look, table: Table) -> bool:
    """Return whether steps some lines aside take much less off chi2: a smooth wave's don't."""
    none, seen = look.seen.chi2(np.zeros(1)), look.seen
    gain, aside = none - seen.chi2(table.departure), BESIDE_LINES * look.step
    for move in (-aside, aside):
        moved = np.roll(table.form.basis, move, axis=0)
        moved[:aside], moved[-aside:] = 0.0, 1.0
        if none - seen.chi2(fitted(seen, replace(table.form, basis=moved)).departure) > SHARP_SHARE * gain:
            return False
    return True


def _lies_in_one_half(profile: Profile, form: Form) -> bool:
    """Return whether a step shows in residuals of one half alone: there is nothing that the other could say of it."""
    shown = np.abs(np.asarray(profile.matrix @ form.basis)).sum(axis=1)
    return bool(min(shown[profile.low].sum(), shown[~profile.low].sum()) < 0.1 * shown.sum())


def _judged(look: Look, table: Table) -> PredictiveTable:
    """Return the table with chi2 of the captures held out; of the seen ones where none are. Of images, whose patterns
    stand for the noise, it is that of the table's own numbers."""
    judge = _judge(look, table)
    chi2 = own = chi2_within(judge, table)
    if look.stage == "codes" or look.is_of_measurements:
        chi2 = judge.chi2(np.zeros(1)), judge.chi2(table.over(judge.count)), len(judge.residual)
    return PredictiveTable(look, table.form, table.departure, table.std, table.log_probability, chi2, own, table.said)


def _judge(look: Look, table: Table | PredictiveTable) -> Profile:
    """Return the captures held out, or the seen ones where a table says nothing of those."""
    held_out = look.held_out
    is_silent = held_out is None or held_out.said_by(table.over(held_out.count)) < LEAST_SAID
    return look.seen if held_out is None or is_silent else held_out


def _by_code(look: Look, periodic: PredictiveTable | None, policy: DecisionPolicy) -> PredictiveTable | None:
    """Return a table by every code where the captures held out show that widths differ beyond a period's, else that.

    The widths beyond the periodic table are normal with a variance tau^2 that is what the counts' noise doesn't explain
    (empirical Bayes): d minimises |(r - A d) / sigma|^2 + |d|^2 / tau^2. The standard deviations are those given all
    other widths. It has to take twice the standard deviation off chi2 of the captures held out, and
    `least_discovery_share` of it. Beyond `MOST_BY_CODE` codes none is made, and the periodic table says so.
    """
    if look.held_out is None:
        return periodic
    seen = look.seen
    base = np.zeros(seen.count) if periodic is None else periodic.over(seen.count)
    if int(np.ptp(seen.index)) + 1 > MOST_BY_CODE:
        return None if periodic is None else replace(periodic, remark=BEYOND_TABLE.format(most=MOST_BY_CODE))
    own = np.asarray(seen.matrix[np.arange(len(seen.index)), seen.index]).ravel()  # change by the code's own width
    left = seen.left_by(base)
    excess = float(np.mean(np.square(left / own) - seen.variance / np.square(own)))
    if excess <= 0.0:
        return periodic
    weighted = sparse.csr_array(seen.matrix / seen.variance[:, None])
    normal = sparse.csc_array(seen.matrix.T @ weighted + sparse.eye_array(seen.count) / excess)
    every = base + spsolve(normal, weighted.T @ left)
    std = 1.0 / np.sqrt(normal.diagonal())
    n = len(look.held_out.residual)
    first, before, after = (look.held_out.chi2(table) for table in (np.zeros(1), base, every))
    if before - after < max(2.0 * np.sqrt(2.0 * n), policy.least_discovery_share * before):
        return periodic
    # chi2 of what the table takes off, as of one number
    log_p = float(chi_squared.logsf(before - after, 1)) if periodic is None else periodic.log_probability
    form, chi2 = Form("by index", np.zeros((0, 0)), seen.count), (first, after, n)
    shorter = () if periodic is None else (*periodic.shorter, periodic)
    return PredictiveTable(look, form, every, std, log_p, chi2, chi2, shorter=shorter)


def _of_each_place(found: Iterable[PredictiveTable]) -> list[PredictiveTable]:
    """Return of each place in the chain the likeliest law, and cells in the place of what rows and columns do in
    them."""
    every = sorted(found, key=lambda one: one.log_probability)
    cells = _smallest_cells([one for one in every if one.look.columns])
    kept: dict[tuple[str, str, str], PredictiveTable] = {}
    for one in every:
        look = one.look
        whole = [c for c in cells if c.look.stage == look.stage and look.of == "mean" and one.period]
        periods = [c.period // c.look.columns if look.along == "row" else c.look.columns for c in whole]
        is_in_cell = look.along in {"row", "column"} and any(period % one.period == 0 for period in periods)
        if not look.columns and not is_in_cell:
            kept.setdefault((look.stage, look.along, look.of), one)
    return [*kept.values(), *cells]


# --- along coordinates -----------------------------------------------------------------------------------------------


def _curves(
    dataset: Dataset,
    left: Verdict,
    found: Sequence[PredictiveTable],
    tried: Sequence[float],
    policy: DecisionPolicy,
    most: int = MOST_CURVES,
) -> list[PredictiveTable]:
    """Find laws along coordinates of what is mismatched, the one that describes most first, and others beside it."""
    laws: list[PredictiveTable] = []
    while len(laws) < most:
        acting = (*left.effects, *(law_of(one, dataset) for one in (*found, *laws)))
        located = _located(left.model, acting, policy)
        looks = list(curve_looks(left.model, dataset, acting, located, every=not located))
        tables = [_fitted(look, _curve_forms(look)) for look in looks]
        every = [*tried, *(_likeliest(own) for own in tables)]
        limit = _limit(every, policy)
        likeliest = [
            _predictive_curve(look, [table for table in own if table.log_probability <= limit], policy)
            for look, own in zip(looks, tables, strict=True)
        ]
        candidates = [one for one in likeliest if one is not None and _beats_smooth(one, left)]
        if not candidates:
            break
        length = [description_length(one.look.seen, one) for one in candidates]
        near = [one for one, size in zip(candidates, length, strict=True) if size < min(length) + EQUAL_LENGTH]
        best = next((one for one in near if one.look.is_own_axis), candidates[int(np.argmin(length))])
        laws.append(replace(best, equal=tuple(place_in_words(one.look) for one in near if one is not best)))
    return laws


def _beats_smooth(one: PredictiveTable, left: Verdict) -> bool:
    """Return whether a law predicts the captures held out as well as the smooth discrepancies of its measurements do,
    or to their noise. What they predict better has no form.
    """
    names = one.look.shown_in
    blocks = [i for i, block in enumerate(left.model.blocks) if block.measurement.name in names]
    if not any(i in left.kernels for i in blocks):
        return True
    where = np.any([left.model.mask(i) for i in blocks], axis=0)
    smooth, n = left.model.held_out(left.effects, where, left.kernels)
    least = n + 2.0 * np.sqrt(2.0 * n) if one.form.name != "curve" else 0.0
    return one.chi2[1] <= max(smooth, least)


def _predictive_curve(look: Look, kept: Sequence[Table], policy: DecisionPolicy) -> PredictiveTable | None:
    """Return the form of the fewest numbers that predicts the captures held out nearly as well as any does.

    Where none are held out, the one of the least description length that predicts every other number from the rest.
    """
    if look.held_out is None:
        return _predictive(look, kept, policy)
    judged = [_judged(look, table) for table in kept]
    most = max((_gain(one) for one in judged), default=0.0)
    near = [one for one in judged if _gain(one) >= NEARLY_ALL * most and _takes_enough(one, policy)]
    return min(near, key=lambda one: (one.form.numbers, description_length(look.seen, one)), default=None)


def _located(model: MeasurementModel, effects: Effects, policy: DecisionPolicy) -> list[int]:
    """Return the indices of the blocks that are mismatched beside the effects, by seen or by held-out numbers."""
    slices = mismatches(model, model.gaussian(effects), policy) or held_out_mismatches(model, effects, {}, policy)
    return list(dict.fromkeys(model.blocks.index(one.block) for one in slices))


def _curve_forms(look: Look) -> Iterator[Form]:
    x = np.array(look.at)
    if look.along == "plane x time":
        yield from plane_forms(x, look.channels, entry(look))
        return
    yield from curve_forms(look.seen, x, np.array(look.known), unit_of(look), entry(look))
    yield from formulas(look.seen, x, unit_of(look), by_inverse=look.along == "wavelength")


# --- names in whose place a law stands --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Superseded:
    """A name in whose place a law stands. `names`: the effect's, or those of all effects of its family. `with_name`,
    `with_law`: chi2 of the seen and of the held-out numbers."""

    candidate: Candidate
    law: PredictiveTable
    names: tuple[str, ...]
    with_name: tuple[float, float]
    with_law: tuple[float, float]

    def told(self, side: Side, model: MeasurementModel) -> VetoedName:
        """Return it as a result."""
        name, place = self.candidate.told_name, place_in_words(self.law.look)
        return VetoedName(
            side=side,
            name=name,
            probability=self.candidate.probability,
            captures=model.captures(True),
            chi2_before=self.with_law[1],
            chi2_after=self.with_name[1],
            n=int((~model.seen).sum()),
            statement=f"{name} is not named for the {side} camera: a law of the {place} in its place takes chi2 of all "
            f"{len(model.value)} numbers from {sum(self.with_name):.0f} to {sum(self.with_law):.0f}, and that of the "
            f"held-out ones from {self.with_name[1]:.0f} to {self.with_law[1]:.0f}.",
        )


def superseded(
    dataset: Dataset, verdict: Verdict, found: Sequence[PredictiveTable], policy: DecisionPolicy
) -> dict[str, Superseded]:
    """Return the named effects in whose place a discovered law predicts more, by name.

    A law of another quantity of the chain, or of codes, supersedes a name where, in its place, chi2 of all captures is
    lower by `superseding_chi2` and twice its numbers, and that of the held-out ones isn't higher. A law of the same
    quantity is no rival of a listed one, but where it was found beside it, too, and makes it needless: the name doesn't
    take `parameter_log_odds` more off. In the place of a family, of which no law has to hold, stands a table that
    repeats, of codes, which takes as much more off as one of another quantity.
    """
    model, effects = verdict.model, verdict.effects
    lost: dict[str, Superseded] = {}
    for candidate in verdict.named:
        name, others = candidate.effect.name, tuple(e for e in effects if e is not candidate.effect)
        changed = list_changes(candidate.effect)
        rivals = [one for one in found if changed & list_changes(law_of(one, dataset))]
        if candidate.members:
            rivals = [one for one in rivals if one.look.stage == "codes" and one.period]
        if not rivals and (candidate.members or candidate.probability > policy.unrivalled_probability):
            continue
        left = replace(verdict, named=tuple(c for c in verdict.named if c is not candidate), after=(), held_out=())
        again = discover(dataset, (*model.always, *others), policy)
        beside = [one for one in again if any(_is_at(one.look, rival.look) for rival in rivals)]
        elsewhere = [] if rivals else [*again, *_curves(dataset, left, (), (), policy, most=1)]
        elsewhere = [
            one
            for one in elsewhere
            if not any(_is_at(one.look, other.look) for other in found)
            and (one.look.stage == "codes" or not changed & list_changes(law_of(one, dataset)))
        ]
        for law in (*(_with_parity(dataset, model, others, one) for one in beside), *elsewhere):
            with_law = (*others, law_of(law, dataset))
            # a law that is there anyway: the name has to earn its own number
            allowed = policy.parameter_log_odds if rivals and not candidate.members else 0.0
            least = -allowed if allowed else policy.superseding_chi2 + 2.0 * law.form.numbers
            named, instead = (_chi2_of(model, one) for one in (effects, with_law))
            if instead[1] <= named[1] + allowed and sum(instead) <= sum(named) - least:
                family = type(candidate.effect).family
                names = tuple(n for n, kind in library().items() if kind.family is family)
                lost[name] = Superseded(candidate, law, names if candidate.members else (name,), named, instead)
                break
    return lost


def _chi2_of(model: MeasurementModel, effects: Effects) -> tuple[float, float]:
    """Return chi2 of the seen numbers, and of those held out given them."""
    return model.seen_gaussian(effects).chi2(model.value[model.seen]), model.held_out(effects)[0]


# --- as a result, and as an effect ---


def told(side: Side, dataset: Dataset, found: Sequence[PredictiveTable]) -> tuple[DiscoveredLaw, ...]:
    """Put discovered laws into results: the law as it stands in a camera file, its chi2, and sentences."""
    laws = []
    for one in found:
        shortest, law = (*one.shorter, one)[0], law_of(one, dataset)
        # of a table by code, the codes that were counted
        shown = slice(law.first, law.first + len(law.table)) if shortest.form.name == "by index" else slice(None)
        laws.append(
            DiscoveredLaw(
                side=side,
                stage=law.stage,
                along=law.along,
                of=law.of,
                form=one.form.name,
                period=law.period,
                columns=law.columns,
                first=law.first,
                at=law.at,
                table=law.table,
                shown_period=shortest.period,
                shown_departure=tuple(shortest.departure[shown].tolist()),
                shown_std=tuple(shortest.std[shown].tolist()),
                chi2_before=one.chi2[0],
                chi2_after=one.chi2[1],
                n=one.chi2[2],
                own_chi2_before=one.own[0],
                own_chi2_after=one.own[1],
                own_n=one.own[2],
                measurements=tuple(sorted(one.look.shown_in)),
                suspects=suspects_of(one),
                statement=statement(side, one),
            )
        )
    return tuple(laws)


def law_of(found: PredictiveTable, dataset: Dataset) -> EmpiricalLaw:
    """Return the law as an effect that acts on its stage, in its units."""
    look, none = found.look, PLACES[found.look.stage, found.look.along, found.look.of][1]
    first, at, table = found.form.first, np.array(look.at), np.array(found.departure)
    if look.of != "mean" and none == 0.0:  # added to the read noise, of which the least entry has none
        scale = 1.0 / dataset.noise.gain**2 if look.along == "time" else dataset.camera.read_noise_e**2
        table = (table - table.min()) * scale
    elif none == 0.0 and not look.along.endswith("level") and (not look.at or entry_unit(look).startswith("DN")):
        table = table / dataset.noise.gain
    elif none == 1.0:
        table = np.maximum(1.0 + table, LEAST_WIDTH)
        if not look.at:
            table = table / table.mean()
    if look.stage == "charge" and not (look.at or found.period or found.form.name == "step"):
        at = (np.arange(len(table)) + 0.5) / len(table)
    if look.along == "frequency":
        table[0] = 1.0
    if found.form.name == "step" and not look.at:
        at, table = _corners(table)
    if found.form.name == "by index" and look.stage == "codes":
        counted = look.seen.index
        first = int(counted.min())
        moved = np.cumsum(found.departure[first : int(counted.max()) + 1])
        # what accumulates over more codes than the counts' smoothing isn't determined
        moved -= savgol_filter(moved, min(2 * WIDEST + 1, (len(moved) - 1) // 2 * 2 + 1), 2)
        table = np.maximum(1.0 + np.diff(moved, prepend=0.0), LEAST_WIDTH)
        table *= len(table) / table.sum()
    return EmpiricalLaw(
        stage=look.stage,
        along=look.along,
        of=look.of,
        period=found.period // (look.columns or 1),
        columns=look.columns,
        first=first,
        at=tuple(at.tolist()),
        table=tuple(table.tolist()),
        strength=1.0,
    )


def _corners(by_line: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners of steps by line (N,): shares of the lines, and the values there."""
    changes = np.flatnonzero(np.diff(by_line))
    lines = np.unique(np.concatenate([changes, changes + 1]))
    return (lines + 0.5) / len(by_line), by_line[lines]
