"""Slanted edges: the optical transfer function (OTF) across each edge, measured, and predicted by a camera model.

A prediction goes through the same estimator at the recorded edge's geometry (`edge_estimator.Operators`), shading and
nonlinear response included. A pair (channel, light) is called a sight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag
from scipy.special import ndtr

from lab.capture_kinds.slanted_edge import EdgeCapture, SlantedEdgeCapture
from lab.capture_kinds.stopped_edge import StoppedEdgeCapture
from lab.diagnose.measurements.block import Block, Label, Measurement, Prediction
from lab.errors import NotDetermined
from lab.measure.edge_finding import Region
from lab.measure.edge_mtf import ROUGHNESS_SHARE, EdgeGeometry, EdgeMtf
from lab.measure.edges import check_phases, find_edges, measure_edge
from lab.measure.reads import acting
from lab.measure.study import Study, held_out_of
from sim.camera import CameraModel
from sim.effects.base import Effect, Effects
from sim.optics.illumination import optical_axis_px, relative_illumination
from sim.point import (
    MOST_SHARES,
    TRANSFER_AT,
    common_wavelengths,
    detected_transfer,
    halos,
    mix_channels,
    transfer_at,
    varies_over_field,
    wavelength_shares,
    wide_contrast,
)
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum, gauss_rule, lagrange_shares, linear_shares
from sim.stop_down import at_f_number, effects_at_f_number
from sim.uniform import SHADING, SPECTRAL, STRAYS, FieldPoints, Uniform, electron_rate

# --- edge estimator --------------------------------------------------------------------------------------------------
# The slanted-edge estimator of the diagnosis, as a linear operator on the values of an edge's pixels.
#
# `lab.fit.mtf` locates the edge, measures its noise, and sets up the normal equations of the spline that describes its
# edge spread function (ESF). From these, `Estimator` estimates by weighted least squares how the optical transfer
# function (OTF) departs from the baseline's at a few frequencies. `Operators` applies the same estimator to a model:
# OTF -> ESF (`Quadrature`) -> right side of the normal equations -> reported numbers.


ComplexArray = NDArray[np.complex128]
#: Frequencies at which the OTF's real and imaginary parts are measured, as shares of the highest one. The imaginary
#: part is taken as 0 up to `STILL`, as a phase in proportion to frequency only moves the edge.
REAL_AT = np.array([0.04, 0.09, 0.15, 0.22, 0.30, 0.39, 0.49, 0.60, 0.72, 0.86, 1.0])
IMAGINARY_AT = np.array([0.28, 0.42, 0.57, 0.72, 0.86, 1.0])
STILL = 0.14
#: Prior standard deviation of a departure of the OTF: so wide that it matters only where samples tell nothing.
DEPARTURE_STD = 0.5
GRID_PX, FINE_PX = 0.05, 0.0125  # steps of the grids of distances from the edge: of profiles, and of the pixels' values


@dataclass(frozen=True)
class Quadrature:
    """The ESF as a weighted sum of the OTF H at nodes f_k.

    ESF(d) = 1/2 + integral over f > 0 of [Re H sin(2 pi f d) + Im H cos(2 pi f d)] / (pi f) df
           = 1/2 + sum over k of Re H(f_k) odd[k](d) + (Im H(f_k) / f_k) even[k](d)

    with H interpolated by piecewise polynomials. The tables are at the distances d = 0, `GRID_PX`, 2 `GRID_PX`, ...
    """

    frequency: FloatArray  # (nodes,), cy/px
    odd: FloatArray  # (nodes, distances)
    even: FloatArray  # (nodes, distances)

    @staticmethod
    def of(highest: float, reach_px: float) -> Quadrature:
        """For frequencies up to `highest` (cy/px) and distances up to `reach_px`.

        Pieces are 1/4 cy/px wide below 1 cy/px, 1/2 below 2, and 1 above, with 8, 6 and 6 Gauss-Legendre nodes. A
        double image 3 px away is integrated to 1e-4.
        """
        cuts = np.concatenate([np.arange(0.0, 1.0, 0.25), np.arange(1.0, 2.0, 0.5), np.arange(2.0, 64.0)])
        cuts = np.append(cuts[cuts < highest], highest)
        distance = np.arange(int(np.ceil(reach_px / GRID_PX)) + 2) * GRID_PX
        nodes, odd, even = [], [], []
        for low, high in pairwise(cuts):
            unit = np.polynomial.legendre.leggauss(8 if high <= 1.0 else 6)[0]
            fine, weight = np.polynomial.legendre.leggauss(int(16 + 4.0 * (high - low) * reach_px))
            f, width = 0.5 * (low + high) + 0.5 * (high - low) * fine, 0.5 * (high - low) * weight
            hats = _lagrange(unit, fine)
            phase = 2.0 * np.pi * np.outer(f, distance)
            nodes.append(0.5 * (low + high) + 0.5 * (high - low) * unit)
            odd.append((hats * (width / (np.pi * f))) @ np.sin(phase))
            even.append((hats * (width / np.pi)) @ np.cos(phase))
        return Quadrature(np.concatenate(nodes), np.concatenate(odd), np.concatenate(even))


def _lagrange(nodes: FloatArray, at: FloatArray) -> FloatArray:
    """Lagrange polynomials of the nodes (1 at one node, 0 at the others) at `at`, (nodes, at)."""
    basis = np.ones((len(nodes), len(at)))
    for k, node in enumerate(nodes):
        for other in np.delete(nodes, k):
            basis[k] *= (at - other) / (node - other)
    return basis


@dataclass(frozen=True)
class Estimator:
    """Weighted least squares of how an edge's profile departs from the baseline's, linear in the pixels' values.

    profile = level + contrast x (baseline + shift x slope + sum of departures x shapes) + gradients of the illumination

    A shape is the change of the profile by a unit change of the OTF at one frequency. The rows of the result are
    contrast, then contrast x shift, and contrast x departures.
    """

    rows: FloatArray  # (rows, distances): the operator on a profile
    value: FloatArray  # (rows,): estimate from the recording
    covariance: FloatArray  # (rows, rows): of `value`

    @staticmethod
    def of(geometry: EdgeGeometry, spread: FloatArray, shapes: FloatArray) -> Estimator:
        """Return the estimator at an edge's geometry. `spread` (k + g, distances): takes a profile to the right side of
        the normal equations of k spline and g gradient coefficients (`spread_operator`). `shapes` (j, distances):
        level, contrast, slope, departures."""
        size = geometry.spline.size
        matrix, right = geometry.gram[:-1, :-1], geometry.gram[:-1, -1]
        bridged = matrix[:size, :size] + geometry.spline.roughness(
            ROUGHNESS_SHARE * np.trace(matrix[:size, :size]) / size
        )
        count = len(shapes)
        columns = np.zeros((len(matrix), count + len(matrix) - size))
        columns[:size, :count] = np.linalg.solve(bridged, spread[:size] @ shapes.T)
        columns[size:, count:] = np.eye(len(matrix) - size)
        normal = columns.T @ matrix @ columns
        normal[np.arange(3, count), np.arange(3, count)] += DEPARTURE_STD**-2
        solve = (np.linalg.inv(normal) @ columns.T)[1:count]
        return Estimator(solve @ spread, solve @ right, solve @ matrix @ solve.T)


@dataclass(frozen=True)
class Operators:
    """The estimators of all edges as operators on OTFs, each at its own geometry; rows as in `Estimator`."""

    constant: FloatArray  # (edges, rows): by the constant part of the profile
    odd: FloatArray  # (edges, rows, nodes): on the OTF's real part
    even: FloatArray  # (edges, rows, nodes): on the OTF's imaginary part over frequency
    profile: FloatArray  # (edges, rows, distances): on any other change of the profile
    distance: FloatArray  # (distances,), px
    offset: FloatArray  # (edges,): level of the dark side over the contrast
    shade: FloatArray  # (edges, distances): relative illumination, which the operators contain

    def report(self, otf: ComplexArray, frequency: FloatArray, change: FloatArray | None = None) -> FloatArray:
        """Return the estimates (edges, rows) for a model's OTFs (edges, nodes), at the quadrature's `frequency`, and a
        further `change` of its profiles (edges, distances)."""
        rows = self.constant + (self.odd @ np.real(otf)[..., None])[..., 0]
        if np.any(np.imag(otf)):
            rows = rows + (self.even @ (np.imag(otf) / frequency)[..., None])[..., 0]
        if change is not None:
            rows = rows + (self.profile @ change[..., None])[..., 0]
        return np.asarray(rows)


@lru_cache(maxsize=4)
def profile_interpolation(reach_px: float) -> tuple[FloatArray, FloatArray, sparse.csr_array]:
    """Distances of the fine and of the coarse grid, px, and the cubic interpolation matrix (fine, coarse)."""
    count = int(np.ceil(reach_px / GRID_PX)) + 1
    coarse = GRID_PX * np.arange(-count, count + 1, dtype=float)
    ratio = round(GRID_PX / FINE_PX)
    fine = FINE_PX * np.arange(-(count - 2) * ratio, (count - 2) * ratio + 1, dtype=float)
    place = (fine - coarse[0]) / GRID_PX
    left = np.floor(place + 1e-9).astype(int)
    t = place - left
    weights = np.stack(
        [0.5 * t * (-1 + t * (2 - t)), 1 + 0.5 * t * t * (-5 + 3 * t), 0.5 * t * (1 + t * (4 - 3 * t)),
        0.5 * t * t * (t - 1)], axis=1
    )  # fmt: skip
    index = left[:, None] + np.array([-1, 0, 1, 2])
    rows = np.repeat(np.arange(len(fine)), 4)
    return fine, coarse, sparse.csr_array((weights.ravel(), (rows, index.ravel())), shape=(len(fine), len(coarse)))


def spread_operator(geometry: EdgeGeometry, reach_px: float) -> FloatArray:
    """Operator (k + g, coarse distances) that takes a profile to the right side of an edge's normal equations: k spline
    and g gradient coefficients."""
    fine, _, between = profile_interpolation(reach_px)
    distance = np.asarray(geometry.distance_px, float)
    weight = _shared_out(distance, np.asarray(geometry.weight, float), fine)
    used = np.flatnonzero(weight)
    table = np.zeros((geometry.spline.size + len(geometry.gradients), len(fine)))
    table[: geometry.spline.size, used] = (geometry.spline.design(fine[used]).T * weight[used]).toarray()
    for k, row in enumerate(geometry.gradients):
        table[geometry.spline.size + k] = _shared_out(distance, np.asarray(row * geometry.weight, float), fine)
    return np.asarray(table @ between)


def departure_shapes(quadrature: Quadrature, top: float) -> tuple[FloatArray, FloatArray]:
    """Cubic splines that are 1 at one of the measured frequencies and 0 at the others, at the quadrature's nodes:
    (nodes, real parts) and (nodes, imaginary parts). All are 0 at frequency 0 and from 1.25 `top` on; `top` is the
    highest measured frequency, cy/px."""
    f = quadrature.frequency
    tables = []
    for at, still in ((REAL_AT, np.zeros(1)), (IMAGINARY_AT, np.array([0.0, 0.5 * STILL, STILL]))):
        knots = np.concatenate([still, at, [1.25, 1.6]]) * top
        cardinal = CubicSpline(knots, np.eye(len(knots))[:, len(still) : -2], bc_type="natural")
        tables.append(np.where((f < knots[-1])[:, None], cardinal(np.minimum(f, knots[-1])), 0.0))
    return tables[0], tables[1]


def _shared_out(distance: FloatArray, amount: FloatArray, grid: FloatArray) -> FloatArray:
    """Sums (grid,) of amounts at any distances, each shared between the two nearest points of a regular grid as in
    linear interpolation."""
    place = (distance - grid[0]) / FINE_PX
    left = place.astype(int)
    right_part = amount * (place - left)
    return np.asarray(np.bincount(left, amount - right_part, len(grid)) + np.bincount(left + 1, right_part, len(grid)))


def relative_covariance(covariance: FloatArray, rows: FloatArray) -> FloatArray:
    """Covariance of the departures over the contrast, to first order, from an estimate's `rows` and their
    `covariance`."""
    departure = rows[2:] / rows[0]
    jacobian = (
        np.concatenate([-departure[:, None], np.zeros((len(departure), 1)), np.eye(len(departure))], axis=1) / rows[0]
    )
    return np.asarray(jacobian @ covariance @ jacobian.T)


# --- edge profiles ---------------------------------------------------------------------------------------------------
# The slanted edges of a side: their regions, seen and held-out repeats, and the share of their noise that repeats have
# in common.


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

    Raises NotDetermined, with the name of the kind, where f-number or pixel pitch isn't stated, without captures of
    the kind, and where no edge is measured."""
    step = (SLANTED_EDGE if kind is SlantedEdgeCapture else STOPPED_EDGE).name
    if not study.diffraction_is_known:
        raise NotDetermined(step, "f-number or pixel pitch isn't stated: no diffraction to hold the edges against")
    groups = study.groups(
        kind,
        lambda c: (f_number_of(c), c.region, c.angle_deg, c.exposure_s, c.gain_db, c.light_radiance, c.field_mm),
    )
    if not groups:
        raise NotDetermined(step, f"no {step} captures")
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
                        check_phases(step, study.stated.cfa, channel, region, measured.angle_deg)
                    except NotDetermined as refused:
                        reasons.append(refused.reason)
                        continue
                    direction = _direction_deg(study, part[0], region, measured.angle_deg)
                    share = _fixed_share(study, group, len(part), channel, region, measured)
                    edges.append(
                        MeasuredEdge(tuple(part), channel, measured, part[0].id in out, region, direction, share)
                    )  # fmt: skip
    if not edges:
        raise NotDetermined(step, reasons[0])
    return edges


