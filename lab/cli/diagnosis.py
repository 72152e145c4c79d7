"""`calibench validate`, `diagnose` and `report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from lab.capture.data_folder import existing_store
from lab.cli.console import EXIT_CHECK, EXIT_INPUT, check_output, check_writable, err, make_folder, out, write_json
from lab.cli.sources import (
    EngineName,
    FitFile,
    Json,
    Model,
    Scheduler,
    Source,
    StoreFolder,
    camera_path,
    read_given,
    read_models,
    recordings_of,
    run_here,
)
from lab.cli.tables import print_diagnosis, print_validation
from lab.engine import DEFAULT_ENGINE
from lab.errors import InputError
from lab.pipeline import PipelineRequest, PipelineResult

#: The fewest drawn cameras for a threshold: of ten draws, the standard deviation is known to 1 / sqrt(2 (10 - 1)) = 24
#: %.
FEWEST_DRAWS = 10

commands = typer.Typer()


@commands.command()
def validate(
    source: Source, json: Json = None, fit_file: FitFile = None, model: Model = None, data: StoreFolder = None
) -> None:
    """Compare predictions with measurements that the fit didn't use. Exit code 4 if a check fails.

    Example: calibench validate my-camera --json validation.json
    """
    from lab.formats.results import FitResult

    check_writable(json)
    recordings = recordings_of(source, data)
    models = read_models(recordings, model)
    request = PipelineRequest("validate", recordings=recordings, fit=read_given(FitResult, fit_file), models=models)
    result = run_here(request).validation
    assert result is not None
    write_json(result, json)
    if str(json) != "-":
        print_validation(result)
    if not all(check.passed for check in result.checks):
        raise typer.Exit(EXIT_CHECK)


@commands.command()
def diagnose(
    context: typer.Context,
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
            help=f"simulate N healthy cameras (at least {FEWEST_DRAWS}) frame by frame for the threshold of a false "
            "alarm",
        ),
    ] = 0,
    engine: EngineName = DEFAULT_ENGINE,
    scheduler: Scheduler = None,
    data: StoreFolder = None,
) -> None:
    """Name the physics that the camera model lacks and the recordings show. Exit code 2 if they determine no
    measurement.

    Example: calibench diagnose my-camera --json diagnosis.json
    """
    if 0 < bootstrap < FEWEST_DRAWS or bootstrap < 0:
        raise InputError(
            f"--bootstrap {bootstrap}: {FEWEST_DRAWS} draws are the fewest that a threshold follows from; give more, "
            "or 0"
        )
    if bootstrap and engine == "evidence":
        raise InputError("--bootstrap: the engine evidence has no threshold to draw; leave it out, or take today's")
    stated = context.get_parameter_source("scheduler")
    if not bootstrap and stated is not None and stated.name == "ENVIRONMENT":
        scheduler = None  # CALIBENCH_SCHEDULER is for every command: one that has nothing to spread leaves it
    if scheduler is not None and not bootstrap:
        raise InputError(f"--scheduler {scheduler}: only the draws of --bootstrap are spread; give both, or neither")
    from lab.formats.results import FitResult
    from lab.workers import Workers

    check_writable(json)
    if save is not None:
        check_output(save)
    workers = Workers(scheduler=scheduler)
    workers.check()
    recordings = recordings_of(source, data)
    if save is not None:
        camera_path(recordings, recordings.sides[0], save)  # one file is of one camera
    request = PipelineRequest(
        "diagnose",
        recordings=recordings,
        fit=read_given(FitResult, fit_file),
        models=read_models(recordings, model),
        pictures=False,
        bootstrap=bootstrap,
        workers=workers,
        engine=engine,
    )
    result = run_here(request)
    assert result.diagnosis is not None
    write_json(result.diagnosis, json)
    if save is not None:
        _save_models(result, save)
    if str(json) != "-":
        print_diagnosis(result.diagnosis)
    if result.diagnosis.verdict == "nothing_judged":
        raise typer.Exit(EXIT_INPUT)


def _save_models(result: PipelineResult, path: Path) -> None:
    """Write each camera with its named effects and corrections, and list these on stderr."""
    from lab.formats.camera_file import write_camera

    assert result.diagnosis is not None
    for side, content in result.improved.items():
        file = camera_path(result.recordings, side, path)
        make_folder(file.parent)
        write_camera(file, content)
        acting = ", ".join(effect.name for effect in content.effects) or "no effect beside the baseline"
        err.print(escape(f"camera: {file}: {acting}"))
    for item in result.diagnosis.unexplained:
        err.print(escape(f"{item.side}: {item.correction}"))


@commands.command()
def report(
    source: Source,
    out_file: Annotated[Path, typer.Option("--out", metavar="FILE", help="the page to write")] = Path("report.html"),
    fit_file: FitFile = None,
    validation: Annotated[
        Path | None,
        typer.Option("--validation", metavar="FILE", help="a validation's JSON, in place of validating again"),
    ] = None,
    diagnosis: Annotated[
        Path | None, typer.Option("--diagnosis", metavar="FILE", help="a diagnosis' JSON, in place of diagnosing again")
    ] = None,
    cameras: Annotated[
        Path | None,
        typer.Option(
            "--cameras", metavar="DIR", help="the improved cameras of --diagnosis, as `diagnose --save` writes them"
        ),
    ] = None,
    stored: Annotated[
        bool,
        typer.Option("--stored", help="take the newest stored results of a finished session, in place of new ones"),
    ] = False,
    engine: EngineName = DEFAULT_ENGINE,
    data: StoreFolder = None,
) -> None:
    """Fit, validate, diagnose, and write one page with pictures. What is given, or with --stored is stored, isn't
    computed again.

    Example: calibench report my-camera --out report.html
    """
    from lab.formats.results import DiagnosisResult, FitResult, ValidationResult

    check_writable(out_file)
    store = existing_store(data)
    given = {"fit": fit_file, "validate": validation, "diagnose": diagnosis}
    recordings = recordings_of(source, data)
    if cameras is not None and diagnosis is None:
        raise InputError("--cameras: are those of a diagnosis that is given; give it with --diagnosis")
    request = PipelineRequest(
        "report",
        recordings=recordings,
        source=source,
        keep=False,
        reuse=stored,
        fit=read_given(FitResult, fit_file),
        validation=read_given(ValidationResult, validation),
        diagnosis=read_given(DiagnosisResult, diagnosis),
        improved=read_models(recordings, cameras),
        report_file=out_file,
        engine=engine,
    )
    for option, value in (
        ("--fit", request.fit),
        ("--validation", request.validation),
        ("--diagnosis", request.diagnosis),
    ):
        if value is not None and Path(value.source).name != Path(recordings.source).name:
            err.print(
                escape(f"calibench: {option}: computed from {value.source}, shown on the page of {recordings.source}")
            )
    kept = [kind for kind, file in given.items() if file is None and store is not None and store.results(source, kind)]
    if kept and not stored:
        err.print(
            f"calibench: {escape(source)} has stored results ({', '.join(kept)}), computed again now; --stored takes "
            "them"
        )
    if stored and not kept:
        err.print(
            f"calibench: --stored: nothing of {escape(source)} is stored that isn't given; what is missing is computed"
        )
    out.print(f"report: {run_here(request, store).report}")
