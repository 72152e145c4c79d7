"""The page of a traced lens: its drawing with rays, illumination, distortion, lateral colour, MTF against field, PSF
mosaic."""

from __future__ import annotations

import math
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from lab.predict.lens import LensResult, TracedPrescription
from lab.report import page_environment, write_page
from lab.report.charts import ChartData, Figure, Trace, axis, layout, plotly_base64
from lab.report.pictures import kernel_picture
from sim.optics import rays as rt
from sim.optics.system import OpticalSystem
from sim.optics.table import LensTable
from sim.spectrum import FloatArray

#: Distinguishable with all common kinds of colour vision, and legible on white and on near-black.
FIELD_COLOURS = ("#3d7be0", "#2a9d57", "#d1495b")
GLASS_FILL = "rgba(102,178,240,0.22)"
MOSAIC_FIELDS = 5
_RAYS_A_FIELD = 7


def _profile(surfaces: rt.Surfaces, i: int, height: float, count: int = 61) -> tuple[FloatArray, FloatArray]:
    """(z, y) of a surface's section in its own frame, where the surface exists."""
    ys = np.linspace(-height, height, count)
    sags = np.array([rt.sag(surfaces, i, float(y * y)) for y in ys])
    known = sags[:, 1] > 0
    return sags[known, 0], ys[known]


def _paths(system: OpticalSystem, tangent: tuple[float, float]) -> list[FloatArray]:
    """Rays of a field point across the pupil in y, as points (z, y) of the drawing."""
    index, field = system.index(system.reference_nm), system.field(tangent)
    centre = system.open_centre(tangent, [system.reference_nm])
    if centre is None:
        return []
    ends = rt.rim(system.surfaces, index, field, *centre, np.array([0.5 * np.pi, -0.5 * np.pi]), system.pupil_radius_mm)
    vertices, axes = rt.frames(system.surfaces)
    out = np.zeros(rt.ROW)
    drawn = []
    for offset in np.linspace(-ends[1], ends[0], _RAYS_A_FIELD) * (1 - 1e-9):
        points = np.zeros((len(system.surfaces.kind), 3))
        rt.trace_ray(system.surfaces, index, field, centre[0], centre[1] + offset, False, out, points)
        if out[rt.STATUS] != rt.ARRIVED:
            continue
        world = vertices + np.einsum("nij,nj->ni", axes, points)
        finite = field[0] != 0.0
        toward = world[0] - field[1:4] if finite else field[1:4]
        toward = toward / np.linalg.norm(toward)
        lead = 0.15 * (vertices[-1, 2] - min(vertices[:, 2].min(), 0.0)) + max(0.0, -world[0, 2])
        world = np.vstack([world[0] - lead / toward[2] * toward, world])
        drawn.append(world[:, [2, 1]])
    return drawn


def drawing(system: OpticalSystem, tangents: list[tuple[float, float]]) -> Figure:
    """Draw a section of the lens in the y-z plane, to scale, with the rays of three field points."""
    surfaces, prescription = system.surfaces, system.prescription
    vertices, axes = rt.frames(surfaces)
    rays = [_paths(system, tangent) for tangent in tangents]
    reach = np.zeros(len(surfaces.kind))
    for paths in rays:
        for path in paths:
            local = np.einsum("nji,nj->ni", axes[:, 1:, 1:], (path[1:, ::-1] - vertices[:, 1:]))
            reach = np.maximum(reach, np.abs(local[:, 0]))
    heights = np.array(
        [
            surface.aperture.half_height_mm if surface.aperture else max(surface.semi_diameter_mm, 1.05 * reach[i])
            for i, surface in enumerate(prescription.surfaces)
        ]
    )
    heights[-1] = 1.05 * reach[-1]
    traces: list[Trace] = []

    def world(i: int, z: FloatArray, y: FloatArray) -> tuple[list[float], list[float]]:
        points = vertices[i] + np.outer(y, axes[i][:, 1]) + np.outer(z, axes[i][:, 2])
        return points[:, 2].tolist(), points[:, 1].tolist()

    def line(x: list[float], y: list[float], **look: Any) -> Trace:
        return {"type": "scatter", "mode": "lines", "x": x, "y": y, "showlegend": False, "hoverinfo": "skip"} | look

    last = len(surfaces.kind) - 1
    index = system.index(system.reference_nm)
    for i in range(last):
        if index[i + 1] == 1.0 or surfaces.kind[i] == rt.BREAK:
            continue
        front = world(i, *_profile(surfaces, i, heights[i]))
        back = world(i + 1, *_profile(surfaces, i + 1, heights[i + 1]))
        x, y = front[0] + back[0][::-1] + front[0][:1], front[1] + back[1][::-1] + front[1][:1]
        traces.append(line(x, y, fill="toself", fillcolor=GLASS_FILL, line={"color": "@muted", "width": 1.3}))
    stop = prescription.stop
    for sign in (-1.0, 1.0):
        bar = sign * np.array([1.0, 1.25]) * surfaces.stop_radius
        traces.append(line(*world(stop, np.zeros(2), bar), line={"color": "@fg", "width": 4}))
    traces.append(line(*world(last, *_profile(surfaces, last, heights[-1])), line={"color": "@fg", "width": 2}))
    for colour, tangent, paths in zip(FIELD_COLOURS, tangents, rays, strict=False):
        name = f"{math.degrees(math.atan(math.hypot(*tangent))):.1f} deg"
        for number, path in enumerate(paths):
            look = {"name": name, "showlegend": number == 0, "legendgroup": name}
            traces.append(line(path[:, 0].tolist(), path[:, 1].tolist(), line={"color": colour, "width": 1}, **look))
    return {
        "data": traces,
        "layout": layout(
            420,
            xaxis=axis("z, mm"),
            yaxis=axis("y, mm", scaleanchor="x", scaleratio=1),
        ),
    }