def f_number_of(capture: EdgeCapture) -> float | None:
    """Return the f-number of a capture; None: the data sheet's."""
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


# --- slanted edge ------------------------------------------------------------


# standard deviation of the OTF beside noise: numerical error of the estimator and of the model's wavelength sampling
EDGE_FLOOR = 3e-4
#: Highest measured frequency, and its largest share of the lens's cutoff.
HIGHEST_MEASURED_CY_PER_PX, CUTOFF_SHARE = 1.15, 0.95
#: Suffix of the condition of imaginary parts, and their distance from real parts in `Block.along`.
ASIDE, APART_CY_PER_PX = ", asymmetry", 100.0
#: Prior standard deviation of the curvature of the target's illumination across the edge: relative change of the level
#: at `UNEVEN_PX`.
UNEVEN_STD, UNEVEN_PX = 0.003, 50.0
UNEVEN_ORDER = 4  # of the polynomial in the distance from the edge that describes shading
#: Edges whose directions differ by less (deg) share one direction.
ALIKE_DEG = 0.35
#: Prior relative standard deviations of a spectrum that isn't stated: of a tilt over 150 nm, and of triangles of
#: half-width `PART_NM`.
TILT_STD, PART_STD, PART_NM = 0.5, 0.6, 60.0
#: Number of wavelengths for the OTF with effects; for unstated spectra; and step (nm) for the diffraction-limited OTF,
#: whose cutoff has a kink.
WAVELENGTHS, FINE_WAVELENGTHS, FINE_NM = 10, 48, 2.0
HIGHEST_CY_PER_PX = 10.0  # of the quadrature
KEPT = 64  # most entries of each cache
#: Quantities of the stages that change an edge's profile otherwise than by the OTF.
CHANGING = SHADING | STRAYS | {"signal.response", "image.veils", "charge.exchange"}
KERNELS = frozenset({"charge.kernels", "charge.trails"})
K = TypeVar("K")
V = TypeVar("V")
_Key = tuple[Effect, ...]


