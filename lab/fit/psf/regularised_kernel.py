"""The regularised kernel of given normal equations, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.fit.psf.kernel_prior import KernelPrior, envelope_of, most_likely_prior
from lab.fit.psf.normal_equations import NormalEquations
from lab.fit.psf.simplex import MOST_SOLVES, on_simplex

Array = NDArray[np.floating[Any]]

OUTSIDE_STD = 0.1  # of the prior of the share of light from beyond the support
ROUNDS = 3  # of envelope and kernel in turn; more change less than 0.1 dB


@dataclass(frozen=True)
class KernelEstimate:
    """A kernel and its uncertainty.

    `kernel` (support, support), >= 0, sum 1; `kernel_std` its standard deviation; `covariance` (k, k) over the
    elements, row by row. `noise_std`: of the blurred picture. `length_px`, `strength`: the prior of largest marginal
    likelihood. `outside`: share of the light from beyond the support. `information`, `precision`: the contributions of
    the data and of the prior to the quadratic form that was minimised.
    """

    kernel: Array
    kernel_std: Array
    covariance: Array
    noise_std: float
    length_px: float
    strength: float
    outside: float
    information: Array
    precision: Array


def solve_kernel(
    normal: NormalEquations,
    support: int,
    noise_std: float | None = None,
    *,
    outside: bool = False,
    rounds: int = ROUNDS,
    prior_of: KernelEstimate | None = None,
    start_from: KernelEstimate | None = None,
    solves: int = MOST_SOLVES,
) -> KernelEstimate:
    """The kernel (support, support) of given normal equations; see `estimate_kernel`.

    With `outside` the last element of the normal equations is the light from beyond the support, which is part of the
    sum. The prior maximises the marginal likelihood over `rounds` of envelope and kernel in turn; or it is that of the
    estimate `prior_of`, with its noise. `start_from`: an estimate from which the search begins. `solves`: see
    `on_simplex`. Raises `NotDetermined` for a target without structure, ValueError where the number of elements does
    not fit.
    """
    size, total = support * support, len(normal.right)
    if total != size + outside:
        raise ValueError(f"normal equations of {total} elements don't fit a support of {support} x {support}")
    scale = float(np.trace(normal.gram)) / total
    contrast = normal.power / normal.count - (normal.right.mean() ** 2 / max(scale, 1e-300)) / normal.count
    if not scale > 0.0 or not contrast > 0.0:
        raise NotDetermined("psf", "the target shows no structure: put a Bernoulli pattern on the screen")
    given = prior_of or start_from
    if given is None:
        flat = np.full(total, 1.0 / total)
        found = on_simplex(normal.gram + 1e-9 * scale * np.eye(total), normal.right, flat, 6)
    else:
        found = np.append(given.kernel.ravel() * (1.0 - given.outside), [given.outside] * outside)
    residual = max(
        normal.power - 2.0 * float(np.vdot(normal.right, found)) + float(np.vdot(found, normal.gram @ found)), 0.0
    )
    freedom = max(normal.count - int(np.count_nonzero(found > 0.0)), 1)
    if noise_std is None and prior_of is not None:
        noise_std = prior_of.noise_std
    noise = float(np.sqrt(residual / freedom)) if noise_std is None else float(noise_std)
    noise = max(noise, 1e-9 * float(np.sqrt(normal.power / normal.count)))
    information, weighted = normal.gram / noise**2, normal.right / noise**2

    # The likelihood of the kernel alone: the light from beyond is integrated out
    reduced, reduced_right = information[:size, :size], weighted[:size]
    if outside:
        elimination = information[:size, size] / (information[size, size] + OUTSIDE_STD**-2)
        reduced, reduced_right = (
            reduced - np.outer(elimination, information[:size, size]),
            reduced_right - elimination * weighted[size],
        )
    precision = np.zeros_like(information)
    if outside:
        precision[size, size] = OUTSIDE_STD**-2
    at = (2, 1)
    for last in range(1 - rounds if prior_of is None else 1, 1):
        prior, at = most_likely_prior(reduced, reduced_right, found[:size].reshape(support, support), at)
        precision[:size, :size] = prior.precision()
        found = on_simplex(information + precision, weighted, found, solves if last == 0 else 3)
    if prior_of is not None:
        prior, precision = (
            KernelPrior(envelope_of(prior_of.kernel), prior_of.length_px, prior_of.strength),
            prior_of.precision,
        )
        found = on_simplex(information + precision, weighted, found, solves)
    share = float(found[:size].sum())
    posterior = prior.posterior(reduced) / share**2
    return KernelEstimate(
        kernel=found[:size].reshape(support, support) / share,
        kernel_std=np.sqrt(np.clip(np.diag(posterior), 0.0, None)).reshape(support, support),
        covariance=posterior,
        noise_std=noise,
        length_px=prior.length,
        strength=prior.strength,
        outside=1.0 - share if outside else 0.0,
        information=information,
        precision=precision,
    )
