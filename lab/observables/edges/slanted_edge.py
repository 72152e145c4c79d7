"""Slanted edges: the optical transfer function across each edge, measured, and predicted by a camera model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.capture_kinds.stopped_edge import StoppedEdgeCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset
from lab.observables.edges.prediction import CHANGING, PredictedEdges
from lab.observables.edges.side import edges_of_side, f_number_of
from lab.observables.edges.transfer import REAL_AT
from lab.observables.observable import Label, Measurement, Observable, Prediction
from sim.effects.base import Effects
from sim.point import TRANSFER_AT
from sim.stop_down import at_f_number

#: Suffix of the condition of imaginary parts, and their distance from real parts in `Observable.along`.
ASIDE, APART_CY_PER_PX = ", asymmetry", 100.0


def measure_slanted_edge(dataset: Dataset) -> Observable:
    """OTF of every slanted edge by channel: the real part, which is contrast, and the imaginary part about the
    profile's middle, which only an asymmetric blur has.

    Errors of the two parts are correlated, as the light side has more noise than the dark side. Nuisance parameters:
    curvature of the illumination across the edge, and spectra that aren't stated. Raises NotDetermined where f-number
    or pixel pitch isn't stated, and where no edge is measured.
    """
    edges = edges_of_side(dataset, SlantedEdgeCapture, SLANTED_EDGE.name)
    return _observable(SLANTED_EDGE, [PredictedEdges(dataset, edges, dataset.camera)])


def measure_stopped_edge(dataset: Dataset) -> Observable:
    """Return the same of edges at other f-numbers than the data sheet's. Raises NotDetermined as `measure_slanted_edge`
    does, and for a lens that is known at one aperture alone."""
    edges = edges_of_side(dataset, StoppedEdgeCapture, STOPPED_EDGE.name)
    found = []
    for f_number in dict.fromkeys(f_number_of(edge.part[0]) for edge in edges):
        try:
            stopped = at_f_number(dataset.camera, f_number or dataset.camera.lens.f_number)
        except ValueError as refused:
            raise NotDetermined("stopped_edge", f"{refused}: nothing is predicted for f/{f_number:g}") from None
        found.append(PredictedEdges(dataset, [e for e in edges if f_number_of(e.part[0]) == f_number], stopped))
    return _observable(STOPPED_EDGE, found)


def _observable(measurement: Measurement, parts: list[PredictedEdges]) -> Observable:
    """Return the block of edges at one f-number, or at several."""
    sizes = [part.value.size for part in parts]
    jacobian = {}  # the same for all effects: one for all predictions that are kept
    for k, part in enumerate(parts):
        before, after = sum(sizes[:k]), sum(sizes[k + 1 :])
        for name, column in part.jacobian.items():
            own = name if measurement is SLANTED_EDGE else f"{measurement.name} {k}: {name}"
            jacobian[own] = np.pad(column, (before, after))

    def predict(effects: Effects) -> Prediction:
        return Prediction(np.concatenate([part.predict(effects).ravel() for part in parts]), jacobian)

    split = len(REAL_AT)
    return Observable(
        measurement=measurement, reach=0.2, value=np.concatenate([part.value.ravel() for part in parts]),
        covariance=block_diag(*(part.covariance for part in parts)),
        labels=tuple(
            Label(float(f), e.channel, e.orientation + (ASIDE if k >= split else ""), tuple(c.id for c in e.part),
                  e.held_out)
            for part in parts for e in part.edges for k, f in enumerate(part.frequencies)
        ),
        reads=TRANSFER_AT | CHANGING | {"image.transmittance"}, predict=predict, scale=np.ones(sum(sizes)),
        # model discrepancies of real and imaginary parts are independent
        along=np.concatenate([
            np.tile(p.frequencies + np.where(np.arange(len(p.frequencies)) < split, 0.0, APART_CY_PER_PX), len(p.edges))
            for p in parts
        ]),
    )  # fmt: skip


SLANTED_EDGE = Measurement(
    "slanted_edge",
    title="transfer function of slanted edges",
    order=310,
    axis="spatial_frequency",
    unit="cy/px",
    make=measure_slanted_edge,
    quantity="transfer function",
    conditions="orientation",
    conditions_words="edges at",
)
STOPPED_EDGE = replace(
    SLANTED_EDGE,
    name="stopped_edge",
    title="transfer function of slanted edges at another f-number",
    order=311,
    make=measure_stopped_edge,
)
