"""The command line: `calibench COMMAND`. Parses, calls one verb of `lab`, prints, and turns errors into exit codes.

0 done; 2 the input can't be used; 3 a device failed; 4 a check fell short; 1 a defect of calibench; 130 interrupted.
An error is one line on stderr (one for each problem of a folder), never a traceback; CALIBENCH_DEBUG=1 shows that too.
"""

# ruff: noqa: E402  (libraries read the number of threads when they are imported)
from __future__ import annotations

import os

# Both cameras are fitted at the same time; libraries that start threads of their own under these take four times as long.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import contextlib
import re
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer
from pydantic import BaseModel, ValidationError
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from lab.challenge.command import commands as challenge
from lab.errors import DeviceError, InputError, NotDetermined
from lab.fit import Progress as Advance
from lab.fit import fit_recording_set
from lab.formats import recording_set as recording
from lab.formats.recording_set import RecordingError, RecordingSet
from lab.formats.results import ComparisonResult, DiagnosisResult, FitResult, Skipped, ValidationResult
from sim.camera import Side

if TYPE_CHECKING:
    from lab.capture.sequences.calibration import Calibration
    from lab.capture.store import Store
    from lab.diagnose import Diagnosis
    from lab.formats.camera_file import CameraFile
    from lab.predict.lens import LensResult

EXIT_INTERNAL, EXIT_INPUT, EXIT_CHECK, EXIT_INTERRUPTED = 1, 2, 4, 130
#: Drawn cameras from which a threshold is taken: a standard deviation of fewer is known to a quarter and worse.
FEWEST_DRAWS = 10

app = typer.Typer(
    name="calibench",
    help="Captures with, calibrates and explains cameras.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
# Into a file or a pipe, a table isn't squeezed into 80 columns.
out = Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else 200)
err = Console(stderr=True, soft_wrap=True, highlight=False)

Source = Annotated[str, typer.Argument(metavar="SOURCE", help="a recording set's folder, or a stored session's id")]
Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="write the result as JSON ('-': to stdout)")]
StationFile = Annotated[
    Path | None, typer.Option("--station", metavar="FILE", help="the station file; without one, the mock bench")
]
Quick = Annotated[bool, typer.Option("--quick", help="fewer exposures and repeats")]
DataFolder = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="the data folder (CALIBENCH_DATA, else calibench-data)")
]
StoreFolder = Annotated[
    Path | None, typer.Option("--data", metavar="DIR", help="the data folder (CALIBENCH_DATA, else calibench-data)")
]
Resume = Annotated[str, typer.Option(metavar="SESSION", help="go on with this session")]
BENCH_START_S, BENCH_END_S = 60.0, 10.0
Model = Annotated[
    Path | None,
    typer.Option("--model", metavar="DIR", help="take the cameras of DIR/SIDE.toml, with their effects, as they are"),
]
FitFile = Annotated[Path | None, typer.Option("--fit", metavar="FILE", help="a fit's JSON, in place of fitting again")]
Result = TypeVar("Result", bound=BaseModel)


# --- shared by the commands --------------------------------------------------------------------------------------------


def _warn(lines: tuple[str, ...]) -> None:
    for line in lines:
        err.print(f"[yellow]calibench: warning:[/] {escape(line)}")


def _store(folder: Path | None = None) -> Store:
    """The data folder: `folder`, else what CALIBENCH_DATA says; made if it isn't there."""
    from lab.capture.store import Settings, Store

    settings = Settings() if folder is None else Settings(data=folder)
    return Store.open(settings)


def _stored_recordings(store: Store, session_id: str) -> RecordingSet:
    """A session as a recording set, looked through like a folder."""
    recordings = store.recording_set(session_id)
    if not recordings.captures():
        raise InputError(f"session {session_id}: nothing was captured yet; resume it with `calibench capture --resume`")
    problems, warnings = recording.inspect(recordings)
    if problems:
        raise RecordingError(problems)
    recordings.warnings = tuple(warnings)
    return recordings


def _recordings(source: str) -> RecordingSet:
    """The recording set in a folder, or that of a stored session; its warnings go to stderr."""
    from lab.capture.store import Settings

    if Path(source).exists() or os.sep in source:
        recordings = recording.read(source)
    elif not Settings().data.is_dir():
        raise InputError(f"{source}: no such folder, and there are no sessions in {Settings().data}; correct it")
    else:
        store = _store()
        if not store.has_session(source):
            raise InputError(f"{source}: neither a recording set's folder nor a session in {store.root}; correct it")
        recordings = _stored_recordings(store, source)
    _warn(recordings.warnings)
    return recordings


