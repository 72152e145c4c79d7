"""The slanted edges of one side: their regions, seen and held-out repeats, and the share of their noise that repeats
have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from lab.capture_kinds.slanted_edge import EdgeCapture
from lab.capture_kinds.stopped_edge import StoppedEdgeCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset, held_out_of
from lab.observables.edges.finding import Region
from lab.observables.edges.measured import edges_of, measure_edge
from lab.observables.edges.profile import EdgeSummary
from lab.observables.edges.region import check_phases

LEAST_REACH_PX = 8.0  # of the samples from the edge: with less, levels and blur aren't told apart without bias
#: Of an edge: their residuals tell the variance of the noise, to 13 % of 120 on either side.
LEAST_SAMPLES = 240
LEAST_PAIRS = 64  # pixels on the light side whose two repeats tell the temporal noise
MOST_FIXED = 0.95  # of the variance of the noise
#: Difference of two directions below which they are one edge's: the ends of an edge of 200 px are 0.17 px beside each
#: other, which in the mean of two frames takes (pi f 0.17)^2 / 6 = 3e-3 of the contrast at f = 1/4 cy/px. Or so many
#: standard deviations.
REPEATED_DEG, REPEATED_STD = 0.1, 5.0
C = TypeVar("C", bound=EdgeCapture)


@dataclass(frozen=True)
class SideEdge:
    """One edge in one channel, summarised of the mean of its seen or of its held-out repeats."""

    part: tuple[EdgeCapture, ...]  # the repeats
    channel: str
    summary: EdgeSummary
    held_out: bool
    region: Region
    fixed_share: float  # share of the noise's variance that repeats have in common (PRNU)

    @property
    def direction_deg(self) -> float:
        """Return the direction of the normal towards the light side, from x (columns) to y (rows)."""
        return _direction_deg(self.summary)

    @property
    def orientation(self) -> str:
        """The edge's nominal angle, or the measured one where none is stated, in words."""
        nominal = self.part[0].angle_deg
        return f"{self.summary.angle_deg if nominal is None else nominal:.3g} deg"

    @property
    def setting(self) -> tuple[Region, float, str]:
        """Equal for edges on the same pixels in the same direction."""
        return self.region, round(self.direction_deg), self.channel


def _direction_deg(summary: EdgeSummary) -> float:
    curve = summary.curve
    x, y = (-curve.tilt, 1.0) if curve.transposed else (1.0, -curve.tilt)
    angle = float(np.rad2deg(np.arctan2(curve.sign * y, curve.sign * x)))
    return angle + 360.0 if angle <= -90.0 else angle


def edges_of_side(dataset: Dataset, kind: type[EdgeCapture], step: str) -> list[SideEdge]:
    """Return all edges of the captures of a kind, by region and channel. Edges are searched for where no region is
    stated.

    Raises NotDetermined of `step` where f-number or pixel pitch isn't stated, without captures of the kind, and where
    no edge is measured.
    """
    if not dataset.diffraction_is_known:
        raise NotDetermined(step, "f-number or pixel pitch isn't stated: no diffraction to hold the edges against")
    groups = dataset.groups(
        kind,
        lambda c: (f_number_of(c), c.region, c.angle_deg, c.exposure_s, c.gain_db, c.light_radiance, c.field_mm),
    )
    if not groups:
        raise NotDetermined(step, f"no {step} captures")
    groups = [part for group in groups for part in _by_direction(dataset, group)]
    edges: list[SideEdge] = []
    reasons = []
    for i, group in enumerate(groups):
        out = held_out_of(group, i, len(groups))
        try:
            regions = (
                [group[0].region] if group[0].region else [f.region for f in edges_of(dataset.recordings, group[0])]
            )
        except NotDetermined as refused:
            reasons.append(refused.reason)
            continue
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            for channel in dataset.channels if part else ():
                for region in regions:
                    try:
                        summary = measure_edge(dataset.recordings, part, channel, dataset.fitted, region)
                        check_phases(step, dataset.stated.cfa, channel, region, summary.angle_deg)
                        _refuse_narrow(step, part[0], channel, summary)
                    except NotDetermined as refused:
                        reasons.append(refused.reason)
                        continue
                    share = _fixed_share(dataset, group, len(part), channel, region, summary)
                    edges.append(SideEdge(tuple(part), channel, summary, part[0].id in out, region, share))
    if not edges:
        raise NotDetermined(step, reasons[0])
    return edges


