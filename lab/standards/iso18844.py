"""ISO 18844:2017: image flare, the light in a black part of a bright chart.

From the flare chart on the screen (`lab.capture_kinds.flare`) where it was captured, else from the dark squares of
patterns on the screen, which are half lit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.capture_kinds.flare import FlareCapture
from lab.errors import NotDetermined
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation
from lab.observables.observable import Observable
from lab.observables.screens.dark_squares import measure_screen
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard
from sim.sensor import mosaic
from sim.spectrum import FloatArray

#: Size of the white chart over that of the field.
LEAST_CHART_OVER_FIELD = 1.41
MOST_BLACK_PERCENT = 5.0
#: Part of the black square, about its middle, that is read, of its side: its borders hold the lens's blur.
INNER_SHARE = 0.5
LEAST_PIXELS = 64


class Iso18844(Standard):
    """ISO 18844:2017, of one channel, from patterns that are half lit."""

    name: ClassVar[str] = "ISO 18844:2017"
    title: ClassVar[str] = "image flare"
    target: ClassVar[str] = (
        "the flare chart on the screen (`calibench run --standards`), or white, black and patterns of one pose"
    )
    compared: ClassVar[str] = "no peer on the package index; a veil of known size in the tests"
    not_done: ClassVar[tuple[NotDone, ...]] = (
        NotDone(
            "4.2",
            "flare over the field (nine black squares)",
            "the chart of the bench has one square",
        ),
    )

    def __init__(self, side: MeasuredSide, channel: str, share: FloatArray, covariance: FloatArray) -> None:
        super().__init__(side, f"channel {channel}")
        self.share, self.covariance = share, covariance

    @ClauseFigure
    def flare(self) -> Estimate:
        """Return the image flare.

        Clause: 6. Symbol: F. Unit: %.
        Formula: 100 (Y_black in the lit chart − Y of the dark chart) / (Y_white − Y of the dark chart), mean over
        repeats or patterns, weighted by their covariance.
        """
        inverse = np.linalg.pinv(self.covariance)
        ones = np.ones(len(self.share))
        norm = float(ones @ inverse @ ones)
        value = float(ones @ inverse @ self.share) / norm
        rest = self.share - value
        chi2 = float(rest @ inverse @ rest) / max(len(ones) - 1, 1)
        return Estimate(value=100.0 * value, std=100.0 * float(np.sqrt(max(chi2, 1.0) / norm)), unit="%")

    def deviations(self) -> Iterator[Deviation]:
        yield Deviation(
            clause="4.2",
            quantity="chart",
            found="dark squares of a pattern that is half lit",
            limit="a black area of 5 % at most on white that exceeds the field of view by 41 %",
            remedy="show the flare chart on a larger screen (calibench run --standards)",
        )

    def remarks(self) -> Iterator[str]:
        yield (
            "the light of a chart that fills the field would be about twice that of a pattern that is half lit, as a "
            "veil is proportional to it; the wings of the point spread function are part of the flare"
        )


@dataclass(frozen=True)
class FlareChart:
    """The black square in one channel of the mean lit frame: levels above the dark screen, DN, with their standard
    deviations, and its share of the frame's area."""

    black_dn: float
    black_dn_std: float
    white_dn: float
    white_dn_std: float
    black_percent: float


class Iso18844FromChart(Iso18844):
    """ISO 18844:2017, of one channel, from the flare chart."""

    def __init__(self, side: MeasuredSide, channel: str, chart: FlareChart, over_field: float | None) -> None:
        share = chart.black_dn / chart.white_dn
        variance = (chart.black_dn_std**2 + (share * chart.white_dn_std) ** 2) / chart.white_dn**2
        super().__init__(side, channel, np.array([share]), np.array([[variance]]))
        self.chart, self.over_field = chart, over_field

    def deviations(self) -> Iterator[Deviation]:
        if self.over_field is None or self.over_field < LEAST_CHART_OVER_FIELD:
            departure = (
                "not known" if self.over_field is None else f"{100.0 * (self.over_field - 1.0):+.0f} % of the field"
            )
            yield Deviation(
                clause="4.2",
                quantity="extent of the white chart beyond the field of view",
                found=departure,
                limit="+41 %",
                remedy="bring the screen nearer, or take a larger one",
            )
        if self.chart.black_percent > MOST_BLACK_PERCENT:
            yield Deviation(
                clause="4.2",
                quantity="black area of the chart",
                found=f"{self.chart.black_percent:.2g} % of the frame",
                limit=f"{MOST_BLACK_PERCENT:g} % at most",
                remedy="show a smaller square",
            )

    def conditions(self) -> Iterator[str]:
        yield f"a black square of {self.chart.black_percent:.2g} % of the frame on a white screen"
        yield "the dark screen's own light is subtracted"

    def remarks(self) -> Iterator[str]:
        yield "the wings of the point spread function over half of the square's side are part of the flare"


Mask = NDArray[np.bool_]