def _instruments(source: str) -> dict[str, dict[str, str]]:
    """What the instruments of a stored session said of themselves; nothing for a folder."""
    if Path(source).exists():
        return {}
    runs = _store().runs(source)
    return runs[-1].instruments if runs else {}


@contextlib.contextmanager
def _bar(what: str) -> Iterator[Advance]:
    """A progress bar on stderr where that is a terminal; yields `advance(text, share)`."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        task = progress.add_task(what, total=1.0)
        yield lambda text, share: progress.update(task, description=f"{what}: {escape(text)}", completed=share)


def _check_writable(file: Path | None) -> None:
    """Refuse a result's file that can't be written before the work, not after it."""
    if file is None or str(file) == "-":
        return
    if file.is_dir() or not file.parent.is_dir() or not os.access(file.parent, os.W_OK):
        raise InputError(f"{file}: can't be written; name a file in a folder that exists and is yours")


def _write_json(result: BaseModel, file: Path | None) -> None:
    """The result as JSON: completely or not at all."""
    if file is None:
        return
    text = result.model_dump_json(indent=1) + "\n"
    if str(file) == "-":
        sys.stdout.write(text)
        return
    from lab.formats.raw_file import replacing

    with replacing(file) as partial:
        partial.write_text(text, encoding="utf-8")


def _load(model: type[Result], file: Path) -> Result:
    """A result that an earlier command wrote with `--json`."""
    try:
        return model.model_validate_json(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: can't be read ({error}); give the file that --json wrote") from error
    except ValidationError as error:
        first = error.errors()[0]
        at = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{file}: not what --json wrote: {at} {first['msg']}; write it again") from error


def _fitted(recordings: RecordingSet, fit_file: Path | None) -> FitResult:
    if fit_file is not None:
        return _load(FitResult, fit_file)
    with _bar("fit") as advance:
        return fit_recording_set(recordings, advance)


def _validated(
    recordings: RecordingSet, fit: FitResult, models: dict[Side, CameraFile] | None = None
) -> ValidationResult:
    from lab.predict.validate import validate

    with _bar("validate"):
        return validate(recordings, fit, models=models)


def _examined(
    recordings: RecordingSet,
    fit: FitResult,
    baseline: dict[Side, CameraFile] | None = None,
    *,
    pictures: bool = True,
    bootstrap: int = 0,
) -> Diagnosis:
    from lab.diagnose import examine

    with _bar("diagnose") as advance:
        return examine(recordings, fit, advance, baseline=baseline, pictures=pictures, bootstrap=bootstrap)


def _camera_path(recordings: RecordingSet, side: Side, path: Path) -> Path:
    """Where a side's camera file lies: `path` itself where that is a file's name, else SIDE.toml in it."""
    if path.suffix != ".toml":
        return path / f"{side}.toml"
    if len(recordings.sides) > 1:
        raise InputError(f"{path}: is one file, and there are {len(recordings.sides)} cameras; name a folder")
    return path


def _read_models(recordings: RecordingSet, path: Path | None) -> dict[Side, CameraFile]:
    """Cameras that `--save` or `--write-cameras` wrote; none where no path is given."""
    from lab.formats.camera_file import read_camera

    if path is None:
        return {}
    return {side: read_camera(_camera_path(recordings, side, path)) for side in recordings.sides}


def _save_models(recordings: RecordingSet, diagnosis: Diagnosis, path: Path) -> None:
    """Write the improved models, and say what each has that the baseline hasn't."""
    from lab.formats.camera_file import write_camera

    for side, content in diagnosis.improved.items():
        file = _camera_path(recordings, side, path)
        _make_folder(file.parent)
        write_camera(file, content)
        acting = ", ".join(one.name for one in content.effects) or "no effect beside the baseline"
        err.print(escape(f"camera: {file}: {acting}"))
    for item in diagnosis.result.unexplained:
        err.print(escape(f"{item.side}: {item.correction}"))


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be made ({error.strerror}); name a folder that is yours") from error


# --- what is printed ---------------------------------------------------------------------------------------------------


def _print_skipped(skipped: tuple[Skipped, ...]) -> None:
    for item in skipped:
        of = f" ({item.side})" if item.side else ""
        out.print(f"skipped: {escape(item.step)}{of}: {escape(item.reason)}")


def _print_fit(recordings: RecordingSet, fit: FitResult) -> None:
    from lab.report.figures import by_side, stereo_figures

    sides = list(fit.cameras)
    table = Table(box=None, pad_edge=False)
    table.add_column("quantity")
    for side in sides:
        table.add_column(f"{side} (± one standard uncertainty)")
    for name, figures in by_side(fit, recordings.manifest.cameras):
        table.add_row(name, *(figures[side].text if side in figures else "-" for side in sides))
    if table.row_count:
        out.print(table)
    if fit.stereo is not None:
        for figure in stereo_figures(fit.stereo):
            out.print(f"{figure.name}: {figure.text}")
    for side, camera in fit.cameras.items():
        for part in (camera.noise, camera.spectral):
            for remark in part.remarks if part else ():
                out.print(f"{side}: {escape(remark)}")
    _print_skipped(fit.skipped)