def _kept(store: dict[K, V], key: K, make: Callable[[], V]) -> V:
    """Return the value of `key` in the cache `store`, computed by `make` if it is missing. The oldest of `KEPT` entries
    is dropped."""
    if key not in store:
        if len(store) >= KEPT:
            store.pop(next(iter(store)))
        store[key] = make()
    return store[key]


def edge_block(study: Study) -> Block:
    """OTF of every slanted edge by channel: the real part, which is contrast, and the imaginary part about the
    profile's middle, which only an asymmetric blur has.

    Errors of the two parts are correlated, as the light side has more noise than the dark side. Nuisance parameters:
    curvature of the illumination across the edge, and spectra that aren't stated. Raises NotDetermined where f-number
    or pixel pitch isn't stated, and where no edge is measured.
    """
    return _block(SLANTED_EDGE, [_Edges(study, measured_edges(study, SlantedEdgeCapture), study.camera)])


def stopped_edge_block(study: Study) -> Block:
    """Return the same of edges at other f-numbers than the data sheet's. Raises NotDetermined as `edge_block` does, and
    for a lens that is known at one aperture alone."""
    edges = measured_edges(study, StoppedEdgeCapture)
    found = []
    for f_number in dict.fromkeys(f_number_of(edge.part[0]) for edge in edges):
        try:
            stopped = at_f_number(study.camera, f_number or study.camera.lens.f_number)
        except ValueError as refused:
            raise NotDetermined("stopped_edge", f"{refused}: nothing is predicted for f/{f_number:g}") from None
        found.append(_Edges(study, [e for e in edges if f_number_of(e.part[0]) == f_number], stopped))
    return _block(STOPPED_EDGE, found)