def find_black_square(frame: FloatArray) -> tuple[Mask, Mask, Mask]:
    """Return masks (rows, cols) of the black square of a lit chart, of its inner part, and of the white beyond it.

    The square is the dark region nearest the middle of the frame. Raises NotDetermined where there is none.
    """
    smooth = ndimage.uniform_filter(np.asarray(frame, float), 3)
    white, black = np.percentile(smooth, [80.0, 0.5])
    labels, count = ndimage.label(smooth < 0.5 * (white + black))
    middle = 0.5 * (np.array(frame.shape) - 1.0)
    best: tuple[float, int] | None = None
    for number in range(1, count + 1):
        place = np.argwhere(labels == number)
        if len(place) < LEAST_PIXELS:
            continue
        away = float(np.linalg.norm(place.mean(axis=0) - middle))
        best = min(best, (away, number)) if best is not None else (away, number)
    if best is None or not white > 2.0 * black + 1e-9:
        raise NotDetermined(Iso18844.name, "no black square in the lit chart; show it in the middle of the field")
    square = labels == best[1]
    side = float(np.sqrt(square.sum()))
    depth = ndimage.distance_transform_edt(square)
    inner = np.asarray(depth >= 0.5 * (1.0 - INNER_SHARE) * side)
    outer = np.asarray(ndimage.distance_transform_edt(~square) >= 0.5 * side)
    # what else is dark, as a border of the screen, isn't white
    return square, inner, outer & (smooth > 0.8 * white)


def measure_flare_chart(lit: FloatArray, dark: FloatArray, noise_std: tuple[float, float]) -> FlareChart:
    """Measure the black square in the mean lit and dark frames (rows, cols) of one plane, DN.

    `noise_std`: standard deviations, DN, of a pixel of lit less dark in the black and in the white part.
    """
    apart = lit - dark
    square, inner, outer = find_black_square(apart)
    if min(inner.sum(), outer.sum()) < LEAST_PIXELS:
        raise NotDetermined(
            Iso18844.name, f"the inner part of the black square has {int(inner.sum())} pixels; show a larger one"
        )
    return FlareChart(
        black_dn=float(apart[inner].mean()),
        black_dn_std=noise_std[0] / float(np.sqrt(inner.sum())),
        white_dn=float(apart[outer].mean()),
        white_dn_std=noise_std[1] / float(np.sqrt(outer.sum())),
        black_percent=100.0 * float(square.sum()) / lit.size,
    )


def _from_charts(side: MeasuredSide, captures: list[FlareCapture]) -> Iterator[Standard]:
    data = side.dataset
    lit, dark = ([c for c in captures if c.lit == wanted] for wanted in (True, False))
    if not lit or not dark:
        raise NotDetermined(Iso18844.name, "flare captures of the lit or of the dark screen are missing; capture both")
    means = [np.mean([np.asarray(data.recordings.frame(c), float) for c in group], axis=0) for group in (lit, dark)]
    step = mosaic.step(data.camera.cfa)
    for channel in data.channels:
        planes: list[Any] = []
        for frame in means:
            parts = [frame[r::step, c::step] for r, c in mosaic.phases(data.camera.cfa)[channel]]
            planes.append(np.mean(parts, axis=0))
        frames = len(mosaic.phases(data.camera.cfa)[channel])
        white = float(np.percentile(planes[0] - planes[1], 80.0))
        read = data.noise.read_dn**2 * (1.0 / len(lit) + 1.0 / len(dark))
        stds = [
            float(
                np.sqrt((read + data.noise.gain * level / len(lit)) / frames + (data.noise.prnu * level) ** 2 / frames)
            )
            for level in (0.01 * white, white)
        ]
        chart = measure_flare_chart(planes[0], planes[1], (stds[0], stds[1]))
        # black levels of two frames differ by their repeatability, which no number of pixels reduces
        jitter = data.noise.jitter_dn * float(np.sqrt(1.0 / len(lit) + 1.0 / len(dark)))
        flare = FlareChart(
            chart.black_dn, float(np.hypot(chart.black_dn_std, jitter)), chart.white_dn,
            float(np.hypot(chart.white_dn_std, jitter)), chart.black_percent,
        )  # fmt: skip
        yield Iso18844FromChart(side, channel, flare, lit[0].chart_over_field)


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard for each channel. Raises NotDetermined without the flare chart, and without white, black and
    patterned captures of one pose of a screen."""
    charts = side.recordings.captures(FlareCapture, side.side)
    if charts:
        yield from _from_charts(side, charts)
        return
    measured: Observable = measure_screen(side.dataset)
    white = np.asarray(measured.scale)
    usable = [k for k, label in enumerate(measured.labels) if not label.held_out and white[k] > 0]
    if not usable:
        raise NotDetermined(Iso18844.name, "no lit screen; capture white, black and a pattern of one pose")
    share = measured.value / white
    covariance = measured.covariance / np.outer(white, white)
    for channel in side.dataset.channels:
        of_channel = [k for k in usable if measured.labels[k].channel == channel]
        if of_channel:
            yield Iso18844(side, channel, share[of_channel], covariance[np.ix_(of_channel, of_channel)])
