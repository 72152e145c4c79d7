"""Where prediction and recording differ: chi2 by slice of a measurement, corrected for the number of slices."""

from __future__ import annotations

import numpy as np

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.places import Slice, log_tail, slices_of
from lab.diagnose.policy import DecisionPolicy
from lab.observables.gaussian import Gaussian, chi2


def chi2_by_slice(model: MeasurementModel, gaussian: Gaussian, policy: DecisionPolicy) -> list[Slice]:
    """Every slice of the seen numbers under a distribution of all numbers, most significant first."""
    residual = model.value - gaussian.mean
    candidates = slices_of(model)
    found = []
    for block, axis, where, members in candidates:
        value = chi2(residual[members], gaussian.covariance[np.ix_(members, members)])
        value /= (1.0 + policy.covariance_slack) ** 2
        n = len(members)
        log_p = min(log_tail(value, n) + np.log(len(candidates)), 0.0)
        found.append(Slice(block, axis, where, members, value, n, log_p))
    return sorted(found, key=lambda s: s.log_probability)


def mismatches(model: MeasurementModel, gaussian: Gaussian, policy: DecisionPolicy) -> tuple[Slice, ...]:
    """Return the slices whose corrected probability is below `slice_false_alarm_rate`, most significant first."""
    limit = np.log(policy.slice_false_alarm_rate)
    return tuple(s for s in chi2_by_slice(model, gaussian, policy) if s.log_probability < limit)
