"""`estimate_kernel`: the kernel between a target and a blurred picture of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.errors import NotDetermined
from lab.fit.psf.normal_equations import normal_equations, normal_equations_right
from lab.fit.psf.regularised_kernel import ROUNDS, KernelEstimate, solve_kernel
from lab.fit.psf.simplex import BRIEF_SOLVES, on_simplex
from lab.fit.psf.target_displacement import displaced, displacement
from lab.one_blas_thread import one_blas_thread

Array = NDArray[np.floating[Any]]

DISPLACEMENT_STEPS = 3


@one_blas_thread
def estimate_kernel(
    sharp: ArrayLike,
    blurred: ArrayLike,
    support: int,
    noise_std: float | None = None,
    *,
    register: bool = True,
) -> KernelEstimate:
    """The kernel that blurs `sharp` into `blurred`, both (rows, cols); `support` is odd.

        blurred[r, c] = sum_ij kernel[i, j] sharp[r - i + support // 2, c - j + support // 2] + noise

    on the rows and columns at least support // 2 from the border; kernel >= 0, sum 1. `noise_std` is estimated from
    the residual where it isn't given. With `register`, where the residual shows that `sharp` was drawn a little off
    its place (`displacement`), the places are refined together with the kernel, except a common shift, which belongs
    to the kernel. Raises ValueError for arguments of the wrong shape or size; `NotDetermined` where the picture is
    smaller than 2 x support, isn't finite or has no structure, or where `sharp` doesn't explain `blurred`.
    """
    u, b = np.asarray(sharp, dtype=float), np.asarray(blurred, dtype=float)
    if u.shape != b.shape or u.ndim != 2:
        raise ValueError(f"sharp {u.shape} and blurred {b.shape} must be of the same two-dimensional shape")
    if support != int(support) or support < 1 or support % 2 == 0:
        raise ValueError(f"support = {support} must be a whole number, odd and positive: the kernel has a middle")
    if noise_std is not None and not 0.0 <= noise_std < np.inf:
        raise ValueError(f"noise_std = {noise_std} must be finite and not negative")
    if min(u.shape) < 2 * support:
        raise NotDetermined("psf", f"{u.shape[0]} x {u.shape[1]} px are too few for a kernel of {support} x {support}")
    for name, picture in (("sharp", u), ("blurred", b)):
        if not np.isfinite(picture).all():
            raise NotDetermined(
                "psf", f"{int((~np.isfinite(picture)).sum())} pixels of the {name} picture aren't finite"
            )
    from scipy.signal import fftconvolve  # here: the library takes a while to load

    normal = normal_equations(u, b, support)
    found = solve_kernel(normal, support, noise_std, rounds=1, solves=BRIEF_SOLVES)
    inner = np.s_[support // 2 : u.shape[0] - support // 2, support // 2 : u.shape[1] - support // 2]
    kernel, predicted = found.kernel, fftconvolve(u, found.kernel, mode="same")
    _refuse_unrelated(predicted[inner], b[inner])
    field = displacement(predicted, b, support // 2) if register else None
    if field is not None:
        # Gauss-Newton: the Jacobian by the kernel is the displaced target
        carried = displaced(u, field)
        normal = normal_equations(carried, b, support)
        for step in range(DISPLACEMENT_STEPS):
            moved = displaced(predicted, field)
            linear = b - moved + fftconvolve(carried, kernel, mode="same")
            right = normal_equations_right(carried, linear, support)
            normal = replace(normal, right=right[0], power=right[1])
            if step < DISPLACEMENT_STEPS - 1:
                noise2 = float(np.mean((b - moved)[inner] ** 2))
                elements = on_simplex(
                    normal.gram + noise2 * found.precision, normal.right, kernel.ravel(), BRIEF_SOLVES
                )
                kernel = elements.reshape(support, support)
                predicted = fftconvolve(u, kernel, mode="same")
                field = displacement(predicted, b, support // 2, field)
        found = replace(found, kernel=kernel)
    return solve_kernel(normal, support, noise_std, start_from=found, rounds=ROUNDS - 1)


def _refuse_unrelated(predicted: Array, seen: Array) -> None:
    """Raise `NotDetermined` where the predicted picture is unrelated to the one seen, is unlevelled, or this one is
    clipped.
    """
    if not seen.std() > 0.0:
        raise NotDetermined(
            "psf", f"the blurred picture is uniform at {seen.flat[0]:g}: is the target lit, or is it saturated?"
        )
    agreement = float(np.corrcoef(predicted.ravel(), seen.ravel())[0, 1]) if predicted.std() > 0.0 else 0.0
    if not agreement**2 > 0.25:
        raise NotDetermined(
            "psf",
            f"the sharp picture explains {100 * max(agreement, 0.0) ** 2:.0f} % of the blurred one: is it that pattern?",
        )
    contrast = agreement * float(seen.std() / predicted.std())
    if not 0.5 < contrast < 2.0:
        raise NotDetermined(
            "psf",
            f"the blurred picture has {contrast:.2g} times the contrast of the sharp one: level it between white and black, or widen the support",
        )
    for name, end in (("lowest", seen.min()), ("highest", seen.max())):
        standing = seen == end
        share = float(standing.mean())
        # Pixels at one value although the pattern predicts different ones
        if share > 0.02 and float(predicted[standing].std()) > 0.1 * float(predicted.std()):
            raise NotDetermined(
                "psf",
                f"{100 * share:.0f} % of the blurred picture stand at its {name} value, {end:g}: it is clipped, expose it anew",
            )
