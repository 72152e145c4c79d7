"""The standards' pages: one a standard, and an overview. What is drawn in the PDF (`standards_pdf`) is composed here,
too."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult
from lab.formats.results.standards import (
    Deviation,
    PlotCurve,
    StandardFigure,
    StandardMap,
    StandardPlot,
    StandardReading,
    StandardsResult,
)
from lab.formats.results.words import format_unit, format_value
from lab.report import page_environment, write_page
from lab.report.charts import (
    AFTER,
    BEFORE,
    CHANNEL,
    ChartData,
    Figure,
    Trace,
    axis,
    error_bars,
    layout,
    log_axis,
    plotly_base64,
)
from lab.report.emva import spatial_plots, temporal_plots

#: Most subjects that stand beside each other in one table.
MOST_COLUMNS = 4
#: Most readings of one standard whose plots are shown.
MOST_PLOTTED = 4
NOT_BY = "not by the standard"


@dataclass(frozen=True)
class StandardsPicture:
    """A chart with its title and caption."""

    title: str
    figure: Figure
    caption: str


@dataclass(frozen=True)
class StandardRow:
    """One figure of a standard in a table: a text a subject, in the figure's unit; `marks`: whether each is by the
    standard."""

    figure: StandardFigure
    values: tuple[str, ...]
    marks: tuple[bool, ...]
    reason: str

    @property
    def unit(self) -> str:
        """The unit as it is shown; empty of a ratio."""
        return format_unit(self.figure.unit)


@dataclass(frozen=True)
class FigureTable:
    """Figures of subjects that stand beside each other."""

    subjects: tuple[str, ...]
    rows: tuple[StandardRow, ...]


@dataclass(frozen=True)
class StandardSection:
    """All of one standard on one side."""

    standard: str
    title: str
    side: str
    conditions: tuple[str, ...]
    tables: tuple[FigureTable, ...]
    deviations: tuple[str, ...]
    remarks: tuple[str, ...]
    pictures: tuple[StandardsPicture, ...]

    @property
    def figures(self) -> int:
        """Number of figures with a value."""
        return sum(text != "–" for table in self.tables for row in table.rows for text in row.values)

    @property
    def by_the_standard(self) -> int:
        """Number of these that are by the standard."""
        return sum(mark for table in self.tables for row in table.rows for mark in row.marks)


def file_name(standard: str) -> str:
    """Return the name of a standard's page, without its ending.

    >>> file_name("ISO 12233:2023")
    'iso-12233-2023'
    """
    return re.sub(r"[^a-z0-9]+", "-", standard.lower()).strip("-")


def plot_figure(plot: StandardPlot) -> Figure:
    """Return a plot as a Plotly figure."""
    data: list[Trace] = []
    for number, curve in enumerate(plot.curves):
        data.append(_trace(curve, CHANNEL.get(curve.channel, (AFTER, BEFORE, "#777777")[number % 3])))
    values_x = [x for curve in plot.curves for x in curve.x]
    values_y = [y for curve in plot.curves for y in curve.y]
    x_log, y_log = plot.logarithmic
    return {
        "data": data,
        "layout": layout(
            320,
            xaxis=log_axis(plot.x_label, values_x) if x_log else axis(plot.x_label),
            yaxis=log_axis(plot.y_label, values_y) if y_log else axis(plot.y_label),
            margin={"l": 56, "r": 14, "t": 46, "b": 44},
        ),
    }


def _trace(curve: PlotCurve, colour: str) -> Trace:
    trace: Trace = {
        "type": "scatter",
        "name": curve.label,
        "x": list(curve.x),
        "y": list(curve.y),
        "mode": "markers" if curve.style == "points" else "lines",
        "marker": {"color": colour, "size": 5},
        "line": {"color": colour, "width": 1.6, "dash": "dash" if curve.style == "dashed" else "solid"},
    }
    if curve.style == "points" and curve.y_std:
        trace["error_y"] = error_bars(curve.y_std, colour)
    return trace


def map_figure(plane: StandardMap) -> Figure:
    """Return a map as a Plotly figure, rows from the top."""
    return {
        "data": [
            {
                "type": "heatmap",
                "z": [list(row) for row in plane.values],
                "colorscale": "Viridis",
                "colorbar": {"title": {"text": plane.unit}, "thickness": 12},
                "hoverongaps": False,
                "name": plane.title,
            }
        ],
        "layout": layout(
            320,
            xaxis=axis("columns of cells", showgrid=False),
            yaxis=axis("rows of cells", autorange="reversed", showgrid=False),
        ),
    }


def _value(figure: StandardFigure) -> str:
    if figure.estimate is None:
        return "–"
    return format_value(figure.estimate.value, figure.estimate.std)


def _tables(readings: Sequence[StandardReading]) -> Iterator[FigureTable]:
    """Yield tables of readings with the same figures, at most `MOST_COLUMNS` beside each other."""
    groups: dict[tuple[str, ...], list[StandardReading]] = {}
    for reading in readings:
        groups.setdefault(tuple(figure.name for figure in reading.figures), []).append(reading)
    for alike in groups.values():
        for begin in range(0, len(alike), MOST_COLUMNS):
            part = alike[begin : begin + MOST_COLUMNS]
            rows = []
            for each in zip(*(reading.figures for reading in part), strict=True):
                reasons = dict.fromkeys(figure.reason for figure in each if figure.reason)
                rows.append(
                    StandardRow(
                        figure=each[0],
                        values=tuple(_value(figure) for figure in each),
                        marks=tuple(figure.by_the_standard for figure in each),
                        reason="; ".join(reasons),
                    )
                )
            yield FigureTable(tuple(reading.subject for reading in part), tuple(rows))


def _lines(readings: Sequence[StandardReading], kind: str) -> tuple[str, ...]:
    """Return the deviations or remarks of readings, each once, with the subjects that it concerns where not all."""
    readings_of_line: dict[str, list[StandardReading]] = {}
    for reading in readings:
        for remark in getattr(reading, kind):
            readings_of_line.setdefault(remark.line if isinstance(remark, Deviation) else remark, []).append(reading)

    def names(reading: StandardReading) -> tuple[str, ...]:
        return tuple(figure.name for figure in reading.figures)

    lines = []
    for line, of in readings_of_line.items():
        # whether a standard that reads one subject as a whole, too, has it there or not makes no difference
        kinds = {names(reading) for reading in of}
        every = all(reading in of for reading in readings if names(reading) in kinds)
        subjects = dict.fromkeys(reading.subject for reading in of)
        lines.append(line if every else f"{', '.join(subjects)}: {line}")
    return tuple(lines)


def _pictures(
    readings: Sequence[StandardReading], recordings: RecordingSet | None, fit: FitResult | None
) -> Iterator[StandardsPicture]:
    for number, reading in enumerate(readings):
        of = f", {reading.subject}" if len(readings) > 1 else ""
        for plane in reading.maps:
            yield StandardsPicture(f"{plane.title}{of}", map_figure(plane), plane.caption)
        if number < MOST_PLOTTED:
            for plot in reading.plots:
                yield StandardsPicture(f"{plot.title}{of}", plot_figure(plot), plot.caption)
    first = readings[0]
    if recordings is not None and fit is not None and first.standard.startswith("EMVA 1288 R4.0 Linear"):
        yield from _data_sheet(first, recordings, fit)


def _data_sheet(reading: StandardReading, recordings: RecordingSet, fit: FitResult) -> Iterator[StandardsPicture]:
    """Yield the pictures of EMVA 1288's data sheet: photon transfer to profiles, of the green or only plane."""
    noise = fit.cameras[reading.side].noise
    if noise is None:
        return
    plane = next(name for name in ("Y", "G1", *noise.emva1288) if name in noise.emva1288)
    figures = noise.emva1288[plane]
    for plot in (*temporal_plots(figures, plane), *spatial_plots(recordings, reading.side, figures, plane)):
        yield StandardsPicture(f"{plot.title}, plane {plane}", plot.figure, plot.caption)