def _print_validation(validation: ValidationResult) -> None:
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
    _print_skipped(validation.skipped)


def _print_diagnosis(diagnosis: DiagnosisResult) -> None:
    out.print(f"verdict: [bold]{diagnosis.verdict}[/]")
    for sentence in diagnosis.summary:
        out.print(escape(sentence))
    if diagnosis.held_out is not None:
        held = diagnosis.held_out
        captures = f"{len(held.captures)} held-out captures"
        out.print(f"{captures}: chi2 {held.chi2_before:.0f} before, {held.chi2_after:.0f} after, n = {held.n}")
    if diagnosis.next_capture:
        out.print(f"next: {escape(diagnosis.next_capture)}")
    _print_skipped(diagnosis.skipped)


def _print_comparison(comparison: ComparisonResult, every: bool) -> None:
    from lab.report.figures import measured

    shown = [row for row in comparison.changes if every or row.changed]
    table = Table(box=None, pad_edge=False)
    for heading in ("quantity", "side", "where", "A", "B", "B - A", "sigma", "changed"):
        table.add_column(heading)
    for row in sorted(shown, key=lambda row: -row.significance_sigma):
        values = (measured(row.a, row.a_std), measured(row.b, row.b_std), measured(row.difference, row.difference_std))
        of = f"{row.where} (worst of {row.n})" if row.n > 1 else row.where
        marks = (f"{row.significance_sigma:.1f}", "yes" if row.changed else "no")
        table.add_row(escape(row.name), row.side or "", escape(of), *values, *marks)
    if table.row_count:
        out.print(table)
    for item in comparison.projection:
        turn = ", ".join(f"{value:.3f}" for value in item.implied_turn_mrad)
        out.print(
            f"projection ({item.side}): {item.difference_px:.4f} px rms apart once the implied motion is taken out, {item.expected_px:.4f} "
            f"px by the uncertainties, {item.significance_sigma:.1f} sigma: {'changed' if item.changed else 'unchanged'} (as stated "
            f"{item.as_stated_px:.4f} px; implied turn {turn} mrad)"
        )
    number = sum(row.changed for row in comparison.changes) + sum(item.changed for item in comparison.projection)
    total = len(comparison.changes) + len(comparison.projection)
    out.print(
        f"{number or 'none'} of {total} numbers and curves changed beyond {comparison.threshold_sigma:.1f} sigma, which an unchanged rig "
        f"passes in {100 * comparison.false_alarm_rate:g} % of all comparisons"
    )
    _print_skipped(comparison.skipped)


# --- commands on recordings --------------------------------------------------------------------------------------------


@app.command()
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
            help="write every pixel's offset, dark current and gain, and which are defective, into DIR/SIDE (.npy and .png)",
        ),
    ] = None,
) -> None:
    """Calibrate: noise, spectral sensitivity, MTF, PSF, geometry, stereo."""
    _check_writable(json)
    recordings = _recordings(source)
    result = _fitted(recordings, None)
    if str(json) != "-":
        _print_fit(recordings, result)
    _write_json(result, json)
    if cameras is not None:
        _write_cameras(recordings, result, cameras)
    if maps is not None:
        _write_maps(recordings, maps)


def _write_maps(recordings: RecordingSet, folder: Path) -> None:
    """Maps of every side's pixels; a side without darks is said."""
    from lab.fit.pixels import pixel_maps
    from lab.report.maps import write_maps

    for side in recordings.sides:
        try:
            names = write_maps(folder / side, pixel_maps(recordings, side))
        except NotDetermined as refused:
            err.print(escape(f"maps ({side}): none: {refused.reason}"))
        else:
            err.print(escape(f"maps: {folder / side}: {', '.join(n for n in names if n.endswith('.npy'))}"))


def _write_cameras(recordings: RecordingSet, result: FitResult, folder: Path) -> None:
    """Camera files of a fit, and what they hold that was neither fitted nor stated."""
    from lab.formats.camera_file import fitted_camera, write_camera
    from lab.predict.camera_model import assumptions

    _make_folder(folder)
    for side, fitted in result.cameras.items():
        write_camera(folder / f"{side}.toml", fitted_camera(recordings, side, fitted))
        taken = "; ".join(f"{one.quantity} taken as {one.value}" for one in assumptions(recordings.camera(side)))
        note = f" (neither fitted nor stated: {taken})" if taken else ""
        err.print(escape(f"camera: {folder / f'{side}.toml'}{note}"))


