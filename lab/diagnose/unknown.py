"""What no effect accounts for: a smooth discrepancy without a name (a Gaussian process on the measurement's axis)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from lab.diagnose.evidence import Evidence, Gaussian
from sim.spectrum import FloatArray

AMPLITUDES = np.geomspace(2e-4, 1.0, 20)
#: What amplitude, smoothness and kinship of the process cost, in nats.
PROCESS_NATS = 3.0


@dataclass(frozen=True)
class Discrepancy:
    """The best process for one block: its gain in log-likelihood over none, its amplitude, kernel and what it predicts."""

    index: int
    gain: float
    amplitude: float
    reach: float
    kinship: str
    kernel: FloatArray  # (n, n) over the block, with the amplitude in it


def discrepancy(evidence: Evidence, model: Gaussian, index: int) -> Discrepancy:
    """Maximum of the marginal likelihood over amplitude, reach and kinship of a squared-exponential process; block by block."""
    block, at = evidence.blocks[index], evidence.slices[index]
    seen = evidence.seen[at]
    residual = (evidence.value - model.mean)[at][seen]
    covariance = model.covariance[at, at][np.ix_(seen, seen)]
    x = block.position
    channel = np.array([label.channel for label in block.labels])
    condition = np.array([label.condition for label in block.labels])
    by_channel = (channel[:, None] == channel).astype(float)
    by_condition = (condition[:, None] == condition).astype(float)
    kinds = {"shared": np.ones_like(by_channel)}
    if len(set(channel)) > 1:
        kinds["by channel"] = by_channel
    if block.measurement == "slanted_edge" and len(set(condition)) > 1:
        kinds["by orientation"] = by_condition
        kinds["by channel and orientation"] = by_channel * by_condition
    if block.measurement in {"chart", "screen"}:
        kinds = {"by patch": by_condition, "by patch and channel": by_condition * by_channel}
        x = np.zeros_like(x)
    scale = np.outer(block.scale, block.scale)
    best = Discrepancy(index, 0.0, 0.0, block.reach, "none", np.zeros_like(scale))
    for reach in (0.5 * block.reach, 1.0 * block.reach, 2.0 * block.reach) if np.ptp(x) > 0 else (block.reach,):
        smooth = np.exp(-0.5 * ((x[:, None] - x) / reach) ** 2) * scale
        for kind, kin in kinds.items():
            kernel = smooth * kin
            # one generalised eigenproblem serves all amplitudes
            size, vectors = eigh(kernel[np.ix_(seen, seen)], covariance)
            projected = np.square(vectors.T @ residual)
            for amplitude in AMPLITUDES:
                grown = 1.0 + amplitude**2 * np.maximum(size, 0.0)
                gain = 0.5 * float(np.sum(projected * (1.0 - 1.0 / grown)) - np.sum(np.log(grown))) - PROCESS_NATS
                if gain > best.gain:
                    best = Discrepancy(index, gain, float(amplitude), reach, kind, amplitude**2 * kernel)
    return best


def with_discrepancy(evidence: Evidence, model: Gaussian, found: Discrepancy) -> Gaussian:
    """The model with the process in its covariance."""
    covariance = model.covariance.copy()
    covariance[evidence.slices[found.index], evidence.slices[found.index]] += found.kernel
    return Gaussian(model.mean, covariance)
