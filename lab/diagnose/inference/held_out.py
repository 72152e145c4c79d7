"""The veto of held-out captures: they take no part in the choice, but a name, a discrepancy or a silence that they
contradict isn't given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lab.diagnose.inference.discrepancy import predictive_discrepancy
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.places import Slice, log_tail
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.policy import DecisionPolicy
from lab.observables.gaussian import ROUNDING, chi2, conditional
from sim.effects.base import Effects
from sim.spectrum import FloatArray


@dataclass(frozen=True)
class VetoedCandidate:
    """A candidate whose name the held-out captures contradict: their chi2 without and with it, over n numbers of these
    captures."""

    candidate: Candidate
    chi2_without: float
    chi2_with: float
    n: int
    captures: tuple[str, ...]


def held_out_residual(
    model: MeasurementModel, effects: Effects = (), kernels: Mapping[int, FloatArray] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Residual (k,) and covariance (k, k) of the k held-out numbers given all seen ones. Discrepancies enter by their
    posterior means
    alone: a larger variance gains nothing."""
    seen = model.seen
    gaussian = model.gaussian(effects)
    residual = model.value - gaussian.mean - model.discrepancy_mean(effects, kernels or {})
    if seen.all():
        return np.zeros(0), np.zeros((0, 0))
    left, covariance = conditional(residual, gaussian.covariance, ~seen, seen)
    # numbers that the seen ones fix to the last digit have a variance of rounding, which may be negative
    covariance = 0.5 * (covariance + covariance.T)
    covariance += np.diag(ROUNDING * np.diag(gaussian.covariance)[~seen])
    return left, covariance


def held_out_mismatches(
    model: MeasurementModel, effects: Effects, kernels: Mapping[int, FloatArray], policy: DecisionPolicy
) -> tuple[Slice, ...]:
    """Measurements whose held-out numbers contradict the model, most significant first.

    chi2 of a measurement's k held-out numbers given all seen ones, form tolerances of the effects in the covariance,
    over (1 + `covariance_slack`)^2 is chi2_k. A measurement contradicts where P(chi2_k > chi2), times the number of
    measurements, is below `held_out_false_alarm_rate`.
    """
    left, covariance = held_out_residual(model, effects, kernels)
    out = np.flatnonzero(~model.seen)
    found = []
    for block, at in zip(model.blocks, model.slices, strict=True):
        inside = (out >= at.start) & (out < at.stop)
        if inside.any():
            value = chi2(left[inside], covariance[np.ix_(inside, inside)]) / (1.0 + policy.covariance_slack) ** 2
            found.append((block, out[inside], value))
    slices = []
    for block, members, value in found:
        log_p = min(log_tail(value, len(members)) + float(np.log(len(found))), 0.0)
        if log_p < np.log(policy.held_out_false_alarm_rate):
            axis = block.measurement.axis
            slices.append(Slice(block, axis, "held-out captures", members, value, len(members), log_p))
    return tuple(sorted(slices, key=lambda s: s.log_probability))


def predicts_held_out(model: MeasurementModel, effects: Effects, index: int, kernel: FloatArray) -> bool:
    """Return whether a discrepancy lowers the held-out chi2 of its measurement; True where nothing of it is held
    out."""
    where = model.mask(index)
    before, n = model.held_out(effects, where)
    after, _ = model.held_out(effects, where, {index: kernel})
    return n == 0 or after < before


def _kernels(
    model: MeasurementModel, effects: Effects, blocks: Sequence[int], policy: DecisionPolicy
) -> dict[int, FloatArray]:
    """Kernels of the discrepancies that predict held-out captures beside the effects, by block."""
    gaussian = model.seen_gaussian(effects)
    found = {i: predictive_discrepancy(model, gaussian, i, policy) for i in blocks}
    return {i: d.kernel for i, d in found.items() if d.log_odds > 0 and predicts_held_out(model, effects, i, d.kernel)}


def vetoed(
    model: MeasurementModel, candidate: Candidate, effects: Effects, without: Effects, policy: DecisionPolicy
) -> VetoedCandidate | None:
    """Return the veto of held-out numbers on a name, or None. `effects`: the named set; `without`: the set fitted
    without the candidate.

    Let w be the difference of both sets' predictions in standard deviations of the held-out numbers, lambda = |w|^2. If
    the name is right, chi2 rises by it by 2 w.e - lambda, with e normal of variance 1 + lambda / G along w, where G = 2
    `log_odds` is what the parameters' uncertainty follows from. For a quantile z of that, the rise is z^2 (1 + lambda /
    G) at most, whatever lambda. Where neither set describes the held-out numbers, the noise is as much larger as they
    show: the lesser chi2 over their number.

    The nearest law of a family stands in the improved model with a discrepancy beside it, and without the name a
    discrepancy stands alone: these are compared.
    """
    where = model.affected(type(candidate.effect))
    beside: dict[int, FloatArray] = {}
    alone: dict[int, FloatArray] = {}
    if candidate.holds_a_remainder:
        blocks = model.affected_blocks(candidate.effect)
        beside, alone = (_kernels(model, each, blocks, policy) for each in (effects, without))
    before, n = model.held_out(without, where, alone)
    after, _ = model.held_out(effects, where, beside)
    if n == 0 or after <= before:
        return None
    chosen = where[~model.seen]
    one, covariance = held_out_residual(model, effects, beside)
    other, _ = held_out_residual(model, without, alone)
    difference = (one - other)[chosen]
    size = chi2(difference, covariance[np.ix_(chosen, chosen)])
    uncertain = 1.0 + size / max(2.0 * candidate.log_odds, 1.0)
    noise = (1.0 + policy.covariance_slack) ** 2 * max(1.0, before / n)
    if after - before <= policy.held_out_veto_sigma**2 * uncertain * noise:
        return None
    return VetoedCandidate(candidate, before, after, n, model.captures(True, where))
