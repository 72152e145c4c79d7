"""The edges of captures, each summarised once: `measure_edge` for that of a region, `edges_of` for those of a frame.

A summary depends on the frames, the region, and which pixels have one colour. Fits, validation and diagnosis read the
same one (`RecordingSet.summarised`). Statements on levels decide only whether an edge is refused as clipped.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import partial
from operator import attrgetter

import numpy as np

from lab.capture_kinds.slanted_edge import EdgeCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import CodeCounts, RecordingSet
from lab.formats.results import NoiseFit
from lab.observables.codes.step import step_of
from lab.observables.edges.finding import Region, region_planes
from lab.observables.edges.profile import EdgeSummary, summarise_edge
from lab.observables.edges.region import FoundEdge, find_edges
from sim.camera import Cfa
from sim.sensor.mosaic import phases, step

MOST_CLIPPED = 0.002  # of the pixels of a region, at the highest code or at 0


def measure_edge(
    recordings: RecordingSet,
    captures: Sequence[EdgeCapture],
    channel: str,
    noise: NoiseFit | None = None,
    region: Region | None = None,
) -> EdgeSummary:
    """Summarise one slanted edge in one channel (R, G, B or Y).

    `captures` are repeats of the same settings; their mean is analysed. The edge is the one in `region` (row0, col0,
    row1, col1). Without it, it is the one in the region of the capture, or else the longest that `find_edges` finds.
    The noise is the residual between the frame and the fitted edge; it includes the photo response non-uniformity,
    which repeats don't average out. `noise`: its black level, else the stated one, tells whether codes of 0 are
    clipped. Raises `NotDetermined` where the region is saturated or clipped at 0, or holds no edge.
    """
    region = region or captures[0].region or edges_of(recordings, captures[0])[0].region
    _refuse_clipped(recordings, captures[0], noise, region)
    cfa = recordings.camera(captures[0].side).cfa
    return recordings.once(
        _key(captures, cfa, channel, region),
        lambda: _summarise(recordings, captures, cfa, channel, region),
        whatever_is_stated=True,
    )


def _key(captures: Sequence[EdgeCapture], cfa: Cfa, channel: str, region: Region) -> tuple[Hashable, ...]:
    """Return all that a summary depends on."""
    return "edge", tuple(c.frame for c in captures), region, tuple(sorted(phases(cfa)[channel])), step(cfa)


def _summarise(
    recordings: RecordingSet, captures: Sequence[EdgeCapture], cfa: Cfa, channel: str, region: Region
) -> EdgeSummary:
    """Summarise the edge in the mean of the captures' frames."""
    frames = [recordings.frame(c) for c in captures]
    mean = np.mean([f.astype(float) for f in frames], axis=0) if len(frames) > 1 else frames[0]
    code = step_of(CodeCounts.total(recordings.codes(c).every for c in captures))
    return summarise_edge(region_planes(mean, region, cfa, channel), code=code, frames=len(frames))


def _refuse_clipped(recordings: RecordingSet, capture: EdgeCapture, noise: NoiseFit | None, region: Region) -> None:
    """Raise `NotDetermined` where pixels of a region are saturated, or at 0 below the black level."""
    camera = recordings.camera(capture.side)
    row0, col0, row1, col1 = region
    part = recordings.frame(capture)[row0:row1, col0:col1]
    saturated = float(np.mean(part >= camera.saturation_dn))
    if saturated > MOST_CLIPPED:
        raise NotDetermined(
            "mtf", f"{capture.id}: {100 * saturated:.1f} % of the region is saturated; expose it shorter"
        )
    black = noise.black_level_dn if noise is not None and noise.black_level_dn is not None else camera.black_level_dn
    empty = float(np.mean(part <= 0))
    if empty > MOST_CLIPPED and black is None:
        raise NotDetermined(
            "mtf",
            f"{capture.id}: {100 * empty:.1f} % of the region is at 0, and the black level, neither fitted nor stated, "
            "may lie above: add dark frames",
        )
    if empty > MOST_CLIPPED and black is not None and black > 0.0:
        raise NotDetermined(
            "mtf",
            f"{capture.id}: {100 * empty:.1f} % of the region is at 0, below the black level {black:g}: it is clipped",
        )


def edges_of(recordings: RecordingSet, capture: EdgeCapture) -> tuple[FoundEdge, ...]:
    """Find the edges of the frame of a capture, those that can be used first; see `find_edges`. Their summaries are
    those of `measure_edge`.
    """
    camera = recordings.camera(capture.side)
    frame, cfa, saturation_dn = capture.frame, camera.cfa, camera.saturation_dn

    def find() -> tuple[FoundEdge, ...]:
        found = find_edges(recordings.frame(capture), cfa, saturation_dn)
        for edge in found:
            key = _key([capture], cfa, "Y" if cfa == "MONO" else "G", edge.region)
            recordings.once(key, partial(attrgetter("summary"), edge), whatever_is_stated=True)
        return found

    return recordings.once(("edges", frame, cfa, saturation_dn), find, whatever_is_stated=True)
