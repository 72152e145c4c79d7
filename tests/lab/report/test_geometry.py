"""The report's geometry: what the charts draw is what the fit found."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from lab.fit.geometry import geometry_result
from lab.fit.stereo import fit_pairs
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.formats.results import ChannelGeometry, GeometryFit
from lab.observables.boards.calibration import calibrate_robustly
from lab.observables.boards.pairs import StereoPair
from lab.report.geometry import (
    charts_by_side,
    coverage,
    depth_map,
    draw_rectified,
    facts,
    lateral_colour,
    projection_map,
    residual_vectors,
)
from tests.lab.fit.projected import SHAPE, poses, seen


@pytest.fixture(scope="module")
def rig():
    """Views of a pair, both fits and the stereo fit."""
    rng, at = np.random.default_rng(0), poses(7)
    sides = [seen(rng, at, side=side) for side in ("left", "right")]
    fits = [geometry_result(calibrate_robustly(views, SHAPE)) for views in sides]
    pairs = [StereoPair(one, two) for one, two in zip(*sides, strict=True)]
    return pairs, fits, fit_pairs(pairs, *fits, (SHAPE, SHAPE))


def test_coverage_has_every_corner_and_a_closed_outline_of_each_view(rig):
    _, (left, _), _ = rig
    figure = coverage(left)
    outlines, corners = figure["data"][0::2], figure["data"][1::2]
    assert len(outlines) == len(corners) == 7
    assert [len(trace["x"]) for trace in corners] == [len(view.x_px) for view in left.residuals]
    assert all(trace["x"][0] == trace["x"][-1] and trace["y"][0] == trace["y"][-1] for trace in outlines)
    assert figure["layout"]["yaxis"]["range"] == [SHAPE[0] - 0.5, -0.5]  # rows run down


def test_residuals_are_enlarged_by_what_the_legend_says(rig):
    _, (left, _), _ = rig
    lines = residual_vectors(left)["data"][0]
    scale = float(lines["name"].split(", ")[1].split()[0])
    view = left.residuals[0]
    assert (lines["x"][1] - lines["x"][0]) / scale == pytest.approx(view.dx_px[0])
    assert (lines["y"][1] - lines["y"][0]) / scale == pytest.approx(view.dy_px[0])


def test_maps_show_the_values_and_label_them(rig):
    _, (left, _), stereo = rig
    figure = projection_map(left.projection[0])
    trace = figure["data"][0]
    assert trace["customdata"] == [list(row) for row in left.projection[0].projection_px_std]
    ticks = dict(zip(trace["colorbar"]["ticktext"], trace["colorbar"]["tickvals"], strict=True))
    assert all(10**value == pytest.approx(float(text)) for text, value in ticks.items())
    depth = depth_map(stereo.depth[0])["data"][0]
    assert any(value is None for row in depth["z"] for value in row)  # where the right camera doesn't look
    assert depth["colorbar"]["title"]["text"] == "mm"


def test_lateral_colour_has_bands_of_two_standard_uncertainties():
    channel = ChannelGeometry(
        channel="R", camera_matrix=((1, 0, 0), (0, 1, 0), (0, 0, 1)), distortion=(), rms_px=0.1, corners=400,
        radius_px=(0.0, 100.0), radial_shift_px=(0.0, 0.3), radial_shift_px_std=(0.01, 0.05),
    )  # fmt: skip
    shaded, line = lateral_colour((channel,))["data"]
    assert shaded["y"] == pytest.approx([0.02, 0.4, 0.2, -0.02])
    assert line["y"] == [0.0, 0.3]
    assert lateral_colour(()) is None


def test_facts_tell_the_warp_the_halves_and_the_models(rig):
    _, (left, _), _ = rig
    rows = dict(facts(left))
    assert "bend x" in rows["warp of the board (9 x 12 squares of 25 mm, none)"]
    assert "px difference" in rows["cross-validation of two halves of the views"]
    assert sum(name.startswith("pinhole projection, k1") for name in rows) == 3
    assert sum(name.startswith(("equidistant projection", "splined stereographic projection")) for name in rows) == 2
    assert sum("chosen" in text for text in rows.values()) == 1


def test_an_older_fit_without_maps_has_no_charts_and_no_errors():
    bare = GeometryFit(camera_matrix=((1, 0, 0), (0, 1, 0), (0, 0, 1)), distortion=(0.0,) * 5, rms_px=0.1)
    assert all(
        figure is None for _, figures, _ in charts_by_side({"left": bare, "right": None}) for figure in figures.values()
    )
    assert facts(bare) == []


def test_rectified_pair_is_one_picture_of_both(rig):
    pairs, _, stereo = rig
    captures = [capture for pair in pairs for capture in (pair.left.capture, pair.right.capture)]
    captures = [c.model_copy(update={"frame": f"{c.id}.npy"}) for c in captures]
    camera = DataSheet(rows=SHAPE[0], cols=SHAPE[1], pixel_pitch_um=3.0, fill_factor=1.0, cfa="MONO", bit_depth=12)
    frame = (np.indices(SHAPE).sum(axis=0) % 512).astype(np.uint16)
    recordings = RecordingSet(
        Manifest(cameras={"left": camera, "right": camera}, captures=tuple(captures)),
        frames={c.frame: frame for c in captures},
    )
    uri, pose = draw_rectified(recordings, stereo)
    assert pose in {capture.pose for capture in captures}
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (round(1200 * SHAPE[0] / (2 * SHAPE[1])), 1200, 3)
    assert draw_rectified(recordings, stereo.model_copy(update={"rectification": None})) is None
