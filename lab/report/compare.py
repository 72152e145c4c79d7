"""The page of two calibrations compared: what changed, how significantly, and how the projections differ."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from lab.formats.results import Change, ComparisonResult, ProjectionChange
from lab.formats.results.words import format_value
from lab.report import page_environment, write_page
from lab.report.charts import AFTER, BEFORE, ChartData, Figure, axis, layout, log_axis, plotly_base64
from lab.report.geometry import frame_layout, lines_of_vectors

SHOWN = 40  # rows of the chart: those that changed, and the most significant of the rest
LEAST_SIGMA = 0.02  # where a logarithmic axis ends


def _label(row: Change) -> str:
    """Return the quantity as the chart's axis names it."""
    where = row.where if row.n > 1 else ""
    return " ".join(part for part in (row.side, row.title or row.name, where) if part)


def most_significant(comparison: ComparisonResult) -> tuple[Change, ...]:
    """Return the rows that are drawn, most significant first."""
    return tuple(sorted(comparison.changes, key=lambda row: -row.significance_sigma)[:SHOWN])


def significances(comparison: ComparisonResult) -> Figure | None:
    """Draw the significance of each difference in standard deviations, and the limit of the stated false-alarm rate."""
    rows = most_significant(comparison)[::-1]
    if not rows:
        return None
    bars = {
        "type": "bar",
        "orientation": "h",
        "x": [max(row.significance_sigma, LEAST_SIGMA) for row in rows],
        "y": [_label(row) for row in rows],
        "marker": {"color": [BEFORE if row.changed else AFTER for row in rows]},
        "hoverinfo": "x+y",
        "showlegend": False,
    }
    limit = comparison.threshold_sigma
    high = max(limit, *(row.significance_sigma for row in rows))
    return {
        "data": [bars],
        "layout": layout(
            70 + 17 * len(rows),
            xaxis=log_axis("significance, sigma", [LEAST_SIGMA, high]),
            yaxis=axis("", automargin=True, tickfont={"size": 10}),
            shapes=[
                {
                    "type": "line",
                    "x0": limit,
                    "x1": limit,
                    "yref": "paper",
                    "y0": 0,
                    "y1": 1,
                    "line": {"color": "@fg", "width": 1, "dash": "dash"},
                }
            ],
        ),
    }


def projection_vectors(item: ProjectionChange) -> Figure:
    """Draw the differences of projection over the frame as enlarged lines, from A to B."""
    x, y = np.meshgrid(item.x_px, item.y_px)
    at = np.stack([x.ravel(), y.ravel()], axis=1)
    shape = (item.y_px[-1] + 1, item.x_px[-1] + 1)
    traces = lines_of_vectors(at, np.array(item.vectors_px, float).reshape(-1, 2), shape, "B − A")
    return {"data": traces, "layout": frame_layout(shape)}


def render_comparison(comparison: ComparisonResult) -> str:
    """Return the page of a comparison as HTML text, which needs nothing else.

    >>> from lab.fit.compare import compare
    >>> from lab.formats.results import FitResult
    >>> fit = FitResult(source="my-camera", cameras={})
    >>> "</html>" in render_comparison(compare(fit, fit))
    True
    """
    number = sum(row.changed for row in comparison.changes) + sum(item.changed for item in comparison.projection)
    total = len(comparison.changes) + len(comparison.projection)
    rows: list[dict[str, Any]] = [
        {
            "change": row,
            "a": format_value(row.a, row.a_std),
            "b": format_value(row.b, row.b_std),
            "difference": format_value(row.difference, row.difference_std, row.unit),
        }
        for row in sorted(comparison.changes, key=lambda row: -row.significance_sigma)
    ]
    context: dict[str, Any] = {
        "version": metadata.version("calibench"),
        "comparison": comparison,
        "headline": f"{number} of {total} changed" if number else f"None of {total} changed",
        "changed": [row for row in rows if row["change"].changed],
        "unchanged": [row for row in rows if not row["change"].changed],
        "significances": significances(comparison),
        "shown": min(SHOWN, len(comparison.changes)),
        "projections": [(item, projection_vectors(item)) for item in comparison.projection],
        "chart_data": ChartData(),
        "plotly": plotly_base64(),
    }
    return page_environment().get_template("compare.html").render(context)


def write_comparison(folder: Path, comparison: ComparisonResult) -> Path:
    """Write `folder`/compare.html, one self-contained page: completely, or not at all. InputError where it can't be
    written."""
    return write_page(folder / "compare.html", render_comparison(comparison))
