"""The EMVA 1288 data sheet: the standard's table, conditions and plots, from the fit's figures and the recordings'
spatial stacks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.fit.noise.pixel_maps import pixel_maps
from lab.formats.recording_set import RecordingSet
from lab.formats.results import ChannelNoise, Emva1288, Emva1288Points, FitResult, NoiseFit, PixelDefects
from lab.formats.results.words import format_value, plain_number
from lab.observables.darks.pixels import stack_of
from lab.observables.flats.stated_light import light_of
from lab.report.charts import AFTER, BEFORE, CHANNEL, Figure, Trace, axis, error_bars, layout, log_axis
from lab.report.figures import NOISE
from lab.report.pictures import MAPS, map_picture, photograph_data_uri
from sim.camera import Side
from sim.sensor.mosaic import planes
from sim.spectrum import FloatArray


@dataclass(frozen=True)
class EmvaPlot:
    """A figure with its title and caption."""

    title: str
    figure: Figure
    caption: str
    of_plane: bool = True  # of the sheet's plotted plane; else of all pixels


def markers(name: str, x: Sequence[float], y: Sequence[float], colour: str, **more: Any) -> Trace:
    """Return a trace of markers; `more`: further keys of the trace.

    >>> markers("darks", [0.0, 1.0], [64.0, 64.5], "#888888")["mode"]
    'markers'
    """
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": list(x),
        "y": list(y),
        "marker": {"color": colour, "size": 5},
    } | more


def curve(name: str, x: Sequence[float], y: Sequence[float], colour: str, dash: str = "solid", **more: Any) -> Trace:
    """Return a trace of lines; `more`: further keys of the trace.

    >>> curve("K", [0.0, 1.0], [0.0, 0.4], "#888888", "dot")["line"]["dash"]
    'dot'
    """
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": list(x),
        "y": list(y),
        "line": {"color": colour, "width": 1.6, "dash": dash},
    } | more


def values_along(data: Sequence[Trace], key: str) -> list[float]:
    """Return the coordinates of all traces along an axis, and the ends of their error bars.

    data : traces
    key : `x` or `y`

    >>> values_along([{"x": [1.0], "y": [5.0], "error_y": {"array": [0.5]}}], "y")
    [5.0, 4.5, 5.5]
    """
    values = [float(value) for trace in data for value in trace[key]]
    for trace in data:
        std = trace.get(f"error_{key}", {}).get("array", [])
        values += [value + sign * half for value, half in zip(trace[key], std, strict=False) for sign in (-1.0, 1.0)]
    return values


def floats(values: NDArray[np.floating[Any]]) -> list[float]:
    """Return an array (n,) as a list.

    >>> floats(np.array([1.0, 2.0]))
    [1.0, 2.0]
    """
    return [float(value) for value in values]


# The data sheet's spatial plots: spectrograms, histograms and profiles of DSNU and PRNU.


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


def spatial_plots(recordings: RecordingSet, side: Side, figures: Emva1288, plane: str) -> Iterator[EmvaPlot]:
    """Yield the spatial plots of one plane with its `figures`; none where its stacks aren't in the recordings."""
    images = _stacks(recordings, side, figures.points, plane)
    if images is None:
        return
    gain = figures.system_gain_dn_per_e
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
    """Return the image stacks that the spatial figures were computed from."""
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
    """Return frequencies (cycles/px) and rms amplitude along the rows of an image; frequency 0 is left out.

    image : (rows, cols)

    It is the root of the mean power spectrum of the rows, scaled so that a white pattern of standard deviation s has
    the amplitude s at every frequency, as in the spectrograms of EMVA 1288.

    >>> frequency, amplitude = spectrogram(np.random.default_rng(1).normal(0.0, 2.0, (500, 64)))
    >>> bool(abs(np.sqrt(np.mean(amplitude[:-1] ** 2)) - 2.0) < 3.0 * 2.0 / np.sqrt(2.0 * 500 * 64))
    True
    """
    length = image.shape[1]
    power = np.mean(np.abs(np.fft.rfft(image - image.mean(), axis=1)) ** 2, axis=0) / length
    return np.asarray(np.fft.rfftfreq(length)[1:], float), np.asarray(np.sqrt(power[1:]), float)