@app.command()
def validate(source: Source, json: Json = None, fit_file: FitFile = None, model: Model = None) -> None:
    """Predicted against measured, for what the fit didn't use. Exit code 4 where a check falls short."""
    _check_writable(json)
    recordings = _recordings(source)
    result = _validated(recordings, _fitted(recordings, fit_file), _read_models(recordings, model))
    if str(json) != "-":
        _print_validation(result)
    _write_json(result, json)
    if not all(check.passed for check in result.checks):
        raise typer.Exit(EXIT_CHECK)


@app.command()
def diagnose(
    source: Source,
    json: Json = None,
    fit_file: FitFile = None,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="DIR", help="write each camera with what was found as DIR/SIDE.toml"),
    ] = None,
    model: Model = None,
    bootstrap: Annotated[
        int,
        typer.Option(
            metavar="N",
            help=f"draw N healthy cameras (at least {FEWEST_DRAWS}) frame by frame for the threshold of a false alarm",
        ),
    ] = 0,
) -> None:
    """Name the physics that the model left out, where the recordings show any."""
    if 0 < bootstrap < FEWEST_DRAWS or bootstrap < 0:
        raise InputError(
            f"--bootstrap {bootstrap}: {FEWEST_DRAWS} draws are the fewest that a threshold follows from; give more, or 0"
        )
    _check_writable(json)
    recordings = _recordings(source)
    if save is not None:
        _camera_path(recordings, recordings.sides[0], save)
    baseline = _read_models(recordings, model)
    found = _examined(recordings, _fitted(recordings, fit_file), baseline, pictures=False, bootstrap=bootstrap)
    if str(json) != "-":
        _print_diagnosis(found.result)
    _write_json(found.result, json)
    if save is not None:
        _save_models(recordings, found, save)


@app.command()
def compare(
    a: Annotated[str, typer.Argument(metavar="A", help="a fit's JSON, a recording set's folder, or a session's id")],
    b: Annotated[str, typer.Argument(metavar="B", help="the calibration to compare with it")],
    json: Json = None,
    check: Annotated[bool, typer.Option("--check", help="exit code 4 where anything changed")] = False,
    every: Annotated[bool, typer.Option("--all", help="list what didn't change, too")] = False,
    report_folder: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="write DIR/compare.html, one page with pictures")
    ] = None,
) -> None:
    """Two calibrations: what changed beyond its uncertainty."""
    from lab.fit.compare import compare as compared

    _check_writable(json)
    result = compared(_calibration(a), _calibration(b))
    if str(json) != "-":
        _print_comparison(result, every)
    _write_json(result, json)
    if report_folder is not None:
        from lab.report.compare import write_comparison

        err.print(f"report: {escape(str(write_comparison(report_folder, result)))}")
    if check and result.changed:
        raise typer.Exit(EXIT_CHECK)


def _calibration(source: str) -> FitResult:
    """A fit: of a file that `--json` wrote, as a session keeps it, or of recordings that are fitted now."""
    from lab.capture.store import Settings

    if Path(source).is_file():
        return _load(FitResult, Path(source))
    if not Path(source).exists() and Settings().data.is_dir():
        kept = _store().results(source, "fit")
        if kept:
            return FitResult.model_validate(kept[0].document)
    return _fitted(_recordings(source), None)


@app.command("import")
def import_(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="the folder of the recordings")],
    kind: Annotated[str, typer.Option("--from", metavar="KIND", help="emva1288 or raw-folder")],
    out_folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="the recording set to write")],
    checkerboard: Annotated[
        str, typer.Option(metavar="ROWSxCOLS", help="raw-folder: inner corners; the images are pairs leftNN, rightNN")
    ] = "",
    square_mm: Annotated[float, typer.Option(help="side of that checkerboard's squares")] = 0.0,
) -> None:
    """Turn another format into a recording set."""
    from lab.formats.importers import read_checkerboard_pairs, read_foreign

    if checkerboard:
        corners = re.fullmatch(r"(\d+)x(\d+)", checkerboard)
        if kind != "raw-folder" or corners is None or square_mm <= 0:
            raise InputError(
                "--checkerboard: give --from raw-folder --checkerboard ROWSxCOLS --square-mm S, as in 6x9 and 25"
            )
        recordings = read_checkerboard_pairs(path, (int(corners[1]), int(corners[2])), square_mm)
    else:
        recordings = read_foreign(kind, path)
    _warn(recordings.warnings)
    folder = recording.write(recordings, out_folder)
    out.print(f"{folder}: {len(recordings.manifest.captures)} captures of {', '.join(recordings.sides)}")