def _block(measurement: Measurement, parts: list[_Edges]) -> Block:
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
    return Block(
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


class _Edges:
    """Edges of one side at one f-number, that of `camera`: their measured OTFs and the model's predictions. Effects are
    stated for the study's f-number."""

    def __init__(self, study: Study, edges: list[MeasuredEdge], camera: CameraModel) -> None:
        self._study, self._camera = study, camera
        self.edges = edges
        lights = list(dict.fromkeys(e.part[0].light_radiance for e in self.edges))
        #: All channels in every light, as charge may come from neighbours of other channels.
        self._sights = [(c, light) for light in lights for c in study.channels]
        self._sight = np.array([self._sights.index((e.channel, e.part[0].light_radiance)) for e in self.edges])
        self._turns, self._turn = _clusters(np.array([e.direction_deg for e in self.edges]), ALIKE_DEG)
        places = [_place_um(study, e) for e in self.edges]
        if len(set(places)) == 1:  # edges at one place can't tell a change over the field
            places = [(0.0, 0.0)] * len(places)
        self._places = list(dict.fromkeys(places))
        self._place = np.array([self._places.index(p) for p in places])
        spectra = [self._light(light) for _, light in self._sights]
        self._lit = list(zip((c for c, _ in self._sights), spectra, strict=True))
        shortest = float(common_wavelengths(self._camera, self._lit)[0][0])
        lens = self._camera.lens
        cutoff = self._camera.pixel_pitch_um * lens.imaging.cutoff_cy_per_um(shortest, lens.f_number)
        reach = max(e.measured.geometry.reach_px for e in self.edges) + 3 * GRID_PX
        self._quadrature = Quadrature.of(min(cutoff, HIGHEST_CY_PER_PX), reach)
        top = min(HIGHEST_MEASURED_CY_PER_PX, CUTOFF_SHARE * self._mean_cutoff())
        #: Frequencies (cy/px) of the real parts, then of the imaginary parts.
        self.frequencies = np.concatenate([REAL_AT, IMAGINARY_AT]) * top
        self._at = departure_shapes(self._quadrature, top)
        self._spectral: dict[tuple[_Key, bool], tuple[FloatArray, FloatArray, ComplexArray]] = {}
        self._blurred: dict[tuple[_Key, _Key, tuple[float, float]], ComplexArray] = {}
        self._changes: dict[_Key, FloatArray | None] = {}
        self._numbers_of: dict[_Key, FloatArray] = {}
        self._baseline = self._otf(())
        estimators, self._operators = self._estimated(reach)
        self._recorded = np.array([e.value for e in estimators])
        split = len(REAL_AT)
        f = self._quadrature.frequency
        self._level = np.array(
            [[*np.interp(self.frequencies[:split], f, np.real(row)), *np.interp(self.frequencies[split:], f,
            np.imag(row))]
             for row in self._baseline]
        )  # fmt: skip
        self.value = self._numbers(self._recorded)
        self._noise = [
            relative_covariance(e.covariance, row) for e, row in zip(estimators, self._recorded, strict=True)
        ]

    def _light(self, path: str | None) -> Spectrum | None:
        return self._study.spectrum(path) if path else None

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance (n, n) of all edges' numbers: noise, rounding and floor. Edges on the same pixels in the same
        direction share the fixed part of their noise (PRNU)."""
        factors = [np.linalg.cholesky(c + 1e-16 * np.eye(len(c))) for c in self._noise]
        size = self.value.shape[1]
        out = np.zeros((self.value.size,) * 2)
        for i, a in enumerate(self.edges):
            for j, b in enumerate(self.edges[: i + 1]):
                if a.setting == b.setting:
                    share = 1.0 if i == j else np.sqrt(a.fixed_share * b.fixed_share)
                    out[i * size : (i + 1) * size, j * size : (j + 1) * size] = share * factors[i] @ factors[j].T
                    out[j * size : (j + 1) * size, i * size : (i + 1) * size] = share * factors[j] @ factors[i].T
        for i, rounded in enumerate(self._rounded.transpose(1, 2, 0)):
            out[i * size : (i + 1) * size, i * size : (i + 1) * size] += rounded @ rounded.T
        return np.asarray(out + EDGE_FLOOR**2 * np.eye(len(out)))

    @property
    def _rounded(self) -> FloatArray:
        """Changes (waves, edges, frequencies) of the numbers by rounding, one standard deviation each.

        Where noise is less than about half a code, rounding adds a saw-tooth of the level to the profile. Its harmonics
        enter with free phases, as no level is known to a fraction of a code.
        """
        contrast = np.array([e.measured.light_level - e.measured.dark_level for e in self.edges])[:, None]
        level_dn = np.maximum(self._light_profile * contrast, 0.0)
        waves = self._study.noise.rounding_waves_dn(level_dn)
        base = self.predict(())
        return np.array([self._numbers(self._reported((), wave / contrast)) - base for wave in waves]).reshape(
            -1, *base.shape
        )

    # --- the model ---

    def predict(self, effects: Effects) -> FloatArray:
        """Predicted OTFs of all edges at `frequencies`, (edges, frequencies)."""
        key = effects_at_f_number(effects, self._study.camera.lens.f_number, self._camera.lens.f_number)
        return _kept(self._numbers_of, key, lambda: self._numbers(self._reported(key)))

    def _numbers(self, rows: FloatArray) -> FloatArray:
        """OTFs at `frequencies`, (edges, frequencies), from the estimators' `rows` (edges, rows)."""
        return np.asarray(rows[:, 2:] / rows[:, :1] + self._level)

    def _reported(
        self, effects: tuple[Effect, ...], more: FloatArray | None = None, otf: ComplexArray | None = None
    ) -> FloatArray:
        """Return the estimators' rows (edges, rows) for the model, whose profiles are shifted to the recorded ones'
        position. `more` (edges, distances): a further change of the profiles; `otf` (edges, nodes): in place of the
        effects'."""
        otf, change = self._otf(effects) if otf is None else otf, self._change(effects)
        if more is not None:
            change = more if change is None else change + more
        f = self._quadrature.frequency
        moved = np.zeros(len(otf))
        wanted = self._recorded[:, 1] / self._recorded[:, 0]
        rows = self._operators.report(otf, f, change)
        for _ in range(2 if not np.any(np.imag(otf)) and change is None else 4):
            short = wanted - rows[:, 1] / rows[:, 0]
            if np.all(np.abs(short) < 1e-5):
                break
            moved += np.clip(short, -0.5, 0.5)
            rows = self._operators.report(otf * np.exp(2j * np.pi * moved[:, None] * f), f, change)
        return rows

    def _estimated(self, reach_px: float) -> tuple[list[Estimator], Operators]:
        """Return the estimator of every edge, linear about the baseline, and all of them as operators on OTFs."""
        distance = profile_interpolation(reach_px)[1]
        quadrature = self._quadrature
        half, count = len(distance) // 2, quadrature.odd.shape[1]
        odd, even = np.zeros((2, len(quadrature.frequency), len(distance)))
        odd[:, half : half + count], even[:, half : half + count] = quadrature.odd, quadrature.even
        odd[:, half - count + 1 : half + 1] = -quadrature.odd[:, ::-1]
        even[:, half - count + 1 : half + 1] = quadrature.even[:, ::-1]
        real, imaginary = self._at[0].T @ odd, (self._at[1] / quadrature.frequency[:, None]).T @ even
        estimators, found = [], []
        for k, (edge, otf) in enumerate(zip(self.edges, self._baseline, strict=True)):
            contrast = max(edge.measured.light_level - edge.measured.dark_level, 1e-9)
            offset = max(edge.measured.dark_level, 0.0) / contrast
            shade = self._shade(k, distance, ())
            rising = np.real(otf) @ odd + (np.imag(otf) / quadrature.frequency) @ even
            profile = (0.5 + offset + rising) * shade - offset
            slope = np.gradient(profile, distance)
            shapes = np.concatenate(
                [np.ones((1, len(distance))), profile[None], slope[None], real * shade, imaginary * shade]
            )
            estimator = Estimator.of(edge.measured.geometry, spread_operator(edge.measured.geometry, reach_px), shapes)
            estimators.append(estimator)
            shaded = estimator.rows * shade
            constant = shaded.sum(axis=1) * (0.5 + offset) - estimator.rows.sum(axis=1) * offset
            found.append((constant, shaded @ odd.T, shaded @ even.T, estimator.rows, offset, shade))
        constant, by_odd, by_even, rows, offsets, shades = (np.array(part) for part in zip(*found, strict=True))
        return estimators, Operators(constant, by_odd, by_even, rows, distance, offsets, shades)

    def _mean_cutoff(self) -> float:
        """Return the lens's cutoff at the mean detected wavelength of all sights, cy/px."""
        nodes, shares = common_wavelengths(self._camera, self._lit)
        lens = self._camera.lens
        mean = float((shares @ nodes).mean())
        return self._camera.pixel_pitch_um * lens.imaging.cutoff_cy_per_um(mean, lens.f_number)

    def _otf(self, effects: tuple[Effect, ...]) -> ComplexArray:
        """OTFs along the edges' normals, (edges, nodes)."""
        local = self._places if varies_over_field(self._camera, effects) else [(0.0, 0.0)] * len(self._places)
        found = {place: self._sights_otf(effects, place) for place in dict.fromkeys(local)}
        table = np.array([found[place] for place in local])
        # halos are part of the profile (`_change`), as their OTF falls off below the first node of the quadrature
        veiled = wide_contrast(self._camera, effects, self._quadrature.frequency)
        return np.asarray(table[self._place, self._sight, self._turn] / veiled)

    def _sights_otf(self, effects: tuple[Effect, ...], place_um: tuple[float, float]) -> ComplexArray:
        """OTFs of all sights and directions at a place, (sights, directions, nodes)."""
        spectral = acting(effects, SPECTRAL)
        nodes, shares, kink = self._wavelengths(spectral, bool(acting(effects, frozenset({"image.shift"}))))
        fx, fy = self._frequencies
        moving = acting(effects, KERNELS) if self._camera.cfa != "MONO" else ()
        optical = acting(tuple(e for e in effects if e not in moving), TRANSFER_AT)

        def blurred() -> ComplexArray:
            whole = np.array([transfer_at(self._camera, float(w), fx, fy, optical, place_um=place_um) for w in nodes])
            return detected_transfer(self._camera, nodes, shares, whole, fx, fy, optical, [place_um]) + kink

        otf = _kept(self._blurred, (spectral, optical, place_um), blurred)
        return self._mixed(otf, moving, place_um) if moving else otf

    @cached_property
    def _frequencies(self) -> tuple[FloatArray, FloatArray]:
        """fx and fy of the quadrature's nodes along each direction, (directions, nodes), cy/px."""
        turn = np.deg2rad(self._turns)
        return np.outer(np.cos(turn), self._quadrature.frequency), np.outer(np.sin(turn), self._quadrature.frequency)

    def _wavelengths(
        self, spectral: tuple[Effect, ...], dispersed: bool
    ) -> tuple[FloatArray, FloatArray, ComplexArray]:
        """Return a few wavelengths (w,), nm, their weights (sights, w), and the error of the diffraction-limited OTF
        with these few (sights, directions, nodes).

        Where the image is displaced by wavelength (`dispersed`), or weights would be large, the wavelengths are chosen
        for this spectrum."""

        def worked_out() -> tuple[FloatArray, FloatArray, ComplexArray]:
            grid, perfect = self._perfect
            fine = wavelength_shares(self._camera, self._lit, grid, spectral)
            few = self._few
            share = lagrange_shares(grid, fine, few)
            if dispersed or np.abs(share).sum(axis=1).max() > MOST_SHARES:
                few, _ = gauss_rule(grid, fine.mean(axis=0), WAVELENGTHS)
                share = lagrange_shares(grid, fine, few)
            missed = fine - np.array([linear_shares(few, own, grid) for own in share])
            return few, share, np.tensordot(missed, perfect, 1)

        return _kept(self._spectral, (spectral, dispersed), worked_out)

    @cached_property
    def _few(self) -> FloatArray:
        """Wavelengths (w,), nm, chosen for the baseline's spectra. OTFs at them are cached, and serve most changes of
        the spectrum."""
        grid, _ = self._perfect
        return gauss_rule(grid, wavelength_shares(self._camera, self._lit, grid).mean(axis=0), WAVELENGTHS)[0]

    @cached_property
    def _perfect(self) -> tuple[FloatArray, ComplexArray]:
        """Wavelengths (w,), nm, `FINE_NM` apart, and the baseline's OTF at each, (w, directions, nodes)."""
        curves = self._camera.quantum_efficiency.values()
        low, high = min(c.wavelength_nm[0] for c in curves), max(c.wavelength_nm[-1] for c in curves)
        grid = np.linspace(low, high, 2 + int((high - low) / FINE_NM))
        return grid, np.array([transfer_at(self._camera, float(w), *self._frequencies) for w in grid])

    def _mixed(self, otf: ComplexArray, moving: tuple[Effect, ...], place_um: tuple[float, float]) -> ComplexArray:
        """OTFs (sights, directions, nodes) with charge that moves between pixels of different colours."""
        count = len(self._camera.channels)
        parts = [slice(first, first + count) for first in range(0, len(otf), count)]
        rates = np.array([max(self._rate(k), 0.0) for k in range(len(otf))])
        return np.concatenate(
            [mix_channels(self._camera, otf[p], rates[p], *self._frequencies, moving, place_um) for p in parts]
        )

    def _rate(self, sight: int) -> float:
        """Electrons a second of a sight; 1 where its light isn't stated."""
        channel, light = self._lit[sight]
        if light is None:
            return 1.0
        return electron_rate(self._camera, channel, light)

    # --- what changes a profile beside its transfer ---

    def _change(self, effects: tuple[Effect, ...]) -> FloatArray | None:
        """Change of the profiles (edges, distances) by shading, a nonlinear response, exchanged charge and halos; None
        where there is none."""
        changing = acting(effects, CHANGING)
        return _kept(self._changes, changing, lambda: self._changed(changing))

    def _changed(self, effects: tuple[Effect, ...]) -> FloatArray | None:
        model = Uniform(self._camera, effects)
        shading = acting(effects, SHADING | STRAYS)
        spread = halos(self._camera, effects)
        if not shading and model.is_linear and not spread and not model.exchanges_charge:
            return None
        light, operators = self._light_profile, self._operators
        change = np.zeros_like(light)
        if not model.is_linear:
            for i, edge in enumerate(self.edges):
                scale = max(edge.measured.light_level - edge.measured.dark_level, 1e-9) / self._study.noise.gain
                level = np.linspace(0.0, 1.1, 45) * float(light[i].max())
                bent = model.response(level * scale)
                change[i] += np.interp(light[i], level, bent / scale) - light[i]
        if model.exchanges_charge:
            change += self._exchanged(model)
        if model.strays:
            change += self._strayed(model)
        if shading:
            for i in range(len(self.edges)):
                ratio = self._shade(i, operators.distance, shading) / operators.shade[i]
                change[i] += (light[i] + change[i]) * (ratio - 1.0)
        for share, std_px in spread:
            change += share / wide_contrast(self._camera, effects) * (ndtr(operators.distance / std_px) - 0.5)
        return change

    def _exchanged(self, model: Uniform) -> FloatArray:
        """Change of the profiles (edges, distances) by charge that unequal neighbours exchange, averaged over the
        places of each edge's channel in the mosaic."""
        change = [
            model.exchanged_e(squares).reshape(-1, len(self._operators.distance)).mean(axis=0) / scale
            for squares, scale in self._squares
        ]
        return np.array(change)

    def _strayed(self, model: Uniform) -> FloatArray:
        """Change of the profiles (edges, distances) by light that falls on the next pixels, at the level that it leaves
        in even light."""
        cfa, count = self._camera.cfa, len(self._operators.distance)
        step, places = mosaic.step(cfa), mosaic.phases(cfa)
        channel = {place: c for c, mine in places.items() for place in mine}
        found = []
        for edge, lighting, (squares, scale) in zip(self.edges, self._lighting, self._squares, strict=True):
            # their mean along the edge
            shares = {c: [float(s.mean()) for s in model.stray_shares(c, *lighting[:2])] for c in self._camera.channels}
            mine = places[edge.channel]
            change = np.zeros(count)
            for (row, col), square in zip(mine, squares.reshape(len(mine), count, 3, 3), strict=True):
                kernel = np.zeros((3, 3))
                kernel[1, 1] = 1.0 - sum(shares[edge.channel])
                for i, j in ((1, 0), (1, 2), (0, 1), (2, 1)):
                    kernel[i, j] = 0.5 * shares[channel[(row + i - 1) % step, (col + j - 1) % step]][int(j == 1)]
                mixed = square.reshape(count, 9) @ kernel.ravel()
                # far on the bright side all neighbours are lit
                change += (mixed * square[-1, 1, 1] / mixed[-1] - square[:, 1, 1]) / len(mine)
            found.append(change / scale)
        return np.array(found)

    @cached_property
    def _squares(self) -> list[tuple[FloatArray, float]]:
        """Of every edge: the electrons of the 3 x 3 pixels about each distance, (places in the mosaic x distances, 3,
        3), and those of the edge's contrast. Neighbours of other colours have the same profile, at the level of their
        rate in this light."""
        cfa, distance, found = self._camera.cfa, self._operators.distance, []
        step, places = mosaic.step(cfa), mosaic.phases(cfa)
        channel = {place: c for c, mine in places.items() for place in mine}
        for edge, profile in zip(self.edges, self._light_profile, strict=True):
            scale = max(edge.measured.light_level - edge.measured.dark_level, 1e-9) / self._study.noise.gain
            turn, light = np.deg2rad(edge.direction_deg), edge.part[0].light_radiance
            rates = {c: self._rate(self._sights.index((c, light))) for c in self._camera.channels}
            own = max(rates[edge.channel], 1e-9)
            mine = places[edge.channel]
            squares = np.empty((len(mine), len(distance), 3, 3))
            for i, j in np.ndindex(3, 3):
                away = distance + np.sin(turn) * (i - 1) + np.cos(turn) * (j - 1)
                there = scale * np.interp(away, distance, profile)
                for k, (row, col) in enumerate(mine):
                    squares[k, :, i, j] = there * rates[channel[(row + i - 1) % step, (col + j - 1) % step]] / own
            found.append((squares.reshape(-1, 3, 3), scale))
        return found

    @cached_property
    def _light_profile(self) -> FloatArray:
        """The baseline's profiles (edges, distances) above the dark level, over the contrast."""
        half = len(self._operators.distance) // 2
        count = self._quadrature.odd.shape[1]
        rising = np.real(self._baseline) @ self._quadrature.odd
        profile = np.zeros((len(self.edges), 2 * half + 1))
        profile[:, half : half + count] = rising
        profile[:, half - count + 1 : half + 1] = -rising[:, ::-1]
        return np.asarray((0.5 + profile + self._operators.offset[:, None]) * self._operators.shade)

    def _shade(self, edge: int, distance: FloatArray, effects: Effects) -> FloatArray:
        """Illumination (distances,) over that at the edge, averaged along the edge, with effects."""
        x_um, y_um, light, fit = self._lighting[edge]
        model = Uniform(self._camera, effects)
        light = model.shade_light(light, x_um, y_um)
        if model.strays:
            radiance, place = self.edges[edge].part[0].light_radiance, FieldPoints(x_um, y_um, light)
            rates = {c: light * self._rate(self._sights.index((c, radiance))) for c in self._camera.channels}
            light = model.stray_light(rates, place)[self.edges[edge].channel]
        terms = fit @ light
        reach = self.edges[edge].measured.geometry.reach_px
        return np.asarray(polynomial.polyval(np.clip(distance, -reach, reach) / UNEVEN_PX, terms / terms[0]))

    @cached_property
    def _lighting(self) -> list[tuple[FloatArray, ...]]:
        """Of every edge: x and y of points around it (points,), um from the optical axis; the baseline's illumination
        there; and the matrix (terms, points) that fits a polynomial in the distance from the edge to the illumination
        by least squares."""
        camera = self._camera
        axis, pitch = optical_axis_px(camera), camera.pixel_pitch_um
        found: list[tuple[FloatArray, ...]] = []
        for edge in self.edges:
            row0, col0, row1, col1 = edge.region
            every = max(1, (row1 - row0) // 40), max(1, (col1 - col0) // 40)
            row, col = (a.astype(float) for a in np.mgrid[row0 : row1 : every[0], col0 : col1 : every[1]])
            turn = np.deg2rad(edge.direction_deg)
            middle = 0.5 * (row0 + row1 - 1), 0.5 * (col0 + col1 - 1)
            away = np.cos(turn) * (col - middle[1]) + np.sin(turn) * (row - middle[0])
            near = np.abs(away) < edge.measured.geometry.reach_px
            row, col = row[near], col[near]
            light = np.asarray(relative_illumination(camera, row, col), float)
            fit = np.linalg.pinv(polynomial.polyvander(away[near] / UNEVEN_PX, UNEVEN_ORDER))
            found.append(((col - axis[1]) * pitch, (row - axis[0]) * pitch, light, fit))
        return found

    @cached_property
    def jacobian(self) -> dict[str, FloatArray]:
        """Name of a nuisance parameter -> derivative (n,) per prior standard deviation: curvature of the illumination,
        for each region, direction and light; and spectra that aren't stated."""
        base = self.predict(())
        bend = self._light_profile * np.square(self._operators.distance / UNEVEN_PX) * UNEVEN_STD
        moved = self._numbers(self._reported((), bend))
        settings = [(e.region, round(e.direction_deg), e.part[0].light_radiance) for e in self.edges]
        found = {}
        for k, setting in enumerate(dict.fromkeys(settings)):
            mine = np.array([s == setting for s in settings])[:, None]
            found[f"edge light:{k}"] = np.where(mine, moved - base, 0.0).ravel()
        for k, change in enumerate(self._other_colours()):
            moved = self._numbers(self._reported((), otf=self._baseline + change[self._sight, self._turn]))
            found[f"edge colour:{k}"] = (moved - base).ravel()
        return found

    def _other_colours(self) -> FloatArray:
        """Changes (ways, sights, directions, nodes) of the OTFs of sights whose light isn't stated, one prior standard
        deviation each.

        An equal-energy spectrum stands for such light. It may be tilted, and differ by triangles along the wavelength.
        """
        blind = np.array([light is None for _, light in self._lit])
        shape = len(blind), *self._frequencies[0].shape
        if not blind.any():
            return np.zeros((0, *shape))
        wavelength_nm = np.arange(300.0, 1101.0, 5.0)
        middle = np.arange(wavelength_nm[0], wavelength_nm[-1] + 1.0, PART_NM)[:, None]
        parts = 1.0 + PART_STD * np.maximum(1.0 - np.abs(wavelength_nm - middle) / PART_NM, 0.0)
        tilted = 1.0 + TILT_STD * np.clip((wavelength_nm - 550.0) / 150.0, -1.5, 1.5)
        ways = [Spectrum.of(wavelength_nm, value) for value in (tilted, *parts)]
        sights = [(channel, way if light is None else light) for way in [None, *ways] for channel, light in self._lit]
        nodes, shares = common_wavelengths(self._camera, sights, count=FINE_WAVELENGTHS)
        apart = shares.reshape(len(ways) + 1, len(self._lit), -1)
        whole = np.array([np.real(transfer_at(self._camera, float(w), *self._frequencies)) for w in nodes])
        return np.tensordot(apart[1:] - apart[:1], whole, 1)


def _clusters(angle_deg: FloatArray, width: float) -> tuple[FloatArray, NDArray[np.intp]]:
    """Clusters of angles with gaps of more than `width` (deg) between them: mean angles (clusters,), and the cluster
    (angles,) of each."""
    order = np.argsort(angle_deg)
    start = np.concatenate([[True], np.diff(angle_deg[order]) > width])
    label = np.cumsum(start) - 1
    which = np.empty(len(order), np.intp)
    which[order] = label
    count = np.bincount(which)
    return np.bincount(which, angle_deg) / count, which


def _place_um(study: Study, edge: MeasuredEdge) -> tuple[float, float]:
    """(x, y) of the edge's middle from the sensor's centre, um."""
    field_mm = edge.part[0].field_mm
    if field_mm is not None and edge.part[0].region is not None:
        return 1000.0 * field_mm[1], 1000.0 * field_mm[0]
    pitch = study.camera.pixel_pitch_um
    row0, col0, row1, col1 = edge.region
    return 0.5 * pitch * (col0 + col1 - study.camera.cols), 0.5 * pitch * (row0 + row1 - study.camera.rows)


SLANTED_EDGE = Measurement(
    "slanted_edge",
    title="transfer function of slanted edges",
    order=310,
    axis="spatial_frequency",
    unit="cy/px",
    make=edge_block,
    quantity="transfer function",
    conditions="orientation",
    conditions_words="edges at",
)
STOPPED_EDGE = replace(
    SLANTED_EDGE,
    name="stopped_edge",
    title="transfer function of slanted edges at another f-number",
    order=311,
    make=stopped_edge_block,
)
