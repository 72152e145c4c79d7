"""The report's charts as Plotly figures. Colours that differ between the light and the dark page are named "@fg",
"@muted" and "@grid" and are replaced by the page's script. Uncertainty is drawn wherever the results state one."""

from __future__ import annotations

import base64
import gzip
import json
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lab.formats.recording_set import RecordingSet
from lab.formats.results import (
    Check,
    CurveComparison,
    DiagnosisResult,
    MtfCurve,
    NoiseFit,
    PatchComparison,
    PhotonTransfer,
    RepeatDrift,
    ResidualCurve,
    SpectralFit,
)
from lab.formats.results.words import format_value, plain_number
from lab.observables.observable import measurement_title
from lab.predict.validate import SensitivityCurve
from sim.camera import Side
from sim.spectrum import Spectrum

Figure = dict[str, Any]
Trace = dict[str, Any]
#: Distinguishable with all common kinds of colour vision, and legible on white and on near-black.
CHANNEL = {"R": "#d1495b", "G": "#2a9d57", "B": "#3d7be0", "Y": "#8a63d2", "G1": "#2a9d57", "G2": "#7fb800"}
BEFORE, AFTER = "#e08a1e", "#1f9aa5"
BASELINE = "baseline"
#: Range of a residual's axis, standard deviations; what lies beyond is marked at its edge.
RESIDUAL_SIGMA = 5.0
#: Share of the abscissa that a strip takes at least to have a label.
LABELLED_SHARE = 0.1
FADED = 0.22  # opacity of an uncertainty band
#: Decades up to which a logarithmic axis has ticks at 1, 2 and 5, and its margin, a share of its length.
FEW_DECADES, LOG_MARGIN = 2.5, 0.04


def _fade(colour: str, opacity: float = FADED) -> str:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity})"


def axis(title: str, **more: Any) -> dict[str, Any]:
    """Return a labelled axis in the report's style; `more`: further keys of Plotly's axis.

    >>> axis("signal, DN", rangemode="tozero")["title"]["text"]
    'signal, DN'
    """
    return {
        "title": {"text": title, "standoff": 6},
        "gridcolor": "@grid",
        "zerolinecolor": "@grid",
        "linecolor": "@muted",
        "ticks": "outside",
        "ticklen": 4,
        "tickcolor": "@muted",
        "automargin": True,
        "exponentformat": "none",  # 0.0005, not "500µ"
    } | more


def log_axis(title: str, values: Iterable[float], **more: Any) -> dict[str, Any]:
    """Return a logarithmic axis that holds `values`; those of 0 or below have no place on it.

    Its ticks are whole numbers: 1, 2, 5, 10, 20, ... within `FEW_DECADES`, powers of ten beyond.

    >>> log_axis("exposure, s", [0.01, 0.1])["ticktext"]
    ['0.01', '0.02', '0.05', '0.1']
    """
    exponents = [math.log10(value) for value in values if value is not None and 0.0 < value < math.inf]
    low, high = (min(exponents), max(exponents)) if exponents else (0.0, 1.0)
    margin = max(LOG_MARGIN * (high - low), 0.05)
    low, high = low - margin, high + margin
    steps = (1, 2, 5) if high - low <= FEW_DECADES else (1,)
    ticks = [step * 10.0**power for power in range(math.floor(low), math.ceil(high) + 1) for step in steps]
    shown = [tick for tick in ticks if low <= math.log10(tick) <= high]
    return axis(
        title,
        type="log",
        range=[low, high],
        tickvals=shown,
        ticktext=[f"{tick:g}" if 1e-4 <= tick < 1e6 else f"10<sup>{math.log10(tick):.0f}</sup>" for tick in shown],
        **more,
    )


def layout(height: int, **more: Any) -> dict[str, Any]:
    """Return a figure's layout in the report's style.

    height : px
    more : further keys of Plotly's layout

    >>> layout(300)["height"]
    300
    """
    return {
        "height": height,
        "margin": {"l": 56, "r": 14, "t": 26, "b": 44},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": "@fg"},
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0, "font": {"size": 11}},
        "hovermode": "closest",
    } | more


def error_bars(std: Sequence[float | None], colour: str) -> dict[str, Any]:
    """Return error bars of one standard deviation to each side, in a colour.

    std : one for each point; None: none

    >>> error_bars([0.5, None], "#d1495b")["array"]
    [0.5, None]
    """
    return {"type": "data", "array": list(std), "color": colour, "thickness": 1, "width": 2}


def band(
    x: Sequence[float], centre: np.ndarray[Any, Any], half: np.ndarray[Any, Any], colour: str, **more: Any
) -> Trace:
    """Return a filled band centre +- half.

    x : (n,)
    centre, half : (n,), in one unit
    more : further keys of the trace

    >>> band([1.0, 2.0], np.array([5.0, 6.0]), np.array([0.5, 0.5]), "#d1495b")["y"]
    [5.5, 6.5, 5.5, 4.5]
    """
    return {
        "type": "scatter",
        "x": [*x, *reversed(list(x))],
        "y": [*(centre + half).tolist(), *reversed((centre - half).tolist())],
        "fill": "toself",
        "fillcolor": _fade(colour),
        "line": {"width": 0},
        "hoverinfo": "skip",
        "showlegend": False,
    } | more


