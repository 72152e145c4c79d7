"""All standards as one PDF, as a laboratory hands it to a customer: overview, tables, requirements, pictures.

Pages are drawn by matplotlib (calibench's extra `pdf`). The pictures are the pages' own Plotly figures, of which
`draw_figure` knows scatter traces, bars and heat maps on one or two pairs of axes.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lab.errors import InputError, cannot_write
from lab.formats.raw_file import replacing
from lab.formats.results.standards import StandardsResult
from lab.report.charts import Figure, Trace
from lab.report.standards import NOT_BY, StandardSection, StandardsPicture
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure as Page

PAGE_IN = (8.27, 11.69)  # A4
LEFT, RIGHT, TOP, BOTTOM = 0.08, 0.95, 0.94, 0.06
LINE = 0.0135  # of the page's height
BODY_PT, SMALL_PT, HEAD_PT, TITLE_PT = 8.0, 6.8, 10.0, 15.0
ROW_HEIGHT = 0.285  # of a row of pictures, of the page's height
LONGEST_LABEL = 34  # characters of a legend's entry
NAMED = {"@fg": "#1b1b1b", "@muted": "#777777", "@grid": "#dddddd"}
DASHES = {"solid": "-", "dash": "--", "dot": ":"}
WRAPPED = 118  # characters of a line of body text
#: Markup that Plotly takes in labels -> matplotlib's.
MARKUP = {"<sub>": "$_{", "</sub>": "}$", "<sup>": "$^{", "</sup>": "}$", "<br>": " "}


def _plain(text: str) -> str:
    for plotly, mathtext in MARKUP.items():
        text = text.replace(plotly, mathtext)
    return text


def _colour(value: Any) -> Any:
    if isinstance(value, str) and value.startswith("rgba("):
        red, green, blue, opacity = (float(part) for part in value[5:-1].split(","))
        return red / 255.0, green / 255.0, blue / 255.0, opacity
    return NAMED.get(value, value)


def draw_figure(axes: Sequence[Axes], figure: Figure) -> None:
    """Draw a Plotly figure's traces on matplotlib's axes: the first for traces of axis x and y, the second for those of
    x2 or y2."""
    made = figure["layout"]
    for trace in figure["data"]:
        second = len(axes) > 1 and "2" in str(trace.get("xaxis", "")) + str(trace.get("yaxis", ""))
        _draw_trace(axes[1 if second else 0], trace)
    for number, ax in enumerate(axes):
        of_x, of_y = (made.get(f"{key}axis2" if number else f"{key}axis", made[f"{key}axis"]) for key in "xy")
        for key, settings in (("x", of_x), ("y", of_y)):
            getattr(ax, f"set_{key}label")(_plain(settings.get("title", {}).get("text", "")), fontsize=SMALL_PT)
            if settings.get("type") == "log":
                getattr(ax, f"set_{key}scale")("log")
            if "range" in settings:
                low, high = settings["range"]
                ends = (10.0**low, 10.0**high) if settings.get("type") == "log" else (low, high)
                getattr(ax, f"set_{key}lim")(*ends)
        ax.tick_params(labelsize=SMALL_PT - 0.8, length=2.5, which="both")
        if not ax.images:
            ax.grid(visible=True, color=NAMED["@grid"], linewidth=0.4)
        ax.set_axisbelow(True)
        names = ax.get_legend_handles_labels()[1]
        if names:
            ax.legend(fontsize=SMALL_PT - 1.5, frameon=False, loc="best")


def _draw_trace(ax: Axes, trace: Trace) -> None:
    full = _plain(trace.get("name", "")) if trace.get("showlegend", True) else "_"
    name = full if "$" in full else textwrap.shorten(full, LONGEST_LABEL, placeholder="…")
    if trace["type"] == "heatmap":
        values = np.array([[np.nan if v is None else v for v in row] for row in trace["z"]], float)
        drawn = ax.imshow(values, aspect="auto", cmap="viridis", interpolation="nearest")
        bar = ax.figure.colorbar(drawn, ax=ax, fraction=0.05, pad=0.02)
        bar.ax.tick_params(labelsize=SMALL_PT - 0.8)
        bar.set_label(trace["colorbar"]["title"]["text"], fontsize=SMALL_PT)
        return
    x, y = np.array(trace["x"], float), np.array(trace["y"], float)
    if trace["type"] == "bar":
        width = float(np.diff(x).min()) if x.size > 1 else 1.0
        ax.bar(x, y, width=0.95 * width, color=_colour(trace["marker"]["color"]))
        return
    if trace.get("fill") == "toself":
        ax.fill(x, y, color=_colour(trace["fillcolor"]), linewidth=0)
        return
    mode, line, marker = trace.get("mode", "lines"), trace.get("line", {}), trace.get("marker", {})
    colour = _colour(line.get("color") or marker.get("color"))
    style = DASHES.get(line.get("dash", "solid"), "-") if "lines" in mode else "none"
    x_err, y_err = (_spans(trace.get(f"error_{key}", {}).get("array")) for key in "xy")
    if x_err is not None or y_err is not None:
        ax.errorbar(x, y, xerr=x_err, yerr=y_err, fmt="none", ecolor=colour, elinewidth=0.6)
    points = "o" if "markers" in mode else "none"
    ax.plot(
        x, y, linestyle=style, linewidth=0.9, color=colour, label=name or "_", marker=points, markersize=3.4,
        markeredgewidth=0,
    )  # fmt: skip


def _spans(errors: Sequence[float | None] | None) -> FloatArray | None:
    """Return the lengths of error bars, 0 where there is none; None without any."""
    return np.array([v or 0.0 for v in errors], float) if errors else None


class _Sheet:
    """Pages of text from top to bottom; a new page begins where one is full."""

    def __init__(self, pages: PdfPages, running: str) -> None:
        from matplotlib.figure import Figure as MatplotlibFigure

        self._new: Any = MatplotlibFigure
        self.pages, self.running, self.number = pages, running, 0
        self.page: Page | None = None
        self.y = 0.0

    def begin(self) -> Page:
        """Begin a page; the one before is written."""
        self.end()
        self.number += 1
        self.page = self._new(figsize=PAGE_IN)
        self.page.text(LEFT, 0.03, self.running, fontsize=SMALL_PT, color=NAMED["@muted"])
        self.page.text(RIGHT, 0.03, f"{self.number}", fontsize=SMALL_PT, ha="right", color=NAMED["@muted"])
        self.y = TOP
        return self.page

    def end(self) -> None:
        """Write the page."""
        if self.page is not None:
            self.pages.savefig(self.page)
            self.page = None

    def room(self, lines: float) -> Page:
        """Return the page that has room for so many lines."""
        if self.page is None or self.y - lines * LINE < BOTTOM:
            return self.begin()
        return self.page

    def text(
        self, words: str, size: float = BODY_PT, colour: str = "#1b1b1b", indent: float = 0.0, **more: Any
    ) -> None:
        """Write wrapped lines."""
        lines = textwrap.wrap(words, int(WRAPPED * BODY_PT / size * (1.0 - indent))) or [""]
        for line in lines:
            page = self.room(1.2)
            self.y -= LINE * size / BODY_PT
            page.text(LEFT + indent, self.y, line.replace("$", r"\$"), fontsize=size, color=colour, **more)

    def gap(self, lines: float = 0.6) -> None:
        """Leave room."""
        self.y -= lines * LINE

    def row(self, cells: Sequence[tuple[float, str, str]], size: float = SMALL_PT, weight: str = "normal") -> None:
        """Write the cells (place, text, colour) of one row of a table."""
        page = self.room(1.2)
        self.y -= LINE * 0.95
        for place, words, colour in cells:
            right = place < 0
            page.text(
                abs(place),
                self.y,
                words.replace("$", r"\$"),
                fontsize=size,
                color=colour,
                weight=weight,
                ha="right" if right else "left",
            )


def has_matplotlib() -> bool:
    """Return whether matplotlib is installed. Its distribution is asked for: where it isn't, colour-science puts
    modules of that name in its place, which can be imported and draw nothing."""
    try:
        metadata.version("matplotlib")
    except metadata.PackageNotFoundError:
        return False
    return True


def check_pdf() -> None:
    """Raise InputError where matplotlib isn't installed, before anything is computed for a PDF."""
    if not has_matplotlib():
        raise InputError("--pdf: matplotlib isn't installed; pip install 'calibench[pdf]'")


