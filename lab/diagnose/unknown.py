"""What no effect accounts for: a smooth discrepancy without a name (a Gaussian process on the measurement's axis)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, eigh, solve_triangular

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
    """Maximum of the marginal likelihood over amplitude, reach and kinship of a squared-exponential process; block by block.
    `model`: of the seen numbers."""
    block, at = evidence.blocks[index], evidence.slices[index]
    seen = evidence.seen[at]
    residual = evidence.value[at][seen] - model.mean[model.slices[index]]
    covariance = model.of(index)
    x = block.position
    channel = np.array([label.channel for label in block.labels])
    condition = np.array([label.condition for label in block.labels])
    by_channel = np.unique(channel, return_inverse=True)[1]
    by_condition = np.unique(condition, return_inverse=True)[1]
    by_both = np.unique(by_condition * len(channel) + by_channel, return_inverse=True)[1]
    kinds = {"shared": np.zeros_like(by_channel)}
    if len(set(channel)) > 1:
        kinds["by channel"] = by_channel
    if block.conditions and len(set(condition)) > 1:
        kinds[f"by {block.conditions}"] = by_condition
        kinds[f"by channel and {block.conditions}"] = by_both
    if block.places:
        kinds = {"each place by itself": by_condition, "each place and channel by itself": by_both}
        x = np.zeros_like(x)
    lower = cholesky(covariance, lower=True)
    white = solve_triangular(lower, residual, lower=True)
    best = Discrepancy(index, 0.0, 0.0, block.reach, "none", np.zeros((len(x), len(x))))
    for reach in (0.5 * block.reach, 1.0 * block.reach, 2.0 * block.reach) if np.ptp(x) > 0 else (block.reach,):
        smooth = _smooth(x, reach) * block.scale[:, None]
        for kind, kin in kinds.items():
            factor = _by_group(smooth, kin)
            # One eigenproblem of the factor's size, much smaller than the block, serves all amplitudes.
            table = solve_triangular(lower, factor[seen], lower=True)
            size, vectors = eigh(table.T @ table)
            kept = size > 1e-12 * max(float(size[-1]), 1e-300)
            size = size[kept]
            projected = np.square(vectors[:, kept].T @ (table.T @ white)) / size
            for amplitude in AMPLITUDES:
                grown = 1.0 + amplitude**2 * size
                gain = 0.5 * float(np.sum(projected * (1.0 - 1.0 / grown)) - np.sum(np.log(grown))) - PROCESS_NATS
                if gain > best.gain:
                    best = Discrepancy(index, gain, float(amplitude), reach, kind, amplitude**2 * factor @ factor.T)
    return best


def _smooth(x: FloatArray, reach: float) -> FloatArray:
    """Factor B of the squared-exponential kernel, exp(-(x_i - x_j)^2 / (2 reach^2)) = B B' to 1e-9: few columns, as it is smooth."""
    place, which = np.unique(x.reshape(len(x), -1), axis=0, return_inverse=True)
    size, vectors = eigh(np.exp(-0.5 * np.square((place[:, None] - place) / reach).sum(-1)))
    kept = size > 1e-10 * size[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(size[kept]))[which.ravel()])


def _by_group(factor: FloatArray, group: NDArray[np.intp]) -> FloatArray:
    """The factor's columns once for every group, nil outside it: the process is drawn for each group by itself."""
    return np.concatenate([np.where((group == g)[:, None], factor, 0.0) for g in range(int(group.max()) + 1)], axis=1)
