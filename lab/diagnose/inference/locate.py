"""Where prediction and recording part: chi2 by slice, corrected for the number of slices looked at."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import special

from lab.diagnose.inference.evidence import Evidence, Gaussian, chi2
from lab.diagnose.measurements.summaries import Block
from sim.spectrum import FloatArray

#: Slices whose corrected probability is below this are mismatches: one healthy set in two hundred shows one.
SIGNIFICANT = 0.005
#: Systematic parts of the covariance are known to about this share: chi2 is divided by (1 + SLACK)^2.
SLACK = 0.15
#: Different places on an axis from which on its quarters are looked at by themselves.
FEWEST_QUARTERED = 8


@dataclass(frozen=True)
class Slice:
    """A part of one measurement that may be off."""

    block: Block
    axis: str
    where: str
    members: np.ndarray  # of the whole vector
    chi2: float
    n: int
    log_probability: float  # of so large a chi2 by chance, corrected

    @property
    def significance_sigma(self) -> float:
        """Of a normal distribution, one-sided."""
        if self.log_probability > -650.0:
            return float(max(-special.ndtri(np.exp(self.log_probability)), 0.0))
        twice = -2.0 * self.log_probability
        return float(np.sqrt(twice - np.log(2.0 * np.pi * twice)))  # of the tail exp(-z^2 / 2) / (z sqrt(2 pi))

    @property
    def significant(self) -> bool:
        return self.log_probability < np.log(SIGNIFICANT)


def look(evidence: Evidence, model: Gaussian) -> list[Slice]:
    """Every slice of the seen numbers under a model, most significant first."""
    residual = evidence.value - model.mean
    candidates: list[tuple[Block, str, str, np.ndarray]] = []
    for block, at in zip(evidence.blocks, evidence.slices, strict=True):
        candidates += _slices(block, at, evidence.seen)
    found = []
    for block, axis, where, members in candidates:
        value = chi2(residual[members], model.covariance[np.ix_(members, members)]) / (1.0 + SLACK) ** 2
        n = len(members)
        log_p = min(_log_tail(value, n) + np.log(len(candidates)), 0.0)
        found.append(Slice(block, axis, where, members, value, n, log_p))
    return sorted(found, key=lambda s: s.log_probability)


def _log_tail(value: float, n: int) -> float:
    """Logarithm of the probability of a larger chi2 with n degrees of freedom; far out by the tail's leading term."""
    exact = float(special.chdtrc(n, value))
    if exact > 0.0:
        return float(np.log(exact))
    return float(-0.5 * value + (0.5 * n - 1.0) * np.log(0.5 * value) - special.gammaln(0.5 * n))


def _slices(block: Block, at: slice, seen: np.ndarray) -> list[tuple[Block, str, str, np.ndarray]]:
    index = np.arange(at.start, at.stop)
    use = seen[index]
    x = np.array([label.x for label in block.labels])
    channel = np.array([label.channel for label in block.labels])
    condition = np.array([label.condition for label in block.labels])
    found = [(block, block.axis, _range(block, x[use]), index[use])]
    if not use.any():
        return []
    if len(set(channel)) > 1:
        found += [
            (block, "channel", f"channel {c}", index[use & (channel == c)])
            for c in sorted(set(channel))
            if (use & (channel == c)).any()
        ]
    if block.conditions and len(set(condition)) > 1:
        found += [
            (block, block.conditions, c, index[use & (condition == c)])
            for c in sorted(set(condition))
            if (use & (condition == c)).any()
        ]
    if not block.places and len(set(x[use])) >= FEWEST_QUARTERED:
        cuts = np.quantile(x[use], [0, 0.25, 0.5, 0.75, 1.0])
        for low, high in pairwise(cuts):
            part = use & (x >= low) & (x <= high)
            if part.any():
                found.append((block, block.axis, _range(block, x[part]), index[part]))
    return found


def _range(block: Block, x: FloatArray) -> str:
    if block.places or len(x) == 0:
        return block.places
    low, high = float(np.min(x)), float(np.max(x))
    return f"{low:.4g}..{high:.4g} {block.unit}"


def describe(evidence: Evidence, model: Gaussian, part: Slice) -> tuple[str, tuple[str, ...]]:
    """Where in words (range on the axis of what sticks out, channels, conditions), and the captures concerned."""
    block = part.block
    at = evidence.slices[evidence.blocks.index(block)]
    index = np.arange(at.start, at.stop)
    index = index[evidence.seen[index]]
    z = (evidence.value - model.mean)[index] / np.sqrt(np.diag(model.covariance)[index])
    noise = np.sqrt(np.diag(block.covariance))[index - at.start]
    bare = (evidence.value - model.mean)[index] / noise
    strong = np.abs(z) > max(3.0, 0.3 * float(np.abs(z).max()))
    if not strong.any():
        strong = np.abs(bare) >= max(2.0, 0.5 * float(np.abs(bare).max()))
    labels = [block.labels[i - at.start] for i in index[strong]]
    if not labels:
        labels = [block.labels[i - at.start] for i in part.members]
    channels = sorted({label.channel for label in labels})
    every = sorted({label.channel for label in block.labels})
    conditions = list(dict.fromkeys(label.condition for label in labels))
    words = []
    listed = ", ".join(conditions[:6]) + (" and others" if len(conditions) > 6 else "")
    if block.places:
        words.append(f"{block.places}: {listed}")
    else:
        words.append(_range(block, np.array([label.x for label in labels])))
        if block.conditions:
            words.append(f"{block.conditions_words or block.conditions} {listed}")
    words.append("all channels" if channels == every else "channel " + ", ".join(channels))
    captures = sorted({c for label in labels for c in label.captures})
    return ", ".join(words), tuple(captures)
