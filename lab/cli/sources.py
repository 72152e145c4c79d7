"""What commands read: recording sets, stored sessions, results and camera files; and the options that name them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer
from pydantic import BaseModel, ValidationError
from rich.markup import escape

from lab.cli.console import err, make_folder, progress_bar, warn
from lab.errors import InputError
from lab.fit import fit_recording_set
from lab.formats import recording_set as recording
from lab.formats.recording_set import RecordingError, RecordingSet
from lab.formats.results import FitResult, ValidationResult
from sim.camera import Side

if TYPE_CHECKING:
    from lab.capture.store import Store
    from lab.diagnose import Diagnosis
    from lab.formats.camera_file import CameraFile


Source = Annotated[str, typer.Argument(metavar="SOURCE", help="a recording set's folder, or a stored session's id")]
Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="write the result as JSON ('-': to stdout)")]
StoreFolder = Annotated[
    Path | None, typer.Option("--data", metavar="DIR", help="the data folder (CALIBENCH_DATA, else calibench-data)")
]
Model = Annotated[
    Path | None,
    typer.Option("--model", metavar="DIR", help="take the cameras of DIR/SIDE.toml, with their effects, as they are"),
]
FitFile = Annotated[Path | None, typer.Option("--fit", metavar="FILE", help="a fit's JSON, in place of fitting again")]
Result = TypeVar("Result", bound=BaseModel)


def open_store(folder: Path | None = None) -> Store:
    """The data folder: `folder`, else what CALIBENCH_DATA says; made if it isn't there."""
    from lab.capture.store import Settings, Store

    settings = Settings() if folder is None else Settings(data=folder)
    return Store.open(settings)


def stored_recordings(store: Store, session_id: str) -> RecordingSet:
    """A session as a recording set, looked through like a folder."""
    recordings = store.recording_set(session_id)
    if not recordings.captures():
        raise InputError(f"session {session_id}: nothing was captured yet; resume it with `calibench capture --resume`")
    problems, warnings = recording.inspect(recordings)
    if problems:
        raise RecordingError(problems)
    recordings.warnings = tuple(warnings)
    return recordings


def recordings_of(source: str) -> RecordingSet:
    """The recording set in a folder, or that of a stored session; its warnings go to stderr."""
    from lab.capture.store import Settings

    if Path(source).exists() or os.sep in source:
        recordings = recording.read(source)
    elif not Settings().data.is_dir():
        raise InputError(f"{source}: no such folder, and there are no sessions in {Settings().data}; correct it")
    else:
        store = open_store()
        if not store.has_session(source):
            raise InputError(f"{source}: neither a recording set's folder nor a session in {store.root}; correct it")
        recordings = stored_recordings(store, source)
    warn(recordings.warnings)
    return recordings


def instruments_of(source: str) -> dict[str, dict[str, str]]:
    """What the instruments of a stored session said of themselves; nothing for a folder."""
    if Path(source).exists():
        return {}
    runs = open_store().runs(source)
    return runs[-1].instruments if runs else {}


def read_result(model: type[Result], file: Path) -> Result:
    """A result that an earlier command wrote with `--json`."""
    try:
        return model.model_validate_json(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: can't be read ({error}); give the file that --json wrote") from error
    except ValidationError as error:
        first = error.errors()[0]
        at = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{file}: not what --json wrote: {at} {first['msg']}; write it again") from error


def fit_or_read(recordings: RecordingSet, fit_file: Path | None) -> FitResult:
    if fit_file is not None:
        return read_result(FitResult, fit_file)
    with progress_bar("fit") as advance:
        return fit_recording_set(recordings, advance)


def validated(
    recordings: RecordingSet, fit: FitResult, models: dict[Side, CameraFile] | None = None
) -> ValidationResult:
    from lab.predict.validate import validate

    with progress_bar("validate"):
        return validate(recordings, fit, models=models)


def examined(
    recordings: RecordingSet,
    fit: FitResult,
    baseline: dict[Side, CameraFile] | None = None,
    *,
    pictures: bool = True,
    bootstrap: int = 0,
) -> Diagnosis:
    from lab.diagnose import examine

    with progress_bar("diagnose") as advance:
        return examine(recordings, fit, advance, baseline=baseline, pictures=pictures, bootstrap=bootstrap)


def camera_path(recordings: RecordingSet, side: Side, path: Path) -> Path:
    """Where a side's camera file lies: `path` itself where that is a file's name, else SIDE.toml in it."""
    if path.suffix != ".toml":
        return path / f"{side}.toml"
    if len(recordings.sides) > 1:
        raise InputError(f"{path}: is one file, and there are {len(recordings.sides)} cameras; name a folder")
    return path


def read_models(recordings: RecordingSet, path: Path | None) -> dict[Side, CameraFile]:
    """Cameras that `--save` or `--write-cameras` wrote; none where no path is given."""
    from lab.formats.camera_file import read_camera

    if path is None:
        return {}
    return {side: read_camera(camera_path(recordings, side, path)) for side in recordings.sides}


def save_models(recordings: RecordingSet, diagnosis: Diagnosis, path: Path) -> None:
    """Write the improved models, and say what each has that the baseline hasn't."""
    from lab.formats.camera_file import write_camera

    for side, content in diagnosis.improved.items():
        file = camera_path(recordings, side, path)
        make_folder(file.parent)
        write_camera(file, content)
        acting = ", ".join(one.name for one in content.effects) or "no effect beside the baseline"
        err.print(escape(f"camera: {file}: {acting}"))
    for item in diagnosis.result.unexplained:
        err.print(escape(f"{item.side}: {item.correction}"))