@app.command()
def report(
    source: Source,
    out_file: Annotated[Path, typer.Option("--out", metavar="FILE", help="the page to write")] = Path("report.html"),
    fit_file: FitFile = None,
) -> None:
    """Fit, validate, diagnose, and write one page with pictures."""
    from lab.report import provenance_of, write_report

    _check_writable(out_file)
    recordings = _recordings(source)
    fitted = _fitted(recordings, fit_file)
    validation, diagnosis = _validated(recordings, fitted), _examined(recordings, fitted).result
    provenance = provenance_of(recordings, _instruments(source))
    out.print(f"report: {write_report(out_file, recordings, fitted, validation, diagnosis, provenance)}")


# --- simulation --------------------------------------------------------------------------------------------------------


@app.command()
def lens(
    file: Annotated[Path, typer.Argument(metavar="FILE.zmx", help="a Zemax prescription")],
    json: Json = None,
    report_folder: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="write DIR/lens.html, one page with pictures")
    ] = None,
    focus: Annotated[
        str, typer.Option(help="the image where the file has it (file) or at best focus on axis (best)")
    ] = "file",
    field_deg: Annotated[
        float | None, typer.Option(help="the corner of the field (without: the file's largest)")
    ] = None,
    glass: Annotated[
        list[str] | None, typer.Option(metavar="NAME=OTHER", help="a glass for another: NAME=OTHER or NAME=nd,Vd")
    ] = None,
) -> None:
    """What a lens prescription amounts to: first-order quantities, illumination, distortion, MTF, PSF."""
    from lab.predict.lens import parse_glasses, trace_prescription

    _check_writable(json)
    if focus not in ("file", "best"):
        raise InputError(f"--focus {focus}: give file or best")
    with _bar(file.name) as advance:
        traced = trace_prescription(
            file,
            focus="best" if focus == "best" else "file",
            maximum_field_deg=field_deg,
            glasses=parse_glasses(glass or []),
            progress=advance,
        )
    _warn(traced.result.warnings)
    if str(json) != "-":
        _print_lens(traced.result)
    _write_json(traced.result, json)
    if report_folder is not None:
        from lab.report.lens import write_lens_report

        out.print(f"report: {write_lens_report(report_folder, traced)}")


def _print_lens(result: LensResult) -> None:
    out.print(
        f"{escape(result.name)}: f = {result.focal_length_mm:.4f} mm, f/{result.f_number:.3f}, "
        f"entrance pupil {result.entrance_pupil_mm:.4f} mm at {result.primary_wavelength_nm:.1f} nm"
    )
    table = Table(box=None, pad_edge=False)
    for heading in ("field, deg", "height, mm", "relative illumination", "distortion, %", "in the window, %"):
        table.add_column(heading, justify="right")
    at = result.reference_wavelength_nm
    first = result.fields[0].mtf
    curve = next(i for i, one in enumerate(first) if one.wavelength_nm == at)
    frequencies = first[curve].frequency_lp_per_mm
    for frequency in frequencies:
        table.add_column(f"MTF S/T, {frequency:g} lp/mm", justify="right")
    for field in result.fields[::4] if len(result.fields) == 21 else result.fields:
        nearest = min(field.psf, key=lambda one: abs(one.wavelength_nm - at))
        mtf = field.mtf[curve]
        table.add_row(
            f"{field.angle_deg:.2f}",
            f"{field.height_mm:.4f}",
            f"{field.relative_illumination:.4f}",
            f"{field.distortion_percent:.3f}",
            f"{100 * nearest.encircled_share:.2f}",
            *(f"{s:.3f} / {t:.3f}" for s, t in zip(mtf.sagittal, mtf.tangential, strict=True)),
        )
    out.print(table)


