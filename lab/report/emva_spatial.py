"""The data sheet's spatial plots: spectrograms, histograms and profiles of DSNU and PRNU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Emva1288, Emva1288Points
from lab.formats.results.in_words import measured
from lab.measure.dark_pixels import stack_of
from lab.measure.stated_light import light_of
from lab.report.charts import AFTER, BEFORE, Trace, axis, layout
from lab.report.emva_plot import EmvaPlot, curve, floats, markers
from sim.camera import Side
from sim.sensor.mosaic import planes
from sim.spectrum import FloatArray

MOST_POINTS = 700  # of a profile; longer ones are thinned out
HISTOGRAM_BINS = 256  # at most, as the standard has it
HIGH_PASS_PX = 5  # side of the box whose mean is subtracted from the bright image


@dataclass(frozen=True)
class _MeanImages:
    """Mean images of the stacks of one plane of the mosaic."""

    dark: FloatArray  # DN
    bright: FloatArray | None  # DN
    dark_left_dn2: float  # temporal variance that remains in the mean dark image
    bright_left_dn2: float  # the same of the mean bright image
    dark_step_dn: float  # between possible values of the mean dark image


def spatial_plots(recordings: RecordingSet, side: Side, own: Emva1288, plane: str) -> Iterator[EmvaPlot]:
    """The spatial plots of one plane, whose figures are `own`; none where its stacks aren't in the recordings."""
    images = _stacks(recordings, side, own.points, plane)
    if images is None:
        return
    gain = own.system_gain_dn_per_e
    dark = images.dark - images.dark.mean()
    yield _spectrogram("DSNU", dark / gain, images.dark_left_dn2 / gain**2, "e")
    bright = None
    if images.bright is not None:
        signal = float(images.bright.mean() - images.dark.mean())
        bright = 100.0 * (images.bright - images.dark - signal) / signal
        left = 1e4 * (images.bright_left_dn2 + images.dark_left_dn2) / signal**2
        yield _spectrogram("PRNU", bright, left, "%")
    yield _histogram("DSNU", dark / gain, images.dark_left_dn2 / gain**2, "e", images.dark_step_dn / gain)
    if bright is not None:
        # subtracting the mean of n = 25 pixels leaves 1 - 1/n of the noise variance
        high = bright - cv2.blur(bright, (HIGH_PASS_PX, HIGH_PASS_PX), borderType=cv2.BORDER_REFLECT)
        yield _histogram("PRNU", high, left * (1.0 - HIGH_PASS_PX**-2), "%")
    yield _profiles("DSNU", images.dark, "DN")
    if bright is not None:
        yield _profiles("PRNU", 100.0 + bright, "% of the mean")


def _stacks(recordings: RecordingSet, side: Side, points: Emva1288Points, plane: str) -> _MeanImages | None:
    """The image stacks that the spatial figures were computed from."""
    darks = [c for c in recordings.captures(DarkCapture, side) if c.exposure_s == points.stack_dark_exposure_s]

    every = recordings.captures(FlatCapture, side)
    light = light_of(every, recordings.camera(side))
    flats = [c for c in every if c.exposure_s == points.stack_exposure_s and light[c.id].amount == points.stack_light]
    if not darks:
        return None

    def mean(captures: list[DarkCapture] | list[FlatCapture]) -> tuple[FloatArray, float]:
        stack = stack_of(recordings, captures)
        camera = recordings.camera(side)
        left = 0.0
        if stack.squares is not None:
            left = float(planes(stack.squares, camera.cfa)[plane].mean(dtype=float)) / (stack.count - 1) / stack.count
        return np.array(planes(stack.image(), camera.cfa)[plane], float), left

    dark, dark_left = mean(darks)
    bright, bright_left = mean(flats) if flats else (None, 0.0)
    return _MeanImages(dark, bright, dark_left, bright_left, 1.0 / len(darks))


