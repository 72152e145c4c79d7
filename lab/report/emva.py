"""The EMVA 1288 data sheet: the standard's table, conditions and plots, from the fit's figures and the recordings'
spatial stacks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lab.errors import NotDetermined
from lab.fit.noise.pixel_maps import pixel_maps
from lab.formats.recording_set import RecordingSet
from lab.formats.results import ChannelNoise, Emva1288, FitResult, NoiseFit, PixelDefects
from lab.formats.results.in_words import measured
from lab.report.emva_plot import EmvaPlot
from lab.report.emva_spatial import spatial_plots
from lab.report.emva_temporal import joint_fit_plots, temporal_plots
from lab.report.figures import NOISE
from lab.report.maps import MAPS
from lab.report.pictures import map_picture, photograph_data_uri
from sim.camera import Side

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
    """A sheet for each camera whose flats and darks gave EMVA 1288 figures. Reads the frames of the spatial stacks."""
    for side, camera in fit.cameras.items():
        noise = camera.noise
        if noise is None or not noise.emva1288:
            continue
        found = noise.emva1288
        names = tuple(found)
        plotted = next(name for name in ("Y", "G1", *names) if name in found)
        own = found[plotted]
        remarks = [(name, remark) for name, plane in found.items() for remark in plane.remarks]
        grouped: dict[str, list[str]] = {}
        for name, remark in remarks:
            grouped.setdefault(remark, []).append(name)
        yield EmvaSheet(
            side=side,
            planes=names,
            plotted=plotted,
            conditions=tuple(_conditions(recordings, side, own)),
            rows=tuple(table_rows(found)),
            plots=(
                *temporal_plots(own, plotted),
                *spatial_plots(recordings, side, own, plotted),
                *joint_fit_plots(noise),
            ),
            remarks=tuple(
                remark if len(which) == len(names) else f"{', '.join(which)}: {remark}"
                for remark, which in grouped.items()
            ),
            channels=tuple(noise.channels) if len(noise.channels) > 1 else (),
            channel_rows=tuple(_channel_rows(noise)),
            maps=tuple(_maps(recordings, side)),
            defects=_defect_sentence(noise.defects),
        )


def table_rows(found: dict[str, Emva1288]) -> Iterator[EmvaRow]:
    """The quantities that at least one plane has, with standard deviations."""
    for field, (quantity, symbol, unit, factor) in TABLE.items():
        texts = []
        for plane in found.values():
            value, std = getattr(plane, field), getattr(plane, f"{field}_std")
            if value is None:
                limit = plane.temporal_dark_noise_limit_e if field == "temporal_dark_noise_e" else None
                texts.append("–" if limit is None else f"below {limit:.3g} e")
                continue
            text = measured(factor * value, None if std is None else factor * std, unit)
            if field in DECIBELS and value > 0:
                text += f" ({20.0 * np.log10(value):.1f} dB, {np.log2(value):.1f} bit)"
            systematic = getattr(plane, f"{field}_systematic_std", None)
            if systematic is not None:
                text += f" (± {factor * systematic:.2g} {unit} by the photodiode's calibration)"
            texts.append(text)
        if any(text != "–" for text in texts):
            yield EmvaRow(quantity, symbol, tuple(texts))


def _channel_rows(noise: NoiseFit) -> Iterator[EmvaRow]:
    """The joint fit's quantities by colour."""
    for field, (name, unit) in NOISE.items():
        if field not in ChannelNoise.model_fields:
            continue
        values = [getattr(channel, field) for channel in noise.channels.values()]
        stds = [getattr(channel, f"{field}_std") for channel in noise.channels.values()]
        if any(value is not None for value in values):
            texts = ("–" if v is None else measured(v, std, unit) for v, std in zip(values, stds, strict=True))
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


def _conditions(recordings: RecordingSet, side: Side, own: Emva1288) -> Iterator[str]:
    camera, points = recordings.camera(side), own.points
    yield f"{camera.cols} × {camera.rows} pixels, {camera.bit_depth} bit, mosaic {camera.cfa}"
    if camera.pixel_pitch_um is not None:
        yield f"pixel pitch {camera.pixel_pitch_um:g} µm"
    if own.wavelength_nm is not None:
        yield f"light of {own.wavelength_nm:g} nm"
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
