"""What no effect accounts for: a smooth discrepancy without a name (a Gaussian process on the measurement's axis)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, eigh, solve_triangular

from lab.diagnose.inference.evidence import ROUNDING, Evidence, Gaussian, chi2, conditional
from lab.diagnose.measurements.summaries import Block
from sim.spectrum import FloatArray

AMPLITUDES = np.geomspace(2e-4, 1.0, 20)
#: What the choice of amplitude, reach and kinship costs, in nats: the logarithm of how many of them differ.
PROCESS_NATS = 5.0
#: Parts of a block's captures that are left out in turn.
MOST_PARTS = 6
#: Nats within which two processes are as likely as each other.
AS_LIKELY = 10.0
#: Of a block's reach: within it two numbers of the same channel and condition are taken for repeats.
BESIDE = 0.1


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
    return max(_fitted(evidence, model, index, (0.5, 1.0, 2.0)), key=lambda d: d.gain)


def predictive(evidence: Evidence, model: Gaussian, index: int) -> Discrepancy:
    """The process that predicts captures best which it hasn't seen: of those that gain something, the one of the least chi2 over
    captures left out in turn, and none where that isn't less than without. The longest reach and points by themselves (which are
    alike in repeats only) are among them. Where repeats of what was seen are held out, leaving captures out asks for more than is
    wanted: there it only decides between processes that are nearly as likely as the likeliest. Where one set of captures is all
    that is seen, it is the likeliest.

    What is left out is judged by the covariance without the process: one that only says less sure of everything gains nothing.
    """
    block, seen = evidence.blocks[index], evidence.seen[evidence.slices[index]]
    none = _none(block, index)
    tried = [d for d in _fitted(evidence, model, index, (0.5, 1.0, 2.0, 4.0), points=True) if d.gain > 0]
    likeliest = max(tried, key=lambda d: d.gain, default=none)
    parts = _parts(block, seen)
    if len(parts) < 2:
        return likeliest
    residual = evidence.value[evidence.slices[index]][seen] - model.mean[model.slices[index]]
    covariance = model.of(index)

    def missed(process: Discrepancy) -> float:
        kernel = process.kernel[np.ix_(seen, seen)]
        total = 0.0
        for out in parts:
            kept = ~out
            pull = np.linalg.solve((covariance + kernel)[np.ix_(kept, kept)], residual[kept])
            left, spread = conditional(residual - kernel[:, kept] @ pull, covariance, out, kept)
            total += chi2(left, spread + np.diag(ROUNDING * np.diag(covariance)[out]))
        return total

    if _repeated(block, seen) > 0.5:
        return min((d for d in tried if d.gain > likeliest.gain - AS_LIKELY), key=missed, default=none)
    best = min(tried, key=missed, default=none)
    return best if missed(best) < missed(none) - 2.0 * PROCESS_NATS else none


def _parts(block: Block, seen: np.ndarray) -> list[np.ndarray]:
    """Masks of the seen numbers that are left out together: of the same captures, in at most so many parts."""
    captures = [label.captures for label, s in zip(block.labels, seen, strict=True) if s]
    number = {names: k % MOST_PARTS for k, names in enumerate(dict.fromkeys(captures))}
    part = np.array([number[names] for names in captures])
    return [part == k for k in range(min(len(number), MOST_PARTS))]


def _repeated(block: Block, seen: np.ndarray) -> float:
    """Share of the held-out numbers beside which a seen one of the same channel and condition stands."""
    x = block.position.reshape(len(seen), -1) / block.reach
    kind = np.array([f"{label.channel}|{label.condition}" for label in block.labels])
    beside = [
        bool(np.any((kind[seen] == kind[i]) & (np.abs(x[seen] - x[i]).max(1) < BESIDE))) for i in np.flatnonzero(~seen)
    ]
    return float(np.mean(beside)) if beside else 0.0


def _fitted(
    evidence: Evidence, model: Gaussian, index: int, reaches: Sequence[float], *, points: bool = False
) -> Iterator[Discrepancy]:
    """No process, and of every reach (in the block's) and kinship the one of the likeliest amplitude. `points`: points by
    themselves, too."""
    block, at = evidence.blocks[index], evidence.slices[index]
    seen = evidence.seen[at]
    residual = evidence.value[at][seen] - model.mean[model.slices[index]]
    x = np.zeros_like(block.position) if block.places else block.position
    lower = cholesky(model.of(index), lower=True)
    white = solve_triangular(lower, residual, lower=True)
    yield _none(block, index)

    def likeliest(factor: FloatArray, reach: float, kinship: str) -> Discrepancy:
        # One eigenproblem of the factor's size, much smaller than the block, serves all amplitudes.
        table = solve_triangular(lower, factor[seen], lower=True)
        size, vectors = eigh(table.T @ table)
        kept = size > 1e-12 * max(float(size[-1]), 1e-300)
        size = size[kept]
        projected = np.square(vectors[:, kept].T @ (table.T @ white)) / size
        grown = 1.0 + np.square(AMPLITUDES)[:, None] * size
        gain = 0.5 * (np.sum(projected * (1.0 - 1.0 / grown), 1) - np.sum(np.log(grown), 1)) - PROCESS_NATS
        best = int(np.argmax(gain))
        amplitude = float(AMPLITUDES[best])
        return Discrepancy(index, float(gain[best]), amplitude, reach, kinship, amplitude**2 * factor @ factor.T)

    for reach in np.multiply(reaches, block.reach) if np.ptp(x) > 0 else (block.reach,):
        smooth = _smooth(x, reach) * block.scale[:, None]
        for kinship, group in _kinships(block).items():
            yield likeliest(_by_group(smooth, group), float(reach), kinship)
    if points:
        where = np.unique([f"{label.x:.6g}|{label.channel}|{label.condition}" for label in block.labels], return_inverse=True)[1]  # fmt: skip
        yield likeliest(_by_group(block.scale[:, None], where), 0.0, "each point by itself")


def _kinships(block: Block) -> dict[str, NDArray[np.intp]]:
    """Which numbers have a process in common, in words and as groups."""
    channel = np.unique([label.channel for label in block.labels], return_inverse=True)[1]
    condition = np.unique([label.condition for label in block.labels], return_inverse=True)[1]
    both = np.unique(condition * len(channel) + channel, return_inverse=True)[1]
    if block.places:
        return {"each place by itself": condition, "each place and channel by itself": both}
    kinds = {"shared": np.zeros_like(channel)}
    if channel.any():
        kinds["by channel"] = channel
    if block.conditions and condition.any():
        kinds[f"by {block.conditions}"] = condition
        kinds[f"by channel and {block.conditions}"] = both
    return kinds


def _none(block: Block, index: int) -> Discrepancy:
    n = len(block.value)
    return Discrepancy(index, 0.0, 0.0, block.reach, "none", np.zeros((n, n)))


def _smooth(x: FloatArray, reach: float) -> FloatArray:
    """Factor B of the squared-exponential kernel, exp(-(x_i - x_j)^2 / (2 reach^2)) = B B' to 1e-9: few columns, as it is smooth."""
    place, which = np.unique(x.reshape(len(x), -1), axis=0, return_inverse=True)
    size, vectors = eigh(np.exp(-0.5 * np.square((place[:, None] - place) / reach).sum(-1)))
    kept = size > 1e-10 * size[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(size[kept]))[which.ravel()])


def _by_group(factor: FloatArray, group: NDArray[np.intp]) -> FloatArray:
    """The factor's columns once for every group, nil outside it: the process is drawn for each group by itself."""
    return np.concatenate([np.where((group == g)[:, None], factor, 0.0) for g in range(int(group.max()) + 1)], axis=1)
