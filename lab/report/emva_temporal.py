"""The data sheet's temporal plots: photon transfer, responsivity, SNR, linearity, dark current; and those of the joint
fit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lab.formats.results import Emva1288, Emva1288Points, NoiseFit
from lab.formats.results.in_words import measured
from lab.report.charts import AFTER, BEFORE, CHANNEL, axis, layout
from lab.report.emva_plot import EmvaPlot, curve, floats, markers
from sim.spectrum import FloatArray

BOLTZMANN_EV_PER_K, ZERO_C_K = 8.617333262e-5, 273.15


def _light_axis(points: Emva1288Points) -> str:
    return "irradiation, photons/pixel" if points.light_unit == "photons" else "exposure, s"


def temporal_plots(own: Emva1288, plane: str) -> Iterator[EmvaPlot]:
    """The temporal plots of one plane, whose figures are `own`."""
    points, colour = own.points, CHANNEL.get(plane, "#888888")
    signal = np.array(points.mean_dn) - np.array(points.dark_mean_dn)
    excess = np.array(points.variance_dn2) - np.array(points.dark_variance_dn2)
    light = np.array(points.light)
    saturation = own.saturation_capacity_e
    top = saturation * own.system_gain_dn_per_e if saturation is not None else float(signal.max())
    yield EmvaPlot(
        "Photon transfer",
        {
            "data": [
                markers("measured", floats(signal), floats(excess), colour),
                curve(
                    f"K = {measured(own.system_gain_dn_per_e, own.system_gain_dn_per_e_std, 'DN/e')}",
                    [0.0, 0.7 * top],
                    [0.0, 0.7 * top * own.system_gain_dn_per_e],
                    "@fg",
                ),
                curve(
                    "",
                    [0.7 * top, top],
                    [k * top * own.system_gain_dn_per_e for k in (0.7, 1.0)],
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
    if own.responsivity_dn_per_photon is not None:
        slope = own.responsivity_dn_per_photon
        reach = float(light[signal <= 1.02 * top].max())
        yield EmvaPlot(
            "Responsivity",
            {
                "data": [
                    markers("measured", floats(light), floats(signal), colour),
                    curve(
                        f"R = {measured(slope, own.responsivity_dn_per_photon_std, 'DN/photon')}",
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
    yield _snr(own, light, signal, colour)
    yield from _linearity(own, light, signal, colour)
    yield from _dark_current(own, colour)


def _snr(own: Emva1288, light: FloatArray, signal: FloatArray, colour: str) -> EmvaPlot:
    """SNR against light: measured, of the linear model, with nonuniformity, and of an ideal sensor."""
    points, gain = own.points, own.system_gain_dn_per_e
    photons = own.quantum_efficiency is not None
    efficiency = own.quantum_efficiency if own.quantum_efficiency is not None else 1.0
    x = light if photons else signal / gain
    # beyond saturation the noise vanishes, and SNR has no meaning
    seen = (signal > 0) & (np.array(points.variance_dn2) > 0)
    if own.saturation_capacity_e is not None:
        seen &= (
            signal <= 1.001 * own.saturation_capacity_e * gain
            if not photons
            else light <= (own.saturation_capacity_photons or np.inf)
        )
    noise = np.sqrt(np.where(seen, points.variance_dn2, 1.0))
    dark_e = own.temporal_dark_noise_dn / gain if own.temporal_dark_noise_dn is not None else 0.0
    first = own.sensitivity_threshold_photons if photons else own.sensitivity_threshold_e
    full = own.saturation_capacity_photons if photons else own.saturation_capacity_e
    low, high = first or 1.0, full or float(x.max())
    at = np.geomspace(max(0.7 * low, 1e-3), high, 60)
    electrons = efficiency * at
    model = electrons / np.sqrt(dark_e**2 + electrons)
    data = [
        markers("measured", floats(x[seen]), floats(signal[seen] / noise[seen]), colour),
        curve("linear model", floats(at), floats(model), "@fg"),
    ]
    if own.dsnu_e is not None and own.prnu_percent is not None:
        spatial = own.dsnu_e**2 + (own.prnu_percent / 100.0 * electrons) ** 2
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
                xaxis=axis(label, type="log"),
                yaxis=axis("SNR", type="log"),
                margin={"l": 56, "r": 14, "t": 46, "b": 44},
            ),
        },
        "Logarithmic on both axes. The ideal sensor has a quantum efficiency of 1 and shot noise alone."
        if photons
        else "Logarithmic on both axes. The ideal sensor has shot noise alone.",
    )


def _linearity(own: Emva1288, light: FloatArray, signal: FloatArray, colour: str) -> Iterator[EmvaPlot]:
    points = own.points
    at = [k for k, value in enumerate(points.linearity_deviation_percent) if value is not None]
    if not at or own.linearity_error_percent is None:
        return
    deviation = [points.linearity_deviation_percent[k] for k in at]
    x = light[at]
    # The line's own values: signal = line (1 + deviation).
    line = signal[at] / (1.0 + np.array(deviation, float) / 100.0)
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
        f"LE {measured(own.linearity_error_percent, own.linearity_error_percent_std, '%')} is their mean absolute "
        "value.",
    )


def _dark_current(own: Emva1288, colour: str) -> Iterator[EmvaPlot]:
    points = own.points
    if len(set(points.dark_exposure_s)) < 2:
        return
    yield EmvaPlot(
        "Dark signal against exposure",
        {
            "data": [
                markers("mean", points.dark_exposure_s, points.dark_exposure_mean_dn, colour, showlegend=False),
                markers(
                    "variance",
                    points.dark_exposure_s,
                    points.dark_exposure_variance_dn2,
                    BEFORE,
                    yaxis="y2",
                    showlegend=False,
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
    """Plots of the joint fit: read noise of single pixels, dark current against temperature."""
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
                    310, xaxis=axis("temporal dark noise, e"), yaxis=axis("pixels", type="log"), bargap=0.05
                ),
            },
            f"Over {spread.degrees_of_freedom} degrees of freedom a pixel; median {spread.median_e:.3g} e, 99 % below "
            f"{spread.percentile_99_e:.3g} e. The pixels' true variances differ by "
            f"{measured(spread.spread_percent, spread.spread_percent_std, '%')}, sampling error subtracted; "
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
        caption += f" Activation energy {measured(law.activation_energy_ev, law.activation_energy_ev_std, 'eV')}"
        if law.doubling_temperature_c is not None:
            caption += f"; doubles every {measured(law.doubling_temperature_c, law.doubling_temperature_c_std, 'K')}"
        caption += "."
    yield EmvaPlot(
        "Dark current against temperature",
        {
            "data": data,
            "layout": layout(310, xaxis=axis("temperature, °C"), yaxis=axis("dark current, e/s", type="log")),
        },
        caption,
        of_plane=False,
    )
