"""The first screen's charts as static SVG: what a print shows that is made before the page's script has drawn, a reader
without scripts sees, and everybody does until the script draws the chart proper in its place.

Of Plotly's figures it knows what those charts have: scatter traces with lines, markers, error bars and bands on one
abscissa and ordinates one above the other, and rectangles across the whole width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from markupsafe import Markup

from lab.report.charts import Figure, Trace

#: Width (px) of the drawing, as of a chart on a desk; it is scaled to the page's.
WIDTH = 620.0
LEFT, RIGHT, BOTTOM = 66.0, 14.0, 46.0
#: Mean width of a letter (em), for what has to fit beside something.
LETTER_EM = 0.56
DASHES = {"dash": "7 5", "dot": "2 4"}
STEPS = (1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True)
class _Scale:
    """From values `low`..`high` to pixels `start`..`end`."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self, most: int) -> list[float]:
        """Round values in the range, `most` intervals at most."""
        raw = (self.high - self.low) / most
        power = 10.0 ** math.floor(math.log10(raw))
        step = next(power * factor for factor in STEPS if power * factor >= raw * (1 - 1e-9))
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [n * step for n in range(first, last + 1)]


def _style(**properties: str | float) -> str:
    """Return a style attribute; the page's colours by their names."""
    named = {"@fg": "var(--fg)", "@muted": "var(--muted)", "@grid": "var(--grid)"}
    return ";".join(f"{key.replace('_', '-')}:{named.get(str(value), value)}" for key, value in properties.items())


def _text(x: float, y: float, words: str, *, anchor: str = "start", size: float = 12, more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}"{more}>{escape(words)}</text>'


def _number(value: float) -> str:
    """Return a tick's label."""
    return f"{round(value, 12) + 0.0:g}".replace("-", "\N{MINUS SIGN}")


def _pairs(trace: Trace, key: str) -> Iterator[tuple[float, float, float]]:
    """(x, y, half of the error bar) of its points, without those that have no number. `key`: `error_x` or `error_y`."""
    bars = trace.get(key, {}).get("array") or [0.0] * len(trace["x"])
    for x, y, half in zip(trace["x"], trace["y"], bars, strict=True):
        if x is not None and y is not None and math.isfinite(x) and math.isfinite(y):
            yield x, y, half if half is not None and math.isfinite(half) else 0.0


def _range(axis: dict[str, Any], values: Iterable[float]) -> tuple[float, float]:
    """Return the range that a figure states, else that of the values with a margin; 0 in it where it is asked for."""
    low, high = axis.get("range", (0.0, 0.0))
    if math.isfinite(high - low) and low < high:
        return low, high
    every = list(values) or [0.0, 1.0]
    low, high = min(every), max(every)
    margin = 0.05 * (high - low) or 0.5 * abs(high) or 1.0
    to_zero = axis.get("rangemode") == "tozero"
    return (min(0.0, low) if to_zero else low - margin), high + margin


def _legend(data: Sequence[Trace]) -> tuple[list[str], float]:
    """Its entries, and its height."""
    parts: list[str] = []
    x, y = LEFT, 14.0
    for trace in data:
        if not trace.get("showlegend", True):
            continue
        wide = 30.0 + 11 * LETTER_EM * len(trace["name"]) + 14.0
        if x + wide > WIDTH - RIGHT and x > LEFT:
            x, y = LEFT, y + 17.0
        if "lines" in trace["mode"]:
            parts.append(f'<path d="M{x:.1f} {y - 4:.1f}h22" style="{_line_style(trace["line"])}"/>')
        if "markers" in trace["mode"]:
            parts.append(_dots([(x + 11, y - 4)], trace["marker"]))
        parts.append(_text(x + 28, y, trace["name"], size=11))
        x += wide
    return parts, y


def _line_style(line: dict[str, Any]) -> str:
    dash = DASHES.get(line.get("dash", "solid"), "none")
    return _style(stroke=line["color"], stroke_width=line["width"], stroke_dasharray=dash, fill="none")


def _dots(points: Iterable[tuple[float, float]], marker: dict[str, Any]) -> str:
    """Markers as one path: round ends of lines without length, or small circles."""
    size = float(marker["size"])
    if marker.get("symbol") == "circle-open":
        ring = (
            f"m{-size / 2:g} 0a{size / 2:g} {size / 2:g} 0 1 0 {size:g} 0a{size / 2:g} {size / 2:g} 0 1 0 {-size:g} 0"
        )
        path = "".join(f"M{x:.1f} {y:.1f}{ring}" for x, y in points)
        return f'<path d="{path}" style="{_style(stroke=marker["color"], stroke_width=1, fill="none")}"/>'
    if str(marker.get("symbol")).startswith("triangle"):
        rise = size if marker["symbol"] == "triangle-up" else -size
        path = "".join(f"M{x:.1f} {y - rise / 2:.1f}l{size / 2:g} {rise:g}h{-size:g}z" for x, y in points)
        return f'<path d="{path}" style="{_style(fill=marker["color"])}"/>'
    path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
    return f'<path d="{path}" style="{_style(stroke=marker["color"], stroke_width=size, stroke_linecap="round")}"/>'