def _smooth(values: FloatArray, most: int = MOST_POINTS) -> FloatArray:
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
        amplitude = _smooth(amplitude)
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
                yaxis=log_axis(f"rms amplitude, {unit}", values_along(data, "y")),
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
                yaxis=log_axis("pixels", [1.0, *floats(counts.astype(float))]),
                xaxis2=axis(f"absolute deviation, {unit}", domain=[0.58, 1.0], anchor="y2", rangemode="tozero"),
                yaxis2=log_axis("share of pixels, %", [100.0 / moduli.size, 100.0], anchor="x2"),
                margin={"l": 56, "r": 14, "t": 46, "b": 44},
            ),
        },
        f"Mean image{', high-passed by 5 × 5 means' if name == 'PRNU' else ''}; residual temporal noise "
        f"{format_value(float(np.sqrt(left)), None, unit)}. "
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


# The data sheet's temporal plots: photon transfer, responsivity, SNR, linearity, dark current; and those of the joint
# fit.


BOLTZMANN_EV_PER_K, ZERO_C_K = 8.617333262e-5, 273.15


def _light_axis(points: Emva1288Points) -> str:
    return "irradiation, photons/pixel" if points.light_unit == "photons" else "exposure, s"


def temporal_plots(figures: Emva1288, plane: str) -> Iterator[EmvaPlot]:
    """Yield the temporal plots of one plane with its `figures`."""
    points, colour = figures.points, CHANNEL.get(plane, "#888888")
    signal = np.array(points.mean_dn) - np.array(points.dark_mean_dn)
    excess = np.array(points.variance_dn2) - np.array(points.dark_variance_dn2)
    light = np.array(points.light)
    saturation = figures.saturation_capacity_e
    top = saturation * figures.system_gain_dn_per_e if saturation is not None else float(signal.max())
    yield EmvaPlot(
        "Photon transfer",
        {
            "data": [
                markers(
                    "measured",
                    floats(signal),
                    floats(excess),
                    colour,
                    error_x=error_bars(points.signal_dn_std, colour),
                    error_y=error_bars(points.excess_variance_dn2_std, colour),
                ),
                curve(
                    f"K = {format_value(figures.system_gain_dn_per_e, figures.system_gain_dn_per_e_std, 'DN/e')}",
                    [0.0, 0.7 * top],
                    [0.0, 0.7 * top * figures.system_gain_dn_per_e],
                    "@fg",
                ),
                curve(
                    "",
                    [0.7 * top, top],
                    [k * top * figures.system_gain_dn_per_e for k in (0.7, 1.0)],
                    "@fg",
                    "dot",
                    showlegend=False,
                ),
            ],
            "layout": layout(
                310,
                xaxis=axis("μ<sub>y</sub> − μ<sub>y.dark</sub>, DN", rangemode="tozero"),
                yaxis=axis("σ²<sub>y</sub> − σ²<sub>y.dark</sub>, DN²", range=[0.0, 1.15 * float(excess.max())]),
            ),
        },
        "Temporal variance against mean, dark subtracted. Solid: the line through the origin, fitted to 70 % of "
        "saturation; dotted: beyond.",
    )
    if figures.responsivity_dn_per_photon is not None:
        slope = figures.responsivity_dn_per_photon
        reach = float(light[signal <= 1.02 * top].max())
        yield EmvaPlot(
            "Responsivity",
            {
                "data": [
                    markers(
                        "measured",
                        floats(light),
                        floats(signal),
                        colour,
                        error_y=error_bars(points.signal_dn_std, colour),
                    ),
                    curve(
                        f"R = {format_value(slope, figures.responsivity_dn_per_photon_std, 'DN/photon')}",
                        [0.0, reach],
                        [0.0, slope * reach],
                        "@fg",
                    ),
                ],
                "layout": layout(
                    310,
                    xaxis=axis("irradiation, photons/pixel", rangemode="tozero"),
                    yaxis=axis("μ<sub>y</sub> − μ<sub>y.dark</sub>, DN", rangemode="tozero"),
                ),
            },
            "Mean minus dark against photons, with the line through the origin, fitted to 70 % of saturation.",
        )
    yield _snr(figures, light, signal, colour)
    yield from _linearity(figures, light, signal, colour)
    yield from _dark_current(figures, colour)