def photon_transfer(noise: NoiseFit) -> Figure | None:
    """Draw temporal variance against signal, with the line of the fitted conversion gain.

    noise : the fit of one camera

    Returns None where it has no points.

    >>> from lab.formats.results import NoiseFit
    >>> photon_transfer(NoiseFit()) is None
    True
    """
    if noise.photon_transfer is None:
        return None
    return photon_transfer_points(
        noise.photon_transfer, noise.conversion_gain_dn_per_e, noise.conversion_gain_dn_per_e_std
    )


def photon_transfer_points(points: PhotonTransfer, gain: float | None = None, gain_std: float | None = None) -> Figure:
    """Draw temporal variance against signal, with the line of a conversion gain where it is given.

    points : of the photon transfer
    gain, gain_std : DN/e

    >>> from lab.formats.results.fit import PhotonTransfer
    >>> level = PhotonTransfer(channel=("G",), exposure_s=(0.01,), signal_dn=(100.0,), signal_dn_std=(0.1,),
    ...     variance_dn2=(50.0,), variance_dn2_std=(0.5,), used=(True,), linearity_residual_percent=(None,))
    >>> [trace["name"] for trace in photon_transfer_points(level, 0.5)["data"] if "slope" in trace.get("name", "")]
    ['slope 0.5 DN/e']
    """
    data: list[Trace] = []
    for channel in dict.fromkeys(points.channel):
        for used in (True, False):
            at = [k for k, name in enumerate(points.channel) if name == channel and points.used[k] is used]
            if not at:
                continue
            colour = CHANNEL.get(channel, "#888888")
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": channel if used else f"{channel}, not used",
                    "x": [points.signal_dn[k] for k in at],
                    "y": [points.variance_dn2[k] for k in at],
                    "error_x": error_bars([points.signal_dn_std[k] for k in at], colour),
                    "error_y": error_bars([points.variance_dn2_std[k] for k in at], colour),
                    "marker": {"color": colour, "size": 6, "symbol": "circle" if used else "circle-open"},
                }
            )
    top = max(points.signal_dn)
    if gain is not None:
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": f"slope {format_value(gain, gain_std, 'DN/e')}",
                "x": [0.0, top],
                "y": [0.0, gain * top],
                "line": {"color": "@fg", "width": 1.5, "dash": "dash"},
            }
        )
    highest = 1.15 * max(points.variance_dn2)
    return {
        "data": data,
        "layout": layout(
            330,
            xaxis=axis("signal above dark, DN", rangemode="tozero"),
            yaxis=axis("temporal variance above dark, DN²", range=[-0.02 * highest, highest]),
        ),
    }


def repeat_drift(drift: RepeatDrift) -> Figure:
    """Draw the means of repeats over time, with the fitted curve where it changes and its standard uncertainty, DN; of
    several settings in common, departures from each setting's mean.
    """
    curve, half = np.array(drift.curve_dn), np.array(drift.curve_dn_std)
    abscissa = "elapsed time, s" if drift.elapsed_s is not None else "number of the repeat"
    x = list(drift.elapsed_s) if drift.elapsed_s is not None else [float(k + 1) for k in range(len(curve))]
    points: Trace = {
        "type": "scatter",
        "mode": "markers",
        "name": "mean of a frame" if drift.is_of_one_setting else "mean departure of a repeat",
        "x": x,
        "y": list(drift.mean_dn),
        "error_y": error_bars([drift.scatter_dn] * len(x) if drift.is_of_one_setting else half.tolist(), BEFORE),
        "marker": {"color": BEFORE, "size": 6},
    }
    data = [points]
    if drift.is_of_one_setting:
        at = [k for k, name in enumerate(drift.captures) if name in drift.changing]
        along = [x[k] for k in at]
        line: Trace = {
            "type": "scatter",
            "mode": "lines",
            "name": drift.shape.replace("_", "-"),
            "x": along,
            "y": curve[at].tolist(),
            "line": {"color": AFTER, "width": 2},
        }
        data = [band(along, curve[at], half[at], AFTER), line, points]
    title = "mean, DN" if drift.is_of_one_setting else "departure, DN"
    return {"data": data, "layout": layout(260, xaxis=axis(abscissa), yaxis=axis(title))}


def linearity(noise: NoiseFit) -> Figure | None:
    """Draw the deviation from the straight line of the response, per cent of the line.

    noise : the fit of one camera

    Returns None where it has no points.

    >>> from lab.formats.results import NoiseFit
    >>> linearity(NoiseFit()) is None
    True
    """
    points = noise.photon_transfer
    if points is None:
        return None
    data: list[Trace] = []
    for channel in dict.fromkeys(points.channel):
        at = [
            k
            for k, name in enumerate(points.channel)
            if name == channel and points.linearity_residual_percent[k] is not None
        ]
        if at:
            colour = CHANNEL.get(channel, "#888888")
            data.append(
                {
                    "type": "scatter",
                    "mode": "markers+lines",
                    "name": channel,
                    "x": [points.signal_dn[k] for k in at],
                    "y": [points.linearity_residual_percent[k] for k in at],
                    "error_y": error_bars(
                        [100 * points.signal_dn_std[k] / max(abs(points.signal_dn[k]), 1e-9) for k in at], colour
                    ),
                    "marker": {"color": colour, "size": 5},
                    "line": {"color": colour, "width": 1},
                }
            )
    if not data:
        return None
    return {
        "data": data,
        "layout": layout(
            220,
            xaxis=axis("signal above dark, DN", rangemode="tozero"),
            yaxis=axis("deviation from the line, %", zeroline=True),
        ),
    }


