"""MTF curves of a recording set: every channel on its own grid, refusals, edges without a stated region."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.mtf import edge_mtf, fit_mtf
from lab.formats.recording_set import FrameCodes
from lab.observables.edges.region import find_edges
from tests.lab.observables.edges.drawn_edges import edge, gaussian_mtf50, squares

DATA = Path(__file__).resolve().parents[4] / "shared" / "data" / "sfrmat5_edges"


@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
def test_edges_are_found_by_themselves(cfa):
    light = squares((300, 420), [(100, 110, 60, 5.0), (150, 300, 70, 40.0)], 0.6)
    raw = 64 + np.round(0.4 * np.random.default_rng(0).poisson(8000 * light))
    found = find_edges(raw, cfa, 4095.0)
    assert len(found) == 8
    wanted = sorted([-5.0, -5.0, 85.0, 85.0, -40.0, -40.0, 50.0, 50.0])
    np.testing.assert_allclose(sorted(e.angle_deg for e in found), wanted, atol=0.1)
    for e in found:
        row0, col0, row1, col1 = e.region
        mtf = edge_mtf(raw[row0:row1, col0:col1] - 64)
        assert mtf.mtf50_cy_per_px == pytest.approx(gaussian_mtf50(0.6), abs=4 * mtf.mtf50_cy_per_px_std)


def test_edges_that_cross_less_than_a_period_come_with_the_reason():
    """0.4 deg over some 100 lines: 0.7 px. The others, at 5 deg, come first."""
    light = squares((300, 420), [(100, 110, 60, 5.0), (150, 300, 70, 0.4)], 0.6)
    raw = 64 + np.round(0.4 * np.random.default_rng(0).poisson(8000 * light))
    found = find_edges(raw, "MONO", 4095.0)
    assert [bool(e.refused) for e in found] == [False] * 4 + [True] * 4
    assert all(abs(e.angle_deg) % 90.0 == pytest.approx(5.0, abs=0.1) or abs(e.angle_deg) > 80.0 for e in found[:4])
    assert all("of the 1 px between samples of Y: tilt it by 5 deg" in e.refused for e in found[4:])
    with pytest.raises(NotDetermined, match="crosses 0"):
        find_edges(raw[:, 210:], "MONO", 4095.0)


def test_a_real_charts_upright_borders_are_not_taken_for_slanted_edges():
    """The grey patches in the middle of a chart: their borders stand upright, the star's sides at 40 and 50 deg."""
    path = DATA / "sfrmat5_ISO_12233-2023_chart.jpg"
    if not path.is_file():
        pytest.skip("sfrmat5_edges isn't beside the project")
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[500:1200, 900:1600].astype(float)
    found = find_edges(picture, "MONO", 255.0)
    tilt_deg = np.array([abs((e.angle_deg + 45.0) % 90.0 - 45.0) for e in found])
    refused = np.array([bool(e.refused) for e in found])
    assert refused.sum() > 4
    assert np.all(tilt_deg[refused] < 0.7)
    assert np.all(tilt_deg[~refused] > 4.0)


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (np.full((200, 200), 7.0), "uniform"),
        (np.random.default_rng(0).normal(100, 3, (200, 200)), "no straight line"),
        (np.full((200, 200), np.nan), "finite"),
        (np.minimum(1500.0 * squares((200, 200), [(100, 100, 50, 5.0)], 0.6), 1023), "saturated"),
    ],
    ids=["uniform", "noise", "not finite", "saturated"],
)
def test_a_frame_without_an_edge_says_why(frame, reason):
    with pytest.raises(NotDetermined, match=reason):
        find_edges(frame, "MONO", 1023.0)


def recordings(frames, captures, cfa="RGGB"):
    rows, cols = next(iter(frames.values())).shape
    camera = SimpleNamespace(
        cfa=cfa, black_level_dn=64.0, saturation_dn=4095.0, pixel_pitch_um=1.5, rows=rows, cols=cols
    )
    return SimpleNamespace(
        camera=lambda side: camera,
        captures=lambda kind=None, side=None: captures,
        frame=lambda capture: frames[capture.id],
        codes=lambda capture: FrameCodes.count(frames[capture.id]),
        once=lambda key, make, *, whatever_is_stated: make(),
    )


def capture(name, **more):
    stated = {"region": (31, 20, 191, 180), "angle_deg": 95.0, "field_mm": (0.0, 0.0)}
    return SimpleNamespace(id=name, frame=name, side="left", **(stated | more))


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
    """A side at 0.8 deg over 108 lines crosses 1.5 px: a period of green (1 px), less than one of red and blue (2
    px).
    """
    light = squares((220, 220), [(110, 110, 60, 0.8)], 0.6)
    raw = (64 + np.round(0.4 * np.random.default_rng(0).poisson(8000 * light))).astype(np.uint16)
    stated = capture("edge-1", region=None, angle_deg=None, field_mm=None)
    left_out: list[str] = []
    curves = fit_mtf(recordings({"edge-1": raw}, [stated]), "left", None, left_out)
    assert [c.channel for c in curves] == ["G"] * 4
    assert len(left_out) == 8
    assert all("of the 2 px between samples of" in line and "lines are enough" in line for line in left_out)