def _snr(figures: Emva1288, light: FloatArray, signal: FloatArray, colour: str) -> EmvaPlot:
    """SNR against light: measured, of the linear model, with nonuniformity, and of an ideal sensor."""
    points, gain = figures.points, figures.system_gain_dn_per_e
    photons = figures.quantum_efficiency is not None
    efficiency = figures.quantum_efficiency if figures.quantum_efficiency is not None else 1.0
    x = light if photons else signal / gain
    # beyond saturation the noise vanishes, and SNR has no meaning
    seen = (signal > 0) & (np.array(points.variance_dn2) > 0)
    if figures.saturation_capacity_e is not None:
        seen &= (
            signal <= 1.001 * figures.saturation_capacity_e * gain
            if not photons
            else light <= (figures.saturation_capacity_photons or np.inf)
        )
    noise = np.sqrt(np.where(seen, points.variance_dn2, 1.0))
    snr, snr_std = signal[seen] / noise[seen], np.zeros(int(seen.sum()))
    if points.signal_dn_std:
        of_signal = np.array(points.signal_dn_std)[seen] / signal[seen]
        of_variance = np.array(points.excess_variance_dn2_std)[seen] / noise[seen] ** 2
        snr_std = snr * np.hypot(of_signal, 0.5 * of_variance)
    dark_e = figures.temporal_dark_noise_dn / gain if figures.temporal_dark_noise_dn is not None else 0.0
    first = figures.sensitivity_threshold_photons if photons else figures.sensitivity_threshold_e
    full = figures.saturation_capacity_photons if photons else figures.saturation_capacity_e
    low, high = first or 1.0, full or float(x.max())
    at = np.geomspace(max(0.7 * low, 1e-3), high, 60)
    electrons = efficiency * at
    model = electrons / np.sqrt(dark_e**2 + electrons)
    data = [
        markers("measured", floats(x[seen]), floats(snr), colour, error_y=error_bars(floats(snr_std), colour)),
        curve("linear model", floats(at), floats(model), "@fg"),
    ]
    if figures.dsnu_e is not None and figures.prnu_percent is not None:
        spatial = figures.dsnu_e**2 + (figures.prnu_percent / 100.0 * electrons) ** 2
        total = electrons / np.sqrt(dark_e**2 + electrons + spatial)
        data.append(curve("total, with nonuniformity", floats(at), floats(total), BEFORE))
    data.append(curve("ideal sensor", floats(at), floats(np.sqrt(at)), "@muted", "dash"))
    for value, text in ((first, "threshold"), (full, "saturation")):
        if value is not None:
            data.append(
                curve(text, [value, value], [1.0, float(np.sqrt(high))], AFTER, "dot", showlegend=text == "threshold")
            )
            data[-1]["name"] = "threshold and saturation"
    label = "irradiation, photons/pixel" if photons else "signal, e"
    return EmvaPlot(
        "Signal-to-noise ratio",
        {
            "data": data,
            "layout": layout(
                340,
                xaxis=log_axis(label, values_along(data, "x")),
                yaxis=log_axis("SNR", values_along(data, "y")),
                margin={"l": 56, "r": 14, "t": 46, "b": 44},
            ),
        },
        "Logarithmic on both axes. The ideal sensor has a quantum efficiency of 1 and shot noise alone."
        if photons
        else "Logarithmic on both axes. The ideal sensor has shot noise alone.",
    )


def _linearity(figures: Emva1288, light: FloatArray, signal: FloatArray, colour: str) -> Iterator[EmvaPlot]:
    points = figures.points
    at = [k for k, value in enumerate(points.linearity_deviation_percent) if value is not None]
    if not at or figures.linearity_error_percent is None:
        return
    deviation = [points.linearity_deviation_percent[k] for k in at]
    x = light[at]
    # The line's own values: signal = line (1 + deviation).
    line = signal[at] / (1.0 + np.array(deviation, float) / 100.0)
    deviation_std = (
        [100.0 * points.signal_dn_std[k] / own_line for k, own_line in zip(at, line, strict=True)]
        if (points.signal_dn_std)
        else []
    )
    yield EmvaPlot(
        "Linearity",
        {
            "data": [
                markers("measured", floats(light), floats(signal), colour, showlegend=False),
                curve("line, 5 to 95 % of saturation", floats(x), floats(line), "@fg"),
                markers(
                    "deviation",
                    floats(x),
                    [float(v or 0.0) for v in deviation],
                    colour,
                    mode="markers+lines",
                    yaxis="y2",
                    error_y=error_bars(deviation_std, colour),
                )
                | {"line": {"color": colour, "width": 1}, "showlegend": False},
            ],
            "layout": layout(
                340,
                xaxis=axis(_light_axis(points), rangemode="tozero", anchor="y2"),
                yaxis=axis("signal, DN", rangemode="tozero", domain=[0.45, 1.0]),
                yaxis2=axis("deviation, %", domain=[0.0, 0.34], zeroline=True),
            ),
        },
        f"Above: mean minus dark with the line that minimises relative deviations; below: the deviations. "
        f"LE {format_value(figures.linearity_error_percent, figures.linearity_error_percent_std, '%')} is their mean "
        "absolute value.",
    )