@app.command()
def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            metavar="SCENE", help="a scene's name (`calibench simulate list` shows them), a picture or a cube"
        ),
    ] = "",
    out_file: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="the frame: .npy, .tif or .dng")
    ] = None,
    illuminant: Annotated[
        str, typer.Option(metavar="NAME or CSV", help="an illuminant (D65, A, FL2, ...) or a measured light")
    ] = "D65",
    luminance_cd_m2: Annotated[
        float | None, typer.Option(help="of a perfect white diffuser in that light (named lights: 100)")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(metavar="FILE", help="a camera file (TOML); without one, a typical RGB camera")
    ] = None,
    lens: Annotated[Path | None, typer.Option(metavar="FILE.zmx", help="put this lens before the camera")] = None,
    exposure_s: Annotated[
        float | None, typer.Option(help="exposure (without: the brightest 1 % at 70 % of what a pixel holds)")
    ] = None,
    gain_db: Annotated[float, typer.Option(help="analogue gain")] = 0.0,
    temperature_c: Annotated[float | None, typer.Option(help="temperature of the sensor")] = None,
    distance_mm: Annotated[float, typer.Option(help="distance of the scene from the lens")] = 1000.0,
    parameter: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="a parameter of the scene; may be repeated")
    ] = None,
    seed: Annotated[int, typer.Option(help="seed of the noise: the same gives the same frame")] = 0,
    pattern_seed: Annotated[int, typer.Option(help="seed of the fixed patterns: which camera of its kind")] = 0,
    expected: Annotated[bool, typer.Option("--expected", help="leave the noise out")] = False,
    cache: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="where lens tables are kept (CALIBENCH_CACHE, else the user's cache)"),
    ] = None,
    write_camera_file: Annotated[
        Path | None, typer.Option("--write-camera", metavar="FILE", help="write the camera as a file to start from")
    ] = None,
) -> None:
    """Simulate one raw frame, with a preview (NAME.preview.png) and a record (NAME.json) beside it."""
    from lab.predict import simulate as simulation

    if scene == "list":
        _print_scenes()
        return
    if out_file is None and write_camera_file is None:
        raise InputError("simulate: no --out; name the frame's file, ending in .npy, .tif or .dng")
    if out_file is not None and not scene:
        raise InputError("simulate: no SCENE; `calibench simulate list` shows them")
    if out_file is not None:
        simulation.check_out(out_file)
    options = simulation.options_of(
        {
            "scene": scene,
            "parameters": simulation.parameters_of(parameter or []),
            "illuminant": illuminant,
            "luminance_cd_m2": luminance_cd_m2,
            "distance_mm": distance_mm,
            "exposure_s": exposure_s,
            "gain_db": gain_db,
            "temperature_c": temperature_c,
            "seed": seed,
            "pattern_seed": pattern_seed,
            "expected": expected,
        }
    )
    with _bar("simulate") as advance:
        content = simulation.camera_for(camera, lens, cache, advance)
        if write_camera_file is not None:
            from lab.formats.camera_file import write_camera

            write_camera(write_camera_file, content)
            out.print(f"camera: {escape(str(write_camera_file))}")
        if out_file is None:
            return
        made = simulation.simulate(options, content, advance)
        advance("files", 0.95)
        record = simulation.write(made, out_file)
    _warn(record.lens_warnings)
    for line in simulation.summary_lines(record, out_file):
        out.print(escape(line))


def _print_scenes() -> None:
    from sim.scene.catalogue import SCENES

    table = Table(box=None, pad_edge=False)
    for heading in ("scene", "what it shows", "parameters (--set KEY=VALUE)"):
        table.add_column(heading)
    for name, scene in SCENES.items():
        keys = (f"{key}={scene.model_fields[key].default}" for key in scene.quantities())
        table.add_row(name, scene.shows, escape(" ".join(keys)))
    out.print(table)


@app.command()
def effects(
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="one effect, with all that it declares")] = "",
) -> None:
    """The library of effects: what a diagnosis can name, and what a camera file can have."""
    from sim.effects import library

    if not name:
        table = Table(box=None, pad_edge=False)
        for heading in ("effect", "acts in", "parameters"):
            table.add_column(heading)
        for kind in library.effects().values():
            table.add_row(kind.name, str(kind.stage), escape(" ".join(kind.quantities())))
        out.print(table)
        return
    try:
        kind = library.effect(name)
    except KeyError as unknown:
        raise InputError(str(unknown.args[0])) from None
    out.print(escape(f"{kind.name} ({kind.stage}): {kind.sentence}"))
    table = Table(box=None, pad_edge=False)
    for heading in ("parameter", "unit", "from", "to", "usual", "absent", "what it is"):
        table.add_column(heading)
    for field, quantity in kind.quantities().items():
        usual = "any" if quantity.prior is None else "{:g} ± {:g}".format(*quantity.prior)
        limits = ("-" if v is None else f"{v:g}" for v in (quantity.lower, quantity.upper))
        absent = "-" if quantity.absent is None else f"{quantity.absent:g}"
        table.add_row(field, quantity.unit, *limits, usual, absent, escape(quantity.meaning))
    out.print(table)
    for heading, told in (
        ("shown by", sorted(kind.shown_by)),
        ("can look like", sorted(kind.rivals)),
        ("doesn't depend on", sorted(kind.invariances)),
        ("after", [kind.reference]),
    ):
        out.print(escape(f"{heading}: {', '.join(told) or 'nothing'}"))


# --- commands on stations and sessions ---------------------------------------------------------------------------------


