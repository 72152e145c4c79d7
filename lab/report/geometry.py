"""The report's geometry: coverage, reprojection residuals, projection uncertainty, lateral colour, depth uncertainty,
rectified pair."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from lab.capture_kinds.charuco import CharucoCapture
from lab.errors import InputError, NotDetermined
from lab.fit.stereo import rectification_maps
from lab.formats.recording_set import RecordingSet
from lab.formats.results import ChannelGeometry, DepthUncertainty, GeometryFit, ProjectionUncertainty, StereoFit
from lab.formats.results.words import PROJECTION_NAMES, format_value
from lab.observables.boards.detection import luminance
from lab.report.charts import CHANNEL, Figure, Trace, axis, band, layout
from lab.report.pictures import photograph_data_uri
from sim.camera import Side
from sim.spectrum import FloatArray

ARROWS = 0.025  # of the frame's width: drawn length of the 95 % quantile of the residuals
SCALES = (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0)
VIEW_COLOURS = ("#3d7be0", "#d1495b", "#2a9d57", "#e08a1e", "#8a63d2", "#1f9aa5", "#b5651d", "#c154a5")
UNCERTAINTY = [[0.0, "#f2f7fb"], [0.25, "#a8cfe3"], [0.5, "#4f9bc4"], [0.75, "#20639b"], [1.0, "#0b2c52"]]
STRIPES = 12  # lines across the rectified pair


def _frame_axes(shape: tuple[float, float], **more: Any) -> dict[str, Any]:
    """Axes of a frame of `shape` (rows, cols): y downwards, square pixels."""
    return {
        "xaxis": axis("column, px", range=[-0.5, shape[1] - 0.5], constrain="domain", showgrid=False),
        "yaxis": axis("row, px", range=[shape[0] - 0.5, -0.5], scaleanchor="x", constrain="domain", showgrid=False),
    } | more


def _shape(geometry: GeometryFit) -> tuple[float, float]:
    """(rows, cols) of the frame."""
    if geometry.projection:
        return geometry.projection[0].y_px[-1] + 1, geometry.projection[0].x_px[-1] + 1
    return (
        max(y for view in geometry.residuals for y in view.y_px) + 1,
        max(x for view in geometry.residuals for x in view.x_px) + 1,
    )


def _height(shape: tuple[float, float]) -> int:
    return int(110 + 500 * min(shape[0] / shape[1], 1.2))


def frame_layout(shape: tuple[float, float]) -> dict[str, Any]:
    """Return the layout of a chart over a frame of `shape` (rows, cols)."""
    return layout(_height(shape), **_frame_axes(shape))


def coverage(geometry: GeometryFit) -> Figure | None:
    """Draw the corners of each view in the frame, with their convex hull."""
    if not geometry.residuals:
        return None
    data: list[Trace] = []
    for number, view in enumerate(geometry.residuals):
        colour = VIEW_COLOURS[number % len(VIEW_COLOURS)]
        points = np.column_stack([view.x_px, view.y_px])
        try:
            outline = points[ConvexHull(points).vertices]
        except QhullError:  # all in a line
            outline = points
        closed = np.concatenate([outline, outline[:1]])
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": closed[:, 0].tolist(),
                "y": closed[:, 1].tolist(),
                "line": {"color": colour, "width": 1},
                "hoverinfo": "skip",
                "showlegend": False,
            }
        )
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": view.capture,
                "x": list(view.x_px),
                "y": list(view.y_px),
                "marker": {"color": colour, "size": 3},
                "showlegend": False,
            }
        )
    shape = _shape(geometry)
    return {"data": data, "layout": frame_layout(shape)}


def lines_of_vectors(at: FloatArray, vector: FloatArray, shape: tuple[float, float], name: str) -> list[Trace]:
    """Draw vectors in a frame as lines, enlarged by a round number.

    at, vector : places and vectors, (n, 2), x and y in px
    shape : rows and columns of the frame
    name : of the trace, to which the factor is added

    Returns two traces: the lines and the places.

    >>> lines, places = lines_of_vectors(np.array([[10.0, 20.0]]), np.array([[0.1, 0.0]]), (480.0, 640.0), "residuals")
    >>> places["x"], places["y"]
    ([10.0], [20.0])
    """
    usual = max(float(np.percentile(np.linalg.norm(vector, axis=1), 95)), 1e-9)
    wanted = ARROWS * shape[1] / usual
    scale = max([factor for factor in SCALES if factor <= wanted], default=SCALES[0])
    ends = at + scale * vector
    lines = np.stack([at, ends, np.full_like(at, np.nan)], axis=1).reshape(-1, 2)
    return [
        {
            "type": "scatter",
            "mode": "lines",
            "name": f"{name}, {scale:g} times enlarged",
            "x": lines[:, 0].tolist(),
            "y": lines[:, 1].tolist(),
            "line": {"color": "#d1495b", "width": 1},
            "hoverinfo": "skip",
            "showlegend": True,
        },
        {
            "type": "scatter",
            "mode": "markers",
            "x": at[:, 0].tolist(),
            "y": at[:, 1].tolist(),
            "marker": {"color": "@fg", "size": 2},
            "hoverinfo": "skip",
            "showlegend": False,
        },
    ]


def residual_vectors(geometry: GeometryFit) -> Figure | None:
    """Draw the reprojection residuals of all corners, measured minus predicted, as enlarged lines."""
    if not geometry.residuals:
        return None
    at = np.array([(x, y) for view in geometry.residuals for x, y in zip(view.x_px, view.y_px, strict=True)])
    rest = np.array([(x, y) for view in geometry.residuals for x, y in zip(view.dx_px, view.dy_px, strict=True)])
    shape = _shape(geometry)
    return {"data": lines_of_vectors(at, rest, shape, "residual"), "layout": frame_layout(shape)}


def _map(
    x: tuple[float, ...], y: tuple[float, ...], z: list[list[float | None]], unit: str, tick: str, height: int = 0
) -> Figure:
    """Return a contour map over the frame, on a logarithmic colour scale where it spans more than a factor of eight."""
    shape = (y[-1] + 1, x[-1] + 1)
    known = np.array([value for row in z for value in row if value is not None])
    low, high = float(known.min()), float(known.max())
    wide = low > 0 and high / low > 8
    shown = [[None if value is None else (float(np.log10(value)) if wide else value) for value in row] for row in z]
    bar: dict[str, Any] = {"title": {"text": unit, "side": "right"}, "thickness": 10, "outlinewidth": 0}
    if wide:
        decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        ticks = [m * 10.0**d for d in decades for m in (1, 2, 5) if low <= m * 10.0**d <= high]
        bar |= {"tickvals": [float(np.log10(value)) for value in ticks], "ticktext": [f"{value:g}" for value in ticks]}
    return {
        "data": [
            {
                "type": "contour",
                "x": list(x),
                "y": list(y),
                "z": shown,
                "customdata": z,
                "hovertemplate": f"(%{{x:.0f}}, %{{y:.0f}}) px: %{{customdata:{tick}}} {unit}<extra></extra>",
                "colorscale": UNCERTAINTY,
                "contours": {"coloring": "heatmap"},
                "ncontours": 14,
                "line": {"width": 0.6, "color": "rgba(0,0,0,0.35)"},
                "colorbar": bar,
                "connectgaps": False,
            }
        ],
        "layout": layout(height or _height(shape), **_frame_axes(shape)),
    }


def projection_map(uncertainty: ProjectionUncertainty) -> Figure:
    """Draw the standard deviation of the projection over the frame."""
    rows: list[list[float | None]] = [list(row) for row in uncertainty.projection_px_std]
    return _map(uncertainty.x_px, uncertainty.y_px, rows, "px", ".2g")


def depth_map(depth: DepthUncertainty) -> Figure | None:
    """Draw the standard deviation of a depth over the left camera's frame."""
    rows = [list(row) for row in depth.total_mm_std]
    if not any(value is not None for row in rows for value in row):
        return None
    return _map(depth.x_px, depth.y_px, rows, "mm", ".3g", height=330)


