"""Slanted edges: the transfer function that the estimator reports, and the same of a model at the same geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.diagnose.summaries import Block, Effects, Label, Prediction, Study, held_out_of
from lab.errors import NotDetermined
from lab.fit.mtf import EdgeMtf, measure_edge
from lab.recording import SlantedEdge
from sim.forward import optical_transfer
from sim.spectrum import FloatArray

EDGE_FLOOR = 0.0012  # of the contrast: numerical floor of the edge estimator and the model's wavelength sampling
MTF_FREQUENCIES = np.arange(1, 25) * 0.04


def edge_block(study: Study) -> Block:
    """MTF of every slanted edge by channel; the prediction goes through the estimator at the recording's own geometry."""
    if study.stated.f_number is None or study.stated.pixel_pitch_um is None:
        raise NotDetermined(
            "slanted_edge", "f-number or pixel pitch isn't stated: no diffraction to hold the edges against"
        )
    groups = study.groups(SlantedEdge, lambda c: (c.region, c.angle_deg, c.exposure_s, c.light_radiance))
    if not groups:
        raise NotDetermined("slanted_edge", "no slanted-edge captures")
    edges: list[_Edge] = []
    reasons = []
    for i, group in enumerate(groups):
        out = held_out_of(group, i, len(groups))
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            for channel in study.channels if part else ():
                try:
                    measured = measure_edge(study.recordings, part, channel, None, MTF_FREQUENCIES)
                except NotDetermined as refused:
                    reasons.append(refused.reason)
                    continue
                edges.append(_Edge(part, channel, measured, part[0].id in out))
    if not edges:
        raise NotDetermined("slanted_edge", reasons[0])
    camera = study.camera
    cutoff = camera.pixel_pitch_um / (0.4 * camera.lens.f_number)
    basis = _edge_basis(min(cutoff, 4.0))
    operators = [_operator(e.measured, basis) for e in edges]
    transfers = [_real_transfer(e.measured) for e in edges]
    value = np.concatenate([v for v, _ in transfers])
    n = len(MTF_FREQUENCIES)
    covariance = np.zeros((len(value), len(value)))
    for i, (_, spread) in enumerate(transfers):
        at = slice(i * n, (i + 1) * n)
        covariance[at, at] = spread
    covariance += np.diag(np.full(len(value), EDGE_FLOOR**2))
    sets: dict[tuple[str, str | None], list[int]] = {}
    for i, e in enumerate(edges):
        sets.setdefault((e.channel, e.part[0].light_radiance), []).append(i)
    f = np.maximum(basis.frequency, 1e-3)
    angles = np.deg2rad(np.round([e.measured.angle_deg for e in edges], 1))

    def predict(effects: Effects) -> Prediction:
        parts: list[FloatArray] = [np.zeros(0)] * len(edges)
        for (channel, light), members in sets.items():
            turned, which = np.unique(angles[members], return_inverse=True)
            radiance = study.spectrum(light) if light else None
            otf = optical_transfer(
                camera, channel, radiance, np.outer(np.cos(turned), f), np.outer(np.sin(turned), f), effects
            )
            slices = np.real(otf / otf[:, :1])
            for k, i in enumerate(members):
                parts[i] = operators[i].estimate(slices[which[k]])
        return Prediction(np.concatenate(parts), {})

    return Block(
        measurement="slanted_edge", axis="spatial_frequency", unit="cy/px", reach=0.2, value=value, covariance=covariance,
        labels=tuple(Label(float(f), e.channel, f"{e.part[0].angle_deg if e.part[0].angle_deg is not None else e.measured.angle_deg:.3g} deg",
                           tuple(c.id for c in e.part), e.held_out) for e in edges for f in MTF_FREQUENCIES),
        hooks=frozenset({"transfer", "transmittance"}), predict=predict, scale=np.ones(len(value)),
        conditions="orientation", conditions_words="edges at",
    )  # fmt: skip


@dataclass(frozen=True)
class _Edge:
    part: list[SlantedEdge]
    channel: str
    measured: EdgeMtf
    held_out: bool


def _real_transfer(measured: EdgeMtf) -> tuple[FloatArray, FloatArray]:
    """Real part of the transfer function about the profile's own middle, and its covariance.

    Unlike its modulus it is normally distributed where it is next to nothing, and it shows a reversed contrast as such. The
    middle is where the phase's slope, weighted by the squared modulus, is nil.
    """
    f = measured.frequency_cy_per_px
    low = f < 0.35
    shift = float(
        np.sum((np.abs(measured.otf) ** 2 * f * np.unwrap(np.angle(measured.otf)))[low])
        / np.sum((np.abs(measured.otf) ** 2 * f**2)[low])
    )
    turn = np.exp(-1j * shift * f)
    # the estimator's values are levelled: from the first coefficient to the last the profile rises by 1
    operator = turn[:, None] * measured.geometry.spline.transfer_operator(f)
    operator[:, -1] -= turn * measured.otf
    operator[:, 0] += turn * measured.otf
    slopes = np.real(operator)
    size = operator.shape[1]
    return np.real(turn * measured.otf), slopes @ measured.geometry.scatter[:size, :size] @ slopes.T


@dataclass(frozen=True)
class _Basis:
    """ESF = 1/2 + sum over nodes of OTF(f_k) table[k](distance), OTF linear between the nodes."""

    frequency: FloatArray
    distance: FloatArray
    table: FloatArray


@dataclass(frozen=True)
class _Operator:
    """The estimator at one edge's geometry, from the OTF at the basis' nodes to the real part of what it reports."""

    constant: FloatArray  # (f,) of the profile 1/2
    table: FloatArray  # (nodes, f)
    step_constant: float
    step: FloatArray  # (nodes,)

    def estimate(self, otf: FloatArray) -> FloatArray:
        return np.asarray((self.constant + otf @ self.table) / (self.step_constant + otf @ self.step))


def _edge_basis(highest: float, reach_px: float = 64.0) -> _Basis:
    nodes = np.unique(
        np.round(
            np.concatenate([np.arange(0, 0.1, 0.01), np.arange(0.1, 1.0, 0.02), np.arange(1.0, highest + 0.05, 0.05)]),
            6,
        )
    )
    nodes = nodes[nodes <= highest + 0.05]
    step = 0.001
    fine = (np.arange(int(nodes[-1] / step)) + 0.5) * step
    distance = np.arange(0, reach_px, 0.05)
    kernel = np.sin(2 * np.pi * fine[:, None] * distance[None, :]) * (step / np.pi / fine)[:, None]
    left = np.clip(np.searchsorted(nodes, fine) - 1, 0, len(nodes) - 2)
    share = (fine - nodes[left]) / (nodes[left + 1] - nodes[left])
    table = np.zeros((len(nodes), len(distance)))
    np.add.at(table, left, (1 - share)[:, None] * kernel)
    np.add.at(table, left + 1, share[:, None] * kernel)
    return _Basis(nodes, distance, table)


def _operator(measured: EdgeMtf, basis: _Basis) -> _Operator:
    geometry = measured.geometry
    away, sign = np.abs(geometry.distance_px), np.sign(geometry.distance_px)
    table = np.array([geometry.coefficients(sign * np.interp(away, basis.distance, row)) for row in basis.table])
    constant = geometry.coefficients(np.full(len(away), 0.5))
    transform = np.real(geometry.spline.transfer_operator(measured.frequency_cy_per_px))
    return _Operator(
        transform @ constant, table @ transform.T, float(constant[-1] - constant[0]), table[:, -1] - table[:, 0]
    )
