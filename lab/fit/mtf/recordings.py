"""Slanted edges of a recording set: `measure_edge` for one edge, `fit_mtf` for all captures of a side."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import NotDetermined
from lab.fit.mtf.edges_in_frame import FoundEdge, find_edges
from lab.fit.mtf.estimate_mtf import DEFAULT_FREQUENCY_CY_PER_PX, planes_mtf
from lab.fit.mtf.phases import check_phases
from lab.fit.mtf.samples import Region, region_planes
from lab.fit.mtf.transfer_function import EdgeMtf
from lab.formats.recording_set import RecordingSet
from lab.formats.results import MtfCurve, NoiseFit
from sim.camera import Side


def measure_edge(
    recordings: RecordingSet,
    captures: Sequence[SlantedEdgeCapture],
    channel: str,
    noise: NoiseFit | None = None,
    frequency_cy_per_px: ArrayLike | None = None,
    region: Region | None = None,
) -> EdgeMtf:
    """MTF of one slanted edge in one channel (R, G, B or Y).

    `captures` are repeats of the same settings; their mean is analysed. The edge is the one in `region` (row0, col0,
    row1, col1). Without it, it is the one in the region of the capture, or else the longest that `find_edges` finds.
    The noise is the residual between the frame and the fitted edge; it includes the photo response non-uniformity,
    which repeats don't average out. Raises `NotDetermined` where the black level is unknown, the region is saturated
    or clipped at 0, or holds no edge.
    """
    first = captures[0]
    camera = recordings.camera(first.side)
    black = noise.black_level_dn if noise is not None and noise.black_level_dn is not None else camera.black_level_dn
    if black is None:
        raise NotDetermined("mtf", "the black level is neither fitted nor stated: add dark frames")
    frames = [recordings.frame(c) for c in captures]
    row0, col0, row1, col1 = region = region or first.region or _edges_of(recordings, first)[0].region
    saturated = float(np.mean(frames[0][row0:row1, col0:col1] >= camera.saturation_dn))
    if saturated > 0.002:
        raise NotDetermined("mtf", f"{first.id}: {100 * saturated:.1f} % of the region is saturated; expose it shorter")
    empty = float(np.mean(frames[0][row0:row1, col0:col1] <= 0))
    if black > 0.0 and empty > 0.002:
        raise NotDetermined(
            "mtf",
            f"{first.id}: {100 * empty:.1f} % of the region is at 0, below the black level {black:g}: it is clipped",
        )
    mean = np.mean([f.astype(float) for f in frames], axis=0) if len(frames) > 1 else frames[0]
    planes = region_planes(mean, region, camera.cfa, channel, black)
    frequency = DEFAULT_FREQUENCY_CY_PER_PX if frequency_cy_per_px is None else frequency_cy_per_px
    return planes_mtf(planes, frequency, code=1.0, frames=len(frames))


def _edges_of(recordings: RecordingSet, capture: SlantedEdgeCapture) -> tuple[FoundEdge, ...]:
    """Edges of the frame of a capture, those that can be used first; see `find_edges`."""
    camera = recordings.camera(capture.side)
    return find_edges(recordings.frame(capture), camera.cfa, camera.saturation_dn)


def fit_mtf(
    recordings: RecordingSet, side: Side, noise: NoiseFit | None = None, left_out: list[str] | None = None
) -> tuple[MtfCurve, ...]:
    """One MTF curve for every slanted-edge capture of `side` and every channel (R, G, B; or Y), captures in their
    order.

    A capture without a region gives the curves of all edges found in its frame, each with its region. The black level
    is that of `noise` where it was fitted, else the stated one. The angle is given in the half turn next to the
    nominal one of the capture. Edges that can't be used are left out, among them those that cross less than one sample period of their
    channel; `left_out` gets a line for each. Raises `NotDetermined` where none can be used.
    """
    captures = recordings.captures(SlantedEdgeCapture, side)
    if not captures:
        raise NotDetermined("mtf", "no slanted_edge captures")
    camera = recordings.camera(side)
    curves: list[MtfCurve] = []
    reasons: list[str] = [] if left_out is None else left_out
    for capture in captures:
        try:
            found = () if capture.region else _edges_of(recordings, capture)
        except NotDetermined as refused:
            reasons.append(f"{capture.id}: {refused.reason}")
            continue
        reasons += [f"{capture.id}: {f.refused}" for f in found if f.refused]
        regions = [capture.region] if capture.region else [f.region for f in found if not f.refused]
        for region, channel in itertools.product(regions, ("Y",) if camera.cfa == "MONO" else ("R", "G", "B")):
            try:
                edge = measure_edge(recordings, [capture], channel, noise, region=region)
                check_phases("mtf", camera.cfa, channel, region, edge.angle_deg)
            except NotDetermined as refused:
                reasons.append(f"{capture.id} ({channel}): {refused.reason}")
                continue
            turns = 0.0 if capture.angle_deg is None else 180.0 * round((capture.angle_deg - edge.angle_deg) / 180.0)
            row0, col0, row1, col1 = region
            field_mm = capture.field_mm
            if capture.region is None and camera.pixel_pitch_um is not None:
                pitch_mm = 1e-3 * camera.pixel_pitch_um
                field_mm = (pitch_mm * (row0 + row1 - camera.rows) / 2.0, pitch_mm * (col0 + col1 - camera.cols) / 2.0)
            curves.append(
                MtfCurve(
                    capture=capture.id,
                    channel=channel,
                    angle_deg=edge.angle_deg + turns,
                    angle_deg_std=edge.angle_deg_std,
                    field_mm=field_mm,
                    region=region,
                    frequency_cy_per_px=tuple(edge.frequency_cy_per_px.tolist()),
                    mtf=tuple(edge.mtf.tolist()),
                    mtf_std=tuple(edge.mtf_std.tolist()),
                    mtf50_cy_per_px=edge.mtf50_cy_per_px,
                    mtf50_cy_per_px_std=edge.mtf50_cy_per_px_std,
                    mtf10_cy_per_px=edge.mtf10_cy_per_px,
                    mtf10_cy_per_px_std=edge.mtf10_cy_per_px_std,
                )
            )
    if not curves:
        raise NotDetermined("mtf", reasons[0])
    return tuple(curves)
