"""Captures whose level isn't that of what is stated of them: a factor on the light of single captures (data snooping,
Baarda 1968)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, chdtri

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from lab.observables.observable import Observable
from sim.effects.base import Effects
from sim.spectrum import FloatArray
from sim.uniform import LEVEL


@dataclass(frozen=True)
class OutlyingLevel:
    """Captures of one setting whose numbers fit `factor` times the stated exposure, or light."""

    captures: tuple[str, ...]
    factor: float
    factor_std: float


def outlying_levels(
    model: MeasurementModel, index: int, effects: Effects, policy: DecisionPolicy
) -> tuple[OutlyingLevel, ...]:
    """Captures of one measurement of levels, seen or held out, by whose factors alone it agrees with the model; none
    where it doesn't.

    With d_c the signal of a capture's numbers, 0 elsewhere, the factor of capture c gains (d_c' C^-1 r)^2 / (d_c' C^-1
    d_c) in chi2. The best capture is taken while its gain is above the chi2_1 quantile of `slice_false_alarm_rate` over
    the number of captures, all factors fitted again each time.
    """
    block, at = model.blocks[index], model.slices[index]
    if not block.reads >= LEVEL or block.measurement.places:
        return ()
    captures = list(dict.fromkeys(label.captures for label in block.labels))
    column = np.zeros((len(model.value), len(captures)))
    for i, label in enumerate(block.labels):
        column[at.start + i, captures.index(label.captures)] = block.scale[i]
    gaussian = model.gaussian(effects)
    solved = gaussian.solve(np.column_stack([model.value - gaussian.mean, column]))
    normal, right = column.T @ solved[:, 1:], column.T @ solved[:, 0]
    slack = (1.0 + policy.covariance_slack) ** 2
    least = slack * float(chdtri(1, policy.slice_false_alarm_rate / len(captures)))
    chosen: list[int] = []
    while True:
        rest = [i for i in range(len(captures)) if i not in chosen]
        inner = np.linalg.solve(normal[np.ix_(chosen, chosen)], normal[np.ix_(chosen, rest)])
        left = right[rest] - inner.T @ right[chosen]
        size = np.diag(normal)[rest] - np.sum(normal[np.ix_(chosen, rest)] * inner, axis=0)
        gain = np.square(left) / np.maximum(size, 1e-9 * np.diag(normal)[rest])
        if gain.max() < least:
            break
        chosen.append(rest[int(np.argmax(gain))])
        if len(chosen) > policy.most_outlying_share * len(captures):
            return ()
    if not chosen:
        return ()
    covariance = np.linalg.inv(normal[np.ix_(chosen, chosen)])
    shift = covariance @ right[chosen]
    if not _agrees(model, effects, index, column[:, chosen] @ shift, len(chosen), policy):
        return ()
    # the measured signal is the factor times what is predicted: shift = 1 - 1 / factor
    factor = 1.0 / (1.0 - shift)
    std = np.sqrt(np.diag(covariance)) * factor**2
    return _by_setting(block, [captures[i] for i in chosen], factor, std, policy.alike_outlying_sigma)


def freed(model: MeasurementModel, outlying: Mapping[int, Sequence[OutlyingLevel]]) -> MeasurementModel:
    """Return the model with the light of outlying captures as nuisance parameters: what is stated of these moves
    nothing that other measurements share with them, as the black level. `outlying`: by block."""
    if not outlying:
        return model
    columns = dict(model.unstated_jacobian)
    for index, levels in outlying.items():
        block, at = model.blocks[index], model.slices[index]
        for level in levels:
            mine = np.array([set(label.captures) <= set(level.captures) for label in block.labels])
            column = np.zeros(len(model.value))
            column[at] = np.where(mine, block.scale, 0.0)
            columns[f"outlying:{index}:{level.captures[0]}"] = column
    return replace(model, unstated_jacobian=columns, _covariances={})


def _agrees(
    model: MeasurementModel, effects: Effects, index: int, moved: FloatArray, freed: int, policy: DecisionPolicy
) -> bool:
    """Return whether the measurement's numbers agree with the model once the outlying ones are `moved`."""
    mine = model.mask(index)
    value = model.value - moved
    both, others = (
        model.gaussian(effects, where).chi2(value[where]) if where.any() else 0.0
        for where in (model.seen | mine, model.seen & ~mine)
    )
    left = (both - others) / (1.0 + policy.covariance_slack) ** 2
    return float(chdtrc(max(int(mine.sum()) - freed, 1), left)) > policy.slice_false_alarm_rate


def _by_setting(
    block: Observable, captures: list[tuple[str, ...]], factor: FloatArray, std: FloatArray, alike_sigma: float
) -> tuple[OutlyingLevel, ...]:
    """Return captures of one setting whose factors agree within `alike_sigma`, together, with their weighted mean."""
    setting = {label.captures: label.condition for label in block.labels}
    groups: list[list[int]] = []
    for i, names in enumerate(captures):
        for group in groups:
            j = group[0]
            alike = abs(factor[i] - factor[j]) < alike_sigma * float(np.hypot(std[i], std[j]))
            if alike and setting[names] == setting[captures[j]]:
                group.append(i)
                break
        else:
            groups.append([i])
    found = []
    for group in groups:
        weight = 1.0 / np.square(std[group])
        mean = float(np.sum(weight * factor[group]) / weight.sum())
        names = tuple(sorted({name for i in group for name in captures[i]}))
        # factors share the other captures' uncertainty: the largest is no less than the mean's
        found.append(OutlyingLevel(names, mean, float(np.max(std[group]))))
    return tuple(found)
