"""The colour-filter mosaic: the channel of each pixel, planes of a frame, and frames from channels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sim.camera import Cfa

Scalar = TypeVar("Scalar", bound=np.generic)

#: A whole number of the periods by which pixels of one colour may collect light unlike each other, px.
PERIOD_PX = 48


def step(cfa: Cfa) -> int:
    """Return the period of the mosaic, px: 2, or 1 of a MONO sensor.

    >>> step("RGGB"), step("MONO")
    (2, 1)
    """
    return 1 if cfa == "MONO" else 2


def phases(cfa: Cfa) -> dict[str, list[tuple[int, int]]]:
    """List the positions of each channel's pixels in the mosaic's period, from pixel [0, 0].

    Returns channel -> [(row0, col0), ...]: R and B have one phase, G two (first the one on the red rows), MONO has
    Y. A phase's pixels are `frame[row0::step, col0::step]` with `step(cfa)`.

    >>> phases("RGGB")
    {'R': [(0, 0)], 'G': [(0, 1), (1, 0)], 'B': [(1, 1)]}
    """
    if cfa == "MONO":
        return {"Y": [(0, 0)]}
    at = {(index // 2, index % 2): letter for index, letter in enumerate(cfa)}
    red_row = next(row for (row, _), letter in at.items() if letter == "R")
    greens = sorted((place for place, letter in at.items() if letter == "G"), key=lambda place: place[0] != red_row)
    return {
        "R": [place for place, letter in at.items() if letter == "R"],
        "G": greens,
        "B": [place for place, letter in at.items() if letter == "B"],
    }


def first_pixels(cfa: Cfa) -> dict[str, tuple[int, int]]:
    """Return the first pixel (row, column) of each plane of a mosaic, by the names that `planes` has.

    >>> first_pixels("GRBG")
    {'R': (0, 1), 'G1': (0, 0), 'G2': (1, 1), 'B': (1, 0)}
    """
    if cfa == "MONO":
        return {"Y": (0, 0)}
    at = phases(cfa)
    return {"R": at["R"][0], "G1": at["G"][0], "G2": at["G"][1], "B": at["B"][0]}


def planes(frame: NDArray[Scalar], cfa: Cfa) -> dict[str, NDArray[Scalar]]:
    """Take a mosaic apart into its planes, as views of the frame.

    frame : (..., rows, cols)

    Returns `R`, `G1` (green on red rows), `G2` (green on blue rows), `B`; or `Y` of a MONO sensor.

    >>> {name: plane.tolist() for name, plane in planes(np.array([[1, 2], [3, 4]]), "RGGB").items()}
    {'R': [[1]], 'G1': [[2]], 'G2': [[3]], 'B': [[4]]}
    """
    period = step(cfa)
    return {name: frame[..., row::period, col::period] for name, (row, col) in first_pixels(cfa).items()}


def assemble(channels: Mapping[str, NDArray[Scalar]], cfa: Cfa) -> NDArray[Scalar]:
    """Assemble a frame from full images of each channel: every pixel takes the value of its own channel.

    channels : `R`, `G`, `B` or `Y`, all (rows, cols)

    Returns (rows, cols). Raises ValueError for a missing channel, and for images of different shapes.

    >>> assemble({c: np.full((2, 2), k) for k, c in enumerate("RGB")}, "RGGB").tolist()
    [[0, 1], [1, 2]]
    """
    places = phases(cfa)
    missing = [channel for channel in places if channel not in channels]
    if missing:
        raise ValueError(
            f"a {cfa} mosaic has the channels {', '.join(places)}, and no image came for {', '.join(missing)}: give "
            "one each"
        )
    shapes = {np.shape(channels[channel]) for channel in places}
    if len(shapes) != 1:
        raise ValueError(
            f"the channels' images differ in shape ({', '.join(map(str, sorted(shapes)))}): give all the frame's"
        )
    period = step(cfa)
    frame = np.empty_like(channels[next(iter(places))])
    for channel, where in places.items():
        for row, col in where:
            frame[row::period, col::period] = channels[channel][row::period, col::period]
    return frame