@app.command()
def capture(
    station: StationFile = None,
    quick: Quick = False,
    out_folder: DataFolder = None,
    name: Annotated[str, typer.Option(help="what the session is called")] = "",
    resume: Resume = "",
) -> None:
    """Run the sequences of a station and keep what was captured. Without a station file: on the mock bench."""
    store = _store(out_folder)
    session_id = _captured(store, station, quick, name, resume)
    out.print(f"session: {session_id}")


@app.command()
def run(
    station: StationFile = None,
    quick: Quick = False,
    out_folder: DataFolder = None,
    name: Annotated[str, typer.Option(help="what the session is called")] = "",
    resume: Resume = "",
    resolve: Annotated[
        bool,
        typer.Option(
            "--resolve", help="where rivals are left, take the capture that tells them apart, and decide again"
        ),
    ] = False,
) -> None:
    """The main job: capture, fit, validate, diagnose, report. Without a station file: on the mock bench."""
    from lab.report import provenance_of, words, write_report

    store = _store(out_folder)
    session_id = _captured(store, station, quick, name, resume)
    recordings = _stored_recordings(store, session_id)
    _warn(recordings.warnings)
    fitted = _fitted(recordings, None)
    validation = _validated(recordings, fitted)
    examined = _examined(recordings, fitted)
    if resolve:
        examined = _resolved(store, station, recordings, fitted, examined)
    diagnosis = examined.result
    folder = store.folder(session_id)
    _save_models(recordings, examined, folder / "cameras")
    for kind, result in (("fit", fitted), ("validate", validation), ("diagnose", diagnosis)):
        store.add_result(kind, session_id, result.model_dump(mode="json"))
        _write_json(result, folder / f"{kind}.json")
    runs = store.runs(session_id)
    provenance = provenance_of(recordings, runs[-1].instruments if runs else {})
    page = write_report(folder / "report.html", recordings, fitted, validation, diagnosis, provenance)
    _print_fit(recordings, fitted)
    badge, _, headline = words.headline(diagnosis)
    out.print(f"\n[bold]{badge}[/]: {headline}")
    for sentence in words.summary(fitted, validation, diagnosis):
        out.print(escape(sentence))
    if diagnosis.next_capture:
        out.print(f"Next: {escape(diagnosis.next_capture)}")
    out.print(f"\nsession: {session_id}")
    out.print(f"report: {page}")


@app.command()
def sessions(data: StoreFolder = None) -> None:
    """List the stored sessions."""
    table = Table(box=None, pad_edge=False)
    for heading in ("session", "name", "created", "state", "steps done"):
        table.add_column(heading)
    for info in _store(data).sessions():
        created = f"{info.created:%Y-%m-%d %H:%M}"
        table.add_row(info.id, escape(info.name), created, info.state, f"{info.steps_done} of {info.steps}")
    out.print(table)


@app.command()
def export(
    session: Annotated[str, typer.Argument(metavar="SESSION", help="a stored session's id")],
    to: Annotated[Path, typer.Option("--to", metavar="DIR", help="the recording set to write")],
    data: StoreFolder = None,
) -> None:
    """Write a stored session as a recording set."""
    recordings = _stored_recordings(_store(data), session)
    _warn(recordings.warnings)
    folder = recording.write(recordings, to)
    out.print(f"{folder}: {len(recordings.manifest.captures)} captures of {', '.join(recordings.sides)}")


def _resolved(
    store: Store, station: Path | None, recordings: RecordingSet, fitted: FitResult, examined: Diagnosis
) -> Diagnosis:
    """Take the best capture that the station can take by itself, and decide again with it; as it was where there is none."""
    from dataclasses import replace

    from lab.diagnose.outcome.next_capture import WORTH_TAKING
    from lab.formats.results import Resolution

    best = next((p for p in examined.proposals if p.plan is not None and p.capture.distance >= WORTH_TAKING), None)
    if best is None:
        why = (
            "no capture that the station takes by itself tells the rivals apart"
            if examined.proposals
            else "no rivals are left"
        )
        out.print(f"resolve: {why}")
        return examined
    capture = best.capture
    out.print(escape(f"resolve: {capture.capture}, to tell {' from '.join(capture.rivals)}"))
    session_id = _captured(store, station, False, f"{recordings.manifest.name} resolve".strip(), "", best.plan)
    joined = recordings.joined(_stored_recordings(store, session_id), "resolve")
    again = _examined(joined, fitted)
    before = Resolution(
        capture=capture.capture,
        session=session_id,
        verdict_before=examined.result.verdict,
        effects_before=examined.result.effects,
    )
    return replace(again, result=again.result.model_copy(update={"resolution": before}))


