"""The signals of a channel under known lights, and what the errors of several channels have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from lab.fit.spectral.sensitivity import Sensitivity

RADIOMETER_RELATIVE_STD = 0.003  # repeatability of a measured spectrum

LEAST_SHARE = 1e-6  # of a channel's highest signal: the least standard deviation that is its own


@dataclass(frozen=True)
class Scatter:
    """Relative standard deviations of signals beyond the stated ones: `common` to the channels in one light, as the lamp and the
    reading of its power are, and `own`, independent from channel to channel. `log_ratio`: ln of the likelihood ratio to none.
    """

    common: float = 0.0
    own: float = 0.0
    log_ratio: float = 0.0

    @property
    def total(self) -> float:
        """Relative standard deviation of one signal by both."""
        return float(np.hypot(self.common, self.own))


@dataclass(frozen=True, eq=False)
class ChannelSignals:
    """Signals of one channel and the operator on its sensitivity.

    `operator` (n, m), `value`, `std` (n,): e/s, or relative. `light` (n,): names of the lights; two channels share the error of a light.
    `saturated` (k, m), `limit` (k,): operator and lower limits of saturated signals.
    """

    operator: FloatArray
    value: FloatArray
    std: FloatArray
    light: tuple[str, ...]
    saturated: FloatArray
    limit: FloatArray

    @property
    def has_gaps(self) -> bool:
        """Whether lights saturate."""
        return self.limit.size > 0

    def scattered(self, scatter: Scatter) -> ChannelSignals:
        """The signals with the standard deviation that `scatter` adds."""
        return replace(self, std=np.hypot(self.std, scatter.total * self.value))

    def unshared(self, scatter: Scatter) -> ChannelSignals:
        """The signals with `scatter`, and without the radiometer's repeatability, which the channels share."""
        square = self.std**2 - (RADIOMETER_RELATIVE_STD * self.value) ** 2
        least = LEAST_SHARE * float(np.max(np.abs(self.value)))
        return replace(self, std=np.sqrt(np.maximum(square, least**2))).scattered(scatter)


def light_errors(signals: Mapping[str, ChannelSignals]) -> dict[str, FloatArray]:
    """Changes (n, lights) of each channel's signals by the relative errors of all lights, which the channels share."""
    lights = np.array(list(dict.fromkeys(name for one in signals.values() for name in one.light)))
    return {c: (np.array(one.light)[:, None] == lights) * one.value[:, None] for c, one in signals.items()}


def joint_covariance(at: FloatArray, solved: Mapping[str, Sensitivity]) -> FloatArray:
    """Covariance (channels x k, channels x k) of the curves of all channels, channel after channel, at the wavelengths to which `at` (k, m)
    interpolates. Between channels it is that of what they share.
    """
    return np.block(
        [
            [at @ (one.covariance if c == d else one.common @ two.common.T) @ at.T for d, two in solved.items()]
            for c, one in solved.items()
        ]
    )