def _by_direction(dataset: Dataset, group: list[C]) -> list[list[C]]:
    """Return the captures of a group that show the edge in one direction, for each direction.

    Where `angle_deg` isn't stated, repeats are told from other edges by the frames. A capture whose edge isn't measured
    is a group of its own."""
    if len(group) == 1 or group[0].angle_deg is not None:
        return [group]
    found: list[tuple[EdgeSummary | None, list[C]]] = []
    for capture in group:
        try:
            edge = _first_edge(dataset, capture)
        except NotDetermined:
            edge = None
        same = (members for other, members in found if edge and other and _is_repeated(edge, other))
        if (members := next(same, None)) is not None:
            members.append(capture)
        else:
            found.append((edge, [capture]))
    return [members for _, members in found]


def _first_edge(dataset: Dataset, capture: EdgeCapture) -> EdgeSummary:
    """Summarise the first edge of a single frame. Raises NotDetermined where there is none."""
    if capture.region is None:
        return edges_of(dataset.recordings, capture)[0].summary
    channel = "Y" if dataset.camera.cfa == "MONO" else "G"
    return measure_edge(dataset.recordings, [capture], channel, dataset.fitted)


def _is_repeated(one: EdgeSummary, other: EdgeSummary) -> bool:
    """Return whether two edges stand in one direction, but for the errors of their angles."""
    apart = (_direction_deg(one) - _direction_deg(other) + 180.0) % 360.0 - 180.0
    return abs(apart) < max(REPEATED_DEG, REPEATED_STD * float(np.hypot(one.angle_deg_std, other.angle_deg_std)))


def _refuse_narrow(step: str, capture: EdgeCapture, channel: str, summary: EdgeSummary) -> None:
    """Raise `NotDetermined` where the samples beside an edge are too few to tell its levels from its blur."""
    if summary.reach_px < LEAST_REACH_PX:
        raise NotDetermined(
            step,
            f"{capture.id}: the samples of {channel} reach {summary.reach_px:.1f} px from the edge, "
            f"{LEAST_REACH_PX:g} px are needed: widen the region",
        )
    if summary.samples < LEAST_SAMPLES:
        raise NotDetermined(
            step,
            f"{capture.id}: the region holds {summary.samples} samples of {channel}, {LEAST_SAMPLES} are needed to "
            "tell their noise: widen the region",
        )


def f_number_of(capture: EdgeCapture) -> float | None:
    """Return the f-number of a capture; None: the data sheet's."""
    return capture.f_number if isinstance(capture, StoppedEdgeCapture) else None


def _fixed_share(
    dataset: Dataset, group: Sequence[EdgeCapture], frames: int, channel: str, region: Region, summary: EdgeSummary
) -> float:
    """Share of the noise variance of a mean of `frames` frames that is fixed (PRNU): 1 - temporal variance / total
    variance.

    The temporal variance is taken from the difference of two repeats on the light side, else from shot and read noise.
    0 where neither is known.
    """
    if len(group) > 1:
        row0, col0, row1, col1 = region
        mask = dataset.plane_mask(channel, (dataset.camera.rows, dataset.camera.cols))[row0:row1, col0:col1]
        first, second = (
            np.asarray(dataset.recordings.frame(c)[row0:row1, col0:col1], float)[mask] for c in (group[0], group[1])
        )
        light = 0.5 * (first + second) > 0.5 * sum(summary.levels) + 0.35 * summary.contrast
        apart = (first - second)[light]
        if apart.size < LEAST_PAIRS:
            return 0.0
        temporal = 0.5 * float(np.var(apart))
    elif dataset.stated.conversion_gain_dn_per_e is not None:
        temporal = dataset.noise.gain * (summary.levels[1] - dataset.noise.black) + dataset.noise.read_dn**2
    else:
        return 0.0
    total = max(summary.noise_std[1] ** 2, 1e-300)
    return float(np.clip(1.0 - temporal / frames / total, 0.0, MOST_FIXED))
