"""Causes that must show in means can't be told from variances alone.

A variance follows from the slope of the response at the mean level (v = K (dy/de)^2 e), so that a law which changes it
through a quantity that mean levels depend on changes these, too. Its evidence in means may be weak, or missing because
no level's light is stated; then other causes, and errors of the variances, look like it.
"""

from __future__ import annotations

import numpy as np

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from sim.effects.base import Effect, Effects
from sim.effects.library import may_change
from sim.uniform import LEVEL


def must_show_in_means(model: MeasurementModel, kind: type[Effect]) -> bool:
    """Return whether an effect changes variances that were measured, and each only through quantities that mean levels
    depend on."""
    shared = [b.reads & may_change(kind) for b in model.blocks if b.measurement.of_variances and b.touched_by(kind)]
    return bool(shared) and all(quantities <= LEVEL for quantities in shared)


def is_judged_in_means(model: MeasurementModel, kind: type[Effect]) -> bool:
    """Return whether a measurement other than of variances tells of the effect."""
    return any(not b.measurement.of_variances and b.touched_by(kind) for b in model.blocks)


def shown_in_means(
    model: MeasurementModel, effect: Effect, effects: Effects, without: Effects, policy: DecisionPolicy
) -> bool:
    """Return whether the seen numbers that aren't variances are likelier with an effect, by `least_means_log_odds`,
    where it must show in them.

    `effects`: the fitted set; `without`: the set fitted without the effect. True for effects that needn't show in
    means."""
    if not must_show_in_means(model, type(effect)):
        return True
    if not is_judged_in_means(model, type(effect)):
        return False
    of_means = np.concatenate([np.full(len(b.value), not b.measurement.of_variances) for b in model.blocks])
    where = of_means & model.seen
    with_it, without_it = (model.gaussian(one, where).log_likelihood(model.value[where]) for one in (effects, without))
    return with_it - without_it >= policy.least_means_log_odds