def _departures(spectral: SpectralFit) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Shapes and annotations for the wavelength bands in which a curve differs from the maker's: a strip along the top
    for each channel, labelled with the difference in per cent."""
    shapes: list[dict[str, Any]] = []
    notes: list[dict[str, Any]] = []
    channels = list(spectral.quantum_efficiency)
    for departure in spectral.maker_departures:
        colour = CHANNEL.get(departure.channel, "#888888")
        half = 0.5 * float(np.median(np.diff(spectral.wavelength_nm)))
        bottom = 0.95 - 0.055 * channels.index(departure.channel)
        at = {"x0": departure.from_nm - half, "x1": departure.to_nm + half}
        look = {"type": "rect", "fillcolor": _fade(colour), "line": {"width": 0}, "layer": "below"}
        shapes.append(look | at | {"yref": "paper", "y0": bottom, "y1": bottom + 0.05})
        shapes.append(look | at | {"yref": "paper", "y0": 0.0, "y1": bottom, "fillcolor": _fade(colour, 0.07)})
        size = "new" if departure.difference_percent is None else f"{departure.difference_percent:+.1f} %"
        if departure.to_nm - departure.from_nm + 2 * half < LABELLED_SHARE * (
            spectral.wavelength_nm[-1] - spectral.wavelength_nm[0]
        ):
            continue  # no room for its label
        notes.append(
            {
                "x": 0.5 * (departure.from_nm + departure.to_nm),
                "y": bottom + 0.025,
                "yref": "paper",
                "yanchor": "middle",
                "text": size,
                "showarrow": False,
                "font": {"size": 10, "color": colour},
                "hovertext": f"{departure.channel}, {departure.from_nm:g} to {departure.to_nm:g} nm: {size}, "
                f"{departure.significance_sigma:.1f} sigma",
            }
        )
    return shapes, notes


def quantum_efficiency(
    spectral: SpectralFit,
    recordings: RecordingSet | None = None,
    side: Side = "left",
    models: Mapping[str, SensitivityCurve] | None = None,
) -> Figure:
    """Return the quantum efficiency with its band (standard deviation times the fit's coverage factor) and the
    wavelength bands in which it differs from the maker's.

    `models`: curves of the baseline and the improved model by channel, drawn beside it. Without them, the maker's curve
    that the recordings state, scaled by the fitted factor where there is one.
    """
    data: list[Trace] = []
    scale = spectral.maker_scale or 1.0
    for channel, values in spectral.quantum_efficiency.items():
        colour = CHANNEL.get(channel, "#888888")
        std = spectral.quantum_efficiency_std.get(channel)
        if std:
            half = spectral.coverage_factor * np.asarray(std)
            data.append(band(spectral.wavelength_nm, np.asarray(values), half, colour))
        data.append(
            {
                "type": "scatter",
                "mode": "markers" if models else "lines+markers",
                "name": f"{channel} measured" if models else channel,
                "x": list(spectral.wavelength_nm),
                "y": list(values),
                "line": {"color": colour, "width": 2},
                "marker": {"color": colour, "size": 4},
            }
        )
    for number, (channel, curve) in enumerate((models or {}).items()):
        colour = CHANNEL.get(channel, "#888888")
        pairs = [(BASELINE, curve.baseline, "dash", 1.3), ("improved model", curve.improved, "solid", 1.8)]
        for name, drawn, dash, width in pairs if curve.improved != curve.baseline else pairs[:1]:
            line = {"color": colour, "width": width, "dash": dash}
            if number == 0:
                data.append(_legend(name, mode="lines", line=line | {"color": "@fg"}))
            data.append(
                {"type": "scatter", "mode": "lines", "x": list(curve.wavelength_nm), "y": list(drawn), "line": line}
                | {"showlegend": False, "name": f"{channel}, {name}"}
            )
    stated: dict[str, Spectrum] = {}
    if recordings is not None and not models:
        files = recordings.camera(side).quantum_efficiency or {}
        stated = {channel: recordings.spectrum(path) for channel, path in files.items()}
    for channel, maker in stated.items():
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": f"{channel}, maker" + (f" x {scale:.3f}" if spectral.maker_scale else ""),
                "x": list(maker.wavelength_nm),
                "y": [scale * value for value in maker.value],
                "line": {"color": CHANNEL.get(channel, "#888888"), "width": 1.2, "dash": "dot"},
            }
        )
    span = [min(spectral.wavelength_nm) - 10, max(spectral.wavelength_nm) + 10]
    shapes, notes = _departures(spectral)
    # Room above the curves for the strips, where there are any.
    highest = max(max(values) for values in spectral.quantum_efficiency.values())
    highest = max(
        [highest, *(max(*sensitivity.baseline, *sensitivity.improved) for sensitivity in (models or {}).values())]
    )
    top = 1.05 * highest / (0.8 if shapes else 1.0)
    return {
        "data": data,
        "layout": layout(
            340,
            xaxis=axis("wavelength, nm", range=span),
            yaxis=axis("quantum efficiency, e/photon", range=[0.0, top])
            if shapes
            else axis("quantum efficiency, e/photon", rangemode="tozero"),
            shapes=shapes,
            annotations=notes,
        ),
    }


def _panel_title(number: int, text: str) -> dict[str, Any]:
    suffix = "" if number == 0 else str(number + 1)
    return {
        "text": text,
        "xref": f"x{suffix} domain",
        "yref": f"y{suffix} domain",
        "x": 0,
        "y": 1.02,
        "xanchor": "left",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 10, "color": "@fg"},
    }


@dataclass(frozen=True)
class Overlay:
    """One channel's measured curve and its predictions: the baseline's and, where effects were named, the improved
    model's."""

    channel: str
    x: Sequence[float]
    measured: Sequence[float]
    measured_std: Sequence[float]
    baseline: Sequence[float]
    explained: Sequence[float] | None = None


def overlay_validated(checks: Sequence[tuple[Check, Check | None]]) -> dict[str, list[Overlay]]:
    """Return the curves of checks, by panel title: one panel for each check by a first model and, where there is one,
    by the improved model.

    checks : (by the first model, by the improved model) of each

    >>> overlay_validated([])
    {}
    """
    panels: dict[str, list[Overlay]] = {}
    for check, improved in checks:
        mended = {curve.channel: curve.predicted for curve in improved.curves} if improved is not None else {}
        for curve in check.curves:
            panels.setdefault(check.curves[0].label.replace(f"-{check.side}", ""), []).append(
                Overlay(
                    curve.channel,
                    curve.x,
                    curve.measured,
                    curve.measured_std,
                    curve.predicted,
                    mended.get(curve.channel),
                )
            )
    return panels


def overlay_explained(curves: Sequence[ResidualCurve], measurement: str = "slanted_edge") -> dict[str, list[Overlay]]:
    """Return the curves of one measurement from the diagnosis, by panel title; where a curve exists twice, the held-out
    one.
    """
    chosen: dict[tuple[str, str], ResidualCurve] = {}
    for curve in curves:
        key = (curve.label, curve.channel)
        if curve.measurement == measurement and (key not in chosen or curve.held_out):
            chosen[key] = curve
    panels: dict[str, list[Overlay]] = {}
    for (label, channel), curve in chosen.items():
        title = f"{label}{', held out' if curve.held_out else ''}"
        panels.setdefault(title, []).append(
            Overlay(channel, curve.x, curve.measured, curve.measured_std, curve.before, curve.after)
        )
    return panels


def _legend(name: str, **look: Any) -> Trace:
    """Return a legend entry without data."""
    return {"type": "scatter", "name": name, "x": [None], "y": [None], "hoverinfo": "skip"} | look


def transfer_overlays(
    panels: Mapping[str, Sequence[Overlay]], columns: int = 3, model: str = "baseline"
) -> Figure | None:
    """Draw measured MTF (points), the baseline's prediction (dashed), and the improved model's (solid) where effects
    were named.
    """
    if not panels:
        return None
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    height = 60 + rows * 190
    panes: dict[str, Any] = {
        "grid": {
            "rows": rows,
            "columns": columns,
            "pattern": "independent",
            "xgap": 0.16,
            "ygap": 0.3 if rows < 4 else 0.34,
        }
    }
    data: list[Trace] = []
    titles = []
    everything = [overlay for overlays in panels.values() for overlay in overlays]
    for channel in dict.fromkeys(overlay.channel for overlay in everything):
        data.append(_legend(f"{channel} measured", mode="markers", marker={"color": CHANNEL.get(channel, "#888888")}))
    data.append(_legend(model, mode="lines", line={"color": "@fg", "width": 1.3, "dash": "dash"}))
    if any(overlay.explained is not None for overlay in everything):
        data.append(_legend("improved model", mode="lines", line={"color": "@fg", "width": 1.8}))

    def add(overlay: Overlay, y: Sequence[float], on: dict[str, str], **trace: Any) -> None:
        data.append({"type": "scatter", "x": list(overlay.x), "y": list(y), "showlegend": False} | on | trace)

    for number, (title, overlays) in enumerate(panels.items()):
        suffix = str(number + 1) if number else ""
        on = {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}"}
        titles.append(_panel_title(number, title))
        for overlay in overlays:
            colour = CHANNEL.get(overlay.channel, "#888888")
            data.append(band(overlay.x, np.asarray(overlay.measured), np.asarray(overlay.measured_std), colour, **on))
            add(overlay, overlay.measured, on, mode="markers", marker={"color": colour, "size": 4})
            dashed = {"color": colour, "width": 1.3, "dash": "dash"}
            add(overlay, overlay.baseline, on, mode="lines", line=dashed)
            if overlay.explained is not None:
                add(overlay, overlay.explained, on, mode="lines", line={"color": colour, "width": 1.8})
        panes |= {
            f"xaxis{suffix}": axis("cy/px" if number >= len(panels) - columns else ""),
            f"yaxis{suffix}": axis("MTF" if number % columns == 0 else "", range=[-0.02, 1.08]),
        }
    legend = {"orientation": "h", "y": 1 + 26 / height, "yanchor": "bottom", "x": 0, "font": {"size": 11}}
    margin = {"l": 56, "r": 14, "t": 56, "b": 44}
    return {
        "data": data,
        "layout": layout(height, annotations=titles, **panes) | {"legend": legend, "margin": margin},
    }


def mtf_curves(curves: Sequence[MtfCurve]) -> Figure:
    """Return modulation transfer functions with bands of one standard deviation, spatial frequency in cy/px.

    curves : of the slanted edges

    >>> from lab.formats.results import MtfCurve
    >>> edge = MtfCurve(capture="edge-1", channel="G", angle_deg=5.0, frequency_cy_per_px=(0.0, 0.5), mtf=(1.0, 0.2),
    ...     mtf_std=(0.0, 0.01), mtf50_cy_per_px=0.31)
    >>> len(mtf_curves([edge])["data"]) > 0
    True
    """
    data: list[Trace] = []
    for curve in curves:
        colour = CHANNEL.get(curve.channel, "#888888")
        data.append(band(curve.frequency_cy_per_px, np.asarray(curve.mtf), np.asarray(curve.mtf_std), colour))
        line = {"color": colour, "width": 1.8}
        data.append(
            {"type": "scatter", "mode": "lines", "name": f"{curve.channel}, {curve.capture}", "line": line}
            | {"x": list(curve.frequency_cy_per_px), "y": list(curve.mtf)}
        )
    highest = max(max(curve.mtf) for curve in curves)
    return {
        "data": data,
        "layout": layout(
            300,
            xaxis=axis("spatial frequency, cy/px", rangemode="tozero"),
            yaxis=axis("MTF", range=[-0.02, max(1.05, 1.05 * highest)]),
        ),
    }


def draw_predicted_curves(curves: Sequence[CurveComparison]) -> Figure:
    """Draw measured curves (points with one standard deviation) and their predictions (lines) on one axis.

    >>> from lab.formats.results.validation import CurveComparison
    >>> curve = CurveComparison(label="edge-1", channel="G", axis="spatial frequency, cy/px", x=(0.0, 0.5),
    ...     predicted=(1.0, 0.2), measured=(1.0, 0.21), measured_std=(0.01, 0.01))
    >>> draw_predicted_curves([curve])["layout"]["xaxis"]["title"]["text"]
    'spatial frequency, cy/px'
    """
    data: list[Trace] = []
    for curve in curves:
        colour = CHANNEL.get(curve.channel, "#888888")
        at = {"type": "scatter", "x": list(curve.x)}
        line = {"color": colour, "width": 1.8, "dash": "dash"}
        data.append(
            at | {"mode": "lines", "name": f"{curve.channel} predicted", "y": list(curve.predicted)} | {"line": line}
        )
        data.append(
            at
            | {"mode": "markers", "name": f"{curve.channel} measured", "y": list(curve.measured)}
            | {"error_y": error_bars(curve.measured_std, colour), "marker": {"color": colour, "size": 4}}
        )
    return {"data": data, "layout": layout(300, xaxis=axis(curves[0].axis), yaxis=axis("MTF", rangemode="tozero"))}


def draw_predicted_patches(patches: Sequence[PatchComparison]) -> Figure:
    """Draw predicted against measured signals of a chart's patches, DN above black, by channel.

    Bars: one standard deviation of prediction and measurement together.

    >>> from lab.formats.results.validation import PatchComparison
    >>> patch = PatchComparison(patch="white", channel="G", predicted_dn=1000.0, predicted_dn_std=3.0,
    ...     measured_dn=1010.0, measured_dn_std=4.0)
    >>> draw_predicted_patches([patch])["data"][1]["error_y"]["array"]
    [5.0]
    """
    data: list[Trace] = []
    top = max(max(patch.measured_dn, patch.predicted_dn) for patch in patches)
    line = {"color": "@muted", "width": 1.0, "dash": "dash"}
    data.append({"type": "scatter", "mode": "lines", "name": "equal", "x": [0.0, top], "y": [0.0, top], "line": line})
    for channel in dict.fromkeys(patch.channel for patch in patches):
        mine = [patch for patch in patches if patch.channel == channel]
        colour = CHANNEL.get(channel, "#888888")
        std = [float(np.hypot(patch.measured_dn_std, patch.predicted_dn_std)) for patch in mine]
        data.append(
            {"type": "scatter", "mode": "markers", "name": channel, "text": [patch.patch for patch in mine]}
            | {"x": [patch.measured_dn for patch in mine], "y": [patch.predicted_dn for patch in mine]}
            | {"error_y": error_bars(std, colour), "marker": {"color": colour, "size": 6}}
        )
    return {
        "data": data,
        "layout": layout(
            300,
            xaxis=axis("measured above black, DN", rangemode="tozero"),
            yaxis=axis("predicted above black, DN", rangemode="tozero"),
        ),
    }


def patch_comparison(patches: Sequence[PatchComparison], improved: Sequence[PatchComparison] | None = None) -> Figure:
    """Draw measured and predicted patches on the same axes, a panel for each channel, in per cent of its brightest
    measured patch.

    patches : by the first model
    improved : the same patches by the improved model

    Bars: one standard deviation of measurement and prediction together.

    >>> from lab.formats.results.validation import PatchComparison
    >>> patch = PatchComparison(patch="white", channel="G", predicted_dn=990.0, predicted_dn_std=3.0,
    ...     measured_dn=1000.0, measured_dn_std=4.0)
    >>> patch_comparison([patch])["data"][0]["y"]
    [99.0]
    """
    channels = list(dict.fromkeys(patch.channel for patch in patches))
    first = BASELINE if improved is not None else "predicted"
    height, data, axes = 90 + 150 * len(channels), list[Trace](), dict[str, Any]()
    pitch = 1.0 / len(channels)
    for number, channel in enumerate(channels):
        mine = [patch for patch in patches if patch.channel == channel]
        mended = [patch for patch in improved or () if patch.channel == channel]
        unit = 100.0 / max(*(patch.measured_dn for patch in mine), 1e-9)
        names = [patch.patch for patch in mine]
        suffix = "" if number == 0 else str(number + 1)
        on = {"type": "scatter", "yaxis": f"y{suffix}", "showlegend": number == 0}
        std = [unit * float(np.hypot(patch.measured_dn_std, patch.predicted_dn_std)) for patch in mended or mine]
        for name, values, colour, dash, width in (
            (first, [patch.predicted_dn for patch in mine], BEFORE, "dash", 1.6),
            ("improved model", [patch.predicted_dn for patch in mended], AFTER, "solid", 1.8),
        ):
            if values:
                line = {"color": colour, "width": width, "dash": dash}
                data.append(
                    on | {"mode": "lines", "name": name, "x": names, "y": [unit * v for v in values], "line": line}
                )
        data.append(
            on
            | {
                "mode": "markers",
                "name": "measured",
                "x": names,
                "y": [unit * patch.measured_dn for patch in mine],
                "error_y": error_bars(std, "@fg"),
                "marker": {"color": CHANNEL.get(channel, "#888888"), "size": 6},
            }
        )
        top = 1.0 - number * pitch
        axes[f"yaxis{suffix}"] = axis(f"{channel}, %", rangemode="tozero", domain=[top - 0.84 * pitch, top])
    last = "y" if len(channels) == 1 else f"y{len(channels)}"
    return {
        "data": data,
        "layout": layout(height, xaxis=axis("", anchor=last, tickangle=-45, tickfont={"size": 10}), **axes),
    }


def mismatch_map(diagnosis: DiagnosisResult) -> Figure | None:
    """Draw the significance of the baseline's mismatches by axis, one row for each side and measurement."""
    if not diagnosis.mismatches:
        return None
    rows = list(dict.fromkeys((item.side, item.measurement) for item in diagnosis.mismatches))
    axes = list(dict.fromkeys(item.axis for item in diagnosis.mismatches))
    strongest: dict[tuple[tuple[str, str], str], Any] = {}
    for item in diagnosis.mismatches:
        key = ((item.side, item.measurement), item.axis)
        if key not in strongest or item.significance_sigma > strongest[key].significance_sigma:
            strongest[key] = item
    cells = [[strongest.get((row, name)) for name in axes] for row in rows]
    names = [f"{side}: {measurement_title(measurement)}" for side, measurement in rows]
    labels = [name.replace("_", " ") for name in axes]
    return {
        "data": [
            {
                "type": "heatmap",
                "x": labels,
                "y": names,
                "z": [[None if cell is None else cell.significance_sigma for cell in row] for row in cells],
                "customdata": [["" if cell is None else cell.where for cell in row] for row in cells],
                "hovertemplate": "%{y}<br>%{x}: %{z:.1f} sigma<br>%{customdata}<extra></extra>",
                "colorscale": [[0, "#fde0c5"], [0.5, "#f0874f"], [1, "#a1232f"]],
                "zmin": diagnosis.threshold or 0.0,
                "xgap": 3,
                "ygap": 3,
                "colorbar": {"title": {"text": "sigma", "side": "right"}, "thickness": 10, "outlinewidth": 0},
            }
        ],
        "layout": layout(
            110 + 44 * len(rows),
            xaxis=axis("", side="bottom", showgrid=False),
            yaxis=axis("", autorange="reversed", showgrid=False),
            annotations=[
                {
                    "x": labels[column],
                    "y": names[row],
                    "text": f"{cell.significance_sigma:.1f} σ",
                    "showarrow": False,
                    "font": {"size": 12, "color": "#1b1b1b"},
                    "bgcolor": "rgba(255,255,255,0.55)",
                }
                for row, line in enumerate(cells)
                for column, cell in enumerate(line)
                if cell is not None
            ],
        ),
    }


def _range(curve: ResidualCurve) -> list[float]:
    """Return the range of the ordinate: it holds the measurement with its bars, and both models."""
    seen, std = np.asarray(curve.measured), np.nan_to_num(np.asarray(curve.measured_std))
    shown = np.concatenate([seen - std, seen + std, curve.before, curve.after])
    low, high = float(shown.min()), float(shown.max())
    margin = 0.06 * (high - low) or 0.5 * abs(high) or 1.0
    return [low - margin, high + margin]


def _residual_traces(name: str, x: Sequence[float], residual: np.ndarray[Any, Any], colour: str) -> list[Trace]:
    """Return residuals as dots within the axis, and as triangles at its edge where they lie beyond."""
    places = np.asarray(x)
    dots = {"type": "scatter", "mode": "markers", "name": name, "showlegend": False, "yaxis": "y2"}
    traces: list[Trace] = []
    for symbol, chosen, at in (
        ("circle", np.abs(residual) <= RESIDUAL_SIGMA, residual),
        ("triangle-up", residual > RESIDUAL_SIGMA, np.full_like(residual, RESIDUAL_SIGMA)),
        ("triangle-down", residual < -RESIDUAL_SIGMA, np.full_like(residual, -RESIDUAL_SIGMA)),
    ):
        if chosen.any():
            look = {"color": colour, "size": 4 if symbol == "circle" else 8, "symbol": symbol}
            said = {"text": [f"{value:.3g} σ" for value in residual[chosen]], "hoverinfo": "x+text"}
            traces.append(dots | said | {"x": places[chosen].tolist(), "y": at[chosen].tolist(), "marker": look})
    return traces


def beyond_axis(name: str, residual: np.ndarray[Any, Any]) -> str:
    """Return how many residuals lie beyond the axis, and the farthest; empty where none does.

    name : of the measurement
    residual : (n,), standard deviations

    >>> beyond_axis("MTF", np.array([0.5, -1.0]))
    ''
    """
    beyond = np.abs(residual) > RESIDUAL_SIGMA
    if not beyond.any():
        return ""
    farthest = float(residual[np.argmax(np.abs(residual))])
    sign = "\N{MINUS SIGN}" if farthest < 0 else "+"
    return (
        f"{name}: {int(beyond.sum())} of {residual.size} beyond ±{RESIDUAL_SIGMA:g} σ, to "
        f"{sign}{plain_number(abs(farthest), 2)} σ"
    )


def _name_ticks(curve: ResidualCurve) -> dict[str, Any]:
    """Tick labels with the points' names, where x only numbers them."""
    if not curve.names:
        return {}
    return {"tickvals": list(curve.x), "ticktext": list(curve.names), "tickangle": -45, "tickfont": {"size": 9}}


def _beside_residuals(said: str, colour: str, place: int) -> dict[str, Any]:
    """Return a line of text above the residuals."""
    at = {
        "xref": "paper",
        "yref": "paper",
        "x": 0.0,
        "y": 0.305 + 0.055 * place,
        "xanchor": "left",
        "yanchor": "bottom",
    }
    return at | {"text": said, "showarrow": False, "font": {"size": 10, "color": colour}}


def residual_curve(curve: ResidualCurve) -> Figure:
    """Draw one measurement with both models' predictions, and below it the residuals in standard deviations.

    >>> from lab.formats.results.diagnosis import ResidualCurve
    >>> curve = ResidualCurve(side="left", measurement="slanted_edge", label="edge-1", channel="G",
    ...     axis="spatial frequency, cy/px", x=(0.1, 0.2), measured=(0.9, 0.8), measured_std=(0.01, 0.01),
    ...     before=(0.95, 0.85), after=(0.9, 0.8), held_out=True)
    >>> len(residual_curve(curve)["data"]) >= 3
    True
    """
    std = np.maximum(np.asarray(curve.measured_std), 1e-12)
    seen = np.asarray(curve.measured)
    notes: list[dict[str, Any]] = []
    data: list[Trace] = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": "measured",
            "x": list(curve.x),
            "y": list(curve.measured),
            "error_y": error_bars(curve.measured_std, "@fg"),
            "marker": {"color": "@fg", "size": 4},
        }
    ]
    for name, values, colour, dash in (
        ("baseline", curve.before, BEFORE, "dash"),
        ("improved model", curve.after, AFTER, "solid"),
    ):
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": name,
                "x": list(curve.x),
                "y": list(values),
                "line": {"color": colour, "width": 2, "dash": dash},
            }
        )
        residual = (seen - np.asarray(values)) / std
        data += _residual_traces(name, curve.x, residual, colour)
        if said := beyond_axis(name, residual):
            notes.append(_beside_residuals(said, colour, len(notes)))
    return {
        "data": data,
        "layout": layout(
            330,
            xaxis=axis(curve.axis, anchor="y2", **_name_ticks(curve)),
            yaxis=axis(
                "<br>".join(textwrap.wrap(curve.quantity or "measured", 20)), domain=[0.44, 1.0], range=_range(curve)
            ),
            yaxis2=axis(
                "residual, σ",
                domain=[0.0, 0.3],
                zeroline=True,
                range=[-1.15 * RESIDUAL_SIGMA, 1.15 * RESIDUAL_SIGMA],
                tickvals=[-RESIDUAL_SIGMA, 0.0, RESIDUAL_SIGMA],
                ticktext=["−5", "0", "+5"],
            ),
            annotations=notes,
            shapes=[
                {
                    "type": "rect",
                    "xref": "paper",
                    "yref": "y2",
                    "x0": 0,
                    "x1": 1,
                    "y0": -2,
                    "y1": 2,
                    "fillcolor": "rgba(128,128,128,0.15)",
                    "line": {"width": 0},
                    "layer": "below",
                }
            ],
        ),
    }


