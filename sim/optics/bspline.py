"""Cubic B-splines for compiled loops."""

from __future__ import annotations

from numba import njit


@njit(cache=True, inline="always")
def spline_weights(t):  # type: ignore[no-untyped-def]
    """Weights of a cubic B-spline at the samples -1, 0, 1, 2, for a point at 0 <= t < 1."""
    s = 1.0 - t
    return (
        s * s * s / 6.0,
        (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
        t * t * t / 6.0,
    )