def _captured(
    store: Store,
    station_file: Path | None,
    quick: bool,
    name: str,
    resume: str,
    calibration: Calibration | None = None,
) -> str:
    """Run a new session, or what is left of the session `resume`; its id. On the mock bench where there is no station."""
    from lab.capture.session import CaptureSession
    from lab.capture.session import Progress as Standing
    from lab.capture.station import read_station

    if resume and store.session(resume).state == "finished":
        return resume
    with contextlib.ExitStack() as stack:
        file = station_file or stack.enter_context(_mock_bench())
        station = read_station(file)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        left = TextColumn("{task.fields[left]}")
        bar = stack.enter_context(Progress(*columns, left, console=err, transient=True, disable=not err.is_terminal))
        task = bar.add_task("capture", total=None, left="")
        begun: set[str] = set()

        def tell(standing: Standing) -> None:
            if not err.is_terminal and standing.sequence and standing.sequence not in begun:
                begun.add(standing.sequence)  # a log gets a line a sequence, where a person sees a bar
                out.print(f"{standing.sequence}: from step {standing.done + 1} of {standing.total}")
            left_s = "" if standing.left_s is None else f"about {standing.left_s:.0f} s left"
            what = escape(f"{standing.sequence} {standing.what}".strip())
            bar.update(task, description=what, total=standing.total, completed=standing.done, left=left_s)
            if standing.remark:
                err.print(f"calibench: {escape(standing.remark)}")

        if resume:
            session = CaptureSession(store, resume, on_progress=tell)
            session.station = station  # the instruments may have moved to other addresses
        else:
            session = CaptureSession.start(store, station, calibration, quick=quick, name=name, on_progress=tell)
        try:
            session.run()
        except KeyboardInterrupt:
            err.print(f"calibench: go on with `calibench capture --resume {session.id}`")
            raise
    return session.id


@contextlib.contextmanager
def _mock_bench() -> Iterator[Path]:
    """Start the mock bench as a process of its own, and give its station file; it ends with the block, or with us."""
    with tempfile.TemporaryDirectory(prefix="calibench-bench-") as folder:
        file = Path(folder) / "station.toml"
        command = [sys.executable, "-m", "lab.cli", "bench", "--station", str(file), "--with-parent"]
        # Of its own session: Ctrl-C is for us, and the bench has to be there while the shutter closes.
        bench = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        try:
            _await_ready(bench)
            yield file
        finally:
            assert bench.stdin is not None
            bench.stdin.close()
            try:
                bench.wait(BENCH_END_S)
            except subprocess.TimeoutExpired:
                bench.kill()
                bench.wait()


def _await_ready(bench: subprocess.Popen[str]) -> None:
    """Wait until the bench says that it is ready; what it says afterwards is read and dropped."""
    ready = threading.Event()

    def listen() -> None:
        assert bench.stdout is not None
        for line in bench.stdout:
            if line.strip() == "ready":
                ready.set()
        ready.set()

    threading.Thread(target=listen, daemon=True).start()
    if not ready.wait(BENCH_START_S) or bench.poll() is not None:
        raise DeviceError("mock bench: it doesn't start; see what `calibench bench` says")


app.add_typer(challenge)


# --- entry -------------------------------------------------------------------------------------------------------------


def _attach_others() -> None:
    """`calibench serve`, `key`, `mock` and `bench`: the service and the mocks bring their own commands, and nothing else here
    knows them."""
    from api.command import commands as service
    from mocks.command import commands as mocks

    names = {command.name or getattr(command.callback, "__name__", "") for command in app.registered_commands}
    if "bench" not in names:  # once in a process
        for others in (service, mocks):
            app.registered_commands += others.registered_commands
            app.registered_groups += others.registered_groups


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    try:
        _attach_others()
        code = app(arguments, standalone_mode=False)
    except (InputError, DeviceError) as error:
        if os.environ.get("CALIBENCH_DEBUG"):
            traceback.print_exc()
        for line in str(error).splitlines():
            err.print(f"[red]calibench:[/] {escape(line)}")
        return error.exit_code
    except KeyboardInterrupt:
        code = EXIT_INTERRUPTED
    except Exception as error:
        usage = getattr(error, "format_message", None)
        if usage is not None:
            err.print(f"[red]calibench:[/] {escape(usage())} See `calibench --help`.")
            return EXIT_INPUT
        if os.environ.get("CALIBENCH_DEBUG"):
            traceback.print_exc()
        text = " ".join(str(error).split())
        err.print(
            f"[red]calibench:[/] {type(error).__name__}: {escape(text)}: a defect of calibench; "
            "report it with what CALIBENCH_DEBUG=1 shows"
        )
        return EXIT_INTERNAL
    if code == EXIT_INTERRUPTED:
        err.print("[red]calibench:[/] interrupted")
    return int(code or 0)


if __name__ == "__main__":
    sys.exit(main())
