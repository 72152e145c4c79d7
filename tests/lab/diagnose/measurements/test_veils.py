"""Veiling glare: uniform over the frame, or a halo about its source."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from lab.diagnose.measurements.screens import screen_block
from lab.diagnose.measurements.slanted_edge import edge_block
from lab.diagnose.measurements.spectral import chart_block
from lab.measure.patches import Surroundings, harmonics
from mocks.former import laws as concealed
from sim.point import halos
from tests.lab.diagnose.on_blocks import former, names, verdict


@pytest.mark.parametrize("std_px", [6.0, 20.0, 60.0])
def test_surroundings_are_what_a_filter_leaves(std_px: float) -> None:
    rng = np.random.default_rng(3)
    picture = ndimage.uniform_filter(rng.random((60, 90)), 7)
    where = np.zeros(picture.shape, bool)
    where[20:26, 50:58] = True
    expected = ndimage.gaussian_filter(picture, std_px, mode="reflect", truncate=6.0)[where].mean()
    low = harmonics(picture)
    assert Surroundings.of(low, where).mean(std_px) == pytest.approx(expected, abs=1e-6)
    box = Surroundings.of_box(low, picture.shape, slice(20, 26), slice(50, 58))
    assert box.mean(std_px) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("variant", [0, 1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_glare_has_its_name_whatever_its_reach(variant: int) -> None:
    """Evenly spread; half of it within a halo of a quarter of the frame; fading from the middle."""
    law = concealed.VeilingGlareLaw(2.0, variant, 9)
    recordings = former(104, law, cfa="RGGB", kinds=("dark", "flat", "chart", "slanted_edge", "screen"))
    found = verdict(recordings, edge_block, chart_block, screen_block)
    assert names(found) == ["veiling_glare"]
    # of what a lens spreads a halo's share is told apart only where there is one
    assert bool(halos(found.model.camera, (found.named[0].effect,))) == (variant == 1)