def spectrogram(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frequencies (cycles/px) and rms amplitude along the rows of an image: the root of the mean power spectrum of its
    rows, scaled so that a white pattern of standard deviation s has the amplitude s at every frequency. Frequency 0 is
    left out."""
    length = image.shape[1]
    power = np.mean(np.abs(np.fft.rfft(image - image.mean(), axis=1)) ** 2, axis=0) / length
    return np.asarray(np.fft.rfftfreq(length)[1:], float), np.asarray(np.sqrt(power[1:]), float)


def _smoothed(values: FloatArray, most: int = MOST_POINTS) -> FloatArray:
    """At most `most` values: the largest of each run, as means would hide lines of a spectrum."""
    if values.size <= most:
        return values
    run = -(-values.size // most)
    padded = np.pad(values, (0, -values.size % run), mode="edge")
    return padded.reshape(-1, run).max(axis=1)


def _spectrogram(name: str, image: FloatArray, left: float, unit: str) -> EmvaPlot:
    data: list[Trace] = []
    whole = float(np.sqrt(max(image.var() - left, 0.0)))
    for text, turned, colour in (("rows (horizontal)", image, AFTER), ("columns (vertical)", image.T, BEFORE)):
        frequency, amplitude = spectrogram(turned)
        amplitude = _smoothed(amplitude)
        data.append(
            curve(text, floats(np.linspace(frequency[0], frequency[-1], amplitude.size)), floats(amplitude), colour)
        )
    for text, value, dash in (
        (f"{name}1288", whole, "solid"),
        ("residual temporal noise", float(np.sqrt(left)), "dot"),
    ):
        if value > 0:
            data.append(curve(text, [0.0, 0.5], [value, value], "@fg", dash))
    return EmvaPlot(
        f"Spectrograms of the {name}",
        {
            "data": data,
            "layout": layout(
                320,
                xaxis=axis("frequency, cycles/px", range=[0.0, 0.5]),
                yaxis=axis(f"rms amplitude, {unit}", type="log"),
                margin={"l": 56, "r": 14, "t": 46, "b": 44},
            ),
        },
        "A white pattern is flat at its standard deviation; peaks are periodic patterns, a rise towards low "
        "frequencies is shading.",
    )


def _histogram(name: str, image: FloatArray, left: float, unit: str, step: float = 0.0) -> EmvaPlot:
    """Logarithmic histogram with the normal distribution of the same standard deviation, and the cumulative histogram
    of absolute deviations. `step`: between possible values; a bin holds a whole number of them."""
    rest = (image - image.mean()).ravel()
    reach = 1.05 * float(np.abs(rest).max()) or 1.0
    width = 2.0 * reach / HISTOGRAM_BINS
    if step > 0:
        width = step * np.ceil(width / step)
    first = rest.min() - 0.5 * min(step, width) if step > 0 else -reach
    counts, edges = np.histogram(rest, first + width * np.arange(np.ceil((reach - first) / width) + 1))
    middle = (edges[:-1] + edges[1:]) / 2.0
    spread = float(rest.std()) or 1e-12  # all equal: one bin
    law = rest.size * (edges[1] - edges[0]) * np.exp(-0.5 * (middle / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
    moduli = np.sort(np.abs(rest))[::-1]
    steps = np.unique(np.geomspace(1, moduli.size, 160).astype(int)) - 1
    shown = counts > 0
    drawn = law > 0.3
    return EmvaPlot(
        f"Histograms of the {name}",
        {
            "data": [
                markers("pixels", floats(middle[shown]), floats(counts[shown].astype(float)), AFTER)
                | {"marker": {"size": 4, "color": AFTER}},
                curve("normal distribution, same standard deviation", floats(middle[drawn]), floats(law[drawn]), "@fg"),
                curve(
                    "share of pixels beyond",
                    floats(moduli[steps]),
                    floats(100.0 * (steps + 1.0) / moduli.size),
                    BEFORE,
                    xaxis="x2",
                    yaxis="y2",
                ),
            ],
            "layout": layout(
                320,
                xaxis=axis(f"deviation from the mean, {unit}", domain=[0.0, 0.47]),
                yaxis=axis("pixels", type="log", range=[-0.3, float(np.log10(max(counts.max(), 2))) + 0.3]),
                xaxis2=axis(f"absolute deviation, {unit}", domain=[0.58, 1.0], anchor="y2", rangemode="tozero"),
                yaxis2=axis("share of pixels, %", type="log", anchor="x2"),
                margin={"l": 56, "r": 14, "t": 46, "b": 44},
            ),
        },
        f"Mean image{', high-passed by 5 × 5 means' if name == 'PRNU' else ''}; residual temporal noise "
        f"{measured(float(np.sqrt(left)), None, unit)}. "
        "Defective pixels lie outside the normal distribution.",
    )


def _profiles(name: str, image: FloatArray, unit: str) -> EmvaPlot:
    """Profiles along rows and columns: middle line, mean, minimum and maximum."""
    data: list[Trace] = []
    for number, turned in enumerate((image, image.T)):
        on = {"xaxis": f"x{number + 1}" if number else "x", "yaxis": "y2" if number else "y", "showlegend": number == 0}
        curves: tuple[tuple[str, Callable[[FloatArray], FloatArray], str, str], ...] = (
            ("largest", lambda a: a.max(axis=0), "@muted", "dot"),
            ("smallest", lambda a: a.min(axis=0), "@muted", "dot"),
            ("middle", lambda a: a[len(a) // 2], BEFORE, "solid"),
            ("mean", lambda a: a.mean(axis=0), AFTER, "solid"),
        )
        for text, of, colour, dash in curves:
            values = of(turned)
            thin = -(-values.size // MOST_POINTS)
            data.append(curve(text, list(range(0, values.size, thin)), floats(values[::thin]), colour, dash, **on))
            data[-1]["line"]["width"] = 1.0 if text in ("middle", "largest", "smallest") else 1.8
    inside = np.percentile(image, [0.05, 99.95])
    margin = 0.6 * float(inside[1] - inside[0]) or 1.0
    span = [float(inside[0]) - margin, float(inside[1]) + margin]
    return EmvaPlot(
        f"Profiles of the {name}",
        {
            "data": data,
            "layout": layout(
                320,
                xaxis=axis("column", domain=[0.0, 0.47]),
                yaxis=axis(unit, range=span),
                xaxis2=axis("row", domain=[0.56, 1.0], anchor="y2"),
                yaxis2=axis("", range=span, anchor="x2"),
                margin={"l": 56, "r": 14, "t": 46, "b": 44},
            ),
        },
        "Left: horizontal profiles (over the columns), right: vertical ones. Single defects may lie outside the range "
        "shown.",
    )