def sections(
    result: StandardsResult, recordings: RecordingSet | None = None, fit: FitResult | None = None
) -> list[StandardSection]:
    """Return the standards by name and side. `recordings`, `fit`: of the same set, for EMVA 1288's pictures; None:
    without these."""
    groups: dict[tuple[str, str], list[StandardReading]] = {}
    for reading in result.readings:
        groups.setdefault((reading.standard, reading.side), []).append(reading)
    return [
        StandardSection(
            standard=standard,
            title=readings[-1].title,
            side=side,
            conditions=tuple(dict.fromkeys(line for reading in readings for line in reading.conditions))
            if len(readings) <= MOST_COLUMNS
            else readings[0].conditions,
            tables=tuple(_tables(readings)),
            deviations=_lines(readings, "deviations"),
            remarks=_lines(readings, "remarks"),
            pictures=tuple(_pictures(readings, recordings, fit)),
        )
        for (standard, side), readings in groups.items()
    ]


def write_standards(
    folder: Path, result: StandardsResult, recordings: RecordingSet, standard_sections: Sequence[StandardSection]
) -> Path:
    """Write `folder`/standards.html, the overview, and one page for each standard; return the overview's path.
    `standard_sections`: what `sections` returns. Raises InputError where one can't be written."""
    environment = page_environment()
    shared: dict[str, Any] = {
        "version": metadata.version("calibench"),
        "made": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "name": recordings.manifest.name or result.source,
        "plotly": "",
    }
    names = dict.fromkeys(section.standard for section in standard_sections)
    for name in names:
        own_sections = [section for section in standard_sections if section.standard == name]
        page = environment.get_template("standard.html").render(
            shared
            | {
                "standard": name,
                "sections": own_sections,
                "chart_data": ChartData(),
                "plotly": plotly_base64(),
                "not_by": NOT_BY,
            }
        )
        write_page(folder / f"{file_name(name)}.html", page)
    overview = environment.get_template("standards.html").render(
        shared
        | {
            "sections": [(section, f"{file_name(section.standard)}.html") for section in standard_sections],
            "skipped": result.skipped,
            "chart_data": ChartData(),
        }
    )
    return write_page(folder / "standards.html", overview)
