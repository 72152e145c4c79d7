"""Arrays as tuples of floats, as the results store them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


def numbers(values: Array) -> tuple[float, ...]:
    """A vector (n,)."""
    return tuple(float(value) for value in values)


def rows(values: Array) -> tuple[tuple[float, ...], ...]:
    """A matrix (n, m), row by row."""
    return tuple(numbers(row) for row in values)


def triple(values: Array) -> tuple[float, float, float]:
    """A vector (3,)."""
    return float(values[0]), float(values[1]), float(values[2])


def triples(values: Array) -> tuple[tuple[float, float, float], ...]:
    """A matrix (n, 3), row by row."""
    return tuple(triple(row) for row in values)