def held_out_bars(diagnosis: DiagnosisResult) -> Figure | None:
    """Draw chi2 / n of both models on held-out captures; noise alone gives 1."""
    held = diagnosis.held_out
    if held is None or held.n == 0:
        return None
    every = (held.chi2_before, held.chi2_after, held.chi2_discovered)
    left = [chi2 / held.n for chi2 in every if chi2 is not None]
    return {
        "data": [
            {
                "type": "bar",
                "orientation": "h",
                "y": ["baseline", "improved model", "with laws without a name"][: len(left)],
                "x": left,
                "marker": {"color": [BEFORE, AFTER, AFTER][: len(left)]},
                "text": [f"{ratio:.2f}" for ratio in left],
                "textposition": "auto",
                "showlegend": False,
            }
        ],
        "layout": layout(
            150,
            xaxis=axis("χ² / n on held-out captures (1: noise alone)", rangemode="tozero"),
            yaxis=axis("", autorange="reversed", showgrid=False),
            shapes=[
                {
                    "type": "line",
                    "x0": 1,
                    "x1": 1,
                    "yref": "paper",
                    "y0": 0,
                    "y1": 1,
                    "line": {"color": "@fg", "width": 1, "dash": "dot"},
                }
            ],
        ),
    }


# ----------------------------------------------------------------------------------------------------------------------
# The data of a page's charts: the figures as typed arrays, and plotly.js with Cartesian traces only, both compressed.
#
# `plotly-cartesian.min.js.gz` is a third of the full build. It was made by
#
#     npm pack plotly.js-cartesian-dist-min@4.1.1     # MIT, see plotly-LICENSE.txt
#     gzip -9 -n < package/plotly-cartesian.min.js > plotly-cartesian.min.js.gz


