"""The flare chart: a known veil in its black square, intervals, the sequence that shows it, and charts that aren't."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from lab.errors import NotDetermined
from lab.standards.iso18844 import FlareChart, Iso18844FromChart, find_black_square, measure_flare_chart

SHAPE, WHITE, DARK, FLARE, SIDE_PX = (120, 160), 2000.0, 64.0, 0.008, 24
NOISE = (4.0, 30.0)


def frames(rng: np.random.Generator | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The lit chart, blurred by 1 px, with a veil of 0.8 % of white in its black square; and the dark screen."""
    chart = np.ones(SHAPE)
    row, col = SHAPE[0] // 2, SHAPE[1] // 2
    half = SIDE_PX // 2
    chart[row - half : row + half, col - half : col + half] = FLARE
    lit = DARK + WHITE * ndimage.gaussian_filter(chart, 1.0)
    dark = np.full(SHAPE, DARK)
    if rng is not None:
        lit = lit + np.where(chart < 0.5, *NOISE) * rng.standard_normal(SHAPE)
    return lit, dark


def test_flare_is_that_of_the_veil() -> None:
    """Half of the square's side is 6 px from its border, 6 standard deviations of the blur: 1e-9 of white."""
    found = measure_flare_chart(*frames(), NOISE)
    assert found.black_dn / found.white_dn == pytest.approx(FLARE, rel=1e-5)
    assert found.black_percent == pytest.approx(100.0 * SIDE_PX**2 / np.prod(SHAPE), rel=0.01)


def test_intervals_hold() -> None:
    rng, held = np.random.default_rng(14), 0
    side = SimpleNamespace(side="left")
    for _ in range(100):
        chart = measure_flare_chart(*frames(rng), NOISE)
        one = Iso18844FromChart(side, "G", chart, 1.5).flare
        held += abs(one.value - 100.0 * FLARE) < 1.96 * one.std
    assert 90 <= held <= 99, held


def test_small_chart_and_large_square_are_told() -> None:
    side = SimpleNamespace(side="left")
    chart = FlareChart(10.0, 0.1, 2000.0, 0.1, 7.0)
    lines = [one.line for one in Iso18844FromChart(side, "G", chart, 1.2).deviations()]
    assert lines[0].startswith("extent of the white chart beyond the field of view: +20 % of the field; ")
    assert lines[1].startswith("black area of the chart: 7 % of the frame; the standard asks for 5 % at most")
    assert not list(Iso18844FromChart(side, "G", FlareChart(10.0, 0.1, 2000.0, 0.1, 2.0), 1.5).deviations())


def test_even_frame_has_no_square() -> None:
    with pytest.raises(NotDetermined, match="no black square"):
        find_black_square(np.full(SHAPE, 100.0))


def test_dark_border_isnt_white() -> None:
    """A screen that ends within the frame: what lies beyond is neither the square nor white."""
    lit, dark = frames()
    lit[:, :20] = DARK
    _, inner, outer = find_black_square(lit - dark)
    assert inner[SHAPE[0] // 2, SHAPE[1] // 2]
    assert not outer[:, :20].any()
