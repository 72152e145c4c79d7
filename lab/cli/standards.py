"""`calibench standards`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.cli.console import check_folder, check_writable, err, out, write_json
from lab.cli.sources import FitFile, Json, Source, StoreFolder, read_given, recordings_of, run_here
from lab.pipeline import PipelineRequest

if TYPE_CHECKING:
    from lab.formats.recording_set import RecordingSet
    from lab.formats.results import FitResult, StandardsResult

commands = typer.Typer()

ReportFolder = Annotated[
    Path | None,
    typer.Option(
        "--report", metavar="DIR", help="write an overview, DIR/standards.html, and one page for each standard"
    ),
]
PdfFile = Annotated[
    Path | None, typer.Option("--pdf", metavar="FILE", help="write all standards as one PDF (needs calibench[pdf])")
]


@commands.command()
def standards(
    source: Source,
    json: Json = None,
    report_folder: ReportFolder = None,
    pdf: PdfFile = None,
    fit_file: FitFile = None,
    data: StoreFolder = None,
) -> None:
    """The figures of EMVA 1288, ISO 12233 and other standards, with uncertainties, and the requirements that the
    recordings don't meet.

    Example: calibench standards my-camera --report pages --pdf standards.pdf
    """
    from lab.formats.results import FitResult
    from lab.report.standards_pdf import check_pdf

    check_writable(json)
    check_writable(pdf)
    check_folder(report_folder)
    if pdf is not None:
        check_pdf()
    recordings = recordings_of(source, data)
    fitted = read_given(FitResult, fit_file) or run_here(PipelineRequest("fit", recordings=recordings)).fit
    assert fitted is not None
    report_standards(recordings, fitted, json, report_folder, pdf)


def report_standards(
    recordings: RecordingSet, fitted: FitResult, json: Path | None, report_folder: Path | None, pdf: Path | None
) -> None:
    """Read the standards of recordings and their fit; write JSON, pages and PDF where they are asked for, and print."""
    from lab.standards.reading import read_standards

    result = read_standards(recordings, fitted)
    write_json(result, json)
    if report_folder is not None or pdf is not None:
        from lab.report.standards import sections, write_standards

        read_off = sections(result, recordings, fitted)
        if report_folder is not None:
            page = write_standards(report_folder, result, recordings, read_off)
            err.print(f"report: {escape(str(page))}")
        if pdf is not None:
            from lab.report.standards_pdf import write_standards_pdf

            name = recordings.manifest.name or result.source
            err.print(f"pdf: {escape(str(write_standards_pdf(pdf, result, read_off, name)))}")
    if str(json) != "-":
        print_standards(result)


def print_standards(result: StandardsResult) -> None:
    """Print the figures of each standard, and the requirements that aren't met."""
    from lab.formats.results.words import format_value

    for reading in result.readings:
        out.print(f"\n[bold]{escape(reading.standard)}[/], {reading.side}, {escape(reading.subject)}")
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        for figure in reading.figures:
            value = escape(figure.reason)
            if figure.estimate is not None:
                value = escape(format_value(figure.estimate.value, figure.estimate.std, figure.estimate.unit))
                value += "" if figure.by_the_standard else "  [yellow]not by the standard[/]"
            table.add_row(escape(figure.symbol), escape(figure.quantity), value)
        out.print(table)
        for deviation in reading.deviations:
            out.print(f"  [yellow]![/] {escape(deviation.line)}")
    for item in result.skipped:
        out.print(f"\n{escape(item.step)}, {item.side}: {escape(item.reason)}")
