"""What commands read: recording sets, stored sessions, results and camera files; and the options that name them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from lab.capture.data_folder import existing_store
from lab.cli.console import pipeline_bar, warn
from lab.engine import Engine
from lab.errors import InputError
from lab.pipeline import Capturer, PipelineRequest, PipelineResult, run_pipeline, source_recordings

if TYPE_CHECKING:
    from pydantic import BaseModel

    from lab.capture.store import Store
    from lab.formats.camera_file import CameraFile
    from lab.formats.recording_set import RecordingSet
    from sim.camera import Side

M = TypeVar("M", bound="BaseModel")

Source = Annotated[str, typer.Argument(metavar="SOURCE", help="a recording set's folder, or a stored session's id")]
Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="write the result as JSON ('-': to stdout)")]
StoreFolder = Annotated[
    Path | None, typer.Option("--data", metavar="DIR", help="the data folder (CALIBENCH_DATA, else calibench-data)")
]
Model = Annotated[
    Path | None,
    typer.Option("--model", metavar="DIR", help="take the cameras of DIR/SIDE.toml, with their effects, as they are"),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        envvar="CALIBENCH_SCHEDULER",
        help="a Dask scheduler (tcp://HOST:PORT) whose workers do the parallel work in place of this computer; they "
        "have to see its files under the same path",
    ),
]
EngineName = Annotated[
    Engine,
    typer.Option(
        "--engine",
        help="what diagnoses: `evidence`, one table of sets of effects with their posterior probabilities, or `today`, "
        "the engine before it",
    ),
]
FitFile = Annotated[Path | None, typer.Option("--fit", metavar="FILE", help="a fit's JSON, in place of fitting again")]


def recordings_of(source: str, data: Path | None = None) -> RecordingSet:
    """The recording set in a folder, or that of a session stored in the data folder; its warnings go to stderr."""
    recordings = source_recordings(source, lambda: existing_store(data))
    warn(recordings.warnings)
    return recordings


def run_here(request: PipelineRequest, store: Store | None = None, capturer: Capturer | None = None) -> PipelineResult:
    """Carry out a pipeline's request with a progress bar."""
    with pipeline_bar() as tell:
        return run_pipeline(request, tell, store=store, capturer=capturer)


def read_given(model: type[M], file: Path | None) -> M | None:
    """The result of an option `--fit FILE`, `--validation FILE` or `--diagnosis FILE`; None without it: the pipeline
    computes one then."""
    if file is None:
        return None
    from lab.formats.result_file import read_result

    return read_result(model, file)


def camera_path(recordings: RecordingSet, side: Side, path: Path) -> Path:
    """The camera file of a side: `path` if it names a .toml file, else SIDE.toml in the folder `path`. Raises
    InputError for one file and two cameras."""
    if path.suffix != ".toml":
        return path / f"{side}.toml"
    if len(recordings.sides) > 1:
        raise InputError(f"{path}: is one file, and there are {len(recordings.sides)} cameras; name a folder")
    return path


def read_models(recordings: RecordingSet, path: Path | None) -> dict[Side, CameraFile]:
    """The cameras that `--save` or `--write-cameras` wrote, by side; none without a path."""
    from lab.formats.camera_file import read_camera

    if path is None:
        return {}
    return {side: read_camera(camera_path(recordings, side, path)) for side in recordings.sides}
