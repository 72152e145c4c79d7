"""Where recordings depart from the empty set, for the pictures; goodness of fit of each measurement, curves, and the
smallest detectable magnitude of each effect.

The predictive distribution of the empty set has theta and the everyday small physics marginalised. Significances are
corrected for the number of places (Bonferroni)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from lab.diagnose.evidence.causes import SHOWN_CHI2, SHOWN_SHARE, Cause, shown_in
from lab.diagnose.evidence.side_table import SideTable, posterior_means
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.places import Slice, describe, log_tail, slices_of
from lab.diagnose.outcome.detectability import detectable, smallest_sizes, told_as
from lab.diagnose.outcome.residual_curves import curves_of
from lab.formats.results import (
    ExaminedPlace,
    HeldOut,
    MeasurementFit,
    Mismatch,
    ResidualCurve,
    Unexplained,
    Unlisted,
    Visibility,
)
from lab.inference.check import RATE as HELD_OUT_RATE
from lab.inference.check import HeldOutCheck
from lab.inference.posterior import LIKELIER, NAMED
from lab.inference.search import FittedSet
from lab.observables.gaussian import Gaussian, chi2
from lab.observables.observable import Observable
from sim.effects.base import Effect
from sim.effects.library import effects as library
from sim.spectrum import FloatArray

#: Probability, corrected for the number of places, below which a place is a mismatch: that of the held-out check.
PLACE_RATE = HELD_OUT_RATE
#: Probability at which the smallest detectable magnitude is stated.
DETECTION = 0.9
#: From this probability on a state is listed as one on which something unlisted may act.
LEAST_UNLISTED = 0.05
#: Words for a mismatch that no part of a measurement shows by itself.
WHOLE_AXIS = "along the whole axis"
#: Families and effects that are told as the likeliest where none has a name.
LIKELIEST = 3


def examine_places(model: MeasurementModel, gaussian: Gaussian) -> list[Slice]:
    """Return every part of every measurement with its chi2 under a distribution of the used numbers, most significant
    first."""
    residual, covariance = model.value - gaussian.mean, gaussian.covariance
    parts = slices_of(model)
    found = []
    for block, axis, where, members in parts:
        value = chi2(residual[members], covariance[np.ix_(members, members)])
        log_p = min(log_tail(value, len(members)) + np.log(len(parts)), 0.0)
        found.append(Slice(block, axis, where, members, value, len(members), log_p))
    return sorted(found, key=lambda part: part.log_probability)


def examined(reading: SideTable, before: Sequence[Slice], after: Gaussian) -> Iterator[ExaminedPlace]:
    """Yield every place, under the empty set and under the improved one."""
    by_place = {(id(s.block), s.axis, s.where): s for s in examine_places(reading.used, after)}
    for one in before:
        now = by_place[id(one.block), one.axis, one.where]
        yield ExaminedPlace(
            side=reading.side, measurement=one.block.measurement.name, axis=one.axis, where=one.where, n=one.n,
            chi2_before=one.chi2, chi2_after=now.chi2, sigma_before=round(one.significance_sigma, 2),
            sigma_after=round(now.significance_sigma, 2),
        )  # fmt: skip


def mismatches_of(reading: SideTable, before: Sequence[Slice], named: Sequence[Cause]) -> list[Mismatch]:
    """Return the most significant place of every measurement that departs from the empty set, in the used captures or
    in those that are held out; and where a name stands that no place shows by itself, the measurement that it changes
    most, with the significance sqrt(2 ln(posterior odds / prior odds))."""
    found: dict[str, Mismatch] = {}
    for part in before:
        name = part.block.measurement.name
        if name in found or part.log_probability >= np.log(PLACE_RATE):
            continue
        where, captures = describe(reading.used, reading.baseline, part)
        found[name] = Mismatch(
            side=reading.side, measurement=name, axis=part.axis, where=where,
            significance_sigma=round(part.significance_sigma, 2), captures=captures,
        )  # fmt: skip
    for cause in named:
        if cause.shown_in and not set(cause.shown_in) & set(found):
            block = next(b for b in reading.used.blocks if b.measurement.name == cause.shown_in[0])
            found[block.measurement.name] = Mismatch(
                side=reading.side, measurement=block.measurement.name, axis=block.measurement.axis,
                where=f"{WHOLE_AXIS}, as {cause.name}", significance_sigma=round(_significance(cause), 2),
                captures=_captures(block),
            )  # fmt: skip
    if not found and reading.posterior.nothing <= reading.least_nothing:
        found |= _by_evidence_alone(reading)
    for check in reading.checked:
        if check.contradicts and check.measurement not in found:
            block = next(b for b in reading.problem.held_out if b.measurement.name == check.measurement)
            found[check.measurement] = Mismatch(
                side=reading.side, measurement=check.measurement, axis=block.measurement.axis,
                where="in held-out captures", significance_sigma=round(_sigma(check), 2), captures=_captures(block),
            )  # fmt: skip
    return list(found.values())


def _by_evidence_alone(reading: SideTable) -> dict[str, Mismatch]:
    """Return the measurement that the likeliest effect changes most, where something acts and no place shows it by
    itself; with the significance of anything acting."""
    row = next((r for r in reading.table.rows if r.members and r.refitted), None)
    if row is None:
        return {}
    effects = reading.effects_of(reading.table.fits[row.members].state)
    shown = [name for effect in effects for name in shown_in(reading.used, effect, effects)]
    if not shown:
        return {}
    block = next(b for b in reading.used.blocks if b.measurement.name == shown[0])
    prior = reading.search.prior.number[0] * (1.0 - reading.search.any_unlisted)
    return {
        shown[0]: Mismatch(
            side=reading.side, measurement=shown[0], axis=block.measurement.axis, where=WHOLE_AXIS,
            significance_sigma=round(_gaussian_sigma(1.0 - reading.posterior.nothing, 1.0 - prior), 2),
            captures=_captures(block),
        )
    }  # fmt: skip


def _significance(cause: Cause) -> float:
    return _gaussian_sigma(cause.probability, cause.prior)


def _gaussian_sigma(posterior: float, prior: float) -> float:
    """sqrt(2 ln B), B the Bayes factor: posterior odds over prior odds."""
    p = min(posterior, 1.0 - 1e-12)
    factor = np.log(p / (1.0 - p)) - np.log(prior / (1.0 - prior))
    return float(np.sqrt(max(2.0 * factor, 0.0)))


def _sigma(check: HeldOutCheck) -> float:
    return float(max(-special.ndtri(max(check.p, 1e-300)), 0.0))


def _captures(block: Observable) -> tuple[str, ...]:
    return tuple(sorted({name for label in block.labels for name in label.captures}))


# --- what has no name -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _UnlistedChange:
    """Unlisted physics, under the likeliest set that holds it: what it changes of the used numbers (n,), without and
    with it."""

    change: FloatArray
    before: Gaussian
    after: Gaussian


def _unlisted_change(reading: SideTable, state: str) -> _UnlistedChange | None:
    groups = reading.table.groups_on(state)
    row = max(
        (r for r in reading.table.rows if groups & r.unlisted and r.refitted), key=lambda r: r.probability, default=None
    )
    if row is None:
        return None
    fit = reading.table.fits[row.members].given(row.unlisted)
    before, after = (reading.gaussian(fit, unlisted) for unlisted in (row.unlisted - groups, row.unlisted))
    tau = fit.likeliest.scales.mode(row.unlisted)
    columns = np.column_stack([tau[g] * reading.problem.groups[g].columns for g in groups & row.unlisted])
    change = columns @ (columns.T @ after.solve(reading.used.value - after.mean))
    return _UnlistedChange(change, before, after)


def unlisted_of(reading: SideTable) -> tuple[list[Unlisted], list[Unexplained]]:
    """Return the states on which unlisted physics may act; and those on which it acts more likely than not, as
    mismatches without a name."""
    listed, left = [], []
    for finding in reading.posterior.findings:
        if finding.kind != "unlisted" or finding.probability < LEAST_UNLISTED:
            continue
        departure = _unlisted_change(reading, finding.name)
        blocks = [] if departure is None else _changed(reading.used, departure.change)
        where = "" if departure is None or not blocks else _range(reading.used, blocks[0], departure.change)
        listed.append(
            Unlisted(
                side=reading.side, state=finding.name, probability=round(finding.probability, 6), where=where,
                measurements=tuple(reading.used.blocks[k].measurement.name for k in blocks),
            )
        )  # fmt: skip
        if finding.probability >= LIKELIER and departure is not None and blocks:
            left.append(_without_name(reading, finding.name, finding.probability, departure, blocks[0], where))
    return listed, left


def _changed(model: MeasurementModel, change: FloatArray) -> list[int]:
    """Return the blocks that a change (n,) shows in, strongest first; only the strongest, where none stands out."""
    size = {
        k: float(np.sum(np.square(change[at]) / np.diag(model.blocks[k].covariance)))
        for k, at in enumerate(model.slices)
    }
    strongest = sorted(size, key=lambda k: -size[k])
    least = max(SHOWN_CHI2, SHOWN_SHARE * size[strongest[0]])
    return [k for k in strongest if size[k] > least] or strongest[:1]


def _range(model: MeasurementModel, index: int, change: FloatArray) -> str:
    """Return the part of a block in which a change is at least half of its largest, in words."""
    block, at = model.blocks[index], model.slices[index]
    size = np.abs(change[at]) / np.sqrt(np.diag(block.covariance))
    strong = size >= 0.5 * float(size.max())
    labels = [label for label, counts in zip(block.labels, strong, strict=True) if counts]
    if block.measurement.places:
        names = list(dict.fromkeys(label.condition for label in labels))
        return f"{block.measurement.places}: {', '.join(names[:LIKELIEST])}{' and others' * (len(names) > LIKELIEST)}"
    x = [label.x for label in labels]
    return f"{min(x):.4g}..{max(x):.4g} {block.measurement.unit}"


def _without_name(
    reading: SideTable, state: str, probability: float, departure: _UnlistedChange, index: int, where: str
) -> Unexplained:
    block, at = reading.used.blocks[index], reading.used.slices[index]
    of = np.arange(at.start, at.stop)
    residual = reading.used.value
    before, after = (
        chi2((residual - g.mean)[of], g.covariance[np.ix_(of, of)]) for g in (departure.before, departure.after)
    )
    parts = [s for s in examine_places(reading.used, departure.before) if s.block is block]
    return Unexplained(
        side=reading.side, measurement=block.measurement.name, axis=block.measurement.axis, where=where,
        shape=f"unlisted physics acts on the {state}, with probability {probability:.3f}",
        significance_sigma=round(parts[0].significance_sigma, 2), chi2_before=before, chi2_after=after, n=len(of),
        captures=_captures(block),
    )  # fmt: skip


def contradicted(reading: SideTable) -> Iterator[Unexplained]:
    """Yield the measurements of which held-out captures contradict the prediction of the whole table."""
    for check in reading.checked:
        if check.contradicts:
            block = next(b for b in reading.problem.held_out if b.measurement.name == check.measurement)
            yield Unexplained(
                side=reading.side, measurement=check.measurement, axis=block.measurement.axis,
                where="in held-out captures", shape="held-out captures contradict the prediction of the whole table",
                significance_sigma=round(_sigma(check), 2), chi2_before=check.chi2, chi2_after=check.chi2, n=check.n,
                captures=_captures(block),
            )  # fmt: skip


def unresolved(reading: SideTable, before: Sequence[Slice], mismatches: Sequence[Mismatch]) -> Iterator[Unexplained]:
    """Yield the mismatches of a side on which nothing reaches the threshold of a name and nothing unlisted is likelier
    than not: each with the likeliest causes."""
    causes = [f for f in reading.posterior.findings if f.kind in ("effect", "family")]
    likeliest = ", ".join(f"{f.name.replace('_', ' ')} {f.probability:.2f}" for f in causes[:LIKELIEST])
    for one in mismatches:
        part = next((s for s in before if s.block.measurement.name == one.measurement), None)
        if part is None or one.where == "in held-out captures":
            continue
        yield Unexplained(
            side=reading.side, measurement=one.measurement, axis=one.axis, where=one.where,
            shape=f"no cause reaches a probability of {NAMED:g}; the likeliest: {likeliest}",
            significance_sigma=one.significance_sigma, chi2_before=part.chi2, chi2_after=part.chi2, n=part.n,
            captures=one.captures,
        )  # fmt: skip


# --- goodness of fit --------------------------------------------------------------------------------------------------


def held_out_of(reading: SideTable) -> HeldOut | None:
    """Return chi2 of all held-out captures: by the baseline, and by the whole table."""
    if not reading.checked:
        return None
    return HeldOut(
        captures=tuple(sorted({name for b in reading.problem.held_out for name in _captures(b)})),
        chi2_before=sum(c.chi2 for c in reading.unchanged),
        chi2_after=sum(c.chi2 for c in reading.checked),
        n=sum(c.n for c in reading.checked),
    )


def measurement_fits(reading: SideTable, after: Gaussian) -> Iterator[MeasurementFit]:
    """Yield chi2 of every measurement: of its used numbers under the empty set and the improved one; of its held-out
    ones given the used, by the baseline and by the whole table."""
    model = reading.used
    held_before = {c.measurement: c for c in reading.unchanged}
    held_after = {c.measurement: c for c in reading.checked}

    def of_block(gaussian: Gaussian, index: int) -> float:
        at = model.slices[index]
        return chi2((model.value - gaussian.mean)[at], gaussian.block_covariance(index))

    for index, block in enumerate(model.blocks):
        name = block.measurement.name
        told = held_after.get(name)
        yield MeasurementFit(
            side=reading.side, measurement=name, n=len(block.value), chi2_before=of_block(reading.baseline, index),
            chi2_after=of_block(after, index), held_out_n=told.n if told is not None else 0,
            held_out_before=held_before[name].chi2 if name in held_before else 0.0,
            held_out_after=told.chi2 if told is not None else 0.0,
        )  # fmt: skip


def residual_curves(reading: SideTable, fit: FittedSet, unlisted: frozenset[int]) -> Iterator[ResidualCurve]:
    """Yield curves of every measurement by condition and channel, used and held out apart: measured, and predicted
    without and with the effects of a set.

    Before is the camera without the effects at the nuisance parameters that were found with them. Those that only
    held-out captures have (a chart's light) are fitted to these."""
    model = reading.whole
    effects = reading.effects_of(fit.state)
    tau = fit.likeliest.scales.mode(unlisted)
    none = np.zeros((0, 0))
    columns = [
        t * np.vstack([g.columns, g.held_out if g.held_out is not None else none.reshape(0, g.columns.shape[1])])
        for g, t in zip(reading.problem.groups, tau, strict=True)
        if t > 0.0
    ]
    disturbances = np.column_stack([np.zeros((len(model.value), 0)), *columns])
    estimates, change = posterior_means(model, effects, disturbances)
    jacobian = model.nuisance_jacobian(effects)
    after = model.mean(effects) + sum(estimates[name] * column for name, column in jacobian.items()) + change
    estimates |= _of_held_out_alone(model, model.value - after, jacobian)
    after = after + sum(estimates[name] * column for name, column in jacobian.items() if name.startswith("held out: "))
    before = model.stated_mean(estimates)
    yield from curves_of(model, reading.side, before, after, held_out_apart=False)


def _of_held_out_alone(
    model: MeasurementModel, residual: FloatArray, jacobian: dict[str, FloatArray]
) -> dict[str, float]:
    """Return the nuisance parameters that only held-out captures have, by the residuals (n,) of these, block by
    block."""
    found: dict[str, float] = {}
    for index, (block, at) in enumerate(zip(model.blocks, model.slices, strict=True)):
        own = {n: c[at] for n, c in jacobian.items() if n.startswith("held out: ") and c[at].any()}
        if not own or not model.mask(index)[~model.seen].any():
            continue
        table = np.column_stack(list(own.values()))
        weighted = np.linalg.solve(block.covariance, np.column_stack([table, residual[at]]))
        inner = np.eye(len(own)) + table.T @ weighted[:, :-1]
        found |= dict(zip(own, np.linalg.solve(inner, table.T @ weighted[:, -1]).tolist(), strict=True))
    return found


# --- the smallest detectable magnitude of each effect -----------------------------------------------------------------


def detectability(reading: SideTable) -> Iterator[Visibility]:
    """Yield for every effect that these recordings can show the least size of each parameter that would be named with
    a probability of 90 %, and the effect of the most similar signature.

    A size c with the normal prior N(0, s^2) and the precision r has ln B = z^2/2 r s^2 / (1 + r s^2) - 1/2 ln(1 + r
    s^2). With q the threshold of a name, p the prior probability, z^2 has to exceed about

        2 ln(q / (1 - q)) - 2 ln(p / (1 - p)) + ln(1 + r s^2)."""
    model = reading.used
    base = model.mean()
    columns: dict[str, list[tuple[tuple[Effect, ...], FloatArray]]] = {}
    scale: dict[str, float] = {}
    for name, hypothesis in reading.search.hypotheses.items():
        if name in reading.statements:  # a wrong statement has no size from which on it would show
            continue
        for alternative in hypothesis.alternatives:
            effects = tuple(point.template for point in alternative.points)
            white = reading.baseline.whiten(np.column_stack([model.mean((e,)) - base for e in effects]))
            columns.setdefault(name, []).append((effects, white))
            strength = float(np.linalg.norm(white, axis=0).max() * max(alternative.scales))
            scale[name] = max(scale.get(name, 0.0), strength)
    unit = {
        name: np.concatenate([t / np.maximum(np.linalg.norm(t, axis=0), 1e-300) for _, t in members], axis=1)
        for name, members in columns.items()
    }
    for name, members in columns.items():
        prior = reading.inclusion_prior[name]
        threshold = 2.0 * (np.log(NAMED / (1.0 - NAMED)) - np.log(prior / (1.0 - prior))) + np.log1p(scale[name] ** 2)
        needed = detectable(float(threshold), DETECTION)
        cosines = {other: float(np.abs(unit[name].T @ unit[other]).max()) for other in unit if other != name}
        nearest = max(cosines, key=lambda other: cosines[other], default=None)
        cosine = min(cosines[nearest], 1.0) if nearest is not None else 0.0
        sizes = smallest_sizes(library()[name], members, needed)
        yield Visibility(
            side=reading.side, effect=name, nearest=nearest, cosine=cosine,
            smallest={
                told_as(field, library()[name].quantities()[field], gain_is_known=model.gain_is_known)[0]: size
                for field, size in sizes.items()
            },
            told_apart=float(special.ndtr(0.5 * np.sqrt(needed * (1.0 - cosine**2)))),
        )  # fmt: skip
