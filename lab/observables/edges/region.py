"""The edges of a frame for which no region is stated (`find_edges`).

An edge has to cross enough phases of the pixels for its angle, and with that its MTF, to be determined
(`check_phases`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from lab.errors import NotDetermined
from lab.formats.recording_set import FrameCodes
from lab.observables.codes.step import step_of
from lab.observables.edges.finding import Region, region_planes
from lab.observables.edges.profile import EdgeSummary, summarise_edge
from sim.camera import Cfa
from sim.sensor.mosaic import phases
from sim.sensor.mosaic import step as period

LEAST_TILT_DEG = 0.5  # below, no frame has enough rows or columns along the edge

LEAST_EDGE_PX = 40.0  # length
LEAST_ROOM_PX = 20.0  # on either side
MOST_EDGES = 24  # of a frame
MOST_REFUSED = 72  # edges of a frame that are too little tilted, after which no more are looked for


def check_phases(step: str, cfa: Cfa, channel: str, region: Region, angle_deg: float) -> None:
    """Raise `NotDetermined` of `step` where the edge in a region crosses less than one sample period of its channel.

    Aliasing makes the position at which a row or column crosses the edge err periodically, by its phase to the samples.
    Over less than a period this error doesn't average out, and biases the angle.
    """
    tilt_deg = abs((angle_deg + 45.0) % 90.0 - 45.0)
    lines = region[2] - region[0] if abs((angle_deg + 90.0) % 180.0 - 90.0) < 45.0 else region[3] - region[1]
    period_px = period(cfa) / len(phases(cfa)[channel])
    crossed_px = lines * math.tan(math.radians(tilt_deg))
    if crossed_px < period_px:
        wanted = (
            f"{math.ceil(lines * period_px / crossed_px)} lines are enough"
            if tilt_deg > LEAST_TILT_DEG
            else "tilt it by 5 deg"
        )
        raise NotDetermined(
            step,
            f"an edge at {tilt_deg:.2g} deg over {lines} lines crosses {crossed_px:.2g} of the {period_px:g} px "
            f"between samples of {channel}: {wanted}",
        )


@dataclass(frozen=True)
class FoundEdge:
    """An edge: a region (row0, col0, row1, col1) about its middle, its angle from the vertical, the length that is
    used, why it can't be used ("": it can), as it crosses less than a period of the samples, and its summary in the
    green (or only) channel.
    """

    region: Region
    angle_deg: float
    length_px: float
    refused: str
    summary: EdgeSummary


def find_edges(frame: ArrayLike, cfa: Cfa = "MONO", saturation_dn: float | None = None) -> tuple[FoundEdge, ...]:
    """Find the edges of a raw frame (rows, cols) from which an MTF can be taken, the longest first, none twice.

    Line segments (LSD, von Gioi et al. 2010) of the frame binned to the pitch of a channel. About the middle of each
    segment a region is laid that holds no other edge. It is kept where both sides are uniform and unsaturated, and the
    MTF of the green (or only) channel can be determined. Edges that cross less than a period of the samples come with
    the reason why they can't be used, after the others. Raises `NotDetermined` where none can be used, with the reason
    of the last one refused.
    """
    recorded = np.asarray(frame)
    values = recorded.astype(float)
    if values.ndim != 2 or not np.isfinite(values).all():
        raise NotDetermined("mtf", "the frame has to be two-dimensional and finite to find edges in it")
    step = period(cfa)
    rows, cols = (n // step * step for n in values.shape)
    binned = values[:rows, :cols].reshape(rows // step, step, cols // step, step).mean(axis=(1, 3))
    low, high = np.quantile(binned, [0.002, 0.998])
    if not high > low:
        raise NotDetermined("mtf", "no edge found in the frame: it is uniform")
    picture = ndimage.gaussian_filter(np.clip((binned - low) / (high - low), 0.0, 1.0), 1.0)
    lines = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(np.rint(255.0 * picture).astype(np.uint8))[0]
    channel = "Y" if cfa == "MONO" else "G"
    code = step_of(FrameCodes.count(recorded).every) if recorded.dtype == np.uint16 else 0.0
    found: list[FoundEdge] = []
    reason = "no straight line of 40 px or more stands out"
    segments = np.empty((0, 4)) if lines is None else lines.reshape(-1, 4) * step
    lengths = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    for index in np.argsort(-lengths):
        usable = sum(not f.refused for f in found)
        if lengths[index] < LEAST_EDGE_PX or usable == MOST_EDGES or len(found) - usable == MOST_REFUSED:
            break
        x0, y0, x1, y1 = segments[index]
        middle, along = (
            (0.5 * (y0 + y1), 0.5 * (x0 + x1)),
            (np.array([y1 - y0, x1 - x0]) / lengths[index]),
        )
        if any(
            abs((middle[0] - 0.5 * (r0 + r1)) * along[1] - (middle[1] - 0.5 * (c0 + c1)) * along[0]) < LEAST_ROOM_PX
            and max(abs(middle[0] - 0.5 * (r0 + r1)), abs(middle[1] - 0.5 * (c0 + c1))) < 0.75 * max(r1 - r0, c1 - c0)
            for r0, c0, r1, c1 in (f.region for f in found)
        ):
            continue
        for share in (0.9, 0.7, 0.5):
            half = 0.5 * share * lengths[index] * np.abs(along)
            if 2.0 * half.max() < 0.6 * LEAST_EDGE_PX:
                break
            # across the edge, only so much that the next side of a square stays outside the region
            room = np.maximum(half, np.minimum(LEAST_ROOM_PX + half.min(), 0.47 * lengths[index] * np.abs(along).max()))
            region = _region_about(middle, room, values.shape)
            part = values[region[0] : region[2], region[1] : region[3]]
            if saturation_dn is not None and np.mean(part >= saturation_dn) > 0.002:
                reason = f"the edge at row {middle[0]:.0f}, column {middle[1]:.0f} is saturated; expose it shorter"
                continue
            try:
                edge = summarise_edge(region_planes(values, region, cfa, channel), code=code)
            except NotDetermined as refused:
                reason = f"at row {middle[0]:.0f}, column {middle[1]:.0f}: {refused.reason}"
                continue
            is_faint = max(edge.noise_std) > 0.1 * edge.contrast or edge.contrast < 0.05 * (high - low)
            if edge.residual_chi2_per_sample > 2.0 or is_faint:
                reason = (
                    f"what lies at row {middle[0]:.0f}, column {middle[1]:.0f} isn't one edge between two even fields"
                )
                continue
            reason = _refusal(cfa, channel, region, edge.angle_deg)
            found.append(FoundEdge(region, edge.angle_deg, float(share * lengths[index]), reason, edge))
            break
    found.sort(key=lambda f: bool(f.refused))
    if not found or found[0].refused:
        raise NotDetermined("mtf", f"no edge found in the frame: {reason}")
    return tuple(found)


def _region_about(middle: tuple[float, float], room: NDArray[np.float64], shape: tuple[int, ...]) -> Region:
    """Return the region that reaches `room` (rows, columns), px, to both sides of a place, within a frame of that
    shape.
    """
    start = np.maximum(np.ceil(np.array(middle) - room), 0).astype(int)
    stop = np.minimum(np.floor(np.array(middle) + room) + 1, shape).astype(int)
    return int(start[0]), int(start[1]), int(stop[0]), int(stop[1])


def _refusal(cfa: Cfa, channel: str, region: Region, angle_deg: float) -> str:
    """Say why an edge crosses too few phases of the samples; empty where it crosses enough."""
    try:
        check_phases("mtf", cfa, channel, region, angle_deg)
    except NotDetermined as refused:
        return (
            f"at row {0.5 * (region[0] + region[2]):.0f}, column {0.5 * (region[1] + region[3]):.0f}: {refused.reason}"
        )
    return ""
