"""ISO 12233:2023: the edge-based spatial frequency response (e-SFR) as the standard specifies it, beside the unbiased
estimate of the same edge.

Steps of the standard: the position of the edge in every line by the centroid of its windowed derivative; a polynomial
through the positions; all lines projected along it into bins of a quarter pixel; the derivative [-1/2, 0, 1/2]; the
maximum centred by circular rotation; a window; the discrete Fourier transform, its modulus over that at frequency 0;
the transfer of the derivative taken out, by a factor of 10 at most. The fourth edition takes a Tukey window and a
polynomial, earlier ones a Hamming window and a straight line: both are here.

The standard states no uncertainty. The response is a quotient of linear functions of the pixels once the edge is
located, so that the noise of the pixels propagates through it in closed form. What binning and window take away is a
bias, which is the figure `sfr50_bias`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from scipy.signal import windows

from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import NotDetermined
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, PlotCurve, StandardMap, StandardPlot
from lab.formats.results.words import format_value
from lab.observables.edges.finding import Region, region_planes
from lab.observables.edges.measured import edges_of, measure_edge
from lab.observables.edges.mtf import EdgeMtf, read_mtf
from lab.observables.edges.profile import EdgeSummary
from lab.observables.edges.region import check_phases
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard
from sim.spectrum import FloatArray

Window = Literal["tukey", "hamming"]

BINS_PER_PX = 4
POLYNOMIAL_ORDER = 5  # at most; the fourth edition's
MOST_CORRECTION = 10.0  # of the derivative's transfer
#: Angle from the rows or columns, deg: 5 is what the standard's chart has.
LEAST_ANGLE_DEG, MOST_ANGLE_DEG = 2.0, 10.0
#: Dark over light side of the edge: the chart's contrast is 4:1, 25 %.
LEAST_DARK_SHARE, MOST_DARK_SHARE = 0.10, 0.40
LEAST_LINES = 60
MAP_ROWS, MAP_COLS = 5, 7
#: Of the edge's positions in the lines about their curve, rms.
MOST_SCATTER_PX = 1.0


@dataclass(frozen=True)
class ESfr:
    """The e-SFR of one region: `frequency` (n,) cycles per pixel of the region's grid along the normal of the edge,
    `sfr` and its covariance (n, n) by the noise of the pixels."""

    frequency: FloatArray
    sfr: FloatArray
    covariance: FloatArray
    angle_deg: float
    empty_bins: int

    @property
    def std(self) -> FloatArray:
        """Standard deviations (n,) of `sfr`."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))

    def falls_to(self, level: float) -> tuple[float, float]:
        """Return the first frequency at which the response falls to `level`, and its standard deviation.

        Raises NotDetermined where it doesn't up to the highest frequency.
        """
        below = np.flatnonzero(self.sfr < level)
        if not below.size:
            raise NotDetermined("e-SFR", f"the response doesn't fall to {level:g} up to {self.frequency[-1]:.2g} cy/px")
        k = int(below[0])
        f0, f1, s0, s1 = self.frequency[k - 1], self.frequency[k], self.sfr[k - 1], self.sfr[k]
        share = (s0 - level) / (s0 - s1)
        gradient = np.array([1.0 - share, share])
        pair = self.covariance[np.ix_([k - 1, k], [k - 1, k])]
        std = float(np.sqrt(max(gradient @ pair @ gradient, 0.0))) * (f1 - f0) / (s0 - s1)
        return float(f0 + share * (f1 - f0)), std

    def at(self, frequency: float) -> tuple[float, float]:
        """Return the response at a frequency and its standard deviation."""
        return float(np.interp(frequency, self.frequency, self.sfr)), float(
            np.interp(frequency, self.frequency, self.std)
        )


