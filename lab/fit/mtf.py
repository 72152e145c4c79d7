"""Modulation transfer function from a slanted edge on the raw mosaic (the purpose of the e-SFR of ISO 12233).

Each Bayer plane is analysed on its own grid; nothing is demosaiced.

- `lab.observables.edges.finding`: where the edge lies, a cubic polynomial in the frame, found by iterated least
  squares;
- `lab.observables.edges.spread`: the edge-spread function (ESF) is a cubic spline of the distance from the edge. Its
  knots are even near the edge and ever wider apart in the tails. A spline is used because a basis of hat functions
  leaves a ripple of h^2 E'' / 12, which samples at uneven distances turn into a bias of 0.1 % of MTF50. A prior of the
  line-spread function (LSF), the derivative of the ESF, decides what the samples leave open: a Gaussian, a Gaussian
  process about it, and the 1 / distance^2 tail of diffraction, which holds 1 % of the contrast beyond any region;
- `lab.observables.edges.profile`: the ESF is fitted by weighted least squares together with gradients of the
  illumination. This is the summary of an edge, which the diagnosis reads, too;
- `lab.observables.edges.mtf`: the MTF is the Fourier transform of the derivative of the spline, in closed form, with
  its covariance. `edge_mtf` is the whole estimator, on a region;
- `lab.observables.edges.region`: the edges of a frame that are usable; `lab.observables.edges.measured`: the edges of
  captures, each summarised once;
- here, the step on all captures of a side.

Once the edge is found, the estimate is linear in the pixel values. `EdgeSummary` keeps this linear operator, and
`EdgeMtf.predict` sends a predicted edge profile through it. A comparison of the two is free of the bias of the
estimator.

Frequencies are in cycles per pixel of the full sensor, along the normal of the edge. This holds also for a plane that
is sampled at every second pixel: the slant samples the profile more finely than the pitch of the plane.
"""

from __future__ import annotations

import itertools

from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.formats.results import MtfCurve, NoiseFit
from lab.observables.edges.measured import edges_of, measure_edge
from lab.observables.edges.mtf import edge_mtf, read_mtf
from lab.observables.edges.region import check_phases
from sim.camera import Side

__all__ = ["edge_mtf", "fit_mtf"]


def fit_mtf(
    recordings: RecordingSet, side: Side, noise: NoiseFit | None = None, left_out: list[str] | None = None
) -> tuple[MtfCurve, ...]:
    """Fit one MTF curve for every slanted-edge capture of `side` and every channel (R, G, B; or Y), captures in their
    order.

    A capture without a region gives the curves of all edges found in its frame, each with its region. `noise`: see
    `measure_edge`. The angle is given in the half turn next to the nominal
    one of the capture. Edges that can't be used are left out, among them those that cross less than one sample period
    of their channel; `left_out` gets a line for each. Raises `NotDetermined` where none can be used.
    """
    captures = recordings.captures(SlantedEdgeCapture, side)
    if not captures:
        raise NotDetermined("mtf", "no slanted_edge captures")
    camera = recordings.camera(side)
    curves: list[MtfCurve] = []
    reasons: list[str] = [] if left_out is None else left_out
    for capture in captures:
        try:
            edges = () if capture.region else edges_of(recordings, capture)
        except NotDetermined as refused:
            reasons.append(f"{capture.id}: {refused.reason}")
            continue
        reasons += [f"{capture.id}: {f.refused}" for f in edges if f.refused]
        regions = [capture.region] if capture.region else [f.region for f in edges if not f.refused]
        for region, channel in itertools.product(regions, ("Y",) if camera.cfa == "MONO" else ("R", "G", "B")):
            try:
                edge = read_mtf(measure_edge(recordings, [capture], channel, noise, region))
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
