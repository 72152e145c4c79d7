"""IEEE 1858 (CPIQ): acutance of a slanted edge for stated viewing conditions.

The response of the camera is weighted by the contrast sensitivity of the eye at the angle under which the viewer sees a
pixel. The response is the unbiased estimate of `lab.observables.edges.mtf`, with its covariance, so that the
uncertainty of the acutance is that of a linear function of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lab.errors import NotDetermined
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, PlotCurve, StandardPlot
from lab.observables.edges.finding import Array
from lab.standards.iso12233 import EdgeRecord, edge_records
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard

#: Contrast sensitivity a f^c exp(-b f) / K, f in cycles per degree.
CSF_A, CSF_B, CSF_C, CSF_K = 75.0, 0.2, 0.8, 34.05
#: Frequency up to which the eye's sensitivity is integrated, cycles per degree.
HIGHEST_CY_PER_DEG = 200.0


@dataclass(frozen=True)
class ViewingCondition:
    """How a picture is seen. `height_mm`: of the whole picture as shown; None: one pixel of the camera is one of a
    screen of `pitch_mm`."""

    name: str
    distance_mm: float
    height_mm: float | None = None
    pitch_mm: float = 0.0

    def pixels_per_degree(self, rows: int) -> float:
        """Return the number of camera pixels that the viewer sees in a degree; `rows`: of the frame."""
        pitch = self.pitch_mm if self.height_mm is None else self.height_mm / rows
        return float(self.distance_mm * 2.0 * np.tan(np.radians(0.5)) / pitch)

    def words(self) -> str:
        """Return the condition in words."""
        shown = f"pixels of {self.pitch_mm:g} mm" if self.height_mm is None else f"{self.height_mm:g} mm high"
        return f"{self.name}: {shown}, seen from {self.distance_mm:g} mm"


SCREEN = ViewingCondition("screen at 100 %", 600.0, pitch_mm=0.25)
PRINT = ViewingCondition("print", 400.0, height_mm=100.0)
TELEVISION = ViewingCondition("television set", 2000.0, height_mm=600.0)


def contrast_sensitivity(frequency_cy_per_deg: Array) -> Array:
    """Return the eye's contrast sensitivity to luminance (n,) at frequencies (n,), cycles per degree; 3.0 at its
    maximum, at 4 cycles per degree."""
    f = np.asarray(frequency_cy_per_deg, float)
    return np.asarray(CSF_A * f**CSF_C * np.exp(-CSF_B * f) / CSF_K)


def acutance(
    frequency_cy_per_px: Array, mtf: Array, covariance: Array, pixels_per_degree: float
) -> tuple[float, float]:
    """Return the acutance and its standard deviation.

    `frequency_cy_per_px`, `mtf` (n,), `covariance` (n, n): the response, from frequency 0 up; it counts to the Nyquist
    frequency of 0.5 cycles per pixel. `pixels_per_degree`: see `ViewingCondition`.
    """
    kept = frequency_cy_per_px <= 0.5 + 1e-9
    f = frequency_cy_per_px[kept] * pixels_per_degree
    # the response is linear between its points: weights of the points by an integral over a fine grid
    fine = np.linspace(0.0, f[-1], 4001)
    csf = contrast_sensitivity(fine)
    step = fine[1] - fine[0]
    trapezoid = np.full(fine.size, step)
    trapezoid[[0, -1]] *= 0.5
    share = np.clip(np.searchsorted(f, fine, side="right") - 1, 0, f.size - 2)
    right = (fine - f[share]) / (f[share + 1] - f[share])
    weights = np.zeros(f.size)
    np.add.at(weights, share, csf * trapezoid * (1.0 - right))
    np.add.at(weights, share + 1, csf * trapezoid * right)
    whole = np.linspace(0.0, HIGHEST_CY_PER_DEG, 20001)
    weights /= float(np.trapezoid(contrast_sensitivity(whole), whole))
    part = covariance[np.ix_(kept, kept)]
    return float(weights @ mtf[kept]), float(np.sqrt(max(float(weights @ part @ weights), 0.0)))


class Ieee1858(Standard):
    """IEEE 1858-2016 (CPIQ), the acutance of one edge."""

    name: ClassVar[str] = "IEEE 1858-2016 (CPIQ)"
    title: ClassVar[str] = "acutance of a slanted edge for stated viewing conditions"
    target: ClassVar[str] = "slanted edges"
    compared: ClassVar[str] = "no peer on the package index; the integral of the contrast sensitivity in closed form"
    not_done: ClassVar[tuple[NotDone, ...]] = (
        NotDone("5.4", "quality loss in JND", "the text of the standard was not at hand"),
        NotDone("6", "texture blur, chroma level, local distortion", "need a dead-leaves chart"),
    )

    def __init__(self, side: MeasuredSide, edge: EdgeRecord) -> None:
        super().__init__(side, edge.name)
        self.edge = edge

    def _acutance(self, condition: ViewingCondition) -> Estimate:
        unbiased = self.edge.unbiased
        value, std = acutance(
            unbiased.frequency_cy_per_px,
            unbiased.mtf,
            unbiased.covariance,
            condition.pixels_per_degree(self.measured.camera.rows),
        )
        if not np.isfinite(value):
            raise NotDetermined(self.name, "the response of the edge isn't finite")
        return Estimate(value=value, std=std, unit="1")

    @ClauseFigure
    def screen_acutance(self) -> Estimate:
        """Return the acutance on a screen at 100 %.

        Clause: 5.4. Symbol: A.screen. Unit: 1.
        Formula: ∫ MTF(f) CSF(f) df / ∫ CSF(f) df with CSF = 75 f^0.8 exp(−0.2 f) / 34.05, f in cycles per degree.
        """
        return self._acutance(SCREEN)

    @ClauseFigure
    def print_acutance(self) -> Estimate:
        """Return the acutance of a print.

        Clause: 5.4. Symbol: A.print. Unit: 1.
        Formula: as on a screen.
        """
        return self._acutance(PRINT)

    @ClauseFigure
    def television_acutance(self) -> Estimate:
        """Return the acutance on a television set.

        Clause: 5.4. Symbol: A.television. Unit: 1.
        Formula: as on a screen.
        """
        return self._acutance(TELEVISION)

    def deviations(self) -> Iterator[Deviation]:
        yield Deviation(
            clause="5.4",
            quantity="image data",
            found="raw data",
            limit="the finished image on the stated display, whose own response belongs to it",
            remedy="multiply by the display's response where it is known",
        )

    def conditions(self) -> Iterator[str]:
        for viewing in (SCREEN, PRINT, TELEVISION):
            shown = viewing.pixels_per_degree(self.measured.camera.rows)
            yield f"{viewing.words()}: {shown:.3g} pixels a degree"

    def plots(self) -> Iterator[StandardPlot]:
        unbiased = self.edge.unbiased
        per_degree = SCREEN.pixels_per_degree(self.measured.camera.rows)
        kept = unbiased.frequency_cy_per_px <= 0.5
        f = unbiased.frequency_cy_per_px[kept] * per_degree
        yield StandardPlot(
            title="Response and contrast sensitivity, screen at 100 %",
            x_label="frequency, cycles per degree",
            y_label="",
            curves=(
                PlotCurve(
                    label="response",
                    x=tuple(f.tolist()),
                    y=tuple(unbiased.mtf[kept].tolist()),
                    y_std=tuple(unbiased.mtf_std[kept].tolist()),
                    style="points",
                    channel=self.edge.channel,
                ),
                PlotCurve(
                    label="contrast sensitivity of the eye, over its maximum",
                    x=tuple(f.tolist()),
                    y=tuple((contrast_sensitivity(f) / contrast_sensitivity(np.array([CSF_C / CSF_B]))).tolist()),
                    style="dashed",
                ),
            ),
        )


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the acutance of each edge. Raises NotDetermined where no edge is usable."""
    for edge in edge_records(side):
        yield Ieee1858(side, edge)
