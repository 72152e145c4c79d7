"""`calibench validate`, `diagnose` and `report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from lab.cli.console import check_writable, err, make_folder, out, write_json
from lab.cli.exit_codes import EXIT_CHECK, EXIT_INPUT
from lab.cli.sources import (
    FitFile,
    Json,
    Model,
    Source,
    camera_path,
    existing_store,
    read_fit,
    read_models,
    recordings_of,
    run_here,
)
from lab.cli.tables import print_diagnosis, print_validation
from lab.errors import InputError
from lab.pipeline import PipelineRequest, PipelineResult

#: The fewest drawn cameras for a threshold: of ten draws, the standard deviation is known to 1 / sqrt(2 (10 - 1)) = 24 %.
FEWEST_DRAWS = 10

commands = typer.Typer()


@commands.command()
def validate(source: Source, json: Json = None, fit_file: FitFile = None, model: Model = None) -> None:
    """Compare predictions with measurements that the fit didn't use. Exit code 4 if a check fails."""
    check_writable(json)
    recordings = recordings_of(source)
    models = read_models(recordings, model)
    request = PipelineRequest("validate", recordings=recordings, fit=read_fit(fit_file), models=models)
    result = run_here(request).validation
    assert result is not None
    write_json(result, json)
    if str(json) != "-":
        print_validation(result)
    if not all(check.passed for check in result.checks):
        raise typer.Exit(EXIT_CHECK)


@commands.command()
def diagnose(
    source: Source,
    json: Json = None,
    fit_file: FitFile = None,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="DIR", help="write each camera with the named effects as DIR/SIDE.toml"),
    ] = None,
    model: Model = None,
    bootstrap: Annotated[
        int,
        typer.Option(
            metavar="N",
            help=f"draw N healthy cameras (at least {FEWEST_DRAWS}) frame by frame for the threshold of a false alarm",
        ),
    ] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            envvar="CALIBENCH_SCHEDULER",
            help="a Dask scheduler (tcp://HOST:PORT) whose workers draw the cameras of --bootstrap; they have to see the recordings under the same path",
        ),
    ] = None,
) -> None:
    """Name the physics that the camera model lacks and the recordings show. Exit code 2 if they determine no measurement."""
    if 0 < bootstrap < FEWEST_DRAWS or bootstrap < 0:
        raise InputError(
            f"--bootstrap {bootstrap}: {FEWEST_DRAWS} draws are the fewest that a threshold follows from; give more, or 0"
        )
    from lab.workers import Workers

    check_writable(json)
    recordings = recordings_of(source)
    if save is not None:
        camera_path(recordings, recordings.sides[0], save)
    request = PipelineRequest(
        "diagnose",
        recordings=recordings,
        fit=read_fit(fit_file),
        models=read_models(recordings, model),
        pictures=False,
        bootstrap=bootstrap,
        workers=Workers(scheduler=scheduler),
    )
    found = run_here(request)
    assert found.diagnosis is not None
    write_json(found.diagnosis, json)
    if save is not None:
        _save_models(found, save)
    if str(json) != "-":
        print_diagnosis(found.diagnosis)
    if found.diagnosis.verdict == "nothing_judged":
        raise typer.Exit(EXIT_INPUT)


def _save_models(found: PipelineResult, path: Path) -> None:
    """Write each camera with its named effects and corrections, and list these on stderr."""
    from lab.formats.camera_file import write_camera

    assert found.diagnosis is not None
    for side, content in found.improved.items():
        file = camera_path(found.recordings, side, path)
        make_folder(file.parent)
        write_camera(file, content)
        acting = ", ".join(one.name for one in content.effects) or "no effect beside the baseline"
        err.print(escape(f"camera: {file}: {acting}"))
    for item in found.diagnosis.unexplained:
        err.print(escape(f"{item.side}: {item.correction}"))


@commands.command()
def report(
    source: Source,
    out_file: Annotated[Path, typer.Option("--out", metavar="FILE", help="the page to write")] = Path("report.html"),
    fit_file: FitFile = None,
) -> None:
    """Fit, validate, diagnose, and write one page with pictures."""
    check_writable(out_file)
    request = PipelineRequest(
        "report",
        recordings=recordings_of(source),
        source=source,
        keep=False,
        fit=read_fit(fit_file),
        report_file=out_file,
    )
    out.print(f"report: {run_here(request, existing_store()).report}")