def _dark_current(figures: Emva1288, colour: str) -> Iterator[EmvaPlot]:
    points = figures.points
    if len(set(points.dark_exposure_s)) < 2:
        return
    yield EmvaPlot(
        "Dark signal against exposure",
        {
            "data": [
                markers(
                    "mean",
                    points.dark_exposure_s,
                    points.dark_exposure_mean_dn,
                    colour,
                    showlegend=False,
                    error_y=error_bars(points.dark_exposure_mean_dn_std, colour),
                ),
                markers(
                    "variance",
                    points.dark_exposure_s,
                    points.dark_exposure_variance_dn2,
                    BEFORE,
                    yaxis="y2",
                    showlegend=False,
                    error_y=error_bars(points.dark_exposure_variance_dn2_std, BEFORE),
                ),
            ],
            "layout": layout(
                310,
                xaxis=axis("exposure, s", anchor="y2", rangemode="tozero"),
                yaxis=axis("mean, DN", domain=[0.56, 1.0]),
                yaxis2=axis("variance, DN²", domain=[0.0, 0.44]),
            ),
        },
        "Above: mean of the darks; below: their temporal variance. Their slopes are the dark current, from means and "
        "from variances.",
    )


def joint_fit_plots(noise: NoiseFit) -> Iterator[EmvaPlot]:
    """Yield the plots of the joint fit: read noise of single pixels, dark current against temperature."""
    spread = noise.read_noise_distribution
    if spread is not None:
        edges = np.array(spread.noise_e)
        yield EmvaPlot(
            "Read noise of single pixels",
            {
                "data": [
                    {
                        "type": "bar",
                        "name": "pixels",
                        "x": floats((edges[:-1] + edges[1:]) / 2.0),
                        "y": list(spread.pixels),
                        "marker": {"color": AFTER},
                        "showlegend": False,
                    }
                ],
                "layout": layout(
                    310,
                    xaxis=axis("temporal dark noise, e"),
                    yaxis=log_axis("pixels", [0.7, *spread.pixels]),
                    bargap=0.05,
                ),
            },
            f"Over {spread.degrees_of_freedom} degrees of freedom a pixel; median {spread.median_e:.3g} e, 99 % below "
            f"{spread.percentile_99_e:.3g} e. The pixels' true variances differ by "
            f"{format_value(spread.spread_percent, spread.spread_percent_std, '%')}, sampling error subtracted; "
            f"{spread.noisy_pixels} noisy pixels.",
            of_plane=False,
        )
    law = noise.dark_current_temperature
    if law is None or len(law.temperature_c) < 2:
        return
    data = [
        markers(
            "measured",
            law.temperature_c,
            law.dark_current_e_per_s,
            AFTER,
            error_y={
                "type": "data",
                "array": list(law.dark_current_e_per_s_std),
                "color": AFTER,
                "thickness": 1,
                "width": 2,
            },
        )
    ]
    caption = "Dark current from means at each temperature, logarithmic."
    if law.activation_energy_ev is not None and law.reference_current_e_per_s is not None:
        at = np.linspace(min(law.temperature_c), max(law.temperature_c), 40)
        reference_k = (law.reference_temperature_c or 0.0) + ZERO_C_K
        exponent = law.activation_energy_ev / BOLTZMANN_EV_PER_K * (1.0 / reference_k - 1.0 / (at + ZERO_C_K))
        data.append(curve("Arrhenius", floats(at), floats(law.reference_current_e_per_s * np.exp(exponent)), "@fg"))
        caption += f" Activation energy {format_value(law.activation_energy_ev, law.activation_energy_ev_std, 'eV')}"
        if law.doubling_temperature_c is not None:
            caption += (
                f"; doubles every {format_value(law.doubling_temperature_c, law.doubling_temperature_c_std, 'K')}"
            )
        caption += "."
    yield EmvaPlot(
        "Dark current against temperature",
        {
            "data": data,
            "layout": layout(
                310, xaxis=axis("temperature, °C"), yaxis=log_axis("dark current, e/s", values_along(data, "y"))
            ),
        },
        caption,
        of_plane=False,
    )