def _curve(name: str, x: list[float], y: list[float], colour: str, **more: Any) -> Trace:
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": name,
        "x": x,
        "y": y,
        "line": {"color": colour, "width": 2},
        "marker": {"size": 4, "color": colour},
    } | more


def _spectral(table: LensTable) -> list[tuple[int, str]]:
    """Indices of a short, a middle and a long wavelength of the table, with their colours."""
    wanted = (450.0, 550.0, 650.0)
    if not table.wavelength_nm[0] <= wanted[0] < wanted[-1] <= table.wavelength_nm[-1]:
        wanted = tuple(np.linspace(table.wavelength_nm[0], table.wavelength_nm[-1], 3).tolist())
    places = [int(np.argmin(np.abs(table.wavelength_nm - w))) for w in wanted]
    return list(dict(zip(places, FIELD_COLOURS, strict=True)).items())


def illumination(table: LensTable) -> Figure:
    """Draw relative illumination against the field angle, with cos^4 beside it."""
    angle = table.field_deg[:, 1].tolist()
    traces = [
        _curve(f"{table.wavelength_nm[i]:.0f} nm", angle, table.relative_illumination[i].tolist(), colour)
        for i, colour in _spectral(table)
    ]
    fall = (np.cos(np.deg2rad(table.field_deg[:, 1])) ** 4).tolist()
    traces.append(_curve("cos⁴ law", angle, fall, "@muted", mode="lines", line={"color": "@muted", "dash": "dot"}))
    return {
        "data": traces,
        "layout": layout(
            320, xaxis=axis("field angle, deg"), yaxis=axis("relative illumination, 1", rangemode="tozero")
        ),
    }


def distortion(result: LensResult) -> Figure:
    """Draw the distortion of the chief ray against the field angle."""
    angle = [field.angle_deg for field in result.fields]
    values = [field.distortion_percent for field in result.fields]
    name = f"{result.reference_wavelength_nm:.0f} nm"
    return {
        "data": [_curve(name, angle, values, FIELD_COLOURS[1])],
        "layout": layout(320, showlegend=False, xaxis=axis("field angle, deg"), yaxis=axis("distortion, %")),
    }