def lateral_colour(channels: tuple[ChannelGeometry, ...]) -> Figure | None:
    """Draw the radial shift of red and blue relative to green over the distance from the principal point, with a band
    of two standard deviations.
    """
    drawn = [channel for channel in channels if channel.radius_px]
    if not drawn:
        return None
    data: list[Trace] = []
    for channel in drawn:
        colour = CHANNEL[channel.channel]
        shift, std = np.array(channel.radial_shift_px), np.array(channel.radial_shift_px_std)
        data.append(band(channel.radius_px, shift, 2.0 * std, colour))
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": f"{channel.channel} − G, {channel.corners} corners",
                "x": list(channel.radius_px),
                "y": shift.tolist(),
                "line": {"color": colour, "width": 2},
            }
        )
    return {
        "data": data,
        "layout": layout(
            280,
            xaxis=axis("distance from the principal point, px", rangemode="tozero"),
            yaxis=axis("radial shift, px outwards", zeroline=True),
        ),
    }


def facts(geometry: GeometryFit) -> list[tuple[str, str]]:
    """Return further results of a fit as rows of a table."""
    rows: list[tuple[str, str]] = []
    if geometry.corner_px_std is not None:
        noise = f", {geometry.corner_noise_px:.4f} px expected from image noise" if geometry.corner_noise_px else ""
        rows.append(("standard deviation of a corner's coordinate", f"{geometry.corner_px_std:.4f} px{noise}"))
    if geometry.corner_errors is not None:
        parts_px = geometry.corner_errors
        rows.append(
            (
                "of it, each corner by itself; shared by neighbours",
                f"{parts_px.noise_px:.4f} px (sampling error); {parts_px.model_error_px:.4f} px (model error)",
            )
        )
    halves = geometry.cross_validation
    if halves is not None:
        error = f"model error {halves.model_error_px:.3f} px" if halves.model_error_px > 0 else "no model error"
        rows.append(
            (
                "cross-validation of two halves of the views",
                f"{halves.difference_px:.4f} px difference, {halves.expected_px:.4f} px expected: {error}",
            )
        )
    for warp in geometry.board_warp:
        parts = [
            f"{name} {format_value(value, std, 'mm')}"
            for name, value, std in (
                ("bend x", warp.bend_x_mm, warp.bend_x_mm_std),
                ("bend y", warp.bend_y_mm, warp.bend_y_mm_std),
                ("twist", warp.twist_mm, warp.twist_mm_std),
            )
            if value is not None
        ]
        rows.append((f"warp of the board ({warp.board})", ", ".join(parts) or "not determined"))
    for channel in geometry.channels:
        if channel.radius_px:
            shift = format_value(channel.radial_shift_px[-1], channel.radial_shift_px_std[-1], "px")
            at = f"at {channel.radius_px[-1]:.0f} px from the principal point"
            rows.append((f"lateral colour, {channel.channel} − G", f"{shift} {at}"))
    rows += [
        (
            f"{model.lens_projection.replace('_', ' ')} projection, {' '.join(model.coefficients)}",
            f"held-out views {model.held_out_rms_px:.4f} px rms: {model.reason}",
        )
        for model in geometry.distortion_models
    ]
    return rows


