"""Results as tables and sentences on stdout."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from lab.cli.console import out

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.capture.catalogue import PlanEstimate, SequenceDescription
    from lab.formats.recording_set import RecordingSet
    from lab.formats.results import (
        ComparisonResult,
        DiagnosisResult,
        FitResult,
        RivalOdds,
        Skipped,
        ValidationResult,
    )


def print_sequences(catalogue: tuple[SequenceDescription, ...], planned_session: PlanEstimate | None) -> None:
    """The catalogue; with `found`, the sequences of a plan with their values, captures and time."""
    planned = {sequence.name: sequence for sequence in planned_session.sequences} if planned_session is not None else {}
    for sequence in catalogue:
        if planned_session is not None and sequence.name not in planned:
            continue
        there = planned.get(sequence.name)
        takes = ""
        if there is not None:
            takes = f": {there.captures} captures, {_duration(there.estimated_s, there.learned)}"
        out.print(f"[bold]{sequence.name}[/]{takes}: {escape(sequence.purpose)}")
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 2), show_header=False)
        for parameter in sequence.parameters:
            value = "" if there is None else _values(there.parameters[parameter.name])
            unit = "" if parameter.unit == "1" else parameter.unit
            bounds = " .. ".join("" if bound is None else f"{bound:g}" for bound in (parameter.lower, parameter.upper))
            table.add_row(parameter.name, value, unit, escape(parameter.meaning), f"({bounds})")
        out.print(table)
    if planned_session is not None:
        learned = all(sequence.learned for sequence in planned_session.sequences)
        duration = _duration(planned_session.estimated_s, learned)
        out.print(f"{planned_session.captures} captures in {planned_session.steps} steps, {duration}")


def _values(value: float | tuple[float, ...] | None) -> str:
    if isinstance(value, tuple):
        return ", ".join(f"{number:g}" for number in value)
    return "all" if value is None else f"{value:g}"


def _duration(seconds: float, learned: bool) -> str:
    """Return a time in words; marked as estimated where no session of the station showed it."""
    words = (
        f"{seconds:.0f} s"
        if seconds < 90
        else f"{seconds / 60:.0f} min"
        if seconds < 5400
        else f"{seconds / 3600:.1f} h"
    )
    return f"about {words}" if learned else f"about {words} (estimated)"


def print_skipped(skipped: tuple[Skipped, ...]) -> None:
    for item in skipped:
        of = f" ({item.side})" if item.side else ""
        out.print(f"skipped: {escape(item.step)}{of}: {escape(item.reason)}")


def print_fit(recordings: RecordingSet, fit: FitResult) -> None:
    from lab.report.figures import by_side, stereo_figures

    _print_emva1288(fit)
    sides = list(fit.cameras)
    table = Table(box=None, pad_edge=False)
    table.add_column("quantity")
    for side in sides:
        table.add_column(f"{side} (± one standard deviation)")
    for name, figures in by_side(fit, recordings.manifest.cameras):
        table.add_row(name, *(figures[side].text if side in figures else "-" for side in sides))
    if table.row_count:
        out.print(table)
    if fit.stereo is not None:
        for figure in stereo_figures(fit.stereo):
            out.print(f"{figure.name}: {figure.text}")
    for line in fit.warnings:
        out.print(f"[yellow]warning:[/] {escape(line)}")
    for side, camera in fit.cameras.items():
        for remark in camera.remarks:
            out.print(f"{side}: {escape(remark)}")
    for remark in fit.stereo.remarks if fit.stereo is not None else ():
        out.print(f"stereo: {escape(remark)}")
    print_skipped(fit.skipped)


def _print_emva1288(fit: FitResult) -> None:
    """The standard's own figures of each camera, by plane of its mosaic, and what the standard's recordings lack."""
    from lab.report.emva import compare_estimates, table_rows

    for side, camera in fit.cameras.items():
        if camera.noise is None or not camera.noise.emva1288:
            continue
        planes = camera.noise.emva1288
        table = Table(box=None, pad_edge=False)
        for heading in (f"EMVA 1288, {side}", "", *(f"{name} (± one standard deviation)" for name in planes)):
            table.add_column(heading)
        for row in table_rows(planes):
            table.add_row(row.quantity, row.symbol, *row.values)
        out.print(table)
        for remark in dict.fromkeys(remark for plane in planes.values() for remark in plane.remarks):
            out.print(f"{side}: EMVA 1288: {escape(remark)}")
        for line in compare_estimates(camera.noise):
            out.print(f"{side}: {escape(line)}")
        out.print()


def print_validation(validation: ValidationResult) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("check", "side", "capture", "n", "chi2/n", "rms, %", "within noise"):
        table.add_column(heading)
    for check in validation.checks:
        table.add_row(
            check.name,
            check.side,
            check.capture,
            str(check.n),
            f"{check.chi2 / max(check.n, 1):.2f}",
            f"{check.rms_relative_percent:.2f}",
            "yes" if check.passed else "[red]no[/]",
        )
    if table.row_count:
        out.print(table)
    print_skipped(validation.skipped)


def print_diagnosis(diagnosis: DiagnosisResult) -> None:
    out.print(f"verdict: [bold]{diagnosis.verdict}[/]")
    for sentence in diagnosis.summary:
        out.print(escape(sentence))
    if diagnosis.held_out is not None:
        held = diagnosis.held_out
        captures = f"{len(held.captures)} held-out captures"
        with_laws = "" if held.chi2_discovered is None else f", {held.chi2_discovered:.0f} with laws without a name"
        out.print(
            f"{captures}: chi2 {held.chi2_before:.0f} before, {held.chi2_after:.0f} after{with_laws}, n = {held.n}"
        )
    departing = {(m.side, m.measurement) for m in diagnosis.mismatches}
    departing |= {(u.side, u.measurement) for u in diagnosis.unexplained}
    table = Table(box=None, pad_edge=False)
    for heading in ("departing", "side", "n", "chi2 before", "after", "held out", "chi2 before", "after"):
        table.add_column(heading)
    for fit in diagnosis.measurements:
        if (fit.side, fit.measurement) in departing:
            used = (str(fit.n), f"{fit.chi2_before:.0f}", f"{fit.chi2_after:.0f}")
            held_out = (str(fit.held_out_n), f"{fit.held_out_before:.0f}", f"{fit.held_out_after:.0f}")
            table.add_row(fit.measurement, fit.side, *used, *(held_out if fit.held_out_n else ("-", "-", "-")))
    if table.row_count:
        out.print(table)
    if diagnosis.next_capture:
        out.print(f"next: {escape(diagnosis.next_capture)}")
    print_skipped(diagnosis.skipped)


def print_resolving(diagnosis: DiagnosisResult) -> None:
    """The journal of resolving: in doubt, taken, said; and how it ended."""

    def odds(rivals: Sequence[RivalOdds]) -> str:
        return ", ".join(f"{rival.name} {rival.probability:.2g}" for rival in rivals) or "none"

    table = Table(box=None, pad_edge=False)
    for heading in ("in doubt", "taken", "expected, nat", "expected, s", "took, s", "said", "session"):
        table.add_column(heading)
    for step in diagnosis.resolutions:
        numbers = (step.information_nat, step.expected_s, step.spent_s)
        table.add_row(
            escape(odds(step.rivals)),
            escape(step.capture + (f", then {step.then}" if step.then else "")),
            *("" if number is None else f"{number:.3g}" for number in numbers),
            escape("nothing yet" if step.rivals_after is None else odds(step.rivals_after)),
            step.session,
        )
    if table.row_count:
        out.print(table)
    if diagnosis.resolve_end is not None:
        out.print(f"resolving: [bold]{diagnosis.resolve_end}[/]: {escape(diagnosis.resolve_reason)}")


def print_comparison(comparison: ComparisonResult, every: bool) -> None:
    from lab.formats.results.words import format_unit, format_value

    shown = [row for row in comparison.changes if every or row.changed]
    table = Table(box=None, pad_edge=False)
    for heading in ("quantity", "side", "where", "A", "B", "B - A", "unit", "sigma", "changed", "figure"):
        table.add_column(heading)
    for row in sorted(shown, key=lambda row: -row.significance_sigma):
        values = (
            format_value(row.a, row.a_std),
            format_value(row.b, row.b_std),
            format_value(row.difference, row.difference_std),
        )
        of = f"{row.where} (worst of {row.n})" if row.n > 1 else row.where
        marks = (format_unit(row.unit), f"{row.significance_sigma:.1f}", "yes" if row.changed else "no")
        table.add_row(escape(row.title or row.name), row.side or "", escape(of), *values, *marks, escape(row.name))
    if table.row_count:
        out.print(table)
    for item in comparison.projection:
        turn = ", ".join(f"{value:.3f}" for value in item.implied_turn_mrad)
        out.print(
            f"projection ({item.side}): {item.difference_px:.4f} px rms apart once the implied motion is taken out, "
            f"{item.expected_px:.4f} "
            f"px by the uncertainties, {item.significance_sigma:.1f} sigma: "
            f"{'changed' if item.changed else 'unchanged'} (as stated "
            f"{item.as_stated_px:.4f} px; implied turn {turn} mrad)"
        )
    number = sum(row.changed for row in comparison.changes) + sum(item.changed for item in comparison.projection)
    total = len(comparison.changes) + len(comparison.projection)
    out.print(
        f"{number or 'none'} of {total} numbers and curves changed beyond {comparison.threshold_sigma:.1f} sigma, "
        "which an unchanged rig "
        f"passes in {100 * comparison.false_alarm_rate:g} % of all comparisons"
    )
    for line in comparison.instruments:
        out.print(f"instruments: {escape(line)}")
    print_skipped(comparison.skipped)
