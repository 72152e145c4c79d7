"""Results in a notebook: a summary in words, a table of what matters, and the chart that tells most."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import singledispatch
from html import escape
from itertools import islice
from typing import TYPE_CHECKING, Any

from lab.calibration.life import History
from lab.formats.recording_set import RecordingSet
from lab.formats.results import ComparisonResult, DiagnosisResult, FitResult, Skipped, ValidationResult
from lab.formats.results.words import format_value
from lab.observables.observable import measurement_title
from lab.pipeline import PipelineResult
from lab.predict.simulate import Simulation, preview
from lab.report import answers, dataframes, words
from lab.report.figures import by_side, stereo_figures
from lab.report.pictures import frame_picture, photograph_data_uri
from lab.report.plots import charts_of, picture
from lab.twin.score import TwinScore, conclusion, title
from lab.twin.sealed import SealedPrediction

if TYPE_CHECKING:
    import pandas as pd

#: Charts of a summary, rows of its table, pictures of a recording set's captures, and lines of what isn't determined in
#: a text.
CHARTS, ROWS, FRAMES, SKIPPED = 2, 30, 6, 4
FRAME_PX = 200


@dataclass(frozen=True)
class ShownSummary:
    """What is shown of a result.

    headline : in a sentence
    headings, rows : its table
    lines : sentences below the table
    skipped : what the recordings don't determine
    pictures : HTML of its pictures; called for HTML alone
    """

    headline: str
    headings: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    lines: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()
    pictures: Callable[[], str] = str


def html(result: Any) -> str:
    """Return the summary of a result with its pictures, as HTML that needs nothing else."""
    shown = summary(result)
    parts = [f"<p><b>{escape(shown.headline)}</b></p>"]
    if shown.rows:
        body = "".join(_row("td", row) for row in shown.rows[:ROWS])
        parts.append(f"<table><thead>{_row('th', shown.headings)}</thead><tbody>{body}</tbody></table>")
        parts += [f"<p>{len(shown.rows) - ROWS} more rows: to_dataframe()</p>"] if len(shown.rows) > ROWS else []
    parts += [f"<p>{escape(line)}</p>" for line in shown.lines]
    parts.append(shown.pictures())
    if shown.skipped:
        items = "".join(f"<li>{escape(line)}</li>" for line in shown.skipped)
        parts.append(f"<details><summary>{len(shown.skipped)} not determined</summary><ul>{items}</ul></details>")
    return f'<div class="calibench">{"".join(parts)}</div>'


def _row(kind: str, cells: Sequence[str]) -> str:
    """Return a row of a table; `kind`: `th` or `td`."""
    inside = "".join(f'<{kind} align="left">{escape(cell)}</{kind}>' for cell in cells)
    return f"<tr>{inside}</tr>"


def text(result: Any) -> str:
    """Return the summary of a result as lines of text.

    >>> import calibench
    >>> text(calibench.FitResult(source="my-camera", cameras={})).splitlines()[0]
    'Fit of my-camera'
    """
    shown = summary(result)
    rows = [shown.headings, *shown.rows[:ROWS]] if shown.rows else []
    widths = [max(len(row[k]) for row in rows) for k in range(len(shown.headings))] if rows else []
    lines = [" ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    skipped = [f"not determined: {line}" for line in shown.skipped[:SKIPPED]]
    more = [f"and {len(shown.skipped) - SKIPPED} more: skipped"] if len(shown.skipped) > SKIPPED else []
    return "\n".join([shown.headline, *lines, *shown.lines, *skipped, *more])


def table(result: Any) -> pd.DataFrame:
    """Return a result as a pandas table."""
    return dataframes.table(result)


def _charts(result: object) -> Callable[[], str]:
    return lambda: "".join(picture(chart) for chart in islice(charts_of(result), CHARTS))


def _list_skipped(items: Sequence[Skipped]) -> tuple[str, ...]:
    return tuple(f"{item.step}{f' ({item.side})' if item.side else ''}: {item.reason}" for item in items)


@singledispatch
def summary(result: object) -> ShownSummary:
    """Return what is shown of a result."""
    return ShownSummary(repr(result))


@summary.register
def _(result: FitResult) -> ShownSummary:
    sides = tuple(result.cameras)
    rows = [
        (name, *(figure_of_side[side].text if side in figure_of_side else "–" for side in sides))
        for name, figure_of_side in by_side(result, {})
    ]
    for figure in stereo_figures(result.stereo) if result.stereo is not None else ():
        rows.append((figure.name, figure.text, *[""] * (len(sides) - 1)))
    return ShownSummary(
        f"Fit of {result.source}",
        ("quantity", *(f"{side} (± one standard deviation)" for side in sides)),
        tuple(rows),
        tuple(f"Warning: {line}" for line in result.warnings),
        _list_skipped(result.skipped),
        _charts(result),
    )


@summary.register
def _(result: ValidationResult) -> ShownSummary:
    passed = sum(check.passed for check in result.checks)
    rows = tuple(
        (
            check.side,
            words.CHECK_NAMES[check.name],
            check.capture,
            f"{check.chi2:.4g}",
            str(check.n),
            f"{check.rms_relative_percent:.2g} %",
            "passed" if check.passed else "failed",
        )
        for check in result.checks
    )
    return ShownSummary(
        f"Validation of {result.source}: {passed} of {len(result.checks)} checks passed "
        "(chi2 within its 99.9 % quantile)",
        ("side", "check", "capture", "chi2", "n", "rms difference", "result"),
        rows,
        (),
        _list_skipped(result.skipped),
        _charts(result),
    )


@summary.register
def _(result: DiagnosisResult) -> ShownSummary:
    badge, _, sentence = words.headline(result)
    rows = tuple(
        (answers.effect_line(effect), f"{effect.probability:.3g}", ", ".join(_rivals(effect.alternatives)) or "none")
        for effect in result.effects
    )
    held = result.held_out
    lines = [law.statement for law in result.discovered]
    if result.unexplained:
        places = sorted({f"{measurement_title(item.measurement)} ({item.side})" for item in result.unexplained})
        lines.append(f"Without a name so far: {', '.join(places)}.")
    if held is not None and held.n:
        lines.append(
            f"Held-out captures: chi2 {held.chi2_before:.4g} before, {held.chi2_after:.4g} after, of n = {held.n}."
        )
    if result.next_capture:
        lines.append(f"Next capture: {result.next_capture}")
    return ShownSummary(
        f"Diagnosis of {result.source}: {badge}. {sentence}",
        ("effect", "probability", "alternatives"),
        rows,
        tuple(lines),
        _list_skipped(result.skipped),
        _charts(result),
    )


def _rivals(names: Sequence[str]) -> Iterator[str]:
    yield from (name.replace("_", " ") for name in names)


@summary.register
def _(result: ComparisonResult) -> ShownSummary:
    ordered = sorted(result.changes, key=lambda row: -row.significance_sigma)
    rows = tuple(
        (
            change.side or "",
            f"{change.title or change.name} {change.where}".strip(),
            format_value(change.a, change.a_std, change.unit),
            format_value(change.b, change.b_std, change.unit),
            f"{change.significance_sigma:.1f}",
            "changed" if change.changed else "",
        )
        for change in ordered
    )
    changed = sum(change.changed for change in result.changes) + sum(change.changed for change in result.projection)
    return ShownSummary(
        f"{result.a} and {result.b}: {changed} of {len(result.changes) + len(result.projection)} figures changed "
        f"beyond {result.threshold_sigma:.1f} sigma (false-alarm rate {100 * result.false_alarm_rate:g} %)",
        ("side", "quantity", "A", "B", "difference, sigma", ""),
        rows,
        result.instruments,
        _list_skipped(result.skipped),
    )


@summary.register
def _(result: RecordingSet) -> ShownSummary:
    counted = Counter((capture.kind, capture.side) for capture in result.captures())
    first = {(capture.kind, capture.side): capture for capture in reversed(result.captures())}

    def pictures() -> str:
        shown = [first[key] for key in list(counted)[:FRAMES]]
        uris = [frame_picture(result.frame(capture), result.camera(capture.side), FRAME_PX) for capture in shown]
        return "".join(
            f'<figure style="display:inline-block;margin:0.4em"><figcaption>{escape(capture.id)}</figcaption>'
            f'<img alt="{escape(capture.id, quote=True)}" src="{uri}"></figure>'
            for capture, uri in zip(shown, uris, strict=True)
        )

    return ShownSummary(
        f"Recording set {result.manifest.name or result.source}: {len(result.captures())} captures of "
        f"{', '.join(result.sides)}",
        ("kind", "side", "captures"),
        tuple((kind, side, str(number)) for (kind, side), number in counted.items()),
        tuple(f"Warning: {line}" for line in result.warnings),
        pictures=pictures,
    )


@summary.register
def _(result: Simulation) -> ShownSummary:
    record = result.record
    frame_figures, rows, cols = record.summary, *result.frame.shape

    def pictures() -> str:
        uri = photograph_data_uri(preview(result.frame, result.camera, result.white))
        return f'<img alt="{escape(record.options.scene, quote=True)}" style="max-width:480px" src="{uri}">'

    return ShownSummary(
        f"Simulated frame of {record.options.scene} under {record.options.illuminant}: {cols} x {rows} px, "
        f"{record.camera['cfa']}",
        ("quantity", "value"),
        (
            ("exposure", f"{frame_figures.exposure_s:.4g} s"),
            ("mean", f"{frame_figures.mean_electrons:.4g} e, {frame_figures.mean_dn:.4g} DN"),
            ("SNR at the mean", f"{frame_figures.snr:.3g}"),
            ("saturated pixels", f"{frame_figures.saturated_percent:.2g} %"),
        ),
        tuple(f"Warning: {line}" for line in record.lens_warnings),
        pictures=pictures,
    )


@summary.register
def _(result: History) -> ShownSummary:
    drifted = sum(point.drifted for point in result.points)
    return ShownSummary(
        f"{result.title or result.figure} of {result.camera} over {len(result.points)} calibrations: {drifted} drifted",
        ("calibration", "created (UTC)", "value", "difference, sigma", ""),
        tuple(
            (
                point.calibration_id,
                f"{point.created:%Y-%m-%d %H:%M}",
                format_value(point.value, point.std, result.unit),
                "" if point.significance_sigma is None else f"{point.significance_sigma:.1f}",
                "drifted" * point.drifted,
            )
            for point in result.points
        ),
        pictures=_charts(result),
    )


@summary.register
def _(result: SealedPrediction) -> ShownSummary:
    counted = Counter(
        (side, number.quantity) for side, side_prediction in result.sides.items() for number in side_prediction.numbers
    )
    skipped = tuple(
        line for side_prediction in result.sides.values() for line in _list_skipped(side_prediction.skipped)
    )
    rows = tuple((side, title(quantity), str(number)) for (side, quantity), number in counted.items())
    return ShownSummary(f"Prediction of {result.plan}", ("side", "quantity", "numbers"), rows, skipped=skipped)


@summary.register
def _(result: TwinScore) -> ShownSummary:
    sides = dict.fromkeys(effect.side for effect in result.effects)
    return ShownSummary(
        f"Prediction against {result.source}: chi2 {result.chi2:.4g} of n = {result.n}",
        ("quantity", "n", "median deviation", "in 95 % intervals", "chi2 / n"),
        tuple(
            (
                title(quantity.quantity),
                str(quantity.n),
                f"{quantity.median:.3g}{' %' if quantity.unit == '%' else ''}",
                f"{100 * quantity.within_95_percent_interval:.1f} %",
                f"{quantity.chi2 / quantity.n:.2f}",
            )
            for quantity in result.quantities
        ),
        tuple(f"{side}: {conclusion([e for e in result.effects if e.side == side])}" for side in sides),
        _list_skipped(result.skipped),
    )


@summary.register
def _(result: PipelineResult) -> ShownSummary:
    parts = [summary(part) for part in (result.fit, result.validation, result.diagnosis) if part is not None]
    first = parts[0] if parts else summary(result.recordings)
    return ShownSummary(
        ". ".join(part.headline for part in parts[::-1]) or first.headline,
        first.headings,
        first.rows,
        (
            *(line for part in parts for line in part.lines),
            *((f"Report: {result.report}",) if result.report is not None else ()),
        ),
        tuple(dict.fromkeys(line for part in parts for line in part.skipped)),
        _charts(result),
    )