def lateral_colour(table: LensTable) -> Figure:
    """Draw the centroid height of each wavelength relative to the middle wavelength, against the field angle."""
    angle = table.field_deg[:, 1].tolist()
    chosen = _spectral(table)
    middle = table.centroid_um[chosen[len(chosen) // 2][0], :, 1]
    traces = [
        _curve(f"{table.wavelength_nm[i]:.0f} nm", angle, (table.centroid_um[i, :, 1] - middle).tolist(), colour)
        for i, colour in chosen
    ]
    return {
        "data": traces,
        "layout": layout(320, xaxis=axis("field angle, deg"), yaxis=axis("centroid shift in y, µm")),
    }


def mtf_against_field(result: LensResult) -> Figure:
    """Draw MTF at the stated frequencies against the field angle: sagittal solid, tangential dashed."""
    angle = [field.angle_deg for field in result.fields]
    reference = [
        next(curve for curve in field.mtf if curve.wavelength_nm == result.reference_wavelength_nm)
        for field in result.fields
    ]
    traces: list[Trace] = []
    for k, frequency in enumerate(reference[0].frequency_lp_per_mm):
        colour = FIELD_COLOURS[k % 3]
        for name, values, dash in (
            ("sagittal", [curve.sagittal[k] for curve in reference], "solid"),
            ("tangential", [curve.tangential[k] for curve in reference], "dash"),
        ):
            look = {"color": colour, "width": 2, "dash": dash}
            traces.append(_curve(f"{frequency:g} lp/mm {name}", angle, values, colour, line=look))
    return {
        "data": traces,
        "layout": layout(360, xaxis=axis("field angle, deg"), yaxis=axis("MTF, 1", range=[0, 1.02])),
    }


def encircled(table: LensTable) -> Figure:
    """Draw the share of the light within the table's window, against the field angle."""
    angle = table.field_deg[:, 1].tolist()
    traces = [
        _curve(f"{table.wavelength_nm[i]:.0f} nm", angle, (100 * table.encircled_share[i]).tolist(), colour)
        for i, colour in _spectral(table)
    ]
    return {
        "data": traces,
        "layout": layout(320, xaxis=axis("field angle, deg"), yaxis=axis("encircled energy, %", range=[0, 102])),
    }


def _mosaic(table: LensTable) -> list[dict[str, Any]]:
    """Rows of the PSF mosaic: pictures of one wavelength from centre to corner, each scaled to its own peak."""
    count = len(table.field_deg)
    chosen = sorted({round(k * (count - 1) / (MOSAIC_FIELDS - 1)) for k in range(MOSAIC_FIELDS)})
    return [
        {
            "wavelength": f"{table.wavelength_nm[i]:.0f} nm",
            "cells": [
                {
                    "picture": kernel_picture(table.psf[i, f], float(table.psf[i, f].max())),
                    "angle": f"{table.field_deg[f, 1]:.1f}°",
                    "share": f"{100 * table.encircled_share[i, f]:.1f} %",
                }
                for f in chosen
            ],
        }
        for i, _ in _spectral(table)
    ]


def render_lens(traced: TracedPrescription) -> str:
    """Return the page as HTML text."""
    result, table, system = traced.result, traced.table, traced.system
    last = math.tan(math.radians(result.maximum_field_deg))
    window = table.psf.shape[-1] * table.sample_pitch_um

    def mm(value: float | None) -> str:
        return "at infinity" if value is None else f"{value:.4f} mm"

    figures = [
        ("focal length", mm(result.focal_length_mm)),
        ("f-number", f"{result.f_number:.4f}"),
        ("working f-number", f"{result.working_f_number:.4f}"),
        ("object", "at infinity" if result.object_distance_mm is None else mm(result.object_distance_mm)),
        ("back focus, from the last surface", mm(result.back_focus_mm)),
        ("image shift from the file's position", mm(result.image_shift_mm)),
        ("entrance pupil, diameter", mm(result.entrance_pupil_mm)),
        ("entrance pupil, from the first surface", mm(result.entrance_pupil_position_mm)),
        ("exit pupil, diameter", mm(result.exit_pupil_mm)),
        ("exit pupil, from the last surface", mm(result.exit_pupil_position_mm)),
        ("largest field angle", f"{result.maximum_field_deg:.3f}°"),
    ]
    context: dict[str, Any] = {
        "title": result.name,
        "version": metadata.version("calibench"),
        "result": result,
        "figures": figures,
        "drawing": drawing(system, [(0.0, 0.0), (0.0, 0.7 * last), (0.0, last)]),
        "illumination": illumination(table),
        "distortion": distortion(result),
        "lateral": lateral_colour(table),
        "mtf": mtf_against_field(result),
        "encircled": encircled(table),
        "mosaic": _mosaic(table),
        "window": f"{window:.1f}",
        "pitch": f"{table.sample_pitch_um:.2f}",
        "chart_data": ChartData(),
        "plotly": plotly_base64(),
    }
    return page_environment().get_template("lens.html").render(context)


def write_lens_report(folder: Path, traced: TracedPrescription) -> Path:
    """Write `folder`/lens.html, one self-contained page: completely, or not at all. InputError where it can't be
    written."""
    return write_page(folder / "lens.html", render_lens(traced))
