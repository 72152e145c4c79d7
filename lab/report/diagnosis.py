"""The diagnosis on the page: heat maps of all slices, residual images, smallest detectable effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from lab.diagnose.outcome.detectability import detectable, told_as
from lab.diagnose.outcome.law_words import departure_unit
from lab.formats.results import (
    DiagnosisResult,
    DiscoveredLaw,
    ExaminedPlace,
    ResidualCurve,
    ResidualPicture,
    Visibility,
)
from lab.formats.results.words import format_unit, plain_number
from lab.observables.observable import measurement_title, measurements
from lab.report.charts import AFTER, CHANNEL, Figure, Trace, axis, band, layout
from lab.report.pictures import difference_picture
from sim.camera import Side
from sim.effects.empirical_law import PLACES as EMPIRICAL_PLACES
from sim.effects.library import effects as library
from sim.parameters import Quantity
from sim.spectrum import FloatArray

#: Range of a residual image's colours, standard deviations.
PICTURE_LIMIT = 6.0
#: A chi2 above this quantile of its distribution under noise alone is marked.
MARKED_QUANTILE = 0.999
CURVES_A_SIDE = 8
#: Share of the prior's standard deviation below which an entry of a table by code is determined.
DETERMINED = 0.95
#: What laws are of whose numbers are no factors, offsets or widths.
QUANTITIES = {
    ("charge", "radius"): "dark current",
    ("charge", "radius x exposure"): "time collected besides",
    ("light", "wavelength"): "displacement",
}
#: Range of the heat maps' colours.
DEEPEST_SIGMA = 12.0


def context(diagnosis: DiagnosisResult | None, sides: Sequence[Side]) -> dict[str, Any]:
    """Return the variables of `diagnosis.html` besides the result itself."""
    if diagnosis is None:
        return {}
    threshold = diagnosis.threshold
    return {
        "by_table": diagnosis.engine == "evidence",
        "place_map": place_maps(diagnosis, sides),
        "discovered": [(law, _law_chart(law)) for law in diagnosis.discovered],
        "residual_pictures": [_ResidualImages.of(picture) for picture in diagnosis.pictures],
        "picture_limit": f"{PICTURE_LIMIT:g}",
        "visibility": _visibility(diagnosis.visibility),
        "detectable": f"{detectable(threshold):.0f}" if threshold is not None else "",
    }


def _law_chart(law: DiscoveredLaw) -> Figure:
    """Draw the shortest table of a discovered law: a periodic one with two standard deviations of each entry; one by
    code with the median of these as a band about no change; a curve over its coordinate; a table by row and column as a
    map; a curve of one measurement by channel and condition.
    """
    if law.columns:
        return _cell_map(law)
    if law.curve_of:
        return _of_measurement(law)
    if law.along == "plane x time":
        return _by_channel(law)
    unit = departure_unit(law.stage, law.along, law.of, bool(law.at))
    factor = 100.0 if unit == "%" else 1.0
    quantity = {"codes": "width less 1", "signal": "offset"}.get(
        law.stage if law.of == "mean" and (unit != "%" or law.stage == "codes") else ""
    )
    quantity = quantity or (f"{law.of} less its mean" if law.of != "mean" else "factor less 1")
    quantity = QUANTITIES.get((law.stage, law.along), quantity)
    departure, half = factor * np.array(law.shown_departure), 2.0 * factor * np.array(law.shown_std)
    x: FloatArray = np.arange(len(departure)).astype(float)
    points: Trace = {"type": "scatter", "mode": "markers", "showlegend": False}
    data: list[Trace] = []
    along = f"{law.along} mod {law.shown_period}" if law.shown_period else law.along
    if law.shown_period:
        points |= {
            "error_y": {"type": "data", "array": half.tolist(), "color": "@fg"},
            "marker": {"color": "@fg", "size": 7},
        }
    elif law.form == "by index":
        known = half < half.max() * DETERMINED
        known = known if known.any() else ~known  # all of them are as well known
        x, departure, half = law.first + x[known], departure[known], half[known]
        ends, none = [float(x[0]), float(x[-1])], np.zeros(2)
        data.append(band(ends, none, np.full(2, float(np.median(half))), AFTER))
        points["marker"] = {"color": "@fg", "size": 2}
    else:
        place = EMPIRICAL_PLACES.get((law.stage, law.along, law.of))  # type: ignore[arg-type]
        if len(law.at) == len(departure):
            x, along = np.array(law.at), f"{law.along}, {place[2] if place else 'cycles per um'}"
        data.append(band(x.tolist(), departure, half, AFTER))
        points |= {"mode": "lines", "line": {"color": "@fg", "width": 2}}
    points |= {"x": x.tolist(), "y": departure.tolist()}
    return {"data": [*data, points], "layout": layout(220, xaxis=axis(along), yaxis=axis(f"{quantity}, {unit}"))}


def _by_channel(law: DiscoveredLaw) -> Figure:
    """Draw the curves of the channels over the time, with two standard deviations."""
    curves, half = (
        factor * np.array(values).reshape(-1, len(law.at))
        for factor, values in ((100.0, law.shown_departure), (200.0, law.shown_std))
    )
    data: list[Trace] = []
    for curve, std, name in zip(curves, half, ("R", "G", "B") if len(curves) == 3 else ("Y",), strict=True):
        data.append(band(list(law.at), curve, std, CHANNEL[name], mode="lines"))
        data.append({
            "type": "scatter", "mode": "lines", "x": list(law.at), "y": curve.tolist(), "name": name,
            "line": {"color": CHANNEL[name], "width": 2},
        })  # fmt: skip
    return {"data": data, "layout": layout(220, xaxis=axis("time, s"), yaxis=axis("factor less 1, %"))}


def _of_measurement(law: DiscoveredLaw) -> Figure:
    """Draw a curve of one measurement's numbers over its axis, a line for each channel and condition, with two standard
    deviations."""
    measurement = next((m for m in measurements() if m.name == law.curve_of), None)
    x, departure, half = np.array(law.at), np.array(law.shown_departure), 2.0 * np.array(law.shown_std)
    data: list[Trace] = []
    for label in dict.fromkeys(law.labels):
        places = [k for k, of_label in enumerate(law.labels) if of_label == label]
        colour = CHANNEL.get(label.partition(" ")[0], "#888888")
        data.append(band(x[places].tolist(), departure[places], half[places], colour))
        data.append({
            "type": "scatter", "mode": "lines+markers", "x": x[places].tolist(), "y": departure[places].tolist(),
            "name": label, "line": {"color": colour, "width": 2},
        })  # fmt: skip
    along = law.along if measurement is None else f"{measurement.axis.replace('_', ' ')}, {measurement.unit}"
    quantity = "departure" if measurement is None else f"departure: {measurement.quantity}"
    return {"data": data, "layout": layout(220, xaxis=axis(along), yaxis=axis(quantity))}


def _cell_map(law: DiscoveredLaw) -> Figure:
    """Draw a table by row and column as a map, in per cent or DN."""
    factor, unit = (1.0, "DN") if law.stage == "signal" else (100.0, "%")
    cells = factor * np.array(law.shown_departure).reshape(-1, law.columns)
    most = float(np.abs(cells).max())
    drawn: Trace = {
        "type": "heatmap", "z": cells.tolist(), "zmin": -most, "zmax": most, "colorscale": "RdBu",
        "colorbar": {"title": {"text": unit}},
    }  # fmt: skip
    rows = axis(f"row mod {law.period}", autorange="reversed")
    return {"data": [drawn], "layout": layout(260, xaxis=axis(f"column mod {law.columns}"), yaxis=rows)}


def mood(chi2: float, n: int) -> str:
    """Return the CSS class of a chi2's cell: marked above the 99.9 % quantile of chi2 with n degrees of freedom.

    >>> mood(200.0, 100), mood(100.0, 100)
    ('open', '')
    """
    return "open" if n and chi2 > special.chdtri(n, 1.0 - MARKED_QUANTILE) else ""


def worst_of_each(curves: Sequence[ResidualCurve], most: int = CURVES_A_SIDE) -> list[ResidualCurve]:
    """Return the curve of every measurement that the baseline fits worst, of held-out captures where there are any;
    worst first.

    curves : of the diagnosis
    most : how many at most

    >>> worst_of_each([])
    []
    """

    def mean_chi2(curve: ResidualCurve) -> float:
        std = np.maximum(np.asarray(curve.measured_std), 1e-12)
        return float(np.mean(np.square((np.asarray(curve.measured) - np.asarray(curve.before)) / std)))

    chosen: dict[str, ResidualCurve] = {}
    for curve in sorted(curves, key=lambda curve: (curve.held_out, mean_chi2(curve))):
        chosen[curve.measurement] = curve
    return sorted(chosen.values(), key=mean_chi2, reverse=True)[:most]


def place_maps(diagnosis: DiagnosisResult, sides: Sequence[Side]) -> list[tuple[str, Figure]]:
    """Draw heat maps of significance by measurement and axis, one for each side and model (baseline, and improved model
    where effects were named)."""
    maps = []
    for side in sides:
        mine = [place for place in diagnosis.places if place.side == side]
        if not mine:
            continue
        maps.append((f"{side}, baseline", _place_map(mine, after=False)))
        if any(side in effect.sides for effect in diagnosis.effects):
            maps.append((f"{side}, improved model", _place_map(mine, after=True)))
    return maps


def _place_map(places: Sequence[ExaminedPlace], *, after: bool) -> Figure:
    rows = list(dict.fromkeys(place.measurement for place in places))
    axes = list(dict.fromkeys(place.axis for place in places))

    def sigma(place: ExaminedPlace) -> float:
        return place.sigma_after if after else place.sigma_before

    worst: dict[tuple[str, str], ExaminedPlace] = {}
    for place in places:
        key = place.measurement, place.axis
        if key not in worst or sigma(place) > sigma(worst[key]):
            worst[key] = place
    cells = [[worst.get((row, name)) for name in axes] for row in rows]
    return {
        "data": [
            {
                "type": "heatmap",
                "x": [name.replace("_", " ") for name in axes],
                "y": [measurement_title(row) for row in rows],
                "z": [[None if cell is None else min(sigma(cell), DEEPEST_SIGMA) for cell in line] for line in cells],
                "customdata": [
                    ["" if cell is None else f"{sigma(cell):.1f} σ, {cell.where}" for cell in line] for line in cells
                ],
                "hovertemplate": "%{y}, %{x}<br>%{customdata}<extra></extra>",
                "colorscale": [[0, "#eef1f4"], [0.25, "#fbe3c8"], [0.6, "#f0874f"], [1, "#a1232f"]],
                "zmin": 0.0,
                "zmax": DEEPEST_SIGMA,
                "xgap": 2,
                "ygap": 2,
                "showscale": False,
            }
        ],
        "layout": layout(
            70 + 26 * len(rows),
            xaxis=axis("", side="top", showgrid=False, ticks="", tickangle=-35),
            yaxis=axis("", autorange="reversed", showgrid=False, ticks=""),
            margin={"l": 110, "r": 14, "t": 70, "b": 12},
            annotations=[
                {
                    "x": axes[column].replace("_", " "),
                    "y": measurement_title(rows[line]),
                    "text": _short(sigma(cell)),
                    "showarrow": False,
                    "font": {"size": 11, "color": "#ffffff" if sigma(cell) > 0.8 * DEEPEST_SIGMA else "#1b1b1b"},
                }
                for line, of_row in enumerate(cells)
                for column, cell in enumerate(of_row)
                if cell is not None and sigma(cell) >= 0.05
            ],
        ),
    }


def _short(sigma: float) -> str:
    """Return a significance in at most four characters."""
    return f"{sigma:.1f}" if sigma < 9.95 else f"{sigma:.0f}" if sigma < 99.5 else "99+"


@dataclass(frozen=True)
class _ResidualImages:
    """One frame's residual images by both models."""

    side: Side
    kind: str
    capture: str
    held_out: bool
    before: str
    after: str
    rms_before: str
    rms_after: str

    @classmethod
    def of(cls, picture: ResidualPicture) -> _ResidualImages:
        before, after = np.asarray(picture.before), np.asarray(picture.after)
        return cls(
            side=picture.side,
            kind=picture.kind,
            capture=picture.capture,
            held_out=picture.held_out,
            before=difference_picture(before, PICTURE_LIMIT),
            after=difference_picture(after, PICTURE_LIMIT),
            rms_before=f"{np.sqrt(np.mean(np.square(before))):.2f}",
            rms_after=f"{np.sqrt(np.mean(np.square(after))):.2f}",
        )