def draw_rectified(recordings: RecordingSet, stereo: StereoFit, width_px: int = 1200) -> tuple[str, str] | None:
    """Draw both cameras' images of one pose, rectified, side by side with lines along the rows; and the pose's name."""
    try:
        sides: tuple[Side, Side] = ("left", "right")
        left, right = (
            {capture.pose: capture for capture in recordings.captures(CharucoCapture, side)} for side in sides
        )
        poses = [pose for pose in left if pose in right]
        if not poses:
            return None
        pose = poses[len(poses) // 2]
        camera = recordings.camera("left")
        maps = rectification_maps(stereo, (camera.rows, camera.cols))
        halves = []
        for side, captures in (("left", left), ("right", right)):
            frame = luminance(recordings.frame(captures[pose]))
            picture = np.clip(255.0 * frame, 0, 255).astype(np.uint8)
            halves.append(cv2.remap(picture, *maps["left" if side == "left" else "right"], cv2.INTER_LINEAR))
    except (InputError, NotDetermined):
        return None
    both = np.hstack(halves)
    factor = width_px / both.shape[1]
    size = (width_px, max(1, round(both.shape[0] * factor)))
    both = cv2.resize(both, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR)
    coloured = np.stack([both] * 3, axis=-1)
    for row in np.linspace(0, size[1] - 1, STRIPES + 2)[1:-1].round().astype(int):
        coloured[row] = (np.array([224, 138, 30]) * 0.8 + 0.2 * coloured[row]).astype(np.uint8)
    coloured[:, width_px // 2 - 1 : width_px // 2 + 1] = 255
    return photograph_data_uri(coloured), pose


def context(geometry: GeometryFit | None) -> dict[str, Any]:
    """Return the variables of the page for one camera, besides its key figures."""
    if geometry is None:
        return {}
    return {
        "projection": PROJECTION_NAMES[geometry.lens_projection],
        "facts": facts(geometry),
        "rejected": (*geometry.rejected, *geometry.rejected_corners),
        "remarks": geometry.remarks,
    }


def charts_by_side(fits: Mapping[Side, GeometryFit | None]) -> list[tuple[str, dict[Side, Figure | None], str]]:
    """Return title, figure of each side, and caption of each chart of the cameras."""

    def of(draw: Callable[[GeometryFit], Figure | None]) -> dict[Side, Figure | None]:
        return {side: draw(fit) if fit is not None else None for side, fit in fits.items()}

    def at(place: int) -> Callable[[GeometryFit], Figure | None]:
        return lambda fit: projection_map(fit.projection[place]) if len(fit.projection) > place else None

    known = next((fit.projection for fit in fits.values() if fit is not None and fit.projection), ())
    rows = [
        ("Coverage by the boards", of(coverage), "Corners of each view in the frame, and their convex hull."),
        ("Reprojection residuals, measured − predicted", of(residual_vectors), ""),
    ]
    for place, projection in enumerate(known):
        where = "at infinity" if projection.distance_mm is None else "at the boards' distance"
        caption = (
            "Standard deviation in the worst direction; the rigid motion that the corners can't separate from the "
            "intrinsics is removed."
        )
        rows.append(
            (f"Uncertainty of the projection, {where}", of(at(place)), caption if place == len(known) - 1 else "")
        )
    rows.append(("Lateral colour", of(lambda fit: lateral_colour(fit.channels)), "Bands: two standard deviations."))
    return rows


def stereo_context(recordings: RecordingSet, stereo: StereoFit | None) -> dict[str, Any]:
    """Return the variables of the page for the pair: depth maps and a rectified pose."""
    if stereo is None:
        return {"depth": [], "rectified": None, "row_rms_px": None, "rejected": (), "remarks": ()}
    return {
        "depth": [(depth, figure) for depth in stereo.depth if (figure := depth_map(depth)) is not None],
        "rectified": draw_rectified(recordings, stereo),
        "row_rms_px": stereo.rectification.row_rms_px if stereo.rectification else None,
        "rejected": stereo.rejected,
        "remarks": stereo.remarks,
    }
