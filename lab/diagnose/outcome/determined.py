"""Combinations of parameters that the recordings determine, where they don't determine each parameter by itself.

With C the posterior covariance of an effect's coordinates u (k, k) and Q = C^-1, coordinates whose partial correlations
-Q_ij / sqrt(Q_ii Q_jj) are near 1 can't be told apart. Of such a group the eigenvector e of the correlation matrix with
the smallest eigenvalue l is the direction in which the recordings tell most: w . u, w_i = e_i / sigma_i, has the
standard deviation sqrt(l), where each u_i has sigma_i (Jolliffe, Principal Component Analysis, 2002, chapter 8).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.diagnose.outcome.detectability import told_as
from lab.formats.results import Combination
from sim.camera import Side
from sim.parameters import Quantity
from sim.spectrum import FloatArray

#: Partial correlation of two coordinates from which they can't be told apart: each alone then has more than twice the
#: standard deviation that it has where the other is known, 1 / sqrt(1 - 0.9^2) = 2.3.
APART = 0.9
#: Half the width of an interval of 95 %, and distance from absence from which a combination is determined, in standard
#: deviations.
NORMAL_95, DETERMINED_SIGMA = 1.96, 3.0


@dataclass(frozen=True)
class Direction:
    """A determined combination: sum of `weights` times the coordinates `members` less their values in absence.

    weights : (k,), the first of them 1; its unit is that of the first coordinate
    """

    members: tuple[int, ...]
    weights: FloatArray
    value: float
    std: float


def determined_directions(from_absence: FloatArray, covariance: FloatArray) -> list[Direction]:
    """Return the combination that each group of coordinates determines, where one of its members isn't determined by
    itself.

    from_absence : coordinates less their values in absence (k,)
    covariance : theirs (k, k)

    A member isn't determined where its interval of 95 % holds absence. A combination within `DETERMINED_SIGMA` of
    absence isn't returned: nothing of the group is determined then.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    used = np.flatnonzero(std > 0.0)
    if len(used) < 2:
        return []
    correlation = covariance[np.ix_(used, used)] / np.outer(std[used], std[used])
    found = []
    for group in _groups(correlation):
        members = used[group]
        if all(abs(from_absence[members]) >= NORMAL_95 * std[members]):
            continue
        size, axes = np.linalg.eigh(correlation[np.ix_(group, group)])
        weights = axes[:, 0] / std[members]
        first = int(np.argmax(np.abs(weights * from_absence[members])))
        order = [first, *(k for k in range(len(members)) if k != first)]
        weights, spread = weights[order] / weights[first], np.sqrt(max(size[0], 0.0)) / abs(weights[first])
        value = float(weights @ from_absence[members[order]])
        if abs(value) >= DETERMINED_SIGMA * spread:
            found.append(Direction(tuple(int(m) for m in members[order]), weights, value, float(spread)))
    return found


def _groups(correlation: FloatArray) -> list[list[int]]:
    """Return the groups of coordinates, two at least, that can't be told apart."""
    precision = np.linalg.pinv(correlation, hermitian=True)
    size = np.sqrt(np.maximum(np.diag(precision), 1e-300))
    linked = np.abs(precision) / np.outer(size, size) >= APART
    groups: list[set[int]] = []
    for k in range(len(correlation)):
        own = {int(one) for one in np.flatnonzero(linked[k])} | {k}
        for other in [one for one in groups if one & own]:
            own |= other
            groups.remove(other)
        groups.append(own)
    return [sorted(one) for one in groups if len(one) > 1]


def combinations(
    side: Side,
    parameters: Sequence[tuple[str, Quantity]],
    from_absence: FloatArray,
    covariance: FloatArray,
    *,
    gain_is_known: bool,
) -> tuple[Combination, ...]:
    """Return what the recordings determine of an effect's sizes, where they can't tell these apart.

    parameters : name and declaration of each coordinate
    from_absence : the coordinates less their values in absence (k,)
    covariance : theirs (k, k)
    """
    found = []
    for power in sorted({int(q.linear_power) for _, q in parameters if not q.logarithmic}):
        own = [k for k, (_, q) in enumerate(parameters) if q.linear_power == power and not q.logarithmic]
        for one in determined_directions(from_absence[own], covariance[np.ix_(own, own)]):
            told = [told_as(*parameters[own[k]], gain_is_known=gain_is_known) for k in one.members]
            found.append(
                Combination(
                    side=side,
                    parameters=tuple(name for name, _ in told),
                    weights=tuple(one.weights.tolist()),
                    power=power,
                    value=one.value,
                    std=one.std,
                    unit=_raised(told[0][1], power),
                )
            )
    return tuple(found)


def _raised(unit: str, power: int) -> str:
    """Return a unit to a power: `um^2`."""
    return unit if power == 1 or unit == "1" else f"{unit}^{power}" if unit.isalpha() else f"({unit})^{power}"


def is_determined(value: float, absent: float, std: float | None, interval: tuple[float, float] | None) -> bool:
    """Return whether a parameter's interval of 95 % leaves out the value at which its effect is absent."""
    if interval is not None:
        return not interval[0] <= absent <= interval[1]
    return std is None or abs(value - absent) >= NORMAL_95 * std