def _trace(trace: Trace, x_of: _Scale, y_of: _Scale) -> Iterator[str]:
    if trace.get("fill") == "toself":  # an uncertainty band
        outline = "L".join(f"{x_of(x):.1f} {y_of(y):.1f}" for x, y, _ in _pairs(trace, ""))
        yield f'<path d="M{outline}Z" style="{_style(fill=trace["fillcolor"], stroke="none")}"/>'
        return
    bars = [
        f"M{x_of(x):.1f} {y_of(y - half):.1f}V{y_of(y + half):.1f}" for x, y, half in _pairs(trace, "error_y") if half
    ]
    bars += [
        f"M{x_of(x - half):.1f} {y_of(y):.1f}H{x_of(x + half):.1f}" for x, y, half in _pairs(trace, "error_x") if half
    ]
    if bars:
        colour = trace["marker"]["color"]
        yield f'<path d="{"".join(bars)}" style="{_style(stroke=colour, stroke_width=1)}"/>'
    points = [(x_of(x), y_of(y)) for x, y, _ in _pairs(trace, "")]
    if "lines" in trace["mode"] and points:
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
        yield f'<path d="{path}" style="{_line_style(trace["line"])}"/>'
    if "markers" in trace["mode"]:
        yield _dots(points, trace["marker"])


def _abscissa(axis: dict[str, Any], x_of: _Scale, bottom: float, height: float) -> Iterator[str]:
    named = "tickvals" in axis
    places = axis["tickvals"] if named else x_of.ticks(8)
    names = axis["ticktext"] if named else [_number(place) for place in places]
    for place, name in zip(places, names, strict=True):
        x, y = x_of(place), bottom + (14.0 if named else 17.0)
        yield f'<path d="M{x:.1f} {bottom:.1f}v4" style="{_style(stroke="@muted")}"/>'
        turned = f' transform="rotate(-45 {x:.1f} {y:.1f})"' if named else ""
        yield _text(x, y, str(name), anchor="end" if named else "middle", size=9 if named else 12, more=turned)
    yield _text(0.5 * (x_of.start + x_of.end), height - 6, axis["title"]["text"], anchor="middle")


def _ordinate(axis: dict[str, Any], y_of: _Scale) -> Iterator[str]:
    left, right = LEFT, WIDTH - RIGHT
    ticks = axis.get("tickvals") or y_of.ticks(max(2, round((y_of.start - y_of.end) / 40)))
    names = axis.get("ticktext") or [_number(tick) for tick in ticks]
    for tick, name in zip(ticks, names, strict=True):
        y = y_of(tick)
        yield f'<path d="M{left} {y:.1f}H{right}" style="{_style(stroke="@grid")}"/>'
        yield _text(left - 7, y + 4, name, anchor="end")
    lines = axis["title"]["text"].split("<br>")
    middle = 0.5 * (y_of.start + y_of.end)
    for number, line in enumerate(lines):
        x = 14.0 + 14.0 * number - (14.0 if len(lines) > 2 else 0.0)
        yield _text(x, middle, line, anchor="middle", more=f' transform="rotate(-90 {x:.1f} {middle:.1f})"')


def still(figure: Figure, number: int) -> Markup:
    """Return a figure as SVG, in the page's colours. `number`: of the chart on its page, for ids that differ."""
    layout, data = figure["layout"], figure["data"]
    height = float(layout["height"])
    legend, legend_px = _legend(data)
    x_axis = layout["xaxis"]
    longest = max((len(str(name)) for name in x_axis.get("ticktext", ())), default=0)
    top, bottom = legend_px + 12.0, height - BOTTOM - 9 * LETTER_EM * longest * math.sqrt(0.5)
    abscissae = (end for trace in data for x, _, half in _pairs(trace, "error_x") for end in (x - half, x + half))
    x_of = _Scale(*_range(x_axis, abscissae), LEFT, WIDTH - RIGHT)
    parts = [*legend, *_abscissa(x_axis, x_of, bottom, height)]
    for key in sorted(name for name in layout if name.startswith("yaxis")):
        axis, id = layout[key], key.replace("axis", "")
        low, high = axis.get("domain", (0.0, 1.0))
        mine = [trace for trace in data if trace.get("yaxis", "y") == id]
        shapes = [shape for shape in layout.get("shapes", ()) if shape["yref"] == id]
        values = [end for trace in mine for _, y, half in _pairs(trace, "error_y") for end in (y - half, y + half)]
        values += [shape[end] for shape in shapes for end in ("y0", "y1")]
        y_of = _Scale(*_range(axis, values), bottom - low * (bottom - top), bottom - high * (bottom - top))
        for shape in shapes:
            at = f'y="{y_of(shape["y1"]):.1f}" height="{y_of(shape["y0"]) - y_of(shape["y1"]):.1f}"'
            parts.append(f'<rect x="{LEFT}" width="{x_of.end - LEFT}" {at} style="{_style(fill=shape["fillcolor"])}"/>')
        parts += _ordinate(axis, y_of)
        clip = f"still-{number}-{id}"
        parts.append(
            f'<clipPath id="{clip}"><rect x="{LEFT - 4}" y="{y_of.end - 2:.1f}" width="{x_of.end - LEFT + 8}" '
            f'height="{y_of.start - y_of.end + 4:.1f}"/></clipPath><g clip-path="url(#{clip})">'
        )
        parts += [part for trace in mine for part in _trace(trace, x_of, y_of)]
        parts.append("</g>")
    for note in layout.get("annotations", ()):
        if note.get("xref") != "paper":
            continue  # stands at a place of the data, and needs the chart proper
        x, y = LEFT + note["x"] * (x_of.end - LEFT), bottom - note["y"] * (bottom - top)
        colour = f' style="{_style(fill=note["font"]["color"])}"'
        parts.append(_text(x, y - 3, note["text"], size=note["font"]["size"], more=colour))
    named = escape(str(layout["yaxis"]["title"]["text"]).replace("<br>", " "), quote=True)
    opening = (
        f'<svg class="still" aria-label="{named}" viewBox="0 0 {WIDTH:g} {height:g}" style="{_style(fill="@fg")}" '
        'role="img">'
    )
    return Markup(opening + "".join(parts) + "</svg>")  # its texts are escaped
