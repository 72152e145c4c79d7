"""Pictures of the evaluation as SVG: rows on an axis, a matrix of counts, and curves of power."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np

#: Colours: of a right answer, a wrong one, and none.
RIGHT, WRONG, ABSTAINED = "#2f7d4f", "#b3372f", "#8a8f98"
MEASURED, ORACLE = "#1f5fa8", "#8a8f98"
INK, GRID, LIMIT = "#222", "#ddd", "#555"
#: Of plots of rows: width of the labels and of the axis, height of a row and of the head.
LABEL_PX, PLOT_PX, ROW_PX, HEAD_PX = 400, 420, 20, 44
CELL_PX, NAMES_PX, TURNED_PX = 24, 210, 225

Anchor = Literal["start", "middle", "end"]


class Plot:
    """An SVG picture that grows by its parts; coordinates in pixels from the upper left corner."""

    def __init__(self, width: float, height: float) -> None:
        size = f'width="{width:.0f}" height="{height:.0f}"'
        self.parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="12">',
            f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
        ]

    def text(
        self, x: float, y: float, words: str, anchor: Anchor = "start", fill: str = INK, more: str = ""
    ) -> None:  # fmt: skip
        """Write words. `more`: further attributes."""
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{fill}"{more}>{escape(words)}</text>'
        )

    def path(self, points: str, ink: str, width: float = 1.0) -> None:
        """Draw a path of SVG's commands."""
        self.parts.append(f'<path d="{points}" fill="none" stroke="{ink}" stroke-width="{width:g}"/>')

    def dot(self, x: float, y: float, fill: str, radius: float = 4.0, more: str = "") -> None:
        """Draw a disc."""
        self.parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{fill}"{more}/>')

    def box(self, x: float, y: float, width: float, height: float, fill: str, more: str = "") -> None:
        """Draw a filled rectangle."""
        self.parts.append(f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:g}" height="{height:g}" fill="{fill}"{more}/>')

    def svg(self) -> str:
        """Return the picture's text."""
        return "\n".join([*self.parts, "</svg>\n"])


@dataclass(frozen=True)
class Axis:
    """A horizontal axis. Values beyond its ends are drawn there. `limit`: the tick that is drawn as one."""

    low: float
    high: float
    ticks: Sequence[float]
    limit: float
    is_logarithmic: bool = False

    def share(self, value: float) -> float:
        """Return where a value lies, 0 at the low end and 1 at the high one."""
        ends = np.array([self.low, self.high, min(max(value, self.low), self.high)], float)
        low, high, at = np.log(ends) if self.is_logarithmic else ends
        return float((at - low) / (high - low))

    def x_px(self, value: float) -> float:
        """Return where a value lies in a plot of rows."""
        return LABEL_PX + PLOT_PX * self.share(value)


@dataclass(frozen=True)
class Mark:
    """A dot at a value. `ends`: of a bar through it, or None; `ringed`: with a black ring."""

    value: float
    colour: str
    ends: tuple[float, float] | None = None
    ringed: bool = False


@dataclass(frozen=True)
class Row:
    """A labelled row of marks. `note`: words right of the axis, or on it where there is no mark."""

    label: str
    marks: Sequence[Mark] = ()
    note: str = ""
    note_colour: str = INK


def row_plot(title: str, axis: Axis, rows: Sequence[Row], legend: Sequence[tuple[str, str]] = ()) -> str:
    """Return rows on one axis as SVG. `legend`: what is said of a colour, and the colour."""
    height = HEAD_PX + ROW_PX * len(rows) + 34 + 30 * bool(legend)
    bottom = HEAD_PX + ROW_PX * len(rows)
    picture = Plot(LABEL_PX + PLOT_PX + 90, height)
    picture.text(12, 16, title)
    for tick in axis.ticks:
        x = axis.x_px(tick)
        picture.path(f"M{x:.0f} {HEAD_PX - 8}V{bottom + 6}", LIMIT if tick == axis.limit else GRID)
        picture.text(x, bottom + 22, f"{tick:g}", "middle")
    for number, row in enumerate(rows):
        y = HEAD_PX + ROW_PX * (number + 0.5)
        picture.text(LABEL_PX - 8, y + 4, row.label, "end")
        picture.text(LABEL_PX + (PLOT_PX + 8 if row.marks else 6), y + 4, row.note, fill=row.note_colour)
        for mark in row.marks:
            if mark.ends is not None:
                low, high = (axis.x_px(end) for end in mark.ends)
                picture.path(f"M{low:.1f} {y:.1f}H{high:.1f}", mark.colour, 2.5)
            ring = ' stroke="#111" stroke-width="1.5"' if mark.ringed else ""
            picture.dot(axis.x_px(mark.value), y, mark.colour, more=ring)
    x = 12.0
    for words, colour in legend:
        picture.dot(x + 5, height - 16, colour, 5.0)
        picture.text(x + 16, height - 12, words)
        x += 40 + 7 * len(words)
    return picture.svg()