MAP_WIDTH_PX = 300

#: Field of `Emva1288` -> (quantity, symbol, unit, factor on the value), in the order of the standard's summary sheet.
TABLE = {
    "quantum_efficiency": ("quantum efficiency", "η", "%", 100.0),
    "responsivity_dn_per_photon": ("responsivity", "R", "DN/photon", 1.0),
    "system_gain_dn_per_e": ("system gain", "K", "DN/e", 1.0),
    "temporal_dark_noise_e": ("temporal dark noise", "σ_d", "e", 1.0),
    "temporal_dark_noise_dn": ("temporal dark noise", "σ_y.dark", "DN", 1.0),
    "snr_max": ("largest signal-to-noise ratio", "SNR_max", "", 1.0),
    "sensitivity_threshold_photons": ("absolute sensitivity threshold", "μ_p.min", "photons", 1.0),
    "sensitivity_threshold_e": ("absolute sensitivity threshold", "μ_e.min", "e", 1.0),
    "saturation_capacity_photons": ("saturation capacity", "μ_p.sat", "photons", 1.0),
    "saturation_capacity_e": ("saturation capacity", "μ_e.sat", "e", 1.0),
    "dynamic_range": ("dynamic range", "DR", "", 1.0),
    "linearity_error_percent": ("linearity error", "LE", "%", 1.0),
    "dsnu_e": ("dark signal nonuniformity", "DSNU1288", "e", 1.0),
    "dsnu_row_e": ("of rows", "DSNU1288.row", "e", 1.0),
    "dsnu_column_e": ("of columns", "DSNU1288.col", "e", 1.0),
    "dsnu_pixel_e": ("of pixels", "DSNU1288.pixel", "e", 1.0),
    "prnu_percent": ("photo response nonuniformity", "PRNU1288", "%", 1.0),
    "prnu_row_percent": ("of rows", "PRNU1288.row", "%", 1.0),
    "prnu_column_percent": ("of columns", "PRNU1288.col", "%", 1.0),
    "prnu_pixel_percent": ("of pixels", "PRNU1288.pixel", "%", 1.0),
    "light_nonuniformity_percent": ("nonuniformity of the light, highest less lowest", "ΔE", "%", 1.0),
    "shading_percent": ("low-frequency part of the PRNU (shading)", "", "%", 1.0),
    "row_gain_percent": ("PRNU of rows, shading removed", "", "%", 1.0),
    "column_gain_percent": ("PRNU of columns, shading removed", "", "%", 1.0),
    "dark_current_from_mean_e_per_s": ("dark current, from means", "μ_I.mean", "e/s", 1.0),
    "dark_current_from_variance_e_per_s": ("dark current, from variances", "μ_I.var", "e/s", 1.0),
}
#: Ratios that the sheet gives in decibels, too.
DECIBELS = ("snr_max", "dynamic_range")


@dataclass(frozen=True)
class EmvaRow:
    """One line of the table: a value a plane, as text."""

    quantity: str
    symbol: str
    values: tuple[str, ...]


@dataclass(frozen=True)
class EmvaSheet:
    """One camera's data sheet; the plots are of one plane."""

    side: Side
    planes: tuple[str, ...]
    plotted: str
    conditions: tuple[str, ...]
    rows: tuple[EmvaRow, ...]
    plots: tuple[EmvaPlot, ...]
    remarks: tuple[str, ...]
    #: Beyond the standard: the joint fit's figures by channel, and maps of single pixels as (title, picture, caption).
    channels: tuple[str, ...]
    channel_rows: tuple[EmvaRow, ...]
    maps: tuple[tuple[str, str, str], ...]
    defects: str


