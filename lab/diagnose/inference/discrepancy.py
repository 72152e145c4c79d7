"""Model discrepancy: what no effect accounts for, as a smooth Gaussian process along a measurement's axis (Kennedy and
O'Hagan, 2001).

Kernel: a^2 s_i s_j exp(-(x_i - x_j)^2 / (2 l^2)) for numbers of one group, 0 between groups; s is the block's scale.
Amplitude a, length l and grouping (which channels and conditions share one draw) are chosen from a grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, eigh, solve_triangular

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from lab.observables.gaussian import ROUNDING, Gaussian, chi2, conditional
from lab.observables.observable import Observable
from sim.spectrum import FloatArray

#: Amplitudes, relative to the block's scale, and lengths, relative to the block's `reach`, that are tried.
AMPLITUDES = np.geomspace(2e-4, 1.0, 20)
LENGTHS, PREDICTIVE_LENGTHS = (0.5, 1.0, 2.0), (0.5, 1.0, 2.0, 4.0)


@dataclass(frozen=True)
class Discrepancy:
    """A discrepancy of one block: its log posterior odds over none, its amplitude, correlation length, grouping in
    words, and kernel."""

    index: int
    log_odds: float
    amplitude: float
    length: float
    grouping: str
    kernel: FloatArray  # (m, m) over the block, the amplitude included


def likeliest_discrepancy(
    model: MeasurementModel, gaussian: Gaussian, index: int, policy: DecisionPolicy
) -> Discrepancy:
    """Return the discrepancy of one block that maximises the marginal likelihood of the seen numbers, or none where
    that is likelier. `gaussian`: the distribution of the seen numbers without it."""
    return max(_fitted(model, gaussian, index, LENGTHS, policy), key=lambda d: d.log_odds)


def predictive_discrepancy(
    model: MeasurementModel, gaussian: Gaussian, index: int, policy: DecisionPolicy
) -> Discrepancy:
    """Return the discrepancy of one block that best predicts captures which it hasn't seen, or none where none does.

    Captures are left out in turn (cross-validation); of the discrepancies with positive log odds, the one of the least
    chi2 over what was left out is taken, if that beats none by twice `discrepancy_log_odds`. Longer lengths, and points
    by themselves, are tried besides. Where mostly repeats of seen numbers are held out, leaving captures out asks for
    more than is needed: cross-validation then decides only between discrepancies within `equal_discrepancy_log_odds` of
    the likeliest. With a single set of captures, the likeliest is taken.

    What was left out is judged by the covariance without the discrepancy, so that larger variances gain nothing.
    """
    block, seen = model.blocks[index], model.seen[model.slices[index]]
    none = no_discrepancy(block, index)
    tried = [d for d in _fitted(model, gaussian, index, PREDICTIVE_LENGTHS, policy, points=True) if d.log_odds > 0]
    likeliest = max(tried, key=lambda d: d.log_odds, default=none)
    parts = _left_out(block, seen, policy.left_out_parts)
    if len(parts) < 2:
        return likeliest
    residual = model.value[model.slices[index]][seen] - gaussian.mean[gaussian.slices[index]]
    covariance = gaussian.block_covariance(index)

    def left_out_chi2(one: Discrepancy) -> float:
        kernel = one.kernel[np.ix_(seen, seen)]
        total = 0.0
        for out in parts:
            kept = ~out
            weighted = np.linalg.solve((covariance + kernel)[np.ix_(kept, kept)], residual[kept])
            left, left_covariance = conditional(residual - kernel[:, kept] @ weighted, covariance, out, kept)
            total += chi2(left, left_covariance + np.diag(ROUNDING * np.diag(covariance)[out]))
        return total

    if _repeated_share(block, seen, policy.repeat_distance) > 0.5:
        near = (d for d in tried if d.log_odds > likeliest.log_odds - policy.equal_discrepancy_log_odds)
        return min(near, key=left_out_chi2, default=none)
    best = min(tried, key=left_out_chi2, default=none)
    return best if left_out_chi2(best) < left_out_chi2(none) - 2.0 * policy.discrepancy_log_odds else none


def _left_out(block: Observable, seen: np.ndarray, most_parts: int) -> list[np.ndarray]:
    """Masks over the seen numbers that are left out together: those of the same captures, in at most `most_parts`
    parts."""
    captures = [label.captures for label, s in zip(block.labels, seen, strict=True) if s]
    number = {names: k % most_parts for k, names in enumerate(dict.fromkeys(captures))}
    part = np.array([number[names] for names in captures])
    return [part == k for k in range(min(len(number), most_parts))]


def _repeated_share(block: Observable, seen: np.ndarray, distance: float) -> float:
    """Share of the held-out numbers that have a seen one of the same channel and condition within `distance`
    correlation lengths."""
    x = block.position.reshape(len(seen), -1) / block.reach
    kind = np.array([f"{label.channel}|{label.condition}" for label in block.labels])
    repeated = [
        bool(np.any((kind[seen] == kind[i]) & (np.abs(x[seen] - x[i]).max(1) < distance)))
        for i in np.flatnonzero(~seen)
    ]
    return float(np.mean(repeated)) if repeated else 0.0


def _fitted(
    model: MeasurementModel,
    gaussian: Gaussian,
    index: int,
    lengths: Sequence[float],
    policy: DecisionPolicy,
    *,
    points: bool = False,
) -> Iterator[Discrepancy]:
    """None; and for every length and grouping the one of the likeliest amplitude. `points`: every point by itself,
    too."""
    block, at = model.blocks[index], model.slices[index]
    seen = model.seen[at]
    residual = model.value[at][seen] - gaussian.mean[gaussian.slices[index]]
    x = np.zeros_like(block.position) if block.measurement.places else block.position
    lower = cholesky(gaussian.block_covariance(index), lower=True)
    white = solve_triangular(lower, residual, lower=True)
    yield no_discrepancy(block, index)

    def likeliest(factor: FloatArray, length: float, grouping: str) -> Discrepancy:
        # With the eigenvalues e of the whitened factor, an amplitude a changes the log-likelihood by
        # 1/2 sum(p (1 - 1 / (1 + a^2 e)) - log(1 + a^2 e)): one small eigenproblem serves all amplitudes.
        table = solve_triangular(lower, factor[seen], lower=True)
        size, vectors = eigh(table.T @ table)
        kept = size > 1e-12 * max(float(size[-1]), 1e-300)
        size = size[kept]
        projected = np.square(vectors[:, kept].T @ (table.T @ white)) / size
        grown = 1.0 + np.square(AMPLITUDES)[:, None] * size
        gain = 0.5 * (np.sum(projected * (1.0 - 1.0 / grown), 1) - np.sum(np.log(grown), 1))
        log_odds = gain - policy.discrepancy_log_odds
        best = int(np.argmax(log_odds))
        amplitude = float(AMPLITUDES[best])
        return Discrepancy(index, float(log_odds[best]), amplitude, length, grouping, amplitude**2 * factor @ factor.T)

    for length in np.multiply(lengths, block.reach) if np.ptp(x) > 0 else (block.reach,):
        smooth = _kernel_factor(x, length) * block.scale[:, None]
        for grouping, group in _groupings(block).items():
            yield likeliest(_by_group(smooth, group), float(length), grouping)
    if points:
        where = np.unique(
            [f"{label.x:.6g}|{label.channel}|{label.condition}" for label in block.labels], return_inverse=True
        )[1]
        yield likeliest(_by_group(block.scale[:, None], where), 0.0, "each point by itself")


def _groupings(block: Observable) -> dict[str, NDArray[np.intp]]:
    """Return the ways in which numbers share a draw: in words, and each number's group (m,)."""
    channel = np.unique([label.channel for label in block.labels], return_inverse=True)[1]
    condition = np.unique([label.condition for label in block.labels], return_inverse=True)[1]
    both = np.unique(condition * len(channel) + channel, return_inverse=True)[1]
    if block.measurement.places:
        return {"each place by itself": condition, "each place and channel by itself": both}
    found = {"shared": np.zeros_like(channel)}
    if channel.any():
        found["by channel"] = channel
    if block.measurement.conditions and condition.any():
        found[f"by {block.measurement.conditions}"] = condition
        found[f"by channel and {block.measurement.conditions}"] = both
    return found


def no_discrepancy(block: Observable, index: int) -> Discrepancy:
    """None, with log odds of 0."""
    n = len(block.value)
    return Discrepancy(index, 0.0, 0.0, block.reach, "none", np.zeros((n, n)))


def _kernel_factor(x: FloatArray, length: float) -> FloatArray:
    """Factor B (m, k) of the squared exponential, exp(-(x_i - x_j)^2 / (2 l^2)) = B B' to 1e-9; k is small, as the
    kernel is smooth."""
    place, which = np.unique(x.reshape(len(x), -1), axis=0, return_inverse=True)
    size, vectors = eigh(np.exp(-0.5 * np.square((place[:, None] - place) / length).sum(-1)))
    kept = size > 1e-10 * size[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(size[kept]))[which.ravel()])


def _by_group(factor: FloatArray, group: NDArray[np.intp]) -> FloatArray:
    """Return the factor's columns once for every group, zero outside it: independent draws of the groups."""
    return np.concatenate([np.where((group == g)[:, None], factor, 0.0) for g in range(int(group.max()) + 1)], axis=1)
