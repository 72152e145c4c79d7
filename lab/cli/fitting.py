"""`calibench fit` and `calibench compare`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from lab.capture.data_folder import existing_store
from lab.cli.console import EXIT_CHECK, check_folder, check_writable, err, make_folder, warn, write_json
from lab.cli.sources import Json, Source, StoreFolder, recordings_of, run_here
from lab.cli.tables import print_comparison, print_fit
from lab.errors import NotDetermined
from lab.pipeline import PipelineRequest

if TYPE_CHECKING:
    from lab.formats.recording_set import RecordingSet, Snapshots
    from lab.formats.results import FitResult

commands = typer.Typer()


@commands.command()
def fit(
    source: Source,
    json: Json = None,
    cameras: Annotated[
        Path | None, typer.Option("--write-cameras", metavar="DIR", help="write each fitted camera as DIR/SIDE.toml")
    ] = None,
    maps: Annotated[
        Path | None,
        typer.Option(
            "--maps",
            metavar="DIR",
            help="write every pixel's offset, dark current and gain, and which are defective, into DIR/SIDE (.npy and "
            ".png)",
        ),
    ] = None,
    data: StoreFolder = None,
) -> None:
    """Calibrate: noise, spectral sensitivity, MTF, PSF, geometry, stereo.

    Example: calibench fit my-camera --json fit.json
    """
    check_writable(json)
    check_folder(cameras)
    check_folder(maps)
    recordings = recordings_of(source, data)
    result = _fit(recordings)
    write_json(result, json)
    if cameras is not None:
        _write_cameras(recordings, result, cameras)
    if maps is not None:
        _write_maps(recordings, maps)
    if str(json) != "-":
        print_fit(recordings, result)


def _fit(recordings: RecordingSet) -> FitResult:
    fit = run_here(PipelineRequest("fit", recordings=recordings)).fit
    assert fit is not None
    return fit


def _write_maps(recordings: RecordingSet, folder: Path) -> None:
    """Write the maps of every side's pixels. A side without darks has none; a line on stderr says so."""
    from lab.fit.noise.pixel_maps import pixel_maps
    from lab.report.pictures import write_maps

    for side in recordings.sides:
        try:
            names = write_maps(folder / side, pixel_maps(recordings, side))
        except NotDetermined as refused:
            err.print(escape(f"maps ({side}): none: {refused.reason}"))
        else:
            err.print(escape(f"maps: {folder / side}: {', '.join(n for n in names if n.endswith('.npy'))}"))


def _write_cameras(recordings: RecordingSet, result: FitResult, folder: Path) -> None:
    """Write the camera files of a fit. A line on stderr names each value that was neither fitted nor stated, and one
    each that isn't the fitted one."""
    from lab.formats.camera_file import fitted_camera, write_camera
    from lab.formats.camera_model import assumed_noise, assumptions, limited_values

    make_folder(folder)
    for side, fitted in result.cameras.items():
        content = fitted_camera(recordings, side, fitted)
        write_camera(folder / f"{side}.toml", content)
        stated = recordings.camera(side)
        assumed = (*assumptions(stated, fitted), *assumed_noise(stated, fitted, content.camera))
        taken = "; ".join(f"{assumption.quantity} taken as {assumption.value}" for assumption in assumed)
        note = f" (neither fitted nor stated: {taken})" if taken else ""
        err.print(escape(f"camera: {folder / f'{side}.toml'}{note}"))
        warn(tuple(f"{folder / f'{side}.toml'}: {line}" for line in limited_values(fitted)))


@commands.command()
def compare(
    a: Annotated[str, typer.Argument(metavar="A", help="a fit's JSON, a recording set's folder, or a session's id")],
    b: Annotated[str, typer.Argument(metavar="B", help="the calibration to compare with it")],
    json: Json = None,
    check: Annotated[bool, typer.Option("--check", help="exit code 4 where anything changed")] = False,
    fail_on: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[SIDE:]FIGURE[>AMOUNT[%]]",
            help="exit code 4 where this figure changed, by more than AMOUNT; * stands for any text; may be repeated",
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="list what didn't change, too")] = False,
    report_folder: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="write DIR/compare.html, one page with pictures")
    ] = None,
    data: StoreFolder = None,
) -> None:
    """Compare two calibrations: figures that changed beyond their uncertainty, and instruments that changed.

    Example: calibench compare fit-january.json fit-june.json
    """
    from lab.fit.compare import FailRule, failures
    from lab.fit.compare import compare as compared
    from lab.formats.recording_set import differences

    check_writable(json)
    check_folder(report_folder)
    rules = [FailRule.parse(text) for text in fail_on or ()]
    (before, then), (after, now) = _calibration(a, data), _calibration(b, data)
    result = compared(before, after).model_copy(update={"instruments": differences(then, now)})
    write_json(result, json)
    if report_folder is not None:
        from lab.report.compare import write_comparison

        err.print(f"report: {escape(str(write_comparison(report_folder, result)))}")
    if str(json) != "-":
        print_comparison(result, every)
    failed = failures(result, rules)
    for name in failed:
        err.print(escape(f"--fail-on: {name} changed"))
    if failed or (check and result.changed):
        raise typer.Exit(EXIT_CHECK)


def _calibration(source: str, data: Path | None) -> tuple[FitResult, Snapshots]:
    """A fit from the file that `--json` wrote, from the registry of sessions, or made now from recordings; and what the
    instruments said of themselves, which a fit's file doesn't have."""
    from lab.formats.result_file import read_result
    from lab.formats.results import FitResult

    if Path(source).is_file():
        return read_result(FitResult, Path(source)), {}
    if not Path(source).exists() and (store := existing_store(data)) is not None:
        for kept in store.results(source, "fit")[:1]:
            there = store.recording_set(source, ()).manifest.instruments if store.has_session(source) else {}
            return FitResult.model_validate(kept.document), there
    recordings = recordings_of(source, data)
    return _fit(recordings), recordings.manifest.instruments