def data_sheets(recordings: RecordingSet, fit: FitResult) -> Iterator[EmvaSheet]:
    """Yield a sheet for each camera whose flats and darks gave EMVA 1288 figures. Reads the frames of the spatial
    stacks."""
    for side, camera in fit.cameras.items():
        noise = camera.noise
        if noise is None or not noise.emva1288:
            continue
        figures_of_plane = noise.emva1288
        names = tuple(figures_of_plane)
        plotted = next(name for name in ("Y", "G1", *names) if name in figures_of_plane)
        plotted_figures = figures_of_plane[plotted]
        remarks = [(name, remark) for name, plane in figures_of_plane.items() for remark in plane.remarks]
        grouped: dict[str, list[str]] = {}
        for name, remark in remarks:
            grouped.setdefault(remark, []).append(name)
        yield EmvaSheet(
            side=side,
            planes=names,
            plotted=plotted,
            conditions=tuple(_conditions(recordings, side, plotted_figures)),
            rows=tuple(table_rows(figures_of_plane)),
            plots=(
                *temporal_plots(plotted_figures, plotted),
                *spatial_plots(recordings, side, plotted_figures, plotted),
                *joint_fit_plots(noise),
            ),
            remarks=(
                *(
                    remark if len(which) == len(names) else f"{', '.join(which)}: {remark}"
                    for remark, which in grouped.items()
                ),
                *compare_estimates(noise),
            ),
            channels=tuple(noise.channels) if len(noise.channels) > 1 else (),
            channel_rows=tuple(_channel_rows(noise)),
            maps=tuple(_maps(recordings, side)),
            defects=_defect_sentence(noise.defects),
        )


#: Field of `Emva1288` -> (field of the joint fit, why the two may differ).
BOTH_ESTIMATES = {
    "system_gain_dn_per_e": (
        "conversion_gain_dn_per_e",
        (
            "with nonlinearity or a brighter-fatter effect, the standard's line to 70 % of saturation has another "
            "slope than the curve has at zero signal"
        ),
    ),
    "quantum_efficiency": ("quantum_efficiency", "each is the responsivity over its own K"),
    "temporal_dark_noise_e": ("read_noise_e", "each has its own K; the joint fit has the defective pixels left out"),
    "saturation_capacity_e": (
        "full_well_e",
        "the standard takes the level of the largest variance, the joint fit the highest code reached",
    ),
    "dark_current_from_mean_e_per_s": ("dark_current_e_per_s", "each has its own K and set of pixels"),
    "linearity_error_percent": ("linearity_error_percent", "each has its own levels and weights"),
    "dsnu_e": ("dsnu_e", "the standard counts defective pixels"),
    "prnu_percent": ("prnu_percent", "the standard counts shading and defective pixels"),
}
#: Combined standard deviations from which on a difference of two estimates is worth a line of its own.
APART_SIGMA = 2.0


def compare_estimates(noise: NoiseFit) -> Iterator[str]:
    """Yield by how much the standard's figures and the joint fit's differ, in per cent and in combined standard
    deviations (which are too large where both use the same noise), and why they may: the system gain always, the
    others where they are apart."""
    for plane, figures in noise.emva1288.items():
        joint = noise.channels.get(plane[0], noise)
        for field, (field_of_fit, why) in BOTH_ESTIMATES.items():
            scale = 10.0 ** ((noise.gain_db or 0.0) / 20.0) if field_of_fit == "conversion_gain_dn_per_e" else 1.0
            first, first_std = getattr(figures, field), getattr(figures, f"{field}_std")
            source = joint if field_of_fit in type(joint).model_fields else noise
            second, second_std = getattr(source, field_of_fit), getattr(source, f"{field_of_fit}_std")
            if not first or not second or not first_std or not second_std:
                continue
            second, second_std = scale * second, scale * second_std
            sigma = abs(first - second) / float(np.hypot(first_std, second_std))
            if sigma < APART_SIGMA and field != "system_gain_dn_per_e":
                continue
            name, unit = NOISE[field_of_fit]
            yield (
                f"two estimates of the {name} ({plane}): EMVA 1288 {format_value(first, first_std, unit)}, joint fit "
                f"{format_value(second, second_std, unit)}, {_percent(first / second - 1.0)} % or {sigma:.1f} combined "
                f"standard deviations apart: {why}"
            )
        mean, variance = figures.dark_current_from_mean_e_per_s, figures.dark_current_from_variance_e_per_s
        stds = figures.dark_current_from_mean_e_per_s_std, figures.dark_current_from_variance_e_per_s_std
        if mean is not None and variance is not None and stds[0] is not None and stds[1] is not None:
            sigma = abs(mean - variance) / float(np.hypot(stds[0], stds[1]))
            if sigma >= APART_SIGMA:
                yield (
                    f"two estimates of the dark current ({plane}): from means {format_value(mean, stds[0], 'e/s')}, "
                    f"from variances {format_value(variance, stds[1], 'e/s')}, {sigma:.1f} combined standard "
                    "deviations apart: "
                    "a black level that follows the exposure moves the means alone, excess noise the variances alone"
                )


