"""Where a drawn target lies against a blurred picture of it: a smooth displacement, or none, by marginal likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, ndimage

Array = NDArray[np.floating[Any]]

GRID_PX = 11.0  # spacing of the nodes
NODE_STD_PX = 0.5  # of the displacement of a node
NODE_CURVATURES_PX = (0.02, 0.1, 0.5)  # second differences between nodes; chosen by marginal likelihood
LEAST_LOG_BAYES_FACTOR = 3.0  # for a displacement against none


def displaced(picture: Array, field: Array) -> Array:
    """`picture` (rows, cols) read at the place of each pixel plus `field` (2, rows, cols), px, by splines of order
    5.
    """
    rows, cols = np.indices(picture.shape, dtype=float)
    return np.asarray(ndimage.map_coordinates(picture, [rows + field[0], cols + field[1]], order=5, mode="nearest"))


@overload
def displacement(predicted: Array, seen: Array, border: int, start: Array) -> Array: ...


@overload
def displacement(predicted: Array, seen: Array, border: int) -> Array | None: ...


def displacement(predicted: Array, seen: Array, border: int, start: Array | None = None) -> Array | None:
    """Field (2, rows, cols), px, such that `predicted` read at the displaced places agrees with `seen`.

    Bilinear between the nodes of a grid of about `GRID_PX`, with mean 0. Gauss-Newton on the residual beyond `border`
    px of the frame; the nodes have a Gaussian prior of `NODE_STD_PX`, and of second differences whose size maximises
    the marginal likelihood. None where the log Bayes factor against no displacement is below `LEAST_LOG_BAYES_FACTOR`,
    except with `start`, a field to begin with.
    """
    inner = np.s_[border : seen.shape[0] - border, border : seen.shape[1] - border]
    hats = [_hats(n, max(2, round(n / GRID_PX) + 1)) for n in seen[inner].shape]
    shape = hats[0].shape[1], hats[1].shape[1]
    nodes = shape[0] * shape[1]
    field, at = np.zeros((2, *seen.shape)), np.zeros(2 * nodes)
    if start is not None:
        field = start
        at = np.concatenate([(_pinv(hats[0]) @ part[inner] @ _pinv(hats[1]).T).ravel() for part in start])
    precisions = [
        _node_precision(shape, curvature) + np.eye(nodes) / NODE_STD_PX**2 for curvature in NODE_CURVATURES_PX
    ]
    precision = precisions[0]
    for iteration in range(2):
        moved = displaced(predicted, field)
        residual = (seen - moved)[inner]
        noise2 = float(np.mean(residual**2))
        gradients = [np.gradient(moved, axis=axis)[inner] for axis in (0, 1)]
        gram = np.block([[_hat_gram(hats, a * b) for b in gradients] for a in gradients]) / noise2
        right = np.concatenate([(hats[0].T @ (a * residual) @ hats[1]).ravel() for a in gradients]) / noise2
        if iteration == 0:
            log_factors = [_log_bayes_factor(gram, right + gram @ at, p) for p in precisions]
            if start is None and max(log_factors) < LEAST_LOG_BAYES_FACTOR:
                return None
            precision = linalg.block_diag(*[precisions[int(np.argmax(log_factors))]] * 2)
        factor = linalg.cho_factor(gram + precision, lower=True, check_finite=False)
        at = at + linalg.cho_solve(factor, right - precision @ at, check_finite=False)
        parts = [hats[0] @ part.reshape(shape) @ hats[1].T for part in np.split(at, 2)]
        field = np.stack([np.pad(part - part.mean(), border, mode="edge") for part in parts])
    return field


def _pinv(hats: Array) -> Array:
    """Pseudo-inverse of the basis of one axis."""
    return np.asarray(np.linalg.pinv(hats))


def _node_precision(shape: tuple[int, int], curvature_px: float) -> Array:
    """Precision (nodes, nodes) of a grid whose second differences, along both axes and mixed, are about
    `curvature_px`.
    """
    down, across = (np.eye(n) for n in shape)
    differences = [np.kron(np.diff(down, 2, axis=0), across), np.kron(down, np.diff(across, 2, axis=0))]
    differences.append(np.kron(np.diff(down, axis=0), np.diff(across, axis=0)))
    return np.asarray(sum(b.T @ b for b in differences) / curvature_px**2)


def _log_bayes_factor(gram: Array, right: Array, precision: Array) -> float:
    """Log Bayes factor of a displacement with given `precision` (of one axis) against none."""
    factor = linalg.cholesky(gram + linalg.block_diag(precision, precision), lower=True, check_finite=False)
    half = linalg.solve_triangular(factor, right, lower=True, check_finite=False)
    prior = linalg.cholesky(precision, lower=True, check_finite=False)
    return float(0.5 * half @ half - np.log(np.diag(factor)).sum() + 2.0 * np.log(np.diag(prior)).sum())


def _hats(count: int, nodes: int) -> Array:
    """Basis (count, nodes) of linear interpolation between evenly spaced nodes: hat functions."""
    at = np.linspace(0.0, nodes - 1.0, count)
    return np.clip(1.0 - np.abs(at[:, None] - np.arange(nodes)), 0.0, None)


def _hat_gram(hats: Sequence[Array], weight: Array) -> Array:
    """Gram matrix (nodes, nodes) of the products of row and column hat functions under a `weight` (rows, cols)."""
    down, across = hats
    # By rows first, then by columns
    row_products = np.einsum("ri,rj->rij", down, down).reshape(len(down), -1)  # (rows, a a')
    half = row_products.T @ weight  # (a a', cols)
    full = half @ np.einsum("ci,cj->cij", across, across).reshape(len(across), -1)  # (a a', b b')
    a, b = down.shape[1], across.shape[1]
    return np.asarray(full.reshape(a, a, b, b).transpose(0, 2, 1, 3).reshape(a * b, a * b))
