"""Every measurement in all Bayer orders and without a mosaic, of a camera with a strong low-pass filter, a strong blur
or strong lateral colour: with the concealed effect at its true size, numbers scatter about their prediction by chance.

Cameras are the second image former's: it shares no code with the measurements. Measurements are taken from their
library: a new one is covered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.special import chdtri, ndtri

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import ChargeDiffusionLaw, LateralColourLaw, OpticalLowPassFilterLaw
from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.observables.dataset import Dataset
from lab.observables.observable import Observable, measurements
from sim.effects.base import Effects
from sim.effects.library import candidates
from sim.sensor.mosaic import phases

SEED = 49151
ORDERS = ("RGGB", "BGGR", "GRBG", "GBRG", "MONO")
LAWS = ("filter", "blur", "lateral colour")
CHANCE = 1e-3  # that a right measurement fails one test, over all its comparisons (Bonferroni)
WHOLE = ("dark", "flat", "narrowband", "slanted_edge", "charuco", "screen")
#: Degrees by which a screen is turned that stands as square as a careful lab can set it up: its cells of 4 px then have
#: the same phase on the mosaic over tens of cells, and aliases of the pattern are coherent.
SQUARE_DEG = 0.07


@dataclass(frozen=True)
class Mosaic:
    """A camera with one strong law."""

    cfa: str
    law: str

    def __str__(self) -> str:
        return f"{self.cfa}-{self.law}"

    def concealed(self) -> Law:
        """Return the law, of a size in pixels: the filter's null at 0.9 cy/px, a Gaussian blur of 0.37 px, and 1 px at
        the frame's corner for 100 nm."""
        pitch_um = ConcealedCamera(SEED).pitch_um
        if self.law == "filter":
            return OpticalLowPassFilterLaw(0.56 * pitch_um, 0, 1)
        if self.law == "blur":
            return ChargeDiffusionLaw(0.37 * pitch_um, 0, 1)
        return LateralColourLaw(pitch_um, 0, 1)


GRID = tuple(Mosaic(cfa, law) for cfa in ORDERS for law in LAWS if (cfa, law) != ("MONO", "lateral colour"))
#: One of every order and of every law, for every day.
FEW = (
    Mosaic("GBRG", "filter"),
    Mosaic("RGGB", "lateral colour"),
    Mosaic("BGGR", "blur"),
    Mosaic("GRBG", "filter"),
    Mosaic("MONO", "blur"),
)
CASES = [pytest.param(case, id=str(case), marks=() if case in FEW else pytest.mark.slow) for case in GRID]


def _blocks(case: Mosaic, plan: Plan) -> tuple[list[Observable], Effects]:
    """Return what a small camera's recordings determine, and the concealed effect."""
    law = case.concealed()
    recordings = recordings_of(ConcealedCamera(SEED, (law,), cfa=case.cfa, rows=192, cols=256), plan)
    dataset = Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))
    found = []
    for measurement in measurements():
        try:
            found.append(measurement.make(dataset))
        except NotDetermined as refused:
            assert refused.reason, measurement.name
    (effect,) = (one for one in candidates() if one.name == law.effect)
    return found, (effect(**law.library_parameters()),)


def _pulls(block: Observable, effects: Effects) -> tuple[np.ndarray, np.ndarray]:
    """Return the pulls of a measurement's numbers, and those along the principal axes of their correlations."""
    prediction = block.predict(effects)
    jacobian = np.reshape(list(prediction.jacobian.values()), (-1, len(block.value)))
    covariance = block.covariance + jacobian.T @ jacobian
    std = np.sqrt(np.diag(covariance))
    pull = (block.value - prediction.mean) / std
    size, axes = np.linalg.eigh(covariance / np.outer(std, std))
    use = size > 1e-6  # rounding of the covariance is all there is in the others
    return pull, axes.T[use] @ pull / np.sqrt(size[use])


@pytest.mark.extra  # all measurements of ten cameras
@pytest.mark.parametrize("case", CASES)
def test_numbers_scatter_about_the_true_law_in_every_order(case: Mosaic) -> None:
    """chi2 lies below its quantile of probability 1 - CHANCE over the number of measurements."""
    blocks, effects = _blocks(case, Plan(WHOLE))
    if case.law == "lateral colour":
        # this former moves a channel's image as a whole, without the blur by the light's width that the effect has
        blocks = [block for block in blocks if block.measurement.name != "bernoulli"]
    names = {block.measurement.name for block in blocks}
    colour = {"lateral_colour", "board_colour", "green_balance"} if case.cfa != "MONO" else set()
    assert names >= {"flat_lines", "narrowband", "slanted_edge", "screen", "ghost", "cell_borders", "boards"} | colour
    assert {label.channel for block in blocks for label in block.labels} >= set(phases(case.cfa))  # type: ignore[arg-type]
    for block in blocks:
        _, along = _pulls(block, effects)
        limit = float(chdtri(len(along), CHANCE / len(blocks)))
        assert along @ along < limit, block.measurement.name


@pytest.mark.parametrize("case", CASES)
def test_a_square_screen_is_registered_in_every_order(case: Mosaic) -> None:
    """No displacement of a channel, and no band's contrast, is off its prediction by more than chance: two-sided, over
    the numbers of a measurement. Contrasts that alias together leave more in chi2 (2 to 3 of 1) than each shows."""
    blocks, effects = _blocks(case, Plan(("screen",), screen_turn_deg=SQUARE_DEG))
    looked_at = {"bernoulli", "lateral_colour"} - ({"bernoulli"} if case.law == "lateral colour" else set())
    found = [block for block in blocks if block.measurement.name in looked_at]
    assert {block.measurement.name for block in found} >= looked_at - (
        {"lateral_colour"} if case.cfa == "MONO" else set()
    )
    for block in found:
        pull, along = _pulls(block, effects)
        assert np.abs(pull).max() < float(-ndtri(0.5 * CHANCE / len(pull))), block.measurement.name
        if block.measurement.name == "lateral_colour":
            assert along @ along < float(chdtri(len(along), CHANCE))