def write_standards_pdf(file: Path, result: StandardsResult, sections: Sequence[StandardSection], name: str) -> Path:
    """Write all standards as the PDF `file`: completely, or not at all. `sections`: what the pages hold; `name`: of the
    recordings. Raises InputError where matplotlib isn't installed or the file can't be written."""
    check_pdf()
    import matplotlib as mpl
    from matplotlib.backends.backend_pdf import PdfPages

    made = datetime.now(UTC)
    running = f"{name}; calibench {metadata.version('calibench')}, {made:%Y-%m-%d %H:%M} UTC"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with (
            replacing(file) as partial,
            mpl.rc_context({"pdf.fonttype": 42, "axes.linewidth": 0.5, "font.family": "DejaVu Sans"}),
            PdfPages(partial, metadata={"Title": f"Standards: {name}", "CreationDate": made}) as pages,
        ):
            sheet = _Sheet(pages, running)
            _overview(sheet, result, sections, name)
            for section in sections:
                _section(sheet, section)
            sheet.end()
    except OSError as error:
        raise cannot_write(file, error, "name another place") from error
    return file


def _overview(sheet: _Sheet, result: StandardsResult, sections: Sequence[StandardSection], name: str) -> None:
    sheet.begin()
    sheet.text("Camera by the standards", TITLE_PT, weight="bold")
    sheet.gap()
    sheet.text(name, HEAD_PT)
    sheet.gap()
    fg, muted = NAMED["@fg"], NAMED["@muted"]
    sheet.row(
        [(LEFT, "standard", muted), (0.33, "what", muted), (-0.70, "figures", muted), (-0.78, "by it", muted),
         (-RIGHT, "requirements not met", muted)]
    )  # fmt: skip
    for section in sections:
        label = f"{section.standard} ({section.side})"
        sheet.row(
            [(LEFT, label, fg), (0.33, textwrap.shorten(section.title, 46, placeholder="…"), fg),
             (-0.70, f"{section.figures}", fg), (-0.78, f"{section.by_the_standard}", fg),
             (-RIGHT, f"{len(section.deviations)}", fg)]
        )  # fmt: skip
    if result.skipped:
        sheet.gap(1.5)
        sheet.text("Not determined", HEAD_PT, weight="bold")
        for item in result.skipped:
            sheet.text(f"{item.step} ({item.side}): {item.reason}", SMALL_PT)


