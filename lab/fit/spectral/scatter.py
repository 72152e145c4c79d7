"""How far signals scatter beyond their stated standard deviations, by maximum marginal likelihood.

Signals C = A S (1 + g) (1 + h) + noise: g is common to the channels in one light, as a lamp that flickers or a reading of its power is; h is
each channel's own. The curves S have the curvature prior of the fit, of free strength, and straight lines are integrated out (restricted
likelihood; Patterson and Thompson, 1971), so that neither structure of the curves nor their number of parameters is taken for scatter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, optimize

from lab.fit.spectral.channel_signals import RADIOMETER_RELATIVE_STD, ChannelSignals, Scatter
from lab.fit.spectral.curvature_prior import straight_lines
from sim.spectrum import FloatArray

#: ln of the likelihood ratio from which on scatter of several channels is counted (Akaike's for one parameter; what the channels share
#: shows what isn't structure of a curve), and from which on it is told, or counted for a channel alone: twice it is chi2 of two parameters at
#: their bounds at most, which exceeds 13.8 in one recording of a thousand that has none.
COUNTED_LOG_RATIO, CLEAR_LOG_RATIO = 1.0, 6.9
#: Largest relative scatter. Its variance goes with the measured signals; above it, a curve of zero would explain them all by scatter.
MOST_SCATTER = 0.2
#: Prior of ln(relative scatter), normal: one per cent, within a factor of ten. It bounds what the signals don't determine.
_PRIOR_LOG, _PRIOR_STD = np.log(0.01), np.log(10.0)
_STRENGTH_RANGE = 8.0  # of ln(strength^2) about the start


@dataclass(frozen=True)
class ScatterEvidence:
    """`log_evidence`: ln of the marginal likelihood at the likeliest `scatter`. `strength` (channels,): ln of the squared strengths of the
    priors there. The likelihood of no scatter is taken at strengths of its own.
    """

    log_evidence: float
    scatter: Scatter
    strength: FloatArray


def scatter_evidence(
    wave: FloatArray,
    signals: Sequence[ChannelSignals],
    prior: Sequence[FloatArray],
    start: FloatArray,
    scatter: Scatter,
) -> ScatterEvidence:
    """The likeliest scatter of `signals`, all channels at once, from a `start` of ln(strength^2) (channels,) and a first `scatter`.

    `prior`: of each channel the covariance (n, n) of its signals by the curvature of its curve, at strength 1. Of one channel all scatter
    is its own and stands as `common`.
    """
    rest = [linalg.qr(s.operator @ straight_lines(wave))[0][:, 2:] for s in signals]  # lines are integrated out
    turn = linalg.block_diag(*rest)
    value = np.concatenate([s.value for s in signals])
    light = np.concatenate([np.array(s.light) for s in signals])
    several = len(signals) > 1
    read = RADIOMETER_RELATIVE_STD if several else 0.0  # part of the stated standard deviations, common to the channels
    own = np.maximum(
        np.concatenate([s.std for s in signals]) ** 2 - (read * value) ** 2, 1e-20 * float(np.max(value**2))
    )
    y = turn.T @ value
    noise = (turn.T * own) @ turn
    alone = (turn.T * value**2) @ turn
    shared = turn.T @ ((light[:, None] == light) * np.outer(value, value)) @ turn if several else alone
    curve = [r.T @ p @ r for r, p in zip(rest, prior, strict=True)]
    ends = np.cumsum([0, *(len(c) for c in curve)])
    count = len(signals)

    def loss(strength: FloatArray, found: Scatter) -> float:
        covariance = noise + (read**2 + found.common**2) * shared + found.own**2 * alone
        for k in range(count):
            at = slice(ends[k], ends[k + 1])
            covariance[at, at] += np.exp(strength[k]) * curve[k]
        try:
            root = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            return 1e12
        z = linalg.solve_triangular(root, y, lower=True, check_finite=False)
        return 0.5 * float(z @ z) + float(np.log(np.diag(root)).sum())

    def penalised(x: FloatArray) -> float:
        weak = 0.5 * float(np.sum(((x[count:] - _PRIOR_LOG) / _PRIOR_STD) ** 2))
        return loss(x[:count], _scatter_of(x[count:])) + weak

    without, _ = _least(lambda x: loss(x, Scatter()), start)
    first = [max(scatter.common, 0.003), *([max(scatter.own, 0.001)] if several else [])]
    _, x = _least(penalised, np.concatenate([start, np.log(first)]))
    found = _scatter_of(x[count:])
    log_evidence = -loss(x[:count], found)
    return ScatterEvidence(log_evidence, replace(found, log_ratio=log_evidence + without), x[:count])


def _scatter_of(log: FloatArray) -> Scatter:
    """Scatter of the logarithms of common and own."""
    return Scatter(*np.exp(np.minimum(log, np.log(MOST_SCATTER))).tolist())


def _least(loss: Callable[[FloatArray], float], start: FloatArray) -> tuple[float, FloatArray]:
    """Least `loss` and its place, by a simplex about `start`."""
    simplex = np.concatenate([start[None], start + np.eye(start.size)])
    found = optimize.minimize(
        loss,
        start,
        method="Nelder-Mead",
        bounds=[(x - _STRENGTH_RANGE, x + _STRENGTH_RANGE) for x in start],
        options={"xatol": 0.05, "fatol": 0.05, "initial_simplex": simplex},
    )
    return float(found.fun), np.asarray(found.x)


def scatter_remarks(scatter: Scatter) -> list[str]:
    """What is told of scatter: a line where it is clear."""
    if scatter.log_ratio < CLEAR_LOG_RATIO:
        return []
    shares = [
        f"{100.0 * part:.2g} % {whose}"
        for part, whose in ((scatter.common, "common to the channels"), (scatter.own, "of each channel's own"))
        if part > 0.1 * scatter.total
    ]
    return [
        f"signals scatter beyond their stated standard deviations, by {' and '.join(shares)}: it is in those of the curves; repeat the light's readings"
    ]