@dataclass(frozen=True)
class Panel:
    """Power over strength. `points`: strength, share, its 95 % interval, number of cases; `oracle`: strength, share."""

    title: str
    points: Sequence[tuple[float, float, float, float, int]]
    oracle: Sequence[tuple[float, float]] = ()


def power_plot(axis: Axis, along: str, panels: Sequence[Panel]) -> str:
    """Return curves of the share of right answers over a strength as SVG, a panel beside the other."""
    wide, high, left, top, gap = 330.0, 210.0, 62.0, 44.0, 66.0
    picture = Plot(left + len(panels) * (wide + gap) - gap + 24, top + high + 92)
    for column, panel in enumerate(panels):
        _draw_panel(picture, panel, axis, along, (left + column * (wide + gap), top, wide, high))
    y = top + high + 70
    for x, colour, words in ((left, MEASURED, "diagnosis"), (left + 120, ORACLE, "oracle: the best that could be")):
        picture.box(x, y - 9, 22, 4, colour)
        picture.text(x + 28, y - 2, words)
    return picture.svg()


def _draw_panel(picture: Plot, panel: Panel, axis: Axis, along: str, place: tuple[float, float, float, float]) -> None:
    left, top, wide, high = place

    def at(strength: float, share: float) -> tuple[float, float]:
        return left + wide * axis.share(strength), top + high * (1.0 - share)

    def line(points: Sequence[tuple[float, float]], colour: str) -> None:
        if points:
            picture.path("M" + "L".join(f"{x:.1f},{y:.1f}" for x, y in points), colour, 2.0)

    picture.text(left + wide / 2, top - 18, panel.title, "middle")
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        _, y = at(axis.low, share)
        picture.path(f"M{left:.0f} {y:.1f}h{wide:.0f}", GRID)
        picture.text(left - 8, y + 4, f"{100 * share:.0f} %", "end")
    for tick in axis.ticks:
        x, y = at(tick, 0.0)
        picture.path(f"M{x:.1f} {y:.1f}v5", INK)
        picture.text(x, y + 18, f"{tick:g}", "middle")
    picture.text(left + wide / 2, top + high + 38, along, "middle")
    if not panel.points:
        picture.text(left + wide / 2, top + high / 2, "no case", "middle")
    line([at(*point) for point in panel.oracle], ORACLE)
    line([at(strength, share) for strength, share, *_ in panel.points], MEASURED)
    for strength, share, low, most, count in panel.points:
        x, y = at(strength, share)
        picture.path(f"M{x:.1f} {at(strength, low)[1]:.1f}V{at(strength, most)[1]:.1f}", MEASURED)
        picture.dot(x, y, MEASURED, 3.5)
        picture.text(x + 5, y - 6, str(count), fill=MEASURED, more=' font-size="10"')


@dataclass(frozen=True)
class Cell:
    """A cell of a matrix: a count and the colour of what it means."""

    count: int
    colour: str


def matrix_plot(
    rows: Sequence[str], columns: Sequence[str], cells: Mapping[tuple[str, str], Cell], titles: Mapping[str, str],
    legend: Mapping[str, str],
) -> str:  # fmt: skip
    """Return a matrix of counts as SVG, each row shaded by the share of its sum.

    titles: of rows and columns, by name; legend: what is said of a colour -> the colour.
    """
    height = TURNED_PX + CELL_PX * len(rows) + 50
    picture = Plot(NAMES_PX + CELL_PX * len(columns) + 130, height)
    for j, column in enumerate(columns):
        x, y = NAMES_PX + CELL_PX * (j + 0.5) + 4, TURNED_PX - 6
        picture.text(x, y, titles[column], more=f' transform="rotate(-55 {x:.0f} {y})"')
    for i, row in enumerate(rows):
        y = TURNED_PX + CELL_PX * i
        total = sum(cell.count for (of, _), cell in cells.items() if of == row)
        picture.text(NAMES_PX - 8, y + 16, titles[row], "end")
        for j, column in enumerate(columns):
            x, cell = NAMES_PX + CELL_PX * j, cells.get((row, column), Cell(0, "#ffffff"))
            shade = 0.25 + 0.75 * cell.count / total if cell.count else 0.0
            picture.box(x, y, CELL_PX, CELL_PX, cell.colour, f' fill-opacity="{shade:.2f}" stroke="{GRID}"')
            if cell.count:
                ink = "#fff" if shade > 0.55 else "#111"
                picture.text(x + CELL_PX / 2, y + 16, str(cell.count), "middle", ink)
    for k, (words, colour) in enumerate(legend.items()):
        x, y = NAMES_PX + 130 * k - 150, height - 20
        picture.box(x, y - 11, 12, 12, colour)
        picture.text(x + 18, y, words)
    return picture.svg()
