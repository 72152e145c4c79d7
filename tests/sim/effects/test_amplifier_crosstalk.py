"""Crosstalk of output amplifiers: places that are read together, the frame's mean, correlations and the dark."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from sim.effects.amplifier_crosstalk import LAYOUTS, AmplifierCrosstalk, Layout, Order
from sim.frame import Exposure, moments
from sim.scene.scenes import Darkness, UniformField
from sim.sensor.amplifiers import CoupledAmplifiers
from sim.stages import Signal, signal_of
from sim.uniform import Uniform
from tests.sim.effects.test_sensor_effects import CAMERA, LIGHT

EVERY = [(layout, order) for layout in LAYOUTS for order in get_args(Order)]


@pytest.mark.parametrize(
    ("layout", "order", "places"),
    [
        ("two columns", "alike", {(2, 9): 1.0}),
        ("two columns", "turned", {(2, 14): 1.0}),
        ("four columns", "alike", {(2, 5): 1.0, (2, 9): 0.3, (2, 13): 0.3}),
        ("four columns", "turned", {(2, 6): 1.0, (2, 9): 0.3, (2, 14): 0.3}),
        ("two rows", "alike", {(6, 1): 1.0}),
        ("two rows", "turned", {(5, 1): 1.0}),
        ("quadrants", "turned", {(2, 14): 1.0, (5, 1): 1.0, (5, 14): 0.3}),
    ],
)
def test_ghosts_lie_where_pixels_are_read_together(
    layout: Layout, order: Order, places: dict[tuple[int, int], float]
) -> None:
    """Of a bright pixel at (2, 1) in a frame of 8 x 16, by hand."""
    frame = np.zeros((8, 16))
    frame[2, 1] = 1000.0
    one = AmplifierCrosstalk(share_percent=2.0, far_share=0.3, layout=layout, order=order)
    (law,) = signal_of(CAMERA, (one,)).amplifiers
    after = law.couple(frame)
    found = {place: float(after[place] / after[2, 1]) for place in zip(*map(list, np.nonzero(after)), strict=True)}
    assert found.pop((2, 1)) == 1.0
    assert found == pytest.approx({place: 0.02 * share for place, share in places.items()})


@pytest.mark.parametrize(("layout", "order"), EVERY)
def test_the_mean_of_even_light_stays_and_areas_differ_by_the_excess(layout: Layout, order: Order) -> None:
    one = AmplifierCrosstalk(share_percent=2.0, excess_percent=1.0, layout=layout, order=order)
    gains = Uniform(CAMERA, (one,)).gain_map()
    assert gains is not None
    assert gains.mean() == pytest.approx(1.0, rel=1e-12)
    if LAYOUTS[layout] in {(1, 2), (2, 1)}:  # c + d of the second, c - d of the first, over 1 + c
        assert np.unique(gains.round(12)) == pytest.approx([1.01 / 1.02, 1.03 / 1.02])
    plain, _ = moments(CAMERA, Exposure(UniformField(LIGHT), 0.01))
    lit, _ = moments(CAMERA, Exposure(UniformField(LIGHT), 0.01), (one,))
    assert lit.mean() == pytest.approx(plain.mean(), rel=2e-3)  # a mosaic's colours meet others of unlike brightness


def test_pixels_that_are_read_together_share_noise() -> None:
    """2 c / (1 + c^2) of white noise, 4 / sqrt(32768 pairs); and none in the form that couples light alone."""
    noise = np.random.default_rng(5).standard_normal((256, 256))
    for of_noise, stated in ((True, 0.1 / (1.0 + 0.05**2)), (False, 0.0)):
        law = CoupledAmplifiers(np.array([[0.0, 0.05], [0.05, 0.0]]), 1, 2, turned=True, of_noise=of_noise)
        coupled = signal_of(CAMERA, ()).add_laws(amplifiers=law).couple_noise(noise)
        left, right = coupled[:, :128], coupled[:, :127:-1]
        assert np.mean(left * right) / coupled.var() == pytest.approx(stated, abs=4.0 / np.sqrt(32768))


def test_the_dark_has_steps_of_the_pedestal() -> None:
    """Twice the excess, 1 %, of 1000 e over 1 + c: +-10 e / 1.02 about an unchanged mean."""
    one = AmplifierCrosstalk(share_percent=2.0, excess_percent=1.0, pedestal_e=1000.0)
    dark, _ = moments(CAMERA, Exposure(Darkness(), 0.0), (one,))
    half = CAMERA.cols // 2
    step = (dark[:, half:].mean() - dark[:, :half].mean()) / CAMERA.conversion_gain_dn_per_e
    assert step == pytest.approx(20.0 / 1.02, abs=5e-3)
    without, _ = moments(CAMERA, Exposure(Darkness(), 0.0), (one.replace_fields(pedestal_e=0.0),))
    assert np.ptp(without) < 1e-9


def test_no_share_is_no_law_and_the_other_form_couples_read_noise() -> None:
    assert AmplifierCrosstalk().on_signal(Signal(CAMERA)) == Signal(CAMERA)
    (other,) = AmplifierCrosstalk(share_percent=1.0).other_forms()
    assert other.noise == "coupled"


def test_both_ways_couple_with_one_sign() -> None:
    """Shares c + d and c - d of one sign cost nothing; opposite ones, of which areas differ in gain alone, cost 24
    standard deviations: 0.48 % over 0.02 %."""
    for excess in (-2.0, 0.0, 1.0, 2.0):
        assert AmplifierCrosstalk(share_percent=-2.0, excess_percent=excess).log_prior() == 0.0
    assert AmplifierCrosstalk(share_percent=0.0, excess_percent=0.5).log_prior() < -(24.0**2) / 2.0
    assert AmplifierCrosstalk(share_percent=0.5, excess_percent=0.52).log_prior() > -0.1