def _percent(share: float) -> str:
    """Return a signed share in per cent, to two digits and without a power of ten."""
    return f"{'-' if share < 0 else '+'}{plain_number(abs(100.0 * share), 2)}"


def table_rows(figures_of_plane: dict[str, Emva1288]) -> Iterator[EmvaRow]:
    """Yield the quantities that at least one plane has, with standard deviations."""
    for field, (quantity, symbol, unit, factor) in TABLE.items():
        texts = []
        for plane in figures_of_plane.values():
            value, std = getattr(plane, field), getattr(plane, f"{field}_std")
            if value is None:
                limit = plane.temporal_dark_noise_limit_e if field == "temporal_dark_noise_e" else None
                texts.append("–" if limit is None else f"below {limit:.3g} e")
                continue
            text = format_value(factor * value, None if std is None else factor * std, unit)
            if field in DECIBELS and value > 0:
                text += f" ({20.0 * np.log10(value):.1f} dB, {np.log2(value):.1f} bit)"
            systematic = getattr(plane, f"{field}_systematic_std", None)
            if systematic is not None:
                text += f" (± {factor * systematic:.2g} {unit} by the photodiode's calibration)"
            texts.append(text)
        if any(text != "–" for text in texts):
            yield EmvaRow(quantity, symbol, tuple(texts))


def _channel_rows(noise: NoiseFit) -> Iterator[EmvaRow]:
    """Yield the joint fit's quantities by colour."""
    for field, (name, unit) in NOISE.items():
        if field not in ChannelNoise.model_fields:
            continue
        values = [getattr(channel, field) for channel in noise.channels.values()]
        stds = [getattr(channel, f"{field}_std") for channel in noise.channels.values()]
        if any(value is not None for value in values):
            texts = ("–" if v is None else format_value(v, std, unit) for v, std in zip(values, stds, strict=True))
            yield EmvaRow(name, "", tuple(texts))


def _defect_sentence(defects: PixelDefects | None) -> str:
    if defects is None:
        return ""
    strongest = "; ".join(
        f"row {defect.row}, column {defect.col}: {defect.dark_dn:+.3g} DN"
        + (f", {defect.dark_current_e_per_s:.3g} e/s" if defect.dark_current_e_per_s is not None else "")
        for defect in defects.listed[:8]
    )
    return (
        f"{defects.hot} pixels are hot and {defects.cold} cold in the longest dark ({defects.exposure_s:.4g} s), by "
        "more than 8 standard "
        f"deviations of their plane. The strongest: {strongest}."
    )


def _conditions(recordings: RecordingSet, side: Side, figures: Emva1288) -> Iterator[str]:
    camera, points = recordings.camera(side), figures.points
    yield f"{camera.cols} × {camera.rows} pixels, {camera.bit_depth} bit, mosaic {camera.cfa}"
    if camera.pixel_pitch_um is not None:
        yield f"pixel pitch {camera.pixel_pitch_um:g} µm"
    if figures.wavelength_nm is not None:
        yield f"light of {figures.wavelength_nm:g} nm"
    elif points.light_unit == "photons":
        yield "wavelength of the light not stated"
    else:
        yield "photons not stated: no responsivity, no quantum efficiency; light is counted in exposure"
    yield f"{len(points.light)} bright and {len(points.dark_exposure_s)} dark exposures"
    if points.stack_images is not None and points.stack_exposure_s is not None:
        yield (
            f"spatial stacks of {points.stack_images} bright images ({1e3 * points.stack_exposure_s:.4g} ms) and "
            f"{points.stack_dark_images} dark ones"
        )


def _maps(recordings: RecordingSet, side: Side) -> Iterator[tuple[str, str, str]]:
    """Offset, dark current and gain of every pixel as pictures."""
    try:
        maps = pixel_maps(recordings, side)
    except NotDetermined:
        return
    for name, (title, unit) in MAPS.items():
        values = getattr(maps, name)
        if values is None:
            continue
        picture, low, high = map_picture(values, MAP_WIDTH_PX)
        yield title, photograph_data_uri(picture), f"from {low:.4g} (dark) to {high:.4g} (bright) {unit}"