def _section(sheet: _Sheet, section: StandardSection) -> None:
    sheet.begin()
    fg, muted, off = NAMED["@fg"], NAMED["@muted"], "#b26a00"
    sheet.text(f"{section.standard}: {section.title}", 12.0, weight="bold")
    sheet.gap(0.3)
    sheet.text("; ".join((f"{section.side} camera", *section.conditions)) + ".", SMALL_PT, muted)
    sheet.gap()
    if section.deviations:
        sheet.text(f"Requirements that the recordings don't meet; figures that they bear on (*) are {NOT_BY}", HEAD_PT)
        for line in section.deviations:
            sheet.text(f"– {line}", SMALL_PT, off)
    else:
        sheet.text("All requirements that can be checked are met.", BODY_PT)
    sheet.gap()
    for table in section.tables:
        columns = len(table.subjects)
        width = 0.51 / columns if columns > 1 else 0.2
        places = [-(0.44 + width * (k + 1)) for k in range(columns)]
        if columns > 1:
            sheet.room(4)
            for k, subject in enumerate(table.subjects):
                if len(subject) > 90 / columns:
                    sheet.text(f"({k + 1}) {subject}", SMALL_PT, muted)
        heads = [subject if len(subject) <= 90 / columns else f"({k + 1})" for k, subject in enumerate(table.subjects)]
        sheet.row(
            [(LEFT, "quantity", muted), (0.37, "clause", muted), (0.42, "unit", muted)]
            + [(place, head, muted) for place, head in zip(places, heads, strict=True)]
        )
        for row in table.rows:
            label = textwrap.shorten(row.figure.quantity, 58, placeholder="…")
            marked = [
                (place, text if mark or text == "–" else f"{text} *", fg if mark or text == "–" else off)
                for place, text, mark in zip(places, row.values, row.marks, strict=True)
            ]
            start = [(LEFT, label, fg), (0.37, row.figure.clause, muted), (0.42, row.unit, muted)]
            sheet.row([*start, *marked], SMALL_PT - 0.6)
        sheet.gap()
    for line in section.remarks:
        sheet.text(f"{line[0].upper()}{line[1:]}.", SMALL_PT, muted)
    _draw_pictures(sheet, section.pictures)


def _draw_pictures(sheet: _Sheet, pictures: Sequence[StandardsPicture]) -> None:
    """Draw pictures, two in a row, below the text where there is room."""
    for begin in range(0, len(pictures), 2):
        page = sheet.room(ROW_HEIGHT / LINE)
        bottom = sheet.y - ROW_HEIGHT + 0.045
        sheet.y -= ROW_HEIGHT
        for column, picture in enumerate(pictures[begin : begin + 2]):
            left = LEFT + 0.02 + 0.46 * column
            made = picture.figure["layout"]
            if "xaxis2" in made:
                axes = [page.add_axes((left, bottom, 0.165, 0.19)), page.add_axes((left + 0.22, bottom, 0.165, 0.19))]
            elif "yaxis2" in made:
                axes = [page.add_axes((left, bottom + 0.1, 0.37, 0.09)), page.add_axes((left, bottom, 0.37, 0.085))]
            else:
                axes = [page.add_axes((left, bottom, 0.37, 0.19))]
            draw_figure(axes, picture.figure)
            if "yaxis2" in made and "xaxis2" not in made:
                axes[0].set_xlabel("")
                axes[0].tick_params(labelbottom=False)
            title = textwrap.shorten(picture.title, 52, placeholder="…")
            page.text(left - 0.03, bottom + 0.203, _plain(title), fontsize=BODY_PT, weight="bold")