@dataclass(frozen=True)
class _Detectable:
    """One effect's cells in the table of detectable effects."""

    smallest: str
    nearest: str | None
    cosine: float
    told_apart: float


def _visibility(items: Sequence[Visibility]) -> dict[str, dict[Side, _Detectable]]:
    """Effect -> side -> cells of the table, in the order of the names."""
    table: dict[str, dict[Side, _Detectable]] = {}
    for item in sorted(items, key=lambda item: item.effect):
        declared = library()[item.effect].quantities()
        quantities = {
            told_as(name, quantity, gain_is_known=known): quantity
            for name, quantity in declared.items()
            for known in (True, False)
        }
        units = {name: (unit, quantity) for (name, unit), quantity in quantities.items()}
        sizes = [_smallest_size(name, value, *units[name]) for name, value in item.smallest.items()]
        text = ", ".join(sizes) or "detectable at any magnitude"
        table.setdefault(item.effect, {})[item.side] = _Detectable(text, item.nearest, item.cosine, item.told_apart)
    return table


def _smallest_size(name: str, value: float, unit: str, quantity: Quantity) -> str:
    """Return the least detectable size of a parameter, or that none within its bounds is detectable."""
    said = name.removesuffix("_" + ("percent" if unit == "%" else unit.lower())).replace("_", " ")
    size = f"{plain_number(value, 2)} {format_unit(unit)}".strip()
    away = [abs(bound - (quantity.absent or 0.0)) for bound in (quantity.lower, quantity.upper) if bound is not None]
    if away and value > max(away):
        return f"{said}: not detectable below {size}, which is beyond its bounds"
    return f"{said} {size}"
