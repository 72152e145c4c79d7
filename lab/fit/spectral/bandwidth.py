"""Is narrowband light as wide as stated? Widths are compared by the marginal likelihood of the signals of all channels.

Light of a triangle's width b leaves little structure of the curves finer than b in the signals. Where they hold more than curves with usual
flanks leave, the light was narrower. Scatter of the signals is weighed against that at every width.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from lab.fit.spectral.channel_signals import ChannelSignals, Scatter
from lab.fit.spectral.curvature_prior import averaging_matrix, local_roughness, signal_covariance, straight_lines
from lab.fit.spectral.scatter import scatter_evidence
from lab.fit.spectral.sensitivity import ROUGHNESS_FLOORS
from lab.fit.spectral.tikhonov import least_misfit
from sim.spectrum import FloatArray

#: Of the stated width: halves of it first, and where these are likelier, what lies between. Wider light isn't tried, since it can't be told
#: from curves that are smoother than their prior.
HALVES = (1.0, 0.5, 0.25, 0.125)
BETWEEN = tuple(0.5**0.5 * factor for factor in HALVES)
#: ln of the likelihood ratio of the likeliest width to the stated one from which on the stated one isn't used: odds of 1,000.
BANDWIDTH_LOG_RATIO = 6.9
LEAST_SHARE = 0.02  # of the probability: curves at widths below it are left out

Signals = Callable[[float], tuple[FloatArray, Mapping[str, ChannelSignals]]]


@dataclass(frozen=True)
class LikelyWidths:
    """Factors on the stated bandwidth. `share`: the probabilities of those that count; `widest`: the largest that isn't excluded by the odds by
    which the stated width is. How narrow light is below that hardly matters, and roughness of the curves themselves looks like narrower light.
    """

    share: Mapping[float, float]
    widest: float


def likely_widths(signals_of: Signals, scatter: Scatter, fine_share: float) -> LikelyWidths | None:
    """The widths of narrowband light that fit; None unless the signals contradict the stated one.

    `signals_of`: wavelengths and signals by channel with the operators of a factor on the stated width. `scatter`: what was found at that.
    """
    found = {factor: bandwidth_evidence(*signals_of(factor), scatter, fine_share) for factor in HALVES}
    if max(found.values()) - found[1.0] < BANDWIDTH_LOG_RATIO:
        return None
    found |= {factor: bandwidth_evidence(*signals_of(factor), scatter, fine_share) for factor in BETWEEN}
    highest = max(found.values())
    kept = {
        factor: float(np.exp(log - highest)) for factor, log in found.items() if log > highest + np.log(LEAST_SHARE)
    }
    widest = max(factor for factor, log in found.items() if log > highest - BANDWIDTH_LOG_RATIO)
    return LikelyWidths({factor: share / sum(kept.values()) for factor, share in kept.items()}, widest)


def bandwidth_evidence(
    wave: FloatArray, signals: Mapping[str, ChannelSignals], scatter: Scatter, fine_share: float
) -> float:
    """ln of the marginal likelihood of `signals` under their lights, up to what all lights share.

    The local scale of the curvature prior is that of the signals over the light's power, which doesn't depend on the width.
    """
    average, line = averaging_matrix(wave), straight_lines(wave)
    priors, start = [], []
    for one in signals.values():
        level = one.operator.sum(axis=1)
        middle = one.operator @ wave / level
        order = np.argsort(middle)
        local = local_roughness(wave, np.interp(wave, middle[order], (one.value / level)[order]), average)
        local = np.zeros_like(wave) if local is None else local
        std = one.scattered(scatter).std
        tried = []
        for floor in ROUGHNESS_FLOORS[1::2]:
            for fine in (0.0, fine_share):  # curves without fine structure aren't evidence for light that would hide it
                prior = signal_covariance(wave, one.operator, floor + local, fine)
                tried.append((*least_misfit(prior, one.operator @ line, one.value, std), prior))
        _, strength, prior = min(tried, key=lambda t: t[0])
        priors.append(prior)
        start.append(2.0 * np.log(strength))
    return scatter_evidence(wave, list(signals.values()), priors, np.array(start), scatter).log_evidence
