"""MTF curves of a recording set: every channel on its own grid, refusals, edges without a stated region."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.mtf.recordings import fit_mtf
from tests.lab.fit.mtf.drawn_edges import edge, gaussian_mtf50, squares


def recordings(frames, captures, cfa="RGGB"):
    rows, cols = next(iter(frames.values())).shape
    camera = SimpleNamespace(
        cfa=cfa, black_level_dn=64.0, saturation_dn=4095.0, pixel_pitch_um=1.5, rows=rows, cols=cols
    )
    return SimpleNamespace(
        camera=lambda side: camera,
        captures=lambda kind=None, side=None: captures,
        frame=lambda capture: frames[capture.id],
    )


def capture(name, **more):
    stated = {"region": (31, 20, 191, 180), "angle_deg": 95.0, "field_mm": (0.0, 0.0)}
    return SimpleNamespace(id=name, side="left", **(stated | more))


def test_fit_takes_every_channel_of_the_mosaic_on_its_own_grid():
    rng = np.random.default_rng(4)
    sigma = {"R": 0.8, "G": 0.6, "B": 0.5}
    frame = np.zeros((200, 200))
    for phase, channel in enumerate("RGGB"):
        i, j = phase // 2, phase % 2
        frame[i::2, j::2] = edge(200, 95.0, sigma[channel])[i::2, j::2]
    raw = (64 + np.round(0.4 * rng.poisson(8000.0 * frame))).astype(np.uint16)
    curves = fit_mtf(recordings({"edge-1": raw}, [capture("edge-1")]), "left")
    assert [c.channel for c in curves] == ["R", "G", "B"]
    for curve in curves:
        assert curve.angle_deg == pytest.approx(95.0, abs=5 * curve.angle_deg_std)
        assert curve.mtf50_cy_per_px == pytest.approx(
            gaussian_mtf50(sigma[curve.channel]), abs=4 * curve.mtf50_cy_per_px_std
        )


def test_fit_refuses_a_saturated_edge():
    raw = np.full((200, 200), 4095, np.uint16)
    raw[:, :100] = 500
    with pytest.raises(NotDetermined, match="saturated"):
        fit_mtf(recordings({"edge-1": raw}, [capture("edge-1")]), "left")


def test_fit_looks_for_edges_where_no_region_is_stated():
    light = squares((220, 220), [(110, 110, 60, 5.0)], 0.6)
    raw = (64 + np.round(0.4 * np.random.default_rng(0).poisson(8000 * light))).astype(np.uint16)
    stated = capture("edge-1", region=None, angle_deg=None, field_mm=None)
    curves = fit_mtf(recordings({"edge-1": raw}, [stated]), "left")
    assert len(curves) == 12  # four sides, three channels
    assert len({c.region for c in curves}) == 4
    assert all(c.mtf10_cy_per_px is None or c.mtf10_cy_per_px > c.mtf50_cy_per_px for c in curves)
    # 1.5 um pixels: regions lie 60 px from the middle of the frame
    assert all(np.hypot(*c.field_mm) == pytest.approx(60 * 1.5e-3, abs=0.01) for c in curves)


def test_edges_that_cross_less_than_a_period_of_their_channel_are_left_out():
    """A side at 0.8 deg over 108 lines crosses 1.5 px: a period of green (1 px), less than one of red and blue (2 px)."""
    light = squares((220, 220), [(110, 110, 60, 0.8)], 0.6)
    raw = (64 + np.round(0.4 * np.random.default_rng(0).poisson(8000 * light))).astype(np.uint16)
    stated = capture("edge-1", region=None, angle_deg=None, field_mm=None)
    left_out: list[str] = []
    curves = fit_mtf(recordings({"edge-1": raw}, [stated]), "left", None, left_out)
    assert [c.channel for c in curves] == ["G"] * 4
    assert len(left_out) == 8
    assert all("of the 2 px between samples of" in line and "lines are enough" in line for line in left_out)