BUILD = Path(__file__).with_name("plotly-cartesian.min.js.gz")
#: A trace's keys whose numbers are sent as typed arrays, from how many numbers on.
PACKED, PACKED_FROM = frozenset({"x", "y", "z", "array", "arrayminus"}), 8


@cache
def plotly_base64() -> str:
    """Return the compressed build of Plotly as base64; `charts.js` expands it in the page.

    >>> base64.b64decode(plotly_base64())[:2].hex()  # of gzip
    '1f8b'
    """
    return base64.b64encode(BUILD.read_bytes()).decode("ascii")


class ChartData:
    """The figures of one page, in the order in which its template asks for them."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add(self, figure: Figure) -> int:
        """Keep a figure; its number on the page."""
        self._lines.append(figure_json(figure))
        return len(self._lines) - 1

    def pack(self) -> str:
        """Return all figures as base64, a line of JSON each, compressed: no text of theirs can end the element that
        holds it.

        >>> charts = ChartData()
        >>> _ = charts.add({"data": [], "layout": {}})
        >>> gzip.decompress(base64.b64decode(charts.pack())).decode()
        '{"data":[],"layout":{}}'
        """
        return base64.b64encode(gzip.compress("\n".join(self._lines).encode(), mtime=0)).decode("ascii")


def _pack(values: Any) -> dict[str, str] | None:
    """Numbers as plotly's typed array (float32, base64; NaN where there is none), None where it isn't an array worth
    packing."""
    if not isinstance(values, list | tuple) or len(values) < PACKED_FROM:
        return None
    rows = [row for row in values if isinstance(row, list | tuple)]
    if rows and (len(rows) != len(values) or len({len(row) for row in rows}) != 1):
        return None
    flat = [item for row in rows for item in row] if rows else list(values)
    if any(isinstance(item, bool) or not isinstance(item, int | float | None) for item in flat):
        return None
    numbers = np.array([np.nan if item is None else item for item in flat], "<f4")
    shape = {"shape": f"{len(rows)}, {len(rows[0])}"} if rows else {}
    return {"dtype": "f4", "bdata": base64.b64encode(numbers.tobytes()).decode("ascii")} | shape


def figure_json(figure: Figure) -> str:
    """Return a figure as one line of JSON: a trace's numbers as typed arrays, others rounded to 7 digits.

    >>> figure_json({"data": [], "layout": {"height": 300}})
    '{"data":[],"layout":{"height":300}}'
    """

    def round_numbers(value: Any, key: str = "") -> Any:
        if key in PACKED and (packed := _pack(value)) is not None:
            return packed
        if isinstance(value, dict):
            return {name: round_numbers(item, name) for name, item in value.items()}
        if isinstance(value, list | tuple):
            return [round_numbers(item) for item in value]
        if isinstance(value, float):
            return float(f"{value:.7g}") if np.isfinite(value) else None
        return value

    return json.dumps(round_numbers(figure), separators=(",", ":"), allow_nan=False)