def measure_e_sfr(
    region: FloatArray,
    noise_std: tuple[float, float] = (0.0, 0.0),
    window: Window = "tukey",
    order: int = POLYNOMIAL_ORDER,
    highest: float = 1.0,
) -> ESfr:
    """Return the e-SFR of a linear region (lines, samples) with one edge that crosses every line.

    `noise_std`: standard deviations of a pixel on the dark and on the light side. `window`: "tukey" (fourth edition) or
    "hamming" (third). `order`: of the polynomial through the edge's positions. `highest`: frequency up to which the
    response is given, cycles per pixel. Raises NotDetermined where the edge isn't within every line.
    """
    values = np.asarray(region, float)
    if values[:, -3:].mean() < values[:, :3].mean():
        values = values[:, ::-1]
    lines, n = values.shape
    place = np.arange(lines)
    edge = _edge_positions(values, window, order)
    line = np.polynomial.polynomial.Polynomial.fit(place, edge, 1)
    if any(np.any((ends < 1.0) | (ends > n - 2.0)) for ends in (edge, line(place))):
        raise NotDetermined("e-SFR", "the edge leaves the region: widen the region, or shorten it along the edge")
    tilt = float(line.deriv()(0.0))
    cosine = float(np.cos(np.arctan(tilt)))
    bins = np.floor(BINS_PER_PX * (np.arange(n)[None, :] - edge[:, None] + n / 2.0)).astype(int)
    size = BINS_PER_PX * n
    inside = (bins >= 0) & (bins < size)
    count = np.bincount(bins[inside], minlength=size).astype(float)
    total = np.bincount(bins[inside], values[inside], size)
    filled = count > 0
    esf = np.interp(np.arange(size), np.flatnonzero(filled), total[filled] / count[filled])
    lsf = np.zeros(size)
    lsf[1:-1] = 0.5 * (esf[2:] - esf[:-2])
    peak = int(np.argmax(lsf))
    shift = size // 2 - peak
    weight = _window(window, size)
    frequency = np.arange(size // 2 + 1) * BINS_PER_PX / size / cosine
    # F_k = sum over bins b of esf_b c_kb: window, rotation and derivative in one matrix
    kept = frequency <= highest
    frequency = frequency[kept]
    k = np.arange(frequency.size)
    transform = np.exp(-2j * np.pi * np.outer(k, np.arange(size)) / size) * weight[None, :]
    transform = np.roll(transform, -shift, axis=1)  # acts on the line spread as it was before the rotation
    onto_esf = np.zeros_like(transform)
    onto_esf[:, 2:] += 0.5 * transform[:, 1:-1]
    onto_esf[:, :-2] -= 0.5 * transform[:, 1:-1]
    spectrum = onto_esf @ esf
    correction = np.minimum(1.0 / np.maximum(np.sinc(2.0 * k / size), 1e-9), MOST_CORRECTION)
    modulus = np.abs(spectrum)
    sfr = correction * modulus / modulus[0]
    share = np.clip((esf - esf[:n].mean()) / max(esf[-n:].mean() - esf[:n].mean(), 1e-300), 0.0, 1.0)
    variance = noise_std[0] ** 2 + share * (noise_std[1] ** 2 - noise_std[0] ** 2)
    phase = spectrum.conj() / np.maximum(modulus, 1e-300)
    along = (phase[:, None] * onto_esf).real
    jacobian = (correction / modulus[0])[:, None] * (along - (modulus / modulus[0])[:, None] * along[0][None, :])
    spread = np.where(filled, variance / np.maximum(count, 1.0), 0.0)
    covariance = (jacobian * spread[None, :]) @ jacobian.T
    return ESfr(frequency, sfr, covariance, float(np.degrees(np.arctan(tilt))), int(np.count_nonzero(~filled)))


def _window(window: Window, size: int) -> FloatArray:
    """Return a centred window (size,)."""
    return np.asarray(windows.tukey(size, 1.0) if window == "tukey" else windows.hamming(size, sym=True))


def _edge_positions(values: FloatArray, window: Window, order: int) -> FloatArray:
    """Return the position of the edge in every line (lines,), px: a polynomial through the centroids of the derivative,
    windowed about the middle first, then about the line found."""
    lines, n = values.shape
    at, place = np.arange(n), np.linspace(-1.0, 1.0, lines)
    slope = np.zeros_like(values)
    slope[:, 1:-1] = 0.5 * (values[:, 2:] - values[:, :-2])
    centre = np.full(lines, (n - 1) / 2.0)
    for number in range(2):
        # a window about the edge, as wide as reaches the farther border
        away = (at[None, :] - centre[:, None]) / np.maximum(centre, n - 1.0 - centre)[:, None]
        cosine = np.cos(np.pi * np.clip(away, -1.0, 1.0))
        weight = 0.5 + 0.5 * cosine if window == "tukey" else 0.54 + 0.46 * cosine
        with np.errstate(divide="ignore", invalid="ignore"):
            centroid = (slope * weight) @ at / (slope * weight).sum(axis=1)
        if not np.all(np.isfinite(centroid)):
            raise NotDetermined("e-SFR", "a line of the region has no edge: narrow the region to the edge")
        degree = min(order if number else 1, max(lines // 20, 1))
        centre = np.polynomial.polynomial.Polynomial.fit(place, centroid, degree, domain=[-1.0, 1.0])(place)
    scatter = float(np.sqrt(np.mean((centroid - centre) ** 2)))
    if scatter > MOST_SCATTER_PX:
        raise NotDetermined(
            "e-SFR",
            f"the positions of the edge scatter by {scatter:.1f} px about the fitted curve; of one edge they do by "
            f"{MOST_SCATTER_PX:g} px at most: narrow the region, or turn the edge to 5 degrees",
        )
    return np.asarray(centre)


@dataclass(frozen=True, eq=False)
class EdgeRecord:
    """One edge of a capture in one channel: its region, its unbiased summary, and the samples of the channel's first
    plane, turned so that lines cross the edge."""

    capture: SlantedEdgeCapture
    channel: str
    region: Region
    summary: EdgeSummary
    samples: FloatArray
    pitch_px: int

    @property
    def name(self) -> str:
        """The capture and the channel, with the middle of a region that was found."""
        name = f"{self.capture.id}, {self.channel}"
        if self.capture.region is not None:
            return name
        row0, col0, row1, col1 = self.region
        return f"{name} at row {(row0 + row1) // 2}, column {(col0 + col1) // 2}"

    @cached_property
    def unbiased(self) -> EdgeMtf:
        """The unbiased MTF of the same edge, to the highest frequency of the letter's."""
        return read_mtf(self.summary)

    def e_sfr(self, window: Window = "tukey", order: int = POLYNOMIAL_ORDER) -> ESfr:
        """Return the e-SFR as the standard specifies it, in cycles per pixel of the plane's own grid."""
        return measure_e_sfr(self.samples, self.summary.noise_std, window, order)


def edge_records(side: MeasuredSide) -> list[EdgeRecord]:
    """Return the edges of the side in the green (or only) channel, repeats of a region taken together.

    Raises NotDetermined where no capture has a usable edge.
    """
    camera = side.camera
    channel = "Y" if camera.cfa == "MONO" else "G"
    groups: dict[object, list[SlantedEdgeCapture]] = {}
    for capture in side.recordings.captures(SlantedEdgeCapture, side.side):
        groups.setdefault((capture.region, capture.angle_deg, capture.exposure_s, capture.gain_db), []).append(capture)
    readings, reasons = [], ["no slanted_edge captures"]
    for group in groups.values():
        try:
            first = group[0]
            regions = [first.region] if first.region else [e.region for e in edges_of(side.recordings, first)]
        except NotDetermined as refused:
            reasons.append(refused.reason)
            continue
        for region in regions:
            try:
                summary = measure_edge(side.recordings, group, channel, side.fit.noise, region)
                check_phases("e-SFR", camera.cfa, channel, region, summary.angle_deg)
            except NotDetermined as refused:
                reasons.append(refused.reason)
                continue
            mean = np.mean([side.recordings.frame(c).astype(float) for c in group], axis=0)
            plane = region_planes(mean, region, camera.cfa, channel)[0]
            turned = plane.values.T if summary.curve.transposed else plane.values
            readings.append(EdgeRecord(first, channel, region, summary, np.asarray(turned, float), plane.step))
    if not readings:
        raise NotDetermined(Iso12233.name, reasons[-1])
    return readings


class Iso12233(Standard):
    """ISO 12233:2023, the e-SFR of one edge."""

    name: ClassVar[str] = "ISO 12233:2023"
    title: ClassVar[str] = "spatial frequency response of a slanted edge"
    target: ClassVar[str] = "slanted edges of contrast 4:1 at 5 degrees"
    compared: ClassVar[str] = (
        "quickMTF 2023.3.3: SFR50 0.7 to 4.4 % lower, as its window is narrower (predicted by the two windows"
        " within 0.5 %); on the real edge of `sfrmat5_edges` 0.281 ± 0.003 cy/px, the unbiased estimate 0.286"
        " ± 0.002, two other programs 0.291 and 0.294 (their region and tone curve are not known)"
    )
    not_done: ClassVar[tuple[NotDone, ...]] = (
        NotDone(
            "6.3",
            "s-SFR of a sine-modulated starburst",
            "needs a starburst target with grey levels; the screen of the bench shows two",
        ),
        NotDone("5", "visual resolution of hyperbolic wedges", "needs a printed chart"),
    )

    def __init__(self, side: MeasuredSide, edge: EdgeRecord) -> None:
        super().__init__(side, edge.name)
        self.edge = edge

    @cached_property
    def letter(self) -> ESfr:
        """The e-SFR as specified."""
        return self.edge.e_sfr()

    @property
    def has_response(self) -> bool:
        """Whether the e-SFR of the region can be computed as specified."""
        try:
            return self.letter.frequency.size > 0
        except NotDetermined:
            return False

    def _frequency(self, pair: tuple[float, float]) -> Estimate:
        value, std = pair
        return Estimate(value=value / self.edge.pitch_px, std=std / self.edge.pitch_px, unit="cy/px")

    @ClauseFigure
    def sfr50(self) -> Estimate:
        """Return the frequency of 50 % response.

        Clause: 6.2. Symbol: SFR50. Unit: cy/px.
        Formula: first f with SFR(f) = 0.5, SFR = D(f) |DFT(w LSF)(f)| / |DFT(w LSF)(0)|.
        """
        return self._frequency(self.letter.falls_to(0.5))

    @ClauseFigure
    def sfr10(self) -> Estimate:
        """Return the limiting resolution.

        Clause: 6.2. Symbol: SFR10. Unit: cy/px.
        Formula: first f with SFR(f) = 0.1.
        """
        return self._frequency(self.letter.falls_to(0.1))

    @ClauseFigure
    def sfr_at_half_nyquist(self) -> Estimate:
        """Return the response at half the Nyquist frequency.

        Clause: 6.2. Symbol: SFR(0.25). Unit: 1.
        Formula: SFR at 0.25 cycles per pixel of the plane.
        """
        value, std = self.letter.at(0.25)
        return Estimate(value=value, std=std, unit="1")

    @ClauseFigure
    def edge_angle(self) -> Estimate:
        """Return the angle of the edge from the nearer axis of the pixels.

        Clause: 6.2. Symbol: α. Unit: deg.
        Formula: arctan of the slope of the line through the edge's positions.
        """
        angle = abs((self.edge.summary.angle_deg + 45.0) % 90.0 - 45.0)
        return Estimate(value=angle, std=self.edge.summary.angle_deg_std, unit="deg")

    @ClauseFigure
    def unbiased_mtf50(self) -> Estimate:
        """Return the unbiased estimate of the frequency of 50 % response.

        Clause: none. Symbol: MTF50. Unit: cy/px.
        Formula: of a spline profile fitted to all samples by least squares.
        """
        unbiased = self.edge.unbiased
        if unbiased.mtf50_cy_per_px is None:
            raise NotDetermined(self.name, "the response doesn't fall to 50 %")
        return Estimate(value=unbiased.mtf50_cy_per_px, std=unbiased.mtf50_cy_per_px_std, unit="cy/px")

    @ClauseFigure
    def sfr50_bias(self) -> Estimate:
        """Return the difference of the standard's estimate from the unbiased one.

        Clause: none. Symbol: δ. Unit: %.
        Formula: SFR50 / MTF50 − 1, both of the same samples.
        """
        biased, free = self.sfr50, self.unbiased_mtf50
        ratio = biased.value / free.value
        std = ratio * float(np.hypot((biased.std or 0.0) / biased.value, (free.std or 0.0) / free.value))
        return Estimate(value=100.0 * (ratio - 1.0), std=100.0 * std, unit="%")

    def deviations(self) -> Iterator[Deviation]:
        summary, letter = self.edge.summary, self.letter
        angle = self.edge_angle.value
        if not LEAST_ANGLE_DEG <= angle <= MOST_ANGLE_DEG:
            yield Deviation(
                clause="6.2",
                quantity="angle of the edge",
                found=f"{angle:.3g}°",
                limit=f"5°, {LEAST_ANGLE_DEG:g} to {MOST_ANGLE_DEG:g}° here",
                remedy="turn the edge",
            )
        black = self.measured.dataset.noise.black
        dark, light = (level - black for level in summary.levels)
        share = dark / light
        if not LEAST_DARK_SHARE <= share <= MOST_DARK_SHARE:
            yield Deviation(
                clause="4.3",
                quantity="dark side of the edge over its light side",
                found=f"{100.0 * max(share, 0.0):.2g} %",
                limit=f"a contrast of 4:1 (25 %), {100 * LEAST_DARK_SHARE:g} to {100 * MOST_DARK_SHARE:g} % here",
                remedy="take an edge of the chart's contrast",
            )
        if self.edge.samples.shape[0] < LEAST_LINES:
            yield Deviation(
                clause="6.2",
                quantity="lines of the region",
                found=f"{self.edge.samples.shape[0]}",
                limit=f"{LEAST_LINES} at least",
                remedy="take a longer edge",
            )
        if letter.empty_bins:
            yield Deviation(
                clause="6.2",
                quantity="bins of a quarter pixel without a sample",
                found=f"{letter.empty_bins}",
                limit="samples in every bin",
                remedy="take a longer edge, or turn it to 5°",
            )
        if self.measured.camera.cfa != "MONO":
            yield Deviation(
                clause="6.2",
                quantity="image data",
                found="one plane of the raw mosaic, sampled at every second pixel",
                limit="luminance of the finished image",
                remedy="nothing: a finished image holds the demosaicing, too; the frequencies are of the full sensor",
            )

    def conditions(self) -> Iterator[str]:
        lines, samples = self.edge.samples.shape
        yield f"{lines} lines of {samples} samples, raw data (linear: no OECF is inverted)"
        row0, col0, row1, col1 = self.edge.region
        yield (
            f"{self.edge.name}: rows {row0} to {row1 - 1}, columns {col0} to {col1 - 1}, edge at "
            f"{self.edge.summary.angle_deg:.2f}° from the vertical"
        )

    def remarks(self) -> Iterator[str]:
        try:
            value, std = self.edge.e_sfr("hamming", 1).falls_to(0.5)
        except NotDetermined:
            return
        pitch = self.edge.pitch_px
        yield (
            "by the third edition (Hamming window, straight line) SFR50 is "
            f"{format_value(value / pitch, std / pitch)} cy/px"
        )

    def plots(self) -> Iterator[StandardPlot]:
        letter, free = self.letter, self.edge.unbiased
        kept = free.frequency_cy_per_px <= 1.0 / self.edge.pitch_px
        yield StandardPlot(
            title="Spatial frequency response",
            x_label="frequency, cy/px",
            y_label="SFR",
            curves=(
                PlotCurve(
                    label="e-SFR as specified",
                    x=tuple((letter.frequency / self.edge.pitch_px).tolist()),
                    y=tuple(letter.sfr.tolist()),
                    y_std=tuple(letter.std.tolist()),
                    style="points",
                    channel=self.edge.channel,
                ),
                PlotCurve(
                    label="unbiased estimate",
                    x=tuple(free.frequency_cy_per_px[kept].tolist()),
                    y=tuple(free.mtf[kept].tolist()),
                    y_std=tuple(free.mtf_std[kept].tolist()),
                ),
            ),
        )


class Iso12233Field(Standard):
    """ISO 12233:2023, the e-SFR over the frame."""

    name: ClassVar[str] = "ISO 12233:2023"
    title: ClassVar[str] = "spatial frequency response over the frame"
    target: ClassVar[str] = "slanted edges from centre to corners"
    compared: ClassVar[str] = "the edges themselves"

    def __init__(self, side: MeasuredSide, edges: list[Iso12233]) -> None:
        super().__init__(side, "whole frame")
        self.edges = edges

    @cached_property
    def _each(self) -> list[tuple[float, float, float, float]]:
        """Row and column of the middle, SFR50 and its standard deviation, of each edge that has one."""
        places = []
        for edge in self.edges:
            try:
                value = edge.sfr50
            except NotDetermined:
                continue
            row0, col0, row1, col1 = edge.edge.region
            places.append((0.5 * (row0 + row1), 0.5 * (col0 + col1), value.value, value.std or 0.0))
        if not places:
            raise NotDetermined(self.name, "no edge whose response falls to 50 %")
        return places

    def _average_weighted(self, chosen: list[tuple[float, float, float, float]]) -> Estimate:
        values = np.array([place[2] for place in chosen])
        stds = np.array([place[3] for place in chosen])
        return Estimate(value=float(values.mean()), std=float(np.sqrt(np.sum(stds**2))) / len(chosen), unit="cy/px")

    def _radius(self, place: tuple[float, float, float, float]) -> float:
        camera = self.measured.camera
        return float(np.hypot(place[0] - camera.rows / 2.0, place[1] - camera.cols / 2.0)) / (
            0.5 * float(np.hypot(camera.rows, camera.cols))
        )

    @ClauseFigure
    def centre_sfr50(self) -> Estimate:
        """Return the mean frequency of 50 % response in the centre.

        Clause: 6.2. Symbol: SFR50.centre. Unit: cy/px.
        Formula: mean over the edges within 0.3 of the half diagonal.
        """
        chosen = [place for place in self._each if self._radius(place) <= 0.3]
        if not chosen:
            raise NotDetermined(self.name, "no edge within 0.3 of the half diagonal")
        return self._average_weighted(chosen)

    @ClauseFigure
    def corner_sfr50(self) -> Estimate:
        """Return the mean frequency of 50 % response in the corners.

        Clause: 6.2. Symbol: SFR50.corner. Unit: cy/px.
        Formula: mean over the edges beyond 0.7 of the half diagonal.
        """
        chosen = [place for place in self._each if self._radius(place) >= 0.7]
        if not chosen:
            raise NotDetermined(self.name, "no edge beyond 0.7 of the half diagonal")
        return self._average_weighted(chosen)

    @ClauseFigure
    def lowest_sfr50(self) -> Estimate:
        """Return the lowest frequency of 50 % response.

        Clause: 6.2. Symbol: SFR50.min. Unit: cy/px.
        Formula: least of all edges.
        """
        return self._average_weighted([min(self._each, key=lambda place: place[2])])

    def deviations(self) -> Iterator[Deviation]:
        yield from {deviation.line: deviation for edge in self.edges for deviation in edge.deviations()}.values()

    def maps(self) -> Iterator[StandardMap]:
        camera = self.measured.camera
        cells: dict[tuple[int, int], list[float]] = {}
        for row, col, value, _ in self._each:
            place = (int(MAP_ROWS * row / camera.rows), int(MAP_COLS * col / camera.cols))
            cells.setdefault(place, []).append(value)
        if len(cells) < 2:
            return
        yield StandardMap(
            title="SFR50 over the frame",
            unit="cy/px",
            values=tuple(
                tuple(float(np.mean(cells[row, col])) if (row, col) in cells else None for col in range(MAP_COLS))
                for row in range(MAP_ROWS)
            ),
            caption=f"Means over cells of {MAP_ROWS} × {MAP_COLS}; empty where no edge lies.",
        )


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard for each edge and for the frame. Raises NotDetermined where no edge is usable."""
    edges = [Iso12233(side, edge) for edge in edge_records(side)]
    if measured_edges := [edge for edge in edges if edge.has_response]:
        yield Iso12233Field(side, measured_edges)
    yield from edges
