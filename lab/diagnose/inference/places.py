"""Places: parts of a measurement, with their chi2, their significance and their words."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import special

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.observables.gaussian import ROUNDING, Gaussian, conditional
from lab.observables.observable import Observable
from sim.spectrum import FloatArray

#: Distinct places on an axis from which on its quarters are slices, too: two a quarter.
FEWEST_QUARTERED = 8
#: Below this logarithm of a probability the normal quantile follows from the tail's asymptote, as exp would underflow.
LOG_UNDERFLOW = -650.0


@dataclass(frozen=True)
class Slice:
    """A part of one measurement: a range of its axis, a channel or a condition. `log_probability`: of a chi2 as large
    by chance, corrected for the number of slices (Bonferroni)."""

    block: Observable
    axis: str
    where: str
    members: np.ndarray  # indices into the model's vector
    chi2: float  # over (1 + slack)^2
    n: int
    log_probability: float

    @property
    def significance_sigma(self) -> float:
        """The probability as a one-sided quantile of the normal distribution."""
        if self.log_probability > LOG_UNDERFLOW:
            return float(max(-special.ndtri(np.exp(self.log_probability)), 0.0))
        twice = -2.0 * self.log_probability
        return float(np.sqrt(twice - np.log(2.0 * np.pi * twice)))  # tail: exp(-z^2 / 2) / (z sqrt(2 pi))


def log_tail(value: float, n: int) -> float:
    """log P(chi2_n > value); far out by the tail's leading term."""
    exact = float(special.chdtrc(n, value))
    if exact > 0.0:
        return float(np.log(exact))
    return float(-0.5 * value + (0.5 * n - 1.0) * np.log(0.5 * value) - special.gammaln(0.5 * n))


def slices_of(model: MeasurementModel) -> list[tuple[Observable, str, str, np.ndarray]]:
    """Return every part of every measurement that is tested: its block, its axis, where it is in words, and the indices
    of its used numbers."""
    return [
        part for block, at in zip(model.blocks, model.slices, strict=True) for part in _slices(block, at, model.seen)
    ]


def _slices(block: Observable, at: slice, seen: np.ndarray) -> list[tuple[Observable, str, str, np.ndarray]]:
    """Return the block as a whole, its channels, its conditions, and the quarters of its axis: (block, axis, words,
    indices)."""
    index = np.arange(at.start, at.stop)
    use = seen[index]
    x = np.array([label.x for label in block.labels])
    channel = np.array([label.channel for label in block.labels])
    condition = np.array([label.condition for label in block.labels])
    found = [(block, block.measurement.axis, _range(block, x[use]), index[use])]
    if not use.any():
        return []
    if len(set(channel)) > 1:
        found += [
            (block, "channel", f"channel {c}", index[use & (channel == c)])
            for c in sorted(set(channel))
            if (use & (channel == c)).any()
        ]
    if block.measurement.conditions and len(set(condition)) > 1:
        found += [
            (block, block.measurement.conditions, c, index[use & (condition == c)])
            for c in sorted(set(condition))
            if (use & (condition == c)).any()
        ]
    if not block.measurement.places and len(set(x[use])) >= FEWEST_QUARTERED:
        cuts = np.quantile(x[use], [0, 0.25, 0.5, 0.75, 1.0])
        for low, high in pairwise(cuts):
            part = use & (x >= low) & (x <= high)
            if part.any():
                found.append((block, block.measurement.axis, _range(block, x[part]), index[part]))
    return found


def _range(block: Observable, x: FloatArray) -> str:
    if block.measurement.places or len(x) == 0:
        return block.measurement.places
    low, high = float(np.min(x)), float(np.max(x))
    return f"{low:.4g}..{high:.4g} {block.measurement.unit}"


def describe(model: MeasurementModel, gaussian: Gaussian, part: Slice) -> tuple[str, tuple[str, ...]]:
    """Return a mismatch in words, and the captures concerned: of held-out numbers, where the slice is of those.

    The words give range, channels and conditions of the numbers whose residuals are largest: at least 3 standard
    deviations and 0.3 of the largest; where all are smaller, by noise alone, 2 standard deviations and 0.5 of the
    largest.
    """
    block = part.block
    at = model.slices[model.blocks.index(block)]
    index = np.arange(at.start, at.stop)
    is_held_out = not model.seen[part.members].any()
    index = index[model.seen[index] != is_held_out]
    residual = (model.value - gaussian.mean)[index]
    std = np.sqrt(np.diag(gaussian.covariance)[index])
    noise = np.abs(residual / np.sqrt(np.diag(block.covariance))[index - at.start])
    if is_held_out:  # by what the seen numbers say of them
        of = np.isin(np.arange(len(model.value)), index)
        residual, covariance = conditional(model.value - gaussian.mean, gaussian.covariance, of, model.seen)
        std = np.sqrt(np.maximum(np.diag(covariance), ROUNDING * np.square(std)))
        noise = np.abs(residual / std)
    total = np.abs(residual / std)
    strong = total > max(3.0, 0.3 * float(total.max()))
    if not strong.any():
        strong = noise >= max(2.0, 0.5 * float(noise.max()))
    labels = [block.labels[i - at.start] for i in index[strong]]
    if not labels:
        labels = [block.labels[i - at.start] for i in part.members]
    channels = sorted({label.channel for label in labels})
    every = sorted({label.channel for label in block.labels})
    conditions = list(dict.fromkeys(label.condition for label in labels))
    words = []
    listed = ", ".join(conditions[:6]) + (" and others" if len(conditions) > 6 else "")
    if block.measurement.places:
        words.append(f"{block.measurement.places}: {listed}")
    else:
        words.append(_range(block, np.array([label.x for label in labels])))
        if block.measurement.conditions:
            words.append(f"{block.measurement.conditions_words or block.measurement.conditions} {listed}")
    words.append("all channels" if channels == every else "channel " + ", ".join(channels))
    captures = sorted({c for label in labels for c in label.captures})
    return ", ".join(words), tuple(captures)
