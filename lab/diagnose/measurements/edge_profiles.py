"""The slanted edges of a side: their regions, seen and held-out repeats, and the share of their noise that repeats have
in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.capture_kinds.slanted_edge import EdgeCapture
from lab.capture_kinds.stopped_edge import StoppedEdgeCapture
from lab.errors import NotDetermined
from lab.measure.edge_finding import Region
from lab.measure.edge_mtf import EdgeMtf
from lab.measure.edges import check_phases, find_edges, measure_edge
from lab.measure.study import Study, held_out_of

PLAIN = np.array([0.25])  # cy/px: where `measure_edge` evaluates its own MTF, which isn't used here


@dataclass(frozen=True)
class MeasuredEdge:
    """One edge in one channel, measured on the mean of its seen or of its held-out repeats."""

    part: tuple[EdgeCapture, ...]  # the repeats
    channel: str
    measured: EdgeMtf
    held_out: bool
    region: Region
    direction_deg: float  # of the normal towards the light side, from x (columns) to y (rows)
    fixed_share: float  # share of the noise's variance that repeats have in common (PRNU)

    @property
    def orientation(self) -> str:
        """The edge's nominal angle, or the measured one where none is stated, in words."""
        nominal = self.part[0].angle_deg
        return f"{self.measured.angle_deg if nominal is None else nominal:.3g} deg"

    @property
    def setting(self) -> tuple[Region, float, str]:
        """Equal for edges on the same pixels in the same direction."""
        return self.region, round(self.direction_deg), self.channel


def measured_edges(study: Study, kind: type[EdgeCapture]) -> list[MeasuredEdge]:
    """All edges of the captures of a kind, by region and channel. Edges are searched for where no region is stated.

    Raises NotDetermined where f-number or pixel pitch isn't stated, without slanted-edge captures, and where no edge is
    measured."""
    if not study.diffraction_is_known:
        raise NotDetermined(
            "slanted_edge", "f-number or pixel pitch isn't stated: no diffraction to hold the edges against"
        )
    groups = study.groups(
        kind,
        lambda c: (f_number_of(c), c.region, c.angle_deg, c.exposure_s, c.gain_db, c.light_radiance, c.field_mm),
    )
    if not groups:
        raise NotDetermined("slanted_edge", "no slanted-edge captures")
    edges: list[MeasuredEdge] = []
    reasons = []
    for i, group in enumerate(groups):
        out = held_out_of(group, i, len(groups))
        try:
            regions = [group[0].region] if group[0].region else _found(study, group[0])
        except NotDetermined as refused:
            reasons.append(refused.reason)
            continue
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            for channel in study.channels if part else ():
                for region in regions:
                    try:
                        measured = measure_edge(study.recordings, part, channel, None, PLAIN, region)
                        check_phases("slanted_edge", study.stated.cfa, channel, region, measured.angle_deg)
                    except NotDetermined as refused:
                        reasons.append(refused.reason)
                        continue
                    direction = _direction_deg(study, part[0], region, measured.angle_deg)
                    share = _fixed_share(study, group, len(part), channel, region, measured)
                    edges.append(
                        MeasuredEdge(tuple(part), channel, measured, part[0].id in out, region, direction, share)
                    )  # fmt: skip
    if not edges:
        raise NotDetermined("slanted_edge", reasons[0])
    return edges


def f_number_of(capture: EdgeCapture) -> float | None:
    """The f-number of a capture; None: the data sheet's."""
    return capture.f_number if isinstance(capture, StoppedEdgeCapture) else None


def _found(study: Study, capture: EdgeCapture) -> list[Region]:
    """Regions of the edges that are found in a capture's frame."""
    return [f.region for f in find_edges(study.recordings.frame(capture), study.stated.cfa, study.saturation_dn)]


def _direction_deg(study: Study, capture: EdgeCapture, region: Region, angle_deg: float) -> float:
    """Direction of the edge's normal towards the light side, from x (columns) to y (rows)."""
    row0, col0, row1, col1 = region
    frame = np.asarray(study.recordings.frame(capture)[row0:row1, col0:col1], float)
    angle = np.deg2rad(angle_deg)
    row, col = np.arange(row1 - row0) - 0.5 * (row1 - row0 - 1), np.arange(col1 - col0) - 0.5 * (col1 - col0 - 1)
    side = np.cos(angle) * col[None, :] + np.sin(angle) * row[:, None]
    return angle_deg if float(np.sum(side * (frame - frame.mean()))) > 0 else angle_deg + 180.0


def _fixed_share(
    study: Study, group: Sequence[EdgeCapture], frames: int, channel: str, region: Region, measured: EdgeMtf
) -> float:
    """Share of the noise variance of a mean of `frames` frames that is fixed (PRNU): 1 - temporal variance / total
    variance.

    The temporal variance is taken from the difference of two repeats on the light side, else from shot and read noise.
    0 where neither is known; at most 0.95.
    """
    total = measured.noise_std_light**2
    if len(group) > 1:
        row0, col0, row1, col1 = region
        mask = study.plane_mask(channel, (study.camera.rows, study.camera.cols))[row0:row1, col0:col1]
        first, second = (
            np.asarray(study.recordings.frame(c)[row0:row1, col0:col1], float)[mask] for c in (group[0], group[1])
        )
        black = study.stated.black_level_dn or 0.0
        middle = black + 0.5 * (measured.dark_level + measured.light_level)
        light = 0.5 * (first + second) > middle + 0.35 * (measured.light_level - measured.dark_level)
        apart = (first - second)[light]
        if apart.size < 64:
            return 0.0
        temporal = 0.5 * float(np.var(apart))
    elif study.stated.conversion_gain_dn_per_e is not None:
        temporal = study.noise.gain * measured.light_level + study.noise.read_dn**2
    else:
        return 0.0
    return float(np.clip(1.0 - temporal / frames / max(total, 1e-300), 0.0, 0.95))
